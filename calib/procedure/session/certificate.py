"""The certificate of a session: the results of geometry and dynamics, read from the session's folders, on one page."""

from dataclasses import dataclass, replace
from pathlib import Path

from calib import files
from calib.data.poses import CORNERS, JOINTS
from calib.errors import command_line
from calib.extensions import offered
from calib.folders import CERTIFICATE
from calib.procedure.excitation.coefficients import SAMPLES
from calib.procedure.kinematic_stage.folder import SCHEMA, URDF
from calib.procedure.kinematic_stage.metrics import FitMetrics
from calib.procedure.report import certificate, fit_report
from calib.procedure.report.certificate import FileRow
from calib.procedure.report.fit_report import RowErrors
from calib.procedure.report.page import Section, Text
from calib.procedure.session.folder import CHECKED, MARK, SELECTION, Say, Session, read_state
from calib.procedure.session.geometry_steps import chain_of
from calib.records import read_json, read_lines

ROLES = {
    "1-robot": "nominal robot", "3-measured": "measured", "4-fit": "fit", "6-excitation": "motion to record",
    "7-recorded": "recorded", "8-dynamics": "identified model", "6-export": "calibrated robot",
    "9-export": "calibrated robot",
}  # fmt: skip
TORQUES = {
    "motor": "motors'", "link": "of sensors behind the gears", "both": "motors' and of sensors behind the gears",
}  # fmt: skip


def certify(session: Session, say: Say) -> list[str]:
    """Write the certificate of a session as HTML, and return its notes."""
    from calib.procedure.report import dynamics_section, geometry_section

    say("drawing" if session.plots else "writing")
    judged, whole = [], None
    if session.geometric:
        whole, drawn = _whole_report(session), {}
        if session.plots:
            from calib.procedure.report.geometry_figures import draw

            drawn = draw(whole)
        section = geometry_section.certificate_section(whole, drawn)
        judged = [_with_arrival(section, _arrival_notes(session, "3-measured", "validate"))]
    if session.dynamic:
        dynamics = dynamics_section.read(session.identification.path)
        exported = read_state(session).notes("export")
        drawn = {}
        if session.plots:
            from calib.procedure.report.dynamics_figures import draw_dynamics

            motions = session.path("6-excitation") if session.settings.dynamics.plan else None
            drawn = draw_dynamics(dynamics, session.identification.path, motions, chain_of(session).joints)
        tolerance = session.settings.dynamics.tolerance_percent
        section = dynamics_section.certificate_section(dynamics, drawn, exported, tolerance)
        own = session.verdicts().stages["dynamics"]
        section = replace(section, verdict=own.level, reason=own.reason)
        judged.append(_with_arrival(section, _arrival_notes(session, "7-recorded", "predict")))
    notes = [f"{section.title.lower()} {section.verdict}: {section.reason}" for section in judged]
    simulated = session.path(MARK).exists()
    page = certificate.certificate(
        f"{'Simulated calibration' if simulated else 'Calibration'} of {session.settings.name}",
        f"{'SIMULATED: ' if simulated else ''}{session.settings.instrument.name}, {session.settings.created[:10]}",
        _setup(session, whole),
        judged,
        listed(session),
    )
    files.write(session.path(CERTIFICATE), certificate.render(page))
    recordings = [write(session.folder) for write in offered("recordings") if session.plots]
    return [*notes, CERTIFICATE, *recordings]


def _whole_report(session: Session) -> fit_report.Report:
    """Return the report of the fit, including the results of the step validate."""
    place = session.validation
    found = place.metrics()
    if found.schema >= SCHEMA:
        return fit_report.read(place.report)
    fit = fit_report.read(session.fit.report)
    known = place.rows.exists() and found.validation
    rows = read_json(place.rows, "validate again", tuple[RowErrors, ...]) if known else ()
    return fit.with_unseen(replace(found, warnings=(*fit.metrics.warnings, *found.warnings)), rows)


def _arrival_notes(session: Session, place: str, unseen: str) -> list[str]:
    """Return the notes made when the files were read: training files, and files of the step `unseen`."""
    lines = read_lines(session.path(f"{place}/{CHECKED}"))
    files_there = session.brought("validation" if place == "3-measured" else "unseen")
    said = read_state(session).notes(unseen)
    names = tuple(f"{each.name}: " for each in files_there)
    return [line for line in (*lines, *(note for note in said if names and note.startswith(names))) if line.strip()]


def _with_arrival(section: Section, lines: list[str]) -> Section:
    """Return a section with the missing notes on its input files appended."""
    said = {line for block in section.blocks if isinstance(block, Text) for line in block.lines}
    fresh = [line for line in dict.fromkeys(lines) if line not in said]
    return replace(section, blocks=[*section.blocks, Text("Notes on the files when they were read", fresh)])


def _setup(session: Session, found: fit_report.Report | None) -> list[tuple[str, str]]:
    """Return the rows (label, value) of the certificate's table "Setup", for the stages that the session has."""
    settings, chain = session.settings, chain_of(session)
    described = settings.robot.given if found else f"{settings.robot.given}, taken as calibrated"
    rows = [*(("simulated", line) for line in read_lines(session.path(MARK)))]
    rows += [
        ("robot", f"{chain.name}, {chain.base} to {chain.tip}, {chain.n} joints"), ("description", described),
        ("session made", settings.created.replace("T", " ")),
    ]  # fmt: skip
    if found:
        plan = _session_plan(session)
        rows += [
            ("instrument", _instrument(session, found.metrics)),
            ("measurements", _named(session.brought("measured", "validation"))),
            ("pose plan", plan.words), ("poses kept", ", ".join(plan.checked)),
            ("poses NOT checked for", ", ".join(plan.unchecked)), ("model", found.metrics.model),
            ("tolerance", certificate.tolerance(settings.fit.tolerance_mm, found.metrics)),
        ]  # fmt: skip
    if session.dynamic:
        section = settings.dynamics
        allowed = section.tolerance_percent
        rows += [
            ("recordings", _named(session.brought("training", "unseen"))), ("torques", TORQUES[section.torques]),
            ("tolerance of torque", f"{allowed:g} % on unseen motion" if allowed else "none given: pass below 10 %"),
            ("payloads", ", ".join(f"{label} {mass:g} kg" for label, mass in section.payloads.items())),
        ]  # fmt: skip
    rows += [
        ("seed", str(settings.seed)), ("command", command_line("next", session.folder.name)),
        ("toolkit", certificate.versions()),
    ]  # fmt: skip
    return [(label, value) for label, value in rows if value.strip()]


def _instrument(session: Session, found: FitMetrics) -> str:
    """Return a text on the instrument: kind of measurement (as given, and as used) and sigmas."""
    instrument = session.settings.instrument
    said, turned = instrument.measures, found.fit.calibrated.orientation_deg is not None
    used = {("position", True): "poses with orientation", ("pose", False): "positions or distances alone"}
    other = used.get((said, turned))
    measures = (
        f"said to measure {said}, but the files contain {other}; these were used" if other else f"measures {said}"
    )
    stated = f"σ {1e6 * instrument.sigma_position:g} µm" if instrument.sigma_position else "σ estimated"
    turning = f", {1e3 * instrument.sigma_orientation:g} mrad" if instrument.sigma_orientation else ""
    return f"{instrument.name}, {measures}, {stated}{turning}"


def _named(paths: list[Path]) -> str:
    """Return the file names as one text, without dates, since copying changes a file's date."""
    return ", ".join(path.name for path in paths)


@dataclass(frozen=True)
class _Plan:
    """The content of ``selection.json``: how the poses were chosen, the checked limits, and the limits not checked."""

    words: str = "chosen by hand"
    checked: tuple[str, ...] = ()
    unchecked: tuple[str, ...] = ()


def _session_plan(session: Session) -> _Plan:
    path = session.path(SELECTION)
    if not session.settings.poses.plan or not path.exists():
        return _Plan("poses not planned here")
    return read_json(path, "repeat the step with `calib redo`", _Plan)


def _filed(paths: list[Path]) -> list[Path]:
    """Return the measured files to archive; an image folder is represented by its file of detected corners."""
    own = [
        (path / CORNERS if (path / CORNERS).exists() else path / JOINTS) if path.is_dir() else path for path in paths
    ]
    return [*own, *(path / JOINTS for path in paths if path.is_dir() and (path / CORNERS).exists())]


def listed(session: Session) -> list[FileRow]:
    """Return name, content, size [bytes] and SHA-256 of the certificate's files, the most important ones first."""
    exported = sorted(path for path in session.path(session.export).glob("*") if path.is_file())
    exported.sort(key=lambda path: path.name != URDF)
    filed = [
        *exported[:1],
        session.robot_file,
        *_filed(session.brought("measured")),
        *_filed(session.brought("validation")),
    ]
    if session.dynamic:
        filed += [path for path in session.brought("training", "unseen") if path.is_file()]
        if session.settings.dynamics.plan:  # else other motions were played
            filed += sorted(session.path("6-excitation").glob(f"*/{SAMPLES}"))
        filed += [*session.identification.tables, session.identification.model]
    filed += [*(session.fit.tables if session.geometric else ()), *exported[1:]]
    made = {name: mark for step in read_state(session).steps.values() for name, mark in step.outputs.items()}
    judged = session.validation.metrics().validation if session.geometric else {}
    rows, seen = [], [name for name, found in judged.items() if not found.unseen]
    for path in filed:
        name = path.relative_to(session.folder)
        role = ROLES[name.parts[0]]
        if name.parts[-1].lower().startswith("validation") or name.parts[1].lower().startswith("validation"):
            which = "the fit" if name.parts[0] == "3-measured" else "the identification"
            known = name.parts[0] == "3-measured" and name.parts[1] in seen
            role = certificate.unseen_role(role, known, which)
        if name.parts[0] in ("4-fit", "8-dynamics", session.export) and made.get(str(name)) != files.fingerprint(path):
            role = certificate.EDITED
        rows.append(certificate.file_row(str(name), role, path))
    return rows
