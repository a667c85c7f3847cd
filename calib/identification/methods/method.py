"""Interface of identification methods: from a problem to an estimate with its status.

A failure is a status, not an exception, since studies compare methods under conditions in which some of them fail. The
estimate contains the error with its advice, and `MethodEstimate.fit` raises it.
"""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property

import numpy as np

from calib.data.signals.filtering import Decimator
from calib.dynamics.base import Base
from calib.dynamics.drives import DriveTerm
from calib.dynamics.regressor_model import RegressorModel
from calib.dynamics.torque_rows import POWER, TorqueRows
from calib.errors import CannotSimulate, Diverged, NotConverged, Unidentifiable
from calib.estimation.estimate import Estimate, whitened
from calib.estimation.linear import LinearFit
from calib.estimation.triangles import Triangles, empty, retriangulate
from calib.identification.loop import LoopSettings
from calib.identification.methods.constraint_settings import ConstraintSettings, Held
from calib.identification.prior import Prior
from calib.identification.rows import Case, ObservationRows, pool, triangulate
from calib.records import frozen


class EstimateStatus(Enum):
    """Outcome of an estimation."""

    FOUND = "found"
    CANNOT_BE_SIMULATED = "cannot be simulated"
    DIVERGED = "diverged"
    NOT_CONVERGED = "not converged"
    RANK_DEFICIENT = "rank deficient"


_STATUS = (
    (Unidentifiable, EstimateStatus.RANK_DEFICIENT),
    (CannotSimulate, EstimateStatus.CANNOT_BE_SIMULATED),
    (Diverged, EstimateStatus.DIVERGED),
    (NotConverged, EstimateStatus.NOT_CONVERGED),
)


@dataclass(frozen=True, eq=False)
class IdentificationProblem:
    """The data and settings of an estimation.

    Attributes:
        model: model with standard friction.
        base: base parameters of the model.
        cases: recordings with their motion at the full rate.
        decimator: filter and decimation of all rows.
        rows: observation matrix and torques of each case; p columns, base columns first, then additional friction.
        terms: (p,) drive term of each column; None for parameters of bodies.
        groups: (p,) ridge group of each column of additional friction; -1 for base columns.
        noise: (rows,) standard deviation of the torques' noise, up to a common factor; None: from the residuals.
        prior: prior of the base parameters; None without one.
        loop: the closed loop in which the recordings were made; None if not stated.
        cad: standard parameters of the bodies from the robot's description, for a loop that feeds them forward; None:
            unknown.
        constraints: constraints of the options, for methods that support them; None: the defaults.
        start: (p,) start values of methods that simulate; None: least squares, if that robot can be simulated.
        progress: called with a short text at each round of a method that simulates; None: not called.
        ridges: (p,) ridges that an earlier identification chose; NaN or None: chosen by evidence.
    """

    model: RegressorModel
    base: Base
    cases: Sequence[Case]
    decimator: Decimator
    rows: tuple[ObservationRows, ...]
    terms: tuple[DriveTerm | None, ...]
    groups: np.ndarray
    noise: np.ndarray | None = None
    prior: Prior | None = None
    loop: LoopSettings | None = None
    cad: np.ndarray | None = None
    constraints: ConstraintSettings | None = None
    start: np.ndarray | None = None
    progress: Callable[[str], None] | None = None
    ridges: np.ndarray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "groups", frozen(self.groups, int))

    def say(self, text: str) -> None:
        """Call `progress`, if there is one, with a short text."""
        if self.progress is not None:
            self.progress(text)

    @cached_property
    def pooled(self) -> Triangles:
        """R factors of all rows, one group per torque row."""
        data = triangulate(self.rows)
        rows = self.rows[0].target.shape[1]
        return pool(data, rows)

    @property
    def nonnegative(self) -> np.ndarray:
        """Mask (p,) of columns whose parameters must not be negative: inertia and friction of drives."""
        return np.array([term is not None and term.nonnegative for term in self.terms], dtype=bool)

    @property
    def exact(self) -> np.ndarray:
        """Mask (p,) of columns that have no noise from measured positions: constants and signs."""
        exact = [term is not None and term.form.exact for term in self.terms]
        return np.array(exact, dtype=bool)


@dataclass(frozen=True, eq=False)
class MethodEstimate:
    """Result of a method on a problem.

    Attributes:
        method: name of the method.
        status: outcome of the estimation.
        solution: values with covariance, and details of the fit; None after a failure.
        pooled: R factors of all rows, one group per torque row.
        std: (rows,) standard deviation by which each row is weighted: that of its residuals, unless stated.
        inflation: (rows,) variance inflation (number of rows that count as one), from the residuals' autocorrelation.
        weighted: whether the rows were weighted with `std` (all methods but OLS).
        beforehand: (k, p) whitened rows of the prior and ridges, which are added to those of the data; None without
            these.
        iterations: number of iterations; 1 for a method that does not iterate.
        simulations: number of closed-loop simulations.
        seconds: computing time.
        failure: reason for a missing solution, with advice; None without a failure.
        held: the constraints and which of them bind; None for a method without constraints.
        alone: whether least squares with `pooled` does not give this estimate, so that only values and covariance
            describe it.
        instruments: for a method with instruments, by recording: the case whose motion W describes, its rows, and Z in
            the form of `ObservationRows.matrix`; () for other methods.
    """

    method: str
    status: EstimateStatus
    solution: LinearFit | None
    pooled: Triangles
    std: np.ndarray
    inflation: np.ndarray
    weighted: bool = True
    beforehand: np.ndarray | None = None
    iterations: int = 1
    simulations: int = 0
    seconds: float = 0.0
    failure: Unidentifiable | NotConverged | None = None
    held: Held | None = None
    alone: bool = False
    instruments: tuple[tuple[Case, ObservationRows, np.ndarray], ...] = ()

    @property
    def found(self) -> bool:
        """Whether there is a solution."""
        return self.status is EstimateStatus.FOUND

    @property
    def fit(self) -> LinearFit:
        """Values with covariance, and details of the fit.

        Raises:
            Unidentifiable, NotConverged: after a failure.
        """
        if self.solution is None:
            raise self.failure or NotConverged(f"{self.method}: {self.status.value}")
        return self.solution

    @property
    def estimate(self) -> Estimate:
        """Values with covariance.

        Raises:
            Unidentifiable, NotConverged: after a failure.
        """
        return self.fit.estimate

    def testable(self) -> tuple[Triangles, np.ndarray, np.ndarray]:
        """Return R factors whose least-squares solution is this estimate, for tests of nested models.

        Returns:
            R factors of g groups, standard deviations (g,), and variance inflations (g,).
        """
        if self.alone:
            return _equivalent_triangle(self.estimate), np.ones(1), np.ones(1)
        if self.beforehand is None:
            return self.pooled, self.std, self.inflation
        # The prior is one more group of rows.
        with_target = np.pad(self.beforehand, ((0, 0), (0, 1)))
        prior_factor = retriangulate(with_target)
        factors = np.concatenate([self.pooled.factors, prior_factor[None]])
        counts = [*self.pooled.rows, len(self.beforehand)]
        rows = frozen(counts, int)
        data = replace(self.pooled, factors=frozen(factors), rows=rows)
        return data, np.append(self.std, 1.0), np.append(self.inflation, 1.0)


def _equivalent_triangle(estimate: Estimate) -> Triangles:
    """Return the R factor of one group whose least-squares solution is a given estimate with its covariance."""
    p = len(estimate.values)
    freedom = max(estimate.dof, 1)
    factor = np.zeros((1, p + 1, p + 1))
    triangle = retriangulate(whitened(estimate.values, estimate.covariance))
    factor[0, :p] = triangle[:p]
    factor[0, p, p] = np.sqrt(freedom)
    no_rows = empty(estimate.names, estimate.units, 1)
    factors = frozen(factor)
    rows = frozen([freedom + p], int)
    return replace(no_rows, factors=factors, rows=rows)


@dataclass(frozen=True)
class Method(ABC):
    """An identification method, which returns an estimate for a problem.

    The flags determine which steps around a method (prior, additional friction, stated noise, elimination) are made.

    Attributes:
        name: name in options and files.
        assumes: assumptions of the estimate, for the user.
        description: one line.
        source: authors and year.
        tunes: settings chosen beforehand, not estimated from the data; () without any.
        version: number to be raised whenever the same data give another estimate or number of iterations; results that
            studies stored before are then discarded and computed again.
        takes_prior: whether it uses a prior, ridges of additional friction, and a stated noise of the rows.
        needs_controller: whether it simulates the closed loop of a recording.
        takes_start: whether its estimate depends on the problem's start values.
        needs_simulation: whether it needs a model whose motion can be computed from torques.
        takes_models: whether it supports joint torque sensors and additional friction; otherwise motor torques and
            standard friction only.
        takes_constraints: whether its estimate satisfies the options' [constraints].
        auto_friction: meaning of friction = "auto" for this method: auto (chosen by least squares) or standard.
    """

    name: str
    assumes: str
    description: str = field(kw_only=True)
    source: str = field(kw_only=True)
    tunes: tuple[str, ...] = field(default=(), kw_only=True)
    version: int = field(default=1, kw_only=True)
    takes_prior: bool = field(default=False, kw_only=True)
    needs_controller: bool = field(default=False, kw_only=True)
    takes_start: bool = field(default=False, kw_only=True)
    needs_simulation: bool = field(default=False, kw_only=True)
    takes_models: bool = field(default=True, kw_only=True)
    takes_constraints: bool = field(default=False, kw_only=True)
    auto_friction: str = field(default="auto", kw_only=True)

    @abstractmethod
    def estimate(self, problem: IdentificationProblem) -> MethodEstimate:
        """Return the estimate of the problem's p columns, or a failure as a status with its reason."""

    def takes(self, rows: TorqueRows) -> bool:
        """Return whether the method supports these torque rows; methods that simulate need rows with bodies."""
        simulable = rows.has_bodies and rows != POWER
        return rows.motors_alone or (self.takes_models and (simulable or not self.needs_simulation))

    def __str__(self) -> str:
        text = f"{self.name:14} {self.description} ({self.source})"
        if self.needs_controller:
            text += "; needs the loop"
        elif self.needs_simulation:
            text += "; needs simulation"
        if self.tunes:
            text += f"; tuned: {', '.join(self.tunes)}"
        return text


def attempted(method: str, problem: IdentificationProblem, run: Callable[[], MethodEstimate]) -> MethodEstimate:
    """Return the result of `run` with its computing time; a failure of the estimation becomes a status.

    Args:
        method: name of the method.
        problem: data and settings, with which a failure is recorded.
        run: function that makes the estimate.
    """
    began = time.perf_counter()
    try:
        estimate = run()
    except (Unidentifiable, NotConverged) as error:
        status = next(status for kind, status in _STATUS if isinstance(error, kind))
        unknown = np.full(problem.pooled.groups, np.nan)
        estimate = MethodEstimate(method, status, None, problem.pooled, unknown, unknown, failure=error)
    return replace(estimate, seconds=time.perf_counter() - began)
