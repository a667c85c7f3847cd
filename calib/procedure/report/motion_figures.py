"""Pictures of an exciting motion: q, v, a, τ with their limits, the tool's path, the search, and the front."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.procedure.report.charts import Chart, Panel, level, line, save_all, text
from calib.procedure.report.geometry_figures import outlook_figure
from calib.procedure.report.style import AFTER, BEFORE, HALF_WIDTH, MARK, QUIET
from calib.robot.chain import Chain
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
) -> Chart:  # fmt: skip
    """Return series of every joint, a line per joint and a column per series, with their limits dashed.

    Args:
        times: (N,) [s].
        series: values (N, n), lower and upper limit (n,), infinite without one, and title.
        units: of each series.
        names: of the n joints.
    """
    n, columns = len(names), len(series)
    panels = []
    for j, k in ((j, k) for j in range(n) for k in range(columns)):
        values, lower, upper, quantity = series[k]
        last = j == n - 1
        bounds = [level(float(bound)) for bound in (lower[j], upper[j]) if np.isfinite(bound)]
        label = names[j].replace("_", "_\n") if len(names[j]) > 12 else names[j]
        panels.append(
            Panel(
                [line(times, values[:, j]), *bounds],
                f"{quantity} [{units[k]}]" if j == 0 else "",
                "time [s]" if last else "",
                label if k == 0 else "",
                xlim=(times[0], times[-1]),
                ticks=4,
                bare="" if last else "x",
            )
        )
    return Chart(panels, 0.7 + 0.75 * n, columns, title=_nearest(series, names))


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


def _motion_figure(designed: Designed) -> Chart:
    """Return q, v, a and τ of every joint over one period, with their limits dashed."""
    motion = _motion(designed)
    states = zip((motion.q, motion.v, motion.a), (_limits(designed, order) for order in range(3)), TITLES)
    rows = [(values, lower, upper, title) for values, (lower, upper), title in states]
    values = designed.inputs.model.values
    if values is not None:
        torque = designed.inputs.model.exact.regressor(motion.q, motion.v, motion.a) @ values
        rows.append((torque, -designed.inputs.limits.torque, designed.inputs.limits.torque, TITLES[3]))
    units = motion_units(joint.kind for joint in designed.inputs.chain.joints)
    return motion_sheet(motion.times, rows, units, designed.inputs.chain.joint_names)


def _path_figure(designed: Designed) -> Chart:
    """Return the tool's path from above and from the side."""
    tool = sweep(designed.inputs.chain, _motion(designed).q).position
    panels = [
        Panel(
            [
                line(tool[0], tool[j], form="-"), line(tool[0, :1], tool[j, :1], "o", MARK),
                text("start", tool[0, 0], tool[j, 0]), line([0.0], [0.0], "+", QUIET), text("base", 0.0, 0.0),
            ],
            title, "x [m]", f"{'xyz'[j]} [m]", grid="both", equal=True,
        )
        for j, title in ((1, "the tool's path from above"), (2, "from the side"))
    ]  # fmt: skip
    return Chart(panels, 3.2, 2)


def _history_figure(designed: Designed) -> Chart:
    """Return the improving feasible motions of the best start."""
    history = np.asarray(designed.found.history, dtype=float)
    title = f"{history[0]:.4g} at first, {history[-1]:.4g} at last" if len(history) else ""
    curve = line(np.arange(len(history)), history)
    return Chart([Panel([curve], title, "improving feasible motions", "objective")], 2.2, width=HALF_WIDTH)


def _front_figure(front: Front) -> Chart:
    """Return the trade-off the engineer chooses from; open points are beaten by others."""
    good = front.values[front.best]
    good, rest = good[np.argsort(good[:, 1])], front.values[~front.best]
    points = [line(good[:, 1], good[:, 0], "o-", size=4.0), line(rest[:, 1], rest[:, 0], "o", BEFORE, hollow=True)]
    title = f"{len(good)} motions to choose from"
    return Chart([Panel(points, title, front.names[1], front.names[0])], 2.5, width=HALF_WIDTH)


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


def design_figures(designed: Designed) -> dict[str, Chart]:
    """Return the figures of a designed motion by name: motion, an arm's tool path, search, front and outlook if any."""
    figures = {"motion": _motion_figure(designed), "history": _history_figure(designed)}
    if isinstance(designed.inputs.chain, Chain):
        figures["path"] = _path_figure(designed)
    if designed.front is not None and len(designed.front.values):
        figures["front"] = _front_figure(designed.front)
    if (look := designed.outlook) is not None and look.by_period:
        curve = [(one.seconds, 100 * one.torque_sigma_share) for one in look.by_period]
        own = (look.own.seconds, 100 * look.own.torque_sigma_share)
        figures["outlook"] = outlook_figure(curve, own, "motion [s]", "σ of torques [% of limits]")
    return figures


def plan_figures(planned: Planned) -> dict[str, Chart]:
    """Return the figures of a planned motion by name: motion and speed profile."""
    return {"motion": _plan_figure(planned), "profile": _profile_figure(planned)}


def write_design(designed: Designed, folder: Path) -> None:
    """Write the figures of a designed motion into its folder."""
    save_all(design_figures(designed), folder)


def write_plan(planned: Planned, folder: Path) -> None:
    """Write the figures of a planned motion into its folder."""
    save_all(plan_figures(planned), folder)


def _plan_figure(planned: Planned) -> Chart:
    """Return q, v, a and τ of every joint with their limits dashed."""
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


def _profile_figure(planned: Planned) -> Chart:
    """Return the speed along the path, and which limit is nearest to being reached."""
    above, below, start = [], [], 0.0
    for one in planned.timings:
        times = start + one.profile.times
        above.append(line(times, np.sqrt(one.profile.x)))
        instants = np.repeat(times[:-1], len(one.sampled.s) // (len(times) - 1))
        for (name, used), colour in zip(one.used.items(), (BEFORE, AFTER, QUIET)):
            below.append(line(instants, used.max(axis=1), colour=colour, label=name if start == 0.0 else ""))
        start = float(times[-1])
    below.append(level(1.0))
    share = np.average([one.active_share for one in planned.timings], weights=[one.duration for one in planned.timings])
    panels = [
        Panel(below, x="time [s]", y="share of the limit", xlim=(0.0, start), ylim=(0.0, 1.05)),
        Panel(above, x="time [s]", y="speed along the path", xlim=(0.0, start)),
    ]
    return Chart(panels, 3.8, title=f"{start:.3g} s, with a limit all but reached for {share:.0%} of them")
