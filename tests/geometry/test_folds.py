"""Folds: a partition of the rows that keeps together what belongs together."""

from dataclasses import replace

import numpy as np
import pytest
from planted import cell, load, measure

from calib.data.poses.measurements import PoseMeasurements, Sockets, take
from calib.errors import UsageError
from calib.geometry.model_choice.folds import Folds, folds_by_name, random_folds, region_folds, transfer_folds


@pytest.fixture(scope="module")
def truth():
    return cell(load("ur5"), 0, ("a", "b", "c"))


def assert_partition(folds: Folds, measured) -> None:
    """Every row is in exactly one fold, every fold has rows, and none has them all."""
    assert len(folds.members) == len(measured)
    assert [len(members) for members in folds.members] == [len(block) for block in measured]
    counts = np.bincount(np.concatenate(folds.members), minlength=folds.count)
    assert len(counts) == folds.count >= 2
    assert counts.min() > 0 and counts.max() < counts.sum()


def parted(measured, kind: str, count: int | None = None) -> Folds:
    """Return the most demanding folds: a partition of this kind."""
    folds = transfer_folds(measured)
    assert folds.kind == kind and count in (None, folds.count)
    assert_partition(folds, measured)
    return folds


@pytest.mark.parametrize("count", [30, 60, 300, 1000])
def test_regions_are_balanced_partition(truth, count):
    """Regions are a partition of any size, and none dominates."""
    folds = parted([measure(truth, "position", count, 1)], "regions")
    assert np.bincount(folds.members[0]).max() < (0.7 if count < 60 else 0.4) * count


def test_regions_are_regions(truth):
    """Rows of one region stand nearer to each other than to rows of other folds: a random split would not."""
    measured = [measure(truth, "position", 400, 2)]
    q = measured[0].q / measured[0].q.std(axis=0)
    distance = np.linalg.norm(q[:, None] - q[None], axis=2) + 1e9 * np.eye(400)
    nearest = distance.argmin(axis=1)
    fold = region_folds(measured).members[0]
    together = np.mean(fold == fold[nearest])
    shuffled = np.random.default_rng(0).permutation(fold)
    assert together > 2 * np.mean(shuffled == shuffled[nearest])


def test_the_seed_repeats_the_regions(truth):
    measured = [measure(truth, "position", 200, 3)]
    one, same, other = (region_folds(measured, seed=s).members[0] for s in (1, 1, 2))
    assert np.array_equal(one, same) and not np.array_equal(one, other)


def test_stations_are_kept_whole(truth):
    """Stations are kept whole, each in a fold of its own."""
    measured = [measure(truth, "position", 20 + 5 * k, k, station=k) for k in range(3)]
    measured.append(replace(measure(truth, "pose", 15, 9, station=1), file="again"))
    folds = parted(measured, "stations", 3)
    first = [members[0] for members in folds.members]
    assert all(len(set(members)) == 1 for members in folds.members)
    assert first[1] == first[3] and len(set(first[:3])) == 3


def test_lone_station_is_split_by_regions(truth):
    """One station or fixture cannot be left out, so regions are."""
    parted([measure(truth, "position", 40, 1), measure(truth, "pose", 40, 2)], "regions")
    parted([sockets(1)], "regions")


def assert_pairs_together(folds: Folds, block) -> None:
    assert all(len(set(folds.members[0][block.group == pair])) == 1 for pair in np.unique(block.group))


def test_rows_of_a_distance_stay_together(truth):
    """The two rows of a distance stay together."""
    measured = [measure(truth, "distance", 120, 1), measure(truth, "position", 50, 2)]
    measured[0] = take(measured[0], np.random.default_rng(0).permutation(120))
    assert_pairs_together(parted(measured, "regions"), measured[0])


def sockets(fixtures: int, file: str = "one", linked: bool = True) -> PoseMeasurements:
    """Return rows in shuffled order, two sockets per fixture."""
    group = np.random.default_rng(1).permutation(np.repeat(np.arange(2 * fixtures), 8))
    links = tuple((2 * k, 2 * k + 1, 0.05) for k in range(fixtures)) if linked else ()
    q = np.random.default_rng(2).normal(size=(len(group), 3))
    return Sockets(q, ("a", "b", "c"), group=group, links=links, file=file)


@pytest.mark.parametrize("fixtures", [3, 5, 8])
def test_fixtures_stay_whole(fixtures):
    """Fixtures stay whole, with both sockets of a known distance."""
    measured = sockets(fixtures)
    folds = parted([measured], "fixtures", min(fixtures, 5))
    for k in range(fixtures):
        assert len(set(folds.members[0][np.isin(measured.group, [2 * k, 2 * k + 1])])) == 1


def test_lone_sockets_are_left_out_singly():
    """Sockets without links are left out one by one."""
    parted([sockets(2, linked=False)], "fixtures", 4)


def test_files_are_left_out_one_by_one():
    """Files without an instrument are left out one by one."""
    folds = parted([sockets(2, name) for name in "xyz"], "files", 3)
    assert all(len(set(members)) == 1 for members in folds.members)


@pytest.mark.parametrize("kind", ["position", "distance"])
def test_random_folds_repeat_by_seed(truth, kind):
    """Random folds are a partition that the seed repeats."""
    measured = [measure(truth, kind, 60, 1)]
    folds = random_folds(measured, 10, seed=3)
    assert_partition(folds, measured)
    assert folds.count == 10
    assert np.array_equal(folds.members[0], random_folds(measured, 10, seed=3).members[0])
    assert not np.array_equal(folds.members[0], random_folds(measured, 10, seed=4).members[0])
    if kind == "distance":
        assert_pairs_together(folds, measured[0])


def test_single_poses_are_left_out_of_few(truth):
    """Leaving out one pose leaves out each once, and only of few."""
    measured = [measure(truth, "position", 40, 1)]
    folds = folds_by_name("poses", measured)
    assert folds.count == 40 and sorted(folds.members[0]) == list(range(40))
    with pytest.raises(UsageError, match="choose 'random'"):
        folds_by_name("poses", [measure(truth, "position", 200, 1)])
    with pytest.raises(UsageError, match="transfer, regions, random, poses"):
        folds_by_name("kfold", measured)
