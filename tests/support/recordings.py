"""Where the real recordings are: outside the repository, ``CALIB_DATA``, default ``../shared/data``."""

import os
from pathlib import Path

DATA = Path(os.environ.get("CALIB_DATA", Path(__file__).parents[3] / "shared" / "data"))
