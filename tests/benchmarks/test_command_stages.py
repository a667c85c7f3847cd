"""Processor time of commands by stage: the innermost stage counts, and all of it adds up."""

import sys
from itertools import count
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
import command_stages


def test_time_counts_for_innermost_stage(monkeypatch):
    """Time counts for the innermost stage and adds up."""
    seconds = count(0.0)  # every look at the clock is a second later
    monkeypatch.setattr(command_stages.time, "process_time", lambda: next(seconds))
    clock = command_stages.Clock()
    drawing = clock.around(lambda: clock.around(int, "imports")(), "figures")
    clock.around(drawing, "writing")()
    assert clock.spent == {"other": 0.0, "writing": 2.0, "figures": 2.0, "imports": 1.0}
    assert sum(clock.spent.values()) == clock.since


def test_a_stage_that_fails_ends():
    clock = command_stages.Clock()
    with pytest.raises(ZeroDivisionError):
        clock.around(lambda: 1 / 0, "reading")()
    assert clock.stack == ["other"]
