"""Partitions of measurements for cross-validation: by station, file, fixture, or region of the joint space.

A random split of grid data holds out neighbours of what was fitted and flatters every model; these folds ask for
transfer.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.data.poses.measurements import Distances, PoseMeasurements, Sockets, take
from calib.errors import UsageError, require

REGIONS = 20
FOLDS = 5


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
    stations = list(dict.fromkeys(block.station for block in measured if block.has_instrument))
    if len(stations) >= 2 and all(block.has_instrument for block in measured):
        return _folds_of("stations", [block.station for block in measured], measured)
    if not stations and len({block.file for block in measured}) >= 2:
        return _folds_of("files", [block.file for block in measured], measured)
    if len(measured) == 1 and isinstance(measured[0], Sockets) and (fixtures := _fixtures(measured[0])) is not None:
        return fixtures
    return region_folds(measured, seed=seed)


def _folds_of(kind: str, names: Sequence[str], measured: Sequence[PoseMeasurements]) -> Folds:
    """Return folds that each hold out all blocks of one name; if there are too many names, some share a fold."""
    each = list(dict.fromkeys(names))
    count = min(len(each), 2 * FOLDS)
    members = [np.full(len(block), each.index(name) % count) for block, name in zip(measured, names)]
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
    members, count = [np.array(fold) for fold in folds.members], 0
    for fold in range(folds.count):
        inside = [np.flatnonzero(each == fold) for each in folds.members]
        if not blind[fold]:
            new = [np.full(len(rows), 0) for rows in inside]
        else:
            chosen = [(take(block, rows), k) for k, (block, rows) in enumerate(zip(measured, inside)) if len(rows)]
            new = [np.zeros(0, dtype=int) for _ in measured]
            parts = [block for block, _ in chosen]
            divided = random_folds(parts, 3, seed) if scattered else region_folds(parts, seed=seed)
            for (_, k), fresh in zip(chosen, divided.members):
                new[k] = fresh
        for each, rows, fresh in zip(members, inside, new):
            each[rows] = count + fresh
        count += 1 + max(int(fresh.max(initial=0)) for fresh in new)
    names = [
        block.station if block.has_instrument else block.file
        for block, fold in zip(measured, folds.members)
        if blind[fold].any()
    ]
    kind = folds.kind if scattered or not blind.all() else "regions"
    return Folds(kind, count, tuple(members), tuple(dict.fromkeys((*folds.blind, *names))))


def region_folds(
    measured: Sequence[PoseMeasurements], regions: int = REGIONS, folds: int = FOLDS, seed: int = 0
) -> Folds:
    """Return folds made of regions of the joint space (k-means on joint values in units of their spread)."""
    from scipy.cluster.vq import kmeans2

    q = np.concatenate([block.q for block in measured])
    spread = q.std(axis=0)
    scaled = q[:, spread > 1e-9] / spread[spread > 1e-9]
    regions = int(np.clip(len(q) // 12, 2, regions))
    count = min(folds, regions)
    _, label = kmeans2(scaled, regions, rng=seed, minit="++", missing="warn")
    order = {int(old): new for new, old in enumerate(np.argsort(-np.bincount(label, minlength=regions)))}
    fold = np.array([order[int(k)] for k in label]) % count
    members = np.split(fold, np.cumsum([len(block) for block in measured])[:-1])
    return Folds("regions", count, tuple(_whole(block, rows) for block, rows in zip(measured, members)))


def folds_by_name(name: str, measured: Sequence[PoseMeasurements], seed: int = 0) -> Folds:
    """Return folds by name: `transfer_folds`, `region_folds`, ten `random_folds`, or one fold per pose (``poses``).

    Raises:
        UsageError: for another name, or for leaving out each of more than `max_station_poses` poses.
    """
    max_station_poses = 150
    if name == "poses" and sum(len(block) for block in measured) > max_station_poses:
        raise UsageError(f"folds 'poses' hold out each pose once: at most {max_station_poses} rows; choose 'random'")
    ways = {
        "transfer": lambda: transfer_folds(measured, seed),
        "regions": lambda: region_folds(measured, seed=seed),
        "random": lambda: random_folds(measured, 10, seed),
        "poses": lambda: random_folds(measured, None, seed),
    }
    require(name in ways, f"folds {name}: expected one of {', '.join(ways)}", UsageError)
    return ways[name]()


def random_folds(measured: Sequence[PoseMeasurements], folds: int | None = 10, seed: int = 0) -> Folds:
    """Return random folds by seed: k-fold, or leave-one-out where `folds` is None.

    They ask for interpolation only: on a grid every held-out pose has neighbours among the fitted ones, so that errors
    come out smaller than elsewhere in the workspace. Reflectors of one pose and the two rows of a distance stay
    together.
    """
    members = []
    for number, block in enumerate(measured):
        _, unit = np.unique(block.together, return_inverse=True)
        count = int(unit.max(initial=-1)) + 1
        most = count if folds is None else min(folds, count)
        order = np.random.default_rng([seed, number]).permutation(count)
        members.append((order % most)[unit])
    highest = max(int(fold.max(initial=0)) for fold in members) + 1
    return Folds("poses" if folds is None else "random", highest, tuple(members))


def _whole(block: PoseMeasurements, fold: np.ndarray) -> np.ndarray:
    """Return the fold of each row, with both rows of a distance in one fold."""
    if not isinstance(block, Distances):
        return fold
    _, first, inverse = np.unique(block.group, return_index=True, return_inverse=True)
    return fold[first][inverse]


def _fixtures(block: Sockets) -> Folds | None:
    """Return folds of whole fixtures (sockets with known distances form one fixture); None for fewer than three."""
    root = {int(group): int(group) for group in np.unique(block.group)}
    for a, b, _ in block.links:
        if a in root and b in root:
            old, new = root[b], root[a]
            root = {group: new if parent == old else parent for group, parent in root.items()}
    names = sorted(set(root.values()))
    if len(names) < 3:
        return None
    count = min(len(names), FOLDS)
    fold = {group: names.index(parent) % count for group, parent in root.items()}
    return Folds("fixtures", count, (np.array([fold[int(group)] for group in block.group]),))
