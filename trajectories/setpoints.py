"""Motions as setpoints for a controller: sampled at its rate, concatenated, repeated, slowed down."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from .errors import BadInput, require

# largest jump of a joint between two tracks [rad or m]
MAX_JUMP = 1e-6


@dataclass(frozen=True, eq=False)
class Setpoints:
    """Samples of a motion at a constant rate, both ends included.

    Attributes:
        rate: sampling rate [Hz].
        q, v, a: (N, n) [rad or m, and per s, per s²].
        tau: (N, n) torques of the motion [N m or N]; None where they were not computed.
    """

    rate: float
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    tau: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.q)

    @property
    def n(self) -> int:
        return self.q.shape[1]

    @property
    def times(self) -> np.ndarray:
        return np.arange(len(self)) / self.rate

    @property
    def duration(self) -> float:
        return (len(self) - 1) / self.rate

    def repeated(self, times: int) -> Setpoints:
        """Return a closed motion repeated `times` times.

        The first and last of the N samples of a closed motion coincide, so a period is N - 1 samples.
        """
        require(times >= 1, f"times = {times}: expected 1 or more")
        return joined([self] * times)


def joined(tracks: Sequence[Setpoints]) -> Setpoints:
    """Return motions concatenated; each begins at the last sample of the previous one.

    Raises:
        BadInput: tracks of different rates, or a jump of position or speed between two tracks; the message gives joint
            and size.
    """
    rate = tracks[0].rate
    for k, (track, following) in enumerate(pairwise(tracks)):
        if following.rate != rate:
            raise BadInput(
                f"motions {k + 1} and {k + 2} are at {track.rate:g} and {following.rate:g} Hz: use one rate for all"
            )
        _check_seam(k, "position", track.q[-1], following.q[0], MAX_JUMP)
        _check_seam(k, "speed", track.v[-1], following.v[0], MAX_JUMP * rate)
    q, v, a, tau = [], [], [], []
    for k, track in enumerate(tracks):
        # the first sample of a track is the last one of the track before
        rows = slice(min(k, 1), None)
        q.append(track.q[rows])
        v.append(track.v[rows])
        a.append(track.a[rows])
        if track.tau is not None:
            tau.append(track.tau[rows])
    torques = None
    if len(tau) == len(tracks):
        torques = np.vstack(tau)
    return Setpoints(rate, np.vstack(q), np.vstack(v), np.vstack(a), torques)


def _check_seam(k: int, quantity: str, end: np.ndarray, start: np.ndarray, max_jump: float) -> None:
    """Raise BadInput where the end of a motion and the start of the next differ by more than `max_jump`.

    Args:
        k: index (from 0) of the first of the two motions.
        quantity: name of the compared quantity in the message ("position" or "speed").
        end, start: (n,) values at the end of motion k and at the start of the next.
        max_jump: largest permitted difference, in the unit of the values.
    """
    jump = np.abs(start - end)
    if jump.max() > max_jump:
        j = int(jump.argmax())
        raise BadInput(
            f"motion {k + 2} begins {jump[j]:.3g} away from motion {k + 1}'s end ({quantity} of joint {j + 1}): "
            "insert an approach between them"
        )


def slowed(track: Setpoints, factor: float) -> Setpoints:
    """Return the motion `factor` times slower, for a rehearsal at low speed: v / factor, a / factor², without torques.

    Positions between the samples are interpolated by cubic Hermite polynomials, which match q and v at every sample.

    Args:
        track: the motion.
        factor: 1 or more; rounded to a whole number of samples at the end.

    Raises:
        BadInput: a factor below 1 or not finite.
    """
    require(np.isfinite(factor) and factor >= 1, f"rehearsal factor {factor:g}: expected 1 or more")
    if factor == 1:
        return track
    last = len(track) - 1
    count = round(last * factor)
    factor = count / last
    position = np.minimum(np.arange(count + 1) / factor, last)
    k = np.minimum(position.astype(int), last - 1)
    x = (position - k)[:, None]
    step = 1 / track.rate
    q0 = track.q[k]
    q1 = track.q[k + 1]
    v0 = step * track.v[k]
    v1 = step * track.v[k + 1]
    bend = 3 * (q1 - q0) - 2 * v0 - v1
    twist = 2 * (q0 - q1) + v0 + v1
    q = q0 + x * (v0 + x * (bend + x * twist))
    v = (v0 + x * (2 * bend + 3 * x * twist)) * track.rate
    a = track.a[k] * (1 - x) + track.a[k + 1] * x
    return Setpoints(track.rate, q, v / factor, a / factor**2)
