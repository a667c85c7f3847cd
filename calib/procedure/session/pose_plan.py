"""Which poses a session asks for: chosen ones for the fit, random ones within the same limits for validation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from calib import files
from calib.data.poses.pixels import Pixels
from calib.geometry.observability import SIGMA_ORIENTATION, observation, targets_of
from calib.procedure.kinematic_stage import selection
from calib.procedure.kinematic_stage.settings import SelectionSettings
from calib.procedure.measuring.camera_view import BLIND
from calib.procedure.measuring.pose_limits import read_limits
from calib.procedure.measuring.run import Run, same_turn
from calib.procedure.measuring.selection_prediction import SelectionPrediction
from calib.procedure.session.folder import PREDICTED, Session
from calib.robot.chain import Chain
from poses.candidates import draw_candidates
from poses.space import is_feasible

HOW = "state [camera] in the limits file: calib formats constraints"


@dataclass(frozen=True, eq=False)
class Plan:
    """Poses for the fit (m, n) and for validation (v, n) [rad or m], how they came about, what they keep and tell."""

    fit: np.ndarray
    validation: np.ndarray
    words: str
    kept: tuple[str, ...]
    record: dict[str, Any]
    run: Run
    prediction: SelectionPrediction | None


def plan(session: Session, robot_file: Any, chain: Chain, say: Callable[[str], None]) -> Plan:
    """Choose the poses that ``session.toml`` asks for."""
    settings = session.settings
    wanted, instrument = settings.poses, settings.instrument
    constraints = session.path(wanted.constraints) if wanted.constraints else None
    links = (chain.base, chain.tip) if robot_file.suffix == ".urdf" else (None, None)
    stated = (instrument.sigma_position, instrument.sigma_orientation)
    choice = SelectionSettings(
        kind=_seen_as(instrument.measures), tools=(tuple(instrument.tool),), index=wanted.index, method=wanted.method,
        sigmas=_sigmas(*stated), seed=settings.seed,
    )  # fmt: skip
    chosen = selection.choose(
        robot_file, wanted.fit, choice, constraints=constraints, base=links[0], tip=links[1],
        progress=lambda done, total, what: say(f"choosing poses: {what}"),
    )  # fmt: skip
    said = any(words.startswith(BLIND) for words in chosen.unchecked)
    if instrument.measures == Pixels.kind and not chosen.by_images and not said:
        chosen = replace(chosen, unchecked=(*chosen.unchecked, f"{BLIND} ({HOW})"))
    found, q = chosen.selection, chosen.selection.joints
    if found.interrupted:  # a session is resumed, not gone on with half a search
        raise KeyboardInterrupt
    gain = found.random_baseline / found.value if found.index == "cond" else found.value / found.random_baseline
    words = (
        f"{len(q)} poses by {found.method}, {found.index} = {found.value:.4g}, {gain:.2f} times the best of 1000 "
        f"random sets, {100 * found.efficiency:.1f} % of the convex bound ({selection.bound_words(found)})"
    )
    record = {"words": words, **selection.record(chosen), "seed": settings.seed}
    outlook = chosen.outlook.poses
    if session.plots and np.isfinite(outlook.rms):
        from calib.procedure.report.charts import picture
        from calib.procedure.report.geometry_figures import predicted_map

        chart = predicted_map(outlook.points, outlook.spread)
        files.write(session.path(PREDICTED), picture(chart, "").png)
    unseen = _unseen(session, robot_file, chain, wanted.validation)
    kept = (*chosen.kept(), *(f"{words}: {number}" for words, number in selection.predicted_rows(chosen)))
    return Plan(q, unseen, words, kept, record, chosen.run, chosen.prediction)


def _sigmas(position: float, orientation: float) -> tuple[float, float] | None:
    """Return the sigmas that are stated, with our own for an orientation that is not; None where none is."""
    return (position, orientation or SIGMA_ORIENTATION) if position else None


def _seen_as(measures: str) -> str:
    """Return the kind of measurement that poses are chosen for: an image tells a pose."""
    return "pose" if measures == Pixels.kind else measures


def _unseen(session: Session, robot_file: Any, chain: Chain, count: int) -> np.ndarray:
    """Return random poses within limits and constraints (count, n), from another stream than the candidates'."""
    if not count:
        return np.zeros((0, chain.n))
    name = session.settings.poses.constraints
    cell = targets_of(chain, [session.settings.instrument.tool])
    limits = read_limits(session.path(name) if name else None, cell, robot_file)
    jacobian = observation(cell, _seen_as(session.settings.instrument.measures))
    space = limits.space(jacobian)
    stream = np.random.default_rng([session.settings.seed, 1])
    if limits.camera is not None:
        return limits.camera.draw(count, partial(is_feasible, space), limits.lower, limits.upper, stream)
    q = draw_candidates(limits.lower, limits.upper, count, lambda q: is_feasible(space, q), seed=stream)
    return same_turn(chain, q, limits.lower, limits.upper)
