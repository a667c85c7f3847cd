"""What every command prints by default: at most 25 lines besides warnings and verdicts; the rest with -v."""

import pytest
import typer
from rich.table import Table

from calib.cli import command_tree
from calib.cli.shared import MAX_LINES, command, say

LISTINGS = {"docs", "formats", "explain"}  # what they print is what was asked for


def test_every_command_has_the_option():
    commands = command_tree().commands
    with_it = {name for name, one in commands.items() if any("-v" in option.opts for option in one.params)}
    assert with_it == set(commands) - LISTINGS


def test_quiet_console_drops_details_only(capsys):
    """Without ``-v`` details go, and warnings stay."""
    app = typer.Typer()

    @command(app, "Start")
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


@pytest.mark.parametrize(
    ("typed", "begins"),
    [
        ("select ur5 --out p.csv --sigma abc", "--sigma: cannot read 'abc'"),
        ("select ur5 --out p.csv --tool 1,2", "--tool: expected x,y,z [m]"),
        ("select ur5 --out p.csv --speed 2", "--speed: expected a number, at most 1"),
        ("select ur5 --out p.csv --without foo", "--without foo: expected one of"),
        ("excite ur5 --out o --rate 1e12", "--rate: expected a number [Hz], at most 100000"),
        ("excite ur5 --out o --goal foo=1", "--goal 'foo=1': 'foo' is unknown"),
        ("excite ur5 --out o --lock joint9", "--lock joint9: 'joint9' is not a joint"),
        ("excite ur5 --out o --workers -3", "--workers '-3': expected a number of processes"),
        ("fit ur5 m.csv --out o --holdout 2", "--holdout: expected a share"),
        ("new s --robot ur5 --instrument tracker --cone 30", "--cone needs --instrument-at"),
        ("new s --robot ur5 --instrument tracker --facing q", "--facing q: expected x, +x"),
        ("view nofile.csv", "nofile.csv: no such folder"),
    ],
)
def test_an_error_names_the_option_as_typed(calib, monkeypatch, tmp_path, typed, begins):
    monkeypatch.chdir(tmp_path)
    code, _, err = calib(*typed.split())
    assert code == 2 and err.startswith(f"calib: {begins}"), err
