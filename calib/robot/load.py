"""Find a robot by user input: a library name, a file, or a folder with a ``robot.toml``."""

from collections.abc import Sequence
from pathlib import Path

from calib.errors import RobotError, refuse_robot, require, suggestion
from calib.robot import calibrated, description, library
from calib.robot.calibrated import CalibratedChain
from calib.robot.chain import Chain
from calib.robot.formats import urdf


def load(
    robot: str | Path, base: str | None = None, tip: str | None = None, joint_names: Sequence[str] | None = None
) -> Chain:
    """Return the chain of a robot given by name or path.

    Args:
        robot: a library name, the path of a ``.urdf`` or ``.toml`` file, or a folder that holds ``robot.toml``.
        base, tip: links of a URDF between which the arm runs.
        joint_names: the joints a measurement file names (URDF).

    Raises:
        RobotError: where nothing of this kind is found, with the library's names and the nearest one.
    """
    path = resolve(robot)
    if path.suffix == ".urdf":
        return urdf.read(path, base, tip, joint_names)
    return _check_ends(path, description.read(path), base, tip)


def _check_ends(path: Path, chain: Chain, base: str | None, tip: str | None) -> Chain:
    for option, wanted, found in (("base", base, chain.base), ("tip", tip, chain.tip)):
        if wanted is not None and wanted != found:
            refuse_robot(path, f"its {option} is '{found}', not '{wanted}'; only a URDF allows to choose base and tip")
    return chain


def load_calibrated(robot: str | Path, base: str | None = None, tip: str | None = None) -> CalibratedChain:
    """Return the calibrated robot of a name or path, with covariance and corrections; arguments as in `load`."""
    path = resolve(robot)
    if path.suffix == ".urdf":
        return CalibratedChain(load(path, base, tip), source=str(robot))
    found = calibrated.read(path)
    _check_ends(path, found.complete, base, tip)
    return found


def resolve(robot: str | Path) -> Path:
    """Return the file of a robot given by name or path; the working folder takes precedence over the library."""
    path, names = Path(robot), library.names()
    require(str(robot).strip(), f"the robot's name is empty; the library has {', '.join(names)}", RobotError)
    known = f"a path of a .urdf or .toml file, a folder with robot.toml, or one of the library: {', '.join(names)}"
    if path.is_dir():
        if (path / calibrated.ROBOT).is_file():
            return path / calibrated.ROBOT
        require(str(robot) in names, f"folder {path} has no robot.toml; give {known}", RobotError)
    elif path.is_file():
        if path.suffix in (".urdf", ".toml"):
            return path
        advice = "expand it first: xacro file.xacro > robot.urdf" if path.suffix == ".xacro" else f"give {known}"
        raise RobotError(f"{path} is neither .urdf nor .toml; {advice}")
    if str(robot) in names:
        return library.path(str(robot))
    require(path.suffix not in (".urdf", ".toml") and len(path.parts) <= 1, f"no file {path}; give {known}", RobotError)
    raise RobotError(f"no robot '{robot}'{suggestion(str(robot), names)}; give {known}")
