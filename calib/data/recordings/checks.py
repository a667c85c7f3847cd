"""Can a recording be what it claims? Each complaint names the row, the column and the likely cause.

What cannot be is refused; what is odd but possible becomes a note. All thresholds are our choice.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.data.poses.plausible import DEGREE, FAR, SLACK, STILL, TURN
from calib.data.recordings.recording import Joints, Recording
from calib.errors import MeasurementError

FEWEST = 100  # samples; filters at both ends eat some 50
SLOWEST, FASTEST = 5.0, 50e3  # sampling rates that occur [Hz]
MOVES = 1e-3  # a joint that goes less far has not moved [rad or m]: above encoder noise
POSES = 300  # of a recording, among which two alike are looked for
BACK = 0.05  # of each joint's travel by which two poses may differ to be one
BEYOND = 3.0  # times its limit: no joint's torque reaches that
SPIKES = 0.002  # share of the rows, and `FEW` at least, that may be spikes of a torque
FEW = 3
OUTSIDE, WILD = 2.0, 10.0  # times what the other rows stay below: a spike beyond the joint's limit, one within
MANY = 0.05  # share of the rows from which on they are no spikes, but another unit
HUGE = 1e12  # no quantity of a robot is larger, whatever its unit
JUMP = 0.02  # no position leaves the slope of the rows around it by that [rad]; real ones do by 7 mrad; in m a tenth
NEEDED = ("t", "q", "effort", "v", "tau_link", "tau_motor")


def check_recording(recording: Recording, joints: Joints | None = None) -> Recording:
    """Return the recording with its notes, or refuse it.

    Raises:
        MeasurementError: for too few samples, values that are not finite, time that stands or runs backwards, degrees
            for radians, a torque that is one number while its joint moves.
    """
    _check_count(recording)
    _check_finite(recording)
    recording = _drop_spikes(recording, joints)
    _check_finite(recording, HUGE)
    recording = _drop_repeats(recording)
    _check_time(recording.t, recording.rows, recording.file)
    _check_size(recording, joints)
    _check_speed(recording)
    notes = (*_still(recording), *_effort_notes(recording, joints), *_limit_notes(recording, joints))
    return replace(_noted(recording, *notes, *_work_notes(recording)), jumps=tuple(_jumps(recording, joints)))


def _check_count(recording: Recording) -> None:
    if len(recording) < FEWEST:
        message = f"{len(recording)} samples are too few to filter and to learn from; at least {FEWEST} are needed"
        raise MeasurementError(message, recording.file)


def _check_finite(recording: Recording, most: float = np.inf) -> None:
    """Refuse NaN, infinities and what is beyond `most`; NaN in `q_link` says that a joint has no second encoder."""
    for name in NEEDED:
        values = getattr(recording, name)
        if values is None or (np.abs(values) < most).all():
            continue
        bad = np.argwhere(~(np.abs(values) < most).reshape(len(recording), -1))
        row, joint = (int(i) for i in bad[0])
        where = "t" if name == "t" else _column(recording, name, joint)
        many = f" (and in {len(np.unique(bad[:, 0])) - 1} more rows)" if len(bad) > 1 else ""
        message = f"found {values.reshape(len(recording), -1)[row, joint]:g}{many}; cut that part out, or leave the"
        raise MeasurementError(f"{message} rows out", recording.file, int(recording.rows[row]), where)


def _drop_spikes(recording: Recording, joints: Joints | None) -> Recording:
    """Return the recording without the few rows in which a torque is one that its joint cannot have.

    That is `BEYOND` its limit and `OUTSIDE` of what all but `SPIKES` of its rows stay below, or `WILD` times that.

    Raises:
        MeasurementError: where more rows than that, up to `MANY`, are beyond the limit by as much.
    """
    count = len(recording)
    few = max(FEW, int(SPIKES * count))
    limit = np.full(recording.n, np.inf)
    if joints is not None and recording.kind == "torque":
        limit = np.where(np.isfinite(joints.effort) & (joints.effort > 0), BEYOND * joints.effort, np.inf)
    size, beyond = np.abs(recording.effort - np.median(recording.effort, axis=0)), np.abs(recording.effort) > limit
    ordered = np.sort(size, axis=0)
    usual = ordered[count - few - 1]
    wild = ((size > WILD * usual) | ((size > OUTSIDE * usual) & beyond)) & (usual > 0.0)
    if not 0 < wild.any(axis=1).sum() <= few:
        usual = ordered[count - int(MANY * count) - 1]
        wild = (size > WILD * usual) & beyond
    rows = wild.any(axis=1)
    if not rows.any():
        return recording
    row = int(np.argmax(rows))
    j = int(np.argmax(wild[row]))
    found = f"is {recording.effort[row, j]:.4g} at {recording.t[row]:.6g} s"
    more = f" (and in {int(rows.sum()) - 1} more rows)" if rows.sum() > 1 else ""
    if rows.sum() > few:
        message = f"{found}{more}, where {1 - MANY:.0%} of the rows are within {usual[j]:.4g} of its median"
        advice = "spikes of the log, too many to be left out? Cut those parts out"
        place = _column(recording, "effort", j)
        raise MeasurementError(f"{message}: {advice}", recording.file, int(recording.rows[row]), place)
    note = (
        f"row {recording.rows[row]}: the {_column(recording, 'effort', j)} {found}{more}, the other rows are within "
        f"{size[~rows, j].max():.4g} of its median: a spike of the log; left out"
    )
    return _noted(recording.take(~rows), note)


def _drop_repeats(recording: Recording) -> Recording:
    """Return the recording without rows that a logger wrote twice: same stamp, same positions, same torques."""
    same = np.diff(recording.t) == 0
    for name in ("q", "effort"):
        same &= (np.diff(getattr(recording, name), axis=0) == 0).all(axis=1)
    if not same.any():
        return recording
    first = int(recording.rows[int(np.argmax(same)) + 1])
    kept = recording.take(np.concatenate([[True], ~same]))
    return _noted(kept, f"{int(same.sum())} rows repeat the one before, stamp and all (first: row {first}); dropped")


def _check_time(t: np.ndarray, rows: np.ndarray, file: str) -> None:
    """Refuse stamps (N,) [s] that do not rise, and those whose step looks like another unit."""
    step = np.diff(t)
    if (step < 0).any():
        i = int(np.argmax(step < 0))
        if (step < 0).all():
            raise MeasurementError("time runs backwards in every row: turn the rows around, last one first", file)
        message = (
            f"time goes back from {t[i]:.6g} s to {t[i + 1]:.6g} s ({int((step < 0).sum())} times): were two"
            f" logs joined, or was the clock set? Cut the file there (@{t[0]:g}:{t[i]:g})"
        )
        raise MeasurementError(message, file, int(rows[i + 1]), "t")
    if (step == 0).any():
        i = int(np.argmax(step == 0))
        message = (
            f"two samples have the stamp {t[i]:.6g} s but different values ({int((step == 0).sum())} pairs): is the"
            " clock too coarse? Number the samples, or leave one of each pair out"
        )
        raise MeasurementError(message, file, int(rows[i + 1]), "t")
    rate = 1 / float(np.median(step))
    if not SLOWEST <= rate <= FASTEST:
        units = {"ms": 1e3, "us": 1e6, "ns": 1e9}
        likely = next((unit for unit, factor in units.items() if SLOWEST <= rate * factor <= FASTEST), "")
        hint = f"the stamps look like {likely}; if so, say so (units: t = '{likely}')" if likely else "check the stamps"
        raise MeasurementError(f"the median step is {np.median(step):.4g} s, {rate:.3g} Hz: {hint}", file, column="t")


def _check_size(recording: Recording, joints: Joints | None = None) -> None:
    """Refuse positions that no joint has: degrees, millimetres, or the columns of another robot."""
    n = recording.n
    kinds = joints.kinds if joints else ("revolute",) * n
    for j, kind in enumerate(kinds):
        q = recording.q[:, j]
        most = FAR if kind == "prismatic" else TURN
        if joints is not None and np.isfinite(joints.lower[j]) and np.isfinite(joints.upper[j]):
            most = max(most, 2 * np.abs([joints.lower[j], joints.upper[j]]).max())
        beyond = np.abs(q) > most
        if kind == "continuous" or not beyond.any():
            continue
        row = int(np.argmax(beyond))
        unit, other = ("m", "mm") if kind == "prismatic" else ("rad", "deg")
        message = (
            f"{q[row]:g} {unit} is beyond what a {kind} joint does ({int(beyond.sum())} of {len(q)} rows): looks like "
            f"{other}; if so, say so (a header 'q{j + 1} [{other}]', or units: q = '{other}')"
        )
        raise MeasurementError(message, recording.file, int(recording.rows[row]), _column(recording, "q", j))


def _check_speed(recording: Recording) -> None:
    """Refuse measured velocities that differ from the slope of the positions by 180/π: one of them is in degrees."""
    if recording.v is None:
        return
    slope = np.diff(recording.q, axis=0) / np.diff(recording.t)[:, None]
    mean = (recording.v[1:] + recording.v[:-1]) / 2
    power, own, product = (slope**2).sum(axis=0), (mean**2).sum(axis=0), (slope * mean).sum(axis=0)
    ratio = product / np.maximum(power, 1e-300)
    alike = product > 0.9 * np.sqrt(power * own)  # a joint that hardly moves shows noise alone
    for j in np.flatnonzero(alike & (np.ptp(recording.q, axis=0) > MOVES)):
        for factor, wrong in ((1 / DEGREE, "the velocities look like deg/s"), (DEGREE, "the positions look like deg")):
            if abs(ratio[j] / factor - 1) < 0.1:
                message = f"v is {ratio[j]:.3g} times the slope of q: {wrong}; if so, say so in the header or the units"
                raise MeasurementError(message, recording.file, column=_column(recording, "v", int(j)))


def _jumps(recording: Recording, joints: Joints | None) -> list[str]:
    """Return in words which positions jump, whatever the rows around do: an encoder, a clock, a join."""
    if len(recording) < 5:
        return []
    step = np.diff(recording.t)
    slope = np.diff(recording.q, axis=0) / step[:, None]
    around = np.median(np.stack([slope[:-4], slope[1:-3], slope[3:-1], slope[4:]]), axis=0)
    off = np.abs(slope[2:-2] - around) * step[2:-2, None]
    usual = np.maximum(np.median(off, axis=0), 1e-9)
    apart = (step[2:-2] < 3 * np.median(step))[:, None]  # not over a gap
    kinds = joints.kinds if joints is not None else ("revolute",) * recording.n
    least = np.array([JUMP if kind != "prismatic" else JUMP / 10 for kind in kinds])
    notes = []
    for j in np.flatnonzero(((off > least) & (off > 20 * usual) & apart).any(axis=0)):
        row = int(np.argmax(off[:, j] * apart[:, 0]))
        size = f"{1e3 * off[row, j]:.3g} {'mm' if kinds[j] == 'prismatic' else 'mrad'}"
        notes.append(
            f"{recording.joint_names[j]} jumps by {size} between rows {recording.rows[row + 2]} and "
            f"{recording.rows[row + 3]}: an encoder, or two logs joined? Cut the file there"
        )
    return notes


def _column(recording: Recording, name: str, joint: int) -> str:
    """Return how a message calls a column: ``effort of elbow (joint 3)``."""
    label = recording.kind if name == "effort" else name
    return f"{label} of {recording.joint_names[joint]} (joint {joint + 1})"


def _still(recording: Recording) -> list[str]:
    still = np.ptp(recording.q, axis=0) < MOVES
    if still.all():
        return ["no joint moves in this recording: it tells of gravity in one pose, and nothing else"]
    notes = []
    for j, dead in enumerate(np.ptp(recording.effort, axis=0) == 0):
        if dead and not still[j]:
            message = f"is {recording.effort[0, j]:g} in all {len(recording)} rows while the joint moves: was it logged"
            raise MeasurementError(message + "?", recording.file, column=_column(recording, "effort", j))
        if still[j]:
            travel = "is one number" if np.ptp(recording.q[:, j]) < STILL else f"moves less than {MOVES:g}"
            own = f", and so is its {recording.kind}" if dead else ""
            notes.append(f"{recording.joint_names[j]} never moves (its position {travel}{own}): what only its motion")
            notes[-1] += " excites cannot be identified from this file"
    return notes


def _effort_notes(recording: Recording, joints: Joints | None) -> list[str]:
    """Note efforts that do not suit the limits: currents given as torques differ from them by the gear.

    Raises:
        MeasurementError: where every joint is far beyond its limit: another unit.
    """
    if joints is None or recording.kind != "torque":
        return []
    most, limit = np.abs(recording.effort).max(axis=0), joints.effort
    known = np.isfinite(limit) & (limit > 0)
    usual = np.quantile(np.abs(recording.effort), 0.99, axis=0)  # a spike is no unit
    if known.any() and (usual[known] > BEYOND * limit[known]).all():
        j = int(np.argmax(np.where(known, usual / np.where(known, limit, 1.0), 0.0)))
        message = (
            f"|torque| reaches {usual[j]:.4g} where the joint's limit is {limit[j]:g}, and every joint is beyond "
            f"{BEYOND:g} times its limit: are these N mm, or another robot's? If N mm, say so (a header 'tau_1 [Nmm]', "
            "or units: torque = 'Nmm'); if N m, correct the limits in the robot's file"
        )
        raise MeasurementError(message, recording.file, column=_column(recording, "effort", j))
    high = known & (most > 1.2 * np.where(known, limit, np.inf))
    notes = [
        f"{recording.joint_names[j]}: |torque| reaches {most[j]:.3g}, its limit is {limit[j]:g}: another unit?"
        for j in np.flatnonzero(high)
    ]
    if known.any() and (most[known] < 0.03 * limit[known]).all():
        notes.append(
            "no torque reaches 3 % of its joint's limit: are these currents, or torques before the gear? If currents,"
            " say kind = 'current', and their gains are identified"
        )
    return notes


def _limit_notes(recording: Recording, joints: Joints | None) -> list[str]:
    if joints is None:
        return []
    notes = []
    for j, name in enumerate(recording.joint_names):
        over = np.maximum(joints.lower[j] - recording.q[:, j], recording.q[:, j] - joints.upper[j])
        if (worst := float(np.nanmax(over, initial=-np.inf))) > SLACK:
            notes.append(f"{name} is beyond its limits by up to {worst:.2g}: are the columns in the robot's order?")
    return notes


def _work_notes(recording: Recording) -> list[str]:
    """Note torques that take energy out of the robot: from a pose back to it drives pay for friction, ∫τᵀ dq > 0.

    Between different poses gravity pays too, an arm that comes down gives energy back: there nothing is said.
    """
    rows = _round_trip(recording.q) if recording.kind == "torque" else None
    if rows is None:
        return []
    work = ((recording.effort[1:] + recording.effort[:-1]) / 2 * np.diff(recording.q, axis=0))[rows]
    share = float(work.sum() / max(np.abs(work).sum(), 1e-300))
    if share > -0.05:
        return []
    message = "the torques take energy out of the robot (work {:.0%} of the energy moved): is their sign reversed?"
    return [message.format(share)]


def _round_trip(q: np.ndarray) -> slice | None:
    """Return the steps between two rows of nearly one pose, far apart; None where the motion does not come back."""
    every = max(1, len(q) // POSES)
    poses = q[::every] / np.maximum(np.ptp(q, axis=0), MOVES)
    apart = np.abs(poses[:, None] - poses[None]).max(axis=2)
    first, last = np.nonzero(apart < BACK)
    longest = int(np.argmax(last - first))
    if last[longest] - first[longest] < len(poses) // 2:
        return None
    return slice(first[longest] * every, last[longest] * every)


def _noted(recording: Recording, *notes: str) -> Recording:
    return replace(recording, notes=tuple(dict.fromkeys((*recording.notes, *notes)))) if notes else recording
