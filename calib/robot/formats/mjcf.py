"""MJCF export (MuJoCo) of a `Chain` with masses and drives; motor inertia becomes ``armature``.

The world is the chain's base. Bodies stand where the chain's frames are, one behind each moving element; a mimic
joint's follower is tied to its leader by an equality, which MuJoCo keeps softly. The tip is a site.
There are no meshes: grey capsules without contact and without mass show the links.
"""

from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation

from calib.robot.chain import AXES, Chain, Element
from calib.robot.formats.urdf_write import centred
from calib.robot.kinematics import moving_frames
from calib.transforms import invert


def text(chain: Chain, bodies: np.ndarray, armature: np.ndarray, damping: np.ndarray, friction: np.ndarray) -> str:
    """Return the MJCF text of a chain with its bodies and drives.

    Args:
        bodies: (B, 10) standard parameters of the body after each moving element.
        armature, damping, friction: (n,) of each joint [kg m², N m s/rad, N m, or kg, N s/m, N].
    """
    lines = [
        f"<mujoco model={quoteattr(chain.name)}>",
        '  <compiler angle="radian" autolimits="true" inertiafromgeom="false"/>',
        f'  <option gravity="{_numbers(chain.gravity)}"/>',
        "  <worldbody>",
    ]
    first, depth, ties = set(chain.moving.tolist()), 2, []
    frames = moving_frames(chain, np.zeros((1, chain.n)))[:, 0]
    placed = [frames[0], *(invert(frames[:-1]) @ frames[1:])]  # each in the frame of the body before
    ends = [one[:3, 3] for one in (*placed[1:], chain.tail)]
    for number, k in enumerate(chain.driven.tolist()):
        element, main = chain.elements[k], k in first
        blank = "  " * depth
        name = joint_name(chain, k)
        lines.append(f"{blank}<body name={quoteattr(name + '_body')} {_placed(placed[number])}>")
        lines += [blank + "  " + line for line in _inertial(bodies[number])]
        lines.append(blank + "  " + _joint(chain, element, name, main, (armature, damping, friction)))
        if np.linalg.norm(ends[number]) > 1e-3:
            shape = f'type="capsule" fromto="0 0 0 {_numbers(ends[number])}" size="0.03"'
            lines.append(f'{blank}  <geom {shape} contype="0" conaffinity="0" rgba="0.6 0.6 0.6 1"/>')
        if not main:
            leader = chain.joints[element.joint or 0].name
            ties.append(
                f'    <joint joint1={quoteattr(name)} joint2={quoteattr(leader)} polycoef="0 {element.ratio!r} 0 0 0"/>'
            )
        depth += 1
    lines.append("  " * depth + f"<site name={quoteattr(chain.tip + '_tip')} {_placed(chain.tail)}/>")
    lines += ["  " * level + "</body>" for level in range(depth - 1, 1, -1)]
    lines.append("  </worldbody>")
    if ties:
        lines += ["  <equality>", *ties, "  </equality>"]
    return "\n".join([*lines, "</mujoco>"]) + "\n"


def joint_name(chain: Chain, k: int) -> str:
    """Return the MJCF joint name of moving element k: the chain joint's name, or the name of a mimic follower."""
    element = chain.elements[k]
    main = k in chain.moving.tolist()
    return chain.joints[element.joint or 0].name if main else element.name.removesuffix(".offset")


def _inertial(body: np.ndarray) -> list[str]:
    if not body.any():
        return []
    mass, centre, (xx, xy, xz, yy, yz, zz) = centred(body)
    full = _numbers(np.array([xx, yy, zz, xy, xz, yz]))
    return [f'<inertial pos="{_numbers(centre)}" mass="{mass!r}" fullinertia="{full}"/>']


def _joint(chain: Chain, element: Element, name: str, main: bool, drives: tuple[np.ndarray, ...]) -> str:
    joint = chain.joints[element.joint or 0]
    axis = element.sign * np.eye(3)[AXES.index(element.axis) % 3]
    kind = "slide" if element.axis[0] == "t" else "hinge"
    words = f'<joint name={quoteattr(name)} type="{kind}" axis="{_numbers(axis)}"'
    if main:
        values = (float(one[element.joint or 0]) for one in drives)
        words += "".join(f' {key}="{value!r}"' for key, value in zip(("armature", "damping", "frictionloss"), values))
        if np.isfinite([joint.lower, joint.upper]).all():
            words += f' range="{joint.lower!r} {joint.upper!r}"'
    return words + "/>"


def _placed(frame: np.ndarray) -> str:
    x, y, z, w = Rotation.from_matrix(frame[:3, :3]).as_quat()
    return f'pos="{_numbers(frame[:3, 3])}" quat="{_numbers(np.array([w, x, y, z]))}"'


def _numbers(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)
