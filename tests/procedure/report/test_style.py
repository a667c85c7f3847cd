"""Figures drawn at once look as matplotlib draws them tick by tick, and are left as they were."""

from __future__ import annotations

import io

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from calib.procedure.report import geometry_figures, style

RNG = np.random.default_rng(0)
NAMES = [f"joint_{k}.offset" for k in range(6)]


def made(kind: str) -> Figure:
    if kind == "joints":
        q, errors = RNG.uniform(-2.0, 2.0, (60, 6)), RNG.uniform(1e-5, 1e-3, (2, 60))
        return geometry_figures.residuals_by_joint(q, *errors, NAMES)
    if kind == "rotated":
        return geometry_figures.correlation_map(NAMES, np.corrcoef(RNG.normal(size=(6, 9))), 0.0)
    return geometry_figures.error_map(RNG.normal(size=(40, 3)), RNG.uniform(0.0, 1e-3, 40))


@pytest.mark.parametrize(
    "kind", ["rotated", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("joints", "map"))]
)
def test_a_picture_is_what_matplotlib_draws(kind):
    figure = made(kind)
    with style.styled():
        figure.set_dpi(style.DPI)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        expected = np.asarray(canvas.buffer_rgba())[..., :3].astype(float)
        drawn = np.asarray(Image.open(io.BytesIO(style.png(figure))).convert("RGB"), dtype=float)
        apart = np.abs(drawn - expected).max(axis=2) > 64.0  # beyond what a palette costs
        assert apart.mean() < 0.002
        assert (expected.min(axis=2) < 128.0).mean() > 0.01  # there is something to be wrong about
        again = np.asarray(Image.open(io.BytesIO(style.png(figure))).convert("RGB"), dtype=float)
    assert np.array_equal(drawn, again)
    assert all(axis.get_visible() for axes in figure.axes for axis in (axes.xaxis, axes.yaxis))
