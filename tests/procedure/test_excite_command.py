"""What `calib excite` promises: a verified motion in files other programs read, and a clear refusal of bad input."""

from __future__ import annotations

import csv
import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from differences import check

from calib.dynamics import base, drives
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.tree import standard_parameters, tree
from calib.procedure.excitable import read_dynamics
from calib.procedure.motion_limits import Points, read_motion_limits
from calib.robot.kinematics import forward
from calib.robot.load import load
from trajectories.basis import Motion
from trajectories.fourier import evaluate

LIMITS = """
[target]
height = -0.2
axis_distance = 0.3
[velocity]
share = 0.9
[acceleration]
all = 12.0
[friction]
Fv = [14.4, 15.3, 6.55, 11.0, 4.29, 2.26, 1.6]
Fc = [11.9, 11.5, 8.98, 8.35, 8.31, 4.72, 6.04]
"""
QUICK = ("--starts", 1, "--evaluations", 90, "--period", 16, "--harmonics", 4, "--rate", 100)


def test_the_motion_keeps_its_limits_and_is_written_for_a_controller(cell, calib):
    Path("limits.toml").write_text(LIMITS)
    code, out, err = calib("excite", "lwr4plus", "--limits", "limits.toml", "--out", "e", *QUICK)
    assert code == 0, err
    assert "64 columns" in out and "every limit is kept" in out
    metrics = json.loads(Path("e/metrics.json").read_text())
    assert {"condition_number", "objective", "feasible", "margins", "seconds", "evaluations", "history"} <= set(metrics)
    assert metrics["feasible"] is True and metrics["condition_number"]["normalised"] < 12
    assert set(metrics["margins"]) == {"position", "velocity", "acceleration", "torque", "workspace"}
    assert all(one["margin"] >= 0 for one in metrics["margins"].values())
    for name in ("plot_motion.png", "plot_path.png", "plot_history.png"):
        assert (Path("e") / name).stat().st_size > 5000
    with Path("e/trajectory.csv").open(newline="") as file:
        rows = np.array([[float(x) for x in row.values()] for row in csv.DictReader(file)])
    assert rows.shape == (1601, 22) and np.allclose(np.diff(rows[:, 0]), 0.01)
    q, v, a = np.split(rows[:, 1:], 3, axis=1)
    chain = load("lwr4plus")
    assert (q < chain.upper).all() and (q > chain.lower).all() and (np.abs(a) < 12).all()
    assert (np.abs(v) <= 0.9 * np.array([joint.velocity for joint in chain.joints])).all()
    tool = forward(chain, q)[:, :3, 3]
    assert np.hypot(tool[:, 0], tool[:, 1]).min() >= 0.3 and tool[:, 2].min() >= -0.2
    assert np.abs(v[[0, -1]]).max() < 1e-9 and np.abs(a[[0, -1]]).max() < 1e-9
    assert np.allclose((q[2:] - q[:-2]) / 0.02, v[1:-1], atol=0.01)
    table = tomllib.loads(Path("e/trajectory.toml").read_text())
    series = [np.concatenate([[joint["q0"]], joint["a"], joint["b"]]) for joint in table["joint"]]
    assert np.allclose(evaluate(series, table["period"], rows[:, 0]), q, atol=1e-9)


def test_goals_raise_the_torque_of_the_wrist_and_the_front_is_drawn(cell, calib):
    Path("limits.toml").write_text(LIMITS)
    code, _, err = calib(
        "excite", "lwr4plus", "--limits", "limits.toml", "--out", "e", *QUICK, "--hard", "wrist=0.18", "--front", 2
    )
    assert code == 0, err
    reached = json.loads(Path("e/metrics.json").read_text())["goals"]
    assert reached["torque slack of joints 6, 7"]["reached"] <= 0.82 + 1e-5
    assert {"cond raw", "cond normalised"} < set(reached)
    assert Path("e/plot_front.png").exists() and len(Path("e/front.csv").read_text().splitlines()) > 1


@pytest.mark.parametrize(
    ("extra", "options", "words"),
    [
        ("[joints]\nq1 = [1.0, 0.5]", (), "not below"),
        ("[velocity]\nq3 = 0.0", (), "velocity limit of joint 3 is 0"),
        ("[velocity]\nq9 = 1.0", (), "unknown key 'q9'"),
        ('[frequency]\nresonance = "0.2 Hz"', (), "not below the resonance"),
        ("[target]\nheight = 1.5", (), "breaks the workspace limit"),
        ("[torque]\nall = 0.05", (), "breaks the torque limit"),
        ("[torque]\nmargin = 1.5", (), "torque margin 1.5"),
        ("[target]\nreach = nan", (), "not a number"),
        ("", ("--hard", "wrist=0.9"), "hard goal torque slack of joints 6, 7"),
        ("", ("--goal", "wrist=2"), "above 0 and below 1"),
        ("", ("--goal", "elbow=0.1"), "none of raw"),
        ("", ("--goal", "wrist"), "expected NAME=NUMBER"),
        ("", ("--period", "16.003"), "take 16 s"),
        ("", ("--period", "nan"), "period nan"),
        ("", ("--family", "steps"), "none of fourier"),
        ("", ("--model", "nowhere"), "folder of an identification"),
    ],
)
def test_bad_input_is_refused_with_exit_code_2(cell, calib, extra, options, words):
    Path("limits.toml").write_text(extra)
    quick = (*QUICK[:2], "--evaluations", 30, *QUICK[4:])
    code, _, err = calib("excite", "lwr4plus", "--limits", "limits.toml", "--out", "e", *quick, *options)
    assert (code, words in err) == (2, True), err
    assert not Path("e").exists()


def identified(folder: Path, spoil: str = "") -> None:
    """Write what `calib identify` writes of the LWR4+'s model."""
    chain = load("lwr4plus")
    terms = drives.standard(["Ia Fv Fc off"] * 7)
    model = IdentificationModel(tree(chain), terms)
    values = np.concatenate([standard_parameters(chain), np.tile([1.0, 5.0, 6.0, 0.1], 7)])
    found = base.find(model)
    folder.mkdir()
    table = {
        "gravity": [0, 0, -9.81],
        "bodies": dict(zip(model.tree.names, values[:70].tolist())),
        "terms": [
            {
                "name": one.name, "shape": one.shape, "acts": [[r, [list(p) for p in m]] for r, m in one.acts],
                "settings": list(one.settings), "side": one.side, "linear": one.linear,
                "value": float("nan") if one.name == spoil else float(value),
            }
            for one, value in zip(terms, values[70:])
        ],
    }  # fmt: skip
    (folder / "dynamics.json").write_text(json.dumps(table))
    rows = [",".join(["name", *found.names])]
    for i, name in enumerate(found.names):
        rows.append(",".join([name, *("0.01" if i == k else "0" for k in range(found.b))]))
    (folder / "covariance.csv").write_text("\n".join(rows))


def test_an_identified_model_predicts_torques_with_their_uncertainty(tmp_path):
    identified(tmp_path / "m")
    chain = load("lwr4plus")
    dynamics = read_dynamics(chain, tmp_path / "m", "", read_motion_limits(None, chain))
    assert dynamics.values is not None and dynamics.covariance is not None and dynamics.friction
    assert len(dynamics.values) == len(dynamics.exact.names) == 69  # 43 + 28, less Ia1 and Ia2
    assert np.allclose(dynamics.covariance, 0.01 * np.eye(69))
    q, v, a = np.random.default_rng(0).normal(size=(3, 5, 7))
    full = IdentificationModel(tree(chain), drives.standard(["Ia Fv Fc off"] * 7))
    values = np.concatenate([standard_parameters(chain), np.tile([1.0, 5.0, 6.0, 0.1], 7)])
    assert np.allclose(dynamics.exact.regressor(q, v, a) @ dynamics.values, full.regressor(q, v, a) @ values)


def test_nan_in_the_model_is_named(cell, calib):
    identified(Path("m"), spoil="Fv3")
    code, _, err = calib("excite", "lwr4plus", "--model", "m", "--out", "e", *QUICK)
    assert code == 2 and "parameter Fv3 of the model is not finite" in err


def test_named_points_move_with_their_links():
    chain = load("lwr4plus")
    points = Points(chain, (0, 4), np.array([[0.0, 0.0, 0.0], [0.05, 0.1, -0.1]]))
    q = np.random.default_rng(0).normal(size=(1, 7))
    G = np.random.default_rng(1).normal(size=(1, 2, 3))
    check(lambda x: (G * points(x[None])).sum(), points.product(q, G)[0], q[0])
    assert np.allclose(points(q)[:, 0], forward(chain, q)[:, :3, 3])


def test_collision_distances_are_kept_with_a_slope(tmp_path):
    (tmp_path / "l.toml").write_text("[collision]\nradius = 0.05\nfloor = -0.3\n")
    chain = load("lwr4plus")
    limits = read_motion_limits(tmp_path / "l.toml", chain)
    (clearance,) = (one for one in limits.constraints if one.name == "clearance")
    q = 0.5 * np.random.default_rng(3).normal(size=(1, 7))
    weights = np.ones((1, len(clearance.labels)))

    def total(x):
        still = np.zeros((1, 7))
        return clearance.values(Motion(np.zeros(1), x[None], still, still, still)).sum()

    motion = Motion(np.zeros(1), q, 0 * q, 0 * q, 0 * q)
    check(total, clearance.slopes(motion, weights)[0, 0], q[0], tolerance=1e-4)
