"""Charts for reports: lines, box plots and maps in a common style."""

from calib.procedure.report.charts import Chart, Layer, Panel, box, line, picture, text
from calib.procedure.report.geometry_figures import error_histogram, error_map, parameter_changes
from calib.procedure.report.style import (
    AFTER,
    BEFORE,
    BROWN,
    INK,
    MARK,
    PAGE_WIDTH,
    QUIET,
    log_axis,
    save,
    sheet,
    styled,
)

__all__ = [
    "AFTER",
    "BEFORE",
    "BROWN",
    "INK",
    "MARK",
    "PAGE_WIDTH",
    "QUIET",
    "Chart",
    "Layer",
    "Panel",
    "box",
    "error_histogram",
    "error_map",
    "line",
    "log_axis",
    "parameter_changes",
    "picture",
    "save",
    "sheet",
    "styled",
    "text",
]
