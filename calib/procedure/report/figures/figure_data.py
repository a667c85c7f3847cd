"""Figures as text (JSON): what ``figures.json`` holds beside a result, and what its page draws.

A chart is a dictionary of its fields, a layer has the name of its class as ``layer``. Arrays stand apart and once per
figure, ``{"array": 3}``, little-endian in base64: numbers of four bytes, ``{"f4": "AACAPw=="}``, or, of long curves,
steps of two bytes from a lowest value, ``{"u2": "AAD//w==", "low": -1.5, "step": 4.6e-5}``.
"""

import base64
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from calib import files
from calib.config_types import ParsedTable
from calib.errors import CalibError
from calib.folders import FIGURES, PAGES
from calib.procedure.report.figures.charts import Captioned, Chart, Cloud, Layer, Line, Panel
from calib.procedure.report.figures.style import STRETCHES, thinned

NAME = FIGURES
# what stands before the figures in a page
BEGIN = '<script type="application/json" id="figures">'
SCHEMA = 1
# numbers from which on a sequence is written as an array
SHORTEST_ARRAY = 16
# length of a curve from which on its values are steps of two bytes, and number of steps between their limits
SHORTEST_STEPS, STEPS = 256, 65535
# samples of all curves in a page: about 0.7 MB
MAX_SAMPLES = 250_000
# script with all samples of a figure, beside the page
WHOLE = "figure_{}.js"
# packed arrays of a figure by their content, each with its number
Arrays: TypeAlias = dict[bytes, tuple[int, ParsedTable]]
FieldValue: TypeAlias = Any  # of a chart, or its JSON value
LAYERS: Mapping[str, type] = {kind.__name__: kind for kind in Layer.__args__}


def text(charts: Mapping[str, Captioned]) -> str:
    """Return charts with captions, by name, as JSON with all their samples.

    Args:
        charts: the charts.
    """
    figures = {}
    for name, (chart, caption) in charts.items():
        figures[name] = _figure(chart, caption)
    return _json({"schema": SCHEMA, "figures": figures})


def page_text(charts: Mapping[str, Captioned]) -> str:
    """Return charts with captions, by name, as JSON that may stand in a script of a page.

    Curves beyond the room of a page are thinned; their figures name the file with all samples (`whole_figures`).

    Args:
        charts: the charts.
    """
    figures = {}
    whole = _whole(charts)
    for name, (chart, caption) in charts.items():
        if name in whole:
            figures[name] = _figure(_thinned(chart), caption) | {"whole": WHOLE.format(name)}
        else:
            figures[name] = _figure(chart, caption)
    return _json({"schema": SCHEMA, "figures": figures})


def whole_figures(charts: Mapping[str, Captioned]) -> Iterator[tuple[str, str]]:
    """Yield name and content of the scripts with all samples of the figures that a page shows thinned.

    Args:
        charts: all charts of the page, with captions.
    """
    for name in sorted(_whole(charts)):
        chart, caption = charts[name]
        arguments = _json([name, _figure(chart, caption)])
        yield WHOLE.format(name), f"calibFigure(...{arguments});\n"


def _whole(charts: Mapping[str, Captioned]) -> set[str]:
    """Return the names of the charts whose curves have no room in a page; the first ones have it first."""
    names = set()
    samples = MAX_SAMPLES
    for name, (chart, _) in charts.items():
        longest, count = 0, 0
        for curve in _curves(chart):
            longest = max(longest, np.size(curve.y))
            count += np.size(curve.y)
        if longest > 2 * STRETCHES and count > samples:
            names.add(name)
        else:
            samples -= count
    return names


def _curves(chart: Chart) -> Iterator[Line]:
    """Yield the curves of a chart, which may be thinned: lines without points and dashes."""
    for panel in chart.panels:
        for layer in panel.layers:
            if isinstance(layer, Line) and layer.form == "-":
                yield layer


def _thinned(chart: Chart) -> Chart:
    """Return a chart with curves of fewer points, of which all peaks remain."""
    panels = []
    for panel in chart.panels:
        layers = list(panel.layers)
        for k, layer in enumerate(layers):
            if isinstance(layer, Line) and layer.form == "-":
                x, y = thinned(np.asarray(layer.x), np.asarray(layer.y))
                layers[k] = replace(layer, x=x, y=y)
        panels.append(replace(panel, layers=layers))
    return replace(chart, panels=panels)


def _figure(chart: Chart, caption: str) -> ParsedTable:
    """Return a chart with its caption as JSON values, its arrays apart."""
    arrays: Arrays = {}
    content = {"caption": caption, **_fields(chart, arrays)}
    return content | {"arrays": [packed for _, packed in arrays.values()]}


def _json(value: object) -> str:
    plain = json.dumps(value, ensure_ascii=False, separators=(",", ":"))
    # no name ends the script, or begins a comment in it
    return plain.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def write(folder: Path, charts: Mapping[str, Captioned]) -> Path:
    """Write charts with captions, by name, as ``figures.json`` into a folder."""
    return files.write(folder / NAME, text(charts))


def of_folder(folder: Path) -> dict[str, Captioned]:
    """Return the charts with captions of a result in a folder, by name; empty if it has none."""
    for name in (PAGES[-1], NAME):
        charts = read(folder / name)
        if charts:
            return charts
    return {}


def read(path: Path) -> dict[str, Captioned]:
    """Return the charts with captions in a ``figures.json`` or a page, by name.

    Args:
        path: the file; no charts, if it is missing or a page without figures.

    Raises:
        CalibError: the file holds no figures, or is of a later version.
    """
    if not path.is_file():
        return {}
    content = path.read_text(encoding="utf-8")
    if path.suffix == ".html":
        _, _, content = content.partition(BEGIN)
        content, _, _ = content.partition("</script>")
        if not content:
            return {}
    try:
        table = json.loads(content)
        schema = table["schema"]
        if schema > SCHEMA:
            raise CalibError(f"{path} is of a later version (schema {schema}, here {SCHEMA}): update the toolkit")
        charts = {}
        for name, figure in table["figures"].items():
            arrays = list(map(_unpacked, figure["arrays"]))
            charts[name] = _chart(figure, arrays), figure["caption"]
        return charts
    except (ValueError, KeyError, TypeError) as error:
        raise CalibError(f"{path} holds no figures ({error!r}): make the result again") from error


def _fields(record: object, arrays: Arrays) -> ParsedTable:
    """Return the fields of a chart, panel, layer or cloud as JSON values; None is left out.

    Args:
        record: the chart, panel, layer or cloud.
        arrays: packed arrays of the figure by their content, to which those of the record are added.
    """
    content: ParsedTable = {}
    if type(record).__name__ in LAYERS:
        content["layer"] = type(record).__name__
    for field in fields(record):  # ty: ignore[invalid-argument-type]
        value = getattr(record, field.name)
        if value is not None:
            content[field.name] = _value(value, arrays, field.name)
    return content


def _value(value: FieldValue, arrays: Arrays, name: str) -> object:
    """Return a field's value as a JSON value.

    Args:
        value: the value.
        arrays: packed arrays of the figure by their content.
        name: name of the field.
    """
    if isinstance(value, Layer | Panel | Cloud):
        return _fields(value, arrays)
    if isinstance(value, Mapping):
        return {str(key): _value(item, arrays, str(key)) for key, item in value.items()}
    if isinstance(value, np.generic):
        return _value(value.item(), arrays, name)
    if isinstance(value, float) and not np.isfinite(value):
        return {"float": str(value)}
    if value is None or isinstance(value, str | float | int):
        return value
    if len(value) < SHORTEST_ARRAY or _of_records(value):
        return [_value(item, arrays, name) for item in value]
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        return [_value(item, arrays, name) for item in value]
    content = np.ascontiguousarray(array, dtype="<f4")
    key = content.tobytes()
    if key not in arrays:
        arrays[key] = (len(arrays), _packed(content, name))
    return {"array": arrays[key][0]}


def _packed(content: np.ndarray, name: str) -> ParsedTable:
    """Return an array as base64: long curves with 16 bits between their limits, all else as numbers of four bytes.

    Args:
        content: the array.
        name: name of its field.
    """
    if name == "y" and content.size >= SHORTEST_STEPS and np.isfinite(content).all():
        low, high = float(content.min()), float(content.max())
        step = (high - low) / STEPS or 1.0
        steps = np.round((content - low) / step).astype("<u2")
        return {"u2": base64.b64encode(steps.tobytes()).decode(), "low": low, "step": step}
    packed: ParsedTable = {"f4": base64.b64encode(content.tobytes()).decode()}
    if content.ndim > 1:
        packed["shape"] = list(content.shape)
    return packed


def _of_records(value: Sequence[object]) -> bool:
    """Return whether a sequence contains layers, panels or texts, not numbers."""
    return len(value) > 0 and isinstance(value[0], Layer | Panel | str)


def _chart(content: ParsedTable, arrays: Sequence[np.ndarray]) -> Chart:
    """Return the chart with the fields `content`, whose arrays are numbered."""
    record = _record(Chart, content, arrays)
    record["panels"] = [_panel(panel, arrays) for panel in content["panels"]]
    record["points"] = {name: _read(values, arrays) for name, values in content.get("points", {}).items()}
    if "cloud" in content:
        record["cloud"] = Cloud(**_record(Cloud, content["cloud"], arrays))
    return Chart(**record)


def _panel(content: ParsedTable, arrays: Sequence[np.ndarray]) -> Panel:
    layers = []
    for layer in content["layers"]:
        kind = LAYERS[layer["layer"]]
        layers.append(kind(**_record(kind, layer, arrays)))
    return Panel(**_record(Panel, content, arrays) | {"layers": layers})  # ty: ignore[invalid-argument-type]


def _record(kind: type, content: ParsedTable, arrays: Sequence[np.ndarray]) -> ParsedTable:
    """Return the values of a class's fields; fields of later versions are left out."""
    record = {}
    for field in fields(kind):  # ty: ignore[invalid-argument-type]
        if field.name in content:
            record[field.name] = _read(content[field.name], arrays)
    return record


def _read(value: FieldValue, arrays: Sequence[np.ndarray]) -> FieldValue:
    """Return a JSON value as the value of a field."""
    if isinstance(value, Mapping) and "array" in value:
        return arrays[value["array"]]
    if isinstance(value, Mapping) and "float" in value:
        return float(value["float"])
    if isinstance(value, list):
        return tuple(_read(item, arrays) for item in value)
    return value


def _unpacked(packed: ParsedTable) -> np.ndarray:
    """Return a packed array."""
    if "u2" in packed:
        steps = np.frombuffer(base64.b64decode(packed["u2"]), dtype="<u2")
        return packed["low"] + packed["step"] * steps
    array = np.frombuffer(base64.b64decode(packed["f4"]), dtype="<f4").astype(float)
    return array.reshape(packed.get("shape", -1))
