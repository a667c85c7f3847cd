"""Geometry from torques: joint offsets are told by gravity and a payload of known mass, and nothing else is made up."""

from dataclasses import replace

import numpy as np
import planted_motion as planted
import pytest

from calib.data.recordings.recording import Recording
from calib.data.signals.motion import FilterOptions, make_motion
from calib.identification.identify import Identification, identify
from calib.identification.rows import Case, make_case
from calib.identification.settings import IdentificationSettings, Payload
from calib.identification.uncertainty.joint_estimate import (
    JointEstimate,
    estimate_jointly,
    identify_jointly,
    independent_elements,
    prior_of,
    updated,
)
from calib.robot.calibrated import CalibratedChain

OFFSET = 0.01
LOAD = Payload(mass=2.0, com=(0.05, 0.025, 0.1))
SETTINGS = IdentificationSettings(friction="standard", essential="none", payloads={"load": LOAD})


def shifted(name: str, seed: int, carried: tuple[str, ...] = (), offset: float = OFFSET) -> Case:
    """Return a recording of an arm whose second joint shows `offset` less than its angle."""
    log = planted.series(seed, payload=bool(carried), duration=12.0)
    q = log["q"] - np.array([0.0, offset, 0.0])
    recording = Recording(log["t"], q, log["tau"], "torque", ("joint1", "joint2", "joint3"), file=name)
    return make_case(name, make_motion(recording, FilterOptions(cutoff=30.0, band=10.0)), carried=carried)


@pytest.fixture(scope="module")
def cases() -> tuple[Case, ...]:
    return shifted("free", 0), shifted("loaded", 1, ("load",))


@pytest.fixture(scope="module")
def identification(cases) -> Identification:
    return identify(planted.arm(), cases, SETTINGS)


@pytest.fixture(scope="module")
def joint(identification, cases) -> JointEstimate:
    robot = CalibratedChain(planted.arm())
    return identify_jointly(identification, robot, cases, SETTINGS).estimate


@pytest.mark.slow
def test_the_offset_of_a_lifting_joint_is_recovered_within_its_sigma(joint):
    k = joint.elements.index("shoulder")
    assert joint.sigma[k] < 5e-3 < joint.sigma_before[k]
    assert abs(joint.change[k] - OFFSET) < 3.0 * joint.sigma[k] + 1e-4
    assert joint.identified[k] and joint.held_out < 1.0


@pytest.mark.slow
def test_offsets_of_the_first_and_the_last_joint_are_frames(joint):
    assert "turn" not in joint.elements and "elbow" not in joint.elements
    assert set(joint.elements) <= {"shoulder", "up", "upper", "gravity.rx", "gravity.ry"}


def test_independent_elements_prefer_offsets():
    chain = planted.arm()
    names = [chain.names[k] for k in independent_elements(chain).index]
    assert "shoulder" in names and "fore" not in names


@pytest.mark.slow
def test_no_torque_widens_a_sigma(joint):
    assert (joint.sigma <= joint.sigma_before * (1.0 + 1e-9)).all()
    assert np.linalg.eigvalsh(joint.covariance).min() > -1e-12


@pytest.mark.slow
def test_torques_of_other_joint_zeros_are_far_from_a_fit(joint):
    robot = CalibratedChain(planted.arm(), covariance=np.diag(np.full(6, 1e-10)))
    k = joint.elements.index("shoulder")
    assert abs(joint.distances(robot)[k]) > 5.0


@pytest.mark.slow
def test_where_torques_say_little_the_fit_counts(identification, cases):
    covariance = np.diag(np.where(np.array(planted.arm().names) == "shoulder", 1e-5**2, 0.0))
    fit = CalibratedChain(planted.arm(), covariance=covariance)
    after = estimate_jointly(identification, fit, cases)
    k = after.elements.index("shoulder")
    assert after.sigma[k] == pytest.approx(1e-5, rel=0.05) and abs(after.change[k]) < 1e-4


@pytest.mark.slow
def test_an_exact_geometry_stays_exact(cases):
    exact = tuple(shifted(case.name, seed, case.carried, 0.0) for seed, case in enumerate(cases))
    found = identify(planted.arm(), exact, SETTINGS)
    joint = estimate_jointly(found, CalibratedChain(planted.arm()), exact)
    assert (np.abs(joint.change) < 3.5 * joint.sigma).all()


@pytest.mark.slow
def test_the_updated_robot_has_the_estimates_values_and_covariance(joint):
    robot = CalibratedChain(planted.arm())
    after, settings = updated(robot, SETTINGS, joint)
    k = after.chain.names.index("shoulder")
    position = joint.elements.index("shoulder")
    assert after.chain.values[k] == pytest.approx(joint.after[position])
    assert after.covariance is not None
    assert np.sqrt(after.covariance[k, k]) == pytest.approx(joint.sigma[position])
    assert np.linalg.norm(after.chain.gravity) == pytest.approx(np.linalg.norm(robot.chain.gravity))
    assert after.nominal is not None and after.nominal.values[k] == 0.0 and settings.gravity is None


def test_a_fit_is_its_own_prior():
    chain = planted.arm()
    covariance = np.diag(np.arange(1.0, 7.0) * 1e-8)
    prior = prior_of(CalibratedChain(chain, covariance=covariance))
    assert np.array_equal(prior[:6, :6], covariance)


@pytest.mark.slow
def test_a_doubted_payload_counts_as_one_that_nobody_stated(identification, cases):
    robot = CalibratedChain(planted.arm())
    heavy = replace(SETTINGS, payloads={"load": replace(LOAD, mass=4.0)})
    doubted = estimate_jointly(replace(identification, settings=heavy), robot, cases, doubted=("load",))
    unstated = replace(SETTINGS, payloads={"load": Payload()})
    without = estimate_jointly(replace(identification, settings=unstated), robot, cases)
    assert np.allclose(doubted.change, without.change) and np.allclose(doubted.covariance, without.covariance)
