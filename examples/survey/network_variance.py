"""The variance of the networks, as multiples of that of ordinary least squares; the survey has the neuron above 10.

    python examples/survey/network_variance.py [--conditions MCS-TX40-1-1,MCS-TX40-1-2] [--data-sets 8] [--guesses 3]

For each network, rate and number of steps, as multiples of least squares' variance over data sets (medians over the
parameters): the variance over data sets from one guess, and over guesses on one data set. Besides, the median error [%]
of noise-free torques along another motion.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace

import numpy as np

from calib.apps.studies.conditions import Condition, read_study
from calib.apps.studies.experiment import make_experiment
from calib.identification.methods.method import Method
from calib.identification.registry import method_named
from calib.identification.survey.networks import ADALINE, HOPFIELD

METHODS: dict[str, Method] = {
    "ols": method_named("ols"),
    "adaline": ADALINE,
    "adaline, rate 0.1": replace(ADALINE, rate=0.1),
    "adaline, 100,000 steps": replace(ADALINE, steps=100_000),
    "hopfield": HOPFIELD,
    "hopfield, 100,000 steps": replace(HOPFIELD, steps=100_000),
}


@dataclass(frozen=True, eq=False)
class Trials:
    """Estimates of one method on several data sets.

    Attributes:
        values: (data sets, guesses, b) estimated base parameters.
        error: median error of the noise-free torques [%].
    """

    values: np.ndarray
    error: float


def run_trials(condition: Condition, sets: int) -> dict[str, Trials]:
    """Return the trials of each method on a condition.

    Args:
        condition: the condition, with its number of guesses.
        sets: number of data sets.
    """
    values: dict[str, list[np.ndarray]] = {name: [] for name in METHODS}
    errors: dict[str, list[float]] = {name: [] for name in METHODS}
    for seed in range(sets * condition.guesses):
        data = make_experiment(condition, seed)
        for name, method in METHODS.items():
            estimate = method.estimate(data.problem).estimate
            residual = data.matrix @ estimate.values - data.torque
            values[name].append(estimate.values)
            errors[name].append(float(np.linalg.norm(residual) / np.linalg.norm(data.torque)))
    trials = {}
    for name in METHODS:
        by_guess = np.reshape(values[name], (sets, condition.guesses, -1))
        trials[name] = Trials(by_guess, 100.0 * float(np.median(errors[name])))
    return trials


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--conditions", default="MCS-TX40-1-1,MCS-TX40-1-2")
    parser.add_argument("--data-sets", type=int, default=8)
    parser.add_argument("--guesses", type=int, default=3)
    arguments = parser.parse_args()
    for condition in read_study(arguments.conditions.split(",")).conditions:
        trials = run_trials(replace(condition, guesses=arguments.guesses), arguments.data_sets)
        # variance of ordinary least squares over the data sets, from the first guess
        reference = trials["ols"].values[:, 0].var(axis=0, ddof=1)
        print(f"{condition.name}\n\n| | over data sets | over guesses | torque [%] |\n|---|---:|---:|---:|")
        for name, trial in trials.items():
            over_sets = trial.values.var(axis=0, ddof=1).mean(axis=0)
            over_guesses = trial.values.var(axis=1, ddof=1).mean(axis=0)
            set_share = np.median(over_sets / reference)
            guess_share = np.median(over_guesses / reference)
            print(f"| {name} | {set_share:.3g} | {guess_share:.3g} | {trial.error:.3g} |", flush=True)
        print()


if __name__ == "__main__":
    main()
