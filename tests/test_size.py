"""Code lines (no blanks, comments, docstrings) by package: at most what the changelog's table allows, and near it."""

import ast
import re
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
MAX_CORE = 32_000  # lines of everything but calib/rooms
SLACK = 40  # lines by which a package may stay below its row before the row has to be lowered


def code_lines(path: Path) -> int:
    """Return the lines of a module that are neither blank nor comment nor docstring."""
    text = path.read_text(encoding="utf-8")
    documented = {
        line
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        and ast.get_docstring(node) is not None
        for line in range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1)
    }
    lines = enumerate(text.split("\n"), 1)
    return sum(1 for n, line in lines if n not in documented and line.strip() and not line.strip().startswith("#"))


def test_packages_keep_their_budget():
    """A package that grows says in the changelog what for; one that shrinks lowers its row there."""
    counted: Counter[str] = Counter()
    for package in ("calib", "poses", "trajectories"):
        for path in (ROOT / package).rglob("*.py"):
            parts = path.relative_to(ROOT).parts
            counted["/".join(parts[:2]) if package == "calib" and len(parts) > 2 else package] += code_lines(path)
    table = re.findall(r"^\| `([\w/]+)` \| ([\d,]+) \| (.*) \|$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    allowed = {package: int(lines.replace(",", "")) for package, lines, why in table if why.strip()}
    assert set(counted) == set(allowed)
    assert {name: n for name, n in counted.items() if not allowed[name] - SLACK <= n <= allowed[name]} == {}
    assert sum(n for name, n in counted.items() if name != "calib/rooms") <= MAX_CORE
