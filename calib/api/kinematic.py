"""Kinematic calibration in Python: choose poses, fit the geometry, predict and compensate errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from calib import files
from calib.api.rendering import ChartedResult, Progress, ReportedResult, WithoutVerdict, charts_of, listed, optional
from calib.api.result_table import ResultTable, data_frame
from calib.arguments import checked
from calib.config import Tables
from calib.config_types import Plots
from calib.data.poses.fit_options import FitOptions, read_options
from calib.data.poses.measurements import PoseMeasurements
from calib.data.poses.pose_lists import PAYLOAD
from calib.errors import TaskLost, UsageError, as_ours, require
from calib.estimation.estimate import Estimate
from calib.estimation.robust import Loss, check_loss
from calib.geometry.observation import pose_sigmas
from calib.geometry.static_torques.gravity_fit import payload_load
from calib.geometry.static_torques.sources import gravity_of
from calib.procedure.kinematic_stage import fit, folder, inputs, selection
from calib.procedure.kinematic_stage.settings import DEFAULT_SELECTION, FitSettings, SelectionSettings
from calib.procedure.measuring import prediction
from calib.procedure.measuring.measuring_run import write_run
from calib.procedure.robot_kinds import Mechanism, stage_of
from calib.records import Floats, as_subclass, plain
from calib.result_kinds import BY_NAME
from calib.robot.calibrated import CalibratedChain, like_joints
from calib.workers.threads import one_blas_thread

if TYPE_CHECKING:
    from calib.api.result_table import DataFrame
    from calib.procedure.report.figures.charts import Captioned, Chart
    from calib.procedure.report.page import Section

Measured = str | Path | PoseMeasurements
Several = Measured | Sequence[Measured | Sequence[Measured]]


class PoseSelection(ChartedResult, WithoutVerdict, selection.Chosen):
    """Poses that determine a robot's geometry best.

    ``print`` shows the observability index, its upper bound, and the index of random poses.
    """

    kind = BY_NAME["selection"]
    tab = "q chain selection loads outlook run notes plot save save_run to_dict to_dataframe"

    @property
    def q(self) -> Floats:
        """Joint values (m, n) of the poses [rad or m]."""
        return np.asarray(self.selection.q)

    @checked
    def save(self, path: str | Path, *, plots: Plots = True, overwrite: bool = False) -> Path:
        """Write the poses [deg or mm] as CSV, and the predicted errors beside it; return the path of the CSV.

        The columns are the joints' names. The predicted errors are written to ``…_prediction.json``, which the argument
        `poses` of `fit_geometry` uses. The figures are those of `plot`. Existing files are replaced only if an earlier
        selection wrote them and no measurements were added, or with `overwrite`.

        Args:
            path: the CSV to write.
            plots: False: no figures, True: in the page, ``png`` or ``svg``: as files, too.
            overwrite: whether to replace any existing file.

        Raises:
            UsageError: a file exists and must not be replaced.
        """
        path = Path(path)
        paths = selection.beside_poses(path, plots, self)
        with files.results(selection.targets(path, plots), overwrite=overwrite):
            if "figures" in paths:
                self._write_figures(paths, plots)
            return selection.write(self, path)

    def _write_figures(self, paths: Mapping[str, Path], plots: Plots) -> None:
        """Write the page with the figures, and each as a file, if `plots` is a format.

        Args:
            paths: ``figures``: the page, and the files of the figures by name.
            plots: True or the format.
        """
        from calib.procedure.report import outputs
        from calib.procedure.report.figures import figure_files

        charts = self._captioned()
        files.write(paths["figures"], outputs.figures_page(f"Poses for {self.chain.name}", [str(self)], charts))
        if isinstance(plots, str):
            for name, (chart, _) in charts.items():
                files.write(paths[name], figure_files.drawn(chart, plots))

    @checked
    def save_run(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write the measuring run, with the poses in their order, as CSV, and return its path.

        The columns are t [s], pose (0 for a via-point) and the joints [deg or mm].

        Args:
            path: the CSV to write.
            overwrite: whether to replace any existing file; without it, only an unchanged file of an earlier call.
        """
        with files.results([(Path(path), (".csv",))], overwrite=overwrite):
            return write_run(Path(path), self.run, self.chain)

    def charts(self) -> dict[str, Chart]:
        """Return the charts by name: σ of the tool position over the workspace, and over the number of poses.

        Empty if a parameter is not identifiable.
        """
        return charts_of(self._captioned())

    def _captioned(self) -> dict[str, Captioned]:
        from calib.procedure.report.geometry_figures import outlook_figure, predicted_map

        result: dict[str, Captioned] = {}
        for name in self.figure_names:
            if name == "predicted":
                selected = self.outlook.poses
                chart = predicted_map(selected.points, selected.spread)
                result[name] = chart, "How well the tool's position will be known over the workspace."
            else:
                curve = [(float(forecast.poses), 1e3 * forecast.rms) for forecast in self.outlook.others]
                point = (float(self.outlook.poses.poses), 1e3 * self.outlook.poses.rms)
                chart = outlook_figure(curve, point, "poses", "σ of the tool's position [mm]")
                result[name] = chart, "What fewer and more poses are predicted to identify."
        return result

    def to_dict(self) -> dict[str, object]:
        """Return the results of the selection: index, its value, value of random poses, efficiency, seconds, notes."""
        return selection.record(self)

    def to_dataframe(self) -> DataFrame:
        """Return the joint values as a pandas DataFrame, one row per pose."""
        header = [f"{joint.name} [{joint.unit}]" for joint in self.chain.joints]
        values = self.q
        if self.loads is not None:
            header.append(PAYLOAD)
            values = np.column_stack([values, self.loads.masses])
        return data_frame(values.tolist(), header)

    def __repr__(self) -> str:
        return f"<PoseSelection: {len(self.q)} poses of {self.chain.name}>"

    def __str__(self) -> str:
        lines = [f"{label:38} {number}" for label, number in selection.table(self)]
        lines += self.kept()
        lines += [f"note: {note}" for note in self.notes]
        return "\n".join(lines)


class PredictedPoses(NamedTuple):
    """Poses (m, 4, 4) [m] of a tool in the robot's base frame, with σ (m, 2) of position [m] and orientation [rad].

    Of one pose, asked for by joint values (n,): (4, 4) and (2,).
    """

    pose: Floats
    sigma: Floats


class GeometryFit(ChartedResult, ReportedResult, fit.Outcome):
    """A fitted geometry with covariance and verdict.

    ``print`` shows the compared models, the errors on held-out poses, and the verdict.
    """

    kind = BY_NAME["fit"]
    tab = (
        "robot verdict warnings validation estimate residuals outliers predict position_sigma plot save to_dict "
        "to_dataframe"
    )

    @property
    def residuals(self) -> ResultTable:
        """Residuals (measured minus predicted) of every row, fitted or held out, with weight and expected error.

        The columns are those of ``residuals.csv``: ``fit.residuals["dx [mm]"]`` is an array (m,), and
        ``fit.residuals.to_dataframe()`` a pandas DataFrame.
        """
        from calib.procedure.kinematic_stage.fit_tables import residuals

        return ResultTable.of_rows(*residuals(self))

    @property
    def estimate(self) -> Estimate:
        """Names, units, values and covariance of the fitted parameters."""
        return self.selection.fit.estimate

    @one_blas_thread()
    def predict(self, q: ArrayLike, tool: int = 0, payload: float | Sequence[float] | None = None) -> PredictedPoses:
        """Return the tool poses of the calibrated robot at given joint values, in its base frame, with their σ.

        If the fit has an error model, σ of the position contains all expected errors (`position_sigma`), else only
        those due to the parameters. σ of the orientation contains only those due to the parameters.

        Args:
            q: joint values (m, n) [rad or m], or (n,) for one pose.
            tool: index of the fitted tool, from 0.
            payload: mass that the tip carries [kg], or mass and its centre x, y, z in the tip's frame [m]; None: what
                the arm carried in the fit.
        """
        geometry = self.selection.fit
        poses = self._poses(q, payload)
        sigma = pose_sigmas(geometry.cell, poses, geometry.free, geometry.estimate.covariance, -1, tool)
        if self.expected is not None:
            sigma[:, 0] = self.expected.position_sigma(poses, -1, tool)
        tool_poses = self.robot.forward(poses.q, poses.torque, poses.load) @ geometry.cell.tools[tool]
        return PredictedPoses(like_joints(q, tool_poses), like_joints(q, sigma))

    @one_blas_thread()
    def position_sigma(self, q: ArrayLike, tool: int = 0, payload: float | Sequence[float] | None = None) -> Floats:
        """Return the standard deviation (m,) [m] of the tool position error (norm over the axes) at given poses.

        It contains the parameters' covariance and unmodelled effects. It is estimated on held-out rows, and grows with
        the distance from the fitted poses. 95 % of the errors are below ``expected.discrepancy.radius`` times this
        value.

        Args:
            q: joint values (m, n) [rad or m], or (n,) for one pose.
            tool: index of the fitted tool, from 0.
            payload: mass that the tip carries [kg], or mass and its centre x, y, z in the tip's frame [m]; None: what
                the arm carried in the fit.

        Raises:
            UsageError: fewer than 20 positions were measured.
        """
        if self.expected is None:
            raise UsageError("this fit has no expected errors: they need at least 20 measured positions")
        return like_joints(q, self.expected.position_sigma(self._poses(q, payload), tool=tool))

    def _poses(self, q: ArrayLike, payload: float | Sequence[float] | None = None) -> PoseMeasurements:
        """Return poses at joint values q (m, n), with gravity torques (m, n) [N m] if the links' masses are known.

        Args:
            q: joint values.
            payload: mass [kg], or mass and centre in the tip's frame [m]; None for no payload.
        """
        joints = self.robot.joint_rows(q)
        chain = self.inputs.weighed
        load = payload_load(chain, payload)
        if load is not None:
            load = np.tile(load, (len(joints), 1))
        torque = gravity_of(chain, joints, load)
        return PoseMeasurements(joints, self.inputs.chain.joint_names, torque=torque, load=load)

    @checked
    def save(self, out: str | Path, *, plots: Plots = True) -> Path:
        """Write the result folder, with the same files as `calib fit --out`, and return its path.

        The files are robot.toml, URDF, estimate, residuals and certificate.

        Args:
            out: folder to write; an earlier result of the same kind in it is replaced.
            plots: False: no figures, True: in the page, ``png`` or ``svg``: as files, too.
        """
        from calib.procedure.report import outputs

        return folder.write_folder(self, Path(out), partial(outputs.write_fit, plots=plots))

    def charts(self) -> dict[str, Chart]:
        """Return the charts of the report's figures by name."""
        from calib.procedure.report import geometry_figures
        from calib.procedure.report.fit_report import collect

        return charts_of(geometry_figures.captioned(collect(self)))

    def to_dict(self) -> dict[str, object]:
        """Return the metrics of the result, the content of ``metrics.json``."""
        return plain(folder.metrics(self))

    def to_dataframe(self) -> DataFrame:
        """Return the fitted parameters as a pandas DataFrame: name, unit, nominal, value, sigma, RSD [%].

        RSD is the relative standard deviation.
        """
        from calib.procedure.kinematic_stage.fit_tables import HEADER, estimate_table

        return data_frame(estimate_table(self.selection.fit, self.selection.nominal.cell).rows(), HEADER)

    def section(self) -> Section:
        """Return a report section with the errors on held-out poses, the compared models, and the verdict."""
        from calib.procedure.report import geometry_section

        return geometry_section.outcome_section(folder.metrics(self))

    def __repr__(self) -> str:
        return f"<GeometryFit of {self.robot.chain.name}: model {self.selection.chosen}, {self.verdict.level}>"


@checked
def select_poses(
    robot: str | Path | CalibratedChain,
    count: int = 30,
    settings: SelectionSettings = DEFAULT_SELECTION,
    *,
    constraints: Tables | None = None,
    existing: str | Path | PoseMeasurements | np.ndarray | None = None,
    candidates: selection.Candidates | None = None,
    base: str | None = None,
    tip: str | None = None,
    workers: str | int = 1,
    progress: Progress | None = None,
) -> PoseSelection:
    """Return reachable and visible poses that determine a robot's geometry best.

    By default, poses are inside the joint limits and free of collisions of the arm with itself and with the floor at
    its base; the result lists what was not checked. ``SelectionSettings.without`` names constraints to ignore.

    Args:
        robot, base, tip: arguments of `calib.load`; or, for `robot`, its result.
        count: number of poses.
        settings: measured quantity, targets, index, method, sigmas, seed.
        constraints: TOML file of the arm's workspace and the instrument's placement (``calib formats constraints``), or
            its tables; None takes the defaults.
        existing: poses measured before, to which the selection adds the most informative ones: a CSV, measurements, or
            joint values (m, n) [rad or m]; None for no such poses.
        candidates: poses to choose from: a CSV with the joints' columns, joint values (N, n) [rad or m], or a function
            of a number of poses that returns joint values; those that break the constraints are left out, and
            ``selection.indices`` are the rows of the chosen ones, of which a joint may be turned by whole turns where
            that shortens the run. None draws ``settings.candidates`` poses at random.
        workers: number of local processes, or the address of a Dask scheduler.
        progress: called with texts on the progress; None for no report.

    Raises:
        UsageError: an invalid argument, file of constraints or candidate.
        RobotError: the robot is not found, or its file is invalid.
    """
    from calib.workers import workers as opened

    stage_of(robot, "choosing poses")
    lost_workers: list[TaskLost] = []

    def show(done: int, total: int, task: str) -> None:
        if progress is not None:
            progress(f"{task} ({done} of {total})")

    with as_ours(), opened(workers) as crew:
        chosen = selection.choose(
            robot,
            count,
            settings,
            constraints=optional(constraints),
            existing=optional(existing),
            candidates=optional(candidates),
            base=base,
            tip=tip,
            map=crew.map_without(lost_workers),
            progress=show,
        )
    chosen = replace(chosen, notes=(*chosen.notes, *map(str, lost_workers)))
    return as_subclass(chosen, PoseSelection)


@checked
def fit_geometry(
    robot: str | Path | CalibratedChain | Mechanism,
    measured: Several,
    settings: FitSettings | None = None,
    *,
    validate: Several = (),
    options: FitOptions | str | Path | None = None,
    poses: PoseSelection | str | Path | None = None,
    loss: Loss | None = None,
    base: str | None = None,
    tip: str | None = None,
    on_read: Callable[[inputs.Inputs], None] | None = None,
    progress: Progress | None = None,
) -> GeometryFit:
    """Return a robot's geometry, fitted to measured poses and judged on poses that were not fitted.

    Args:
        robot, base, tip: the nominal robot: arguments of `calib.load`; or, for `robot`, its result. For a parallel
            robot, measurements must be files, and the result has the same members.
        measured: CSV files, results of `read_poses`, or several of either.
        settings: model, loss, folds, stations, tools, rows to hold out, tolerance, seed; None takes the defaults.
        validate: poses that are not fitted but used to judge the result, in the same forms as `measured`.
        options: units and columns that the files' headers do not state, priors, fixed parameters: in memory, or as a
            TOML file (``calib formats options``). None takes the defaults.
        poses: the planned poses: result of `select_poses`, its CSV, or its folder. The predicted σ are compared with
            those of the fit (finding ``sigma-ratio``). None for no comparison.
        loss: the loss as a function ρ of squared residuals z = (r/σ)² (m,), which returns the rows ρ, ρ' and ρ'' (3, m)
            or the first two, as in ``scipy.optimize.least_squares`` (Triggs et al. 2000); row weights are ρ'. It takes
            the place of the loss in `settings`. None for a loss by name.
        on_read: called with the inputs before the fit begins; None for no call.
        progress: called with the name of each step; None for no report.

    Raises:
        UsageError: an invalid argument; for `loss`: ρ' is negative, not finite, or not the derivative of ρ.
        MeasurementError: a file is implausible; the message names row and column.
        Unidentifiable: no parameter is identifiable.
        NotConverged: the fit did not converge.
    """
    if loss is not None:
        require(
            settings is None or settings.loss is None,
            "loss: given both as a function and by name, in the settings: give only one of them",
            UsageError,
        )
        check_loss(loss)
    if not isinstance(options, FitOptions):
        options = read_options(optional(options))
    expected = None
    if isinstance(poses, PoseSelection):
        expected = poses.prediction
    elif poses:
        expected = prediction.read(Path(poses))
    stage = stage_of(robot, "fit", base, tip)
    if stage is not None:
        require(loss is None, "loss: a function is for arms only; parallel robots are fitted without one", UsageError)
        return stage.run(
            listed(measured), listed(validate), settings=settings, options=options, poses=poses, progress=progress
        )
    if progress is not None:
        progress("reading")
    fit_inputs = inputs.gather(
        cast(str | Path | CalibratedChain, robot),
        listed(measured),
        listed(validate),
        options=options,
        settings=settings,
        base=base,
        tip=tip,
    )
    if on_read is not None:
        on_read(fit_inputs)
    outcome = fit.run(fit_inputs, options, settings, progress, expected or None, loss)
    return as_subclass(outcome, GeometryFit)
