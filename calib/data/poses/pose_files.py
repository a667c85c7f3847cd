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

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.csv_table import Table, read_header, read_table
from calib.data.poses import plausible, robodk
from calib.data.poses.base_frame import relative_to_base
from calib.data.poses.columns import OURS, SUFFIXES, Layout, find_layout
from calib.data.poses.fit_options import FileOptions
from calib.data.poses.grouped import labels, read_groups
from calib.data.poses.measurements import PoseMeasurements, Poses, Positions
from calib.data.poses.plausible import Limits
from calib.errors import MeasurementError


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
        options: names, units, kind where the header does not tell.
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
    block = _measurements(table, joints, options, kinds=kinds, limits=limits)
    return [replace(block, notes=(*notes, *block.notes))]


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


def _measurements(
    table: Table,
    joints: Sequence[str],
    options: FileOptions,
    *,
    kinds: Sequence[str] | None = None,
    limits: Limits | None = None,
) -> PoseMeasurements:
    """Return what `table` holds, as `read_measurements`."""
    table = _select_rows(table, options)
    layout = find_layout(table, options, joints)
    q = read_joints(table, options, layout.joints)
    notes = (*layout.notes, *plausible.check_joints(q, table, layout.joints, joints, options, kinds, limits))
    block = (_read_targets if layout.positions else read_groups)(table, options, layout, q)
    station = options.station or Path(table.file).stem
    return replace(block, station=station, ignored=layout.ignored(table), notes=(*notes, *block.notes))


def _select_rows(table: Table, options: FileOptions) -> Table:
    """Return the rows whose cells have the values that ``where`` allows."""
    keep = np.ones(len(table), dtype=bool)
    for name, values in options.where.items():
        texts = table.texts(name)
        keep &= np.isin(texts, list(values))
        if not keep.any():
            found = ", ".join(list(dict.fromkeys(texts))[:10])
            message = f"no row is left by where = {', '.join(values)}; found {found}"
            raise MeasurementError(message, table.file, column=name)
    return table if keep.all() else table.where(keep)


def read_joints(table: Table, options: FileOptions, columns: Sequence[str]) -> np.ndarray:
    """Return joint values (m, n) [rad or m]."""
    return _numbers(table, options, columns, "joint", "joints")


def _numbers(
    table: Table, options: FileOptions, names: Sequence[str], dimension: str, family: str, gaps: bool = False
) -> np.ndarray:
    """Read columns (m, k) in SI; the options may state a column's unit, or that of its family."""
    ours = {theirs: name for name, theirs in options.columns.items()}
    units = options.units
    stated = [units.get(ours.get(name, name), units.get(name, units.get(family, ""))) for name in names]
    return np.stack([table.numbers(name, dimension, unit, gaps) for name, unit in zip(names, stated)], axis=1)


def _read_targets(table: Table, options: FileOptions, layout: Layout, q: np.ndarray) -> Positions:
    """Read positions and poses; each target that was seen makes a row, in the file's order."""
    several = len(layout.positions) > 1
    position = np.stack([_position(table, options, names, several) for names in layout.positions], axis=1)
    seen = np.asarray(~np.isnan(position).any(axis=2))
    index, target = np.nonzero(seen)
    if not len(index):
        raise MeasurementError("no target was seen in any row", table.file, column=layout.positions[0][0])
    names, tool = (options.tool,), target
    if several:
        names = tuple(f"{options.tool} {k + 1}" for k in range(len(layout.positions)))
    elif layout.tool:
        names, tool = labels(table, (layout.tool,))
    sigma = _sigma(table, options, layout, seen)
    common: dict[str, Any] = {
        "sigma": None if sigma is None else sigma[index, target], "tool": tool, "tool_names": names,
        "file": table.file, "rows": table.rows[index], "notes": _unseen(seen, layout),
    }  # fmt: skip
    q, places = q[index], position[index, target]
    block = Positions(q, layout.joints, places, **common)
    if layout.kind == Poses.kind:
        turns, about = _orientation(table, options, layout), _sigma_rotation(table, options, layout)
        block = Poses(q, layout.joints, places, turns, sigma_rotation=about, **common)
    return _seen_from_base(block, table, options, layout, index) if layout.base else block


def _seen_from_base(
    block: Positions, table: Table, options: FileOptions, layout: Layout, index: np.ndarray
) -> Positions:
    """Return a block relative to the base frame that stands in the same rows."""
    position = _numbers(table, options, layout.base[:3], "length", "position")
    quaternion = plausible.unit_quaternions(_numbers(table, options, layout.base[3:], "", ""), table, layout.base[3:])
    return relative_to_base(block, position[index], quaternion[index])


def _position(table: Table, options: FileOptions, names: Sequence[str], gaps: bool) -> np.ndarray:
    position = _numbers(table, options, names, "length", "position", gaps)
    empty = np.isnan(position)
    partial = empty.any(axis=1) & ~empty.all(axis=1)
    if partial.any():
        row = int(np.argmax(partial))
        column = names[int(np.argmax(empty[row]))]
        message = f"is empty while others of {', '.join(names)} are not; a target not seen has none of them"
        raise MeasurementError(message, table.file, int(table.rows[row]), column)
    plausible.check_lengths(position, table, names)
    return position


def _unseen(seen: np.ndarray, layout: Layout) -> tuple[str, ...]:
    counts = len(seen) - np.sum(seen, axis=0)
    return tuple(
        f"{', '.join(names)}: not seen in {count} of {len(seen)} rows"
        for names, count in zip(layout.positions, counts)
        if count
    )


def _orientation(table: Table, options: FileOptions, layout: Layout) -> np.ndarray:
    if len(layout.orientation) == 3:
        angles = _numbers(table, options, layout.orientation, "angle", "orientation")
        return plausible.turns(angles, table, layout.orientation, options.euler)
    values = _numbers(table, options, layout.orientation, "", "")
    if len(layout.orientation) == 4:
        return plausible.unit_quaternions(values, table, layout.orientation)
    return Rotation.from_matrix(plausible.rotation_matrices(values, table, layout.orientation)).as_quat(canonical=True)


def _sigma(table: Table, options: FileOptions, layout: Layout, seen: np.ndarray) -> np.ndarray | None:
    """Return sigmas (m, targets, 3) [m] from columns, else from the options, else None."""
    if not layout.sigmas:
        return None if options.sigma.position is None else np.tile(options.sigma.position, (*seen.shape, 1))
    stack = []
    for k, names in enumerate(layout.sigmas):
        sigma = _numbers(table, options, names, "length", "sigma", gaps=not seen[:, k].all())
        sigma = np.where(sigma < 0.0, sigma, np.maximum(sigma, options.sigma.floor))
        advice = "a sigma must be above 0; where it was rounded to 0, set sigma.floor in the options"
        plausible.check_positive(np.where(seen[:, k : k + 1], sigma, np.nan), table, names, advice)
        _no_gaps(sigma, seen[:, k], table, names)
        stack.append(sigma)
    return np.stack(stack, axis=1)


def _no_gaps(sigma: np.ndarray, seen: np.ndarray, table: Table, names: Sequence[str]) -> None:
    gaps = np.argwhere(np.isnan(sigma) & seen[:, None])
    if len(gaps):
        row, column = (int(i) for i in gaps[0])
        raise MeasurementError("is empty where a target was seen", table.file, int(table.rows[row]), names[column])


def _sigma_rotation(table: Table, options: FileOptions, layout: Layout) -> np.ndarray | None:
    if not layout.sigma_rotation:
        return None if options.sigma.orientation is None else np.tile(options.sigma.orientation, (len(table), 1))
    values = _numbers(table, options, layout.sigma_rotation, "angle", "sigma_rotation")
    plausible.check_positive(values, table, layout.sigma_rotation, "a sigma must be above 0")
    return values
