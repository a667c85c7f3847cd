"""The same files asked about by command and by guided session, and the answers compared."""

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from sessions import begin, edit, quiet
from without_figures import DRAWING

from calib import cli
from calib.errors import CalibError
from calib.procedure.session import steps
from calib.procedure.session.folder import Session, locked, open_session

COMMAND = cli.command_tree()


@dataclass(frozen=True)
class Judgement:
    """What a command or a session said of the same files: nothing but `refused`, where it refused them."""

    verdict: str = ""
    reason: str = ""
    numbers: Any = None
    notes: frozenset[str] = frozenset()
    refused: str = ""


def same(one: Any, two: Any, where: str = "") -> None:
    """Assert that two JSON values are the same but for rounding."""
    if isinstance(one, Mapping):
        assert isinstance(two, Mapping) and set(one) == set(two), where
        for key in one:
            same(one[key], two[key], f"{where}.{key}")
    elif isinstance(one, list):
        assert len(one) == len(two), where
        for number, pair in enumerate(zip(one, two)):
            same(*pair, f"{where}[{number}]")
    elif isinstance(one, float):
        assert two == pytest.approx(one, rel=1e-6, abs=1e-9), where
    else:
        assert one == two, where


def agree(one: Judgement, two: Judgement) -> None:
    """Assert that two ways of asking gave one answer."""
    assert one.refused == two.refused
    assert (one.verdict, one.reason) == (two.verdict, two.reason)
    assert one.notes == two.notes
    same(one.numbers, two.numbers)


def refusal(work: Callable[[], Any]) -> str:
    """Return how `work` was refused, "" where it was not."""
    try:
        work()
    except CalibError as error:
        return str(error)
    return ""


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))


def command(*words: object) -> str:
    """Run a command, without figures; return how it was refused."""
    bare = ["--no-plots"] if words[0] in DRAWING else []
    arguments = [*(str(word) for word in words), *bare]
    return refusal(lambda: COMMAND(arguments, standalone_mode=False))


def session_with(folder: Path, robot: Path, model: str, *measured: Path) -> Session:
    """Make a session, with the measured files brought to it."""
    session = begin(folder, str(robot), "cmm", 4, 1, dynamics=False)
    settings = session.path("session.toml")
    for old, new in (("plan = true", "plan = false"), ('model = "auto"', f'model = "{model}"')):
        edit(settings, old, new)
    for path in measured:
        shutil.copyfile(path, session.path("3-measured") / path.name)
    return open_session(session.folder)


def go_on(session: Session) -> str:
    """Run a session to its end, or to where it waits; return how it was refused."""

    def work() -> None:
        with locked(session, quiet):
            steps.run_next(open_session(session.folder, plots=False), quiet, quiet)

    return refusal(work)
