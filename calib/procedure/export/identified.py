"""Identification for export: physically consistent parameters, their files (URDF, MJCF, JSON), and remarks.

URDF and MJCF are verified by reading them with Pinocchio.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.dynamics import pseudo_inertia, rigid_body
from calib.dynamics.bodies import Bodies, bodies_of
from calib.dynamics.drives import DriveTerm
from calib.errors import RobotError, finding, listing
from calib.identification.model_file import MODEL, refuse_currents
from calib.identification.physical_consistency.information import Information
from calib.identification.physical_consistency.information import read as read_information
from calib.identification.physical_consistency.solve import PossibleBodies, find_possible
from calib.identification.prediction import Dynamics
from calib.procedure.dynamic_stage.folder import IdentificationFolder, read_torques
from calib.procedure.export import geometry
from calib.procedure.export.geometry import MAX_DIFFERENCE
from calib.procedure.findings import lines_of
from calib.robot.calibrated import CalibratedChain, nominal_of
from calib.robot.chain import Chain, random_joints
from calib.robot.description import impossible_bodies
from calib.robot.formats import urdf, urdf_write
from calib.robot.formats.simulators import mjcf_text, motion_torques
from calib.robot.formats.urdf_tree import UrdfTree, transform_body
from calib.robot.formats.urdf_tree import read as read_tree
from calib.robot.kinematics import moving_frames
from calib.transforms import invert

MAX_MASS_RATIO = 3.0  # times a body's mass in the description from which on it is named (our choice)


PLAIN = {"acceleration": 0, "velocity": 1, "sign": 2, "one": 3}


@dataclass(frozen=True, eq=False)
class Drives:
    """Drive parameters by joint (armature, damping, friction, offset), and the names of all other drive terms.

    Attributes:
        values: (n, 4) armature [kg m² or kg], damping [N m s/rad or N s/m], friction, offset [N m or N].
        left: names of terms that do not fit the table: richer friction.
        couplings: (c, 4) the same values for motors that turn with two joints (`calib.dynamics.drives.coupled`).
        pairs: (c,) their joints, from 0, and the weight of the second: 1 for the sum, -1 for the difference.
        sigma: (n + c, 4) of all values; None where no covariance is known.
    """

    values: np.ndarray
    left: tuple[str, ...]
    couplings: np.ndarray
    pairs: tuple[tuple[int, int, float], ...] = ()
    sigma: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class IdentifiedRobot:
    """Identified robot with physically consistent bodies, ready for export.

    Attributes:
        robot: the geometry, with that before calibration.
        information: the estimate.
        found: all its parameters, of physically consistent bodies.
        bodies: (B, 10) of the arm's bodies, without payloads.
        drives: by joint.
    """

    robot: CalibratedChain
    information: Information
    found: PossibleBodies
    bodies: np.ndarray
    drives: Drives

    @property
    def chain(self) -> Chain:
        return self.robot.chain

    @property
    def arm(self) -> Bodies:
        """Bodies of the arm with the gravity of the identification."""
        return bodies_of(self.chain).with_gravity(self.found.dynamics.model.bodies.gravity)


def is_identified(folder: Path) -> bool:
    """Return whether a folder is that of an identification."""
    return (folder / MODEL).is_file()


def read(folder: Path, prior: str = "entropic") -> IdentifiedRobot:
    """Return the robot of an identification's folder, made physically consistent by a prior (`find_possible`)."""
    refuse_currents(folder, "an export of masses")
    information = read_information(folder)
    found = find_possible(information, prior=prior)
    own = bodies_of(information.chain).count
    bodies = found.dynamics.values[: 10 * own].reshape(own, 10)
    table = drive_table(found.dynamics, found.covariance)
    return IdentifiedRobot(geometry.read(folder), information, found, bodies, table)


@dataclass(frozen=True)
class ExportedPrediction:
    """Unexplained share of the torque [%] on a recording: by the exported robot, and by the identified model."""

    file: str
    exported: float
    identified: float

    def __str__(self) -> str:
        return (
            f"the exported robot (with drives.csv) leaves {self.exported:.2f} % of the torque unexplained, the "
            f"identified model {self.identified:.2f} % ({self.file})"
        )


def exported_prediction(given: IdentifiedRobot, folder: Path) -> ExportedPrediction | None:
    """Return the torque prediction error of the exported robot, on the worst recording in `folder`.

    None where these recordings carry payloads or are by a version that did not keep their speeds.
    """
    dynamics, found = without_left(given.found.dynamics), []
    for path in IdentificationFolder(folder).torques:
        motion = read_torques(path) if path.is_file() else {}
        if not motion:
            continue
        torque = dynamics.model.torque(dynamics.values, motion["q"], motion["v"], motion["a"], ())
        size = np.linalg.norm(motion["measured"]) / 100.0
        left = [float(np.linalg.norm(motion["measured"] - one) / size) for one in (torque, motion["predicted"])]
        found.append(ExportedPrediction(str(path.relative_to(folder)), *left))
    return max(found, key=lambda one: one.exported, default=None)


def notes_of(given: IdentifiedRobot) -> list[str]:
    """Return findings on the exported inertias and masses, and on parameters that no robot file contains."""
    solved, chain, bodies = given.found, given.chain, given.found.dynamics.model.bodies
    masses, theirs = given.bodies[:, 9], [] if chain.inertias is None else chain.inertias[:, 9]
    found = [
        finding(
            "inertias",
            distance=solved.distance,
            count=given.information.b,
            allowed=solved.allowed,
            source=solved.source,
            weight=solved.weight,
            prior=solved.prior,
            thinnest=solved.margins.min(),
        )
    ]
    if not solved.possible:
        blamed = [f"{name} (without it {left:.3g})" for name, left in solved.blamed]
        found.append(finding("inertias-inconsistent", nearest=solved.nearest, allowed=solved.allowed, blamed=blamed))
    found.append(finding("masses-written", masses=[f"{mass:.3g}" for mass in masses]))
    rows = [row for row in zip(chain.joint_names, masses, theirs) if max(row[1:]) > MAX_MASS_RATIO * min(row[1:])]
    offsets = ["offsets"] if np.any(given.drives.values[:, 3]) else []
    optional = {
        "masses-unlike": [f"{name} {mass:.3g} kg ({stated:.3g})" for name, mass, stated in rows],
        "description-inconsistent": impossible_bodies(chain),
        "urdf-without-motor-inertias": given.drives.values[:, 0].nonzero()[0],
        "only-in-parameters": [*offsets, *given.drives.left],
        "payload-not-exported": [label for label, c in zip(bodies.labels, bodies.coordinates) if c < 0],
    }
    found += [finding(code, names=names, times=MAX_MASS_RATIO) for code, names in optional.items() if len(names)]
    return [*lines_of(found), *solved.notes]


def parameters(given: IdentifiedRobot) -> dict[str, Any]:
    """Return the content of ``parameters.json``."""
    estimate, found, chain = given.information, given.found, given.chain
    model = found.dynamics.model
    same = ("possible", "nearest", "distance", "allowed", "weight", "prior", "notes")
    consistency = {name: getattr(found, name) for name in same} | {
        "margins_m": dict(zip(model.bodies.labels, found.margins)),
        "sigmas_widened_by": found.doubt,
        "drawn_to": found.source,
        "blamed": dict(found.blamed),
    }
    geometric = {"nominal": nominal_of(given.robot).values, "covariance": given.robot.covariance}
    frames = "about the chain's frame behind each joint (robot.toml), payloads about the tip"
    standard = {"names": model.names, "units": model.units, "values": found.dynamics.values}
    return {
        "robot": chain.name,
        "geometry": _columns(chain) | geometric,
        "dynamics": {
            "gravity": model.bodies.gravity,
            "rows": model.torque_rows.name,
            "base": _columns(estimate) | {"covariance": estimate.covariance},
            "standard": standard | {"covariance": found.covariance, "frames": frames},
            "consistency": consistency,
        },
    }


def _columns(of: Chain | Information) -> dict[str, Any]:
    return {name: getattr(of, name) for name in ("names", "units", "values")}


def as_mjcf(given: IdentifiedRobot, where: str) -> str:
    """Return the MJCF of an identified robot.

    Raises:
        RobotError: where Pinocchio reads other poses, torques or drives.
    """
    model = mjcf_text(given.chain, given.bodies, *given.drives.values.T[:3])
    _check(given, model, given.chain, where, mjcf=True)
    return model


def as_urdf(given: IdentifiedRobot, content: str, where: str, nominal: Chain) -> tuple[str, list[str]]:
    """Return a URDF text with calibrated origins, masses and friction, and notes.

    Args:
        given: the identified robot.
        content: the URDF of the nominal robot.
        where: names it in messages.
        nominal: the arm that `content` describes.

    Raises:
        RobotError: where Pinocchio reads other poses, torques or drives.
    """
    chain = given.chain
    calibrated_text = urdf_write.edit(content, nominal, chain, where)
    tree = read_tree(calibrated_text, where)
    own = geometry.chain_in(tree, chain, chain.base if chain.base in tree.bodies else None)
    own = replace(own, gravity=chain.gravity)
    links, notes = _link_bodies(given, tree, own)
    names = own.joint_names
    friction = {name: (float(row[1]), float(row[2])) for name, row in zip(names, given.drives.values)}
    edited = urdf_write.put(calibrated_text, where, links, friction)
    geometry.check_readback(edited, where, chain)
    _check(given, edited, own, where)
    return edited, notes


def _link_bodies(given: IdentifiedRobot, tree: UrdfTree, own: Chain) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the inertials to write by link, about the links' frames, and notes."""
    path = [joint for joint in tree.path(own.base, own.tip) if joint.moves]
    zero = np.zeros((1, own.n))
    between = invert(moving_frames(own, zero)[:, 0]) @ moving_frames(given.chain, zero)[:, 0]
    links: dict[str, np.ndarray] = {}
    notes: list[str] = []
    for joint, turn, body in zip(path, between, given.bodies):
        if not body.any():
            continue
        whole = transform_body(body, urdf.align(joint.axis) @ turn)
        fixed, loose = urdf_write.hanging(tree, tree.path(own.base, own.tip), joint.child)
        others = {
            name: placed for name, placed in fixed.items() if name != joint.child and tree.bodies[name] is not None
        }
        rest = whole - _sum(tree, loose)
        links[joint.child] = rest - _sum(tree, others)
        if others and not pseudo_inertia.margin(links[joint.child]) > 0.0:
            links |= {joint.child: rest, **{name: np.zeros(10) for name in others}}
            notes.append(
                f"link {joint.child}: it has the whole mass, and {', '.join(others)} have mass zero: with their masses "
                "in the URDF the remaining body is not physically consistent"
            )
        if not pseudo_inertia.margin(links[joint.child]) > 0.0:
            raise RobotError(_no_room(tree, joint.name, joint.child, whole[9], loose))
    return links, notes


def _no_room(tree: UrdfTree, joint: str, link: str, mass: float, loose: Mapping[str, np.ndarray]) -> str:
    """Return the message for a link whose identified inertia leaves no possible body beside what hangs on it.

    Args:
        mass: identified for all that the joint moves up to the arm's next joint [kg].
        loose: links on joints that are not the arm's, by name.
    """
    hanging = sum(float(body[9]) for name in loose if (body := tree.bodies[name]) is not None)
    return (
        f"{tree.where}: {mass:.3g} kg were identified between {joint} and the arm's next joint, and the file hangs "
        f"{hanging:.3g} kg on link '{link}' by joints that are not the arm's ({listing(loose, 3)}): no possible body "
        "remains for the link. Either the motion does not identify that joint's mass (estimate.csv: its sigma), or the "
        "drive gains or the masses of those links are wrong: correct these and identify again, or omit --urdf: then "
        "robot.urdf is the arm alone"
    )


def _sum(tree: UrdfTree, placed: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the summed standard parameters (10,) of links in the URDF."""
    found = [(tree.bodies[name], pose) for name, pose in placed.items()]
    return sum((transform_body(body, pose) for body, pose in found if body is not None), np.zeros(10))


def _check(given: IdentifiedRobot, source: str, chain: Chain, where: str, mjcf: bool = False) -> None:
    """Refuse a file if Pinocchio reads other frames, torques, motor inertias or friction, on random motion."""
    rng = np.random.default_rng(0)
    q = random_joints(given.chain, 20, 0)
    v, a = rng.uniform(-1.0, 1.0, (2, *q.shape))
    torques, frames, damping, friction = motion_torques(source, chain, q, v, a, mjcf)
    wanted = rigid_body.inverse_dynamics(given.arm, given.bodies.ravel(), q, v, a)
    if mjcf:
        wanted = wanted + given.drives.values[:, 0] * a
        away = float(np.abs(frames - moving_frames(given.chain, q)).max())
        if away > MAX_DIFFERENCE:
            raise RobotError(f"{where}: poses differ by {away:.2g} when Pinocchio reads the file; nothing was written")
    off = float(np.abs(torques - wanted).max()) / max(1.0, float(np.abs(wanted).max()))
    if off > MAX_DIFFERENCE:
        raise RobotError(
            f"{where}: torques differ by {off:.2g} of the largest when Pinocchio reads the file; nothing was written. "
            "Do other joints of the file have masses that were not part of the identification?"
        )
    for what, read_back, own in (("damping", damping, 1), ("friction", friction, 2)):
        if not np.allclose(read_back, given.drives.values[:, own], rtol=MAX_DIFFERENCE, atol=1e-12):
            raise RobotError(f"{where}: Pinocchio reads another {what} than was written")


def without_left(dynamics: Dynamics) -> Dynamics:
    """Return an identified model without the drive terms that ``drives.csv`` cannot contain."""
    left, first = drive_table(dynamics).left, dynamics.model.inertial
    values = np.array(dynamics.values)
    values[[first + k for k, one in enumerate(dynamics.model.columns) if one.name in left]] = 0.0
    return Dynamics(dynamics.model, values)


def drive_table(dynamics: Dynamics, covariance: np.ndarray | None = None) -> Drives:
    """Return the drive parameters of an identified model by joint, motor side plus link side.

    Args:
        dynamics: the model.
        covariance: of all its parameters.
    """
    model = dynamics.model
    n, left = model.bodies.n, []
    pairs = tuple(dict.fromkeys(pair for one in model.columns if (pair := _pair(one)) is not None))
    values = np.zeros((n + len(pairs), 4))
    adds = np.zeros((*values.shape, len(dynamics.values)))
    for k, (one, value) in enumerate(zip(model.columns, dynamics.values[model.inertial :]), model.inertial):
        if not one.acts or value == 0.0:
            continue
        if one.shape in PLAIN and one.joint is not None:
            values[one.joint, PLAIN[one.shape]] += value
            adds[one.joint, PLAIN[one.shape], k] = 1.0
        elif (pair := _pair(one)) is not None:
            values[n + pairs.index(pair), PLAIN[one.shape]] = value
            adds[n + pairs.index(pair), PLAIN[one.shape], k] = 1.0
        else:
            left.append(one.name)
    if covariance is None:
        return Drives(values[:n], tuple(left), values[n:], pairs)
    variance = np.einsum("nki,ij,nkj->nk", adds, covariance, adds)
    return Drives(values[:n], tuple(left), values[n:], pairs, np.sqrt(np.clip(variance, 0.0, None)))


def _pair(one: DriveTerm) -> tuple[int, int, float] | None:
    """Return the joints that a term couples and the weight of the second; None for any other term."""
    if one.shape not in PLAIN or len(one.acts) != 2:
        return None
    (first, motion), (second, _) = one.acts
    weights = dict(motion)
    return None if second not in weights else (first, second, weights[second])
