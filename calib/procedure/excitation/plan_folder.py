"""The folder of a planned motion: samples at the controller's rate, ROS messages, metrics, and pictures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.procedure.excitation import motion_files
from calib.procedure.excitation.planning import Planned
from trajectories.timing.time_scaling import ACTIVE

OURS = ("metrics.json", "motion.csv", "trajectory.yaml", "trajectory.json")
UNITS = {"velocity": "rad/s", "acceleration": "rad/s²", "torque": "N m"}


def check_target(out: Path) -> None:
    """Refuse, before any work is done, what is not ours to replace."""
    motion_files.check_target(out, OURS, "plan")


def write_folder(planned: Planned, out: Path, draw: Callable[[Planned, Path], None] | None = None) -> Path:
    """Write the folder; each file whole or not at all, ``metrics.json`` last; `draw` adds figures."""
    motion_files.write_track(planned.track, out / "motion.csv")
    motion_files.write_messages(planned.track, planned.chain.joint_names, out)
    motion_files.write_optional(planned.approach, out / "approach.csv")
    motion_files.write_optional(planned.rehearsal, out / "rehearsal.csv")
    if draw is not None:
        draw(planned, out)
    files.write_json(out / "metrics.json", metrics(planned))
    return out


def metrics(planned: Planned) -> dict[str, Any]:
    """Return the content of ``metrics.json``."""
    used = {name: np.concatenate([one.used[name] for one in planned.timings]) for name in planned.timings[0].used}
    seconds = np.array([one.duration for one in planned.timings])
    shaped = planned.shaped
    return {
        "feasible": True,
        "duration": planned.track.duration,
        "margins": {"position": _nearest(planned)} | {name: _margin(planned, name, x) for name, x in used.items()},
        "active_share": float(seconds @ [one.active_share for one in planned.timings] / seconds.sum()),
        "active_within": ACTIVE,
        "iterations": sum(one.iterations for one in planned.timings),
        "tightened": max(one.tightened for one in planned.timings),
        "history": [list(one.history) for one in planned.timings],
        "segments": seconds.tolist(),
        "rate": planned.track.rate,
        "samples": len(planned.track),
        "samples_verified": sum(len(one.sampled.s) for one in planned.timings),
        "line_deviation": None
        if planned.deviation is None
        else {"position": float(planned.deviation[0]), "orientation": float(planned.deviation[1])},
        "shortened": None
        if shaped is None
        else {
            "before": shaped.before, "after": shaped.after, "evaluations": shaped.evaluations,
            "refused": shaped.refused, "parameters": shaped.phi.tolist(),
        },
        "torque_sigma": None if planned.sigma is None else planned.sigma.tolist(),
        "torque_limits": [float(x) if np.isfinite(x) else None for x in planned.limits.torque],
        "approach": None if planned.approach is None else planned.approach.duration,
        "notes": list(planned.notes),
    }  # fmt: skip


def lines(planned: Planned) -> list[str]:
    """Return what a person wants to read at the end."""
    found = metrics(planned)
    words = [
        f"{found['duration']:.3f} s at {found['rate']:g} Hz; some limit is within {ACTIVE:.0%} of being reached for "
        f"{found['active_share']:.1%} of the time, none is crossed at {found['samples_verified']} instants",
        "smallest margins:",
    ]
    for name, one in found["margins"].items():
        words.append(f"  {name:12} {one['margin']:.4g} {one['unit']} ({one['at']})")
    if planned.sigma is not None:
        free = ", ".join(f"{x:.3g}" for x in planned.sigma)
        words.append(f"limits of torque narrowed for the model's uncertainty, one sigma of each joint: {free} N m")
    if planned.shaped is not None:
        words.append(f"the path's own shape: {planned.shaped.before:.3f} s before, {planned.shaped.after:.3f} s after")
    if planned.deviation is not None:
        words.append(f"the tool keeps its lines to {1e6 * planned.deviation[0]:.2g} µm")
    return words + [f"note: {note}" for note in planned.notes]


def _margin(planned: Planned, name: str, used: np.ndarray) -> dict[str, Any]:
    size = getattr(planned.limits, name)
    share = 1.0 - used.max(axis=0)
    j = int(np.argmin(share))
    joint = planned.chain.joints[j]
    unit = UNITS[name] if joint.kind == "revolute" else UNITS[name].replace("rad", "m").replace("N m", "N")
    return {
        "margin": float(share[j] * size[j]), "unit": unit, "at": joint.name, "share": float(share[j]),
        "joints": share.tolist(),
    }  # fmt: skip


def _nearest(planned: Planned) -> dict[str, Any]:
    j = int(np.argmin(planned.margins))
    joint = planned.chain.joints[j]
    return {
        "margin": float(planned.margins[j]), "unit": joint.unit, "at": joint.name,
        "share": float(planned.margins[j] / (planned.upper[j] - planned.lower[j])), "joints": planned.margins.tolist(),
    }  # fmt: skip
