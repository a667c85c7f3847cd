"""Read a CSV file of measured poses into `PoseMeasurements`.

Columns by default (a unit in brackets is converted, ``q1 [deg]``, ``x [mm]``; plain headers are SI):

==================  ===================================================================================================
joints              the robot's joint names, or ``q_<joint name>``, or ``q1`` to ``qn``; else names of one series, with
                    words beside (``elbow.pos``) or numbered (``A1 … A6 E1``, ``J1``, ``Joint 1``, ``theta0``)
position, pose      ``x y z``; with ``qx qy qz qw``, ``r11`` to ``r33`` or three angles (``rx ry rz``, ``a b c``,
                    ``w p r``, ``roll pitch yaw``; the options' ``euler`` says what they mean, else the arm, where it
                    agrees with one meaning only) a pose; also with ``_meas``, ``_measured`` (where a file has both, the
                    options' [columns] say which is to be read); else by shape: ``position.x``, ``tvec_x``,
                    ``orientation.w``, ``phix1``, ``theta_x``, ``rvec_x``, ``T_00`` to ``T_33``, ``pose_0`` to
                    ``pose_15``
several reflectors  ``x1 y1 z1 x2 y2 z2 ...``, each a row of its own
not seen            a triple that is empty, one text (``lost``) or one large number (``9999``) three times
base frame          ``base_x`` … ``base_qw`` (or ``base_r11`` …), a frame on the robot's base measured with every row:
                    the target is then seen from there (options: ``base_frame``), and rows without it are left out;
                    ``base_sigma_x`` …, ``base_sigma_rx`` … (by default the target's); ``base_time`` beside ``time``
sigmas              ``sigma_x``, ``_y``, ``_z`` (numbered as the reflectors, or common), ``sigma_rx``, ``_ry``, ``_rz``
measured moving     ``late_x``, ``_y``, ``_z``, the target's velocity, with ``time``: the fit then takes offset and
                    drift of the instrument's clock as unknown
distance            ``distance`` with ``pair`` (two rows share a label), or with ``bar`` (the unknown other end);
                    ``sigma_distance``
sockets, plane      ``socket`` (grouped together with ``tool_position``), ``plane``
tool                ``tool``: label of the reflector that a row saw
torques             ``tau1`` to ``taun`` [N m] (or ``tau_<joint name>``): what the joints' sensors read at rest; empty
                    where they read nothing. They drive the compliance, and show a payload that nobody stated
payload             ``payload`` [kg]: mass that the tip carries; its centre: options, ``payload``
==================  ===================================================================================================

All other columns are ignored and listed. Files of RoboDK: `calib formats robodk`. Units may stand behind a slash
(``X / mm``). Columns of foreign names without a unit are deg or mm where they cannot be SI. A table without names is
read if the nominal arm agrees with one arrangement of its columns only.

A base frame (as the study's LEDs on the base, Kolyubin et al. 2019, section 3.5) takes out how instrument and base move
against each other: `calib fit` says how much. It adds the noise of both, and its orientation's over the distance to the
target, so that it is of no use where nothing moves.

Rows that belong together: sockets, planes, pairs and bars.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from calib.data.csv_table import Table, read_header, read_table, split_units
from calib.data.joint_columns import COMMANDED_WORDS, words_of
from calib.data.poses import plausible
from calib.data.poses.base_frame import rows_with_base, seen_from_base
from calib.data.poses.columns import (
    DISTANCE,
    LATE,
    OURS,
    PAYLOAD,
    POSITION,
    SIGMA,
    SIGMA_DISTANCE,
    SIGMA_ROTATION,
    SUFFIXES,
    TIME,
    TORQUE,
    TURNS,
    Layout,
    Sheet,
    Undecided,
    find_layout,
    unread_rivals,
    with_shapes,
)
from calib.data.poses.fit_options import FileOptions
from calib.data.poses.measurements import (
    Bars,
    Distances,
    GroupedMeasurements,
    Planes,
    PoseMeasurements,
    Poses,
    Positions,
    Sockets,
)
from calib.data.poses.name_shapes import REJECTED_WORDS, positions_by_shape
from calib.data.poses.placeholders import without_placeholders
from calib.data.poses.robodk import FORMS
from calib.data.poses.silent_units import with_silent_units
from calib.data.poses.unnamed import arrangements
from calib.data.schema import Joints, refuse
from calib.records import FieldValues
from calib.units import ANGLES

# Largest number that is an angle [deg], and least spread of each of three angles over the poses [rad] (our choice).
MAX_ANGLE = 360.0
MIN_SPREAD = 0.3


def read_groups(sheet: Sheet, layout: Layout, q: np.ndarray) -> GroupedMeasurements:
    """Return grouped measurements from the rows of a table.

    Args:
        sheet: the table with its options.
        layout: the columns to read.
        q: (m, n) joint values of the rows [rad or m].
    """
    table, options = sheet.table, sheet.options
    names, group = labels(table, layout.group)
    tool_names, tool = (options.tool,), np.zeros(len(q), dtype=int)
    if layout.tool:
        tool_names, tool = labels(table, (layout.tool,))
    notes = ()
    single = [name for name, size in zip(names, np.bincount(group)) if size == 1]
    if single:
        notes = (
            f"{layout.kind} {', '.join(single[:5])}: measured in one row only, which determines nothing; measure "
            "more rows",
        )
    common: FieldValues = {
        "group": group,
        "group_names": names,
        "tool": tool,
        "tool_names": tool_names,
        "file": table.file,
        "rows": table.rows,
        "notes": notes,
    }
    position_sigma = None
    sigma_along = None
    if options.sigma.position is not None:
        position_sigma = np.tile(options.sigma.position, (len(q), 1))
        sigma_along = position_sigma[:, 0]
    if layout.kind == Sockets.kind:
        return Sockets(q, layout.joints, sigma=position_sigma, links=_links(sheet, layout, group), **common)
    if layout.kind == Planes.kind:
        return Planes(q, layout.joints, sigma=sigma_along, **common)
    distance, sigma = _read_distance(sheet, layout)
    if sigma is None:
        sigma = sigma_along
    if layout.kind == Bars.kind:
        return Bars(q, layout.joints, distance, sigma=sigma, **common)
    _check_pairs(table, layout, group, names, distance)
    return Distances(q, layout.joints, distance, sigma=sigma, **common)


def labels(table: Table, columns: Sequence[str]) -> tuple[tuple[str, ...], np.ndarray]:
    """Return the distinct labels in order of appearance, and the index (m,) of each row's label.

    The labels of several columns are joined by ``/``.

    Args:
        table: the table.
        columns: names of the columns with labels.
    """
    texts = np.column_stack([np.array(table.texts(name), dtype=object) for name in columns])
    empty = (texts == "") | (texts == "nan")
    refuse(table, empty, columns, lambda row, k: "found an empty cell where a label is needed")
    joined = ["/".join(parts) for parts in texts]
    index: dict[str, int] = {}
    for label in joined:
        index.setdefault(label, len(index))
    return tuple(index), np.array([index[label] for label in joined])


def _read_distance(sheet: Sheet, layout: Layout) -> tuple[np.ndarray, np.ndarray | None]:
    """Return distances (m,) and their sigmas (m,) [m]; sigmas are None if neither columns nor options contain them.

    Args:
        sheet: the table with its options.
        layout: the columns to read.
    """
    distance = sheet.numbers(layout.distance[:1], DISTANCE)[:, 0]
    options = sheet.options.sigma
    if len(layout.distance) == 1 and options.distance is None:
        return distance, None
    if len(layout.distance) == 1:
        return distance, np.full(len(distance), options.distance)
    sigma = sheet.numbers(layout.distance[1:], replace(SIGMA_DISTANCE, positive=""))
    sigma = np.where(sigma < 0.0, sigma, np.maximum(sigma, options.floor))
    sigma = SIGMA_DISTANCE.check(sigma, sheet.table, layout.distance[1:])
    return distance, sigma[:, 0]


def _check_pairs(table: Table, layout: Layout, group: np.ndarray, names: Sequence[str], distance: np.ndarray) -> None:
    for number, name in enumerate(names):
        members = np.flatnonzero(group == number)
        first, last = members[0], members[-1]
        if len(members) != 2:
            message = f"pair '{name}' has {len(members)} rows; a distance needs two"
            table.fail(message, layout.group[-1], last)
        if abs(distance[first] - distance[last]) > 1e-9:
            message = (
                f"pair '{name}' has {distance[last]:g} m here and {distance[first]:g} m in row {table.rows[first]}"
            )
            table.fail(message, layout.distance[0], last)


def _links(sheet: Sheet, layout: Layout, group: np.ndarray) -> tuple[tuple[int, int, float], ...]:
    """Return the pairs of groups that differ only in the socket's label, each with the known distance [m].

    Args:
        sheet: the table with its options, which contain the known distances between sockets.
        layout: the columns to read.
        group: (m,) index of each row's group.
    """
    table, options = sheet.table, sheet.options
    if options.socket_distance is None:
        return ()
    texts = [table.texts(name) for name in layout.group]
    fixtures: dict[tuple[str, ...], dict[str, int]] = {}
    for parts, number in zip(zip(*texts), group):
        fixture, socket = parts[:-1], parts[-1]
        fixtures.setdefault(fixture, {})[socket] = int(number)
    links = []
    for fixture, sockets in fixtures.items():
        if len(sockets) > 2 and not options.socket_pairs:
            name = "/".join(fixture) or "the fixture"
            sheet.fail(
                f"{name} has {len(sockets)} sockets ({', '.join(sockets)}): state which of "
                "them are socket_distance apart (socket_pairs = [['0', '1']] in the options)",
                layout.group[-1],
            )
        for a, b in options.socket_pairs or combinations(sockets, 2):
            if a in sockets and b in sockets:
                links.append((sockets[a], sockets[b], options.socket_distance))
    if not links:
        expected = ", ".join(f"{a} and {b}" for a, b in options.socket_pairs) or "two sockets"
        sockets = ", ".join(dict.fromkeys(texts[-1]))
        message = f"no fixture position has {expected}, needed for socket_distance; found {sockets}"
        sheet.fail(message, layout.group[-1])
    return tuple(links)


def read_measurements(
    source: str | Path | Table, joints: Joints | Sequence[str], options: FileOptions | None = None
) -> list[PoseMeasurements]:
    """Return the measurements in a file, or in a table read from one.

    Args:
        source: the file, or the table.
        joints: the robot's n joints, or only their names (then taken as revolute without limits).
        options: column names, units and kind if the header does not contain them; None: the defaults.

    Returns:
        A list of one block.

    Raises:
        MeasurementError: an invalid file or value; the message contains row and column.
    """
    robot = Joints.of(joints)
    options = options or FileOptions()
    table = source if isinstance(source, Table) else None
    path = source.file if isinstance(source, Table) else source
    notes: tuple[str, ...] = ()
    form = options.format
    if table is None and not form:
        _ask_for_names(path, robot, options)
    if not form:
        header = read_header(path)[0] if table is None else ()
        matching = [name for name, (matches, _) in FORMS.items() if matches(header)]
        form = matching[0] if matching else "csv"
    if form in FORMS:
        reader: Callable[..., tuple[Table, FileOptions, tuple[str, ...]]] = FORMS[form][1]
        table, options, notes = reader(path, len(robot.names), options)
    table = table or read_table(path)
    options = replace(options, columns=_without_units(options.columns, table))
    # Names that the reader of the form has understood need no map.
    if table.notes:
        mapped = options.columns.items()
        columns = {name: heading for name, heading in mapped if heading in table or name not in table}
        options = replace(options, columns=columns)
    sheet = with_shapes(_select_rows(Sheet(table, options)), robot)
    layout = find_layout(sheet, robot)
    sheet, unit_notes = with_silent_units(sheet, layout, robot)
    sheet, unseen_notes = without_placeholders(sheet, layout)
    sheet, base_notes = rows_with_base(sheet, layout)
    number_columns = layout.used.difference(layout.group, layout.torques, [layout.tool])
    # Where a file has several targets, one that was not seen is a gap.
    columns_with_gaps: set[str] = set()
    if len(layout.positions) > 1:
        columns_with_gaps.update(*layout.positions, *layout.sigmas)
    sheet.table.check([name for name in sheet.table.header if name in number_columns], columns_with_gaps)
    q, _ = sheet.joints(robot)
    turn_notes: tuple[str, ...] = ()
    if options.check_limits:
        q, turn_notes = plausible.within_limits(q, robot, layout.joints)
    notes = (*sheet.table.notes, *notes, *layout.notes, *unit_notes, *unseen_notes, *turn_notes, *base_notes)
    notes = (*notes, *plausible.check_joints(q, sheet, layout.joints, robot))
    if layout.positions:
        block: PoseMeasurements = _read_targets(sheet, layout, q)
    else:
        block = read_groups(sheet, layout, q)
    block = _with_loads(sheet, layout, block)
    ignored = tuple(name for name in sheet.table.header if name not in layout.used)
    rivals = unread_rivals(sheet, layout, robot)
    notes += rivals
    if layout.kind == Positions.kind and not options.kind and not rivals:
        notes += _unread_angles(sheet.table, ignored)
    station = options.station or Path(path).stem
    return [replace(block, station=station, ignored=ignored, notes=(*notes, *block.notes))]


def _with_loads(sheet: Sheet, layout: Layout, block: PoseMeasurements) -> PoseMeasurements:
    """Return the block with the torques that the joints measured at rest, and with the stated payload.

    Args:
        sheet: the table with its options.
        layout: the columns to read.
        block: the measurements, one or several per row of the table.
    """
    rows = np.searchsorted(sheet.table.rows, block.rows)
    if layout.torques:
        torque = sheet.numbers(layout.torques, TORQUE, gaps=True)
        block = replace(block, measured_torque=torque[rows])
    block = replace(block, torque_fault=layout.torque_fault)
    stated = sheet.options.payload
    if not layout.payload and stated.mass is None:
        return block
    mass = np.full(len(sheet.table), np.nan if stated.mass is None else stated.mass)
    if layout.payload:
        mass = sheet.numbers((layout.payload,), PAYLOAD)[:, 0]
        refuse(
            sheet.table, mass < 0.0, [layout.payload], lambda row, k: f"found {mass[row]:g} kg: a payload has a mass"
        )
    centre = np.full(3, np.nan) if stated.centre is None else np.array(stated.centre)
    payload = np.column_stack([mass, np.tile(centre, (len(mass), 1))])
    return replace(block, payload=payload[rows])


def _unread_angles(table: Table, ignored: Sequence[str]) -> tuple[str, ...]:
    """Return a note on the first three neighbouring columns that are not read and look like angles; () without such.

    Args:
        table: the table.
        ignored: names of the columns that are not read.
    """
    for first in range(len(table.header) - 2):
        names = table.header[first : first + 3]
        cells = table.cells[first : first + 3]
        if not set(names) <= set(ignored) or any(values.dtype != float for values in cells):
            continue
        if not set(map(str.lower, table.units[first : first + 3])) <= {"", *ANGLES}:
            continue
        # x_target y_target z_target: a commanded position, or another quantity
        terms = {term for name in names for term in words_of(name)}
        if positions_by_shape(names) or terms & (REJECTED_WORDS | COMMANDED_WORDS):
            continue
        values = np.stack(cells, axis=1)
        largest = np.abs(values).max(initial=0.0)
        # numbers of rows and of points are whole
        is_fractional = (values % 1.0 != 0.0).any(axis=0).all()
        is_spread = (np.ptp(values, axis=0) > MIN_SPREAD).all()
        if len(values) and largest <= MAX_ANGLE and is_fractional and is_spread:
            columns = ", ".join(names)
            mapping = ", ".join(f'{angle} = "{name}"' for angle, name in zip(TURNS.names, names))
            return (
                f"{columns} are not read, and look like three angles beside the position: only positions are fitted. "
                f"If they are the orientation, state it in the options: columns = {{ {mapping} }}",
            )
    return ()


def _ask_for_names(path: str | Path, robot: Joints, options: FileOptions) -> None:
    """Raise `Undecided` for a file without names whose number of columns suits the robot.

    Args:
        path: the file.
        robot: the robot's joints.
        options: options for reading the file.
    """
    possible = arrangements(path, len(robot.names), options)
    if possible is None:
        return
    table, choices = possible
    lines = " or ".join(list(choices)[:2])
    message = (
        f"has no header: put a line of names and units (q1 [deg], x [mm]) above the numbers, as in {lines}, or state "
        "`format` in the options for a known headerless format"
    )
    raise Undecided(table, message, choices)


def _without_units(columns: Mapping[str, str], table: Table) -> dict[str, str]:
    """Return the columns that the options map, with the table's names where the options have headings with units.

    Args:
        columns: the toolkit's name of a column → the file's name, or its heading (``X / mm``).
        table: the table.
    """
    names, _ = split_units(list(columns.values()))
    result = {}
    for (standard_name, heading), name in zip(columns.items(), names):
        result[standard_name] = heading if heading in table or name not in table else name
    return result


def joint_columns(path: str | Path) -> tuple[str, ...]:
    """Return the header names of `path` that may be joints, without ``q_``: all names unknown to the toolkit.

    Callers compare them with the joint names of a URDF's chains, to find the chain that was measured.
    """
    toolkit_names = {name + suffix for name in OURS for suffix in SUFFIXES}
    names, units = read_header(path)
    columns = []
    for name, unit in zip(names, units):
        is_target = name[:1] in "xyz" and name[1:].isdigit()
        if name not in toolkit_names and not is_target and unit not in ("s", "C", "°C"):
            columns.append(name.removeprefix("q_"))
    return tuple(columns)


def _select_rows(sheet: Sheet) -> Sheet:
    """Return the sheet with only those rows that the option ``where`` selects.

    Args:
        sheet: the table with its options.
    """
    table = sheet.table
    keep = np.ones(len(table), dtype=bool)
    for name, values in sheet.options.where.items():
        texts = table.texts(name)
        keep &= np.isin(texts, list(values))
        if not keep.any():
            examples = ", ".join(list(dict.fromkeys(texts))[:10])
            sheet.fail(f"no row is selected by where = {', '.join(values)}; found {examples}", name)
    return sheet if keep.all() else replace(sheet, table=table.where(keep))


def _read_targets(sheet: Sheet, layout: Layout, q: np.ndarray) -> Positions:
    """Return positions or poses, one row per measured target, in the file's order.

    Args:
        sheet: the table with its options.
        layout: the columns to read.
        q: (m, n) joint values of the rows [rad or m].
    """
    table = sheet.table
    several = len(layout.positions) > 1
    position = np.stack([_position(sheet, columns, several) for columns in layout.positions], axis=1)
    visible = np.asarray(~np.isnan(position).any(axis=2))
    row, target = np.nonzero(visible)
    if not len(row):
        sheet.fail("no target was seen in any row", layout.positions[0][0])

    names, tool = (sheet.options.tool,), target
    if several:
        names = tuple(f"{sheet.options.tool} {k + 1}" for k in range(len(layout.positions)))
    elif layout.tool:
        names, tool = labels(table, (layout.tool,))
    sigma = _sigma(sheet, layout, visible)
    notes = []
    hidden_counts = len(visible) - np.sum(visible, axis=0)
    for columns, count in zip(layout.positions, hidden_counts):
        if count:
            notes.append(f"{', '.join(columns)}: not seen in {count} of {len(visible)} rows")
    common: FieldValues = {
        "sigma": None if sigma is None else sigma[row, target],
        "tool": tool,
        "tool_names": names,
        "file": table.file,
        "rows": table.rows[row],
        "late": _late(sheet, layout, row),
        "notes": tuple(notes),
    }
    block = Positions(q[row], layout.joints, position[row, target], **common)
    if layout.kind == Poses.kind:
        quaternion = plausible.orientation(sheet, layout.orientation)
        common["sigma_rotation"] = _sigma_rotation(sheet, layout)
        common["euler"] = sheet.options.euler if len(layout.orientation) == 3 else ""
        if sheet.options.camera.mounting != "auto":
            common["mounting"] = sheet.options.camera.mounting
        block = Poses(q[row], layout.joints, block.position, quaternion, **common)
    if not layout.base:
        return block
    return seen_from_base(sheet, layout, block, row)


def _position(sheet: Sheet, names: Sequence[str], gaps: bool) -> np.ndarray:
    position = sheet.numbers(names, POSITION, gaps)
    empty = np.isnan(position)
    partial = empty & ~empty.all(axis=1, keepdims=True)
    message = f"is empty, unlike others of {', '.join(names)}: leave all of them empty where a target was not seen"
    refuse(sheet.table, partial, names, lambda row, k: message)
    return position


def _sigma(sheet: Sheet, layout: Layout, visible: np.ndarray) -> np.ndarray | None:
    """Return position sigmas (m, targets, 3) [m] from the columns, or from the options; None if neither contains them.

    Args:
        sheet: the table with its options.
        layout: the columns to read.
        visible: (m, targets) whether each target was measured.
    """
    options = sheet.options.sigma
    if not layout.sigmas:
        if options.position is None:
            return None
        return np.tile(options.position, (*visible.shape, 1))
    stack = []
    for k, names in enumerate(layout.sigmas):
        is_seen = visible[:, k : k + 1]
        sigma = sheet.numbers(names, replace(SIGMA, positive=""), gaps=not is_seen.all())
        sigma = np.where(sigma < 0.0, sigma, np.maximum(sigma, options.floor))
        SIGMA.check(np.where(is_seen, sigma, np.nan), sheet.table, names)
        refuse(
            sheet.table,
            np.isnan(sigma) & is_seen,
            names,
            lambda row, k: "is empty where a target was seen: state σ for every row, or remove the column",
        )
        stack.append(sigma)
    return np.stack(stack, axis=1)


def _late(sheet: Sheet, layout: Layout, index: np.ndarray) -> np.ndarray | None:
    """Return the derivatives (m, 2, 3) of positions by offset [m/s] and drift [m] of a clock; None without the columns.

    Args:
        sheet: the table with its options.
        layout: the columns to read.
        index: (m,) indices of the table's rows.
    """
    if not layout.late:
        return None
    velocity = sheet.numbers(layout.late[:3], LATE)[index]
    t = sheet.numbers(layout.late[3:], TIME)[index]
    return np.stack([velocity, (t - t.mean()) * velocity], axis=1)


def _sigma_rotation(sheet: Sheet, layout: Layout) -> np.ndarray | None:
    if layout.sigma_rotation:
        return sheet.numbers(layout.sigma_rotation, SIGMA_ROTATION)
    sigma = sheet.options.sigma.orientation
    return None if sigma is None else np.tile(sigma, (len(sheet.table), 1))
