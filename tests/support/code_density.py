"""How dense code is, whatever its line length: tokens and comprehensions per statement, names that say nothing.

    python tests/support/code_density.py            # today's figures beside those of tests/size.toml
    python tests/support/code_density.py --lower    # write those that fell into tests/size.toml; none is raised

Only simple statements count (assignments, returns, calls, raises, asserts, deletions; docstrings do not), so that a
loop's body is not counted twice. Tokens are names, numbers, strings and operators.
"""

import argparse
import ast
import bisect
import math
import re
import tomllib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
FIGURES_FILE = ROOT / "tests/size.toml"
PACKAGES = ("calib", "poses", "trajectories")
WRITTEN_TO_BE_READ = (*PACKAGES, "examples", "docs")
NESTED_STATEMENT = 3  # comprehensions and conditionals in a statement from which on it is called nested

EMPTY_WORDS = """
    one own other others each every found given known told left kept seen rest whole wanted asked stated said
    words word those them this that it its these same some any both more most least now there here way ways place
    alone apart inside outside beyond far near late taken shown moved made done named called judged learnt looked
    tried used held thing things what which who how why again already ours theirs mine
"""
EMPTY_NAMES = frozenset(EMPTY_WORDS.split())
CONVENTIONAL_NAMES = frozenset({"self", "cls", "_"})
SIMPLE_STATEMENTS = (ast.Assign, ast.AugAssign, ast.AnnAssign, ast.Return, ast.Expr, ast.Raise, ast.Assert, ast.Delete)
CONDENSED_EXPRESSIONS = (
    ast.ListComp,
    ast.GeneratorExp,
    ast.DictComp,
    ast.SetComp,
    ast.IfExp,
    ast.Lambda,
    ast.NamedExpr,
)
# comments and space, or a token that counts; the same tokens as of Python 3.11's tokenizer, at a fifth of its time
TOKEN = re.compile(
    r"""
    (?P<passed> \#[^\n]* | \s+ | \\\n )
    | (?:[rRbBuU]|[fF][rR]?|[rR][fFbB]|[bB][rR])?
      (?: \"{3}(?:[^\\]|\\.)*?\"{3} | '{3}(?:[^\\]|\\.)*?'{3} | "(?:[^"\\\n]|\\.)*" | '(?:[^'\\\n]|\\.)*' )
    | 0[xX][\da-fA-F_]+ | 0[oO][0-7_]+ | 0[bB][01_]+
    | (?:\d[\d_]*\.?[\d_]*|\.\d[\d_]*)(?:[eE][-+]?\d[\d_]*)?[jJ]?
    | \w+
    | \*\*=? | //=? | >>=? | <<=? | \.\.\. | -> | := | [-+*/%&@|^=<>!]= | [^\s]
    """,
    re.VERBOSE | re.DOTALL,
)


@dataclass(frozen=True)
class Density:
    """Density of the modules of a package; the names are those of tests/size.toml."""

    tokens_per_statement: float
    comprehensions_per_100_statements: float  # conditional expressions, lambdas and walruses with them
    nested_per_100_statements: float  # statements with NESTED_STATEMENT of those or more
    empty_names_percent: float  # of all names that are bound
    fmt_skip: int
    any_annotations: int  # uses of typing.Any: each hides an argument or a result from the type checker


def modules(package: str) -> list[Path]:
    """Return the modules of a package, sorted by path."""
    return sorted((ROOT / package).rglob("*.py"))


@cache
def token_starts(text: str) -> list[int]:
    """Return the characters of a module at which its counted tokens start."""
    return [match.start() for match in TOKEN.finditer(text) if match.lastgroup is None]


def tokens_by_package() -> Counter[str]:
    """Return the number of tokens by package: calib, each package directly below it, poses, trajectories."""
    counted: Counter[str] = Counter()
    for package in PACKAGES:
        for path in modules(package):
            folders = path.relative_to(ROOT).parent.parts
            name = "/".join(folders[:2]) if package == "calib" else package
            counted[name] += len(token_starts(path.read_text(encoding="utf-8")))
    return counted


class Positions:
    """Characters of a module by line and column; the parser counts columns in bytes."""

    def __init__(self, text: str) -> None:
        self.lines = text.split("\n")
        self.starts = [0]
        for line in self.lines:
            self.starts.append(self.starts[-1] + len(line) + 1)

    def character(self, line: int, byte_column: int) -> int:
        """Return how many characters stand before a column of a line, which counts from 1."""
        text = self.lines[line - 1]
        column = byte_column if text.isascii() else len(text.encode()[:byte_column].decode())
        return self.starts[line - 1] + column


def statement_tokens(statement: ast.stmt, starts: list[int], positions: Positions) -> int:
    """Return how many tokens a statement has."""
    assert statement.end_lineno is not None and statement.end_col_offset is not None
    first = bisect.bisect_left(starts, positions.character(statement.lineno, statement.col_offset))
    behind = bisect.bisect_left(starts, positions.character(statement.end_lineno, statement.end_col_offset))
    return behind - first


def descendants(root: ast.AST, stop: tuple[type[ast.AST], ...] = ()) -> list[ast.AST]:
    """Return a node and all below it, but nothing below nodes of some types; as `ast.walk`, at half its time."""
    nodes = [root]
    for node in nodes:
        if isinstance(node, stop):
            continue
        for name in node._fields:
            value = getattr(node, name, None)
            if isinstance(value, list):
                nodes.extend(item for item in value if isinstance(item, ast.AST))
            elif isinstance(value, ast.AST) and value._fields:
                nodes.append(value)
    return nodes


def simple_statements(nodes: list[ast.AST]) -> Iterator[ast.stmt]:
    """Yield the simple statements among a module's nodes but its docstrings and bare constants."""
    for node in nodes:
        if not isinstance(node, SIMPLE_STATEMENTS):
            continue
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            continue
        yield node


def bound_names(nodes: list[ast.AST]) -> Iterator[str]:
    """Yield the name of every parameter and of every assigned variable but self, cls and _."""
    for node in nodes:
        if isinstance(node, ast.arg):
            name = node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            name = node.id
        else:
            continue
        if name not in CONVENTIONAL_NAMES:
            yield name


def measure(package: str) -> Density:
    """Return the density of a package's modules."""
    return density_of([path.read_text(encoding="utf-8") for path in modules(package)])


def density_of(texts: list[str]) -> Density:
    """Return the density of modules by their source texts."""
    statements = tokens = condensed = nested = bindings = empty = skips = unchecked = 0
    for text in texts:
        nodes = descendants(ast.parse(text), stop=SIMPLE_STATEMENTS)
        starts = token_starts(text)
        positions = Positions(text)
        skips += text.count("fmt: skip")
        for statement in list(simple_statements(nodes)):
            parts = descendants(statement)
            nodes += parts[1:]
            statements += 1
            tokens += statement_tokens(statement, starts, positions)
            count = sum(isinstance(node, CONDENSED_EXPRESSIONS) for node in parts)
            condensed += count
            nested += count >= NESTED_STATEMENT
        unchecked += sum(isinstance(node, ast.Name) and node.id == "Any" for node in nodes)
        for name in bound_names(nodes):
            bindings += 1
            empty += name.strip("_") in EMPTY_NAMES
    return Density(
        tokens_per_statement=tokens / max(statements, 1),
        comprehensions_per_100_statements=100 * condensed / max(statements, 1),
        nested_per_100_statements=100 * nested / max(statements, 1),
        empty_names_percent=100 * empty / max(bindings, 1),
        fmt_skip=skips,
        any_annotations=unchecked,
    )


def agreed_density() -> dict[str, Density]:
    """Return the density by package that tests/size.toml states."""
    tables = tomllib.loads(FIGURES_FILE.read_text(encoding="utf-8"))["density"]
    return {package: Density(**figures) for package, figures in tables.items()}


def token_budgets() -> dict[str, int]:
    """Return the number of tokens by package that tests/size.toml states."""
    return tomllib.loads(FIGURES_FILE.read_text(encoding="utf-8"))["tokens"]


def lowered(text: str, section: str, key: str, value: float) -> str:
    """Return the text of tests/size.toml with a figure replaced, if the new one is lower."""
    header = f"[{section}]\n"
    start = text.index(header) + len(header)
    end = text.find("\n[", start)
    if end < 0:
        end = len(text)
    line = re.compile(rf"^{re.escape(key)} = ([\d._]+)$", re.MULTILINE).search(text, start, end)
    if line is None or value >= float(line[1]):
        return text
    if isinstance(value, int):
        written = f"{value:_d}"
    else:
        written = f"{math.ceil(1000 * value) / 1000:.3f}"
    return text[: line.start(1)] + written + text[line.end(1) :]


def main() -> None:
    """Print today's figures beside the agreed ones; with ``--lower`` write those that fell."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--lower", action="store_true", help="write the figures that fell into tests/size.toml")
    write = options.parse_args().lower

    text = FIGURES_FILE.read_text(encoding="utf-8")
    for package, agreed in agreed_density().items():
        measured = vars(measure(package))
        for key, limit in vars(agreed).items():
            print(f"{package:20} {key:36} {measured[key]:10.3f} (agreed {limit:.3f})")
            text = lowered(text, f"density.{package}", key, measured[key])

    budgets = token_budgets()
    for package, count in sorted(tokens_by_package().items()):
        print(f"{package:20} {'tokens':36} {count:10,} (budget {budgets.get(package, 0):,})")
        text = lowered(text, "tokens", f'"{package}"', count)
    if write:
        FIGURES_FILE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
