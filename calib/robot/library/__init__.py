"""Robots by what a user names: one of the library (a TOML file each), a file, or a folder with a ``robot.toml``."""

import logging
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

from calib.errors import RobotError, refuse_robot, require, suggestion
from calib.result_kinds import refusal
from calib.robot import calibrated, description
from calib.robot.calibrated import CalibratedChain
from calib.robot.chain import Chain
from calib.robot.formats import urdf
from calib.robot.formats.urdf_tree import converter, is_urdf

LOG = logging.getLogger(__name__)


def names() -> tuple[str, ...]:
    """Return the names of the robots in the library."""
    files = (entry.name for entry in resources.files(__name__).iterdir())
    return tuple(
        sorted(name.removesuffix(".toml") for name in files if name.endswith(".toml") and "_truth" not in name)
    )


def path(name: str) -> Path:
    """Return the path of the file of a library robot, or of its simulated truth (``lwr4plus_truth``)."""
    return Path(str(resources.files(__name__).joinpath(f"{name}.toml")))


def load(
    robot: str | Path, base: str | None = None, tip: str | None = None, joint_names: Sequence[str] | None = None
) -> Chain:
    """Return the chain of a robot given by name or path; the log says where a URDF's arm ends, and why.

    Args:
        robot: a library name, the path of a ``.urdf``, ``.urdf.xacro``, MJCF or ``.toml`` file, or a folder that holds
            ``robot.toml``.
        base, tip: links of a URDF between which the arm runs.
        joint_names: the joints a measurement file names (URDF).

    Raises:
        RobotError: where nothing of this kind is found, with the library's names and the nearest one.
    """
    path = resolve(robot)
    if is_urdf(path):
        chain = urdf.read(path, base, tip, joint_names)
        LOG.info("%s: the arm ends at %s", chain.name, chain.ends)
        return chain
    return _check_ends(path, description.read(path), base, tip)


def _check_ends(path: Path, chain: Chain, base: str | None, tip: str | None) -> Chain:
    for option, given, found in (("base", base, chain.base), ("tip", tip, chain.tip)):
        if given is not None and given != found:
            refuse_robot(path, f"its {option} is '{found}', not '{given}'; only a URDF allows to choose base and tip")
    return chain


def load_calibrated(robot: str | Path, base: str | None = None, tip: str | None = None) -> CalibratedChain:
    """Return the calibrated robot of a name or path, with covariance and corrections; arguments as in `load`."""
    path = resolve(robot)
    if is_urdf(path):
        return CalibratedChain(load(path, base, tip), source=str(robot))
    found = calibrated.read(path)
    _check_ends(path, found.complete, base, tip)
    return found


def resolve(robot: str | Path) -> Path:
    """Return the file of a robot given by name or path; the working folder takes precedence over the library."""
    place, listed = Path(robot), names()
    require(str(robot).strip(), f"the robot's name is empty; the library has {', '.join(listed)}", RobotError)
    known = (
        "a path of a .urdf, .urdf.xacro, MJCF (.xml) or .toml file, a folder with robot.toml, or one of the library: "
        f"{', '.join(listed)}"
    )
    if place.is_dir():
        if (place / calibrated.ROBOT).is_file():
            return place / calibrated.ROBOT
        require(str(robot) in listed, f"{refusal(place, 'robot')}; the library has {', '.join(listed)}", RobotError)
    elif place.is_file() or converter(place):
        require(place.suffix == ".toml" or is_urdf(place), f"{place} is no robot file; give {known}", RobotError)
        return place
    if str(robot) in listed:
        return path(str(robot))
    a_path = place.suffix in (".urdf", ".toml", ".xacro", ".xml") or len(place.parts) > 1
    what = f"no file {place}" if a_path else f"no robot '{robot}'{suggestion(str(robot), listed)}"
    raise RobotError(f"{what}; give {known}")
