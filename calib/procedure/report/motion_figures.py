"""Pictures of an exciting motion: q, v, a, τ with their limits, the tool's path, the search, and the front."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from calib.procedure.excitation.design import Designed
from calib.procedure.excitation.planning import Planned
from calib.procedure.report.style import (
    AFTER,
    BEFORE,
    HALF,
    MARK,
    QUIET,
    WIDE,
    motion_sheet,
    motion_units,
    save,
    sheet,
    styled,
)
from calib.robot.kinematics import sweep
from trajectories.constraints import BoxLimit
from trajectories.design.pareto import Front
from trajectories.design.verify import dense_motion

POINTS = 800
TITLES = ("position", "velocity", "acceleration", "torque")


def motion_figure(designed: Designed) -> Figure:
    """Draw q, v, a and τ of every joint over one period, with their limits dashed."""
    motion = _motion(designed)
    states = zip((motion.q, motion.v, motion.a), (_limits(designed, order) for order in range(3)), TITLES)
    rows = [(values, lower, upper, title) for values, (lower, upper), title in states]
    values = designed.dynamics.values
    if values is not None:
        torque = designed.dynamics.exact.regressor(motion.q, motion.v, motion.a) @ values
        rows.append((torque, -designed.limits.torque, designed.limits.torque, TITLES[3]))
    units = motion_units(joint.kind for joint in designed.chain.joints)
    return motion_sheet(motion.times, rows, units, designed.chain.joint_names)


def path_figure(designed: Designed) -> Figure:
    """Draw the tool's path in space, and from above."""
    tool = sweep(designed.chain, _motion(designed).q).position
    with styled():
        figure = Figure(figsize=(WIDE, 3.2))
        space: Any = figure.add_subplot(1, 2, 1, projection="3d")
        space.plot(*tool, color=AFTER, linewidth=0.9)
        space.scatter(*tool[:, :1], color=MARK, s=14)
        space.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", box_aspect=np.ptp(tool, axis=1) + 0.05)
        above = figure.add_subplot(1, 2, 2)
        above.plot(tool[0], tool[1], color=AFTER, linewidth=0.9)
        above.plot(tool[0, :1], tool[1, :1], "o", color=MARK, markersize=4)
        above.plot([0.0], [0.0], "+", color=QUIET)
        above.set(xlabel="x [m]", ylabel="y [m]", title="from above", aspect="equal")
    return figure


def history_figure(designed: Designed) -> Figure:
    """Draw the improving feasible motions of the best start."""
    with styled():
        figure, (axis,) = sheet(width=HALF, height=2.2)
        axis.plot(designed.found.history, color=AFTER, linewidth=1.0)
        axis.set(xlabel="improving feasible motions", ylabel="objective")
    return figure


def front_figure(front: Front) -> Figure:
    """Draw the trade-off the engineer chooses from; open points are beaten by others."""
    with styled():
        figure, (axis,) = sheet(width=HALF, height=2.6)
        good = front.values[front.best]
        good = good[np.argsort(good[:, 1])]
        axis.plot(good[:, 1], good[:, 0], "o-", color=AFTER, linewidth=0.9, markersize=4)
        rest = front.values[~front.best]
        axis.plot(rest[:, 1], rest[:, 0], "o", color=BEFORE, markerfacecolor="none", markersize=4)
        axis.set(xlabel=front.names[1], ylabel=front.names[0])
    return figure


def _motion(designed: Designed) -> Any:
    times = np.linspace(0.0, designed.period, POINTS)
    return dense_motion(designed.family, designed.found.x, times, designed.found.factor)


def _limits(designed: Designed, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the limits (n,) of position, velocity or acceleration; infinite without one."""
    for limit in designed.limits.constraints:
        if isinstance(limit, BoxLimit) and limit.order == order:
            return limit.lower, limit.upper
    none = np.full(designed.chain.n, np.inf)
    return -none, none


def write_design(designed: Designed, folder: Path) -> None:
    """Write the figures of a designed motion into its folder: motion, tool path, search, and front if any."""
    save(motion_figure(designed), folder / "plot_motion.png")
    save(path_figure(designed), folder / "plot_path.png")
    save(history_figure(designed), folder / "plot_history.png")
    if designed.front is not None and len(designed.front.values):
        save(front_figure(designed.front), folder / "plot_front.png")


def write_plan(planned: Planned, folder: Path) -> None:
    """Write the figures of a planned motion into its folder: motion and speed profile."""
    save(plan_figure(planned), folder / "plot_motion.png")
    save(profile_figure(planned), folder / "plot_profile.png")


def plan_figure(planned: Planned) -> Figure:
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


def profile_figure(planned: Planned) -> Figure:
    """Draw the speed along the path, and which limit is nearest to being reached."""
    with styled():
        figure, (above, below) = sheet(2, 1, WIDE, 3.6)
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
        below.legend(loc="lower center", ncols=3, fontsize=7)
    return figure
