"""Populations: planted errors are of the sizes stated, follow from the seed, and are compared with what is fitted."""

import numpy as np
import pytest

import calib
from calib.errors import CalibError, UsageError

NOTHING = calib.PlantedErrors(length=0, angle=0, offset=0, compliance=0, harmonics=0, unmodelled=0, masses=0)
EXACT = calib.SimulatedInstrument(position_sigma=0.0, orientation_sigma=0.0, encoder_sigma=0.0)


FRICTION = calib.FrictionTerm("Fa", lambda v: np.tanh(5.0 * v), lambda v: 5.0 * (1.0 - np.tanh(5.0 * v) ** 2))


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def test_nothing_planted_is_the_description():
    """Without errors and noise the true arm is the described one, in poses, measurements and comparisons."""
    arm = calib.population("tx40", 1, errors=NOTHING, instrument=EXACT)[0]
    q = arm.postures(20)
    np.testing.assert_allclose(arm.poses(q), arm.nominal.forward(q), atol=1e-12)
    np.testing.assert_allclose(arm.poses(q[0]), arm.nominal.forward(q[0]), atol=1e-12)
    assert arm.position_errors(arm.nominal, q).max() < 1e-9
    np.testing.assert_array_equal(arm.measure(q).q, q)


def test_each_kind_of_error_has_its_stated_size():
    errors = calib.PlantedErrors(length=1e-3, angle=0.0, offset=2e-3, compliance=0, harmonics=0, unmodelled=0)
    arms = calib.population("ur5", 100, errors=errors)
    elements = arms[0].nominal.chain.elements
    changes = np.array([arm.truth.chain.values - arm.nominal.chain.values for arm in arms])
    for k, element in enumerate(elements):
        size = 1e-3 if element.unit == "m" else 2e-3 if element.joint is not None else 0.0
        assert changes[:, k].std() == pytest.approx(size, rel=0.3, abs=1e-15)


def test_seeds_repeat_an_arm_and_its_files():
    """Arm 3 of a population is the first of that with seed 3; other seeds differ in truth and in noise."""
    arm, other = calib.population("ur5", 2, seed=2)[1], calib.population("ur5", 1, seed=3)[0]
    q = arm.postures(5)
    np.testing.assert_array_equal(q, other.postures(5))
    np.testing.assert_array_equal(arm.measure(q).position, other.measure(q).position)
    assert np.abs(arm.measure(q, seed=1).position - arm.measure(q).position).max() > 1e-6


@pytest.mark.slow
def test_a_fit_comes_near_the_hidden_truth():
    """What no rigid geometry describes remains; the fit itself, and its robot newly placed, are both compared."""
    arm = calib.population("ur5", 1, seed=5)[0]
    fit = calib.fit_geometry(arm.nominal, arm.measure(arm.postures(40)), calib.FitSettings(model="geometry"))
    unseen = arm.postures(200, seed=9)
    nominal = rms(arm.position_errors(arm.nominal, unseen))
    fitted = rms(arm.position_errors(fit, unseen))
    placed = rms(arm.position_errors(fit.robot, unseen))
    assert rms(arm.position_errors(arm.truth, unseen)) < placed <= 1.05 * fitted < 0.2 * nominal


@pytest.mark.parametrize("kind", ("pose", "position", "distance", "bar", "sockets", "plane"))
def test_every_kind_of_measurement_is_made(kind):
    """Measured exactly on a rigid arm, the described arm of the truth explains all of it."""
    arm = calib.population("ur10", 1, seed=1)[0]
    measured = arm.measure(arm.postures(48), kind=kind)
    assert len(measured) > 20 and measured.joint_names == arm.nominal.chain.joint_names


def test_logs_have_the_planted_friction():
    """Noise-free torques with a further friction term differ from those without by this term alone."""
    arm = calib.population("tx40", 1, seed=3, errors=calib.PlantedErrors(unmodelled=0.0), torque_sensors=True)[0]
    motion = arm.motion(seconds=2.0)
    states = motion.q, motion.v, motion.a
    amounts = np.arange(1.0, 7.0)
    more = arm.with_friction(FRICTION, amounts).torques(*states) - arm.torques(*states)
    np.testing.assert_allclose(more, amounts * np.tanh(5.0 * motion.v), atol=1e-4)


@pytest.mark.slow
def test_an_arm_is_identified_from_its_log():
    """The torque of a log, with sensors behind the gears, is near the true torque of the same motion."""
    arm = calib.population("tx40", 1, seed=3, errors=calib.PlantedErrors(unmodelled=0.0), torque_sensors=True)[0]
    log = arm.record(arm.motion(seconds=6.0), seed=1)
    assert log.tau_link is not None and log.q.shape[1] == 6
    model = calib.identify_dynamics(arm.nominal, log, friction="standard")
    motion = arm.motion(seconds=4.0, seed=2)
    states = motion.q, motion.v, motion.a
    true = arm.torques(*states)
    assert np.linalg.norm(model.torques(*states) - true) < 0.1 * np.linalg.norm(true)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda arm: calib.population("ur5", 0), "count = 0: ask for one arm or more"),
        (lambda arm: calib.population("ur5", 1, seed=-1), "seed = -1: expected a whole number, 0 or more"),
        (lambda arm: arm.postures(-1), "count = -1: expected 0 or more"),
        (lambda arm: arm.postures(1, seed=-1), "seed = -1"),
        (lambda arm: arm.motion(0), "seconds = 0: expected a duration above 0"),
        (lambda arm: arm.motion(5, rate=-1), "rate = -1: expected a number above 0"),
        (lambda arm: arm.motion(5, rate=1), "expected 20 samples or more, found 5"),
        (lambda arm: arm.nominal.forward("a"), "q: expected numbers: could not convert"),
        (lambda arm: arm.with_friction(FRICTION, 1.0).with_friction(FRICTION, 1.0), "the arm has Fa1 already"),
        (lambda arm: calib.PlantedErrors(length=-1.0), "length: expected 0 or more, found -1"),
        (lambda arm: calib.SimulatedInstrument(position_sigma=-1.0), "position_sigma = -1.0: expected 0 or more"),
        (lambda arm: arm.record(arm.motion(2.0)), "the description of ur5 has no masses"),
        (lambda arm: arm.measure(arm.postures(3), kind="laser"), "kind of measurement 'laser' is not one of pose"),
        (lambda arm: arm.record((1.0, 2.0, 3.0)), "motion: expected t, q, v, a, found 3 arrays"),
        (lambda arm: arm.measure(np.zeros((3, 5))), "q: expected an array of shape"),
    ],
)
def test_wrong_wishes_are_refused(make, message):
    with pytest.raises((UsageError, CalibError), match=message):
        make(calib.population("ur5", 1)[0])
