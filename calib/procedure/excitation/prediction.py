"""Predicted σ of the parameters and torques that a motion identifies, before the robot moves.

With Y one sample's regressor and σ_j the error of joint j's torque that no parameter explains, a log of R independent
rows per joint leaves the base parameters with the covariance

    C = (R · mean over the period of Σ_j Y_jᵀ Y_j / σ_j²)⁻¹,

and a torque on other motion with the variance Y C Yᵀ. On a calibrated robot an error g of the geometry, the same in all
logs, adds to both (`calib.identification.uncertainty.geometry_uncertainty`): the parameters err by S g = -C Σ Yᵀ
(∂Y/∂g φ) g / σ²,
with earlier motions C (C_before⁻¹ S_before g - …), and torques by Y S g + (∂Y/∂g φ) g. A design minimises the part of
the torques' errors alone. R counts the rows that `calib identify` keeps: twice the band
that its own rules read from the accelerations. What is not known before a log is σ_j: noise, and friction that no term
holds. It is taken as the limits file states it ([noise]), or as a share of the torque limits, stated or
`DEFAULT_NOISE`; all sigmas but the geometry's part go with it in proportion.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calib import files
from calib.data.signals.bandwidth import LOWEST, SHARE
from calib.errors import UsageError, refused_as, require
from calib.folders import METRICS
from calib.procedure.dynamic_stage.identify import IdentificationOutcome
from calib.procedure.excitation.inputs import ExcitationInputs
from calib.procedure.excitation.limits import DEFAULT_NOISE, DEFAULT_RISE
from calib.procedure.excitation.settings import ExcitationSettings
from calib.procedure.findings import sentence
from calib.procedure.measuring.prediction import sigma_ratio
from calib.records import Array, read_json, read_rows
from calib.result_kinds import refusal
from calib.trajectories.basis import Family, SampledMotion
from calib.trajectories.design.problem import ExcitationProblem
from calib.trajectories.design.search import STAGES, SearchResult, one_start
from calib.trajectories.design.verify import dense_motion

NAME = "prediction.csv"
OUTLOOK_EVALUATIONS = 240  # for a motion of another period, which is only looked at (our choice)
PERIODS = (5.0, 10.0, 20.0, 40.0)
PERIOD_SAMPLES = 500  # over a period
TASK_STATES = 400  # states of the typical task: anywhere within the joint limits, up to half of the speed limits


@dataclass(frozen=True, eq=False)
class MotionPrediction:
    """σ predicted for a log of a motion.

    Attributes:
        seconds: of motion; rows_per_joint: independent ones.
        torque_sigma: (n,) rms of the predicted torque's sigma over the typical task [N m or N].
        torque_sigma_share: the same, rms over the joints, as a share of the torque limits.
    """

    seconds: float
    rows_per_joint: float
    torque_sigma: Array
    torque_sigma_share: float


class PredictedSigma(NamedTuple):
    """A row of ``prediction.csv``: a parameter, its value if known, and the sigma predicted for the motion as run.

    `sigma_before` is that of an identification that the motion adds to; `sigma_geometry` the geometry's part of sigma.
    """

    name: str
    unit: str
    value: float | None
    sigma: float
    rsd: float | None
    sigma_before: float | None = None
    sigma_geometry: float | None = None


class Task(NamedTuple):
    """Regressors (N, rows, c) at states of a typical task, and the torques' changes (N, rows, r) by the geometry."""

    regressors: np.ndarray
    felt: np.ndarray


@dataclass(frozen=True, eq=False)
class MotionOutlook:
    """Predicted σ of a designed motion, and of motions of other lengths.

    Attributes:
        noise: (n,) taken as the torques' error [N m or N]; noise_share: of the torque limits.
        own: of the motion as it is to be run; by_period: of other lengths. Longer ones run the same motion again,
            shorter ones are designed quickly.
        before: torque_sigma_share of an identification that the motion adds to, and torque_sigma_before (n,) [N m or
            N] its torque_sigma; None without one.
    """

    noise_share: float
    noise: Array
    own: MotionPrediction
    by_period: tuple[MotionPrediction, ...]
    before: float | None = None
    torque_sigma_before: Array | None = None


def foretell(
    given: ExcitationInputs,
    settings: ExcitationSettings,
    problem: ExcitationProblem,
    found: SearchResult,
    problem_of: Callable[[float], ExcitationProblem],
) -> tuple[MotionOutlook | None, Sequence[PredictedSigma]]:
    """Return the predicted sigmas of torques and parameters; None if a joint has no torque limit.

    Args:
        given, settings, problem, found: the robot, what was asked for, what was solved, and the motion.
        problem_of: a period [s] -> the problem with it.
    """
    limits, noise = given.limits.torque, given.limits.noise
    if not np.isfinite(limits).all():
        return None, ()
    if noise is None:
        noise = (DEFAULT_NOISE if settings.noise is None else settings.noise) * limits
    share = float(np.sqrt(np.mean((noise / limits) ** 2)))
    task = task_of(given, settings.seed)
    predict = partial(_prediction, given, noise, task)
    own, spread = predict(problem.family, found.x, found.factor, settings.repeat)
    others, evaluations = [], min(OUTLOOK_EVALUATIONS, settings.evaluations // 4)
    own_period = problem.family.period * found.factor
    for period in PERIODS if settings.outlook and evaluations and not found.interrupted else ():
        if period >= own_period - 1e-9:
            others.append(predict(problem.family, found.x, found.factor, period / own_period)[0])
            continue
        shorter = _shortened(problem, found, problem_of, period, evaluations)
        others += [] if shorter is None else [predict(shorter[0], shorter[1].x, shorter[1].factor, 1.0)[0]]
    model, kept = given.model, given.columns.kept
    values = np.full(len(model.exact.names), np.nan) if model.values is None else model.values
    before, earlier = (None, None), [None] * len(values[kept])
    if given.errors_known:
        before, earlier = known_sigmas(given, task)
    parts = given.columns.names, np.array(model.exact.units)[kept].tolist(), values[kept].tolist(), earlier
    sigmas = (np.linalg.norm(part, axis=1).tolist() for part in (np.hstack(spread), spread[1]))
    rows = []
    for name, unit, value, sigma_before, sigma, geometry in zip(*parts, *sigmas):
        known = np.isfinite(value) and value != 0.0
        known_rsd = 100.0 * sigma / abs(value) if known else None
        part = None if given.geometry is None else geometry
        rows.append(PredictedSigma(name, unit, value if known else None, sigma, known_rsd, sigma_before, part))
    return MotionOutlook(share, noise, own, tuple(others), before[1], before[0]), rows


def known_sigmas(given: ExcitationInputs, task: Task) -> tuple[tuple[np.ndarray, float], list[float]]:
    """Return the σ of torques on a task (see `_torque_sigma`), and of the parameters, that an identification states."""
    parts = _root(_known(given)), _shifts_before(given)
    return _torque_sigma(given, task, *parts), np.linalg.norm(np.hstack(parts), axis=1).tolist()


def _known(given: ExcitationInputs) -> np.ndarray:
    """Return a root (c, c) of the information matrix of earlier motions, for the columns of the design."""
    assert given.prior is not None
    kept = given.columns.kept
    values, V = np.linalg.eigh(given.prior.information[kept][:, kept])
    return np.sqrt(np.maximum(values, 0.0))[:, None] * V.T


def _root(W: np.ndarray) -> np.ndarray:
    """Return a root C^(1/2) (c, c) of the covariance (Wᵀ W)⁻¹."""
    scale = np.maximum(np.linalg.norm(W, axis=0), 1e-300)
    _, s, vt = np.linalg.svd(W / scale, full_matrices=False)
    return (vt.T / np.maximum(s, 1e-12 * s[0])) / scale[:, None]


def _felt(given: ExcitationInputs, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the torques' changes (N, rows, r) by the principal errors of the geometry; r = 0 for an exact one."""
    if given.geometry is None or given.model.values is None:
        return np.zeros((len(q), len(given.model.exact.joint_of_row), 0))
    return given.geometry.felt(given.model.values, q, v, a)


def _shifts_before(given: ExcitationInputs) -> np.ndarray:
    """Return what the principal errors of the geometry did to the parameters (c, r) of an earlier identification."""
    return (
        np.zeros((len(given.columns.names), 0)) if given.geometry is None else given.geometry.before[given.columns.kept]
    )


def _torque_sigma(
    given: ExcitationInputs, task: Task, root: np.ndarray, shifts: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the σ of each joint's predicted torque (n,), largest over the loads, and the rms of σ / torque limit.

    Args:
        root: (c, c) of the parameters' covariance; shifts: (c, r) of the parameters by the geometry's errors.
    """
    errors = np.concatenate([task.regressors @ root, task.regressors @ shifts + task.felt], axis=2)
    squares = np.mean(np.sum(errors**2, axis=2), axis=0)
    torque = np.sqrt(squares[given.model.exact.limited].max(axis=0))
    return torque, float(np.sqrt(np.mean((torque / given.limits.torque) ** 2)))


def task_states(given: ExcitationInputs, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return q, v, a (TASK_STATES, n) of a typical task."""
    box, rng, n = given.limits.positions, np.random.default_rng([seed, 3]), given.chain.n
    low, high = np.where(np.isfinite(box.lower), box.lower, -np.pi), np.where(np.isfinite(box.upper), box.upper, np.pi)
    speeds = np.array([joint.velocity for joint in given.chain.joints])
    fast = 0.5 * np.where(np.isfinite(speeds), speeds, 1.0)
    q, v, a = low + (high - low) * rng.random((TASK_STATES, n)), *(2.0 * rng.random((2, TASK_STATES, n)) - 1.0)
    for j, value in given.locked.items():
        q[:, j], v[:, j], a[:, j] = 0.0 if value is None else value, 0.0, 0.0
    return q, fast * v, DEFAULT_RISE * fast * a


def task_of(given: ExcitationInputs, seed: int) -> Task:
    """Return the typical task of `task_states`."""
    states = task_states(given, seed)
    return Task(given.model.exact.regressor(*states)[:, :, given.columns.kept], _felt(given, *states))


def _prediction(
    given: ExcitationInputs, noise: np.ndarray, task: Task, family: Family, x: np.ndarray, factor: float, repeat: float
) -> tuple[MotionPrediction, tuple[np.ndarray, np.ndarray]]:
    """Return the prediction for `repeat` periods of a motion, and the two parts of the parameters' errors.

    They are a root (c, c) of the covariance by the torques' errors, and the shifts (c, r) by the geometry's errors.
    """
    period = family.period * factor
    motion = dense_motion(family, x, period / PERIOD_SAMPLES * np.arange(PERIOD_SAMPLES), factor)
    rows, sigmas = 2.0 * _band(motion, period) * period * repeat, given.columns.sigmas
    if sigmas is None or not given.errors_known:
        own = noise[given.model.exact.joint_of_row]
        sigmas = own if sigmas is None else np.where(np.isinf(sigmas), np.inf, own)
        weight, earlier = rows / PERIOD_SAMPLES, np.zeros((0, task.regressors.shape[2]))
    else:
        weight, earlier = period * repeat / PERIOD_SAMPLES, _known(given)
    kept, factors = given.columns.kept, np.sqrt(weight) / sigmas[:, None]
    Y = (given.model.exact.regressor(motion.q, motion.v, motion.a)[:, :, kept] * factors).reshape(
        -1, len(task.regressors[0, 0])
    )
    felt = (_felt(given, motion.q, motion.v, motion.a) * factors).reshape(len(Y), -1)
    root = _root(np.concatenate([Y, earlier]))
    shifts = root @ (root.T @ (earlier.T @ (earlier @ _shifts_before(given)) - Y.T @ felt))
    return MotionPrediction(period * repeat, rows, *_torque_sigma(given, task, root, shifts)), (root, shifts)


def _band(motion: SampledMotion, period: float) -> float:
    """Return the band [Hz] in which identification compares torques: twice f_dyn (`calib.data.signals.bandwidth`)."""
    power = np.abs(np.fft.rfft(motion.a, axis=0)) ** 2
    total = np.cumsum(power, axis=0)
    lines = np.argmax(total >= SHARE * total[-1], axis=0)[total[-1] > 0]
    return 2.0 * max(LOWEST, float(lines.max(initial=0)) / period)


def _shortened(
    problem: ExcitationProblem,
    found: SearchResult,
    problem_of: Callable[[float], ExcitationProblem],
    period: float,
    evaluations: int,
) -> tuple[Family, SearchResult] | None:
    """Return a motion of a shorter period, or None; the search starts from the same path, scaled to keep its speeds."""
    try:
        other = replace(problem_of(period), stretch=(1.0, 1.0))
    except ValueError:  # as many harmonics of a short period are beyond the resonance, or it is no whole sample
        return None
    basis, full = other.basis(), problem.family.period * found.factor
    path = problem.family.basis(basis.times * problem.family.period / period).motion(found.x).q
    middle = path.mean(axis=0)
    run = one_start(
        other, evaluations, "slsqp", 0, basis.nearest(middle + period / full * (path - middle)), STAGES[1:3]
    )
    return (other.family, run) if isinstance(run, SearchResult) else None


def write(rows: Sequence[PredictedSigma], folder: Path) -> Path:
    """Write the parameters' predicted sigmas as CSV; value and rsd [%] are empty where the value is not known."""
    header = [f"{name} [%]" if name == "rsd" else name for name in PredictedSigma._fields]
    return files.write_table(folder / NAME, header, rows)


def lines(one: MotionOutlook, predicted: Sequence[PredictedSigma] = ()) -> list[str]:
    """Return the predicted σ of torques as text, for this motion and for motions of other lengths.

    After an identification, the three parameters whose σ the motion lowers most follow.
    """
    others = ", ".join(f"{100 * each.torque_sigma_share:.2g} % from {each.seconds:g} s" for each in one.by_period)
    head = "predicted σ of torques, typical task: "
    own = f"{100 * one.own.torque_sigma_share:.2g} % of the limits from {one.own.seconds:g} s"
    others = f" ({others})" if others else ""
    if one.before is None:
        return [f"{head}{own}{others}, if the torque residual is {100 * one.noise_share:.2g} %"]
    gains = sorted(
        (row for row in predicted if row.sigma_before), key=lambda row: row.sigma / (row.sigma_before or np.inf)
    )[:3]
    return [
        f"{head}{100 * one.before:.2g} % so far, with this motion {own}{others}",
        "most improved: "
        + "; ".join(f"{row.name} from ± {row.sigma_before:.3g} to ± {row.sigma:.3g} {row.unit}" for row in gains),
    ]


def check_folder(folder: Path) -> None:
    """Raise an error if a folder contains no prediction of `calib excite`."""
    require((folder / NAME).is_file(), refusal(folder, "recall"), UsageError)


@dataclass(frozen=True)
class _Predicted:
    prediction: MotionOutlook


def compared_with_identification(folder: Path, outcome: IdentificationOutcome) -> str:
    """Return a line that compares the predicted sigmas (folder of `calib excite`) with the identified ones.

    Raises:
        UsageError: if the folder contains no prediction, or one of other parameters.
    """
    check_folder(folder)
    outlook = read_json(folder / METRICS, "give the folder that calib excite wrote", _Predicted).prediction
    with refused_as(UsageError, ValueError, "{}; give the folder that calib excite wrote"):
        predicted = {row.name: row.sigma for row in read_rows(PredictedSigma, folder / NAME)}
    limits = np.array([joint.effort for joint in outcome.inputs.chain.joints])
    rms = next(iter(outcome.fit.values())).filtered.rms[-len(limits) :]  # the motors' rows come last
    known = len(rms) == len(limits) and np.isfinite(rms / limits).all()
    known &= outlook.before is None  # else the errors were known
    residual = float(np.sqrt(np.mean((rms / limits) ** 2))) if known else None
    estimate = outcome.found.fitted.estimate if outcome.carried is None else outcome.carried
    stated = dict(zip(outcome.found.names, estimate.sigma.tolist()))
    found = sigma_ratio(predicted, stated, residual=residual, assumed=outlook.noise_share)
    if found is None:
        raise UsageError(
            f"{folder} contains none of the {len(stated)} identified parameters: it belongs to another robot"
        )
    return sentence(found)
