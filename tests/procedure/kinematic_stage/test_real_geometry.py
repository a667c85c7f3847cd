"""The issue's table on real recordings, through the Python API: errors on poses that were not fitted."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from calib.data.poses.measurements import PoseMeasurements, Poses, Positions, Sockets, take
from calib.geometry.accuracy import errors
from calib.geometry.checks.diagnosis import diagnose
from calib.geometry.checks.unidentified import unidentified
from calib.geometry.first_guess import install
from calib.geometry.model_choice.ladder import ModelSelection, select_model
from calib.geometry.weighing import Settings
from calib.robot.formats import urdf


def columns(file: Path, names: list[str]) -> np.ndarray:
    with file.open() as stream:
        return np.array([[float(row[name]) for name in names] for row in csv.DictReader(stream)])


def holdout(measured: PoseMeasurements, share: float, seed: int = 0) -> tuple[PoseMeasurements, PoseMeasurements]:
    """Return what to fit and the last share of a permutation to judge by."""
    order = np.random.default_rng(seed).permutation(len(measured))
    held = round(share * len(measured))
    return take(measured, np.sort(order[: len(order) - held])), take(measured, np.sort(order[len(order) - held :]))


def ur5(data: Path):
    folder, q = data / "ur5_gts3800", [f"q{k}" for k in range(1, 7)]
    file = folder / "grid_800.csv"
    position = columns(file, ["x_meas", "y_meas", "z_meas"])
    measured = Positions(columns(file, q), tuple(q), position=position, file=file.name)
    return urdf.read(folder / "model.urdf"), measured


def ur10(data: Path):
    folder, q = data / "ur10_ipa", [f"q{k}" for k in range(1, 7)]
    file = folder / "A_grid_2500.csv"
    quaternion = columns(file, ["qx_meas", "qy_meas", "qz_meas", "qw_meas"])
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    position = columns(file, ["x_meas", "y_meas", "z_meas"])
    measured = Poses(columns(file, q), tuple(q), position=position, quaternion=quaternion, file=file.name)
    return urdf.read(folder / "model.urdf"), measured


def motoman(data: Path, name: str):
    folder, q = data / "motoman_leica", ["q_E_external", *(f"q_{c}" for c in "SLURBT")]
    file = folder / name
    position = columns(file, ["x_meas", "y_meas", "z_meas"])
    measured = Positions(columns(file, q), tuple(q), position=position, file=name)
    return urdf.read(folder / "model_right.urdf"), measured


def mukca(data: Path, name: str):
    """Return the Panda, its first tool position and the others; sockets 50 mm apart."""
    folder, q = data / "mukca_sockets", [f"q{k}" for k in range(1, 8)]
    with (folder / name).open() as stream:
        rows = list(csv.DictReader(stream))
    places = list(dict.fromkeys(row["tool_position"] for row in rows))
    number = np.array([places.index(row["tool_position"]) for row in rows])
    group = 2 * number + np.array([int(row["socket"]) for row in rows])
    measured = Sockets(
        columns(folder / name, q),
        tuple(q),
        group=group,
        group_names=tuple(f"{place}/{socket}" for place in places for socket in (0, 1)),
        links=tuple((2 * k, 2 * k + 1, 0.05) for k in range(len(places))),
        file=name,
    )
    first = np.flatnonzero(number == 0)
    return urdf.read(folder / "panda.urdf"), take(measured, first), take(measured, np.flatnonzero(number > 0))


def judged(chain, fitted: PoseMeasurements, unseen: PoseMeasurements) -> tuple[ModelSelection, dict, dict]:
    """Return the climb, and the errors on unseen rows of the nominal and the calibrated arm."""
    found = select_model(install(chain, [fitted]), [fitted])
    assert found.fit.solution.status.good
    return found, *(errors(cell, [unseen]).summary() for cell in (found.nominal.cell, found.fit.cell))


def report(
    capsys, name: str, found: ModelSelection, nominal: dict, calibrated: dict, quantity: str, goal: float
) -> None:
    with capsys.disabled():
        print(
            f"\n  {name}: {getattr(nominal.position_mm, quantity):.3f} -> "
            f"{getattr(calibrated.position_mm, quantity):.4f} mm "
            f"({quantity}, goal {goal}), {found.chosen}, {len(found.fit.free)} parameters"
        )


@pytest.mark.slow
def test_ur5_with_a_laser_tracker(data, capsys):
    chain, measured = ur5(data)
    found, nominal, calibrated = judged(chain, *holdout(measured, 0.25))
    report(capsys, "ur5", found, nominal, calibrated, "rms", 0.07)
    assert calibrated.position_mm.rms <= 0.07
    assert calibrated.position_mm.rms < 0.1 * nominal.position_mm.rms


@pytest.mark.slow
def test_ur10_poses(data, capsys):
    chain, measured = ur10(data)
    found, nominal, calibrated = judged(chain, *holdout(measured, 0.4))
    report(capsys, "ur10 A", found, nominal, calibrated, "rms", 0.12)
    assert calibrated.position_mm.rms <= 0.12
    assert calibrated.orientation_deg.rms < nominal.orientation_deg.rms


@pytest.mark.slow
def test_motoman_in_a_small_volume(data, capsys):
    chain, measured = motoman(data, "right_6x6x6_150.csv")
    found, nominal, calibrated = judged(chain, *holdout(measured, 50 / 150))
    report(capsys, "motoman 6x6x6", found, nominal, calibrated, "rms", 0.07)
    assert calibrated.position_mm.rms <= 0.07


@pytest.mark.slow
def test_motoman_in_the_whole_workspace(data, capsys):
    chain, measured = motoman(data, "right_wide_386.csv")
    found, nominal, calibrated = judged(chain, *holdout(measured, 100 / 386))
    report(capsys, "motoman wide", found, nominal, calibrated, "rms", 1.3)
    assert calibrated.position_mm.rms <= 1.3


@pytest.mark.parametrize(
    "name, consistency, distance",
    [pytest.param("panda_2.csv", 0.79, 0.21, marks=pytest.mark.slow), ("panda_3.csv", 0.23, 0.05)],
)
def test_mukca_sockets_at_other_places(data, capsys, name, consistency, distance):
    chain, fitted, unseen = mukca(data, name)
    found, nominal, calibrated = judged(chain, fitted, unseen)
    report(capsys, name, found, nominal, calibrated, "mean", consistency)
    with capsys.disabled():
        print(f"  distance {nominal.distance_mm.mean:.3f} -> {calibrated.distance_mm.mean:.4f} ({distance})")
    assert calibrated.position_mm.mean <= consistency
    assert calibrated.distance_mm.mean <= distance


def tiago(data: Path):
    """Return the arm on its torso and 35 poses, three markers each as a reflector of its own."""
    folder = data / "tiago_laas"
    q = ["torso_lift_joint", *(f"arm_{k}_joint" for k in range(1, 8))]
    file = folder / "mocap_35poses.csv"
    joints, seen = columns(file, q), columns(file, [f"{axis}{k}" for k in (1, 2, 3) for axis in "xyz"])
    m = len(joints)
    measured = Positions(
        np.repeat(joints, 3, axis=0),
        tuple(q),
        position=seen.reshape(-1, 3),
        tool=np.tile([0, 1, 2], m),
        tool_names=("marker1", "marker2", "marker3"),
        rows=np.repeat(np.arange(1, m + 1), 3),
        file=file.name,
    )
    return urdf.read(folder / "model.urdf", tip="arm_7_link", joint_names=q), measured


def test_tiago_outliers_are_named(data, capsys):
    chain, measured = tiago(data)
    assert chain.joints[0].kind == "prismatic"
    settings = Settings(loss="cauchy", passes=10)
    found = select_model(install(chain, [measured]), [measured], "offsets", settings=settings)
    named = found.fit.outliers()
    sizes = 1e3 * errors(found.fit.cell, [measured]).position
    with capsys.disabled():
        rows = list(dict.fromkeys(item[1] for item in named))
        print(f"\n  tiago: outliers in rows {rows}, median {np.median(sizes):.2f} mm, largest {sizes.max():.1f} mm")
    assert named and named[0][0] == "mocap_35poses.csv"
    assert sizes.max() > 20 and np.median(sizes) < 6
    worst = int(measured.rows[np.argmax(sizes)])
    assert named[0][1] == worst
    assert len({item[1] for item in named}) <= 35 // 3


@pytest.mark.slow
def test_motoman_in_a_small_volume_cannot_tell_base_from_tool(data):
    chain, measured = motoman(data, "right_6x6x6_150.csv")
    found = select_model(install(chain, [measured]), [measured], "geometry")
    assert any(one.code == "loose-tool" and one.values["station"] for one in unidentified(found.fit))


@pytest.mark.slow
def test_motoman_in_the_whole_workspace_is_said_not_to_be_rigid(data):
    chain, measured = motoman(data, "right_wide_386.csv")
    found = select_model(install(chain, [measured]), [measured], "geometry")
    assert any(one.code in ("set-up-changed", "systematic-residual") for one in diagnose(found.fit))
