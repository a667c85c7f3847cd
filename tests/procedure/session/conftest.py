import shutil
from pathlib import Path

import pytest
from sessions import begin, copy_of, edit, go_on

from calib.apps.cell_demo import demo
from calib.procedure.session.folder import Session, open_session
from calib.simulation.virtual_cells import virtual_cell


@pytest.fixture(scope="session")
def planned_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session that waits for measurements."""
    folder = tmp_path_factory.mktemp("planned") / "cell"
    session = begin(folder, "lwr4plus", "cmm", 20, 8, seed=1, dynamics=False)
    edit(folder / "session.toml", 'model = "auto"', 'model = "geometry"')
    waiting = go_on(session)
    assert waiting is not None and waiting.step.name == "measure"
    return folder


@pytest.fixture(scope="session")
def finished_folder(planned_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session that has come to its certificate."""
    folder = tmp_path_factory.mktemp("finished") / "cell"
    shutil.copytree(planned_folder, folder)
    session = open_session(folder)
    demo.simulate_measurements(session, virtual_cell("lwr4plus"), 1)
    assert go_on(session, plots=True) is None
    return folder


planned, finished = copy_of("planned_folder"), copy_of("finished_folder")


@pytest.fixture
def measured(planned: Session) -> Session:
    demo.simulate_measurements(planned, virtual_cell("lwr4plus"), 1)
    return planned
