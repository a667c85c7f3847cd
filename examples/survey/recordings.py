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
class Recorded:
    """A robot's recordings: learnt from, unseen, and how they are read."""

    train: tuple[str, ...]
    unseen: tuple[str, ...]
    options: str = ""


ROBOTS = {
    "franka_panda_inria": Recorded(("traj1_first60pct.npz@0:9.387",), ("traj1_first60pct.npz@9.387:11.9",)),
    "staubli_tx40": Recorded(
        ("tx40_first_5p4s.npz@0:4",), ("tx40_first_5p4s.npz@4:",), '[[coupling]]\njoints = [5, 6]\nlabel = "6"\n'
    ),
    "ur10e_innopolis": Recorded(
        ("ur-20_02_10-30sec_12harm.npz",), ("ur-20_02_19_14harm50sec.npz",),
        "gains = [14.87, 13.26, 11.13, 10.62, 11.03, 11.47]\n",
    ),
    "kuka_lwr4plus_iit": Recorded(("measurements_1.npz@2.5:8.75",), ("measurements_1.npz@8.75:15",)),
}  # fmt: skip


def compare(name: str, data: Path, out: Path) -> int:
    """Write the table of one robot; return the command's exit code."""
    one, folder = ROBOTS[name], data / name
    with tempfile.TemporaryDirectory() as scratch:
        options = Path(scratch) / "options.toml"
        options.write_text(one.options)
        words = ["compare", str(folder / "model.urdf"), *(str(folder / path) for path in one.train)]
        for path in one.unseen:
            words += ["--validate", str(folder / path)]
        return run([*words, "--options", str(options), "--out", str(out / f"{name}.csv")])


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("CALIB_DATA", "../shared/data")))
    parser.add_argument("--out", type=Path, default=Path("survey-recordings"))
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    codes = [
        compare(name, given.data, given.out)
        for name in ROBOTS
        if not (given.out / f"{name}.csv").exists() and (given.data / name).is_dir()
    ]
    return max(codes, default=0)


if __name__ == "__main__":
    sys.exit(main())
