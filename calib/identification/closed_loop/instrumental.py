"""IDIM-IV: instruments from a closed-loop simulation with the last estimate; both steps are repeated to convergence.

    simulate with x_k → Z = W(q_s, v_s, a_s), filtered and decimated like W → x_{k+1} = (Zᵀ Ω⁻¹ W)⁻¹ Zᵀ Ω⁻¹ y

(Janot, Vandanjon & Gautier 2014). The simulation has the recording's reference and controller but no noise, so Z is
uncorrelated with the noise that the feedback brings into W. The iteration starts from a regular robot: inertia diag(J),
no gravity, no friction. DIDIM (Gautier, Janot & Vandanjon 2013) estimates from the simulated W alone, x_{k+1} = W_s⁺ y.

Noise shifts the mean of the column of a Coulomb sign, and instruments do not remove such a bias. It is removed by
`sign_noise`, which simulates the noise in the loop or in the log alone, wherever the torques show it to be.

With constraints on base parameters, every round minimises ½ ‖P_Z (y - W x)‖² under them; this is PC-IDIM-IV
(`calib.identification.methods.parameter_constraints`). Constraints do not remove a bias.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from calib.data.signals.filtering import Decimator
from calib.dynamics.base import Base
from calib.dynamics.drives import DriveTerm
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.torque_rows import POWER
from calib.errors import CalibError, CannotSimulate, Diverged, NotConverged, UsageError, one_of
from calib.estimation.linear import LinearFit, settled_std, wls
from calib.estimation.triangles import Triangles, combine
from calib.estimation.whiteness import inflation
from calib.identification.closed_loop import instrumental_variables
from calib.identification.closed_loop.instrumental_variables import Instruments, InstrumentStrength
from calib.identification.closed_loop.loop_recordings import Loop, simulated_case
from calib.identification.closed_loop.sign_noise import PositionNoise, mean_signs, position_noise, with_quiet_speed
from calib.identification.closed_loop.simulated_runs import (
    MAX_GAIN_RATIO,
    MAX_RETREATS,
    Runs,
    between,
    distance_percent,
    error_ratio,
    nearer,
    regular_plant,
    simulated_runs,
)
from calib.identification.closed_loop.simulation import Plant
from calib.identification.loop import ExogeneityTest
from calib.identification.methods.constraint_settings import ConstraintSettings, Held
from calib.identification.methods.parameter_constraints import Constraints, hold, make_constraints
from calib.identification.rows import Case, ObservationRows, observe, observe_terms, pool, triangulate
from calib.records import frozen

# iterations; 3 to 6 are usual
MAX_ROUNDS = 10


@dataclass(frozen=True)
class _RoundEstimator:
    """Estimator that one iteration uses, from the R factors of [Z W y].

    Attributes:
        name: name in options and files.
        fit: function of R factors, standard deviations of the groups (g,) and variance inflation that returns the
            estimate.
        triangle: function of R factors and standard deviations (g,) that returns the R factor [R z; 0 ρ] of the
            criterion, which is minimised under constraints.
        measured: whether the estimate uses the regressor W of the measured motion.
    """

    name: str
    fit: Callable[[Instruments, np.ndarray, float], LinearFit]
    triangle: Callable[[Instruments, np.ndarray], np.ndarray]
    measured: bool


@dataclass(frozen=True)
class Round:
    """Convergence of one iteration.

    Attributes:
        change: largest |Δx_j| / max(|x_j|, 8 σ_j) of a parameter; 8 = 0.2 / 2.5 %, from the criterion of
            `calib.identification.closed_loop.instrumental_variables.settled`.
        residual: standard deviation of the weighted residuals.
        retreats: number of times the step was halved until the parameters could be simulated.
    """

    change: float
    residual: float
    retreats: int


@dataclass(frozen=True, eq=False)
class Instrumental:
    """Result of IDIM-IV.

    Attributes:
        fit: the estimate.
        ordinary: weighted least squares of the same rows, for comparison.
        plant: the simulated robot with the estimated parameters.
        rounds: history of the iterations.
        strength: strength of the instruments, i.e. their correlation with W.
        verdict: test whether least squares is biased (Durbin, Wu, Hausman).
        std, inflation: standard deviation of each torque row (rows,), and variance inflation of all rows together.
        distance: (n,) 100 ‖q - q_s‖ / ‖q - mean q‖ [%] of filtered measured and simulated positions; large if the
            stated controller is not the robot's.
        stray: (n,) tracking error of the recorded robot over that of the simulated robot, the factor by which stated
            gains are wrong; NaN if the tracking error is below the noise.
        constrained: the constrained estimate; None without constraints. `fit` has its values and covariance.
        problem: R factors of [Z W y], one group per torque row.
        estimator: estimator used in each iteration.
        rows: for each recording, the case whose motion W describes, its rows, and its instruments Z.
        noise: for each recording, its position noise in the loop and in the log alone.
    """

    fit: LinearFit
    ordinary: LinearFit
    plant: Plant
    rounds: tuple[Round, ...]
    strength: InstrumentStrength
    verdict: ExogeneityTest
    std: np.ndarray
    inflation: float
    distance: np.ndarray
    stray: np.ndarray
    constrained: Held | None
    problem: Instruments
    estimator: _RoundEstimator
    rows: tuple[tuple[Case, ObservationRows, np.ndarray], ...]
    noise: tuple[PositionNoise, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the estimated parameters, as in `Base.names`."""
        return self.fit.estimate.names

    @property
    def direct(self) -> np.ndarray:
        """Relative torque error (n,) of the estimate on the simulated motion: 100 ‖y - Z x‖ / ‖y‖ [%]."""
        return self.simulated_error(self.fit.estimate.values)

    def simulated_error(self, values: np.ndarray) -> np.ndarray:
        """Return the torque errors (n,) of parameters (p,) on the simulated motion, 100 ‖y - Z x‖ / ‖y‖ [%]."""
        with_instruments = np.concatenate([values, np.zeros(len(self.names))])
        return self.problem.data.relative_errors(with_instruments)

    @property
    def own(self) -> np.ndarray:
        """Relative torque error (n,) of the estimate on the measured motion: 100 ‖y - W x‖ / ‖y‖ [%]."""
        by_measured = np.concatenate([np.zeros(len(self.names)), self.fit.estimate.values])
        return self.problem.data.relative_errors(by_measured)

    @property
    def off(self) -> np.ndarray:
        """Joints (from 0) whose stated gains are wrong, because recorded and simulated tracking errors differ."""
        estimate = self.fit.estimate
        simulated = self.problem.data.factors[:, :, : len(self.names)]
        explained = np.sum((simulated @ estimate.values) ** 2, axis=1)
        sizes = np.maximum(explained, 1e-300)
        # the torques' share that is unsure makes e_s = q_ref - q_s unsure, too
        unsure = np.sqrt(np.einsum("gij,jk,gik->g", simulated, estimate.covariance, simulated) / sizes)
        # rows of the motors
        if len(unsure) >= len(self.stray):
            unsure = unsure[-len(self.stray) :]
        else:
            unsure = unsure.max()
        ratio = np.maximum(np.nan_to_num(self.stray, nan=1.0), 1e-3)
        away = np.abs(np.log(ratio))
        return np.flatnonzero(away > np.log(MAX_GAIN_RATIO) + 5.0 * unsure)

    @property
    def unexplained(self) -> np.ndarray:
        """Torque rows (from 0) that the estimate fits much worse on the simulated than on the measured motion."""
        # of the torque simulated, times the model's own error: beyond, the loop is another (our choice)
        max_loop_error = 2.0
        return np.flatnonzero(self.direct >= max_loop_error * self.own)

    @property
    def explains(self) -> bool:
        """Whether the simulation explains the recording: no gains are wrong, and no torque row fits much worse."""
        return not len(self.off) and not len(self.unexplained)

    @property
    def shift(self) -> np.ndarray:
        """|Least-squares estimate - IV estimate| of each parameter (p,), in standard deviations.

        The test in `verdict` finds any bias that the data can detect; this difference shows whether the bias matters.
        """
        estimate = self.fit.estimate
        difference = np.abs(self.ordinary.estimate.values - estimate.values)
        sigma = np.where(estimate.sigma > 0, estimate.sigma, 1)
        return difference / sigma

    @property
    def apart(self) -> np.ndarray:
        """Distance (p,) of the constrained IV estimate from the one of `by_free_instruments`, in sigmas.

        The sigmas are the standard deviations of the unconstrained fit. The distance is zero if no constraint is
        binding, and for didim.
        """
        constrained = self.constrained
        values = self.fit.estimate.values
        if constrained is None or not len(constrained.normals) or not self.estimator.measured:
            return np.zeros(len(values))
        free_estimate = instrumental_variables.by_free_instruments(self.problem, self.std, values, constrained.normals)
        return np.abs(free_estimate - values) / np.maximum(constrained.free.estimate.sigma, 1e-300)

    @property
    def valid(self) -> bool:
        """Whether the instruments are not weak, and simulated positions differ by less than 10 % from recorded ones."""
        return not self.strength.weak and bool(np.all(self.distance < 10.0))


def identify_instrumental(
    model: IdentificationModel,
    base: Base,
    cases: Sequence[tuple[Case, Loop]],
    decimator: Decimator,
    *,
    method: str = "iv",
    inertia: np.ndarray | None = None,
    positive: Sequence[str] = (),
    constraints: Constraints | None = None,
    terms: Sequence[DriveTerm] = (),
    limit: int = MAX_ROUNDS,
    say: Callable[[str], None] | None = None,
) -> Instrumental:
    """Return the estimate of the base parameters with instruments from simulation.

    Args:
        model: model of motor torques, joint torque sensors, or both. With sensors alone the motor side is not
            identified: the simulated robot keeps its initial motor inertia and has no friction.
        base: base parameters of the model.
        cases: recordings, each with the closed loop in which it was made.
        decimator: filter and decimation of W, Z and y.
        method: ``iv`` or ``didim``.
        inertia: (n,) inertia of the regular robot at the start [kg m²]; None: kd² / (2 kp), with which the first
            recording's controller has a damping ratio of 0.7.
        positive: names of base parameters that must not be negative (PC-IDIM-IV).
        constraints: constraints on the estimated base parameters; None: only those of `positive`.
        terms: additional friction terms, estimated after the base parameters; the loads on which they depend are
            computed by least squares.
        limit: largest number of iterations.
        say: called with a short text after each iteration; None: not called.

    Raises:
        UsageError: for an unknown method, or torque rows that cannot be simulated.
        Unidentifiable: if the instruments do not identify the parameters separately.
        NotConverged: with the last `LinearFit`, after `limit` iterations; `Diverged` if the iterations diverged.
        CannotSimulate: if the loop is unstable with the initial robot, or with an estimate and all smaller steps to it.
    """
    one_of(method, ROUNDS, "method", UsageError)
    rows = model.torque_rows
    if not rows.has_bodies or rows == POWER or not cases:
        raise UsageError(
            "instruments from simulation need a recording with its reference, and rows motor, link or both (of a "
            f"parallel robot motor or platform); found '{rows.name}'"
        )
    observed, friction = _observed_with_friction(model, base, cases, decimator, terms)
    data = pool(triangulate(observed), model.rows)
    if constraints is None and positive:
        bounds = dict.fromkeys(positive, (0.0, np.inf))
        settings = ConstraintSettings(signs=False, inertia=0, bounds=bounds)
        constraints = make_constraints(settings, model, base, base.names, [None] * base.b)
    estimator = ROUNDS[method]
    ordinary = wls(data, settled_std(data, 1e-3))
    loop = cases[0][1]
    plant = regular_plant(model, friction.terms, loop, inertia)
    std = ordinary.group_std
    before: LinearFit | None = None
    noise: list[PositionNoise] = []
    rounds: list[Round] = []
    try:
        runs = simulated_runs(plant, cases)
        for case, recording_loop in cases:
            noise.append(position_noise(plant, case, recording_loop))
        retreats = 0
        tau = 1.0
    except NotConverged as error:
        raise CannotSimulate(str(error), error.last) from error
    task = _Fixed(model, base, cases, decimator, observed, estimator, constraints, friction, noise)
    # of the last step, and how often it was halved afterwards
    start, returns = plant, 0
    while True:
        try:
            estimate = _estimate_round(task, plant, runs, std, tau)
        except CannotSimulate:
            # a loop that holds without noise and not with it is hardly stable: take a smaller step
            returns += 1
            if returns > MAX_RETREATS or plant is start:
                raise
            plant, runs = nearer(start, plant, cases)
            retreats = returns
            continue
        task = task.after(estimate)
        residual_std = estimate.fit.estimate.residual_std
        iteration = Round(_change(before, estimate.fit), residual_std, retreats)
        rounds.append(iteration)
        if say is not None:
            say(f"{method}, round {len(rounds)}: parameters change by {100 * min(iteration.change, 1.0):.3g} %")
        if before is not None and retreats == 0 and instrumental_variables.settled(before, estimate.fit):
            return _result(task, estimate, ordinary, task.plant(plant, estimate), rounds, std, runs)
        try:
            task, estimate, end, runs, retreats = _simulate_new(task, estimate, plant, std, tau)
            start, plant, returns = plant, end, 0
        except CannotSimulate:
            # the last step led to a loop that is hardly stable, whose motion tells nothing: take a smaller one
            returns += 1
            if returns > MAX_RETREATS or plant is start:
                raise
            plant, runs = nearer(start, plant, cases)
            retreats = returns
        before = estimate.fit
        std = estimate.fit.group_std
        tau = estimate.tau
        if len(rounds) >= limit:
            break
    change_percent = 100 * rounds[-1].change
    message = (
        f"instruments from simulation: parameters still change by {change_percent:.3g} % after {limit} "
        "iterations; estimate fewer parameters (essential ones), or check the controller's "
        f"gains{_if_weak(task, estimate, std)}"
    )
    if len(rounds) > 2 and rounds[-1].change > rounds[1].change:
        raise Diverged(message, before)
    raise NotConverged(message, before)


def _observed_with_friction(
    model: IdentificationModel,
    base: Base,
    cases: Sequence[tuple[Case, Loop]],
    decimator: Decimator,
    terms: Sequence[DriveTerm],
) -> tuple[list[ObservationRows], _Friction]:
    """Return the rows of all cases, with columns of the additional friction terms, and these terms with their loads.

    The loads are computed with a least-squares estimate without these terms.
    """
    observed = []
    for case, _ in cases:
        rows = observe(model, base.kept, case, decimator)
        observed.append(replace(rows, names=base.names))
    if not terms:
        return observed, _Friction((), model, decimator, None)
    data = pool(triangulate(observed), model.rows)
    std = settled_std(data, 1e-3)
    ordinary = wls(data, std)
    loads = base.to_standard(ordinary.estimate.values)
    friction = _Friction(tuple(terms), model, decimator, loads)
    richer = [friction.added(part, case) for part, (case, _) in zip(observed, cases)]
    return richer, friction


@dataclass(frozen=True, eq=False)
class _Friction:
    """Additional friction terms of a model, which may depend on the joints' loads.

    Attributes:
        terms: drive terms.
        model: model without these terms.
        decimator: filter and decimation of the rows.
        loads: (p,) standard parameters from which the joint loads are computed; None without terms.
    """

    terms: tuple[DriveTerm, ...]
    model: IdentificationModel
    decimator: Decimator
    loads: np.ndarray | None

    def added(self, rows: ObservationRows, case: Case) -> ObservationRows:
        """Return the rows of a case with one more column for each term."""
        if self.loads is None:
            return rows
        return rows.extend(self.terms, self.columns(case))

    def columns(self, case: Case) -> np.ndarray:
        """Return the columns (M, rows, k) of the terms on a case's motion."""
        assert self.loads is not None, "there are terms"
        motion = case.motion
        load = self.model.transmitted(self.loads, motion.q, motion.v, motion.a, case.carried)
        return observe_terms(self.terms, case, self.decimator, load, self.model.torque_rows)


@dataclass(frozen=True, eq=False)
class _Fixed:
    """Data and settings that are the same in all iterations.

    Attributes:
        model, base: the model and its base parameters.
        cases: recordings with their loops.
        decimator: filter and decimation of the rows.
        observed: measured rows of each recording.
        estimator: estimator of each iteration.
        constraints: constraints on the parameters; None without.
        friction: additional friction terms.
        noise: position noise of each recording, in the loop and in the log alone.
    """

    model: IdentificationModel
    base: Base
    cases: Sequence[tuple[Case, Loop]]
    decimator: Decimator
    observed: Sequence[ObservationRows]
    estimator: _RoundEstimator
    constraints: Constraints | None
    friction: _Friction
    noise: Sequence[PositionNoise]

    @cached_property
    def signs(self) -> tuple[np.ndarray, np.ndarray]:
        """Masks of base columns (b,) and of richer terms (k,) whose value jumps with the sign of the speed."""
        base_signs = np.zeros(len(self.base.kept), dtype=bool)
        for position, k in enumerate(self.base.kept - self.model.inertial):
            base_signs[position] = k >= 0 and self.model.columns[k].form.undecided_at_rest
        richer_signs = np.zeros(len(self.friction.terms), dtype=bool)
        for position, term in enumerate(self.friction.terms):
            richer_signs[position] = term.form.undecided_at_rest
        return base_signs, richer_signs

    @cached_property
    def width(self) -> float:
        """The least width of a smoothed sign [rad/s or m/s]."""
        widths = [np.inf]
        for term in (*self.model.columns, *self.friction.terms):
            settings = dict(zip(term.form.settings, term.settings))
            widths.append(settings.get("v0", np.inf))
        return min(widths)

    def after(self, estimate: _Found) -> _Fixed:
        """Return the settings of the next iteration; its constraints start with the postures binding in `estimate`."""
        if self.constraints is None or estimate.bound is None:
            return self
        constraints = replace(self.constraints, likely=estimate.bound.tight)
        return replace(self, constraints=constraints)

    def plant(self, old: Plant, estimate: _Found) -> Plant:
        """Return the simulated robot with the estimated parameters.

        If the rows contain no motor torques, it keeps the motor inertias of the robot `old`.
        """
        estimated = estimate.fit.estimate.values
        b = self.base.b
        standard = self.base.to_standard(estimated[:b])
        values = np.concatenate([standard, estimated[b:]])
        regular = old.parameters[len(values) :] * (not self.model.torque_rows.driven)
        return old.with_parameters(np.concatenate([values, regular]))


@dataclass(frozen=True, eq=False)
class _Found:
    """Data of one iteration.

    Attributes:
        observed: rows of each recording.
        simulated: (M, rows, p) instruments Z of each recording.
        problem: R factors of [Z W y].
        fit: the estimate.
        tau: variance inflation of the residuals.
        bound: the constrained estimate; None without constraints.
    """

    observed: Sequence[ObservationRows]
    simulated: Sequence[np.ndarray]
    problem: Instruments
    fit: LinearFit
    tau: float
    bound: Held | None


def _estimate_round(task: _Fixed, plant: Plant, runs: Runs, std: np.ndarray, tau: float) -> _Found:
    """Return the estimate with instruments from simulated runs.

    Args:
        task: data and settings of all iterations.
        plant: the simulated robot.
        runs: its simulated motions of all recordings.
        std: (rows,) standard deviations of the torque rows.
        tau: variance inflation of the last iteration.
    """
    columns = task.base.kept
    observed: list[ObservationRows] = []
    simulated: list[np.ndarray] = []
    for ((case, loop), run), rows, noise in zip(runs, task.observed, task.noise):
        replayed = simulated_case(case, run, loop)
        simulated_rows = observe(task.model, columns, replayed, task.decimator)
        matrix = task.friction.added(simulated_rows, replayed).matrix
        signs = np.concatenate(task.signs)
        if signs.any():
            sign_columns = partial(_sign_columns, task)
            true, recorded = mean_signs(sign_columns, plant, case, loop, run, noise, task.width)
            corrected = rows.matrix.copy()
            corrected[:, :, signs] = sign_columns(with_quiet_speed(case, task.width)) + true - recorded
            rows = replace(rows, matrix=corrected)
            if not task.estimator.measured:
                matrix = matrix.copy()
                matrix[:, :, signs] = true
        simulated.append(matrix)
        observed.append(rows)
    problem = _stack(observed, simulated, task.estimator.measured)
    fit, bound = _held_fit(task, problem, std, tau)
    return _Found(observed, simulated, problem, fit, _inflation(observed, fit), bound)


def _sign_columns(task: _Fixed, case: Case) -> np.ndarray:
    """Return the columns (M, rows, k) of a case's drive terms whose value jumps with the sign of the speed."""
    base_signs, richer_signs = task.signs
    model = task.model
    columns = task.base.kept[base_signs]
    if isinstance(model, IdentificationModel) and model.torque_rows.projection is None:
        # without the columns of the bodies, which cost most
        terms = [model.columns[column - model.inertial] for column in columns]
        matrix = observe_terms(terms, case, task.decimator, torque_rows=model.torque_rows)
    else:
        matrix = observe(model, columns, case, task.decimator).matrix
    if not richer_signs.any():
        return matrix
    return np.concatenate([matrix, task.friction.columns(case)[:, :, richer_signs]], axis=2)


def _result(
    task: _Fixed,
    estimate: _Found,
    ordinary: LinearFit,
    plant: Plant,
    rounds: Sequence[Round],
    std: np.ndarray,
    runs: Runs,
) -> Instrumental:
    """Return the result after the last iteration, with the tests of the instruments and of least squares.

    Covariances include the variance inflation of the last residuals.
    """
    if task.estimator.measured:
        problem = estimate.problem
    else:
        problem = _stack(estimate.observed, estimate.simulated)
    fit, bound = _held_fit(task, problem, std, estimate.tau)
    verdict = instrumental_variables.exogeneity(problem, std, estimate.tau)
    strength = instrumental_variables.strength(problem, std)
    rows = []
    for ((case, loop), run), observed, simulated in zip(runs, estimate.observed, estimate.simulated):
        if task.estimator.measured:
            rows.append((case, observed, simulated))
        else:
            rows.append((simulated_case(case, run, loop), replace(observed, matrix=simulated), simulated))
    distance = distance_percent(runs)
    stray = error_ratio(runs)
    return Instrumental(
        fit,
        ordinary,
        plant,
        tuple(rounds),
        strength,
        verdict,
        frozen(std),
        estimate.tau,
        distance,
        stray,
        bound,
        problem,
        task.estimator,
        tuple(rows),
        tuple(task.noise),
    )


def _simulate_new(
    task: _Fixed, estimate: _Found, old: Plant, std: np.ndarray, tau: float
) -> tuple[_Fixed, _Found, Plant, Runs, int]:
    """Return the simulations with the new parameters or, if these fail, with smaller steps from the old ones.

    If the constraint that the mass matrix M(q) is positive definite is binding, its bound is raised first (our choice):
    a sampled controller cannot stabilise a robot with almost no inertia.

    Returns:
        settings, estimate, simulated robot, its simulated motions, and number of times the step was halved.
    """
    retreats = 0
    while True:
        end = task.plant(old, estimate)
        candidate = between(old, end, 0.5**retreats)
        try:
            return task, estimate, candidate, simulated_runs(candidate, task.cases), retreats
        except CalibError as error:
            problem = error
        if task.constraints and estimate.bound and estimate.bound.postures:
            bound = task.constraints.raised()
        else:
            bound = None
        if bound is not None:
            further = replace(task, constraints=bound)
            with suppress(NotConverged):
                fit, binding = _held_fit(further, estimate.problem, std, tau)
                task = further
                estimate = replace(estimate, fit=fit, bound=binding)
                continue
        retreats += 1
        if retreats >= MAX_RETREATS:
            break
    message = f"neither the estimate nor smaller steps can be simulated: {problem}{_if_weak(task, estimate, std)}"
    raise CannotSimulate(message, task.plant(old, estimate))


def _if_weak(task: _Fixed, estimate: _Found, std: np.ndarray) -> str:
    """Return a text on weak instruments to append to a failure's message; empty for strong instruments."""
    if not task.estimator.measured:
        return ""
    strength = instrumental_variables.strength(estimate.problem, std)
    note = f". The instruments are weak (Cragg-Donald {strength.cragg_donald:.2g}, sound above 10)"
    if strength.weak:
        return f"{note}: record faster motion, or positions with less noise"
    return ""


def _stack(observed: Sequence[ObservationRows], simulated: Sequence[np.ndarray], measured: bool = True) -> Instruments:
    """Return the R factors of [Z W y], one group per torque row.

    Args:
        observed: measured rows (W and y) of each recording.
        simulated: (M, rows, p) instruments Z of each recording.
        measured: if false, W is replaced by zeros, which is cheaper.
    """
    first = observed[0]
    count = observed[0].target.shape[1]
    problem = instrumental_variables.unseen(first.names, first.units, count)
    for rows, z in zip(observed, simulated, strict=True):
        for row in range(count):
            # no copy of all
            if rows.present[:, row].all():
                in_use = slice(None)
            else:
                in_use = rows.present[:, row]
            instruments = z[in_use, row]
            if measured:
                w = rows.matrix[in_use, row]
            else:
                w = np.zeros_like(instruments)
            problem = instrumental_variables.instrument(instruments, w, rows.target[in_use, row], row, before=problem)
    return problem


def _simulated(problem: Instruments) -> Triangles:
    """Return the R factors of [Z y], selected from those of [Z W y]."""
    instruments = np.arange(len(problem.names))
    return replace(problem.data.select(instruments), names=problem.names)


def _inflation(observed: Sequence[ObservationRows], fit: LinearFit) -> float:
    """Return the variance inflation of the longest recording's residuals, mean over the torque rows.

    Variance inflation is the integrated autocorrelation.
    """
    series = [rows.target - rows.matrix @ fit.estimate.values for rows in observed]
    longest = max(series, key=len)
    inflations = [inflation(row) for row in longest.T]
    return max(1.0, float(np.mean(inflations)))


def _held_fit(task: _Fixed, problem: Instruments, std: np.ndarray, tau: float) -> tuple[LinearFit, Held | None]:
    """Return the estimate of an iteration under the constraints, and details of the constrained fit (None without)."""
    fit = task.estimator.fit(problem, std, tau)
    estimator = task.estimator
    if task.constraints is None:
        return fit, None
    if estimator.measured:
        data = problem.least_squares()
    else:
        data = _simulated(problem)
    stated_noise = not estimator.measured
    factor = estimator.triangle(problem, std)
    return hold(fit, factor, data, std, task.constraints, stated_noise=stated_noise)


def _change(before: LinearFit | None, after: LinearFit) -> float:
    if before is None:
        return float("inf")
    size = np.maximum(np.abs(before.estimate.values), 8.0 * after.estimate.sigma)
    change = np.abs(after.estimate.values - before.estimate.values)
    return float(np.max(change / np.maximum(size, 1e-300)))


def _fit_simulated(problem: Instruments, std: np.ndarray, tau: float) -> LinearFit:
    data = _simulated(problem)
    return wls(data, std, np.full(problem.data.groups, tau))


def _combine_simulated(problem: Instruments, std: np.ndarray) -> np.ndarray:
    data = _simulated(problem)
    return combine(data, std)


ROUNDS = {
    "iv": _RoundEstimator("iv", instrumental_variables.iv, instrumental_variables.projected, True),
    "didim": _RoundEstimator("didim", _fit_simulated, _combine_simulated, False),
}
