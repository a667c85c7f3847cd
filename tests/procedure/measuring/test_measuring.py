"""Poses that one can drive and see: lines of sight change the choice, ways keep clear, predictions hold."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from differences import check

import calib
from calib.cli import run
from calib.config import parse
from calib.errors import UsageError
from calib.geometry.observability import observation, targets_of
from calib.poses.candidates import draw_candidates
from calib.poses.space import is_feasible
from calib.procedure.measuring import measuring_run as measuring
from calib.procedure.measuring.constraints_file import ConstraintsFile
from calib.procedure.measuring.measuring_run import Exchange, RunSettings, drivable, plan_run, turns, write_run
from calib.procedure.measuring.pose_limits import Limits, limits_of, read_limits
from calib.procedure.measuring.prediction import predicted
from calib.procedure.session.questions import cell_tables
from calib.results.scene_files import is_run, rehearsed_samples
from calib.robot.chain import Chain, random_joints
from calib.robot.library import load

CELL = """
[instrument]
xyz = [3.0, 0.0, 1.0]
sight = "30 deg"
range = [1.0, 5.0]
[[obstacle]]
name = "table"
kind = "box"
size = [1.2, 1.6, 0.05]
xyz = [0.9, 0.0, -0.06]
"""


def four_joints() -> Chain:
    arm = load("ur5")
    return replace(arm, joints=arm.joints[:4], elements=tuple(e for e in arm.elements if e.owner < 4), links=())


ARMS = {"4 joints": four_joints, "6 joints": lambda: load("ur5"), "7 joints": lambda: load("lwr4plus")}


def limits(name: str, tmp_path, text: str = CELL, tools=((0.05, 0.0, 0.05),)) -> tuple[Chain, Limits, object]:
    (tmp_path / "c.toml").write_text(text)
    chain = ARMS[name]()
    cell = targets_of(chain, tools)
    return chain, read_limits(tmp_path / "c.toml", cell), observation(cell, "position")


@pytest.mark.parametrize("name", ARMS)
def test_candidates_are_seen_and_keep_clear(name, tmp_path):
    """Every candidate is seen, and keeps clear."""
    chain, found, seen = limits(name, tmp_path)
    space = found.space(seen)
    q = draw_candidates(space.lower, space.upper, 30, lambda x: is_feasible(space, x), seed=1)
    assert found.sight is not None and found.sight.visible(q).all()
    assert (found.collision.distances(q) >= found.clearance - 1e-9).all()
    assert not is_feasible(space, random_joints(chain, 300)).all()


@pytest.mark.slow
def test_several_reflectors_show_more_poses(tmp_path):
    """Several reflectors let more poses be seen, and only seen rows count."""
    sides = "[target]\nfacing = [[0, 0, 1], [1, 0, 0], [-1, 0, 0]]\n" + CELL
    tools = ((0.0, 0.0, 0.08), (0.08, 0.0, 0.05), (-0.08, 0.0, 0.05))
    chain, one, _ = limits("6 joints", tmp_path, tools=tools[:1])
    _, three, seen = limits("6 joints", tmp_path, sides, tools)
    q = random_joints(chain, 2000, 3)
    spaces = [each.space(seen) for each in (one, three)]
    shares = [is_feasible(space, q).mean() for space in spaces]
    assert shares[1] > 1.5 * shares[0] > 0
    own = q[is_feasible(spaces[1], q)]
    rows, visible = spaces[1].jacobian(own), three.sight.visible(own)
    assert visible.any(axis=1).all() and not visible.all()
    assert np.array_equal(np.abs(rows).reshape(len(own), 3, -1).max(axis=2) > 0, visible)
    for constraint in spaces[1].constraints:
        for pose in own[:3]:
            slope = constraint.gradient(pose[None])[0]
            check(lambda x, one=constraint: one.function(x[None])[0], slope, pose, tolerance=1e-5)


def test_the_cell_as_told_becomes_tables():
    told = cell_tables(
        instrument_at="3,0,1", cone="30", facing="-z", box="none",
        obstacles=["table box 1.2,0.8,0.05 at 0.7,0,-0.04; pole cylinder 0.1,2 at 1,1,1"],
    )  # fmt: skip
    assert told["instrument"] == {"xyz": [3.0, 0.0, 1.0], "sight": "30 deg"}
    assert told["target"] == {"facing": "-z"} and told["without"] == ["box"]
    read = parse(ConstraintsFile, told, "the cell")
    assert read.target.facing == ((0.0, 0.0, -1.0),) and read.instrument.sight == pytest.approx(np.pi / 6)
    assert [one["name"] for one in told["obstacle"]] == ["table", "pole"]
    assert cell_tables(instrument_at="unknown", cone="unknown", facing="unknown", box="", obstacles=["?"]) == {}


@pytest.mark.parametrize(
    ("answers", "words"),
    [
        ({"instrument_at": "3000,0,1"}, "3000 mm are 3, or '3000 mm'"),
        ({"instrument_at": "3,0"}, "expected x,y,z in metres, or the word unknown"),
        ({"cone": "30"}, "--cone needs --instrument-at"),
        ({"instrument_at": "3,0,1", "cone": "wide"}, "instrument.sight: cannot read"),
        ({"instrument_at": "3,0,1", "cone": "0"}, "instrument.sight: expected"),
        ({"facing": "up"}, "--facing up: expected x"),
        ({"box": "1,2,-1,1,0,2"}, "the robot's base, at 0,0, is outside"),
        ({"box": "1,-1,-1,1,0,2"}, "the smaller one first"),
        ({"mounting": "on top"}, "expected one of in hand, to hand"),
        ({"carried": "0,0,0.1"}, "give --mounting, too"),
        ({"mounting": "in hand", "carried": "40,0,60"}, "40 mm are 0.04, or '40 mm'"),
        ({"mounting": "in hand", "stands": "0.5,0,0"}, "and a direction"),
        ({"mounting": "in hand", "stands": "0.5,0,0 facing up"}, "--stands .*expected x"),
        ({"mounting": "in hand", "lens": "nix.yaml"}, "no such file"),
        ({"obstacles": ["table"]}, "expected NAME box|sphere|cylinder SIZES at"),
        ({"obstacles": ["table box 1,0,1 at 0,0,0"]}, "expected a number above 0"),
    ],
)
def test_answers_that_cannot_be(answers, words):
    with pytest.raises(calib.CalibError, match=words.replace("|", r"\|")):
        cell_tables(**answers)


@pytest.mark.slow
def test_selection_is_drawn_beside_its_poses(tmp_path, capsys):
    """A selection is drawn beside its poses, never onto what is read."""
    given = ["select", "lwr4plus", "-m", "12", "--candidates", "150", "--out"]
    assert run([*given, str(tmp_path / "a.csv")]) == 0
    written = {path.name for path in tmp_path.iterdir() if not path.name.startswith(".")}
    assert written == {"a.csv", "a_prediction.json", "a_figures.html"}
    assert run([*given, str(tmp_path / "b.csv"), "--no-plots"]) == 0 and not (tmp_path / "b_figures.html").exists()
    (tmp_path / "a.csv").rename(tmp_path / "c_figures.html")
    assert run([*given, str(tmp_path / "c.csv"), "--existing", str(tmp_path / "c_figures.html")]) == 2
    assert "c_figures.html is an input" in capsys.readouterr().err
    assert run([*given, str(tmp_path / "d.csv"), "--run", str(tmp_path / "d.csv")]) == 2
    assert "written twice" in capsys.readouterr().err and not (tmp_path / "d.csv").exists()


def test_unknown_things_are_named():
    """What is unknown is named, and what is not there is not."""
    cell = targets_of(load("ur5"))
    bare = limits_of(ConstraintsFile(), cell)
    touching = "collision of base with shoulder_lift_joint_link, elbow_joint_link with wrist_2_joint_link"
    pairs = tuple(words for words in bare.unchecked if words.startswith(touching))
    assert len(bare.unchecked) == 4 and "obstacles (not known)" in bare.unchecked and len(pairs) == 1
    none = limits_of(ConstraintsFile(without=("instrument", "box", "obstacles")), cell)
    assert none.unchecked == pairs
    off = limits_of(ConstraintsFile(), cell, without=("self-collision", "floor", "joint-margin"))
    assert off.collision is None and off.checked == () and len(off.unchecked) == 6
    assert (off.lower == cell.chain.lower).all() and (bare.lower > cell.chain.lower).all()


def test_ordered_ways_are_clear_and_faster(tmp_path):
    """Ways keep clear, and their order takes less time."""
    wall = '[[obstacle]]\nname = "wall"\nkind = "box"\nsize = [1.0, 0.04, 1.0]\nxyz = [0.7, 0.0, 0.3]\n'
    chain, found, seen = limits("6 joints", tmp_path, wall)
    space = found.space(seen)
    q = draw_candidates(np.maximum(space.lower, -2.5), np.minimum(space.upper, 2.5), 5, lambda x: is_feasible(space, x))
    run = plan_run(chain, q, found, RunSettings(dwell=2.0))
    assert (sorted(run.order) == list(range(5)) and run.seconds <= run.found + 1e-6) or run.around
    for k, way in enumerate(run.ways):
        assert np.array_equal(way[0], q[run.order[k]]) and np.array_equal(way[-1], q[run.order[k + 1]])
        if k not in run.blocked:
            dense = np.concatenate([a + np.linspace(0, 1, 400)[:, None] * (b - a) for a, b in pairwise(way)])
            assert (found.collision.distances(dense) > 0).all()
    path = write_run(tmp_path / "run.csv", run, chain)
    t, played = rehearsed_samples(path, chain)
    assert is_run(path) and t[-1] == pytest.approx(run.seconds, abs=0.01)
    assert np.abs(played[0] - q[run.order[0]]).max() < 1e-6 and np.abs(played[-1] - q[run.order[-1]]).max() < 1e-6


def test_predicted_sigma_is_of_many_fits():
    """The tool's error after linear fits to noise, over typical poses, is as large as said."""
    chain = load("ur5")
    seen = observation(targets_of(chain, [(0.05, 0, 0.05)]), "position", (2e-5, 1e-4))
    q, typical = random_joints(chain, 30, 1), random_joints(chain, 200, 2)
    rows = seen(q).reshape(-1, len(seen.free))
    noise = np.random.default_rng(0).normal(size=(len(rows), 300))
    steps = np.linalg.lstsq(rows, noise, rcond=None)[0]
    errors = seen(typical)[:, :3] * seen.sigmas[0] @ steps
    real = np.sqrt((errors**2).sum(axis=1).mean())
    assert predicted(seen, seen(q), typical).rms == pytest.approx(real, rel=0.05)
    assert not np.isfinite(predicted(seen, seen(q[:5]), typical).rms)


@pytest.mark.slow
def test_selection_tells_run_and_prediction(tmp_path):
    """A selection tells the run, the prediction and what seeing costs."""
    (tmp_path / "c.toml").write_text(CELL)
    wanted = calib.SelectionSettings("position", ((0.05, 0, 0.05),), candidates=100)
    chosen = calib.select_poses("lwr4plus", 14, wanted, constraints=tmp_path / "c.toml")
    told = str(chosen)
    said = ("predicted σ of the tool's position", "cost of line of sight", "run: 14 poses in", "NOT checked: walls")
    assert all(words in told for words in said)
    outlook = chosen.outlook
    assert outlook.blind is not None and outlook.blind[0] > outlook.comparable
    with pytest.raises(calib.CalibError, match="of random postures that keep each constraint: line of sight 0 %"):
        (tmp_path / "d.toml").write_text(CELL.replace("30 deg", "0.1 deg"))
        calib.select_poses("lwr4plus", 14, wanted, constraints=tmp_path / "d.toml")


def _limits(text, tmp_path):
    (tmp_path / "c.toml").write_text(text)
    return read_limits(tmp_path / "c.toml", targets_of(load("ur5")))


BOX = "[[obstacle]]\nname = 'wall'\nkind = 'box'\nsize = {}\nxyz = {}\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[collision]\nfloor = -300\n", "floor: 300 m from the base"),
        (BOX.format([4000, 100, 3000], [0, 1500, 1500]), "wall: 1.45e"),
        ("[collision]\nradius = 60\n", "links of radius 60 m"),
    ],
)
def test_a_cell_in_millimetres_is_refused(tmp_path, text, words):
    with pytest.raises(UsageError, match=words):
        _limits(text, tmp_path)


def test_inactive_limits_are_told(tmp_path):
    """A limit that never acts is told, and not said to be kept."""
    far, near = (_limits(BOX.format([1, 1, 1], [x, 0, 0]), tmp_path) for x in (50, 1.3))
    assert any("wall: 49.5 m" in note for note in far.notes) and not any("wall" in kept for kept in far.checked)
    assert not any("wall:" in note for note in near.notes) and any("wall" in kept for kept in near.checked)
    assert any("if in degrees" in note for note in _limits("[joints]\nq1 = [-90, 90]\n", tmp_path).notes)


CHAIN = load("ur5")
FULL = 2 * np.pi


class Barrier:
    """A wall through the axis of the first joint, at one of its angles."""

    def free(self, q: np.ndarray, clearance: float) -> np.ndarray:
        return np.abs(np.angle(np.exp(1j * q[:, 0]))) > 0.1


def walls(most: float) -> SimpleNamespace:
    top = np.array([most, 2.0, 2.0, 2.0, 2.0, 2.0])
    return SimpleNamespace(lower=-top, upper=top, collision=Barrier(), clearance=0.05)


def poses(count: int, seed: int, side: float) -> np.ndarray:
    q = np.random.default_rng(seed).uniform(-1.5, 1.5, (count, 6))
    q[:, 0] = side * np.random.default_rng(seed + 1).uniform(0.2, 2.5, count)
    return q


@pytest.mark.slow
@pytest.mark.parametrize("index", ["O1", pytest.param("O3", marks=pytest.mark.slow)])
def test_hidden_poses_are_replaced_cheaply(index):
    """Poses behind a wall are replaced by those that cost least."""
    room, seen = walls(2.8), observation(targets_of(CHAIN))
    q = np.concatenate([poses(9, 1, 1.0), poses(2, 2, -1.0)])
    candidates = np.concatenate([poses(60, 3, 1.0), poses(60, 4, -1.0)])
    assert plan_run(CHAIN, q, room).cut_off == (9, 10)
    exchange = Exchange(seen, candidates, None, index)
    found = drivable(CHAIN, q, exchange, room, RunSettings())
    assert set(found.replaced) == {9, 10} and not found.run.blocked and np.array_equal(found.q[:9], q[:9])
    assert all(number < 60 for number in found.replaced.values())  # on the side where the others are
    trials = [exchange.value(np.concatenate([found.q[:10], one[None]]))[0] for one in candidates[:60]]
    assert found.value[1] == pytest.approx(max(trials), rel=1e-9)
    assert found.value == pytest.approx((exchange.value(q)[0], exchange.value(found.q)[0]))
    named = [number for number, place in enumerate(found.run.order, 1) if place > 8]
    assert found.words.startswith(f"poses {named[0]}, {named[1]} replaced")


@pytest.mark.slow
def test_pose_on_another_turn_is_kept():
    """The same pose on another turn is kept."""
    room, seen = walls(6.0), observation(targets_of(CHAIN))
    q = np.concatenate([poses(9, 1, 1.0), poses(2, 2, -1.0)])
    found = drivable(CHAIN, q, Exchange(seen, poses(60, 3, 1.0), None, "O1"), room, RunSettings())
    assert not found.replaced and not found.words and not found.run.blocked
    assert np.abs(np.sin((found.q - q) / 2)).max() < 1e-9
    assert found.value[0] == pytest.approx(found.value[1], rel=1e-9)


@pytest.mark.slow
def test_what_cannot_be_replaced_is_told():
    room, seen = walls(2.8), observation(targets_of(CHAIN))
    q = np.concatenate([poses(5, 1, 1.0), poses(1, 2, -1.0)])
    found = drivable(CHAIN, q, Exchange(seen, poses(60, 4, -1.0), None, "O1"), room, RunSettings())
    assert found.run.cut_off == (5,) and len(found.run.blocked) == 1 and not found.replaced


def test_turns_are_one_posture_within_limits():
    """Turns are the same posture within the limits."""
    top = np.array([6.2, 2.0, 2.0, 2.0, 2.0, 9.0])
    found = turns(CHAIN, np.full(6, 1.0), -top, top)
    assert len(found) == 2 * 3 and (np.abs(found) <= top).all()
    assert np.abs(np.sin((found - 1.0) / 2)).max() < 1e-12


def test_ways_lead_by_third_poses(monkeypatch):
    """Of a star only the middle is joined with each: the run comes back to it, and leaves nothing out."""
    room, q = walls(2.8), poses(5, 1, 1.0)

    def only_the_middle(room, start, goal, **_):
        ends = [start, goal]
        return np.array(ends) if any(np.array_equal(end, q[0]) for end in ends) else None

    monkeypatch.setattr(measuring, "way", only_the_middle)
    found = drivable(CHAIN, q, Exchange(observation(targets_of(CHAIN)), q, None, "O1"), room, RunSettings())
    run = found.run
    assert not found.replaced and np.array_equal(found.q, q)
    assert not run.blocked and not run.cut_off and sorted(run.order) == list(range(5)) and run.around >= 2
    for (one, two), way in run.found_ways.items():
        assert np.array_equal(way[[0, -1]], q[[one, two]])
        assert len(way) == 2 or np.array_equal(way[1], q[0])
