"""What the command says: whole file names where nobody looks, brackets as they are, the way on after Ctrl-C."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import planted_motion as planted
import pytest
from rich.text import Text

from calib import cli
from calib.cli.shared import make_console
from calib.data import values
from calib.errors import UsageError
from calib.identification.loop.replay import CAD, FEEDBACK, FLOOR, IDENTIFIED, Replay
from calib.procedure.dynamic_stage import tracking
from calib.procedure.dynamic_stage.tracking import Tracking
from calib.procedure.report import identification_figures
from calib.procedure.report.style import motion_units


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


def test_names_in_brackets_reach_the_console():
    still = {name: np.full(3, 1e-3) for name in (FEEDBACK, CAD, IDENTIFIED, FLOOR)}
    one = Replay("log.npz", 1.0, None, True, (), np.zeros(3), still)
    *_, last = tracking.tracking_lines(Tracking((one,), True), planted.arm())
    assert "the controller of [loop];" in Text.from_markup(last).plain


def test_figures_have_units_at_their_axes():
    one = planted.case("train", 0)
    joints = (replace(planted.arm().joints[0], kind="prismatic"), *planted.arm().joints[1:])
    outcome: Any = SimpleNamespace(
        fit={"train": None}, repeated={}, found=SimpleNamespace(settings=SimpleNamespace(kind="motor")),
        inputs=SimpleNamespace(unit="N m", chain=replace(planted.arm(), joints=joints)),
    )  # fmt: skip
    figure = identification_figures.torques(one, np.asarray(one.target), outcome)
    assert [axis.get_ylabel() for axis in figure.axes] == ["joint 1\n[N]", "joint 2\n[N m]", "joint 3\n[N m]"]
    assert not any(axis.get_legend() for axis in figure.axes), "a legend inside would cover the curve"
    assert motion_units(["revolute"] * 2) == ("rad", "rad/s", "rad/s²", "N m")
    assert motion_units(["revolute", "prismatic"])[3] == "N m, N"


def test_no_keys_to_choose_from_is_said():
    with pytest.raises(UsageError, match="; there are none"):
        values.known({"tool": None}, set(), "files.payload")
