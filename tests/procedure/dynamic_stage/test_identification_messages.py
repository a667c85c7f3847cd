"""What the command says: whole file names where nobody looks, brackets as they are, the way on after Ctrl-C."""

import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import planted_motion as planted
import pytest
from rich.text import Text

from calib import cli
from calib.cli.shared import make_console
from calib.config import check_keys
from calib.dynamics.torque_rows import MOTOR
from calib.errors import UsageError
from calib.identification.gains import DriveGains
from calib.identification.identify_options import IdentifyOptions
from calib.identification.prediction import PredictionErrors, RelativeErrors
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.procedure.dynamic_stage.metrics import TorqueCurves
from calib.procedure.dynamic_stage.recorded_gains import FoundGains
from calib.procedure.dynamic_stage.replay import Replay
from calib.procedure.report import dynamics_figures, dynamics_loop, page
from calib.procedure.report.figures import drawing
from calib.robot.calibrated import CalibratedChain
from calib.units import motion_units


def test_a_pipe_gets_tables_of_full_width(monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    assert make_console().width == 160
    monkeypatch.setenv("COLUMNS", "70")
    assert make_console().width == 70


@pytest.mark.parametrize("command, words", [("identify", "starts over"), ("next", "goes on from here")])
def test_ctrl_c_says_what_a_rerun_will_do(monkeypatch, capsys, command, words):
    """Ctrl-C says what the same command will do."""

    def stop(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "command_tree", lambda: stop)
    monkeypatch.setattr(cli, "_spread", list)
    assert cli.run([command, "folder"]) == 130
    assert words in capsys.readouterr().err


def test_second_ctrl_c_ends_as_the_first(monkeypatch):
    """A second Ctrl-C ends as the first would."""

    def stop(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "command_tree", lambda: stop)
    monkeypatch.setattr(cli, "_complain", stop)  # as it comes while the first is told
    before = signal.getsignal(signal.SIGINT)
    try:
        with pytest.raises(SystemExit) as end:
            cli.main(["identify"])
    finally:
        signal.signal(signal.SIGINT, before)
    assert end.value.code == 130


def test_names_in_brackets_reach_the_console():
    rms = {key: np.full(3, 1e-3) for key in ("feedback", "cad", "model", "floor")}
    one = Replay("log.npz", 30.0, None, True, (), np.zeros(3), rms, unseen=True)
    *_, last = page.rendered(dynamics_loop.tracking_blocks({"log.npz": one}))
    assert isinstance(last, Text) and "the controller of [loop];" in last.plain


def test_figures_have_units_at_their_axes():
    one = planted.case("train", 0)
    joints = (replace(planted.arm().joints[0], kind="prismatic"), *planted.arm().joints[1:])
    arm, options = CalibratedChain(replace(planted.arm(), joints=joints)), IdentifyOptions()
    inputs = IdentificationInputs(
        arm, Path(), (), (), options, (), FoundGains(options, None, None, "N m", ())
    )  # fmt: skip
    report: Any = SimpleNamespace(
        fit={"train": SimpleNamespace(raw=PredictionErrors(RelativeErrors(5.0, np.full(3, 5.0)), np.zeros(3)))},
        validation={}, rows=MOTOR.titles(arm.chain.joint_names), units=inputs.row_units,
    )  # fmt: skip
    figure = drawing.figure(dynamics_figures.recorded(TorqueCurves.of(one, np.asarray(one.target)), report)[0])
    units = [f"{joint.name} [{unit}]: 5 % unexplained" for joint, unit in zip(joints, ("N", "N m", "N m"))]
    assert [axis.get_title(loc="left") for axis in figure.axes] == units
    assert not any(axis.get_legend() for axis in figure.axes), "a legend inside would cover the curve"
    gains = DriveGains(np.ones(3), np.zeros((3, 3)), (), np.zeros(0), np.ones(3), "", (2,))
    amperes = replace(inputs, currents=FoundGains(options, gains.gains, gains, "A of joint 2", ()))
    assert amperes.row_units == ("A of joint 2", "A of joint 2", "A of joint 3"), "a gain not told: its own amperes"
    assert motion_units(["revolute"] * 2) == ("rad", "rad/s", "rad/s²", "N m")
    assert motion_units(["revolute", "prismatic"])[3] == "N m, N"


def test_no_keys_to_choose_from_is_said():
    with pytest.raises(UsageError, match="; there are none"):
        check_keys({"tool": None}, set(), "files.payload")
