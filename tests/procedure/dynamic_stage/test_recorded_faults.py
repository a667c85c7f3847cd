"""``calib identify`` names clipped torques, standing encoders, and a payload that the options do not state."""

import json
from pathlib import Path

import numpy as np
import planted_motion as planted
import pytest
import without_figures

CODES = {"torque-clipped", "encoder-stands", "velocity-stands", "payload-unstated"}


def spoiled(folder: Path) -> Path:
    """Write a recording whose joint 1 has a frozen velocity, joint 2 a clipped torque, joint 3 a frozen position."""
    log = planted.series(2)
    v = planted.motion(2)[2]
    q, torque = np.array(log["q"]), np.array(log["tau"])
    v[1000:1100, 0] = v[1000, 0]
    bound = 0.7 * np.abs(torque[:, 1]).max()
    torque[:, 1] = np.clip(torque[:, 1], -bound, bound)
    q[1500:1600, 2] = q[1500, 2]
    path = folder / "spoiled.npz"
    np.savez(path, t=log["t"], q=q, dq=v, tau=torque)
    return path


def said(capsys, *arguments: object) -> str:
    without_figures.run("identify", *arguments, "--friction", "standard")
    out, err = capsys.readouterr()
    return " ".join((out + err).split())


def test_faults_are_named_with_their_file(robot, tmp_path, capsys):
    """Each fault is named with its file and joint."""
    plain = planted.write(tmp_path, "plain.npz", 0)
    loaded = planted.write(tmp_path, "loaded.npz", 1, tau=planted.series(1, payload=True)["tau"])
    words = said(capsys, robot, plain, loaded, "--validate", spoiled(tmp_path), "--out", tmp_path / "out", "-v")
    assert "spoiled.npz: torque of joint2 stays at one extreme value while the joint moves" in words
    assert "spoiled.npz: position of joint3 frozen from 7.5 to 7.995 s" in words
    assert "spoiled.npz: measured velocity of joint1 frozen from 5 to 5.495 s" in words
    assert "loaded.npz: an unstated payload of 2" in words


@pytest.mark.slow
def test_sound_payload_recordings_are_clear(robot, tmp_path, capsys):
    """Sound recordings with a stated payload are accused of nothing."""
    plain = planted.write(tmp_path, "plain.npz", 0)
    loaded = planted.write(tmp_path, "loaded.npz", 1, tau=planted.series(1, payload=True)["tau"])
    options = tmp_path / "options.toml"
    options.write_text('[payload.load]\n[files."loaded.npz"]\npayload = ["load"]\n')
    words = said(capsys, robot, plain, loaded, "--options", options, "--out", tmp_path / "out", "-v")
    assert "unstated payload" not in words and " frozen from " not in words
    codes = json.dumps(json.loads((tmp_path / "out" / "metrics.json").read_text()))
    assert not any(code in codes for code in CODES)


@pytest.mark.parametrize(
    ("stated", "code"),
    [
        pytest.param("mass = 2.0\ncom = [0.05, 0.025, 0.1]", None, marks=pytest.mark.slow),
        pytest.param("mass = 3.0", "payload-mass", marks=pytest.mark.slow),
        pytest.param("mass = 2.0\ncom = [0.05, 0.025, 0.3]", "payload-centre", marks=pytest.mark.slow),
    ],
)
def test_wrongly_stated_payload_is_named(robot, tmp_path, stated, code):
    """A stated mass or centre of mass that the torques contradict is named; the true one is not."""
    plain = planted.write(tmp_path, "plain.npz", 0)
    loaded = planted.write(tmp_path, "loaded.npz", 1, tau=planted.series(1, payload=True)["tau"])
    options = tmp_path / "options.toml"
    options.write_text(f'[payload.load]\n{stated}\n[files."loaded.npz"]\npayload = ["load"]\n')
    without_figures.run(
        "identify", robot, plain, loaded, "--friction", "standard", "--options", options, "--out", tmp_path / "out"
    )
    notices = json.loads((tmp_path / "out" / "metrics.json").read_text())["noticed"]
    codes = {notice["code"] for notice in notices if notice["code"].startswith("payload")}
    assert codes == ({code} if code else set())


@pytest.mark.slow
def test_standing_joint_is_no_fault(robot, tmp_path, capsys):
    """A joint that stands is no fault and no obstacle."""
    t, q, v, a = (np.array(series) for series in planted.motion(0))
    q[:, 0], v[:, 0], a[:, 0] = 0.3, 0.0, 0.0
    noise = 0.2 * np.random.default_rng(0).normal(size=q.shape)
    np.savez(tmp_path / "standing.npz", t=t, q=q, tau=planted.torques(q, v, a) + noise)
    words = said(capsys, robot, tmp_path / "standing.npz", "--out", tmp_path / "out", "-v")
    assert " frozen from " not in words and "extreme value" not in words and "joint1 never moves" in words
    found = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert 1.0 < found["condition_number"]["normalised"] < 1e3
