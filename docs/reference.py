"""Write the reference pages from what the program declares: commands, files, findings, exit codes, terms.

Each function returns one page's text; `write` puts them into ``reference/made``. Nothing here is typed by hand: an
option, a key, a column or a finding that is declared appears, one that is removed disappears.
"""

import pkgutil
import re
from collections.abc import Iterable, Iterator
from importlib import import_module
from inspect import cleandoc
from pathlib import Path
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
    return re.sub(r"([|<>*_\[\]`$\\~])", r"\\\1", " ".join(str(text).split()))


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table; its cells are Markdown."""
    lines = [list(head)]
    lines += [["---"] * len(lines[0]), *map(list, rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def code(text: object) -> str:
    """Return a text as code in a cell."""
    return f"`{' '.join(str(text).split())}`".replace("|", "\\|") if str(text) else ""


def paragraphs(text: str) -> str:
    """Return plain text as Markdown: its paragraphs, indented lines as code."""
    parts = re.split(r"\n\s*\n", cleandoc(text))
    return "\n\n".join(f"```text\n{cleandoc(part)}\n```" if part.startswith("  ") else cell(part) for part in parts)


# ---- commands -------------------------------------------------------------------------------------------------------


def commands() -> str:
    """Return the page of all commands, by their groups."""
    tree, groups = cli.command_tree(), dict[str, list[Any]]()
    printed = tree.get_help(tree.context_class(tree, info_name="calib"))  # in the order of calib --help
    for name in re.findall(r"^  (\w[\w-]*)  ", printed, flags=re.M):
        one = tree.commands[name]
        groups.setdefault(str(one.rich_help_panel or "All commands"), []).append(one)
    parts = ["# Commands\n\n`calib COMMAND --help` prints the same.", exit_codes()]
    for group, members in groups.items():
        parts += [f"## {group}", *map(_command, members)]
    return "\n\n".join(parts) + "\n"


def _command(one: Any) -> str:
    context = one.context_class(one, info_name=f"calib {one.name}")
    records = [(part, part.get_help_record(context)) for part in one.params]
    shown = [(part, *record) for part, record in records if record]
    usage = one.get_usage(context).removeprefix("Usage: ")
    parts = [
        f"(command-{one.name})=\n### calib {one.name}",
        paragraphs(one.help or ""),
        f"```text\n{cleandoc(usage)}\n```",
    ]
    for kind, head in (("argument", "Argument"), ("option", "Option")):
        rows = [(code(name), cell(words)) for part, name, words in shown if part.param_type_name == kind]
        if rows:
            parts.append(table((head, "Meaning"), rows))
    return "\n\n".join(parts)


def exit_codes() -> str:
    """Return the section of exit codes."""
    rows = re.findall(r"(\d+) (.*?)(?=, \d+ |\. |\.$|: details)", cli.EXIT_CODES)
    return "\n\n".join(
        [
            "(exit-codes)=\n## Exit codes",
            table(("Code", "Meaning"), [(number, cell(words)) for number, words in rows]),
            f"130: {cli.INTERRUPTED}.",
        ]
    )


# ---- docstrings -----------------------------------------------------------------------------------------------------

_SECTION = re.compile(r"(Args|Attributes|Returns|Yields|Raises):$")
_FILE_ROW = re.compile(r"(\S+(?: \S+)*)\s{2,}(\S.*)")


def readable(docstring: str) -> str:
    """Return a docstring as reStructuredText that renders as its author laid it out.

    Indented paragraphs are equations or code: kept line by line. Paragraphs of names, each with a text beside it that
    goes on below, become tables. Sections (``Args:``) are left to napoleon.
    """
    parts, literal = re.split(r"\n[ \t]*\n", docstring), False
    for k, part in enumerate(parts):
        if _SECTION.match(part):
            break
        indented = part.startswith("    ")
        if indented and not literal and k:
            parts[k - 1] = parts[k - 1].rstrip() + ("\n\n::" if not parts[k - 1].endswith(":") else ":")
        elif not indented:
            parts[k] = _names("``".join(_unmarked(text, n % 2) for n, text in enumerate(part.split("``"))))
        literal = indented or part.rstrip().endswith("::")
    return "\n\n".join(parts)


def _unmarked(text: str, code: int) -> str:
    """Return text whose bars and last underscores are no marks of reStructuredText; code as it is."""
    return text if code else re.sub(r"(?<=\w)_(?!\w)", r"\\_", text.replace("|", "∣"))


def _names(part: str) -> str:
    """Return a paragraph of names with a text beside each as a table; any other as it is."""
    lines = part.splitlines()
    if len(lines) < 2 or not any(line.startswith(" " * 8) for line in lines) or lines[0].startswith(("=", "..", " ")):
        return part
    rows: list[list[str]] = []
    for line in lines:
        found = _FILE_ROW.match(line)
        if line.startswith(" ") and rows:
            rows[-1][1] += f" {line.strip()}"
        else:
            rows.append([found[1], found[2]] if found else [line, ""])
    return _rst_table(("", ""), ([_literal(name), text] for name, text in rows))


# ---- files ----------------------------------------------------------------------------------------------------------


def topic(name: str) -> str:
    """Return the page of a kind of file (reStructuredText, as the docstrings that document it are)."""
    words, modules = formats.TOPICS[name]
    parts = [f".. _format-{name}:", f"{name}\n{'=' * len(name)}", f"{_plain(words)} (``calib formats {name}``)"]
    parts += [readable(cleandoc(import_module(module).__doc__ or "")) for module in modules.split()]
    if name in COLUMNS:
        parts += ["Columns\n-------", COLUMNS[name]()]
    if name == "session":
        parts += ["session.toml, as ``calib new`` writes it::", _indented(example())]
    if name in formats.SCHEMAS:
        parts += ["Keys\n----", f"``calib formats {name} --schema`` prints the JSON schema.", _keys(name)]
    return "\n\n".join(parts) + "\n"


def file_list() -> str:
    """Return the page that lists the kinds of files."""
    rows = [(f"[{name}](format-{name}.rst)", cell(words)) for name, (words, _) in formats.TOPICS.items()]
    tree = "\n".join(f"format-{name}" for name in formats.TOPICS)
    return f"# Files\n\n{table(('Topic', 'What it is'), rows)}\n```{{toctree}}\n:hidden:\n\n{tree}\n```\n"


def _indented(text: str) -> str:
    return "\n".join(f"    {line}" if line else "" for line in text.splitlines())


def _rst_table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    lines = [".. list-table::", "   :header-rows: 1", ""]
    for row in [head, *rows]:
        lines += [f"   {'* -' if k == 0 else '  -'} {text}".rstrip() for k, text in enumerate(row)]
    return "\n".join(lines)


def _literal(text: str) -> str:
    return f"``{text}``" if text else ""


def _plain(text: str) -> str:
    return re.sub(r"([\\`*|_])", r"\\\1", text)


def _keys(name: str) -> str:
    said = example_words(name)
    rows = [
        (_literal(key), _plain(held), _literal(default), _plain(words or said.get(key, "")))
        for key, held, default, words in formats.keys(name)
    ]
    return _rst_table(("Key", "Allowed", "Default", "Meaning"), rows)


_EXAMPLE_LINE = re.compile(r"    (?:\[\[([\w.]+)\]\]|\[(\w+).*?\]|(?:# )?(\w+) = .*?(?=$| +#)| )? *(?:# (.*))?")


def example_words(name: str) -> dict[str, str]:
    """Return what the comments in the example of a kind of TOML file say of its keys, by place (``loop.kp``)."""
    texts = [import_module(module).__doc__ or "" for module in formats.TOPICS[name][1].split()]
    texts += [_indented(example())] if name == "session" else []
    table, key, found = "", "", example_words("constraints") if name == "limits" else {}  # whose tables it takes, too
    for line in "\n".join(texts).splitlines():
        if not (parts := _EXAMPLE_LINE.fullmatch(line)) or not line.strip():
            table, key = "", ""
            continue
        tables, one, name, words = parts.groups()  # of [payload.tool] the second part is a name that the user gives
        if tables or one:
            table = key = tables or one
        elif name:
            key = f"{table}.{name}".lstrip(".")
        if words:
            found[key] = f"{found.get(key, '')} {words}".strip()
    return found


def _pose_columns() -> str:
    rows = [
        (
            ", ".join(map(_literal, one.names)), one.dimension or "–", _literal(one.family),
            f"{one.most:g}" if one.most < float("inf") else "–",
        )
        for one in vars(columns).values()
        if isinstance(one, Column)
    ]  # fmt: skip
    return _rst_table(("Names", "Dimension", "Unit stated under", "Largest value [SI]"), rows)


def _series() -> str:
    rows = [
        (_literal(ours), ", ".join(map(_literal, theirs)), ", ".join(map(_literal, SCALES.get(ours, ()))))
        for ours, theirs in SYNONYMS.items()
    ]
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
    for line in Path(findings.__file__).with_suffix(".toml").read_text(encoding="utf-8").splitlines():
        if found := re.match(r"# -+ \d+ (.+?) -+$", line):
            parts.append(f"## {found[1]}")
        elif found := re.match(r"\[([\w-]+)\]$", line):
            parts.append(_finding(found[1], findings.catalogue()[found[1]]))
    return "\n\n".join(parts) + "\n"


def _finding(name: str, one: findings.CatalogueEntry) -> str:
    says, advice = findings.example_texts(name)
    rows = [
        ("Says", cell(says)),
        ("Level", cell(findings.levels(one))),
        ("Means", cell(one.means)),
        ("Do", cell(advice)),
        ("Accept", code(f'accept = ["{one.accept}"]') if one.accept else ""),
    ]
    return f"(finding-{name})=\n### {name}\n\n" + table(("", ""), [row for row in rows if row[1]])


def terms() -> str:
    """Return the glossary."""
    entries = "\n\n".join(f"{term}\n: {meaning}" for term, meaning in findings.glossary().items())
    head = (
        "# Glossary\n\nThe field's terms as this toolkit uses them, one meaning each. `calib explain TERM` prints one."
    )
    return f"{head}\n\n{entries}\n"


def method_list() -> str:
    """Return the page of identification methods, effects and library robots."""
    methods = [(code(one.name), cell(one.description), cell(one.source), cell(one.assumes)) for one in calib.methods()]
    shapes = [(code(name), cell(one.unit), cell(", ".join(one.settings))) for name, one in SHAPES.items()]
    robots = [(code(name), str(arm.n), "yes" if arm.inertias is not None else "no") for name, arm in _arms()]
    return (
        "\n\n".join(
            [
                "# Methods, effects, robots",
                "## Identification methods\n\n`calib identify --method NAME`.",
                table(("Method", "What it does", "Source", "Assumes"), methods),
                "## Shapes of drive torque\n\n`[[term]] shape = NAME` of the options of `calib identify`; formulas: "
                "`calib.dynamics.shape_kernels`.",
                table(("Shape", "Unit of its parameter", "Settings"), shapes),
                "## Robots of the library\n\nAny command takes these names where it takes a file.",
                table(("Name", "Joints", "Masses known"), robots),
            ]
        )
        + "\n"
    )


def _arms() -> Iterator[tuple[str, Any]]:
    return ((name, library.load(name)) for name in library.names())


# ---- Python ---------------------------------------------------------------------------------------------------------


def api() -> dict[str, str]:
    """Return the pages of the Python API: `import calib`, and the modules of `calib.poses` and `calib.trajectories`."""
    given = [(name, getattr(calib, name)) for name in calib.__all__]
    parts = ["calib\n=====", ".. automodule:: calib\n   :no-members:"]
    for title, members in (
        ("Functions", [name for name, one in given if not isinstance(one, type)]),
        ("Settings", [name for name, one in given if isinstance(one, type) and name.endswith("Settings")]),
        ("Results", [name for name, one in given if isinstance(one, type) and not name.endswith("Settings")]),
    ):
        parts.append(f"{title}\n{'-' * len(title)}")
        parts += [_documented(f"calib.{name}", getattr(calib, name)) for name in members]
    return {"api-calib.rst": "\n\n".join(parts) + "\n"} | {
        f"api-{package.__name__.removeprefix('calib.')}.rst": _package(package) for package in (poses, trajectories)
    }


def _documented(name: str, one: Any) -> str:
    return f".. autoclass:: {name}\n   :members:" if isinstance(one, type) else f".. autofunction:: {name}"


def _package(package: Any) -> str:
    name = package.__name__
    modules = sorted(one.name for one in pkgutil.walk_packages(package.__path__, f"{name}."))
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
    }
    pages["files.md"] = file_list()
    pages |= {f"format-{name}.rst": topic(name) for name in formats.TOPICS} | api()
    MADE.mkdir(parents=True, exist_ok=True)
    for old in set(MADE.iterdir()) - {MADE / name for name in pages}:
        old.unlink()
    for name, text in pages.items():
        place = MADE / name
        if not place.exists() or place.read_text(encoding="utf-8") != text:
            place.write_text(text, encoding="utf-8")
