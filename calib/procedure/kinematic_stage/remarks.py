"""Rows that do not fit, and whether rigid geometry explains the measurements."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.data.poses.measurements import PoseMeasurements
from calib.errors import Finding, finding
from calib.geometry.accuracy import NATURE
from calib.geometry.model_choice.ladder import MAX_RESIDUAL, ModelSelection
from calib.geometry.observation import observe
from calib.geometry.result import GeometricFit
from calib.units import ERRORS

FLOOR = 4e-4  # rms per metre of reach: more is not left by a rigid geometry of a sound arm (our choice)
TOO_GOOD = 2e-6  # rms [m]: less is left by no instrument (our choice)


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
    for file, row, label, sigmas in found.outliers():
        result.setdefault((file, row, label), Outlier(file, row, NATURE[label], sigmas, sizes[file, row, label]))
    return list(result.values())


def misfit(found: ModelSelection, reach: float) -> Finding | None:
    """Return that no rigid geometry explains the measurements: the full one leaves more than `FLOOR` of the reach.

    Cross-validated, and on the fitted rows, degrees of freedom counted: few poses predict each other badly under any
    model, which says nothing against this one. Where the chosen model, joint corrections included, leaves less than
    `FLOOR`, it is a note.

    Args:
        found: the selection of models by cross-validation.
        reach: of the arm [m].
    """
    rigid = [rung for rung in found.rungs if rung.model in ("frames", "offsets", "geometry")]
    if not rigid or rigid[-1].model != "geometry":
        return None
    best = min(rung.cross_validated for rung in rigid)
    if min(best, _left(found.rigid)) <= FLOOR * reach:
        return None
    return finding("rigid-misfit", rms=best, reach=reach, healthy=FLOOR * reach, left=_remains(found, reach))


def gross_rows(found: ModelSelection, robust: ModelSelection, reach: float) -> Finding | None:
    """Return that rows grossly off leave what `misfit` complains of; None where they do not.

    Args:
        found: the selection of models with a loss that heeds every row.
        robust: the rigid models on the same rows with a loss that does not.
        reach: of the arm [m].
    """
    off = [row for row in named_outliers(robust.rigid) if row.sigmas > MAX_RESIDUAL]
    if not off or misfit(robust, reach):
        return None
    best = min(rung.cross_validated for rung in robust.rungs)
    return finding(
        "gross-rows", count=len({(row.file, row.row) for row in off}), rows=[row.words for row in off], loss=found.loss,
        rms=best, left=_remains(found, reach),
    )  # fmt: skip


def _left(found: GeometricFit) -> float:
    """Return the rms position error of a fit on its own rows [m], as if it had not used up degrees of freedom."""
    parts = [piece.part for piece in found.pieces]
    sizes = [part.sizes() for part in parts if NATURE[part.label] == "position"]
    rows, used = sum(part.height for part in parts), len(found.free) + sum(part.nuisances for part in parts)
    if not sizes or rows <= used:
        return np.inf
    return float(np.sqrt(np.mean(np.concatenate(sizes) ** 2) * rows / (rows - used)))


def _remains(found: ModelSelection, reach: float) -> float:
    """Return what the chosen model leaves on held-out rows, over `FLOOR` of the reach."""
    return ([rung.cross_validated for rung in found.rungs if rung.kept] or [np.inf])[-1] / (FLOOR * reach)


def _file_rows(block: PoseMeasurements) -> np.ndarray:
    return block.rows
