"""Where the real recordings are.

They live outside the repository: ``CALIB_DATA``, default ``../shared/data``. Tests that need them are skipped, with the
reason, where the folder is absent.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from recordings import DATA


@pytest.fixture
def data() -> Path:
    """Return the folder of real recordings, or skip."""
    if not DATA.is_dir():
        pytest.skip(f"no folder of real recordings at {DATA} (set CALIB_DATA)")
    return DATA
