"""Xacro files, expanded by the xacro package of ROS wherever a URDF is taken.

Arguments follow the file as they do on the command line of xacro, all in quotes::

    calib fit "ur.urdf.xacro ur_type:=ur5e name:=ur" measured.csv --out fit

``$(find NAME)`` and ``package://NAME`` need no ROS: a package is a folder of that name, or one whose ``package.xml``
has the name, among the folders above the file and those beside them, in the installed ROS (``AMENT_PREFIX_PATH``), or
in the folders of the environment variable ``ROS_PACKAGE_PATH``, separated by colons.

A calibrated robot is exported as a URDF: the expanded file with its joint origins edited; the xacro itself is never
rewritten.
"""

import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, suppress
from importlib import import_module
from io import StringIO
from itertools import chain
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree as ET

from calib.errors import RobotError, refuse_robot, suggestion
from calib.robot.collision import PACKAGE_PATH, package_folders
from calib.robot.descriptions.xacro_arguments import split

_MISSING = re.compile(r"Undefined substitution argument (\w+)")
# Folders above the file in which packages are looked for (our choice).
MAX_ABOVE = 4


class _Arguments(dict[str, str]):
    """Xacro arguments that record which of them the file declares, since xacro silently ignores undeclared ones."""

    def __init__(self, arguments: dict[str, str]) -> None:
        super().__init__(arguments)
        self.declared: set[object] = set()

    def __contains__(self, name: object) -> bool:
        self.declared.add(name)
        return super().__contains__(name)

    def __getitem__(self, name: str) -> str:
        self.declared.add(name)
        return super().__getitem__(name)


def expand(path: str) -> str:
    """Return the URDF text for a xacro file, whose path may be followed by arguments (``name:=value``).

    Raises:
        RobotError: xacro fails (the message contains the file and xacro's error), or the file does not declare an
            argument.
    """
    xacro = import_module("xacro")

    file, stated_arguments = split(path)
    arguments = _Arguments(stated_arguments)
    try:
        # Its warnings of style are not shown.
        with _packages_for(Path(file)), redirect_stderr(StringIO()):
            urdf_text = xacro.process_file(file, mappings=arguments).toprettyxml(indent="  ")
    except RecursionError:
        reason = "a macro that calls itself, or a file that includes itself"
        raise RobotError(f"{_location(xacro, file)}: nested without end: {reason}") from None
    except Exception as error:  # whatever xacro, its expressions and parsers raise
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, RobotError):
            cause = getattr(cause, "exc", None)
        if cause is not None:
            raise cause from None
        reason = " ".join(str(error).split()) or repr(error)
        missing = _MISSING.search(reason)
        hint = f"; state it after the file: {missing[1]}:=…" if missing else ""
        raise RobotError(f"{_location(xacro, file)}: xacro: {reason}{hint}") from error
    declared = sorted(str(name) for name in arguments.declared)
    for name in stated_arguments:
        if name not in arguments.declared:
            choices = f"it has {', '.join(declared)}" if declared else "it has none"
            refuse_robot(file, f"there is no xacro argument '{name}'{suggestion(name, declared)}; {choices}")
    return urdf_text


def _location(xacro: ModuleType, file: str) -> str:
    open_files = [name for name in xacro.filestack or () if name]
    if not open_files or open_files[-1] == file:
        return file
    return f"{open_files[-1]}, included by {file}"


@contextmanager
def _packages_for(file: Path) -> Iterator[None]:
    """Within this context, xacro's ``$(find NAME)`` finds packages by `package_folder`.

    Xacro looks packages up in ROS's package index, whose module is replaced meanwhile.

    Args:
        file: the robot description, from whose folder packages are searched.
    """
    from unittest.mock import patch  # slow to load

    index = ModuleType("ament_index_python.packages")
    index.get_package_share_directory = lambda name: str(package_folder(name, file))  # ty: ignore[missing-attribute]
    with patch.dict(sys.modules, {"ament_index_python": ModuleType("ament_index_python"), index.__name__: index}):
        yield


def package_folder(name: str, file: Path) -> Path:
    """Return the folder of the ROS package `name`, which the robot description `file` refers to.

    Raises:
        RobotError: the package is not found.
    """
    parents = file.resolve().parents
    packages = map(_packages_in, (*parents[:MAX_ABOVE], *package_folders()))
    for folder in chain(parents, chain.from_iterable(packages)):
        if name in (folder.name, _name_in(folder / "package.xml")):
            return folder
    refuse_robot(
        file,
        f"there is no package '{name}' among the folders above it and beside those; state where packages are by "
        f"{PACKAGE_PATH}=/folder/that/holds/{name} (several: separated by {os.pathsep})",
    )


def _packages_in(folder: Path) -> Iterator[Path]:
    with suppress(OSError):
        yield from sorted(path for path in folder.iterdir() if path.is_dir())
    yield from sorted(path.parent for path in folder.glob("*/*/package.xml"))


def _name_in(package: Path) -> str:
    """Return the package name in a ``package.xml``; "" if the file or the name is missing."""
    with suppress(OSError, ET.ParseError):
        return (ET.parse(package).getroot().findtext("name") or "").strip()
    return ""
