"""One motion repeated under several loads: the stacked base regressor of all runs, with derivatives."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib.dynamics.base import BaseModel


@dataclass(frozen=True, eq=False)
class LoadCases(BaseModel):
    """Base model of a motion that is run once with each load.

    The regressor has (loads x rows per sample) rows and b base columns. The parameters of arm and payload are columns
    of one observation matrix, in which the runs with and without the payload are stacked (Kolyubin, Shiriaev & Jubien
    2019, section 6.2).

    Attributes:
        loads: for each run, the labels of the attached payloads; None: all payloads of the model.
    """

    loads: Sequence[Collection[str] | None] = (None,)

    @property
    def joint_of_row(self) -> np.ndarray:
        """Joint index, from 0, of each of the (loads x rows per sample) rows."""
        joints = np.arange(self.model.rows) % self.model.n
        return np.tile(joints, len(self.loads))

    @property
    def limited(self) -> np.ndarray:
        """Indices (loads, n) of the rows to which torque limits apply: the motor torques.

        In a model of joint torque sensors alone, they are the rows of the sensors.
        """
        last = np.arange(self.model.rows - self.model.n, self.model.rows)
        return self.model.rows * np.arange(len(self.loads))[:, None] + last

    @property
    def row_names(self) -> tuple[str, ...]:
        """Names of the rows: the joint, e.g. joint 1, followed by the load if there are several loads."""
        n = self.model.n
        joint_names = [f"joint {joint + 1}" for joint in range(n)] * (self.model.rows // n)
        if len(self.loads) == 1:
            return tuple(joint_names)
        names = []
        for load in self.loads:
            text = "all payloads"
            if load is not None:
                text = " + ".join(load) or "no payload"
            names += [f"{name} ({text})" for name in joint_names]
        return tuple(names)

    def of_rows(self, of_joints: np.ndarray, fill: float = np.inf) -> np.ndarray:
        """Return values of the n joints at the corresponding rows of `limited`, and `fill` at all other rows.

        Args:
            of_joints: (n,) one value per joint.
            fill: value of the rows without torque limit.
        """
        values = np.full(len(self.joint_of_row), fill)
        values[self.limited] = of_joints
        return values

    def regressor(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the stacked base regressor (N, loads x rows per sample, b); columns of absent payloads are zero.

        Args:
            q, v, a: (N, n) the motion [rad or m, and per s, per s²].
        """
        regressor = super().regressor(q, v, a)
        if self._plain:
            return regressor
        rows = self.model.rows
        of_load = regressor.transpose(2, 1, 0)
        columns = np.concatenate([of_load] * len(self.loads), axis=1)
        for k, absent in enumerate(self._absent):
            columns[absent, k * rows : (k + 1) * rows] = 0.0
        return columns.transpose(2, 1, 0)

    def regressor_gradient(
        self, q: np.ndarray, v: np.ndarray, a: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the gradients of Σ weights · regressor with respect to q, v and a, (N, n) each.

        Args:
            q, v, a: (N, n) the motion [rad or m, and per s, per s²].
            weights: (N, loads x rows per sample, b) weight of each regressor entry.
        """
        if self._plain:
            return super().regressor_gradient(q, v, a, weights)
        parts = np.split(weights.transpose(2, 1, 0), len(self.loads), axis=1)
        total = np.zeros_like(parts[0])
        for part, absent in zip(parts, self._absent):
            total = total + np.where(absent[:, None, None], 0.0, part)
        return super().regressor_gradient(q, v, a, np.transpose(total, (2, 1, 0)))

    def torque_gradient(
        self, q: np.ndarray, v: np.ndarray, a: np.ndarray, values: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the gradients of Σ weights · torques with respect to q, v and a, (N, n) each.

        Args:
            q, v, a: (N, n) the motion [rad or m, and per s, per s²].
            values: (b,) base parameters, which give the torques.
            weights: (N, loads x rows per sample) weight of each torque.
        """
        gradients = []
        for part, absent in zip(np.split(weights, len(self.loads), axis=1), self._absent):
            present_values = np.where(absent, 0.0, values)
            gradients.append(super().torque_gradient(q, v, a, present_values, part))
        by_q, by_v, by_a = (np.sum(by_load, axis=0) for by_load in zip(*gradients))
        return by_q, by_v, by_a

    def largest_torques(self, values: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the motor torques (N, n) of a motion, each under the load that gives the largest |torque|.

        Args:
            values: (b,) base parameters.
            q, v, a: (N, n) the motion [rad or m, and per s, per s²].
        """
        # (N, loads, n)
        torques = (self.regressor(q, v, a) @ values)[:, self.limited]
        largest = np.abs(torques).argmax(axis=1, keepdims=True)
        return np.take_along_axis(torques, largest, axis=1)[:, 0]

    @property
    def _plain(self) -> bool:
        """Whether there is a single load case, in which all payloads are attached."""
        return len(self.loads) == 1 and not self._absent[0].any()

    @cached_property
    def _absent(self) -> list[np.ndarray]:
        """For each load, the mask (b,) of the base columns of payloads that are not attached."""
        model = self.model
        drives = np.ones(model.p - model.inertial)
        absent = []
        for carried in self.loads:
            bodies = np.ones(model.inertial)
            if carried is not None:
                bodies = model.carried_columns(carried)
            present = np.append(bodies, drives)
            absent.append(present[self.base.kept] == 0.0)
        return absent
