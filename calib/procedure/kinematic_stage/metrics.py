"""What ``metrics.json`` of a fit holds, as values: errors of both arms, the ladder, outliers, the verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from calib.geometry.uncertainty.error_model import Discrepancy
from calib.procedure.findings import SpelledFinding as Finding
from calib.procedure.findings import Verdict
from calib.procedure.sigma_comparison import SigmaComparison


@dataclass(frozen=True)
class ErrorStatistics:
    """Sizes of errors in mm or deg."""

    mean: float
    rms: float
    p95: float
    max: float


@dataclass(frozen=True)
class _ArmErrors:
    """Errors of one arm by nature; None where nothing of the kind was measured."""

    position_mm: ErrorStatistics | None = None
    orientation_deg: ErrorStatistics | None = None
    distance_mm: ErrorStatistics | None = None

    @property
    def main(self) -> ErrorStatistics | None:
        """What is judged by: positions, or distances where there are no positions [mm]."""
        return self.position_mm or self.distance_mm


@dataclass(frozen=True)
class _MeanAndMax:
    """Of some sizes."""

    mean: float
    max: float


@dataclass(frozen=True)
class _BothArms:
    """The same of the nominal and of the calibrated arm."""

    nominal: _MeanAndMax
    calibrated: _MeanAndMax


@dataclass(frozen=True)
class RepeatedPose:
    """One pose measured several times: its rows, AP of both arms per axis, RP, vAP; mm and deg."""

    rows: tuple[int, ...]
    repeatability_mm: float
    nominal_mm: tuple[float, ...]
    calibrated_mm: tuple[float, ...]
    repeatability_deg: tuple[float, ...] = ()
    multidirectional_mm: float | None = None


@dataclass(frozen=True)
class RepeatedPoses:
    """Accuracy and repeatability of poses that were measured several times (`iso9283`)."""

    poses: int
    cycles: tuple[int, int]
    repeatability_mm: _MeanAndMax
    accuracy_mm: _BothArms
    each: tuple[RepeatedPose, ...] = ()


@dataclass(frozen=True)
class _IntervalCoverage:
    """How many errors were within the 95 % interval that the fit states, how wide that was, where it extrapolated."""

    coverage_percent: float
    median_mm: float
    sigma_rms_mm: float
    rows: int
    rows_beyond_learnt_range: int
    joints_beyond_learnt_range: tuple[str, ...] = ()


@dataclass(frozen=True)
class ComparedRows:
    """Both arms on one set of rows.

    Attributes:
        poses: how many robot poses.
        frames: whose base and tool placement was used, in words.
        nominal, calibrated: their errors.
        urdf_alone: those of the calibrated geometry without joint corrections.
        pair_distance_mm: arm → errors of the distances between pairs of positions.
        iso9283: of repeated poses.
        unseen: False where rows are none that the fit had not seen.
        parameters: how many were fitted, on the fit's own rows.
        interval95: how the errors that the fit stated held here.
    """

    poses: int
    frames: str
    nominal: _ArmErrors
    calibrated: _ArmErrors
    urdf_alone: _ArmErrors | None = None
    pair_distance_mm: Mapping[str, ErrorStatistics] = field(default_factory=dict)
    iso9283: RepeatedPoses | None = None
    unseen: bool = True
    parameters: int = 0
    interval95: _IntervalCoverage | None = None

    def judged(self, deliverable: str) -> _ArmErrors:
        """Return the errors of what is to be delivered."""
        return self.calibrated if deliverable != "urdf" or self.urdf_alone is None else self.urdf_alone


@dataclass(frozen=True)
class LadderStep:
    """One model tried, with its error on held-out rows; of its parameters `corrections` are shrunk by a ridge."""

    model: str
    parameters: int
    cross_validated_mm: float | None
    kept: bool
    note: str = ""
    corrections: int = 0


@dataclass(frozen=True)
class OutlierRow:
    """A row that does not fit, in robust standard deviations and in mm or deg."""

    file: str
    row: int
    nature: str
    sigmas: float
    size_mm: float | None = None
    size_deg: float | None = None


@dataclass(frozen=True)
class Findings:
    """What a fit says of itself and a verdict needs beside the errors on rows; kept in the fit's folder.

    Attributes:
        model: the one chosen.
        cross_validated, nominal_cross_validated: errors of the chosen model and of the nominal arm on rows left out
            [m]; None where they were not computed.
        outlier_share: of the fit's rows.
        unexplained: that no rigid geometry explains the measurements, in words, where that decides; else empty.
        reach: of the arm [m].
        loss: that was used; empty where it is not known.
        notes: what a user should know of the fit, whatever the unseen rows are.
        blind: stations whose rows were left out by regions only, since the others do not tell where their tool is.
        rigid_cross_validated: the error of the best model without joint corrections [m].
        discrepancy: what makes an error at a pose likely, learnt on rows left out; None where nothing was.
        odd: what cannot be of this arm, see `calib.procedure.kinematic_stage.plausibility`.
    """

    model: str
    cross_validated: float | None
    nominal_cross_validated: float | None
    outlier_share: float
    unexplained: str
    reach: float
    loss: str = ""
    notes: tuple[str, ...] = ()
    blind: tuple[str, ...] = ()
    odd: tuple[Finding, ...] = ()
    discrepancy: Discrepancy | None = None
    rigid_cross_validated: float | None = None


@dataclass(frozen=True)
class ValidationMetrics:
    """What holding a fit against unseen rows came to: their errors, the verdict, what to know.

    Attributes:
        deliverables: the verdict on each of `calib.procedure.kinematic_stage.settings.DELIVERABLES` that there is.
        deliverable: which of them `verdict` and `reason` are about; empty in files of earlier versions.
    """

    validation: Mapping[str, ComparedRows]
    verdict: str
    reason: str
    warnings: tuple[str, ...]
    schema: int = 1
    deliverables: Mapping[str, Verdict] = field(default_factory=dict)
    deliverable: str = ""


@dataclass(frozen=True)
class FitMetrics:
    """The content of ``metrics.json``; see `calib.procedure.kinematic_stage.folder`."""

    fit: ComparedRows
    validation: Mapping[str, ComparedRows]
    model: str
    ladder: tuple[LadderStep, ...]
    seed: int
    verdict: str
    reason: str
    tolerance_mm: float | None
    warnings: tuple[str, ...]
    not_identifiable: tuple[str, ...]
    outliers: tuple[OutlierRow, ...]
    findings: Findings | None = None
    predicted_sigmas: tuple[SigmaComparison, ...] = ()
    schema: int = 1
    deliverables: Mapping[str, Verdict] = field(default_factory=dict)
    deliverable: str = ""

    @property
    def proofs(self) -> dict[str, ComparedRows]:
        """Sets of rows that the fit has not seen, by name."""
        return {name: rows for name, rows in self.validation.items() if rows.unseen}
