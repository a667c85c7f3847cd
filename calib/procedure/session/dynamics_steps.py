"""Steps of a session for the dynamics: design motions, check recordings, identify, validate on unseen motion.

The same functions as `calib excite` and `calib identify`; only the files are the session's.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NoReturn

import numpy as np

from calib import files
from calib.column_changes import Change
from calib.data.recordings.recording import Recording
from calib.data.recordings.recording_files import read_recording
from calib.dynamics.torque_rows import torque_rows
from calib.errors import CalibError, Finding, finding, refuse_data
from calib.identification.checks.recorded_motion import (
    EDGE_TIME,
    DesignedMotion,
    LocatedMotion,
    another_motion,
    locate,
    share_of_nominal,
)
from calib.identification.identify_options import FileSettings, IdentifyOptions, read_options
from calib.identification.settings import Payload
from calib.procedure.dynamic_stage import identify as identifying
from calib.procedure.dynamic_stage import inputs
from calib.procedure.dynamic_stage.identify import Assessment, assess
from calib.procedure.excitation import coefficients, prediction
from calib.procedure.excitation.coefficients import Periodic
from calib.procedure.findings import UNJUDGED, Verdict, lines_of
from calib.procedure.robot_kinds import joints_of
from calib.procedure.session.folder import CUTS, MOTION_CHECKED, ROUND, Say, Session
from calib.procedure.session.masses import return_masses
from calib.records import read_json
from calib.robot.chain import Chain
from calib.robot.library import load_calibrated

Cuts = Mapping[str, tuple[float, float] | None]  # of recordings, by their names [s]
MIN_TRACKED_SHARE = 0.98  # of the motion, explained by a recorded period; below it is noted
MAX_TORQUE_RATIO = 10.0  # a factor between measured and nominal torques that no wrong mass explains
VALIDATION_PERIOD = 0.8  # of the validation motion, over the training motion's (our choice)
VALIDATION_SEED = 3  # added to the seed for the validation motion


def options_of(session: Session) -> IdentifyOptions:
    """Return the identification options from the options file or ``session.toml``, with each recording's payloads."""
    section = session.settings.dynamics
    options = read_options(session.named(section.options))
    settings = options.settings
    if not section.options:
        rows = torque_rows(section.torques)
        settings = replace(settings, torque_rows=rows, friction=section.friction, method=section.method)
    known = {label: Payload(float(mass)) for label, mass in section.payloads.items()}
    settings = replace(settings, payloads={**known, **settings.payloads}, seed=session.settings.seed)
    named = dict(options.files)
    for path in session.brought("training", "unseen"):
        labels = tuple(label for label in known if label.lower() in path.stem.lower())
        if labels:
            named[path.name] = replace(
                named.get(path.name, FileSettings(options.every.recording, options.every.filter)), payload=labels
            )
    return replace(options, settings=settings, files=named)


def excite(session: Session, say: Say) -> list[str]:
    """Design the training motion and the validation motion, and return notes."""
    from calib.procedure.excitation import design
    from calib.procedure.excitation import folder as motion_folder
    from calib.procedure.excitation.settings import ExcitationSettings

    section, notes, draw = session.settings.dynamics, [], None
    if not section.plan:
        return ["no motion was designed, since plan = false: the recordings may contain any motions"]
    if session.plots:
        from calib.procedure.report.motion_figures import write_design as draw
    limits = session.named(section.limits)
    names = ["training", "validation"] if section.validation else ["training"]
    for name in names:
        first = name == "training"
        settings = ExcitationSettings(
            period=section.period * (1.0 if first else VALIDATION_PERIOD),
            harmonics=section.harmonics,
            rate=section.rate,
            starts=section.starts if first else 1,
            evaluations=section.evaluations if first else max(20, section.evaluations // 3),
            seed=session.settings.seed + (0 if first else VALIDATION_SEED),
            repeat=section.repeats,
            outlook=first,
            goals=section.goals if first else (),
            hard=section.hard if first else (),
            front=section.front if first else 0,
            within="" if first else str(session.path("6-excitation/training")),
        )
        designed = design.excite(
            session.fit.path,
            settings,
            limits=limits,
            options=options_of(session).settings,
            progress=lambda words, name=name: say(f"{name} motion: {words}"),
        )
        if designed.found.interrupted:  # a session is resumed, not gone on with half a search
            raise KeyboardInterrupt
        motion_folder.write_design(designed, session.path("6-excitation") / name, draw if first else None)
        cond = designed.condition
        notes.append(
            f"{name}: {designed.period:g} s, condition number {cond.raw:.3g} raw, {cond.normalised:.3g} "
            f"normalised, {len(designed.inputs.model.exact.names)} columns; all limits are respected"
        )
        said = (*designed.inputs.limits.bounds.lines(), *designed.notes)
        notes += [f"{name}: {note}" for note in said if first]
    if limits is None:
        notes.append("only the limits in the robot's file were checked: watch for collisions, or give a limits file")
    return notes


def record(session: Session, say: Say) -> list[str]:
    """Check the training recordings, and return notes."""
    cuts, notes = {}, []
    for path in session.brought("training"):
        say(f"reading {path.name}")
        rounds = [
            name for name in designed_motions(session) if name.startswith(ROUND) and path in _logs_of(session, name)
        ]
        found, said = check_recording(session, path, ["training", *rounds][-1])
        cuts[path.name] = found
        notes += said
    files.write_json(session.path(CUTS), cuts)
    files.write(session.path(MOTION_CHECKED), "\n".join(notes) + "\n")
    return notes


def check_recording(session: Session, path: Path, name: str) -> tuple[list[float] | None, list[str]]:
    """Return start and end of the designed motion in a recording [s] (None: use the whole recording), and notes.

    Raises:
        MeasurementError: for wrong units or joint order, another motion, or reversed torques.
    """
    chain, options = load_calibrated(session.fit.path).chain, options_of(session)
    own = options.file_settings(str(path))
    recording = read_recording(str(path), joints_of(chain), own.recording)
    rate = 1.0 / max(float(np.median(np.diff(recording.t))), 1e-9)  # as identification takes it
    sensors = ", and sensors behind the gears" if recording.tau_link is not None else ""
    notes = [f"{path.name}: {recording.duration:.1f} s at {rate:.4g} Hz, {recording.kind}s{sensors}"]
    notes += [f"{path.name}: {note}" for note in recording.notes]
    if not own.payload:  # the nominal masses hold no payload
        check_torques(recording, chain)
    motions = designed_motions(session)
    if name not in motions:
        whole = [float(recording.t[0]), float(recording.t[-1])]
        return whole if session.settings.dynamics.holdout else None, notes
    others = {other: motion for other, motion in motions.items() if other != name}
    found, loose = check_motion(recording, motions[name], others, session.settings.dynamics.repeats)
    worst = max(found.tracking)
    notes.append(
        f"{path.name}: the {name} motion, {found.periods} times, from {found.start:.2f} s ({EDGE_TIME:g} s before it, "
        f"for the filters); deviation up to {1e3 * worst:.2g} mrad rms"
    )
    return [found.start, found.stop], notes + [f"{path.name}: {note}" for note in lines_of(loose)]


def check_motion(
    recording: Recording, motion: DesignedMotion, others: Mapping[str, DesignedMotion], repeats: int
) -> tuple[LocatedMotion, list[Finding]]:
    """Find the designed motion in a recording, and return its location and findings.

    Args:
        recording: of n joints.
        motion: the one that was to be played.
        others: the session's other motions by name, to say if one of them was played instead.
        repeats: how many repetitions were asked for.

    Raises:
        MeasurementError: if the motion is not found, with the likely reason.
    """
    found = locate(recording, motion)
    if found is None:
        _refuse(recording, _other_motion(recording, motion, another_motion(recording, motion, others)))
    notes = []
    if found.periods < repeats:
        notes.append(finding("repetitions-missing", periods=found.periods, wanted=repeats))
    if found.likeness < MIN_TRACKED_SHARE:
        joint = recording.joint_names[found.loosest]
        notes.append(finding("tracking-loose", share=found.likeness, joint=joint))
    return found, notes


def _other_motion(recording: Recording, motion: DesignedMotion, found: Change | None) -> Finding:
    """Return the finding on what a recording contains instead of the designed motion."""
    if found is None and recording.duration < motion.period:
        return finding("motion-short", duration=recording.duration, period=motion.period)
    if found is None:
        return finding("motion-unknown")
    names = recording.joint_names
    if found.code != "motion-altered":
        return finding(found.code, joints=[names[j] for j in found.joints], **found.values)
    unit, order, sign = (found.values[key] for key in ("unit", "order", "sign"))
    moved = [(names[column], names[j]) for j, column in enumerate(order) if column != j]
    return finding(
        found.code,
        unit="" if unit == 1.0 else "deg" if unit < 1.0 else "rad although the header says deg",
        swapped=[f"the column of {column} contains {joint}" for column, joint in moved],
        reversed=[names[j] for j, one in enumerate(sign) if one < 0],
    )


def check_torques(recording: Recording, chain: Chain) -> None:
    """Raise an error if recorded torques have the wrong sign or unit, compared with torques of the nominal masses.

    Raises:
        MeasurementError: if torques of heavily loaded joints are reversed, or of another magnitude.
    """
    if chain.inertias is None or recording.kind != "torque":
        return
    share = share_of_nominal(recording.t, recording.q, recording.effort, chain)
    sure = np.flatnonzero(np.isfinite(share))
    if not len(sure):
        return
    joints, size = [recording.joint_names[j] for j in sure], np.abs(share[sure])
    if (size > MAX_TORQUE_RATIO).all() or (size < 1 / MAX_TORQUE_RATIO).all():
        ratio = float(np.median(size))
        code = "torques-too-small" if ratio < 1 else "torques-too-large"
        _refuse(recording, finding(code, joints=joints, ratio=ratio))
    turned = [recording.joint_names[j] for j in sure if share[j] < 0]
    if turned:
        _refuse(
            recording, finding("torques-reversed" if turned == joints else "torque-of-joint-reversed", joints=turned)
        )


def _refuse(recording: Recording, found: Finding) -> NoReturn:
    refuse_data(recording.file, lines_of([found])[0])


def designed_motions(session: Session) -> dict[str, Periodic]:
    """Return the session's designed motions by name; empty if no motion was designed."""
    if not session.settings.dynamics.plan:
        return {}
    folders = [session.path(f"6-excitation/{name}") for name in ("training", "validation")]
    folders += sorted(session.path("6-excitation").glob(f"{ROUND}[0-9]*"))
    return {folder.name: coefficients.read(folder) for folder in folders if folder.exists()}


def next_round(session: Session) -> str:
    """Return the name of the round after those whose logs are there: round2, round3 …"""
    number = 2
    while _logs_of(session, f"{ROUND}{number}"):
        number += 1
    return f"{ROUND}{number}"


def _logs_of(session: Session, name: str) -> list[Path]:
    """Return the training recordings whose names begin with that of a further motion."""
    return [path for path in session.brought("training") if path.stem.lower().startswith(name)]


def _cut_paths(paths: list[Path], cuts: Cuts) -> list[str]:
    """Return each recording's path with the time range of the motion appended, as ``log.csv@0:9``."""
    marked = {path: cuts.get(path.name) for path in paths}
    return [str(path) if cut is None else f"{path}@{cut[0]:.6g}:{cut[1]:.6g}" for path, cut in marked.items()]


def _divided(session: Session) -> tuple[list[str], list[str]]:
    """Return training recordings and held-out recordings, as paths with time ranges (``log.csv@0:9``)."""
    cuts = read_json(session.path(CUTS), "calib redo recreates it", Cuts)
    share = session.settings.dynamics.holdout
    training = session.brought("training")
    if not share:
        return _cut_paths(training, cuts), []
    middle = {name: stop - share * (stop - start) for name, (start, stop) in cuts.items()}
    learnt = {name: (start, middle[name]) for name, (start, _) in cuts.items()}
    held = {name: (middle[name], stop) for name, (_, stop) in cuts.items()}
    return _cut_paths(training, learnt), _cut_paths(training, held)


def _gathered(
    session: Session, training: Sequence[str], unseen: Sequence[str], say: Say
) -> inputs.IdentificationInputs:
    """Return the inputs of the identification: calibrated robot, training recordings, validation recordings."""
    options, seed = options_of(session), session.settings.seed
    designed = [motion for name, motion in designed_motions(session).items() if name == "training"]
    return inputs.gather(
        session.fit.path, training, unseen, options=options, seed=seed, designed=designed, progress=say
    )


def identify(session: Session, say: Say) -> list[str]:
    """Identify base parameters and friction on the calibrated geometry; validation files are not used."""
    from calib.procedure.dynamic_stage import folder as identification_outputs
    from calib.procedure.report.outputs import write_model

    given = _gathered(session, _divided(session)[0], (), say)
    outcome = identifying.run(replace(given, replayed=False), progress=say)  # `predict` replays unseen motion
    outcome = replace(outcome, verdict=UNJUDGED)
    say("writing")
    write = partial(write_model, plots=session.plots, pages=False)
    identification_outputs.write_folder(outcome, session.identification.path, write, owned=True)
    found = outcome.found
    raw, normalised = found.condition
    fitted = next(iter(outcome.fit.values()))
    notes = [
        f"{len(found.names)} parameters by {found.fitted.method}, friction {found.friction.chosen or 'standard'}, "
        "condition "
        f"number {raw:.3g}, with unit columns {normalised:.3g}; {fitted.judged.total:.2f} % of the torque unexplained"
    ]
    before = f"{ROUND}{int(next_round(session).removeprefix(ROUND)) - 1}"
    designed = session.path(f"6-excitation/{before if before in designed_motions(session) else 'training'}")
    if session.settings.dynamics.plan and (designed / prediction.NAME).is_file():
        notes.append(prediction.compared_with_identification(designed, outcome))
    notes += return_masses(session)
    later = lines_of([one for one in outcome.noticed if one.code == "no-unseen-motion"])  # `predict` judges
    return [*notes, *(words for words in outcome.warnings if words not in later)]


def predict(session: Session, say: Say) -> list[str]:
    """Validate the identified model on unseen motion, and write the verdict."""
    training, held = _divided(session)
    unseen = session.brought("unseen")
    notes, aside = [], {}
    for path in unseen:
        aside[path.name], said = check_recording(session, path, "validation")
        notes += said
    say("predicting unseen motion")
    given = _gathered(session, training, [*held, *_cut_paths(unseen, aside)], say)
    place = session.identification
    found = assess(given, place.dynamics(), place.findings(), place.errors(), progress=say)
    place.unseen.write(given, found)  # the export is judged by the torques written here
    found = replace(found, verdict=_as_delivered(session, found))
    place.unseen.write(given, found)
    known = place.metrics().warnings
    fresh = [words for words in found.warnings if words not in known]
    return [*notes, str(found.verdict), *fresh]


def _as_delivered(session: Session, found: Assessment) -> Verdict:
    """Return the verdict on the exported robot; a model that cannot be exported gets the verdict prediction only."""
    from calib.procedure.export.delivery import Export

    verdict, known = found.verdict, None
    exported = Export(session.robot_file, identified=session.identification.path)
    try:
        known = exported.with_masses and exported.prediction
    except CalibError as error:
        verdict = verdict.for_prediction(f"the dynamics cannot be exported: {error}")
    left, what = max((one.judged.total for one in found.proofs.values()), default=0.0), "identified model"
    if known is not None:
        left, what = known.exported, "exported robot"
        figure = f"{left:.2f} % of the torque unexplained by the exported robot"
        verdict = replace(verdict, reason=f"{figure} (identified model: {verdict.reason})")
    tolerance = session.settings.dynamics.tolerance_percent
    if not tolerance or left <= tolerance:
        return verdict
    why = f"the {what} has an error of {left:.2f} %, above the tolerance of {tolerance:g} %"
    return Verdict("fail", f"{verdict.reason}; {why}")
