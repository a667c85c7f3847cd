"""The certificate of a session: the results of geometry and dynamics, read from the session's folders."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from calib import files
from calib.data.poses import CORNERS, JOINTS
from calib.errors import command_line
from calib.extensions import Point
from calib.folders import CERTIFICATE, PAGES
from calib.procedure.excitation import coefficients
from calib.procedure.export.delivery import prediction
from calib.procedure.kinematic_stage.folder import SCHEMA, URDF
from calib.procedure.kinematic_stage.metrics import FitMetrics
from calib.procedure.report import fit_report
from calib.procedure.report.certificate import dynamics, geometry, rendering
from calib.procedure.report.certificate.record import EDITED, Certificate, Entry, Page, Stage, records
from calib.procedure.report.certificate.results import measured_range, tolerance
from calib.procedure.report.fit_report import RowErrors, file_row, unseen_role
from calib.procedure.report.page import FileRow, Text
from calib.procedure.report.templates import versions
from calib.procedure.session.folder import (
    CHECKED,
    MARK,
    MOTION_CHECKED,
    POSES_CHECKED,
    SELECTION,
    VERDICT,
    Say,
    Session,
    read_state,
)
from calib.procedure.session.geometry_steps import chain_of
from calib.procedure.session.steps import ExportedFile, SessionFile, SessionStep, Setting
from calib.records import read_json, read_lines

RECORDINGS: Point[Callable[[Path], str]] = Point(
    "recordings", "writes a recording of a session for Rerun, and returns its name"
)

ROLES = {
    "1-robot": "nominal robot",
    "3-measured": "measured",
    "4-fit": "fit",
    "6-excitation": "motion to record",
    "7-recorded": "recorded",
    "8-dynamics": "identified model",
    "6-export": "calibrated robot",
    "9-export": "calibrated robot",
}
TORQUES = {
    "motor": "of the motors",
    "link": "of sensors behind the gears",
    "both": "of the motors and of sensors behind the gears",
}


def certify(session: Session, say: Say) -> list[str]:
    """Write certificate and report of a session, and return its notes."""
    say("drawing" if session.plots else "writing")
    one, whole = pages(session)
    judged = [section for section in whole.sections if section.verdict]
    notes = [f"{section.title.lower()} {section.verdict}: {section.reason}" for section in judged]
    written = rendering.write(session.folder, one, whole)
    recordings = [write(session.folder) for write in RECORDINGS.all() if session.plots]
    return [*notes, CERTIFICATE, *written, *recordings]


def pages(session: Session) -> tuple[Certificate, Page]:
    """Return certificate and report of a session."""
    whole = _whole_report(session) if session.geometric else None
    stages = [*([_geometry(session, whole)] if whole else []), *([_dynamics(session)] if session.dynamic else [])]
    simulated, settings, rows = read_lines(session.path(MARK)), session.settings, listed(session)
    title = f"{'Simulated calibration' if simulated else 'Calibration'} of {settings.name}"
    subtitle = f"{settings.instrument.name}, {settings.created[:10]}"
    setup = [*(Entry("simulated", line) for line in simulated), *_setup(session, whole and whole.metrics)]
    alert = f"SIMULATED: {simulated[0].rpartition('; ')[2]}" if simulated else ""
    return records(title, subtitle, setup, stages, [*_unchecked(session)], rows, settings.certificate, alert)


def _geometry(session: Session, whole: fit_report.Report) -> Stage:
    drawn = {}
    if session.plots:
        from calib.procedure.report.charts import pictures
        from calib.procedure.report.geometry_figures import captioned

        drawn = pictures(captioned(whole))
    found = geometry.stage(whole, drawn)
    return _with_arrival(found, _arrival_notes(session, "3-measured", "validate"))


def _dynamics(session: Session) -> Stage:
    from calib.procedure.report import dynamics_section

    found, drawn = dynamics_section.read(session.identification.path), {}
    if session.plots:
        from calib.procedure.report.charts import picture, pictures
        from calib.procedure.report.dynamics_figures import captioned

        drawn = pictures(captioned(found, session.identification.path))
        training = session.path("6-excitation") / "training"
        if session.settings.dynamics.plan and (training / coefficients.NAME).exists():
            drawn["excitation"] = picture(*dynamics.trained_on(training, chain_of(session).joints))
    allowed, exported = session.settings.dynamics.tolerance_percent, read_state(session).notes("export")
    known = prediction(session.path(session.export))
    section = dynamics_section.report_section(found, drawn, exported, allowed, known and known.exported)
    own = session.verdicts().stages["dynamics"]
    section = replace(section, verdict=own.level, reason=own.reason)
    stage = dynamics.stage(found, section, session.plots, allowed)
    return _with_arrival(stage, _arrival_notes(session, "7-recorded", "predict"))


def _unchecked(session: Session) -> Iterator[str]:
    """Yield what the whole session does not show."""
    unchecked = _session_plan(session).unchecked if session.geometric else ()
    if unchecked:
        yield f"when poses were chosen: {', '.join(unchecked)}"
    if not session.geometric:
        yield "geometry: not measured, taken as described"
    if not session.dynamic:
        yield "dynamics: not identified"
    if session.geometric and not session.brought("drift"):
        yield "drift: no poses were measured once more at the end"
    if session.geometric and not session.settings.certificate.instrument_calibrated:
        yield "calibration of the instrument: its date was not stated"


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


def _with_arrival(stage: Stage, lines: list[str]) -> Stage:
    """Return a stage whose section of the report has the missing notes on its input files, too."""
    blocks = stage.section.blocks
    said = {line for block in blocks if isinstance(block, Text) for line in block.lines}
    fresh = [line for line in dict.fromkeys(lines) if line not in said]
    notes = Text("Notes on the files when they were read", fresh)
    return replace(stage, section=replace(stage.section, blocks=[*blocks, notes]))


def _setup(session: Session, found: FitMetrics | None) -> list[Entry]:
    """Return what was calibrated, with what and how, for the stages that the session has."""
    settings, chain = session.settings, chain_of(session)
    described = settings.robot.given if found else f"{settings.robot.given}, taken as calibrated"
    rows = [
        ("robot", f"{chain.name}, {chain.base} to {chain.tip}, {chain.n} joints"),
        ("description", described),
        ("session made", settings.created.replace("T", " ")),
    ]
    if found:
        plan = _session_plan(session)
        rows += [
            ("instrument", _instrument(session, found)),
            ("measurements", _named(session.brought("measured", "validation"))),
            ("pose plan", plan.words),
            ("poses kept", ", ".join(plan.checked)),
            ("poses NOT checked for", ", ".join(plan.unchecked)),
            ("model", found.model),
            ("measured range", measured_range(found)),
            ("tolerance", tolerance(settings.fit.tolerance_mm, found)),
        ]
    if session.dynamic:
        section = settings.dynamics
        allowed = section.tolerance_percent
        rows += [
            ("recordings", _named(session.brought("training", "unseen"))),
            ("torques", TORQUES[section.torques]),
            ("tolerance of torque", f"{allowed:g} % on unseen motion" if allowed else "none given: pass below 10 %"),
            ("payloads", ", ".join(f"{label} {mass:g} kg" for label, mass in section.payloads.items())),
        ]
    rows += [
        ("seed", str(settings.seed)),
        ("command", command_line("next", session.folder.name)),
        ("toolkit", versions()),
    ]
    return [Entry(label, value) for label, value in rows if value.strip()]


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
            filed += sorted(session.path("6-excitation").glob(f"*/{coefficients.SAMPLES}"))
        filed += [*session.identification.tables, session.identification.model]
    filed += [*(session.fit.tables if session.geometric else ()), *exported[1:]]
    judged_files = read_json(session.path(VERDICT)).get("files", {}) if session.path(VERDICT).exists() else {}
    made = {name: mark for step in read_state(session).steps.values() for name, mark in step.outputs.items()}
    judged = session.validation.metrics().validation if session.geometric else {}
    rows, seen = [], [name for name, found in judged.items() if not found.unseen]
    for path in filed:
        name = path.relative_to(session.folder)
        role = ROLES[name.parts[0]]
        if name.parts[-1].lower().startswith("validation") or name.parts[1].lower().startswith("validation"):
            which = "the fit" if name.parts[0] == "3-measured" else "the identification"
            known = name.parts[0] == "3-measured" and name.parts[1] in seen
            role = unseen_role(role, known, which)
        if name.parts[0] == session.export and name.name in judged_files:
            role = f"{role}, verdict {judged_files[name.name]['verdict']}"
        if name.parts[0] in ("4-fit", "8-dynamics", session.export) and made.get(str(name)) != files.fingerprint(path):
            role = EDITED
        rows.append(file_row(str(name), role, path))
    return rows


STEP = SessionStep(
    "certificate",
    "print the certificate",
    certify,
    reads=(
        SessionFile(VERDICT, without_geometry=True),
        SessionFile("4-fit/report.json"),
        SessionFile("5-validation/metrics.json"),
        ExportedFile("robot.urdf"),
        SessionFile(SELECTION, optional=True),
        SessionFile(POSES_CHECKED),
        SessionFile(MOTION_CHECKED),
        SessionFile("8-dynamics/metrics.json"),
        SessionFile("8-dynamics/estimate.csv"),
        SessionFile("8-dynamics/unseen/report.json"),
        SessionFile(MARK, optional=True),
    ),
    makes=PAGES,
    settings=(
        Setting("name"),
        Setting("created"),
        Setting("instrument"),
        Setting("poses"),
        Setting("fit"),
        Setting("dynamics", ("torques", "payloads", "tolerance_percent")),
        Setting("certificate"),
    ),
)
