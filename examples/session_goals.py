"""A session's motion of two objectives beside that of one: σ of the parameters as predicted by the design, and reached.

python examples/session_goals.py FOLDER [--seeds 0 …] [--readme]

Each session, of a simulated TX40 without a geometry to fit, is a folder there; its `goals` stand in `session.toml`.
"""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import practice

import calib
from calib.folders import METRICS, read_estimate
from calib.procedure.excitation.prediction import NAME, PredictedSigma
from calib.procedure.session.folder import open_session
from calib.records import read_rows

README = Path(__file__).parent / "README.md"
MARK = "<!-- examples/session_goals.py -->"
GOALS = {"one": "[]", "two": '["normalised=12", "wrist=0.1"]'}
QUICK_SEARCH = {"period": 6.0, "starts": 1, "evaluations": 100, "repeats": 2}  # of the motions
HEAD = (
    "| seed | condition number, one → two | σ predicted, two / one: all | joints 5, 6 | σ reached, two / one: all | "
    "joints 5, 6 | unexplained, one → two |\n|---|---|---|---|---|---|---|"
)


@dataclass(frozen=True)
class Outcome:
    """What a whole session came to.

    Attributes:
        condition: condition number of the motion's normalised observation matrix.
        sigmas: σ of each parameter as predicted and as reached, (2,).
        unexplained: torque on the held-out motion [%].
    """

    condition: float
    sigmas: dict[str, np.ndarray]
    unexplained: float


def session_outcome(folder: Path, goals: str, seed: int) -> Outcome:
    """Run a whole session of a simulated TX40, its cell simulated, and return what it came to."""
    calib.new_session(folder, "tx40", "none", seed=seed, **QUICK_SEARCH)
    settings = folder / "session.toml"
    text = settings.read_text(encoding="utf-8")
    settings.write_text(text.replace("goals = []", f"goals = {goals}"), encoding="utf-8")
    while next(calib.run_sessions(folder)).state == "waits":
        practice.bring(str(folder))

    session = open_session(folder)
    motion = session.path("6-excitation/training")
    metrics = json.loads((motion / METRICS).read_text(encoding="utf-8"))
    reached = {parameter.name: parameter.sigma for parameter in read_estimate(session.identification.path)}
    sigmas = {}
    for parameter in read_rows(PredictedSigma, motion / NAME):
        if reached.get(parameter.name):
            sigmas[parameter.name] = np.array([parameter.sigma, reached[parameter.name]])
    report = session.identification.unseen.read()
    (proof,) = (report.proofs or report.fit).values()
    unexplained = proof.raw.relative_error_percent.total
    return Outcome(metrics["condition_number"]["normalised"], sigmas, unexplained)


def row(folder: Path, seed: int) -> str:
    """Return the table's row of two sessions."""
    first = session_outcome(folder / f"one{seed}", GOALS["one"], seed)
    second = session_outcome(folder / f"two{seed}", GOALS["two"], seed)
    names = [name for name in first.sigmas if name in second.sigmas]
    ratios = np.array([second.sigmas[name] / first.sigmas[name] for name in names])
    wrist = np.array([name.removesuffix("R")[-1] in "56" for name in names])
    all_medians = np.median(ratios, axis=0)
    wrist_medians = np.median(ratios[wrist], axis=0)
    cells = [str(seed), f"{first.condition:.1f} → {second.condition:.1f}"]
    for median, wrist_median in zip(all_medians, wrist_medians):
        cells += [f"{median:.2f}", f"{wrist_median:.2f}"]
    cells.append(f"{first.unexplained:.2f} → {second.unexplained:.2f} %")
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--readme", action="store_true")
    options = parser.parse_args()
    rows = [row(options.folder, seed) for seed in options.seeds]
    table = "\n".join([HEAD, *rows])
    print(table)
    if options.readme:
        before, _, after = README.read_text(encoding="utf-8").split(MARK)
        README.write_text(f"{before}{MARK}\n{table}\n{MARK}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
