"""Time of a reference in its recording: the time shift δ with which the stated controller best explains the torques.

    y_j(t) = C_j(q_ref(t - δ) - q(t)) + c_j,    min over δ of Σ_j ‖y_j - C_j - c_j‖² / σ_j²    (our choice)

C is the control law with its gains, delays and feedforward, y are the logged torques, c_j constants. Gauss–Newton steps
start at the shift with which positions match best, which is too late by the tracking lag. No model of the robot is
used, so that unknown friction or masses have no influence; wrong gains do. A reference that equals the measured
positions to their last digit is a copy of them and is refused.
"""

from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy.interpolate import CubicSpline

from calib.data.signals.filtering import border, low_pass
from calib.data.signals.motion import Motion
from calib.errors import NotConverged, refuse_data
from calib.estimation.whiteness import inflation
from calib.identification.closed_loop.controllers import Reference
from calib.identification.loop import LoopController
from calib.identification.rows import Case

# [s] by which a reference may be off (this and all below: our choice)
MAX_SHIFT = 0.5


@dataclass(frozen=True)
class ReferenceShift:
    """Shift of a reference in time.

    Attributes:
        seconds, sigma: time by which the reference is later than stated, and its standard deviation [s].
        left, before: share of the torque that the controller does not explain, with this shift and without it; only the
            part of the torque correlated with the reference's motion counts.
        effect: rms change of the torque if the reference moves by one sigma, as a share of the torque's standard
            deviation.
    """

    seconds: float
    sigma: float
    left: float
    before: float
    effect: float


def reference_shift(
    case: Case, reference: Reference, every: float, controller: LoopController, band: float
) -> ReferenceShift:
    """Return the time by which the reference of a gap-free part of a recording was played later than stated.

    Args:
        case: the part, with motor torques.
        reference: reference at the controller's rate, from the part's first sample on.
        every: control periods per sample.
        controller: the controller that followed the reference.
        band: cut-off of the low-pass of torques and positions [Hz].

    Raises:
        NotConverged: if no shift within `MAX_SHIFT` explains the torques best.
    """
    law = _Law(case, reference, every, controller, band)
    t = law.t[law.rows]
    shift = _by_positions(law.asked, law.measured, t)
    max_steps = 30
    steps = 0
    while True:
        steps += 1
        residual, slopes = law.linearised(shift)
        weighted = slopes / np.maximum(residual.var(axis=0), 1e-300)
        information = float(np.sum(weighted * slopes))
        step = float(np.sum(weighted * residual)) / max(information, 1e-300)
        shift += step
        if abs(step) < 1e-8:
            break
        if abs(shift) > MAX_SHIFT:
            raise NotConverged(f"{case.name}: no shift of the reference in time explains the torques: check [loop]")
        if steps == max_steps:
            break
    tau = np.mean([inflation(column) for column in residual.T])
    sigma = float(np.sqrt(tau / max(information, 1e-300)))
    torque = law.torque(law.t, 0)[law.rows]
    rise = law.torque(law.t, 1)[law.rows]
    variance_ratio = rise.var(axis=0) / np.maximum(torque.var(axis=0), 1e-300)
    effect = float(sigma * np.sqrt(np.mean(variance_ratio)))
    return ReferenceShift(shift, sigma, *law.left(shift), effect)


class _Law:
    """Control law of a recording, with low-passed reference, measured positions and torques as splines in time."""

    def __init__(self, case: Case, reference: Reference, every: float, controller: LoopController, band: float) -> None:
        rate = case.motion.rate
        n = case.motion.n
        self.controller = controller
        self.t = np.arange(len(case.motion)) / rate
        ticks = np.arange(len(self.t)) * every
        asked_q, *_ = reference.at(ticks)
        torques = cast(np.ndarray, motor_torques(case))
        parts = (asked_q, case.motion.q, torques)
        self.asked, self.measured, self.torque = (CubicSpline(self.t, low_pass(x, rate, band)) for x in parts)
        self.ahead = np.zeros((len(self.t), n))
        if controller.ahead is not None:
            ahead = CubicSpline(np.arange(len(controller.ahead)), controller.ahead)(ticks)
            self.ahead = low_pass(ahead, rate, band)
        edge = border(rate, band)
        # saturated ones follow no law
        free = (np.abs(parts[2]) < 0.98 * controller.limit).all(axis=1)
        samples = np.arange(len(self.t))
        is_inside = (samples >= edge) & (samples < len(self.t) - edge)
        self.rows = np.flatnonzero(is_inside & free)
        self.late = controller.delay * reference.period
        if controller.cutoff is None:
            lag = 0.0
        else:
            lag = 1.0 / (2 * np.pi * controller.cutoff)
        # the measured speed is a backward difference
        self.speed_late = self.late + 0.5 * reference.period + lag

    def linearised(self, shift: float) -> tuple[np.ndarray, np.ndarray]:
        """Return residual torques (M, n) minus their means, and the control law's derivative by the shift (M, n).

        Args:
            shift: time by which the reference is later than stated [s].
        """
        controller = self.controller
        instants = self.t - self.late
        shifted = np.clip(instants - shift, self.t[0], self.t[-1])
        q_ref = self.asked(shifted, 0)
        v_ref = self.asked(shifted, 1)
        a_ref = self.asked(shifted, 2)
        error = q_ref - self.measured(instants)
        speed = controller.share * v_ref - self.measured(self.t - self.speed_late, 1)
        step = self.t[1] - self.t[0]
        sums = np.cumsum(error, axis=0) * step
        law = controller.kp * error + controller.kd * speed + controller.ki * sums + self.ahead
        slopes = -(controller.kp * v_ref + controller.kd * controller.share * a_ref + controller.ki * q_ref)
        residual = (self.torque(self.t) - law)[self.rows]
        slopes = slopes[self.rows]
        return residual - residual.mean(axis=0), slopes - slopes.mean(axis=0)

    def left(self, shift: float) -> tuple[float, float]:
        """Return the shares of the torques that the control law does not explain, with the shift and without it.

        Only those parts of torques and residuals count that are correlated with the reference (shifted or not) and its
        derivatives, joint by joint, so that position noise in the law cannot hide a delay (our choice).
        """
        times = self.t[self.rows]
        derivatives = []
        for delay in (shift, 0.0):
            instants = np.clip(times - delay, self.t[0], self.t[-1])
            derivatives += [self.asked(instants, order) for order in range(3)]
        reference = np.array(derivatives)
        scale = np.maximum(reference.std(axis=1, keepdims=True), 1e-300)
        reference = (reference - reference.mean(axis=1, keepdims=True)) / scale
        orthonormal, _ = np.linalg.qr(reference.transpose(2, 1, 0))
        along = orthonormal.transpose(0, 2, 1)

        def projected(torques: np.ndarray) -> np.ndarray:
            along_reference = along @ torques.T[:, :, None]
            return np.sum(along_reference**2, axis=(1, 2))

        size = np.maximum(projected(self.torque(times)), 1e-300)
        residual_shifted, _ = self.linearised(shift)
        residual_stated, _ = self.linearised(0.0)
        shifted_share = float(np.sqrt(np.mean(projected(residual_shifted) / size)))
        stated_share = float(np.sqrt(np.mean(projected(residual_stated) / size)))
        return shifted_share, stated_share


def _by_positions(reference: CubicSpline, measured: CubicSpline, t: np.ndarray) -> float:
    """Return the shift [s] of the reference with which it is nearest to the measured positions, at times t (M,).

    Args:
        reference, measured: reference and measured positions as splines in time.
        t: (M,) times [s].
    """
    shift = 0.0
    low = float(reference.x[0])
    high = float(reference.x[-1])
    for _ in range(30):
        residual = measured(t) - reference(np.clip(t - shift, low, high))
        slopes = -reference(np.clip(t - shift, low, high), 1)
        size = np.maximum(measured(t).var(axis=0), 1e-300)
        gradient = np.sum(residual * slopes / size)
        curvature = max(np.sum(slopes**2 / size), 1e-300)
        step = float(gradient / curvature)
        shift = float(np.clip(shift + step, -MAX_SHIFT, MAX_SHIFT))
        if abs(step) < 1e-9:
            break
    return shift


def motor_torques(case: Case) -> np.ndarray | None:
    """Return the motors' torques (N, n) of a case [N m or N]; None if rows and recording do not contain them."""
    if case.torque_rows.with_motors:
        return case.target[:, -case.motion.n :]
    projected = case.torque_rows.projection is not None and case.motion.kind == "torque"
    if projected:
        return np.asarray(case.motion.effort)
    return None


def check_no_copy(motion: Motion, reference_q: np.ndarray) -> None:
    """Raise an error for a reference that is the measured motion, perhaps shifted in time, rounded or low-passed.

    After the motion has ended, measured positions contain only noise; a reference that also contains this noise is a
    copy.

    Args:
        motion: the recorded motion.
        reference_q: (N, n) the reference, filtered like the measured positions.

    Raises:
        MeasurementError: for a copy; the message states the shift.
    """
    moves = np.ptp(motion.q, axis=0) > 1e-3
    t = np.arange(len(motion)) / motion.rate
    # the filters' ends differ
    edge = 4 * border(motion.rate, float(motion.cutoff.min()))
    rows = t[edge:-edge]
    if len(rows) < 10 or not moves.any():
        return
    measured = CubicSpline(t, motion.q[:, moves])
    reference = CubicSpline(t, reference_q[:, moves])
    shift = _by_positions(reference, measured, rows)
    shifted = np.clip(rows - shift, t[0], t[-1])
    residual = measured(rows) - reference(shifted)
    # of the positions' noise in the band; no commanded motion has that of the encoders
    share = 0.01
    all_noise = motion.cutoffs.noise * np.sqrt(2.0 * motion.cutoff / motion.rate)
    noise = all_noise[moves]
    rms = np.sqrt(np.mean(residual**2, axis=0))
    rounding = 1e-7 * measured(rows).std(axis=0)
    exact = rms < np.maximum(share * noise, rounding)
    joints = np.flatnonzero(moves)
    shares = _noise_shares(motion, measured(rows), residual, joints)
    # of the noise's power in the distance from a copy; from a commanded motion it is all (our choice)
    max_share = 0.1
    if exact.all() or (len(shares) and np.median(shares) < max_share):
        note = f", {1e3 * -shift:.4g} ms later" if abs(shift) > 1e-5 else ""
        refuse_data(
            motion.file,
            f"its reference (q_ref) is the measured positions{note}: instruments from it contain the noise that they "
            "are to avoid. Log what was commanded (UR: target_q, Franka: q_d), or give the folder of the designed "
            "motion (--excitation)",
        )


def _noise_shares(motion: Motion, measured: np.ndarray, residual: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Return the ratio of the noise powers in `residual` and in the `measured` positions, joint by joint.

    Both powers are taken in the lowest octave below the positions' cut-off in which the spectrum of the positions is at
    its noise floor. Joints without such an octave are omitted.

    Args:
        motion: the recorded motion.
        measured, residual: (N, k) measured positions, and their deviation from the reference.
        joints: (k,) joints of the columns.
    """
    # slow to load
    from scipy.signal import welch

    # windows of 4 s
    size = min(len(measured), max(64, int(4.0 * motion.rate)))
    f, power = welch(measured, motion.rate, "hann", size, detrend="linear", axis=0)
    spectrum = welch(residual, motion.rate, "hann", size, detrend="linear", axis=0)[1]
    floor = 2.0 * motion.cutoffs.noise[joints] ** 2 / motion.rate
    # times the floor that are still noise; frequencies that make a spectrum (our choice)
    above, min_bins = 4.0, 8
    result = []
    for column, joint in enumerate(joints):
        in_band = (f > 0.0) & (f < 0.8 * motion.cutoff[joint])
        quiet = (power[:, column] < above * floor[column]) & in_band
        octave = quiet & (f <= 2.0 * f[np.argmax(quiet)])
        if octave.sum() >= min_bins:
            share = spectrum[octave, column].sum() / power[octave, column].sum()
            result.append(share)
    return np.array(result)
