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
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import study_options
import study_tables

from calib import files
from calib.data.signals.filtering import decimate
from calib.dynamics.torque_rows import torque_rows
from calib.errors import TaskLost
from calib.identification.identify import chain_states, common_decimator, find_base
from calib.identification.uncertainty import geometry_uncertainty
from calib.simulation import known_robots
from calib.toolkit.chains import CalibratedChain, Chain, random_joints
from calib.toolkit.installations import calibrated_chain, install
from calib.toolkit.installations import fit_installation as fit
from calib.toolkit.model_identification import Identification, identify
from calib.toolkit.recordings import FilterOptions, Recording, make_motion
from calib.toolkit.sessions import Payload
from calib.toolkit.simulations import Cell, Reference, SimulatedInstrument, lwr4plus_cell, measure, random_fourier
from calib.toolkit.torque_models import Case, IdentificationSettings, make_case, make_model, standard_parameters
from calib.workers import workers

PAYLOAD = "8"
RATE, DURATION, HARMONICS = 200.0, 25.0, 5
REACH = 0.8 * np.deg2rad([170.0, 120.0, 170.0, 120.0, 170.0, 90.0, 170.0])
SPEED = 0.8 * np.deg2rad([110.0, 110.0, 128.0, 128.0, 204.0, 184.0, 184.0])
LIMIT = np.array([176.0, 176.0, 100.0, 100.0, 100.0, 38.0, 38.0])
FILTERS = FilterOptions(cutoff=20.0, band=10.0, clock="stamps")
SETS = {"link": "Fvl Fcl offl", "motor": "Ia Fv Fc off"}
WITHIN = 1.959964  # sigmas of a 95 % interval
FURTHER = (1, 3, 10)  # CAD, and geometries so many times as far off


@dataclass(frozen=True)
class Setup:
    """An instrument and the number of poses it measures."""

    name: str
    position: float
    orientation: float
    poses: int

    @property
    def instrument(self) -> SimulatedInstrument:
        return SimulatedInstrument(self.name, self.position, self.orientation)


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
        clean: torques without noise (N, n), without and with the payload.
        names, base: the true base parameters (b,), regrouped on the true geometry.
        noise: (n,) standard deviation of the torque.
        poses: (m, n) joint values.
    """

    cell: Cell
    settings: IdentificationSettings
    motion: Reference
    clean: list[np.ndarray]
    names: tuple[str, ...]
    base: np.ndarray
    noise: np.ndarray
    poses: np.ndarray


def world(setup: Setup, kind: str, seed: int) -> World:
    """Return the truth of a setup; the arm's CAD inertias are the true ones."""
    cell = lwr4plus_cell(setup.instrument, hidden=0.0)
    settings = IdentificationSettings(
        torque_rows=torque_rows(kind), sets=(SETS[kind],), friction="standard", essential="none", prior="none",
        payloads={PAYLOAD: Payload()},
    )  # fmt: skip
    motion, true = reference(seed), cell.truth.chain
    values, clean = true_torques(true, settings, motion)
    cases = cases_of(motion, clean, kind, np.zeros(true.n), 0)
    nominal = make_model(cell.nominal, settings)
    base = find_base(make_model(true, settings), cases, chain_states(true, nominal, settings.seed), nominal)
    noise = known_robots.truth("lwr4plus")["noise"]["sigma_tau_l" if kind == "link" else "sigma_tau_m"] * LIMIT
    poses = random_joints(cell.nominal, setup.poses, [seed, setup.poses])
    return World(cell, settings, motion, clean, base.names, base.transform @ values, noise, poses)


def true_torques(
    true: Chain, settings: IdentificationSettings, motion: Reference
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the true standard parameters, and the torques without and with the payload (N, n)."""
    known, model = known_robots.truth("lwr4plus"), make_model(true, settings)
    drives = [drive_values(known)[name] for name in model.names[model.inertial :]]
    values = np.concatenate([standard_parameters(true), known["payload"]["inertia"], drives])
    loads = ((), (PAYLOAD,))
    return values, [model.regressor(motion.q, motion.v, motion.a, carried=load) @ values for load in loads]


def reference(seed: int) -> Reference:
    """Return a random motion of one period of 25 s."""
    return random_fourier(-REACH, REACH, SPEED, DURATION, RATE, HARMONICS, seed=np.random.default_rng(seed))


def drive_values(known: dict[str, Any]) -> dict[str, float]:
    """Return the true drive parameters by name; for motors alone they are the sum of motor and link side."""
    own = dict(known["drives"])
    own["off"] = np.add(own["offl"], own["offm"])
    return {f"{name}{joint + 1}": float(x) for name, row in own.items() for joint, x in enumerate(row)}


def cases_of(
    motion: Reference, clean: Any, kind: str, noise: np.ndarray, seed: Any, sigma_q: float = 0.0
) -> list[Case]:
    """Return the two recordings, without and with the payload."""
    rng = np.random.default_rng(seed)
    result = []
    for name, tau, load in (("empty", clean[0], ()), ("loaded", clean[1], (PAYLOAD,))):
        tau = tau + noise * rng.normal(size=tau.shape)
        q = motion.q + sigma_q * rng.normal(size=tau.shape)
        names = tuple(f"joint{j + 1}" for j in range(tau.shape[1]))
        recording = Recording(motion.t, q, tau, "torque", names, tau_link=tau if kind == "link" else None)
        result.append(make_case(name, make_motion(recording, FILTERS), torque_rows(kind), carried=load))
    return result


def calibrate(given: World, seed: list[int]) -> CalibratedChain:
    """Measure the poses and fit: the calibrated robot, with the covariance of its elements."""
    measured = measure(given.cell, given.poses, np.random.default_rng([*seed, 1]))
    return calibrated_chain(fit(install(given.cell.nominal, [measured]), [measured]))


def once(given: World, seed: list[int]) -> np.ndarray:
    """Calibrate geometry and dynamics: errors, σ_torque and σ_geometry of the base parameters (3, b)."""
    robot = calibrate(given, seed)
    cases = cases_of(given.motion, given.clean, given.settings.torque_rows.name, given.noise, [*seed, 2], 1e-5)
    found = identify(robot, cases, given.settings)
    carried = geometry_uncertainty.propagate(found, robot, cases)
    off = found.fitted.estimate.values - given.base
    return np.stack([off, carried.sigma_torque, carried.sigma_geometry])


def coverage(setup: Setup, kind: str, runs: int, seed: int, where: str | None) -> dict[str, Any]:
    """Return how often the intervals contain the true value, pooled and by parameter."""
    given, start = world(setup, kind, seed), time.perf_counter()
    results = {}
    with workers(where) as crew:
        for number, one in crew.completed(partial(once, given), [[seed, k] for k in range(runs)]):
            if isinstance(one, TaskLost):
                print(f"\n{one}", file=sys.stderr)
                continue
            results[number] = one
            spent = time.perf_counter() - start
            print(f"\r{setup.name}: {len(results)} of {runs}, {spent:.0f} s", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    off, torque, geometry = np.abs(np.stack([results[number] for number in sorted(results)], axis=1))
    with_it, without = off <= WITHIN * np.hypot(torque, geometry), off <= WITHIN * torque
    share = np.mean(geometry, axis=0) / np.mean(torque, axis=0)
    over = share > 1.0
    grows = np.hypot(1.0, share) - 1.0
    names = given.names
    return {
        "runs": len(results), "parameters": len(names),
        "pooled": {"with": float(with_it.mean()), "without": float(without.mean())},
        "geometry_exceeds_torque": {
            "parameters": [name for name, yes in zip(names, over) if yes],
            "with": _mean(with_it[:, over]), "without": _mean(without[:, over]),
            "largest_without": _mean(without[:, over].mean(axis=0).max(initial=0.0) if over.any() else np.zeros(0)),
        },
        "unchanged": {
            "parameters": [name for name, x in zip(names, grows) if x <= geometry_uncertainty.NOTHING],
            "with": _mean(with_it[:, grows <= geometry_uncertainty.NOTHING]),
            "without": _mean(without[:, grows <= geometry_uncertainty.NOTHING]),
        },
        "by_parameter": [
            {"name": name, "sigma_geometry_over_torque": float(s), "with": float(a), "without": float(b)}
            for name, s, a, b in zip(names, share, with_it.mean(axis=0), without.mean(axis=0))
        ],
        "rms_error_in_sigma": {
            "with": float(np.sqrt(np.mean((off / np.hypot(torque, geometry)) ** 2))),
            "without": float(np.sqrt(np.mean((off / torque) ** 2))),
        },
        "seconds_per_run": (time.perf_counter() - start) / runs,
    }  # fmt: skip


def _mean(values: np.ndarray) -> float | None:
    return float(np.mean(values)) if np.size(values) else None


def geometries(kind: str, seed: int) -> dict[str, Any]:
    """Return the errors of torque and of parameters by the geometry that identification uses."""
    fine, coarse = (world(setup, kind, seed) for setup in SETUPS)
    true, nominal = fine.cell.truth.chain, fine.cell.nominal
    chains = {"true geometry": true}
    chains |= {
        f"calibrated, {setup.name}": calibrate(given, [seed, 0]).chain for setup, given in zip(SETUPS, (fine, coarse))
    }
    for times in FURTHER:
        chains["CAD" if times == 1 else f"CAD, {times} times as far off"] = true.with_values(
            true.values + times * (nominal.values - true.values)
        )
    cases = cases_of(fine.motion, fine.clean, kind, fine.noise, [seed, 3], 1e-5)
    found = identify(CalibratedChain(true, nominal), cases, fine.settings)
    other = unseen(fine, seed)
    return {name: judged(fine, found, chain, cases, other) for name, chain in chains.items()}


def unseen(given: World, seed: int) -> list[Case]:
    """Return the cases of a validation motion with noise-free torques."""
    motion, true = reference(seed + 1001), given.cell.truth.chain
    _, clean = true_torques(true, given.settings, motion)
    return cases_of(motion, clean, given.settings.torque_rows.name, np.zeros(true.n), 0)


def judged(given: World, found: Identification, chain: Chain, cases: list[Case], other: list[Case]) -> dict[str, Any]:
    """Return the error of the torque on other motion and the parameters' bias, of the model identified on a geometry.

    The torque's error is that of the noisy estimate, against noise-free torque; the bias that of noise-free torques.
    """
    how = geometry_uncertainty.estimator(found)
    rows = geometry_uncertainty.rows_on(found, chain, cases)
    noisy, _ = geometry_uncertainty.estimate(how, rows)
    decimator = common_decimator(cases, given.settings)
    exact = [
        replace(part, target=decimate(tau, decimator)[: len(part.target)])
        for part, tau in zip(rows, _cut(given, cases))
    ]
    biased, _ = geometry_uncertainty.estimate(how, exact)
    size = (biased - given.base) / found.fitted.estimate.sigma
    model, error, torque = make_model(chain, given.settings), [], []
    for case in other:
        motion = case.motion
        regressor = model.regressor(motion.q, motion.v, motion.a, carried=case.carried)[:, :, found.base.kept]
        error.append(regressor @ np.stack([noisy, biased], axis=1) - case.target[:, :, None])
        torque.append(case.target)
    off, whole = np.concatenate(error), np.concatenate(torque)
    percent = 100.0 * np.sqrt((off**2).sum(axis=(0, 1)) / (whole**2).sum())
    joints = 100.0 * np.linalg.norm(off[:, :, 0], axis=0) / np.linalg.norm(whole, axis=0)
    order = np.argsort(-np.abs(size))
    return {
        "torque_error_percent": float(percent[0]), "torque_error_without_noise_percent": float(percent[1]),
        "joints_percent": joints.tolist(), "rms": np.sqrt((off[:, :, 0] ** 2).mean(axis=0)).tolist(),
        "bias_in_sigma": {"rms": float(np.sqrt(np.mean(size**2))), "largest": float(np.abs(size).max()),
                          "beyond_2": int((np.abs(size) > 2.0).sum())},
        "by_parameter": {found.names[k]: float(size[k]) for k in order},
    }  # fmt: skip


def _cut(given: World, cases: list[Case]) -> list[np.ndarray]:
    """Return the noise-free torques at the samples kept by the filters, for each case."""
    result = []
    for tau, case in zip(given.clean, cases):
        first = round((case.motion.t[0] - given.motion.t[0]) * RATE)
        result.append(tau[first : first + len(case.motion)])
    return result


def run(out: Path, runs: int = 20, kind: str = "link", seed: int = 0, where: str | None = None) -> dict[str, Any]:
    """Run both halves; write and return the metrics."""
    metrics: dict[str, Any] = {"kind": kind, "seed": seed, "geometries": geometries(kind, seed)}
    metrics["coverage"] = {setup.name: coverage(setup, kind, runs, seed, where) for setup in SETUPS} if runs else {}
    files.write_json(out / "metrics.json", metrics)
    return metrics


def main() -> None:
    options = study_options.read(
        __doc__,
        runs=(20, "simulated calibrations per setup; 0 for none"),
        kind=(("link", "motor"), "joint torque sensors, or motor torques"),
        workers=(None, "number of processes, or a Dask scheduler's address"),
    )
    study_tables.show(
        study_tables.consistency(run(options.out, options.runs, options.kind, options.seed, options.workers))
    )


if __name__ == "__main__":
    main()
