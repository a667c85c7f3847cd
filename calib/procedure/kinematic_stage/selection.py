"""Selection of the poses to measure, by the optimisation in the package `poses`.

This module supplies a robot's observation Jacobian and limits to the optimisation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from calib import files
from calib.config import Tables
from calib.config_types import Plots
from calib.data.poses.fit_options import FitOptions
from calib.data.poses.measurements import PoseMeasurements
from calib.data.poses.pose_lists import read_poses, write_poses
from calib.errors import UsageError, require
from calib.geometry.observability import Observation, observation, targets_of
from calib.poses.candidates import draw_candidates
from calib.poses.indices import observability
from calib.poses.select import SearchSettings, Selection, select_poses
from calib.poses.space import SearchSpace, is_feasible
from calib.procedure.kinematic_stage.inputs import load_robot
from calib.procedure.kinematic_stage.loads import (
    LoadedCandidates,
    LoadOutlook,
    load_outlook,
    loaded_candidates,
    loaded_run,
    without_masses,
)
from calib.procedure.kinematic_stage.possible_poses import METHODS_BY_CANDIDATES, Candidates, Progress, possible_poses
from calib.procedure.kinematic_stage.settings import DEFAULT_SELECTION, SelectionSettings
from calib.procedure.measuring import prediction as forecast
from calib.procedure.measuring.measuring_run import Drivable, Exchange, MeasuringRun, RunSettings, drivable
from calib.procedure.measuring.measuring_run import lines as run_lines
from calib.procedure.measuring.pose_limits import Limits, read_limits
from calib.procedure.measuring.prediction import Prediction, SelectionPrediction
from calib.procedure.robot_kinds import joints_of
from calib.robot.calibrated import CalibratedChain
from calib.robot.chain import Chain, joint_kinds

# sigma of the tool over the workspace, and by the number of poses
FIGURES = ("predicted", "outlook")
# end of the name of the page with them, after the stem of the CSV
FIGURES_PAGE = "_figures.html"
# poses all over the workspace, seen or not, at which the tool's sigma is predicted (our choice)
TYPICAL = 300


@dataclass(frozen=True, eq=False)
class PoseOutlook:
    """Accuracy of a calibration with the selected poses, predicted before the measurement.

    Attributes:
        poses: prediction for a fit to the selected poses.
        others: predictions for other numbers of poses, selected greedily.
        blind: index and prediction without line-of-sight constraints; None if there are no such constraints.
        comparable: index of poses selected with line-of-sight constraints, by the same method as `blind`.
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
        selection: the selected poses with index and efficiency (`calib.poses.select.Selection`).
        parameters: number of parameters that are identifiable from measurements at any poses.
        existing: index of the existing poses alone; None without existing poses, or if they are too few.
        checked, unchecked: constraints that were checked, and constraints that could not be checked, as text.
        notes: other remarks for the user.
        outlook: predicted accuracy with the selected poses and with other numbers of poses.
        run: order of the poses, which is that of `selection.q`, and the paths between them.
        driven: speed and dwell time of the run.
        by_images: whether a camera measures by images of a board.
        loads: loads of the poses, and what they tell of compliance; None without loads to choose from.
    """

    chain: Chain
    selection: Selection
    parameters: int
    existing: float | None
    checked: tuple[str, ...]
    unchecked: tuple[str, ...]
    notes: tuple[str, ...]
    outlook: PoseOutlook
    run: MeasuringRun
    driven: RunSettings
    by_images: bool
    loads: LoadOutlook | None = None

    @property
    def prediction(self) -> SelectionPrediction | None:
        """Prediction that is stored next to the poses; None if a parameter is not identifiable."""
        if not np.isfinite(self.outlook.poses.rms):
            return None
        return self.outlook.poses

    @property
    def figure_names(self) -> tuple[str, ...]:
        """Names of the figures that can be drawn; empty if a parameter is not identifiable."""
        if self.prediction is None:
            return ()
        if self.outlook.others:
            return FIGURES
        return FIGURES[:1]

    def kept(self) -> list[str]:
        """Return lines of text on the checked constraints, the unchecked constraints, and the run."""
        lines = []
        if self.loads is not None:
            lines.append(self.loads.line())
        if self.checked:
            lines.append(f"respected: {', '.join(self.checked)}")
        if self.unchecked:
            lines.append(f"NOT checked: {', '.join(self.unchecked)}")
        return lines + run_lines(self.run, self.driven)


def choose(
    robot: str | Path | CalibratedChain,
    m: int,
    settings: SelectionSettings = DEFAULT_SELECTION,
    *,
    constraints: Tables | None = None,
    existing: Path | PoseMeasurements | np.ndarray | None = None,
    base: str | None = None,
    tip: str | None = None,
    candidates: Candidates | None = None,
    map: Callable = map,
    progress: Progress | None = None,
) -> Chosen:
    """Return the m poses that determine the robot's geometry best.

    Args:
        robot: name of a library robot, file (URDF, or MDH table in TOML), folder of a fit, or a robot in memory.
        m: number of poses.
        settings: quantity to measure, index, method, seed.
        constraints: constraints file (`calib formats constraints`), or its content as tables; None: defaults.
        existing: poses measured earlier, which the selection complements: a CSV, or in memory; None: none.
        base, tip: first and last link of the arm in a URDF; None: its root, and its flange.
        candidates: poses to choose from, a CSV, joint values (N, n) or a function of a count; None: drawn at random.
        map: function that runs parallel work (`calib.workers`).
        progress: called with (done, total, text); None: silent.

    Raises:
        UsageError: for wrong settings or constraints, and if too few poses are feasible.
    """
    require(m >= 1, f"-m {m}: give a number of poses, 1 or more", UsageError)
    existing_file = existing if isinstance(existing, Path) else None
    chain, source = load_robot(robot, existing_file, FitOptions(), base, tip)
    cell = targets_of(chain, settings.tools)
    limits = read_limits(constraints, cell, source, settings.without)
    view = limits.camera
    if view is None:
        jacobian = observation(cell, settings.kind, settings.sigmas, settings.seed, settings.reference)
    else:
        jacobian = view.observation(limits.lower, limits.upper, settings.seed)
    space = limits.space(jacobian)
    possible, numbers, remarks = possible_poses(candidates, chain, space, limits, settings, m, progress)
    earlier = None
    if existing is not None:
        earlier = _earlier_poses(read_poses(existing, joints_of(chain)), space, settings)
    task = _Task(chain, m, jacobian, limits, space, possible, numbers is None, earlier, settings)
    if settings.loads:
        result = _selected_with_loads(task, map, progress)
    else:
        result = _selected(task, map, progress)

    selection = result.selection
    if numbers is not None and selection.indices is not None:
        selection = replace(selection, indices=numbers[selection.indices])
    notes = [*limits.notes, *remarks]
    if earlier is not None:
        notes += earlier.notes
    if view is not None:
        notes.append(view.assumed)
    return Chosen(
        chain=chain,
        selection=selection,
        parameters=len(jacobian.free),
        existing=earlier.value if earlier is not None else None,
        checked=limits.checked,
        unchecked=limits.unchecked,
        notes=(*notes, *result.notes),
        outlook=result.outlook,
        run=result.run,
        driven=settings.run,
        by_images=view is not None,
        loads=result.loads,
    )


@dataclass(frozen=True, eq=False)
class _EarlierPoses:
    """Poses that were measured earlier.

    Attributes:
        q: (k, n) joint values [rad or m].
        jacobian: their observation Jacobians.
        value: their observability index; None if it is 0.
        notes: remarks for the user.
    """

    q: np.ndarray
    jacobian: np.ndarray
    value: float | None
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Task:
    """What is chosen from, and how.

    Attributes:
        chain: the arm.
        m: number of poses to choose.
        jacobian: observation Jacobian by the geometry.
        limits: limits of poses.
        space: search space with all constraints.
        possible: (N, n) poses to choose from [rad or m].
        drawn: whether these were drawn at random.
        earlier: poses measured earlier; None without such poses.
        settings: quantity to measure, index, method, seed.
    """

    chain: Chain
    m: int
    jacobian: Observation
    limits: Limits
    space: SearchSpace
    possible: np.ndarray
    drawn: bool
    earlier: _EarlierPoses | None
    settings: SelectionSettings


@dataclass(frozen=True, eq=False)
class _SelectedRun:
    """Chosen poses in the order of a run through them.

    Attributes:
        selection: the poses; their indices count the poses to choose from.
        run: the run.
        outlook: predicted accuracy.
        loads: the poses' loads; None without loads to choose from.
        notes: remarks for the user.
    """

    selection: Selection
    run: MeasuringRun
    outlook: PoseOutlook
    loads: LoadOutlook | None
    notes: tuple[str, ...]


def _earlier_poses(q: np.ndarray, space: SearchSpace, settings: SelectionSettings) -> _EarlierPoses:
    """Return the poses q (k, n) [rad or m] that were measured earlier, with their index."""
    jacobian = space.jacobian(q)
    # `select_poses` checks the name of the index
    value = observability(jacobian, cast(Any, settings.index)) or None
    infeasible = int((~is_feasible(space, q)).sum())
    notes: tuple[str, ...] = ()
    if infeasible:
        notes = (f"{infeasible} of the {len(q)} existing poses break the constraints",)
    return _EarlierPoses(q, jacobian, value, notes)


def _selected(task: _Task, map: Callable, progress: Progress | None) -> _SelectedRun:
    """Return the poses that determine the geometry best, with a run through them.

    Args:
        task: what is chosen from, and how.
        map: function that runs parallel work.
        progress: called with (done, total, text); None: silent.
    """
    settings, limits = task.settings, task.limits
    search = _search_settings(settings)
    existing = None if task.earlier is None else task.earlier.jacobian
    selection = select_poses(
        None, task.m, search, q=task.possible, space=task.space, existing=existing, map=map, progress=progress
    )
    # the selection without sight limits is not polished: the start of a polished one compares with it
    comparable = selection.value
    if settings.method == "polish":
        comparable = float(selection.history[0])
    exchange = Exchange(task.space.jacobian, task.possible, existing, cast(Any, settings.index))
    stages = _stages(progress)
    driven = drivable(task.chain, selection.joints, exchange, limits, settings.run, settings.seed, stages)
    outlook = _outlook(task.jacobian, limits, search, driven.q, exchange, comparable, task.drawn)
    return _SelectedRun(_in_driving_order(selection, driven), driven.run, outlook, None, _replacements(driven))


def _selected_with_loads(task: _Task, map: Callable, progress: Progress | None) -> _SelectedRun:
    """Return the pairs of pose and load that determine geometry and compliance best, with a run through them.

    Args:
        task: what is chosen from, and how.
        map: function that runs parallel work.
        progress: called with (done, total, text); None: silent.
    """
    settings, limits = task.settings, task.limits
    _check_loads(settings, limits)
    search = _search_settings(settings)
    unloaded_q = None if task.earlier is None else task.earlier.q
    pairs = loaded_candidates(task.jacobian, limits, task.possible, settings.loads, unloaded_q)
    selection = select_poses(pairs.jacobians, task.m, search, existing=pairs.before, map=map, progress=progress)
    driven = loaded_run(task.chain, pairs, selection, limits, settings.run, settings.seed, _stages(progress))
    selection = _in_driving_order(selection, driven)
    outlook, loads = _loaded_outlook(task.jacobian, limits, search, selection, pairs)
    assert selection.indices is not None
    selection = replace(selection, indices=pairs.pose[selection.indices])
    remarks = _remarks_on_loads(task.chain, loads, unloaded_q is not None)
    return _SelectedRun(selection, driven.run, outlook, loads, (*_replacements(driven), *remarks))


def _stages(progress: Progress | None) -> Callable[[str], None]:
    """Return a function that shows the text of a stage by a progress function; silent for None."""

    def show(stage: str) -> None:
        if progress:
            progress(0, 1, stage)

    return show


def _replacements(driven: Drivable) -> tuple[str, ...]:
    """Return the note on the poses that were replaced for a run; empty if none was."""
    if not driven.replaced:
        return ()
    return (driven.words,)


def _check_loads(settings: SelectionSettings, limits: Limits) -> None:
    """Raise a UsageError where loads cannot be chosen together with poses."""
    require(settings.method in METHODS_BY_CANDIDATES, "--loads: give --method detmax", UsageError)
    is_by_points = limits.camera is None
    require(is_by_points, "--loads: with a [camera] loads are not chosen; leave one of them out", UsageError)


def _remarks_on_loads(chain: Chain, loads: LoadOutlook, has_existing: bool) -> list[str]:
    """Return notes on poses that were chosen together with loads.

    Args:
        chain: the arm.
        loads: what was chosen.
        has_existing: whether poses were measured earlier.
    """
    notes = []
    if without_masses(chain):
        notes.append(without_masses(chain))
    if has_existing:
        notes.append("the existing poses count as measured without load")
    if loads.excluded:
        notes.append(f"{loads.excluded} pairs of pose and load exceed a joint's largest torque and were left out")
    return notes


def _search_settings(settings: SelectionSettings) -> SearchSettings:
    """Return the settings of the search; index and method are checked later, by `select_poses`."""
    seconds = np.inf
    if settings.seconds is not None:
        seconds = settings.seconds
    return SearchSettings(
        cast(Any, settings.index),
        cast(Any, settings.method),
        settings.candidates,
        settings.seed,
        starts=settings.starts,
        evaluations=settings.evaluations,
        seconds=seconds,
        climbs=settings.climbs,
    )


def _in_driving_order(selection: Selection, driven: Drivable) -> Selection:
    """Return the selection in the order of the run, with index and efficiency updated for replaced poses.

    Args:
        selection: the selected poses.
        driven: the run through the poses, with replacements of unreachable poses.
    """
    value = selection.value
    history = selection.history
    if driven.replaced:
        value = driven.value[1]
        history = np.append(history, value)
    indices = selection.indices
    if indices is not None:
        indices = indices.copy()
        indices[list(driven.replaced)] = list(driven.replaced.values())
        indices = indices[driven.run.order]
    return replace(
        selection,
        q=driven.q[driven.run.order],
        indices=indices,
        value=value,
        history=history,
        efficiency=selection.efficiency * float(np.exp(driven.gain)),
    )


def _outlook(
    jacobian: Observation,
    limits: Limits,
    search: SearchSettings,
    q: np.ndarray,
    exchange: Exchange,
    comparable: float,
    drawn: bool,
) -> PoseOutlook:
    """Return the predicted accuracy with the selected poses and in other cases.

    The other cases are other numbers of poses, and no line-of-sight constraints.

    Args:
        jacobian: observation Jacobian.
        limits: limits of poses.
        search: settings of the search.
        q: (m, n) selected poses [rad or m].
        exchange: candidate poses, and Jacobians of poses measured earlier.
        comparable: observability index of poses selected with line-of-sight constraints.
        drawn: whether the candidates were drawn at random, so that they can be drawn without line of sight, too.
    """
    space = limits.space(jacobian, sight=False)
    existing = exchange.before
    stream = np.random.default_rng([search.seed, 2])
    typical = draw_candidates(space.lower, space.upper, TYPICAL, partial(is_feasible, space), seed=stream)

    def predicted(chosen: np.ndarray) -> Prediction:
        jacobians = np.asarray(space.jacobian(chosen))
        if existing is not None:
            jacobians = np.concatenate([jacobians, existing])
        return forecast.predicted(jacobian, jacobians, typical, len(q))

    blind = None
    if limits.sight is not None and drawn:
        search = replace(search, method="detmax", climbs=0)
        selection = select_poses(None, len(q), search, space=space, existing=existing)
        blind = selection.value, predicted(selection.joints)
    others = forecast.by_count(jacobian, exchange.jacobian(exchange.candidates), typical, existing)
    return PoseOutlook(predicted(q), others, blind, comparable)


def _loaded_outlook(
    jacobian: Observation, limits: Limits, search: SearchSettings, selection: Selection, pairs: LoadedCandidates
) -> tuple[PoseOutlook, LoadOutlook]:
    """Return the predicted accuracy with the selected poses and loads, of the tool and of compliance.

    Args:
        jacobian: observation Jacobian by the geometry.
        limits: limits of poses.
        search: settings of the search.
        selection: the chosen pairs, in the order of the run.
        pairs: the pairs of pose and load to choose from.
    """
    assert selection.indices is not None
    space = limits.space(jacobian, sight=False)
    stream = np.random.default_rng([search.seed, 2])
    typical = draw_candidates(space.lower, space.upper, TYPICAL, partial(is_feasible, space), seed=stream)
    masses = pairs.masses[pairs.load[selection.indices]]
    jacobians = pairs.jacobians_of(selection.joints, masses)
    unloaded = pairs.unloaded(jacobian, limits, len(masses), search)
    loads = load_outlook(pairs, jacobians, masses, typical, unloaded)
    others = forecast.by_count(pairs.observations[-1], pairs.jacobians, typical, pairs.before)
    return PoseOutlook(loads.loaded, others, None, selection.value), loads


def beside_poses(out: Path, plots: Plots, chosen: Chosen | None = None) -> dict[str, Path]:
    """Return the paths of the files next to a selection's CSV: the prediction, and the figures by name.

    Args:
        out: path of the CSV.
        plots: figures: none, on a page, or as files of a format, too.
        chosen: the selection, which determines the files; None: all files that a selection may write.
    """
    paths = {}
    if chosen is None or chosen.prediction is not None:
        paths["prediction"] = forecast.beside(out)
    figures = FIGURES if chosen is None else chosen.figure_names
    if plots and figures:
        paths["figures"] = out.parent / f"{out.stem}{FIGURES_PAGE}"
    if isinstance(plots, str):
        for name in figures:
            paths[name] = out.parent / f"{out.stem}_{name}.{plots}"
    return paths


def targets(out: Path, plots: Plots) -> files.Results:
    """Return the paths of all files that a selection may write, with their allowed suffixes.

    Args:
        out: path of the selection's CSV.
        plots: whether figures are written.
    """
    beside = beside_poses(out, plots).values()
    return [(out, (".csv",)), *((path, (path.suffix,)) for path in beside)]


def write(chosen: Chosen, path: Path) -> Path:
    """Write the selected poses to a CSV with the joints' names [rad or m], and the predicted accuracy next to it.

    Args:
        chosen: the selection.
        path: path of the CSV.

    Returns:
        Path of the CSV.
    """
    if chosen.prediction is not None:
        forecast.write(chosen.prediction, path)
    else:
        # an earlier selection's
        forecast.beside(path).unlink(missing_ok=True)
    masses = None if chosen.loads is None else chosen.loads.masses
    return write_poses(path, chosen.selection.joints, chosen.chain.joint_names, joint_kinds(chosen.chain), masses)


def bound_words(selection: Selection) -> str:
    """Return a text on the bound of a selection's efficiency.

    It names the set of poses to which the bound applies, and the bound's accuracy.

    Args:
        selection: the selected poses with their efficiency.
    """
    ceiling = selection.ceiling
    if ceiling.climbs:
        percent = 100 * ceiling.gap
        return (
            f"of all feasible poses found by {ceiling.climbs} searches; the bound is at most {percent:.2g} % too high"
        )
    if selection.indices is None:
        return "of the candidates and these poses, not of all feasible poses"
    return "of the candidates, not of all feasible poses"


def record(chosen: Chosen) -> dict[str, object]:
    """Return the results of a selection as numbers by name; `table` returns them as text.

    Args:
        chosen: the selection.
    """
    selection = chosen.selection
    rms = chosen.outlook.poses.rms
    return {
        "index": selection.index,
        "method": selection.method,
        "value": selection.value,
        "random_baseline": selection.random_baseline,
        "efficiency": selection.efficiency,
        "seconds": selection.seconds,
        "parameters": chosen.parameters,
        "existing": chosen.existing,
        "checked": list(chosen.checked),
        "unchecked": list(chosen.unchecked),
        "notes": list(chosen.notes),
        "start": float(selection.history[0]),
        "efficiency_covers": bound_words(selection),
        "tool_sigma": rms if np.isfinite(rms) else None,
        "run_seconds": chosen.run.seconds,
        "loads": None if chosen.loads is None else chosen.loads.record(),
    }


def table(chosen: Chosen) -> list[tuple[str, str]]:
    """Return the results of a selection as pairs of label and text.

    Args:
        chosen: the selection.
    """
    selection = chosen.selection
    index = f"{selection.index}"
    if selection.index == "O1":
        index += " (ranks pose sets independently of units)"
    rows = [
        ("index", index),
        ("identifiable parameters", str(chosen.parameters)),
        ("best of 1000 random sets", f"{selection.random_baseline:.6g}"),
    ]
    if chosen.existing is not None:
        rows.append(("existing poses alone", f"{chosen.existing:.6g}"))
    efficiency = f"{selection.efficiency:.4f} (det^(1/p); {bound_words(selection)})"
    rows += [
        ("start of the search", f"{float(selection.history[0]):.6g}"),
        ("chosen poses", f"{selection.value:.6g}"),
        ("efficiency against the convex bound", efficiency),
        ("seconds", f"{selection.seconds:.2f}"),
    ]
    return rows + predicted_rows(chosen)


def predicted_rows(chosen: Chosen) -> list[tuple[str, str]]:
    """Return table rows (label, text) on the predicted accuracy, and on the accuracy lost by lines of sight.

    Args:
        chosen: the selection.
    """
    outlook = chosen.outlook
    rows = forecast.table(outlook.poses, outlook.others)
    if chosen.loads is not None:
        rows += chosen.loads.rows()
    if outlook.blind is None:
        return rows
    blind_index, blind = outlook.blind
    cost = (
        f"index {outlook.comparable:.5g} instead of {blind_index:.5g} without it, "
        f"σ of the tool {1e3 * outlook.poses.rms:.3g} instead of {1e3 * blind.rms:.3g} mm"
    )
    return [*rows, ("cost of line of sight", cost)]
