"""Motions in Python: design exciting ones, plan time-optimal ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib.api.dynamic import DynamicsModel
from calib.api.kinematic import saved
from calib.procedure.excitation import design, folder, planning
from calib.procedure.excitation.settings import ExcitationSettings, PlanSettings
from calib.robot.calibrated import CalibratedChain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class ExcitationDesign:
    """A motion that shows a robot's dynamics, proved to keep its limits. ``print`` shows condition numbers and margins.

    Attributes:
        designed: the motion, its proof, goals and search history.
    """

    designed: design.Designed

    def save(self, out: str | Path, *, plots: bool = True) -> Path:
        """Write the folder that `calib excite --out` writes: trajectory.csv, ROS 2 messages, metrics, figures."""
        from calib.procedure.report import motion_figures

        return folder.write_design(self.designed, Path(out), motion_figures.write_design if plots else None)

    def plot(self) -> dict[str, Figure]:
        """Return the figures by name: motion, tool path, search, front."""
        from calib.procedure.report import motion_figures

        return motion_figures.design_figures(self.designed)

    def to_dict(self) -> dict[str, Any]:
        """Return the metrics as ``metrics.json`` holds them."""
        return design.metrics(self.designed)

    def __str__(self) -> str:
        return "\n".join(folder.design_lines(self.designed))


@dataclass(frozen=True, eq=False)
class MotionPlan:
    """The fastest motion through waypoints, within speeds and torques. ``print`` shows duration and margins.

    Attributes:
        planned: track, margins, and how it was found.
    """

    planned: planning.Planned

    def save(self, out: str | Path, *, plots: bool = True) -> Path:
        """Write the folder that `calib plan --out` writes."""
        from calib.procedure.report import motion_figures

        return folder.write_plan(self.planned, Path(out), motion_figures.write_plan if plots else None)

    def plot(self) -> dict[str, Figure]:
        """Return the figures by name: motion and speed profile."""
        from calib.procedure.report import motion_figures

        return motion_figures.plan_figures(self.planned)

    def to_dict(self) -> dict[str, Any]:
        """Return the metrics as ``metrics.json`` holds them."""
        return folder.plan_metrics(self.planned)

    def __str__(self) -> str:
        return "\n".join(folder.plan_lines(self.planned))
