"""What `calib select` promises: better poses than chance gives, within the constraints, by seed."""

import csv
import pickle
from pathlib import Path

import numpy as np
import pytest

from calib.geometry.observability import observation, targets_of
from calib.procedure.kinematic_stage import selection
from calib.procedure.measuring.pose_limits import read_limits
from calib.robot.library import load

CONSTRAINTS = """
[joints]
q1 = ["-90 deg", "90 deg"]
[target]
height = [0.1, 1.0]
axis_distance = 0.3
reach = 0.9
[instrument]
xyz = [2.5, 0.0, 0.8]
rpy = [0, "90 deg", 0]
roll = ["-170 deg", "170 deg"]
sight = "50 deg"
[collision]
radius = 0.04
floor = -0.1
"""


def read_poses(path: str) -> np.ndarray:
    with Path(path).open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [f"{name} [deg]" for name in load("ur5").joint_names]
    return np.deg2rad([[float(value) for value in row.values()] for row in rows])


def write_poses(path: str, count: int, seed: int) -> None:
    q = np.random.default_rng(seed).uniform(-2.0, 2.0, (count, 6))
    np.savetxt(path, q, delimiter=",", header=",".join(load("ur5").joint_names), comments="")


@pytest.mark.slow
def test_selection_is_near_the_bound(cell, calib, monkeypatch):
    """The selection is better than chance, and near the bound."""
    choose, selections = selection.choose, []

    def noted(*arguments, **options):
        selections.append(choose(*arguments, **options))
        return selections[-1]

    monkeypatch.setattr(selection, "choose", noted)
    code, out, err = calib("select", "ur5", "-m", "12", "--candidates", "300", "--out", "p.csv", "--seed", "1")
    assert code == 0, err
    (found,) = selections
    assert found.parameters == 30
    assert found.selection.random_baseline < found.selection.value
    assert 0.95 < found.selection.efficiency <= 1.0 + 1e-9
    for words in ("best of 1000 random sets", "efficiency against the convex bound", "seconds"):
        assert words in out
    assert np.allclose(read_poses("p.csv"), found.selection.q, atol=1e-11)


@pytest.mark.parametrize(("tool", "count"), [((0, 0, 0.1), 25), ((0.05, 0, 0.1), 27)])
def test_columns_of_positions_can_be_told(tool, count):
    """The columns of positions are those that can be told."""
    assert len(observation(targets_of(load("ur5"), [tool]), "position").free) == count


def test_chosen_poses_keep_the_constraints(cell, calib):
    Path("c.toml").write_text(CONSTRAINTS)
    given = "select ur5 -m 12 --kind position --constraints c.toml --candidates 200 --out p.csv"
    code, out, err = calib(*given.split())
    assert code == 0, err
    assert "capsules" in out
    q = read_poses("p.csv")
    arm = targets_of(load("ur5"))
    limits = read_limits(Path("c.toml"), arm)
    assert (np.abs(q[:, 0]) <= np.pi / 2).all()
    for constraint in limits.constraints:
        assert (constraint.function(q) <= 1e-8).all(), constraint.name
    assert len(limits.constraints) == 4
    assert limits.sight is not None and limits.sight.visible(q).all()
    assert limits.collision is not None
    assert (limits.collision.distances(q) >= limits.clearance - 1e-8).all()
    # and they do exclude something
    assert not all((constraint.function(np.zeros((1, 6))) <= 0).all() for constraint in limits.constraints)


def test_gradient_is_central_difference(cell):
    """The gradients of the constraints are those of central differences."""
    from calib.poses.space import central_difference

    Path("c.toml").write_text(CONSTRAINTS)
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (5, 6))
    checked = 0
    arm = targets_of(load("ur5"), [(0.1, 0, 0.2)])
    for constraint in read_limits(Path("c.toml"), arm).space(observation(arm)).constraints:
        assert constraint.gradient is not None
        slope = np.asarray(constraint.gradient(q))
        assert np.abs(slope - central_difference(constraint.function, q).transpose(0, 2, 1)).max() < 1e-7
        checked += 1
    assert checked == 7  # height, axis, reach, orientation, collision, cone of sight, view past the arm


@pytest.mark.slow
def test_existing_poses_count(cell, calib):
    write_poses("first.csv", 10, 0)
    code, out, err = calib(
        *["select", "ur5", "-m", "5", "--candidates", "200", "--existing", "first.csv", "--out", "second.csv"]
    )
    assert code == 0, err
    assert "existing poses alone" in out
    assert len(read_poses("second.csv")) == 5


@pytest.mark.parametrize(
    "text", ["[target]\nhight = 1\n", "[joints]\nq1 = [1, 0]\n", "[target]\nheight = 'tall'\n", "x ="]
)
def test_impossible_constraints(cell, calib, text):
    Path("c.toml").write_text(text)
    code, _, err = calib("select", "ur5", "--constraints", "c.toml", "--out", "p.csv")
    assert (code, "c.toml" in err, Path("p.csv").exists()) == (2, True, False)


def test_nothing_feasible_says_so(cell, calib):
    Path("c.toml").write_text("[target]\nheight = 5.0\n")
    code, _, err = calib("select", "ur5", "--constraints", "c.toml", "--candidates", "50", "--out", "p.csv")
    assert (code, Path("p.csv").exists()) == (2, False)
    assert "0 " in err


def test_objects_for_processes_can_pickle(cell):
    """What is sent to other processes can be pickled."""
    Path("c.toml").write_text(CONSTRAINTS)
    arm = targets_of(load("ur5"))
    limits, seen = read_limits(Path("c.toml"), arm), observation(arm, "position")
    q = np.random.default_rng(0).uniform(-1, 1, (4, 6))
    copy, again = pickle.loads(pickle.dumps((limits, seen)))
    assert np.array_equal(again(q), seen(q))
    assert np.array_equal(copy.collision.distances(q), limits.collision.distances(q))


@pytest.mark.parametrize(
    ("out", "words"), [("before.csv", "is an input"), ("rules.toml", "is an input"), (".", "is a folder")]
)
def test_input_files_are_not_overwritten(cell, calib, out, words):
    """Nothing is written onto what is read."""
    Path("rules.toml").write_text("[target]\nreach = 0.9\n")
    write_poses("before.csv", 8, 0)
    kept = {name: Path(name).read_bytes() for name in ("before.csv", "rules.toml")}
    given = ("--existing", "before.csv", "--constraints", "rules.toml")
    code, _, err = calib("select", "ur5", "-m", 8, "--candidates", 100, *given, "--out", out)
    assert (code, words in err) == (2, True), err
    assert kept == {name: Path(name).read_bytes() for name in kept}


def _poses(path: str, names: tuple[str, ...], more: str = "") -> bytes:
    head, row = ",".join(names), ",".join(["0.123456789012"] * len(names))
    Path(path).write_text(f"{head}{',x,y,z' if more else ''}\n{row}{more}\n")
    return Path(path).read_bytes()


def test_unrelated_file_stays(cell, calib) -> None:
    """A file that an earlier run did not leave is kept."""
    names = load("ur5").joint_names
    kept = {
        "measured.csv": _poses("measured.csv", names, ",0.1,0.2,0.3"),
        "taught.csv": ",".join(names).encode() + b"\n0.1,0.2,0.3,0.4,0.5,0.6\n",
        "other.csv": b"a,b\n1,2\n",
    }
    for name, content in kept.items():
        Path(name).write_bytes(content)
        code, _, err = calib("select", "ur5", "-m", "8", "--candidates", "100", "--no-plots", "--out", name)
        assert (code, name in err and "--overwrite" in err) == (2, True), err
    assert {name: Path(name).read_bytes() for name in kept} == kept
    assert not list(Path().glob("*_prediction.json"))
    code, _, err = calib("select", "ur5", "-m", "8", "--candidates", "100", "--no-plots", "--out", "plot_mine.png")
    assert (code, "suffix .csv" in err) == (2, True)


@pytest.mark.slow
def test_a_command_replaces_its_own_files(cell, calib) -> None:
    given = ("select", "ur5", "--candidates", "40", "--out", "p.csv", "--run", "run.csv")
    for more in (("-m", "5"), ("-m", "6")):
        code, _, err = calib(*given, *more)
        assert code == 0, err
    assert len(Path("p.csv").read_text().splitlines()) == 7
    Path("p.csv").write_text(Path("p.csv").read_text() + "\n")
    for code, more in ((2, ()), (0, ("--overwrite",))):
        assert calib(*given, "-m", "5", *more)[0] == code, "a file that somebody changed is kept"
