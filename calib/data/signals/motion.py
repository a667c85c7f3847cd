"""Motion for identification from a raw recording: filtered positions, derivatives and torques on an even time grid.

`Motion` is the only type with accelerations, so that an unfiltered log cannot be used in a regressor. Its torques are
unfiltered, interpolated on the grid. The parallel decimation later filters the torques and every column of the
regressor W by one filter (`calib.data.signals.filtering`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from scipy.interpolate import CubicSpline

from calib.config import strict
from calib.config_types import OneOf, OneOrMany, Positive, Real, Whole
from calib.data.recordings.archives import read_archived_positions
from calib.data.recordings.column_faults import ColumnFault
from calib.data.recordings.recording import Recording
from calib.data.recordings.recording_files import read_positions
from calib.data.recordings.recording_options import RecordingOptions
from calib.data.schema import Joints
from calib.data.signals import filtering
from calib.data.signals.bandwidth import USABLE, Cutoffs, check_cutoff, propose_cutoffs
from calib.data.signals.resampling import CLOCKS, GAP, Resampled, SamplingReport, resample
from calib.errors import MeasurementError, UsageError, refuse_data, refused_as, require
from calib.files import check_regular
from calib.records import FieldValues, frozen, read_only

# Share of a joint's peak speed below which it stands, for friction (the TX40's own thresholds are this share).
STANDSTILL_SHARE = 0.01
# Largest ratio of f_v to f_q (our choice).
MAX_CUTOFF_RATIO = 5.0
# No joint moves below this speed [rad/s or m/s].
CREEP = 1e-3
# Share of the accelerations' rms that noise may have at the velocities' cut-off (our choice).
MAX_NOISE = 0.1
# Least number of samples of a reference.
MIN_REFERENCE_SAMPLES = 10

# Fields of a motion with one entry per sample.
ROWS = (
    "t",
    "q",
    "v",
    "a",
    "effort",
    "weight",
    "segment",
    "tau_link",
    "tau_motor",
    "q_link",
    "q_ref",
    "tau_ff",
    "q_measured",
    "v_measured",
)


@strict
@dataclass(frozen=True)
class FilterOptions:
    """Options of filtering a recording; None: chosen from the data (`calib.data.signals.bandwidth`).

    Attributes:
        cutoff: cut-off f_q of the positions' Butterworth filter [Hz]; one number, or one per joint.
        velocity_cutoff: cut-off f_v of the positions that velocities are computed from [Hz]; None: f_q if that is
            stated, else above it.
        order: order of the Butterworth filter in one pass; it runs forwards and backwards.
        band: cut-off f_p of the parallel decimation [Hz]; torques are compared below it.
        dynamics: bandwidth f_dyn of the robot's motion [Hz], if known.
        width: samples on each side that the central differences use.
        clock: how samples are dated: by their stamps, evenly, or by counting steps (auto: the smoothest positions).
        gap: longest time without a sample that is interpolated [s].
        borders: time removed at both ends of each segment [s].
        decimator: low-pass filter of the decimation.
    """

    cutoff: Annotated[float | tuple[float, ...], OneOrMany(Real(above=0))] | None = None
    velocity_cutoff: Annotated[float | tuple[float, ...], OneOrMany(Real(above=0))] | None = None
    order: Annotated[int, Whole(1, 12)] = filtering.ORDER
    band: Positive | None = None
    dynamics: Positive | None = None
    width: Annotated[int, Whole(1, 4)] = 4
    clock: Annotated[str, OneOf(("auto", *CLOCKS))] = "auto"
    gap: Positive = GAP
    borders: Positive | None = None
    decimator: Annotated[str, OneOf(filtering.KINDS)] = "kaiser"


@dataclass(frozen=True, eq=False)
class Motion:
    """Filtered motion: N samples on an even time grid, in segments without gaps.

    At a change of sign of the velocity, Coulomb friction makes the acceleration fall by 2 Fc / M, which is a corner in
    the course of the velocity. A filter rounds this corner and delays the velocity's zero. The friction's column in the
    regressor is then late, and the motor inertia Ia is estimated too large (by 2 % at f_q = 10 Hz on a simulated
    LWR4+). Velocities tolerate more noise than accelerations, and therefore have a separate, higher cut-off.

    Attributes:
        t: (N,) times [s], in steps of 1/rate within a segment.
        q, v, a: (N, n) filtered position [rad or m], and velocity [/s] and acceleration [/s²] by central differences.
        effort: (N, n) torque [N·m or N] or current [A] (`kind`), not filtered; interpolated where a sample is missing
            (weight 0).
        weight: (N,) 1 at a sample, 0 at a lost one that was interpolated.
        segment: (N,) number of each sample's segment, increasing.
        rate: sampling rate [Hz].
        band: cut-off f_p of the parallel decimation, the identification band [Hz].
        cutoff: (n,) cut-off f_q of the positions [Hz].
        velocity_cutoff: (n,) cut-off f_v of the positions from which v is computed [Hz].
        decimator: the filter of the parallel decimation to `band`.
        joint_names, kind, file, drive_gain, effort_variance: those of the recording.
        tau_link, tau_motor, q_link, q_ref, tau_ff, q_measured, v_measured: (N, n) further series of the recording on
            the grid, not filtered; None if not recorded.
        sampling, cutoffs: reports of resampling and of the choice of cut-offs.
        notes: remarks for the user.
        jumps, faults: those of the recording.
        hashes: hashes of the recording's samples, sorted, by which it is recognised; None: not computed.
        located: time at which a designed motion, used as the reference, begins [s]; None for another reference.
    """

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    effort: np.ndarray
    kind: str
    weight: np.ndarray
    segment: np.ndarray
    rate: float
    band: float
    cutoff: np.ndarray
    velocity_cutoff: np.ndarray
    decimator: filtering.Decimator
    joint_names: tuple[str, ...]
    file: str
    sampling: SamplingReport
    cutoffs: Cutoffs
    notes: tuple[str, ...]
    tau_link: np.ndarray | None = None
    tau_motor: np.ndarray | None = None
    q_link: np.ndarray | None = None
    q_ref: np.ndarray | None = None
    tau_ff: np.ndarray | None = None
    q_measured: np.ndarray | None = None
    v_measured: np.ndarray | None = None
    drive_gain: np.ndarray | None = None
    effort_variance: np.ndarray | None = None
    jumps: tuple[str, ...] = ()
    faults: tuple[ColumnFault, ...] = ()
    located: float | None = None
    hashes: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.t)

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.q.shape[1]

    def part(self, rows: slice) -> "Motion":
        """Return the motion with only the samples in the slice `rows`."""
        series: dict[str, object] = {}
        for name in ROWS:
            values = getattr(self, name)
            if values is not None:
                series[name] = values[rows]
        return replace(self, **series)

    def in_band(self, values: np.ndarray) -> np.ndarray:
        """Return `values` (N, ...) low-pass filtered to the identification band, segment by segment, not decimated."""
        cutoff = min(self.band, USABLE * self.rate / 2)
        parts = [filtering.low_pass(values[rows], self.rate, cutoff) for rows in filtering.segments(self.segment)]
        return np.concatenate(parts)

    def standstill(self, slow: float | Sequence[float] = STANDSTILL_SHARE) -> np.ndarray:
        """Return the samples at which all joints are at rest, (N,) bool.

        At rest, friction is unknown up to Coulomb's value.

        Args:
            slow: speed below which a joint counts as at rest: a share of its peak speed, or (n,) [rad/s or m/s].
        """
        return np.asarray(~moving(self, slow).any(axis=1))

    def velocity_noise(self, cutoff: float | None = None) -> np.ndarray:
        """Return the standard deviation (n,) of the filtered velocities due to white position noise [rad/s or m/s].

        σ_v² = σ_q² (2/f_s) ∫ (2πf)² |H(f)|⁴ df, with |H|² the gain of both passes; this is about σ_q² (2/f_s) (2π)²
        f³/3 for the cut-off f.

        Args:
            cutoff: cut-off of the positions from which velocities are computed [Hz]; None: that of this motion.
        """
        velocity_cutoff = self.velocity_cutoff if cutoff is None else cutoff
        return self.cutoffs.noise * 2 * np.pi * np.sqrt(2 * velocity_cutoff**3 / (3 * self.rate))


def make_motion(
    recording: Recording,
    options: FilterOptions | None = None,
    sampled: Resampled | None = None,
    cutoffs: Cutoffs | None = None,
) -> Motion:
    """Return the motion of a recording: resampled to an even grid, filtered without phase shift, differentiated.

    Args:
        recording: the recording.
        options: options of filtering; None: the defaults.
        sampled: the resampled recording, if already computed with the same clock and gap; None to compute it.
        cutoffs: cut-offs proposed for `sampled`, if already computed with the same f_dyn; None to compute them.

    Raises:
        MeasurementError: a cut-off at or above the Nyquist frequency, or segments shorter than the ends that the
            filters affect.
        UsageError: the number of cut-offs differs from the number of joints.
    """
    options = options or FilterOptions()
    if sampled is None:
        sampled = resample(recording, options.clock, options.gap)
    if cutoffs is None:
        cutoffs = propose_cutoffs(sampled, options.dynamics)
    cutoff = _per_joint(cutoffs.position if options.cutoff is None else options.cutoff, recording)
    _check_cutoffs(cutoff, sampled.rate, recording.file)
    velocity_cutoff = None
    if options.velocity_cutoff is not None:
        velocity_cutoff = _per_joint(options.velocity_cutoff, recording)
        _check_cutoffs(velocity_cutoff, sampled.rate, recording.file)
    decimator = _decimator(cutoffs, options, sampled, recording.file)

    q = _smooth(sampled, cutoff, options.order)
    mask = _unaffected(sampled, cutoff, options, recording.file)
    a = _differences(filtering.curvature, q, sampled, options.width)
    if velocity_cutoff is None:
        velocity_cutoff = cutoff
        if options.cutoff is None:
            velocity_cutoff = _velocity_cutoff(cutoffs, cutoff, a[mask], sampled.rate)
    q_for_velocity = q
    if not np.array_equal(velocity_cutoff, cutoff):
        q_for_velocity = _smooth(sampled, velocity_cutoff, options.order)
    v = _differences(filtering.slope, q_for_velocity, sampled, options.width)

    # Unless the band is stated, a filter is taken whose window fits.
    segment = sampled.segment[mask]
    while options.band is None and decimator.factor > 1 and not len(filtering.kept(segment, decimator)):
        decimator = filtering.design_decimator(sampled.rate, decimator.factor // 2, options.decimator)
    if not len(filtering.kept(segment, decimator)):
        raise filtering.too_short(int(mask.sum()), decimator)

    rows = _span(mask)
    series: FieldValues = {}
    for name, values in sampled.series.items():
        field = f"{name}_measured" if name in ("q", "v") else name
        series[field] = read_only(values[rows])
    return Motion(
        t=read_only(sampled.t[rows]),
        q=read_only(q[rows]),
        v=read_only(v[rows]),
        a=read_only(a[rows]),
        weight=read_only(sampled.weight[rows]),
        segment=frozen(sampled.segment[rows], int),
        rate=sampled.rate,
        band=decimator.band,
        cutoff=frozen(cutoff),
        velocity_cutoff=frozen(velocity_cutoff),
        decimator=decimator,
        kind=recording.kind,
        joint_names=recording.joint_names,
        file=recording.file,
        sampling=sampled.report,
        cutoffs=cutoffs,
        notes=(*recording.notes, *sampled.report.lines(), *_reasons(cutoffs, options)),
        drive_gain=recording.drive_gain,
        effort_variance=recording.effort_variance,
        jumps=recording.jumps,
        faults=recording.faults,
        **series,
    )


def _check_cutoffs(cutoffs: np.ndarray, rate: float, file: str) -> None:
    for cutoff in cutoffs:
        check_cutoff(float(cutoff), rate, file)


def with_reference(motion: Motion, path: Path, joints: Joints, options: RecordingOptions) -> Motion:
    """Return the motion with the reference positions from the file at `path`, interpolated at the motion's samples.

    In both files, time counts from the first sample.

    Args:
        motion: the motion.
        path: the reference file.
        joints: the robot's joints.
        options: options for reading the file.

    Raises:
        MeasurementError: the file is not a reference, has other joints, or does not cover the time of the motion.
    """
    with refused_as(MeasurementError, OSError, "cannot be read: {}", path):
        check_regular(path)
        with open(path, "rb") as file:
            is_archive = file.read(2) == b"PK"
    if is_archive:
        t, q = read_archived_positions(path, joints, options)
    else:
        t, q = read_positions(path, joints, options)
    if q.shape[1:] != (motion.n,):
        refuse_data(
            path, f"has {q.shape[1]} joints, the recording has {motion.n}: is it the reference of this recording?"
        )
    if len(t) < MIN_REFERENCE_SAMPLES or not np.isfinite(q).all() or not (np.diff(t) > 0.0).all():
        refuse_data(path, "a reference needs ten samples or more, finite numbers and increasing stamps")
    slack = 1.5 * float(np.median(np.diff(t)))
    if motion.t[0] < t[0] - slack or motion.t[-1] > t[-1] + slack:
        message = (
            f"{len(t)} samples from {t[0]:.6g} s to {t[-1]:.6g} s do not span the recording {motion.file}, "
            f"used from {motion.t[0]:.6g} s to {motion.t[-1]:.6g} s: times count from each file's first sample"
        )
        refuse_data(path, message)
    q_ref = CubicSpline(t, q)(np.clip(motion.t, t[0], t[-1]))
    return replace(motion, q_ref=frozen(q_ref))


def moving(motion: Motion, slow: float | Sequence[float] = STANDSTILL_SHARE) -> np.ndarray:
    """Return at which samples each joint moves, (N, n) bool: where |v_j| ≥ `slow`.

    Args:
        motion: the motion.
        slow: threshold: a share of each joint's peak speed, or (n,) [rad/s or m/s]. The threshold is at least three
            standard deviations of the velocity noise.
    """
    peak = np.abs(motion.v).max(axis=0)
    threshold = slow * peak if isinstance(slow, (int, float)) else np.asarray(slow, dtype=float)
    noise = 3 * motion.velocity_noise()
    return np.abs(motion.v) >= np.maximum(np.maximum(threshold, noise), CREEP)


def _velocity_cutoff(cutoffs: Cutoffs, cutoff: np.ndarray, a: np.ndarray, rate: float) -> np.ndarray:
    """Return the velocities' cut-off f_v (n,) [Hz], at which noise reaches the share `MAX_NOISE` of the accelerations.

    f_v is limited to the range from f_q to 5 f_q.

    Args:
        cutoffs: proposed cut-offs, with the position noise.
        cutoff: (n,) cut-off f_q of the positions [Hz].
        a: (N, n) accelerations [rad/s² or m/s²].
        rate: sampling rate [Hz].
    """
    rms = np.sqrt(np.mean(a**2, axis=0))
    noise_share = cutoffs.acceleration_noise(cutoff, rate) / np.maximum(rms, 1e-12)
    # The noise grows with f_q^2.5.
    ratio = (MAX_NOISE / np.maximum(noise_share, 1e-12)) ** 0.4
    velocity_cutoff = cutoff * np.clip(ratio, 1.0, MAX_CUTOFF_RATIO)
    return np.maximum(np.minimum(velocity_cutoff, 0.5 * USABLE * rate), cutoff)


def _smooth(sampled: Resampled, cutoff: np.ndarray, order: int) -> np.ndarray:
    """Return the positions (N, n) low-pass filtered at each joint's cut-off (n,) [Hz], segment by segment.

    Args:
        sampled: the resampled recording.
        cutoff: (n,) cut-offs f_q [Hz].
        order: order of the Butterworth filter in one pass.
    """
    key = (*cutoff.tolist(), order)
    if key in sampled.filtered:
        return sampled.filtered[key]
    # By joints, as all that follows reads them.
    result = np.array(sampled.series["q"], order="F")
    for rows in filtering.segments(sampled.segment):
        for j, f in enumerate(cutoff):
            result[rows, j] = filtering.low_pass(result[rows, j], sampled.rate, float(f), order)
    sampled.filtered[key] = read_only(result)
    return result


def _differences(
    derivative: Callable[[np.ndarray, float, int], np.ndarray], q: np.ndarray, sampled: Resampled, width: int
) -> np.ndarray:
    """Return the first or second time derivative (N, n) of positions q (N, n), segment by segment.

    Args:
        derivative: `slope` or `curvature`.
        q: the positions.
        sampled: the recording, whose segments and sampling rate are used.
        width: number of samples on each side that the central differences use.
    """
    parts = [derivative(q[rows], sampled.rate, width) for rows in filtering.segments(sampled.segment)]
    return np.concatenate(parts)


def _unaffected(sampled: Resampled, cutoff: np.ndarray, options: FilterOptions, file: str) -> np.ndarray:
    """Return the samples that the ends of the filters do not affect, (N,) bool.

    Args:
        sampled: the resampled recording.
        cutoff: (n,) cut-offs of the positions [Hz].
        options: options of filtering, with the time to remove at the ends.
        file: name of the recording, for messages.

    Raises:
        MeasurementError: there are no such samples.
    """
    if options.borders is None:
        border = filtering.border(sampled.rate, float(cutoff.min()))
        reason = "the filters' ends"
    else:
        border = int(np.ceil(options.borders * sampled.rate))
        reason = f"borders = {options.borders:g}"
    border = max(border, options.width)
    mask = np.zeros(len(sampled.t), dtype=bool)
    for rows in filtering.segments(sampled.segment):
        first = rows.start + border
        mask[first : max(first, rows.stop - border)] = True
    if not mask.any():
        message = (
            f"no part without a gap is longer than {2 * border / sampled.rate:.3g} s, the part removed by {reason}"
        )
        refuse_data(file, f"{message}: record longer, or lower the borders")
    return mask


def _span(mask: np.ndarray) -> np.ndarray | slice:
    """Return a mask (N,), or the equivalent slice if the selected samples are contiguous (slices avoid copies)."""
    first = int(np.argmax(mask))
    stop = len(mask) - int(np.argmax(mask[::-1]))
    return slice(first, stop) if mask[first:stop].all() else mask


def _decimator(cutoffs: Cutoffs, options: FilterOptions, sampled: Resampled, file: str) -> filtering.Decimator:
    rate = sampled.rate
    if options.band is None:
        return filtering.design_decimator(rate, cutoffs.factor, options.decimator)
    message = f"an identification band of {options.band:g} Hz is not below the Nyquist frequency {rate / 2:g} Hz"
    require(options.band < rate / 2, message, MeasurementError, file)
    factor = filtering.factor_for(rate, options.band)
    if factor > len(sampled.t):
        message = f"a band of {options.band:g} Hz keeps one of {factor} samples; there are only {len(sampled.t)}"
        refuse_data(file, f"{message}: raise the band, or leave it out")
    return filtering.design_decimator(rate, factor, options.decimator)


def _per_joint(cutoff: float | tuple[float, ...], recording: Recording) -> np.ndarray:
    values = np.atleast_1d(np.asarray(cutoff, dtype=float))
    if len(values) not in (1, recording.n):
        raise UsageError(f"cutoff: {len(values)} values for {recording.n} joints; give one, or one per joint")
    return np.broadcast_to(values, (recording.n,))


def _reasons(cutoffs: Cutoffs, options: FilterOptions) -> tuple[str, ...]:
    """Return sentences that explain how the cut-offs were chosen.

    Args:
        cutoffs: the proposed cut-offs.
        options: options of filtering, which may state others.
    """
    lines = []
    for name, option in (("cutoff", options.cutoff), ("band", options.band)):
        if option is not None:
            frequencies = " ".join(f"{frequency:.4g}" for frequency in np.atleast_1d(option))
            lines.append(f"{name} = {frequencies} Hz, as stated or as for the training motion")
    # Both are stated: none was chosen from the data.
    if len(lines) == 2:
        return tuple(lines)
    return (*lines, *cutoffs.reasons)
