"""Sessions driven from tests: go on in silence, edit a file."""

from __future__ import annotations

from pathlib import Path

from calib.procedure.session import steps
from calib.procedure.session.folder import Session, locked, open_session


def quiet(words: str) -> None:
    """Say nothing."""


def go_on(session: Session) -> steps.State | None:
    with locked(session, quiet):
        return steps.run_next(open_session(session.folder), quiet, quiet)


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
