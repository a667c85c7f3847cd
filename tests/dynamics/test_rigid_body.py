"""Identities: regressor · parameters = inverse dynamics = Pinocchio; gradients."""

import numpy as np
import pinocchio_model as model
import pytest
from arms import LIBRARY, motley, physical, states
from closed_tree import from_inertia
from differences import check

from calib.dynamics import rigid_body
from calib.dynamics.bodies import bodies_of, standard_parameters, with_payload
from calib.errors import CalibError, RobotError
from calib.robot.chain import Chain, Element, Joint
from calib.robot.library import load
from calib.transforms import displace

ARMS = {name: load(name) for name in LIBRARY} | {"motley": motley()}


def relative(found, wanted):
    return np.abs(found - wanted).max() / np.abs(wanted).max()


@pytest.mark.parametrize("name", ARMS)
def test_agrees_with_pinocchio(name):
    chain = ARMS[name]
    bodies, chi = bodies_of(chain), physical(chain.n).ravel()
    q, v, a = states(chain.n)
    assert relative(rigid_body.regressor(bodies, q, v, a), model.regressor(chain, q, v, a)) < 1e-12
    tau = rigid_body.inverse_dynamics(bodies, chi, q, v, a)
    assert relative(tau, model.inverse_dynamics(chain, chi, q, v, a)) < 1e-12
    assert relative(rigid_body.regressor(bodies, q, v, a) @ chi, tau) < 1e-12


def test_pinocchio_carries_massless_bodies():
    """Pinocchio carries bodies without mass."""
    chain = ARMS["lwr4plus"]
    rng = np.random.default_rng(1)
    chi = rng.normal(size=70)
    chi[9::10] = rng.uniform(1.0, 2.0, 7)
    chi[[9, 39]] = 0.0
    q, v, a = states(7)
    tau = rigid_body.inverse_dynamics(bodies_of(chain), chi, q, v, a)
    assert relative(model.inverse_dynamics(chain, chi, q, v, a), tau) < 1e-12


def test_inertia_round_trip():
    chi = physical(1)[0]
    assert np.allclose(from_inertia(model.to_inertia(chi)), chi, rtol=0, atol=1e-15)


@pytest.mark.parametrize("name", ARMS)
def test_mass_matrix_is_pinocchios(name):
    import pinocchio as pin

    chain = ARMS[name]
    chi, q = physical(chain.n).ravel(), states(chain.n, 5)[0]
    matrix, made = rigid_body.mass_matrix(bodies_of(chain), chi, q), model.model(chain, chi)
    for one, at in zip(matrix, q):
        upper = np.triu(pin.crba(made, made.createData(), at))
        assert np.allclose(one, upper + np.triu(upper, 1).T, rtol=0, atol=1e-12 * np.abs(matrix).max())


@pytest.mark.parametrize("name", ["lwr4plus", "motley", "mimic", "payload"])
def test_gradient_of_the_regressor(name):
    bodies = {"mimic": lambda: bodies_of(mimic()), "payload": lambda: with_payload(bodies_of(motley()), np.eye(4))}.get(
        name, lambda: bodies_of(ARMS[name])
    )()
    n, rng = bodies.n, np.random.default_rng(5)
    x = rng.normal(size=3 * n)
    weights = rng.normal(size=(1, n, 10 * bodies.count))

    def weighted(x):
        return np.sum(weights * rigid_body.regressor(bodies, *x.reshape(3, 1, n)))

    slopes = np.concatenate([g[0] for g in rigid_body.regressor_gradient(bodies, *x.reshape(3, 1, n), weights)])
    assert check(weighted, slopes, x) < 1e-8
    chi, push = rng.normal(size=10 * bodies.count), rng.normal(size=(1, n))
    of_torques = rigid_body.torque_gradient(bodies, chi, *x.reshape(3, 1, n), push)
    of_rows = rigid_body.regressor_gradient(bodies, *x.reshape(3, 1, n), push[:, :, None] * chi)
    assert np.allclose(of_torques, of_rows, rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", ["lwr4plus", "motley", "mimic", "payload"])
def test_products_with_the_regressor(name):
    """Y χ and Σ w · Y are those of the formed regressor, also where samples fill no whole lane and angles are large."""
    special = {"mimic": lambda: bodies_of(mimic()), "payload": lambda: with_payload(bodies_of(motley()), np.eye(4))}
    bodies = special.get(name, lambda: bodies_of(ARMS[name]))()
    random = np.random.default_rng(7)
    q, v, a, weights = random.normal(size=(4, 150, bodies.n))
    q[0] = 2e6
    chi = random.normal(size=10 * bodies.count)
    formed = rigid_body.regressor(bodies, q, v, a)
    lighter = bodies.with_gravity(0.5 * bodies.gravity)
    (torque, sums), (other, _) = rigid_body.regressor_products([bodies, lighter], chi, q, v, a, weights)
    assert relative(other.T, rigid_body.regressor(lighter, q, v, a) @ chi) < 1e-13
    assert relative(torque.T, formed @ chi) < 1e-13
    assert relative(sums, np.tensordot(weights, formed, 2)) < 1e-13


def test_torque_gradient_is_pinocchios():
    """The gradient of torques agrees with Pinocchio in batch."""
    import pinocchio as pin

    chain, chi = ARMS["lwr4plus"], physical(7).ravel()
    q, v, a = states(7, 4)
    push = np.random.default_rng(2).normal(size=(4, 7))
    found = rigid_body.regressor_gradient(bodies_of(chain), q, v, a, push[:, :, None] * chi)
    made = model.model(chain, chi)
    data = made.createData()
    for k in range(4):
        slopes = pin.computeRNEADerivatives(made, data, q[k], v[k], a[k])
        for got, (index, matrix) in zip(found, enumerate(slopes)):
            matrix = np.triu(matrix) + np.triu(matrix, 1).T if index == 2 else matrix
            assert np.allclose(got[k], push[k] @ matrix, rtol=0, atol=1e-11)


def mimic() -> Chain:
    """Return two joints where the first one also drives a third body at -1.5 times its rate."""
    step = displace(np.eye(4), [0.3, 0.1, 0.0, 0.4, 0.2, 0.1])
    return Chain(
        "mimic",
        (Joint("a"), Joint("b")),
        (
            Element("one", "rz", 0.1, 0, 0),
            Element("two", "ry", 0.2, 1, 1, placement=step),
            Element("three", "rx", 0.3, 1, 0, ratio=-1.5, placement=step),
        ),
    )


def test_mimic_ties_coordinates_of_a_chain():
    """A mimic joint is a chain of three with tied coordinates."""
    tied = bodies_of(mimic())
    free = Chain(
        "free",
        (Joint("a"), Joint("b"), Joint("c")),
        tuple(Element(e.name, e.axis, e.value, k, k, placement=e.placement) for k, e in enumerate(mimic().elements)),
    )
    q, v, a = states(2)
    spread = np.array([[1.0, 0.0], [0.0, 1.0], [-1.5, 0.0]])
    wanted = np.einsum(
        "jc,kjp->kcp", spread, rigid_body.regressor(bodies_of(free), q @ spread.T, v @ spread.T, a @ spread.T)
    )
    assert tied.labels == ("1", "2", "1b")
    assert relative(rigid_body.regressor(tied, q, v, a), wanted) < 1e-13
    chi = physical(3).ravel()
    tau = rigid_body.inverse_dynamics(tied, chi, q, v, a)
    assert relative(tau, wanted @ chi) < 1e-13


def test_payload_is_a_body_of_its_own():
    """A payload's torques are those of the last link with the payload's parameters moved into its frame."""
    from calib.robot.formats.urdf_tree import transform_body

    chain, load_ = ARMS["lwr4plus"], physical(1, 4)[0]
    placement = displace(np.eye(4), [0.1, -0.2, 0.3, 0.4, 0.5, 0.6])
    loaded = with_payload(bodies_of(chain), placement)
    assert loaded.names[-1] == "M8" and loaded.count == 8 and loaded.n == 7
    chi = standard_parameters(chain)
    merged = chi.copy()
    merged[-10:] += transform_body(load_, placement)
    q, v, a = states(7)
    found = rigid_body.inverse_dynamics(loaded, np.concatenate([chi, load_]), q, v, a)
    wanted = rigid_body.inverse_dynamics(bodies_of(chain), merged, q, v, a)
    assert relative(found, wanted) < 1e-13
    assert relative(rigid_body.regressor(loaded, q, v, a) @ np.concatenate([chi, load_]), wanted) < 1e-13
    with pytest.raises(RobotError, match="exists already"):
        with_payload(loaded, placement)


def test_sine_and_cosine_of_the_kernels():
    """Within 3e-16 of the library's over the whole range, at the quadrants' borders, and NaN stays NaN."""
    from calib.dynamics.kernels import sincos

    x = np.concatenate([np.arange(-40, 41) * np.pi / 4, np.random.default_rng(0).uniform(-1e6, 1e6, 2000), [0.0]])
    found = np.array([sincos(one) for one in x])
    assert np.abs(found - np.stack([np.sin(x), np.cos(x)], axis=1)).max() < 3e-16
    assert np.isnan(sincos(np.nan)).all()


def test_angles_of_many_turns():
    bodies = bodies_of(ARMS["ur5"])
    q, v, a = states(6)
    turns = 2 * np.pi * 1e6
    far = rigid_body.regressor(bodies, q + turns, v, a)
    assert relative(far, rigid_body.regressor(bodies, q, v, a)) < 1e-8  # the angle itself is only good to 1e-9


def test_gravity_is_a_parameter():
    chain = ARMS["lwr4plus"]
    q, v, a = states(7)
    still = bodies_of(chain).with_gravity(np.zeros(3))
    chi = standard_parameters(chain)
    assert np.abs(rigid_body.inverse_dynamics(still, chi, q, 0 * v, 0 * a)).max() == 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: (s[0][:, :5], s[1], s[2]), "joint positions q: expected .*, 7"),
        (lambda s: (s[0], s[1][:3], s[2]), "joint velocities v: expected .*20, 7"),
        (lambda s: (s[0], s[1], np.where(s[2] == s[2][3, 2], np.nan, s[2])), r"index \(3, 2\) is not finite"),
    ],
)
def test_bad_input_is_named(change, message):
    with pytest.raises(CalibError, match=message):
        rigid_body.regressor(bodies_of(ARMS["lwr4plus"]), *change(states(7)))
