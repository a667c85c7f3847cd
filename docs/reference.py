"""Write the reference pages from what the program declares: commands, files, findings, exit codes, terms.

Each function returns one page's text; `write` puts them into ``reference/made``. Nothing here is typed by hand: an
option, a key, a column or a finding that is declared appears, one that is removed disappears.
"""

import pkgutil
import re
from collections.abc import Iterable
from importlib import import_module
from inspect import cleandoc
from pathlib import Path
from textwrap import indent
from typing import Any

import calib
from calib import cli, poses, trajectories
from calib.data.poses import columns
from calib.data.recordings.recording_options import SCALES, SYNONYMS
from calib.data.schema import Column
from calib.dynamics.shapes import SHAPES
from calib.procedure import findings, formats
from calib.procedure.session.settings import example
from calib.robot import library

MADE = Path(__file__).parent / "reference/made"


def cell(text: object) -> str:
    """Return a text as a cell of a Markdown table: on one line, its marks as they are."""
    line = " ".join(str(text).split())
    return re.sub(r"([|<>*_\[\]`$\\~])", r"\\\1", line)


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table; its cells are Markdown."""
    names = list(head)
    text = ""
    for row in [names, ["---"] * len(names), *rows]:
        text += f"| {' | '.join(row)} |\n"
    return text


def code(text: object) -> str:
    """Return a text as code in a cell."""
    line = " ".join(str(text).split())
    if not line:
        return ""
    return f"`{line}`".replace("|", "\\|")


def paragraphs(text: str) -> str:
    """Return plain text as Markdown: its paragraphs, indented lines as code."""
    result = []
    for part in re.split(r"\n\s*\n", cleandoc(text)):
        if part.startswith("  "):
            result.append(_verbatim(part))
        else:
            result.append(cell(part))
    return "\n\n".join(result)


def _verbatim(text: str) -> str:
    """Return a text as a fenced block."""
    return f"```text\n{cleandoc(text)}\n```"


# ---- commands -------------------------------------------------------------------------------------------------------


def commands() -> str:
    """Return the page of all commands, by their groups."""
    tree = cli.command_tree()
    groups: dict[str, list[Any]] = {}
    printed = tree.get_help(tree.context_class(tree, info_name="calib"))  # in the order of calib --help
    for name in re.findall(r"^  (\w[\w-]*)  ", printed, flags=re.M):
        command = tree.commands[name]
        group = str(command.rich_help_panel or "All commands")
        groups.setdefault(group, []).append(command)
    parts = ["# Commands\n\n`calib COMMAND --help` prints the same.", exit_codes()]
    for group, members in groups.items():
        parts.append(f"## {group}")
        parts += [_command(command) for command in members]
    return "\n\n".join(parts) + "\n"


def _command(command: Any) -> str:
    """Return the section of a command: help, usage, and tables of its arguments and options."""
    context = command.context_class(command, info_name=f"calib {command.name}")
    usage = command.get_usage(context).removeprefix("Usage: ")
    parts = [f"(command-{command.name})=\n### calib {command.name}", paragraphs(command.help or ""), _verbatim(usage)]
    # hidden parameters have no record
    rows: dict[str, list[tuple[str, str]]] = {"argument": [], "option": []}
    for parameter in command.params:
        record = parameter.get_help_record(context)
        if record:
            name, meaning = record
            rows[parameter.param_type_name].append((code(name), cell(meaning)))
    for kind, head in (("argument", "Argument"), ("option", "Option")):
        if rows[kind]:
            parts.append(table((head, "Meaning"), rows[kind]))
    return "\n\n".join(parts)


def exit_codes() -> str:
    """Return the section of exit codes."""
    codes = re.findall(r"(\d+) (.*?)(?=, \d+ |\. |\.$|: details)", cli.EXIT_CODES)
    rows = [(number, cell(meaning)) for number, meaning in codes]
    parts = ["(exit-codes)=\n## Exit codes", table(("Code", "Meaning"), rows), f"130: {cli.INTERRUPTED}."]
    return "\n\n".join(parts)


# ---- docstrings -----------------------------------------------------------------------------------------------------

_SECTION = re.compile(r"(Args|Attributes|Returns|Yields|Raises):$")
_FILE_ROW = re.compile(r"(\S+(?: \S+)*)\s{2,}(\S.*)")


def readable(docstring: str) -> str:
    """Return a docstring as reStructuredText that renders as its author laid it out.

    Indented paragraphs are equations or code: kept line by line. Paragraphs of names, each with a text beside it that
    goes on below, become tables. Sections (``Args:``) are left to napoleon.
    """
    parts = re.split(r"\n[ \t]*\n", docstring)
    literal = False
    for k, part in enumerate(parts):
        if _SECTION.match(part):
            break
        indented = part.startswith("    ")
        if not indented:
            parts[k] = _names(_without_marks(part))
        elif not literal and k:
            parts[k - 1] = _before_literal(parts[k - 1].rstrip())
        literal = indented or part.rstrip().endswith("::")
    return "\n\n".join(parts)


def _before_literal(part: str) -> str:
    """Return a paragraph with the two colons that announce a literal block."""
    if part.endswith(":"):
        return f"{part}:"
    return f"{part}\n\n::"


def _without_marks(part: str) -> str:
    """Return a paragraph whose bars and last underscores are no marks of reStructuredText; code as it is."""
    pieces = part.split("``")
    for k in range(0, len(pieces), 2):  # every second one is code
        plain = pieces[k].replace("|", "∣")
        pieces[k] = re.sub(r"(?<=\w)_(?!\w)", r"\\_", plain)
    return "``".join(pieces)


def _names(part: str) -> str:
    """Return a paragraph of names with a text beside each as a table; any other as it is."""
    lines = part.splitlines()
    has_continuation = any(line.startswith(" " * 8) for line in lines)
    if len(lines) < 2 or not has_continuation or lines[0].startswith(("=", "..", " ")):
        return part
    rows: list[list[str]] = []
    for line in lines:
        match = _FILE_ROW.match(line)
        if line.startswith(" ") and rows:
            rows[-1][1] += f" {line.strip()}"
        elif match:
            rows.append([_literal(match[1]), match[2]])
        else:
            rows.append([_literal(line), ""])
    return _rst_table(("", ""), rows)


# ---- files ----------------------------------------------------------------------------------------------------------


def topic(name: str) -> str:
    """Return the page of a kind of file (reStructuredText, as the docstrings that document it are)."""
    summary, modules = formats.TOPICS[name]
    parts = [f".. _format-{name}:", f"{name}\n{'=' * len(name)}", f"{_plain(summary)} (``calib formats {name}``)"]
    parts += [readable(docstring) for docstring in _docstrings(modules)]
    if name in COLUMNS:
        parts += ["Columns\n-------", COLUMNS[name]()]
    if name == "session":
        parts += ["session.toml, as ``calib new`` writes it::", _indented(example())]
    if name in formats.SCHEMAS:
        parts += ["Keys\n----", f"``calib formats {name} --schema`` prints the JSON schema.", _keys(name)]
    return "\n\n".join(parts) + "\n"


def _docstrings(modules: str) -> list[str]:
    """Return the docstrings of modules, whose names are separated by blanks."""
    return [cleandoc(import_module(module).__doc__ or "") for module in modules.split()]


def file_list() -> str:
    """Return the page that lists the kinds of files."""
    rows = []
    for name, (summary, _) in formats.TOPICS.items():
        rows.append((f"[{name}](format-{name}.rst)", cell(summary)))
    toctree = "\n".join(f"format-{name}" for name in formats.TOPICS)
    return f"# Files\n\n{table(('Topic', 'What it is'), rows)}\n```{{toctree}}\n:hidden:\n\n{toctree}\n```\n"


def _indented(text: str) -> str:
    return indent(text, "    ").removesuffix("\n")


def _rst_table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a table in reStructuredText."""
    lines = [".. list-table::", "   :header-rows: 1", ""]
    for row in [head, *rows]:
        bullet = "* -"
        for text in row:
            lines.append(f"   {bullet} {text}".rstrip())
            bullet = "  -"
    return "\n".join(lines)


def _literal(text: str) -> str:
    return f"``{text}``" if text else ""


def _literals(texts: Iterable[str]) -> str:
    return ", ".join(_literal(text) for text in texts)


def _plain(text: str) -> str:
    return re.sub(r"([\\`*|_])", r"\\\1", text)


def _keys(name: str) -> str:
    """Return the table of the keys of a kind of TOML file; meanings come from its schema, else from its example."""
    comments = example_words(name)
    rows = []
    for key, allowed, default, meaning in formats.keys(name):
        rows.append((_literal(key), _plain(allowed), _literal(default), _plain(meaning or comments.get(key, ""))))
    return _rst_table(("Key", "Allowed", "Default", "Meaning"), rows)


_EXAMPLE_LINE = re.compile(
    r"    (?:\[\[(?P<array>[\w.]+)\]\]|\[(?P<table>\w+).*?\]|(?:# )?(?P<key>\w+) = .*?(?=$| +#)| )?"
    r" *(?:# (?P<comment>.*))?"
)


def example_words(name: str) -> dict[str, str]:
    """Return what the comments in the example of a kind of TOML file say of its keys, by place (``loop.kp``)."""
    modules = formats.TOPICS[name][1].split()
    texts = [import_module(module).__doc__ or "" for module in modules]
    if name == "session":
        texts.append(_indented(example()))
    comments: dict[str, str] = {}
    if name == "limits":
        comments = example_words("constraints")  # whose tables it takes, too
    table = ""
    key = ""
    for line in "\n".join(texts).splitlines():
        match = _EXAMPLE_LINE.fullmatch(line)
        if not match or not line.strip():
            table = ""
            key = ""
            continue
        # of [payload.tool] the second part is a name that the user gives
        if match["array"] or match["table"]:
            table = match["array"] or match["table"]
            key = table
        elif match["key"]:
            key = f"{table}.{match['key']}".lstrip(".")
        if match["comment"]:
            comments[key] = f"{comments.get(key, '')} {match['comment']}".strip()
    return comments


def _pose_columns() -> str:
    """Return the table of the columns of measured poses."""
    rows = []
    for column in vars(columns).values():
        if isinstance(column, Column):
            largest = "–" if column.most == float("inf") else f"{column.most:g}"
            rows.append((_literals(column.names), column.dimension or "–", _literal(column.family), largest))
    return _rst_table(("Names", "Dimension", "Unit stated under", "Largest value [SI]"), rows)


def _series() -> str:
    """Return the table of the series of recordings."""
    rows = []
    for series, synonyms in SYNONYMS.items():
        rows.append((_literal(series), _literals(synonyms), _literals(SCALES.get(series, ()))))
    return _rst_table(("Series", "Accepted names", "Units"), rows)


COLUMNS = {"measurements": _pose_columns, "recordings": _series}


# ---- findings, terms, methods, effects, robots -----------------------------------------------------------------------


def finding_list() -> str:
    """Return the page of all findings."""
    intro = (
        "What `calib` may say about data and results: on the console, on the certificate, in `metrics.json`. "
        "`calib explain CODE` prints one. A verdict is the worst level among the findings; `accept` in the options "
        "file makes a finding a note. The numbers and names are examples."
    )
    parts = ["# Findings", intro]
    catalogue = findings.catalogue()
    text = Path(findings.__file__).with_suffix(".toml").read_text(encoding="utf-8")
    for line in text.splitlines():
        section = re.match(r"# -+ \d+ (.+?) -+$", line)
        entry = re.match(r"\[([\w-]+)\]$", line)
        if section:
            parts.append(f"## {section[1]}")
        elif entry:
            parts.append(_finding(entry[1], catalogue[entry[1]]))
    return "\n\n".join(parts) + "\n"


def _finding(name: str, entry: findings.CatalogueEntry) -> str:
    """Return the section of a finding."""
    sentence, advice = findings.example_texts(name)
    rows = [
        ("Says", cell(sentence)),
        ("Level", cell(findings.levels(entry))),
        ("Means", cell(entry.means)),
        ("Do", cell(advice)),
    ]
    if entry.accept:
        rows.append(("Accept", code(f'accept = ["{entry.accept}"]')))
    filled = [row for row in rows if row[1]]
    return f"(finding-{name})=\n### {name}\n\n" + table(("", ""), filled)


def terms() -> str:
    """Return the glossary."""
    head = (
        "# Glossary\n\nThe field's terms as this toolkit uses them, one meaning each. `calib explain TERM` prints one."
    )
    entries = [f"{term}\n: {meaning}" for term, meaning in findings.glossary().items()]
    return "\n\n".join([head, *entries]) + "\n"


def method_list() -> str:
    """Return the page of identification methods, effects and library robots."""
    methods = []
    for method in calib.methods():
        row = (code(method.name), cell(method.description), cell(method.source), cell(method.assumes))
        methods.append(row)
    shapes = []
    for name, shape in SHAPES.items():
        shapes.append((code(name), cell(shape.unit), cell(", ".join(shape.settings))))
    robots = []
    for name in library.names():
        arm = library.load(name)
        robots.append((code(name), str(arm.n), "no" if arm.inertias is None else "yes"))
    parts = [
        "# Methods, effects, robots",
        "## Identification methods\n\n`calib identify --method NAME`.",
        table(("Method", "What it does", "Source", "Assumes"), methods),
        "## Shapes of drive torque\n\n`[[term]] shape = NAME` of the options of `calib identify`; formulas: "
        "`calib.dynamics.shape_kernels`.",
        table(("Shape", "Unit of its parameter", "Settings"), shapes),
        "## Robots of the library\n\nAny command takes these names where it takes a file.",
        table(("Name", "Joints", "Masses known"), robots),
    ]
    return "\n\n".join(parts) + "\n"


# ---- Python ---------------------------------------------------------------------------------------------------------


def api() -> dict[str, str]:
    """Return the pages of the Python API: `import calib`, and the modules of `calib.poses` and `calib.trajectories`."""
    members: dict[str, list[str]] = {"Functions": [], "Settings": [], "Results": []}
    for name in calib.__all__:
        if not isinstance(getattr(calib, name), type):
            members["Functions"].append(name)
        elif name.endswith("Settings"):
            members["Settings"].append(name)
        else:
            members["Results"].append(name)
    parts = ["calib\n=====", ".. automodule:: calib\n   :no-members:"]
    for title, names in members.items():
        parts.append(f"{title}\n{'-' * len(title)}")
        parts += [_documented(name) for name in names]
    pages = {"api-calib.rst": "\n\n".join(parts) + "\n"}
    for package in (poses, trajectories):
        name = package.__name__.removeprefix("calib.")
        pages[f"api-{name}.rst"] = _package(package)
    return pages


def _documented(name: str) -> str:
    """Return the directive that documents a name of `import calib`."""
    if isinstance(getattr(calib, name), type):
        return f".. autoclass:: calib.{name}\n   :members:"
    return f".. autofunction:: calib.{name}"


def _package(package: Any) -> str:
    """Return the page of a package and its modules."""
    name = package.__name__
    modules = sorted(module.name for module in pkgutil.walk_packages(package.__path__, f"{name}."))
    parts = [f"{name}\n{'=' * len(name)}", f".. automodule:: {name}\n   :no-members:"]
    for module in modules:
        parts += [f"{module}\n{'-' * len(module)}", f".. automodule:: {module}\n   :members:"]
    return "\n\n".join(parts) + "\n"


def write() -> None:
    """Write all pages; those whose text is as before keep their date."""
    pages = {
        "commands.md": commands(),
        "findings.md": finding_list(),
        "glossary.md": terms(),
        "methods.md": method_list(),
        "files.md": file_list(),
    }
    for name in formats.TOPICS:
        pages[f"format-{name}.rst"] = topic(name)
    pages |= api()
    MADE.mkdir(parents=True, exist_ok=True)
    for path in MADE.iterdir():
        if path.name not in pages:
            path.unlink()
    for name, text in pages.items():
        path = MADE / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
