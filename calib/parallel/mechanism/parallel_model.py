"""The identification model of a parallel robot, with rows for platform coordinates, actuators or power.

    platform   J_p^invᵀ τ = W χ      one row per freedom; unique, also with redundant actuators (eqs 24-28)
    motor      τ = W χ               one row per actuator, where there are as many as freedoms (eq. 14)
    power      q̇ᵀ τ = vᵀ W χ         one row

    W = [J_tᵀ W_legs, Dᵀ W_platform, J_tᵀ W_drives]

(Briot, Gautier & Krut 2013.) Bodies are numbered as there: joint j of leg k is jk, the platform comes after the legs'
last joints, payloads on it after that. χ: ten standard parameters of each body, then the drives' terms.
`PlatformRegressor` has the same rows as functions of platform coordinates x(t), with gradients for motion design.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib.dynamics import drives, rigid_body
from calib.dynamics.bodies import PAIRS, PRISMATIC, STANDARD, UNITS, Bodies, bodies_of
from calib.dynamics.drives import DriveTerm
from calib.dynamics.idim import KEPT_LAST
from calib.dynamics.regressor_model import Loads, States
from calib.dynamics.shapes import V0
from calib.dynamics.torque_rows import MOTOR, POWER, Projection, TorqueRows, projected
from calib.errors import CalibError, UsageError, require
from calib.parallel.mechanism.closure import ClosedRobot, Posture
from calib.parallel.mechanism.parallel_robot import COORDINATES, FORCES
from calib.parallel.mechanism.velocities import LoopMotion, cross, distributed, loop_jacobians, of_platform, of_readings


def wrench_regressor(pose: np.ndarray, twist: np.ndarray, change: np.ndarray, gravity: np.ndarray) -> np.ndarray:
    """Return the regressor (N, 6, 10) of force and moment at the platform's origin, in the base's axes.

    Args:
        pose: (N, 4, 4) of the platform.
        twist, change: (N, 6) velocity of its origin and angular velocity, and their derivatives.
        gravity: (3,) [m/s²].
    """
    R = pose[:, :3, :3]
    # acceleration, angular velocity and its derivative in the platform's axes
    a = np.einsum("nji,nj->ni", R, change[:, :3] - gravity)
    w = np.einsum("nji,nj->ni", R, twist[:, 3:])
    b = np.einsum("nji,nj->ni", R, change[:, 3:])
    regressor = np.zeros((len(R), 6, 10))
    spin = _skew(w)
    regressor[:, :3, 9] = a
    regressor[:, :3, 6:9] = _skew(b) + spin @ spin
    regressor[:, 3:, 6:9] = -_skew(a)
    regressor[:, 3:, :6] = _inertia_columns(b) + spin @ _inertia_columns(w)
    return np.concatenate([R @ regressor[:, :3], R @ regressor[:, 3:]], axis=1)


def energy_columns(pose: np.ndarray, twist: np.ndarray, gravity: np.ndarray) -> np.ndarray:
    """Return kinetic and potential energy (N, 10) per unit of each standard parameter; see `wrench_regressor`."""
    R = pose[:, :3, :3]
    u = np.einsum("nji,nj->ni", R, twist[:, :3])
    w = np.einsum("nji,nj->ni", R, twist[:, 3:])
    result = np.empty((len(R), 10))
    result[:, :6] = 0.5 * np.einsum("ni,nik->nk", w, _inertia_columns(w))
    down = np.einsum("nji,j->ni", R, gravity)
    # u · (w × s) = s · (u × w)
    result[:, 6:9] = cross(u, w) - down
    result[:, 9] = 0.5 * np.sum(u**2, axis=1) - pose[:, :3, 3] @ gravity
    return result


def _skew(x: np.ndarray) -> np.ndarray:
    result = np.zeros((len(x), 3, 3))
    result[:, [2, 0, 1], [1, 2, 0]] = x
    result[:, [1, 2, 0], [2, 0, 1]] = -x
    return result


def _inertia_columns(w: np.ndarray) -> np.ndarray:
    """Return I w as columns (N, 3, 6) of XX XY XZ YY YZ ZZ."""
    result = np.zeros((len(w), 3, 6))
    for k, (i, j) in enumerate(PAIRS):
        result[:, i, k] += w[:, j]
        if i != j:
            result[:, j, k] += w[:, i]
    return result


# of random states: m/s or rad/s, and per s (as `IdentificationModel.sample`)
RATE = 3.0


@dataclass(frozen=True, eq=False)
class ParallelModel:
    """Legs, platform, payloads and drives as one regressor; a `calib.dynamics.regressor_model.RegressorModel`.

    Attributes:
        mechanism: the robot, its loops closed.
        terms: drive terms; their joint indices refer to the tree.
        torque_rows: ``platform``, ``motor`` or ``power`` rows (`rows_named`).
        payloads: labels of bodies that the platform may carry.
        identical_legs: whether all legs have common inertial parameters and motor inertias, named after the first leg.
            Friction and offsets differ by joint.
        preload: (n - r,) mean overconstraint of redundant actuators (`velocities.overconstraint`) [N m or N]; (): 0.
    """

    mechanism: ClosedRobot
    terms: tuple[DriveTerm, ...]
    torque_rows: TorqueRows
    payloads: tuple[str, ...] = ()
    identical_legs: bool = False
    preload: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        legs = self.mechanism.robot.legs
        if self.identical_legs:
            kinds = [joint.kind for joint in legs[0].chain.joints]
            for leg in legs:
                leg_kinds = [joint.kind for joint in leg.chain.joints]
                if leg.bodies != legs[0].bodies or leg_kinds != kinds:
                    raise UsageError(f"identical_legs: {leg.name} is built unlike {legs[0].name}")
        doubled = sorted({name for name in self.names if self.names.count(name) > 1})
        if doubled:
            raise CalibError(f"parameter '{doubled[0]}' occurs twice; give the payload or term another name")

    @property
    def n(self) -> int:
        """Number of actuated joints, whose motion is recorded."""
        return self.mechanism.robot.n

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """Labels of the bodies: the legs', the platform's, the payloads'."""
        robot = self.mechanism.robot
        labels: list[str] = []
        for leg, start in zip(robot.legs, robot.starts):
            labels += robot.labels[start : start + leg.bodies]
        return (*labels, robot.platform_label, *self.payloads)

    @cached_property
    def single(self) -> ParallelModel:
        """The model in which each leg has parameters of its own."""
        if self.identical_legs:
            return replace(self, identical_legs=False)
        return self

    @cached_property
    def _first(self) -> np.ndarray:
        """For each parameter of `single` (p_1,), the index of the parameter that represents it: itself, or the first
        leg's.
        """
        first = np.arange(self._bodies + len(self.terms))
        if self.identical_legs:
            size = self.legs[0][2].stop
            starts = self.mechanism.robot.starts
            first[: size * len(self.legs)] %= size
            motors = {}
            for k, term in enumerate(self.terms, self._bodies):
                if term.name.startswith("Ia") and term.joint is not None:
                    motors[term.joint] = k
            for joint, k in motors.items():
                first[k] = motors.get(joint % int(starts[1]), k)
        return first

    @cached_property
    def _kept(self) -> np.ndarray:
        """Indices (p,) in `single` of the parameters of this model."""
        return np.unique(self._first)

    @cached_property
    def owners(self) -> np.ndarray:
        """For each parameter of `single` (p_1,), the index of the corresponding parameter in this model."""
        return np.unique(self._first, return_inverse=True)[1]

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Return the parameters of `single` (p_1,) from the parameters (p,) of this model."""
        return np.asarray(values, dtype=float)[self.owners]

    def _merged(self, columns: np.ndarray) -> np.ndarray:
        """Return the columns (p, …) of this model's parameters from those of `single` (p_1, …)."""
        if not self.identical_legs:
            return columns
        result = np.zeros((self.p, *columns.shape[1:]))
        for owner, column in zip(self.owners, columns):
            result[owner] += column
        return result

    def _chosen(self, entries: Sequence[Any]) -> tuple[Any, ...]:
        return tuple(entries[k] for k in self._kept)

    @property
    def _bodies(self) -> int:
        """Number of the bodies' parameters in `single`."""
        return 10 * len(self.labels)

    @property
    def inertial(self) -> int:
        return int(np.searchsorted(self._kept, self._bodies))

    @property
    def names(self) -> tuple[str, ...]:
        return self._names

    @cached_property
    def _names(self) -> tuple[str, ...]:
        bodies = (name + label for label in self.labels for name in STANDARD)
        return self._chosen((*bodies, *(term.name for term in self.terms)))

    @property
    def units(self) -> tuple[str, ...]:
        return self._chosen((*UNITS * len(self.labels), *(term.unit for term in self.terms)))

    @property
    def p(self) -> int:
        return len(self.names)

    @property
    def columns(self) -> tuple[DriveTerm, ...]:
        return self._columns

    @cached_property
    def _columns(self) -> tuple[DriveTerm, ...]:
        return self._chosen((*[None] * self._bodies, *self.terms))[self.inertial :]

    @property
    def rows(self) -> int:
        return self.torque_rows.count(self.n)

    @cached_property
    def legs(self) -> tuple[tuple[Bodies, slice, slice], ...]:
        """For each leg: its bodies, its joints' indices in the tree, and its bodies' columns."""
        robot = self.mechanism.robot
        ends = 10 * np.cumsum([0, *(leg.bodies for leg in robot.legs)])
        legs = []
        for k, leg in enumerate(robot.legs):
            joints = slice(*robot.starts[k : k + 2])
            columns = slice(*ends[k : k + 2])
            legs.append((bodies_of(leg.chain), joints, columns))
        return tuple(legs)

    def regressor(
        self,
        q: np.ndarray,
        v: np.ndarray,
        a: np.ndarray,
        load: np.ndarray | None = None,
        carried: Collection[str] | None = None,
        states: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return W (N, rows, p) at the encoders' q, v, a (N, n); other arguments as `IdentificationModel.regressor`."""
        return self.along(self.moved(q, v, a), carried)

    def along(self, motion: LoopMotion, carried: Collection[str] | None = None) -> np.ndarray:
        """Return W (N, rows, p) along a motion of the whole robot."""
        return self.on_rows(self.platform_regressor(motion, carried), motion)

    def torque(
        self,
        values: np.ndarray,
        q: np.ndarray,
        v: np.ndarray,
        a: np.ndarray,
        carried: Collection[str] | None = None,
        states: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the torques, forces or power (N, rows) for parameters (p,), computed without the regressor."""
        motion = self.moved(q, v, a)
        force = self.platform_force(values, motion, carried)
        return self.on_rows(force[:, :, None], motion)[:, :, 0]

    def moved(self, q: np.ndarray, v: np.ndarray, a: np.ndarray, start: Posture | None = None) -> LoopMotion:
        """Return the whole robot's motion from the encoders' q, v, a (N, n); `start`: postures near the new ones."""
        posture = self.mechanism.locate(q, start)
        v = np.asarray(v, dtype=float)
        a = np.asarray(a, dtype=float)
        return of_readings(self.mechanism, posture, v, a)

    def platform_regressor(self, motion: LoopMotion, carried: Collection[str] | None = None) -> np.ndarray:
        """Return the regressor W (N, r, p) in platform coordinates, stored in the order (p, r, N)."""
        robot = self.mechanism.robot
        J = motion.jacobians
        out = np.zeros((self._bodies + len(self.terms), robot.r, len(motion.v)))
        for bodies, joints, columns in self.legs:
            q, v, a = motion.posture.q[:, joints], motion.v[:, joints], motion.a[:, joints]
            W = rigid_body.regressor(bodies, q, v, a)
            W = W[:, :, : columns.stop - columns.start]
            out[columns] = np.einsum("njr,njc->crn", J.joints[:, joints], W, optimize=True)
        platform = wrench_regressor(motion.posture.pose, motion.twist, motion.change, robot.gravity)
        on_coordinates = J.platform.transpose(0, 2, 1) @ platform
        self._fill_platform(out, on_coordinates.transpose(2, 1, 0), carried)
        motions = [motion.posture.q.T, motion.v.T, motion.a.T, None]
        for k, term in enumerate(self.terms):
            for joint, column in term.acting(motions, np.zeros((0, len(motion.v)))):
                out[self._bodies + k] += J.joints[:, joint].T * column
        return self._merged(out).transpose(2, 1, 0)

    def platform_force(
        self, values: np.ndarray, motion: LoopMotion, carried: Collection[str] | None = None
    ) -> np.ndarray:
        """Return the forces and moments (N, r) in platform coordinates for parameters (p,)."""
        robot = self.mechanism.robot
        J = motion.jacobians
        tree = self.tree_torque(values, motion)
        fixed = self.platform_parameters(values, carried)
        regressor = wrench_regressor(motion.posture.pose, motion.twist, motion.change, robot.gravity)
        wrench = regressor @ fixed
        of_tree = np.einsum("ntr,nt->nr", J.joints, tree)
        of_platform = np.einsum("nkr,nk->nr", J.platform, wrench)
        return of_tree + of_platform

    def actuator_torques(
        self, values: np.ndarray, motion: LoopMotion, carried: Collection[str] | None = None
    ) -> np.ndarray:
        """Return the torques (N, n) of the actuators for parameters (p,): of redundant ones with the preload."""
        forces = self.platform_force(values, motion, carried)
        return distributed(self.mechanism, motion.jacobians, forces, np.array(self.preload or [0.0]))

    def tree_torque(self, values: np.ndarray, motion: LoopMotion) -> np.ndarray:
        """Return the torques (N, n_t) of the opened legs with their drives, without the platform."""
        q = motion.posture.q
        v = motion.v
        a = motion.a
        torques = []
        for (bodies, joints, _), parameters in zip(self.legs, self.leg_parameters(values)):
            states = q[:, joints], v[:, joints], a[:, joints]
            torques.append(rigid_body.inverse_dynamics(bodies, parameters, *states))
        result = np.concatenate(torques, axis=1)
        no_payloads = np.zeros((0, len(result)))
        for term, value in zip(self.terms, self.spread(values)[self._bodies :]):
            for joint, column in term.acting([q.T, v.T, a.T, None], no_payloads):
                result[:, joint] += value * column
        return result

    def leg_parameters(self, values: np.ndarray) -> list[np.ndarray]:
        """Return the parameters of each leg's bodies; those of a last link that is the platform are zero."""
        standard = self.spread(values)
        parameters = []
        for bodies, _, columns in self.legs:
            leg_values = np.zeros(10 * bodies.count)
            leg_values[: columns.stop - columns.start] = standard[columns]
            parameters.append(leg_values)
        return parameters

    def platform_parameters(self, values: np.ndarray, carried: Collection[str] | None = None) -> np.ndarray:
        """Return the ten standard parameters of the platform together with the payloads on board."""
        bodies = self.spread(values)[self.legs[-1][2].stop : self._bodies].reshape(-1, 10)
        present = [True, *(carried is None or label in carried for label in self.payloads)]
        return bodies[present].sum(axis=0)

    def energy_columns(self, q: np.ndarray, v: np.ndarray, carried: Collection[str] | None = None) -> np.ndarray:
        """Return the energy regressor h (N, p) at encoder q, v (N, n), like `IdentificationModel.energy_columns`."""
        return self.energies(self.moved(q, v, np.zeros_like(v)), carried)

    def energies(self, motion: LoopMotion, carried: Collection[str] | None = None) -> np.ndarray:
        """Return the columns h (N, p) of kinetic and potential energy; zero for friction (eq. 3 of the power paper)."""
        out = np.zeros((self._bodies + len(self.terms), len(motion.v)))
        for bodies, joints, columns in self.legs:
            leg_energies = rigid_body.energies(bodies, motion.posture.q[:, joints], motion.v[:, joints])
            out[columns] = leg_energies[:, : columns.stop - columns.start].T
        platform = energy_columns(motion.posture.pose, motion.twist, self.mechanism.robot.gravity)
        self._fill_platform(out, platform.T, carried)
        drives.fill_energies(self.terms, out[self._bodies :], motion.v.T)
        return self._merged(out).T

    def _fill_platform(self, out: np.ndarray, platform: np.ndarray, carried: Collection[str] | None) -> None:
        """Write the ten columns of the platform, and ten columns for each payload on board."""
        for first, label in zip(range(self.legs[-1][2].stop, self._bodies, 10), (None, *self.payloads)):
            if label is None or carried is None or label in carried:
                out[first : first + 10] = platform

    def acting(self) -> np.ndarray:
        states = self.sample(4, np.random.default_rng(0))
        regressor = self.regressor(states.q, states.v, states.a)
        return np.asarray((np.abs(regressor) > 1e-12).any(axis=0)).T

    def preference(self) -> np.ndarray:
        """Return the columns in the order of selection: platform, first moments, inertias, drives, masses, payloads.

        Inertia and mass of bodies next to the platform regroup on the platform and on the links before (Khalil &
        Ibrahim 2007).
        """
        orders = []
        leg_kinds = []
        for bodies, _, columns in self.legs:
            count = (columns.stop - columns.start) // 10
            orders.append(bodies.order[:count])
            leg_kinds.append(bodies.kinds[:count])
        order = np.concatenate(orders)
        kinds = np.concatenate(leg_kinds)
        ranks: dict[str, list[int]] = {"moments": [], "inertias": [], "late": []}
        for i, (body_order, kind) in enumerate(zip(order, kinds)):
            last = KEPT_LAST["prismatic" if kind == PRISMATIC else "revolute"]
            for c in range(10):
                if c in last or c == 9:
                    rank = "late"
                else:
                    rank = "moments" if c > 5 else "inertias"
                ranks[rank].append(10 * i + int(body_order[c]))
        platform = 10 * len(order)
        drive = range(self._bodies, self._bodies + len(self.terms))
        first = range(platform, platform + 10)
        payloads = range(platform + 10, self._bodies)
        columns = [*first, *ranks["moments"], *ranks["inertias"], *drive, *ranks["late"], *payloads]
        distinct = dict.fromkeys(self.owners[columns])
        return np.array(list(distinct), dtype=int)

    def plant(self, values: np.ndarray, terms: Sequence[DriveTerm] = ()) -> Any:
        """Return the robot to simulate with values of its parameters and of further terms of the actuated joints."""
        # stands on this module
        from calib.parallel.mechanism.mechanism_simulation import ParallelPlant

        actuated_terms = []
        for term in terms:
            joint = int(self.mechanism.robot.actuated[term.acts[0][0]])
            actuated_terms.append(replace(term, acts=((joint, ((joint, 1.0),)),)))
        return ParallelPlant(replace(self, terms=(*self.terms, *actuated_terms)), values)

    def load_cases(self) -> Loads:
        if self.payloads:
            return (None, ())
        return (None,)

    def sample(
        self, count: int, rng: np.random.Generator, lower: np.ndarray | None = None, upper: np.ndarray | None = None
    ) -> States:
        """Draw random states: the platform uniform in its box, its twist and the twist's derivative within ±3."""
        robot = self.mechanism.robot
        coordinates = rng.uniform(robot.lower, robot.upper, (count, robot.r))
        posture = self.mechanism.place(coordinates)
        rate, change = rng.uniform(-RATE, RATE, (2, count, robot.r))
        motion = of_platform(self.mechanism, posture, rate, change)
        actuated = robot.actuated
        return States(posture.q[:, actuated], motion.v[:, actuated], motion.a[:, actuated])

    def known_parameters(self) -> np.ndarray | None:
        """Return the inertial parameters of the robot's file (inertial,), zero for payloads; None if it has none.
        Identical legs have the mean of the file's.
        """
        robot = self.mechanism.robot
        parts = [leg.chain.inertias[: leg.bodies] for leg in robot.legs if leg.chain.inertias is not None]
        if len(parts) < len(robot.legs) or robot.platform is None:
            return None
        payloads = np.zeros((len(self.payloads), 10))
        parameters = np.concatenate([*parts, robot.platform[None], payloads]).ravel()
        owners = self.owners[: self._bodies]
        return np.bincount(owners, parameters) / np.bincount(owners)

    def on_rows(self, W: np.ndarray, motion: LoopMotion) -> np.ndarray:
        """Return the regressor (N, rows, p) of the torque rows from the one in platform coordinates, W (N, r, p)."""
        if self.torque_rows.name == PLATFORM:
            return W
        if self.torque_rows.name == POWER.name:
            return np.einsum("nr,nrp->pn", motion.rate, W).T[:, None, :]
        return np.linalg.solve(motion.jacobians.readings.transpose(0, 2, 1), W)


PLATFORM = "platform"


def rows_named(mechanism: ClosedRobot, name: str = "") -> TorqueRows:
    """Return the rows of the option ``platform``, ``motor`` or ``power``; by default those possible for a robot.

    Raises:
        UsageError: for motor rows of redundant actuators, whose torques no model determines; for other names.
    """
    robot = mechanism.robot
    name = name or (PLATFORM if robot.redundant else MOTOR.name)
    if name == PLATFORM:
        units = tuple(FORCES[COORDINATES.index(coordinate)] for coordinate in robot.freedom)
        return projected(PLATFORM, Projection(robot.freedom, units, partial(_to_platform, mechanism)))
    if name == POWER.name:
        return POWER
    require(name == MOTOR.name, f"rows = '{name}': for a parallel robot expected platform, motor or power", UsageError)
    if robot.redundant:
        raise UsageError(
            f"rows = 'motor': '{robot.name}' has {robot.n} actuators for {robot.r} freedoms, so that the share of each "
            "depends on the overconstraint; use rows = 'platform', or 'power'"
        )
    return MOTOR


def make_parallel_model(
    mechanism: ClosedRobot,
    sets: Sequence[str] = (),
    v0: float = V0,
    rows: TorqueRows | None = None,
    payloads: Sequence[str] = (),
    passive: str = "",
    identical_legs: bool = False,
) -> ParallelModel:
    """Return the identification model of a robot: bodies, drive terms of actuated joints, friction of passive joints.

    Args:
        sets: names out of `calib.dynamics.drives.standard`, one text per actuated joint or one for all; none: Ia Fv Fc
            off.
        v0: smoothing of the Coulomb sign [rad/s or m/s].
        passive: names for all passive joints, e.g. ``Fv Fc``.
        identical_legs: see `ParallelModel`.
    """
    robot = mechanism.robot
    drive_sets = list(sets) or ["Ia Fv Fc off"]
    if len(drive_sets) == 1:
        drive_sets = drive_sets * robot.n
    if len(drive_sets) != robot.n:
        raise UsageError(
            f"drives: {len(drive_sets)} texts for the {robot.n} actuated joints; give one, or one per joint"
        )
    joints = [joint for leg in robot.legs for joint in leg.chain.joints]
    texts = [passive] * len(joints)
    for j, text in zip(robot.actuated, drive_sets):
        texts[j] = text
    linear = [joint.kind == "prismatic" for joint in joints]
    plain = drives.standard(texts, v0, linear)
    terms = tuple(replace(term, name=_renamed(term, robot.labels)) for term in plain)
    return ParallelModel(mechanism, terms, rows or rows_named(mechanism), tuple(payloads), identical_legs)


def _renamed(term: DriveTerm, labels: Sequence[str]) -> str:
    """Return the name of a term with its joint's label instead of its number."""
    joint = term.acts[0][0]
    return term.name.removesuffix(str(joint + 1)) + labels[joint]


def _to_platform(mechanism: ClosedRobot, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return J_p^invᵀ (N, r, n), which maps actuator torques to platform coordinates."""
    return loop_jacobians(mechanism, mechanism.locate(q)).readings.transpose(0, 2, 1)


# of the differences by x, v and a
STEPS = (1e-6, 1e-3, 1.0)


def along(mechanism: ClosedRobot, x: np.ndarray, v: np.ndarray, a: np.ndarray) -> LoopMotion:
    """Return the motion of all joints for platform coordinates x (N, r) and their derivatives v, a."""
    return of_platform(mechanism, mechanism.place(x), *_twist_of(mechanism, x, v, a))


def _twist_of(mechanism: ClosedRobot, x: np.ndarray, v: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the independent parts of the platform's twist and their derivatives, each (N, r).

    Position's are v and a themselves; ω = ψ̇ z + φ̇ Rz y + ρ̇ Rz Ry x of roll ρ, pitch φ, yaw ψ about the base's axes.
    """
    selected = mechanism.robot.selected
    if not (selected > 2).any() or ((selected > 2).sum() == 1 and 5 in selected):
        return v, a
    full = np.zeros((3, len(x), 6))
    full[:, :, selected] = x, v, a
    angles, rates, changes = full[:, :, 3:]
    Rz = Rotation.from_euler("z", angles[:, 2:]).as_matrix()
    Rzy = Rz @ Rotation.from_euler("y", angles[:, 1:2]).as_matrix()
    vertical = np.broadcast_to([0.0, 0.0, 1.0], (len(x), 3))
    axes = np.stack([Rzy[:, :, 0], Rz[:, :, 1], vertical], axis=2)
    yaw = rates[:, 2:] * axes[:, :, 2]
    pitch = rates[:, 1:2] * axes[:, :, 1]
    roll = rates[:, :1] * axes[:, :, 0]
    full[1, :, 3:] = yaw + pitch + roll
    by_changes = np.einsum("nij,nj->ni", axes, changes)
    full[2, :, 3:] = by_changes + np.cross(yaw, pitch) + np.cross(yaw + pitch, roll)
    return full[1][:, selected], full[2][:, selected]


# of a search, whose objectives and limits all ask for the same motion and for those beside it
@lru_cache(maxsize=4)
def _moving(mechanism: ClosedRobot, *motion: bytes) -> LoopMotion:
    """Return the motion of all joints for x, v, a (N, r) of the platform."""
    x, v, a = (np.frombuffer(series).reshape(-1, mechanism.robot.r) for series in motion)
    return along(mechanism, x, v, a)


@lru_cache(maxsize=4)
def _beside(mechanism: ClosedRobot, *motion: bytes) -> list[tuple[LoopMotion, LoopMotion]]:
    """Return the motions for finite differences at x, v, a (N, r): each column increased and decreased by its step."""
    states = [np.frombuffer(series).reshape(-1, mechanism.robot.r) for series in motion]
    result = []
    start = _moving(mechanism, *motion).posture
    still = loop_jacobians(mechanism, start)
    for order, step in enumerate(STEPS):
        for shift in step * np.eye(mechanism.robot.r):
            ends = []
            for shifted in ([*states], [*states]):
                shifted[order] = shifted[order] + (-shift if ends else shift)
                posture = start
                if order == 0:
                    posture = mechanism.place(shifted[0], start)
                twist = _twist_of(mechanism, *shifted)
                ends.append(of_platform(mechanism, posture, *twist, None if order == 0 else still))
            result.append(tuple(ends))
    return result


@dataclass(frozen=True, eq=False)
class PlatformRegressor:
    """Regressor in platform coordinates and actuator torques as functions of x, v, a; gradients are by differences.

    Attributes:
        model: model of the robot.
        columns: (b,) indices of the model's columns that are used.
        values: (p,) parameters that predict torques; None where unknown.
    """

    model: ParallelModel
    columns: np.ndarray
    values: np.ndarray | None = None
    carried: Collection[str] | None = None

    def motion(self, x: np.ndarray, v: np.ndarray, a: np.ndarray) -> LoopMotion:
        """Return the motion of all joints for x, v, a (N, r); x is clipped to the robot's box."""
        reachable = self._reachable(x)
        return _moving(self.model.mechanism, reachable.tobytes(), v.tobytes(), a.tobytes())

    def regressor(self, x: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return W (N, r, b) in the selected columns."""
        return self._columns(self.motion(x, v, a))

    def regressor_gradient(
        self, x: np.ndarray, v: np.ndarray, a: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the gradients of Σ weights · W (N, r, b) with respect to x, v, a, each (N, r)."""
        return self.slopes(x, v, a, self._columns, weights)

    def torques(self, motion: LoopMotion) -> np.ndarray:
        """Return the actuators' torques (N, n) of a motion, by the model's `values` and preload."""
        assert self.values is not None
        return self.model.actuator_torques(self.values, motion, self.carried)

    def speeds(self, motion: LoopMotion) -> np.ndarray:
        """Return the actuators' speeds (N, n) of a motion."""
        return motion.v[:, self.model.mechanism.robot.actuated]

    def _reachable(self, x: np.ndarray, spare_share: float = 0.01) -> np.ndarray:
        """Return coordinates clipped to the robot's box, since a search may leave the box.

        `spare_share`: share of the box's width allowed beyond the box (our choice).
        """
        robot = self.model.mechanism.robot
        spare = spare_share * (robot.upper - robot.lower)
        return np.clip(x, robot.lower - spare, robot.upper + spare)

    def _columns(self, motion: LoopMotion) -> np.ndarray:
        regressor = self.model.platform_regressor(motion, self.carried)
        return regressor.transpose(2, 1, 0)[self.columns].transpose(2, 1, 0)

    def slopes(
        self, x: np.ndarray, v: np.ndarray, a: np.ndarray, of: Callable[[LoopMotion], np.ndarray], weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the gradients of Σ weights · of(motion) in x, v, a by central differences (exact in v, a).

        Args:
            of: maps a motion of N samples to values (N, ...); weights: array of the shape of these values.
        """
        within = self._reachable(x)
        result = np.empty((3, *x.shape))
        pairs = _beside(self.model.mechanism, within.tobytes(), v.tobytes(), a.tobytes())
        for k, (raised, lowered) in enumerate(pairs):
            order, j = divmod(k, x.shape[1])
            change = ((of(raised) - of(lowered)) * weights).reshape(len(x), -1)
            result[order, :, j] = change.sum(axis=1) / (2.0 * STEPS[order])
        return result[0] * (within == x), result[1], result[2]
