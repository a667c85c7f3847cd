"""What a designed motion is worth: errors of parameters and torques by the criterion it was designed for.

    python examples/survey/motions.py random designed logdet torque [--conditions …] [--data-sets 8]

where logdet is a folder of ``calib excite tx40 --out logdet --goal logdet --period 10 --harmonics 12 --drives "Ia Fv
Fc" --rate 5000 --limits examples/survey/limits.toml``, and torque one of ``--goal torque``.

`random` and `designed` are the motions of `calib study`. Prints, for each motion, the condition number of W raw and
normalised, and of ols and wls the median errors [%] of β and of noise-free torques along another motion, and the torque
error of the mean estimate: what more data would not take away, but for the mean's own noise.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from calib.apps.studies.conditions import read_study
from calib.apps.studies.experiment import make_experiment
from calib.identification.registry import method_named


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("motions", nargs="+", help="random, designed, or a folder of calib excite")
    parser.add_argument("--conditions", default="MCS-TX40-1-1,MCS-TX40-1-2")
    parser.add_argument("--data-sets", type=int, default=8)
    given = parser.parse_args()
    print("| | cond(W) | normalised | method | β [%] | torque [%] | of the mean |\n|---|---:|---:|---|---:|---:|---:|")
    for condition in read_study(given.conditions.split(",")).conditions:
        for motion in given.motions:
            found: dict[str, list[np.ndarray]] = {"ols": [], "wls": []}
            for seed in range(given.data_sets):
                data = make_experiment(replace(condition, motion=motion), seed)
                for name, own in found.items():
                    own.append(method_named(name).estimate(data.problem).estimate.values)
            matrix = data.problem.rows[0].matrix.reshape(-1, len(data.truth))
            conditions = [np.linalg.cond(matrix / scale) for scale in (1.0, np.linalg.norm(matrix, axis=0))]
            for name, own in found.items():
                off = [
                    (np.linalg.norm(x - data.truth), np.linalg.norm(data.matrix @ x - data.torque))
                    for x in (*own, np.mean(own, axis=0))
                ]
                shares = 100.0 * np.array(off) / [np.linalg.norm(data.truth), np.linalg.norm(data.torque)]
                cells = [*conditions, *np.median(shares[:-1], axis=0), shares[-1, 1]]
                words = [f"{value:.3g}" for value in cells]
                print(f"| {condition.name} {motion} | {' | '.join([*words[:2], name, *words[2:]])} |", flush=True)


if __name__ == "__main__":
    main()
