"""Additional files in a result's folder: the report's data, figures, and the certificate."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from calib.files import write_json
from calib.workers.extras import available

if TYPE_CHECKING:
    from calib.procedure.dynamic_stage.identify import IdentificationOutcome
    from calib.procedure.kinematic_stage.fit import Outcome
    from calib.procedure.report.page import Picture


def write_fit(outcome: Outcome, folder: Path, plots: bool = True, pages: bool = True) -> None:
    """Write ``report.json``, figures and certificate of a fit into the folder of the fit.

    Args:
        outcome: the fit.
        folder: folder of the fit.
        plots: whether to draw figures.
        pages: whether to write certificate and report; sessions write these pages later.
    """
    from calib.procedure.kinematic_stage.folder import FitFolder
    from calib.procedure.report import fit_report

    report = fit_report.collect(outcome)
    fit_report.write(report, FitFolder(folder).report)
    drawn: Mapping[str, Picture] = {}
    if plots and available("matplotlib"):
        from calib.procedure.report.charts import saved
        from calib.procedure.report.geometry_figures import captioned

        drawn = saved(captioned(report), folder)
    if pages:
        from calib.procedure.report.certificate import results

        results.write_fit(report, drawn, folder)


def write_model(outcome: IdentificationOutcome, folder: Path, plots: bool = True, pages: bool = True) -> None:
    """Write figures, ``report.json`` and certificate of an identification into the folder of the identification.

    Args:
        outcome: the identification.
        folder: folder of the identification.
        plots: whether to draw figures.
        pages: whether to write everything but the friction figure; a session's certificate step does this later, with
            the held-out recordings.
    """
    from calib.procedure.dynamic_stage.folder import UnseenFolder
    from calib.procedure.report import dynamics_section

    drawn: Mapping[str, Picture] = {}
    plots = plots and available("matplotlib")
    if plots:
        from calib.procedure.report import charts, dynamics_figures

        charts.save_all(dynamics_figures.friction(outcome), folder)
    if not pages:
        return
    report = dynamics_section.of_outcome(outcome, folder)
    write_json(UnseenFolder(folder).report, report.unseen)
    if plots:
        from calib.procedure.report import charts, dynamics_figures

        drawn = charts.saved(dynamics_figures.captioned(report, folder), folder)
    from calib.procedure.report.certificate import results

    results.write_model(report, drawn, folder)
