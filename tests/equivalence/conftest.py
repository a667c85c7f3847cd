"""The small arm of all equivalence tests: its measurements, and a finished session of it."""

from pathlib import Path

import numpy as np
import planted_motion as planted
import pytest
from both_ways import go_on, session_with

from calib.robot import description
from calib.simulation.cell import measure, write_measured
from calib.simulation.virtual_cells import perturbed_cell


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The planted arm of three joints as it is described; measurements of it, off its nominal, to fit and to validate.

    Those whose name begins with ``bent`` are of an arm whose joints deflect.
    """
    folder = tmp_path_factory.mktemp("files")
    description.write(folder / "robot.toml", planted.arm())
    for name, hidden in (("", 0.05), ("bent_", 2.0)):
        cell = perturbed_cell(planted.arm(), seed=1, hidden=hidden)
        for kind, count, seed in (("first", 60, 0), ("measured", 40, 5), ("validation", 24, 7)):
            q = np.random.default_rng(seed).uniform(-2.0, 2.0, (count, planted.N))
            write_measured(measure(cell, q, seed=seed + 1), folder / f"{name}{kind}.csv")
    return folder


@pytest.fixture(scope="session")
def fitted(files: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished session of geometry."""
    place = tmp_path_factory.mktemp("fitted") / "cell"
    session = session_with(place, files / "robot.toml", "geometry", files / "measured.csv", files / "validation.csv")
    assert not go_on(session)
    return place
