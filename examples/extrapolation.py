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
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import extrapolation_plain as plain
import extrapolation_ridge as ridge
import numpy as np
from extrapolation_pairs import PAIRS, Pair, Prepared
from scipy.signal import butter, filtfilt

import calib

CUTOFF = 10.0  # of the low-pass of measured and predicted torques [Hz]
RATE = 100.0  # at which both are compared [Hz]
BORDER = 0.3  # at both ends of a recording, where the low-pass has not settled [s]
STANDING = 0.01  # below which a joint counts as standing [rad/s or m/s]
MAX_SECONDS = 300  # for a pair
MARK = "<!-- examples/extrapolation.py -->"
RIDGE_CUTOFFS = (6.0, 15.0)  # of the ridges' positions [Hz]
PLAIN_RIDGE = "6 Hz, zero"  # the ridge that stands beside plain least squares
MAX_RATIO = 1.1  # pairs above are counted in the summary

# instants (N,) [s] and torques (N, n) [N m or N] of a recording
Prediction = tuple[np.ndarray, np.ndarray]


def state() -> str:
    """Return a digest of the code of the toolkit and of these scripts."""
    toolkit = sorted(Path(calib.__file__).parent.rglob("*.py"))
    scripts = sorted(Path(__file__).parent.glob("extrapolation*.py"))
    digest = hashlib.sha1()
    for path in [*toolkit, *scripts]:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def resampled(grid: np.ndarray, t: np.ndarray, series: np.ndarray) -> np.ndarray:
    """Return series (N, n) at instants t (N,) [s], interpolated at the instants of a grid."""
    return np.column_stack([np.interp(grid, t, column) for column in series.T])


def low_passed(series: np.ndarray) -> np.ndarray:
    """Return series (N, n) at `RATE`, low-passed at `CUTOFF` without delay."""
    return filtfilt(*butter(4, CUTOFF / (RATE / 2)), series, axis=0)


def squared_errors(
    test: list[Path], predictions: list[Prediction], moving: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return Σ (τ - τ̂)² and Σ τ² per joint (n,) of predictions of recordings.

    Args:
        test: the recordings (npz: t, q, tau).
        predictions: instants and torques, one pair per recording.
        moving: of the samples alone in which a joint moves.
    """
    sums = []
    for path, (t, tau) in zip(test, predictions):
        log = np.load(path)
        start = max(log["t"][0], t[0])
        end = min(log["t"][-1], t[-1])
        grid = np.arange(start, end, 1.0 / RATE)
        measured = low_passed(resampled(grid, log["t"], log["tau"]))
        predicted = low_passed(resampled(grid, t, tau))
        settled = (grid >= grid[0] + BORDER) & (grid <= grid[-1] - BORDER)
        counted = np.broadcast_to(settled[:, None], predicted.shape)
        if moving:
            q = low_passed(resampled(grid, log["t"], log["q"]))
            velocity = np.gradient(q, 1.0 / RATE, axis=0)
            counted = counted & (np.abs(velocity) > STANDING)
        error = ((measured - predicted) ** 2 * counted).sum(axis=0)
        size = (measured**2 * counted).sum(axis=0)
        sums.append([error, size])
    errors, sizes = np.sum(sums, axis=0)
    return errors, sizes


def identified_pair(files: Prepared, folder: Path) -> calib.DynamicsModel:
    """Return the identification of a pair's training files, validated on its test files."""
    options = folder / "options.toml"
    options.write_text(files.options)
    train = [str(path) for path in files.train]
    test = [str(path) for path in files.test]
    return calib.identify_dynamics(files.robot, train, validate=test, options=options)


def _toolkit(files: Prepared, folder: Path) -> tuple[list[Prediction], float | None]:
    """Return the toolkit's predictions of the test files, and the share of their samples inside 95 % intervals [%]."""
    model = identified_pair(files, folder)
    predictions = [(case.motion.t, np.asarray(model.predictions[case.name])) for case in model.inputs.unseen]
    inside = [intervals.contains[intervals.valid].ravel() for intervals in model.intervals.values()]
    if not inside:
        return predictions, None
    return predictions, 100.0 * float(np.concatenate(inside).mean())


def _ridges(files: Prepared) -> dict:
    """Return the errors of the ridge regressions: their names → total and joints [%]."""
    priors = ["zero"]
    if files.masses:
        priors.append("cad")
    errors = {}
    for cutoff in RIDGE_CUTOFFS:
        predictions = ridge.predict(files.robot, files.train, files.test, cutoff, files.payload, files.joints)
        for prior in priors:
            errors[f"{cutoff:g} Hz, {prior}"] = _errors(files, predictions[prior])
    return errors


def run(name: str) -> dict:
    """Return the row of the pair of that name: errors [%] of total and joints, coverage [%], processor seconds."""
    pair = next(pair for pair in PAIRS if pair.name == name)
    signal.signal(signal.SIGALRM, _too_long)
    signal.alarm(MAX_SECONDS)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        start = time.process_time()
        files = pair.prepare(folder)
        result: dict = {"pair": name, "across": pair.across, "ridges": _ridges(files)}
        cutoff = RIDGE_CUTOFFS[0]
        least_squares = plain.predict(files.robot, files.train, files.test, cutoff, files.payload, files.joints)
        result["plain"] = _errors(files, least_squares)
        result["plain in motion"] = _errors(files, least_squares, moving=True)
        prepared = time.process_time()
        result |= _toolkit_row(files, folder)
        result["seconds"] = time.process_time() - prepared
        result["preparing"] = prepared - start
    signal.alarm(0)
    return result


def _toolkit_row(files: Prepared, folder: Path) -> dict:
    """Return the toolkit's part of a row; where it fails, the reason."""
    try:
        predictions, coverage = _toolkit(files, folder)
        errors = _errors(files, predictions)
        errors_in_motion = _errors(files, predictions, moving=True)
    except Exception as error:  # one pair's failure is a row of the table
        reason = f"{type(error).__name__}: {error}"
        return {"ours": None, "in motion": None, "coverage": None, "refused": reason}
    return {"ours": errors, "in motion": errors_in_motion, "coverage": coverage, "refused": ""}


def _too_long(*_: object) -> None:
    raise TimeoutError(f"longer than {MAX_SECONDS} s")


def _errors(files: Prepared, predictions: list[Prediction], moving: bool = False) -> dict:
    """Return the relative errors [%] of predictions of a pair's test files: total, and joint by joint."""
    errors, sizes = squared_errors(files.test, predictions, moving)
    joints = 100.0 * np.sqrt(errors / sizes)
    alike = ~np.isin(np.arange(len(errors)), files.other_unit)
    total = 100.0 * np.sqrt(errors[alike].sum() / sizes[alike].sum())
    return {"total": float(total), "joints": joints.tolist()}


def reference(row: dict) -> float:
    """Return the error of the plain reference [%]: the better of ridge and weighted least squares, both at 6 Hz."""
    return min(row["ridges"][PLAIN_RIDGE]["total"], row["plain"]["total"])


def best_ridge(row: dict) -> str:
    """Return the name of the ridge regression with the least error on the test."""
    return min(row["ridges"], key=lambda name: row["ridges"][name]["total"])


def ratios(row: dict) -> tuple[float, float]:
    """Return the toolkit's error over the plain reference's and over the best reference's; infinite if it refused."""
    if row["ours"] is None:
        return np.inf, np.inf
    best = min(row["plain"]["total"], row["ridges"][best_ridge(row)]["total"])
    error = row["ours"]["total"]
    return error / reference(row), error / best


def head(before: dict) -> str:
    """Return the table's head."""
    names = ["pair", "regime", "ridge", "plain", "best ridge"]
    if before:
        names.append("before")
    names += ["toolkit", "in motion", "ratio", "to best", "worst joint (ridge)", "within 95 %", "s"]
    return f"| {' | '.join(names)} |\n|{'---|' * len(names)}"


def line(row: dict, before: dict) -> str:
    """Return a line of the table; `before`: the errors of another version by pair, None where it refused."""
    plain_ridge = row["ridges"][PLAIN_RIDGE]
    best = best_ridge(row)
    cells = [row["pair"]]
    cells.append("across" if row["across"] else "same")
    cells.append(_share(plain_ridge["total"]))
    cells.append(_share(row["plain"]["total"]))
    cells.append(f"{_share(row['ridges'][best]['total'])} ({best})")
    if before:
        cells.append(_share(before.get(row["pair"])))
    if row["ours"] is None:
        cells += [_share(None), "–", "–", "–", row["refused"][:80], "–"]
    else:
        joints = row["ours"]["joints"]
        worst = int(np.argmax(joints))
        cells.append(_share(row["ours"]["total"]))
        cells.append(_share(row["in motion"]["total"]))
        cells += [f"{ratio:.2f}" for ratio in ratios(row)]
        cells.append(f"{worst + 1}: {joints[worst]:.0f} % ({plain_ridge['joints'][worst]:.0f} %)")
        cells.append("–" if row["coverage"] is None else f"{row['coverage']:.0f} %")
    cells.append(f"{row['seconds']:.0f}")
    return f"| {' | '.join(cells)} |"


def _share(value: float | None) -> str:
    if value is None:
        return "refused"
    return f"{value:.1f} %"


def summary(rows: list[dict]) -> list[str]:
    """Return lines on all pairs, those of the same regime and those across, open ones and simulated ones."""
    groups: dict[str, list[dict]] = {"all": rows, "same regime": [], "across regimes": [], "open": [], "simulated": []}
    for row in rows:
        regime = "across regimes" if row["across"] else "same regime"
        origin = "simulated" if row["pair"].startswith("sim.") else "open"
        groups[regime].append(row)
        groups[origin].append(row)
    lines = ["| pairs | number | max ratio | median | above 1.1 | to best: max | median | above 1.1 | within 95 % |"]
    lines.append("|---|---|---|---|---|---|---|---|---|")
    for name, group in groups.items():
        if group:
            lines.append(_summary_line(name, group))
    return lines


def _summary_line(name: str, group: list[dict]) -> str:
    """Return the summary's line of a group of pairs."""
    cells = [name, str(len(group))]
    to_plain, to_best = np.transpose([ratios(row) for row in group])
    for ratio in (to_plain, to_best):
        cells += [f"{ratio.max():.2f}", f"{np.median(ratio):.2f}", str((ratio > MAX_RATIO).sum())]
    coverage = [row["coverage"] for row in group if row["coverage"] is not None]
    cells.append(f"{np.mean(coverage):.0f} %" if coverage else "–")
    return f"| {' | '.join(cells)} |"


def chosen_pairs(quick: bool, texts: list[str]) -> list[Pair]:
    """Return the pairs to run: the quick ones or all; of these, where texts are given, those whose names hold one."""
    chosen = []
    for pair in PAIRS:
        if quick and not pair.quick:
            continue
        if texts and not any(text in pair.name for text in texts):
            continue
        chosen.append(pair)
    return chosen


def results(pairs: list[Pair], folder: Path, jobs: int) -> Iterator[dict]:
    """Yield the rows of pairs in their order; those that the folder holds already are not made again."""
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        tasks = []
        for pair in pairs:
            path = folder / f"{hashlib.sha1(pair.name.encode()).hexdigest()[:12]}.json"
            task = None if path.exists() else pool.submit(run, pair.name)
            tasks.append((path, task))
        for path, task in tasks:
            if task is not None:
                path.write_text(json.dumps(task.result()))
            yield json.loads(path.read_text())


def write_between_marks(document: Path, lines: list[str]) -> None:
    """Replace what stands between the two marks of a document."""
    text_before, _, marked = document.read_text().partition(MARK)
    text_after = marked.partition(MARK)[2]
    table = "\n".join(lines)
    document.write_text(f"{text_before}{MARK}\n{table}\n{MARK}{text_after}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a subset of some 20 pairs")
    parser.add_argument("--only", nargs="+", default=[], help="pairs whose names contain any of these")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("extrapolation"), help="where results are kept")
    parser.add_argument("--beside", type=Path, help="results.json of another version: a column of its errors")
    parser.add_argument("--markdown", type=Path, help="document whose tables between the marks are replaced")
    options = parser.parse_args()
    tree = state()
    folder = options.out / tree
    folder.mkdir(parents=True, exist_ok=True)
    before = errors_by_pair(options.beside) if options.beside else {}
    print(head(before), flush=True)
    rows = []
    for row in results(chosen_pairs(options.quick, options.only), folder, options.jobs):
        rows.append(row)
        print(line(row, before), flush=True)
    (options.out / "results.json").write_text(json.dumps({"tree": tree, "rows": rows}, indent=1))
    print()
    print("\n".join(summary(rows)))
    if options.markdown:
        lines = [*summary(rows), "", head(before)]
        lines += [line(row, before) for row in rows]
        write_between_marks(options.markdown, lines)


def errors_by_pair(path: Path) -> dict[str, float | None]:
    """Return the errors [%] in a results.json by pair; None where the toolkit refused."""
    errors: dict[str, float | None] = {}
    for row in json.loads(path.read_text())["rows"]:
        errors[row["pair"]] = None
        if row["ours"] is not None:
            errors[row["pair"]] = row["ours"]["total"]
    return errors


if __name__ == "__main__":
    main()
