"""How time and memory grow with poses, samples, joints, parameters and candidates, beside other tools.

    G=tests/benchmarks/growth; python $G.py --out $G.csv --picture docs/growth.png --page docs/growth.md

Goes on from the rows that are there, and writes each as it comes: a process of its own (`growth_work.py`,
`growth_peers.py`), its processor time and peak memory. ``--only samples --again`` measures one part anew; a
killed one goes on without ``--again``.

Exponents p of ``cost ~ size^p`` are least-squares lines through the logarithms at the sizes within a factor of `UPPER`
of a curve's largest one; their σ is from the scatter about the line.
"""

import argparse
import hashlib
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from growth_work import PARAMETERS

from calib.files import write, write_table
from calib.records import read_rows

HERE = Path(__file__).parent
UPPER = 33.0  # sizes below the largest one by more than this are left out of exponents (our choice)
LIMIT = 1.1  # largest exponent, above that of the work itself


class Curve(NamedTuple):
    """A curve to measure: what it is about, its name, the function of `growth_work` or `growth_peers`, its sizes.

    `order` is the exponent of the work itself: 2 where a result has n² numbers or a least-squares triangle is of n
    columns, 3 where it has rows in proportion to n, too.
    """

    about: str
    name: str
    work: str
    largest: int
    order: int = 1
    peer: bool = False
    smallest: int = 0


class Row(NamedTuple):
    """A measurement: processor time [s] and peak memory [MB], or why there are none."""

    about: str
    curve: str
    size: int
    cpu: float | None
    memory: float | None
    remark: str = ""


SIZES = {
    "poses": (100, 300, 1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000),
    "samples": (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 600_000, 3_600_000),
    "joints": (3, 5, 7, 10, 15, 20, 30),
    "parameters": tuple(PARAMETERS),
    "candidates": (100, 200, 500, 1_000, 2_000, 5_000, 10_000, 20_000),
}
BEYOND = {"poses": 100_000, "samples": 600_000}  # larger sizes with --largest only
CURVES = (
    Curve("poses", "calib fit, whole command", "command_fit", 1_000_000),
    Curve("poses", "calib, the fit alone", "fit_poses", 1_000_000),
    Curve("poses", "SciPy least_squares, our Jacobian", "scipy_jacobian", 30_000, peer=True),
    Curve("poses", "SciPy least_squares, differences", "scipy_differences", 30_000, peer=True),
    Curve("poses", "FIGAROH, its forward kinematics in SciPy", "figaroh_fit", 3_000, peer=True),
    Curve("samples", "calib identify, whole command", "command_identify", 3_600_000),
    Curve("samples", "calib, log read to model", "identify_log", 3_600_000, smallest=10_000),
    Curve("samples", "calib, regressor", "regressor_samples", 600_000),
    Curve("samples", "Pinocchio's regressor in a loop", "pinocchio_samples", 600_000, peer=True),
    Curve("samples", "FIGAROH's regressor", "figaroh_regressor", 30_000, peer=True),
    Curve("samples", "MuJoCo sysid, 28 parameters, 5 steps", "sysid_identify", 10_000, peer=True),
    Curve("joints", "calib, kinematics and Jacobian", "kinematics_joints", 30),
    Curve("joints", "calib, inverse dynamics", "dynamics_joints", 30),
    Curve("joints", "calib, regressor", "regressor_joints", 30, 2),
    Curve("joints", "calib, base parameters", "base_joints", 30, 3),
    Curve("joints", "Pinocchio's regressor in a loop", "pinocchio_joints", 30, 2, peer=True),
    Curve("joints", "LAPACK's QR of as many rows and columns", "lapack_joints", 30, 3, peer=True),
    Curve("joints", "FIGAROH's base parameters", "figaroh_base", 30, 3, peer=True),
    Curve("parameters", "calib, the fit alone", "fit_parameters", 93, 2),
    Curve("parameters", "SciPy least_squares, our Jacobian", "scipy_parameters", 93, 2, peer=True),
    Curve("candidates", "calib select, whole command", "command_select", 20_000),
    Curve("candidates", "calib, the choice alone", "select_candidates", 20_000),
    Curve("candidates", "FIGAROH's cone program", "figaroh_selection", 200, peer=True),
)
WORDS = {
    "poses": "Positions of a UR5's target, six joints, 27 unknowns.",
    "samples": "Samples of the LWR4+ at 1 kHz, seven joints. Regressors go block by block into the same memory.",
    "joints": "Joints of random arms, every third prismatic: 10,000 samples, of base parameters 1000.",
    "parameters": "Identifiable parameters of arms of 3 to 30 joints, frames included, from 1000 positions.",
    "candidates": "Poses of the LWR4+ of which 40 are chosen.",
}


def measured(curve: Curve, size: int) -> Row:
    """Return the row of a curve at a size, measured in a process of its own."""
    script = HERE / ("growth_peers.py" if curve.work.startswith(("figaroh", "sysid")) else "growth_work.py")
    places = {"PYTHONPATH": os.pathsep.join([str(HERE.parents[1]), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run(
        [sys.executable, str(script), curve.work, str(size)], capture_output=True, text=True,
        env=os.environ | places | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    if done.returncode == 0:
        found = json.loads(done.stdout.splitlines()[-1])
        return Row(curve.about, curve.name, size, round(found["cpu"], 5), round(found["memory"], 1))
    last = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
    if absent := re.fullmatch(r"ModuleNotFoundError: No module named '([^']+)'", last):
        return Row(curve.about, curve.name, size, None, None, f"{absent[1]} is not installed")
    if not curve.peer:
        raise SystemExit(f"{curve.name} at {size}:\n{done.stderr}")
    return Row(curve.about, curve.name, size, None, None, last[:200])


def run(out: Path, abouts: Sequence[str], again: bool, largest: bool, most: float) -> None:
    """Measure the rows that are missing, and write them one by one; from small sizes to large ones."""
    rows = [row for row in stored(out) if not (again and row.about in abouts)]
    there = {(row.about, row.curve, row.size) for row in rows if row.cpu is not None}
    for about in abouts:
        for size in SIZES[about]:
            beyond = not largest and size > BEYOND.get(about, size)
            for curve in CURVES:
                if curve.about != about or beyond or not curve.smallest <= size <= min(curve.largest, most):
                    continue
                if (about, curve.name, size) in there:
                    continue
                row = measured(curve, size)
                print(*row, flush=True)
                rows = [one for one in rows if one[:3] != row[:3]] + [row]
                write_table(out, Row._fields, rows)


def stored(path: Path) -> list[Row]:
    """Return the rows of a file in the curves' order; none where it is missing."""
    order = {(curve.about, curve.name): k for k, curve in enumerate(CURVES)}
    rows = read_rows(Row, path) if path.exists() else ()
    return sorted((row for row in rows if row[:2] in order), key=lambda row: (order[row[:2]], row.size))


class Growth(NamedTuple):
    """A curve's sizes, a cost at each, and the exponent with its σ; NaN where there are fewer than three sizes."""

    sizes: np.ndarray
    costs: np.ndarray
    exponent: float
    sigma: float


def growth(curve: Curve, rows: Sequence[Row], cost: str = "cpu") -> Growth:
    """Return how a curve's ``cpu`` or ``memory`` grows."""
    own = [row for row in rows if row[:2] == (curve.about, curve.name) and row.cpu is not None]
    sizes, costs = (np.array([getattr(row, name) for row in own], dtype=float) for name in ("size", cost))
    upper = sizes >= sizes.max(initial=0.0) / UPPER
    if upper.sum() < 3:
        return Growth(sizes, costs, np.nan, np.nan)
    x, y = np.log(sizes[upper]), np.log(costs[upper])
    x -= x.mean()
    slope = x @ y / (x @ x)
    left = y - y.mean() - slope * x
    return Growth(sizes, costs, float(slope), float(np.sqrt(left @ left / (len(x) - 2) / (x @ x))))


def number(value: float) -> str:
    return f"{value:.3g}" if value < 1000 else f"{value:,.0f}"


def exponent(found: Growth) -> str:
    return "–" if np.isnan(found.exponent) else f"{found.exponent:.2f} ± {found.sigma:.2f}"


def table(about: str, rows: Sequence[Row]) -> Iterator[str]:
    """Yield a table: processor seconds by size, exponents of time and memory, memory at the largest size."""
    own = [row for row in rows if row.about == about]
    sizes = sorted({row.size for row in own})
    yield f"| {about} | {' | '.join(f'{size:,}' for size in sizes)} | exponent | MB at most | exponent |"
    yield f"|---|{'---:|' * (len(sizes) + 3)}"
    for curve in CURVES:
        mine = {row.size: row for row in own if row.curve == curve.name}
        if curve.about != about or not mine:
            continue
        cells = [number(mine[size].cpu) if size in mine and mine[size].cpu is not None else "" for size in sizes]
        time, memory = growth(curve, rows), growth(curve, rows, "memory")
        name = f"{curve.name} (work: {curve.order})" if curve.order > 1 else curve.name
        if remark := next((row.remark for row in mine.values() if row.remark), ""):
            name += f": {remark}"
        most = number(max(memory.costs)) if len(memory.costs) else ""
        yield f"| {name} | {' | '.join(cells)} | {exponent(time)} | {most} | {exponent(memory)} |"


def digest(rows: Sequence[Row]) -> str:
    """Return what the picture keeps of its rows."""
    return hashlib.sha256(repr([tuple(row) for row in rows]).encode()).hexdigest()[:16]


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw time above memory against size, a column for each kind of size; peers dashed."""
    from matplotlib import pyplot, ticker

    figure, axes = pyplot.subplots(2, len(SIZES), figsize=(18, 9), layout="constrained", sharex="col", sharey="row")
    for (above, below), about in zip(axes.T, SIZES):
        for curve in (one for one in CURVES if one.about == about):
            for place, cost in ((above, "cpu"), (below, "memory")):
                found = growth(curve, rows, cost)
                label = curve.name if np.isnan(found.exponent) else f"{curve.name}: {found.exponent:.2f}"
                style = {"linestyle": "--", "marker": "s"} if curve.peer else {"marker": "o"}
                place.plot(found.sizes, found.costs, markersize=3, label=label, **style)
        for place in (above, below):
            place.set(xscale="log", yscale="log")
            place.grid(alpha=0.3)
            place.xaxis.set_minor_formatter(ticker.NullFormatter())
            place.yaxis.set_minor_formatter(ticker.NullFormatter())
        above.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0))
        below.set_xlabel(about)
        if max(SIZES[about]) < 100:
            below.set_xticks(SIZES[about], map(str, SIZES[about]))
    axes[0, 0].set_ylabel("processor time [s]")
    axes[1, 0].set_ylabel("peak memory [MB]")
    figure.savefig(path, dpi=80, metadata={"Description": digest(rows)})


def written(text: str, rows: Sequence[Row]) -> str:
    """Return a page with each table in its place, between <!-- ABOUT --> and <!-- end -->."""
    for about in SIZES:
        block = "\n".join([f"<!-- {about} -->", WORDS[about], "", *table(about, rows), "<!-- end -->"])
        text, count = re.subn(rf"<!-- {about} -->.*?<!-- end -->", lambda _, own=block: own, text, flags=re.DOTALL)
        if count != 1:
            raise SystemExit(f"the page has {count} places for {about}, <!-- {about} --> … <!-- end -->; give it one")
    return text


def above_limit(rows: Sequence[Row]) -> list[str]:
    """Return our curves that grow faster than the work itself by more than `LIMIT` allows."""
    found = []
    for curve in (one for one in CURVES if not one.peer):
        for cost, order in (("cpu", curve.order), ("memory", min(curve.order, 2))):
            power = growth(curve, rows, cost).exponent
            if power - (order - 1) > LIMIT:
                found.append(f"{curve.about}, {curve.name}: {cost} {power:.2f}")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="CSV file of the rows")
    parser.add_argument("--only", nargs="+", choices=list(SIZES), default=list(SIZES))
    parser.add_argument("--again", action="store_true", help="measure anew what is there")
    parser.add_argument("--no-runs", action="store_true", help="tables and picture of the rows that are there")
    parser.add_argument("--largest", action="store_true", help="up to 1,000,000 poses and 3,600,000 samples")
    parser.add_argument("--most", type=float, default=np.inf, help="no sizes above this")
    parser.add_argument("--picture", type=Path, help="draw the curves into this file")
    parser.add_argument("--page", type=Path, help="write the tables into this page")
    given = parser.parse_args()
    if not given.no_runs:
        run(given.out, given.only, given.again, given.largest, given.most)
    rows = stored(given.out)
    for about in given.only:
        print("\n".join(["", *table(about, rows)]))
    print(f"\n{platform.machine()}, {os.cpu_count()} cores; above {LIMIT}: {'; '.join(above_limit(rows)) or 'none'}")
    if given.picture:
        draw(rows, given.picture)
    if given.page:
        write(given.page, written(given.page.read_text(encoding="utf-8"), rows))


if __name__ == "__main__":
    main()
