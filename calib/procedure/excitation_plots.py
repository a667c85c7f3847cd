"""Pictures of an exciting motion: q, v, a, τ with their limits, the tool's path, the search, and the front."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from calib.procedure.drawing import AFTER, BEFORE, HALF, MARK, QUIET, WIDE, motion_sheet, motion_units, sheet, styled
from calib.procedure.exciting import Designed
from calib.robot.kinematics import sweep
from trajectories.constraints import BoxLimit
from trajectories.pareto import Front
from trajectories.verify import dense_motion

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
