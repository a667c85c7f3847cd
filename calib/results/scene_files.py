"""Reading of scenes (`calib.results.scene`) from result folders, and from CSV files of poses.

A folder is that of a fit, an identification, an excitation, a planned motion, or a session that contains several of
these. The robot's meshes are those of the URDF's ``<visual>`` elements.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.config import read_toml
from calib.data.csv_table import Table, read_table
from calib.data.poses.pose_lists import read_poses
from calib.data.schema import Joints
from calib.dynamics.torque_rows import MOTOR, ROWS
from calib.errors import CalibError, UsageError, refuse_option, require
from calib.geometry import installation
from calib.geometry.installation import Installation, see
from calib.identification import model_file
from calib.procedure.dynamic_stage.folder import IdentificationFolder
from calib.procedure.excitation import coefficients, stored_front
from calib.procedure.kinematic_stage.folder import IN_SESSION, VALIDATED, FitFolder, ValidationFolder
from calib.procedure.robot_kinds import stage_of
from calib.result_kinds import refusal
from calib.results.scene import Drawn, ErrorSizes, Measured, Played, Scene, Torques, TradeOffs, Visual
from calib.robot import calibrated, library
from calib.robot.chain import Chain, joint_kinds
from calib.robot.collision import find_mesh, urdf_meshes
from calib.robot.formats.urdf_tree import is_urdf, numbers, origin
from calib.robot.library import load, resolve
from calib.transforms import invert

# meshes that the viewer shows
DRAWABLE = (".stl", ".obj", ".dae", ".glb", ".gltf")
# column of the 95 % intervals in tables of errors, without its unit
INTERVAL95 = "interval95"
# of a run that is drawn [Hz] (our choice)
REHEARSAL_RATE = 10.0


def read(folder: str | Path, robot: str | None = None) -> Scene:
    """Return the scene of the results in a folder: robot, poses, motions, torques.

    Args:
        folder: folder of a fit, an identification, an excitation, a plan, or a session; or a CSV of poses or of a run.
        robot: name or file of the robot to draw; None: the robot in the folder.

    Raises:
        UsageError: if there is nothing to draw.
    """
    folder = Path(folder)
    is_csv = folder.is_file() and folder.suffix == ".csv"
    require(is_csv or folder.is_dir(), f"{folder} is neither folder nor CSV; give a fit, session or motion", UsageError)
    if is_csv and robot is None:
        refuse_option(folder, "robot of these poses unknown; give --robot")
    chain, source = _robot(folder, robot)
    meshes, notes = _meshes(chain, source)
    measured, sizes = _errors(folder, chain)
    pose_files = [folder] if is_csv else sorted(folder.glob("2-poses/*.csv"))
    chosen, runs = _plans(pose_files, chain)
    motions = _motions(folder)
    torques = _all_torques(folder, chain)
    fronts, damaged = _fronts(folder)
    notes += damaged
    require(measured or sizes or chosen or runs or motions or torques or fronts, refusal(folder, "view"), UsageError)
    if chain is None:
        notes.append("no robot is shown: the folder does not name one; give --robot")
    resolved = folder.resolve()
    return Scene(
        title=resolved.stem if is_csv else resolved.name,
        chain=chain,
        meshes=tuple(meshes),
        measured=tuple(measured),
        sizes=tuple(sizes),
        chosen=tuple(chosen),
        played=(*runs, *motions),
        torques=tuple(torques),
        fronts=tuple(fronts),
        notes=tuple(notes),
    )


def _robot(folder: Path, robot: str | None) -> tuple[Chain | Drawn | None, Path | None]:
    """Return the robot to draw (None: unknown), and the file of its description, such as a URDF (None: not found).

    Args:
        folder: the result folder.
        robot: name or file of the robot; None: the robot in the folder.
    """
    stage = stage_of(robot or folder, "view")
    if stage is not None:
        return stage.run(), None
    if robot is not None:
        return load(robot), resolve(robot)
    for path in (folder / calibrated.ROBOT, folder / IN_SESSION / calibrated.ROBOT, folder / coefficients.ARM):
        if path.is_file():
            robot_file = calibrated.read(path)
            source = Path(robot_file.source) if robot_file.source else None
            if source is not None and not source.is_file():
                source = None
            return robot_file.complete, source
    for path in sorted(folder.glob("1-robot/robot.*")):
        return load(str(path)), path
    # Motions of earlier versions state the robot's name alone.
    try:
        name = read_toml(folder / coefficients.NAME).get("robot", "")
    except CalibError:
        return None, None
    if name in library.names():
        return load(name), None
    return None, None


def _meshes(chain: Chain | Drawn | None, source: Path | None) -> tuple[list[Visual], list[str]]:
    """Return the meshes of the moving links, and a note if mesh files are missing.

    Args:
        chain: the robot; None: unknown.
        source: file of the robot's description; without a URDF of a serial arm there are no meshes.
    """
    if not isinstance(chain, Chain) or source is None or not is_urdf(source) or not chain.links:
        return [], []
    meshes, missing = visuals(source)
    links = (chain.base, *chain.links)
    moving = [mesh for mesh in meshes if mesh.link in links]
    notes = []
    if missing:
        notes.append(
            f"{len(missing)} meshes of {source.name} were not found, e.g. {missing[0]}: their links are drawn as lines"
        )
    return moving, notes


def visuals(path: str | Path) -> tuple[list[Visual], list[str]]:
    """Return the meshes of a URDF's ``<visual>`` elements, and the names of missing mesh files, for the URDF at `path`.

    The XML is not parsed by yourdfpy, which raises an error (ValueError, TypeError) for a file with a capsule or with a
    ``<visual>`` without geometry. ``package://`` is resolved as for collision shapes, see `find_mesh`.
    """
    search_folders = list(Path(path).resolve().parents)
    meshes = []
    missing = []
    for link, visual, mesh in urdf_meshes(path, "visual"):
        name = mesh.attributes.get("filename", "")
        file = find_mesh(name, search_folders)
        if file is None or file.suffix.lower() not in DRAWABLE:
            missing.append(name)
            continue
        scale = numbers(mesh, "scale", str(path), "1 1 1")
        meshes.append(Visual(link.attributes.get("name", ""), file, origin(visual, str(path)), scale))
    return meshes, missing


def _errors(folder: Path, chain: Chain | Drawn | None) -> tuple[list[Measured], list[ErrorSizes]]:
    """Return the errors of a fit's rows and of a session's held-out poses.

    Args:
        folder: folder of a fit or of a session.
        chain: the robot that is drawn; None: unknown.

    Returns:
        Errors with positions in the arm's base frame, and errors of which only the magnitudes are known.
    """
    measured = []
    sizes = []
    for fit_folder in (folder, folder / IN_SESSION):
        if not FitFolder(fit_folder).residuals.is_file():
            continue
        poses = _with_unseen(_measured(fit_folder, chain), ValidationFolder(folder / VALIDATED).errors)
        if len(poses.q):
            measured.append(poses)
        sizes += [rows for rows in _unplaced(fit_folder, chain) if len(rows.q)]
    return measured, sizes


def _measured(folder: Path, chain: Chain | Drawn | None) -> Measured:
    """Return the measured positions in ``residuals.csv``, with the predictions of both arms.

    The arms are the nominal and the calibrated one.

    Args:
        folder: folder of the fit.
        chain: the robot that is drawn; None: unknown.
    """
    if isinstance(chain, Drawn):
        return Measured(*chain.measured(folder))
    after, before = installation.read_arms(folder)
    table = read_table(FitFolder(folder).residuals)
    table = table.where(_is_placed(table, after))
    q = _joint_values(table, after)
    miss = _triples(table, "d", "length")
    turned = np.full((len(q), 3), np.nan)
    if "drx" in table:
        turned = _triples(table, "dr", "angle")
    seen = np.zeros((len(q), 3))
    nominal = np.zeros((len(q), 3))
    modelled = np.zeros((len(q), 3))
    stations = np.array(table.texts("station"))
    tools = np.array(table.texts("tool"))
    for station, tool in sorted(set(zip(stations.tolist(), tools.tolist()))):
        rows = np.flatnonzero((stations == station) & (tools == tool))
        s = after.station_names.index(station)
        t = after.tool_names.index(tool)
        T_base_station = invert(after.stations[s])
        rotation = T_base_station[:3, :3].T
        modelled[rows] = _points(after, q[rows], s, t) @ rotation + T_base_station[:3, 3]
        seen[rows] = modelled[rows] + miss[rows] @ rotation
        nominal_cell = before
        if station not in before.station_names:
            nominal_cell = replace(after, chain=before.chain)
        nominal[rows] = _points(nominal_cell, q[rows], s, t) @ rotation + T_base_station[:3, 3]
    unseen = np.array(table.texts("set")) != "fit"
    return Measured(q, seen, nominal, modelled, unseen, turned, _intervals(table))


def _intervals(table: Table) -> np.ndarray | None:
    """Return the radii (m,) [m] of the rows' 95 % intervals; None in a table of an earlier version."""
    if INTERVAL95 not in table:
        return None
    return table.numbers(INTERVAL95, "length", gaps=True)


def _unplaced(folder: Path, chain: Chain | Drawn | None) -> list[ErrorSizes]:
    """Return the errors of those rows of ``residuals.csv`` that have no position in the arm's base frame, by kind.

    Args:
        folder: folder of the fit.
        chain: the robot that is drawn; None: unknown.
    """
    if isinstance(chain, Drawn):
        return []
    cell = installation.read(folder)
    table = read_table(FitFolder(folder).residuals)
    table = table.where(~_is_placed(table, cell))
    has_position = ~np.isnan(table.numbers("dx", "length", gaps=True))
    result = []
    for kind, rows in (("position", has_position), ("distance", ~has_position)):
        part = table.where(rows)
        nominal = part.numbers("nominal size", "length", gaps=True)
        fitted = part.numbers("size", "length", gaps=True)
        unseen = np.array(part.texts("set")) != "fit"
        result.append(ErrorSizes(kind, _joint_values(part, cell), nominal, fitted, unseen, _intervals(part)))
    return result


def _is_placed(table: Table, cell: Installation) -> np.ndarray:
    """Return flags (m,): whether a row's error can be drawn as an arrow at the measured position.

    This requires a measured position and a station whose pose the fit contains.

    Args:
        table: content of ``residuals.csv`` (m rows).
        cell: the calibrated arm with the poses of stations and tools.
    """
    has_position = ~np.isnan(table.numbers("dx", "length", gaps=True))
    return has_position & np.isin(table.texts("station"), cell.station_names)


def _with_unseen(fitted: Measured, errors: Path) -> Measured:
    """Return the fitted poses, followed by the held-out poses of a session if there is a file of their errors.

    Args:
        fitted: the poses of the fit.
        errors: path of the file of held-out poses; it need not exist.
    """
    if not errors.is_file():
        return fitted
    table = read_table(errors)
    # written by an earlier version
    if "x" not in table:
        return fitted
    table = table.where(~np.isnan(table.numbers("x", "length", gaps=True)))
    n = fitted.q.shape[1]
    q = np.column_stack([table.numbers(name, "joint") for name in table.header[2 : 2 + n]])
    seen = _triples(table, "", "length")
    nominal = seen + _triples(table, "to_nominal_", "length")
    modelled = seen + _triples(table, "to_calibrated_", "length")
    return Measured(
        np.concatenate([fitted.q, q]),
        np.concatenate([fitted.seen, seen]),
        np.concatenate([fitted.nominal, nominal]),
        np.concatenate([fitted.calibrated, modelled]),
        np.concatenate([fitted.unseen, np.ones(len(q), dtype=bool)]),
        np.concatenate([fitted.turned, np.full((len(q), 3), np.nan)]),
        _joined(fitted.interval, _intervals(table)),
    )


def _joined(fitted: np.ndarray | None, held_out: np.ndarray | None) -> np.ndarray | None:
    """Return the intervals of fitted and of held-out rows; None where either is unknown."""
    if fitted is None or held_out is None:
        return None
    return np.concatenate([fitted, held_out])


def _points(cell: Installation, q: np.ndarray, station: int, tool: int) -> np.ndarray:
    """Return the tool's positions (m, 3) [m] in the station's frame at joint values q (m, n), deflections included.

    Args:
        cell: arm, stations and tools.
        q: joint values [rad or m].
        station, tool: indices (from 0) of the station and of the tool.
    """
    return see(cell, q, station, tool).point.T


def _joint_values(table: Table, cell: Installation) -> np.ndarray:
    """Return the joint values (m, n) [rad or m] in ``residuals.csv``.

    Args:
        table: content of the file.
        cell: the arm, whose joint names are the columns' names.
    """
    return np.column_stack([table.numbers(joint.name, "joint") for joint in cell.chain.joints])


def _triples(table: Table, head: str, dimension: str) -> np.ndarray:
    """Return three columns of a table, named `head` followed by x, y, z, as an array (m, 3) in SI units.

    Empty cells are NaN.

    Args:
        table: the table.
        head: beginning of the columns' names.
        dimension: kind of quantity, such as "length", by which the column's unit is converted.
    """
    return np.column_stack([table.numbers(f"{head}{axis}", dimension, gaps=True) for axis in "xyz"])


def _plans(paths: list[Path], chain: Chain | Drawn | None) -> tuple[list[tuple[str, np.ndarray]], list[Played]]:
    """Return the lists of poses, and the measuring runs through poses, that CSV files contain.

    Args:
        paths: the CSV files.
        chain: the robot; None: unknown, and both results are empty.

    Returns:
        Name and joint values (m, n) of each list, and the runs.
    """
    chosen = []
    runs = []
    if chain is None:
        return chosen, runs
    kinds = joint_kinds(chain) if isinstance(chain, Chain) else [joint.kind for joint in chain.joints]
    for path in paths:
        if not is_run(path):
            chosen.append((path.stem, read_poses(path, Joints(chain.joint_names, kinds))))
        elif isinstance(chain, Chain):
            t, q = rehearsed_samples(path, chain)
            runs.append(Played(path.stem, t, q))
    return chosen, runs


def is_run(path: Path) -> bool:
    """Return whether the CSV file `path` contains a measuring run, which has times, instead of a list of poses."""
    with path.open(encoding="utf-8", errors="replace") as file:
        return file.readline().startswith(("t [s],pose,", "t,pose,"))


def rehearsed_samples(path: Path, chain: Chain, rate: float = REHEARSAL_RATE) -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) [s] and joint values (N, n) [rad or m] of a measuring run, interpolated at a rate.

    Args:
        path: file of the run.
        chain: the arm.
        rate: rate of the samples [Hz].

    Raises:
        MeasurementError: if a joint's column is missing.
    """
    table = read_table(path)
    # The first of columns that differ in their unit alone.
    columns: dict[str, str] = {}
    for name in table.header:
        columns.setdefault(name.split(" [")[0], name)
    times = table.numbers("t", None)
    t = np.linspace(times[0], times[-1], max(int((times[-1] - times[0]) * rate), 2))
    q = np.empty((len(t), chain.n))
    for joint, name in enumerate(chain.joint_names):
        stops = table.numbers(columns.get(name, name), "joint")
        q[:, joint] = np.interp(t, times, stops)
    return t, q


def _motions(folder: Path) -> list[Played]:
    """Return the designed and planned motions of a folder and its subfolders."""
    motions = []
    for name in (coefficients.SAMPLES, coefficients.PLANNED):
        for path in _below(folder, name):
            table = read_table(path)
            motions.append(Played(_label(path, folder), _seconds(table), _columns(table, "q", path), table.block("v")))
    return motions


def _all_torques(folder: Path, chain: Chain | Drawn | None) -> list[Torques]:
    """Return the measured and predicted torques in a folder and its subfolders.

    If there is held-out motion, only its torques are returned.

    Args:
        folder: the folder.
        chain: the robot, which names the torques; None: unknown.
    """
    result = []
    for path in _below(folder, "torques_*.csv"):
        # A folder that also holds unseen motions shows those alone.
        if (path.parent / "unseen").is_dir():
            continue
        table = read_table(path)
        measured = _columns(table, "measured", path)
        predicted = _columns(table, "predicted", path)
        rows, units = _torque_rows(path.parent, chain, measured.shape[1])
        label = _label(path, folder)
        extra = {name: table.block(name) for name in ("q", "sigma", "nominal")}
        result.append(Torques(label, rows, units, _seconds(table), measured, predicted, **extra))
    return result


def _fronts(folder: Path) -> tuple[list[TradeOffs], list[str]]:
    """Return the fronts of trade-offs in a folder and its subfolders, and notes on those that cannot be read."""
    fronts = []
    notes = []
    for path in _below(folder, stored_front.TABLE):
        try:
            front = stored_front.read(path.parent).values
        except CalibError as reason:
            notes.append(f"{path.parent.name}: no front is shown: {reason}")
            continue
        name = path.parent.resolve().name
        fronts.append(TradeOffs(name, tuple(front.names), front.values, front.best, front.designed))
    return fronts, notes


def _torque_rows(folder: Path, chain: Chain | Drawn | None, count: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the labels and the units of an identification's torque rows.

    Args:
        folder: folder with the table of torques: that of the identification, or its subfolder ``unseen``.
        chain: the robot; None: unknown.
        count: number of torque rows.
    """
    if chain is not None:
        for identification in (IdentificationFolder(folder), IdentificationFolder(folder.parent)):
            if not identification.model.is_file():
                continue
            labelled = _model_rows(model_file.read_table(identification.path), chain, count)
            if labelled is not None:
                return labelled
    if chain is not None and chain.n == count:
        names = chain.joint_names
    else:
        names = tuple(f"row {k + 1}" for k in range(count))
    return tuple(f"{name} torque" for name in names), ("N m or N",) * count


def _model_rows(model: dict, chain: Chain | Drawn, count: int) -> tuple[tuple[str, ...], tuple[str, ...]] | None:
    """Return labels and units of an identified model's torque rows; None if the model has not `count` rows.

    Args:
        model: content of ``dynamics.json``.
        chain: the robot.
        count: number of torque rows in the table.
    """
    unit = model.get("unit", "N m")
    if isinstance(chain, Drawn):
        titles, units = chain.torque_rows(model.get("kind", ""))
        kind = " force or torque"
    else:
        rows = ROWS.get(model.get("kind", ""), MOTOR)
        if rows.count(chain.n) != count:
            return None
        titles = rows.titles(chain.joint_names)
        units = rows.units([joint.kind == "prismatic" for joint in chain.joints])
        quantity = "torque" if unit == "N m" else "current"
        kind = f" motor {quantity}" if rows.motors_alone else f" {quantity}"
    if unit != "N m":
        units = (unit,) * count
    return tuple(f"{title}{kind}" for title in titles), units


def _below(folder: Path, pattern: str) -> list[Path]:
    """Return the files that match a pattern in a folder and in subfolders down to two levels.

    Files of the folder itself are first.
    """
    paths = []
    for subfolders in ("", "*/", "*/*/"):
        paths += sorted(folder.glob(subfolders + pattern))
    return paths


def _label(path: Path, folder: Path) -> str:
    """Return the name under which the viewer shows the file `path`, which is in `folder` or in a subfolder of it."""
    parent = path.parent
    if parent == folder:
        return path.stem
    if path.stem == "torques_1":
        return f"{parent.name} torques"
    return parent.name


def _seconds(table: Table) -> np.ndarray:
    return np.asarray(table.cells[table.index("t")], dtype=float)


def _columns(table: Table, letter: str, path: Path) -> np.ndarray:
    """Return the columns of a quantity for all joints as an array (N, n).

    Args:
        table: the table.
        letter: beginning of the columns' names, such as ``q``.
        path: the file, for the message.

    Raises:
        UsageError: if the columns are missing.
    """
    block = table.block(letter)
    if block is None:
        raise UsageError(f"{path} has no columns {letter}_joint …; was it written by this toolkit?")
    return block
