"""Find a designed motion in a log, cut it to whole periods, and average them: mean and variance over the periods.

What is written is a recording of one period that `calib identify` reads. A NumPy archive holds besides, per sample and
joint, the variance of one sample over the periods (``variance_q``, ``variance_tau``, ...), and how many ``periods``
there were: the mean's variance is that over their number.
"""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib import files
from calib.data.recordings.recording import Recording
from calib.data.recordings.recording_files import read_recording
from calib.data.schema import Joints
from calib.data.signals.resampling import resample
from calib.errors import MeasurementError, UsageError, require
from calib.folders import METRICS
from calib.procedure.excitation import coefficients
from calib.procedure.excitation.coefficients import Periodic
from trajectories.errors import BadInput
from trajectories.recall import Averaged, Recalled, average, find_periods

SUFFIXES = (".npz", ".csv")
HEADERS = {"effort": "tau", "tau_link": "tau_link", "tau_motor": "tau_motor", "q_link": "q_link"}


@dataclass(frozen=True, eq=False)
class AveragedMotion:
    """Periods of a motion in a log, averaged.

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
    """Return the input files of `find`, which outputs must not overwrite."""
    return [folder, folder / coefficients.NAME, folder / METRICS, log]


def find(folder: Path, log: str, skip: int = 0) -> AveragedMotion:
    """Return the motion designed in `folder`, located in a log and averaged over its periods.

    Args:
        log: a recording, with a cut if wanted (``log.npz@0:90``).
        skip: whole periods to leave out at the beginning: transients, a robot that warms up.

    Raises:
        UsageError, MeasurementError: for an unreadable folder or log, and if the log does not contain the motion.
    """
    require(skip >= 0, f"--skip {skip}: expected a number of periods, 0 or more", UsageError)
    motion = coefficients.read(folder)
    recording = read_recording(log, Joints(motion.joint_names))
    rate, series = _longest(recording, motion.period)
    count = round(motion.period * rate)
    reference = motion.orders(np.arange(count) / rate)[0]
    try:
        found = find_periods(series["q"], reference, skip)
        averages = {name: average(values, found) for name, values in series.items() if np.isfinite(values).all()}
    except BadInput as error:
        raise MeasurementError(str(error), recording.file) from error
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
        header = ["t", *(f"{called[name]}{j + 1}" for name in averages for j in range(len(names)))]
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
    unit = "N m" if averaged.kind == "torque" else "A"
    result = [
        f"{found.periods} whole periods of {averaged.motion.period:g} s in {averaged.file}, from {start:.3f} s "
        f"on; each matches at least {min(found.likeness):.2%} of the motion",
        f"{'joint':14} {'off command':>14} {'noise of q':>12} {f'noise of {unit}':>14} {'of the mean':>12}",
    ]
    noise, effort = np.sqrt(averages["q"].pooled), np.sqrt(averages["effort"].pooled)
    rows = zip(averaged.motion.joint_names, averaged.following, noise, effort)
    for name, following, one, two in rows:
        result.append(f"{name:14} {following:14.3g} {one:12.3g} {two:14.3g} {two / np.sqrt(found.periods):12.3g}")
    return result


def _longest(recording: Recording, period: float) -> tuple[float, dict[str, np.ndarray]]:
    """Return the longest part without gaps, resampled to a whole number of samples per period."""
    own = 1.0 / float(np.median(np.diff(recording.t)))
    rate = max(1, round(period * own)) / period
    sampled = resample(recording, rate=rate)
    longest = int(np.bincount(sampled.segment).argmax())
    rows = sampled.segment == longest
    return rate, {name: values[rows] for name, values in sampled.series.items()}
