"""A fleet of virtual robots, geometry only, by one process and by two: wall seconds, and the same results.

python tests/benchmarks/fleet.py --out DIR [--robots 20]
"""

import argparse
import shutil
import time
from pathlib import Path

from calib.apps.cell_demo import demo
from calib.apps.fleet import fleet
from calib.procedure.session import steps
from calib.procedure.session.commands import new_session
from calib.procedure.session.folder import locked, open_session
from calib.simulation.virtual_cells import virtual_cell

ROBOTS = ("ur5", "ur10e", "panda", "tx40")


def quiet(words: str) -> None:
    """Say nothing."""


def prepare(folder: Path, number: int) -> None:
    """Make a session whose measurements are there and whose steps are all to be made."""
    robot = ROBOTS[number % len(ROBOTS)]
    session = open_session(new_session(folder, robot, "cmm", seed=number, dynamics=False))
    with locked(session, quiet):
        steps.run_next(session, quiet, quiet, "benchmark")
    demo.simulate_measurements(session, virtual_cell(robot, number), number)
    session.path("state.json").unlink()


def timed(folders: list[Path], processes: int) -> tuple[float, list[float | None]]:
    """Return wall seconds and the calibrated errors [mm]."""
    started = time.perf_counter()
    found = fleet.run_sessions(folders, workers=processes, command="benchmark")
    outcomes = sorted(found, key=lambda one: one.folder)
    print(fleet.summary(outcomes, time.perf_counter() - started))
    return time.perf_counter() - started, [one.calibrated for one in outcomes]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--robots", type=int, default=20)
    given = parser.parse_args()
    for number in range(given.robots):
        prepare(given.out / f"two/r{number:02d}", number)
    shutil.copytree(given.out / "two", given.out / "one")
    two, errors = timed(sorted((given.out / "two").iterdir()), 2)
    one, same = timed(sorted((given.out / "one").iterdir()), 1)
    print(f"{given.robots} robots: {one:.1f} s by one process, {two:.1f} s by two, ratio {one / two:.2f}")
    print(f"same results: {errors == same}")


if __name__ == "__main__":
    main()
