"""Claims of output and input error: their sigma covers, each is best where its signal is clean, failures are named."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from calib.data.recordings.recording import Recording
from calib.data.signals.motion import FilterOptions, make_motion
from calib.dynamics import base as bases
from calib.dynamics import drives
from calib.dynamics.bodies import bodies_of
from calib.dynamics.idim import IdentificationModel
from calib.errors import UsageError
from calib.identification.cases import make_case
from calib.identification.loop.loop_settings import LoopSettings
from calib.identification.methods.method import EstimateStatus, IdentificationProblem
from calib.identification.methods.registry import METHODS
from calib.identification.rows import observe
from calib.robot import mdh
from calib.simulation.loop import controllers, references
from calib.simulation.loop.closed_loop import Plant, Sensing, simulate

RATE = 700.0
ROWS = [
    mdh.Row("joint1", 1, "revolute", np.pi / 2, 0.0, 0.0, 0.0, lower=-2.0, upper=2.0),
    mdh.Row("joint2", 2, "prismatic", np.pi / 2, 0.1, 0.0, 0.3, lower=-1.0, upper=1.0),
]
LINKS = np.array([0.3, 0, 0, 0.1, 0, 0.4, 0.6, 0.1, 0, 3.0, 0.05, 0, 0, 0.04, 0, 0.1, 0.2, 0.05, 0, 1.0])
DRIVES = np.array([0.2, 1.0, 1.5, 0.1, 5.0, 0.8])  # Ia Fv Fc
PD = controllers.pd(np.array([900.0, 600.0]), np.array([40.0, 30.0]))
LOOP = LoopSettings(controller="pd", kp=tuple(PD.kp), kd=tuple(PD.kd), rate=RATE)


@cache
def robot() -> tuple[Plant, IdentificationModel, bases.Base]:
    chain = mdh.chain("turn and slide", ROWS)
    terms = drives.standard(["Ia Fv Fc"] * 2, 0.2, [False, True])
    model = IdentificationModel(bodies_of(chain), terms)
    return Plant(model.bodies, terms, np.concatenate([LINKS, DRIVES])), model, bases.find(model)


@cache
def motion() -> references.Reference:
    limit = np.array([1.5, 0.6])
    return references.random_fourier(-limit, limit, np.full(2, 3.0), 5.0, RATE, 8, acceleration=20.0, seed=5)


def problem(seed: int, sigma_q: float = 0.0, sigma_tau: float = 0.05) -> IdentificationProblem:
    """Return the problem of a log at 200 Hz of a loop at 700 Hz: 3.5 periods per sample."""
    plant, model, base = robot()
    tick = RATE / 200.0
    run = simulate(plant, PD, motion(), Sensing(sigma_q, sigma_tau=sigma_tau, every=tick), seed)
    asked = motion().at(np.arange(len(run.t)) * tick)[0]
    recording = Recording(run.t, run.measured, run.tau, "torque", ("joint1", "joint2"), q_ref=asked)
    case = make_case("log", make_motion(recording, FilterOptions(cutoff=40.0, band=20.0, clock="stamps")))
    decimator = case.motion.decimator
    rows = (observe(model, base.kept, case, decimator),)
    terms = tuple(None if k < model.inertial else model.columns[k - model.inertial] for k in base.kept)
    return IdentificationProblem(
        model, base, (case,), decimator, rows, terms, np.full(base.b, -1), loop=LOOP
    )  # fmt: skip


def truth() -> np.ndarray:
    plant, _, base = robot()
    return base.transform @ plant.parameters


@pytest.mark.parametrize(("name", "noise"), [("clie", (0.0, 0.1)), ("cloe", (2e-5, 0.0)), ("clie", (2e-5, 0.05))])
def test_the_stated_sigma_covers(name, noise):
    """Noise of the torque sensor, or of encoders in the loop, which makes the residuals anything but white."""
    found = [METHODS[name].estimate(problem(seed, *noise)) for seed in range(5)]
    assert all(one.found and one.simulations >= one.iterations > 0 for one in found)
    away = np.array([(one.estimate.values - truth()) / one.estimate.sigma for one in found])
    assert 0.6 < np.sqrt(np.mean(away**2)) < 1.4
    assert np.mean(np.abs(away) < 2.0) > 0.85


def test_each_is_better_where_its_own_signal_is_clean():
    heard, seen = problem(0, 0.0, 0.1), problem(0, 2e-5, 0.0)
    error = {
        (name, where): np.linalg.norm(METHODS[name].estimate(one).estimate.values - truth())
        for name in ("cloe", "clie") for where, one in (("heard", heard), ("seen", seen))
    }  # fmt: skip
    assert error["cloe", "heard"] < 0.1 * error["clie", "heard"]  # positions know nothing of the torque sensor
    assert error["cloe", "seen"] < error["clie", "seen"]


def test_a_loop_that_cannot_be_followed_is_a_status_not_an_exception():
    one = problem(0)
    wild = replace(one, loop=replace(LOOP, kp=(9e6, 6e6), kd=(4e5, 3e5)), start=truth())
    for name in ("cloe", "clie"):
        found = METHODS[name].estimate(wild)
        assert found.status is EstimateStatus.DIVERGED and not found.found
        assert "diverged" in str(found.failure)


def test_a_start_that_no_robot_has_is_a_status():
    one = problem(0)
    found = METHODS["clie"].estimate(replace(one, start=-truth()))
    assert found.status is EstimateStatus.CANNOT_BE_SIMULATED and "not positive definite" in str(found.failure)
    near = METHODS["clie"].estimate(replace(one, start=1.2 * truth()))
    plain = METHODS["clie"].estimate(one)
    assert np.abs((near.estimate.values - plain.estimate.values) / plain.estimate.sigma).max() < 0.3


def test_without_a_loop_nothing_can_be_compared():
    with pytest.raises(UsageError, match="needs a"):
        METHODS["cloe"].estimate(replace(problem(0), loop=None))
