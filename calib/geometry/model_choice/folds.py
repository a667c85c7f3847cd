"""Partitions of measurements for cross-validation: by station, file, fixture, or region of the joint space.

With a random split of poses on a grid, held-out poses have fitted neighbours, and every model seems better than it is.
The folds of this module hold out whole groups of poses instead, so that the model must predict other parts of the
workspace.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.data.poses.measurements import Distances, PoseMeasurements, Sockets, take
from calib.errors import UsageError, require

# number of regions of the joint space, and number of folds over which they are distributed (our choice)
REGIONS = 20
FOLDS = 5
# number of random parts of a fold that the other rows do not determine
SCATTERED_FOLDS = 3
# largest number of poses for folds of one pose each
MAX_SINGLE_POSES = 150
NAMES = ("transfer", "regions", "random", "poses")


@dataclass(frozen=True, eq=False)
class Folds:
    """A partition of the rows of all blocks.

    Attributes:
        kind: ``stations``, ``files``, ``fixtures`` or ``regions``; on request ``random`` or ``poses`` (leave-one-out).
        count: number of folds.
        members: for each block, (m,) index of each row's fold, from 0.
        blind: names of stations or files that are not held out as a whole, since the other rows do not determine their
            tool.
    """

    kind: str
    count: int
    members: tuple[np.ndarray, ...]
    blind: tuple[str, ...] = ()


def transfer_folds(measured: Sequence[PoseMeasurements], seed: int = 0) -> Folds:
    """Return the most demanding folds that the measurements allow: by station, file, fixture or region.

    With two or more stations, each fold holds out one station, whose placement is fitted to the held-out rows. With two
    or more files without an instrument, each fold holds out one file. With at least three fixtures (groups of linked
    sockets, planes), each fold holds out some of them. Otherwise `REGIONS` regions of the joint space (k-means) are
    distributed over `FOLDS` folds; both numbers are smaller where there are few rows.

    Args:
        measured: blocks of measurements.
        seed: seed of the clusters of regions.
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
    """Return folds that each hold out all blocks of one name; with too many names, several names share a fold.

    Args:
        kind: kind of the folds, for `Folds.kind`.
        names: name of each block's station or file.
        measured: blocks of measurements.
    """
    distinct = list(dict.fromkeys(names))
    count = min(len(distinct), 2 * FOLDS)
    members = []
    for block, name in zip(measured, names):
        members.append(np.full(len(block), distinct.index(name) % count))
    return Folds(kind, count, tuple(members))


def divide(
    folds: Folds, blind: np.ndarray, measured: Sequence[PoseMeasurements], seed: int = 0, scattered: bool = False
) -> Folds:
    """Return the folds, where each fold marked in `blind` (count,) is split into several by regions of the joint space.

    A fold that is held out as a whole is predicted from the other folds. If these do not determine the tool's placement
    (because they contain only one orientation, for example), the error on this fold does not depend on the quality of
    the model. If only a part of it is held out, and the remaining part is fitted, the error does.

    Args:
        folds: the partition.
        blind: (count,) mask of the folds to split.
        measured: blocks of measurements.
        seed: seed of the regions.
        scattered: True splits at random into three parts, for folds whose regions cannot be predicted either.
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
    """Return, for each block, the part number of each of its rows in a fold that is split by region or at random.

    Args:
        measured: blocks of measurements.
        fold_rows: for each block, the row numbers in the fold.
        seed: seed of regions or random parts.
        scattered: True splits at random, False by region.
    """
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
    """Return folds that consist of regions of the joint space.

    The regions are clusters by k-means on joint values divided by their standard deviations.

    Args:
        measured: blocks of measurements.
        regions: number of regions.
        folds: number of folds; each consists of several regions.
        seed: seed of the clusters.
    """
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
    """Return the folds of a given kind.

    Args:
        name: ``transfer`` (`transfer_folds`), ``regions`` (`region_folds`), ``random`` (ten `random_folds`) or
            ``poses`` (one fold per pose).
        measured: blocks of measurements.
        seed: seed of random choices.

    Raises:
        UsageError: an unknown name, or ``poses`` for more than `MAX_SINGLE_POSES` poses.
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
    """Return random folds: k folds, or leave-one-out where `folds` is None.

    These folds test interpolation only: on a grid of poses, every held-out pose has fitted neighbours, so that errors
    are smaller than elsewhere in the workspace. All reflectors measured at one pose are in the same fold, and so are
    the two rows of a distance.

    Args:
        measured: blocks of measurements.
        folds: number k of folds; None for one fold per pose.
        seed: seed of the draw.
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
    """Return the fold number of each row, with both rows of a distance in the same fold.

    Args:
        block: the measurements.
        fold: (m,) fold number of each row.
    """
    if not isinstance(block, Distances):
        return fold
    _, first, pair = np.unique(block.group, return_index=True, return_inverse=True)
    return fold[first][pair]


def _fixtures(block: Sockets) -> Folds | None:
    """Return folds that hold out whole fixtures; None for fewer than three fixtures.

    Sockets with known distances between them are one fixture.

    Args:
        block: measurements of sockets.
    """
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
