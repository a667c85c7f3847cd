"""Steps of a session for geometry and export, which call the functions of `calib fit` and `calib export`.

A session selects two sets of poses: optimised poses for the fit, and random poses for the validation.
"""

import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from calib import files
from calib.data.images.coverage import image_words
from calib.data.images.pixels import Pixels
from calib.data.poses import IMAGES, MEASURED
from calib.data.poses.fit_options import FileOptions, FitOptions, read_options
from calib.data.poses.measurements import PoseMeasurements, Poses, Positions
from calib.data.poses.pose_lists import (
    MAX_JOINT_DIFFERENCE,
    check_against,
    filled_in,
    read_poses,
    unmeasured,
    write_poses,
)
from calib.data.schema import Joints
from calib.errors import CalibError, Finding, UsageError, finding
from calib.extensions import Point
from calib.folders import write_staged
from calib.geometry.checks.base_motion import base_motion
from calib.geometry.observability import SIGMA_ORIENTATION, observation, targets_of
from calib.identification.model_file import MODEL
from calib.poses.candidates import draw_candidates
from calib.poses.space import is_feasible
from calib.procedure.findings import UNJUDGED, Note, as_notes, notes_of
from calib.procedure.kinematic_stage import fit as fitting
from calib.procedure.kinematic_stage import folder as outputs
from calib.procedure.kinematic_stage import inputs, selection
from calib.procedure.kinematic_stage.settings import FitSettings, SelectionSettings
from calib.procedure.kinematic_stage.verdict.validation import Assessment, assess
from calib.procedure.measuring.constraints_file import VIEW_UNCHECKED
from calib.procedure.measuring.measuring_run import same_turn, write_run
from calib.procedure.measuring.pose_limits import read_limits
from calib.procedure.measuring.prediction import beside
from calib.procedure.measuring.prediction import read as read_prediction
from calib.procedure.measuring.prediction import write as write_prediction
from calib.procedure.report import fit_report
from calib.procedure.report.geometry_section import error_words, outlier_sentences, parameter_words
from calib.procedure.report.outputs import write_fit
from calib.procedure.session import drift, folder
from calib.procedure.session.folder import Say, Session
from calib.records import read_json
from calib.robot import calibrated
from calib.robot.chain import Chain, joint_kinds
from calib.robot.formats.urdf_tree import is_urdf
from calib.robot.library import load_calibrated
from calib.units import JOINT

# advice for a camera whose view cannot be checked
CAMERA_ADVICE = "add [camera] to the limits file, see `calib formats constraints`"
# [rad or m]: joints closer to the commanded ones were not read back
MIN_READBACK_DIFFERENCE = 1e-8

WRITE_PROGRAM: Point[Callable[[Path, Path, str, Sequence[str]], object]] = Point(
    "write_program", "files of a program of the poses in a CSV"
)


def _choose(session: Session, chain: Chain, say: Say) -> list[str]:
    """Select poses by the settings in ``session.toml``, and write poses, visiting order, and predicted σ.

    Args:
        session: the session.
        chain: the nominal arm.
        say: called with progress texts.

    Returns:
        Notes for the user.
    """
    settings, robot_file = session.settings, session.robot_file
    section, instrument = settings.poses, settings.instrument
    sigmas = None
    if instrument.sigma_position:
        sigmas = instrument.sigma_position, instrument.sigma_orientation or SIGMA_ORIENTATION

    def report_progress(done: int, total: int, stage: str) -> None:
        say(f"choosing poses: {stage}")

    choice = selection.choose(
        robot_file,
        section.fit,
        SelectionSettings(
            kind=_selection_kind(instrument.measures),
            tools=(instrument.tool,),
            index=section.index,
            method=section.method,
            sigmas=sigmas,
            reference=instrument.reference,
            seed=settings.seed,
        ),
        constraints=session.named(section.constraints),
        **session.links,
        progress=report_progress,
    )
    is_noted = any(words.startswith(VIEW_UNCHECKED) for words in choice.unchecked)
    if instrument.measures == IMAGES and not choice.by_images and not is_noted:
        choice = replace(choice, unchecked=(*choice.unchecked, f"{VIEW_UNCHECKED} ({CAMERA_ADVICE})"))
    poses = choice.selection
    # a session is resumed, not gone on with half a search
    if poses.interrupted:
        raise KeyboardInterrupt

    validation = _write_pose_lists(session, chain, poses.joints)
    write_run(session.path(f"2-poses/{folder.WAYS}"), choice.run, chain)
    if choice.prediction is not None:
        write_prediction(choice.prediction, session.path(f"2-poses/{folder.POSES}"))
    outlook = choice.outlook.poses
    if session.plots and np.isfinite(outlook.rms):
        _write_predicted(session, outlook.points, outlook.spread)

    # a condition number is the better the smaller it is, other indices the larger
    gain = poses.value / poses.random_baseline
    if poses.index == "cond":
        gain = poses.random_baseline / poses.value
    words = (
        f"{len(poses.joints)} poses by {poses.method}, {poses.index} = {poses.value:.4g}, {gain:.2f} times the best of "
        f"1000 random sets, {100 * poses.efficiency:.1f} % of the convex bound ({selection.bound_words(poses)})"
    )
    record = {"words": words, **selection.record(choice), "seed": settings.seed}
    files.write_json(session.path(folder.SELECTION), record)

    notes = [f"{len(poses.joints)} poses for the fit: {words}"]
    if section.validation:
        notes.append(f"{validation} random poses for validation")
    notes += choice.kept()
    notes += [f"{quantity}: {value}" for quantity, value in selection.predicted_rows(choice)]
    notes += record["notes"]  # ty: ignore[unsupported-operator]
    return notes


def _write_pose_lists(session: Session, chain: Chain, q: np.ndarray) -> int:
    """Write the lists of poses to measure, and programs for the robot's controller.

    The lists are the selected poses for the fit, and random poses for the validation.

    Args:
        session: the session.
        chain: the nominal arm.
        q: (m, n) poses for the fit [rad or m].

    Returns:
        The number of poses for the validation.
    """
    lists = {folder.POSES: q}
    if session.settings.poses.validation:
        lists[folder.UNSEEN] = _random_poses(session, chain, session.settings.poses.validation)
    robot = session.settings.robot
    for name, joints in lists.items():
        path = write_poses(session.path(f"2-poses/{name}"), joints, chain.joint_names, joint_kinds(chain))
        if robot.controller:
            WRITE_PROGRAM.first()(path, path.with_suffix(""), robot.controller, robot.external)
    return len(lists.get(folder.UNSEEN, ()))


def _selection_kind(measures: str) -> str:
    """Return the kind of measurement for pose selection.

    Args:
        measures: quantity that the instrument measures; images (``pixels``) count as poses.
    """
    return "pose" if measures == IMAGES else measures


def _random_poses(session: Session, chain: Chain, count: int) -> np.ndarray:
    """Return random poses (count, n) [rad or m] within all limits, independent of the poses for the fit.

    Args:
        session: the session with its limits and seed.
        chain: the nominal arm.
        count: number of poses.
    """
    cell = targets_of(chain, [session.settings.instrument.tool])
    limits = read_limits(session.named(session.settings.poses.constraints), cell, session.robot_file)
    jacobian = observation(cell, _selection_kind(session.settings.instrument.measures))
    feasible = partial(is_feasible, limits.space(jacobian))
    stream = np.random.default_rng([session.settings.seed, 1])
    if limits.camera is not None:
        return limits.camera.draw(count, feasible, limits.lower, limits.upper, stream)
    q = draw_candidates(limits.lower, limits.upper, count, feasible, seed=stream)
    return same_turn(chain, q, limits.lower, limits.upper)


def chain_of(session: Session) -> Chain:
    """Return the nominal arm in the session's robot file."""
    return inputs.load_robot(session.robot_file, None, _options_of(session), **session.links)[0]


def _options_of(session: Session, paths: Sequence[Path] = ()) -> FitOptions:
    """Return the fit options, completed by the session's instrument and pose lists.

    Files without a stated σ get the instrument's σ. Files in `paths` that contain no joint values are assigned the
    session's list of planned poses.
    """
    options = read_options(session.named(session.settings.fit.options))
    by_file = dict(options.files)
    if session.settings.poses.plan:
        validation = session.brought("validation")
        for path in paths:
            plan = session.path(f"2-poses/{folder.UNSEEN if path in validation else folder.POSES}")
            if plan.exists():
                by_file[path.name] = replace(options.for_file(path), planned=str(plan))
    by_file = {name: _with_instrument(session, file_options) for name, file_options in by_file.items()}
    common = _with_instrument(session, options)
    return replace(options, sigma=common.sigma, base_frame=common.base_frame, files=by_file)


def _with_instrument(session: Session, options: FileOptions) -> FileOptions:
    """Return a file's options completed by a session's instrument: its σ, and whether it measures a base frame."""
    instrument, sigma = session.settings.instrument, options.sigma
    if instrument.sigma_position and sigma.position is None:
        sigma = replace(sigma, position=(instrument.sigma_position,) * 3)
    if instrument.sigma_orientation and sigma.orientation is None:
        sigma = replace(sigma, orientation=(instrument.sigma_orientation,) * 3)
    base_frame = options.base_frame
    if instrument.reference and base_frame == FileOptions.base_frame:
        base_frame = MEASURED
    return replace(options, sigma=sigma, base_frame=base_frame)


def describe(session: Session, say: Say) -> list[str]:
    """Read the robot, write a summary of it into the session's folder, and return notes for the user."""
    chain = chain_of(session)
    lines = [f"{chain.name}: {chain.base} to {chain.tip}, {chain.n} joints, {len(chain.elements)} elements", ""]
    for joint in chain.joints:
        factor, unit = JOINT[joint.kind]
        lines.append(f"{joint.name}: {joint.kind}, {factor * joint.lower:g} to {factor * joint.upper:g} {unit}")
    lines += ["", "elements, base to tip [m, rad]"]
    lines += [f"  {element.name:<24} {element.axis}  {element.value:.9g}" for element in chain.elements]
    files.write(session.path(folder.SUMMARY), "\n".join(lines) + "\n")
    if session.geometric:
        return [lines[0]]
    robot = load_calibrated(session.robot_file, **session.links)
    session.fit.path.mkdir(exist_ok=True)
    calibrated.write(session.fit.path, replace(robot, nominal=robot.nominal or robot.chain))
    return [lines[0], "nothing is measured: the geometry of the robot's file is used"]


def select(session: Session, say: Say) -> list[str]:
    """Select poses for the fit of a session and random poses for its validation, and return notes for the user.

    Raises:
        UsageError: if a pose list contains measurements, which would be overwritten.
    """
    if not session.settings.poses.plan:
        return ["no poses were chosen, since plan = false: the measured files may contain any poses"]
    chain = chain_of(session)
    for name in (folder.POSES, folder.UNSEEN):
        path = session.path(f"2-poses/{name}")
        if path.exists() and filled_in(path, chain.n):
            raise UsageError(
                f"{path} contains more than the planned poses and would be overwritten: move measurements to "
                f"{session.path('3-measured')}, and restore or remove this list"
            )
    say("choosing poses")
    return _choose(session, chain, say)


def arrive(session: Session, say: Say) -> list[Note]:
    """Check a session's measured files for the fit, and return notes for the user."""
    chain = chain_of(session)
    blocks = read_measured(session, chain, session.brought("measured"))
    repeated = read_measured(session, chain, session.brought("drift"))
    notes = notes_on(session, chain, blocks, folder.POSES)
    measured = [block for _, block in blocks]
    measured_later = [block for _, block in repeated]
    notes += notes_of(drift.of_session(session, chain, measured, measured_later))
    text = "\n".join(note.text for note in notes)
    files.write(session.path(folder.POSES_CHECKED), text + "\n")
    return notes


def read_measured(
    session: Session, chain: Chain, paths: Sequence[Path], like: Sequence[PoseMeasurements] = ()
) -> list[tuple[str, PoseMeasurements]]:
    """Return the measurements in files, each with the name of its file.

    Args:
        session: the session.
        chain: the nominal arm.
        paths: the files.
        like: measurements of the fit, whose lens and board apply to images in `paths`.

    Raises:
        MeasurementError: for implausible values; the message states row and column.
    """
    options = _options_of(session, paths)
    blocks = []
    for path in paths:
        blocks += [(path.name, block) for block in inputs.read_file(path, chain, options, like)]
    return blocks


def notes_on(session: Session, chain: Chain, blocks: Sequence[tuple[str, PoseMeasurements]], plan: str) -> list[Note]:
    """Return notes for the user on measurements: rows, kind, ignored columns, and planned poses that are missing.

    Args:
        session: the session.
        chain: the nominal arm.
        blocks: measurements with the names of their files.
        plan: name of the list of planned poses in ``2-poses``.
    """
    measures = session.settings.instrument.measures
    path = session.path(f"2-poses/{plan}")
    planned = None
    if session.settings.poses.plan and path.exists():
        planned = read_poses(path, Joints(chain.joint_names, joint_kinds(chain)))
    notes: list[Note] = []
    for name, block in blocks:
        ignored = f", ignored: {', '.join(block.ignored)}" if block.ignored else ""
        remarks = [f"{len(block)} rows of kind {block.kind}{ignored}"]
        if measures == Poses.kind and isinstance(block, Positions) and not isinstance(block, Poses):
            remarks.append("only positions, although the instrument measures poses")
        if isinstance(block, Pixels):
            remarks.append(image_words(block))
        elif measures == IMAGES:
            remarks.append("contains no images, although the instrument is a camera; the file is fitted nevertheless")
        remarks += block.notes
        if planned is not None:
            remarks += check_against(planned, block)
        notes += [Note(f"{name}: {remark}") for remark in remarks]
        notes += notes_of(base_motion([block]))
        if planned is not None:
            for note in notes_of(readback(planned, block)):
                notes.append(Note(f"{name}: {note.text}", note.is_warning))
    if planned is not None:
        notes += map(Note, unmeasured(planned, [block for _, block in blocks]))
    return notes


def readback(plan: np.ndarray, measured: PoseMeasurements) -> list[Finding]:
    """Return findings on the difference between measured and planned joint values.

    Args:
        plan: (m, n) planned joint values [rad or m].
        measured: measurements; rows that are not near a planned pose are ignored.

    Returns:
        One finding; an empty list if no row is near a planned pose.
    """
    distance, index = KDTree(plan).query(measured.q, p=np.inf)
    distance, index = np.atleast_1d(distance), np.atleast_1d(index)
    close = distance <= MAX_JOINT_DIFFERENCE
    if not close.any():
        return []
    difference = np.abs(measured.q[close] - plan[index[close]])
    if difference.max() < MIN_READBACK_DIFFERENCE:
        return [finding("readback-copied")]
    joint = measured.joint_names[int(np.argmax(difference.max(axis=0)))]
    rms = np.sqrt(np.mean(difference**2))
    return [finding("readback", rms=rms, largest=difference.max(), joint=joint)]


def _fit_settings(session: Session) -> FitSettings:
    """Return the fit settings of ``session.toml``; for a value ``auto``, the options file decides."""
    section = session.settings.fit
    masses = ""
    if (session.path(folder.MASSES) / MODEL).is_file():
        masses = str(session.path(folder.MASSES))
    settings = FitSettings(
        stations=section.stations,
        tolerance=1e-3 * section.tolerance_mm or None,
        refit_frames=section.validation_frames == "own",
        seed=session.settings.seed,
        holdout=section.holdout,
        deliverable=section.deliverable,
        masses=masses,
    )
    if section.model != "auto":
        settings = replace(settings, model=section.model)
    if section.loss != "auto":
        settings = replace(settings, loss=section.loss)
    return settings


def _gathered(session: Session, validate: Sequence[Path] = ()) -> inputs.Inputs:
    """Return the inputs of a session's fit: robot, measurements, and validation files.

    Args:
        session: the session.
        validate: the validation files; empty: none.
    """
    measured = session.brought("measured")
    links = session.links
    # the same links whatever joints the files' columns name
    if is_urdf(session.robot_file):
        chain = chain_of(session)
        links = {"base": chain.base, "tip": chain.tip}
    return inputs.gather(
        session.robot_file,
        measured,
        validate,
        options=_options_of(session, [*measured, *validate]),
        settings=_fit_settings(session),
        **links,
    )


def _write_predicted(session: Session, points: np.ndarray, sigma: np.ndarray) -> None:
    """Write the page with the map of the predicted σ (m,) [m] of the tool's position at workspace points (m, 3) [m]."""
    from calib.procedure.report.figures import figure_files
    from calib.procedure.report.geometry_figures import predicted_map
    from calib.procedure.report.outputs import figures_page

    chart = predicted_map(points, sigma)
    caption = "How well the tool's position will be known over the workspace."
    page = session.path(folder.PREDICTED)
    files.write(page, figures_page(f"Poses for {session.settings.name}", [], {"predicted": (chart, caption)}))
    if isinstance(session.plots, str):
        files.write(page.with_suffix(f".{session.plots}"), figure_files.drawn(chart, session.plots))


def fit(session: Session, say: Say) -> list[Note]:
    """Fit the geometry to a session's measured files, and return notes for the user; validation files are not used."""
    poses = session.path(f"2-poses/{folder.POSES}")
    predicted = None
    if session.settings.poses.plan and beside(poses).exists():
        predicted = read_prediction(poses)
    outcome = fitting.run(_gathered(session), _options_of(session), _fit_settings(session), say, predicted)
    # the session judges on unseen rows
    outcome = replace(outcome, assessment=replace(outcome.assessment, verdict=UNJUDGED, deliverables={}))
    draw = partial(write_fit, plots=session.plots, pages=False)
    outputs.write_folder(outcome, session.fit.path, draw, owned=True)

    metrics = session.fit.metrics()
    notes = [Note(f"model {metrics.model}: {error_words(metrics)}; {parameter_words(metrics)}")]
    notes += as_notes(outcome.warnings, outcome.assessment.noticed)
    for sentence in outlier_sentences(metrics):
        if outcome.selection.loss == "none":
            sentence += '; check these rows, or set loss = "cauchy" in session.toml'
        notes.append(Note(sentence))
    return notes


def validate(session: Session, say: Say) -> list[Note]:
    """Validate a session's fitted robot on held-out poses, and return notes for the user.

    The errors are computed as by `calib fit` with validation files.
    """
    chain, unseen = chain_of(session), session.brought("validation")
    metrics, report = session.fit.metrics(), fit_report.read(session.fit.report)
    # images are read with the lens and board of those of the fit
    like: Sequence[PoseMeasurements] = ()
    if any(path.is_dir() for path in unseen):
        like = _gathered(session).fit
    notes = notes_on(session, chain, read_measured(session, chain, unseen, like), folder.UNSEEN)

    say("comparing on unseen poses")
    findings = session.fit.findings()
    gathered = session.fit.driven(_gathered(session, unseen))
    options, fit_settings = _options_of(session), _fit_settings(session)
    weighing = fitting.weighing_settings(options, fit_settings)
    fit_settings = replace(fit_settings, model=fit_settings.model or options.model)
    arms = session.fit.arms(gathered, weighing)
    assessment = assess(arms, gathered, findings, weighing, fit_settings)
    rows = []
    for name, comparison in assessment.validation.items():
        rows.append(fit_report.rows_of(name, comparison, comparison.proves))
    validation_metrics = session.validation.write(assessment, gathered, rows)
    fit_report.write(report.with_unseen(validation_metrics, rows), session.validation.report)
    new_warnings = [warning for warning in assessment.warnings if warning not in metrics.warnings]
    notes += notes_of(_predicted_and_reached(session, assessment))
    return [*notes, Note(str(assessment.verdict)), *as_notes(new_warnings, assessment.noticed)]


def _predicted_and_reached(session: Session, assessment: Assessment) -> list[Finding]:
    """Return the findings that state the reached accuracy of the tool next to the predicted one.

    Args:
        session: the session, whose selection of poses contains the predicted σ of the tool's position.
        assessment: errors on held-out poses, whose rms is the reached accuracy.

    Returns:
        One finding for each set of held-out poses; an empty list without a prediction.
    """
    path = session.path(folder.SELECTION)
    if not session.settings.poses.plan or not path.exists():
        return []
    predicted = read_json(path, "repeat the step with `calib redo`", _PredictedTool).tool_sigma
    if predicted is None:
        return []
    findings = []
    for name, rows in assessment.validation.items():
        delivered = rows.of_urdf if assessment.deliverable == "urdf" else rows
        if rows.proves:
            reached = delivered.errors[1].rms
            findings.append(finding("tool-accuracy-reached", file=name, reached=reached, predicted=predicted))
    return findings


@dataclass(frozen=True)
class _PredictedTool:
    """The key of ``selection.json`` with the predicted σ of the tool's position [m]; None if it is not known."""

    tool_sigma: float | None = None


def export(session: Session, say: Say) -> list[str]:
    """Export the calibrated robot to all file formats, and write the verdicts on each file and on the session.

    Returns:
        Remarks for the user.
    """
    from calib.procedure.export.delivery import by_file, mark, prediction

    out = session.path(session.export)
    lines = _deliver(session, out, say)
    verdicts = session.verdicts()
    files_table = {}
    for name, file_verdicts in by_file(out, verdicts).items():
        if file_verdicts.level:
            files_table[name] = file_verdicts.table()
    predicted = prediction(out)
    table = {
        "schema": 1,
        **verdicts.table(),
        "deliverable": session.settings.fit.deliverable,
        "files": files_table,
        "exported_prediction": predicted and asdict(predicted),
    }
    files.write_json(session.path(folder.VERDICT), table)
    return [*mark(out, verdicts), *lines]


def _deliver(session: Session, out: Path, say: Say) -> list[str]:
    """Write the exported files of the session's stages, and return remarks for the user.

    If the dynamics cannot be exported, only the geometry is written.

    Args:
        session: the session.
        out: folder to write into.
        say: called with progress texts.
    """
    from calib.procedure.export.delivery import FILES, Export, deliver

    if not session.geometric:
        write_staged(out, [file.name for file in FILES], partial(shutil.copy, session.fit.robot))
    if not session.dynamic:
        return deliver(Export(session.robot_file, session.fit.path), out)
    say("physically consistent parameters")
    # earlier versions wrote a second robot.urdf
    for file in FILES:
        (out / "dynamics" / file.name).unlink(missing_ok=True)
    # not there, or not empty
    with suppress(OSError):
        (out / "dynamics").rmdir()
    fitted = session.fit.path if session.geometric else None
    robot = Export(session.robot_file, fitted, session.identification.path)
    try:
        return deliver(robot, out)
    except CalibError as error:
        # the geometry stands by itself
        lines = [calibrated.ROBOT]
        if session.geometric:
            lines = deliver(replace(robot, identified=None), out)
        return [*lines, f"the dynamics were not exported: {error}"]


def clear_staging(session: Session) -> None:
    """Remove temporary files of a killed command from a session's folder, but not those of a running upload."""
    for path in session.folder.rglob(".*.part"):
        if files.in_use(path):
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
