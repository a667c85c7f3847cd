"""The search for exciting motions against its peers: same robot, same limits, same processor time.

Problem: LWR4+ of the library, 64 base columns (43 inertial, Fv Fc off of seven joints; Coulomb sign smoothed at 0.05
rad/s), Fourier series of five harmonics at rest at both ends, T0 = 20 s, 200 samples; minimise the mean of log cond
with raw and with normalised columns; limits of position and velocity (URDF), torque (library inertias, published
friction), tool 0.3 m from axis 1 and above -0.2 m. Every method keeps its best motion that meets all limits:

    ours            SLSQP of NLopt, exact gradients, smoothed in three stages, random starts that are repaired
    differences     the same, every gradient by forward differences over all variables
    scipy           SLSQP of SciPy, exact gradients of the same smoothed functions (the sharpest stage alone)
    scipy, 2-point  SLSQP of SciPy with its own finite differences
    random          feasible ones among random Fourier series, coefficients scaled into the joint limits

and ours on the Panda and the TX40, T0 = 20 s, with the same kinds of columns and limits, the tool above the mounting
plane (the Panda's masses are not in the library, so its torque is not limited).

    python examples/lwr4plus/excitation_peers.py --out lwr4plus-peers [--seconds 60] [--alone] [--seed 0]

Some seven minutes at 60 s of processor time per method; 2 seconds are enough to see it run.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import scipy.optimize
import study_options
from matplotlib.figure import Figure

from calib import files
from calib.dynamics import base, drives
from calib.dynamics.base import BaseModel
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.procedure.excitation.limits import Points
from calib.procedure.report.style import AFTER, BEFORE, INK, MARK, QUIET, WIDE, save, sheet, styled
from calib.robot.chain import Chain
from calib.robot.load import load
from trajectories.constraints import TorqueLimit, box_limits
from trajectories.design import search
from trajectories.design.objectives import Excitation, condition_numbers
from trajectories.design.problem import Evaluation, ExcitationProblem, evaluate
from trajectories.design.search import STAGES, SearchResult, StartSearch, one_start
from trajectories.design.starts import random_start
from trajectories.design.verify import dense_motion, ensured
from trajectories.fourier import fourier_family
from trajectories.places import Workspace

FC = (11.9, 11.5, 8.98, 8.35, 8.31, 4.72, 6.04)  # [N m], Jubien, Gautier & Janot 2014 as quoted in public code
FV = (14.4, 15.3, 6.55, 11.0, 4.29, 2.26, 1.6)  # [N m s/rad]
STEP = 1e-7
Curve = list[tuple[float, float]]  # processor seconds, and the mean log cond of a motion


def problem(
    chain: Chain, period: float, friction: tuple | None = (FV, FC), radius: float | None = 0.3, lowest: float = -0.2
) -> ExcitationProblem:
    """Return the problem of a robot; torque is limited where its masses are known."""
    smooth, values = model(chain, 0.05, friction)
    velocity, effort = (np.array([getattr(j, key) for j in chain.joints]) for key in ("velocity", "effort"))
    tool = Points(chain, (0,), np.zeros((1, 3)))
    limits: list[Any] = [*box_limits(chain.lower, chain.upper, velocity)]
    if values is not None:
        product = smooth.torque_gradient
        limits.append(TorqueLimit(smooth.regressor, smooth.regressor_gradient, values, effort, torque_product=product))
    limits.append(Workspace(tool, tool.product, radius=radius, lowest=lowest))
    objectives = tuple((Excitation("cond", scaling), 0.5) for scaling in ("raw", "normalised"))
    family = fourier_family(5, period, chain.n, rate=1000.0)
    return ExcitationProblem(family, smooth.regressor, smooth.regressor_gradient, objectives, tuple(limits))


def model(chain: Chain, v0: float, friction: tuple | None) -> tuple[BaseModel, np.ndarray | None]:
    full = IdentificationModel(bodies_of(chain), drives.standard(["Fv Fc off"] * chain.n, v0))
    found = base.find(full)
    if chain.inertias is None:
        return BaseModel(full, found), None
    own = np.zeros((chain.n, 3))
    if friction is not None:
        own[:, 0], own[:, 1] = friction
    return BaseModel(full, found), found.transform @ np.concatenate([standard_parameters(chain), own.ravel()])


def ours(
    spot: ExcitationProblem, seconds: float, seed: int, evaluator: Any = evaluate
) -> tuple[Curve, np.ndarray | None]:
    """Search start after start until the time is up; the best motion of all."""
    began, curve, x, start = time.process_time(), Curve(), None, 0

    def timed(*given: Any) -> Evaluation:
        if time.process_time() - began > seconds:
            raise KeyboardInterrupt  # a start hands back the best it has
        return evaluator(*given)

    with mock.patch.object(search, "evaluate", timed), suppress(KeyboardInterrupt):
        while True:
            offset = time.process_time() - began
            found = one_start(spot, 600, "slsqp", seed, start)
            start += 1
            if isinstance(found, SearchResult):
                x = found.x if not curve or found.merit < min(m for _, m in curve) else x
                curve += [(offset + t, m) for t, m in zip(found.times, found.history)]
    return falling(curve), x


def differenced(spot: ExcitationProblem, basis: Any, y: np.ndarray, sharpness: tuple[float, float]) -> Evaluation:
    """Return what `evaluate` returns, its gradients by forward differences over all variables."""
    bare = blind(spot)
    here = evaluate(bare, basis, y, sharpness)
    slopes, rows = np.empty((1, len(y))), np.empty((len(here.constraints), len(y)))
    for k in range(len(y)):
        moved = y.copy()
        moved[k] += STEP
        there = evaluate(bare, basis, moved, sharpness)
        slopes[:, k], rows[:, k] = (there.total - here.total) / STEP, (there.constraints - here.constraints) / STEP
    return replace(here, slopes=slopes, rows=rows)


def blind(spot: ExcitationProblem) -> ExcitationProblem:
    """Return the problem without derivative products: values cost what values cost."""
    limits: list[Any] = [replace(c, product=_none) if isinstance(c, Workspace) else c for c in spot.constraints]
    limits = [replace(c, product=_none, torque_product=None) if isinstance(c, TorqueLimit) else c for c in limits]
    return replace(spot, product=_none, constraints=tuple(limits))


def _none(q: np.ndarray, *others: np.ndarray) -> Any:
    return np.zeros(q.shape) if len(others) == 1 else (np.zeros(q.shape),) * 3


def by_scipy(spot: ExcitationProblem, seconds: float, seed: int, exact: bool) -> tuple[Curve, np.ndarray | None]:
    """Run SciPy's SLSQP from random starts until the time is up."""
    given = spot if exact else blind(spot)
    basis, began, curve, x, start = given.basis(), time.process_time(), Curve(), None, 0
    while (offset := time.process_time() - began) < seconds:
        run = StartSearch(given, basis)
        run.sharpness = STAGES[-1]

        def fun(z: np.ndarray, run: StartSearch = run) -> float:
            if time.process_time() - began > seconds:
                raise KeyboardInterrupt
            return run.at(z).total

        def jac(z: np.ndarray, run: StartSearch = run) -> np.ndarray:
            return run.at(z).slopes[0]

        limits: Any = {"type": "ineq", "fun": lambda z, run=run: -run.at(z).constraints}
        if exact:
            limits["jac"] = lambda z, run=run: -run.at(z).rows
        y = random_start(spot, basis, np.random.default_rng([seed, start]))
        with suppress(KeyboardInterrupt):
            scipy.optimize.minimize(
                fun, y, method="SLSQP", jac=jac if exact else None, constraints=limits,
                options={"maxiter": 300, "ftol": 1e-6},
            )  # fmt: skip
        start += 1
        if run.best is not None:
            x = run.best if not curve or run.merit < min(m for _, m in curve) else x
            curve += [(offset + t, m) for t, m in zip(run.times, run.history)]
    return falling(curve), x


def at_random(spot: ExcitationProblem, seconds: float, seed: int) -> tuple[Curve, np.ndarray | None]:
    began, curve, basis = time.process_time(), Curve(), spot.basis()
    rng, x, least, count, kept = np.random.default_rng(seed), None, np.inf, 0, 0
    while (now := time.process_time() - began) < seconds:
        drawn = random_start(spot, basis, rng)
        motion = basis.motion(drawn)
        count += 1
        if any((c.values(motion) > 0).any() for c in spot.constraints):
            continue
        kept += 1
        cond = condition_numbers(spot.regressor(motion.q, motion.v, motion.a))
        value = 0.5 * float(np.log(cond["raw"]) + np.log(cond["normalised"]))
        if value < least:
            x, least = drawn, value
            curve.append((now, value))
    print(f"  random: {count} motions, {kept} of them feasible", flush=True)
    return curve, x


def falling(curve: Curve) -> Curve:
    """Return the best so far over time."""
    result, least = Curve(), np.inf
    for point in sorted(curve):
        if point[1] < least:
            least = point[1]
            result.append(point)
    return result


def reached(
    chain: Chain, spot: ExcitationProblem, x: np.ndarray, friction: tuple | None = (FV, FC)
) -> dict[str, float]:
    """Return the condition numbers at 1000 samples with a Coulomb sign smoothed at 0.01 rad/s."""
    period = spot.family.period
    motion = dense_motion(spot.family, x, period / 1000 * np.arange(1000))
    return condition_numbers(model(chain, 0.01, friction)[0].regressor(motion.q, motion.v, motion.a))


def picture(curves: dict[str, Curve], seconds: float) -> Figure:
    """Draw the geometric mean of both condition numbers against processor time."""
    with styled():
        figure, (axis,) = sheet(width=WIDE, height=3.2)
        for (name, curve), color, dash in zip(
            curves.items(), (AFTER, MARK, BEFORE, QUIET, INK), ("-", "-", "-", "--", ":")
        ):
            seen = [point for point in curve if point[0] <= seconds] or [(seconds, np.nan)]
            t, merit = [*(p[0] for p in seen), seconds], [*(p[1] for p in seen), seen[-1][1]]
            axis.step(t, np.exp(merit), where="post", color=color, linestyle=dash, linewidth=1.2, label=name)
        axis.set(
            xlabel="processor time [s]",
            ylabel="√(cond raw · cond normalised)",
            xscale="log",
            yscale="log",
            xlim=(min(0.1, seconds / 10), seconds),
        )
        axis.legend(fontsize=7)
    return figure


def compare(seconds: float, seed: int, out: Path, robots: Sequence[str]) -> dict[str, Any]:
    chain = load("lwr4plus")
    spot = problem(chain, 20.0)
    methods = {
        "ours": partial(ours, spot, seconds, seed),
        "differences": partial(ours, spot, seconds, seed, differenced),
        "scipy": partial(by_scipy, spot, seconds, seed, True),
        "scipy, 2-point": partial(by_scipy, spot, seconds, seed, False),
        "random": partial(at_random, spot, seconds, seed),
    }
    curves, rows = dict[str, Curve](), dict[str, Any]()
    for name, method in methods.items():
        curves[name], x = method()
        rows[name] = None if x is None else reached(chain, spot, x)
        said = (
            "nothing feasible"
            if x is None
            else f"{rows[name]['raw']:.1f} raw, {rows[name]['normalised']:.2f} normalised"
        )
        print(f"{name:16} {said}", flush=True)
    save(picture(curves, seconds), out / "plot_peers.png")
    others = dict[str, Any]()
    for name in robots:
        chain = load(name)
        spot = problem(chain, 20.0, None, None, 0.0)
        curve, x = ours(spot, seconds, seed)
        if x is None:
            others[name] = None
            continue
        found = SearchResult(x, 1.0, curve[-1][1], np.zeros(0), (), 0, 0.0, seconds)
        found, proof = ensured(spot, found)
        others[name] = reached(chain, spot, found.x, None) | {
            "feasible": proof.feasible, "columns": len(model(chain, 0.01, None)[0].names),
            "limits": sorted(proof.worst),
        }  # fmt: skip
        print(f"{name}: {others[name]}", flush=True)
    return {"seconds": seconds, "reached": rows, "other_robots": others, "curves": curves}


def main() -> None:
    chosen = study_options.read(
        __doc__, seconds=(60.0, "of processor time per method"), alone="leave out the Panda and the TX40"
    )
    found = compare(chosen.seconds, chosen.seed, chosen.out, () if chosen.alone else ("panda", "tx40"))
    files.write_json(chosen.out / "metrics.json", found)


if __name__ == "__main__":
    main()
