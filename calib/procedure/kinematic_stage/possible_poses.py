"""Poses to choose from: the user's candidates, random feasible ones, or postures in which a camera sees the board."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib.data.poses.pose_lists import read_poses
from calib.errors import CalibError, UsageError, refused_as, require
from calib.poses.candidates import draw_candidates
from calib.poses.errors import NothingFeasible
from calib.poses.space import SearchSpace, is_feasible
from calib.procedure.kinematic_stage.settings import SelectionSettings
from calib.procedure.measuring.pose_limits import Limits
from calib.procedure.robot_kinds import joints_of
from calib.robot.chain import Chain

if TYPE_CHECKING:
    from calib.procedure.measuring.camera_view import CameraView

Progress = Callable[[int, int, str], None]
Candidates = str | Path | np.ndarray | Sequence[Sequence[float]] | Callable[[int], np.ndarray]
"""Poses to choose from: a CSV, joint values (N, n) [rad or m], or a function of a count that returns joint values."""
METHODS_BY_CANDIDATES = ("detmax",)
"""Methods whose poses are among the candidates."""
# postures that see a camera's board, to choose from (our choice)
VIEWS = 600
# random postures by which the share is estimated that keeps each constraint
RANDOM_POSTURES = 2000


def possible_poses(
    candidates: Candidates | None,
    chain: Chain,
    space: SearchSpace,
    limits: Limits,
    settings: SelectionSettings,
    m: int,
    progress: Progress | None,
) -> tuple[np.ndarray, np.ndarray | None, list[str]]:
    """Return the poses (N, n) [rad or m] to choose from, with their numbers among the candidates, and notes.

    The numbers are None where poses are drawn.

    Args:
        candidates, settings, m, progress: arguments of `calib.procedure.kinematic_stage.selection.choose`.
        chain: the arm.
        space: the space of poses.
        limits: limits of poses, with the camera's.
    """
    view = limits.camera
    if candidates is not None:
        require(view is None, "candidates: with a [camera], views of the board are drawn; leave them out", UsageError)
        offered, numbers = _feasible_candidates(candidates, space, chain, settings, m)
        infeasible = len(offered) - len(numbers)
        notes = [f"{infeasible} of the {len(offered)} candidates break the constraints"] * bool(infeasible)
        return offered[numbers], numbers, notes
    if view is None:
        return _draw_feasible(space, limits, settings), None, []
    if progress:
        progress(0, 1, "views of the board")
    return _draw_views(view, space, limits, settings, m), None, []


def _feasible_candidates(
    candidates: Candidates, space: SearchSpace, chain: Chain, settings: SelectionSettings, m: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the user's candidates (N, n) [rad or m], and the numbers, from 0, of those that keep the constraints.

    Args:
        candidates: a CSV, joint values, or a function of a count.
        space: search space with all constraints.
        chain: the arm.
        settings: settings of the selection.
        m: number of poses to select.

    Raises:
        UsageError: a method whose poses are not candidates; wrong joint values; too few feasible candidates.
    """
    if settings.method not in METHODS_BY_CANDIDATES:
        raise UsageError(
            f"candidates: the method '{settings.method}' moves poses away from the candidates: give method = "
            f"{' or '.join(METHODS_BY_CANDIDATES)}"
        )
    source = candidates(settings.candidates) if callable(candidates) else candidates
    with refused_as(UsageError, CalibError, "candidates: {}"):
        q = read_poses(source, joints_of(chain))  # ty: ignore[invalid-argument-type]
    numbers = np.flatnonzero(is_feasible(space, q))
    if len(numbers) < m:
        exceeding = int(((q < space.lower) | (q > space.upper)).any(axis=1).sum())
        raise UsageError(
            f"candidates: {len(numbers)} of {len(q)} keep the constraints, and {m} are to be chosen: {exceeding} "
            "exceed the joint limits [rad or m]; give more candidates, or loosen the constraints"
        )
    return q, numbers


def _draw_views(
    view: CameraView, space: SearchSpace, limits: Limits, settings: SelectionSettings, m: int
) -> np.ndarray:
    """Return feasible postures (N, n) at which the camera sees the board, at least twice as many as shall be selected.

    Args:
        view: camera and board.
        space: search space with all constraints.
        limits: joint limits and constraints.
        settings: settings of the selection.
        m: number of poses to select.

    Raises:
        UsageError: if fewer postures are found.
    """
    count = min(settings.candidates, VIEWS)
    feasible = partial(is_feasible, space)
    candidates = view.draw(count, feasible, limits.lower, limits.upper, settings.seed)
    if len(candidates) < 2 * m:
        raise UsageError(
            f"{len(candidates)} feasible postures see the board, but {2 * m} are needed to choose {m}: "
            "check carried, stands, tilt and range in [camera]"
        )
    return candidates


def _draw_feasible(space: SearchSpace, limits: Limits, settings: SelectionSettings) -> np.ndarray:
    """Return random feasible poses as candidates.

    Args:
        space: search space with all constraints.
        limits: joint limits and constraints.
        settings: settings of the selection.

    Raises:
        UsageError: if too few poses are feasible; the message lists the constraints.
    """
    feasible = partial(is_feasible, space)
    try:
        return draw_candidates(space.lower, space.upper, settings.candidates, feasible, seed=settings.seed)
    except NothingFeasible as error:
        stream = np.random.default_rng(settings.seed)
        q = stream.uniform(limits.lower, limits.upper, (RANDOM_POSTURES, len(limits.lower)))
        shares = []
        for constraint in space.constraints:
            satisfied = (np.asarray(constraint.function(q)) <= 0.0).all(1)
            shares.append((constraint.name, satisfied.mean()))
        shares.sort(key=itemgetter(1))
        listed = ", ".join(f"{name} {100 * share:.2g} %" for name, share in shares)
        hint = ""
        if limits.sight is not None:
            hint = " (does the target face the arm? check facing in [target])"
        raise UsageError(f"{error}; share of random postures that keep each constraint: {listed}{hint}") from error
