"""References in files of their own: stamps and the positions that were asked for, in a table or an archive.

Names are those of recordings (`recording_options`): t, and q_ref (or, without one, q); other columns are not looked at.
"""

import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from calib.arrays import frozen
from calib.data.recordings.csv_logs import read_positions
from calib.data.recordings.recording import Joints
from calib.data.recordings.recording_options import SYNONYMS, RecordingOptions, joint_order, scale
from calib.data.signals.motion import Motion
from calib.errors import MeasurementError, refuse_data, refused_as
from calib.files import check_regular


def with_reference(motion: Motion, path: Path, joints: Joints, options: RecordingOptions) -> Motion:
    """Return the motion with the reference that the file at `path` holds, at the motion's instants.

    Both files count time from their first sample.

    Raises:
        MeasurementError: where the file is none, has other joints, or does not span the motion.
    """
    t, q = _archive(path, joints, options) if _is_archive(path) else read_positions(path, joints, options)
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


def _is_archive(path: Path) -> bool:
    with refused_as(MeasurementError, OSError, "cannot be read: {}", path):
        check_regular(path)
        with open(path, "rb") as file:
            return file.read(2) == b"PK"


def _archive(path: Path, joints: Joints, options: RecordingOptions) -> tuple[np.ndarray, np.ndarray]:
    with (
        refused_as(
            MeasurementError, (ValueError, OSError, zipfile.BadZipFile), "is no archive of plain arrays ({})", path
        ),
        np.load(path, allow_pickle=False) as archive,
    ):
        members = {name: archive[name] for name in archive.files}
    name = {
        ours: options.names.get(ours) or next((one for one in SYNONYMS[ours] if one in members), "")
        for ours in ("t", "q_ref", "q")
    }
    asked = "q_ref" if name["q_ref"] in members else "q"
    if name[asked] not in members or (name["t"] not in members and not options.rate):
        refuse_data(path, f"a reference needs t and q_ref (or q); found: {', '.join(members)}")
    q = np.asarray(members[name[asked]], dtype=float) * scale(asked, options.units.get(asked, ""))
    if q.ndim != 2:
        refuse_data(path, f"has shape {q.shape}, expected (samples, joints)", name[asked])
    order = joint_order([str(one) for one in members.get("joint_names", ())], joints, q.shape[1], path)[0]
    if name["t"] not in members:
        return np.arange(len(q)) / float(options.rate or 1.0), q[:, order]
    t = np.asarray(members[name["t"]], dtype=float).ravel() * scale("t", options.units.get("t", ""))
    if len(t) != len(q):
        refuse_data(path, f"has {len(t)} stamps where {name[asked]} has {len(q)} samples", name["t"])
    return t - t[0], q[:, order]
