"""Predicted σ of the parameters and torques that a motion identifies, before the robot moves.

With Y the regressor of one sample and σ_j the standard deviation of the torque error of joint j that no parameter
explains, a log of R independent rows per joint yields the base parameters with the covariance

    C = (R · mean over the period of Σ_j Y_jᵀ Y_j / σ_j²)⁻¹,

and the torque of another motion with the variance Y C Yᵀ. On a calibrated robot, an error g of the geometry, which is
equal in all logs, adds to both (`calib.identification.uncertainty.geometry_uncertainty`). It changes the parameters by
S g = -C Σ Yᵀ (∂Y/∂g φ) g / σ², with earlier motions by C (C_before⁻¹ S_before g - …), and the torques by
Y S g + (∂Y/∂g φ) g. A design minimises only the part from torque errors.

R is the number of rows that `calib identify` uses: twice the identification band, computed from the accelerations by
the rules of the identification. Before a log exists, σ_j is unknown: it consists of noise, and of friction that no term
models. It is taken from the limits file ([noise]), or assumed as a share of the torque limits (stated, or
`DEFAULT_NOISE`). All predicted σ except the geometry's part are proportional to it.

After an identification, σ_j² is the spectral density of the errors that it left. Its share that grew with the torques'
rates of change is scaled by the torques' variance on the new motion (`calib.identification.uncertainty.error_growth`),
and all of it is taken from the band in which the recordings are then identified together
(`calib.identification.uncertainty.error_bands`), in which the earlier recordings are weighed anew. A further recording
adds larger errors than those of the earlier ones, on which the model was chosen (`ADDED_ERRORS`).
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
from calib.procedure.dynamic_stage.inputs import rows_per_second
from calib.procedure.excitation.inputs import ExcitationInputs
from calib.procedure.excitation.limits import DEFAULT_NOISE, DEFAULT_RISE
from calib.procedure.excitation.settings import ExcitationSettings
from calib.procedure.findings import sentence
from calib.procedure.measuring.prediction import sigma_ratio
from calib.records import Array, read_json, read_rows
from calib.trajectories.basis import Family, SampledMotion
from calib.trajectories.design.problem import ExcitationProblem
from calib.trajectories.design.search import STAGES, SearchResult, one_start
from calib.trajectories.design.verify import dense_motion

NAME = "prediction.csv"
# of the search for a motion of another period, which only informs the user (our choice)
OUTLOOK_EVALUATIONS = 240
# [s] of the motions that are predicted besides
PERIODS = (5.0, 10.0, 20.0, 40.0)
# samples of a period at which rows are computed
PERIOD_SAMPLES = 500
# states of the typical task: anywhere within the joint limits, up to half of the speed limits
TASK_STATES = 400
# parameters named as those that a motion improves most
NAMED_GAINS = 3
# variance of the errors that a further recording adds, over that of the recordings on which the model was chosen: the
# medians of six real robots are then nearest to the prediction (examples/promised_sigma.py)
ADDED_ERRORS = 1.4
# σ reached over σ predicted after an identification: 10 and 90 % quantiles of the parameters of six real robots, which
# count alike (examples/promised_sigma.py)
REACHED = (0.75, 1.78)
# share of an eigenvalue's size that is rounding
ROUNDING = 1e-6
WRITTEN_BY_EXCITE = "give the folder that calib excite wrote"


@dataclass(frozen=True, eq=False)
class MotionPrediction:
    """σ predicted for a log of a motion.

    Attributes:
        seconds: duration of the motion [s].
        rows_per_joint: number of independent rows per joint.
        torque_sigma: (n,) rms over the typical task of the σ of the predicted torque [N m or N].
        torque_sigma_share: rms over the joints of `torque_sigma`, as a share of the torque limits.
        error_growth: largest factor of a torque error's σ compared with that of the earlier motions; 1 without these.
    """

    seconds: float
    rows_per_joint: float
    torque_sigma: Array
    torque_sigma_share: float
    error_growth: float = 1.0


class PredictedSigma(NamedTuple):
    """A row of ``prediction.csv``: a parameter, and the σ predicted for the motion as it is to be run.

    Attributes:
        name, unit: name and unit of the parameter.
        value: its value; None if unknown.
        sigma: predicted standard deviation.
        rsd: `sigma` in percent of the value; None if the value is unknown.
        sigma_before: σ by the identification that the motion complements; None: no such identification.
        sigma_geometry: part of `sigma` that is due to the uncertain geometry; None if the geometry is taken as exact.
    """

    name: str
    unit: str
    value: float | None
    sigma: float
    rsd: float | None
    sigma_before: float | None = None
    sigma_geometry: float | None = None


class Task(NamedTuple):
    """A typical task, sampled at N states.

    Attributes:
        regressors: (N, rows, c) regressors at the states.
        felt: (N, rows, r) changes of the torques by r principal errors of the geometry.
    """

    regressors: np.ndarray
    felt: np.ndarray


@dataclass(frozen=True, eq=False)
class MotionOutlook:
    """Predicted σ of a designed motion, and of motions with other durations.

    Attributes:
        noise_share: assumed torque error as a share of the torque limits.
        noise: (n,) assumed torque error [N m or N].
        own: prediction for the designed motion as it is to be run.
        by_period: predictions for other durations: longer ones repeat the designed motion, shorter ones are designed by
            a quick search.
        before: `torque_sigma_share` of the identification that the motion complements; None: no such identification.
        torque_sigma_before: (n,) `torque_sigma` of that identification [N m or N]; None: no such identification.
        reached: 10 and 90 % quantiles of σ reached over σ predicted for the parameters; None: not known, since no
            identification states its errors in wider bands.
    """

    noise_share: float
    noise: Array
    own: MotionPrediction
    by_period: tuple[MotionPrediction, ...]
    before: float | None = None
    torque_sigma_before: Array | None = None
    reached: tuple[float, float] | None = None

    @property
    def reliability(self) -> str:
        """A clause on how far the parameters' σ of the next identification may be from those predicted."""
        if self.reached is None:
            return (
                "how far σ reached may be from σ predicted is not known, since the identification, of an earlier "
                "version, does not state its errors in wider bands: identify again"
            )
        low, high = self.reached
        return (
            f"on six real robots, 80 % of the parameters reached a σ of {low:g} to {high:g} times the predicted one, "
            "all recordings identified with --after, too"
        )


def foretell(
    inputs: ExcitationInputs,
    settings: ExcitationSettings,
    problem: ExcitationProblem,
    motion: SearchResult,
    problem_of: Callable[[float], ExcitationProblem],
) -> tuple[MotionOutlook | None, Sequence[PredictedSigma]]:
    """Return the predicted σ of torques and of parameters for a designed motion.

    Without torque limits of all joints, the results are None and empty.

    Args:
        inputs: the robot, its limits and model.
        settings: settings of the design.
        problem: optimisation problem of the design.
        motion: solution of the problem.
        problem_of: function that returns the optimisation problem for a period [s].
    """
    limits, noise = inputs.limits.torque, inputs.limits.noise
    if not np.isfinite(limits).all():
        return None, ()
    if noise is None:
        share = DEFAULT_NOISE
        if settings.noise is not None:
            share = settings.noise
        noise = share * limits
    noise_share = float(np.sqrt(np.mean((noise / limits) ** 2)))
    task = task_of(inputs, settings.seed)
    predict = partial(_prediction, inputs, noise, task)
    prediction, root, shifts = predict(problem.family, motion.x, motion.factor, settings.repeat)

    by_period = []
    evaluations = min(OUTLOOK_EVALUATIONS, settings.evaluations // 4)
    periods: Sequence[float] = ()
    if settings.outlook and evaluations and not motion.interrupted:
        periods = PERIODS
    designed_period = problem.family.period * motion.factor
    for period in periods:
        # a longer log repeats the motion, a shorter one needs another motion
        if period >= designed_period - 1e-9:
            repeated, _, _ = predict(problem.family, motion.x, motion.factor, period / designed_period)
            by_period.append(repeated)
            continue
        shorter = _shortened(problem, motion, problem_of, period, evaluations)
        if shorter is not None:
            family, search = shorter
            shortened, _, _ = predict(family, search.x, search.factor, 1.0)
            by_period.append(shortened)

    outlook = MotionOutlook(noise_share, noise, prediction, tuple(by_period))
    sigmas_before: Sequence[float | None] = [None] * len(inputs.columns.names)
    if inputs.errors_known:
        (torque_sigma, share_before), sigmas_before = known_sigmas(inputs, task)
        outlook = replace(outlook, before=share_before, torque_sigma_before=torque_sigma)
        if inputs.prior is not None and inputs.prior.bands is not None:
            outlook = replace(outlook, reached=REACHED)
    return outlook, _parameter_rows(inputs, root, shifts, sigmas_before)


def _parameter_rows(
    inputs: ExcitationInputs, root: np.ndarray, shifts: np.ndarray, sigmas_before: Sequence[float | None]
) -> list[PredictedSigma]:
    """Return the rows of ``prediction.csv``.

    Args:
        inputs: the robot and its model.
        root: (c, c) square root of the parameters' covariance from torque errors.
        shifts: (c, r) shifts of the parameters by the principal errors of the geometry.
        sigmas_before: (c,) σ of the identification that the motion complements; None: no such identification.
    """
    model, columns = inputs.model, inputs.columns.kept
    values = np.full(len(model.exact.names), np.nan)
    if model.values is not None:
        values = model.values
    units = np.array(model.exact.units)[columns].tolist()
    sigmas = np.linalg.norm(np.hstack([root, shifts]), axis=1).tolist()
    geometry_sigmas = np.linalg.norm(shifts, axis=1).tolist()
    rows = []
    for k, value in enumerate(values[columns].tolist()):
        stated_value = rsd = sigma_geometry = None
        if np.isfinite(value) and value != 0.0:
            stated_value = value
            rsd = 100.0 * sigmas[k] / abs(value)
        if inputs.geometry is not None:
            sigma_geometry = geometry_sigmas[k]
        name = inputs.columns.names[k]
        rows.append(PredictedSigma(name, units[k], stated_value, sigmas[k], rsd, sigmas_before[k], sigma_geometry))
    return rows


def known_sigmas(inputs: ExcitationInputs, task: Task) -> tuple[tuple[np.ndarray, float], list[float]]:
    """Return the σ that an earlier identification states, for the torques of a task and for the parameters.

    Args:
        inputs: the robot, its model and the earlier identification.
        task: the typical task.

    Returns:
        σ of each joint's torque (n,) with the rms of σ / torque limit, and σ (c,) of the parameters.
    """
    root = _root(_information_root(inputs))
    shifts = _shifts_before(inputs)
    sigmas = np.linalg.norm(np.hstack([root, shifts]), axis=1)
    return _torque_sigma(inputs, task, root, shifts), sigmas.tolist()


def _information_root(inputs: ExcitationInputs, factor: np.ndarray | float = 1.0) -> np.ndarray:
    """Return a square root W (c, c) of the earlier motions' information matrix Wᵀ W.

    The priors' share is what the information exceeds that of the recordings' rows by. Where it does not exceed it, as
    with a geometry's part in the covariance, all of it is scaled.

    Args:
        inputs: model and earlier motions; c is the number of columns of the design.
        factor: factor (c,) of the recordings' rows; that of priors is 1.
    """
    assert inputs.prior is not None
    columns = inputs.columns.kept
    information = inputs.prior.information[columns][:, columns]
    squared_factors = np.outer(factor, factor) * np.ones_like(information)
    scaled = information * squared_factors
    if inputs.prior.data is not None:
        data = inputs.prior.data[columns][:, columns]
        priors = information - data
        if _is_semidefinite(priors, information):
            scaled = priors + data * squared_factors
    # columns of unit size: what a term that is switched off is known by must not drown the others by rounding
    size = np.sqrt(np.maximum(np.diag(scaled), 1e-300))
    values, V = np.linalg.eigh(scaled / np.outer(size, size))
    return np.sqrt(np.maximum(values, 0.0))[:, None] * V.T * size


def _is_semidefinite(difference: np.ndarray, information: np.ndarray) -> bool:
    """Return whether a part (c, c) of an information matrix has no negative eigenvalue but for rounding."""
    size = np.sqrt(np.maximum(np.diag(information), 1e-300))
    return bool(np.linalg.eigvalsh(difference / np.outer(size, size))[0] > -ROUNDING)


def _root(W: np.ndarray) -> np.ndarray:
    """Return a square root C^(1/2) (c, c) of the covariance C = (Wᵀ W)⁻¹: C^(1/2) C^(1/2)ᵀ = C.

    Args:
        W: (rows, c) weighted observation matrix, or a square root of the information matrix.
    """
    scale = np.maximum(np.linalg.norm(W, axis=0), 1e-300)
    _, s, vt = np.linalg.svd(W / scale, full_matrices=False)
    return (vt.T / np.maximum(s, 1e-12 * s[0])) / scale[:, None]


def _geometry_torques(inputs: ExcitationInputs, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the changes (N, rows, r) of the torques by r principal errors of the geometry; r = 0 without them.

    Args:
        inputs: the robot with its geometry's uncertainty, and the model.
        q, v, a: (N, n) positions, velocities and accelerations.
    """
    if inputs.geometry is None or inputs.model.values is None:
        return np.zeros((len(q), len(inputs.model.exact.joint_of_row), 0))
    return inputs.geometry.felt(inputs.model.values, q, v, a)


def _shifts_before(inputs: ExcitationInputs) -> np.ndarray:
    """Return the shifts (c, r) of an earlier identification's parameters by r principal errors of the geometry.

    Without principal errors, r is 0.

    Args:
        inputs: the earlier identification and the geometry's uncertainty.
    """
    if inputs.geometry is None:
        return np.zeros((len(inputs.columns.names), 0))
    return inputs.geometry.before[inputs.columns.kept]


def _torque_sigma(
    inputs: ExcitationInputs, task: Task, root: np.ndarray, shifts: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the σ of each joint's predicted torque (n,), largest over the payloads, and the rms of σ / torque limit.

    Args:
        inputs: the robot and its model.
        task: the typical task.
        root: (c, c) square root of the parameters' covariance.
        shifts: (c, r) shifts of the parameters by the geometry's errors.
    """
    by_torque_errors = task.regressors @ root
    by_geometry = task.regressors @ shifts + task.felt
    errors = np.concatenate([by_torque_errors, by_geometry], axis=2)
    squares = np.mean(np.sum(errors**2, axis=2), axis=0)
    torque = np.sqrt(squares[inputs.model.exact.limited].max(axis=0))
    return torque, float(np.sqrt(np.mean((torque / inputs.limits.torque) ** 2)))


def task_states(inputs: ExcitationInputs, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return random positions, velocities and accelerations q, v, a (TASK_STATES, n) of a typical task.

    Args:
        inputs: the robot and its limits.
        seed: seed of the states.
    """
    n = inputs.chain.n
    box = inputs.limits.positions
    low = np.where(np.isfinite(box.lower), box.lower, -np.pi)
    high = np.where(np.isfinite(box.upper), box.upper, np.pi)
    speeds = np.array([joint.velocity for joint in inputs.chain.joints])
    half_speed = 0.5 * np.where(np.isfinite(speeds), speeds, 1.0)
    stream = np.random.default_rng([seed, 3])
    q = low + (high - low) * stream.random((TASK_STATES, n))
    v, a = 2.0 * stream.random((2, TASK_STATES, n)) - 1.0
    for j, value in inputs.locked.items():
        q[:, j] = 0.0 if value is None else value
        v[:, j] = 0.0
        a[:, j] = 0.0
    return q, half_speed * v, DEFAULT_RISE * half_speed * a


def task_of(inputs: ExcitationInputs, seed: int) -> Task:
    """Return the typical task: regressors and effects of the geometry's errors at the states of `task_states`.

    Args:
        inputs: the robot and its model.
        seed: seed of the states.
    """
    states = task_states(inputs, seed)
    regressors = inputs.model.exact.regressor(*states)[:, :, inputs.columns.kept]
    return Task(regressors, _geometry_torques(inputs, *states))


def _prediction(
    inputs: ExcitationInputs, noise: np.ndarray, task: Task, family: Family, x: np.ndarray, factor: float, repeat: float
) -> tuple[MotionPrediction, np.ndarray, np.ndarray]:
    """Return the prediction for a motion, and the two parts of the parameters' errors.

    Args:
        inputs: the robot and its model.
        noise: (n,) assumed torque errors [N m or N].
        task: the typical task.
        family, x, factor: family of motions, and variables and time factor of the motion.
        repeat: number of periods.

    Returns:
        The prediction, a square root (c, c) of the covariance from torque errors, and the shifts (c, r) of the
        parameters by the geometry's errors.
    """
    exact, columns = inputs.model.exact, inputs.columns.kept
    period = family.period * factor
    motion = dense_motion(family, x, period / PERIOD_SAMPLES * np.arange(PERIOD_SAMPLES), factor)
    band = _band(motion, period)
    rows = 2.0 * band * period * repeat

    regressor = exact.regressor(motion.q, motion.v, motion.a)
    growth = np.ones(regressor.shape[1])
    # rows are weighted by the stated density of the torques' errors, else by the noise of each independent row
    sigmas = inputs.columns.sigmas
    if sigmas is not None and inputs.errors_known:
        wider = _wider(inputs, regressor, band, period * repeat)
        earlier = _information_root(inputs, _reweighted(regressor[:, :, columns] / sigmas[:, None], wider))
        growth = wider * _growth(inputs, regressor)
        sigmas = sigmas * growth
        weight = period * repeat / PERIOD_SAMPLES
    else:
        row_noise = noise[exact.joint_of_row]
        sigmas = row_noise if sigmas is None else np.where(np.isinf(sigmas), np.inf, row_noise)
        weight = rows / PERIOD_SAMPLES
        earlier = np.zeros((0, task.regressors.shape[2]))
    factors = np.sqrt(weight) / sigmas[:, None]
    Y = regressor[:, :, columns] * factors
    Y = Y.reshape(-1, len(task.regressors[0, 0]))
    geometry_torques = _geometry_torques(inputs, motion.q, motion.v, motion.a) * factors
    geometry_torques = geometry_torques.reshape(len(Y), -1)
    root = _root(np.concatenate([Y, earlier]))
    information_shifts = earlier.T @ (earlier @ _shifts_before(inputs)) - Y.T @ geometry_torques
    shifts = root @ (root.T @ information_shifts)
    torque_sigma, share = _torque_sigma(inputs, task, root, shifts)
    prediction = MotionPrediction(period * repeat, rows, torque_sigma, share, float(growth.max()))
    return prediction, root, shifts


def _growth(inputs: ExcitationInputs, regressor: np.ndarray) -> np.ndarray:
    """Return the factor (rows,) of the torque errors' σ on a motion with this regressor (N, rows, b); 1: not known."""
    values = inputs.model.values
    if inputs.prior is None or inputs.prior.growth is None or values is None:
        return np.ones(regressor.shape[1])
    torques = regressor @ values
    return np.sqrt(inputs.prior.growth.factor(torques.var(axis=0)))


def _wider(inputs: ExcitationInputs, regressor: np.ndarray, band: float, seconds: float) -> np.ndarray:
    """Return the factor (rows,) of all torque errors' σ if a further motion is identified with them; 1: not known.

    Args:
        inputs: the earlier motions.
        regressor: (N, rows, b) regressor of the motion.
        band: identification band of the motion [Hz].
        seconds: duration of the motion [s].
    """
    if inputs.prior is None or inputs.prior.bands is None:
        return np.ones(regressor.shape[1])
    bands = inputs.prior.bands
    # motions that were not identified add errors, too; identified ones of unknown duration (0) count as none, which
    # gives the largest σ
    added = inputs.prior.seconds + seconds
    share = added / (bands.seconds + added)
    return np.sqrt(bands.factor(rows_per_second(band, seconds)) * (1.0 + (ADDED_ERRORS - 1.0) * share))


def _reweighted(whitened: np.ndarray, growth: np.ndarray) -> np.ndarray:
    """Return the factor (c,) of the earlier recordings' rows in a wider band.

    The rows of each parameter are taken to share its information as in the new motion.

    Args:
        whitened: (N, rows, c) regressor of the new motion over the σ of the earlier errors.
        growth: (rows,) factor of σ.
    """
    squares = np.sum(whitened**2, axis=0)
    total = squares.sum(axis=0)
    responds = total > 0.0
    shares = growth**-2.0 @ squares / np.where(responds, total, 1.0)
    # what the new motion does not move was seen by rows that are not known: by those that lose most
    return np.sqrt(np.where(responds, shares, np.min(growth**-2.0)))


def _band(motion: SampledMotion, period: float) -> float:
    """Return the identification band [Hz]: twice the bandwidth f_dyn of a motion (`calib.data.signals.bandwidth`).

    Args:
        motion: the motion, sampled evenly over one period.
        period: the period [s].
    """
    power = np.abs(np.fft.rfft(motion.a, axis=0)) ** 2
    total = np.cumsum(power, axis=0)
    lines = np.argmax(total >= SHARE * total[-1], axis=0)[total[-1] > 0]
    return 2.0 * max(LOWEST, float(lines.max(initial=0)) / period)


def _shortened(
    problem: ExcitationProblem,
    motion: SearchResult,
    problem_of: Callable[[float], ExcitationProblem],
    period: float,
    evaluations: int,
) -> tuple[Family, SearchResult] | None:
    """Return family and solution of a motion with a shorter period; None if no such motion is possible.

    The search starts from the path of the given motion, scaled in amplitude by the ratio of the periods.

    Args:
        problem: optimisation problem of the designed motion.
        motion: the designed motion.
        problem_of: function that returns the optimisation problem for a period [s].
        period: the shorter period [s].
        evaluations: largest number of evaluations of the search.
    """
    try:
        shorter = replace(problem_of(period), stretch=(1.0, 1.0))
    except ValueError:  # as many harmonics of a short period are beyond the resonance, or it is no whole sample
        return None
    basis = shorter.basis()
    designed_period = problem.family.period * motion.factor
    path = problem.family.basis(basis.times * problem.family.period / period).motion(motion.x).q
    middle = path.mean(axis=0)
    start = basis.nearest(middle + period / designed_period * (path - middle))
    result = one_start(shorter, evaluations, "slsqp", 0, start, STAGES[1:3])
    if isinstance(result, SearchResult):
        return shorter.family, result
    return None


def write(rows: Sequence[PredictedSigma], folder: Path) -> Path:
    """Write the predicted σ of the parameters as CSV and return the file's path.

    Value and rsd [%] are empty for parameters with unknown values.

    Args:
        rows: the predicted parameters.
        folder: folder of the designed motion.
    """
    header = list(PredictedSigma._fields)
    header[header.index("rsd")] = "rsd [%]"
    return files.write_table(folder / NAME, header, rows)


def lines(outlook: MotionOutlook, predicted: Sequence[PredictedSigma] = ()) -> list[str]:
    """Return lines of text on the predicted σ of torques, for the designed motion and for motions of other durations.

    If the motion complements an identification, a line names the three parameters whose σ decreases most.

    Args:
        outlook: prediction for the designed motion and other durations.
        predicted: predicted σ of the parameters; empty: no line on parameters.
    """
    by_period = ""
    if outlook.by_period:
        parts = [f"{100 * motion.torque_sigma_share:.2g} % from {motion.seconds:g} s" for motion in outlook.by_period]
        by_period = f" ({', '.join(parts)})"
    head = "predicted σ of torques, typical task: "
    designed = f"{100 * outlook.own.torque_sigma_share:.2g} % of the limits from {outlook.own.seconds:g} s"
    if outlook.before is None:
        noise = f"{100 * outlook.noise_share:.2g} %"
        return [f"{head}{designed}{by_period}, if the torque residual is {noise}"]
    rows = [row for row in predicted if row.sigma_before]
    rows.sort(key=lambda row: row.sigma / (row.sigma_before or np.inf))
    gains = [f"{row.name} from ± {row.sigma_before:.3g} to ± {row.sigma:.3g} {row.unit}" for row in rows[:NAMED_GAINS]]
    assumed = f"; torque errors assumed up to {outlook.own.error_growth:.2g} times those so far"
    assumed += f"; {outlook.reliability}"
    return [
        f"{head}{100 * outlook.before:.2g} % so far, with this motion {designed}{by_period}{assumed}",
        "most improved: " + "; ".join(gains),
    ]


def check_folder(folder: Path) -> None:
    """Raise a UsageError if a folder contains no prediction that `calib excite` wrote."""
    require((folder / NAME).is_file(), f"{folder} has no {NAME}: give the folder that calib excite wrote", UsageError)


@dataclass(frozen=True)
class _Predicted:
    prediction: MotionOutlook


def compared_with_identification(folder: Path, outcome: IdentificationOutcome) -> str:
    """Return a line of text that compares predicted and identified σ of the parameters.

    Args:
        folder: folder that `calib excite` wrote.
        outcome: the identification.

    Raises:
        UsageError: if the folder contains no prediction, or a prediction for other parameters.
    """
    check_folder(folder)
    outlook = read_json(folder / METRICS, WRITTEN_BY_EXCITE, _Predicted).prediction
    with refused_as(UsageError, ValueError, f"{{}}; {WRITTEN_BY_EXCITE}"):
        predicted = {row.name: row.sigma for row in read_rows(PredictedSigma, folder / NAME)}
    limits = np.array([joint.effort for joint in outcome.inputs.chain.joints])
    # the motors' rows come last
    rms = next(iter(outcome.fit.values())).filtered.rms[-len(limits) :]
    residual = None
    # after an identification the errors were known, not assumed
    if outlook.before is None and len(rms) == len(limits) and np.isfinite(rms / limits).all():
        residual = float(np.sqrt(np.mean((rms / limits) ** 2)))
    estimate = outcome.found.fitted.estimate if outcome.carried is None else outcome.carried
    identified = dict(zip(outcome.found.names, estimate.sigma.tolist()))
    ratio = sigma_ratio(predicted, identified, residual=residual, assumed=outlook.noise_share)
    if ratio is None:
        raise UsageError(
            f"{folder} contains none of the {len(identified)} identified parameters, so it belongs to another robot: "
            "give the excitation of this one"
        )
    return sentence(ratio)
