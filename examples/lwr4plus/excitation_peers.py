"""The search for exciting motions against its peers, and by itself over five seeds: same robot, same limits.

Problem: LWR4+ of the library, 64 base columns (43 inertial, Fv Fc off of seven joints; Coulomb sign smoothed at 0.05
rad/s), Fourier series of twelve harmonics at rest at both ends, 200 samples; minimise the mean of log cond with raw and
with normalised columns; limits of position and velocity (URDF), torque (library inertias, published friction), tool
0.3 m from axis 1 and above -0.2 m. Every motion told is verified against all limits between the samples.

Peers, T0 = 20 s, equal processor time on one core, each from random starts that are repaired, one after another:

    slsqp, mma, ccsaq, auglag  exact gradients, four stages of sharpness that begin with five harmonics and few samples:
                               SciPy's SLSQP; NLopt's MMA, CCSAQ (sequential convex) and augmented Lagrangian
    slsqp, one stage           SciPy's SLSQP on the problem as it is
    slsqp, differences         four stages, every gradient by forward differences over all variables
    random                     feasible ones among random Fourier series, coefficients scaled into the joint limits

Seeds: what `calib excite` does by default (four starts, the best goes on), T0 = 20 and 10 s. And the first peer on the
Panda and the TX40, T0 = 20 s, with the same kinds of columns and limits, the tool above the mounting plane (the Panda's
masses are not in the library, so its torque is not limited).

    python examples/lwr4plus/excitation_peers.py --out lwr4plus-peers [--seconds 30] [--quick] [--seed 0]

Some quarter of an hour of processor time; what rows.json holds already is not run again. --quick: two seconds per
peer, one seed, no other robots, of the peers exact gradients, differences and chance; two starts of the default search.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import study_options
from matplotlib.figure import Figure

from calib import files
from calib.dynamics import base, drives
from calib.procedure.excitation.limits import Points
from calib.procedure.excitation.settings import COARSE, DEFAULT_DESIGN, HARMONICS
from calib.procedure.report.figures.sheets import save, sheet, styled
from calib.toolkit.chains import Chain, load
from calib.toolkit.report_charts import AFTER, BEFORE, INK, MARK, PAGE_WIDTH, QUIET
from calib.toolkit.torque_models import BaseModel, IdentificationModel, bodies_of, standard_parameters
from calib.trajectories.constraints import TorqueLimit, box_limits
from calib.trajectories.design import search
from calib.trajectories.design.objectives import Excitation, condition_numbers
from calib.trajectories.design.optimise import design
from calib.trajectories.design.problem import Evaluation, ExcitationProblem, evaluate
from calib.trajectories.design.search import STAGES, Method, SearchResult, Stage, one_start
from calib.trajectories.design.starts import random_start
from calib.trajectories.design.verify import dense_motion, ensured
from calib.trajectories.fourier import fourier_family
from calib.trajectories.workspace_limits import Workspace

FC = (11.9, 11.5, 8.98, 8.35, 8.31, 4.72, 6.04)  # [N m], Jubien, Gautier & Janot 2014 as quoted in public code
FV = (14.4, 15.3, 6.55, 11.0, 4.29, 2.26, 1.6)  # [N m s/rad]
STEP = 1e-7
CLOSE = 1.05  # of the final value: what "nearly there" means
ALONE = (Stage(30.0, 500.0, 1e-6, 1.0),)
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
    family, few = (fourier_family(count, period, chain.n, rate=1000.0) for count in (HARMONICS, COARSE))
    return ExcitationProblem(
        family, smooth.regressor, smooth.regressor_gradient, objectives, tuple(limits), coarse=few
    )  # fmt: skip


def model(chain: Chain, v0: float, friction: tuple | None) -> tuple[BaseModel, np.ndarray | None]:
    full = IdentificationModel(bodies_of(chain), drives.standard(["Fv Fc off"] * chain.n, v0))
    found = base.find(full)
    if chain.inertias is None:
        return BaseModel(full, found), None
    own = np.zeros((chain.n, 3))
    if friction is not None:
        own[:, 0], own[:, 1] = friction
    return BaseModel(full, found), found.transform @ np.concatenate([standard_parameters(chain), own.ravel()])


def searched(
    spot: ExcitationProblem, method: Method, stages: tuple[Stage, ...], evaluator: Callable[..., Evaluation],
    seconds: float, seed: int,
) -> tuple[Curve, SearchResult | None]:  # fmt: skip
    """Return the best motion of repeated searches from random starts within the time limit."""
    began, curve, best, start = time.process_time(), Curve(), None, 0
    ended = list[float]()

    def timed(*given: Any) -> Evaluation:
        now = time.process_time() - began
        if now > seconds and not ended:
            ended.append(now)
            raise KeyboardInterrupt  # as a user's Ctrl-C: a start hands back the best it has
        return evaluator(*given)

    with mock.patch.object(search, "evaluate", timed), suppress(KeyboardInterrupt):
        while (offset := time.process_time() - began) < seconds:
            found = one_start(spot, DEFAULT_DESIGN.evaluations, method, seed, start, stages)
            start += 1
            if isinstance(found, SearchResult):
                best = found if best is None or found.merit < best.merit else best
                curve += [(offset + t, m) for t, m in zip(found.times, found.history)]
    return falling(curve), best


def differenced(spot: ExcitationProblem, basis: Any, y: np.ndarray, sharpness: tuple[float, float]) -> Any:
    """Return the result of `evaluate` with gradients by forward differences over all variables."""
    bare = blind(spot)
    here = evaluate(bare, basis, y, sharpness)
    slopes, rows = np.empty((1, len(y))), np.empty((len(here.constraints), len(y)))
    for k in range(len(y)):
        moved = y.copy()
        moved[k] += STEP
        there = evaluate(bare, basis, moved, sharpness)
        slopes[:, k], rows[:, k] = (there.total - here.total) / STEP, (there.constraints - here.constraints) / STEP
    told = ("motion", "constraints", "excess", "values", "exact", "total")
    return SimpleNamespace(**{name: getattr(here, name) for name in told}, slopes=slopes, rows=rows)


def blind(spot: ExcitationProblem) -> ExcitationProblem:
    """Return the problem without derivative products: values cost what values cost."""
    limits: list[Any] = [replace(c, product=_none) if isinstance(c, Workspace) else c for c in spot.constraints]
    limits = [replace(c, product=_none, torque_product=None) if isinstance(c, TorqueLimit) else c for c in limits]
    return replace(spot, product=_none, constraints=tuple(limits))


def _none(q: np.ndarray, *others: np.ndarray) -> Any:
    return np.zeros(q.shape) if len(others) == 1 else (np.zeros(q.shape),) * 3


def at_random(spot: ExcitationProblem, seconds: float, seed: int) -> tuple[Curve, SearchResult | None]:
    began, curve, basis = time.process_time(), Curve(), spot.basis()
    rng, best, count, kept = np.random.default_rng(seed), None, 0, 0
    while (now := time.process_time() - began) < seconds:
        drawn = random_start(spot, basis, rng)
        motion = basis.motion(drawn)
        count += 1
        if any((c.values(motion) > 0).any() for c in spot.constraints):
            continue
        kept += 1
        cond = condition_numbers(spot.regressor(motion.q, motion.v, motion.a))
        value = 0.5 * float(np.log(cond["raw"]) + np.log(cond["normalised"]))
        if best is None or value < best.merit:
            best = SearchResult(drawn, 1.0, value, np.zeros(0), (), 0, 0.0, now)
            curve.append((now, value))
    print(f"  random: {count} motions, {kept} of them feasible", flush=True)
    return curve, best


PEERS: dict[str, Callable[..., tuple[Curve, SearchResult | None]]] = {
    "slsqp": partial(searched, method="slsqp", stages=STAGES, evaluator=evaluate),
    "mma": partial(searched, method="mma", stages=STAGES, evaluator=evaluate),
    "ccsaq": partial(searched, method="ccsaq", stages=STAGES, evaluator=evaluate),
    "auglag": partial(searched, method="auglag", stages=STAGES, evaluator=evaluate),
    "slsqp, one stage": partial(searched, method="slsqp", stages=ALONE, evaluator=evaluate),
    "slsqp, differences": partial(searched, method="slsqp", stages=STAGES, evaluator=differenced),
    "random": at_random,
}


QUICK = ("slsqp", "slsqp, differences", "random")


def falling(curve: Curve) -> Curve:
    """Return the best value reached so far, over time."""
    result, least = Curve(), np.inf
    for point in sorted(curve):
        if point[1] < least:
            least = point[1]
            result.append(point)
    return result


def reached(
    chain: Chain, spot: ExcitationProblem, found: SearchResult, friction: tuple | None = (FV, FC)
) -> dict[str, float]:
    """Return condition numbers of a motion that is verified: 1000 samples, Coulomb sign smoothed at 0.01 rad/s."""
    found, proof = ensured(spot, found)
    if not proof.feasible:
        raise RuntimeError(f"a motion breaks {', '.join(sorted(proof.worst))}")
    period = spot.family.period
    motion = dense_motion(spot.family, found.x, period / 1000 * np.arange(1000))
    return condition_numbers(model(chain, 0.01, friction)[0].regressor(motion.q, motion.v, motion.a))


def picture(curves: dict[str, Curve], seconds: float) -> Figure:
    """Draw the geometric mean of both condition numbers against processor time."""
    with styled():
        figure, (axis,) = sheet(width=PAGE_WIDTH, height=3.2)
        styles = [(color, dash) for dash in ("-", "--") for color in (AFTER, MARK, BEFORE, QUIET, INK)]
        for (name, curve), (color, dash) in zip(curves.items(), styles):
            seen = [point for point in curve if point[0] <= seconds] or [(seconds, np.nan)]
            t, merit = [*(p[0] for p in seen), seconds], [*(p[1] for p in seen), seen[-1][1]]
            axis.step(t, np.exp(merit), where="post", color=color, linestyle=dash, linewidth=1.2, label=name)
        axis.set(
            xlabel="processor time [s]",
            ylabel="√(raw · normalised)",
            xscale="log",
            yscale="log",
            xlim=(min(0.1, seconds / 10), seconds),
        )
        for side in (axis.xaxis, axis.yaxis):
            side.set_major_formatter("{x:g}")
        axis.legend(fontsize=7)
    return figure


def compared(chain: Chain, name: str, seconds: float, seed: int) -> dict[str, Any]:
    """Return the condition numbers and the time of a peer method."""
    spot = problem(chain, 20.0)
    curve, found = PEERS[name](spot=spot, seconds=seconds, seed=seed)
    return {"curve": curve, "reached": None if found is None else reached(chain, spot, found)}


def by_default(chain: Chain, period: float, seed: int, starts: int = DEFAULT_DESIGN.starts) -> dict[str, float]:
    """Return condition numbers and processor seconds of the default search."""
    spot, curve, began = problem(chain, period), Curve(), time.process_time()
    found = design(
        spot, starts=starts, evaluations=DEFAULT_DESIGN.evaluations, seed=seed,
        map=partial(_timed, curve, began),
    )  # fmt: skip
    found, _ = ensured(spot, found)
    spent = time.process_time() - began
    close = min(t for t, merit in curve if merit < found.merit + np.log(CLOSE))
    return reached(chain, spot, found) | {"seconds": spent, "seconds_close": close}


def _timed(curve: Curve, began: float, call: Callable, tasks: Any) -> Iterator[Any]:
    """Call like the builtin map, noting at which processor second which merit was reached."""
    for task in tasks:
        offset = time.process_time() - began
        found = call(task)
        if isinstance(found, SearchResult):
            curve += [(offset + t, merit) for t, merit in zip(found.times, found.history)]
        yield found


def elsewhere(name: str, seconds: float, seed: int) -> dict[str, Any]:
    """Return the result of the default peer method on another robot of the library."""
    chain = load(name)
    spot = problem(chain, 20.0, None, None, 0.0)
    _, found = PEERS["slsqp"](spot=spot, seconds=seconds, seed=seed)
    if found is None:
        return {}
    columns, limits = len(model(chain, 0.01, None)[0].names), sorted({c.name for c in spot.constraints})
    return reached(chain, spot, found, None) | {"columns": columns, "limits": limits}


def main() -> None:
    chosen = study_options.read(
        __doc__,
        seconds=(30.0, "of processor time per peer"),
        quick="two seconds for each of three peers, one seed, two starts",
    )
    chain, first, place = load("lwr4plus"), chosen.seed, chosen.out / "rows.json"
    seconds, two, five = (2.0, 1, 1) if chosen.quick else (chosen.seconds, 2, 5)
    periods, others = ((10.0,), ()) if chosen.quick else ((20.0, 10.0), ("panda", "tx40"))
    peers = QUICK if chosen.quick else tuple(PEERS)
    starts = 2 if chosen.quick else DEFAULT_DESIGN.starts
    todo: dict[str, Callable[[], dict[str, Any]]] = {
        f"default, {period:g} s, seed {seed}": partial(by_default, chain, period, seed, starts)
        for seed in range(first, first + five) for period in periods
    }  # fmt: skip
    todo |= {
        f"{name}, seed {seed}": partial(compared, chain, name, seconds, seed)
        for seed in range(first, first + two) for name in peers
    }  # fmt: skip
    todo |= {name: partial(elsewhere, name, seconds / 3.0, first) for name in others}
    kept = json.loads(place.read_text(encoding="utf-8")) if place.exists() else {}
    found: dict[str, Any] = kept if kept.get("seconds") == seconds else {"seconds": seconds}
    for name, work in todo.items():
        if name not in found:
            found[name] = work()
            files.write_json(place, found)
            print(name, {key: value for key, value in found[name].items() if key != "curve"}, flush=True)
    curves = {name: found[f"{name}, seed {first}"]["curve"] for name in peers}
    save(picture(curves, seconds), chosen.out / "plot_peers.png")
    files.write_json(chosen.out / "metrics.json", found)


if __name__ == "__main__":
    main()
