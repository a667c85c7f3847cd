"""The figures of a geometric calibration: plain arrays in, a `Figure` out. Lengths come in m, angles in rad.

Before is light and after is dark everywhere, so that a greyscale print still tells them apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calib.procedure.report.style import AFTER, BEFORE, HALF, HEAT, INK, MARK, QUIET, WIDE, sheet, styled

UNITS = {"position": (1e3, "mm"), "orientation": (180.0 / np.pi, "deg"), "distance": (1e3, "mm")}


def error_histogram(
    before: np.ndarray, after: np.ndarray, nature: str = "position", noise: float | None = None
) -> Figure:
    """Draw the sizes of errors before and after, each with its rms; `noise` marks what the instrument alone gives.

    Args:
        before, after: (m,) [m] or [rad].
        nature: ``position``, ``orientation`` or ``distance``.
        noise: rms of the instrument's own error, in the same unit.
    """
    factor, unit = UNITS[nature]
    one, two = factor * np.asarray(before), factor * np.asarray(after)
    top = max(one.max(), two.max(), 1e-9) * 1.02
    apart = np.median(two) < np.median(one) / 6.0  # then equal bins would show one bar of the smaller errors
    least = max(min(one.min(), two.min()), 1e-4 * top) * 0.9
    edges = np.geomspace(least, top, 31) if apart else np.linspace(0.0, top, 31)
    with styled():
        figure, (axes,) = sheet(width=HALF, height=2.4)
        axes.set_xscale("log" if apart else "linear")
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.hist(one, edges, color=BEFORE, label="nominal")
        axes.hist(two, edges, color=AFTER, alpha=0.9, label="calibrated")
        for sizes, colour, label in ((one, "#a8622a", "nominal"), (two, AFTER, "calibrated")):
            rms = float(np.sqrt(np.mean(sizes**2)))
            axes.axvline(rms, color=colour, linewidth=1.0, linestyle="--")
            axes.annotate(
                f"{label}\nrms {rms:.3g}", (rms, 0.98), xycoords=("data", "axes fraction"), xytext=(3, 0),
                textcoords="offset points", color=colour, va="top", fontsize=7.5,
            )  # fmt: skip
        if noise:
            axes.axvline(factor * noise, color=QUIET, linewidth=0.9, linestyle=":")
            axes.annotate(
                "instrument", (factor * noise, 0.5), xycoords=("data", "axes fraction"), rotation=90, xytext=(2, 0),
                textcoords="offset points", color=INK, va="center", fontsize=6.5,
            )  # fmt: skip
        axes.set(xlabel=f"{nature} error [{unit}]", ylabel="poses", xlim=(edges[0], edges[-1]))
        axes.margins(y=0.18)
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
    factor, unit = UNITS[nature]
    n = q.shape[1]
    columns = min(4, n)
    rows = -(-n // columns)
    slides = prismatic or [False] * n
    with styled():
        figure, axes = sheet(rows, columns, WIDE, 0.4 + 1.35 * rows)
        for j, plot in enumerate(axes):
            if j >= n:
                plot.set_axis_off()
                continue
            x = q[:, j] if slides[j] else np.rad2deg(q[:, j])
            plot.scatter(x, factor * before, s=4, color=BEFORE, linewidths=0, alpha=0.8, rasterized=len(q) > 60)
            plot.scatter(x, factor * after, s=4, color=AFTER, linewidths=0, alpha=0.9, rasterized=len(q) > 60)
            plot.set_title(f"{joint_names[j]} [{'m' if slides[j] else 'deg'}]", fontsize=7.5, fontweight="normal")
            plot.set_yscale("log")
            plot.set_ylim(*_decades(factor * np.concatenate([before, after])))
            plot.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
            plot.minorticks_off()
            plot.grid(axis="y")
            if j % columns:
                plot.tick_params(labelleft=False)
            else:
                plot.set_ylabel(f"error [{unit}]")
        _dots(axes[0])
    return figure


def _dots(plot: Axes) -> None:
    for height, colour, label in ((0.97, "#a8622a", "nominal"), (0.03, AFTER, "calibrated")):
        side = "top" if height > 0.5 else "bottom"
        plot.text(0.03, height, label, color=colour, transform=plot.transAxes, va=side, fontsize=7, fontweight="bold")


def _decades(sizes: np.ndarray) -> tuple[float, float]:
    """Return limits that leave out the few smallest sizes, with room above for a label."""
    return float(max(np.percentile(sizes, 2), 1e-9)) * 0.5, float(max(sizes.max(), 1e-8)) * 2.5


def error_map(points: np.ndarray, sizes: np.ndarray, names: str = "xyz") -> Figure:
    """Draw where in the workspace errors remain, seen from above and from the side.

    Args:
        points: (m, 3) target positions in the arm's base [m].
        sizes: (m,) errors that remain [m].
        names: of the axes.
    """
    order = np.argsort(sizes)
    top = 1e3 * float(np.max(sizes, initial=1e-9))
    with styled():
        figure, axes = sheet(1, 2, WIDE, 3.1)
        for plot, (i, j) in zip(axes, ((0, 1), (0, 2))):
            plot.scatter(
                points[order, i], points[order, j], c=1e3 * sizes[order], cmap=HEAT, vmin=0.0, vmax=top, s=16,
                edgecolors=QUIET, linewidths=0.25, rasterized=len(points) > 500,
            )  # fmt: skip
            plot.plot(0.0, 0.0, marker="+", color=INK, markersize=9)
            plot.annotate("base", (0.0, 0.0), xytext=(4, 4), textcoords="offset points", fontsize=7)
            plot.set(xlabel=f"{names[i]} [m]", ylabel=f"{names[j]} [m]", aspect="equal")
            plot.set_title("from above" if j == 1 else "from the side", fontweight="normal")
            plot.grid(True)
            plot.set_axisbelow(True)
        figure.colorbar(axes[0].collections[0], ax=axes, label="remaining error [mm]", fraction=0.03, pad=0.02)
    return figure


def parameter_changes(
    names: Sequence[str], units: Sequence[str], changes: np.ndarray, sigmas: np.ndarray, most: int = 48
) -> Figure:
    """Draw calibrated minus nominal with bars of two sigmas, lengths in mm and angles in mrad side by side.

    Args:
        names, units: (p,); units ``m`` and ``rad``, others are left out.
        changes, sigmas: (p,).
        most: parameters per panel, those with the largest change in sigmas first to be kept.
    """
    panels = [[k for k, unit in enumerate(units) if unit == wanted] for wanted in ("m", "rad")]
    panels = [_strongest(panel, changes, sigmas, most) for panel in panels]
    longest = max((len(panel) for panel in panels), default=1)
    with styled():
        figure, axes = sheet(1, 2, WIDE, 0.7 + 0.155 * max(longest, 5))
        for plot, panel, unit in zip(axes, panels, ("mm", "mrad")):
            y = np.arange(len(panel))[::-1]
            value, spread = 1e3 * changes[panel], 2e3 * sigmas[panel]
            clear = np.abs(value) > spread
            plot.axvline(0.0, color=QUIET, linewidth=0.7)
            plot.barh(y, value, height=0.55, color=[AFTER if one else "#c3ccd6" for one in clear])
            plot.errorbar(value, y, xerr=spread, fmt="none", ecolor=MARK, elinewidth=0.9, capsize=1.8)
            plot.set_yticks(y, [names[k] for k in panel], fontsize=7)
            plot.set(xlabel=f"calibrated - nominal [{unit}], bars ±2σ")
            plot.grid(axis="x")
            plot.set_axisbelow(True)
            if not panel:
                plot.set_axis_off()
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
        figure, (axes,) = sheet(width=HALF, height=2.4)
        number = np.arange(1, len(values) + 1)
        axes.semilogy(number[:rank], shown[:rank], "o", color=AFTER, markersize=3)
        axes.semilogy(number[rank:], shown[rank:], "o", markersize=3, markerfacecolor="white", color=MARK)
        if 0 < rank < len(values):
            axes.axvspan(rank + 0.1, rank + 0.9, color="#f3e3e1", linewidth=0)
            ratio = shown[rank - 1] / shown[rank]
            axes.annotate(
                f"gap {ratio:.0e}", (rank + 0.5, np.sqrt(shown[rank - 1] * shown[rank])), xytext=(-6, 0),
                textcoords="offset points", ha="right", va="center", color=MARK, fontsize=7.5,
            )  # fmt: skip
        axes.set(xlabel="number", ylabel="singular value")
        axes.set_title(f"{rank} of {len(values)} can be told", fontweight="normal")
        axes.grid(axis="y")
    return figure


def ladder(
    models: Sequence[str],
    parameters: Sequence[int],
    unseen: Sequence[float],
    kept: Sequence[bool],
    noise: float | None = None,
) -> Figure:
    """Draw the error on rows left out, rung by rung: the climb ends where the gain ends.

    Args:
        models: names of the rungs.
        parameters: fitted by each.
        unseen: cross-validated rms [m].
        kept: whether the climb went on from there; the last one kept is the model chosen.
        noise: rms of the instrument's own error [m].
    """
    errors, x, taken = 1e3 * np.asarray(unseen, dtype=float), np.arange(len(models)), np.flatnonzero(kept)
    with styled():
        figure, (axes,) = sheet(width=WIDE, height=2.3)
        axes.plot(x[taken], errors[taken], color=AFTER, linewidth=1.0, zorder=1)
        for place in x:
            last, face = place == taken[-1] if len(taken) else False, AFTER if kept[int(place)] else "white"
            axes.plot(place, errors[place], "o", color=AFTER, markerfacecolor=face, markersize=8 if last else 5)
            axes.annotate(
                f"{errors[place]:.3g}", (place, errors[place]), xytext=(0, 8), textcoords="offset points", ha="center",
                fontsize=7.5, fontweight="bold" if last else "normal",
            )  # fmt: skip
        if noise:
            axes.axhline(1e3 * noise, color=QUIET, linewidth=0.9, linestyle=":")
            axes.text(-0.45, 1.05e3 * noise, "instrument", color=QUIET, fontsize=6.5, va="bottom")
        axes.set_yscale("log")
        axes.set_ylim(0.7 * min(errors.min(), 1e3 * (noise or np.inf)), 2.4 * errors.max())
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:.0e}"[0] in "25" else "")
        axes.set_xticks(x, [f"{model}\n{count}" for model, count in zip(models, parameters)], fontsize=7)
        axes.set(ylabel="error on rows left out [mm]", xlabel="model, parameters", xlim=(-0.5, len(models) - 0.5))
        axes.grid(axis="y", which="both")
    return figure


def selection_growth(counts: Sequence[int], curves: Mapping[str, Sequence[float]], index: str = "O1") -> Figure:
    """Draw an observability index as the set of poses grows, one line per method, labelled at its end.

    Args:
        counts: numbers of poses.
        curves: method → index at each count; NaN where there is none.
        index: its name.
    """
    shades = [AFTER, "#a8622a", QUIET, MARK, "#4d7c57"]
    with styled():
        figure, (axes,) = sheet(width=HALF, height=2.4)
        for (name, values), colour in zip(curves.items(), shades * 3):
            axes.plot(counts, values, color=colour, linewidth=1.4)
            end = int(np.flatnonzero(np.isfinite(values))[-1])
            axes.annotate(
                name, (counts[end], values[end]), xytext=(4, 0), textcoords="offset points", color=colour, va="center",
                fontsize=7, annotation_clip=False,
            )  # fmt: skip
        axes.set(xlabel="poses", ylabel=f"observability index {index}")
        axes.margins(x=0.02)
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
    with styled():
        figure, (axes,) = sheet(width=HALF, height=3.2)
        image = axes.imshow(block, cmap="PuOr", vmin=-1.0, vmax=1.0)
        axes.set_xticks(range(len(labels)), labels, rotation=90, fontsize=6.5)
        axes.set_yticks(range(len(labels)), labels, fontsize=6.5)
        if len(labels) <= 10:
            for i, j in np.ndindex(*block.shape):
                dark = abs(block[i, j]) > 0.6
                text = f"{block[i, j]:.2f}"
                axes.text(j, i, text, ha="center", va="center", fontsize=5.5, color="white" if dark else INK)
        figure.colorbar(image, ax=axes, label="correlation", fraction=0.046, pad=0.03)
    return figure
