"""The exceptions of the toolkit: one root, and leaves that carry the data a caller needs.

Every message says what was found, where, and what to try. ``poses`` and ``trajectories`` import nothing from here and
raise their own subclasses of `ValueError`.
"""

from __future__ import annotations

import difflib
import shlex
import sys
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


class CalibError(Exception):
    """Root of all errors this toolkit raises on purpose."""


class UsageError(CalibError):
    """A command, an option or an options file that cannot be carried out as said."""


class RobotError(CalibError):
    """A robot description that cannot be read or does not hold together."""


class MeasurementError(CalibError):
    """Measured data that cannot be what they claim to be.

    Attributes:
        file, row, column: where it was found; ``row`` counts data rows from 1 (the header is not a row), None where
            the complaint is about the whole file.
    """

    def __init__(self, message: str, file: str | Path | None = None, row: int | None = None, column: str | None = None):
        self.file, self.row, self.column = file, row, column
        place = ", ".join(
            part
            for part in (
                str(file) if file else "",
                f"row {row}" if row is not None else "",
                f"column '{column}'" if column else "",
            )
            if part
        )
        super().__init__(f"{place}: {message}" if place else message)


class Unidentifiable(CalibError):
    """Parameters that the data cannot tell apart.

    Attributes:
        names: the parameters concerned.
        singular_values: of the column-scaled observation matrix, falling.
    """

    def __init__(self, message: str, names: Sequence[str] = (), singular_values: np.ndarray | None = None):
        self.names, self.singular_values = tuple(names), singular_values
        super().__init__(message)


class NotConverged(CalibError):
    """An iteration that stopped before its tolerance; ``last`` is its last estimate."""

    def __init__(self, message: str, last: object = None):
        self.last = last
        super().__init__(message)


class CannotSimulate(NotConverged):
    """Parameters of a robot that no simulation can follow, nor any near them."""


class Diverged(NotConverged):
    """An iteration whose estimates went from bad to worse."""


class TaskLost(CalibError):
    """A task of many whose worker process died, also when it was tried again; the others' results are good.

    Attributes:
        number: of the task, from 0.
        task: what the function was given.
    """

    def __init__(self, message: str, number: int = 0, task: object = None):
        self.number, self.task = number, task
        super().__init__(message)


class SessionError(CalibError):
    """A session folder that is busy, damaged, or not in the state a command needs."""


def command_line(*words: object, program: str = "calib") -> str:
    """Return a command as a shell takes it: ``calib next 'cell 7'``."""
    return shlex.join([program, *map(str, words)])


def suggestion(word: str, words: Collection[str]) -> str:
    """Return `` (did you mean '...'?)`` for the most similar of `words`, or nothing."""
    lower = {str(other).lower(): other for other in words}
    close = difflib.get_close_matches(word.lower(), lower, 1, 0.6)
    return f" (did you mean '{lower[close[0]]}'?)" if close else ""


@contextmanager
def as_ours() -> Iterator[None]:
    """Raise what ``poses`` and ``trajectories`` refuse as errors of this toolkit, the original as their cause."""
    try:
        yield
    except ValueError as error:
        code = exit_code(error)
        if code is None:
            raise
        raise (Unidentifiable if code == 3 else UsageError)(str(error)) from error


def exit_code(error: Exception) -> int | None:
    """Return the exit code of an error raised on purpose, 2 or 3 (not identifiable, not converged); None for others."""
    if isinstance(error, (NotConverged, Unidentifiable)):
        return 3
    if isinstance(error, CalibError):
        return 2
    module = sys.modules.get("poses.errors")
    if module is not None and isinstance(error, module.NotIdentifiable):
        return 3
    return 2 if type(error).__module__.split(".")[0] in ("poses", "trajectories") else None
