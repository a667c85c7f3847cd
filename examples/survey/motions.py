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
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from calib.apps.studies.conditions import Condition, read_study
from calib.apps.studies.experiment import Experiment, make_experiment
from calib.identification.registry import method_named

METHODS = ("ols", "wls")


def condition_numbers(data: Experiment) -> tuple[float, float]:
    """Return the condition number of the observation matrix, raw and with normalised columns."""
    matrix = data.problem.rows[0].matrix.reshape(-1, len(data.truth))
    normalised = matrix / np.linalg.norm(matrix, axis=0)
    return float(np.linalg.cond(matrix)), float(np.linalg.cond(normalised))


def relative_errors(data: Experiment, values: np.ndarray) -> tuple[float, float]:
    """Return the errors [%] of base parameters (b,), and of the noise-free torques that follow from them."""
    wrong_values = np.linalg.norm(values - data.truth)
    wrong_torque = np.linalg.norm(data.matrix @ values - data.torque)
    value_error = 100.0 * wrong_values / np.linalg.norm(data.truth)
    torque_error = 100.0 * wrong_torque / np.linalg.norm(data.torque)
    return float(value_error), float(torque_error)


def table_lines(condition: Condition, sets: int) -> Iterator[str]:
    """Yield the lines of a condition with its motion, one per method.

    Args:
        condition: the condition.
        sets: number of data sets.
    """
    experiments = [make_experiment(condition, seed) for seed in range(sets)]
    # all data sets share the motion and the truth
    data = experiments[-1]
    raw, normalised = condition_numbers(data)
    for name in METHODS:
        method = method_named(name)
        estimates = [method.estimate(experiment.problem).estimate.values for experiment in experiments]
        errors = [relative_errors(data, values) for values in estimates]
        value_error, torque_error = np.median(errors, axis=0)
        _, mean_error = relative_errors(data, np.mean(estimates, axis=0))
        start = f"| {condition.name} {condition.motion} | {raw:.3g} | {normalised:.3g} | {name} |"
        yield f"{start} {value_error:.3g} | {torque_error:.3g} | {mean_error:.3g} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("motions", nargs="+", help="random, designed, or a folder of calib excite")
    parser.add_argument("--conditions", default="MCS-TX40-1-1,MCS-TX40-1-2")
    parser.add_argument("--data-sets", type=int, default=8)
    arguments = parser.parse_args()
    print("| | cond(W) | normalised | method | β [%] | torque [%] | of the mean |\n|---|---:|---:|---|---:|---:|---:|")
    for condition in read_study(arguments.conditions.split(",")).conditions:
        for motion in arguments.motions:
            for line in table_lines(replace(condition, motion=motion), arguments.data_sets):
                print(line, flush=True)


if __name__ == "__main__":
    main()
