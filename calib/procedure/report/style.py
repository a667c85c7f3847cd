"""How every figure looks and is written: one palette that survives a greyscale print, quiet axes, whole files."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calib import files

BEFORE, AFTER, MARK, QUIET, INK = "#e2a26b", "#17486e", "#b3261e", "#8a8f98", "#22262b"
HEAT = "cividis_r"
WIDE, HALF = 7.4, 3.6
STYLE: Any = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Helvetica", "Arial", "sans-serif"],
    "font.size": 8.5,
    "axes.titlesize": 9.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": QUIET,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "text.color": INK,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "grid.color": "#e3e5e8",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
    "svg.fonttype": "none",
}


@contextmanager
def styled() -> Iterator[None]:
    """Draw in our style, leaving matplotlib's settings as they were."""
    with matplotlib.rc_context(STYLE):
        yield


def sheet(rows: int = 1, columns: int = 1, width: float = HALF, height: float = 2.5) -> tuple[Figure, list[Axes]]:
    """Return a figure without a window, and its axes row by row; width and height in inches."""
    figure = Figure(figsize=(width, height))
    axes = figure.subplots(rows, columns, squeeze=False)
    return figure, list(axes.ravel())


def motion_units(kinds: Iterable[str]) -> tuple[str, str, str, str]:
    """Return the units of position, velocity, acceleration and torque of joints of these kinds."""
    found = set(kinds)
    first = "rad" if "prismatic" not in found else "m" if found == {"prismatic"} else "rad, m"
    torque = {"rad": "N m", "m": "N"}.get(first, "N m, N")
    return first, f"{first}/s", f"{first}/s²", torque


def motion_sheet(
    times: np.ndarray, rows: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray, str]], units: Sequence[str],
    names: Sequence[str],
) -> Figure:  # fmt: skip
    """Draw series of every joint, a line per joint and a column per series, with their limits dashed.

    Args:
        times: (N,) [s].
        rows: values (N, n), lower and upper limit (n,), title.
        units: of each series.
        names: of the n joints.
    """
    with styled():
        figure, axes = sheet(len(names), len(rows), WIDE, 0.85 * len(names) + 0.5)
        for j, k in np.ndindex(len(names), len(rows)):
            values, lower, upper, title = rows[k]
            axis = axes[j * len(rows) + k]
            axis.plot(times, values[:, j], color=AFTER, linewidth=0.8)
            for bound in (lower[j], upper[j]):
                if np.isfinite(bound):
                    axis.axhline(bound, color=MARK, linewidth=0.6, linestyle="--")
            if j == 0:
                axis.set_title(f"{title} [{units[k]}]")
            if k == 0:
                axis.set_ylabel(names[j], fontsize=7)
        for axis in axes[-len(rows) :]:
            axis.set_xlabel("time [s]")
    return figure


def save(figure: Figure, path: str | Path, dpi: int = 150) -> Path:
    """Write a figure whole or not at all; the suffix (png, svg, pdf) says the form."""
    return files.write(path, _bytes(figure, Path(path).suffix.lstrip(".") or "png", dpi))


def svg(figure: Figure, name: str) -> str:
    """Return a figure as an SVG element to stand in a page; `name` keeps its ids apart from those of other figures."""
    text = _bytes(figure, "svg", 100, name).decode()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'(id="|url\(#|href="#)', rf"\g<1>{name}-", text)
    return re.sub(r'<svg ([^>]*?)width="[^"]*" height="[^"]*"', r'<svg \1role="img"', text, count=1).strip()


def png_uri(figure: Figure, dpi: int = 150) -> str:
    """Return a figure as a data URI, for pictures with thousands of points."""
    return "data:image/png;base64," + base64.b64encode(_bytes(figure, "png", dpi)).decode()


def _bytes(figure: Figure, form: str, dpi: int, salt: str = "calib") -> bytes:
    buffer = io.BytesIO()
    with styled(), matplotlib.rc_context({"svg.hashsalt": salt}):
        figure.savefig(buffer, format=form, dpi=dpi, metadata={"Date": None} if form == "svg" else None)
    return buffer.getvalue()
