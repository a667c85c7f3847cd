"""What unseen rows say of both arms: doubtful rows, the table of errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calib import files
from calib.data.measurements import PoseMeasurements
from calib.procedure.comparing import Comparison
from calib.robot.chain import Chain

GROSS = 8.0  # our choice


def doubtful(validation: dict[str, Comparison]) -> list[str]:
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


def write_errors(path: Path, chain: Chain, validation: dict[str, Comparison]) -> None:
    """Write the errors of both arms at every unseen row."""
    rows: list[list[object]] = []
    for name, each in validation.items():
        q = np.concatenate([block.q for block in each.blocks])
        numbers = [row for block in each.blocks for row in _numbers(block)]
        sizes = [found.main for found in each.errors]
        if len(sizes[0]) == len(q):
            rows += [
                [name, number, *map(float, joints), 1e3 * float(a), 1e3 * float(b)]
                for number, joints, a, b in zip(numbers, q, *sizes)
            ]
    joints = [f"{joint.name} [{joint.unit}]" for joint in chain.joints]
    files.write_table(path, ["file", "row", *joints, "nominal [mm]", "calibrated [mm]"], rows)


def _numbers(block: PoseMeasurements) -> list[int]:
    assert block.rows is not None
    return [int(row) for row in block.rows]
