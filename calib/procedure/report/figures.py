"""Which figures a geometric calibration gets, with captions; drawn from a `Report`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.procedure.kinematic_stage.metrics import LadderStep
from calib.procedure.report import geometry_figures
from calib.procedure.report.fit_report import Report, RowErrors
from calib.procedure.report.page import Picture
from calib.procedure.report.style import picture


def draw(report: Report) -> dict[str, Picture]:
    """Return the figures by name; those that the data do not give are left out."""
    result: dict[str, Picture] = {}
    proof = next((rows for rows in report.sets if rows.unseen), report.sets[0])
    label = f"{proof.poses} {'unseen' if proof.unseen else 'fitted'} poses ({proof.name})"
    for nature in ("position", "orientation", "distance"):
        if nature in proof.calibrated:
            sizes = [np.array(arm[nature]) for arm in (proof.nominal, proof.calibrated)]
            figure = geometry_figures.error_histogram(sizes[0], sizes[1], nature, report.noise.get(nature))
            result[nature] = picture(figure, f"{nature.capitalize()} errors before and after, {label}; dashed: rms.")
    rungs = [rung for rung in report.metrics.ladder if rung.cross_validated_mm is not None]
    if len(rungs) > 1:
        result["ladder"] = _ladder(report, rungs)
    if report.singular_values:
        figure = geometry_figures.singular_values(np.array(report.singular_values), report.rank)
        words = "Singular values of the scaled observation matrix: filled ones carry a parameter, open ones none."
        result["singular_values"] = picture(figure, words)
    if proof.q:
        result |= _over_workspace(report, proof, label)
    arm = [row for row in report.parameters if row.group == "arm"]
    if arm:
        change = np.array([row.value - row.nominal for row in arm])
        sigma = np.array([row.sigma for row in arm])
        figure = geometry_figures.parameter_changes([row.name for row in arm], [row.unit for row in arm], change, sigma)
        result["parameters"] = picture(figure, "What the fit changed in the arm. Grey: less than two sigmas.", True)
    if len(report.correlated.names) > 1:
        matrix = np.array(report.correlated.matrix)
        figure = geometry_figures.correlation_map(report.correlated.names, matrix, 0.0)
        result["correlations"] = picture(figure, "Parameters that the data tell apart least.")
    return result


def _ladder(report: Report, rungs: Sequence[LadderStep]) -> Picture:
    figure = geometry_figures.ladder(
        [rung.model for rung in rungs],
        [rung.parameters for rung in rungs],
        [1e-3 * (rung.cross_validated_mm or 0.0) for rung in rungs],
        [not rung.note for rung in rungs],
        report.noise.get("position"),
    )
    return picture(figure, "The ladder of models: error on rows left out. Filled: kept; open: left out.", True)


def _over_workspace(report: Report, proof: RowErrors, label: str) -> dict[str, Picture]:
    """Return the figures that need one error per pose: against the joints, and over the workspace."""
    nature = "position" if "position" in proof.calibrated else "distance"
    before, after = (np.array(arm[nature]) for arm in (proof.nominal, proof.calibrated))
    q, points = np.array(proof.q), np.array(proof.points)
    joints = geometry_figures.residuals_by_joint(q, before, after, report.joints, report.prismatic, nature)
    return {
        "joints": picture(
            joints, f"Errors against each joint, {label}: a trend is something no parameter holds.", True
        ),
        "map": picture(
            geometry_figures.error_map(points, after), f"Remaining error over the workspace, {label}.", True
        ),
    }
