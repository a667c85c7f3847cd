"""Closed loops of recordings: reference and controller of every gap-free part, ready for simulation.

The simulation covers a whole part. It is compared with the recording without the filters' borders (2 / f_q) and without
`settling_time`, in which the simulated robot's initial deviation from the true state decays. The simulated motion is
sampled at the recorded times and low-passed like the recording.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from calib.data.signals.bandwidth import USABLE
from calib.data.signals.filtering import Decimator, border, curvature, low_pass, slope
from calib.data.signals.motion import Motion
from calib.errors import CalibError, NotConverged, UsageError, refuse_data
from calib.identification.closed_loop.controllers import (
    IdentifiedController,
    Reference,
    completed,
    identify_controller,
    stated_controller,
)
from calib.identification.closed_loop.simulation import SimulatedRun, plant_of
from calib.identification.closed_loop.timing import check_no_copy, motor_torques, reference_shift
from calib.identification.loop import LoopController, LoopSettings
from calib.identification.rows import Case, segments

DEGREES = 180.0 / np.pi


@dataclass(frozen=True, eq=False)
class Loop:
    """The closed loop in which a recording was made.

    Attributes:
        controller: controller as stated, identified from the log (`calib.identification.closed_loop.controllers`) or
            guessed (a third of the true bandwidth suffices).
        reference: reference at the controller's rate, over the whole duration of the recording, in the recording's
            time.
        every: control periods per recorded sample, not necessarily an integer.
        design: (n,) inertia for which the gains are stated [kg m²]; the simulated robot then gets gains times J(x_k) /
            design, so that its bandwidth is constant (Gautier & Janot). None: the gains are used as stated.
    """

    controller: LoopController
    reference: Reference
    every: float = 1
    design: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class ClosedLoops:
    """Gap-free parts of recordings, each with its closed control loop (reference and controller).

    Attributes:
        pairs: each part and its loop.
        controller: controller of all parts.
        identified: result of identifying the controller from the logs; None if it was stated.
        notes: remarks for the user.
    """

    pairs: tuple[tuple[Case, Loop], ...]
    controller: LoopController
    identified: IdentifiedController | None
    notes: tuple[str, ...]


def close_loops(
    model: Any, cases: Sequence[Case], decimator: Decimator, loop: LoopSettings, cad: np.ndarray | None = None
) -> ClosedLoops:
    """Return the closed control loops of recordings whose motions contain a reference `q_ref`.

    Args:
        model: model of the robot, which can be simulated (`plant_of`).
        cases: recordings.
        decimator: filter of the rows; parts too short for it are omitted.
        loop: settings of the loop.
        cad: standard parameters from the robot's description, for feedforward of kind ``cad``; None: unknown.

    Raises:
        MeasurementError: for a recording without a reference, or with one that it cannot have followed.
        UsageError: for a control rate below the recording's rate, or gains of another number of joints.
    """
    for case in cases:
        _check_reference(case.motion)
    stretches = []
    for case in cases:
        for first, last in segments(case.motion.segment):
            part = take(case, slice(first, last))
            usable = _inside(part.motion)
            if usable.stop - usable.start > 2 * len(decimator.taps):
                stretches.append(part)
    if not stretches:
        refuse_data(cases[0].motion.file, "no part without gaps is long enough to be simulated: record longer")
    ordered = sorted(stretches, key=lambda part: -len(part.motion))
    controller, identified, notes = _controller(loop, ordered[0])
    shifts: dict[str, float] = {}
    # the longest part of each recording tells
    for part in ordered:
        if part.name not in shifts and loop.timing != "stated":
            feed_forward_of = partial(_fed_forward, controller, loop, cad, model)
            shifts[part.name], note = _shift(part, loop, feed_forward_of)
            notes += note
    design = None
    if loop.design:
        design = loop.per_joint("design", model.n)
    pairs = []
    for part in stretches:
        shift = shifts.get(part.name, 0.0)
        reference, every = _make_reference(part.motion, loop.rate, shift)
        feed_forward = _fed_forward(controller, loop, cad, model, part.motion, reference, every)
        if loop.reference_velocity == "difference":
            # by half a period
            rates = np.diff(reference.q, axis=0) / reference.period
            v = np.vstack([reference.v[:1], rates])
            reference = replace(reference, v=v)
        inner = take(part, _inside(part.motion))
        pairs.append((inner, Loop(feed_forward, reference, every, design)))
    return ClosedLoops(tuple(pairs), controller, identified, notes)


def take(case: Case, part: slice) -> Case:
    """Return the part of a case whose samples are in the slice `part`."""
    motion = case.motion.part(part)
    target = case.target[part]
    present = case.present[part]
    return replace(case, motion=motion, target=target, present=present)


def _check_reference(motion: Motion) -> None:
    """Raise an error for a motion's reference that is missing, wrong, in degrees, or a copy of the motion.

    Raises:
        MeasurementError: in these cases.
    """
    if motion.q_ref is None:
        refuse_data(
            motion.file,
            "has no reference positions (columns q_ref1 …, q_des, q_cmd, or [recording] names = { q_ref = '…' }); the "
            "simulation of the closed loop needs them. Log them, or give a file: [loop] reference = '…', or the folder "
            "of the designed motion: --excitation FOLDER; without a reference use wls or irls",
        )
    finite = np.isfinite(motion.q_ref).all(axis=0)
    if not finite.all():
        joint = int(np.argmin(finite))
        refuse_data(
            motion.file,
            f"the reference of {motion.joint_names[joint]} (joint {joint + 1}) is not finite everywhere: cut those "
            "samples out",
        )
    for j in np.flatnonzero(np.ptp(motion.q, axis=0) > 1e-3):
        reference = motion.q_ref[:, j]
        _compare(motion, reference, int(j))
    if motion.located is None:
        reference_q = low_passed(np.asarray(motion.q_ref), motion)
        check_no_copy(motion, reference_q)


def _compare(motion: Motion, reference: np.ndarray, joint: int, max_difference: float = 0.3) -> None:
    """Raise an error if a joint does not follow its `reference` (N,), and name a likely error of units.

    `max_difference`: largest deviation from the reference, relative to the joint's motion (our choice).

    Args:
        motion: the recorded motion.
        reference: (N,) reference of the joint [rad or m].
        joint: index of the joint.
    """
    q = motion.q[:, joint]
    spread = np.std(q)
    size = np.std(reference)
    away = float(np.sqrt(np.mean((q - reference) ** 2)) / spread)
    if away < max_difference:
        return
    name = f"{motion.joint_names[joint]} (joint {joint + 1})"
    alike = False
    if size > 0.0:
        alike = abs(float(np.corrcoef(q, reference)[0, 1])) > 0.95
    if alike and abs(size / spread / DEGREES - 1.0) < 0.1:
        refuse_data(
            motion.file,
            f"the reference of {name} is {size / spread:.3g} times its position: it looks like deg; if so, state it (a "
            f"header 'q_ref{joint + 1} [deg]', or [recording] units = {{ q_ref = 'deg' }})",
        )
    refuse_data(
        motion.file,
        f"{name} deviates from its reference by {away:.2g} times its travel (rms); the reference "
        + (
            f"is {size / spread:.3g} times as large, {np.mean(reference - q):.2g} rad (or m) above it on average"
            if alike
            else "is not correlated with it"
        )
        + "; check that the reference belongs to this recording, has the same joints and starts at the same time",
    )


def _shift(part: Case, loop: LoopSettings, fed_forward: Callable[..., LoopController]) -> tuple[float, tuple[str, ...]]:
    """Return the time [s] by which a recording's reference was played later than stated, and remarks for the user.

    If the reference's time is stated, the result is 0, unless the torques contradict this time.

    Args:
        part: a gap-free part of the recording.
        loop: settings of the loop.
        fed_forward: function of motion, reference and control periods per sample that returns the controller with
            feedforward.

    Raises:
        MeasurementError: if the motors' torques show that the reference is late or early.
        UsageError: for a designed motion without motor torques, from which its time is estimated.
    """
    motion = part.motion
    estimated = part.motion.located is not None or loop.timing == "estimated"
    if motor_torques(part) is None:
        if estimated:
            raise UsageError(
                f"{part.name}: the time of its reference is estimated from motor torques, which rows = "
                f"'{part.torque_rows.name}' do not have; use rows = 'both', or log the reference (q_ref); for method "
                "iv alone, [loop] timing = 'stated' suffices: the reference stays where it matches the positions"
            )
        return 0.0, ()
    reference, every = _make_reference(motion, loop.rate)
    lowest_cutoff = float(motion.cutoff.min())
    band = min(loop.band, 0.5 * lowest_cutoff, 0.2 * motion.rate)
    controller = fed_forward(motion, reference, every)
    shift = reference_shift(part, reference, every, controller, band)
    text = f"{1e3 * abs(shift.seconds):.3g} ± {1e3 * shift.sigma:.2g} ms"
    if estimated:
        begin = (motion.located or 0.0) + shift.seconds
        where = "" if motion.located is None else f"the designed motion begins at {begin:.5f} s, "
        direction = "later" if shift.seconds > 0.0 else "earlier"
        return shift.seconds, (
            f"{part.name}: {where}the reference was moved {text} {direction}; the controller explains "
            f"{100 * (1 - shift.left):.3g} % of the torques, one σ of time changes them by {100 * shift.effect:.2g} %",
        )
    # [s], and shares of the torques (our choice)
    min_shift, min_gain, max_left = 1.5e-3, 2.0, 0.5
    significant = abs(shift.seconds) > max(5.0 * shift.sigma, min_shift)
    if significant and shift.left < max_left and shift.before > min_gain * shift.left:
        message = (
            f"its reference (q_ref) is {'late' if shift.seconds < 0.0 else 'early'} by {text}: "
            f"shifted by this, the controller of [loop] explains {100 * (1 - shift.left):.3g} % of the torques, "
            f"as logged {100 * (1 - min(shift.before, 1.0)):.2g} %. Set [loop] timing = 'estimated' to shift it; or "
            "correct kd and share, which may have the same effect; timing = 'stated' uses the logged times"
        )
        refuse_data(motion.file, message)
    return 0.0, ()


def _make_reference(
    motion: Motion, rate: float | None = None, shift: float = 0.0, cutoff_factor: float = 4.0
) -> tuple[Reference, float]:
    """Return the reference of a gap-free motion at the control rate, and the control periods per recorded sample.

    The reference is delayed by `shift` [s]. The logged positions are low-passed at `cutoff_factor` times f_q (the
    positions' cut-off) and interpolated by a cubic spline, whose derivatives are v and a.

    Args:
        motion: the recorded motion.
        rate: control rate [Hz]; None: the rate of the motion, or the smallest multiple of it that is at least 1 kHz.
        shift: delay [s].
        cutoff_factor: cut-off of the low-pass over f_q; it removes the rounding of the logged reference (our choice).

    Raises:
        UsageError: if the control rate is below the motion's rate.
    """
    every = periods_per_sample(motion, rate)
    cutoff = min(cutoff_factor * float(motion.cutoff.max()), USABLE * motion.rate / 2)
    smooth = low_pass(np.asarray(motion.q_ref), motion.rate, cutoff)
    spline = CubicSpline(np.arange(len(smooth)), smooth)
    count = int((len(smooth) - 1) * every + 1e-9) + 1
    indices = np.arange(count) / every
    times = np.clip(indices - shift * motion.rate, 0.0, len(smooth) - 1.0)
    q, v, a = (spline(times, order) * motion.rate**order for order in range(3))
    return Reference(motion.t[0] + indices / motion.rate, q, v, a), every


def periods_per_sample(motion: Motion, rate: float | None = None) -> float:
    """Return the control periods per recorded sample, not always an integer.

    Args:
        motion: the recorded motion.
        rate: control rate [Hz]; None: the rate of the motion, or the smallest multiple of it that is at least
            `min_rate`.

    Raises:
        UsageError: if the control rate is below the motion's rate.
    """
    # of a controller whose rate is not stated [Hz] (our choice)
    min_rate = 1000.0
    if rate is None:
        return max(1, int(np.ceil(min_rate / motion.rate - 1e-6)))
    every = round(rate / motion.rate)
    # of a control rate that is near a multiple of the log's, by which it is that: clocks are not exact
    max_rounding = 0.001
    if rate < (1.0 - max_rounding) * motion.rate:
        raise UsageError(
            f"[loop] rate: {rate:g} Hz is below {motion.rate:.6g} Hz, the rate of {motion.file}: no controller is "
            "slower than its log; check the unit (Hz)"
        )
    if abs(rate / motion.rate - every) <= max_rounding * every:
        return every
    return rate / motion.rate


def _inside(motion: Motion, settling_time: float = 0.2) -> slice:
    """Return the slice of samples that are compared with the simulation: without settling time and filter borders.

    `settling_time`: time after which the simulated robot's initial state has no effect [s] (our choice).

    Args:
        motion: the recorded motion.
        settling_time: time [s].
    """
    edge = max(border(motion.rate, float(motion.cutoff.min())), 4)
    settling_samples = int(np.ceil(settling_time * motion.rate))
    return slice(max(edge, settling_samples), len(motion) - edge)


def _controller(loop: LoopSettings, case: Case) -> tuple[LoopController, IdentifiedController | None, tuple[str, ...]]:
    """Return the controller, the result of its identification (None if it is stated), and remarks for the user.

    Args:
        loop: settings of the loop.
        case: the longest part, from which a controller is identified if requested.
    """
    n = case.motion.n
    if loop.controller != "identify":
        return stated_controller(loop, n), None, ()
    motion = case.motion
    tau = motor_torques(case)
    if tau is None:
        raise UsageError(f"[loop] controller = 'identify' needs motor torques, not rows = '{case.torque_rows.name}'")
    lowest_cutoff = float(motion.cutoff.min())
    band = min(loop.band, lowest_cutoff, 0.4 * motion.rate)

    def identified(shift: float) -> IdentifiedController:
        reference, _ = _make_reference(motion, loop.rate, shift)
        if loop.integral:
            orders = (1, 2)
        else:
            orders = (0, 1)
        return identify_controller(reference, motion.q, tau, motion.rate, band, orders, loop.integral)

    identified_controller = identified(
        _best_shift(identified) if motion.located is not None or loop.timing == "estimated" else 0.0
    )
    kp = identified_controller.controller.kp
    kd = identified_controller.controller.kd
    bad = np.flatnonzero((kp <= 0.0) | (kd <= 0.0))
    gains = ", ".join(
        f"{x:.4g}/{y:.3g} ({share:.0f} %)" for x, y, share in zip(kp, kd, identified_controller.explained)
    )
    if len(bad):
        raise NotConverged(
            f"{case.name}: the log does not identify the controller of joint {bad[0] + 1} (kp/kd by joint: {gains}); "
            "state the gains, or lower [loop] band",
            identified_controller,
        )
    note = f"controller identified from {case.name} up to {band:.3g} Hz, kp/kd (explained torque): {gains}"
    return completed(identified_controller.controller, loop, n), identified_controller, (note,)


def _best_shift(identified: Callable[[float], IdentifiedController]) -> float:
    """Return the shift of the reference [s] with which the identified controller best explains the torques.

    Args:
        identified: function of the shift that returns the identified controller.
    """
    # within 0.03 s of where positions match best (our choice)
    middle, step = 0.0, 0.01
    while step > 1e-6:
        candidates = middle + step * np.arange(-3, 4)
        middle = max(candidates, key=lambda shift: float(np.mean(identified(shift).explained)))
        step = step / 3.0
    return float(middle)


def _fed_forward(
    controller: LoopController,
    loop: LoopSettings,
    cad: np.ndarray | None,
    model: Any,
    motion: Motion,
    reference: Reference,
    every: float,
) -> LoopController:
    """Return the controller with feedforward torques along the reference, as the settings require.

    Args:
        controller: controller without feedforward.
        loop: settings of the loop.
        cad: standard parameters from the robot's description, for feedforward of kind ``cad``; None: unknown.
        model: model of the robot.
        motion: the recorded motion.
        reference: reference at the controller's rate.
        every: control periods per recorded sample.
    """
    if loop.feedforward == "none":
        return controller
    if loop.feedforward == "recording":
        if motion.tau_ff is None:
            refuse_data(motion.file, "[loop] feedforward: the recording has no column tau_ff")
        grid = np.arange(len(motion))
        samples = np.arange(len(reference.t)) / every
        torque = CubicSpline(grid, motion.tau_ff)(samples)
        return controller.with_feedforward(torque)
    if cad is None:
        raise UsageError("[loop] feedforward = 'cad': the robot's description states no masses")
    no_drives = np.zeros(model.p - len(cad))
    values = np.append(cad, no_drives)
    believed = plant_of(model, values)
    return controller.with_feedforward(believed.feed_forward(reference))


def simulated_case(case: Case, run: SimulatedRun, loop: Loop) -> Case:
    """Return the case with the simulated motion at the recorded times, filtered like the recorded motion.

    Low-pass and differences round off reversals of a motion. Since both motions are filtered equally, this affects the
    observation matrix W and the instruments Z equally, so that they differ by noise only.

    Args:
        case: a gap-free part of a recording.
        run: simulation of its loop.
        loop: loop of the recording.
    """
    samples = simulated_samples(case, run.t, loop)
    q, v, a = followed(run.q, case.motion, samples)
    motion = replace(case.motion, q=q, v=v, a=a)
    return replace(case, motion=motion)


def followed(q: np.ndarray, motion: Motion, index: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return q, v, a (M, n, ...) from simulated positions, filtered and differentiated like the recorded motion.

    Args:
        q: (N, n, ...) positions of the whole simulation, or their derivatives with respect to parameters.
        motion: the recorded motion.
        index: (M,) indices of the samples to return.
    """
    positions = low_passed(q, motion, motion.cutoff)
    less = low_passed(q, motion, motion.velocity_cutoff)
    velocity = slope(less, motion.rate)[index]
    acceleration = curvature(positions, motion.rate)[index]
    return positions[index], velocity, acceleration


def simulated_samples(case: Case, t: np.ndarray, loop: Loop) -> np.ndarray:
    """Return the index of the simulated sample at the time of each sample of a case.

    Args:
        case: the recording.
        t: simulated times [s].
        loop: loop of the recording.

    Raises:
        CalibError: if the simulation does not cover the recording's times.
    """
    step = loop.reference.period * loop.every
    since = case.motion.t - loop.reference.t[0]
    index = np.rint(since / step).astype(int)
    if index[0] < 0 or index[-1] >= len(t) or np.abs(index * step - since).max() > 0.01 * step:
        raise CalibError(
            f"the recording runs from {case.motion.t[0]:.6g} s to {case.motion.t[-1]:.6g} s in steps of "
            f"{1 / case.motion.rate:.6g} s, the simulation from {t[0]:.6g} s to {t[-1]:.6g} s in steps of "
            f"{step:.6g} s; give the whole reference and `every`"
        )
    return index


def low_passed(q: np.ndarray, motion: Motion, cutoff: np.ndarray | None = None) -> np.ndarray:
    """Return simulated positions (N, n), or their derivatives (N, n, ...), low-passed like the recorded positions.

    Args:
        q: (N, n, ...) values at the recording's rate.
        motion: the recorded motion.
        cutoff: (n,) another cut-off [Hz]; None: that of the recorded positions.
    """
    result = np.empty_like(q)
    cutoffs = motion.cutoff if cutoff is None else cutoff
    for f in np.unique(cutoffs):
        joints = cutoffs == f
        result[:, joints] = low_pass(q[:, joints], motion.rate, float(f))
    return result
