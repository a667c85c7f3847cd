"""CSV formats of other programs: RoboDK's points and poses, and the headerless format of three reflectors.

RoboDK (six joints). The header has J1 to J6 (``J1``, ``J1 (deg)``, ``Joint 1``), and what follows is read by its place,
as RoboDK's own macros do (RoboDK-API, CalculateErrorsDistances.py, CalculateErrorsPoses.py):

    points, 9 or 12 columns    J1..J6 [deg], x y z [mm] measured, TCP x y z [mm]
    poses, 12 or 18 columns    J1..J6 [deg], x y z [mm] w p r [deg] measured, TCP x y z w p r

Where 12 columns could be either, the tenth name decides: ``w``, ``rx``, ``r`` or ``a`` is a pose, any other a point. A
unit in brackets wins over the one above. Rows with different TCPs saw different reflectors: each TCP is a tool. The
TCP's values themselves are not used (tools are fitted).

What w, p, r mean differs between RoboDK's displays and versions, so that the options say it (``euler``): ``wpr``, the
default, is Fanuc's R = Rz(r) Ry(p) Rx(w); ``xyz`` is R = Rx(w) Ry(p) Rz(r), which RoboDK's macro for pose errors
assumes, in rad; ``vector`` is a rotation vector. Angles that would fit radians are refused until a unit is stated.

Three reflectors without a header (``format = "three_smr"``, only on request): N1 x y z, N2 x y z, N3 x y z [mm],
columns of padding, joints [deg] last; 18 to 21 columns for six joints. A reflector at 0, 0, 0 was not seen.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np

from calib.data.csv_table import Table, read_header, read_table, row_width
from calib.data.joint_columns import COMMANDED_WORDS, words_of
from calib.data.poses.fit_options import FileOptions
from calib.errors import MeasurementError, refuse_data, require
from calib.records import frozen
from calib.units import DEG

_POSE_MARKS = ("w", "rx", "r", "a")
JOINT_NUMBERS = ["j1", "j2", "j3", "j4", "j5", "j6"]
JOINT_NAMES = ["joint 1", "joint 2", "joint 3", "joint 4", "joint 5", "joint 6"]
# Numbers of columns of points, of points with TCP or poses, of poses with TCP.
WIDTHS = (9, 12, 18)
# Meaning of w, p, r by the options' `euler`.
MEANINGS = {"wpr": "Rz(r) Ry(p) Rx(w)", "xyz": "Rx(w) Ry(p) Rz(r)", "vector": "a rotation vector"}
# Largest angle [rad] read as degrees that would fit radians, with rounding.
MAX_RADIANS_AS_DEGREES = 1.001 * np.pi * DEG

Read = tuple[Table, FileOptions, tuple[str, ...]]


def recognises(header: Sequence[str]) -> bool:
    """Return whether a header begins with RoboDK's J1 to J6 (or ``Joint 1`` to ``Joint 6``).

    ``joint1`` in one word does not count, since robots have such joint names: these files are read by column names.
    """
    names = [name.split("(")[0].split("[")[0].strip().lower() for name in header[:6]]
    if names not in (JOINT_NUMBERS, JOINT_NAMES):
        return False
    has_seventh = len(header) > 6 and _plain(header[6]) in ("j7", "joint7")
    return not has_seventh


def _is_robodk(header: Sequence[str]) -> bool:
    """Return whether a header begins as RoboDK's and goes on with x y z, then with angles or with the x y z of a TCP.

    Args:
        header: names of the columns; fewer than those of a point count, too.
    """
    if not recognises(header) or (len(header) > WIDTHS[0] and len(header) not in WIDTHS):
        return False
    term_lists = list(map(words_of, header[6:]))
    if not COMMANDED_WORDS.isdisjoint(chain(*term_lists)):
        return False
    is_pose = len(header) == WIDTHS[-1] or _plain("".join(header[9:10])) in _POSE_MARKS
    axes = "xyz" if is_pose else "xyzxyz"
    return all(axis in (name[-1][-1], name[-1][0]) for name, axis in zip(term_lists, axes))


def read_robodk(path: str | Path, joints: int, options: FileOptions) -> Read:
    """Return RoboDK's CSV as a table for the standard reader, the options for reading this table, and notes.

    Args:
        path: the file.
        joints: the robot's number of joints.
        options: options for reading the file.
    """
    header = read_header(path)[0]
    if not recognises(header):
        refuse_data(path, f"is not a RoboDK file: its header begins with {', '.join(header[:7])}, not J1 to J6")
    require(joints == 6, f"RoboDK's format has 6 joints, the robot has {joints}", MeasurementError, path)
    is_pose = len(header) == 18 or (len(header) == 12 and _plain(header[9]) in _POSE_MARKS)
    if len(header) not in WIDTHS:
        refuse_data(path, f"has {len(header)} columns; RoboDK's points have 9 or 12, its poses 12 or 18")
    raw = read_table(path, doubles=True)
    measured_count = 12 if is_pose else 9
    tcp = tuple(f"TCP {name}" for name in "xyzwpr"[: len(header) - measured_count])
    names = (*header[:6], *"xyzwpr"[: measured_count - 6], *tcp)
    angle_unit_assumed = is_pose and not options.units.get("orientation") and not any(raw.units[9:12])
    angle_unit = "deg" if angle_unit_assumed else ""
    default_units = ("deg",) * 6 + ("mm",) * 3 + (angle_unit,) * 3 + ("",) * 6
    units = tuple(unit or default for unit, default in zip(raw.units, default_units))
    table = replace(raw, header=names, units=units)
    table, notes = _with_tools(table, tcp, options)

    columns = dict(options.columns)
    for number, name in enumerate(names[:6], 1):
        columns[f"q{number}"] = name
    kind = options.kind or ("pose" if is_pose else "position")
    euler = options.euler
    if is_pose:
        columns |= {"rx": "w", "ry": "p", "rz": "r"}
        euler = euler or "wpr"
        notes += (f"w p r are taken as {MEANINGS.get(euler, euler)}; other conventions: euler in the options",)
        if angle_unit_assumed:
            largest = max(np.abs(table.numbers(name, "angle")).max() for name in "wpr")
            if largest < MAX_RADIANS_AS_DEGREES:
                message = "all angles are within ±3.15: deg as in RoboDK's manual, or rad as in its macro?"
                message += " State it: units.orientation = 'deg' or 'rad' in the options, or [deg] in the header"
                table.fail(message, "w", 0)
    note = f"read as RoboDK's {kind}s: joints in deg, positions in mm unless the header states other units"
    return table, replace(options, columns=columns, kind=kind, euler=euler), (note, *notes)


def read_three_smr(path: str | Path, joints: int, options: FileOptions) -> Read:
    """Return the headerless CSV of three reflectors as a table, the options for reading it, and notes.

    Args:
        path: the file.
        joints: the robot's number of joints.
        options: options for reading the file.
    """
    targets = ["x1", "y1", "z1", "x2", "y2", "z2", "x3", "y3", "z3"]
    width = row_width(path)
    padding = width - 9 - joints
    if padding < 0:
        refuse_data(path, f"has {width} columns; three reflectors and {joints} joints need {9 + joints}")
    names = (*targets, *(f"padding {i + 1}" for i in range(padding)), *(f"q{i + 1}" for i in range(joints)))
    raw = read_table(path, header=names)
    cells = list(raw.cells)
    for k in range(0, 9, 3):
        triple = np.array([raw.numbers(name, gaps=True) for name in targets[k : k + 3]])
        unseen = np.all(triple == 0, axis=0)
        cells[k : k + 3] = [frozen(np.where(unseen, np.nan, values)) for values in triple]
    table = replace(raw, units=("mm",) * 9 + ("",) * padding + ("deg",) * joints, cells=tuple(cells))
    return table, options, (f"read as three reflectors, {padding} columns of padding, {joints} joints",)


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _with_tools(table: Table, tcp: Sequence[str], options: FileOptions) -> tuple[Table, tuple[str, ...]]:
    """Return the table and notes; if rows have different TCPs, with a column ``tool`` that distinguishes these.

    Args:
        table: the table.
        tcp: names of the columns with the TCP's position; empty if there are none.
        options: options for reading the file.
    """
    if not tcp:
        return table, ()
    tcp_values = np.stack([table.numbers(name) for name in tcp], axis=1)
    triples = [tuple(row) for row in np.round(tcp_values, 3)]
    labels: dict[tuple[float, ...], str] = {}
    descriptions = []
    for triple in dict.fromkeys(triples):
        label = f"{options.tool} {len(labels) + 1}"
        labels[triple] = label
        coordinates = ", ".join(f"{coordinate:g}" for coordinate in triple)
        descriptions.append(f"{label}: {coordinates}")
    if len(labels) == 1:
        return table, ()
    cells = (*table.cells, np.array([labels[triple] for triple in triples], dtype=object))
    table = replace(table, header=(*table.header, "tool"), units=(*table.units, ""), cells=cells)
    return table, (f"{len(labels)} different TCPs, read as different tools ({'; '.join(descriptions)})",)


FORMS: dict[str, tuple[Callable[[Sequence[str]], bool], Callable[[str | Path, int, FileOptions], Read]]] = {
    "robodk": (_is_robodk, read_robodk),
    "three_smr": (lambda header: False, read_three_smr),
}
"""By the options' ``format``: whether a header is of that form, and the reader."""
