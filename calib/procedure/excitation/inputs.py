"""Inputs of an excitation: model to identify, loads, limits, locked joints, and earlier motions to include."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, cast

import numpy as np

from calib.config import Tables
from calib.dynamics import base as base_parameters
from calib.dynamics import drives
from calib.dynamics.base import columns_at_rest, information, places, standard_name
from calib.dynamics.bodies import STANDARD, Bodies, bodies_of, standard_parameters, with_payload
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.load_cases import LoadCases
from calib.dynamics.regressor_model import Loads
from calib.dynamics.shapes import V0
from calib.dynamics.torque_rows import MOTOR, TorqueRows
from calib.errors import UsageError, one_of, require
from calib.extensions import offered
from calib.folders import COVARIANCE, read_covariance
from calib.identification.identify_options import FileSettings
from calib.identification.model_file import from_table, read_table, refuse_currents, refuse_other_arm
from calib.identification.settings import IdentificationSettings, make_model
from calib.procedure.dynamic_stage.folder import IdentificationFolder
from calib.procedure.dynamic_stage.geometry_tables import TORQUE_COVARIANCE
from calib.procedure.dynamic_stage.inputs import read_motion
from calib.procedure.excitation import coefficients
from calib.procedure.excitation.limits import MotionLimits, check_bodies, read_motion_limits
from calib.procedure.excitation.settings import ExcitationSettings
from calib.procedure.kinematic_stage.inputs import load_rigid
from calib.robot.calibrated import CalibratedChain
from calib.robot.chain import Chain
from trajectories.constraints import BoxLimit

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


@dataclass(frozen=True, eq=False)
class IdentifiableColumns:
    """The columns that a motion can identify.

    Attributes:
        columns: (c,) of the model's; None: all of them.
        sigmas: (rows,) by which torque rows are divided, see `PriorMotions`; infinite for rows left out; None: 1.
        names: of the columns; notes: what a user should know.
        chosen: (k,) of the model's, for which the motion is designed while the others are estimated, too; None: all.
    """

    columns: np.ndarray | None
    sigmas: np.ndarray | None
    names: tuple[str, ...]
    notes: tuple[str, ...] = ()
    chosen: np.ndarray | None = None

    @property
    def aimed(self) -> np.ndarray | None:
        """The model's columns whose condition number counts; None: all."""
        return self.columns if self.chosen is None else self.chosen

    @property
    def aimed_names(self) -> tuple[str, ...]:
        """Names of the columns whose condition number counts."""
        own = range(len(self.names)) if self.columns is None else self.columns
        return tuple(name for k, name in zip(own, self.names) if self.chosen is None or k in self.chosen)

    @property
    def kept(self) -> np.ndarray | slice:
        """Index of the identifiable columns among all columns of the model."""
        return slice(None) if self.columns is None else self.columns


class GeometrySpread(Protocol):
    """Principal errors of a calibrated geometry, g_1 … g_r: √λ_i u_i of its covariance Σ λ_i u_i u_iᵀ."""

    @property
    def before(self) -> np.ndarray:
        """Changes (b, r) of the parameters of an earlier identification by each error; zero without one."""
        ...

    def felt(self, values: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the torques' changes (N, rows, r) by each error at fixed base parameters `values` (b,)."""
        ...


@dataclass(frozen=True, eq=False)
class PriorMotions:
    """Information matrix of earlier motions, recorded or designed.

    Attributes:
        names: of the files or folders.
        seconds: of motion.
        information: (b, b) ∫ ωᵀω dt, of the design's columns, rows in units of `sigmas`.
        sigmas: (rows,) root of the torque errors' density, where an identification states it; None: 1.
    """

    names: tuple[str, ...]
    seconds: float
    information: np.ndarray
    sigmas: np.ndarray | None = None

    def per_sample(self, count: int, duration: float) -> np.ndarray:
        """Return the information (b, b) per sample of a new motion of `duration` seconds and `count` samples."""
        return self.information * (count / duration)


@dataclass(frozen=True, eq=False)
class ExcitationInputs:
    """Inputs of a design: robot, limits, model, locked joints, and earlier motions.

    Attributes:
        chain, limits, model: the arm, what it must keep, and the dynamics to excite.
        locked: joint index -> its fixed value; None: the search chooses it.
        columns: that the motion can identify.
        prior: motions that count already; None without any.
        geometry: its uncertainty, of a calibrated robot whose torques can be predicted; None elsewhere.
    """

    chain: Chain
    limits: MotionLimits
    model: ExcitedModel
    locked: Mapping[int, float | None]
    columns: IdentifiableColumns
    prior: PriorMotions | None
    geometry: GeometrySpread | None = None

    @property
    def errors_known(self) -> bool:
        """Whether an identification states the errors of the torques."""
        return self.prior is not None and self.prior.sigmas is not None


def read_inputs(
    robot: str | Path | CalibratedChain,
    settings: ExcitationSettings,
    model: Path | None = None,
    limits: Tables | None = None,
    base: str | None = None,
    tip: str | None = None,
    options: IdentificationSettings | None = None,
    after: Path | None = None,
) -> ExcitationInputs:
    """Read robot, limits, model and earlier motions of an excitation.

    Args:
        robot, base, tip: see `calib.robot.library`.
        model: folder of an identification: torques, friction and their uncertainty.
        limits: see `calib.procedure.excitation.limits`.
        options: of the identification that will follow: torque rows, drive terms, payloads.
        after: folder of an identification that the motion shall add to: its model, information and torque errors.

    Raises:
        UsageError, MeasurementError: for a file that cannot be read, or belongs to another robot.
    """
    require(after is None or model is None, "after: its folder is also the model; leave --model out", UsageError)
    model = model or after
    if settings.drives and (model is not None or options is not None):
        raise UsageError(
            f"drives '{settings.drives}': {model or 'the options file'} states the drive terms; leave it out"
        )
    found, source = load_rigid(robot, None, base, tip)
    chain, nominal = found.chain, found.nominal if found.moved else None
    known = read_motion_limits(limits, chain, source, predicted=model is not None)
    if settings.within:
        orders = _designed(Path(settings.within), chain)[:3]
        known = known.narrowed([(one.min(axis=0), one.max(axis=0)) for one in orders])
    if settings.noise is not None and (after is not None or known.noise is not None):
        raise UsageError(f"noise: {after or '[noise] of the limits file'} states the torque errors; leave --noise out")
    dynamics = read_model(chain, model, settings.drives, known, options, settings.loads, nominal)
    _check_held(dynamics, known)
    noise = None if known.noise is None or after is not None else known.noise[dynamics.exact.joint_of_row]
    locked = _read_locked(settings.lock, chain, known.positions)
    spreads = [find(robot, source, chain, dynamics, after) for find in offered("geometry_spread")]
    spread = next(iter(spreads), None)
    prior = read_prior(settings.existing, dynamics, chain, after, noise, spread)
    columns = selected_columns(identifiable(dynamics, chain, locked, prior, noise), dynamics, settings, model)
    return ExcitationInputs(chain, known, dynamics, locked, columns, prior, spread)


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
        drive_values = [known[one.shape][one.acts[0][0]] if one.shape in known and one.side == side else 0.0
                        for one in model.columns]  # fmt: skip
        payloads, said = stated_payloads(options)
        values = np.concatenate([standard_parameters(chain), *payloads, drive_values])
        notes += said
        if not known:
            notes.append("friction is unknown (no model, no [friction]): torques are predicted without it")
    return excited_model(model, cases, values, bool(known), notes, nominal)


def _check_held(model: ExcitedModel, limits: MotionLimits) -> None:
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
    try:
        found = from_table(chain, table)
        require(found.model.torque_rows.has_bodies, "rows 'drive' contain no information on the bodies", ValueError)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise UsageError(f"{folder}/dynamics.json does not fit robot '{chain.name}': {error!r}") from error
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
    covariance = _covariance(folder / COVARIANCE, made.exact)
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


def _covariance(path: Path, model: LoadCases) -> np.ndarray | None:
    """Return the covariance of a model's columns; None if the file has other columns."""
    known, covariance = read_covariance(path) if path.is_file() else ((), np.empty((0, 0)))
    index = places(model.names, known, model.model.names)
    return None if index is None else covariance[np.ix_(index, index)]


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
    model: ExcitedModel, chain: Chain, locked: Mapping[int, float | None], prior: PriorMotions | None = None,
    noise: np.ndarray | None = None,
) -> IdentifiableColumns:  # fmt: skip
    """Return the columns that a motion with locked joints, together with earlier motions, can identify.

    Args:
        noise: (rows,) by which torque rows are divided, where no earlier motion states it; None: 1.
    """
    names = model.exact.names
    known, sigmas = (
        (None, noise) if prior is None else (prior.information, noise if prior.sigmas is None else prior.sigmas)
    )
    if not locked:
        return IdentifiableColumns(None, sigmas, names)
    still = np.isin(model.exact.joint_of_row, list(locked))
    kept = columns_at_rest(model.exact, locked, *chain.sampling_limits(), known, np.flatnonzero(still))
    sigmas = np.where(still, np.inf, 1.0 if sigmas is None else sigmas)
    gone = [name for k, name in enumerate(names) if k not in set(kept.tolist())]
    note = (
        f"locked: {', '.join(chain.joint_names[j] for j in locked)}; their torques are not used "
        f"(stiction); {len(kept)} of {len(names)} "
        f"columns are identifiable ({len(gone)} are regrouped or have no effect: {', '.join(gone[:12])}"
        f"{', ...' if len(gone) > 12 else ''})"
    )
    return IdentifiableColumns(kept, sigmas, tuple(names[k] for k in kept), (note,) if gone else ())


def selected_columns(
    found: IdentifiableColumns, model: ExcitedModel, settings: ExcitationSettings, folder: Path | None
) -> IdentifiableColumns:
    """Return the identifiable columns that the settings request: by name, or the essential ones of an identification.

    Raises:
        UsageError: for an unknown parameter, or ``essential`` without a folder.
    """
    requested = [name.strip() for text in settings.columns for name in text.split(",")]
    if not requested:
        return found
    standard = model.exact.model.names
    short = {standard_name(name, standard): name for name in found.names}
    if "essential" in requested:
        require(
            folder is not None, "columns 'essential': needs --model with the folder of an identification", UsageError
        )
        requested.remove("essential")
        essential = IdentificationFolder(cast(Path, folder)).essential()
        requested += [name for name in essential if standard_name(name, standard) in short]  # friction has derivatives
    for name in requested:
        one_of(standard_name(name, standard), short, "columns: parameter", UsageError)
    chosen = {short[standard_name(name, standard)] for name in requested}
    kept = np.array([k for k, name in enumerate(model.exact.names) if name in chosen])
    return replace(found, chosen=kept)


def read_prior(
    paths: Sequence[str], model: ExcitedModel, chain: Chain, after: Path | None = None,
    noise: np.ndarray | None = None, geometry: GeometrySpread | None = None,
) -> PriorMotions | None:  # fmt: skip
    """Return the information from recordings (``log.npz@0:9.4`` cuts) and folders of `calib excite`; None if none.

    Recordings are filtered and differentiated as `calib identify` does it. What an identification `after` knows, its
    prior included, is the inverse of its covariance, without the part of the geometry.

    Args:
        noise: (rows,) by which torque rows are divided where no identification states it; None: 1.

    Raises:
        UsageError, MeasurementError: for a path that is neither, or belongs to another robot.
    """
    if not paths and after is None:
        return None
    total, seconds, sigmas = np.zeros((len(model.exact.names),) * 2), 0.0, None
    names, trained = [], ()
    if after is not None:
        total, sigmas = _known(after, model, geometry)
        names, trained = ["what is identified"], tuple(IdentificationFolder(after).metrics().identification)
    for text in paths:
        if Path(text).name in trained:
            raise UsageError(f"existing {text}: {after} was identified from this recording; leave it out")
        designed = (Path(text) / coefficients.NAME).exists()
        q, v, a, rate = _designed(Path(text), chain) if designed else _recorded(text, chain)
        total += information(model.exact, q, v, a, noise if sigmas is None else sigmas) / rate
        seconds += len(q) / rate
    return PriorMotions((*names, *paths), seconds, total, sigmas)


def _known(folder: Path, model: ExcitedModel, geometry: GeometrySpread | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the information (b, b) of an identification, and the square root of its torque error density (rows,).

    Args:
        geometry: where it is given, its part is not in the information.
    """
    density, path = IdentificationFolder(folder).metrics().error_density, folder / COVARIANCE
    path = path if geometry is None else folder / TORQUE_COVARIANCE
    covariance = _covariance(path, model.exact)
    if density is None or len(density) != model.exact.model.rows:
        raise UsageError(f"{folder}/metrics.json has no error_density of the torque rows; identify again")
    if covariance is None:
        raise UsageError(
            f"{path} is missing or lacks columns of the design; if the model has payloads, state each run's load "
            "(--load none --load tool)"
        )
    spread = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    # what a constraint holds has no spread and gains nothing: as if known to a millionth (our choice)
    spread = np.where(spread > 0.0, spread, np.maximum(1e-6 * np.abs(cast(np.ndarray, model.values)), 1e-12))
    unit = covariance / np.outer(spread, spread)
    np.fill_diagonal(unit, 1.0 + 1e-9)
    if not np.linalg.eigvalsh(unit)[0] > 0.0:
        raise UsageError(f"{path} is not positive definite, so it is damaged; identify again")
    return np.linalg.inv(unit) / np.outer(spread, spread), np.tile(np.sqrt(density), len(model.exact.loads))


def _designed(folder: Path, chain: Chain) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return q, v, a of all periods of a designed motion, sampled at 50 Hz or more, and the sampling rate [Hz]."""
    found = coefficients.read(folder)
    if found.joint_names != tuple(chain.joint_names):
        raise UsageError(
            f"{folder}: the motion has joints {', '.join(found.joint_names)}; {chain.name} has "
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
