"""Reader of robot descriptions that are converted to a URDF when read; the converter is chosen by the file's suffix."""

from functools import lru_cache
from pathlib import Path

from calib.robot.descriptions.xacro_arguments import split

SUFFIXES = (".xacro", ".xml", ".mjcf", ".conf")


def takes(path: str) -> bool:
    """Return whether `urdf` can convert the file at `path`, and the file exists."""
    file = Path(split(path)[0])
    return file.suffix in SUFFIXES and file.is_file()


def urdf(path: str) -> str:
    """Return the URDF text for the file at `path`; the path may be followed by arguments.

    Args:
        path: the file; for a xacro file or a ``calibration.conf``, arguments ``name:=value`` may follow.

    Raises:
        RobotError: a file that cannot be converted.
    """
    return _converted(path, Path(split(path)[0]).stat().st_mtime_ns)


@lru_cache(maxsize=8)  # one command reads its robot's file several times
def _converted(path: str, changed: int) -> str:
    # Converters are slow to load, and few robots need one.
    suffix = Path(split(path)[0]).suffix
    if suffix == ".xacro":
        from calib.robot.descriptions.xacro_files import expand as convert
    elif suffix == ".conf":
        from calib.robot.descriptions.ur_calibration import convert
    else:
        from calib.robot.descriptions.mjcf import convert
    return convert(path)
