"""Steps of a session for the dynamics: design motions, check recordings, identify, validate on held-out motion.

The steps call the functions behind `calib excite` and `calib identify` with files in the session's folder.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NoReturn

import numpy as np

from calib import files
from calib.column_changes import Change
from calib.data.recordings.recording import Recording, parse_cut
from calib.data.recordings.recording_files import read_recording
from calib.dynamics.torque_rows import torque_rows
from calib.errors import CalibError, Finding, UsageError, command_line, finding, refuse_data, require
from calib.identification.checks.recorded_motion import (
    EDGE_TIME,
    DesignedMotion,
    LocatedMotion,
    another_motion,
    locate,
    share_of_nominal,
)
from calib.identification.identify_options import FileSettings, IdentifyOptions, read_options
from calib.procedure.dynamic_stage import identify as identifying
from calib.procedure.dynamic_stage import inputs
from calib.procedure.dynamic_stage.computed_torque import torque_tests
from calib.procedure.dynamic_stage.identify import DynamicsAssessment, assess
from calib.procedure.excitation import coefficients, prediction, stored_front
from calib.procedure.excitation.coefficients import Periodic
from calib.procedure.excitation.settings import ExcitationSettings
from calib.procedure.excitation.stored_front import StoredFront
from calib.procedure.findings import UNJUDGED, Note, Verdict, as_notes, lines_of
from calib.procedure.robot_kinds import joints_of
from calib.procedure.session.folder import CUTS, MOTION_CHECKED, ROUND, Say, Session
from calib.procedure.session.masses import return_masses
from calib.procedure.session.recording_names import labels_in
from calib.records import read_json
from calib.robot.chain import Chain
from calib.robot.library import load_calibrated

# start and end of the motion in recordings [s], by their names
Cuts = Mapping[str, tuple[float, float] | None]
# of the motion, explained by a recorded period; below it is noted
MIN_TRACKED_SHARE = 0.98
# a factor between measured and nominal torques that no wrong mass explains
MAX_TORQUE_RATIO = 10.0
# of the validation motion, over the training motion's (our choice)
VALIDATION_PERIOD = 0.8
# added to the seed for the validation motion
VALIDATION_SEED = 3
# evaluations of the search for the validation motion: at least, and as a fraction of the training motion's
VALIDATION_EVALUATIONS = 20
VALIDATION_FRACTION = 3


def options_of(session: Session) -> IdentifyOptions:
    """Return the identification options from the options file or ``session.toml``, with the payload of each recording.

    A recording carries the payloads whose labels are part of its file name.
    """
    section = session.settings.dynamics
    options = read_options(session.named(section.options))
    settings = options.settings
    if not section.options:
        rows = torque_rows(section.torques)
        settings = replace(settings, torque_rows=rows, friction=section.friction, method=section.method)
    if section.with_geometry:
        settings = replace(settings, with_geometry=True)
    payloads = dict(section.payloads) | dict(settings.payloads)
    settings = replace(settings, payloads=payloads, seed=session.settings.seed)
    by_file = dict(options.files)
    for path in session.brought("training", "unseen"):
        labels = labels_in(path.stem, payloads)
        if labels:
            default = FileSettings(options.every.recording, options.every.filter, columns=options.every.columns)
            by_file[path.name] = replace(by_file.get(path.name, default), payload=labels)
    return replace(options, settings=settings, files=by_file)


def unrecorded_payloads(session: Session) -> list[str]:
    """Return the labels of the session's payloads that no training recording carries."""
    if not session.settings.dynamics.payloads:
        return []
    try:
        options = options_of(session)
    except CalibError:
        # the step that reads the options says what is wrong with them
        return []
    carried = set()
    for path in session.brought("training"):
        carried.update(options.file_settings(str(path)).payload)
    return [label for label in session.settings.dynamics.payloads if label not in carried]


def excite(session: Session, say: Say) -> list[str | Note]:
    """Design the training motion and the validation motion of a session, and return notes.

    Args:
        session: the session.
        say: called with progress texts.
    """
    if not session.settings.dynamics.plan:
        return ["no motion was designed, since plan = false: the recordings may contain any motions"]
    return design_motions(session, say)


def design_motions(session: Session, say: Say, picked: StoredFront | None = None) -> list[str | Note]:
    """Design both motions of a session, and return notes.

    Args:
        session: the session.
        say: called with progress texts.
        picked: front whose designed motion is the training motion; None: search.
    """
    section = session.settings.dynamics
    notes = _design(session, "training", _training_settings(session), say, picked)
    if section.validation:
        notes += _design(session, "validation", _validation_settings(session), say)
    if session.named(section.limits) is None:
        notes.append("only the limits in the robot's file were checked: watch for collisions, or give a limits file")
    return notes


def _training_settings(session: Session) -> ExcitationSettings:
    """Return the settings for the design of the training motion, from ``session.toml``."""
    section = session.settings.dynamics
    return ExcitationSettings(
        period=section.period,
        harmonics=section.harmonics,
        rate=section.rate,
        starts=section.starts,
        evaluations=section.evaluations,
        seed=session.settings.seed,
        repeat=section.repeats,
        outlook=True,
        goals=section.goals,
        hard=section.hard,
        front=section.front,
        within="",
    )


def _validation_settings(session: Session) -> ExcitationSettings:
    """Return the settings for the design of a session's validation motion.

    The motion has another period and seed than the training motion, and stays within its range of positions, velocities
    and accelerations.
    """
    section = session.settings.dynamics
    return replace(
        _training_settings(session),
        period=section.period * VALIDATION_PERIOD,
        starts=1,
        evaluations=max(VALIDATION_EVALUATIONS, section.evaluations // VALIDATION_FRACTION),
        seed=session.settings.seed + VALIDATION_SEED,
        outlook=False,
        goals=(),
        hard=(),
        front=0,
        within=str(session.path("6-excitation/training")),
    )


def picked_front(session: Session, number: int) -> StoredFront:
    """Return the front of the session's training motion with motion `number`, from 1, as the designed one.

    Raises:
        UsageError: if the training motion has no front, or no such motion.
    """
    folder = session.path("6-excitation/training")
    message = f"{folder} has no front: write front = 5 and a torque goal under [dynamics] of session.toml"
    require((folder / stored_front.TABLE).is_file(), message, UsageError)
    return stored_front.read(folder).with_designed(number)


def _design(
    session: Session, name: str, settings: ExcitationSettings, say: Say, picked: StoredFront | None = None
) -> list[str | Note]:
    """Design a motion, write its folder, and return notes; only the training motion gets figures and details.

    Args:
        session: the session.
        name: name of the motion and of its folder in ``6-excitation``.
        settings: settings of the design.
        say: called with progress texts.
        picked: front with a stored motion that is taken instead of a search; None: search.
    """
    from calib.procedure.excitation import design
    from calib.procedure.excitation import folder as motion_folder

    def report_progress(words: str) -> None:
        say(f"{name} motion: {words}")

    designed = design.excite(
        session.fit.path,
        settings,
        limits=session.named(session.settings.dynamics.limits),
        options=options_of(session).settings,
        picked=picked,
        progress=report_progress,
    )
    # a session is resumed, not gone on with half a search
    if designed.interrupted:
        raise KeyboardInterrupt
    draw = None
    if session.plots and name == "training":
        from calib.procedure.report.outputs import write_design

        draw = partial(write_design, plots=session.plots)
    motion_folder.write_design(designed, session.path("6-excitation") / name, draw)

    condition, columns = designed.condition, len(designed.inputs.model.exact.names)
    notes: list[str | Note] = [
        f"{name}: {designed.period:g} s, condition number {condition.raw:.3g} raw, {condition.normalised:.3g} "
        f"normalised, {columns} columns; all limits are respected"
    ]
    if name == "training":
        notes += [Note(f"{name}: {goal_note}", is_warning=True) for goal_note in designed.goal_notes]
        if designed.front is not None:
            count = len(designed.front.values)
            choose = command_line("next", session.folder, "--pick", "N")
            table = session.path("6-excitation/training") / stored_front.TABLE
            notes.append(Note(f"{name}: {count} motions to choose from ({table}): {choose}", is_warning=True))
        for remark in (*designed.inputs.limits.bounds.lines(), *designed.notes):
            if remark not in designed.goal_notes:
                notes.append(f"{name}: {remark}")
    return notes


def record(session: Session, say: Say) -> list[str]:
    """Check the training recordings of a session, and return notes for the user."""
    cuts = {}
    notes = []
    for path in session.brought("training"):
        say(f"reading {path.name}")
        # the name of a further motion's log begins like its folder
        motion = "training"
        for name in designed_motions(session):
            if name.startswith(ROUND) and path in _logs_of(session, name):
                motion = name
        cuts[path.name], recording_notes = check_recording(session, path, motion)
        notes += recording_notes
    files.write_json(session.path(CUTS), cuts)
    files.write(session.path(MOTION_CHECKED), "\n".join(notes) + "\n")
    return notes


def check_recording(session: Session, path: Path, name: str) -> tuple[list[float] | None, list[str]]:
    """Return start and end of the designed motion in a recording [s], and notes for the user.

    The start and end are None if no designed motion is expected, so that the whole recording is used.

    Args:
        session: the session.
        path: path of the recording.
        name: name of the designed motion: ``training``, ``validation`` or ``round2`` …

    Raises:
        MeasurementError: for wrong units or joint order, another motion, or reversed torques.
    """
    chain = load_calibrated(session.fit.path).chain
    settings = options_of(session).file_settings(str(path))
    recording = read_recording(str(path), joints_of(chain), settings.recording)
    # as identification takes it
    rate = 1.0 / max(float(np.median(np.diff(recording.t))), 1e-9)
    sensors = ", and sensors behind the gears" if recording.tau_link is not None else ""
    notes = [f"{path.name}: {recording.duration:.1f} s at {rate:.4g} Hz, {recording.kind}s{sensors}"]
    notes += [f"{path.name}: {note}" for note in recording.notes]
    # the nominal masses hold no payload
    if not settings.payload:
        check_torques(recording, chain)

    motions = designed_motions(session)
    if name not in motions:
        if session.settings.dynamics.holdout:
            return [float(recording.t[0]), float(recording.t[-1])], notes
        return None, notes
    motion = motions.pop(name)
    located, findings = check_motion(recording, motion, motions, session.settings.dynamics.repeats)
    notes.append(
        f"{path.name}: the {name} motion, {located.periods} times, from {located.start:.2f} s ({EDGE_TIME:g} s before "
        f"it, for the filters); deviation up to {1e3 * max(located.tracking):.2g} mrad rms"
    )
    notes += [f"{path.name}: {note}" for note in lines_of(findings)]
    return [located.start, located.stop], notes


def check_motion(
    recording: Recording, motion: DesignedMotion, others: Mapping[str, DesignedMotion], repeats: int
) -> tuple[LocatedMotion, list[Finding]]:
    """Find the designed motion in a recording, and return its location with findings on how it was played.

    Args:
        recording: the recording.
        motion: the motion that should have been played.
        others: the session's other motions by name; if one of them was played instead, the error message names it.
        repeats: requested number of repetitions.

    Raises:
        MeasurementError: if the motion is not found; the message states the likely reason.
    """
    located = locate(recording, motion)
    if located is None:
        _refuse(recording, _other_motion(recording, motion, another_motion(recording, motion, others)))
    findings = []
    if located.periods < repeats:
        findings.append(finding("repetitions-missing", periods=located.periods, wanted=repeats))
    if located.likeness < MIN_TRACKED_SHARE:
        joint = recording.joint_names[located.loosest]
        findings.append(finding("tracking-loose", share=located.likeness, joint=joint))
    return located, findings


def _other_motion(recording: Recording, motion: DesignedMotion, change: Change | None) -> Finding:
    """Return a finding on why a recording does not contain the designed motion.

    Args:
        recording: the recording.
        motion: the designed motion.
        change: the change of units, joint order or signs, or the other motion, that explains the recording; None:
            unknown.
    """
    if change is None:
        if recording.duration < motion.period:
            return finding("motion-short", duration=recording.duration, period=motion.period)
        return finding("motion-unknown")
    names = recording.joint_names
    if change.code != "motion-altered":
        return finding(change.code, joints=[names[j] for j in change.joints], **change.values)

    factor, order, sign = change.values["unit"], change.values["order"], change.values["sign"]
    unit = ""
    if factor != 1.0:
        unit = "deg" if factor < 1.0 else "rad although the header says deg"
    swapped = []
    for j, column in enumerate(order):
        if column != j:
            swapped.append(f"the column of {names[column]} contains {names[j]}")
    reversed_joints = [names[j] for j, direction in enumerate(sign) if direction < 0]
    return finding(change.code, unit=unit, swapped=swapped, reversed=reversed_joints)


def check_torques(recording: Recording, chain: Chain) -> None:
    """Compare recorded torques with the gravity and inertia torques of the nominal masses.

    Args:
        recording: the recording.
        chain: the arm with its nominal masses.

    Raises:
        MeasurementError: if torques of heavily loaded joints have the opposite sign, or another magnitude.
    """
    if chain.inertias is None or recording.kind != "torque":
        return
    share = share_of_nominal(recording.t, recording.q, recording.effort, chain)
    loaded = np.flatnonzero(np.isfinite(share))
    if not len(loaded):
        return
    joints = [recording.joint_names[j] for j in loaded]
    size = np.abs(share[loaded])
    if (size > MAX_TORQUE_RATIO).all() or (size < 1 / MAX_TORQUE_RATIO).all():
        ratio = float(np.median(size))
        code = "torques-too-small" if ratio < 1 else "torques-too-large"
        _refuse(recording, finding(code, joints=joints, ratio=ratio))
    reversed_joints = [recording.joint_names[j] for j in loaded if share[j] < 0]
    if reversed_joints:
        code = "torques-reversed" if reversed_joints == joints else "torque-of-joint-reversed"
        _refuse(recording, finding(code, joints=reversed_joints))


def _refuse(recording: Recording, reason: Finding) -> NoReturn:
    refuse_data(recording.file, lines_of([reason])[0])


def designed_motions(session: Session) -> dict[str, Periodic]:
    """Return the designed motions in the session's folder: name -> motion; empty if no motion was designed."""
    if not session.settings.dynamics.plan:
        return {}
    folders = [session.path(f"6-excitation/{name}") for name in ("training", "validation")]
    folders += sorted(session.path("6-excitation").glob(f"{ROUND}[0-9]*"))
    return {folder.name: coefficients.read(folder) for folder in folders if folder.exists()}


def next_round(session: Session) -> str:
    """Return the name of a session's next further motion: round2, or round3 if a log of round2 exists, and so on."""
    number = 2
    while _logs_of(session, f"{ROUND}{number}"):
        number += 1
    return f"{ROUND}{number}"


def _logs_of(session: Session, name: str) -> list[Path]:
    """Return the training recordings of a session whose file names begin with `name`, that of a further motion."""
    return [path for path in session.brought("training") if path.stem.lower().startswith(name)]


def _cut_paths(paths: list[Path], cuts: Cuts) -> list[str]:
    """Return the recordings' paths with the time range of the motion appended, such as ``log.csv@0:9``.

    Args:
        paths: the recordings.
        cuts: file name -> start and end of the motion [s]; None: the whole recording.
    """
    ranges = []
    for path in paths:
        cut = cuts.get(path.name)
        if cut is None:
            ranges.append(str(path))
        else:
            start, stop = cut
            ranges.append(f"{path}@{start:.6g}:{stop:.6g}")
    return ranges


def _divided(session: Session) -> tuple[list[str], list[str]]:
    """Return a session's training recordings and the held-out parts of recordings.

    Both are paths with time ranges (``log.csv@0:9``).
    """
    cuts = read_json(session.path(CUTS), "calib redo recreates it", Cuts)
    share = session.settings.dynamics.holdout
    training = session.brought("training")
    if not share:
        return _cut_paths(training, cuts), []
    # the end of each recording is held out
    first_parts, last_parts = {}, {}
    for name, (start, stop) in cuts.items():
        middle = stop - share * (stop - start)
        first_parts[name] = start, middle
        last_parts[name] = middle, stop
    return _cut_paths(training, first_parts), _cut_paths(training, last_parts)


def _gathered(
    session: Session, training: Sequence[str], unseen: Sequence[str], say: Say
) -> inputs.IdentificationInputs:
    """Return the inputs of the identification: calibrated robot, training recordings, and held-out recordings.

    Args:
        session: the session.
        training, unseen: recordings as paths with time ranges.
        say: called with progress texts.
    """
    motions = designed_motions(session)
    options = options_of(session)
    # settings of recordings that are not read are refused
    session_files = {path.name for path in session.brought("training", "unseen")}
    used_files = {Path(parse_cut(recording)[0]).name for recording in (*training, *unseen)}
    unused = session_files - used_files
    by_file = {name: entry for name, entry in options.files.items() if Path(name).name not in unused}
    return inputs.gather(
        session.fit.path,
        training,
        unseen,
        options=replace(options, files=by_file),
        seed=session.settings.seed,
        designed=[motions["training"]] if "training" in motions else [],
        progress=say,
    )


def identify(session: Session, say: Say) -> list[str | Note]:
    """Identify a session's base parameters and friction on the calibrated geometry; held-out recordings are not used.

    Returns:
        Notes for the user.
    """
    from calib.procedure.dynamic_stage import folder as identification_outputs
    from calib.procedure.report.outputs import write_model

    training, _ = _divided(session)
    gathered = _gathered(session, training, (), say)
    # `predict` replays unseen motion, and judges
    outcome = identifying.run(replace(gathered, replayed=False), progress=say)
    outcome = replace(outcome, verdict=UNJUDGED)
    say("writing")
    write = partial(write_model, plots=session.plots, pages=False)
    identification_outputs.write_folder(outcome, session.identification.path, write, owned=True)

    identification = outcome.found
    raw, normalised = identification.condition
    friction = identification.friction.chosen or "standard"
    score = next(iter(outcome.fit.values()))
    notes: list[str | Note] = [
        f"{len(identification.names)} parameters by {identification.fitted.method}, friction {friction}, condition "
        f"number {raw:.3g}, with unit columns {normalised:.3g}; {score.judged.total:.2f} % of the torque unexplained"
    ]
    # the motion of the last round that was recorded
    last_round = f"{ROUND}{int(next_round(session).removeprefix(ROUND)) - 1}"
    motion = last_round if last_round in designed_motions(session) else "training"
    designed = session.path(f"6-excitation/{motion}")
    if session.settings.dynamics.plan and (designed / prediction.NAME).is_file():
        notes.append(prediction.compared_with_identification(designed, outcome))
    notes += return_masses(session)
    # `predict` judges on unseen motion
    later = lines_of([warning for warning in outcome.noticed if warning.code == "no-unseen-motion"])
    warnings = [warning for warning in outcome.warnings if warning not in later]
    notes += as_notes(warnings, outcome.noticed)
    return notes


def predict(session: Session, say: Say) -> list[str | Note]:
    """Validate a session's identified model on held-out motion, write the verdict, and return notes for the user."""
    from calib.procedure.report.outputs import write_recordings

    training, held_out = _divided(session)
    unseen = session.brought("unseen")
    notes = []
    cuts = {}
    for path in unseen:
        cuts[path.name], recording_notes = check_recording(session, path, "validation")
        notes += recording_notes  # ty: ignore[unsupported-operator]
    say("predicting unseen motion")
    gathered = _gathered(session, training, [*held_out, *_cut_paths(unseen, cuts)], say)
    folder = session.identification
    assessment = assess(gathered, folder.dynamics(), folder.findings(), folder.errors(), progress=say)
    # the export is judged by the torques written here
    folder.unseen.write(gathered, assessment)
    assessment = replace(assessment, verdict=_as_delivered(session, gathered, assessment))
    folder.unseen.write(gathered, assessment)
    if session.plots:
        write_recordings(gathered, assessment, folder.unseen)
    earlier = folder.metrics().warnings
    new_warnings = [warning for warning in assessment.warnings if warning not in earlier]
    carried = {label for case in gathered.unseen for label in case.carried}
    for label in session.settings.dynamics.payloads:
        if unseen and label not in carried:
            notes.append(Note(f"payload '{label}' is in no validation recording: its model is not validated", True))
    return [*notes, str(assessment.verdict), *as_notes(new_warnings, assessment.noticed)]


def _as_delivered(session: Session, gathered: inputs.IdentificationInputs, assessment: DynamicsAssessment) -> Verdict:
    """Return the verdict on the exported robot; for a model that cannot be exported, pass becomes prediction only.

    The verdict is fail if the torque error exceeds the tolerance in ``session.toml``.

    Args:
        session: the session, with the tolerance.
        assessment: errors of the exported robot's model on the recordings, and the verdict.
    """
    from calib.procedure.export.delivery import Export

    verdict = assessment.verdict
    exported = Export(session.robot_file, identified=session.identification.path)
    errors = [score.counted(score.floor_dominates).total for score in assessment.proofs.values()]
    error, model = max(errors, default=0.0), "identified model"
    predicted = None
    try:
        # a URDF that cannot be written is refused here
        predicted = exported.with_masses and exported.prediction
    except CalibError as reason:
        verdict = verdict.for_prediction(f"the dynamics cannot be exported: {reason}")
    if predicted:
        error, model = predicted.compared, "exported robot"
        figure = f"{predicted.exported:.2f} % of the torque unexplained by the exported robot"
        verdict = replace(verdict, reason=f"{figure} (identified model: {verdict.reason})")
    elif verdict.level == "pass" and assessment.proofs:
        # recordings with payloads test the identified model alone
        words = "the exported robot is not tested: no unseen recording is without payload"
        verdict = Verdict("marginal", f"{words}; {verdict.reason}")
    section = session.settings.dynamics
    excesses = []
    if section.tolerance_percent and error > section.tolerance_percent:
        excesses.append(
            f"the {model} has an error of {error:.2f} %, above the tolerance of {section.tolerance_percent:g} %"
        )
    rows = gathered.options.settings.torque_rows.titles(gathered.chain.joint_names)
    tests = torque_tests(section.tolerance_torque, assessment.proofs, rows, len(gathered.chain.joints))
    failed = ", ".join(str(test) for test in tests if test.passed is False)
    if failed:
        excesses.append(f"rms torque errors [N m or N] of the identified model above tolerance: {failed}")
    if not excesses:
        return verdict
    return Verdict("fail", "; ".join([verdict.reason, *excesses]))
