"""Which poses a session asks for: chosen ones for the fit, random ones within the same limits for validation."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from calib import files
from calib.data.poses.choices import IMAGES
from calib.data.poses.pose_lists import write_poses
from calib.geometry.observability import SIGMA_ORIENTATION, observation, targets_of
from calib.procedure.kinematic_stage import selection
from calib.procedure.kinematic_stage.settings import SelectionSettings
from calib.procedure.measuring.constraints_file import VIEW_UNCHECKED
from calib.procedure.measuring.pose_limits import read_limits
from calib.procedure.measuring.run import same_turn, write_run
from calib.procedure.measuring.selection_prediction import write as write_prediction
from calib.procedure.session.folder import POSES, PREDICTED, SELECTION, UNSEEN, WAYS, Session
from calib.robot.chain import Chain, joint_kinds
from poses.candidates import draw_candidates
from poses.space import is_feasible

HOW = "state [camera] in the limits file: calib formats constraints"


def choose(session: Session, chain: Chain, say: Callable[[str], None]) -> list[str]:
    """Choose and write the poses that ``session.toml`` asks for, the run through them, and predicted sigmas."""
    settings, robot_file = session.settings, session.robot_file
    wanted, instrument = settings.poses, settings.instrument
    base, tip = session.links(chain)
    sigmas = (instrument.sigma_position, instrument.sigma_orientation or SIGMA_ORIENTATION)
    choice = SelectionSettings(
        kind=_seen_as(instrument.measures), tools=(instrument.tool,), index=wanted.index, method=wanted.method,
        sigmas=sigmas if instrument.sigma_position else None, seed=settings.seed,
    )  # fmt: skip
    chosen = selection.choose(
        robot_file, wanted.fit, choice, constraints=session.named(wanted.constraints), base=base, tip=tip,
        progress=lambda done, total, what: say(f"choosing poses: {what}"),
    )  # fmt: skip
    said = any(words.startswith(VIEW_UNCHECKED) for words in chosen.unchecked)
    if instrument.measures == IMAGES and not chosen.by_images and not said:
        chosen = replace(chosen, unchecked=(*chosen.unchecked, f"{VIEW_UNCHECKED} ({HOW})"))
    found, q = chosen.selection, chosen.selection.joints
    if found.interrupted:  # a session is resumed, not gone on with half a search
        raise KeyboardInterrupt
    gain = found.random_baseline / found.value if found.index == "cond" else found.value / found.random_baseline
    words = (
        f"{len(q)} poses by {found.method}, {found.index} = {found.value:.4g}, {gain:.2f} times the best of 1000 "
        f"random sets, {100 * found.efficiency:.1f} % of the convex bound ({selection.bound_words(found)})"
    )
    unseen = _unseen(session, robot_file, chain, wanted.validation)
    sets = {POSES: q, UNSEEN: unseen} if wanted.validation else {POSES: q}
    for name, joints in sets.items():
        write_poses(session.path(f"2-poses/{name}"), joints, chain.joint_names, unit="deg", kinds=joint_kinds(chain))
    write_run(session.path(f"2-poses/{WAYS}"), chosen.run, chain)
    if chosen.prediction is not None:
        write_prediction(chosen.prediction, session.path(f"2-poses/{POSES}"))
    outlook = chosen.outlook.poses
    if session.plots and np.isfinite(outlook.rms):
        from calib.procedure.report.charts import picture
        from calib.procedure.report.geometry_figures import predicted_map

        chart = predicted_map(outlook.points, outlook.spread)
        files.write(session.path(PREDICTED), picture(chart, "").png)
    record = {"words": words, **selection.record(chosen), "seed": settings.seed}
    files.write_json(session.path(SELECTION), record)
    notes = [f"{len(q)} poses for the fit: {words}"]
    notes += [f"{len(unseen)} poses for validation, at random"] if wanted.validation else []
    numbers = (f"{words}: {number}" for words, number in selection.predicted_rows(chosen))
    return [*notes, *chosen.kept(), *numbers, *record["notes"]]


def _seen_as(measures: str) -> str:
    """Return the kind of measurement that poses are chosen for: an image determines a pose."""
    return "pose" if measures == IMAGES else measures


def _unseen(session: Session, robot_file: Any, chain: Chain, count: int) -> np.ndarray:
    """Return random poses within limits and constraints (count, n), from another stream than the candidates'."""
    if not count:
        return np.zeros((0, chain.n))
    cell = targets_of(chain, [session.settings.instrument.tool])
    limits = read_limits(session.named(session.settings.poses.constraints), cell, robot_file)
    jacobian = observation(cell, _seen_as(session.settings.instrument.measures))
    space = limits.space(jacobian)
    stream = np.random.default_rng([session.settings.seed, 1])
    if limits.camera is not None:
        return limits.camera.draw(count, partial(is_feasible, space), limits.lower, limits.upper, stream)
    q = draw_candidates(limits.lower, limits.upper, count, lambda q: is_feasible(space, q), seed=stream)
    return same_turn(chain, q, limits.lower, limits.upper)
