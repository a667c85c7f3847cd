"""Figures on the dynamics, made from an identification's outcome or from the files in its folder."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.dynamics.drives import DriveTerm
from calib.dynamics.shapes import TermMotion
from calib.dynamics.torque_rows import MOTOR
from calib.estimation.whiteness import Whiteness
from calib.identification.rows import Case
from calib.procedure.dynamic_stage.geometry_tables import GEOMETRIES, MIN_SHIFT, GeometricEffect, TwoGeometries
from calib.procedure.dynamic_stage.identify import DynamicsAssessment, IdentificationOutcome
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.procedure.dynamic_stage.metrics import TorqueCurves, UnseenReport
from calib.procedure.report.dynamics_errors import percent
from calib.procedure.report.dynamics_geometry import SIGNIFICANT
from calib.procedure.report.dynamics_section import DynamicReport, IdentifiedParameter, proof_of
from calib.procedure.report.figures.charts import Bars, Captioned, Chart, Label, Level, Line, Panel
from calib.procedure.report.figures.style import AFTER, BEFORE, CURVES, HALF_WIDTH, MARK, PAGE_WIDTH, QUIET
from calib.procedure.robot_kinds import Mechanism
from calib.records import read_rows
from calib.robot.chain import Joint
from calib.units import small

# torque rows whose figures fit half a page
MAX_HALF_PAGE_ROWS = 8
# elements in the ranked figure
MAX_ELEMENTS = 15
# parameters along an axis: more cannot be read on A4
MAX_LABELS = 40
# samples per period of the highest frequency of low-passed torques: their curve looks as if it had all
SAMPLES_PER_CYCLE = 8.0
# points of a cloud of friction, and of its curve
MAX_CLOUD_POINTS = 1400
CURVE_POINTS = 400


def captioned(report: DynamicReport, folder: Path | None = None) -> dict[str, Captioned]:
    """Return the charts of an identification's report with captions, by name; charts without data are omitted.

    Args:
        report: stored results of the identification.
        folder: folder of the identification, with the comparison of nominal and calibrated geometry; None: no chart of
            this comparison.
    """
    unseen = report.unseen
    result = _error_charts(unseen)
    for number, curves in enumerate(unseen.curves, 1):
        result[f"torque_{number}"] = recorded(curves, unseen)
    comparison_file = folder / GEOMETRIES if folder else None
    result |= _geometry_charts(report.effects, comparison_file)
    with_sigma = [row for row in report.estimate if row.sigma]
    if with_sigma:
        result["significance"] = _significance(with_sigma)
    return result


def figures(outcome: IdentificationOutcome) -> dict[str, Chart]:
    """Return the charts of an identification by name: torques of every recording, residuals, and friction.

    Args:
        outcome: the identification.
    """
    report = UnseenReport.of(outcome.inputs, outcome)
    result = {}
    cases = (*outcome.inputs.unseen, *outcome.inputs.cases)
    for number, case in enumerate(cases, 1):
        curves = _sampled(case, outcome.predictions[case.name])
        result[f"torque_{number}"], _ = recorded(curves, report)
    for name, (chart, _) in (_error_charts(report) | friction(outcome)).items():
        result[name] = chart
    return result


def recordings(
    inputs: IdentificationInputs, assessment: DynamicsAssessment, report: UnseenReport
) -> dict[str, Captioned]:
    """Return charts of torques and velocities of the recordings that decide the verdict, by name, with all samples.

    Args:
        inputs: robot and recordings.
        assessment: the model's predictions.
        report: report on the model's errors.
    """
    result: dict[str, Captioned] = {}
    for number, case in enumerate(inputs.unseen or inputs.cases, 1):
        curves = _sampled(case, assessment.predictions[case.name])
        chart, caption = recorded(curves, report)
        linked = f"recording {number}"
        result[f"torque_{number}"] = replace(chart, linked=linked), caption
        if not isinstance(inputs.robot, Mechanism):
            chart = _velocities(case, curves.t, inputs.chain.joints, report.rows)
            caption = f"Velocities of the joints on {case.name}, with the cursor of the torques."
            result[f"velocity_{number}"] = replace(chart, linked=linked), caption
    return result


def _sampled(case: Case, predicted: np.ndarray) -> TorqueCurves:
    """Return the low-passed torques of a recording with as many samples as their band needs.

    Args:
        case: the recording with N samples.
        predicted: (N, rows) torques that the model predicts for it.
    """
    motion = case.motion
    step = _step(case)
    measured, predicted = motion.in_band(np.asarray(case.target)), motion.in_band(predicted)
    return TorqueCurves(case.name, motion.t[::step], measured[::step].T, predicted[::step].T, motion.band)


def _step(case: Case) -> int:
    motion = case.motion
    if not np.isfinite(motion.band):
        return 1
    return max(1, int(motion.rate / (SAMPLES_PER_CYCLE * motion.band)))


def _velocities(case: Case, t: np.ndarray, joints: Sequence[Joint], rows: Sequence[str]) -> Chart:
    """Return a chart of the joints' velocities on a recording.

    Args:
        case: the recording.
        t: (K,) times of the samples of its torques [s].
        joints: the robot's joints.
        rows: names of the torque rows; where they are one per joint, they are the joints' switches, too.
    """
    v = np.asarray(case.motion.v)[:: _step(case)]
    units = set()
    lines = []
    for j, joint in enumerate(joints):
        switch = joint.name
        if len(rows) == len(joints):
            switch = rows[j]
        colour = CURVES[j % len(CURVES)]
        lines.append(Line(t, v[:, j], "-", colour, 0.8, label=joint.name, switch=switch))
        units.add("m/s" if joint.kind == "prismatic" else "rad/s")
    label = f"velocity [{', '.join(sorted(units))}]"
    panel = Panel(lines, x="time [s]", y=label, xlim=(t[0], t[-1]))
    return Chart([panel], 2.0, title=f"velocities on {case.name}")


def recorded(curves: TorqueCurves, report: UnseenReport) -> Captioned:
    """Return a chart of one recording's measured and predicted torques, with a caption.

    Args:
        curves: torques of the recording.
        report: report on the model's errors.
    """
    scores = {**report.fit, **report.validation}
    raw = scores[curves.name].raw
    if curves.name in report.fit:
        role = "fitted"
    elif curves.name in report.proofs:
        role = "unseen"
    else:
        role = "repeat"
    title = f"{curves.name}: {percent(raw.total)} unexplained"
    measured, predicted = curves.measured.T, curves.predicted.T
    chart = torques(curves.t, measured, predicted, report.rows, report.units, title, raw.joints, curves.band)
    return chart, f"Torques on {curves.name}, {role}: measured, predicted, and the residual."


def friction(outcome: IdentificationOutcome) -> dict[str, Captioned]:
    """Return a captioned chart of friction over velocity, with the key ``friction``; empty for mechanisms.

    The chart shows the friction model, and as points the torques of the first training recording minus the rigid-body
    model. If a torque row depends on several joints (such as power), only the friction model is shown.

    Args:
        outcome: the identification.
    """
    if isinstance(outcome.inputs.robot, Mechanism):
        return {}
    dynamics, case = outcome.found.dynamics, outcome.inputs.cases[0]
    model = dynamics.model
    terms = list(zip(model.columns, dynamics.values[model.inertial :]))
    joints = outcome.inputs.chain.joints
    by_joint = case.torque_rows.projection is None
    if by_joint:
        units = outcome.inputs.row_units[-len(joints) :]
        residual = np.array(case.target - outcome.predictions[case.name])[:, -len(joints) :]
    else:
        units = MOTOR.units([joint.kind == "prismatic" for joint in joints])
        residual = np.zeros((len(case.target), len(joints)))

    v = np.asarray(case.motion.v)
    columns = min(len(joints), 4)
    step = max(1, len(v) // MAX_CLOUD_POINTS)
    panels = []
    for j, joint in enumerate(joints):
        grid = np.linspace(v[:, j].min(), v[:, j].max(), CURVE_POINTS)
        curve = np.zeros(len(grid))
        cloud = residual[:, j]
        for column, value in terms:
            if column.form.of_velocity and column.joint == j:
                curve += value * _friction(column, grid)
                cloud += value * _friction(column, v[:, j])
        layers = [Line(grid, curve, width=1.2, label="model")]
        if by_joint:
            layers.insert(0, Line(v[::step, j], cloud[::step], ".", BEFORE, size=1.5, label="model + residual"))
        # the unit stands where it changes, and at the start of a row of panels
        label = ""
        if j % columns == 0 or units[j] != units[j - 1]:
            label = f"friction [{units[j]}]"
        velocity_unit = "m/s" if joint.kind == "prismatic" else "rad/s"
        panels.append(Panel(layers, joint.name, f"velocity [{velocity_unit}]", label))
    title = f"friction over velocity on {case.name}"
    rows = -(-len(joints) // columns)
    chart = Chart(panels, 0.5 + 1.55 * rows, columns, title=title)
    caption = "Friction over velocity: the model, and, light, what the model of the bodies leaves of the torques."
    return {"friction": (chart, caption)}


def _friction(column: DriveTerm, velocity: np.ndarray) -> np.ndarray:
    """Return the values (N,) of a friction term at velocities (N,), with zero position and acceleration.

    Args:
        column: the friction term.
        velocity: velocities of its joint [rad/s or m/s].
    """
    zero = np.zeros(len(velocity))
    return column.values(TermMotion(zero, velocity, zero))


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
    """Return a chart of measured torques, predicted torques and residuals over time.

    Args:
        t: (N,) times [s].
        measured, predicted: (N, rows) torques.
        rows, units: names of the torque rows, and their units.
        title: title of the chart.
        errors: relative error of each row [%]; empty: unknown.
        band: cutoff to which the torques are low-passed [Hz]; NaN: not filtered.
    """
    time_label = "time [s]"
    if np.isfinite(band):
        time_label += f"; torques low-passed at {band:.3g} Hz"
    panels = []
    for j, (row, unit) in enumerate(zip(rows, units)):
        row_title = f"{row} [{unit}]"
        if j < len(errors) and np.isfinite(errors[j]):
            row_title += f": {errors[j]:.3g} % unexplained"
        residual = measured[:, j] - predicted[:, j]
        lines = [
            Line(t, measured[:, j], "-", BEFORE, 2.4, label="measured"),
            Line(t, predicted[:, j], "-", AFTER, 0.7, label="predicted"),
            Line(t, residual, "-", QUIET, 0.5, label="measured - predicted"),
        ]
        panels.append(Panel(lines, row_title, time_label, xlim=(t[0], t[-1]), switch=row))
    columns = 2 if len(rows) > MAX_HALF_PAGE_ROWS else 1
    height = 0.7 + 0.95 * -(-len(rows) // columns)
    return Chart(panels, height, columns, title=title, shared="x")


def autocorrelations(
    whiteness: Sequence[Whiteness | None], rows: Sequence[str], title: str = "", width: float = PAGE_WIDTH
) -> Chart:
    """Return a chart of the autocorrelation of each torque row's residual, with the bounds for white noise.

    Args:
        whiteness: autocorrelation of each torque row; None for rows with too few samples.
        rows: names of the torque rows.
        title: title of the chart.
        width: width of the figure [in].
    """
    panels = []
    for row, white in zip(rows, whiteness):
        if white is None or not len(white.acf):
            continue
        layers = [Bars([0.0, *white.acf], upright=True, thick=0.4), Level(white.bound), Level(-white.bound)]
        lags = 0.0, len(white.acf) + 1.0
        panels.append(Panel(layers, row, "lag [samples]", ylim=(-1.0, 1.0), xlim=lags, ticks=3))
    if not panels:
        panels = [Panel([])]
    if len(panels) > MAX_HALF_PAGE_ROWS:
        columns = 7
    elif width > HALF_WIDTH:
        columns = 4
    else:
        columns = 3
    columns = min(columns, len(panels))
    height = 0.65 + 0.95 * -(-len(panels) // columns)
    return Chart(panels, height, columns, width, title, shared="xy")


def _geometry_charts(effects: Sequence[GeometricEffect], comparison_file: Path | None) -> dict[str, Captioned]:
    """Return charts, by name, on the effect of geometric errors on the dynamic parameters.

    Args:
        effects: effects of geometric errors; empty: no chart.
        comparison_file: table of the parameters on nominal and calibrated geometry; None: no chart.
    """
    result: dict[str, Captioned] = {}
    compared: list[TwoGeometries] = []
    if comparison_file and comparison_file.is_file():
        rows = read_rows(TwoGeometries, comparison_file)
        compared = [row for row in rows if row.essential == "yes" and row.calibrated != 0.0]
    if compared:
        caption = (
            "Essential parameters identified from the same torques on the nominal (CAD) and on the calibrated geometry "
            "(as Fig. 7 of Kolyubin et al. 2019). Above: relative to the calibrated one, bars two sigmas (nominal: "
            "of torque noise; calibrated: with the geometry's uncertainty). Below: difference of the two, "
            "in sigmas of the calibrated one."
        )
        result["geometries"] = _geometries(compared), caption
    with_sigma = [row for row in effects if row.sigma is not None]
    if with_sigma:
        caption = (
            "Effect of geometric errors on the dynamics: largest parameter shift caused by one standard deviation of "
            "each error, in that parameter's sigma from torque noise. Below the dashed line no sigma grows by more "
            "than 1 %."
        )
        result["geometry_effects"] = _effects(with_sigma[:MAX_ELEMENTS]), caption
    return result


def _geometries(rows: Sequence[TwoGeometries]) -> Chart:
    """Return a chart of the parameters on the nominal and the calibrated geometry, and of their differences in σ.

    If there are too many parameters, only those with the largest differences are shown.

    Args:
        rows: the parameters on both geometries.
    """
    nominal = np.array([row.nominal for row in rows])
    calibrated = np.array([row.calibrated for row in rows])
    sigma_nominal = np.array([row.sigma_nominal for row in rows], dtype=float)
    sigma = np.array([row.sigma_calibrated for row in rows], dtype=float)
    difference = np.divide(nominal - calibrated, sigma, out=np.zeros(len(rows)), where=sigma > 0.0)
    changed = int((np.abs(difference) > SIGNIFICANT).sum())
    title = f"{changed} of {len(rows)} parameters change by two sigmas with the geometry"

    # the parameters that change most, in the order of the table
    chosen = np.sort(np.argsort(-np.abs(difference), kind="stable")[:MAX_LABELS])
    label = ""
    if len(chosen) < len(rows):
        label = f"the {len(chosen)} of {len(rows)} that change most"
    nominal, calibrated, difference = nominal[chosen], calibrated[chosen], difference[chosen]
    sigma_nominal, sigma = sigma_nominal[chosen], sigma[chosen]
    x = np.arange(len(chosen))
    percent = 100.0 / np.abs(calibrated)
    above = [
        Line(
            x - 0.15,
            percent * (nominal - calibrated),
            "o",
            BEFORE,
            1.0,
            2.5,
            label="nominal (CAD) geometry",
            spread=2.0 * percent * sigma_nominal,
        ),
        Line(
            x + 0.15,
            percent * (calibrated - calibrated),
            "o",
            AFTER,
            1.0,
            2.5,
            label="calibrated",
            spread=2.0 * percent * sigma,
        ),
    ]
    colours = np.where(np.abs(difference) > SIGNIFICANT, MARK, QUIET).tolist()
    below = [Bars(difference, colours, upright=True)]
    names = [rows[k].name for k in chosen]
    panels = [
        Panel(above, y="from calibrated [%]", xnames=[""] * len(chosen), grid="y", symlog=1.0),
        Panel(below, x=label, y="difference [σ]", xnames=names, grid="y", symlog=SIGNIFICANT),
    ]
    return Chart(panels, 4.2, title=title)


def _effects(rows: Sequence[GeometricEffect]) -> Chart:
    """Return a chart of geometric errors, ranked by the largest parameter shift that one σ of the error causes.

    Args:
        rows: effects of the geometric errors.
    """
    shifts = np.array([row.shift_sigma or 0.0 for row in rows])
    shifts = np.nan_to_num(shifts, posinf=0.0)
    matters = shifts > MIN_SHIFT
    layers = [Bars(shifts, np.where(matters, AFTER, QUIET).tolist()), Level(MIN_SHIFT, upright=True)]
    labels = []
    for k, (row, shift) in enumerate(zip(rows, shifts)):
        layers.append(Label(row.parameter, shift, k, (3, 0), along="center"))
        sigma = small(row.sigma or 0.0, row.unit, digits=2)
        labels.append(f"{row.element} ({sigma})")
    title = f"{int(matters.sum())} of {len(rows)} geometric errors matter"
    limits = 0.0, 1.25 * float(shifts.max(initial=MIN_SHIFT))
    panel = Panel(layers, title, "shift [σ of torque noise]", xlim=limits, ynames=labels)
    return Chart([panel], 0.7 + 0.19 * len(rows), width=HALF_WIDTH)


def _error_charts(unseen: UnseenReport) -> dict[str, Captioned]:
    """Return charts of each torque row's error [%] and residual autocorrelation, by name.

    The errors are those of the recording that decides the verdict.

    Args:
        unseen: report on the model's errors.
    """
    _, proof, motion = proof_of(unseen)
    training = next(iter(unseen.fit.values()))
    training_errors = np.nan_to_num(training.raw.joints)
    proof_errors = np.nan_to_num(proof.raw.joints)
    layers = [
        Bars(training_errors, BEFORE, shift=-0.19, thick=0.36, label="training"),
        Bars(proof_errors, AFTER, shift=0.19, thick=0.36, label="unseen"),
    ]
    title = f"at most {max(proof_errors, default=0.0):.3g} % unexplained"
    panel = Panel(layers, x="torque unexplained [%]", ynames=unseen.rows, grid="x")
    width = PAGE_WIDTH if len(unseen.rows) > MAX_HALF_PAGE_ROWS else HALF_WIDTH
    errors = Chart([panel], 0.8 + 0.21 * len(unseen.rows), width=width, title=title)
    errors_caption = f"Unexplained share of each torque, on the training motion and on {motion}."

    name, score = next(iter((unseen.validation or unseen.fit).items()))
    residuals = autocorrelations(score.whiteness, unseen.rows, "Residuals", width)
    residuals_caption = (
        f"Autocorrelation of residuals, low-passed to the identification band, {name}; dashed: white noise limits."
    )
    return {"errors": (errors, errors_caption), "residuals": (residuals, residuals_caption)}


def _significance(parameters: Sequence[IdentifiedParameter]) -> Captioned:
    """Return a chart of |value| / σ of each parameter, with a caption; below two, a parameter is not significant."""
    value = np.array([row.value for row in parameters])
    sigma = np.array([row.sigma or 0.0 for row in parameters])
    # a logarithmic axis starts at 0.1
    distance = np.maximum(np.abs(value) / np.maximum(sigma, 1e-300), 0.1)
    title = f"{int((distance > SIGNIFICANT).sum())} of {len(parameters)} parameters differ from zero by two sigmas"

    # the parameters nearest to zero, in the order of the table
    chosen = np.sort(np.argsort(distance, kind="stable")[:MAX_LABELS])
    label = ""
    if len(chosen) < len(parameters):
        label = f"the {len(chosen)} of {len(parameters)} nearest to zero"
    distance = distance[chosen]
    names = [parameters[k].name for k in chosen]
    colours = np.where(distance > SIGNIFICANT, AFTER, QUIET).tolist()
    layers = [Bars(distance, colours, upright=True, base=0.1), Level(SIGNIFICANT)]
    limits = 0.1, 2.0 * float(distance.max(initial=SIGNIFICANT))
    panel = Panel(layers, title, label, "|value| / σ", ylim=limits, log="y", xnames=names)
    return Chart([panel], 2.3), "Distance of each parameter from zero, in its σ; grey: not significant."
