"""Rows of a study, made up."""

from dataclasses import replace

from calib.apps.studies.trial import TrialRow

ROW = TrialRow(
    "c", "d1", "wls", 0, "found", "", "tx40", 1e-6, 0.05, 1, 50.0, "none", 10.0, 0.15, torque_error=0.3, version="1"
)


def rows(count: int) -> list[TrialRow]:
    return [replace(ROW, seed=seed, message=f"odd, with a comma {seed}") for seed in range(count)]
