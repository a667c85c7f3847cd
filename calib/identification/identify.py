"""Identification of a model from cases: base parameters, selected friction, estimate with covariance, prediction."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Generic, TypeGuard, cast

import numpy as np

from calib.data.signals.filtering import Decimator, design_decimator
from calib.dynamics import base as bases
from calib.dynamics.base import Base
from calib.dynamics.bodies import standard_parameters
from calib.dynamics.drives import DriveTerm
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.regressor_model import RegressorModel, States
from calib.dynamics.torque_rows import POWER
from calib.errors import MeasurementError, UsageError, refuse_data, require
from calib.estimation.essential import Elimination, Rule, eliminate
from calib.estimation.triangles import condition_numbers
from calib.extensions import needed
from calib.identification.friction.friction_ladder import FrictionCandidates, FrictionSelection, select_friction
from calib.identification.friction.ripple import Ripple, find_all
from calib.identification.loop import LoopResults, per_joint
from calib.identification.methods.least_squares import LeastSquares
from calib.identification.methods.method import IdentificationProblem, Method, MethodEstimate
from calib.identification.methods.registry import METHODS, method_named
from calib.identification.prediction import Dynamics, Model, predict
from calib.identification.prior import TEMPERING, FirstFit, Prior, find_prior, first_fit, rods, tempered_prior
from calib.identification.rows import Case, ObservationRows, observe, observe_terms, pool, triangulate, with_blocks
from calib.identification.settings import IdentificationSettings, make_model, require_usable
from calib.identification.standstill import (
    CLEARLY_LESS,
    LESS,
    left_out_error,
    with_slowness,
    with_standstills,
    with_weights,
)
from calib.identification.time_folds import estimate, regimes
from calib.robot.calibrated import CalibratedChain, as_calibrated
from calib.robot.chain import Chain

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Identification(Generic[Model]):
    """Result of an identification.

    Attributes:
        dynamics: the model with its parameter values.
        base: base columns selected from the standard model, and their regrouping.
        fitted: the estimate of base parameters and friction.
        elimination: the steps to the essential parameters; None if not requested.
        friction: richer friction selected on held-out time.
        settings: settings of the identification.
        rows: the training data.
        terms: the drive term of each estimated parameter; None for parameters of bodies.
        condition: of the base parameters' observation matrix, as it is and with columns of unit norm.
        prior: prior of the base parameters; None if unused.
        ripples: gear ripple above the identification band, by joint; not part of the estimate's covariance.
        loop: results of simulating the recordings' closed loop, where one is stated.
    """

    dynamics: Dynamics[Model]
    base: Base
    fitted: MethodEstimate
    elimination: Elimination | None
    friction: FrictionSelection
    settings: IdentificationSettings
    rows: tuple[ObservationRows, ...]
    terms: tuple[DriveTerm | None, ...]
    condition: tuple[float, float]
    prior: Prior | None = None
    ripples: tuple[Ripple, ...] = ()
    loop: LoopResults = field(default_factory=LoopResults)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the estimate's parameters: base parameters, then richer friction."""
        return (*self.base.names, *(one.name for one in self.friction.terms))


def identify(
    robot: Chain | CalibratedChain,
    cases: Sequence[Case],
    settings: IdentificationSettings | None = None,
    progress: Progress | None = None,
) -> Identification:
    """Return the dynamics of a robot identified from recordings, on its calibrated geometry.

    Args:
        robot: as a geometric fit returns it, or a chain that no fit has moved. Base columns are chosen on its nominal
            geometry; joint corrections take part where the cases have the links' motion.
        cases: training recordings.
        settings: the choices; None: those that suit a serial arm with motor torques.
        progress: called with a few words at each stage.
    """
    settings, robot = settings or IdentificationSettings(), as_calibrated(robot)
    chain = robot.chain if any(case.link is None for case in cases) else robot.complete
    model = make_model(chain, settings)
    nominal = None if robot.nominal is None or not robot.moved else make_model(robot.nominal, settings)
    states = chain_states(chain, nominal or model, settings.seed)
    found = identify_model(
        model,
        cases,
        settings,
        nominal=nominal,
        states=states,
        cad=_known_masses(chain),
        shape=np.where(model.bodies.coordinates[:, None] >= 0, rods(chain, model), 0.0).ravel(),
        effort=_torque_limits(chain),
        progress=progress,
    )
    return cast(Identification, found)  # its model is the chain's


def identify_model(
    model: RegressorModel,
    cases: Sequence[Case],
    settings: IdentificationSettings | None = None,
    *,
    nominal: RegressorModel | None = None,
    states: States | None = None,
    cad: np.ndarray | None = None,
    shape: np.ndarray | None = None,
    effort: np.ndarray | None = None,
    progress: Progress | None = None,
) -> Identification[RegressorModel]:
    """Return the identification of a model, linear in its parameters, from recordings.

    Base columns, what is known beforehand, richer friction, the method's estimate, ripple, essential parameters: a
    sequence of steps around one method, each of which says what it accepts.

    Args:
        model: of a serial chain, or of anything else that meets the protocol.
        cases: training recordings, their targets those of the model's torque rows.
        settings: the choices; what makes a chain's model of them (drives, payloads, gravity) is in `model` already.
        nominal: the same model on the geometry that base columns are chosen on; None: `model`.
        states: to choose base columns over; None: the model's own.
        cad: the first of the model's parameters by the robot's description; None where it holds no masses.
        shape: the same of a robot of one kilogram, where it holds none; None: not known either.
        effort: (n,) torque limits of the joints, up to a factor; None: not known.
        progress: called with a few words at each stage.

    Raises:
        CalibError: the method's failure, where there is no estimate.
    """
    settings, say = settings or IdentificationSettings(), progress or (lambda words: None)
    require(cases, "no recording to identify the model from", UsageError)
    method = method_named(settings.method)
    settings = require_usable(settings, method)
    _require_constrainable(method, settings)
    _require_motion(cases)
    noise = _repeats_noise(cases, settings)
    say("base parameters")
    states = bases.random_samples(model, seed=settings.seed) if states is None else states
    base = find_base(model, cases, states, nominal)
    decimator = common_decimator(cases, settings)
    say("observation matrix")
    rows = with_blocks([observe(model, base.kept, case, decimator) for case in cases], settings.folds)
    if model.torque_rows == POWER and len(cases) > 1:
        rows = [part.by_recording(k, len(cases)) for k, part in enumerate(rows)]
    rows_as_moving = rows
    holds_standstills = isinstance(method, LeastSquares) and isinstance(model, IdentificationModel)
    if holds_standstills:
        width = np.array(per_joint(settings.v0, cases[0].motion.n, "v0"))
        rows = with_standstills(rows, cases, decimator, model, base.kept, width)
    _require_enough(rows, base)
    say("first fit")
    whole, source = (shape, "sizes") if cad is None else (cad, "cad")
    found = partial(find_prior, model, base, whole=whole, source=source, noise=noise, effort=effort)
    takes_prior = _takes_prior(method, model, settings, source)
    prior = found(rows) if takes_prior else None
    first = first_fit(rows, noise) if prior is None else prior.first
    rows = with_weights(rows, first.rest)
    if any(part.standing.any() for part in rows):
        prior_as_moving = found(rows_as_moving) if takes_prior else None
        first_as_moving = first_fit(rows_as_moving, noise) if prior_as_moving is None else prior_as_moving.first
        known = None if prior is None else prior.rows
        known_as_moving = None if prior_as_moving is None else prior_as_moving.rows
        error = left_out_error(rows, rows, first.std, first.inflation, known, settings.apart)
        error_as_moving = left_out_error(
            rows_as_moving, rows, first_as_moving.std, first_as_moving.inflation, known_as_moving, settings.apart
        )
        if error_as_moving < CLEARLY_LESS**2 * error:
            rows, prior, first = rows_as_moving, prior_as_moving, first_as_moving
            holds_standstills = False
    if prior is not None:
        prior = tempered_prior(found, prior, rows, regimes(rows, cases, decimator))
        first = prior.first
    rows = with_weights(rows, first.rest)
    friction, loads = _richer_friction(model, base, rows, cases, decimator, first, prior, settings, progress)
    own = [None if k < model.inertial else model.columns[k - model.inertial] for k in base.kept]
    full = tuple(
        part.extend(friction.terms, observe_terms(friction.terms, case, decimator, load, model.torque_rows))
        for part, case, load in zip(rows, cases, loads)
    )
    groups = np.array(friction.groups, dtype=int)
    if prior is not None and holds_standstills:
        # richer friction explains slow motion, too: what it leaves there counts
        data = pool(triangulate(full), full[0].target.shape[1])
        inflation = prior.tempering * first.inflation
        every_group = np.concatenate([np.full(base.b, -1), groups])
        known = prior.widened(len(groups))
        values, _ = estimate(data, first.std, inflation, every_group, known)
        weighed = with_slowness(full, cases, decimator, model.torque_rows, values)
        error = left_out_error(full, full, first.std, inflation, known, settings.apart)
        error_weighed = left_out_error(weighed, full, first.std, inflation, known, settings.apart)
        if error_weighed < LESS**2 * error:
            full = tuple(weighed)
    if prior is not None and (friction.terms or any((part.slowness < 1.0).any() for part in full)):
        say("sizes beside richer friction")
        prior = found(full, groups=groups, start=prior, tempering=prior.tempering)
        full = tuple(with_weights(full, prior.first.rest))
    problem = IdentificationProblem(
        model,
        base,
        cases,
        decimator,
        full,
        (*own, *friction.terms),
        np.concatenate([np.full(base.b, -1), friction.groups]),
        noise,
        prior,
        settings.loop,
        cad,
        settings.constraints,
    )
    return _identified(problem, method, friction, settings, say)


def _identified(
    problem: IdentificationProblem,
    method: Method,
    friction: FrictionSelection,
    settings: IdentificationSettings,
    say: Progress,
) -> Identification[RegressorModel]:
    """Return the identification of a problem by a method: estimate, test of its loop, ripple, essential parameters."""
    model, base, cases = problem.model, problem.base, problem.cases
    say("simulating the closed loop" if method.needs_controller else "estimate")
    found = method.estimate(problem)
    values = found.estimate.values
    friction = friction.fitted(found.estimate.sigma[base.b :])
    if settings.loop is not None and not method.needs_controller:
        say("simulating the closed loop")
    loop = LoopResults() if settings.loop is None else needed("loop_results")(problem, found)
    richer = model.with_terms(*friction.terms) if _sees_drives(model) else model
    dynamics = Dynamics(richer, np.concatenate([base.to_standard(values[: base.b]), values[base.b :]]))
    dynamics, ripples = _with_ripple(dynamics, cases, settings, say)
    dynamics = _with_payloads(dynamics, cases, settings)
    say("essential parameters")
    gone = _essential(found, settings)
    condition = condition_numbers(problem.pooled.factors.reshape(-1, len(values) + 1)[:, : base.b])
    rows, terms, prior = problem.rows, problem.terms, problem.prior
    return Identification(dynamics, base, found, gone, friction, settings, rows, terms, condition, prior, ripples, loop)


def chain_states(chain: Chain, model: RegressorModel, seed: int = 0) -> States:
    """Return random states of a chain's model within the chain's limits."""
    lower, upper = chain.sampling_limits()
    return bases.random_samples(model, seed=seed, lower=lower, upper=upper)


def find_base(
    model: RegressorModel, cases: Sequence[Case], states: States, nominal: RegressorModel | None = None
) -> Base:
    """Return the base columns of a model, selected over states and payloads on the nominal geometry if one is given."""
    loads = tuple(dict.fromkeys(tuple(sorted(case.carried)) for case in cases))
    return bases.find(model, states, loads, nominal=nominal)


def _known_masses(chain: Chain) -> np.ndarray | None:
    """Return the standard parameters (10 B,) from a chain's description; None where it states no masses."""
    known = chain.inertias is not None and np.any(chain.inertias[:, 9] > 0.0)
    return standard_parameters(chain) if known else None


def _torque_limits(chain: Chain) -> np.ndarray | None:
    """Return the joints' torque limits (n,) from the robot's description; None if any limit is missing."""
    limits = np.array([joint.effort for joint in chain.joints])
    return limits if (np.isfinite(limits) & (limits > 0.0)).all() else None


def _sees_drives(model: RegressorModel) -> TypeGuard[IdentificationModel]:
    """Return whether a model accepts richer friction, which acts on the motors of single joints."""
    return isinstance(model, IdentificationModel) and model.torque_rows.with_motors


def _richer_friction(
    model: RegressorModel,
    base: Base,
    rows: Sequence[ObservationRows],
    cases: Sequence[Case],
    decimator: Decimator,
    first: FirstFit,
    prior: Prior | None,
    settings: IdentificationSettings,
    progress: Progress | None,
) -> tuple[FrictionSelection, Sequence[np.ndarray | None]]:
    """Return the friction selected on held-out time, and the torques (N, n) that load-dependent terms depend on."""
    nothing: list[np.ndarray | None] = [None] * len(cases)
    if not _sees_drives(model):
        return FrictionSelection((), (), ()), nothing
    std, tau, values, _ = first
    plain = Dynamics(model, base.to_standard(values))
    loads = nothing if settings.friction in ("standard", "ripple") else [plain.transmitted(case) for case in cases]
    candidates = FrictionCandidates(
        cases,
        rows,
        loads,
        decimator,
        std,
        tau if prior is None else tau * prior.tempering / TEMPERING,
        np.array(per_joint(settings.v0, model.n, "v0")),
        model.prismatic,
        prior,
        settings.apart,
        model.torque_rows,
        frozenset(tuple(sorted({row for row, _ in one.acts})) for one in model.columns if len(one.acts) > 1),
    )
    return select_friction(candidates, settings.friction, progress), loads


def _with_ripple(
    dynamics: Dynamics[RegressorModel], cases: Sequence[Case], settings: IdentificationSettings, say: Progress
) -> tuple[Dynamics[RegressorModel], tuple[Ripple, ...]]:
    """Return the model with gear ripple identified from its residuals, if the settings request it."""
    model = dynamics.model
    if not _sees_drives(model) or not model.torque_rows.motors_alone or settings.friction not in ("auto", "ripple"):
        return dynamics, ()
    say("ripple")
    ripples = tuple(find_all(cases, [case.target - predict(dynamics, case) for case in cases]))
    richer = model.with_terms(*(one for ripple in ripples for one in ripple.terms))
    return Dynamics(richer, np.concatenate([dynamics.values, *(ripple.values for ripple in ripples)])), ripples


def _with_payloads(
    dynamics: Dynamics[RegressorModel], cases: Sequence[Case], settings: IdentificationSettings
) -> Dynamics[RegressorModel]:
    """Return the model with the known parameters of payloads that occur in no training recording."""
    model, values = dynamics.model, np.array(dynamics.values)
    for label, stated in settings.payloads.items():
        known = settings.payload_values.get(label, stated.parameters)
        unseen = known is not None and not any(label in case.carried for case in cases)
        if isinstance(model, IdentificationModel) and unseen:
            first = 10 * model.bodies.labels.index(label)
            values[first : first + 10] = known
    return Dynamics(model, values)


def common_decimator(cases: Sequence[Case], settings: IdentificationSettings) -> Decimator:
    """Return the filter of all rows: the widest of the cases' bands; if that gives too many rows, with every second,
    third, ... row.

    Too many are more than ``settings.samples``. The band stays: long recordings have rows to spare, but what they show
    of fast motion no other row identifies.
    """
    rates = [case.motion.rate for case in cases]
    words = f"recordings of {min(rates):.4g} Hz and {max(rates):.4g} Hz cannot be combined; resample one of them"
    require(max(rates) <= 1.02 * min(rates), words, MeasurementError)
    total = sum(len(case.motion) for case in cases)
    widest = design_decimator(rates[0], min(case.motion.decimator.factor for case in cases))
    one_in = -(-total // (widest.factor * settings.samples))  # what the memory asks for
    return replace(widest, factor=one_in * widest.factor)


def _repeats_noise(cases: Sequence[Case], settings: IdentificationSettings) -> np.ndarray | None:
    """Return the torque noise (rows,) estimated from repeats of the motion (rms over the cases); None if not requested.

    Raises:
        UsageError: for another method than WLS, or rows with torques that no variance is read for.
        MeasurementError: for a recording without variances, or with a joint of variance zero.
    """
    if settings.weights == "residuals":
        return None
    if not method_named(settings.method).takes_prior or not settings.torque_rows.motors_alone:
        raise UsageError(
            f'weights = "repeats" needs method wls and rows motor; the options state {settings.method} and '
            f"{settings.torque_rows.name}"
        )
    for case in cases:
        if case.noise is None:
            refuse_data(
                case.motion.file,
                'has no variances of its torques (variance_tau and periods), which weights = "repeats" needs: average '
                'repeats with calib recall DIR LOG --out avg.npz, or use weights = "residuals"',
            )
        if not (case.noise > 0).all():
            silent = case.motion.joint_names[int(np.argmin(case.noise))]
            refuse_data(
                case.motion.file,
                f'joint {silent} has no variance over the periods: it cannot be weighted; use weights = "residuals"',
            )
    squares = np.array([case.noise**2 for case in cases if case.noise is not None])
    return np.asarray(np.sqrt(np.average(squares, axis=0, weights=[len(case.motion) for case in cases])))


def _takes_prior(method: Method, model: RegressorModel, settings: IdentificationSettings, source: str) -> bool:
    """Return whether the parameters get a prior: requested, and supported by method and model.

    Raises:
        UsageError: where the CAD prior is requested, but the description states no masses.
    """
    if settings.prior == "cad" and source != "cad":
        raise UsageError("prior = 'cad', but the robot's description states no masses")
    return settings.prior != "none" and method.takes_prior and model.inertial > 0


def _essential(found: MethodEstimate, settings: IdentificationSettings) -> Elimination | None:
    """Return the elimination of parameters, or None if it is not requested."""
    if settings.essential == "none":
        return None
    data, std, inflation = found.testable()
    return eliminate(
        data,
        Rule(settings.essential),
        ratio=settings.ratio,
        level=settings.level,
        keep=[bases.standard_name(name, data.names) for name in settings.keep],
        drop=[bases.standard_name(name, data.names) for name in settings.drop],
        std=std,
        inflation=inflation,
    )


def _require_constrainable(method: Method, settings: IdentificationSettings) -> None:
    """Raise a UsageError for constraints that the method does not support."""
    if settings.constraints is not None and not method.takes_constraints:
        known = [name for name, one in METHODS.items() if one.takes_constraints]
        own = f"pc-{method.name}"
        advice = f"use '{own}'" if own in known else f"methods that do: {', '.join(known)}"
        raise UsageError(f"[constraints]: method '{method.name}' does not support them; {advice}")


def _require_motion(cases: Sequence[Case]) -> None:
    """Raise an error for training cases without motion (our choice: less than a milliradian or millimetre)."""
    if all((np.ptp(case.motion.q, axis=0) < 1e-3).all() for case in cases):
        refuse_data(cases[0].motion.file, "no joint moves: only gravity in one pose is identifiable")


def _require_enough(rows: Sequence[ObservationRows], base: Base) -> None:
    count = sum(int(part.present.sum()) for part in rows)
    words = f"{count} rows remain for {base.b} base parameters after filtering and decimation"
    advice = "record longer, or raise the identification band ([filter] band)"
    require(count >= 2 * base.b, f"{words}: {advice}", MeasurementError)
