"""Every option of every command with odd values: a complaint or a result, never a traceback, nothing overwritten."""

import shutil
from pathlib import Path

import planted_motion as planted
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from calib import cli
from calib.robot import description

ODD = (
    "", "nan", "inf", "-inf", "-1", "0", "1e400", "1e12", "999999999999", "abc", "0_5", "０.５", ",", "1,2",
    "nan,nan,nan", "1e9,0,0", "[1]", "a=1", "joint1=", "joint9", "raw=nan", "..", "/", "nosuch", "\n", "9" * 400,
    "é" * 300, "-", "--",
)  # fmt: skip
ALONE = {"--help", "--debug", "--workers", "--spawn", "--bring"}  # a process more for each odd number of workers
POSES = "joint1,joint2,joint3,x,y,z\n" + "".join(
    f"{a},{b},{a * b},{1 + 0.1 * a},{0.2 * b},{0.3 * a - b}\n" for a in (-0.5, 0.1, 0.6, 0.9) for b in (-0.4, 0.2, 0.5)
)
BASE = {
    "fit": ["arm.toml", "m.csv", "--out", "o", "--model", "frames", "--no-plots"],
    "select": ["arm.toml", "--out", "o.csv", "-m", "4", "--candidates", "20", "--method", "detmax", "--no-plots"],
    "excite": ["arm.toml", "--out", "o", "--starts", "1", "--evaluations", "2", "--harmonics", "1", "--no-plots"],
    "plan": ["arm.toml", "--waypoints", "w.csv", "--out", "o", "--no-plots"],
    "recall": ["nothing", "l.npz", "--out", "o.npz"],
    "identify": ["arm.toml", "l.npz", "--out", "o", "--no-plots", "--friction", "standard"],
    "compensate": ["nothing", "w.csv", "--out", "o.csv"],
    "export": ["nothing", "--into", "o"],
    "view": ["nothing", "--save", "o.rrd"],
    "new": ["o", "--robot", "arm.toml", "--instrument", "tracker"],
    "next": ["nothing"], "status": ["nothing"], "redo": ["nothing", "fit"], "run": ["nothing"], "formats": ["mdh"],
}  # fmt: skip
FAST = [name for name in BASE if name not in ("fit", "excite", "plan", "identify")]
CHECKS = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture]


def options(command: str) -> list[str]:
    """Return the options of a command that take a value."""
    known = cli.command_tree().commands[command].params
    taking = [one for one in known if one.param_type_name == "option" and not one.is_flag]
    return sorted({max(one.opts, key=len) for one in taking} - ALONE)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("CALIB_DEBUG", raising=False)
    return tmp_path


def written(folder: Path) -> dict[str, bytes]:
    return {str(one.relative_to(folder)): one.read_bytes() for one in sorted(folder.rglob("*")) if one.is_file()}


def run_odd(command: str, data: st.DataObject, place: Path) -> None:
    """Run a command with one odd option: a known exit code, inputs as they were, nothing half-written."""
    room = place / "room"
    shutil.rmtree(room, ignore_errors=True)
    room.mkdir()
    description.write(room / "arm.toml", planted.arm())
    (room / "m.csv").write_text(POSES)
    (room / "w.csv").write_text("joint1,joint2,joint3\n0,0,0\n0.5,0.2,0.1\n")
    planted.write(room, "l.npz", 0)
    before = written(room)
    given_options = options(command)
    odd = [data.draw(st.sampled_from(given_options)), data.draw(st.sampled_from(ODD))] if given_options else []
    with pytest.MonkeyPatch.context() as inside:
        inside.chdir(room)
        code = cli.run([command, *BASE[command], *odd])
    after = written(room)
    assert code in (0, 1, 2, 3), (command, odd, code)
    assert {name: after.get(name) for name in before} == before, (command, odd)
    assert not [name for name in after if name.endswith(".part") or "calib-bug" in name], (command, odd)


@pytest.mark.parametrize("command", FAST)
@settings(max_examples=4, deadline=None, derandomize=True, suppress_health_check=CHECKS)
@given(data=st.data())
def test_odd_option_is_complaint_or_result(command: str, data: st.DataObject, place: Path) -> None:
    """An odd option is a complaint or a result."""
    run_odd(command, data, place)


@pytest.mark.slow
@pytest.mark.parametrize("command", BASE)
@settings(max_examples=60, deadline=None, suppress_health_check=CHECKS)
@given(data=st.data())
def test_odd_options_by_the_dozen(command: str, data: st.DataObject, place: Path) -> None:
    run_odd(command, data, place)
