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
    r"(?:\n*```text(?: within (?P<within>\d+) %)?\n(?P<shown>.*?)^```\n)?",
    re.M | re.S,
)


@dataclass
class Block:
    """One code block of a page.

    Attributes:
        kind: sh or python.
        code: its text.
        line: of the page, from 1, where it begins.
        shown: what the page says that it prints, line by line.
        mark: ``slow``, ``data: NAME`` or "".
        tolerance: relative, of its numbers.
    """

    kind: str
    code: str
    line: int
    shown: list[str] = field(default_factory=list)
    mark: str = ""
    tolerance: float = TOLERANCE

    def left_out(self, slow: bool) -> str:
        """Return why the block does not run; "" where it does."""
        place = DATA / self.mark.removeprefix("data: ")
        if self.mark.startswith("data: ") and not place.is_dir():
            return f"{place} is absent"
        return "slow" if self.mark == "slow" and not slow else ""


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
    return [
        Block(
            found["kind"], found["code"], text.count("\n", 0, found.start()) + 1,
            (found["shown"] or "").splitlines(), found["mark"] or "",
            float(found["within"]) / 100.0 if found["within"] else TOLERANCE,
        )
        for found in _FENCE.finditer(text)
    ]  # fmt: skip


def run(page: Path, folder: Path, slow: bool = False) -> Report:
    """Run the blocks of a page in a new folder, slow ones if wanted; a block that fails ends it."""
    text, started = page.read_text(encoding="utf-8"), sum(os.times()[:4])
    folder.mkdir(parents=True)
    (folder / "examples").symlink_to(ROOT / "examples")
    names: dict[str, object] = {"__name__": "page"}
    report = Report(page.stem, [], [], text, 0.0)
    for block in read(text):
        place = f"{page.name}, line {block.line}"
        if why := block.left_out(slow):
            report.remarks.append(f"{place}: left out, {why}")
            continue
        printed, error = _run(block, folder, names)
        if error:
            report.complaints.append(f"{place}: {error}\n{printed}")
            break
        fresh, wrong = compare(block.shown, printed.splitlines(), block.tolerance)
        report.fresh = report.fresh.replace("\n".join(block.shown), "\n".join(fresh)) if block.shown else report.fresh
        if wrong:
            report.complaints.append(f"{place}: the page shows\n{wrong}\nbut it printed\n{printed}")
    report.seconds = sum(os.times()[:4]) - started
    return report


def _run(block: Block, folder: Path, names: dict[str, object]) -> tuple[str, str]:
    """Return what a block prints, and what went wrong."""
    if block.kind == "python":
        printed = io.StringIO()
        try:
            with chdir(folder), redirect_stdout(printed):
                exec(compile(block.code, "block", "exec"), names)
        except Exception as error:
            return printed.getvalue(), f"{type(error).__name__}: {error}"
        return printed.getvalue(), ""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    # of BLAS one thread, as the commands have by themselves, for scripts
    places = {"PATH": path, "COLUMNS": COLUMNS, "D": str(DATA), "OPENBLAS_NUM_THREADS": "1"}
    command = ["bash", "-euo", "pipefail", "-c", block.code]
    done = subprocess.run(
        command, cwd=folder, env=os.environ | places, capture_output=True, text=True, stdin=subprocess.DEVNULL
    )
    return done.stdout + done.stderr, f"exit code {done.returncode}" if done.returncode else ""


def compare(shown: list[str], printed: list[str], tolerance: float = TOLERANCE) -> tuple[list[str], str]:
    """Return the lines that a page shows with fresh numbers, and those that no longer hold."""
    fresh, wrong, left = [], [], list(printed)
    for line in shown:
        match = next((one for one in left if _words(one) == _words(line)), None)
        if match is None:
            fresh.append(line)
            wrong += [line] if line.strip() not in ("", "…") else []
            continue
        left.remove(match)
        alike = all(_close(a, b, tolerance) for a, b in zip(_NUMBER.findall(line), _NUMBER.findall(match)))
        fresh.append(line if alike else match.rstrip())
        wrong += [] if alike else [line]
    return fresh, "\n".join(wrong)


def _words(line: str) -> list[str]:
    return _NUMBER.sub("#", line).split()


def _close(a: str, b: str, tolerance: float) -> bool:
    digit = 10.0 ** -len(a.partition("e")[0].partition(".")[2])
    return abs(float(a) - float(b)) <= max(1.01 * digit, tolerance * abs(float(b)))
