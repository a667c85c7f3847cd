"""Motions as setpoints for a controller: samples at its rate, joined, repeated, slowed down."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from calib.trajectories.errors import BadInput, require


@dataclass(frozen=True, eq=False)
class Setpoints:
    """Samples at a constant rate, both ends included.

    Attributes:
        rate: [Hz].
        q, v, a: (N, n) [rad or m, and per s, per s²].
        tau: (N, n) torques that go with it [N m or N]; None where no model was asked.
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
        """Return a closed motion repeated `times` times; both ends are included, so N - 1 samples a period."""
        require(times >= 1, f"times = {times}: expected 1 or more")
        return joined([self] * times)


def joined(tracks: Sequence[Setpoints]) -> Setpoints:
    """Return tracks joined one after the other; each begins at the last sample of the previous one.

    Raises:
        BadInput: for other rates, or a jump of position or speed at a seam, with its joint and size.
    """
    first, rate = tracks[0], tracks[0].rate
    max_jump = 1e-6  # of a joint [rad or m] at a seam between two tracks
    for k, (one, two) in enumerate(pairwise(tracks)):
        if two.rate != rate:
            raise BadInput(f"motions {k + 1} and {k + 2} are at {one.rate:g} and {two.rate:g} Hz: use one rate for all")
        for what, end, start in (("position", one.q[-1], two.q[0]), ("speed", one.v[-1], two.v[0])):
            jump = np.abs(start - end)
            if jump.max() > max_jump * (1 if what == "position" else rate):
                j = int(jump.argmax())
                raise BadInput(
                    f"motion {k + 2} begins {jump[j]:.3g} away from motion {k + 1}'s end ({what} of joint {j + 1}): "
                    "insert an approach between them"
                )
    rows = [slice(None)] + [slice(1, None)] * (len(tracks) - 1)
    parts = {key: np.vstack([getattr(t, key)[r] for t, r in zip(tracks, rows)]) for key in ("q", "v", "a")}
    torques = [t.tau for t in tracks]
    tau = None if any(x is None for x in torques) else np.vstack([x[r] for x, r in zip(torques, rows) if x is not None])
    return Setpoints(first.rate, **parts, tau=tau)


def slowed(track: Setpoints, factor: float) -> Setpoints:
    """Return the same path `factor` times slower, for a rehearsal: v / factor, a / factor²; torques unknown.

    Positions between the samples come from cubic Hermite pieces, which meet q and v at every sample.

    Args:
        factor: 1 or more; rounded to a whole number of samples at the end.
    """
    require(np.isfinite(factor) and factor >= 1, f"rehearsal factor {factor:g}: expected 1 or more")
    if factor == 1:
        return track
    count = round((len(track) - 1) * factor)
    factor = count / (len(track) - 1)
    place = np.minimum(np.arange(count + 1) / factor, len(track) - 1)
    k = np.minimum(place.astype(int), len(track) - 2)
    x, step = (place - k)[:, None], 1 / track.rate
    q0, q1, v0, v1 = track.q[k], track.q[k + 1], step * track.v[k], step * track.v[k + 1]
    bend, twist = 3 * (q1 - q0) - 2 * v0 - v1, 2 * (q0 - q1) + v0 + v1
    q = q0 + x * (v0 + x * (bend + x * twist))
    v = (v0 + x * (2 * bend + 3 * x * twist)) * track.rate
    a = track.a[k] * (1 - x) + track.a[k + 1] * x
    return Setpoints(track.rate, q, v / factor, a / factor**2)
