"""What every command prints by default: at most 25 lines besides warnings and verdicts; the rest with -v."""

import typer
from rich.table import Table

from calib.cli import _command
from calib.cli.shared import MAX_LINES, command, say

LISTINGS = {"formats", "explain"}  # what they print is what was asked for


def test_every_command_has_the_option():
    commands = _command().commands
    with_it = {name for name, one in commands.items() if any("-v" in option.opts for option in one.params)}
    assert with_it == set(commands) - LISTINGS


def test_without_it_details_go_and_warnings_stay(capsys):
    app = typer.Typer()

    @command(app)
    def talk() -> None:
        """Print much."""
        table = Table("a")
        table.add_row("cell")
        say(table, "  detail", *(f"line {k}" for k in range(40)), "    warning: hot", "verdict: fail", "written to x")

    app(["-v"], standalone_mode=False)
    whole = capsys.readouterr().out.splitlines()
    app([], standalone_mode=False)
    *lines, last = capsys.readouterr().out.splitlines()
    assert len(whole) > 44 and "cell" in " ".join(whole) and "  detail" in whole
    assert len(lines) == MAX_LINES + 2 and last == f"… {41 - MAX_LINES + 2} more lines with -v"
    assert lines[0] == "line 0" and lines[-3:] == ["    warning: hot", "verdict: fail", "written to x"]
