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


@dataclass(frozen=True, eq=False)
class LoadedPlatform(PlatformRegressor):
    """Rows of a model (platform, motor or power) of one motion that is run once with each of several loads.

    Attributes:
        names, units: names and units of the columns, as in an identification.
        loads: payloads carried in each run.
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
            load_name = "all payloads" if load is None else " + ".join(load) or "no payload"
            row_names += [f"{name} ({load_name})" for name in names]
        return tuple(row_names)

    def torques(self, motion: LoopMotion) -> np.ndarray:
        """Return the actuators' torques (N, loads · n) of a motion, run after run."""
        torques = []
        for load in self.loads:
            run = replace(self, loads=(None,), carried=load)
            torques.append(super(LoadedPlatform, run).torques(motion))
        return np.concatenate(torques, axis=1)

    def _columns(self, motion: LoopMotion) -> np.ndarray:
        runs = []
        for load in self.loads:
            regressor = self.model.along(motion, load).transpose(2, 1, 0)
            runs.append(regressor[self.columns])
        return np.concatenate(runs, axis=1).transpose(2, 1, 0)


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
    """Return a model of a robot with its values (p,): identified, or the file's inertias without friction.

    Args:
        folder: folder of an identification; None to use the robot's file, with the terms `drives` for each actuator.

    Raises:
        RobotError: if the folder contains no model, or a model of other bodies.
        UsageError: if the robot's file has no inertias.
    """
    if folder is None:
        model = make_parallel_model(robot.mechanism, (drives,), v0=0.05)
        return model, np.append(file_bodies(robot, model), np.zeros(len(model.terms)))
    path = folder / MODEL
    tree = robot.mechanism.robot
    table = read_table(folder)
    unreadable = f"{path} contains no model of a parallel robot ({{}}); give a folder of calib identify"
    with refused_as(RobotError, (ValueError, KeyError, TypeError, AttributeError), unreadable):
        stated_values = {str(name): float(value) for name, value in table["values"].items()}
        drive_sets = []
        passive = ""
        for joint, label in enumerate(tree.labels):
            drive_set = " ".join(drive for drive in DRIVES if drive + label in stated_values)
            drive_sets.append(drive_set)
            if joint not in tree.actuated:
                passive = passive or drive_set
        v0 = float(table.get("v0", V0))
        payloads = [str(label) for label in table.get("payloads", ())]
        preload = tuple(map(float, table.get("preload", ())))
        actuated = [drive_sets[joint] for joint in tree.actuated]
        model = make_parallel_model(robot.mechanism, actuated, v0=v0, payloads=payloads, passive=passive)
        model = replace(model, identical_legs=bool(table.get("identical_legs")), preload=preload)
    missing = [name for name in model.names[: model.inertial] if name not in stated_values]
    if missing:
        raise RobotError(f"{path} is of another robot (parameter {missing[0]} is missing): identify this robot")
    return model, np.array([stated_values.get(name, 0.0) for name in model.names])


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
    """Return the model of an identification's options, its values (p,) where known, the loads, and notes."""
    if options is None:
        model, values = read_model(robot, None, settings.drives or "Fv Fc off")
        return model, values, loads_of(settings.loads, (), False), ()
    if isinstance(options, IdentifySettings):
        identify_options = options_of(options)
    else:
        identify_options = read_options(options)
    refuse_options_of_arms(identify_options.settings, identify_options)
    identification_settings = identify_options.settings
    row_kind = identification_settings.torque_rows.name
    rows = rows_named(robot.mechanism, "" if row_kind == MOTOR.name else row_kind)
    smoothed_settings = replace(identification_settings, torque_rows=rows, v0=(SMOOTH,))
    model = model_of(robot.mechanism, smoothed_settings)
    payloads, notes = stated_payloads(identification_settings)
    values = np.append(file_bodies(robot, model), np.zeros(len(model.columns)))
    first_payload = model.inertial - 10 * len(payloads)
    values[first_payload : model.inertial] = np.ravel(payloads)
    return model, values, loads_of(settings.loads, model.payloads, with_payloads=True), tuple(notes)


def of_folder(
    robot: ParallelMechanism, folder: Path, settings: ExcitationSettings
) -> tuple[ParallelModel, np.ndarray, Loads, tuple[str, ...]]:
    """Return the model of an identification's folder with its rows, its values (p,), the loads, and no notes."""
    refuse_currents(folder, "an excitation within torque limits")
    model, values = read_model(robot, folder)
    model = replace(model, torque_rows=rows_named(robot.mechanism, read_table(folder).get("kind", "")))
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
    """Return the design goal: a model's base columns under some loads, with the prior of the identification `after`.

    With `after` the columns are those of the identification; payloads that no load contains rest on the prior alone.
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
        base_columns = np.array([standard.index(standard_name(name, standard)) for name in names])
        units = tuple(model.units[k] for k in base_columns)
        chosen = values[base_columns]
    exact_model = replace(model, terms=model.terms)
    exact = LoadedPlatform(exact_model, base_columns, values, names=names, units=units, loads=loads)
    smooth_model = replace(model, terms=tuple(map(_smoothed, model.terms)))
    smooth = LoadedPlatform(smooth_model, base_columns, values, names=names, units=units, loads=loads)
    excited: Any = ExcitedModel(cast(Any, smooth), cast(Any, exact), chosen, covariance, folder is not None, notes)
    prior = read_prior((), excited, cast(Any, model.mechanism.robot), after)
    if prior is None:
        sigmas = np.ones(model.rows * len(loads))
    else:
        sigmas = prior.sigmas
    columns = selected_columns(IdentifiableColumns(None, sigmas, names), excited, settings, folder)
    return Purpose(excited, columns, prior)


def _smoothed(term: DriveTerm) -> DriveTerm:
    if term.shape == "sign":
        return replace(term, settings=(max(SMOOTH, term.settings[0]),))
    return term


def foretold(excitation: Any, states: int = 400) -> Any:
    """Return a motion with the predicted σ of parameters and of the actuators' torques, before and after it.

    States of the typical task are random: the platform in its box, actuators at up to half of their speeds.
    """
    inputs = excitation.inputs
    plan = cast(LoadedPlatform, excitation.plan)
    mechanism = excitation.robot.mechanism
    assert inputs.prior is not None and inputs.columns.sigmas is not None
    robot = mechanism.robot
    rng = np.random.default_rng([excitation.settings.seed, 3])
    sigmas = inputs.columns.sigmas
    times = excitation.period / INSTANTS * np.arange(INSTANTS)
    Y = plan.regressor(*excitation.orders(times)) / sigmas[:, None]
    new = np.einsum("nri,nrj->ij", Y, Y, optimize=True) * (excitation.period / INSTANTS)
    root_before = np.linalg.cholesky(_inverse(inputs.prior.information + 0.0 * new))
    root_after = np.linalg.cholesky(_inverse(inputs.prior.information + new))
    x = rng.uniform(robot.lower, robot.upper, (states, robot.r))
    still = loop_jacobians(mechanism, mechanism.home).readings[0]
    bounds = inputs.limits.bounds
    largest_rate = np.min(bounds.velocity / np.linalg.norm(still, axis=1))
    fast = 0.5 * largest_rate * np.ones(robot.r)
    directions = 2.0 * rng.random((2, states, robot.r)) - 1.0
    v, a = fast * directions * [[[1.0]], [[DEFAULT_RISE]]]
    W = model_rows(plan, plan.motion(x, v, a))

    def torque_sigma(root: np.ndarray) -> np.ndarray:
        return np.sqrt(np.mean(np.sum((W @ root) ** 2, axis=2), axis=0))

    def share(torques: np.ndarray) -> float:
        return float(np.sqrt(np.mean((torques / bounds.torque) ** 2)))

    torque_before = torque_sigma(root_before)
    torque_after = torque_sigma(root_after)
    prediction = MotionPrediction(excitation.period, excitation.period, torque_after, share(torque_after))
    outlook = MotionOutlook(share(torque_before), torque_before, prediction, (), share(torque_before))
    values = cast(np.ndarray, plan.values)[plan.columns].tolist()
    sigmas_before = np.linalg.norm(root_before, axis=1).tolist()
    sigmas_after = np.linalg.norm(root_after, axis=1).tolist()
    predicted = []
    for name, unit, value, before, after in zip(plan.names, plan.units, values, sigmas_before, sigmas_after):
        relative = 100.0 * after / abs(value) if value else None
        predicted.append(PredictedSigma(name, unit, value or None, after, relative, before))
    return replace(excitation, outlook=outlook, predicted=predicted)


def model_rows(plan: LoadedPlatform, motion: LoopMotion) -> np.ndarray:
    """Return the regressor (N, n, b) of the actuators' torques, redundant ones of least norm, with all payloads."""
    regressor = plan.model.platform_regressor(motion).transpose(2, 1, 0)
    W = regressor[plan.columns].transpose(2, 1, 0)
    distribution = np.linalg.pinv(motion.jacobians.readings)
    return distribution.transpose(0, 2, 1) @ W


def _inverse(information: np.ndarray) -> np.ndarray:
    unit = 1.0 / np.sqrt(np.diag(information))
    return np.linalg.inv(information * unit * unit[:, None]) * unit * unit[:, None]


def whole(model: ParallelModel, values: np.ndarray) -> Purpose:
    """Return the purpose of all base parameters, with σ of the rows that follows from equal noise of all torques."""
    mechanism = model.mechanism
    base = bases.find(ParallelModel(mechanism, model.terms, rows_named(mechanism), ()))
    columns = np.array([model.names.index(base.standard[k]) for k in base.kept])
    plan: Any = PlatformRegressor(model, columns, values)
    home_readings = loop_jacobians(mechanism, mechanism.home).readings[0]
    sigmas = np.linalg.norm(home_readings, axis=0)
    excited = ExcitedModel(plan, plan, None, None, False)
    return Purpose(excited, IdentifiableColumns(None, sigmas, base.names))
