"""Proposition 1 against Pinocchio: A = MΦ', B = MΦ'' + CΦ', Γ = G, and tau is the full inverse dynamics."""

import arms
import numpy as np
import pinocchio
import pytest
from pinocchio_model import model as pinocchio_model

from calib.dynamics import base, drives
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.path_dynamics import of_standard
from calib.dynamics.torque_rows import BOTH, DRIVE, MOTOR
from calib.errors import CalibError
from calib.robot.library import load

IA, FV, FC, OFF = (np.array(x) for x in ((2.0, 0.7), (9.0, 3.0), (11.0, 4.0), (0.4, -0.3)))


def driven(chain):
    """Return a model of the chain with Ia Fv Fc off per joint, and all its values."""
    model = IdentificationModel(bodies_of(chain), drives.standard(["Ia Fv Fc off"] * chain.n, 0.01))
    amounts = np.column_stack([np.resize(x, chain.n) for x in (IA, FV, FC, OFF)])
    return model, np.concatenate([standard_parameters(chain), amounts.ravel()])


def terms_by_pinocchio(chain, q, slope, curvature):
    made = pinocchio_model(chain)
    data, inertia = made.createData(), np.diag(np.resize(IA, chain.n))
    A, B, G = (np.empty_like(q) for _ in range(3))
    for k in range(len(q)):
        upper = pinocchio.crba(made, data, q[k])
        M = np.triu(upper) + np.triu(upper, 1).T + inertia
        C = pinocchio.computeCoriolisMatrix(made, data, q[k], slope[k])
        A[k], B[k] = M @ slope[k], M @ curvature[k] + C @ slope[k]
        G[k] = pinocchio.computeGeneralizedGravity(made, data, q[k]) + np.resize(OFF, chain.n)
    return A, B, G


@pytest.mark.parametrize("seen", ["standard", "base"])
@pytest.mark.parametrize("chain", [load("lwr4plus"), arms.motley()], ids=["lwr4plus", "motley"])
def test_the_three_terms_are_pinocchios(chain, seen):
    model, values = driven(chain)
    if seen == "base":
        found = base.find(model)
        dynamics = of_standard(model, found.to_standard(found.transform @ values))
    else:
        dynamics = of_standard(model, values)
    states = arms.states(chain.n, 12)
    for ours, theirs in zip(dynamics.along(*states), terms_by_pinocchio(chain, *states)):
        np.testing.assert_allclose(ours, theirs, atol=1e-10)


def test_path_torque_is_inverse_dynamics():
    """The torque along a path is the full inverse dynamics."""
    chain = load("lwr4plus")
    dynamics = of_standard(*driven(chain))
    q, slope, curvature = arms.states(chain.n, 30, seed=1)
    speed, pull = np.random.default_rng(0).normal(size=(2, 30, 1))
    v, a = slope * speed, slope * pull + curvature * speed**2
    A, B, G = dynamics.along(q, slope, curvature)
    made = pinocchio_model(chain)
    data = made.createData()
    rnea = np.array([pinocchio.rnea(made, data, *rows) for rows in zip(q, v, a)])
    full = rnea + np.resize(IA, 7) * a + np.resize(OFF, 7) + np.resize(FV, 7) * v + np.resize(FC, 7) * np.sign(v)
    np.testing.assert_allclose(A * pull + B * speed**2 + G + dynamics.friction(q, v, a), full, atol=1e-10)
    np.testing.assert_allclose(dynamics.torque(q, v, a), full, atol=1e-10)
    np.testing.assert_allclose(dynamics.rigid(q, v, a) + dynamics.friction(q, v, a), full, atol=1e-10)


def test_richer_friction_along_a_path():
    """Richer friction depends on load and past as far as a path can tell."""
    chain = load("lwr4plus")
    model, values = driven(chain)
    model = model.with_terms(drives.term("Ft2", "load", 1, 0.01), drives.term("Fp4.1", "presliding", 3, 1e-3, 0.01))
    q, v, a = arms.states(7, 5)
    plain, rich = of_standard(*driven(chain)), of_standard(model, np.append(values, [0.1, 2.0]))
    extra = rich.torque(q, v, a) - plain.torque(q, v, a)
    transmitted = plain.rigid(q, v, a) - np.resize(IA, 7) * a - np.resize(OFF, 7)
    np.testing.assert_allclose(extra[:, 1], 0.1 * np.abs(transmitted[:, 1]) * np.sign(v[:, 1]), atol=1e-10)
    np.testing.assert_allclose(extra[:, 3], 0.0, atol=1e-12)  # slides on: Fc alone says what it costs


def test_motor_torques_are_last_sensor_rows():
    """Motor torques are the last rows of a model with joint torque sensors."""
    chain = load("lwr4plus")
    terms = drives.standard(["Ia Fvl Fcl Fvm Fcm"] * 7)
    values = np.concatenate([standard_parameters(chain), np.tile([0.5, 1.0, 2.0, 3.0, 4.0], 7)])
    q, v, a = arms.states(7, 5)
    one = of_standard(IdentificationModel(bodies_of(chain), terms, MOTOR), values)
    two = of_standard(IdentificationModel(bodies_of(chain), terms, BOTH), values)
    np.testing.assert_allclose(two.torque(q, v, a), one.torque(q, v, a), atol=1e-12)


def test_bodiless_rows_and_nan_are_refused():
    """Rows without bodies and values that are no numbers are refused."""
    model, values = driven(load("lwr4plus"))
    with pytest.raises(CalibError, match="no bodies"):
        of_standard(IdentificationModel(model.bodies, model.terms, DRIVE), values[70:])
    with pytest.raises(CalibError, match="not finite"):
        of_standard(model, np.where(np.arange(model.p) == 3, np.nan, values))
