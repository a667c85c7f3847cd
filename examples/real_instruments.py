"""Instrumental variables on real recordings, with a reference that is fitted to the positions: a table in Markdown.

    CALIB_DATA=... python examples/real_instruments.py [ROBOT ...] [--published gen_params.txt]

The open recordings hold no reference, but their motions were designed as Fourier series. A series with their number of
harmonics is fitted to the positions, base frequency included, and serves

* as instruments itself, Z = W(q_s, v_s, a_s): no controller is needed;
* as the reference of a simulated loop (methods iv, didim, pc-iv), under a PD of 5 Hz on the estimated inertia, for the
  robots' own controllers are not known.

It assumes that the robot was asked for such a series, and that noise is no function of time that the next run would
repeat. The robot's lag is in the fit: the series is the motion, not the command, so that it tells no controller.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import fminbound

import calib
from calib.data.signals.motion import Motion
from calib.dynamics.base import Base
from calib.estimation.linear import settled_std, wls
from calib.estimation.whiteness import inflation
from calib.identification.closed_loop import instrumental_variables as instruments
from calib.identification.identify import Identification, identify
from calib.identification.identify_options import IdentifyOptions, parse_options
from calib.identification.rows import Case, ObservationRows, observe
from calib.procedure.dynamic_stage import inputs as recordings
from calib.records import frozen
from calib.trajectories.basis import SampledMotion
from calib.trajectories.fourier import fourier_family

DATA = Path(os.environ.get("CALIB_DATA", "../shared/data"))
UR10E = {"gains": [14.87, 13.26, 11.13, 10.62, 11.03, 11.47]}
SENSOR = {"rows": "link", "recording": {"names": {"tau_link": "tau"}}}
PD = {"controller": "pd", "kp": 987.0, "kd": 44.0, "design": 1.0, "rate": 1000.0, "timing": "stated"}
LOOP_METHODS = ("iv", "didim", "pc-iv")


@dataclass(frozen=True)
class Row:
    """A recording to learn from, another motion of the same robot, and the series: its period [s] and harmonics."""

    name: str
    folder: str
    train: str
    unseen: str
    period: float
    harmonics: int
    options: dict[str, Any]


UR10E_12 = "ur-20_02_10-30sec_12harm.npz"
UR10E_14 = "ur-20_02_19_14harm50sec.npz"
PANDA = "traj1_first60pct.npz"
ROWS = (
    Row("Panda", "franka_panda_inria", f"{PANDA}@1.2:9.387", f"{PANDA}@9.387:11.9", 2.0 / 0.15, 5, SENSOR),
    Row("UR10e, 30 s", "ur10e_innopolis", f"{UR10E_12}@7:36.8", UR10E_14, 30.3, 12, UR10E),
    Row("UR10e, 30 s", "ur10e_innopolis", f"{UR10E_12}@7:36.8", UR10E_14, 30.3, 60, UR10E),
    Row("UR10e, 50 s", "ur10e_innopolis", f"{UR10E_14}@2.2:51.9", UR10E_12, 50.3, 14, UR10E),
    Row("UR10e, 50 s", "ur10e_innopolis", f"{UR10E_14}@2.2:51.9", UR10E_12, 50.3, 60, UR10E),
    Row("KR300, A", "kuka_kr300_tuk", "traj_A.npz", "traj_B.npz", 10.0, 20, {}),
    Row("KR300, B", "kuka_kr300_tuk", "traj_B.npz", "traj_A.npz", 10.0, 20, {}),
)
SAMPLES = 3000  # of a motion, about, by which its period is fitted


def nearest_series(motion: Motion, period: float, harmonics: int) -> tuple[SampledMotion, float]:
    """Return the Fourier series nearest to the positions of a motion, and its period [s], within 2 % of `period`."""
    times = motion.t - motion.t[0]
    all_samples = slice(None)
    decimated = slice(None, None, max(1, len(times) // SAMPLES))

    def series(period: float, part: slice) -> SampledMotion:
        basis = fourier_family(harmonics, period, motion.n, rest=False).basis(times[part])
        return basis.motion(basis.nearest(motion.q[part]))

    def squares(period: float) -> float:
        residual = series(period, decimated).q - motion.q[decimated]
        return float(np.sum(residual**2))

    fitted_period = minimum(squares, 0.98 * period, 1.02 * period)
    return series(fitted_period, all_samples), fitted_period


def minimum(function: Callable[[float], float], low: float, high: float) -> float:
    """Return where a function of one number is lowest."""
    return float(fminbound(function, low, high, xtol=1e-6))  # type: ignore[arg-type]


def settings(row: Row, method: str = "wls", **keys: Any) -> IdentifyOptions:
    """Return the options of an identification: base parameters, standard friction, no prior."""
    plain = {"friction": "standard", "prior": "none", "essential": "none"}
    return parse_options(plain | row.options | {"method": method} | keys)


def error(identification: Identification, values: np.ndarray, case: Case) -> float:
    """Return the torque error 100 ‖y - W x‖ / ‖y‖ of a case in the identification band [%]."""
    rows = observed(identification, case)
    residual = rows.target - rows.matrix @ values
    return float(100.0 * np.linalg.norm(residual[rows.present]) / np.linalg.norm(rows.target[rows.present]))


def error_cell(identification: Identification, values: np.ndarray | None, case: Case) -> str:
    """Return the error of an estimate as a cell; a dash where there is none."""
    if values is None:
        return "–"
    return f"{error(identification, values, case):.2f} %"


def observed(identification: Identification, case: Case) -> ObservationRows:
    """Return the filtered rows of a case for the base parameters of an identification."""
    return observe(identification.dynamics.model, identification.base.kept, case, case.motion.decimator)


def instrumented(base: Base, measured: ObservationRows, series: ObservationRows) -> instruments.Instruments:
    """Return the problem y = W x of measured rows with the rows of a series as instruments Z."""
    problem = instruments.unseen(base.names, base.units, measured.target.shape[1])
    for row, present in enumerate(measured.present.T):
        z = series.matrix[present, row]
        w = measured.matrix[present, row]
        y = measured.target[present, row]
        problem = instruments.instrument(z, w, y, row, before=problem)
    return problem


def series_estimate(identification: Identification, case: Case, series: SampledMotion) -> tuple[np.ndarray, str]:
    """Return the IV estimate (b,) with the series as instruments, and its tests as cells of the table."""
    series_motion = replace(case.motion, q=series.q, v=series.v, a=series.a)
    measured = observed(identification, case)
    problem = instrumented(identification.base, measured, observed(identification, replace(case, motion=series_motion)))
    data = problem.least_squares()
    least_squares = wls(data, settled_std(data, 1e-3))
    # residuals are correlated in time: their inflation τ widens σ and tests
    first = instruments.iv(problem, least_squares.group_std).estimate
    residual = measured.target - measured.matrix @ first.values
    tau = max(1.0, float(np.mean([inflation(column) for column in residual.T])))
    iv = instruments.iv(problem, least_squares.group_std, tau).estimate
    shift = np.abs(least_squares.estimate.values - iv.values) / iv.sigma
    strength = instruments.strength(problem, least_squares.group_std)
    test = instruments.exogeneity(problem, least_squares.group_std, tau)
    return iv.values, f"{strength.cragg_donald:.2g} | {test.p:.2f} | {shift.max():.2f} σ"


def estimate(row: Row, robot: Any, case: Case, method: str, **keys: Any) -> np.ndarray | None:
    """Return the estimate (b,) of a method; None where it failed, with the reason on the console."""
    try:
        return identify(robot, [case], settings(row, method, **keys).settings).fitted.estimate.values
    except calib.CalibError as problem:
        print(f"{row.name}: {method}: {problem}", file=sys.stderr)
        return None


def span(values: np.ndarray, digits: int) -> str:
    """Return the smallest and the largest value as a cell."""
    return f"{values.min():.{digits}g}–{values.max():.{digits}g}"


@dataclass(frozen=True, eq=False)
class SharedResults:
    """What the rows of a recording have in common.

    Attributes:
        robot: as `identify` takes it.
        case: the recording to learn from.
        unseen: another motion.
        plain: the identification by least squares.
        consistent: the estimate (b,) under physical constraints; None where it failed.
    """

    robot: Any
    case: Case
    unseen: Case
    plain: Identification
    consistent: np.ndarray | None


@lru_cache(maxsize=1)
def shared_results(train: str) -> SharedResults:
    """Return what all rows of a recording have in common."""
    row = next(row for row in ROWS if row.train == train)
    folder = DATA / row.folder
    train_files = [folder / row.train]
    unseen_files = [folder / row.unseen]
    inputs = recordings.gather(folder / "model.urdf", train_files, unseen_files, options=settings(row))
    (case,) = inputs.cases
    (unseen,) = inputs.unseen
    plain = identify(inputs.robot, [case], inputs.options.settings)
    return SharedResults(inputs.robot, case, unseen, plain, estimate(row, inputs.robot, case, "pc-wls"))


def study(row: Row) -> str:
    """Return a row of the table."""
    shared = shared_results(row.train)
    plain = shared.plain
    case = shared.case
    motion = case.motion
    series, period = nearest_series(motion, row.period, row.harmonics)
    distance = 1e3 * (motion.q - series.q).std(axis=0)
    noise = 1e3 * motion.cutoffs.noise
    acceleration_noise = motion.cutoffs.acceleration_noise(motion.cutoff, motion.rate)
    noise_share = 100.0 * acceleration_noise / motion.a.std(axis=0)
    series_values, tests = series_estimate(plain, case, series)
    estimates = [plain.fitted.estimate.values, shared.consistent, series_values]
    # the series as reference of a simulated loop
    with_reference = replace(case, motion=replace(motion, q_ref=frozen(series.q)))
    estimates += [estimate(row, shared.robot, with_reference, method, loop=PD) for method in LOOP_METHODS]
    cells = [
        row.name,
        f"{row.harmonics} of {period:.2f} s",
        span(distance, 2),
        span(noise, 1),
        f"{noise_share.max():.2g} %",
        tests,
    ]
    cells += [error_cell(plain, values, shared.unseen) for values in estimates]
    return f"| {' | '.join(cells)} |"


def published_distance(path: Path) -> str:
    """Return how far the Panda's fitted series is from the one that its authors published, at the fitted period.

    Args:
        path: gen_params.txt, (14, 5): cosines a and sines b of the velocities, of 0.15 π rad/s and its multiples.
    """
    row = ROWS[0]
    decimated = slice(None, None, 10)
    folder = DATA / row.folder
    inputs = recordings.gather(folder / "model.urdf", [folder / row.train], options=settings(row))
    motion = inputs.cases[0].motion
    series, period = nearest_series(motion, row.period, row.harmonics)
    k = np.arange(1, row.harmonics + 1)
    a, b = np.split(np.loadtxt(path) / (0.15 * np.pi * k), 2)

    def distance(delay: float) -> np.ndarray:
        angle = np.outer(motion.t[decimated] - delay, 2.0 * np.pi / period * k)
        difference = np.sin(angle) @ a.T - np.cos(angle) @ b.T - series.q[decimated]
        return 1e3 * difference.std(axis=0)

    def squares(delay: float) -> float:
        return float(np.sum(distance(delay) ** 2))

    delay = minimum(squares, 0.4, 0.6)
    low, high = distance(delay).min(), distance(delay).max()
    return f"published series {delay:.4f} s late: {low:.2g} to {high:.2g} mrad from the fitted one"


HEAD = (
    "| recording | harmonics | series off [mrad] | noise [mrad] | in a | Cragg-Donald | DWH p | shift | WLS | PC-WLS | "
    "IV by series | iv | didim | pc-iv |\n|" + "---|" * 14
)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("robots", nargs="*", help="how rows of the table begin; all without any")
    parser.add_argument(
        "--published",
        type=Path,
        help="matlab/data/Exciting_Traj/Trajectory_1/gen_params.txt of FrankaEmikaPandaDynModel",
    )
    options = parser.parse_args()
    print(HEAD)
    for row in ROWS:
        if not options.robots or row.name.startswith(tuple(options.robots)):
            print(study(row), flush=True)
    if options.published:
        print(published_distance(options.published))


if __name__ == "__main__":
    main()
