"""The folder of an excitation: metrics, the motion at the controller's rate, its coefficients, and pictures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.procedure.excitation import design, motion_files
from calib.procedure.excitation.design import Designed
from calib.robot.tables import dumps
from trajectories.basis import SampledMotion
from trajectories.design.verify import dense_motion

OURS = ("metrics.json", "trajectory.csv", "trajectory.toml")
MESSAGES = 100.0  # points per second of the ROS message, whose controllers interpolate (our choice)


def check_target(out: Path) -> None:
    """Refuse, before any work is done, what is not ours to replace."""
    motion_files.check_target(out, OURS, "excitation")


def write_folder(designed: Designed, out: Path, draw: Callable[[Designed, Path], None] | None = None) -> Path:
    """Write the folder; each file whole or not at all, ``metrics.json`` last; `draw` adds figures."""
    motion = sampled(designed)
    header = ["t", *(f"{letter}{j + 1}" for letter in "qva" for j in range(designed.chain.n))]
    table = np.concatenate([motion.times[:, None], motion.q, motion.v, motion.a], axis=1)
    files.write_table(out / "trajectory.csv", header, table.tolist())
    files.write(out / "trajectory.toml", dumps(coefficients(designed)))
    played = designed.playback
    longer = played.approach is not None or played.repeat > 1
    motion_files.write_optional(played.run if longer else None, out / "run.csv")
    motion_files.write_optional(played.approach, out / "approach.csv")
    motion_files.write_optional(played.rehearsal, out / "rehearsal.csv")
    every = max(1, round(designed.rate / MESSAGES))
    motion_files.write_messages(played.run, designed.chain.joint_names, out, every)
    if draw is not None:
        draw(designed, out)
    if designed.front is not None and len(designed.front.values):
        rows = [[*map(float, row), bool(best)] for row, best in zip(designed.front.values, designed.front.best)]
        files.write_table(out / "front.csv", [*designed.front.names, "not dominated"], rows)
    files.write_json(out / "metrics.json", design.metrics(designed))
    return out


def sampled(designed: Designed) -> SampledMotion:
    """Return one period at the controller's rate, both ends included."""
    count = round(designed.period * designed.rate)
    times = np.arange(count + 1) * (designed.period / count)
    return dense_motion(designed.family, designed.found.x, times, designed.found.factor)


def coefficients(designed: Designed) -> dict[str, Any]:
    """Return the content of ``trajectory.toml``: eq. 23 of Kolyubin et al. 2019, or control points."""
    head: dict[str, Any] = {
        "robot": designed.chain.name, "family": designed.kind, "period": designed.period, "rate": designed.rate,
        "repeat": designed.playback.repeat,
        "note": "q(t) = q0 + sum_k a_k sin(k w t) + b_k cos(k w t), w = 2 pi / period; rad, m, s"
        if designed.kind == "fourier" else "periodic spline, uniform knots over the period; rad, m, s",
    }  # fmt: skip
    joints = []
    for name, c in zip(designed.chain.joint_names, designed.family.coefficients(designed.found.x)):
        if designed.kind == "fourier":
            half = len(c) // 2
            joints.append({"name": name, "q0": c[0], "a": c[1 : 1 + half], "b": c[1 + half :]})
        else:
            joints.append({"name": name, "points": c})
    degree = getattr(designed.family, "degree", None)
    return head | ({"degree": degree} if degree else {}) | {"joint": joints}


def lines(designed: Designed) -> list[str]:
    """Return what a person wants to read at the end."""
    found, cond = designed.found, designed.condition
    columns = len(designed.told.names)
    result = [
        *(["interrupted: this is the best motion found until then"] if found.interrupted else []),
        f"condition number of {columns} columns: {cond['raw']:.4g} raw, {cond['normalised']:.4g} normalised "
        f"({designed.kind}, period {designed.period:g} s)",
        *_together(designed),
        *(f"goal {name}: {value:.4g} (asked: {goal:.4g})" for name, goal, _, value in designed.goals),
        f"{found.evaluations} evaluations, {found.feasible:.0%} of them feasible, {found.seconds:.1f} s",
        f"every limit is kept, at {designed.proof.instants} instants and between them; smallest margins:",
    ]
    for name, one in designed.proof.worst.items():
        how = "bound" if one.proved else "estimate"
        result.append(
            f"  {name:12} {one.margin:.4g} {one.unit} ({one.label}, t = {one.time:.2f} s; between instants: {how})"
        )
    played = designed.playback
    parts = ["the approach"] if played.approach is not None else []
    parts.append(f"{played.repeat} period{'s' if played.repeat > 1 else ''}")
    result.append(f"to run: {' and '.join(parts)}, {played.run.duration:.1f} s")
    return result + [f"note: {note}" for note in designed.notes]


def _together(designed: Designed) -> list[str]:
    """Return what motions before have, and this one alone."""
    if designed.existing is None:
        return []
    cond = designed.condition
    return [
        f"together with {', '.join(designed.existing.names)} ({designed.existing.seconds:.1f} s), which alone has "
        f"{cond['raw_before']:.4g} raw, {cond['normalised_before']:.4g} normalised; this motion alone "
        f"{cond['raw_alone']:.4g} and {cond['normalised_alone']:.4g}"
    ]
