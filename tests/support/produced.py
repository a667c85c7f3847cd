"""Which findings the tests' files make the sources say: codes that have a level, noted as they are made."""

import sys
from pathlib import Path

import pytest

import calib
from calib.errors import Finding

SOURCES = str(Path(calib.__file__).parent)
CODES: set[str] = set()


def note() -> None:
    """Note the code of each finding that a source, not a test, makes from now on; examples of messages do not count."""
    from calib.procedure.findings import catalogue, level_of

    make = Finding.__init__

    def noted(self: Finding, *given: object, **named: object) -> None:
        make(self, *given, **named)
        frame = sys._getframe(1)
        while frame.f_back and frame.f_code.co_name == "finding":
            frame = frame.f_back
        is_source = frame.f_code.co_filename.startswith(SOURCES) and frame.f_code.co_name != "example"
        if is_source and self.code in catalogue() and level_of(self):
            CODES.add(self.code)

    Finding.__init__ = noted


def keep(config: pytest.Config) -> None:
    """Write what this process has noted into pytest's cache: a file for the quick tests and one for the slow, each."""
    worker = getattr(config, "workerinput", {}).get("workerid", "main")
    (config.cache.mkdir("findings") / f"{config.option.markexpr}, {worker}").write_text(" ".join(sorted(CODES)))


def kept(config: pytest.Config) -> set[str]:
    """Return the codes that all processes have noted."""
    return {code for path in config.cache.mkdir("findings").iterdir() for code in path.read_text().split()}
