"""Option files: TOML read within limits, held against frozen dataclasses, complained about in one form.

A table of a file is a dataclass under `strict`; its fields are the keys, and their annotated types (below) say what a
key may hold, in which unit, and which words a complaint uses. pydantic does the checking. It is imported where a file
is read and not before: 0.1 CPU seconds that ``calib --help`` and a fit without options need not wait for. Complaints
read ``file: key: what was expected, what was found, did you mean …``. `schema` gives the same as a JSON schema.
"""

from __future__ import annotations

import ast
import datetime
import math
import operator
import re
import reprlib
import tomllib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

from calib.errors import CalibError, UsageError, suggestion
from calib.units import QUANTITIES

T = TypeVar("T")
LARGEST = 8_000_000  # bytes of a file, and below: levels of tables in tables, signs of an expression (our choices)
DEEPEST = 32
LONGEST = 200
_TAG = "\0"  # begins the names of alternatives, which are no part of a place
UNKNOWN = "unexpected_keyword_argument"  # as pydantic calls it
_BARE = re.compile(r"[A-Za-z0-9_-]+")
_BINARY = {ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv}


class _Short(reprlib.Repr):
    """Shows a value in at most about a line; dates as TOML writes them."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlist = self.maxdict = 12
        self.maxstring = self.maxother = 80

    def repr_date(self, value: datetime.date, level: int) -> str:
        return value.isoformat()

    repr_datetime = repr_time = repr_date


_SHORT = _Short()

# ---- reading --------------------------------------------------------------------------------------------------------


def read_toml(path: str | Path, error: type[CalibError] = UsageError) -> dict[str, Any]:
    """Return the tables of the TOML file at `path`.

    Raises:
        CalibError: `error`, for a file that is missing, too large, no TOML, nested too deeply, or with a whole number
            of more than 64 bits.
    """
    try:
        with open(path, "rb") as file:
            data = file.read(LARGEST + 1)
        if len(data) > LARGEST:
            raise error(f"{path}: is larger than {LARGEST / 1e6:g} MB: is it the right file?")
        found = tomllib.loads(data.decode("utf-8-sig"))
    except OSError as wrong:
        raise error(f"{path}: cannot be read: {wrong.strerror or wrong}") from wrong
    except RecursionError:
        raise error(f"{path}: is nested too deeply: more than {DEEPEST} levels") from None
    except ValueError as wrong:  # of tomllib, of the decoder, of a number with thousands of digits, of a name with NUL
        words = "a whole number of thousands of digits" if "digits" in str(wrong) else wrong
        raise error(f"{path}: is no TOML: {words}") from wrong
    _check_size(found, str(path), error)
    return found


def _check_size(found: Any, place: str, error: type[CalibError]) -> None:
    """Refuse what nests too deeply, and whole numbers that TOML does not have; without recursion."""
    ahead: list[tuple[tuple[Any, ...], Any]] = [((), found)]
    while ahead:
        loc, value = ahead.pop()
        if len(loc) > DEEPEST:
            raise error(f"{place}: {located(loc[:3])}: is nested too deeply: more than {DEEPEST} levels")
        if isinstance(value, int) and not -(2**63) <= value < 2**63:
            raise error(f"{place}: {located(loc)}: a whole number of more than 64 bits: {shown(value)}")
        inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        ahead += [((*loc, key), item) for key, item in inner]


def parse(kind: type[T], found: Any, place: str, error: type[CalibError] = UsageError) -> T:
    """Return a parsed table as a `kind`.

    Args:
        kind: a dataclass under `strict`.
        found: the table, lists and tables in it as tomllib makes them.
        place: names it in complaints.
        error: the class of complaints.

    Raises:
        CalibError: `error`, for the first key that is unknown, missing, or holds what it cannot hold.
    """
    from pydantic import ValidationError

    try:
        return _adapter(kind).validate_python(found)
    except ValidationError as wrong:
        raise error(_complaint(wrong.errors(include_url=False), kind, place)) from None


def strict(kind: type[T]) -> type[T]:
    """Let a dataclass stand for a table of a file: keys that are none of its fields are refused."""
    kind.__pydantic_config__ = {"extra": "forbid"}  # type: ignore[attr-defined]
    return kind


@cache
def _adapter(kind: Any) -> Any:
    from pydantic import TypeAdapter

    return TypeAdapter(kind)


def schema(kind: type, title: str) -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of the files that `parse` reads as a `kind`."""
    from pydantic.json_schema import GenerateJsonSchema

    found = _adapter(kind).json_schema()
    return {"$schema": GenerateJsonSchema.schema_dialect, **_for_toml(found), "title": title}


def _for_toml(found: Any) -> Any:
    """Return a schema without nulls, which TOML does not have, hidden fields, and titles that repeat the key."""
    if isinstance(found, list):
        return [_for_toml(item) for item in found]
    if not isinstance(found, dict):
        return found
    result = {}
    for key, value in found.items():
        if key in ("properties", "$defs"):
            result[key] = {name: _for_toml(item) for name, item in value.items() if item.get("not") != {}}
        elif key == "default" and value not in (None, [None]):  # None of a list: infinity, which JSON does not have
            result[key] = value
        elif key not in ("title", "default"):
            result[key] = _for_toml(value)
    choices = [item for item in result.pop("anyOf", ()) if item != {"type": "null"}]
    return {**choices[0], **result} if len(choices) == 1 else {**({"anyOf": choices} if choices else {}), **result}


def inherited(table: Mapping[str, Any], kind: type) -> dict[str, Any]:
    """Return a file's table whose ``[files.NAME]`` tables hold what is said for every file, where they say nothing.

    Args:
        table: the file.
        kind: the dataclass of one file; its fields are the keys that are handed down, tables key by key.
    """
    files = table.get("files")
    if not isinstance(files, Mapping):
        return dict(table)
    every = {key: table[key] for key in _keys(kind) if key in table}

    def filled(own: Any) -> Any:
        if not isinstance(own, Mapping):
            return own
        both = [key for key in own if isinstance(own[key], Mapping) and isinstance(every.get(key), Mapping)]
        return {**every, **own, **{key: {**every[key], **own[key]} for key in both}}

    return {**table, "files": {name: filled(own) for name, own in files.items()}}


def own_table(files: Mapping[str, T], path: str | Path) -> T | None:
    """Return what `files` holds under the name of the file at `path`, or the end of its path; None for nothing."""
    parts = Path(path).parts
    for name, own in files.items():
        wanted = Path(name).parts
        if parts[-len(wanted) :] == wanted:
            return own
    return None


# ---- complaints -----------------------------------------------------------------------------------------------------


def check_keys(
    found: Mapping[str, Any], keys: Collection[str], place: str, error: type[CalibError] = UsageError
) -> None:
    """Refuse a key that is none of `keys`, with the most similar one that is."""
    for key in found:
        if key not in keys:
            raise error(f"{place}: {_no_key(key, keys)}")


def shown(value: Any) -> str:
    """Return a value as a complaint shows it, at most a line long."""
    try:
        return _SHORT.repr(value)
    except ValueError:
        return "a whole number of thousands of digits"


def located(loc: Sequence[Any]) -> str:
    """Return a place in a file as TOML names it: ``sigma.position``, ``files."a.csv".kind``, ``[[term]] number 2``."""
    result = ""
    for k, part in enumerate(loc):
        if isinstance(part, int):
            result = f"[[{result}]] number {part + 1}" if k + 1 < len(loc) or k == 1 else result
            continue
        name = part if _BARE.fullmatch(part) else f'"{part}"'
        result = f"{result}{', ' if result.endswith(tuple('0123456789')) and k > 1 else '.' if result else ''}{name}"
    return result


def _no_key(key: str, keys: Collection[str]) -> str:
    there = f"the keys are {', '.join(sorted(keys))}" if keys else "there are none"
    return f"there is no key '{key}'{suggestion(key, keys)}; {there}"


def _complaint(errors: list[Any], kind: type, place: str) -> str:
    """Return the first of pydantic's errors in our form; a key that is not known explains one that is missing."""
    first = next((one for one in errors if one["type"] == UNKNOWN), errors[0])
    loc = tuple(part for part in first["loc"] if not (isinstance(part, str) and part.startswith(_TAG)))
    name, found, context = first["type"], first["input"], first.get("ctx", {})
    table = _type_at(kind, loc[:-1]) if name in (UNKNOWN, "missing") else None
    at = loc if table is None else loc[:-1]
    while (
        at and isinstance(at[-1], int) and name not in (UNKNOWN, "missing", "dataclass_type")
    ):  # one of several values
        at = at[:-1]
    where = f"{place}: {located(at)}" if at else place
    if name == UNKNOWN and len(loc) == 3 and loc[0] == "files" and isinstance(found, dict) and "." not in loc[1]:
        return f'{where}: the dot needs quotes: [files."{loc[1]}.{loc[2]}"]'
    if name == UNKNOWN:
        return f"{where}: {_no_key(str(loc[-1]), _keys(table))}"
    if name == "missing":
        return f"{where}: there is no '{loc[-1]}'{_needed(table)}"
    if name == "value_error":
        return f"{where}: {context['error']}"
    if name == "one_of":
        near = suggestion(found, context["allowed"]) if isinstance(found, str) else ""
        words = f"one of {', '.join(context['allowed'])}{near}"
    elif name == "expected":
        words = first["msg"]
    else:
        words = {"tuple_type": f"a list of tables, [[{loc[-1]}]]", "too_short": "at least one number"}.get(
            name, "a table"
        )
    return f"{where}: expected {words}, found {shown(found)}"


def _keys(kind: Any) -> list[str]:
    """Return the keys of the table that a dataclass stands for."""
    hints = get_type_hints(kind, include_extras=True)
    return [key for key, hint in hints.items() if Hidden() not in getattr(hint, "__metadata__", ())]


def _needed(kind: Any) -> str:
    from dataclasses import MISSING

    needed = [f.name for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING]
    return f"; needed are {', '.join(needed)}" if len(needed) > 1 else ""


def _type_at(kind: Any, loc: Sequence[Any]) -> Any:
    """Return the dataclass that stands for the table at a place."""
    for part in loc:
        kind = get_type_hints(kind)[part] if is_dataclass(kind) else get_args(kind)[-1 if isinstance(part, str) else 0]
        while get_origin(kind) is not None and type(None) in get_args(kind):
            kind = get_args(kind)[0]
    return kind


# ---- what a key may hold --------------------------------------------------------------------------------------------


def number(value: Any, place: str, quantity: str = "", error: type[CalibError] = UsageError) -> float:
    """Return a number in SI, from a number of TOML or a text: an expression with pi, and a unit behind it.

    Args:
        value: ``0.4``, ``"-pi/2"``, ``"90 deg"``; infinite ones count.
        place: names it in the complaint.
        quantity: a key of `calib.units.QUANTITIES`; "" for a plain number.

    Raises:
        CalibError: `error`, where it is no number, or has a unit of something else.
    """
    try:
        return _number(value, quantity)
    except ValueError as wrong:
        raise error(f"{place}: {wrong}") from None


def numbers(
    value: Any, count: int, place: str, quantity: str = "", error: type[CalibError] = UsageError
) -> tuple[float, ...]:
    """Return a list of `count` numbers in SI; see `number`."""
    if not isinstance(value, (list, tuple)) or len(value) != count:
        raise error(f"{place}: expected a list of {count} numbers, found {shown(value)}")
    return tuple(number(item, place, quantity, error) for item in value)


def _number(value: Any, quantity: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError(f"{shown(value)} is not a number")
    try:
        result = _expression(value, quantity) if isinstance(value, str) else float(value)
    except (SyntaxError, ValueError, ZeroDivisionError, OverflowError, RecursionError, MemoryError):
        units = ", ".join(unit for unit in QUANTITIES.get(quantity, {}) if unit.isascii())
        hint = f" (here an optional unit may follow: {units})" if units else ""
        raise ValueError(f"cannot read {shown(value)} as a number{hint}; try 0.4, 'pi/2' or '90 deg'") from None
    if math.isnan(result):
        raise ValueError(f"{shown(value)} is not a number")
    return result


def _expression(text: str, quantity: str) -> float:
    if len(text) > LONGEST or "_" in text:  # Python would read 0_5 as 5
        raise ValueError(text)
    text, factor = text.strip(), 1.0
    for unit, size in sorted(QUANTITIES.get(quantity, {}).items(), key=lambda item: -len(item[0])):
        if text.endswith(unit):
            text, factor = text.removesuffix(unit).strip(), size
            break
    return _evaluated(ast.parse(text, mode="eval").body) * factor


def _evaluated(node: ast.expr) -> float:
    """Evaluate numbers, pi, signs and the four operations; anything else is a ValueError."""
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            return float(value)
        case ast.Name(id="pi"):
            return math.pi
        case ast.Name(id="inf"):
            return math.inf
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -_evaluated(operand)
        case ast.UnaryOp(op=ast.UAdd(), operand=operand):
            return _evaluated(operand)
        case ast.BinOp(left=left, op=sign, right=right) if type(sign) in _BINARY:
            return _BINARY[type(sign)](_evaluated(left), _evaluated(right))
    raise ValueError(ast.dump(node))


@dataclass(frozen=True)
class Real:
    """A finite number, made a float.

    Attributes:
        above, least, most: what it has to be above, and its least and largest values; beyond `most`, another unit is
            suspected.
        unit: of `most`, for the complaint.
        quantity: read texts with units of it, too, see `number`; "1" for texts without unit.
        infinite: whether infinity counts.
        words: what was expected; by default said from the bounds.
    """

    above: float | None = None
    least: float | None = None
    most: float | None = None
    unit: str = ""
    quantity: str = ""
    infinite: bool = False
    words: str = ""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core import core_schema as core

        words = self.words or ("a number" if self.above is None else f"a number above {self.above:g}")
        if not self.words and self.least is not None:
            words = f"{self.least:g} or more"
        inner = core.float_schema(strict=True, gt=self.above, ge=self.least, allow_inf_nan=self.infinite)
        result = core.custom_error_schema(inner, "expected", custom_error_message=words)
        if self.most is not None:
            hint = " (are these mm, or degrees?)" if self.unit in ("m", "rad") else ""
            words = f"{self.unit or 'a number'}, at most {self.most:g}{hint}"
            bound = core.custom_error_schema(core.float_schema(le=self.most), "expected", custom_error_message=words)
            result = core.chain_schema([result, bound])
        return Checked(self._read).around(result) if self.quantity else result

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> Any:
        bounds = {"exclusiveMinimum": self.above, "minimum": self.least, "maximum": self.most}
        found = {"type": "number", **{key: value for key, value in bounds.items() if value is not None}}
        return {"anyOf": [found, {"type": "string"}]} if self.quantity else found

    def _read(self, value: Any) -> Any:
        return _number(value, self.quantity) if isinstance(value, str) else value


@dataclass(frozen=True)
class Whole:
    """A whole number from `least` to `most`; `of` says in a complaint what it counts."""

    least: int = 0
    most: int | None = None
    of: str = ""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core import core_schema as core

        span = f", {self.least} or more" if self.most is None else f" from {self.least} to {self.most}"
        inner = core.int_schema(strict=True, ge=self.least, le=self.most)
        return core.custom_error_schema(inner, "expected", custom_error_message=f"a whole number{self.of}{span}")


@dataclass(frozen=True)
class Index:
    """A whole number counted from 1 in the file, from 0 here."""

    most: int = 99

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core import core_schema as core

        counted = Whole(1, self.most).__get_pydantic_core_schema__(int, handler)
        return core.no_info_after_validator_function(lambda number: number - 1, counted)


@dataclass(frozen=True)
class OneOf:
    """A text that is one of a few."""

    allowed: tuple[str, ...]

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core import core_schema as core

        inner, context = core.literal_schema(list(self.allowed)), {"allowed": list(self.allowed)}
        return core.custom_error_schema(inner, "one_of", custom_error_message="", custom_error_context=context)


@dataclass(frozen=True)
class Expect:
    """What is expected, for complaints; numbers, texts and flags in it are not converted into each other."""

    words: str

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core import core_schema as core

        inner = _unconverted(handler(source))
        return core.custom_error_schema(inner, "expected", custom_error_message=self.words)


def _unconverted(one: Any) -> Any:
    """Return pydantic's schema of a number, text, flag or list of them without conversions, nan and infinity."""
    if one["type"] in ("int", "float", "str", "bool"):
        one["strict"] = True
    if one["type"] == "float":
        one.setdefault("allow_inf_nan", False)
    if one["type"] == "tuple":
        one["items_schema"] = [_unconverted(item) for item in one["items_schema"]]
    return one


@dataclass(frozen=True)
class Checked:
    """What a function makes of a value before what stands to its left looks at it.

    Attributes:
        read: raises `ValueError` with the complaint's words.
        json: what the JSON schema says in place of what stands to its left.
    """

    read: Callable[[Any], Any]
    json: Mapping[str, Any] | None = field(default=None, hash=False)

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return self.around(handler(source))

    def around(self, inner: Any) -> Any:
        """Return pydantic's schema `inner` behind the function."""
        from pydantic_core import core_schema as core

        return core.no_info_before_validator_function(self.read, inner)

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> Any:
        return handler(schema) if self.json is None else dict(self.json)


@dataclass(frozen=True)
class Spread:
    """One value for all, or a list: made a tuple, of `count` where that is stated."""

    count: int | None = None
    words: str = "a number, or a list with one per joint"

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return Checked(self._read).around(handler(source))

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> Any:
        several = handler(schema)
        one = several["items"] if "items" in several else several["prefixItems"][0]
        return {"anyOf": [one, several]}

    def _read(self, value: Any) -> Any:
        if not isinstance(value, (list, tuple)):
            return [value] * (self.count or 1)
        if not value or len(value) != (self.count or len(value)):
            raise ValueError(f"expected {self.words}, found {shown(value)}")
        return value


@dataclass(frozen=True)
class Filled:
    """A list of tables that is not empty."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return {**handler(source), "min_length": 1}


@dataclass(frozen=True)
class Hidden:
    """A field that no file states: as a key it is unknown."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core import PydanticCustomError
        from pydantic_core import core_schema as core

        def refuse(value: Any) -> Any:
            raise PydanticCustomError(UNKNOWN, "unknown")

        return core.no_info_before_validator_function(refuse, core.any_schema())

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> Any:
        return {"not": {}}


@dataclass(frozen=True)
class About:
    """What a key is about: the description in the JSON schema, and the comment in a file that we write."""

    words: str

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> Any:
        return {**handler(schema), "description": self.words}


@dataclass(frozen=True)
class OneOrMany:
    """A number, or a list of them, which means something else: made a float or a tuple."""

    of: Real

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core import core_schema as core

        one = self.of.__get_pydantic_core_schema__(float, handler)
        several = core.tuple_variable_schema(one, min_length=1)
        return core.tagged_union_schema(
            {f"{_TAG}one": one, f"{_TAG}several": several},
            lambda value: f"{_TAG}{'several' if isinstance(value, (list, tuple)) else 'one'}",
        )

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> Any:
        one = self.of.__get_pydantic_json_schema__(schema, handler)
        return {"anyOf": [one, {"type": "array", "items": one, "minItems": 1}]}


def _label(value: Any) -> str:
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise ValueError(f"expected a text or a number, found {shown(value)}")
    return f"{value:.12g}" if isinstance(value, float) else str(value)  # an integer of any length


def _numeric(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise ValueError(f"expected a number, or a text with a unit, found {shown(value)}")
    return value


def _filled(value: Any) -> Any:
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"expected a text, found {shown(value)}")
    return value


Flag = Annotated[bool, Expect("true or false")]
Text = Annotated[str, Expect("a text")]
Name = Annotated[str, Expect("a text"), Checked(_filled)]
Names = Annotated[tuple[str, ...], Expect("a list of names")]
Label = Annotated[str, Checked(_label, {"type": ["string", "number"]})]
Positive = Annotated[float, Real(above=0)]
NotNegative = Annotated[float, Real(least=0)]
JointNumber = Annotated[int, Index()]
Length = Annotated[float, Real(quantity="length")]
Angle = Annotated[float, Real(quantity="angle")]
Numeric = Annotated[Any, Checked(_numeric, {"type": ["number", "string"]})]
"""A number or a text with a unit that the caller reads by `number`: of what quantity it is, another key says."""
