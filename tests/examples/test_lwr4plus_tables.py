"""The tables of the LWR4+ study's README are those that its scripts make, within stated bounds.

Searches by processor time, the many seeds of the designs and the 500 calibrations are not run again: of the designs
that of one seed, which has to lie in the range that README gives for three.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

STUDY = Path(__file__).parents[2] / "examples/lwr4plus"
sys.path.insert(0, str(STUDY))
import study_tables  # noqa: E402

README = study_tables.blocks((STUDY / "README.md").read_text(encoding="utf-8"))
BOUNDS = {  # relative, of numbers that hang on the last digits of a search or of a fit
    "geometry-errors": 0.1, "geometry-beside": 0.15, "dynamics-counts": 0.0, "dynamics-essential": 0.0,
    "dynamics-models": 0.02, "dynamics-torque": 0.1, "dynamics-tracking": 0.05, "dynamics-published": 0.05,
    "consistency-geometries": 0.1, "planning": 0.02, "planning-shape": 0.05,
}  # fmt: skip
SMALL = {"geometry-beside": 1e-3, "dynamics-torque": 5e-3, "consistency-geometries": 2e-3, "planning": 0.5}
_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e-?\d+)?")


def rows(text: str) -> dict[str, list[str]]:
    """Return a table's cells by the first of each row."""
    cells = [[cell.strip() for cell in line.strip("| ").split("|")] for line in text.splitlines()]
    return {line[0]: line[1:] for line in cells if set(line[0]) != {"-"}}


def numbers(cell: str) -> list[float]:
    return [float(one) for one in _NUMBER.findall(cell)]


@pytest.fixture(scope="module")
def fresh(tmp_path_factory: pytest.TempPathFactory):
    """Run a script once and return its metrics."""
    done: dict[str, dict] = {}

    def run(name: str, *options: str) -> dict:
        if name not in done:
            out = tmp_path_factory.mktemp(name)
            subprocess.run([sys.executable, STUDY / f"{name}.py", "--out", out, *options], check=True)
            done[name] = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
        return done[name]

    return run


def test_every_table_of_the_study_stands_in_the_readme_and_holds_what_was_run() -> None:
    assert set(BOUNDS) <= set(README)
    named = re.findall(r"^def (\w+)\(found: dict", Path(study_tables.__file__).read_text(), flags=re.MULTILINE)
    assert set(named) == set(study_tables.SHOW)
    for text in README.values():
        assert len(text.splitlines()) >= 3
    pictures = re.findall(r"\]\((figures/[^)]+)\)", (STUDY / "README.md").read_text(encoding="utf-8"))
    assert pictures and all((STUDY / picture).exists() for picture in pictures)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options"),
    [("geometry", ("--seeds", "0")), ("dynamics", ()), ("consistency", ("--runs", "0")), ("planning", ())],
)
def test_a_fresh_run_makes_the_readmes_tables(fresh, name: str, options: tuple[str, ...]) -> None:
    found = study_tables.SHOW[name](fresh(name, *options))
    assert found
    for key, text in found.items():
        ours, theirs = rows(text), rows(README[key])
        assert list(ours) == list(theirs), key
        for row, cells in ours.items():
            for cell, other in zip(cells, theirs[row], strict=True):
                if key == "dynamics-essential":
                    assert cell == other
                expected = pytest.approx(numbers(other), rel=BOUNDS[key], abs=SMALL.get(key, 1e-3))
                assert numbers(cell) == expected, (key, row)


def test_the_kept_trajectory_b_is_the_readmes() -> None:
    import dynamics
    import excitation

    _, least, most = numbers(rows(README["excitation-designs"])["B, 44 columns"][1])
    assert least - 0.1 <= excitation.exact(dynamics.trajectory_b())["cond"]["44"]["raw"] <= most + 0.1


@pytest.mark.slow
def test_a_fresh_design_and_fresh_logs_lie_in_the_readmes_ranges(fresh) -> None:
    found = fresh("excitation", "--quick")
    for key, columns in (("excitation-designs", (0, 1)), ("excitation-rsd", (2, 6))):
        ours, theirs = rows(study_tables.excitation(found)[key]), rows(README[key])
        assert set(ours) <= set(theirs)
        for row, cells in list(ours.items())[1:]:  # below the head
            for column in columns:
                value, (_, least, most) = numbers(cells[column])[0], numbers(theirs[row][column])
                # a ratio to one B, whose own RSD the README has within a range
                _, b_least, b_most = numbers(theirs["B, 44 columns"][column]) if key == "excitation-rsd" else (1, 1, 1)
                assert 0.95 * least / b_most - 0.01 <= value <= 1.05 * most / b_least + 0.01, (key, row, column)
