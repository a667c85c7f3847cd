"""Settings of an identification: drive terms, weights of the rows, and elimination of parameters."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from calib.config import strict
from calib.config_types import Checked, Expect, Flag, JointNumber, Names, OneOf, Positive, Real, Spread, Text, Whole
from calib.dynamics import drives
from calib.dynamics.bodies import Bodies, bodies_of, with_payload
from calib.dynamics.drives import DriveTerm
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.shapes import V0
from calib.dynamics.torque_rows import MOTOR, TorqueRows
from calib.errors import UsageError, refuse_option, require
from calib.identification.earlier import EarlierChoice
from calib.identification.friction.friction_ladder import NAMES
from calib.identification.friction.friction_terms import FrictionTerm
from calib.identification.loop import LoopSettings, check_loop, per_joint
from calib.identification.methods.constraint_settings import ConstraintSettings
from calib.identification.methods.method import Method
from calib.identification.registry import METHODS
from calib.robot.chain import Chain

RULES = ("none", "rsd", "f", "both")
PRIORS = ("auto", "none", "cad")
WEIGHTS = ("residuals", "repeats")


@strict
@dataclass(frozen=True)
class Coupling:
    """A gear whose motor turns with the sum of two joints (from 0), as in `calib.dynamics.drives.coupled`."""

    joints: Annotated[tuple[JointNumber, JointNumber], Expect("two joint numbers, counted from 1")]
    label: Text = ""


@strict
@dataclass(frozen=True)
class Payload:
    """A body at the flange; None for what is unknown.

    Attributes:
        mass: its mass [kg]
        com: its centre of mass in the tip's frame [m]
    """

    mass: Annotated[float, Real(above=0, most=1e4, unit="kg")] | None = None
    com: Annotated[tuple[float, float, float], Expect("three numbers [m]")] | None = None

    @property
    def parameters(self) -> tuple[float, ...] | None:
        """Ten standard parameters of a point mass, in the tip's frame [SI]; None if mass or centre is unknown."""
        if self.mass is None or self.com is None:
            return None
        x, y, z = self.com
        inertia = (y * y + z * z, -x * y, -x * z, x * x + z * z, -y * z, x * x + y * y)
        per_mass = (*inertia, x, y, z, 1.0)
        return tuple(self.mass * value for value in per_mass)

    def __str__(self) -> str:
        """Return the stated mass and centre of mass: ``3.28 kg at 0,0,0.05``, or that the mass is unknown."""
        mass = "mass unknown" if self.mass is None else f"{self.mass:g} kg"
        if self.com is None:
            return mass
        position = ",".join(f"{coordinate:g}" for coordinate in self.com)
        return f"{mass} at {position}"


def mass_as_payload(value: object) -> object:
    """Return the table of a payload that is stated by its mass alone; other values as they are."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return {"mass": value}
    return value


@dataclass(frozen=True)
class Choices:
    """Settings with the same names in options files and code; the defaults suit a serial arm with motor torques.

    Attributes:
        passive: drive terms of a parallel robot's passive joints, one text for all.
        identical_legs: whether a parallel robot's legs have the same inertial parameters.
        v0: smoothing of the Coulomb sign [rad/s or m/s], one per joint, or one for all.
        friction: model of the drives' friction; auto selects steps of the ladder by the errors on held-out time.
        method: name of the method, see `calib.identification.methods.least_squares`.
        weights: source of the joints' weights in WLS, one of `WEIGHTS`: residuals, or variance over repeats.
        essential: rule to stop eliminating parameters, one of `RULES`.
        ratio, level: r_σ of the RSD rule, significance level of the F rule.
        keep, drop: parameters never eliminated, or eliminated first.
        prior: towards CAD values or rods (``auto``) or CAD values only (``cad``), with sizes by evidence, or
            not at all (``none``).
        gravity: gravity in the base frame [m/s²]; None: the robot's.
        samples: largest number of rows per torque; longer recordings use only every second, third, ... row.
        folds: number of parts of the motion, with their repetitions, for cross-validation.
        deflections: whether joint corrections of the fit (compliance, gears, encoders) move the links; never where the
            closed loop is simulated.
        with_geometry: whether the geometry is estimated again together with the dynamics (calib identify
            --with-geometry).
        loop: the closed loop in which recordings were made, for instrumental variables.
        constraints: constraints on parameters for the methods pc-*; None: their defaults. By a function of parameters,
            or a file of it, also for ols, wls and iv.
    """

    passive: Text = ""
    identical_legs: Flag = False
    v0: Annotated[tuple[Positive, ...], Spread()] = (V0,)
    friction: Annotated[str, OneOf(NAMES)] = "auto"
    method: Annotated[str, OneOf(tuple(METHODS))] = "wls"
    weights: Annotated[str, OneOf(WEIGHTS)] = "residuals"
    essential: Annotated[str, OneOf(RULES)] = "both"
    ratio: Positive = 20.0
    level: Annotated[float, Real(above=0, most=1.0)] = 0.05
    keep: Names = ()
    drop: Names = ()
    prior: Annotated[str, OneOf(PRIORS)] = "auto"
    gravity: Annotated[tuple[float, float, float], Expect("three numbers [m/s²]")] | None = None
    samples: Annotated[int, Whole(1000, 10_000_000)] = 20_000
    folds: Annotated[int, Whole(2, 50)] = 6
    deflections: Flag = True
    with_geometry: Flag = False
    loop: Annotated[LoopSettings, Checked(check_loop)] | None = None
    constraints: Annotated[ConstraintSettings | None, Checked(ConstraintSettings.of)] = None


@dataclass(frozen=True)
class IdentificationSettings(Choices):
    """All settings of an identification.

    Attributes:
        sets: names of the standard drive terms, one text per joint, or one for all; empty: those of the rows.
        torque_rows: kind of torques to explain.
        couplings, terms: couplings and torque terms in addition to the model of single joints.
        functions: torque terms that are functions, of a script.
        payloads: label → known mass and centre of mass.
        payload_values: label → ten standard parameters in the tip's frame, from a gain identification;
            these, or else the stated mass and centre, are used where no training recording has the payload.
        seed: seed of random states.
        apart: joints, from 0, whose torque has a different unit, excluded from totals.
        earlier: choice of an earlier identification, which is carried on; None: none.
    """

    sets: tuple[str, ...] = ()
    torque_rows: TorqueRows = MOTOR
    couplings: tuple[Coupling, ...] = ()
    terms: tuple[DriveTerm, ...] = ()
    functions: tuple[FrictionTerm, ...] = ()
    payloads: Mapping[str, Payload] = field(default_factory=dict)
    payload_values: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    seed: int = 0
    apart: tuple[int, ...] = ()
    earlier: EarlierChoice | None = None


def make_model(chain: Chain, settings: IdentificationSettings) -> IdentificationModel:
    """Return the model of a chain: bodies, payloads at the tip, and drive terms.

    Args:
        chain: the arm.
        settings: settings, with drive terms, payloads and gravity.

    Raises:
        UsageError: for settings that do not apply to this chain.
    """
    require(
        not (settings.passive or settings.identical_legs),
        "passive, identical_legs: for parallel robots only; remove them",
        UsageError,
    )
    _check_joints(chain.n, settings)
    linear = [joint.kind == "prismatic" for joint in chain.joints]
    values = settings.sets or (settings.torque_rows.drives,)
    sets = per_joint(values, chain.n, "drives")
    v0 = per_joint(settings.v0, chain.n, "v0")
    terms = list(drives.standard(sets, v0, linear))
    for coupling in settings.couplings:
        first, second = coupling.joints
        names = {term.name for term in terms}
        coupled = drives.coupled(first, second, v0=v0[second], label=coupling.label or None)
        for term in coupled:
            if term.name in names:
                label = f"{first + 1}_{second + 1}"
                raise UsageError(
                    f'coupling: {term.name} is already a joint\'s parameter; add another label: label = "{label}"'
                )
        terms += coupled
    for term in settings.terms:
        if term.acts:
            first_row, _ = term.acts[0]
            term = replace(term, linear=linear[first_row])
        terms.append(term)
    for function in settings.functions:
        for term in function.drive_terms(chain):
            names = {earlier.name for earlier in terms}
            if term.name in names:
                raise UsageError(
                    f"FrictionTerm {function.name}: {term.name} is already a parameter: choose another name"
                )
            terms.append(term)
    bodies = make_bodies(chain, settings)
    return IdentificationModel(bodies, tuple(terms), settings.torque_rows)


def make_bodies(chain: Chain, settings: IdentificationSettings) -> Bodies:
    """Return the bodies of a chain under the stated gravity, with payloads at the tip.

    Args:
        chain: the arm.
        settings: settings, with gravity and payloads.
    """
    bodies = bodies_of(chain)
    if settings.gravity is not None:
        bodies = bodies.with_gravity(np.array(settings.gravity))
    for label in settings.payloads:
        on = chain.n - 1
        placement = np.asarray(chain.tail)
        bodies = with_payload(bodies, placement, label, on=on)
    return bodies


def _check_joints(n: int, settings: IdentificationSettings) -> None:
    """Raise a UsageError for couplings or terms of unknown joints, and for a joint coupled with itself.

    Args:
        n: number of joints.
        settings: settings, with couplings and terms.
    """
    for coupling in settings.couplings:
        numbers = [joint + 1 for joint in coupling.joints]
        require(max(numbers) <= n, f"coupling: joints {numbers}: the robot has joints 1 to {n}", UsageError)
    for term in settings.terms:
        joints = []
        for row, motion in term.acts:
            joints.append(row)
            joints += [joint for joint, _ in motion]
        number = max(joints, default=0) + 1
        message = f"term '{term.name}': joint {number}: the robot has joints 1 to {n}"
        require(number <= n, message, UsageError)
    for coupling in settings.couplings:
        first, second = coupling.joints
        if first == second:
            raise UsageError(f"coupling: joint {first + 1} is coupled with itself; name two joints")


def require_usable(settings: IdentificationSettings, method: Method) -> IdentificationSettings:
    """Return the settings for a method, with friction = "auto" replaced by its meaning for this method.

    Args:
        settings: the requested settings.
        method: the method that will be used.

    Raises:
        UsageError: for a missing loop, or torque rows or friction that the method does not support; the message names
            the methods that do.
    """
    option = f"method '{method.name}'"
    rows, friction = settings.torque_rows, settings.friction
    if method.needs_controller and settings.loop is None:
        refuse_option(
            option,
            "needs the closed loop: state [loop] controller = … in the options file (calib formats "
            "identify-options), and log or state the reference; from q and torque alone use wls or irls",
        )
    if not method.takes(rows):
        supporting = [name for name, candidate in METHODS.items() if candidate.takes(rows)]
        refuse_option(
            option, f"rows = '{rows.name}' is not supported; methods that support it: {', '.join(supporting)}"
        )
    if friction == "auto":
        return replace(settings, friction=method.auto_friction)
    if friction != "standard" and not method.takes_models:
        supporting = [name for name, candidate in METHODS.items() if candidate.takes_models]
        refuse_option(
            option,
            f"supports standard friction only, not friction = '{friction}'; methods that support it: "
            f"{', '.join(supporting)}",
        )
    return settings
