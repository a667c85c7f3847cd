"""The dynamic model that a motion shall excite: from an identification, or from the robot and options."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.dynamics import base as base_parameters
from calib.dynamics import drives
from calib.dynamics.base import places
from calib.dynamics.bodies import STANDARD, Bodies, bodies_of, standard_parameters, with_payload
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.load_cases import LoadCases
from calib.dynamics.regressor_model import Loads
from calib.dynamics.shapes import V0
from calib.dynamics.torque_rows import MOTOR, TorqueRows
from calib.errors import UsageError, one_of, refused_as, require
from calib.folders import COVARIANCE, read_covariance
from calib.identification.model_file import from_table, read_table, refuse_currents, refuse_other_arm
from calib.identification.settings import IdentificationSettings, make_model
from calib.procedure.excitation.limits import MotionLimits, check_bodies
from calib.robot.chain import Chain

MANY_POSTURES, MAX_UNHELD = 400, 0.5  # postures; share of them that the torque limits need not hold (our choice)
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

    smooth: LoadCases
    exact: LoadCases
    values: np.ndarray | None
    covariance: np.ndarray | None
    friction: bool
    notes: tuple[str, ...] = ()


def read_model(
    chain: Chain,
    folder: Path | None,
    sets: str,
    limits: MotionLimits,
    options: IdentificationSettings | None = None,
    loads: Sequence[str] = (),
    nominal: Chain | None = None,
) -> ExcitedModel:
    """Return the model to excite: from an identification's folder, or from the robot's inertias and the given friction.

    Args:
        folder: of an identification; its torque rows count, and its payloads that `loads` names.
        sets: drive terms of motor torques, where there are neither folder nor options.
        options: of the identification that will follow, where there is no folder.
        loads: see `ExcitationSettings`.
        nominal: see `excited_model`.

    Raises:
        UsageError: for an unknown payload.
    """
    if folder is not None:
        if options is not None:
            raise UsageError(
                f"identification {folder}: already states rows, drives and payloads; leave the options out"
            )
        return _identified(chain, folder, loads, nominal)
    notes = []
    if options is not None and not _designable(options.torque_rows):
        notes = [f"designed for motor torques: a motion cannot be designed for rows = '{options.torque_rows.name}'"]
        options = replace(options, torque_rows=MOTOR, sets=())
    if options is None:
        linear = [joint.kind == "prismatic" for joint in chain.joints]
        model = IdentificationModel(bodies_of(chain), drives.standard([sets or MOTOR.drives] * chain.n, V0, linear))
    else:
        model = make_model(chain, options)
    model, left = _differentiable(model)
    cases = loads_of(loads, [] if options is None else [*options.payloads], with_payloads=True)
    if options is not None and options.friction not in ("auto", "standard"):
        notes.append(f"designed for standard friction: the step '{options.friction}' has its terms from recordings")
    if chain.inertias is None and np.isfinite(limits.torque).any():
        sizes = ", ".join(f"{x:g}" for x in dict.fromkeys(limits.torque.tolist()))
        notes.append(f"NOT checked: torques (limits {sizes}), since the robot has no masses; name a model (--model)")
    known = {} if limits.friction is None else dict(zip(("velocity", "sign"), limits.friction))
    values, notes = None, notes + left
    if chain.inertias is not None:
        check_bodies(chain, limits.torque)
        side = "motor" if model.torque_rows.with_motors else "link"  # where all friction counts, as the limits do
        drive_values = [
            known[one.shape][one.acts[0][0]] if one.shape in known and one.side == side else 0.0
            for one in model.columns
        ]
        payloads, said = stated_payloads(options)
        values = np.concatenate([standard_parameters(chain), *payloads, drive_values])
        notes += said
        if not known:
            notes.append("friction is unknown (no model, no [friction]): torques are predicted without it")
    return excited_model(model, cases, values, bool(known), notes, nominal)


def check_held(model: ExcitedModel, limits: MotionLimits) -> None:
    """Raise an error where gravity is beyond the torque limits in most postures: payload too heavy, or wrong masses."""
    if model.values is None:
        return
    exact, box = model.exact, limits.positions
    low, high = np.maximum(box.lower, -np.pi), np.minimum(box.upper, np.pi)
    q = low + (high - low) * np.random.default_rng(0).random((MANY_POSTURES, len(low)))
    torques, held = exact.regressor(q, 0.0 * q, 0.0 * q) @ model.values, exact.of_rows(limits.torque)
    beyond = float(np.mean((np.abs(torques) > held).any(axis=1)))
    posture, row = np.unravel_index(np.argmax(np.abs(torques) / held), torques.shape)
    words = (
        f"gravity is beyond the torque limits in {beyond:.0%} of the postures: at {exact.row_names[row]} "
        f"{abs(torques[posture, row]):.4g}, limit {held[row]:.4g} N m (or N), in the posture "
        f"{', '.join(f'{x:.2f}' for x in q[posture])} rad (or m); take a lighter payload, or correct masses or limits"
    )
    require(beyond <= MAX_UNHELD, words, UsageError)


def _designable(rows: TorqueRows) -> bool:
    """Return whether a motion can be designed for torque rows: they depend on the bodies and are differentiable."""
    return rows.has_bodies and rows.projection is None


def stated_payloads(options: IdentificationSettings | None) -> tuple[list[tuple[float, ...]], list[str]]:
    """Return the ten parameters of each payload, and notes on assumptions about the payloads."""
    result, notes = [], []
    for label, load in ({} if options is None else options.payloads).items():
        if load.mass is None:
            notes.append(f"NOT checked: torques with payload '{label}', whose mass is not stated")
        elif load.com is None:
            notes.append(f"payload '{label}': no com is stated; torques are predicted with its mass at the tip")
        result.append(replace(load, com=load.com or (0.0, 0.0, 0.0)).parameters or (0.0,) * 10)
    return result, notes


def loads_of(texts: Sequence[str], known: Sequence[str], with_payloads: bool) -> Loads:
    """Return the payload labels of each run; by default none, then each known one alone if `with_payloads`."""
    if not texts:
        return ((), *((label,) for label in known)) if with_payloads and known else (None,)
    result = []
    for text in texts:
        labels = () if text == "none" else tuple(part.strip() for part in text.split("+"))
        for label in labels:
            where = f"load '{text}': payload"
            require(known, f"{where} '{label}' is not known: options or model have no payloads", UsageError)
            one_of(label, known, where, UsageError)
        result.append(labels)
    return tuple(result)


def _differentiable(model: IdentificationModel) -> tuple[IdentificationModel, list[str]]:
    """Return the model without drive terms that have no derivatives, and a note that names them."""
    left = [one.name for one in model.columns if not one.form.slopes]
    notes = [f"the design does not include friction terms without derivatives: {', '.join(left)}"] if left else []
    return replace(model, terms=tuple(one for one in model.columns if one.form.slopes)), notes


def _identified(chain: Chain, folder: Path, texts: Sequence[str], nominal: Chain | None) -> ExcitedModel:
    """Return the model of an identification's folder with the payloads of the loads, and its covariance."""
    refuse_currents(folder, "an excitation within torque limits")
    refuse_other_arm(folder, chain)
    table = read_table(folder)
    words = f"{folder}/dynamics.json does not fit robot '{chain.name}' ({{}}); identify again"
    with refused_as(UsageError, (KeyError, TypeError, ValueError, IndexError), words):
        found = from_table(chain, table)
    words = f"{folder}: rows 'drive' contain no information on the bodies; give an identification of motor torques"
    require(found.model.torque_rows.has_bodies, words, UsageError)
    loads = loads_of(texts, table.get("payloads", ()), with_payloads=False)
    run = {label for carried in loads for label in carried or ()}
    values = dict(zip(found.model.names, found.values))
    carried = [label for label in table.get("payloads", ()) if label in run]
    bodies = bodies_with(chain, found.model.bodies.gravity, carried)
    rows = found.model.torque_rows if _designable(found.model.torque_rows) else MOTOR
    model, notes = _differentiable(IdentificationModel(bodies, found.model.columns, rows))
    parameters = np.array([values[name] for name in model.names])
    if not np.isfinite(parameters).all():
        name = model.names[int(np.argmin(np.isfinite(parameters)))]
        raise UsageError(f"{folder}: parameter {name} of the model is not finite")
    made = excited_model(model, loads, parameters, any(one.shape == "sign" for one in model.columns), notes, nominal)
    covariance = covariance_of(folder / COVARIANCE, made.exact)
    if covariance is None:
        notes.append(f"{folder}/covariance.csv has other columns than the design: no torque margin for uncertainty")
    return replace(made, covariance=covariance, notes=tuple(notes))


def bodies_with(chain: Chain, gravity: np.ndarray, payloads: Sequence[str]) -> Bodies:
    """Return the bodies of a chain, gravity (3,) in its base frame [m/s²], with payloads at its tip."""
    bodies = bodies_of(chain).with_gravity(np.asarray(gravity))
    for label in payloads:
        bodies = with_payload(bodies, np.asarray(chain.tail), label, on=chain.n - 1)
    return bodies


def moved_to(chain: Chain, model: IdentificationModel) -> IdentificationModel:
    """Return a model, payloads included, on another geometry of its arm."""
    payloads = [label for label, c in zip(model.bodies.labels, model.bodies.coordinates) if c < 0]
    return replace(model, bodies=bodies_with(chain, model.bodies.gravity, payloads))


def excited_model(
    model: IdentificationModel,
    loads: Loads,
    values: np.ndarray | None,
    friction: bool,
    notes: Sequence[str] = (),
    nominal: Chain | None = None,
) -> ExcitedModel:
    """Return the base model to excite, with a smoothed Coulomb sign for the search, from an identification model.

    Args:
        loads: payload labels of each run.
        values: (p,) of the model's parameters; None: unknown.
        friction: whether friction is among the values.
        nominal: the arm that base columns are chosen on, as by the identification; None: the model's own.
    """
    smoothed = (
        replace(one, settings=(max(SMOOTH, one.settings[0]),)) if one.shape == "sign" else one for one in model.terms
    )
    smooth = replace(model, terms=tuple(smoothed))
    there = None if nominal is None else moved_to(nominal, model)
    found = base_parameters.find(model, loads=loads, nominal=there)
    chosen = None if values is None else found.transform @ values
    own = {model.names[k].removeprefix(name) for k in found.kept for name in STANDARD}
    lost = [label for label, c in zip(model.bodies.labels, model.bodies.coordinates) if c < 0 and label not in own]
    if lost:
        notes = (*notes, f"payload {', '.join(lost)}: not identifiable from these loads; run others, too: --load none")
    return ExcitedModel(
        LoadCases(smooth, found, loads), LoadCases(model, found, loads), chosen, None, friction, tuple(notes)
    )


def covariance_of(path: Path, model: LoadCases) -> np.ndarray | None:
    """Return the covariance of a model's columns; None if the file has other columns."""
    known, covariance = read_covariance(path) if path.is_file() else ((), np.empty((0, 0)))
    index = places(model.names, known, model.model.names)
    return None if index is None else covariance[np.ix_(index, index)]
