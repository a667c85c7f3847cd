"""Identification of a model from recordings: base parameters, selected friction, and estimate with covariance."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Generic, TypeGuard, cast

import numpy as np

from calib.data.signals.filtering import Decimator, design_decimator, kept
from calib.data.signals.repetition import course
from calib.dynamics import base as bases
from calib.dynamics.base import Base
from calib.dynamics.bodies import standard_parameters
from calib.dynamics.drives import DriveTerm
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.regressor_model import RegressorModel, States
from calib.dynamics.torque_rows import POWER, TorqueRows
from calib.errors import MeasurementError, UsageError, refuse_data, require
from calib.estimation.essential import Elimination, Rule, eliminate
from calib.estimation.triangles import condition_numbers
from calib.identification.closed_loop.simulated import loop_results
from calib.identification.earlier import DECISIVE, EarlierChoice, ModelChoice
from calib.identification.friction.friction_ladder import FrictionCandidates, FrictionSelection, select_friction
from calib.identification.friction.ripple import Ripple, find_all
from calib.identification.loop import LoopResults, per_joint
from calib.identification.methods.least_squares import LeastSquares
from calib.identification.methods.method import IdentificationProblem, Method, MethodEstimate
from calib.identification.prediction import Dynamics, Model, predict
from calib.identification.prior import TEMPERING, FirstFit, Prior, find_prior, first_fit, rods, tempered_prior
from calib.identification.registry import METHODS, TAKING_FUNCTIONS, method_named, under_constraints
from calib.identification.rows import Case, ObservationRows, observe, observe_terms, pool, triangulate, with_blocks
from calib.identification.settings import IdentificationSettings, make_model, require_usable
from calib.identification.standstill import (
    BREAKAWAY_ROUNDS,
    CLEARLY_LESS,
    left_out_error,
    with_breakaway,
    with_standstills,
    with_weights,
)
from calib.identification.time_folds import estimate, regimes
from calib.robot.calibrated import CalibratedChain, as_calibrated
from calib.robot.chain import Chain

MIN_MOTION = 1e-3
"""Motion of a joint in a recording that identifies anything [rad or m] (our choice)."""
MAX_RATE_RATIO = 1.02
"""Largest ratio of sampling rates of recordings that are combined."""


Progress = Callable[[str], None]
# rows of all recordings, their prior, and the fit that weighs them
_Fitted = tuple[list[ObservationRows], Prior | None, FirstFit]


@dataclass(frozen=True, eq=False)
class Identification(Generic[Model]):
    """Result of an identification.

    Attributes:
        dynamics: the model with its parameter values.
        base: base columns selected from the standard model, and their regrouping.
        fitted: the estimate of base parameters and additional friction.
        elimination: the elimination to the essential parameters; None if not requested.
        friction: additional friction terms selected on held-out time.
        settings: settings of the identification.
        rows: observation rows of the training data.
        terms: the drive term of each estimated parameter; None for parameters of bodies.
        condition: condition numbers of the base parameters' observation matrix, as it is and with columns of unit norm.
        prior: prior of the base parameters; None if unused.
        ripples: gear ripple above the identification band, by joint; not part of the estimate's covariance.
        loop: results of simulating the recordings' closed loop; empty if none is stated.
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
    def choice(self) -> ModelChoice:
        """Friction terms and prior, for a later identification that carries them on."""
        terms = self.friction.terms
        active = [k for k, term in enumerate(terms) if term.name not in self.friction.off]
        names = tuple(terms[k].name for k in active)
        groups = tuple(self.friction.groups[k] for k in active)
        ridges = np.full(len(terms), np.nan)
        if self.fitted.beforehand is not None:
            ridges = 1.0 / np.linalg.norm(self.fitted.beforehand[:, self.base.b :], axis=0)
        stored_ridges = tuple(ridges[active].tolist())
        if self.prior is None:
            return ModelChoice(names, groups, stored_ridges, {}, TEMPERING)
        return ModelChoice(names, groups, stored_ridges, self.prior.sizes, self.prior.tempering)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the estimated parameters: base parameters, then additional friction."""
        friction_names = [term.name for term in self.friction.terms]
        return (*self.base.names, *friction_names)


def identify(
    robot: Chain | CalibratedChain,
    cases: Sequence[Case],
    settings: IdentificationSettings | None = None,
    progress: Progress | None = None,
) -> Identification:
    """Return the dynamics of a robot identified from recordings, on its calibrated geometry.

    Args:
        robot: the chain of a geometric fit, or a nominal chain. Base columns are chosen on its nominal geometry. Joint
            corrections are used if the cases contain the motion of the links.
        cases: training recordings.
        settings: settings of the identification; None: the defaults, for a serial arm with motor torques.
        progress: function that is called with a short text at each stage; None: not called.

    Raises:
        UsageError, MeasurementError: for settings or recordings that cannot be used.
        CalibError: the method's failure, if there is no estimate.
    """
    settings = settings or IdentificationSettings()
    robot = as_calibrated(robot)
    chain = robot.complete
    if any(case.link is None for case in cases):
        chain = robot.chain
    model = make_model(chain, settings)
    nominal = None
    if robot.nominal is not None and robot.moved:
        nominal = make_model(robot.nominal, settings)
    cad = None
    if chain.inertias is not None and np.any(chain.inertias[:, 9] > 0.0):
        cad = standard_parameters(chain)
    moves = model.bodies.coordinates[:, None] >= 0
    states = chain_states(chain, nominal or model, settings.seed)
    shape = np.where(moves, rods(chain, model), 0.0).ravel()
    effort = _torque_limits(chain)
    identification = identify_model(
        model, cases, settings, nominal=nominal, states=states, cad=cad, shape=shape, effort=effort, progress=progress
    )
    # The model is that of the chain.
    return cast(Identification, identification)


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

    The steps are base columns, prior, additional friction, the method's estimate, ripple, and essential parameters. The
    method states which of them it supports.

    Args:
        model: model of a serial chain, or any other `RegressorModel`.
        cases: training recordings, with the torques of the model's rows as targets.
        settings: settings of the identification, whose drives, payloads and gravity are ignored (`model` has its own);
            None: the defaults.
        nominal: the same model on the geometry on which base columns are chosen; None: `model`.
        states: states at which base columns are compared; None: random states of the model.
        cad: the bodies' parameters from the robot's description; None if it has no masses.
        shape: the bodies' parameters of a robot of this geometry with a mass of 1 kg, used without CAD values; None:
            unknown.
        effort: (n,) torque limits of the joints, up to a factor; None: unknown.
        progress: function that is called with a short text at each stage; None: not called.

    Raises:
        UsageError, MeasurementError: for settings or recordings that cannot be used.
        CalibError: the method's failure, if there is no estimate.
    """
    settings = settings or IdentificationSettings()
    say = progress or (lambda message: None)
    require(cases, "no recording to identify the model from: give at least one", UsageError)
    method = method_named(settings.method)
    settings = require_usable(settings, method)
    method, constraints = under_constraints(method, settings.constraints)
    settings = replace(settings, constraints=constraints)
    _require_constrainable(method, settings)
    _require_motion(cases)
    noise = _repeats_noise(cases, settings)

    say("base parameters")
    if states is None:
        states = bases.random_samples(model, seed=settings.seed)
    base = find_base(model, cases, states, nominal)
    decimator = common_decimator(cases, settings)

    say("observation matrix")
    observed = _observed(model, base, cases, decimator, settings, method)

    if cad is None:
        robot, source = shape, "sizes"
    else:
        robot, source = cad, "cad"
    find = partial(find_prior, model, base, robot=robot, source=source, noise=noise, effort=effort)
    takes_prior = _takes_prior(method, model, settings, source)
    choose = partial(_chosen, model, base, cases, decimator, observed, find, method, takes_prior, noise, progress)
    chosen = choose(settings)
    earlier, prior = settings.earlier, chosen.prior
    if earlier is not None and prior is not None and prior.contradiction > np.log(DECISIVE):
        say("the prior of the earlier identification is left")
        settings = replace(settings, earlier=earlier.without_prior(prior.contradiction))
        chosen = choose(settings)

    problem = IdentificationProblem(
        model=model,
        base=base,
        cases=cases,
        decimator=decimator,
        rows=tuple(chosen.rows),
        terms=(*_terms_of(model, base), *chosen.friction.terms),
        groups=chosen.groups,
        noise=noise,
        prior=chosen.prior,
        loop=settings.loop,
        cad=cad,
        constraints=settings.constraints,
        progress=progress,
        ridges=chosen.ridges(base, settings.earlier),
    )
    return _identified(problem, method, chosen.friction, settings, say)


@dataclass(frozen=True, eq=False)
class _Choice:
    """Prior and friction terms that were chosen for recordings.

    Attributes:
        rows: rows of all recordings, in the base columns and the columns of friction.
        prior: prior of the base parameters; None if the method uses none.
        friction: additional friction terms.
        groups: (p,) ridge group of each column; -1 for base columns.
    """

    rows: list[ObservationRows]
    prior: Prior | None
    friction: FrictionSelection
    groups: np.ndarray

    def ridges(self, base: Base, earlier: EarlierChoice | None) -> np.ndarray | None:
        """Return the ridge (p,) of each column that an earlier identification chose, NaN for others; None without one.

        Args:
            base: base parameters.
            earlier: choice of the earlier identification.
        """
        if self.prior is None or earlier is None:
            return None
        names = [*base.names, *[term.name for term in self.friction.terms]]
        return np.array([earlier.ridges.get(name, np.nan) for name in names])


def _chosen(
    model: RegressorModel,
    base: Base,
    cases: Sequence[Case],
    decimator: Decimator,
    observed: tuple[list[ObservationRows], list[ObservationRows]],
    find: Callable[..., Prior],
    method: Method,
    takes_prior: bool,
    noise: np.ndarray | None,
    progress: Progress | None,
    settings: IdentificationSettings,
) -> _Choice:
    """Return prior and friction terms for recordings, with the rows in all columns.

    Args:
        model: the model.
        base: its base parameters.
        cases: recordings.
        decimator: filter and decimation of the rows.
        observed: rows in the base columns, without and with marked standstills.
        find: function of rows that returns their prior.
        method: the method.
        takes_prior: whether to use a prior.
        noise: (rows,) stated standard deviation of the torque noise, up to a common factor; None: from the residuals.
        progress: function that is called with a short text at each stage; None: not called.
        settings: settings of the identification, with the choice of an earlier one if it is carried on.
    """
    say = progress or (lambda message: None)
    earlier = settings.earlier
    if earlier is not None:
        find = partial(find, fixed=earlier.choice.sizes)
    rows_as_moving, rows = observed

    say("first fit")
    rows, prior, first = _first_fit(rows, find, takes_prior, noise)
    rows = with_weights(rows, first.rest_weights)
    marks_standstills = isinstance(method, LeastSquares) and isinstance(model, IdentificationModel)
    if any(part.standing.any() for part in rows):
        as_moving = _first_fit(rows_as_moving, find, takes_prior, noise)
        fitted = (rows, prior, first)
        error = _left_out_error(fitted, rows, settings)
        error_as_moving = _left_out_error(as_moving, rows, settings)
        if error_as_moving < CLEARLY_LESS**2 * error:
            rows, prior, first = as_moving
            marks_standstills = False
    if prior is not None and earlier is not None and earlier.choice.sizes:
        earlier.check_sizes(tuple(prior.sizes))
        prior = find(rows, start=prior, tempering=earlier.choice.tempering)
    elif prior is not None:
        prior = tempered_prior(find, prior, rows, regimes(rows, cases, decimator))
    if prior is not None:
        first = prior.first
    rows = with_weights(rows, first.rest_weights)

    friction, loads = _richer_friction(model, base, rows, cases, decimator, first, prior, settings, progress)
    richer_rows = []
    for part, case, load in zip(rows, cases, loads):
        columns = observe_terms(friction.terms, case, decimator, load, model.torque_rows)
        richer_rows.append(part.extend(friction.terms, columns))
    groups = np.array(friction.groups, dtype=int)
    column_groups = np.concatenate([np.full(base.b, -1), groups])
    if prior is not None and marks_standstills:
        richer_rows = _weighed_after_standstills(
            richer_rows, cases, decimator, model.torque_rows, first, prior, column_groups
        )
    breakaway = any((part.breakaway < 1.0).any() for part in richer_rows)
    if prior is not None and (friction.terms or breakaway):
        say("sizes beside richer friction")
        prior = find(richer_rows, groups=groups, start=prior, tempering=prior.tempering)
        richer_rows = with_weights(richer_rows, prior.first.rest_weights)
    return _Choice(richer_rows, prior, friction, column_groups)


def _first_fit(
    rows: list[ObservationRows], find: Callable[..., Prior], takes_prior: bool, noise: np.ndarray | None
) -> _Fitted:
    """Return the rows with their prior (None if the method uses none) and their first fit.

    Args:
        rows: rows of all recordings.
        find: function of the rows that returns their prior.
        takes_prior: whether to use a prior.
        noise: (rows,) stated standard deviation of the torque noise, up to a common factor; None: from the residuals.
    """
    if takes_prior:
        prior = find(rows)
        return rows, prior, prior.first
    return rows, None, first_fit(rows, noise)


def _left_out_error(
    fitted: _Fitted, reference_rows: Sequence[ObservationRows], settings: IdentificationSettings
) -> float:
    """Return the cross-validated squared error of a first fit on the reference rows of held-out time blocks.

    Args:
        fitted: rows with a treatment of standstills, their prior and first fit.
        reference_rows: the same samples with their standstills marked; the error is that of their rows in motion.
        settings: settings, which exclude torques of another unit.
    """
    rows, prior, first = fitted
    prior_rows = None
    if prior is not None:
        prior_rows = prior.rows
    return left_out_error(rows, reference_rows, first.std, first.inflation, prior_rows, settings.apart)


def _weighed_after_standstills(
    rows: list[ObservationRows],
    cases: Sequence[Case],
    decimator: Decimator,
    torque_rows: TorqueRows,
    first: FirstFit,
    prior: Prior,
    column_groups: np.ndarray,
) -> list[ObservationRows]:
    """Return the rows with lower weights shortly after standstills, where the friction at rest still decays.

    The decay is estimated from residuals of a fit with additional friction, which also explains slow motion.

    Args:
        rows: rows of all recordings, additional friction included.
        cases: recordings.
        decimator: filter of the rows.
        torque_rows: kind of torques in the rows.
        first: first fit, which gives the weights of the joints.
        prior: prior of the base parameters.
        column_groups: ridge group of each column; -1 for base parameters.
    """
    inflation = prior.tempering * first.inflation
    prior_rows = prior.widened(int((column_groups >= 0).sum()))
    for _ in range(BREAKAWAY_ROUNDS):
        data = pool(triangulate(rows), rows[0].target.shape[1])
        values, _ = estimate(data, first.std, inflation, column_groups, prior_rows)
        rows = with_breakaway(rows, cases, decimator, torque_rows, values)
    return rows


def _terms_of(model: RegressorModel, base: Base) -> list[DriveTerm | None]:
    """Return the drive term of each base parameter; None for parameters of bodies.

    Args:
        model: the model.
        base: its base parameters.
    """
    terms: list[DriveTerm | None] = []
    for column in base.kept:
        if column < model.inertial:
            terms.append(None)
        else:
            terms.append(model.columns[column - model.inertial])
    return terms


def _observed(
    model: RegressorModel,
    base: Base,
    cases: Sequence[Case],
    decimator: Decimator,
    settings: IdentificationSettings,
    method: Method,
) -> tuple[list[ObservationRows], list[ObservationRows]]:
    """Return the rows of all cases in the base columns with numbered time blocks, without and with marked standstills.

    Args:
        model: the model.
        base: its base parameters.
        cases: recordings.
        decimator: filter and decimation of the rows.
        settings: settings: number of time blocks, smoothing of the Coulomb sign.
        method: the method; standstills are marked only for least squares.

    Raises:
        MeasurementError: if there are fewer rows than twice the number of base parameters.
    """
    rows = [observe(model, base.kept, case, decimator) for case in cases]
    samples = [kept(case.motion.segment, decimator) for case in cases]
    repetition = course([case.motion for case in cases]).at(samples)
    rows = with_blocks(rows, settings.folds, repetition)
    if model.torque_rows == POWER and len(cases) > 1:
        rows = [part.by_recording(number, len(cases)) for number, part in enumerate(rows)]
    rows_as_moving = rows
    if isinstance(method, LeastSquares) and isinstance(model, IdentificationModel):
        width = np.array(per_joint(settings.v0, cases[0].motion.n, "v0"))
        rows_as_moving = with_standstills(rows, cases, decimator, model, base.kept, width, marks=False)
        rows = with_standstills(rows, cases, decimator, model, base.kept, width)
    count = sum(int(part.present.sum()) for part in rows)
    message = (
        f"{count} rows remain for {base.b} base parameters after filtering and decimation: "
        "record longer, or raise the identification band ([filter] band)"
    )
    require(count >= 2 * base.b, message, MeasurementError)
    return rows_as_moving, rows


def _identified(
    problem: IdentificationProblem,
    method: Method,
    friction: FrictionSelection,
    settings: IdentificationSettings,
    say: Progress,
) -> Identification[RegressorModel]:
    """Return the identification of a problem by a method: estimate, simulated loop, ripple, essential parameters.

    Args:
        problem: data and settings of the estimation.
        method: the method.
        friction: selected friction terms.
        settings: settings of the identification.
        say: function that is called with a short text at each stage.
    """
    model = problem.model
    base = problem.base
    cases = problem.cases
    say("simulating the closed loop" if method.needs_controller else "estimate")
    fit = method.estimate(problem)
    values = fit.estimate.values
    friction = friction.fitted(fit.estimate.sigma[base.b :])
    loop = LoopResults()
    if settings.loop is not None:
        if not method.needs_controller:
            say("simulating the closed loop")
        loop = loop_results(problem, fit)

    if _has_drives(model):
        model = model.with_terms(*friction.terms)
    standard = base.to_standard(values[: base.b])
    dynamics = Dynamics(model, np.concatenate([standard, values[base.b :]]))
    dynamics, ripples = _with_ripple(dynamics, cases, settings, say)
    dynamics = _with_payloads(dynamics, cases, settings)

    say("essential parameters")
    elimination = _essential(fit, settings)
    stacked = problem.pooled.factors.reshape(-1, len(values) + 1)
    base_columns = stacked[:, : base.b]
    condition = condition_numbers(base_columns)
    return Identification(
        dynamics=dynamics,
        base=base,
        fitted=fit,
        elimination=elimination,
        friction=friction,
        settings=settings,
        rows=problem.rows,
        terms=problem.terms,
        condition=condition,
        prior=problem.prior,
        ripples=ripples,
        loop=loop,
    )


def chain_states(chain: Chain, model: RegressorModel, seed: int = 0) -> States:
    """Return random states of a chain's model within the chain's joint limits.

    Args:
        chain: the arm.
        model: its model.
        seed: seed of random numbers.
    """
    lower, upper = chain.sampling_limits()
    return bases.random_samples(model, seed=seed, lower=lower, upper=upper)


def find_base(
    model: RegressorModel, cases: Sequence[Case], states: States, nominal: RegressorModel | None = None
) -> Base:
    """Return the base parameters of a model, with columns compared over states and over the payloads of the cases.

    Args:
        model: the model.
        cases: recordings.
        states: states at which columns are compared.
        nominal: the model on the geometry on which columns are chosen; None: `model`.
    """
    payloads = [tuple(sorted(case.carried)) for case in cases]
    return bases.find(model, states, tuple(dict.fromkeys(payloads)), nominal=nominal)


def _torque_limits(chain: Chain) -> np.ndarray | None:
    """Return the torque limits (n,) [N m or N] of the joints of `chain`; None if any limit is missing."""
    limits = np.array([joint.effort for joint in chain.joints])
    usable = np.isfinite(limits) & (limits > 0.0)
    return limits if usable.all() else None


def _has_drives(model: RegressorModel) -> TypeGuard[IdentificationModel]:
    """Return whether a model supports additional friction terms, which act on the motors of single joints."""
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
    """Return the friction terms selected on held-out time, and for each case the transmitted torques (N, n).

    Load-dependent friction depends on the transmitted torques; these are None if no tested term needs them.

    Args:
        model: the model with standard friction.
        base: its base parameters.
        rows: rows of all cases.
        cases: recordings.
        decimator: filter and decimation of the rows.
        first: first fit, which gives row weights and predicts transmitted torques.
        prior: prior of the base parameters; None without one.
        settings: settings of the identification.
        progress: function that is called with a short text at each step; None: not called.
    """
    loads: list[np.ndarray | None] = [None] * len(cases)
    if not _has_drives(model):
        return FrictionSelection((), (), ()), loads
    if settings.friction not in ("standard", "ripple"):
        plain = Dynamics(model, base.to_standard(first.values))
        loads = [plain.transmitted(case) for case in cases]
    inflation = first.inflation
    if prior is not None:
        inflation = inflation * prior.tempering / TEMPERING
    coupled = set()
    for term in model.columns:
        if len(term.acts) > 1:
            coupled.add(tuple(sorted({row for row, _ in term.acts})))
    v0 = np.array(per_joint(settings.v0, model.n, "v0"))
    candidates = FrictionCandidates(
        cases=cases,
        rows=rows,
        loads=loads,
        decimator=decimator,
        std=first.std,
        inflation=inflation,
        v0=v0,
        linear=model.prismatic,
        prior=prior,
        apart=settings.apart,
        torque_rows=model.torque_rows,
        coupled=frozenset(coupled),
    )
    return select_friction(candidates, settings.friction, progress, settings.earlier), loads


def _with_ripple(
    dynamics: Dynamics[RegressorModel], cases: Sequence[Case], settings: IdentificationSettings, say: Progress
) -> tuple[Dynamics[RegressorModel], tuple[Ripple, ...]]:
    """Return the model with gear ripple identified from its residuals, and the ripple of all joints.

    Without a request in the settings, the model is unchanged and there is no ripple.

    Args:
        dynamics: the identified model.
        cases: recordings.
        settings: settings of the identification.
        say: function that is called with a short text.
    """
    model = dynamics.model
    if not _has_drives(model) or not model.torque_rows.motors_alone or settings.friction not in ("auto", "ripple"):
        return dynamics, ()
    say("ripple")
    residuals = [case.target - predict(dynamics, case) for case in cases]
    ripples = tuple(find_all(cases, residuals))
    terms: list[DriveTerm] = []
    values = [dynamics.values]
    for ripple in ripples:
        terms += ripple.terms
        values.append(ripple.values)
    return Dynamics(model.with_terms(*terms), np.concatenate(values)), ripples


def _with_payloads(
    dynamics: Dynamics[RegressorModel], cases: Sequence[Case], settings: IdentificationSettings
) -> Dynamics[RegressorModel]:
    """Return the model with known parameters set for payloads that are in no training recording.

    Args:
        dynamics: the identified model.
        cases: training recordings.
        settings: settings, with known masses of payloads.
    """
    model = dynamics.model
    values = np.array(dynamics.values)
    for label, payload in settings.payloads.items():
        parameters = settings.payload_values.get(label, payload.parameters)
        in_training = any(label in case.carried for case in cases)
        if isinstance(model, IdentificationModel) and parameters is not None and not in_training:
            first = 10 * model.bodies.labels.index(label)
            values[first : first + 10] = parameters
    return Dynamics(model, values)


def common_decimator(cases: Sequence[Case], settings: IdentificationSettings) -> Decimator:
    """Return the filter and decimation for all cases, with the widest identification band among the cases.

    If this gives more than ``settings.samples`` rows, only every second, third, … row is used. The band is not reduced:
    long recordings have redundant rows, but fast motion is identified only in a wide band.

    Args:
        cases: recordings.
        settings: settings, with the largest number of rows.

    Raises:
        MeasurementError: if the sampling rates of the cases differ.
    """
    rates = [case.motion.rate for case in cases]
    message = f"recordings of {min(rates):.4g} Hz and {max(rates):.4g} Hz cannot be combined; resample one of them"
    require(max(rates) <= MAX_RATE_RATIO * min(rates), message, MeasurementError)
    total = sum(len(case.motion) for case in cases)
    rate = rates[0]
    widest = design_decimator(rate, min(case.motion.decimator.factor for case in cases))
    max_rows = widest.factor * settings.samples
    step = -(-total // max_rows)
    factor = step * widest.factor
    return replace(widest, factor=factor)


def _repeats_noise(cases: Sequence[Case], settings: IdentificationSettings) -> np.ndarray | None:
    """Return the torque noise (rows,) from repetitions of the motion, rms over the cases; None if not requested.

    Args:
        cases: recordings that are averages over repetitions.
        settings: settings, which request this noise by `weights`.

    Raises:
        UsageError: for a method other than WLS, or rows other than motor torques.
        MeasurementError: for a recording without variances, or with a joint of zero variance.
    """
    if settings.weights == "residuals":
        return None
    if not method_named(settings.method).takes_prior or not settings.torque_rows.motors_alone:
        raise UsageError(
            f'weights = "repeats" needs method wls and rows motor; the options state {settings.method} and '
            f"{settings.torque_rows.name}"
        )
    variances, lengths = [], []
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
        variances.append(case.noise**2)
        lengths.append(len(case.motion))
    variance = np.average(variances, axis=0, weights=lengths)
    return np.asarray(np.sqrt(variance))


def _takes_prior(method: Method, model: RegressorModel, settings: IdentificationSettings, source: str) -> bool:
    """Return whether the parameters get a prior: it is requested, and method and model support it.

    Args:
        method: the method.
        model: the model.
        settings: settings, which request the prior.
        source: source of the prior, ``cad`` or ``sizes``.

    Raises:
        UsageError: if a CAD prior is requested, but the description has no masses.
    """
    if settings.prior == "cad" and source != "cad":
        raise UsageError("prior = 'cad', but the robot's description states no masses")
    return settings.prior != "none" and method.takes_prior and model.inertial > 0


def _essential(fit: MethodEstimate, settings: IdentificationSettings) -> Elimination | None:
    """Return the elimination to the essential parameters; None if it is not requested.

    Args:
        fit: the estimate of base parameters and friction.
        settings: settings: rule of the elimination, parameters to keep and to drop.
    """
    if settings.essential == "none":
        return None
    data, std, inflation = fit.testable()
    keep = [bases.standard_name(name, data.names) for name in settings.keep]
    drop = [bases.standard_name(name, data.names) for name in settings.drop]
    rule = Rule(settings.essential)
    return eliminate(
        data, rule, ratio=settings.ratio, level=settings.level, keep=keep, drop=drop, std=std, inflation=inflation
    )


def _require_constrainable(method: Method, settings: IdentificationSettings) -> None:
    """Raise a UsageError if the settings contain constraints that the method does not support."""
    if settings.constraints is None or method.takes_constraints:
        return
    supporting = [name for name, candidate in METHODS.items() if candidate.takes_constraints]
    constrained = f"pc-{method.name}"
    advice = f"methods that support them: {', '.join(supporting)}"
    if constrained in supporting:
        advice = f"use '{constrained}'"
    if settings.constraints.by_function:
        advice = f"methods that do: {', '.join([*TAKING_FUNCTIONS, *supporting])}"
    raise UsageError(f"[constraints]: method '{method.name}' does not support them; {advice}")


def _require_motion(cases: Sequence[Case]) -> None:
    """Raise an error if no joint moves in any of the training cases."""
    if all((np.ptp(case.motion.q, axis=0) < MIN_MOTION).all() for case in cases):
        refuse_data(
            cases[0].motion.file, "no joint moves, so only gravity in one pose is identifiable: record a motion"
        )
