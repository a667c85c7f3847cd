"""Plausibility checks of recordings: each error names the row, the column and the likely cause.

Impossible values are refused; odd but possible values become notes. Thresholds: `RecordingBounds`.
"""

from dataclasses import dataclass, replace

import numpy as np

from calib.data.recordings.column_faults import column_faults
from calib.data.recordings.recording import Recording
from calib.data.recordings.row_order import goes_far_back, in_order
from calib.data.schema import BOUNDS, Joints, check_travel, max_travel, more_rows, refuse
from calib.errors import MeasurementError, refuse_data, require
from calib.units import DEG


@dataclass(frozen=True)
class RecordingBounds:
    """Bounds on the values of a recording; all of them are our choice.

    Attributes:
        min_samples: smallest number of samples, for filters to start and to end.
        min_rate, max_rate: smallest and largest sampling rate [Hz].
        min_travel: smallest range of a moving joint [rad or m], above encoder noise.
        max_compared: largest number of rows among which two nearly equal poses are sought.
        max_apart: largest difference of nearly equal poses, as a share of each joint's range.
        max_effort: largest plausible torque, as a multiple of the joint's limit.
        max_spike_share, max_spikes: largest share, and largest number, of rows with torque spikes (the larger counts).
        max_unit_share: share of rows above which large torques indicate another unit rather than spikes.
        min_spike_beyond, min_spike: size of a spike beyond the joint's limit, and of one within it, as a multiple of
            the bound below which the other rows are.
        max_number: largest plausible number of any quantity of a robot, in whatever unit.
        max_jump: largest deviation of a position from the slope of the rows around it [rad]; in real logs 7 mrad occur.
            For prismatic joints a tenth of it [m].
        max_degrees: largest plausible joint angle in degrees, four turns; larger numbers are not degrees.
    """

    min_samples: int = 20
    min_rate: float = 5.0
    max_rate: float = 50e3
    min_travel: float = 1e-3
    max_compared: int = 300
    max_apart: float = 0.05
    max_effort: float = 3.0
    max_spike_share: float = 0.002
    max_spikes: int = 3
    max_unit_share: float = 0.05
    min_spike_beyond: float = 2.0
    min_spike: float = 10.0
    max_number: float = 1e12
    max_jump: float = 0.02
    max_degrees: float = 1440.0


LIMITS = RecordingBounds()
# Ratio of velocities to the slope of positions in degrees: factor, cause, and the line for the options.
DEGREES = (
    (1 / DEG, "the velocities look like deg/s", "recording.units.v = 'deg/s'"),
    (DEG, "the positions look like deg", "recording.units.q = 'deg'"),
)
NEEDED = ("t", "q", "effort", "v", "tau_link", "tau_motor")


def check_recording(recording: Recording, joints: Joints | None = None) -> Recording:
    """Return the recording with notes on unusual values; refuse impossible values.

    Args:
        recording: the recording as read.
        joints: types and limits of the joints; None: unknown.

    Raises:
        MeasurementError: too few samples, values that are not finite, time stamps that do not increase, degrees instead
            of radians, or a torque that is constant while its joint moves.
    """
    few = f"{len(recording)} samples are too few for filters; record {LIMITS.min_samples} or more"
    require(len(recording) >= LIMITS.min_samples, few, MeasurementError, recording.file)
    recording = _without_absent(recording)
    _check_finite(recording)
    recording = in_order(recording)
    recording = _drop_spikes(recording, joints)
    _check_finite(recording, LIMITS.max_number)
    recording = _drop_repeats(recording)
    _check_time(recording)
    _check_size(recording, joints)
    _check_speed(recording)
    notes = (*_still(recording), *_effort_notes(recording, joints), *_limit_notes(recording, joints))
    noted = _noted(recording, *notes, *_work_notes(recording))
    faults = column_faults(recording.t, recording.q, recording.effort, recording.v)
    return replace(noted, jumps=tuple(_jumps(recording, joints)), faults=faults)


def _without_absent(recording: Recording) -> Recording:
    """Return the recording without velocities that are NaN in every row.

    Drivers write NaN for quantities that they do not provide.

    Raises:
        MeasurementError: positions or torques of a joint are NaN in every row.
    """
    absent = {}
    for name in NEEDED[1:]:
        values = getattr(recording, name)
        absent[name] = [] if values is None else np.flatnonzero(np.isnan(values).all(axis=0)).tolist()
    for name, quantity in (("q", "position"), ("effort", recording.kind)):
        if absent[name]:
            joints = ", ".join(recording.joint_names[j] for j in absent[name])
            refuse_data(
                recording.file,
                f"the {quantity} of {joints} is NaN in every row: its driver does not provide it. Identification needs "
                f"positions and torques (or currents) of all joints",
            )
    notes = []
    quantities = (("v", "velocities"), ("tau_link", "torques behind the gear"), ("tau_motor", "motor torques"))
    for name, quantity in quantities:
        if absent[name]:
            joints = ", ".join(recording.joint_names[j] for j in absent[name])
            notes.append(f"{quantity} of {joints} are NaN in every row, so they are not used for any joint")
    removed = dict.fromkeys(name for name, joints in absent.items() if joints)
    return _noted(replace(recording, **removed), *notes)


def _check_finite(recording: Recording, limit: float = np.inf) -> None:
    """Raise MeasurementError for NaN, infinities and values beyond `limit`.

    NaN is allowed in `q_link`, for joints without a second encoder.

    Args:
        recording: the recording.
        limit: largest absolute value of any number in the recording.
    """
    series = []
    columns: list[str] = []
    for name in NEEDED:
        value = getattr(recording, name)
        if value is not None:
            series.append(value)
            columns += ["t"] if name == "t" else _columns(recording, name)
    invalid = np.column_stack([~(np.abs(values) < limit) for values in series])
    if invalid.any():
        values = np.column_stack(series)
        advice = _sound_part(recording, invalid)
        refuse(recording, invalid, columns, lambda row, k: f"found {values[row, k]:g}; cut this part out{advice}")


def _sound_part(recording: Recording, bad: np.ndarray) -> str:
    """Return advice, as text, to cut the recording to its longest part without faulty rows.

    A part has increasing time stamps and no row that is marked in `bad`, (N,) or (N, k). A cut refers to the latest
    time stamp up to each row. The text is empty if that part is too short, or if the file was read in pieces, since the
    rows between the pieces are unknown.

    Args:
        recording: the recording.
        bad: rows, or cells, with faulty values.
    """
    if np.ptp(recording.rows) + 1 > len(recording):
        return ""
    latest = np.fmax.accumulate(recording.t)
    faulty = np.append(False, ~(latest[1:] > latest[:-1])) | bad.reshape(len(bad), -1).any(axis=1)
    breaks = np.flatnonzero(np.concatenate([[True], faulty, [True]]))
    longest = int(np.argmax(np.diff(breaks)))
    first, last = int(breaks[longest]), int(breaks[longest + 1]) - 2
    advice = f"; the longest part without such rows is @{recording.t[first]:.9g}:{recording.t[last]:.9g}"
    return advice if last - first >= LIMITS.min_samples else ""


def _drop_spikes(recording: Recording, joints: Joints | None) -> Recording:
    """Return the recording without the few rows that have impossible torques (spikes of the log).

    Let b be the bound that all but `max_spike_share` of the rows do not exceed. A spike exceeds both `max_effort` times
    the joint's limit and `min_spike_beyond` times b; or, whatever the limit, `min_spike` times b.

    Args:
        recording: the recording.
        joints: the robot's joints with their limits; None: unknown limits.

    Raises:
        MeasurementError: more rows than the allowed share, but at most `max_unit_share`, have such torques.
    """
    count = len(recording)
    max_count = max(LIMITS.max_spikes, int(LIMITS.max_spike_share * count))
    beyond_limit = np.abs(recording.effort) > LIMITS.max_effort * _effort_limits(recording, joints)
    size = np.abs(recording.effort - np.median(recording.effort, axis=0))
    narrow, wide = count - max_count - 1, count - int(LIMITS.max_unit_share * count) - 1
    ordered = np.partition(size, (narrow, wide), axis=0)
    usual_size = ordered[narrow]
    is_large = size > LIMITS.min_spike * usual_size
    is_large |= (size > LIMITS.min_spike_beyond * usual_size) & beyond_limit
    is_spike = is_large & (usual_size > 0.0)
    if not 0 < is_spike.any(axis=1).sum() <= max_count:
        usual_size = ordered[wide]
        is_spike = (size > LIMITS.min_spike * usual_size) & beyond_limit
    rows = is_spike.any(axis=1)
    if not rows.any():
        return recording
    columns, median = _columns(recording, "effort"), f"where {1 - LIMITS.max_unit_share:.0%} of the rows are within"
    if rows.sum() > max_count:
        refuse(
            recording,
            is_spike,
            columns,
            lambda row, j: (
                f"is {recording.effort[row, j]:.4g} at {recording.t[row]:.6g} s, {median} {usual_size[j]:.4g} of "
                "its median: spikes of the log? They are too many to ignore; cut those parts out"
            ),
        )
    row, j = np.argwhere(is_spike)[0]
    note = (
        f"row {recording.rows[row]}: the {columns[j]} is {recording.effort[row, j]:.4g} at {recording.t[row]:.6g} s"
        f"{more_rows(recording, is_spike, columns)}, the other rows are within "
        f"{size[~rows, j].max():.4g} of its median: taken as a spike of the log and not used"
    )
    return _noted(recording.take(~rows), note)


def _effort_limits(recording: Recording, joints: Joints | None) -> np.ndarray:
    """Return the effort limits (n,) of the joints; infinite if unknown, and for currents.

    Args:
        recording: the recording, which has torques or currents.
        joints: the robot's joints with their limits; None: unknown.
    """
    if joints is None or recording.kind != "torque":
        return np.full(recording.n, np.inf)
    return np.where(np.isfinite(joints.effort) & (joints.effort > 0), joints.effort, np.inf)


def _drop_repeats(recording: Recording) -> Recording:
    """Return the recording without rows that a logger wrote twice: equal time stamp, positions and torques."""
    repeats = np.diff(recording.t) == 0
    for values in (recording.q, recording.effort):
        repeats &= (np.diff(values, axis=0) == 0).all(axis=1)
    if not repeats.any():
        return recording
    first = int(recording.rows[int(np.argmax(repeats)) + 1])
    remaining = recording.take(np.concatenate([[True], ~repeats]))
    return _noted(
        remaining, f"{int(repeats.sum())} rows repeat the row before, with its stamp (first: row {first}); not used"
    )


def _check_time(recording: Recording) -> None:
    """Raise MeasurementError for time stamps that do not increase, or whose step suggests another unit than seconds.

    Args:
        recording: the recording.
    """
    t = recording.t
    step = np.diff(t)
    goes_back, stands_still = np.append(False, step < 0), np.append(False, step == 0)
    far_back = goes_far_back(t)
    goes_back = far_back if far_back.any() else goes_back
    if len(step) and (step < 0).all():
        refuse_data(recording.file, "time runs backwards in every row: reverse the order of the rows")
    refuse(
        recording,
        goes_back,
        ["t"],
        lambda i, _: (
            f"time goes back from {t[i - 1]:.6g} s to {t[i]:.6g} s: were two logs joined, or was the clock "
            f"set? Cut the file there{_sound_part(recording, goes_back)}"
        ),
    )
    refuse(
        recording,
        stands_still,
        ["t"],
        lambda i, _: (
            f"two samples have the stamp {t[i]:.6g} s but different values: is the clock too coarse? Number "
            "the samples, or remove one of each pair"
        ),
    )
    rate = 1 / float(np.median(step))
    if not LIMITS.min_rate <= rate <= LIMITS.max_rate:
        hint = "check the stamps"
        for unit, factor in (("ns", 1e9), ("us", 1e6), ("ms", 1e3)):
            if LIMITS.min_rate <= rate * factor <= LIMITS.max_rate:
                hint = (
                    f"stamps look like {unit}; if so, state it in the options (--options): recording.units.t = '{unit}'"
                )
        refuse_data(recording.file, f"the median step is {np.median(step):.4g} s, {rate:.3g} Hz: {hint}", "t")


def _check_size(recording: Recording, joints: Joints | None = None) -> None:
    """Raise MeasurementError for positions that no joint can reach.

    Likely causes are degrees, millimetres, or columns of another robot.

    Args:
        recording: the recording.
        joints: types and limits of the joints; None: unknown.
    """
    kinds = joints.kinds if joints else ("revolute",) * recording.n
    max_size = max_travel(kinds)
    if joints is not None:
        reach = 2 * np.maximum(np.abs(joints.lower), np.abs(joints.upper))
        max_size = np.where(np.isfinite(reach), np.maximum(max_size, reach), max_size)
    check_travel(
        recording.q,
        max_size,
        recording,
        _columns(recording, "q"),
        recording.joint_names,
        kinds,
        lambda j, other: _likely_unit(recording, j, other),
    )


def _likely_unit(recording: Recording, joint: int, unit: str) -> str:
    """Return advice on the positions of a joint that exceed its range and may be in another unit.

    Args:
        recording: the recording [rad or m].
        joint: index of the joint.
        unit: the unit in which the positions may be, deg or mm.
    """
    if unit == "deg" and np.abs(recording.q[:, joint]).max() > LIMITS.max_degrees:
        return (
            "too large for deg, too: encoder counts? Then state the counts per turn and the count at zero in the "
            "options (--options): recording.units.q = 'counts/4096@2048'"
        )
    stated = f"header 'q{joint + 1} [{unit}]', or in the options (--options): recording.units.q = '{unit}'"
    return f"looks like {unit}; if so, state the unit ({stated})"


def _check_speed(recording: Recording) -> None:
    """Raise MeasurementError if velocities differ from the slope of the positions by the factor 180/π (degrees).

    Args:
        recording: the recording; without measured velocities nothing is checked.
    """
    if recording.v is None:
        return
    slope = np.diff(recording.q, axis=0) / np.diff(recording.t)[:, None]
    mean = (recording.v[1:] + recording.v[:-1]) / 2
    power, mean_power, product = (slope**2).sum(axis=0), (mean**2).sum(axis=0), (slope * mean).sum(axis=0)
    ratio = product / np.maximum(power, 1e-300)
    proportional = product > 0.9 * np.sqrt(power * mean_power)  # a joint that hardly moves shows noise alone
    for j in np.flatnonzero(proportional & (np.ptp(recording.q, axis=0) > LIMITS.min_travel)):
        for factor, cause, line in DEGREES:
            if abs(ratio[j] / factor - 1) < 0.1:
                message = f"v is {ratio[j]:.3g} times the slope of q: {cause}; if so, state the unit in the header"
                message += f", or in the options (--options): {line}"
                refuse_data(recording.file, message, _columns(recording, "v")[j])


def _jumps(recording: Recording, joints: Joints | None) -> list[str]:
    """Return descriptions of positions that jump relative to the rows around them; an empty list without jumps.

    Causes are encoders, clocks, or joined logs.

    Args:
        recording: the recording.
        joints: types of the joints; None: all revolute.
    """
    if len(recording) < 5:
        return []
    step = np.diff(recording.t)
    adjacent = step[2:-2] < 3 * np.median(step)  # not over a gap
    kinds = joints.kinds if joints is not None else ("revolute",) * recording.n
    min_jump = np.where(np.array(kinds) == "prismatic", LIMITS.max_jump / 10, LIMITS.max_jump)
    notes = []
    for j, q in enumerate(recording.q.T):
        slope = np.diff(q) / step
        low, high = np.minimum(slope[:-1], slope[1:]), np.maximum(slope[:-1], slope[1:])
        # median of two before, two after
        around = (np.maximum(low[:-3], low[3:]) + np.minimum(high[:-3], high[3:])) / 2
        by_stamps = np.abs(slope[2:-2] - around) * step[2:-2]
        # stamps with jitter make slopes of their own: a jump is one between equally spaced samples, too
        change = np.diff(q)
        low, high = np.minimum(change[:-1], change[1:]), np.maximum(change[:-1], change[1:])
        usual = (np.maximum(low[:-3], low[3:]) + np.minimum(high[:-3], high[3:])) / 2
        deviation = np.minimum(by_stamps, np.abs(change[2:-2] - usual))
        is_jump = (deviation > min_jump[j]) & adjacent
        if not is_jump.any() or not (deviation[is_jump] > 20 * max(float(np.median(deviation)), 1e-9)).any():
            continue
        row = int(np.argmax(deviation * adjacent))
        size = f"{1e3 * deviation[row]:.3g} {'mm' if kinds[j] == 'prismatic' else 'mrad'}"
        notes.append(
            f"{recording.joint_names[j]} jumps by {size} between rows {recording.rows[row + 2]} and "
            f"{recording.rows[row + 3]}: an encoder error, or two joined logs? Cut the file there"
        )
    return notes


def _columns(recording: Recording, name: str) -> list[str]:
    """Return the label of each joint's column of a series, for messages, such as ``effort of elbow (joint 3)``.

    Args:
        recording: the recording.
        name: name of the series, such as ``q`` or ``effort``.
    """
    label = recording.kind if name == "effort" else name
    return [f"{label} of {joint} (joint {j + 1})" for j, joint in enumerate(recording.joint_names)]


def _still(recording: Recording) -> list[str]:
    stands = np.ptp(recording.q, axis=0) < LIMITS.min_travel
    if stands.all():
        return ["no joint moves in this recording: it contains only gravity in one pose"]
    dead = np.ptp(recording.effort, axis=0) == 0
    if (dead & ~stands).any():
        j = int(np.argmax(dead & ~stands))
        message = f"is {recording.effort[0, j]:g} in all {len(recording)} rows while the joint moves: was it logged?"
        refuse_data(recording.file, message, _columns(recording, "effort")[j])
    notes = []
    for j in np.flatnonzero(stands):
        fixed = np.ptp(recording.q[:, j]) < BOUNDS.min_travel
        travel = "is constant" if fixed else f"moves less than {LIMITS.min_travel:g}"
        effort = f", and so is its {recording.kind}" if dead[j] else ""
        question = ""
        if fixed and not dead[j] and stands.sum() == 1:
            spread = float(recording.effort[:, j].std())
            question = f"; its {recording.kind} varies by {spread:.3g} (rms): is its position column frozen?"
        notes.append(
            f"{recording.joint_names[j]} never moves (its position {travel}{effort}): parameters that only its "
            f"motion excites cannot be identified from this file{question}"
        )
    return notes


def _effort_notes(recording: Recording, joints: Joints | None) -> list[str]:
    """Return notes on torques that do not match the effort limits (currents, or torques before the gear).

    Args:
        recording: the recording.
        joints: the robot's joints with their limits; None: unknown.

    Raises:
        MeasurementError: every joint is far beyond its limit, so that the torques are in another unit.
    """
    peak, limit = np.abs(recording.effort).max(axis=0), _effort_limits(recording, joints)
    is_limited = np.isfinite(limit)
    if not is_limited.any():
        return []
    usual_torque = np.quantile(np.abs(recording.effort), 0.99, axis=0)  # a spike is no unit
    if (usual_torque > LIMITS.max_effort * limit)[is_limited].all():
        j = int(np.argmax(usual_torque / limit))
        message = (
            f"|torque| reaches {usual_torque[j]:.4g}, the joint's limit is {limit[j]:g}; every joint exceeds "
            f"{LIMITS.max_effort:g} times its limit: N mm, or another robot? If N mm, state the unit (a header "
            "'tau_1 [Nmm]', or in the options: recording.units.torque = 'Nmm'); if N m, correct the limits in the "
            "robot's file"
        )
        refuse_data(recording.file, message, _columns(recording, "effort")[j])
    notes = []
    for j in np.flatnonzero(peak > 1.2 * limit):
        name = recording.joint_names[j]
        notes.append(f"{name}: |torque| reaches {peak[j]:.3g}, its limit is {limit[j]:g}: is it in another unit?")
    if (peak < 0.03 * limit)[is_limited].all():
        notes.append(
            "no torque reaches 3 % of its joint's limit. If these are currents, set recording.kind = 'current': their "
            "gains are then identified. If they are torques before the gear, multiply them by the gear ratio"
        )
    return notes


def _limit_notes(recording: Recording, joints: Joints | None) -> list[str]:
    if joints is None:
        return []
    notes = []
    for j, name in enumerate(recording.joint_names):
        excess = np.maximum(joints.lower[j] - recording.q[:, j], recording.q[:, j] - joints.upper[j])
        worst = float(np.nanmax(excess, initial=-np.inf))
        if worst > BOUNDS.limit_slack:
            notes.append(f"{name} is beyond its limits by up to {worst:.2g}: are the columns in the robot's order?")
    return notes


def _work_notes(recording: Recording) -> list[str]:
    """Return a note if the torques extract energy from the robot: over a closed path, friction requires ∫τᵀ dq > 0.

    There is no note if the motion does not return to a pose, since gravity does work between different poses.

    Args:
        recording: the recording of joint positions q and torques τ.
    """
    rows = _round_trip(recording.q) if recording.kind == "torque" else None
    if rows is None:
        return []
    mean_effort = (recording.effort[1:] + recording.effort[:-1]) / 2
    work = (mean_effort * np.diff(recording.q, axis=0))[rows]
    share = float(work.sum() / max(np.abs(work).sum(), 1e-300))
    if share > -0.05:
        return []
    return [f"the torques take energy out of the robot (work {share:.0%} of the energy moved): is their sign reversed?"]


def _round_trip(q: np.ndarray) -> slice | None:
    """Return the slice of time steps between two rows with nearly equal poses, far apart in time.

    None if the motion does not return to a pose.
    """
    step = max(1, len(q) // LIMITS.max_compared)
    poses = q[::step] / np.maximum(np.ptp(q, axis=0), LIMITS.min_travel)
    distance = np.abs(poses[:, None] - poses[None]).max(axis=2)
    first, last = np.nonzero(distance < LIMITS.max_apart)
    longest = int(np.argmax(last - first))
    if last[longest] - first[longest] < len(poses) // 2:
        return None
    return slice(first[longest] * step, last[longest] * step)


def _noted(recording: Recording, *notes: str) -> Recording:
    if not notes:
        return recording
    unique_notes = dict.fromkeys((*recording.notes, *notes))
    return replace(recording, notes=tuple(unique_notes))
