"""What identification needs of a model: torques as a linear function of parameters, W(q, v, a) x = y.

A serial chain meets it (`calib.dynamics.idim.IdentificationModel`), and so may anything whose torques are linear in its
parameters: a closed chain reduced to its actuated coordinates, a model of the power alone. What only a serial chain
knows (limits of its joints, masses of its CAD, another geometry) goes to identification beside it.
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
    """States over which columns are compared, random or recorded.

    Attributes:
        q, v, a: (N, n) [rad or m, and per s, per s²].
        load: (N, n) transmitted torques, where a friction term depends on them.
        states: (s, N) of `idim.friction_states`, where a friction term remembers.
    """

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    load: np.ndarray | None = None
    states: np.ndarray | None = None


class RegressorModel(Protocol):
    """A model of n recorded coordinates and p parameters, those of bodies first, then those of drive terms."""

    @property
    def n(self) -> int:
        """Coordinates of a recorded motion."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """(p,) of the parameters."""
        ...

    @property
    def units(self) -> tuple[str, ...]:
        """(p,) of the parameters."""
        ...

    @property
    def p(self) -> int: ...

    @property
    def inertial(self) -> int:
        """How many of the parameters are bodies'."""
        ...

    @property
    def columns(self) -> tuple[DriveTerm, ...]:
        """(p - inertial,) the drive terms behind the other parameters."""
        ...

    @property
    def torque_rows(self) -> TorqueRows:
        """Which measured torques it explains."""
        ...

    @property
    def rows(self) -> int:
        """Torque rows per sample."""
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
        """Return W (N, rows, p) at q, v, a (N, n); further arguments as of `IdentificationModel.regressor`."""
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
        """Return the torques (N, rows) of parameters (p,): W · values, or faster."""
        ...

    def acting(self) -> np.ndarray:
        """Return which entries of the regressor can differ from 0, (p, rows) bool."""
        ...

    def preference(self) -> np.ndarray:
        """Return all columns (p,) in the order in which they are tried as base columns."""
        ...

    def load_cases(self) -> Loads:
        """Return the load cases to choose base columns over, each as `carried` of the regressor."""
        ...

    def sample(
        self, count: int, rng: np.random.Generator, lower: np.ndarray | None = None, upper: np.ndarray | None = None
    ) -> States:
        """Draw `count` states that the model can be in, within limits (n,) of its coordinates where there are any."""
        ...
