"""Reference motions sampled at the controller's rate."""

from dataclasses import dataclass

import numpy as np

from calib.errors import CalibError
from calib.records import frozen, shaped


@dataclass(frozen=True, eq=False)
class Reference:
    """A reference motion at N equally spaced times.

    Attributes:
        t: (N,) times [s].
        q, v, a: (N, n) [rad or m, and per s, per s²].
    """

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "t", frozen(self.t))
        for name in ("q", "v", "a"):
            object.__setattr__(self, name, frozen(shaped(getattr(self, name), np.shape(self.q), name)))
        if len(self.t) != len(self.q) or len(self.t) < 2:
            raise CalibError(
                f"a reference needs at least two times, one per position; found {len(self.t)}, {len(self.q)}"
            )

    @property
    def period(self) -> float:
        """The control period [s]."""
        return float(self.t[-1] - self.t[0]) / (len(self.t) - 1)

    def at(self, tick: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return q, v, a (M, n) at control periods `tick` (M,), interpolated by cubic splines between integers."""
        whole = tick.astype(int)
        if np.all(tick == whole):
            return self.q[whole], self.v[whole], self.a[whole]
        from scipy.interpolate import CubicSpline

        q, v, a = (CubicSpline(np.arange(len(self.t)), x)(tick) for x in (self.q, self.v, self.a))
        return q, v, a
