"""Join joint values and measured points, each in a file of its own, to one table of measured poses.

==================  ===================================================================================================
joints              ``joints.csv``: one row per pose, or a log over time: a column per joint; or what a program of
                    `calib program` left at the controller (`calib formats programs`)
points              ``points.csv``: ``x y z``, with or without an orientation, sigmas, ``tool``
by name             a column ``name``, ``point``, ``pose``, ``id``, ``label`` or ``target`` (also in German, French,
                    Italian, Spanish) in both; ``P_007`` is ``p7``
by time             a column ``t``, ``time`` or ``timestamp`` in both (a number, or ISO 8601), of the same clock; points
                    measured while the arm moved are left out
by row              as many rows in both
by geometry         with a robot: the order in which the nominal arm explains the points
by motion           with a robot: points measured while the arm moves, by a clock of their own, and a log over time
logs                two logs of one motion (positions, torques): one recording for `calib identify`, by time or row
==================  ===================================================================================================

Several readings of one pose are averaged; their pooled scatter becomes ``sigma_x``, ``_y``, ``_z`` of the mean where it
has at least five degrees of freedom and the file states no sigma. A pose whose readings are further apart than
1 mm, and than ten times what such readings usually are, is left out and named. Units are those of the two files.

Columns of other names, units that the header does not state, joints as a controller shows them and the meaning of
angles are stated in options (``--options``: [columns], [units], controller, euler); the result is read without them.

By motion, both files have a column of times (seconds, or ``t [ms]``; 5 Hz or more), each by its own clock, and run
while the arm moves slowly. Offset and drift of the clocks are found from the motion; rows that cannot be used are left
out and counted; the rest is thinned to rows whose errors are independent. Notes above the table's header say all of it.
A clock that steps (by 5 ms or more, as far as that stands out from noise and backlash: not in each short stream),
wanders or restarts on the way is refused, with the row: cut the file there, and give `calib fit` the parts, each joined
on its own (`--stations one`).
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.distance import pdist

from calib.apps.controller_programs.program import joints_table
from calib.apps.controller_programs.targets import is_program
from calib.apps.joining.joined import NAMES, Joined, column_of
from calib.apps.joining.logs import clock_of, is_log, join_logs, seconds
from calib.apps.joining.mapping import JoinOptions, mapped, read_mapping, with_options
from calib.apps.joining.order import MAX_MISFIT, MIN_FOUND, MIN_POINTS, find_order
from calib.apps.joining.stated import check_columns, stated
from calib.apps.joining.streams import join_streams
from calib.arguments import checked
from calib.errors import MeasurementError, UsageError, counted, finding, listing, one_of, refuse_data, require
from calib.records import interpolated
from calib.toolkit.chains import CalibratedChain, Chain, as_described, controllers, load_calibrated
from calib.toolkit.installations import check_scale
from calib.toolkit.pose_data import (
    POSITION,
    SIGMA,
    FitOptions,
    PoseMeasurements,
    Sheet,
    Table,
    positions_by_shape,
    read_fit_options,
    read_table,
)
from calib.toolkit.recordings import bag_table, dataset_table, is_bag, is_dataset, series_of, words_of
from calib.toolkit.result_folders import joints_of, lines_of

METHODS = ("name", "time", "row", "geometry", "motion")
# requirements of each method except motion, for messages
REQUIREMENTS = ("both files need names (a column name, pose, id …)", "times (column t)", "as many rows", "give --robot")

# remark on a join by row without a robot
UNCHECKED = "order not checked: give --robot, whose nominal arm shows whether the rows belong together"

# Thresholds are our choice.
# largest distance of two readings of one pose [m], where their scatter is not known
MAX_DISTANCE = 1e-3
# largest distance of two readings of one pose, as a multiple of the median of such distances
MAX_DISTANCE_RATIO = 10.0
# smallest number of degrees of freedom of a scatter that is written as sigma
MIN_REPEATS = 5
# time before and after a point during which the arm has to stand still [s]
STANDSTILL = 0.25
# largest motion of a joint during this time, as a share of the joint's whole travel
MAX_MOTION = 1e-3
_MEASURED = re.compile(r"[xyz]\d*(_meas|_measured)?")


@checked
def join(
    joints: str | Path,
    points: str | Path,
    *,
    by: str = "",
    robot: str | Path | CalibratedChain | None = None,
    base: str | None = None,
    tip: str | None = None,
    options: str | Path | FitOptions | None = None,
) -> Joined:
    """Join a controller's joint values and an instrument's points to one table of measured poses.

    Args:
        joints: CSV file of joint values, one row per pose, or a log over time; or the file to which a program of `calib
            program` wrote the joint values at the controller.
        points: CSV file of measured points.
        by: ``name``, ``time``, ``row``, ``geometry`` or ``motion``; empty: the first of these for which both files have
            columns, except ``motion``.
        robot: the nominal robot, by whose geometry the order is checked or found: library name, file, folder of a fit,
            or in memory; None: not checked.
        base, tip: first and last link of the arm in a URDF; None: its root, and its flange.
        options: options whose [columns], [units], ``controller`` and ``euler`` say how the two files are read: in
            memory, or as a TOML file (``calib formats options``); None: their headers say it. The result needs none.

    Returns:
        The table, the index of each row's pose, and notes; ``write(path)`` writes the CSV that `fit_geometry` reads. By
        motion, also the clock (`calib.apps.joining.streams.Streamed`).

    Raises:
        UsageError: an unknown `by`, one for which the files have no columns, or ``motion`` or links without a robot.
        MeasurementError: the points were not measured at the poses of the joints' file.
    """
    one_of(by or "row", METHODS, "by", UsageError)
    joints_file, points_file = Path(joints), Path(points)
    named_links = base is not None or tip is not None
    require(robot is not None or not named_links, "--base and --tip are links of a robot: give --robot", UsageError)
    if isinstance(robot, str | Path):
        robot = load_calibrated(robot, base, tip)
    if by == "motion":
        if robot is None:
            raise UsageError("joining by motion needs the nominal arm's path: give --robot")
        return join_streams(joints_file, points_file, robot.complete, _pose_options(options))
    chain = None if robot is None else robot.complete
    point_table = _table(points_file)
    if is_program(joints_file):
        joint_table = joints_table(joints_file)
        options = _pose_options(options)
        check_columns(options, [joint_table, point_table], chain)
    else:
        joint_table = _table(joints_file)
        tables = (joint_table, point_table)
        mapping = _mapping(options)
        if _are_logs(*(with_options(table, mapping) for table in tables)):
            (first, second), notes = mapped(tables, mapping)
            joined: Joined = join_logs(first, second, by)
            return replace(joined, notes=(*notes, *joined.notes))
        options = _pose_options(options)
        check_columns(options, [joint_table, point_table], chain)
        joint_table = stated(joint_table, options.for_file(joints_file), chain, holds_joints=True)
    point_table = stated(point_table, options.for_file(points_file), chain, holds_points=True)
    return _joined(joint_table, point_table, by, chain)


def _table(path: Path) -> Table:
    """Return a CSV file, the joint states in a ROS bag, or a LeRobot data set, as a table."""
    if is_bag(path) and path.exists():
        return bag_table(path)
    return dataset_table(path) if is_dataset(path) else read_table(path)


def _pose_options(options: str | Path | FitOptions | None) -> FitOptions:
    """Return the options by which joint values and points are read."""
    return options if isinstance(options, FitOptions) else read_fit_options(options)


def _mapping(options: str | Path | FitOptions | None) -> JoinOptions:
    """Return names and units of columns, as the options state them for two logs."""
    if isinstance(options, FitOptions):
        return JoinOptions(options.columns, options.units)
    return read_mapping(None if options is None else Path(options))


def _are_logs(first: Table, second: Table) -> bool:
    """Return whether two tables are logs of one motion, the second without measured points."""
    return not _has_points(second) and is_log(first) and is_log(second)


def _has_points(table: Table) -> bool:
    """Return whether a table has columns of measured positions, by their names or the shape of these."""
    first_target = [f"{name}1" for name in POSITION.names]
    is_named = not {*POSITION.names, *first_target}.isdisjoint(table.header)
    return is_named or bool(positions_by_shape(table.header))


def _joined(joints: Table, points: Table, by: str, chain: Chain | None) -> Joined:
    name_columns = [column_of(joints, NAMES), column_of(points, NAMES)]
    time_columns = [clock_of(joints), clock_of(points)]
    possible = {
        "name": all(name_columns),
        "time": all(time_columns),
        "row": len(joints) == len(points),
        "geometry": bool(chain),
    }
    if not by:
        by = next((method for method, is_possible in possible.items() if is_possible), "")
    counts = f"{len(joints)} rows of joints, {len(points)} points"
    if not by or not possible[by]:
        method = f" by {by}" if by else ""
        raise UsageError(f"{counts} cannot be joined{method}: {', or '.join(REQUIREMENTS)}")

    notes = ()
    if by == "time":
        joints, pose, notes = _at_times(joints, points, *time_columns)
    elif by == "name":
        pose = _same_names(joints, points, *name_columns)
        if not (pose >= 0).any():
            raise MeasurementError(
                f"{points.file}: none of its names is in {joints.file}: name the poses alike in both files"
            )
    else:
        pose = np.arange(len(points))
    if chain is not None and by != "time":
        q, _ = Sheet(joints).joints(joints_of(chain))
        candidates = {} if by == "geometry" else {f"joined by {by}": pose}
        pose, notes = ordered(chain, q, points, candidates)
    else:
        notes = (f"{counts}, joined by {by}", *notes)
        if by == "row":
            notes = (*notes, UNCHECKED)
    keys = {*name_columns, *time_columns} - {""}
    return merged(joints, points, pose, (*joints.notes, *points.notes, *notes), keys)


def ordered(
    chain: Chain, q: np.ndarray, points: Table, candidates: dict[str, np.ndarray], sheet: Sheet | None = None
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return for each of m points the index of its pose among q (n, joints), -1 for none, and notes on the order.

    Args:
        chain: the nominal arm.
        q: joint values of the poses [rad or m].
        points: table of the measured points.
        candidates: orders that are tried first: description of the order to (m,) index of each point's pose.
        sheet: the points with the options for reading them; None: the default options.

    Raises:
        MeasurementError: no order explains the points.
    """
    position = _positions(sheet or Sheet(points))
    measured = np.flatnonzero(np.isfinite(position).all(axis=1))
    if len(measured) < MIN_POINTS:
        few = f"{len(measured)} points are too few to find their poses by the robot's geometry (at least {MIN_POINTS})"
        for origin, pose in candidates.items():
            if (pose >= 0).all():
                return pose, (f"{len(pose)} points, {origin}; {few}",)
        refuse_data(points.file, f"{few}: name them (a column 'pose' with the pose's number)")

    # says which unit explains points that spread too far
    block = PoseMeasurements.of(
        q[measured % len(q)], position[measured], joint_names=chain.joint_names, file=points.file
    )
    check_scale(block, chain)
    measured_candidates = {origin: pose[measured] for origin, pose in candidates.items()}
    order = find_order(chain, q, position[measured], measured_candidates)
    if order is None:
        _refuse_shown(chain, q, points, position, measured_candidates)
        searched, advice = "any order", ""
        if len(measured) < MIN_FOUND:
            searched = "their order"
            advice = f" With {MIN_FOUND} points or more any order is found; else name them (a column 'pose')"
        limit = 1e3 * MAX_MISFIT * chain.stretched_length()
        refuse_data(
            points.file,
            f"its {len(measured)} points do not fit the {len(q)} poses in {searched} (within {limit:.0f} mm of "
            f"the nominal arm): is this the right robot and list, and did instrument and target stay in place?{advice}",
        )
    pose = np.full(len(position), -1)
    pose[measured] = order.pose
    notes = [f"{len(measured)} points, {order.origin} ({1e3 * order.rms:.2g} mm rms from the nominal arm)"]
    strange = measured[order.pose < 0]
    if len(strange):
        notes.append(f"left out, since they are near no pose: rows {listing(points.rows[strange])}")
    if order.rivals:
        doubtful = measured[list(order.rivals)]
        pose[doubtful] = -1
        notes.append(f"left out, since several poses are equally near: rows {listing(points.rows[doubtful])}")
    return pose, tuple(notes)


def _refuse_shown(
    chain: Chain, q: np.ndarray, points: Table, position: np.ndarray, candidates: dict[str, np.ndarray]
) -> None:
    """Raise MeasurementError if the joint values explain the points as a controller shows them (a FANUC's J3).

    Args:
        chain: the nominal arm.
        q: (n, joints) joint values [rad or m].
        points: table of the measured points.
        position: (m, 3) measured positions [m]; NaN where none was measured.
        candidates: orders that are tried first.
    """
    measured = position[np.isfinite(position).all(axis=1)]
    for name, controller in controllers().items():
        if not controller.coupled:
            continue
        try:
            described = as_described(name, q, chain.joints)
        except UsageError:
            # this controller has no such arm
            continue
        if find_order(chain, described, measured, candidates) is not None:
            refuse_data(
                points.file,
                f"its points fit the joints as {controller.title} shows them, not as the description counts them: "
                f'state controller = "{name}" in the options (--options)',
            )


def merged(
    joints: Table,
    points: Table,
    pose: np.ndarray,
    notes: Sequence[str],
    keys: Collection[str],
    name_missing: bool = True,
) -> Joined:
    """Return the rows of joint values with their points; several readings of one pose are averaged.

    Args:
        joints, points: tables of joint values and of points.
        pose: (m,) index of each point's row of joints; -1 for none.
        notes: notes on the joining, to be extended.
        keys: names of the columns by which the files were joined; these columns are left out.
        name_missing: whether a note names the poses without a point.
    """
    position = _positions(Sheet(points))
    label = _labels(joints)
    # rows of the readings of each pose
    groups = {int(k): np.flatnonzero(pose == k) for k in np.unique(pose[pose >= 0])}
    missing = [label[k] for k in range(len(joints)) if k not in groups]
    stray = points.rows[pose < 0]
    groups, inconsistent = _consistent(position, groups, label, points)
    if not groups:
        raise MeasurementError(f"{points.file}: none of its {len(points)} points belongs to a pose of {joints.file}")
    notes = [*notes, *inconsistent]
    if missing and name_missing:
        notes.append(f"without a point: {len(missing)} of {len(joints)} poses: {listing(missing)}")
    if len(stray):
        notes.append(f"points left out: rows {listing(stray)}")

    pose_rows = np.array(list(groups), dtype=int)
    labels = np.array([label[k] for k in pose_rows], dtype=object)
    header, units, cells = ["pose"], [""], [labels]
    point_names = [name for name in points.header if name not in keys]
    for name in joints.header:
        if name not in keys and name not in point_names:
            column = joints.index(name)
            header.append(name)
            units.append(joints.units[column])
            cells.append(joints.cells[column][pose_rows])
    for name in point_names:
        header.append(name)
        units.append(points.units[points.index(name)])
        cells.append(_averaged(points, name, groups, position))

    # pooled scatter of repeated readings
    count = np.array([[len(rows)] for rows in groups.values()])
    repeats = int(count.sum() - len(count))
    if repeats:
        squares = np.zeros(3)
        for rows in groups.values():
            errors = position[rows] - position[rows].mean(axis=0)
            squares = squares + (errors**2).sum(axis=0)
        sigma = 1e3 * np.sqrt(squares / repeats)
        notes.append(
            f"{counted(repeats, 'repeated reading')} averaged, σ of one reading {np.mean(sigma):.2g} mm per axis"
        )
        has_sigma = any(name.startswith("sigma") for name in point_names)
        if repeats >= MIN_REPEATS and not has_sigma and np.all(sigma):
            header += SIGMA.names
            units += ["mm"] * 3
            cells += list((sigma / np.sqrt(count)).T)
    table = Table(points.file, tuple(header), tuple(units), tuple(cells), pose_rows + 1)
    return Joined(table, pose_rows, tuple(notes))


def _positions(sheet: Sheet) -> np.ndarray:
    """Return measured positions (m, 3) [m] of the m rows of `sheet`; NaN where none was measured.

    Of several targets, the first one is used.
    """
    columns = sheet.family(POSITION.names) or sheet.family(POSITION.names, "1")
    if not columns:
        refuse_data(sheet.table.file, f"has no x, y, z; found {', '.join(sheet.table.header)}")
    return sheet.numbers(columns, POSITION, gaps=True)


def _consistent(
    position: np.ndarray, groups: dict[int, np.ndarray], label: Sequence[str], points: Table
) -> tuple[dict[int, np.ndarray], list[str]]:
    """Return the groups of readings whose readings agree, and remarks on the other groups.

    Args:
        position: (m, 3) measured positions [m].
        groups: pose to indices of its readings.
        label: name of each pose.
        points: table of the points, for the remarks.
    """
    distances = {}
    for k, rows in groups.items():
        if len(rows) > 1:
            distances[k] = float(pdist(position[rows]).max())
    bound = MAX_DISTANCE
    if len(distances) > 2:
        usual = float(np.median(list(distances.values())))
        bound = max(bound, MAX_DISTANCE_RATIO * usual)
    consistent = dict(groups)
    findings = []
    for k, distance in distances.items():
        if distance > bound:
            rows = consistent.pop(k)
            findings.append(finding("readings-apart", pose=label[k], apart=distance, rows=points.rows[rows]))
    return consistent, lines_of(findings)


def _averaged(points: Table, name: str, groups: dict[int, np.ndarray], position: np.ndarray) -> np.ndarray:
    """Return a column of the points with one cell per group of readings.

    The cell is the mean for measured numbers; otherwise it is the cell of the reading nearest to the mean position.

    Args:
        points: table of the m points.
        name: name of the column.
        groups: pose to indices of its readings.
        position: (m, 3) measured positions [m].
    """
    cells = points.cells[points.index(name)]
    if _MEASURED.fullmatch(name) and cells.dtype == float:
        return np.array([cells[rows].mean() for rows in groups.values()])
    nearest = []
    for rows in groups.values():
        errors = position[rows] - position[rows].mean(axis=0)
        distance = np.linalg.norm(errors, axis=1)
        nearest.append(rows[np.argmin(distance)])
    return cells[nearest]


def _labels(joints: Table) -> list[str]:
    """Return a name for each row of joints: from the column of names if there is one, else the row numbers from 1."""
    name = column_of(joints, NAMES)
    if name:
        return joints.texts(name)
    return [str(row) for row in joints.rows]


def _same_names(joints: Table, points: Table, joint_column: str, point_column: str) -> np.ndarray:
    """Return for each point the row of joints with the point's name, (m,); -1 where no row has it.

    Args:
        joints, points: tables of joint values and of points.
        joint_column, point_column: names of the columns with the names of poses.
    """
    point_names = points.texts(point_column)
    joint_names = joints.texts(joint_column)
    # first by the whole names, then by their numbers
    for comparable in (_plain, _number):
        rows = {comparable(text): k for k, text in enumerate(joint_names)}
        if len(rows) < len(joints):
            refuse_data(joints.file, "has a name twice: each pose needs a name of its own", joint_column)
        pose = np.array([rows.get(comparable(text), -1) for text in point_names])
        if pose.max() >= 0:
            break
    return pose


def _plain(text: str) -> str:
    """Return the name `text` in comparable form: lower-case letters and digits, without leading zeros.

    ``P_007`` becomes ``p7``.
    """
    plain = re.sub(r"[^a-z0-9]", "", text.lower())
    return re.sub(r"(?<!\d)0+(?=\d)", "", plain)


def _number(text: str) -> str:
    """Return the last number in the name `text` without leading zeros; the whole name if it has no number."""
    numbers = re.findall(r"\d+", text) or [text]
    return numbers[-1].lstrip("0")


def _at_times(
    joints: Table, points: Table, joint_column: str, point_column: str
) -> tuple[Table, np.ndarray, tuple[str, ...]]:
    """Return joints at the times of the points, the pose index (m,) of each point (-1 if the arm moved), and notes.

    Args:
        joints, points: tables of joint values and of points, with times of one clock.
        joint_column, point_column: names of the columns of times.
    """
    t = seconds(joints, joint_column)
    point_times = seconds(points, point_column)
    not_after = np.flatnonzero(np.diff(t) <= 0.0)
    if len(not_after):
        joints.fail("the times do not increase", joint_column, int(not_after[0]) + 1)
    in_log = (point_times >= t[0]) & (point_times <= t[-1])
    if in_log.mean() < 0.5:
        of_points = f"{point_times.min():.10g} to {point_times.max():.10g} s"
        message = f"its points are of {of_points}, the joints of {t[0]:.10g} to {t[-1]:.10g} s"
        refuse_data(
            points.file,
            f"{message}: are both times of the same clock? Otherwise join by motion, row or name",
            point_column,
        )

    names, units, columns = [], [], []
    for name, unit, cells in zip(joints.header, joints.units, joints.cells):
        if name != joint_column and cells.dtype == float:
            names.append(name)
            units.append(unit)
            columns.append(joints.numbers(name, None))
    values = np.column_stack(columns)
    shifts = np.linspace(-STANDSTILL, STANDSTILL, 5)
    around = np.stack([interpolated(point_times + shift, t, values) for shift in shifts])
    motion, travel = np.ptp(around, axis=0), np.ptp(values, axis=0)
    # torques and currents are never at rest
    may_be_position = np.array([series_of(words_of(name)) in ("", "q") for name in names])
    still = (motion <= MAX_MOTION * travel + 1e-12)[:, may_be_position].all(axis=1)
    # one row per pose: the arm's motion between them is not known, and each was taken at rest
    if np.median(np.diff(t)) > 2.0 * STANDSTILL:
        row = np.abs(point_times[:, None] - t).argmin(axis=1)
        same_time = np.abs(point_times - t[row]) <= STANDSTILL
        around[2, same_time] = values[row[same_time]]
        still |= same_time
    at_points = Table(joints.file, tuple(names), tuple(units), tuple(around[2].T), points.rows)

    notes = [f"{len(points)} points, joined by time with a log of {t[-1] - t[0]:.4g} s"]
    moving = in_log & ~still
    if moving.any():
        notes.append(f"measured while the arm moved: rows {listing(points.rows[moving])}")
    if not in_log.all():
        notes.append(f"outside the log: rows {listing(points.rows[~in_log])}")
    pose = np.where(in_log & still, np.arange(len(point_times)), -1)
    return at_points, pose, tuple(notes)
