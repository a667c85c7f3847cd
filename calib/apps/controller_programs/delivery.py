"""A calibration in a controller's words: `calib deliver FIT --for NAME`.

A controller that keeps its nominal geometry takes the tool's and the instrument's frames with which the nominal arm
meets the measurements best. One whose axes are mastered anew takes joint offsets with the frames that belong to them:
from a fit with ``--model offsets``, since offsets of a richer model are not the best ones by themselves.

Each frame stands in the controller's base or flange (`calib.apps.controller_programs.frames`), and is printed with it.
Where nothing says where that is, no number is printed.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from calib.apps.controller_programs.frames import ControllerFrame, Description, base_frame, flange_frame
from calib.apps.controller_programs.targets import number, pose_values
from calib.toolkit.chains import CalibratedChain, Controller, nominal_of
from calib.toolkit.installations import Installation, read_arms
from calib.toolkit.result_folders import open_result, read_exported
from calib.transforms import invert

# of frames, by the unit of lengths
DECIMALS = {"m": 7, "mm": 4}


def delivery_text(
    folder: Path, controller: Controller, world: np.ndarray | None = None, flange: np.ndarray | None = None
) -> str:
    """Return what a controller can be told of a fit, as text for the person who enters it.

    Args:
        folder: of a fit, or of a session with one.
        controller: whose words.
        world, flange: (4, 4) poses of the controller's base in the arm's base, and of its flange in the arm's tip,
            where the user states them.

    Raises:
        UsageError: for a folder without a fit.
    """
    result = open_result(folder, "deliver")
    result.check_arm("deliver")
    fit_folder = result.fit
    fit = folder if fit_folder is None else fit_folder.path
    robot = read_exported(fit, "deliver")
    cell, nominal = read_arms(fit)
    arm = Description.of_fit(fit, nominal.chain)
    frames = base_frame(controller, arm, world), flange_frame(controller, arm, flange)
    verdicts = open_result(fit, "deliver").verdicts
    lines = [f"{controller.title}: calibration of {robot.chain.name}", str(verdicts), ""]
    lines += [f"It takes: {controller.takes}.", f"It does not: {controller.closed}.", ""]
    if len(nominal.tools):
        lines += [
            "Frames if the controller's geometry and mastering stay as they are:",
            *_frames(nominal, controller, *frames),
            "",
        ]
    if not controller.mastered:
        lines.append("Its axes are not mastered by their users.")
    elif fit_folder is not None and fit_folder.metrics().model == "offsets":
        lines += [
            "Mastering, with frames that belong to it:",
            *_mastering(robot, controller),
            *_frames(cell, controller, *frames),
        ]
    else:
        lines.append("Mastering offsets: fit with --model offsets, and deliver that fit.")
    lines.append("")
    for frame in frames:
        if frame.warning:
            lines.append(f"Warning: {frame.warning}.")
    lines.append(f"{controller.base}, {controller.flange}: {controller.frames}.")
    lines.append("A tool's angles are nominal where only its position was measured.")
    return "\n".join([*lines, ""])


def _frames(arm: Installation, controller: Controller, base: ControllerFrame, flange: ControllerFrame) -> Iterator[str]:
    """Yield the tools and instrument frames of an arm as the controller writes them, each with what it stands in."""
    for index, (name, pose) in enumerate(zip(arm.tool_names, arm.tools), 1):
        yield from _stood(f"tool {name}", controller.tool_frame, controller, pose, flange, index)
    for index, (name, pose) in enumerate(zip(arm.station_names, invert(arm.stations)), 1):
        yield from _stood(f"instrument {name}", controller.base_frame, controller, pose, base, index)


def _stood(
    name: str, form: str, controller: Controller, pose: np.ndarray, frame: ControllerFrame, index: int
) -> Iterator[str]:
    """Yield the lines of one frame: its numbers in the controller's frame, and which frames they relate."""
    if frame.pose is None:
        yield f"  {name}: not printed, since {frame.name} is {frame.basis}"
        return
    yield f"  {name}: {_written(form, controller, invert(frame.pose) @ pose, index)}"
    yield f"    is {name} in {frame}"


def _written(form: str, controller: Controller, pose: np.ndarray, index: int) -> str:
    (values,) = pose_values(controller, pose[None])
    numbers = [number(value, DECIMALS[controller.length]) for value in values]
    return form.format(*numbers, n=index)


def _mastering(robot: CalibratedChain, controller: Controller) -> Iterator[str]:
    """Yield the offset of each axis in the controller's unit, to add to what it shows."""
    chain, nominal = robot.chain, nominal_of(robot)
    offsets = []
    for k in chain.moving:
        change = chain.elements[k].value - nominal.elements[k].value
        offsets.append(change / chain.elements[k].ratio)
    for axis, value in enumerate(controller.shown(np.array(offsets)), 1):
        note = "" if value else " (kept at nominal)"
        yield f"  axis {axis}: true angle = shown angle {value:+.5f} {controller.unit}{note}"
