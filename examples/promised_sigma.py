"""How the σ that `calib excite --after` predicts for a further motion compare with those reached.

CALIB_DATA=... python examples/promised_sigma.py [--every N | --simulated] [--anew] [--csv FILE] [ROBOT ...]

Recordings of a robot are identified, and another one is taken for the further motion. Its σ are predicted by what
`calib excite --after` calls; then all of them are identified together, as `calib identify --after` does, or with
friction terms and priors chosen anew (--anew). The first table has a row per robot; robots
without data are skipped. The second table says what the rest is due to: the same with the torque errors reached in
place of those predicted, and the ceiling, i.e. a prediction that misses by nothing but the sampling of the reached σ.
"""

from __future__ import annotations

import argparse
import csv
import os
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import numpy as np
from scipy.interpolate import make_interp_spline

import calib
from calib.api.dynamic import DynamicsModel
from calib.estimation.whiteness import inflation
from calib.identification.identify_options import parse_options
from calib.identification.prior import MAX_INFLATION
from calib.procedure.dynamic_stage.metrics import on_bounds
from calib.procedure.excitation.inputs import ExcitationInputs, read_inputs
from calib.procedure.excitation.prediction import REACHED, PredictedSigma, foretell
from calib.procedure.excitation.settings import ExcitationSettings

FOLDERS = tempfile.TemporaryDirectory()
DATA = Path(os.environ.get("CALIB_DATA", "../shared/data"))
WITHIN = 0.3  # a σ predicted well is within this share of the one reached
RANGE = (0.1, 0.9)  # quantiles of σ reached over σ predicted
DEGREE = 5  # of the spline through a recording's positions
RESAMPLINGS = 40  # of the torque errors, for the ceiling
BLOCKS = 6.0  # length of their blocks, in integrated autocorrelations
MIN_BLOCK = 20  # and in samples, at least
SIMULATED_SECONDS, SIMULATION_SEED = 10.0, 5
WRIST = {"coupling": [{"joints": [5, 6], "label": "6"}]}


class Pair(NamedTuple):
    """Earlier recordings, and a further one, by their names in the robot's folder, with cuts [s]."""

    earlier: tuple[str, ...]
    further: str


class Ratio(NamedTuple):
    """σ of a parameter in a pair of recordings.

    Attributes:
        robot, pair, parameter: names.
        several: whether there were several earlier recordings.
        before, predicted, reached: σ so far, predicted with the further motion, and reached.
        with_errors: predicted with the torque errors reached.
        ceiling: share of the resampled σ reached that are within `WITHIN` of their median.
    """

    robot: str
    pair: str
    parameter: str
    several: bool
    before: float
    predicted: float
    reached: float
    with_errors: float
    ceiling: float


@dataclass(frozen=True)
class Robot:
    """A robot's folder, the options of its identification, and its pairs of recordings."""

    folder: str
    pairs: tuple[Pair, ...]
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def urdf(self) -> Path:
        return DATA / self.folder / "model.urdf"


def parts(file: str, start: float, end: float, count: int) -> list[str]:
    """Return `count` cuts of equal duration of a recording between two times [s]."""
    edges = np.linspace(start, end, count + 1)
    return [f"{file}@{first:.4g}:{last:.4g}" for first, last in pairwise(edges)]


def each_to_next(recordings: Sequence[str]) -> tuple[Pair, ...]:
    """Return each recording with the next one as the further motion, the last one with the first."""
    following = [*recordings[1:], recordings[0]]
    return tuple(Pair((earlier,), further) for earlier, further in zip(recordings, following))


def growing(recordings: Sequence[str]) -> tuple[Pair, ...]:
    """Return the first two recordings with the third as the further motion, the first three with the fourth, …"""
    return tuple(Pair(tuple(recordings[:count]), recordings[count]) for count in range(2, len(recordings)))


def halves_to_quarters(file: str, start: float, end: float) -> tuple[Pair, ...]:
    """Return pairs of the halves, thirds and quarters of a recording between two times [s]."""
    pairs: list[Pair] = []
    for count in (2, 3, 4):
        pairs += each_to_next(parts(file, start, end, count))
    return tuple(pairs)


UR10E_LOGS = (
    "05-20sec_8harm",
    "05-20sec_12harm",
    "06-20sec_10harm",
    "06-20sec_5harm",
    "10-20sec_7harm",
    "10-30sec_12harm",
    "19_14harm50sec",
)
UR10E = [f"ur-20_02_{name}.npz" for name in UR10E_LOGS]
UR10E_GAINS = {"gains": [14.87, 13.26, 11.13, 10.62, 11.03, 11.47]}  # [N m/A], by their authors
PANDA = ("traj1_first60pct.npz", 0.0, 12.5)
TX40 = ("tx40_first_5p4s.npz", 0.0, 5.4)
TIAGO = ("dynamic.npz", 9.0, 67.0)
LWR = ("measurements_1.npz", 2.5, 22.5)
KR300 = ["traj_A.npz", "traj_B.npz"]
KR300_HALVES = [*parts(KR300[0], 0, 10, 2), *parts(KR300[1], 0, 10, 2)]
ROBOTS = {
    "Panda": Robot("franka_panda_inria", (*halves_to_quarters(*PANDA), *growing(parts(*PANDA, 4)))),
    "UR10e": Robot("ur10e_innopolis", (*each_to_next(UR10E), *growing(UR10E)), UR10E_GAINS),
    "TX40": Robot("staubli_tx40", (*halves_to_quarters(*TX40), *growing(parts(*TX40, 3))), WRIST),
    "TIAGo": Robot("tiago_laas", (*halves_to_quarters(*TIAGO), *growing(parts(*TIAGO, 3)))),
    "KR300": Robot("kuka_kr300_tuk", (*each_to_next(KR300), *each_to_next(KR300_HALVES), *growing(KR300_HALVES))),
    "LWR4+": Robot("kuka_lwr4plus_iit", (*each_to_next(parts(*LWR, 2)), *each_to_next(parts(*LWR, 4)))),
}


def simulated(parent: Path) -> dict[str, Robot]:
    """Write recordings of two arms, simulated by Pinocchio, and return the robots by their names."""
    import extrapolation_simulated as simulation  # Pinocchio is a dependency of this alone

    robots = {}
    for name, arm, behind in (("simulated LWR4+", "lwr4plus", True), ("simulated TX40", "tx40", False)):
        folder = parent / arm
        folder.mkdir()
        described = simulation.arm(arm)
        simulation.write_urdf(described, described.inertias, folder / "model.urdf")
        wrong = simulation.wrong(described.inertias, SIMULATION_SEED)
        true = simulation.write_urdf(described, wrong, folder / "true.urdf")
        logs = [f"log_{number}.npz" for number in range(3)]
        for number, log in enumerate(logs):
            seed = 2 * SIMULATION_SEED + number
            q = simulation.fourier(described, SIMULATED_SECONDS, seed)
            simulation.record(
                described,
                true,
                q,
                folder / log,
                seed=seed,
                arm_seed=SIMULATION_SEED,
                family="stribeck",
                behind=behind,
                coupled=not behind,
            )
        options = {} if behind else WRIST
        robots[name] = Robot(str(folder), (*each_to_next(logs), *growing(logs)), options)
    return robots


class RecordedMotion:
    """A recording's motion in the place of a designed one: the spline through its filtered positions."""

    def __init__(self, model: DynamicsModel):
        motion = model.inputs.cases[-1].motion
        self._path = make_interp_spline(motion.t - motion.t[0], motion.q, DEGREE)
        self.period = float(motion.t[-1] - motion.t[0])

    def evaluate(self, x: np.ndarray, times: np.ndarray, order: int) -> np.ndarray:
        """Return the derivative of an order (N, n) at times (N,) [s]; a recording has no variables x."""
        return self._path(times, order)


@dataclass(frozen=True)
class KnownErrors:
    """Torque errors as they are reached: the factor (rows,) of their density, whatever the band."""

    density: np.ndarray
    seconds: float = np.inf  # so that no recording adds others

    def factor(self, rows_per_second: float) -> np.ndarray:
        """Return the factor (rows,) of the density."""
        return self.density


@cache
def identified(robot: str, recordings: tuple[str, ...]) -> DynamicsModel:
    """Return the identification of a robot from recordings."""
    return identified_after(robot, recordings, None)


def identified_after(robot: str, recordings: tuple[str, ...], after: Path | None) -> DynamicsModel:
    """Return the identification of a robot from recordings, which carries on an earlier one; None: none."""
    files = [str(DATA / ROBOTS[robot].folder / name) for name in recordings]
    options = parse_options(ROBOTS[robot].options)
    return calib.identify_dynamics(ROBOTS[robot].urdf, files, options=options, after=after)


def identified_together(robot: str, pair: Pair, anew: bool) -> DynamicsModel:
    """Return the identification from all recordings of a pair; `anew`: with friction and prior chosen from nothing."""
    recordings = (*pair.earlier, pair.further)
    if anew:
        return identified(robot, recordings)
    return identified_after(robot, recordings, stored(robot, pair.earlier))


@cache
def stored(robot: str, recordings: tuple[str, ...]) -> Path:
    """Return the folder of an identification, which lasts as long as the program."""
    return identified(robot, recordings).save(Path(tempfile.mkdtemp(dir=FOLDERS.name)) / "identified", plots=False)


@cache
def design_inputs(robot: str, earlier: tuple[str, ...]) -> ExcitationInputs:
    """Return the inputs of a design after the identification of earlier recordings."""
    return read_inputs(ROBOTS[robot].urdf, ExcitationSettings(outlook=False), after=stored(robot, earlier))


def predicted(inputs: ExcitationInputs, family: RecordedMotion) -> Sequence[PredictedSigma]:
    """Return the σ that are predicted for a motion."""
    motion = SimpleNamespace(x=np.zeros(0), factor=1.0, interrupted=False)
    problem = SimpleNamespace(family=family)
    settings = ExcitationSettings(outlook=False)
    return foretell(inputs, settings, cast(Any, problem), cast(Any, motion), cast(Any, None))[1]


def ratios(robot: str, pair: Pair, anew: bool) -> Iterator[Ratio]:
    """Yield the σ of all parameters that are predicted for a pair of recordings, and identified from both."""
    inputs = design_inputs(robot, pair.earlier)
    together = identified_together(robot, pair, anew)
    family = RecordedMotion(together)
    assert inputs.prior is not None and inputs.prior.sigmas is not None
    density = np.array(together.to_dict()["error_density"]) / inputs.prior.sigmas**2
    prior = replace(inputs.prior, growth=None, bands=cast(Any, KnownErrors(density)))
    with_errors = predicted(replace(inputs, prior=prior), family)

    positions = {name: position for position, name in enumerate(together.found.names)}
    ceilings = ceiling(together)
    bounded = on_bounds(together.found)
    label = f"{' + '.join(pair.earlier)} → {pair.further}"
    for row, row_with_errors in zip(predicted(inputs, family), with_errors):
        # a parameter on its bound has no σ of its own
        if row.name not in positions or row.name in bounded or not row.sigma_before:
            continue
        position = positions[row.name]
        yield Ratio(
            robot,
            label,
            row.name,
            several=len(pair.earlier) > 1,
            before=row.sigma_before,
            predicted=row.sigma,
            reached=float(together.estimate.sigma[position]),
            with_errors=row_with_errors.sigma,
            ceiling=ceilings[position],
        )


def ceiling(model: DynamicsModel) -> np.ndarray:
    """Return the share (p,) of resampled σ within `WITHIN` of their median.

    The errors of every recording and torque row are resampled by blocks, and their density is estimated anew. A
    parameter's σ follows to first order by the torque rows' shares of its variance.
    """
    fitted, stream = model.found.fitted, np.random.default_rng(0)
    values, covariance = fitted.estimate.values, fitted.estimate.covariance
    row_count = len(fitted.std)
    logarithms = np.zeros((RESAMPLINGS, row_count))
    for row in range(row_count):
        series = []
        for rows in model.found.rows:
            moves = rows.standing[:, row] == 0.0
            errors = rows.target[moves, row] - rows.matrix[moves, row] @ values
            if len(errors) >= MIN_BLOCK:
                series.append(errors)
        if series:
            logarithms[:, row] = [np.log(density(series, stream)) for _ in range(RESAMPLINGS)]
    logarithms -= np.median(logarithms, axis=0)
    by_row = np.sum((fitted.pooled.factors[:, :, :-1] @ covariance) ** 2, axis=1)
    by_row /= (fitted.std**2 * fitted.inflation)[:, None]
    shares = by_row / np.maximum(np.diag(covariance), 1e-300)
    resampled = np.exp(0.5 * logarithms @ shares)
    return np.mean(within(resampled), axis=0)


def density(series: Sequence[np.ndarray], stream: np.random.Generator) -> float:
    """Return the density of resampled errors of recordings (N_i,), up to a factor, as identifications estimate it."""
    squares = inflated = 0.0
    for errors in series:
        length = max(MIN_BLOCK, round(BLOCKS * min(inflation(errors), MAX_INFLATION)))
        starts = stream.integers(0, len(errors), -(-len(errors) // length))
        index = (starts[:, None] + np.arange(length)).ravel()[: len(errors)]
        drawn = errors[index % len(errors)]
        squares += np.sum(drawn**2)
        inflated += len(drawn) * inflation(drawn)
    count = sum(map(len, series))
    return squares * min(inflated / count, MAX_INFLATION) + 1e-300


def share(mask: np.ndarray) -> str:
    """Return the share of a mask in percent; a dash if it is empty."""
    return f"{100.0 * np.mean(mask):.0f} %" if len(mask) else "–"


def within(ratio: np.ndarray) -> np.ndarray:
    """Return whether σ reached is within `WITHIN` of the predicted one (k,)."""
    return np.abs(ratio - 1.0) <= WITHIN


def spread(of_robots: Sequence[np.ndarray]) -> np.ndarray:
    """Return the `RANGE` of the ratios of robots, each of which counts alike."""
    values = np.concatenate(of_robots)
    weights = np.concatenate([np.full(len(ratio), 1.0 / len(ratio)) for ratio in of_robots])
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order]) / weights.sum()
    return values[order][np.searchsorted(cumulative, RANGE)]


def ratio_line(robot: str, rows: Sequence[Ratio]) -> str:
    """Return a robot's row of the first table."""
    ratio = np.array([row.reached / row.predicted for row in rows])
    several = np.array([row.several for row in rows])
    pairs = {row.pair for row in rows}
    low, high = np.quantile(ratio, RANGE)
    in_stated_range = (ratio >= REACHED[0]) & (ratio <= REACHED[1])
    cells = (
        robot,
        str(len(pairs)),
        str(len(ratio)),
        f"{np.median(ratio):.2f}",
        share(within(ratio)),
        share(within(ratio[~several])),
        share(within(ratio[several])),
        f"{low:.2f}–{high:.2f}",
        share(in_stated_range),
    )
    return f"| {' | '.join(cells)} |"


def residue_line(robot: str, rows: Sequence[Ratio], other_ratios: Sequence[np.ndarray]) -> str:
    """Return a robot's row of the second table.

    Args:
        robot: its name.
        rows: its parameters.
        other_ratios: ratios of the other robots, whose range is held against this one.
    """
    ratio = np.array([row.reached / row.predicted for row in rows])
    ratio_with_errors = np.array([row.reached / row.with_errors for row in rows])
    cover = ""
    if other_ratios:
        low, high = spread(other_ratios)
        cover = f"{low:.2f}–{high:.2f}: {share((ratio >= low) & (ratio <= high))}"
    highest = 100.0 * np.mean([row.ceiling for row in rows])
    return f"| {robot} | {share(within(ratio))} | {share(within(ratio_with_errors))} | {highest:.0f} % | {cover} |"


def print_tables(robots: Sequence[str], step: int, anew: bool) -> list[Ratio]:
    """Print both tables, a robot's row as soon as it is made, and return what they are made of.

    Args:
        robots: names of the robots.
        step: 1 for all pairs of a robot, 2 for every second one, …
        anew: whether friction and prior are chosen anew from all recordings.
    """
    header = "robot | pairs | parameters | median | within 30 % | after one recording | after several | 10–90 %"
    print(f"| {header} | within {REACHED[0]:g}–{REACHED[1]:g} |\n|{9 * '---|'}", flush=True)
    rows_of_robots: dict[str, list[Ratio]] = {}
    for name in robots:
        robot = ROBOTS[name]
        if not robot.urdf.exists():
            print(f"{name} is skipped: no {robot.urdf}", flush=True)
            continue
        rows_of_robots[name] = [row for pair in robot.pairs[::step] for row in ratios(name, pair, anew)]
        print(ratio_line(name, rows_of_robots[name]), flush=True)

    print("\n| robot | within 30 % | with the torque errors reached | ceiling | 10–90 % of the others: holds |")
    print(f"|{5 * '---|'}")
    ratio_of_robots = {}
    for name, rows in rows_of_robots.items():
        ratio_of_robots[name] = np.array([row.reached / row.predicted for row in rows])
    for name, rows in rows_of_robots.items():
        other_ratios = [ratio for peer, ratio in ratio_of_robots.items() if peer != name]
        print(residue_line(name, rows, other_ratios))
    if len(ratio_of_robots) > 1:
        low, high = spread(list(ratio_of_robots.values()))
        print(f"\n10–90 % of all robots, which count alike: {low:.2f}–{high:.2f}")
    return [row for rows in rows_of_robots.values() for row in rows]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="*", help="names of robots; all without any")
    parser.add_argument(
        "--every", dest="step", type=int, default=1, help="2: every second pair of a robot; 100: the first"
    )
    parser.add_argument("--simulated", action="store_true", help="two simulated arms in place of the real robots")
    parser.add_argument("--anew", action="store_true", help="friction and prior are chosen anew from all recordings")
    parser.add_argument("--csv", help="file for the σ of every parameter")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        names = arguments.robots or list(ROBOTS)
        if arguments.simulated:
            arms = simulated(Path(folder))
            ROBOTS.update(arms)
            names = list(arms)
        rows = print_tables(names, arguments.step, arguments.anew)
    if arguments.csv:
        with Path(arguments.csv).open("w", newline="") as file:
            csv.writer(file).writerows([Ratio._fields, *rows])


if __name__ == "__main__":
    main()
