"""Files ``trajectory.toml`` (coefficients of an exciting motion), and detection of that motion in a log.

::

    robot = "lwr4plus"
    family = "fourier"               # q(t) = q0 + sum_k a_k sin(k w t) + b_k cos(k w t), w = 2 pi / period
    period = 20.0                    # [s]
    rate = 1000.0                    # of the controller [Hz]
    repeat = 5                       # periods that were written to run
    limits = ["velocity limits: joint_1 1.92 rad/s (robot description)", ...]
    [[joint]]
    name = "joint_1"
    kind = "revolute"                # or prismatic
    q0 = 0.1                         # [rad or m]
    a = [...]
    b = [...]

With ``family = "bspline"`` a joint has ``points``, control points of a periodic spline of ``degree`` on uniform knots.

``trajectory.csv`` is one period at that rate, ``run.csv`` the whole run with its approach: ``t [s]``, then of every
joint ``q_joint1 [rad]``, ``v_joint1 [rad/s]``, ``a_joint1 [rad/s^2]`` (of sliding joints m) and, where the model
predicts them, ``tau_joint1 [N m]``; ``motion.csv`` of `calib plan` likewise. ``arm.toml`` is the robot that it was
made for, so that `calib view` can draw it.

With ``--front`` there are ``front.csv``, a row per motion, and the motions (``front/3/trajectory.toml``);
``calib excite --pick 3``, with the options of the design, makes one of them the designed one.

``calib recall`` finds the motion in a log, cuts it to whole periods and averages them. It writes a recording of one
period that `calib identify` reads. A NumPy archive holds besides, per sample and joint, the variance of one sample over
the periods (``variance_q``, ``variance_tau``, ...), and how many ``periods`` there were: the mean's variance is that
over their number.
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import MinLen

from calib import files
from calib.config import parse, read_toml
from calib.config_types import Expect, Name, OneOf, Positive, Real, Text, Whole
from calib.data.recordings.recording import Recording
from calib.data.recordings.recording_files import read_recording
from calib.data.schema import Joints
from calib.data.signals.resampling import resample
from calib.errors import MeasurementError, UsageError, refused_as, require
from calib.folders import METRICS
from calib.records import FieldValues
from calib.result_kinds import refusal
from calib.trajectories.bspline import bspline_family
from calib.trajectories.errors import BadInput
from calib.trajectories.fourier import evaluate
from calib.trajectories.recall import Averaged, Recalled, average, find_periods
from calib.units import headings, motion_units

NAME = "trajectory.toml"
# the robot that the motion was made for
ARM = "arm.toml"
# files of setpoints: one period at the controller's rate, the whole run if it is longer, and a planned motion
SAMPLES = "trajectory.csv"
RUN = "run.csv"
PLANNED = "motion.csv"
# of a file of the averaged motion
SUFFIXES = (".npz", ".csv")
# series of a recording -> its columns
HEADERS = {"effort": "tau", "tau_link": "tau_link", "tau_motor": "tau_motor", "q_link": "q_link"}
FOURIER_NOTE = "q(t) = q0 + sum_k a_k sin(k w t) + b_k cos(k w t), w = 2 pi / period; rad, m, s"
SPLINE_NOTE = "periodic spline, uniform knots over the period; rad, m, s"

Numbers = Annotated[tuple[float, ...], Expect("a list of finite numbers")]


@dataclass(frozen=True)
class _JointTable:
    """Entry ``[[joint]]`` of ``trajectory.toml``: coefficients of one joint.

    The module's docstring explains the keys.
    """

    name: Name
    kind: Text = "revolute"
    q0: Annotated[float, Real()] | None = None
    a: Numbers | None = None
    b: Numbers | None = None
    points: Numbers | None = None


@dataclass(frozen=True)
class TrajectoryFile:
    """Content of ``trajectory.toml``; keys of the file that are not fields of this class are ignored."""

    family: Annotated[str, OneOf(("fourier", "bspline"))]
    period: Positive
    rate: Positive
    joint: Annotated[tuple[_JointTable, ...], MinLen(1)]
    repeat: Annotated[int, Whole(1)] = 1
    degree: Annotated[int, Whole(1, 20)] = 5


@dataclass(frozen=True, eq=False)
class Periodic:
    """A periodic motion, defined by the coefficients of a Fourier series or of a spline.

    Attributes:
        joint_names, kinds: (n,) names and kinds (revolute, prismatic) of the joints.
        period: duration of a period [s].
        rate: rate of the controller [Hz].
        repeat: planned number of periods.
        kind: family of motions: fourier or bspline.
        coefficients: for each joint, q0, a, b of a Fourier series, or control points of a spline [rad or m].
        degree: degree of splines.
    """

    joint_names: tuple[str, ...]
    kinds: tuple[str, ...]
    period: float
    rate: float
    repeat: int
    kind: str
    coefficients: tuple[np.ndarray, ...]
    degree: int = 5

    def orders(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions, velocities and accelerations q, v, a, each (N, n), at times (N,) [s]."""
        if self.kind == "fourier":
            q, v, a = (evaluate(self.coefficients, self.period, times, order) for order in range(3))
            return q, v, a
        point_counts = [len(points) for points in self.coefficients]
        family = bspline_family(point_counts, self.period, degree=self.degree, rest=False)
        x = family.variables(self.coefficients)
        q, v, a = (family.evaluate(x, times, order) for order in range(3))
        return q, v, a


def table(motion: Periodic, robot: str, limits: Sequence[str]) -> dict[str, object]:
    """Return the content of ``trajectory.toml`` for a motion.

    Args:
        motion: the motion.
        robot: name of the robot.
        limits: lines of text on the limits of the motion.
    """
    fourier = motion.kind == "fourier"
    content: dict[str, object] = {
        "robot": robot,
        "family": motion.kind,
        "period": motion.period,
        "rate": motion.rate,
        "repeat": motion.repeat,
        "note": FOURIER_NOTE if fourier else SPLINE_NOTE,
        "limits": list(limits),
    }
    if not fourier:
        content["degree"] = motion.degree
    joints = []
    for name, kind, values in zip(motion.joint_names, motion.kinds, motion.coefficients):
        joint: dict[str, object] = {"name": name, "kind": kind}
        if fourier:
            half = len(values) // 2
            joint |= {"q0": values[0], "a": values[1 : 1 + half], "b": values[1 + half :]}
        else:
            joint["points"] = values
        joints.append(joint)
    content["joint"] = joints
    return content


def read(folder: Path) -> Periodic:
    """Return the periodic motion in a folder that `calib excite` wrote.

    Raises:
        UsageError: if the file is missing or damaged.
    """
    path = folder / NAME
    require(path.is_file(), refusal(folder, "recall"), UsageError)
    content = parse(TrajectoryFile, read_toml(path), str(path))
    if content.family == "bspline":
        coefficients = _spline_points(content, path)
    else:
        coefficients = _fourier_coefficients(content, path)
    motion = Periodic(
        joint_names=tuple(joint.name for joint in content.joint),
        kinds=tuple(joint.kind for joint in content.joint),
        period=content.period,
        rate=content.rate,
        repeat=content.repeat,
        kind=content.family,
        coefficients=tuple(coefficients),
        degree=content.degree,
    )
    damaged = f"{path} is damaged ({{}}); write it again with calib excite"
    with refused_as(UsageError, (ValueError, IndexError, BadInput), damaged):
        motion.orders(np.zeros(1))
    return motion


def _spline_points(content: TrajectoryFile, path: Path) -> list[np.ndarray]:
    """Return the control points of each joint's spline.

    Args:
        content: content of ``trajectory.toml``.
        path: the file, for messages.

    Raises:
        UsageError: for a joint without control points.
    """
    coefficients = []
    for number, joint in enumerate(content.joint, 1):
        if joint.points is None:
            raise UsageError(f"{path}: [[joint]] number {number}: family bspline needs points")
        coefficients.append(np.array(joint.points, dtype=float))
    return coefficients


def _fourier_coefficients(content: TrajectoryFile, path: Path) -> list[np.ndarray]:
    """Return [q0, a, b] of each joint as one array; only [q0] for a locked joint.

    Args:
        content: content of ``trajectory.toml``.
        path: the file, for messages.

    Raises:
        UsageError: for a joint with another number of harmonics.
    """
    count = max(len(joint.a or ()) for joint in content.joint)
    coefficients = []
    for number, joint in enumerate(content.joint, 1):
        where = f"{path}: [[joint]] number {number}"
        if joint.q0 is None or joint.a is None or joint.b is None:
            raise UsageError(f"{where}: family fourier needs q0, a and b")
        if not len(joint.a) == len(joint.b) or len(joint.a) not in (0, count):
            raise UsageError(f"{where}: a and b need {count} values each, as many as those of the other joints")
        coefficients.append(np.array([joint.q0, *joint.a, *joint.b], dtype=float))
    return coefficients


@dataclass(frozen=True, eq=False)
class AveragedMotion:
    """A designed motion found in a log and averaged over its periods.

    Attributes:
        motion: the designed motion.
        file: the log.
        found: samples of the log that contain the motion.
        averages: series of the recording (q, effort, v, ...) -> mean and variance over the periods.
        kind: kind of the effort: torque or current.
        rate: sampling rate [Hz]; a period has a whole number of samples.
        following: (n,) rms of measured minus commanded positions, after the best shift by whole samples [rad or m].
    """

    motion: Periodic
    file: str
    found: Recalled
    averages: dict[str, Averaged]
    kind: str
    rate: float
    following: np.ndarray


def inputs(folder: Path, log: str) -> list[str | Path]:
    """Return the files and folders that `find` reads, which no output may overwrite.

    Args:
        folder: folder of the designed motion.
        log: the recording.
    """
    return [folder, folder / NAME, folder / METRICS, log]


def find(folder: Path, log: str, skip: int = 0) -> AveragedMotion:
    """Return the designed motion of a folder, located in a log and averaged over its periods.

    Args:
        folder: folder that `calib excite` wrote.
        log: a recording, with an optional cut (``log.npz@0:90``).
        skip: number of whole periods to omit at the beginning, such as transients or warming up.

    Raises:
        UsageError, MeasurementError: for an unreadable folder or log, and if the log does not contain the motion.
    """
    require(skip >= 0, f"--skip {skip}: expected a number of periods, 0 or more", UsageError)
    motion = read(folder)
    recording = read_recording(log, Joints(motion.joint_names))
    rate, series = _longest(recording, motion.period)
    count = round(motion.period * rate)
    reference = motion.orders(np.arange(count) / rate)[0]
    with refused_as(MeasurementError, BadInput, "{}", recording.file):
        recalled = find_periods(series["q"], reference, skip)
        averages = {}
        for name, values in series.items():
            if np.isfinite(values).all():
                averages[name] = average(values, recalled)
    error = averages["q"].mean - reference
    return AveragedMotion(
        motion=motion,
        file=recording.file,
        found=recalled,
        averages=averages,
        kind=recording.kind,
        rate=rate,
        following=np.sqrt(np.mean(error**2, axis=0)),
    )


def write(averaged: AveragedMotion, out: Path) -> Path:
    """Write one averaged period as a recording, and return the path.

    Args:
        averaged: the averaged motion.
        out: a CSV file, or a NumPy archive, which also contains the variances.
    """
    averages, motion = averaged.averages, averaged.motion
    letters = HEADERS | {"q": "q", "v": "v", "effort": "tau" if averaged.kind == "torque" else "current"}
    t = np.arange(averaged.found.period) / averaged.rate
    if out.suffix == ".csv":
        joints = [_JointTable(name, kind) for name, kind in zip(motion.joint_names, motion.kinds)]
        header = ["t [s]"]
        for name in averages:
            header += headings(letters[name], joints)
        means = [series.mean for series in averages.values()]
        return files.write_numbers(out, header, np.column_stack([t, *means]))
    arrays: FieldValues = {letters[name]: series.mean for name, series in averages.items()}
    for name, series in averages.items():
        arrays[f"variance_{letters[name]}"] = series.variance
    arrays["t"] = t
    arrays["joint_names"] = np.array(motion.joint_names)
    arrays["periods"] = np.array(averaged.found.periods)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return files.write(out, buffer.getvalue())


def lines(averaged: AveragedMotion) -> list[str]:
    """Return the lines that `calib recall` prints: number of periods, their agreement, and noise of each joint.

    Args:
        averaged: the averaged motion.
    """
    recalled, averages, motion = averaged.found, averaged.averages, averaged.motion
    start = recalled.start / averaged.rate
    unit = motion_units(motion.kinds)[0]
    effort_unit = "N m" if averaged.kind == "torque" else "A"
    lines = [
        f"{recalled.periods} whole periods of {motion.period:g} s in {averaged.file}, from {start:.3f} s "
        f"on; each matches at least {min(recalled.likeness):.2%} of the motion",
        f"{'joint':14} {f'off by [{unit}]':>14} {f'noise [{unit}]':>12} {f'noise [{effort_unit}]':>14} "
        f"{'of the mean':>12}",
    ]
    q_noise = np.sqrt(averages["q"].pooled)
    effort_noise = np.sqrt(averages["effort"].pooled)
    for name, following, noise, effort in zip(motion.joint_names, averaged.following, q_noise, effort_noise):
        of_mean = effort / np.sqrt(recalled.periods)
        lines.append(f"{name:14} {following:14.3g} {noise:12.3g} {effort:14.3g} {of_mean:12.3g}")
    return lines


def _longest(recording: Recording, period: float) -> tuple[float, dict[str, np.ndarray]]:
    """Return sampling rate [Hz] and series of a recording's longest part without gaps.

    The recording is resampled so that one period of the motion has a whole number of samples.

    Args:
        recording: the recording.
        period: period of the motion [s].
    """
    recorded_rate = 1.0 / float(np.median(np.diff(recording.t)))
    rate = max(1, round(period * recorded_rate)) / period
    sampled = resample(recording, rate=rate)
    longest = int(np.bincount(sampled.segment).argmax())
    rows = sampled.segment == longest
    return rate, {name: values[rows] for name, values in sampled.series.items()}
