"""Inputs of an excitation: a robot's model and limits, locked joints, and earlier motions that count."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.config import Tables
from calib.dynamics import base as base_parameters
from calib.dynamics import drives
from calib.dynamics.base import BaseModel, columns_at_rest, information
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.shapes import V0
from calib.errors import UsageError, require
from calib.folders import COVARIANCE, read_covariance
from calib.identification.identify_options import FileSettings
from calib.identification.model_file import from_table, read_table, refuse_currents
from calib.procedure.dynamic_stage.inputs import read_motion
from calib.procedure.excitation import coefficients
from calib.procedure.excitation.limits import MotionLimits, check_bodies, read_motion_limits
from calib.procedure.excitation.settings import ExcitationSettings
from calib.procedure.kinematic_stage.inputs import load_rigid
from calib.robot import description
from calib.robot.calibrated import ROBOT, CalibratedChain
from calib.robot.chain import Chain
from trajectories.constraints import BoxLimit

SMOOTH = 0.05  # [rad/s or m/s] of the Coulomb sign while searching; the figures reported have the model's own


@dataclass(frozen=True, eq=False)
class ExcitedModel:
    """The dynamic model to excite, with known parameter values to predict torques.

    Attributes:
        smooth: base model with the Coulomb sign smoothed for the search; `exact` with the model's own smoothing.
        values: (b,) base parameters; None where neither a model nor inertias are known.
        covariance: (b, b) or None.
        friction: whether friction is among the values.
        notes: what a user should know.
    """

    smooth: BaseModel
    exact: BaseModel
    values: np.ndarray | None
    covariance: np.ndarray | None
    friction: bool
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class IdentifiableColumns:
    """The columns that a motion can identify.

    Attributes:
        columns: (c,) of the model's; None: all of them.
        sigmas: (n,) infinite for torque rows that are left out; None: all rows count.
        names: of the columns; notes: what a user should know.
    """

    columns: np.ndarray | None
    sigmas: np.ndarray | None
    names: tuple[str, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class PriorMotions:
    """Information from earlier motions, recorded or designed.

    Attributes:
        names: of the files or folders.
        seconds: of motion.
        information: (b, b) ∫ ωᵀω dt, of the design's columns.
    """

    names: tuple[str, ...]
    seconds: float
    information: np.ndarray

    def per_sample(self, count: int, duration: float) -> np.ndarray:
        """Return the information per sample, if `count` samples represent `duration` seconds of new motion."""
        return self.information * (count / duration)


@dataclass(frozen=True, eq=False)
class ExcitationInputs:
    """Inputs of a design: robot, limits, model, locked joints, and earlier motions.

    Attributes:
        chain, limits, model: the arm, what it must keep, and the dynamics to excite.
        locked: joint index -> its fixed value; None: the search chooses it.
        columns: that the motion can identify.
        prior: motions that count already; None without any.
    """

    chain: Chain
    limits: MotionLimits
    model: ExcitedModel
    locked: Mapping[int, float | None]
    columns: IdentifiableColumns
    prior: PriorMotions | None


def read_inputs(
    robot: str | Path | CalibratedChain,
    settings: ExcitationSettings,
    model: Path | None = None,
    limits: Tables | None = None,
    base: str | None = None,
    tip: str | None = None,
) -> ExcitationInputs:
    """Read robot, limits, model and earlier motions of an excitation.

    Args:
        robot, base, tip: see `calib.robot.library`.
        model: folder of an identification: torques, friction and their uncertainty.
        limits: see `calib.procedure.excitation.limits`.

    Raises:
        UsageError, MeasurementError: for a file that cannot be read, or belongs to another robot.
    """
    chain, source = load_rigid(robot, None, base, tip)
    known = read_motion_limits(limits, chain, source, predicted=model is not None)
    dynamics = read_model(chain, model, settings.drives, known)
    locked = _read_locked(settings.lock, chain, known.positions)
    prior = read_prior(settings.existing, dynamics, chain)
    return ExcitationInputs(chain, known, dynamics, locked, identifiable(dynamics, chain, locked, prior), prior)


def read_model(chain: Chain, folder: Path | None, sets: str, limits: MotionLimits) -> ExcitedModel:
    """Return the model to excite: of an identification's folder, or the robot's own inertias and stated friction."""
    if folder is not None:
        return _identified(chain, folder)
    linear = [joint.kind == "prismatic" for joint in chain.joints]
    terms = drives.standard([sets] * chain.n, V0, linear)
    known = {} if limits.friction is None else dict(zip(("velocity", "sign"), limits.friction))
    values, notes = None, ()
    if chain.inertias is not None:
        check_bodies(chain, limits.torque)
        own = [known[one.shape][one.acts[0][0]] if one.shape in known else 0.0 for one in terms]
        values = np.concatenate([standard_parameters(chain), own])
        if not known:
            notes = ("friction is unknown (no model, no [friction]): torques are predicted without it",)
    return _dynamics(IdentificationModel(bodies_of(chain), terms), values, bool(known), notes)


def _identified(chain: Chain, folder: Path) -> ExcitedModel:
    """Return the model of an identification's folder without its payloads, and the covariance of its columns."""
    refuse_currents(folder, "an excitation within torque limits")
    table = read_table(folder)
    try:
        found = from_table(chain, table)
        require(found.model.torque_rows.has_bodies, "rows 'drive' contain no information on the bodies", ValueError)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        theirs = description.read(folder / ROBOT)
        if theirs.n != chain.n:
            message = f"{folder} is of a robot with {theirs.n} joints ({theirs.name}), {chain.name} has {chain.n}"
            raise UsageError(message) from error
        raise UsageError(f"{folder}/dynamics.json does not fit robot '{chain.name}': {error!r}") from error
    bodies = bodies_of(chain).with_gravity(np.asarray(found.model.bodies.gravity))
    numbers = found.values[: 10 * bodies.count]
    terms = list(zip(found.model.columns, found.values[found.model.inertial :]))
    kept = [(one, value) for one, value in terms if one.form.slopes]
    left = [one.name for one, _ in terms if not one.form.slopes]
    values = np.array([*numbers, *(value for _, value in kept)])
    if not np.isfinite(values).all():
        names = [*bodies.names, *(one.name for one, _ in kept)]
        raise UsageError(f"{folder}: parameter {names[int(np.argmin(np.isfinite(values)))]} of the model is not finite")
    notes = [f"predicted torques do not include friction terms without derivatives: {', '.join(left)}"] if left else []
    model = IdentificationModel(bodies, tuple(one for one, _ in kept))
    made = _dynamics(model, values, any(one.shape == "sign" for one, _ in kept))
    covariance = _covariance(folder, made.exact.names)
    if covariance is None:
        notes.append(f"{folder}/covariance.csv has other columns than the design: no torque margin for uncertainty")
    return replace(made, covariance=covariance, notes=tuple(notes))


def _dynamics(
    model: IdentificationModel, values: np.ndarray | None, friction: bool, notes: tuple[str, ...] = ()
) -> ExcitedModel:
    smoothed = (
        replace(one, settings=(max(SMOOTH, one.settings[0]),)) if one.shape == "sign" else one for one in model.terms
    )
    smooth = replace(model, terms=tuple(smoothed))
    found = base_parameters.find(model)
    chosen = None if values is None else found.transform @ values
    return ExcitedModel(BaseModel(smooth, found), BaseModel(model, found), chosen, None, friction, notes)


def _covariance(folder: Path, names: Sequence[str]) -> np.ndarray | None:
    """Return the covariance of the named columns; None if the file has other columns."""
    known, covariance = read_covariance(folder) if (folder / COVARIANCE).is_file() else ((), np.empty((0, 0)))
    if not set(names) <= set(known):
        return None
    index = [known.index(name) for name in names]
    return covariance[np.ix_(index, index)]


def _read_locked(texts: Sequence[str], chain: Chain, limits: BoxLimit) -> dict[int, float | None]:
    """Return the locked joints: index -> stated value (``joint4=0.5``, rad or m), or None if the search chooses it.

    Raises:
        UsageError: for an unknown joint, a value beyond its limits, or if all joints are locked.
    """
    known = {f"{word}{j + 1}": j for word in ("joint", "q") for j in range(chain.n)}
    known |= {name: j for j, name in enumerate(chain.joint_names)}
    found: dict[int, float | None] = {}
    for text in [part.strip() for word in texts for part in word.split(",")]:
        name, _, amount = (part.strip() for part in text.partition("="))
        if name not in known:
            raise UsageError(f"lock {text}: '{name}' is not a joint; joints: {', '.join(chain.joint_names)}")
        j = known[name]
        try:
            value = float(amount) if amount else None
        except ValueError:
            raise UsageError(f"lock {text}: '{amount}' is not a number") from None
        lower, upper = limits.lower[j], limits.upper[j]
        if value is not None and not lower <= value <= upper:
            raise UsageError(
                f"lock {text}: {chain.joint_names[j]} at {value:g} is beyond its limits {lower:.4g} to {upper:.4g}"
            )
        found[j] = value
    require(len(found) != chain.n, "lock: all joints are locked; leave at least one free", UsageError)
    return found


def identifiable(
    model: ExcitedModel, chain: Chain, locked: Mapping[int, float | None], prior: PriorMotions | None = None
) -> IdentifiableColumns:
    """Return the columns that a motion with locked joints, together with earlier motions, can identify."""
    names = model.exact.names
    if not locked:
        return IdentifiableColumns(None, None, names)
    known = None if prior is None else prior.information
    kept = columns_at_rest(model.exact, locked, *chain.sampling_limits(), known)
    sigmas = np.where(np.isin(np.arange(chain.n), list(locked)), np.inf, 1.0)
    still = ", ".join(chain.joint_names[j] for j in locked)
    gone = [name for k, name in enumerate(names) if k not in set(kept.tolist())]
    note = (
        f"locked: {still}; torques of locked joints are not used (stiction); {len(kept)} of {len(names)} "
        f"columns are identifiable ({len(gone)} are regrouped or have no effect: {', '.join(gone[:12])}"
        f"{', ...' if len(gone) > 12 else ''})"
    )
    return IdentifiableColumns(kept, sigmas, tuple(names[k] for k in kept), (note,) if gone else ())


def read_prior(paths: Sequence[str], model: ExcitedModel, chain: Chain) -> PriorMotions | None:
    """Return the information from recordings (``log.npz@0:9.4`` cuts) and folders of `calib excite`; None if none.

    Recordings are filtered and differentiated as `calib identify` does it.

    Raises:
        UsageError, MeasurementError: for a path that is neither, or belongs to another robot.
    """
    if not paths:
        return None
    total, seconds = np.zeros((len(model.exact.names),) * 2), 0.0
    for text in paths:
        designed = (Path(text) / coefficients.NAME).exists()
        q, v, a, rate = _designed(Path(text), chain) if designed else _recorded(text, chain)
        total += information(model.exact, q, v, a) / rate
        seconds += len(q) / rate
    return PriorMotions(tuple(str(path) for path in paths), seconds, total)


def _designed(folder: Path, chain: Chain) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return q, v, a of all periods of a designed motion, sampled at 50 Hz or more, and the sampling rate [Hz]."""
    found = coefficients.read(folder)
    if found.joint_names != tuple(chain.joint_names):
        raise UsageError(
            f"existing {folder}: the motion has joints {', '.join(found.joint_names)}; {chain.name} has "
            f"{', '.join(chain.joint_names)}"
        )
    count = max(1000, round(50 * found.period))
    q, v, a = found.orders(np.arange(count) * (found.period / count))
    every = found.repeat
    return np.tile(q, (every, 1)), np.tile(v, (every, 1)), np.tile(a, (every, 1)), count / found.period


def _recorded(text: str, chain: Chain) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    motion = read_motion(text, chain, FileSettings())
    present = motion.weight > 0.5
    return motion.q[present], motion.v[present], motion.a[present], motion.rate
