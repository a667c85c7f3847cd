"""Setpoints of an exciting motion for a controller: approach, periods, and a slow rehearsal.

The approach leads slowly from the robot's present posture to the start of the motion, with limited jerk, and within the
limits of the limits file.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.errors import UsageError, require
from calib.procedure.excitation.excited_model import ExcitedModel
from calib.procedure.excitation.inputs import ExcitationInputs
from calib.procedure.excitation.limits import DEFAULT_RISE, MotionLimits
from calib.procedure.excitation.settings import ExcitationSettings
from calib.records import evenly
from calib.robot.chain import Chain
from calib.trajectories.approach import straight_approach
from calib.trajectories.basis import Family, SampledMotion
from calib.trajectories.constraints import BoxLimit
from calib.trajectories.design.search import SearchResult
from calib.trajectories.design.verify import dense_motion
from calib.trajectories.setpoints import Setpoints, joined, slowed
from calib.trajectories.workspace_limits import Clearance

# [1/s, 1/s^2] acceleration and jerk of an approach over its speed, where none is stated
APPROACH_RISE = DEFAULT_RISE
APPROACH_JERK = 20.0
# [rad/s or m/s] an approach is no faster than this (our choice)
MAX_APPROACH_SPEED = 1.0
# samples of an approach at which constraints are checked
CHECKED_SAMPLES = 500
# samples whose torques are predicted at once, for memory
BLOCK_ROWS = 4000


@dataclass(frozen=True, eq=False)
class Playback:
    """Setpoints for a controller: run, approach and rehearsal.

    Attributes:
        run: `repeat` periods, preceded by the approach if there is one.
        approach: setpoints of the approach; None if not requested.
        rehearsal: approach and one period at lower speed; None if not requested.
        repeat: number of periods.
        notes: remarks for the user.
    """

    run: Setpoints
    approach: Setpoints | None
    rehearsal: Setpoints | None
    repeat: int
    notes: tuple[str, ...]


def play(family: Family, result: SearchResult, inputs: ExcitationInputs, settings: ExcitationSettings) -> Playback:
    """Return the setpoints of a designed motion: periods, and approach and rehearsal if the settings request them.

    Args:
        family: family of motions.
        result: the motion, as variables of the family.
        inputs: robot, model and limits.
        settings: settings with rate, number of periods, start, and factor of the rehearsal.
    """
    model, limits, chain = inputs.model, inputs.limits, inputs.chain
    # a period holds a whole number of the controller's samples
    period = family.period * result.factor
    count = round(period * settings.rate)
    motion = dense_motion(family, result.x, np.arange(count + 1) * (period / count), result.factor)
    once = _with_torque(Setpoints(settings.rate, motion.q, motion.v, motion.a), model)
    approach, notes = approach_to(settings.start, once.q[0], settings.rate, limits, chain)
    before: list[Setpoints] = []
    if approach is not None:
        approach = _with_torque(approach, model)
        before = [approach]
    rehearsal = None
    if settings.slower > 1:
        rehearsal = _with_torque(slowed(joined([*before, once]), settings.slower), model)
    for name, track in (("approach", approach), ("rehearsal", rehearsal)):
        notes = (*notes, *_torques(name, track, limits, chain))
    run = joined([*before, once.repeated(settings.repeat)])
    return Playback(run, approach, rehearsal, settings.repeat, notes)


def _with_torque(track: Setpoints, dynamics: ExcitedModel) -> Setpoints:
    """Return setpoints with the largest predicted torques over all payloads; unchanged if parameters are unknown.

    Args:
        track: the setpoints.
        dynamics: the model that predicts the torques.
    """
    if dynamics.values is None:
        return track
    torques = []
    for begin in range(0, len(track), BLOCK_ROWS):
        rows = slice(begin, begin + BLOCK_ROWS)
        q, v, a = (np.ascontiguousarray(values[rows]) for values in (track.q, track.v, track.a))
        torques.append(dynamics.exact.largest_torques(dynamics.values, q, v, a))
    return replace(track, tau=np.concatenate(torques))


def _torques(name: str, track: Setpoints | None, limits: MotionLimits, chain: Chain) -> tuple[str, ...]:
    """Return a note if the predicted torques of setpoints exceed the torque limits; otherwise empty.

    Args:
        name: name of the setpoints for the note.
        track: the setpoints; None: no setpoints.
        limits: limits of the motion.
        chain: the arm.
    """
    if track is None or track.tau is None:
        return ()
    share = (np.abs(track.tau) / limits.torque).max(axis=0)
    j = int(np.argmax(share))
    if share[j] <= 1.0:
        return ()
    return (f"torque of {chain.joint_names[j]} reaches {share[j]:.0%} of its limit in the {name}: do not run it",)


def approach_to(
    start: Sequence[float] | None, goal: np.ndarray, rate: float, limits: MotionLimits, chain: Chain
) -> tuple[Setpoints | None, tuple[str, ...]]:
    """Return setpoints of a straight approach in joint space to the start of a motion, and notes on violated limits.

    Limits of velocity, acceleration and jerk are from the limits file or the robot; missing limits are our choice.

    Args:
        start: (n,) joint values of the robot before the motion [rad or m]; None: no approach.
        goal: (n,) joint values at the start of the motion [rad or m].
        rate: rate of the controller [Hz].
        limits: limits of the motion.
        chain: the arm.

    Raises:
        UsageError: for a start beyond the joint limits, or an approach that violates a clearance.
    """
    start_q = check_start(start, chain, limits)
    if start_q is None:
        return None, ()
    unlimited = np.full(chain.n, np.inf)
    boxes = [constraint for constraint in limits.constraints if isinstance(constraint, BoxLimit)]
    upper = {box.order: box.upper for box in boxes}
    velocity = np.minimum(upper.get(1, unlimited), MAX_APPROACH_SPEED)
    acceleration = upper.get(2, unlimited)
    acceleration = np.where(np.isfinite(acceleration), acceleration, APPROACH_RISE * velocity)
    jerk = upper.get(3, unlimited)
    jerk = np.where(np.isfinite(jerk), jerk, APPROACH_JERK * velocity)
    approach = straight_approach(start_q, goal, velocity, acceleration, jerk, rate)

    rows = evenly(len(approach), CHECKED_SAMPLES)
    # no constraint on positions needs the jerk
    jerk = np.zeros(approach.q.shape)
    columns = (approach.times, approach.q, approach.v, approach.a, jerk)
    notes = []
    for limit, violation, k in limits.broken(SampledMotion(*(column[rows] for column in columns))):
        message = f"on the straight approach, {violation} at t = {approach.times[rows[k]]:.3g} s"
        if isinstance(limit, Clearance):
            raise UsageError(f"{message}: move the robot to another pose first, or jog it to the start")
        notes.append(f"{message}: watch the approach, or start from another pose")
    return approach, tuple(notes)


def check_start(start: Sequence[float] | None, chain: Chain, limits: MotionLimits) -> np.ndarray | None:
    """Return the joint values of a start as an array (n,); None for None.

    Args:
        start: joint values of the robot before the motion [rad or m]; None: unknown.
        chain: the arm with n joints.
        limits: limits of the motion.

    Raises:
        UsageError: for a wrong number of values, or a value beyond the joint limits.
    """
    if start is None:
        return None
    q = np.asarray(start, dtype=float)
    require(q.shape == (chain.n,), f"start: expected {chain.n} joint values, found {q.size}", UsageError)
    box = limits.positions
    for name, value, lower, upper in zip(chain.joint_names, q, box.lower, box.upper):
        if not lower <= value <= upper:
            raise UsageError(f"start: {name} at {value:g} is beyond its limits {lower:.4g} to {upper:.4g}")
    return q
