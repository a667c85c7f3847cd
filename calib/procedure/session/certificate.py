"""The certificate of a session, on the results of geometry and dynamics that are read from the session's folders."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from calib import files
from calib.data.poses import CORNERS, JOINTS
from calib.errors import command_line
from calib.extensions import Point
from calib.folders import CERTIFICATE, ESTIMATE, METRICS, PAGES, REPORT, read_estimate
from calib.procedure.dynamic_stage.computed_torque import torque_tests
from calib.procedure.excitation import coefficients
from calib.procedure.export.delivery import prediction
from calib.procedure.kinematic_stage.folder import SCHEMA, URDF
from calib.procedure.kinematic_stage.metrics import FitMetrics
from calib.procedure.report import fit_report
from calib.procedure.report.certificate import dynamics_pages, geometry, rendering
from calib.procedure.report.certificate.record import EDITED, Certificate, Entry, Page, StageRecord, records
from calib.procedure.report.certificate.results import loads, measured_range, tolerance
from calib.procedure.report.figures import figure_data
from calib.procedure.report.fit_report import RowErrors, file_row, unseen_role
from calib.procedure.report.page import FileRow, Text, chart_pictures
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
from calib.procedure.session.steps import ExportedFile, SessionFile, SessionStep, StepSetting
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
    """Write certificate and report of a session, and return notes for the user."""
    say("drawing" if session.plots else "writing")
    certificate, report = pages(session)
    judged = [section for section in report.sections if section.verdict]
    notes = [f"{section.title.lower()} {section.verdict}: {section.reason}" for section in judged]
    written = rendering.write(session.folder, certificate, report)
    recordings = [write(session.folder) for write in RECORDINGS.all() if session.plots]
    return [*notes, CERTIFICATE, *written, *recordings]


def pages(session: Session) -> tuple[Certificate, Page]:
    """Return certificate and report of a session as records, which are rendered as HTML and PDF."""
    stages = []
    metrics = None
    if session.geometric:
        report = _validated_report(session)
        metrics = report.metrics
        stages.append(_geometry(session, report))
    if session.dynamic:
        stages.append(_dynamics(session))

    settings = session.settings
    simulated = read_lines(session.path(MARK))
    title, alert = f"Calibration of {settings.name}", ""
    if simulated:
        _, _, mark = simulated[0].rpartition("; ")
        title, alert = f"Simulated calibration of {settings.name}", f"SIMULATED: {mark}"
    subtitle = f"{settings.instrument.name}, {settings.created[:10]}"
    setup = [Entry("simulated", line) for line in simulated]
    setup += _setup(session, metrics)
    unchecked = list(_unchecked(session))
    return records(title, subtitle, setup, stages, unchecked, listed(session), settings.certificate, alert)


def _geometry(session: Session, report: fit_report.Report) -> StageRecord:
    """Return the content of report and certificate on the geometry; with figures if the session draws figures."""
    figures = {}
    if session.plots:
        from calib.procedure.report.geometry_figures import captioned

        figures = chart_pictures(captioned(report))
    return _with_arrival(geometry.stage(report, figures), _arrival_notes(session, "3-measured", "validate"))


def _dynamics(session: Session) -> StageRecord:
    """Return the content of report and certificate on the dynamics of a session.

    The verdict is that on the exported robot.
    """
    from calib.procedure.report import dynamics_section

    report = dynamics_section.read(session.identification.path)
    figures = {}
    if session.plots:
        from calib.procedure.report.dynamics_figures import captioned

        charts = captioned(report, session.identification.path)
        # friction, and the torques with all samples
        for path in (session.identification.path, session.identification.unseen.path):
            charts |= figure_data.of_folder(path)
        training = session.path("6-excitation") / "training"
        if session.settings.dynamics.plan and (training / coefficients.NAME).exists():
            charts["excitation"] = dynamics_pages.trained_on(training, chain_of(session).joints)
        figures = chart_pictures(charts)
    allowed = session.settings.dynamics.tolerance_percent
    predicted = prediction(session.path(session.export))
    delivered = None
    if predicted is not None:
        delivered = predicted.compared if allowed else predicted.exported
    exported = read_state(session).notes("export")
    tolerances, joint_count = session.settings.dynamics.tolerance_torque, len(chain_of(session).joints)
    tests = torque_tests(tolerances, report.unseen.proofs, report.unseen.rows, joint_count)
    section = dynamics_section.report_section(report, figures, exported, allowed, delivered, tests)
    verdict = session.verdicts().stages["dynamics"]
    section = replace(section, verdict=verdict.level, reason=verdict.reason)
    stage = dynamics_pages.stage(report, section, session.plots, bool(allowed or tests))
    return _with_arrival(stage, _arrival_notes(session, "7-recorded", "predict"))


def _validated_report(session: Session) -> fit_report.Report:
    """Return the report on a session's fit, including the results of the step ``validate``."""
    validation = session.validation
    metrics = validation.metrics()
    if metrics.schema >= SCHEMA:
        return fit_report.read(validation.report)
    # earlier versions stored the rows of the validation alone
    report = fit_report.read(session.fit.report)
    rows: tuple[RowErrors, ...] = ()
    if validation.rows.exists() and metrics.validation:
        rows = read_json(validation.rows, "validate again", tuple[RowErrors, ...])
    return report.with_unseen(replace(metrics, warnings=(*report.metrics.warnings, *metrics.warnings)), rows)


def _unchecked(session: Session) -> Iterator[str]:
    """Yield texts on the properties that the session as a whole cannot prove."""
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


def _arrival_notes(session: Session, folder: str, step: str) -> list[str]:
    """Return the notes on measured files that were made when the files were read.

    Args:
        session: the session.
        folder: folder of the training files: ``3-measured`` or ``7-recorded``.
        step: name of the step that read the held-out files.
    """
    lines = read_lines(session.path(f"{folder}/{CHECKED}"))
    unseen = session.brought("validation" if folder == "3-measured" else "unseen")
    prefixes = tuple(f"{path.name}: " for path in unseen)
    if prefixes:
        lines = [*lines, *(note for note in read_state(session).notes(step) if note.startswith(prefixes))]
    return [line for line in lines if line.strip()]


def _with_arrival(stage: StageRecord, lines: list[str]) -> StageRecord:
    """Return the content on a stage, with notes on input files added to the report section.

    Args:
        stage: content of report and certificate on the stage.
        lines: the notes; those that the section already contains are omitted.
    """
    blocks = stage.section.blocks
    present: set[str] = set()
    for block in blocks:
        if isinstance(block, Text):
            present.update(map(str, block.lines))
    missing = [line for line in dict.fromkeys(lines) if line not in present]
    notes = Text("Notes on the files when they were read", missing)
    return replace(stage, section=replace(stage.section, blocks=[*blocks, notes]))


def _setup(session: Session, metrics: FitMetrics | None) -> list[Entry]:
    """Return certificate entries on robot, instrument and method, for the stages of the session.

    Args:
        session: the session.
        metrics: metrics of the fit; None: no fit.
    """
    settings, chain = session.settings, chain_of(session)
    description = settings.robot.given
    if metrics is None:
        description += ", taken as calibrated"
    rows = [
        ("robot", f"{chain.name}, {chain.base} to {chain.tip}, {chain.n} joints"),
        ("description", description),
        ("session made", settings.created.replace("T", " ")),
    ]
    if metrics is not None:
        plan = _session_plan(session)
        rows += [
            ("instrument", _instrument(session, metrics)),
            ("measurements", _names(session.brought("measured", "validation"))),
            ("pose plan", plan.words),
            ("poses kept", ", ".join(plan.checked)),
            ("poses NOT checked for", ", ".join(plan.unchecked)),
            ("model", metrics.model),
            ("measured range", measured_range(metrics)),
            ("load", loads(metrics)),
            ("tolerance", tolerance(settings.fit.tolerance_mm, metrics)),
        ]
    if session.dynamic:
        section = settings.dynamics
        allowed = "none given: pass below 10 %"
        if section.tolerance_percent:
            allowed = f"{section.tolerance_percent:g} % on unseen motion"
        joint_tolerances = ", ".join(f"{tolerance:g}" for tolerance in section.tolerance_torque)
        payloads = ", ".join(_payloads(session))
        rows += [
            ("recordings", _names(session.brought("training", "unseen"))),
            ("torques", TORQUES[section.torques]),
            ("tolerance of torque", allowed),
            ("tolerance of joints' torques, rms", joint_tolerances and f"{joint_tolerances} N m or N"),
            ("payloads", payloads),
        ]
    rows += [
        ("seed", str(settings.seed)),
        ("command", command_line("next", session.folder.name)),
        ("toolkit", versions()),
    ]
    return [Entry(label, value) for label, value in rows if value.strip()]


def _instrument(session: Session, metrics: FitMetrics) -> str:
    """Return a text on a session's instrument: name, measured quantity (as stated, and as used), and σ.

    Args:
        session: the session.
        metrics: metrics of the fit, which state the measured quantities that were used.
    """
    instrument = session.settings.instrument
    with_orientation = metrics.fit.calibrated.orientation_deg is not None
    measures = f"measures {instrument.measures}"
    if instrument.measures == "position" and with_orientation:
        measures = "said to measure position, but the files contain poses with orientation; these were used"
    if instrument.measures == "pose" and not with_orientation:
        measures = "said to measure pose, but the files contain positions or distances alone; these were used"
    sigma = "σ estimated"
    if instrument.sigma_position:
        sigma = f"σ {1e6 * instrument.sigma_position:g} µm"
    if instrument.sigma_orientation:
        sigma += f", {1e3 * instrument.sigma_orientation:g} mrad"
    if instrument.reference:
        sigma += ", seen from a frame on the base that was measured with every row"
    return f"{instrument.name}, {measures}, {sigma}"


def _payloads(session: Session) -> Iterator[str]:
    """Yield for each payload of a session its label, what was stated of it, and its identified mass."""
    identified = {}
    if session.settings.dynamics.payloads and (session.identification.path / ESTIMATE).exists():
        identified = {row.name: row for row in read_estimate(session.identification.path)}
    for label, payload in session.settings.dynamics.payloads.items():
        text = f"{label} {payload}"
        mass = identified.get(f"M{label}")
        if mass is not None:
            sigma = f" ± {mass.sigma:.2g}" if mass.sigma else ""
            text += f" (identified: {mass.value:.4g}{sigma} kg)"
        yield text


def _names(paths: list[Path]) -> str:
    """Return the names of the files `paths` as one text.

    Dates are omitted, since copying changes the date of a file.
    """
    return ", ".join(path.name for path in paths)


@dataclass(frozen=True)
class _Plan:
    """The content of ``selection.json``: how the poses were selected, as text, and the checked and unchecked limits."""

    words: str = "chosen by hand"
    checked: tuple[str, ...] = ()
    unchecked: tuple[str, ...] = ()


def _session_plan(session: Session) -> _Plan:
    path = session.path(SELECTION)
    if not session.settings.poses.plan or not path.exists():
        return _Plan("poses not planned here")
    return read_json(path, "repeat the step with `calib redo`", _Plan)


def _filed(paths: list[Path]) -> list[Path]:
    """Return the measured files for the certificate's list; the file of detected corners represents an image folder.

    Args:
        paths: the measured files.
    """
    archived = []
    joints = []
    for path in paths:
        if not path.is_dir():
            archived.append(path)
        elif (path / CORNERS).exists():
            archived.append(path / CORNERS)
            joints.append(path / JOINTS)
        else:
            archived.append(path / JOINTS)
    return [*archived, *joints]


def listed(session: Session) -> list[FileRow]:
    """Return name, role, size [bytes] and SHA-256 of the files in a session's certificate.

    The most important files are first.
    """
    judged_files = {}
    if session.path(VERDICT).exists():
        judged_files = read_json(session.path(VERDICT)).get("files", {})
    fingerprints: dict[str, str] = {}
    for record in read_state(session).steps.values():
        fingerprints |= record.outputs
    # validation files that the fit has used
    fitted = []
    if session.geometric:
        validation = session.validation.metrics().validation
        fitted = [name for name, rows in validation.items() if not rows.unseen]

    rows = []
    for path in _archive(session):
        name = path.relative_to(session.folder)
        folder, file = name.parts[0], name.parts[1]
        role = ROLES[folder]
        # the file, or the folder of images or bags
        if name.name.lower().startswith("validation") or file.lower().startswith("validation"):
            if folder == "3-measured":
                role = unseen_role(role, file in fitted, "the fit")
            else:
                role = unseen_role(role, False, "the identification")
        if folder == session.export and name.name in judged_files:
            role = f"{role}, verdict {judged_files[name.name]['verdict']}"
        is_output = folder in ("4-fit", "8-dynamics", session.export)
        if is_output and fingerprints.get(str(name)) != files.fingerprint(path):
            role = EDITED
        rows.append(file_row(str(name), role, path))
    return rows


def _archive(session: Session) -> list[Path]:
    """Return the paths of the files that a session's certificate lists, the most important ones first."""
    exported = sorted(path for path in session.path(session.export).glob("*") if path.is_file())
    exported.sort(key=lambda path: path.name != URDF)
    paths = [*exported[:1], session.robot_file]
    paths += _filed(session.brought("measured"))
    paths += _filed(session.brought("validation"))
    if session.dynamic:
        paths += [path for path in session.brought("training", "unseen") if path.is_file()]
        # else other motions were played
        if session.settings.dynamics.plan:
            paths += sorted(session.path("6-excitation").glob(f"*/{coefficients.SAMPLES}"))
        paths += [*session.identification.tables, session.identification.model]
    if session.geometric:
        paths += session.fit.tables
    return [*paths, *exported[1:]]


STEP = SessionStep(
    "certificate",
    "print the certificate",
    certify,
    reads=(
        SessionFile(VERDICT, without_geometry=True),
        SessionFile(f"4-fit/{REPORT}"),
        SessionFile(f"5-validation/{METRICS}"),
        ExportedFile(URDF),
        SessionFile(SELECTION, optional=True),
        SessionFile(POSES_CHECKED),
        SessionFile(MOTION_CHECKED),
        SessionFile(f"8-dynamics/{METRICS}"),
        SessionFile(f"8-dynamics/{ESTIMATE}"),
        SessionFile(f"8-dynamics/unseen/{REPORT}"),
        SessionFile(MARK, optional=True),
    ),
    makes=PAGES,
    settings=(
        StepSetting("name"),
        StepSetting("created"),
        StepSetting("instrument"),
        StepSetting("poses"),
        StepSetting("fit"),
        StepSetting("dynamics", ("torques", "payloads", "tolerance_percent", "tolerance_torque")),
        StepSetting("certificate"),
    ),
)
