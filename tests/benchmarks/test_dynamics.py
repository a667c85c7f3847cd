"""Speed of the dynamics: run with `pytest tests/benchmarks/test_dynamics.py --benchmark-only -s`.

On a shared machine add --benchmark-timer=time.thread_time to leave out what others take. All regressor figures are for
10 000 samples of the LWR4+ (7 joints, 70 columns); the numpy version is the plain vectorised one below, the fairest a
batch without a compiler can be.
"""

import numpy as np
import pinocchio_model as model
import pytest

from calib.dynamics import base, drives, rigid_body
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.robot.library import load

COUNT = 10_000
CHAIN = load("lwr4plus")
BODIES = bodies_of(CHAIN)
STATES = np.random.default_rng(0).normal(size=(3, COUNT, 7))


def numpy_regressor(bodies, q, v, a):
    """Return the regressor (p, n, N) of a chain about z axes by numpy alone, the sample axis last."""
    n, count = q.shape[1], len(q)
    out = np.zeros((10 * n, n, count))
    w, dw, acc = np.zeros((3, count)), np.zeros((3, count)), np.repeat(-bodies.gravity[:, None], count, axis=1)
    twists = np.zeros((0, 6, count))
    z = np.array([0.0, 0.0, 1.0])[:, None]
    for i in range(n):
        c, s = np.cos(q[:, i]), np.sin(q[:, i])
        fixed, t = bodies.placements[i][:3, :3], bodies.placements[i][:3, 3:]
        turn = np.stack([fixed[:, :1] * c + fixed[:, 1:2] * s, fixed[:, 1:2] * c - fixed[:, :1] * s,
                         np.repeat(fixed[:, 2:], count, axis=1)])  # fmt: skip
        acc = np.einsum("rck,ck->rk", turn, acc + cross(dw, t) + cross(w, cross(w, t)))
        w, dw = np.einsum("rck,ck->rk", turn, w), np.einsum("rck,ck->rk", turn, dw)
        dw = dw + cross(w, z) * v[:, i] + z * a[:, i]
        w = w + z * v[:, i]
        moved = np.zeros((i + 1, 6, count))
        for j in range(i):
            moved[j, :3] = np.einsum("rck,ck->rk", turn, twists[j, :3])
            moved[j, 3:] = np.einsum("rck,ck->rk", turn, twists[j, 3:] + cross(twists[j, :3], t))
        moved[i, 2] = 1.0
        twists = moved
        for j in range(i + 1):
            u, lever = moved[j, :3], moved[j, 3:]
            e = cross(u, w)
            rows = out[10 * i :, j]
            for k, (x, y) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
                rows[k] = u[x] * dw[y] + e[x] * w[y]
                if x != y:
                    rows[k] += u[y] * dw[x] + e[y] * w[x]
            rows[6:9] = cross(lever, dw) + cross(cross(lever, w), w) + cross(acc, u)
            rows[9] = np.sum(lever * acc, axis=0)
    return out


def cross(x, y):
    return np.stack([x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]])


def per_sample(benchmark, name):
    figure = benchmark.stats.stats.min / COUNT * 1e6
    benchmark.extra_info["microseconds_per_sample"] = figure
    print(f"\n{name}: {figure:.2f} µs per sample (best), {benchmark.stats.stats.median / COUNT * 1e6:.2f} (median)")


def test_regressor_kernel(benchmark):
    benchmark.pedantic(rigid_body.regressor, (BODIES, *STATES), rounds=30, warmup_rounds=2)
    per_sample(benchmark, "regressor, kernel")


def test_regressor_kernel_into_given_memory(benchmark):
    out = np.zeros((70, 7, COUNT))
    benchmark.pedantic(rigid_body.fill_regressor, (BODIES, *STATES, out), rounds=30, warmup_rounds=2)
    per_sample(benchmark, "regressor, kernel into given memory")


def test_copy_of_the_result(benchmark):
    made = rigid_body.regressor(BODIES, *STATES).transpose(2, 1, 0)
    benchmark.pedantic(made.copy, rounds=30, warmup_rounds=2)
    per_sample(benchmark, "copying the result")


def test_copy_into_given_memory(benchmark):
    made = rigid_body.regressor(BODIES, *STATES).transpose(2, 1, 0)
    out = np.zeros_like(made)
    benchmark.pedantic(np.copyto, (out, made), rounds=30, warmup_rounds=2)
    per_sample(benchmark, "copying the result into given memory")


def test_regressor_numpy(benchmark):
    found = benchmark.pedantic(numpy_regressor, (BODIES, *STATES), rounds=5, warmup_rounds=1)
    assert np.allclose(found.transpose(2, 1, 0), rigid_body.regressor(BODIES, *STATES), rtol=0, atol=1e-10)
    per_sample(benchmark, "regressor, numpy")


def test_regressor_pinocchio_loop(benchmark):
    benchmark.pedantic(model.regressor, (CHAIN, *STATES), rounds=3, warmup_rounds=1)
    per_sample(benchmark, "regressor, Pinocchio in a loop")


def test_gradient_of_the_regressor(benchmark):
    weights = np.random.default_rng(1).normal(size=(COUNT, 7, 70))
    benchmark.pedantic(rigid_body.regressor_gradient, (BODIES, *STATES, weights), rounds=10, warmup_rounds=2)
    per_sample(benchmark, "derivative product of the regressor")


def test_inverse_dynamics(benchmark):
    chi = standard_parameters(CHAIN)
    benchmark.pedantic(rigid_body.inverse_dynamics, (BODIES, chi, *STATES), rounds=20, warmup_rounds=2)
    per_sample(benchmark, "inverse dynamics")


@pytest.mark.parametrize("sets", ["", "Ia Fv Fc off"])
def test_base_parameters(benchmark, sets):
    full = IdentificationModel(BODIES, drives.standard([sets] * 7))
    samples = base.random_samples(full, COUNT)
    found = benchmark.pedantic(base.find, (full, samples), rounds=5, warmup_rounds=1)
    print(f"\nbase parameters of {full.p}: {found.b}, {benchmark.stats.stats.min:.3f} s from {COUNT} samples")
