"""Results as text: what the commands print, for ``print(result)``."""

from __future__ import annotations

import io
from collections.abc import Iterable
from typing import Any

WIDTH = 120


def as_text(renderables: Iterable[Any]) -> str:
    """Return rich renderables as plain text without colours."""
    from rich.console import Console

    console = Console(file=io.StringIO(), width=WIDTH, highlight=False, color_system=None)
    for each in renderables:
        console.print(each, soft_wrap=True)
    return console.file.getvalue().rstrip()  # type: ignore[attr-defined]


def data_frame(rows: Iterable[Any], columns: list[str]) -> Any:
    """Return rows as a pandas DataFrame.

    Raises:
        UsageError: where pandas is not installed.
    """
    from calib.errors import UsageError

    try:
        from pandas import DataFrame  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise UsageError("to_dataframe needs pandas: pip install pandas; to_dict does without") from error
    return DataFrame(list(rows), columns=columns)
