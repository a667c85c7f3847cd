"""Drift with time and temperature, from poses measured more than once."""

from dataclasses import replace

import numpy as np
import pytest

from calib import cli
from calib.apps.monitoring import drift_page
from calib.apps.monitoring.settings import DriftSettings
from calib.errors import UsageError
from calib.procedure.findings import level_of
from calib.procedure.session.drift import trends
from calib.robot.library import load_calibrated
from calib.simulation.cell import measure, wandering, write_measured
from calib.simulation.virtual_cells import perturbed_cell

MOVES = 4e-4  # over the measurement [m]
HOURS = 0.5


@pytest.fixture(scope="module")
def cell():
    return perturbed_cell(load_calibrated("ur5").chain, seed=1)


def measured(cell, folder, moves, seed=2, columns=("time [min]",), start=0.0):
    """Write a series of 46 rows, three poses of it measured three times, with columns of time and temperature."""
    q = np.random.default_rng(seed).uniform(-2.0, 2.0, (40, 6))
    q = np.concatenate([q[:20], q[:3], q[20:], q[:3]])
    path = write_measured(wandering(measure(cell, q, seed=seed), moves, seed), folder / f"{seed}_{moves}_{start}.csv")
    shares = np.linspace(0.0, 1.0, len(q))
    more = {"time [min]": start + 60.0 * HOURS * shares, "temp_air": 20.0 + 2.0 * shares}
    header, *rows = path.read_text().splitlines()
    lines = [",".join([header, *columns])]
    lines += [",".join([row, *(f"{more[name][k]:.6g}" for name in columns)]) for k, row in enumerate(rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_planted_drift_is_found_with_slope(cell, tmp_path):
    """A planted drift is found with its slope."""
    path = measured(cell, tmp_path, MOVES, columns=("time [min]", "temp_air"))
    found = drift_page.drift("ur5", [path], DriftSettings(sigma=6e-5))
    time, warmth = found.trends
    assert (time.column, time.unit, warmth.column, warmth.unit) == ("time", "h", "temp_air", "°C")
    assert abs(time.size - MOVES / HOURS) < 4.0 * time.sigma < 0.6 * time.size
    assert warmth.total == pytest.approx(time.total, rel=1e-3) and found.verdict == "marginal"
    assert {each.code for each in found.noticed} == {"target-drifts", "poses-moved"}


def test_drift_within_tolerance_is_a_note(cell, tmp_path):
    """A drift within the tolerance is a note."""
    path = measured(cell, tmp_path, MOVES)
    found = drift_page.drift("ur5", [path], DriftSettings(sigma=6e-5, tolerance=1e-3))
    assert [level_of(one) for one in found.noticed if one.code == "target-drifts"] == ["note"]
    assert found.verdict == "pass"


@pytest.mark.parametrize("seed", range(4))
def test_noise_is_no_drift(cell, tmp_path, seed):
    found = drift_page.drift("ur5", [measured(cell, tmp_path, 0.0, seed)], DriftSettings(sigma=6e-5))
    assert [one.code for one in found.noticed] == ["poses-repeat"] and found.trends[0].size < 4.0 * found.trends[
        0
    ].sigma


def test_time_starting_anew_is_no_clock(cell, tmp_path):
    """A time that starts anew in each file is no clock."""
    first = measured(cell, tmp_path, MOVES)
    late, restarted = (measured(cell, tmp_path, MOVES, start=start) for start in (60.0, 1.0))
    assert drift_page.drift("ur5", [first, late]).trends
    assert not drift_page.drift("ur5", [first, restarted]).trends


def test_dates_are_times(cell, tmp_path):
    path = measured(cell, tmp_path, MOVES)
    header, *rows = path.read_text().splitlines()
    cells = [row.rpartition(",") for row in rows]
    dated = [
        f"{head},2026-11-27 10:{int(float(last)):02d}:{60.0 * (float(last) % 1.0):06.3f}" for head, _, last in cells
    ]
    path.write_text("\n".join([header.replace("time [min]", "timestamp"), *dated]) + "\n")
    (found,) = drift_page.drift("ur5", [path]).trends
    assert found.span == pytest.approx(HOURS, rel=1e-3)


def test_drift_needs_repeated_poses(cell, tmp_path):
    """Without repeated poses nothing is said."""
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (20, 6))
    path = write_measured(measure(cell, q, seed=1), tmp_path / "once.csv")
    with pytest.raises(UsageError, match="no pose was measured twice"):
        drift_page.drift("ur5", [path])
    block = measure(cell, q, seed=1)
    assert trends(cell.nominal, [replace(block, file="none.csv")]) == []


def test_command_writes_page_table_figure(cell, tmp_path, capsys):
    """The command writes page, table and figure."""
    path = measured(cell, tmp_path, MOVES)
    assert (
        cli.run(["drift", "ur5", str(path), "--sigma", "0.06", "--plots", "svg", "--out", str(tmp_path / "out")]) == 0
    )
    assert "the target drifts with time by" in capsys.readouterr().out
    assert {"report.html", "trends.csv", "metrics.json", "plot_drift.svg"} == {
        each.name for each in (tmp_path / "out").iterdir()
    }
