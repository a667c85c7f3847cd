"""The command line that the studies share: where their metrics go, the seed, and a few options of each."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def read(document: str | None, **options: str | tuple[Any, str]) -> argparse.Namespace:
    """Return the options of the command line; create the folder ``--out``.

    Args:
        document: the script's docstring, whose first line is its help.
        options: beside ``--out`` and ``--seed``: words of a switch, or default and words of a value (a tuple as the
            default: the values there are, the first by default).
    """
    parser = argparse.ArgumentParser(description=(document or "").split("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for metrics.json and figures")
    for name, given in ({"seed": (0, "of everything random")} | options).items():
        if isinstance(given, str):
            parser.add_argument(f"--{name}", action="store_true", help=given)
        elif isinstance(given[0], tuple):
            parser.add_argument(f"--{name}", choices=given[0], default=given[0][0], help=given[1])
        else:
            kind = str if given[0] is None else type(given[0])
            parser.add_argument(f"--{name}", type=kind, default=given[0], help=given[1])
    found = parser.parse_args()
    found.out.mkdir(parents=True, exist_ok=True)
    return found
