"""Calibrated robot: the result of a geometric fit as used by all later steps, and its files in the fit's folder.

``robot.toml`` holds the chain (`calib.robot.description`) and beside it::

    [provenance]
    robot = "ur5.urdf"               # the description that was calibrated
    nominal = [0.0, 0.1625, ...]     # its element values
    rigid = [0.0, 0.1627, ...]       # those of the best geometry without joint corrections, where there are any
    [deflection]                     # the joint corrections; formula in `calib.robot.calibrated`
    reference = [0.0, 0.1, ...]      # element values of the chain that levers are taken from (the nominal one)
    masses = [[0.1, ...], ...]       # XX .. M of its bodies, where these were identified: gravity torques are right,
                                     # single parameters are not
    [[deflection.term]]
    element = "q3.offset"            # the element it moves
    basis = "sin"                    # torque, moment, lever, joint, cos, sin
    joint = "q4"                     # the joint (or the body behind it) it comes from
    order = 2                        # k of sin and cos; axis of a lever (0 x, 1 y, 2 z)
    coefficient = 1.2e-5

``chain_covariance.csv`` next to it: the covariance [m, rad] of the element values of the best geometry without
corrections (``provenance.rigid``, if present), by name; elements that are not in it were not fitted.

Deflections are effects beyond the joint angles: compliance under gravity, coupled axes, encoder and gear errors.

Every effect is linear in its coefficients and adds to the displacement of one element of the chain:

    δ_e(q) = Σ_terms c · b(q),    b one of

    torque        τ_j(q), gravity torque at joint j [N m]: c is the compliance [rad/N m]
    moment        moment about the element's own axis that balances the weight of all that it carries [N m]: c is the
                  compliance of a bearing or link across the joint's axis
    lever         (z_e × R_i e_a) · ĝ, the moment about the element's axis z_e of a first moment of link i along its
                  axis a (0 x, 1 y, 2 z), gravity being a unit vector: sag where the masses are not known
    joint         q_i: gear ratio error (i = j) or coupling of another axis (i ≠ j)
    cos, sin      cos(k q_i), sin(k q_i): harmonics of order k
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from calib.config_types import ParsedTable
from calib.errors import CalibError, RobotError, one_of, refuse_robot
from calib.folders import read_covariance, write_covariance
from calib.records import Floats, as_numbers, frozen, shaped
from calib.robot import description
from calib.robot.chain import Chain
from calib.robot.kinematics import forward, gravity_moments, joint_frames, sweep, tip_jacobian
from calib.robot.tables import check_keys, number, vector

LOG = logging.getLogger(__name__)
ROBOT = "robot.toml"
COVARIANCE = "chain_covariance.csv"
# those that need masses or torques, and scale with the load
BY_TORQUE = ("torque", "moment")
BASES = (*BY_TORQUE, "lever", "joint", "cos", "sin")


@dataclass(frozen=True)
class Term:
    """One deflection effect, which adds a displacement to an element of the chain.

    Attributes:
        element: name of the moved element.
        basis: name of the basis function: torque, moment, lever, joint, cos or sin.
        source: index of the joint or link on which the basis function depends.
        order: order k of sin and cos; axis of a lever (0 x, 1 y, 2 z).
    """

    element: str
    basis: str
    source: int
    order: int = 0

    def __post_init__(self) -> None:
        one_of(self.basis, BASES, "deflection basis")


@dataclass(frozen=True, eq=False)
class Deflection:
    """Deflection terms (joint corrections) with their coefficients.

    Attributes:
        terms: the E effects.
        coefficients: (E,) coefficients [unit of the element per unit of the basis function].
        reference: the chain for which levers and gravity torques are computed. It is the nominal one, so that the basis
            functions do not change while the geometry is fitted.
    """

    terms: tuple[Term, ...] = ()
    coefficients: np.ndarray | tuple[float, ...] = ()
    reference: Chain | None = None

    def with_coefficients(self, values: np.ndarray) -> Deflection:
        return replace(self, coefficients=np.asarray(values, dtype=float))

    def names(self, chain: Chain) -> tuple[str, ...]:
        """Return one name per term for tables, such as ``theta3 per N·m`` or ``theta3 sin 2 q4``.

        Args:
            chain: the arm, which provides names and kinds of joints and elements.
        """
        return tuple(_name(term, chain) for term in self.terms)


def _name(term: Term, chain: Chain) -> str:
    source = chain.joint_names[term.source]
    if term.basis in BY_TORQUE:
        return f"{term.element} compliance"
    if term.basis == "lever":
        return f"{term.element} sag of {source} {'xyz'[term.order]}"
    if term.basis == "joint":
        return f"{term.element} per {source}"
    return f"{term.element} {term.basis} {term.order} {source}"


def evaluate(
    deflection: Deflection, q: np.ndarray, torque: np.ndarray | None = None, load: np.ndarray | None = None
) -> np.ndarray:
    """Return the values (E, m) of the terms' basis functions at joint values q (m, n).

    Args:
        deflection: the terms, with their reference chain.
        q: (m, n) joint values [rad or m].
        torque: (m, n) gravity torques [N m], for terms with the basis ``torque``; None: computed from the reference
            chain's masses and the load.
        load: (m, 4) first moments [kg m] and mass [kg] that the last body carries beyond the reference chain's masses,
            in its frame; None for no load.

    Raises:
        CalibError: a term needs gravity torques, and the reference chain has no masses.
    """
    bases = {term.basis for term in deflection.terms}
    moments = np.zeros((0, len(q)))
    if "moment" in bases or (torque is None and "torque" in bases):
        moments = _reference_moments(deflection, q, load)
    if torque is None and "torque" in bases and deflection.reference is not None:
        torque = moments[deflection.reference.driven].T @ deflection.reference.rates
    result = np.empty((len(deflection.terms), len(q)))
    highest: dict[int, int] = {}
    for term in deflection.terms:
        if term.basis in ("cos", "sin"):
            highest[term.source] = max(term.order, highest.get(term.source, 0))
    # exp(i k q) as products: a quarter of the time of cosines.
    powers: dict[int, np.ndarray] = {}
    for j, order in highest.items():
        factors = np.tile(np.exp(1j * q[:, j]), (order, 1))
        powers[j] = np.cumprod(factors, axis=0)
    for e, term in enumerate(deflection.terms):
        if term.basis == "torque" and torque is not None:
            result[e] = torque[:, term.source]
        elif term.basis == "moment" and deflection.reference is not None:
            result[e] = moments[deflection.reference.names.index(term.element)]
        elif term.basis == "joint":
            result[e] = q[:, term.source]
        elif term.basis in ("cos", "sin"):
            power = powers[term.source][term.order - 1]
            result[e] = power.real if term.basis == "cos" else power.imag
    lever_terms = [e for e, term in enumerate(deflection.terms) if term.basis == "lever"]
    if lever_terms:
        chain = deflection.reference
        if chain is None:
            raise CalibError("sag terms need reference, the chain from which lever arms are computed")
        gravity = chain.gravity / np.linalg.norm(chain.gravity)
        # (z × u) · ĝ = (ĝ × z) · u
        gravity_cross_axis = np.cross(gravity, np.moveaxis(sweep(chain, q).directions, 1, -1))
        frames = joint_frames(chain, q)
        for e in lever_terms:
            term = deflection.terms[e]
            element = chain.names.index(term.element)
            link_axis = frames[term.source, :, :3, term.order]
            result[e] = np.einsum("mi,mi->m", gravity_cross_axis[element], link_axis)
    return result


def _reference_moments(deflection: Deflection, q: np.ndarray, load: np.ndarray | None) -> np.ndarray:
    """Return the gravity moments (K, m) [N m] about the elements of the deflection's reference chain.

    Args:
        deflection: the terms, with their reference chain.
        q: (m, n) joint values [rad or m].
        load: (m, 4) load of the last body, as of `evaluate`; None for no load.
    """
    chain = deflection.reference
    if chain is None or chain.inertias is None:
        raise CalibError("a compliance needs gravity torques: state the robot's masses, or have them fitted")
    return gravity_moments(chain, q, load)


def extra_displacements(
    chain: Chain, deflection: Deflection, q: np.ndarray, bases: np.ndarray | None = None
) -> np.ndarray | None:
    """Return the displacements (K, m) [rad or m] that the deflection adds to the K elements; None without terms.

    Args:
        chain: the arm.
        deflection: the terms with their coefficients.
        q: (m, n) joint values [rad or m].
        bases: (E, m) values of the basis functions at q; None to compute them.
    """
    if not deflection.terms:
        return None
    if bases is None:
        bases = evaluate(deflection, q)
    coefficients = np.asarray(deflection.coefficients)
    targets = target_elements(chain, deflection)
    extra = np.zeros((len(chain.elements), len(q)))
    for element in np.unique(targets):
        of_element = targets == element
        extra[element] = coefficients[of_element] @ bases[of_element]
    return extra


def target_elements(chain: Chain, deflection: Deflection) -> np.ndarray:
    """Return the index (E,) of the element of `chain` that each term of `deflection` moves."""
    table = {name: k for k, name in enumerate(chain.names)}
    return np.array([table[term.element] for term in deflection.terms], dtype=int)


@dataclass(frozen=True, eq=False)
class CorrectedChain:
    """Geometry fitted together with joint corrections; it is valid only in combination with these corrections.

    Attributes:
        chain: the geometry.
        deflection: the corrections (at least one term).
        covariance: (K + E, K + E) covariance of the chain's element values and the corrections' coefficients; None if
            unknown.
    """

    chain: Chain
    deflection: Deflection
    covariance: np.ndarray | None = None


@dataclass(frozen=True, eq=False, repr=False)
class CalibratedChain:
    """Robot resulting from a geometric fit: input of identification, excitation, export and compensation.

    ``print`` shows the robot's joints and their limits.

    Attributes:
        chain: the best geometry without joint corrections, for URDF export.
        nominal: the arm before calibration; None if unknown.
        covariance: (K, K) covariance of the chain's element values [m, rad], zero for elements that were not fitted;
            None without a fit.
        corrections: joint corrections and the geometry fitted with them; None without corrections.
        source: the calibrated robot description, as the user named it; empty if unknown.
    """

    chain: Chain
    nominal: Chain | None = None
    covariance: np.ndarray | None = None
    corrections: CorrectedChain | None = None
    source: str = ""

    def __post_init__(self) -> None:
        if self.covariance is not None:
            count = len(self.chain.elements)
            shaped(self.covariance, (count, count), "covariance of the chain's elements")
            object.__setattr__(self, "covariance", frozen(self.covariance))

    @property
    def complete(self) -> Chain:
        """Geometry with the best prediction: the one fitted with the corrections if any, otherwise `chain`."""
        return self.chain if self.corrections is None else self.corrections.chain

    @property
    def deflection(self) -> Deflection:
        """Joint corrections of the robot; without terms if it has none."""
        return Deflection() if self.corrections is None else self.corrections.deflection

    def __repr__(self) -> str:
        return f"<CalibratedChain {self.chain.name}: {self.chain.n} joints, {self._state}>"

    def __str__(self) -> str:
        rows: list[tuple[str, ...]] = [("joint", "", "from", "to", "speed", "effort")]
        for joint in self.chain.joints:
            limits = (joint.lower, joint.upper, joint.velocity, joint.effort)
            rows.append((joint.name, f"{joint.kind} [{joint.unit}]", *(f"{limit:.4g}" for limit in limits)))
        widths = [max(map(len, column)) for column in zip(*rows)]
        lines = [f"{self.chain.name}: {self.chain.base} to {self.chain.tip}, {self._state}"]
        if self.chain.ends:
            lines.append(f"the arm ends at {self.chain.ends}")
        for row in rows:
            cells = [cell.ljust(width) for cell, width in zip(row, widths)]
            lines.append("  ".join(cells).rstrip())
        return "\n".join(lines)

    @property
    def _state(self) -> str:
        parts = ["calibrated" if self.moved else "nominal geometry"]
        if self.corrections is not None:
            parts.append(f"{len(self.deflection.terms)} joint corrections")
        parts.append("without masses" if self.chain.inertias is None else "with masses")
        return ", ".join(parts)

    @property
    def moved(self) -> bool:
        """Whether the nominal arm is known and the calibration changed one of its element values."""
        return self.nominal is not None and not np.array_equal(self.nominal.values, self.chain.values)

    def forward(self, q: ArrayLike, torque: np.ndarray | None = None, load: np.ndarray | None = None) -> Floats:
        """Return the tip's poses in the base frame [m]: (m, 4, 4) at joint values (m, n), (4, 4) at (n,).

        If the robot has joint corrections, they are applied to the geometry that was fitted with them.

        Args:
            q: joint values (m, n) [rad or m], or (n,) for one pose.
            torque: gravity torques [N m] in the shape of `q`, for corrections by compliance; None: computed from the
                masses that the fit used.
            load: (m, 4) first moments [kg m] and mass [kg] that the last body carries beyond those masses, in its
                frame; None for no load.

        Raises:
            CalibError: an array of a wrong shape, or corrections by compliance without torques or masses.
        """
        values = self.joint_rows(q)
        bases = None
        if self.deflection.terms:
            torques = None if torque is None else shaped(np.atleast_2d(torque), values.shape, "torque")
            bases = evaluate(self.deflection, values, torques, load)
        poses = forward(self.complete, values, extra_displacements(self.complete, self.deflection, values, bases))
        return like_joints(q, poses)

    def jacobian(self, q: ArrayLike) -> Floats:
        """Return the tip's Jacobians [v; ω] in the base frame: (m, 6, n) at joint values (m, n), (6, n) at (n,).

        v is the velocity of the tip, ω its angular velocity, per unit joint velocity. The derivatives of joint
        corrections are not included.

        Args:
            q: joint values (m, n) [rad or m], or (n,) for one pose.

        Raises:
            CalibError: joint values of a wrong shape.
        """
        return like_joints(q, tip_jacobian(self.complete, self.joint_rows(q)))

    def joint_rows(self, q: ArrayLike) -> np.ndarray:
        """Return joint values (m, n) [rad or m]; those of one pose (n,) as one row.

        Raises:
            CalibError: joint values of a wrong shape.
            UsageError: joint values that are no numbers.
        """
        rows = np.atleast_2d(as_numbers(q, "q"))
        return shaped(rows, (None, self.chain.n), "q")

    def without_corrections(self) -> CalibratedChain:
        """Return the robot without its joint corrections, as a URDF can describe it."""
        return replace(self, corrections=None)


def like_joints(q: ArrayLike, values: np.ndarray) -> np.ndarray:
    """Return values (m, ...) of m poses as they are, those of one pose (1, ...) without their first axis.

    Args:
        q: the joint values as the user gave them: (m, n), or (n,) for one pose.
        values: one entry per pose.
    """
    return values[0] if np.ndim(q) == 1 else values


def as_calibrated(robot: Chain | CalibratedChain) -> CalibratedChain:
    """Return a calibrated robot unchanged; a plain chain becomes a robot without covariance and nominal geometry."""
    return robot if isinstance(robot, CalibratedChain) else CalibratedChain(robot)


def read(path: str | Path) -> CalibratedChain:
    """Return the calibrated robot in the folder of a fit or an identification, or in any ``robot.toml``.

    Args:
        path: the folder, or the file.

    Raises:
        RobotError: an invalid file; the message names the file and the error.
    """
    return read_whole(path)[0]


def read_whole(path: str | Path) -> tuple[CalibratedChain, ParsedTable]:
    """Return the calibrated robot, as `read` does, and the extra tables of its file.

    `calib.robot.description.EXTRA` names the extra tables.

    Args:
        path: the folder, or the file.
    """
    path = Path(path)
    if path.is_dir():
        path = path / ROBOT
    complete, extra = description.read_whole(path)
    where = str(path)
    # Only a URDF leaves the choice of the arm's end.
    if complete.links:
        LOG.info("%s: the arm ends at %s, as robot.toml says", complete.name, complete.tip)
    provenance = extra.get("provenance", {})

    def chain_of_values(key: str) -> Chain | None:
        if provenance.get(key) is None:
            return None
        return complete.with_values(vector(provenance[key], len(complete.elements), f"{where}, provenance.{key}"))

    chain = chain_of_values("rigid") or complete
    deflection = _deflection(extra.get("deflection", {}), complete, where)
    covariance = _covariance(path.parent / COVARIANCE, chain.names)
    corrections = None
    if deflection.terms:
        covariance_file = path.parent / str(provenance.get("covariance", ""))
        names = (*complete.names, *deflection.names(complete))
        corrections = CorrectedChain(complete, deflection, _covariance(covariance_file, names))
    nominal = chain_of_values("nominal")
    robot = CalibratedChain(chain, nominal, covariance, corrections, str(provenance.get("robot", "")))
    return robot, extra


def write(
    folder: Path,
    robot: CalibratedChain,
    tables: Mapping[str, object] | None = None,
    record: Mapping[str, object] | None = None,
    comment: str = "",
) -> None:
    """Write a calibrated robot to ``robot.toml`` and ``chain_covariance.csv``; `read` returns an equal robot.

    Args:
        folder: an existing folder.
        robot: the calibrated robot.
        tables: further tables of ``robot.toml`` (`calib.robot.description.EXTRA`); None for no such tables.
        record: further entries of the table ``[provenance]``; None for no such entries.
        comment: source of the numbers, written as a comment.
    """
    nominal = None if robot.nominal is None else robot.nominal.values
    rigid = None if robot.corrections is None else robot.chain.values
    extra: dict[str, object] = dict(tables or {})
    if robot.corrections is not None:
        extra["deflection"] = _deflection_table(robot.corrections)
    extra["provenance"] = {**(record or {}), "robot": robot.source, "nominal": nominal, "rigid": rigid}
    description.write(folder / ROBOT, robot.complete, extra, source=comment)
    if robot.covariance is None:
        return
    fitted = np.flatnonzero(np.diag(robot.covariance) > 0.0)
    if len(fitted):
        names = [robot.chain.names[k] for k in fitted]
        write_covariance(folder / COVARIANCE, names, robot.covariance[np.ix_(fitted, fitted)])


def nominal_of(robot: CalibratedChain) -> Chain:
    """Return the nominal chain of a calibrated robot.

    Raises:
        RobotError: the nominal chain is unknown.
    """
    if robot.nominal is None:
        raise RobotError(f"the nominal robot of '{robot.chain.name}' is unknown; fit again")
    return robot.nominal


def _covariance(path: Path, names: tuple[str, ...]) -> np.ndarray | None:
    """Return the covariance (k, k) of the values `names` from a file; None if the file does not exist.

    The covariance is zero for names that the file does not contain.

    Args:
        path: CSV file of a covariance with names.
        names: the k names of the wanted values, in order.
    """
    if not path.is_file():
        return None
    file_names, values = read_covariance(path)
    rows = [row for row, name in enumerate(file_names) if name in names]
    index = [names.index(file_names[row]) for row in rows]
    result = np.zeros((len(names), len(names)))
    result[np.ix_(index, index)] = values[np.ix_(rows, rows)]
    return result


def _deflection_table(corrections: CorrectedChain) -> dict[str, object]:
    deflection, names = corrections.deflection, corrections.chain.joint_names
    terms = []
    for term, coefficient in zip(deflection.terms, np.asarray(deflection.coefficients)):
        terms.append(
            {
                "element": term.element,
                "basis": term.basis,
                "joint": names[term.source],
                "order": term.order,
                "coefficient": float(coefficient),
            }
        )
    reference = deflection.reference
    if reference is None:
        return {"term": terms}
    table: dict[str, object] = {"reference": reference.values.tolist()}
    # Masses are written only where they differ from those of the chain, which stand in the file already.
    chain_masses = corrections.chain.inertias
    masses = reference.inertias
    if masses is not None and (chain_masses is None or not np.array_equal(masses, chain_masses)):
        table["masses"] = masses.tolist()
    table["term"] = terms
    return table


def _deflection(table: ParsedTable, chain: Chain, where: str) -> Deflection:
    where = f"{where}, deflection"
    check_keys(table, ("reference", "masses", "term"), where)
    terms, coefficients = [], []
    for entry in table.get("term", []):
        check_keys(entry, ("element", "basis", "joint", "order", "coefficient"), where)
        for key, names in (("element", chain.names), ("joint", chain.joint_names)):
            if entry.get(key) not in names:
                refuse_robot(
                    where, f"{key} {entry.get(key)!r} does not exist in the robot; correct or remove this entry"
                )
        source = chain.joint_names.index(entry["joint"])
        terms.append(Term(entry["element"], entry.get("basis", ""), source, int(entry.get("order", 0))))
        coefficients.append(number(entry.get("coefficient"), f"{where}, coefficient"))
    reference = chain
    if "reference" in table:
        reference = chain.with_values(vector(table["reference"], len(chain.elements), f"{where}, reference"))
    if "masses" in table:
        rows = [vector(row, 10, f"{where}, masses") for row in table["masses"]]
        reference = replace(reference, inertias=shaped(np.array(rows), (chain.n, 10), f"{where}, masses"))
    return Deflection(tuple(terms), np.array(coefficients), reference)
