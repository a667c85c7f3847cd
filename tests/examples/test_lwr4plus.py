"""The scripted LWR4+ study runs, and says what it says."""

import json
import subprocess
import sys
from pathlib import Path

import blocks
import numpy as np
import pytest

from calib.simulation import lwr4plus

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs/tutorials/lwr_study.md"


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """What the study prints, and its folder."""
    out = tmp_path_factory.mktemp("study")
    script = ROOT / "examples/lwr4plus/geometry.py"
    done = subprocess.run([sys.executable, script, "--out", out, "--quick"], capture_output=True, text=True, check=True)
    return done.stdout, out


@pytest.fixture(scope="module")
def metrics(study: tuple[str, Path]) -> dict:
    return json.loads((study[1] / "metrics.json").read_text())


def test_page_shows_what_it_prints(study: tuple[str, Path]) -> None:
    """The tutorial's slow block is this command, and shows what it prints."""
    (block,) = [block for block in blocks.read(PAGE.read_text(encoding="utf-8")) if "geometry.py" in block.code]
    assert block.code.split() == ["python", "examples/lwr4plus/geometry.py", "--quick", "--out", "geometry"]
    assert len(block.expected) == 2
    assert blocks.compare(block.expected, study[0].splitlines(), block.tolerance)[1] == ""


def test_parameters_and_poses_are_the_papers(metrics: dict) -> None:
    """The residual's size is not asked for: the hidden deflection was chosen to leave the paper's."""
    assert metrics["parameters"] == 32 and metrics["poses"] == 17


def test_nominal_rows_tell_installations(metrics: dict) -> None:
    """Nominal rows tell installations from arms."""
    rows = {name: entry["position_mm"]["mean"] for name, entry in metrics["table_3"]["nominal"].items()}
    paper = lwr4plus.TABLE_3["nominal"]["position_mm"]["mean"]
    assert rows["full nominal column"] > 10 * paper
    assert rows["nominal arm, station and tool fitted"] == pytest.approx(paper, rel=0.25)


def test_covariance_holds_for_rigid_truth(metrics: dict) -> None:
    """With a rigid truth the covariance holds."""
    assert metrics["table_2"]["within_2_sigma_rigid_truth"]["weighted"] == pytest.approx(0.95 * 32, abs=0.7)
    assert metrics["table_2"]["within_2_sigma_rigid_truth"]["unweighted"] > 0.9 * 32
    assert metrics["eq_11_against_eq_12"]["largest_difference_in_sigmas"] < 1e-2


def test_ranks_agree_with_paper_and_algebra(metrics: dict) -> None:
    """Ranks are those of the paper and of the algebra."""
    assert metrics["rank"]["alpha8 = d8 = 0"] == {"above 0.001": 32, "above 1e-09": 32}
    assert metrics["rank"]["calibrated"]["above 1e-09"] == 34


def test_selection_is_better_than_chance(metrics: dict) -> None:
    for row in metrics["selection"]:
        assert row["gain_over_random"] > 1.0 and row["seeds"] == 1
    assert 0.9 < metrics["ceiling"]["best_share_of_det"] <= 1.0 + 1e-9
    sets = metrics["random_sets"]
    assert sets["best"] <= sets["median"] <= sets["worst"] < lwr4plus.CONDITION
    assert np.isfinite(metrics["condition_number"]["ours_m_rad"])
