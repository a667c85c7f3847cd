"""Placements of tool, base, camera and board in Python: `calib.tool`, `calib.base`, `calib.hand_eye`.

All three are the fit of the model ``frames`` (`calib.fit_geometry`): instrument and targets are placed, and the arm's
geometry is not changed. The three differ in the frames that are printed.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from calib.apps.registration.settings import DEFAULT_PLACEMENT, PlacementSettings
from calib.records import as_subclass
from calib.toolkit.chains import CalibratedChain
from calib.toolkit.installations import FRAME_AXES
from calib.toolkit.pose_data import FitOptions
from calib.toolkit.result_folders import FitSettings, GeometryFit, Progress, Several, fit_geometry
from calib.toolkit.statistics import Estimate
from calib.transforms import invert
from calib.units import DEG

Arm = str | Path | CalibratedChain
# of a quick calibration (our choice)
USUAL_POSES = 12
# what stands beside an arm that carries the camera, or the board
STANDING = {"camera": "board", "board": "camera"}


class Placed(NamedTuple):
    """A placed frame.

    Attributes:
        name: names of the frame and of its reference frame.
        pose: (4, 4) pose in the reference frame [m].
        sigma: (6,) σ of the position [m] and of small rotations [rad] along the axes of the reference frame; NaN where
            the measurements do not identify a component.
    """

    name: str
    pose: np.ndarray
    sigma: np.ndarray

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


class Placements(GeometryFit):
    """A fit of base and tool placement.

    ``print`` shows the frames with σ, then the verdict.
    """

    tab = f"placed {GeometryFit.tab}"

    @property
    def placed(self) -> tuple[Placed, ...]:
        """The placed frames.

        They are each target in the arm's tip, the arm's base in each instrument, and each instrument in the arm's base.
        """
        fit = self.selection.fit
        chain = self.robot.chain
        cell = fit.cell
        block = self.inputs.fit[0]
        carried = block.carried[0]
        standing = STANDING.get(carried, "instrument")
        frames = list[Placed]()
        for name, pose in zip(cell.tool_names, cell.tools):
            sigma = _sigma(fit.estimate, name, _turned(pose))
            frames.append(Placed(f"{carried} '{name}' in {chain.tip}", pose, sigma))
        if not block.has_instrument:
            return tuple(frames)
        for name, pose in zip(cell.station_names, cell.stations):
            sigma = _sigma(fit.estimate, name, _turned(pose))
            frames.append(Placed(f"base in {standing} '{name}'", pose, sigma))
            # small motions of the inverse: -dp - dr × t, and -dr
            inverse = invert(pose)
            jacobian = -np.eye(6)
            jacobian[:3, 3:] = np.cross(inverse[:3, 3], np.eye(3)).T
            sigma = _sigma(fit.estimate, name, jacobian)
            frames.append(Placed(f"{standing} '{name}' in {chain.base}", inverse, sigma))
        return tuple(frames)

    def lines(self, *first: str) -> Iterator[str]:
        """Yield the console lines: verdict, residual, and frames.

        Args:
            *first: beginnings of the names of the frames to print.
        """
        poses = self.fit.poses
        yield str(self.verdict)
        for frame in self.placed:
            if frame.name.startswith(first):
                yield str(frame)
        rms_mm = 1e3 * self.fit.errors[1].rms
        yield f"{poses} poses, {rms_mm:.3g} mm rms residual (with the arm's random errors), from which σ is computed"
        yield from map(str, self.warnings)
        if poses < USUAL_POSES:
            yield f"{poses} poses are few: measure {USUAL_POSES}, with the wrist turned by 90° and more between them"

    def __str__(self) -> str:
        return "\n".join(self.lines(""))


def _turned(pose: np.ndarray) -> np.ndarray:
    """Return the Jacobian (6, 6) of small motions along the reference axes by those along a frame's own axes.

    Args:
        pose: (4, 4) pose of the frame in the reference frame.
    """
    return np.kron(np.eye(2), pose[:3, :3])


def _sigma(estimate: Estimate, name: str, jacobian: np.ndarray) -> np.ndarray:
    """Return σ (6,) of `jacobian` times the six small motions of a frame; NaN where a component is not identified.

    Args:
        estimate: the fit's estimate with its covariance.
        name: name of the frame.
        jacobian: (6, 6) derivative of the wanted components by the small motions.
    """
    identified = np.zeros(6, dtype=bool)
    index = []
    for k, axis in enumerate(FRAME_AXES):
        parameter = f"{name}.{axis}"
        if parameter in estimate.names:
            identified[k] = True
            index.append(estimate.names.index(parameter))
    covariance = np.full((6, 6), np.nan)
    covariance[np.ix_(identified, identified)] = estimate.covariance[np.ix_(index, index)]
    variances = []
    for row in jacobian:
        # 0 times an unidentified variance would be unidentified, too
        nonzero = row != 0.0
        variances.append(row[nonzero] @ covariance[np.ix_(nonzero, nonzero)] @ row[nonzero])
    return np.sqrt(np.array(variances))


def _stated(values: np.ndarray, sigmas: np.ndarray) -> str:
    """Return as text values with three decimals and their standard deviations.

    Args:
        values, sigmas: values and standard deviations, in one unit.
    """
    texts = []
    for value, sigma in zip(values, sigmas):
        if np.isnan(sigma):
            texts.append(f"{value:.3f} (not identifiable)")
        else:
            texts.append(f"{value:.3f} ± {sigma:.2g}")
    return ", ".join(texts)


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
        robot: the arm, whose geometry is not changed: library name, file (URDF, or MDH table in TOML), folder of a fit,
            or a robot in memory.
        measured: one or several CSV files of measured poses, folders of images, or results of `read_poses`.
        settings: tolerance, and share of the poses to hold out.
        options: options for reading the files (`calib formats options`): TOML file, or in memory; None: defaults.
        base, tip: first and last link of the arm in a URDF; None: its root, and its flange.
        progress: called with a text on each step; None: no report.

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

    The arguments (robot, measured, settings, and further ones by name) and the fit are those of `tool`.
    """
    return tool(robot, measured, settings, **arguments)


def hand_eye(
    robot: Arm, measured: Several, settings: PlacementSettings = DEFAULT_PLACEMENT, **arguments: Any
) -> Placements:
    """Calibrate camera and board, one carried by the arm and the other fixed beside it, from a dozen images.

    The arguments (robot, measured, settings, and further ones by name) and the fit are those of `tool`.
    """
    return tool(robot, measured, settings, **arguments)
