"""Command that opens the documentation: docs."""

import sys
import webbrowser
from pathlib import Path

import typer

from calib.cli.shared import command, say
from calib.errors import UsageError, require

app = typer.Typer()

CLONE = Path(__file__).parents[3]  # where the package is used from a clone
PAGE = Path("docs/_build/html/index.html")
ADVICE = "in a clone of the project: pip install '.[docs]' && python docs/build.py"


@command(app, "Start")
def docs() -> None:
    """Open the documentation, or say how to build it.

    It is looked for in this folder and, if calib runs from a clone of the project, in the clone.

    Example: calib docs
    """
    found = [place / PAGE for place in (Path.cwd(), CLONE) if (place / PAGE).is_file()]
    require(bool(found), f"the documentation has not been built here; {ADVICE}", UsageError)
    if sys.stdout.isatty():
        webbrowser.open(found[0].as_uri())
    say(str(found[0]))
