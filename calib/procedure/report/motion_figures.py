"""Figures of a designed or planned motion: joint motion with limits, tool path, search history, trade-offs of goals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from calib.procedure.report.figures.charts import Captioned, Chart, Label, Layer, Level, Line, Panel
from calib.procedure.report.figures.style import AFTER, BEFORE, HALF_WIDTH, MARK, QUIET
from calib.procedure.report.geometry_figures import outlook_figure
from calib.robot.chain import Chain, Joint
from calib.robot.kinematics import sweep
from calib.trajectories.basis import SampledMotion
from calib.trajectories.constraints import BoxLimit
from calib.trajectories.design.pareto import Front
from calib.trajectories.design.verify import dense_motion
from calib.units import motion_units

if TYPE_CHECKING:
    from calib.procedure.excitation.design import Designed
    from calib.procedure.excitation.planning import Planned
# instants at which a designed motion is drawn
POINTS = 800
# letters of a joint's name from which on it is broken into lines
LONG_NAME = 12
# values, lower and upper limit
Limited = tuple[np.ndarray, np.ndarray, np.ndarray]

TITLES = ("position", "velocity", "acceleration", "torque")


def motion_sheet(times: np.ndarray, series: Sequence[Limited], joints: Sequence[Joint]) -> Chart:
    """Return a chart of the joint motion over time, with a row per joint and a column per quantity.

    Args:
        times: (N,) times [s].
        series: for each quantity, values (N, n), lower limits (n,) and upper limits (n,), infinite: no limit. The
            quantities are position, velocity and, if known, acceleration and torque.
        joints: the robot's n joints.
    """
    units = motion_units(joint.kind for joint in joints)
    panels = []
    smallest_gap, title = np.inf, ""
    for j, joint in enumerate(joints):
        name = joint.name.replace("_", "_\n") if len(joint.name) > LONG_NAME else joint.name
        for k, (values, lower, upper) in enumerate(series):
            quantity, unit = TITLES[k], units[k]
            layers: list[Layer] = [Line(times, values[:, j])]
            bounds = [float(bound) for bound in (lower[j], upper[j]) if np.isfinite(bound)]
            layers += map(Level, bounds)
            panel_title = f"{quantity} [{unit}]" if j == 0 else ""
            label = name if k == 0 else ""
            limits = times[0], times[-1]
            panels.append(Panel(layers, panel_title, "time [s]", label, limits, ticks=4, switch=joint.name))
            if len(bounds) == 2 and upper[j] > lower[j]:
                gap = min(upper[j] - values[:, j].max(), values[:, j].min() - lower[j]) / (upper[j] - lower[j])
                if gap < smallest_gap:
                    smallest_gap = gap
                    title = f"{quantity} of {joint.name} comes closest to its limit (dashed)"
    return Chart(panels, 0.7 + 0.75 * len(joints), len(series), title=title, shared="x")


def _motion_figure(designed: Designed) -> Chart:
    """Return a chart of each joint's position, velocity, acceleration and torque over one period; limits are dashed.

    Args:
        designed: the motion.
    """
    motion, model, limits = _dense_motion(designed), designed.inputs.model, designed.inputs.limits
    infinite = np.full(designed.inputs.chain.n, np.inf)
    # the order of the derivative that is limited: 0 position, 1 velocity, 2 acceleration
    boxes = dict.fromkeys(range(3), (-infinite, infinite))
    for limit in limits.constraints:
        if isinstance(limit, BoxLimit):
            boxes[limit.order] = limit.lower, limit.upper
    series: list[Limited] = [(motion.q, *boxes[0]), (motion.v, *boxes[1]), (motion.a, *boxes[2])]
    if model.values is not None:
        torque = model.exact.largest_torques(model.values, motion.q, motion.v, motion.a)
        series.append((torque, -limits.torque, limits.torque))
    return motion_sheet(motion.times, series, designed.inputs.chain.joints)


def _path_figure(designed: Designed) -> Chart:
    """Return a chart of the tool's path in a designed motion, seen from above and from the side."""
    position = sweep(designed.inputs.chain, _dense_motion(designed).q).position
    panels = []
    for axis, title in ((1, "the tool's path from above"), (2, "from the side")):
        layers = [
            Line(position[0], position[axis], form="-"),
            Line(position[0, :1], position[axis, :1], "o", MARK),
            Label("start", position[0, 0], position[axis, 0]),
            Line([0.0], [0.0], "+", QUIET),
            Label("base", 0.0, 0.0),
        ]
        panels.append(Panel(layers, title, "x [m]", f"{'xyz'[axis]} [m]", grid="both", equal=True))
    return Chart(panels, 3.2, 2)


def _history_figure(designed: Designed) -> Chart:
    """Return a chart of the objective over the search for a motion.

    It shows the search from the start point that led to the best motion.

    Args:
        designed: the motion.
    """
    history = np.asarray(designed.found.history, dtype=float)
    title = f"{history[0]:.4g} at first, {history[-1]:.4g} at last" if len(history) else ""
    curve = Line(np.arange(len(history)), history)
    return Chart([Panel([curve], title, "improving feasible motions", "objective")], 2.2, width=HALF_WIDTH)


def front_figure(front: Front) -> Chart:
    """Return a chart of the trade-off between condition number and mean torque; open points are dominated by others.

    Args:
        front: the trade-offs, with the condition number as the first and the torque slack as the second objective.
    """
    condition, torque = front.values[:, 0], 1.0 - front.values[:, 1]
    order = np.argsort(torque)
    efficient, dominated = order[front.best[order]], order[~front.best[order]]
    designed = front.designed
    layers = [
        Line(torque[efficient], condition[efficient], "o-", size=4.0),
        Line(torque[dominated], condition[dominated], "o", BEFORE, hollow=True),
        Line(torque[[designed]], condition[[designed]], "s", MARK, size=5.5),
        Label("designed", torque[designed], condition[designed]),
    ]
    count = len(np.unique(front.values[efficient], axis=0))
    label = f"mean {front.names[1].replace('slack ', '')} / limit"
    panel = Panel(layers, f"{count} motions to choose from", label, front.names[0])
    return Chart([panel], 2.5, width=HALF_WIDTH)


def _dense_motion(designed: Designed) -> SampledMotion:
    times = np.linspace(0.0, designed.period, POINTS)
    return dense_motion(designed.family, designed.found.x, times, designed.found.factor)


def design_figures(designed: Designed) -> dict[str, Captioned]:
    """Return the figures of a designed motion by name: motion, history, and, if available, path, front and outlook."""
    motion, history = _motion_figure(designed), _history_figure(designed)
    figures = {
        "motion": (motion, "One period of the motion; dashed: limits."),
        "history": (history, "The objective over the search, from the start point that led to the best motion."),
    }
    if isinstance(designed.inputs.chain, Chain):
        figures["path"] = _path_figure(designed), "The tool's path."
    if designed.front is not None and len(designed.front.values):
        caption = "Trade-off between condition number and mean torque; light points are dominated by others."
        figures["front"] = front_figure(designed.front), caption
    outlook = designed.outlook
    if outlook is not None and outlook.by_period:
        curve = [(period.seconds, 100 * period.torque_sigma_share) for period in outlook.by_period]
        plan = outlook.own.seconds, 100 * outlook.own.torque_sigma_share
        chart = outlook_figure(curve, plan, "motion [s]", "σ of torques [% of limits]")
        figures["outlook"] = chart, "What shorter and longer motions are predicted to identify."
    return figures


def plan_figures(planned: Planned) -> dict[str, Captioned]:
    """Return the figures of a planned motion by name: joint motion and speed profile."""
    return {
        "motion": (_plan_figure(planned), "The motion; dashed: limits."),
        "profile": (_profile_figure(planned), "Speed along the path, and the used share of each limit."),
    }


def _plan_figure(planned: Planned) -> Chart:
    """Return a chart of each joint's position, velocity, acceleration and torque in a planned motion.

    Limits are dashed.
    """
    track, limits = planned.track, planned.limits
    series: list[Limited] = [
        (track.q, planned.lower, planned.upper),
        (track.v, -limits.velocity, limits.velocity),
        (track.a, -limits.acceleration, limits.acceleration),
    ]
    if track.tau is not None:
        series.append((track.tau, -limits.torque, limits.torque))
    return motion_sheet(track.times, series, planned.chain.joints)


def _profile_figure(planned: Planned) -> Chart:
    """Return a chart of the speed along the path of a planned motion, and of the used share of each limit."""
    speeds, shares = [], []
    start = 0.0
    for timing in planned.timings:
        times = start + timing.profile.times
        speeds.append(Line(times, np.sqrt(timing.profile.x)))
        per_interval = len(timing.sampled.s) // (len(times) - 1)
        instants = np.repeat(times[:-1], per_interval)
        for (name, share), colour in zip(timing.used.items(), (BEFORE, AFTER, QUIET)):
            # the legend names the curves of the first path only
            label = name if start == 0.0 else ""
            shares.append(Line(instants, share.max(axis=1), colour=colour, label=label))
        start = float(times[-1])
    shares.append(Level(1.0))
    panels = [
        Panel(shares, x="time [s]", y="share of the limit", xlim=(0.0, start), ylim=(0.0, 1.05)),
        Panel(speeds, x="time [s]", y="speed along the path", xlim=(0.0, start)),
    ]
    return Chart(panels, 3.8, title=f"{start:.3g} s, close to a limit for {planned.active_share:.0%} of the time")
