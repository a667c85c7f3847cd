"""σ predicted for a further motion, held against those reached on real recordings."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from recordings import DATA
from scripts import require_same_package

from calib.procedure.excitation.prediction import ADDED_ERRORS, REACHED

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "examples/real_recordings.md").read_text()
SECTION = TEXT.partition("### How the σ predicted for a further motion hold")[2].partition("\n#")[0]
ROW = re.compile(r"^\| (\S+) \| (\d+) \| (\d+) \| ([\d.]+) \| (\d+) % .* \| (\d+) % \|$", re.MULTILINE)
CEILING = re.compile(r"^\| (\S+) \| \d+ % \| \d+ % \| (\d+) % \|", re.MULTILINE)
ROBOTS = ("Panda", "UR10e", "TX40", "TIAGo", "KR300", "LWR4+")


def run(data: Path, *parts: str) -> str:
    require_same_package()
    environment = os.environ | {"CALIB_DATA": str(data)}
    command = [sys.executable, str(ROOT / "examples/promised_sigma.py"), *parts]
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=True).stdout


def test_robots_without_data_are_skipped_with_the_reason(tmp_path):
    output = run(tmp_path)
    assert ROW.findall(output) == []
    for robot in ROBOTS:
        assert f"{robot} is skipped: no {tmp_path}" in output


def test_range_and_factor_of_the_program_are_those_of_the_documents():
    """The program states what the table's command prints, and the table has all robots."""
    low, high = REACHED
    concept = (ROOT / "docs/concepts/identifiability.md").read_text()
    assert f"within {low:g}–{high:g}" in SECTION and f"{low:g} to {high:g} times those predicted" in concept
    assert f"{ADDED_ERRORS:g} times the variance" in SECTION and f"1 + {ADDED_ERRORS - 1.0:.1f}" in concept
    assert tuple(row[0] for row in ROW.findall(SECTION)) == ROBOTS


@pytest.mark.slow
def test_one_pair_of_two_real_robots(data):
    """The median is near the prediction, most ratios are in the stated range, and sampling is not what is missed."""
    output = run(DATA, "--every", "100", "Panda", "TX40")
    rows = ROW.findall(output)
    assert [row[0] for row in rows] == ["Panda", "TX40"]
    for robot, pairs, parameters, median, _, in_range in rows:
        assert int(pairs) == 1 and int(parameters) > 50, robot
        assert 0.8 <= float(median) <= 1.25, robot
        assert int(in_range) >= 80, robot
    ceilings = [int(percent) for _, percent in CEILING.findall(output)]
    assert len(ceilings) == 2 and min(ceilings) >= 95
