"""What leaves a session: the calibrated robot in the forms others read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from calib import files
from calib.errors import RobotError, UsageError
from calib.folders import check_target, write_staged
from calib.procedure.export import geometry
from calib.procedure.export.geometry import results
from calib.procedure.export.parameters import PARAMETERS
from calib.procedure.kinematic_stage.folder import CORRECTED_URDF, FORMULA, TERMS, URDF
from calib.robot.calibrated import ROBOT
from calib.robot.formats.markup import with_comment

COPIED = (ROBOT, TERMS, FORMULA)
OFFSETS, UR_KINEMATICS = "joint_offsets.csv", "ur_kinematics.yaml"
WRITTEN = (*COPIED, URDF, CORRECTED_URDF, OFFSETS, UR_KINEMATICS)
MARKS = (OFFSETS, PARAMETERS)  # by which an earlier export is known, of a geometry or of dynamics
FIRST = "verdict fail: "  # how a README.txt of ours begins; another's is left alone


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
    notes = [f"robot.urdf: {made}; {read}"]
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


def mark_failed(out: Path, verdicts: Mapping[str, tuple[str, str]]) -> list[str]:
    """Write failed verdicts at the head of the exported URDFs and into a README.txt beside them; return what to say.

    Args:
        out: the folder of the export; without a failed stage an earlier README.txt is removed from it.
        verdicts: stage to verdict (``pass``, ``marginal``, ``fail``) and reason.
    """
    failed = [f"{stage}: {reason}" for stage, (verdict, reason) in verdicts.items() if verdict == "fail"]
    readme = out / "README.txt"
    if not failed:
        if readme.exists() and readme.read_text(encoding="utf-8", errors="replace").startswith(FIRST):
            readme.unlink()
        return []
    words = f"{FIRST}{'; '.join(failed)}; do not use"
    files.write(readme, f"{words}\nThe files in this folder were exported for inspection only.\n")
    for path in sorted(out.rglob("*.urdf")):
        files.write(path, with_comment(path.read_bytes(), words))
    return [words]
