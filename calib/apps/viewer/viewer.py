"""Display of a scene in Rerun; the only module that loads rerun-sdk, and only when a scene is shown.

Everything is on one timeline, ``time`` [s], in the order of a calibration: pose plans as they grow, measured poses one
by one, motions, torques. A pose lasts `EACH` seconds, a motion its own duration. Poses also have timelines of their
own, which count poses.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calib import files
from calib.errors import CalibError, UsageError, command_line, refused_as
from calib.toolkit.chains import Chain, Joint, joint_frames
from calib.toolkit.result_folders import DrawnRobot as Drawn
from calib.toolkit.result_folders import ErrorSizes, Measured, Played, Scene, Torques, TradeOffs, drawn, strips, thinned
from calib.transforms import to_quaternion
from calib.workers.extras import needing

if TYPE_CHECKING:
    from rerun import RecordingStream, TimeColumn

# colours, red, green and blue
ARM = [90, 100, 115]
BEFORE = [213, 94, 0]
AFTER = [0, 130, 90]
SEEN = [40, 90, 180]
LIMIT = [200, 60, 60]
BAND = [150, 200, 180]
CAD = [140, 90, 170]
DOMINATED = [170, 170, 170]
# between one part and the next [s]
GAP = 1.0
# that a pose stands still [s]
EACH = 0.2
FILE = "session.rrd"


class _Rerun:
    """The package rerun, loaded when one of its names is first used."""

    def __getattr__(self, name: str) -> Any:
        with needing("rerun", " (no version for Macs with Intel processors)"):
            import rerun
        return getattr(rerun, name)


rr = _Rerun()


def write(folder: str | Path, path: str | Path, robot: str | None = None) -> Scene:
    """Write a folder's scene as a Rerun recording, and return the scene; an incomplete recording is never left.

    Args:
        folder: folder of a result or a session, or a CSV.
        path: file of the recording.
        robot: the robot to draw; None: as the folder has it.

    Raises:
        UsageError: rerun is not installed, or the folder has nothing to show.
    """
    path = Path(path)
    scene = drawn(folder, robot)
    with tempfile.TemporaryDirectory() as temporary_folder:
        temporary = Path(temporary_folder) / "scene.rrd"
        recording = rr.RecordingStream(files.MAKER, recording_id=scene.title)
        recording.save(temporary, default_blueprint=_blueprint(scene))
        _send(recording, scene)
        recording.flush()
        recording.disconnect()
        files.write(path, temporary.read_bytes())
    return scene


def write_beside(folder: str | Path) -> str:
    """Write ``session.rrd`` into a folder, and return its name, or in one line why it failed; never raises.

    A recording is a convenience: neither a missing package nor a full disk stops the step that writes it.

    Args:
        folder: folder of a session.
    """
    try:
        write(folder, Path(folder) / FILE)
    except Exception as error:  # whatever rerun may raise
        return f"no {FILE}: {error}"
    return FILE


def spawn(folder: str | Path, robot: str | None = None) -> Scene:
    """Open Rerun's window with a folder's scene, and return the scene.

    Args:
        folder: folder of a result or a session, or a CSV.
        robot: the robot to draw; None: as the folder has it.

    Raises:
        UsageError: there is no display, as over SSH.
        CalibError: the window did not open.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        saved = command_line("view", folder, "--save", FILE)
        raise UsageError(f"no display to open a window on; {saved} writes a file for rerun on another computer")
    scene = drawn(folder, robot)
    recording = rr.RecordingStream(files.MAKER, recording_id=scene.title)
    message = "Rerun's window did not open ({}); calib view --save FILE.rrd writes a file"
    with refused_as(CalibError, Exception, message):
        recording.spawn(default_blueprint=_blueprint(scene))
    _send(recording, scene)
    recording.flush()
    return scene


def _send(recording: RecordingStream, scene: Scene) -> None:
    """Write all parts of a scene into a Rerun recording."""
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    recording.log("about", rr.TextDocument(about(scene), media_type="text/markdown"), static=True)
    start = 0.0
    for name, q in scene.chosen:
        if scene.chain is not None:
            start = _chosen(recording, scene, scene.chain, name, q, start)
    for measured in scene.measured:
        start = _measured(recording, scene, measured, start)
    for sizes in scene.sizes:
        start = _sizes(recording, scene, sizes, start)
    for played in scene.played:
        start = _played(recording, scene, played, start)
    for torques in scene.torques:
        start = _torques(recording, scene, torques, start)
    for front in scene.fronts:
        _front(recording, front)
    _meshes(recording, scene)


def about(scene: Scene) -> str:
    """Return the text on a scene that is shown next to the plots."""
    lines = [f"# {scene.title}"]
    for measured in scene.measured:
        nominal_mm = 1e3 * np.linalg.norm(measured.seen - measured.nominal, axis=1)
        calibrated_mm = 1e3 * np.linalg.norm(measured.seen - measured.calibrated, axis=1)
        for label, rows in (("fitted", ~measured.unseen), ("unseen", measured.unseen)):
            if rows.any():
                nominal = f"{_rms(nominal_mm[rows]):.3f} mm rms nominal (orange)"
                calibrated = f"{_rms(calibrated_mm[rows]):.3f} mm calibrated (green)"
                lines.append(f"{int(rows.sum())} {label} poses: {nominal}, {calibrated}")
        scale = 1.0
        if scene.chain:
            scale = measured.arrow_scale(scene.chain)
        meaning = "from the target's position by the arm's model to the measured one."
        lines.append(f"**Arrows are {scale:g} times as long as the errors**; {meaning}")
    for sizes in scene.sizes:
        lines += _size_lines(sizes)
    for name, q in scene.chosen:
        lines.append(f"pose plan *{name}*: {len(q)} poses")
    for motion in scene.played:
        lines.append(f"motion *{motion.name}*: {motion.t[-1]:.1f} s")
    for torques in scene.torques:
        lines.append(_torque_line(torques))
    for front in scene.fronts:
        lines.append(f"front of *{front.name}*: motion {front.designed + 1} of {len(front.values)} was designed")
    lines += [f"note: {note}" for note in scene.notes]
    return "\n\n".join(lines)


def _torque_line(torques: Torques) -> str:
    """Return the line on a recording's torques, with the colours of its curves."""
    curves = ["measured orange", "predicted green"]
    if torques.sigma is not None:
        curves.append("expected interval of 95 % light green")
    if torques.nominal is not None:
        curves.append("identified on the CAD geometry violet")
    return f"torques *{torques.name}*: {', '.join(curves)}, and residuals [N·m, N]"


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _size_lines(sizes: ErrorSizes) -> Iterator[str]:
    """Yield lines on the errors of measurements that do not give a position in the arm's base.

    Args:
        sizes: magnitudes of these errors.
    """
    for label, rows in (("fitted", ~sizes.unseen), ("unseen", sizes.unseen)):
        if not rows.any():
            continue
        beginning = f"{int(rows.sum())} {label} rows without a position in the arm's base: {sizes.kind} errors"
        nominal = _rms_mm(sizes.nominal[rows])
        calibrated = _rms_mm(sizes.calibrated[rows])
        yield f"{beginning}, {nominal} rms nominal (orange), {calibrated} calibrated (green)"


def _rms_mm(sizes: np.ndarray) -> str:
    """Return the rms of error sizes (m,) [m] as text in mm, ignoring NaN; 'not stated' if all are NaN."""
    errors_mm = 1e3 * sizes[np.isfinite(sizes)]
    if not len(errors_mm):
        return "not stated"
    return f"{_rms(errors_mm):.3f} mm"


def _poses(name: str, count: int, start: float, selection: np.ndarray | None = None) -> list[TimeColumn]:
    """Return the time columns of poses: on the common timeline from `start` [s] on, and on a counter called `name`.

    Args:
        name: name of the counter.
        count: number of poses.
        start: time at which the poses begin [s].
        selection: indices of the poses to include; None for all.
    """
    steps = np.arange(1, count + 1)
    if selection is not None:
        steps = selection + 1
    return [rr.TimeColumn("time", duration=start + EACH * steps), rr.TimeColumn(name, sequence=steps)]


def _measured(recording: RecordingStream, scene: Scene, measured: Measured, start: float) -> float:
    """Log measured points and error arrows, all together and pose by pose; return the start time of the next part [s].

    Args:
        recording: the recording.
        scene: the scene, which contains the robot.
        measured: the measured poses.
        start: time at which this part begins [s].
    """
    if not len(measured.q) or scene.chain is None:
        return start
    count = len(measured.q)
    scale = measured.arrow_scale(scene.chain)
    index = _poses("pose", count, start)
    recording.log("world/seen", rr.Points3D(measured.seen, radii=0.006, colors=SEEN), static=True)
    for name, points, colour in (("nominal", measured.nominal, BEFORE), ("calibrated", measured.calibrated, AFTER)):
        errors = measured.seen - points
        arrows = rr.Arrows3D(vectors=scale * errors, origins=points, colors=colour, radii=0.004)
        recording.log(f"world/errors_times_{scale:g}/{name}", arrows, static=True)
        recording.log(f"world/tool/{name}", rr.Points3D(points, radii=0.006, colors=colour), static=True)
        size_mm = 1e3 * np.linalg.norm(errors, axis=1)
        _series(recording, f"errors/{name}", index, size_mm, f"{name} [mm]", colour)
    _interval(recording, "errors", "pose", start, measured.interval)
    residual_mm = 1e3 * (measured.seen - measured.calibrated)
    for k, axis in enumerate("xyz"):
        _series(recording, f"axes/position/{axis}", index, residual_mm[:, k], f"{axis} in the arm's base [mm]")

    rows = np.flatnonzero(np.isfinite(measured.turned).all(axis=1))
    if len(rows):
        index_of_rows = _poses("pose", count, start, rows)
        turns_mrad = 1e3 * measured.turned[rows]
        size_mrad = np.linalg.norm(turns_mrad, axis=1)
        _series(recording, "turns/calibrated", index_of_rows, size_mrad, "orientation, calibrated [mrad]", AFTER)
        for k, axis in enumerate("xyz"):
            entity = f"axes/orientation/{axis}"
            _series(recording, entity, index_of_rows, turns_mrad[:, k], f"about {axis} [mrad]")
    if measured.unseen.any():
        is_unseen = np.where(measured.unseen, 1.0, 0.0)
        _series(recording, "errors/unseen", index, is_unseen, "1: unseen, 0: fitted", SEEN)

    radii = np.full(count, 0.015)
    colours = np.tile(SEEN, (count, 1))
    pose_columns = rr.Points3D.columns(positions=measured.seen, radii=radii, colors=colours)
    recording.send_columns("world/pose", indexes=index, columns=pose_columns)
    _arm(recording, scene, index, measured.q)
    return start + EACH * count + GAP


def _sizes(recording: RecordingStream, scene: Scene, sizes: ErrorSizes, start: float) -> float:
    """Log the sizes of errors row by row, with the arm at each row's pose; return the start time of the next part [s].

    Args:
        recording: the recording.
        scene: the scene, which contains the robot.
        sizes: magnitudes of the errors.
        start: time at which this part begins [s].
    """
    count = len(sizes.q)
    entity = f"errors/{sizes.kind}"
    if sizes.kind == "position":
        entity = "errors"
    for name, size, colour in (("nominal", sizes.nominal, BEFORE), ("calibrated", sizes.calibrated, AFTER)):
        rows = np.flatnonzero(np.isfinite(size))
        if len(rows):
            index = _poses("row", count, start, rows)
            _series(recording, f"{entity}/{name}", index, 1e3 * size[rows], f"{name} [mm]", colour)
    _interval(recording, entity, "row", start, sizes.interval)
    index = _poses("row", count, start)
    if sizes.unseen.any():
        is_unseen = np.where(sizes.unseen, 1.0, 0.0)
        _series(recording, f"{entity}/unseen", index, is_unseen, "1: unseen, 0: fitted", SEEN)
    _arm(recording, scene, index, sizes.q)
    return start + EACH * count + GAP


def _interval(recording: RecordingStream, entity: str, counter: str, start: float, interval: np.ndarray | None) -> None:
    """Log the radii (m,) [m] within which 95 % of the calibrated arm's errors are expected, at rows that have one."""
    if interval is None:
        return
    rows = np.flatnonzero(np.isfinite(interval))
    if len(rows):
        index = _poses(counter, len(interval), start, rows)
        _series(recording, f"{entity}/interval95", index, 1e3 * interval[rows], "95 % expected below [mm]", BAND)


def _chosen(
    recording: RecordingStream, scene: Scene, chain: Chain | Drawn, name: str, q: np.ndarray, start: float
) -> float:
    """Log a pose plan as it grows: one more tool position per step, and the arm at the newest pose.

    Args:
        recording: the recording.
        scene: the scene.
        chain: the robot.
        name: name of the plan.
        q: (m, n) joint values of the plan's poses [rad or m].
        start: time at which this part begins [s].

    Returns:
        The start time of the next part [s].
    """
    tips = strips(chain, q)[0][:, -1]
    counts = np.arange(1, len(q) + 1)
    positions = np.concatenate([tips[:k] for k in counts])
    points = rr.Points3D.columns(positions=positions, radii=np.full(len(positions), 0.008))
    index = _poses(f"chosen: {name}", len(q), start)
    part = _part(name)
    recording.send_columns(f"world/chosen/{part}", indexes=index, columns=points.partition(counts))
    _series(recording, f"chosen/{part}", index, counts.astype(float), f"{name}: poses", SEEN)
    _arm(recording, scene, index, q)
    return start + EACH * len(q) + GAP


def _played(recording: RecordingStream, scene: Scene, played: Played, start: float) -> float:
    """Log a motion and its limits; return the start time of the next part [s].

    Args:
        recording: the recording.
        scene: the scene, which contains the robot.
        played: the motion.
        start: time at which this part begins [s].
    """
    t = start + played.t - played.t[0]
    samples = thinned(played.t)
    index = [rr.TimeColumn("time", duration=t[samples])]
    names = [f"q{k + 1}" for k in range(played.q.shape[1])]
    if scene.chain is not None:
        names = list(scene.chain.joint_names)
    for j, name in enumerate(names):
        _series(recording, f"motion/position/{_part(name)}", index, played.q[samples, j], name)
        if played.v is not None:
            _series(recording, f"motion/velocity/{_part(name)}", index, played.v[samples, j], name)
        if scene.chain is not None:
            _limits(recording, scene.chain.joints[j], name, t[[0, -1]], played.v is not None)
    _arm(recording, scene, index, played.q[samples])
    return float(t[-1]) + GAP


def _limits(recording: RecordingStream, joint: Joint, name: str, ends: np.ndarray, velocities: bool) -> None:
    """Log a joint's limits, if it has any, as lines over the duration of a motion.

    Args:
        recording: the recording.
        joint: the joint.
        name: its name in the viewer.
        ends: (2,) first and last time of the motion [s].
        velocities: whether the limits of velocity are logged, too.
    """
    index = [rr.TimeColumn("time", duration=ends)]
    limits = [("position", "lower", joint.lower), ("position", "upper", joint.upper)]
    if velocities:
        limits += [("velocity", "lower", -joint.velocity), ("velocity", "upper", joint.velocity)]
    for kind, side, value in limits:
        if np.isfinite(value):
            entity = f"limits/{kind}/{_part(name)}/{side}"
            _series(recording, entity, index, [value, value], f"{name} {side}", LIMIT)


def _torques(recording: RecordingStream, scene: Scene, torques: Torques, start: float) -> float:
    """Log measured torques, predicted torques and residuals, with the arm on the same time axis.

    Args:
        recording: the recording.
        scene: the scene, which contains the robot.
        torques: torques of one recording of the robot.
        start: time at which this part begins [s].

    Returns:
        The start time of the next part [s].
    """
    t = start + torques.t - torques.t[0]
    index = [rr.TimeColumn("time", duration=t)]
    for j, (name, unit) in enumerate(zip(torques.rows, torques.units)):
        part = _part(name)
        measured = torques.measured[:, j]
        predicted = torques.predicted[:, j]
        _series(recording, f"torques/{part}/measured", index, measured, f"measured [{unit}]", BEFORE)
        _series(recording, f"torques/{part}/predicted", index, predicted, f"predicted [{unit}]", AFTER)
        _series(recording, f"residuals/{part}", index, measured - predicted, f"{name} [{unit}]")
        if torques.band is not None:
            for side, bound in zip(("lower", "upper"), torques.band):
                _series(recording, f"torques/{part}/{side}", index, bound[:, j], f"95 %, {side} [{unit}]", BAND)
        if torques.nominal is not None:
            nominal = torques.nominal[:, j]
            _series(recording, f"torques/{part}/nominal", index, nominal, f"on the CAD geometry [{unit}]", CAD)
    if torques.q is not None:
        samples = thinned(torques.t)
        _arm(recording, scene, [rr.TimeColumn("time", duration=t[samples])], torques.q[samples])
    return float(t[-1]) + GAP


def _front(recording: RecordingStream, front: TradeOffs) -> None:
    """Log a front of trade-offs as labelled points, each objective scaled to 0 to 1; the designed motion is marked."""
    colours = np.where(front.best[:, None], AFTER, DOMINATED)
    colours[front.designed] = BEFORE
    points = front.drawn * [1.0, -1.0]  # the viewer's y axis points down
    entity = f"front/{_part(front.name)}"
    motions = rr.Points2D(points, radii=0.02, colors=colours, labels=front.labels)
    recording.log(f"{entity}/motions", motions, static=True)
    order = np.flatnonzero(front.best)
    order = order[np.argsort(points[order, 0])]
    recording.log(f"{entity}/best", rr.LineStrips2D([points[order]], colors=[AFTER]), static=True)


def _part(name: str) -> str:
    """Return a name as one part of a Rerun entity path, with an underscore for each blank."""
    return rr.escape_entity_path_part(name.replace(" ", "_"))


def _series(
    recording: RecordingStream,
    path: str,
    index: list[TimeColumn],
    values: Sequence[float] | np.ndarray,
    name: str,
    colour: Sequence[int] | None = None,
) -> None:
    """Log one curve of a plot with its legend.

    Args:
        recording: the recording.
        path: entity path of the curve.
        index: time columns of the values.
        values: the values.
        name: name in the legend.
        colour: colour of the curve; None: chosen by Rerun.
    """
    style = {}
    if colour is not None:
        style["colors"] = colour
    recording.log(path, rr.SeriesLines(names=name, **style), static=True)
    scalars = rr.Scalars.columns(scalars=np.asarray(values, dtype=float))
    recording.send_columns(path, indexes=index, columns=scalars)


def _arm(recording: RecordingStream, scene: Scene, index: list[TimeColumn], q: np.ndarray) -> None:
    """Log the arm's links as lines, and the frames of the links if the robot has meshes, at joint values q (m, n).

    Args:
        recording: the recording.
        scene: the scene, which contains robot and meshes.
        index: time columns of the m poses.
        q: joint values [rad or m].
    """
    if scene.chain is None or q.shape[1] != scene.chain.n:
        return
    lines = strips(scene.chain, q)
    radius = 0.018 / len(lines)
    if scene.meshes:
        # thin, so that the meshes hide them
        radius = 0.006
    lines_by_pose = []
    for lines_of_pose in zip(*lines):
        lines_by_pose += lines_of_pose
    count = len(lines_by_pose)
    colours = np.tile(ARM, (count, 1))
    line_columns = rr.LineStrips3D.columns(strips=lines_by_pose, radii=np.full(count, radius), colors=colours)
    line_counts = [len(lines)] * len(q)
    recording.send_columns("world/robot/lines", indexes=index, columns=line_columns.partition(line_counts))

    points = np.concatenate(lines, axis=1)
    points_of_pose = points.shape[1]
    count = points_of_pose * len(q)
    colours = np.tile(ARM, (count, 1))
    radii = np.full(count, 1.4 * radius)
    spheres = rr.Points3D.columns(positions=points.reshape(-1, 3), radii=radii, colors=colours)
    point_counts = [points_of_pose] * len(q)
    recording.send_columns("world/robot/joints", indexes=index, columns=spheres.partition(point_counts))
    if scene.meshes and isinstance(scene.chain, Chain):
        for link, frame in zip(scene.chain.links, joint_frames(scene.chain, q)):
            motion = rr.Transform3D.columns(translation=frame[:, :3, 3], quaternion=to_quaternion(frame))
            recording.send_columns(f"world/robot/links/{_part(link)}", indexes=index, columns=motion)


def _meshes(recording: RecordingStream, scene: Scene) -> None:
    """Log each mesh of a scene's robot once, attached to the frame of its link."""
    for number, mesh in enumerate(scene.meshes):
        entity = f"world/robot/links/{_part(mesh.link)}/mesh_{number}"
        position = mesh.placement[:3, 3]
        orientation = to_quaternion(mesh.placement)
        placement = rr.Transform3D(translation=position, quaternion=orientation, scale=mesh.scale)
        recording.log(entity, placement, rr.Asset3D(path=mesh.file), static=True)


def _blueprint(scene: Scene) -> Any:
    """Return the initial layout of the recording of a scene: the arm on the left, plots and text on the right."""
    import rerun.blueprint as rrb

    tabs: list[Any] = []
    # a line's name shows where the pointer is
    silent = rrb.PlotLegend(visible=False)
    if scene.chosen:
        tabs.append(rrb.TimeSeriesView(origin="chosen", name="pose plans"))
    if scene.measured:
        sizes = [rrb.TimeSeriesView(origin="errors", name="position error [mm]")]
        sides = [rrb.TimeSeriesView(origin="axes/position", name="residuals by axis [mm]")]
        if any(np.isfinite(measured.turned).any() for measured in scene.measured):
            sizes.append(rrb.TimeSeriesView(origin="turns", name="orientation error [mrad]"))
            sides.append(rrb.TimeSeriesView(origin="axes/orientation", name="residuals about each axis [mrad]"))
        tabs += [rrb.Vertical(*sizes, name="error of each pose"), rrb.Vertical(*sides, name="error by axis")]
    elif scene.sizes:
        tabs.append(rrb.TimeSeriesView(origin="errors", name="error of each row [mm]"))
    if scene.played:
        views = []
        for kind, unit in (("position", ""), ("velocity", "/s")):
            view = rrb.TimeSeriesView(
                origin="/",
                contents=[f"+ /motion/{kind}/**", f"+ /limits/{kind}/**"],
                name=f"{kind} [rad{unit} or m{unit}], limits in red",
                plot_legend=silent,
            )
            views.append(view)
        tabs.append(rrb.Vertical(*views, name="motion"))
    if scene.torques:
        names: list[str] = []
        for torques in scene.torques:
            names += torques.rows
        plots = []
        # each once, in order of appearance
        for name in dict.fromkeys(names):
            plot = rrb.TimeSeriesView(origin=f"torques/{_part(name)}", name=name, plot_legend=silent)
            plots.append(plot)
        grid = rrb.Grid(*plots, grid_columns=2)
        residuals = rrb.TimeSeriesView(origin="residuals", name="measured minus predicted")
        tabs.append(rrb.Vertical(grid, residuals, row_shares=[3, 1], name="torques"))
    for front in scene.fronts:
        axes = " over ".join(reversed(front.objectives))
        origin = f"front/{_part(front.name)}"
        tabs.append(rrb.Spatial2DView(origin=origin, name=f"front of {front.name}: {axes}, both scaled"))
    picture = rrb.Spatial3DView(origin="world", name="robot, nominal orange, calibrated green")
    right = rrb.Tabs(*tabs, active_tab=int(bool(scene.measured and scene.chosen)))
    text = rrb.TextDocumentView(origin="about", name="what is shown")
    left = rrb.Vertical(picture, text, row_shares=[4, 1])
    views = rrb.Horizontal(left, right, column_shares=[3, 2])
    timeline = "pose"
    if scene.chosen or scene.played or scene.torques:
        timeline = "time"
    time_panel = rrb.TimePanel(timeline=timeline, state="collapsed")
    selection_panel = rrb.SelectionPanel(state="collapsed")
    blueprint_panel = rrb.BlueprintPanel(state="collapsed")
    return rrb.Blueprint(views, time_panel, selection_panel, blueprint_panel, auto_views=False)
