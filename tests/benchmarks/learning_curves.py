"""Error on other motion against the seconds learnt from, and the error stated: python learning_curves.py [NAME …].

Needs the folder of recordings (``CALIB_DATA``). Rows go to ``learning_curves.json`` in the working folder, one curve at
a time; ``--figure FILE`` draws those that are there, ``--no-fits`` without measuring any.
"""

import argparse
import json
import os
from pathlib import Path

import numpy as np

from calib.identification.identify import identify
from calib.identification.identify_options import parse_options
from calib.identification.prediction import predict, score
from calib.identification.uncertainty.learned_torque_errors import learn_torque_errors
from calib.identification.uncertainty.torque_errors import intervals
from calib.procedure.dynamic_stage.inputs import gather

DATA = Path(os.environ.get("CALIB_DATA", "../shared/data"))
ROWS = Path("learning_curves.json")
GAINS = {"gains": [14.87, 13.26, 11.13, 10.62, 11.03, 11.47]}
WRIST = {"coupling": [{"joints": [5, 6], "label": "6"}]}
PANDA, UR10E, TX40 = (
    "franka_panda_inria/traj1_first60pct.npz",
    "ur10e_innopolis/ur-20_0",
    "staubli_tx40/tx40_first_5p4s.npz",
)
KR300, LWR, TIAGO = "kuka_kr300_tuk/traj_", "kuka_lwr4plus_iit/measurements_1.npz", "tiago_laas/dynamic.npz"
SHOWN = (0.5, 1, 2, 4, 8, 16, 32), (3, 5, 10, 20, 50, 100)  # on the axes [s], [%]
CURVES = {  # training, its start, seconds, unseen, options
    "Panda": (PANDA, 0.0, (1, 2, 4, 6, 9.387), f"{PANDA}@9.387:11.9", {}),
    "UR10e": (f"{UR10E}2_10-30sec_12harm.npz", 8.0, (2, 4, 8, 16, 22), f"{UR10E}2_19_14harm50sec.npz", GAINS),
    "TX40": (TX40, 0.0, (0.5, 1, 2, 2.7), f"{TX40}@2.7:", WRIST),
    "KR300": (f"{KR300}A.npz", 0.0, (4, 6, 8, 10), f"{KR300}B.npz", {}),
    "LWR4+": (LWR, 2.5, (3, 6.25), f"{LWR}@8.75:15", {}),
    "TIAGo": (TIAGO, 0.0, (5, 10, 25, 50), f"{TIAGO}@50:", {}),
}


def error(name: str, seconds: float) -> dict[str, str | float]:
    """Return the total error on unseen and on training motion of a model of the first `seconds`, and what it states.

    ``stated`` is the rms of the stated sigma on the unseen motion, in percent of the rms torque as the errors are, and
    ``inside`` the share of errors within 1.96 sigma [%]; both None where there is too little motion to state any.
    """
    log, start, _, unseen, options = CURVES[name]
    robot = (DATA / log).parent / "model.urdf"
    given = gather(
        robot, [f"{DATA / log}@{start:g}:{start + seconds:g}"], [str(DATA / unseen)], options=parse_options(options)
    )  # fmt: skip
    found, (case,), (other,) = identify(given.robot, given.cases, given.options.settings), given.cases, given.unseen
    predicted = predict(found.dynamics, other)
    result = {
        "robot": name,
        "seconds": seconds,
        "training": round(score(case, predict(found.dynamics, case)).raw.total, 2),
        "unseen": round(score(other, predicted).raw.total, 2),
    }
    if (errors := learn_torque_errors(found, given.cases)) is None:
        return result
    expected = intervals(errors, found.dynamics, other, predicted)
    size, own = (np.sqrt(np.mean(one[expected.known] ** 2)) for one in (other.target[expected.index], expected.sigma))
    return result | {"stated": round(float(100.0 * own / size), 2), "inside": round(100.0 * expected.covered, 1)}


def draw(rows: list[dict], path: Path) -> None:
    """Draw error against seconds, and the stated sigma beside it."""
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6.4, 3.6), layout="constrained")
    for name in CURVES:
        own = sorted((row["seconds"], row["unseen"]) for row in rows if row["robot"] == name)
        if own:
            (line,) = axes.plot(*zip(*own), "o-", label=name)
            stated = sorted((row["seconds"], row["stated"]) for row in rows if row["robot"] == name and "stated" in row)
            axes.plot(*zip(*stated), ":", color=line.get_color())
    axes.set(xscale="log", yscale="log", xlabel="learnt from [s]", ylabel="unexplained on other motion [%]")
    axes.set_title("dotted: the sigma stated", fontsize=9)
    axes.grid(alpha=0.3, which="both")
    axes.set_xticks(SHOWN[0], [f"{x:g}" for x in SHOWN[0]], minor=False)
    axes.set_yticks(SHOWN[1], [f"{y:g}" for y in SHOWN[1]], minor=False)
    axes.minorticks_off()
    figure.legend(loc="outside right upper")
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(CURVES))
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--no-fits", action="store_true")
    given = parser.parse_args()
    rows = json.loads(ROWS.read_text()) if ROWS.exists() else []
    for name in () if given.no_fits else given.names:
        for seconds in CURVES[name][2]:
            rows = [row for row in rows if (row["robot"], row["seconds"]) != (name, seconds)]
            rows.append(error(name, seconds))
            print(rows[-1], flush=True)
            ROWS.write_text(json.dumps(rows, indent=1))
    if given.figure is not None:
        draw(rows, given.figure)


if __name__ == "__main__":
    main()
