"""Inputs of an excitation: model to identify, limits, locked joints, columns, and earlier motions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.config import Tables
from calib.dynamics.base import columns_at_rest, standard_name
from calib.errors import UsageError, one_of, refused_as, require
from calib.identification.settings import IdentificationSettings
from calib.procedure.dynamic_stage.folder import IdentificationFolder
from calib.procedure.excitation.excited_model import ExcitedModel, check_held, read_model
from calib.procedure.excitation.geometry_spread import geometry_spread
from calib.procedure.excitation.limits import MotionLimits, read_motion_limits
from calib.procedure.excitation.prior_motions import PrincipalErrors, PriorMotions, designed_orders, read_prior
from calib.procedure.excitation.settings import ExcitationSettings
from calib.procedure.kinematic_stage.inputs import load_rigid
from calib.robot.calibrated import CalibratedChain
from calib.robot.chain import Chain
from calib.trajectories.constraints import BoxLimit

# columns without effect that a note names
LISTED_COLUMNS = 12


@dataclass(frozen=True, eq=False)
class IdentifiableColumns:
    """The columns (base parameters) that a motion can identify.

    Attributes:
        columns: (c,) indices of the identifiable columns among the model's base columns; None: all columns.
        sigmas: (rows,) standard deviations by which torque rows are divided; infinite: excluded rows; None: 1.
        names: names of the identifiable columns.
        notes: remarks for the user.
        chosen: (k,) indices of the columns for which the motion is designed, although all identifiable columns are
            estimated; None: all identifiable columns.
    """

    columns: np.ndarray | None
    sigmas: np.ndarray | None
    names: tuple[str, ...]
    notes: tuple[str, ...] = ()
    chosen: np.ndarray | None = None

    @property
    def aimed(self) -> np.ndarray | None:
        """Indices of the model's columns whose condition number is minimised; None: all columns."""
        if self.chosen is None:
            return self.columns
        return self.chosen

    @property
    def aimed_names(self) -> tuple[str, ...]:
        """Names of the columns whose condition number is minimised."""
        if self.chosen is None:
            return self.names
        columns = range(len(self.names)) if self.columns is None else self.columns
        return tuple(name for column, name in zip(columns, self.names) if column in self.chosen)

    @property
    def kept(self) -> np.ndarray | slice:
        """Index expression that selects the identifiable columns among all columns of the model."""
        if self.columns is None:
            return slice(None)
        return self.columns


@dataclass(frozen=True, eq=False)
class ExcitationInputs:
    """Inputs of a design: robot, limits, model, locked joints, and earlier motions.

    Attributes:
        chain, limits, model: the arm, the limits of its motion, and the dynamic model to excite.
        locked: joint index -> fixed value [rad or m]; None: the search chooses the value.
        columns: columns that the motion can identify.
        prior: information of earlier motions; None: no earlier motions.
        geometry: uncertainty of a calibrated robot's geometry; None if the robot is not calibrated or torques are
            unknown.
        source: the robot's description, as named by the user; empty if unknown.
    """

    chain: Chain
    limits: MotionLimits
    model: ExcitedModel
    locked: Mapping[int, float | None]
    columns: IdentifiableColumns
    prior: PriorMotions | None
    geometry: PrincipalErrors | None = None
    source: str = ""

    @property
    def errors_known(self) -> bool:
        """Whether an earlier identification states the standard deviations of the torque errors."""
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
    """Return the inputs of an excitation: robot, limits, model and earlier motions, read from their files.

    Args:
        robot: name of a library robot, file (URDF, or MDH table in TOML), folder of a fit, or a robot in memory.
        settings: settings of the design.
        model: folder of an identification, from which torques, friction and their uncertainty are taken; None: from the
            robot's description.
        limits: limits file (`calib formats limits`), or its content as tables; None: limits of the robot's description.
        base, tip: first and last link of the arm in a URDF; None: its root, and its flange.
        options: options of the later identification: torque rows, drive terms, payloads; None: defaults.
        after: folder of an identification whose recordings the motion shall complement; it replaces `model`, and its
            information and torque errors are used; None: none.

    Raises:
        UsageError, MeasurementError: for a file that cannot be read, or belongs to another robot.
    """
    require(after is None or model is None, "after: its folder is also the model; leave --model out", UsageError)
    model = model or after
    if settings.drives and (model is not None or options is not None):
        raise UsageError(
            f"drives '{settings.drives}': {model or 'the options file'} states the drive terms; leave drives out"
        )
    calibrated, source = load_rigid(robot, None, base, tip)
    chain = calibrated.chain
    nominal = calibrated.nominal if calibrated.moved else None
    motion_limits = read_motion_limits(limits, chain, source, predicted=model is not None)
    if settings.within:
        q, v, a, _ = designed_orders(Path(settings.within), chain)
        motion_limits = motion_limits.narrowed([(values.min(axis=0), values.max(axis=0)) for values in (q, v, a)])
    if settings.noise is not None and (after is not None or motion_limits.noise is not None):
        raise UsageError(f"noise: {after or '[noise] of the limits file'} states the torque errors; leave --noise out")
    dynamics = read_model(chain, model, settings.drives, motion_limits, options, settings.loads, nominal)
    check_held(dynamics, motion_limits)
    # an identification states the torque errors itself
    noise = None
    if motion_limits.noise is not None and after is None:
        noise = motion_limits.noise[dynamics.exact.joint_of_row]
    locked = _read_locked(settings.lock, chain, motion_limits.positions)
    spread = geometry_spread(robot, source, chain, dynamics, after)
    prior = read_prior(settings.existing, dynamics, chain, after, noise, spread)
    columns = identifiable(dynamics, chain, locked, prior, noise)
    columns = selected_columns(columns, dynamics, settings, model)
    return ExcitationInputs(
        chain=chain,
        limits=motion_limits,
        model=dynamics,
        locked=locked,
        columns=columns,
        prior=prior,
        geometry=spread,
        source=calibrated.source or str(source),
    )


def _read_locked(texts: Sequence[str], chain: Chain, limits: BoxLimit) -> dict[int, float | None]:
    """Return the locked joints: joint index -> stated value [rad or m], or None if the search chooses the value.

    Args:
        texts: locked joints, such as ``joint4`` or ``joint4=0.5``.
        chain: the arm.
        limits: limits of the joint positions.

    Raises:
        UsageError: for an unknown joint, a value beyond the joint limits, or if all joints are locked.
    """
    index: dict[str, int] = {}
    for j in range(chain.n):
        index[f"joint{j + 1}"] = j
        index[f"q{j + 1}"] = j
    index |= {name: j for j, name in enumerate(chain.joint_names)}
    locked: dict[int, float | None] = {}
    for text in ",".join(texts).split(",") if texts else ():
        text = text.strip()
        name, _, amount = (part.strip() for part in text.partition("="))
        if name not in index:
            raise UsageError(f"lock {text}: '{name}' is not a joint; joints: {', '.join(chain.joint_names)}")
        j = index[name]
        with refused_as(UsageError, ValueError, f"lock {text}: '{amount}' is not a number"):
            value = float(amount) if amount else None
        lower, upper = limits.lower[j], limits.upper[j]
        if value is not None and not lower <= value <= upper:
            raise UsageError(
                f"lock {text}: {chain.joint_names[j]} at {value:g} is beyond its limits {lower:.4g} to {upper:.4g}"
            )
        locked[j] = value
    require(len(locked) != chain.n, "lock: all joints are locked; leave at least one free", UsageError)
    return locked


def identifiable(
    model: ExcitedModel,
    chain: Chain,
    locked: Mapping[int, float | None],
    prior: PriorMotions | None = None,
    noise: np.ndarray | None = None,
) -> IdentifiableColumns:
    """Return the columns that a motion with locked joints, together with earlier motions, can identify.

    Args:
        model: the model to excite.
        chain: the arm.
        locked: joint index -> fixed value [rad or m]; None: the search chooses the value.
        prior: information of earlier motions; None: no earlier motions.
        noise: (rows,) σ of the torque rows, used if no earlier motion states σ; None: 1.
    """
    names = model.exact.names
    information = None
    sigmas = noise
    if prior is not None:
        information = prior.information
        if prior.sigmas is not None:
            sigmas = prior.sigmas
    if not locked:
        return IdentifiableColumns(None, sigmas, names)
    # torques of joints that do not move are not used: stiction
    locked_row = np.isin(model.exact.joint_of_row, list(locked))
    limits = chain.sampling_limits()
    columns = columns_at_rest(model.exact, locked, *limits, information, np.flatnonzero(locked_row))
    sigmas = np.where(locked_row, np.inf, 1.0 if sigmas is None else sigmas)
    notes: tuple[str, ...] = ()
    identifiable_columns = set(columns.tolist())
    lost = [name for k, name in enumerate(names) if k not in identifiable_columns]
    if lost:
        joints = ", ".join(chain.joint_names[j] for j in locked)
        listed = ", ".join(lost[:LISTED_COLUMNS])
        if len(lost) > LISTED_COLUMNS:
            listed += ", ..."
        notes = (
            f"locked: {joints}; their torques are not used "
            f"(stiction); {len(columns)} of {len(names)} "
            f"columns are identifiable ({len(lost)} are regrouped or have no effect: {listed})",
        )
    return IdentifiableColumns(columns, sigmas, tuple(names[k] for k in columns), notes)


def selected_columns(
    columns: IdentifiableColumns, model: ExcitedModel, settings: ExcitationSettings, folder: Path | None
) -> IdentifiableColumns:
    """Return the identifiable columns that the settings request: by name, or the essential ones of an identification.

    Args:
        columns: the identifiable columns.
        model: the model to excite.
        settings: settings of the design.
        folder: folder of the identification; None: no identification.

    Raises:
        UsageError: for an unknown parameter, or ``essential`` without a folder.
    """
    requested = [name.strip() for text in settings.columns for name in text.split(",")]
    if not requested:
        return columns
    standard = model.exact.model.names
    column_of = {standard_name(name, standard): name for name in columns.names}
    if "essential" in requested:
        if folder is None:
            raise UsageError("columns 'essential': needs --model with the folder of an identification")
        requested.remove("essential")
        # friction terms without derivatives are no columns of a design
        essential = IdentificationFolder(folder).essential()
        requested += [name for name in essential if standard_name(name, standard) in column_of]
    selected = set()
    for name in requested:
        short_name = standard_name(name, standard)
        one_of(short_name, column_of, "columns: parameter", UsageError)
        selected.add(column_of[short_name])
    chosen = np.array([k for k, name in enumerate(model.exact.names) if name in selected])
    return replace(columns, chosen=chosen)
