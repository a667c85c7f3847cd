"""Charts for reports as values: lines, box plots and maps in common colours."""

from calib.procedure.report.figures.charts import Box, Captioned, Chart, Label, Layer, Line, Panel
from calib.procedure.report.figures.figure_files import drawn as drawn_chart
from calib.procedure.report.figures.figure_files import write as write_figures
from calib.procedure.report.figures.style import AFTER, BEFORE, BROWN, INK, MARK, PAGE_WIDTH, QUIET
from calib.procedure.report.geometry_figures import error_histogram, error_map, parameter_changes

__all__ = [
    "AFTER",
    "BEFORE",
    "BROWN",
    "INK",
    "MARK",
    "PAGE_WIDTH",
    "QUIET",
    "Box",
    "Captioned",
    "Chart",
    "Label",
    "Layer",
    "Line",
    "Panel",
    "drawn_chart",
    "error_histogram",
    "error_map",
    "parameter_changes",
    "write_figures",
]
