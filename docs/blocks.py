"""Run the code blocks of a page, and compare what they print with what the page shows.

A page is Markdown. Its blocks run in their order, in one folder of the page's own, as a reader would run them in the
project's folder (`examples` is there):

    ```sh                  commands of bash; the first one that fails ends the page
    ```python              code; the blocks of a page share their names
    ```text                directly after one of these: lines that it printed; others may be left out

A line of a ``text`` block holds if a printed line is the same word by word, and number by number within `TOLERANCE`, or
within what ``text within 30 %`` says: a search may end elsewhere where a processor rounds otherwise.
``<!-- data: NAME -->`` before a block says that it reads the open recordings ``$D/NAME``, D being ``CALIB_DATA``
(default ``../shared/data``): where they are absent the block is left out. ``<!-- slow -->`` says that it takes more
than a few seconds: it is left out but with ``slow``.
"""

import io
import os
import re
import subprocess
import sys
from contextlib import chdir, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
DATA = Path(os.environ.get("CALIB_DATA", ROOT.parent / "shared/data")).resolve()
TOLERANCE = 0.05  # relative, of numbers that a page shows
COLUMNS = "100"
_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_FENCE = re.compile(
    r"(?:^<!-- (?P<mark>slow|data: \S+) -->\n)?^```(?P<kind>sh|python)\n(?P<code>.*?)^```\n"
    r"(?:\n*```text(?: within (?P<within>\d+) %)?\n(?P<expected>.*?)^```\n)?",
    re.M | re.S,
)


@dataclass
class Block:
    """One code block of a page.

    Attributes:
        kind: sh or python.
        code: its text.
        line: of the page, from 1, where it begins.
        expected: what the page says that it prints, line by line.
        mark: ``slow``, ``data: NAME`` or "".
        tolerance: relative, of its numbers.
    """

    kind: str
    code: str
    line: int
    expected: list[str] = field(default_factory=list)
    mark: str = ""
    tolerance: float = TOLERANCE

    def left_out(self, slow: bool) -> str:
        """Return why the block does not run; "" where it does."""
        if self.mark.startswith("data: "):
            recordings = DATA / self.mark.removeprefix("data: ")
            if not recordings.is_dir():
                return f"{recordings} is absent"
        if self.mark == "slow" and not slow:
            return "slow"
        return ""


@dataclass
class Report:
    """What came of a page: complaints, remarks, its text with fresh numbers, and the processor seconds that it took."""

    page: str
    complaints: list[str]
    remarks: list[str]
    fresh: str
    seconds: float


def pages() -> list[Path]:
    """Return the documentation's own pages, without those that are generated."""
    return sorted({*DOCS.glob("*.md"), *DOCS.glob("*/*.md")} - set(DOCS.glob("_build/*.md")))


def read(text: str) -> list[Block]:
    """Return the code blocks of a page."""
    blocks = []
    for match in _FENCE.finditer(text):
        line = text.count("\n", 0, match.start()) + 1
        block = Block(match["kind"], match["code"], line, mark=match["mark"] or "")
        if match["expected"]:
            block.expected = match["expected"].splitlines()
        if match["within"]:
            block.tolerance = float(match["within"]) / 100.0
        blocks.append(block)
    return blocks


def run(page: Path, folder: Path, slow: bool = False) -> Report:
    """Run the blocks of a page in a new folder, slow ones if wanted; a block that fails ends it."""
    text = page.read_text(encoding="utf-8")
    started = _processor_seconds()
    folder.mkdir(parents=True)
    (folder / "examples").symlink_to(ROOT / "examples")
    names: dict[str, object] = {"__name__": "page"}
    report = Report(page.stem, [], [], text, 0.0)
    for block in read(text):
        where = f"{page.name}, line {block.line}"
        reason = block.left_out(slow)
        if reason:
            report.remarks.append(f"{where}: left out, {reason}")
            continue
        printed, error = _run(block, folder, names)
        if error:
            report.complaints.append(f"{where}: {error}\n{printed}")
            break
        fresh, wrong = compare(block.expected, printed.splitlines(), block.tolerance)
        if block.expected:
            report.fresh = report.fresh.replace("\n".join(block.expected), "\n".join(fresh))
        if wrong:
            report.complaints.append(f"{where}: the page shows\n{wrong}\nbut it printed\n{printed}")
    report.seconds = _processor_seconds() - started
    return report


def _processor_seconds() -> float:
    """Return the processor time of this process and of those it has waited for."""
    return sum(os.times()[:4])


def _run(block: Block, folder: Path, names: dict[str, object]) -> tuple[str, str]:
    """Return what a block prints, and what went wrong.

    Args:
        block: to run.
        folder: in which it runs.
        names: the variables of the page's Python blocks; new ones are added.
    """
    if block.kind == "python":
        return _run_python(block.code, folder, names)
    return _run_shell(block.code, folder)


def _run_python(code: str, folder: Path, names: dict[str, object]) -> tuple[str, str]:
    printed = io.StringIO()
    try:
        with chdir(folder), redirect_stdout(printed):
            exec(compile(code, "block", "exec"), names)
    except Exception as error:
        return printed.getvalue(), f"{type(error).__name__}: {error}"
    return printed.getvalue(), ""


def _run_shell(code: str, folder: Path) -> tuple[str, str]:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    # scripts get one BLAS thread, as the commands have by themselves
    variables = {"PATH": path, "COLUMNS": COLUMNS, "D": str(DATA), "OPENBLAS_NUM_THREADS": "1"}
    result = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", code],
        cwd=folder,
        env=os.environ | variables,
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
    )
    error = ""
    if result.returncode:
        error = f"exit code {result.returncode}"
    return result.stdout + result.stderr, error


def compare(expected: list[str], printed: list[str], tolerance: float = TOLERANCE) -> tuple[list[str], str]:
    """Return the lines that a page shows with fresh numbers, and those that no longer hold."""
    fresh = []
    wrong = []
    unmatched = list(printed)
    for line in expected:
        match = _same_words(line, unmatched)
        if match is None:
            fresh.append(line)
            if line.strip() not in ("", "…"):
                wrong.append(line)
            continue
        unmatched.remove(match)
        if _same_numbers(line, match, tolerance):
            fresh.append(line)
        else:
            fresh.append(match.rstrip())
            wrong.append(line)
    return fresh, "\n".join(wrong)


def _same_words(line: str, printed: list[str]) -> str | None:
    """Return the first printed line that has the words of a line; None without one."""
    expected_words = _words(line)
    for candidate in printed:
        if _words(candidate) == expected_words:
            return candidate
    return None


def _same_numbers(line: str, printed: str, tolerance: float) -> bool:
    numbers = zip(_NUMBER.findall(line), _NUMBER.findall(printed))
    return all(_close(expected, fresh, tolerance) for expected, fresh in numbers)


def _words(line: str) -> list[str]:
    """Return the words of a line, its numbers as ``#``."""
    return _NUMBER.sub("#", line).split()


def _close(expected: str, fresh: str, tolerance: float) -> bool:
    """Return whether a number holds: within its last digit, or within the relative tolerance."""
    decimals = len(expected.partition("e")[0].partition(".")[2])
    last_digit = 10.0**-decimals
    return abs(float(expected) - float(fresh)) <= max(1.01 * last_digit, tolerance * abs(float(fresh)))
