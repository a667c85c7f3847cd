"""Pictures of an exciting motion: q, v, a, τ with their limits, the tool's path, the search, and the front."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from calib.procedure.report.style import (
    AFTER,
    BEFORE,
    HALF,
    MARK,
    QUIET,
    WIDE,
    legend,
    room,
    save_all,
    sheet,
    styled,
    thinned,
)
from calib.procedure.report.uncertainty_figures import outlook_figure
from calib.robot.kinematics import sweep
from calib.units import motion_units
from trajectories.constraints import BoxLimit
from trajectories.design.pareto import Front
from trajectories.design.verify import dense_motion

if TYPE_CHECKING:
    from calib.procedure.excitation.design import Designed
    from calib.procedure.excitation.planning import Planned

POINTS = 800
TITLES = ("position", "velocity", "acceleration", "torque")


def motion_sheet(
    times: np.ndarray, series: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray, str]], units: Sequence[str],
    names: Sequence[str],
) -> Figure:  # fmt: skip
    """Draw series of every joint, a line per joint and a column per series, with their limits dashed.

    Args:
        times: (N,) [s].
        series: values (N, n), lower and upper limit (n,), infinite without one, and title.
        units: of each series.
        names: of the n joints.
    """
    n, columns = len(names), len(series)
    labels = [name.replace("_", "_\n") if len(name) > 12 else name for name in names]
    title = _nearest(series, names)
    top = 0.5 if title else 0.25
    left = room(["-0.00"], 6.5) + 0.16 + 0.1 * max(label.count("\n") for label in labels)
    with styled():
        figure, axes = sheet(
            n, columns, WIDE, 0.35 + top + 0.75 * n, left=left, across=0.42, between=0.12, top=top, bottom=0.36
        )
        for j, k in np.ndindex(n, columns):
            values, lower, upper, quantity = series[k]
            axis = axes[j * columns + k]
            axis.plot(*thinned(times, values[:, j]), color=AFTER, linewidth=0.8)
            for bound in (lower[j], upper[j]):
                if np.isfinite(bound):
                    axis.axhline(bound, color=MARK, linewidth=0.6, linestyle="--")
            axis.set_xlim(times[0], times[-1])
            axis.locator_params(axis="y", nbins=3)
            axis.locator_params(axis="x", nbins=5)
            axis.tick_params(labelsize=6.5, labelbottom=j == n - 1, pad=2.0)
            if j == 0:
                axis.set_title(f"{quantity} [{units[k]}]", fontsize=7.5, fontweight="normal", pad=3.0)
            if k == 0:
                axis.set_ylabel(labels[j], fontsize=7, labelpad=2.0)
            if j == n - 1:
                axis.set_xlabel("time [s]", fontsize=7, labelpad=2.0)
        legend(figure, None, title)
    return figure


def _nearest(series: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray, str]], names: Sequence[str]) -> str:
    """Say which series of which joint comes nearest to its limit, of those that have both."""
    least, words = np.inf, ""
    for values, lower, upper, title in series:
        known = np.isfinite(lower) & np.isfinite(upper) & (upper > lower)
        for j in map(int, np.flatnonzero(known)):
            gap = min(upper[j] - values[:, j].max(), values[:, j].min() - lower[j]) / (upper[j] - lower[j])
            if gap < least:
                least, words = gap, f"{title} of {names[j]} comes nearest to its limit (dashed)"
    return words


def _motion_figure(designed: Designed) -> Figure:
    """Draw q, v, a and τ of every joint over one period, with their limits dashed."""
    motion = _motion(designed)
    states = zip((motion.q, motion.v, motion.a), (_limits(designed, order) for order in range(3)), TITLES)
    rows = [(values, lower, upper, title) for values, (lower, upper), title in states]
    values = designed.inputs.model.values
    if values is not None:
        torque = designed.inputs.model.exact.regressor(motion.q, motion.v, motion.a) @ values
        rows.append((torque, -designed.inputs.limits.torque, designed.inputs.limits.torque, TITLES[3]))
    units = motion_units(joint.kind for joint in designed.inputs.chain.joints)
    return motion_sheet(motion.times, rows, units, designed.inputs.chain.joint_names)


def _path_figure(designed: Designed) -> Figure:
    """Draw the tool's path from above and from the side."""
    tool = sweep(designed.inputs.chain, _motion(designed).q).position
    with styled():
        figure, axes = sheet(1, 2, WIDE, 3.4, across=0.6)
        for axis, (i, j), title in (
            (axes[0], (0, 1), "the tool's path from above"),
            (axes[1], (0, 2), "from the side"),
        ):
            axis.plot(tool[i], tool[j], color=AFTER, linewidth=0.9)
            axis.plot(tool[i, :1], tool[j, :1], "o", color=MARK, markersize=4)
            axis.annotate("start", (tool[i, 0], tool[j, 0]), xytext=(4, 4), textcoords="offset points", fontsize=7)
            axis.plot([0.0], [0.0], "+", color=QUIET)
            axis.annotate("base", (0.0, 0.0), xytext=(4, 4), textcoords="offset points", fontsize=7)
            axis.set_aspect("equal", adjustable="datalim")
            axis.set(xlabel=f"{'xyz'[i]} [m]", ylabel=f"{'xyz'[j]} [m]", title=title)
            axis.grid(True)
    return figure


def _history_figure(designed: Designed) -> Figure:
    """Draw the improving feasible motions of the best start."""
    history = np.asarray(designed.found.history, dtype=float)
    with styled():
        figure, (axis,) = sheet(width=HALF, height=2.3)
        axis.plot(history, color=AFTER, linewidth=1.0)
        axis.set(xlabel="improving feasible motions", ylabel="objective")
        if len(history):
            axis.set_title(f"{history[0]:.4g} at first, {history[-1]:.4g} at last")
    return figure


def _front_figure(front: Front) -> Figure:
    """Draw the trade-off the engineer chooses from; open points are beaten by others."""
    with styled():
        figure, (axis,) = sheet(width=HALF, height=2.7)
        good = front.values[front.best]
        good = good[np.argsort(good[:, 1])]
        axis.plot(good[:, 1], good[:, 0], "o-", color=AFTER, linewidth=0.9, markersize=4)
        rest = front.values[~front.best]
        axis.plot(rest[:, 1], rest[:, 0], "o", color=BEFORE, markerfacecolor="none", markersize=4)
        axis.set(xlabel=front.names[1], ylabel=front.names[0], title=f"{len(good)} motions to choose from")
    return figure


def _motion(designed: Designed) -> Any:
    times = np.linspace(0.0, designed.period, POINTS)
    return dense_motion(designed.family, designed.found.x, times, designed.found.factor)


def _limits(designed: Designed, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the limits (n,) of position, velocity or acceleration; infinite without one."""
    for limit in designed.inputs.limits.constraints:
        if isinstance(limit, BoxLimit) and limit.order == order:
            return limit.lower, limit.upper
    none = np.full(designed.inputs.chain.n, np.inf)
    return -none, none


def design_figures(designed: Designed) -> dict[str, Figure]:
    """Return the figures of a designed motion by name: motion, tool path, search, front and outlook if any."""
    figures = {"motion": _motion_figure(designed), "path": _path_figure(designed), "history": _history_figure(designed)}
    if designed.front is not None and len(designed.front.values):
        figures["front"] = _front_figure(designed.front)
    if (look := designed.outlook) is not None and look.others:
        curve = [(one.seconds, 100 * look.torque_share(one)) for one in look.others]
        own = (look.own.seconds, 100 * look.torque_share(look.own))
        figures["outlook"] = outlook_figure(curve, own, "motion [s]", "σ of torques [% of limits]")
    return figures


def plan_figures(planned: Planned) -> dict[str, Figure]:
    """Return the figures of a planned motion by name: motion and speed profile."""
    return {"motion": _plan_figure(planned), "profile": _profile_figure(planned)}


def write_design(designed: Designed, folder: Path) -> None:
    """Write the figures of a designed motion into its folder."""
    save_all(design_figures(designed), folder)


def write_plan(planned: Planned, folder: Path) -> None:
    """Write the figures of a planned motion into its folder."""
    save_all(plan_figures(planned), folder)


def _plan_figure(planned: Planned) -> Figure:
    """Draw q, v, a and τ of every joint with their limits dashed."""
    track, limits = planned.track, planned.limits
    rows = [
        (track.q, planned.lower, planned.upper, "position"),
        (track.v, -limits.velocity, limits.velocity, "velocity"),
    ]
    rows.append((track.a, -limits.acceleration, limits.acceleration, "acceleration"))
    if track.tau is not None:
        rows.append((track.tau, -limits.torque, limits.torque, "torque"))
    units = motion_units(joint.kind for joint in planned.chain.joints)
    return motion_sheet(track.times, rows, units, planned.chain.joint_names)


def _profile_figure(planned: Planned) -> Figure:
    """Draw the speed along the path, and which limit is nearest to being reached."""
    with styled():
        figure, (above, below) = sheet(2, 1, WIDE, 3.8, top=0.4, between=0.2)
        start = 0.0
        for one in planned.timings:
            times = start + one.profile.times
            above.plot(times, np.sqrt(one.profile.x), color=AFTER, linewidth=0.9)
            instants = np.repeat(times[:-1], len(one.sampled.s) // (len(times) - 1))
            for (name, used), color in zip(one.used.items(), (BEFORE, AFTER, QUIET)):
                label = name if start == 0.0 else None
                below.plot(instants, used.max(axis=1), color=color, linewidth=0.8, label=label)
            start = float(times[-1])
        below.axhline(1.0, color=MARK, linewidth=0.6, linestyle="--")
        above.set(ylabel="speed along the path")
        below.set(xlabel="time [s]", ylabel="share of the limit", ylim=(0, 1.05))
        above.tick_params(labelbottom=False)
        below.set_xlim(above.get_xlim())
        share = np.average(
            [one.active_share for one in planned.timings], weights=[one.duration for one in planned.timings]
        )
        legend(figure, below, f"{start:.3g} s, with a limit all but reached for {share:.0%} of them")
    return figure
