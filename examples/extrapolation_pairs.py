"""The pairs of `extrapolation.py`: recordings to learn from, and others to predict; open ones and simulated ones."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import extrapolation_simulated as simulated
import numpy as np
from extrapolation_simulated import PAYLOAD, each_alone, fourier, points, sine

DATA = Path(os.environ.get("CALIB_DATA", "../shared/data"))
WRIST = '[[coupling]]\njoints = [5, 6]\nlabel = "6"\n'
UR10E_GAINS = np.array([14.87, 13.26, 11.13, 10.62, 11.03, 11.47])  # [N m/A]


@dataclass(frozen=True)
class Prepared:
    """Files of a pair.

    Attributes:
        robot: URDF.
        train, test: npz of t [s], q [rad or m], tau [N m or N].
        options: text of the options file.
        masses: whether the URDF has them.
        payload: carried in the test.
        joints: that were recorded, where the description has others.
        other_unit: joints in another unit, which no total holds; from 0.
    """

    robot: Path
    train: list[Path]
    test: list[Path]
    options: str = ""
    masses: bool = False
    payload: dict | None = None
    joints: tuple[str, ...] = ()
    other_unit: tuple[int, ...] = ()


@dataclass(frozen=True)
class Pair:
    """A pair of recordings: training data, and the motion to predict.

    Attributes:
        across: the test is of another regime: faster, other ranges, all joints after single ones, with a payload.
        prepare: writes the files into a folder.
        quick: one of the subset for a first look.
    """

    name: str
    across: bool
    prepare: Callable[[Path], Prepared]
    quick: bool = False


# open recordings


class Part(NamedTuple):
    """Part of a log: its name, begin and end [s]."""

    log: str
    begin: float = 0.0
    end: float = np.inf


# folder of each robot, and which of its samples are read: every first, second, fifth
FOLDERS = {
    "Panda": ("franka_panda_inria", 2),
    "UR10e": ("ur10e_innopolis", 1),
    "KR300": ("kuka_kr300_tuk", 1),
    "TX40": ("staubli_tx40", 5),
    "TIAGo": ("tiago_laas", 1),
    "LWR4+": ("kuka_lwr4plus_iit", 1),
}
FILES = {"Panda": "traj1_first60pct", "TX40": "tx40_first_5p4s", "TIAGo": "dynamic", "LWR4+": "measurements_1"}
TIAGO_JOINTS = ("torso_lift_joint", *(f"arm_{k}_joint" for k in range(1, 8)))
MOVING_SPAN = {"TIAGo": (9.0, 67.0), "LWR4+": (2.5, 22.5)}  # in which the robot moves [s]


def _read(robot: str, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return instants (N,) [s], positions (N, n) [rad or m] and torques (N, n) [N m or N] of a log."""
    folder, step = FOLDERS[robot]
    prefix = {"UR10e": "ur-20_", "KR300": "traj_"}.get(robot, "")
    log = np.load(DATA / folder / f"{prefix}{name}.npz")
    if "tau" in log:
        tau = log["tau"]
    elif robot == "UR10e":
        tau = UR10E_GAINS * log["i"]
    else:
        tau = log.get("drive_gain", 1.0) * log["i"]
    first, end = 0, len(tau)
    if "use_range" in log:
        first, end = log["use_range"]
    rows = slice(first, end, step)
    return log["t"][rows] - log["t"][0], log["q"][rows], tau[rows]


def _write_parts(robot: str, parts: Sequence[Part], stem: Path) -> list[Path]:
    """Write parts of a robot's logs as npz files of t, q, tau; return their paths."""
    paths = []
    for k, part in enumerate(parts):
        t, q, tau = _read(robot, part.log)
        inside = (t >= part.begin) & (t < part.end)
        path = Path(f"{stem}_{k}.npz")
        np.savez(path, t=t[inside] - t[inside][0], q=q[inside], tau=tau[inside])
        paths.append(path)
    return paths


def _halves(robot: str, name: str, window: float, criterion: Callable[..., float]) -> tuple[list[Part], list[Part]]:
    """Return the time windows of a log with the lower and with the higher values of ``criterion(q, v)``.

    Args:
        robot, name: the log.
        window: length of the windows, about [s].
        criterion: of positions and velocities in a window, the latter relative to the range.
    """
    t, q, _ = _read(robot, name)
    low, high = MOVING_SPAN.get(robot, (t[0], t[-1]))
    edges = np.linspace(low, high, round((high - low) / window) + 1)
    v = np.gradient(q, axis=0) / np.gradient(t)[:, None] / np.ptp(q, axis=0)
    values = []
    for begin, end in pairwise(edges):
        inside = (t >= begin) & (t < end)
        values.append(criterion(q[inside], v[inside]))
    is_upper = np.array(values) > np.median(values)
    lower: list[Part] = []
    upper: list[Part] = []
    for k, (begin, end) in enumerate(pairwise(edges)):
        half = upper if is_upper[k] else lower
        # adjacent windows become one part
        if half and half[-1].end == begin:
            begin = half.pop().begin
        half.append(Part(name, begin, end))
    return lower, upper


def _open(
    robot: str,
    title: str,
    train: Sequence[Part] | Callable[[], Sequence],
    test: Sequence[Part] = (),
    *,
    across: bool = False,
    options: str = "",
    quick: bool = False,
) -> Pair:
    """Return a pair of an open robot.

    Args:
        robot, title: what its name is made of.
        train: parts of logs to learn from, or what returns these and those to predict.
        test: parts of logs to predict, where `train` does not return them.
        across, quick: as in `Pair`.
        options: text of the options file.
    """

    def prepare(folder: Path) -> Prepared:
        urdf = DATA / FOLDERS[robot][0] / "model.urdf"
        parts = train() if callable(train) else (train, test)
        train_files = _write_parts(robot, parts[0], folder / "train")
        test_files = _write_parts(robot, parts[1], folder / "test")
        masses = "<mass" in urdf.read_text()
        if robot == "TIAGo":
            return Prepared(urdf, train_files, test_files, options, masses, joints=TIAGO_JOINTS, other_unit=(0,))
        return Prepared(urdf, train_files, test_files, options, masses)

    return Pair(f"{robot}, {title}", across, prepare, quick)


def _span(robot: str, begin: float, end: float = np.inf) -> list[Part]:
    """Return the part of a robot's only log between two instants [s]."""
    return [Part(FILES[robot], begin, end)]


def _speeds(robot: str, name: str, window: float) -> Callable:
    """Return a function that divides a log into slow and fast windows."""

    def mean_square(q: np.ndarray, v: np.ndarray) -> float:
        return float((v**2).mean())

    return partial(_halves, robot, name, window, mean_square)


def _reach(robot: str, name: str, window: float, joint: int) -> Callable:
    """Return a function that divides a log into windows with low and high positions of a joint, from 1."""

    def mean_position(q: np.ndarray, v: np.ndarray) -> float:
        return float(q[:, joint - 1].mean())

    return partial(_halves, robot, name, window, mean_position)


STILL = [Part(f"01_17-p{k}") for k in range(1, 6)]
SINGLE = [Part(f"01_22-joint_{k}", 4.0, 14.0) for k in range(1, 7)]
EIGHT, TEN, TWELVE = "02_05-20sec_8harm", "02_06-20sec_10harm", "02_10-30sec_12harm"
FIVE, SEVEN, FOURTEEN = "02_06-20sec_5harm", "02_10-20sec_7harm", "02_19_14harm50sec"
LATER = Part(FOURTEEN, 10.0, 30.0)
PANDA_PAIRS = [
    _open("Panda", "first 9.4 s → rest", _span("Panda", 0, 9.387), _span("Panda", 9.387), quick=True),
    _open("Panda", "first 4 s → rest", _span("Panda", 0, 4), _span("Panda", 4)),
    _open("Panda", "first 1.5 s → from 4 s on", _span("Panda", 0, 1.5), _span("Panda", 4)),
    _open("Panda", "2 s from 6 s on → first 5 s", _span("Panda", 6, 8), _span("Panda", 0, 5), quick=True),
    _open("Panda", "last 8.8 s → first 3.1 s", _span("Panda", 3.13), _span("Panda", 0, 3.13)),
    _open("Panda", "slow windows → fast ones", _speeds("Panda", FILES["Panda"], 1.3), across=True, quick=True),
    _open("Panda", "low joint 2 → high joint 2", _reach("Panda", FILES["Panda"], 1.3, 2), across=True),
]
UR10E_PAIRS = [
    _open("UR10e", "8 → 14 harmonics", [Part(EIGHT)], [LATER], quick=True),
    _open("UR10e", "7 → 5 harmonics", [Part(SEVEN)], [Part(FIVE)]),
    _open("UR10e", "2 s of 12 → 14 harmonics", [Part(TWELVE, 8, 10)], [LATER], quick=True),
    _open("UR10e", "2 s of 14 → 12 harmonics", [Part(FOURTEEN, 20, 22)], [Part(TWELVE)]),
    _open("UR10e", "4 s of 12 → 14 harmonics", [Part(TWELVE, 8, 12)], [LATER]),
    _open("UR10e", "5 s of 5 → 12 harmonics", [Part(FIVE, 3, 8)], [Part(TWELVE, 10, 25)]),
    _open("UR10e", "2 s of 8 → 10 harmonics", [Part(EIGHT, 12, 14)], [Part(TEN, 5, 25)]),
    _open("UR10e", "single joints → 10 harmonics", SINGLE, [Part(TEN, 5, 25)], across=True, quick=True),
    _open("UR10e", "five postures and single joints → 14 harmonics", STILL + SINGLE, [LATER], across=True),
    _open(
        "UR10e",
        "five postures and joint 6 → 7 harmonics",
        [*STILL, Part("01_22-joint_6", 4, 40)],
        [Part(SEVEN)],
        across=True,
    ),
    _open("UR10e", "slow windows → fast ones", _speeds("UR10e", EIGHT, 2.0), across=True),
    _open("UR10e", "low joint 2 → high joint 2", _reach("UR10e", FOURTEEN, 2.5, 2), across=True),
]
TX40_PAIRS = [
    _open("TX40", "first 4 s → rest", _span("TX40", 0, 4), _span("TX40", 4), options=WRIST, quick=True),
    _open("TX40", "first 4 s → rest, coupling not stated", _span("TX40", 0, 4), _span("TX40", 4)),
    _open("TX40", "first 2.7 s → rest", _span("TX40", 0, 2.7), _span("TX40", 2.7), options=WRIST),
    _open("TX40", "first 1.5 s → rest", _span("TX40", 0, 1.5), _span("TX40", 1.5), options=WRIST),
    _open("TX40", "2 s from 1 s on → rest, coupling not stated", _span("TX40", 1, 3), _span("TX40", 3)),
    _open(
        "TX40", "slow windows → fast ones", _speeds("TX40", FILES["TX40"], 0.9), across=True, options=WRIST, quick=True
    ),
    _open("TX40", "slow windows → fast ones, coupling not stated", _speeds("TX40", FILES["TX40"], 0.9), across=True),
    _open("TX40", "low joint 3 → high joint 3", _reach("TX40", FILES["TX40"], 0.9, 3), across=True, options=WRIST),
]
KR300_PAIRS = [
    _open("KR300", "A → B", [Part("A")], [Part("B")], across=True, quick=True),
    _open("KR300", "B → A", [Part("B")], [Part("A")], across=True),
    _open("KR300", "5 s of A → B", [Part("A", 0, 5)], [Part("B")], across=True),
    _open("KR300", "3 s of B → rest of B", [Part("B", 2, 5)], [Part("B", 5, 10)]),
    _open("KR300", "slow windows of A → fast ones", _speeds("KR300", "A", 1.25), across=True),
]
TIAGO_PAIRS = [
    _open("TIAGo", "first half → second half", _span("TIAGo", 9, 38), _span("TIAGo", 38, 67), quick=True),
    _open("TIAGo", "second half → first half", _span("TIAGo", 38, 67), _span("TIAGo", 9, 38)),
    _open("TIAGo", "10 s → next 20 s", _span("TIAGo", 20, 30), _span("TIAGo", 30, 50)),
    _open("TIAGo", "slow windows → fast ones", _speeds("TIAGo", FILES["TIAGo"], 4.0), across=True),
]
LWR4PLUS_PAIRS = [
    _open(
        "LWR4+",
        "one sinusoid, first half → second half",
        _span("LWR4+", 2.5, 8.75),
        _span("LWR4+", 8.75, 15),
        across=True,
        quick=True,
    ),
    _open(
        "LWR4+",
        "one sinusoid, second half → first half",
        _span("LWR4+", 8.75, 15),
        _span("LWR4+", 2.5, 8.75),
        across=True,
    ),
    _open("LWR4+", "one sinusoid, 4 s → next 10 s", _span("LWR4+", 5, 9), _span("LWR4+", 9, 19), across=True),
]
OPEN = [*PANDA_PAIRS, *UR10E_PAIRS, *TX40_PAIRS, *KR300_PAIRS, *TIAGO_PAIRS, *LWR4PLUS_PAIRS]


# simulated recordings


@dataclass(frozen=True)
class Simulated:
    """A simulated pair: arm, sensors, friction, motions.

    Attributes:
        arm: of the library.
        masses: the description has them, somewhat wrong.
        behind: sensors behind the gears; else the motors' torques.
        family: of friction.
        train, test: motion, its seconds, and settings of it.
        rate: of the log [Hz].
        coupled, coupling_stated: the last motor turns with the last two joints; the options say so.
        payload: the test is with one.
        cold: the training begins cold, the test is warm.
    """

    name: str
    arm: str
    family: str
    train: tuple
    test: tuple
    across: bool
    masses: bool = True
    behind: bool = False
    rate: float = 200.0
    coupled: bool = False
    coupling_stated: bool = True
    payload: bool = False
    cold: bool = False
    quick: bool = False

    def prepare(self, folder: Path) -> Prepared:
        """Write the robot description, the recordings and the options of a pair."""
        seed = sum(map(ord, self.name))
        robot = simulated.arm(self.arm)
        described = robot.inertias if self.masses else None
        description = simulated.write_urdf(robot, described, folder / "robot.urdf")
        true_inertias = simulated.wrong(robot.inertias, seed)
        true = simulated.write_urdf(robot, true_inertias, folder / "true.urdf")
        recorded = partial(
            simulated.record,
            robot,
            true,
            arm_seed=seed,
            family=self.family,
            rate=self.rate,
            behind=self.behind,
            coupled=self.coupled,
        )
        motion, seconds, settings = self.train
        q = motion(robot, seconds, 2 * seed, **settings)
        warm_up = 0.0 if self.cold else simulated.WARM
        train = recorded(q=q, path=folder / "train_0.npz", seed=2 * seed, cold=warm_up)
        motion, seconds, settings = self.test
        q = motion(robot, seconds, 2 * seed + 1, **settings)
        payload = PAYLOAD if self.payload else None
        test = recorded(q=q, path=folder / "test_0.npz", seed=2 * seed + 1, payload=payload)
        return Prepared(description, [train], [test], self._options(), self.masses, payload)

    def _options(self) -> str:
        """Return the text of the options file: coupling and payload, where they are stated."""
        options = ""
        if self.coupled and self.coupling_stated:
            options += WRIST
        if self.payload:
            options += f"[payload.tool]\nmass = {PAYLOAD['mass']}\ncom = {PAYLOAD['com']}\n"
            options += '[files."test_0.npz"]\npayload = ["tool"]\n'
        return options


def slow(seconds: float, **settings) -> tuple:
    """Return a slow Fourier motion over a small range."""
    return fourier, seconds, {"reach": 0.35, "speed": 0.12, "period": 12.0, **settings}


def rich(seconds: float, **settings) -> tuple:
    """Return a Fourier motion over most of the range at half the speed."""
    return fourier, seconds, {"reach": 0.7, "speed": 0.5, **settings}


FAST = (fourier, 12.0, {"reach": 0.8, "speed": 0.9, "period": 6.0})
FASTER = (fourier, 12.0, {"reach": 0.6, "speed": 0.35, "period": 8.0})
POOR = (sine, 25.0, {})
SIMULATED_SENSORS = [
    Simulated("LWR4+ sensors, one sinusoid → fast", "lwr4plus", "simple", POOR, FAST, True, behind=True, quick=True),
    Simulated(
        "LWR4+ sensors, one sinusoid → rich",
        "lwr4plus",
        "position",
        POOR,
        rich(12),
        True,
        behind=True,
        masses=False,
        quick=True,
    ),
    Simulated(
        "LWR4+ sensors, half a sinusoid → faster", "lwr4plus", "lugre", (sine, 7.0, {}), FASTER, True, behind=True
    ),
    Simulated(
        "Panda sensors, one sinusoid → faster",
        "panda",
        "stribeck",
        POOR,
        FASTER,
        True,
        behind=True,
        masses=False,
        quick=True,
    ),
    Simulated("iiwa sensors, one sinusoid → faster", "iiwa14", "lugre", POOR, FASTER, True, behind=True, masses=False),
    Simulated(
        "LWR4+ sensors, one small sinusoid → faster",
        "lwr4plus",
        "simple",
        (sine, 25.0, {"reach": 0.2}),
        FASTER,
        True,
        behind=True,
        masses=False,
    ),
    Simulated(
        "Panda sensors, slow → fast with payload",
        "panda",
        "lugre",
        slow(20),
        FAST,
        True,
        behind=True,
        masses=False,
        payload=True,
    ),
    Simulated(
        "iiwa sensors, one sinusoid → faster with payload",
        "iiwa14",
        "stribeck",
        POOR,
        FASTER,
        True,
        behind=True,
        payload=True,
    ),
    Simulated(
        "iiwa sensors, each joint alone → all",
        "iiwa14",
        "position",
        (each_alone, 28.0, {}),
        rich(12),
        True,
        behind=True,
        masses=False,
        quick=True,
    ),
    Simulated("iiwa sensors, 1.5 s → rich", "iiwa14", "simple", rich(1.5), rich(12), False, behind=True),
    Simulated("Panda sensors, 10 s → rich", "panda", "position", rich(10), rich(12), False, behind=True, masses=False),
    Simulated("LWR4+ sensors, 3 s → rich", "lwr4plus", "asymmetric", rich(3), rich(12), False, behind=True),
]
SIMULATED_MOTORS = [
    Simulated("LWR4+ motors, one sinusoid → fast", "lwr4plus", "lugre", POOR, FAST, True),
    Simulated("iiwa motors, slow → fast", "iiwa14", "stribeck", slow(20), FAST, True, masses=False),
    Simulated("RV-2SQ, 2 s → rich", "rv2sq", "stribeck", rich(2), rich(10), False, quick=True),
    Simulated("RV-2SQ, 2 s → points", "rv2sq", "lugre", rich(2), (points, 10.0, {}), True),
    Simulated("RV-2SQ, cold 20 s → warm fast", "rv2sq", "warming", rich(20), FAST, True, cold=True),
    Simulated("RV-2SQ, points → rich", "rv2sq", "asymmetric", (points, 15.0, {}), rich(10), True),
    Simulated("RV-2SQ, 10 s → rich with payload", "rv2sq", "position", rich(10), rich(10), True, payload=True),
    Simulated("TX40, 5 s → rich", "tx40", "stribeck", rich(5), rich(10), False, coupled=True, quick=True),
    Simulated(
        "TX40, 5 s → rich, coupling not stated",
        "tx40",
        "lugre",
        rich(5),
        rich(10),
        False,
        coupled=True,
        coupling_stated=False,
        quick=True,
    ),
    Simulated(
        "TX40, 5 s slow → fast, coupling not stated",
        "tx40",
        "stribeck",
        slow(5),
        FAST,
        True,
        coupled=True,
        coupling_stated=False,
    ),
    Simulated("TX40, each joint alone → all", "tx40", "simple", (each_alone, 24.0, {}), rich(10), True, coupled=True),
    Simulated("TX40, one sinusoid → fast with payload", "tx40", "lugre", POOR, FAST, True, coupled=True, payload=True),
    Simulated("TX40, 2 s → fast", "tx40", "asymmetric", rich(2), FAST, True, coupled=True),
    Simulated("UR10e, 2 s → rich", "ur10e", "lugre", rich(2), rich(10), False, masses=False, quick=True),
    Simulated("UR5, 2 s → faster", "ur5", "position", rich(2), FASTER, True, masses=False),
    Simulated("UR5, one sinusoid → faster", "ur5", "stribeck", POOR, FASTER, True),
    Simulated("UR10e, 2 s of points → rich", "ur10e", "stribeck", (points, 2.5, {}), rich(10), True, masses=False),
    Simulated(
        "UR10e, one sinusoid → faster with payload", "ur10e", "stribeck", POOR, FASTER, True, payload=True, quick=True
    ),
    Simulated(
        "UR10e, each joint alone → all", "ur10e", "position", (each_alone, 24.0, {}), rich(10), True, masses=False
    ),
    Simulated("UR10e, 60 s → rich", "ur10e", "lugre", rich(60), rich(10), False, rate=100.0),
    Simulated("UR5, 5 s → points", "ur5", "position", rich(5), (points, 10.0, {}), True),
    Simulated("UR5, cold 15 s → warm", "ur5", "warming", rich(15), rich(10), False, masses=False, cold=True),
    Simulated("UR5, slow → fast", "ur5", "asymmetric", slow(30), FAST, True, rate=100.0),
    Simulated("UR5, 8 s → rich", "ur5", "stribeck", rich(8), rich(10), False, masses=False),
]
SIMULATED_PAIRS = []
for simulation in [*SIMULATED_SENSORS, *SIMULATED_MOTORS]:
    pair = Pair(f"sim. {simulation.name}", simulation.across, simulation.prepare, simulation.quick)
    SIMULATED_PAIRS.append(pair)

PAIRS = [*OPEN, *SIMULATED_PAIRS]
