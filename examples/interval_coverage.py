"""How the errors that fits and identifications state hold: one row per recording and split, and simulated parameters.

CALIB_DATA=... python examples/interval_coverage.py [torques] [regimes] [parameters] [positions] [ROW ...]

A ROW of positions or torques is named by its first cells: "Motoman small | each region". Without any all are made.
Regimes: the open recordings' pairs of `extrapolation.py` whose test is of another regime (faster, another range or
motion).
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from extrapolation import identified_pair
from extrapolation_pairs import OPEN

import calib
from calib.api.dynamic import DynamicsModel
from calib.api.kinematic import GeometryFit
from calib.data.poses.measurements import take
from calib.geometry.model_choice.folds import region_folds
from calib.identification.identify import Identification, identify
from calib.identification.identify_options import parse_options
from calib.identification.uncertainty.torque_errors import TorqueIntervals
from calib.procedure.dynamic_stage.inputs import gather as gather_logs
from calib.procedure.kinematic_stage.inputs import gather
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.robot.calibrated import as_calibrated
from calib.simulation.known_robots import random_fourier
from calib.simulation.truth import true_base
from calib.simulation.unmodelled import TorqueErrors
from calib.simulation.virtual_arm import MovingArm, moving_arm, record
from calib.simulation.virtual_cells import virtual_cell

DATA = Path(os.environ.get("CALIB_DATA", "../shared/data"))
UR10, UR5, MOTOMAN = DATA / "ur10_ipa", DATA / "ur5_gts3800", DATA / "motoman_leica"
RECORDINGS = {
    "UR5": (UR5 / "model.urdf", UR5 / "grid_800.csv", 0.25),
    "UR10 A": (UR10 / "model.urdf", UR10 / "A_grid_2500.csv", 0.4),
    "UR10 B": (UR10 / "model.urdf", UR10 / "B_joint_configurations.csv", 0.4),
    "Motoman small": (MOTOMAN / "model_right.urdf", MOTOMAN / "right_6x6x6_150.csv", 1 / 3),
    "Motoman wide": (MOTOMAN / "model_right.urdf", MOTOMAN / "right_wide_386.csv", 0.25),
    "TIAGo, three markers": (DATA / "tiago_laas/model.urdf", DATA / "tiago_laas/mocap_35poses.csv", 0.25),
}
ENDS = ("UR5", "UR10 A", "UR10 B", "Motoman small", "Motoman wide")
STATIONS = (
    ("UR10 A", "UR10 B"), ("UR10 B", "UR10 A"), ("Motoman small", "Motoman wide"), ("Motoman wide", "Motoman small"),
)  # fmt: skip
SECONDS, RATE, SEEDS = 20.0, 1000.0, 50
REGION_SEED = 7  # regions that are none of the fit's own folds
END = 0.15  # share of the poses at one end of a joint that is left out


PANDA, LWR = "franka_panda_inria/traj1_first60pct.npz", "kuka_lwr4plus_iit/measurements_1.npz"
TX40, TIAGO = "staubli_tx40/tx40_first_5p4s.npz", "tiago_laas/dynamic.npz"
KR300 = ("kuka_kr300_tuk/traj_A.npz", "kuka_kr300_tuk/traj_B.npz")
UR10E = {harmonics: f"ur10e_innopolis/ur-20_02_{name}.npz" for harmonics, name in (
    (8, "05-20sec_8harm"), (12, "10-30sec_12harm"), (14, "19_14harm50sec"),
)}  # fmt: skip
GAINS = {"gains": [14.87, 13.26, 11.13, 10.62, 11.03, 11.47]}
WRIST = {"coupling": [{"joints": [5, 6], "label": "6"}]}
MOTIONS = (
    ("Panda, first 9.4 s", f"{PANDA}@0:9.387", f"{PANDA}@9.387:", {}),
    ("Panda, first 4 s", f"{PANDA}@0:4", f"{PANDA}@4:", {}),
    ("Panda, first 1 s", f"{PANDA}@0:1", f"{PANDA}@4:", {}),
    ("Panda, last 8.8 s", f"{PANDA}@3.13:", f"{PANDA}@0:3.13", {}),
    ("UR10e, 12 harmonics", UR10E[12], UR10E[14], GAINS),
    ("UR10e, 8 harmonics", UR10E[8], UR10E[14], GAINS),
    ("UR10e, 8 harmonics", UR10E[8], UR10E[12], GAINS),
    ("UR10e, 4 s of 12 harmonics", f"{UR10E[12]}@8:12", UR10E[14], GAINS),
    ("TX40, first 4 s", f"{TX40}@0:4", f"{TX40}@4:", WRIST),
    ("TX40, first 2.7 s", f"{TX40}@0:2.7", f"{TX40}@2.7:", WRIST),
    ("KR300 A", *KR300, {}),
    ("KR300 B", *KR300[::-1], {}),
    ("TIAGo, first 50 s", f"{TIAGO}@0:50", f"{TIAGO}@50:", {}),
    ("LWR4+, first half", f"{LWR}@2.5:8.75", f"{LWR}@8.75:15", {}),
)


def row(name: str, split: str, fits: list[GeometryFit]) -> str:
    """Return a row of the table: errors and intervals of the unseen rows of some fits together."""
    found = [each for fit in fits for each in fit.validation.values() if each.intervals is not None]
    sizes, radii, beyond = (
        np.concatenate([getattr(each.intervals, key) for each in found]) for key in ("size", "radius", "beyond")
    )
    rms, covered = 1e3 * np.sqrt(np.mean(sizes**2)), 100 * np.mean(sizes <= radii)
    return (
        f"| {name} | {split} | {len(sizes)} | {rms:.3f} | {covered:.1f} % | {1e3 * np.median(radii):.3f} | "
        f"{100 * np.mean(beyond):.0f} % |"
    )


def regions(robot: Path, file: Path) -> Iterator[GeometryFit]:
    """Yield one fit for each left-out region of the joint space."""
    block = gather(robot, [file], settings=FitSettings()).fit[0]
    folds = region_folds([block], seed=REGION_SEED)
    for fold in range(folds.count):
        inside = folds.members[0] == fold
        left_out = replace(take(block, np.flatnonzero(inside)), file=f"region {fold + 1}")
        yield calib.fit_geometry(robot, take(block, np.flatnonzero(~inside)), FitSettings(), validate=left_out)


def ends(robot: Path, file: Path) -> Iterator[GeometryFit]:
    """Yield one fit for each left-out end of each joint's range."""
    block = gather(robot, [file], settings=FitSettings()).fit[0]
    for joint in np.flatnonzero(np.ptp(block.q, axis=0) > 1e-3):
        low, high = np.quantile(block.q[:, joint], [END, 1.0 - END])
        for name, left in (("low", block.q[:, joint] < low), ("high", block.q[:, joint] > high)):
            if left.any():
                unseen = replace(take(block, np.flatnonzero(left)), file=f"{name} end of joint {joint + 1}")
                yield calib.fit_geometry(robot, take(block, np.flatnonzero(~left)), FitSettings(), validate=unseen)


def torque_row(name: str, split: str, model: DynamicsModel) -> str:
    """Return a row of the torques' table: intervals on motion that the identification has not seen."""
    cases = model.intervals
    series = ("index", "sigma", "contains", "valid", "standing")
    joined = {key: np.concatenate([getattr(one, key) for one in cases.values()]) for key in series}
    found = TorqueIntervals(**joined, extrapolated=np.concatenate([x.extrapolated for x in cases.values()], axis=1))
    errors = [model.validation[case].raw.total for case in cases]
    joints = 100.0 * found.joints
    return (
        f"| {name} | {split} | {np.average(errors, weights=[len(x.index) for x in cases.values()]):.1f} % | "
        f"{100 * found.covered:.1f} % | {joints.min():.0f}–{joints.max():.0f} % | "
        f"{' '.join(f'{one:.2g}' for one in found.median)} | {100 * found.beyond.mean():.0f} % |"
    )


def motion_rows(chosen: Sequence[str] = ()) -> Iterator[str]:
    """Yield the rows of the torques' table, all or those whose first cells are chosen."""
    for name, train, unseen, options in MOTIONS:
        if chosen and not f"{name} | {Path(unseen).name}".startswith(tuple(chosen)):
            continue
        robot = (DATA / train).parent / "model.urdf"
        files = [str(DATA / each) for each in (train, unseen)]
        model = calib.identify_dynamics(robot, files[0], validate=files[1], options=parse_options(options))
        yield torque_row(name, Path(unseen).name, model)


def regime_rows() -> Iterator[str]:
    """Yield one row for each open pair of recordings whose test data are of another regime."""
    for pair in OPEN:
        if pair.across:
            with tempfile.TemporaryDirectory() as place:
                yield torque_row(*pair.name.split(" → ", 1), identified_pair(pair.prepare(Path(place)), Path(place)))


def position_rows() -> Iterator[tuple[str, str, Callable[[], list[GeometryFit]]]]:
    """Yield the recording, the split and the fits of each row in the table of positions."""
    for name, (robot, file, share) in RECORDINGS.items():
        settings = FitSettings(holdout=share)
        yield name, f"{100 * share:.0f} % at random", lambda: [calib.fit_geometry(robot, file, settings)]  # noqa: B023
        yield name, "each region left out", lambda: list(regions(robot, file))  # noqa: B023
        if name in ENDS:
            yield name, "each joint's ends left out", lambda: list(ends(robot, file))  # noqa: B023
    for one, other in STATIONS:
        robot, file, _ = RECORDINGS[one]
        settings, unseen = FitSettings(refit_frames=True), RECORDINGS[other][1]
        yield one, f"→ {other}", lambda: [calib.fit_geometry(robot, file, settings, validate=unseen)]  # noqa: B023


def positions(chosen: Sequence[str] = ()) -> None:
    """Print the table of positions, all rows or those whose first cells, as in ``Motoman small | →``, are chosen."""
    print("| recording | split | unseen rows | rms [mm] | within 95 % interval | median interval [mm] | extrapolated |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for name, split, fits in position_rows():
        if not chosen or f"{name} | {split}".startswith(tuple(chosen)):
            print(row(name, split, fits()), flush=True)


def torques(rows: Iterator[str]) -> None:
    """Print the table of torques, all rows or those of other regimes."""
    print("| learnt from | unseen motion | unexplained | within 95 % | by joint | median ± by joint | extrapolated |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for row in rows:
        print(row, flush=True)


def identified(arm: MovingArm, seeds: Sequence[int]) -> Identification:
    """Return the identification of a simulated arm from random motions of 20 s, on its true geometry."""
    lower, upper = arm.chain.sampling_limits()
    speed = np.array([joint.velocity for joint in arm.chain.joints])
    logs = []
    for seed in seeds:
        motion = random_fourier(0.8 * lower, 0.8 * upper, 0.8 * speed, SECONDS, RATE, seed=seed)
        logs.append(replace(record(arm, motion, seed), file=f"motion {seed}"))
    given = gather_logs(as_calibrated(arm.chain), logs, options=parse_options({"rows": "both"}))
    return identify(given.robot, given.cases, given.options.settings)


def parameters(seeds: int = SEEDS) -> None:
    """Print the share of identified parameters within 1.96 σ of the true values, over seeds of motion and noise.

    The arm's own friction is that of steady sliding when it is warm. Prediction and verdict, which take most of the
    time of `calib identify`, are left out: no sigma of a parameter depends on them.
    """
    print("| simulated LWR4+ | identifications | within 1.96 σ | bodies | Ia | Fv | Fc | offsets |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    cell = virtual_cell("lwr4plus")
    for name, beyond in (("model exact", TorqueErrors()), ("effects that no parameter holds", None)):
        arm, inside = moving_arm(cell, "lwr4plus", unmodelled=beyond), defaultdict(list)
        for seed in range(seeds):
            found = identified(arm, [seed])
            estimate, true = found.fitted.estimate, true_base(found.dynamics.model, cell, arm, 0)
            for known, value, sigma in zip(found.names, estimate.values, estimate.sigma):
                if (own := known.removesuffix("R")) in true and sigma > 1e-9:
                    kind = next((kind for kind in ("Ia", "Fv", "Fc", "off") if own.startswith(kind)), "bodies")
                    inside[kind].append(abs(value - true[own]) < 1.96 * sigma)
        each = [100.0 * np.mean(inside[kind]) for kind in ("bodies", "Ia", "Fv", "Fc", "off")]
        every = 100.0 * np.mean(np.concatenate(list(inside.values())))
        print(f"| {name} | {seeds} | {every:.1f} % | {' | '.join(f'{one:.1f} %' for one in each)} |", flush=True)


def main() -> None:
    tables = ("torques", "regimes", "parameters", "positions")
    wanted = [name for name in tables if name in sys.argv[1:]] or tables
    chosen = [name for name in sys.argv[1:] if name not in tables]
    if "torques" in wanted:
        torques(motion_rows(chosen))
    if "regimes" in wanted:
        torques(regime_rows())
    if "parameters" in wanted:
        parameters()
    if "positions" in wanted:
        positions(chosen)


if __name__ == "__main__":
    main()
