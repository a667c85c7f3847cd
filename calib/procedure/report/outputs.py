"""What the folder of a result holds besides its numbers: the data of its report, figures, and pages made by rooms."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib.extensions import Point
from calib.files import write_json

FIT_PAGES: Point[Callable[[Any, Mapping[str, Any], Path], None]] = Point(
    "fit_pages", "writes a fit's certificate into its folder"
)
MODEL_PAGES: Point[Callable[[Any, Mapping[str, Any], Path], None]] = Point(
    "model_pages", "writes an identification's certificate into its folder"
)

if TYPE_CHECKING:
    from calib.procedure.dynamic_stage.identify import IdentificationOutcome
    from calib.procedure.kinematic_stage.fit import Outcome
    from calib.procedure.report.page import Picture


def write_fit(outcome: Outcome, folder: Path, plots: bool = True, pages: bool = True) -> None:
    """Write ``report.json``, figures (if `plots`) and, outside sessions, the certificate of a fit into its folder."""
    from calib.procedure.kinematic_stage.folder import FitFolder
    from calib.procedure.report import fit_report

    report = fit_report.collect(outcome)
    fit_report.write(report, FitFolder(folder).report)
    drawn: Mapping[str, Picture] = {}
    if plots:
        from calib.procedure.report.charts import saved
        from calib.procedure.report.geometry_figures import captioned

        drawn = saved(captioned(report), folder)
    for write in FIT_PAGES.all() if pages else ():
        write(report, drawn, folder)


def write_model(outcome: IdentificationOutcome, folder: Path, plots: bool = True, pages: bool = True) -> None:
    """Write the figure of friction (if `plots`) and, outside sessions, ``report.json``, figures and certificate.

    A session's certificate draws the other figures, with the unseen recordings.
    """
    from calib.procedure.dynamic_stage.folder import UnseenFolder
    from calib.procedure.report import dynamics_section

    drawn: Mapping[str, Picture] = {}
    if plots:
        from calib.procedure.report import charts, dynamics_figures

        charts.save_all(dynamics_figures.friction(outcome), folder)
    if not pages:
        return
    report = dynamics_section.of_outcome(outcome, folder)
    write_json(UnseenFolder(folder).report, report.unseen)
    if plots:
        drawn = charts.saved(dynamics_figures.captioned(report, folder), folder)
    for write in MODEL_PAGES.all():
        write(report, drawn, folder)
