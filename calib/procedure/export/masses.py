"""Export of identified masses and friction to URDF and MJCF, each verified by reading it with Pinocchio."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from calib.dynamics import pseudo_inertia, rigid_body
from calib.errors import RobotError
from calib.procedure.export import geometry
from calib.procedure.export.geometry import MAX_DIFFERENCE
from calib.procedure.export.identified import IdentifiedRobot
from calib.robot.chain import Chain, random_joints
from calib.robot.formats import urdf, urdf_write
from calib.robot.formats.simulators import mjcf_text, motion_torques
from calib.robot.formats.urdf_tree import UrdfTree, transform_body
from calib.robot.formats.urdf_tree import read as read_tree
from calib.robot.kinematics import moving_frames
from calib.transforms import invert


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
    own = _own_chain(tree, chain)
    links, notes = _link_bodies(given, tree, own)
    names = own.joint_names
    friction = {name: (float(row[1]), float(row[2])) for name, row in zip(names, given.drives.values)}
    edited = urdf_write.put(calibrated_text, where, links, friction)
    geometry.check_readback(edited, where, chain)
    _check(given, edited, own, where)
    return edited, notes


def _own_chain(tree: UrdfTree, chain: Chain) -> Chain:
    """Return the chain of the URDF, in its link frames, with the gravity of the identified chain."""
    named = chain.joint_names if chain.joint_names[0] in tree.joints else None
    base = chain.base if chain.base in tree.bodies else None
    own = urdf.build(tree, *urdf.ends(tree, base, chain.tip if chain.tip in tree.bodies else None, named))
    return replace(own, gravity=chain.gravity)


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
            raise RobotError(
                f"{tree.where}: link '{joint.child}' is not physically consistent, since the attached links "
                f"({', '.join(loose)}) are heavier than the identified mass: are the drive gains "
                "right? Correct those masses, or omit --urdf to write all other files"
            )
    return links, notes


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
