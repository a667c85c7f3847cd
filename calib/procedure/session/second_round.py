"""A further motion for joints or parameters that do not meet the accuracy requested in ``session.toml``.

Requests are ``tolerance_percent``, for the torques on held-out motion, and ``sigma_percent``, for the σ of essential
parameters. The further motion is designed after the identification, into ``6-excitation/round2`` (``round3`` after
round2 was recorded …). A log whose name begins with the folder's name is used in the identification together with all
other logs. If the session requests no accuracy, its last messages name the joints whose torque error, and the essential
parameters whose σ, is above `NEED`, and how to request a further motion.

More motion reduces only the part of a joint's torque error that is due to the parameters' σ. From an error e with the
parts s before and s' after the motion, √(e² - s² + s'²) remains. If even s' = 0 would gain less than `MIN_GAIN`, more
motion does not help, since the remaining error is an effect that is not modelled.
"""

from dataclasses import replace
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from calib.errors import CalibError, command_line, listing
from calib.folders import ESTIMATE, REPORT, read_estimate
from calib.procedure.excitation import design, prediction
from calib.procedure.excitation import folder as motion_folder
from calib.procedure.excitation.coefficients import RUN, SAMPLES
from calib.procedure.excitation.inputs import ExcitationInputs, read_inputs
from calib.procedure.excitation.settings import ExcitationSettings
from calib.procedure.findings import limit
from calib.procedure.session.dynamics_steps import next_round, options_of
from calib.procedure.session.folder import ROUND, Say, Session, read_state
from calib.procedure.session.recording_names import log_name
from calib.procedure.session.steps import (
    FITTED_ROBOT,
    IDENTIFY_OPTIONS,
    NamedFile,
    SessionFile,
    SessionStep,
    StepSetting,
)
from calib.robot.library import load_calibrated

# [%] of torques and σ, where none is stated
NEED = limit("torque-unexplained", "share", "marginal")
# of a joint's error: a smaller gain is no reason to record more (our choice)
MIN_GAIN = 0.02


class _Parameter(NamedTuple):
    name: str
    rsd: float | None
    essential: float | None


class _ShortParameter(NamedTuple):
    """A joint whose torque error is larger than requested.

    Attributes:
        joint: index of the joint.
        error: torque error on held-out motion [%].
        size: rms of the torque [N m or N].
    """

    joint: int
    error: float
    size: float

    def left(self, before: np.ndarray, after: np.ndarray) -> float:
        """Return the torque error [%] that remains after a further motion.

        Args:
            before, after: (n,) σ of the torques due to the parameters' σ, before and after the further motion [N m or
                N].
        """
        then = 100.0 * before[self.joint] / self.size
        after_percent = 100.0 * after[self.joint] / self.size
        return float(np.sqrt(max(self.error**2 - then**2 + after_percent**2, 0.0)))


def extend(session: Session, say: Say) -> list[str]:
    """Design a further motion if joints or parameters of a session do not meet the requested accuracy.

    Args:
        session: the session.
        say: called with progress texts.

    Returns:
        Notes on the predicted benefit.
    """
    section = session.settings.dynamics
    identification = session.identification
    round_name = next_round(session)
    short = _short_joints(session, section.tolerance_percent)
    weak = _weak_parameters(session, section.sigma_percent or np.inf)
    if not short and not weak:
        return ["no further motion is needed: joints and parameters are as asked for"]
    payloads = tuple(options_of(session).settings.payloads)
    loads: tuple[str, ...] = ()
    if payloads:
        loads = ("none", *payloads)
    settings = ExcitationSettings(
        period=section.period,
        harmonics=section.harmonics,
        rate=section.rate,
        starts=section.starts,
        evaluations=section.evaluations,
        repeat=section.repeats,
        outlook=False,
        columns=weak,
        seed=session.settings.seed + int(round_name.removeprefix(ROUND)),
        loads=loads,
    )
    try:
        limits = session.named(section.limits)
        inputs = read_inputs(session.fit.path, settings, limits=limits, after=identification.path)
        task = prediction.task_of(inputs, settings.seed)
        before = prediction.known_sigmas(inputs, task)[0][0]
        helped: list[_ShortParameter] = []
        unmodelled: list[_ShortParameter] = []
        for joint in short:
            # The error that would remain if the parameters were known exactly.
            remaining = joint.left(before, 0.0 * before)
            if remaining < (1.0 - MIN_GAIN) * joint.error:
                helped.append(joint)
            else:
                unmodelled.append(joint)
        notes = _unmodelled(inputs, unmodelled)
        if not helped and not weak:
            return notes
        aim = "parameters" if weak else "torque"
        designed = design.search_motion(inputs, replace(settings, goals=(aim,)), progress=say)
    except (CalibError, ValueError) as error:
        return [f"joints or parameters fall short, but no further motion could be designed: {error}"]
    if designed.interrupted:
        raise KeyboardInterrupt
    motion_folder.write_design(designed, session.path(f"6-excitation/{round_name}"))
    aimed = designed.inputs.columns.aimed_names if weak else ()
    return [*_gains(designed, helped, aimed), *notes]


def _short_joints(session: Session, tolerance: float) -> list[_ShortParameter]:
    """Return the joints whose motor torque error exceeds the tolerance [%] on the worst recording.

    Empty if the error of all torques together is within the tolerance.

    Args:
        session: the session with its identification.
        tolerance: largest accepted torque error of a joint [%].
    """
    report = session.identification.unseen.read()
    recordings = (report.proofs or report.fit).values()
    errors_in_motion = [recording.counted(recording.floor_dominates) for recording in recordings]
    worst = max(errors_in_motion, key=attrgetter("total"))
    if not tolerance or worst.total <= tolerance:
        return []
    n = session.identification.dynamics().model.n
    # the motors' rows come last
    errors = worst.relative_error_percent.joints[-n:]
    rms = worst.rms[-n:]
    sizes = (100.0 * rms / errors).tolist()
    short = []
    for joint, (error, size) in enumerate(zip(errors.tolist(), sizes)):
        if error > tolerance:
            short.append(_ShortParameter(joint, error, size))
    return short


def _weak_parameters(session: Session, tolerance: float) -> tuple[str, ...]:
    """Return the names of essential parameters whose relative σ [%] exceeds the tolerance.

    Parameters that the design of a motion cannot take into account are excluded.

    Args:
        session: the session with its identification.
        tolerance: largest accepted standard deviation [%] of the parameter's value.
    """
    identification = session.identification
    without = {column.name for column in identification.dynamics().model.columns if not column.form.slopes}
    weak = []
    for row in read_estimate(identification.path, _Parameter):
        uncertain = row.essential is not None and (row.rsd or 0.0) > tolerance
        if uncertain and row.name not in without:
            weak.append(row.name)
    return tuple(weak)


def _unmodelled(inputs: ExcitationInputs, joints: list[_ShortParameter]) -> list[str]:
    """Return a note on the joints whose torque error more motion does not reduce; an empty list without such joints.

    Args:
        inputs: robot and model.
        joints: joints with too large torque errors.
    """
    if not joints:
        return []
    names = listing(f"{inputs.chain.joint_names[joint.joint]} {joint.error:.2g} %" for joint in joints)
    return [f"more motion does not reduce the torque errors of {names}: they are unmodelled effects"]


def _gains(designed: design.Designed, joints: list[_ShortParameter], parameters: tuple[str, ...]) -> list[str]:
    """Return a note on the improvement of joints and parameters that is predicted for a designed motion.

    Args:
        designed: the designed motion.
        joints: joints with too large torque errors.
        parameters: names of parameters with too large σ.
    """
    outlook = designed.outlook
    names = designed.inputs.chain.joint_names
    rows = sorted(designed.predicted, key=lambda prediction: -(prediction.rsd or 0.0))
    seconds = designed.playback.run.duration
    if outlook is None or outlook.torque_sigma_before is None:
        return []
    errors = (outlook.torque_sigma_before, outlook.own.torque_sigma)
    parts = []
    for joint in joints:
        after = joint.left(*errors)
        parts.append(f"torque error of {names[joint.joint]} from {joint.error:.2g} to {after:.2g} %")
    for row in rows:
        if row.name in parameters and row.value and row.sigma_before and row.rsd is not None:
            before = 100.0 * row.sigma_before / abs(row.value)
            parts.append(f"σ of {row.name} from {before:.2g} to {row.rsd:.2g} %")
    changes = f"a further motion of {seconds:.0f} s, designed for this, is expected to change {listing(parts, 6)}"
    return [f"{changes} ({outlook.reliability})"]


def promised(session: Session) -> tuple[str, ...]:
    """Return lines on a further motion of a complete session: predicted benefit, and how to record it; may be empty.

    If the session requests no accuracy, the lines name joints and parameters that do not meet the default accuracy.
    """
    if session.dynamic and session.settings.dynamics.plan and not session.needs:
        return _short_of_default(session)
    name = next_round(session)
    notes = read_state(session).notes(STEP.name)
    folder = session.path(f"6-excitation/{name}")
    if not session.needs or not notes or not folder.exists():
        return ()
    played = folder / SAMPLES
    if session.settings.dynamics.repeats > 1:
        played = folder / RUN
    payloads = session.settings.dynamics.payloads
    paths = " and ".join(str(session.path(f"7-recorded/{log_name(name, label)}")) for label in ("", *payloads))
    loads = " without and with each payload" if payloads else ""
    task = f"play {played}{loads}, put the log into {paths}; then: "
    return (notes[0], f"if wanted, {task}{command_line('next', session.folder)}")


def _short_of_default(session: Session) -> tuple[str, ...]:
    """Return a line on joints and parameters below the default accuracy, and on how to request a further motion.

    Args:
        session: a session with an identification.
    """
    joints = _short_joints(session, NEED)
    weak = _weak_parameters(session, NEED)
    names = load_calibrated(session.fit.path).chain.joint_names
    parts = [f"torque of {names[joint.joint]} ({joint.error:.2g} %)" for joint in joints]
    if weak:
        rows = read_estimate(session.identification.path, _Parameter)
        deviations = {row.name: row.rsd or 0.0 for row in rows}
        weakest_first = sorted(weak, key=lambda name: -deviations[name])
        worst = listing((f"{name} ({deviations[name]:.2g} %)" for name in weakest_first), 4)
        parts.append(f"σ of essential parameters {worst}")
    if not parts:
        return (f"no further motion is needed: torques of joints and σ of essential parameters are within {NEED:g} %",)
    keys = [f"sigma_percent = {NEED:g}"] * bool(weak) + [f"tolerance_percent = {NEED:g}"] * bool(joints)
    return (
        f"above {NEED:g} %: {'; '.join(parts)}; for a motion that improves them write {' and '.join(keys)} under "
        f"[dynamics] in session.toml, then: {command_line('next', session.folder)}",
    )


STEP = SessionStep(
    "extend",
    "see whether more motion is needed",
    extend,
    reads=(
        FITTED_ROBOT,
        NamedFile("dynamics", "limits"),
        IDENTIFY_OPTIONS,
        SessionFile(f"8-dynamics/{ESTIMATE}"),
        SessionFile(f"8-dynamics/unseen/{REPORT}"),
    ),
    makes=(f"6-excitation/{ROUND}*/*",),
    settings=(
        StepSetting(
            "dynamics",
            ("tolerance_percent", "sigma_percent", "period", "harmonics", "rate", "starts", "evaluations", "repeats"),
        ),
        StepSetting("seed"),
    ),
    stage="need",
)
