"""Checks of the Python API's arguments by their annotations; the error for a wrong type names the argument.

Loads nothing heavy: the command line builds default settings before it knows what it is asked for.
"""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache, wraps
from inspect import Signature, isgenerator, signature
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

C = TypeVar("C")
_PLAIN = {int: (Integral,), float: (Real,)}
_WORDS = {
    bool: "True or False",
    int: "a whole number",
    float: "a number",
    str: "a text",
    NoneType: "None",
    Path: "a path",
}
_TABLE = "found a DataFrame: write it by frame.to_csv('table.csv', index=False) and give that file"


def checked(given: C) -> C:
    """Return a function or settings class that raises an error for arguments of a type other than annotated.

    A function runs with one thread of BLAS, `calib.workers.threads`; one that takes `progress` shows it in notebooks,
    in a line below the cell until it returns. Settings are read as an option file's table is,
    see `calib.config.parse`; without arguments nothing is loaded for that.

    Numbers may be numpy's, and any sequence or array stands for a tuple; text is neither number nor sequence.

    Raises:
        UsageError: when called: ``fit_geometry: settings: expected FitSettings or None, found 0.25``.
    """
    function: Any = given
    if not isinstance(given, type):
        return _checked(function)
    function.__init__, function.__pydantic_config__ = _read_by_type(function), {"extra": "forbid"}
    return given


def _read_by_type(kind: Any) -> Any:
    init = kind.__init__

    @wraps(init)
    def call(self: Any, *args: Any, **kwargs: Any) -> None:
        from calib.config import parse, plain_values
        from calib.errors import quiet

        with quiet():
            bound = _bound(signature(init), kind.__name__, (self, *args), kwargs)
            given = {key: plain_values(value) for key, value in bound.items() if key != "self"}
            vars(self).update(vars(parse(kind, given, kind.__name__)) if given else {})
            if not given:
                init(self)

    return call


def _bound(wanted: Signature, name: str, args: tuple, kwargs: dict[str, Any]) -> dict[str, Any]:
    from calib.errors import UsageError

    try:
        return wanted.bind(*args, **kwargs).arguments
    except TypeError as wrong:
        raise UsageError(f"{name}: {wrong}") from None


def _checked(function: Callable[..., Any]) -> Any:
    @cache
    def expected() -> tuple[Any, dict[str, Any]]:  # at the first call: modules load each other no more
        return signature(function), get_type_hints(function)

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        from calib.errors import quiet
        from calib.workers.threads import limited_steps, one_blas_thread

        _refuse_other_types(function.__name__, *expected(), args, kwargs)
        with one_blas_thread(), quiet(), _reporter(expected()[0], kwargs) as progress:
            result = function(*args, **kwargs | progress)
        return limited_steps(result) if isgenerator(result) else result

    return call


@contextmanager
def _reporter(wanted: Signature, given: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield a notebook's reporter as an argument for a function that takes one and was given none; otherwise {}."""
    notebook = sys.modules.get("IPython")
    wants = "progress" in wanted.parameters and given.get("progress") is None
    if not wants or notebook is None or not hasattr(notebook.get_ipython(), "kernel"):
        yield {}
        return
    line = notebook.display.display({"text/plain": ""}, raw=True, display_id=True)
    try:
        yield {"progress": lambda words: line.update({"text/plain": words}, raw=True)}
    finally:
        line.update({}, raw=True)


def _refuse_other_types(name: str, wanted: Signature, hints: dict[str, Any], args: tuple, kwargs: dict) -> None:
    from calib.config_types import shown
    from calib.errors import UsageError

    for argument, value in _bound(wanted, name, args, kwargs).items():
        variadic = wanted.parameters[argument].kind in (2, 4)  # *args, **kwargs
        if argument in hints and not variadic and not _fits(value, hints[argument]):
            found = _TABLE if hasattr(value, "to_csv") else f"found {shown(value)}"
            raise UsageError(f"{name}: {argument}: expected {_words(hints[argument])}, {found}")


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a value matches an annotated type; an annotation that states no type matches every value."""
    kind, inner = get_origin(hint), get_args(hint)
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
    """Return the description of an annotated type, for messages."""
    kind, inner = get_origin(hint), get_args(hint)
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
