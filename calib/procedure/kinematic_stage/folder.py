"""Folders of a fit and of a fit's validation in a session: writing and reading their files.

A fit's folder is written completely into a temporary folder, then moved to its final path. Only this module defines the
names of the files.
"""

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from calib import files, folders
from calib.config_types import ParsedTable
from calib.errors import UsageError, refused_as
from calib.estimation.robust import LOSSES
from calib.folders import COVARIANCE, ESTIMATE, METRICS, PAGES, REPORT, InFolder
from calib.geometry import installation
from calib.geometry.error_model import ErrorModel
from calib.geometry.first_guess import install
from calib.geometry.fit import polish_frames
from calib.geometry.weighing import Settings
from calib.procedure.findings import lines_of
from calib.procedure.kinematic_stage import fit_tables, mastering
from calib.procedure.kinematic_stage.fit import Outcome
from calib.procedure.kinematic_stage.inputs import Inputs, plain_reference
from calib.procedure.kinematic_stage.metrics import SCHEMA, Findings, FitMetrics, ValidationMetrics
from calib.procedure.kinematic_stage.verdict.validation import Arms, Assessment
from calib.records import read_json, read_record, shielded
from calib.robot import calibrated
from calib.robot.calibrated import CorrectedChain
from calib.robot.chain import Joint
from calib.robot.formats import urdf_write
from calib.robot.formats.urdf_tree import is_urdf

T = TypeVar("T")
URDF, CORRECTED_URDF = "robot.urdf", "robot_for_corrections.urdf"
RESIDUALS = "residuals.csv"
TERMS = "joint_corrections.csv"
# how to apply these terms; shipped beside this module
FORMULA = "joint_corrections.txt"
FIGURES = (
    "position",
    "orientation",
    "distance",
    "ladder",
    "singular_values",
    "joints",
    "map",
    "rows",
    "parameters",
    "correlations",
)
# files of an earlier fit that a new one replaces
OURS = (
    calibrated.ROBOT,
    URDF,
    CORRECTED_URDF,
    ESTIMATE,
    COVARIANCE,
    calibrated.COVARIANCE,
    RESIDUALS,
    TERMS,
    FORMULA,
    mastering.MASTERING,
    REPORT,
    *PAGES,
    METRICS,
    *folders.figure_files(*FIGURES, "coverage", "coverage_[0-9]*"),
)
# what these folders are called in a session
IN_SESSION = "4-fit"
VALIDATED = "5-validation"


@dataclass(frozen=True)
class FitFolder:
    """Folder of a fit: paths of its files, and functions that read them."""

    path: Path

    robot = InFolder(calibrated.ROBOT)  # the calibrated robot
    urdf = InFolder(URDF)  # the best geometry without joint corrections
    numbers = InFolder(METRICS)  # with verdict and findings
    report = InFolder(REPORT)  # data of the certificate
    residuals = InFolder(RESIDUALS)  # one row for each measured row

    @property
    def tables(self) -> tuple[Path, Path]:
        """Paths of the parameter estimate (``estimate.csv``) and of its covariance (``covariance.csv``)."""
        return self.path / ESTIMATE, self.path / COVARIANCE

    def metrics(self) -> FitMetrics:
        """Read ``metrics.json``: numbers, verdict and findings."""
        return _read(FitMetrics, self.numbers)

    def findings(self) -> Findings:
        """Read the findings of the fit; folders of schema 1 store them in the report, without the loss function."""
        metrics = self.metrics()
        if metrics.findings is not None:
            return metrics.findings
        early = read_json(self.report, "fit again")["judged"]
        return read_record(Findings, _current_form(early | {"notes": metrics.warnings}))

    def arms(self, inputs: Inputs, settings: Settings) -> Arms:
        """Return the nominal and the calibrated arm of the fit.

        The calibrated arm is read from the folder; frames of the nominal arm are refitted to the fitted rows.

        Args:
            inputs: robot and fitted rows.
            settings: settings of the placement.
        """
        findings = self.findings()
        calibrated_cell = installation.read(self.path)
        expected = None
        if findings.discrepancy is not None:
            fitted_q = np.concatenate([block.q for block in inputs.fit])
            free, covariance = fit_tables.read_covariance(self.path, calibrated_cell)
            expected = ErrorModel(calibrated_cell, free, covariance, fitted_q, findings.discrepancy)
        start = install(inputs.chain, inputs.fit, inputs.known)
        # of a loss that was a function, only the name is stored
        loss = findings.loss if findings.loss in LOSSES else settings.loss
        weighing = replace(settings, loss=loss)
        nominal = polish_frames(start, inputs.fit, weighing).cell
        rigid = calibrated.read(self.path).chain
        return Arms(nominal, calibrated_cell, rigid, expected, plain_reference(nominal, inputs))

    def driven(self, inputs: Inputs) -> Inputs:
        """Return inputs whose compliance is driven by the torques that the fit used: measured, or of its masses."""
        reference = calibrated.read(self.path).deflection.reference
        if inputs.gravity is None and reference is not None and reference.inertias is not None:
            return inputs.with_masses(reference.inertias)
        return inputs.driven_by(self.findings().torques)

    def learnt_joints(self, joints: Sequence[Joint]) -> np.ndarray | None:
        """Return the joint values (m, n) [rad or m] of the fitted rows; None without a file of residuals."""
        if not self.residuals.is_file():
            return None
        names = [shielded(f"{joint.name} [{joint.unit}]") for joint in joints]
        with self.residuals.open(encoding="utf-8", newline="") as file:
            fitted = [row for row in csv.DictReader(file) if row["set"] == "fit"]
        if not fitted:
            return None
        q = [[float(row[name]) for name in names] for row in fitted]
        return np.array(q).reshape(-1, len(names))


@dataclass(frozen=True)
class ValidationFolder:
    """Folder of a fit's validation in a session: paths of its files, and functions that read and write them."""

    path: Path

    judged = InFolder(METRICS)  # numbers and verdict
    errors = InFolder("errors.csv")  # one row for each unseen row
    rows = InFolder("rows.json")  # errors of all rows, for figures
    report = InFolder(REPORT)  # data of the certificate

    def write(self, assessment: Assessment, inputs: Inputs, rows: Sequence[object]) -> ValidationMetrics:
        """Write errors, rows and, last, the metrics; return the metrics.

        Args:
            assessment: errors and verdict.
            inputs: robot and measurements.
            rows: errors of each set of rows, for figures.
        """
        fit_tables.write_errors(self.errors, inputs.chain, assessment.validation)
        files.write_json(self.rows, rows)
        files.write_json(self.judged, assessment.record)
        return assessment.record

    def metrics(self) -> ValidationMetrics:
        """Read numbers and verdict; in files of schema 1, warnings of the fit are not included."""
        return _read(ValidationMetrics, self.judged)


def _read(kind: type[T], path: Path) -> T:
    content = read_json(path, "fit again")
    if content.get("schema", 1) > SCHEMA:
        raise UsageError(
            f"{path}: schema {content['schema']} is of a later version, this one reads up to {SCHEMA}: upgrade"
        )
    if content.get("findings"):
        content["findings"] = _current_form(content["findings"])
    with refused_as(UsageError, ValueError, f"{path} cannot be read ({{}}); fit again"):
        return read_record(kind, content | {"schema": content.get("schema", 1)})


def _current_form(findings: ParsedTable) -> ParsedTable:
    """Return findings with the current keys and codes; schemas 1 and 2 stored sentences instead of codes."""
    if "odd" not in findings and "notes" not in findings:
        return findings
    noticed = []

    def add(sentence: str, code: str, accepted: bool) -> None:
        noticed.append({"code": code, "values": {"words": sentence}, "accepted": accepted})

    codes = {"fail": "earlier-fail", "marginal": "earlier-misfit"}
    for contradiction in findings.get("odd", ()):
        code = codes.get(contradiction["level"], "earlier")
        add(contradiction["words"], code, contradiction["accepted"])
    unexplained = findings.get("unexplained")
    if unexplained:
        add(unexplained, "earlier-misfit", False)
    for note in findings.get("notes", ()):
        if note != unexplained:
            add(note, "earlier", False)
    return findings | {"noticed": noticed}


def check_fit_target(out: Path, inputs: Sequence[str | Path | None] = ()) -> None:
    """Check that a fit can be written into a folder.

    Args:
        out: the folder.
        inputs: files that the command reads; None entries are ignored.

    Raises:
        UsageError: if the folder contains other results or input files.
    """
    folders.check_target(out, OURS, (METRICS, calibrated.ROBOT, RESIDUALS), "fit", inputs)


def write_folder(
    outcome: Outcome, out: Path, plots: Callable[[Outcome, Path], None] | None = None, *, owned: bool = False
) -> Path:
    """Write all files of a fit into a folder and return its path; on an error, nothing is written.

    Args:
        outcome: the fit.
        out: path of the folder.
        plots: function that writes figures into the folder; None: no figures.
        owned: whether the folder belongs to the procedure, so that its content is replaced without a check.

    Raises:
        UsageError: if a folder that is not owned contains other results, or an input file.
    """
    if not owned:
        check_fit_target(out, [outcome.inputs.source])

    def write(folder: Path) -> None:
        _write_all(outcome, folder)
        if plots is not None:
            plots(outcome, folder)

    return folders.write_staged(out, OURS, write)


def _write_all(outcome: Outcome, folder: Path) -> None:
    fit, chain, source = outcome.selection.fit, outcome.inputs.chain, outcome.inputs.source
    robot = outcome.robot
    frames = installation.frame_tables(fit.cell)
    calibrated.write(folder, robot, frames, _record(outcome), f"calibrated from {source}")
    mastering.write(folder, outcome)
    urdfs = {URDF: robot.chain}
    if robot.corrections is not None:
        urdfs[CORRECTED_URDF] = robot.corrections.chain
        _write_corrections(robot.corrections, folder)
    for name, geometry in urdfs.items():
        if is_urdf(source):
            urdf_write.edit_file(source, folder / name, chain, geometry)
        else:
            files.write(folder / name, urdf_write.write_new(geometry))
    estimate = fit_tables.estimate_table(fit, outcome.selection.nominal.cell)
    files.write_table(folder / ESTIMATE, fit_tables.HEADER, estimate.rows())
    folders.write_covariance(folder / COVARIANCE, estimate.names, estimate.covariance)
    rows, header = fit_tables.residuals(outcome)
    files.write_table(folder / RESIDUALS, header, rows)
    files.write_json(folder / METRICS, metrics(outcome))


def metrics(outcome: Outcome) -> FitMetrics:
    """Return the content of ``metrics.json`` for the outcome of a fit."""
    tolerance_mm = None
    if outcome.settings.tolerance is not None:
        tolerance_mm = 1e3 * outcome.settings.tolerance
    assessed = outcome.assessment.record
    return FitMetrics(
        validation=assessed.validation,
        verdict=assessed.verdict,
        reason=assessed.reason,
        code=assessed.code,
        advice=assessed.advice,
        warnings=assessed.warnings,
        noticed=assessed.noticed,
        deliverables=assessed.deliverables,
        deliverable=assessed.deliverable,
        fit=outcome.fit.record(outcome.selection.fit.identified),
        model=outcome.selection.chosen,
        ladder=outcome.selection.rungs,
        seed=outcome.settings.seed,
        status=outcome.selection.fit.solution.status.name.lower(),
        tolerance_mm=tolerance_mm,
        not_identifiable=tuple(lines_of(outcome.undetermined)),
        outliers=tuple(outcome.outliers),
        findings=outcome.findings,
    )


def _record(outcome: Outcome) -> dict[str, object]:
    """Return the entries of ``robot.toml`` on the fit: files, model, seed, verdict and nominal frames.

    Args:
        outcome: the fit.
    """
    verdict = outcome.verdict
    nominal_frames = installation.frame_tables(outcome.nominal_cell)
    record: dict[str, object] = {f"nominal_{kind}": table for kind, table in nominal_frames.items()}
    record["files"] = [block.file for block in outcome.inputs.fit]
    record["model"] = outcome.selection.chosen
    record["seed"] = outcome.settings.seed
    if verdict.level:
        record["verdict"] = f"{verdict.level}: {verdict.reason}"
    record["covariance"] = COVARIANCE
    return record


def _write_corrections(corrections: CorrectedChain, folder: Path) -> None:
    """Write the table of joint corrections, which a URDF cannot contain, and a text on how to apply them.

    Args:
        corrections: the arm's joint corrections.
        folder: folder to write into.
    """
    chain, deflection = corrections.chain, corrections.deflection
    unit_of = dict(zip(chain.names, chain.units))
    joint_of = {element.name: element.joint for element in chain.elements}
    rows = []
    for term, coefficient in zip(deflection.terms, np.asarray(deflection.coefficients)):
        joint = joint_of[term.element]
        corrected = term.element if joint is None else chain.joint_names[joint]
        source = chain.joint_names[term.source]
        rows.append([corrected, unit_of[term.element], term.basis, source, term.order, float(coefficient)])
    files.write_table(folder / TERMS, ("corrected", "unit", "basis", "joint", "order", "coefficient"), rows)
    files.write(folder / FORMULA, Path(__file__).with_name(FORMULA).read_text(encoding="utf-8"))
