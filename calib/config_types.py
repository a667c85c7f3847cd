"""Types of keys in option files: annotations of dataclass fields with bounds, units and messages.

pydantic checks values by these annotations, and `calib.config` converts its errors to readable messages. pydantic is
imported only where a file is read.
"""

from __future__ import annotations

import ast
import datetime
import math
import operator
import re
import reprlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn, TypeAlias, get_args

from calib.errors import CalibError, UsageError, suggestion
from calib.units import QUANTITIES

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
    from pydantic_core import CoreSchema

ParsedTable: TypeAlias = dict[str, Any]
"""A table of a TOML or JSON file as its parser returns it; who reads a value checks it."""

Plots: TypeAlias = bool | Literal["png", "svg"]
"""Figures of a result: False none, True as data and in its page, a format as files of this format, too."""

# Pydantic's name of the error for an unknown key.
UNKNOWN = "unexpected_keyword_argument"
# Largest number of characters of an expression (our choice).
MAX_LETTERS = 200
# Class of an operation in `ast`, with its function of two values.
Operations = Mapping[type[ast.operator], Callable[[Any, Any], Any]]
_BINARY: Operations = {ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv}
_NAMES = {"pi": math.pi, "inf": math.inf}


class _Short(reprlib.Repr):
    """Shortened texts of values, about one line each; dates are written as in TOML."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlist = self.maxdict = 12
        self.maxstring = self.maxother = 80

    def repr_date(self, value: datetime.date, level: int) -> str:
        return value.isoformat()

    repr_datetime = repr_time = repr_date


_SHORT = _Short()


def shown(value: object) -> str:
    """Return the text of a value for messages, at most one line long."""
    try:
        return _SHORT.repr(value)
    except ValueError:
        return "a whole number with thousands of digits"


def number(value: object, place: str, quantity: str = "", error: type[CalibError] = UsageError) -> float:
    """Return a number in SI, read from a number in TOML or from a text.

    A text is an expression, which may contain pi, followed by an optional unit.

    Args:
        value: ``0.4``, ``"-pi/2"``, ``"90 deg"``; infinite values are accepted.
        place: name of the value in messages.
        quantity: a key of `calib.units.QUANTITIES`; "" for a number without unit.
        error: class of the errors raised.

    Raises:
        CalibError: of class `error`, if the value is not a number or has a unit of another quantity.
    """
    try:
        return _number(value, quantity)
    except ValueError as wrong:
        raise error(f"{place}: {wrong}") from None


def numbers(
    value: object, count: int, place: str, quantity: str = "", error: type[CalibError] = UsageError
) -> tuple[float, ...]:
    """Return a list of `count` numbers in SI, each read by `number`.

    Raises:
        CalibError: of class `error`, if the value is not a list of so many numbers.
    """
    if not isinstance(value, (list, tuple)) or len(value) != count:
        raise error(f"{place}: expected a list of {count} numbers, found {shown(value)}")
    return tuple(number(item, place, quantity, error) for item in value)


def _number(value: object, quantity: str) -> float:
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
    # Python would read 0_5 as 5.
    if len(text) > MAX_LETTERS or "_" in text:
        raise ValueError(text)
    text = text.strip()
    factor = 1.0
    factors = QUANTITIES.get(quantity, {})
    for unit in sorted(factors, key=len, reverse=True):
        if text.endswith(unit):  # ty: ignore[invalid-argument-type]
            text = text.removesuffix(unit).strip()  # ty: ignore[no-matching-overload]
            factor = factors[unit]
            break
    return evaluated(ast.parse(text, mode="eval").body) * factor


def evaluated(node: ast.expr, names: Mapping[str, Any] = _NAMES, operations: Operations = _BINARY) -> Any:
    """Return the value of an arithmetic expression of numbers, names, signs, operations and functions.

    Args:
        node: the parsed expression.
        names: values by name, and functions of one argument.
        operations: class of each operation in `ast`, with its function of two values.

    Raises:
        ValueError: the expression contains anything else; the message is the invalid part.
    """
    inner = partial(evaluated, names=names, operations=operations)
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            return float(value)
        case ast.Name(id=name) if name in names and not callable(names[name]):
            return names[name]
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -inner(operand)
        case ast.UnaryOp(op=ast.UAdd(), operand=operand):
            return inner(operand)
        case ast.BinOp(left=left, op=sign, right=right) if type(sign) in operations:
            return operations[type(sign)](inner(left), inner(right))
        case ast.Call(func=ast.Name(id=name), args=[operand], keywords=[]) if callable(names.get(name)):
            return names[name](inner(operand))
    raise ValueError(ast.unparse(node))


def _float(value: object) -> float:
    """Return a TOML number as a float; NaN for any other value."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.nan


class _Refused(ValueError):
    """Error whose message states the expected and the given value."""

    def __init__(self, expected: str, value: object, hint: str = "") -> None:
        super().__init__(f"expected {expected}, found {shown(value)}{hint and f'; {hint}'}")


class _Read(ABC):
    """Base class of key types; pydantic passes a value to `read`, which returns it converted or raises an error."""

    @abstractmethod
    def read(self, value: object) -> object: ...

    @property
    @abstractmethod
    def json(self) -> Mapping[str, object]: ...

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        from pydantic_core import core_schema as core

        return core.no_info_plain_validator_function(self.read)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, object]:
        return dict(self.json)


@dataclass(frozen=True)
class Real(_Read):
    """A finite number, converted to float.

    Attributes:
        above, least, most: the number must be above `above`, and from `least` to `most`. Beyond `most`, and between
            `above` and `least` if both are given, the error message suggests that the unit is wrong.
        unit: unit of `most`, for the error message.
        quantity: texts with units of this quantity are also read (see `number`); "1" for texts without unit.
        infinite: True: infinity is allowed.
        zero: True: 0 is allowed, even if it is outside the bounds.
        words: description of the expected value in error messages; empty makes it from the bounds.
    """

    above: float | None = None
    least: float | None = None
    most: float | None = None
    unit: str = ""
    quantity: str = ""
    infinite: bool = False
    zero: bool = False
    words: str = ""

    def read(self, value: object) -> float:
        result = _number(value, self.quantity) if self.quantity and isinstance(value, str) else _float(value)
        if self.zero and result == 0.0:
            return result
        if expected := self._expected(result):
            raise _Refused(self.words or expected, value)
        return result

    def _expected(self, value: float) -> str:
        """Return a description of the expected number if `value` is out of bounds; empty otherwise."""
        finite = math.isfinite(value) or (self.infinite and not math.isnan(value))
        if not finite or (self.above is not None and value <= self.above):
            return "a number" if self.above is None else f"a number above {self.above:g}"
        if self.above is None and self.least is not None and value < self.least:
            return f"{self.least:g} or more"
        if (self.least is None or value >= self.least) and (self.most is None or value <= self.most):
            return ""
        hint = " (are these mm, or degrees?)" if self.unit in ("m", "rad") else ""
        if self.quantity == "length" and self.most is not None and 1e-3 * value <= self.most:
            hint = f" ({value:g} mm are {1e-3 * value:g}, or '{value:g} mm')"
        low = "" if self.least is None else f"at least {self.least:g} and "
        upper = math.inf if self.most is None else self.most
        return f"a number{self.unit and f' [{self.unit}]'}, {low}at most {upper:g}{hint}"

    @property
    def json(self) -> Mapping[str, object]:
        bounds = {"exclusiveMinimum": self.above, "minimum": self.least, "maximum": self.most}
        if self.zero:
            bounds = {"minimum": 0.0, "maximum": self.most}
        elif self.least is not None:
            del bounds["exclusiveMinimum"]
        number_schema = {"type": "number", **{key: value for key, value in bounds.items() if value is not None}}
        return {"anyOf": [number_schema, {"type": "string"}]} if self.quantity else number_schema


@dataclass(frozen=True)
class Whole(_Read):
    """A whole number from `least` to `most`, from which `start` is subtracted; `of` names its unit in messages."""

    least: int = 0
    most: int = 2**63 - 1
    of: str = ""
    start: int = 0

    def read(self, value: object) -> int:
        if type(value) is int and self.least <= value <= self.most:
            return value - self.start
        span = f", {self.least} or more" if self.most == Whole.most else f" from {self.least} to {self.most}"
        raise _Refused(f"a whole number{self.of}{span}", value)

    @property
    def json(self) -> Mapping[str, object]:
        return {"type": "integer", "minimum": self.least, "maximum": self.most}


@dataclass(frozen=True)
class OneOf(_Read):
    """One of a few allowed texts; `hint` is added to the error message.

    Attributes:
        allowed: the texts; or ``module:Name`` of a `Literal` with them, if the module is to be imported only when
            needed.
        pattern: regular expression of further texts, which the hint names; "" for none.
    """

    allowed: tuple[str, ...] | str
    hint: str = ""
    pattern: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """The allowed texts."""
        if not isinstance(self.allowed, str):
            return self.allowed
        module, _, name = self.allowed.partition(":")
        return get_args(getattr(import_module(module), name))

    @property
    def words(self) -> str:
        """The allowed texts as a list for messages; empty if they are given by the name of a module."""
        if isinstance(self.allowed, str):
            return ""
        return f"{', '.join(self.allowed[:-1])} or {self.allowed[-1]}"

    def read(self, value: object) -> str:
        if isinstance(value, str) and (value in self.names or (self.pattern and re.fullmatch(self.pattern, value))):
            return value
        near = suggestion(value, self.names) if isinstance(value, str) else ""
        raise _Refused(f"one of {', '.join(self.names)}{near}", value, self.hint)

    @property
    def json(self) -> Mapping[str, object]:
        names: Mapping[str, object] = {"enum": [*self.names], "type": "string"}
        return {"anyOf": [names, {"type": "string", "pattern": self.pattern}]} if self.pattern else names


@dataclass(frozen=True)
class Expect:
    """Description of the expected value for error messages.

    Numbers, texts and flags of another type are not converted.
    """

    words: str

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        from pydantic_core import ValidationError
        from pydantic_core import core_schema as core

        def read(value: object, inner: Callable[[object], object]) -> object:
            try:
                return inner(value)
            except ValidationError:
                raise _Refused(self.words, value) from None

        return core.no_info_wrap_validator_function(read, _unconverted(handler(source)))


def _unconverted(inner_schema: Any) -> Any:
    """Return pydantic's schema of a number, text, flag or list of these, without conversion of types.

    nan and infinity are refused.
    """
    if inner_schema["type"] in ("int", "float", "str", "bool"):
        inner_schema["strict"] = True
    if inner_schema["type"] == "float":
        inner_schema.setdefault("allow_inf_nan", False)
    if inner_schema["type"] == "tuple":
        inner_schema["items_schema"] = [_unconverted(item) for item in inner_schema["items_schema"]]
    return inner_schema


@dataclass(frozen=True)
class Checked:
    """A function that pydantic applies to a value before the annotations to the left of this one check it.

    Attributes:
        read: function from the value to the value to be checked; raises `ValueError` with the error message.
        json: JSON schema that replaces the schema of the annotations to the left; None keeps it.
    """

    read: Callable[[object], object]
    json: Mapping[str, object] | None = field(default=None, hash=False)

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        return self.around(handler(source))

    def around(self, inner: CoreSchema) -> CoreSchema:
        """Return pydantic's schema that applies the function, then checks the result by the schema `inner`."""
        from pydantic_core import core_schema as core

        return core.no_info_before_validator_function(self.read, inner)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, object]:
        return handler(schema) if self.json is None else dict(self.json)


@dataclass(frozen=True)
class Spread:
    """One value, or a list of values, stored as a tuple.

    If `count` is given, the list must have this length, and one value is repeated that often.
    """

    count: int | None = None
    words: str = "a number, or a list with one per joint"

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        return Checked(self._read).around(handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, object]:
        several = handler(schema)
        one = several["items"] if "items" in several else several["prefixItems"][0]
        return {"anyOf": [one, several]}

    def _read(self, value: object) -> object:
        if not isinstance(value, (list, tuple)):
            return [value] * (self.count or 1)
        if not value or len(value) != (self.count or len(value)):
            raise ValueError(f"expected {self.words}, found {shown(value)}")
        return value


@dataclass(frozen=True)
class Hidden:
    """Annotation of a field that files cannot set: in a file, its name is an unknown key."""

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        from pydantic_core import PydanticCustomError
        from pydantic_core import core_schema as core

        def refuse(value: object) -> NoReturn:
            raise PydanticCustomError(UNKNOWN, "unknown")

        return core.no_info_before_validator_function(refuse, core.any_schema())

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, object]:
        return {"not": {}}


@dataclass(frozen=True)
class Typed:
    """Form of a setting on the command line: the option's name, and the unit of its number (SI in Python)."""

    name: str = ""
    unit: str = ""


@dataclass(frozen=True)
class OneOrMany(_Read):
    """A number, converted to float, or a list of numbers, converted to a tuple; the two have different meanings."""

    of: Real

    def read(self, value: object) -> object:
        if not isinstance(value, (list, tuple)):
            return self.of.read(value)
        if not value:
            raise _Refused("at least one number", value)
        return tuple(map(self.of.read, value))

    @property
    def json(self) -> Mapping[str, object]:
        return {"anyOf": [self.of.json, {"type": "array", "items": self.of.json, "minItems": 1}]}


def _label(value: object) -> str:
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise ValueError(f"expected a text or a number, found {shown(value)}")
    return f"{value:.12g}" if isinstance(value, float) else str(value)  # an integer of any length


def _numeric(value: object) -> object:
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise ValueError(f"expected a number, or a text with a unit, found {shown(value)}")
    return value


def _filled(value: object) -> object:
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"expected a text, found {shown(value)}")
    return value


Flag = Annotated[bool, Expect("true or false")]
Text = Annotated[str, Expect("a text")]
Name = Annotated[str, Expect("a text"), Checked(_filled)]
Names = Annotated[tuple[str, ...], Expect("a list of names")]
Label = Annotated[str, Checked(_label, {"type": ["string", "number"]})]
Positive = Annotated[float, Real(above=0)]
Tolerance = Annotated[float, Real(above=0.0, quantity="length"), Typed(unit="mm")] | None
Holdout = Annotated[float, Real(least=0.0, most=0.99, words="a share from 0 to 0.99")]
Seed = Annotated[int, Whole(0, 2**63 - 1)]
NotNegative = Annotated[float, Real(least=0)]
JointNumber = Annotated[int, Whole(1, 99, start=1)]
Length = Annotated[float, Real(quantity="length")]
Angle = Annotated[float, Real(quantity="angle")]
Numeric = Annotated[object, Checked(_numeric, {"type": ["number", "string"]})]
"""A number, or a text with a unit, parsed by `number`; another key of the table gives the quantity, e.g. length."""
