"""Sweeps run many settings over one data set in memory, and give a table; files are neither read nor written."""

from dataclasses import dataclass

import numpy as np
import pytest
from worker_tasks import chosen_and_error

import calib
from calib.errors import UsageError

ARM = calib.population("ur5", 1, seed=4)[0]
MEASURED = ARM.measure(ARM.postures(40))
OFFSETS = calib.FitSettings(model="offsets")


def soft_l1(z: np.ndarray) -> np.ndarray:
    root = np.sqrt(1.0 + z)
    return np.array([2.0 * (root - 1.0), 1.0 / root])


@dataclass
class FewFigures:
    rms: float

    def to_dict(self) -> dict[str, object]:
        return {"rms": self.rms}


def interrupted(rms: float) -> FewFigures:
    raise KeyboardInterrupt


@pytest.mark.slow
def test_a_grid_gives_a_row_for_each_combination():
    """Settings by name, and arguments of the function such as a loss; figures are those of a call by hand."""
    over = {"model": ["frames", "offsets"], "loss": ["none", soft_l1]}
    table = calib.sweep(calib.fit_geometry, ARM.nominal, MEASURED, over=over)
    assert list(table["model"]) == ["frames", "frames", "offsets", "offsets"]
    assert list(table["loss"]) == ["none", "soft_l1", "none", "soft_l1"]
    assert set(table["verdict"]) <= {"pass", "marginal", "fail", "not judged"} and list(table["error"]) == [""] * 4
    fit = calib.fit_geometry(ARM.nominal, MEASURED, OFFSETS, loss=soft_l1)
    assert table["findings.cross_validated"][3] == pytest.approx(fit.selection.cross_validated, rel=1e-12)


@pytest.mark.slow
def test_runs_have_figures_of_ones_own_and_errors_in_a_column():
    """A run that fails does not end the sweep."""
    few = ARM.measure(ARM.postures(2))
    runs = [{"measured": MEASURED}, {"measured": few}]
    table = calib.sweep(calib.fit_geometry, robot=ARM.nominal, settings=OFFSETS, over=runs, figures=chosen_and_error)
    assert table.columns[1:] == ("chosen", "rms", "error") and table["chosen"][0] == "offsets"
    assert np.isfinite(table["rms"][0]) and np.isnan(table["rms"][1])
    assert table["error"][0] == "" and "2 usable rows" in table["error"][1]


def boom(result: object) -> dict[str, object]:
    raise ValueError("boom")


def slip(z: np.ndarray) -> np.ndarray:
    raise ZeroDivisionError("no such loss")


def test_whatever_a_run_raises_the_others_go_on():
    """Errors of the user's own functions have their class in the table; Ctrl-C still ends a sweep."""
    over = {"loss": [slip, soft_l1]}
    table = calib.sweep(calib.fit_geometry, ARM.nominal, MEASURED, over=over, figures=chosen_and_error)
    assert table["error"][0] == "ZeroDivisionError: no such loss" and table["error"][1] == ""
    table = calib.sweep(FewFigures, over={"rms": [1.0, 2.0]}, figures=boom)
    assert list(table["error"]) == ["figures: ValueError: boom"] * 2
    with pytest.raises(KeyboardInterrupt):
        calib.sweep(interrupted, over={"rms": [1.0]})


@pytest.mark.parametrize(
    ("figures", "message"),
    [
        (lambda result: None, "figures: expected a mapping of names to numbers or texts, found NoneType"),
        (lambda result: np.ones(3), "figures: expected a mapping .* found ndarray"),
        (lambda result: {"all": np.ones(3)}, "figures: all: expected a number or a text, found ndarray"),
        (lambda result: {"error": 1.0}, "figures: 'error' is a column of the sweep itself"),
        (lambda result: {"rms": 1.0}, "figures: 'rms' is a column of the sweep itself"),
        (lambda result: {1: 1.0}, "figures: expected names as texts, found 1"),
    ],
)
def test_figures_that_are_no_columns_are_refused_at_the_first_run(figures, message):
    runs: list[float] = []

    def few(rms: float) -> FewFigures:
        runs.append(rms)
        return FewFigures(rms)

    with pytest.raises(UsageError, match=message):
        calib.sweep(few, over={"rms": [1.0, 2.0]}, figures=figures)
    assert runs == [1.0]


@pytest.mark.slow
def test_processes_give_the_same_table():
    over = {"model": ["frames", "offsets"]}
    tables = [
        calib.sweep(calib.fit_geometry, ARM.nominal, MEASURED, over=over, figures=chosen_and_error, workers=workers)
        for workers in (1, 2)
    ]
    assert tables[0].to_dict() == tables[1].to_dict()


@pytest.mark.parametrize(
    ("over", "message"),
    [
        ({"los": ["none"]}, "'los' is neither a setting nor an argument of fit_geometry: .*loss"),
        ({"model": ["none such"]}, "FitSettings: model: expected one of"),
        ({"model": "geometry"}, "over: model: expected several values in a list"),
        ({"model": []}, "over: nothing to run"),
        ([], "over: nothing to run"),
    ],
)
def test_sweeps_of_nothing_known_are_refused(over, message):
    with pytest.raises(UsageError, match=message):
        calib.sweep(calib.fit_geometry, ARM.nominal, MEASURED, over=over)


def test_a_wrong_argument_is_named():
    with pytest.raises(UsageError, match="sweep: over: expected a mapping or several, each a mapping, found 3"):
        calib.sweep(calib.fit_geometry, ARM.nominal, MEASURED, over=3)


def test_functions_that_cannot_be_sent_to_processes_are_named():
    with pytest.raises(UsageError, match="define functions at the top of a module, or leave workers = 1"):
        calib.sweep(calib.fit_geometry, ARM.nominal, MEASURED, over={"loss": [lambda z: z]}, workers=2)
