"""Figures as values: a `Chart` is a grid of `Panel`s, and a panel contains layers over two axes.

Layers are lines, bars, marked levels, labels, coloured dots, heat maps, histograms and box plots. Charts know no
library that draws: `drawing` draws them by matplotlib, `svg` writes them for certificates, and `figures.js` draws them
in the browser from the text of `figure_data`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from numpy.typing import ArrayLike

from calib.procedure.report.figures.style import AFTER, INK, MARK, PAGE_WIDTH

# most letters of a name at an axis: beside it, upright below it, and of title and label of one of several panels in a
# row; longer ones lose their middle (our choice, by the space of the three readers)
MAX_NAME, MAX_UPRIGHT_NAME, MAX_TITLE = 30, 18, 28
# panels in a row from which on titles and labels have that little space
NARROW_COLUMNS = 3


def shortened(text: str, letters: int) -> str:
    """Return a text of at most so many letters: of a longer one a third is its beginning, the rest its end."""
    if len(text) <= letters:
        return text
    beginning = letters // 3
    return f"{text[:beginning]}…{text[len(text) - letters + beginning + 1 :]}"


def _distinct(names: Sequence[str], letters: int) -> Sequence[str]:
    """Return names of one line shortened; unchanged where two of them would become equal."""
    if any("\n" in name for name in names):
        return names
    short = [shortened(name, letters) for name in names]
    if len(set(short)) < len(set(names)):
        return names
    return short


@dataclass(frozen=True, eq=False)
class Line:
    """A curve or points (k,); curves with many points are thinned where they are drawn.

    Attributes:
        x, y: (k,) coordinates.
        form: matplotlib format, such as ``-``, ``o`` or ``o-``.
        colour: colour of line and points.
        width: width of the line [pt].
        size: size of the points [pt].
        hollow: whether points are drawn as outlines only.
        label: text in the legend; empty: none.
        spread: (k,) half lengths of error bars; None: no error bars.
        switch: name of the switch of a page that shows and hides the curve, such as a joint's; empty: none.
    """

    x: ArrayLike
    y: ArrayLike
    form: str = "-"
    colour: str = AFTER
    width: float = 0.9
    size: float = 3.5
    hollow: bool = False
    label: str = ""
    spread: ArrayLike | None = None
    switch: str = ""


@dataclass(frozen=True, eq=False)
class Bars:
    """Bars (k,) from `base` to their values, at the positions 0, 1, … of the other axis.

    Attributes:
        values: (k,) ends of the bars.
        colours: one colour for all bars, or one per bar.
        upright: whether the bars are vertical.
        shift: offset of the positions.
        thick: thickness of the bars.
        base: value at which the bars begin.
        spread: (k,) half lengths of error bars; None: no error bars.
        label: text in the legend.
    """

    values: ArrayLike
    colours: str | Sequence[str] = AFTER
    upright: bool = False
    shift: float = 0.0
    thick: float = 0.7
    base: float = 0.0
    spread: ArrayLike | None = None
    label: str = ""


@dataclass(frozen=True, eq=False)
class Level:
    """A horizontal or vertical line across the panel, with a label.

    Attributes:
        at: position of the line.
        colour: colour of line and label.
        form: matplotlib line style, such as ``--``.
        upright: whether the line is vertical.
        text: the label.
        height: height of a vertical line's label, as a share of the panel's height.
    """

    at: float
    colour: str = MARK
    form: str = "--"
    upright: bool = False
    text: str = ""
    height: float = 0.98


@dataclass(frozen=True, eq=False)
class Label:
    """A text at a point, shifted by an offset.

    Attributes:
        text: the text.
        x, y: the point.
        offset: shift to the right and upwards [pt].
        colour: colour of the text.
        size: font size [pt].
        across, along: matplotlib's horizontal and vertical alignment of the text.
    """

    text: str
    x: float
    y: float
    offset: tuple[float, float] = (4, 4)
    colour: str = INK
    size: float = 7.0
    across: str = "left"
    along: str = "baseline"


@dataclass(frozen=True, eq=False)
class Dots:
    """Points (k,) coloured by their values.

    Attributes:
        x, y: (k,) coordinates.
        values: (k,) values.
        low, high: values of the first and the last colour.
        unit: title of the colour bar; empty: no colour bar.
    """

    x: ArrayLike
    y: ArrayLike
    values: ArrayLike
    low: float
    high: float
    unit: str = ""


@dataclass(frozen=True, eq=False)
class Heat:
    """A colour map of values (rows, columns) with a colour bar; row 0 is at the top, and NaN is white.

    Attributes:
        values: the values.
        unit: title of the colour bar.
        extent: coordinates of the map's left, right, bottom and top edge; None: cell k is at coordinate k.
        limits: values of the first and the last colour; None: the largest value.
        colours: name of the colour map.
        written: whether each value is printed in its cell.
    """

    values: ArrayLike
    unit: str = ""
    extent: tuple[float, float, float, float] | None = None
    limits: tuple[float, float | None] = (0.0, None)
    colours: str = "cividis_r"
    written: bool = False


@dataclass(frozen=True, eq=False)
class Histogram:
    """A histogram of k counts (k,) between bin edges (k + 1,).

    Attributes:
        counts: number in each bin.
        edges: bin edges, rising.
        colour: colour of the bars.
    """

    counts: ArrayLike
    edges: ArrayLike
    colour: str = AFTER


@dataclass(frozen=True, eq=False)
class Box:
    """A horizontal box plot of values (k,) at a y position.

    It shows quartiles and median, 5th and 95th percentile, and all points beyond these percentiles.

    Attributes:
        values: the values.
        position: the y position.
        colour: colour of the box.
    """

    values: ArrayLike
    position: float
    colour: str = AFTER


Layer = Line | Bars | Level | Label | Dots | Heat | Histogram | Box


@dataclass(frozen=True, eq=False)
class Panel:
    """A panel of a chart: layers over two axes.

    Attributes:
        layers: layers in drawing order.
        title, x, y: title, and labels of the axes.
        xlim, ylim: limits of the axes; None: chosen by the content.
        log: letters of the logarithmic axes, whose limits are required.
        xnames, ynames: labels at 0, 1, … instead of numbers; upright along x if of one line. Long ones lose their
            middle. None: numbers.
        grid: axes with grid lines: ``x``, ``y``, ``both`` or empty.
        equal: whether both axes have the same scale.
        symlog: the y axis is linear between ± this value and logarithmic beyond; 0: linear everywhere.
        ticks: approximate largest number of ticks per axis; 0: default.
        switch: name of the switch of a page that shows and hides the panel, such as a joint's; empty: none.
        file: name of the file whose rows are along x; empty: of several, or none.
    """

    layers: Sequence[Layer]
    title: str = ""
    x: str = ""
    y: str = ""
    xlim: tuple[float, float] | None = None
    ylim: tuple[float, float] | None = None
    log: str = ""
    xnames: Sequence[str] | None = None
    ynames: Sequence[str] | None = None
    grid: str = ""
    equal: bool = False
    symlog: float = 0.0
    ticks: int = 0
    switch: str = ""
    file: str = ""

    def __post_init__(self) -> None:
        for field_name, letters in (("xnames", MAX_UPRIGHT_NAME), ("ynames", MAX_NAME)):
            names = getattr(self, field_name)
            if names is not None:
                object.__setattr__(self, field_name, _distinct(names, letters))


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points in space coloured by their values, which a page shows as a map that turns, instead of the panels.

    Attributes:
        points: (k, 3) positions [m].
        values: (k,) values.
        low, high: values of the first and the last colour.
        unit: unit of the values.
    """

    points: ArrayLike
    values: ArrayLike
    low: float
    high: float
    unit: str


@dataclass(frozen=True, eq=False)
class Chart:
    """A figure as a value: panels, row by row.

    Attributes:
        panels: at least one panel.
        height, width: size of the figure [in].
        columns: number of panels in a row.
        title: title of the figure, beside the legend of the first panel; empty: neither title nor legend.
        shared: letters of the axes whose labels are drawn only at the edge of the grid: ``x`` at the lowest panel of
            each column, ``y`` at the first panel of each row.
        linked: charts of a page with the same word share zoom and cursor along x; empty: not linked.
        points: name -> (k,) values that a page shows under the pointer, for layers of k points: row, σ, joint values;
            ``file`` is an index into `files`.
        files: names of the files of the points.
        cloud: the points in space; None: the chart is no map.
    """

    panels: Sequence[Panel]
    height: float
    columns: int = 1
    width: float = PAGE_WIDTH
    title: str = ""
    shared: str = ""
    linked: str = ""
    points: Mapping[str, ArrayLike] = field(default_factory=dict)
    cloud: Cloud | None = None
    files: Sequence[str] = ()

    def __post_init__(self) -> None:
        if self.columns < NARROW_COLUMNS:
            return
        panels = []
        for panel in self.panels:
            title, label = shortened(panel.title, MAX_TITLE), shortened(panel.x, MAX_TITLE)
            panels.append(replace(panel, title=title, x=label))
        object.__setattr__(self, "panels", panels)


Captioned = tuple[Chart, str]  # with what it shows, in a sentence
