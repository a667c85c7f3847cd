"""``trajectory.toml``, the coefficients of an exciting motion.

::

    robot = "lwr4plus"
    family = "fourier"               # q(t) = q0 + sum_k a_k sin(k w t) + b_k cos(k w t), w = 2 pi / period
    period = 20.0                    # [s]
    rate = 1000.0                    # of the controller [Hz]
    repeat = 5                       # periods that were written to run
    [[joint]]
    name = "joint_1"
    q0 = 0.1                         # [rad or m]
    a = [...]
    b = [...]

With ``family = "bspline"`` a joint has ``points``, control points of a periodic spline of ``degree`` on uniform knots.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib.errors import UsageError
from trajectories.bspline import bspline_family
from trajectories.errors import BadInput
from trajectories.fourier import evaluate

NAME = "trajectory.toml"


@dataclass(frozen=True, eq=False)
class Periodic:
    """A periodic motion by its coefficients: eq. 23 of Kolyubin et al. 2019, or control points.

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
        """Return q, v, a (N, n) at times [s]."""
        if self.kind == "fourier":
            q, v, a = (evaluate(self.coefficients, self.period, times, order) for order in range(3))
            return q, v, a
        family = bspline_family([len(c) for c in self.coefficients], self.period, degree=self.degree, rest=False)
        x = family.variables(self.coefficients)
        q, v, a = (family.evaluate(x, times, order) for order in range(3))
        return q, v, a


def table(motion: Periodic, robot: str) -> dict[str, Any]:
    """Return the content of ``trajectory.toml`` of a robot's motion."""
    fourier = motion.kind == "fourier"
    head: dict[str, Any] = {
        "robot": robot, "family": motion.kind, "period": motion.period, "rate": motion.rate, "repeat": motion.repeat,
        "note": "q(t) = q0 + sum_k a_k sin(k w t) + b_k cos(k w t), w = 2 pi / period; rad, m, s" if fourier
        else "periodic spline, uniform knots over the period; rad, m, s",
    }  # fmt: skip
    joints = []
    for name, c in zip(motion.joint_names, motion.coefficients):
        half = len(c) // 2
        own = {"q0": c[0], "a": c[1 : 1 + half], "b": c[1 + half :]} if fourier else {"points": c}
        joints.append({"name": name, **own})
    return head | ({} if fourier else {"degree": motion.degree}) | {"joint": joints}


def read(folder: Path) -> Periodic:
    """Read the motion of an excitation's folder.

    Raises:
        UsageError: where there is none, or it is damaged.
    """
    path = folder / NAME
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
        kind = str(table["family"])
        keys = {"fourier": ("q0", "a", "b"), "bspline": ("points",)}[kind]
        coefficients = tuple(
            np.concatenate([np.atleast_1d(np.asarray(joint[key], dtype=float)) for key in keys])
            for joint in table["joint"]
        )
        found = Periodic(
            tuple(str(joint["name"]) for joint in table["joint"]), float(table["period"]), float(table["rate"]),
            int(table.get("repeat", 1)), kind, coefficients, int(table.get("degree", 5)),
        )  # fmt: skip
        if not all(np.isfinite(c).all() for c in coefficients):
            raise ValueError("a coefficient is not finite")
        found.orders(np.zeros(1))
    except (FileNotFoundError, NotADirectoryError):
        raise UsageError(f"{folder} holds no {NAME}: give the folder that calib excite wrote") from None
    except (OSError, KeyError, TypeError, ValueError, BadInput) as error:
        raise UsageError(f"{path} is damaged ({error!r}): was it edited?") from error
    return found
