"""Where the real recordings are: outside the repository, ``CALIB_DATA``, default ``../shared/data``."""

from __future__ import annotations

import os
from pathlib import Path

DATA = Path(os.environ.get("CALIB_DATA", Path(__file__).parents[3] / "shared" / "data"))
