"""The documents of the friction ladder list the steps of its table."""

import importlib
import inspect
import re

import pytest

from calib.identification.friction.friction_ladder import NAMES

DOCUMENTS = (
    "calib.cli.dynamics",
    "calib.identification.identify_options",
    "calib.identification.friction.friction_ladder",
)


@pytest.mark.parametrize("module", DOCUMENTS)
def test_every_step_is_listed(module: str) -> None:
    """A step that is added to `calib.dynamics.shapes.STEPS` is added to help and file format, too."""
    words = set(re.findall(r"\w+", inspect.getsource(importlib.import_module(module))))
    steps = set(NAMES) - ({"auto"} if module.endswith("ladder") else set())
    assert steps <= words
