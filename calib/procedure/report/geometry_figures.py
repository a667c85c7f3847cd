"""Figures on a geometric calibration, made from a `Report` or from arrays [m, rad], as `Chart`s with captions.

Errors of the nominal arm are light and those of the calibrated arm dark, so that they differ in greyscale.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.geometry.model_choice.ladder import ModelStep
from calib.procedure.kinematic_stage.verdict.validation import ARM
from calib.procedure.report.figures.charts import (
    Bars,
    Captioned,
    Chart,
    Cloud,
    Dots,
    Heat,
    Histogram,
    Label,
    Level,
    Line,
    Panel,
)
from calib.procedure.report.figures.style import AFTER, BEFORE, BROWN, HALF_WIDTH, INK, MARK, PAGE_WIDTH, number
from calib.procedure.report.fit_report import FittedParameter, Report, RowErrors
from calib.units import ERRORS

# (effort, sigma) pairs
Curve = Sequence[tuple[float, float]]

# colour of changes below two sigmas
PALE = "#c3ccd6"
# ratio of the medians from which on bins are logarithmic: equal ones would show one bar of the smaller errors
LOGARITHMIC_RATIO = 6.0
# edges of the bins of a histogram
BIN_EDGES = 31
# most files of a set that have a panel each in the chart of errors by row (our choice)
MAX_FILES = 6


def error_histogram(
    before: np.ndarray, after: np.ndarray, nature: str = "position", noise: float | None = None, arm: str = ARM["urdf"]
) -> Chart:
    """Return a histogram of nominal and calibrated errors, with lines at the rms of each.

    Args:
        before, after: (m,) errors of the nominal and of the calibrated arm [m] or [rad].
        nature: ``position``, ``orientation`` or ``distance``.
        noise: rms of the instrument's own error, in the unit of the errors, drawn as a line; None: not drawn.
        arm: printed name of the arm with the errors `after`.
    """
    factor, unit = ERRORS[nature]
    before, after = factor * np.asarray(before), factor * np.asarray(after)
    largest = max(before.max(), after.max(), 1e-9) * 1.02
    logarithmic = bool(np.median(after) < np.median(before) / LOGARITHMIC_RATIO)
    if logarithmic:
        instrument = factor * noise if noise else largest
        smallest = max(min(before.min(), after.min(), instrument), 1e-4 * largest) * 0.9
        edges = np.geomspace(smallest, largest, BIN_EDGES)
    else:
        edges = np.linspace(0.0, largest, BIN_EDGES)
    rms_before = float(np.sqrt(np.mean(before**2)))
    rms_after = float(np.sqrt(np.mean(after**2)))
    count_before, _ = np.histogram(before, edges)
    count_after, _ = np.histogram(after, edges)

    layers = [
        Histogram(count_before, edges, BEFORE),
        Histogram(count_after, edges, AFTER),
        Level(rms_before, BROWN, upright=True, text="nominal"),
        Level(rms_after, AFTER, upright=True, text=arm, height=0.9),
    ]
    if noise:
        layers.append(Level(factor * noise, INK, ":", upright=True, text="instrument", height=0.82))
    panel = Panel(
        layers,
        f"{rms_before:.3g} {unit} rms before, {rms_after:.3g} {unit} after",
        f"{nature} error [{unit}]",
        "poses",
        xlim=(edges[0], edges[-1]),
        ylim=(0.0, 1.3 * max(1, count_before.max(), count_after.max())),
        log="x" if logarithmic else "",
    )
    return Chart([panel], 2.4, width=HALF_WIDTH)


def residuals_by_joint(
    q: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
    joint_names: Sequence[str],
    prismatic: Sequence[bool],
    nature: str = "position",
    arm: str = ARM["urdf"],
) -> Chart:
    """Return a chart of errors over each joint value; a trend in the errors indicates an unmodelled effect.

    Args:
        q: (m, n) joint values [rad or m].
        before, after: (m,) error sizes of the nominal and of the calibrated arm [m] or [rad].
        joint_names: (n,) names of the joints.
        prismatic: (n,) whether each joint is prismatic.
        nature: ``position``, ``orientation`` or ``distance``.
        arm: printed name of the arm with the errors `after`.
    """
    factor, unit = ERRORS[nature]
    sizes = factor * np.concatenate([before, after])
    smallest = max(np.percentile(sizes, 2), 1e-9)
    largest = max(sizes.max(), 1e-8)
    limits = float(smallest) * 0.5, float(largest) * 1.3

    panels = []
    for j, name in enumerate(joint_names):
        x, joint_unit = np.rad2deg(q[:, j]), "deg"
        if prismatic[j]:
            x, joint_unit = q[:, j], "m"
        clouds = [
            Line(x, factor * before, ".", BEFORE, size=4.5, label="nominal"),
            Line(x, factor * after, ".", AFTER, size=4.5, label=arm),
        ]
        label = f"{name} [{joint_unit}]"
        y_label = f"error [{unit}]"
        panels.append(Panel(clouds, x=label, y=y_label, ylim=limits, log="y", grid="y", ticks=5, switch=name))

    n = q.shape[1]
    columns = 4
    if n < 4:
        columns = n
    elif n in (5, 6):
        # two rows of the same length
        columns = -(-n // 2)
    rows = -(-n // columns)
    title = f"{nature} errors of {len(q)} poses"
    return Chart(panels, 0.55 + 1.35 * rows, columns, title=title, shared="y")


def error_map(
    points: np.ndarray,
    sizes: np.ndarray,
    words: str = "at most {} remain",
    expected: np.ndarray | None = None,
    least: float = 0.0,
) -> Chart:
    """Return maps of calibrated and expected errors over the workspace, seen from above and from the side.

    Args:
        points: (m, 3) target positions in the arm's base frame [m].
        sizes: (m,) errors of the calibrated arm [m].
        words: title, in which {} is replaced by the largest error.
        expected: (m,) predicted radius that contains 95 % of such errors [m]; None or empty: unknown, no map.
        least: error at which the colour scale begins [m].
    """
    largest_mm = 1e3 * float(np.max(sizes, initial=1e-9))
    title = f"from above: {words.format(f'{largest_mm:.3g} mm')}"
    maps = [(sizes, title, "from the side")]
    shown = [sizes]
    if expected is not None and len(expected):
        maps.append((expected, "from above: expected 95 % radius", ""))
        shown.append(expected)

    # few values far off do not hide the differences of the others
    values_mm = 1e3 * np.concatenate([*shown, [1e-9]])
    colour_limits_mm = 1e3 * least, min(float(values_mm.max()), 1.5 * float(np.percentile(values_mm, 99)))
    panels = []
    for values, from_above, from_side in maps:
        sizes_mm = 1e3 * np.asarray(values)
        panels.append(_map_panel(points, sizes_mm, colour_limits_mm, 1, from_above))
        panels.append(_map_panel(points, sizes_mm, colour_limits_mm, 2, from_side))
    cloud = Cloud(points, 1e3 * np.asarray(sizes), *colour_limits_mm, "mm")
    return Chart(panels, 3.0 * len(maps), 2, cloud=cloud)


def _map_panel(
    points: np.ndarray, sizes_mm: np.ndarray, limits_mm: tuple[float, float], axis: int, title: str
) -> Panel:
    """Return a map of sizes at points over x and another axis.

    Args:
        points: (m, 3) positions [m].
        sizes_mm: (m,) sizes at the points, shown by colours [mm].
        limits_mm: sizes at the ends of the colour scale [mm].
        axis: vertical axis of the map: 1 for y, 2 for z; only the map over z has a colour bar.
        title: title of the map.
    """
    layers = [
        Dots(points[:, 0], points[:, axis], sizes_mm, *limits_mm, "[mm]" if axis == 2 else ""),
        Line([0.0], [0.0], "+", INK, size=9.0),
        Label("base", 0.0, 0.0, (-5, 4), across="right"),
    ]
    return Panel(layers, title, "x [m]", f"{'xyz'[axis]} [m]", grid="both", equal=True, ticks=6)


def predicted_map(points: np.ndarray, sigma: np.ndarray) -> Chart:
    """Return a map of the predicted σ (m,) [m] of the tool's position at workspace points (m, 3) [m].

    Args:
        points: positions of the tool.
        sigma: predicted σ.
    """
    return error_map(points, sigma, words="predicted σ up to {}", least=float(np.min(sigma)))


def image_coverage(size: tuple[int, int], count: np.ndarray, rms: np.ndarray) -> Chart:
    """Return maps of corner counts and reprojection errors over a camera's image; cells without corners are white.

    Args:
        size: width and height of the images [px].
        count: (rows, columns) number of corners in each cell of the image.
        rms: (rows, columns) rms reprojection error in each cell [px].
    """
    width, height = size
    extent = 0, width, height, 0
    covered = count > 0
    counts = Heat(np.where(covered, count.astype(float), np.nan), "", extent)
    errors = Heat(np.where(covered, rms, np.nan), "[px]", extent)
    counts_title = f"corners seen, in {np.mean(covered):.0%} of the image"
    panels = [
        Panel([counts], counts_title, "u [px]", "v [px]", ticks=5),
        Panel([errors], "reprojection error, rms", "u [px]", "v [px]", ticks=5),
    ]
    return Chart(panels, 0.8 + 0.5 * (PAGE_WIDTH - 2.0) * height / width, 2)


def parameter_changes(rows: Sequence[FittedParameter], most: int = 48, of: str = "fitted - nominal") -> Chart:
    """Return a chart of fitted minus nominal values with error bars of two σ; lengths in mm, angles in mrad.

    Args:
        rows: fitted parameters; parameters in other units are omitted.
        most: largest number of parameters per panel; those with the largest change in σ are shown.
        of: axis label for the difference.
    """
    panels = []
    longest = 5
    for si_unit, unit, quantity in (("m", "mm", "lengths"), ("rad", "mrad", "angles")):
        parameters = [row for row in rows if row.unit == si_unit]
        change = np.array([row.value - row.nominal for row in parameters])
        sigma = np.array([row.sigma for row in parameters])
        changed_most = np.argsort(-np.abs(change) / np.maximum(sigma, 1e-15), kind="stable")[:most]
        chosen = np.sort(changed_most)
        if not len(chosen):
            continue
        value, two_sigmas = 1e3 * change[chosen], 2e3 * sigma[chosen]
        clear = np.abs(value) > two_sigmas
        colours = np.where(clear, AFTER, PALE).tolist()
        title = f"{int(clear.sum())} of {len(chosen)} {quantity} clearly changed"
        labels = [parameters[k].name for k in chosen]
        layer = Bars(value, colours, spread=two_sigmas)
        panels.append(Panel([layer], title, f"{of} [{unit}], bars ±2σ", ynames=labels, grid="x"))
        longest = max(longest, len(chosen))
    return Chart(panels, 0.65 + 0.155 * longest, max(1, len(panels)))


def singular_values(values: np.ndarray, rank: int) -> Chart:
    """Return a chart of the singular values of the scaled observation matrix.

    It marks the gap below the singular values of the identifiable parameter combinations.

    Args:
        values: (p,) singular values in descending order.
        rank: number of singular values that are kept.
    """
    values = np.asarray(values, dtype=float)
    # zeros have no place on a logarithmic axis
    sizes = np.maximum(values, max(values[0] * 1e-17, 1e-17))
    number_of = np.arange(1, len(values) + 1)
    layers = [Line(number_of[:rank], sizes[:rank], "o"), Line(number_of[rank:], sizes[rank:], "o", MARK, hollow=True)]
    if 0 < rank < len(values):
        last, first = sizes[rank - 1], sizes[rank]
        middle = float(np.sqrt(last * first))
        gap = f"gap {number(last / first)}"
        layers.append(Label(gap, rank + 0.5, middle, (-6, 0), MARK, across="right", along="center"))
    title = f"{rank} of {len(values)} parameters are identifiable"
    limits = 0.3 * float(sizes.min()), 3.0 * float(sizes.max())
    panel = Panel(layers, title, "number", "singular value", ylim=limits, log="y", grid="y")
    return Chart([panel], 2.4, width=HALF_WIDTH)


def ladder(steps: Sequence[ModelStep], noise: float | None = None) -> Chart:
    """Return a chart of the cross-validated errors of the tried models.

    Args:
        steps: tried models with a cross-validated error, in the order of the trials; the last model without a note is
            the chosen one.
        noise: rms of the instrument's own error [m]; None: not drawn.
    """
    errors = np.array([step.cross_validated_mm for step in steps], dtype=float)
    x = np.arange(len(steps))
    kept = np.flatnonzero([not step.note for step in steps])
    rejected, chosen = np.setdiff1d(x, kept), kept[-1:]
    layers = [
        Line(x[kept], errors[kept], "o-", size=5.0),
        Line(x[rejected], errors[rejected], "o", size=5.0, hollow=True),
        Line(x[chosen], errors[chosen], "o", size=8.0),
    ]
    for k, error in enumerate(errors):
        layers.append(Label(f"{error:.3g}", k, error, (0, 8), across="center"))
    lowest = errors.min()
    if noise:
        layers.append(Level(1e3 * noise, INK, ":", text="instrument"))
        lowest = min(lowest, 1e3 * noise)

    title = ""
    for k in chosen:
        model = steps[k].model.removeprefix("+ ")
        title = f"{model} is the last to reduce the error: to {errors[k]:.3g} mm"
    labels = [f"{step.model}\n{step.parameters}" for step in steps]
    panel = Panel(
        layers,
        title,
        "model, parameters",
        "cross-validated error [mm]",
        ylim=(0.7 * lowest, 2.4 * errors.max()),
        log="y",
        xnames=labels,
        grid="y",
    )
    return Chart([panel], 2.4)


def correlation_map(names: Sequence[str], correlation: np.ndarray) -> Chart:
    """Return a map of the correlation matrix (p, p) of parameters.

    Args:
        names: (p,) names of the parameters.
        correlation: the matrix.
    """
    off = np.abs(correlation - np.diag(np.diag(correlation)))
    matrix = Heat(correlation, limits=(-1.0, 1.0), colours="PuOr", written=len(names) <= 10)
    # long names widen the figure, and never overlap
    side = max(HALF_WIDTH, 0.13 * len(names) + 0.05 * max(map(len, names)) + 1.0)
    panel = Panel([matrix], f"correlations up to {off.max():.2f}", xnames=names, ynames=names)
    return Chart([panel], side - 0.3, width=side)


def outlook_figure(others: Curve, own: tuple[float, float], along: str, across: str) -> Chart:
    """Return a chart of predicted σ over measuring effort, both logarithmic, on which the present plan is marked.

    Args:
        others: pairs of effort and σ of other plans.
        own: effort and σ of the present plan.
        along, across: axis labels of effort and σ, with units.
    """
    points = np.array(sorted(others)).reshape(-1, 2)
    with_plan = np.vstack([points, [own]])
    low, high = with_plan.min(axis=0), with_plan.max(axis=0)
    layers = [
        Line(points[:, 0], points[:, 1], "o-", BEFORE),
        Line([own[0]], [own[1]], "o", MARK, size=5.5),
        Label("this plan", *own),
    ]
    panel = Panel(
        layers,
        "predicted before measuring",
        along,
        across,
        xlim=(0.8 * low[0], 1.25 * high[0]),
        ylim=(0.7 * low[1], 1.4 * high[1]),
        log="xy",
        grid="both",
    )
    return Chart([panel], 2.4, width=HALF_WIDTH)


def _point_values(report: Report, errors: RowErrors) -> dict[str, np.ndarray]:
    """Return what a page shows of each row under the pointer: row number, expected error [mm], and joint values.

    Args:
        report: results of the fit.
        errors: errors of the rows.
    """
    values = {"row": np.array(errors.rows, dtype=float)}
    if errors.files:
        values["file"] = np.array(errors.file, dtype=float)
    if errors.expected:
        values["95 % expected within [mm]"] = 1e3 * np.array(errors.expected)
    joint_values = np.array(errors.q)
    for j, name in enumerate(report.joints):
        if report.prismatic[j]:
            values[f"{name} [m]"] = joint_values[:, j]
        else:
            values[f"{name} [deg]"] = np.rad2deg(joint_values[:, j])
    return values


def errors_by_row(report: Report, nature: str) -> Chart:
    """Return a chart of the delivered arm's errors over the rows of the files: a panel per file, or per set of many.

    Args:
        report: results of the fit.
        nature: ``position``, ``orientation`` or ``distance``.
    """
    factor, unit = ERRORS[nature]
    deliverable = report.metrics.deliverable
    panels = []
    for errors in report.sets:
        delivered = errors.judged(deliverable)
        if nature not in delivered or len(errors.rows) != len(delivered[nature]):
            continue
        sizes = factor * np.array(delivered[nature])
        rows, files = np.array(errors.rows), np.array(errors.file)
        kind = "unseen rows" if errors.unseen else "fitted rows"
        parts = [(name, files == number) for number, name in enumerate(errors.files)]
        if not 0 < len(parts) <= MAX_FILES:
            parts = [(errors.name if errors.unseen else "", np.ones(len(rows), dtype=bool))]
        for file, selected in parts:
            title = f"{kind} of {file}" if file else kind
            if errors.worst is not None:
                title = f"{int(selected.sum())} of the {title}, at random"
            points = Line(rows[selected], sizes[selected], ".", AFTER, size=4.5)
            panels.append(Panel([points], title, "row", f"error [{unit}]", grid="y", file=file))
    return Chart(panels or [Panel([])], 0.5 + 1.2 * max(1, len(panels)))


def captioned(report: Report) -> dict[str, Captioned]:
    """Return the charts of a report with captions, by name; charts without data are omitted."""
    proof = report.sets[0]
    for rows in report.sets:
        if rows.unseen:
            proof = rows
            break
    role = "unseen" if proof.unseen else "fitted"
    label = f"{proof.poses} {role} poses ({proof.name})"
    deliverable = report.metrics.deliverable
    delivered, arm = proof.judged(deliverable), proof.judged_arm(deliverable)

    result: dict[str, Captioned] = {}
    for nature in ("position", "orientation", "distance"):
        if nature in delivered:
            before, after = np.array(proof.nominal[nature]), np.array(delivered[nature])
            chart = error_histogram(before, after, nature, report.noise.get(nature), arm)
            quantity = report.metrics.fit.words(nature).capitalize()
            result[nature] = chart, f"{quantity} errors before and after, {label}; dashed: rms."

    steps = [step for step in report.metrics.ladder if step.cross_validated_mm is not None]
    if len(steps) > 1:
        chart = ladder(steps, report.noise.get("position"))
        result["ladder"] = chart, "Models tried, by their cross-validated error. Filled: kept; open: rejected."
    if report.singular_values:
        chart = singular_values(np.array(report.singular_values), report.rank)
        caption = "Singular values of the scaled observation matrix; filled: identifiable, open: not identifiable."
        result["singular_values"] = chart, caption

    if proof.q:
        nature = "position" if "position" in delivered else "distance"
        before, after = np.array(proof.nominal[nature]), np.array(delivered[nature])
        chart = residuals_by_joint(np.array(proof.q), before, after, report.joints, report.prismatic, nature, arm)
        points = _point_values(report, proof)
        chart = replace(chart, points=points, files=proof.files)
        result["joints"] = chart, f"Errors against each joint, {label}: a trend shows an unmodelled effect."

        # intervals hold the joint corrections' errors: they say nothing of the robot without them
        expected = proof.expected if delivered is proof.calibrated else ()
        chart = error_map(np.array(proof.points), after, expected=np.array(expected))
        quantity = report.metrics.fit.words(nature)
        caption = f"Remaining {quantity} error over the workspace, {label}"
        caption += "; below: radius expected to contain 95 % of the errors." if expected else "."
        result["map"] = replace(chart, points=points, files=proof.files), caption
        chart = errors_by_row(report, nature)
        result["rows"] = (
            chart,
            f"{quantity.capitalize()} errors by row of the file: a step shows a change of the set-up.",
        )

    for k, images in enumerate(report.images, 1):
        name = "coverage" if k == 1 else f"coverage_{k}"
        chart = image_coverage(images.size, np.array(images.count), np.array(images.rms))
        result[name] = chart, f"Number of corners and reprojection error over the image ({images.file})."

    of_arm = [row for row in report.parameters if row.group == "arm"]
    if of_arm:
        result["parameters"] = parameter_changes(of_arm), "Parameter changes by the fit. Grey: less than two sigmas."
    if len(report.correlated.names) > 1:
        chart = correlation_map(report.correlated.names, np.array(report.correlated.matrix))
        result["correlations"] = chart, "The most strongly correlated parameters."
    return result
