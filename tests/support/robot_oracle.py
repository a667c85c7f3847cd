"""Pinocchio as the judge of kinematics, and small URDFs to judge by."""

import re
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from calib.robot.chain import Chain


def pinocchio_poses(source: str, chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return the poses (m, 4, 4) of the chain's tip in its base after Pinocchio; joints beside it at zero.

    Pinocchio reads mimic joints as joints of their own, since it refuses those that mimic a later one (IRB 6640); they
    are moved after the file's numbers. Base and tip are links: a joint may share their name (Sawyer).
    """
    model = pin.buildModelFromXML(source)
    data = model.createData()
    base, tip = (model.getFrameId(link, pin.FrameType.BODY) for link in (chain.base, chain.tip))
    assert base < model.nframes and tip < model.nframes
    followers = mimic_joints(source)
    poses = []
    for row in q:
        configuration = pin.neutral(model)
        positions = dict(zip(chain.joint_names, row, strict=True))
        for name in model.names[1:]:
            joint, value = model.joints[model.getJointId(name)], position_of(name, positions, followers)
            if joint.nq == 2:
                configuration[joint.idx_q : joint.idx_q + 2] = np.cos(value), np.sin(value)
            else:
                configuration[joint.idx_q] = value
        pin.framesForwardKinematics(model, data, configuration)
        poses.append(data.oMf[base].actInv(data.oMf[tip]).homogeneous)
    return np.array(poses)


def mimic_joints(source: str) -> dict[str, tuple[str, float, float]]:
    """Return leader, multiplier and offset of each mimic joint of a URDF text."""
    result = {}
    for element in ElementTree.fromstring(source).iterfind("joint"):
        mimic = element.find("mimic")
        if mimic is not None:
            multiplier, offset = float(mimic.get("multiplier", 1.0)), float(mimic.get("offset", 0.0))
            result[element.attrib["name"]] = mimic.attrib["joint"], multiplier, offset
    return result


def position_of(name: str, positions: dict[str, float], followers: dict[str, tuple[str, float, float]]) -> float:
    """Return the position of a joint: driven, or after the joint that it mimics, or zero."""
    if name in followers:
        leader, multiplier, offset = followers[name]
        return multiplier * position_of(leader, positions, followers) + offset
    return positions.get(name, 0.0)


def pinocchio_inertias(source: str, chain: Chain) -> np.ndarray:
    """Return the standard parameters (n, 10) of the chain's joints after Pinocchio, in our order."""
    model = pin.buildModelFromXML(source)
    rows = []
    for name in chain.joint_names:
        # Pinocchio's order: m, mc, Ixx, Ixy, Iyy, Ixz, Iyz, Izz
        mass, mx, my, mz, xx, xy, yy, xz, yz, zz = model.inertias[model.getJointId(name)].toDynamicParameters()
        rows.append([xx, xy, xz, yy, yz, zz, mx, my, mz, mass])
    return np.array(rows)


def joint(
    name: str, kind: str, parent: str, child: str, inner: str = "", xyz: str = "0 0 0", rpy: str = "0 0 0"
) -> str:
    """Return a <joint>; limits are given unless `inner` gives some."""
    stated = "<limit" in inner or kind in ("fixed", "floating")
    limit = "" if stated else '<limit velocity="2" effort="9" lower="-2" upper="2"/>'
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/>{limit}{inner}</joint>\n'
    )


def robot(*joints: str, bodies: dict[str, str] | None = None) -> str:
    """Return a URDF of these joints and the links they name; `bodies` are the links' inner texts."""
    links = dict.fromkeys([*re.findall(r'<(?:parent|child) link="([^"]*)"', "".join(joints)), *(bodies or {})])
    tags = "".join(f'<link name="{name}">{(bodies or {}).get(name, "")}</link>\n' for name in links)
    return f'<?xml version="1.0"?>\n<robot name="synthetic">\n{tags}{"".join(joints)}</robot>\n'


def inertial(mass: float, xyz: str, rpy: str = "0.1 0.2 0.3") -> str:
    return (
        f'<inertial><origin xyz="{xyz}" rpy="{rpy}"/><mass value="{mass}"/>'
        '<inertia ixx="0.02" ixy="0.001" ixz="-0.002" iyy="0.03" iyz="0.003" izz="0.04"/></inertial>'
    )


def axis(xyz: str) -> str:
    return f'<axis xyz="{xyz}"/>'
