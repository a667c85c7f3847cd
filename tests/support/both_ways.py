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


def same(first: Any, second: Any, where: str = "") -> None:
    """Assert that two JSON values are the same but for rounding."""
    if isinstance(first, Mapping):
        assert isinstance(second, Mapping) and set(first) == set(second), where
        for key in first:
            same(first[key], second[key], f"{where}.{key}")
    elif isinstance(first, list):
        assert len(first) == len(second), where
        for number, pair in enumerate(zip(first, second)):
            same(*pair, f"{where}[{number}]")
    elif isinstance(first, float):
        assert second == pytest.approx(first, rel=1e-6, abs=1e-9), where
    else:
        assert first == second, where


def agree(first: Judgement, second: Judgement) -> None:
    """Assert that two ways of asking gave one answer."""
    assert first.refused == second.refused
    assert (first.verdict, first.reason) == (second.verdict, second.reason)
    assert first.notes == second.notes
    same(first.numbers, second.numbers)


def refusal(work: Callable[[], Any]) -> str:
    """Return how `work` was refused, "" where it was not."""
    try:
        work()
    except CalibError as error:
        return str(error)
    return ""


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))


def command(name: str, *arguments: object) -> str:
    """Run a command, without figures; return how it was refused."""
    line = [name, *(str(argument) for argument in arguments)]
    if name in DRAWING:
        line.append("--no-plots")
    return refusal(lambda: COMMAND(line, standalone_mode=False))


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
