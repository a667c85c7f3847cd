"""Figures of the dynamics: from an identification's outcome, or from the files of its folder."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib.dynamics.shapes import Joined
from calib.dynamics.torque_rows import MOTOR
from calib.estimation.whiteness import Whiteness
from calib.procedure.dynamic_stage.geometry_tables import GEOMETRIES, MIN_SHIFT, GeometricEffect, TwoGeometries
from calib.procedure.dynamic_stage.identify import IdentificationOutcome
from calib.procedure.dynamic_stage.metrics import TorqueCurves, UnseenReport
from calib.procedure.report.charts import Captioned, Chart, Panel, bars, level, line, text
from calib.procedure.report.dynamics_section import DynamicReport, IdentifiedParameter, percent, proof_of
from calib.procedure.report.style import AFTER, BEFORE, HALF_WIDTH, MARK, PAGE_WIDTH, QUIET, thinned
from calib.procedure.robot_kinds import Mechanism
from calib.records import read_rows
from calib.units import small

MAX_HALF_PAGE_ROWS = 8  # torque rows whose figures fit half a page
MAX_ELEMENTS = 15  # elements in the ranked figure
MAX_LABELS = 40  # parameters along an axis: more cannot be read on A4


def captioned(found: DynamicReport, folder: Path | None = None) -> dict[str, Captioned]:
    """Return the charts of an identification's report with captions, by name; charts without data are omitted.

    Args:
        folder: of the identification, for its comparison with the nominal geometry.
    """
    unseen = found.unseen
    result = _errors(unseen) | {
        f"torque_{number}": recorded(curves, unseen) for number, curves in enumerate(unseen.curves, 1)
    }
    result |= _of_geometry(found.effects, folder / GEOMETRIES if folder else None)
    if known := [row for row in found.estimate if row.sigma]:
        result["significance"] = _significance(known)
    return result


def figures(outcome: IdentificationOutcome) -> dict[str, Chart]:
    """Return the charts of an identification by name: torques of every recording, residuals, friction."""
    report = UnseenReport.of(outcome.inputs, outcome)
    cases = (*outcome.inputs.unseen, *outcome.inputs.cases)
    curves = (TorqueCurves.of(case, outcome.predictions[case.name]) for case in cases)
    drawn = {f"torque_{number}": recorded(one, report)[0] for number, one in enumerate(curves, 1)}
    return drawn | {name: chart for name, (chart, _) in _errors(report).items()} | friction(outcome)


def recorded(curves: TorqueCurves, report: UnseenReport) -> Captioned:
    """Return the chart of one recording's torques, measured and predicted."""
    raw = {**report.fit, **report.validation}[curves.name].raw
    seen = "fitted" if curves.name in report.fit else "unseen" if curves.name in report.proofs else "repeat"
    title = f"{curves.name}: {percent(raw.total)} unexplained"
    sides = curves.measured.T, curves.predicted.T
    chart = torques(curves.t, *sides, report.rows, report.units, title, raw.joints, curves.band)
    return chart, f"Torques on {curves.name}, {seen}: measured, predicted, and the residual."


def friction(outcome: IdentificationOutcome) -> dict[str, Chart]:
    """Return the chart of friction over velocity, by its name; of mechanisms none.

    It shows the model, and the torques of the first file minus the rigid-body model; the model alone where a row is not
    of one joint (power).
    """
    if isinstance(outcome.inputs.robot, Mechanism):
        return {}
    found, case = outcome.found, outcome.inputs.cases[0]
    model = found.dynamics.model
    terms = list(zip(model.columns, found.dynamics.values[model.inertial :]))
    joints, torque_rows = outcome.inputs.chain.joints, case.torque_rows
    by_joint = torque_rows.projection is None
    if by_joint:
        units = outcome.inputs.row_units[-len(joints) :]
        observed = np.array(case.target - outcome.predictions[case.name])[:, -len(joints) :]
    else:
        units = MOTOR.units([joint.kind == "prismatic" for joint in joints])
        observed = np.zeros((len(case.target), len(joints)))
    v = np.asarray(case.motion.v)
    columns, step = min(len(joints), 4), max(1, len(v) // 1400)
    panels = []
    for j, joint in enumerate(joints):
        grid = np.linspace(v[:, j].min(), v[:, j].max(), 400)
        curve = np.zeros(len(grid))
        for one, value in terms:
            if one.form.of_velocity and one.joint == j:
                for speeds, target in ((grid, curve), (v[:, j], observed[:, j])):
                    still = np.zeros(len(speeds))
                    target += value * one.values(Joined(still, speeds, still))
        cloud = line(v[::step, j], observed[::step, j], ".", BEFORE, size=1.5, label="model + residual")
        words = f"friction [{units[j]}]" if j % columns == 0 or units[j] != units[j - 1] else ""
        speed = f"velocity [{'m/s' if joint.kind == 'prismatic' else 'rad/s'}]"
        model_line = line(grid, curve, width=1.2, label="model")
        panels.append(Panel([cloud, model_line] if by_joint else [model_line], joint.name, speed, words))
    title = f"friction over velocity on {case.name}"
    return {"friction": Chart(panels, 0.5 + 1.55 * -(-len(joints) // columns), columns, title=title)}


def torques(
    t: np.ndarray,
    measured: np.ndarray,
    predicted: np.ndarray,
    rows: Sequence[str],
    units: Sequence[str],
    title: str,
    errors: Sequence[float] | np.ndarray = (),
    band: float = np.nan,
) -> Chart:
    """Return the chart of measured torques, predicted torques and residuals over time.

    Args:
        t: (N,) [s].
        measured, predicted: (N, rows) [units].
        rows, units: names of the torque rows, and their units.
        title: of the whole.
        errors: relative error of each row [%]; none where it is not known.
        band: to which the torques are low-passed [Hz]; NaN: they are as recorded.
    """
    below = "time [s]" + (f"; torques low-passed at {band:.3g} Hz" if np.isfinite(band) else "")
    columns = 2 if len(rows) > MAX_HALF_PAGE_ROWS else 1
    panels = []
    for j, (row, unit) in enumerate(zip(rows, units)):
        left = f": {errors[j]:.3g} % unexplained" if j < len(errors) and np.isfinite(errors[j]) else ""
        own, model = measured[:, j], predicted[:, j]
        lines = [  # thinned here already: a chart of an hour would be held, and pickled, whole
            line(*thinned(t, own), "-", BEFORE, 2.4, label="measured"),
            line(*thinned(t, model), "-", AFTER, 0.7, label="predicted"),
            line(*thinned(t, own - model), "-", QUIET, 0.5, label="measured - predicted"),
        ]
        panels.append(Panel(lines, f"{row} [{unit}]{left}", below, xlim=(t[0], t[-1])))
    return Chart(panels, 0.7 + 0.95 * -(-len(rows) // columns), columns, title=title, shared="x")


def autocorrelations(
    found: Sequence[Whiteness | None], rows: Sequence[str], title: str = "", width: float = PAGE_WIDTH
) -> Chart:
    """Return the chart of the autocorrelation of each row's residual, with the bounds of white noise.

    Args:
        found: of each torque row; None of rows that are too short to say.
        rows: names of the torque rows.
        title: of the whole.
        width: of the figure [in].
    """
    shown = [(row, white) for row, white in zip(rows, found) if white is not None and len(white.acf)]
    columns = min(7 if len(shown) > MAX_HALF_PAGE_ROWS else 4 if width > HALF_WIDTH else 3, max(1, len(shown)))
    panels = [
        Panel(
            [bars([0.0, *white.acf], upright=True, thick=0.4), level(white.bound), level(-white.bound)],
            row,
            "lag [samples]",
            ylim=(-1.0, 1.0),
            xlim=(0.0, len(white.acf) + 1.0),
            ticks=3,
        )
        for row, white in shown
    ]
    height = 0.65 + 0.95 * -(-max(1, len(shown)) // columns)
    return Chart(panels or [Panel([])], height, columns, width, title, shared="xy")


def _of_geometry(effects: Sequence[GeometricEffect], compared: Path | None) -> dict[str, Captioned]:
    """Return the charts on the geometry's effect on the dynamics, by name."""
    result: dict[str, Captioned] = {}
    rows = read_rows(TwoGeometries, compared) if compared and compared.is_file() else ()
    if rows := [row for row in rows if row.essential == "yes" and row.calibrated != 0.0]:
        words = (
            "Essential parameters identified from the same torques on the nominal (CAD) and on the calibrated geometry "
            "(as Fig. 7 of Kolyubin et al. 2019). Above: relative to the calibrated one, bars two sigmas (nominal: "
            "of torque noise; calibrated: with the geometry's uncertainty). Below: difference of the two, "
            "in sigmas of the calibrated one."
        )
        result["geometries"] = _geometries(rows), words
    if known := [row for row in effects if row.sigma is not None]:
        words = (
            "Effect of geometric errors on the dynamics: largest parameter shift caused by one standard deviation of "
            "each error, in that parameter's sigma from torque noise. Below the dashed line no sigma grows by more "
            "than 1 %."
        )
        result["geometry_effects"] = _effects(known[:MAX_ELEMENTS]), words
    return result


def _geometries(rows: Sequence[TwoGeometries]) -> Chart:
    """Return the chart of parameters' values on both geometries, and of the differences in sigmas: the largest ones."""
    table = np.array([(row.nominal, row.sigma_nominal, row.calibrated, row.sigma_calibrated) for row in rows])
    size = np.divide(table[:, 0] - table[:, 2], table[:, 3], out=np.zeros(len(rows)), where=table[:, 3] > 0.0)
    title = f"{int((np.abs(size) > 2.0).sum())} of {len(rows)} parameters change by two sigmas with the geometry"
    chosen = np.sort(np.argsort(-np.abs(size), kind="stable")[:MAX_LABELS])
    which = f"the {len(chosen)} of {len(rows)} that change most" if len(chosen) < len(rows) else ""
    (nominal, s_nominal, own, s_own), size = table[chosen].T, size[chosen]
    x, percent = np.arange(len(chosen)), 100.0 / np.abs(own)
    above = [
        line(x + shift, percent * (values - own), "o", colour, 1.0, 2.5, label=label, spread=2.0 * percent * sigma)
        for values, sigma, colour, shift, label in (
            (nominal, s_nominal, BEFORE, -0.15, "nominal (CAD) geometry"),
            (own, s_own, AFTER, 0.15, "calibrated"),
        )
    ]
    shown = bars(size, [MARK if abs(one) > 2.0 else QUIET for one in size], upright=True)
    panels = [
        Panel(above, y="from calibrated [%]", xnames=[""] * len(chosen), grid="y", symlog=1.0),
        Panel([shown], x=which, y="difference [σ]", xnames=[rows[k].name for k in chosen], grid="y", symlog=2.0),
    ]
    return Chart(panels, 4.2, title=title)


def _effects(rows: Sequence[GeometricEffect]) -> Chart:
    """Return the chart of geometric errors, ranked by the largest parameter shift they cause."""
    size = np.nan_to_num(np.array([row.shift_sigma or 0.0 for row in rows]), posinf=0.0)
    layers = [
        bars(size, [AFTER if one > MIN_SHIFT else QUIET for one in size]),
        level(MIN_SHIFT, upright=True),
        *(text(row.parameter, one, k, (3, 0), along="center") for k, (row, one) in enumerate(zip(rows, size))),
    ]
    labels = [f"{row.element} ({small(row.sigma or 0.0, row.unit, digits=2)})" for row in rows]
    title = f"{int((size > MIN_SHIFT).sum())} of {len(rows)} geometric errors matter"
    limits = 0.0, 1.25 * float(size.max(initial=MIN_SHIFT))
    panel = Panel(layers, title, "shift [σ of torque noise]", xlim=limits, ynames=labels)
    return Chart([panel], 0.7 + 0.19 * len(rows), width=HALF_WIDTH)


def _errors(unseen: UnseenReport) -> dict[str, Captioned]:
    """Return the charts of each row's error [%] and of the autocorrelations, for the recording that decides."""
    _, proof, where = proof_of(unseen)
    fitted, left = (np.nan_to_num(one.raw.joints) for one in (next(iter(unseen.fit.values())), proof))
    shown = [
        bars(fitted, BEFORE, shift=-0.19, thick=0.36, label="training"),
        bars(left, AFTER, shift=0.19, thick=0.36, label="unseen"),
    ]
    title = f"at most {max(left, default=0.0):.3g} % unexplained"
    panel = Panel(shown, x="torque unexplained [%]", ynames=unseen.rows, grid="x")
    width = PAGE_WIDTH if len(unseen.rows) > MAX_HALF_PAGE_ROWS else HALF_WIDTH
    errors = Chart([panel], 0.8 + 0.21 * len(unseen.rows), width=width, title=title)
    name, looked = next(iter((unseen.validation or unseen.fit).items()))
    residuals = autocorrelations(looked.whiteness, unseen.rows, "Residuals", width)
    shares = f"Unexplained share of each torque, on the training motion and on {where}."
    rest = f"Autocorrelation of residuals, low-passed to the identification band, {name}; dashed: white noise limits."
    return {"errors": (errors, shares), "residuals": (residuals, rest)}


def _significance(known: Sequence[IdentifiedParameter]) -> Captioned:
    """Return the chart of each parameter's distance from zero in sigmas; values below two are not significant."""
    share = np.array([max(abs(row.value) / max(row.sigma or 0.0, 1e-300), 0.1) for row in known])
    title = f"{int((share > 2).sum())} of {len(known)} parameters differ from zero by two sigmas"
    chosen = np.sort(np.argsort(share, kind="stable")[:MAX_LABELS])
    which = f"the {len(chosen)} of {len(known)} nearest to zero" if len(chosen) < len(known) else ""
    share, names = share[chosen], [known[k].name for k in chosen]
    shown = bars(share, [AFTER if one > 2 else QUIET for one in share], upright=True, base=0.1)
    limits = 0.1, 2.0 * float(share.max(initial=2.0))
    chart = Chart([Panel([shown, level(2.0)], title, which, "|value| / σ", ylim=limits, log="y", xnames=names)], 2.3)
    return chart, "Distance of each parameter from zero, in its σ; grey: not significant."
