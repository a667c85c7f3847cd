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

``calib recall`` finds the motion in a log, cuts it to whole periods and averages them. It writes a recording of one
period that `calib identify` reads. A NumPy archive holds besides, per sample and joint, the variance of one sample over
the periods (``variance_q``, ``variance_tau``, ...), and how many ``periods`` there were: the mean's variance is that
over their number.
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

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
from calib.result_kinds import refusal
from calib.units import headings, motion_units
from trajectories.bspline import bspline_family
from trajectories.errors import BadInput
from trajectories.fourier import evaluate
from trajectories.recall import Averaged, Recalled, average, find_periods

NAME = "trajectory.toml"
ARM = "arm.toml"  # the robot that the motion was made for
SAMPLES, RUN, PLANNED = "trajectory.csv", "run.csv", "motion.csv"
"""Files of setpoints: one period at the controller's rate, the whole run if it is longer, and a planned motion."""


Numbers = Annotated[tuple[float, ...], Expect("a list of finite numbers")]


@dataclass(frozen=True)
class _JointTable:
    """Entry ``[[joint]]`` of ``trajectory.toml``: a joint's coefficients, see the module."""

    name: Name
    kind: Text = "revolute"
    q0: Annotated[float, Real()] | None = None
    a: Numbers | None = None
    b: Numbers | None = None
    points: Numbers | None = None


@dataclass(frozen=True)
class TrajectoryFile:
    """Content of ``trajectory.toml``; keys that are not fields here are ignored."""

    family: Annotated[str, OneOf(("fourier", "bspline"))]
    period: Positive
    rate: Positive
    joint: Annotated[tuple[_JointTable, ...], MinLen(1)]
    repeat: Annotated[int, Whole(1)] = 1
    degree: Annotated[int, Whole(1, 20)] = 5


@dataclass(frozen=True, eq=False)
class Periodic:
    """A periodic motion, defined by its coefficients: eq. 23 of Kolyubin et al. 2019, or control points.

    Attributes:
        joint_names, kinds: n names, and types (revolute, prismatic).
        period: [s]; rate: of the controller [Hz]; repeat: periods that were to be run.
        kind: of the family; coefficients: per joint; degree: of splines.
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
        """Return positions, velocities and accelerations q, v, a (N, n) at times [s]."""
        if self.kind == "fourier":
            q, v, a = (evaluate(self.coefficients, self.period, times, order) for order in range(3))
            return q, v, a
        family = bspline_family([len(c) for c in self.coefficients], self.period, degree=self.degree, rest=False)
        x = family.variables(self.coefficients)
        q, v, a = (family.evaluate(x, times, order) for order in range(3))
        return q, v, a


def table(motion: Periodic, robot: str, limits: Sequence[str]) -> dict[str, Any]:
    """Return the content of ``trajectory.toml`` for a motion; `limits`: text lines on its limits."""
    fourier = motion.kind == "fourier"
    head: dict[str, Any] = {
        "robot": robot,
        "family": motion.kind,
        "period": motion.period,
        "rate": motion.rate,
        "repeat": motion.repeat,
        "note": "q(t) = q0 + sum_k a_k sin(k w t) + b_k cos(k w t), w = 2 pi / period; rad, m, s"
        if fourier
        else "periodic spline, uniform knots over the period; rad, m, s",
        "limits": list(limits),
    }
    joints = []
    for name, kind, c in zip(motion.joint_names, motion.kinds, motion.coefficients):
        half = len(c) // 2
        series = {"q0": c[0], "a": c[1 : 1 + half], "b": c[1 + half :]} if fourier else {"points": c}
        joints.append({"name": name, "kind": kind, **series})
    return head | ({} if fourier else {"degree": motion.degree}) | {"joint": joints}


def read(folder: Path) -> Periodic:
    """Return the periodic motion stored in a folder of `calib excite`.

    Raises:
        UsageError: if the file is missing or damaged.
    """
    path = folder / NAME
    require(path.is_file(), refusal(folder, "recall"), UsageError)
    table = parse(TrajectoryFile, read_toml(path), str(path))
    coefficients = []
    for number, joint in enumerate(table.joint, 1):
        place = f"{path}: [[joint]] number {number}"
        stated = (joint.points,) if table.family == "bspline" else ((joint.q0,), joint.a, joint.b)
        parts = [part for part in stated if part is not None and None not in part]
        if len(parts) < len(stated):
            raise UsageError(f"{place}: family {table.family} needs {'points' if len(stated) == 1 else 'q0, a and b'}")
        if len(parts) == 3 and not len(parts[1]) == len(parts[2]) == len(table.joint[0].a or ()):
            raise UsageError(f"{place}: a and b need {len(table.joint[0].a or ())} values each, as many as joint 1's a")
        coefficients.append(np.concatenate([np.array(part, dtype=float) for part in parts]))
    found = Periodic(
        tuple(joint.name for joint in table.joint),
        tuple(joint.kind for joint in table.joint),
        table.period,
        table.rate,
        table.repeat,
        table.family,
        tuple(coefficients),
        table.degree,
    )
    damage, words = (ValueError, IndexError, BadInput), f"{path} is damaged ({{}}); write it again with calib excite"
    with refused_as(UsageError, damage, words):
        found.orders(np.zeros(1))
    return found


SUFFIXES = (".npz", ".csv")
HEADERS = {"effort": "tau", "tau_link": "tau_link", "tau_motor": "tau_motor", "q_link": "q_link"}


@dataclass(frozen=True, eq=False)
class AveragedMotion:
    """Average of the periods of a designed motion in a log.

    Attributes:
        motion: that was looked for; file: the log.
        found: where it was.
        averages: series of the recording (q, effort, v, ...) → mean and variance over the periods.
        kind: of the effort, torque or current.
        rate: [Hz]; a period holds a whole number of samples.
        following: (n,) rms of measured minus commanded positions, after the best shift of whole samples [rad or m].
    """

    motion: Periodic
    file: str
    found: Recalled
    averages: dict[str, Averaged]
    kind: str
    rate: float
    following: np.ndarray


def inputs(folder: Path, log: str) -> list[str | Path]:
    """Return the files that `find` reads; no output may overwrite them."""
    return [folder, folder / NAME, folder / METRICS, log]


def find(folder: Path, log: str, skip: int = 0) -> AveragedMotion:
    """Return the motion designed in `folder`, located in a log and averaged over its periods.

    Args:
        log: a recording, with a cut if wanted (``log.npz@0:90``).
        skip: whole periods to leave out at the beginning: transients, a robot that warms up.

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
        found = find_periods(series["q"], reference, skip)
        averages = {name: average(values, found) for name, values in series.items() if np.isfinite(values).all()}
    error = averages["q"].mean - reference
    return AveragedMotion(
        motion, recording.file, found, averages, recording.kind, rate, np.sqrt(np.mean(error**2, axis=0))
    )


def write(averaged: AveragedMotion, out: Path) -> Path:
    """Write one averaged period as a recording: CSV, or an archive with variances."""
    averages, names = averaged.averages, averaged.motion.joint_names
    called = HEADERS | {"q": "q", "v": "v", "effort": "tau" if averaged.kind == "torque" else "current"}
    t = np.arange(averaged.found.period) / averaged.rate
    if out.suffix == ".csv":
        joints = [_JointTable(name, kind) for name, kind in zip(names, averaged.motion.kinds)]
        header = ["t [s]", *(title for name in averages for title in headings(called[name], joints))]
        table = np.column_stack([t, *(one.mean for one in averages.values())])
        return files.write_numbers(out, header, table)
    arrays = {called[name]: one.mean for name, one in averages.items()}
    arrays |= {f"variance_{called[name]}": one.variance for name, one in averages.items()}
    buffer = io.BytesIO()
    arrays |= {"t": t, "joint_names": np.array(names), "periods": np.array(averaged.found.periods)}
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    return files.write(out, buffer.getvalue())


def lines(averaged: AveragedMotion) -> list[str]:
    """Return the lines that `calib recall` prints: periods, their agreement, noise of each joint."""
    found, averages = averaged.found, averaged.averages
    start = found.start / averaged.rate
    place, unit = motion_units(averaged.motion.kinds)[0], "N m" if averaged.kind == "torque" else "A"
    result = [
        f"{found.periods} whole periods of {averaged.motion.period:g} s in {averaged.file}, from {start:.3f} s "
        f"on; each matches at least {min(found.likeness):.2%} of the motion",
        f"{'joint':14} {f'off by [{place}]':>14} {f'noise [{place}]':>12} {f'noise [{unit}]':>14} {'of the mean':>12}",
    ]
    noise, effort = np.sqrt(averages["q"].pooled), np.sqrt(averages["effort"].pooled)
    rows = zip(averaged.motion.joint_names, averaged.following, noise, effort)
    for name, following, one, two in rows:
        result.append(f"{name:14} {following:14.3g} {one:12.3g} {two:14.3g} {two / np.sqrt(found.periods):12.3g}")
    return result


def _longest(recording: Recording, period: float) -> tuple[float, dict[str, np.ndarray]]:
    """Return rate and series of the longest part without gaps, with a whole number of samples per period."""
    recorded_rate = 1.0 / float(np.median(np.diff(recording.t)))
    rate = max(1, round(period * recorded_rate)) / period
    sampled = resample(recording, rate=rate)
    longest = int(np.bincount(sampled.segment).argmax())
    rows = sampled.segment == longest
    return rate, {name: values[rows] for name, values in sampled.series.items()}
