"""Figures as files of a result: their data where no page has them, and drawings where they are asked for."""

from collections.abc import Mapping
from pathlib import Path

from calib import files
from calib.config_types import Plots
from calib.procedure.report.figures import figure_data
from calib.procedure.report.figures.charts import Captioned, Chart
from calib.workers.extras import needing


def write(folder: Path, charts: Mapping[str, Captioned], plots: Plots, paged: bool) -> None:
    """Write the figures of a result into its folder: ``figures.json``, and ``plot_<name>.png`` or ``.svg``.

    Args:
        folder: folder of the result.
        charts: the figures by name, with captions.
        plots: what is written: False nothing, True the data, a format drawings in it, too.
        paged: whether a page of the folder has the data, so that no ``figures.json`` is written.
    """
    if plots and charts and not paged:
        figure_data.write(folder, charts)
    if isinstance(plots, str):
        for name, (chart, _) in charts.items():
            files.write(folder / f"plot_{name}.{plots}", drawn(chart, plots))


def drawn(chart: Chart, form: str) -> bytes:
    """Return a chart as the content of a file.

    Args:
        chart: the chart.
        form: ``png``, drawn by matplotlib, or ``svg``.

    Raises:
        UsageError: matplotlib is not installed.
    """
    if form == "svg":
        from calib.procedure.report.figures.svg import svg

        return svg(chart)
    with needing("matplotlib", "; without it: --plots svg"):
        from calib.procedure.report.figures.drawing import png

    return png(chart)
