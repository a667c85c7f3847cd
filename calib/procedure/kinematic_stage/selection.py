"""Selection of the poses to measure: the package `poses` gets a robot's observation Jacobian."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from calib import files
from calib.config import Tables
from calib.data.poses.fit_options import FitOptions
from calib.data.poses.measurements import PoseMeasurements
from calib.data.poses.pose_lists import read_poses, write_poses
from calib.errors import UsageError, require
from calib.geometry.observability import Observation, observation, targets_of
from calib.poses.candidates import draw_candidates
from calib.poses.errors import NothingFeasible
from calib.poses.indices import observability
from calib.poses.select import SearchSettings, Selection, select_poses
from calib.poses.space import SearchSpace, is_feasible
from calib.procedure.kinematic_stage.inputs import load_robot
from calib.procedure.kinematic_stage.settings import DEFAULT_SELECTION, SelectionSettings
from calib.procedure.measuring import prediction as forecast
from calib.procedure.measuring.pose_limits import Limits, read_limits
from calib.procedure.measuring.prediction import Prediction, SelectionPrediction
from calib.procedure.measuring.run import Drivable, Exchange, Run, RunSettings, drivable
from calib.procedure.measuring.run import lines as ways
from calib.procedure.robot_kinds import joints_of
from calib.robot.calibrated import CalibratedChain
from calib.robot.chain import Chain, joint_kinds

Progress = Callable[[int, int, str], None]
VIEWS = 600  # postures that see a camera's board, to choose from (our choice)
FIGURES = ("predicted", "outlook")  # sigma of the tool over the workspace, and by the number of poses

TYPICAL = 300  # poses all over the workspace, seen or not, at which the tool's sigma is predicted; our choice


@dataclass(frozen=True, eq=False)
class PoseOutlook:
    """Predicted accuracy of a calibration with the chosen poses, before measuring.

    Attributes:
        poses: of the fit on the chosen poses.
        others: of other numbers of poses, chosen greedily.
        blind: index and prediction without line-of-sight constraints; None if there are none.
        comparable: index of poses chosen in the same way as `blind`, with line of sight.
    """

    poses: Prediction
    others: tuple[Prediction, ...]
    blind: tuple[float, Prediction] | None
    comparable: float


@dataclass(frozen=True, eq=False)
class Chosen:
    """Selected poses with their robot, constraints and predicted accuracy.

    Attributes:
        chain: the nominal arm.
        selection: see `calib.poses.select`.
        parameters: how many are identifiable from the measurements.
        existing: index of the existing poses alone; None without them, or if they are too few.
        checked, unchecked: constraints that were checked, and those that could not be, as text.
        notes: other remarks for the user.
        outlook: predicted accuracy with these poses and with others.
        by_images: whether the poses are those at which a camera sees its board.
        run, driven: the poses' order, in which `selection.q` is, and the ways between them; how they are driven.
    """

    chain: Chain
    selection: Selection
    parameters: int
    existing: float | None
    checked: tuple[str, ...]
    unchecked: tuple[str, ...]
    notes: tuple[str, ...]
    outlook: PoseOutlook
    run: Run
    driven: RunSettings
    by_images: bool

    @property
    def prediction(self) -> SelectionPrediction | None:
        """Prediction stored next to the poses; None if a parameter is not identifiable."""
        return self.outlook.poses if np.isfinite(self.outlook.poses.rms) else None

    @property
    def figures(self) -> tuple[str, ...]:
        """Names of the available figures; none if a parameter is not identifiable."""
        return () if self.prediction is None else FIGURES if self.outlook.others else FIGURES[:1]

    def kept(self) -> list[str]:
        """Return lines on the checked constraints, on the constraints not checked, and on the run."""
        lines = [f"kept: {', '.join(self.checked)}"] if self.checked else []
        lines += [f"NOT checked: {', '.join(self.unchecked)}"] if self.unchecked else []
        return [*lines, *ways(self.run, self.driven)]


def choose(
    robot: str | Path | CalibratedChain,
    m: int,
    settings: SelectionSettings = DEFAULT_SELECTION,
    *,
    constraints: Tables | None = None,
    existing: Path | PoseMeasurements | np.ndarray | None = None,
    base: str | None = None,
    tip: str | None = None,
    map: Callable = map,
    progress: Progress | None = None,
) -> Chosen:
    """Return the m poses that determine the robot's geometry best.

    Args:
        robot: see `calib.robot.library`.
        m: how many.
        settings: what is measured, index, method, seed.
        constraints: see `calib.procedure.measuring.constraints_file`; a file, or its tables.
        existing: poses measured before, which count: a CSV, or in memory.
        base, tip: links of a URDF.
        map: where parallel work runs (`calib.workers`).
        progress: called with (done, total, what).
    """
    require(m >= 1, f"-m {m}: give a number of poses, 1 or more", UsageError)
    chain, source = load_robot(robot, existing if isinstance(existing, Path) else None, FitOptions(), base, tip)
    cell = targets_of(chain, settings.tools)
    limits = read_limits(constraints, cell, source, settings.without)
    view, joints = limits.camera, None
    if view is None:
        jacobian = observation(cell, settings.kind, settings.sigmas, settings.seed)
    else:
        jacobian = view.observation(limits.lower, limits.upper, settings.seed)
    space = limits.space(jacobian)
    if view is not None:
        if progress:
            progress(0, 1, "views of the board")
        number = min(settings.candidates, VIEWS)
        joints = view.draw(number, partial(is_feasible, space), limits.lower, limits.upper, settings.seed)
        if len(joints) < 2 * m:
            raise UsageError(
                f"{len(joints)} feasible postures see the board, but {2 * m} are needed to choose {m}: "
                "check carried, stands, tilt and range in [camera]"
            )
    index, method = cast(Any, settings.index), cast(Any, settings.method)  # checked by `select_poses`
    before = value = None
    notes = list(limits.notes)
    if existing is not None:
        q = read_poses(existing, joints_of(chain))
        before = jacobian(q)
        value = observability(before, index) or None
        if not is_feasible(space, q).all():
            notes.append(f"{int((~is_feasible(space, q)).sum())} of the {len(q)} existing poses break the constraints")
    search = SearchSettings(
        index,
        method,
        settings.candidates,
        settings.seed,
        starts=settings.starts,
        evaluations=settings.evaluations,
        seconds=np.inf if settings.seconds is None else settings.seconds,
        climbs=settings.climbs,
    )
    candidates = _drawn(space, limits, settings) if joints is None else joints
    found = select_poses(None, m, search, q=candidates, space=space, existing=before, map=map, progress=progress)
    comparable = float(found.history[0]) if method == "polish" else found.value
    notes += [] if view is None else [view.assumed]
    pool = Exchange(space.jacobian, candidates, before, index)
    driven = drivable(
        chain, found.joints, pool, limits, settings.run, settings.seed, lambda words: progress and progress(0, 1, words)
    )
    found, run = _driven(found, driven), driven.run
    notes += [driven.words] if driven.replaced else []
    outlook = _outlook(jacobian, limits, search, driven.q, pool, comparable)
    return Chosen(
        chain,
        found,
        len(jacobian.free),
        value,
        limits.checked,
        limits.unchecked,
        tuple(notes),
        outlook,
        run,
        settings.run,
        view is not None,
    )


def _driven(found: Selection, driven: Drivable) -> Selection:
    """Return the selection in driving order, with index and efficiency updated for replaced poses."""
    indices, value = found.indices, driven.value[1] if driven.replaced else found.value
    if indices is not None:
        indices = indices.copy()
        indices[list(driven.replaced)] = list(driven.replaced.values())
        indices = indices[driven.run.order]
    history = np.append(found.history, value) if driven.replaced else found.history
    return replace(
        found,
        q=driven.q[driven.run.order],
        indices=indices,
        value=value,
        history=history,
        efficiency=found.efficiency * float(np.exp(driven.gain)),
    )


def _drawn(space: SearchSpace, limits: Limits, settings: SelectionSettings) -> np.ndarray:
    """Return the candidate poses; an error names the constraints if too few poses are feasible."""
    try:
        return draw_candidates(
            space.lower, space.upper, settings.candidates, partial(is_feasible, space), seed=settings.seed
        )
    except NothingFeasible as error:
        q = np.random.default_rng(settings.seed).uniform(limits.lower, limits.upper, (2000, len(limits.lower)))
        shares = [(one.name, (np.asarray(one.function(q)) <= 0.0).all(1).mean()) for one in space.constraints]
        named = ", ".join(f"{name} {100 * share:.2g} %" for name, share in sorted(shares, key=lambda each: each[1]))
        hint = " (does the target face the arm? check facing in [target])" if limits.sight is not None else ""
        raise UsageError(f"{error}; share of random postures that keep each constraint: {named}{hint}") from error


def _outlook(
    seen: Observation, limits: Limits, search: SearchSettings, q: np.ndarray, pool: Exchange, comparable: float
) -> PoseOutlook:
    """Return the predicted accuracy with chosen poses q (m, n), with other pose counts, and without sight limits."""
    free, before = limits.space(seen, sight=False), pool.before
    stream = np.random.default_rng([search.seed, 2])
    typical = draw_candidates(free.lower, free.upper, TYPICAL, partial(is_feasible, free), seed=stream)
    past = [] if before is None else [before]

    def known(chosen: np.ndarray) -> Prediction:
        return forecast.predicted(seen, np.concatenate([free.jacobian(chosen), *past]), typical, len(q))

    blind = None
    if limits.sight is not None:
        other = select_poses(None, len(q), replace(search, method="detmax", climbs=0), space=free, existing=before)
        blind = other.value, known(other.joints)
    others = forecast.by_count(seen, pool.jacobian(pool.candidates), typical, before)
    return PoseOutlook(known(q), others, blind, comparable)


def beside_poses(out: Path, plots: bool, chosen: Chosen | None = None) -> dict[str, Path]:
    """Return the files written next to a selection's CSV: the prediction, and the figures by name."""
    figures = () if not plots else FIGURES if chosen is None else chosen.figures
    predicted = {} if chosen is not None and chosen.prediction is None else {"prediction": forecast.beside(out)}
    return predicted | {name: out.parent / f"{out.stem}_{name}.png" for name in figures}


def targets(out: Path, plots: bool) -> files.Results:
    """Return the paths of all files that a selection may write."""
    return [(out, (".csv",)), *((path, (path.suffix,)) for path in beside_poses(out, plots).values())]


def write(chosen: Chosen, path: Path) -> Path:
    """Write the chosen poses to a CSV with the joints' names [rad or m], and their predicted accuracy next to it."""
    if chosen.prediction is not None:
        forecast.write(chosen.prediction, path)
    else:
        forecast.beside(path).unlink(missing_ok=True)  # an earlier selection's
    return write_poses(path, chosen.selection.joints, chosen.chain.joint_names, joint_kinds(chosen.chain))


def bound_words(found: Selection) -> str:
    """Return a text on the poses for which the bound of an efficiency holds, and on the bound's accuracy."""
    climbs, gap = found.ceiling.climbs, 100 * found.ceiling.gap
    if not climbs:
        return f"of the candidates{' and these poses' if found.indices is None else ''}, not of all feasible poses"
    return f"of all feasible poses found by {climbs} searches; the bound is at most {gap:.2g} % too high"


def record(chosen: Chosen) -> dict[str, Any]:
    """Return the results of the selection as numbers; `table` returns them as text."""
    found, rms = chosen.selection, chosen.outlook.poses.rms
    search = ("index", "method", "value", "random_baseline", "efficiency", "seconds")
    return {
        **{name: getattr(found, name) for name in search},
        **{name: getattr(chosen, name) for name in ("parameters", "existing")},
        **{name: list(getattr(chosen, name)) for name in ("checked", "unchecked", "notes")},
        "start": float(found.history[0]),
        "efficiency_covers": bound_words(found),
        "tool_sigma": rms if np.isfinite(rms) else None,
        "run_seconds": chosen.run.seconds,
    }


def table(chosen: Chosen) -> list[tuple[str, str]]:
    """Return the results of the selection as pairs of label and value."""
    found = chosen.selection
    known = [] if chosen.existing is None else [("existing poses alone", f"{chosen.existing:.6g}")]
    return [
        ("index", f"{found.index}" + (" (ranks pose sets independently of units)" if found.index == "O1" else "")),
        ("identifiable parameters", str(chosen.parameters)),
        ("best of 1000 random sets", f"{found.random_baseline:.6g}"),
        *known,
        ("start of the search", f"{float(found.history[0]):.6g}"),
        ("chosen poses", f"{found.value:.6g}"),
        ("efficiency against the convex bound", f"{found.efficiency:.4f} (det^(1/p); {bound_words(found)})"),
        ("seconds", f"{found.seconds:.2f}"),
        *predicted_rows(chosen),
    ]


def predicted_rows(chosen: Chosen) -> list[tuple[str, str]]:
    """Return the table rows of the predicted accuracy, with the accuracy lost to line-of-sight constraints."""
    rows = forecast.table(chosen.outlook.poses, chosen.outlook.others)
    if chosen.outlook.blind is None:
        return rows
    (index, blind), one = chosen.outlook.blind, chosen.outlook.poses
    words = (
        f"index {chosen.outlook.comparable:.5g} instead of {index:.5g} without it, "
        f"σ of the tool {1e3 * one.rms:.3g} instead of {1e3 * blind.rms:.3g} mm"
    )
    return [*rows, ("cost of line of sight", words)]
