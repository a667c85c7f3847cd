"""Descriptions of serial arms as odd as real ones: short levers, near-parallel axes, forks, slides, odd mountings."""

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st

QUARTER = 0.5 * np.pi  # [rad]
LINK = st.floats(0.15, 0.6)  # length of a link [m]
SHORT_LEVER = st.sampled_from([1e-4, 2e-4, 5e-4, 2e-3, 10e-3])  # offset between two axes that nearly meet [m]
NEARLY_PARALLEL = st.sampled_from([1e-4, 1e-3, 5e-3])  # angle between two axes [rad]
DIRECTIONS = st.sampled_from(["1 0 0", "0 1 0", "0 0 1", "-1 0 0", "0 -1 0", "0 0 -1"])
MOUNTINGS = st.sampled_from(
    [
        (0.0, 0.0, 0.0),  # on the floor
        (np.pi, 0.0, 0.0),  # on the ceiling
        (0.0, QUARTER, 0.0),  # on a wall
        (0.5 * QUARTER, 0.0, 0.3),  # on a frame at 45°
    ]
)
ENDS = st.sampled_from(["tool0", "flange and tool0", "two leaves", "fingers", "camera", "bare"])
FINGER_LIMIT = '<limit lower="0" upper="0.04" effort="20" velocity="0.1"/>'


@dataclass(frozen=True)
class Origin:
    """Placement of a joint in the frame of the one before: xyz [m] and rpy [rad]."""

    xyz: tuple[float, ...] = (0.0, 0.0, 0.0)
    rpy: tuple[float, ...] = (0.0, 0.0, 0.0)

    @property
    def tag(self) -> str:
        xyz, rpy = (" ".join(map(repr, map(float, numbers))) for numbers in (self.xyz, self.rpy))
        return f'<origin xyz="{xyz}" rpy="{rpy}"/>'


def joint_tag(name: str, kind: str, parent: str, child: str, origin: Origin, inner: str = "") -> str:
    """Return a <joint> between two links."""
    links = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{links}{origin.tag}{inner}</joint>'


@st.composite
def origins(draw: st.DrawFn, must_have_length: bool) -> Origin:
    """Draw a joint's placement: a link or a short lever along one axis, axes turned by quarters or nearly parallel."""
    length = draw(LINK if must_have_length else st.one_of(LINK, SHORT_LEVER, st.just(0.0)))
    along = draw(st.integers(0, 2))
    xyz = np.zeros(3)
    xyz[along] = length
    if draw(st.booleans()):
        xyz[(along + 1) % 3] = draw(SHORT_LEVER)
    rpy = np.zeros(3)
    rpy[draw(st.integers(0, 2))] = draw(st.one_of(st.just(QUARTER), st.just(-QUARTER), st.just(0.0), NEARLY_PARALLEL))
    return Origin(tuple(xyz), tuple(rpy))


@st.composite
def moving_joints(draw: st.DrawFn, number: int, count: int) -> str:
    """Draw joint `number` of `count`, between links of these numbers; joints 2 and 3 have links before them."""
    turning = st.sampled_from(["revolute", "revolute", "continuous"])
    at_an_end = number in (1, count)
    kind = draw(st.one_of(turning, turning, st.just("prismatic")) if at_an_end else turning)
    half = draw(st.floats(0.3, 1.0) if kind == "prismatic" else st.floats(1.5, 3.0))
    limit = f'<limit lower="{-half}" upper="{half}" effort="100" velocity="2"/>'
    if kind == "continuous":
        limit = '<limit effort="100" velocity="2"/>'
    axis = f'<axis xyz="{draw(DIRECTIONS)}"/>'
    origin = draw(origins(must_have_length=number in (2, 3)))
    return joint_tag(f"joint_{number}", kind, f"link_{number - 1}", f"link_{number}", origin, axis + limit)


def end_tags(end: str, last: str) -> list[str]:
    """Return the joints behind the last moving link."""
    flange = Origin((0.0, 0.0, 0.08), (0.0, -QUARTER, 0.0))
    tool = Origin((0.0, 0.0, 0.0), (QUARTER, 0.0, QUARTER))
    camera = joint_tag("camera_mount", "fixed", last, "camera", Origin((0.05, 0.0, 0.02), (0.1, 0.2, 0.3)))
    to_flange = joint_tag("to_flange", "fixed", last, "flange", flange)
    if end == "bare":
        return []
    if end == "tool0":
        return [joint_tag("to_tool0", "fixed", last, "tool0", flange)]
    if end == "two leaves":  # REP 199 has them in a row; many descriptions side by side
        return [to_flange, joint_tag("to_tool0", "fixed", last, "tool0", Origin(flange.xyz, (0.0, 0.0, QUARTER)))]
    chain = [to_flange, joint_tag("to_tool0", "fixed", "flange", "tool0", tool)]
    if end == "camera":
        return [*chain, camera]
    if end == "fingers":
        inner = f'<axis xyz="0 1 0"/>{FINGER_LIMIT}'
        for side, lean in (("left", 0.02), ("right", -0.02)):
            origin = Origin((0.0, lean, 0.06))
            chain.append(joint_tag(f"{side}_finger_joint", "prismatic", "tool0", f"{side}_finger", origin, inner))
    return chain


@st.composite
def arms(draw: st.DrawFn) -> str:
    """Draw a URDF of an arm of four to seven joints on some mounting, with some end."""
    count = draw(st.integers(4, 7))
    mounting = Origin((0.1, -0.2, 0.5), draw(MOUNTINGS))
    joints = [joint_tag("mounting", "fixed", "world", "link_0", mounting)]
    joints += [draw(moving_joints(number, count)) for number in range(1, count + 1)]
    joints += end_tags(draw(ENDS), f"link_{count}")
    links = ["world", *(f"link_{number}" for number in range(count + 1))]
    links += [
        name for name in ("flange", "tool0", "camera", "left_finger", "right_finger") if f'"{name}"' in str(joints)
    ]
    tags = "\n".join([f'<link name="{name}"/>' for name in links] + joints)
    return f'<?xml version="1.0"?>\n<robot name="generated">\n{tags}\n</robot>\n'
