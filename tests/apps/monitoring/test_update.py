"""calib update: logs are predicted, then learnt from; what is not as predicted is named and not averaged in."""

import json
import shutil
from pathlib import Path

import numpy as np
import planted_motion as planted
import pytest

import calib
from calib import folders
from calib.apps.monitoring.learning.dynamics_update import DRIFT, LOG_TABLE, DynamicsUpdate
from calib.apps.monitoring.learning.logs import dated
from calib.apps.monitoring.learning.update import update_dynamics
from calib.data.csv_table import read_table
from calib.data.signals.fingerprint import common_share, in_motion, sample_hashes, sketch
from calib.errors import MeasurementError, UsageError
from calib.procedure.report.figures import figure_data
from calib.result_kinds import kind_of
from calib.results.result_classes import open_result
from calib.robot import description

SECONDS = 8.0
SIGN = np.array([0.0, 1.5, 0.0])  # change of Coulomb friction [N m]


@pytest.fixture(scope="module")
def identified(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the planted arm's identification from 20 s."""
    folder = tmp_path_factory.mktemp("update")
    robot = description.write(folder / "planted.toml", planted.arm())
    first = planted.write(folder, "first.npz", 0)
    model = calib.identify_dynamics(robot, first, friction="standard")
    return model.save(folder / "dynamics", plots=False)


def log(folder: Path, date: str, seed: int, torque: np.ndarray | float = 0.0, factor: float = 1.0) -> str:
    """Write a log of 8 s with torques in addition (N, 3) or (3,), times a factor; return its path."""
    series = planted.series(seed, duration=SECONDS)
    path = folder / f"log_{date}.npz"
    np.savez(path, t=series["t"], q=series["q"], tau=factor * (series["tau"] + torque))
    return str(path)


def codes(update: DynamicsUpdate) -> list[str]:
    """Return the codes of an update's findings."""
    return [finding.code for finding in update.noticed]


def test_logs_in_turn_and_together_give_the_same_model(identified: Path, tmp_path: Path):
    logs = [log(tmp_path, f"2026-03-{day:02}", day) for day in (1, 3, 8)]
    together = update_dynamics(identified, logs)
    folder = update_dynamics(identified, logs[:1]).save(tmp_path / "a", plots=False)
    folder = update_dynamics(folder, logs[1:2]).save(tmp_path / "b", plots=False)
    in_turn = update_dynamics(folder, logs[2:])
    assert codes(together) == codes(in_turn) == []
    values, covariance = together.state.bank.posterior()
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose((in_turn.state.bank.posterior()[0] - values) / sigma, 0.0, atol=1e-6)
    assert [record.name for record in in_turn.state.record.logs] == [Path(path).name for path in logs]
    assert in_turn.state.bank.factors.nbytes == together.state.bank.factors.nbytes
    assert "3 of 3 logs" in together.verdict.reason
    assert together.verdict == "not judged"


def test_the_folder_is_an_identification_with_the_values_of_today(identified: Path, tmp_path: Path):
    update = update_dynamics(identified, [log(tmp_path, "2026-03-01", 4), log(tmp_path, "2026-03-02", 5)])
    folder = update.save(tmp_path / "today")
    kind = kind_of(folder)
    assert kind is not None and kind.name == "identification"
    assert open_result(folder).verdict == "not judged"
    assert set(figure_data.of_folder(folder)) == {"drift"}
    assert read_table(folder / DRIFT).numbers("day", None).size == 2
    assert read_table(folder / LOG_TABLE).numbers("seconds", None).size == 2
    written = json.loads((folder / "dynamics.json").read_text())
    values = update.state.model.updated(update.state.bank.posterior()[0]).values
    assert [entry["value"] for entry in written["terms"]] == pytest.approx(
        values[update.state.model.dynamics.model.inertial :]
    )
    assert str(update)


def test_a_parameter_without_variance_stays_at_its_value(identified: Path, tmp_path: Path):
    first = shutil.copytree(identified, tmp_path / "first")
    names, covariance = folders.read_covariance(first)
    fixed = names.index("Fc2")
    covariance[fixed] = covariance[:, fixed] = 0.0
    folders.write_covariance(first / folders.COVARIANCE, names, covariance)
    folder = update_dynamics(first, [log(tmp_path, "2026-03-01", 4)]).save(tmp_path / "today", plots=False)
    value = read_table(first / folders.ESTIMATE).numbers("value", None)[fixed]
    assert value != 0.0
    assert read_table(folder / folders.ESTIMATE).numbers("value", None)[fixed] == value
    factor = np.loadtxt(folder / "information.csv", delimiter=",", skiprows=1)
    assert np.linalg.solve(factor[:, :-1], factor[:, -1])[fixed] == pytest.approx(value)


def test_a_load_that_was_not_stated_is_found_and_not_averaged_in(identified: Path, tmp_path: Path):
    series = planted.series(6, payload=True, duration=SECONDS)
    path = tmp_path / "log_2026-03-05.npz"
    np.savez(path, **series)
    update = update_dynamics(identified, [log(tmp_path, "2026-03-04", 7), str(path)])
    assert codes(update) == ["log-load"]
    mass, sigma = update.noticed[0].values["mass"], update.noticed[0].values["sigma"]
    assert mass == pytest.approx(planted.PAYLOAD[-1], abs=max(3 * sigma, 0.1))
    assert [record.learnt for record in update.logs] == [True, False]
    assert update.verdict == "marginal"


def test_changed_friction_and_a_changed_gain_are_learnt_anew(identified: Path, tmp_path: Path):
    velocity = planted.motion(8, duration=SECONDS)[2]
    update = update_dynamics(identified, [log(tmp_path, "2026-03-05", 8, 3.0 * SIGN * np.sign(velocity))])
    assert codes(update) == ["log-friction"]
    k = [update.state.record.names[index] for index in update.state.drifting].index("Fc2")
    assert update.logs[0].parameters[k] == pytest.approx(planted.DRIVES["Fc"][1] + 4.5, abs=0.3)
    torque = planted.series(9, duration=SECONDS)["tau"] * [0.0, 0.4, 0.0]
    update = update_dynamics(identified, [log(tmp_path, "2026-03-06", 9, torque)])
    assert codes(update) == ["log-gain"]
    assert update.noticed[0].values["factor"] == pytest.approx(1.4, abs=0.02)


def test_torques_in_another_unit_are_not_learnt_from(identified: Path, tmp_path: Path):
    update = update_dynamics(identified, [log(tmp_path, "2026-03-05", 10, factor=10.0)])
    assert codes(update) == ["log-unit"]
    assert update.noticed[0].values["factor"] == pytest.approx(10.0, rel=0.02)


def test_torques_that_no_parameters_explain_weigh_less(identified: Path, tmp_path: Path):
    t = planted.motion(11, duration=SECONDS)[0]
    waves = 12.0 * np.sin(2 * np.pi * 1.7 * t)[:, None] * [1.0, 0.0, 0.0]
    update = update_dynamics(identified, [log(tmp_path, "2026-03-05", 11, waves)])
    assert codes(update) == ["log-motion"]


def test_a_log_of_another_arm_is_not_learnt_from(identified: Path, tmp_path: Path):
    t, q, v, a = planted.motion(12, duration=SECONDS)
    values = planted.truth()
    values[:30] *= np.resize([1.6, 0.5, 1.0, 1.3, 0.7], 30)
    values[30:] *= np.resize([3.0, 0.3, 2.0, -4.0], 12)
    path = tmp_path / "log_2026-03-05.npz"
    np.savez(path, t=t, q=q, tau=planted.model().regressor(q, v, a) @ values)
    update = update_dynamics(identified, [str(path)])
    assert codes(update) == ["log-unknown"]
    assert not update.logs[0].learnt


def test_the_same_log_is_not_counted_twice(identified: Path, tmp_path: Path):
    first = log(tmp_path, "2026-03-05", 13)
    again = tmp_path / "copy_2026-03-09.npz"
    again.write_bytes(Path(first).read_bytes())
    update = update_dynamics(identified, [first, f"{again}@2:6"])
    assert codes(update) == ["log-repeated"]
    once = update_dynamics(identified, [first])
    assert update.state.bank.count == once.state.bank.count


@pytest.mark.slow
def test_logs_are_taken_in_the_order_of_their_dates(identified: Path, tmp_path: Path):
    early, late = log(tmp_path, "2026-03-01", 14), log(tmp_path, "2026-03-09", 15)
    update = update_dynamics(identified, [late, early])
    assert codes(update) == ["logs-out-of-order"]
    folder = update_dynamics(identified, [late]).save(tmp_path / "late", plots=False)
    with pytest.raises(UsageError, match="older than log_2026-03-09"):
        update_dynamics(folder, [early])
    undated = tmp_path / "log_a.npz"
    undated.write_bytes(Path(early).read_bytes())
    with pytest.raises(UsageError, match="name all alike"):
        update_dynamics(folder, [str(undated)])
    assert codes(update_dynamics(identified, [str(undated)])) == ["logs-undated"]


def test_enough_stops_at_the_stated_sigma(identified: Path, tmp_path: Path):
    logs = [log(tmp_path, f"2026-03-{day:02}", 20 + day) for day in (1, 2, 3)]
    update = update_dynamics(identified, logs, enough=90.0)
    assert codes(update) == ["learnt-enough"]
    assert len(update.logs) == 1


def test_half_a_second_at_rest_is_named_and_the_others_are_learnt(identified: Path, tmp_path: Path):
    short = tmp_path / "log_2026-03-02.npz"
    t = np.arange(100) / 200.0
    np.savez(short, t=t, q=np.zeros((100, 3)), tau=np.zeros((100, 3)))
    update = update_dynamics(identified, [str(short), log(tmp_path, "2026-03-03", 16)])
    assert codes(update) == ["log-unreadable"]
    with pytest.raises(MeasurementError):
        update_dynamics(identified, [str(short)])


def test_dates_come_from_the_last_part_of_the_path_that_has_them():
    texts = [entry.date for entry in dated(["2025-01-01/a_20260314.csv@0:5", "x/2026-03-15_1230/b.csv"], 1)]
    assert texts == ["2026-03-14", "2026-03-15 12:30"]
    (unix_time,) = dated(["log_1720201115.csv"], 1)  # no 2020-11-15
    assert not unix_time.date
    with pytest.raises(UsageError, match="no date"):
        dated(["a_2026-03-14.csv", "b.csv"], 1)


def test_a_sketch_recognises_a_part_of_a_log():
    hashes = np.sort(np.random.default_rng(0).integers(0, 2**63, 5000, dtype=np.uint64))
    assert common_share(hashes, sketch(hashes)) == 1.0
    assert common_share(hashes[::2], sketch(hashes)) == pytest.approx(0.5, abs=0.05)
    assert common_share(hashes + np.uint64(1), sketch(hashes)) == 0.0


@pytest.mark.slow
def test_the_log_of_the_identification_is_not_counted_twice(identified: Path, tmp_path: Path):
    series = planted.series(0)
    half = {name: values[: len(values) // 2 : 2] for name, values in series.items()}
    piece = tmp_path / "piece_2026-03-01.npz"
    np.savez(piece, **half)
    table = tmp_path / "table_2026-03-02.csv"
    names = [f"{name}{joint}" for name in ("q", "tau") for joint in (1, 2, 3)]
    columns = np.column_stack([series["t"], series["q"], series["tau"]])
    np.savetxt(table, columns, delimiter=",", header=",".join(["t", *names]), comments="")
    update = update_dynamics(identified, [str(piece), str(table), log(tmp_path, "2026-03-03", 31)])
    assert codes(update) == ["log-repeated", "log-repeated"]
    assert {remark.values["before"] for remark in update.noticed} == {"first.npz"}
    assert [record.learnt for record in update.logs] == [False, False, True]
    again = update_dynamics(
        update.save(tmp_path / "today", plots=False), [str(table.rename(tmp_path / "2026-03-04.csv"))]
    )
    assert codes(again) == ["log-repeated"]


def from_home(folder: Path, date: str, seed: int) -> str:
    """Write a log that rests at home for 2 s, with encoders of two steps, and moves off within 2 s; return its path."""
    t, q, v, a = planted.motion(seed, duration=14.0)
    x = np.clip((t - 2.0) / 2.0, 0.0, 1.0)[:, None]
    w, dw, ddw = x**3 * (10 - 15 * x + 6 * x**2), 15 * x**2 * (1 - x) ** 2, 15 * x * (1 - x) * (1 - 2 * x)
    torque = planted.torques(w * q, dw * q + w * v, ddw * q + 2 * dw * v + w * a)
    position = w * q + 1e-5 * np.random.default_rng(seed).integers(0, 2, q.shape) * (x == 0)
    path = folder / f"log_{date}.npz"
    np.savez(path, t=t, q=np.round(position, 5), tau=np.round(torque, 2))
    return str(path)


@pytest.mark.slow
def test_two_logs_from_the_same_rest_are_two_logs(identified: Path, tmp_path: Path):
    first, second = from_home(tmp_path, "2026-03-05", 13), from_home(tmp_path, "2026-03-06", 14)
    series = [np.load(path) for path in (first, second)]
    hashes = [sample_hashes([log["q"], log["tau"]]) for log in series]
    assert len(np.intersect1d(*hashes)) >= 8  # at home
    again = shutil.copy(first, tmp_path / "log_2026-03-07.npz")
    update = update_dynamics(identified, [first, second, f"{again}@6:11"])
    assert codes(update) == ["log-repeated"]
    assert [record.learnt for record in update.logs] == [True, True, False]


def test_few_common_samples_in_a_large_sketch_are_chance():
    hashes = np.arange(512, dtype=np.uint64)
    assert common_share(hashes[:5], hashes) == 0.0  # below 1 %
    assert common_share(hashes[:6], hashes) == pytest.approx(6 / 512)
    assert common_share(hashes[:4], sketch(hashes)) == 0.0


def test_an_arm_that_never_moves_has_no_samples_to_be_recognised_by():
    t = np.arange(500) / 100.0
    assert not in_motion(t, np.full((500, 2), 0.3)).any()
    assert in_motion(t, np.column_stack([t, 0.0 * t]))[20:-20].all()
    empty = sample_hashes([np.empty((0, 2)), np.empty((0, 2))])
    assert common_share(sketch(empty), sketch(empty)) == 0.0


def test_a_log_older_than_the_identification_is_not_learnt_from(identified: Path, tmp_path: Path):
    folder = shutil.copytree(identified, tmp_path / "first")
    recordings = folder / "recordings.json"
    recordings.write_text(recordings.read_text().replace("first.npz", "first_2026-03-05.npz"))
    logs = [log(tmp_path, f"2026-03-{day:02}", day) for day in (4, 5)]
    update = update_dynamics(folder, logs)
    assert codes(update) == ["log-older"]
    assert update.noticed[0].values["before_date"] == "2026-03-05"
    assert [record.name for record in update.logs] == ["log_2026-03-05.npz"]
    with pytest.raises(UsageError, match="older than first_2026-03-05"):
        update_dynamics(folder, logs[:1])
