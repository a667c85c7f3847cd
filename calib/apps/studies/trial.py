"""One trial: a method applied to one data set of a condition, as a row of figures of merit.

An error of the method becomes part of the row and never ends a study.
"""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from calib.apps.studies.conditions import Condition
from calib.apps.studies.experiment import Experiment, make_experiment, set_up
from calib.errors import CalibError
from calib.records import FieldValues
from calib.toolkit.simulations import Plant, Sensing, published_controller, simulate
from calib.toolkit.torque_models import VERSIONS, Dynamics, EstimateStatus, MethodEstimate, method_named, predict

FOUND = EstimateStatus.FOUND.value
# Beside `EstimateStatus`: the true robot, or the method, raised an error.
NOT_RECORDED = "not recorded"
FAILED = "failed"
STATUSES = (*(status.value for status in EstimateStatus), NOT_RECORDED, FAILED)
NAN = float("nan")
# Between the versions of toolkit and method.
_CHANGED = " method "
# Standard deviations of a normal distribution that hold 95 %.
NORMAL_95 = 1.959963984540054
# Longest message of a row.
MAX_MESSAGE = 300


@dataclass(frozen=True)
class TrialRow:
    """Figures of merit of one trial; NaN where a figure is not available.

    β are the p base parameters, W is the observation matrix, τ the torques; a hat marks estimates. "The survey" is
    Leboutet et al. (2021).

    Attributes:
        condition, digest: name of the condition, and the digest of its content.
        method, seed: method and seed of the trial.
        status: how the trial ended: ``found``, another value of `EstimateStatus`, ``not recorded``, ``failed``.
        message: the reason, in one line.
        robot, sigma_q, sigma_tau, decimation, cutoff, mismatch, duration, guess: values of the condition. Its other
            values are determined by digest and name.
        beta_error: 100 ‖β̂ - β‖ / ‖β‖ [%].
        beta_distance: the survey's d_β = 100 (2/p) Σ |β̂_j - β_j| / (|β̂_j| + |β_j|) [%].
        beta_sigma: rms of (β̂_j - β_j) / σ_j: 1 where the estimated σ match the errors.
        coverage: share of the parameters whose true value is within 1.96 σ of the estimate [%].
        torque_error: 100 ‖τ̂ - τ‖ / ‖τ‖ along the validation motion, τ noise-free [%].
        torque_worst: torque error of the worst joint [%].
        survey_tau: the survey's d_τ = 100 mean_k ‖τ_m - W β̂‖ / ‖τ_m‖ on the method's own data set, with measured
            torques τ_m, noise included [%].
        survey_q: the survey's d_q = 100 mean_k ‖q - q_s‖ / ‖q‖, with positions q_s simulated with β̂ [%]; only for the
            first data sets.
        iterations, simulations: number of iterations and simulations of the method.
        seconds, cpu: wall-clock and processor time of the method [s].
        version: version of the toolkit, followed by that of the method if it has changed: ``0.1.0``, ``0.1.0 method
            2``.
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
        """Key of the trial in the store: digest of the condition, method and seed."""
        return self.digest, self.method, self.seed

    @property
    def toolkit(self) -> str:
        """Version of the toolkit that wrote the row."""
        return self.version.partition(_CHANGED)[0]

    @property
    def current(self) -> bool:
        """Whether the method is unchanged since the trial; otherwise the row is not used and the trial is repeated."""
        return (self.version.partition(_CHANGED)[2] or "1") == str(VERSIONS.get(self.method, 1))

    @property
    def found(self) -> bool:
        return self.status == FOUND


COLUMNS = tuple(field.name for field in fields(TrialRow))


@dataclass(frozen=True)
class Trials:
    """Trials of several methods on one data set, which are one task for a worker.

    Attributes:
        condition: the condition.
        methods: names of the methods.
        seed: seed of the trials.
    """

    condition: Condition
    methods: tuple[str, ...]
    seed: int


def run_trials(trials: Trials) -> list[TrialRow]:
    """Return one row for each method of a task."""
    return [run_trial(trials.condition, method, trials.seed) for method in trials.methods]


def run_trial(condition: Condition, method: str, seed: int) -> TrialRow:
    """Return the row of a trial, given by condition, method and seed; reproducible except for the times."""
    head: FieldValues = {
        "condition": condition.name,
        "digest": condition.digest,
        "method": method,
        "seed": seed,
        "version": _version(method),
    }
    head |= {key: value for key, value in asdict(condition).items() if key in COLUMNS}
    estimator = method_named(method)
    try:
        data = make_experiment(condition, seed)
    except Exception as error:
        # An unstable loop, or a geometry that cannot be fitted, is a finding, not an end.
        return TrialRow(status=NOT_RECORDED, message=_message(error), **head)
    wall, cpu = time.perf_counter(), time.process_time()
    outcome: MethodEstimate | None = None
    failure: BaseException | None = None
    try:
        outcome = estimator.estimate(data.problem)
    except Exception as error:
        failure = error
    head["seconds"] = time.perf_counter() - wall
    head["cpu"] = time.process_time() - cpu
    if outcome is None:
        return TrialRow(status=FAILED, message=_message(failure), **head)
    if not outcome.found:
        return TrialRow(status=outcome.status.value, message=_message(outcome.failure), **head)
    values = outcome.estimate.values[: data.problem.base.b]
    if not np.isfinite(values).all():
        return TrialRow(status=EstimateStatus.DIVERGED.value, message="the estimate is not finite", **head)
    merit = _merit(data, outcome, values)
    merit["survey_q"] = _resimulated(condition, data, values, seed)
    return TrialRow(status=FOUND, message="", **head, **merit)


def _merit(data: Experiment, outcome: MethodEstimate, values: np.ndarray) -> FieldValues:
    """Return all figures of merit but ``survey_q`` of an estimate, by name.

    Args:
        data: the data set.
        outcome: the method's estimate.
        values: (b,) estimated base parameters.
    """
    error = values - data.truth
    torque_error = data.matrix @ values - data.torque
    joint_errors = [_percent(joint, torque) for joint, torque in zip(torque_error.T, data.torque.T)]
    sizes = np.maximum(np.abs(values) + np.abs(data.truth), 1e-300)
    beta_sigma = coverage = NAN
    sigma = np.asarray(outcome.estimate.sigma)[: len(values)]
    if np.isfinite(sigma).all() and (sigma > 0.0).any():
        in_sigmas = np.abs(error[sigma > 0.0] / sigma[sigma > 0.0])
        beta_sigma = float(np.sqrt(np.mean(in_sigmas**2)))
        coverage = float(100.0 * np.mean(in_sigmas < NORMAL_95))
    return {
        "beta_error": _percent(error, data.truth),
        "beta_distance": float(200.0 * np.mean(np.abs(error) / sizes)),
        "beta_sigma": beta_sigma,
        "coverage": coverage,
        "torque_error": _percent(torque_error, data.torque),
        "torque_worst": float(max(joint_errors)),
        "survey_tau": _survey_tau(data, values),
        "iterations": outcome.iterations,
        "simulations": outcome.simulations,
    }


def _percent(error: np.ndarray, size: np.ndarray) -> float:
    return float(100.0 * np.linalg.norm(error) / max(float(np.linalg.norm(size)), 1e-300))


def _survey_tau(data: Experiment, values: np.ndarray) -> float:
    """Return the torque error d_τ of Leboutet et al. (2021) [%] of an estimate on the data set's first recording.

    Args:
        data: the data set.
        values: (b,) estimated base parameters.
    """
    problem = data.problem
    case = problem.cases[0]
    predicted = predict(Dynamics(problem.model, problem.base.to_standard(values)), case)
    residual = np.linalg.norm(case.target - predicted, axis=1)
    size = np.maximum(np.linalg.norm(case.target, axis=1), 1e-12)
    return float(100.0 * np.mean(residual / size))


def _resimulated(condition: Condition, data: Experiment, values: np.ndarray, seed: int) -> float:
    """Return the position error d_q of Leboutet et al. (2021) [%] of an estimate; NaN if unavailable.

    The motion is simulated again without noise, with the estimated parameters.

    Args:
        condition: the condition.
        data: the data set.
        values: (b,) estimated base parameters.
        seed: seed of the trial; the error is computed for the first data sets only.
    """
    if seed // condition.guesses >= condition.resimulated:
        return NAN
    setup = set_up(condition)
    problem = data.problem
    plant = Plant(data.model.bodies, data.model.terms, problem.base.to_standard(values))
    controller = published_controller(condition.robot)
    sensing = Sensing(every=setup.every)
    try:
        run = simulate(plant, controller, setup.reference, sensing)
    except CalibError:
        return NAN
    motion = problem.cases[0].motion
    index = np.rint((motion.t - run.t[0]) * motion.rate).astype(int)
    position_error = np.linalg.norm(motion.q - run.q[index], axis=1)
    size = np.maximum(np.linalg.norm(motion.q, axis=1), 1e-12)
    return float(100.0 * np.mean(position_error / size))


def _message(error: BaseException | None) -> str:
    """Return the message of an error in one line, preceded by the class of an unexpected error; empty for None."""
    if error is None:
        return ""
    if isinstance(error, CalibError):
        message = str(error)
    else:
        message = f"{type(error).__name__}: {error}"
    return " ".join(message.split())[:MAX_MESSAGE]


def _version(method: str) -> str:
    """Return the version of the toolkit, followed by that of the method if it has changed."""
    try:
        toolkit = version("armature-calib")
    except PackageNotFoundError:
        toolkit = ""
    if VERSIONS[method] == 1:
        return toolkit
    return f"{toolkit}{_CHANGED}{VERSIONS[method]}"


def grouped(condition: Condition, methods: Sequence[str], seed: int) -> list[Trials]:
    """Return the trials of one data set as tasks: one per simulating method, one for all other methods.

    Args:
        condition: the condition.
        methods: names of the methods.
        seed: seed of the trials.
    """
    fast = [name for name in methods if not method_named(name).needs_simulation]
    tasks = []
    if fast:
        tasks.append(Trials(condition, tuple(fast), seed))
    return tasks + [Trials(condition, (name,), seed) for name in methods if name not in fast]
