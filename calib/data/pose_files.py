"""Read a CSV file of measured poses into `PoseMeasurements`.

Columns by default (a unit in brackets is converted, ``q1 [deg]``, ``x [mm]``; plain headers are SI):

=====================  ================================================================================================
joints                 the robot's joint names, or ``q_<joint name>``, or ``q1`` to ``qn``
position, pose         ``x y z``; with ``qx qy qz qw`` or ``r11`` to ``r33`` a pose; also with ``_meas``, ``_measured``
several reflectors     ``x1 y1 z1 x2 y2 z2 ...``, each a row of its own; an empty triple is a reflector not seen
sigmas                 ``sigma_x sigma_y sigma_z`` (numbered as the reflectors, or common), ``sigma_rx sigma_ry sigma_rz``
distance               ``distance`` with ``pair`` (two rows share a label), or with ``bar`` (the unknown other end)
sockets, plane         ``socket`` (grouped together with ``tool_position``), ``plane``
tool                   ``tool``: label of the reflector that a row saw
=====================  ================================================================================================

All other columns are ignored and listed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data import plausible
from calib.data.columns import Layout, find_layout
from calib.data.measurements import PoseMeasurements
from calib.data.options import FileOptions
from calib.data.plausible import Limits
from calib.data.tables import Table, nearest, read_header, read_table
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
    return [measurements(read_table(path), joints, options, kinds=kinds, limits=limits)]


def joint_columns(path: str | Path) -> tuple[str, ...]:
    """Return the names in the header of `path` that may be joints: all but those we know as something else."""
    from calib.data.columns import OURS, SUFFIXES

    known = {name + suffix for name in OURS for suffix in SUFFIXES}
    names, units = read_header(path)
    return tuple(
        name.removeprefix("q_")
        for name, unit in zip(names, units)
        if name not in known and not (name[:1] in "xyz" and name[1:].isdigit()) and unit not in ("s", "C", "°C")
    )


def measurements(
    table: Table,
    joints: Sequence[str],
    options: FileOptions,
    *,
    kinds: Sequence[str] | None = None,
    limits: Limits | None = None,
) -> PoseMeasurements:
    """Return what `table` holds, as `read_measurements`."""
    table = select_rows(table, options)
    layout = find_layout(table, options, joints)
    q = _numbers(table, options, layout.joints, "joint", "joints")
    _joint_units(table, layout, kinds)
    notes = (*layout.notes, *plausible.check_joints(q, table, layout.joints, joints, options, kinds, limits))
    block = _read_targets(table, options, layout, q) if layout.positions else _read_groups(table, options, layout, q)
    station = options.station or Path(table.file).stem
    ignored = layout.ignored(table)
    return replace(block, station=station, ignored=ignored, notes=(*notes, *block.notes))


def select_rows(table: Table, options: FileOptions) -> Table:
    """Return the rows whose cells have the values that ``where`` allows."""
    keep = np.ones(len(table), dtype=bool)
    for name, values in options.where.items():
        texts = table.texts(name)
        keep &= np.isin(texts, list(values))
        if not keep.any():
            found = ", ".join(sorted(set(texts))[:10])
            wanted = ", ".join(values)
            raise MeasurementError(f"no row is left by where = {wanted}; found {found}", table.file, column=name)
    return table if keep.all() else table.where(keep)


def _numbers(
    table: Table, options: FileOptions, names: Sequence[str], dimension: str, group: str, gaps: bool = False
) -> np.ndarray:
    """Read columns (m, k) in SI; the options may state a column's unit, or that of its family `group`."""
    ours = {theirs: name for name, theirs in options.columns.items()}
    units = options.units
    stated = [units.get(ours.get(name, name), units.get(name, units.get(group, ""))) for name in names]
    return np.stack([table.numbers(name, dimension, unit, gaps) for name, unit in zip(names, stated)], axis=1)


def _joint_units(table: Table, layout: Layout, kinds: Sequence[str] | None) -> None:
    from calib.data.tables import ANGLES

    for name, kind in zip(layout.joints, kinds or ()):
        unit = table.units[table.index(name)].lower()
        if unit and (unit in ANGLES) == (kind == "prismatic"):
            message = f"the unit [{unit}] does not suit a {kind} joint: is the column in its place?"
            raise MeasurementError(message, table.file, column=name)


def _read_targets(table: Table, options: FileOptions, layout: Layout, q: np.ndarray) -> PoseMeasurements:
    """Read positions and poses; each target that was seen makes a row, rows in the file's order."""
    several = len(layout.positions) > 1
    stack = [_numbers(table, options, names, "length", "position", gaps=several) for names in layout.positions]
    position = np.stack(stack, axis=1)  # (m, targets, 3)
    for k, names in enumerate(layout.positions):
        _complete(table, names, position[:, k])
        plausible.check_lengths(position[:, k], table, names, table.rows)
    seen = ~np.isnan(position).any(axis=2)
    index, target = np.nonzero(seen)
    if not len(index):
        raise MeasurementError("no target was seen in any row", table.file, column=layout.positions[0][0])
    sigma = None
    if layout.sigmas:
        stack = [_numbers(table, options, names, "length", "sigma", gaps=several) for names in layout.sigmas]
        sigma = np.stack(stack, axis=1)[index, target]
        for k, names in enumerate(layout.sigmas):
            plausible.positive(
                sigma[target == k], table, names, table.rows[index[target == k]], "a sigma must be above 0"
            )
    elif options.sigma_position is not None:
        sigma = np.tile(options.sigma_position, (len(index), 1))
    names = tuple(f"{options.tool} {k + 1}" for k in range(len(layout.positions))) if several else (options.tool,)
    if layout.tool and not several:
        names, target = _labels(table, (layout.tool,))
    block = PoseMeasurements(
        layout.kind,
        q[index],
        layout.joints,
        position[index, target if several else 0],
        _orientation(table, options, layout),
        sigma,
        _sigma_rotation(table, options, layout, len(q)),
        tool=target,
        tool_names=names,
        file=table.file,
        rows=table.rows[index],
        notes=_unseen(seen, layout),
    )
    return block


def _complete(table: Table, names: Sequence[str], position: np.ndarray) -> None:
    gaps = np.isnan(position)
    partial = gaps.any(axis=1) & ~gaps.all(axis=1)
    if partial.any():
        row = int(np.argmax(partial))
        column = names[int(np.argmax(gaps[row]))]
        message = f"is empty while others of {', '.join(names)} are not; a target not seen has none of them"
        raise MeasurementError(message, table.file, int(table.rows[row]), column)


def _unseen(seen: np.ndarray, layout: Layout) -> tuple[str, ...]:
    counts = len(seen) - seen.sum(axis=0)
    return tuple(
        f"{', '.join(names)}: not seen in {count} of {len(seen)} rows"
        for names, count in zip(layout.positions, counts)
        if count
    )


def _orientation(table: Table, options: FileOptions, layout: Layout) -> np.ndarray | None:
    if not layout.orientation:
        return None
    values = _numbers(table, options, layout.orientation, "", "")
    if len(layout.orientation) == 4:
        return plausible.unit_quaternions(values, table, layout.orientation, table.rows)
    matrices = plausible.rotation_matrices(values, table, layout.orientation, table.rows)
    return Rotation.from_matrix(matrices).as_quat(canonical=True)


def _sigma_rotation(table: Table, options: FileOptions, layout: Layout, m: int) -> np.ndarray | None:
    if layout.kind != "pose":
        return None
    if layout.sigma_rotation:
        values = _numbers(table, options, layout.sigma_rotation, "angle", "sigma_rotation")
        plausible.positive(values, table, layout.sigma_rotation, table.rows, "a sigma must be above 0")
        return values
    return None if options.sigma_orientation is None else np.tile(options.sigma_orientation, (m, 1))


def _read_groups(table: Table, options: FileOptions, layout: Layout, q: np.ndarray) -> PoseMeasurements:
    """Read distances, sockets and planes: rows that belong to groups."""
    names, group = _labels(table, layout.group)
    distance = None
    if layout.distance:
        values = _numbers(table, options, (layout.distance,), "length", "distance")
        plausible.check_lengths(values, table, (layout.distance,), table.rows)
        plausible.positive(values, table, (layout.distance,), table.rows, "a distance must be above 0")
        distance = values[:, 0]
        if layout.kind == "distance":
            _check_pairs(table, layout, group, names, distance)
    tool_names, tool = _labels(table, (layout.tool,)) if layout.tool else ((options.tool,), None)
    sizes = np.bincount(group)
    single = [name for name, size in zip(names, sizes) if size == 1]
    notes = (f"only one row each, which tells nothing: {', '.join(single[:5])}",) if single else ()
    sigma = None
    if options.sigma_position is not None:
        sigma = np.tile(options.sigma_position, (len(q), 1))
    return PoseMeasurements(
        layout.kind,
        q,
        layout.joints,
        sigma=sigma,
        distance=distance,
        group=group,
        group_names=names,
        links=_links(table, options, layout, group) if layout.kind == "sockets" else (),
        tool=tool,
        tool_names=tool_names,
        file=table.file,
        rows=table.rows,
        notes=notes,
    )


def _labels(table: Table, columns: Sequence[str]) -> tuple[tuple[str, ...], np.ndarray]:
    """Return the distinct labels in order of appearance, joined by ``/``, and each row's index (m,) among them."""
    texts = [table.texts(name) for name in columns]
    for name, column in zip(columns, texts):
        for row, text in zip(table.rows, column):
            if text in ("", "nan"):
                raise MeasurementError("found an empty cell where a label is needed", table.file, int(row), name)
    joined = ["/".join(parts) for parts in zip(*texts)]
    place = {name: i for i, name in enumerate(dict.fromkeys(joined))}
    return tuple(place), np.array([place[name] for name in joined])


def _check_pairs(table: Table, layout: Layout, group: np.ndarray, names: Sequence[str], distance: np.ndarray) -> None:
    for number, name in enumerate(names):
        members = np.flatnonzero(group == number)
        first = int(table.rows[members[0]])
        if len(members) != 2:
            message = f"pair '{name}' has {len(members)} rows; a distance joins two"
            raise MeasurementError(message, table.file, first, layout.group[0])
        if abs(distance[members[0]] - distance[members[1]]) > 1e-9:
            message = f"the rows of pair '{name}' state two distances: {distance[members[0]]:g} m and "
            message += f"{distance[members[1]]:g} m (row {first})"
            raise MeasurementError(message, table.file, int(table.rows[members[1]]), layout.distance)


def _links(table: Table, options: FileOptions, layout: Layout, group: np.ndarray) -> tuple[tuple[int, int, float], ...]:
    """Return the pairs of groups that share all labels but the socket's, with the known distance."""
    if options.socket_distance is None:
        return ()
    socket = table.texts(layout.group[-1])
    others = zip(*(table.texts(name) for name in layout.group[:-1])) if len(layout.group) > 1 else [()] * len(socket)
    fixtures: dict[tuple[str, ...], dict[str, int]] = {}
    for place, label, number in zip(others, socket, group):
        fixtures.setdefault(tuple(place), {})[label] = int(number)
    links = []
    for place, sockets in fixtures.items():
        pairs = options.socket_pairs or tuple(combinations(sockets, 2))
        if len(sockets) > 2 and not options.socket_pairs:
            message = f"fixture {'/'.join(place)} has {len(sockets)} sockets ({', '.join(sockets)})"
            message += ": say in the options which of them are socket_distance apart (socket_pairs = [['0', '1']])"
            raise MeasurementError(message, table.file, column=layout.group[-1])
        links += [(sockets[a], sockets[b], options.socket_distance) for a, b in pairs if a in sockets and b in sockets]
    if not links:
        found = ", ".join(dict.fromkeys(socket))
        wanted = " or ".join(f"{a} and {b}" for a, b in options.socket_pairs) or "two sockets"
        message = f"no fixture position has {wanted}, so that socket_distance joins nothing; found {found}"
        raise MeasurementError(message + nearest(wanted, socket), table.file, column=layout.group[-1])
    return tuple(links)
