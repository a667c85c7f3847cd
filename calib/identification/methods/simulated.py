"""Methods that simulate the closed loop of a recording: instrumental variables, and DIDIM."""

from dataclasses import dataclass, field, replace

from calib.dynamics.idim import IdentificationModel
from calib.errors import UsageError
from calib.identification.loop.loop_recordings import ClosedLoops, close_loops
from calib.identification.loop.loop_settings import LoopSettings
from calib.identification.methods.instrumental import identify_instrumental
from calib.identification.methods.least_squares import CONSISTENT, CONSTRAINED, WLS
from calib.identification.methods.method import IdentificationProblem, Method, MethodEstimate, attempted


@dataclass(frozen=True)
class _Simulated(Method):
    """A method that simulates the closed loop.

    Attributes:
        instruments: its use of the simulated motion, see `calib.identification.methods.instrumental.ROUNDS`;
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

    def beside(self, problem: IdentificationProblem, plain: MethodEstimate) -> MethodEstimate:
        """Return the estimate, starting from the least-squares estimate `plain`."""
        model, loop = problem.model, problem.loop
        if loop is None or not isinstance(model, IdentificationModel) or not model.torque_rows.motors_alone:
            raise UsageError("instruments from simulation support motor torques only")
        loops = close_loops(model.bodies, problem.cases, problem.decimator, loop, problem.cad)
        return attempted(self.name, problem, lambda: self._estimate(problem, plain, model, loop, loops), loops)

    def _estimate(
        self, problem: IdentificationProblem, plain: MethodEstimate, model: IdentificationModel, loop: LoopSettings,
        loops: ClosedLoops,
    ) -> MethodEstimate:  # fmt: skip
        found = identify_instrumental(
            model, problem.base, loops.pairs, problem.decimator, method=self.instruments or loop.instruments,
            inertia=loop.per_joint("inertia", model.n) if loop.inertia else None, positive=loop.positive,
            constraints=problem.constrained if self.takes_constraints else None,
        )  # fmt: skip
        return replace(
            plain, method=self.name, solution=found.fit, std=found.std, iterations=len(found.rounds),
            simulations=len(loops.pairs) * sum(1 + one.retreats for one in found.rounds), beforehand=None,
            instrumental=found, loops=loops, held=found.constrained,
        )  # fmt: skip


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
