"""Methods compared on recordings: ranked by motion they have not seen, with reasons where one is missing."""

import csv
from pathlib import Path

import numpy as np
import planted_motion as planted
import pytest

from calib.apps.studies.method_comparison import FAST_SECONDS, caveats, compare_methods
from calib.cli import run
from calib.errors import UsageError
from calib.procedure.dynamic_stage.identify import overlaps
from calib.procedure.dynamic_stage.inputs import gather


def recorded(folder: Path, duration: float = 10.0) -> tuple[Path, Path]:
    """Write two recordings [s] with noise on the torques."""
    for name, seed in (("a.npz", 0), ("b.npz", 7)):
        np.savez(folder / name, **planted.series(seed, noise=0.05, duration=duration))
    return folder / "a.npz", folder / "b.npz"


@pytest.mark.slow
def test_methods_are_ranked_by_unseen_motion(robot: Path, tmp_path: Path):
    """What cannot be distinguished is as good; a fast one of these is taken, with the verdict of an identification."""
    train, other = recorded(tmp_path)
    given = gather(robot, [train], [other])
    found = compare_methods(given, ["wls", "ols", "iv"])
    assert [one.rank for one in found] == [1, 2, 0] and "[loop]" in found[2].failure
    assert found[0].unseen <= found[1].unseen
    assert found[0].good and found[0].sigma > 0.0 and found[0].unseen < 10.0
    good = [one for one in found if one.good]
    (taken,) = (one for one in found if one.chosen)
    fast = max(FAST_SECONDS, 2.0 * min(each.seconds for each in good))
    assert taken is next(one for one in good if one.seconds <= fast)
    assert [one for one in found if one.verdict is not None] == [taken] and taken.verdict == "pass"
    assert set(taken.warnings) <= set(caveats(given, found))


@pytest.mark.slow
def test_learnt_motion_ranks_nothing(robot: Path, tmp_path: Path):
    """Samples in both are refused; a copy of the motion under another name, here of other noise, is no evidence."""
    train, other = recorded(tmp_path, 20.0)
    end = float(np.load(train)["t"][-1])
    shared, apart = (
        gather(robot, [f"{train}@0:{part * end:.2f}"], [f"{train}@{0.5 * end:.2f}:"]) for part in (0.6, 0.5)
    )
    assert not overlaps(apart.cases, apart.unseen)
    with pytest.raises(UsageError, match="belong to the training data"):
        compare_methods(shared, ["ols"])
    np.savez(tmp_path / "copy.npz", **(dict(np.load(train)) | {"tau": planted.series(0, noise=0.1)["tau"]}))
    alone, beside = (gather(robot, [train], [tmp_path / "copy.npz", *more]) for more in ([], [other]))
    (found,) = compare_methods(alone, ["ols"])
    assert not found.chosen
    assert "repeat the training motion" in caveats(alone, [found])[-1].text
    (both,), (plain,) = compare_methods(beside, ["ols"]), compare_methods(gather(robot, [train], [other]), ["ols"])
    assert both.chosen and both.unseen == pytest.approx(plain.unseen)
    assert "copy.npz" in caveats(beside, [both])[-1].text


@pytest.mark.slow
def test_no_method_worse_than_no_model(robot: Path, tmp_path: Path):
    """No method is chosen that predicts no better than no model."""
    train, other = recorded(tmp_path)
    content = dict(np.load(other))
    np.savez(other, **(content | {"tau": -content["tau"]}))
    given = gather(robot, [train], [other])
    (found,) = compare_methods(given, ["ols"])
    assert found.unseen > 100.0 and not found.chosen
    assert "add training motion" in caveats(given, [found])[-1].text


@pytest.mark.slow
def test_error_of_one_method_costs_no_other(robot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """One method's error costs no other result."""
    from calib.apps.studies import method_comparison

    def broken(robot, cases, settings, say):
        if settings.method == "tls":
            raise ValueError("array must not contain infs")
        return identify(robot, cases, settings, say)

    identify = method_comparison.identify
    monkeypatch.setattr(method_comparison, "identify", broken)
    train, other = recorded(tmp_path)
    found = compare_methods(gather(robot, [train], [other]), ["tls", "ols"])
    assert [one.name for one in found] == ["ols", "tls"]
    assert "array must not contain infs" in found[1].failure


def test_no_ranking_without_unseen_motion(robot: Path, tmp_path: Path):
    """Without unseen motion there is no ranking."""
    with pytest.raises(UsageError, match="--validate"):
        compare_methods(gather(robot, [recorded(tmp_path)[0]]))


def test_the_command_writes_what_it_shows(
    robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("COLUMNS", "160")
    train, other = recorded(tmp_path)
    words = ["compare", str(robot), str(train), "--validate", str(other), "--methods", "wls,ols"]
    assert run([*words, "--out", str(tmp_path / "methods.csv")]) == 0
    rows = list(csv.DictReader((tmp_path / "methods.csv").open()))
    assert {row["method"] for row in rows} == {"wls", "ols"}
    assert np.isfinite([float(row["unseen_percent"]) for row in rows]).all()
    assert "take" in capsys.readouterr().out
    assert run([*words, "--methods", "wsl"]) == 2
    assert "did you mean 'wls'" in capsys.readouterr().err
    assert run([*words, "--methods", "iv"]) == 2
    assert "[loop]" in capsys.readouterr().err


@pytest.mark.slow
def test_failed_identification_is_not_taken(robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """One joint's torque is doubled in the unseen file: better than no model, and yet none of this robot."""
    train, other = recorded(tmp_path)
    content = dict(np.load(other))
    np.savez(other, **(content | {"tau": content["tau"] * [1.0, 2.0, 1.0]}))
    words = [str(robot), str(train), "--validate", str(other)]
    assert run(["compare", *words, "--methods", "wls,ols"]) == 1
    shown = capsys.readouterr().out
    assert "take │" not in shown and "no method recommended" in shown
    compared = shown[shown.index("verdict: fail") :].splitlines()[0].partition(": ")[2].partition(": ")[2]
    name, _, reason = compared.partition(": ")
    out = ["--method", name, "--friction", "standard", "--no-plots", "--out", str(tmp_path / "out")]
    assert run(["identify", *words, *out]) == 1
    assert f"verdict: fail: {reason}" in capsys.readouterr().out
