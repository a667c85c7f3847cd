"""One motion run under several loads: the rows of all runs as one base regressor, with derivatives."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib.dynamics.base import BaseModel


@dataclass(frozen=True, eq=False)
class LoadCases(BaseModel):
    """Base model of a motion that is run once with each load: rows (loads x rows per sample) and base columns (b,).

    Kolyubin, Shiriaev & Jubien (2019), section 6.2: the payload's parameters and the arm's stand in one observation
    matrix if the runs with and without the payload are stacked.

    Attributes:
        loads: payload labels of each run; None: all payloads of the model.
    """

    loads: Sequence[Collection[str] | None] = (None,)

    @property
    def joint_of_row(self) -> np.ndarray:
        """Joint of each row (loads x rows per sample,), from 0."""
        return np.tile(np.arange(self.model.rows) % self.model.n, len(self.loads))

    @property
    def limited(self) -> np.ndarray:
        """Rows that are motor torques (loads, n); of a model of joint torque sensors alone, the sensors' rows."""
        last = np.arange(self.model.rows - self.model.n, self.model.rows)
        return self.model.rows * np.arange(len(self.loads))[:, None] + last

    @property
    def row_names(self) -> tuple[str, ...]:
        """Names of the rows: joint 1, or joint 1 with its load if there are several."""
        names = [f"joint {j + 1}" for j in range(self.model.n)] * (self.model.rows // self.model.n)
        if len(self.loads) == 1:
            return tuple(names)
        words = ["all payloads" if one is None else " + ".join(one) or "no payload" for one in self.loads]
        return tuple(f"{name} ({load})" for load in words for name in names)

    def of_rows(self, of_joints: np.ndarray, others: float = np.inf) -> np.ndarray:
        """Return the values of the joints (n,) at the rows of `limited`, and `others` elsewhere."""
        result = np.full(len(self.joint_of_row), others)
        result[self.limited] = of_joints
        return result

    def regressor(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the stacked base regressor (N, loads x rows per sample, b); columns of absent payloads are zero."""
        one = super().regressor(q, v, a)
        if self._plain:
            return one
        columns, rows = np.concatenate([one.transpose(2, 1, 0)] * len(self.loads), axis=1), self.model.rows
        for k, absent in enumerate(self._absent):
            columns[absent, k * rows : (k + 1) * rows] = 0.0
        return columns.transpose(2, 1, 0)

    def regressor_gradient(
        self, q: np.ndarray, v: np.ndarray, a: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the derivatives of Σ weights · regressor by q, v, a, each (N, n); weights (N, all rows, b)."""
        if self._plain:
            return super().regressor_gradient(q, v, a, weights)
        parts = np.split(weights.transpose(2, 1, 0), len(self.loads), axis=1)
        columns = sum(np.where(absent[:, None, None], 0.0, part) for part, absent in zip(parts, self._absent))
        return super().regressor_gradient(q, v, a, np.transpose(columns, (2, 1, 0)))

    def torque_gradient(
        self, q: np.ndarray, v: np.ndarray, a: np.ndarray, values: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the derivatives of Σ weights · regressor values by q, v, a, each (N, n); weights (N, all rows)."""
        parts = zip(np.split(weights, len(self.loads), axis=1), self._absent)
        own = super().torque_gradient
        each = [own(q, v, a, np.where(absent, 0.0, values), part) for part, absent in parts]
        by_q, by_v, by_a = (np.sum(one, axis=0) for one in zip(*each))
        return by_q, by_v, by_a

    def largest_torques(self, values: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the motor torques (N, n) of base parameters (b,), each of the load under which it is largest."""
        torques = (self.regressor(q, v, a) @ values)[:, self.limited]  # (N, loads, n)
        largest = np.abs(torques).argmax(axis=1, keepdims=True)
        return np.take_along_axis(torques, largest, axis=1)[:, 0]

    @property
    def _plain(self) -> bool:
        return len(self.loads) == 1 and not self._absent[0].any()

    @cached_property
    def _absent(self) -> list[np.ndarray]:
        """Columns (b,) of each load whose payloads are absent."""
        model, result = self.model, []
        for carried in self.loads:
            present = np.ones(model.inertial) if carried is None else model.carried_columns(carried)
            result.append(np.append(present, np.ones(model.p - model.inertial))[self.base.kept] == 0.0)
        return result
