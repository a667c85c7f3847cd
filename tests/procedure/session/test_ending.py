"""A finished session ends with the robot that its verdict is about."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from calib.procedure.findings import Verdict, Verdicts
from calib.procedure.session import commands


@pytest.mark.parametrize(
    ("deliverable", "files", "level", "ending"),
    [
        ("urdf", ["robot.urdf", "robot_for_corrections.urdf"], "pass", "6-export/robot.urdf"),
        (
            "corrections",
            ["robot.urdf", "robot_for_corrections.urdf"],
            "pass",
            "6-export/robot_for_corrections.urdf with joint_corrections.csv",
        ),
        ("corrections", ["robot.urdf"], "pass", "6-export/robot.urdf"),  # the fit took up no corrections
        ("urdf", ["robot.urdf"], "fail", "6-export/robot.urdf (for inspection only, do not use)"),
        ("urdf", [], "fail", "no robot was exported"),
    ],
)
def test_last_line_names_the_judged_robot(tmp_path: Path, monkeypatch, deliverable, files, level, ending):
    """The last line names the judged robot."""
    (tmp_path / "6-export").mkdir()
    for name in files:
        (tmp_path / "6-export" / name).touch()
    session: Any = SimpleNamespace(
        path=tmp_path.joinpath,
        export="6-export",
        settings=SimpleNamespace(fit=SimpleNamespace(deliverable=deliverable)),
        verdicts=lambda: Verdicts({"geometry": Verdict(level, "why")}),
    )
    monkeypatch.setattr(commands, "promised", lambda session: [])
    assert commands._ending(session)[-1].endswith(ending)
