"""Speed of excitation's gradients: run with `pytest tests/benchmarks/test_excitation.py --benchmark-only -s`.

How good the search is, beside others and over seeds: `examples/lwr4plus/excitation_peers.py`.

LWR4+ of the library, 64 base columns (43 inertial, Fv Fc off of seven
joints), limits of the URDF on position and velocity, torque from the library's inertias with published friction, tool
at least 0.3 m from axis 1 and not below -0.2 m.
"""

import time
import tomllib
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from calib.dynamics import base, drives
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.procedure.excitation.limits import Points
from calib.robot import library, mdh
from calib.robot.chain import Chain
from calib.robot.library import load
from calib.trajectories.constraints import TorqueLimit, box_limits
from calib.trajectories.design.objectives import Excitation
from calib.trajectories.design.problem import ExcitationProblem, evaluate
from calib.trajectories.design.starts import random_start
from calib.trajectories.fourier import fourier_family
from calib.trajectories.workspace_limits import Workspace

CHAIN = load("lwr4plus")
FC = (11.9, 11.5, 8.98, 8.35, 8.31, 4.72, 6.04)
FV = (14.4, 15.3, 6.55, 11.0, 4.29, 2.26, 1.6)


@cache
def model() -> tuple[base.BaseModel, np.ndarray]:
    full = IdentificationModel(bodies_of(CHAIN), drives.standard(["Fv Fc off"] * 7, 0.05))
    found = base.find(full)
    values = np.concatenate([standard_parameters(CHAIN), np.column_stack([FV, FC, np.zeros(7)]).ravel()])
    return base.BaseModel(full, found), found.transform @ values


def problem(period: float, harmonics: int, samples: int = 200, constrained: bool = True) -> ExcitationProblem:
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
    return ExcitationProblem(
        fourier_family(harmonics, period, 7, rate=1000.0), columns.regressor, columns.regressor_gradient,
        constraints=limits if constrained else (), samples=samples,
    )  # fmt: skip


def value(spot: ExcitationProblem, basis, x: np.ndarray) -> float:
    """Return log cond, which the search minimises."""
    motion = basis.motion(x)
    Y = spot.regressor(motion.q, motion.v, motion.a)
    return float(np.log(Excitation().evaluate(motion, Y).value))


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
def test_cond_gradient_against_differences(benchmark, harmonics, samples):
    """Value and gradient of cond, against differences."""
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
    assert error < 1e-4
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
