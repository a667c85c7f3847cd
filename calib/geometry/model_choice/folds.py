"""Partitions of measurements for cross-validation: by station, file, fixture, or region of the joint space.

A random split of grid data holds out neighbours of what was fitted and flatters every model; these folds ask for
transfer.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.data.poses.measurements import Distances, PoseMeasurements, Sockets, take
from calib.errors import UsageError, require

# regions of the joint space, and folds that they are divided among (our choice)
REGIONS = 20
FOLDS = 5
# parts of a fold that the other rows do not determine
SCATTERED_FOLDS = 3
# poses of which each may be held out alone
MAX_SINGLE_POSES = 150
NAMES = ("transfer", "regions", "random", "poses")


@dataclass(frozen=True, eq=False)
class Folds:
    """A partition of the rows of all blocks.

    Attributes:
        kind: ``stations``, ``files``, ``fixtures`` or ``regions``; ``random`` or ``poses`` (leave-one-out) on request.
        count: number of folds.
        members: per block, (m,) fold of each row.
        blind: names of groups that are not held out as a whole, since the other rows do not determine their tool.
    """

    kind: str
    count: int
    members: tuple[np.ndarray, ...]
    blind: tuple[str, ...] = ()


def transfer_folds(measured: Sequence[PoseMeasurements], seed: int = 0) -> Folds:
    """Return the most demanding folds that the measurements allow: by station, file, fixture or region.

    Two or more stations: leave one station out (its placement is fitted anew on the held-out rows). Two or more files
    without an instrument: leave one file out. Several fixtures (groups of linked sockets, planes): leave some out. Else
    `REGIONS` regions of the joint space by k-means, in `FOLDS` folds, both fewer where there are few rows.
    """
    stations = {block.station for block in measured if block.has_instrument}
    if len(stations) >= 2 and all(block.has_instrument for block in measured):
        return _folds_of("stations", [block.station for block in measured], measured)
    files = [block.file for block in measured]
    if not stations and len(set(files)) >= 2:
        return _folds_of("files", files, measured)
    if len(measured) == 1 and isinstance(measured[0], Sockets):
        fixtures = _fixtures(measured[0])
        if fixtures is not None:
            return fixtures
    return region_folds(measured, seed=seed)


def _folds_of(kind: str, names: Sequence[str], measured: Sequence[PoseMeasurements]) -> Folds:
    """Return folds that each hold out all blocks of one name; if there are too many names, some share a fold."""
    distinct = list(dict.fromkeys(names))
    count = min(len(distinct), 2 * FOLDS)
    members = []
    for block, name in zip(measured, names):
        members.append(np.full(len(block), distinct.index(name) % count))
    return Folds(kind, count, tuple(members))


def divide(
    folds: Folds, blind: np.ndarray, measured: Sequence[PoseMeasurements], seed: int = 0, scattered: bool = False
) -> Folds:
    """Return the folds with those marked in `blind` (count,) split by region, one fold per region.

    What is left out as a whole has to be predicted by the rest. Where the rest does not determine the tool (it holds
    one orientation, say), errors there say nothing of any model; those on a part, the other part being fitted, do.

    Args:
        scattered: hold out every third row of a region instead of the region, if the other rows do not determine its
            tool.
    """
    members = [np.array(fold) for fold in folds.members]
    count = 0
    for fold in range(folds.count):
        fold_rows = [np.flatnonzero(fold_of_row == fold) for fold_of_row in folds.members]
        parts = [np.zeros(len(rows), dtype=int) for rows in fold_rows]
        if blind[fold]:
            parts = _divided(measured, fold_rows, seed, scattered)
        highest = 0
        for fold_of_row, rows, part in zip(members, fold_rows, parts):
            fold_of_row[rows] = count + part
            highest = max(highest, int(part.max(initial=0)))
        count += 1 + highest
    names = list(folds.blind)
    for block, fold_of_row in zip(measured, folds.members):
        if blind[fold_of_row].any():
            names.append(block.station if block.has_instrument else block.file)
    kind = folds.kind
    if blind.all() and not scattered:
        kind = "regions"
    return Folds(kind, count, tuple(members), tuple(dict.fromkeys(names)))


def _divided(
    measured: Sequence[PoseMeasurements], fold_rows: Sequence[np.ndarray], seed: int, scattered: bool
) -> list[np.ndarray]:
    """Return, for each block, the part of each row of a fold that is divided by region or at random."""
    parts = [np.zeros(0, dtype=int) for _ in measured]
    numbers = [number for number, rows in enumerate(fold_rows) if len(rows)]
    blocks = [take(measured[number], fold_rows[number]) for number in numbers]
    divided = random_folds(blocks, SCATTERED_FOLDS, seed) if scattered else region_folds(blocks, seed=seed)
    for number, part in zip(numbers, divided.members):
        parts[number] = part
    return parts


def region_folds(
    measured: Sequence[PoseMeasurements], regions: int = REGIONS, folds: int = FOLDS, seed: int = 0
) -> Folds:
    """Return folds made of regions of the joint space (k-means on joint values in units of their spread)."""
    from scipy.cluster.vq import kmeans2

    q = np.concatenate([block.q for block in measured])
    spread = q.std(axis=0)
    moving = spread > 1e-9
    scaled = q[:, moving] / spread[moving]
    regions = int(np.clip(len(q) // 12, 2, regions))
    count = min(folds, regions)
    _, region = kmeans2(scaled, regions, rng=seed, minit="++", missing="warn")
    # the largest regions go to different folds
    by_size = np.argsort(-np.bincount(region, minlength=regions))
    rank = np.empty(regions, dtype=int)
    rank[by_size] = np.arange(regions)
    fold = rank[region] % count
    edges = np.cumsum([len(block) for block in measured])[:-1]
    members = [_together(block, rows) for block, rows in zip(measured, np.split(fold, edges))]
    return Folds("regions", count, tuple(members))


def folds_by_name(name: str, measured: Sequence[PoseMeasurements], seed: int = 0) -> Folds:
    """Return folds by name: `transfer_folds`, `region_folds`, ten `random_folds`, or one fold per pose (``poses``).

    Raises:
        UsageError: for another name, or for leaving out each of more than `MAX_SINGLE_POSES` poses.
    """
    if name == "poses" and sum(len(block) for block in measured) > MAX_SINGLE_POSES:
        raise UsageError(f"folds 'poses' hold out each pose once: at most {MAX_SINGLE_POSES} rows; choose 'random'")
    require(name in NAMES, f"folds {name}: expected one of {', '.join(NAMES)}", UsageError)
    if name == "transfer":
        return transfer_folds(measured, seed)
    if name == "regions":
        return region_folds(measured, seed=seed)
    return random_folds(measured, 10 if name == "random" else None, seed)


def random_folds(measured: Sequence[PoseMeasurements], folds: int | None = 10, seed: int = 0) -> Folds:
    """Return random folds by seed: k-fold, or leave-one-out where `folds` is None.

    They ask for interpolation only: on a grid every held-out pose has neighbours among the fitted ones, so that errors
    come out smaller than elsewhere in the workspace. Reflectors of one pose and the two rows of a distance stay
    together.
    """
    members = []
    count = 0
    for number, block in enumerate(measured):
        _, pose = np.unique(block.together, return_inverse=True)
        poses = int(pose.max(initial=-1)) + 1
        block_folds = poses if folds is None else min(folds, poses)
        order = np.random.default_rng([seed, number]).permutation(poses)
        fold = (order % block_folds)[pose]
        members.append(fold)
        count = max(count, int(fold.max(initial=0)) + 1)
    return Folds("poses" if folds is None else "random", count, tuple(members))


def _together(block: PoseMeasurements, fold: np.ndarray) -> np.ndarray:
    """Return the fold of each row, with both rows of a distance in one fold."""
    if not isinstance(block, Distances):
        return fold
    _, first, pair = np.unique(block.group, return_index=True, return_inverse=True)
    return fold[first][pair]


def _fixtures(block: Sockets) -> Folds | None:
    """Return folds of whole fixtures (sockets with known distances form one fixture); None for fewer than three."""
    groups = np.unique(block.group).tolist()
    fixture = dict(zip(groups, groups))
    for first, second, _ in block.links:
        if first in fixture and second in fixture:
            merged = fixture[second]
            for group in groups:
                if fixture[group] == merged:
                    fixture[group] = fixture[first]
    fixtures = sorted(set(fixture.values()))
    if len(fixtures) < 3:
        return None
    count = min(len(fixtures), FOLDS)
    fold = [fixtures.index(fixture[group]) % count for group in block.group.tolist()]
    return Folds("fixtures", count, (np.array(fold),))
