"""The table of instrumental variables on real recordings is what the command makes."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TABLE = (ROOT / "examples/real_recordings.md").read_text().split("<!-- examples/real_instruments.py -->")[1]
# rows of a table that share a recording, and so its least squares; the UR10e's 50 s are the code path of its 30 s,
# series of few and of many harmonics, on a longer log
COMPARED = ((0,), (1, 2), (5,), (6,))
NEAR = 0.05  # relative: what another processor's rounding may change, beside the last digit printed


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    import real_instruments

    return real_instruments


def cells(row: str) -> list[str]:
    return [cell.strip() for cell in row.strip().strip("|").split("|")]


def test_every_row_stands_in_the_document(script):
    head, _, *rows = TABLE.strip().splitlines()
    assert head == script.HEAD.splitlines()[0]
    assert [tuple(cells(row)[:2]) for row in rows] == [
        (one.name, f"{one.harmonics} of {cells(row)[1].split()[2]} s")
        for one, row in zip(script.ROWS, rows, strict=True)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("numbers", COMPARED)
def test_document_states_fresh_results(script, numbers, data, monkeypatch):
    """The document states what a fresh run gives: of each robot a recording."""
    monkeypatch.setattr(script, "DATA", data)
    for number in numbers:
        told, fresh = cells(TABLE.strip().splitlines()[2 + number]), cells(script.study(script.ROWS[number]))
        assert told[0] == fresh[0]
        for one, other in zip(told, fresh, strict=True):
            values, new = (re.findall(r"\d+\.?\d*(?:e[+-]\d+)?", cell) for cell in (one, other))
            digit = max((10.0 ** -len(value.partition(".")[2]) for value in values), default=0.0)
            assert [float(value) for value in new] == pytest.approx([float(value) for value in values], NEAR, digit)
