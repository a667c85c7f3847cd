"""Sweeps in memory: one function of this API, many settings, one data set, a table of what comes out."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from inspect import signature
from itertools import product
from numbers import Real
from typing import Protocol, TypeVar, get_args, get_type_hints

from calib.api.result_table import ResultTable
from calib.arguments import checked
from calib.errors import CalibError, UsageError, brief, refused_as, require
from calib.workers.threads import one_blas_thread


class Summarised(Protocol):
    """A result with figures."""

    def to_dict(self) -> dict[str, object]:
        """Return the figures of the result by name; values may be nested."""
        ...


R = TypeVar("R", bound=Summarised)
Over = Mapping[str, Sequence[object]] | Sequence[Mapping[str, object]]
"""Values by name, of which all combinations run; or one mapping for each run."""
Figures = Callable[[R], Mapping[str, object]]
# Columns of a sweep beside those that vary and the figures.
VERDICT, ERROR = "verdict", "error"
# Numbers of ``to_dict`` that are no figures of a result.
NO_FIGURES = ("schema",)


@dataclass(frozen=True, eq=False)
class _Task:
    """One run of a sweep: what is called with what, and what it is called with in the table."""

    verb: Callable[..., Summarised]
    arguments: tuple[object, ...]
    options: Mapping[str, object]
    figures: Callable[..., Mapping[str, object]] | None
    varied: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _Row:
    """The cells of a run's row by column, and whether they are of the user's function `figures`."""

    cells: Mapping[str, object]
    chosen: bool = False


@checked
def sweep(
    verb: Callable[..., R],
    *arguments: object,
    over: Over,
    figures: Figures[R] | None = None,
    workers: str | int = 1,
    progress: Callable[[str], None] | None = None,
    **options: object,
) -> ResultTable:
    """Return a table with one row for each run of a function with other settings on the same data.

        table = calib.sweep(calib.fit_geometry, robot, measured, over={"loss": ["none", "huber"], "model": MODELS})
        table["verdict"], table["findings.cross_validated"]

    A run that fails, whatever it raises, has the reason in the column ``error``, and NaN in the others. No files are
    written.

    Args:
        verb: `fit_geometry`, `identify_dynamics`, `select_poses`, or any function whose result has ``to_dict``.
        arguments, options: what every call is given; measurements are read once where they are given in memory
            (`read_poses`, `read_recording`).
        over: what varies: fields of the verb's settings, or arguments of the verb itself. A mapping of names to values
            stands for all combinations of them, a sequence of mappings for one run each.
        figures: function of a result that returns the columns of its row, a mapping of names to numbers or texts, by
            other names than ``error`` and those that vary; None: the verdict and all single numbers of ``to_dict``,
            with names such as ``fit.parameters``.
        workers: number of local processes, or the address of a Dask scheduler. With several, functions must be defined
            at the top of a module, and the script needs ``if __name__ == "__main__"``.
        progress: called with a text for each finished run; None for no report.

    Raises:
        UsageError: a name that is neither a setting nor an argument, a wrong value, figures that are no columns, or
            what processes cannot be sent.
    """
    from calib.workers import workers as opened

    runs = _runs(over)
    tasks = [_task(verb, arguments, options, run, figures) for run in runs]
    if workers != 1:
        with refused_as(UsageError, (pickle.PicklingError, AttributeError, TypeError), _UNSENT):
            pickle.dumps(tasks[0])
    results: list[Mapping[str, object]] = [{}] * len(tasks)
    with opened(workers) as crew:
        for finished, (number, result) in enumerate(crew.completed(_row, tasks), 1):
            if isinstance(result, _Row):
                if result.chosen:
                    _check_figures(result.cells, tasks[number].varied)
                results[number] = result.cells
            else:
                results[number] = {ERROR: str(result)}
            if progress is not None:
                progress(f"run {finished} of {len(tasks)}")
    return _table(tasks, results)


_UNSENT = "workers: {}: define functions at the top of a module, or leave workers = 1"


def _runs(over: Over) -> list[dict[str, object]]:
    """Return what each run varies, by name."""
    if not isinstance(over, Mapping):
        runs = list(map(dict, over))
    else:
        for name, values in over.items():
            is_several = isinstance(values, Sequence) and not isinstance(values, str)
            require(is_several, f"over: {name}: expected several values in a list, found {values!r}", UsageError)
        runs = []
        for values in product(*over.values()):
            runs.append(dict(zip(over, values)))
    require(len(over) > 0 and len(runs) > 0, "over: nothing to run: give one value or more for each name", UsageError)
    return runs  # ty: ignore[invalid-explicit-return]


def _task(
    verb: Callable[..., Summarised],
    arguments: tuple[object, ...],
    options: Mapping[str, object],
    varied: Mapping[str, object],
    figures: Callable[..., Mapping[str, object]] | None,
) -> _Task:
    """Return a run's call: settings with its values, other names as arguments of the verb.

    Raises:
        UsageError: a name that is neither, or a value that the settings refuse.
    """
    parameters = signature(verb).parameters
    kind = _settings_class(verb)
    setting_names: set[str] = set()
    if kind is not None:
        setting_names.update(entry.name for entry in fields(kind))  # ty: ignore[invalid-argument-type]
    call_options = dict(options)
    changes: dict[str, object] = {}
    for name, value in varied.items():
        if name in setting_names and not (callable(value) and name in parameters):
            changes[name] = value
        elif name in parameters:
            call_options[name] = value
        else:
            names = ", ".join(sorted({*setting_names, *parameters}))
            raise UsageError(f"over: '{name}' is neither a setting nor an argument of {verb.__name__}: {names}")  # ty: ignore[missing-attribute]
    if changes and kind is not None:
        base = call_options.get("settings")
        positional = list(parameters).index("settings") < len(arguments)
        require(not positional, "settings: give them by name: settings=…", UsageError)
        if base is None:
            base = kind()
        call_options["settings"] = replace(base, **changes)  # ty: ignore[invalid-argument-type]
    return _Task(verb, arguments, call_options, figures, varied)


def _settings_class(verb: Callable[..., object]) -> type | None:
    """Return the class of a function's argument `settings`; None if it has none."""
    if "settings" not in signature(verb).parameters:
        return None
    hint = get_type_hints(verb)["settings"]
    kinds = get_args(hint) or (hint,)
    for kind in kinds:
        if isinstance(kind, type) and is_dataclass(kind):
            return kind
    return None


@one_blas_thread()
def _row(task: _Task) -> _Row:
    """Run a task and return the figures of its result, or its error."""
    # whatever a run raises, the others go on
    try:
        result = task.verb(*task.arguments, **task.options)
        if task.figures is None:
            return _Row(_all_numbers(result))
    except Exception as error:
        return _Row({ERROR: _reason(error)})
    try:
        return _Row(task.figures(result), chosen=True)
    except Exception as error:
        return _Row({ERROR: f"figures: {_reason(error)}"})


def _all_numbers(result: Summarised) -> Mapping[str, object]:
    """Return the verdict of a result, where it has one, and all its single numbers, by name."""
    numbers = dict(_numbers(result.to_dict()))
    verdict = getattr(result, "verdict", None)
    if verdict is None:
        return numbers
    return {VERDICT: verdict.level, **numbers}


def _reason(error: Exception) -> str:
    """Return an error as a cell: its message, after the name of its class where it is no error of this toolkit."""
    if isinstance(error, CalibError):
        return brief(error)
    return f"{type(error).__name__}: {brief(error)}"


def _check_figures(cells: object, varied: Mapping[str, object]) -> None:
    """Raise an error for figures that are no columns of the table.

    Args:
        cells: what the user's function returned.
        varied: what varies, by name.

    Raises:
        UsageError: no mapping, a name that the table has otherwise, or a value other than a number or a text.
    """
    kind = type(cells).__name__
    is_mapping = isinstance(cells, Mapping)
    require(is_mapping, f"figures: expected a mapping of names to numbers or texts, found {kind}", UsageError)
    for name, value in dict(cells).items():  # ty: ignore[no-matching-overload]
        require(isinstance(name, str), f"figures: expected names as texts, found {name!r}", UsageError)
        is_free = name != ERROR and name not in varied
        require(is_free, f"figures: '{name}' is a column of the sweep itself: choose another name", UsageError)
        is_cell = value is None or isinstance(value, (Real, str))
        message = f"figures: {name}: expected a number or a text, found {type(value).__name__}"
        require(is_cell, message, UsageError)


def _numbers(values: Mapping[str, object], start: str = "") -> Iterator[tuple[str, float]]:
    """Yield names and values of all single numbers in nested mappings; names are joined by points."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _numbers(value, f"{start}{name}.")
        elif isinstance(value, (int, float)) and name not in NO_FIGURES:
            yield start + name, float(value)


def _table(tasks: Sequence[_Task], results: Sequence[Mapping[str, object]]) -> ResultTable:
    """Return the table of the runs: what varied, figures in the order of their first run, and errors."""
    varied: dict[str, None] = {}
    names: dict[str, None] = {}
    for task, result in zip(tasks, results, strict=True):
        varied.update(dict.fromkeys(task.varied))
        names.update(dict.fromkeys(result))
    names.pop(ERROR, None)
    rows = []
    for task, result in zip(tasks, results, strict=True):
        row = [_label(task.varied.get(name)) for name in varied]
        row += [result.get(name) for name in names]
        rows.append([*row, result.get(ERROR, "")])
    titles = []
    for name in varied:
        # the result has a figure of the same name
        if name in names:
            name = f"{name} (set)"
        titles.append(name)
    return ResultTable.of_rows(rows, [*titles, *names, ERROR])


def _label(value: object) -> object:
    """Return a varied value as a cell: numbers and texts unchanged, functions by name, all else as text."""
    if isinstance(value, (int, float, str)) and not isinstance(value, bool):
        return value
    return getattr(value, "__name__", "") or str(value)
