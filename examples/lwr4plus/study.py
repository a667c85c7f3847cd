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
ROOT = HERE.parents[1]
FIGURES = HERE / "figures"
# part: options of the whole part, and of the quick one
PARTS: dict[str, tuple[list[str], list[str]]] = {
    "geometry": ([], ["--quick"]),
    "dynamics": ([], []),
    "consistency": (["--runs", "40"], ["--runs", "0"]),
    "excitation": ([], ["--quick"]),
    "planning": ([], ["--paths", "3"]),
    "excitation_peers": ([], ["--quick"]),
}
# files of a part: its metrics, its results as it goes on, and the mark of the code that made them
METRICS, ROWS, MARK = "metrics.json", "rows.json", "code.txt"
# scripts that do not change a part's metrics
PRESENTATION = ("study.py", "study_tables.py")


def code_of(name: str, quick: bool) -> str:
    """Return a mark of all that a part's metrics come from: the toolkit, the scripts here, and its options."""
    sources = [path for path in HERE.glob("*.py") if path.name not in PRESENTATION]
    for package in ("calib", "poses", "trajectories"):
        sources += (ROOT / package).rglob("*.py")
    options = " ".join([name, *PARTS[name][quick]])
    digest = hashlib.sha256(options.encode())
    for path in sorted(sources):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def is_finished(name: str, out: Path, quick: bool) -> bool:
    """Return whether a part was run to its end by this code."""
    mark = out / MARK
    return (out / METRICS).exists() and mark.exists() and mark.read_text() == code_of(name, quick)


def run(name: str, out: Path, quick: bool) -> None:
    """Run one part of the study; results of older code are removed."""
    start = time.perf_counter()
    code = code_of(name, quick)
    mark = out / MARK
    if not mark.exists() or mark.read_text() != code:
        (out / METRICS).unlink(missing_ok=True)
        (out / ROWS).unlink(missing_ok=True)
        files.write(mark, code)
    command = [sys.executable, str(HERE / f"{name}.py"), "--out", str(out), *PARTS[name][quick]]
    print(f"\n== {name}: {' '.join(command[1:])}", file=sys.stderr, flush=True)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    print(f"== {name}: {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)


def tables_of(name: str, out: Path) -> study_tables.Tables:
    """Return the tables of a finished part."""
    metrics = json.loads((out / METRICS).read_text(encoding="utf-8"))
    return study_tables.SHOW[name](metrics)


def write_tables(tables: study_tables.Tables, out: Path, quick: bool) -> None:
    """Write ``tables.md``, with the marks between which the README holds the same tables."""
    text = "quick form: these are not the study's figures\n\n" if quick else ""
    for name, table in tables.items():
        text += f"<!-- table {name} -->\n\n{table}\n\n<!-- end -->\n\n"
    files.write(out / "tables.md", text)


def renew_readme(tables: study_tables.Tables, folders: list[Path]) -> None:
    """Put tables, figures and the designed motion of finished parts into the README and beside it."""
    readme = HERE / "README.md"
    files.write(readme, study_tables.renewed(readme.read_text(encoding="utf-8"), tables))
    FIGURES.mkdir(exist_ok=True)
    for folder in folders:
        for picture in folder.glob("*.png"):
            shutil.copy(picture, FIGURES / picture.name)
        for motion in folder.glob(coefficients.NAME):
            shutil.copy(motion, HERE / motion.name)


def main() -> None:
    """Run the requested parts; print and write their tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--all", action="store_true", help="run every part, whatever is there already")
    parser.add_argument("--quick", action="store_true", help="each part in its short form: to see that it runs")
    parser.add_argument("--readme", action="store_true", help="put tables and figures into README.md")
    parser.add_argument("--only", nargs="+", choices=list(PARTS), default=list(PARTS))
    arguments = parser.parse_args()
    if arguments.quick and arguments.readme:
        parser.error("--readme takes the study's figures, not those of --quick")
    tables: study_tables.Tables = {}
    folders = []
    for name in arguments.only:
        out = arguments.out / name
        folders.append(out)
        if arguments.all or not is_finished(name, out, arguments.quick):
            run(name, out, arguments.quick)
        tables |= tables_of(name, out)
    study_tables.show(tables)
    write_tables(tables, arguments.out, arguments.quick)
    if arguments.readme:
        renew_readme(tables, folders)


if __name__ == "__main__":
    main()
