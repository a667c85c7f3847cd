"""Which findings the tests' files make the sources say: codes that have a level, noted as they are made."""

import sys
from pathlib import Path

import calib
from calib.errors import Finding

SOURCES = str(Path(calib.__file__).parent)
CODES: set[str] = set()
KEY = "calib/findings"  # of the codes of the quick tests, in pytest's cache


def note() -> None:
    """Note the code of each finding that a source, not a test, makes from now on."""
    from calib.procedure.findings import catalogue, level_of

    make = Finding.__init__

    def noted(self: Finding, *given: object, **named: object) -> None:
        make(self, *given, **named)
        frame = sys._getframe(1)
        while frame.f_back and frame.f_code.co_name == "finding":
            frame = frame.f_back
        if frame.f_code.co_filename.startswith(SOURCES) and self.code in catalogue() and level_of(self):
            CODES.add(self.code)

    Finding.__init__ = noted
