"""Methods compared on recordings: ranked by motion they have not seen, with reasons where one is missing."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import planted_motion as planted
import pytest

from calib.cli import run
from calib.errors import UsageError
from calib.procedure.dynamic_stage.inputs import gather
from calib.procedure.dynamic_stage.method_comparison import compare_methods


def recorded(folder: Path) -> tuple[Path, Path]:
    """Write two recordings with noise on the torques."""
    for name, seed in (("a.npz", 0), ("b.npz", 7)):
        np.savez(folder / name, **planted.series(seed, noise=0.05))
    return folder / "a.npz", folder / "b.npz"


def test_methods_are_ranked_by_unseen_motion(robot: Path, tmp_path: Path):
    train, other = recorded(tmp_path)
    given = gather(robot, [train], [other])
    found = compare_methods(given, ["wls", "ols", "iv"])
    ranks = [one.rank for one in found]
    assert ranks == [1, 2, 0]
    assert found[0].unseen <= found[1].unseen
    assert found[0].good and found[0].sigma > 0.0 and found[0].unseen < 10.0
    assert sum(one.chosen for one in found) == 1
    assert "[loop]" in found[2].failure


def test_what_is_not_told_apart_is_as_good_and_a_fast_one_is_taken(robot: Path, tmp_path: Path):
    train, other = recorded(tmp_path)
    found = compare_methods(gather(robot, [train], [other]), ["wls", "ols"])
    good = [one for one in found if one.good]
    (taken,) = (one for one in good if one.chosen)
    assert taken.seconds <= 2.0 * min(one.seconds for one in good)


def test_without_unseen_motion_there_is_no_ranking(robot: Path, tmp_path: Path):
    with pytest.raises(UsageError, match="--validate"):
        compare_methods(gather(robot, [recorded(tmp_path)[0]]))


def test_the_command_writes_what_it_shows(robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    train, other = recorded(tmp_path)
    words = ["compare", str(robot), str(train), "--validate", str(other), "--methods", "wls,ols"]
    assert run([*words, "--out", str(tmp_path / "methods.csv")]) == 0
    rows = list(csv.DictReader((tmp_path / "methods.csv").open()))
    assert {row["method"] for row in rows} == {"wls", "ols"}
    assert np.isfinite([float(row["unseen_percent"]) for row in rows]).all()
    assert "take" in capsys.readouterr().out
    assert run([*words, "--methods", "wsl"]) == 2
    assert "did you mean 'wls'" in capsys.readouterr().err
