"""The power model of serial arms: energies whose derivative is the power, one row per sample, weights by recording."""

import numpy as np
from arms import motley

from calib.data.recordings.recording import Recording
from calib.data.signals.motion import FilterOptions, make_motion
from calib.dynamics.bodies import bodies_of
from calib.dynamics.drives import coupled, standard
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.torque_rows import POWER
from calib.identification.identify import identify_model
from calib.identification.rows import make_case
from calib.identification.settings import IdentificationSettings


def model(n: int, drives: str = "Ia"):
    terms = (*standard([drives] * n, v0=0.5), *coupled(n - 2, n - 1, v0=0.5)[:1])
    return IdentificationModel(bodies_of(motley()), terms, POWER)


def motion(t: np.ndarray, n: int, seed: int = 0):
    """Return q, v, a (N, n) of a sum of sines."""
    rng = np.random.default_rng(seed)
    a, phase, w = rng.normal(size=(3, n)) * 0.4, rng.uniform(0, 6, (3, n)), rng.uniform(0.7, 4.0, (3, n))
    angle = w[:, None] * t[None, :, None] + phase[:, None]
    q = np.sum(a[:, None] * np.sin(angle), axis=0)
    v = np.sum((a * w)[:, None] * np.cos(angle), axis=0)
    return q, v, -np.sum((a * w**2)[:, None] * np.sin(angle), axis=0)


def test_energy_derivative_is_the_power():
    """Of every column: bodies, rotors, a rotor that two joints share; under gravity, with prismatic joints."""
    n = motley().n
    t = np.linspace(0.0, 1.0, 4001)
    q, v, a = motion(t, n)
    own = model(n)
    rising = np.gradient(own.energy_columns(q, v), t, axis=0)[1:-1]
    power = own.regressor(q, v, a)[1:-1, 0]
    assert np.allclose(rising, power, rtol=0, atol=1e-5 * np.abs(power).max())


def test_power_needs_no_accelerations():
    """Base parameters within their sigmas, from two recordings one of which is ten times as noisy."""
    n, away = motley().n, []
    own = model(n, "Ia Fv")
    truth = np.abs(np.random.default_rng(5).normal(size=own.p))
    for seed in range(4):
        cases = []
        for k, noise in enumerate((0.05, 0.5)):
            t = np.arange(4000) / 200.0
            q, v, a = motion(t, n, 10 * seed + k)
            joints = IdentificationModel(own.bodies, own.terms)
            tau = joints.torque(truth, q, v, a)
            tau += noise * np.random.default_rng(seed + 100 * k).normal(size=tau.shape)
            recording = Recording(t, q, tau, "torque", motley().joint_names, file=f"run{k}")
            cases.append(make_case(f"run{k}", make_motion(recording, FilterOptions(cutoff=20.0, band=8.0)), POWER))
        settings = IdentificationSettings(prior="none", essential="none", torque_rows=POWER)
        found = identify_model(own, cases, settings)
        estimate = found.fitted.estimate
        away.append((estimate.values - found.base.transform @ truth) / estimate.sigma)
        assert found.fitted.std[1] > 4.0 * found.fitted.std[0]
    assert 0.5 < np.sqrt(np.mean(np.concatenate(away) ** 2)) < 2.0
