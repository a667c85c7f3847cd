"""Placed frames with their uncertainty, in the words of those who use them: URDF, ROS, robot controllers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.apps.controller_programs.delivery import frame_lines
from calib.apps.controller_programs.frames import ControllerFrame, Description, base_frame, flange_frame
from calib.errors import UsageError
from calib.toolkit.chains import Chain, Controller, description_text, is_urdf, read_tree
from calib.transforms import to_quaternion, to_xyz_rpy
from calib.units import DEG

# Suffix of a link's name if the description has another link of this name.
NEW_LINK = "_calibrated"
# Link names of frames: that of an image's axes (z forward) has this name in ROS (REP 103).
LINK_NAMES = {"camera": "camera_optical_frame"}


@dataclass(frozen=True, eq=False)
class Placed:
    """A placed frame.

    Attributes:
        name: names of the frame and of its reference frame.
        pose: (4, 4) pose in the reference frame [m].
        sigma: (6,) σ of the position [m] and of small rotations [rad] along the axes of the reference frame; NaN where
            the measurements do not identify a component.
        frame: name of the frame alone, such as ``camera``.
        reference: name of the reference frame: a link of the arm, or an instrument.
    """

    name: str
    pose: np.ndarray
    sigma: np.ndarray
    frame: str = ""
    reference: str = ""

    @property
    def link(self) -> str:
        """Name of the frame as a link of a URDF, or a frame of tf."""
        return LINK_NAMES.get(self.frame, self.frame.replace(" ", "_"))

    @property
    def urdf_origin(self) -> str:
        """The pose as the origin of a URDF's joint, whose parent is the reference frame."""
        xyz, rpy = to_xyz_rpy(self.pose)
        return f'<origin xyz="{_numbers(xyz, 7)}" rpy="{_numbers(rpy, 7)}"/>'

    @property
    def ros_command(self) -> str:
        """The command that publishes the pose as a static transform of ROS 2."""
        values = [*self.pose[:3, 3], *to_quaternion(self.pose)]
        texts = []
        for name, value in zip(("x", "y", "z", "qx", "qy", "qz", "qw"), values):
            texts.append(f"--{name} {_numbers([value], 7)}")
        frames = f"--frame-id {self.reference} --child-frame-id {self.link}"
        return f"ros2 run tf2_ros static_transform_publisher {' '.join(texts)} {frames}"

    def __str__(self) -> str:
        turn = Rotation.from_matrix(self.pose[:3, :3])
        position_mm = 1e3 * self.pose[:3, 3]
        sigma_mm = 1e3 * self.sigma[:3]
        position = _stated(position_mm, sigma_mm)
        if np.isnan(self.sigma[3:]).all():
            return f"{self.name}: x y z {position} mm; orientation not identifiable"
        angles = _stated(turn.as_euler("xyz") / DEG, self.sigma[3:] / DEG)
        quaternion = ", ".join(f"{value:.6f}" for value in turn.as_quat(canonical=True))
        return f"{self.name}: x y z {position} mm; roll pitch yaw {angles} deg; quaternion x y z w {quaternion}"


def _stated(values: np.ndarray, sigmas: np.ndarray) -> str:
    """Return as text values with three decimals and their standard deviations.

    Args:
        values, sigmas: values and standard deviations, in one unit.
    """
    texts = []
    for value, sigma in zip(values, sigmas):
        if np.isnan(sigma):
            texts.append("not identifiable")
        else:
            texts.append(f"{value:.3f} ± {sigma:.2g}")
    return ", ".join(texts)


def _numbers(values: np.ndarray | list[float], decimals: int) -> str:
    """Return numbers as text, separated by blanks, without negative zeros."""
    return " ".join(f"{round(float(value), decimals) + 0.0:.{decimals}f}" for value in values)


def in_controller(
    placed: tuple[Placed, ...],
    controller: Controller,
    base_name: str,
    arm: Description | None,
    world: np.ndarray | None = None,
    flange: np.ndarray | None = None,
) -> Iterator[str]:
    """Yield the lines on frames in a controller's notation, relative to its base and its flange.

    Args:
        placed: the frames; the reference of each is the arm's base or tip.
        controller: the controller.
        base_name: reference of the frames that are in the arm's base.
        arm: the arm's description; None for poses that the controller itself reported.
        world, flange: (4, 4) poses of the controller's base in the arm's base, and of its flange in the arm's tip, as
            the user states them; None: known from the description, or from the controller's rule.
    """
    if arm is None:
        basis = "as in the file: the tool that was active there"
        base = ControllerFrame("the robot poses' base", np.eye(4), "as in the file")
        tip = ControllerFrame("the robot poses' tool", np.eye(4), basis)
    else:
        base = base_frame(controller, arm, world)
        tip = flange_frame(controller, arm, flange)
    for index, frame in enumerate(placed, 1):
        form, reference = controller.tool_frame, tip
        if frame.reference == base_name:
            form, reference = controller.base_frame, base
        yield from frame_lines(frame.frame, form, controller, frame.pose, reference, index)


def description_of(source: Path, chain: Chain) -> Description:
    """Return an arm with the links of its URDF, if it was read from one."""
    if not is_urdf(source):
        return Description(chain)
    return Description(chain, read_tree(description_text(source)[0], str(source)))


def urdf_with(source: Path, placed: tuple[Placed, ...]) -> tuple[str, list[str]]:
    """Return the text of a URDF with a link and a fixed joint for each frame, and the names of the links.

    All else in the file stays as it is. Where a link of that name exists, the new one has the suffix ``_calibrated``.

    Args:
        source: the URDF, or a description that is converted to one.
        placed: the frames, each in a link of the description.

    Raises:
        UsageError: the robot has no URDF.
    """
    if not is_urdf(source):
        raise UsageError(f"{source} is no URDF: the frames are in the folder of --out (calib export writes a URDF)")
    text, _ = description_text(source)
    tree = read_tree(text, str(source))
    end = text.rfind("</")
    links = []
    tags = []
    for frame in placed:
        link = frame.link
        if link in tree.bodies:
            link += NEW_LINK
        links.append(link)
        name = escape(link)
        tags.append(
            f'  <link name="{name}"/>\n'
            f'  <joint name="{name}_joint" type="fixed">\n'
            f'    <parent link="{escape(frame.reference)}"/>\n'
            f'    <child link="{name}"/>\n'
            f"    {frame.urdf_origin}\n"
            "  </joint>\n"
        )
    return text[:end] + "".join(tags) + text[end:], links
