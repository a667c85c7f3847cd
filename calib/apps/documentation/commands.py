"""Command that opens the documentation: docs."""

import sys
import webbrowser
from pathlib import Path

import typer

from calib.cli.shared import command, say
from calib.errors import UsageError, require

app = typer.Typer()

# where the package is used from a clone
CLONE = Path(__file__).parents[3]
PAGE = Path("docs/_build/html/index.html")
ADVICE = "in a clone of the project: pip install '.[docs]' && python docs/build.py"


@command(app, "Start")
def docs() -> None:
    """Open the documentation, or say how to build it.

    It is looked for in this folder and, if calib runs from a clone of the project, in the clone.

    Example: calib docs
    """
    pages = [folder / PAGE for folder in (Path.cwd(), CLONE)]
    built = [page for page in pages if page.is_file()]
    require(bool(built), f"the documentation has not been built here; {ADVICE}", UsageError)
    if sys.stdout.isatty():
        webbrowser.open(built[0].as_uri())
    say(str(built[0]))
