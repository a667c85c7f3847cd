"""One trial: a method on one data set of a condition, as a row of figures of merit. Its errors never end a study."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from calib.errors import CalibError
from calib.identification.closed_loop.simulation import Plant, Sensing, simulate
from calib.identification.methods.method import EstimateStatus, MethodEstimate
from calib.identification.prediction import Dynamics, predict
from calib.identification.registry import VERSIONS, method_named
from calib.rooms.cells import known_robots
from calib.rooms.studies.conditions import Condition
from calib.rooms.studies.experiment import Experiment, make_experiment, set_up

FOUND = EstimateStatus.FOUND.value
NOT_RECORDED, FAILED = "not recorded", "failed"  # beside `EstimateStatus`: the true robot, or the method, raised
STATUSES = (*(one.value for one in EstimateStatus), NOT_RECORDED, FAILED)
NAN = float("nan")
_CHANGED = " method "


@dataclass(frozen=True)
class TrialRow:
    """Figures of merit of one trial; NaN if not available.

    Attributes:
        condition: name of the condition; digest: what it is.
        method, seed: of the trial.
        status: how it ended: ``found``, another of `EstimateStatus`, ``not recorded``, ``failed``.
        message: why, in a line.
        robot, sigma_q, sigma_tau, decimation, cutoff, mismatch, duration, guess: of the condition; what else there is
            of it, digest and name tell.
        beta_error: 100 ‖β̂ - β‖ / ‖β‖ [%].
        beta_distance: the survey's d_β = 100 (2/p) Σ |β̂_j - β_j| / (|β̂_j| + |β_j|) [%].
        beta_sigma: rms of (β̂_j - β_j) / σ_j: 1 where the stated σ match the error.
        coverage: share of the parameters within 1.96 σ [%].
        torque_error: 100 ‖τ̂ - τ‖ / ‖τ‖ along the validation motion, τ noise-free [%].
        torque_worst: the same of the worst joint.
        survey_tau: the survey's d_τ = 100 mean_k ‖τ_m - W β̂‖ / ‖τ_m‖ on its own data set, noise included [%].
        survey_q: the survey's d_q = 100 mean_k ‖q - q_s‖ / ‖q‖, q_s simulated with β̂ [%]; of the first data sets.
        iterations, simulations: of the method.
        seconds, cpu: wall and processor time of the method [s].
        version: of the toolkit; behind it that of the method, where it has changed: ``0.1.0``, ``0.1.0 method 2``.
    """

    condition: str
    digest: str
    method: str
    seed: int
    status: str
    message: str
    robot: str
    sigma_q: float
    sigma_tau: float
    decimation: int
    cutoff: float
    mismatch: str
    duration: float
    guess: float
    beta_error: float = NAN
    beta_distance: float = NAN
    beta_sigma: float = NAN
    coverage: float = NAN
    torque_error: float = NAN
    torque_worst: float = NAN
    survey_tau: float = NAN
    survey_q: float = NAN
    iterations: int = 0
    simulations: int = 0
    seconds: float = NAN
    cpu: float = NAN
    version: str = ""

    @property
    def key(self) -> tuple[str, str, int]:
        """Unique key of the trial."""
        return self.digest, self.method, self.seed

    @property
    def toolkit(self) -> str:
        """Version of the toolkit that wrote the row."""
        return self.version.partition(_CHANGED)[0]

    @property
    def current(self) -> bool:
        """Whether the method is unchanged since the trial; otherwise the row does not count and is run again."""
        return (self.version.partition(_CHANGED)[2] or "1") == str(VERSIONS.get(self.method, 1))

    @property
    def found(self) -> bool:
        return self.status == FOUND


COLUMNS = tuple(one.name for one in fields(TrialRow))


@dataclass(frozen=True)
class Trials:
    """Trials of several methods on one data set: one task for a worker."""

    condition: Condition
    methods: tuple[str, ...]
    seed: int


def run_trials(trials: Trials) -> list[TrialRow]:
    """Return the row of each method."""
    return [run_trial(trials.condition, method, trials.seed) for method in trials.methods]


def run_trial(condition: Condition, method: str, seed: int) -> TrialRow:
    """Return the row of a condition, a method and a seed; always the same, except for the times."""
    known = {key: value for key, value in asdict(condition).items() if key in COLUMNS}
    head = {"condition": condition.name, "digest": condition.digest, "method": method, "seed": seed, **known}
    own = method_named(method)
    try:
        data = make_experiment(condition, seed)
    except Exception as error:  # an unstable loop, a geometry that cannot be fitted: a finding, not an end
        return TrialRow(status=NOT_RECORDED, message=_said(error), version=_version(method), **head)
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        found, failure = own.estimate(data.problem), None
    except Exception as error:
        found, failure = None, error
    times = {"seconds": time.perf_counter() - wall, "cpu": time.process_time() - cpu, "version": _version(method)}
    if found is None or not found.found:
        status = FAILED if found is None else found.status.value
        why = failure if found is None else found.failure
        return TrialRow(status=status, message=_said(why), **head, **times)
    values = found.estimate.values[: data.problem.base.b]
    if not np.isfinite(values).all():
        return TrialRow(status=EstimateStatus.DIVERGED.value, message="the estimate is not finite", **head, **times)
    merit = _merit(data, found, values) | {"survey_q": _resimulated(condition, data, values, seed)}
    return TrialRow(status=FOUND, message="", **head, **merit, **times)


def _merit(data: Experiment, found: MethodEstimate, values: np.ndarray) -> dict[str, float]:
    truth, error = data.truth, values - data.truth
    wrong = data.matrix @ values - data.torque
    sigma = np.asarray(found.estimate.sigma)[: len(values)]
    stated = bool(np.isfinite(sigma).all() and (sigma > 0.0).any())
    away = np.abs(error[sigma > 0.0] / sigma[sigma > 0.0]) if stated else np.full(1, NAN)
    normal_95 = 1.959963984540054  # standard deviations that hold 95 %
    return {
        "beta_error": _percent(error, truth),
        "beta_distance": float(200.0 * np.mean(np.abs(error) / np.maximum(np.abs(values) + np.abs(truth), 1e-300))),
        "beta_sigma": float(np.sqrt(np.mean(away**2))),
        "coverage": float(100.0 * np.mean(away < normal_95)) if stated else NAN,
        "torque_error": _percent(wrong, data.torque),
        "torque_worst": float(max(_percent(own, true) for own, true in zip(wrong.T, data.torque.T))),
        "survey_tau": _survey_tau(data, values),
        "iterations": found.iterations,
        "simulations": found.simulations,
    }


def _percent(error: np.ndarray, size: np.ndarray) -> float:
    return float(100.0 * np.linalg.norm(error) / max(float(np.linalg.norm(size)), 1e-300))


def _survey_tau(data: Experiment, values: np.ndarray) -> float:
    case, problem = data.problem.cases[0], data.problem
    predicted = predict(Dynamics(problem.model, problem.base.to_standard(values)), case)
    rest = np.linalg.norm(case.target - predicted, axis=1)
    return float(100.0 * np.mean(rest / np.maximum(np.linalg.norm(case.target, axis=1), 1e-12)))


def _resimulated(condition: Condition, data: Experiment, values: np.ndarray, seed: int) -> float:
    """Return the survey's position error d_q [%] of an estimate, simulated again without noise; NaN if unavailable."""
    if seed // condition.guesses >= condition.resimulated:
        return NAN
    setup, problem, model = set_up(condition), data.problem, data.model
    plant = Plant(model.bodies, model.terms, problem.base.to_standard(values))
    controller, sensing = known_robots.controller(condition.robot), Sensing(every=setup.every)
    try:
        run = simulate(plant, controller, setup.reference, sensing)
    except CalibError:
        return NAN
    motion = problem.cases[0].motion
    index = np.rint((motion.t - run.t[0]) * motion.rate).astype(int)
    away = np.linalg.norm(motion.q - run.q[index], axis=1)
    return float(100.0 * np.mean(away / np.maximum(np.linalg.norm(motion.q, axis=1), 1e-12)))


def _said(error: BaseException | None) -> str:
    """Return the message of an error as one line, with its class if it is an unexpected one."""
    if error is None:
        return ""
    words = str(error) if isinstance(error, CalibError) else f"{type(error).__name__}: {error}"
    return " ".join(words.split())[:300]


def _version(method: str) -> str:
    try:
        toolkit = version("armature-calib")
    except PackageNotFoundError:
        toolkit = ""
    return toolkit if VERSIONS[method] == 1 else f"{toolkit}{_CHANGED}{VERSIONS[method]}"


def grouped(condition: Condition, methods: Sequence[str], seed: int) -> list[Trials]:
    """Return the trials of one data set as tasks: one per simulating method, one for all other methods."""
    plain = tuple(name for name in methods if not method_named(name).needs_simulation)
    alone = [Trials(condition, (name,), seed) for name in methods if name not in plain]
    return [*([Trials(condition, plain, seed)] if plain else []), *alone]
