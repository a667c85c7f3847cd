"""Placements of tool, base, camera and board in Python: `calib.tool`, `calib.base`, `calib.hand_eye`.

All three are the fit of the model ``frames`` (`calib.fit_geometry`): instrument and targets are placed, and the arm's
geometry is not changed. The three differ in the frames that are printed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from calib.apps.controller_programs.frames import stated_frame
from calib.apps.registration.pairs import measured_pairs
from calib.apps.registration.printed_frames import Placed, description_of, in_controller, urdf_with
from calib.apps.registration.settings import DEFAULT_PLACEMENT, PlacementSettings
from calib.errors import UsageError
from calib.records import as_subclass
from calib.toolkit.chains import CalibratedChain, controller_named, is_urdf, load_calibrated, resolve
from calib.toolkit.installations import FRAME_AXES
from calib.toolkit.pose_data import FitOptions, PoseMeasurements, read_fit_options
from calib.toolkit.pose_pairs import IN_HAND, TO_HAND, PosePairs, read_pairs
from calib.toolkit.result_folders import FitSettings, GeometryFit, Progress, Several, fit_geometry
from calib.toolkit.statistics import Estimate
from calib.transforms import invert

Arm = str | Path | CalibratedChain
# of a quick calibration (our choice)
USUAL_POSES = 12
# what the arm carries where neither names nor options say it
OPEN = "camera or board"
# what stands beside an arm that carries the camera, or the board
STANDING = {"camera": "board", "board": "camera", OPEN: "board or camera"}
CARRIED = {IN_HAND: "camera", TO_HAND: "board"}


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
        carried = self.carried
        standing = STANDING.get(carried, "instrument")
        frames = list[Placed]()
        for name, pose in zip(cell.tool_names, cell.tools):
            sigma = _sigma(fit.estimate, name, _turned(pose))
            title = self._title(carried, name, cell.tool_names)
            frames.append(Placed(f"{title} in {chain.tip}", pose, sigma, carried, chain.tip))
        if not block.has_instrument:
            return tuple(frames)
        for name, pose in zip(cell.station_names, cell.stations):
            sigma = _sigma(fit.estimate, name, _turned(pose))
            title = self._title(standing, name, cell.station_names)
            frames.append(Placed(f"base in {title}", pose, sigma, chain.base, standing))
            # small motions of the inverse: -dp - dr × t, and -dr
            inverse = invert(pose)
            jacobian = -np.eye(6)
            jacobian[:3, 3:] = np.cross(inverse[:3, 3], np.eye(3)).T
            sigma = _sigma(fit.estimate, name, jacobian)
            frames.append(Placed(f"{title} in {chain.base}", inverse, sigma, standing, chain.base))
        return tuple(frames)

    @property
    def carried(self) -> str:
        """What the arm carries: tool, camera or board."""
        return self.inputs.fit[0].carried[0]

    def _title(self, frame: str, name: str, names: tuple[str, ...]) -> str:
        """Return how a frame is called in a line: with its own name.

        Args:
            frame: what it is: tool, camera, board, instrument.
            name: its name.
            names: names of all frames of its kind.
        """
        return f"{frame} '{name}'"

    def lines(self, *first: str) -> Iterator[str]:
        """Yield the console lines: verdict, residual, and frames.

        Args:
            *first: beginnings of the names of the frames to print.
        """
        yield str(self.verdict)
        for frame in self.placed:
            if frame.name.startswith(first):
                yield str(frame)
        yield from self._on_residual()

    def _on_residual(self) -> Iterator[str]:
        """Yield the lines on the residual, from which σ is computed, on warnings, and on a small number of poses."""
        poses = self.fit.poses
        rms_mm = 1e3 * self.fit.errors[1].rms
        yield f"{poses} poses, {rms_mm:.3g} mm rms residual (with the arm's random errors), from which σ is computed"
        yield from map(str, self.warnings)
        if poses < USUAL_POSES:
            yield f"{poses} poses are few: measure {USUAL_POSES}, with the wrist turned by 90° and more between them"

    def __str__(self) -> str:
        return "\n".join(self.lines(""))


class HandEye(Placements):
    """A fit of the placements of camera and board, one carried by the arm and the other beside it.

    ``print`` shows both frames with σ, as the origin of a URDF's joint and as the command for a ROS transform.
    """

    @property
    def carried(self) -> str:
        """What the arm carries: camera or board; ``camera or board`` if neither names nor options say it."""
        block = self.inputs.fit[0]
        carried = block.carried[0]
        if carried in STANDING:
            return carried
        mounting = getattr(block, "mounting", "")
        if not mounting and getattr(block, "lever", None) is not None:
            mounting = IN_HAND
        return CARRIED.get(mounting, OPEN)

    @property
    def transforms(self) -> tuple[Placed, ...]:
        """Camera and board: the carried one in the arm's tip, the standing one in its base."""
        standing = STANDING[self.carried]
        frames = [frame for frame in self.placed if frame.frame in (self.carried, standing)]
        if _are_open(frames):
            # what is not identifiable of one position moves the other
            unknown = np.array([*np.full(3, np.nan), *np.zeros(3)])
            frames = [replace(frame, sigma=frame.sigma + unknown) for frame in frames]
        return tuple(frames)

    @property
    def is_open(self) -> bool:
        """Whether a component of a placement is not identifiable, so that numbers of both frames depend on a choice."""
        return _are_open(self.transforms)

    @property
    def defect(self) -> str:
        """Why the frames are not for use; empty where they are."""
        if self.verdict.level == "fail":
            return "the verdict is fail"
        if self.is_open:
            return (
                "the poses turn about one axis only: positions of camera and board along it are not identifiable, only "
                "their sum; turn the wrist by 90° and more about a second axis"
            )
        return ""

    @property
    def is_of_pairs(self) -> bool:
        """Whether it was fitted to pairs of poses, whose robot's joints are coordinates of its poses."""
        return self.inputs.chain.is_free_flyer

    def for_controller(
        self, name: str, source: Path | None = None, world: str | None = None, flange: str | None = None
    ) -> Iterator[str]:
        """Yield both transforms as frames of a robot controller.

        Args:
            name: the controller (``calib program --list``).
            source: the robot's description, for pairs of poses; None: that of the fit.
            world, flange: poses of the controller's base in the arm's base, and of its flange in the arm's tip, as in
                `calib deliver`; None where the description says them.

        Raises:
            UsageError: the frames are not for use.
        """
        self._check_use()
        arm = None
        if not self.is_of_pairs:
            arm = description_of(source or self.inputs.source, self.robot.chain)
        statements = stated_frame(world, "--world"), stated_frame(flange, "--flange")
        controller = controller_named(name)
        yield f"{controller.title}:"
        yield from in_controller(self.transforms, controller, self.robot.chain.base, arm, *statements)

    def urdf(self, source: Path | None = None) -> tuple[str, list[str]]:
        """Return the robot's URDF with a link for camera and board each, and the names of these links.

        Args:
            source: the robot's description, for pairs of poses; None: that of the fit.

        Raises:
            UsageError: the frames are not for use, it is not known what the arm carries, or the robot has no URDF.
        """
        self._check_use()
        if self.carried == OPEN:
            raise UsageError(
                "it is not known whether the arm carries the camera or the board: state [camera] mounting = "
                f"'{IN_HAND}' (camera) or '{TO_HAND}' (board) in the options, then write the URDF"
            )
        if self.is_of_pairs and source is None:
            raise UsageError("pairs of poses have no URDF: give the robot's before the file")
        return urdf_with(resolve(source or self.inputs.source), self.transforms)

    def _check_use(self) -> None:
        """Raise UsageError if the frames are not for use."""
        if self.defect:
            raise UsageError(f"no frames for use: {self.defect}")

    def _title(self, frame: str, name: str, names: tuple[str, ...]) -> str:
        return frame if len(names) == 1 else f"{frame} '{name}'"

    def lines(self, *first: str) -> Iterator[str]:
        """Yield the console lines: verdict, both transforms in the words of their users, residual, remarks."""
        yield str(self.verdict)
        for frame in self.transforms:
            yield str(frame)
            if not self.defect:
                yield f"URDF: {frame.urdf_origin}"
                yield f"ROS: {frame.ros_command}"
        if self.defect:
            yield f"no frames are printed or written for use: {self.defect}"
        if self.carried == OPEN:
            tip = self.robot.chain.tip
            yield (
                f"the poses do not say what {tip} carries: the board if they are poses of the board in the camera, as "
                "detectors give them; the camera if they are poses of the camera in the board. State [camera] mounting "
                f"= '{TO_HAND}' (board) or '{IN_HAND}' (camera) in the options"
            )
        yield from self._on_residual()


def _are_open(frames: Iterable[Placed]) -> bool:
    """Return whether a component of a frame is not identifiable."""
    return any(bool(np.isnan(frame.sigma).any()) for frame in frames)


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
    robot: Arm | None,
    measured: Several = (),
    settings: PlacementSettings = DEFAULT_PLACEMENT,
    *,
    options: FitOptions | str | Path | None = None,
    base: str | None = None,
    tip: str | None = None,
    progress: Progress | None = None,
) -> HandEye:
    """Calibrate camera and board, one carried by the arm and the other fixed beside it, from a dozen poses.

    Poses of the board in the camera, and of the camera in the board, are told apart by what agrees with the robot.

    Args:
        robot: the arm, as for `tool`; None for pairs of poses, in which case it names base and tip only.
        measured: folders of images; tables of joints and poses; or pairs of poses without joints (robot and board): CSV
            tables, files of easy_handeye, MoveIt or OpenCV (``calib formats pairs``). Empty: `robot` is such a file.
        settings: tolerance, and share of the poses to hold out.
        options: options for reading the files; ``[camera] mounting`` states what the arm carries.
        base, tip: first and last link of the arm in a URDF; None: its root, and its flange.
        progress: called with a text on each step; None: no report.

    Returns:
        The fit: ``transforms`` has both frames with σ, ``verdict`` the verdict.

    Raises:
        MeasurementError: a file is invalid; the message names row and column.
        UsageError: a robot is missing.
    """
    file_options = options if isinstance(options, FitOptions) else read_fit_options(options)
    sources = _listed(measured)
    if not sources and isinstance(robot, (str, Path)) and Path(robot).is_file() and not is_urdf(Path(robot)):
        sources.append(Path(robot))
        robot = None
    pairs = _read_pairs(sources, file_options)
    if pairs:
        return _of_pairs(robot, pairs, settings, file_options, base, tip, progress)
    if robot is None or not sources:
        raise UsageError("a robot and measured poses are needed; only a file of pairs of poses does without robot")
    fit = tool(robot, sources, settings, options=file_options, base=base, tip=tip, progress=progress)
    return as_subclass(fit, HandEye)


def _listed(measured: Several) -> list[Path | PoseMeasurements]:
    """Return measurements as a list: files as paths, blocks as they are."""
    if isinstance(measured, (str, Path)):
        return [Path(measured)]
    if isinstance(measured, PoseMeasurements):
        return [measured]
    sources = list[Path | PoseMeasurements]()
    for source in measured:
        sources += _listed(source)
    return sources


def _read_pairs(sources: list[Path | PoseMeasurements], options: FitOptions) -> list[PosePairs]:
    """Return the pairs of poses of files; none if the files have other measurements.

    Raises:
        UsageError: some files have pairs of poses, others do not.
    """
    pairs = []
    for source in sources:
        if isinstance(source, Path):
            of_file = read_pairs(source, options.for_file(source))
            if of_file is not None:
                pairs.append(of_file)
    if pairs and len(pairs) < len(sources):
        raise UsageError(f"{pairs[0].file} has pairs of poses without joints, other files have not: fit them apart")
    if len(pairs) > 1:
        raise UsageError(f"{pairs[0].file} and {pairs[1].file} have pairs of poses: give one file at a time")
    return pairs


def _of_pairs(
    robot: Arm | None,
    pairs: list[PosePairs],
    settings: PlacementSettings,
    options: FitOptions,
    base: str | None,
    tip: str | None,
    progress: Progress | None,
) -> HandEye:
    """Return camera and board placed by pairs of poses; the robot, if any, names base and tip."""
    chain = None
    if robot is not None:
        chain = robot.chain if isinstance(robot, CalibratedChain) else load_calibrated(robot, base, tip).chain
    mounting = options.for_file(pairs[0].file).camera.mounting
    if mounting == "auto":
        mounting = ""
    free_flyer, block = measured_pairs(pairs[0], mounting, chain)
    fit = tool(free_flyer, cast(Several, [block]), settings, options=options, progress=progress)
    return as_subclass(fit, HandEye)
