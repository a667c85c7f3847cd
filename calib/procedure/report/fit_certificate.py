"""The figures and the certificate of a fit, written into its folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from calib import files
from calib.procedure.kinematic_stage.fit import Outcome
from calib.procedure.kinematic_stage.folder import FitFolder
from calib.procedure.report import certificate, fit_report, geometry_section, html
from calib.procedure.report.fit_report import Report
from calib.procedure.report.page import Page, Picture


def write(outcome: Outcome, folder: Path, plots: bool = True) -> None:
    """Write ``report.json``, the figures, and a certificate of the fit alone into a fit's folder.

    Args:
        plots: whether there are to be figures; the certificate is written without them, too.
    """
    report = fit_report.collect(outcome)
    fit_report.write(report, FitFolder(folder).report)
    drawn = draw(report) if plots else {}
    for name, figure in drawn.items():
        files.write(folder / f"plot_{name}.png", figure.png)
    files.write(folder / "certificate.html", html.render(of_fit(report, drawn)))


def draw(report: Report) -> Mapping[str, Picture]:
    """Return the figures by name; matplotlib is loaded here."""
    from calib.procedure.report import figures

    return figures.draw(report)


def of_fit(report: Report, drawn: Mapping[str, Picture]) -> Page:
    """Return the certificate of a fit alone, without a session around it."""
    given = (
        ("robot", f"{report.robot}, {report.base} to {report.tip}, {len(report.joints)} joints"),
        ("model", report.metrics.model),
        ("tolerance", certificate.tolerance(report.metrics.tolerance_mm)),
        ("seed", str(report.metrics.seed)),
        ("toolkit", certificate.versions()),
    )
    section = geometry_section.certificate_section(report, drawn)
    return certificate.certificate(f"Calibration of {report.robot}", "Geometry", given, [section])
