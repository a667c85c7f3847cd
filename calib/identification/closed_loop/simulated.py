"""Methods that simulate the closed loop of a recording: instrumental variables (IV), and DIDIM."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from calib.dynamics.drives import DriveTerm
from calib.errors import CalibError, Finding, UsageError, finding
from calib.estimation.triangles import Triangles
from calib.identification.closed_loop.instrumental import Instrumental, identify_instrumental
from calib.identification.closed_loop.loop_recordings import ClosedLoops, close_loops
from calib.identification.closed_loop.simulation import simulable
from calib.identification.loop import LoopDisagreement, LoopMetrics, LoopResults
from calib.identification.methods.estimators import CONSISTENT, CONSTRAINED
from calib.identification.methods.least_squares import WLS
from calib.identification.methods.method import IdentificationProblem, Method, MethodEstimate, attempted
from calib.identification.methods.parameter_constraints import constraints_of
from calib.records import field_values


@dataclass(frozen=True, eq=False, kw_only=True)
class LoopEstimate(MethodEstimate):
    """Result of a method that simulates the closed loop.

    Attributes:
        loops: the simulated closed loops.
        instrumental: further results of instrumental variables; None for other methods, and after a failure.
    """

    loops: ClosedLoops
    instrumental: Instrumental | None = None

    def testable(self) -> tuple[Triangles, np.ndarray, np.ndarray]:
        """Return R factors whose least-squares solution is this estimate, for tests of nested models.

        Returns:
            R factors of g groups, standard deviations (g,), and variance inflations (g,).
        """
        identification = self.instrumental
        if identification is None:
            return super().testable()
        residuals = identification.problem.testable(identification.fit, identification.std)
        inflation = np.array([identification.inflation])
        return residuals, np.ones(1), inflation


def attempted_in_loop(
    method: str, problem: IdentificationProblem, loops: ClosedLoops, run: Callable[[], MethodEstimate]
) -> LoopEstimate:
    """Return the result of `run` with the loops and its computing time; an estimation's failure becomes a status.

    Args:
        method: name of the method.
        problem: data and settings, with which a failure is recorded.
        loops: closed loops that `run` simulates.
        run: function that makes the estimate.
    """
    estimate = attempted(method, problem, run)
    if isinstance(estimate, LoopEstimate):
        return estimate
    return LoopEstimate(**field_values(estimate), loops=loops)


@dataclass(frozen=True)
class _Simulated(Method):
    """A method that simulates the closed loop.

    Attributes:
        instruments: use of the simulated motion, a key of `calib.identification.closed_loop.instrumental.ROUNDS`;
            empty: as in the loop's settings.
    """

    needs_controller: bool = field(default=True, kw_only=True)
    needs_simulation: bool = field(default=True, kw_only=True)
    tunes: tuple[str, ...] = field(default=("tolerance 2.5 %", "10 rounds"), kw_only=True)
    instruments: str = ""

    def estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        """Return the estimate of the problem's columns; row weights and variance inflation are those of WLS.

        Raises:
            UsageError, MeasurementError: for a loop or recordings that cannot be simulated.
        """
        if problem.loop is None or not simulable(problem.model):
            raise UsageError(f"method '{self.name}' needs a [loop], and a robot that can be simulated")
        plain = WLS.estimate(problem)
        if not plain.found:
            return replace(plain, method=self.name)
        richer = [term for term in problem.terms[problem.base.b :] if term is not None]
        estimate = self.beside(problem, plain, richer)
        seconds = plain.seconds + estimate.seconds
        return replace(estimate, seconds=seconds)

    def beside(
        self, problem: IdentificationProblem, plain: MethodEstimate, terms: Sequence[DriveTerm] = ()
    ) -> LoopEstimate:
        """Return the estimate with instruments, which starts from a least-squares estimate.

        Args:
            problem: data and settings.
            plain: the least-squares estimate.
            terms: additional friction terms.

        Raises:
            UsageError: without a loop, or for a robot that cannot be simulated.
        """
        model: Any = problem.model
        loop = problem.loop
        if loop is None or not simulable(model):
            raise UsageError("instruments from simulation need a [loop], and a robot that can be simulated")
        loops = close_loops(model, problem.cases, problem.decimator, loop, problem.cad)
        inertia = None
        if loop.inertia:
            inertia = loop.per_joint("inertia", model.n)

        constraints = None
        if self.takes_constraints:
            constraints = constraints_of(problem)

        def estimate() -> LoopEstimate:
            method = self.instruments or loop.instruments
            identification = identify_instrumental(
                model,
                problem.base,
                loops.pairs,
                problem.decimator,
                method=method,
                inertia=inertia,
                positive=loop.positive,
                terms=terms,
                constraints=constraints,
                say=problem.say,
            )
            simulations = 0
            for iteration in identification.rounds:
                simulations += len(loops.pairs) * (1 + iteration.retreats)
            iterations = len(identification.rounds)
            result = replace(
                plain,
                method=self.name,
                solution=identification.fit,
                std=identification.std,
                iterations=iterations,
                simulations=simulations,
                beforehand=None,
                held=identification.constrained,
                instruments=identification.rows,
            )
            # `plain` may be the estimate of another loop, whose results are replaced.
            values = field_values(result) | {"loops": loops, "instrumental": identification}
            return LoopEstimate(**values)  # ty: ignore[invalid-argument-type]

        return attempted_in_loop(self.name, problem, loops, estimate)


CHOSEN = "friction model (with friction = 'auto': steps chosen by least squares) are those of the robot"
IV = _Simulated(
    "iv",
    f"the stated controller, reference and {CHOSEN}",
    description="instrumental variables from the simulated closed loop",
    source="Janot, Vandanjon & Gautier 2014",
)
DIDIM = _Simulated(
    "didim",
    f"the simulated robot moves like the real one: stated controller, reference and {CHOSEN}; measured positions are "
    "not used",
    "didim",
    description="least squares on the simulated motion alone (CLIE of the source)",
    source="Gautier, Janot & Vandanjon 2013",
)
PC_IV = replace(
    IV,
    name=f"pc-{IV.name}",
    assumes=IV.assumes + CONSISTENT,
    instruments=IV.name,
    takes_constraints=True,
    description=IV.name + CONSTRAINED,
    source="Janot & Wensing 2021",
)
PC_DIDIM = replace(
    DIDIM,
    name=f"pc-{DIDIM.name}",
    assumes=DIDIM.assumes + CONSISTENT,
    instruments=DIDIM.name,
    takes_constraints=True,
    description=DIDIM.name + CONSTRAINED,
    source="Leboutet et al. 2021",
)
METHODS = (IV, DIDIM, PC_IV, PC_DIDIM)


@dataclass(frozen=True, eq=False)
class LoopTest:
    """Test of an estimate by instrumental variables (IV) from simulation.

    Attributes:
        found: IV estimate of the standard model, with the test of least squares for bias; None if IV failed.
        loops: the simulated closed loops; None if IV failed.
        failure: reason for a missing estimate; empty otherwise.
    """

    found: Instrumental | None = None
    loops: ClosedLoops | None = None
    failure: str = ""

    def findings(self, is_estimate: bool) -> list[Finding]:
        """Return the findings of the test.

        Args:
            is_estimate: whether IV is the user's estimate; otherwise it is the comparison for a least-squares estimate.
        """
        if self.found is None or self.loops is None:
            return [finding("loop-test-failed", why=self.failure)]
        causes = _distance(self.found) or _gains(self.found) or _torques(self.found)
        noticed = [*_weakness(self.found), *causes]
        return noticed if is_estimate else noticed + _biased(self.found)


def compare_with_loop(problem: IdentificationProblem, estimate: MethodEstimate) -> LoopTest:
    """Return the test of an estimate by instrumental variables (IV), with the closed loop of the problem.

    An IV estimate is its own comparison. For an estimate of another method, a failure of IV is part of the result.

    Args:
        problem: data and settings, with the closed loop.
        estimate: the user's estimate.
    """
    loop_estimate = None
    if isinstance(estimate, LoopEstimate) and estimate.instrumental is not None:
        loop_estimate = estimate
    if loop_estimate is None:
        try:
            loop_estimate = IV.beside(problem, estimate)
        except CalibError as error:
            failure = str(error)
            return LoopTest(failure=failure)
    return LoopTest(
        loop_estimate.instrumental, loop_estimate.loops, "" if loop_estimate.found else str(loop_estimate.failure)
    )


def _weakness(identification: Instrumental) -> list[Finding]:
    strength = identification.strength
    if not strength.weak:
        return []
    weakest = np.argsort(strength.partial_r2)[:5]
    names = [f"{strength.names[k]} ({100 * strength.partial_r2[k]:.2g} %)" for k in weakest]
    return [finding("weak-instruments", donald=strength.cragg_donald, names=names)]


def _distance(identification: Instrumental) -> list[Finding]:
    # [%] of a joint's motion by which the simulated robot may miss the recorded one (our choice)
    max_miss = 10.0
    joints = [f"{x:.3g} % at joint {j + 1}" for j, x in enumerate(identification.distance) if not x < max_miss]
    if joints:
        return [finding("loop-not-followed", joints=joints)]
    return []


def _gains(identification: Instrumental) -> list[Finding]:
    """Return the finding on joints whose stated gains differ from the gains during the recording.

    Args:
        identification: estimate by instrumental variables, with the gains that the simulation suggests.
    """
    joints = [f"{identification.stray[j]:.2g} times at joint {j + 1}" for j in identification.off]
    if joints:
        return [finding("loop-gains-off", joints=joints)]
    return []


def _torques(identification: Instrumental) -> list[Finding]:
    """Return the finding on torque rows that are explained by the measured motion but not by the simulated motion.

    Args:
        identification: estimate by instrumental variables, with the simulation's errors.
    """
    case = identification.rows[0][0]
    direct = identification.direct
    iv_torques = identification.own
    labels = case.torque_rows.numbered(case.motion.n)
    rows = [f"{direct[k]:.3g} % for {iv_torques[k]:.3g} % at joint {labels[k]}" for k in identification.unexplained]
    if rows:
        return [finding("loop-unexplained", rows=rows)]
    return []


def _biased(identification: Instrumental) -> list[Finding]:
    """Return the finding that least squares is biased; none if the bias is small or the simulation fits poorly.

    Args:
        identification: estimate by instrumental variables, with its test of least squares.
    """
    # standard deviations of a shift that is worth a word (our choice)
    shift = identification.shift
    min_shift = 1.0
    if (
        not identification.verdict.biased()
        or not identification.valid
        or not identification.explains
        or shift.max() < min_shift
    ):
        return []
    names = [f"{identification.names[k]} by {shift[k]:.2g} σ" for k in np.argsort(-shift)[:5]]
    return [finding("least-squares-biased", p=identification.verdict.p, names=names)]


# of both together, by which a parameter differs surely (our choice)
SIGMAS = 5.0


def disagreement(problem: IdentificationProblem, estimate: MethodEstimate, test: LoopTest) -> LoopDisagreement | None:
    """Return how an output-error estimate (fitted to simulated positions) contradicts the torques; None if it does not.

    Args:
        problem: data and settings of both estimates.
        estimate: the output-error estimate.
        test: test by instrumental variables, whose estimate is the comparison; least squares if it has none.
    """
    if not (estimate.found and estimate.alone and isinstance(estimate, LoopEstimate)):
        return None
    own_estimate = estimate.estimate
    instruments = test.found
    # times the torque that instruments leave unexplained (our choice)
    max_beside_instruments = 1.2
    # the same beside least squares, of which it is the least that there is (our choice)
    max_beside_wls = 2.0
    if instruments is not None and instruments.valid and len(instruments.names) == len(own_estimate.values):
        name = instruments.estimator.name
        iv_estimate = instruments.fit.estimate
        limit = max_beside_instruments
        own_errors = instruments.simulated_error(own_estimate.values)
        beside = instruments.simulated_error(iv_estimate.values)
    else:
        plain = WLS.estimate(problem)
        if not plain.found:
            return None
        name = "wls"
        iv_estimate = plain.estimate
        limit = max_beside_wls
        own_errors = problem.pooled.relative_errors(own_estimate.values)
        beside = problem.pooled.relative_errors(iv_estimate.values)
    sigma = np.hypot(own_estimate.sigma, iv_estimate.sigma)
    away = np.abs(own_estimate.values - iv_estimate.values) / np.maximum(sigma, 1e-300)
    worst = int(np.argmax(away))
    if away[worst] < SIGMAS or not np.any(own_errors > limit * beside):
        return None
    factors = _factors(problem, own_estimate.values, iv_estimate.values)
    parameter = iv_estimate.names[worst]
    sigmas = float(away[worst])
    beside_left = tuple(beside.tolist())
    return LoopDisagreement(estimate.method, name, parameter, sigmas, tuple(own_errors.tolist()), beside_left, factors)


def _factors(problem: IdentificationProblem, estimate: np.ndarray, reference: np.ndarray) -> tuple[float, ...]:
    """Return for each torque row the ratio of two estimates' torques (regression slope).

    Args:
        problem: data and settings.
        estimate, reference: (p,) parameters; the ratios are torques of `estimate` over those of `reference`.
    """
    factors = problem.pooled.factors[:, :, :-1]
    own_values = factors @ estimate
    reference_values = factors @ reference
    products = np.sum(own_values * reference_values, axis=1)
    squares = np.sum(reference_values**2, axis=1)
    ratios = products / np.maximum(squares, 1e-300)
    return tuple(ratios.tolist())


def loop_results(problem: IdentificationProblem, estimate: MethodEstimate) -> LoopResults:
    """Return the results of simulating an estimate's loop, in the form that is stored and printed.

    Args:
        problem: data and settings; without a loop the results are empty.
        estimate: the user's estimate.
    """
    test = compare_with_loop(problem, estimate)
    is_estimate = isinstance(estimate, LoopEstimate) and estimate.instrumental is not None
    table: tuple[tuple[object, ...], ...] = ()
    if test.found is not None:
        table = _table(test.found)
    metrics = _metrics(test, not is_estimate)
    findings = tuple(test.findings(is_estimate))
    controller = None if test.loops is None else test.loops.controller
    return LoopResults(metrics, findings, table, controller, disagreement(problem, estimate, test))


def _metrics(test: LoopTest, beside: bool) -> LoopMetrics:
    """Return the metrics of a test by simulation.

    Args:
        test: result of instrumental variables.
        beside: whether the user's estimate was made by another method.
    """
    identification = test.found
    loops = test.loops
    notes = () if loops is None else loops.notes
    if identification is None or loops is None:
        return LoopMetrics(test.failure, notes, valid=False, explains=False)
    identified = loops.identified
    strength = identification.strength
    distance = identification.apart
    if distance.any():
        notes += (
            f"with the instruments of unbound parameters alone (Janot's form) the estimate is at most "
            f"{distance.max():.2g} σ away, at {identification.names[int(np.argmax(distance))]}",
        )
    shares = np.min([noise.share for noise in identification.noise], axis=0)
    by_joint = np.array2string(100 * shares, formatter={"float": "{:.0f}".format})
    notes = (
        f"share of the position noise that the controller answers, by joint: {by_joint} %; Coulomb signs are averaged "
        "over the noise, simulated in the loop by this share",
        *notes,
    )
    rounds = len(identification.rounds)
    largest_shift_sigma = float(identification.shift.max())
    least_partial_r2 = float(strength.partial_r2.min())
    controller_explains_percent = None if identified is None else identified.explained
    return LoopMetrics(
        "",
        notes,
        identification.estimator.name,
        beside,
        rounds,
        identification.verdict,
        largest_shift_sigma,
        strength.cragg_donald,
        strength.weak,
        least_partial_r2,
        identification.distance,
        identification.direct,
        identification.stray,
        identification.valid,
        identification.explains,
        loops.controller,
        controller_explains_percent,
    )


def _table(identification: Instrumental) -> tuple[tuple[object, ...], ...]:
    """Return a table that compares IV and least-squares estimates of the standard model, one row per parameter.

    Args:
        identification: estimate by instrumental variables, with the least-squares estimate.
    """
    estimate = identification.fit.estimate
    ordinary = identification.ordinary.estimate.values
    explained = 100.0 * identification.strength.partial_r2
    columns = (estimate.values, estimate.sigma, ordinary, identification.shift, explained)
    columns_of_numbers = [column.tolist() for column in columns]
    return tuple(zip(estimate.names, estimate.units, *columns_of_numbers))
