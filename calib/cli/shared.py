"""Shared parts of the commands: options from function signatures, console output, progress, check
of the output folder.
"""

from __future__ import annotations

import logging
import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from copy import copy
from dataclasses import fields, is_dataclass
from enum import StrEnum
from functools import partial, wraps
from inspect import Parameter, cleandoc, signature
from math import inf, isfinite
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import typer
from typer.models import ArgumentInfo, OptionInfo, ParameterInfo

from calib.cli.completion import completion
from calib.cli.help import Command, type_word
from calib.config import described, parse
from calib.config_types import OneOf, Plots, Typed
from calib.errors import UsageError, require
from calib.units import plain_number
from calib.workers.extras import installed, lacking

if TYPE_CHECKING:
    from rich.console import Console


def check_destination(verb: str, robot: object, out: Path, inputs: Sequence[str | Path | None] = ()) -> None:
    """Check, before any other work, that a command can write its results into a folder.

    Args:
        verb: name of the command.
        robot: the robot as the user named it: file, library name or folder of a fit.
        out: folder for the results.
        inputs: files that the command reads, which must not be overwritten; None: no file.

    Raises:
        UsageError: if the folder contains inputs or other files; the message names the folder or file.
    """
    from calib.procedure.robot_kinds import stage_of

    stage = stage_of(robot, verb)
    if stage is not None:
        check = stage.check
    elif verb == "fit":
        from calib.procedure.kinematic_stage.folder import check_fit_target as check
    elif verb == "identify":
        from calib.procedure.dynamic_stage.folder import check_identification_target as check
    elif verb == "excite":
        from calib.procedure.excitation.folder import check_design_target as check
    else:
        from calib.procedure.excitation.folder import check_plan_target as check
    check(out, inputs)


# Columns of tables that no terminal bounds.
PIPED = 160
# Lines that a command prints without -v, warnings and verdicts not counted, and of these the ones it ends with.
MAX_LINES = 25
MAX_LAST_LINES = 9

Out = Annotated[Path, typer.Option()]
Seed = Annotated[int, typer.Option(min=0, help="reproduces everything random")]


def make_console(stderr: bool = False) -> Console:
    from rich.console import Console

    stream = sys.stderr if stderr else sys.stdout
    width = None
    # Rich takes 80, and cuts the files' names.
    if not stream.isatty() and "COLUMNS" not in os.environ:
        width = PIPED
    return Console(highlight=False, stderr=stderr, width=width)


class _Output:
    """Output of a command: all lines with -v, otherwise at most `MAX_LINES`, without indented lines and tables."""

    def __init__(self, verbose: bool) -> None:
        self.verbose = verbose
        self.printed = 0
        self.left_out = 0
        # Lines that may be printed at the end: each with its console, and whether it has to be.
        self.last: list[tuple[object, Console, bool]] = []

    def show(self, line: object, console: Console, result: bool) -> None:
        is_table = hasattr(line, "add_column")
        text = " " if is_table else str(line)
        if self.verbose or result or re.match(r"\s*(verdict|warning)\b", text):
            self.last.append((line, console, True))
        elif text.startswith(" "):
            self.left_out += getattr(line, "row_count", 1)
        else:
            self.printed += 1
            self.last.append((line, console, False))
        if self.printed <= MAX_LINES - MAX_LAST_LINES:
            self.flush()
        elif self.printed > MAX_LINES:
            droppable = [index for index, (_, _, required) in enumerate(self.last) if not required]
            del self.last[droppable[0]]
            self.printed -= 1
            self.left_out += 1

    def flush(self) -> None:
        for line, console, _ in self.last:
            console.print(line, soft_wrap=True, markup=False)
        self.last = []

    def end(self) -> None:
        self.flush()
        if self.left_out:
            make_console().print(f"… {self.left_out} more lines with -v")


_OUTPUT: ContextVar[_Output | None] = ContextVar("output", default=None)


class _Logged(logging.Handler):
    """Log handler that prints the log messages of this package for the user; each text is printed once."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.printed: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        message = record.getMessage()
        if message not in self.printed:
            self.printed.add(message)
            say(message)


@contextmanager
def printing(verbose: bool) -> Iterator[None]:
    """Print the lines that the block passes to `say`: all lines if `verbose`, otherwise the most important ones.

    Log messages of the package are printed, too.
    """
    output = _Output(verbose)
    log = logging.getLogger("calib")
    handler = _Logged()
    token = _OUTPUT.set(output)
    level = log.level
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(level)
        _OUTPUT.reset(token)
        output.end()


def say(*lines: object, console: Console | None = None, result: bool = False) -> None:
    """Print texts and rich renderables.

    Args:
        lines: the texts and renderables.
        console: console for the output; None: standard output.
        result: whether the lines are the requested result, which is always printed in full.
    """
    console = console or make_console()
    output = _OUTPUT.get() or _Output(verbose=True)
    for line in lines:
        output.show(line, console, result)


def say_written(lines: Iterable[object], out: Path, verdict: str = "") -> None:
    """Print the lines on a result, and the path to which the result was written.

    Args:
        lines: texts and rich renderables to print.
        out: path of the result.
        verdict: level of the verdict; empty: no verdict.

    Raises:
        typer.Exit: with code 1 if the verdict is fail.
    """
    say(*lines, f"written to {out}")
    exit_failed(verdict)


def exit_failed(verdict: str) -> None:
    """Exit with code 1 if the level of the verdict is fail."""
    if verdict == "fail":
        raise typer.Exit(1)


@contextmanager
def progress(console: Console | None = None) -> Iterator[Callable[[str], None]]:
    """Yield a function that shows progress messages on a console, if the console is a terminal.

    Args:
        console: the console; None: stderr.
    """
    from rich.markup import escape

    console = console or make_console(stderr=True)
    spinner = "dots" if console.encoding.startswith("utf") else "line"
    with console.status("", spinner=spinner) as status:

        def show(message: object) -> None:
            status.update(escape(str(message)))

        yield show


def _now_and_then(period: float) -> Callable[[str], None]:
    """Return a function that prints a message on stderr, at most once per `period` [s]; other messages are dropped."""
    due = time.monotonic() + period

    def say_if_due(message: str) -> None:
        nonlocal due
        time_now = time.monotonic()
        if time_now >= due:
            due = time_now + period
            print(message, file=sys.stderr, flush=True)

    return say_if_due


@contextmanager
def reporting(logged: float = inf) -> Iterator[tuple[Callable[..., None], Callable[[str], None]]]:
    """Yield two functions: one prints permanent lines, the other one shows progress messages.

    Args:
        logged: interval [s] between progress messages on stderr if the output is not a terminal (but a file, or the log
            of a job); infinite: no such messages.
    """
    console = make_console()
    if not console.is_terminal and logged < inf:
        yield partial(say, console=console), _now_and_then(logged)
        return
    with progress(console) as show:
        yield partial(say, console=console), show


def numbers(text: str, count: int, option: str, expected: str = "") -> list[float]:
    """Return the finite numbers in an option's text such as ``1,2,3``.

    Args:
        text: the text.
        count: expected number of values.
        option: name of the option for the message.
        expected: what the message says of the values; by default their number.

    Raises:
        UsageError: for any other text.
    """
    if not expected:
        expected = "a finite number" if count == 1 else f"{count} finite numbers separated by commas"
    try:
        values = [plain_number(part) for part in text.split(",")]
    except ValueError:
        values = []
    message = f"{option} {text}: expected {expected}"
    require(len(values) == count and all(map(isfinite, values)), message, UsageError)
    return values


F = TypeVar("F", bound=Callable[..., object])
S = TypeVar("S")


class Common:
    """Parameters with the same meaning in all commands.

    Attributes:
        robot: a .urdf, an MDH .toml, a library name, or the folder of an earlier fit.
        base: URDF: the link the arm starts at.
        tip: URDF: the link the arm ends at; else its flange (tool0, flange), which is printed with the reason.
        workers: local processes, or the address of a Dask scheduler.
        plots: write each figure as a file, too. Default: figures are on the page.
        no_plots: leave figures out.
        verbose: print all details, tables included.
        overwrite: replace all existing files; without it, only those of an earlier run.
    """


def command(app: typer.Typer, group: str, name: str | None = None, listing: bool = False) -> Callable[[F], F]:
    """Return a decorator that adds a function to `app` as a command.

    The function's docstring ends with an example, which tests parse. The help of an option is the text on the parameter
    under ``Args:`` of this docstring, or in `Common`. A flag that is off by default has no option to switch it off.

    A parameter that is annotated with a settings dataclass becomes one option per field, with the help from
    ``Attributes:`` of the class. A field with the name of one of the function's parameters becomes no option of its
    own.

    Every command except listing commands has the option ``-v``; without it, the output is shortened by
    `calib.cli.shared.printing`.

    Args:
        app: the Typer application.
        group: group of the command in the help, one of `calib.cli.help.GROUPS`.
        name: name of the command; None: the function's name.
        listing: whether the command prints a list, which is never shortened.
    """

    def add(function: F) -> F:
        hints = get_type_hints(function, include_extras=True)
        descriptions = described(Common) | described(function)
        parameters = signature(function).parameters
        settings = {
            key: hint
            for key, hint in hints.items()
            if key in parameters and isinstance(hint, type) and is_dataclass(hint)
        }
        options: list[Parameter] = []
        for key, parameter in parameters.items():
            if key in settings:
                options += [option for option in _options(settings[key]) if option.name not in parameters]
            elif key == "plots":
                options += _plots_options(descriptions)
            elif listing or key != "verbose":
                names = (f"--{key.replace('_', '-')}",) if parameter.default is False else ()
                annotation = _with_help(parameter, hints[key], descriptions.get(key, ""), names)
                options.append(parameter.replace(annotation=annotation, kind=Parameter.KEYWORD_ONLY))
        if not listing:
            verbose = Parameter("verbose", Parameter.KEYWORD_ONLY, default=False)
            annotation = _with_help(verbose, bool, descriptions["verbose"], ("-v", "--verbose"))
            options = [option for option in options if option.name != "verbose"]
            options.append(verbose.replace(annotation=annotation))

        @wraps(function)
        def call(**values: object) -> object:
            try:
                arguments = {key: _built(kind, values) for key, kind in settings.items()}
                with printing(bool(values.get("verbose", True))):
                    arguments |= {key: value for key, value in values.items() if key in parameters}
                    if "plots" in parameters:
                        arguments["plots"] = _plots(values)
                    return function(**arguments)
            except UsageError as error:
                error.args = (_as_typed(str(error), options),)
                raise

        call.__signature__ = signature(function).replace(parameters=options)  # ty: ignore[missing-attribute]
        call.__annotations__ = {}
        help_text = cleandoc(function.__doc__ or "").partition("\n\nArgs:\n")[0]
        app.command(name, cls=Command, help=help_text, rich_help_panel=group)(call)
        return function

    return add


class PlotFormat(StrEnum):
    """Formats of figures that are written as files."""

    PNG = "png"
    SVG = "svg"


def _plots_options(descriptions: Mapping[str, str]) -> Iterator[Parameter]:
    """Yield the options ``--plots`` and ``--no-plots`` of a command that has the parameter `plots`.

    Args:
        descriptions: name of a parameter -> its help.
    """
    file_format = typer.Option("--plots", metavar="png|svg", help=descriptions["plots"])
    kind = Annotated[PlotFormat | None, file_format]
    yield Parameter("plots", Parameter.KEYWORD_ONLY, default=None, annotation=kind)
    none = typer.Option("--no-plots", metavar=type_word(bool), help=descriptions["no_plots"])
    yield Parameter("no_plots", Parameter.KEYWORD_ONLY, default=False, annotation=Annotated[bool, none])


def _plots(values: Mapping[str, object]) -> Plots:
    """Return which figures a command writes.

    Args:
        values: the command line's values.

    Raises:
        UsageError: figures are asked for and left out.
    """
    asked = values["plots"]
    require(not (asked and values["no_plots"]), "--plots and --no-plots exclude each other", UsageError)
    if asked == PlotFormat.PNG:
        require(installed("matplotlib"), f"{lacking('matplotlib')}; without it: --plots svg", UsageError)
    if isinstance(asked, PlotFormat):
        return asked.value
    return not values["no_plots"]


def _with_help(parameter: Parameter, hint: object, description: str, names: Sequence[str]) -> object:
    """Return the annotation of a parameter for Typer, with help text and a word for the type of the value.

    Args:
        parameter: parameter of the command's function.
        hint: its type annotation.
        description: the help text.
        names: names of the option, such as ``--out``; empty: Typer's default.
    """
    kind, *metadata = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    stated = [item for item in metadata if isinstance(item, ParameterInfo)]
    if stated:
        option = copy(stated[0])
    elif parameter.default is Parameter.empty:
        option = typer.Argument()
    else:
        option = typer.Option(*names)
    option.help = option.help or description
    if not option.metavar:
        is_argument = isinstance(option, ArgumentInfo)
        option.metavar = parameter.name.upper() if is_argument else type_word(_plain(kind)[0])
    return Annotated[kind, option]  # ty: ignore[invalid-type-form]


def _options(kind: type) -> Iterator[Parameter]:
    """Yield the options of a settings dataclass, including those of nested settings dataclasses.

    Args:
        kind: the settings dataclass.
    """
    hints = get_type_hints(kind, include_extras=True)
    descriptions = described(kind)
    for field in fields(kind):  # ty: ignore[invalid-argument-type]
        if is_dataclass(hints[field.name]):
            yield from _options(hints[field.name])
            continue
        plain, metadata = _plain(hints[field.name])
        typed = _typed(metadata)
        choices = OneOf(())
        for item in metadata:
            if isinstance(item, OneOf):
                choices = item
                break
        names = [typed.name] if typed.name else []
        metavar = typed.unit.upper() or type_word(plain, choices.allowed)
        help_texts = [descriptions.get(field.name, "")]
        if metavar == "NAME":
            help_texts.append(choices.words)
        if get_origin(plain) is tuple:
            names = names or [f"--{field.name.removesuffix('s')}"]
            metavar = "TEXT" if _plain(get_args(plain)[0])[0] is str else "NUMBERS"
            plain = list[str] if _is_repeated(plain) else str
        elif typed.unit:
            plain = str
        complete = completion(choices) if choices.allowed else None
        help_text = "; ".join(filter(None, help_texts))
        option = typer.Option(*names, help=help_text, metavar=metavar, autocompletion=complete)
        default = field.default if isinstance(field.default, int | float | str) else None
        value_type = plain | None if default is None else plain
        yield Parameter(field.name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[value_type, option])  # ty: ignore[invalid-type-form]


def _typed(metadata: Sequence[object]) -> Typed:
    """Return how a setting is typed on the command line, from its annotation's metadata; or a default."""
    for item in metadata:
        if isinstance(item, Typed):
            return item
    return Typed()


def _as_typed(message: str, options: Sequence[Parameter]) -> str:
    """Return an error message whose first word, if it is the name of a parameter, is replaced by the option's name.

    ``sigmas: …`` or ``lock joint9: …`` then begin with ``--sigmas`` or ``--lock``. Other messages are unchanged.

    Args:
        message: the error message.
        options: the command's parameters.
    """
    match = re.match(r"\w+(?=:| \S+: )", message)
    if match is None:
        return message
    name, remainder = match[0], message[match.end() :]
    for parameter in options:
        option = parameter.annotation.__metadata__[0]
        declarations = (option.default, *(option.param_decls or ()))
        flags = [flag for flag in declarations if str(flag).startswith("--")]
        flag = flags[0].partition("/")[0] if flags else f"--{parameter.name.replace('_', '-')}"
        if isinstance(option, OptionInfo) and name in (parameter.name, flag[2:]):
            return f"{flag}{remainder}"
    return message


def _plain(hint: Any) -> tuple[Any, tuple[object, ...]]:
    """Return the type in the annotation `hint` without None, and the metadata of the annotation."""
    if get_origin(hint) is Annotated:
        plain, metadata = _plain(get_args(hint)[0])
        return plain, (*metadata, *hint.__metadata__)
    if get_origin(hint) in (Union, UnionType):
        kinds = [kind for kind in get_args(hint) if kind is not NoneType]
        return _plain(kinds[0])
    return hint, ()


def _is_repeated(plain: object) -> bool:
    """Return whether an option is repeated for each item of a list.

    A list of numbers is instead one comma-separated text.

    Args:
        plain: type of the option's value, without None.
    """
    first, last = get_args(plain)[0], get_args(plain)[-1]
    return last is ... and _plain(first)[0] is not float


def _built(kind: type[S], values: dict[str, object]) -> S:
    """Return a settings object with the values from the command line; missing values are the defaults.

    Args:
        kind: the settings dataclass.
        values: values of the command's options by parameter name.

    Raises:
        UsageError: for an invalid value.
    """
    chosen = _chosen(kind, values)
    if not chosen:
        return kind()
    try:
        return parse(kind, chosen, "")
    except UsageError as error:
        # Nested settings are options like the others.
        error.args = (re.sub(r"^(\w+\.)+", "", str(error)),)
        raise


def _chosen(kind: type, values: dict[str, object]) -> dict[str, object]:
    result = {}
    hints = get_type_hints(kind, include_extras=True)
    for field in fields(kind):  # ty: ignore[invalid-argument-type]
        if is_dataclass(hints[field.name]):
            value = _chosen(hints[field.name], values)
        else:
            value = values.get(field.name)
        if value not in (None, field.default, [], {}):
            result[field.name] = _read(hints[field.name], value)
    return result


def _read(hint: object, value: Any) -> object:
    """Return a value as it would be in an option file: comma-separated texts as lists, numbers with their unit.

    Args:
        hint: type annotation of the setting.
        value: value from the command line.
    """
    plain, metadata = _plain(hint)
    unit = _typed(metadata).unit
    if unit:
        return f"{value} {unit}"
    if get_origin(plain) is not tuple:
        return value
    if isinstance(value, str):
        return value.split(",")
    return [_read(get_args(plain)[0], item) for item in value]
