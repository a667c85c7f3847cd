"""Content of a fit's ``metrics.json``: errors of both arms, tried models, outliers, and the verdict."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from calib.errors import Finding
from calib.geometry.accuracy import ArmErrors, ErrorStatistics
from calib.geometry.checks.joint_range import JointRange
from calib.geometry.error_model import Discrepancy
from calib.geometry.model_choice.ladder import ModelStep
from calib.geometry.repeatability import RepeatedPoses
from calib.geometry.static_torques.sources import MEASURED
from calib.procedure.findings import Verdict

# of metrics.json; 1 had no findings, 2 kept sentences in place of codes
SCHEMA = 3


@dataclass(frozen=True)
class PoseIntervalCoverage:
    """Coverage of the 95 % intervals of position errors that a fit predicts.

    Attributes:
        coverage_percent: share of errors within their intervals [%].
        median_mm: median radius of the intervals [mm].
        sigma_rms_mm: rms of the predicted σ [mm].
        rows: number of rows.
        rows_beyond_learnt_range: number of rows at which a joint is outside the range of the fitted rows.
        joints_beyond_learnt_range: names of these joints.
    """

    coverage_percent: float
    median_mm: float
    sigma_rms_mm: float
    rows: int
    rows_beyond_learnt_range: int
    joints_beyond_learnt_range: tuple[str, ...] = ()


@dataclass(frozen=True)
class ComparedRows:
    """Errors of the nominal and the calibrated arm on one set of rows.

    Attributes:
        poses: number of robot poses.
        frames: text on the source of the base and tool placement.
        nominal, calibrated: errors of the nominal and the calibrated arm.
        urdf_alone: errors of the calibrated geometry without joint corrections; None without corrections.
        pair_distance_mm: arm -> errors of the distances between pairs of positions.
        iso9283: repeatability and accuracy from repeated poses; None without such poses.
        unseen: whether the rows were held out from the fit.
        parameters: number of parameters fitted to these rows; 0 on held-out rows.
        interval95: coverage of the error intervals that the fit predicts; None without an error model.
        reprojection_px: arm -> rms distance between detected and predicted corners.
        plain: errors of the plain reference; None on fitted rows.
        loads_kg: masses that the arm carried beyond its masses, as stated or found from torques; empty if unknown.
        position_means: meaning of the errors ``position_mm``: ``position`` if positions were measured, otherwise the
            component that sockets and planes measure (`calib.geometry.accuracy`).
    """

    poses: int
    frames: str
    nominal: ArmErrors
    calibrated: ArmErrors
    urdf_alone: ArmErrors | None = None
    pair_distance_mm: Mapping[str, ErrorStatistics | None] = field(default_factory=dict)
    iso9283: RepeatedPoses | None = None
    unseen: bool = True
    parameters: int = 0
    interval95: PoseIntervalCoverage | None = None
    reprojection_px: Mapping[str, float] = field(default_factory=dict)
    plain: ArmErrors | None = None
    loads_kg: tuple[float, ...] = ()
    position_means: str = "position"

    def words(self, nature: str) -> str:
        """Return the printed name of an error, which depends on the measurements.

        Args:
            nature: kind of the error: position, orientation or distance.
        """
        if nature == "position":
            return self.position_means
        return nature

    def judged(self, deliverable: str) -> ArmErrors:
        """Return the errors of the deliverable that is judged.

        Args:
            deliverable: ``urdf`` or ``corrections``.
        """
        if deliverable == "urdf" and self.urdf_alone is not None:
            return self.urdf_alone
        return self.calibrated


@dataclass(frozen=True)
class Outlier:
    """A row with a large residual.

    Attributes:
        file, row: file and row number.
        nature: kind of the residual: position, orientation or distance.
        sigmas: size of the residual, in robust standard deviations of all rows.
        size_mm, size_deg: size in mm or in degrees; the other one is None.
    """

    file: str
    row: int
    nature: str
    sigmas: float
    size_mm: float | None = None
    size_deg: float | None = None

    @property
    def size(self) -> str:
        """Size of the residual with its unit, as text."""
        if self.size_deg is None:
            return f"{self.size_mm:.3g} mm"
        return f"{self.size_deg:.3g} deg"

    @property
    def words(self) -> str:
        """File, row number and size of the residual, as text."""
        return f"{Path(self.file).name} row {self.row} ({self.size}, {self.sigmas:.1f} sigma)"


@dataclass(frozen=True)
class Findings:
    """Findings of a fit that the verdict needs in addition to the errors on rows; stored in the fit's folder.

    Attributes:
        model: the chosen model.
        cross_validated, nominal_cross_validated: cross-validated errors of the chosen model and of the nominal arm [m];
            None if not computed.
        outlier_share: share of outliers among the fitted rows.
        reach: reach of the arm [m].
        loss: loss function that was used; empty if unknown.
        noticed: findings on the fit that do not depend on held-out rows, worst first.
        blind: stations that cross-validation could not hold out as a whole, since the other stations do not determine
            their tool; only regions of their poses were held out.
        discrepancy: distribution of the error at a pose, estimated by cross-validation; None if not estimated.
        rigid_cross_validated: cross-validated error of the best model without joint corrections [m]; None if not
            computed.
        joint_range: joint range of the fitted rows; None in files of earlier versions.
        torques: source of the torques that drove the compliance: measured, or modelled by the masses.
    """

    model: str
    cross_validated: float | None
    nominal_cross_validated: float | None
    outlier_share: float
    reach: float
    loss: str = ""
    noticed: tuple[Finding, ...] = ()
    blind: tuple[str, ...] = ()
    discrepancy: Discrepancy | None = None
    rigid_cross_validated: float | None = None
    joint_range: JointRange | None = None
    torques: str = MEASURED


@dataclass(frozen=True, kw_only=True)
class ValidationMetrics:
    """Results of a fit on validation rows: errors, verdict, warnings.

    Attributes:
        validation: name of a validation file -> errors of both arms.
        verdict, reason: level of the verdict, and the reason as text.
        warnings: texts for the user.
        noticed: the findings whose sentences are in the warnings; remarks from reading the files are text only.
        code, advice: code and advice of the finding that decided the verdict; empty for a pass.
        schema: version of the file's format.
        deliverables: verdict on each existing deliverable of `calib.procedure.kinematic_stage.settings.DELIVERABLES`.
        deliverable: name of the deliverable to which `verdict` and `reason` apply; empty in files of earlier versions.
    """

    validation: Mapping[str, ComparedRows]
    verdict: str
    reason: str
    warnings: tuple[str, ...]
    noticed: tuple[Finding, ...] = ()
    code: str = ""
    advice: str = ""
    schema: int = SCHEMA
    deliverables: Mapping[str, Verdict] = field(default_factory=dict)
    deliverable: str = ""


@dataclass(frozen=True, kw_only=True)
class FitMetrics(ValidationMetrics):
    """The content of a fit's ``metrics.json``.

    Attributes:
        fit: errors of both arms on the fitted rows.
        model: name of the chosen model.
        ladder: tried models with their cross-validated errors.
        seed: seed of all random numbers.
        tolerance_mm: largest acceptable rms on held-out poses [mm]; None: none was stated.
        not_identifiable: texts on parameters that the poses do not identify.
        outliers: fitted rows with large residuals, worst first.
        findings: findings that the verdict needs besides the errors; None in files of earlier versions.
        status: how the optimisation ended; empty in files of earlier versions.
    """

    fit: ComparedRows
    model: str
    ladder: tuple[ModelStep, ...]
    seed: int
    tolerance_mm: float | None
    not_identifiable: tuple[str, ...]
    outliers: tuple[Outlier, ...]
    findings: Findings | None = None
    status: str = ""

    @property
    def proofs(self) -> dict[str, ComparedRows]:
        """Errors on each set of validation rows that were held out from the fit: name -> errors."""
        return {name: rows for name, rows in self.validation.items() if rows.unseen}


@dataclass(frozen=True)
class ImageCoverage:
    """Number of corners in each cell of a camera's image area, and their reprojection errors.

    Attributes:
        file: folder of the images.
        size: width and height of the images [px].
        count: number of corners in each cell, row by row.
        rms: rms distance between detected and predicted corners in each cell [px]; 0 in cells without corners.
    """

    file: str
    size: tuple[int, int]
    count: tuple[tuple[int, ...], ...]
    rms: tuple[tuple[float, ...], ...]
