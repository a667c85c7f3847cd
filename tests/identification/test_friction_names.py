"""What a user reads of the friction ladder lists the steps of its table."""

import re

from calib.cli import run
from calib.identification.friction.friction_ladder import NAMES


def test_every_step_is_listed_by_formats(capsys) -> None:
    assert run(["formats", "identify-options"]) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("    friction   ")]
    assert set(NAMES) <= set(re.findall(r"\w+", line))
