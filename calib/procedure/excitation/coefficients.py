"""``trajectory.toml``, the coefficients of an exciting motion.

::

    robot = "lwr4plus"
    family = "fourier"               # q(t) = q0 + sum_k a_k sin(k w t) + b_k cos(k w t), w = 2 pi / period
    period = 20.0                    # [s]
    rate = 1000.0                    # of the controller [Hz]
    repeat = 5                       # periods that were written to run
limits = ["velocity limits: joint_1 1.92 rad/s (robot description)", ...]
    [[joint]]
    name = "joint_1"
    q0 = 0.1                         # [rad or m]
    a = [...]
    b = [...]

With ``family = "bspline"`` a joint has ``points``, control points of a periodic spline of ``degree`` on uniform knots.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import MinLen

from calib.config import parse, read_toml
from calib.config_types import Expect, Name, OneOf, Positive, Real, Whole
from calib.errors import UsageError, require
from trajectories.bspline import bspline_family
from trajectories.errors import BadInput
from trajectories.fourier import evaluate

NAME = "trajectory.toml"
SAMPLES, RUN, PLANNED = "trajectory.csv", "run.csv", "motion.csv"
"""Files of setpoints: one period at the controller's rate, the whole run if it is longer, and a planned motion."""


Numbers = Annotated[tuple[float, ...], Expect("a list of finite numbers")]


@dataclass(frozen=True)
class _JointTable:
    """Entry ``[[joint]]`` of ``trajectory.toml``: a joint's coefficients, see the module."""

    name: Name
    q0: Annotated[float, Real()] | None = None
    a: Numbers | None = None
    b: Numbers | None = None
    points: Numbers | None = None


@dataclass(frozen=True)
class TrajectoryFile:
    """The content of ``trajectory.toml``; other keys are ignored."""

    family: Annotated[str, OneOf(("fourier", "bspline"))]
    period: Positive
    rate: Positive
    joint: Annotated[tuple[_JointTable, ...], MinLen(1)]
    repeat: Annotated[int, Whole(1)] = 1
    degree: Annotated[int, Whole(1, 20)] = 5


@dataclass(frozen=True, eq=False)
class Periodic:
    """A periodic motion, defined by its coefficients: eq. 23 of Kolyubin et al. 2019, or control points.

    Attributes:
        joint_names: n names.
        period: [s]; rate: of the controller [Hz]; repeat: periods that were to be run.
        kind: of the family; coefficients: per joint; degree: of splines.
    """

    joint_names: tuple[str, ...]
    period: float
    rate: float
    repeat: int
    kind: str
    coefficients: tuple[np.ndarray, ...]
    degree: int = 5

    def orders(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions, velocities and accelerations q, v, a (N, n) at times [s]."""
        if self.kind == "fourier":
            q, v, a = (evaluate(self.coefficients, self.period, times, order) for order in range(3))
            return q, v, a
        family = bspline_family([len(c) for c in self.coefficients], self.period, degree=self.degree, rest=False)
        x = family.variables(self.coefficients)
        q, v, a = (family.evaluate(x, times, order) for order in range(3))
        return q, v, a


def table(motion: Periodic, robot: str, limits: Sequence[str]) -> dict[str, Any]:
    """Return the content of ``trajectory.toml`` for a motion; `limits` are lines on the limits it respects."""
    fourier = motion.kind == "fourier"
    head: dict[str, Any] = {
        "robot": robot, "family": motion.kind, "period": motion.period, "rate": motion.rate, "repeat": motion.repeat,
        "note": "q(t) = q0 + sum_k a_k sin(k w t) + b_k cos(k w t), w = 2 pi / period; rad, m, s" if fourier
        else "periodic spline, uniform knots over the period; rad, m, s", "limits": list(limits),
    }  # fmt: skip
    joints = []
    for name, c in zip(motion.joint_names, motion.coefficients):
        half = len(c) // 2
        own = {"q0": c[0], "a": c[1 : 1 + half], "b": c[1 + half :]} if fourier else {"points": c}
        joints.append({"name": name, **own})
    return head | ({} if fourier else {"degree": motion.degree}) | {"joint": joints}


def read(folder: Path) -> Periodic:
    """Read the motion from the folder of `calib excite`.

    Raises:
        UsageError: if the file is missing or damaged.
    """
    path = folder / NAME
    require(path.is_file(), f"{folder} has no {NAME}: give the folder that calib excite wrote", UsageError)
    table = parse(TrajectoryFile, read_toml(path), str(path))
    coefficients = []
    for number, joint in enumerate(table.joint, 1):
        place = f"{path}: [[joint]] number {number}"
        stated = (joint.points,) if table.family == "bspline" else ((joint.q0,), joint.a, joint.b)
        own = [part for part in stated if part is not None and None not in part]
        if len(own) < len(stated):
            raise UsageError(f"{place}: family {table.family} needs {'points' if len(stated) == 1 else 'q0, a and b'}")
        if len(own) == 3 and not len(own[1]) == len(own[2]) == len(table.joint[0].a or ()):
            raise UsageError(f"{place}: a and b need {len(table.joint[0].a or ())} values each, as many as joint 1's a")
        coefficients.append(np.concatenate([np.array(part, dtype=float) for part in own]))
    found = Periodic(
        tuple(joint.name for joint in table.joint), table.period, table.rate, table.repeat, table.family,
        tuple(coefficients), table.degree,
    )  # fmt: skip
    try:
        found.orders(np.zeros(1))
    except (ValueError, IndexError, BadInput) as error:
        raise UsageError(f"{path} is damaged ({error}): was it edited?") from error
    return found
