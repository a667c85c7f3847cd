"""The figures and the certificate of a fit, written into its folder."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from calib import files
from calib.procedure.kinematic_stage.fit import Outcome
from calib.procedure.report import figures, page
from calib.procedure.report.fit_report import collect
from calib.procedure.report.style import save


def write(outcome: Outcome, folder: Path) -> None:
    """Write ``report.json``, the figures, and a certificate of the fit alone into a fit's folder."""
    report = collect(outcome)
    files.write_json(folder / "report.json", asdict(report))
    drawn = figures.draw(report)
    for name, figure in drawn.items():
        save(figure.figure, folder / f"plot_{name}.png")
    files.write(folder / "certificate.html", page.render(page.of_fit(report, drawn)))
