"""A robot file and recordings for the command."""

from pathlib import Path

import planted_motion as planted
import pytest

from calib.robot import description


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """Return the planted arm's robot.toml."""
    return description.write(tmp_path / "planted.toml", planted.arm())
