"""A simulated robot cell with known true parameters: the arm, and the instrument that measures it.

    y_i = S_true · arm_true(q_i + δ(q_i)) · X_true · noise,     q_recorded = q_i + encoder noise,

δ being displacements beyond the rigid geometry: compliance under gravity and gear harmonics, which joint corrections
can describe, and effects that no model describes (`unmodelled`). With LEDs on the base the instrument sees the base,
too, and reports the tool in the base LEDs' frame: B_i⁻¹ y_i, so that both frames' noises count and the base's
orientation noise acts with the lever between the two.

Writing simulated measurements and logs as CSV files for `calib`.
"""

import io
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib import files
from calib.data.poses.base_frame import relative_to_base
from calib.data.poses.measurements import Poses, Positions
from calib.data.poses.pose_lists import read_poses
from calib.data.recordings.recording import Recording
from calib.data.schema import Joints
from calib.errors import UsageError, require
from calib.geometry.installation import Installation, see
from calib.records import FieldValues, shaped
from calib.robot.calibrated import evaluate
from calib.robot.chain import Chain, joint_kinds
from calib.robot.kinematics import gravity_torques
from calib.simulation.unmodelled import PositionErrors, displacements, drooping
from calib.transforms import pose, to_quaternion

# Names of the pose lists that a session plans, each with the name under which its measurement is stored.
PLANS = (("poses", "measured"), ("validation_poses", "validation_measured"))


@dataclass(frozen=True)
class SimulatedInstrument:
    """An instrument that measures frames (or points) with white noise.

    Attributes:
        name: name for messages and certificates.
        position_sigma: σ of a measured position per axis [m].
        orientation_sigma: σ of a measured orientation about each axis [rad]; None if the instrument measures points
            only.
        drift: displacement of the instrument over one series [m], linear in the row number.
        outlier_share: share of rows with a gross error.
        outlier_size: length of a gross error [m].
        encoder_sigma: σ of the recorded joint values [rad or m].
        base_frame: pose (4, 4) of the base LEDs in the arm's base; None without base LEDs.
    """

    name: str = "optical CMM"
    position_sigma: float = 60e-6
    orientation_sigma: float | None = 0.2e-3
    drift: float = 0.0
    outlier_share: float = 0.0
    outlier_size: float = 5e-3
    encoder_sigma: float = 1e-5
    base_frame: np.ndarray | None = None

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name not in ("name", "base_frame") and value is not None:
                wrong = isinstance(value, str) or not 0.0 <= value < np.inf
                require(not wrong, f"SimulatedInstrument: {name} = {value!r}: expected 0 or more", UsageError)


@dataclass(frozen=True, eq=False)
class Cell:
    """A cell with one station and one tool.

    Attributes:
        nominal: the nominal arm.
        truth: the true arm with station, tool and deflections, hidden from a calibration.
        instrument: the instrument.
        note: a sentence on how the truth was generated.
        unmodelled: position errors that no parameter of a calibration describes.
    """

    nominal: Chain
    truth: Installation
    instrument: SimulatedInstrument = field(default_factory=SimulatedInstrument)
    note: str = ""
    unmodelled: PositionErrors = field(default_factory=PositionErrors)


def true_poses(cell: Cell, q: np.ndarray, warm: float = np.inf) -> np.ndarray:
    """Return the tool's poses (m, 4, 4) in the station's frame, without noise.

    Args:
        cell: the cell.
        q: (m, n) joint values in the order in which the arm takes them [rad or m].
        warm: number of poses to which the arm has moved before; infinite for a warm arm.
    """
    arm = cell.truth.chain
    q = shaped(q, (None, arm.n), "joint values")
    torque = np.zeros(q.shape)
    if arm.inertias is not None:
        torque = gravity_torques(arm, q)
    bases = evaluate(cell.truth.deflection, q, torque)
    unmodelled_errors = displacements(cell.unmodelled, arm, q, torque, warm)
    sweep = see(cell.truth, q, bases=bases, displacements=unmodelled_errors)
    return drooping(cell.unmodelled, arm, sweep.poses(), cell.truth.stations[0])


def measure(
    cell: Cell, q: np.ndarray, seed: int | np.random.Generator = 0, file: str = "simulated", warm: float = np.inf
) -> Positions:
    """Return one simulated measurement of each pose q (m, n) [rad or m], in this order.

    Args:
        cell: the cell.
        q: true joint values (m, n); the recorded ones have encoder noise added.
        seed: seed of the noise.
        file: file name stored in the measurement.
        warm: number of poses to which the arm has moved before; infinite for a warm arm.

    Returns:
        Poses, or positions if the instrument measures points only, with the sigmas that the instrument's maker states.
        These sigmas do not include drift and outliers.
    """
    measured, bases = measure_frames(cell, q, seed, file, warm)
    if bases is None:
        return measured
    return relative_to_base(measured, bases[:, :3, 3], to_quaternion(bases))


def measure_frames(
    cell: Cell, q: np.ndarray, seed: int | np.random.Generator = 0, file: str = "simulated", warm: float = np.inf
) -> tuple[Positions, np.ndarray | None]:
    """Return a simulated measurement of each pose in the instrument's frame, and the base LEDs measured with it.

    The instrument's drift moves both.

    Args:
        cell, q, seed, file, warm: as of `measure`.

    Returns:
        Poses or positions, and the measured base frames (m, 4, 4); None without base LEDs.
    """
    rng = np.random.default_rng(seed)
    instrument = cell.instrument
    true = true_poses(cell, q, warm=warm)
    measured = _noisy(true, instrument, rng)
    measured_bases = None
    if instrument.base_frame is not None:
        base = cell.truth.stations[0] @ instrument.base_frame
        base_poses = np.broadcast_to(base, measured.shape)
        measured_bases = _noisy(base_poses, instrument, rng)
    drift, outliers = _gross_errors(instrument, len(q), rng)
    if measured_bases is not None:
        measured_bases[:, :3, 3] += drift
    position = measured[:, :3, 3] + drift + outliers
    recorded = np.asarray(q) + rng.normal(0.0, instrument.encoder_sigma, np.shape(q))
    common: FieldValues = {
        "sigma": np.full((len(q), 3), instrument.position_sigma),
        "station": cell.truth.station_names[0],
        "tool_names": cell.truth.tool_names,
        "file": file,
    }
    joint_names = cell.nominal.joint_names
    if instrument.orientation_sigma is None:
        return Positions(recorded, joint_names, position, **common), measured_bases
    turns = Rotation.from_matrix(measured[:, :3, :3])
    quaternion = turns.as_quat(canonical=True)
    sigma_rotation = np.full((len(q), 3), instrument.orientation_sigma)
    return Poses(recorded, joint_names, position, quaternion, sigma_rotation=sigma_rotation, **common), measured_bases


def wandering(measured: Positions, drift: float, seed: int, begin: float = 0.0) -> Positions:
    """Return measured positions with an instrument drift added: `drift` [m] from `begin` (0 to 1) to the end.

    The direction follows from `seed`, so that several series can share it.
    """
    return replace(measured, position=measured.position + drift_path(len(measured), drift, seed, begin))


def drift_path(rows: int, drift: float, seed: int, begin: float = 0.0) -> np.ndarray:
    """Return the displacements (m, 3) [m] of an instrument that drifts by `drift` [m], from `begin` (0 to 1) to 1."""
    direction = np.random.default_rng([seed, 5]).standard_normal(3)
    share = np.linspace(begin, 1.0, rows)[:, None]
    return drift * share * direction / np.linalg.norm(direction)


def _noisy(poses: np.ndarray, instrument: SimulatedInstrument, rng: np.random.Generator) -> np.ndarray:
    """Return measured poses (m, 4, 4): noise along and about the instrument's axes."""
    m = len(poses)
    turn_sigma = instrument.orientation_sigma or 0.0
    rotation_vectors = rng.normal(0.0, turn_sigma, (m, 3))
    turns = Rotation.from_rotvec(rotation_vectors).as_matrix()
    shift = rng.normal(0.0, instrument.position_sigma, (m, 3))
    return pose(turns @ poses[:, :3, :3], poses[:, :3, 3] + shift)


def _gross_errors(instrument: SimulatedInstrument, m: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the position errors (m, 3) [m] of m rows from drift, and from outliers."""
    directions = rng.normal(size=(m + 1, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    drift = instrument.drift * np.linspace(0.0, 1.0, m)
    hit = rng.uniform(size=m) < instrument.outlier_share
    outliers = instrument.outlier_size * hit
    return drift[:, None] * directions[-1], outliers[:, None] * directions[:-1]


def planned_poses(folder: Path, arm: Chain) -> Iterator[tuple[int, str, np.ndarray]]:
    """Yield the pose lists planned by the session in `folder` for an arm: number, name when measured, q (m, n)."""
    joints = Joints(arm.joint_names, joint_kinds(arm))
    for number, (plan, name) in enumerate(PLANS):
        path = folder / f"2-poses/{plan}.csv"
        if path.exists():
            yield number, name, read_poses(path, joints)


def write_measured(
    measured: Positions, path: str | Path, degrees: bool = True, bases: np.ndarray | None = None
) -> Path:
    """Write poses or positions as CSV: joints in deg, positions in mm, as controllers and instruments give them.

    Args:
        measured: positions or poses of one target; every joint revolute where `degrees`.
        path: path of the file.
        degrees: False for SI units throughout.
        bases: (m, 4, 4) base frames measured with every row, in the same frame as `measured`; None without base frame.
    """
    angle = 1.0
    length = 1.0
    angle_unit = "rad"
    length_unit = "m"
    if degrees:
        angle = 180.0 / np.pi
        length = 1e3
        angle_unit = "deg"
        length_unit = "mm"
    header = [f"{name} [{angle_unit}]" for name in measured.joint_names]
    header += [f"{axis} [{length_unit}]" for axis in "xyz"]
    columns = [angle * measured.q, length * measured.position]
    if isinstance(measured, Poses):
        header += ["qx", "qy", "qz", "qw"]
        columns.append(measured.quaternion)
    if measured.sigma is not None:
        header += [f"sigma_{axis} [{length_unit}]" for axis in "xyz"]
        columns.append(length * measured.sigma)
    if isinstance(measured, Poses) and measured.sigma_rotation is not None:
        header += [f"sigma_r{axis} [rad]" for axis in "xyz"]
        columns.append(measured.sigma_rotation)
    if bases is not None:
        header += [f"base_{axis} [{length_unit}]" for axis in "xyz"]
        header += [f"base_q{axis}" for axis in "xyzw"]
        columns += [length * bases[:, :3, 3], to_quaternion(bases)]
    return files.write_numbers(path, header, np.hstack(columns))


def write_log(recording: Recording, path: str | Path, degrees: bool = True) -> Path:
    """Write a recording as CSV: ``t [s]``, ``q_joint [deg]``, ``tau_joint [Nm]`` and, for torque sensors,
    ``tau_link_joint``.

    Seven digits, as controllers log.
    """
    angle = 1.0
    angle_unit = "rad"
    if degrees:
        angle = 180.0 / np.pi
        angle_unit = "deg"
    series = [("q", angle * recording.q, angle_unit), ("tau", recording.effort, "Nm")]
    if recording.tau_link is not None:
        series.append(("tau_link", recording.tau_link, "Nm"))
    header = ["t [s]"]
    columns = [recording.t[:, None]]
    for key, values, unit in series:
        header += [f"{key}_{name} [{unit}]" for name in recording.joint_names]
        columns.append(values)
    table = np.hstack(columns)
    formats = ["%.4f"] + ["%.7g"] * (table.shape[1] - 1)
    text = io.StringIO()
    text.write(",".join(header) + "\n")
    np.savetxt(text, table, fmt=formats, delimiter=",")
    return files.write(path, text.getvalue())
