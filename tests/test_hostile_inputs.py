"""Hostile inputs, one row each: a command ends with its exit code and one line, quickly, and leaves nothing behind."""

import shutil
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import planted_motion as planted
import pytest
from without_figures import run

from calib.robot import description
from calib.robot.formats import urdf_write
from calib.robot.kinematics import forward

FIT = ("fit", "arm.urdf", "m.csv", "--model", "frames", "--out", "o")
IDENTIFY = ("identify", "arm.toml", "l.npz", "--friction", "standard", "--out", "o")
BAG = ("identify", "arm.toml", "bag", "--out", "o")
FEW = ("-m", "6", "--candidates", "20", "--method", "detmax")
SELECT = ("select", "arm.urdf", *FEW, "--kind", "position", "--out", "o.csv")
Spoil = Callable[[Path], object]


def poses(points: Callable[[np.ndarray], np.ndarray] = lambda points: points) -> str:
    q = np.random.default_rng(0).uniform(-1, 1, (12, 3))
    rows = np.hstack([q, points(forward(planted.arm(), q)[:, :3, 3])])
    return "\n".join(["q1,q2,q3,x,y,z", *(",".join(f"{value:.9g}" for value in row) for row in rows)])


def written(name: str, content: str | bytes) -> Spoil:
    return lambda folder: (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)


def edited(name: str, old: str, new: str) -> Spoil:
    return lambda folder: (folder / name).write_text((folder / name).read_text().replace(old, new))


def declared(encoding: str) -> Spoil:
    head = f'<?xml version="1.0" encoding="{encoding}"?>\n'
    return lambda folder: (folder / "arm.urdf").write_text(
        head + (folder / "arm.urdf").read_text().split("?>", 1)[-1].lstrip()
    )


def late(folder: Path) -> None:
    series = planted.series(0)
    half = len(series["t"]) // 2
    np.savez(folder / "l.npz", **(series | {"t": series["t"] + 1e6 * (np.arange(len(series["t"])) >= half)}))


def bag(metadata: bytes) -> Spoil:
    def make(folder: Path) -> None:
        (folder / "bag").mkdir()
        (folder / "bag/metadata.yaml").write_bytes(metadata)

    return make


HOSTILE: dict[str, tuple[Spoil, tuple[str, ...], int]] = {
    **{f"encoding {name}": (declared(name), FIT, 2) for name in ("undefined", "idna", "hex", "no such")},
    **{f"encoding {name}": (declared(name), FIT, 0) for name in ("unicode_escape", "raw_unicode_escape", "utf-7")},
    "positions all zero": (written("m.csv", poses(np.zeros_like)), FIT, 2),
    "positions on a line": (written("m.csv", poses(lambda p: p[:, :1] * [1, 2, 3])), FIT, 2),
    "a header with a name twice": (written("m.csv", "q1,q1,q3,x,y,z\n1,2,3,4,5,6\n"), FIT, 2),
    "a header alone": (written("m.csv", "q1,q2,q3,x,y,z\n"), FIT, 2),
    "borders beyond the log": (written("o.toml", "[filter]\nborders = 100.0\n"), (*IDENTIFY, "--options", "o.toml"), 2),
    "gravity of 1e300": (written("o.toml", "gravity = [0, 0, -1e300]\n"), (*IDENTIFY, "--options", "o.toml"), 2),
    "gravity of 1e300 in the robot": (edited("arm.toml", "-9.81", "-1e300"), IDENTIFY, 2),
    "a gap of eleven days": (late, IDENTIFY, 0),
    "a cut before the start": (lambda folder: None, ("identify", "arm.toml", "l.npz@-1:2", "--out", "o"), 2),
    "a bag of broken YAML": (bag(b"a:\n  version: [b\n  c: : d"), BAG, 2),
    "a bag of YAML that makes objects": (bag(b"!!python/object:os.system 1"), BAG, 2),
    "no method": (lambda folder: None, ("select", "arm.urdf", "--method", "", "--out", "o.csv"), 2),
    "a joint that hardly moves": (edited("arm.urdf", 'velocity="5.0"', 'velocity="1e-300"'), SELECT, 0),
    "a slow joint": (edited("arm.urdf", 'velocity="5.0"', 'velocity="1e-5"'), SELECT, 0),
    "no display": (lambda folder: None, ("view", "arm.urdf"), 2),
}  # fmt: skip


@pytest.fixture
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for name in ("CALIB_DEBUG", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    description.write(tmp_path / "arm.toml", planted.arm())
    written("arm.urdf", urdf_write.write_new(planted.arm()))(tmp_path)
    written("m.csv", poses())(tmp_path)
    planted.write(tmp_path, "l.npz", 0)
    return tmp_path


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def refused_or_done(code: int, command: tuple[str, ...], room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = content(room)
    with warnings.catch_warnings():
        warnings.simplefilter("error", ResourceWarning)
        assert run(*command) == code
    said, after = capsys.readouterr().err, content(room)
    assert (said.count("\n") == 1) if code else not said, said
    assert {name: after.get(name) for name in before} == before
    assert code == 0 or after == before


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "a gap of eleven days")) for name in HOSTILE]
)
def test_hostile_input_is_refused_or_read(name: str, room: Path, capsys) -> None:
    """A hostile input is refused in one line, or read."""
    spoil, command, code = HOSTILE[name]
    spoil(room)
    refused_or_done(code, command, room, capsys)


@pytest.mark.slow
def test_session_damage_is_named(room: Path, capsys) -> None:
    """What is damaged in a session is named."""
    assert run("new", "cell", "--robot", "arm.urdf", "--instrument", "tracker", "--geometry-only") == 0
    edited("cell/session.toml", "fit = 40", "fit = 8")(room)
    assert run("next", "cell") == 0
    for name in ("poses.csv", "validation_poses.csv", "selection.json", "poses_prediction.json"):
        for damaged in ("", "[[1, 2], {", "\0\0", None):
            path, kept = room / "cell/2-poses" / name, (room / "cell/2-poses" / name).read_bytes()
            path.unlink()
            path.mkdir() if damaged is None else path.write_text(damaged)
            for command in ("status", "next"):
                capsys.readouterr()
                assert run(command, "cell") in (0, 2)
                assert capsys.readouterr().err.count("\n") <= 1
            shutil.rmtree(path) if path.is_dir() else path.unlink()
            path.write_bytes(kept)
