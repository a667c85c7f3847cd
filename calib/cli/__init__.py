"""The command ``calib``: commands only, no mathematics. Exit codes: 0 done (the verdict is pass or marginal), 1 done
but the verdict is fail, 2 input or usage, 3 not identifiable or not converged, 4 an internal error (what is
needed to mend it stands in a file, see `calib.bug_reports`), 130 interrupted."""

import codecs
import gc
import io
import os
import signal
import sys
import warnings
from functools import lru_cache
from typing import Annotated, Any

import typer
from typer.main import get_command

import calib
from calib.cli import dynamics, geometry, session
from calib.cli.help import Group, spelt
from calib.extensions import Point
from calib.workers.threads import limit_process

COMMANDS: Point[typer.Typer] = Point("commands", "commands of calib, one Typer application")

# a command makes a million objects as it loads and hardly a cycle: walking all of them again and again for garbage was
# 6 % of its time (numbers of new objects, of young and of middle-aged collections; Python's own are 700, 10, 10)
GARBAGE = (20_000, 10, 10)

EXIT_CODES = (
    "Exit codes: 0 done (the verdict is pass or marginal), 1 the verdict is fail, 2 input or usage, 3 not identifiable "
    "or not converged, 4 an internal error: details in calib-bug-….txt."
)
BEGIN = "Begin with calib demo; at a robot with calib new CELL, then calib next CELL. calib COMMAND --help: an example."
INTERRUPTED = "interrupted; no incomplete files were left"
RESUMED = ("next", "redo", "demo", "study")  # keep what they have done; every other command starts over

app = typer.Typer(
    cls=Group,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # a unit in brackets is a unit, not a style
    help="Calibrate a robot's geometry, then its dynamics: choose poses and motions, fit, validate, export.",
    epilog=f"{BEGIN}\n\n{EXIT_CODES}",
)

_USAGE: Any = typer.BadParameter.__mro__[2]  # ClickException, of the click that this typer uses (or brings)

codecs.register_error("spelt", spelt)


def _show_version(wanted: bool) -> None:
    if wanted:
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
    """Run the command line and exit with one of the codes above."""
    gc.set_threshold(*GARBAGE)
    if arguments is None:  # the process is this command's
        limit_process()
    if not os.environ.get("CALIB_DEBUG"):  # what numpy and others say to programmers helps nobody at a cell
        warnings.filterwarnings("ignore")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="spelt")
    try:
        code = run(arguments)
    except KeyboardInterrupt:  # one more, while the first was being seen to
        code = 130
    if arguments is None:  # the process is this command's: a third would end as a signal what is over but for the exit
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.exit(code)


@lru_cache(maxsize=1)
def command_tree() -> Any:
    """Return the Typer commands, built once per process from the functions' signatures."""
    for commands in (*COMMANDS.all(), geometry.app, dynamics.app, session.app):  # in the order of the help
        app.add_typer(commands)
    return get_command(app)


def run(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code; errors become one message on stderr."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    for before, word in zip(["calib", *given], given):
        if word.encode(errors="ignore").decode() != word or not word:
            what = "is not UTF-8; rename the file" if word else "is empty; leave the option out, or give it a value"
            return _complain(f"the argument after {before} {what}", 2)
    try:
        code = int(command_tree()(args=_spread(given), prog_name="calib", standalone_mode=False) or 0)
        return _interrupted(given) if code == 130 else code  # Typer turns Ctrl-C into this code
    except typer.Exit as stop:
        return stop.exit_code
    except _USAGE as error:
        error.show()
        return 2
    except (KeyboardInterrupt, typer.Abort):
        return _interrupted(given)
    except SystemExit as stop:  # Typer's: completion is done, or whoever read the output has gone
        return 141 if stop.code else 0  # as a shell says of SIGPIPE
    except Exception as error:
        if os.environ.get("CALIB_DEBUG"):
            raise
        return _failed(error, given)


def _failed(error: Exception, given: list[str]) -> int:
    """Print the error, and return its exit code."""
    from calib import bug_reports
    from calib.errors import complaint

    if (foreseen := complaint(error, given)) is not None:
        return _complain(*foreseen)

    return _complain(bug_reports.report(error, given), bug_reports.CODE)


def _spread(arguments: list[str]) -> list[str]:
    """Return the arguments with ``--validate a b`` expanded to ``--validate a --validate b``.

    Only where ROBOT and MEASURED have come before: what follows --validate then cannot be one of them.
    """
    command = next((word for word in arguments[:2] if word in ("fit", "identify", "compare")), None)
    if command is None:
        return arguments
    known = [*command_tree().params, *command_tree().commands[command].params]
    flags = [name for one in known if getattr(one, "is_flag", False) for name in (*one.opts, *one.secondary_opts)]
    result: list[str] = []
    option, positionals, spreading = "", 0, False
    for word in arguments:
        if word.startswith("--") or word in flags:
            option = "" if word in (*flags, "--help") or "=" in word else word
            spreading = False
        elif option:
            spreading = option == "--validate" and positionals > 2  # the command itself, ROBOT, MEASURED
            option = ""
        elif spreading:
            result.append("--validate")
        else:
            positionals += 1
        result.append(word)
    return result


def _interrupted(given: list[str]) -> int:
    resumed = bool(set(RESUMED) & set(given[:2]))
    return _complain(f"{INTERRUPTED}; the same command {'goes on from here' if resumed else 'starts over'}", 130)


def _complain(message: str, code: int) -> int:
    print(f"calib: {message}", file=sys.stderr)
    return code
