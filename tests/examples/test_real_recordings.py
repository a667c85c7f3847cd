"""The figures of examples/real_recordings.md are those of a fresh run."""

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
TEXT = (EXAMPLES / "real_recordings.md").read_text()
NEAR = 0.03  # relative: what another processor's rounding and library may change, beside the last digit printed


def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("real_recordings", EXAMPLES / "real_recordings.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["real_recordings"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


SCRIPT = script()
ROWS = SCRIPT.ROWS


def stated(row) -> list[tuple[float, float]]:
    """Return the figures that the document states in a row, with half of their last digit."""
    (line,) = [line for line in TEXT.splitlines() if line.startswith(f"| {row.document}")]
    cells = [cell.strip() for cell in line.strip("|").split("|")][2:]
    found = re.findall(rf"(\d+\.\d+) {row.unit}", " | ".join(cells))
    return [(float(one), 0.5 * 10.0 ** -len(one.partition(".")[2])) for one in found]


@pytest.mark.parametrize("row", ROWS, ids=[row.document for row in ROWS])
def test_command_rows_stand_in_document(row) -> None:
    """Every row of the command stands in the document."""
    assert stated(row)


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS, ids=[row.document for row in ROWS])
def test_document_states_fresh_results(row, data, monkeypatch) -> None:
    """The document states what a fresh run gives."""
    monkeypatch.setattr(SCRIPT, "DATA", data)
    fresh = row.run()
    for value, (told, digit) in zip(fresh, stated(row)):
        assert abs(value - told) <= NEAR * told + digit, (value, told)
