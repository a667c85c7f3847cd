"""A calibration in a controller's words: `calib deliver FIT --for NAME`.

A controller that keeps its nominal geometry takes the tool's and the instrument's frames with which the nominal arm
meets the measurements best. One whose axes are mastered anew takes joint offsets with the frames that belong to them:
from a fit with ``--model offsets``, since offsets of a richer model are not the best ones by themselves.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from calib.geometry.installation import Installation, read_arms
from calib.procedure.export.delivery import verdicts
from calib.procedure.export.geometry import read
from calib.procedure.kinematic_stage.folder import IN_SESSION, FitFolder
from calib.robot.calibrated import CalibratedChain, nominal_of
from calib.rooms.controllers.table import Controller
from calib.rooms.controllers.targets import number, pose_values
from calib.transforms import invert

DECIMALS = {"m": 7, "mm": 4}  # of frames, by the unit of lengths


def delivery_text(folder: Path, controller: Controller) -> str:
    """Return what a controller can be told of a fit, as text for the person who enters it.

    Args:
        folder: of a fit, or of a session with one.

    Raises:
        UsageError: for a folder without a fit.
    """
    fit = folder / IN_SESSION if FitFolder(folder / IN_SESSION).robot.is_file() else folder
    robot, (cell, nominal) = read(fit), read_arms(fit)
    lines = [f"{controller.title}: calibration of {robot.chain.name}", str(verdicts(fit)), ""]
    lines += [f"It takes: {controller.takes}.", f"It does not: {controller.closed}.", ""]
    if len(nominal.tools):
        lines += [
            "Frames if the controller's geometry and mastering stay as they are:",
            *_frames(nominal, controller),
            "",
        ]
    if not controller.mastered:
        lines.append("Its axes are not mastered by their users.")
    elif FitFolder(fit).metrics().model == "offsets":
        lines += [
            "Mastering, with frames that belong to it:",
            *_mastering(robot, controller),
            *_frames(cell, controller),
        ]
    else:
        lines.append("Mastering offsets: fit with --model offsets, and deliver that fit.")
    lines += ["", "A tool's angles are nominal where only its position was measured."]
    return "\n".join([*lines, ""])


def _frames(arm: Installation, controller: Controller) -> Iterator[str]:
    """Yield the tools and instrument frames of an arm, as the controller writes them."""
    bases = invert(arm.stations)
    for place, (name, pose) in enumerate(zip(arm.tool_names, arm.tools), 1):
        yield f"  tool {name}: {_written(controller.tool_frame, controller, pose, place)}"
    for place, (name, pose) in enumerate(zip(arm.station_names, bases), 1):
        yield f"  instrument {name}: {_written(controller.base_frame, controller, pose, place)}"


def _written(form: str, controller: Controller, pose: np.ndarray, place: int) -> str:
    values = (number(value, DECIMALS[controller.length]) for value in pose_values(controller, pose[None])[0])
    return form.format(*values, n=place)


def _mastering(robot: CalibratedChain, controller: Controller) -> Iterator[str]:
    """Yield the offset of each axis in the controller's unit, to add to what it shows."""
    chain, before = robot.chain, nominal_of(robot)
    moved = [(chain.elements[k].value - before.elements[k].value) / chain.elements[k].ratio for k in chain.moving]
    for axis, value in enumerate(controller.shown(np.array(moved)), 1):
        kept = "" if value else " (kept at nominal)"
        yield f"  axis {axis}: true angle = shown angle {value:+.5f} {controller.unit}{kept}"
