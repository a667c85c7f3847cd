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
RUNS = HERE / "_build/runs"
HTML = HERE / "_build/html"
WORKERS = 2


def pages_with_code() -> dict[str, Path]:
    """Return the pages that have blocks to run, by their names."""
    pages = {}
    for page in blocks.pages():
        if blocks.read(page.read_text(encoding="utf-8")):
            pages[page.stem] = page
    return pages


def run_pages(names: list[str], without: list[str], record: bool, slow: bool) -> bool:
    """Run pages, by default all but those left out; return whether all that they show holds."""
    pages = pages_with_code()
    unknown = {*names, *without} - set(pages)
    if unknown:
        sys.exit(f"no page with code is called {', '.join(sorted(unknown))}; there are {', '.join(pages)}")
    chosen = {name: pages[name] for name in names or pages if name not in without}
    folders = [RUNS / name for name in chosen]
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)
    good = True
    with ProcessPoolExecutor(WORKERS, get_context("spawn")) as pool:
        for report in pool.map(blocks.run, chosen.values(), folders, [slow] * len(chosen)):
            lines = [f"{report.page}: {report.seconds:.0f} s of processor time", *report.remarks, *report.complaints]
            print("\n  ".join(lines), flush=True)
            if record and report.fresh:
                chosen[report.page].write_text(report.fresh, encoding="utf-8")
            if report.complaints:
                good = False
    return good


def write_html(fresh: bool) -> bool:
    """Write the HTML with Sphinx; return whether it went without a warning.

    Args:
        fresh: read every page anew: notebooks run, too, where only the code has changed.
    """
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-j", str(WORKERS), "-b", "html"]
    if fresh:
        command.append("--fresh-env")
    return subprocess.run([*command, HERE, HTML]).returncode == 0


def main() -> None:
    """Build what the command line asks for; exit with 1 where a page or the HTML fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="*", metavar="PAGE")
    parser.add_argument("--html", action="store_true")
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--slow", action="store_true")
    parser.add_argument("--without", action="append", default=[], metavar="PAGE")
    options = parser.parse_args()
    pages_hold = True
    if not options.html:
        pages_hold = run_pages(options.pages, options.without, options.record, options.slow)
    html_written = write_html(fresh=not options.html)
    if not (pages_hold and html_written):
        print("the documentation has errors")
        sys.exit(1)
    print(HTML / "index.html")


if __name__ == "__main__":
    main()
