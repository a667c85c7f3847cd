"""Figures as text (JSON): what ``figures.json`` holds beside a result, and what its page draws.

A chart is a dictionary of its fields, a layer has the name of its class as ``layer``. Arrays are little-endian numbers
of four bytes in base64, ``{"f4": "AACAPw=="}``, a quarter of what their digits would take.
"""

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from calib import files
from calib.config_types import ParsedTable
from calib.errors import CalibError
from calib.folders import FIGURES, PAGES
from calib.procedure.report.figures.charts import Captioned, Chart, Cloud, Layer, Panel

NAME = FIGURES
# what stands before the figures in a page
BEGIN = '<script type="application/json" id="figures">'
SCHEMA = 1
# Numbers from which on a sequence is written as an array.
SHORTEST_ARRAY = 4
FieldValue: TypeAlias = Any  # of a chart, or its JSON value
LAYERS: Mapping[str, type] = {kind.__name__: kind for kind in Layer.__args__}


def text(charts: Mapping[str, Captioned]) -> str:
    """Return charts with captions, by name, as JSON; it may stand in a script of a page.

    Args:
        charts: the charts.
    """
    figures = {name: {"caption": caption, **_fields(chart)} for name, (chart, caption) in charts.items()}
    plain = json.dumps({"schema": SCHEMA, "figures": figures}, ensure_ascii=False, separators=(",", ":"))
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
        return {name: (_chart(figure), figure["caption"]) for name, figure in table["figures"].items()}
    except (ValueError, KeyError, TypeError) as error:
        raise CalibError(f"{path} holds no figures ({error!r}): make the result again") from error


def _fields(record: object) -> dict[str, object]:
    """Return the fields of a chart, panel, layer or cloud that are not their defaults' emptiness, as JSON values."""
    content: dict[str, object] = {}
    if type(record).__name__ in LAYERS:
        content["layer"] = type(record).__name__
    for field in fields(record):  # type: ignore[arg-type]
        value = getattr(record, field.name)
        if value is not None:
            content[field.name] = _value(value)
    return content


def _value(value: FieldValue) -> object:
    """Return a field's value as a JSON value."""
    if isinstance(value, Layer | Panel | Cloud):
        return _fields(value)
    if isinstance(value, Mapping):
        return {str(key): _value(item) for key, item in value.items()}
    if isinstance(value, np.generic):
        return _value(value.item())
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, str | int):
        return value
    if isinstance(value, Sequence) and len(value) < SHORTEST_ARRAY:
        return [_value(item) for item in value]
    array = np.asarray(value) if not _of_records(value) else None
    if array is None or array.dtype.kind not in "fiub":
        return [_value(item) for item in value]
    content = np.ascontiguousarray(array, dtype="<f4")
    packed: dict[str, object] = {"f4": base64.b64encode(content.tobytes()).decode()}
    if content.ndim > 1:
        packed["shape"] = list(content.shape)
    return packed


def _of_records(value: Sequence[object]) -> bool:
    return len(value) > 0 and isinstance(value[0], Layer | Panel | str)


def _chart(content: ParsedTable) -> Chart:
    """Return the chart with the fields `content`."""
    fields_of_chart = _record(Chart, content)
    fields_of_chart["panels"] = [_panel(panel) for panel in content["panels"]]
    fields_of_chart["points"] = {name: _read(values) for name, values in content.get("points", {}).items()}
    if "cloud" in content:
        fields_of_chart["cloud"] = Cloud(**_record(Cloud, content["cloud"]))
    return Chart(**fields_of_chart)


def _panel(content: ParsedTable) -> Panel:
    layers = []
    for layer in content["layers"]:
        kind = LAYERS[layer["layer"]]
        layers.append(kind(**_record(kind, layer)))
    return Panel(**_record(Panel, content) | {"layers": layers})


def _record(kind: type, content: ParsedTable) -> ParsedTable:
    """Return the values of a class's fields; fields of later versions are left out."""
    record = {}
    for field in fields(kind):
        if field.name in content:
            record[field.name] = _read(content[field.name])
    return record


def _read(value: FieldValue) -> FieldValue:
    """Return a JSON value as the value of a field; packed numbers as an array."""
    if isinstance(value, Mapping) and "f4" in value:
        array = np.frombuffer(base64.b64decode(value["f4"]), dtype="<f4").astype(float)
        return array.reshape(value.get("shape", -1))
    if isinstance(value, list) and value and not isinstance(value[0], Mapping):
        return tuple(np.nan if item is None else item for item in value)
    return value
