"""The identification model of a parallel robot, with rows for platform coordinates, actuators or power.

    platform   J_p^invᵀ τ = W χ      one row per freedom; unique, also with redundant actuators (eqs 24-28)
    motor      τ = W χ               one row per actuator, where there are as many as freedoms (eq. 14)
    power      q̇ᵀ τ = vᵀ W χ         one row

    W = [J_tᵀ W_legs, Dᵀ W_platform, J_tᵀ W_drives]

(Briot, Gautier & Krut 2013.) Bodies are labelled as in that paper: joint j of leg k is jk, the platform has the number
after the legs' last joints; payloads have their own labels. χ are the ten standard parameters of each body (legs,
platform, payloads), followed by the drives' terms. `PlatformRegressor` gives the rows as functions of platform
coordinates x(t), with gradients for the design of motions.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib.dynamics import drives, rigid_body
from calib.dynamics.bodies import PRISMATIC, STANDARD, UNITS, Bodies, bodies_of
from calib.dynamics.drives import DriveTerm
from calib.dynamics.idim import KEPT_LAST
from calib.dynamics.regressor_model import Loads, States
from calib.dynamics.shapes import V0
from calib.dynamics.torque_rows import MOTOR, POWER, Projection, TorqueRows, projected
from calib.errors import CalibError, UsageError, require
from calib.parallel.mechanism.closure import ClosedRobot, Posture
from calib.parallel.mechanism.parallel_robot import COORDINATES, FORCES
from calib.parallel.mechanism.platform_columns import energy_columns, wrench_regressor
from calib.parallel.mechanism.velocities import (
    LoopJacobians,
    LoopMotion,
    distributed,
    loop_jacobians,
    of_platform,
    of_readings,
)
from calib.records import shaped

# Largest speed [m/s or rad/s] and acceleration [m/s² or rad/s²] of random states (as `IdentificationModel.sample`).
RATE = 3.0
# Largest entry of a regressor below which a column has no effect on a row.
NO_EFFECT = 1e-12


@dataclass(frozen=True, eq=False)
class ParallelModel:
    """Legs, platform, payloads and drives as one regressor; a `calib.dynamics.regressor_model.RegressorModel`.

    Attributes:
        mechanism: the robot, its loops closed.
        terms: drive terms; their joint indices count the joints of all legs (the tree).
        torque_rows: ``platform``, ``motor`` or ``power`` rows (`rows_named`).
        payloads: labels of bodies that the platform may carry.
        identical_legs: whether all legs have common inertial parameters and motor inertias, named after the first leg;
            friction and offsets are always separate parameters of each joint.
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
        first = legs[0]
        if self.identical_legs:
            kinds = [joint.kind for joint in first.chain.joints]
            for leg in legs:
                leg_kinds = [joint.kind for joint in leg.chain.joints]
                if leg.bodies != first.bodies or leg_kinds != kinds:
                    raise UsageError(f"identical_legs: {leg.name} is built unlike {first.name}; remove identical_legs")
        counts = Counter(self.names)
        doubled = sorted(name for name, count in counts.items() if count > 1)
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
        """The model with separate parameters of each leg; the model itself unless legs are identical."""
        if self.identical_legs:
            return replace(self, identical_legs=False)
        return self

    @cached_property
    def _first(self) -> np.ndarray:
        """For each parameter of `single` (p_1,), the index in `single` of the parameter that replaces it.

        A parameter of identical legs is replaced by that of the first leg; others are replaced by themselves.
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
            leg_joints = int(starts[1])
            for joint, k in motors.items():
                first[k] = motors.get(joint % leg_joints, k)
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
        """Return the entries of this model's parameters from those of the parameters of `single`."""
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
        names: list[str] = []
        for label in self.labels:
            names += [name + label for name in STANDARD]
        names += [term.name for term in self.terms]
        return self._chosen(names)

    @property
    def units(self) -> tuple[str, ...]:
        units = [*UNITS] * len(self.labels)
        units += [term.unit for term in self.terms]
        return self._chosen(units)

    @property
    def p(self) -> int:
        return len(self.names)

    @property
    def columns(self) -> tuple[DriveTerm, ...]:
        return self._columns

    @cached_property
    def _columns(self) -> tuple[DriveTerm, ...]:
        no_terms = [None] * self._bodies
        columns = self._chosen([*no_terms, *self.terms])
        return columns[self.inertial :]

    @property
    def rows(self) -> int:
        return self.torque_rows.count(self.n)

    @cached_property
    def legs(self) -> tuple[tuple[Bodies, slice, slice], ...]:
        """For each leg: its bodies, its joints' indices in the tree, and its bodies' columns."""
        robot = self.mechanism.robot
        counts = [leg.bodies for leg in robot.legs]
        ends = 10 * np.cumsum([0, *counts])
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
        """Return W (N, rows, p) at positions, velocities and accelerations (N, n) of the actuated joints.

        Args:
            q, v, a: (N, n) of the actuated joints.
            load, states: not used.
            carried: labels of the payloads on board; None: all.
        """
        motion = self.moved(q, v, a)
        return self.along(motion, carried)

    def drive_regressor(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return W (N, rows, p) as `regressor`, but with zeros for the bodies, whose columns cost most."""
        return self.drives_along(self.moved(q, v, a))

    def drives_along(self, motion: LoopMotion) -> np.ndarray:
        """Return W (N, rows, p) as `along`, but with zeros for the bodies."""
        count = self._bodies + len(self.terms)
        out = np.zeros((count, self.mechanism.robot.r, len(motion.v)))
        self._fill_drives(out, motion)
        return self.on_rows(self._merged(out).transpose(2, 1, 0), motion)

    def along(self, motion: LoopMotion, carried: Collection[str] | None = None) -> np.ndarray:
        """Return W (N, rows, p) along a motion of the whole robot."""
        regressor = self.platform_regressor(motion, carried)
        return self.on_rows(regressor, motion)

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
        rows = self.on_rows(force[:, :, None], motion)
        return rows[:, :, 0]

    def moved(self, q: np.ndarray, v: np.ndarray, a: np.ndarray, start: Posture | None = None) -> LoopMotion:
        """Return the motion of all joints and the platform from q, v, a (N, n) of the actuated joints.

        `start`: postures near those at q, for a faster solution; None: home.
        """
        if start is None:
            robot = self.mechanism.robot
            readings = shaped(q, (None, robot.n), f"readings of '{robot.name}'")
            values = readings.tobytes()
            posture = _located(self.mechanism, values)
            jacobians = _loop_at(self.mechanism, values)
        else:
            posture = self.mechanism.locate(q, start)
            jacobians = loop_jacobians(self.mechanism, posture)
        v = np.asarray(v, dtype=float)
        a = np.asarray(a, dtype=float)
        return of_readings(self.mechanism, posture, v, a, jacobians)

    def platform_regressor(self, motion: LoopMotion, carried: Collection[str] | None = None) -> np.ndarray:
        """Return the regressor W (N, r, p) in platform coordinates, stored in the order (p, r, N)."""
        robot = self.mechanism.robot
        J = motion.jacobians
        count = self._bodies + len(self.terms)
        out = np.zeros((count, robot.r, len(motion.v)))
        for bodies, joints, columns in self.legs:
            q = motion.posture.q[:, joints]
            v = motion.v[:, joints]
            a = motion.a[:, joints]
            W = rigid_body.regressor(bodies, q, v, a)
            W = W[:, :, : columns.stop - columns.start]
            out[columns] = np.einsum("njr,njc->crn", J.joints[:, joints], W, optimize=True)
        platform = wrench_regressor(motion.posture.pose, motion.twist, motion.change, robot.gravity)
        on_coordinates = J.platform.transpose(0, 2, 1) @ platform
        self._fill_platform(out, on_coordinates.transpose(2, 1, 0), carried)
        self._fill_drives(out, motion)
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
        """Return the torques (N, n) of the actuators for parameters (p,); of redundant actuators with `preload`."""
        forces = self.platform_force(values, motion, carried)
        preload = np.array(self.preload or [0.0])
        return distributed(self.mechanism, motion.jacobians, forces, preload)

    def tree_torque(self, values: np.ndarray, motion: LoopMotion) -> np.ndarray:
        """Return the torques (N, n_t) of all joints that legs and drives need if the platform is detached."""
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
        """Return the ten standard parameters of the platform together with the payloads on board.

        `carried`: labels of the payloads on board; None: all.
        """
        first = self.legs[-1][2].stop
        standard = self.spread(values)[first : self._bodies]
        bodies = standard.reshape(-1, 10)
        on_board = [carried is None or label in carried for label in self.payloads]
        present = [True, *on_board]
        return bodies[present].sum(axis=0)

    def energy_columns(self, q: np.ndarray, v: np.ndarray, carried: Collection[str] | None = None) -> np.ndarray:
        """Return the energy regressor h (N, p) at positions and velocities q, v (N, n) of the actuated joints."""
        motion = self.moved(q, v, np.zeros_like(v))
        return self.energies(motion, carried)

    def energies(self, motion: LoopMotion, carried: Collection[str] | None = None) -> np.ndarray:
        """Return the columns h (N, p) of kinetic plus potential energy; columns of friction are zero."""
        count = self._bodies + len(self.terms)
        out = np.zeros((count, len(motion.v)))
        for bodies, joints, columns in self.legs:
            q = motion.posture.q[:, joints]
            leg_energies = rigid_body.energies(bodies, q, motion.v[:, joints])
            out[columns] = leg_energies[:, : columns.stop - columns.start].T
        platform = energy_columns(motion.posture.pose, motion.twist, self.mechanism.robot.gravity)
        self._fill_platform(out, platform.T, carried)
        drives.fill_energies(self.terms, out[self._bodies :], motion.v.T)
        return self._merged(out).T

    def _fill_platform(self, out: np.ndarray, platform: np.ndarray, carried: Collection[str] | None) -> None:
        """Write the columns `platform` (10, …) into `out`: for the platform, and for each payload on board."""
        firsts = range(self.legs[-1][2].stop, self._bodies, 10)
        for first, label in zip(firsts, (None, *self.payloads)):
            if label is None or carried is None or label in carried:
                out[first : first + 10] = platform

    def _fill_drives(self, out: np.ndarray, motion: LoopMotion) -> None:
        """Add the columns of the drive terms in platform coordinates to `out` (p_1, r, N)."""
        motions = [motion.posture.q.T, motion.v.T, motion.a.T, None]
        for k, term in enumerate(self.terms):
            for joint, column in term.acting(motions, np.zeros((0, len(motion.v)))):
                out[self._bodies + k] += motion.jacobians.joints[:, joint].T * column

    def acting(self) -> np.ndarray:
        return self._acting

    @cached_property
    def _acting(self) -> np.ndarray:
        states = self.sample(4, np.random.default_rng(0))
        regressor = self.regressor(states.q, states.v, states.a)
        has_effect = np.abs(regressor) > NO_EFFECT
        return np.asarray(has_effect.any(axis=0)).T

    def preference(self) -> np.ndarray:
        """Return the columns in the order in which they are preferred as base parameters.

        Order: platform, first moments, inertias, drives, masses, payloads. Inertia and mass of bodies next to the
        platform are regrouped with parameters of the platform and of the previous links (Khalil & Ibrahim 2007).
        """
        orders = []
        leg_kinds = []
        for bodies, _, columns in self.legs:
            count = (columns.stop - columns.start) // 10
            orders.append(bodies.order[:count])
            leg_kinds.append(bodies.kinds[:count])
        order = np.concatenate(orders)
        kinds = np.concatenate(leg_kinds)
        moments: list[int] = []
        inertias: list[int] = []
        last_columns: list[int] = []
        for i, (body_order, kind) in enumerate(zip(order, kinds)):
            last = KEPT_LAST["revolute"]
            if kind == PRISMATIC:
                last = KEPT_LAST["prismatic"]
            for c in range(10):
                column = 10 * i + int(body_order[c])
                if c in last or c == 9:
                    last_columns.append(column)
                elif c > 5:
                    moments.append(column)
                else:
                    inertias.append(column)
        platform = 10 * len(order)
        drive = range(self._bodies, self._bodies + len(self.terms))
        first = range(platform, platform + 10)
        payloads = range(platform + 10, self._bodies)
        columns = [*first, *moments, *inertias, *drive, *last_columns, *payloads]
        distinct = dict.fromkeys(self.owners[columns])
        return np.array(list(distinct), dtype=int)

    def plant(self, values: np.ndarray, terms: Sequence[DriveTerm] = ()) -> Any:
        """Return the robot to simulate.

        Args:
            values: values of the model's parameters, followed by those of `terms`.
            terms: further drive terms, whose joints count the actuated joints.
        """
        # imports this module
        from calib.parallel.mechanism.mechanism_simulation import ParallelPlant

        actuated_terms = []
        for term in terms:
            actuator = term.acts[0][0]
            joint = int(self.mechanism.robot.actuated[actuator])
            acts = ((joint, ((joint, 1.0),)),)
            actuated_terms.append(replace(term, acts=acts))
        model = replace(self, terms=(*self.terms, *actuated_terms))
        return ParallelPlant(model, values)

    def load_cases(self) -> Loads:
        if self.payloads:
            return (None, ())
        return (None,)

    def sample(
        self, count: int, rng: np.random.Generator, lower: np.ndarray | None = None, upper: np.ndarray | None = None
    ) -> States:
        """Return random states: the platform uniformly in its box, its twist and the twist's derivative within ±3.

        `lower` and `upper` are not used.
        """
        robot = self.mechanism.robot
        coordinates = rng.uniform(robot.lower, robot.upper, (count, robot.r))
        posture = self.mechanism.place(coordinates)
        rate, change = rng.uniform(-RATE, RATE, (2, count, robot.r))
        motion = of_platform(self.mechanism, posture, rate, change)
        actuated = robot.actuated
        q = posture.q[:, actuated]
        v = motion.v[:, actuated]
        a = motion.a[:, actuated]
        return States(q, v, a)

    def known_parameters(self) -> np.ndarray | None:
        """Return the inertial parameters (inertial,) that the robot's file states; None if it does not state all.

        Parameters of payloads are zero. Parameters of identical legs are the mean over the file's legs.
        """
        robot = self.mechanism.robot
        if robot.platform is None:
            return None
        parts = []
        for leg in robot.legs:
            if leg.chain.inertias is None:
                return None
            parts.append(leg.chain.inertias[: leg.bodies])
        payloads = np.zeros((len(self.payloads), 10))
        bodies = np.concatenate([*parts, robot.platform[None], payloads])
        parameters = bodies.ravel()
        owners = self.owners[: self._bodies]
        return np.bincount(owners, parameters) / np.bincount(owners)

    def on_rows(self, W: np.ndarray, motion: LoopMotion) -> np.ndarray:
        """Return the regressor (N, rows, p) of the torque rows from the one in platform coordinates, W (N, r, p)."""
        if self.torque_rows.name == PLATFORM:
            return W
        if self.torque_rows.name == POWER.name:
            power = np.einsum("nr,nrp->pn", motion.rate, W)
            return power.T[:, None, :]
        projection = motion.jacobians.readings.transpose(0, 2, 1)
        return np.linalg.solve(projection, W)


PLATFORM = "platform"


def rows_named(mechanism: ClosedRobot, name: str = "") -> TorqueRows:
    """Return the torque rows of a name: ``platform``, ``motor`` or ``power``.

    By default, rows of redundant actuators are ``platform``, those of other robots ``motor``.

    Raises:
        UsageError: for motor rows of redundant actuators, whose torques no model determines; for other names.
    """
    robot = mechanism.robot
    name = name or (PLATFORM if robot.redundant else MOTOR.name)
    if name == PLATFORM:
        units = tuple(FORCES[COORDINATES.index(coordinate)] for coordinate in robot.freedom)
        to_platform = partial(_to_platform, mechanism)
        return projected(PLATFORM, Projection(robot.freedom, units, to_platform))
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
        mechanism: the robot, its loops closed.
        sets: names of drive terms (`calib.dynamics.drives.standard`), one text per actuated joint or one for all;
            empty: Ia Fv Fc off.
        v0: smoothing of the Coulomb sign [rad/s or m/s].
        rows: torque rows; None: the default of `rows_named`.
        payloads: labels of bodies that the platform may carry.
        passive: names of the drive terms of all passive joints, e.g. ``Fv Fc``; "": none.
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
    terms = []
    for term in drives.standard(texts, v0, linear):
        name = _renamed(term, robot.labels)
        terms.append(replace(term, name=name))
    torque_rows = rows or rows_named(mechanism)
    return ParallelModel(mechanism, tuple(terms), torque_rows, tuple(payloads), identical_legs)


def _renamed(term: DriveTerm, labels: Sequence[str]) -> str:
    """Return the name of a term with its joint's label instead of its number."""
    joint = term.acts[0][0]
    return term.name.removesuffix(str(joint + 1)) + labels[joint]


# Instrumental variables ask for several speeds at the same readings, block after block of a record.
@lru_cache(maxsize=32)
def _located(mechanism: ClosedRobot, readings: bytes) -> Posture:
    """Return the postures at readings (N, n) of the actuated joints."""
    values = np.frombuffer(readings)
    return mechanism.locate(values.reshape(-1, mechanism.robot.n))


# Jacobians are larger than postures.
@lru_cache(maxsize=4)
def _loop_at(mechanism: ClosedRobot, readings: bytes) -> LoopJacobians:
    """Return the Jacobians at readings (N, n) of the actuated joints."""
    return loop_jacobians(mechanism, _located(mechanism, readings))


def _to_platform(mechanism: ClosedRobot, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return J_p^invᵀ (N, r, n), which maps actuator torques to platform coordinates."""
    posture = mechanism.locate(q)
    jacobians = loop_jacobians(mechanism, posture)
    return jacobians.readings.transpose(0, 2, 1)


# Steps of the differences by x [m or rad], v [per s] and a [per s²].
STEPS = (1e-6, 1e-3, 1.0)


def along(mechanism: ClosedRobot, x: np.ndarray, v: np.ndarray, a: np.ndarray) -> LoopMotion:
    """Return the motion of all joints for platform coordinates x (N, r) and their derivatives v, a."""
    posture = mechanism.place(x)
    rate, change = _twist_of(mechanism, x, v, a)
    return of_platform(mechanism, posture, rate, change)


def _twist_of(mechanism: ClosedRobot, x: np.ndarray, v: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the independent parts of the platform's twist and their derivatives, each (N, r).

    For coordinates of position these are v and a. The angular velocity is ω = ψ̇ z + φ̇ Rz y + ρ̇ Rz Ry x with roll ρ,
    pitch φ and yaw ψ about the base's axes.
    """
    selected = mechanism.robot.selected
    if not (selected > 2).any() or ((selected > 2).sum() == 1 and 5 in selected):
        return v, a
    full = np.zeros((3, len(x), 6))
    full[:, :, selected] = x, v, a
    angles, rates, changes = full[:, :, 3:]
    Rz = Rotation.from_euler("z", angles[:, 2:]).as_matrix()
    Ry = Rotation.from_euler("y", angles[:, 1:2]).as_matrix()
    Rzy = Rz @ Ry
    roll_axis = Rzy[:, :, 0]
    pitch_axis = Rz[:, :, 1]
    yaw_axis = np.broadcast_to([0.0, 0.0, 1.0], (len(x), 3))
    axes = np.stack([roll_axis, pitch_axis, yaw_axis], axis=2)
    yaw = rates[:, 2:] * axes[:, :, 2]
    pitch = rates[:, 1:2] * axes[:, :, 1]
    roll = rates[:, :1] * axes[:, :, 0]
    full[1, :, 3:] = yaw + pitch + roll
    by_changes = np.einsum("nij,nj->ni", axes, changes)
    pitch_turned = np.cross(yaw, pitch)
    roll_turned = np.cross(yaw + pitch, roll)
    full[2, :, 3:] = by_changes + pitch_turned + roll_turned
    return full[1][:, selected], full[2][:, selected]


# A search evaluates objectives and limits at the same motion, and its derivatives at the same neighbouring motions.
@lru_cache(maxsize=4)
def _moving(mechanism: ClosedRobot, *motion: bytes) -> LoopMotion:
    """Return the motion of all joints for x, v, a (N, r) of the platform."""
    x, v, a = _series(mechanism, motion)
    return along(mechanism, x, v, a)


def _series(mechanism: ClosedRobot, motion: Sequence[bytes]) -> list[np.ndarray]:
    """Return the arrays x, v, a (N, r) of a motion from their bytes."""
    series = [np.frombuffer(content) for content in motion]
    return [values.reshape(-1, mechanism.robot.r) for values in series]


@lru_cache(maxsize=4)
def _beside(mechanism: ClosedRobot, *motion: bytes) -> LoopMotion:
    """Return the motions near x, v, a (N, r), one behind the other (6 r N samples), for central differences.

    In each one coordinate of x, v or a is increased, or decreased, by its step: first those of x, then of v and a.
    """
    states = np.array(_series(mechanism, motion))
    r = mechanism.robot.r
    shifts = np.zeros((3, r, 2, 3, 1, r))
    for order, step in enumerate(STEPS):
        for j in range(r):
            shifts[order, j, :, order, 0, j] = step, -step
    neighbours = states + shifts.reshape(-1, 3, 1, r)
    x, v, a = neighbours.transpose(1, 0, 2, 3).reshape(3, -1, r)
    start = _moving(mechanism, *motion).posture
    repeated = start[np.tile(np.arange(len(start)), 6 * r)]
    displaced = 2 * r * len(start)
    placed = mechanism.place(x[:displaced], repeated[:displaced])
    q = np.concatenate([placed.q, repeated.q[displaced:]])
    pose = np.concatenate([placed.pose, repeated.pose[displaced:]])
    rate, change = _twist_of(mechanism, x, v, a)
    return of_platform(mechanism, Posture(q, pose), rate, change)


@dataclass(frozen=True, eq=False)
class PlatformRegressor:
    """Regressor and actuator torques of a robot as functions of the platform's coordinates x, v, a.

    Gradients are computed by central differences.

    Attributes:
        model: model of the robot.
        columns: (b,) indices of the model's columns that are used.
        values: (p,) parameters that predict torques; None where unknown.
        carried: labels of the payloads on board; None: all.
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
        """Return coordinates clipped to the robot's box and a margin, since a search may leave the box.

        `spare_share`: margin on each side as a share of the box's width (our choice).
        """
        robot = self.model.mechanism.robot
        spare = spare_share * (robot.upper - robot.lower)
        return np.clip(x, robot.lower - spare, robot.upper + spare)

    def _columns(self, motion: LoopMotion) -> np.ndarray:
        regressor = self.model.platform_regressor(motion, self.carried)
        by_column = regressor.transpose(2, 1, 0)
        return by_column[self.columns].transpose(2, 1, 0)

    def slopes(
        self, x: np.ndarray, v: np.ndarray, a: np.ndarray, of: Callable[[LoopMotion], np.ndarray], weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the gradients of Σ weights · of(motion) in x, v, a by central differences (exact in v, a).

        Args:
            of: maps a motion of N samples to values (N, ...); weights: array of the shape of these values.
        """
        within = self._reachable(x)
        samples, r = x.shape
        motions = _beside(self.model.mechanism, within.tobytes(), v.tobytes(), a.tobytes())
        values = of(motions).reshape(3, r, 2, samples, -1)
        change = values[:, :, 0] - values[:, :, 1]
        by_value = weights.reshape(samples, -1)
        steps = 2.0 * np.array(STEPS)[:, None, None]
        result = np.einsum("ojnk,nk->onj", change, by_value) / steps
        # a clipped coordinate has no effect
        by_x = result[0] * (within == x)
        return by_x, result[1], result[2]
