"""Speed and quality of excitation: run with `pytest tests/benchmarks/test_excitation.py --benchmark-only -s`.

Set OPENBLAS_NUM_THREADS=1 on a shared machine. LWR4+ of the library, 64 base columns (43 inertial, Fv Fc off of seven
joints), limits of the URDF on position and velocity, torque from the library's inertias with published friction, tool
at least 0.3 m from axis 1 and not below -0.2 m.
"""

from __future__ import annotations

import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from unittest import mock

import numpy as np
import pytest

from calib.dynamics import base, drives
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.procedure.excitation.limits import Points
from calib.robot import library, mdh
from calib.robot.chain import Chain
from calib.robot.load import load
from trajectories.constraints import TorqueLimit, box_limits
from trajectories.design import search
from trajectories.design.objectives import Excitation, condition_numbers
from trajectories.design.optimise import design
from trajectories.design.problem import AttainmentGoal, Evaluation, ExcitationProblem, evaluate
from trajectories.design.search import SearchResult, Stage, one_start
from trajectories.design.starts import random_start
from trajectories.design.verify import dense_motion, ensured
from trajectories.fourier import fourier_family
from trajectories.places import Workspace

SCALINGS = ("raw", "normalised")
CHAIN = load("lwr4plus")
FC = (11.9, 11.5, 8.98, 8.35, 8.31, 4.72, 6.04)
FV = (14.4, 15.3, 6.55, 11.0, 4.29, 2.26, 1.6)


@cache
def model() -> tuple[base.BaseModel, np.ndarray]:
    full = IdentificationModel(bodies_of(CHAIN), drives.standard(["Fv Fc off"] * 7, 0.05))
    found = base.find(full)
    values = np.concatenate([standard_parameters(CHAIN), np.column_stack([FV, FC, np.zeros(7)]).ravel()])
    return base.BaseModel(full, found), found.transform @ values


def problem(period: float, harmonics: int, samples: int = 200, goals=(), constrained: bool = True) -> ExcitationProblem:
    columns, values = model()
    velocity, effort = (np.array([getattr(j, key) for j in CHAIN.joints]) for key in ("velocity", "effort"))
    points = Points(CHAIN, (0,), np.zeros((1, 3)))
    limits = (
        *box_limits(CHAIN.lower, CHAIN.upper, velocity),
        TorqueLimit(
            columns.regressor, columns.regressor_gradient, values, effort, torque_product=columns.torque_gradient
        ),
        Workspace(points, points.product, radius=0.3, lowest=-0.2),
    )
    chosen = tuple(AttainmentGoal(Excitation("cond", name), goal) for name, goal in zip(("raw", "normalised"), goals))
    return ExcitationProblem(
        fourier_family(harmonics, period, 7, rate=1000.0), columns.regressor, columns.regressor_gradient,
        constraints=limits if constrained else (), goals=chosen, samples=samples,
    )  # fmt: skip


def value(spot: ExcitationProblem, basis, x: np.ndarray) -> float:
    motion = basis.motion(x)
    Y = spot.regressor(motion.q, motion.v, motion.a)
    return Excitation().evaluate(motion, Y).value


def processor_time(call: Callable, rounds: int = 15) -> float:
    """Return the least processor time of a call [s]: others may use the machine."""
    spent = []
    for _ in range(rounds):
        began = time.process_time()
        call()
        spent.append(time.process_time() - began)
    return min(spent)


@pytest.mark.parametrize("harmonics", [5, 10])
@pytest.mark.parametrize("samples", [200, 1000])
def test_value_and_gradient_of_cond_against_differences(benchmark, harmonics, samples):
    spot = problem(20.0, harmonics, samples, constrained=False)
    basis = spot.basis()
    x = random_start(problem(20.0, harmonics), basis, np.random.default_rng(0))
    found = benchmark.pedantic(evaluate, (spot, basis, x, (np.inf, 1.0)), rounds=5, warmup_rounds=1)
    began, differences = time.process_time(), []
    for k in range(len(x)):
        h = 1e-6 * np.eye(len(x))[k]
        differences.append((value(spot, basis, x + h) - value(spot, basis, x - h)) / 2e-6)
    taken = time.process_time() - began
    error = np.abs(np.array(differences) - found.slopes[0]).max() / np.abs(found.slopes[0]).max()
    exact = processor_time(lambda: evaluate(spot, basis, x, (np.inf, 1.0)))
    print(
        f"\nn_f {harmonics}, {samples} samples, {len(x)} variables: {1e3 * exact:.1f} ms exact, {1e3 * taken:.0f} ms "
        f"by central differences ({taken / exact:.0f} times), largest relative difference {error:.1e}"
    )


def first_joints(count: int) -> Chain:
    """Return the LWR4+ cut off behind its first joints."""
    table = tomllib.loads(library.path("lwr4plus").read_text())
    return mdh.from_table(table | {"joint": table["joint"][:count]}, f"{count} joints")


@pytest.mark.parametrize("joints", [2, 3, 4, 5, 6, 7])
@pytest.mark.parametrize("samples", [200, 1000])
def test_growth_with_joints_and_samples(benchmark, joints, samples):
    chain = first_joints(joints)
    full = IdentificationModel(bodies_of(chain), drives.standard(["Fv Fc off"] * joints, 0.05))
    columns = base.BaseModel(full, base.find(full))
    spot = ExcitationProblem(
        fourier_family(5, 20.0, joints), columns.regressor, columns.regressor_gradient, samples=samples
    )
    basis = spot.basis()
    x = random_start(spot, basis, np.random.default_rng(0))
    benchmark.pedantic(evaluate, (spot, basis, x, (np.inf, 1.0)), rounds=10, warmup_rounds=2)
    exact = processor_time(lambda: evaluate(spot, basis, x, (np.inf, 1.0)))
    alone = processor_time(lambda: value(spot, basis, x))
    print(
        f"\n{joints} joints, {len(columns.names)} columns, {samples} samples: value and gradient {1e3 * exact:.2f} ms, "
        f"{exact / alone:.1f} times the value, {2 * len(x) * alone / exact:.0f} times faster than central differences"
    )


@pytest.mark.parametrize("harmonics", [5, 12])
@pytest.mark.parametrize("period", [20.0, 10.0])
def test_condition_number_under_all_constraints_beside_scipy(benchmark, period, harmonics):
    """Ours with its defaults, then SciPy's SLSQP on the sharpest stage alone in the same processor time, five seeds."""
    rows = benchmark.pedantic(lambda: [_beside_scipy(period, harmonics, seed) for seed in range(5)], rounds=1)
    middle = np.median(rows, axis=0)
    print(
        f"\nT0 = {period:g} s, n_f {harmonics}, 64 columns, 1000 samples, sign smoothed at 0.01 rad/s, all limits "
        f"verified, medians of {len(rows)} seeds: {middle[2]:.1f} raw, {middle[3]:.2f} normalised in {middle[0]:.0f} s "
        f"of processor time, within 5 % after {middle[1]:.0f} s; SciPy's SLSQP in the same time {middle[4]:.1f} / "
        f"{middle[5]:.2f}"
    )


def _beside_scipy(period: float, harmonics: int, seed: int) -> list[float]:
    """Return processor time, that to within 5 %, condition numbers raw and normalised, and SciPy's."""
    spot = replace(
        problem(period, harmonics), objectives=tuple((Excitation("cond", name), 0.5) for name in SCALINGS),
        coarse=fourier_family(5, period, 7) if harmonics > 5 else None,
    )  # fmt: skip
    curve, began = list[tuple[float, float]](), time.process_time()
    found = design(spot, starts=4, evaluations=1500, seed=seed, map=partial(_timed, curve, began))
    found, proof = ensured(spot, found)
    spent = time.process_time() - began
    close = min(t for t, merit in curve if merit < found.merit + np.log(1.05))
    theirs, by_scipy = ensured(spot, _scipy_alone(spot, spent, seed))
    assert proof.feasible and by_scipy.feasible
    row = [spent, close, *(x for one in (found, theirs) for x in sharp_conditions(spot, one.x).values())]
    print("  ".join(f"{x:.4g}" for x in row), flush=True)
    return row


def _timed(curve: list[tuple[float, float]], began: float, call: Callable, tasks) -> Iterator[SearchResult]:
    """Call like the builtin map, noting at which processor second which merit was reached."""
    for task in tasks:
        offset = time.process_time() - began
        found = call(task)
        curve += [(offset + t, merit) for t, merit in zip(found.times, found.history)]
        yield found


def _scipy_alone(spot: ExcitationProblem, seconds: float, seed: int) -> SearchResult:
    """Run SciPy's SLSQP from one random start after the other, on the problem as it is, until the time is up."""
    began, found, start = time.process_time(), list[SearchResult](), 0
    alone = Stage(30.0, 500.0, 1e-6, 1.0)

    def measured(*given) -> Evaluation:
        if time.process_time() - began > seconds and found:
            raise KeyboardInterrupt
        return evaluate(*given)

    with mock.patch.object(search, "evaluate", measured), suppress(KeyboardInterrupt):
        while True:
            run = one_start(spot, 1500, "slsqp", seed, start, (alone,))
            found += [run] if isinstance(run, SearchResult) else []
            start += 1
    return min(found, key=lambda one: one.merit)


def sharp_conditions(spot: ExcitationProblem, x: np.ndarray) -> dict[str, float]:
    """Return the condition numbers of a motion at 1000 samples, the Coulomb sign smoothed at 0.01 rad/s."""
    motion = dense_motion(spot.family, x, spot.family.period / 1000 * np.arange(1000))
    full = IdentificationModel(bodies_of(CHAIN), drives.standard(["Fv Fc off"] * 7, 0.01))
    return condition_numbers(base.BaseModel(full, model()[0].base).regressor(motion.q, motion.v, motion.a))


def test_finite_differences_with_the_same_optimiser_and_the_same_time(benchmark):
    """The same SLSQP on the same problem, its gradients of cond by forward differences, stopped after 30 s."""
    spot = problem(20.0, 5, goals=(35.0, 6.0))
    numeric = ExcitationProblem(**(spot.__dict__ | {"product": partial(_differences, spot.regressor)}))
    start = time.perf_counter()
    found = benchmark.pedantic(design, (numeric,), {"starts": 1, "evaluations": 150, "seed": 0}, rounds=1)
    print(f"\nregressor differentiated numerically: γ = {found.merit:.3f} in {time.perf_counter() - start:.0f} s")
    exact = design(spot, starts=1, evaluations=150, seed=0)
    print(f"exact: γ = {exact.merit:.3f} in {exact.seconds:.1f} s")


def test_random_search(benchmark):
    spot = problem(20.0, 5)
    basis, rng = spot.basis(), np.random.default_rng(0)

    def search(seconds: float = 20.0) -> tuple[float, int]:
        best, count, began = np.inf, 0, time.perf_counter()
        while time.perf_counter() - began < seconds:
            x = random_start(spot, basis, rng)
            motion = basis.motion(x)
            count += 1
            if all((c.values(motion) <= 0).all() for c in spot.constraints):
                best = min(best, value(spot, basis, x))
        return best, count

    best, count = benchmark.pedantic(search, rounds=1)
    print(f"\nrandom search, 20 s: {best:.0f} raw, best of {count} motions")


def _differences(regressor, q, v, a, G):
    """Return the derivative product by central differences of the regressor: what a robot without kernels offers."""
    slopes = []
    for k in range(3):
        gradient = np.zeros(q.shape)
        for j in range(q.shape[1]):
            step = np.zeros(q.shape[1])
            step[j] = 1e-6
            one, two = ([x + s * step * (i == k) for i, x in enumerate((q, v, a))] for s in (1, -1))
            gradient[:, j] = (G * (regressor(*one) - regressor(*two))).sum(axis=(1, 2)) / 2e-6
        slopes.append(gradient)
    return tuple(slopes)
