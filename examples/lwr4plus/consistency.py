"""Consistent geometry and dynamics on the simulated LWR4+: do the intervals cover the truth, and what is CAD worth?

Coverage: many whole calibrations. Each measures the poses anew (truth: the calibrated column of Table 2 of Kolyubin,
Shiriaev & Jubien 2019, no hidden deflections), fits the geometry, records the torques anew (joint torque sensors or
motors, encoder noise), identifies the base parameters on the geometry it found, and carries that geometry's covariance
along. How often do the 95 % intervals hold the true base parameters, with the geometry's part and without it? For a
fine instrument and many poses, and for a coarse one and few. The truth is of the model's own form and the noise white:
this tests the statistics, and is no evidence of how well intervals hold on a real arm.

Geometries: the same torques identified on the true geometry, on calibrated ones, on CAD, and on CADs further off. How
wrong is the torque on other motion, against the torque without noise, and how far off are the parameters?

    python examples/lwr4plus/consistency.py --out lwr4plus-consistency [--runs 20] [--kind link] [--workers 1]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import study_options
import study_tables

import calib
from calib import files
from calib.data.signals.filtering import decimate
from calib.dynamics.torque_rows import torque_rows
from calib.errors import TaskLost
from calib.identification.identify import chain_states, common_decimator, find_base
from calib.identification.uncertainty import geometry_uncertainty
from calib.simulation import known_robots
from calib.toolkit.chains import Chain, random_joints
from calib.toolkit.installations import calibrated_chain, install
from calib.toolkit.installations import fit_installation as fit
from calib.toolkit.model_identification import Identification, identify
from calib.toolkit.recordings import FilterOptions, Recording, make_motion
from calib.toolkit.sessions import Payload
from calib.toolkit.simulations import Cell, Reference, lwr4plus_cell, measure, random_fourier
from calib.toolkit.torque_models import Case, IdentificationSettings, make_case, make_model, standard_parameters
from calib.workers import workers

PAYLOAD = "8"
# reference motion: rate [Hz], duration [s], harmonics, shares of the ranges [rad] and of the speeds [rad/s]
RATE, DURATION, HARMONICS = 200.0, 25.0, 5
REACH = 0.8 * np.deg2rad([170.0, 120.0, 170.0, 120.0, 170.0, 90.0, 170.0])
SPEED = 0.8 * np.deg2rad([110.0, 110.0, 128.0, 128.0, 204.0, 184.0, 184.0])
# torque limits [N m]; noise is stated as their share
LIMIT = np.array([176.0, 176.0, 100.0, 100.0, 100.0, 38.0, 38.0])
# σ of the encoders [rad]
ENCODER_NOISE = 1e-5
FILTERS = FilterOptions(cutoff=20.0, band=10.0, clock="stamps")
# kind of torque: drive terms, and the key of its noise in lwr4plus_truth.toml
DRIVES = {"link": "Fvl Fcl offl", "motor": "Ia Fv Fc off"}
NOISE = {"link": "sigma_tau_l", "motor": "sigma_tau_m"}
# σ of a 95 % interval
INTERVAL = 1.959964
# factors of the CAD's error, in the geometries that are compared
CAD_FACTORS = (1, 3, 10)


@dataclass(frozen=True)
class Setup:
    """An instrument and the number of poses it measures.

    Attributes:
        name: name of the setup.
        position: σ of a position [m].
        orientation: σ of an orientation [rad].
        poses: number of poses.
    """

    name: str
    position: float
    orientation: float
    poses: int

    @property
    def instrument(self) -> calib.SimulatedInstrument:
        return calib.SimulatedInstrument(self.name, self.position, self.orientation)


SETUPS = (
    Setup("fine instrument, many poses", 60e-6, 0.2e-3, 60),
    Setup("coarse instrument, few poses", 1e-3, 2e-3, 20),
)


@dataclass(frozen=True, eq=False)
class World:
    """The true robot, and the data shared by all runs.

    Attributes:
        cell: the arm and its instrument.
        settings: of the identification.
        motion: the reference.
        clean: torques without noise (N, n) [N m], without and with the payload.
        names, base: the true base parameters (b,), regrouped on the true geometry.
        noise: (n,) standard deviation of the torque [N m].
        poses: (m, n) joint values [rad].
    """

    cell: Cell
    settings: IdentificationSettings
    motion: Reference
    clean: list[np.ndarray]
    names: tuple[str, ...]
    base: np.ndarray
    noise: np.ndarray
    poses: np.ndarray


def make_world(setup: Setup, kind: str, seed: int) -> World:
    """Return the truth of a setup; the arm's CAD inertias are the true ones.

    Args:
        setup: instrument and number of poses.
        kind: ``link`` for joint torque sensors, ``motor`` for motor torques.
        seed: seed of motion and poses.
    """
    cell = lwr4plus_cell(setup.instrument, hidden=0.0)
    true = cell.truth.chain
    settings = IdentificationSettings(
        torque_rows=torque_rows(kind),
        sets=(DRIVES[kind],),
        friction="standard",
        essential="none",
        prior="none",
        payloads={PAYLOAD: Payload()},
    )
    motion = reference(seed)
    values, clean = true_torques(true, settings, motion)
    # base columns of the nominal model, regrouped on the true geometry
    cases = cases_of(motion, clean, kind, np.zeros(true.n), 0)
    nominal = make_model(cell.nominal, settings)
    states = chain_states(true, nominal, settings.seed)
    base = find_base(make_model(true, settings), cases, states, nominal)
    noise = known_robots.truth("lwr4plus")["noise"][NOISE[kind]] * LIMIT
    poses = random_joints(cell.nominal, setup.poses, [seed, setup.poses])
    return World(cell, settings, motion, clean, base.names, base.transform @ values, noise, poses)


def true_torques(
    true: Chain, settings: IdentificationSettings, motion: Reference
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the true standard parameters (p,), and the torques without and with the payload (N, n) [N m]."""
    truth = known_robots.truth("lwr4plus")
    model = make_model(true, settings)
    by_name = drive_values(truth)
    drives = [by_name[name] for name in model.names[model.inertial :]]
    values = np.concatenate([standard_parameters(true), truth["payload"]["inertia"], drives])
    torques = []
    for carried in ((), (PAYLOAD,)):
        regressor = model.regressor(motion.q, motion.v, motion.a, carried=carried)
        torques.append(regressor @ values)
    return values, torques


def reference(seed: int) -> Reference:
    """Return a random motion of one period of 25 s."""
    return random_fourier(-REACH, REACH, SPEED, DURATION, RATE, HARMONICS, seed=np.random.default_rng(seed))


def drive_values(truth: dict[str, Any]) -> dict[str, float]:
    """Return the true drive parameters by name; for motors alone they are the sum of motor and link side."""
    drives = dict(truth["drives"])
    drives["off"] = np.add(drives["offl"], drives["offm"])
    values = {}
    for name, row in drives.items():
        for joint, value in enumerate(row, 1):
            values[f"{name}{joint}"] = float(value)
    return values


def cases_of(
    motion: Reference, clean: Sequence[np.ndarray], kind: str, noise: np.ndarray, seed: Any, sigma_q: float = 0.0
) -> list[Case]:
    """Return the two recordings, without and with the payload.

    Args:
        motion: the motion.
        clean: noise-free torques (N, n) [N m], without and with the payload.
        kind: ``link`` or ``motor``.
        noise: (n,) standard deviation of the torque [N m].
        seed: seed of the noise.
        sigma_q: standard deviation of the positions [rad].
    """
    rng = np.random.default_rng(seed)
    cases = []
    for name, torque, carried in (("empty", clean[0], ()), ("loaded", clean[1], (PAYLOAD,))):
        tau = torque + noise * rng.normal(size=torque.shape)
        q = motion.q + sigma_q * rng.normal(size=torque.shape)
        tau_link = tau if kind == "link" else None
        names = tuple(f"joint{joint + 1}" for joint in range(tau.shape[1]))
        recording = Recording(motion.t, q, tau, "torque", names, tau_link=tau_link)
        cases.append(make_case(name, make_motion(recording, FILTERS), torque_rows(kind), carried=carried))
    return cases


def calibrate(world: World, seed: list[int]) -> calib.CalibratedChain:
    """Measure the poses and fit: the calibrated robot, with the covariance of its elements."""
    measured = measure(world.cell, world.poses, np.random.default_rng([*seed, 1]))
    installation = install(world.cell.nominal, [measured])
    return calibrated_chain(fit(installation, [measured]))


def calibrate_both(world: World, seed: list[int]) -> np.ndarray:
    """Calibrate geometry and dynamics: errors, σ_torque and σ_geometry of the base parameters (3, b)."""
    robot = calibrate(world, seed)
    kind = world.settings.torque_rows.name
    cases = cases_of(world.motion, world.clean, kind, world.noise, [*seed, 2], ENCODER_NOISE)
    identification = identify(robot, cases, world.settings)
    propagated = geometry_uncertainty.propagate(identification, robot, cases)
    errors = identification.fitted.estimate.values - world.base
    return np.stack([errors, propagated.sigma_torque, propagated.sigma_geometry])


def coverage(setup: Setup, kind: str, runs: int, seed: int, where: str | None) -> dict[str, Any]:
    """Return how often the intervals contain the true value, pooled and by parameter.

    Args:
        setup: instrument and number of poses.
        kind: ``link`` or ``motor``.
        runs: number of calibrations.
        seed: seed of everything random.
        where: number of processes, or address of a Dask scheduler.
    """
    start = time.perf_counter()
    world = make_world(setup, kind, seed)
    results = {}
    with workers(where) as crew:
        for number, result in crew.completed(partial(calibrate_both, world), [[seed, k] for k in range(runs)]):
            if isinstance(result, TaskLost):
                print(f"\n{result}", file=sys.stderr)
                continue
            results[number] = result
            seconds = time.perf_counter() - start
            print(f"\r{setup.name}: {len(results)} of {runs}, {seconds:.0f} s", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    ordered = [results[number] for number in sorted(results)]
    metrics = coverage_metrics(world.names, np.stack(ordered))
    return metrics | {"seconds_per_run": (time.perf_counter() - start) / runs}


def coverage_metrics(names: Sequence[str], results: np.ndarray) -> dict[str, Any]:
    """Return how often the intervals contain the true value, pooled and by parameter.

    Args:
        names: names of the b base parameters.
        results: (runs, 3, b) errors, σ_torque and σ_geometry of each run.
    """
    errors, torque, geometry = np.abs(results).swapaxes(0, 1)
    total = np.hypot(torque, geometry)
    covered = errors <= INTERVAL * total
    covered_without = errors <= INTERVAL * torque
    # σ of the geometry over that of the torques, and how much it widens the interval
    ratio = np.mean(geometry, axis=0) / np.mean(torque, axis=0)
    growth = np.hypot(1.0, ratio) - 1.0
    geometric = ratio > 1.0
    unchanged = growth <= geometry_uncertainty.NOTHING

    def share_of(mask: np.ndarray) -> dict[str, Any]:
        """Return some parameters, and how often intervals hold them with and without the geometry's part."""
        return {
            "parameters": [name for name, selected in zip(names, mask) if selected],
            "with": _mean(covered[:, mask]),
            "without": _mean(covered_without[:, mask]),
        }

    by_parameter = []
    for k, name in enumerate(names):
        by_parameter.append(
            {
                "name": name,
                "sigma_geometry_over_torque": float(ratio[k]),
                "with": float(covered[:, k].mean()),
                "without": float(covered_without[:, k].mean()),
            }
        )
    largest_without = None
    if geometric.any():
        largest_without = float(covered_without[:, geometric].mean(axis=0).max())
    return {
        "runs": len(results),
        "parameters": len(names),
        "pooled": {"with": float(covered.mean()), "without": float(covered_without.mean())},
        "geometry_exceeds_torque": share_of(geometric) | {"largest_without": largest_without},
        "unchanged": share_of(unchanged),
        "by_parameter": by_parameter,
        "rms_error_in_sigma": {"with": _rms(errors / total), "without": _rms(errors / torque)},
    }


def _mean(values: np.ndarray) -> float | None:
    return float(np.mean(values)) if values.size else None


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def geometries(kind: str, seed: int) -> dict[str, Any]:
    """Return the errors of torque and of parameters by the geometry that identification uses."""
    worlds = [make_world(setup, kind, seed) for setup in SETUPS]
    # recordings and truth are those of the first setup
    world = worlds[0]
    true, nominal = world.cell.truth.chain, world.cell.nominal
    chains = {"true geometry": true}
    for setup, setup_world in zip(SETUPS, worlds):
        chains[f"calibrated, {setup.name}"] = calibrate(setup_world, [seed, 0]).chain
    for factor in CAD_FACTORS:
        name = "CAD" if factor == 1 else f"CAD, {factor} times as far off"
        chains[name] = true.with_values(true.values + factor * (nominal.values - true.values))
    cases = cases_of(world.motion, world.clean, kind, world.noise, [seed, 3], ENCODER_NOISE)
    identification = identify(calib.CalibratedChain(true, nominal), cases, world.settings)
    validation = validation_cases(world, seed)
    metrics = {}
    for name, chain in chains.items():
        metrics[name] = geometry_metrics(world, identification, chain, cases, validation)
    return metrics


def validation_cases(world: World, seed: int) -> list[Case]:
    """Return the cases of a validation motion with noise-free torques."""
    motion = reference(seed + 1001)
    true = world.cell.truth.chain
    _, clean = true_torques(true, world.settings, motion)
    return cases_of(motion, clean, world.settings.torque_rows.name, np.zeros(true.n), 0)


def geometry_metrics(
    world: World, identification: Identification, chain: Chain, cases: list[Case], validation: list[Case]
) -> dict[str, Any]:
    """Return the error of the torque on other motion and the parameters' bias, of the model identified on a geometry.

    The torque's error is that of the noisy estimate, against noise-free torque; the bias that of noise-free torques.

    Args:
        world: the truth.
        identification: identification on the true geometry, whose estimator and σ are used.
        chain: the geometry.
        cases: the recordings.
        validation: cases of another motion, without noise.
    """
    estimator = geometry_uncertainty.estimator(identification)
    rows = geometry_uncertainty.rows_on(identification, chain, cases)
    noisy, _ = geometry_uncertainty.estimate(estimator, rows)
    decimator = common_decimator(cases, world.settings)
    noise_free = []
    for case_rows, torque in zip(rows, _clean_torques(world, cases)):
        target = decimate(torque, decimator)[: len(case_rows.target)]
        noise_free.append(replace(case_rows, target=target))
    biased, _ = geometry_uncertainty.estimate(estimator, noise_free)
    bias = (biased - world.base) / identification.fitted.estimate.sigma
    by_size = np.argsort(-np.abs(bias))

    model = make_model(chain, world.settings)
    kept = identification.base.kept
    noisy_errors, biased_errors, targets = [], [], []
    for case in validation:
        motion = case.motion
        regressor = model.regressor(motion.q, motion.v, motion.a, carried=case.carried)[:, :, kept]
        noisy_errors.append(regressor @ noisy - case.target)
        biased_errors.append(regressor @ biased - case.target)
        targets.append(case.target)
    error, noise_free_error, torque = map(np.concatenate, (noisy_errors, biased_errors, targets))
    joints = np.linalg.norm(error, axis=0) / np.linalg.norm(torque, axis=0)
    return {
        "torque_error_percent": float(100.0 * np.linalg.norm(error) / np.linalg.norm(torque)),
        "torque_error_without_noise_percent": float(100.0 * np.linalg.norm(noise_free_error) / np.linalg.norm(torque)),
        "joints_percent": (100.0 * joints).tolist(),
        "rms": np.sqrt((error**2).mean(axis=0)).tolist(),
        "bias_in_sigma": {
            "rms": _rms(bias),
            "largest": float(np.abs(bias).max()),
            "beyond_2": int((np.abs(bias) > 2.0).sum()),
        },
        "by_parameter": {identification.names[k]: float(bias[k]) for k in by_size},
    }


def _clean_torques(world: World, cases: list[Case]) -> list[np.ndarray]:
    """Return the noise-free torques (N, n) [N m] at the samples kept by the filters, for each case."""
    torques = []
    for torque, case in zip(world.clean, cases):
        first = round((case.motion.t[0] - world.motion.t[0]) * RATE)
        torques.append(torque[first : first + len(case.motion)])
    return torques


def run(out: Path, runs: int = 20, kind: str = "link", seed: int = 0, where: str | None = None) -> dict[str, Any]:
    """Run both halves; write and return the metrics."""
    coverages = {}
    metrics: dict[str, Any] = {"kind": kind, "seed": seed, "geometries": geometries(kind, seed)}
    if runs:
        coverages = {setup.name: coverage(setup, kind, runs, seed, where) for setup in SETUPS}
    metrics["coverage"] = coverages
    files.write_json(out / "metrics.json", metrics)
    return metrics


def main() -> None:
    arguments = study_options.read(
        __doc__,
        runs=(20, "simulated calibrations per setup; 0 for none"),
        kind=(("link", "motor"), "joint torque sensors, or motor torques"),
        workers=(None, "number of processes, or a Dask scheduler's address"),
    )
    metrics = run(arguments.out, arguments.runs, arguments.kind, arguments.seed, arguments.workers)
    study_tables.show(study_tables.consistency(metrics))


if __name__ == "__main__":
    main()
