"""Three arms go from `calib new` to a delivered correction by commands alone, on files as an engineer gets them."""

from pathlib import Path

import pytest
from scripts import run_here

EXAMPLE = Path(__file__).parents[2] / "examples/cell"


def rows(text: str) -> dict[str, list[str]]:
    """Return the rows of a table in Markdown by their first cell."""
    cells = ([cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:2] == "| ")
    return {name: others for name, *others in cells}


@pytest.mark.slow
def test_arms_are_corrected_as_readme_states(tmp_path, capsys):
    """Each arm is corrected, and the README states what a fresh run finds."""
    said = run_here(EXAMPLE / "rehearsal.py", "--out", tmp_path / "r", capsys=capsys)
    found, stated = rows(said), rows((EXAMPLE / "README.md").read_text())
    assert found.keys() == stated.keys() and len(found) == 5
    for name in ("ur5", "lrmate200id", "lwr4plus"):
        controller, verdict, *errors, checked = found[name]
        assert [controller, verdict, checked] == [*stated[name][:2], stated[name][-1]]
        assert [float(one) for one in errors] == pytest.approx([float(one) for one in stated[name][2:-1]], rel=0.1)
        nominal, urdf, sent = map(float, errors)
        assert urdf < 0.5 * nominal and sent < 0.5 * nominal
