"""A session's motion of two objectives beside that of one: σ of the parameters as predicted by the design, and reached.

python examples/session_goals.py FOLDER [--seeds 0 …] [--readme]

Each session, of a simulated TX40 without a geometry to fit, is a folder there; its `goals` stand in `session.toml`.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import practice

import calib
from calib.folders import METRICS, read_estimate
from calib.procedure.excitation.prediction import NAME, PredictedSigma
from calib.procedure.session.folder import open_session
from calib.records import read_rows

README, END = Path(__file__).parent / "README.md", "<!-- examples/session_goals.py -->"
GOALS = {"one": "[]", "two": '["normalised=12", "wrist=0.1"]'}
LITTLE = {"period": 6.0, "starts": 1, "evaluations": 100, "repeats": 2}  # of the motions, to be quick
HEAD = (
    "| seed | condition number, one → two | σ predicted, two / one: all | joints 5, 6 | σ reached, two / one: all | "
    "joints 5, 6 | unexplained, one → two |\n|---|---|---|---|---|---|---|"
)


def walked(folder: Path, goals: str, seed: int) -> tuple[float, dict[str, np.ndarray], float]:
    """Return condition number, σ predicted and reached by parameter, and unexplained torque [%] of a whole session."""
    calib.new_session(folder, "tx40", "none", seed=seed, **LITTLE)
    path = folder / "session.toml"
    path.write_text(path.read_text(encoding="utf-8").replace("goals = []", f"goals = {goals}"), encoding="utf-8")
    while next(calib.run_sessions(folder)).state == "waits":
        practice.bring(str(folder))
    session = open_session(folder)
    motion, report = session.path("6-excitation/training"), session.identification.unseen.read()
    reached = {one.name: one.sigma for one in read_estimate(session.identification.path)}
    both = {
        one.name: np.array([one.sigma, reached[one.name]])
        for one in read_rows(PredictedSigma, motion / NAME)
        if reached.get(one.name)
    }
    (proof,) = (report.proofs or report.fit).values()
    condition = json.loads((motion / METRICS).read_text(encoding="utf-8"))["condition_number"]["normalised"]
    return condition, both, proof.raw.relative_error_percent.total


def row(folder: Path, seed: int) -> str:
    """Return the table's row of two sessions."""
    (cond, one, left), (other, two, rest) = (walked(folder / f"{k}{seed}", text, seed) for k, text in GOALS.items())
    names = [name for name in one if name in two]
    ratios = np.array([two[name] / one[name] for name in names])
    wrist = np.array([name.removesuffix("R")[-1] in "56" for name in names])
    cells = [f"{np.median(ratios[own, k]):.2f}" for k in range(2) for own in (slice(None), wrist)]
    return f"| {seed} | {cond:.1f} → {other:.1f} | {' | '.join(cells)} | {left:.2f} → {rest:.2f} % |"


def main() -> None:
    read = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    read.add_argument("folder", type=Path)
    read.add_argument("--seeds", type=int, nargs="+", default=[0])
    read.add_argument("--readme", action="store_true")
    given = read.parse_args()
    table = "\n".join([HEAD, *(row(given.folder, seed) for seed in given.seeds)])
    print(table)
    if given.readme:
        before, _, after = README.read_text(encoding="utf-8").split(END)
        README.write_text(f"{before}{END}\n{table}\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
