"""Errors of the nominal and the calibrated arm on the same measured rows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.geometry.accuracy import Errors, errors, pair_errors, statistics
from calib.geometry.error_model import ErrorModel, outside
from calib.geometry.fit import placed_on
from calib.geometry.installation import Installation
from calib.geometry.repeatability import ARMS, RepeatedPoses, repeated_poses
from calib.geometry.static_torques.load_errors import load_masses
from calib.geometry.weighing import Settings
from calib.procedure.kinematic_stage.inputs import Unseen, pose_count, pose_of_row
from calib.procedure.kinematic_stage.metrics import ComparedRows, PoseIntervalCoverage
from calib.procedure.kinematic_stage.verdict.image_findings import reprojection

# Columns of unseen rows: the standard deviation that the fit expects of the calibrated arm's position error there, all
# axes together; the radius within which 95 % of such errors are to be; 1 where a joint is outside the range learnt from
INTERVAL = ("sigma [mm]", "interval95 [mm]", "extrapolated")
# measured numbers per fitted parameter of a placement, below which errors prove nothing (our choice)
MARGIN = 3
# number of poses below which errors decide no verdict (our choice): of 8 poses the rms has a standard error of 14 % if
# its three components are independent and alike, of 25 % if one component dominates
MIN_UNSEEN = 8
# kind of a block -> what its position errors are, where it measures no position
MEASURED = {"sockets": "socket scatter", "plane": "plane distance"}
# kinds of blocks that have no position errors
WITHOUT_POSITIONS = ("distance", "bar")
# ISO 9283 requires so many poses and cycles; makers state an accuracy from so many poses
ISO_POSES = 5
ISO_CYCLES = 30
USUAL_POSES = 100


@dataclass(frozen=True, eq=False)
class Intervals:
    """Position errors on a set of rows, with the predicted σ and 95 % intervals.

    Attributes:
        sigma: (m,) predicted standard deviation of the tool position error, of all three axes together [m].
        radius: (m,) predicted radius that contains 95 % of the errors [m].
        size: (m,) magnitudes of the errors [m].
        beyond: (m,) whether a joint is outside the range of the fitted rows.
        joints: names of the joints that are outside this range at some row.
    """

    sigma: np.ndarray
    radius: np.ndarray
    size: np.ndarray
    beyond: np.ndarray
    joints: tuple[str, ...] = ()

    @property
    def covered(self) -> float:
        """Share of the errors inside their 95 % intervals."""
        return float(np.mean(self.size <= self.radius))

    @property
    def record(self) -> PoseIntervalCoverage:
        """Coverage and median radius of the 95 % intervals, and the number of rows that extrapolate.

        This is the entry of ``metrics.json``.
        """
        return PoseIntervalCoverage(
            coverage_percent=100.0 * self.covered,
            median_mm=1e3 * float(np.median(self.radius)),
            sigma_rms_mm=1e3 * float(np.sqrt(np.mean(self.sigma**2))),
            rows=len(self.size),
            rows_beyond_learnt_range=int(self.beyond.sum()),
            joints_beyond_learnt_range=self.joints,
        )


@dataclass(frozen=True, eq=False)
class Comparison:
    """Errors of the nominal and the calibrated arm on the same rows.

    Attributes:
        blocks: the rows.
        cells: nominal and calibrated installation, which predict the rows.
        errors: errors of the nominal and the calibrated arm.
        pairs: errors of the distances between pairs of positions, of both arms [m].
        poses: number of robot poses.
        frames: text on the source of the base and tool placement.
        proves: whether a verdict may be based on the errors; False if the rows were fitted, or if the placement of base
            and tool did not converge or absorbed the errors.
        alone: errors of the calibrated robot as a URDF describes it, without corrections and with frames fitted to the
            same rows; None if the robot has no corrections.
        shares_frames: whether base and tool placement of another file were used.
        repeated: repeatability and accuracy from poses that were measured several times; None without such poses.
        reprojection: rms distance between detected and predicted corners, of both arms [px]; None without images.
        settled: False if the placement of base and tool on these rows did not converge; then the errors are
            meaningless.
        placed_by: number of measured values, and number of placement parameters fitted to them, if there are too few
            values to judge by the errors (`MARGIN`); otherwise, and of fitted rows, None.
        few: number of poses, if these are fewer than a verdict needs (`MIN_UNSEEN`); otherwise None.
        intervals: errors of the calibrated arm with their predicted intervals; None without an error model of the fit.
        plain: errors of the plain reference, with frames fitted to the same rows; None on fitted rows, and without a
            plain reference.
    """

    blocks: tuple[PoseMeasurements, ...]
    cells: tuple[Installation, Installation]
    errors: tuple[Errors, Errors]
    pairs: tuple[np.ndarray, np.ndarray]
    poses: int
    frames: str
    proves: bool = True
    alone: Errors | None = None
    shares_frames: bool = False
    repeated: RepeatedPoses | None = None
    reprojection: tuple[float, float] | None = None
    settled: bool = True
    placed_by: tuple[int, int] | None = None
    few: int | None = None
    intervals: Intervals | None = None
    plain: Errors | None = None

    @property
    def decides(self) -> bool:
        """Whether a verdict may follow from these rows."""
        return self.proves and self.few is None

    @property
    def may_contradict(self) -> bool:
        """Whether these rows are too few to prove anything, but may contradict the fit."""
        return self.placed_by is not None or (self.proves and self.few is not None)

    @property
    def least_poses(self) -> int:
        """Number of such poses from which on errors decide a verdict: beside a fitted placement, more are needed."""
        if self.placed_by is None:
            return MIN_UNSEEN
        measured, parameters = self.placed_by
        return max(MIN_UNSEEN, math.ceil(MARGIN * parameters * self.poses / measured))

    @property
    def of_urdf(self) -> Comparison:
        """The comparison for the URDF alone: without joint corrections and without intervals.

        Intervals are left out since they include the corrections.
        """
        if self.alone is None:
            return self
        return replace(self, errors=(self.errors[0], self.alone), intervals=None)

    def record(self, parameters: int = 0) -> ComparedRows:
        """Return the entry of ``metrics.json`` on these rows.

        Args:
            parameters: number of parameters that were fitted to these rows.
        """
        pair_distances = {}
        if len(self.pairs[0]):
            pair_distances = {arm: statistics(sizes, 1e3) for arm, sizes in zip(ARMS, self.pairs)}
        urdf_alone = plain = interval95 = None
        if self.alone is not None:
            urdf_alone = self.alone.summary()
        if self.plain is not None:
            plain = self.plain.summary()
        if self.intervals is not None:
            interval95 = self.intervals.record
        return ComparedRows(
            poses=self.poses,
            frames=self.frames,
            nominal=self.errors[0].summary(),
            calibrated=self.errors[1].summary(),
            urdf_alone=urdf_alone,
            plain=plain,
            pair_distance_mm=pair_distances,
            iso9283=self.repeated,
            unseen=self.proves,
            parameters=parameters,
            interval95=interval95,
            reprojection_px=dict(zip(ARMS, self.reprojection or ())),
            loads_kg=load_masses([block for block in self.blocks if block.load is not None]),
            position_means=_position_means(self.blocks),
        )


def _position_means(blocks: Sequence[PoseMeasurements]) -> str:
    """Return as text which distance is called position error: that of positions, sockets or planes.

    Args:
        blocks: the measurements.
    """
    kinds = [block.kind for block in blocks if block.kind not in WITHOUT_POSITIONS]
    means = dict.fromkeys(MEASURED.get(kind, "position") for kind in kinds)
    return " or ".join(means) or "position"


def compare(
    cells: Sequence[Installation], blocks: Sequence[PoseMeasurements], frames: str, proves: bool = True, seed: int = 0
) -> Comparison:
    """Return the errors of the nominal arm, the calibrated arm and (if given) the URDF alone on the same rows.

    Args:
        cells: installations of these arms, in this order.
        blocks: the rows.
        frames: text on the source of the base and tool placement.
        proves: whether a verdict may be based on the rows.
        seed: seed of the random pairs of positions whose distances are compared.
    """
    nominal, calibrated, *urdf_alone = [errors(cell, blocks) for cell in cells]
    arms = (cells[0], cells[1])
    pairs_nominal = pair_errors(arms[0], blocks, seed=seed)
    pairs_calibrated = pair_errors(arms[1], blocks, seed=seed)
    nominal_pixels = reprojection(arms[0], blocks)
    calibrated_pixels = reprojection(arms[1], blocks)
    pixels = None
    if nominal_pixels is not None and calibrated_pixels is not None:
        pixels = (nominal_pixels, calibrated_pixels)
    return Comparison(
        blocks=tuple(blocks),
        cells=arms,
        errors=(nominal, calibrated),
        pairs=(pairs_nominal, pairs_calibrated),
        poses=pose_count(blocks),
        frames=frames,
        proves=proves,
        alone=urdf_alone[0] if urdf_alone else None,
        repeated=repeated_poses(arms, blocks),
        reprojection=pixels,
    )


def compare_unseen(
    cells: Sequence[Installation],
    unseen: Unseen,
    settings: Settings,
    seed: int,
    expected: ErrorModel | None,
    plain: Installation | None = None,
) -> Comparison:
    """Return the errors of the arms on validation rows; base and tool placement are refitted if requested.

    Args:
        cells: nominal and calibrated installation, and the installation of the URDF alone if it differs.
        unseen: the rows.
        settings: settings of the placement.
        seed: seed of the random pairs of positions whose distances are compared.
        expected: the fit's error model; None: no error model.
        plain: the plain reference; None: no plain reference.
    """
    block = unseen.block
    settled = True
    placed_by = None
    if unseen.own_frames:
        placements = [placed_on(cell, block, settings) for cell in cells]
        cells = [placement.cell for placement in placements]
        settled = all(placement.solution.status.good for placement in placements[:2])
        calibrated = placements[1]
        measured = sum(piece.part.value.size for piece in calibrated.pieces)
        parameters = len(calibrated.free)
        frames = "base and tool placement refitted on these rows"
        if not settled:
            frames = "base and tool placement did not converge on these rows"
        elif measured < MARGIN * parameters and not unseen.seen:
            placed_by = measured, parameters
            frames = f"base and tool placement: {parameters} parameters fitted to only {measured} numbers of these rows"
    elif unseen.held_out:
        frames = "those of the fit"
    elif block.has_instrument:
        frames = f"those of the fit, station '{block.station}'"
    else:
        frames = "tool of the fit"
    proves = settled and placed_by is None and not unseen.seen
    comparison = compare(cells, [block], frames, proves, seed)

    intervals = None
    sizes = comparison.errors[1].position
    if expected is not None and isinstance(block, Positions) and sizes is not None:
        sigma = expected.sigma_on(cells[1], block, unseen.own_frames)
        outside_range = outside(block.q, expected.learnt)
        joint_outside = np.any(outside_range, axis=0)
        joints = tuple(name for name, is_outside in zip(block.joint_names, joint_outside) if is_outside)
        radius = expected.discrepancy.radius * sigma
        intervals = Intervals(sigma, radius, sizes, np.any(outside_range, axis=1), joints)

    plain_errors = None
    if plain is not None and settled:
        if unseen.own_frames:
            plain = placed_on(plain, block, settings).cell
        plain_errors = errors(plain, [block])
    few = None
    poses = int(pose_of_row(block).max(initial=-1)) + 1
    if poses < MIN_UNSEEN:
        few = poses
    return replace(
        comparison,
        settled=settled,
        few=few,
        placed_by=placed_by,
        intervals=intervals,
        shares_frames=not (unseen.own_frames or unseen.held_out),
        plain=plain_errors,
    )


def interval_cells(comparison: Comparison) -> np.ndarray:
    """Return the values (m, 3) of the columns `INTERVAL` for all m rows; NaN if the fit has no error model.

    Args:
        comparison: errors on the m rows.
    """
    intervals = comparison.intervals
    if intervals is None:
        row_count = sum(len(block) for block in comparison.blocks)
        return np.full((row_count, 3), np.nan)
    return np.column_stack([1e3 * intervals.sigma, 1e3 * intervals.radius, intervals.beyond])


def iso9283_sentence(repeated: RepeatedPoses, arm: str) -> str:
    """Return a sentence with repeatability RP and accuracy AP of repeated poses (ISO 9283).

    Args:
        repeated: repeatability and accuracy.
        arm: printed name of the fitted arm.
    """
    fewest, largest = repeated.cycles
    cycles = f"{fewest}"
    if largest != fewest:
        cycles += f" to {largest}"
    nominal, calibrated = (repeated.accuracy_mm[name]["mean"] for name in ARMS)
    text = (
        f"ISO 9283 on {repeated.poses} poses repeated {cycles} times: RP {repeated.repeatability_mm['mean']:.3f} mm "
        f"(at most {repeated.repeatability_mm['max']:.3f}), AP {nominal:.3f} mm nominal, {calibrated:.3f} mm {arm}"
    )
    required = []
    if repeated.poses < ISO_POSES:
        required.append(f"{ISO_POSES} poses")
    if fewest < ISO_CYCLES:
        required.append(f"{ISO_CYCLES} cycles")
    if required:
        text += f"; the norm requires {' and '.join(required)}"
    if repeated.poses < USUAL_POSES:
        text += f"; too few poses to state an accuracy (makers use {USUAL_POSES})"
    return text
