"""Commands from function signatures: parameters and settings fields become options, docstrings their help."""

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import fields, is_dataclass
from functools import wraps
from inspect import Parameter, cleandoc, signature
from types import NoneType, UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import typer
from typer.models import ParameterInfo

from calib.cli.shared import printing
from calib.config import described, parse
from calib.config_types import OneOf, Typed

F = TypeVar("F", bound=Callable[..., Any])


class Common:
    """Parameters that mean the same in all commands.

    Attributes:
        robot: a .urdf, an MDH .toml, a library name, or the folder of an earlier fit.
        base: URDF: the link the arm starts at.
        tip: URDF: the link the arm ends at.
        workers: local processes, or the address of a Dask scheduler.
        plots: draw figures, or leave them out.
        verbose: print all details, tables included.
        overwrite: replace any existing files; without: only those of an earlier run.
    """


def command(app: typer.Typer, name: str | None = None, listing: bool = False) -> Callable[[F], F]:
    """Return a decorator that adds a function to `app` as a command.

    What ``Args:`` of its docstring, or `Common`, says of a parameter is the option's help; a flag that is off by
    default has no name to switch it off. A parameter that is annotated with a settings dataclass becomes an option per
    field, described under ``Attributes:`` of that class; fields that the function takes itself are left to it. Every
    command has ``-v``, without which it prints what `calib.cli.shared.printing` lets through; not so one that lists.
    """

    def add(function: F) -> F:
        hints, about = get_type_hints(function, include_extras=True), described(Common) | described(function)
        own, made = signature(function).parameters, list[Parameter]()
        settings = {key: hint for key, hint in hints.items() if key in own and is_dataclass(hint)}
        for key, one in own.items():
            if key in settings:
                made += [option for option in _options(settings[key]) if option.name not in own]
            else:
                names = (f"--{key.replace('_', '-')}",) if one.default is False else ()
                annotation = _with_help(hints[key], about.get(key, ""), names, one.default is Parameter.empty)
                made.append(one.replace(annotation=annotation, kind=Parameter.KEYWORD_ONLY))

        if not listing:
            words = _with_help(bool, about["verbose"], ("-v", "--verbose"), False)
            made = [one for one in made if one.name != "verbose"]
            made.append(Parameter("verbose", Parameter.KEYWORD_ONLY, default=False, annotation=words))

        @wraps(function)
        def call(**given: Any) -> Any:
            built = {key: _built(kind, given) for key, kind in settings.items()}
            with printing(given.get("verbose", True)):
                return function(**built, **{key: value for key, value in given.items() if key in own})

        call.__signature__ = signature(function).replace(parameters=made)  # type: ignore[attr-defined]
        call.__annotations__ = {}
        app.command(name, help=cleandoc(function.__doc__ or "").partition("\n\nArgs:\n")[0])(call)
        return function

    return add


def _with_help(hint: Any, words: str, names: Sequence[str], positional: bool) -> Any:
    """Return an annotation with the help of its option or argument, and further metadata for Typer."""
    kind, *metadata = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    option = next((copy(one) for one in metadata if isinstance(one, ParameterInfo)), None)
    option = option or (typer.Argument() if positional else typer.Option(*names))
    option.help = option.help or words
    return Annotated[kind, option]


def _options(kind: Any) -> Iterator[Parameter]:
    """Yield the options of a settings dataclass, including nested settings."""
    hints, about = get_type_hints(kind, include_extras=True), described(kind)
    for field in fields(kind):
        if is_dataclass(hints[field.name]):
            yield from _options(hints[field.name])
            continue
        plain, metadata = _plain(hints[field.name])
        typed = next((one for one in metadata if isinstance(one, Typed)), Typed())
        words = [about.get(field.name, ""), *(one.words for one in metadata if isinstance(one, OneOf))]
        names, metavar = [typed.name] if typed.name else [], typed.unit.upper() or None
        if get_origin(plain) is tuple:
            names = names or [f"--{field.name.removesuffix('s')}"]
            metavar = "NUMBERS" if _plain(get_args(plain)[0])[0] is not str else None
            plain = list[str] if _is_repeated(plain) else str
        elif typed.unit:
            plain = str
        option = typer.Option(*names, help="; ".join(filter(None, words)), metavar=metavar)
        default = field.default if isinstance(field.default, int | float | str) else None
        annotation = Annotated[plain if default is not None else plain | None, option]
        yield Parameter(field.name, Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _plain(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return a type without None, and its metadata."""
    if get_origin(hint) is Annotated:
        plain, metadata = _plain(get_args(hint)[0])
        return plain, (*metadata, *hint.__metadata__)
    if get_origin(hint) in (Union, UnionType):
        return _plain(next(one for one in get_args(hint) if one is not NoneType))
    return hint, ()


def _is_repeated(plain: Any) -> bool:
    """Return whether an option is repeated per item of a tuple; numbers are given as one comma-separated text."""
    first, last = get_args(plain)[0], get_args(plain)[-1]
    return last is ... and _plain(first)[0] is not float


def _built(kind: Any, given: dict[str, Any]) -> Any:
    """Return settings from the values of the command line; missing values take the defaults."""
    chosen = _chosen(kind, given)
    return parse(kind, chosen, "") if chosen else kind()


def _chosen(kind: Any, given: dict[str, Any]) -> dict[str, Any]:
    result, hints = {}, get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        if is_dataclass(hints[field.name]):
            value = _chosen(hints[field.name], given)
        else:
            value = given.get(field.name)
        if value not in (None, field.default, [], {}):
            result[field.name] = _read(hints[field.name], value)
    return result


def _read(hint: Any, value: Any) -> Any:
    """Return a value as in an option file: comma-separated texts as lists, numbers with their unit."""
    plain, metadata = _plain(hint)
    typed = next((one for one in metadata if isinstance(one, Typed)), Typed())
    if typed.unit:
        return f"{value} {typed.unit}"
    if get_origin(plain) is not tuple:
        return value
    if isinstance(value, str):
        return value.split(",")
    return [_read(get_args(plain)[0], one) for one in value]
