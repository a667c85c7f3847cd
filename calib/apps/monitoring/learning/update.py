"""Update of an identified model by production logs, one after another: `calib update`.

Each log is predicted before it is learnt from, so that its error is one on unseen motion. A log whose torques are not
as predicted is not averaged into the model: its cause is named, and the log is left out unless the cause is a change of
friction or of a drive's gain, after which these are estimated anew.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calib.apps.monitoring.learning.dynamics_update import DynamicsUpdate, PredictedLog
from calib.apps.monitoring.learning.logs import DatedLog, dated
from calib.apps.monitoring.learning.working_state import LogRecord, WorkingState, read_state
from calib.errors import Finding, MeasurementError, UsageError, finding, listing, require
from calib.toolkit.model_identification import (
    Cause,
    IdentifyOptions,
    Judgement,
    absorbed,
    common_decimator,
    gather_recordings,
    judge,
    log_rows,
    read_identify_options,
    torque_shares,
)
from calib.toolkit.recordings import common_share, sketch
from calib.toolkit.torque_models import Case, predict

MIN_RANGE = 1e-3
"""Range of positions from which on a joint moves [rad or m]."""
TINY = 1e-300
"""Sum of squares that others are divided by, where a log has no torque at all [N² m² or N²]."""
Progress = Callable[[str], None]


class _Step(NamedTuple):
    """What a log led to: the state after it, findings, and the log with its prediction."""

    state: WorkingState
    findings: list[Finding]
    log: PredictedLog


def update_dynamics(
    folder: str | Path,
    logs: Sequence[str | Path],
    *,
    options: str | Path | None = None,
    enough: float | None = None,
    progress: Progress | None = None,
) -> DynamicsUpdate:
    """Return an identified model updated by further logs.

    Args:
        folder: folder of an identification, or of an earlier update.
        logs: recordings of q and torque or current; their names contain their dates.
        options: TOML file with the options of the identification: gains, columns, payloads.
        enough: torque [%] that one σ of any parameter may move: when it is reached, later logs are not read.
        progress: called with a text on each log; None: silent.

    Raises:
        UsageError: for a folder that holds no identification of a serial arm, logs that are older than those learnt
            from, or logs in another unit than the model.
        MeasurementError: if no log can be read.
    """
    say = progress or _silent
    state = read_state(folder)
    identify_options = read_identify_options(None if options is None else Path(options))
    settings = replace(identify_options.settings, torque_rows=state.model.dynamics.model.torque_rows)
    identify_options = replace(identify_options, settings=settings)
    paths = [str(log) for log in logs]
    require(paths, "no log given", UsageError)
    ordered = dated(paths, len(state.record.logs) + 1)
    findings: list[Finding] = []
    if [log.path for log in ordered] != paths:
        findings.append(finding("logs-out-of-order", files=[Path(log.path).name for log in ordered]))
    if not ordered[0].date:
        findings.append(finding("logs-undated", file=Path(ordered[0].path).name))
    _check_order(state, ordered)
    ordered, older_logs = _without_older(state, ordered)
    findings += older_logs

    earlier_count = len(state.record.logs)
    predicted = None
    failure = None
    for log in ordered:
        say(f"learning from {Path(log.path).name}")
        try:
            step = _next_step(state, log, identify_options)
        except MeasurementError as error:
            failure = error
            findings.append(finding("log-unreadable", file=Path(log.path).name, reason=_reason(error, log.path)))
            continue
        state = step.state
        findings += step.findings
        predicted = step.log
        sigma = state.record.logs[-1].sigma
        if enough is not None and sigma < enough:
            findings.append(finding("learnt-enough", file=Path(log.path).name, limit=enough, sigma=sigma))
            break
    if predicted is None:
        assert failure is not None
        raise failure
    return DynamicsUpdate(state, earlier_count, tuple(findings), predicted)


def _silent(text: str) -> None:
    """Ignore a progress text."""


def _reason(error: MeasurementError, path: str) -> str:
    """Return an error's message without the path at its beginning."""
    return str(error).removeprefix(f"{path}: ").removeprefix(f"{path}, ")


def _check_order(state: WorkingState, logs: Sequence[DatedLog]) -> None:
    """Raise an error for logs older than those learnt from, or with dates where those had none.

    Args:
        state: the state with the earlier logs.
        logs: further logs, in the order of their dates.

    Raises:
        UsageError: the message names logs and dates.
    """
    if not state.record.logs:
        return
    last = state.record.logs[-1]
    message = (
        f"{logs[0].path} {'has a date' if logs[0].date else 'has no date in its name'}, but the logs that "
        f"{state.folder} was learnt from {'have dates' if last.date else 'have none'}: name all alike"
    )
    require(bool(last.date) == bool(logs[0].date), message, UsageError)
    older = [f"{log.path} ({log.date})" for log in logs if log.day < last.day]
    message = (
        f"{listing(older)}: older than {last.name} of {last.date}, from which {state.folder} was learnt; give all logs "
        "together to the identification before it"
    )
    require(not older, message, UsageError)


def _next_step(state: WorkingState, log: DatedLog, options: IdentifyOptions) -> _Step:
    """Return what a log leads to: it is predicted, compared with the prediction, and learnt from if it is accepted.

    Args:
        state: the state before it.
        log: the log.
        options: options of the identification, with the torque rows of the model.
    """
    name = Path(log.path).name
    case = _read(state, log, options)
    if (np.ptp(case.motion.q, axis=0) < MIN_RANGE).all():
        raise MeasurementError("no joint moves, so that friction and inertias have no effect", log.path)
    days = 0.0
    if state.last_day is not None:
        days = log.day - state.last_day
    bank = state.bank.later(days)
    rows = log_rows(state.model, case, common_decimator([case], options.settings))
    mean, _ = bank.posterior()
    first = predict(state.model.dynamics, case)
    torque = predict(state.model.updated(mean), case) + first * mean[state.model.k :]

    hashes = case.motion.hashes
    assert hashes is not None
    findings = []
    repeated = _repeated(state, hashes)
    judgement = judge(state.model, bank, rows)
    learnt = judgement.accepted and not repeated
    if repeated:
        findings.append(finding("log-repeated", file=name, before=repeated))
    elif judgement.cause is not Cause.NONE:
        findings.append(_not_as_predicted(state, name, judgement))
    if learnt:
        bank = absorbed(bank, rows, judgement)
    mean, covariance = bank.posterior()
    drifting = state.drifting
    record = LogRecord(
        name=name,
        date=log.date,
        day=log.day,
        seconds=case.duration,
        error=_unexplained(case, torque),
        first_error=_unexplained(case, first),
        ratio=float(np.nanmax(judgement.ratios)),
        cause="same log" if repeated else judgement.cause.value,
        learnt=learnt,
        sigma=100.0 * float(torque_shares(rows, covariance).max()),
        parameters=tuple(_absolute(state, mean)[drifting].tolist()),
        sigmas=tuple(np.sqrt(np.diag(covariance))[drifting].tolist()),
    )
    return _Step(state.after(record, bank, sketch(hashes)), findings, PredictedLog(case, torque))


def _read(state: WorkingState, log: DatedLog, options: IdentifyOptions) -> Case:
    """Return a log as a case in the model's unit, with payloads that the model knows.

    Args:
        state: the state with robot and model.
        log: the log.
        options: options of the identification.

    Raises:
        UsageError: for another unit, or an unknown payload.
        MeasurementError: for a log that cannot be used.
    """
    settings = options.file_settings(log.path)
    alike = replace(options, every=settings, files={})
    inputs = gather_recordings(state.robot, [log.path], options=alike)
    message = (
        f"{log.path} gives torques in {inputs.unit}, the model in {state.folder} is in {state.unit}: give the options "
        "of the identification (--options), with its gains"
    )
    require(inputs.unit == state.unit, message, UsageError)
    case = inputs.cases[0]
    labels = set(case.carried) - set(state.model.dynamics.model.bodies.labels)
    message = (
        f"{log.path} carries payload {listing(sorted(labels))}, which the model in {state.folder} does not have: "
        "identify again with a recording of it"
    )
    require(not labels, message, UsageError)
    return case


def _absolute(state: WorkingState, changes: np.ndarray) -> np.ndarray:
    """Return the parameters (p,) themselves from their changes (p,): estimated values, and gains as factors."""
    first = np.ones(len(changes))
    first[: state.model.k] = state.model.values
    return first + changes


def _unexplained(case: Case, torque: np.ndarray) -> float:
    """Return the share of a log's torque that a prediction (N, rows) leaves unexplained [%]."""
    present = case.present
    residual = np.sum((case.target - torque)[present] ** 2)
    return 100.0 * float(np.sqrt(residual / max(np.sum(case.target[present] ** 2), TINY)))


def _repeated(state: WorkingState, hashes: np.ndarray) -> str:
    """Return the name of a recording of the model that has common samples with a log; empty if there is none.

    Args:
        state: the state with the recordings of its identification and the earlier logs.
        hashes: hashes of the log's samples.
    """
    sketches = [(recording.name, recording.hashes) for recording in state.identified_from]
    learnt = [record.name for record in state.record.logs if record.learnt]
    for name, earlier in [*sketches, *zip(learnt, state.sketches)]:
        if common_share(hashes, earlier) > 0.0:
            return name
    return ""


def _without_older(state: WorkingState, logs: Sequence[DatedLog]) -> tuple[list[DatedLog], list[Finding]]:
    """Return the logs that are no older than the identification's recordings, and findings on the others.

    A log of the same day counts as no older, since its name may lack the time.

    Args:
        state: the state with the recordings of its identification.
        logs: dated logs, or logs without dates, which are all accepted.

    Raises:
        UsageError: if all logs are older.
    """
    recordings = []
    for recording in state.identified_from:
        recordings += dated([recording.file], 1)
    dated_recordings = [recording for recording in recordings if recording.date]
    if not dated_recordings or not logs[0].date:
        return list(logs), []
    latest = max(dated_recordings, key=lambda recording: recording.day)
    before = Path(latest.path).name
    accepted: list[DatedLog] = []
    findings = []
    for log in logs:
        if int(log.day) >= int(latest.day):
            accepted.append(log)
            continue
        name = Path(log.path).name
        findings.append(finding("log-older", file=name, date=log.date, before=before, before_date=latest.date))
    message = (
        f"{listing([log.path for log in logs])}: older than {before} of {latest.date}, from which {state.folder} was "
        "identified; give all recordings together to calib identify"
    )
    require(accepted, message, UsageError)
    return accepted, findings


def _not_as_predicted(state: WorkingState, name: str, judgement: Judgement) -> Finding:
    """Return the finding on a log whose torques are not as predicted.

    Args:
        state: the state, which names the torque rows.
        name: name of the log.
        judgement: its comparison with the prediction.
    """
    rows = [state.model.row_names[row] for row in judgement.unexpected]
    shared = {"file": name, "joints": rows, "times": float(np.nanmax(judgement.ratios))}
    change, sigma = judgement.change, judgement.sigma
    joint = "" if judgement.row is None else state.model.row_names[judgement.row]
    if judgement.cause is Cause.LOAD:
        return finding("log-load", mass=change, sigma=sigma, **shared)
    if judgement.cause is Cause.FRICTION:
        return finding("log-friction", joint=joint, torque=change, sigma=sigma, unit=state.unit, **shared)
    if judgement.cause is Cause.GAIN:
        return finding("log-gain", joint=joint, factor=1.0 + change, sigma=sigma, **shared)
    if judgement.cause is Cause.UNIT:
        return finding("log-unit", factor=1.0 + change, **shared)
    if judgement.cause is Cause.MOTION:
        return finding("log-motion", **shared)
    return finding("log-unknown", **shared)
