"""Rows that belong together: sockets, planes, pairs and bars."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from calib.data.csv_table import Table
from calib.data.poses.columns import DISTANCE, SIGMA_DISTANCE, Layout, Sheet
from calib.data.poses.measurements import Bars, Distances, GroupedMeasurements, Planes, Sockets
from calib.data.schema import refuse


def read_groups(sheet: Sheet, layout: Layout, q: np.ndarray) -> GroupedMeasurements:
    """Return the rows of a table, with joint values q (m, n), as groups."""
    table, options = sheet.table, sheet.options
    names, group = labels(table, layout.group)
    tool_names, tool = labels(table, (layout.tool,)) if layout.tool else ((options.tool,), np.zeros(len(q), dtype=int))
    single = [name for name, size in zip(names, np.bincount(group)) if size == 1]
    common: dict[str, Any] = {
        "group": group, "group_names": names, "tool": tool, "tool_names": tool_names, "file": table.file,
        "rows": table.rows,
        "notes": (f"one row alone determines nothing: {layout.kind} {', '.join(single[:5])}",) if single else (),
    }  # fmt: skip
    stated = None if options.sigma.position is None else np.tile(options.sigma.position, (len(q), 1))
    if layout.kind == Sockets.kind:
        return Sockets(q, layout.joints, sigma=stated, links=_links(sheet, layout, group), **common)
    along = None if stated is None else stated[:, 0]
    if layout.kind == Planes.kind:
        return Planes(q, layout.joints, sigma=along, **common)
    distance, sigma = _read_distance(sheet, layout)
    sigma = along if sigma is None else sigma
    if layout.kind == Bars.kind:
        return Bars(q, layout.joints, distance, sigma=sigma, **common)
    _check_pairs(table, layout, group, names, distance)
    return Distances(q, layout.joints, distance, sigma=sigma, **common)


def labels(table: Table, columns: Sequence[str]) -> tuple[tuple[str, ...], np.ndarray]:
    """Return the distinct labels in order of appearance, joined by ``/``, and each row's index (m,) among them."""
    texts = np.column_stack([np.array(table.texts(name), dtype=object) for name in columns])
    empty = (texts == "") | (texts == "nan")
    refuse(table, empty, columns, lambda row, k: "found an empty cell where a label is needed")
    joined = ["/".join(parts) for parts in texts]
    place = {name: i for i, name in enumerate(dict.fromkeys(joined))}
    return tuple(place), np.array([place[name] for name in joined])


def _read_distance(sheet: Sheet, layout: Layout) -> tuple[np.ndarray, np.ndarray | None]:
    """Return distances (m,) and their sigmas (m,) [m], None where not stated."""
    value = sheet.numbers(layout.distance[:1], DISTANCE)[:, 0]
    stated = sheet.options.sigma
    if len(layout.distance) == 1:
        return value, None if stated.distance is None else np.full(len(value), stated.distance)
    sigma = sheet.numbers(layout.distance[1:], replace(SIGMA_DISTANCE, positive=""))
    sigma = np.where(sigma < 0.0, sigma, np.maximum(sigma, stated.floor))
    return value, SIGMA_DISTANCE.check(sigma, sheet.table, layout.distance[1:])[:, 0]


def _check_pairs(table: Table, layout: Layout, group: np.ndarray, names: Sequence[str], distance: np.ndarray) -> None:
    for number, name in enumerate(names):
        members = np.flatnonzero(group == number)
        first, last = members[0], members[-1]
        if len(members) != 2:
            message = f"pair '{name}' has {len(members)} rows; a distance joins two"
            table.fail(message, layout.group[-1], last)
        if abs(distance[first] - distance[last]) > 1e-9:
            message = (
                f"pair '{name}' has {distance[last]:g} m here and {distance[first]:g} m in row {table.rows[first]}"
            )
            table.fail(message, layout.distance[0], last)


def _links(sheet: Sheet, layout: Layout, group: np.ndarray) -> tuple[tuple[int, int, float], ...]:
    """Return the pairs of groups that share all labels but the socket's, with the known distance [m]."""
    table, options = sheet.table, sheet.options
    if options.socket_distance is None:
        return ()
    texts = [table.texts(name) for name in layout.group]
    fixtures: dict[tuple[str, ...], dict[str, int]] = {}
    for parts, number in zip(zip(*texts), group):
        fixtures.setdefault(parts[:-1], {})[parts[-1]] = int(number)
    links = []
    for place, sockets in fixtures.items():
        if len(sockets) > 2 and not options.socket_pairs:
            sheet.fail(
                f"{'/'.join(place) or 'the fixture'} has {len(sockets)} sockets ({', '.join(sockets)}): say which of "
                "them are socket_distance apart (socket_pairs = [['0', '1']] in the options)",
                layout.group[-1],
            )
        for a, b in options.socket_pairs or combinations(sockets, 2):
            if a in sockets and b in sockets:
                links.append((sockets[a], sockets[b], options.socket_distance))
    if not links:
        wanted = ", ".join(f"{a} and {b}" for a, b in options.socket_pairs) or "two sockets"
        found = ", ".join(dict.fromkeys(texts[-1]))
        message = f"no fixture position has {wanted}, so that socket_distance joins nothing; found {found}"
        sheet.fail(message, layout.group[-1])
    return tuple(links)
