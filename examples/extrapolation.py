"""How well identified dynamics predict other motion, compared with ridge regression, on many pairs of recordings.

CALIB_DATA=... python examples/extrapolation.py [--quick] [--only TEXT ...] [--jobs 2] [--out FOLDER]
    [--beside results.json] [--markdown real_recordings.md]

Errors are 100 ‖τ - τ̂‖ / ‖τ‖ on the test, measured and predicted torques low-passed alike, over the joints of one unit.
*Ridge* is regularised towards zero, positions low-passed at 6 Hz (`extrapolation_ridge.py`); *best ridge* is the best
on the test of that, of one at 15 Hz, and of both towards the description's masses where it has any. All see the same
description and files as the toolkit. *Ratio* is the toolkit's error over the better of ridge and *plain*, *to best*
over that of the best of all.
*Plain* is weighted least squares truncated at the data's rank (`extrapolation_plain.py`); *in motion* are errors of the
samples alone in which a joint is faster than `STANDING`. Results are kept in FOLDER, by the state of `calib` and of
these scripts: what is there already is not made again.
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

import extrapolation_plain as plain
import extrapolation_ridge as ridge
import numpy as np
from extrapolation_pairs import PAIRS, Prepared
from scipy.signal import butter, filtfilt

import calib

CUTOFF, RATE, BORDER = 10.0, 100.0, 0.3  # of both sides of the comparison [Hz, Hz, s]
STANDING = 0.01  # below which a joint counts as standing [rad/s or m/s]
MAX_SECONDS = 300  # for a pair
MARK = "<!-- examples/extrapolation.py -->"
CUTOFFS = (6.0, 15.0)  # of the ridges' positions [Hz]
PLAIN_RIDGE = "6 Hz, zero"  # the ridge that stands beside plain least squares


def state() -> str:
    """Return a digest of the code of the toolkit and of these scripts."""
    here = Path(__file__).parent
    files = [*sorted(Path(calib.__file__).parent.rglob("*.py")), *sorted(here.glob("extrapolation*.py"))]
    return hashlib.sha1(b"".join(path.read_bytes() for path in files)).hexdigest()[:12]


def squared_errors(
    test: list[Path], predicted: list[tuple[np.ndarray, np.ndarray]], moving: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return Σ (τ - τ̂)² and Σ τ² per joint (n,) of predictions (instants, torques) of recordings.

    Args:
        moving: of the samples alone in which a joint moves.
    """
    sums = []
    for path, (t, tau) in zip(test, predicted):
        log = np.load(path)
        grid = np.arange(max(log["t"][0], t[0]), min(log["t"][-1], t[-1]), 1.0 / RATE)
        sides = (np.column_stack([np.interp(grid, s, c) for c in x.T]) for s, x in ((log["t"], log["tau"]), (t, tau)))
        measured, own = (filtfilt(*butter(4, CUTOFF / (RATE / 2)), side, axis=0) for side in sides)
        inner = np.broadcast_to(((grid >= grid[0] + BORDER) & (grid <= grid[-1] - BORDER))[:, None], own.shape)
        if moving:
            q = np.column_stack([np.interp(grid, log["t"], c) for c in log["q"].T])
            speed = np.gradient(filtfilt(*butter(4, CUTOFF / (RATE / 2)), q, axis=0), 1.0 / RATE, axis=0)
            inner = inner & (np.abs(speed) > STANDING)
        sums.append([((measured - own) ** 2 * inner).sum(axis=0), (measured**2 * inner).sum(axis=0)])
    left, size = np.sum(sums, axis=0)
    return left, size


def identified_pair(files: Prepared, folder: Path) -> calib.DynamicsModel:
    """Return the identification of a pair's training files, validated on its test files."""
    options = folder / "options.toml"
    options.write_text(files.options)
    train, test = ([str(path) for path in paths] for paths in (files.train, files.test))
    return calib.identify_dynamics(files.robot, train, validate=test, options=options)


def _ours(files: Prepared, folder: Path) -> tuple[list[tuple[np.ndarray, np.ndarray]], float | None]:
    """Return the toolkit's predictions of the test files, and the share of their samples inside 95 % intervals [%]."""
    outcome = identified_pair(files, folder)
    predicted = [(case.motion.t, np.asarray(outcome.predictions[case.name])) for case in outcome.inputs.unseen]
    found = outcome.intervals.values()
    inside = [one.contains[one.valid].ravel() for one in found]
    return predicted, 100.0 * float(np.concatenate(inside).mean()) if inside else None


def _ridges(files: Prepared) -> dict:
    """Return the errors of the plain baselines: their names → total and joints [%]."""
    found = {}
    for cutoff in CUTOFFS:
        both = ridge.predict(files.robot, files.train, files.test, cutoff, files.payload, files.joints)
        for name in ("zero", "cad") if files.masses else ("zero",):
            found[f"{cutoff:g} Hz, {name}"] = _percent(*squared_errors(files.test, both[name]), files.apart)
    return found


def run(name: str) -> dict:
    """Return the row of the pair of that name: errors [%] of total and joints, coverage [%], processor seconds."""
    pair = next(pair for pair in PAIRS if pair.name == name)
    signal.signal(signal.SIGALRM, _too_long)
    signal.alarm(MAX_SECONDS)
    with tempfile.TemporaryDirectory() as place:
        folder, start = Path(place), time.process_time()
        files = pair.prepare(folder)
        result: dict = {"pair": name, "across": pair.across, "ridges": _ridges(files)}
        least = plain.predict(files.robot, files.train, files.test, CUTOFFS[0], files.payload, files.joints)
        result["plain"] = _percent(*squared_errors(files.test, least), files.apart)
        result["plain in motion"] = _percent(*squared_errors(files.test, least, moving=True), files.apart)
        ready = time.process_time()
        try:
            predicted, covered = _ours(files, folder)
            ours = _percent(*squared_errors(files.test, predicted), files.apart)
            moved = _percent(*squared_errors(files.test, predicted, moving=True), files.apart)
            result |= {"ours": ours, "in motion": moved, "coverage": covered, "refused": ""}
        except Exception as error:  # one pair's failure is a row of the table
            result |= {"ours": None, "in motion": None, "coverage": None, "refused": f"{type(error).__name__}: {error}"}
        result |= {"seconds": time.process_time() - ready, "preparing": ready - start}
    signal.alarm(0)
    return result


def _too_long(*_: object) -> None:
    raise TimeoutError(f"longer than {MAX_SECONDS} s")


def _percent(left: np.ndarray, size: np.ndarray, apart: tuple[int, ...]) -> dict:
    joints = 100.0 * np.sqrt(left / size)
    alike = ~np.isin(np.arange(len(left)), apart)
    return {"total": float(100.0 * np.sqrt(left[alike].sum() / size[alike].sum())), "joints": joints.tolist()}


def reference(one: dict) -> float:
    """Return the error of the plain reference [%]: the better of ridge and weighted least squares, both at 6 Hz."""
    return min(one["ridges"][PLAIN_RIDGE]["total"], one["plain"]["total"])


def ratios(one: dict) -> tuple[float, float]:
    """Return the toolkit's error over the plain reference's and over the best reference's; infinite if it refused."""
    if one["ours"] is None:
        return np.inf, np.inf
    best = min(one["plain"]["total"], *(x["total"] for x in one["ridges"].values()))
    return one["ours"]["total"] / reference(one), one["ours"]["total"] / best


def head(before: dict) -> str:
    """Return the table's head."""
    names = ["pair", "regime", "ridge", "plain", "best ridge", *(["before"] if before else []), "toolkit", "in motion"]
    names += ["ratio", "to best", "worst joint (ridge)", "within 95 %", "s"]
    return f"| {' | '.join(names)} |\n|{'---|' * len(names)}"


def line(one: dict, before: dict) -> str:
    """Return a line of the table; `before`: the errors of another version by pair, None where it refused."""
    ridged = one["ridges"][PLAIN_RIDGE]
    best = min(one["ridges"], key=lambda name: one["ridges"][name]["total"])
    cells = [one["pair"], "across" if one["across"] else "same", _share(ridged["total"]), _share(one["plain"]["total"])]
    cells.append(f"{_share(one['ridges'][best]['total'])} ({best})")
    if before:
        cells.append(_share(before.get(one["pair"])))
    cells.append(_share(one["ours"] and one["ours"]["total"]))
    if one["ours"] is None:
        cells += ["–", "–", "–", one["refused"][:80], "–"]
    else:
        joints = one["ours"]["joints"]
        worst = int(np.argmax(joints))
        cells.append(_share(one["in motion"]["total"]))
        cells += [f"{x:.2f}" for x in ratios(one)]
        cells.append(f"{worst + 1}: {joints[worst]:.0f} % ({ridged['joints'][worst]:.0f} %)")
        cells.append("–" if one["coverage"] is None else f"{one['coverage']:.0f} %")
    return f"| {' | '.join([*cells, format(one['seconds'], '.0f')])} |"


def _share(value: float | None) -> str:
    return "refused" if value is None else f"{value:.1f} %"


def summary(rows: list[dict]) -> list[str]:
    """Return lines on all pairs, those of the same regime and those across, open ones and simulated ones."""
    kinds = {
        "all": lambda x: True, "same regime": lambda x: not x["across"], "across regimes": lambda x: x["across"],
        "open": lambda x: not x["pair"].startswith("sim."), "simulated": lambda x: x["pair"].startswith("sim."),
    }  # fmt: skip
    lines = ["| pairs | number | max ratio | median | above 1.1 | to best: max | median | above 1.1 | within 95 % |"]
    lines.append("|---|---|---|---|---|---|---|---|---|")
    for name, wanted in kinds.items():
        own = [x for x in rows if wanted(x)]
        if own:
            cells = [f"{x.max():.2f} | {np.median(x):.2f} | {(x > 1.1).sum()}" for x in np.array([*map(ratios, own)]).T]
            covered = [x["coverage"] for x in own if x["coverage"] is not None]
            mean = f"{np.mean(covered):.0f} %" if covered else "–"
            lines.append(f"| {name} | {len(own)} | {' | '.join(cells)} | {mean} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a subset of some 20 pairs")
    parser.add_argument("--only", nargs="+", default=[], help="pairs whose names contain any of these")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("extrapolation"), help="where results are kept")
    parser.add_argument("--beside", type=Path, help="results.json of another version: a column of its errors")
    parser.add_argument("--markdown", type=Path, help="document whose tables between the marks are replaced")
    wanted = parser.parse_args()
    tree = state()
    kept = wanted.out / tree
    kept.mkdir(parents=True, exist_ok=True)
    chosen = [
        pair for pair in PAIRS
        if (pair.quick or not wanted.quick) and (not wanted.only or any(x in pair.name for x in wanted.only))
    ]  # fmt: skip
    before = errors_by_pair(wanted.beside) if wanted.beside else {}
    print(head(before), flush=True)
    rows = []
    with ProcessPoolExecutor(wanted.jobs, mp_context=get_context("spawn")) as pool:
        paths = [kept / f"{hashlib.sha1(pair.name.encode()).hexdigest()[:12]}.json" for pair in chosen]
        under_way = [None if path.exists() else pool.submit(run, pair.name) for path, pair in zip(paths, chosen)]
        for path, task in zip(paths, under_way):
            if task is not None:
                path.write_text(json.dumps(task.result()))
            rows.append(json.loads(path.read_text()))
            print(line(rows[-1], before), flush=True)
    (wanted.out / "results.json").write_text(json.dumps({"tree": tree, "rows": rows}, indent=1))
    print("\n".join(["", *summary(rows)]))
    if wanted.markdown:
        lines = [*summary(rows), "", head(before), *(line(one, before) for one in rows)]
        first, _, rest = wanted.markdown.read_text().partition(MARK)
        wanted.markdown.write_text(f"{first}{MARK}\n" + "\n".join(lines) + f"\n{MARK}{rest.partition(MARK)[2]}")


def errors_by_pair(path: Path) -> dict[str, float | None]:
    """Return the errors [%] in a results.json by pair; None where the toolkit refused."""
    return {x["pair"]: x["ours"] and x["ours"]["total"] for x in json.loads(path.read_text())["rows"]}


if __name__ == "__main__":
    main()
