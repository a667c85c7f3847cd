"""The command ``calib``: definition of the command line; the mathematics is in other packages.

Exit codes: 0 done (the verdict is pass or marginal), 1 done but the verdict is fail, 2 wrong input or usage, 3 not
identifiable or not converged, 4 an internal error (a file contains what is needed for its correction, see
`calib.bug_reports`), 130 interrupted, 143 terminated (SIGTERM).
"""

import codecs
import gc
import io
import os
import sys
import warnings
from functools import lru_cache
from typing import Annotated, Any

import typer
from typer.main import get_command

import calib
from calib.cli import dynamics, geometry, session, signals
from calib.cli.help import CommandGroup, spelt
from calib.cli.signals import INTERRUPTED_CODE, TERMINATED_CODE
from calib.extensions import Point
from calib.workers.threads import limit_process

COMMANDS: Point[typer.Typer] = Point("commands", "commands of calib, one Typer application")

# A command makes a million objects as it loads and hardly a cycle: walking all of them again and again for garbage was
# 6 % of its time (numbers of new objects, of young and of middle-aged collections; Python's own are 700, 10, 10).
GARBAGE = (20_000, 10, 10)

EXIT_CODES = (
    "Exit codes: 0 done (the verdict is pass or marginal), 1 the verdict is fail, 2 input or usage, 3 not identifiable "
    "or not converged, 4 an internal error: details in calib-bug-….txt."
)
BEGIN = "Begin with calib demo; at a robot with calib new CELL, then calib next CELL. calib COMMAND --help: an example."
INTERRUPTED = "interrupted; no incomplete files were left"
# These commands keep what they have done, and how they go on; every other one starts over.
GOES_ON = "the same command goes on from here"
RESUMED = {
    "next": GOES_ON,
    "redo": GOES_ON,
    "study": GOES_ON,
    "demo": "calib next FOLDER goes on from here; calib demo --bring FOLDER simulates the files that it asks for",
}
# Exit code of a command whose output nobody reads, as a shell says of SIGPIPE.
BROKEN_PIPE_CODE = 141

app = typer.Typer(
    cls=CommandGroup,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # a unit in brackets is a unit, not a style
    help="Calibrate a robot's geometry, then its dynamics: choose poses and motions, fit, validate, export.",
    epilog=f"{BEGIN}\n\n{EXIT_CODES}",
)

_USAGE: Any = typer.BadParameter.__mro__[2]  # ClickException, of the click that this typer uses (or brings)

codecs.register_error("spelt", spelt)


def _show_version(is_on: bool) -> None:
    if is_on:
        print(f"calib {calib.__version__}")
        raise typer.Exit


@app.callback()
def options(
    debug: Annotated[bool, typer.Option("--debug", help="show tracebacks (or set CALIB_DEBUG)")] = False,
    version: Annotated[bool, typer.Option("--version", help="print the version", callback=_show_version)] = False,
) -> None:
    if debug:
        os.environ["CALIB_DEBUG"] = "1"


def main(arguments: list[str] | None = None) -> None:
    """Run the command line, and exit with one of the exit codes that the module's docstring lists.

    Args:
        arguments: arguments of the command line; None: those of this process.
    """
    owns_process = arguments is None
    gc.set_threshold(*GARBAGE)
    if owns_process:
        limit_process()
        signals.hear()
    # What numpy and others say to programmers helps nobody at a cell.
    if not os.environ.get("CALIB_DEBUG"):
        warnings.filterwarnings("ignore")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="spelt")
    try:
        code = run(arguments)
    except KeyboardInterrupt:
        # A second one, while the first was being handled.
        code = INTERRUPTED_CODE
    # A third would end as a signal what is over but for the exit.
    if owns_process:
        signals.ignore()
    sys.exit(code)


@lru_cache(maxsize=1)
def command_tree() -> Any:
    """Return the tree of Typer commands, built once per process from the signatures of the commands' functions."""
    for commands in (*COMMANDS.all(), geometry.app, dynamics.app, session.app):  # in the order of the help
        app.add_typer(commands)
    return get_command(app)


def run(arguments: list[str] | None = None) -> int:
    """Run the command line and return the exit code; an error is printed as one message on stderr.

    Args:
        arguments: arguments of the command line; None: those of this process.
    """
    if arguments is None:
        arguments = sys.argv[1:]
    arguments = list(arguments)
    for before, argument in zip(["calib", *arguments], arguments):
        if not argument:
            return _complain(f"the argument after {before} is empty; leave the option out, or give it a value", 2)
        if argument.encode(errors="ignore").decode() != argument:
            return _complain(f"the argument after {before} is not UTF-8; rename the file", 2)
    try:
        code = int(command_tree()(args=_spread(arguments), prog_name="calib", standalone_mode=False) or 0)
        # Typer turns Ctrl-C into this code.
        return _interrupted(arguments) if code == INTERRUPTED_CODE else code
    except typer.Exit as stop:
        return stop.exit_code
    except _USAGE as error:
        error.show()
        return 2
    except (KeyboardInterrupt, typer.Abort):
        return _interrupted(arguments)
    except SystemExit as stop:  # terminated, or Typer's: completion is done, or the output's reader has gone
        if stop.code == TERMINATED_CODE:
            return _interrupted(arguments, TERMINATED_CODE)
        return BROKEN_PIPE_CODE if stop.code else 0
    except Exception as error:
        if os.environ.get("CALIB_DEBUG"):
            raise
        return _failed(error, arguments)


def _failed(error: Exception, arguments: list[str]) -> int:
    """Print an error, write a bug report if it is an internal error, and return the exit code.

    Args:
        error: the exception that ended the command.
        arguments: arguments of the command line, for the message and the bug report.
    """
    from calib import bug_reports
    from calib.errors import complaint

    expected = complaint(error, arguments)
    if expected is not None:
        message, code = expected
        return _complain(message, code)
    if signals.received:
        # a library lost the signal in a callback, and failed for that
        return _interrupted(arguments, signals.received[-1])
    return _complain(bug_reports.report(error, arguments), bug_reports.CODE)


def _spread(arguments: list[str]) -> list[str]:
    """Return the arguments of the command line with ``--validate a b`` expanded to ``--validate a --validate b``.

    The expansion is made only if --validate is after ROBOT and MEASURED, since the texts after --validate could
    otherwise be these two arguments.
    """
    commands = [argument for argument in arguments[:2] if argument in ("fit", "identify", "compare")]
    if not commands:
        return arguments
    flags: list[str] = []
    for parameter in (*command_tree().params, *command_tree().commands[commands[0]].params):
        if getattr(parameter, "is_flag", False):
            flags += [*parameter.opts, *parameter.secondary_opts]
    result: list[str] = []
    option, positional_count, spreading = "", 0, False
    for argument in arguments:
        if argument.startswith("--") or argument in flags:
            takes_value = argument not in (*flags, "--help") and "=" not in argument
            option = argument if takes_value else ""
            spreading = False
        elif option:
            # The command itself, ROBOT and MEASURED have come.
            spreading = option == "--validate" and positional_count > 2
            option = ""
        elif spreading:
            result.append("--validate")
        else:
            positional_count += 1
        result.append(argument)
    return result


def _interrupted(arguments: list[str], code: int = INTERRUPTED_CODE) -> int:
    signals.stop_repeating()
    outcome = "the same command starts over"
    for word in arguments[:2]:
        outcome = RESUMED.get(word, outcome)
    return _complain(f"{INTERRUPTED}; {outcome}", code)


def _complain(message: str, code: int) -> int:
    print(f"calib: {message}", file=sys.stderr)
    return code
