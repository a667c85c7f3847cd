"""The dynamic model whose parameters a designed motion shall excite.

It is read from an identification, or built from the robot's description and options.
"""

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
from calib.errors import UsageError, listing, one_of, refused_as, require
from calib.folders import COVARIANCE, read_covariance
from calib.identification.model_file import from_table, read_table, refuse_currents, refuse_other_arm
from calib.identification.settings import IdentificationSettings, make_model
from calib.procedure.dynamic_stage.folder import IdentificationFolder
from calib.procedure.excitation.limits import MotionLimits, check_bodies
from calib.robot.chain import Chain

# postures in which gravity is held against the torque limits
MANY_POSTURES = 400
# share of these postures that the torque limits need not hold (our choice)
MAX_UNHELD = 0.5
# [rad/s or m/s] of the Coulomb sign while searching; the figures reported have the model's own
SMOOTH = 0.05
# inertial parameters of a body
BODY_PARAMETERS = 10


@dataclass(frozen=True, eq=False)
class ExcitedModel:
    """The dynamic model to excite, with known parameter values from which torques are predicted.

    Attributes:
        smooth: base model with a smoothed sign function of Coulomb friction, for the search.
        exact: base model with the sign function of the identification.
        values: (b,) base parameters; None if neither a model nor inertias are known.
        covariance: (b, b) covariance of the values; None if unknown.
        friction: whether the values include friction.
        notes: remarks for the user.
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
    """Return the model to excite, of an identification, or of the robot's inertias and the stated friction.

    Args:
        chain: the arm.
        folder: folder of an identification, whose torque rows are used; None: no identification.
        sets: names of drive terms of motor torques (``Ia Fv Fc off``), used without folder and options; empty: default
            terms.
        limits: limits of the motion, with the friction that the limits file states.
        options: options of the later identification, allowed only without a folder; None: defaults.
        loads: payloads of each run: ``none``, or labels joined by ``+``; empty: one run without, and one with each
            payload.
        nominal: arm on whose geometry the base parameters are selected, as in the identification; None: `chain`.

    Raises:
        UsageError: for an unknown payload, or if both folder and options are given.
    """
    if folder is not None:
        if options is not None:
            raise UsageError(
                f"identification {folder}: already states rows, drives and payloads; leave the options out"
            )
        return _identified(chain, folder, loads, nominal)
    notes = []
    if options is not None and not _designable(options.torque_rows):
        notes.append(f"designed for motor torques: a motion cannot be designed for rows = '{options.torque_rows.name}'")
        options = replace(options, torque_rows=MOTOR, sets=())
    payloads: list[str] = []
    if options is None:
        linear = [joint.kind == "prismatic" for joint in chain.joints]
        terms = drives.standard([sets or MOTOR.drives] * chain.n, V0, linear)
        model = IdentificationModel(bodies_of(chain), terms)
    else:
        payloads = [*options.payloads]
        model = make_model(chain, options)
    model, derivative_notes = _differentiable(model)
    cases = loads_of(loads, payloads, with_payloads=True)
    if options is not None and options.friction not in ("auto", "standard"):
        notes.append(
            f"designed for standard friction, since the terms of '{options.friction}' are chosen from recordings"
        )
    if chain.inertias is None and np.isfinite(limits.torque).any():
        sizes = ", ".join(f"{size:g}" for size in dict.fromkeys(limits.torque.tolist()))
        notes.append(f"NOT checked: torques (limits {sizes}), since the robot has no masses; name a model (--model)")
    notes += derivative_notes

    values = None
    friction: dict[str, np.ndarray] = {}
    if limits.friction is not None:
        friction = dict(zip(("velocity", "sign"), limits.friction))
    if chain.inertias is not None:
        check_bodies(chain, limits.torque)
        # all friction counts where the torque limits do
        side = "motor" if model.torque_rows.with_motors else "link"
        drive_values = []
        for term in model.columns:
            value = 0.0
            if term.shape in friction and term.side == side:
                joint = term.acts[0][0]
                value = friction[term.shape][joint]
            drive_values.append(value)
        payload_values, payload_notes = stated_payloads(options)
        values = np.concatenate([standard_parameters(chain), *payload_values, drive_values])
        notes += payload_notes
        if not friction:
            notes.append("friction is unknown (no model, no [friction]): torques are predicted without it")
    return excited_model(model, cases, values, bool(friction), notes, nominal)


def check_held(model: ExcitedModel, limits: MotionLimits) -> None:
    """Check that the torque limits suffice against gravity in at least half of the postures.

    Args:
        model: the model that predicts gravity torques.
        limits: limits of the motion with the torque limits.

    Raises:
        UsageError: if they do not, since the payload is too heavy, or the masses or limits are wrong.
    """
    if model.values is None:
        return
    exact, box = model.exact, limits.positions
    low = np.maximum(box.lower, -np.pi)
    high = np.minimum(box.upper, np.pi)
    q = low + (high - low) * np.random.default_rng(0).random((MANY_POSTURES, len(low)))
    torques = exact.regressor(q, 0.0 * q, 0.0 * q) @ model.values
    limit = exact.of_rows(limits.torque)
    unheld = float(np.mean((np.abs(torques) > limit).any(axis=1)))
    if unheld <= MAX_UNHELD:
        return
    posture, row = np.unravel_index(np.argmax(np.abs(torques) / limit), torques.shape)
    values = ", ".join(f"{value:.2f}" for value in q[posture])
    raise UsageError(
        f"gravity is beyond the torque limits in {unheld:.0%} of the postures: at {exact.row_names[row]} "
        f"{abs(torques[posture, row]):.4g}, limit {limit[row]:.4g} N m (or N), in the posture "
        f"{values} rad (or m); take a lighter payload, or correct masses or limits"
    )


def _designable(rows: TorqueRows) -> bool:
    """Return whether a motion can be designed for the given torque rows.

    The rows must depend on the rigid bodies, and must be differentiable.
    """
    return rows.has_bodies and rows.projection is None


def stated_payloads(options: IdentificationSettings | None) -> tuple[list[tuple[float, ...]], list[str]]:
    """Return the ten inertial parameters of each payload in the options, and notes on assumptions about the payloads.

    The parameters are zero for a payload without a stated mass.

    Args:
        options: options of the later identification; None: no payloads.
    """
    parameters: list[tuple[float, ...]] = []
    notes: list[str] = []
    if options is None:
        return parameters, notes
    for label, load in options.payloads.items():
        if load.mass is None:
            notes.append(f"NOT checked: torques with payload '{label}', whose mass is not stated")
        elif load.com is None:
            notes.append(f"payload '{label}': no com is stated; torques are predicted with its mass at the tip")
        at_tip = replace(load, com=load.com or (0.0, 0.0, 0.0))
        parameters.append(at_tip.parameters or (0.0,) * BODY_PARAMETERS)
    return parameters, notes


def loads_of(texts: Sequence[str], payloads: Sequence[str], with_payloads: bool) -> Loads:
    """Return the payload labels of each run of a motion.

    Without texts, the runs are one without payload and, if `with_payloads`, one for each payload.

    Args:
        texts: payloads of each run: ``none``, or labels joined by ``+``.
        payloads: labels of the known payloads.
        with_payloads: whether the payloads are carried by default.

    Raises:
        UsageError: for an unknown payload.
    """
    if not texts:
        if with_payloads and payloads:
            return ((), *((label,) for label in payloads))
        return (None,)
    runs = []
    for text in texts:
        labels: tuple[str, ...] = ()
        if text != "none":
            labels = tuple(part.strip() for part in text.split("+"))
        for label in labels:
            where = f"load '{text}': payload"
            require(
                payloads,
                f"{where} '{label}' is not known, since options or model have no payloads: leave it out",
                UsageError,
            )
            one_of(label, payloads, where, UsageError)
        runs.append(labels)
    return tuple(runs)


def _differentiable(model: IdentificationModel) -> tuple[IdentificationModel, list[str]]:
    """Return the model without drive terms that have no derivatives, and a note for the user that names these terms."""
    differentiable = tuple(term for term in model.columns if term.form.slopes)
    omitted = [term.name for term in model.columns if not term.form.slopes]
    notes = []
    if omitted:
        notes.append(f"the design does not include friction terms without derivatives: {listing(omitted)}")
    return replace(model, terms=differentiable), notes


def _identified(chain: Chain, folder: Path, texts: Sequence[str], nominal: Chain | None) -> ExcitedModel:
    """Return the model in an identification's folder, with the payloads that the runs carry, and its covariance.

    Terms that the identification switched off have no torque and are left out: their σ of next to zero is no knowledge.

    Args:
        chain: the arm.
        folder: folder of the identification.
        texts: payloads of each run: ``none``, or labels joined by ``+``.
        nominal: arm on whose geometry the base parameters are selected; None: `chain`.

    Raises:
        UsageError: if the identification belongs to another arm, or its torque rows are not suited for a design.
    """
    refuse_currents(folder, "an excitation within torque limits")
    refuse_other_arm(folder, chain)
    table = read_table(folder)
    unfit = f"{folder}/dynamics.json does not fit robot '{chain.name}' ({{}}); identify again"
    with refused_as(UsageError, (KeyError, TypeError, ValueError, IndexError), unfit):
        identified = from_table(chain, table)
    torque_rows = identified.model.torque_rows
    without_bodies = f"{folder}: rows 'drive' contain no information on the bodies"
    require(torque_rows.has_bodies, f"{without_bodies}; give an identification of motor torques", UsageError)
    if not _designable(torque_rows):
        torque_rows = MOTOR

    payloads = table.get("payloads", ())
    loads = loads_of(texts, payloads, with_payloads=False)
    run_labels = {label for run in loads for label in run or ()}
    bodies = bodies_with(chain, identified.model.bodies.gravity, [label for label in payloads if label in run_labels])
    switched_off = IdentificationFolder(folder).switched_off()
    terms = tuple(term for term in identified.model.columns if term.name not in switched_off)
    model, notes = _differentiable(IdentificationModel(bodies, terms, torque_rows))
    value_of = dict(zip(identified.model.names, identified.values))
    parameters = np.array([value_of[name] for name in model.names])
    if not np.isfinite(parameters).all():
        name = model.names[int(np.argmin(np.isfinite(parameters)))]
        raise UsageError(f"{folder}: parameter {name} of the model is not finite; identify again")
    friction = any(term.shape == "sign" for term in model.columns)
    excited = excited_model(model, loads, parameters, friction, notes, nominal)
    covariance = covariance_of(folder / COVARIANCE, excited.exact)
    if covariance is None:
        notes.append(f"{folder}/covariance.csv has other columns than the design: no torque margin for uncertainty")
    return replace(excited, covariance=covariance, notes=tuple(notes))


def bodies_with(chain: Chain, gravity: np.ndarray, payloads: Sequence[str]) -> Bodies:
    """Return the rigid bodies of a chain with payloads at the tip.

    Args:
        chain: the arm.
        gravity: (3,) gravity in the base frame [m/s²].
        payloads: labels of the payloads.
    """
    bodies = bodies_of(chain).with_gravity(np.asarray(gravity))
    for label in payloads:
        bodies = with_payload(bodies, np.asarray(chain.tail), label, on=chain.n - 1)
    return bodies


def moved_to(chain: Chain, model: IdentificationModel) -> IdentificationModel:
    """Return a model, including its payloads, with the geometry of another arm.

    Args:
        chain: the arm.
        model: the model.
    """
    return replace(model, bodies=bodies_with(chain, model.bodies.gravity, _payloads(model)))


def _payloads(model: IdentificationModel) -> list[str]:
    """Return the labels of a model's payloads, which are the bodies without a joint of their own."""
    bodies = zip(model.bodies.labels, model.bodies.coordinates)
    return [label for label, coordinate in bodies if coordinate < 0]


def excited_model(
    model: IdentificationModel,
    loads: Loads,
    values: np.ndarray | None,
    friction: bool,
    notes: Sequence[str] = (),
    nominal: Chain | None = None,
) -> ExcitedModel:
    """Return the base model to excite, from an identification model; for the search, Coulomb friction is smoothed.

    Args:
        model: the identification model.
        loads: payload labels of each run.
        values: (p,) values of the model's parameters; None: unknown.
        friction: whether the values include friction.
        notes: remarks for the user.
        nominal: arm on which the base columns are selected, as in the identification; None: the model's arm.
    """
    smooth_terms = []
    for term in model.terms:
        if term.shape == "sign":
            term = replace(term, settings=(max(SMOOTH, term.settings[0]),))
        smooth_terms.append(term)
    smooth = replace(model, terms=tuple(smooth_terms))
    nominal_model = None
    if nominal is not None:
        nominal_model = moved_to(nominal, model)
    base = base_parameters.find(model, loads=loads, nominal=nominal_model)
    base_values = None
    if values is not None:
        base_values = base.transform @ values
    # a body without a parameter of its own among the base columns cannot be identified
    identifiable = {model.names[k].removeprefix(name) for k in base.kept for name in STANDARD}
    lost = [label for label in _payloads(model) if label not in identifiable]
    if lost:
        notes = (
            *notes,
            f"payload {', '.join(lost)}: not identifiable from these loads; add another load, such as --load none",
        )
    return ExcitedModel(
        smooth=LoadCases(smooth, base, loads),
        exact=LoadCases(model, base, loads),
        values=base_values,
        covariance=None,
        friction=friction,
        notes=tuple(notes),
    )


def covariance_of(path: Path, model: LoadCases) -> np.ndarray | None:
    """Return the covariance (b, b) of a model's base columns, read from a file.

    None if the file is missing or contains other columns.

    Args:
        path: the CSV file.
        model: the model with its base columns.
    """
    names: Sequence[str] = ()
    covariance = np.empty((0, 0))
    if path.is_file():
        names, covariance = read_covariance(path)
    index = places(model.names, names, model.model.names)
    if index is None:
        return None
    return covariance[np.ix_(index, index)]
