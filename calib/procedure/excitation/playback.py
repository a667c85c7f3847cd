"""An exciting motion as it is run: an approach, as many periods as wanted, and a slow rehearsal of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.dynamics.base import BaseModel
from calib.errors import UsageError
from calib.procedure.excitation.approach import approach_to, check_start
from calib.procedure.excitation.limits import MotionLimits
from calib.procedure.excitation.model import ExcitedModel
from calib.robot.chain import Chain
from trajectories.basis import Family
from trajectories.design.search import SearchResult
from trajectories.design.verify import dense_motion
from trajectories.setpoints import Setpoints, joined, repeated, slowed

BLOCK = 4000


@dataclass(frozen=True, eq=False)
class Playback:
    """What a controller is to run.

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


def check_playback(
    repeat: int, slower: float, start: Sequence[float] | None, chain: Chain, limits: MotionLimits
) -> None:
    """Refuse, before the search, what could not be played."""
    if repeat < 1:
        raise UsageError(f"--repeat {repeat}: expected 1 period or more")
    if not (np.isfinite(slower) and slower >= 1):
        raise UsageError(f"--slower {slower:g}: a rehearsal runs a factor of 1 or more slower")
    if start is not None:
        check_start(np.asarray(start, dtype=float), chain, limits)


def play(
    family: Family,
    found: SearchResult,
    dynamics: ExcitedModel,
    chain: Chain,
    limits: MotionLimits,
    *,
    rate: float,
    start: Sequence[float] | None = None,
    repeat: int = 1,
    slower: float = 1.0,
) -> Playback:
    """Return the tracks of a motion that was found.

    Args:
        rate: of the controller [Hz]; a period holds a whole number of its samples.
        start: (n,) where the robot stands, for an approach.
        repeat: periods; slower: factor of the rehearsal, 1 for none.
    """
    period = family.period * found.factor
    count = round(period * rate)
    motion = dense_motion(family, found.x, np.arange(count + 1) * (period / count), found.factor)
    once = _with_torque(Setpoints(rate, motion.q, motion.v, motion.a), dynamics)
    lead, notes = None, ()
    if start is not None:
        lead, notes = approach_to(start, once.q[0], rate, limits, chain)
        lead = _with_torque(lead, dynamics)
    ahead = [] if lead is None else [lead]
    slow = _with_torque(slowed(joined([*ahead, once]), slower), dynamics) if slower > 1 else None
    for name, track in (("approach", lead), ("rehearsal", slow)):
        notes = (*notes, *_torques(name, track, limits, chain))
    return Playback(joined([*ahead, repeated(once, repeat)]), lead, slow, repeat, notes)


def _with_torque(track: Setpoints, dynamics: ExcitedModel) -> Setpoints:
    """Return the track with the torques the model predicts, where it knows its parameters."""
    if dynamics.values is None:
        return track
    return replace(track, tau=_torque(dynamics.exact, dynamics.values, track))


def _torque(model: BaseModel, values: np.ndarray, track: Setpoints) -> np.ndarray:
    parts = []
    for begin in range(0, len(track), BLOCK):
        part = (np.ascontiguousarray(x[begin : begin + BLOCK]) for x in (track.q, track.v, track.a))
        parts.append(model.regressor(*part) @ values)
    return np.concatenate(parts)


def _torques(name: str, track: Setpoints | None, limits: MotionLimits, chain: Chain) -> tuple[str, ...]:
    """Return a note where a track needs more torque than there is: slow motion can, where speed helped the arm up."""
    if track is None or track.tau is None:
        return ()
    share = (np.abs(track.tau) / limits.torque).max(axis=0)
    j = int(np.argmax(share))
    if share[j] <= 1.0:
        return ()
    return (f"the {name} needs {share[j]:.0%} of the torque limit of {chain.joint_names[j]}: do not run it",)
