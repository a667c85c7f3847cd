"""Checks of the Python API's arguments against their annotated types; the error for a wrong type names the argument.

The module imports nothing that loads slowly: the command line creates default settings before it knows the command.
"""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache, wraps
from inspect import Parameter, Signature, isgenerator, signature
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


def checked(target: C) -> C:
    """Return a function or settings class that raises an error for arguments of a type other than the annotated one.

    A function runs with one BLAS thread (`calib.workers.threads`). If it has an argument `progress`, a notebook shows
    the progress in a line below the cell until the function returns. Arguments of a settings class are checked by
    `calib.config.parse`, as the keys of an option file are; this loads nothing where there are no arguments.

    numpy numbers are accepted as numbers, and any sequence or array as a tuple. Text is neither a number nor a
    sequence.

    Raises:
        UsageError: at the call: ``fit_geometry: settings: expected FitSettings or None, found 0.25``.
    """
    function: Any = target
    if not isinstance(target, type):
        return _checked(function)
    function.__init__ = _read_by_type(function)
    function.__pydantic_config__ = {"extra": "forbid"}
    return target


def _read_by_type(kind: type) -> Callable[..., None]:
    init = kind.__init__

    @wraps(init)
    def call(self: object, *args: object, **kwargs: object) -> None:
        from calib.config import parse, plain_values
        from calib.errors import quiet

        with quiet():
            bound = _bound(signature(init), kind.__name__, (self, *args), kwargs)
            values = {key: plain_values(value) for key, value in bound.items() if key != "self"}
            if not values:
                init(self)
                return
            parsed = parse(kind, values, kind.__name__)
            # The dataclass may be frozen.
            self.__dict__.update(parsed.__dict__)

    return call


def _bound(function_signature: Signature, name: str, args: tuple, kwargs: dict[str, object]) -> dict[str, object]:
    from calib.errors import UsageError

    try:
        return function_signature.bind(*args, **kwargs).arguments
    except TypeError as error:
        raise UsageError(f"{name}: {error}") from None


def _checked(function: Any) -> Any:
    @cache
    def expected() -> tuple[Signature, dict[str, object]]:  # at the first call: modules load each other no more
        return signature(function), get_type_hints(function)

    @wraps(function)
    def call(*args: object, **kwargs: object) -> object:
        from calib.errors import quiet
        from calib.workers.threads import limited_steps, one_blas_thread

        _refuse_other_types(function.__name__, *expected(), args, kwargs)
        with one_blas_thread(), quiet(), _reporter(expected()[0], kwargs) as progress:
            result = function(*args, **kwargs | progress)
        return limited_steps(result) if isgenerator(result) else result

    return call


@contextmanager
def _reporter(function_signature: Signature, arguments: Mapping[str, object]) -> Iterator[dict[str, object]]:
    """Yield the argument `progress` that shows progress in a notebook, as a dictionary.

    The dictionary is empty for a function without this argument, for a call that has it, and outside notebooks.
    """
    notebook = sys.modules.get("IPython")
    lacks_reporter = "progress" in function_signature.parameters and arguments.get("progress") is None
    if not lacks_reporter or notebook is None or not hasattr(notebook.get_ipython(), "kernel"):
        yield {}
        return
    line = notebook.display.display({"text/plain": ""}, raw=True, display_id=True)

    def show(message: str) -> None:
        line.update({"text/plain": message}, raw=True)

    try:
        yield {"progress": show}
    finally:
        line.update({}, raw=True)


def _refuse_other_types(
    name: str, function_signature: Signature, hints: dict[str, object], args: tuple, kwargs: dict
) -> None:
    from calib.config_types import shown
    from calib.errors import UsageError

    for argument, value in _bound(function_signature, name, args, kwargs).items():
        kind = function_signature.parameters[argument].kind
        is_variadic = kind in (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD)
        if argument in hints and not is_variadic and not _fits(value, hints[argument]):
            content = _TABLE if hasattr(value, "to_csv") else f"found {shown(value)}"
            raise UsageError(f"{name}: {argument}: expected {_words(hints[argument])}, {content}")


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a value has an annotated type; annotations that are not types accept every value."""
    kind, inner = get_origin(hint), get_args(hint)
    if kind in (Union, UnionType):
        return any(_fits(value, alternative) for alternative in inner)
    if kind is Literal:
        return value in inner
    if kind is tuple or kind is Sequence:
        is_array = hasattr(value, "__array__") and getattr(value, "ndim", 0) > 0 and not hasattr(value, "columns")
        if isinstance(value, (str, bytes)) or not (is_array or isinstance(value, Sequence)):
            return False
        if kind is Sequence or inner[-1] is ...:
            return all(_fits(item, inner[0]) for item in value)
        return len(value) == len(inner) and all(map(_fits, value, inner))
    if kind is Mapping or kind is Callable:
        return isinstance(value, kind)
    if hint is bool:
        return isinstance(value, bool) or getattr(getattr(value, "dtype", None), "kind", "") == "b"
    if hint in (int, float) and isinstance(value, bool):
        return False
    if not isinstance(hint, type):
        return True
    return isinstance(value, _PLAIN.get(hint, (hint,)))


def _words(hint: object) -> str:
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
