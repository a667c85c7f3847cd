"""Instrumental variables for joint torque sensors: Models 1 and 2 of an LWR4+, encoder noise in the loop."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from calib.data.recordings.recording import Recording
from calib.data.signals.motion import FilterOptions, make_motion
from calib.dynamics import base as bases
from calib.dynamics import drives
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.torque_rows import BOTH, DRIVE, LINK
from calib.errors import UsageError
from calib.identification.closed_loop import controllers
from calib.identification.closed_loop.instrumental import identify_instrumental
from calib.identification.closed_loop.loop_recordings import Loop
from calib.identification.closed_loop.simulation import Plant, Sensing, simulate
from calib.identification.rows import make_case
from calib.robot.library import load
from calib.simulation import known_robots

RATE, WIDTH, FREQUENCY = 1000.0, 0.5, 3.0  # of the controller [Hz], of the Coulomb sign [rad/s], of the loop [Hz]


@cache
def arm() -> tuple[Plant, controllers.LoopController, controllers.Reference]:
    """Return the arm, a PD controller by its inertia, and what it is to follow for 20 s."""
    chain, known = load("lwr4plus"), known_robots.truth("lwr4plus")["drives"]
    terms = drives.standard([" ".join(known_robots.SIDED)] * chain.n, WIDTH)
    values = [known[name][joint] for joint in range(chain.n) for name in known_robots.SIDED]
    plant = Plant(bodies_of(chain), terms, np.concatenate([standard_parameters(chain), values]))
    inertia = plant.inertia_diagonal(np.random.default_rng(0).uniform(-1, 1, (100, chain.n)))
    omega, speed = 2 * np.pi * FREQUENCY, np.array([joint.velocity for joint in chain.joints])
    lower, upper = 0.6 * np.asarray(chain.lower), 0.6 * np.asarray(chain.upper)
    reference = known_robots.random_fourier(lower, upper, 0.6 * speed, 20.0, RATE, 8, acceleration=12.0, seed=3)
    return plant, controllers.pd(omega**2 * inertia, 1.4 * omega * inertia), reference


def model_of(rows) -> tuple[IdentificationModel, bases.Base, np.ndarray]:
    """Return the model of torque rows, its base, and the base parameters' true values."""
    plant, _, _ = arm()
    model = IdentificationModel(plant.bodies, plant.terms, rows)
    base, own = bases.find(model), dict(zip([one.name for one in plant.terms], plant.parameters[plant.inertial :]))
    values = np.append(plant.parameters[: plant.inertial], [own[one.name] for one in model.columns])
    return model, base, base.transform @ values


def log(rows, seed: int = 0):
    """Return the case of one run; the noise of 1 mrad is what the controller acts on."""
    plant, controller, reference = arm()
    run = simulate(plant, controller, reference, Sensing(sigma_q=1e-3, sigma_tau=0.05), seed)
    link = IdentificationModel(plant.bodies, plant.terms, LINK)
    own = dict(zip([one.name for one in plant.terms], plant.parameters[plant.inertial :]))
    values = np.append(plant.parameters[: plant.inertial], [own[one.name] for one in link.columns])
    noise = 0.02 * np.random.default_rng([seed, 2]).normal(size=run.q.shape)
    names = load("lwr4plus").joint_names
    sensed = Recording(
        run.t, run.measured, run.tau, "torque", names, tau_link=link.torque(values, run.q, run.v, run.a) + noise
    )
    return make_case("log", make_motion(sensed, FilterOptions(cutoff=30.0, band=10.0, clock="stamps")), rows)


@pytest.mark.slow
@pytest.mark.parametrize("rows", [BOTH, LINK])
def test_instruments_with_sensors_are_right(rows):
    """Measured over seeds 0 to 7: where least squares is beyond 5 of its σ, IV is within 1.4 of its own.

    These are 15 to 20 of 92 parameters (up to 17 σ off), of link rows alone 7 to 12 of 64; IV errs there by 1 to 3 %
    (median) of what least squares does. Its σ are cautious, some 15 times the scatter over these seeds: they take the
    residuals for white, which hold accelerations' noise, least where the motion's power is. Against that scatter some
    bias is left with both rows (up to 18 times it, 0.4 σ), with link rows none (1.7 times).
    """
    (model, base, truth), case, (_, controller, reference) = model_of(rows), log(rows), arm()
    found = identify_instrumental(model, base, [(case, Loop(controller, reference))], case.motion.decimator)
    errors = [np.abs(one.values - truth) for one in (found.ordinary.estimate, found.fit.estimate)]
    ordinary, instrumental = errors[0] / found.ordinary.estimate.sigma, errors[1] / found.fit.estimate.sigma
    biased = ordinary > 5.0
    assert biased.sum() >= 8 and ordinary.max() > 10.0
    assert instrumental[biased].max() < 2.0 and np.median(errors[1][biased] / errors[0][biased]) < 0.05
    assert (instrumental < 2.0).mean() > 0.95 and instrumental.max() < 4.0
    assert found.valid and found.explains and found.verdict.biased() and not len(found.off)


@pytest.mark.slow
def test_bodiless_rows_have_no_instruments():
    """Rows without bodies have no instruments."""
    model = replace(model_of(BOTH)[0], torque_rows=DRIVE)
    base = bases.find(model)
    with pytest.raises(UsageError, match="rows motor, link or both"):
        identify_instrumental(model, base, [], log(BOTH).motion.decimator)
