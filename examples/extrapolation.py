"""How well identified dynamics predict other motion, beside a plain ridge regression, over many pairs of recordings.

CALIB_DATA=... python examples/extrapolation.py [--quick] [--only TEXT ...] [--jobs 2] [--out FOLDER] [--markdown]

Errors are 100 ‖τ - τ̂‖ / ‖τ‖ on the test, measured and predicted torques low-passed alike; a pair's total is over the
joints of the most frequent kind (N m). *Ridge* is regularised towards zero (`extrapolation_ridge.py`); *CAD* is the
same towards the description's masses, where there are any. Both see the same description and files as the toolkit.
Results are kept in FOLDER, by the state of `calib` and of these scripts: what is there already is not made again.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import hashlib
import json
import signal
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import extrapolation_ridge as ridge
import numpy as np
from extrapolation_pairs import PAIRS, Pair, Prepared
from scipy.signal import butter, filtfilt

import calib

CUTOFF, RATE, BORDER = 10.0, 100.0, 0.3  # of both sides of the comparison [Hz, Hz, s]
MAX_SECONDS = 300  # for a pair
COLUMNS = ("ridge", "cad", "ours", "ratio", "coverage", "seconds")


def state() -> str:
    """Return what tells one version of the toolkit and of these scripts from another."""
    here = Path(__file__).parent
    files = [*sorted(Path(calib.__file__).parent.rglob("*.py")), *sorted(here.glob("extrapolation*.py"))]
    return hashlib.sha1(b"".join(path.read_bytes() for path in files)).hexdigest()[:12]


def _errors(test: list[Path], predicted: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Return Σ (τ - τ̂)² and Σ τ² per joint (n,) of predictions (instants, torques) of recordings."""
    sums = []
    for path, (t, tau) in zip(test, predicted):
        log = np.load(path)
        grid = np.arange(max(log["t"][0], t[0]), min(log["t"][-1], t[-1]), 1.0 / RATE)
        sides = (np.column_stack([np.interp(grid, s, c) for c in x.T]) for s, x in ((log["t"], log["tau"]), (t, tau)))
        measured, own = (filtfilt(*butter(4, CUTOFF / (RATE / 2)), side, axis=0) for side in sides)
        inner = (grid >= grid[0] + BORDER) & (grid <= grid[-1] - BORDER)
        sums.append([((measured - own)[inner] ** 2).sum(axis=0), (measured[inner] ** 2).sum(axis=0)])
    left, size = np.sum(sums, axis=0)
    return left, size


def _ours(files: Prepared, folder: Path) -> tuple[list[tuple[np.ndarray, np.ndarray]], float]:
    """Return the toolkit's predictions of the test files, and the share of their samples inside 95 % intervals [%]."""
    options = folder / "options.toml"
    options.write_text(files.options)
    model = calib.identify_dynamics(
        files.robot, [str(x) for x in files.train], validate=[str(x) for x in files.test], options=options
    )
    outcome = model.outcome
    predicted = [(case.motion.t, np.asarray(outcome.predictions[case.name])) for case in outcome.inputs.unseen]
    found = getattr(getattr(outcome, "assessment", None), "intervals", {}).values()
    weights = [one.beyond.size for one in found]
    covered = 100.0 * np.average([one.covered for one in found], weights=weights) if weights else np.nan
    return predicted, float(covered)


def run(pair: Pair) -> dict:
    """Return a pair's row: errors [%] of total and joints of each model, coverage [%], processor seconds."""
    result: dict = {"pair": pair.name, "across": pair.across}
    signal.signal(signal.SIGALRM, _too_long)
    signal.alarm(MAX_SECONDS)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        files = pair.prepare(folder)
        plain = [[ridge.predict(files.robot, files.train, x, files.payload, cad) for x in files.test] for cad in (0, 1)]
        result["ridge"] = _percent(*_errors(files.test, plain[0]))
        result["cad"] = _percent(*_errors(files.test, plain[1])) if files.masses else None
        start = time.process_time()
        try:
            predicted, covered = _ours(files, folder)
            result |= {"ours": _percent(*_errors(files.test, predicted)), "coverage": covered}
        except (calib.CalibError, TimeoutError) as error:
            result |= {"ours": None, "coverage": None, "refused": f"{type(error).__name__}: {error}"}
        result["seconds"] = time.process_time() - start
    signal.alarm(0)
    return result


def _too_long(*_: object) -> None:
    raise TimeoutError(f"longer than {MAX_SECONDS} s")


def _percent(left: np.ndarray, size: np.ndarray) -> dict:
    joints = 100.0 * np.sqrt(left / size)
    return {"total": float(100.0 * np.sqrt(left.sum() / size.sum())), "joints": joints.tolist()}


def row(one: dict) -> str:
    """Return a line of the table."""
    kind = "across" if one["across"] else "same"
    cad = f"{one['cad']['total']:.1f}" if one["cad"] else "–"
    if one["ours"] is None:
        told = f"refused | – | {one['refused'][:60]} | –"
    else:
        worst = int(np.argmax(one["ours"]["joints"]))
        told = (
            f"{one['ours']['total']:.1f} | {ratio(one):.2f} | {worst + 1}: {one['ours']['joints'][worst]:.0f} "
            f"({one['ridge']['joints'][worst]:.0f}) | {one['coverage']:.0f}"
        )
    return f"| {one['pair']} | {kind} | {one['ridge']['total']:.1f} | {cad} | {told} | {one['seconds']:.0f} |"


def ratio(one: dict, against: str = "ridge") -> float:
    """Return the toolkit's error over the baseline's; NaN where either is missing."""
    if one["ours"] is None or one[against] is None:
        return np.nan
    return one["ours"]["total"] / one[against]["total"]


def summary(rows: list[dict]) -> list[str]:
    """Return a line for all pairs, those of the same regime and those across."""
    lines = []
    for name, own in (("all", rows), *((kind, [x for x in rows if x["across"] == (kind == "across")])
                                       for kind in ("same", "across"))):  # fmt: skip
        known = np.array([ratio(x) for x in own])
        known = known[~np.isnan(known)]
        if len(known):
            lines.append(
                f"{name}: {len(known)} of {len(own)} pairs, error over ridge's: max {known.max():.2f}, median "
                f"{np.median(known):.2f}, above 1.1 in {(known > 1.1).sum()}; coverage "
                f"{np.nanmedian([x['coverage'] for x in own if x['ours']]):.0f} % (median)"
            )
    cad = np.array([ratio(x, "cad") for x in rows])
    if (~np.isnan(cad)).any():
        lines.append(f"over ridge towards CAD: max {np.nanmax(cad):.2f}, median {np.nanmedian(cad):.2f}")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a subset of some 20 pairs")
    parser.add_argument("--only", nargs="+", default=[], help="pairs whose names contain any of these")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("extrapolation"), help="where results are kept")
    wanted = parser.parse_args()
    tree = state()
    kept = wanted.out / tree
    kept.mkdir(parents=True, exist_ok=True)
    chosen = [
        pair for pair in PAIRS
        if (pair.quick or not wanted.quick) and (not wanted.only or any(x in pair.name for x in wanted.only))
    ]  # fmt: skip
    print("| pair | regime | ridge % | ridge CAD % | ours % | ratio | worst joint % (ridge) | within 95 % | s |")
    print("|---|---|---|---|---|---|---|---|---|", flush=True)
    rows = []
    with ProcessPoolExecutor(wanted.jobs, mp_context=get_context("spawn")) as pool:
        paths = [kept / f"{hashlib.sha1(pair.name.encode()).hexdigest()[:12]}.json" for pair in chosen]
        under_way = [None if path.exists() else pool.submit(run_named, pair.name) for path, pair in zip(paths, chosen)]
        for path, task in zip(paths, under_way):
            if task is not None:
                path.write_text(json.dumps(task.result()))
            rows.append(json.loads(path.read_text()))
            print(row(rows[-1]), flush=True)
    (wanted.out / "results.json").write_text(json.dumps({"tree": tree, "rows": rows}, indent=1))
    print("\n".join(["", *summary(rows)]))


def run_named(name: str) -> dict:
    """Return the row of the pair of that name (pairs do not pickle)."""
    return run(next(pair for pair in PAIRS if pair.name == name))


if __name__ == "__main__":
    main()
