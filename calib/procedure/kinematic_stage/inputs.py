"""Inputs of a fit: the robot, the rows to fit, and the unseen rows."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.data.poses import IMAGES, JOINTS, is_image_folder
from calib.data.poses.fit_options import FileOptions, FitOptions, check_files
from calib.data.poses.measurements import PoseMeasurements, take
from calib.data.poses.plausible import check_block
from calib.data.poses.pose_files import joint_columns, read_measurements
from calib.errors import CalibError, MeasurementError, UsageError, require
from calib.extensions import Point
from calib.geometry.first_guess import check_orientations, check_scale
from calib.geometry.fit import plain_fit
from calib.geometry.installation import Installation
from calib.geometry.repeatability import repeated, repeated_rows
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.procedure.robot_kinds import joints_of
from calib.robot import calibrated, description
from calib.robot.calibrated import CalibratedChain, Deflection
from calib.robot.chain import Chain
from calib.robot.description import remarks
from calib.robot.formats import urdf
from calib.robot.formats.urdf_tree import is_urdf, text
from calib.robot.formats.urdf_tree import read as read_tree
from calib.robot.kinematics import gravity_torques
from calib.robot.library import load, resolve

IDENTIFIED_MASSES: Point[Callable[[str, Chain], np.ndarray]] = Point(
    "identified_masses", "standard parameters (n, 10) in the folder of an identification"
)
IMAGE_FOLDERS: Point[Any] = Point("image_folders", "a module: `read_images` reads a folder of images as a block")
PLANNED_POSES: Point[Callable[[Path, Chain, FileOptions], list[PoseMeasurements]]] = Point(
    "planned_poses", "points without joints, with those of planned poses"
)
CAMERA_GUESS: Point[Any] = Point("camera_guess", "a module: completes images' lenses, and takes images as poses")


@dataclass(frozen=True)
class Unseen:
    """Validation rows: measurements that are not fitted.

    Attributes:
        block: the measurements; station and tool names are those of the fit unless ``own_frames``.
        own_frames: True where base and tool placement are to be fitted on these rows.
        held_out: True for a share of a fit file, False for a validation file.
        seen: True if the same file was fitted, so that its errors are no evidence.
    """

    block: PoseMeasurements
    own_frames: bool = False
    held_out: bool = False
    seen: bool = False


@dataclass(frozen=True, eq=False)
class Inputs:
    """Robot and measurements, divided into rows to fit and validation rows.

    Attributes:
        chain: the nominal arm.
        source: the file it came from.
        fit: blocks to fit on.
        unseen: by the name of the file they come from.
        notes: remarks for the user on the interpretation of the files.
        earlier: the robot as its file has it, with what an earlier fit left there; None for a URDF.
        masses: (n, 10) identified standard parameters that gravity torques are computed from; None: the arm's own.
    """

    chain: Chain
    source: Path
    fit: tuple[PoseMeasurements, ...]
    unseen: Mapping[str, Unseen] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    earlier: CalibratedChain | None = None
    masses: np.ndarray | None = None

    @property
    def weighed(self) -> Chain:
        """The nominal arm with the masses that gravity torques are computed from."""
        return self.chain if self.masses is None else replace(self.chain, inertias=self.masses)

    @property
    def known(self) -> Deflection:
        """Joint corrections of the robot from an earlier fit."""
        return Deflection() if self.earlier is None else self.earlier.deflection

    @property
    def bare(self) -> Chain | None:
        """Geometry of the robot as it came that is valid without its corrections; None if it has none."""
        if self.earlier is None or self.earlier.corrections is None:
            return None
        return self.earlier.chain

    @property
    def nominal(self) -> Chain:
        """Nominal arm, before any calibration."""
        return self.chain if self.earlier is None or self.earlier.nominal is None else self.earlier.nominal


def gather(
    robot: str | Path | CalibratedChain,
    measured: Sequence[Path | PoseMeasurements],
    validate: Sequence[Path | PoseMeasurements] = (),
    *,
    options: FitOptions | None = None,
    settings: FitSettings | None = None,
    base: str | None = None,
    tip: str | None = None,
) -> Inputs:
    """Return the inputs of a fit from files: the robot, the named stations and tools, fitted and unseen rows.

    Args:
        robot: see `calib.robot.library`; or a robot in memory.
        measured: files, or blocks in memory, to fit on.
        validate: the same, to validate on.
        options: how files are read.
        settings: stations, tools, rows to hold out, seed of their choice.
        base, tip: links of a URDF.
    """
    options, settings = options or FitOptions(), settings or FitSettings()
    require(measured, "no measurement file given", UsageError)
    files = [_path(each) for each in measured]
    check_files(options, [*files, *map(_path, validate)])
    # the joints of a table tell where a URDF's arm ends; measurements in memory have no table
    table = None if isinstance(measured[0], PoseMeasurements) else files[0]
    chain, source = load_robot(robot, table, options, base, tip)
    stored = source.suffix == ".toml"
    earlier = robot if isinstance(robot, CalibratedChain) else calibrated.read(source) if stored else None
    masses = IDENTIFIED_MASSES.one()(settings.masses, chain) if settings.masses else None
    weighed = chain if masses is None else replace(chain, inertias=masses)
    blocks = _named(
        [(path, block) for path, each in zip(files, measured) for block in read_file(each, weighed, options)],
        options,
        settings.stations,
        settings.tools,
    )
    unseen: dict[str, Unseen] = {}
    fit = []
    for block in blocks:
        kept, aside = hold_out(block, settings.holdout, settings.seed)
        fit.append(kept)
        if aside is not None:
            unseen[_free_name(unseen, block.file)] = Unseen(aside, held_out=True)
    notes = remarks(chain)
    if masses is not None:
        notes += (f"gravity torques of the compliance are those of the masses identified in {settings.masses}",)
    given = Inputs(chain, source, tuple(fit), unseen, notes, earlier, masses)
    given = with_unseen(given, validate, options, settings)
    if earlier is None or earlier.corrections is None:
        return given
    name, count = source if isinstance(robot, CalibratedChain) else robot, len(earlier.deflection.terms)
    return replace(
        given, notes=(*given.notes, f"{name} has {count} deflection terms of an earlier fit; these stay unchanged")
    )


def with_unseen(
    given: Inputs, validate: Sequence[Path | PoseMeasurements], options: FitOptions, settings: FitSettings
) -> Inputs:
    """Return the inputs with further validation rows; copies of fitted rows are marked as seen.

    Args:
        given: robot, fitted rows, and unseen rows so far.
        validate: files, or blocks in memory.
        options: how files are read.
        settings: whether they have frames of their own.
    """
    unseen, notes, fit = dict(given.unseen), list[str](), given.fit
    files = {Path(block.file).resolve() for block in fit}
    for each in validate:
        for block in read_file(each, given.weighed, options, fit):
            again = _path(each).resolve() in files
            if again:
                notes.append(f"{block.file} is also a fit file, so its errors do not count as validation")
            shared = block if settings.refit_frames else _shared(block, fit, notes)
            unseen[_free_name(unseen, block.file)] = Unseen(shared, own_frames=settings.refit_frames, seen=again)
    copied, remarks = repeated(fit, {name: each.block for name, each in unseen.items()})
    unseen = {
        name: replace(each, seen=each.seen or (name in copied and not each.held_out)) for name, each in unseen.items()
    }
    return replace(given, unseen=unseen, notes=(*given.notes, *notes, *remarks))


def plain_reference(nominal: Installation, inputs: Inputs) -> Installation | None:
    """Return the arm by plain least squares, without joint corrections; None where the rows are too few for it.

    Args:
        nominal: the arm as it was, placed.
        inputs: the rows to fit.
    """
    bare = inputs.bare
    if bare is not None:
        nominal = replace(nominal, chain=bare, known=Deflection())
    reference = plain_fit(nominal, inputs.fit)
    return None if reference is None else reference.cell


def load_robot(
    robot: str | Path | CalibratedChain,
    measured: Path | None,
    options: FitOptions,
    base: str | None = None,
    tip: str | None = None,
) -> tuple[Chain, Path]:
    """Return a robot's chain and its file; from a URDF, the chain that has the joints of the measured table."""
    if isinstance(robot, CalibratedChain):
        return robot.complete, Path(robot.source or robot.chain.name)
    source = resolve(robot)
    if not is_urdf(source):
        if base is None and tip is None and not options.beta:
            return description.read(source, propose_beta=False), source
        return load(robot, base, tip), source
    names: list[str] = []
    if measured is not None and tip is None:
        known = read_tree(text(source)[0], str(source)).joints
        table = measured / JOINTS if measured.is_dir() else measured
        header = joint_columns(table)
        columns = [*header, *options.for_file(measured).columns]
        names = [name for name in dict.fromkeys(columns) if name in known and known[name].actuated]
        names = [] if f"q{len(names) + 1}" in header else names  # numbered columns hold more joints than are named
    return load(robot, base, tip, names or None), source


def load_rigid(
    robot: str | Path | CalibratedChain, measured: Path | None = None, base: str | None = None, tip: str | None = None
) -> tuple[CalibratedChain, Path]:
    """Return the robot whose chain dynamics and motion planning use, and its file.

    That chain is the best one without joint corrections: neither torques nor a robot's controller know of these, and
    the geometry they belong to is worse than this one where they are left out.
    """
    if isinstance(robot, CalibratedChain):
        return robot, Path(robot.source or robot.chain.name)
    chain, source = load_robot(robot, measured, FitOptions(), base, tip)
    if measured is not None and tip is None and is_urdf(source):
        _check_whole(chain, source, measured, base)
    return CalibratedChain(chain) if is_urdf(source) else calibrated.read(source), source


def _check_whole(chain: Chain, source: Path, measured: Path, base: str | None) -> None:
    """Refuse a table without columns of some revolute joints of the arm, since their positions would be unknown."""
    try:
        whole = urdf.read(source, base)
    except CalibError:  # the URDF does not say by itself where its arm ends
        return
    missing = [one.name for one in whole.joints if one.name not in chain.joint_names and one.kind != "prismatic"]
    if missing and set(chain.joint_names) < set(whole.joint_names):
        raise UsageError(
            f"{measured}: column '{missing[0]}' is missing: the arm of {source.name} has {whole.n} joints, but the "
            f"table has {chain.n}; if the arm ends at {chain.tip}, give --tip {chain.tip}"
        )


def read_file(
    each: Path | PoseMeasurements, chain: Chain, options: FitOptions, like: Sequence[PoseMeasurements] = ()
) -> list[PoseMeasurements]:
    """Read the measurements of a file (or folder of images) for a chain, and check them against its joint limits.

    Args:
        each, chain, options: what (or a block in memory, which is checked alike), for whom, and how.
        like: blocks read before; images of the same size are taken to be by the same camera.
    """
    path, joints = _path(each), joints_of(chain)
    own = options.for_file(path)
    if not isinstance(each, (str, Path)):
        fits = tuple(each.joint_names) == chain.joint_names or len(each.joint_names) == chain.n
        blocks = [check_block(each, own, joints) if fits else each]
    elif is_image_folder(path):
        blocks = [IMAGE_FOLDERS.one().read_images(path, joints, own)]
    else:
        rooms = PLANNED_POSES.all() if own.planned else ()
        blocks = [block for room in rooms for block in room(path, chain, own)] or read_measurements(path, joints, own)
    blocks = [CAMERA_GUESS.one().complete_camera(chain, b, like) if b.kind == IMAGES else b for b in blocks]
    for block in blocks:
        check_scale(block, chain)  # unseen files, too: the fit looks at its own only
        check_orientations(chain, block)
    return [replace(block, torque=gravity_of(chain, block.q)) for block in blocks]


def gravity_of(chain: Chain, q: np.ndarray) -> np.ndarray | None:
    """Return gravity torques (m, n) [N m] at joint values (m, n); None if the robot's masses are unknown."""
    if chain.inertias is None or len(chain.driven) != chain.n:
        return None
    return gravity_torques(chain, q)


def _path(each: Path | PoseMeasurements) -> Path:
    return Path(each) if isinstance(each, (str, Path)) else Path(each.file or "measured")


def hold_out(block: PoseMeasurements, share: float, seed: int) -> tuple[PoseMeasurements, PoseMeasurements | None]:
    """Return the rows of a block to fit, and the held-out rows (None for a share of 0).

    Poses are permuted, not rows: the reflectors of one pose stay together, and so do the two rows of a distance and the
    cycles of a repeated pose.
    """
    if share == 0.0:
        return block, None
    unit = _units(block)
    count = int(unit.max()) + 1
    held = round(share * count)
    order = np.random.default_rng(seed).permutation(count)
    if held == 0 or held == count:
        raise MeasurementError(f"a hold-out share of {share:g} gives {held} of {count} poses; change it", block.file)
    aside = np.isin(unit, order[count - held :])
    return take(block, np.flatnonzero(~aside)), take(block, np.flatnonzero(aside))


def _units(block: PoseMeasurements) -> np.ndarray:
    """Return the index (m,) of the pose (or measured pair) of each row.

    Cycles of one repeated pose are one pose.
    """
    labels = np.array(block.together)
    for cycles in repeated_rows(block):
        labels[np.isin(labels, labels[cycles])] = labels[cycles[0]]
    rank = {label: k for k, label in enumerate(dict.fromkeys(labels.tolist()))}
    return np.array([rank[label] for label in labels.tolist()], dtype=int)


def pose_count(blocks: Sequence[PoseMeasurements]) -> int:
    """Return the number of robot poses in the blocks (several reflectors measured at once are one pose)."""
    return sum(len(np.unique(block.rows)) for block in blocks)


def _named(
    read: Sequence[tuple[Path, PoseMeasurements]], options: FitOptions, stations: str, tools: str
) -> list[PoseMeasurements]:
    """Return the blocks to fit with station and tool names from --stations and --tools; all names are distinct.

    Where an arm carried a camera and something else, or two cameras, these are several tools whatever --tools says.
    """
    result, count, names = [], dict[str, int](), dict[Path, str]()
    carried = list(dict.fromkeys(block.carried for _, block in read))
    for path, block in read:
        if tools == "one" and len(carried) > 1 and block.tool_names == (FileOptions().tool,):
            block = replace(block, tool_names=(_carried_name(block.carried, carried),))
        if tools == "each":
            block = replace(block, tool_names=tuple(f"{path.stem} {name}" for name in block.tool_names))
        if path not in names:
            name = "station" if stations == "one" else block.station
            if stations == "each" and not options.for_file(path).station:
                count[name] = count.get(name, 0) + 1
                name = f"{name} {count[name]}" if count[name] > 1 else name
            names[path] = name
        result.append(replace(block, station=names[path]))
    targets = {name for block in result for name in block.tool_names}
    return [replace(b, station=f"{b.station} station") if b.station in targets else b for b in result]


def _carried_name(own: tuple[str, object], carried: Sequence[tuple[str, object]]) -> str:
    """Return the name of a file's tool, with a number from the second tool of its kind on."""
    number = [each for each in carried if each[0] == own[0]].index(own) + 1
    return f"{own[0]} {number}" if number > 1 else own[0]


def _free_name(taken: Mapping[str, Unseen], file: str) -> str:
    """Return a file's name, or its path if another file has the same name."""
    names = (Path(file).name, file, *(f"{file} ({number})" for number in range(2, len(taken) + 2)))
    return next(name for name in names if name not in taken)


def _shared(block: PoseMeasurements, fit: Sequence[PoseMeasurements], notes: list[str]) -> PoseMeasurements:
    """Return a validation block that uses the station and the tools of the fit."""
    fit = [other for other in fit if other.carried == block.carried] or fit
    first = fit[0]
    if block.has_instrument:
        stations = [other.station for other in fit if other.has_instrument]
        if not stations:
            raise UsageError(f"{block.file}: no fit file has this instrument; refit its frames (--refit-frames)")
        if block.station not in stations:
            block = replace(block, station=stations[0])
            notes.append(
                f"{Path(block.file).name} is predicted with the fit's station '{stations[0]}'; if the instrument stood "
                "elsewhere, refit its frames (--refit-frames)"
            )
    known = {name for other in fit for name in other.tool_names}
    if not set(block.tool_names) <= known:
        if len(block.tool_names) != len(first.tool_names):
            found = ", ".join(block.tool_names)
            raise UsageError(
                f"{block.file}: the fit has no tool {found}, only {', '.join(sorted(known))}; refit_frames"
            )
        block = replace(block, tool_names=first.tool_names)
    return block
