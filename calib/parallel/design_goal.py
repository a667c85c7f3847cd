"""Design goal of a parallel robot's motion: model, rows and columns, loads, and an earlier identification as prior."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from calib.dynamics import base as bases
from calib.dynamics.base import standard_name
from calib.dynamics.drives import DriveTerm
from calib.dynamics.regressor_model import Loads
from calib.dynamics.shapes import V0
from calib.dynamics.torque_rows import MOTOR
from calib.errors import RobotError, UsageError, refused_as
from calib.folders import read_covariance
from calib.identification.identify_options import IdentifySettings, options_of, read_options
from calib.identification.model_file import MODEL, read_table, refuse_currents
from calib.parallel.identification import model_of, refuse_options_of_arms
from calib.parallel.mechanism.parallel_model import ParallelModel, PlatformRegressor, make_parallel_model, rows_named
from calib.parallel.mechanism.velocities import LoopMotion, loop_jacobians
from calib.parallel.robots import ParallelMechanism
from calib.procedure.excitation.design import INSTANTS
from calib.procedure.excitation.excited_model import SMOOTH, ExcitedModel, loads_of, stated_payloads
from calib.procedure.excitation.inputs import IdentifiableColumns, selected_columns
from calib.procedure.excitation.limits import DEFAULT_RISE
from calib.procedure.excitation.prediction import MotionOutlook, MotionPrediction, PredictedSigma
from calib.procedure.excitation.prior_motions import PriorMotions, read_prior
from calib.procedure.excitation.settings import DRIVES, ExcitationSettings

# Smoothing of Coulomb's sign [rad/s or m/s] in a model of the robot's file.
FILE_V0 = 0.05
# Share of the actuators' speeds up to which states of the typical task move.
TASK_SPEED = 0.5


@dataclass(frozen=True, eq=False)
class LoadedPlatform(PlatformRegressor):
    """Rows of a model (platform, motor or power) of a motion that is run once with each of several loads.

    Attributes:
        names, units: names and units of the columns, as in an identification.
        loads: labels of the payloads carried in each run; None: all payloads.
    """

    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    loads: Loads = (None,)

    @property
    def row_names(self) -> tuple[str, ...]:
        """Names of the limited torques: of the actuators, with the load if there are several."""
        names = self.model.mechanism.robot.joint_names
        if len(self.loads) == 1:
            return names
        row_names = []
        for load in self.loads:
            load_name = "all payloads"
            if load is not None:
                load_name = " + ".join(load) or "no payload"
            row_names += [f"{name} ({load_name})" for name in names]
        return tuple(row_names)

    def torques(self, motion: LoopMotion) -> np.ndarray:
        """Return the actuators' torques (N, loads · n) of a motion, with the loads one after another."""
        torques = []
        for load in self.loads:
            run = replace(self, loads=(None,), carried=load)
            run_torques = super(LoadedPlatform, run).torques(motion)
            torques.append(run_torques)
        return np.concatenate(torques, axis=1)

    def _columns(self, motion: LoopMotion) -> np.ndarray:
        runs = []
        for load in self.loads:
            regressor = self.model.along(motion, load)
            by_column = regressor.transpose(2, 1, 0)
            runs.append(by_column[self.columns])
        rows = np.concatenate(runs, axis=1)
        return rows.transpose(2, 1, 0)


@dataclass(frozen=True, eq=False)
class Purpose:
    """Design goal of a motion of a parallel robot.

    Attributes:
        model: rows as functions of the platform's coordinates, smoothed for the search, and exact.
        columns: columns to be identified, and σ of the rows.
        prior: information of an earlier identification that the motion complements; None without one.
    """

    model: ExcitedModel
    columns: IdentifiableColumns
    prior: PriorMotions | None = None


def read_model(robot: ParallelMechanism, folder: Path | None, drives: str = "") -> tuple[ParallelModel, np.ndarray]:
    """Return a model of a robot with the values (p,) of its parameters.

    Args:
        robot: the robot.
        folder: folder of an identification whose model is read; None: the inertias of the robot's file, no friction.
        drives: without a folder, names of the drive terms of each actuator, whose values are 0.

    Raises:
        RobotError: if the folder contains no model, or a model of other bodies.
        UsageError: if the robot's file has no inertias.
    """
    if folder is None:
        model = make_parallel_model(robot.mechanism, (drives,), v0=FILE_V0)
        inertial = file_bodies(robot, model)
        no_friction = np.zeros(len(model.terms))
        return model, np.append(inertial, no_friction)
    path = folder / MODEL
    tree = robot.mechanism.robot
    table = read_table(folder)
    unreadable = f"{path} contains no model of a parallel robot ({{}}); give a folder of calib identify"
    with refused_as(RobotError, (ValueError, KeyError, TypeError, AttributeError), unreadable):
        stated_values = {str(name): float(value) for name, value in table["values"].items()}
        drive_sets = []
        passive = ""
        for joint, label in enumerate(tree.labels):
            joint_terms = [drive for drive in DRIVES if drive + label in stated_values]
            drive_set = " ".join(joint_terms)
            drive_sets.append(drive_set)
            if joint not in tree.actuated:
                passive = passive or drive_set
        v0 = float(table.get("v0", V0))
        payloads = [str(label) for label in table.get("payloads", ())]
        preload = tuple(map(float, table.get("preload", ())))
        identical_legs = bool(table.get("identical_legs"))
        actuated = [drive_sets[joint] for joint in tree.actuated]
        model = make_parallel_model(robot.mechanism, actuated, v0=v0, payloads=payloads, passive=passive)
        model = replace(model, identical_legs=identical_legs, preload=preload)
    missing = [name for name in model.names[: model.inertial] if name not in stated_values]
    if missing:
        raise RobotError(f"{path} is of another robot (parameter {missing[0]} is missing): identify this robot")
    values = [stated_values.get(name, 0.0) for name in model.names]
    return model, np.array(values)


def file_bodies(robot: ParallelMechanism, model: ParallelModel) -> np.ndarray:
    """Return the inertial parameters (inertial,) of a model by the robot's file.

    Raises:
        UsageError: if the file has no inertias.
    """
    bodies = model.known_parameters()
    if bodies is None:
        raise UsageError(
            f"{robot.source} has no inertias, so torque limits cannot be applied; state them there, or name an "
            "identified model (--model)"
        )
    return bodies


def of_options(
    robot: ParallelMechanism, options: IdentifySettings | str | Path | None, settings: ExcitationSettings
) -> tuple[ParallelModel, np.ndarray, Loads, tuple[str, ...]]:
    """Return the model that the options of a later identification describe.

    Args:
        robot: the robot.
        options: options of the identification, or their file; None: rows and drives of `settings` alone.
        settings: settings of the excitation.

    Returns:
        Model, values (p,) of its parameters (0 where unknown), payloads of each run, notes.
    """
    if options is None:
        model, values = read_model(robot, None, settings.drives or "Fv Fc off")
        loads = loads_of(settings.loads, (), False)
        return model, values, loads, ()
    if isinstance(options, IdentifySettings):
        identify_options = options_of(options)
    else:
        identify_options = read_options(options)
    refuse_options_of_arms(identify_options.settings, identify_options)
    identification_settings = identify_options.settings
    row_kind = identification_settings.torque_rows.name
    if row_kind == MOTOR.name:
        row_kind = ""
    rows = rows_named(robot.mechanism, row_kind)
    smoothed_settings = replace(identification_settings, torque_rows=rows, v0=(SMOOTH,))
    model = model_of(robot.mechanism, smoothed_settings)
    payloads, notes = stated_payloads(identification_settings)
    inertial = file_bodies(robot, model)
    no_friction = np.zeros(len(model.columns))
    values = np.append(inertial, no_friction)
    first_payload = model.inertial - 10 * len(payloads)
    values[first_payload : model.inertial] = np.ravel(payloads)
    loads = loads_of(settings.loads, model.payloads, with_payloads=True)
    return model, values, loads, tuple(notes)


def of_folder(
    robot: ParallelMechanism, folder: Path, settings: ExcitationSettings
) -> tuple[ParallelModel, np.ndarray, Loads, tuple[str, ...]]:
    """Return the model of an identification's folder: model, values (p,), payloads of each run, no notes."""
    refuse_currents(folder, "an excitation within torque limits")
    model, values = read_model(robot, folder)
    row_kind = read_table(folder).get("kind", "")
    rows = rows_named(robot.mechanism, row_kind)
    model = replace(model, torque_rows=rows)
    loads: Loads = ((),)
    if settings.loads:
        loads = loads_of(settings.loads, model.payloads, with_payloads=False)
    return model, values, loads, ()


def purpose_of(
    model: ParallelModel,
    values: np.ndarray,
    loads: Loads,
    notes: tuple[str, ...],
    settings: ExcitationSettings,
    folder: Path | None,
    after: Path | None,
) -> Purpose:
    """Return the design goal: to identify a model's base parameters from runs with some loads.

    Args:
        model: model of the robot.
        values: (p,) values of its parameters.
        loads: payloads of each run.
        notes: notes of the design.
        settings: settings of the excitation.
        folder: folder of the identification that `model` is read from; None if it is read from the robot's file.
        after: folder of an identification that the motion complements: its columns are those to be identified, and its
            information is the prior. Payloads that no run carries are then known from the prior alone. None: no prior.
    """
    standard = model.names
    covariance = None
    if after is None:
        base = bases.find(model, loads=loads)
        names = base.names
        units = base.units
        base_columns = base.kept
        chosen = base.transform @ values
    else:
        names, covariance = read_covariance(after)
        indices = [standard.index(standard_name(name, standard)) for name in names]
        base_columns = np.array(indices)
        units = tuple(model.units[k] for k in base_columns)
        chosen = values[base_columns]
    exact_model = replace(model, terms=model.terms)
    exact = LoadedPlatform(exact_model, base_columns, values, names=names, units=units, loads=loads)
    smooth_terms = tuple(map(_smoothed, model.terms))
    smooth_model = replace(model, terms=smooth_terms)
    smooth = LoadedPlatform(smooth_model, base_columns, values, names=names, units=units, loads=loads)
    excited: Any = ExcitedModel(cast(Any, smooth), cast(Any, exact), chosen, covariance, folder is not None, notes)
    prior = read_prior((), excited, cast(Any, model.mechanism.robot), after)
    if prior is None:
        sigmas = np.ones(model.rows * len(loads))
    else:
        sigmas = prior.sigmas
    all_columns = IdentifiableColumns(None, sigmas, names)
    columns = selected_columns(all_columns, excited, settings, folder)
    return Purpose(excited, columns, prior)


def _smoothed(term: DriveTerm) -> DriveTerm:
    """Return a term with Coulomb's sign smoothed at least by `SMOOTH`; other terms unchanged."""
    if term.shape == "sign":
        v0 = max(SMOOTH, term.settings[0])
        return replace(term, settings=(v0,))
    return term


def foretold(excitation: Any, states: int = 400) -> Any:
    """Return a motion with the σ of parameters and actuators' torques that are predicted before and after the motion.

    The torques are predicted for random states of a typical task: the platform in its box, actuators at up to half of
    their speeds.

    Args:
        excitation: the motion, designed with a prior.
        states: number of random states.
    """
    inputs = excitation.inputs
    plan = cast(LoadedPlatform, excitation.plan)
    mechanism = excitation.robot.mechanism
    assert inputs.prior is not None and inputs.columns.sigmas is not None
    robot = mechanism.robot
    rng = np.random.default_rng([excitation.settings.seed, 3])
    sigmas = inputs.columns.sigmas
    # information of the motion, and roots of the covariance before and after it
    period = excitation.period
    step = period / INSTANTS
    times = step * np.arange(INSTANTS)
    Y = plan.regressor(*excitation.orders(times)) / sigmas[:, None]
    new = np.einsum("nri,nrj->ij", Y, Y, optimize=True) * step
    prior_information = inputs.prior.information
    root_before = np.linalg.cholesky(_inverse(prior_information + 0.0 * new))
    root_after = np.linalg.cholesky(_inverse(prior_information + new))

    # random states of a typical task
    x = rng.uniform(robot.lower, robot.upper, (states, robot.r))
    still = loop_jacobians(mechanism, mechanism.home).readings[0]
    bounds = inputs.limits.bounds
    speed_per_rate = np.linalg.norm(still, axis=1)
    largest_rate = np.min(bounds.velocity / speed_per_rate)
    fast = TASK_SPEED * largest_rate * np.ones(robot.r)
    directions = 2.0 * rng.random((2, states, robot.r)) - 1.0
    v, a = fast * directions * [[[1.0]], [[DEFAULT_RISE]]]
    W = model_rows(plan, plan.motion(x, v, a))

    def torque_sigma(root: np.ndarray) -> np.ndarray:
        variance = np.sum((W @ root) ** 2, axis=2)
        return np.sqrt(np.mean(variance, axis=0))

    def share(torques: np.ndarray) -> float:
        mean_square = np.mean((torques / bounds.torque) ** 2)
        return float(np.sqrt(mean_square))

    torque_before = torque_sigma(root_before)
    torque_after = torque_sigma(root_after)
    share_before = share(torque_before)
    share_after = share(torque_after)
    prediction = MotionPrediction(period, period, torque_after, share_after)
    outlook = MotionOutlook(share_before, torque_before, prediction, (), share_before)
    values = cast(np.ndarray, plan.values)[plan.columns].tolist()
    sigmas_before = np.linalg.norm(root_before, axis=1).tolist()
    sigmas_after = np.linalg.norm(root_after, axis=1).tolist()
    predicted = []
    for name, unit, value, before, after in zip(plan.names, plan.units, values, sigmas_before, sigmas_after):
        relative = None
        if value:
            relative = 100.0 * after / abs(value)
        predicted.append(PredictedSigma(name, unit, value or None, after, relative, before))
    return replace(excitation, outlook=outlook, predicted=predicted)


def model_rows(plan: LoadedPlatform, motion: LoopMotion) -> np.ndarray:
    """Return the regressor (N, n, b) of the actuators' torques with all payloads.

    Torques of redundant actuators are those of least norm.
    """
    regressor = plan.model.platform_regressor(motion)
    by_column = regressor.transpose(2, 1, 0)
    W = by_column[plan.columns].transpose(2, 1, 0)
    distribution = np.linalg.pinv(motion.jacobians.readings)
    return distribution.transpose(0, 2, 1) @ W


def _inverse(information: np.ndarray) -> np.ndarray:
    """Return the inverse of a matrix (b, b), scaled to a unit diagonal for the inversion."""
    unit = 1.0 / np.sqrt(np.diag(information))
    scaled = information * unit * unit[:, None]
    return np.linalg.inv(scaled) * unit * unit[:, None]


def whole(model: ParallelModel, values: np.ndarray) -> Purpose:
    """Return the design goal to identify all base parameters of a model without payloads.

    σ of the rows is the one that equal noise of all actuators' torques has at home.
    """
    mechanism = model.mechanism
    rows = rows_named(mechanism)
    bare_model = ParallelModel(mechanism, model.terms, rows, ())
    base = bases.find(bare_model)
    indices = [model.names.index(base.standard[k]) for k in base.kept]
    columns = np.array(indices)
    plan: Any = PlatformRegressor(model, columns, values)
    home_readings = loop_jacobians(mechanism, mechanism.home).readings[0]
    sigmas = np.linalg.norm(home_readings, axis=0)
    excited = ExcitedModel(plan, plan, None, None, False)
    identifiable = IdentifiableColumns(None, sigmas, base.names)
    return Purpose(excited, identifiable)
