"""The figures of a geometric calibration: plain arrays in, a `Figure` out. Lengths come in m, angles in rad.

Before is light and after is dark everywhere, so that a greyscale print still tells them apart.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from calib.procedure.report.style import (
    AFTER,
    BEFORE,
    BROWN,
    HALF,
    HEAT,
    INK,
    MARK,
    QUIET,
    WIDE,
    colour_scale,
    label_ticks,
    log_axis,
    number,
    room,
    sheet,
    styled,
)
from calib.units import ERRORS

PALE = "#c3ccd6"  # of what is not told from zero
LINE = 0.13  # between labels of 6.5 points [in]


def error_histogram(
    before: np.ndarray, after: np.ndarray, nature: str = "position", noise: float | None = None
) -> Figure:
    """Draw the sizes of errors before and after, each with its rms; `noise` marks what the instrument alone gives.

    Args:
        before, after: (m,) [m] or [rad].
        nature: ``position``, ``orientation`` or ``distance``.
        noise: rms of the instrument's own error, in the same unit.
    """
    factor, unit = ERRORS[nature]
    one, two = factor * np.asarray(before), factor * np.asarray(after)
    top = max(one.max(), two.max(), 1e-9) * 1.02
    apart = np.median(two) < np.median(one) / 6.0  # then equal bins would show one bar of the smaller errors
    seen = factor * noise if noise else top
    least = max(min(one.min(), two.min(), seen), 1e-4 * top) * 0.9
    edges = np.geomspace(least, top, 31) if apart else np.linspace(0.0, top, 31)
    rms = [float(np.sqrt(np.mean(sizes**2))) for sizes in (one, two)]
    with styled():
        figure, (axes,) = sheet(width=HALF, height=2.5, left=0.5)
        highest = 1
        for sizes, colour in ((one, BEFORE), (two, AFTER)):
            counts = np.histogram(sizes, edges)[0]
            highest = max(highest, int(counts.max()))
            axes.stairs(counts, edges, fill=True, color=colour, alpha=0.9)
        for value, colour, label in ((rms[0], BROWN, "nominal"), (rms[1], AFTER, "calibrated")):
            axes.axvline(value, color=colour, linewidth=1.0, linestyle="--")
            right = (np.log(value / edges[0]) / np.log(edges[-1] / edges[0]) if apart else value / edges[-1]) > 0.7
            axes.annotate(
                label, (value, 0.98), xycoords=("data", "axes fraction"), xytext=(-3 if right else 3, 0),
                textcoords="offset points", color=colour, va="top", ha="right" if right else "left", fontsize=7.5,
            )  # fmt: skip
        if noise:
            axes.axvline(seen, color=INK, linewidth=0.9, linestyle=":")
            left = apart and np.log(seen / edges[0]) > 0.25 * np.log(edges[-1] / edges[0])
            axes.annotate(
                "instrument", (seen, 0.89), xycoords=("data", "axes fraction"), xytext=(-3 if left else 3, 0),
                textcoords="offset points", color=INK, va="top", ha="right" if left else "left", fontsize=6.5,
            )  # fmt: skip
        if apart:
            log_axis(axes.xaxis, edges[0], edges[-1])
        axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
        axes.set(xlabel=f"{nature} error [{unit}]", ylabel="poses", ylim=(0.0, 1.2 * highest))
        if not apart:
            axes.set_xlim(edges[0], edges[-1])
        axes.set_title(f"{rms[0]:.3g} {unit} rms before, {rms[1]:.3g} {unit} after")
    return figure


def residuals_by_joint(
    q: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
    joint_names: Sequence[str],
    prismatic: Sequence[bool] | None = None,
    nature: str = "position",
) -> Figure:
    """Draw errors against each joint (small multiples): a trend that stays is something no parameter describes.

    Args:
        q: (m, n) [rad or m].
        before, after: (m,) sizes of errors [m] or [rad].
        joint_names: (n,).
        prismatic: (n,) which joints are.
        nature: as in `error_histogram`.
    """
    factor, unit = ERRORS[nature]
    n = q.shape[1]
    columns = n if n < 4 else 4 if n in (4, 7, 8) else -(-n // 2) if n < 7 else 4
    rows = -(-n // columns)
    slides = prismatic or [False] * n
    low, high = _decades(factor * np.concatenate([before, after]))
    with styled():
        figure, axes = sheet(rows, columns, WIDE, 0.75 + 1.45 * rows, across=0.25, between=0.55, top=0.42)
        for plot in axes[n:]:
            plot.set_axis_off()
        for j, plot in enumerate(axes[:n]):
            x = q[:, j] if slides[j] else np.rad2deg(q[:, j])
            for sizes, colour in ((before, BEFORE), (after, AFTER)):
                plot.plot(x, factor * sizes, ".", color=colour, markersize=3.2, markeredgewidth=0.0)
            plot.set_xlabel(f"{joint_names[j]} [{'m' if slides[j] else 'deg'}]", fontsize=7.5)
            log_axis(plot.yaxis, low, high, 4)
            plot.locator_params(axis="x", nbins=5)
            plot.tick_params(labelsize=7)
            plot.grid(axis="y")
            if j % columns:
                plot.tick_params(labelleft=False)
            else:
                plot.set_ylabel(f"error [{unit}]", fontsize=7.5)
        _key(axes[0])
    return figure


def _key(plot: Axes) -> None:
    """Name the two colours above the upper left corner."""
    for place, colour, label in ((0.0, BROWN, "nominal"), (0.42, AFTER, "calibrated")):
        plot.text(place, 1.05, label, color=colour, transform=plot.transAxes, va="bottom", fontweight="bold")


def _decades(sizes: np.ndarray) -> tuple[float, float]:
    """Return limits that leave out the few smallest sizes."""
    return float(max(np.percentile(sizes, 2), 1e-9)) * 0.5, float(max(sizes.max(), 1e-8)) * 1.3


def error_map(
    points: np.ndarray,
    sizes: np.ndarray,
    names: str = "xyz",
    words: str = "at most {} remain",
    expected: np.ndarray | None = None,
) -> Figure:
    """Draw where in the workspace errors remain, seen from above and from the side; below, what was expected.

    Args:
        points: (m, 3) target positions in the arm's base [m].
        sizes: (m,) errors that remain [m].
        names: of the axes.
        words: of the title, around the largest.
        expected: (m,) radius within which 95 % of such errors are to be [m]; None or empty where it is not known.
    """
    top = 1e3 * float(np.max(sizes, initial=1e-9))
    both = [sizes] if expected is None or not len(expected) else [sizes, expected]
    every = 1e3 * np.concatenate([*both, [1e-9]])
    limit = min(float(every.max()), 1.5 * float(np.percentile(every, 99)))  # few far off do not hide the rest
    with styled():
        figure, axes = sheet(len(both), 2, WIDE, 3.1 * len(both), across=0.6, right=0.75, between=0.7)
        for plot, (k, i, j) in zip(axes, ((k, 0, j) for k in range(len(both)) for j in (1, 2))):
            order = np.argsort(both[k])
            drawn = plot.scatter(
                points[order, i], points[order, j], c=1e3 * both[k][order], cmap=HEAT, vmin=0.0, vmax=limit, s=16,
                edgecolors=QUIET, linewidths=0.25,
            )  # fmt: skip
            plot.plot(0.0, 0.0, marker="+", color=INK, markersize=9)
            plot.annotate("base", (0.0, 0.0), (0, -5), textcoords="offset points", ha="center", va="top", fontsize=7)
            plot.set_aspect("equal", adjustable="datalim")
            plot.locator_params(nbins=6)
            plot.set(xlabel=f"{names[i]} [m]", ylabel=f"{names[j]} [m]")
            plot.grid(True)
            if j == 2:
                colour_scale(figure, plot, drawn, "[mm]", extend="max" if limit < every.max() else "neither")
        axes[0].set_title(f"from above: {words.format(f'{top:.3g} mm')}")
        axes[1].set_title("from the side")
        if len(both) > 1:
            axes[2].set_title("from above: 95 % are expected within")
    return figure


def predicted_map(points: np.ndarray, sigma: np.ndarray) -> Figure:
    """Draw where in the workspace (m, 3) [m] the tool will be known how well (m,) [m], before anything is measured."""
    return error_map(points, sigma, words="predicted σ up to {}")


def image_coverage(size: tuple[int, int], count: np.ndarray, rms: np.ndarray) -> Figure:
    """Draw where in its images a camera saw corners, and their reprojection error; where none was seen stays white.

    Args:
        size: width and height of the images [px].
        count: (rows, columns) corners per cell of the image.
        rms: (rows, columns) reprojection error there [px].
    """
    wide, high = size
    share = float(np.mean(count > 0))
    inch = 0.5 * (WIDE - 2.0) * high / wide
    with styled():
        figure, axes = sheet(1, 2, WIDE, 0.9 + inch, across=0.75, right=0.75)
        corners = count.astype(float), "", f"corners seen, in {share:.0%} of the image"
        drawn = corners, (rms, "[px]", "reprojection error, rms")
        for plot, (values, unit, title) in zip(axes, drawn):
            shown = np.where(count > 0, values, np.nan)
            mesh = plot.imshow(shown, extent=(0, wide, high, 0), cmap=HEAT, vmin=0.0, interpolation="nearest")
            plot.set(xlabel="u [px]", title=title)
            plot.locator_params(nbins=5)
            plot.tick_params(labelleft=plot is axes[0])
            colour_scale(figure, plot, mesh, unit)
        axes[0].set_ylabel("v [px]")
    return figure


def parameter_changes(
    names: Sequence[str], units: Sequence[str], changes: np.ndarray, sigmas: np.ndarray, most: int = 48
) -> Figure:
    """Draw calibrated minus nominal with bars of two sigmas, lengths in mm and angles in mrad side by side.

    Args:
        names, units: (p,); units are ``m`` or ``rad``, others are left out.
        changes, sigmas: (p,) [unit].
        most: parameters per panel, those furthest from nominal by their sigma.
    """
    panels = [[k for k, unit in enumerate(units) if unit == wanted] for wanted in ("m", "rad")]
    panels = [_strongest(panel, changes, sigmas, most) for panel in panels]
    longest = max((len(panel) for panel in panels), default=1)
    margin = room([names[k] for panel in panels for k in panel], 7.0)
    with styled():
        height = 0.75 + 0.155 * max(longest, 5)
        figure, axes = sheet(1, 2, WIDE, height, left=margin, across=margin + 0.1)
        for plot, panel, unit in zip(axes, panels, ("mm", "mrad")):
            if not panel:
                plot.set_axis_off()
                continue
            y = np.arange(len(panel))[::-1]
            value, spread = 1e3 * changes[panel], 2e3 * sigmas[panel]
            clear = np.abs(value) > spread
            thick = 0.55 * 72.0 * (height - 0.73) / (len(panel) + 0.2)
            plot.axvline(0.0, color=QUIET, linewidth=0.7)
            plot.hlines(y, 0.0, value, colors=[AFTER if one else PALE for one in clear], linewidth=min(thick, 9.0))
            plot.errorbar(value, y, xerr=spread, fmt="none", ecolor=MARK, elinewidth=0.9, capsize=1.8)
            label_ticks(plot.yaxis, y, [names[k] for k in panel], 7)
            plot.set(xlabel=f"calibrated - nominal [{unit}], bars ±2σ", ylim=(-0.6, len(panel) - 0.4))
            plot.set_title(
                f"{int(clear.sum())} of {len(panel)} {'lengths' if unit == 'mm' else 'angles'} clearly changed"
            )
            plot.grid(axis="x")
    return figure


def _strongest(panel: list[int], changes: np.ndarray, sigmas: np.ndarray, most: int) -> list[int]:
    if len(panel) <= most:
        return panel
    weight = np.abs(changes) / np.maximum(sigmas, 1e-15)
    return sorted(sorted(panel, key=lambda k: -weight[k])[:most])


def singular_values(values: np.ndarray, rank: int) -> Figure:
    """Draw the singular values of the scaled observation matrix, largest first, and the gap behind the rank.

    Args:
        values: (p,), falling.
        rank: how many are kept.
    """
    values = np.asarray(values, dtype=float)
    floor = max(values[0] * 1e-17, 1e-17)
    shown = np.maximum(values, floor)
    with styled():
        figure, (axes,) = sheet(width=HALF, height=2.5)
        count = np.arange(1, len(values) + 1)
        axes.plot(count[:rank], shown[:rank], "o", color=AFTER, markersize=3)
        axes.plot(count[rank:], shown[rank:], "o", markersize=3, markerfacecolor="white", color=MARK)
        if 0 < rank < len(values):
            axes.axvspan(rank + 0.1, rank + 0.9, color="#f3e3e1", linewidth=0)
            ratio = shown[rank - 1] / shown[rank]
            axes.annotate(
                f"gap {number(ratio)}", (rank + 0.5, np.sqrt(shown[rank - 1] * shown[rank])), xytext=(-6, 0),
                textcoords="offset points", ha="right", va="center", color=MARK, fontsize=7.5,
            )  # fmt: skip
        log_axis(axes.yaxis, 0.3 * shown.min(), 3.0 * shown.max())
        axes.set(xlabel="number", ylabel="singular value")
        axes.set_title(f"{rank} of {len(values)} parameters can be told apart")
        axes.grid(axis="y")
    return figure


def ladder(
    models: Sequence[str],
    parameters: Sequence[int],
    unseen: Sequence[float],
    kept: Sequence[bool],
    noise: float | None = None,
) -> Figure:
    """Draw the error on rows left out, rung by rung: the search ends where the gain ends.

    Args:
        models: names of the rungs.
        parameters: fitted by each.
        unseen: cross-validated rms [m].
        kept: whether the search went on from there; the last one kept is the model chosen.
        noise: rms of the instrument's own error [m].
    """
    errors, x, taken = 1e3 * np.asarray(unseen, dtype=float), np.arange(len(models)), np.flatnonzero(kept)
    left_out, last = np.setdiff1d(x, taken), taken[-1:]
    with styled():
        figure, (axes,) = sheet(width=WIDE, height=2.4, bottom=0.62)
        axes.plot(x[taken], errors[taken], "o-", color=AFTER, linewidth=1.0, markersize=5)
        axes.plot(x[left_out], errors[left_out], "o", color=AFTER, markerfacecolor="white", markersize=5)
        axes.plot(x[last], errors[last], "o", color=AFTER, markersize=8)
        for place, error in zip(x, errors):
            axes.annotate(
                f"{error:.3g}", (place, error), xytext=(0, 8), textcoords="offset points", ha="center", fontsize=7.5,
                fontweight="bold" if place in last else "normal",
            )  # fmt: skip
        if noise:
            axes.axhline(1e3 * noise, color=INK, linewidth=0.9, linestyle=":")
            axes.text(-0.45, 1.05e3 * noise, "instrument", color=INK, fontsize=6.5, va="bottom")
        log_axis(axes.yaxis, 0.7 * min(errors.min(), 1e3 * (noise or np.inf)), 2.4 * errors.max())
        label_ticks(axes.xaxis, x, [f"{model}\n{count}" for model, count in zip(models, parameters)], 7)
        axes.set(ylabel="error on rows left out [mm]", xlabel="model, parameters", xlim=(-0.5, len(models) - 0.5))
        if len(taken):
            chosen = str(models[int(taken[-1])]).removeprefix("+ ")
            axes.set_title(f"{chosen} is where the gain ends: {errors[taken[-1]]:.3g} mm")
        axes.grid(axis="y")
    return figure


def correlation_map(names: Sequence[str], correlation: np.ndarray, threshold: float = 0.9, most: int = 24) -> Figure:
    """Draw the correlations of those parameters that go together with some other one by more than `threshold`.

    Args:
        names: (p,).
        correlation: (p, p).
        threshold: of a strong pair.
        most: parameters shown, the strongest.
    """
    off = np.abs(correlation - np.diag(np.diag(correlation))).max(axis=1)
    chosen = np.flatnonzero(off > threshold)
    if len(chosen) < 2:
        chosen = np.argsort(-off)[:6]
    chosen = np.sort(chosen[np.argsort(-off[chosen])][:most])
    block = correlation[np.ix_(chosen, chosen)]
    labels = [str(names[k]) for k in chosen]
    margin = room(labels, 6.5)
    side = max(HALF - margin - 0.72, LINE * len(labels))  # long names widen the figure, and never overlap
    with styled():
        figure, (axes,) = sheet(
            width=margin + side + 0.72, height=side + margin + 0.3, left=margin, bottom=margin, right=0.72, top=0.3
        )
        image = axes.imshow(block, cmap="PuOr", vmin=-1.0, vmax=1.0, aspect="auto")
        label_ticks(axes.xaxis, range(len(labels)), labels, 6.5, rotation=90)
        label_ticks(axes.yaxis, range(len(labels)), labels, 6.5)
        if len(labels) <= 10:
            for i, j in np.ndindex(*block.shape):
                dark = abs(block[i, j]) > 0.6
                text = f"{block[i, j]:.2f}"
                axes.text(j, i, text, ha="center", va="center", fontsize=5.5, color="white" if dark else INK)
        colour_scale(figure, axes, image, ticks=(-1.0, -0.5, 0.0, 0.5, 1.0))
        if len(labels) > 1:
            strongest = np.abs(block - np.diag(np.diag(block))).max()
            axes.set_title(f"correlations up to {strongest:.2f}", x=-margin / side)
    return figure
