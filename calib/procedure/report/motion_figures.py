"""Figures of a designed or planned motion: q, v, a, τ with limits, tool path, search, and trade-offs of goals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.procedure.report.charts import Chart, Panel, level, line, save_all, text
from calib.procedure.report.geometry_figures import outlook_figure
from calib.procedure.report.style import AFTER, BEFORE, HALF_WIDTH, MARK, QUIET
from calib.robot.chain import Chain, Joint
from calib.robot.kinematics import sweep
from calib.trajectories.constraints import BoxLimit
from calib.trajectories.design.pareto import Front
from calib.trajectories.design.verify import dense_motion
from calib.units import motion_units

if TYPE_CHECKING:
    from calib.procedure.excitation.design import Designed
    from calib.procedure.excitation.planning import Planned

POINTS = 800
Limited = tuple[np.ndarray, np.ndarray, np.ndarray]  # values, lower and upper limit
TITLES = ("position", "velocity", "acceleration", "torque")


def motion_sheet(times: np.ndarray, series: Sequence[Limited], joints: Sequence[Joint]) -> Chart:
    """Return the chart of series of every joint, a row per joint and a column per series, limits dashed.

    Args:
        times: (N,) [s].
        series: values (N, n), lower and upper limit (n,), infinite without one: q, v, and a and τ where known.
        joints: of the robot (n).
    """
    units = motion_units(joint.kind for joint in joints)
    panels, nearest, title = [], np.inf, ""
    for j, joint in enumerate(joints):
        label = joint.name.replace("_", "_\n") if len(joint.name) > 12 else joint.name
        for (values, lower, upper), quantity, unit in zip(series, TITLES, units):
            first = values is series[0][0]
            bounds = [level(float(bound)) for bound in (lower[j], upper[j]) if np.isfinite(bound)]
            head, curve = f"{quantity} [{unit}]" if j == 0 else "", line(times, values[:, j])
            limits = times[0], times[-1]
            panels.append(Panel([curve, *bounds], head, "time [s]", label if first else "", xlim=limits, ticks=4))
            if len(bounds) < 2 or upper[j] <= lower[j]:
                continue
            gap = min(upper[j] - values[:, j].max(), values[:, j].min() - lower[j]) / (upper[j] - lower[j])
            if gap < nearest:
                nearest, title = gap, f"{quantity} of {joint.name} comes closest to its limit (dashed)"
    return Chart(panels, 0.7 + 0.75 * len(joints), len(series), title=title, shared="x")


def _motion_figure(designed: Designed) -> Chart:
    """Return the chart of q, v, a and τ of every joint over one period, limits dashed."""
    motion, model, limits = _motion(designed), designed.inputs.model, designed.inputs.limits
    boxes = {limit.order: (limit.lower, limit.upper) for limit in limits.constraints if isinstance(limit, BoxLimit)}
    none = np.full(designed.inputs.chain.n, np.inf)
    rows: list[Limited] = [
        (values, *boxes.get(order, (-none, none))) for order, values in enumerate((motion.q, motion.v, motion.a))
    ]
    if model.values is not None:
        torque = model.exact.largest_torques(model.values, motion.q, motion.v, motion.a)
        rows.append((torque, -limits.torque, limits.torque))
    return motion_sheet(motion.times, rows, designed.inputs.chain.joints)


def _path_figure(designed: Designed) -> Chart:
    """Return the chart of the tool's path from above and from the side."""
    tool = sweep(designed.inputs.chain, _motion(designed).q).position
    panels = [
        Panel(
            [
                line(tool[0], tool[j], form="-"),
                line(tool[0, :1], tool[j, :1], "o", MARK),
                text("start", tool[0, 0], tool[j, 0]),
                line([0.0], [0.0], "+", QUIET),
                text("base", 0.0, 0.0),
            ],
            title,
            "x [m]",
            f"{'xyz'[j]} [m]",
            grid="both",
            equal=True,
        )
        for j, title in ((1, "the tool's path from above"), (2, "from the side"))
    ]
    return Chart(panels, 3.2, 2)


def _history_figure(designed: Designed) -> Chart:
    """Return the chart of the objective over the search, for the best start."""
    history = np.asarray(designed.found.history, dtype=float)
    title = f"{history[0]:.4g} at first, {history[-1]:.4g} at last" if len(history) else ""
    curve = line(np.arange(len(history)), history)
    return Chart([Panel([curve], title, "improving feasible motions", "objective")], 2.2, width=HALF_WIDTH)


def front_figure(front: Front) -> Chart:
    """Return the chart of a condition number over the mean torque that it was traded for; open: dominated points."""
    index, torque = front.values[:, 0], 1.0 - front.values[:, 1]
    order = np.argsort(torque)
    good, rest = order[front.best[order]], order[~front.best[order]]
    own = front.designed
    points = [
        line(torque[good], index[good], "o-", size=4.0),
        line(torque[rest], index[rest], "o", BEFORE, hollow=True),
        line(torque[[own]], index[[own]], "s", MARK, size=5.5),
        text("designed", torque[own], index[own]),
    ]
    title = f"{len(np.unique(front.values[good], axis=0))} motions to choose from"
    words = f"mean {front.names[1].replace('slack ', '')} / limit"
    return Chart([Panel(points, title, words, front.names[0])], 2.5, width=HALF_WIDTH)


def _motion(designed: Designed) -> Any:
    times = np.linspace(0.0, designed.period, POINTS)
    return dense_motion(designed.family, designed.found.x, times, designed.found.factor)


def design_figures(designed: Designed) -> dict[str, Chart]:
    """Return the figures of a designed motion by name: motion, an arm's tool path, search, front and outlook if any."""
    figures = {"motion": _motion_figure(designed), "history": _history_figure(designed)}
    if isinstance(designed.inputs.chain, Chain):
        figures["path"] = _path_figure(designed)
    if designed.front is not None and len(designed.front.values):
        figures["front"] = front_figure(designed.front)
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
    """Return the chart of q, v, a and τ of every joint, limits dashed."""
    track, limits = planned.track, planned.limits
    rows: list[Limited] = [(track.q, planned.lower, planned.upper), (track.v, -limits.velocity, limits.velocity)]
    rows.append((track.a, -limits.acceleration, limits.acceleration))
    if track.tau is not None:
        rows.append((track.tau, -limits.torque, limits.torque))
    return motion_sheet(track.times, rows, planned.chain.joints)


def _profile_figure(planned: Planned) -> Chart:
    """Return the chart of the speed along the path, and of the share reached of each limit."""
    above, below, start = [], [], 0.0
    for one in planned.timings:
        times = start + one.profile.times
        above.append(line(times, np.sqrt(one.profile.x)))
        instants = np.repeat(times[:-1], len(one.sampled.s) // (len(times) - 1))
        for (name, used), colour in zip(one.used.items(), (BEFORE, AFTER, QUIET)):
            below.append(line(instants, used.max(axis=1), colour=colour, label=name if start == 0.0 else ""))
        start = float(times[-1])
    below.append(level(1.0))
    panels = [
        Panel(below, x="time [s]", y="share of the limit", xlim=(0.0, start), ylim=(0.0, 1.05)),
        Panel(above, x="time [s]", y="speed along the path", xlim=(0.0, start)),
    ]
    return Chart(panels, 3.8, title=f"{start:.3g} s, close to a limit for {planned.active_share:.0%} of the time")
