"""Points measured while an arm moves: the clock is found from the motion, and rows are thinned to independent ones."""

import errno
import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

import calib
from calib.apps.joining import joining, stream_files, streams
from calib.apps.joining.streams import Streamed
from calib.cli import run
from calib.data.poses.measurements import PoseMeasurements, Poses, Positions
from calib.errors import CalibError, MeasurementError, UsageError, finding
from calib.geometry.first_guess import install
from calib.geometry.fit import fit
from calib.geometry.observation import observe, predict, prepare, target_jacobian
from calib.procedure.findings import lines_of
from calib.robot.chain import Chain
from calib.robot.library import load
from calib.simulation.cell import Cell, true_poses
from calib.simulation.virtual_cells import perturbed_cell, rigid, virtual_cell
from calib.transforms import to_quaternion

OFFSET, SIGMA, MEMORY = 0.137, 30e-6, 0.03  # [s], [m], [s]: the noise is correlated, as an AR(1) process
POINT = "time [s],x [mm],y [mm],z [mm]"
GANTRY = """<robot name="gantry"><link name="base"/><link name="a"/><link name="b"/><link name="c"/><link name="tip"/>
<joint name="jx" type="prismatic"><parent link="base"/><child link="a"/><axis xyz="1 0 0"/>{0}</joint>
<joint name="jy" type="prismatic"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/>{0}</joint>
<joint name="ra" type="revolute"><parent link="b"/><child link="c"/><axis xyz="0 0 1"/>{0}</joint>
<joint name="rb" type="revolute"><parent link="c"/><child link="tip"/><origin xyz="0 0.1 -0.2"/><axis xyz="0 1 0"/>{0}
</joint></robot>""".format('<limit lower="-3" upper="3" effort="1" velocity="1"/>')


def slow_motion(n: int, seed: int, period: float = 240.0) -> Callable[[np.ndarray], np.ndarray]:
    """Return joints (m, n) over time [rad or m]: four sines each, of 17 to 120 s; the tool moves at some 30 mm/s."""
    rng = np.random.default_rng([seed, 9])
    order = rng.integers(2, 14, (n, 4))
    phase, size, middle = rng.uniform(0, 6.3, (n, 4)), rng.uniform(0.1, 0.25, (n, 4)), rng.uniform(-0.5, 0.5, n)
    frequency = 2.0 * np.pi * order / period
    return lambda t: middle + (size / order**0.5 * np.sin(t[:, None, None] * frequency + phase)).sum(axis=2)


def recorded(
    folder: Path, cell: Cell, seed: int, seconds: float = 110.0, rate: float = 100.0, drift: float = 0.0,
    poses: bool = False, pace: Callable[[np.ndarray], np.ndarray] = np.array,
) -> tuple[Path, Path]:  # fmt: skip
    """Write a log at 50 Hz and an instrument's stream that begins 2 s later; `pace`: time → the motion's time."""
    chain, rng, folder = cell.nominal, np.random.default_rng([seed, 1]), folder / f"{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    path, t = slow_motion(chain.n, seed), np.arange(0.0, seconds, 0.02)
    shown = [("mm", 1e3) if joint.kind == "prismatic" else ("deg", 180.0 / np.pi) for joint in chain.joints]
    header = ",".join(["t [s]", *(f"{name} [{unit}]" for name, (unit, _) in zip(chain.joint_names, shown))])
    log = np.column_stack([t, path(pace(t)) * [factor for _, factor in shown]])
    np.savetxt(folder / "log.csv", log, "%.7f", ",", header=header, comments="")
    t = np.arange(2.0, seconds - 3.0, 1.0 / rate)
    seen, memory = true_poses(cell, path(pace(t))), np.exp(-1.0 / (rate * MEMORY))
    pushes = SIGMA * np.sqrt(1.0 - memory**2) * rng.normal(size=(len(t), 3))
    points = 1e3 * (seen[:, :3, 3] + lfilter([1.0], [1.0, -memory], pushes, axis=0))
    turns = to_quaternion(seen) if poses else np.zeros((len(t), 0))
    if poses:
        turns += 1e-4 * rng.normal(size=turns.shape)
        turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    stream = np.column_stack([t + OFFSET + drift * (t - t.mean()), points, turns])
    header = f"{POINT},qx,qy,qz,qw" if poses else POINT
    np.savetxt(folder / "tracker.csv", stream, "%.6f", ",", header=header, comments="")
    return folder / "log.csv", folder / "tracker.csv"


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> tuple[Path, Path]:
    return recorded(tmp_path_factory.mktemp("stream"), rigid(perturbed_cell(load("ur5"), 3)), 3)


BAD = np.random.default_rng(0).choice(np.arange(1, 10_000), 105, replace=False)  # one row in a hundred


@pytest.fixture(scope="module")
def found(files) -> Streamed:
    """Return what is found of a stream with damaged rows."""
    head, *rows = files[1].read_text().splitlines()
    for k, i in enumerate(BAD):
        t, x, y, z = rows[i].split(",")
        rows[i] = (f"{t},{x}", f"{t},nan,{y},{z}", f"{t},---,,", f"{t},0.0,0,0", f"{t},{x},9e99,{z}",
                   f"{float(t) + 500},{x},{y},{z}", f"{t},{x},{y},{float(z) + 20}")[k % 7]  # fmt: skip
    damaged = files[1].with_name("damaged.csv")
    damaged.write_text("\n".join([head, *rows]))
    return joined(files[0], damaged)


def joined(log: Path, stream: Path, robot: str | Path = "ur5") -> Streamed:
    result = calib.join(log, stream, by="motion", robot=robot)
    assert isinstance(result, Streamed)
    return result


def changed(source: Path, path: Path, change: Callable[[np.ndarray], np.ndarray], header: str = "") -> Path:
    """Write a file of numbers with other numbers, or another header."""
    names = source.read_text().partition("\n")[0]
    rows = change(np.loadtxt(source, delimiter=",", skiprows=1))
    np.savetxt(path, rows, "%.7f", ",", header=header or names, comments="")
    return path


def test_clock_found_and_rows_independent(found):
    """The clock is found, and neighbours that are kept are nearly independent."""
    clock, step = found.clock, 0.01
    assert abs(clock.offset - OFFSET) < 3.0 * clock.sigma < 0.5e-3
    assert abs(clock.drift) < 3.0 * clock.drift_sigma < 2e-5
    assert found.sigma == pytest.approx(SIGMA, rel=0.1)
    memory = np.exp(-step / MEMORY)
    assert found.correlation == pytest.approx(step * (1.0 + memory) / (1.0 - memory), rel=0.25)
    assert found.factor == pytest.approx(np.sqrt(found.correlation / step))
    assert found.left < 0.15
    assert len(found.table) == pytest.approx(105.0 / (1.5 * found.correlation), rel=0.15)


def test_command_writes_table_with_reasons(tmp_path, files, found, capsys, monkeypatch):
    """The command writes a table for `fit`, with the reasons above it."""
    asked = list[object]()
    monkeypatch.setattr(joining, "join_streams", lambda *given: asked.extend(given) or found)
    out = tmp_path / "poses.csv"
    line = ["join", *map(str, files), "--by", "motion", "--robot", "ur5", "--out", str(out)]
    assert run(line) == 0
    assert asked[:2] == list(files)
    assert f"{len(found.table)} measured poses written" in capsys.readouterr().out
    comments = [row for row in out.read_text().splitlines() if row.startswith("#")]
    assert any("the instrument's clock minus" in row for row in comments) and any(
        "correlated" in row for row in comments
    )
    (block,) = calib.read_poses(out, "ur5")
    assert len(block) == len(found.table) and block.kind == "position"
    log = np.loadtxt(files[0], delimiter=",", skiprows=1)
    times = found.clock.controller(found.table.cells[0])
    for own, column in zip(block.q.T, log.T[1:]):
        np.testing.assert_allclose(own, np.radians(np.interp(times, log[:, 0], column)), atol=1e-5)


def test_damaged_rows_are_counted(found):
    """One per cent of damaged rows is dropped and counted."""
    jumps = len(BAD) // 7
    words = f"left out: {len(BAD) - jumps} damaged, empty or not seen, {jumps} far from the arm's path"
    assert found.notes[1].endswith(words)
    assert not set(found.poses) & set(BAD)


def test_residuals_ignore_offset_and_drift(tmp_path, found):
    """Residuals of rows measured in motion do not feel offset and drift of the clock."""
    (block,) = calib.read_poses(found.write(tmp_path / "poses.csv"), "ur5")
    assert isinstance(block, Positions) and block.late is not None
    speed = np.gradient(block.position, found.table.cells[0], axis=0)
    assert np.corrcoef(speed[:, 0], block.late[:, 0, 0])[0, 1] > 0.95
    moved = block.position + np.einsum("mkj,k->mj", block.late, [1e-3, 1e-5])
    cell = install(load("ur5"), [block])
    one, other = (observe(cell, prepare(cell, [each])[0], cell.chain.moving)[0]
                  for each in (block, replace(block, position=moved)))  # fmt: skip
    np.testing.assert_allclose(other.value, one.value, atol=1e-12)
    assert one.nuisances == 2 and np.ptp(moved - block.position) > 5e-5
    bare = observe(cell, prepare(cell, [replace(block, late=None)])[0], cell.chain.moving)[0]
    assert np.linalg.norm(one.jacobian) < np.linalg.norm(bare.jacobian)


@pytest.mark.slow
def test_backlash_is_no_late_clock(tmp_path):
    """Backlash and gear errors do not pass for a late clock."""
    errors = list[float]()
    for seed in range(4):
        clock = joined(*recorded(tmp_path, virtual_cell("ur5", seed), seed)).clock
        errors += [(clock.offset - OFFSET) / clock.sigma, clock.drift / clock.drift_sigma]
        assert clock.sigma < 0.6e-3
    assert np.abs(errors).max() < 2.5


@pytest.mark.slow
def test_drift_gaps_and_going_back_are_said(tmp_path):
    """Drift, gaps, and rows that go back in time are said."""
    cell = rigid(perturbed_cell(load("ur5"), 2))
    log, stream = recorded(tmp_path, cell, 2, drift=50e-6)

    def change(rows: np.ndarray) -> np.ndarray:
        return np.delete(np.insert(rows, 4000, rows[3900:3950], axis=0), np.arange(6000, 6400), axis=0)

    again = joined(log, changed(stream, tmp_path / "t.csv", change))
    assert again.clock.drift == pytest.approx(50e-6, abs=3.0 * again.clock.drift_sigma)
    assert "50 with a time not after that of the row before" in again.notes[1]
    assert "1 gap not bridged, the longest 4.01 s" in again.notes[2]


@pytest.mark.slow
def test_rows_too_fast_are_left_out(tmp_path, files, found):
    """Rows too fast for uncertain times are left out."""
    noise = np.random.default_rng(1).uniform(-3e-3, 3e-3, 20_000)
    log = changed(files[0], tmp_path / "log.csv", lambda rows: np.column_stack([rows[:, 0] + noise[: len(rows)],
                                                                               rows[:, 1:]]))  # fmt: skip
    again = joined(log, files[1])
    assert "too fast" in again.notes[1] and any("times are uncertain by 1." in note for note in again.notes)

    def speeds(one: Streamed) -> np.ndarray:
        t, *points = (np.asarray(one.table.cells[k]) for k in (0, 7, 8, 9))
        return np.linalg.norm(np.gradient(np.column_stack(points), t, axis=0), axis=1)

    assert np.quantile(speeds(again), 0.95) < np.quantile(speeds(found), 0.95)


@pytest.mark.slow
def test_standing_arm_gives_no_rows(tmp_path):
    """An arm that stands still for a while gives no rows there."""
    cell = rigid(perturbed_cell(load("ur5"), 3))
    log, stream = recorded(tmp_path, cell, 3, 140.0, pace=lambda t: np.interp(t, [0, 50, 80, 200], [0, 50, 50, 170]))
    again = joined(log, stream)
    at = again.clock.controller(again.table.cells[0])
    assert ((at > 50.5) & (at < 79.5)).sum() <= 1
    assert abs(again.clock.offset - OFFSET) < 3.0 * again.clock.sigma < 1e-3


@pytest.mark.slow
def test_sliding_joints_and_full_poses(tmp_path):
    robot = tmp_path / "gantry.urdf"
    robot.write_text(GANTRY)
    chain = load(robot)
    again = joined(*recorded(tmp_path, rigid(perturbed_cell(chain, 4)), 4, poses=True), robot)
    assert abs(again.clock.offset - OFFSET) < 3.0 * again.clock.sigma < 1e-3
    again.write(tmp_path / "poses.csv")
    assert again.table.units[1:5] == ("mm", "mm", "deg", "deg")
    (block,) = calib.read_poses(tmp_path / "poses.csv", robot)
    assert isinstance(block, Poses)
    q = slow_motion(chain.n, 4)(again.clock.controller(again.table.cells[0]))
    np.testing.assert_allclose(block.q, q, atol=1e-5)


@pytest.mark.slow
def test_offset_of_repetition_is_ambiguous(tmp_path):
    """The offset of a motion that repeats itself is said to be ambiguous."""
    cell = rigid(perturbed_cell(load("ur5"), 3))
    again = joined(*recorded(tmp_path, cell, 3, 160.0, pace=lambda t: 25.0 * np.sin(2.0 * np.pi * t / 40.0)))
    assert any("the motion repeats itself" in note for note in again.notes)
    assert again.clock.offset == pytest.approx(OFFSET, abs=3.0 * again.clock.sigma)


def stepped(source: Path, path: Path, at: float, size: float) -> tuple[Path, int]:
    """Write a stream whose clock steps by a size [s] at a share of its rows; return it and the row of the step."""
    row = int(at * (len(source.read_text().splitlines()) - 1)) + 1
    late = np.arange(1, 1_000_000) >= row
    return changed(
        source, path, lambda rows: rows + np.outer(late[: len(rows)], [size, *[0] * (rows.shape[1] - 1)])
    ), row


def check_step(log: Path, stream: Path, robot: str, size: float, file: str, row: int) -> None:
    with pytest.raises(MeasurementError, match=r"clock steps by .*cut the file there, and join each part") as refused:
        joined(log, stream, robot)
    said = re.search(r"steps by (\S+) ± (\S+) ms.* \((\S+): row (\d+), t = ", str(refused.value))
    assert said and said[3] == file
    assert float(said[1]) == pytest.approx(1e3 * size, abs=max(5.0 * float(said[2]), 1e1 * abs(size)))
    assert abs(int(said[4]) - row) <= 2


@pytest.mark.slow
@pytest.mark.parametrize("size", [5e-3, -0.02, 0.2])
def test_instrument_clock_step_is_refused(tmp_path, files, size):
    """A step of the instrument's clock is refused with its size and row."""
    stream, row = stepped(files[1], tmp_path / "s.csv", 0.4, size)
    check_step(files[0], stream, "ur5", size, "s.csv", row)


@pytest.mark.slow
def test_log_clock_step_is_found_in_the_log(tmp_path, files):
    """A step of the log's clock is found in the log."""
    log, row = stepped(files[0], tmp_path / "l.csv", 0.6, 0.05)
    check_step(log, files[1], "ur5", -0.05, "l.csv", row)


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["ur5", "tx40"])
def test_steps_are_told_from_backlash(tmp_path, robot):
    """Steps of each size are found in two arms with backlash, and none where there are none."""
    sizes = (5e-3, -0.02, 0.05, 0.2)
    for seed in range(2):
        log, stream = recorded(tmp_path, virtual_cell(robot, seed), seed, 160.0, drift=40e-6)
        assert abs(joined(log, stream, robot).clock.drift - 40e-6) < 2e-5
        for size in sizes[seed % 2 :: 2]:
            path, row = stepped(stream, tmp_path / "s.csv", 0.3 + 0.1 * seed, size)
            check_step(log, path, robot, size, "s.csv", row)


@pytest.mark.slow
@pytest.mark.parametrize("period", [240.0, 60.0])
def test_wandering_clock_is_no_step(tmp_path, period):
    """A clock that wanders by a millisecond is no step."""
    for seed in range(3):
        log, stream = recorded(tmp_path, rigid(perturbed_cell(load("ur5"), seed)), seed, 240.0)
        wander = changed(stream, tmp_path / "w.csv", lambda rows: rows + np.outer(
            1e-3 * np.sin(2.0 * np.pi / period * rows[:, 0]), [1, 0, 0, 0]))  # fmt: skip
        one = joined(log, wander)
        assert one.clock.offset == pytest.approx(OFFSET, abs=1e-3)
        if period == 240.0:
            assert any("ms from a line of offset and drift" in note for note in one.notes)
    far = changed(wander, tmp_path / "f.csv", lambda rows: rows + np.outer(
        0.015 * np.sin(2.0 * np.pi / 240.0 * rows[:, 0]), [1, 0, 0, 0]))  # fmt: skip
    with pytest.raises(MeasurementError, match=r"shorter parts|clock steps by"):
        joined(log, far)


@pytest.mark.slow
def test_step_there_and_back_is_no_drift(tmp_path):
    """A step there and back is no drift, either."""
    log, stream = recorded(tmp_path, rigid(perturbed_cell(load("ur5"), 1)), 1, 240.0)
    there, first = stepped(stream, tmp_path / "a.csv", 0.33, 0.03)
    back, last = stepped(there, tmp_path / "b.csv", 0.67, -0.03)
    with pytest.raises(MeasurementError, match=rf"clock steps by .*b.csv: row ({first}|{last}), "):
        joined(log, back)


def test_what_thins_rows_is_said():
    t = 0.01 * np.arange(1000)
    for times, q, apart, wanted in (
        (t, t, 0.05, {"apart": 0.05, "most": None, "moved": None}),
        (t, t / 200.0, 0.05, {"apart": 0.21, "most": None, "moved": 1.0}),
        (np.linspace(0.0, 5.0, 100_000), np.linspace(0.0, 500.0, 100_000), 1e-4,
         {"apart": 2.5e-4, "most": 20_000, "moved": None}),
    ):  # fmt: skip
        said = streams._thinned(times, q[:, None], apart)[1]
        assert said["apart"] == pytest.approx(wanted["apart"], rel=0.25)
        assert (said["most"], said["moved"]) == (wanted["most"], wanted["moved"])
    known = {"taken": 3, "of": 9, "step": 0.01, "apart": 0.03, "sigma": 1e-5, "correlation": 0.01, "left": 0.0}
    (line,) = lines_of([finding("stream-thinned", **known, most=None, moved=None, factor=None)])
    assert "since" not in line and "too small" not in line


def test_the_offset_is_said_with_its_time(found):
    line = next(note for note in found.notes if "minus the controller's" in note)
    first = found.clock.offset + found.clock.drift * (2.0 + OFFSET - found.clock.middle)
    assert f" at {found.clock.middle:.2f} s of the instrument's time, {first:+.5f} s at its first row; " in line


REFUSED = {
    "no times": (lambda rows: rows[:, 1:], "x [mm],y [mm],z [mm]", "no column of times.*joined by name, time or row"),
    "stops": (lambda rows: rows[::500], "", "rows are 5 s apart, a stream's 0.2 s at most. Is t in ms"),
    "milliseconds": (lambda rows: rows * [1e3, 1, 1, 1], "", "rows are 10 s apart.*Is t in ms"),
    "mm as m": (lambda rows: rows, "t,x,y,z", r"if it is in mm, name the column 'x \[mm\]'"),
    "m as mm": (lambda rows: rows * [1, 1e-3, 1e-3, 1e-3], "", "moves by only.*is the unit right"),
    "inches": (lambda rows: rows / [1, 25.4, 25.4, 25.4], "", "inches"),
    "still": (lambda rows: np.column_stack([rows[:, 0], rows[0, 1:] + 1e-2 * np.sin(1e3 * rows[:, 1:])]), "",
              "moves by only"),
    "backwards": (lambda rows: np.column_stack([rows[::-1, 0], rows[:, 1:]]), "",
                  "only 1 of .* rows can be used .*a time not after that of the row before"),
    "a jump of the clock": (lambda rows: rows + (rows[:, :1] > 60.0) * [7.0, 0, 0, 0], "",
                            "no offset of the clocks.*did no clock jump|did a clock jump"),
    "a clock that restarts": (lambda rows: rows - (rows[:, :1] > 60.0) * [58.0, 0, 0, 0], "",
                              r"row 5.*go back from (59\.9|60\.0)\d* to 2\.\d* s and run on .*restarted. Split"),
    "too short": (lambda rows: rows[:400], "", "offset of its clock is known to .* ms only|independent"),
    "nothing seen": (lambda rows: rows * [1, 0, 0, 0], "", "only 0 of .* rows can be used"),
}  # fmt: skip


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, marks=[pytest.mark.slow] * (case in ("too short", "a jump of the clock"))) for case in REFUSED],
)
def test_unjoinable_is_refused_with_cause(tmp_path, files, case):
    """What cannot be joined is refused with the cause."""
    change, header, says = REFUSED[case]
    with pytest.raises(MeasurementError, match=says):
        joined(files[0], changed(files[1], tmp_path / "t.csv", change, header))


@pytest.mark.slow
def test_stream_of_other_motion_is_refused(tmp_path, files):
    """A stream of another motion, or a log at rest, is refused."""
    other, _ = recorded(tmp_path, rigid(perturbed_cell(load("ur5"), 3)), 5)
    with pytest.raises(MeasurementError, match=r"no offset of the clocks .*is it the log of this motion"):
        joined(other, files[1])
    still = changed(files[0], tmp_path / "still.csv", lambda rows: rows * ([1.0] + [0.0] * 6))
    with pytest.raises(MeasurementError, match=r"moves by only .*too little to identify the clocks' offset"):
        joined(still, files[1])
    radians = changed(files[0], tmp_path / "rad.csv", lambda rows: rows, "t,q1,q2,q3,q4,q5,q6")
    with pytest.raises(MeasurementError, match=r"name the column 'q\d \[deg\]'"):
        joined(radians, files[1])
    with pytest.raises(UsageError, match="give --robot"):
        calib.join(*files, by="motion")


def test_full_disk_leaves_no_half_file(tmp_path, found, monkeypatch):
    """A full disk leaves nothing half written."""

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(CalibError, match="No space left on device; nothing was changed there"):
        found.write(tmp_path / "poses.csv")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_rows_held_are_bounded(files, monkeypatch, found):
    """Rows held are bounded, however long the stream."""
    monkeypatch.setattr(stream_files, "HELD", 3000)
    monkeypatch.setattr(stream_files, "PIECE", 1000)
    again = joined(*files)
    assert again.correlation == pytest.approx(found.correlation, rel=0.4)
    assert abs(again.clock.offset - OFFSET) < 3.0 * again.clock.sigma < 1e-3


def errors_in_sigmas(chain: Chain, cell: Cell, q: np.ndarray, position: np.ndarray, **more) -> np.ndarray:
    """Return the errors of the fitted parameters in their sigmas, seen at poses of the motion (by least squares)."""
    names = chain.joint_names
    block = PoseMeasurements.of(q, position, joint_names=names, **more)
    found = fit(install(chain, [block]), [block])
    at = q[:: max(len(q) // 60, 1)]
    (seen,) = prepare(found.cell, [PoseMeasurements.of(at, np.zeros((len(at), 3)), joint_names=names)])
    predicted = predict(found.cell, seen)
    slopes = target_jacobian(found.cell, predicted, found.free, 0, seen.tool)[:, :3].reshape(len(found.free), -1).T
    size, wrong = np.linalg.norm(slopes, axis=0), true_poses(cell, at)[:, :3, 3].T - predicted.point
    errors = np.linalg.lstsq(slopes / size, wrong.ravel(), rcond=1e-9)[0] / size
    return errors / np.sqrt(np.diag(found.estimate.covariance))


@pytest.mark.slow
def test_errors_match_sigmas_when_thinned(tmp_path):
    """Offsets and parameters err as their sigmas say, and without thinning they would not."""
    offsets, thinned, every = list[float](), list[np.ndarray](), list[np.ndarray]()
    for seed in range(3):
        cell = rigid(perturbed_cell(load("ur5"), seed))
        log, stream = recorded(tmp_path, cell, seed, rate=250.0)
        one = joined(log, stream)
        offsets.append((one.clock.offset - OFFSET) / one.clock.sigma)
        (block,) = calib.read_poses(one.write(tmp_path / "poses.csv"), "ur5")
        assert isinstance(block, Positions)
        thinned.append(errors_in_sigmas(cell.nominal, cell, block.q, block.position, late=block.late))
        rows = np.loadtxt(stream, delimiter=",", skiprows=1)[::2]
        q = slow_motion(6, seed)(one.clock.controller(rows[:, 0]))
        every.append(errors_in_sigmas(cell.nominal, cell, q, 1e-3 * rows[:, 1:4]))
    assert np.abs(offsets).max() < 2.5
    ours, all_rows = np.concatenate(thinned), np.concatenate(every)
    assert np.mean(np.abs(ours) < 2.0) == pytest.approx(0.95, abs=0.05)
    assert np.sqrt(np.mean(ours**2)) == pytest.approx(1.0, abs=0.2)
    assert np.sqrt(np.mean(all_rows**2)) == pytest.approx(np.sqrt(2.0 * MEMORY / 0.008), rel=0.25)
    assert np.mean(np.abs(all_rows) < 2.0) < 0.7


@pytest.mark.slow
def test_deflecting_cell_keeps_its_clock(tmp_path):
    """A cell with deflections that no rigid arm has keeps its clock."""
    again = joined(*recorded(tmp_path, perturbed_cell(load("ur5"), 6), 6))
    assert abs(again.clock.offset - OFFSET) < 4.0 * again.clock.sigma < 1e-3
