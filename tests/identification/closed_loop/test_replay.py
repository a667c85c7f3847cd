"""The second judgement: what replaying a recording says of a feed-forward is what the true robot would do."""

import json
from functools import cache

import numpy as np
import planted_motion as planted
import pytest
from without_figures import run

from calib.data.recordings.recording import Recording
from calib.data.signals.motion import FilterOptions, make_motion
from calib.identification.closed_loop import controllers
from calib.identification.closed_loop.simulation import Plant, simulate, tracking_error
from calib.identification.prediction import Dynamics, predict
from calib.identification.rows import Case, make_case
from calib.procedure.dynamic_stage import replay as replays
from calib.simulation import known_robots

PD = controllers.pd(np.array([900.0, 700.0, 120.0]), np.array([80.0, 60.0, 10.0]))


def plant() -> Plant:
    return Plant(planted.model().bodies, planted.model().terms, planted.truth())


@cache
def recorded() -> tuple[controllers.Reference, np.ndarray, Case]:
    """Return what was asked, what pushed, what came of it and the case; torques without noise."""
    limit = np.full(3, 1.2)
    asked = known_robots.random_fourier(-limit, limit, np.full(3, 2.5), 12.0, 1000.0, 8, acceleration=10.0, seed=3)
    omega = 2 * np.pi * np.array([0.7, 1.3, 2.9])
    push = np.array([3.0, 2.0, 0.6]) * np.sin(np.outer(asked.t, omega) + np.arange(3.0))
    run = simulate(plant(), PD, asked, push=push)
    names = tuple(f"joint{j + 1}" for j in range(3))
    motion = make_motion(Recording(run.t, run.q, run.tau, "torque", names), FilterOptions(cutoff=60.0, clock="stamps"))
    return asked, push, make_case("log", motion)


@pytest.mark.parametrize("share", [pytest.param(0.8, marks=pytest.mark.slow), 1.0])
def test_replay_tracks_as_the_true_robot(share):
    """A model whose friction falls short, fed forward on the true robot, pushed as it was: the same rms within 10 %."""
    _, push, case = recorded()
    values = planted.truth()
    values[30:] = [x * (share if one.name.startswith(("Fc", "Fv")) else 1.0)
                   for x, one in zip(values[30:], planted.model().terms)]  # fmt: skip
    dynamics = Dynamics(planted.model(), values)
    predicted = predict(dynamics, case)
    found = replays.replay(planted.arm(), dynamics, case, predicted, PD)
    motion = case.motion
    start = round(motion.t[0] * 1000)
    followed = controllers.Reference(motion.t, motion.q, motion.v, motion.a)
    own = push[start : start + len(motion)]
    for name, ahead in ((replays.FEEDBACK, None), (replays.IDENTIFIED, predicted)):
        true = tracking_error(plant(), PD, followed, ahead, own)
        np.testing.assert_allclose(found.rms[name], true, rtol=0.1)
    assert (found.rms[replays.FLOOR] < 0.1 * found.rms[replays.IDENTIFIED]).all()


@pytest.mark.slow
def test_better_models_track_better():
    """Better models track better, and the CAD knows no friction."""
    _, _, case = recorded()
    errors = []
    for factor in (0.5, 0.8, 1.0):
        dynamics = Dynamics(planted.model(), factor * planted.truth())
        found = replays.replay(planted.arm(), dynamics, case, predict(dynamics, case), PD)
        errors.append(np.mean(found.rms[replays.IDENTIFIED] / found.rms[replays.FEEDBACK]))
        assert (found.rms[replays.CAD] > found.rms[replays.IDENTIFIED]).all() or factor < 1.0
    assert errors[0] > errors[1] > errors[2]


@pytest.mark.slow
def test_impossible_model_gets_inertia_added():
    """Motor inertia off the last joint until its own is negative: errors of the true robot's are met within a third."""
    _, push, case = recorded()
    values = planted.truth()
    values[planted.model().names.index("Ia3")] -= 0.35
    dynamics = Dynamics(planted.model(), values)
    predicted = predict(dynamics, case)
    found = replays.replay(planted.arm(), dynamics, case, predicted, PD)
    assert found.inertia_added[2] > 0.0
    motion = case.motion
    start = round(motion.t[0] * 1000)
    followed = controllers.Reference(motion.t, motion.q, motion.v, motion.a)
    true = tracking_error(plant(), PD, followed, predicted, push[start : start + len(motion)])
    np.testing.assert_allclose(found.rms[replays.IDENTIFIED], true, rtol=0.33)
    sound = replays.replay(planted.arm(), Dynamics(planted.model(), planted.truth()), case, predicted, PD)
    assert not sound.inertia_added.any()


@pytest.mark.slow
def test_the_command_reports_it(robot, tmp_path, capsys):
    train, other = planted.write(tmp_path, "train.npz", 0), planted.write(tmp_path, "other.npz", 1)
    out = tmp_path / "out"
    assert run("identify", robot, train, "--validate", other, "--out", out, "--friction", "standard") == 0
    said = json.loads((out / "metrics.json").read_text())["tracking"]["other.npz"]
    assert said["unseen"] and not said["stated"] and said["feedback_over_model"] > 5.0
    assert set(said["rms"]) == {"feedback", "cad", "model", "floor"} and len(said["rms"]["model"]) == 3
    assert np.all(np.array(said["rms"]["model"]) < 0.5 * np.array(said["rms"]["cad"]))
    assert "reduces the tracking error by" in capsys.readouterr().out


def test_no_ratio_for_an_impossible_robot():
    """No ratio is told of a model that is no possible robot."""
    from calib.procedure.report.dynamics_loop import tracking_blocks

    def said(*added: float) -> str:
        rms = {"feedback": np.full(2, 13.4e-3), "model": np.full(2, 1e-3)}
        replay = replays.Replay("log", 1.0, None, False, (), np.array(added), rms, unseen=True)
        return " ".join(tracking_blocks({"log": replay})[1].lines)

    assert "reduces the tracking error by a factor of 13.4" in said(0.0, 0.0)
    assert "13.4" not in said(0.0, 1.4) and "physically inconsistent" in said(0.0, 1.4)
