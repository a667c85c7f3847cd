"""A rigid misfit names a cause where the numbers show it; else it says what was looked for."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from calib.geometry.model_choice.ladder import ModelStep
from calib.procedure.kinematic_stage.verdict import plausibility

EFFECTS = ["joints that give way", "bearings or links that bend", "joints that move others", "gear or encoder errors"]


def misfit_of(rows, cell, calib):
    _, out, err = calib("fit", "ur5", cell.write("m.csv", rows), "--out", "o")
    noticed = json.loads(Path("o/metrics.json").read_text())["noticed"]
    values = [finding["values"] for finding in noticed if finding["code"] == "rigid-misfit"]
    assert len(values) == 1, err
    return values[0], out


def test_noise_of_the_instrument_has_no_cause_in_the_arm(cell, calib):
    random = np.random.default_rng(0)
    rows = cell.measure(100)
    for row in rows:
        for axis in "xyz":
            row[axis] += 2e-3 * random.normal()
    values, out = misfit_of(rows, cell, calib)
    assert not values["causes"]
    tested = ["wrong columns, units or rows", "a changed set-up", "random joint errors", *EFFECTS, "axes that wobble"]
    assert values["excluded"] == tested
    assert "no sign of wrong columns, units or rows, a changed set-up" in out and "likely causes" not in out


def test_what_another_finding_names_is_not_excluded(cell, calib):
    """Rows from the 40th on are one row late."""
    rows = cell.measure(60)
    late = [rows[number - (number >= 40)] for number in range(60)]
    slipped = [row | {axis: reading[axis] for axis in "xyz"} for row, reading in zip(rows, late)]
    values, _ = misfit_of(slipped, cell, calib)
    assert not values["causes"] and not values["excluded"]


@pytest.mark.parametrize(
    ("steps", "cause"),
    [
        ((("+ stiffness", 0.2, True),), "joints that give way (96% of the squares)"),
        ((("+ stiffness", 0.95, False), ("+ harmonics", 0.4, True)), "gear or encoder errors (84% of the squares)"),
        ((("+ bending", 0.8, True), ("+ coupling", 0.5, True)), "joint errors of unclear kind (75% of the squares)"),
        ((("+ bending", 0.95, True),), None),
        ((("+ stiffness", 0.1, False),), None),
    ],
)
def test_one_kind_of_correction_names_a_cause_if_it_removes_nearly_all(steps, cause):
    rungs = [ModelStep("geometry", 27, 1.0, True)]
    rungs += [ModelStep(model, 40, error, kept) for model, error, kept in steps]
    selection = SimpleNamespace(rungs=tuple(rungs))
    assert plausibility._causes(selection, 1e-3) == ([cause] if cause else [])
