"""Pinocchio as the judge of kinematics, and small URDFs to judge by."""

import re

import numpy as np
import pinocchio as pin

from calib.robot.chain import Chain


def pinocchio_poses(source: str, chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return the poses (m, 4, 4) of the chain's tip in its base after Pinocchio; other joints at zero."""
    model = pin.buildModelFromXML(source, len(chain.driven) > chain.n)  # which moves followers where there are any
    data = model.createData()
    base, tip = (model.getFrameId(link, pin.FrameType.BODY) for link in (chain.base, chain.tip))
    assert base < model.nframes and tip < model.nframes
    poses = []
    for row in q:
        configuration = pin.neutral(model)
        for name, value in zip(chain.joint_names, row, strict=True):
            joint = model.joints[model.getJointId(name)]
            if joint.nq == 2:
                configuration[joint.idx_q : joint.idx_q + 2] = np.cos(value), np.sin(value)
            else:
                configuration[joint.idx_q] = value
        pin.framesForwardKinematics(model, data, configuration)
        poses.append(data.oMf[base].actInv(data.oMf[tip]).homogeneous)
    return np.array(poses)


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
