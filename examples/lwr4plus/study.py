"""The whole reproduction of Kolyubin, Shiriaev & Jubien (2019, IJAMT 101): their tables beside ours, and the figures.

Runs the scripts beside this one, each into a folder of its own, and prints their tables from metrics.json; they are
written to tables.md too. Without --all, a part whose metrics are there and come from the same code is not run again, so
that an interrupted study goes on where it stopped. --readme puts the tables and figures into README.md here: nothing
there is typed by hand.

    python examples/lwr4plus/study.py --all --out lwr4plus-study [--quick] [--readme] [--only geometry dynamics …]
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

import study_tables

from calib import files
from calib.procedure.excitation import coefficients

HERE = Path(__file__).parent
PARTS: dict[str, tuple[list[str], list[str]]] = {  # options of the whole part, and of the quick one
    "geometry": ([], ["--quick"]),
    "dynamics": ([], []),
    "consistency": (["--runs", "40"], ["--runs", "0"]),
    "excitation": ([], ["--quick"]),
    "planning": ([], ["--paths", "3"]),
    "excitation_peers": ([], ["--quick"]),
}
FIGURES = HERE / "figures"
METRICS, ROWS, MARK = "metrics.json", "rows.json", "code.txt"  # of a part: whole, as it goes on, what made it


def code_of(name: str, quick: bool) -> str:
    """Return a mark of all that a part's metrics come from: the toolkit, the scripts here, and its options."""
    digest, root = hashlib.sha256(" ".join([name, *PARTS[name][quick]]).encode()), HERE.parents[1]
    tools = [path for room in ("calib", "poses", "trajectories") for path in (root / room).rglob("*.py")]
    scripts = [path for path in HERE.glob("*.py") if path.name not in ("study.py", "study_tables.py")]
    for path in sorted([*tools, *scripts]):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def is_made(name: str, out: Path, quick: bool) -> bool:
    """Return whether a part was run to its end by this code."""
    mark = out / MARK
    return (out / METRICS).exists() and mark.exists() and mark.read_text() == code_of(name, quick)


def run(name: str, out: Path, quick: bool) -> None:
    """Run one part of the study; results of older code are removed."""
    started, code, mark = time.perf_counter(), code_of(name, quick), out / MARK
    if not mark.exists() or mark.read_text() != code:
        for left in (METRICS, ROWS):
            (out / left).unlink(missing_ok=True)
        files.write(mark, code)
    command = [sys.executable, str(HERE / f"{name}.py"), "--out", str(out), *PARTS[name][quick]]
    print(f"\n== {name}: {' '.join(command[1:])}", file=sys.stderr, flush=True)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    print(f"== {name}: {time.perf_counter() - started:.0f} s", file=sys.stderr, flush=True)


def tables_of(name: str, out: Path) -> study_tables.Tables:
    """Return the tables of a finished part."""
    return study_tables.SHOW[name](json.loads((out / METRICS).read_text(encoding="utf-8")))


def main() -> None:
    """Run the requested parts; print and write their tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--all", action="store_true", help="run every part, whatever is there already")
    parser.add_argument("--quick", action="store_true", help="each part in its short form: to see that it runs")
    parser.add_argument("--readme", action="store_true", help="put tables and figures into README.md")
    parser.add_argument("--only", nargs="+", choices=list(PARTS), default=list(PARTS))
    given = parser.parse_args()
    if given.quick and given.readme:
        parser.error("--readme takes the study's figures, not those of --quick")
    tables: study_tables.Tables = {}
    for name in given.only:
        out = given.out / name
        if given.all or not is_made(name, out, given.quick):
            run(name, out, given.quick)
        tables |= tables_of(name, out)
    study_tables.show(tables)
    head = "quick form: these are not the study's figures\n\n" if given.quick else ""
    text = "".join(f"<!-- table {name} -->\n\n{one}\n\n<!-- end -->\n\n" for name, one in tables.items())
    files.write(given.out / "tables.md", head + text)
    if given.readme:
        readme = HERE / "README.md"
        files.write(readme, study_tables.renewed(readme.read_text(encoding="utf-8"), tables))
        for picture in (path for name in given.only for path in (given.out / name).glob("*.png")):
            FIGURES.mkdir(exist_ok=True)
            shutil.copy(picture, FIGURES / picture.name)
        for motion in (path for name in given.only for path in (given.out / name).glob(coefficients.NAME)):
            shutil.copy(motion, HERE / motion.name)


if __name__ == "__main__":
    main()
