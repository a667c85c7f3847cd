"""Placements of tool, base, camera and board in Python: `calib.tool`, `calib.base`, `calib.hand_eye`.

All three are the fit of model ``frames`` (`calib.fit_geometry`), which places the instrument and what it sees, and
leaves the arm as it is; they differ in the frames that are shown.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from calib.api.kinematic import GeometryFit, Several, fit_geometry
from calib.api.rendering import Progress
from calib.apps.registration.settings import DEFAULT_PLACEMENT, PlacementSettings
from calib.data.poses.fit_options import FitOptions
from calib.estimation.estimate import Estimate
from calib.geometry.installation import FRAME_AXES
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.records import as_subclass
from calib.robot.calibrated import CalibratedChain
from calib.transforms import invert
from calib.units import DEG

Arm = str | Path | CalibratedChain
USUAL_POSES = 12  # of a quick calibration (our choice)


class Placed(NamedTuple):
    """A placed frame.

    Attributes:
        name: of it, and of what it is placed in.
        pose: (4, 4) [m].
        sigma: (6,) of its position [m] and of turns about the axes [rad], both along the axes of the frame that it
            is placed in; NaN where the measurements do not identify it.
    """

    name: str
    pose: np.ndarray
    sigma: np.ndarray

    def __str__(self) -> str:
        turn = Rotation.from_matrix(self.pose[:3, :3])
        position, angles = 1e3 * self.pose[:3, 3], turn.as_euler("xyz") / DEG
        position_text = ", ".join(_stated(value, 1e3 * sigma, 3) for value, sigma in zip(position, self.sigma[:3]))
        if np.isnan(self.sigma[3:]).all():
            return f"{self.name}: x y z {position_text} mm; orientation not identifiable"
        turns = ", ".join(_stated(value, sigma / DEG, 3) for value, sigma in zip(angles, self.sigma[3:]))
        quaternion = ", ".join(f"{value:.6f}" for value in turn.as_quat(canonical=True))
        return f"{self.name}: x y z {position_text} mm; roll pitch yaw {turns} deg; quaternion x y z w {quaternion}"


class Placements(GeometryFit):
    """A fit of base and tool placement. ``print`` shows the frames with σ, then the verdict."""

    tab = f"placed {GeometryFit.tab}"

    @property
    def placed(self) -> tuple[Placed, ...]:
        """The placed frames: targets in the tip, the arm's base in each instrument, and each instrument in the base."""
        fit, chain = self.selection.fit, self.robot.chain
        cell, carried = fit.cell, self.inputs.fit[0].carried[0]
        standing = {"camera": "board", "board": "camera"}.get(carried, "instrument")
        frames = list[Placed]()
        for name, pose in zip(cell.tool_names, cell.tools):
            turned = np.kron(np.eye(2), pose[:3, :3])  # the fit's small motions are along the frame's own axes
            frames.append(Placed(f"{carried} '{name}' in {chain.tip}", pose, _sigma(fit.estimate, name, turned)))
        for name, pose in zip(cell.station_names, cell.stations) if self.inputs.fit[0].has_instrument else ():
            turned, back = np.kron(np.eye(2), pose[:3, :3]), invert(pose)
            frames.append(Placed(f"base in {standing} '{name}'", pose, _sigma(fit.estimate, name, turned)))
            inverse_jacobian = -np.eye(6)  # of the inverse: -dp - dr × t, and -dr
            inverse_jacobian[:3, 3:] = np.cross(back[:3, 3], np.eye(3)).T
            frames.append(
                Placed(f"{standing} '{name}' in {chain.base}", back, _sigma(fit.estimate, name, inverse_jacobian))
            )
        return tuple(frames)

    def lines(self, *first: str) -> Iterator[object]:
        """Yield what a command prints: the frames whose names begin with one of `first`, and the verdict."""
        poses = self.fit.poses
        yield str(self.verdict)
        yield from (str(frame) for frame in self.placed if frame.name.startswith(first))
        rms_mm = 1e3 * self.fit.errors[1].rms
        yield f"{poses} poses, {rms_mm:.3g} mm rms residual; σ follows from it, the arm's random errors included"
        yield from self.warnings
        if poses < USUAL_POSES:
            yield f"{poses} poses are few: measure {USUAL_POSES}, with the wrist turned by 90° and more between them"

    def __str__(self) -> str:
        return "\n".join(self.lines(""))


def _sigma(estimate: Estimate, name: str, jacobian: np.ndarray) -> np.ndarray:
    """Return the standard deviations (6,) of J times the six small motions of a frame; NaN where not identified."""
    names = [f"{name}.{axis}" for axis in FRAME_AXES]
    identified = [parameter in estimate.names for parameter in names]
    index = [estimate.names.index(parameter) for parameter in names if parameter in estimate.names]
    covariance = np.full((6, 6), np.nan)
    covariance[np.ix_(identified, identified)] = estimate.covariance[np.ix_(index, index)]
    nonzero = jacobian != 0.0
    size = [row[use] @ covariance[np.ix_(use, use)] @ row[use] for row, use in zip(jacobian, nonzero)]
    return np.sqrt(np.array(size))


def _stated(value: float, sigma: float, digits: int) -> str:
    return f"{value:.{digits}f} " + ("(not identifiable)" if np.isnan(sigma) else f"± {sigma:.2g}")


def tool(
    robot: Arm,
    measured: Several,
    settings: PlacementSettings = DEFAULT_PLACEMENT,
    *,
    options: FitOptions | str | Path | None = None,
    base: str | None = None,
    tip: str | None = None,
    progress: Progress | None = None,
) -> Placements:
    """Calibrate the tool (TCP): the target's placement in the arm's tip, from a dozen measured poses.

    Args:
        robot, base, tip: the arm, as of `calib.load`; its geometry is left as it is.
        measured: CSV files, folders of images, or what `read_poses` returned, as of `fit_geometry`.
        settings: tolerance, share held out.
        options, progress: as of `fit_geometry`.

    Returns:
        The fit: ``placed`` has the frames with σ, ``verdict`` the verdict.
    """
    fit_settings = FitSettings(model="frames", holdout=settings.holdout, tolerance=settings.tolerance)
    fit = fit_geometry(robot, measured, fit_settings, options=options, base=base, tip=tip, progress=progress)
    return as_subclass(fit, Placements)


def base(
    robot: Arm, measured: Several, settings: PlacementSettings = DEFAULT_PLACEMENT, **arguments: Any
) -> Placements:
    """Calibrate the base: the arm's placement in the instrument's frame, from a dozen measured poses.

    It is the fit of `tool`, with the same arguments (robot, measured, settings, and more by their names).
    """
    return tool(robot, measured, settings, **arguments)


def hand_eye(
    robot: Arm, measured: Several, settings: PlacementSettings = DEFAULT_PLACEMENT, **arguments: Any
) -> Placements:
    """Calibrate camera and board, one carried by the arm and the other beside it, from a dozen images.

    It is the fit of `tool`, with the same arguments (robot, measured, settings, and more by their names).
    """
    return tool(robot, measured, settings, **arguments)
