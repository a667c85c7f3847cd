"""Joint corrections in dynamics: an arm with soft joints whose springs harden, which no fitted term describes."""

from dataclasses import replace
from functools import cache

import numpy as np
import planted_motion as planted
import pytest

from calib.data.recordings.recording import Recording
from calib.data.signals.motion import FilterOptions, make_motion
from calib.dynamics import rigid_body
from calib.dynamics.torque_rows import DRIVE
from calib.identification.identify import Identification, identify
from calib.identification.link_motion import with_link_motion
from calib.identification.prediction import predict
from calib.identification.rows import Case, make_case
from calib.identification.settings import IdentificationSettings
from calib.identification.uncertainty.geometry_uncertainty import deflection_sensitivity, propagate
from calib.robot import calibrated
from calib.robot.calibrated import CalibratedChain, CorrectedChain, Deflection, Term

SETTINGS = IdentificationSettings(friction="standard", essential="none", prior="none")
STIFFNESS = np.array([8e3, 4e3, 1.6e3])  # [N m/rad]
HARDENING = np.array([40.0, 45.0, 15.0])  # torques at which the springs are 1.3 times as stiff [N m]
BAND = 7.0  # of the deflection, below the joints' resonances of 8 Hz and more [Hz]


def derivatives(x: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and second derivative of a periodic series (N, n), by its spectrum."""
    omega = 2j * np.pi * np.fft.rfftfreq(len(x), period / len(x))[:, None]
    spectrum = np.fft.rfft(x, axis=0)
    first, second = (np.fft.irfft(omega**order * spectrum, len(x), axis=0) for order in (1, 2))
    return first, second


@cache
def soft(seed: int, noise: float = 0.0) -> Case:
    """Return a recording of the soft arm: link and motor in equilibrium, δ = -τ(q + δ) / k(τ), by iteration."""
    t, q, v, a = planted.motion(seed, duration=10.0)
    frequency, moved = np.fft.rfftfreq(len(t), 1.0 / planted.RATE), np.zeros_like(q)
    model = planted.model()
    for _ in range(60):
        link = q + moved
        tau = rigid_body.inverse_dynamics(model.bodies, planted.INERTIAS.ravel(), link, *derivatives(link, 10.0))
        spectrum = np.fft.rfft(-tau / STIFFNESS / (1.0 + 0.3 * np.abs(tau) / HARDENING), axis=0)
        spectrum[frequency > BAND] = 0.0
        new = np.fft.irfft(spectrum, len(t), axis=0)
        step, moved = np.abs(new - moved).max(), new
    assert step < 1e-9 and 2e-3 < np.abs(moved).max() < 0.03
    drives = planted.torques(q, v, a) - rigid_body.inverse_dynamics(model.bodies, planted.INERTIAS.ravel(), q, v, a)
    torque = np.tile(tau + drives, (3, 1)) + noise * np.random.default_rng(seed).normal(size=(3 * len(t), planted.N))
    times, names = np.arange(3 * len(t)) / planted.RATE, ("joint1", "joint2", "joint3")
    log = Recording(times, np.tile(q, (3, 1)), torque, "torque", names, file=f"soft {seed}")
    return make_case(f"soft {seed}", make_motion(log, FilterOptions(cutoff=40.0, band=8.0)))


def robot(compliance: np.ndarray = -1.0 / STIFFNESS, sigma: float = 0.0) -> CalibratedChain:
    """Return the arm as a fit leaves it: springs of one stiffness, and their uncertainty."""
    arm = planted.arm()
    terms = tuple(Term(arm.names[k], "torque", j) for j, k in enumerate(arm.moving))
    spread = np.diag([0.0] * len(arm.elements) + [sigma**2] * 3)
    bending = CorrectedChain(arm, Deflection(terms, np.asarray(compliance), arm), spread)
    return CalibratedChain(arm, arm, np.zeros((len(arm.elements),) * 2), bending)


def error(found: Identification, case: Case) -> float:
    """Return the torque error on a recording, both sides in the band [%]."""
    target, left = case.motion.in_band(case.target), case.motion.in_band(case.target - predict(found.dynamics, case))
    return float(100.0 * np.linalg.norm(left) / np.linalg.norm(target))


def test_link_moves_as_motor_and_deflection():
    """The link's motion is the motor's plus the deflection and its derivatives."""
    case = with_link_motion(robot(), soft(1), SETTINGS)
    motion, rate = case.motion, case.motion.rate
    q, v, a = (moved - own for moved, own in zip(case.links, (motion.q, motion.v, motion.a)))
    tau = rigid_body.inverse_dynamics(
        planted.model().bodies, planted.INERTIAS.ravel(), motion.q, motion.v, motion.a
    )  # gravity and inertia alike
    np.testing.assert_allclose(q, -motion.in_band(tau) / STIFFNESS, atol=1e-12)
    np.testing.assert_allclose(v[5:-5], np.gradient(q, 1 / rate, axis=0)[5:-5], atol=1e-9)
    np.testing.assert_allclose(a[5:-5], np.gradient(v, 1 / rate, axis=0)[5:-5], atol=1e-7)
    assert with_link_motion(robot(), soft(1), replace(SETTINGS, deflections=False)).link is None
    assert with_link_motion(robot().without_corrections(), soft(1), SETTINGS).link is None
    # rows without bodies, whose torques bend nothing
    assert with_link_motion(robot(), soft(1), replace(SETTINGS, torque_rows=DRIVE)).link is None


def test_deflection_improves_prediction():
    """Measured: 0.29 % rigid, 0.09 % with the springs; of the wrong sign 0.64 %."""
    errors = []
    for arm in (robot().without_corrections(), robot(), robot(1.0 / STIFFNESS)):
        learnt, other = (with_link_motion(arm, soft(seed), SETTINGS) for seed in (1, 2))
        errors.append(error(identify(arm, [learnt], SETTINGS), other))
    assert errors[1] < 0.5 * errors[0] and errors[2] > 1.5 * errors[0]


@pytest.mark.slow
def test_stiffness_slope_is_that_of_refits():
    """Measured: 0.3 % off."""
    step = 0.02 / STIFFNESS[1] * np.eye(3)[1]

    def refit(compliance: np.ndarray) -> Identification:
        arm = robot(compliance, sigma=1e-5)
        return identify(arm, [with_link_motion(arm, soft(1, noise=0.1), SETTINGS)], SETTINGS)

    found, arm = refit(-1.0 / STIFFNESS), robot(sigma=1e-5)
    case = with_link_motion(arm, soft(1, noise=0.1), SETTINGS)
    above, below = (refit(-1.0 / STIFFNESS + sign * step).fitted.estimate.values for sign in (1.0, -1.0))
    expected = (above - below) / (2.0 * step[1])
    slopes, sigma = deflection_sensitivity(found, arm, [case]), found.fitted.estimate.sigma
    assert np.linalg.norm((slopes[:, 1] - expected) / sigma) < 0.05 * np.linalg.norm(expected / sigma)
    carried = propagate(found, arm, [case])  # the geometry is exact, the springs are not
    np.testing.assert_allclose(carried.sigma_geometry, 1e-5 * np.linalg.norm(slopes, axis=1), rtol=1e-9)


def test_drives_alone_feel_no_deflection():
    """Model 3 (tau_m - tau_l) has no bodies, so that joint corrections do not change its estimate."""
    t, q, v, a = planted.motion(1)
    noise = 0.1 * np.random.default_rng(1).normal(size=q.shape)
    link = rigid_body.inverse_dynamics(planted.model().bodies, planted.INERTIAS.ravel(), q, v, a)
    names = ("joint1", "joint2", "joint3")
    log = Recording(t, q, planted.torques(q, v, a) + noise, "torque", names, tau_link=link, file="drives")
    case = make_case("drives", make_motion(log, FilterOptions(cutoff=40.0, band=8.0)), DRIVE)
    settings, arm = replace(SETTINGS, torque_rows=DRIVE), robot(sigma=1e-5)
    found = identify(arm, [case], settings)
    assert not deflection_sensitivity(found, arm, [case]).any()
    assert not propagate(found, arm, [case]).sigma_geometry.any()


def test_masses_of_springs_survive_the_file(tmp_path):
    """Identified masses of the springs' torques survive the file."""
    whole = robot(sigma=1e-5)
    heavier = replace(planted.arm(), inertias=1.2 * planted.INERTIAS)
    bending = replace(whole.corrections, deflection=replace(whole.deflection, reference=heavier))
    calibrated.write(tmp_path, replace(whole, corrections=bending))
    read = calibrated.read(tmp_path)
    assert read.deflection.terms == whole.deflection.terms
    np.testing.assert_array_equal(read.deflection.reference.inertias, heavier.inertias)
    np.testing.assert_array_equal(read.complete.inertias, planted.INERTIAS)
    with pytest.raises(Exception, match="masses"):
        path = tmp_path / calibrated.ROBOT
        path.write_text(path.read_text().replace("masses = [", "masses = [[1.0], ", 1))
        calibrated.read(tmp_path)
