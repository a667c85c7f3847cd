"""The geometric half of the LWR4+ study, scripted: simulate the paper's cell, choose 17 poses, fit, validate.

Kolyubin, Shiriaev & Jubien (2019), Int. J. Adv. Manuf. Technol. 101, 243-259, sections 3 and 6.1. The truth is the
calibrated column of their Table 2, plus a hidden deflection that no rigid geometry holds, of a size that leaves about
the residual of their Table 3. The model is theirs: frames 0 to 8, 36 parameters, 32 of them fitted.

    python examples/lwr4plus/geometry.py --out lwr4plus-geometry [--seeds 3] [--seconds 3] [--quick] [--seed 0]

Some six minutes of processor time, nearly all of it for comparing ways of choosing poses (--seeds 0: left out).
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import study_options
import study_tables

import calib
from calib import files
from calib.geometry.accuracy import errors
from calib.geometry.fit import GeometricFit, Settings, fit_with_prior, parameter_values, polish_frames
from calib.poses.candidates import draw_candidates
from calib.poses.continuous.tabu import TabuRule
from calib.poses.indices import Index, observability
from calib.poses.select import Method, SearchSettings, Selection, random_baseline, select_poses
from calib.poses.space import PoseConstraint, SearchSpace, is_feasible
from calib.poses.whole_space import bound_over_space
from calib.robot import mdh
from calib.robot.kinematics import jacobian, jacobian_product
from calib.simulation import lwr4plus
from calib.toolkit.chains import Chain, random_joints
from calib.toolkit.installations import Installation, install, prepare, see
from calib.toolkit.installations import fit_installation as fit
from calib.toolkit.pose_data import Positions
from calib.toolkit.simulations import Cell, lwr4plus_cell, measure, rigid, true_poses
from calib.transforms import invert

# joint limits, symmetric [rad]
LIMITS = np.deg2rad([170.0, 120.0, 170.0, 120.0, 170.0, 90.0, 170.0])
# the paper's four parameters that are not identifiable
DROPPED = ("alpha0", "d0", "theta7", "r7")
# σ of the simulated instrument [m], [rad]; scale the rows of O1
SIGMAS = np.repeat([60e-6, 0.2e-3], 3)
# draws of the noise, for a rigid truth
DRAWS = 60
METHODS: tuple[Method, ...] = ("local", "multistart", "tabu", "detmax", "polish")
# O2 = 1 / cond, but of rows in sigmas
INDICES: tuple[Index, ...] = ("cond", "O1", "O2", "O3", "O4", "O5")
# relative tolerances of the rank
TOLERANCES = (1e-3, 1e-9)
Metrics = dict[str, Any]


@dataclass(frozen=True)
class Extent:
    """How much of the study is run.

    Attributes:
        indices: indices by which poses are chosen.
        methods: methods of choosing poses.
        candidates: number of candidates of a comparison.
        unseen: number of validation poses.
        climbs: local searches of the last round, in the bound of O1.
        random_sets: number of single random sets.
        best_of: number of random sets of which the best is taken.
    """

    indices: tuple[Index, ...] = INDICES
    methods: tuple[Method, ...] = METHODS
    candidates: int = 2000
    unseen: int = 500
    climbs: int = 32
    random_sets: int = 200
    best_of: int = 1000


QUICK = Extent(("cond", "O1"), ("detmax",), 500, 100, 0, 50, 100)


def study_chain(table: np.ndarray) -> Chain:
    """Return the paper's chain from a column of Table 2: frames 0 and 8 are fixed rows around the seven joints.

    Args:
        table: (9, 4) alpha [rad], d [m], theta [rad], r [m] of the frames.
    """
    rows = []
    for index, (alpha, d, theta, r) in enumerate(table):
        name = f"joint{index}"
        if index in (0, 8):
            row = mdh.Row(name, index, "fixed", alpha, d, theta, r)
        else:
            limit = LIMITS[index - 1]
            row = mdh.Row(name, index, "revolute", alpha, d, theta, r, lower=-limit, upper=limit)
        rows.append(row)
    return mdh.chain("lwr4plus study", rows, base="camera", tip="fixture")


def base_columns(chain: Chain) -> np.ndarray:
    """Return the positions of the paper's 32 base parameters."""
    return np.array([k for k, name in enumerate(chain.names) if name not in DROPPED])


@dataclass(frozen=True)
class BaseJacobian:
    """q (m, 7) -> (m, 6, 32): position rows [m], orientation rows [rad], divided by `scale` (6,)."""

    chain: Chain
    scale: np.ndarray

    def __call__(self, q: np.ndarray) -> np.ndarray:
        return jacobian(self.chain, q)[:, :, base_columns(self.chain)] / self.scale[:, None]

    def product(self, q: np.ndarray, G: np.ndarray) -> np.ndarray:
        """Return Σ G ∂J/∂q (m, 7)."""
        full = np.zeros((len(q), 6, len(self.chain.elements)))
        full[:, :, base_columns(self.chain)] = G / self.scale[:, None]
        return jacobian_product(self.chain, q, full)


@dataclass(frozen=True)
class TableOne:
    """The paper's Table 1 in our reading (`lwr4plus.constraint_values`), as values that have to be <= 0."""

    chain: Chain
    station: np.ndarray
    tool: np.ndarray

    def __call__(self, q: np.ndarray) -> np.ndarray:
        return -lwr4plus.constraint_values(self.chain, self.station, self.tool, q)

    def gradient(self, q: np.ndarray) -> np.ndarray:
        """Return the derivatives (m, 6, 7)."""
        return -lwr4plus.constraint_gradients(self.chain, self.station, self.tool, q)


def search_space(nominal: np.ndarray, index: str) -> SearchSpace:
    """Return the search space of poses; Jacobian in metres and radians for cond (as in the paper), else in sigmas.

    Args:
        nominal: (9, 4) nominal column of Table 2.
        index: index by which poses are chosen.
    """
    scale = np.ones(6) if index == "cond" else SIGMAS
    base_jacobian = BaseJacobian(study_chain(nominal), scale)
    table = TableOne(lwr4plus.nominal_chain(), lwr4plus.station(nominal), lwr4plus.tool(nominal))
    constraint = PoseConstraint("Table 1", table, table.gradient)
    return SearchSpace(base_jacobian, -LIMITS, LIMITS, base_jacobian.product, (constraint,))


def feasible_poses(space: SearchSpace, count: int, seed: list[int]) -> np.ndarray:
    """Return random poses (count, 7) that keep Table 1."""

    def feasible(q: np.ndarray) -> np.ndarray:
        return is_feasible(space, q)

    return draw_candidates(space.lower, space.upper, count, feasible, seed=seed)


@dataclass(frozen=True)
class Trial:
    """One search for 17 poses.

    Attributes:
        index: index of the poses.
        method: method of the search.
        seed: seed of candidates and search.
        seconds: processor time [s].
        count: number of candidates.
    """

    index: Index
    method: Method
    seed: int
    seconds: float
    count: int


def run_trial(trial: Trial) -> Selection:
    """Run a trial; local, multistart and tabu start at random, detmax and polish from the relaxation."""
    nominal, _ = lwr4plus.table_2()
    space = search_space(nominal, trial.index)
    candidates = feasible_poses(space, trial.count, [trial.seed, 3])
    # kicks raise O1 alone
    kicks = SearchSettings.kicks
    if trial.index == "O1" and trial.method == "detmax":
        kicks = 1000
    settings = SearchSettings(
        trial.index,
        trial.method,
        seed=trial.seed,
        starts=1000,
        kicks=kicks,
        rule=TabuRule(patience=1000.0),
        seconds=trial.seconds,
    )
    return select_poses(None, lwr4plus.POSES, settings, q=candidates, space=space)


def comparison(
    extent: Extent, seed: int, seeds: int, seconds: float, workers: int
) -> tuple[list[Metrics], list[Selection]]:
    """Choose 17 poses by every method for every index in equal processor time; rows, and the sets chosen by O1.

    Args:
        extent: indices, methods and number of candidates.
        seed: the first seed.
        seeds: number of seeds of each search.
        seconds: processor time of a search [s].
        workers: number of processes.
    """
    trials = []
    for index, method, k in itertools.product(extent.indices, extent.methods, range(seeds)):
        trials.append(Trial(index, method, seed + k, seconds, extent.candidates))
    selections: dict[tuple[Index, Method], list[Selection]] = {}
    with ProcessPoolExecutor(workers) as pool:
        for trial, selection in zip(trials, pool.map(run_trial, trials), strict=True):
            label = f"{trial.index} by {trial.method}, seed {trial.seed}"
            print(f"{label}: {selection.value:.5g}", file=sys.stderr, flush=True)
            selections.setdefault((trial.index, trial.method), []).append(selection)
    rows, by_o1 = [], []
    for (index, method), runs in selections.items():
        rows.append({"index": index, "method": method, **selection_metrics(index, runs), "processor_seconds": seconds})
        if index == "O1":
            by_o1 += runs
    return rows, by_o1


def selection_metrics(index: Index, runs: Sequence[Selection]) -> Metrics:
    """Return median, worst and best of an index over seeds, beside the best of random sets."""
    values = [run.value for run in runs]
    median = float(np.median(values))
    best_random = float(np.median([run.random_baseline for run in runs]))
    # of the condition number the smallest is the best
    if index == "cond":
        best, worst = min(values), max(values)
        gain = best_random / median
    else:
        best, worst = max(values), min(values)
        gain = median / best_random
    return {
        "median": median,
        "worst": worst,
        "best": best,
        "best_of_1000_random": best_random,
        "gain_over_random": gain,
        "evaluations": float(np.median([run.evaluations for run in runs])),
        "seeds": len(runs),
    }


def ceiling(nominal: np.ndarray, candidates: np.ndarray, selections: list[Selection], climbs: int) -> Metrics:
    """Return the upper bound of O1 over all sets of 17 poses under Table 1, and the share that the best set reaches.

    Args:
        nominal: (9, 4) nominal column of Table 2.
        candidates: (m, 7) poses that the bound starts from, beside those of the selections.
        selections: sets chosen by O1.
        climbs: number of searches in the bound.
    """
    selected = [selection.q for selection in selections if selection.q is not None]
    poses = np.concatenate([candidates, *selected])
    bound = bound_over_space(search_space(nominal, "O1"), poses, lwr4plus.POSES, climbs=climbs, rounds=40)
    largest = float(np.sqrt(bound.upper / lwr4plus.POSES))
    best = max(selection.value for selection in selections)
    share = (best / largest) ** 2
    return {"O1": largest, "climbs": bound.climbs, "loose_by": bound.gap, "best_share_of_det": share}


def study_fit(start: Chain, measured: Positions, damping: float = 1e-4, weighted: bool = False) -> GeometricFit:
    """Fit the paper's 32 parameters, from the nominal column; damping 0 is eq. 11, above it eq. 12.

    Theirs are not weighted: a metre counts as a radian, and one σ is taken from all residuals.

    Args:
        start: chain of the nominal column.
        measured: the measured poses.
        damping: damping of the steps.
        weighted: whether the stated σ are used.
    """
    installation = Installation(start, station_names=(measured.station,), tool_names=measured.tool_names)
    if not weighted:
        measured = replace(measured, sigma=None, sigma_rotation=None)
    blocks = prepare(installation, [measured])
    return fit_with_prior(installation, blocks, base_columns(start), settings=Settings(damping=damping))


def calibration(seed: int) -> tuple[Selection, Positions, GeometricFit]:
    """Choose 17 poses by cond, measure them on the simulated arm, and fit."""
    nominal, _ = lwr4plus.table_2()
    # until the search ends by itself: the same poses every time
    selection = run_trial(Trial("cond", "local", seed, np.inf, 2000))
    measured = measure(lwr4plus_cell(), np.asarray(selection.q), [seed, 1], "fit")
    return selection, measured, study_fit(study_chain(nominal), measured)


def fitted_arm(seed: int) -> Chain:
    """Return the arm fitted by `calibration`: the library's, with frames 2 to 7 as fitted."""
    _, _, result = calibration(seed)
    chain = result.cell.chain
    values = dict(zip(chain.names, chain.values))
    table = np.empty((9, len(lwr4plus.COLUMNS)))
    for row in range(9):
        table[row] = [values[f"{name}{row}"] for name in lwr4plus.COLUMNS]
    return lwr4plus.arm(table)


def nominal_readings(nominal: np.ndarray, result: GeometricFit, measured: Positions) -> dict[str, Installation]:
    """Return what Table 3's row 'nominal' may mean: the paper does not say whose frames 0, 1 and 8 it uses.

    Args:
        nominal: (9, 4) nominal column of Table 2.
        result: the fit.
        measured: the fitted poses, by which frames of the nominal arm are placed.
    """
    start = result.start
    calibrated = result.cell.chain
    calibrated_values = dict(zip(calibrated.names, calibrated.values))
    outer_frames = {name: value for name, value in calibrated_values.items() if name[-1] in "018"}
    station, tool = lwr4plus.station(nominal), lwr4plus.tool(nominal)
    placed = Installation(lwr4plus.arm(nominal), station[None], tool[None], start.station_names, start.tool_names)
    return {
        "full nominal column": start,
        "nominal frames 2-7, calibrated frames 0, 1, 8": replace(start, chain=start.chain.with_values(outer_frames)),
        "nominal arm, station and tool fitted": polish_frames(placed, [measured]).cell,
    }


def parameter_rows(result: GeometricFit, nominal: np.ndarray, truth: np.ndarray) -> list[Metrics]:
    """Return the 32 estimates next to both columns (9, 4) of Table 2."""
    nominal_chain, true_chain = study_chain(nominal), study_chain(truth)
    nominal_values = dict(zip(nominal_chain.names, nominal_chain.values))
    true_values = dict(zip(true_chain.names, true_chain.values))
    estimate = result.estimate
    rows = []
    for name, unit, value, sigma in zip(estimate.names, estimate.units, estimate.values, estimate.sigma):
        row = {
            "name": name,
            "unit": unit,
            "nominal": nominal_values[name],
            "table_2": true_values[name],
            "estimate": float(value),
            "sigma": float(sigma),
            "off_by_sigmas": float((value - true_values[name]) / sigma),
        }
        rows.append(row)
    return rows


def within_two_sigma(rows: list[Metrics]) -> int:
    """Return the number of estimates within two σ of Table 2."""
    return sum(abs(row["off_by_sigmas"]) <= 2.0 for row in rows)


def rigid_counts(poses: np.ndarray, seed: int) -> dict[str, float]:
    """Return how many of the 32 estimates lie within two σ of a rigid truth, mean over draws of the noise.

    Args:
        poses: (17, 7) the chosen poses.
        seed: seed of the noise.
    """
    nominal, truth = lwr4plus.table_2()
    start = study_chain(nominal)
    cell = rigid(lwr4plus_cell())
    draws = [measure(cell, poses, [seed, 10 + k]) for k in range(DRAWS)]
    counts = {}
    for name, weighted in (("unweighted", False), ("weighted", True)):
        results = [study_fit(start, measured, weighted=weighted) for measured in draws]
        within = [within_two_sigma(parameter_rows(result, nominal, truth)) for result in results]
        counts[name] = float(np.mean(within))
    return counts


def run(seed: int, quick: bool, seeds: int = 3, seconds: float = 3.0, workers: int = 2) -> Metrics:
    """Run the study; return the content of ``metrics.json``.

    Args:
        seed: seed of everything random.
        quick: whether few methods and poses are taken.
        seeds: seeds of each way of choosing poses; 0: none is compared.
        seconds: processor time for each search [s].
        workers: number of processes.
    """
    extent = QUICK if quick else Extent()
    nominal, truth = lwr4plus.table_2()
    selection, measured, result = calibration(seed)
    poses = np.asarray(selection.q)
    unseen = feasible_poses(search_space(nominal, "cond"), extent.unseen, [seed, 7])
    validation = measure(lwr4plus_cell(), unseen, [seed, 2], "validation")
    rows = parameter_rows(result, nominal, truth)
    # eq. 11, without damping
    undamped = study_fit(study_chain(nominal), measured, damping=0.0)
    differences = np.abs(parameter_values(result.cell) - parameter_values(undamped.cell))
    differences_in_sigma = differences[result.free] / result.estimate.sigma
    compared: Metrics = {}
    if seeds:
        table, selections = comparison(extent, seed, 1 if quick else seeds, seconds, workers)
        compared = {"selection": table, "ceiling": ceiling(nominal, unseen, selections, extent.climbs)}
    readings = nominal_readings(nominal, result, measured)
    table_3 = {
        "paper": lwr4plus.TABLE_3,
        "nominal": {name: error_summary(reading, validation) for name, reading in readings.items()},
        "calibrated, unseen poses": error_summary(result.cell, validation),
        "calibrated, the 17 fitted poses": error_summary(result.cell, measured),
        "unseen_poses": len(unseen),
        "remark": "the paper does not say whose frames its nominal row uses, nor on which poses its rows rest",
    }
    table_2 = {
        "parameters": rows,
        "within_2_sigma": within_two_sigma(rows),
        "within_2_sigma_rigid_truth": rigid_counts(poses, seed),
        "remark": f"rigid truth: means of {DRAWS} draws of the noise. The hidden deflection leaves no white noise, "
        "so that fewer than 95 % are to be expected; with a rigid truth and weights the covariance has to hold",
    }
    return {
        "seed": seed,
        "poses": len(poses),
        "selected_by": f"cond, {selection.method}",
        "parameters": len(result.free),
        "condition_number": {
            "ours_m_rad": selection.value,
            "paper": lwr4plus.CONDITION,
            "remark": "the paper states no units; in m and rad every random feasible set lies below 11.19, so that "
            "number is not aimed at",
        },
        "table_3": table_3,
        "table_2": table_2,
        "eq_11_against_eq_12": {"largest_difference_in_sigmas": float(differences_in_sigma.max())},
        "rank": ranks(nominal, truth),
        **compared,
        "random_sets": random_sets(nominal, unseen, seed, extent),
        "base_leds": base_leds(poses, seed),
    }


def error_summary(installation: Installation, measured: Positions) -> Metrics:
    """Return mean and largest errors of positions [mm] and orientations [deg]."""
    return asdict(errors(installation, [measured]).summary())


def ranks(nominal: np.ndarray, truth: np.ndarray) -> dict[str, dict[str, int]]:
    """Return the rank of all 36 columns over 500 poses, for three tools and two tolerances.

    Args:
        nominal, truth: (9, 4) columns of Table 2.
    """
    straight_tool = nominal.copy()
    straight_tool[8, :2] = 0.0
    tables = {"alpha8 = d8 = 0": straight_tool, "nominal": nominal, "calibrated": truth}
    q = np.random.default_rng(0).uniform(-LIMITS, LIMITS, (500, 7))
    ranks_of = {}
    for name, table in tables.items():
        matrix = jacobian(study_chain(table), q).reshape(-1, 36)
        values = np.linalg.svd(matrix / np.linalg.norm(matrix, axis=0), compute_uv=False)
        ranks_of[name] = {f"above {t:g}": int((values > t * values[0]).sum()) for t in TOLERANCES}
    return ranks_of


def random_sets(nominal: np.ndarray, candidates: np.ndarray, seed: int, extent: Extent) -> dict[str, float]:
    """Return cond of single random sets, in m and rad: best of 1000, median and worst of 200.

    Args:
        nominal: (9, 4) nominal column of Table 2.
        candidates: (m, 7) poses.
        seed: seed of the sets.
        extent: numbers of sets.
    """
    jacobians = search_space(nominal, "cond").jacobian(candidates)
    rng = np.random.default_rng(seed)
    values = []
    for _ in range(extent.random_sets):
        index = rng.choice(len(jacobians), lwr4plus.POSES, replace=False)
        values.append(observability(jacobians[index], "cond"))
    best = random_baseline(jacobians, lwr4plus.POSES, "cond", seed=seed, sets=extent.best_of)
    return {"best": best, "median": float(np.median(values)), "worst": float(max(values))}


def base_leds(poses: np.ndarray, seed: int) -> dict[str, float]:
    """Return what measuring the base's LEDs beside the tool's costs on a rigid truth: true rms error, unseen [mm].

    Without them the camera must not move between the series; with them it may, and both frames' noises count.

    Args:
        poses: (17, 7) poses to fit.
        seed: seed of the noise.
    """
    tool_only = lwr4plus_cell(calib.SimulatedInstrument(base_frame=None), hidden=0.0)
    with_base = lwr4plus_cell(calib.SimulatedInstrument(base_frame=np.eye(4)), hidden=0.0)
    # the frame in which positions are compared: the camera's, or the base's
    T_base_camera = invert(with_base.truth.stations[0])
    return {
        "tool only": _true_error_mm(tool_only, np.eye(4), poses, seed),
        "tool and base": _true_error_mm(with_base, T_base_camera, poses, seed),
    }


def _true_error_mm(cell: Cell, T_frame_camera: np.ndarray, poses: np.ndarray, seed: int) -> float:
    """Return the true rms position error [mm] at 500 unseen poses, of a fit to measured poses.

    Args:
        cell: the simulated arm and its instrument.
        T_frame_camera: (4, 4) frame of the fitted installation.
        poses: (17, 7) poses to fit.
        seed: seed of the noise.
    """
    measured = measure(cell, poses, [seed, 3])
    start = polish_frames(install(cell.nominal, [measured]), [measured]).cell
    result = fit(start, [measured])
    q = random_joints(lwr4plus.nominal_chain(), 500, 99)
    predicted = see(result.cell, q).poses()[:, :3, 3]
    true = (T_frame_camera @ true_poses(cell, q))[:, :3, 3]
    squared = np.sum((predicted - true) ** 2, axis=1)
    return float(1e3 * np.sqrt(np.mean(squared)))


def main() -> None:
    """Run the study from the command line."""
    arguments = study_options.read(
        __doc__,
        quick="one method, fewer poses: to see that it runs",
        seeds=(3, "of each way of choosing poses; 0: none is compared"),
        seconds=(3.0, "of processor time for each search"),
        workers=(2, "local processes"),
    )
    metrics = run(arguments.seed, arguments.quick, arguments.seeds, arguments.seconds, arguments.workers)
    files.write_json(arguments.out / "metrics.json", metrics)
    study_tables.show(study_tables.geometry(metrics))
    print(f"\nwritten to {arguments.out / 'metrics.json'}")


if __name__ == "__main__":
    main()
