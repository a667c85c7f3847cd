"""The families: derivatives with respect to time and to the variables, rest at both ends, bounds, refusals."""

import numpy as np
import pytest
from differences import check

from calib.trajectories.basis import aligned_period, sample_times
from calib.trajectories.bspline import bspline_family
from calib.trajectories.errors import BadInput
from calib.trajectories.fourier import evaluate, fourier_family

FAMILIES = [
    fourier_family((3, 5, 2), 4.0),
    fourier_family(3, 4.0, 3, rest=False),
    fourier_family(4, 4.0, 3, start=np.array([0.3, -1.0, 2.0])),
    bspline_family(9, 4.0, 3),
    bspline_family((12, 9, 1), 4.0, start=np.array([0.3, -1.0, 2.0])),
]
IDS = ["fourier", "not at rest", "given start", "spline", "spline, one joint locked"]


def drawn(family, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=family.basis(np.zeros(1)).p)


@pytest.mark.parametrize("family", FAMILIES, ids=IDS)
def test_orders_are_successive_derivatives(family):
    """Each order is the derivative of the one before."""
    x, t = drawn(family), np.array([0.37, 1.9, 3.61])
    orders = family.basis(t).motion(x).orders
    for order in range(3):

        def at(s, order=order):
            return family.basis(t + s[0]).motion(x).orders[order]

        check(at, orders[order + 1][..., None], np.zeros(1), tolerance=1e-6)


@pytest.mark.parametrize("family", FAMILIES, ids=IDS)
def test_adjoint_is_derivative_by_variables(family):
    """The adjoint is the derivative by the variables."""
    basis = family.basis(sample_times(4.0, 11))
    weights = np.random.default_rng(1).normal(size=(4, 11, 3))

    def f(x):
        return sum((w * o).sum() for w, o in zip(weights, basis.motion(x).orders))

    check(f, basis.adjoint(weights[None])[0], drawn(family))


@pytest.mark.parametrize("family", [f for f, name in zip(FAMILIES, IDS) if name != "not at rest"])
def test_any_variables_start_and_end_at_rest(family):
    motion = family.basis(np.array([0.0, 4.0 - 1e-12])).motion(drawn(family))
    assert np.abs(motion.v).max() < 1e-7 and np.abs(motion.a).max() < 1e-6
    assert np.allclose(motion.q[0], motion.q[1], atol=1e-9)


def test_a_given_start_is_kept():
    family = fourier_family(4, 4.0, 3, start=np.array([0.3, -1.0, 2.0]))
    assert np.allclose(family.basis(np.zeros(1)).motion(drawn(family)).q, [[0.3, -1.0, 2.0]])


def test_equation_23_agrees_with_tables():
    """Equation 23, term by term, agrees with the tables."""
    family = FAMILIES[0]
    x, t = drawn(family), np.linspace(0, 4, 17)
    for order, values in enumerate(family.basis(t).motion(x).orders):
        assert np.allclose(evaluate(family.coefficients(x), 4.0, t, order), values, atol=1e-9)


@pytest.mark.parametrize("family", FAMILIES, ids=IDS)
def test_evaluation_without_tables_agrees(family):
    """Evaluation without the tables agrees."""
    x, t = drawn(family), np.linspace(0, 4, 17)
    for order, values in enumerate(family.basis(t).motion(x).orders):
        assert np.allclose(family.evaluate(x, t, order), values, atol=1e-9 * max(1, np.abs(values).max()))


@pytest.mark.parametrize("family", FAMILIES, ids=IDS)
@pytest.mark.parametrize("order", [pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow), 3])
def test_derivative_bound_is_not_idle(family, order):
    """The bound on a derivative holds and is not idle."""
    for seed in range(5):
        x = drawn(family, seed)
        peak = np.abs(family.basis(np.linspace(0, 4, 4001)).motion(x).orders[order]).max(axis=0)
        bound = family.largest(x, order)
        assert (peak <= bound + 1e-9).all()
        assert (bound <= 6 * peak + 1e-12).all()


@pytest.mark.parametrize("family", FAMILIES, ids=IDS)
def test_variables_come_from_coefficients(family):
    """Variables are read back from their coefficients."""
    x = drawn(family)
    assert np.allclose(family.variables(family.coefficients(x)), x, atol=1e-12)


@pytest.mark.parametrize("family", [fourier_family(3, 4.0, 3, held={1: 0.7}), bspline_family(9, 4.0, 3, held={1: 0.7})])
def test_a_joint_is_held_at_its_value(family):
    motion = family.basis(sample_times(4.0, 20)).motion(drawn(family))
    assert np.allclose(motion.q[:, 1], 0.7) and not motion.v[:, 1].any() and np.ptp(motion.q[:, 0]) > 0


def test_a_locked_joint_stands_still():
    family = fourier_family((3, 0, 2), 4.0)
    motion = family.basis(sample_times(4.0, 20)).motion(drawn(family))
    assert np.ptp(motion.q[:, 1]) == 0 and np.ptp(motion.q[:, 0]) > 0


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: fourier_family(5, 2.0, 7, resonance=15.0), "not below the resonance"),
        (lambda: fourier_family(5, 1.00037, 7, rate=1000.0), "take 1 s"),
        (lambda: fourier_family(1, 2.0, 7), "cannot start at rest"),
        (lambda: fourier_family(5, 0.0, 7), "period 0"),
        (lambda: fourier_family(5, float("nan"), 7), "period nan"),
        (lambda: fourier_family(2, 4.0, 2, start=np.array([0.0, np.nan])), "2 finite joint values"),
        (lambda: fourier_family(4, 4.0, 2, held={2: 0.0}), "joint 3 of 2 cannot be held"),
        (lambda: fourier_family(4, 4.0, 2, held={0: 0.5}, start=np.zeros(2)), "held at 0.5, but"),
        (lambda: bspline_family(5, 4.0, 3), "more than the degree"),
        (lambda: bspline_family(9, 4.0, 3, degree=4), "jerk"),
    ],
)
def test_refusals_say_what_to_do(make, words):
    with pytest.raises(BadInput, match=words):
        make()


def test_aligned_periods_count_samples():
    assert aligned_period(20.0, 1000.0) == 20000
    assert aligned_period(0.3, 1000.0) == 300
