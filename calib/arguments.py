"""Arguments of the Python API held against their annotations: what has another type is refused by its name.

Loads nothing heavy: the command line builds default settings before it knows what it is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, wraps
from inspect import Signature, isgenerator, signature
from math import inf
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

C = TypeVar("C")
_PLAIN = {int: (Integral,), float: (Real,)}
_WORDS = {
    bool: "True or False", int: "a whole number", float: "a number", str: "a text", NoneType: "None", Path: "a path",
}  # fmt: skip
_TABLE = "found a DataFrame: write it, frame.to_csv('table.csv', index=False), and give the file"


@dataclass(frozen=True)
class Within:
    """Where a number may lie, as an annotation: ``Annotated[float, Within(above=0.0, most=1e6)]``; never NaN.

    Attributes:
        least, above: from, or beyond, which it lies; most: up to which.
    """

    least: float = -inf
    most: float = inf
    above: float = -inf

    def holds(self, value: Any) -> bool:
        return bool(self.above < value <= self.most and value >= self.least)

    @property
    def words(self) -> str:
        low = f"above {self.above:g}" if self.above > -inf else f"from {self.least:g}" if self.least > -inf else ""
        high = f"up to {self.most:g}" if self.most < inf else ""
        return " ".join(part for part in (low, high) if part)


def checked(given: C) -> C:
    """Return a function, or a dataclass, that refuses arguments of other types than annotated.

    A function runs with one thread of BLAS, `calib.workers.threads`.

    Numbers may be numpy's, and any sequence or array stands for a tuple; text is neither number nor sequence.

    Raises:
        UsageError: when called: ``fit_geometry: settings: expected FitSettings or None, found 0.25``.
    """
    function: Any = given
    if not isinstance(given, type):
        return _checked(function, function.__name__, given)
    function.__init__ = _checked(function.__init__, function.__name__, given, method=True)
    return given


def _checked(function: Callable[..., Any], name: str, annotated: Any, method: bool = False) -> Any:
    @cache
    def expected() -> tuple[Any, dict[str, Any]]:
        return signature(function), get_type_hints(
            annotated, include_extras=True
        )  # at the first call: modules load each other no more

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        from calib.errors import quiet
        from calib.workers.threads import limited_steps, one_blas_thread

        if len(args) > method or kwargs:  # something is given beside the defaults
            _refuse_other_types(name, *expected(), args, kwargs)
        if method:
            with quiet():
                return function(*args, **kwargs)
        with one_blas_thread(), quiet():
            result = function(*args, **kwargs)
        return limited_steps(result) if isgenerator(result) else result

    return call


def _refuse_other_types(name: str, wanted: Signature, hints: dict[str, Any], args: tuple, kwargs: dict) -> None:
    from calib.config_types import shown
    from calib.errors import UsageError

    try:
        bound = wanted.bind(*args, **kwargs)
    except TypeError as wrong:
        raise UsageError(f"{name}: {wrong}") from None
    for argument, value in bound.arguments.items():
        variadic = wanted.parameters[argument].kind in (2, 4)  # *args, **kwargs
        if argument in hints and not variadic and not _fits(value, hints[argument]):
            hint = hints[argument]
            if get_origin(hint) is Annotated and _fits(value, get_args(hint)[0]):  # of its type, beyond its range
                raise UsageError(f"{argument} {shown(value)}: expected {_words(hint)}")
            found = _TABLE if hasattr(value, "to_csv") else f"found {shown(value)}"
            raise UsageError(f"{name}: {argument}: expected {_words(hint)}, {found}")


def _fits(value: Any, hint: Any) -> bool:
    """Say whether a value is of an annotated type; what the annotation leaves open fits."""
    kind, inner = get_origin(hint), get_args(hint)
    if kind is Annotated:
        return _fits(value, inner[0]) and all(one.holds(value) for one in inner[1:] if isinstance(one, Within))
    if kind in (Union, UnionType):
        return any(_fits(value, one) for one in inner)
    if kind is Literal:
        return value in inner
    if kind is tuple or kind is Sequence:
        array = hasattr(value, "__array__") and getattr(value, "ndim", 0) > 0 and not hasattr(value, "columns")
        if isinstance(value, (str, bytes)) or not (array or isinstance(value, Sequence)):
            return False
        fixed = kind is tuple and inner[-1] is not ...
        return (not fixed or len(value) == len(inner)) and all(
            _fits(one, inner[k if fixed else 0]) for k, one in enumerate(value)
        )
    if kind is Mapping or kind is Callable:
        return isinstance(value, kind)
    if hint is bool:
        return isinstance(value, bool) or getattr(getattr(value, "dtype", None), "kind", "") == "b"
    if hint in (int, float) and isinstance(value, bool):
        return False
    return isinstance(value, _PLAIN.get(hint, (hint,))) if isinstance(hint, type) else True


def _words(hint: Any) -> str:
    """Return an annotated type in words."""
    kind, inner = get_origin(hint), get_args(hint)
    if kind is Annotated:
        return " ".join([_words(inner[0]), *(one.words for one in inner[1:] if isinstance(one, Within))])
    if kind in (Union, UnionType):
        *first, last = dict.fromkeys(map(_words, inner))
        return f"{', '.join(first)} or {last}" if first else last
    if kind is Literal:
        return f"one of {', '.join(map(str, inner))}"
    if kind is tuple and inner[-1] is not ...:
        return f"{len(inner)} values, each {_words(inner[0])}"
    if kind is tuple or kind is Sequence:
        return f"several, each {_words(inner[0])}"
    if kind in (Mapping, Callable):
        return "a mapping" if kind is Mapping else "a function"
    return _WORDS.get(hint, getattr(hint, "__name__", str(hint)))
