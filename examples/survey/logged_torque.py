"""What a log's torque costs: that of an instant, or the mean of what acted; encoder noise in the loop, or beside it.

    python examples/survey/logged_torque.py [--methods wls,iv,ekf,ukf] [--seeds 1]

A controller at 5 kHz turns encoder noise into torque that a log at 1 kHz sees one period in five of. Prints the error
[%] of noise-free torques along another motion, TX40 without decimation, as `calib study` has it.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from calib.apps.studies.conditions import Condition, read_study
from calib.apps.studies.experiment import Experiment, make_experiment, set_up
from calib.data.recordings.recording import Recording
from calib.data.signals.motion import FilterOptions, make_motion
from calib.identification.closed_loop.simulation import Sensing, simulate
from calib.identification.registry import method_named
from calib.identification.rows import Case, observe
from calib.simulation import known_robots


def with_case(data: Experiment, case: Case) -> Experiment:
    """Return the data set with its recording replaced by another."""
    rows = observe(data.model, data.problem.base.kept, case, data.problem.decimator)
    return replace(data, problem=replace(data.problem, cases=(case,), rows=(rows,)))


def variants(condition: Condition, seed: int) -> dict[str, Experiment]:
    """Return three variants of a data set: as logged, with mean torque, and with encoder noise outside the loop."""
    data, setup = make_experiment(condition, seed), set_up(condition)
    case, every = data.problem.cases[0], int(setup.every)
    sensing = Sensing(condition.sigma_q, sigma_tau=condition.sigma_tau)
    rng = np.random.default_rng([seed, 20_211])  # that of `make_experiment`: the same noise in the loop
    fine = simulate(setup.plant, known_robots.controller(condition.robot), setup.reference, sensing, rng)
    at = np.rint((case.motion.t - fine.t[0]) / setup.reference.period).astype(int)
    near = at[:, None] + np.arange(-(every // 2), every // 2 + 1)
    mean = fine.torque[np.clip(near, 0, len(fine.t) - 1)].mean(axis=1)
    away = np.sqrt(np.mean((case.target - mean) ** 2, axis=0))
    print(f"{condition.name}: torque of an instant less the mean, rms per joint [N m]: {np.round(away, 2)}")
    beside = fine.q[::every] + condition.sigma_q * np.random.default_rng(seed).standard_normal(fine.q[::every].shape)
    log = Recording(fine.t[::every], beside, fine.tau[::every], "torque", setup.chain.joint_names, file=condition.name)
    asked = FilterOptions(cutoff=condition.cutoff, band=0.999 * case.motion.band, clock="stamps")
    moved = make_motion(log, asked)
    same = np.rint((case.motion.t - moved.t[0]) * moved.rate).astype(int)
    other = replace(case, motion=replace(case.motion, q=moved.q[same], v=moved.v[same], a=moved.a[same]))
    return {
        "as logged": data,
        "mean torque": with_case(data, replace(case, target=mean)),
        "encoder noise beside the loop": with_case(data, other),
    }


def error(data: Experiment, method: str) -> float:
    """Return the torque error [%]; NaN without an estimate."""
    found = method_named(method).estimate(data.problem)
    if not found.found:
        return float("nan")
    wrong = data.matrix @ found.estimate.values[: data.problem.base.b] - data.torque
    return 100.0 * float(np.linalg.norm(wrong) / np.linalg.norm(data.torque))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--methods", default="wls,iv,ekf,ukf")
    parser.add_argument("--seeds", type=int, default=1)
    given = parser.parse_args()
    for condition in read_study(["MCS-TX40-1-1", "MCS-TX40-1-2", "MCS-TX40-1-3"]).conditions:
        for seed in range(given.seeds):
            for name, data in variants(condition, seed).items():
                errors = ", ".join(f"{method} {error(data, method):.3g}" for method in given.methods.split(","))
                print(f"{condition.name}, seed {seed}, {name}: {errors}", flush=True)


if __name__ == "__main__":
    main()
