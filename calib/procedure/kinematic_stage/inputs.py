"""Inputs of a fit: the robot, the rows to fit, and the held-out rows."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from calib.data.images.pixels import Pixels
from calib.data.joint_columns import joints_in, longest_numbering
from calib.data.pose_pairs.pair_files import read_pairs
from calib.data.poses import JOINTS, is_image_folder
from calib.data.poses.columns import Undecided
from calib.data.poses.fit_options import FileOptions, FitOptions, check_files
from calib.data.poses.measurements import PoseMeasurements, reunited, take
from calib.data.poses.plausible import check_block
from calib.data.poses.pose_files import joint_columns, read_measurements
from calib.errors import CalibError, Finding, MeasurementError, UsageError, listing, refuse_option, require
from calib.extensions import Point
from calib.geometry.checks.pose_direction import as_seen_by_instrument
from calib.geometry.checks.readings import without_unseen
from calib.geometry.first_guess import check_orientations, check_scale
from calib.geometry.fit import plain_fit
from calib.geometry.installation import Installation
from calib.geometry.model_choice.stated_compliance import StatedCompliance, check_torques, read_compliance
from calib.geometry.repeatability import repeated, repeated_rows, without_copies
from calib.geometry.static_torques.agreement import agreeing_torques, unread_torques, without_contradicting_torques
from calib.geometry.static_torques.gravity_fit import GravityFit
from calib.geometry.static_torques.sources import MEASURED, driven, load_findings, with_stated_load
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.procedure.kinematic_stage.undecided_files import decided
from calib.procedure.robot_kinds import joints_of
from calib.robot import calibrated, description
from calib.robot.calibrated import CalibratedChain, Deflection
from calib.robot.chain import Chain
from calib.robot.description import remarks
from calib.robot.formats import arm_ends, urdf
from calib.robot.formats.urdf_tree import is_urdf, text
from calib.robot.formats.urdf_tree import read as read_tree
from calib.robot.library import load, resolve

PLANNED_POSES: Point[Callable[[Path, Chain, FileOptions], list[PoseMeasurements]]] = Point(
    "planned_poses", "points without joints, with those of planned poses"
)


@dataclass(frozen=True)
class Unseen:
    """Validation rows: measurements that are not fitted.

    Attributes:
        block: the measurements; station and tool have the names of the fit's station and tool unless `own_frames`.
        own_frames: whether base and tool placement are to be fitted to these rows.
        held_out: True for a held-out share of a fit file, False for a validation file.
        seen: whether these rows were fitted, too, so that their errors are no evidence.
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
        source: file from which the robot was read.
        fit: blocks to fit.
        unseen: name of a validation file -> its rows.
        notes: remarks for the user on the interpretation of the files.
        earlier: the robot with the results of an earlier fit, as its file contains them; None for a URDF.
        masses: (n, 10) identified standard parameters, from which gravity torques are computed; None: parameters of the
            robot's description.
        noticed: findings on readings that were left out, since the instrument did not see the target, and on torques.
        gravity: gravity of the arm by the torques that it measured at rest; None without such torques.
        torques: whether measured torques drive the compliance, or those of the masses.
        compliance: compliance of joints that an identification told; None without it.
    """

    chain: Chain
    source: Path
    fit: tuple[PoseMeasurements, ...]
    unseen: Mapping[str, Unseen] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    earlier: CalibratedChain | None = None
    masses: np.ndarray | None = None
    noticed: tuple[Finding, ...] = ()
    gravity: GravityFit | None = None
    torques: str = MEASURED
    compliance: StatedCompliance | None = None

    @property
    def files(self) -> tuple[PoseMeasurements, ...]:
        """Blocks to fit, with the rows of their files that were held out."""
        held_out = [rows.block for rows in self.unseen.values() if rows.held_out]
        if not held_out:
            return self.fit
        return tuple(reunited(block, remainder) for block, remainder in zip(self.fit, held_out, strict=True))

    def driven_by(self, source: str) -> "Inputs":
        """Return the inputs whose compliance is driven by measured or by modelled torques.

        Args:
            source: `MEASURED` or `MODELLED`; without measured torques both are the same.
        """
        gravity = self.gravity
        if gravity is None:
            return self
        fitted = tuple(driven(block, gravity, source) for block in self.fit)
        unseen = {}
        for name, rows in self.unseen.items():
            unseen[name] = replace(rows, block=driven(rows.block, gravity, source))
        return replace(self, fit=fitted, unseen=unseen, torques=source)

    def with_masses(self, masses: np.ndarray) -> "Inputs":
        """Return the inputs whose compliance is driven by the gravity of other masses (n, 10), and the stated loads."""
        weighed = replace(self.chain, inertias=masses)
        fitted = tuple(with_stated_load(weighed, block) for block in self.fit)
        unseen = {}
        for name, rows in self.unseen.items():
            unseen[name] = replace(rows, block=with_stated_load(weighed, rows.block))
        return replace(self, fit=fitted, unseen=unseen, masses=masses)

    @property
    def weighed(self) -> Chain:
        """The nominal arm with the masses from which gravity torques are computed."""
        if self.masses is None:
            return self.chain
        return replace(self.chain, inertias=self.masses)

    @property
    def known(self) -> Deflection:
        """Joint corrections that the robot has from an earlier fit or an identification; else empty."""
        if self.compliance is not None:
            return self.compliance.deflection
        if self.earlier is None:
            return Deflection()
        return self.earlier.deflection

    @property
    def bare(self) -> Chain | None:
        """Geometry before the fit for use without joint corrections; None if the robot has none before the fit."""
        if self.compliance is not None:
            return self.chain
        if self.earlier is None or self.earlier.corrections is None:
            return None
        return self.earlier.chain

    @property
    def nominal(self) -> Chain:
        """Nominal arm before any calibration; if the robot is from an earlier fit, the nominal arm of that fit."""
        if self.earlier is None or self.earlier.nominal is None:
            return self.chain
        return self.earlier.nominal


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
    """Return the inputs of a fit from files: the robot, the named stations and tools, fitted and held-out rows.

    Args:
        robot: name of a library robot, file (URDF, or MDH table in TOML), folder of a fit, or a robot in memory.
        measured: files, or blocks in memory, to fit.
        validate: files, or blocks in memory, for the validation.
        options: options for reading the files; None: defaults.
        settings: stations, tools, share of rows to hold out, and seed; None: defaults.
        base, tip: first and last link of the arm in a URDF; None: chosen by the joint columns of the measurements.

    Raises:
        UsageError: without a measurement file.
        MeasurementError: for a file that cannot be read.
    """
    options = options or FitOptions()
    settings = settings or FitSettings()
    require(measured, "no measurement file given", UsageError)
    paths = [_path(source) for source in measured]
    check_files(options, [*paths, *map(_path, validate)])
    # the joints of a table tell where a URDF's arm ends; measurements in memory have no table
    table = None if isinstance(measured[0], PoseMeasurements) else paths[0]
    chain, robot_file = load_robot(robot, table, options, base, tip)
    if isinstance(robot, CalibratedChain):
        earlier = robot
    elif robot_file.suffix == ".toml":
        earlier = calibrated.read(robot_file)
    else:
        earlier = None
    masses = None
    weighed = chain
    if settings.masses:
        # a fit alone loads no dynamics
        from calib.identification.model_file import identified_masses

        masses = identified_masses(settings.masses, chain)
        weighed = replace(chain, inertias=masses)

    read_blocks: list[tuple[Path, PoseMeasurements]] = []
    for path, source in zip(paths, measured):
        read_blocks += [(path, block) for block in read_file(source, weighed, options)]
    notes = remarks(chain)
    unseen: dict[str, Unseen] = {}
    fitted_blocks = []
    held_out_names = []
    noticed: list[Finding] = []
    for block in _with_station_and_tool_names(read_blocks, options, settings.stations, settings.tools):
        block, copy_notes = without_copies(block)
        notes += tuple(copy_notes)
        block, unseen_readings = without_unseen(weighed, block, "copies" in options.accept)
        noticed += unseen_readings
        fitted, held_out = hold_out(block, settings.holdout, settings.seed)
        fitted_blocks.append(fitted)
        name = _free_name(unseen, block.file)
        held_out_names.append(name)
        if held_out is not None:
            unseen[name] = Unseen(held_out, held_out=True)

    gravity, fit_blocks, torque_findings = agreeing_torques(weighed, fitted_blocks)
    noticed += torque_findings
    for name, block in zip(held_out_names, fit_blocks):
        if name in unseen and block.measured_torque is None:
            silent = replace(unseen[name].block, measured_torque=None)
            unseen[name] = replace(unseen[name], block=silent)
    if gravity is not None:
        for block in fit_blocks:
            noticed += load_findings(block, gravity)
        masses = gravity.chain.inertias
    elif masses is not None:
        notes += (f"gravity torques of the compliance are those of the masses identified in {settings.masses}",)
    inputs = Inputs(chain, robot_file, fit_blocks, unseen, notes, earlier, masses, tuple(noticed), gravity)
    inputs = with_unseen(inputs, validate, options, settings)
    if settings.compliance:
        inputs = _with_compliance(inputs, settings.compliance)
    if earlier is None or earlier.corrections is None:
        return inputs
    name = robot_file if isinstance(robot, CalibratedChain) else robot
    count = len(earlier.deflection.terms)
    note = f"{name} has {count} deflection terms of an earlier fit; these stay unchanged"
    return replace(inputs, notes=(*inputs.notes, note))


def _with_compliance(inputs: Inputs, path: str) -> Inputs:
    """Return the inputs with the compliance of joints that an identification told.

    Args:
        inputs: robot and measurements.
        path: ``joint_compliance.csv``, or the folder of an identification.

    Raises:
        UsageError: for measurements without torques, or a robot that has joint corrections of an earlier fit.
    """
    if inputs.earlier is not None and inputs.earlier.corrections is not None:
        refuse_option(
            f"compliance {path}",
            f"{inputs.source} has joint corrections of an earlier fit, which may count it; fit the nominal robot",
        )
    check_torques(inputs.fit, path)
    return replace(inputs, compliance=read_compliance(path, inputs.weighed))


def with_unseen(
    inputs: Inputs, validate: Sequence[Path | PoseMeasurements], options: FitOptions, settings: FitSettings
) -> Inputs:
    """Return the inputs with additional validation rows; copies of fitted rows are marked as seen.

    Args:
        inputs: robot, fitted rows, and previous validation rows.
        validate: files, or blocks in memory.
        options: options for reading the files.
        settings: states whether base and tool placement are fitted to the validation rows.

    Raises:
        UsageError: if the fit has no station or tool for the rows.
    """
    unseen = dict(inputs.unseen)
    notes: list[str] = []
    noticed = list(inputs.noticed)
    fit_files = {Path(block.file).resolve() for block in inputs.fit}
    for source in validate:
        fitted = _path(source).resolve() in fit_files
        for block in read_file(source, inputs.weighed, options, inputs.fit):
            if fitted:
                notes.append(f"{block.file} is also a fit file, so its errors do not count as validation")
            name = _free_name(unseen, block.file)
            block, unseen_readings = without_unseen(inputs.weighed, block, "copies" in options.accept)
            noticed += unseen_readings
            noticed += unread_torques(block)
            if inputs.gravity is not None:
                block, unused_torques = without_contradicting_torques(block, inputs.gravity, inputs.fit)
                noticed += [*unused_torques, *load_findings(block, inputs.gravity)]
            if settings.refit_frames:
                unseen[name] = Unseen(block, own_frames=True, seen=fitted)
            else:
                unseen[name] = Unseen(_with_frames_of_fit(block, inputs.fit, notes), seen=fitted)

    # a file under another name may repeat fitted rows; rows that were held out are no copies
    blocks = {name: rows.block for name, rows in unseen.items()}
    copied, copy_notes = repeated(inputs.fit, blocks)
    for name, rows in unseen.items():
        if name in copied and not rows.held_out:
            unseen[name] = replace(rows, seen=True)
    notes = [*inputs.notes, *notes, *copy_notes]
    inputs = replace(inputs, unseen=unseen, notes=tuple(notes), noticed=tuple(noticed))
    return inputs.driven_by(inputs.torques)


def plain_reference(nominal: Installation, inputs: Inputs) -> Installation | None:
    """Return the arm fitted by plain least squares without joint corrections; None if there are too few rows.

    Args:
        nominal: the arm before the fit, with base and tool placed.
        inputs: the rows to fit.
    """
    bare = inputs.bare
    if bare is not None:
        nominal = replace(nominal, chain=bare, known=Deflection())
    reference = plain_fit(nominal, inputs.fit)
    if reference is None:
        return None
    return reference.cell


def load_robot(
    robot: str | Path | CalibratedChain,
    measured: Path | None,
    options: FitOptions,
    base: str | None = None,
    tip: str | None = None,
) -> tuple[Chain, Path]:
    """Return a robot's chain and its file; the chain of a URDF is the one with the joints of the measured table.

    Args:
        robot: name of a library robot, file (URDF, or MDH table in TOML), folder of a fit, or a robot in memory.
        measured: file with joint columns; None: the table is not considered.
        options: options for reading the file.
        base, tip: first and last link of the arm in a URDF; None: chosen by default.
    """
    if isinstance(robot, CalibratedChain):
        return robot.complete, Path(robot.source or robot.chain.name)
    source = resolve(robot)
    if not is_urdf(source):
        if base is None and tip is None and not options.beta:
            return description.read(source, propose_beta=False), source
        return load(robot, base, tip), source
    if measured is None:
        return load(robot, base, tip), source
    names = _measured_joints(source, measured, options)
    if tip is None:
        return load(robot, base, None, names or None), source
    chain = load(robot, base, tip)
    if names and not set(chain.joint_names) <= set(names) and not options.for_file(measured).columns:
        _check_measured_arm(chain, source, measured, names)
    return chain, source


def _measured_joints(source: Path, measured: Path, options: FitOptions) -> list[str]:
    """Return the joints of a URDF that are named in the header of a table; [] where its joints are numbered.

    Args:
        source: file of the robot.
        measured: the table, or a folder of images.
        options: options for reading the table.
    """
    joints = read_tree(text(source)[0], str(source)).joints
    actuated = [name for name, joint in joints.items() if joint.actuated]
    table = measured / JOINTS if measured.is_dir() else measured
    header = joint_columns(table)
    columns = dict.fromkeys([*header, *options.for_file(measured).columns])
    names = list(filter(actuated.__contains__, columns))
    with_words = joints_in(header, actuated)
    if len(with_words) > len(names):
        names = with_words
    # numbered columns hold more joints than are named
    if f"q{len(names) + 1}" in header or longest_numbering(header) > len(names):
        return []
    return names


def _check_measured_arm(chain: Chain, source: Path, measured: Path, names: Sequence[str]) -> None:
    """Check that the table of a stated arm does not have another arm's joints in place of its own.

    Args:
        chain: the stated arm.
        source: its URDF.
        measured: the table.
        names: the URDF's joints in the table.

    Raises:
        UsageError: if the table lacks the arm's last joint, and has joints of another arm.
    """
    others = [name for name in names if name not in chain.joint_names]
    if not others or chain.joint_names[-1] in names:
        return
    message = f"{measured}: has joints of another arm ({listing(others, 8)}), not of that to {chain.tip}"
    try:
        tip = arm_ends.choose(read_tree(text(source)[0], str(source)), chain.base, others).tip
    except CalibError:  # several arms
        raise UsageError(f"{message}: state the last link of the measured arm by --tip") from None
    raise UsageError(f"{message}: give --tip {tip}")


def load_rigid(
    robot: str | Path | CalibratedChain, measured: Path | None = None, base: str | None = None, tip: str | None = None
) -> tuple[CalibratedChain, Path]:
    """Return the robot for dynamics and motion planning, and its file.

    The robot's chain is the best geometry without joint corrections, since neither torque models nor controllers apply
    corrections. The geometry that was fitted together with corrections is less accurate without them.

    Args:
        robot: name of a library robot, file (URDF, or MDH table in TOML), folder of a fit, or a robot in memory.
        measured: table whose joint columns determine the chain of a URDF; None: no table.
        base, tip: first and last link of the arm in a URDF; None: chosen by default.
    """
    if isinstance(robot, CalibratedChain):
        return robot, Path(robot.source or robot.chain.name)
    chain, source = load_robot(robot, measured, FitOptions(), base, tip)
    if not is_urdf(source):
        return calibrated.read(source), source
    if measured is not None and tip is None:
        _check_joint_columns(chain, source, measured, base)
    return CalibratedChain(chain), source


def _check_joint_columns(chain: Chain, source: Path, measured: Path, base: str | None) -> None:
    """Check that a table has columns for all revolute joints of the arm, since other positions would be unknown.

    Args:
        chain: the arm that was chosen by the table's columns.
        source: file of the robot.
        measured: the table.
        base: first link of the arm; None: chosen by default.

    Raises:
        UsageError: if a column is missing.
    """
    try:
        arm = urdf.read(source, base)
    except CalibError:  # the URDF does not say by itself where its arm ends
        return
    revolute = [joint.name for joint in arm.joints if joint.kind != "prismatic"]
    missing = [name for name in revolute if name not in chain.joint_names]
    if missing and set(chain.joint_names) < set(arm.joint_names):
        raise UsageError(
            f"{measured}: column '{missing[0]}' is missing: the arm of {source.name} has {arm.n} joints, but the "
            f"table has {chain.n}; if the arm ends at {chain.tip}, give --tip {chain.tip}"
        )


def read_file(
    source: Path | PoseMeasurements, chain: Chain, options: FitOptions, like: Sequence[PoseMeasurements] = ()
) -> list[PoseMeasurements]:
    """Return the measurements in a file (or folder of images), checked against the arm's joints and limits.

    Args:
        source: the file, or a block in memory, which is checked in the same way.
        chain: the arm.
        options: options for reading the file.
        like: blocks that were read earlier; images of the same size are assumed to be from the same camera.

    Raises:
        MeasurementError: for a file that cannot be read, or implausible values.
    """
    path = _path(source)
    joints = joints_of(chain)
    file_options = options.for_file(path)
    if not isinstance(source, (str, Path)):
        blocks = [source]
        if tuple(source.joint_names) == chain.joint_names or len(source.joint_names) == chain.n:
            blocks = [check_block(source, file_options, joints)]
    elif is_image_folder(path):
        from calib.data.images.image_folders import read_images

        blocks = [read_images(path, joints, file_options)]
    elif path.is_dir():
        raise MeasurementError("is a folder; give a CSV, or a folder of images with joints.csv", path)
    else:
        blocks = []
        if file_options.planned:
            for planned_poses in PLANNED_POSES.all():
                blocks += planned_poses(path, chain, file_options)
        if not blocks:
            try:
                blocks = read_measurements(path, joints, file_options)
            except Undecided as undecided:
                blocks = decided(chain, undecided, joints)
            except MeasurementError:
                _refuse_pairs(path, file_options)
                raise

    result = []
    for block in blocks:
        if isinstance(block, Pixels):
            from calib.geometry.camera.camera_guess import complete_camera

            block = complete_camera(chain, block, like)
        result.append(block)
    result = [as_seen_by_instrument(chain, block) for block in result]
    for block in result:
        # of unseen files, too: the fit checks the rows that it fits only
        check_scale(block, chain)
        check_orientations(chain, block)
    return [with_stated_load(chain, block) for block in result]


def _refuse_pairs(path: Path, options: FileOptions) -> None:
    """Raise MeasurementError for a file with pairs of poses, which do not say the joints; return for other files."""
    pairs = None
    with suppress(MeasurementError):
        pairs = read_pairs(path, options)
    if pairs is not None:
        raise MeasurementError(
            f"has {len(pairs)} pairs of poses ({pairs.robot.title}, {pairs.camera.title}) and no joints: calib "
            "hand-eye places camera and board by them; all else needs joint values",
            path,
        )


def _path(source: Path | PoseMeasurements) -> Path:
    if isinstance(source, (str, Path)):
        return Path(source)
    return Path(source.file or "measured")


def hold_out(block: PoseMeasurements, share: float, seed: int) -> tuple[PoseMeasurements, PoseMeasurements | None]:
    """Return the rows of a block to fit, and the held-out rows (None for a share of 0).

    Whole poses are drawn at random, so that the reflectors of one pose, the two rows of a distance and the cycles of a
    repeated pose stay together.

    Args:
        block: the measurements.
        share: share of the poses to hold out.
        seed: seed of the random choice.

    Raises:
        MeasurementError: if the share yields no poses, or all poses.
    """
    if share == 0.0:
        return block, None
    pose = pose_of_row(block)
    count = int(pose.max()) + 1
    held_count = round(share * count)
    order = np.random.default_rng(seed).permutation(count)
    if held_count == 0 or held_count == count:
        raise MeasurementError(
            f"a hold-out share of {share:g} gives {held_count} of {count} poses; state another share", block.file
        )
    held_out = np.isin(pose, order[count - held_count :])
    return take(block, np.flatnonzero(~held_out)), take(block, np.flatnonzero(held_out))


def pose_of_row(block: PoseMeasurements) -> np.ndarray:
    """Return the index (m,) of the pose, or measured pair of poses, for each row of a block.

    Cycles of a repeated pose have the same index.
    """
    labels = np.array(block.together)
    for cycles in repeated_rows(block):
        labels[np.isin(labels, labels[cycles])] = labels[cycles[0]]
    row_labels = labels.tolist()
    index = {label: k for k, label in enumerate(dict.fromkeys(row_labels))}
    return np.array([index[label] for label in row_labels], dtype=int)


def pose_count(blocks: Sequence[PoseMeasurements]) -> int:
    """Return the number of robot poses in the blocks; several reflectors measured at once count as one pose."""
    return sum(len(np.unique(block.rows)) for block in blocks)


def _with_station_and_tool_names(
    read_blocks: Sequence[tuple[Path, PoseMeasurements]], options: FitOptions, stations: str, tools: str
) -> list[PoseMeasurements]:
    """Return the blocks to fit with station and tool names by the options --stations and --tools.

    All names are distinct. If the arm carried a camera and another target, or two cameras, these are different tools,
    regardless of --tools.

    Args:
        read_blocks: (file, measurements) of each block.
        options: options for reading the files, which may state names.
        stations: ``one`` base placement for all files, or one for each.
        tools: one tool for all files, or one for each.
    """
    carried = list(dict.fromkeys(block.carried for _, block in read_blocks))
    station_of: dict[Path, str] = {}
    files_of_station: dict[str, int] = {}
    blocks = []
    for path, block in read_blocks:
        if tools == "one" and len(carried) > 1 and block.tool_names == (FileOptions().tool,):
            block = replace(block, tool_names=(_carried_name(block.carried, carried),))
        if tools == "each":
            block = replace(block, tool_names=tuple(f"{path.stem} {name}" for name in block.tool_names))
        if path not in station_of:
            station = block.station
            if stations == "one":
                station = "station"
            if stations == "each" and not options.for_file(path).station:
                number = files_of_station.get(station, 0) + 1
                files_of_station[station] = number
                if number > 1:
                    station = f"{station} {number}"
            station_of[path] = station
        blocks.append(replace(block, station=station_of[path]))

    # a station that is called like a target gets a name of its own
    target_names = {name for block in blocks for name in block.tool_names}
    for index, block in enumerate(blocks):
        if block.station in target_names:
            blocks[index] = replace(block, station=f"{block.station} station")
    return blocks


def _carried_name(device: tuple[str, object], carried: Sequence[tuple[str, object]]) -> str:
    """Return the name of the tool in a file: its kind, with a number if it is not the first tool of this kind.

    Args:
        device: kind and identity of what the arm carried in the file.
        carried: kind and identity of everything that the arm carried in any file, each once.
    """
    kind = device[0]
    of_kind = [candidate for candidate in carried if candidate[0] == kind]
    number = of_kind.index(device) + 1
    if number == 1:
        return kind
    return f"{kind} {number}"


def _free_name(unseen: Mapping[str, Unseen], file: str) -> str:
    """Return the name of a file as a key for `unseen`, or its path if this name is already used there."""
    if Path(file).name not in unseen:
        return Path(file).name
    name = file
    number = 1
    while name in unseen:
        number += 1
        name = f"{file} ({number})"
    return name


def _with_frames_of_fit(block: PoseMeasurements, fit: Sequence[PoseMeasurements], notes: list[str]) -> PoseMeasurements:
    """Return a validation block with the names of the fit's station and tools; remarks are appended to `notes`.

    Raises:
        UsageError: if the fit has no station or tools for the block.
    """
    fit = [fitted for fitted in fit if fitted.carried == block.carried] or fit
    if block.has_instrument:
        stations = [fitted.station for fitted in fit if fitted.has_instrument]
        if not stations:
            raise UsageError(f"{block.file}: no fit file has this instrument; refit its frames (--refit-frames)")
        if block.station not in stations:
            block = replace(block, station=stations[0])
            notes.append(
                f"{Path(block.file).name} is predicted with the fit's station '{stations[0]}'; if the instrument stood "
                "elsewhere, refit its frames (--refit-frames)"
            )
    fit_tools = {name for fitted in fit for name in fitted.tool_names}
    if set(block.tool_names) <= fit_tools:
        return block
    if len(block.tool_names) != len(fit[0].tool_names):
        tools = ", ".join(block.tool_names)
        raise UsageError(
            f"{block.file}: the fit has no tool {tools}, only {', '.join(sorted(fit_tools))}; refit its frames "
            "(--refit-frames)"
        )
    return replace(block, tool_names=fit[0].tool_names)
