"""A calibration as numbers that a robot controller accepts: `calib deliver FIT --for NAME`.

A controller that keeps its nominal geometry accepts a tool frame and the instrument's frame; those with which the
nominal arm fits the measurements best are printed. A controller whose axes can be mastered anew accepts joint offsets,
and the frames that were fitted together with them. These are of a fit of offsets alone to the same measurements, since
the joint offsets of a model with more parameters are not the best ones when used alone.

Each frame is relative to the controller's base or flange (`calib.apps.controller_programs.frames`), which is printed
too. Where the pose of that base or flange is not known, no numbers are printed.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from calib.apps.controller_programs.frames import ControllerFrame, Description, base_frame, flange_frame
from calib.apps.controller_programs.targets import number, pose_values
from calib.errors import UsageError
from calib.toolkit.chains import Axes, Chain, Controller, axes_of
from calib.toolkit.installations import Installation, read_arms
from calib.toolkit.result_folders import NoOffsets, open_result, read_exported, read_mastering
from calib.transforms import invert

# of frames, by the unit of lengths
DECIMALS = {"m": 7, "mm": 4}


def delivery_text(
    folder: Path,
    controller: Controller,
    world: np.ndarray | None = None,
    flange: np.ndarray | None = None,
    external: Sequence[str] = (),
) -> str:
    """Return the numbers of a fit that a controller accepts, as text for the person who enters them.

    Args:
        folder: folder of a fit, or of a session with a fit.
        controller: the controller.
        world, flange: (4, 4) poses of the controller's base in the arm's base, and of its flange in the arm's tip, as
            the user specifies them; None: known from the robot's description, or from the controller's rule.
        external: names of joints that are external axes, where names and kinds do not tell.

    Raises:
        UsageError: a folder without a fit.
    """
    result = open_result(folder, "deliver")
    result.check_arm("deliver")
    fit_folder = result.fit
    fit = folder if fit_folder is None else fit_folder.path
    robot = read_exported(fit, "deliver")
    _, nominal = read_arms(fit)
    axes = _axes(controller, nominal.chain, external)
    arm = Description.of_fit(fit, nominal.chain, axes)
    frames = base_frame(controller, arm, world), flange_frame(controller, arm, flange)
    verdicts = open_result(fit, "deliver").verdicts
    lines = [f"{controller.title}: calibration of {robot.chain.name}", str(verdicts), ""]
    lines += [f"The controller accepts: {controller.takes}.", f"It does not accept: {controller.closed}.", ""]
    if len(nominal.tools):
        lines += [
            "Frames if the controller's geometry and mastering stay as they are:",
            *_frames(nominal, controller, *frames),
            "",
        ]
    if not controller.mastered:
        lines.append("Users cannot master the axes of this controller.")
    else:
        lines += _mastering(fit, controller, frames, axes)
    lines.append("")
    for frame in frames:
        if frame.warning:
            lines.append(f"Warning: {frame.warning}.")
    lines.append(f"{controller.base}, {controller.flange}: {controller.frames}.")
    lines.append("A tool's angles are nominal where only its position was measured.")
    return "\n".join([*lines, ""])


def _axes(controller: Controller, chain: Chain, external: Sequence[str]) -> Axes:
    """Return an arm's joints as a controller's axes; all of them as the arm's, where none is coupled to another.

    Args:
        controller: the controller.
        chain: the arm.
        external: names of joints that are external axes, where names and kinds do not tell.
    """
    try:
        return axes_of(controller, chain.joints, external)
    except UsageError:
        if controller.coupled or external:
            raise
        return Axes.plain(chain.joints)


def _frames(arm: Installation, controller: Controller, base: ControllerFrame, flange: ControllerFrame) -> Iterator[str]:
    """Yield lines with an arm's tool frames and instrument frames in the controller's notation.

    Args:
        arm: the arm with its stations and tools.
        controller: the controller.
        base, flange: the controller's base and flange, located in the arm's base and tip.
    """
    for index, (name, pose) in enumerate(zip(arm.tool_names, arm.tools), 1):
        yield from frame_lines(f"tool {name}", controller.tool_frame, controller, pose, flange, index)
    for index, (name, pose) in enumerate(zip(arm.station_names, invert(arm.stations)), 1):
        yield from frame_lines(f"instrument {name}", controller.base_frame, controller, pose, base, index)


def frame_lines(
    name: str, form: str, controller: Controller, pose: np.ndarray, frame: ControllerFrame, index: int
) -> Iterator[str]:
    """Yield the lines on one frame: its numbers relative to the controller's base or flange, and this reference's name.

    Args:
        name: kind and name of the frame.
        form: the controller's template for the text of such a frame.
        controller: the controller.
        pose: (4, 4) pose in the arm's base or tip.
        frame: the controller's base or flange.
        index: number of the frame, from 1.
    """
    if frame.pose is None:
        yield f"  {name}: not printed, since {frame.name} is {frame.basis}"
        return
    yield f"  {name}: {_written(form, controller, invert(frame.pose) @ pose, index)}"
    yield f"    is {name} in {frame}"


def _written(form: str, controller: Controller, pose: np.ndarray, index: int) -> str:
    (values,) = pose_values(controller, pose[None])
    numbers = [number(value, DECIMALS[controller.length]) for value in values]
    return form.format(*numbers, n=index)


def _mastering(
    fit: Path, controller: Controller, frames: tuple[ControllerFrame, ControllerFrame], axes: Axes
) -> Iterator[str]:
    """Yield one line per axis with the offset to add to the displayed value, in the controller's unit, and the frames.

    Args:
        fit: folder of the fit.
        controller: the controller.
        frames: the controller's base and flange, located in the arm's base and tip.
        axes: the arm's joints as its axes.
    """
    try:
        mastering = read_mastering(fit)
    except NoOffsets as reason:
        yield f"Mastering offsets are left out: {reason}."
        return
    yield f"Mastering {mastering}, with frames that belong to it:"
    shown = axes.shown(controller, mastering.offset)
    for label, unit, value in zip(axes.labels(), axes.units(controller.unit), shown):
        note = "" if value else " (kept at nominal)"
        quantity = "angle" if unit == controller.unit else "position"
        yield f"  {label}: true {quantity} = shown {quantity} {value:+.5f} {unit}{note}"
    yield from _frames(mastering.cell, controller, *frames)
