"""Every method on real recordings (`calib compare`): a table per robot, which is made once and kept.

    CALIB_DATA=… python examples/survey/recordings.py --out examples/survey/recordings

A table that is there already is left as it is, so that a run that was stopped goes on. The recordings hold no
reference, so that methods that simulate the closed loop do not run (with a fitted one: `examples/real_instruments.py`).
What each one is: `examples/real_recordings.md`.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from calib.cli import run


@dataclass(frozen=True)
class RobotRecordings:
    """A robot's recordings and how they are read.

    Attributes:
        train: recordings to identify from, in the robot's folder.
        unseen: recordings to judge by.
        options: text of the options file.
    """

    train: tuple[str, ...]
    unseen: tuple[str, ...]
    options: str = ""


# Joint 6 of the TX40 moves with joint 5.
TX40_OPTIONS = """\
[[coupling]]
joints = [5, 6]
label = "6"
"""
# Torque constants of the drives [N m/A].
UR10E_OPTIONS = "gains = [14.87, 13.26, 11.13, 10.62, 11.03, 11.47]\n"
ROBOTS = {
    "franka_panda_inria": RobotRecordings(("traj1_first60pct.npz@0:9.387",), ("traj1_first60pct.npz@9.387:11.9",)),
    "staubli_tx40": RobotRecordings(("tx40_first_5p4s.npz@0:4",), ("tx40_first_5p4s.npz@4:",), TX40_OPTIONS),
    "ur10e_innopolis": RobotRecordings(
        ("ur-20_02_10-30sec_12harm.npz",), ("ur-20_02_19_14harm50sec.npz",), UR10E_OPTIONS
    ),
    "kuka_lwr4plus_iit": RobotRecordings(("measurements_1.npz@2.5:8.75",), ("measurements_1.npz@8.75:15",)),
}


def compare(name: str, data: Path, out: Path) -> int:
    """Write the table of one robot; return the command's exit code.

    Args:
        name: name of the robot, one of `ROBOTS`.
        data: folder of the robots' folders.
        out: folder of the tables.
    """
    recordings = ROBOTS[name]
    folder = data / name
    arguments = ["compare", str(folder / "model.urdf")]
    arguments += [str(folder / path) for path in recordings.train]
    for path in recordings.unseen:
        arguments += ["--validate", str(folder / path)]
    with tempfile.TemporaryDirectory() as scratch:
        options = Path(scratch) / "options.toml"
        options.write_text(recordings.options)
        return run([*arguments, "--options", str(options), "--out", str(out / f"{name}.csv")])


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("CALIB_DATA", "../shared/data")))
    parser.add_argument("--out", type=Path, default=Path("survey-recordings"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    codes = [0]
    for name in ROBOTS:
        table = arguments.out / f"{name}.csv"
        if (arguments.data / name).is_dir() and not table.exists():
            codes.append(compare(name, arguments.data, arguments.out))
    return max(codes)


if __name__ == "__main__":
    sys.exit(main())
