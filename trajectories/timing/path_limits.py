"""Dynamics and limits (velocity, acceleration, torque) for the timing of a path."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..errors import BadInput


class Law(Protocol):
    """Interface of a robot's dynamics along a path, implemented by `calib.dynamics.path_dynamics.PathDynamics`.

    Arrays are (N, n).
    """

    def along(
        self, q: np.ndarray, slope: np.ndarray, curvature: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]: ...
    def friction(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray: ...
    def torque(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True, eq=False)
class TimingLimits:
    """Limits (n,) on the absolute values of velocity, acceleration and torque, each above zero; infinite for no limit.

    Attributes:
        velocity: [rad/s or m/s].
        acceleration: [rad/s² or m/s²].
        torque: [N m or N].

    Raises:
        BadInput: a limit that is not above zero, or not one per joint.
    """

    velocity: np.ndarray
    acceleration: np.ndarray
    torque: np.ndarray

    def __post_init__(self) -> None:
        for name in ("velocity", "acceleration", "torque"):
            values = np.asarray(getattr(self, name), dtype=float)
            if values.shape != np.shape(self.velocity) or values.ndim != 1:
                raise BadInput(f"{name} limits: expected one per joint, found shape {values.shape}")
            if not (values > 0).all():
                below_if_nan = np.where(np.isnan(values), -np.inf, values)
                j = int(np.argmin(below_if_nan))
                raise BadInput(f"{name} limit of joint {j + 1} is {values[j]:g}: it must be above zero")
            object.__setattr__(self, name, values)
