"""Rows that belong together: sockets, planes, pairs and bars."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from calib.data.csv_table import Table
from calib.data.poses import plausible
from calib.data.poses.columns import Layout
from calib.data.poses.fit_options import FileOptions
from calib.data.poses.measurements import Bars, Distances, GroupedMeasurements, Planes, Sockets
from calib.errors import MeasurementError


def read_groups(table: Table, options: FileOptions, layout: Layout, q: np.ndarray) -> GroupedMeasurements:
    """Return the rows of `table`, with joint values q (m, n), as groups."""
    names, group = labels(table, layout.group)
    tool_names, tool = labels(table, (layout.tool,)) if layout.tool else ((options.tool,), np.zeros(len(q), dtype=int))
    single = [name for name, size in zip(names, np.bincount(group)) if size == 1]
    common: dict[str, Any] = {
        "group": group, "group_names": names, "tool": tool, "tool_names": tool_names, "file": table.file,
        "rows": table.rows,
        "notes": (f"one row alone tells nothing: {layout.kind} {', '.join(single[:5])}",) if single else (),
    }  # fmt: skip
    stated = None if options.sigma.position is None else np.tile(options.sigma.position, (len(q), 1))
    if layout.kind == Sockets.kind:
        links = _links(table, options, layout, group)
        return Sockets(q, layout.joints, sigma=stated, links=links, **common)
    along = None if stated is None else stated[:, 0]
    if layout.kind == Planes.kind:
        return Planes(q, layout.joints, sigma=along, **common)
    distance, sigma = _read_distance(table, options, layout)
    sigma = along if sigma is None else sigma
    if layout.kind == Bars.kind:
        return Bars(q, layout.joints, distance, sigma=sigma, **common)
    _check_pairs(table, layout, group, names, distance)
    return Distances(q, layout.joints, distance, sigma=sigma, **common)


def labels(table: Table, columns: Sequence[str]) -> tuple[tuple[str, ...], np.ndarray]:
    """Return the distinct labels in order of appearance, joined by ``/``, and each row's index (m,) among them."""
    texts = [table.texts(name) for name in columns]
    for name, column in zip(columns, texts):
        for row, text in zip(table.rows, column):
            if text in ("", "nan"):
                raise MeasurementError("found an empty cell where a label is needed", table.file, int(row), name)
    joined = ["/".join(parts) for parts in zip(*texts)]
    place = {name: i for i, name in enumerate(dict.fromkeys(joined))}
    return tuple(place), np.array([place[name] for name in joined])


def _read_distance(table: Table, options: FileOptions, layout: Layout) -> tuple[np.ndarray, np.ndarray | None]:
    """Return distances (m,) and their sigmas (m,) [m], None where not stated."""
    value = table.numbers(layout.distance, "length", options.units.get("distance", ""))[:, None]
    plausible.check_lengths(value, table, (layout.distance,))
    plausible.check_positive(value, table, (layout.distance,), "a distance must be above 0")
    sigma = None if options.sigma.distance is None else np.full(len(value), options.sigma.distance)
    if layout.sigma_distance:
        column = table.numbers(layout.sigma_distance, "length", options.units.get("sigma", ""))
        column = np.where(column < 0.0, column, np.maximum(column, options.sigma.floor))[:, None]
        plausible.check_positive(column, table, (layout.sigma_distance,), "a sigma must be above 0 (see sigma.floor)")
        sigma = column[:, 0]
    return value[:, 0], sigma


def _check_pairs(table: Table, layout: Layout, group: np.ndarray, names: Sequence[str], distance: np.ndarray) -> None:
    for number, name in enumerate(names):
        members = np.flatnonzero(group == number)
        first, last = members[0], members[-1]
        if len(members) != 2:
            message = f"pair '{name}' has {len(members)} rows; a distance joins two"
            raise MeasurementError(message, table.file, int(table.rows[last]), layout.group[-1])
        if abs(distance[first] - distance[last]) > 1e-9:
            message = (
                f"pair '{name}' has {distance[last]:g} m here and {distance[first]:g} m in row {table.rows[first]}"
            )
            raise MeasurementError(message, table.file, int(table.rows[last]), layout.distance)


def _links(table: Table, options: FileOptions, layout: Layout, group: np.ndarray) -> tuple[tuple[int, int, float], ...]:
    """Return the pairs of groups that share all labels but the socket's, with the known distance [m]."""
    if options.socket_distance is None:
        return ()
    texts = [table.texts(name) for name in layout.group]
    fixtures: dict[tuple[str, ...], dict[str, int]] = {}
    for parts, number in zip(zip(*texts), group):
        fixtures.setdefault(parts[:-1], {})[parts[-1]] = int(number)
    links = []
    for place, sockets in fixtures.items():
        if len(sockets) > 2 and not options.socket_pairs:
            message = f"{'/'.join(place) or 'the fixture'} has {len(sockets)} sockets ({', '.join(sockets)}): say which"
            message += " of them are socket_distance apart (socket_pairs = [['0', '1']] in the options)"
            raise MeasurementError(message, table.file, column=layout.group[-1])
        for a, b in options.socket_pairs or combinations(sockets, 2):
            if a in sockets and b in sockets:
                links.append((sockets[a], sockets[b], options.socket_distance))
    if not links:
        wanted = ", ".join(f"{a} and {b}" for a, b in options.socket_pairs) or "two sockets"
        message = f"no fixture position has {wanted}, so that socket_distance joins nothing"
        found = ", ".join(dict.fromkeys(texts[-1]))
        raise MeasurementError(f"{message}; found {found}", table.file, column=layout.group[-1])
    return tuple(links)
