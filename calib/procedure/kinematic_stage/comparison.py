"""Errors of the nominal and the calibrated arm on the same rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.extensions import Point
from calib.geometry.accuracy import Errors, errors, pair_errors, statistics
from calib.geometry.error_model import ErrorModel, outside
from calib.geometry.fit import placed_on
from calib.geometry.installation import Installation
from calib.geometry.repeatability import ARMS, RepeatedPoses, repeated_poses
from calib.geometry.weighing import Settings
from calib.procedure.kinematic_stage.inputs import Unseen, pose_count
from calib.procedure.kinematic_stage.metrics import ComparedRows, IntervalCoverage

REPROJECTION: Point[Callable[[Installation, Any], Any]] = Point("reprojection", "how far corners are off")

# of unseen rows: the standard deviation that the fit expects of the calibrated arm's position error there, all axes
# together; the radius within which 95 % of such errors are to be; 1 where a joint is outside the range learnt from
INTERVAL = ("sigma [mm]", "interval95 [mm]", "extrapolated")
MARGIN = 3  # measured numbers per fitted parameter of a placement, below which errors prove nothing (our choice)


@dataclass(frozen=True, eq=False)
class Intervals:
    """Position errors on a set of rows, with the predicted σ and 95 % intervals.

    Attributes:
        sigma: (m,) standard deviation of the tool position error, all axes together [m].
        radius: (m,) within which 95 % of such errors are to be [m].
        size: (m,) the errors found [m].
        beyond: (m,) whether a joint stands outside the training range.
        joints: names of those that do.
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
    def record(self) -> IntervalCoverage:
        """Coverage and median radius of the 95 % intervals, and the number of rows that extrapolate."""
        return IntervalCoverage(
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
        cells: nominal and calibrated installation that predict them.
        errors: of each.
        pairs: errors of the distances between pairs of positions, of each [m].
        poses: how many robot poses.
        frames: whose base and tool placement was used, in words.
        proves: False where the rows were fitted on, or where the placement did not settle or took up the errors.
        alone: errors of the calibrated robot as a URDF holds it, without corrections and with frames fitted for it
            on the same rows as theirs; None where that is all there is.
        plain: errors of the plain reference, frames likewise; None on the fit's own rows, and where there is none.
        shares_frames: True where another file's base and tool placement was used.
        repeated: what poses that were measured several times say (`calib.procedure.kinematic_stage.comparison`); None
            without any.
        reprojection: rms distance of seen from predicted corners, of each arm [px]; None without images.
        intervals: what the fit's error model expected of the calibrated arm on these rows; None without one.
        settled: False where the placement of base and tool on these rows did not settle: their errors mean nothing.
        placed_by: how many numbers were measured, and how many parameters of the placement were fitted to them, where
            that leaves too little to prove anything (`MARGIN`).
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
    intervals: Intervals | None = None
    plain: Errors | None = None

    @property
    def of_urdf(self) -> Comparison:
        """The comparison for the URDF alone: without joint corrections and without intervals (these include them)."""
        return self if self.alone is None else replace(self, errors=(self.errors[0], self.alone), intervals=None)

    def record(self, parameters: int = 0) -> ComparedRows:
        """Return the entry of ``metrics.json``; `parameters` is the number of parameters fitted to these rows."""
        pairs = self.pairs if len(self.pairs[0]) else ()
        return ComparedRows(
            poses=self.poses,
            frames=self.frames,
            nominal=self.errors[0].summary(),
            calibrated=self.errors[1].summary(),
            urdf_alone=None if self.alone is None else self.alone.summary(),
            plain=None if self.plain is None else self.plain.summary(),
            pair_distance_mm={arm: statistics(sizes, 1e3) for arm, sizes in zip(ARMS, pairs)},
            iso9283=self.repeated,
            unseen=self.proves,
            parameters=parameters,
            interval95=None if self.intervals is None else self.intervals.record,
            reprojection_px=dict(zip(ARMS, self.reprojection or ())),
            position_means=_position_means(self.blocks),
        )


MEASURED = {"sockets": "socket scatter", "plane": "plane distance"}
"""Kind of a block → what its position errors are, where it measures no position."""


def _position_means(blocks: Sequence[PoseMeasurements]) -> str:
    """Return what the position errors of blocks are, in words."""
    kinds = dict.fromkeys(block.kind for block in blocks if block.kind not in ("distance", "bar"))
    return " or ".join(dict.fromkeys(MEASURED.get(kind, "position") for kind in kinds)) or "position"


def compare(
    cells: Sequence[Installation], blocks: Sequence[PoseMeasurements], frames: str, proves: bool = True, seed: int = 0
) -> Comparison:
    """Return the errors of the nominal arm, the calibrated arm and (if given) the URDF alone on the same rows."""
    (one, two, *alone), both = [errors(cell, blocks) for cell in cells], (cells[0], cells[1])
    first, second = (pair_errors(cell, blocks, seed=seed) for cell in both)
    corners: Any = tuple(room(cell, blocks) for room in REPROJECTION.all() for cell in both)
    return Comparison(
        tuple(blocks),
        both,
        (one, two),
        (first, second),
        pose_count(blocks),
        frames,
        proves,
        alone=alone[0] if alone else None,
        repeated=repeated_poses(both, blocks),
        reprojection=None if None in corners else corners or None,
    )


def compare_unseen(
    cells: Sequence[Installation],
    unseen: Unseen,
    settings: Settings,
    seed: int,
    expected: ErrorModel | None,
    plain: Installation | None = None,
) -> Comparison:
    """Return the errors of the arms on validation rows; base and tool placement are refitted where needed.

    Args:
        cells: nominal and calibrated installation, and that of the URDF alone where it differs.
        unseen: the rows.
        settings: of the placement.
        seed: of the pairs whose distances are compared.
        expected: what errors the fit expects; None without an error model.
        plain: the plain reference.
    """
    block, settled, thin = unseen.block, True, None
    if unseen.own_frames:
        placed = [placed_on(cell, block, settings) for cell in cells]
        cells = [each.cell for each in placed]
        settled = all(each.solution.status.good for each in placed[:2])
        numbers, fitted = sum(piece.part.value.size for piece in placed[1].pieces), len(placed[1].free)
        words = "base and tool placement refitted on these rows"
        if not settled:
            words = "base and tool placement did not converge on these rows"
        elif numbers < MARGIN * fitted:
            thin = numbers, fitted
            words = f"base and tool placement: {fitted} parameters fitted to only {numbers} numbers of these rows"
    elif unseen.held_out:
        words = "those of the fit"
    else:
        words = f"those of the fit, station '{block.station}'" if block.has_instrument else "tool of the fit"
    found = compare(cells, [block], words, settled and thin is None and not unseen.seen, seed)
    sizes, intervals = found.errors[1].position, None
    if expected is not None and isinstance(block, Positions) and sizes is not None:
        sigma, beyond = expected.sigma_on(cells[1], block, unseen.own_frames), outside(block.q, expected.learnt)
        names = tuple(name for name, out in zip(block.joint_names, np.any(beyond, axis=0)) if out)
        intervals = Intervals(sigma, expected.discrepancy.radius * sigma, sizes, np.any(beyond, axis=1), names)
    shares = not (unseen.own_frames or unseen.held_out)
    reference = None
    if plain is not None and settled:
        if unseen.own_frames:
            plain = placed_on(plain, block, settings).cell
        reference = errors(plain, [block])
    return replace(found, settled=settled, placed_by=thin, intervals=intervals, shares_frames=shares, plain=reference)


def interval_cells(found: Comparison) -> np.ndarray:
    """Return the table cells (m, 3) of `INTERVAL` for all rows; NaN if the fit has no error model."""
    if (each := found.intervals) is None:
        return np.full((sum(map(len, found.blocks)), 3), np.nan)
    return np.column_stack([1e3 * each.sigma, 1e3 * each.radius, each.beyond])


def iso9283_sentence(
    found: RepeatedPoses, arm: str, min_poses: int = 5, min_cycles: int = 30, usual_poses: int = 100
) -> str:
    """Return a sentence with repeatability RP and accuracy AP of repeated poses (ISO 9283); `arm`: what was fitted."""
    least, most = found.cycles
    cycles = f"{least}" if least == most else f"{least} to {most}"
    nominal, calibrated = (found.accuracy_mm[arm]["mean"] for arm in ARMS)
    words = (
        f"ISO 9283 on {found.poses} poses repeated {cycles} times: RP {found.repeatability_mm['mean']:.3f} mm "
        f"(at most {found.repeatability_mm['max']:.3f}), AP {nominal:.3f} mm nominal, {calibrated:.3f} mm {arm}"
    )
    few = [f"{min_poses} poses"] * (found.poses < min_poses) + [f"{min_cycles} cycles"] * (least < min_cycles)
    words += f"; the norm requires {' and '.join(few)}" if few else ""
    too_few = f"; too few poses to state an accuracy (makers use {usual_poses})"
    return words + (too_few if found.poses < usual_poses else "")
