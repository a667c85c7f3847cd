"""The nominal arm beside the calibrated one, on the same rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.data.measurements import PoseMeasurements
from calib.geometry.accuracy import Errors, errors, pair_errors, statistics, summary
from calib.geometry.first_guess import install
from calib.geometry.fit import polish_frames
from calib.geometry.installation import Installation
from calib.geometry.weighing import Settings
from calib.procedure.inputs import Unseen, pose_count

Torques = list[np.ndarray | None]


@dataclass(frozen=True, eq=False)
class Comparison:
    """The two arms on the same rows.

    Attributes:
        blocks: the rows.
        torques: gravity torques (m, n) per block, or None [N m].
        cells: nominal and calibrated installation that predict them.
        errors: of each.
        pairs: errors of the distances between pairs of positions, of each [m].
        poses: how many robot poses.
        frames: whose base and tool placement was used, in words.
        proves: False where the rows were fitted on.
    """

    blocks: tuple[PoseMeasurements, ...]
    torques: Torques
    cells: tuple[Installation, Installation]
    errors: tuple[Errors, Errors]
    pairs: tuple[np.ndarray, np.ndarray]
    poses: int
    frames: str
    proves: bool = True

    def table(self) -> dict[str, object]:
        """Return the comparison as ``metrics.json`` holds it."""
        arms = ("nominal", "calibrated")
        result: dict[str, object] = {"poses": self.poses, "frames": self.frames}
        result |= {arm: summary(found) for arm, found in zip(arms, self.errors)}
        if len(self.pairs[0]):
            result["pair_distance_mm"] = {arm: statistics(sizes, 1e3) for arm, sizes in zip(arms, self.pairs)}
        return result


def compare(
    nominal: Installation,
    calibrated: Installation,
    blocks: Sequence[PoseMeasurements],
    torques: Torques,
    frames: str,
    proves: bool = True,
    seed: int = 0,
) -> Comparison:
    """Return both arms' errors on some rows."""
    cells = nominal, calibrated
    one, two = (errors(cell, blocks, torques) for cell in cells)
    first, second = (pair_errors(cell, blocks, torques, seed=seed) for cell in cells)
    return Comparison(tuple(blocks), torques, cells, (one, two), (first, second), pose_count(blocks), frames, proves)


def compare_unseen(
    nominal: Installation,
    calibrated: Installation,
    unseen: Unseen,
    torque_of: Callable[[PoseMeasurements], np.ndarray | None],
    settings: Settings,
    seed: int = 0,
) -> Comparison:
    """Return both arms' errors on unseen rows, their frames refitted where the rows have frames of their own."""
    block = unseen.block
    torques = [torque_of(block)]
    if unseen.own_frames:
        nominal, calibrated = (place(cell, block, torques, settings) for cell in (nominal, calibrated))
        words = "base and tool placement refitted on these rows"
    elif unseen.held_out:
        words = "those of the fit"
    else:
        words = (
            f"those of the fit, station '{block.station}'" if block.kind in ("pose", "position") else "tool of the fit"
        )
    return compare(nominal, calibrated, [block], torques, words, not unseen.seen, seed)


def place(cell: Installation, block: PoseMeasurements, torques: Torques, settings: Settings) -> Installation:
    """Return an arm, deflections included, with base and tool placement fitted on a block and nothing else."""
    start = replace(install(cell.chain, [block], cell.known), deflection=cell.deflection)
    return polish_frames(start, [block], settings, torques).cell
