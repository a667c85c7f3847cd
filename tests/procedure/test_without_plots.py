"""Drawing can be left out, and broken off: --no-plots, and Ctrl-C while figures are drawn."""

from pathlib import Path

import planted_motion as planted
import pytest

from calib.procedure.report import charts, style
from calib.robot import description


@pytest.fixture
def figures() -> bool:
    return True


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make figures as ever, but do not draw them: for what asks which are made."""
    monkeypatch.setattr(style, "png", lambda figure, dpi=style.DPI: b"\x89PNG")


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.mark.slow
def test_fit_without_plots_has_all_else(cell, calib, undrawn):
    """A fit without plots has its certificate and all else."""
    measured = cell.write("m.csv", cell.measure())
    arguments = ("fit", "ur5", measured, "--holdout", 0.25, "--model", "geometry")
    assert calib(*arguments, "--out", "with")[0] == calib(*arguments, "--out", "without", "--no-plots")[0] == 0
    drawn, bare = names(cell.folder / "with"), names(cell.folder / "without")
    assert len(drawn - bare) >= 6 and all(name.startswith("plot_") for name in drawn - bare) and bare < drawn
    page = (cell.folder / "without/report.html").read_text(encoding="utf-8")
    assert "<img" not in page and "Ladder of models" in page
    for name in ("metrics.json", "estimate.csv", "report.json"):
        assert (cell.folder / "with" / name).read_text() == (cell.folder / "without" / name).read_text()
    assert calib(*arguments, "--out", "with", "--no-plots")[0] == 0
    assert names(cell.folder / "with") == bare, "figures of the earlier fit are gone"


def test_fit_without_plots_spares_matplotlib(loaded):
    """A fit without plots loads no Matplotlib."""
    assert "matplotlib" not in loaded["fit without plots"]


def test_ctrl_c_leaves_no_half_made_figures(cell, calib, monkeypatch, undrawn):
    """Ctrl-C while figures are drawn leaves nothing half made."""
    measured = cell.write("m.csv", cell.measure(40))
    arguments = ("fit", "ur5", measured, "--model", "geometry", "--out", "o")
    drawn = []

    def interrupted(figure, dpi=style.DPI):
        drawn.append(figure)
        if len(drawn) == 3:
            raise KeyboardInterrupt
        return b"\x89PNG"

    with monkeypatch.context() as patch:
        patch.setattr(style, "png", interrupted)
        code, _, said = calib(*arguments)
    assert code == 130 and "no incomplete files were left" in said and len(drawn) == 3
    assert names(cell.folder) == {"m.csv"}
    assert calib(*arguments)[0] == 0 and "plot_position.png" in names(cell.folder / "o")


@pytest.mark.slow
def test_figures_are_drawn_once_or_never(tmp_path, calib, monkeypatch, undrawn):
    """An identification draws each figure once, and none without plots."""
    import numpy as np

    monkeypatch.chdir(tmp_path)
    description.write(tmp_path / "robot.toml", planted.arm())
    np.savez(tmp_path / "train.npz", **planted.series(0))
    arguments = ("identify", "robot.toml", "train.npz", "--friction", "standard", "--out", "o")
    drawn, figure = [], charts.figure
    monkeypatch.setattr(charts, "figure", lambda chart: drawn.append(chart) or figure(chart))
    assert calib(*arguments)[0] == 0
    files = [name for name in names(tmp_path / "o") if name.endswith(".png")]
    assert len(drawn) == len(files) + 1 >= 5, "each is drawn once for its file and the report, and one for print"
    assert calib(*arguments, "--no-plots")[0] == 0 and len(drawn) == len(files) + 1
    assert not [name for name in names(tmp_path / "o") if name.endswith(".png")]
