"""The search for exciting motions against its peers, and by itself over five seeds: same robot, same limits.

Problem: LWR4+ of the library, 64 base columns (43 inertial, Fv Fc off of seven joints; Coulomb sign smoothed at 0.05
rad/s), Fourier series of twelve harmonics at rest at both ends, 200 samples; minimise the mean of log cond with raw and
with normalised columns; limits of position and velocity (URDF), torque (library inertias, published friction), tool
0.3 m from axis 1 and above -0.2 m. Every motion is verified against all limits between the samples.

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
peer, one seed, no other robots, of the peers exact gradients, differences and chance; one start of the default search.
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import study_options
from matplotlib.figure import Figure

import calib
from calib import files
from calib.dynamics import base, drives
from calib.procedure.excitation.limits import Points
from calib.procedure.excitation.settings import COARSE, DEFAULT_DESIGN, HARMONICS
from calib.procedure.report.figures.sheets import save, sheet, styled
from calib.toolkit.chains import Chain
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

# friction of the LWR4+, Jubien, Gautier & Janot 2014 as quoted in public code [N m], [N m s/rad]
FC = (11.9, 11.5, 8.98, 8.35, 8.31, 4.72, 6.04)
FV = (14.4, 15.3, 6.55, 11.0, 4.29, 2.26, 1.6)
# speeds over which the Coulomb sign is smoothed, in the search and in its judgement [rad/s]
SMOOTH_SPEED, SHARP_SPEED = 0.05, 0.01
# step of the forward differences
STEP = 1e-7
# factor of the final value from which a search is nearly there
CLOSE = 1.05
# the problem as it is, in one stage
ONE_STAGE = (Stage(30.0, 500.0, 1e-6, 1.0),)
# samples at which a motion is judged
JUDGED_SAMPLES = 1000
# processor seconds, and the mean log cond of a motion
Curve = list[tuple[float, float]]
Metrics = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot of the library, its friction and its workspace.

    Attributes:
        chain: geometry, limits and inertias.
        friction: viscous [N m s/rad] and Coulomb friction [N m] of the joints; None: without friction.
        radius: least distance of the tool from axis 1 [m]; None: not limited.
        lowest: least height of the tool [m].
    """

    chain: Chain
    friction: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    radius: float | None = None
    lowest: float = 0.0

    def model(self, v0: float) -> BaseModel:
        """Return the model of the base columns, its Coulomb sign smoothed over v0 [rad/s]."""
        terms = drives.standard(["Fv Fc off"] * self.chain.n, v0)
        full = IdentificationModel(bodies_of(self.chain), terms)
        return BaseModel(full, base.find(full))

    def values(self, model: BaseModel) -> np.ndarray | None:
        """Return the base parameters (b,); None where the masses are unknown."""
        if self.chain.inertias is None:
            return None
        drive_values = np.zeros((self.chain.n, 3))
        if self.friction is not None:
            drive_values[:, 0], drive_values[:, 1] = self.friction
        standard = np.concatenate([standard_parameters(self.chain), drive_values.ravel()])
        return model.base.transform @ standard


def lwr4plus() -> Robot:
    return Robot(calib.load("lwr4plus").chain, (FV, FC), radius=0.3, lowest=-0.2)


def excitation_problem(robot: Robot, period: float) -> ExcitationProblem:
    """Return the problem of a robot; torque is limited where its masses are known.

    Args:
        robot: the robot.
        period: duration of the motion T0 [s].
    """
    chain = robot.chain
    smooth = robot.model(SMOOTH_SPEED)
    values = robot.values(smooth)
    velocity = np.array([joint.velocity for joint in chain.joints])
    effort = np.array([joint.effort for joint in chain.joints])
    limits: list[Any] = [*box_limits(chain.lower, chain.upper, velocity)]
    if values is not None:
        product = smooth.torque_gradient
        limits.append(TorqueLimit(smooth.regressor, smooth.regressor_gradient, values, effort, torque_product=product))
    tool = Points(chain, (0,), np.zeros((1, 3)))
    limits.append(Workspace(tool, tool.product, radius=robot.radius, lowest=robot.lowest))
    objectives = ((Excitation("cond", "raw"), 0.5), (Excitation("cond", "normalised"), 0.5))
    family = fourier_family(HARMONICS, period, chain.n, rate=1000.0)
    coarse = fourier_family(COARSE, period, chain.n, rate=1000.0)
    return ExcitationProblem(
        family, smooth.regressor, smooth.regressor_gradient, objectives, tuple(limits), coarse=coarse
    )


@dataclass
class TimedEvaluator:
    """Evaluator that interrupts a search, once, when its processor time is over.

    Attributes:
        evaluator: evaluates the problem.
        seconds: processor time of the search [s].
        start: processor time at its start [s].
        interrupted: whether the search was interrupted.
    """

    evaluator: Callable[..., Evaluation]
    seconds: float
    start: float = field(default_factory=time.process_time)
    interrupted: bool = False

    @property
    def elapsed(self) -> float:
        return time.process_time() - self.start

    def __call__(self, *arguments: Any) -> Evaluation:
        if self.elapsed > self.seconds and not self.interrupted:
            self.interrupted = True
            # as a user's Ctrl-C: a start returns its best motion
            raise KeyboardInterrupt
        return self.evaluator(*arguments)


def repeated_search(
    problem: ExcitationProblem,
    method: Method,
    stages: tuple[Stage, ...],
    evaluator: Callable[..., Evaluation],
    seconds: float,
    seed: int,
) -> tuple[Curve, SearchResult | None]:
    """Return the best motion of repeated searches from random starts within the time limit.

    Args:
        problem: the problem.
        method: optimiser of a search.
        stages: stages of sharpness.
        evaluator: evaluates values and gradients.
        seconds: processor time [s].
        seed: seed of the starts.
    """
    curve: Curve = []
    best: SearchResult | None = None
    timed = TimedEvaluator(evaluator, seconds)
    with mock.patch.object(search, "evaluate", timed), suppress(KeyboardInterrupt):
        for start in itertools.count():
            offset = timed.elapsed
            if offset >= seconds:
                break
            result = one_start(problem, DEFAULT_DESIGN.evaluations, method, seed, start, stages)
            if isinstance(result, SearchResult):
                curve += later(result, offset)
                if best is None or result.merit < best.merit:
                    best = result
    return falling(curve), best


def later(result: SearchResult, offset: float) -> Curve:
    """Return the curve of a search that began at an offset [s]."""
    return [(offset + seconds, merit) for seconds, merit in zip(result.times, result.history)]


def falling(curve: Curve) -> Curve:
    """Return the best value reached so far, over time."""
    improvements: Curve = []
    best = np.inf
    for seconds, merit in sorted(curve):
        if merit < best:
            best = merit
            improvements.append((seconds, merit))
    return improvements


def differenced(problem: ExcitationProblem, basis: Any, x: np.ndarray, sharpness: tuple[float, float]) -> Any:
    """Return the result of `evaluate` with gradients by forward differences over all variables (p,)."""
    bare = without_derivatives(problem)
    start = evaluate(bare, basis, x, sharpness)
    slopes = np.empty((1, len(x)))
    rows = np.empty((len(start.constraints), len(x)))
    for k in range(len(x)):
        shifted = x.copy()
        shifted[k] += STEP
        evaluation = evaluate(bare, basis, shifted, sharpness)
        slopes[:, k] = (evaluation.total - start.total) / STEP
        rows[:, k] = (evaluation.constraints - start.constraints) / STEP
    return SimpleNamespace(
        motion=start.motion,
        constraints=start.constraints,
        excess=start.excess,
        values=start.values,
        exact=start.exact,
        total=start.total,
        slopes=slopes,
        rows=rows,
    )


def without_derivatives(problem: ExcitationProblem) -> ExcitationProblem:
    """Return the problem without derivative products: values cost what values cost."""
    constraints: list[Any] = []
    for constraint in problem.constraints:
        if isinstance(constraint, Workspace):
            constraint = replace(constraint, product=_no_product)
        elif isinstance(constraint, TorqueLimit):
            constraint = replace(constraint, product=_no_product, torque_product=None)
        constraints.append(constraint)
    return replace(problem, product=_no_product, constraints=tuple(constraints))


def _no_product(q: np.ndarray, *arguments: np.ndarray) -> Any:
    """Return zeros in the form of a derivative product, by positions alone or by q, v and a."""
    zeros = np.zeros(q.shape)
    return zeros if len(arguments) == 1 else (zeros, zeros, zeros)


def random_search(problem: ExcitationProblem, seconds: float, seed: int) -> tuple[Curve, SearchResult | None]:
    """Return the best feasible motion among random ones within the time limit.

    Args:
        problem: the problem.
        seconds: processor time [s].
        seed: seed of the motions.
    """
    start = time.process_time()
    rng = np.random.default_rng(seed)
    basis = problem.basis()
    curve: Curve = []
    best: SearchResult | None = None
    count = feasible = 0
    while (elapsed := time.process_time() - start) < seconds:
        x = random_start(problem, basis, rng)
        motion = basis.motion(x)
        count += 1
        if any((constraint.values(motion) > 0).any() for constraint in problem.constraints):
            continue
        feasible += 1
        condition = condition_numbers(problem.regressor(motion.q, motion.v, motion.a))
        merit = 0.5 * float(np.log(condition["raw"]) + np.log(condition["normalised"]))
        if best is None or merit < best.merit:
            best = SearchResult(x, 1.0, merit, np.zeros(0), (), 0, 0.0, elapsed)
            curve.append((elapsed, merit))
    print(f"  random: {count} motions, {feasible} of them feasible", flush=True)
    return curve, best


PEERS: dict[str, Callable[..., tuple[Curve, SearchResult | None]]] = {
    "slsqp": partial(repeated_search, method="slsqp", stages=STAGES, evaluator=evaluate),
    "mma": partial(repeated_search, method="mma", stages=STAGES, evaluator=evaluate),
    "ccsaq": partial(repeated_search, method="ccsaq", stages=STAGES, evaluator=evaluate),
    "auglag": partial(repeated_search, method="auglag", stages=STAGES, evaluator=evaluate),
    "slsqp, one stage": partial(repeated_search, method="slsqp", stages=ONE_STAGE, evaluator=evaluate),
    "slsqp, differences": partial(repeated_search, method="slsqp", stages=STAGES, evaluator=differenced),
    "random": random_search,
}


@dataclass(frozen=True)
class Extent:
    """How much of the comparison is run.

    Attributes:
        seconds: processor time per peer [s].
        peers: names of the peers.
        peer_seeds: number of seeds of each peer.
        periods: durations of the default search's motions [s].
        default_seeds: number of its seeds.
        default_starts: number of its starts.
        robots: other robots of the library.
    """

    seconds: float
    peers: tuple[str, ...] = tuple(PEERS)
    peer_seeds: int = 2
    periods: tuple[float, ...] = (20.0, 10.0)
    default_seeds: int = 5
    default_starts: int = DEFAULT_DESIGN.starts
    robots: tuple[str, ...] = ("panda", "tx40")


QUICK = Extent(2.0, ("slsqp", "slsqp, differences", "random"), 1, (10.0,), 1, 1, ())


def verified_condition(robot: Robot, problem: ExcitationProblem, result: SearchResult) -> dict[str, float]:
    """Return condition numbers of a motion that is verified: 1000 samples, Coulomb sign smoothed at 0.01 rad/s."""
    result, proof = ensured(problem, result)
    if not proof.feasible:
        raise RuntimeError(f"a motion breaks {', '.join(sorted(proof.worst))}")
    t = problem.family.period / JUDGED_SAMPLES * np.arange(JUDGED_SAMPLES)
    motion = dense_motion(problem.family, result.x, t)
    return condition_numbers(robot.model(SHARP_SPEED).regressor(motion.q, motion.v, motion.a))


def picture(curves: dict[str, Curve], seconds: float) -> Figure:
    """Draw the geometric mean of both condition numbers against processor time.

    Args:
        curves: name of a search to its curve.
        seconds: end of the drawn time [s].
    """
    styles = [(colour, dash) for dash in ("-", "--") for colour in (AFTER, MARK, BEFORE, QUIET, INK)]
    with styled():
        figure, (axis,) = sheet(width=PAGE_WIDTH, height=3.2)
        for (name, curve), (colour, dash) in zip(curves.items(), styles):
            points = [point for point in curve if point[0] <= seconds]
            if not points:
                points = [(seconds, np.nan)]
            t, merits = zip(*points, (seconds, points[-1][1]))
            axis.step(t, np.exp(merits), where="post", color=colour, linestyle=dash, linewidth=1.2, label=name)
        axis.set(xlabel="processor time [s]", ylabel="√(raw · normalised)", xscale="log", yscale="log")
        axis.set(xlim=(min(0.1, seconds / 10), seconds))
        for scale in (axis.xaxis, axis.yaxis):
            scale.set_major_formatter("{x:g}")
        axis.legend(fontsize=7)
    return figure


def run_peer(robot: Robot, name: str, seconds: float, seed: int) -> Metrics:
    """Return the curve and the condition numbers of a peer."""
    problem = excitation_problem(robot, 20.0)
    curve, result = PEERS[name](problem=problem, seconds=seconds, seed=seed)
    reached = None
    if result is not None:
        reached = verified_condition(robot, problem, result)
    return {"curve": curve, "reached": reached}


def run_default(robot: Robot, period: float, seed: int, starts: int) -> Metrics:
    """Return condition numbers and processor seconds of the default search.

    Args:
        robot: the robot.
        period: duration of the motion [s].
        seed: seed of the starts.
        starts: number of starts.
    """
    problem = excitation_problem(robot, period)
    curve: Curve = []
    start = time.process_time()
    result = design(
        problem, starts=starts, evaluations=DEFAULT_DESIGN.evaluations, seed=seed, map=partial(_timed_map, curve, start)
    )
    result, _ = ensured(problem, result)
    elapsed = time.process_time() - start
    near_merit = result.merit + np.log(CLOSE)
    seconds_close = min(seconds for seconds, merit in curve if merit < near_merit)
    condition = verified_condition(robot, problem, result)
    return condition | {"seconds": elapsed, "seconds_close": seconds_close}


def _timed_map(curve: Curve, start: float, function: Callable, tasks: Any) -> Iterator[Any]:
    """Call like the builtin map, noting at which processor second which merit was reached."""
    for task in tasks:
        offset = time.process_time() - start
        result = function(task)
        if isinstance(result, SearchResult):
            curve += later(result, offset)
        yield result


def run_robot(name: str, seconds: float, seed: int) -> Metrics:
    """Return the result of the default peer on another robot of the library; empty without a motion."""
    robot = Robot(calib.load(name).chain)
    problem = excitation_problem(robot, 20.0)
    _, result = PEERS["slsqp"](problem=problem, seconds=seconds, seed=seed)
    if result is None:
        return {}
    columns = len(robot.model(SHARP_SPEED).names)
    limits = sorted({constraint.name for constraint in problem.constraints})
    return verified_condition(robot, problem, result) | {"columns": columns, "limits": limits}


def searches_of(extent: Extent, seed: int) -> dict[str, Callable[[], Metrics]]:
    """Return the searches to run, by name.

    Args:
        extent: how much is run.
        seed: the first seed.
    """
    robot = lwr4plus()
    searches: dict[str, Callable[[], Metrics]] = {}
    for k in range(seed, seed + extent.default_seeds):
        for period in extent.periods:
            searches[f"default, {period:g} s, seed {k}"] = partial(run_default, robot, period, k, extent.default_starts)
    for k in range(seed, seed + extent.peer_seeds):
        for name in extent.peers:
            searches[f"{name}, seed {k}"] = partial(run_peer, robot, name, extent.seconds, k)
    for name in extent.robots:
        searches[name] = partial(run_robot, name, extent.seconds / 3.0, seed)
    return searches


def stored_metrics(path: Path, seconds: float) -> Metrics:
    """Return the results of an earlier run with the same processor time per peer; without results if there is none."""
    if path.exists():
        metrics = json.loads(path.read_text(encoding="utf-8"))
        if metrics.get("seconds") == seconds:
            return metrics
    return {"seconds": seconds}


def main() -> None:
    arguments = study_options.read(
        __doc__,
        seconds=(30.0, "of processor time per peer"),
        quick="two seconds for each of three peers, one seed, a start",
    )
    extent = QUICK if arguments.quick else Extent(arguments.seconds)
    rows = arguments.out / "rows.json"
    metrics = stored_metrics(rows, extent.seconds)
    for name, search_motion in searches_of(extent, arguments.seed).items():
        if name in metrics:
            continue
        metrics[name] = search_motion()
        files.write_json(rows, metrics)
        print(name, {key: value for key, value in metrics[name].items() if key != "curve"}, flush=True)
    curves = {name: metrics[f"{name}, seed {arguments.seed}"]["curve"] for name in extent.peers}
    save(picture(curves, extent.seconds), arguments.out / "plot_peers.png")
    files.write_json(arguments.out / "metrics.json", metrics)


if __name__ == "__main__":
    main()
