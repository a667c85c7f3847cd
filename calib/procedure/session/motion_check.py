"""Is the recorded motion the designed one? If not: degrees, swapped joints, another speed, the other motion, or none.

Both are looked at on a coarse common grid; `trajectories.recall` finds the motion and its repetitions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.signal import fftconvolve, savgol_filter

from calib.data.recordings.recording import Recording
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.rigid_body import inverse_dynamics
from calib.errors import MeasurementError
from calib.procedure.excitation.coefficients import Periodic
from calib.robot.chain import Chain
from trajectories.errors import BadInput
from trajectories.recall import find_periods

STEP = 0.01  # of the coarse grid [s] (this and all below: our choice)
LIKE = 0.9  # share of the motion's variance a recorded period has to explain
LOOSE = 0.98  # below which the tracking is worth a note
SPEEDS = (0.1, 0.2, 0.25, 0.5, 2.0)  # rehearsal factors that are tried to explain another motion
EDGE = 0.25  # kept before and after the motion [s], for the filters' borders
SMOOTH = 10  # half width of the window for derivatives, in steps of the coarse grid
SURE = 0.8  # partial correlation with the torque of the nominal masses from which on its sign counts
HEAVY = 0.03  # of the torque limit: rigid-body torques smaller than this say nothing
SCALE = 10.0  # a factor between measured and nominal torques that no wrong mass explains


@dataclass(frozen=True)
class Heard:
    """A motion found in a recording.

    Attributes:
        start, stop: the whole repetitions with a short rim [s], in the recording's time.
        periods: how many.
        tracking: (n,) rms of recorded minus designed positions [rad or m].
        notes: what a user should know.
    """

    start: float
    stop: float
    periods: int
    tracking: tuple[float, ...]
    notes: tuple[str, ...]


def coarse(motion: Periodic, speed: float = 1.0) -> np.ndarray:
    """Return one period's positions every `STEP` or so, without the closing one, played at a share of the speed."""
    count = round(motion.period / speed / STEP)
    return motion.orders(np.arange(count) * motion.period / count)[0]


def find_motion(recording: Recording, motion: Periodic, others: Mapping[str, Periodic], wanted: int) -> Heard:
    """Find the designed motion in a recording.

    Args:
        motion: the one that was to be played.
        others: the session's other motions by name, to say if one of them was played instead.
        wanted: how many repetitions were asked for.

    Raises:
        MeasurementError: where it is not there, with what explains the recording.
    """
    grid = np.arange(recording.t[0], recording.t[-1], STEP)
    q = _sampled(recording.t, recording.q, grid)
    reference = coarse(motion)
    try:
        found = find_periods(q, reference, likeness=LIKE)
    except BadInput:
        raise _explain(recording, q, motion, others) from None
    start, stop = grid[found.start], grid[min(found.rows.stop, len(grid) - 1)]
    played = q[found.rows] - np.tile(reference, (found.periods, 1))[: len(q[found.rows])]
    tracking = np.sqrt(np.mean(played**2, axis=0))
    notes = []
    if found.periods < wanted:
        notes.append(f"{found.periods} of {wanted} repetitions of the motion were recorded")
    if (worst := min(found.likeness)) < LOOSE:
        name = recording.joint_names[int(np.argmax(tracking / np.maximum(np.std(reference, axis=0), 1e-9)))]
        notes.append(f"the robot follows the motion loosely (it explains {worst:.1%}), {name} most: that is allowed")
    first, last = float(recording.t[0]), float(recording.t[-1])
    return Heard(
        max(first, float(start) - EDGE), min(last, float(stop) + EDGE), found.periods, tuple(map(float, tracking)),
        tuple(notes),
    )  # fmt: skip


def _sampled(t: np.ndarray, q: np.ndarray, grid: np.ndarray) -> np.ndarray:
    return np.column_stack([np.interp(grid, t, column) for column in q.T])


def _explain(recording: Recording, q: np.ndarray, motion: Periodic, others: Mapping[str, Periodic]) -> MeasurementError:
    """Return what the recording is instead."""
    reference = coarse(motion)
    duration = STEP * len(q)
    for name, other in others.items():
        if _heard(q, coarse(other)):
            return MeasurementError(f"this is the {name} motion, which belongs into a file of its own", recording.file)
    for speed in SPEEDS:
        if _heard(q, coarse(motion, speed)):
            words = f"the motion is there at {speed:g} times its speed: a rehearsal? Record it at full speed"
            return MeasurementError(words, recording.file)
    if len(q) >= len(reference):
        for factor, unit in ((1.0, ""), (np.pi / 180, "deg"), (180 / np.pi, "rad under a header that says deg")):
            order, sign = _best_order(q, reference)
            if _heard(factor * q[:, order] * sign, reference):
                return MeasurementError(_cause(recording, order, sign, unit), recording.file)
    if duration < motion.period:
        words = f"{duration:.1f} s are shorter than one period of the motion ({motion.period:.1f} s): was it stopped?"
        return MeasurementError(words, recording.file)
    return MeasurementError(
        "this is another motion than the one designed here, in no order of joints, sign, unit or speed that was tried; "
        "play 6-excitation's, or set plan = false under [dynamics] in session.toml to identify from this one",
        recording.file,
    )


def _heard(q: np.ndarray, reference: np.ndarray) -> bool:
    try:
        find_periods(q, reference, likeness=LIKE)
    except BadInput:
        return False
    return True


def _cause(recording: Recording, order: np.ndarray, sign: np.ndarray, unit: str) -> str:
    names, causes = recording.joint_names, []
    if unit:
        causes.append(f"its positions are {unit}")
    if moved := [j for j in range(len(names)) if order[j] != j]:
        pairs = ", ".join(f"the column of {names[order[j]]} holds {names[j]}" for j in moved)
        causes.append(f"columns are swapped ({pairs})")
    if (sign < 0).any():
        causes.append(f"the sign is reversed ({', '.join(names[j] for j in np.flatnonzero(sign < 0))})")
    return f"this is the designed motion if {' and '.join(causes)}; correct the header (or the options file)"


def _best_order(q: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which recorded column (n,) moves most like each joint, and with which sign (n,), at any shift."""
    n = reference.shape[1]
    likeness = np.zeros((2, n, n))
    for j in range(n):
        r = reference[:, j] - reference[:, j].mean()
        for k in range(n):
            x = q[:, k] - q[:, k].mean()
            crossed = fftconvolve(x, r[::-1], mode="valid") / max(np.linalg.norm(r), 1e-12)
            power = np.sqrt(np.maximum(fftconvolve(x**2, np.ones(len(r)), mode="valid"), 1e-12))
            likeness[0, j, k], likeness[1, j, k] = (crossed / power).max(), (-crossed / power).max()
    order = linear_sum_assignment(-likeness.max(axis=0))[1]
    rows = np.arange(n)
    return order, np.where(likeness[0, rows, order] >= likeness[1, rows, order], 1.0, -1.0)


def check_torques(recording: Recording, chain: Chain) -> None:
    """Hold torques against those of the nominal masses, friction left free: reversed signs, other units.

    Raises:
        MeasurementError: where the torques of joints that carry much are reversed, or of another size.
    """
    if chain.inertias is None or recording.kind != "torque":
        return
    share, alike, heavy = _against_masses(recording, chain)
    sure = [j for j in np.flatnonzero(heavy) if alike[j] > SURE]
    if not sure:
        return
    names = ", ".join(recording.joint_names[j] for j in sure)
    size = np.abs(share[sure])
    if (size > SCALE).all() or (size < 1 / SCALE).all():
        guess = "are they mNm? Say so in the header (tau_… [mNm])"
        if np.median(size) < 1:
            guess = "are they currents (i_… [A]), or torques before the gear?"
        words = f"the torques of {names} are some {np.median(size):.2g} times what the nominal masses ask for"
        raise MeasurementError(f"{words}: {guess}", recording.file)
    if all(share[j] < 0 for j in sure):
        words = f"the torques of {names} push the wrong way for the nominal masses: reverse their sign"
        raise MeasurementError(words, recording.file)
    if turned := [recording.joint_names[j] for j in sure if share[j] < 0]:
        named, column = ", ".join(turned), f"column{'s' if len(turned) > 1 else ''}"
        raise MeasurementError(
            f"torque of {named} seems to have the wrong sign: it pushes against what the nominal masses ask for, where "
            f"the other joints' do not; negate the {column} of {named} in the log (or correct the nominal masses)",
            recording.file,
        )


def _against_masses(recording: Recording, chain: Chain) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return how much of the nominal masses' torque is in each measured one (n,), how surely, and which carry much.

    Least squares of τ_j on [τ_nominal,j, v_j, sign(v_j), 1]; how surely is the partial correlation with the first.
    """
    grid = np.arange(recording.t[0], recording.t[-1], STEP)
    place = _sampled(recording.t, recording.q, grid)
    q, v, a = (_smooth(place, order) for order in range(3))
    torque = _smooth(_sampled(recording.t, recording.effort, grid))
    rigid = inverse_dynamics(bodies_of(chain), standard_parameters(chain), q, v, a)
    limit = np.array([joint.effort for joint in chain.joints])
    share, alike = np.zeros(chain.n), np.zeros(chain.n)
    for j in range(chain.n):
        others = np.column_stack([v[:, j], np.tanh(v[:, j] / 0.05), np.ones(len(q))])
        left = [x - others @ np.linalg.lstsq(others, x, rcond=None)[0] for x in (rigid[:, j], torque[:, j])]
        power = left[0] @ left[0]
        share[j] = left[0] @ left[1] / max(power, 1e-12)
        alike[j] = abs(left[0] @ left[1]) / max(np.sqrt(power * (left[1] @ left[1])), 1e-12)
    return share, alike, rigid.std(axis=0) > HEAVY * np.where(np.isfinite(limit), limit, 100.0)


def _smooth(values: np.ndarray, order: int = 0) -> np.ndarray:
    """Return values (N, n) on the coarse grid, or their derivatives, by cubics over a moving window."""
    return np.asarray(savgol_filter(values, 2 * SMOOTH + 1, 3, deriv=order, delta=STEP, axis=0))
