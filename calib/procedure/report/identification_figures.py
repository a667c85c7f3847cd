"""The figures of an identification's folder: torques of every file, what the residual holds, friction, the geometry."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from calib.dynamics.shapes import Joined
from calib.identification.cases import Case
from calib.procedure.dynamic_stage.identify import IdentificationOutcome
from calib.procedure.report import dynamics_figures, uncertainty_figures
from calib.procedure.report.style import save_all


def write(outcome: IdentificationOutcome, folder: Path) -> None:
    """Write ``plot_torque_<n>.png`` of every file, ``plot_residuals.png``, ``plot_friction.png`` and more."""
    save_all(figures(outcome), folder)
    uncertainty_figures.write(folder)


def figures(outcome: IdentificationOutcome) -> dict[str, Figure]:
    """Return the figures of an identification by name: torques of every file, residuals, friction."""
    cases = enumerate((*outcome.inputs.cases, *outcome.inputs.unseen), start=1)
    drawn = {f"torque_{number}": torques(case, outcome.predictions[case.name], outcome) for number, case in cases}
    return drawn | {"residuals": autocorrelations(outcome), "friction": friction(outcome)}


def torques(case: Case, predicted: np.ndarray, outcome: IdentificationOutcome) -> Figure:
    """Draw the torques of one file, measured and predicted (N, rows)."""
    kind = "fitted" if case.name in outcome.fit else "repeat" if case.name in outcome.repeated else "unseen"
    found = {**outcome.fit, **outcome.validation}[case.name].raw
    title = f"{case.name} ({kind}): {found.total:.3g} % of the torque unexplained"
    labels, units = _rows(outcome), _units(outcome)
    target = np.asarray(case.target)
    return dynamics_figures.torques(case.motion.t, target, predicted, labels, units, title, found.joints.tolist())


def autocorrelations(outcome: IdentificationOutcome) -> Figure:
    """Draw the autocorrelations of the residuals below the band, of the file that judges."""
    name = next(iter(outcome.validation or outcome.fit))
    found = {**outcome.fit, **outcome.validation}[name]
    values = [None if white is None else white.acf for white in found.whiteness]
    bounds = [None if white is None else white.bound for white in found.whiteness]
    title = f"{name}: autocorrelation of the residuals at {found.rate:.3g} Hz, dashed: white noise"
    return dynamics_figures.autocorrelations(values, bounds, _rows(outcome), title)


def friction(outcome: IdentificationOutcome) -> Figure:
    """Draw the friction that the first file shows, and the model's."""
    found, case = outcome.found, outcome.inputs.cases[0]
    model = found.dynamics.model
    terms = list(zip(model.columns, found.dynamics.values[model.inertial :]))
    n, rows = case.motion.n, case.target.shape[1]
    v, observed = np.asarray(case.motion.v), np.asarray(case.target - outcome.predictions[case.name])[:, rows - n :]
    curves, units = [], _units(outcome)[rows - n :]
    observed = observed.copy()
    for j in range(n):
        own = [one for one in terms if one[0].form.of_velocity and one[0].joint == j]
        grid = np.linspace(v[:, j].min(), v[:, j].max(), 400)
        curve = np.zeros(len(grid))
        for one, value in own:
            for speeds, target in ((grid, curve), (v[:, j], observed[:, j])):
                still = np.zeros(len(speeds))
                target += value * one.form.values(Joined(still, speeds, still), one.settings)
        curves.append((grid, curve))
    speeds = ["m/s" if joint.kind == "prismatic" else "rad/s" for joint in outcome.inputs.chain.joints]
    title = f"friction over velocity on {case.name}"
    names = outcome.inputs.chain.joint_names
    return dynamics_figures.friction(v, observed, curves, names, list(zip(speeds, units)), title)


def _rows(outcome: IdentificationOutcome) -> tuple[str, ...]:
    """Return the names of the torque rows."""
    return outcome.found.settings.torque_rows.titles(outcome.inputs.chain.joint_names)


def _units(outcome: IdentificationOutcome) -> Sequence[str]:
    """Return the unit of each torque row; A where the model is of currents."""
    rows = outcome.found.settings.torque_rows.units([one.kind == "prismatic" for one in outcome.inputs.chain.joints])
    return rows if outcome.inputs.unit == "N m" else [outcome.inputs.unit] * len(rows)
