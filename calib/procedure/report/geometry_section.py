"""The report section on the geometry, which is also the console output of a fit."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from calib.errors import counted
from calib.geometry.accuracy import ErrorStatistics, rms_sigma
from calib.geometry.model_choice.ladder import MAX_RESIDUAL
from calib.geometry.repeatability import RepeatedPose
from calib.procedure.findings import as_notes
from calib.procedure.kinematic_stage.inputs import Inputs
from calib.procedure.kinematic_stage.metrics import ComparedRows, FitMetrics, Outlier
from calib.procedure.kinematic_stage.verdict.comparison import iso9283_sentence
from calib.procedure.kinematic_stage.verdict.validation import ARM
from calib.procedure.report import page
from calib.procedure.report.fit_report import CROSS_VALIDATED, Report, RowErrors
from calib.units import ERRORS, SMALL

# key of `Errors` and its nature and unit, as ``position_mm``
KINDS = {f"{nature}_{unit}": (nature, unit) for nature, (_, unit) in ERRORS.items()}
# fields of `ComparedRows` and their names, in the order of the tables
ARMS = {"nominal": "nominal", "urdf_alone": ARM["urdf"], "calibrated": ARM["corrections"]}
# parameters beyond which joint corrections are not listed
MAX_ROWS = 60
# repeated poses that are listed
MAX_POSES = 30
# outliers that are listed, and those that are named in a sentence
MAX_OUTLIERS = 20
MAX_NAMED_OUTLIERS = 8
# pairs of correlated parameters that are named
MAX_PAIRS = 8
ISO_NOTE = (
    "After ISO 9283. AP: barycentre of a pose's cycles minus the command (pose by the arm's model, with station and "
    "tool as fitted). RP: mean distance from the barycentre plus three standard deviations. vAP: largest distance "
    "between barycentres approached from different directions. The norm requires 5 poses of 30 cycles. Five poses are "
    "too few to state an accuracy (makers use 100 or more): see the errors on unseen poses. "
    "Repeatability is the lower limit of what calibration can reach."
)
MEANS = {
    "socket scatter": "Socket scatter: distance of a predicted point from the mean of its socket's points.",
    "plane distance": "Plane distance: of a predicted point from the plane through the points of its group.",
}
ALONE_NOTE = (
    "A URDF cannot contain joint corrections. Calibrated: robot.urdf, the best geometry without them; with joint "
    "corrections: robot_for_corrections.urdf with joint_corrections.csv."
)


def read_lines(inputs: Inputs) -> list[str]:
    """Return lines of text that list the robot and the measurements that were read.

    Args:
        inputs: robot and measurements of the fit.
    """
    chain = inputs.chain
    lines = [f"robot {chain.name}: {chain.n} joints, {chain.base} to {chain.tip}"]
    for block in inputs.fit:
        line = f"{Path(block.file).name}: {len(block)} rows of kind {block.kind}"
        if len(block.tool_names) > 1:
            line += f", {len(block.tool_names)} targets"
        line += f", sigmas {'stated' if block.states_sigma else 'estimated'}"
        if block.ignored:
            line += f"; ignored: {', '.join(block.ignored)}"
        lines.append(line)
    for name, unseen in inputs.unseen.items():
        role = "held out" if unseen.held_out else "validation"
        lines.append(f"{name}: {len(unseen.block)} rows of kind {unseen.block.kind}, not used in the fit ({role})")
    return lines


def outcome_section(metrics: FitMetrics) -> page.Section:
    """Return the console output on a fit: tried models, errors, repeated poses, findings, and verdict.

    Args:
        metrics: metrics of the fit.
    """
    sets = _sets(metrics)
    blocks: list[page.Block] = [_ladder_table(metrics), error_table(sets, metrics.deliverable)]
    lines = [f"model {metrics.model}, {parameter_words(metrics)}"]
    for label, rows in sets:
        lines.append(f"{label}: {_rms_words(rows, metrics.deliverable)}")
    blocks.append(page.Text("", lines))
    # a warning may contain the verdict's advice already
    if metrics.advice and not any(metrics.advice in warning for warning in metrics.warnings):
        blocks.append(page.Text("", [metrics.advice], "what to do"))
    blocks.append(page.Text("", _repeated_sentences(metrics)))
    blocks.append(page.Text("", outlier_sentences(metrics), "outliers"))
    blocks.append(page.Text("", as_notes(metrics.warnings, metrics.noticed), "note"))
    blocks.append(page.Text("", metrics.not_identifiable, "identifiability"))
    return page.Section("Geometry", blocks, metrics.verdict, metrics.reason)


def report_section(report: Report, figures: Mapping[str, page.ChartPicture]) -> page.Section:
    """Return the report section on the geometry: errors, tried models, parameters, identifiability, figures, outliers.

    Args:
        report: stored results of the fit.
        figures: figures by name (`geometry_figures.captioned`); absent figures are left out of the section.
    """
    metrics = report.metrics
    blocks: list[page.Block] = [error_table(_sets(metrics), metrics.deliverable), *iso9283_tables(metrics)]
    blocks.append(page.pictures("Before and after", figures, ("position", "orientation", "distance")))
    blocks.append(page.pictures("What remains", figures, ("joints", "map", "rows")))
    coverage = [name for name in figures if name.startswith("coverage")]
    blocks.append(page.pictures("Image coverage", figures, coverage))
    if any(step.cross_validated_mm is not None for step in metrics.ladder):
        blocks.append(_ladder_table(metrics))
        blocks.append(page.pictures("", figures, ("ladder",)))
    blocks.append(page.Text("Identifiability", _identifiability(report)))
    blocks.append(page.pictures("Parameters", figures, ("parameters", "singular_values", "correlations")))
    blocks.append(_parameter_table(report))
    if metrics.outliers:
        blocks.append(_outlier_table(metrics))
    blocks.append(page.Text("Notes", metrics.warnings))
    return page.Section("Geometry", blocks, metrics.verdict, metrics.reason, _key_figures(report))


def _key_figures(report: Report) -> list[page.KeyFigure]:
    """Return the errors of the nominal and the calibrated robot on which the verdict is based.

    They are those of the worst held-out rows. Without held-out rows, they are the cross-validated errors if the verdict
    is based on these, otherwise the errors on the fitted rows.

    Args:
        report: stored results of the fit.
    """
    metrics = report.metrics
    if not metrics.proofs:
        cross_validated = _cross_validated_figure(metrics)
        if cross_validated is not None:
            return [cross_validated]

    proof, rows = deciding(report)
    if rows is not None and rows.name == CROSS_VALIDATED:
        role = CROSS_VALIDATED
    elif metrics.proofs:
        role = "unseen"
    else:
        role = "fitted"
    basis = f"{proof.poses} {role} poses"

    # the arm that is delivered comes first
    arms = {"calibrated": ""}
    if proof.urdf_alone is not None:
        arms = {"urdf_alone": ARM["urdf"], "calibrated": ARM["corrections"]}
    if metrics.deliverable == "corrections":
        arms = dict(reversed(arms.items()))
    delivered = next(iter(arms))

    figures = []
    for key, (nature, unit) in KINDS.items():
        before = getattr(proof.nominal, key)
        for arm, arm_name in arms.items():
            after = _arm_errors(proof, arm, key)
            if before is None or after is None:
                continue
            suffix = f" ({arm_name})" if arm_name else ""
            spread = _rms_spread(rows, arm, nature)
            allowed = met = ""
            # the tolerance holds for the main error alone: position, else distance
            if before is proof.nominal.main:
                tolerance = metrics.tolerance_mm or 0.0
                allowed = f"{tolerance:g} mm" if tolerance else "none"
                met = page.met(after.rms, tolerance)
            quantity = f"{proof.words(nature)}, rms{suffix}"
            sizes = _size(before.rms, unit), _size(after.rms, unit)
            figures.append(page.KeyFigure(quantity, *sizes, spread, basis, allowed, met))
            if arm == delivered:
                quantity = f"{proof.words(nature)}, largest{suffix}"
                sizes = _size(before.max, unit), _size(after.max, unit)
                figures.append(page.KeyFigure(quantity, *sizes, "", basis))
    return figures


def _rms_spread(rows: RowErrors | None, arm: str, nature: str) -> str:
    """Return the standard error of an arm's rms error as text; empty if it is unknown.

    Args:
        rows: errors on the rows; None: not stored, so that the result is empty.
        arm: key of an arm: ``calibrated`` or ``urdf_alone``.
        nature: ``position``, ``orientation`` or ``distance``.
    """
    if rows is None:
        return ""
    errors = rows.urdf_alone if arm == "urdf_alone" else rows.calibrated
    if nature not in errors:
        return ""
    factor, unit = ERRORS[nature]
    sigma = factor * rms_sigma(np.array(errors[nature]))
    return f"± {sigma:.2g} {unit}" if np.isfinite(sigma) else ""


def deciding(report: Report) -> tuple[ComparedRows, RowErrors | None]:
    """Return the rows on which the verdict is based, and the error of each row (None: not stored).

    They are the held-out rows with the largest error; without held-out rows, the fitted rows.

    Args:
        report: stored results of the fit.
    """
    metrics = report.metrics
    name = next(iter(metrics.proofs), "fit")
    largest = -np.inf
    for candidate, rows in metrics.proofs.items():
        errors = rows.judged(metrics.deliverable).main
        # of equal ones the last
        if errors and errors.rms >= largest:
            name, largest = candidate, errors.rms
    row_errors = next((rows for rows in report.sets if rows.name == name), None)
    return metrics.proofs.get(name, metrics.fit), row_errors


def _cross_validated_figure(metrics: FitMetrics) -> page.KeyFigure | None:
    """Return the cross-validated errors of the nominal and the calibrated arm.

    None if the verdict is based on other errors (`validation.judge`).

    Args:
        metrics: metrics of the fit.
    """
    findings, nominal = metrics.findings, metrics.fit.nominal.main
    if findings is None or findings.cross_validated is None or nominal is None or len(metrics.ladder) < 2:
        return None
    before = nominal.rms
    if findings.nominal_cross_validated is not None:
        before = 1e3 * findings.nominal_cross_validated
    after = findings.cross_validated
    without_corrections = metrics.fit.judged(metrics.deliverable) is metrics.fit.urdf_alone
    if without_corrections and findings.rigid_cross_validated:
        after = findings.rigid_cross_validated
    after = 1e3 * after

    label = metrics.fit.words("position" if metrics.fit.nominal.position_mm else "distance")
    allowed = f"{metrics.tolerance_mm:g} mm" if metrics.tolerance_mm else "none"
    met = page.met(after, metrics.tolerance_mm or 0.0)
    sizes = _size(before, "mm"), _size(after, "mm")
    return page.KeyFigure(f"{label}, rms", *sizes, "", "cross-validated rows", allowed, met)


def _size(value: float, unit: str) -> str:
    return f"{value:.3g} {unit}"


def _arm_errors(rows: ComparedRows, arm: str, key: str) -> ErrorStatistics | None:
    """Return an arm's errors of one nature; None if there are none.

    Args:
        rows: errors on a set of rows.
        arm: key of `ARMS`, such as ``nominal``.
        key: key of `KINDS`, such as ``position_mm``.
    """
    errors = getattr(rows, arm)
    return None if errors is None else getattr(errors, key)


def _sets(metrics: FitMetrics) -> list[tuple[str, ComparedRows]]:
    """Return the fitted and the validation rows, each with a label for tables.

    Args:
        metrics: metrics of the fit.
    """
    sets = [(f"fitted: {metrics.fit.poses} poses", metrics.fit)]
    for name, rows in metrics.validation.items():
        role = "unseen" if rows.unseen else "NOT unseen"
        sets.append((f"{role}: {name}, {counted(rows.poses, 'pose')}", rows))
    return sets


def meanings(rows: ComparedRows) -> list[str]:
    """Return sentences that explain how position errors are defined if positions were not measured directly.

    Args:
        rows: errors on a set of rows.
    """
    return [sentence for name, sentence in MEANS.items() if name in rows.position_means]


def error_table(sets: Sequence[tuple[str, ComparedRows]], deliverable: str) -> page.ReportTable:
    """Return the table of the errors of all arms on sets of rows; the arm that is judged is in bold.

    Args:
        sets: label and errors of each set of rows.
        deliverable: deliverable that is judged: ``urdf`` or ``corrections``.
    """
    has_corrections = any(rows.urdf_alone for _, rows in sets)
    notes = {"Distances of pairs do not depend on the placement of instrument and tool.": None}
    if has_corrections:
        notes[ALONE_NOTE] = None
    groups = {}
    for label, rows in sets:
        groups[label] = list(_error_rows(rows))
        notes |= dict.fromkeys(meanings(rows))
    arm = ARM["corrections"] if has_corrections and deliverable != "urdf" else ARM["urdf"]

    def judged(row: Sequence[str]) -> bool:
        return len(row) > 1 and row[1] == arm

    header = ("error", "arm", "mean", "rms", "95 %", "max")
    title = "Errors of the nominal and the calibrated arm"
    return page.grouped(title, header, groups, " ".join(notes), judged, texts=2)


def _error_rows(rows: ComparedRows) -> Iterator[tuple[str, ...]]:
    """Yield table rows of text: kind of error, arm, and the arm's mean, rms, 95 % quantile and maximum."""
    kinds: dict[str, Mapping[str, ErrorStatistics | None]] = {}
    for key, (nature, unit) in KINDS.items():
        kinds[f"{rows.words(nature)} [{unit}]"] = {arm: _arm_errors(rows, arm, key) for arm in ARMS}
    kinds["distance of pairs [mm]"] = rows.pair_distance_mm

    names = dict(ARMS)
    if not rows.urdf_alone:
        names["calibrated"] = ARM["urdf"]
    for quantity, errors_by_arm in kinds.items():
        for arm in ARMS:
            errors = errors_by_arm.get(arm)
            if not errors:
                continue
            sizes = [f"{size:.4f}" for size in (errors.mean, errors.rms, errors.p95, errors.max)]
            # the quantity stands at its first arm only
            yield quantity if arm == "nominal" else "", names[arm], *sizes


def _ladder_table(metrics: FitMetrics) -> page.ReportTable:
    """Return the table of the tried models with their errors on held-out rows.

    Args:
        metrics: metrics of the fit.
    """
    header = ("model", "parameters", "cross-validated rms [mm]", "remark")
    rows = []
    strong = set()
    for k, step in enumerate(metrics.ladder):
        parameters = str(step.parameters - step.corrections)
        if step.corrections:
            parameters += f" + {step.corrections}"
        error = "" if step.cross_validated_mm is None else f"{step.cross_validated_mm:.4f}"
        rows.append([step.model, parameters, error, step.note])
        if step.kept:
            strong.add(k)
    note = f"Chosen: {metrics.model}, {parameter_words(metrics)}."
    return page.ReportTable("Ladder of models", header, rows, note, frozenset(strong), [1, 2])


def _outlier_table(metrics: FitMetrics) -> page.ReportTable:
    """Return the table of outliers, largest first.

    Args:
        metrics: metrics of the fit.
    """
    columns = (
        page.RecordColumn("file", _file_name, number=False),
        page.RecordColumn("row", "{0.row}"),
        page.RecordColumn("residual", "{0.nature}", number=False),
        page.RecordColumn("size", "{0.size}"),
        page.RecordColumn("robust sigmas", "{0.sigmas:.1f}"),
    )
    note = "Rows beyond 4 robust sigmas. The fit includes these rows; a robust loss reduces their weight."
    return page.table("Outliers", columns, metrics.outliers, note, most=MAX_OUTLIERS)


def _file_name(outlier: Outlier) -> str:
    return Path(outlier.file).name


def parameter_words(metrics: FitMetrics) -> str:
    """Return a text on the number of a fit's parameters: geometric parameters and joint corrections."""
    corrections = 0
    for step in metrics.ladder:
        if step.kept:
            corrections = step.corrections
    words = f"{metrics.fit.parameters - corrections} geometric parameters (base and tool placement included)"
    if corrections:
        words += f" + {corrections} small joint corrections, regularised by a ridge"
    return words


def error_words(metrics: FitMetrics) -> str:
    """Return a text on the rms errors on the fitted poses.

    Args:
        metrics: metrics of the fit.
    """
    return f"{_rms_words(metrics.fit, metrics.deliverable)} on {metrics.fit.poses} fitted poses"


def _rms_words(rows: ComparedRows, deliverable: str) -> str:
    """Return a text on the rms errors of the nominal robot and of the deliverable.

    If a robot with and one without joint corrections is delivered, the errors of the one that is not judged are in
    brackets.

    Args:
        rows: errors on a set of rows.
        deliverable: ``urdf`` or ``corrections``.
    """
    arms = {"nominal": rows.nominal, ARM["urdf"]: rows.calibrated}
    alternative = {}
    if rows.urdf_alone is not None:
        alternative = {ARM["urdf"]: rows.urdf_alone, ARM["corrections"]: rows.calibrated}
        delivered = ARM["urdf"] if deliverable == "urdf" else ARM["corrections"]
        arms = {"nominal": rows.nominal, delivered: alternative.pop(delivered)}
    sizes = [f"{errors.main.rms:.3f} mm {name}" for name, errors in arms.items() if errors.main]
    words = f"rms {', '.join(sizes)}"
    for name, errors in alternative.items():
        if errors.main:
            words += f" ({errors.main.rms:.3f} mm {name})"
    return words


def _parameter_table(report: Report) -> page.ReportTable:
    """Return the table of fitted parameters; joint corrections are omitted if there are too many parameters.

    Args:
        report: stored results of the fit.
    """
    parameters = report.parameters
    if len(report.parameters) > MAX_ROWS:
        parameters = tuple(row for row in report.parameters if row.group != "deflection")
    rows = []
    for row in parameters:
        factor, unit = SMALL.get(row.unit, (1.0, row.unit))
        digits = ".3f" if factor > 1 else ".4g"
        nominal = f"{factor * row.nominal:{digits}}"
        fitted = f"{factor * row.value:{digits}}"
        change = f"{factor * (row.value - row.nominal):+{digits}}"
        sigma = f"{factor * row.sigma:.2g}"
        rows.append((row.name, unit, nominal, fitted, change, sigma, page.relative_sigma(row.rsd)))

    note = ""
    omitted = len(report.parameters) - len(parameters)
    if omitted:
        note = f"{omitted} joint corrections are listed in joint_corrections.csv."
    if report.kept:
        note = f"Not fitted, kept at their nominal values: {', '.join(report.kept)}. {note}"
    header = ("parameter", "unit", "nominal", "fitted", "change", "σ", "RSD")
    return page.ReportTable("Fitted parameters", header, rows, note.strip(), numbers=range(2, 7))


def outlier_sentences(metrics: FitMetrics) -> list[str]:
    """Return a sentence on the number of outliers and on the largest ones; an empty list without outliers.

    Args:
        metrics: metrics of the fit.
    """
    if not metrics.outliers:
        return []
    rows = {(outlier.file, outlier.row) for outlier in metrics.outliers}
    worst = "; ".join(outlier.words for outlier in metrics.outliers[:MAX_NAMED_OUTLIERS])
    if len(metrics.outliers) > MAX_NAMED_OUTLIERS:
        worst += "; ..."
    treatment = "kept in the fit"
    if metrics.findings and metrics.findings.loss not in ("", "none"):
        treatment = f"weight reduced by the {metrics.findings.loss} loss"
    lines = [f"{counted(len(rows), 'row')} beyond 4 robust sigma, {treatment}: {worst}"]
    if max(outlier.sigmas for outlier in metrics.outliers) > MAX_RESIDUAL:
        lines.append(
            "were these rows measured wrongly (beam lost, an earlier point read again)? Correct them or leave them "
            "out; errors on fitted poses include them"
        )
    return lines


def _identifiability(report: Report) -> list[str]:
    """Return sentences on parameters that are not identifiable or strongly correlated.

    Args:
        report: stored results of the fit.
    """
    lines = []
    candidates = len(report.singular_values)
    undetermined, fitted = report.metrics.not_identifiable, report.metrics.fit.parameters
    if candidates and not undetermined:
        lines.append(f"All {candidates} candidate parameters are identifiable.")
    if candidates and fitted < report.rank:
        lines.append(
            f"{fitted} of them are fitted: the others have sigmas above manufacturing tolerances, so "
            "they keep their nominal values."
        )
    lines += [f"{sentence[0].upper()}{sentence[1:]}" for sentence in undetermined]
    strongest = report.correlations[:MAX_PAIRS]
    if strongest:
        pairs = [f"{pair.first} with {pair.second} ({pair.correlation:+.2f})" for pair in strongest]
        lines.append(f"Strongly correlated (abs. ρ > 0.9): {', '.join(pairs)}.")
    else:
        lines.append("No two parameters correlate by more than 0.9.")
    return lines


def _repeated_sentences(metrics: FitMetrics) -> list[str]:
    """Return a sentence on pose accuracy and repeatability for each set of rows with repeated poses.

    Args:
        metrics: metrics of the fit.
    """
    sets = {"fitted": metrics.fit, **metrics.validation}
    return [f"{name}: {iso9283_words(rows)}" for name, rows in sets.items() if rows.iso9283]


def iso9283_words(rows: ComparedRows) -> str:
    """Return a sentence on the accuracy and repeatability of repeated poses; empty if no pose was repeated.

    Args:
        rows: errors on a set of rows.
    """
    if rows.iso9283 is None:
        return ""
    return iso9283_sentence(rows.iso9283, ARM["corrections"] if rows.urdf_alone else ARM["urdf"])


def iso9283_tables(metrics: FitMetrics, most: int = MAX_POSES) -> list[page.ReportTable]:
    """Return tables of accuracy and repeatability after ISO 9283, one for each set of rows with repeated poses.

    Args:
        metrics: metrics of the fit.
        most: largest number of poses in a table.
    """
    columns = (
        page.RecordColumn("pose", "{0[0]}", number=False),
        page.RecordColumn("cycles", _cycles),
        page.RecordColumn("AP nominal [mm]", _nominal_accuracy),
        page.RecordColumn("AP after [mm]", _accuracy),
        page.RecordColumn("AP after, x, y, z [mm]", _accuracy_by_axis),
        page.RecordColumn("RP [mm]", "{0[1].repeatability_mm:.3f}"),
        page.RecordColumn("RP a, b, c [deg]", _repeatability_of_angles),
        page.RecordColumn("vAP [mm]", _multidirectional),
    )
    tables = []
    for name, rows in {"fitted": metrics.fit, **metrics.validation}.items():
        if not rows.iso9283:
            continue
        title = f"Accuracy and repeatability, {name} ({iso9283_words(rows)})"
        numbered_poses = list(enumerate(rows.iso9283.each, 1))
        tables.append(page.table(title, columns, numbered_poses, ISO_NOTE, most=most))
    return tables


def _cycles(pose: tuple[int, RepeatedPose]) -> str:
    return str(len(pose[1].rows))


def _nominal_accuracy(pose: tuple[int, RepeatedPose]) -> str:
    return f"{np.linalg.norm(pose[1].nominal_mm):.3f}"


def _accuracy(pose: tuple[int, RepeatedPose]) -> str:
    return f"{np.linalg.norm(pose[1].calibrated_mm):.3f}"


def _accuracy_by_axis(pose: tuple[int, RepeatedPose]) -> str:
    return ", ".join(f"{value:+.3f}" for value in pose[1].calibrated_mm)


def _repeatability_of_angles(pose: tuple[int, RepeatedPose]) -> str:
    return ", ".join(f"{value:.4f}" for value in pose[1].repeatability_deg)


def _multidirectional(pose: tuple[int, RepeatedPose]) -> str:
    value_mm = pose[1].multidirectional_mm
    return "" if value_mm is None else f"{value_mm:.3f}"
