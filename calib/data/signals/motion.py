"""Motion for identification from a raw recording: filtered positions, derivatives and torques on one even grid.

`Motion` is the only type with accelerations, so that an unfiltered log cannot reach a regressor. Its torques are as
recorded (on the even grid): the parallel decimation filters them, and every column of W in the same way
(`calib.data.signals.filtering`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
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
from calib.records import frozen, read_only

# of a joint's peak speed: below it stands, for friction (the TX40's own thresholds are this share)
STANDSTILL_SHARE = 0.01
FASTER = 5.0  # f_v of f_q at most (our choice)
CREEP = 1e-3  # no joint moves below this [rad/s or m/s]


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
    """Filtered motion: N samples on an even grid, in segments without gaps.

    Coulomb friction bends the velocity where it changes its sign: the acceleration falls by 2 Fc / M from one side to
    the other. A filter rounds that corner off and moves the zero to later, friction's column lags behind, and Ia, whose
    acceleration then has the sign of what is missing, is found too large (by 2 % at f_q = 10 Hz on a simulated LWR4+).
    Velocities stand more noise than accelerations, and so have a cut-off of their own.

    Attributes:
        t: (N,) [s]; within a segment in steps of 1/rate.
        q, v, a: (N, n) filtered position [rad or m] and its central differences [/s], [/s²].
        effort: (N, n) torque [N·m or N] or current [A] (`kind`), not filtered; interpolated where a sample is
            missing (weight 0).
        weight: (N,) 1 at a sample, 0 at one that was lost and interpolated.
        segment: (N,) number of the segment, rising.
        rate: [Hz].
        band: f_p, the identification band [Hz].
        cutoff: (n,) f_q [Hz].
        velocity_cutoff: (n,) f_v [Hz]: of the positions that v comes from.
        decimator: the filter of the parallel decimation to that band.
        joint_names, kind, file, drive_gain, effort_variance: the recording's.
        tau_link, tau_motor, q_link, q_ref, tau_ff, v_measured: (N, n) the recording's others on the grid, not
            filtered; or None.
        sampling, cutoffs: what was found; notes: for the user; jumps: the recording's, in words; faults: the
            recording's.
        located: where a designed motion that is the reference was found to begin [s]; None: another reference.
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
    v_measured: np.ndarray | None = None
    drive_gain: np.ndarray | None = None
    effort_variance: np.ndarray | None = None
    jumps: tuple[str, ...] = ()
    faults: tuple[ColumnFault, ...] = ()
    located: float | None = None

    def __len__(self) -> int:
        return len(self.t)

    @property
    def n(self) -> int:
        """The number of joints."""
        return self.q.shape[1]

    def part(self, rows: slice) -> "Motion":
        """Return the motion of a slice of its samples."""
        return replace(self, **{name: value[rows] for name in ROWS if (value := getattr(self, name)) is not None})

    def in_band(self, values: np.ndarray) -> np.ndarray:
        """Return `values` (N, ...) low-passed to the identification band, at the full rate, segment by segment."""
        cutoff = min(self.band, USABLE * self.rate / 2)
        parts = [filtering.low_pass(values[own], self.rate, cutoff) for own in filtering.segments(self.segment)]
        return np.concatenate(parts)

    def standstill(self, slow: float | Sequence[float] = STANDSTILL_SHARE) -> np.ndarray:
        """Return the mask (N,) of samples with all joints at rest, where friction is unknown up to Coulomb's value."""
        return np.asarray(~moving(self, slow).any(axis=1))

    def velocity_noise(self, cutoff: float | None = None) -> np.ndarray:
        """Return the standard deviation (n,) of filtered velocities due to white position noise [rad/s or m/s].

        With `cutoff` [Hz], in those of positions filtered to less than the motion's.

        σ_v² = σ_q² (2/f_s) ∫ (2πf)² |H(f)|⁴ df with |H|² of the two passes, about σ_q² (2/f_s) (2π)² f_q³/3.
        """
        at = self.velocity_cutoff if cutoff is None else cutoff
        return self.cutoffs.noise * 2 * np.pi * np.sqrt(2 * at**3 / (3 * self.rate))


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
    "v_measured",
)


def make_motion(
    recording: Recording,
    options: FilterOptions | None = None,
    sampled: Resampled | None = None,
    cutoffs: Cutoffs | None = None,
) -> Motion:
    """Return the motion of a recording: resampled to an even grid, low-passed without phase shift, differentiated.

    Args:
        sampled: the recording on its grid if already computed with the same clock and gap.
        cutoffs: proposed for it, if already computed with the same f_dyn.

    Raises:
        MeasurementError: for a cut-off at or above the Nyquist frequency; for segments that the filters eat up.
        UsageError: for a list of cut-offs of another length than the joints.
    """
    options = options or FilterOptions()
    sampled = resample(recording, options.clock, options.gap) if sampled is None else sampled
    cutoffs = propose_cutoffs(sampled, options.dynamics) if cutoffs is None else cutoffs
    cutoff = _per_joint(cutoffs.position if options.cutoff is None else options.cutoff, recording)
    faster = None if options.velocity_cutoff is None else _per_joint(options.velocity_cutoff, recording)
    for value in (*cutoff, *(() if faster is None else faster)):
        check_cutoff(float(value), sampled.rate, recording.file)
    decimator = _decimator(cutoffs, options, sampled, recording.file)
    q, mask = _smooth(sampled, cutoff, options.order), _inside(sampled, cutoff, options, recording.file)
    a = _differences(filtering.curvature, q, sampled, options.width)
    if faster is None:
        faster = cutoff if options.cutoff is not None else _velocity_cutoff(cutoffs, cutoff, a[mask], sampled.rate)
    less = q if np.array_equal(faster, cutoff) else _smooth(sampled, faster, options.order)
    v = _differences(filtering.slope, less, sampled, options.width)
    while options.band is None and decimator.factor > 1 and not len(filtering.kept(sampled.segment[mask], decimator)):
        # whose window fits
        decimator = filtering.design_decimator(sampled.rate, decimator.factor // 2, options.decimator)
    if not len(filtering.kept(sampled.segment[mask], decimator)):
        raise filtering.too_short(int(mask.sum()), decimator)
    inside = _span(mask)
    others = {name: read_only(value[inside]) for name, value in sampled.series.items() if name not in ("q", "v")}
    v_measured = read_only(sampled.series["v"][inside]) if "v" in sampled.series else None
    return Motion(
        *(read_only(values[inside]) for values in (sampled.t, q, v, a)),
        weight=read_only(sampled.weight[inside]),
        segment=frozen(sampled.segment[inside], int),
        rate=sampled.rate,
        band=decimator.band,
        cutoff=frozen(cutoff),
        velocity_cutoff=frozen(faster),
        decimator=decimator,
        kind=recording.kind,
        joint_names=recording.joint_names,
        file=recording.file,
        sampling=sampled.report,
        cutoffs=cutoffs,
        notes=(*recording.notes, *sampled.report.lines(), *_reasons(cutoffs, options)),
        drive_gain=recording.drive_gain,
        effort_variance=recording.effort_variance,
        v_measured=v_measured,
        jumps=recording.jumps,
        faults=recording.faults,
        **others,
    )


def with_reference(motion: Motion, path: Path, joints: Joints, options: RecordingOptions) -> Motion:
    """Return the motion with the reference positions of the file at `path`, interpolated at its samples.

    Both files count time from their first sample.

    Raises:
        MeasurementError: if the file is not a reference, has other joints, or does not span the motion.
    """
    with refused_as(MeasurementError, OSError, "cannot be read: {}", path):
        check_regular(path)
        with open(path, "rb") as file:
            read = read_archived_positions if file.read(2) == b"PK" else read_positions
    t, q = read(path, joints, options)
    if q.shape[1:] != (motion.n,):
        refuse_data(path, f"has {q.shape[1]} joints, the recording has {motion.n}")
    if len(t) < 10 or not np.isfinite(q).all() or not (np.diff(t) > 0.0).all():
        refuse_data(path, "a reference needs ten samples or more, finite numbers and increasing stamps")
    slack = 1.5 * float(np.median(np.diff(t)))
    if motion.t[0] < t[0] - slack or motion.t[-1] > t[-1] + slack:
        message = (
            f"{len(t)} samples from {t[0]:.6g} s to {t[-1]:.6g} s do not span the recording {motion.file}, "
            f"used from {motion.t[0]:.6g} s to {motion.t[-1]:.6g} s: times count from each file's first sample"
        )
        refuse_data(path, message)
    return replace(motion, q_ref=frozen(CubicSpline(t, q)(np.clip(motion.t, t[0], t[-1]))))


def moving(motion: Motion, slow: float | Sequence[float] = STANDSTILL_SHARE) -> np.ndarray:
    """Return the mask (N, n) of moving joints: |v_j| ≥ `slow`, a share of the peak, or (n,) [rad/s or m/s]."""
    peak = np.abs(motion.v).max(axis=0)
    threshold = slow * peak if isinstance(slow, (int, float)) else np.asarray(slow, dtype=float)
    noise = 3 * motion.velocity_noise()
    return np.abs(motion.v) >= np.maximum(np.maximum(threshold, noise), CREEP)


def _velocity_cutoff(cutoffs: Cutoffs, cutoff: np.ndarray, a: np.ndarray, rate: float) -> np.ndarray:
    """Return f_v (n,) [Hz], at which noise reaches `max_noise` of the accelerations (N, n); between f_q and 5 f_q."""
    share = cutoffs.acceleration_noise(cutoff, rate) / np.maximum(np.sqrt(np.mean(a**2, axis=0)), 1e-12)
    # noise in the accelerations that velocities of the same cut-off can bear, of their rms (our choice)
    max_noise = 0.1
    wider = (max_noise / np.maximum(share, 1e-12)) ** 0.4  # the noise grows with f_q^2.5
    return np.maximum(np.minimum(cutoff * np.clip(wider, 1.0, FASTER), 0.5 * USABLE * rate), cutoff)


def _smooth(sampled: Resampled, cutoff: np.ndarray, order: int) -> np.ndarray:
    """Return the positions (N, n) low-passed at each joint's cut-off (n,) [Hz], segment by segment."""
    result = np.array(sampled.series["q"], order="F")  # by joints, as all that follows reads them
    for own, (j, f) in product(filtering.segments(sampled.segment), enumerate(cutoff)):
        result[own, j] = filtering.low_pass(result[own, j], sampled.rate, float(f), order)
    return result


def _differences(
    of: Callable[[np.ndarray, float, int], np.ndarray], q: np.ndarray, sampled: Resampled, width: int
) -> np.ndarray:
    """Return first or second derivatives (N, n) of q (N, n), segment by segment."""
    return np.concatenate([of(q[own], sampled.rate, width) for own in filtering.segments(sampled.segment)])


def _inside(sampled: Resampled, cutoff: np.ndarray, options: FilterOptions, file: str) -> np.ndarray:
    """Return the mask (N,) of samples that the filters' ends do not affect; refuse a motion without such samples."""
    inside = np.zeros(len(sampled.t), dtype=bool)
    edge = filtering.border(sampled.rate, float(cutoff.min()))
    edge = edge if options.borders is None else int(np.ceil(options.borders * sampled.rate))
    edge = max(edge, options.width)
    for own in filtering.segments(sampled.segment):
        inside[own.start + edge : max(own.start + edge, own.stop - edge)] = True
    if not inside.any():
        why = "the filters' ends" if options.borders is None else f"borders = {options.borders:g}"
        message = f"no part without a gap is longer than {2 * edge / sampled.rate:.3g} s, the part removed by {why}"
        refuse_data(file, f"{message}: record longer, or lower the borders")
    return inside


def _span(mask: np.ndarray) -> np.ndarray | slice:
    """Return a mask (N,), or a slice if its samples are contiguous (slices copy nothing)."""
    first, stop = int(np.argmax(mask)), len(mask) - int(np.argmax(mask[::-1]))
    return slice(first, stop) if mask[first:stop].all() else mask


def _decimator(cutoffs: Cutoffs, options: FilterOptions, sampled: Resampled, file: str) -> filtering.Decimator:
    rate = sampled.rate
    if options.band is None:
        return filtering.design_decimator(rate, cutoffs.factor, options.decimator)
    words = f"an identification band of {options.band:g} Hz is not below the Nyquist frequency {rate / 2:g} Hz"
    require(options.band < rate / 2, words, MeasurementError, file)
    if (factor := filtering.factor_for(rate, options.band)) > len(sampled.t):
        message = f"a band of {options.band:g} Hz keeps one of {factor} samples; there are only {len(sampled.t)}"
        refuse_data(file, f"{message}: raise the band, or leave it out")
    return filtering.design_decimator(rate, factor, options.decimator)


def _per_joint(cutoff: float | tuple[float, ...], recording: Recording) -> np.ndarray:
    values = np.atleast_1d(np.asarray(cutoff, dtype=float))
    if len(values) not in (1, recording.n):
        raise UsageError(f"cutoff: {len(values)} values for {recording.n} joints; give one, or one per joint")
    return np.broadcast_to(values, (recording.n,))


def _reasons(cutoffs: Cutoffs, options: FilterOptions) -> tuple[str, ...]:
    """Return sentences on where the cut-offs come from."""
    stated = {name: value for name in ("cutoff", "band") if (value := getattr(options, name)) is not None}
    lines = [
        f"{name} = {' '.join(f'{one:.4g}' for one in np.atleast_1d(value))} Hz, stated, or that of the training motion"
        for name, value in stated.items()
    ]
    return (*lines, *cutoffs.reasons) if len(stated) < 2 else tuple(lines)
