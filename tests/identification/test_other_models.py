"""A model that is no serial chain is identified like one: a planar four-bar, reduced to the angle of its crank."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from calib.data.recordings.recording import Recording
from calib.data.signals.motion import FilterOptions, make_motion
from calib.dynamics import drives
from calib.dynamics.drives import DriveTerm
from calib.dynamics.regressor_model import States
from calib.dynamics.torque_rows import Projection, TorqueRows, projected
from calib.errors import CalibError, UsageError
from calib.identification.identify import identify_model
from calib.identification.loop.loop_settings import LoopSettings
from calib.identification.prediction import predict
from calib.identification.rows import make_case
from calib.identification.scores import score
from calib.identification.settings import IdentificationSettings

GROUND, CRANK, COUPLER, ROCKER, G = 1.0, 0.3, 0.9, 0.7, 9.81
CRANK_ROW = projected("crank", Projection(("crank",), ("N m",), lambda q, v: np.ones((len(q), 1, 1))))


@dataclass(frozen=True)
class FourBar:
    """Three links in a closed chain, moved by the crank alone; q, v, a are the crank's, (N, 1).

    The regressor is Jᵀ W of the three links' absolute angles θ(q), J = dθ/dq: gravity and inertia of planar bodies
    (ZZ about the joint that carries the link, MX, MY; of the coupler M besides), and the crank's friction.
    """

    n, rows, torque_rows = 1, 1, CRANK_ROW
    names = ("ZZ1", "MX1", "MY1", "ZZ2", "MX2", "MY2", "M2", "ZZ3", "MX3", "MY3", "Fv1", "Fc1")
    units = ("kg m²", "kg m", "kg m", "kg m²", "kg m", "kg m", "kg", "kg m²", "kg m", "kg m", "N m s/rad", "N m")
    p, inertial = 12, 10

    @property
    def columns(self) -> tuple[DriveTerm, ...]:
        return drives.standard(["Fv Fc"])

    def regressor(self, q, v, a, load=None, carried=None, states=None):
        W = np.zeros((len(q), 1, self.p))
        crank, coupler, rocker = angles(q[:, 0], v[:, 0], a[:, 0])
        (first, dfirst, ddfirst), (second, dsecond, ddsecond), (third, _, ddthird) = crank, coupler, rocker
        elbow = CRANK * np.array([np.cos(first), np.sin(first)])
        acceleration = np.array([-elbow[1] * ddfirst - elbow[0] * dfirst**2, elbow[0] * ddfirst - elbow[1] * dfirst**2])
        jacobian = [np.ones(len(q)), *rates(first, second, third)]
        W[:, 0, 0], W[:, 0, 1], W[:, 0, 2] = ddfirst, G * np.cos(first), -G * np.sin(first)
        c, s = np.cos(second), np.sin(second)
        up = acceleration + np.array([[0.0], [G]])
        moved = np.array([-elbow[1], elbow[0]])  # of the elbow per rad of the crank
        W[:, 0, 3] = jacobian[1] * ddsecond
        for column, (x, y) in ((4, (c, s)), (5, (-s, c))):  # first moments along and across the coupler
            own = np.array([-y * ddsecond - x * dsecond**2, x * ddsecond - y * dsecond**2])
            W[:, 0, column] = jacobian[1] * (x * up[1] - y * up[0]) + np.sum(moved * own, axis=0)
        W[:, 0, 6] = np.sum(moved * up, axis=0)
        W[:, 0, 7] = jacobian[2] * ddthird
        W[:, 0, 8], W[:, 0, 9] = jacobian[2] * G * np.cos(third), -jacobian[2] * G * np.sin(third)
        W[:, 0, 10], W[:, 0, 11] = v[:, 0], np.tanh(v[:, 0] / 0.01)
        return W

    def torque(self, values, q, v, a, carried=None, states=None):
        return self.regressor(q, v, a) @ values

    def acting(self):
        return np.ones((self.p, 1), dtype=bool)

    def preference(self):
        return np.arange(self.p)

    def load_cases(self):
        return (None,)

    def sample(self, count, rng, lower=None, upper=None):
        return States(rng.uniform(-np.pi, np.pi, (count, 1)), *rng.uniform(-3.0, 3.0, (2, count, 1)))


def angles(q, v, a):
    """Return angle, speed and acceleration of crank, coupler and rocker, the closure solved in closed form."""
    x, y = GROUND - CRANK * np.cos(q), -CRANK * np.sin(q)
    reach = np.hypot(x, y)
    second = np.arctan2(y, x) + np.arccos((COUPLER**2 + reach**2 - ROCKER**2) / (2 * COUPLER * reach))
    tip = np.array([CRANK * np.cos(q) + COUPLER * np.cos(second), CRANK * np.sin(q) + COUPLER * np.sin(second)])
    third = np.arctan2(tip[1], tip[0] - GROUND)
    one, two = rates(q, second, third)
    speeds = v * np.array([np.ones_like(q), one, two])
    matrix = closure(second, third)
    rest = CRANK * np.array([np.cos(q), np.sin(q)]) * v**2 + CRANK * np.array([np.sin(q), -np.cos(q)]) * a
    rest += COUPLER * np.array([np.cos(second), np.sin(second)]) * speeds[1] ** 2
    rest -= ROCKER * np.array([np.cos(third), np.sin(third)]) * speeds[2] ** 2
    found = np.linalg.solve(matrix, rest.T[:, :, None])[:, :, 0].T
    return (q, v, a), (second, speeds[1], found[0]), (third, speeds[2], found[1])


def closure(second, third):
    """Return the (N, 2, 2) matrix of the differentiated loop, crank + coupler = ground + rocker."""
    columns = (-COUPLER * np.sin(second), ROCKER * np.sin(third)), (COUPLER * np.cos(second), -ROCKER * np.cos(third))
    return np.array(columns).transpose(2, 0, 1)


def rates(first, second, third):
    """Return dθ2/dq and dθ3/dq (N,) each."""
    rest = CRANK * np.array([np.sin(first), -np.cos(first)])
    return np.linalg.solve(closure(second, third), rest.T[:, :, None])[:, :, 0].T


TRUTH = np.array([0.04, 0.30, 0.02, 0.25, 0.50, -0.03, 1.2, 0.12, 0.35, 0.04, 0.8, 1.5])
PLAIN = IdentificationSettings(prior="none", essential="none")


def case(seed: int, noise: float = 0.1):
    """Return a recording of the crank, whose torque a motor would log."""
    rng, rate = np.random.default_rng(seed), 200.0
    t = np.arange(int(20.0 * rate)) / rate
    omega, size = 2 * np.pi / 10.0 * np.arange(1, 7), rng.normal(size=(2, 6)) / np.sqrt(np.arange(1, 7))
    s, c = np.sin(np.outer(t, omega)), np.cos(np.outer(t, omega))
    q, v = s @ size[0] + c @ size[1], (c * omega) @ size[0] - (s * omega) @ size[1]
    a = -(s * omega**2) @ size[0] - (c * omega**2) @ size[1]
    states = (x[:, None] for x in (q, v, a))
    tau = FourBar().torque(TRUTH, *states) + noise * rng.normal(size=(len(t), 1))
    recording = Recording(t, q[:, None], tau, "torque", ("crank",), file=f"run{seed}")
    return make_case(f"run{seed}", make_motion(recording, FilterOptions(cutoff=30.0, band=10.0)), CRANK_ROW)


def test_the_reduced_regressor_is_that_of_the_energy():
    """Power of the model without friction is the change of kinetic and potential energy along a motion."""
    t = np.linspace(0.0, 2.0, 20001)
    q, v, a = np.sin(2 * t)[:, None], 2 * np.cos(2 * t)[:, None], -4 * np.sin(2 * t)[:, None]
    values = np.append(TRUTH[:10], [0.0, 0.0])
    (one, d1, _), (two, d2, _), (three, d3, _) = angles(q[:, 0], v[:, 0], a[:, 0])
    zz1, mx1, my1, zz2, mx2, my2, m2, zz3, mx3, my3 = values[:10]
    velocity = CRANK * d1 * np.array([-np.sin(one), np.cos(one)])
    centre = np.array([mx2 * np.cos(two) - my2 * np.sin(two), mx2 * np.sin(two) + my2 * np.cos(two)])
    moved = d2 * np.array([-centre[1], centre[0]])
    kinetic = 0.5 * (zz1 * d1**2 + zz2 * d2**2 + zz3 * d3**2 + m2 * np.sum(velocity**2, axis=0))
    kinetic += np.sum(velocity * moved, axis=0)
    height = mx1 * np.sin(one) + my1 * np.cos(one) + m2 * CRANK * np.sin(one) + centre[1]
    energy = kinetic + G * (height + mx3 * np.sin(three) + my3 * np.cos(three))
    power = FourBar().torque(values, q, v, a)[:, 0] * v[:, 0]
    assert np.allclose(np.gradient(energy, t)[1:-1], power[1:-1], rtol=0, atol=1e-5 * np.abs(power).max())


def test_a_four_bar_is_identified_within_its_covariance():
    """Fewer base parameters than standard ones; all of them within what their sigmas say, over ten recordings."""
    model, away = FourBar(), []
    for seed in range(10):
        found = identify_model(model, [case(seed)], PLAIN)
        truth = found.base.transform @ TRUTH
        estimate = found.fitted.estimate
        away.append((estimate.values - truth) / estimate.sigma)
    assert found.base.b < model.p and {"Fv1", "Fc1"} <= set(found.names)
    assert found.dynamics.model is model and found.friction.terms == () and found.ripples == ()
    assert 0.6 < np.sqrt(np.mean(np.array(away) ** 2)) < 1.5
    other = case(77)
    assert score(other, predict(found.dynamics, other)).filtered.total < 1.0


def test_essential_parameters_and_the_other_methods_serve_it_too():
    recorded = [case(0)]
    for method in ("ols", "irls", "tls"):
        found = identify_model(FourBar(), recorded, IdentificationSettings(method=method, prior="none"))
        assert found.fitted.found and found.fitted.method == method and found.elimination is not None
        assert abs(dict(zip(found.names, found.fitted.estimate.values))["Fv1"] - 0.8) < 0.1


def test_what_only_a_chain_has_is_asked_for():
    with pytest.raises(UsageError, match="holds no masses"):
        identify_model(FourBar(), [case(0)], IdentificationSettings(prior="cad"))
    loop = IdentificationSettings(method="didim", loop=LoopSettings("pd", (100.0,), (10.0,)))
    with pytest.raises(CalibError, match="can be simulated"):
        identify_model(FourBar(), [case(0)], loop)
    assert isinstance(CRANK_ROW, TorqueRows) and not CRANK_ROW.motors_alone
