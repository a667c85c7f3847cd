"""Exceptions of the toolkit, and findings: one base class, and subclasses with the data that a caller needs.

Every message states what was found, where, and what to try. The packages ``poses`` and ``trajectories`` do not import
this module, and raise their own subclasses of `ValueError`. The module also has functions for short texts in messages:
lists, counts, commands.
"""

from __future__ import annotations

import difflib
import errno
import os
import re
import shlex
import sys
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

if TYPE_CHECKING:
    import numpy as np

T = TypeVar("T")
# Errors of writing that do not depend on the file, such as a full disk.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)
# Smallest similarity (0 to 1) of a name that is suggested.
SIMILAR = 0.6
# Exit codes for wrong input, and for data that do not determine a result.
USAGE_CODE = 2
NO_RESULT_CODE = 3


@dataclass(frozen=True)
class Finding:
    """An observation about data or a result; its text is in the catalogue ``calib/procedure/findings.toml``.

    Attributes:
        code: code of the finding in the catalogue.
        values: values for its sentence and its limits [SI], of types that JSON has.
        accepted: True where the options state that the finding is intended.
    """

    code: str
    values: Mapping[str, Any] = field(default_factory=dict)
    accepted: bool = False


def finding(code: str, **values: object) -> Finding:
    """Return a finding with plain values: numpy numbers are converted to Python's, sequences to tuples."""
    return Finding(code, {name: _plain(value) for name, value in values.items()})


def _plain(value: object) -> object:
    to_list = getattr(value, "tolist", None)
    if to_list is not None:
        value = to_list()
    return tuple(value) if isinstance(value, list) else value


class CalibError(Exception):
    """Base class of all errors that the toolkit raises for wrong input or data."""


class CalibWarning(UserWarning):
    """A warning about a result, which is shown even where other warnings are hidden."""


class UsageError(CalibError):
    """Raised for a wrong or contradictory command, option or options file."""


class RobotError(CalibError):
    """Raised for a robot description that is unreadable or inconsistent."""


class NoPosture(CalibError):
    """Raised where a parallel robot's loops do not close, or its posture is singular.

    Attributes:
        samples: indices of the samples concerned, from 0.
    """

    def __init__(self, message: str, samples: Sequence[int] = ()):
        self.samples = tuple(samples)
        super().__init__(message)


class MeasurementError(CalibError):
    """Raised for measured data that contradict their description (columns, units, robot).

    Attributes:
        file, row, column: location of the contradiction. ``row`` counts data rows from 1, without the header; it is
            None where the message concerns the whole file.
    """

    def __init__(self, message: str, file: str | Path | None = None, row: int | None = None, column: str | None = None):
        self.file, self.row, self.column = file, row, column
        location = []
        if file:
            location.append(str(file))
        if row is not None:
            location.append(f"row {row}")
        if column:
            location.append(f"column '{column}'")
        if location:
            message = f"{', '.join(location)}: {message}"
        super().__init__(message)


class Unidentifiable(CalibError):
    """Raised where the data do not identify all parameters.

    Attributes:
        names: names of the parameters concerned.
        singular_values: singular values of the column-scaled observation matrix, largest first; None where they are not
            known.
    """

    def __init__(self, message: str, names: Sequence[str] = (), singular_values: np.ndarray | None = None):
        self.names, self.singular_values = tuple(names), singular_values
        super().__init__(message)


class NotConverged(CalibError):
    """Raised where an iteration stopped before it reached its tolerance.

    Attributes:
        last: last estimate of the iteration.
    """

    def __init__(self, message: str, last: object = None):
        self.last = last
        super().__init__(message)


class CannotSimulate(NotConverged):
    """Raised for robot parameters that cannot be simulated, where no parameters near them can be simulated either."""


class Diverged(NotConverged):
    """Raised where the estimates of an iteration diverged."""


class TaskLost(CalibError):
    """Raised for a task whose worker process died at every attempt; the results of the other tasks are valid.

    Attributes:
        number: number of the task, from 0.
        task: argument of the task's function.
    """

    def __init__(self, message: str, number: int = 0, task: object = None):
        self.number, self.task = number, task
        super().__init__(message)


class SessionError(CalibError):
    """Raised for a session folder that is locked, damaged, or in the wrong state for a command."""


class Busy(SessionError):
    """Raised for a session folder that another command is using."""


def require(holds: object, message: str, kind: type[Exception] = CalibError, *details: object) -> None:
    """Raise `kind(message, *details)` if the condition `holds` is false."""
    if not holds:
        raise kind(message, *details)


def refuse_robot(where: object, message: str) -> NoReturn:
    """Raise `RobotError` for an error in a robot's description; `where` is a file, a line, a joint or a row."""
    raise RobotError(f"{where}: {message}")


def refuse_data(file: str | Path, message: str, column: str | None = None, row: int | None = None) -> NoReturn:
    """Raise `MeasurementError` for a file or block of measured data, with its column and row (from 1) if given."""
    raise MeasurementError(message, file, row, column)


def refuse_option(where: object, message: str) -> NoReturn:
    """Raise `UsageError` for an option, a command or an options file, named by `where`."""
    raise UsageError(f"{where}: {message}")


def one_of(name: T, choices: Collection[str], role: str, kind: type[Exception] = CalibError, *details: object) -> T:
    """Return `name` if it is one of `choices`, else raise ``role 'name' is not one of ... (did you mean ...?)``."""
    if name not in choices:
        raise kind(f"{role} '{name}' is not one of {', '.join(choices)}{suggestion(str(name), choices)}", *details)
    return name


@contextmanager
def refused_as(
    kind: type[Exception], kinds: type[BaseException] | tuple[type[BaseException], ...], message: str, *details: object
) -> Iterator[None]:
    """Convert exceptions of the classes `kinds` raised in the block to `kind(message, *details)`.

    ``{}`` in `message` is replaced by the original message. For an error of the operating system, this is its reason
    without the file name, which `details` or `message` contain.
    """
    try:
        yield
    except kinds as error:
        # Of all exceptions, those of this toolkit have their message already.
        if kinds is Exception and isinstance(error, CalibError):
            raise
        reason = getattr(error, "strerror", None)
        if isinstance(error, KeyError):
            reason = f"no entry {error}"
        elif not reason and kinds is Exception:
            reason = brief(error)
        elif not reason:
            reason = str(error)
        raise kind(message.replace("{}", str(reason)), *details) from error


def command_line(*arguments: object, program: str = "calib") -> str:
    """Return a command quoted for a shell: ``calib next 'cell 7'``; on Windows ``calib next "cell 7"``."""
    words = [program, *map(str, arguments)]
    if sys.platform == "win32":
        from subprocess import list2cmdline

        return list2cmdline(words)
    return shlex.join(words)


def brief(error: BaseException, max_length: int = 200) -> str:
    """Return the message of an error in one line of at most `max_length` characters."""
    message = " ".join(str(error).split())
    if len(message) <= max_length:
        return message
    return f"{message[:max_length]}…"


def suggestion(name: str, choices: Collection[str]) -> str:
    """Return `` (did you mean '...'?)`` with the most similar of `choices`; "" if none is similar."""
    by_lower_case = {str(choice).lower(): choice for choice in choices}
    similar = difflib.get_close_matches(name.lower(), by_lower_case, 1, SIMILAR)
    if not similar:
        return ""
    return f" (did you mean '{by_lower_case[similar[0]]}'?)"


def listing(names: Iterable[object], max_names: int = 12) -> str:
    """Return the first `max_names` names separated by commas, and the number of the others."""
    texts = [str(name) for name in names]
    result = ", ".join(texts[:max_names])
    if len(texts) > max_names:
        result += f" and {len(texts) - max_names} more"
    return result


def counted(number: int, noun: str, plural: str = "") -> str:
    """Return a count with its noun, such as ``1 pose`` or ``3 poses``.

    `plural` is needed for nouns whose plural is not formed with s.
    """
    if number != 1:
        noun = plural or f"{noun}s"
    return f"{number} {noun}"


@contextmanager
def as_ours() -> Iterator[None]:
    """Convert errors of ``poses`` and ``trajectories`` in the block to errors of this toolkit.

    The original error is kept as the cause.
    """
    try:
        yield
    except ValueError as error:
        code = exit_code(error)
        if code is None:
            raise
        if code == NO_RESULT_CODE:
            raise Unidentifiable(str(error)) from error
        raise UsageError(str(error)) from error


def complaint(error: Exception, arguments: Iterable[str] = ()) -> tuple[str, int] | None:
    """Return message and exit code of an expected error; None for an internal error.

    Expected errors are those of this toolkit, those of the operating system for a named file or a full disk, and lack
    of memory.

    Args:
        error: the error.
        arguments: arguments of the command; for lack of memory, the message names the largest file among them.
    """
    code = exit_code(error)
    if code is not None:
        return str(error), code
    memory_error = _lack_of_memory(error)
    if memory_error:
        names = [argument.partition("@")[0] for argument in arguments]
        largest = max(filter(os.path.isfile, names), key=os.path.getsize, default="")
        message = ": ".join(filter(None, [largest, "not enough memory", brief(memory_error)]))
        remedy = "of a long recording use fewer samples ([recording] samples = 100000 in the options); otherwise check"
        return f"{message}; {remedy} whether a number or a file is larger than intended", USAGE_CODE
    if isinstance(error, OSError) and (error.filename is not None or error.errno in NO_ROOM):
        reason = str(error.strerror or error)
        if error.filename is not None:
            reason = f"{error.filename}: {reason}"
        return reason, USAGE_CODE
    return None


def _lack_of_memory(error: BaseException | None) -> BaseException | None:
    """Return the error, or the one that caused it, that reports a lack of memory (also when loading a library).

    None if there is no such error.
    """
    while error and not (isinstance(error, MemoryError) or re.search("map segment|allocate memory", str(error))):
        error = error.__cause__ or error.__context__
    return error


@contextmanager
def quiet() -> Iterator[None]:
    """Hide warnings of numpy, scipy, matplotlib and other libraries in the block; show `CalibWarning` at its end.

    With the environment variable CALIB_DEBUG all warnings are shown.
    """
    if os.environ.get("CALIB_DEBUG"):
        yield
        return
    with warnings.catch_warnings(record=True, action="ignore") as caught:
        warnings.simplefilter("always", CalibWarning)
        yield
    # Levels: here, contextlib, what `quiet` is around, whoever called that.
    for warning in caught:
        warnings.warn(warning.message, stacklevel=4)


def exit_code(error: Exception) -> int | None:
    """Return the exit code of an error of this toolkit; None for any other error.

    It is 3 where data are not identifiable or a fit did not converge, else 2.
    """
    if isinstance(error, (NotConverged, Unidentifiable)):
        return NO_RESULT_CODE
    if isinstance(error, CalibError):
        return USAGE_CODE
    module = sys.modules.get("calib.poses.errors")
    if module is not None and isinstance(error, module.NotIdentifiable):
        return NO_RESULT_CODE
    package = type(error).__module__
    return USAGE_CODE if package.startswith(("calib.poses.", "calib.trajectories.")) else None
