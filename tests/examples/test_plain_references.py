"""The plain fit stands beside the toolkit on open recordings: its figures, and that no delivered URDF is worse."""

from pathlib import Path

import numpy as np
import plain_references
import pytest
from plain_references import IIWA_POSES, ROWS, WORSE, Result, Row, print_table, run, split
from scipy.spatial.transform import Rotation

BY_NAME = {row.name: row for row in ROWS}


@pytest.fixture
def recordings(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plain_references, "DATA", data)


@pytest.mark.usefixtures("recordings")
def test_iiwa_plain_fit_has_prototype_rms():
    """Rms on its unseen file: 1.174 mm nominal, 0.589 mm by another plain fit with the same prior."""
    result = run(BY_NAME["iiwa7, positions, its files"], draw=0, plain_only=True)
    assert (result.nominal, result.plain) == pytest.approx((1.174, 0.589), rel=2e-3)


@pytest.mark.slow
@pytest.mark.usefixtures("recordings")
@pytest.mark.parametrize(
    ("name", "draw"),
    [("iiwa7, positions, its files", 0), ("iiwa7, positions", 0), ("iiwa7, full poses", 0), ("positioner", 2)]
    + [("UR5, 15 poses", draw) for draw in range(3)],
)
def test_delivered_urdf_is_no_worse(name: str, draw: int):
    """A delivered URDF is no worse than the plain fit."""
    result = run(BY_NAME[name], draw)
    assert result.urdf <= WORSE * result.plain, result


@pytest.mark.usefixtures("recordings")
def test_split_holds_every_row_once():
    """A split holds every row once and is drawn anew."""
    row = Row("three of four", IIWA_POSES, draws=2, share=0.25)
    header, fitted, _, unseen = split(row, draw=0)
    assert len(fitted) == 228 and len(unseen) == 76 and not set(fitted) & set(unseen)
    assert set(split(row, draw=1)[3]) != set(unseen)
    q, targets = IIWA_POSES.read(header, unseen)
    assert q.shape == (76, 7) and targets.positions.shape == (76, 1, 3) and targets.orientations is not None
    exact = Rotation.from_matrix(targets.orientations).as_matrix()
    assert np.abs(exact - targets.orientations).max() < 1e-3


def test_the_table_counts_what_is_worse(capsys: pytest.CaptureFixture[str]):
    rows = [
        Result("arm", draw, 15, 100, nominal=2.0, plain=1.0, urdf=urdf, corrections=0.5)
        for draw, urdf in enumerate((1.0, 1.01, 1.5))
    ]
    print_table([*rows, Result("refused", 0, 15, 100, nominal=2.0, plain=1.0, verdict="MeasurementError: no")])
    lines = capsys.readouterr().out.splitlines()
    (counted,) = [line for line in lines if line.startswith("arm")]
    assert "1.010 (1.500)" in counted and counted.endswith("1.500, 1 of 3")
    (refused,) = [line for line in lines if line.startswith("refused")]
    assert refused.split()[-2:] == ["none", "none"]
