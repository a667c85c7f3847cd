"""Recordings from files: NumPy archives, CSV tables or ROS bags, recognised by their first bytes."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from calib.data.recordings.archives import Ends, read_archive
from calib.data.recordings.bags import read_bag
from calib.data.recordings.checks import check_recording
from calib.data.recordings.csv_logs import read_log
from calib.data.recordings.recording import Joints, Recording, earlier, parse_cut
from calib.data.recordings.recording_options import RecordingOptions, check_units
from calib.errors import MeasurementError, refuse_data
from calib.files import check_regular

Reader = Callable[[Path, Joints | None, RecordingOptions], Recording]


def read_recording(
    path: str | Path, joints: Joints | None = None, options: RecordingOptions | None = None
) -> Recording:
    """Return the checked recording at `path`, which may be cut in time (``log.npz@0:9.4``).

    Args:
        joints: the robot's; columns are put in their order if the file names its joints.

    Raises:
        MeasurementError: where the file cannot be what it should be; with row and column.
        UsageError: for an invalid cut.
    """
    file, start, stop = parse_cut(str(path))
    options = options or RecordingOptions()
    for name, unit in options.units.items():
        check_units(name, [unit] * len(joints.names if joints else ()), joints, file)
    recording = _reader(Path(file), (start, stop))(Path(file), joints, options)
    if (start, stop) != (None, None):
        recording = recording.cut(start, stop)
    if joints is not None:
        _check_names(recording, joints)
    return check_recording(earlier(recording, options.lag), joints)


def _check_names(recording: Recording, joints: Joints) -> None:
    """Refuse a recording whose number of joints differs from the robot's."""
    if recording.n != len(joints.names):
        message = (
            f"has {recording.n} joints ({', '.join(recording.joint_names)}), the robot has {len(joints.names)} "
            f"({', '.join(joints.names)}): is this another robot's recording?"
        )
        refuse_data(recording.file, message)


def _reader(path: Path, ends: Ends) -> Reader:
    """Return the reader for a path, chosen by the file's first bytes or suffix; a folder is a bag."""
    try:
        if path.exists():
            check_regular(path)
        if path.is_dir() or path.suffix in (".bag", ".mcap", ".db3"):
            return read_bag
        with open(path, "rb") as file:
            head = file.read(1 << 16)
    except OSError as error:
        hint = "; write a cut as log.npz@0:9.4, in seconds" if "@" in path.name else ""
        raise MeasurementError(f"cannot be read: {error.strerror}{hint}", path) from error
    if head[:2] == b"PK":
        return partial(read_archive, ends=ends)  # other rows are not kept
    if head and path.suffix == ".npz":
        refuse_data(path, "is not a NumPy archive despite its name: was it written by np.savez?")
    if not head or b"\0" in head:
        found = "is empty" if not head else "is neither a NumPy archive, a bag nor text"
        refuse_data(path, f"{found}: expected .npz, .csv, .mcap, .bag or a ROS 2 bag's folder")
    if len(head) == 1 << 16 and b"\n" not in head:
        refuse_data(path, "has a first line of more than 64 kB: not a table")
    return read_log
