"""References in files of their own: stamps and the positions that were asked for, in a table or an archive.

Names are those of recordings (`recording_options`): t, and q_ref (or, without one, q); other columns are not looked at.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from calib.arrays import frozen
from calib.data.recordings.archives import read_archived_positions
from calib.data.recordings.csv_logs import read_positions
from calib.data.recordings.recording import Joints
from calib.data.recordings.recording_options import RecordingOptions
from calib.data.signals.motion import Motion
from calib.errors import MeasurementError, refuse_data, refused_as
from calib.files import check_regular


def with_reference(motion: Motion, path: Path, joints: Joints, options: RecordingOptions) -> Motion:
    """Return the motion with the reference that the file at `path` holds, at the motion's instants.

    Both files count time from their first sample.

    Raises:
        MeasurementError: where the file is none, has other joints, or does not span the motion.
    """
    with refused_as(MeasurementError, OSError, "cannot be read: {}", path):
        check_regular(path)
        with open(path, "rb") as file:
            read = read_archived_positions if file.read(2) == b"PK" else read_positions
    t, q = read(path, joints, options)
    if q.shape[1:] != (motion.n,):
        refuse_data(path, f"has {q.shape[1]} joints, the recording {motion.n}")
    if len(t) < 10 or not np.isfinite(q).all() or not (np.diff(t) > 0.0).all():
        refuse_data(path, "a reference needs ten samples or more, numbers throughout and rising stamps")
    slack = 1.5 * float(np.median(np.diff(t)))
    if motion.t[0] < t[0] - slack or motion.t[-1] > t[-1] + slack:
        message = (
            f"{len(t)} samples from {t[0]:.6g} s to {t[-1]:.6g} s do not span the recording {motion.file}, which is "
            f"used from {motion.t[0]:.6g} s to {motion.t[-1]:.6g} s: both count from their first sample"
        )
        refuse_data(path, message)
    return replace(motion, q_ref=frozen(CubicSpline(t, q)(np.clip(motion.t, t[0], t[-1]))))
