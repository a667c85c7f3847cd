"""The variance of the networks, as multiples of that of ordinary least squares; the survey has the neuron above 10.

    python examples/survey/network_variance.py [--conditions MCS-TX40-1-1,MCS-TX40-1-2] [--data-sets 8] [--guesses 3]

For each network, rate and number of steps, as multiples of least squares' variance over data sets (medians over the
parameters): the variance over data sets from one guess, and over guesses on one data set. Besides, the median error [%]
of noise-free torques along another motion.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from calib.apps.studies.conditions import Condition, read_study
from calib.apps.studies.experiment import make_experiment
from calib.identification.methods.method import Method
from calib.identification.registry import method_named
from calib.identification.survey.networks import ADALINE, HOPFIELD

TRIED: dict[str, Method] = {
    "ols": method_named("ols"),
    "adaline": ADALINE,
    "adaline, rate 0.1": replace(ADALINE, rate=0.1),
    "adaline, 100,000 steps": replace(ADALINE, steps=100_000),
    "hopfield": HOPFIELD,
    "hopfield, 100,000 steps": replace(HOPFIELD, steps=100_000),
}


def estimated(condition: Condition, sets: int) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Return estimates (data sets, guesses, b) and the median torque error [%] of each method."""
    values: dict[str, list[np.ndarray]] = {name: [] for name in TRIED}
    errors: dict[str, list[float]] = {name: [] for name in TRIED}
    for seed in range(sets * condition.guesses):
        data = make_experiment(condition, seed)
        for name, method in TRIED.items():
            own = method.estimate(data.problem).estimate.values
            values[name].append(own)
            errors[name].append(float(np.linalg.norm(data.matrix @ own - data.torque) / np.linalg.norm(data.torque)))
    shaped = {name: np.reshape(own, (sets, condition.guesses, -1)) for name, own in values.items()}
    return shaped, {name: 100.0 * float(np.median(own)) for name, own in errors.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--conditions", default="MCS-TX40-1-1,MCS-TX40-1-2")
    parser.add_argument("--data-sets", type=int, default=8)
    parser.add_argument("--guesses", type=int, default=3)
    given = parser.parse_args()
    for condition in read_study(given.conditions.split(",")).conditions:
        values, errors = estimated(replace(condition, guesses=given.guesses), given.data_sets)
        plain = values["ols"][:, 0].var(axis=0, ddof=1)
        print(f"{condition.name}\n\n| | over data sets | over guesses | torque [%] |\n|---|---:|---:|---:|")
        for name, own in values.items():
            over = own.var(axis=0, ddof=1).mean(axis=0), own.var(axis=1, ddof=1).mean(axis=0)
            shares = " | ".join(f"{np.median(one / plain):.3g}" for one in over)
            print(f"| {name} | {shares} | {errors[name]:.3g} |", flush=True)
        print()


if __name__ == "__main__":
    main()
