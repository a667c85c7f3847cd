"""The figures of the dynamics: those of an identification's outcome for its folder, those of plain arrays for both.

A certificate draws the latter from what the folder keeps (`calib.procedure.report.figures`).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from calib.dynamics.shapes import Joined
from calib.identification.cases import Case
from calib.procedure.dynamic_stage.identify import IdentificationOutcome
from calib.procedure.report import uncertainty_figures
from calib.procedure.report.style import (
    AFTER,
    BEFORE,
    HALF,
    INK,
    MARK,
    QUIET,
    WIDE,
    label_ticks,
    legend,
    log_axis,
    room,
    save_all,
    sheet,
    styled,
    thinned,
)

FEW = 8  # torque rows whose figures fit half a page


def write(outcome: IdentificationOutcome, folder: Path) -> None:
    """Write ``plot_torque_<n>.png`` of every file, ``plot_residuals.png``, ``plot_friction.png`` and more."""
    save_all(figures(outcome), folder)
    uncertainty_figures.write(folder)


def figures(outcome: IdentificationOutcome) -> dict[str, Figure]:
    """Return the figures of an identification by name: torques of every file, residuals, friction."""
    cases = enumerate((*outcome.inputs.cases, *outcome.inputs.unseen), start=1)
    drawn = {f"torque_{number}": file_torques(case, outcome.predictions[case.name], outcome) for number, case in cases}
    return drawn | {"residuals": _autocorrelations(outcome), "friction": _friction(outcome)}


def file_torques(case: Case, predicted: np.ndarray, outcome: IdentificationOutcome) -> Figure:
    """Draw the torques of one file, measured and predicted (N, rows)."""
    kind = "fitted" if case.name in outcome.fit else "repeat" if case.name in outcome.repeated else "unseen"
    found = {**outcome.fit, **outcome.validation}[case.name].raw
    title = f"{case.name} ({kind}): {found.total:.3g} % of the torque unexplained"
    labels, units = _rows(outcome), outcome.inputs.row_units
    target = np.asarray(case.target)
    return torques(case.motion.t, target, predicted, labels, units, title, found.joints.tolist())


def _autocorrelations(outcome: IdentificationOutcome) -> Figure:
    """Draw the autocorrelations of the residuals below the band, of the file that judges."""
    name = next(iter(outcome.validation or outcome.fit))
    found = {**outcome.fit, **outcome.validation}[name]
    values = [None if white is None else white.acf for white in found.whiteness]
    bounds = [None if white is None else white.bound for white in found.whiteness]
    title = f"{name}: autocorrelation of the residuals at {found.rate:.3g} Hz, dashed: white noise"
    return autocorrelations(values, bounds, _rows(outcome), title)


def _friction(outcome: IdentificationOutcome) -> Figure:
    """Draw the friction that the first file shows, and the model's."""
    found, case = outcome.found, outcome.inputs.cases[0]
    model = found.dynamics.model
    terms = list(zip(model.columns, found.dynamics.values[model.inertial :]))
    n, rows = case.motion.n, case.target.shape[1]
    v, observed = np.asarray(case.motion.v), np.asarray(case.target - outcome.predictions[case.name])[:, rows - n :]
    curves, units = [], outcome.inputs.row_units[rows - n :]
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
    return friction(v, observed, curves, names, list(zip(speeds, units)), title)


def _rows(outcome: IdentificationOutcome) -> tuple[str, ...]:
    """Return the names of the torque rows."""
    return outcome.found.settings.torque_rows.titles(outcome.inputs.chain.joint_names)


def torques(
    t: np.ndarray, measured: np.ndarray, predicted: np.ndarray, rows: Sequence[str], units: Sequence[str], title: str,
    errors: Sequence[float | None] = (),
) -> Figure:  # fmt: skip
    """Draw measured and predicted torque of every row over time, and what is left.

    Args:
        t: (N,) [s].
        measured, predicted: (N, rows) [units].
        rows, units: names of the torque rows, and their units.
        title: of the whole.
        errors: share of each row's torque that is left [%]; none where it is not known.
    """
    count = len(rows)
    columns = 2 if count > FEW else 1
    lines = -(-count // columns)
    with styled():
        figure, axes = sheet(
            lines, columns, WIDE, 0.8 + 0.95 * lines, left=0.5, across=0.4, between=0.27, top=0.45, bottom=0.4
        )
        for axis in axes[count:]:
            axis.set_visible(False)
        for j, axis in enumerate(axes[:count]):
            rest = measured[:, j] - predicted[:, j]
            for values, colour, width, label in (
                (measured[:, j], BEFORE, 1.4, "measured"), (predicted[:, j], AFTER, 0.7, "predicted"),
                (rest, QUIET, 0.5, "measured - predicted"),
            ):  # fmt: skip
                axis.plot(*thinned(t, values), color=colour, linewidth=width, label=label)
            share = errors[j] if j < len(errors) else None
            left = "" if share is None or not np.isfinite(share) else f": {share:.3g} % left"
            axis.set_title(f"{rows[j]} [{units[j]}]{left}", fontsize=7.5, fontweight="normal", pad=3.0)
            axis.tick_params(labelsize=6.5)
            axis.set_xlim(t[0], t[-1])
            if j + columns < count:
                axis.tick_params(labelbottom=False)
            else:
                axis.set_xlabel("time [s]", fontsize=7.5)
        legend(figure, axes[0], title)
    return figure


def errors_by_row(fitted: Sequence[float], unseen: Sequence[float], rows: Sequence[str]) -> Figure:
    """Draw the relative error of every row [%], on the training and on unseen motion."""
    place = np.arange(len(rows))
    many = len(rows) > FEW
    size = 6.5 if many else 7.5
    worst = int(np.argmax(unseen)) if len(rows) else 0
    with styled():
        height = 0.95 + 0.21 * len(rows)
        figure, (axis,) = sheet(1, 1, WIDE if many else HALF, height, left=room(rows, size), top=0.5)
        for shift, shares, colour, label in (
            (-0.19, fitted, BEFORE, "training motion"), (0.19, unseen, AFTER, "unseen motion"),
        ):  # fmt: skip
            axis.hlines(place + shift, 0.0, shares, colors=colour, linewidth=5.0, label=label)
        label_ticks(axis.yaxis, place, rows, size)
        axis.set(xlabel="torque unexplained [%]", ylim=(len(rows) - 0.5, -0.5))
        axis.set_xlim(left=0.0)
        axis.grid(axis="x")
        legend(figure, axis, f"at most {unseen[worst]:.3g} % left" if len(rows) else "")
    return figure


def autocorrelations(
    values: Sequence[Sequence[float] | np.ndarray | None], bounds: Sequence[float | None], rows: Sequence[str],
    title: str = "", width: float = WIDE,
) -> Figure:  # fmt: skip
    """Draw the autocorrelation of every row's residual, with the bounds of white noise.

    Args:
        values: at lags 1, 2, … of each torque row; None of rows that are too short to say.
        bounds: of white noise, of each row.
        rows: names of the torque rows.
        title: of the whole.
        width: of the figure [in].
    """
    shown = [j for j in range(len(rows)) if values[j] is not None]
    columns = min(7 if len(shown) > FEW else 4 if width > HALF else 3, max(1, len(shown)))
    lines = -(-max(1, len(shown)) // columns)
    with styled():
        figure, axes = sheet(
            lines, columns, width, 0.85 + 0.95 * lines, left=0.4, across=0.14, between=0.45, top=0.5, bottom=0.4
        )
        for axis in axes[len(shown) :]:
            axis.set_visible(False)
        for k, (j, axis) in enumerate(zip(shown, axes)):
            series, bound = np.asarray(values[j], dtype=float), bounds[j] or 0.0
            axis.vlines(np.arange(1, len(series) + 1), 0.0, series, colors=AFTER, linewidth=1.0)
            axis.hlines([-bound, bound], 0, len(series) + 1, colors=MARK, linewidth=0.7, linestyles="--")
            axis.set_title(rows[j], fontsize=7, fontweight="normal", pad=3.0)
            axis.set(ylim=(-1, 1), yticks=(-1, 0, 1), xlim=(0, len(series) + 1))
            axis.locator_params(axis="x", nbins=3)
            axis.tick_params(labelsize=6.5, labelleft=k % columns == 0, labelbottom=k + columns >= len(shown))
            if k + columns >= len(shown):
                axis.set_xlabel("lag [samples]", fontsize=6.5, labelpad=2.0)
        legend(figure, None, title)
    return figure


def friction(
    velocity: np.ndarray, observed: np.ndarray, curves: Sequence[tuple[np.ndarray, np.ndarray]], rows: Sequence[str],
    units: Sequence[tuple[str, str]], title: str = "",
) -> Figure:  # fmt: skip
    """Draw each joint's friction over its velocity: what the rigid model leaves, and the model's terms of velocity.

    Args:
        velocity, observed: (N, n), of each joint.
        curves: velocities and the model's friction there, of each joint.
        rows: names of the joints.
        units: of velocity and of friction, of each joint.
        title: of the whole.
    """
    n = len(rows)
    columns = min(n, 4)
    lines = -(-n // columns)
    step = max(1, len(velocity) // (2 * 700))
    with styled():
        figure, axes = sheet(lines, columns, WIDE, 0.6 + 1.6 * lines, across=0.5, between=0.62, left=0.55, top=0.5)
        for axis in axes[n:]:
            axis.set_visible(False)
        for j, axis in enumerate(axes[:n]):
            axis.plot(
                velocity[::step, j], observed[::step, j], ".", color=BEFORE, markersize=1.5, markeredgewidth=0.0,
                label="model + residual",
            )  # fmt: skip
            axis.plot(*curves[j], color=AFTER, linewidth=1.2, label="model")
            axis.set_title(rows[j], fontsize=7.5, fontweight="normal", pad=3.0)
            axis.set_xlabel(f"velocity [{units[j][0]}]", fontsize=7, labelpad=2.0)
            if j % columns == 0 or units[j] != units[j - 1]:
                axis.set_ylabel(f"friction [{units[j][1]}]", fontsize=7, labelpad=2.0)
            axis.tick_params(labelsize=6.5)
        legend(figure, axes[0], title)
    return figure


def significance(names: Sequence[str], values: np.ndarray, sigma: np.ndarray) -> Figure:
    """Draw how many sigmas each parameter is from zero; below two it is not told.

    Args:
        names: (p,).
        values, sigma: (p,), in each parameter's unit.
    """
    share = np.maximum(np.abs(values) / np.maximum(sigma, 1e-300), 0.1)
    size = 5.0 if len(names) > 60 else 6.0
    with styled():
        margin = room(names, size)
        figure, (axis,) = sheet(1, 1, WIDE, 1.75 + margin, bottom=margin)
        colours = [AFTER if one > 2 else QUIET for one in share]
        thick = min(8.0, 0.75 * 72.0 * (WIDE - 0.62) / (len(names) + 1))
        axis.vlines(np.arange(len(names)), 0.1, share, colors=colours, linewidth=thick)
        axis.axhline(2.0, color=MARK, linewidth=0.7, linestyle="--")
        log_axis(axis.yaxis, 0.1, 2.0 * share.max(initial=2.0))
        label_ticks(axis.xaxis, np.arange(len(names)), names, size, rotation=90)
        axis.set(ylabel="|value| / σ", xlim=(-0.7, len(names) - 0.3))
        axis.set_title(f"{int((share > 2).sum())} of {len(names)} parameters differ from zero by two sigmas", color=INK)
    return figure
