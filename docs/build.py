"""Build the documentation: run the code of its pages, generate the reference, write the HTML.

python docs/build.py [--html] [--record] [--slow] [--without PAGE] [PAGE ...]

    PAGE       run these pages only, by their names; default: all
    --html     run no page: pictures are those of the last run
    --slow     run slow blocks, too
    --without  do not run this page
    --record   write fresh numbers into pages whose commands print others than they show
"""

import argparse
import shutil
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import blocks

HERE = Path(__file__).parent
RUNS, HTML = HERE / "_build/runs", HERE / "_build/html"
WORKERS = 2


def run_pages(names: list[str], without: list[str], record: bool, slow: bool) -> bool:
    """Run pages, by default all but those left out; return whether all that they show holds."""
    known = {page.stem: page for page in blocks.pages() if blocks.read(page.read_text(encoding="utf-8"))}
    if unknown := {*names, *without} - set(known):
        sys.exit(f"no page with code is called {', '.join(sorted(unknown))}; there are {', '.join(known)}")
    wanted = {name: known[name] for name in names or known if name not in without}
    for name in wanted:
        shutil.rmtree(RUNS / name, ignore_errors=True)
    good = True
    with ProcessPoolExecutor(WORKERS, get_context("spawn")) as pool:
        for report in pool.map(blocks.run, wanted.values(), [RUNS / name for name in wanted], [slow] * len(wanted)):
            print(
                f"{report.page}: {report.seconds:.0f} s of processor time",
                *report.remarks,
                *report.complaints,
                sep="\n  ",
                flush=True,
            )
            if record and report.fresh:
                wanted[report.page].write_text(report.fresh, encoding="utf-8")
            good = good and not report.complaints
    return good


def main() -> None:
    """Build what the command line asks for; exit with 1 where a page or the HTML fails."""
    read = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    read.add_argument("pages", nargs="*", metavar="PAGE")
    read.add_argument("--html", action="store_true")
    read.add_argument("--record", action="store_true")
    read.add_argument("--slow", action="store_true")
    read.add_argument("--without", action="append", default=[], metavar="PAGE")
    given = read.parse_args()
    good = given.html or run_pages(given.pages, given.without, given.record, given.slow)
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-j", str(WORKERS), "-b", "html", HERE, HTML]
    command += [] if given.html else ["--fresh-env"]  # notebooks run, too, where only the code has changed
    good = subprocess.run(command).returncode == 0 and good
    print(f"{HTML / 'index.html'}" if good else "the documentation has errors")
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
