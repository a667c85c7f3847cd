"""Populations of simulated arms: one description, many true arms with planted errors, and what is measured of them.

    arms = calib.population("robot.urdf", 20, seed=1)
    for arm in arms:
        fit = calib.fit_geometry(arm.nominal, arm.measure(arm.postures(40)))
        errors = arm.position_errors(fit, arm.postures(200, seed=9))        # (200,) [m], against the hidden truth

The true arm differs from its description by normal errors of every length, angle and joint offset, by compliance and
gear harmonics, which joint corrections can describe, by effects that no model describes, and by masses
(`PlantedErrors`). An instrument stands somewhere in the room, a tool is mounted somewhere on the flange. All of it
follows from the seed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from functools import cached_property
from itertools import compress
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from calib.arguments import checked
from calib.data.poses.measurements import PoseMeasurements, Poses
from calib.data.recordings.recording import Recording
from calib.errors import UsageError, require
from calib.geometry.installation import Installation, see
from calib.geometry.static_torques.sources import gravity_of
from calib.identification.closed_loop.controllers import Reference
from calib.identification.friction.friction_terms import FrictionTerm
from calib.procedure.kinematic_stage.fit import Outcome
from calib.records import Floats, shaped
from calib.robot.calibrated import CalibratedChain, CorrectedChain, Deflection, as_calibrated, evaluate
from calib.robot.chain import random_joints
from calib.robot.library import load_calibrated
from calib.simulation import cell as cells
from calib.simulation.cell import Cell, SimulatedInstrument
from calib.simulation.kinds import measure_kind
from calib.simulation.known_robots import random_fourier
from calib.simulation.truth import placed
from calib.simulation.unmodelled import TorqueErrors
from calib.simulation.virtual_arm import UNMODELLED, MovingArm, carrying, moving_arm, play, record
from calib.simulation.virtual_cells import CMM, PlantedErrors, industrial, planted_cell
from calib.transforms import invert, to_quaternion

Motion = Reference | tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""A period of a motion: t (N,) [s] in even steps, q, v, a (N, n), as ``sampled()`` of a designed motion returns it."""
DEFAULT_ERRORS = PlantedErrors()
# Speed of random motions as a share of the limit, and for joints without one [rad/s, m/s]; acceleration [rad/s², m/s²].
SPEED_SHARE = 0.5
DEFAULT_SPEED = 1.0
ACCELERATION = 15.0
# Sampling rate of random motions [Hz].
RATE = 500.0
# Fewest samples of a period of random motions: four of the fifth, the fastest, harmonic.
MIN_SAMPLES = 20
# Share of the joints' ranges that random motions use.
RANGE_SHARE = 0.8
# Streams of random numbers of one arm: measurements and logs.
MEASURED, LOGGED = 1, 2


@dataclass(frozen=True, eq=False)
class PlantedArm:
    """A simulated arm whose true geometry, masses and friction are known, and hidden from a calibration.

    Attributes:
        cell: the arm in its cell: nominal and true arm, instrument, placements of instrument and tool.
        seed: seed of everything random of this arm.
        errors: sizes of the planted errors.
        torque_sensors: whether torques behind the gears are logged, too.
        friction: further friction of the true arm, each a term with its parameters (n,) [N m or N].
    """

    cell: Cell
    seed: int
    errors: PlantedErrors
    torque_sensors: bool = False
    friction: tuple[tuple[FrictionTerm, tuple[float, ...]], ...] = ()

    @property
    def nominal(self) -> CalibratedChain:
        """The arm as its description has it: what a calibration is given."""
        return CalibratedChain(self.cell.nominal)

    @property
    def truth(self) -> CalibratedChain:
        """The true arm with compliance and harmonics as joint corrections, without what no model describes."""
        chain = self.cell.truth.chain
        deflection = self.cell.truth.deflection
        # without masses gravity bends nothing
        acting = [term.basis != "torque" or chain.inertias is not None for term in deflection.terms]
        terms = tuple(compress(deflection.terms, acting))
        acting_deflection = Deflection(terms, np.asarray(deflection.coefficients)[acting], deflection.reference)
        return CalibratedChain(chain, self.cell.nominal, corrections=CorrectedChain(chain, acting_deflection))

    @property
    def note(self) -> str:
        """A sentence on how the truth was generated."""
        return self.cell.note

    @cached_property
    def moving(self) -> MovingArm:
        """The arm with its true masses, drives, controller and sensors.

        Raises:
            CalibError: the description has no masses.
        """
        sizes = self.errors.unmodelled * np.array(astuple(UNMODELLED))
        unmodelled = TorqueErrors(*sizes.tolist())
        name = self.cell.nominal.name
        arm = moving_arm(self.cell, name, self.seed, unmodelled, self.errors.masses)
        plant = arm.plant
        for term, values in self.friction:
            terms = term.drive_terms(arm.chain)
            parameters = np.concatenate([plant.parameters, values])
            plant = replace(plant, terms=(*plant.terms, *terms), parameters=parameters)
        return replace(arm, plant=plant, sensors=arm.sensors or self.torque_sensors)

    def postures(self, count: int, seed: int = 0) -> Floats:
        """Return random joint values (count, n) [rad or m] within the joints' limits; collisions are not checked.

        Raises:
            UsageError: a negative number or seed.
        """
        require(count >= 0, f"count = {count}: expected 0 or more", UsageError)
        _check_seed(seed)
        return random_joints(self.cell.nominal, count, np.random.default_rng([self.seed, seed]))

    def poses(self, q: ArrayLike) -> Floats:
        """Return the true poses of the tip in the base frame [m], with all that is planted: (m, 4, 4), or (4, 4).

        Args:
            q: joint values (m, n) [rad or m], or (n,) for one pose.
        """
        values = self.nominal.joint_rows(q)
        station, tool = self.cell.truth.stations[0], self.cell.truth.tools[0]
        poses = invert(station) @ cells.true_poses(self.cell, values) @ invert(tool)
        return poses[0] if np.ndim(q) == 1 else poses

    def measure(self, q: ArrayLike, seed: int = 0, kind: str = "") -> PoseMeasurements:
        """Return what the instrument measures of the tool at joint values q (m, n) [rad or m], with its noise.

        Args:
            q: joint values in the order in which the arm takes them.
            seed: seed of the noise.
            kind: empty for what the instrument measures, poses or positions; or ``pose``, ``position``, ``distance``
                (of pairs of rows), ``bar`` (about three centres), ``sockets`` or ``plane`` (the joints are moved from q
                until the tool touches), of which unmodelled errors, drift and outliers are no part.

        Raises:
            UsageError: an unknown kind, or the arm does not reach its sockets or planes.
        """
        values = self.nominal.joint_rows(q)
        rng = np.random.default_rng([self.seed, MEASURED, seed])
        name = f"{self.cell.nominal.name}-{self.seed}"
        if not kind:
            return cells.measure(self.cell, values, rng, name)
        instrument = self.cell.instrument
        return measure_kind(
            replace(self.cell.truth, deflection=self.truth.deflection),
            kind,
            values,
            rng,
            sigma=instrument.position_sigma,
            sigma_rotation=instrument.orientation_sigma,
            file=name,
        )

    def motion(self, seconds: float = 20.0, seed: int = 0, rate: float = RATE) -> Reference:
        """Return a random Fourier motion within the limits, at rest at both ends, not optimised for identification.

        Args:
            seconds: duration of the period [s].
            seed: seed of the coefficients.
            rate: samples per second [Hz].

        Raises:
            UsageError: a duration or rate of which no motion follows, or a negative seed.
        """
        _check_seed(seed)
        require(0 < seconds < np.inf, f"seconds = {seconds}: expected a duration above 0", UsageError)
        require(0 < rate < np.inf, f"rate = {rate}: expected a number above 0 [Hz]", UsageError)
        samples = seconds * rate
        message = f"seconds = {seconds}, rate = {rate}: expected {MIN_SAMPLES} samples or more, found {samples:.3g}"
        require(samples >= MIN_SAMPLES, message, UsageError)
        lower, upper = self.cell.nominal.sampling_limits()
        middle = 0.5 * (lower + upper)
        half = 0.5 * RANGE_SHARE * (upper - lower)
        speeds = np.array([SPEED_SHARE * joint.velocity for joint in self.cell.nominal.joints])
        speeds = np.where(np.isfinite(speeds), speeds, DEFAULT_SPEED)
        stream = np.random.default_rng([self.seed, LOGGED, seed])
        limits = (middle - half, middle + half, speeds)
        return random_fourier(*limits, seconds, rate, acceleration=ACCELERATION, seed=stream)

    def record(
        self, motion: Motion, seed: int = 0, repeats: int = 1, payload: Sequence[float] | None = None
    ) -> Recording:
        """Return the log of a motion under the arm's controller: encoders, motor torques, sensors if there are any.

        Args:
            motion: one period: of `motion`, of ``sampled()`` of a designed motion, or t (N,), q, v, a (N, n).
            seed: seed of the noise.
            repeats: number of periods.
            payload: (10,) standard parameters XX … M of a body at the tip, in its frame; None for none.

        Raises:
            CalibError: the description has no masses.
            NotConverged: the controller cannot follow this motion.
        """
        t, q, v, a = _series(motion, self.cell.nominal.n)
        arm = self.moving
        if payload is not None:
            arm = carrying(arm, shaped(payload, (10,), "payload").tolist())
        noise = np.random.default_rng([self.seed, LOGGED, seed, 1])
        recording = record(arm, play(t, q, v, a, repeats), noise)
        return replace(recording, file=f"{self.cell.nominal.name}-{self.seed}-log{seed}")

    def torques(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> Floats:
        """Return the true motor torques (N, n) [N m or N] of a warm arm along a finely sampled motion, without noise.

        Args:
            q, v, a: (N, n) joint positions [rad or m], velocities [per s] and accelerations [per s²].

        Raises:
            CalibError: the description has no masses.
        """
        positions = self.nominal.joint_rows(q)
        return self.moving.true_torque(positions, shaped(v, positions.shape, "v"), shaped(a, positions.shape, "a"))

    def position_errors(self, calibrated: CalibratedChain | Outcome, q: ArrayLike) -> Floats:
        """Return the distances (m,) [m] of the tool from where the true arm has it, at joint values q (m, n).

        Args:
            calibrated: a fit, which predicts in its instrument's frame by its own placements; or a robot, whose
                placements of instrument and tool are fitted to the true poses first, so that only arms are compared.
            q: joint values [rad or m].
        """
        values = self.nominal.joint_rows(q)
        true = cells.true_poses(self.cell, values)
        if isinstance(calibrated, Outcome):
            arm = calibrated.selection.fit.cell
            torque = gravity_of(calibrated.inputs.weighed, values)
        else:
            arm, torque = self._placed(calibrated, values, true), None
        bases = None
        if arm.deflection.terms:
            bases = evaluate(arm.deflection, values, torque)
        predicted = see(arm, values, bases=bases).point.T
        return np.linalg.norm(predicted - true[:, :3, 3], axis=1)

    def _placed(self, robot: CalibratedChain, q: np.ndarray, true: np.ndarray) -> Installation:
        """Return a robot with the station and the tool that fit the true poses (m, 4, 4) at q (m, n) best."""
        names = self.cell.nominal.joint_names
        return placed(robot.complete, Poses(q, names, true[:, :3, 3], to_quaternion(true)), robot.deflection)

    def with_friction(self, term: FrictionTerm, values: float | Sequence[float]) -> PlantedArm:
        """Return the arm with further friction.

        Args:
            term: the torque per unit of its parameter, as a function.
            values: parameter of each joint of the term [N m or N], or one for all.
        """
        terms = term.drive_terms(self.cell.nominal)
        planted = set()
        for earlier, _ in self.friction:
            planted.update(drive_term.name for drive_term in earlier.drive_terms(self.cell.nominal))
        for drive_term in terms:
            message = f"FrictionTerm {term.name}: the arm has {drive_term.name} already: choose another name"
            require(drive_term.name not in planted, message, UsageError)
        count = len(terms)
        if np.ndim(values) == 0:
            numbers = np.full(count, values)
        else:
            numbers = shaped(values, (count,), "values")
        return replace(self, friction=(*self.friction, (term, tuple(numbers.tolist()))))

    def __repr__(self) -> str:
        return f"<PlantedArm {self.cell.nominal.name}: seed {self.seed}>"


def _check_seed(seed: int) -> None:
    """Raise a UsageError for a negative seed."""
    require(seed >= 0, f"seed = {seed}: expected a whole number, 0 or more", UsageError)


def _series(motion: Motion, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return t (N,), q, v, a (N, n) of a motion.

    Raises:
        UsageError: other than four arrays of these shapes.
    """
    if isinstance(motion, Reference):
        arrays = (motion.t, motion.q, motion.v, motion.a)
    else:
        arrays = tuple(motion)
    require(len(arrays) == 4, f"motion: expected t, q, v, a, found {len(arrays)} arrays", UsageError)
    t = shaped(arrays[0], (None,), "t")
    shape = (len(t), n)
    return t, shaped(arrays[1], shape, "q"), shaped(arrays[2], shape, "v"), shaped(arrays[3], shape, "a")


@checked
def population(
    robot: str | Path | CalibratedChain,
    count: int = 10,
    *,
    seed: int = 0,
    errors: PlantedErrors = DEFAULT_ERRORS,
    instrument: SimulatedInstrument = CMM,
    torque_sensors: bool = False,
    base: str | None = None,
    tip: str | None = None,
) -> tuple[PlantedArm, ...]:
    """Return simulated arms of one description with planted errors, each with an instrument and a tool.

    Args:
        robot, base, tip: arguments of `calib.load`; or, for `robot`, its result.
        count: number of arms.
        seed: seed of the first arm; the next ones follow.
        errors: sizes of the planted errors.
        instrument: what measures the tool, with its noise.
        torque_sensors: whether logs have torques behind the gears, too.

    Raises:
        UsageError: an invalid argument.
        RobotError: the robot is not found, or its file is invalid.
    """
    require(count >= 1, f"count = {count}: ask for one arm or more", UsageError)
    _check_seed(seed)
    described = robot if isinstance(robot, CalibratedChain) else load_calibrated(robot, base, tip)
    nominal = as_calibrated(described).chain
    arms = []
    for number in range(seed, seed + count):
        unmodelled = replace(industrial(errors.unmodelled), seed=number)
        cell = planted_cell(nominal, number, instrument, errors, unmodelled)
        arms.append(PlantedArm(cell, number, errors, torque_sensors))
    return tuple(arms)
