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
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from extrapolation import identified_pair
from extrapolation_pairs import OPEN

import calib
from calib.data.poses.measurements import PoseMeasurements, take
from calib.geometry.model_choice.folds import region_folds
from calib.identification.identify import Identification, identify
from calib.identification.identify_options import parse_options
from calib.identification.uncertainty.torque_errors import TorqueIntervals
from calib.procedure.dynamic_stage.inputs import gather as gather_logs
from calib.procedure.kinematic_stage.inputs import gather
from calib.robot.calibrated import as_calibrated
from calib.simulation.known_robots import random_fourier
from calib.simulation.truth import true_base
from calib.simulation.unmodelled import TorqueErrors
from calib.simulation.virtual_arm import UNMODELLED, MovingArm, moving_arm, record
from calib.simulation.virtual_cells import virtual_cell

DATA = Path(os.environ.get("CALIB_DATA", "../shared/data"))
UR5 = DATA / "ur5_gts3800"
UR10 = DATA / "ur10_ipa"
MOTOMAN = DATA / "motoman_leica"
TIAGO_LAAS = DATA / "tiago_laas"
# robot, measured poses, and the share of them that is held out at random
RECORDINGS = {
    "UR5": (UR5 / "model.urdf", UR5 / "grid_800.csv", 0.25),
    "UR10 A": (UR10 / "model.urdf", UR10 / "A_grid_2500.csv", 0.4),
    "UR10 B": (UR10 / "model.urdf", UR10 / "B_joint_configurations.csv", 0.4),
    "Motoman small": (MOTOMAN / "model_right.urdf", MOTOMAN / "right_6x6x6_150.csv", 1 / 3),
    "Motoman wide": (MOTOMAN / "model_right.urdf", MOTOMAN / "right_wide_386.csv", 0.25),
    "TIAGo, three markers": (TIAGO_LAAS / "model.urdf", TIAGO_LAAS / "mocap_35poses.csv", 0.25),
}
# recordings with enough poses to leave out the ends of each joint's range
WITH_ENDS = ("UR5", "UR10 A", "UR10 B", "Motoman small", "Motoman wide")
# recordings of one arm from two stations: fitted, held out
STATIONS = (
    ("UR10 A", "UR10 B"),
    ("UR10 B", "UR10 A"),
    ("Motoman small", "Motoman wide"),
    ("Motoman wide", "Motoman small"),
)
REGION_SEED = 7  # regions that are none of the fit's own folds
END_SHARE = 0.15  # share of the poses at one end of a joint that is left out

SECONDS = 20.0  # of a simulated motion
RATE = 1000.0  # of its log [Hz]
SEEDS = 50
PARAMETER_KINDS = ("bodies", "Ia", "Fv", "Fc", "off")

PANDA = "franka_panda_inria/traj1_first60pct.npz"
LWR = "kuka_lwr4plus_iit/measurements_1.npz"
TX40 = "staubli_tx40/tx40_first_5p4s.npz"
TIAGO = "tiago_laas/dynamic.npz"
KR300_A = "kuka_kr300_tuk/traj_A.npz"
KR300_B = "kuka_kr300_tuk/traj_B.npz"
UR10E_8 = "ur10e_innopolis/ur-20_02_05-20sec_8harm.npz"
UR10E_12 = "ur10e_innopolis/ur-20_02_10-30sec_12harm.npz"
UR10E_14 = "ur10e_innopolis/ur-20_02_19_14harm50sec.npz"
DEFAULTS = calib.IdentifySettings()
GAINS = calib.IdentifySettings(gains=(14.87, 13.26, 11.13, 10.62, 11.03, 11.47))  # [N m/A]
WRIST = calib.IdentifySettings(coupling=({"joints": [5, 6], "label": "6"},))  # one motor moves axes 5 and 6
# name, recording to learn from, unseen recording, settings of the identification
MOTIONS = (
    ("Panda, first 9.4 s", f"{PANDA}@0:9.387", f"{PANDA}@9.387:", DEFAULTS),
    ("Panda, first 4 s", f"{PANDA}@0:4", f"{PANDA}@4:", DEFAULTS),
    ("Panda, first 1 s", f"{PANDA}@0:1", f"{PANDA}@4:", DEFAULTS),
    ("Panda, last 8.8 s", f"{PANDA}@3.13:", f"{PANDA}@0:3.13", DEFAULTS),
    ("UR10e, 12 harmonics", UR10E_12, UR10E_14, GAINS),
    ("UR10e, 8 harmonics", UR10E_8, UR10E_14, GAINS),
    ("UR10e, 8 harmonics", UR10E_8, UR10E_12, GAINS),
    ("UR10e, 4 s of 12 harmonics", f"{UR10E_12}@8:12", UR10E_14, GAINS),
    ("TX40, first 4 s", f"{TX40}@0:4", f"{TX40}@4:", WRIST),
    ("TX40, first 2.7 s", f"{TX40}@0:2.7", f"{TX40}@2.7:", WRIST),
    ("KR300 A", KR300_A, KR300_B, DEFAULTS),
    ("KR300 B", KR300_B, KR300_A, DEFAULTS),
    ("TIAGo, first 50 s", f"{TIAGO}@0:50", f"{TIAGO}@50:", DEFAULTS),
    ("LWR4+, first half", f"{LWR}@2.5:8.75", f"{LWR}@8.75:15", DEFAULTS),
)


# ---- positions -------------------------------------------------------------------------------------------------------


def position_row(name: str, split: str, fits: Iterable[calib.GeometryFit]) -> str:
    """Return a row of the table: errors and intervals of the unseen rows of some fits together."""
    validations = []
    for fit in fits:
        validations += fit.validation.values()
    intervals = [validation.intervals for validation in validations if validation.intervals is not None]
    sizes = np.concatenate([interval.size for interval in intervals])
    radii = np.concatenate([interval.radius for interval in intervals])
    extrapolated = np.concatenate([interval.beyond for interval in intervals])
    cells = [
        name,
        split,
        str(len(sizes)),
        f"{1e3 * np.sqrt(np.mean(sizes**2)):.3f}",
        f"{100 * np.mean(sizes <= radii):.1f} %",
        f"{1e3 * np.median(radii):.3f}",
        f"{100 * np.mean(extrapolated):.0f} %",
    ]
    return f"| {' | '.join(cells)} |"


def read_block(robot: Path, file: Path) -> PoseMeasurements:
    """Return the measured poses of a file."""
    return gather(robot, [file], settings=calib.FitSettings()).fit[0]


def fit_without(robot: Path, block: PoseMeasurements, held_out: np.ndarray, name: str) -> calib.GeometryFit:
    """Return the fit to some rows of a block, validated on the others.

    Args:
        robot: the description.
        block: measured poses (m).
        held_out: (m,) whether a row is held out.
        name: of the held-out rows.
    """
    training = take(block, np.flatnonzero(~held_out))
    unseen = replace(take(block, np.flatnonzero(held_out)), file=name)
    return calib.fit_geometry(robot, training, calib.FitSettings(), validate=unseen)


def random_split(robot: Path, file: Path, share: float) -> Iterator[calib.GeometryFit]:
    """Yield the fit with a share of the rows held out at random."""
    yield calib.fit_geometry(robot, file, calib.FitSettings(holdout=share))


def region_fits(robot: Path, file: Path) -> Iterator[calib.GeometryFit]:
    """Yield one fit for each left-out region of the joint space."""
    block = read_block(robot, file)
    folds = region_folds([block], seed=REGION_SEED)
    for fold in range(folds.count):
        yield fit_without(robot, block, folds.members[0] == fold, f"region {fold + 1}")


def end_fits(robot: Path, file: Path) -> Iterator[calib.GeometryFit]:
    """Yield one fit for each left-out end of each joint's range."""
    block = read_block(robot, file)
    for joint in np.flatnonzero(np.ptp(block.q, axis=0) > 1e-3):
        values = block.q[:, joint]
        low, high = np.quantile(values, [END_SHARE, 1.0 - END_SHARE])
        for name, held_out in (("low", values < low), ("high", values > high)):
            if held_out.any():
                yield fit_without(robot, block, held_out, f"{name} end of joint {joint + 1}")


def station_fit(robot: Path, file: Path, unseen: Path) -> Iterator[calib.GeometryFit]:
    """Yield the fit to the poses of one station, validated on those of another, whose frames are fitted anew."""
    settings = calib.FitSettings(refit_frames=True)
    yield calib.fit_geometry(robot, file, settings, validate=unseen)


def position_splits() -> Iterator[tuple[str, str, Iterable[calib.GeometryFit]]]:
    """Yield recording, split and fits of each row of the positions' table; the fits are made when iterated over."""
    for name, (robot, file, share) in RECORDINGS.items():
        yield name, f"{100 * share:.0f} % at random", random_split(robot, file, share)
        yield name, "each region left out", region_fits(robot, file)
        if name in WITH_ENDS:
            yield name, "each joint's ends left out", end_fits(robot, file)
    for name, unseen in STATIONS:
        robot, file, _ = RECORDINGS[name]
        yield name, f"→ {unseen}", station_fit(robot, file, RECORDINGS[unseen][1])


def print_positions(chosen: Sequence[str] = ()) -> None:
    """Print the table of positions, all rows or those whose first cells, as in ``Motoman small | →``, are chosen."""
    print("| recording | split | unseen rows | rms [mm] | within 95 % interval | median interval [mm] | extrapolated |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for name, split, fits in position_splits():
        if not chosen or f"{name} | {split}".startswith(tuple(chosen)):
            print(position_row(name, split, fits), flush=True)


# ---- torques ---------------------------------------------------------------------------------------------------------


def joined(parts: Sequence[TorqueIntervals]) -> TorqueIntervals:
    """Return the intervals of several recordings as those of one."""
    by_sample = {}
    for name in ("index", "sigma", "contains", "valid", "standing"):
        by_sample[name] = np.concatenate([getattr(part, name) for part in parts])
    extrapolated = np.concatenate([part.extrapolated for part in parts], axis=1)
    return TorqueIntervals(**by_sample, extrapolated=extrapolated)


def torque_row(name: str, split: str, model: calib.DynamicsModel) -> str:
    """Return a row of the torques' table: intervals on motion that the identification has not seen."""
    parts = list(model.intervals.values())
    intervals = joined(parts)
    errors = [model.validation[case].raw.total for case in model.intervals]
    samples = [len(part.index) for part in parts]
    joints = 100.0 * intervals.joints
    cells = [
        name,
        split,
        f"{np.average(errors, weights=samples):.1f} %",
        f"{100 * intervals.covered:.1f} %",
        f"{joints.min():.0f}–{joints.max():.0f} %",
        " ".join(f"{width:.2g}" for width in intervals.median),
        f"{100 * intervals.beyond.mean():.0f} %",
    ]
    return f"| {' | '.join(cells)} |"


def motion_rows(chosen: Sequence[str] = ()) -> Iterator[str]:
    """Yield the rows of the torques' table, all or those whose first cells are chosen."""
    for name, train, unseen, settings in MOTIONS:
        split = Path(unseen).name
        if chosen and not f"{name} | {split}".startswith(tuple(chosen)):
            continue
        robot = (DATA / train).parent / "model.urdf"
        model = calib.identify_dynamics(robot, str(DATA / train), settings, validate=str(DATA / unseen))
        yield torque_row(name, split, model)


def regime_rows() -> Iterator[str]:
    """Yield one row for each open pair of recordings whose test data are of another regime."""
    for pair in OPEN:
        if not pair.across:
            continue
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            model = identified_pair(pair.prepare(folder), folder)
            name, split = pair.name.split(" → ", 1)
            yield torque_row(name, split, model)


def print_torques(rows: Iterator[str]) -> None:
    """Print the table of torques, all rows or those of other regimes."""
    print("| learnt from | unseen motion | unexplained | within 95 % | by joint | median ± by joint | extrapolated |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for row in rows:
        print(row, flush=True)


# ---- parameters of a simulated arm -----------------------------------------------------------------------------------


def identified(arm: MovingArm, seeds: Sequence[int]) -> Identification:
    """Return the identification of a simulated arm from random motions of 20 s, on its true geometry."""
    lower, upper = arm.chain.sampling_limits()
    speed = np.array([joint.velocity for joint in arm.chain.joints])
    logs = []
    for seed in seeds:
        motion = random_fourier(0.8 * lower, 0.8 * upper, 0.8 * speed, SECONDS, RATE, seed=seed)
        log = record(arm, motion, seed)
        logs.append(replace(log, file=f"motion {seed}"))
    inputs = gather_logs(as_calibrated(arm.chain), logs, options=parse_options({"rows": "both"}))
    return identify(inputs.robot, inputs.cases, inputs.options.settings)


def parameter_kind(name: str) -> str:
    """Return the kind of a parameter: one of `PARAMETER_KINDS`."""
    for kind in PARAMETER_KINDS[1:]:
        if name.startswith(kind):
            return kind
    return "bodies"


def parameters_inside(identification: Identification, true: Mapping[str, float]) -> Iterator[tuple[str, bool]]:
    """Yield the kind of each parameter whose true value is known, and whether it is within 1.96 σ of the estimate."""
    estimate = identification.fitted.estimate
    for regrouped, value, sigma in zip(identification.names, estimate.values, estimate.sigma):
        name = regrouped.removesuffix("R")
        if name in true and sigma > 1e-9:
            yield parameter_kind(name), abs(value - true[name]) < 1.96 * sigma


def print_parameters(seeds: int = SEEDS) -> None:
    """Print the share of identified parameters within 1.96 σ of the true values, over seeds of motion and noise.

    The arm's own friction is that of steady sliding when it is warm. Prediction and verdict, which take most of the
    time of `calib identify`, are left out: no sigma of a parameter depends on them.
    """
    print("| simulated LWR4+ | identifications | within 1.96 σ | bodies | Ia | Fv | Fc | offsets |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    cell = virtual_cell("lwr4plus")
    for name, unmodelled in (("model exact", TorqueErrors()), ("effects that no parameter holds", UNMODELLED)):
        arm = moving_arm(cell, "lwr4plus", unmodelled=unmodelled)
        inside = defaultdict(list)
        for seed in range(seeds):
            identification = identified(arm, [seed])
            true = true_base(identification.dynamics.model, cell, arm, 0)
            for kind, is_inside in parameters_inside(identification, true):
                inside[kind].append(is_inside)
        total = np.mean(np.concatenate(list(inside.values())))
        shares = [total, *(np.mean(inside[kind]) for kind in PARAMETER_KINDS)]
        cells = [f"{100.0 * share:.1f} %" for share in shares]
        print(f"| {name} | {seeds} | {' | '.join(cells)} |", flush=True)


def main() -> None:
    tables = ("torques", "regimes", "parameters", "positions")
    arguments = sys.argv[1:]
    requested = [name for name in tables if name in arguments]
    rows = [name for name in arguments if name not in tables]
    for table in requested or tables:
        match table:
            case "torques":
                print_torques(motion_rows(rows))
            case "regimes":
                print_torques(regime_rows())
            case "parameters":
                print_parameters()
            case "positions":
                print_positions(rows)


if __name__ == "__main__":
    main()
