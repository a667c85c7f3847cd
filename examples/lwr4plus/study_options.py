"""The command line that the studies share: where their metrics go, the seed, and a few options of each."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def read(document: str | None, **options: str | tuple[Any, str]) -> argparse.Namespace:
    """Return the options of the command line; create the folder ``--out``.

    Args:
        document: the script's docstring, whose first line is its help.
        options: beside ``--out`` and ``--seed``: the help of a switch, or default and help of a value (a tuple as the
            default: the values there are, the first by default).
    """
    parser = argparse.ArgumentParser(description=(document or "").split("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for metrics.json and figures")
    parser.add_argument("--seed", type=int, default=0, help="of everything random")
    for name, option in options.items():
        if isinstance(option, str):
            parser.add_argument(f"--{name}", action="store_true", help=option)
            continue
        default, text = option
        if isinstance(default, tuple):
            parser.add_argument(f"--{name}", choices=default, default=default[0], help=text)
        elif default is None:
            parser.add_argument(f"--{name}", help=text)
        else:
            parser.add_argument(f"--{name}", type=type(default), default=default, help=text)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    return arguments
