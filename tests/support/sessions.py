"""Sessions driven from tests: go on in silence, edit a file."""

import shutil
from pathlib import Path
from typing import Any

import pytest

from calib.procedure.session import steps
from calib.procedure.session.commands import new_session
from calib.procedure.session.folder import Session, locked, open_session


def quiet(words: str) -> None:
    """Say nothing."""


def go_on(session: Session, plots: bool = False) -> steps.State | None:
    """Run a session as far as it goes; figures take most of the time, so that a test has to ask for them."""
    with locked(session, quiet):
        return steps.run_next(open_session(session.folder, plots), quiet, quiet)


def kinds(session: Session) -> dict[str, str]:
    """Return the status of each step by its name, read from the folder anew."""
    return {state.step.name: state.kind for state in steps.states(open_session(session.folder))}


def copy_of(source: str) -> Any:
    """Return a fixture: a copy of the session that the fixture `source` made, opened."""

    @pytest.fixture
    def opened(request: pytest.FixtureRequest, tmp_path: Path) -> Session:
        shutil.copytree(request.getfixturevalue(source), tmp_path / "cell")
        return open_session(tmp_path / "cell")

    return opened


def begin(folder: Path, robot: str, instrument: str, poses: int = 40, validation: int = 20, **keys: Any) -> Session:
    """Make a session and open it."""
    return open_session(new_session(folder, robot, instrument, poses=poses, validation=validation, **keys))


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
