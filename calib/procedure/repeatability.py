"""ISO 9283's accuracy and repeatability as the fit's metrics, the console and the certificate state them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calib.data.measurements import PoseMeasurements
from calib.geometry.accuracy import Torques
from calib.geometry.installation import Installation
from calib.geometry.repeatability import SAME, Repeats, repeats

POSES, CYCLES, ENOUGH = 5, 30, 100  # what the norm asks for; how many poses makers judge accuracy by
MOST = 30  # poses a certificate lists
ARMS = ("nominal", "calibrated")
NOTE = (
    "After ISO 9283: AP is the barycentre of a pose's cycles minus the command (what the arm's model says of these "
    "joints; station and tool as fitted), RP the mean distance from the barycentre plus three standard deviations, vAP "
    "the largest distance between barycentres approached from different directions. The norm asks for 5 poses of 30 "
    "cycles. Five poses are too few to state an accuracy: makers judge it by 100 and more, once each, as the errors on "
    "unseen poses do; repeated poses state the repeatability, below which no calibration can get."
)


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


def sentence(found: Mapping[str, Any]) -> str:
    """Say in a sentence what repeated poses tell."""
    least, most = found["cycles"]
    cycles = f"{least}" if least == most else f"{least} to {most}"
    before, after = (found["accuracy_mm"][arm]["mean"] for arm in ARMS)
    words = (
        f"ISO 9283 on {found['poses']} poses repeated {cycles} times: RP {found['repeatability_mm']['mean']:.3f} mm "
        f"(at most {found['repeatability_mm']['max']:.3f}), AP {before:.3f} mm nominal, {after:.3f} mm calibrated"
    )
    few = [f"{POSES} poses"] * (found["poses"] < POSES) + [f"{CYCLES} cycles"] * (least < CYCLES)
    words += f"; the norm asks for {' and '.join(few)}" if few else ""
    return words + (f"; too few poses to state an accuracy (makers take {ENOUGH})" if found["poses"] < ENOUGH else "")


def blocks(metrics: Mapping[str, Any]) -> list[Any]:
    """Return the certificate's tables: one for each set of rows in which poses were repeated."""
    from calib.procedure.certificate import Table

    sets = [("fitted", metrics["fit"]), *metrics["validation"].items()]
    result = []
    for name, found in sets:
        if iso := found.get("iso9283"):
            rows = [_row(number + 1, each) for number, each in enumerate(iso["each"][:MOST])]
            rows += [("…", f"{len(iso['each']) - MOST} more in metrics.json", *[""] * 6)] * (len(iso["each"]) > MOST)
            title = f"Accuracy and repeatability, {name} ({sentence(iso)})"
            result.append(Table(title, HEADER, rows, NOTE, numbers=range(1, 8)))
    return result


HEADER = (
    "pose", "cycles", "AP nominal [mm]", "AP calibrated [mm]", "x, y, z of it [mm]", "RP [mm]", "RP a, b, c [deg]",
    "vAP [mm]",
)  # fmt: skip


def _row(number: int, each: Mapping[str, Any]) -> tuple[str, ...]:
    sizes = [f"{float(np.linalg.norm(each[f'{arm}_mm'])):.3f}" for arm in ARMS]
    axes = ", ".join(f"{value:+.3f}" for value in each["calibrated_mm"])
    turns = ", ".join(f"{value:.4f}" for value in each.get("repeatability_deg", ()))
    varied = f"{each['multidirectional_mm']:.3f}" if "multidirectional_mm" in each else ""
    return (str(number), str(len(each["rows"])), *sizes, axes, f"{each['repeatability_mm']:.3f}", turns, varied)
