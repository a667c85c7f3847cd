"""The scene of a folder as plain arrays, shown by `calib.apps.viewer.viewer`.

A folder is that of a fit, an identification, an excitation, a planned motion, or a session that has several of them.
All points are in the base of the arm that is drawn; its meshes are those of the URDF's ``<visual>`` elements.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

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
from calib.procedure.excitation import coefficients
from calib.procedure.kinematic_stage.folder import IN_SESSION, VALIDATED, FitFolder, ValidationFolder
from calib.procedure.robot_kinds import stage_of
from calib.records import Frozen
from calib.result_kinds import refusal
from calib.robot import calibrated, library
from calib.robot.chain import Chain, Joint, joint_kinds
from calib.robot.collision import find_mesh, urdf_meshes
from calib.robot.formats.urdf_tree import is_urdf, numbers, origin
from calib.robot.kinematics import forward, joint_frames
from calib.robot.library import load, resolve
from calib.transforms import invert

DRAWABLE = (".stl", ".obj", ".dae", ".glb", ".gltf")  # meshes that the viewer shows


@runtime_checkable
class Drawn(Protocol):
    """A robot that is not a serial arm, as its ``view`` (`calib.procedure.robot_kinds.CommandStage`) returns it.

    Attributes:
        n, joints, joint_names: its actuated joints.
    """

    @property
    def n(self) -> int: ...
    @property
    def joints(self) -> tuple[Joint, ...]: ...
    @property
    def joint_names(self) -> tuple[str, ...]: ...

    def strips(self, q: np.ndarray) -> list[np.ndarray]:
        """Return lines (m, k, 3) [m] for readings q (m, n); the first ends at the point whose errors are shown."""
        ...

    def torque_rows(self, kind: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return titles and units of an identification's torque rows, by the ``kind`` of ``dynamics.json``."""
        ...

    def measured(self, folder: Path) -> tuple[np.ndarray, ...]:
        """Return the poses of a fit's folder, in the order of `Measured`."""
        ...


@dataclass(frozen=True, eq=False)
class Visual(Frozen):
    """A mesh file that moves with a link: its placement (4, 4) in the link's frame, its scale (3,)."""

    link: str
    file: Path
    placement: np.ndarray
    scale: np.ndarray


def visuals(path: str | Path) -> tuple[list[Visual], list[str]]:
    """Return the meshes of a URDF's ``<visual>`` elements, and the names of missing files.

    Read from our own parsed XML, not by yourdfpy: one capsule, or one ``<visual>`` without geometry, makes that refuse
    the whole file (ValueError, TypeError), and ``package://`` is resolved as for collision shapes, see `find_mesh`.
    """
    places, meshes, missing = list(Path(path).resolve().parents), [], []
    for link, visual, mesh in urdf_meshes(path, "visual"):
        name = mesh.attributes.get("filename", "")
        file = find_mesh(name, places)
        if file is None or file.suffix.lower() not in DRAWABLE:
            missing.append(name)
            continue
        scale = numbers(mesh, "scale", str(path), "1 1 1")
        meshes.append(Visual(link.attributes.get("name", ""), file, origin(visual, str(path)), scale))
    return meshes, missing


FRAMES = 50.0  # positions of the arm per second of motion; our choice


@dataclass(frozen=True, eq=False)
class Measured:
    """m measured poses: where the target was seen, and where the two arms say it is.

    Attributes:
        q: (m, n) [rad or m].
        seen, nominal, calibrated: (m, 3) [m].
        unseen: (m,) whether the row was kept from the fit.
        turned: (m, 3) rotation vector from the calibrated arm's orientation to the one seen, as ``residuals.csv`` has
            it [rad]; NaN where none was measured.
    """

    q: np.ndarray
    seen: np.ndarray
    nominal: np.ndarray
    calibrated: np.ndarray
    unseen: np.ndarray
    turned: np.ndarray

    def arrow_scale(self, chain: Chain | Drawn) -> float:
        """Return the factor 1, 2 or 5 · 10^k that makes the larger arrows about a tenth of the arm long."""
        span = float(np.ptp(strips(chain, self.q)[0][:, -1], axis=0).max()) or 1.0
        large = float(np.quantile(np.linalg.norm(self.seen - self.nominal, axis=1), 0.9)) or 1e-3
        target = 0.1 * span / large
        steps = np.array([f * 10.0**k for k in range(7) for f in (1.0, 2.0, 5.0)])
        return float(steps[np.argmin(np.abs(np.log(steps / target)))])


@dataclass(frozen=True, eq=False)
class ErrorSizes:
    """Errors of m measured rows that have no place in the arm's base: their sizes alone.

    Distances, bars, sockets, planes and images measure no position; validation rows with base and tool placement of
    their own measure it in a frame that the fit's folder does not hold.

    Attributes:
        kind: ``position`` where the row's residual is one (in the instrument's frame, from a socket's mean point or
            from a plane), else ``distance``.
        q: (m, n) [rad or m].
        nominal, calibrated: (m,) sizes of both arms' errors [m]; NaN where the fit states none.
        unseen: (m,) whether the row was kept from the fit.
    """

    kind: str
    q: np.ndarray
    nominal: np.ndarray
    calibrated: np.ndarray
    unseen: np.ndarray


@dataclass(frozen=True, eq=False)
class Played:
    """A motion: times (N,) [s], joint values, and velocities where they are known (N, n)."""

    name: str
    t: np.ndarray
    q: np.ndarray
    v: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Torques:
    """Measured and predicted torques (N, rows) of a recording, at times t (N,) [s], and its joints (N, n).

    Attributes:
        rows, units: what each torque is, by joint and kind, and its unit.
    """

    name: str
    rows: tuple[str, ...]
    units: tuple[str, ...]
    t: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray
    q: np.ndarray | None


@dataclass(frozen=True, eq=False)
class Scene:
    """Robot, poses, motions and torques to show.

    Attributes:
        title: of the recording.
        chain: the robot that is drawn; None where none is known.
        meshes: of its links.
        measured: poses with their errors.
        sizes: errors of rows without a measured position in the arm's base.
        chosen: names and joint values of pose plans (m, n), in the order of choice.
        played: motions.
        torques: recordings.
        notes: what could not be shown.
    """

    title: str
    chain: Chain | Drawn | None = None
    meshes: tuple[Visual, ...] = ()
    measured: tuple[Measured, ...] = ()
    sizes: tuple[ErrorSizes, ...] = ()
    chosen: tuple[tuple[str, np.ndarray], ...] = ()
    played: tuple[Played, ...] = ()
    torques: tuple[Torques, ...] = ()
    notes: tuple[str, ...] = ()


def read(folder: str | Path, robot: str | None = None) -> Scene:
    """Return what to show of a folder's results: robot, poses, motions, torques.

    Args:
        folder: of a fit, an identification, an excitation, a plan, or a session; or a CSV of poses or of a run.
        robot: the arm to draw; None for the folder's own.

    Raises:
        UsageError: where there is nothing to see.
    """
    folder = Path(folder)
    is_csv = folder.is_file() and folder.suffix == ".csv"
    require(is_csv or folder.is_dir(), f"{folder} is neither folder nor CSV; give a fit, session or motion", UsageError)
    if is_csv and robot is None:
        refuse_option(folder, "robot of these poses unknown; give --robot")
    chain, source = _arm(folder, robot)
    meshes, notes = _meshes(chain, source)
    fit_folders = [path for path in (folder, folder / IN_SESSION) if FitFolder(path).residuals.is_file()]
    measured: list[Measured] = []
    sizes: list[ErrorSizes] = []
    for fit_folder in fit_folders:
        errors = ValidationFolder(folder / VALIDATED).errors
        measured.append(_joined(_measured(fit_folder, chain), errors))
    for fit_folder in fit_folders:
        sizes += _unplaced(fit_folder, chain)

    chosen: list[tuple[str, np.ndarray]] = []
    played: list[Played] = []
    plans = [folder]
    if not is_csv:
        plans = sorted(folder.glob("2-poses/*.csv"))
    for path in plans:
        if chain and not is_run(path):
            joints = Joints(chain.joint_names, _kinds(chain))
            chosen.append((path.stem, read_poses(path, joints)))
    for path in plans:
        if isinstance(chain, Chain) and is_run(path):
            t, q = rehearsed_samples(path, chain)
            played.append(Played(path.stem, t, q))
    for name in (coefficients.SAMPLES, coefficients.PLANNED):
        played += [_played(path, folder) for path in _below(folder, name)]

    # A folder that also holds unseen motions shows those alone.
    torque_files = [path for path in _below(folder, "torques_*.csv") if not (path.parent / "unseen").is_dir()]
    torques = [_torques(path, folder, chain) for path in torque_files]

    resolved = folder.resolve()
    title = resolved.name
    if is_csv:
        title = resolved.stem
    measured = [poses for poses in measured if len(poses.q)]
    sizes = [rows for rows in sizes if len(rows.q)]
    content = measured or sizes or chosen or played or torques
    require(content, refusal(folder, "view"), UsageError)
    if chain is None:
        notes.append("no robot is shown: the folder does not name one; give --robot")
    return Scene(
        title=title,
        chain=chain,
        meshes=tuple(meshes),
        measured=tuple(measured),
        sizes=tuple(sizes),
        chosen=tuple(chosen),
        played=tuple(played),
        torques=tuple(torques),
        notes=tuple(notes),
    )


def _below(folder: Path, pattern: str) -> list[Path]:
    """Return the files of a folder and of its subfolders down to two levels, the folder's files first."""
    return [path for depth in ("", "*/", "*/*/") for path in sorted(folder.glob(depth + pattern))]


def _arm(folder: Path, robot: str | None) -> tuple[Chain | Drawn | None, Path | None]:
    """Return the robot to show, and its original description file."""
    if (stage := stage_of(robot or folder, "view")) is not None:
        return stage.run(), None
    if robot is not None:
        return load(robot), resolve(robot)
    for path in (folder / calibrated.ROBOT, folder / IN_SESSION / calibrated.ROBOT, folder / coefficients.ARM):
        if path.is_file():
            robot_file = calibrated.read(path)
            return robot_file.complete, Path(robot_file.source) if robot_file.source and Path(
                robot_file.source
            ).is_file() else None
    for path in sorted(folder.glob("1-robot/robot.*")):
        return load(str(path)), path
    try:
        name = read_toml(folder / coefficients.NAME).get("robot", "")
    except CalibError:
        return None, None
    return (load(name), None) if name in library.names() else (None, None)


def _kinds(chain: Chain | Drawn) -> list[str]:
    return joint_kinds(chain) if isinstance(chain, Chain) else [joint.kind for joint in chain.joints]


def _meshes(chain: Chain | Drawn | None, source: Path | None) -> tuple[list[Visual], list[str]]:
    """Return the meshes of the moving links, and a note on missing meshes."""
    if not isinstance(chain, Chain) or source is None or not is_urdf(source) or not chain.links:
        return [], []
    meshes, missing = visuals(source)
    drawn_meshes = [mesh for mesh in meshes if mesh.link in (chain.base, *chain.links)]
    note = (
        f"{len(missing)} meshes of {source.name} were not found, e.g. {missing[0]}: links are lines" if missing else ""
    )
    return drawn_meshes, [note] if note else []


def _measured(folder: Path, chain: Chain | Drawn | None) -> Measured:
    """Return the measured positions of ``residuals.csv``, with the predictions of both arms."""
    if isinstance(chain, Drawn):
        return Measured(*chain.measured(folder))
    after, before = installation.read_arms(folder)
    table = read_table(FitFolder(folder).residuals)
    table = table.where(_placed(table, after))
    q = np.column_stack([table.numbers(joint.name, "joint") for joint in after.chain.joints])
    miss, turned = _triples(table, "d", "length"), np.full((len(q), 3), np.nan)
    if "drx" in table:
        turned = _triples(table, "dr", "angle")
    positions_seen, nominal, modelled = (np.zeros((len(q), 3)) for _ in range(3))
    stations, tools = np.array(table.texts("station")), np.array(table.texts("tool"))
    for station, tool in sorted(set(zip(stations.tolist(), tools.tolist()))):
        rows = np.flatnonzero((stations == station) & (tools == tool))
        s, t = after.station_names.index(station), after.tool_names.index(tool)
        base = invert(after.stations[s])
        modelled[rows] = _points(after, q[rows], s, t) @ base[:3, :3].T + base[:3, 3]
        positions_seen[rows] = modelled[rows] + miss[rows] @ base[:3, :3].T
        drawn = before if station in before.station_names else replace(after, chain=before.chain)
        nominal[rows] = _points(drawn, q[rows], s, t) @ base[:3, :3].T + base[:3, 3]
    return Measured(q, positions_seen, nominal, modelled, np.array(table.texts("set")) != "fit", turned)


def _placed(table: Table, cell: Installation) -> np.ndarray:
    """Return which rows (m,) of ``residuals.csv`` have a measured position that a station of the fit places."""
    positions = ~np.isnan(table.numbers("dx", "length", gaps=True))
    return positions & np.isin(table.texts("station"), cell.station_names)


def _unplaced(folder: Path, chain: Chain | Drawn | None) -> list[ErrorSizes]:
    """Return the errors of the rows of ``residuals.csv`` that `_measured` leaves out, by their kind."""
    if isinstance(chain, Drawn):
        return []
    cell = installation.read(folder)
    table = read_table(FitFolder(folder).residuals)
    left_out = table.where(~_placed(table, cell))
    measured = ~np.isnan(left_out.numbers("dx", "length", gaps=True))
    result = []
    for kind, rows in (("position", measured), ("distance", ~measured)):
        part = left_out.where(rows)
        q = np.column_stack([part.numbers(joint.name, "joint") for joint in cell.chain.joints])
        nominal, calibrated = (part.numbers(name, "length", gaps=True) for name in ("nominal size", "size"))
        result.append(ErrorSizes(kind, q, nominal, calibrated, np.array(part.texts("set")) != "fit"))
    return result


def _triples(table: Table, head: str, dimension: str) -> np.ndarray:
    """Return the columns x, y, z of a table whose names begin with `head`, as (m, 3) in SI; NaN where empty."""
    return np.column_stack([table.numbers(f"{head}{axis}", dimension, gaps=True) for axis in "xyz"])


def is_run(path: Path) -> bool:
    """Return whether a CSV file contains a run."""
    with path.open(encoding="utf-8", errors="replace") as file:
        return file.readline().startswith(("t [s],pose,", "t,pose,"))


def rehearsed_samples(path: Path, chain: Chain, rate: float = 10.0) -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) [s] and joint values (N, n) [rad or m] of a run's file at `rate` [Hz], for a rehearsal.

    Raises:
        MeasurementError: if a joint's column is missing.
    """
    table = read_table(path)
    columns = {name.split(" [")[0]: name for name in reversed(table.header)}
    stops = np.column_stack([table.numbers(columns.get(name, name), "joint") for name in chain.joint_names])
    times = table.numbers("t", None)
    t = np.linspace(times[0], times[-1], max(int((times[-1] - times[0]) * rate), 2))
    return t, np.column_stack([np.interp(t, times, column) for column in stops.T])


def _joined(fitted: Measured, errors: Path) -> Measured:
    """Return the fitted poses followed by a session's unseen poses, if its file of errors exists."""
    table = read_table(errors) if errors.is_file() else ()
    if not isinstance(table, Table) or "x" not in table:  # written by an earlier version
        return fitted
    table = table.where(~np.isnan(table.numbers("x", "length", gaps=True)))
    positions_seen, *away = (_triples(table, head, "length") for head in ("", "to_nominal_", "to_calibrated_"))
    q = np.column_stack([table.numbers(name, "joint") for name in table.header[2 : 2 + fitted.q.shape[1]]])
    unseen = (
        q,
        positions_seen,
        *(positions_seen + displacement for displacement in away),
        np.ones(len(q), dtype=bool),
        np.full((len(q), 3), np.nan),
    )
    return Measured(*map(np.concatenate, zip(vars(fitted).values(), unseen)))


def _points(cell: Installation, q: np.ndarray, station: int, tool: int) -> np.ndarray:
    """Return the tool's positions (m, 3) in the station's frame, deflections included."""
    return see(cell, q, station, tool).point.T


def _played(path: Path, folder: Path) -> Played:
    table = read_table(path)
    return Played(_name(path, folder), _seconds(table), _needed(table, "q", path), table.block("v"))


def _seconds(table: Table) -> np.ndarray:
    return np.asarray(table.cells[table.index("t")], dtype=float)


def _torques(path: Path, folder: Path, chain: Chain | Drawn | None) -> Torques:
    table = read_table(path)
    measured, predicted = (_needed(table, name, path) for name in ("measured", "predicted"))
    rows, units = _torque_rows(path.parent, chain, measured.shape[1])
    return Torques(_name(path, folder), rows, units, _seconds(table), measured, predicted, table.block("q"))


def _torque_rows(folder_: Path, chain: Chain | Drawn | None, count: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the labels and units of an identification's torque rows."""
    for folder in (IdentificationFolder(folder_), IdentificationFolder(folder_.parent)):
        if chain is None or not folder.model.is_file():
            continue
        table = model_file.read_table(folder.path)
        unit = table.get("unit", "N m")
        if isinstance(chain, Drawn):
            titles, units = chain.torque_rows(table.get("kind", ""))
            return tuple(f"{title} force or torque" for title in titles), units if unit == "N m" else (unit,) * count
        rows = ROWS.get(table.get("kind", ""), MOTOR)
        if rows.count(chain.n) == count:
            kind = f"{' motor' if rows.motors_alone else ''} {'torque' if unit == 'N m' else 'current'}"
            units = rows.units([joint.kind == "prismatic" for joint in chain.joints])
            return tuple(title + kind for title in rows.titles(chain.joint_names)), (
                units if unit == "N m" else (unit,) * count
            )
    names = chain.joint_names if chain is not None and chain.n == count else [f"row {k + 1}" for k in range(count)]
    return tuple(f"{name} torque" for name in names), ("N m or N",) * count


def _needed(table: Table, letter: str, path: Path) -> np.ndarray:
    """Return the required columns letter_joint of a file as (N, n)."""
    block = table.block(letter)
    if block is None:
        raise UsageError(f"{path} has no columns {letter}_joint …; was it written by this toolkit?")
    return block


def _name(path: Path, folder: Path) -> str:
    parent = path.parent
    if parent == folder:
        return path.stem
    if path.stem == "torques_1":
        return f"{parent.name} torques"
    return parent.name


def strips(chain: Chain | Drawn, q: np.ndarray) -> list[np.ndarray]:
    """Return the lines (m, k, 3) [m] by which a robot is drawn; an arm has one."""
    return [skeleton(chain, q)] if isinstance(chain, Chain) else chain.strips(q)


def skeleton(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return the positions of base, joints and tip (m, n + 2, 3) [m]."""
    points = np.zeros((len(q), chain.n + 2, 3))
    points[:, 1:-1] = joint_frames(chain, q)[:, :, :3, 3].transpose(1, 0, 2)
    points[:, -1] = forward(chain, q)[:, :3, 3]
    return points


def thinned(t: np.ndarray, rate: float = FRAMES) -> np.ndarray:
    """Return indices of samples at about `rate` [Hz], the last one included."""
    step = max(1, round(1.0 / (rate * float(np.median(np.diff(t)))))) if len(t) > 1 else 1
    return np.unique([*range(0, len(t), step), len(t) - 1])
