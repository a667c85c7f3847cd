"""ISO 9283's accuracy and repeatability as the fit's metrics, the console and the certificate state them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from calib.data.poses.measurements import PoseMeasurements
from calib.geometry.accuracy import Torques
from calib.geometry.checks.repeatability import SAME, Repeats, repeats
from calib.geometry.installation import Installation
from calib.procedure.kinematic_stage.metrics import RepeatedPoses

POSES, CYCLES, ENOUGH = 5, 30, 100  # what the norm asks for; how many poses makers judge accuracy by
ARMS = ("nominal", "calibrated")


def table(
    cells: tuple[Installation, Installation], blocks: Sequence[PoseMeasurements], torques: Torques
) -> dict[str, Any] | None:
    """Return what ``metrics.json`` holds of repeated poses under ``iso9283``; None where there are none.

    Args:
        cells: nominal and calibrated arm.
        blocks: the rows.
        torques: gravity torques (m, n) per block [N m].
    """
    found = [repeats(cell, blocks, torques) for cell in cells]
    one, two = found
    if one is None or two is None:
        return None
    result: dict[str, Any] = {
        "poses": len(one.cycles),
        "cycles": [int(one.cycles.min()), int(one.cycles.max())],
        "same_joints_within": SAME,
        "repeatability_mm": _sizes(1e3 * one.repeatability),
        "accuracy_mm": {
            arm: _sizes(1e3 * np.linalg.norm(each.accuracy, axis=1)) for arm, each in zip(ARMS, (one, two))
        },
    }
    if one.turn_repeatability is not None and one.turn_accuracy is not None and two.turn_accuracy is not None:
        degrees = np.degrees(1.0)
        result["orientation_repeatability_deg"] = _sizes(degrees * one.turn_repeatability.max(axis=1))
        result["orientation_accuracy_deg"] = {
            arm: _sizes(degrees * np.linalg.norm(turn, axis=1))
            for arm, turn in zip(ARMS, (one.turn_accuracy, two.turn_accuracy))
        }
    several = one.variation[~np.isnan(one.variation)]
    if len(several):
        result["multidirectional_mm"] = _sizes(1e3 * several) | {"poses": len(several)}
    result["each"] = [_pose(k, one, two) for k in range(len(one.cycles))]
    return result


def _sizes(values: np.ndarray) -> dict[str, float]:
    return {"mean": float(values.mean()), "max": float(values.max())}


def _pose(k: int, one: Repeats, two: Repeats) -> dict[str, Any]:
    """Return one pose: its rows, AP of both arms per axis, RP, and vAP where there is one."""
    entry: dict[str, Any] = {"rows": [int(row) for row in one.rows[k]], "repeatability_mm": 1e3 * one.repeatability[k]}
    entry |= {f"{arm}_mm": (1e3 * each.accuracy[k]).tolist() for arm, each in zip(ARMS, (one, two))}
    if one.turn_accuracy is not None and two.turn_accuracy is not None and one.turn_repeatability is not None:
        turns = zip(ARMS, (one.turn_accuracy, two.turn_accuracy))
        entry |= {f"{arm}_deg": np.degrees(turn[k]).tolist() for arm, turn in turns}
        entry["repeatability_deg"] = np.degrees(one.turn_repeatability[k]).tolist()
    return entry if np.isnan(one.variation[k]) else entry | {"multidirectional_mm": 1e3 * one.variation[k]}


def sentence(found: RepeatedPoses) -> str:
    """Return in a sentence what repeated poses tell."""
    least, most = found.cycles
    cycles = f"{least}" if least == most else f"{least} to {most}"
    accuracy, repeatability = found.accuracy_mm, found.repeatability_mm
    words = (
        f"ISO 9283 on {found.poses} poses repeated {cycles} times: RP {repeatability.mean:.3f} mm "
        f"(at most {repeatability.max:.3f}), AP {accuracy.nominal.mean:.3f} mm nominal, "
        f"{accuracy.calibrated.mean:.3f} mm calibrated"
    )
    few = [f"{POSES} poses"] * (found.poses < POSES) + [f"{CYCLES} cycles"] * (least < CYCLES)
    words += f"; the norm asks for {' and '.join(few)}" if few else ""
    return words + (f"; too few poses to state an accuracy (makers take {ENOUGH})" if found.poses < ENOUGH else "")
