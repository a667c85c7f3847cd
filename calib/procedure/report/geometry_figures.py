"""Figures of a geometric calibration, from a `Report` or from arrays [m, rad], as `Chart`s with captions.

Before is light and after is dark, so that a greyscale print distinguishes them.
"""

from collections.abc import Sequence

import numpy as np

from calib.geometry.model_choice.ladder import ModelStep
from calib.procedure.kinematic_stage.validation import ARM
from calib.procedure.report.charts import Captioned, Chart, Panel, bars, dots, heat, histogram, level, line, text
from calib.procedure.report.fit_report import FittedParameter, Report
from calib.procedure.report.style import AFTER, BEFORE, BROWN, HALF_WIDTH, INK, MARK, PAGE_WIDTH, number
from calib.units import ERRORS

Curve = Sequence[tuple[float, float]]
PALE = "#c3ccd6"  # of changes below two sigmas


def error_histogram(
    before: np.ndarray, after: np.ndarray, nature: str = "position", noise: float | None = None, arm: str = ARM["urdf"]
) -> Chart:
    """Return the histogram of errors before and after, each with its rms; `noise` marks the instrument's error.

    Args:
        before, after: (m,) [m] or [rad].
        nature: ``position``, ``orientation`` or ``distance``.
        noise: rms of the instrument's own error, in the same unit.
        arm: whose errors `after` are, in a word or two.
    """
    factor, unit = ERRORS[nature]
    one, two = factor * np.asarray(before), factor * np.asarray(after)
    top = max(one.max(), two.max(), 1e-9) * 1.02
    apart = np.median(two) < np.median(one) / 6.0  # then equal bins would show one bar of the smaller errors
    seen = factor * noise if noise else top
    least = max(min(one.min(), two.min(), seen), 1e-4 * top) * 0.9
    edges = np.geomspace(least, top, 31) if apart else np.linspace(0.0, top, 31)
    rms = [float(np.sqrt(np.mean(sizes**2))) for sizes in (one, two)]
    counts = [np.histogram(sizes, edges)[0] for sizes in (one, two)]
    panel = Panel(
        [
            *(histogram(count, edges, colour) for count, colour in zip(counts, (BEFORE, AFTER))),
            level(rms[0], BROWN, upright=True, words="nominal"),
            level(rms[1], AFTER, upright=True, words=arm, height=0.9),
            *([level(seen, INK, ":", upright=True, words="instrument", height=0.82)] if noise else []),
        ],
        f"{rms[0]:.3g} {unit} rms before, {rms[1]:.3g} {unit} after",
        f"{nature} error [{unit}]",
        "poses",
        xlim=(edges[0], edges[-1]),
        ylim=(0.0, 1.3 * max(1, *map(max, counts))),
        log="x" if apart else "",
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
    """Return the chart of errors over each joint value; a trend in the errors shows an unmodelled effect.

    Args:
        q: (m, n) [rad or m].
        before, after: (m,) sizes of errors [m] or [rad].
        joint_names: (n,).
        prismatic: (n,) which joints are.
        nature, arm: as in `error_histogram`.
    """
    factor, unit = ERRORS[nature]
    n = q.shape[1]
    columns = n if n < 4 else 4 if n in (4, 7, 8) else -(-n // 2) if n < 7 else 4
    sizes = factor * np.concatenate([before, after])
    limits = float(max(np.percentile(sizes, 2), 1e-9)) * 0.5, float(max(sizes.max(), 1e-8)) * 1.3
    panels = []
    for j in range(n):
        x = q[:, j] if prismatic[j] else np.rad2deg(q[:, j])
        cloud = [
            line(x, factor * errors, ".", colour, size=4.5, label=label)
            for errors, colour, label in ((before, BEFORE, "nominal"), (after, AFTER, arm))
        ]
        name = f"{joint_names[j]} [{'m' if prismatic[j] else 'deg'}]"
        panels.append(Panel(cloud, x=name, y=f"error [{unit}]", ylim=limits, log="y", grid="y", ticks=5))
    title = f"{nature} errors of {len(q)} poses"
    return Chart(panels, 0.55 + 1.35 * -(-n // columns), columns, title=title, shared="y")


def error_map(
    points: np.ndarray,
    sizes: np.ndarray,
    words: str = "at most {} remain",
    expected: np.ndarray | None = None,
    least: float = 0.0,
) -> Chart:
    """Return the maps of remaining errors in the workspace (from above and from the side) and of expected errors.

    Args:
        points: (m, 3) target positions in the arm's base [m].
        sizes: (m,) errors that remain [m].
        words: of the title, around the largest.
        expected: (m,) radius within which 95 % of such errors are to be [m]; None or empty where it is not known.
        least: where the colours begin [m].
    """
    top = 1e3 * float(np.max(sizes, initial=1e-9))
    both = [sizes] if expected is None or not len(expected) else [sizes, expected]
    every = 1e3 * np.concatenate([*both, [1e-9]])
    most = min(float(every.max()), 1.5 * float(np.percentile(every, 99)))  # few far off do not hide the rest
    titles = (
        (f"from above: {words.format(f'{top:.3g} mm')}", "from the side"),
        ("from above: expected 95 % radius", ""),
    )
    panels = [
        Panel(
            [
                dots(points[:, 0], points[:, j], 1e3 * np.asarray(values), 1e3 * least, most, "[mm]" if j == 2 else ""),
                line([0.0], [0.0], "+", INK, size=9.0),
                text("base", 0.0, 0.0, (-5, 4), across="right"),
            ],
            title,
            "x [m]",
            f"{'xyz'[j]} [m]",
            grid="both",
            equal=True,
            ticks=6,
        )
        for values, row in zip(both, titles)
        for j, title in zip((1, 2), row)
    ]
    return Chart(panels, 3.0 * len(both), 2)


def predicted_map(points: np.ndarray, sigma: np.ndarray) -> Chart:
    """Return the map of the tool position's predicted σ (m,) [m] at points (m, 3) [m] of the workspace."""
    return error_map(points, sigma, words="predicted σ up to {}", least=float(np.min(sigma)))


def image_coverage(size: tuple[int, int], count: np.ndarray, rms: np.ndarray) -> Chart:
    """Return the maps of corner counts and reprojection errors in a camera's images; white: no corners.

    Args:
        size: width and height of the images [px].
        count: (rows, columns) corners per cell of the image.
        rms: (rows, columns) reprojection error there [px].
    """
    wide, high = size
    shown = (
        (count.astype(float), "", f"corners seen, in {np.mean(count > 0):.0%} of the image"),
        (rms, "[px]", "reprojection error, rms"),
    )
    panels = [
        Panel([heat(np.where(count > 0, values, np.nan), unit, (0, wide, high, 0))], title, "u [px]", "v [px]", ticks=5)
        for values, unit, title in shown
    ]
    return Chart(panels, 0.8 + 0.5 * (PAGE_WIDTH - 2.0) * high / wide, 2)


def parameter_changes(rows: Sequence[FittedParameter], most: int = 48, of: str = "fitted - nominal") -> Chart:
    """Return the chart of fitted minus nominal values with bars of two sigmas; lengths in mm, angles in mrad.

    Args:
        rows: fitted parameters; those in other units are left out.
        most: parameters per panel, those furthest from nominal by their sigma.
        of: of what the difference is, in words.
    """
    panels, longest = [], 5
    for base, unit, what in (("m", "mm", "lengths"), ("rad", "mrad", "angles")):
        own = [row for row in rows if row.unit == base]
        change = np.array([row.value - row.nominal for row in own])
        sigma = np.array([row.sigma for row in own])
        chosen = np.sort(np.argsort(-np.abs(change) / np.maximum(sigma, 1e-15), kind="stable")[:most])
        if not len(chosen):
            continue
        value, spread = 1e3 * change[chosen], 2e3 * sigma[chosen]
        clear = np.abs(value) > spread
        shown = bars(value, [AFTER if one else PALE for one in clear], spread=spread)
        words = f"{int(clear.sum())} of {len(chosen)} {what} clearly changed"
        labels = [own[k].name for k in chosen]
        panels.append(Panel([shown], words, f"{of} [{unit}], bars ±2σ", ynames=labels, grid="x"))
        longest = max(longest, len(chosen))
    return Chart(panels, 0.65 + 0.155 * longest, max(1, len(panels)))


def singular_values(values: np.ndarray, rank: int) -> Chart:
    """Return the chart of singular values of the scaled observation matrix, and of the gap below the identifiable ones.

    Args:
        values: (p,), falling.
        rank: how many are kept.
    """
    values = np.asarray(values, dtype=float)
    shown = np.maximum(values, max(values[0] * 1e-17, 1e-17))
    count = np.arange(1, len(values) + 1)
    layers: list = [line(count[:rank], shown[:rank], "o"), line(count[rank:], shown[rank:], "o", MARK, hollow=True)]
    if 0 < rank < len(values):
        last, first = shown[rank - 1], shown[rank]
        middle = rank + 0.5, float(np.sqrt(last * first))
        layers.append(text(f"gap {number(last / first)}", *middle, (-6, 0), MARK, across="right", along="center"))
    title = f"{rank} of {len(values)} parameters are identifiable"
    limits = 0.3 * float(shown.min()), 3.0 * float(shown.max())
    return Chart(
        [Panel(layers, title, "number", "singular value", ylim=limits, log="y", grid="y")], 2.4, width=HALF_WIDTH
    )


def ladder(steps: Sequence[ModelStep], noise: float | None = None) -> Chart:
    """Return the chart of cross-validated errors of the models tried, up to the first without improvement.

    Args:
        steps: models with such an error; the last one kept, without a note, is the model chosen.
        noise: rms of the instrument's own error [m].
    """
    errors, x = np.array([step.cross_validated_mm for step in steps], dtype=float), np.arange(len(steps))
    taken = np.flatnonzero([not step.note for step in steps])
    left_out, last = np.setdiff1d(x, taken), taken[-1:]
    layers: list = [
        line(x[taken], errors[taken], "o-", size=5.0),
        line(x[left_out], errors[left_out], "o", size=5.0, hollow=True),
        line(x[last], errors[last], "o", size=8.0),
        *(text(f"{error:.3g}", place, error, (0, 8), across="center") for place, error in enumerate(errors)),
    ]
    if noise:
        layers.append(level(1e3 * noise, INK, ":", words="instrument"))
    limits = 0.7 * min(errors.min(), 1e3 * (noise or np.inf)), 2.4 * errors.max()
    ends = (f"{steps[k].model.removeprefix('+ ')} is the last to reduce the error: to {errors[k]:.3g} mm" for k in last)
    panel = Panel(
        layers,
        next(ends, ""),
        "model, parameters",
        "cross-validated error [mm]",
        ylim=limits,
        log="y",
        xnames=[f"{step.model}\n{step.parameters}" for step in steps],
        grid="y",
    )
    return Chart([panel], 2.4)


def correlation_map(names: Sequence[str], correlation: np.ndarray) -> Chart:
    """Return the map of the parameters' correlations (p, p), with their names (p,)."""
    off = np.abs(correlation - np.diag(np.diag(correlation)))
    matrix = heat(correlation, limits=(-1.0, 1.0), colours="PuOr", written=len(names) <= 10)
    # long names widen the figure, and never overlap
    side = max(HALF_WIDTH, 0.13 * len(names) + 0.05 * max(map(len, names)) + 1.0)
    panel = Panel([matrix], f"correlations up to {off.max():.2f}", xnames=names, ynames=names)
    return Chart([panel], side - 0.3, width=side)


def outlook_figure(others: Curve, own: tuple[float, float], along: str, across: str) -> Chart:
    """Return the chart of predicted σ over measuring effort, both logarithmic; the present plan is marked.

    Args:
        others: pairs of effort and sigma; own: the same of the plan.
        along, across: what they are, with units.
    """
    points = np.array(sorted(others)).reshape(-1, 2)
    low, high = np.vstack([points, [own]]).min(axis=0), np.vstack([points, [own]]).max(axis=0)
    layers = [
        line(points[:, 0], points[:, 1], "o-", BEFORE),
        line([own[0]], [own[1]], "o", MARK, size=5.5),
        text("this plan", *own),
    ]
    panel = Panel(
        layers,
        "predicted before measuring",
        along,
        across,
        (0.8 * low[0], 1.25 * high[0]),
        (0.7 * low[1], 1.4 * high[1]),
        log="xy",
        grid="both",
    )
    return Chart([panel], 2.4, width=HALF_WIDTH)


def captioned(report: Report) -> dict[str, Captioned]:
    """Return the charts of a report with captions, by name; charts without data are omitted."""
    result: dict[str, Captioned] = {}
    proof = next((rows for rows in report.sets if rows.unseen), report.sets[0])
    label = f"{proof.poses} {'unseen' if proof.unseen else 'fitted'} poses ({proof.name})"
    delivered, arm = proof.judged(report.metrics.deliverable), proof.judged_arm(report.metrics.deliverable)
    for nature in ("position", "orientation", "distance"):
        if nature in delivered:
            before, after = np.array(proof.nominal[nature]), np.array(delivered[nature])
            chart = error_histogram(before, after, nature, report.noise.get(nature), arm)
            named = report.metrics.fit.words(nature).capitalize()
            result[nature] = chart, f"{named} errors before and after, {label}; dashed: rms."
    rungs = [rung for rung in report.metrics.ladder if rung.cross_validated_mm is not None]
    if len(rungs) > 1:
        chart = ladder(rungs, report.noise.get("position"))
        result["ladder"] = chart, "Models tried, by their cross-validated error. Filled: kept; open: rejected."
    if report.singular_values:
        chart = singular_values(np.array(report.singular_values), report.rank)
        words = "Singular values of the scaled observation matrix; filled: identifiable, open: not identifiable."
        result["singular_values"] = chart, words
    if proof.q:
        nature = "position" if "position" in delivered else "distance"
        before, after = np.array(proof.nominal[nature]), np.array(delivered[nature])
        chart = residuals_by_joint(np.array(proof.q), before, after, report.joints, report.prismatic, nature, arm)
        result["joints"] = chart, f"Errors against each joint, {label}: a trend shows an unmodelled effect."
        # intervals hold the joint corrections' errors: they say nothing of the robot without them
        expected = proof.expected if delivered is proof.calibrated else ()
        chart = error_map(np.array(proof.points), after, expected=np.array(expected))
        below = "; below: radius expected to contain 95 % of the errors." if expected else "."
        named = report.metrics.fit.words(nature)
        result["map"] = chart, f"Remaining {named} error over the workspace, {label}{below}"
    for count, seen in enumerate(report.images, 1):
        chart = image_coverage(seen.size, np.array(seen.count), np.array(seen.rms))
        words = f"Number of corners and reprojection error over the image ({seen.file})."
        result["coverage" if count == 1 else f"coverage_{count}"] = chart, words
    if moved := [row for row in report.parameters if row.group == "arm"]:
        result["parameters"] = parameter_changes(moved), "Parameter changes by the fit. Grey: less than two sigmas."
    if len(report.correlated.names) > 1:
        chart = correlation_map(report.correlated.names, np.array(report.correlated.matrix))
        result["correlations"] = chart, "The most strongly correlated parameters."
    return result
