"""What the folder of a result holds besides its numbers: the data of its report, figures, and pages made by rooms."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from calib import files
from calib.extensions import offered
from calib.procedure.kinematic_stage.fit import Outcome
from calib.procedure.kinematic_stage.folder import FitFolder
from calib.procedure.report import fit_report
from calib.procedure.report.page import Picture

if TYPE_CHECKING:
    from calib.procedure.dynamic_stage.identify import IdentificationOutcome


def write_fit(outcome: Outcome, folder: Path, plots: bool = True, pages: bool = True) -> None:
    """Write ``report.json``, figures (if `plots`) and, outside sessions, the certificate of a fit into its folder."""
    report = fit_report.collect(outcome)
    fit_report.write(report, FitFolder(folder).report)
    drawn: Mapping[str, Picture] = {}
    if plots:
        from calib.procedure.report.geometry_figures import draw

        drawn = draw(report)
    for name, figure in drawn.items():
        files.write(folder / f"plot_{name}.png", figure.image)
    for write in offered("fit_pages") if pages else ():
        write(report, drawn, folder)


def write_model(outcome: IdentificationOutcome, folder: Path, plots: bool = True) -> None:
    """Write figures (if `plots`) and the certificate of an identification into its folder, where the rest is."""
    if plots:
        from calib.procedure.report import dynamics_figures

        dynamics_figures.write(outcome, folder)
    for write in offered("model_pages"):
        write(outcome, folder, plots)
