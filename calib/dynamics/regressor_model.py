"""Interface of models for identification: torques as a linear function of parameters, y = W(q, v, a) x.

A serial chain implements the interface (`calib.dynamics.idim.IdentificationModel`). Other models whose torques are
linear in their parameters can implement it, too: a closed chain reduced to its actuated coordinates, or a model of the
power alone. Properties that only a serial chain has (joint limits, CAD masses, another geometry) are passed to
identification separately.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from calib.dynamics.drives import DriveTerm
from calib.dynamics.torque_rows import TorqueRows

Loads = Sequence[Collection[str] | None]


@dataclass(frozen=True, eq=False)
class States:
    """Random or recorded states of the robot, at which regressor columns are compared.

    Attributes:
        q, v, a: (N, n) joint positions, velocities and accelerations [rad or m, and per s, per s²].
        load: (N, n) transmitted torques [N m or N], needed if friction depends on them; None otherwise.
        states: (s, N) friction states from `idim.friction_states`, needed if friction depends on past motion; None
            otherwise.
    """

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    load: np.ndarray | None = None
    states: np.ndarray | None = None


class RegressorModel(Protocol):
    """Interface of a model with n recorded coordinates and p parameters: body parameters, then drive parameters."""

    @property
    def n(self) -> int:
        """Number of coordinates of a recorded motion."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters (p,)."""
        ...

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the parameters (p,)."""
        ...

    @property
    def p(self) -> int: ...

    @property
    def inertial(self) -> int:
        """Number of body parameters, which precede the drive parameters."""
        ...

    @property
    def columns(self) -> tuple[DriveTerm, ...]:
        """Drive terms of the last (p - inertial) parameters."""
        ...

    @property
    def torque_rows(self) -> TorqueRows:
        """Torque rows that the model explains."""
        ...

    @property
    def rows(self) -> int:
        """Number of torque rows per sample."""
        ...

    def regressor(
        self,
        q: np.ndarray,
        v: np.ndarray,
        a: np.ndarray,
        load: np.ndarray | None = None,
        carried: Collection[str] | None = None,
        states: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the regressor W (N, rows, p) of a motion.

        Args:
            q, v, a: (N, n) the motion [rad or m, and per s, per s²].
            load, carried, states: as in `IdentificationModel.regressor`: transmitted torques, attached payloads and
                states of friction with hysteresis.
        """
        ...

    def torque(
        self,
        values: np.ndarray,
        q: np.ndarray,
        v: np.ndarray,
        a: np.ndarray,
        carried: Collection[str] | None = None,
        states: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the torques (N, rows) W · values for parameters `values` (p,), possibly by a faster algorithm.

        Args:
            values: (p,) parameter values.
            q, v, a: (N, n) the motion [rad or m, and per s, per s²].
            carried: labels of the attached payloads; None: all.
            states: states of friction with hysteresis, as in `regressor`.
        """
        ...

    def acting(self) -> np.ndarray:
        """Return the mask (p, rows) of regressor entries that can differ from 0."""
        ...

    def preference(self) -> np.ndarray:
        """Return the indices of all columns (p,) in order of preference as base columns."""
        ...

    def load_cases(self) -> Loads:
        """Return the load cases for choosing base columns, each in the form of the regressor's argument `carried`."""
        ...

    def sample(
        self, count: int, rng: np.random.Generator, lower: np.ndarray | None = None, upper: np.ndarray | None = None
    ) -> States:
        """Return `count` random states of the model.

        Args:
            count: number of states.
            rng: generator of the random numbers.
            lower, upper: (n,) limits of the coordinates [rad or m]; None: default limits.
        """
        ...
