"""Export of the calibrated robot to the formats of other programs; each file is verified by reading it back.

``calib export FIT --into DIR [--urdf SOURCE.urdf]`` writes, from the folder of a fit, robot.toml, robot.urdf,
joint_offsets.csv, the joint corrections where there are any, and ur_kinematics.yaml of a UR arm;
``calib export IDENTIFIED --into DIR [--urdf SOURCE.urdf]``, from the folder of an identification,

robot.urdf            the source with calibrated joint origins, masses and friction; comments, meshes, limits, all else
                      as it was. ``<inertial>`` of a link: origin at its centre of mass, axes of the link.
                      ``<dynamics damping friction>``: Fv and Fc. URDF has no place for motor inertia: see drives.csv.
robot.xml             MJCF for MuJoCo: bodies, armature (Ia), damping (Fv), frictionloss (Fc); no meshes.
drives.csv            joint, armature, damping, friction, offset, and the sigma of each: for simulators that take them;
                      by hand. A sigma is empty where the model has no such term. Then a row per coupling, as
                      "joint5 + joint6", of a motor that turns with both.
joint_offsets.csv     of a fit: joint, unit, ``add_to_reading`` (a joint that the controller reads q of stands at q
                      plus this), ``add_to_command`` (the same with the other sign, to send), sigma. They are of a fit
                      of offsets alone, and stand instead of robot.urdf, not beside it. Left out, with the reason,
                      where the fit has none.
joint_origins.yaml    with --urdf: origins as tesseract reads them, ``<calibration_config filename=.../>`` in the SRDF:
                      calibration / joints / name / position x y z [m], orientation x y z w.
parameters.json       names, units, values and covariances of geometry and dynamics, base and standard parameters, what
                      consistency cost, and ``prediction``: unexplained torque [%] by the exported robot (robot.urdf
                      with drives.csv) and by the identified model, at the samples of the ``torques_N.csv`` named there.
README.txt            what each file is for, and the verdict on it.

Masses are those of physically consistent bodies (`calib.identification.physical_consistency.solve`). What the torques
do not
identify is regularised towards the masses of the robot's description: by the entropic (log-det) prior, which keeps off
the border of the physically consistent; with ``--prior euclidean`` by its second order, which does not, so that a body
may come out thin. A link to which others are fixed (flange, covers, sensors) is identified with them as one body: the
others keep the masses the source gives them, and the moving link takes the rest. Where that rest is not physically
consistent, the moving link takes all and the others get mass zero. Links on joints that are not part of the arm
(fingers) keep theirs, standing at zero. Payloads that were identified are not part of the robot: they are in
parameters.json alone. Offsets, gear couplings and richer friction have no place in URDF and MJCF; parameters.json has
them, and a note says so. The sign of Coulomb friction was smoothed as tanh(v / v0).
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from calib import files
from calib.errors import UsageError
from calib.folders import OFFSETS, PARAMETERS, check_target, write_staged
from calib.procedure.dynamic_stage import with_geometry
from calib.procedure.dynamic_stage.folder import IdentificationFolder
from calib.procedure.dynamic_stage.metrics import JudgedMetrics, ModelMetrics, UnseenReport
from calib.procedure.export import geometry, identified
from calib.procedure.export.geometry import results
from calib.procedure.export.identified import ExportedPrediction, IdentifiedRobot
from calib.procedure.export.joint_origins import joint_origins
from calib.procedure.export.ur_kinematics import kinematics
from calib.procedure.findings import Verdict, Verdicts
from calib.procedure.kinematic_stage.folder import (
    CORRECTED_URDF,
    FORMULA,
    IN_SESSION,
    TERMS,
    URDF,
    VALIDATED,
    FitFolder,
    ValidationFolder,
)
from calib.procedure.kinematic_stage.mastering import NoOffsets
from calib.procedure.kinematic_stage.metrics import FitMetrics, ValidationMetrics
from calib.robot.calibrated import ROBOT, CalibratedChain, nominal_of
from calib.robot.chain import Joint
from calib.robot.description import impossible_bodies
from calib.robot.formats import urdf_write
from calib.robot.formats.urdf_tree import is_urdf, text, with_comment

README, UR_KINEMATICS, MJCF, DRIVES = "README.txt", "ur_kinematics.yaml", "robot.xml", "drives.csv"
GEOMETRY, DYNAMICS = "geometry", "dynamics"
READ_BACK = "Pinocchio reads the same poses and torques to 1e-9"
DRIVE_COLUMNS = (
    "joint",
    "armature",
    "damping",
    "friction",
    "offset",
    "armature_unit",
    "damping_unit",
    "friction_unit",
    "armature_sigma",
    "damping_sigma",
    "friction_sigma",
    "offset_sigma",
)


@dataclass(frozen=True, eq=False)
class Export:
    """Sources of an export: nominal robot, fit and identification.

    Attributes:
        source: description of the nominal robot; a copy of a URDF is edited; None or another format: a new URDF is
            written.
        fit: folder of the fit; None: only the identified dynamics are exported.
        identified: folder of the identification; None: only the geometry is exported.
        prior: regularisation of masses that the torques do not identify, see
            `calib.identification.physical_consistency.solve.PRIORS`.
        remark: text at the head of files that a robot or a simulation uses for motion; empty: no text.
    """

    source: Path | None
    fit: Path | None = None
    identified: Path | None = None
    prior: str = "entropic"
    remark: str = ""

    @property
    def geometry_folder(self) -> Path:
        """Folder of the geometry: of the fit, or of an identification that estimated the geometry with the dynamics."""
        if self.fit is None or (self.identified is not None and (self.identified / with_geometry.COVARIANCE).is_file()):
            return self.identified or Path()
        return self.fit

    @cached_property
    def robot(self) -> CalibratedChain:
        return geometry.read(self.geometry_folder)

    @cached_property
    def dynamics(self) -> IdentifiedRobot:
        return identified.read(self.identified or Path(), self.prior)

    @cached_property
    def prediction(self) -> ExportedPrediction | None:
        return identified.exported_prediction(self.dynamics, self.identified or Path())

    @property
    def urdf(self) -> Path | None:
        """Path of the source if it is a URDF; otherwise None."""
        if self.source is not None and is_urdf(self.source):
            return self.source
        return None

    @cached_property
    def with_masses(self) -> tuple[str, list[str]]:
        """Text of the URDF with identified masses and friction, and remarks for the user."""
        robot = self.dynamics
        if self.urdf is None:
            return identified.as_urdf(robot, urdf_write.write_new(robot.chain), "the chain's own URDF", robot.chain)
        return identified.as_urdf(robot, text(self.urdf)[0], str(self.urdf), nominal_of(robot.robot))

    @property
    def files(self) -> list["ExportFile"]:
        """Files that belong to this export, in the order of writing.

        Files for which the robot has no data are in the list, but are not written.
        """
        files_of_stages = []
        for file in FILES:
            of_fit = self.fit is not None and GEOMETRY in file.stages
            of_identification = self.identified is not None and DYNAMICS in file.stages
            if of_fit or of_identification:
                files_of_stages.append(file)
        return files_of_stages


def _urdf(export: Export, path: Path) -> list[str]:
    if export.identified is None:
        return _geometric_urdf(export, path, URDF)
    edited, remarks = export.with_masses
    encoding = "utf-8"
    if export.urdf is not None:
        _, encoding = text(export.urdf)
    files.write(path, edited.encode(encoding))
    notes = [str(export.prediction)] if export.prediction else []
    notes.append(f"{URDF}: joint origins, masses and friction; {READ_BACK}")
    return [*notes, *identified.notes_of(export.dynamics), *remarks]


def _corrected_urdf(export: Export, path: Path) -> list[str]:
    if export.robot.corrections is None:
        return []
    return _geometric_urdf(export, path, CORRECTED_URDF)


def _geometric_urdf(export: Export, path: Path, name: str) -> list[str]:
    """Write a URDF of the calibrated geometry and return remarks for the user.

    Args:
        export: sources of the export.
        path: path of the written file.
        name: `URDF` (rigid geometry), or `CORRECTED_URDF` (geometry for use with joint corrections).
    """
    if export.urdf is not None:
        content, programs = geometry.edited_urdf(export.robot, export.urdf, for_corrections=name != URDF)
        change = f"joint origins of {export.urdf} are calibrated; base link, flange and all else are unchanged"
        if export.urdf.suffix != ".urdf":
            change += f" (a URDF: {export.urdf.name} itself is not rewritten)"
    else:
        content = ((export.fit or Path()) / name).read_bytes()
        chain = export.robot.chain if name == URDF else export.robot.complete
        programs = geometry.check_readback(content.decode(), name, chain)
        change = "written from the calibrated table"
    files.write(path, _remarked(content, export.remark))
    notes = [f"{path.name}: {change}; {programs}"]
    if name == URDF:
        notes += [f"unchanged from the source: {fault}" for fault in impossible_bodies(export.robot.chain)]
    return notes


def _copy(export: Export, path: Path) -> list[str]:
    folder = export.geometry_folder if path.name == ROBOT else export.fit or Path()
    original = folder / path.name
    if not original.exists():
        return []
    files.write(path, original.read_bytes())
    if path.name == TERMS:
        return [f"{TERMS}: corrections for {CORRECTED_URDF}; formula in {FORMULA}"]
    return []


def _offsets(export: Export, path: Path) -> list[str]:
    mastering = geometry.export_offsets(export.fit or Path(), path)
    return [f"{path.name}: {mastering}, not those of {URDF}; calib deliver states the frames that belong to them"]


def _ur_kinematics(export: Export, path: Path) -> list[str]:
    content, flange = kinematics(export.robot, FitFolder(export.fit or Path()).urdf)
    files.write(path, _remarked(content.encode(), export.remark))
    return [f"{path.name}: for kinematics_params_file of ur_description" + (f"; {flange}" if flange else "")]


def _mjcf(export: Export, path: Path) -> list[str]:
    files.write(path, identified.as_mjcf(export.dynamics, path.name))
    return [f"{path.name}: MJCF with armature, damping and frictionloss; {READ_BACK}"]


def write_drives(joints: Sequence[Joint], drives: identified.Drives, path: Path) -> None:
    """Write ``drives.csv``: the drive parameters of joints and joint couplings, with their σ.

    Args:
        joints: the joints.
        drives: the parameters.
        path: path of the file.
    """
    names = [joint.name for joint in joints]
    kinds = [joint.kind for joint in joints]
    for first, second, weight in drives.pairs:
        sign = "+" if weight > 0 else "-"
        names.append(f"{joints[first].name} {sign} {joints[second].name}")
        kinds.append(joints[first].kind)
    values = np.vstack([drives.values, drives.couplings])
    sigmas = np.zeros(values.shape) if drives.sigma is None else drives.sigma
    rows = []
    for name, kind, row, sigma in zip(names, kinds, values, sigmas, strict=True):
        units = ("kg m²", "N m s/rad", "N m")
        if kind == "prismatic":
            units = ("kg", "N s/m", "N")
        # a sigma is empty where the model has no such term
        stated = [float(value) or None for value in sigma]
        rows.append((name, *map(float, row), *units, *stated))
    files.write_table(path, DRIVE_COLUMNS, rows)


def _drives(export: Export, path: Path) -> list[str]:
    write_drives(export.dynamics.chain.joints, export.dynamics.drives, path)
    note = f"{path.name}, {PARAMETERS}"
    if export.urdf is not None:
        note += ", joint_origins.yaml (tesseract's SRDF)"
    return [note]


def _joint_origins(export: Export, path: Path) -> list[str]:
    if export.urdf is not None:
        origins = joint_origins(text(export.urdf)[0], export.with_masses[0], str(export.urdf))
        files.write(path, origins)
    return []


def _parameters(export: Export, path: Path) -> list[str]:
    files.write_json(path, identified.parameters(export.dynamics) | {"prediction": export.prediction})
    return []


@dataclass(frozen=True)
class ExportFile:
    """One file of an export.

    Attributes:
        name: file name.
        write: function that writes the file to a path if the robot has the data for it, and returns remarks.
        use: text on the file's use, for README.txt.
        stages: stages (geometry, dynamics) whose results the file contains.
        deliverable: name of the deliverable whose verdict applies to the file; empty: no robot or simulation uses the
            file for motion.
        marked: whether a verdict other than pass is written at the head of the file.
    """

    name: str
    write: Callable[[Export, Path], list[str]]
    use: str
    stages: tuple[str, ...] = (GEOMETRY,)
    deliverable: str = ""
    marked: bool = False


_TO_MASTER = f"for the controller's mastering: of a fit of joint offsets alone, instead of {URDF}, not beside it"
_ONLY = f"only for programs that apply {TERMS}, otherwise {URDF} is better; masses are those of the source"
TO_SIMULATE = "for simulators: motor inertia, friction and offset of each joint, with sigmas"
_UR = "for ur_description: kinematics_params_file"
_MUJOCO = "for MuJoCo: geometry, masses, motor inertia and friction"
_ROS = "for ROS, MoveIt and simulators; use this file if in doubt"
FILES = (
    ExportFile(URDF, _urdf, _ROS, (GEOMETRY, DYNAMICS), "urdf", marked=True),
    ExportFile(CORRECTED_URDF, _corrected_urdf, _ONLY, deliverable="corrections", marked=True),
    ExportFile(TERMS, _copy, "small corrections of each joint, which no URDF can contain", deliverable="corrections"),
    ExportFile(FORMULA, _copy, "how to apply them"),
    ExportFile(ROBOT, _copy, "for this toolkit: geometry with covariance and corrections", deliverable="corrections"),
    ExportFile(OFFSETS, _offsets, _TO_MASTER),
    ExportFile(UR_KINEMATICS, _ur_kinematics, _UR, deliverable="urdf", marked=True),
    ExportFile(MJCF, _mjcf, _MUJOCO, (DYNAMICS,), "urdf", marked=True),
    ExportFile(DRIVES, _drives, TO_SIMULATE, (DYNAMICS,)),
    ExportFile("joint_origins.yaml", _joint_origins, "for tesseract", (DYNAMICS,)),
    ExportFile(PARAMETERS, _parameters, "all parameters of geometry and dynamics with covariances", (DYNAMICS,)),
)


def deliver(export: Export, out: Path) -> list[str]:
    """Write the calibrated robot into the folder `out` in all file formats; the module's docstring describes the files.

    Args:
        export: sources of the export.
        out: the folder.

    Returns:
        Remarks on the written files, as text.

    Raises:
        RobotError: if a file, read back, differs from the robot; nothing is written.
    """
    notes: list[str] = []

    def write(staging: Path) -> None:
        for file in export.files:
            try:
                notes.extend(file.write(export, staging / file.name))
            except geometry.NoSuchArm:
                # a file for arms of another maker
                continue
            except NoOffsets as error:
                notes.append(f"{file.name}: left out: {error}")

    write_staged(out, [file.name for file in export.files], write)
    return notes


def deliver_single(export: Export, targets: Mapping[str, Path]) -> list[str]:
    """Write single files of an export.

    Args:
        export: sources of the export.
        targets: file name -> path of the written file; other files are not written.

    Returns:
        Remarks on the written files, as text.
    """
    notes = []
    for file in export.files:
        if file.name in targets:
            notes += file.write(export, targets[file.name])
    return notes


def check_into(export: Export, into: Path, folder: Path) -> None:
    """Check, before any other work, that an export can be written into a folder.

    Args:
        export: sources of the export.
        into: folder for the exported files.
        folder: folder of the fit or the identification.

    Raises:
        UsageError: if the folder is not usable, or contains inputs or files that no export writes; the message names
            the folder or file.
    """
    names = [file.name for file in export.files]
    marks: tuple[str, ...] = (PARAMETERS,)
    earlier_fit = (into / ROBOT).exists() and (into / README).exists()
    if earlier_fit or (into / OFFSETS).exists() or (into / PARAMETERS).exists():
        marks = ()
    check_target(into, names, marks, "export", [export.urdf, *results(folder)])


def fit_verdicts(folder: Path) -> Verdicts:
    """Return the verdicts on a fit and its deliverables, read from the folder of the fit.

    In a session, these are the verdicts on held-out poses. Empty if the folder is from an earlier version without
    verdict, or if the session has not yet judged the fit.
    """
    try:
        record = _fit_record(folder)
    except UsageError:
        return Verdicts()
    return Verdicts(_stage_verdict("geometry", record), record.deliverables)


def model_verdicts(folder: Path) -> Verdicts:
    """Return the verdict on an identification, read from the folder of the identification.

    In a session, this is the verdict on held-out motion. Empty if the folder is from an earlier version without
    verdict, or if the session has not yet judged the model.
    """
    try:
        record = _identification_record(folder)
    except UsageError:
        return Verdicts()
    return Verdicts(_stage_verdict("dynamics", record))


def _identification_record(folder: Path) -> UnseenReport | ModelMetrics:
    """Return the stored record of an identification that contains the verdict.

    It is the record on held-out motion if a session has judged the model, otherwise the folder's ``metrics.json``.
    """
    identification = IdentificationFolder(folder)
    if identification.unseen.report.is_file():
        return identification.unseen.read()
    return identification.metrics()


def _fit_record(folder: Path) -> ValidationMetrics | FitMetrics:
    """Return the stored record of a fit that contains the verdict.

    It is the record on held-out poses if a session has judged the fit, otherwise the folder's ``metrics.json``.
    """
    validation = ValidationFolder(folder.absolute().parent / VALIDATED)
    if folder.absolute().name == IN_SESSION and validation.judged.is_file():
        return validation.metrics()
    return FitFolder(folder).metrics()


def _stage_verdict(stage: str, record: JudgedMetrics | ValidationMetrics) -> dict[str, Verdict]:
    """Return a dictionary from the stage's name to the verdict in a record; empty if the record has no verdict."""
    return {stage: Verdict(record.verdict, record.reason)} if record.verdict else {}


def by_file(out: Path, verdicts: Verdicts) -> dict[str, Verdicts]:
    """Return the verdicts on the exported files that robots or simulations use for motion: file name -> verdicts.

    Only existing files are included.

    Args:
        out: folder of the export.
        verdicts: verdicts on the stages and deliverables.
    """
    with_dynamics = (out / PARAMETERS).exists()
    result = {}
    for file in FILES:
        if file.deliverable and (out / file.name).exists():
            result[file.name] = verdicts.of(file.deliverable, with_dynamics and DYNAMICS in file.stages)
    return result


def prediction(out: Path) -> ExportedPrediction | None:
    """Return the torque prediction errors of an exported robot; None without dynamics, or if unknown.

    Args:
        out: folder of the export.
    """
    path = out / PARAMETERS
    if not path.exists():
        return None
    table = json.loads(path.read_text(encoding="utf-8")).get("prediction")
    return None if table is None else ExportedPrediction(**table)


def mark(out: Path, verdicts: Verdicts) -> list[str]:
    """Write verdicts other than pass at the head of exported files, and README.txt with the use of each file.

    A README.txt that this toolkit did not write is kept.

    Args:
        out: folder of the export.
        verdicts: verdicts on the stages and deliverables.

    Returns:
        Texts for the user on verdicts that are marginal or fail.
    """
    of_files = by_file(out, verdicts)
    for file in FILES:
        if file.marked and file.name in of_files:
            remark = of_files[file.name].remark
            if remark:
                files.write(out / file.name, _remarked((out / file.name).read_bytes(), remark))

    # a README that is not ours stays
    readme = out / README
    if not readme.exists() or readme.read_text(encoding="utf-8", errors="replace").startswith("verdict "):
        lines = [str(verdicts) if verdicts.level else "verdict unknown"]
        predicted = prediction(out)
        if predicted:
            lines.append(str(predicted))
        files.write(readme, "\n".join([*lines, "", *_uses(out, of_files), ""]))

    remarks = [verdicts.remark] if verdicts.remark else []
    for name, file_verdicts in of_files.items():
        differs = name in (URDF, CORRECTED_URDF) and file_verdicts.level != verdicts.level
        if differs and file_verdicts.remark:
            remarks.append(f"{name}: {file_verdicts.remark}")
    return remarks


def _uses(out: Path, of_files: Mapping[str, Verdicts]) -> Iterator[str]:
    """Yield the lines of README.txt for each exported file: its use, and the verdict on it.

    Args:
        out: folder of the export.
        of_files: file name -> verdicts that apply to the file.
    """
    with_dynamics = (out / PARAMETERS).exists()
    for file in FILES:
        name = file.name
        if not (out / name).exists():
            continue
        use = f"{name}: {file.use}"
        if name == URDF:
            masses = "identified masses and friction" if with_dynamics else "masses of the source"
            use += f"; geometry with {masses}"
        yield use
        if name in of_files and of_files[name].level:
            # with its reasons where it is the robot
            verdict = f"verdict {of_files[name].level}"
            if name in (URDF, CORRECTED_URDF):
                verdict = str(of_files[name])
            yield f"    {verdict}"
    if with_dynamics:
        yield "the geometry alone: calib export FIT --urdf SOURCE.urdf --out robot_geometry_only.urdf"


def _remarked(content: bytes, remark: str) -> bytes:
    """Return the content of an XML or YAML file with a one-line remark as a comment at the head.

    Without a remark, the content is unchanged.
    """
    if not remark:
        return content
    # behind a byte order mark, perhaps in UTF-16; our YAML begins with a comment
    if b"<" in content[:8]:
        return with_comment(content, remark)
    return f"# {remark}\n".encode() + content
