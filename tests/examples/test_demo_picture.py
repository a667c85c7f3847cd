"""The README's figures of the demonstration are those in its picture; a fresh run's: `session/test_demo`."""

import demo_picture
import pytest


def test_readme_and_picture_state_the_same() -> None:
    drawn, stated = demo_picture.picture_figures(), demo_picture.readme_figures()
    assert {name: told for name, (told, _) in stated.items()} == {
        name: pytest.approx(drawn[name], abs=1.01 * digit) for name, (_, digit) in stated.items()
    }
