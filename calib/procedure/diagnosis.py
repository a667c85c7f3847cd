"""What a fit's residuals say about the measurements: rows that do not fit, and a set-up that changed on the way."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import rankdata

from calib.data.measurements import PoseMeasurements
from calib.geometry.accuracy import NATURE, residual_parts
from calib.geometry.fit import GeometricFit, outliers
from calib.geometry.ladder import Climb
from calib.geometry.observation import observe
from calib.procedure.comparing import Comparison

FLOOR = 4e-4  # rms per metre of reach: more is not left by a rigid geometry of a sound arm (our choice)
CHANGE = 6.0  # standard deviations of the rank sum that a change of the set-up must reach (our choice)
RATIO = 2.0  # and how many times larger errors must be on one side of it (our choice)
SIDE = 10  # rows at least on either side


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
        amount = f"{np.degrees(self.size):.3g} deg" if self.nature == "orientation" else f"{1e3 * self.size:.3g} mm"
        return f"{Path(self.file).name} row {self.row} ({amount}, {self.sigmas:.1f} sigma)"


def named_outliers(found: GeometricFit) -> list[Outlier]:
    """Return rows of the fit beyond four robust sigmas, worst first; several targets of one row count once."""
    sizes: dict[tuple[str, int, str], float] = {}
    for block in found.blocks:
        for part in observe(found.cell, block, np.array([], dtype=int)):
            for row, size in zip(_file_rows(block.measured)[part.index], np.linalg.norm(part.value, axis=0)):
                key = block.measured.file, int(row), part.label
                sizes[key] = max(float(size), sizes.get(key, 0.0))
    result: dict[tuple[str, int, str], Outlier] = {}
    for file, row, label, sigmas in outliers(found):
        result.setdefault((file, row, label), Outlier(file, row, NATURE[label], sigmas, sizes[file, row, label]))
    return list(result.values())


def set_up_changes(fitted: Comparison) -> list[str]:
    """Say where in a file the errors of the calibrated arm change their size: another set-up, or a different region.

    For every place k in the file's order, the rank sum of the errors before k is held against what a random order gives
    (Wilcoxon's, so that single outliers count little); the place where it stands out most is named.
    """
    result = []
    for block, parts in zip(fitted.blocks, residual_parts(fitted.cells[1], fitted.blocks, fitted.torques)):
        part = parts[0]
        order = np.argsort(_file_rows(block)[part.index], kind="stable")
        rows, sizes = _file_rows(block)[part.index][order], np.linalg.norm(part.value, axis=0)[order]
        found = change_point(sizes)
        if found is None:
            continue
        one, two = (1e3 * float(np.sqrt(np.mean(side**2))) for side in (sizes[:found], sizes[found:]))
        name, last, first = Path(block.file).name, rows[found - 1], rows[found]
        result.append(
            f"{name}: up to row {last} errors are {one:.3g} mm rms, from row {first} on {two:.3g} mm: the early or the "
            "late poses behave like another set-up (tool, base, zero positions, warm-up), or lie where the model misses "
            "something; fit the two parts apart to see"
        )
    return result


def change_point(sizes: np.ndarray) -> int | None:
    """Return the number of sizes before the place where they change most; None where that is no clear change."""
    m = len(sizes)
    if m < 4 * SIDE:
        return None
    ranks = rankdata(sizes) - (m + 1) / 2
    before = np.arange(1, m)
    spread = np.sqrt((m * m - 1) / 12 * before * (m - before) / m * m / (m - 1))
    score = np.abs(np.cumsum(ranks)[:-1]) / spread
    k = SIDE + int(np.argmax(score[SIDE - 1 : m - SIDE]))
    one, two = np.median(sizes[:k]), np.median(sizes[k:])
    clear = score[k - 1] > CHANGE and max(one, two) > RATIO * min(one, two)
    return k if clear else None


def plateau(found: Climb, reach: float) -> str:
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


def _file_rows(block: PoseMeasurements) -> np.ndarray:
    assert block.rows is not None
    return block.rows
