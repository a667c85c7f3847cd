"""A front keeps its motions in the design's folder, and one of them can be taken in place of a search."""

from pathlib import Path

import numpy as np
import pytest

import calib
from calib.errors import UsageError
from calib.procedure.excitation import coefficients, design, stored_front
from calib.procedure.excitation.settings import ExcitationSettings

SETTINGS = ExcitationSettings(
    goals=("wrist=0.15", "raw=30"), period=6.0, harmonics=3, rate=250.0, starts=1, evaluations=10,
    front=3, outlook=False,
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        # the ends of the front take most of the time, and nothing here is said of how good they are
        patch.setattr(design, "END_EVALUATIONS", 15)
        found = calib.design_excitation("tx40", SETTINGS)
    return found.save(tmp_path_factory.mktemp("front") / "motion", plots=False)


@pytest.mark.slow
def test_each_row_has_its_motion(folder: Path) -> None:
    """Rows differ, each has a motion, and the designed one is that of the folder."""
    front = stored_front.read(folder)
    count = len(front.values.values)
    assert count == len(front.motions) >= 3
    assert len(np.unique(front.values.values.round(9), axis=0)) == count
    q, _, _ = coefficients.read(folder).orders(np.linspace(0.0, 6.0, 50))
    designed, _, _ = front.designed.orders(np.linspace(0.0, 6.0, 50))
    np.testing.assert_allclose(q, designed, atol=0.05)


@pytest.mark.slow
def test_picked_motion_is_the_front_s(folder: Path) -> None:
    """Without a search the picked motion has the condition number of its row, and the front stays."""
    front = stored_front.read(folder)
    number = 2 if front.values.designed == 0 else 1
    picked = calib.design_excitation("tx40", SETTINGS, pick=(folder, number))
    assert picked.found.evaluations == 0 and picked.proof.feasible
    assert picked.condition.raw == pytest.approx(front.values.values[number - 1, 0], rel=0.05)
    picked.save(folder.parent / "picked", plots=False)
    again = stored_front.read(folder.parent / "picked")
    assert again.values.designed == number - 1
    np.testing.assert_array_equal(again.values.values, front.values.values)
    assert f"motion {number} of the {len(front.motions)} of the front" in str(picked)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "settings", "number", "message"),
    [
        ("tx40", SETTINGS, 99, "the front has the motions 1 to"),
        ("lwr4plus", SETTINGS, 1, "of a robot with the joints"),
        ("tx40", ExcitationSettings(period=6.0, harmonics=4, rate=250.0), 1, "with other harmonics"),
        ("tx40", ExcitationSettings(period=12.0, harmonics=3, rate=250.0), 1, "6 s at 250 Hz, the settings say"),
    ],
)
def test_unlike_picks_are_refused(
    folder: Path, robot: str, settings: ExcitationSettings, number: int, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        calib.design_excitation(robot, settings, pick=(folder, number))


def test_design_without_front_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"has no front\.csv"):
        calib.design_excitation("tx40", SETTINGS, pick=(tmp_path, 1))


@pytest.mark.slow
def test_locked_joint_is_read_again(tmp_path: Path) -> None:
    """A motion whose joint 4 is locked is written and read."""
    settings = ExcitationSettings(
        period=6.0, harmonics=4, starts=1, evaluations=20, lock=("joint_4=0.5",), outlook=False
    )
    out = calib.design_excitation("tx40", settings).save(tmp_path / "motion", plots=False)
    q, v, _ = coefficients.read(out).orders(np.linspace(0.0, 6.0, 20))
    np.testing.assert_allclose(q[:, 3], 0.5)
    np.testing.assert_allclose(v[:, 3], 0.0)
