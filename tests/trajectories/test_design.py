"""The search: feasible means feasible, exact gradients pay, goals are attained, and failure is named."""

import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache, partial

import library_arm as arm
import numpy as np
import pinocchio_model as model
import pytest

from calib.dynamics.bodies import standard_parameters
from calib.trajectories.bspline import bspline_family
from calib.trajectories.constraints import BoxLimit, TorqueLimit, box_limits
from calib.trajectories.design.objectives import Duration, Excitation, FrictionCoverage, TorqueSlack, condition_numbers
from calib.trajectories.design.optimise import design
from calib.trajectories.design.pareto import non_dominated, proposed_goals, sweep
from calib.trajectories.design.problem import AttainmentGoal, ExcitationProblem
from calib.trajectories.design.search import SearchResult, Stuck, one_start
from calib.trajectories.design.starts import random_start
from calib.trajectories.design.verify import dense_motion, ensured, verify_motion
from calib.trajectories.errors import BadInput, NotExciting, NothingFeasible
from calib.trajectories.fourier import fourier_family
from calib.trajectories.workspace_limits import Clearance, Workspace

BASE, CHI, CHAIN = arm.lwr()
EFFORT = np.array([joint.effort for joint in CHAIN.joints])
VELOCITY = np.array([joint.velocity for joint in CHAIN.joints])
SLACK = TorqueSlack((5, 6), CHI, EFFORT, BASE.torque_gradient)


def limits(radius: float = 0.3, lowest: float = -0.2) -> tuple:
    points, product = arm.tool(CHAIN)
    return (
        *box_limits(CHAIN.lower, CHAIN.upper, VELOCITY),
        TorqueLimit(BASE.regressor, BASE.regressor_gradient, CHI, EFFORT),
        Workspace(points, product, radius=radius, lowest=lowest),
    )


def problem(**options) -> ExcitationProblem:
    given = {"family": fourier_family(4, 15.0, 7), "constraints": limits(), "samples": 90} | options
    return ExcitationProblem(regressor=BASE.regressor, product=BASE.regressor_gradient, **given)


@cache
def designed() -> tuple[ExcitationProblem, SearchResult]:
    spot = problem()
    return spot, design(spot, starts=1, evaluations=60, seed=1)


def test_motion_keeps_every_limit():
    """The motion found keeps every limit everywhere, by Pinocchio, too."""
    spot, found = designed()
    found, proof = ensured(spot, found)
    assert proof.feasible and found.merit < np.log(60.0)
    assert max(proof.rest) < 1e-9
    assert {one.name for one in proof.margins} == {"position", "velocity", "torque", "workspace"}
    motion = dense_motion(spot.family, found.x, np.linspace(0, 15, 1501))
    assert (motion.q <= CHAIN.upper).all() and (motion.q >= CHAIN.lower).all()
    assert (np.abs(motion.v) <= VELOCITY).all()
    friction = np.array(arm.FV) * motion.v + np.array(arm.FC) * np.tanh(motion.v / 0.05)
    torque = model.inverse_dynamics(CHAIN, standard_parameters(CHAIN), *motion.orders[:3]) + friction
    assert (np.abs(torque) <= EFFORT).all()
    tool = arm.tool_points(CHAIN, motion.q)[:, 0]
    assert np.hypot(tool[:, 0], tool[:, 1]).min() >= 0.3 and tool[:, 2].min() >= -0.2
    least = proof.worst["torque"]
    assert least.margin == pytest.approx((EFFORT - np.abs(torque))[:, int(least.label[6]) - 1].min(), abs=0.5)


@pytest.mark.slow
def test_same_seed_gives_the_same_motion():
    """The same seed gives the same motion, also through a map."""
    spot = problem(samples=30)
    found = design(spot, starts=1, evaluations=30, seed=1)
    with ThreadPoolExecutor(2) as pool:
        again = design(spot, starts=1, evaluations=30, seed=1, map=pool.map)
    assert np.array_equal(found.x, again.x) and found.evaluations == again.evaluations
    pickle.loads(pickle.dumps(partial(one_start, spot, 100, "slsqp", 0)))


def test_history_falls_and_ends_at_the_merit():
    _, found = designed()
    assert all(one > two for one, two in zip(found.history, found.history[1:]))
    assert found.history[-1] == found.merit and 0 < found.feasible <= 1


def test_the_search_beats_random_motions():
    spot, found = designed()
    basis, rng = spot.basis(), np.random.default_rng(0)
    values = []
    for _ in range(60):
        motion = basis.motion(random_start(spot, basis, rng))
        values.append(condition_numbers(BASE.regressor(motion.q, motion.v, motion.a))["raw"])
    assert found.values[0] < 0.5 * min(values)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["auglag", "mma"])
def test_other_methods_improve_their_start(method):
    """The other methods improve their start, too."""
    spot = problem()
    run = one_start(spot, 240, method, 1, 0)
    assert isinstance(run, SearchResult) and run.merit < run.history[0] - 1.0
    assert ensured(spot, run)[1].feasible


@pytest.mark.slow
def test_splines_are_a_family_like_any_other():
    spot = problem(family=bspline_family(12, 15.0, 7))
    run = one_start(spot, 120, "slsqp", 1, 0)
    assert isinstance(run, SearchResult) and run.merit < run.history[0] - 1.0
    _, proof = ensured(spot, run)
    assert proof.feasible and max(proof.rest) < 1e-6


@pytest.mark.slow
def test_goals_are_attained_within_gamma():
    spot = problem(goals=(AttainmentGoal(Excitation("cond", "normalised"), 20.0), AttainmentGoal(SLACK, 0.85, 0.0)))
    run = design(spot, starts=1, evaluations=150, seed=1, guesses=(designed()[1].x,))
    assert run.values[1] <= 0.85 + 1e-6
    assert run.merit == pytest.approx(run.values[0] / 20.0 - 1.0)
    assert run.merit < 0.0


@pytest.mark.slow
def test_a_hard_goal_out_of_reach_is_named():
    spot = problem(goals=(AttainmentGoal(Excitation(), 30.0), AttainmentGoal(SLACK, 0.1, 0.0)), samples=30)
    with pytest.raises(NothingFeasible, match=r"torque slack of joints 6, 7.*0\.1"):
        design(spot, starts=1, evaluations=60)


@pytest.mark.slow
def test_free_period_is_shortened_to_limit():
    """A free period is shortened down to a limit."""
    spot = problem(
        goals=(AttainmentGoal(Duration(), 10.0), AttainmentGoal(Excitation("cond", "normalised"), 15.0, 0.0)),
        stretch=(0.4, 2.0),
    )
    run, proof = ensured(spot, design(spot, starts=1, evaluations=150, seed=1, guesses=(designed()[1].x,)))
    assert run.factor < 0.95 and run.values[0] == pytest.approx(15.0 * run.factor)
    assert run.values[1] <= 15.0 * (1 + 1e-5)
    assert proof.feasible
    assert min(one.share for one in proof.margins) < 0.1


@pytest.mark.slow
def test_next_motion_complements_earlier():
    """The next motion complements what was recorded."""
    spot, first = designed()
    motion = spot.basis().motion(first.x)
    W = BASE.regressor(motion.q, motion.v, motion.a).transpose(1, 0, 2).reshape(-1, 64)
    known = Excitation("cond", existing=W.T @ W)
    second = design(problem(objectives=((known, 1.0),)), starts=1, evaluations=120, seed=2)
    alone = condition_numbers(BASE.regressor(motion.q, motion.v, motion.a))["raw"]
    assert second.values[0] < 0.9 * alone


@pytest.mark.slow
def test_single_objectives_propose_goals():
    """Single objectives propose goals, and a front trades them."""
    spot, first = designed()
    motion = spot.basis().motion(first.x)
    begin = SLACK.evaluate(motion, BASE.regressor(motion.q, motion.v, motion.a)).value
    (least, run), *_ = proposed_goals(spot, [SLACK], starts=0, evaluations=90, guesses=(first.x,))
    assert least < begin - 0.003 and run.values[0] == least
    index = Excitation("cond", "normalised")
    front = sweep(spot, index, SLACK, 4, (first, run), first, evaluations=120)
    levels = np.linspace(begin, front.values[1, 1], 4)[1:-1]
    inner = front.values[3:]
    assert len(inner) and inner[-1, 1] <= levels[-1] + 1e-5 and (inner[:, 0] <= front.values[1, 0]).all()
    assert (front.values[front.designed] == front.values[0]).all() and front.best.any()


def test_coverage_alone_reaches_its_shares():
    coverage = FrictionCoverage(0.05 * VELOCITY, 0.4 * VELOCITY, wanted=0.05)
    spot = problem(samples=60, objectives=((coverage, 1.0),))
    run = design(spot, starts=1, evaluations=60, seed=1)
    begin = spot.basis().motion(random_start(spot, spot.basis(), np.random.default_rng([1, 0])))
    assert run.merit < 0.05 < coverage.evaluate(begin, np.zeros(0)).value


def test_domination():
    assert non_dominated(np.array([[1.0, 3.0], [2.0, 2.0], [2.0, 3.0], [1.0, 3.0]])).tolist() == [
        True,
        True,
        False,
        True,
    ]


@pytest.mark.slow
def test_infeasibility_names_constraint():
    """Nothing feasible names the constraint and the excess."""
    with pytest.raises(NothingFeasible, match=r"in 1 start: .* workspace limit \(tool lowest\) by 0\.\d+ m") as caught:
        design(problem(constraints=limits(lowest=1.5), samples=20), starts=1, evaluations=10)
    assert caught.value.constraint == "workspace" and 0.6 < caught.value.excess < 1.0
    pickle.loads(pickle.dumps(caught.value))


def test_start_outside_is_infeasible():
    """A start outside the limits is infeasible by what it lacks."""
    start = np.array([0.0, 0.8, 0.0, -1.0, 0.0, 2.3, 0.0])  # joint 6 may go to 2.094
    kept = box_limits(CHAIN.lower, CHAIN.upper, VELOCITY)
    spot = problem(family=fourier_family(4, 15.0, 7, start=start), constraints=kept, samples=10)
    with pytest.raises(NothingFeasible, match=r"position limit \(joint 6 upper\) by 0\.2\d* rad at t = 0 s"):
        design(spot, starts=1, evaluations=10)


def test_locked_joint_leaves_no_information():
    """A locked joint leaves columns without information."""
    with pytest.raises(NotExciting, match="zero along the whole motion"):
        design(problem(family=fourier_family((4, 4, 0, 4, 4, 4, 4), 15.0)), starts=1, evaluations=30)


@pytest.mark.slow
def test_interrupting_keeps_the_best_so_far():
    calls = []

    def regressor(q, v, a):
        calls.append(1)
        if len(calls) == 80:
            raise KeyboardInterrupt
        return BASE.regressor(q, v, a)

    spot = ExcitationProblem(
        fourier_family(4, 15.0, 7), regressor, BASE.regressor_gradient, constraints=limits(), samples=60
    )
    found = design(spot, starts=5, evaluations=600, seed=1)
    assert found.interrupted and len(calls) == 80 and found.merit < found.history[0]


def test_verification_sees_between_samples():
    """Verification finds what happens between samples."""
    family = fourier_family(8, 8.0, 1)
    x = family.random(np.random.default_rng(0), np.zeros(1), np.ones(1))
    peak = np.abs(family.evaluate(x, np.linspace(0, 8, 100_001), 1)).max()
    box = BoxLimit(1, np.array([-peak]), np.array([peak]))
    for instants in (50, 500):
        report = verify_motion(family, x, [box], instants=instants)
        assert not report.feasible or min(one.margin for one in report.margins) < 1e-9
        assert min(one.margin for one in report.margins) > -0.2 * peak * (50 / instants) ** 2
    coarse = np.abs(family.evaluate(x, np.linspace(0, 8, 51), 1)).max()
    assert coarse < peak  # the samples alone would have called it feasible


@pytest.mark.slow
def test_broken_limits_are_searched_again():
    """A motion that breaks its limits is searched again."""
    spot, found = designed()
    larger = replace(found, x=1.1 * found.x)
    assert not verify_motion(spot.family, larger.x, spot.constraints).feasible
    again, proof = ensured(spot, larger)
    assert proof.feasible and again.evaluations > found.evaluations


@pytest.mark.slow
def test_thin_wall_is_not_jumped_over():
    """Joint 1 must stay on one side of 0.3 rad, which samples 0.6 s apart do not see."""
    wall = Clearance(
        lambda q: np.abs(q[:, :1] - 0.3) - 0.02, lambda q: np.sign(q[:, :1, None] - 0.3) * np.eye(1, 7),
        ("wall - arm",),
    )  # fmt: skip
    spot = problem(samples=25, constraints=(*box_limits(CHAIN.lower, CHAIN.upper, VELOCITY), wall))
    found, proof = ensured(spot, design(spot, starts=1, evaluations=100, seed=1))
    side = np.sign(dense_motion(spot.family, found.x, np.linspace(0, 15, 3000)).q[:, 0] - 0.3)
    assert proof.feasible and (side == side[0]).all() and found.values[0] < 200.0


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: box_limits(CHAIN.lower, CHAIN.upper, 0 * VELOCITY), "velocity limit of joint 1 is 0"),
        (lambda: design(problem(), method="newton"), "not one of slsqp"),  # type: ignore[arg-type]
        (lambda: design(problem(), starts=0), "no starts"),
        (lambda: problem(samples=3), "8 or more"),
        (lambda: problem(objectives=()), "nothing to design"),
        (lambda: problem(stretch=(2.0, 1.0)), "smaller first"),
        (lambda: AttainmentGoal(SLACK, np.nan), "expected a number"),
    ],
)
def test_refusals(make, words):
    with pytest.raises(BadInput, match=words):
        make()


@pytest.mark.slow
def test_stuck_is_not_found():
    run = one_start(problem(constraints=limits(lowest=1.5), samples=10), 10, "slsqp", 0, 0)
    assert isinstance(run, Stuck) and run.excess[0] > 0
