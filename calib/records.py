"""JSON and tables as frozen dataclasses: checked once, where they are read, and attributes from there on."""

from __future__ import annotations

import csv
import json
import types
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from numbers import Real
from pathlib import Path
from typing import Any, SupportsIndex, TypeVar, Union, get_args, get_origin, get_type_hints

from calib.errors import UsageError

T = TypeVar("T")
_FORMULA = ("=", "+", "-", "@", "\t", "\r", "'")  # what a spreadsheet's formula begins with, and our own mark


def shielded(text: str) -> str:
    """Return a text as a cell of a table holds it: with an apostrophe where a spreadsheet would take it for a formula.

    Numbers stay as they are.
    """
    if text[:1] not in _FORMULA:
        return text
    try:
        float(text)
    except ValueError:
        return f"'{text}"
    return text


def plain_text(cell: str) -> str:
    """Return the text that `shielded` made this cell of."""
    return cell[1:] if cell[:1] == "'" and cell[1:2] in _FORMULA else cell


def read_rows(kind: type[T], path: Path) -> tuple[T, ...]:
    """Return the rows of a CSV file of ours as values of the named tuple `kind`, whose fields are its columns.

    Raises:
        ValueError: where a column is missing or a cell is no number where one belongs.
        OSError: where the file is missing.
    """
    with path.open(newline="", encoding="utf-8") as file:
        return typed_rows(kind, list(csv.DictReader(file)), str(path))


def typed_rows(kind: type[T], rows: Iterable[Mapping[str, str]], place: str) -> tuple[T, ...]:
    """Return rows of text by column as values of the named tuple `kind`; `place` is for messages, see `read_rows`."""
    hints = _hints(kind)
    return tuple(kind(**{name: _cell(hint, row, name, place) for name, hint in hints.items()}) for row in rows)


def _cell(hint: Any, row: Mapping[str, str], name: str, place: str) -> Any:
    text = row.get(name)
    wanted = [one for one in get_args(hint) or (hint,) if one is not types.NoneType]
    if text is None:
        raise ValueError(f"{place}: column {name} is missing")
    if not text and wanted[0] is not str and len(get_args(hint)) > len(wanted):
        return None
    try:
        return wanted[0](plain_text(text))
    except ValueError as error:
        raise ValueError(f"{place}: {name}: {error}") from error


def read_json(path: Path, advice: str = "make it again", kind: Any = dict) -> Any:
    """Return what a JSON file of ours holds, as a value of `kind` (see `read_record`).

    Raises:
        UsageError: where the file is missing, damaged or of other content, with `advice`.
    """
    try:
        return read_record(kind, json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise UsageError(f"{path} cannot be read ({error}); {advice}") from error


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text that we left, none where there is none; damaged letters are replaced."""
    return path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []


def read_record(kind: type[T], content: Any, place: str = "") -> T:
    """Return plain JSON `content` as a value of the dataclass `kind`, fields of fields included.

    Keys that `kind` does not name are left out, so that a newer version may write more; a field with a default may be
    missing. Annotations may be dataclasses, named tuples (arrays in JSON), ``tuple[X, ...]``, ``Mapping[str, X]``,
    ``X | None`` and plain types.

    Args:
        place: what `content` is, for messages.

    Raises:
        ValueError: where something else stands there, or nothing.
    """
    return _value(kind, content, place)


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _value(kind: Any, content: Any, place: str) -> Any:
    if kind is Any:
        return content
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        wanted = [one for one in inner if one is not type(None)]
        return None if content is None else _value(wanted[0], content, place)
    if origin is tuple and isinstance(content, list | tuple):
        kinds = [inner[0]] * len(content) if inner[-1] is Ellipsis else inner
        if len(kinds) != len(content):
            raise ValueError(f"{place or 'the list'}: {len(content)} values where {len(kinds)} belong")
        return tuple(_value(one, each, f"{place}[{k}]") for k, (one, each) in enumerate(zip(kinds, content)))
    if origin is not None and issubclass(origin, Mapping) and isinstance(content, Mapping):
        return {name: _value(inner[1], each, f"{place}.{name}".lstrip(".")) for name, each in content.items()}
    if hasattr(kind, "_fields") and isinstance(content, list | tuple):  # a NamedTuple: an array in JSON
        return kind(*_value(tuple[tuple(_hints(kind).values())], content, place))
    if is_dataclass(kind) and isinstance(content, Mapping):
        return _record(kind, content, place)
    if kind is float and isinstance(content, Real) and not isinstance(content, bool):
        return float(content)
    if kind is int and isinstance(content, SupportsIndex) and not isinstance(content, bool):
        return int(content)
    if not isinstance(kind, type) or not isinstance(content, kind):
        raise ValueError(f"{place or 'the content'}: {content!r:.60} where {getattr(kind, '__name__', kind)} belongs")
    return content


def _record(kind: Any, content: Mapping[str, Any], place: str) -> Any:
    hints, given = _hints(kind), {}
    for field in fields(kind):
        where = f"{place}.{field.name}".lstrip(".")
        if field.name in content:
            given[field.name] = _value(hints[field.name], content[field.name], where)
        elif field.default is MISSING and field.default_factory is MISSING:
            raise ValueError(f"{where} is missing")
    return kind(**given)
