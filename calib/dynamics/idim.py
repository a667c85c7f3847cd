"""The inverse dynamic identification model: torque rows as a linear function of all parameters.

    tau = W(q, v, a) · chi,    chi = [standard parameters of every body; drive terms]

With torque sensors in the joints (Kolyubin, Shiriaev, Jubien 2019, section 6.2) four kinds of rows exist:

    motor    tau                 bodies and all drive terms (a robot without such sensors)
    link     tau_l               Model 1: bodies and link-side terms
    both     [tau_l; tau]        Model 2: bodies and link-side terms in both, motor-side terms in the second half
    drive    tau - tau_l         Model 3: motor-side terms alone
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.arrays import shaped
from calib.dynamics import drives, rigid_body
from calib.dynamics.bodies import Bodies, bodies_of, with_payload
from calib.dynamics.drives import DriveTerm
from calib.dynamics.shapes import V0
from calib.errors import CalibError
from calib.robot.chain import Chain

KINDS = ("motor", "link", "both", "drive")
MODELS = {1: "link", 2: "both", 3: "drive"}  # as the 2019 paper numbers them


@dataclass(frozen=True, eq=False)
class IdentificationModel:
    """Bodies and drives as one regressor.

    Attributes:
        bodies: of the robot.
        terms: the drives' terms.
        kind: one of `KINDS`.
    """

    bodies: Bodies
    terms: tuple[DriveTerm, ...] = ()
    kind: str = "motor"

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise CalibError(f"model kind '{self.kind}' is none of {', '.join(KINDS)}")
        doubled = sorted({name for name in self.names if self.names.count(name) > 1})
        if doubled:
            raise CalibError(f"parameter '{doubled[0]}' occurs twice; remove one of its terms")
        for one in self.terms:
            for row, motion in one.acts:
                if not all(0 <= joint < self.bodies.n for joint in (row, *(j for j, _ in motion))):
                    raise CalibError(f"term '{one.name}' names a joint beyond the robot's {self.bodies.n}")

    @property
    def names(self) -> tuple[str, ...]:
        own = tuple(one.name for one in self.columns)
        return own if self.kind == "drive" else self.bodies.names + own

    @property
    def units(self) -> tuple[str, ...]:
        own = tuple(one.unit for one in self.columns)
        return own if self.kind == "drive" else self.bodies.units + own

    @property
    def columns(self) -> tuple[DriveTerm, ...]:
        """The terms this kind of rows can see."""
        hidden = {"link": "motor", "drive": "link"}.get(self.kind)
        return tuple(one for one in self.terms if one.side != hidden)

    @property
    def rows(self) -> int:
        """Torque rows per sample: n, or 2 n where sensors and motors are stacked."""
        return self.bodies.n * (2 if self.kind == "both" else 1)

    @property
    def p(self) -> int:
        return len(self.names)

    def regressor(
        self,
        q: np.ndarray,
        v: np.ndarray,
        a: np.ndarray,
        load: np.ndarray | None = None,
        carried: Collection[str] | None = None,
        states: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the regressor (N, rows, p); its memory is ordered (p, rows, N), so stacking copies nothing.

        Args:
            q, v, a: (N, n) [rad or m, and per s, per s²].
            load: (N, n) transmitted torques [N m or N], where a friction term depends on them.
            carried: labels of the fixed bodies (payloads) present; None for all. Columns of absent ones are zero.
            states: (s, N), of `friction_states`; None: computed, taking q for one uninterrupted record.
        """
        q, v, a = (shaped(x, (len(q), self.bodies.n), name) for x, name in ((q, "q"), (v, "v"), (a, "a")))
        loads = None if load is None else shaped(load, q.shape, "load").T
        n, first = self.bodies.n, 0 if self.kind == "drive" else 10 * self.bodies.count
        out = np.zeros((self.p, self.rows, len(q)))
        if first:
            rigid_body.fill_regressor(self.bodies, q, v, a, out[:first])
            self._drop_absent(out, carried)
        motions = [np.ascontiguousarray(x.T) for x in (q, v, a)]
        states = drives.friction_states(self.columns, motions[0]) if states is None else states
        if self.kind != "both":
            drives.fill(self.columns, out[first:], [*motions, loads], states)
            return out.transpose(2, 1, 0)
        drives.fill(self.columns, out[first:, n:], [*motions, loads], states)
        out[:first, n:] = out[:first, :n]
        for k, one in enumerate(self.columns):
            if one.side == "link":
                out[first + k, :n] = out[first + k, n:]
        return out.transpose(2, 1, 0)

    def regressor_gradient(
        self, q: np.ndarray, v: np.ndarray, a: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the slopes of Σ weights · regressor(q, v, a) by q, v and a, each (N, n), exactly; all bodies carried.

        Args:
            weights: (N, rows, p).
        """
        n, first = self.bodies.n, 0 if self.kind == "drive" else 10 * self.bodies.count
        weights = shaped(weights, (len(q), self.rows, self.p), "weights of the regressor")
        if self.kind == "both":
            linked = [True] * first + [one.side == "link" for one in self.columns]
            weights = weights[:, n:] + weights[:, :n] * np.array(linked, dtype=float)
        out = np.zeros((3, *np.shape(q)))
        if first:
            out[:] = rigid_body.regressor_gradient(self.bodies, q, v, a, weights[:, :, :first])
        motions = [np.ascontiguousarray(np.asarray(x, dtype=float).T) for x in (q, v, a)]
        drives.slopes(self.columns, motions, weights[:, :, first:].transpose(2, 1, 0), [out[0].T, out[1].T, out[2].T])
        return out[0], out[1], out[2]

    def _drop_absent(self, out: np.ndarray, carried: Collection[str] | None) -> None:
        """Zero the columns of fixed bodies that are not carried."""
        if carried is None:
            return
        payloads = {label for label, c in zip(self.bodies.labels, self.bodies.coordinates) if c < 0}
        if unknown := sorted(set(carried) - payloads):
            raise CalibError(f"no payload '{unknown[0]}' in the model; it has {', '.join(sorted(payloads)) or 'none'}")
        for label in payloads - set(carried):
            index = self.bodies.labels.index(label)
            out[10 * index : 10 * index + 10] = 0.0


def from_chain(
    chain: Chain,
    sets: str | Sequence[str] = "Ia Fv Fc off",
    payload: np.ndarray | None = None,
    kind: str = "motor",
    v0: float | Sequence[float] = V0,
) -> IdentificationModel:
    """Return the model of a chain with the same drive terms on every joint, or with a set per joint.

    Args:
        sets: names out of `drives.standard`, one string for all joints or n strings.
        payload: (4, 4) frame of a payload in the last body's frame (`Chain.tail` for the tip); None for none.
        v0: smoothing of the Coulomb sign [rad/s or m/s], one or per joint.
    """
    each = [sets] * chain.n if isinstance(sets, str) else list(sets)
    if len(each) != chain.n:
        raise CalibError(f"robot '{chain.name}' has {chain.n} joints, but drive sets are given for {len(each)}")
    bodies = bodies_of(chain)
    bodies = bodies if payload is None else with_payload(bodies, payload)
    linear = [joint.kind == "prismatic" for joint in chain.joints]
    return IdentificationModel(bodies, drives.standard(each, v0, linear), kind)


def friction_states(model: IdentificationModel, q: np.ndarray) -> np.ndarray:
    """Return the states (s, N) of friction with memory along one uninterrupted record q (N, n), to slice in blocks."""
    return drives.friction_states(model.columns, np.ascontiguousarray(shaped(q, (None, model.bodies.n), "q").T))


def with_terms(model: IdentificationModel, *terms: DriveTerm) -> IdentificationModel:
    """Return the model with more drive terms behind its own."""
    return replace(model, terms=(*model.terms, *terms))


def stacked(regressor: np.ndarray) -> np.ndarray:
    """Return the observation matrix (rows · N, p) of a regressor (N, rows, p): all samples of row 1, of row 2, ….

    Column-major without a copy for what `IdentificationModel.regressor` returns; torques stack as ``tau.T.ravel()``.
    """
    samples, rows, p = regressor.shape
    return regressor.transpose(2, 1, 0).reshape(p, rows * samples).T


def with_load(model: IdentificationModel) -> tuple[str, ...]:
    """Return the names of the terms that need `load`."""
    return tuple(one.name for one in model.columns if one.form.loaded)
