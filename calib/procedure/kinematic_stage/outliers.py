"""Rows that do not fit, named with their size, and errors that no rigid geometry explains."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.data.poses.measurements import PoseMeasurements
from calib.geometry.accuracy import NATURE
from calib.geometry.model_choice.ladder import ModelSelection
from calib.geometry.observation import observe
from calib.geometry.result import GeometricFit, outliers
from calib.units import ERRORS

FLOOR = 4e-4  # rms per metre of reach: more is not left by a rigid geometry of a sound arm (our choice)


@dataclass(frozen=True)
class Outlier:
    """A row that does not fit: how large its residual is [m or rad], and in robust standard deviations of all rows."""

    file: str
    row: int
    nature: str
    sigmas: float
    size: float

    @property
    def words(self) -> str:
        factor, unit = ERRORS[self.nature]
        return f"{Path(self.file).name} row {self.row} ({factor * self.size:.3g} {unit}, {self.sigmas:.1f} sigma)"


def named_outliers(found: GeometricFit) -> list[Outlier]:
    """Return rows of the fit beyond four robust sigmas, worst first; several targets of one row count once."""
    sizes: dict[tuple[str, int, str], float] = {}
    for block in found.blocks:
        for each in observe(found.cell, block, np.array([], dtype=int)):
            part = each.per_row()
            for row, size in zip(_file_rows(block.measured)[part.index], part.sizes()):
                key = block.measured.file, int(row), part.label
                sizes[key] = max(float(size), sizes.get(key, 0.0))
    result: dict[tuple[str, int, str], Outlier] = {}
    for file, row, label, sigmas in outliers(found):
        result.setdefault((file, row, label), Outlier(file, row, NATURE[label], sigmas, sizes[file, row, label]))
    return list(result.values())


def plateau(found: ModelSelection, reach: float) -> str:
    """Say that no rigid geometry explains the measurements, where the full one leaves more than `FLOOR` of the reach.

    Args:
        found: the climb, whose rungs were judged on rows left out.
        reach: of the arm [m].

    Returns:
        The sentence, or an empty string.
    """
    rigid = [rung for rung in found.rungs if rung.model in ("frames", "offsets", "geometry")]
    if not rigid or rigid[-1].model != "geometry":
        return ""
    best = min(rigid, key=lambda rung: rung.cross_validated)
    if best.cross_validated <= FLOOR * reach:
        return ""
    return (
        f"no rigid geometry explains these measurements: on rows left out {1e3 * best.cross_validated:.2f} mm rms "
        f"remain with the best one ({best.model}, {best.parameters} parameters), where a sound arm of {reach:.1f} m "
        f"reach leaves less than {1e3 * FLOOR * reach:.2f} mm"
    )


def remains(found: ModelSelection, reach: float) -> bool:
    """Say whether the chosen model, joint corrections included, leaves more than `FLOOR` of the reach on rows left out.

    Where it does not, that no rigid geometry explains the measurements is a remark, and no ground to doubt the model.
    """
    kept = [rung.cross_validated for rung in found.rungs if rung.kept]
    return not kept or kept[-1] > FLOOR * reach


def _file_rows(block: PoseMeasurements) -> np.ndarray:
    assert block.rows is not None
    return block.rows
