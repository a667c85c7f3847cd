"""Figures are data on the page; drawings are files that are asked for: --plots, --no-plots, Ctrl-C while drawing."""

from pathlib import Path

import planted_motion as planted
import pytest

from calib.procedure.report.figures import figure_data, figure_files
from calib.robot import description

SVG = b'<svg xmlns="http://www.w3.org/2000/svg" width="9pt" height="9pt"/>'


@pytest.fixture
def figures() -> bool:
    return True


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write figures as ever, but draw no PNG: for what asks which are written."""
    svg = figure_files.drawn
    monkeypatch.setattr(figure_files, "drawn", lambda chart, form: svg(chart, form) if form == "svg" else b"\x89PNG")


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.mark.slow
def test_fit_without_plots_has_all_else(cell, calib, undrawn):
    """A fit draws nothing that was not asked for; without figures it has its certificate and all else."""
    measured = cell.write("m.csv", cell.measure())
    arguments = ("fit", "ur5", measured, "--holdout", 0.25, "--model", "geometry")
    assert calib(*arguments, "--out", "with", "--plots", "png")[0] == calib(*arguments, "--out", "paged")[0] == 0
    drawn, paged = names(cell.folder / "with"), names(cell.folder / "paged")
    assert len(drawn - paged) >= 6 and all(name.startswith("plot_") for name in drawn - paged) and paged < drawn
    charts = figure_data.of_folder(cell.folder / "paged")
    assert {f"plot_{name}.png" for name in charts} == drawn - paged
    assert calib(*arguments, "--out", "with", "--no-plots")[0] == 0
    assert names(cell.folder / "with") == paged, "figures of the earlier fit are gone"
    page = (cell.folder / "with/report.html").read_text(encoding="utf-8")
    assert "<figure" not in page and "<script" not in page and "Ladder of models" in page
    for name in ("metrics.json", "estimate.csv", "report.json"):
        assert (cell.folder / "with" / name).read_text() == (cell.folder / "paged" / name).read_text()


def test_fit_spares_matplotlib(loaded):
    """A fit loads no Matplotlib, unless PNG are asked for."""
    assert "matplotlib" not in loaded["fit"]


def test_plots_and_none_exclude_each_other(cell, calib):
    measured = cell.write("m.csv", cell.measure(40))
    code, _, said = calib("fit", "ur5", measured, "--plots", "png", "--no-plots", "--out", "o")
    assert code == 2 and "--plots and --no-plots exclude each other" in said
    code, _, said = calib("fit", "ur5", measured, "--plots", "gif", "--out", "o")
    assert code == 2 and "gif" in said and "png" in said


@pytest.mark.slow
def test_ctrl_c_leaves_no_half_made_figures(cell, calib, monkeypatch, undrawn):
    """Ctrl-C while figures are drawn leaves nothing half made."""
    measured = cell.write("m.csv", cell.measure(40))
    arguments = ("fit", "ur5", measured, "--model", "geometry", "--plots", "png", "--out", "o")
    drawn = []

    def interrupted(chart, form):
        drawn.append(chart)
        if len(drawn) == 3:
            raise KeyboardInterrupt
        return b"\x89PNG"

    with monkeypatch.context() as patch:
        patch.setattr(figure_files, "drawn", interrupted)
        code, _, said = calib(*arguments)
    assert code == 130 and "no incomplete files were left" in said and len(drawn) == 3
    assert names(cell.folder) == {"m.csv"}
    assert calib(*arguments)[0] == 0 and "plot_position.png" in names(cell.folder / "o")


@pytest.mark.slow
def test_figures_are_drawn_once_or_never(tmp_path, calib, monkeypatch):
    """An identification draws each figure once if it is asked to, else none but the certificate's."""
    import numpy as np

    monkeypatch.chdir(tmp_path)
    description.write(tmp_path / "robot.toml", planted.arm())
    np.savez(tmp_path / "train.npz", **planted.series(0))
    arguments = ("identify", "robot.toml", "train.npz", "--friction", "standard", "--out", "o")
    drawn = []
    monkeypatch.setattr(figure_files, "drawn", lambda chart, form: drawn.append(form) or SVG)
    for plots, pictures in ((("--plots", "png"), True), ((), False), (("--no-plots",), False)):
        drawn.clear()
        assert calib(*arguments, *plots)[0] == 0
        files = [name for name in names(tmp_path / "o") if name.startswith("plot_")]
        assert len(files) == drawn.count("png") and (len(files) >= 4) == pictures
        stills = 0 if "--no-plots" in plots else 8
        assert drawn.count("svg") == stills, "the page's, and one for print"
