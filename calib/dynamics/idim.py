"""The inverse dynamic identification model (IDIM): torque rows as a linear function of all parameters.

    tau = W(q, v, a) · chi,    chi = [standard parameters of every body; drive terms]

`TorqueRows` defines which torques the rows are: those of the motors, of joint torque sensors, or both.
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

KEPT_LAST = {"revolute": (3, 8, 9), "prismatic": (0, 1, 2, 3, 4, 5)}
"""Parameters of a link that are regrouped where possible: YY MZ M; XX to ZZ, in frames with axis z."""


@dataclass(frozen=True, eq=False)
class IdentificationModel:
    """Inverse dynamic identification model of a serial robot: regressor of bodies and drives.

    Attributes:
        bodies: the robot's bodies, payloads included.
        terms: drive terms (motor inertia, friction, offsets, couplings).
        torque_rows: torque rows that the model explains.
    """

    bodies: Bodies
    terms: tuple[DriveTerm, ...] = ()
    torque_rows: TorqueRows = MOTOR

    def __post_init__(self) -> None:
        repeated = sorted(name for name, count in Counter(self.names).items() if count > 1)
        if repeated:
            raise CalibError(f"parameter '{repeated[0]}' occurs twice; remove one of its terms")
        for term in self.terms:
            for row, motion in term.acts:
                joints = [row, *(joint for joint, _ in motion)]
                if min(joints) < 0 or max(joints) >= self.n:
                    raise CalibError(
                        f"term '{term.name}' refers to a joint that does not exist; the robot has joints 1 to {self.n}"
                    )

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.bodies.n

    @property
    def prismatic(self) -> np.ndarray:
        """Mask (n,) of prismatic coordinates."""
        mask = np.zeros(self.n, dtype=bool)
        # Backwards: the first body that a coordinate moves decides, not a mimic joint's.
        for coordinate, kind in zip(self.bodies.coordinates[::-1], self.bodies.kinds[::-1]):
            if coordinate >= 0:
                mask[coordinate] = kind == PRISMATIC
        return mask

    @property
    def inertial(self) -> int:
        """Number of body parameters; they are the first columns, before the drive terms."""
        return 10 * self.bodies.count if self.torque_rows.has_bodies else 0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the p parameters."""
        term_names = [term.name for term in self.columns]
        return (*self.bodies.names[: self.inertial], *term_names)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the p parameters."""
        term_units = [term.unit for term in self.columns]
        return (*self.bodies.units[: self.inertial], *term_units)

    @property
    def columns(self) -> tuple[DriveTerm, ...]:
        """Drive terms that affect the model's torque rows."""
        sides = self.torque_rows.sides
        return tuple(term for term in self.terms if term.side in sides)

    @property
    def sides(self) -> tuple[str, ...]:
        """Kind of each of the p columns: ``bodies``, or the side ``link`` or ``motor`` of a drive term."""
        term_sides = [term.side for term in self.columns]
        return (*([BODIES] * self.inertial), *term_sides)

    @property
    def rows(self) -> int:
        """Number of torque rows per sample."""
        return self.torque_rows.count(self.n)

    @property
    def p(self) -> int:
        """Number of parameters."""
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
        """Return the regressor (N, rows, p), in the memory order (p, rows, N), so that stacking needs no copy.

        Args:
            q, v, a: (N, n) the motion [rad or m, and per s, per s²].
            load: (N, n) torques transmitted by the gears [N m or N]; None if no friction term depends on them.
            carried: labels of the payloads (fixed bodies) that are attached; None: all. Columns of absent payloads are
                zero.
            states: (s, N) states of friction with hysteresis, from `friction_states`; None: computed here, with q taken
                as one uninterrupted record.
            link: motion q, v, a (N, n) of the bodies, if joints deflect; None: that of the drives.

        Raises:
            CalibError: for a wrong shape, an unknown payload, or a missing load.
        """
        shape = (len(q), self.n)
        q = shaped(q, shape, "q")
        v = shaped(v, shape, "v")
        a = shaped(a, shape, "a")
        load_columns = None if load is None else shaped(load, q.shape, "load").T
        row_count = self.n * len(self.torque_rows.blocks)
        out = np.zeros((self.p, row_count, len(q)))
        if self.inertial:
            q_link, v_link, a_link = link or (q, v, a)
            rigid_body.fill_regressor(self.bodies, q_link, v_link, a_link, out[: self.inertial])
            self._drop_absent(out, carried)
        motions = _columns_of(q, v, a)
        if states is None:
            states = drives.friction_states(self.columns, motions[0])
        drives.fill(self.columns, out[self.inertial :], [*motions, load_columns], states)
        return self.torque_rows.observe_in_place(out, self.sides, q, v)

    def regressor_gradient(
        self, q: np.ndarray, v: np.ndarray, a: np.ndarray, weights: np.ndarray, columns: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the exact gradients of Σ weights · regressor(q, v, a) with respect to q, v and a, (N, n) each.

        All payloads are attached.

        Args:
            q, v, a: (N, n) the motion [rad or m, and per s, per s²].
            weights: (N, rows, c) weight of each regressor entry.
            columns: (c,) ascending indices of the regressor columns that the weights refer to; None: all p.

        Raises:
            CalibError: for a term that depends on past motion or on torques, or projected rows.
        """
        if columns is None:
            columns = np.arange(self.p)
        columns = np.asarray(columns)
        weights = shaped(weights, (len(q), self.rows, len(columns)), "weights of the regressor")
        sides = self.sides
        weights = self.torque_rows.fold(weights, [sides[column] for column in columns])
        body_count = int((columns < self.inertial).sum())
        gradients = np.zeros((3, *np.shape(q)))
        if body_count:
            body_weights = weights[:, :, :body_count]
            if body_count < self.inertial:
                all_weights = np.zeros((len(q), self.n, self.inertial))
                all_weights[:, :, columns[:body_count]] = body_weights
                body_weights = all_weights
            gradients[:] = rigid_body.regressor_gradient(self.bodies, q, v, a, body_weights)
        drive_terms = self.columns
        terms = [drive_terms[column - self.inertial] for column in columns[body_count:]]
        term_weights = weights[:, :, body_count:].transpose(2, 1, 0)
        by_q, by_v, by_a = gradients[0], gradients[1], gradients[2]
        motions = _columns_of(q, v, a)
        drives.slopes(terms, motions, term_weights, [by_q.T, by_v.T, by_a.T])
        return by_q, by_v, by_a

    def torque_gradient(
        self, q: np.ndarray, v: np.ndarray, a: np.ndarray, values: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the exact gradients of Σ weights · torques(q, v, a) with respect to q, v and a, (N, n) each.

        All payloads are attached.

        Args:
            q, v, a: (N, n) the motion [rad or m, and per s, per s²].
            values: (p,) parameter values, which give the torques.
            weights: (N, rows) weight of each torque.

        Raises:
            CalibError: for a term that depends on past motion or on torques, or projected rows.
        """
        side_weights = {}
        for side in set(self.sides):
            joint_weights = self.torque_rows.fold(weights[:, :, None], (side,))
            side_weights[side] = joint_weights[:, :, 0]
        gradients = np.zeros((3, *np.shape(q)))
        body_values = values[: self.inertial]
        if self.inertial and body_values.any():
            gradients[:] = rigid_body.torque_gradient(self.bodies, body_values, q, v, a, side_weights[BODIES])
        terms, term_weights = [], []
        for term, value in zip(self.columns, values[self.inertial :]):
            if value:
                terms.append(term)
                term_weights.append(value * side_weights[term.side].T)
        by_q, by_v, by_a = gradients[0], gradients[1], gradients[2]
        motions = _columns_of(q, v, a)
        drives.slopes(terms, motions, np.array(term_weights), [by_q.T, by_v.T, by_a.T])
        return by_q, by_v, by_a

    def acting(self) -> np.ndarray:
        """Return the mask (p, rows) of regressor entries that can differ from 0.

        A body's parameters affect the joints between base and body; most drive parameters affect one joint. So at most
        about half of all entries differ from 0.
        """
        if self.torque_rows.projection is not None:
            return np.ones((self.p, self.rows), dtype=bool)
        # What is zero at a random state is zero everywhere.
        random = np.random.default_rng(0)
        q, v, a = random.uniform(0.5, 1.5, (3, 4, self.n))
        entries = np.zeros((1, self.n, self.p))
        if self.inertial:
            regressor = rigid_body.regressor(self.bodies, q, v, a)
            entries[0, :, : self.inertial] = (regressor != 0.0).any(axis=0)
        for number, term in enumerate(self.columns):
            for row, _ in term.acts:
                entries[0, row, self.inertial + number] = 1.0
        return self.torque_rows.observe(entries, self.sides, q, v)[0].T != 0.0

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
        """Return the torques (N, rows) for parameters `values` (p,), by recursive Newton-Euler.

        For load-dependent friction, the load is the model's own torque of the bodies, which move as `link`.

        Args:
            values: (p,) parameter values.
            q, v, a: (N, n) the motion [rad or m, and per s, per s²].
            carried, states, link: as in `regressor`.
        """
        load, load_columns = None, None
        if self.inertial:
            q_link, v_link, a_link = link or (q, v, a)
            load = self.transmitted(values, q_link, v_link, a_link, carried)
            load_columns = load.T
        if states is None:
            states = drives.friction_states(self.columns, np.ascontiguousarray(q.T))

        # Torques of the joints by side; the bodies' first.
        torques = {BODIES: np.zeros(np.shape(q)) if load is None else load}
        motions = [q.T, v.T, a.T, load_columns]
        first = 0
        for term, value in zip(self.columns, values[self.inertial :]):
            if term.side not in torques:
                torques[term.side] = np.zeros(np.shape(q))
            state_count = len(term.acts) if term.form.remembers else 0
            term_states = states[first : first + state_count]
            for row, column in term.acting(motions, term_states):
                torques[term.side][:, row] += value * column
            first += state_count
        result = np.zeros((len(q), self.rows))
        for side, joint_torques in torques.items():
            rows = self.torque_rows.observe(joint_torques[:, :, None], (side,), q, v)
            result += rows[:, :, 0]
        return result

    def transmitted(
        self, values: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray, carried: Collection[str] | None = None
    ) -> np.ndarray:
        """Return the torques (N, n) [N m or N] that the gears transmit to the bodies, for load-dependent friction.

        Args:
            values: (p,) parameters.
            q, v, a: (N, n) motion of the bodies [rad or m, and per s, per s²].
            carried: labels of the attached payloads; None: all.
        """
        present = np.ones(self.inertial)
        if carried is not None:
            present = self.carried_columns(carried)
        parameters = np.array(values[: self.inertial]) * present
        return rigid_body.inverse_dynamics(self.bodies, parameters, q, v, a)

    def energy_columns(self, q: np.ndarray, v: np.ndarray, carried: Collection[str] | None = None) -> np.ndarray:
        """Return the energy (N, p) per unit of each parameter, whose time derivative is the power; zero for friction.

        The energies per unit of the bodies' parameters are computed by `rigid_body.energies`. The energy per unit of a
        motor inertia is ½ v², per unit of a coupled motor inertia v_i v_j.

        Args:
            q, v: (N, n) joint positions and velocities [rad or m, and per s].
            carried: labels of the attached payloads; None: all.
        """
        out = np.zeros((len(q), self.p))
        if self.inertial:
            out[:, : self.inertial] = rigid_body.energies(self.bodies, q, v)
            self._drop_absent(out.T, carried)
        drives.fill_energies(self.columns, out.T[self.inertial :], v.T)
        return out

    def carried_columns(self, carried: Collection[str]) -> np.ndarray:
        """Return factors (10 B,) of the body parameters: 0 for payloads not in `carried`, 1 for all other bodies."""
        present = []
        for label, kind in zip(self.bodies.labels, self.bodies.kinds):
            present.append(kind != FIXED or label in carried)
        return np.repeat(np.array(present, dtype=float), 10)

    def preference(self) -> np.ndarray:
        """Return the column indices (p,) in order of preference as base columns.

        First the columns of moving links that Khalil keeps, then the drive terms, the other columns of moving links,
        and the payloads.
        """
        bodies = self.bodies
        kept_first: list[int] = []
        kept_last: list[int] = []
        payloads: list[int] = []
        for body in range(self.inertial // 10):
            if bodies.kinds[body] == FIXED:
                payloads += range(10 * body, 10 * body + 10)
                continue
            kind = "prismatic" if bodies.kinds[body] == PRISMATIC else "revolute"
            for k in range(10):
                column = 10 * body + int(bodies.order[body, k])
                if k in KEPT_LAST[kind]:
                    kept_last.append(column)
                else:
                    kept_first.append(column)
        drive_columns = range(self.inertial, self.p)
        return np.array([*kept_first, *drive_columns, *kept_last, *payloads], dtype=int)

    def load_cases(self) -> Loads:
        """Return the load cases for choosing base columns: all payloads, and none.

        A model without payloads has a single case.
        """
        if self.inertial and np.any(self.bodies.kinds == FIXED):
            return (None, ())
        return (None,)

    def sample(
        self, count: int, rng: np.random.Generator, lower: np.ndarray | None = None, upper: np.ndarray | None = None
    ) -> States:
        """Return `count` random states: q uniform between its limits, v and a uniform within ±3 [per s, per s²].

        Args:
            count: number of states.
            rng: generator of the random numbers.
            lower, upper: (n,) limits of q [rad or m]; None: ±π.
        """
        if lower is None:
            lower = np.full(self.n, -np.pi)
        if upper is None:
            upper = np.full(self.n, np.pi)
        q = rng.uniform(lower, upper, (count, self.n))
        v, a, load = rng.uniform(-3.0, 3.0, (3, count, self.n))
        state_count = sum(len(term.acts) for term in self.columns if term.form.remembers)
        return States(q, v, a, load, rng.uniform(-1.0, 1.0, (state_count, count)))

    def _drop_absent(self, out: np.ndarray, carried: Collection[str] | None) -> None:
        """Set the rows of `out` (p, …) to zero that are columns of payloads not in `carried`; None: no change."""
        if carried is None:
            return
        payloads = set()
        for label, coordinate in zip(self.bodies.labels, self.bodies.coordinates):
            if coordinate < 0:
                payloads.add(label)
        unknown = sorted(set(carried) - payloads)
        if unknown:
            raise CalibError(f"no payload '{unknown[0]}' in the model; it has {', '.join(sorted(payloads)) or 'none'}")
        for label in payloads - set(carried):
            first = 10 * self.bodies.labels.index(label)
            out[first : first + 10] = 0.0

    def with_load(self) -> tuple[str, ...]:
        """Return the names of the drive terms that depend on the transmitted torque (`load`)."""
        return tuple(term.name for term in self.columns if term.form.loaded)

    def with_terms(self, *terms: DriveTerm) -> IdentificationModel:
        """Return the model with further drive terms appended."""
        return replace(self, terms=(*self.terms, *terms))


def _columns_of(q: np.ndarray, v: np.ndarray, a: np.ndarray) -> list[np.ndarray]:
    """Return q, v and a (N, n) transposed to (n, N), each joint's series contiguous in memory."""
    return [np.ascontiguousarray(np.asarray(series, dtype=float).T) for series in (q, v, a)]


def from_chain(
    chain: Chain,
    sets: str | Sequence[str] = "Ia Fv Fc off",
    payload: np.ndarray | None = None,
    rows: TorqueRows = MOTOR,
    v0: float | Sequence[float] = V0,
) -> IdentificationModel:
    """Return the identification model of a chain with standard drive terms.

    Args:
        chain: the robot.
        sets: names of standard drive terms (`drives.standard`), as one string for all joints or one string per joint.
        payload: (4, 4) pose of a payload's frame in the last body's frame (`Chain.tail` for the tip); None: no payload.
        rows: torque rows that the model explains.
        v0: smoothing of the Coulomb sign [rad/s or m/s], one value or one per joint.

    Raises:
        CalibError: for a wrong number of strings, or an unknown drive term.
    """
    joint_sets = [sets] * chain.n if isinstance(sets, str) else list(sets)
    if len(joint_sets) != chain.n:
        raise CalibError(f"robot '{chain.name}' has {chain.n} joints, but drive terms are given for {len(joint_sets)}")
    bodies = bodies_of(chain)
    if payload is not None:
        bodies = with_payload(bodies, payload)
    linear = [joint.kind == "prismatic" for joint in chain.joints]
    return IdentificationModel(bodies, drives.standard(joint_sets, v0, linear), rows)


def friction_states(model: RegressorModel, q: np.ndarray) -> np.ndarray:
    """Return the states (s, N) of a model's friction with hysteresis along an uninterrupted record q (N, n).

    States depend on past motion, so the record must not be cut into blocks. s is 0 without such friction.
    """
    q = shaped(q, (None, model.n), "q")
    return drives.friction_states(model.columns, np.ascontiguousarray(q.T))
