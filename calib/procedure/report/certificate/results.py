"""Certificate and report of a fit or an identification outside sessions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from calib.procedure.answers import CertificateSection
from calib.procedure.report.certificate import rendering
from calib.procedure.report.certificate.record import NO_DETAILS, Certificate, Entry, Page, records, report
from calib.procedure.report.page import Picture, Section
from calib.procedure.report.templates import versions
from calib.units import DEG

if TYPE_CHECKING:
    from calib.procedure.kinematic_stage.metrics import FitMetrics
    from calib.procedure.report.dynamics_section import DynamicReport
    from calib.procedure.report.fit_report import Report


def write_fit(found: Report, drawn: Mapping[str, Picture], folder: Path) -> None:
    """Write certificate and report of a fit into its folder.

    Args:
        drawn: the report's figures by name; without any, the certificate has none either.
    """
    rendering.write(folder, *of_fit(found, drawn))


def read_fit(folder: Path, plots: bool, details: CertificateSection) -> tuple[Certificate, Page]:
    """Return certificate and report of the fit in a folder."""
    from calib.procedure.kinematic_stage.folder import FitFolder
    from calib.procedure.report import fit_report

    found, drawn = fit_report.read(FitFolder(folder).report), {}
    if plots:
        from calib.procedure.report.charts import pictures
        from calib.procedure.report.geometry_figures import captioned

        drawn = pictures(captioned(found))
    return of_fit(found, drawn, details)


def of_fit(
    found: Report, drawn: Mapping[str, Picture], details: CertificateSection = NO_DETAILS
) -> tuple[Certificate, Page]:
    """Return certificate and report of a fit."""
    from calib.procedure.report.certificate import geometry  # slow to load, as all that belongs to a fit

    metrics, title = found.metrics, f"Calibration of {found.robot}"
    measured = ", ".join(name for name, role, *_ in found.files if role != "nominal robot")
    setup = [
        Entry("robot", f"{found.robot}, {found.base} to {found.tip}, {len(found.joints)} joints"),
        Entry("description", found.source),
        Entry("measurements", measured),
        Entry("model", metrics.model),
        Entry("measured range", measured_range(metrics)),
        Entry("tolerance", tolerance(metrics.tolerance_mm, metrics)),
        Entry("seed", str(metrics.seed)),
        Entry("toolkit", versions()),
    ]
    stages, unchecked = [geometry.stage(found, drawn)], ["dynamics: not identified"]
    return records(title, "Geometry", setup, stages, unchecked, found.files, details)


def tolerance(millimetres: float | None, found: FitMetrics) -> str:
    """Return a text on the condition for verdict pass, and on the deliverable to which it applies."""
    from calib.procedure.kinematic_stage.validation import ARM

    of = f"; judged: {ARM[found.deliverable]}" if len(found.deliverables) > 1 else ""
    if not millimetres:
        return f"none given: pass means better than the nominal robot on unseen poses, or no improvement possible{of}"
    return f"{millimetres:g} mm rms on unseen poses{of}"


def measured_range(found: FitMetrics) -> str:
    """Return a text on the joint range that the verdict on a fit is about; empty for fits of earlier versions."""
    held = None if found.findings is None else found.findings.joint_range
    if held is None:
        return ""
    values = zip(held.lower, held.upper, held.units)
    scaled = [(low, high, *((1e3, " mm") if unit == "m" else (1.0 / DEG, "°"))) for low, high, unit in values]
    return ", ".join(f"{round(factor * low)}…{round(factor * high)}{shown}" for low, high, factor, shown in scaled)


def write_model(found: DynamicReport, drawn: Mapping[str, Picture], folder: Path) -> None:
    """Write certificate and report of an identification into its folder.

    Args:
        drawn: the report's figures by name; without any, the certificate has none either.
    """
    rendering.write(folder, *of_model(found, drawn))


def read_model(folder: Path, plots: bool, details: CertificateSection) -> tuple[Certificate, Page]:
    """Return certificate and report of the identification in a folder."""
    from calib.procedure.report import dynamics_section

    found, drawn = dynamics_section.read(folder), {}
    if plots:
        from calib.procedure.report.charts import pictures
        from calib.procedure.report.dynamics_figures import captioned

        drawn = pictures(captioned(found, folder))
    return of_model(found, drawn, details)


def of_model(
    found: DynamicReport, drawn: Mapping[str, Picture], details: CertificateSection = NO_DETAILS
) -> tuple[Certificate, Page]:
    """Return certificate and report of an identification."""
    from calib.procedure.report import dynamics_section
    from calib.procedure.report.certificate import dynamics

    unseen, metrics = found.unseen, found.metrics
    setup = [
        Entry("robot", unseen.robot),
        Entry("recordings", ", ".join((*unseen.fit, *unseen.validation))),
        Entry("torques", f"{len(unseen.rows)} rows"),
        Entry("method", metrics.method),
        Entry("friction", metrics.friction),
        Entry("seed", str(metrics.seed)),
        Entry("toolkit", versions()),
    ]
    stages = [dynamics.stage(found, dynamics_section.report_section(found, drawn), bool(drawn))]
    unchecked = ["geometry: taken as described"]
    return records(f"Calibration of {unseen.robot}", "Dynamics", setup, stages, unchecked, details=details)


class SectionResult(Protocol):
    """A result that is shown as a section of a report."""

    def section(self) -> Section: ...


def notebook(result: SectionResult) -> str:
    """Return a result as a page for a notebook: the first page of a fit's certificate, else its section of a report."""
    from calib.procedure.kinematic_stage.fit import Outcome
    from calib.procedure.report import fit_report

    if isinstance(result, Outcome):
        return rendering.html(replace(of_fit(fit_report.collect(result), {})[0], sections=()))
    return rendering.html(report(repr(result).strip("<>"), "", (), [result.section()]))
