"""Additional files in a result's folder: the report's data, figures, and the certificate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from calib import files
from calib.config_types import Plots
from calib.files import write_json
from calib.procedure.report.figures import figure_files
from calib.procedure.report.page import Pictures, Section, Text, chart_pictures

if TYPE_CHECKING:
    from calib.procedure.dynamic_stage.folder import UnseenFolder
    from calib.procedure.dynamic_stage.identify import DynamicsAssessment, IdentificationOutcome
    from calib.procedure.dynamic_stage.inputs import IdentificationInputs
    from calib.procedure.excitation.design import Designed
    from calib.procedure.excitation.planning import Planned
    from calib.procedure.kinematic_stage.fit import Outcome
    from calib.procedure.report.figures.charts import Captioned


def write_fit(outcome: Outcome, folder: Path, plots: Plots = True, pages: bool = True) -> None:
    """Write ``report.json``, figures and certificate of a fit into the folder of the fit.

    Args:
        outcome: the fit.
        folder: folder of the fit.
        plots: which figures to write: none, their data, or drawings, too.
        pages: whether to write certificate and report; sessions write these pages later.
    """
    from calib.procedure.kinematic_stage.folder import FitFolder
    from calib.procedure.report import fit_report, geometry_figures

    report = fit_report.collect(outcome)
    fit_report.write(report, FitFolder(folder).report)
    charts = geometry_figures.captioned(report) if plots else {}
    figure_files.write(folder, charts, plots, pages)
    if pages:
        from calib.procedure.report.certificate import results

        results.write_fit(report, chart_pictures(charts), folder)


def write_model(outcome: IdentificationOutcome, folder: Path, plots: Plots = True, pages: bool = True) -> None:
    """Write figures, ``report.json`` and certificate of an identification into the folder of the identification.

    Args:
        outcome: the identification.
        folder: folder of the identification.
        plots: which figures to write: none, their data, or drawings, too.
        pages: whether to write everything but the friction figure; a session's certificate step does this later, with
            the held-out recordings.
    """
    from calib.procedure.dynamic_stage.folder import UnseenFolder
    from calib.procedure.report import dynamics_figures, dynamics_section

    charts = dynamics_figures.friction(outcome) if plots else {}
    if not pages:
        figure_files.write(folder, charts, plots, pages)
        return
    report = dynamics_section.of_outcome(outcome, folder)
    write_json(UnseenFolder(folder).report, report.unseen)
    if plots:
        charts |= dynamics_figures.captioned(report, folder)
        charts |= dynamics_figures.recordings(outcome.inputs, outcome, report.unseen)
    figure_files.write(folder, charts, plots, pages)
    from calib.procedure.report.certificate import results

    results.write_model(report, chart_pictures(charts), folder)


def write_recordings(inputs: IdentificationInputs, assessment: DynamicsAssessment, folder: UnseenFolder) -> None:
    """Write torques and velocities of held-out recordings as figures into the folder of their validation.

    Args:
        inputs: robot and recordings.
        assessment: the model's predictions and errors.
        folder: the folder, with its report.
    """
    from calib.procedure.report.dynamics_figures import recordings

    figure_files.write(folder.path, recordings(inputs, assessment, folder.read()), True, paged=False)


def write_design(designed: Designed, folder: Path, plots: Plots = True) -> None:
    """Write the page of a designed motion with its figures into its folder, and drawings if they are asked for."""
    from calib.procedure.excitation.folder import design_lines
    from calib.procedure.report.motion_figures import design_figures

    title = f"Excitation of {designed.inputs.chain.name}"
    _write_motion(title, design_lines(designed), design_figures(designed), folder, plots)


def write_plan(planned: Planned, folder: Path, plots: Plots = True) -> None:
    """Write the page of a planned motion with its figures into its folder, and drawings if they are asked for."""
    from calib.procedure.excitation.folder import plan_lines
    from calib.procedure.report.motion_figures import plan_figures

    title = f"Motion of {planned.chain.name}"
    _write_motion(title, plan_lines(planned), plan_figures(planned), folder, plots)


def _write_motion(
    title: str, lines: Sequence[str], charts: Mapping[str, Captioned], folder: Path, plots: Plots
) -> None:
    from calib.procedure.excitation.folder import PAGE

    figure_files.write(folder, charts, plots, paged=True)
    files.write(folder / PAGE, figures_page(title, lines, charts))


def figures_page(title: str, lines: Sequence[str], charts: Mapping[str, Captioned]) -> str:
    """Return a page with sentences and figures, as HTML.

    Args:
        title: title of the page.
        lines: the sentences.
        charts: the figures by name, with captions.
    """
    from calib.procedure.report.certificate import rendering
    from calib.procedure.report.certificate.record import Page
    from calib.procedure.report.templates import issued

    figures = Pictures("Figures", list(chart_pictures(charts).values()))
    section = Section("Result", [Text("What was found", lines), figures])
    return rendering.html(Page("Figures", title, "", issued(), [section]))
