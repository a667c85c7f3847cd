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
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, suppress
from importlib import import_module
from io import StringIO
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree as ET

from calib.errors import RobotError, refuse_robot, suggestion
from calib.robot.collision import PACKAGE_PATH, package_folders

_ARGUMENTS = re.compile(r"(?:(?<=\.xacro)|(?<=\.conf))\s+(?=\w+:=)")
_MISSING = re.compile(r"Undefined substitution argument (\w+)")
MAX_ABOVE = 4  # folders above the file in which packages are looked for (our choice)


def split(path: str) -> tuple[str, dict[str, str]]:
    """Return the file and the xacro arguments of what a person gives as a robot: ``arm.urdf.xacro name:=value``."""
    file, *rest = _ARGUMENTS.split(path, maxsplit=1)
    words = shlex.split(rest[0]) if rest else []
    if odd := [word for word in words if ":=" not in word]:
        refuse_robot(file, f"'{odd[0]}' is no xacro argument; write name:=value, values with blanks in quotes")
    return file, {name: value for name, _, value in (word.partition(":=") for word in words)}


class _Arguments(dict[str, str]):
    """Arguments that know which of them were declared: xacro ignores others without a word."""

    def __init__(self, given: dict[str, str]) -> None:
        super().__init__(given)
        self.asked: set[object] = set()

    def __contains__(self, name: object) -> bool:
        self.asked.add(name)
        return super().__contains__(name)

    def __getitem__(self, name: str) -> str:
        self.asked.add(name)
        return super().__getitem__(name)


def expand(path: str) -> str:
    """Return the URDF text of a xacro file, its arguments behind it.

    Raises:
        RobotError: naming the file in which xacro failed, and what it says; for an argument that it does not have.
    """
    xacro: Any = import_module("xacro")

    file, given = split(path)
    arguments = _Arguments(given)
    try:
        with _packages_for(Path(file)), redirect_stderr(StringIO()):  # its warnings of style
            found = xacro.process_file(file, mappings=arguments).toprettyxml(indent="  ")
    except RecursionError:
        words = "a macro that calls itself, or a file that includes itself"
        raise RobotError(f"{_place(xacro, file)}: nested without end: {words}") from None
    except Exception as error:  # whatever xacro, its expressions and parsers raise
        inner: Any = error
        while not isinstance(inner, RobotError) and (cause := getattr(inner, "exc", None)) is not None:
            inner = cause
        if isinstance(inner, RobotError):
            raise inner from None
        words = " ".join(str(error).split()) or repr(error)
        hint = f"; say it behind the file: {named[1]}:=…" if (named := _MISSING.search(words)) else ""
        raise RobotError(f"{_place(xacro, file)}: xacro: {words}{hint}") from error
    if unknown := [name for name in given if name not in arguments.asked]:
        known = [str(name) for name in arguments.asked]
        there = f"it has {', '.join(sorted(known))}" if known else "it has none"
        refuse_robot(file, f"there is no xacro argument '{unknown[0]}'{suggestion(unknown[0], known)}; {there}")
    return found


def _place(xacro: Any, file: str) -> str:
    inner = [name for name in xacro.filestack or () if name]
    return file if not inner or inner[-1] == file else f"{inner[-1]}, included by {file}"


@contextmanager
def _packages_for(file: Path) -> Iterator[None]:
    """Let ``$(find NAME)`` of xacro, which asks ROS's index by this import, find packages by `package_folder`."""
    from unittest.mock import patch  # slow to load

    index = ModuleType("ament_index_python.packages")
    index.get_package_share_directory = lambda name: str(package_folder(name, file))  # type: ignore[attr-defined]
    with patch.dict(sys.modules, {"ament_index_python": ModuleType("ament_index_python"), index.__name__: index}):
        yield


def package_folder(name: str, file: Path) -> Path:
    """Return the folder of a ROS package that a robot's file names.

    Raises:
        RobotError: saying how to give its folder.
    """
    above = file.resolve().parents
    for folder in (*above, *(one for each in (*above[:MAX_ABOVE], *package_folders()) for one in _packages_in(each))):
        if name in (folder.name, _name_in(folder / "package.xml")):
            return folder
    refuse_robot(
        file,
        f"there is no package '{name}' among the folders above it and beside those; say where packages are by "
        f"{PACKAGE_PATH}=/folder/that/holds/{name} (several: separated by {os.pathsep})",
    )


def _packages_in(folder: Path) -> Iterator[Path]:
    with suppress(OSError):
        yield from sorted(one for one in folder.iterdir() if one.is_dir())
    yield from sorted(one.parent for one in folder.glob("*/*/package.xml"))


def _name_in(package: Path) -> str:
    """Return the name in a ``package.xml``; "" where there is none."""
    with suppress(OSError, ET.ParseError):
        return (ET.parse(package).getroot().findtext("name") or "").strip()
    return ""
