"""What the command says: whole file names where nobody looks, brackets as they are, the way on after Ctrl-C."""

from __future__ import annotations

import pytest

from calib import cli
from calib.cli.shared import make_console
from calib.data import values
from calib.errors import UsageError


def test_a_pipe_gets_tables_of_full_width(monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    assert make_console().width == 160
    monkeypatch.setenv("COLUMNS", "70")
    assert make_console().width == 70


@pytest.mark.parametrize("command, words", [("identify", "starts over"), ("next", "goes on from here")])
def test_ctrl_c_says_what_the_same_command_will_do(monkeypatch, capsys, command, words):
    def stop(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "app", stop)
    assert cli.run([command, "folder"]) == 130
    assert words in capsys.readouterr().err


def test_no_keys_to_choose_from_is_said():
    with pytest.raises(UsageError, match="; there are none"):
        values.known({"tool": None}, set(), "files.payload")
