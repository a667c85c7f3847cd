"""A placement of base and tool that did not settle is said, and not scored."""

from dataclasses import replace

import numpy as np
import pytest

from calib.geometry import fit as geometric_fit
from calib.geometry.weighing import Settings
from calib.procedure.kinematic_stage import fit, inputs
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.procedure.kinematic_stage.validation import Arms, assess
from calib.robot.calibrated import CalibratedChain
from calib.robot.library import load
from calib.rooms.cells.cell import SimulatedInstrument, measure
from calib.rooms.cells.virtual_cells import perturbed_cell


def test_a_placement_that_ran_out_of_steps_proves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The optimiser gets one linearisation for the file's own frames: what it leaves there means nothing."""
    cell = perturbed_cell(load("ur10"), 0, SimulatedInstrument("6-D probe", 30e-6, 1e-4), hidden=0.3)
    rng = np.random.default_rng(0)
    seen, other = (measure(cell, rng.uniform(-2.0, 2.0, (count, 6)), count) for count in (40, 30))
    wanted = FitSettings(model="offsets", refit_frames=True)
    given = inputs.gather(
        CalibratedChain(cell.nominal),
        [replace(seen, file="seen.csv")],
        [replace(other, file="other.csv")],
        settings=wanted,
    )
    found = fit.run(given, wanted=wanted)
    (name,) = found.validation
    assert found.validation[name].settled and found.validation[name].proves and name in found.verdict.reason
    monkeypatch.setattr(geometric_fit, "CRAWLS", 1)
    chosen = found.selection
    arms = Arms(chosen.nominal.cell, chosen.fit.cell, found.rigid.cell.chain, found.expected)
    again = assess(arms, given, found.findings, Settings(limit=1), wanted)
    assert not again.validation[name].settled and not again.validation[name].proves
    codes = {one.code: one.values.get("file") for one in again.noticed}
    assert codes["placement-unsettled"] == name and "interval-coverage" not in codes
    assert name not in again.verdict.reason and "cross-validation" in again.verdict.reason


def test_a_file_that_its_own_placement_explains_proves_nothing(cell, calib) -> None:
    """Six positions are eighteen numbers, base and tool nine parameters; twelve positions leave enough."""
    file, other = cell.write("a.csv", cell.measure(60)), cell.measure(12, 1)
    for count, scored in ((6, False), (12, True)):
        few = cell.write("few.csv", other[:count])
        _, out, err = calib("fit", "ur5", file, "--model", "offsets", "--validate", few, "--refit-frames", "--out", "o")
        assert ("few.csv is not scored: base and tool placement use 9" in out) is not scored, err
        assert ("on few.csv, unseen" in out) is scored
