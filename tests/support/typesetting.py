"""The PDF of a process's first certificate stands for all that no test reads: hundreds are written, 30 ms each."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import pytest

from calib.procedure.report.certificate import rendering

_typeset = rendering._typeset
_first: dict[bool, bytes] = {}


def _once(inputs: Mapping[str, bytes], dense: bool) -> tuple[bytes, list[str]]:
    """Return the PDF of the first certificate, and no notes."""
    if dense not in _first:
        _first[dense] = _typeset(inputs, dense)[0]
    return _first[dense], []


def spare() -> None:
    """Let certificates be typeset once in this process."""
    rendering._typeset = _once


@contextmanager
def each_typeset() -> Iterator[None]:
    """Let each certificate that is written within the block be typeset."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rendering, "_typeset", _typeset)
        yield
