"""Setpoints of an exciting motion for a controller: approach, periods, and a slow rehearsal.

The approach leads from where a robot stands to where a motion starts: calm, jerk-limited, within the limits file.
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
from calib.trajectories.places import Clearance
from calib.trajectories.setpoints import Setpoints, joined, slowed

APPROACH_RISE, APPROACH_JERK = (DEFAULT_RISE, 20.0)  # over its speed, where none is stated
MAX_APPROACH_SPEED = 1.0  # [rad/s or m/s] an approach is no faster than this (our choice)
BLOCK_ROWS = 4000


@dataclass(frozen=True, eq=False)
class Playback:
    """Setpoints for a controller: run, approach and rehearsal.

    Attributes:
        run: the approach, where there is one, and `repeat` periods.
        approach, rehearsal: None where not asked for; the rehearsal is the approach and one period, slower.
        repeat: periods.
        notes: what a user should know.
    """

    run: Setpoints
    approach: Setpoints | None
    rehearsal: Setpoints | None
    repeat: int
    notes: tuple[str, ...]


def play(family: Family, found: SearchResult, given: ExcitationInputs, settings: ExcitationSettings) -> Playback:
    """Return the setpoints of a designed motion: approach, periods and rehearsal, as set."""
    model, limits, chain = given.model, given.limits, given.chain
    period = family.period * found.factor
    count = round(period * settings.rate)  # a period holds a whole number of the controller's samples
    motion = dense_motion(family, found.x, np.arange(count + 1) * (period / count), found.factor)
    once = _with_torque(Setpoints(settings.rate, motion.q, motion.v, motion.a), model)
    lead, notes = approach_to(settings.start, once.q[0], settings.rate, limits, chain)
    lead = None if lead is None else _with_torque(lead, model)
    ahead = [] if lead is None else [lead]
    slow = _with_torque(slowed(joined([*ahead, once]), settings.slower), model) if settings.slower > 1 else None
    for name, track in (("approach", lead), ("rehearsal", slow)):
        notes = (*notes, *_torques(name, track, limits, chain))
    return Playback(joined([*ahead, once.repeated(settings.repeat)]), lead, slow, settings.repeat, notes)


def _with_torque(track: Setpoints, dynamics: ExcitedModel) -> Setpoints:
    """Return the track with predicted torques, largest over the loads; unchanged if parameters are unknown."""
    if dynamics.values is None:
        return track
    parts, model = [], dynamics.exact
    for begin in range(0, len(track), BLOCK_ROWS):
        part = (np.ascontiguousarray(x[begin : begin + BLOCK_ROWS]) for x in (track.q, track.v, track.a))
        parts.append(model.largest_torques(dynamics.values, *part))
    return replace(track, tau=np.concatenate(parts))


def _torques(name: str, track: Setpoints | None, limits: MotionLimits, chain: Chain) -> tuple[str, ...]:
    """Return a note if the torques of a track exceed their limits."""
    if track is None or track.tau is None:
        return ()
    share = (np.abs(track.tau) / limits.torque).max(axis=0)
    j = int(np.argmax(share))
    if share[j] <= 1.0:
        return ()
    return (f"torque of {chain.joint_names[j]} reaches {share[j]:.0%} of its limit in the {name}: do not run it",)


def approach_to(
    start: Sequence[float] | None, goal: np.ndarray, rate: float, known: MotionLimits, chain: Chain
) -> tuple[Setpoints | None, tuple[str, ...]]:
    """Return setpoints of a straight approach in joint space to the start of a motion, and notes on violated limits.

    Velocity, acceleration and jerk come from the limits file, else from the robot and our own choice.

    Args:
        start: (n,) where the robot stands [rad or m]; None: no approach; goal: (n,).

    Raises:
        UsageError: for a start beyond the joint limits, or an approach that violates a clearance.
    """
    here = check_start(start, chain, known)
    if here is None:
        return None, ()
    boxes = {one.order: one for one in known.constraints if isinstance(one, BoxLimit)}
    sizes = {order: box.upper for order, box in boxes.items()}
    free = np.full(chain.n, np.inf)
    velocity = np.minimum(sizes.get(1, free), MAX_APPROACH_SPEED)
    acceleration, jerk = (
        np.where(np.isfinite(sizes.get(order, free)), sizes.get(order, free), factor * velocity)
        for order, factor in ((2, APPROACH_RISE), (3, APPROACH_JERK))
    )
    found = straight_approach(here, goal, velocity, acceleration, jerk, rate)
    rows = evenly(len(found), 500)
    parts = (found.times, found.q, found.v, found.a, np.zeros(found.q.shape))
    notes = []
    for limit, broken, k in known.broken(SampledMotion(*(x[rows] for x in parts))):
        words = f"on the straight approach, {broken} at t = {found.times[rows[k]]:.3g} s"
        if isinstance(limit, Clearance):
            raise UsageError(f"{words}: move the robot to another pose first, or jog it to the start")
        notes.append(f"{words}: watch the approach, or start from another pose")
    return found, tuple(notes)


def check_start(start: Sequence[float] | None, chain: Chain, known: MotionLimits) -> np.ndarray | None:
    """Return the start as an array (n,); raise an error for a wrong number of values or a violated joint limit."""
    if start is None:
        return None
    limits, here = known.positions, np.asarray(start, dtype=float)
    require(here.shape == (chain.n,), f"start: expected {chain.n} joint values, found {here.size}", UsageError)
    for name, value, lower, upper in zip(chain.joint_names, here, limits.lower, limits.upper):
        if not lower <= value <= upper:
            raise UsageError(f"start: {name} at {value:g} is beyond its limits {lower:.4g} to {upper:.4g}")
    return here
