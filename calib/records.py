"""Records: results that are stored as JSON or CSV according to their type, and read back by the same type.

A record is a frozen dataclass (or named tuple) of numbers, texts, arrays and other records. `plain` converts it to
values that JSON has, with the field names as keys. `read_record` converts these values to an equal record. To store a
further number, a field is added to the class; nothing else need be changed. A `stored` property is a value that a
record computes and that is written for readers of the file.

JSON has no NaN. In arrays annotated `Array` and numbers annotated `Number`, NaN is written as null. In any other field
a number that is not finite is an error, raised by `calib.files.write_json`, which writes all records. Arrays of records
are read-only (`Frozen`).
"""

from __future__ import annotations

import csv
import json
import math
import types
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, TypeVar, get_args, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.errors import CalibError, UsageError, refused_as
from calib.units import is_number

if TYPE_CHECKING:
    from _typeshed import DataclassInstance
    from pydantic import GetCoreSchemaHandler, TypeAdapter
    from pydantic_core import CoreSchema

T = TypeVar("T")
Floats: TypeAlias = NDArray[np.float64]
"""Numbers that the Python API returns."""
FieldValues: TypeAlias = dict[str, Any]
"""Values of fields of a record by name, to be passed on as keywords."""
# Characters with which a spreadsheet's formula begins, and the apostrophe that `shielded` adds.
_FORMULA = ("=", "+", "-", "@", "\t", "\r", "'")


def shielded(text: str) -> str:
    """Return a text as a table cell: with an apostrophe before it if a spreadsheet would read it as a formula.

    Numbers are not changed.
    """
    return text if text[:1] not in _FORMULA or is_number(text) else f"'{text}"


def field_values(record: DataclassInstance) -> FieldValues:
    """Return the values of a dataclass's fields by name, to create a record of a class with further fields."""
    return {field.name: getattr(record, field.name) for field in fields(record) if field.init}


def plain_text(cell: str) -> str:
    """Return the original text of a cell written by `shielded`."""
    return cell[1:] if cell[:1] == "'" and cell[1:2] in _FORMULA else cell


def read_rows(kind: type[T], path: Path) -> tuple[T, ...]:
    """Return the rows of a CSV file as named tuples `kind`, whose fields are the columns.

    Columns of fields with a default may be missing.

    Raises:
        ValueError: a column is missing, or a cell is not a number where the field is one.
        OSError: the file is missing.
    """
    with path.open(newline="", encoding="utf-8") as file:
        rows = csv.DictReader(file)
        # Without units.
        columns = [name.partition(" [")[0] for name in rows.fieldnames or ()]
        rows.fieldnames = columns
        optional_columns: Mapping[str, object] = kind._field_defaults  # ty: ignore[missing-attribute]  # of named tuples
        missing = optional_columns.keys() - set(columns)
        hints = {name: hint for name, hint in get_type_hints(kind).items() if name not in missing}
        result = []
        for row in rows:
            cells = {name: _cell(hint, row, name, str(path)) for name, hint in hints.items()}
            result.append(kind(**cells))
        return tuple(result)


def _cell(hint: type, row: Mapping[str, str], name: str, where: str) -> Any:
    text = row.get(name)
    if text is None:
        raise ValueError(f"{where}: column {name} is missing")
    kinds = [kind for kind in get_args(hint) or (hint,) if kind is not types.NoneType]
    allows_none = len(get_args(hint)) > len(kinds)
    if not text and allows_none and kinds[0] is not str:
        return None
    try:
        return kinds[0](plain_text(text))
    except ValueError as error:
        raise ValueError(f"{where}: {name}: {error}") from error


def read_json(
    path: Path, advice: str = "make it again", kind: Any = dict, current: Callable[[Any], object] | None = None
) -> Any:
    """Return the content of a JSON file of this toolkit as a value of type `kind`, converted by `read_record`.

    Args:
        path: the file.
        advice: what to do if the file cannot be read, for the message.
        kind: type of the result.
        current: function that converts the content of a file of an earlier version to the present keys; None for no
            conversion.

    Raises:
        UsageError: the file is missing, damaged or has other content; the message contains `advice`.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if current is not None:
            content = current(content)
        return read_record(kind, content)
    except (OSError, ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
        raise UsageError(f"{path} cannot be read ({error}); {advice}") from error


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text file, empty if the file is missing; invalid characters are replaced."""
    if not path.exists():
        return []
    return path.read_text(encoding="utf-8", errors="replace").splitlines()


@dataclass(frozen=True)
class _Null:
    """Pydantic type of a number, or an array of numbers, in which null in JSON is read as `value`."""

    value: float = math.nan
    array: bool = False

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        from pydantic_core import core_schema

        if self.array:
            return core_schema.no_info_plain_validator_function(self._filled)
        return core_schema.no_info_before_validator_function(lambda x: self.value if x is None else x, handler(source))

    def _filled(self, content: object) -> np.ndarray:
        values = np.array(content, dtype=float)
        return frozen(np.where(np.isnan(values), self.value, values))


# types of values that are plain JSON as they are; numbers may have to become null
SCALARS = frozenset((str, int, bool, type(None)))
Number = Annotated[float, _Null()]
"""A number of a record that may be NaN or infinite; null in JSON, and NaN when read back."""
Array = Annotated[np.ndarray, _Null(array=True)]
"""An array of numbers of a record, any of which may be NaN; nested lists in JSON, read-only when read back."""
Unbounded = Annotated[np.ndarray, _Null(math.inf, array=True)]
"""An array of limits; infinite for no limit, null in JSON."""


class stored(property):
    """A property that `plain` writes in addition to the fields; when read back, it is computed again."""


def plain(value: object, null: bool = False) -> Any:
    """Return a record, or any nesting of records, arrays, mappings and lists, as plain JSON values.

    Args:
        value: the record or other value.
        null: True writes a number that is not finite as null; in arrays this is always done.
    """
    # most values of long lists
    if type(value) in SCALARS:
        return value
    if isinstance(value, float):
        return None if null and not math.isfinite(value) else float(value)
    if is_dataclass(value) and not isinstance(value, type):
        return {name: plain(getattr(value, name), nullable) for name, nullable in _keys(type(value)).items()}
    if isinstance(value, Mapping):
        return {str(key): plain(item, null) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        not_finite = ~np.isfinite(value) if value.dtype.kind == "f" else False
        return np.ma.masked_array(value, not_finite).tolist()
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item, null) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    return str(value) if isinstance(value, Path) else value


@cache
def _keys(kind: type) -> dict[str, bool]:
    """Return, for each field and stored property of a record type, whether non-finite numbers are written as null."""
    hints = get_type_hints(kind, include_extras=True)
    keys = {field.name: _nullable(hints[field.name]) for field in fields(kind)}  # ty: ignore[invalid-argument-type]
    for base in kind.__mro__:
        for name, item in base.__dict__.items():
            if isinstance(item, stored):
                keys[name] = True
    return keys


def _nullable(hint: object) -> bool:
    metadata = getattr(hint, "__metadata__", ())
    if any(isinstance(item, _Null) for item in metadata):
        return True
    return any(_nullable(inner) for inner in get_args(hint))


def read_record(kind: type[T], content: object, where: str = "") -> T:
    """Return plain JSON `content` as a value of the record type `kind`.

    Keys that are not fields of the record are ignored, so that files of newer versions can be read. A field with a
    default may be missing.

    Args:
        kind: the record type.
        content: values as read from JSON.
        where: name of `content` for messages.

    Raises:
        ValueError: a value is missing or invalid; the message gives its location.
    """
    from pydantic import ValidationError

    try:
        return _adapter(kind).validate_json(json.dumps(plain(content)), strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        location = where
        for part in first["loc"]:
            location += f"[{part}]" if isinstance(part, int) else f".{part}"
        location = location.lstrip(".") or "the content"
        raise ValueError(f"{location}: {first['msg']}, found {first['input']!r:.60}") from None


@cache
def _adapter(kind: type[T]) -> TypeAdapter[T]:
    from pydantic import TypeAdapter

    return TypeAdapter(kind)


def interpolated(times: np.ndarray, t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the values of a time series, linearly interpolated at other times: (m, k).

    Args:
        times: (m,) times of the result [s].
        t: (N,) times of the series [s], rising.
        values: (N, k) the series.
    """
    return np.column_stack([np.interp(times, t, column) for column in values.T])


def evenly(count: int, max_rows: int) -> np.ndarray:
    """Return row numbers (m,) out of `count` rows, spread evenly from first to last: all, or `max_rows` of them."""
    return np.unique(np.linspace(0, count - 1, min(count, max_rows)).astype(int))


def frozen(values: ArrayLike, dtype: type = float) -> np.ndarray:
    """Return a read-only, C-contiguous copy of `values`."""
    return read_only(np.array(values, dtype=dtype, order="C"))


def read_only(values: np.ndarray) -> np.ndarray:
    """Return the array `values` itself, made read-only; no other code may use the array for writing."""
    values.flags.writeable = False
    return values


def as_subclass(record: Any, kind: type[T]) -> T:
    """Return a record as an instance of the subclass `kind` of its class; the subclass adds methods but no fields."""
    if not issubclass(kind, type(record)):
        raise TypeError(f"{kind.__name__} is no subclass of {type(record).__name__}")
    return kind(**field_values(record))


class Frozen:
    """Base class of dataclasses whose ``np.ndarray`` fields are stored as read-only copies (floats or booleans)."""

    def __post_init__(self) -> None:
        for field in fields(self):  # ty: ignore[invalid-argument-type]
            if field.type in (np.ndarray, "np.ndarray"):
                value = np.asarray(getattr(self, field.name))
                kind = bool if value.dtype == bool else float
                object.__setattr__(self, field.name, frozen(value, kind))


def as_numbers(values: ArrayLike, name: str) -> np.ndarray:
    """Return `values` as a float array.

    Raises:
        UsageError: values that are no numbers, or rows of unequal lengths; the message begins with `name`.
    """
    with refused_as(UsageError, (TypeError, ValueError), f"{name}: expected numbers: {{}}"):
        return np.asarray(values, dtype=float)


def shaped(values: ArrayLike, shape: tuple[int | None, ...], name: str) -> np.ndarray:
    """Return `values` as a finite float array of the given shape; None in `shape` allows any length.

    Raises:
        CalibError: another shape, or a value that is not finite; the message gives both shapes, or the index of the
            value.
        UsageError: values that are no numbers.
    """
    array = as_numbers(values, name)
    fits = array.ndim == len(shape)
    for length, expected_length in zip(array.shape, shape):
        fits = fits and expected_length in (None, length)
    if not fits:
        lengths = ["any" if length is None else str(length) for length in shape]
        raise CalibError(f"{name}: expected an array of shape ({', '.join(lengths)}), found {array.shape}")
    if not np.isfinite(array).all():
        index = tuple(np.argwhere(~np.isfinite(array))[0].tolist())
        raise CalibError(f"{name}: value at index {index} is not finite ({array[index]})")
    return array
