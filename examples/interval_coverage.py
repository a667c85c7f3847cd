"""How the errors that a fit states hold on real recordings: one row per recording and split.

CALIB_DATA=... python examples/interval_coverage.py
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import calib
from calib.api.kinematic import GeometryFit
from calib.data.poses.measurements import take
from calib.geometry.model_choice.folds import region_folds
from calib.procedure.kinematic_stage.inputs import gather
from calib.procedure.kinematic_stage.settings import FitSettings

DATA = Path(os.environ.get("CALIB_DATA", "data"))
UR10, UR5, MOTOMAN = DATA / "ur10_ipa", DATA / "ur5_gts3800", DATA / "motoman_leica"
RECORDINGS = {
    "UR5": (UR5 / "model.urdf", UR5 / "grid_800.csv", 0.25),
    "UR10 A": (UR10 / "model.urdf", UR10 / "A_grid_2500.csv", 0.4),
    "UR10 B": (UR10 / "model.urdf", UR10 / "B_joint_configurations.csv", 0.4),
    "Motoman small": (MOTOMAN / "model_right.urdf", MOTOMAN / "right_6x6x6_150.csv", 1 / 3),
    "Motoman wide": (MOTOMAN / "model_right.urdf", MOTOMAN / "right_wide_386.csv", 0.25),
}
STATIONS = (
    ("UR10 A", "UR10 B"), ("UR10 B", "UR10 A"), ("Motoman small", "Motoman wide"), ("Motoman wide", "Motoman small"),
)  # fmt: skip
REGION_SEED = 7  # regions that are none of the fit's own folds


def row(name: str, split: str, fits: list[GeometryFit]) -> str:
    """Return a row of the table: errors and intervals of the unseen rows of some fits together."""
    found = [each for fit in fits for each in fit.outcome.validation.values() if each.intervals is not None]
    sizes, radii, beyond = (
        np.concatenate([getattr(each.intervals, key) for each in found]) for key in ("size", "radius", "beyond")
    )
    rms, covered = 1e3 * np.sqrt(np.mean(sizes**2)), 100 * np.mean(sizes <= radii)
    return (
        f"| {name} | {split} | {len(sizes)} | {rms:.3f} | {covered:.1f} % | {1e3 * np.median(radii):.3f} | "
        f"{100 * np.mean(beyond):.0f} % |"
    )


def regions(robot: Path, file: Path) -> Iterator[GeometryFit]:
    """Yield a fit per region of the joint space that is left out."""
    block = gather(robot, [file], settings=FitSettings()).fit[0]
    folds = region_folds([block], seed=REGION_SEED)
    for fold in range(folds.count):
        inside = folds.members[0] == fold
        left_out = replace(take(block, np.flatnonzero(inside)), file=f"region {fold + 1}")
        yield calib.fit_geometry(robot, take(block, np.flatnonzero(~inside)), FitSettings(), validate=left_out)


def main() -> None:
    print("| recording | split | unseen rows | rms [mm] | within 95 % interval | median interval [mm] | extrapolated |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for name, (robot, file, share) in RECORDINGS.items():
        held_out = calib.fit_geometry(robot, file, FitSettings(holdout=share))
        print(row(name, f"{100 * share:.0f} % at random", [held_out]), flush=True)
        print(row(name, "each region left out", list(regions(robot, file))), flush=True)
    for one, other in STATIONS:
        robot, file, _ = RECORDINGS[one]
        fit = calib.fit_geometry(robot, file, FitSettings(refit_frames=True), validate=RECORDINGS[other][1])
        print(row(one, f"→ {other}", [fit]), flush=True)


if __name__ == "__main__":
    main()
