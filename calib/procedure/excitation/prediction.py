"""Predicted σ of the parameters and torques that a motion identifies, before the robot moves.

With Y one sample's regressor and σ_j the error of joint j's torque that no parameter explains, a log of R independent
rows per joint leaves the base parameters with the covariance

    C = (R · mean over the period of Σ_j Y_jᵀ Y_j / σ_j²)⁻¹,

and a torque on other motion with the variance Y C Yᵀ. R counts the rows that `calib identify` keeps: twice the band
that its own rules read from the accelerations. What is not known before a log is σ_j: noise, and friction that no term
holds. It is taken as a share of the torque limits, stated or `DEFAULT_NOISE`; all sigmas go with it in proportion.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calib import files
from calib.data.signals.bandwidth import LOWEST, SHARE
from calib.errors import UsageError, require
from calib.folders import METRICS
from calib.procedure.dynamic_stage.identify import IdentificationOutcome
from calib.procedure.excitation.inputs import ExcitationInputs
from calib.procedure.excitation.limits import DEFAULT_RISE
from calib.procedure.excitation.settings import ExcitationSettings
from calib.procedure.findings import sentence
from calib.procedure.measuring.prediction import sigma_ratio
from calib.records import Array, read_json, read_rows
from trajectories.basis import Family, SampledMotion
from trajectories.design.problem import ExcitationProblem
from trajectories.design.search import STAGES, SearchResult, one_start
from trajectories.design.verify import dense_motion

NAME = "prediction.csv"
DEFAULT_NOISE = 0.01  # of the torque limits: what no parameter explains, where nothing is stated (our choice)
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

    `sigma_before` is that of an identification that the motion adds to.
    """

    name: str
    unit: str
    value: float | None
    sigma: float
    rsd: float | None
    sigma_before: float | None = None


@dataclass(frozen=True, eq=False)
class MotionOutlook:
    """Predicted σ of a designed motion, and of motions of other lengths.

    Attributes:
        noise: (n,) taken as the torques' error [N m or N]; noise_share: of the torque limits.
        own: of the motion as it is to be run; by_period: of other lengths. Longer ones run the same motion again,
            shorter ones are designed quickly.
        before: torque_sigma_share of an identification that the motion adds to; None without one.
    """

    noise_share: float
    noise: Array
    own: MotionPrediction
    by_period: tuple[MotionPrediction, ...]
    before: float | None = None


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
    limits, share = given.limits.torque, DEFAULT_NOISE if settings.noise is None else settings.noise
    if not np.isfinite(limits).all():
        return None, ()
    sigmas = share * limits
    task = task_regressors(given, settings.seed)
    predict = partial(_prediction, given, sigmas, task)
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
    before, earlier = None, [None] * len(spread)
    if given.errors_known:
        root = _root(_known(given))
        before, earlier = _torque_sigma(given, task, root)[1], np.linalg.norm(root, axis=1).tolist()
    parts = given.columns.names, np.array(model.exact.units)[kept].tolist(), values[kept].tolist(), spread.tolist()
    rows = []
    for name, unit, value, sigma, sigma_before in zip(*parts, earlier):
        known = np.isfinite(value) and value != 0.0
        known_rsd = 100.0 * sigma / abs(value) if known else None
        rows.append(PredictedSigma(name, unit, value if known else None, sigma, known_rsd, sigma_before))
    return MotionOutlook(share, sigmas, own, tuple(others), before), rows


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


def _torque_sigma(given: ExcitationInputs, task: np.ndarray, root: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the σ of each joint's predicted torque (n,), largest over the loads, and the rms of σ / torque limit."""
    squares = np.mean(np.sum((task @ root) ** 2, axis=2), axis=0)
    torque = np.sqrt(squares[given.model.exact.limited].max(axis=0))
    return torque, float(np.sqrt(np.mean((torque / given.limits.torque) ** 2)))


def task_regressors(given: ExcitationInputs, seed: int) -> np.ndarray:
    """Return the regressors (TASK_STATES, n, c) at random states of a typical task."""
    box, rng, n = given.limits.positions, np.random.default_rng([seed, 3]), given.chain.n
    low, high = np.where(np.isfinite(box.lower), box.lower, -np.pi), np.where(np.isfinite(box.upper), box.upper, np.pi)
    speeds = np.array([joint.velocity for joint in given.chain.joints])
    fast = 0.5 * np.where(np.isfinite(speeds), speeds, 1.0)
    q, v, a = low + (high - low) * rng.random((TASK_STATES, n)), *(2.0 * rng.random((2, TASK_STATES, n)) - 1.0)
    for j, value in given.locked.items():
        q[:, j], v[:, j], a[:, j] = 0.0 if value is None else value, 0.0, 0.0
    return given.model.exact.regressor(q, fast * v, DEFAULT_RISE * fast * a)[:, :, given.columns.kept]


def _prediction(
    given: ExcitationInputs, noise: np.ndarray, task: np.ndarray, family: Family, x: np.ndarray, factor: float,
    repeat: float,
) -> tuple[MotionPrediction, np.ndarray]:  # fmt: skip
    """Return the prediction for `repeat` periods of a motion, and the sigmas (c,) of the parameters."""
    period = family.period * factor
    motion = dense_motion(family, x, period / PERIOD_SAMPLES * np.arange(PERIOD_SAMPLES), factor)
    rows, sigmas = 2.0 * _band(motion, period) * period * repeat, given.columns.sigmas
    if sigmas is None or not given.errors_known:
        sigmas = noise[given.model.exact.joint_of_row] * (1.0 if sigmas is None else sigmas)
        weight, earlier = rows / PERIOD_SAMPLES, np.zeros((0, task.shape[2]))
    else:
        weight, earlier = period * repeat / PERIOD_SAMPLES, _known(given)
    Y = given.model.exact.regressor(motion.q, motion.v, motion.a)[:, :, given.columns.kept] / sigmas[:, None]
    root = _root(np.concatenate([np.sqrt(weight) * Y.reshape(-1, Y.shape[2]), earlier]))
    return MotionPrediction(period * repeat, rows, *_torque_sigma(given, task, root)), np.linalg.norm(root, axis=1)


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
    return files.write_table(folder / NAME, PredictedSigma._fields, rows)


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
        "most improved: " + "; ".join(
            f"{row.name} from ± {row.sigma_before:.3g} to ± {row.sigma:.3g} {row.unit}" for row in gains
        ),
    ]  # fmt: skip


def check_folder(folder: Path) -> None:
    """Raise an error if a folder contains no prediction of `calib excite`."""
    require((folder / NAME).is_file(), f"{folder} has no {NAME}: give the folder that calib excite wrote", UsageError)


@dataclass(frozen=True)
class _Predicted:
    prediction: MotionOutlook


def compared_with_identification(folder: Path, outcome: IdentificationOutcome) -> str:
    """Return a line that compares the predicted sigmas (folder of `calib excite`) with the identified ones.

    Raises:
        UsageError: if the folder contains no prediction, or one of other parameters.
    """
    check_folder(folder)
    noise = read_json(folder / METRICS, "give the folder that calib excite wrote", _Predicted).prediction.noise_share
    try:
        predicted = {row.name: row.sigma for row in read_rows(PredictedSigma, folder / NAME)}
    except ValueError as error:
        raise UsageError(f"{error}; give the folder that calib excite wrote") from error
    limits = np.array([joint.effort for joint in outcome.inputs.chain.joints])
    rms = next(iter(outcome.fit.values())).filtered.rms[-len(limits) :]  # the motors' rows come last
    known = len(rms) == len(limits) and np.isfinite(rms / limits).all()
    residual = float(np.sqrt(np.mean((rms / limits) ** 2))) if known else None
    stated = dict(zip(outcome.found.names, outcome.found.fitted.estimate.sigma.tolist()))
    found = sigma_ratio(predicted, stated, residual=residual, assumed=noise)
    if found is None:
        raise UsageError(
            f"{folder} contains none of the {len(stated)} identified parameters: it belongs to another robot"
        )
    return sentence(found)
