"""Studies: what a file may say, trials that are pure, summaries that count failures."""

from dataclasses import asdict, replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from study_rows import ROW

from calib.apps.studies.conditions import Condition, Study, read_study, shipped
from calib.apps.studies.experiment import ACCELERATION, REACH, SPEED, data_set, make_experiment, set_up
from calib.apps.studies.report import condition_table
from calib.apps.studies.run import _missing
from calib.apps.studies.store import opened
from calib.apps.studies.summary import MIN_DATA_SETS, sign_test, summarise
from calib.apps.studies.trial import FOUND, NOT_RECORDED, TrialRow, run_trial
from calib.errors import UsageError
from calib.identification.registry import VERSIONS
from calib.procedure.report.page import rendered

FILE = """
name = "small"
robot = "rv2sq"
methods = ["wls", "iv"]
runs = 3
runs_loop = 2
duration = 2.0
[[noise]]
name = "1"
sigma_q = "1e-4 deg"
sigma_tau = 0.05
"""
SHORT = Condition("short", "rv2sq", np.deg2rad(1e-4), 0.05, duration=2.0, resimulated=0)


def written(folder: Path, text: str = FILE) -> Path:
    path = folder / "small.toml"
    path.write_text(text)
    return path


@pytest.fixture
def small(tmp_path: Path) -> tuple[Study, TrialRow]:
    """Return the small study, and a row of its one condition."""
    study = read_study([written(tmp_path)])
    return study, replace(ROW, digest=study.conditions[0].digest)


def test_the_surveys_conditions_are_there():
    study = read_study(["MCS-*"])
    names = {one.name for one in study.conditions}
    assert names == {f"MCS-{robot}-{n}" for robot in ("TX40-1", "TX40-4", "RV2SQ-1") for n in range(1, 6)}
    assert all(runs["wls"] == 100 and runs["iv"] == 30 for runs in study.runs)
    assert len({one.digest for one in study.conditions}) == 15
    fifth = next(one for one in study.conditions if one.name == "MCS-TX40-4-5")
    assert (fifth.decimation, fifth.sigma_tau) == (4, 0.1)
    assert fifth.sigma_q == pytest.approx(np.deg2rad(1e-2))


def test_shipped_studies_named_as_files():
    """Every shipped study is named as its file."""
    assert all(read_study([name]).name == name for name in shipped())


def test_combinations_named_by_what_varies(tmp_path: Path):
    """Combinations are named by what varies."""
    text = FILE.replace('"rv2sq"', '["tx40", "rv2sq"]').replace("runs = 3", 'runs = 3\nmismatch = ["none", "clock"]')
    names = [one.name for one in read_study([written(tmp_path, text)]).conditions]
    assert names == ["small-tx40-none", "small-tx40-clock", "small-rv2sq-none", "small-rv2sq-clock"]


def test_name_is_no_part_of_condition():
    """What a condition is called is no part of what it is."""
    assert SHORT.digest == replace(SHORT, name="other", resimulated=5).digest
    assert SHORT.digest != replace(SHORT, sigma_tau=0.06).digest


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"iv"]', '"ivv"]', "there is no method 'ivv' .did you mean 'iv'"),
        ("runs_loop", "runs_lop", "no key 'runs_lop' .did you mean 'runs_loop'"),
        ("[[noise]]", "[noise]", "noise"),
        ("runs_loop", 'motion = "design"\nruns_loop', "did you mean 'designed'"),
        ("runs_loop", "guesses = 0\nruns_loop", "guesses"),
        ("runs_loop", "rate = 90\nruns_loop", "expected less than 45 Hz, half the rate of the rv2sq's log"),
        ('"1e-4 deg"', "30.0", "at most 0.1"),
        ('"rv2sq"', '"rv2"', "did you mean 'rv2sq'"),
        ("duration", "cutoff = 70\nduration", "expected less than 70 Hz, half the rate of the rv2sq's log"),
        ('"1e-4 deg"', '"-1e-4 deg"', "sigma_q: expected 0 or more, found '-1e-4 deg'"),
        ("[[noise]]", '[[noise]]\nname = "1"\nsigma_q = 0\nsigma_tau = 0\n[[noise]]', "are named 'small-1'"),
    ],
)
def test_a_file_that_is_no_study_is_told_why(tmp_path: Path, old: str, new: str, said: str):
    with pytest.raises(UsageError, match=said):
        read_study([written(tmp_path, FILE.replace(old, new))])


def test_unknown_study_is_told_neighbour():
    """A study that does not ship is told its neighbour."""
    with pytest.raises(UsageError, match="did you mean 'MCS-TX40-1-1'"):
        read_study(["MCS-TX40-11"])


def forget() -> None:
    """Forget the data sets that were made."""
    make_experiment.cache_clear()
    data_set.cache_clear()


def test_start_values_run_from_each_guess(tmp_path: Path):
    """Methods without start values run once per data set: their estimate would be the same."""
    study = read_study([written(tmp_path, FILE.replace('"iv"]', '"hopfield"]\nguesses = 3'))])
    with opened(tmp_path / "out") as store:
        tasks = list(_missing(study, store))
    seeds = {name: [one.seed for one in tasks if name in one.methods] for name in ("wls", "hopfield")}
    assert seeds == {"wls": [0, 3, 6], "hopfield": list(range(9))}


@pytest.mark.slow
def test_guesses_are_same_for_every_data_set():
    """Guesses are the same for every data set."""
    one, two, three = (make_experiment(replace(SHORT, guesses=2), seed).problem for seed in range(3))
    assert one.rows is two.rows and not np.array_equal(one.rows[0].target, three.rows[0].target)
    assert one.start is not None and np.array_equal(one.start, np.asarray(three.start))
    assert not np.array_equal(one.start, np.asarray(two.start))


def test_first_of_several_guesses_compared(small):
    """A method that is worse from other guesses has a larger median, and the same p."""
    (study, row), p = small, []
    for guesses, others in ((1, ()), (3, (1, 2))):
        condition = replace(study.conditions[0], guesses=guesses)
        own = [replace(row, digest=condition.digest, seed=guesses * k, torque_error=1.0 + k) for k in range(9)]
        more = [replace(one, method="iv", torque_error=0.9 * one.torque_error) for one in own]
        more += [replace(one, seed=one.seed + k, torque_error=99.0) for one in more for k in others]
        (found,) = summarise(replace(study, conditions=(condition,)), [*own, *more])
        p.append({one.method: one.p for one in found.methods if one.method == "wls" or others})
    assert p[1]["iv"] == p[0]["wls"] < 0.05


@pytest.mark.parametrize("robot", ["tx40", "rv2sq"])
def test_designed_motions_keep_limits(robot: str):
    """Designed motions keep the limits of random ones."""
    setup = set_up(replace(SHORT, robot=robot, duration=10.0, motion="designed"))
    (lower, upper), motion = setup.chain.sampling_limits(), setup.reference
    inside = 0.5 * (1.0 - REACH) * (upper - lower)
    assert (motion.q >= lower + inside).all() and (motion.q <= upper - inside).all()
    assert (np.abs(motion.v) <= SPEED * np.array([joint.velocity for joint in setup.chain.joints])).all()
    assert np.abs(motion.a).max() <= ACCELERATION
    assert np.allclose([motion.v[0], motion.a[0]], 0.0, atol=1e-9)


def test_a_log_has_the_rate_that_is_stated():
    (case,) = make_experiment(replace(SHORT, rate=50.0, cutoff=20.0), 0).problem.cases
    assert case.motion.rate == pytest.approx(50.0)


def test_a_trial_is_pure():
    """Same condition, method and seed: the same row but for the times, whatever ran before; another seed: another."""
    first = run_trial(SHORT, "wls", 3)
    other = run_trial(SHORT, "wls", 4)
    forget()
    again = run_trial(SHORT, "wls", 3)
    timeless = [{k: v for k, v in asdict(row).items() if k not in ("seconds", "cpu")} for row in (first, again)]
    assert str(timeless[0]) == str(timeless[1])
    assert first.status == FOUND
    assert first.torque_error != other.torque_error
    assert first.torque_error < 2.0


def test_unrecordable_loop_is_a_row(monkeypatch: pytest.MonkeyPatch):
    """An unstable controller is counted, and ends nothing."""
    from calib.apps.studies import experiment

    stiff = experiment.published_controller("rv2sq").scaled(100.0)
    monkeypatch.setattr(experiment, "published_controller", lambda name: replace(stiff, limit=np.full(6, np.inf)))
    forget()
    row = run_trial(SHORT, "wls", 0)
    forget()
    assert row.status == NOT_RECORDED
    assert row.message


def test_failures_count_against_a_method(small):
    study, row = small
    good = [replace(row, method="wls", seed=k, torque_error=1.0, cpu=9.0) for k in range(20)]
    risky = [replace(row, method="iv", seed=k, torque_error=0.1, cpu=1.0) for k in range(18)]
    lost = [replace(row, method="iv", seed=k, status="diverged") for k in (18, 19)]
    (one,) = summarise(study, [*good, *risky, *lost])
    assert [method.method for method in one.methods] == ["wls", "iv"]
    assert one.chosen is not None and one.chosen.method == "wls"
    assert one.methods[1].failures == {"diverged": 2}


def test_cheapest_of_equal_methods_is_taken(small):
    """The cheap one of methods that are as good as each other is taken."""
    (study, row), rng = small, np.random.default_rng(0)
    found = []
    for seed in range(30):
        own = float(rng.lognormal())
        found.append(replace(row, method="iv", seed=seed, torque_error=own, cpu=5.0))
        found.append(replace(row, method="wls", seed=seed, torque_error=1.01 * own, cpu=1.0))
    (one,) = summarise(study, found)
    assert one.chosen is not None and one.chosen.method == "wls"
    found = [replace(row, torque_error=1.2 * row.torque_error) if row.method == "wls" else row for row in found]
    (one,) = summarise(study, found)
    assert one.chosen is not None and one.chosen.method == "iv"  # always larger by a fifth: told apart


def test_rows_beyond_the_study_stay_in_sight(tmp_path: Path):
    """A method that was added alone, or taken out of the file, leaves the others' rows in the summary."""
    study = read_study([written(tmp_path)], ["tls"])
    row = replace(ROW, digest=study.conditions[0].digest)
    found = [
        replace(row, method=name, seed=k, version=f"0.1.0 method {VERSIONS[name]}")
        for name in ("tls", "wls")
        for k in (0, 1)
    ]
    (one,) = summarise(study, found)
    assert {method.method for method in one.methods} == {"tls", "wls"}


def test_where_none_is_taken_it_is_said_why(small):
    study, row = small
    few = [replace(row, seed=k) for k in range(MIN_DATA_SETS - 1)]
    (one,) = summarise(study, few)
    assert one.best is None and f"--runs {MIN_DATA_SETS}" in one.why_none
    (one,) = summarise(study, [replace(row, status="diverged") for row in [*few, replace(few[0], seed=99)]])
    assert one.best is None and "gives an estimate" in one.why_none
    (one,) = summarise(study, [*few, replace(few[0], seed=99)])
    assert one.best is one.chosen and not one.why_none


def test_a_terminal_shows_figures_whole(small):
    study, row = small
    found = [replace(row, seed=k, torque_error=0.00123 * (k + 1)) for k in range(9)]
    text = StringIO()
    Console(width=100, file=text).print(*rendered([condition_table(summarise(study, found)[0])]))
    assert "0.00369–0.00861" in text.getvalue()


def test_the_sign_test_is_the_binomial_one():
    one = dict.fromkeys(range(10), 2.0)
    other = {seed: 1.0 if seed < 9 else 3.0 for seed in range(10)}
    assert sign_test(one, other) == pytest.approx(2 * (1 + 10) / 2**10)
    assert sign_test(dict.fromkeys(range(5), 2.0), other) == 1.0  # too few to tell
