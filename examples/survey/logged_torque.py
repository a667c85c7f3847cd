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
from calib.apps.studies.experiment import Experiment, Setup, make_experiment, set_up
from calib.data.recordings.recording import Recording
from calib.data.signals.motion import FilterOptions, make_motion
from calib.identification.closed_loop.simulation import Sensing, SimulatedRun, simulate
from calib.identification.registry import method_named
from calib.identification.rows import Case, observe
from calib.simulation import known_robots


def with_case(data: Experiment, case: Case) -> Experiment:
    """Return the data set with its recording replaced by another."""
    rows = observe(data.model, data.problem.base.kept, case, data.problem.decimator)
    return replace(data, problem=replace(data.problem, cases=(case,), rows=(rows,)))


def variants(condition: Condition, seed: int) -> dict[str, Experiment]:
    """Return three variants of a data set: as logged, with mean torque, and with encoder noise outside the loop."""
    data = make_experiment(condition, seed)
    setup = set_up(condition)
    run = loop_run(condition, setup, seed)
    (case,) = data.problem.cases
    mean = mean_torque(case, setup, run)
    difference = np.sqrt(np.mean((case.target - mean) ** 2, axis=0))
    print(f"{condition.name}: torque of an instant less the mean, rms per joint [N m]: {np.round(difference, 2)}")
    return {
        "as logged": data,
        "mean torque": with_case(data, replace(case, target=mean)),
        "encoder noise beside the loop": with_case(data, noise_beside_loop(condition, case, setup, run, seed)),
    }


def loop_run(condition: Condition, setup: Setup, seed: int) -> SimulatedRun:
    """Return the run of a data set at the control rate, with the noise that `make_experiment` has in the loop."""
    sensing = Sensing(condition.sigma_q, sigma_tau=condition.sigma_tau)
    rng = np.random.default_rng([seed, 20_211])
    return simulate(setup.plant, known_robots.controller(condition.robot), setup.reference, sensing, rng)


def mean_torque(case: Case, setup: Setup, run: SimulatedRun) -> np.ndarray:
    """Return the torques (N, n) of a recording, each the mean over the control periods of its sample [N m]."""
    ticks = np.rint((case.motion.t - run.t[0]) / setup.reference.period).astype(int)
    half = int(setup.every) // 2
    window = ticks[:, None] + np.arange(-half, half + 1)
    window = np.clip(window, 0, len(run.t) - 1)
    return run.torque[window].mean(axis=1)


def noise_beside_loop(condition: Condition, case: Case, setup: Setup, run: SimulatedRun, seed: int) -> Case:
    """Return a recording whose encoder noise is added to the log, and did not act on the controller.

    Args:
        condition: the condition, which gives the noise and the filter.
        case: the recording of the data set.
        setup: the data common to all data sets of the condition.
        run: the run at the control rate.
        seed: seed of the noise.
    """
    sample = slice(None, None, int(setup.every))
    q = run.q[sample]
    noise = np.random.default_rng(seed).standard_normal(q.shape)
    measured = q + condition.sigma_q * noise
    names = setup.chain.joint_names
    recording = Recording(run.t[sample], measured, run.tau[sample], "torque", names, file=condition.name)
    filters = FilterOptions(cutoff=condition.cutoff, band=0.999 * case.motion.band, clock="stamps")
    motion = make_motion(recording, filters)
    # the samples of the data set's recording, to keep its torques
    rows = np.rint((case.motion.t - motion.t[0]) * motion.rate).astype(int)
    moved = replace(case.motion, q=motion.q[rows], v=motion.v[rows], a=motion.a[rows])
    return replace(case, motion=moved)


def torque_error(data: Experiment, method: str) -> float:
    """Return the torque error [%] of a method's estimate; NaN without an estimate."""
    result = method_named(method).estimate(data.problem)
    if not result.found:
        return float("nan")
    values = result.estimate.values[: data.problem.base.b]
    residual = data.matrix @ values - data.torque
    return 100.0 * float(np.linalg.norm(residual) / np.linalg.norm(data.torque))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--methods", default="wls,iv,ekf,ukf")
    parser.add_argument("--seeds", type=int, default=1)
    arguments = parser.parse_args()
    methods = arguments.methods.split(",")
    for condition in read_study(["MCS-TX40-1-1", "MCS-TX40-1-2", "MCS-TX40-1-3"]).conditions:
        for seed in range(arguments.seeds):
            for name, data in variants(condition, seed).items():
                errors = [f"{method} {torque_error(data, method):.3g}" for method in methods]
                print(f"{condition.name}, seed {seed}, {name}: {', '.join(errors)}", flush=True)


if __name__ == "__main__":
    main()
