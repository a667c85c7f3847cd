"""Rows of one file in two conventions: orientations in two readings, and values in two units.

Orientations: positions alone place the instrument, S. With the arm's rotations R_i and orientations B_i in some
reading, X_i = R_iᵀ Sᵀ B_i is the target's orientation on the tip, the same in all rows that are in this reading. Two
readings are reported if some X agrees with nearly all rows in one of them or the other, and not in one alone; two
random rotations agree within `SAME_ANGLE` with a chance of 1e-6.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.column_changes import Change
from calib.data.poses.measurements import PoseMeasurements, Poses, Positions, take
from calib.data.poses.plausible import from_angles, to_angles
from calib.errors import CalibError, Finding, finding
from calib.geometry.checks.wrong_rows import Blocks
from calib.geometry.first_guess import checked_rows, install
from calib.geometry.installation import Installation
from calib.robot.kinematics import forward
from calib.units import DEG

# conventions for orientation angles that robot makers use; others are rare (our choice)
CONVENTIONS = ("vector", "xyz fixed", "xyz moving", "zyx fixed", "zyx moving", "zyz moving", "zxz moving")
# largest angle between orientations on the tip that agree: above the errors of a nominal arm (our choice) [rad]
SAME_ANGLE = 2.0 * DEG
# smallest share of rows that agree in one of two readings; angles beyond a convention's range are lost (our choice)
MIN_SHARE = 0.75
# smallest number of rows that agree in one reading only, and of rows in another unit (our choice)
MIN_PART = 4
# order of the numbers x y z w of a quaternion as read, where the file has them in another order
ORDERS = {"a quaternion w x y z, read as x y z w": [1, 2, 3, 0], "a quaternion x y z w, read as w x y z": [3, 0, 1, 2]}
# largest ratio of a change of the values' size to the factor that is tried, or of its inverse (our choice)
MAX_RATIO = 5.0


@dataclass(frozen=True)
class Confusion:
    """Two units that are confused.

    Attributes:
        of_joints: whether they are units of joints; otherwise of positions.
        factor: number of the smaller unit in the larger one.
        smaller: what rows are that are too small by the factor.
        larger: what rows are that are too large by the factor.
    """

    of_joints: bool
    factor: float
    smaller: str
    larger: str

    @property
    def quantity(self) -> str:
        """The values that are in two units."""
        return "joint values" if self.of_joints else "positions"


UNITS = (
    Confusion(False, 1e3, "m among mm", "mm among m"),
    Confusion(False, 25.4, "inches among mm", "mm among inches"),
    Confusion(True, 1.0 / DEG, "rad among deg", "deg among rad"),
)


@dataclass(frozen=True, eq=False)
class Parts:
    """Rows that agree with the arm in two readings.

    Attributes:
        count: number of rows that agree in one of them.
        first, second: numbers of the readings.
        in_first, in_second: (m,) whether a row agrees in each of them.
    """

    count: int
    first: int
    second: int
    in_first: np.ndarray
    in_second: np.ndarray


def mixed_orientations(nominal: Installation, blocks: Blocks) -> list[Finding]:
    """Return findings on blocks whose orientations agree with the arm in two readings, each in a part of the rows.

    Args:
        nominal: the nominal arm.
        blocks: the measurements.
    """
    findings = []
    for block in blocks:
        if not isinstance(block, Poses) or block.lever is not None or block.base is not None:
            continue
        sample = take(block, checked_rows(block))
        names, agrees = _agreement(nominal, sample)
        parts = _parts(agrees)
        if parts is None or parts.count < MIN_SHARE * len(sample):
            continue
        start = np.flatnonzero(parts.in_first != parts.in_first[0])[0]
        in_second_only = parts.in_second & ~parts.in_first
        readings = [(sample.rows[parts.in_first], names[parts.first])]
        readings.append((sample.rows[in_second_only], names[parts.second]))
        # the reading of the first row first
        readings.sort(key=lambda rows_and_reading: rows_and_reading[0][0])
        values: dict[str, object] = {"start": int(sample.rows[start])}
        for ordinal, (rows, reading) in zip(("first", "second"), readings):
            values |= {f"{ordinal}_rows": row_runs(rows), f"{ordinal}_reading": reading}
        findings.append(finding("orientations-mixed", file=Path(block.file).name or "measurements", **values))
    return findings


def row_runs(rows: np.ndarray) -> list[str]:
    """Return increasing row numbers as runs without gaps, such as ``1–20``."""
    breaks = np.flatnonzero(np.diff(rows) > 1) + 1
    return [f"{run[0]}–{run[-1]}" if len(run) > 1 else str(run[0]) for run in np.split(rows, breaks)]


def _agreement(nominal: Installation, block: Poses) -> tuple[list[str], np.ndarray]:
    """Return the names of k readings, and whether each row in each of them agrees with a candidate for X (k, m, k m).

    The candidates are the orientations on the tip of all rows in all readings.

    Args:
        nominal: the nominal arm.
        block: measured poses of one target.
    """
    positions = Positions(block.q, block.joint_names, block.position, file=block.file, rows=block.rows)
    try:
        station = install(nominal.chain, [positions], nominal.known).stations[0]
    except CalibError:
        # too few rows, or another unit: other checks say so
        return [], np.zeros((0, len(block), 0), dtype=bool)
    arm = Rotation.from_matrix(station[:3, :3] @ forward(nominal.chain, block.q)[:, :3, :3])
    names = []
    on_tip = []
    for name, turns in _readings(block):
        names.append(name)
        on_tip.append((arm.inv() * turns).as_quat())
    orientations = np.stack(on_tip)
    cosines = np.abs(orientations @ orientations.reshape(-1, 4).T)
    return names, cosines > math.cos(0.5 * SAME_ANGLE)


def _readings(block: Poses) -> Iterator[tuple[str, Rotation]]:
    """Yield the names and orientations (m) of the readings that are tried, the block's first.

    Args:
        block: measured poses.
    """
    turns = Rotation.from_quat(block.quaternion)
    if block.euler:
        yield f"{block.euler}, as stated", turns
        angles = to_angles(turns, block.euler)
        for convention in CONVENTIONS:
            if convention != block.euler:
                yield convention, from_angles(angles, convention)
        yield "rad among deg", from_angles(angles / DEG, block.euler)
        yield "deg among rad", from_angles(angles * DEG, block.euler)
    else:
        yield "read", turns
        for name, order in ORDERS.items():
            yield name, Rotation.from_quat(np.asarray(block.quaternion)[:, order])
    yield "the inverse (of the instrument in the target's frame)", turns.inv()


def _parts(agrees: np.ndarray) -> Parts | None:
    """Return the two readings in which together most rows agree; None if no two have rows that agree in one only.

    Args:
        agrees: (k, m, c) whether each row in each reading agrees with each candidate.
    """
    best = None
    for first, second in combinations(range(len(agrees)), 2):
        only_first = agrees[first] & ~agrees[second]
        only_second = agrees[second] & ~agrees[first]
        fewer = np.minimum(only_first.sum(axis=0), only_second.sum(axis=0))
        count = np.where(fewer < MIN_PART, 0, (agrees[first] | agrees[second]).sum(axis=0))
        number = int(np.argmax(count))
        if count[number] > (best.count if best else 0):
            best = Parts(int(count[number]), first, second, agrees[first][:, number], agrees[second][:, number])
    return best


def unit_changes(nominal: Installation, blocks: Blocks, max_left: float) -> list[Change]:
    """Return possible changes to the blocks: the rows of one block before or after some row are in another unit.

    Tried are those of which the values' size changes by about the factor between two units.

    Args:
        nominal: the nominal arm.
        blocks: the measurements.
        max_left: largest rms error with the rows converted, as a share of that as recorded.
    """
    turning = np.array([joint.kind != "prismatic" for joint in nominal.chain.joints])
    changes = []
    for number, block in enumerate(blocks):
        if not isinstance(block, Positions) or len(block) < 2 * MIN_PART:
            continue
        for unit in UNITS:
            numbers = block.q[:, turning] if unit.of_joints else block.position
            sizes = np.linalg.norm(numbers, axis=1)
            cut = _size_change(sizes)
            times = np.median(sizes[:cut]) / max(float(np.median(sizes[cut:])), 1e-300)
            # the later rows are smaller, or the earlier ones
            rows = block.rows[cut:]
            if times < 1.0:
                rows = block.rows[:cut]
                times = 1.0 / max(float(times), 1e-300)
            if not 1.0 / MAX_RATIO < times / unit.factor < MAX_RATIO:
                continue
            remainder = block.rows[~np.isin(block.rows, rows)]
            for part, factor, units in ((rows, unit.factor, unit.smaller), (remainder, 1.0 / unit.factor, unit.larger)):
                scale = np.where(turning, factor, 1.0) if unit.of_joints else factor
                make = partial(_converted, number, unit.of_joints, scale, part)
                values = {"what": unit.quantity, "units": units, "factor": factor, "file": block.file}
                values |= {"first": int(part[0]), "last": int(part[-1])}
                changes.append(Change("units-mixed", make, (), values, max_left))
    return changes


def _size_change(sizes: np.ndarray) -> int:
    """Return the index of the row from which on sizes (m,) differ most from those before, by their logarithms."""
    logarithms = np.log(np.maximum(sizes, 1e-12))
    cuts = np.arange(MIN_PART, len(sizes) - MIN_PART + 1)
    sums = np.cumsum(logarithms)
    before = sums[cuts - 1] / cuts
    after = (sums[-1] - sums[cuts - 1]) / (len(sizes) - cuts)
    weight = cuts * (len(sizes) - cuts)
    return int(cuts[np.argmax(weight * (before - after) ** 2)])


def _converted(
    number: int, of_joints: bool, factor: float | np.ndarray, rows: np.ndarray, blocks: Blocks
) -> list[PoseMeasurements]:
    """Return the blocks with joint values or positions of some rows of the block `number` multiplied by a factor."""
    block = blocks[number]
    assert isinstance(block, Positions)
    chosen = np.isin(block.rows, rows)[:, None]
    if of_joints:
        changed = replace(block, q=np.where(chosen, block.q * factor, block.q))
    else:
        changed = replace(block, position=np.where(chosen, block.position * factor, block.position))
    return [*blocks[:number], changed, *blocks[number + 1 :]]
