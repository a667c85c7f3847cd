"""Choosing the poses to measure: a robot's observation Jacobian handed to the package `poses`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from calib.data.poses.fit_options import FitOptions
from calib.data.poses.plans import read_poses, write_poses
from calib.errors import UsageError
from calib.geometry.observability import observation, targets_of
from calib.procedure.kinematic_stage.inputs import joint_kinds, load_robot
from calib.procedure.kinematic_stage.pose_limits import read_limits
from calib.procedure.kinematic_stage.settings import DEFAULT_SELECTION, SelectionSettings
from calib.procedure.measuring.camera_view import ImageObservation, Predicted, image_observation, predict
from calib.robot.calibrated import CalibratedChain
from calib.robot.chain import Chain
from poses.indices import observability
from poses.select import SearchSettings, Selection, select_poses
from poses.space import is_feasible

Progress = Callable[[int, int, str], None]
EVERYWHERE = 600  # postures that accuracy is predicted at (our choice)
VIEWS = 600  # postures that see a camera's board, to choose from (our choice)


@dataclass(frozen=True, eq=False)
class Chosen:
    """A selection with what it was made for.

    Attributes:
        chain: the nominal arm.
        selection: see `poses.select`.
        parameters: how many the measurements can tell.
        existing: index of the poses measured before alone; None without them, or where they are too few.
        checked, unchecked: what the poses were held against, and what they could not be, in words.
        notes: what else a user should know.
    """

    chain: Chain
    selection: Selection
    parameters: int
    existing: float | None
    checked: tuple[str, ...]
    unchecked: tuple[str, ...]
    notes: tuple[str, ...]
    predicted: Predicted | None = None


def choose(
    robot: str | Path | CalibratedChain,
    m: int,
    settings: SelectionSettings = DEFAULT_SELECTION,
    *,
    constraints: Path | None = None,
    existing: Path | None = None,
    base: str | None = None,
    tip: str | None = None,
    map: Callable = map,
    progress: Progress | None = None,
) -> Chosen:
    """Choose m poses at which the robot's geometry shows best.

    Args:
        robot: see `calib.robot.load`.
        m: how many.
        settings: what is measured, index, method, seed.
        constraints: see `calib.procedure.kinematic_stage.pose_limits`.
        existing: CSV of poses measured before, which count.
        base, tip: links of a URDF.
        map: where parallel work runs (`calib.workers`).
        progress: called with (done, total, what).
    """
    if m < 1:
        raise UsageError(f"-m {m}: at least one pose has to be chosen")
    chain, source = load_robot(robot, existing, FitOptions(), base, tip)
    cell = targets_of(chain, settings.tools)
    limits = read_limits(constraints, cell, source, settings.without)
    view, joints = limits.camera, None
    if view is None:
        jacobian = observation(cell, settings.kind, settings.sigmas, settings.seed)
    else:
        jacobian = image_observation(view, limits.lower, limits.upper, settings.seed)
    space = limits.space(jacobian)
    if view is not None:
        if progress:
            progress(0, 1, "views of the board")
        wanted = min(settings.candidates, VIEWS)
        joints = view.draw(wanted, partial(is_feasible, space), limits.lower, limits.upper, settings.seed)
        if len(joints) < 2 * m:
            raise UsageError(
                f"the camera sees the board at {len(joints)} postures that keep everything else, {m} are to be chosen: "
                "look at [camera], carried and stands, tilt and range"
            )
    index, method = cast(Any, settings.index), cast(Any, settings.method)  # checked by `select_poses`
    before = value = None
    notes = list(limits.notes)
    if existing is not None:
        q = read_poses(existing, chain.joint_names, kinds=joint_kinds(chain), limits=(chain.lower, chain.upper))
        before = jacobian(q)
        value = observability(before, index) or None
        if not is_feasible(space, q).all():
            notes.append(f"{int((~is_feasible(space, q)).sum())} of the {len(q)} existing poses break the constraints")
    search = SearchSettings(
        index, method, settings.candidates, settings.seed, starts=settings.starts, evaluations=settings.evaluations,
        seconds=np.inf if settings.seconds is None else settings.seconds, climbs=settings.climbs,
    )  # fmt: skip
    found = select_poses(None, m, search, q=joints, space=space, existing=before, map=map, progress=progress)
    assert found.q is not None
    found = replace(found, q=fewest_turns(chain, found.q, limits.lower, limits.upper))
    predicted = None
    if isinstance(jacobian, ImageObservation) and found.q is not None:
        everywhere = np.random.default_rng(settings.seed).uniform(limits.lower, limits.upper, (EVERYWHERE, chain.n))
        predicted = predict(jacobian, found.q, everywhere)
        notes.append(predicted.words)
    checked = limits.checked, limits.unchecked
    return Chosen(chain, found, len(jacobian.free), value, *checked, tuple(notes), predicted)


def fewest_turns(chain: Chain, q: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the same poses (m, n) with every revolute joint at the turn nearest to the middle of its range."""
    middle = (lower + upper) / 2
    turns = np.where([joint.kind == "revolute" for joint in chain.joints], np.round((q - middle) / (2 * np.pi)), 0.0)
    moved = q - 2 * np.pi * turns
    return np.where((moved >= lower) & (moved <= upper), moved, q)


def write(chosen: Chosen, path: Path) -> Path:
    """Write the chosen poses under the joints' names [rad or m]."""
    assert chosen.selection.q is not None
    return write_poses(path, chosen.selection.q, chosen.chain.joint_names, kinds=joint_kinds(chosen.chain))


def kept(chosen: Chosen) -> list[str]:
    """Return lines on what the poses were held against, and on what they were not."""
    lines = [f"kept: {', '.join(chosen.checked)}"] if chosen.checked else []
    return lines + ([f"NOT checked: {', '.join(chosen.unchecked)}"] if chosen.unchecked else [])


def bound_words(found: Selection) -> str:
    """Return what the bound behind an efficiency covers, and how sure that is."""
    climbs, gap = found.ceiling.climbs, 100 * found.ceiling.gap
    if not climbs:
        return f"of the candidates{' and these poses' if found.indices is None else ''}, not of all feasible poses"
    return f"of all feasible poses, as far as {climbs} searches for better ones can tell; loose by at most {gap:.2g} %"


def record(chosen: Chosen) -> dict[str, Any]:
    """Return what the selection came to, numbers as numbers; `table` says it in words."""
    found = chosen.selection
    return {
        "index": found.index,
        "method": found.method,
        "parameters": chosen.parameters,
        "value": found.value,
        "start": float(found.history[0]),
        "random_baseline": found.random_baseline,
        "existing": chosen.existing,
        "efficiency": found.efficiency,
        "efficiency_covers": bound_words(found),
        "seconds": found.seconds,
        "checked": list(chosen.checked),
        "unchecked": list(chosen.unchecked),
        "notes": list(chosen.notes),
    }


def table(chosen: Chosen) -> list[tuple[str, str]]:
    """Return what the selection came to, as pairs of words and numbers."""
    found = chosen.selection
    rows = [
        ("index", f"{found.index}" + (" (its ranking does not depend on units)" if found.index == "O1" else "")),
        ("parameters that can be told", str(chosen.parameters)),
        ("best of 1000 random sets", f"{found.random_baseline:.6g}"),
    ]
    if chosen.existing is not None:
        rows.append(("existing poses alone", f"{chosen.existing:.6g}"))
    rows += [
        ("start of the search", f"{float(found.history[0]):.6g}"),
        ("chosen poses", f"{found.value:.6g}"),
        ("efficiency against the convex bound", f"{found.efficiency:.4f} (det^(1/p); {bound_words(found)})"),
        ("seconds", f"{found.seconds:.2f}"),
    ]
    return rows
