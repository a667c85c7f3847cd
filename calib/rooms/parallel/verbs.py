"""Results on parallel robots: the same members as those of serial arms, where they have a meaning."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.api.rendering import as_text, data_frame
from calib.arguments import checked
from calib.errors import UsageError
from calib.estimation.estimate import Estimate
from calib.procedure.excitation.settings import ExcitationSettings
from calib.procedure.findings import Verdict
from calib.procedure.robot_kinds import Stage
from calib.rooms.parallel import results as folder
from calib.rooms.parallel.design import ParallelDesign
from calib.rooms.parallel.excite import excite_parallel
from calib.rooms.parallel.identification import ParallelOutcome, identify_parallel
from calib.rooms.parallel.loop_fit import ParallelFit, fit_parallel
from calib.rooms.parallel.plan import ParallelPlan, plan_lines, plan_metrics, plan_parallel
from calib.rooms.parallel.robots import ParallelMechanism
from calib.workers.threads import one_blas_thread

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False, repr=False)
class ParallelGeometry:
    """A fitted parallel robot and how far to trust it: what `calib.fit_geometry` returns of one.

    Attributes:
        outcome: all that the fit found.
    """

    outcome: ParallelFit

    @property
    def robot(self) -> ParallelMechanism:
        """The calibrated robot: what identification, excitation and planning take."""
        return ParallelMechanism(self.outcome.found.known, self.outcome.nominal.source)

    @property
    def verdict(self) -> Verdict:
        """Pass, marginal or fail, with the reason."""
        return self.outcome.verdict

    @property
    def estimate(self) -> Estimate:
        """Changes of the loops' constants [m, rad] with their covariance."""
        return self.outcome.found.estimate

    @checked
    def save(self, out: str | Path, *, plots: bool = True) -> Path:
        """Write the folder that `calib fit --out` writes; it has no figures."""
        return folder.write_fitted(self.outcome, Path(out))

    def to_dict(self) -> dict[str, Any]:
        """Return the metrics as ``metrics.json`` holds them."""
        return self.outcome.metrics()

    def to_dataframe(self) -> Any:
        """Return the constants' changes as a pandas DataFrame: name, unit, value, sigma."""
        return _estimated(self.estimate)

    def with_unseen(self, unseen: Sequence[Any]) -> ParallelGeometry:
        """Return the fit judged anew on more files; nothing is fitted again."""
        return ParallelGeometry(self.outcome.with_unseen([Path(one) for one in unseen]))

    def renderables(self) -> Iterator[Any]:
        """Yield what ``print`` shows, for a rich console."""
        yield from self.outcome.lines()
        yield from _judged(self.verdict)

    def __repr__(self) -> str:
        return f"<ParallelGeometry of {self.outcome.nominal.known.robot.name}: {self.verdict.level}>"

    def __str__(self) -> str:
        return as_text(self.renderables())


@dataclass(frozen=True, eq=False, repr=False)
class ParallelDynamics:
    """Identified dynamics of a parallel robot: what `calib.identify_dynamics` returns of one.

    Attributes:
        outcome: all that the identification found.
    """

    outcome: ParallelOutcome

    @property
    def robot(self) -> ParallelMechanism:
        """The robot whose dynamics these are."""
        return self.outcome.robot

    @property
    def verdict(self) -> Verdict:
        """Pass, marginal or fail, with the reason."""
        return self.outcome.verdict

    @property
    def estimate(self) -> Estimate:
        """The base parameters with their covariance."""
        return self.outcome.found.fitted.estimate

    @one_blas_thread()
    def torques(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the rows (N, rows) of a motion q, v, a (N, n) of the actuated joints, no payload on board.

        Torques of the actuators [N m or N]; of redundant ones the forces on the platform's coordinates they share; or
        their power [W]: as the model was identified.
        """
        return self.outcome.model.torque(self.outcome.found.dynamics.values, q, v, a, ())

    @checked
    def save(self, out: str | Path, *, plots: bool = True) -> Path:
        """Write the folder that `calib identify --out` writes."""
        return folder.write_identified(self.outcome, Path(out), plots)

    @one_blas_thread()
    def plot(self) -> dict[str, Figure]:
        """Return the figures by name: measured and predicted rows."""
        return folder.figures(self.outcome)

    def to_dict(self) -> dict[str, Any]:
        """Return the metrics as ``metrics.json`` holds them."""
        return folder.metrics(self.outcome)

    def to_dataframe(self) -> Any:
        """Return the base parameters as a pandas DataFrame: name, unit, value, sigma."""
        return _estimated(self.estimate)

    def with_unseen(self, unseen: Sequence[Any]) -> ParallelDynamics:
        """Return the model judged anew on more recordings; nothing is identified again."""
        return ParallelDynamics(self.outcome.with_unseen(unseen))

    def renderables(self) -> Iterator[Any]:
        """Yield what ``print`` shows, for a rich console."""
        yield from folder.identified_lines(self.outcome)
        yield from _judged(self.verdict)

    def __repr__(self) -> str:
        return (
            f"<ParallelDynamics of {self.robot.known.robot.name}: {len(self.estimate.names)} parameters, "
            f"{self.verdict.level}>"
        )

    def __str__(self) -> str:
        return as_text(self.renderables())


@dataclass(frozen=True, eq=False, repr=False)
class ParallelExcitation:
    """An exciting motion of a parallel robot: what `calib.design_excitation` returns of one.

    Attributes:
        robot: with its file.
        designed: the motion and its proof.
        rate: of the controller [Hz].
    """

    robot: ParallelMechanism
    designed: ParallelDesign
    rate: float

    @checked
    def save(self, out: str | Path, *, plots: bool = True) -> Path:
        """Write the folder that `calib excite --out` writes; it has no figures."""
        return folder.write_designed(self.robot, self.designed, self.rate, Path(out))

    def to_dict(self) -> dict[str, Any]:
        """Return the metrics as ``metrics.json`` holds them."""
        return folder.design_metrics(self.robot, self.designed)

    def __repr__(self) -> str:
        return f"<ParallelExcitation for {self.robot.known.robot.name}: {self.designed.family.period:g} s>"

    def __str__(self) -> str:
        return "\n".join(folder.designed_lines(self.robot, self.designed))


@dataclass(frozen=True, eq=False, repr=False)
class ParallelMotionPlan:
    """The fastest motion of a parallel robot through platform waypoints: what `calib.plan_motion` returns of one.

    Attributes:
        planned: track, margins, and the platform's coordinates along it.
    """

    planned: ParallelPlan

    @property
    def duration(self) -> float:
        """How long the motion takes [s]."""
        return self.planned.duration

    @checked
    def save(self, out: str | Path, *, plots: bool = True) -> Path:
        """Write the folder that `calib plan --out` writes; it has no figures."""
        return folder.write_planned(self.planned, Path(out))

    def to_dict(self) -> dict[str, Any]:
        """Return the metrics as ``metrics.json`` holds them."""
        return plan_metrics(self.planned)

    def __repr__(self) -> str:
        return f"<ParallelMotionPlan for {self.planned.robot.known.robot.name}: {self.duration:g} s>"

    def __str__(self) -> str:
        return "\n".join(plan_lines(self.planned))


def _estimated(found: Estimate) -> Any:
    rows = zip(found.names, found.units, found.values.tolist(), found.sigma.tolist())
    return data_frame(rows, ["name", "unit", "value", "sigma"])


def _judged(verdict: Verdict) -> Iterator[Any]:
    from calib.procedure.report.console import section
    from calib.procedure.report.page import Section

    yield from section(Section("", (), verdict.level, verdict.reason))


def _fit(
    robot: ParallelMechanism, measured: Sequence[Any], validate: Sequence[Any], *, poses: object = None, **others: Any
) -> ParallelGeometry:
    if poses is not None:
        raise UsageError("poses of a parallel robot are not chosen here, so that nothing was predicted of its fit")
    return ParallelGeometry(
        fit_parallel(robot, *([_file(one) for one in part] for part in (measured, validate)), **others)
    )


def _file(measured: Any) -> Path:
    if not isinstance(measured, (str, Path)):
        raise UsageError("a parallel robot's measurements are CSV files (calib formats parallel), not values in memory")
    return Path(measured)


def _identify(robot: ParallelMechanism, *given: Any, **others: Any) -> ParallelDynamics:
    return ParallelDynamics(identify_parallel(robot, *given, **others))


def _excite(robot: ParallelMechanism, settings: ExcitationSettings, **others: Any) -> ParallelExcitation:
    return ParallelExcitation(robot, excite_parallel(robot, settings, **others), settings.rate)


def _plan(robot: ParallelMechanism, *given: Any, **others: Any) -> ParallelMotionPlan:
    return ParallelMotionPlan(plan_parallel(robot, *given, **others))


STAGES = {
    "parallel robot": {
        "fit": Stage(_fit, folder.check_fitted),
        "identify": Stage(_identify, folder.check_identified),
        "excite": Stage(_excite, folder.check_moved),
        "plan": Stage(_plan, folder.check_moved),
    }
}
