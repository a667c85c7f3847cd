"""The inverse dynamic identification model: torque rows as a linear function of all parameters.

    tau = W(q, v, a) · chi,    chi = [standard parameters of every body; drive terms]

Which torque rows those are, `TorqueRows` says.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.dynamics import drives, rigid_body
from calib.dynamics.bodies import FIXED, PRISMATIC, Bodies, bodies_of, with_payload
from calib.dynamics.drives import DriveTerm
from calib.dynamics.regressor_model import Loads, RegressorModel, States
from calib.dynamics.shapes import V0
from calib.dynamics.torque_rows import BODIES, MOTOR, TorqueRows
from calib.errors import CalibError
from calib.records import shaped
from calib.robot.chain import Chain

KEPT_LAST = {"revolute": (3, 8, 9), "prismatic": (0, 1, 2, 3, 4, 5)}  # YY MZ M; XX to ZZ, in frames with axis z


@dataclass(frozen=True, eq=False)
class IdentificationModel:
    """Regressor of bodies and drives.

    Attributes:
        bodies: of the robot.
        terms: the drives' terms.
        torque_rows: torque rows that the model explains.
    """

    bodies: Bodies
    terms: tuple[DriveTerm, ...] = ()
    torque_rows: TorqueRows = MOTOR

    def __post_init__(self) -> None:
        doubled = sorted(name for name, count in Counter(self.names).items() if count > 1)
        if doubled:
            raise CalibError(f"parameter '{doubled[0]}' occurs twice; remove one of its terms")
        for one in self.terms:
            for row, motion in one.acts:
                if not all(0 <= joint < self.n for joint in (row, *(j for j, _ in motion))):
                    raise CalibError(f"term '{one.name}' refers to a missing joint; the robot has {self.n}")

    @property
    def n(self) -> int:
        return self.bodies.n

    @property
    def prismatic(self) -> np.ndarray:
        """Mask (n,) of prismatic coordinates."""
        moved = {int(c): int(kind) for c, kind in zip(self.bodies.coordinates[::-1], self.bodies.kinds[::-1])}
        return np.array([moved.get(j) == PRISMATIC for j in range(self.n)], dtype=bool)

    @property
    def inertial(self) -> int:
        """Number of body parameters, the first columns."""
        return 10 * self.bodies.count if self.torque_rows.has_bodies else 0

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.bodies.names[: self.inertial], *(one.name for one in self.columns))

    @property
    def units(self) -> tuple[str, ...]:
        return (*self.bodies.units[: self.inertial], *(one.unit for one in self.columns))

    @property
    def columns(self) -> tuple[DriveTerm, ...]:
        """Drive terms that affect these torque rows."""
        seen = self.torque_rows.sides
        return tuple(one for one in self.terms if one.side in seen)

    @property
    def sides(self) -> tuple[str, ...]:
        """Side of each column (p,) for `TorqueRows`."""
        return (*(BODIES,) * self.inertial, *(one.side for one in self.columns))

    @property
    def rows(self) -> int:
        """Number of torque rows per sample."""
        return self.torque_rows.count(self.n)

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
        link: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
    ) -> np.ndarray:
        """Return the regressor (N, rows, p), in the memory order (p, rows, N), which stacks without a copy.

        Args:
            q, v, a: (N, n) [rad or m, and per s, per s²].
            load: (N, n) transmitted torques [N m or N], where a friction term depends on them.
            carried: labels of the fixed bodies (payloads) present; None for all. Columns of absent ones are zero.
            states: (s, N), of `friction_states`; None: computed, taking q for one uninterrupted record.
            link: q, v, a (N, n) of the bodies where joints deflect; None: those of the drives.
        """
        q, v, a = (shaped(x, (len(q), self.n), name) for x, name in ((q, "q"), (v, "v"), (a, "a")))
        loads = None if load is None else shaped(load, q.shape, "load").T
        out = np.zeros((self.p, self.n * len(self.torque_rows.blocks), len(q)))
        if self.inertial:
            moved = (q, v, a) if link is None else link
            rigid_body.fill_regressor(self.bodies, *moved, out[: self.inertial])
            self._drop_absent(out, carried)
        motions = [np.ascontiguousarray(x.T) for x in (q, v, a)]
        states = drives.friction_states(self.columns, motions[0]) if states is None else states
        drives.fill(self.columns, out[self.inertial :], [*motions, loads], states)
        return self.torque_rows.observe_in_place(out, self.sides, q, v)

    def regressor_gradient(
        self, q: np.ndarray, v: np.ndarray, a: np.ndarray, weights: np.ndarray, columns: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the exact gradients of Σ weights · regressor(q, v, a) for q, v and a, (N, n) each, with all payloads.

        Args:
            weights: (N, rows, c).
            columns: (c,) of the regressor, which the weights are of, rising; None: all p.
        """
        kept, sides = np.arange(self.p) if columns is None else np.asarray(columns), self.sides
        weights = shaped(weights, (len(q), self.rows, len(kept)), "weights of the regressor")
        weights, bodies = self.torque_rows.fold(weights, [sides[k] for k in kept]), int((kept < self.inertial).sum())
        out = np.zeros((3, *np.shape(q)))
        if bodies:
            inertial = weights[:, :, :bodies]
            if bodies < self.inertial:
                inertial = np.zeros((len(q), self.n, self.inertial))
                inertial[:, :, kept[:bodies]] = weights[:, :, :bodies]
            out[:] = rigid_body.regressor_gradient(self.bodies, q, v, a, inertial)
        motions = [np.ascontiguousarray(np.asarray(x, dtype=float).T) for x in (q, v, a)]
        offered = self.columns
        terms = [offered[k - self.inertial] for k in kept[bodies:]]
        drives.slopes(terms, motions, weights[:, :, bodies:].transpose(2, 1, 0), [out[0].T, out[1].T, out[2].T])
        return out[0], out[1], out[2]

    def torque_gradient(
        self, q: np.ndarray, v: np.ndarray, a: np.ndarray, values: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the gradients of Σ weights · (regressor values) for q, v and a, (N, n) each, with all payloads.

        Args:
            values: (p,) of the parameters.
            weights: (N, rows) of the torques.
        """
        out = np.zeros((3, *np.shape(q)))
        of_side = {side: self.torque_rows.fold(weights[:, :, None], (side,))[:, :, 0] for side in set(self.sides)}
        if self.inertial and values[: self.inertial].any():
            out[:] = rigid_body.torque_gradient(self.bodies, values[: self.inertial], q, v, a, of_side[BODIES])
        motions = [np.ascontiguousarray(np.asarray(x, dtype=float).T) for x in (q, v, a)]
        terms = [(one, value) for one, value in zip(self.columns, values[self.inertial :]) if value]
        share = np.array([value * of_side[one.side].T for one, value in terms])
        drives.slopes([one for one, _ in terms], motions, share, [out[0].T, out[1].T, out[2].T])
        return out[0], out[1], out[2]

    def acting(self) -> np.ndarray:
        """Return the mask (p, rows) of regressor entries that can differ from 0.

        A body's parameters reach the joints before it, a drive's its own: half of all entries, or less.
        """
        if self.torque_rows.projection is not None:
            return np.ones((self.p, self.rows), dtype=bool)
        entries = np.zeros((1, self.n, self.p))
        state = np.random.default_rng(0).uniform(0.5, 1.5, (3, 4, self.n))
        if self.inertial:  # what is zero at a random state is zero everywhere
            entries[0, :, : self.inertial] = (rigid_body.regressor(self.bodies, *state) != 0.0).any(axis=0)
        for k, one in enumerate(self.columns):
            entries[0, [row for row, _ in one.acts], self.inertial + k] = 1.0
        return self.torque_rows.observe(entries, self.sides, *state[:2])[0].T != 0.0

    def torque(
        self,
        values: np.ndarray,
        q: np.ndarray,
        v: np.ndarray,
        a: np.ndarray,
        carried: Collection[str] | None = None,
        states: np.ndarray | None = None,
        link: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
    ) -> np.ndarray:
        """Return the torques (N, rows) of parameters (p,), by recursive Newton-Euler.

        Friction that depends on the load feels the torque that the bodies, which move as `link`, need by the model.
        """
        moved = (q, v, a) if link is None else link
        load = self.transmitted(values, *moved, carried) if self.inertial else None
        states = drives.friction_states(self.columns, np.ascontiguousarray(q.T)) if states is None else states
        parts, state = {BODIES: np.zeros(np.shape(q)) if load is None else load}, 0
        motions = [q.T, v.T, a.T, None if load is None else load.T]
        for one, value in zip(self.columns, values[self.inertial :]):
            own, used = parts.setdefault(one.side, np.zeros(np.shape(q))), len(one.acts) if one.form.remembers else 0
            for row, column in one.acting(motions, states[state : state + used]):
                own[:, row] += value * column
            state += used
        result = np.zeros((len(q), self.rows))
        for side, own in parts.items():
            result += self.torque_rows.observe(own[:, :, None], (side,), q, v)[:, :, 0]
        return result

    def transmitted(
        self, values: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray, carried: Collection[str] | None = None
    ) -> np.ndarray:
        """Return the torques (N, n) transmitted by the gears to the bodies, for load-dependent friction."""
        present = np.ones(self.inertial) if carried is None else self.carried_columns(carried)
        bodies = np.array(values[: self.inertial]) * present
        return rigid_body.inverse_dynamics(self.bodies, bodies, q, v, a)

    def energy_columns(self, q: np.ndarray, v: np.ndarray, carried: Collection[str] | None = None) -> np.ndarray:
        """Return the energies h (N, p) per unit of each parameter, whose derivative is the power; zero for friction.

        Bodies' are those of `rigid_body.energies`, a motor's inertia has ½ v², coupled ones v_i v_j.
        """
        out = np.zeros((len(q), self.p))
        if self.inertial:
            out[:, : self.inertial] = rigid_body.energies(self.bodies, q, v)
            self._drop_absent(out.T, carried)
        drives.fill_energies(self.columns, out.T[self.inertial :], v.T)
        return out

    def carried_columns(self, carried: Collection[str]) -> np.ndarray:
        """Return factors (10 B,): one for parameters of bodies present, zero for those of absent payloads."""
        kinds = zip(self.bodies.labels, self.bodies.kinds)
        present = [kind != FIXED or label in carried for label, kind in kinds]
        return np.repeat(np.array(present, dtype=float), 10)

    def preference(self) -> np.ndarray:
        """Return the columns in order of preference: those Khalil keeps of moving links, drives, others, payloads."""
        bodies = self.bodies
        first: list[int] = []
        late: list[int] = []
        fixed: list[int] = []
        for i in range(self.inertial // 10):
            if bodies.kinds[i] == FIXED:
                fixed += range(10 * i, 10 * i + 10)
                continue
            last = KEPT_LAST["prismatic" if bodies.kinds[i] == PRISMATIC else "revolute"]
            for c in range(10):
                (late if c in last else first).append(10 * i + int(bodies.order[i, c]))
        return np.array([*first, *range(self.inertial, self.p), *late, *fixed], dtype=int)

    def load_cases(self) -> Loads:
        """Return the load cases: all payloads and none, or only one case without payloads in the model."""
        return (None, ()) if self.inertial and np.any(self.bodies.kinds == FIXED) else (None,)

    def sample(
        self, count: int, rng: np.random.Generator, lower: np.ndarray | None = None, upper: np.ndarray | None = None
    ) -> States:
        """Return random states: q uniform within its limits (default ±π), v, a uniform within ±3 per s and per s²."""
        low = np.full(self.n, -np.pi) if lower is None else lower
        q = rng.uniform(low, np.full(self.n, np.pi) if upper is None else upper, (count, self.n))
        v, a, load = rng.uniform(-3.0, 3.0, (3, count, self.n))
        remembering = sum(len(one.acts) for one in self.columns if one.form.remembers)
        return States(q, v, a, load, rng.uniform(-1.0, 1.0, (remembering, count)))

    def _drop_absent(self, out: np.ndarray, carried: Collection[str] | None) -> None:
        """Set the columns of absent payloads to zero."""
        if carried is None:
            return
        payloads = {label for label, c in zip(self.bodies.labels, self.bodies.coordinates) if c < 0}
        if unknown := sorted(set(carried) - payloads):
            raise CalibError(f"no payload '{unknown[0]}' in the model; it has {', '.join(sorted(payloads)) or 'none'}")
        for label in payloads - set(carried):
            index = self.bodies.labels.index(label)
            out[10 * index : 10 * index + 10] = 0.0

    def with_load(self) -> tuple[str, ...]:
        """Return the names of the terms that depend on `load`."""
        return tuple(one.name for one in self.columns if one.form.loaded)

    def with_terms(self, *terms: DriveTerm) -> IdentificationModel:
        """Return the model with more drive terms appended."""
        return replace(self, terms=(*self.terms, *terms))


def from_chain(
    chain: Chain,
    sets: str | Sequence[str] = "Ia Fv Fc off",
    payload: np.ndarray | None = None,
    rows: TorqueRows = MOTOR,
    v0: float | Sequence[float] = V0,
) -> IdentificationModel:
    """Return the model of a chain with the same drive terms on all joints, or one set per joint.

    Args:
        sets: names out of `drives.standard`, one string for all joints or n strings.
        payload: (4, 4) frame of a payload in the last body's frame (`Chain.tail` for the tip); None for none.
        v0: smoothing of the Coulomb sign [rad/s or m/s], one or per joint.
    """
    each = [sets] * chain.n if isinstance(sets, str) else list(sets)
    if len(each) != chain.n:
        raise CalibError(f"robot '{chain.name}' has {chain.n} joints, but drive terms are given for {len(each)}")
    bodies = bodies_of(chain)
    bodies = bodies if payload is None else with_payload(bodies, payload)
    linear = [joint.kind == "prismatic" for joint in chain.joints]
    return IdentificationModel(bodies, drives.standard(each, v0, linear), rows)


def friction_states(model: RegressorModel, q: np.ndarray) -> np.ndarray:
    """Return the states (s, N) of friction with hysteresis along a gap-free record q (N, n), not cut into blocks."""
    return drives.friction_states(model.columns, np.ascontiguousarray(shaped(q, (None, model.n), "q").T))
