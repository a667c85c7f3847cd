"""Joint compliance from recordings with encoders on both sides of the gears, and the difference that a fit predicts.

    q_link,j - q_j = o_j + c_j τ_j - T v_j + e_j

with c_j the compliance of `calib.robot.calibrated` (-1 / stiffness: τ_j is the torque that carries the bodies), o_j a
constant of each recording, and T the time by which the second encoders' samples are older than the motors', common to
all joints. τ_j is the bodies' torque of an identified model, gravity and inertia: motor torques contain the friction
before the gear, and a torque in phase with speed cannot be told from T.

Errors are not noise (backlash, eccentric encoders, errors of the torque). The variance is therefore that of the
delete-one jackknife over blocks of time (Künsch 1989), plus the mean square by which the compliance changes with terms
for such errors: in phase with acceleration or with the sign of the speed, and once per turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.dynamics.idim import IdentificationModel
from calib.dynamics.regressor_model import RegressorModel
from calib.identification.prediction import Dynamics
from calib.identification.rows import Case

BLOCKS = 10
"""Blocks of time of the jackknife, over all recordings (our choice)."""
MIN_TORQUE = 1e-6
"""Range of a joint's torque [N m or N] from which on its compliance can be told."""
ERROR_TERMS = ((0,), (1,), (2, 3), (0, 1, 2, 3))
"""Terms of errors that are added in turn: acceleration, sign of the speed, cosine and sine of the position."""
CREEP = 1e-2
"""Speed below which the sign of the speed is smoothed [rad/s or m/s]."""
SURE_SIGMAS = 3.0
"""Standard deviations from zero from which on a compliance is identified (our choice)."""
ROUNDS = 4
"""Rounds of weighing joints by their residuals."""


@dataclass(frozen=True)
class JointCompliance:
    """Compliance of one joint, and how it explains the difference of the joint's encoders.

    Attributes:
        joint: index of the joint.
        compliance, sigma: compliance and its standard deviation [rad/N m or m/N].
        difference: rms difference of the encoders about its mean [rad or m].
        delayed: the same without the part of the delay.
        residual: the part that delay and compliance leave.
    """

    joint: int
    compliance: float
    sigma: float
    difference: float
    delayed: float
    residual: float

    @property
    def identified(self) -> bool:
        """Whether the recordings tell the compliance: it is that of an elastic joint, by `SURE_SIGMAS`."""
        return self.compliance < -SURE_SIGMAS * self.sigma


@dataclass(frozen=True)
class EncoderDifference:
    """Differences of motor and link encoders.

    Attributes:
        joints: the joints with two encoders, in the order of the arm.
        delay, delay_sigma: time by which the link encoders' samples are older, with its standard deviation [s].
    """

    joints: tuple[JointCompliance, ...]
    delay: float
    delay_sigma: float


@dataclass(frozen=True, eq=False)
class _Samples:
    """Samples of one joint: difference, torque and speed (N,), recording and block (N,), and terms of errors (N, 4)."""

    difference: np.ndarray
    torque: np.ndarray
    speed: np.ndarray
    recording: np.ndarray
    block: np.ndarray
    errors: np.ndarray


def encoder_difference(dynamics: Dynamics[RegressorModel], cases: Sequence[Case]) -> EncoderDifference | None:
    """Return the compliance of joints with two encoders; None if no recording has link encoders, or no body is known.

    Args:
        dynamics: the identified model, which gives the bodies' torques.
        cases: recordings.
    """
    model = dynamics.model
    if not isinstance(model, IdentificationModel) or not model.inertial:
        return None
    by_joint = _samples(Dynamics(model, dynamics.values), cases)
    if not by_joint:
        return None
    values, residuals = _solve(by_joint)
    jackknife = np.array([_solve(by_joint, omitted=block)[0] for block in range(BLOCKS)])
    deviations = jackknife - jackknife.mean(axis=0)
    variances = (BLOCKS - 1) / BLOCKS * np.sum(deviations**2, axis=0)
    with_errors = np.array([_solve(by_joint, terms=terms)[0] for terms in ERROR_TERMS])
    variances += np.mean((with_errors - values) ** 2, axis=0)
    sigmas = np.sqrt(variances)
    joints = []
    for k, (joint, samples) in enumerate(by_joint.items()):
        without_delay = samples.difference + values[0] * samples.speed
        joints.append(
            JointCompliance(
                joint=joint,
                compliance=float(values[1 + k]),
                sigma=float(sigmas[1 + k]),
                difference=_spread(samples.difference, samples.recording),
                delayed=_spread(without_delay, samples.recording),
                residual=float(np.sqrt(np.mean(residuals[k] ** 2))),
            )
        )
    return EncoderDifference(tuple(joints), float(values[0]), float(sigmas[0]))


def _samples(dynamics: Dynamics[IdentificationModel], cases: Sequence[Case]) -> dict[int, _Samples]:
    """Return the samples of every joint whose link encoder was recorded and whose torque changes, by joint."""
    parts: dict[int, list[np.ndarray]] = {}
    with_encoders = [case for case in cases if case.motion.q_link is not None]
    for number, case in enumerate(with_encoders):
        motion = case.motion
        torque = motion.in_band(dynamics.transmitted(case))
        difference = motion.in_band(np.nan_to_num(np.asarray(motion.q_link - motion.q)))
        recorded = np.isfinite(np.asarray(motion.q_link)).all(axis=0)
        count = len(motion)
        share = max(1, BLOCKS // len(with_encoders))
        block = (number * share + np.arange(count) * share // count) % BLOCKS
        for joint in np.flatnonzero(recorded & (np.ptp(torque, axis=0) > MIN_TORQUE)).tolist():
            q = motion.q[:, joint]
            v = motion.v[:, joint]
            errors = [motion.a[:, joint], np.tanh(v / CREEP), np.cos(q), np.sin(q)]
            columns = [difference[:, joint], torque[:, joint], v, np.full(count, number), block, *errors]
            parts.setdefault(joint, []).append(np.column_stack(columns))
    result = {}
    for joint in sorted(parts):
        stacked = np.concatenate(parts[joint])
        result[joint] = _Samples(*stacked[:, :5].T, stacked[:, 5:])
    return result


def _solve(
    by_joint: dict[int, _Samples], omitted: int | None = None, terms: tuple[int, ...] = ()
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the delay and the compliances (1 + joints,), with the residuals of each joint.

    Constants of recordings are eliminated by subtracting means, terms of errors by projection.

    Args:
        by_joint: samples by joint.
        omitted: block of time that is left out; None: none.
        terms: terms of errors that are added.
    """
    blocks = []
    for samples in by_joint.values():
        rows = np.ones(len(samples.block), dtype=bool)
        if omitted is not None:
            rows = samples.block != omitted
        columns = np.column_stack([samples.difference, -samples.speed, samples.torque])[rows]
        errors = samples.errors[rows][:, list(terms)]
        centred = _centred(np.column_stack([columns, errors]), samples.recording[rows])
        if terms:
            basis = np.linalg.qr(centred[:, 3:])[0]
            centred = centred[:, :3] - basis @ (basis.T @ centred[:, :3])
        blocks.append(centred)
    weights = np.ones(len(blocks))
    values = np.zeros(1 + len(blocks))
    residuals: list[np.ndarray] = []
    for _ in range(ROUNDS):
        square = np.zeros((len(values), len(values)))
        target = np.zeros(len(values))
        for k, (block, weight) in enumerate(zip(blocks, weights)):
            index = [0, 1 + k]
            square[np.ix_(index, index)] += weight * block[:, 1:].T @ block[:, 1:]
            target[index] += weight * block[:, 1:].T @ block[:, 0]
        scale = np.sqrt(np.diag(square))
        scale[scale == 0.0] = 1.0
        values = np.linalg.lstsq(square / np.outer(scale, scale), target / scale, rcond=None)[0] / scale
        residuals = [block[:, 0] - block[:, 1:] @ values[[0, 1 + k]] for k, block in enumerate(blocks)]
        squares = np.array([np.mean(residual**2) for residual in residuals])
        weights = 1.0 / np.maximum(squares, 1e-300)
        weights = weights / weights.max()
    return values, residuals


def _centred(columns: np.ndarray, recording: np.ndarray) -> np.ndarray:
    """Return columns (N, k) without their means over each recording."""
    centred = np.array(columns)
    for number in np.unique(recording):
        rows = recording == number
        centred[rows] -= centred[rows].mean(axis=0)
    return centred


def _spread(values: np.ndarray, recording: np.ndarray) -> float:
    """Return the rms of values (N,) about their means over each recording."""
    return float(np.sqrt(np.mean(_centred(values[:, None], recording) ** 2)))


def compared(
    stated_compliances: Sequence[JointCompliance], dynamics: Dynamics[RegressorModel], cases: Sequence[Case]
) -> EncoderDifference | None:
    """Return how compliances of another source (a fit of poses, other recordings) explain recordings.

    The compliances are as stated; the delay, of which they say nothing, is estimated. ``residual`` is what both leave,
    to be compared with that of `encoder_difference`.

    Args:
        stated_compliances: compliances and their standard deviations.
        dynamics: the identified model, which gives the bodies' torques.
        cases: recordings with link encoders.
    """
    estimate = encoder_difference(dynamics, cases)
    model = dynamics.model
    if estimate is None or not isinstance(model, IdentificationModel):
        return None
    by_joint = _samples(Dynamics(model, dynamics.values), cases)
    compliance_of = {joint.joint: joint for joint in stated_compliances}
    joints = []
    for joint in estimate.joints:
        stated = compliance_of.get(joint.joint)
        if stated is None:
            continue
        samples = by_joint[joint.joint]
        error = samples.difference + estimate.delay * samples.speed - stated.compliance * samples.torque
        joints.append(
            JointCompliance(
                joint=joint.joint,
                compliance=stated.compliance,
                sigma=stated.sigma,
                difference=joint.difference,
                delayed=joint.delayed,
                residual=_spread(error, samples.recording),
            )
        )
    return EncoderDifference(tuple(joints), estimate.delay, estimate.delay_sigma)
