"""The survey: the rows that are kept are of the conditions of this version, and the tables come of them."""

from pathlib import Path

import pytest
from scripts import run_here

from calib.apps.studies.conditions import read_study
from calib.apps.studies.store import read_rows

SURVEY = Path(__file__).parents[2] / "examples" / "survey"


def test_kept_rows_count():
    """Each of the 15 conditions has rows of this version, none twice."""
    rows = read_rows(SURVEY / "rows")
    assert len({row.key for row in rows}) == len(rows)
    there = {row.digest for row in rows}
    assert [one.name for one in read_study(["MCS-*"]).conditions if one.digest not in there] == []


@pytest.mark.slow
def test_tables_are_those_of_the_readme(capsys):
    """Every line of every table that the kept rows and recordings give stands in the README."""
    said = run_here(SURVEY / "tables.py", capsys=capsys)
    printed = [line for line in said.splitlines() if line.startswith("|")]
    readme = set((SURVEY / "README.md").read_text().splitlines())
    assert len(printed) > 100 and [line for line in printed if line not in readme] == []
