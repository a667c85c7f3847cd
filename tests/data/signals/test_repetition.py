"""Where a motion is new, and where recordings repeat it."""

from dataclasses import dataclass

import numpy as np
import pytest

from calib.data.signals.repetition import Course, course

RATE = 200.0
PERIOD = 4.0


@dataclass
class Path:
    """What the course of a recording needs."""

    q: np.ndarray
    rate: float = RATE

    def __len__(self) -> int:
        return len(self.q)

    def standstill(self) -> np.ndarray:
        speed = np.abs(np.gradient(self.q, axis=0))
        return (speed <= 0.01 * speed.max(axis=0)).all(axis=1)


def periods(seconds: float, seed: int = 0, period: float = PERIOD, rate: float = RATE, noise: float = 1e-5) -> Path:
    """Return periods of a motion of three joints."""
    random = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 1.0 / rate)
    phase = 2.0 * np.pi * random.uniform(size=(5, 3))
    size = random.normal(size=(5, 3)) / np.arange(1, 6)[:, None]
    angle = 2.0 * np.pi / period * t[:, None, None] * np.arange(1, 6)[:, None] + phase
    return Path((size * np.sin(angle)).sum(axis=1) + noise * random.normal(size=(len(t), 3)), rate)


def new_share(paths: list[Path]) -> float:
    fresh = np.concatenate(course(paths).fresh)
    return float(fresh.mean())


@pytest.mark.parametrize("rate", [50.0, 200.0, 1000.0])
@pytest.mark.parametrize("count", [1.5, 2, 7.25])
def test_periods_are_repetitions_of_the_first(count: float, rate: float) -> None:
    """Every later period is mapped to the first one, at any rate, also where the last is not whole."""
    path = periods(count * PERIOD, rate=rate)
    result = course([path])
    assert new_share([path]) == pytest.approx(1.0 / count, rel=0.02)
    samples = np.arange(len(path))
    expected = samples % round(PERIOD * rate)
    step = max(1, int(rate / 100.0))
    assert np.abs(result.course_index[0] - expected // step).max() <= 1


def test_way_to_the_start_is_new() -> None:
    """A way to the start and a rest before it, as in every log, do not hide the periods."""
    path = periods(4 * PERIOD)
    way = np.linspace(0.0, 1.0, 600)[:, None] * path.q[0]
    log = Path(np.concatenate([np.zeros((300, 3)), way, path.q]))
    fresh = course([log]).fresh[0]
    assert fresh[: 900 + round(PERIOD * RATE)].mean() > 0.95
    assert fresh[950 + round(PERIOD * RATE) :].mean() < 0.02


@pytest.mark.parametrize("seed", range(6))
def test_other_motion_is_new(seed: int) -> None:
    """Sums of sines without common period repeat nothing."""
    assert new_share([periods(20.0, seed, period=23.0), periods(20.0, seed + 10, period=23.0)]) == 1.0


def test_rest_is_no_repetition() -> None:
    """Rests at one place before and after a motion leave it new."""
    q = periods(10.0, period=11.0).q
    rest = np.zeros((1500, 3))
    log = Path(np.concatenate([rest, q * np.sin(np.linspace(0.0, np.pi, len(q)))[:, None], rest]))
    fresh = course([log]).fresh[0]
    assert fresh[1500:-1500].all()


def test_recording_of_the_same_motion_is_a_repetition() -> None:
    """A second recording of the motion, begun later, is mapped to the first; what is beyond it is new."""
    long = periods(12.0, period=30.0)
    later = Path(periods(16.0, period=30.0, noise=0.0).q[round(3.3 * RATE) :])
    result = course([long, later])
    assert result.fresh[0].all()
    repeated = round((12.0 - 3.3) * RATE)
    assert result.fresh[1][:repeated].mean() < 0.01
    assert result.fresh[1][repeated + 5 :].all()
    assert np.abs(result.course_index[1][:1000:2] - result.course_index[0][round(3.3 * RATE) :][:1000:2]).max() <= 1


def test_rates_that_differ_by_rounding_are_alike() -> None:
    """Rates are estimated from time stamps: those of one controller differ in the fifth digit."""
    first = periods(2 * PERIOD)
    second = Path(first.q, RATE * (1.0 + 1e-5))
    assert new_share([first, second]) == pytest.approx(0.25, rel=0.02)


def test_long_recording_is_searched_for_short_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer samples are read of long recordings, and then of those beside them, too."""
    monkeypatch.setattr("calib.data.signals.repetition.MAX_SAMPLES", 800)
    motion = periods(24.0, period=30.0)
    assert course([motion, Path(motion.q[1000:2200])]).fresh[1].mean() < 0.02


def test_rests_in_two_postures_are_new() -> None:
    """Recordings in which no joint moves repeat nothing, though every lag explains them."""
    assert not course([Path(np.zeros((100, 3))), Path(np.ones((100, 3)))]).repeats


def test_blocks_of_recordings_that_repeat_one() -> None:
    """However often a motion was recorded, it is divided."""
    blocks = course([periods(2 * PERIOD) for _ in range(8)]).blocks(6)
    assert [set(block) for block in blocks] == [set(range(6))] * 8


@pytest.mark.parametrize("seed", range(6))
def test_ways_to_the_start_do_not_hide_a_repetition(seed: int) -> None:
    """Recordings of a motion that begin at other postures repeat it but for the way to its start."""
    random = np.random.default_rng(seed)
    motion = periods(10.0, seed, period=23.0).q
    rise = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 300))[:, None]
    postures = random.normal(size=(3, 3))
    logs = [Path(np.concatenate([posture + (motion[0] - posture) * rise, motion])) for posture in postures]
    result = course(logs)
    for fresh in result.fresh[1:]:
        assert fresh[:200].mean() > 0.9
        assert fresh[320:].mean() < 0.01
    blocks = result.blocks(6)
    assert set(blocks[1][320:]) <= set(blocks[0])


def test_a_few_new_samples_are_no_block() -> None:
    """A disturbance of a tenth of a second in a repetition belongs to a block of other motion."""
    motion = periods(2 * PERIOD).q
    logs = [Path(motion)]
    for begin in (300, 500, 700):
        disturbed = motion.copy()
        disturbed[begin : begin + 20] += 1.0
        logs.append(Path(disturbed))
    result = course(logs)
    # of lags by whole periods, that of the whole recording is taken, though the disturbance is in its overlap
    assert [int(fresh.sum()) for fresh in result.fresh] == pytest.approx([800, 20, 20, 20], abs=4)
    sizes = np.bincount(np.concatenate(result.blocks(6)))
    assert len(sizes) == 6
    assert sizes.min() > 0.8 * sizes.mean()


def test_blocks_hold_all_repetitions() -> None:
    """Blocks divide one period; every block contains that part of each period."""
    path = periods(4 * PERIOD)
    (block,) = course([path]).blocks(5)
    assert set(block) == set(range(5))
    of_periods = block.reshape(4, -1)
    assert (of_periods == of_periods[0]).mean() > 0.99
    assert (np.diff(of_periods[0]) >= 0).all()


def test_without_repetition_blocks_are_contiguous() -> None:
    first, second = Course.without_repetition([60, 30]).blocks(6)
    assert (first == np.arange(60) // 15).all()
    assert (second == 4 + np.arange(30) // 15).all()


def test_joints_at_rest_and_no_motion_at_all() -> None:
    """Recordings in which nothing moves are new."""
    assert course([Path(np.zeros((100, 3)))]).fresh[0].all()
