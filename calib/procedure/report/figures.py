"""Which figures a certificate gets, with captions: of the geometry from a `Report`, of the dynamics from its own."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib.folders import METRICS
from calib.procedure.report import geometry_figures
from calib.procedure.report.charts import Chart, picture
from calib.procedure.report.fit_report import Report, RowErrors
from calib.procedure.report.page import Picture, Pictures
from calib.procedure.report.style import HALF_WIDTH, PAGE_WIDTH
from calib.records import read_json

if TYPE_CHECKING:  # the figures of a fit are drawn without loading the dynamics' modules
    from calib.procedure.dynamic_stage.metrics import UnseenReport
    from calib.procedure.report.dynamics_section import DynamicReport

DRAWN = 300  # points per curve of the excitation

Captioned = tuple[Chart, str]  # with what it shows, in a sentence


def draw(report: Report) -> dict[str, Picture]:
    """Return the figures of a report as pictures by name, drawn once."""
    return {name: picture(*found) for name, found in captioned(report).items()}


def captioned(report: Report) -> dict[str, Captioned]:
    """Return the charts of a report by name; those that the data do not give are left out."""
    result: dict[str, Captioned] = {}
    proof = next((rows for rows in report.sets if rows.unseen), report.sets[0])
    label = f"{proof.poses} {'unseen' if proof.unseen else 'fitted'} poses ({proof.name})"
    for nature in ("position", "orientation", "distance"):
        if nature in proof.calibrated:
            sizes = [np.array(arm[nature]) for arm in (proof.nominal, proof.calibrated)]
            chart = geometry_figures.error_histogram(sizes[0], sizes[1], nature, report.noise.get(nature))
            result[nature] = chart, f"{nature.capitalize()} errors before and after, {label}; dashed: rms."
    rungs = [rung for rung in report.metrics.ladder if rung.cross_validated_mm is not None]
    if len(rungs) > 1:
        chart = geometry_figures.ladder(
            [rung.model for rung in rungs], [rung.parameters for rung in rungs],
            [1e-3 * (rung.cross_validated_mm or 0.0) for rung in rungs], [not rung.note for rung in rungs],
            report.noise.get("position"),
        )  # fmt: skip
        result["ladder"] = chart, "Models tried, by their cross-validated error. Filled: kept; open: left out."
    if report.singular_values:
        chart = geometry_figures.singular_values(np.array(report.singular_values), report.rank)
        words = "Singular values of the scaled observation matrix: filled ones carry a parameter, open ones none."
        result["singular_values"] = chart, words
    if proof.q:
        result |= _over_workspace(report, proof, label)
    for number, seen in enumerate(report.images, 1):
        chart = geometry_figures.image_coverage(seen.size, np.array(seen.count), np.array(seen.rms))
        words = f"Where in the image corners were seen, and how well they are predicted there ({seen.file})."
        result["coverage" if number == 1 else f"coverage_{number}"] = chart, words
    arm = [row for row in report.parameters if row.group == "arm"]
    if arm:
        change = np.array([row.value - row.nominal for row in arm])
        sigma = np.array([row.sigma for row in arm])
        names, units = [row.name for row in arm], [row.unit for row in arm]
        chart = geometry_figures.parameter_changes(names, units, change, sigma)
        result["parameters"] = chart, "What the fit changed in the arm. Grey: less than two sigmas."
    if len(report.correlated.names) > 1:
        chart = geometry_figures.correlation_map(report.correlated.names, np.array(report.correlated.matrix), 0.0)
        result["correlations"] = chart, "The most strongly correlated parameters."
    return result


def _over_workspace(report: Report, proof: RowErrors, label: str) -> dict[str, Captioned]:
    """Return the charts that need one error per pose: against the joints, and over the workspace."""
    nature = "position" if "position" in proof.calibrated else "distance"
    before, after = (np.array(arm[nature]) for arm in (proof.nominal, proof.calibrated))
    q, points = np.array(proof.q), np.array(proof.points)
    joints = geometry_figures.residuals_by_joint(q, before, after, report.joints, report.prismatic, nature)
    below = "; below: 95 % are expected within." if proof.expected else "."
    return {
        "joints": (joints, f"Errors against each joint, {label}: a trend is an unmodelled effect."),
        "map": (
            geometry_figures.error_map(points, after, expected=np.array(proof.expected)),
            f"Remaining error over the workspace, {label}{below}",
        ),
    }


def draw_dynamics(found: DynamicReport, folder: Path, excitation: Path | None) -> dict[str, Pictures]:
    """Return the figures of the dynamics by name, as a page shows them; those that the data do not give are empty.

    Args:
        folder: of the identification.
        excitation: folder with ``training/trajectory.csv`` and its ``metrics.json``; None where other motions
            were played.
    """
    from calib.procedure.report import dynamics_figures

    return {
        "errors": Pictures("", _judged(found.unseen)),
        "torques": Pictures("Torques", _torques(found.unseen)),
        "excitation": Pictures("Excitation", [] if excitation is None else _excitation(excitation)),
        "geometry": Pictures("", list(dynamics_figures.from_folder(folder).values())),
        "parameters": Pictures("Dynamic parameters", [_significance(found)]),
    }


def _judged(unseen: UnseenReport) -> list[Picture]:
    """Return errors by row and autocorrelations of the recording that judges."""
    from calib.procedure.report import dynamics_figures
    from calib.procedure.report.dynamics_section import proof_of

    _, proof, where = proof_of(unseen)
    own = next(iter(unseen.fit.values()))
    sides = [np.nan_to_num(one.raw.joints) for one in (own, proof)]
    name, looked = next(iter((unseen.validation or unseen.fit).items()))
    width = PAGE_WIDTH if len(unseen.rows) > dynamics_figures.MAX_HALF_PAGE_ROWS else HALF_WIDTH
    bars = dynamics_figures.errors_by_row(sides[0], sides[1], unseen.rows)
    drawn = dynamics_figures.autocorrelations(looked.whiteness, unseen.rows, "Residuals", width)
    shares = f"Share of each torque that the model leaves, on the training motion and on {where}."
    rest = f"Autocorrelation of the residuals below the band on {name}; dashed: white noise."
    return [picture(bars, shares), picture(drawn, rest)]


def _torques(unseen: UnseenReport) -> list[Picture]:
    """Return measured and predicted torques of each unseen recording, or of those fitted."""
    from calib.procedure.report import dynamics_figures
    from calib.procedure.report.dynamics_section import percent

    seen = "unseen" if unseen.validation else "fitted"
    result = []
    for curves in unseen.curves:
        raw = {**unseen.fit, **unseen.validation}[curves.name].raw
        sides = curves.measured.T, curves.predicted.T
        title = f"{curves.name}: {percent(raw.total)} of the torque unexplained"
        chart = dynamics_figures.torques(curves.t, *sides, unseen.rows, unseen.units, title, raw.joints)
        result.append(picture(chart, f"Torques on {curves.name}, {seen}: measured, predicted, and the residual."))
    return result


def _excitation(excitation: Path) -> list[Picture]:
    """Return the designed motion, and how well it identifies the parameters; nothing where none was designed."""
    from calib.procedure.excitation import coefficients
    from calib.procedure.excitation.metrics import DesignMetrics
    from calib.procedure.report import motion_figures

    folder = excitation / "training"
    if not (folder / coefficients.NAME).exists():
        return []
    motion = coefficients.read(folder)
    t = np.linspace(0.0, motion.period, DRAWN)
    q, v, _ = motion.orders(t)
    made = read_json(folder / METRICS, "design the motion again", DesignMetrics)
    margins = ", ".join(f"{name} {one.share:.1%} of its scale" for name, one in made.margins.items())
    words = (
        f"The training motion, one period of {made.setting.period:g} s: condition number "
        f"{made.condition_number.raw:.3g} raw, {made.condition_number.normalised:.3g} with unit columns, of "
        f"{len(made.setting.columns)} columns. Every limit was kept, at and between {made.setting.instants_verified} "
        f"instants; smallest margins: {margins}."
    )
    names, none = motion.joint_names, np.full(q.shape[1], np.inf)
    series = [(each, -none, none, title) for each, title in ((q, "position"), (v, "velocity"))]
    return [picture(motion_figures.motion_sheet(t, series, ("rad", "rad/s"), names), words)]


def _significance(found: DynamicReport) -> Picture:
    """Return the figure of parameters over their sigma."""
    from calib.procedure.report import dynamics_figures

    known = [row for row in found.estimate if row.sigma]
    sigma = np.array([row.sigma or np.nan for row in known])
    values = np.array([row.value for row in known])
    chart = dynamics_figures.significance([row.name for row in known], values, sigma)
    return picture(chart, "How far each parameter is from zero, in its σ; grey: not significant.")
