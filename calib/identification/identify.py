"""From cases to an identified model: base parameters, friction that pays, an estimate with covariance, a prediction."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calib.data.signals.decimation import Decimator, design_decimator
from calib.data.signals.persistency import report_excitation
from calib.dynamics import base as bases
from calib.dynamics.base import Base
from calib.dynamics.drives import DriveTerm
from calib.dynamics.idim import IdentificationModel, with_terms
from calib.errors import MeasurementError, UsageError
from calib.estimation import instrumental_variables
from calib.estimation.essential import Elimination, Rule, eliminate
from calib.estimation.linear import LinearFit, ridge
from calib.estimation.triangles import Triangles, combine, condition_numbers, retriangulate
from calib.identification.cases import Case
from calib.identification.friction.friction_ladder import (
    FrictionCandidates,
    FrictionSelection,
    select_friction,
)
from calib.identification.friction.ripple import Ripple, find_all
from calib.identification.friction.time_folds import estimate
from calib.identification.loop.bias import LoopTest, require_loop, try_loop
from calib.identification.methods.least_squares import MethodEstimate, fit_rows, residual_inflation, scaled
from calib.identification.prediction import Dynamics, predict, transmitted
from calib.identification.prior import Prior, bounded, find_prior
from calib.identification.rows import ObservationRows, extend, observe, observe_terms, pool, triangulate, with_blocks
from calib.identification.settings import IdentificationSettings, make_model, per_joint
from calib.robot.calibrated import CalibratedChain, as_calibrated
from calib.robot.chain import Chain, sampling_limits

CONDITION = 150.0  # of the observation matrix, unit columns, from which on the prior is used

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Identification:
    """What was identified.

    Attributes:
        dynamics: the model with numbers.
        base: which columns were kept of the standard model, and what they stand for.
        fitted: the estimate of base parameters and friction.
        elimination: the way to the essential ones; None where not asked for.
        friction: which richer friction the unseen time rewarded.
        settings: how.
        rows: what was learnt from.
        condition: of the observation matrix of the base parameters, in its units and with columns of unit norm.
        prior: what was known of the base parameters beforehand, where it was used.
        ripples: gear ripple found above the identification band, by joint; not part of the estimate's covariance.
        bias: what the simulated closed loop says of least squares, where a loop is stated.
    """

    dynamics: Dynamics
    base: Base
    fitted: MethodEstimate
    elimination: Elimination | None
    friction: FrictionSelection
    settings: IdentificationSettings
    rows: tuple[ObservationRows, ...]
    condition: tuple[float, float]
    prior: Prior | None = None
    ripples: tuple[Ripple, ...] = ()
    bias: LoopTest = field(default_factory=LoopTest)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the estimate's parameters: base ones, then richer friction."""
        return (*self.base.names, *(one.name for one in self.friction.terms))

    @property
    def terms(self) -> tuple[DriveTerm | None, ...]:
        """The drive term behind each of the estimate's parameters; None for those of bodies."""
        model = self.dynamics.model
        own = (None if k < model.inertial else model.columns[k - model.inertial] for k in self.base.kept)
        return (*own, *self.friction.terms)


def identify(
    robot: Chain | CalibratedChain,
    cases: Sequence[Case],
    settings: IdentificationSettings | None = None,
    progress: Progress | None = None,
) -> Identification:
    """Identify the dynamics of a robot from recordings, on its calibrated geometry.

    Args:
        robot: as a geometric fit returns it, or a chain that no fit has moved. Base columns are chosen on its nominal
            geometry; joint corrections take no part.
        cases: recordings to learn from.
        progress: called with a few words at each stage.
    """
    settings, say = settings or IdentificationSettings(), progress or (lambda words: None)
    robot = as_calibrated(robot)
    chain, nominal = robot.chain, robot.nominal if robot.moved else None
    if not cases:
        raise UsageError("no recording to identify from")
    settings = require_loop(settings) if settings.method == "iv" else settings
    model = make_model(chain, settings)
    _require_motion(cases)
    noise = repeats_noise(cases, settings)
    say("base parameters")
    base = find_base(chain, model, settings, nominal, cases)
    decimator = common_decimator(cases, settings)
    say("observation matrix")
    rows = with_blocks([observe(model, base.kept, case, decimator) for case in cases], settings.folds)
    _require_enough(rows, base)
    say("first fit")
    std, tau, values = first_fit(rows, noise)
    first = Dynamics(model, bases.to_standard(base, values))
    friction = "standard" if settings.friction == "auto" and _all_poor(cases) else settings.friction
    loaded = settings.torque_rows.motors_alone and friction not in ("standard", "ripple")
    loads = [transmitted(first, case) if loaded else None for case in cases]
    prior = _prior(chain, model, base, rows, cases, std, tau, settings)
    known = None if prior is None else prior.rows
    n = chain.n
    ground = FrictionCandidates(
        cases, rows, loads, decimator, std, tau, np.array(per_joint(settings.v0, n, "v0")),
        np.array([joint.kind == "prismatic" for joint in chain.joints]), known,
    )  # fmt: skip
    climbed = (
        select_friction(ground, friction, progress)
        if settings.torque_rows.motors_alone
        else FrictionSelection((), (), ())
    )
    say("estimate")
    full = [
        extend(part, climbed.terms, observe_terms(climbed.terms, case, decimator, load))
        for part, case, load in zip(rows, cases, loads)
    ]
    plain = replace(settings, method="wls") if settings.method == "iv" else settings
    fitted, condition = _estimate(full, model, base, climbed, plain, prior, noise)
    if settings.loop is not None:
        say("simulating the closed loop")
    bias = try_loop(chain, model, base, cases, decimator, settings)
    if settings.method == "iv" and bias.found is not None:
        fitted = replace(fitted, fit=bias.found.fit, std=bias.found.std, method="iv")
    richer = with_terms(model, *climbed.terms)
    values = fitted.estimate.values
    standard = np.concatenate([bases.to_standard(base, values[: base.b]), values[base.b :]])
    ripples: list[Ripple] = []
    if settings.torque_rows.motors_alone and friction in ("auto", "ripple"):
        say("ripple")
        so_far = Dynamics(richer, standard)
        ripples = find_all(cases, [case.target - predict(so_far, case) for case in cases])
        richer = with_terms(richer, *(one for ripple in ripples for one in ripple.terms))
        standard = np.concatenate([standard, *(ripple.values for ripple in ripples)])
    standard = _with_payloads(standard, richer, cases, settings)
    say("essential parameters")
    gone = _essential(fitted, settings, prior, bias)
    return Identification(
        Dynamics(richer, standard), base, fitted, gone, climbed, settings, tuple(full), condition, prior,
        tuple(ripples), bias,
    )  # fmt: skip


def _with_payloads(
    standard: np.ndarray, model: IdentificationModel, cases: Sequence[Case], settings: IdentificationSettings
) -> np.ndarray:
    """Return the standard parameters with those of payloads that no case carries, where they are known."""
    result = np.array(standard)
    for label, known in settings.payload_values.items():
        if not any(label in case.carried for case in cases):
            first = 10 * model.bodies.labels.index(label)
            result[first : first + 10] = known
    return result


def find_base(
    chain: Chain,
    model: IdentificationModel,
    settings: IdentificationSettings,
    nominal: Chain | None,
    cases: Sequence[Case],
) -> Base:
    """Return base columns chosen on the nominal chain and regrouped on the calibrated one."""
    loads = tuple(dict.fromkeys(tuple(sorted(case.carried)) for case in cases))
    original = model if nominal is None else make_model(nominal, settings)
    lower, upper = sampling_limits(chain)
    samples = bases.random_samples(original, seed=settings.seed, lower=lower, upper=upper)
    found = bases.find(original, samples, loads)
    return found if nominal is None else bases.regroup(found, model, samples, loads)


def common_decimator(cases: Sequence[Case], settings: IdentificationSettings) -> Decimator:
    """Return the filter of all rows: the widest of the cases' bands; where that makes too many rows, of every second,
    third, ... one alone.

    Too many are more than ``settings.samples``. The band stays: long recordings have rows to spare, but what they show
    of fast motion no other row tells.
    """
    rates = [case.motion.rate for case in cases]
    if max(rates) > 1.02 * min(rates):
        slowest, fastest = min(rates), max(rates)
        raise MeasurementError(
            f"recordings of {slowest:.4g} Hz and {fastest:.4g} Hz do not go together; resample one of them"
        )
    total = sum(len(case.motion) for case in cases)
    widest = design_decimator(rates[0], min(case.motion.decimator.factor for case in cases))
    one_in = -(-total // (widest.factor * settings.samples))  # what the memory asks for
    return replace(widest, factor=one_in * widest.factor)


def repeats_noise(cases: Sequence[Case], settings: IdentificationSettings) -> np.ndarray | None:
    """Return the noise (rows,) that repeats of the motion told, its mean square over cases by length; None: not asked.

    Raises:
        UsageError: for another method than WLS, or rows with torques that no variance is read for.
        MeasurementError: for a recording without variances, or with a joint of none.
    """
    if settings.weights == "residuals":
        return None
    if settings.method != "wls" or not settings.torque_rows.motors_alone:
        raise UsageError(
            f'weights = "repeats" goes with method wls and rows motor, found {settings.method} and '
            f"{settings.torque_rows.name}"
        )
    for case in cases:
        if case.noise is None:
            raise MeasurementError(
                'has no variances of its torques (variance_tau and periods), which weights = "repeats" needs: average '
                'repeats with calib recall DIR LOG --out avg.npz, or take weights = "residuals"',
                case.motion.file,
            )
        if not (case.noise > 0).all():
            silent = case.motion.joint_names[int(np.argmin(case.noise))]
            raise MeasurementError(
                f'joint {silent} has no variance over the periods: it cannot be weighed; take weights = "residuals"',
                case.motion.file,
            )
    squares = np.array([case.noise**2 for case in cases if case.noise is not None])
    return np.asarray(np.sqrt(np.average(squares, axis=0, weights=[len(case.motion) for case in cases])))


def first_fit(
    rows: Sequence[ObservationRows], noise: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return standard deviation and inflation of the residuals (rows,), and values (b,) of a fit that always exists."""
    count = rows[0].target.shape[1]
    data = pool(triangulate(rows), count)
    std, tau = np.ones(count), np.ones(count)
    values = np.zeros(data.parameters)
    for _ in range(4):
        values, _ = estimate(data, std, tau, np.full(data.parameters, -1))
        residuals = np.concatenate([np.where(part.present, part.target - part.matrix @ values, 0.0) for part in rows])
        used = np.concatenate([part.present for part in rows]).sum(axis=0)
        std = np.sqrt((residuals**2).sum(axis=0) / np.maximum(used, 1))
        std = scaled(noise, np.maximum(std, 1e-9 * max(float(std.max()), 1e-300)), used)
    return std, residual_inflation(rows, values), values


def _prior(
    chain: Chain, model: IdentificationModel, base: Base, rows: Sequence[ObservationRows], cases: Sequence[Case],
    std: np.ndarray, tau: np.ndarray, settings: IdentificationSettings,
) -> Prior | None:  # fmt: skip
    """Return the prior, where it is asked for or the motion is too poor to do without."""
    if settings.prior == "none" or settings.method != "wls" or not settings.torque_rows.has_bodies:
        return None
    data = pool(triangulate(rows), rows[0].target.shape[1])
    normalised = condition_numbers(data.factors.reshape(-1, data.parameters + 1)[:, :-1])[1]
    if settings.prior == "auto" and not _all_poor(cases) and normalised < CONDITION:
        return None
    return find_prior(chain, model, base, data, std, tau, settings.prior)


def _estimate(
    rows: Sequence[ObservationRows],
    model: IdentificationModel,
    base: Base,
    climbed: FrictionSelection,
    settings: IdentificationSettings,
    prior: Prior | None,
    noise: np.ndarray | None,
) -> tuple[MethodEstimate, tuple[float, float]]:
    """Return the final fit; richer friction keeps the ridge that the evidence chose."""
    data = triangulate(rows)
    fitted = fit_rows(rows, data, settings.method, prior is None, noise)
    more = len(climbed.terms)
    own = data.parameters - more
    condition = condition_numbers(fitted.pooled.factors.reshape(-1, data.parameters + 1)[:, :own])
    if settings.method != "wls" or (not climbed.terms and prior is None):
        return fitted, condition
    group = np.concatenate([np.full(own, -1), climbed.groups]).astype(int)
    known = None if prior is None else np.hstack([prior.rows[:, :-1], np.zeros((own, more)), prior.rows[:, -1:]])
    _, ridges = estimate(fitted.pooled, fitted.std, fitted.inflation, group, known)
    covariance = np.diag(np.where(group < 0, np.inf, np.maximum(ridges, 1e-12) ** 2))
    mean = np.zeros(len(ridges))
    if prior is not None:
        covariance[:own, :own], mean[:own] = prior.covariance, prior.mean
    std = fitted.std * np.sqrt(fitted.inflation)
    drawn: LinearFit = ridge(fitted.pooled, mean, covariance, std)
    if prior is not None:
        drives = np.array([one.nonnegative for one in model.columns], dtype=bool)
        every = np.concatenate([np.zeros(model.inertial, dtype=bool), drives])
        nonnegative = np.concatenate([every[base.kept], [one.nonnegative for one in climbed.terms]]).astype(bool)
        drawn = _bounded(drawn, fitted.pooled, std, mean, covariance, nonnegative)
    return replace(fitted, fit=drawn), condition


def _all_poor(cases: Sequence[Case]) -> bool:
    """Say whether no case can tell parameters apart: then blocks of time repeat each other, and judge nothing."""
    return all(report_excitation(case.motion).poor for case in cases)


def _bounded(
    drawn: LinearFit, data: Triangles, std: np.ndarray, mean: np.ndarray, covariance: np.ndarray,
    nonnegative: np.ndarray,
) -> LinearFit:  # fmt: skip
    """Return the fit with drive parameters that are not negative; the covariance is that without the bounds."""
    known = np.isfinite(np.diag(covariance))
    unit = np.sqrt(np.diag(covariance)[known])
    lower = np.linalg.cholesky(covariance[np.ix_(known, known)] / np.outer(unit, unit) + 1e-9 * np.eye(len(unit)))
    rows = np.zeros((len(unit), data.parameters + 1))
    rows[:, np.flatnonzero(known)] = np.linalg.solve(lower, np.diag(1.0 / unit))
    rows[:, -1] = rows[:, :-1] @ mean
    values = bounded(retriangulate(np.vstack([combine(data, std), rows])), nonnegative)
    return replace(drawn, estimate=replace(drawn.estimate, values=values))


def _essential(
    fitted: MethodEstimate, settings: IdentificationSettings, prior: Prior | None, bias: LoopTest
) -> Elimination | None:
    """Return the elimination; none where the data alone do not determine the base parameters."""
    if settings.essential == "none" or prior is not None:
        return None
    data, std, inflation = fitted.pooled, fitted.std, fitted.inflation
    if fitted.method == "iv" and bias.found is not None:
        data = instrumental_variables.testable(bias.found.problem, bias.found.fit, bias.found.std)
        std, inflation = np.ones(1), np.array([bias.found.inflation])
    return eliminate(
        data, Rule(settings.essential), ratio=settings.ratio, level=settings.level,
        keep=[bases.standard_name(name, data.names) for name in settings.keep],
        drop=[bases.standard_name(name, data.names) for name in settings.drop],
        std=std, inflation=inflation,
    )  # fmt: skip


def _require_motion(cases: Sequence[Case]) -> None:
    """Refuse cases to learn from in which the robot stands (our choice: less than a milliradian or millimetre)."""
    if all((np.ptp(case.motion.q, axis=0) < 1e-3).all() for case in cases):
        raise MeasurementError(
            "no joint moves: that tells of gravity in one pose, and nothing else", cases[0].motion.file
        )


def _require_enough(rows: Sequence[ObservationRows], base: Base) -> None:
    count = sum(int(part.present.sum()) for part in rows)
    if count < 2 * base.b:
        raise MeasurementError(
            f"{count} rows are left for {base.b} base parameters after filtering and thinning: record longer, or raise "
            "the identification band ([filter] band)"
        )
