"""What leaves a session: the calibrated robot in the forms others read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from calib import files
from calib.errors import RobotError, UsageError
from calib.folders import check_target, write_staged
from calib.procedure.dynamic_stage.folder import IdentificationFolder
from calib.procedure.export import geometry
from calib.procedure.export.geometry import results
from calib.procedure.export.parameters import PARAMETERS
from calib.procedure.findings import LEVELS
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

COPIED = (ROBOT, TERMS, FORMULA)
OFFSETS, UR_KINEMATICS = "joint_offsets.csv", "ur_kinematics.yaml"
WRITTEN = (*COPIED, URDF, CORRECTED_URDF, OFFSETS, UR_KINEMATICS)
DYNAMICS = "dynamics"  # where they are, if on another geometry than robot.urdf's
MARKS = (OFFSETS, PARAMETERS)  # by which an earlier export is known, of a geometry or of dynamics
SAID = {"fail": "; do not use", "marginal": ""}  # verdicts that the exported files state, and what is added to them
FIRST = tuple(f"verdict {level}: " for level in SAID)  # how a README.txt of ours begins; another's is left alone


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
    write_staged(out, WRITTEN, lambda staging: notes.extend(_write(fit, source, staging)))
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
        *(f"AS THE SOURCE HAS IT: {each}" for each in impossible_bodies(found.chain)),
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
        left = geometry.without_corrections(fit)
        words = f"{TERMS}: what a URDF cannot hold, on top of {CORRECTED_URDF}; formula in {FORMULA}"
        notes.append(f"{words}; {left}" if left else words)
    return notes


def verdicts(folder: Path) -> dict[str, tuple[str, str]]:
    """Return verdict and reason of a fit or an identification by its folder; in a session those on unseen rows.

    Empty where the folder is of an earlier version and does not say it.
    """
    identified = IdentificationFolder(folder)
    validated = ValidationFolder(folder.absolute().parent / VALIDATED)
    try:
        if identified.model.is_file():
            found = identified.unseen.verdict() if identified.unseen.report.is_file() else identified.metrics()
            return {"dynamics": (found.verdict, found.reason)}
        own = folder.absolute().name == IN_SESSION and validated.judged.is_file()
        judged = validated.metrics() if own else FitFolder(folder).metrics()
    except UsageError:
        return {}
    return {"geometry": (judged.verdict, judged.reason)}


def worst(verdicts: Mapping[str, tuple[str, str]]) -> str:
    """Return the worst of the stages' verdicts; empty where there is none."""
    return max((level for level, _ in verdicts.values()), key=LEVELS.index, default="")


def remark(verdicts: Mapping[str, tuple[str, str]]) -> str:
    """Return what to say of an export whose worst verdict is no pass: every stage that has it, with the reason."""
    level = worst(verdicts)
    if level not in SAID:
        return ""
    reasons = (f"{stage}: {reason}" for stage, (own, reason) in verdicts.items() if own == level)
    return f"verdict {level}: {'; '.join(reasons)}{SAID[level]}"


def mark(out: Path, verdicts: Mapping[str, tuple[str, str]]) -> list[str]:
    """Write a verdict that is no pass at the head of the exported files and into a README.txt; return the words.

    Args:
        out: the folder of the export; where all stages pass an earlier README.txt of ours is removed from it.
        verdicts: stage to verdict (``pass``, ``marginal``, ``fail``) and reason.
    """
    from calib.procedure.export.masses import MJCF  # slow to load, and needed for a verdict that is no pass alone

    readme = out / "README.txt"
    ours = not readme.exists() or readme.read_text(encoding="utf-8", errors="replace").startswith(FIRST)
    words = remark(verdicts)
    if not words:
        if ours:
            readme.unlink(missing_ok=True)
        return []
    if ours:
        inspect = "The files in this folder were exported for inspection only.\n" if worst(verdicts) == "fail" else ""
        files.write(readme, f"{words}\n{inspect}")
    names = (URDF, CORRECTED_URDF, MJCF, UR_KINEMATICS)
    for path in (place / name for place in (out, out / DYNAMICS) for name in names):
        if path.is_file():
            mark_file(path, words)
    return [words]


def mark_file(path: Path, words: str) -> None:
    """Write words, one line, at the head of an XML or YAML file, as a comment."""
    content = path.read_bytes()
    xml = b"<" in content[:8]  # behind a byte order mark, perhaps in UTF-16; our YAML begins with a comment
    files.write(path, with_comment(content, words) if xml else f"# {words}\n".encode() + content)
