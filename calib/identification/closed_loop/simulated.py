"""Methods that simulate the closed loop of a recording: instrumental variables, and DIDIM."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from calib.dynamics.drives import DriveTerm
from calib.errors import CalibError, Finding, UsageError, finding
from calib.estimation.triangles import Triangles
from calib.identification.closed_loop.instrumental import Instrumental, identify_instrumental, sign_noise
from calib.identification.closed_loop.loop_recordings import ClosedLoops, close_loops
from calib.identification.closed_loop.simulation import simulable
from calib.identification.loop import LoopDisagreement, LoopMetrics, LoopResults
from calib.identification.methods.estimators import CONSISTENT, CONSTRAINED
from calib.identification.methods.least_squares import WLS
from calib.identification.methods.method import IdentificationProblem, Method, MethodEstimate, attempted
from calib.identification.methods.parameter_constraints import constraints_of


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
        """Return R factors on which least squares gives this estimate, with std and inflation (g,), for tests."""
        own = self.instrumental
        if own is None:
            return super().testable()
        return own.problem.testable(own.fit, own.std), np.ones(1), np.array([own.inflation])


def attempted_in_loop(
    method: str, problem: IdentificationProblem, loops: ClosedLoops, run: Callable[[], MethodEstimate]
) -> LoopEstimate:
    """Return the result of `run` on a problem with its loops and computing time; a failure is returned as a status."""
    found = attempted(method, problem, run)
    if isinstance(found, LoopEstimate):
        return found
    return LoopEstimate(**vars(found), loops=loops)


@dataclass(frozen=True)
class _Simulated(Method):
    """A method that simulates the closed loop.

    Attributes:
        instruments: its use of the simulated motion, see `calib.identification.closed_loop.instrumental.ROUNDS`;
            "": by the loop's settings.
    """

    needs_controller: bool = field(default=True, kw_only=True)
    needs_simulation: bool = field(default=True, kw_only=True)
    tunes: tuple[str, ...] = field(default=("tolerance 2.5 %", "10 rounds"), kw_only=True)
    instruments: str = ""

    def estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        """Return the estimate of the base columns, with row weights and variance inflation from WLS.

        Raises:
            UsageError, MeasurementError: for a loop or recordings that no simulation can start from.
        """
        if problem.loop is None or not simulable(problem.model):
            raise UsageError(f"method '{self.name}' needs a [loop], and a robot that can be simulated")
        plain = WLS.estimate(problem)
        if not plain.found:
            return replace(plain, method=self.name)
        richer = [one for one in problem.terms[problem.base.b :] if one is not None]
        found = self.beside(problem, plain, richer)
        return replace(found, seconds=plain.seconds + found.seconds)

    def beside(
        self, problem: IdentificationProblem, plain: MethodEstimate, terms: Sequence[DriveTerm] = ()
    ) -> LoopEstimate:
        """Return the estimate, starting from the least-squares estimate `plain`, with the richer friction `terms`."""
        model: Any = problem.model
        loop = problem.loop
        if loop is None or not simulable(model):
            raise UsageError("instruments from simulation need a [loop], and a robot that can be simulated")
        loops = close_loops(model, problem.cases, problem.decimator, loop, problem.cad)
        inertia = loop.per_joint("inertia", model.n) if loop.inertia else None

        def estimate() -> LoopEstimate:
            found = identify_instrumental(
                model,
                problem.base,
                loops.pairs,
                problem.decimator,
                method=self.instruments or loop.instruments,
                inertia=inertia,
                positive=loop.positive,
                terms=terms,
                constraints=constraints_of(problem) if self.takes_constraints else None,
            )
            result = replace(
                plain,
                method=self.name,
                solution=found.fit,
                std=found.std,
                iterations=len(found.rounds),
                simulations=len(loops.pairs) * sum(1 + one.retreats for one in found.rounds),
                beforehand=None,
                held=found.constrained,
                instruments=found.rows,
            )
            return LoopEstimate(**{**vars(result), "loops": loops, "instrumental": found})

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
    description="least squares on the simulated motion alone (the slides' CLIE)",
    source="Gautier, Janot & Vandanjon 2013",
)
PC_IV, PC_DIDIM = (
    replace(
        one,
        name=f"pc-{one.name}",
        assumes=one.assumes + CONSISTENT,
        instruments=one.name,
        takes_constraints=True,
        description=one.name + CONSTRAINED,
        source=source,
    )
    for one, source in ((IV, "Janot & Wensing 2021"), (DIDIM, "Leboutet et al. 2021"))
)
METHODS = (IV, DIDIM, PC_IV, PC_DIDIM)


@dataclass(frozen=True, eq=False)
class LoopTest:
    """Result of instrumental variables from simulation.

    Attributes:
        found: their estimate of the standard model, with the test of least squares; None if they failed.
        loops: the simulated closed loops.
        failure: reason for a missing estimate.
    """

    found: Instrumental | None = None
    loops: ClosedLoops | None = None
    failure: str = ""

    def findings(self, taken: bool) -> list[Finding]:
        """Return the findings for a user of this estimate, or (`taken` False) of a least-squares one."""
        if self.found is None or self.loops is None:
            return [finding("loop-test-failed", why=self.failure)]
        noticed = [*_weakness(self.found), *(_distance(self.found) or _gains(self.found) or _torques(self.found))]
        return noticed + (_blurred(self.found, self.loops) if taken else _biased(self.found))


def compare_with_loop(problem: IdentificationProblem, estimate: MethodEstimate) -> LoopTest:
    """Return the result of instrumental variables for an estimate whose closed loop is described in the options.

    An estimate that came from them is the comparison itself; beside another method's, their failure is reported.
    """
    found = estimate if isinstance(estimate, LoopEstimate) and estimate.instrumental is not None else None
    if found is None:
        try:
            found = IV.beside(problem, estimate)
        except CalibError as error:
            return LoopTest(failure=str(error))
    return LoopTest(found.instrumental, found.loops, "" if found.found else str(found.failure))


def _weakness(found: Instrumental) -> list[Finding]:
    strength = found.strength
    if not strength.weak:
        return []
    least = np.argsort(strength.partial_r2)[:5]
    names = [f"{strength.names[k]} ({100 * strength.partial_r2[k]:.2g} %)" for k in least]
    return [finding("weak-instruments", donald=strength.cragg_donald, names=names)]


def _distance(found: Instrumental) -> list[Finding]:
    # [%] of a joint's motion by which the simulated robot may miss the recorded one (our choice)
    max_miss = 10.0
    joints = [f"{x:.3g} % at joint {j + 1}" for j, x in enumerate(found.distance) if not x < max_miss]
    if joints:
        return [finding("loop-not-followed", joints=joints)]
    return []


def _gains(found: Instrumental) -> list[Finding]:
    """Return the finding on joints whose given gains differ from the gains in the recording."""
    joints = [f"{found.stray[j]:.2g} times at joint {j + 1}" for j in found.off]
    return [finding("loop-gains-off", joints=joints)] if joints else []


def _torques(found: Instrumental) -> list[Finding]:
    """Return the finding on torque rows that the simulated motion does not explain, though the measured one does."""
    case = found.rows[0][0]
    direct = found.direct
    own = found.own
    labels = case.torque_rows.numbered(case.motion.n)
    rows = [f"{direct[k]:.3g} % for {own[k]:.3g} % at joint {labels[k]}" for k in found.unexplained]
    return [finding("loop-unexplained", rows=rows)] if rows else []


def _biased(found: Instrumental) -> list[Finding]:
    """Return the finding on a bias of least squares; none if the bias is small or the simulated loop fits poorly."""
    # standard deviations of a shift that is worth a word (our choice)
    shift = found.shift
    min_shift = 1.0
    if not found.verdict.biased() or not found.valid or not found.explains or shift.max() < min_shift:
        return []
    names = [f"{found.names[k]} by {shift[k]:.2g} σ" for k in np.argsort(-shift)[:5]]
    return [finding("least-squares-biased", p=found.verdict.p, names=names)]


def _blurred(found: Instrumental, loops: ClosedLoops) -> list[Finding]:
    """Return the finding on joints whose Coulomb sign is mainly velocity noise, which instruments cannot correct."""
    if not found.estimator.measured:
        return []
    # widths of the sign (our choice)
    noise = sign_noise(found.plant, loops.pairs[0][0].motion)
    max_blur = 3.0
    signs = [one for one in found.plant.terms if one.shape == "sign"]
    blurred = {one.name: noise[one.acts[0][0]] / one.settings[-1] for one in signs}
    joints = [f"{size:.2g} at {name}" for name, size in blurred.items() if size > max_blur]
    return [finding("noisy-signs", joints=joints)] if joints else []


# of both together, by which a parameter differs surely (our choice)
SIGMAS = 5.0


def disagreement(problem: IdentificationProblem, found: MethodEstimate, test: LoopTest) -> LoopDisagreement | None:
    """Return the disagreement of an output-error estimate with the recorded torques; None if both agree.

    Args:
        problem: of both.
        found: the estimate.
        test: result of instruments; least squares replaces it if absent.
    """
    if not (found.found and found.alone and isinstance(found, LoopEstimate)):
        return None
    own = found.estimate
    instruments = test.found
    # times the torque that instruments leave unexplained (our choice)
    max_beside_instruments = 1.2
    # the same beside least squares, of which it is the least that there is (our choice)
    max_beside_wls = 2.0
    if instruments is not None and instruments.valid and len(instruments.names) == len(own.values):
        name = instruments.estimator.name
        other = instruments.fit.estimate
        limit = max_beside_instruments
        left, beside = (instruments.simulated_error(x.values) for x in (own, other))
    else:
        plain = WLS.estimate(problem)
        if not plain.found:
            return None
        name = "wls"
        other = plain.estimate
        limit = max_beside_wls
        left, beside = (problem.pooled.relative_errors(x.values) for x in (own, other))
    away = np.abs(own.values - other.values) / np.maximum(np.hypot(own.sigma, other.sigma), 1e-300)
    worst = int(np.argmax(away))
    if away[worst] < SIGMAS or not np.any(left > limit * beside):
        return None
    return LoopDisagreement(
        found.method,
        name,
        other.names[worst],
        float(away[worst]),
        tuple(left.tolist()),
        tuple(beside.tolist()),
        _factors(problem, own.values, other.values),
    )


def _factors(problem: IdentificationProblem, own: np.ndarray, other: np.ndarray) -> tuple[float, ...]:
    """Return for each torque row the ratio (regression slope) of the torques of two estimates."""
    factors = problem.pooled.factors[:, :, :-1]
    mine = factors @ own
    theirs = factors @ other
    return tuple(map(float, np.sum(mine * theirs, axis=1) / np.maximum(np.sum(theirs**2, axis=1), 1e-300)))


def loop_results(problem: IdentificationProblem, estimate: MethodEstimate) -> LoopResults:
    """Return the results of an estimate's loop test, in the form that is stored and printed."""
    test = compare_with_loop(problem, estimate)
    taken = isinstance(estimate, LoopEstimate) and estimate.instrumental is not None
    return LoopResults(
        _metrics(test, not taken),
        tuple(test.findings(taken)),
        () if test.found is None else _table(test.found),
        test.loops and test.loops.controller,
        disagreement(problem, estimate, test),
    )


def _metrics(test: LoopTest, beside: bool) -> LoopMetrics:
    """Return the metrics of a test by simulation."""
    found = test.found
    loops = test.loops
    notes = () if loops is None else loops.notes
    if found is None or loops is None:
        return LoopMetrics(test.failure, notes, valid=False, explains=False)
    identified = loops.identified
    strength = found.strength
    apart = found.apart
    if apart.any():
        notes += (
            f"with the instruments of unbound parameters alone (Janot's slides) the estimate is at most "
            f"{apart.max():.2g} σ away, at {found.names[int(np.argmax(apart))]}",
        )
    return LoopMetrics(
        "",
        notes,
        found.estimator.name,
        beside,
        len(found.rounds),
        found.verdict,
        float(found.shift.max()),
        strength.cragg_donald,
        strength.weak,
        float(strength.partial_r2.min()),
        found.distance,
        found.direct,
        found.stray,
        found.valid,
        found.explains,
        loops.controller,
        identified and identified.explained,
    )


def _table(found: Instrumental) -> tuple[tuple[Any, ...], ...]:
    """Return the rows of both estimates of the standard model, one for each parameter."""
    estimate = found.fit.estimate
    columns = (estimate.values, estimate.sigma, found.ordinary.estimate.values, found.shift)
    explained = 100.0 * found.strength.partial_r2
    return tuple(zip(estimate.names, estimate.units, *(one.tolist() for one in (*columns, explained))))
