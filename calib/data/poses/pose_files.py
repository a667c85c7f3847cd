"""Read a CSV file of measured poses into `PoseMeasurements`.

Columns by default (a unit in brackets is converted, ``q1 [deg]``, ``x [mm]``; plain headers are SI):

==================  ===================================================================================================
joints              the robot's joint names, or ``q_<joint name>``, or ``q1`` to ``qn``
position, pose      ``x y z``; with ``qx qy qz qw``, ``r11`` to ``r33`` or three angles (``rx ry rz``, ``a b c``,
                    ``w p r``, ``roll pitch yaw``; the options' ``euler`` says what they mean) a pose; also with
                    ``_meas``, ``_measured`` (where a file has both, the options' [columns] say which is to be read)
several reflectors  ``x1 y1 z1 x2 y2 z2 ...``, each a row of its own; an empty triple is a reflector not seen
base frame          ``base_x`` … ``base_qw``, measured with every row: the target is then seen from there
sigmas              ``sigma_x``, ``_y``, ``_z`` (numbered as the reflectors, or common), ``sigma_rx``, ``_ry``, ``_rz``
distance            ``distance`` with ``pair`` (two rows share a label), or with ``bar`` (the unknown other end);
                    ``sigma_distance``
sockets, plane      ``socket`` (grouped together with ``tool_position``), ``plane``
tool                ``tool``: label of the reflector that a row saw
==================  ===================================================================================================

All other columns are ignored and listed. Other forms: `calib.data.poses.robodk`.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.data.csv_table import read_header, read_table
from calib.data.poses import plausible, robodk
from calib.data.poses.base_frame import relative_to_base
from calib.data.poses.columns import OURS, POSITION, SIGMA, SIGMA_ROTATION, SUFFIXES, Layout, Sheet, find_layout
from calib.data.poses.fit_options import FileOptions
from calib.data.poses.grouped import labels, read_groups
from calib.data.poses.measurements import PoseMeasurements, Poses, Positions
from calib.data.poses.plausible import Limits
from calib.data.schema import refuse


def read_measurements(
    path: str | Path,
    joints: Sequence[str],
    options: FileOptions | None = None,
    *,
    kinds: Sequence[str] | None = None,
    limits: Limits | None = None,
) -> list[PoseMeasurements]:
    """Read the measurements in `path` for a robot with these joints.

    Args:
        joints: the robot's n joint names.
        options: names, units, kind where the header does not state it.
        kinds: URDF's type of each joint (revolute, continuous, prismatic); all revolute by default.
        limits: lower and upper limits, each (n,) [rad or m].

    Returns:
        One block.

    Raises:
        MeasurementError: for whatever cannot be what it claims to be, with row and column.
    """
    options = options or FileOptions()
    if options.format == "three_smr":
        table, options, notes = robodk.read_three_smr(path, len(joints), options)
    elif options.format == "robodk" or (not options.format and robodk.recognises(read_header(path)[0])):
        table, options, notes = robodk.read_robodk(path, len(joints), options)
    else:
        table, notes = read_table(path), ()
    sheet = _select_rows(Sheet(table, options))
    layout = find_layout(sheet, joints)
    q, _ = sheet.joints(joints)
    notes = (*notes, *layout.notes, *plausible.check_joints(q, sheet, layout.joints, joints, kinds, limits))
    block = (_read_targets if layout.positions else read_groups)(sheet, layout, q)
    ignored = tuple(name for name in sheet.table.header if name not in layout.used)
    station = options.station or Path(table.file).stem
    return [replace(block, station=station, ignored=ignored, notes=(*notes, *block.notes))]


def joint_columns(path: str | Path) -> tuple[str, ...]:
    """Return the names in the header of `path` that may be joints (without ``q_``): all that we know as nothing else.

    A caller holds them against the chains of a URDF, to see which of them was measured.
    """
    known = {name + suffix for name in OURS for suffix in SUFFIXES}
    names, units = read_header(path)
    return tuple(
        name.removeprefix("q_")
        for name, unit in zip(names, units)
        if name not in known and not (name[:1] in "xyz" and name[1:].isdigit()) and unit not in ("s", "C", "°C")
    )


def _select_rows(sheet: Sheet) -> Sheet:
    """Return the rows whose cells have the values that ``where`` allows."""
    table, keep = sheet.table, np.ones(len(sheet.table), dtype=bool)
    for name, values in sheet.options.where.items():
        texts = table.texts(name)
        keep &= np.isin(texts, list(values))
        if not keep.any():
            found = ", ".join(list(dict.fromkeys(texts))[:10])
            sheet.fail(f"no row is left by where = {', '.join(values)}; found {found}", name)
    return sheet if keep.all() else replace(sheet, table=table.where(keep))


def _read_targets(sheet: Sheet, layout: Layout, q: np.ndarray) -> Positions:
    """Read positions and poses; each target that was seen makes a row, in the file's order."""
    table, several = sheet.table, len(layout.positions) > 1
    position = np.stack([_position(sheet, names, several) for names in layout.positions], axis=1)
    seen = np.asarray(~np.isnan(position).any(axis=2))
    index, target = np.nonzero(seen)
    if not len(index):
        sheet.fail("no target was seen in any row", layout.positions[0][0])
    names, tool = (sheet.options.tool,), target
    if several:
        names = tuple(f"{sheet.options.tool} {k + 1}" for k in range(len(layout.positions)))
    elif layout.tool:
        names, tool = labels(table, (layout.tool,))
    sigma = _sigma(sheet, layout, seen)
    unseen = len(seen) - np.sum(seen, axis=0)
    common: dict[str, Any] = {
        "sigma": None if sigma is None else sigma[index, target], "tool": tool, "tool_names": names,
        "file": table.file, "rows": table.rows[index],
        "notes": tuple(
            f"{', '.join(names)}: not seen in {count} of {len(seen)} rows"
            for names, count in zip(layout.positions, unseen)
            if count
        ),
    }  # fmt: skip
    block = Positions(q[index], layout.joints, position[index, target], **common)
    if layout.kind == Poses.kind:
        turns, about = plausible.orientation(sheet, layout.orientation), _sigma_rotation(sheet, layout)
        block = Poses(q[index], layout.joints, block.position, turns, sigma_rotation=about, **common)
    if not layout.base:
        return block
    base = sheet.numbers(layout.base[:3], POSITION)
    return relative_to_base(block, base[index], plausible.orientation(sheet, layout.base[3:])[index])


def _position(sheet: Sheet, names: Sequence[str], gaps: bool) -> np.ndarray:
    position = sheet.numbers(names, POSITION, gaps)
    empty = np.isnan(position)
    partial = empty & ~empty.all(axis=1, keepdims=True)
    message = f"is empty while others of {', '.join(names)} are not; a target not seen has none of them"
    refuse(sheet.table, partial, names, lambda row, k: message)
    return position


def _sigma(sheet: Sheet, layout: Layout, seen: np.ndarray) -> np.ndarray | None:
    """Return sigmas (m, targets, 3) [m] from columns, else from the options, else None."""
    stated = sheet.options.sigma
    if not layout.sigmas:
        return None if stated.position is None else np.tile(stated.position, (*seen.shape, 1))
    stack = []
    for k, names in enumerate(layout.sigmas):
        there = seen[:, k : k + 1]
        sigma = sheet.numbers(names, replace(SIGMA, positive=""), gaps=not there.all())
        sigma = np.where(sigma < 0.0, sigma, np.maximum(sigma, stated.floor))
        SIGMA.check(np.where(there, sigma, np.nan), sheet.table, names)
        refuse(sheet.table, np.isnan(sigma) & there, names, lambda row, k: "is empty where a target was seen")
        stack.append(sigma)
    return np.stack(stack, axis=1)


def _sigma_rotation(sheet: Sheet, layout: Layout) -> np.ndarray | None:
    if layout.sigma_rotation:
        return sheet.numbers(layout.sigma_rotation, SIGMA_ROTATION)
    stated = sheet.options.sigma.orientation
    return None if stated is None else np.tile(stated, (len(sheet.table), 1))
