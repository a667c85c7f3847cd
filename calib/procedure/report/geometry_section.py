"""The geometry section of reports, for the console output of a fit and for its report."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path

import numpy as np

from calib.geometry.accuracy import ErrorStatistics, rms_sigma
from calib.geometry.model_choice.ladder import ModelStep
from calib.procedure.kinematic_stage.comparison import iso9283_sentence
from calib.procedure.kinematic_stage.inputs import Inputs
from calib.procedure.kinematic_stage.metrics import ComparedRows, FitMetrics
from calib.procedure.kinematic_stage.validation import ARM
from calib.procedure.report import page
from calib.procedure.report.fit_report import CROSS_VALIDATED, Report, RowErrors
from calib.units import ERRORS, SMALL

KINDS = {f"{nature}_{unit}": (nature, unit) for nature, (_, unit) in ERRORS.items()}
# fields of `ComparedRows` and their words, in the order of the tables
ARMS = {"nominal": "nominal", "urdf_alone": ARM["urdf"], "calibrated": ARM["corrections"]}
MAX_ROWS = 60  # parameters beyond which joint corrections are not listed
MAX_POSES = 30  # repeated poses that are listed
MAX_OUTLIERS = 20
MAX_NAMED_OUTLIERS = 8  # outliers named in a sentence
LADDER = (
    page.Column("model", "{0.model}", number=False),
    page.Column("parameters", lambda step: _counted(step)),
    page.Column("cross-validated rms [mm]", lambda step: _numbered(step.cross_validated_mm, 4)),
    page.Column("remark", "{0.note}", number=False),
)
OUTLIERS = (
    page.Column("file", lambda each: Path(each.file).name, number=False),
    page.Column("row", "{0.row}"),
    page.Column("residual", "{0.nature}", number=False),
    page.Column("size", "{0.size}"),
    page.Column("robust sigmas", "{0.sigmas:.1f}"),
)
REPEATED = (
    page.Column("pose", "{0[0]}", number=False),
    page.Column("cycles", lambda at: str(len(at[1].rows))),
    page.Column("AP nominal [mm]", lambda at: f"{np.linalg.norm(at[1].nominal_mm):.3f}"),
    page.Column("AP after [mm]", lambda at: f"{np.linalg.norm(at[1].calibrated_mm):.3f}"),
    page.Column("AP after, x, y, z [mm]", lambda at: ", ".join(f"{value:+.3f}" for value in at[1].calibrated_mm)),
    page.Column("RP [mm]", "{0[1].repeatability_mm:.3f}"),
    page.Column("RP a, b, c [deg]", lambda at: ", ".join(f"{value:.4f}" for value in at[1].repeatability_deg)),
    page.Column("vAP [mm]", lambda at: _numbered(at[1].multidirectional_mm, 3)),
)
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
    """Return lines on the robot and the measurements, as read."""
    chain = inputs.chain
    lines = [f"robot {chain.name}: {chain.n} joints, {chain.base} to {chain.tip}"]
    for block in inputs.fit:
        tools = f", {len(block.tool_names)} targets" if len(block.tool_names) > 1 else ""
        ignored = f"; ignored: {', '.join(block.ignored)}" if block.ignored else ""
        sigma = "stated" if block.states_sigma else "estimated"
        lines.append(f"{Path(block.file).name}: {len(block)} rows of kind {block.kind}{tools}, sigmas {sigma}{ignored}")
    for name, unseen in inputs.unseen.items():
        role = "held out" if unseen.held_out else "validation"
        lines.append(f"{name}: {len(unseen.block)} rows of kind {unseen.block.kind}, not used in the fit ({role})")
    return lines


def outcome_section(metrics: FitMetrics) -> page.Section:
    """Return the console's section on a fit: ladder, errors, repeated poses, findings, verdict."""
    blocks: list[page.Block] = [_ladder_table(metrics), error_table(_sets(metrics), metrics.deliverable)]
    sizes = [f"{label}: {_rms_words(found, metrics.deliverable)}" for label, found in _sets(metrics)]
    blocks.append(page.Text("", [f"model {metrics.model}, {parameter_words(metrics)}", *sizes]))
    if metrics.advice and not any(metrics.advice in line for line in metrics.warnings):
        blocks.append(page.Text("", [metrics.advice], "what to do"))
    blocks += [page.Text("", _repeated_sentences(metrics)), page.Text("", outlier_sentences(metrics), "outliers")]
    blocks += [page.Text("", metrics.warnings, "note"), page.Text("", metrics.not_identifiable, "identifiability")]
    return page.Section("Geometry", blocks, metrics.verdict, metrics.reason)


def report_section(report: Report, drawn: Mapping[str, page.Picture]) -> page.Section:
    """Return the section of a report: errors, ladder, parameters, identifiability, figures, outliers.

    Args:
        drawn: figures by name (`geometry_figures.captioned`); those that are not there are left out.
    """
    metrics = report.metrics
    blocks: list[page.Block] = [error_table(_sets(metrics), metrics.deliverable), *iso9283_tables(metrics)]
    blocks.append(page.pictures("Before and after", drawn, ("position", "orientation", "distance")))
    blocks.append(page.pictures("What remains", drawn, ("joints", "map")))
    blocks.append(page.pictures("Image coverage", drawn, [name for name in drawn if name.startswith("coverage")]))
    if any(step.cross_validated_mm is not None for step in metrics.ladder):
        blocks += [_ladder_table(metrics), page.pictures("", drawn, ("ladder",))]
    blocks.append(page.Text("Identifiability", _identifiability(report)))
    blocks.append(page.pictures("Parameters", drawn, ("parameters", "singular_values", "correlations")))
    blocks.append(_parameter_table(report))
    if metrics.outliers:
        note = "Rows beyond 4 robust sigmas. The fit includes these rows; a robust loss reduces their weight."
        blocks.append(page.table("Outliers", OUTLIERS, metrics.outliers, note, most=MAX_OUTLIERS))
    blocks.append(page.Text("Notes", metrics.warnings))
    return page.Section("Geometry", blocks, metrics.verdict, metrics.reason, _key_figures(report))


def _key_figures(report: Report) -> list[page.KeyFigure]:
    """Return the errors that decide the verdict, before and after calibration.

    Of the worst unseen rows; without any, those of cross-validation, where it judged; else of the fit's rows.
    """
    metrics = report.metrics
    if not metrics.proofs and (folds := _left_out(metrics)):
        return [folds]
    proof, own = deciding(report)
    seen = "unseen" if metrics.proofs else "fitted"
    seen = CROSS_VALIDATED if own is not None and own.name == CROSS_VALIDATED else seen
    basis = f"{proof.poses} {seen} poses"
    arms = (
        {"calibrated": ""}
        if proof.urdf_alone is None
        else {"urdf_alone": ARM["urdf"], "calibrated": ARM["corrections"]}
    )
    if metrics.deliverable == "corrections":
        arms = dict(reversed(arms.items()))
    result = []
    for (key, (label, unit)), (arm, words) in product(KINDS.items(), arms.items()):
        before, after = _errors(proof, "nominal", key), _errors(proof, arm, key)
        if before is None or after is None:
            continue
        sizes = None if own is None else (own.urdf_alone if arm == "urdf_alone" else own.calibrated).get(label)
        sigma = np.nan if sizes is None else ERRORS[label][0] * rms_sigma(np.array(sizes))
        spread = f"± {sigma:.2g} {unit}" if np.isfinite(sigma) else ""
        main = before is proof.nominal.main
        judged = (metrics.tolerance_mm or 0.0) if main else 0.0
        allowed = f"{judged:g} mm" if judged else "none" if main else ""
        kinds = {"rms": (before.rms, after.rms, spread, basis, allowed, page.met(after.rms, judged))}
        if arm == next(iter(arms)):
            kinds["largest"] = before.max, after.max, "", basis, "", ""
        for kind, (one, two, *rest) in kinds.items():
            what = f"{proof.words(label)}, {kind}" + (f" ({words})" if words else "")
            result.append(page.KeyFigure(what, _size(one, unit), _size(two, unit), *rest))
    return result


def deciding(report: Report) -> tuple[ComparedRows, RowErrors | None]:
    """Return the worst unseen rows, and the errors of each; without unseen ones the fit's rows."""
    metrics, proofs = report.metrics, report.metrics.proofs
    left = {name: rows.judged(metrics.deliverable).main for name, rows in proofs.items()}
    worst = {found.rms: name for name, found in left.items() if found}
    name = worst[max(worst)] if worst else next(iter(proofs), "fit")
    return proofs.get(name, metrics.fit), next((rows for rows in report.sets if rows.name == name), None)


def _left_out(metrics: FitMetrics) -> page.KeyFigure | None:
    """Return the cross-validated errors of both arms; None if other errors decided the verdict (`validation.judge`)."""
    found, nominal = metrics.findings, metrics.fit.nominal.main
    if found is None or found.cross_validated is None or nominal is None or len(metrics.ladder) < 2:
        return None
    before = nominal.rms if found.nominal_cross_validated is None else 1e3 * found.nominal_cross_validated
    label = metrics.fit.words("position" if metrics.fit.nominal.position_mm else "distance")
    allowed = f"{metrics.tolerance_mm:g} mm" if metrics.tolerance_mm else "none"
    alone = metrics.fit.judged(metrics.deliverable) is metrics.fit.urdf_alone
    after = 1e3 * ((alone and found.rigid_cross_validated) or found.cross_validated)
    met, sizes = page.met(after, metrics.tolerance_mm or 0.0), (_size(before, "mm"), _size(after, "mm"))
    return page.KeyFigure(f"{label}, rms", *sizes, "", "cross-validated rows", allowed, met)


def _size(value: float, unit: str) -> str:
    return f"{value:.3g} {unit}"


def _errors(rows: ComparedRows, arm: str, key: str) -> ErrorStatistics | None:
    found = getattr(rows, arm)
    return None if found is None else getattr(found, key)


def _sets(metrics: FitMetrics) -> list[tuple[str, ComparedRows]]:
    """Return the sets of rows, each with its label."""
    unseen = [
        (f"{'unseen' if found.unseen else 'NOT unseen'}: {name}, {found.poses} poses", found)
        for name, found in metrics.validation.items()
    ]
    return [(f"fitted: {metrics.fit.poses} poses", metrics.fit), *unseen]


def meanings(found: ComparedRows) -> list[str]:
    """Return what the position errors of rows are, in sentences; none where positions were measured."""
    return [sentence for name, sentence in MEANS.items() if name in found.position_means]


def error_table(sets: Sequence[tuple[str, ComparedRows]], deliverable: str) -> page.Table:
    """Return the table of errors of all arms on sets of rows, with the one that is judged in bold."""
    notes = ["Distances of pairs do not depend on the placement of instrument and tool."]
    notes += [ALONE_NOTE] * any(found.urdf_alone for _, found in sets)
    notes += dict.fromkeys(line for _, found in sets for line in meanings(found))
    header = ("error", "arm", "mean", "rms", "95 %", "max")
    groups = {label: list(_error_rows(found)) for label, found in sets}
    alone = any(found.urdf_alone for _, found in sets)
    words = ARM["corrections"] if alone and deliverable != "urdf" else ARM["urdf"]
    judged = lambda row: row[1:2] == (words,)  # noqa: E731
    title = "Errors of the nominal and the calibrated arm"
    return page.grouped(title, header, groups, " ".join(notes), judged, texts=2)


def _error_rows(found: ComparedRows) -> Iterator[tuple[str, ...]]:
    """Yield error, arm, and the arm's mean, rms, 95 % quantile and maximum, as text."""
    kinds: dict[str, Mapping[str, ErrorStatistics | None]] = {
        f"{found.words(nature)} [{unit}]": {arm: _errors(found, arm, key) for arm in ARMS}
        for key, (nature, unit) in KINDS.items()
    }
    names = ARMS if found.urdf_alone else ARMS | {"calibrated": ARM["urdf"]}
    for words, arms in (*kinds.items(), ("distance of pairs [mm]", found.pair_distance_mm)):
        for arm in ARMS:
            if numbers := arms.get(arm):
                sizes = numbers.mean, numbers.rms, numbers.p95, numbers.max
                yield words if arm == "nominal" else "", names[arm], *(f"{size:.4f}" for size in sizes)


def _ladder_table(metrics: FitMetrics) -> page.Table:
    """Return the table of the models tried, with their errors on held-out rows."""
    note = f"Chosen: {metrics.model}, {parameter_words(metrics)}."
    return page.table("Ladder of models", LADDER, metrics.ladder, note, lambda step: step.kept)


def _counted(step: ModelStep) -> str:
    """Return a model's number of parameters as text: geometric parameters plus joint corrections."""
    rigid = step.parameters - step.corrections
    return f"{rigid} + {step.corrections}" if step.corrections else str(rigid)


def parameter_words(metrics: FitMetrics) -> str:
    """Return the number of a fit's parameters by kind, as text; with a ridge, corrections may outnumber poses."""
    last = [step for step in metrics.ladder if step.kept][-1:]
    corrections = last[0].corrections if last else 0
    words = f"{metrics.fit.parameters - corrections} geometric parameters (base and tool placement included)"
    return words + (f" + {corrections} small joint corrections, regularised by a ridge" if corrections else "")


def error_words(metrics: FitMetrics) -> str:
    """Return the rms errors on the fitted poses as text."""
    return f"{_rms_words(metrics.fit, metrics.deliverable)} on {metrics.fit.poses} fitted poses"


def _rms_words(rows: ComparedRows, deliverable: str) -> str:
    """Return the rms errors of the nominal robot and of what is delivered; in brackets those of the alternative."""
    arms = {"nominal": rows.nominal, ARM["urdf"]: rows.calibrated}
    alternative = {}
    if rows.urdf_alone is not None:
        both = {ARM["urdf"]: rows.urdf_alone, ARM["corrections"]: rows.calibrated}
        delivered = ARM["urdf"] if deliverable == "urdf" else ARM["corrections"]
        arms = {"nominal": rows.nominal, delivered: both.pop(delivered)}
        alternative = both
    words = [f"{size.main.rms:.3f} mm {name}" for name, size in arms.items() if size.main]
    bracketed = [f" ({size.main.rms:.3f} mm {name})" for name, size in alternative.items() if size.main]
    return f"rms {', '.join(words)}{''.join(bracketed)}"


def _parameter_table(report: Report) -> page.Table:
    """Return the table of fitted parameters, without joint corrections if these are many."""
    shown = [row for row in report.parameters if len(report.parameters) <= MAX_ROWS or row.group != "deflection"]
    rows = []
    for row in shown:
        factor, printed = SMALL.get(row.unit, (1.0, row.unit))
        digits = ".3f" if factor > 1 else ".4g"
        numbers = [f"{factor * number:{digits}}" for number in (row.nominal, row.value)]
        change = f"{factor * (row.value - row.nominal):+{digits}}"
        rows.append((row.name, printed, *numbers, change, f"{factor * row.sigma:.2g}", page.relative_sigma(row.rsd)))
    left = len(report.parameters) - len(shown)
    note = f"{left} joint corrections are listed in joint_corrections.csv." if left else ""
    if report.kept:
        note = f"Not fitted, kept at their nominal values: {', '.join(report.kept)}. {note}"
    header = ("parameter", "unit", "nominal", "fitted", "change", "σ", "RSD")
    return page.Table("Fitted parameters", header, rows, note.strip(), numbers=range(2, 7))


def outlier_sentences(metrics: FitMetrics) -> list[str]:
    """Return a sentence on the number of outliers and the worst ones; empty without outliers."""
    if not metrics.outliers:
        return []
    count = len({(each.file, each.row) for each in metrics.outliers})
    worst = "; ".join(each.words for each in metrics.outliers[:MAX_NAMED_OUTLIERS])
    more = "; ..." if len(metrics.outliers) > MAX_NAMED_OUTLIERS else ""
    loss = metrics.findings.loss if metrics.findings else ""
    how = "kept in the fit" if loss in ("", "none") else f"weight reduced by the {loss} loss"
    return [f"{count} rows beyond 4 robust sigma, {how}: {worst}{more}"]


def _identifiability(report: Report) -> list[str]:
    """Return sentences on identifiable and correlated parameters."""
    values, rank, lines = report.singular_values, report.rank, []
    unclear, fitted = report.metrics.not_identifiable, report.metrics.fit.parameters
    if values and not unclear:
        lines.append(f"All {len(values)} candidate parameters are identifiable.")
    if values and fitted < rank:
        lines.append(
            f"{fitted} of them are fitted: the others have sigmas above manufacturing tolerances, so "
            "they keep their nominal values."
        )
    lines += [f"{line[0].upper()}{line[1:]}" for line in unclear]
    strong = [f"{pair.first} with {pair.second} ({pair.correlation:+.2f})" for pair in report.correlations[:8]]
    if strong:
        lines.append(f"Strongly correlated (abs. ρ > 0.9): {', '.join(strong)}.")
    else:
        lines.append("No two parameters correlate by more than 0.9.")
    return lines


def _repeated_sentences(metrics: FitMetrics) -> list[str]:
    """Return a sentence on accuracy and repeatability for each set of rows with repeated poses."""
    sets = {"fitted": metrics.fit, **metrics.validation}
    return [f"{name}: {iso9283_words(found)}" for name, found in sets.items() if found.iso9283]


def iso9283_words(rows: ComparedRows) -> str:
    """Return the sentence on repeated poses, naming the arm; empty where no pose was repeated."""
    if rows.iso9283 is None:
        return ""
    return iso9283_sentence(rows.iso9283, ARM["corrections"] if rows.urdf_alone else ARM["urdf"])


def iso9283_tables(metrics: FitMetrics, most: int = MAX_POSES) -> list[page.Table]:
    """Return the tables of accuracy and repeatability after ISO 9283, one per set of rows with repeated poses."""
    result = []
    for name, found in {"fitted": metrics.fit, **metrics.validation}.items():
        if iso := found.iso9283:
            title = f"Accuracy and repeatability, {name} ({iso9283_words(found)})"
            result.append(page.table(title, REPEATED, [*enumerate(iso.each, 1)], ISO_NOTE, most=most))
    return result


def _numbered(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"
