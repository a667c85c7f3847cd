"""Methods that simulate the closed loop of a recording: instrumental variables, and DIDIM."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from calib.dynamics.idim import IdentificationModel
from calib.errors import UsageError
from calib.estimation.triangles import Triangles
from calib.identification.loop import LoopSettings
from calib.identification.methods.least_squares import CONSISTENT, CONSTRAINED, WLS
from calib.identification.methods.method import IdentificationProblem, Method, MethodEstimate, attempted
from calib.rooms.closed_loop.instrumental import Instrumental, identify_instrumental
from calib.rooms.closed_loop.loop_recordings import ClosedLoops, close_loops


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
        """Return triangles on which least squares gives this estimate, with std and inflation (g,), for tests."""
        if (own := self.instrumental) is None:
            return super().testable()
        return own.problem.testable(own.fit, own.std), np.ones(1), np.array([own.inflation])


def attempted_in_loop(
    method: str, problem: IdentificationProblem, loops: ClosedLoops, run: Callable[[], MethodEstimate]
) -> LoopEstimate:
    """Return the result of `run` on a problem with its loops and computing time; a failure is returned as a status."""
    found = attempted(method, problem, run)
    return found if isinstance(found, LoopEstimate) else LoopEstimate(**vars(found), loops=loops)


@dataclass(frozen=True)
class _Simulated(Method):
    """A method that simulates the closed loop.

    Attributes:
        instruments: its use of the simulated motion, see `calib.rooms.closed_loop.instrumental.ROUNDS`;
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
        if problem.loop is None or not isinstance(problem.model, IdentificationModel):
            raise UsageError(f"method '{self.name}' needs a [loop], and a robot that can be simulated")
        plain = WLS.estimate(problem)
        if not plain.found:
            return replace(plain, method=self.name)
        found = self.beside(problem, plain)
        return replace(found, seconds=plain.seconds + found.seconds)

    def beside(self, problem: IdentificationProblem, plain: MethodEstimate) -> LoopEstimate:
        """Return the estimate, starting from the least-squares estimate `plain`."""
        model, loop = problem.model, problem.loop
        if loop is None or not isinstance(model, IdentificationModel) or not model.torque_rows.motors_alone:
            raise UsageError("instruments from simulation support motor torques only")
        loops = close_loops(model.bodies, problem.cases, problem.decimator, loop, problem.cad)
        return attempted_in_loop(self.name, problem, loops, lambda: self._estimate(problem, plain, model, loop, loops))

    def _estimate(
        self, problem: IdentificationProblem, plain: MethodEstimate, model: IdentificationModel, loop: LoopSettings,
        loops: ClosedLoops,
    ) -> MethodEstimate:  # fmt: skip
        found = identify_instrumental(
            model, problem.base, loops.pairs, problem.decimator, method=self.instruments or loop.instruments,
            inertia=loop.per_joint("inertia", model.n) if loop.inertia else None, positive=loop.positive,
            constraints=problem.constrained if self.takes_constraints else None,
        )  # fmt: skip
        result = replace(
            plain, method=self.name, solution=found.fit, std=found.std, iterations=len(found.rounds),
            simulations=len(loops.pairs) * sum(1 + one.retreats for one in found.rounds), beforehand=None,
            held=found.constrained,
        )  # fmt: skip
        return LoopEstimate(**{**vars(result), "loops": loops, "instrumental": found})


IV = _Simulated(
    "iv", "the stated controller, reference and friction model are those of the robot",
    description="instrumental variables from the simulated closed loop", source="Janot, Vandanjon & Gautier 2014",
)  # fmt: skip
DIDIM = _Simulated(
    "didim",
    "the simulated robot moves like the real one: stated controller, reference and friction model are those of the "
    "robot; measured positions are not used",
    "didim",
    description="least squares on the simulated motion alone (the slides' CLIE)",
    source="Gautier, Janot & Vandanjon 2013",
)
PC_IV, PC_DIDIM = (
    replace(
        one, name=f"pc-{one.name}", assumes=one.assumes + CONSISTENT, instruments=one.name, takes_constraints=True,
        description=one.name + CONSTRAINED, source=source,
    )
    for one, source in ((IV, "Janot & Wensing 2021"), (DIDIM, "Leboutet et al. 2021"))
)  # fmt: skip
METHODS = (IV, DIDIM, PC_IV, PC_DIDIM)
