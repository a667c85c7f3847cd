"""Checks of measurements against the model: changes of set-up, errors that no rigid geometry explains."""

from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from calib.errors import Finding, finding
from calib.geometry.observation import Block
from calib.geometry.residuals import Part
from calib.geometry.result import GeometricFit

MIN_ROWS = 30  # rows below which no pattern is looked for (our choice)


def diagnose(found: GeometricFit) -> list[Finding]:
    """Return findings on each block: changes of set-up between rows, and systematic residuals."""
    result: list[Finding] = []
    for block, part in _lengths(found):
        if part.value.shape[1] >= MIN_ROWS:  # pairs of rows count once
            result += [*_setup_change(block, part), *_systematic(block, part)]
    return result


def _lengths(found: GeometricFit) -> list[tuple[Block, Part]]:
    """Return the first residual part of each block, which is in metres for every kind of measurement."""
    first = {piece.block: piece.part.per_row() for piece in reversed(found.pieces)}
    return [(block, first[number]) for number, block in enumerate(found.blocks)]


def _setup_change(block: Block, part: Part, max_chance: float = 1e-3, min_ratio: float = 1.6) -> list[Finding]:
    """Return the finding of a changed set-up: residuals before and after every cut differ in size and ranks.

    `max_chance`: probability that the same rows in another order show such a change (our choice).

    `min_ratio`: a set-up's errors over the rest's from which on it is worth a word (our choice).
    """
    size = np.linalg.norm(part.value, axis=0)
    size = np.minimum(size, 4.0 * np.median(size))  # a few gross rows are not a set-up
    m = len(size)
    cuts = np.arange(max(10, m // 20), m - max(10, m // 20))
    energy = np.cumsum(size**2)
    before = np.sqrt(energy[cuts - 1] / cuts)
    after = np.sqrt((energy[-1] - energy[cuts - 1]) / (m - cuts))
    ratio = np.maximum(before / np.maximum(after, 1e-15), after / np.maximum(before, 1e-15))
    weight = np.minimum(cuts, m - cuts)
    best = int(np.argmax((ratio - 1.0) * np.sqrt(weight)))
    cut, first_worse = int(cuts[best]), before[best] > after[best]
    if ratio[best] < min_ratio:
        return []
    from scipy.stats import mannwhitneyu  # slow to load, and seldom needed

    if float(mannwhitneyu(size[:cut], size[cut:]).pvalue) * len(cuts) > max_chance:  # Bonferroni: the best of many cuts
        return []
    rows = block.measured.rows[part.index]
    bad = (rows[0], rows[cut - 1]) if first_worse else (rows[cut], rows[-1])
    worse, rest = (before[best], after[best]) if first_worse else (after[best], before[best])
    return [finding("set-up-changed", file=_name(block), first=bad[0], last=bad[1], worse=worse, rest=rest)]


def _systematic(block: Block, part: Part, max_times: float = 5.0) -> list[Finding]:
    """Return findings on systematic residuals: noise differs between neighbouring poses, a missing effect does not.

    `max_times`: factor above a stated uncertainty from which residuals give a finding (our choice).
    """
    floor, rms = neighbour_floor(block.measured.q, part), float(np.sqrt(np.mean(np.sum(part.value**2, axis=0))))
    stated = None if part.sigma is None else float(np.sqrt(np.mean(np.sum(part.sigma**2, axis=0))))
    result = []
    if floor is not None and floor < 0.6 * rms:
        result.append(finding("systematic-residual", file=_name(block), rms=rms, neighbours=floor))
    if stated is not None and not stated / max_times <= rms <= max_times * stated:
        code = "sigma-too-small" if rms > stated else "sigma-too-large"
        times = max(rms, stated) / max(min(rms, stated), 1e-300)
        result.append(finding(code, file=_name(block), rms=rms, stated=stated, times=times))
    return result


def _name(block: Block) -> str:
    return Path(block.measured.file).name or "measurements"


def neighbour_floor(q: np.ndarray, part: Part) -> float | None:
    """Return the rms of residual differences between nearest neighbours in q, over √2 [m]: an estimate of the noise.

    (von Neumann's mean square successive difference, 1941, with neighbours in joint space in place of time.) None where
    neighbours are further apart than a third of the joints' spread, so that they share nothing.
    """
    spread = q.std(axis=0)
    moving = spread > 1e-9
    if len(q) != part.value.shape[1] or not moving.any():
        return None
    scaled = q[:, moving] / spread[moving]
    distance, index = KDTree(scaled).query(scaled, k=2)
    near = distance[:, 1] < np.sqrt(moving.sum()) / 3.0
    if near.sum() < MIN_ROWS:
        return None
    change = part.value[:, near] - part.value[:, np.asarray(index)[near, 1]]
    return float(np.sqrt(np.mean(np.sum(change**2, axis=0)) / 2.0))
