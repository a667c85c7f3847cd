"""What unseen rows say of both arms: doubtful rows, the table of errors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from calib import files
from calib.data.poses.measurements import PoseMeasurements
from calib.geometry.observation import predict, prepare
from calib.procedure.kinematic_stage.validation import Comparison
from calib.robot.chain import Chain
from calib.transforms import invert

GROSS = 8.0  # our choice
PLACES = tuple(
    f"{name} [{unit}]"
    for head, unit in (("", "m"), ("to_nominal_", "mm"), ("to_calibrated_", "mm"))
    for name in (f"{head}x", f"{head}y", f"{head}z")
)


def doubtful(validation: Mapping[str, Comparison]) -> list[str]:
    """Name unseen rows whose error is more than `GROSS` times the median: they may be wrong measurements."""
    result = []
    for name, each in validation.items():
        sizes, numbers = each.errors[1].main, [row for block in each.blocks for row in _numbers(block)]
        far = np.flatnonzero(sizes > GROSS * np.median(sizes)) if len(sizes) == len(numbers) else []
        if len(far):
            rows = ", ".join(f"row {numbers[k]} ({1e3 * sizes[k]:.3g} mm)" for k in far[:5])
            rest = np.delete(sizes, far)
            without = 1e3 * float(np.sqrt(np.mean(rest**2)))
            result.append(
                f"{name}: {rows} far off the median of {1e3 * np.median(sizes):.3g} mm; measured wrongly? They count, "
                f"for the verdict too; without them the rms is {without:.3f} mm"
            )
    return result


def write_errors(path: Path, chain: Chain, validation: Mapping[str, Comparison]) -> None:
    """Write the errors of both arms at every unseen row; where positions were measured, with where and whither.

    Then ``x y z`` is where the target was seen, ``to_nominal`` and ``to_calibrated`` lead from there to where each arm
    puts it, all in the calibrated arm's base.
    """
    rows: list[list[object]] = []
    for name, each in validation.items():
        q = np.concatenate([block.q for block in each.blocks])
        numbers = [row for block in each.blocks for row in _numbers(block)]
        sizes = [found.main for found in each.errors]
        if len(sizes[0]) == len(q):
            places = np.concatenate([_places(each, number) for number in range(len(each.blocks))])
            rows += [
                [name, number, *map(float, joints), 1e3 * float(a), 1e3 * float(b), *map(_cell, place)]
                for number, joints, a, b, place in zip(numbers, q, *sizes, places)
            ]
    joints = [f"{joint.name} [{joint.unit}]" for joint in chain.joints]
    files.write_table(path, ["file", "row", *joints, "nominal [mm]", "calibrated [mm]", *PLACES], rows)


def _places(found: Comparison, number: int) -> np.ndarray:
    """Return seen position [m] and the ways from there to both arms' [mm] of one block (m, 9); NaN without any."""
    block, torque = found.blocks[number], [found.torques[number]]
    if block.position is None:
        return np.full((len(block), 9), np.nan)
    ready = [prepare(cell, [block], torque)[0] for cell in found.cells]
    base = invert(found.cells[1].stations[ready[1].station])
    ways = [1e3 * (predict(cell, one).point.T - block.position) for cell, one in zip(found.cells, ready)]
    turn = base[:3, :3].T
    return np.hstack([block.position @ turn + base[:3, 3], *(way @ turn for way in ways)])


def _cell(value: float) -> float | None:
    return None if np.isnan(value) else float(value)


def _numbers(block: PoseMeasurements) -> list[int]:
    assert block.rows is not None
    return [int(row) for row in block.rows]
