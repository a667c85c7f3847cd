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

from calib.data.signals.motion import Motion
from calib.errors import CalibError
from calib.estimation.linear import settled_std, wls
from calib.estimation.whiteness import inflation
from calib.identification.closed_loop import instrumental_variables as instruments
from calib.identification.identify import Identification, identify
from calib.identification.identify_options import IdentifyOptions, parse_options
from calib.identification.rows import Case, observe
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


TWELVE, FOURTEEN = "ur-20_02_10-30sec_12harm.npz", "ur-20_02_19_14harm50sec.npz"
PANDA = "traj1_first60pct.npz"
ROWS = (
    Row("Panda", "franka_panda_inria", f"{PANDA}@1.2:9.387", f"{PANDA}@9.387:11.9", 2.0 / 0.15, 5, SENSOR),
    Row("UR10e, 30 s", "ur10e_innopolis", f"{TWELVE}@7:36.8", FOURTEEN, 30.3, 12, UR10E),
    Row("UR10e, 30 s", "ur10e_innopolis", f"{TWELVE}@7:36.8", FOURTEEN, 30.3, 60, UR10E),
    Row("UR10e, 50 s", "ur10e_innopolis", f"{FOURTEEN}@2.2:51.9", TWELVE, 50.3, 14, UR10E),
    Row("UR10e, 50 s", "ur10e_innopolis", f"{FOURTEEN}@2.2:51.9", TWELVE, 50.3, 60, UR10E),
    Row("KR300, A", "kuka_kr300_tuk", "traj_A.npz", "traj_B.npz", 10.0, 20, {}),
    Row("KR300, B", "kuka_kr300_tuk", "traj_B.npz", "traj_A.npz", 10.0, 20, {}),
)


def fitted(motion: Motion, period: float, harmonics: int) -> tuple[SampledMotion, float]:
    """Return the Fourier series nearest to the positions of a motion, and its period [s], within 2 % of `period`."""
    times = motion.t - motion.t[0]
    few = slice(None, None, max(1, len(times) // 3000))

    def series(period: float, part: slice) -> SampledMotion:
        basis = fourier_family(harmonics, period, motion.n, rest=False).basis(times[part])
        return basis.motion(basis.nearest(motion.q[part]))

    def left(period: float) -> float:
        return float(np.sum((series(period, few).q - motion.q[few]) ** 2))

    found = lowest(left, 0.98 * period, 1.02 * period)
    return series(found, slice(None)), found


def lowest(function: Callable[[float], float], low: float, high: float) -> float:
    """Return where a function of one number is lowest."""
    return float(fminbound(function, low, high, xtol=1e-6))  # type: ignore[arg-type]


def settings(row: Row, method: str = "wls", **more: Any) -> IdentifyOptions:
    """Return the options of an identification: base parameters, standard friction, no prior."""
    plain = {"friction": "standard", "prior": "none", "essential": "none"}
    return parse_options(plain | row.options | {"method": method} | more)


def error(found: Identification, values: np.ndarray, case: Case) -> float:
    """Return the torque error 100 ‖y - W x‖ / ‖y‖ of a case in the identification band [%]."""
    rows = observe(found.dynamics.model, found.base.kept, case, case.motion.decimator)
    left = np.linalg.norm((rows.target - rows.matrix @ values)[rows.present])
    return float(100.0 * left / np.linalg.norm(rows.target[rows.present]))


def with_series(plain: Identification, case: Case, series: SampledMotion) -> tuple[np.ndarray, str]:
    """Return the IV estimate (b,) with the series as instruments, and its tests as cells of the table."""
    moved = replace(case, motion=replace(case.motion, q=series.q, v=series.v, a=series.a))
    own, z = (observe(plain.dynamics.model, plain.base.kept, one, case.motion.decimator) for one in (case, moved))
    problem = instruments.unseen(plain.base.names, plain.base.units, own.target.shape[1])
    for row, used in enumerate(own.present.T):
        problem = instruments.instrument(
            z.matrix[used, row], own.matrix[used, row], own.target[used, row], row, before=problem
        )
    data = problem.least_squares()
    least = wls(data, settled_std(data, 1e-3))
    residual = own.target - own.matrix @ instruments.iv(problem, least.group_std).estimate.values
    tau = max(1.0, float(np.mean([inflation(column) for column in residual.T])))
    found = instruments.iv(problem, least.group_std, tau).estimate
    shift = np.abs(least.estimate.values - found.values) / found.sigma
    strength = instruments.strength(problem, least.group_std)
    test = instruments.exogeneity(problem, least.group_std, tau)
    return found.values, f"{strength.cragg_donald:.2g} | {test.p:.2f} | {shift.max():.2f} σ"


def estimate(row: Row, robot: Any, case: Case, method: str, **more: Any) -> np.ndarray | None:
    """Return the estimate (b,) of a method; None where it failed, with the reason on the console."""
    try:
        return identify(robot, [case], settings(row, method, **more).settings).fitted.estimate.values
    except CalibError as problem:
        print(f"{row.name}: {method}: {problem}", file=sys.stderr)
        return None


@dataclass(frozen=True, eq=False)
class Learnt:
    """A recording and an unseen one, with least squares, plain and under physical constraints (None: failed)."""

    robot: Any
    case: Case
    other: Case
    plain: Identification
    consistent: np.ndarray | None


@lru_cache(maxsize=1)
def learnt(train: str) -> Learnt:
    """Return what all rows of a recording have in common."""
    row = next(row for row in ROWS if row.train == train)
    folder = DATA / row.folder
    paths = [folder / row.train], [folder / row.unseen]
    given = recordings.gather(folder / "model.urdf", *paths, options=settings(row))
    (case,), (other,) = given.cases, given.unseen
    plain = identify(given.robot, [case], given.options.settings)
    return Learnt(given.robot, case, other, plain, estimate(row, given.robot, case, "pc-wls"))


def study(row: Row) -> str:
    """Return a row of the table."""
    shared = learnt(row.train)
    robot, case, other, plain = shared.robot, shared.case, shared.other, shared.plain
    series, period = fitted(case.motion, row.period, row.harmonics)
    motion, away = case.motion, 1e3 * (case.motion.q - series.q).std(axis=0)
    noise = 1e3 * motion.cutoffs.noise
    in_a = 100.0 * motion.cutoffs.acceleration_noise(motion.cutoff, motion.rate) / motion.a.std(axis=0)
    by_series, tests = with_series(plain, case, series)
    asked = replace(case, motion=replace(case.motion, q_ref=frozen(series.q)))
    estimates = [plain.fitted.estimate.values, shared.consistent, by_series]
    estimates += [estimate(row, robot, asked, method, loop=PD) for method in LOOP_METHODS]
    cells = ["–" if one is None else f"{error(plain, one, other):.2f} %" for one in estimates]
    return (
        f"| {row.name} | {row.harmonics} of {period:.2f} s | {away.min():.2g}–{away.max():.2g} | "
        f"{noise.min():.1g}–{noise.max():.1g} | {in_a.max():.2g} % | {tests} | {' | '.join(cells)} |"
    )


def published(path: Path) -> str:
    """Return how far the Panda's fitted series is from the one that its authors published, at the fitted period.

    Args:
        path: gen_params.txt, (14, 5): cosines a and sines b of the velocities, of 0.15 π rad/s and its multiples.
    """
    row, few = ROWS[0], slice(None, None, 10)
    folder = DATA / row.folder
    given = recordings.gather(folder / "model.urdf", [folder / row.train], options=settings(row))
    motion = given.cases[0].motion
    series, period = fitted(motion, row.period, row.harmonics)
    k = np.arange(1, row.harmonics + 1)
    a, b = np.split(np.loadtxt(path) / (0.15 * np.pi * k), 2)

    def away(late: float) -> np.ndarray:
        angle = np.outer(motion.t[few] - late, 2.0 * np.pi / period * k)
        rest = np.sin(angle) @ a.T - np.cos(angle) @ b.T - series.q[few]
        return 1e3 * rest.std(axis=0)

    late = lowest(lambda late: float(np.sum(away(late) ** 2)), 0.4, 0.6)
    return (
        f"published series {late:.4f} s late: {away(late).min():.2g} to {away(late).max():.2g} mrad from the fitted one"
    )


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
    given = parser.parse_args()
    print(HEAD)
    for row in ROWS:
        if not given.robots or any(row.name.startswith(one) for one in given.robots):
            print(study(row), flush=True)
    if given.published:
        print(published(given.published))


if __name__ == "__main__":
    main()
