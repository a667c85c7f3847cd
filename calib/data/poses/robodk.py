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
from pathlib import Path

import numpy as np

from calib.data.csv_table import Table, read_header, read_table, row_width
from calib.data.poses.fit_options import FileOptions
from calib.errors import MeasurementError, refuse_data, require
from calib.records import frozen
from calib.units import DEG

_POSE_MARKS = ("w", "rx", "r", "a")

Read = tuple[Table, FileOptions, tuple[str, ...]]


def recognises(header: Sequence[str]) -> bool:
    """Return whether a header begins with RoboDK's J1 to J6 (or ``Joint 1`` to ``Joint 6``).

    ``joint1`` in one word is a name that robots have: such a file is read by its names.
    """
    first = [name.split("(")[0].split("[")[0].strip().lower() for name in header[:6]]
    named = first in ([f"j{i}" for i in range(1, 7)], [f"joint {i}" for i in range(1, 7)])
    return named and _plain(header[6] if len(header) > 6 else "") not in ("j7", "joint7")


def read_robodk(path: str | Path, joints: int, options: FileOptions) -> Read:
    """Return RoboDK's CSV as a table for the standard reader, with the options to read it and notes."""
    found = read_header(path)[0]
    if not recognises(found):
        refuse_data(path, f"is not a RoboDK file: its header begins with {', '.join(found[:7])}, not J1 to J6")
    require(joints == 6, f"RoboDK's format has 6 joints, the robot has {joints}", MeasurementError, path)
    pose = len(found) == 18 or (len(found) == 12 and _plain(found[9]) in _POSE_MARKS)
    if len(found) not in (9, 12, 18):
        refuse_data(path, f"has {len(found)} columns; RoboDK's points have 9 or 12, its poses 12 or 18")
    raw = read_table(path, doubles=True)
    measured = 12 if pose else 9
    tcp = tuple(f"TCP {name}" for name in "xyzwpr"[: len(found) - measured])
    names = (*found[:6], *"xyzwpr"[: measured - 6], *tcp)
    silent = pose and not options.units.get("orientation") and not any(raw.units[9:12])
    usual = ("deg",) * 6 + ("mm",) * 3 + ("deg" if silent else "",) * 3 + ("",) * 6
    table = replace(raw, header=names, units=tuple(own or unit for own, unit in zip(raw.units, usual)))
    table, notes = _with_tools(table, tcp, options)
    columns = {**options.columns, **{f"q{i + 1}": name for i, name in enumerate(names[:6])}}
    kind, euler = options.kind or ("pose" if pose else "position"), options.euler
    if pose:
        columns |= {"rx": "w", "ry": "p", "rz": "r"}
        euler = euler or "wpr"
        meaning = {"wpr": "Rz(r) Ry(p) Rx(w)", "xyz": "Rx(w) Ry(p) Rz(r)", "vector": "a rotation vector"}
        notes += (f"w p r are taken as {meaning.get(euler, euler)}; other conventions: euler in the options",)
        if silent and max(np.abs(table.numbers(name, "angle")).max() for name in "wpr") < 1.001 * np.pi * DEG:
            message = "all angles are within ±3.15: deg as in RoboDK's manual, or rad as in its macro?"
            message += " State it: units.orientation = 'deg' or 'rad' in the options, or [deg] in the header"
            table.fail(message, "w", 0)
    read = f"read as RoboDK's {kind}s: joints in deg, positions in mm unless the header states other units"
    return table, replace(options, columns=columns, kind=kind, euler=euler), (read, *notes)


def read_three_smr(path: str | Path, joints: int, options: FileOptions) -> Read:
    """Return the headerless CSV of three reflectors as a table, options and notes, as `read_robodk`."""
    targets = [f"{axis}{k}" for k in (1, 2, 3) for axis in "xyz"]
    width = row_width(path)
    padding = width - 9 - joints
    if padding < 0:
        refuse_data(path, f"has {width} columns; three reflectors and {joints} joints need {9 + joints}")
    names = (*targets, *(f"padding {i + 1}" for i in range(padding)), *(f"q{i + 1}" for i in range(joints)))
    raw = read_table(path, header=names)
    cells = list(raw.cells)
    for k in range(0, 9, 3):
        triple = [raw.numbers(name, gaps=True) for name in targets[k : k + 3]]
        unseen = np.all([values == 0 for values in triple], axis=0)
        cells[k : k + 3] = [frozen(np.where(unseen, np.nan, values)) for values in triple]
    table = replace(raw, units=("mm",) * 9 + ("",) * padding + ("deg",) * joints, cells=tuple(cells))
    return table, options, (f"read as three reflectors, {padding} columns of padding, {joints} joints",)


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _with_tools(table: Table, tcp: Sequence[str], options: FileOptions) -> tuple[Table, tuple[str, ...]]:
    """Return the table, with a column ``tool`` and a note if its rows have different TCPs."""
    if not tcp:
        return table, ()
    triples = [tuple(row) for row in np.round(np.stack([table.numbers(name) for name in tcp], axis=1), 3)]
    labels = {triple: f"{options.tool} {k + 1}" for k, triple in enumerate(dict.fromkeys(triples))}
    if len(labels) == 1:
        return table, ()
    values = "; ".join(f"{label}: {', '.join(f'{value:g}' for value in triple)}" for triple, label in labels.items())
    cells = (*table.cells, np.array([labels[triple] for triple in triples], dtype=object))
    table = replace(table, header=(*table.header, "tool"), units=(*table.units, ""), cells=cells)
    return table, (f"{len(labels)} different TCPs, read as different tools ({values})",)


FORMS: dict[str, tuple[Callable[[Sequence[str]], bool], Callable[[str | Path, int, FileOptions], Read]]] = {
    "robodk": (recognises, read_robodk),
    "three_smr": (lambda header: False, read_three_smr),
}
"""By the options' ``format``: whether a header is of that form, and the reader."""
