"""The README's figures of the demonstration, and those in its picture, are the demonstration's."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
import demo_picture

# relative: where linear algebra rounds otherwise the short search for motions ends elsewhere
BOUNDS = {"nominal_mm": 0.01, "calibrated_mm": 0.01, "unexplained_percent": 0.05, "within_two_sigma_percent": 0.12}


def test_readme_and_picture_state_the_same() -> None:
    drawn, stated = demo_picture.drawn(), demo_picture.stated()
    assert {name: told for name, (told, _) in stated.items()} == {
        name: pytest.approx(drawn[name], abs=1.01 * digit) for name, (_, digit) in stated.items()
    }


@pytest.mark.slow
def test_the_picture_is_of_a_fresh_run(tmp_path: Path) -> None:
    drawn, fresh = demo_picture.drawn(), demo_picture.run(tmp_path / "demo")
    assert {name: drawn[name] for name in BOUNDS} == {
        name: pytest.approx(fresh[name], rel=bound) for name, bound in BOUNDS.items()
    }
