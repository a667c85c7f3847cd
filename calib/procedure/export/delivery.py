"""What leaves a session: the calibrated robot in the forms others read."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from calib import files
from calib.errors import RobotError, UsageError
from calib.folders import DRIVES, JOINT_ORIGINS, MJCF, OFFSETS, PARAMETERS, check_target, write_staged
from calib.procedure.dynamic_stage.folder import IdentificationFolder
from calib.procedure.export import geometry
from calib.procedure.export.geometry import results
from calib.procedure.export.identified import ExportedPrediction
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
from calib.robot.calibrated import ROBOT
from calib.robot.description_checks import impossible_bodies
from calib.robot.formats.markup import with_comment

README = "README.txt"
COPIED = (ROBOT, TERMS, FORMULA)
UR_KINEMATICS = "ur_kinematics.yaml"
WRITTEN = (*COPIED, URDF, CORRECTED_URDF, OFFSETS, UR_KINEMATICS)
MARKS = (OFFSETS, PARAMETERS)  # by which an earlier export is known, of a geometry or of dynamics
USES = {
    URDF: "for ROS, MoveIt and simulators; if in doubt, take this one",
    CORRECTED_URDF: f"only for programs that apply {TERMS}, worse than {URDF} without them; masses as in the source",
    TERMS: "small corrections of each joint, which no URDF can hold",
    FORMULA: "how to apply them",
    ROBOT: "for this toolkit: geometry with covariance, and the corrections",
    OFFSETS: "for the controller: joint offsets to add to its mastering; the rest of the geometry left out",
    UR_KINEMATICS: "for ur_description: kinematics_params_file",
    MJCF: "for MuJoCo: geometry, masses, motor inertia and friction",
    DRIVES: "for simulators: motor inertia, friction and offset of each joint, with sigmas",
    JOINT_ORIGINS: "for tesseract",
    PARAMETERS: "all parameters of geometry and dynamics with covariances",
}
MARKED = (URDF, CORRECTED_URDF, MJCF, UR_KINEMATICS)  # state their verdict themselves
CORRECTED, DYNAMIC = (CORRECTED_URDF, TERMS, ROBOT), (URDF, MJCF)


def deliver(fit: Path, source: Path, out: Path) -> list[str]:
    """Write the calibrated robot into `out`: TOML, URDF (the source's own XML where it is one), joint offsets.

    Args:
        fit: the folder of the fit.
        source: the robot's description.
        out: folder for the files.

    Returns:
        What was written, in words.
    """
    notes: list[str] = []
    write_staged(out, USES, lambda staging: notes.extend(_write(fit, source, staging)))
    return notes


def check_into(into: Path, folder: Path, urdf: Path | None, written: Sequence[str]) -> None:
    """Refuse, before any work is done, a folder for exports that cannot be one, or holds what is read or another's.

    Args:
        into: where `written` is to go.
        folder: of the fit or the identification; urdf: the description to edit.
        written: names of the files.

    Raises:
        UsageError: with the file or folder concerned.
    """
    earlier = any((into / mark).exists() for mark in MARKS)
    check_target(into, written, () if earlier else (PARAMETERS,), "export", [urdf, *results(folder)])


def _write(fit: Path, source: Path, out: Path) -> list[str]:
    for name in COPIED:
        if (fit / name).exists():
            files.write(out / name, (fit / name).read_bytes())
    found = geometry.read(fit)
    given = source.suffix == ".urdf"
    urdfs = {URDF: found.chain}
    if found.corrections is not None:
        urdfs[CORRECTED_URDF] = found.corrections.chain
    read = ""
    for name, chain in urdfs.items():
        if given:
            read = geometry.export_urdf(found, source, out / name, for_corrections=name != URDF)
        else:
            written = (fit / name).read_text(encoding="utf-8")
            read = geometry.check_readback(written, name, chain)
            files.write(out / name, written)
    made = (
        "the given URDF with calibrated joint origins, all else kept" if given else "written from the calibrated table"
    )
    notes = [
        f"robot.urdf: {made}; {read}",
        *(f"as the source has it: {each}" for each in impossible_bodies(found.chain)),
    ]
    geometry.export_offsets(found, out / OFFSETS)
    notes.append("robot.toml, joint_offsets.csv")
    try:
        geometry.export_ur_kinematics(found, out / UR_KINEMATICS)
        flange = geometry.flange_note(found)
        words = f"{UR_KINEMATICS}: for kinematics_params_file of ur_description"
        notes.append(f"{words}; {flange}" if flange else words)
    except (RobotError, UsageError):  # no UR arm
        pass
    if found.corrections is not None:
        notes.append(f"{TERMS}: what a URDF cannot hold, on top of {CORRECTED_URDF}; formula in {FORMULA}")
    return notes


def verdicts(folder: Path) -> Verdicts:
    """Return what was judged of a fit or an identification, by its folder; in a session by unseen rows.

    Empty where the folder is of an earlier version and does not say it, or where its session has yet to judge it.
    """
    identified = IdentificationFolder(folder)
    validated = ValidationFolder(folder.absolute().parent / VALIDATED)
    try:
        if identified.model.is_file():
            found = identified.unseen.read() if identified.unseen.report.is_file() else identified.metrics()
            return Verdicts({"dynamics": Verdict(found.verdict, found.reason)} if found.verdict else {})
        own = folder.absolute().name == IN_SESSION and validated.judged.is_file()
        judged = validated.metrics() if own else FitFolder(folder).metrics()
    except UsageError:
        return Verdicts()
    return Verdicts({"geometry": Verdict(judged.verdict, judged.reason)} if judged.verdict else {}, judged.deliverables)


def by_file(out: Path, found: Verdicts) -> dict[str, Verdicts]:
    """Return what was judged of each exported file that is there, and that a robot or a simulation may move by."""
    dynamic = (out / PARAMETERS).exists()
    return {
        name: found.of("corrections" if name in CORRECTED else "urdf", dynamic and name in DYNAMIC)
        for name in (*MARKED, *CORRECTED)
        if (out / name).exists()
    }


def prediction(out: Path) -> ExportedPrediction | None:
    """Return how well an exported robot predicts torques; None without dynamics, or where that is not known."""
    path = out / PARAMETERS
    found = json.loads(path.read_text(encoding="utf-8")).get("prediction") if path.exists() else None
    return None if found is None else ExportedPrediction(**found)


def mark(out: Path, found: Verdicts) -> list[str]:
    """Write verdicts that are no pass at the head of the exported files, and what each file is for into a README.txt.

    Args:
        out: the folder of the export.
        found: what was judged.

    Returns:
        What does not pass, in words.
    """
    judged = by_file(out, found)
    for name, own in judged.items():
        if own.remark and name in MARKED:
            mark_file(out / name, own.remark)
    readme, known = out / README, prediction(out)
    if not readme.exists() or readme.read_text(encoding="utf-8", errors="replace").startswith("verdict "):
        head = [str(found) if found.level else "verdict unknown", *([str(known)] if known else []), ""]
        files.write(readme, "\n".join([*head, *_uses(out, judged), ""]))
    aside = {name: own for name, own in judged.items() if name in (URDF, CORRECTED_URDF) and own.level != found.level}
    lines = [found.remark, *(own.remark and f"{name}: {own.remark}" for name, own in aside.items())]
    return [line for line in lines if line]


def _uses(out: Path, judged: Mapping[str, Verdicts]) -> Iterator[str]:
    """Yield what each exported file is for, and the verdict on it."""
    holds = "identified masses and friction" if (out / PARAMETERS).exists() else "masses as in the source"
    for name, use in USES.items():
        if (out / name).exists():
            yield f"{name}: {use}" + (f"; geometry with {holds}" if name == URDF else "")
            if name in judged and judged[name].level:
                yield f"    {judged[name]}" if name in (URDF, CORRECTED_URDF) else f"    verdict {judged[name].level}"
    if (out / PARAMETERS).exists():
        yield "the geometry alone: calib export FIT --urdf SOURCE.urdf --out robot_geometry_only.urdf"


def mark_file(path: Path, words: str) -> None:
    """Write words, one line, at the head of an XML or YAML file, as a comment."""
    content = path.read_bytes()
    xml = b"<" in content[:8]  # behind a byte order mark, perhaps in UTF-16; our YAML begins with a comment
    files.write(path, with_comment(content, words) if xml else f"# {words}\n".encode() + content)
