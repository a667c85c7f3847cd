"""Identify a parallel robot from encoders and motor torques: rows on its platform, its actuators, or their power."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.data.recordings.recording import Joints, Recording
from calib.dynamics.regressor_model import RegressorModel
from calib.errors import MeasurementError, UsageError
from calib.identification.cases import Case, case_names, make_case
from calib.identification.identify import Identification, identify_model
from calib.identification.identify_options import IdentifyOptions, file_settings
from calib.identification.methods.registry import method_named
from calib.identification.prediction import predict
from calib.identification.scores import Score, score
from calib.identification.settings import IdentificationSettings, per_joint
from calib.mechanism.closure import NoPosture
from calib.mechanism.parallel_model import ParallelModel, make_parallel_model, rows_named
from calib.mechanism.parallel_robot import ParallelRobot
from calib.procedure.dynamic_stage.inputs import read_motion
from calib.procedure.parallel_stage.robots import FoundRobot

_NOT_YET = {
    "couplings": "[[coupling]]", "terms": "[[term]]", "loop": "[loop]", "gravity": "gravity",
    "payload_values": "known payloads",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class ParallelOutcome:
    """What an identification of a parallel robot came to.

    Attributes:
        robot: with its file.
        model: what was identified.
        found: the model with numbers, estimate and elimination.
        cases, unseen: recordings learnt from, and others.
        fit, validation: case name → score.
        notes: what a user should know.
    """

    robot: FoundRobot
    model: ParallelModel
    found: Identification[RegressorModel]
    cases: tuple[Case, ...]
    unseen: tuple[Case, ...]
    fit: Mapping[str, Score]
    validation: Mapping[str, Score]
    notes: tuple[str, ...]


def joints_of(robot: ParallelRobot) -> Joints:
    """Return what a recording of a parallel robot is held against: its actuated joints."""
    joints = robot.joints
    return Joints(
        robot.joint_names, tuple(joint.kind for joint in joints),
        *(np.array([getattr(joint, key) for joint in joints]) for key in ("lower", "upper", "velocity", "effort")),
    )  # fmt: skip


def identify_parallel(
    robot: FoundRobot,
    recordings: Sequence[str | Path | Recording],
    validate: Sequence[str | Path | Recording] = (),
    *,
    options: IdentifyOptions | None = None,
    method: str | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> ParallelOutcome:
    """Identify the dynamics of a parallel robot from recordings of its actuated joints.

    Args:
        recordings, validate: files with a cut if wanted, or recordings in memory.
        options: filters, payloads, drives, method; ``rows``: motor (on the platform's coordinates where actuators are
            redundant) or power.
        method: in place of the options'.

    Raises:
        UsageError: for options that only serial arms know.
        MeasurementError: for recordings that cannot be right.
    """
    say, options = progress or (lambda words: None), options or IdentifyOptions()
    settings = replace(options.settings, seed=seed, **({} if method is None else {"method": method}))
    _refuse(settings, options)
    known = robot.known
    wanted = settings.torque_rows.name
    rows = rows_named(known, "" if wanted == "motor" else wanted)
    model = make_parallel_model(
        known, settings.sets, per_joint(settings.v0, 1, "v0")[0], rows, tuple(settings.payloads)
    )
    given = [*recordings, *validate]
    names = case_names([str(each.file if isinstance(each, Recording) else each) for each in given])
    cases: list[Case] = []
    for name, each in zip(names, given):
        say(f"reading {name}")
        own = file_settings(options, str(each.file if isinstance(each, Recording) else each))
        like = cases[0].motion if len(cases) >= len(recordings) else None
        motion = read_motion(each, joints_of(known.robot), own, like)
        gains = None if own.gains is None else np.array(per_joint(own.gains, model.n, "gains"))
        if motion.kind == "current" and gains is None and motion.drive_gain is None:
            raise UsageError(f"{name}: currents without drive gains; state gains = [...] (N m/A) in the options file")
        gains = motion.drive_gain if gains is None and motion.kind == "current" else gains
        try:
            cases.append(make_case(name, motion, rows, gains=gains, carried=own.payload))
        except NoPosture as error:
            raise MeasurementError(f"{error}", name) from error
    learnt, unseen = tuple(cases[: len(recordings)]), tuple(cases[len(recordings) :])
    settings = replace(settings, torque_rows=rows, prior="none")
    found = identify_model(model, learnt, settings, progress=progress)
    scores = {case.name: score(case, predict(found.dynamics, case)) for case in cases}
    return ParallelOutcome(
        robot, model, found, learnt, unseen, {case.name: scores[case.name] for case in learnt},
        {case.name: scores[case.name] for case in unseen}, tuple(_notes(model, learnt)),
    )  # fmt: skip


def _refuse(settings: IdentificationSettings, options: IdentifyOptions) -> None:
    """Refuse what the identification of serial arms knows and this one does not."""
    plain = IdentificationSettings()
    for key, text in _NOT_YET.items():
        if getattr(settings, key) != getattr(plain, key):
            raise UsageError(f"{options.source or 'options'}: {text} is for serial arms yet, not for parallel robots")
    if options.gain_pair is not None or options.cut_slow:
        raise UsageError(f"{options.source}: [gain_identification] and cut_slow are for serial arms yet")
    if settings.friction not in ("auto", "standard"):
        raise UsageError(f"friction = '{settings.friction}': a parallel robot has standard friction only (Fv Fc off)")
    if settings.prior == "cad":
        raise UsageError('prior = "cad" is for serial arms yet, not for parallel robots')
    method = method_named(settings.method)
    if method.needs_simulation or method.name == "ml":
        what = "simulates" if method.needs_simulation else "differentiates the torques of"
        raise UsageError(f"method '{method.name}' {what} a serial arm; parallel robots take ols, wls, irls, tls")


def _notes(model: ParallelModel, cases: Sequence[Case]) -> list[str]:
    """Return what payloads and redundancy ask to be said."""
    robot, notes = model.known.robot, []
    for label in model.payloads:
        on = sum(label in case.carried for case in cases)
        if on == 0:
            notes.append(f"payload '{label}' is on board of no recording to learn from: nothing is known of it")
        elif on == len(cases):
            notes.append(
                f"payload '{label}' is on board of every recording: its parameters are regrouped with the platform's; "
                "a run without it tells them apart"
            )
    if robot.redundant:
        notes.append(
            f"{robot.n} actuators for {robot.r} freedoms: torques were projected on the platform's coordinates, the "
            "overconstraint takes no part"
        )
    return notes
