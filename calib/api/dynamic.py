"""Dynamic calibration in Python: identify a robot's dynamics on its calibrated geometry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import ArrayLike

from calib.api.rendering import ChartedResult, Progress, ReportedResult, listed, optional
from calib.api.result_table import ResultTable, data_frame
from calib.arguments import checked
from calib.config_types import Plots
from calib.data.recordings.recording import Recording
from calib.errors import UsageError, require
from calib.estimation.estimate import Estimate
from calib.identification.friction.friction_terms import FrictionTerm
from calib.identification.identify_options import IdentifyOptions, IdentifySettings, options_of, read_options
from calib.identification.methods.method import Method
from calib.identification.registry import METHODS
from calib.procedure.dynamic_stage import folder, identify, inputs, metrics
from calib.procedure.robot_kinds import Mechanism, stage_of
from calib.records import Floats, as_numbers, as_subclass, plain, shaped
from calib.result_kinds import BY_NAME
from calib.robot.calibrated import CalibratedChain, like_joints
from calib.workers.threads import one_blas_thread

if TYPE_CHECKING:
    from calib.api.result_table import DataFrame
    from calib.procedure.report.figures.charts import Chart
    from calib.procedure.report.page import Section

Recorded = str | Path | Recording


class DynamicsModel(ChartedResult, ReportedResult, identify.IdentificationOutcome):
    """Identified dynamics with covariance and verdict.

    ``print`` shows the errors on held-out motion, the friction and the verdict.
    """

    kind = BY_NAME["identification"]
    tab = (
        "robot verdict warnings validation estimate residuals torques torque_sigma predictions plot save to_dict "
        "to_dataframe"
    )

    @property
    def residuals(self) -> ResultTable:
        """Torque residuals, measured minus predicted, of every sample, fitted or held out.

        The columns are the file, the time [s], and one residual for each torque row [N m or N].
        """
        titles = self.found.settings.torque_rows.titles(self.inputs.chain.joint_names)
        cases = (*self.inputs.cases, *self.inputs.unseen)
        files = []
        times = []
        torques = []
        for case in cases:
            files.append(np.full(len(case.motion.t), case.name))
            times.append(case.motion.t)
            torques.append(case.target - self.predictions[case.name])
        columns = {"file": np.concatenate(files), "t [s]": np.concatenate(times)}
        for title, unit, residual in zip(titles, self.inputs.row_units, np.concatenate(torques).T, strict=True):
            columns[f"{title} [{unit}]"] = residual
        return ResultTable(columns)

    @property
    def robot(self) -> CalibratedChain:
        """The robot whose dynamics were identified."""
        return self.inputs.robot

    @property
    def estimate(self) -> Estimate:
        """The base parameters with their covariance, which includes that of the geometry if known."""
        estimate = self.found.fitted.estimate
        if self.carried is None:
            return estimate
        return replace(estimate, covariance=self.carried.covariance)

    @one_blas_thread()
    def torques(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> Floats:
        """Return the predicted torques [N m or N]: (N, rows) of a motion (N, n), (rows,) of one state (n,).

        Args:
            q, v, a: (N, n) or (n,) joint positions [rad or m], velocities [per s] and accelerations [per s²].

        Raises:
            CalibError: an array of a wrong shape.
        """
        dynamics = self.found.dynamics
        return like_joints(q, dynamics.model.torque(dynamics.values, *self._states(q, v, a)))

    @one_blas_thread()
    def torque_sigma(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> Floats:
        """Return the standard deviations σ [N m or N] of predicted torques, in the shape of `torques`.

        ± 1.96 σ contains 95 % of the errors.

        They include the part of recorded torques, within the band of the filter, that the model does not explain.

        Args:
            q, v, a: (N, n) or (n,) joint positions [rad or m], velocities [per s] and accelerations [per s²].

        Raises:
            UsageError: the recordings were too short to estimate the model's errors.
        """
        if self.errors is None:
            raise UsageError("torque errors cannot be estimated, since the recording is too short: record longer")
        return like_joints(q, self.errors.sigma(self.found.dynamics, *self._states(q, v, a)))

    def _states(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """Return positions, velocities and accelerations as arrays (N, n) of equal shape.

        Args:
            q, v, a: (N, n) or (n,) joint positions, velocities and accelerations.
        """
        positions = self.robot.joint_rows(q)
        velocities = shaped(np.atleast_2d(as_numbers(v, "v")), positions.shape, "v")
        accelerations = shaped(np.atleast_2d(as_numbers(a, "a")), positions.shape, "a")
        return positions, velocities, accelerations

    @checked
    def save(self, out: str | Path, *, plots: Plots = True) -> Path:
        """Write the result folder, with the same files as `calib identify --out`, and return its path.

        Args:
            out: folder to write; an earlier result of the same kind in it is replaced.
            plots: False: no figures, True: in the page, ``png`` or ``svg``: as files, too.
        """
        from calib.procedure.report import outputs

        return folder.write_folder(self, Path(out), partial(outputs.write_model, plots=plots))

    def charts(self) -> dict[str, Chart]:
        """Return the charts of the figures by name: measured and predicted torques, autocorrelations, friction."""
        from calib.procedure.report import dynamics_figures

        return dynamics_figures.figures(self)

    def to_dict(self) -> dict[str, object]:
        """Return the metrics of the result, the content of ``metrics.json``."""
        return plain(metrics.metrics(self))

    def to_dataframe(self) -> DataFrame:
        """Return the base parameters as a pandas DataFrame with the columns name, unit, value and sigma.

        sigma is NaN for parameters at a bound of the physical constraints.
        """
        estimate = self.estimate
        on_bounds = np.isin(self.found.names, metrics.on_bounds(self.found))
        sigma = np.where(on_bounds, np.nan, estimate.sigma)
        rows = zip(estimate.names, estimate.units, estimate.values.tolist(), sigma.tolist())
        return data_frame(rows, ["name", "unit", "value", "sigma"])

    def section(self) -> Section:
        """Return a report section with the errors on held-out motion, the friction, and the verdict."""
        from calib.procedure.report import dynamics_section

        return dynamics_section.outcome_section(self)

    def __repr__(self) -> str:
        return (
            f"<DynamicsModel of {self.robot.chain.name}: {len(self.estimate.names)} parameters, {self.verdict.level}>"
        )


class MethodTable(tuple[Method, ...]):
    """Identification methods, one record each: ``name``, ``description``, ``source``, ``assumes``.

    ``print`` shows one method per line.
    """

    def __repr__(self) -> str:
        return "\n".join(map(str, self))


def methods() -> MethodTable:
    """Return all identification methods, one record each: ``name``, ``description``, ``source``, ``assumes``."""
    return MethodTable(METHODS.values())


@checked
def identify_dynamics(
    robot: str | Path | CalibratedChain | Mechanism,
    recordings: Recorded | Sequence[Recorded],
    settings: IdentifySettings | None = None,
    *,
    validate: Recorded | Sequence[Recorded] = (),
    method: str | None = None,
    friction: str | None = None,
    terms: Sequence[FrictionTerm] = (),
    options: IdentifyOptions | str | Path | None = None,
    excitation: str | Path | None = None,
    after: str | Path | None = None,
    with_geometry: bool | None = None,
    base: str | None = None,
    tip: str | None = None,
    seed: int = 0,
    on_read: Callable[[inputs.IdentificationInputs], None] | None = None,
    progress: Progress | None = None,
) -> DynamicsModel:
    """Return a robot's dynamics, identified on its geometry and judged on motion that was not fitted.

    If the robot is the result of a fit (``fit.robot``), the covariance of its geometry is propagated to the estimate:
    the covariance Σ of the base parameters is Σ_torque + S Σ_geometry Sᵀ, with Σ_torque due to the errors of the
    torques and S the sensitivity of the estimate to the geometry.

    Args:
        robot, base, tip: arguments of `calib.load`; or, for `robot`, the result of `calib.load` or ``fit.robot``. For a
            parallel robot, the result has the same members.
        recordings: logs of joint positions and torques (or currents): files (``log.npz@0:9.4`` takes seconds 0 to 9.4),
            or results of `read_recording`.
        settings: method, friction, drives, payloads, gains, filters, closed loop; None takes the defaults.
        validate: recordings of other motion, which are used to validate the result only.
        method, friction: identification method (one of `methods`) and friction model, which replace those of the
            settings; None takes those of the settings.
        terms: friction terms that are functions of a joint's velocity or position, in addition to those of the
            friction model; exports say that URDF has no place for them.
        options: the settings as a TOML file (``calib formats identify-options``), or the options read from one, given
            instead of `settings`; None for no file.
        excitation: folder written by `design_excitation`, for methods that simulate the closed loop ([loop] in the
            options). Its motion is the reference motion for recordings that contain none. None for no folder.
        after: folder of an earlier identification of this arm, whose choice of friction terms and of the prior's sizes
            is carried on, unless the recordings contradict it. The σ that `design_excitation` predicts after that
            identification are then those of the same model. None chooses both from the recordings.
        with_geometry: whether the geometry is estimated again together with the dynamics: the covariance of the fit is
            its prior, and torques of motions with and without a known payload tell joint offsets. ``robot`` of the
            result has the geometry after the torques. None takes the settings' choice.
        seed: seed of all random numbers.
        on_read: called with the inputs before the identification begins; None for no call.
        progress: called with the name of each step; None for no report.

    Raises:
        MeasurementError: a log is implausible; the message names row and column.
        Unidentifiable: the motion identifies no parameter.
    """
    require(
        settings is None or options is None,
        "settings and options were both given, but contain the same keys: give only one of them",
        UsageError,
    )
    if settings is not None:
        options = options_of(settings)
    elif not isinstance(options, IdentifyOptions):
        options = read_options(optional(options))
    options = replace(options, settings=replace(options.settings, functions=tuple(terms)))
    if with_geometry is not None:
        options = replace(options, settings=replace(options.settings, with_geometry=with_geometry))
    designed = []
    if excitation is not None:
        from calib.procedure.excitation import coefficients  # slow to load

        designed.append(coefficients.read(Path(excitation)))
    stage = stage_of(robot, "identify", base, tip)
    if stage is not None:
        require(after is None, "after: for arms only; leave it out", UsageError)
        require(not terms, "terms: functions are for arms only; parallel robots have the standard friction", UsageError)
        return stage.run(
            listed(recordings),
            listed(validate),
            options=options,
            method=method,
            friction=friction,
            seed=seed,
            designed=designed,
            on_read=on_read,
            progress=progress,
        )
    identification_inputs = inputs.gather(
        cast(str | Path | CalibratedChain, robot),
        listed(recordings),
        listed(validate),
        options=options,
        method=method,
        friction=friction,
        base=base,
        tip=tip,
        seed=seed,
        designed=designed,
        progress=progress,
    )
    if after is not None:
        identification_inputs = folder.continuing(identification_inputs, Path(after))
    if on_read is not None:
        on_read(identification_inputs)
    return as_subclass(identify.run(identification_inputs, progress), DynamicsModel)
