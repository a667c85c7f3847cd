"""The model that a motion is to excite, and the best there is to predict its torques with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.dynamics import base as base_parameters
from calib.dynamics import drives
from calib.dynamics.base import BaseModel
from calib.dynamics.bodies import bodies_of, standard_parameters, with_gravity
from calib.dynamics.drives import DriveTerm
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.shapes import V0
from calib.errors import UsageError
from calib.identification.model_file import from_table, read_covariance, read_table, refuse_currents
from calib.procedure.excitation.limits import MotionLimits
from calib.robot import description
from calib.robot.chain import Chain

SMOOTH = 0.05  # [rad/s or m/s] of the Coulomb sign while searching; the figures reported have the model's own


@dataclass(frozen=True, eq=False)
class ExcitedModel:
    """A model to excite, and the best there is to predict torques with.

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


def read_dynamics(chain: Chain, folder: Path | None, sets: str, limits: MotionLimits) -> ExcitedModel:
    """Return the model to excite: of an identification's folder, or the robot's own inertias and stated friction."""
    if folder is not None:
        return _identified(chain, folder)
    linear = [joint.kind == "prismatic" for joint in chain.joints]
    terms = drives.standard([sets] * chain.n, V0, linear)
    values, notes = None, []
    if chain.inertias is not None:
        known = {"velocity": 0, "sign": 1}
        own = [
            0.0 if limits.friction is None or one.shape not in known
            else limits.friction[known[one.shape], one.acts[0][0]]
            for one in terms
        ]  # fmt: skip
        values = np.concatenate([standard_parameters(chain), own])
    else:
        notes.append("the robot's masses are not known: torques are not limited")
    friction = limits.friction is not None
    if values is not None and not friction:
        notes.append("friction is not known (no --model, no [friction]): torques are predicted without it")
    model = IdentificationModel(bodies_of(chain), terms)
    return _dynamics(model, values, None, friction, tuple(notes))


def _identified(chain: Chain, folder: Path) -> ExcitedModel:
    """Read an identification; payloads are left ashore."""
    refuse_currents(folder, "an excitation within torque limits")
    table = read_table(folder)
    try:
        found = from_table(chain, table)
        if not found.model.torque_rows.has_bodies:
            raise ValueError("rows 'drive' tell nothing of the bodies")
    except (KeyError, TypeError, ValueError, IndexError) as error:
        theirs = description.read(folder / "robot.toml")
        if theirs.n != chain.n:
            message = f"{folder} is of a robot with {theirs.n} joints ({theirs.name}), {chain.name} has {chain.n}"
            raise UsageError(message) from error
        raise UsageError(f"{folder}/dynamics.json does not fit robot '{chain.name}': {error!r}") from error
    bodies = with_gravity(bodies_of(chain), np.asarray(found.model.bodies.gravity))
    numbers = found.values[: 10 * bodies.count]
    terms = list(zip(found.model.columns, found.values[found.model.inertial :]))
    kept = [(one, value) for one, value in terms if one.form.slopes is not None]
    left = [one.name for one, _ in terms if one.form.slopes is None]
    values = np.array([*numbers, *(value for _, value in kept)])
    if not np.isfinite(values).all():
        names = [*bodies.names, *(one.name for one, _ in kept)]
        raise UsageError(f"{folder}: parameter {names[int(np.argmin(np.isfinite(values)))]} of the model is not finite")
    notes = [f"terms without slopes are left out of the predicted torque: {', '.join(left)}"] if left else []
    model = IdentificationModel(bodies, tuple(one for one, _ in kept))
    made = _dynamics(model, values, None, any(one.shape == "sign" for one, _ in kept), ())
    covariance = _covariance(folder, made.exact.names)
    if covariance is None:
        notes.append(f"{folder}/covariance.csv does not fit the design's columns: the torque has no margin from it")
    return replace(made, covariance=covariance, notes=tuple(notes))


def _dynamics(
    model: IdentificationModel, values: np.ndarray | None, covariance: np.ndarray | None, friction: bool, notes: tuple
) -> ExcitedModel:
    smooth = replace(model, terms=tuple(_smoothed(one) for one in model.terms))
    found = base_parameters.find(model)
    chosen = None if values is None else found.transform @ values
    return ExcitedModel(BaseModel(smooth, found), BaseModel(model, found), chosen, covariance, friction, notes)


def _smoothed(one: DriveTerm) -> DriveTerm:
    return replace(one, settings=(max(SMOOTH, one.settings[0]),)) if one.shape == "sign" else one


def _covariance(folder: Path, names: Sequence[str]) -> np.ndarray | None:
    """Return the covariance of the named columns; None where the file has others."""
    found = read_covariance(folder)
    if found is None or not set(names) <= set(found[0]):
        return None
    index = [found[0].index(name) for name in names]
    return found[1][np.ix_(index, index)]
