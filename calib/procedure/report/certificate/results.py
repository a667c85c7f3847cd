"""Certificate and report of a single fit or identification, outside a session."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from calib.config_types import Plots
from calib.procedure.answers import CertificateSection
from calib.procedure.report.certificate import rendering
from calib.procedure.report.certificate.record import NO_DETAILS, Certificate, Entry, Page, records, report
from calib.procedure.report.figures import figure_data
from calib.procedure.report.page import ChartPicture, Section, chart_pictures
from calib.procedure.report.templates import versions
from calib.units import DEG

if TYPE_CHECKING:
    from calib.procedure.kinematic_stage.metrics import FitMetrics
    from calib.procedure.report.dynamics_section import DynamicReport
    from calib.procedure.report.fit_report import Report


def write_fit(fit_report: Report, drawn: Mapping[str, ChartPicture], folder: Path) -> None:
    """Write certificate and report of a fit into the folder of the fit.

    Args:
        fit_report: stored results of the fit.
        drawn: the report's figures by name; empty: the certificate has no figures either.
        folder: folder of the fit.
    """
    rendering.write(folder, *of_fit(fit_report, drawn))


def read_fit(folder: Path, plots: Plots, details: CertificateSection) -> tuple[Certificate, Page]:
    """Return certificate and report of the fit in a folder.

    Args:
        folder: folder of the fit.
        plots: whether to include figures.
        details: certificate entries made by a person.
    """
    from calib.procedure.kinematic_stage.folder import FitFolder
    from calib.procedure.report import fit_report

    fit = fit_report.read(FitFolder(folder).report)
    drawn = {}
    if plots:
        from calib.procedure.report.geometry_figures import captioned

        drawn = chart_pictures(captioned(fit))
    return of_fit(fit, drawn, details)


def of_fit(
    fit_report: Report, drawn: Mapping[str, ChartPicture], details: CertificateSection = NO_DETAILS
) -> tuple[Certificate, Page]:
    """Return certificate and report of a fit.

    Args:
        fit_report: stored results of the fit.
        drawn: figures by name; empty: no figures.
        details: certificate entries made by a person.
    """
    from calib.procedure.report.certificate import geometry  # slow to load, as all that belongs to a fit

    robot, metrics = fit_report.robot, fit_report.metrics
    measurements = [name for name, role, *_ in fit_report.files if role != "nominal robot"]
    links = f"{fit_report.base} to {fit_report.tip}"
    setup = [
        Entry("robot", f"{robot}, {links}, {len(fit_report.joints)} joints"),
        Entry("description", fit_report.source),
        Entry("measurements", ", ".join(measurements)),
        Entry("model", metrics.model),
        Entry("measured range", measured_range(metrics)),
        Entry("tolerance", tolerance(metrics.tolerance_mm, metrics)),
        Entry("seed", str(metrics.seed)),
        Entry("toolkit", versions()),
    ]
    if loads(metrics):
        setup.append(Entry("load", loads(metrics)))
    stages = [geometry.stage(fit_report, drawn)]
    unchecked = ["dynamics: not identified"]
    return records(f"Calibration of {robot}", "Geometry", setup, stages, unchecked, fit_report.files, details)


def tolerance(millimetres: float | None, metrics: FitMetrics) -> str:
    """Return a text on the condition for the verdict pass, and on the deliverable that is judged.

    Args:
        millimetres: requested tolerance of the position [mm]; None or 0: no tolerance.
        metrics: metrics of the fit.
    """
    from calib.procedure.kinematic_stage.verdict.validation import ARM

    condition = "none given: pass means better than the nominal robot on unseen poses, or no improvement possible"
    if millimetres:
        condition = f"{millimetres:g} mm rms on unseen poses"
    if len(metrics.deliverables) > 1:
        condition += f"; judged: {ARM[metrics.deliverable]}"
    return condition


def measured_range(metrics: FitMetrics) -> str:
    """Return a text on the measured range of each joint, in which the verdict is valid.

    Empty for fits of earlier versions.

    Args:
        metrics: metrics of the fit.
    """
    joint_range = None if metrics.findings is None else metrics.findings.joint_range
    if joint_range is None:
        return ""
    texts = []
    for low, high, unit in zip(joint_range.lower, joint_range.upper, joint_range.units):
        factor, printed_unit = 1.0 / DEG, "°"
        if unit == "m":
            factor, printed_unit = 1e3, " mm"
        texts.append(f"{round(factor * low)}…{round(factor * high)}{printed_unit}")
    return ", ".join(texts)


def loads(metrics: FitMetrics) -> str:
    """Return a text on the masses that the arm carried in fitted and in held-out poses; empty if none is known.

    Args:
        metrics: metrics of the fit, with the errors on held-out poses.
    """
    fitted = metrics.fit.loads_kg
    validated: set[float] = set()
    for rows in metrics.proofs.values():
        validated |= set(rows.loads_kg)
    if not fitted and not validated:
        return ""
    text = f"{_masses(fitted)} fitted" if fitted else "not known of the fitted poses"
    if validated:
        text += f"; validated with {_masses(sorted(validated))}"
    return text


def _masses(values: Sequence[float]) -> str:
    return ", ".join(f"{mass:g}" for mass in values) + " kg"


def write_model(model_report: DynamicReport, drawn: Mapping[str, ChartPicture], folder: Path) -> None:
    """Write certificate and report of an identification into the folder of the identification.

    Args:
        model_report: stored results of the identification.
        drawn: the report's figures by name; empty: the certificate has no figures either.
        folder: folder of the identification.
    """
    rendering.write(folder, *of_model(model_report, drawn))


def read_model(folder: Path, plots: Plots, details: CertificateSection) -> tuple[Certificate, Page]:
    """Return certificate and report of the identification in a folder.

    Args:
        folder: folder of the identification.
        plots: whether to include figures.
        details: certificate entries made by a person.
    """
    from calib.procedure.report import dynamics_section

    model_report = dynamics_section.read(folder)
    drawn = {}
    if plots:
        from calib.procedure.report.dynamics_figures import captioned

        # with all samples, which the report's data have not
        drawn = chart_pictures(captioned(model_report, folder) | figure_data.of_folder(folder))
    return of_model(model_report, drawn, details)


def of_model(
    model_report: DynamicReport, drawn: Mapping[str, ChartPicture], details: CertificateSection = NO_DETAILS
) -> tuple[Certificate, Page]:
    """Return certificate and report of an identification.

    Args:
        model_report: stored results of the identification.
        drawn: figures by name; empty: no figures.
        details: certificate entries made by a person.
    """
    from calib.procedure.report import dynamics_section
    from calib.procedure.report.certificate import dynamics_pages

    unseen, metrics = model_report.unseen, model_report.metrics
    recordings = ", ".join((*unseen.fit, *unseen.validation))
    setup = [
        Entry("robot", unseen.robot),
        Entry("recordings", recordings),
        Entry("torques", f"{len(unseen.rows)} rows"),
        Entry("method", metrics.method),
        Entry("friction", metrics.friction),
        Entry("seed", str(metrics.seed)),
        Entry("toolkit", versions()),
    ]
    section = dynamics_section.report_section(model_report, drawn)
    stages = [dynamics_pages.stage(model_report, section, bool(drawn))]
    unchecked = ["geometry: taken as described"]
    return records(f"Calibration of {unseen.robot}", "Dynamics", setup, stages, unchecked, details=details)


class SectionResult(Protocol):
    """A result that can be shown as a section of a report."""

    def section(self) -> Section: ...


def notebook(result: SectionResult) -> str:
    """Return a result as HTML for a notebook: the certificate's first page for a fit, otherwise a report section."""
    from calib.procedure.kinematic_stage.fit import Outcome
    from calib.procedure.report import fit_report

    if isinstance(result, Outcome):
        certificate, _ = of_fit(fit_report.collect(result), {})
        return rendering.html(replace(certificate, sections=()))
    page = report(repr(result).strip("<>"), "", (), [result.section()])
    return rendering.html(page)
