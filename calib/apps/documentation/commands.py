"""Command that shows the documentation: the built pages in a browser, or a page in the terminal."""

import re
import sys
import webbrowser
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from calib.cli.shared import command, make_console, say
from calib.errors import UsageError, one_of

app = typer.Typer()

# where the package is used from a clone
CLONE = Path(__file__).parents[3]
PAGE = Path("docs/_build/html/index.html")
# the pages' sources: in a clone a link to docs/, in an installed package a copy
SOURCES = Path(__file__).with_name("pages")
ADVICE = "all as web pages, in a clone: pip install '.[docs]' && python docs/build.py; then calib docs opens them"
REFERENCE = "commands: calib --help; files: calib formats; messages: calib explain CODE"
# directives of MyST: lists of pages, and files of a clone
DIRECTIVE = re.compile(r"^```\{(\w+)\} *(\S*)\n.*?^```\n", re.MULTILINE | re.DOTALL)


@command(app, "Start", listing=True)
def docs(topic: Annotated[str | None, typer.Argument()] = None) -> None:
    """Show the documentation: a page here, or the built pages in a browser.

    Built pages are looked for in this folder and, if calib runs from a clone of the project, in the clone. Without
    them, the topics are listed.

    Example: calib docs tracker

    Args:
        topic: a page, such as tracker or uncertainty
    """
    if topic is not None:
        _show(text_of(topic))
        return
    for page in (Path.cwd() / PAGE, CLONE / PAGE):
        if page.is_file():
            if sys.stdout.isatty():
                webbrowser.open(page.as_uri())
            say(str(page))
            return
    for name, path in pages().items():
        say(f"calib docs {name:25} {title(path)}")
    say(REFERENCE, ADVICE)


def pages() -> Mapping[str, Path]:
    """Return the pages by topic: name of the page's file, or of its folder for the folder's first page."""
    topics: dict[str, Path] = {}
    for path in sorted([*SOURCES.glob("*.md"), *SOURCES.glob("*/*.md")]):
        name = path.stem
        if name == "index" and path.parent != SOURCES:
            name = path.parent.name
        topics[name] = path
    return topics


def title(path: Path) -> str:
    """Return the heading of the page in a file."""
    return path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")


def text_of(topic: str) -> str:
    """Return a page as Markdown, without lists of pages and with the names of included files.

    Args:
        topic: name of the page.

    Raises:
        UsageError: there is no such page.
    """
    by_topic = pages()
    text = by_topic[one_of(topic, by_topic, "topic", UsageError)].read_text(encoding="utf-8")
    return DIRECTIVE.sub(_without_directive, text)


def _without_directive(match: re.Match[str]) -> str:
    name, file = match.groups()
    return f"In a clone: {file.removeprefix('../')}.\n" if name == "include" else ""


def _show(text: str) -> None:
    """Print Markdown: set for reading on a terminal, else as it is."""
    if not sys.stdout.isatty():
        say(text.rstrip())
        return
    from rich.markdown import Markdown

    make_console().print(Markdown(text))
