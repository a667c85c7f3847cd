"""A table of two intersecting axes: no check speaks of what the rows cannot hold."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from calib.data.poses.measurements import PoseMeasurements
from calib.geometry.diagnosis import scale_of, wrong_columns
from calib.geometry.first_guess import install
from calib.geometry.fit import polish_frames
from calib.geometry.installation import Installation
from calib.robot.chain import random_joints
from calib.robot.formats.urdf import parse
from calib.robot.kinematics import forward
from calib.transforms import from_xyz_rpy, to_quaternion

TABLE = """<robot name="table"><link name="base"/><link name="tilt"/><link name="plate"/>
<joint name="tilt" type="revolute"><parent link="base"/><child link="tilt"/><origin xyz="0 0 0.5"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="turn" type="revolute"><parent link="tilt"/><child link="plate"/><origin xyz="{side} 0 0.1"/>
<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint></robot>"""
STATION, TOOL = from_xyz_rpy([1.5, -0.8, 0.4], [0.1, -0.2, 2.0]), from_xyz_rpy([0.3, 0.1, 0.2], [0.2, 0.1, -0.4])


def measured(side: float, rows: int = 60) -> tuple[Installation, Sequence[PoseMeasurements]]:
    """Return a nominal table, placed, and its poses; the turning axis passes the tilting one at `side` [m]."""
    chain = parse(TABLE.format(side=side))
    generator = np.random.default_rng(0)
    q = random_joints(chain, rows, 1)
    poses = STATION @ forward(chain, q) @ TOOL
    position = poses[:, :3, 3] + 2e-4 * generator.standard_normal((rows, 3))
    blocks = [PoseMeasurements.of(q, position, to_quaternion(poses), joint_names=chain.joint_names)]
    return polish_frames(install(chain, blocks), blocks).cell, blocks


def test_explained_growth_has_no_factor():
    """The turning axis intersects the tilting one, so that base and tool grow with the table."""
    assert scale_of(*measured(0.0)) is None
    found = scale_of(*measured(0.3))
    assert found is not None and abs(found.factor - 1.0) < 4.0 * found.sigma < 0.01


def test_sound_table_needs_no_exchange():
    """No change of columns is named for a sound table."""
    assert wrong_columns(*measured(0.0), mirrored=True) is None


@pytest.mark.slow
def test_the_public_positioner(data, calib, tmp_path, monkeypatch):
    """205 poses: 0.38 mm mean by the URDF, 0.15 mm with joint corrections."""
    monkeypatch.chdir(tmp_path)
    folder = data / "positioner_2axis"
    code, _, err = calib("fit", folder / "positioner.urdf", folder / "positioner.csv", "--out", "o")
    found = json.loads(Path("o/metrics.json").read_text())
    assert (code, found["verdict"]) == (0, "pass"), err
    assert found["fit"]["urdf_alone"]["position_mm"]["mean"] < 0.38
    assert found["fit"]["calibrated"]["position_mm"]["mean"] < 0.15


@pytest.mark.parametrize("step", [1, pytest.param(17, marks=pytest.mark.slow)])
@pytest.mark.parametrize("holdout", [pytest.param((), marks=pytest.mark.slow), ("--holdout", "0.25")])
def test_twelve_positioner_rows_are_answered(data, calib, tmp_path, monkeypatch, holdout, step):
    """Of the first twelve rows one joint stands still, and no model of the arm can be better than the nominal one."""
    monkeypatch.chdir(tmp_path)
    folder = data / "positioner_2axis"
    header, *rows = (folder / "positioner.csv").read_text().splitlines(keepends=True)
    Path("m.csv").write_text("".join([header, *rows[::step][:12]]))
    code, out, err = calib("fit", folder / "positioner.urdf", "m.csv", *holdout, "--out", "o")
    level = json.loads(Path("o/metrics.json").read_text())["verdict"]
    assert code == (level == "fail") and not err
    assert "times the arm's" not in out and "reversed" not in out
