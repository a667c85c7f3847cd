"""Design of exciting motions, and planning of time-optimal motions, in Python."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from calib.api.dynamic import DynamicsModel
from calib.api.rendering import ChartedResult, Progress, WithoutVerdict, charts_of, optional, saved
from calib.arguments import checked
from calib.config import Tables
from calib.config_types import Plots
from calib.data.poses.pose_lists import Targets
from calib.errors import TaskLost, UsageError, as_ours, require
from calib.identification.identify_options import IdentifyOptions, IdentifySettings, options_of, read_options
from calib.procedure.excitation import design, folder, planning, stored_front
from calib.procedure.excitation.settings import DEFAULT_DESIGN, DEFAULT_PLAN, ExcitationSettings, PlanSettings
from calib.procedure.robot_kinds import Mechanism, MechanismResult, stage_of
from calib.records import as_subclass
from calib.result_kinds import BY_NAME
from calib.robot.calibrated import CalibratedChain
from calib.trajectories.setpoints import Setpoints

if TYPE_CHECKING:
    from calib.procedure.report.figures.charts import Chart

Sampled = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _columns(track: Setpoints) -> Sampled:
    return track.times, track.q, track.v, track.a


class ExcitationDesign(ChartedResult, WithoutVerdict, design.Designed):
    """A motion that excites a robot's dynamics, verified within limits.

    ``print`` shows condition numbers and margins to the limits.
    """

    kind = BY_NAME["excitation"]
    tab = "period condition goals proof outlook predicted front notes sampled plot save to_dict"

    def sampled(self, rate: float | None = None) -> Sampled:
        """Return t (N,) [s] and q, v, a (N, n) [rad or m, per s, per s²] of one period, both ends included.

        The samples are at `rate` [Hz]; without it they are those that `save` writes, at the controller's rate. Samples
        at any rate are computed from the series of the motion, not interpolated.
        """
        return _columns(folder.one_period(self, rate))

    @checked
    def save(self, out: str | Path, *, plots: Plots = True) -> Path:
        """Write the result folder, with the same files as `calib excite --out`, and return its path.

        The files are trajectory.csv, ROS 2 messages, metrics and figures.

        Args:
            out: folder to write; an earlier result of the same kind in it is replaced.
            plots: False: no figures, True: in the page, ``png`` or ``svg``: as files, too.
        """
        from calib.procedure.report import outputs

        draw = partial(outputs.write_design, plots=plots) if plots else None
        return folder.write_design(self, Path(out), draw)

    def charts(self) -> dict[str, Chart]:
        """Return the charts of the figures by name: motion, tool path, search, Pareto front."""
        from calib.procedure.report import motion_figures

        return charts_of(motion_figures.design_figures(self))

    def to_dict(self) -> dict[str, object]:
        """Return the metrics of the result, the content of ``metrics.json``."""
        return folder.design_metrics(self)

    def __repr__(self) -> str:
        return f"<ExcitationDesign for {self.inputs.chain.name}: {self.period:g} s>"

    def __str__(self) -> str:
        return "\n".join(folder.design_lines(self))


class MotionPlan(ChartedResult, WithoutVerdict, planning.Planned):
    """The fastest motion through waypoints, within limits on speeds and torques.

    ``print`` shows the duration and the margins to the limits.
    """

    kind = BY_NAME["plan"]
    tab = "duration track margins deviation sigma notes sampled plot save to_dict"

    @property
    def duration(self) -> float:
        """Duration of the motion [s]."""
        return self.track.duration

    def sampled(self) -> Sampled:
        """Return t (N,) [s] and q, v, a (N, n) [rad or m, per s, per s²] at the controller's rate (`PlanSettings`)."""
        return _columns(self.track)

    @checked
    def save(self, out: str | Path, *, plots: Plots = True) -> Path:
        """Write the result folder, with the same files as `calib plan --out`, and return its path.

        Args:
            out: folder to write; an earlier result of the same kind in it is replaced.
            plots: False: no figures, True: in the page, ``png`` or ``svg``: as files, too.
        """
        from calib.procedure.report import outputs

        draw = partial(outputs.write_plan, plots=plots) if plots else None
        return folder.write_plan(self, Path(out), draw)

    def charts(self) -> dict[str, Chart]:
        """Return the charts of the figures by name: motion and speed profile."""
        from calib.procedure.report import motion_figures

        return charts_of(motion_figures.plan_figures(self))

    def to_dict(self) -> dict[str, object]:
        """Return the metrics of the result, the content of ``metrics.json``."""
        return folder.plan_metrics(self)

    def __repr__(self) -> str:
        return f"<MotionPlan for {self.chain.name}: {self.track.duration:g} s>"

    def __str__(self) -> str:
        return "\n".join(folder.plan_lines(self))


def _read(options: IdentifySettings | str | Path) -> IdentifyOptions:
    if isinstance(options, IdentifySettings):
        return options_of(options)
    return read_options(options)


@checked
def design_excitation(
    robot: str | Path | CalibratedChain | Mechanism,
    settings: ExcitationSettings = DEFAULT_DESIGN,
    *,
    model: DynamicsModel | MechanismResult | str | Path | None = None,
    limits: Tables | None = None,
    options: IdentifySettings | str | Path | None = None,
    after: DynamicsModel | str | Path | None = None,
    pick: tuple[str | Path, int] | None = None,
    base: str | None = None,
    tip: str | None = None,
    workers: str | int = 1,
    progress: Progress | None = None,
) -> ExcitationDesign:
    """Return a motion that excites a robot's dynamics within its limits.

    Args:
        robot, base, tip: arguments of `calib.load`; or, for `robot`, the result of `calib.load` or ``fit.robot``. For a
            parallel robot, the result has the same members except ``plot``.
        settings: period, harmonics, goals, effort of the search, playback, seed.
        model: identified dynamics that predict the torques, in memory or as a folder; None takes those of the robot's
            description.
        limits: TOML file of limits on speeds, torques, workspace and collisions (``calib formats limits``), or its
            tables; None takes the limits of the robot's description.
        options: settings of the later identification, as in `calib.identify_dynamics`. The motion is designed for the
            torque rows, drive terms, couplings and payloads in them. None takes the defaults.
        after: identified dynamics to be improved by a further motion, given instead of `model`. The motion that reduces
            the σ of their parameters most is designed, and the reduction is predicted. None: the design does not refer
            to an earlier identification.
        pick: folder of a design with a Pareto front, made with the same settings, and the number of a motion on that
            front. This motion is returned instead of a new search; None searches.
        workers: number of local processes, or the address of a Dask scheduler.
        progress: called with texts on the progress; None for no report.

    Raises:
        UsageError: limits or goals are contradictory.
        NothingFeasible: no motion satisfies the limits; the message names the constraint.
    """
    from calib.workers import workers as opened

    lost_workers: list[TaskLost] = []
    stage = stage_of(robot, "excite", base, tip)
    picked = None
    if pick is not None:
        front_folder, number = pick
        picked = stored_front.read(Path(front_folder)).with_designed(number)
    with as_ours(), ExitStack() as stack:
        model_folder = None if model is None else stack.enter_context(saved(model))
        previous_folder = None if after is None else stack.enter_context(saved(after))
        crew = stack.enter_context(opened(workers))
        if stage is not None:
            require(pick is None, "pick: fronts of trade-offs are designed for serial arms only", UsageError)
            return stage.run(
                settings,
                model=model_folder,
                limits=limits,
                options=options,
                after=after,
                map=crew.map,
                progress=progress,
            )
        identify_settings = None if options is None else _read(options).settings
        designed = design.excite(
            cast(str | Path | CalibratedChain, robot),
            settings,
            model=model_folder,
            limits=optional(limits),
            base=base,
            tip=tip,
            options=identify_settings,
            after=previous_folder,
            picked=picked,
            map=crew.map_without(lost_workers),
            progress=progress,
        )
    designed = replace(designed, notes=(*designed.notes, *map(str, lost_workers)))
    return as_subclass(designed, ExcitationDesign)


@checked
def plan_motion(
    robot: str | Path | CalibratedChain | Mechanism,
    waypoints: str | Path | Targets | np.ndarray,
    settings: PlanSettings = DEFAULT_PLAN,
    *,
    model: DynamicsModel | MechanismResult | str | Path | None = None,
    limits: Tables | None = None,
    drives: Tables | None = None,
    base: str | None = None,
    tip: str | None = None,
    progress: Progress | None = None,
) -> MotionPlan:
    """Return the fastest motion through waypoints, within limits on a robot's speeds and torques.

    Args:
        robot, base, tip: arguments of `calib.load`; or, for `robot`, the result of `calib.load` or ``fit.robot``. For a
            parallel robot, the result has the same members except ``plot``.
        waypoints: CSV of joint values or of poses of the tip (for a parallel robot, of the platform's coordinates); or
            arrays: joint values (m, n) [rad or m], or poses of the tip (m, 4, 4) [m].
        settings: payloads, straight lines, rate, shaping, approach.
        model: identified dynamics, in memory or as a folder; None takes those of the robot's description.
        limits: TOML file of limits (``calib formats limits``), or its tables; None takes the limits of the robot's
            description.
        drives: TOML file, or its tables, of drive inertia (Ia), viscous and Coulomb friction (Fv, Fc) and torque offset
            (off); used where no `model` is given. None for no such terms.
        progress: called with texts on the progress; None for no report.

    Raises:
        UsageError: waypoints cannot be reached, or limits cannot be satisfied.
    """
    stage = stage_of(robot, "plan", base, tip)
    with as_ours(), ExitStack() as stack:
        model_folder = None if model is None else stack.enter_context(saved(model))
        if stage is not None:
            return stage.run(
                optional(waypoints),
                settings,
                model=model_folder,
                limits=optional(limits),
                drives=optional(drives),
                progress=progress,
            )
        planned = planning.plan(
            cast(str | Path | CalibratedChain, robot),
            optional(waypoints),
            settings,
            model=model_folder,
            limits=optional(limits),
            drives=optional(drives),
            base=base,
            tip=tip,
            progress=progress,
        )
    return as_subclass(planned, MotionPlan)
