"""Each finding on a fit is one sentence, with its numbers in the units of the cell."""

from __future__ import annotations

import pytest

from calib.geometry.checks.diagnosis import BelowStated, BeyondStated, SetUpChange, SystematicResidual
from calib.geometry.checks.unidentified import HeldByPrior, LeftNominal, LoosePlacement, Merged, NoEffect, Rank
from calib.procedure.kinematic_stage.remarks import remark


@pytest.mark.parametrize(
    ("finding", "words"),
    [
        (SetUpChange("/a/day.csv", 1, 40, 4e-4, 5e-5), "day.csv: rows 1–40 fit worse than the rest (0.40 against 0.05"),
        (SystematicResidual("", 2e-4, 5e-5), "measurements: the remaining 0.200 mm rms are mostly systematic"),
        (BeyondStated("a.csv", 5e-4, 5e-5), "is 10 times the stated uncertainty (0.050 mm)"),
        (BelowStated("a.csv", 1e-4, 1.0), "the stated uncertainty (1e+03 mm) is 10000 times the residual (0.1 mm rms)"),
        (Rank(30, 38, 1e-6, 2e-3, 3e-12), "30 of 38 parameters can be told apart (tolerance 1e-06; singular values"),
        (Rank(38, 38, 1e-6, 2e-3, None), "38 of 38 parameters can be told apart (tolerance 1e-06)."),
        (NoEffect(("d1",)), "No effect on what was measured: d1."),
        (Merged(("d1", "r1"), True, True, ("a", "b", "c", "d", "e")), "tool and a, b, c, d and 1 more, and left at"),
        (HeldByPrior(("d1",)), "Drawn to nominal"),
        (LeftNominal(("d1",)), "so they stay at nominal: d1."),
        (LoosePlacement("tool", 3e-3, "s", 0.5), "±3.0 mm: the tool cannot be told from the base (the placement of"),
        (LoosePlacement("tool", 3e-3, "", 20.0), "hold the wrist nearly still (orientations within 20° of each other)"),
        (LoosePlacement("tool", 3e-3, "", 90.0), "±3.0 mm. Predictions"),
    ],
)  # fmt: skip
def test_a_finding_is_a_sentence(finding, words):
    assert words in remark(finding) and remark(finding).endswith(".")
