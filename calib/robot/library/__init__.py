"""Robots by name or path: a robot of the library (one TOML file each), a file, or a folder with ``robot.toml``."""

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
    files = [entry.name for entry in resources.files(__name__).iterdir()]
    robots = [name.removesuffix(".toml") for name in files if name.endswith(".toml") and "_truth" not in name]
    return tuple(sorted(robots))


def path(name: str) -> Path:
    """Return the path of a library robot's file, or of its simulated true parameters (``lwr4plus_truth``).

    Args:
        name: name of a library robot; with the suffix ``_truth`` the true parameters.
    """
    return Path(str(resources.files(__name__).joinpath(f"{name}.toml")))


def load(
    robot: str | Path, base: str | None = None, tip: str | None = None, joint_names: Sequence[str] | None = None
) -> Chain:
    """Return the chain of a robot given by name or path; the log states where a URDF's arm ends, and why.

    Args:
        robot: a library name, the path of a ``.urdf``, ``.urdf.xacro``, MJCF or ``.toml`` file, or a folder with
            ``robot.toml``.
        base, tip: names of the links of a URDF between which the arm is; None: chosen from the tree.
        joint_names: joints named in a measurement file, which select the chain of a URDF; None to select it from the
            tree.

    Raises:
        RobotError: no such robot is found; the message lists the library's names and the most similar one.
    """
    path = resolve(robot)
    if is_urdf(path):
        chain = urdf.read(path, base, tip, joint_names)
        LOG.info("%s: the arm ends at %s", chain.name, chain.ends)
        return chain
    return _check_ends(path, description.read(path), base, tip)


def _check_ends(path: Path, chain: Chain, base: str | None, tip: str | None) -> Chain:
    for option, link, chain_link in (("base", base, chain.base), ("tip", tip, chain.tip)):
        if link is not None and link != chain_link:
            refuse_robot(
                path, f"its {option} is '{chain_link}', not '{link}'; only a URDF allows to choose base and tip"
            )
    return chain


def load_calibrated(robot: str | Path, base: str | None = None, tip: str | None = None) -> CalibratedChain:
    """Return the calibrated robot for a name or path, with covariance and corrections if it was fitted.

    Args:
        robot: a library name, or a path, as in `load`.
        base, tip: names of the links of a URDF between which the arm is; None: chosen from the tree.
    """
    path = resolve(robot)
    if is_urdf(path):
        return CalibratedChain(load(path, base, tip), source=str(robot))
    calibrated_robot = calibrated.read(path)
    _check_ends(path, calibrated_robot.complete, base, tip)
    return calibrated_robot


def resolve(robot: str | Path) -> Path:
    """Return the file of a robot given by name or path; files in the working folder precede the library."""
    location = Path(robot)
    library = names()
    require(str(robot).strip(), f"the robot's name is empty; the library has {', '.join(library)}", RobotError)
    choices = (
        "a path of a .urdf, .urdf.xacro, MJCF (.xml) or .toml file, a folder with robot.toml, or one of the library: "
        f"{', '.join(library)}"
    )
    if location.is_dir():
        if (location / calibrated.ROBOT).is_file():
            return location / calibrated.ROBOT
        require(
            str(robot) in library, f"{refusal(location, 'robot')}; the library has {', '.join(library)}", RobotError
        )
    elif location.is_file() or converter(location):
        is_robot = location.suffix == ".toml" or is_urdf(location)
        require(is_robot, f"{location} is no robot file; give {choices}", RobotError)
        return location
    if str(robot) in library:
        return path(str(robot))
    if location.suffix in (".urdf", ".toml", ".xacro", ".xml") or len(location.parts) > 1:
        raise RobotError(f"no file {location}; give {choices}")
    raise RobotError(f"no robot '{robot}'{suggestion(str(robot), library)}; give {choices}")
