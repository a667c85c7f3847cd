"""Display of a scene in Rerun; the only module that loads rerun-sdk, and only to show a scene.

Everything plays on one clock, the timeline ``time``, in the order of the work: pose plans as they grow, measured poses
one by one, motions, torques; poses last `EACH`, motions as long as they are. Poses have timelines of their own beside.
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
from calib.toolkit.chains import Chain, joint_frames
from calib.toolkit.opened_results import DrawnRobot as Drawn
from calib.toolkit.opened_results import ErrorSizes, Measured, Played, Scene, Torques, drawn, strips, thinned
from calib.transforms import to_quaternion

if TYPE_CHECKING:
    from rerun import RecordingStream, TimeColumn

ARM, BEFORE, AFTER, SEEN, LIMIT = ([90, 100, 115], [213, 94, 0], [0, 130, 90], [40, 90, 180], [200, 60, 60])
GAP = 1.0  # between one part and the next [s]
EACH = 0.2  # that a pose stands still [s]
FILE = "session.rrd"


class _Rerun:
    """The package rerun, loaded at first use."""

    def __getattr__(self, name: str) -> Any:
        message = "Rerun is not installed here (no version for Macs with Intel processors): pip install rerun-sdk"
        with refused_as(UsageError, ImportError, message):
            import rerun
        return getattr(rerun, name)


rr = _Rerun()


def write(folder: str | Path, path: str | Path, robot: str | None = None) -> Scene:
    """Write a folder's scene as a Rerun recording, complete or not at all.

    Raises:
        UsageError: where rerun is not installed, or there is nothing to see.
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
    """Write ``session.rrd`` into a folder if possible, and report the result in one line; never raises.

    A recording is a convenience: neither a missing package nor a full disk stops what it belongs to.
    """
    try:
        write(folder, Path(folder) / FILE)
    except Exception as error:  # whatever rerun may raise
        return f"no {FILE}: {error}"
    return FILE


def spawn(folder: str | Path, robot: str | None = None) -> Scene:
    """Open Rerun's window with a folder's scene.

    Raises:
        UsageError: where no display is there, as over SSH.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        saved = command_line("view", folder, "--save", FILE)
        raise UsageError(f"no display to open a window on; {saved} writes a file for rerun on another computer")
    scene = drawn(folder, robot)
    recording = rr.RecordingStream(files.MAKER, recording_id=scene.title)
    with refused_as(
        CalibError, Exception, "Rerun's window did not open ({}); calib view --save FILE.rrd writes a file"
    ):
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
    _meshes(recording, scene)


def about(scene: Scene) -> str:
    """Return the text shown next to the plots."""
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
        lines.append(f"torques *{torques.name}*: measured orange, predicted green, and residuals [N·m, N]")
    lines += [f"note: {note}" for note in scene.notes]
    return "\n\n".join(lines)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _size_lines(sizes: ErrorSizes) -> Iterator[str]:
    """Yield what the text beside the plots says of rows without a measured position in the arm's base."""
    for label, rows in (("fitted", ~sizes.unseen), ("unseen", sizes.unseen)):
        if not rows.any():
            continue
        errors = [1e3 * size[rows & np.isfinite(size)] for size in (sizes.nominal, sizes.calibrated)]
        rms = [f"{float(np.sqrt(np.mean(size**2))):.3f} mm" if len(size) else "not stated" for size in errors]
        yield (
            f"{int(rows.sum())} {label} rows without a position in the arm's base: {sizes.kind} errors, "
            f"{rms[0]} rms nominal (orange), {rms[1]} calibrated (green)"
        )


def _poses(name: str, count: int, start: float, selection: np.ndarray | None = None) -> list[TimeColumn]:
    """Return the time columns of `count` poses, or `some` of them: the common clock from `start` [s], and a counter."""
    steps = np.arange(1, count + 1) if selection is None else selection + 1
    return [rr.TimeColumn("time", duration=start + EACH * steps), rr.TimeColumn(name, sequence=steps)]


def _measured(recording: RecordingStream, scene: Scene, measured: Measured, start: float) -> float:
    """Log points and error arrows, together and pose by pose; return the start time of the next part [s]."""
    if not len(measured.q) or scene.chain is None:
        return start
    scale = measured.arrow_scale(scene.chain)
    index = _poses("pose", len(measured.q), start)
    recording.log("world/seen", rr.Points3D(measured.seen, radii=0.006, colors=SEEN), static=True)
    for name, points, colour in (("nominal", measured.nominal, BEFORE), ("calibrated", measured.calibrated, AFTER)):
        errors = scale * (measured.seen - points)
        entity = f"world/errors_times_{scale:g}/{name}"
        recording.log(entity, rr.Arrows3D(vectors=errors, origins=points, colors=colour, radii=0.004), static=True)
        recording.log(f"world/tool/{name}", rr.Points3D(points, radii=0.006, colors=colour), static=True)
        size = 1e3 * np.linalg.norm(measured.seen - points, axis=1)
        _series(recording, f"errors/{name}", index, size, f"{name} [mm]", colour)
    residual_mm = 1e3 * (measured.seen - measured.calibrated)
    for k, axis in enumerate("xyz"):
        _series(recording, f"axes/position/{axis}", index, residual_mm[:, k], f"{axis} in the arm's base [mm]")
    measured_rows = np.flatnonzero(np.isfinite(measured.turned).all(axis=1))
    if len(measured_rows):
        index_measured = _poses("pose", len(measured.q), start, measured_rows)
        turned = 1e3 * measured.turned[measured_rows]
        size = np.linalg.norm(turned, axis=1)
        _series(recording, "turns/calibrated", index_measured, size, "orientation, calibrated [mrad]", AFTER)
        for k, axis in enumerate("xyz"):
            _series(recording, f"axes/orientation/{axis}", index_measured, turned[:, k], f"about {axis} [mrad]")
    if measured.unseen.any():
        is_unseen = np.where(measured.unseen, 1.0, 0.0)
        _series(recording, "errors/unseen", index, is_unseen, "1: unseen, 0: fitted", SEEN)
    pose_columns = rr.Points3D.columns(
        positions=measured.seen, radii=np.full(len(measured.q), 0.015), colors=np.tile(SEEN, (len(measured.q), 1))
    )
    recording.send_columns("world/pose", indexes=index, columns=pose_columns)
    _arm(recording, scene, index, measured.q)
    return start + EACH * len(measured.q) + GAP


def _sizes(recording: RecordingStream, scene: Scene, sizes: ErrorSizes, start: float) -> float:
    """Log the sizes of errors row by row, with the arm at each; return the start time of the next part [s]."""
    entity = "errors" if sizes.kind == "position" else f"errors/{sizes.kind}"
    for name, size, colour in (("nominal", sizes.nominal, BEFORE), ("calibrated", sizes.calibrated, AFTER)):
        finite_rows = np.flatnonzero(np.isfinite(size))
        if len(finite_rows):
            index = _poses("row", len(sizes.q), start, finite_rows)
            _series(recording, f"{entity}/{name}", index, 1e3 * size[finite_rows], f"{name} [mm]", colour)
    index = _poses("row", len(sizes.q), start)
    if sizes.unseen.any():
        is_unseen = np.where(sizes.unseen, 1.0, 0.0)
        _series(recording, f"{entity}/unseen", index, is_unseen, "1: unseen, 0: fitted", SEEN)
    _arm(recording, scene, index, sizes.q)
    return start + EACH * len(sizes.q) + GAP


def _chosen(
    recording: RecordingStream, scene: Scene, chain: Chain | Drawn, name: str, q: np.ndarray, start: float
) -> float:
    """Log a pose plan as it grows: one more tool position each step, and the arm at the newest pose."""
    tips = strips(chain, q)[0][:, -1]
    counts = np.arange(1, len(q) + 1)
    grown = np.concatenate([tips[:k] for k in counts])
    columns = rr.Points3D.columns(positions=grown, radii=np.full(len(grown), 0.008)).partition(counts)
    index = _poses(f"chosen: {name}", len(q), start)
    recording.send_columns(f"world/chosen/{_part(name)}", indexes=index, columns=columns)
    _series(recording, f"chosen/{_part(name)}", index, counts.astype(float), f"{name}: poses", SEEN)
    _arm(recording, scene, index, q)
    return start + EACH * len(q) + GAP


def _played(recording: RecordingStream, scene: Scene, played: Played, start: float) -> float:
    """Log a motion with its limits from `start` on [s], and return the start time of the next part."""
    t = start + played.t - played.t[0]
    samples = thinned(played.t)
    index = [rr.TimeColumn("time", duration=t[samples])]
    names = scene.chain.joint_names if scene.chain is not None else [f"q{k + 1}" for k in range(played.q.shape[1])]
    ends = [rr.TimeColumn("time", duration=t[[0, -1]])]
    for j, name in enumerate(names):
        _series(recording, f"motion/position/{_part(name)}", index, played.q[samples, j], name)
        if played.v is not None:
            _series(recording, f"motion/velocity/{_part(name)}", index, played.v[samples, j], name)
        if scene.chain is None:
            continue
        joint = scene.chain.joints[j]
        for side, value in (("lower", joint.lower), ("upper", joint.upper)):
            if np.isfinite(value):
                _series(recording, f"limits/position/{_part(name)}/{side}", ends, [value] * 2, f"{name} {side}", LIMIT)
        if np.isfinite(joint.velocity) and played.v is not None:
            for sign, side in ((-1.0, "lower"), (1.0, "upper")):
                value = sign * joint.velocity
                _series(recording, f"limits/velocity/{_part(name)}/{side}", ends, [value] * 2, f"{name} {side}", LIMIT)
    _arm(recording, scene, index, played.q[samples])
    return float(t[-1]) + GAP


def _torques(recording: RecordingStream, scene: Scene, torques: Torques, start: float) -> float:
    """Log measured torques, predicted torques and residuals, with the arm on the same time axis."""
    t = start + torques.t - torques.t[0]
    index = [rr.TimeColumn("time", duration=t)]
    for j, (name, unit) in enumerate(zip(torques.rows, torques.units)):
        measured, predicted = torques.measured[:, j], torques.predicted[:, j]
        _series(recording, f"torques/{_part(name)}/measured", index, measured, f"measured [{unit}]", BEFORE)
        _series(recording, f"torques/{_part(name)}/predicted", index, predicted, f"predicted [{unit}]", AFTER)
        _series(recording, f"residuals/{_part(name)}", index, measured - predicted, f"{name} [{unit}]")
    if torques.q is not None:
        samples = thinned(torques.t)
        _arm(recording, scene, [rr.TimeColumn("time", duration=t[samples])], torques.q[samples])
    return float(t[-1]) + GAP


def _part(name: str) -> str:
    """Return a name, escaped as one part of a Rerun entity path."""
    return rr.escape_entity_path_part(name)


def _series(
    recording: RecordingStream,
    path: str,
    index: list[TimeColumn],
    values: Sequence[float] | np.ndarray,
    name: str,
    colour: Sequence[int] | None = None,
) -> None:
    """Log one line of a plot with its legend."""
    recording.log(path, rr.SeriesLines(names=name, **({} if colour is None else {"colors": colour})), static=True)
    recording.send_columns(path, indexes=index, columns=rr.Scalars.columns(scalars=np.asarray(values, dtype=float)))


def _arm(recording: RecordingStream, scene: Scene, index: list[TimeColumn], q: np.ndarray) -> None:
    """Log the arm's links as lines, and its links' frames where it has meshes."""
    if scene.chain is None or q.shape[1] != scene.chain.n:
        return
    lines = strips(scene.chain, q)
    thick = 0.006 if scene.meshes else 0.018 / len(lines)
    count = len(q) * len(lines)
    line_strips = rr.LineStrips3D.columns(
        strips=[line for at_once in zip(*lines) for line in at_once],
        radii=np.full(count, thick),
        colors=np.tile(ARM, (count, 1)),
    )
    recording.send_columns("world/robot/lines", indexes=index, columns=line_strips.partition([len(lines)] * len(q)))
    points = np.concatenate(lines, axis=1)
    count = points.shape[1]
    spheres = rr.Points3D.columns(
        positions=points.reshape(-1, 3),
        radii=np.full(count * len(q), 1.4 * thick),
        colors=np.tile(ARM, (count * len(q), 1)),
    )
    recording.send_columns("world/robot/joints", indexes=index, columns=spheres.partition([count] * len(q)))
    if scene.meshes and isinstance(scene.chain, Chain):
        frames = joint_frames(scene.chain, q)
        for link, frame in zip(scene.chain.links, frames):
            moves = rr.Transform3D.columns(translation=frame[:, :3, 3], quaternion=to_quaternion(frame))
            recording.send_columns(f"world/robot/links/{_part(link)}", indexes=index, columns=moves)


def _meshes(recording: RecordingStream, scene: Scene) -> None:
    """Log the meshes, each once, under the frame of its link."""
    for number, mesh in enumerate(scene.meshes):
        entity = f"world/robot/links/{_part(mesh.link)}/mesh_{number}"
        placed = rr.Transform3D(
            translation=mesh.placement[:3, 3], quaternion=to_quaternion(mesh.placement), scale=mesh.scale
        )
        recording.log(entity, placed, rr.Asset3D(path=mesh.file), static=True)


def _blueprint(scene: Scene) -> Any:
    """Return the initial layout of the recording: the arm at the left, what goes with it at the right."""
    import rerun.blueprint as rrb

    tabs: list[Any] = []
    silent = rrb.PlotLegend(visible=False)  # a line's name shows where the pointer is
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
        names: dict[str, None] = {}  # in order of appearance
        for torques in scene.torques:
            names.update(dict.fromkeys(torques.rows))
        plots = []
        for name in names:
            plot = rrb.TimeSeriesView(origin=f"torques/{_part(name)}", name=name, plot_legend=silent)
            plots.append(plot)
        grid = rrb.Grid(*plots, grid_columns=2)
        residuals = rrb.TimeSeriesView(origin="residuals", name="measured minus predicted")
        tabs.append(rrb.Vertical(grid, residuals, row_shares=[3, 1], name="torques"))
    picture = rrb.Spatial3DView(origin="world", name="robot, nominal orange, calibrated green")
    right = rrb.Tabs(*tabs, active_tab=int(bool(scene.measured and scene.chosen)))
    text = rrb.TextDocumentView(origin="about", name="what is shown")
    left = rrb.Vertical(picture, text, row_shares=[4, 1])
    timeline = "pose"
    if scene.chosen or scene.played or scene.torques:
        timeline = "time"
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[3, 2]),
        rrb.TimePanel(timeline=timeline, state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
    )
