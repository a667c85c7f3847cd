"""The figures of an identification: measured against predicted torque, what the residual holds, friction curves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from calib.identification.cases import Case
from calib.identification.scores import Score
from calib.procedure.dynamic_stage.identify import IdentificationOutcome
from calib.procedure.report import uncertainty_figures
from calib.procedure.report.style import AFTER, BEFORE, INK, MARK, QUIET, WIDE, save, sheet, styled

MOST = 4000  # samples drawn per curve


def write(outcome: IdentificationOutcome, folder: Path) -> None:
    """Write ``plot_torque_<n>.png`` of every file, ``plot_residuals.png``, ``plot_friction.png`` and more."""
    cases = (*outcome.inputs.cases, *outcome.inputs.unseen)
    for number, case in enumerate(cases, start=1):
        save(torques(case, outcome.predictions[case.name], outcome), folder / f"plot_torque_{number}.png")
    proof = next(iter(outcome.validation or outcome.fit))
    save(autocorrelations({**outcome.fit, **outcome.validation}[proof], proof), folder / "plot_residuals.png")
    save(friction(outcome), folder / "plot_friction.png")
    uncertainty_figures.write(folder)


def torques(case: Case, predicted: np.ndarray, outcome: IdentificationOutcome) -> Figure:
    """Draw the measured and the predicted torque of every row over time, with the residual."""
    rows = case.target.shape[1]
    step = max(1, len(case.target) // MOST)
    t = case.motion.t[::step]
    labels = [
        f"joint {label}\n[{unit}]"
        for label, unit in zip(outcome.found.settings.torque_rows.numbered(case.motion.n), _units(outcome, rows))
    ]
    kind = "fitted" if case.name in outcome.fit else "repeat" if case.name in outcome.repeated else "unseen"
    with styled():
        figure, axes = sheet(rows, 1, WIDE, 1.15 * rows + 0.5)
        for j, axis in enumerate(axes):
            target, model = case.target[::step, j], predicted[::step, j]
            axis.plot(t, target, color=BEFORE, linewidth=0.8, label="measured")
            axis.plot(t, model, color=AFTER, linewidth=0.8, label="predicted")
            axis.plot(t, target - model, color=QUIET, linewidth=0.5, label="residual")
            axis.set_ylabel(labels[j])
        axes[0].set_title(f"{case.name} ({kind}): torque of each joint")
        figure.legend(*axes[0].get_legend_handles_labels(), ncols=3, loc="outside lower right", fontsize=7)
        axes[-1].set_xlabel("time [s]")
    return figure


def autocorrelations(found: Score, name: str) -> Figure:
    """Draw the autocorrelation of each row's residual below the band, with the bounds of white noise."""
    rows = len(found.whiteness)
    columns = min(rows, 4)
    with styled():
        figure, axes = sheet(-(-rows // columns), columns, WIDE, 1.7 * -(-rows // columns))
        for j, axis in enumerate(axes):
            white = found.whiteness[j] if j < rows else None
            if white is None:
                axis.set_visible(False)
                continue
            lags = np.arange(1, len(white.acf) + 1)
            axis.bar(lags, white.acf, color=AFTER, width=0.7)
            for bound in (-white.bound, white.bound):
                axis.axhline(bound, color=MARK, linewidth=0.7, linestyle="--")
            axis.set(ylim=(-1, 1), title=f"joint {j + 1}")
            axis.set_xlabel("lag [samples]")
        figure.suptitle(f"{name}: autocorrelation of the residuals at {found.rate:.3g} Hz", fontsize=8.5, color=INK)
    return figure


def friction(outcome: IdentificationOutcome) -> Figure:
    """Draw each joint's friction over its velocity: what the rigid model leaves, and the model's terms of velocity."""
    found, case = outcome.found, outcome.inputs.cases[0]
    model, values = found.dynamics.model, found.dynamics.values
    bodies = model.inertial
    n, rows = case.motion.n, case.target.shape[1]
    columns = min(n, 4)
    shown = {"velocity", "sign", "one", "speed", "cubic", "root", "stribeck"}
    units, prismatic = _units(outcome, rows), [joint.kind == "prismatic" for joint in outcome.inputs.chain.joints]
    residual = case.target - outcome.predictions[case.name]
    with styled():
        figure, axes = sheet(-(-n // columns), columns, WIDE, 1.8 * -(-n // columns))
        for j, axis in enumerate(axes):
            if j >= n:
                axis.set_visible(False)
                continue
            v = np.asarray(case.motion.v[:, j])
            grid = np.linspace(v.min(), v.max(), 400)
            curve, along = np.zeros(len(grid)), np.zeros(len(v))
            for one, value in zip(model.columns, values[bodies:]):
                if one.shape not in shown or one.acts != ((j, ((j, 1.0),)),):
                    continue
                from calib.dynamics.shapes import Joined

                zero = np.zeros(len(grid))
                curve += value * one.form.values(Joined(zero, grid, zero), one.settings)
                still = np.zeros(len(v))
                along += value * one.form.values(Joined(still, v, still), one.settings)
            step = max(1, len(v) // MOST)
            axis.plot(v[::step], (along + residual[:, rows - n + j])[::step], ".", color=BEFORE, markersize=0.8)
            axis.plot(grid, curve, color=AFTER, linewidth=1.2)
            speed = "m/s" if prismatic[j] else "rad/s"
            axis.set(title=f"joint {j + 1}", xlabel=f"velocity [{speed}]", ylabel=f"friction [{units[rows - n + j]}]")
        figure.suptitle("friction over velocity: model, and model + residual", fontsize=8.5, color=INK)
    return figure


def _units(outcome: IdentificationOutcome, rows: int) -> list[str]:
    """Return the unit of each torque row: N at prismatic joints; A where the model is of currents."""
    own = outcome.inputs.unit
    if own != "N m":
        return [own] * rows
    joints = outcome.inputs.chain.joints
    return ["N" if joints[k % len(joints)].kind == "prismatic" else "N m" for k in range(rows)]
