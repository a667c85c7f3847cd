"""Export of an identification: physically consistent parameters, their files (URDF, MJCF, JSON), and remarks.

URDF and MJCF are verified by reading them with Pinocchio.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.dynamics import pseudo_inertia, rigid_body
from calib.dynamics.bodies import Bodies, bodies_of
from calib.dynamics.drives import DriveTerm
from calib.errors import RobotError, finding, listing
from calib.identification.model_file import refuse_currents
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
from calib.workers.extras import available

# ratio of a body's mass to that in the description from which on it is named (our choice)
MAX_MASS_RATIO = 3.0
# columns of `Drives.values` by the shape of a drive term
PLAIN = {"acceleration": 0, "velocity": 1, "sign": 2, "one": 3}
# random configurations at which a file is read back
CHECKED_MOTIONS = 20


@dataclass(frozen=True, eq=False)
class Drives:
    """Drive parameters by joint (armature, damping, friction, offset), and the names of all other drive terms.

    Attributes:
        values: (n, 4) armature [kg m² or kg], damping [N m s/rad or N s/m], friction, offset [N m or N].
        left: names of drive terms that have no column in the table, such as richer friction.
        couplings: (c, 4) parameters of motors that turn with two joints (`calib.dynamics.drives.coupled`), with the
            columns of `values`.
        pairs: (c,) indices of the two joints, and the weight of the second: 1 for the sum, -1 for the difference.
        sigma: (n + c, 4) σ of all values; None without a covariance.
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
        robot: calibrated geometry, with the nominal geometry.
        information: the estimate of the identification.
        found: all parameters of the physically consistent model.
        bodies: (B, 10) standard parameters of the arm's bodies, without payloads.
        drives: drive parameters by joint.
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
        """Rigid bodies of the arm, with the gravity vector of the identification."""
        return bodies_of(self.chain).with_gravity(self.found.dynamics.model.bodies.gravity)


def read(folder: Path, prior: str = "entropic") -> IdentifiedRobot:
    """Return the identified robot in a folder with physically consistent parameters.

    Args:
        folder: folder of the identification.
        prior: prior for parameters that the torques do not identify: ``entropic``, or ``euclidean``, its second-order
            expansion.
    """
    refuse_currents(folder, "an export of masses")
    information = read_information(folder)
    solution = find_possible(information, prior=prior)
    count = bodies_of(information.chain).count
    bodies = solution.dynamics.values[: 10 * count].reshape(count, 10)
    drives = drive_table(solution.dynamics, solution.covariance)
    return IdentifiedRobot(geometry.read(folder), information, solution, bodies, drives)


@dataclass(frozen=True)
class ExportedPrediction:
    """Unexplained share of a recording's torque [%], predicted by the exported robot and by the identified model.

    Attributes:
        file: table of the recording's torques, relative to the folder of the identification.
        exported, identified: shares of the exported robot and of the identified model [%].
        tested: the exported robot's share that is compared with a tolerance [%]: without what is above the
            identification band, where that is most of the error; None in files of earlier versions.
    """

    file: str
    exported: float
    identified: float
    tested: float | None = None

    @property
    def compared(self) -> float:
        """The exported robot's share that is compared with a tolerance [%]."""
        return self.exported if self.tested is None else self.tested

    def __str__(self) -> str:
        return (
            f"the exported robot (with drives.csv) leaves {self.exported:.2f} % of the torque unexplained, the "
            f"identified model {self.identified:.2f} % ({self.file})"
        )


def exported_prediction(robot: IdentifiedRobot, folder: Path) -> ExportedPrediction | None:
    """Return the torque prediction error of the exported robot on the recording with the largest error.

    Args:
        robot: the identified robot.
        folder: folder of the identification with tables of measured torques.

    Returns:
        The error; None if the recordings were made with payloads, or if an earlier version did not store their
        velocities.
    """
    dynamics = without_left(robot.found.dynamics)
    identification = IdentificationFolder(folder)
    scores = identification.scores_of_torques()
    worst = None
    for path, score in zip(identification.torques, scores):
        motion = read_torques(path) if path.is_file() else {}
        if not motion:
            continue
        measured = motion["measured"]
        torque = dynamics.model.torque(dynamics.values, motion["q"], motion["v"], motion["a"], ())
        one_percent = float(np.linalg.norm(measured)) / 100.0
        residual, change = measured - motion["predicted"], motion["predicted"] - torque
        exported = float(np.linalg.norm(residual + change)) / one_percent
        identified = float(np.linalg.norm(residual)) / one_percent
        tested = exported
        if score is not None and score.floor_dominates:
            # noise is not correlated with the change of a prediction, so that its square need not be known
            added = float(np.sum(change**2) + 2.0 * np.sum(residual * change)) / one_percent**2
            in_band = score.counted(in_band=True).total
            tested = float(np.sqrt(max(in_band**2 + added, 0.0)))
            if score.noisy:
                exported, identified = tested, in_band
        if worst is None or exported > worst.exported:
            worst = ExportedPrediction(str(path.relative_to(folder)), exported, identified, tested)
    return worst


def notes_of(robot: IdentifiedRobot) -> list[str]:
    """Return findings, as text, on the exported inertias and masses, and on parameters that no robot file contains."""
    solution, drives = robot.found, robot.drives
    findings = [
        finding(
            "inertias",
            distance=solution.distance,
            count=robot.information.b,
            allowed=solution.allowed,
            source=solution.source,
            weight=solution.weight,
            prior=solution.prior,
            thinnest=solution.margins.min(),
        )
    ]
    if not solution.possible:
        blamed = [f"{name} (without it {distance:.3g})" for name, distance in solution.blamed]
        findings.append(
            finding("inertias-inconsistent", nearest=solution.nearest, allowed=solution.allowed, blamed=blamed)
        )
    masses = robot.bodies[:, 9]
    findings.append(finding("masses-written", masses=[f"{mass:.3g}" for mass in masses]))

    unlike = []
    if robot.chain.inertias is not None:
        for name, mass, described in zip(robot.chain.joint_names, masses, robot.chain.inertias[:, 9]):
            if max(mass, described) > MAX_MASS_RATIO * min(mass, described):
                unlike.append(f"{name} {mass:.3g} kg ({described:.3g})")
    only_in_parameters = list(drives.left)
    if np.any(drives.values[:, 3]):
        only_in_parameters.insert(0, "offsets")
    bodies = solution.dynamics.model.bodies
    optional = {
        "masses-unlike": unlike,
        "description-inconsistent": impossible_bodies(robot.chain),
        "urdf-without-motor-inertias": drives.values[:, 0].nonzero()[0],
        "only-in-parameters": only_in_parameters,
        "payload-not-exported": [label for label, row in zip(bodies.labels, bodies.coordinates) if row < 0],
    }
    for code, names in optional.items():
        if len(names):
            findings.append(finding(code, names=names, times=MAX_MASS_RATIO))
    return [*lines_of(findings), *solution.notes]


def parameters(robot: IdentifiedRobot) -> dict[str, object]:
    """Return the content of ``parameters.json``: parameters of geometry and dynamics with their covariances.

    Args:
        robot: the identified robot.
    """
    estimate, solution, chain = robot.information, robot.found, robot.chain
    model = solution.dynamics.model
    return {
        "robot": chain.name,
        "geometry": {
            "names": chain.names,
            "units": chain.units,
            "values": chain.values,
            "nominal": nominal_of(robot.robot).values,
            "covariance": robot.robot.covariance,
        },
        "dynamics": {
            "gravity": model.bodies.gravity,
            "rows": model.torque_rows.name,
            "base": {
                "names": estimate.names,
                "units": estimate.units,
                "values": estimate.values,
                "covariance": estimate.covariance,
            },
            "standard": {
                "names": model.names,
                "units": model.units,
                "values": solution.dynamics.values,
                "covariance": solution.covariance,
                "frames": "about the chain's frame behind each joint (robot.toml), payloads about the tip",
            },
            "consistency": {
                "possible": solution.possible,
                "nearest": solution.nearest,
                "distance": solution.distance,
                "allowed": solution.allowed,
                "weight": solution.weight,
                "prior": solution.prior,
                "notes": solution.notes,
                "margins_m": dict(zip(model.bodies.labels, solution.margins)),
                "sigmas_widened_by": solution.doubt,
                "drawn_to": solution.source,
                "blamed": dict(solution.blamed),
            },
        },
    }


def as_mjcf(robot: IdentifiedRobot, where: str) -> str:
    """Return the text of an MJCF file of an identified robot.

    Args:
        robot: the identified robot.
        where: name of the file for messages.

    Raises:
        RobotError: if Pinocchio reads other poses, torques or drive parameters from the text.
    """
    armature, damping, friction, _ = robot.drives.values.T
    model = mjcf_text(robot.chain, robot.bodies, armature, damping, friction)
    _check(robot, model, robot.chain, where, mjcf=True)
    return model


def as_urdf(robot: IdentifiedRobot, content: str, where: str, nominal: Chain) -> tuple[str, list[str]]:
    """Return the text of a URDF with calibrated joint origins, identified masses and friction, and remarks.

    Args:
        robot: the identified robot.
        content: text of the URDF of the nominal robot.
        where: name of the file for messages.
        nominal: the arm that `content` describes.

    Raises:
        RobotError: if Pinocchio reads other poses, torques or drive parameters from the result.
    """
    chain = robot.chain
    calibrated_text = urdf_write.edit(content, nominal, chain, where)
    tree = read_tree(calibrated_text, where)
    base = chain.base if chain.base in tree.bodies else None
    urdf_chain = replace(geometry.chain_in(tree, chain, base), gravity=chain.gravity)
    links, notes = _link_bodies(robot, tree, urdf_chain)
    friction = {}
    for name, (_, damping, coulomb, _) in zip(urdf_chain.joint_names, robot.drives.values):
        friction[name] = float(damping), float(coulomb)
    edited = urdf_write.put(calibrated_text, where, links, friction)
    geometry.check_readback(edited, where, chain)
    _check(robot, edited, urdf_chain, where)
    return edited, notes


def _link_bodies(robot: IdentifiedRobot, tree: UrdfTree, chain: Chain) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the inertial parameters (10,) of each link to be written, in the link's frame, and remarks.

    Args:
        robot: the identified robot.
        tree: the URDF with calibrated joint origins.
        chain: the arm in this URDF.

    Raises:
        RobotError: if no physically consistent body remains for a link.
    """
    joints_to_tip = tree.path(chain.base, chain.tip)
    moving = [joint for joint in joints_to_tip if joint.moves]
    zero = np.zeros((1, chain.n))
    T_urdf_chain = invert(moving_frames(chain, zero)[:, 0]) @ moving_frames(robot.chain, zero)[:, 0]
    links: dict[str, np.ndarray] = {}
    notes: list[str] = []
    for joint, T, identified_body in zip(moving, T_urdf_chain, robot.bodies):
        if not identified_body.any():
            continue
        # all that moves with the joint up to the next one; links on other joints keep their masses
        total = transform_body(identified_body, urdf.align(joint.axis) @ T)
        fixed, loose = urdf_write.hanging(tree, joints_to_tip, joint.child)
        remainder = total - _sum(tree, loose)
        with_mass = [name for name in fixed if name != joint.child and tree.bodies[name] is not None]
        attached = {name: fixed[name] for name in with_mass}
        links[joint.child] = remainder - _sum(tree, attached)
        if attached and not pseudo_inertia.margin(links[joint.child]) > 0.0:
            links[joint.child] = remainder
            links |= {name: np.zeros(10) for name in attached}
            notes.append(
                f"link {joint.child}: it has the whole mass, and {', '.join(attached)} have mass zero: with their "
                "masses in the URDF the remaining body is not physically consistent"
            )
        if not pseudo_inertia.margin(links[joint.child]) > 0.0:
            bodies = [tree.bodies[name] for name in loose]
            loose_mass = sum(float(body[9]) for body in bodies if body is not None)
            raise RobotError(
                f"{tree.where}: {total[9]:.3g} kg were identified between {joint.name} and the arm's next joint, and "
                f"the file attaches {loose_mass:.3g} kg to link '{joint.child}' by joints that are not the arm's "
                f"({listing(loose, 3)}): no physically consistent body remains. Either the motion does not identify "
                "that joint's mass (estimate.csv: its sigma), or the drive gains or the masses of those links are "
                "wrong: correct these and identify again, or omit --urdf: then robot.urdf is the arm alone"
            )
    return links, notes


def _sum(tree: UrdfTree, placements: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the sum (10,) of the standard parameters of links, transformed to a common frame.

    Args:
        tree: the URDF with the links.
        placements: name of a link -> pose (4, 4) of the link in the common frame.
    """
    total = np.zeros(10)
    for name, T_link in placements.items():
        body = tree.bodies[name]
        if body is not None:
            total = total + transform_body(body, T_link)
    return total


def _check(robot: IdentifiedRobot, source: str, chain: Chain, where: str, mjcf: bool = False) -> None:
    """Check that Pinocchio computes the expected dynamics from a file on random motion.

    Compared are frames, torques, motor inertias and friction. Without Pinocchio a warning says so.

    Args:
        robot: the identified robot.
        source: text of the file.
        chain: the arm in the file.
        where: name of the file for messages.
        mjcf: whether the file is an MJCF; otherwise it is a URDF.

    Raises:
        RobotError: if a value differs.
    """
    if not available("pinocchio"):
        return
    rng = np.random.default_rng(0)
    q = random_joints(robot.chain, CHECKED_MOTIONS, 0)
    v, a = rng.uniform(-1.0, 1.0, (2, *q.shape))
    torques, frames, damping, friction = motion_torques(source, chain, q, v, a, mjcf)
    expected = rigid_body.inverse_dynamics(robot.arm, robot.bodies.ravel(), q, v, a)
    if mjcf:
        expected = expected + robot.drives.values[:, 0] * a
        difference = float(np.abs(frames - moving_frames(robot.chain, q)).max())
        if difference > MAX_DIFFERENCE:
            raise RobotError(
                f"{where}: poses differ by {difference:.2g} when Pinocchio reads the file; nothing was written: "
                "report this as a bug"
            )
    share = float(np.abs(torques - expected).max()) / max(1.0, float(np.abs(expected).max()))
    if share > MAX_DIFFERENCE:
        raise RobotError(
            f"{where}: torques differ by {share:.2g} of the largest when Pinocchio reads the file; nothing was "
            "written. Do other joints of the file have masses that were not part of the identification?"
        )
    for quantity, values, column in (("damping", damping, 1), ("friction", friction, 2)):
        if not np.allclose(values, robot.drives.values[:, column], rtol=MAX_DIFFERENCE, atol=1e-12):
            raise RobotError(f"{where}: Pinocchio reads another {quantity} than was written: report this as a bug")


def without_left(dynamics: Dynamics) -> Dynamics:
    """Return an identified model in which drive terms without a column in ``drives.csv`` are zero.

    Args:
        dynamics: the identified model.
    """
    omitted = drive_table(dynamics).left
    values = np.array(dynamics.values)
    for k, term in enumerate(dynamics.model.columns, dynamics.model.inertial):
        if term.name in omitted:
            values[k] = 0.0
    return Dynamics(dynamics.model, values)


def drive_table(dynamics: Dynamics, covariance: np.ndarray | None = None) -> Drives:
    """Return the drive parameters of an identified model by joint; each is the sum of motor-side and link-side terms.

    Args:
        dynamics: the identified model.
        covariance: (p, p) covariance of all model parameters; None: the result has no σ.
    """
    model = dynamics.model
    n = model.bodies.n
    couplings = map(_pair, model.columns)
    pairs = tuple(dict.fromkeys(pair for pair in couplings if pair is not None))
    values = np.zeros((n + len(pairs), 4))
    # which parameters add to which value
    additions = np.zeros((*values.shape, len(dynamics.values)))
    omitted = []
    for k, term in enumerate(model.columns, model.inertial):
        value = dynamics.values[k]
        if not term.acts or value == 0.0:
            continue
        pair = _pair(term)
        if term.shape in PLAIN and term.joint is not None:
            row, column = term.joint, PLAIN[term.shape]
            values[row, column] += value
        elif pair is not None:
            row, column = n + pairs.index(pair), PLAIN[term.shape]
            values[row, column] = value
        else:
            omitted.append(term.name)
            continue
        additions[row, column, k] = 1.0
    sigma = None
    if covariance is not None:
        variance = np.einsum("nki,ij,nkj->nk", additions, covariance, additions)
        sigma = np.sqrt(np.clip(variance, 0.0, None))
    return Drives(values[:n], tuple(omitted), values[n:], pairs, sigma)


def _pair(term: DriveTerm) -> tuple[int, int, float] | None:
    """Return the indices of the two joints that a drive term couples, and the weight of the second joint.

    None if the term depends on a single joint.
    """
    if term.shape not in PLAIN or len(term.acts) != 2:
        return None
    (first, motion), (second, _) = term.acts
    weights = dict(motion)
    if second not in weights:
        return None
    return first, second, weights[second]
