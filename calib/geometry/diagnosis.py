"""Checks of measurements against the model: changed set-up, systematic residuals, changed columns, a scale factor.

Changed columns (joint signs, exchanged joints, mirrored axes, angles of another convention): the nominal arm, base and
tool placement free, explains rows as measured and with each change; the errors of a sound arm are small compared with
either.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from calib.column_changes import Change, Explanation, best_changes, coupling, couplings, exchange, reversal, standing
from calib.data.poses.measurements import PoseMeasurements, Poses, Positions, take
from calib.data.poses.plausible import from_angles, to_angles
from calib.errors import CalibError, Finding, finding
from calib.geometry.accuracy import errors
from calib.geometry.checks.wrong_rows import Blocks, least_error, row_shifts, two_targets
from calib.geometry.first_guess import install
from calib.geometry.fit import polish_frames
from calib.geometry.installation import Installation
from calib.geometry.observation import Block, layout, observe, positions, prepare
from calib.geometry.residuals import Part
from calib.geometry.weighing import GeometricFit, Settings
from calib.records import evenly
from calib.robot.chain import Chain, element_length

MIN_LENGTH = 0.01  # [m]: shorter lengths, and growth that moves targets by less per unit, say nothing of a factor
MIN_ROWS = 30  # rows below which no pattern is looked for (our choice)


def diagnose(found: GeometricFit, with_changes: bool = True) -> list[Finding]:
    """Return findings on each block: systematic residuals, and `with_changes` rows that fit worse than the others."""
    result: list[Finding] = []
    for block, part in _lengths(found):
        if part.value.shape[1] >= MIN_ROWS:  # pairs of rows count once
            result += [*(_setup_change(block, part) if with_changes else []), *_systematic(block, part)]
    return result


def _lengths(found: GeometricFit) -> list[tuple[Block, Part]]:
    """Return each block with its first residual part, which is in metres for every kind of measurement."""
    first = {piece.block: piece.part.per_row() for piece in reversed(found.pieces)}
    return [(block, first[number]) for number, block in enumerate(found.blocks)]


def _setup_change(block: Block, part: Part, max_chance: float = 1e-3, min_ratio: float = 1.6) -> list[Finding]:
    """Return a finding if the set-up changed: the residuals before and after one row differ in size and rank.

    `max_chance`: probability that the same rows in another order show such a change (our choice).

    `min_ratio`: a set-up's errors over the rest's from which on it is worth a word (our choice).
    """
    size = np.linalg.norm(part.value, axis=0)
    size = np.minimum(size, 4.0 * np.median(size))  # a few gross rows are not a set-up
    m = len(size)
    cuts = np.arange(max(10, m // 20), m - max(10, m // 20))
    energy = np.cumsum(size**2)
    before = np.sqrt(energy[cuts - 1] / cuts)
    after = np.sqrt((energy[-1] - energy[cuts - 1]) / (m - cuts))
    ratio = np.maximum(before / np.maximum(after, 1e-15), after / np.maximum(before, 1e-15))
    weight = np.minimum(cuts, m - cuts)
    best = int(np.argmax((ratio - 1.0) * np.sqrt(weight)))
    cut, first_worse = int(cuts[best]), before[best] > after[best]
    if ratio[best] < min_ratio:
        return []
    from scipy.stats import mannwhitneyu  # slow to load, and seldom needed

    if float(mannwhitneyu(size[:cut], size[cut:]).pvalue) * len(cuts) > max_chance:  # Bonferroni: the best of many cuts
        return []
    rows = block.measured.rows[part.index]
    bad = (rows[0], rows[cut - 1]) if first_worse else (rows[cut], rows[-1])
    worse, rest = (before[best], after[best]) if first_worse else (after[best], before[best])
    return [finding("set-up-changed", file=_name(block), first=bad[0], last=bad[1], worse=worse, rest=rest)]


def _systematic(block: Block, part: Part, max_times: float = 5.0) -> list[Finding]:
    """Return findings on systematic residuals: noise differs between neighbouring poses, a missing effect does not.

    `max_times`: factor above a stated uncertainty from which residuals give a finding (our choice).
    """
    floor, rms = neighbour_floor(block.measured.q, part), float(np.sqrt(np.mean(np.sum(part.value**2, axis=0))))
    stated = None if part.sigma is None else float(np.sqrt(np.mean(np.sum(part.sigma**2, axis=0))))
    result = []
    if floor is not None and floor < 0.6 * rms:
        result.append(finding("systematic-residual", file=_name(block), rms=rms, neighbours=floor))
    if stated is not None and not stated / max_times <= rms <= max_times * stated:
        code = "sigma-too-small" if rms > stated else "sigma-too-large"
        times = max(rms, stated) / max(min(rms, stated), 1e-300)
        result.append(finding(code, file=_name(block), rms=rms, stated=stated, times=times))
    return result


def _name(block: Block) -> str:
    return Path(block.measured.file).name or "measurements"


def neighbour_floor(q: np.ndarray, part: Part) -> float | None:
    """Return the rms of residual differences between nearest neighbours in q, over √2 [m]: an estimate of the noise.

    (von Neumann's mean square successive difference, 1941, with neighbours in joint space in place of time.) None where
    neighbours are further apart than a third of the joints' spread, so that they share nothing.
    """
    spread = q.std(axis=0)
    moving = spread > 1e-9
    if len(q) != part.value.shape[1] or not moving.any():
        return None
    scaled = q[:, moving] / spread[moving]
    distance, index = KDTree(scaled).query(scaled, k=2)
    near = distance[:, 1] < np.sqrt(moving.sum()) / 3.0
    if near.sum() < MIN_ROWS:
        return None
    change = part.value[:, near] - part.value[:, np.asarray(index)[near, 1]]
    return float(np.sqrt(np.mean(np.sum(change**2, axis=0)) / 2.0))


@dataclass(frozen=True)
class Scale:
    """Scale factor of all measured lengths, fitted together with the nominal arm's base and tool placement.

    Attributes:
        factor: measured over the arm's.
        sigma: of the factor.
        explained: share of the squares of the nominal arm's errors that it takes away.
    """

    factor: float
    sigma: float
    explained: float


def scale_of(nominal: Installation, blocks: Sequence[PoseMeasurements]) -> Scale | None:
    """Return the instrument's scale factor and its sigma from measured positions; None without positions.

    y - p = (s - 1) (p - mean p), with p the predicted positions, up to what placements explain.

    None, too, where placements explain a growth of all lengths: it moves the targets by less than `MIN_LENGTH` per unit
    (rms) otherwise.

    Args:
        nominal: the arm with base and tool placement fitted for it.
        blocks: of any kinds; those that measure positions count.
    """
    frames, rows, columns = layout(nominal).frame_index, [], []
    for block in prepare(nominal, blocks):
        if not isinstance(block.measured, Positions):
            continue
        part = next(part for part in observe(nominal, block, frames) if part.label == "position")
        # predicted, since the noise of measured positions is no combination of placements
        predicted = positions(nominal, block)[:, part.index]
        rows.append(part.value.ravel())
        away = (predicted - predicted.mean(axis=1, keepdims=True)).ravel()
        columns.append(np.column_stack([part.jacobian.reshape(len(frames), -1).T, away]))
    if not rows:
        return None
    value, matrix = np.concatenate(rows), np.concatenate(columns)
    sizes = np.maximum(np.linalg.norm(matrix, axis=0), 1e-12)
    placements, growth = matrix[:, :-1] / sizes[:-1], matrix[:, -1]
    # what placements do not explain: of the residuals, and of a growth of all lengths
    residual, lever = (x - placements @ np.linalg.lstsq(placements, x, rcond=1e-9)[0] for x in (value, growth))
    power, count = float(lever @ lever), len(value) - matrix.shape[1]
    if count < 1 or power < len(value) * MIN_LENGTH**2:
        return None
    slope, squares = float(lever @ residual) / power, float(residual @ residual)
    unexplained = max(squares - slope**2 * power, 0.0)
    sigma = float(np.sqrt(unexplained / count / power))
    return Scale(1.0 + slope, sigma, 1.0 - unexplained / max(squares, 1e-300))


def length_factor(fit: GeometricFit) -> Scale | None:
    """Return the common factor of fitted over nominal arm lengths; None for fewer than two fitted lengths.

    Its sigma follows from the measurements; the explained share of the lengths' change shows whether it is one factor.
    """
    chain = fit.start.chain
    if fit.split is None:
        return None
    arm, base = len(chain.elements), fit.base
    nominal_length = np.zeros(len(fit.free))
    change = np.zeros(len(fit.free))
    for number, parameter in enumerate(fit.free):
        if parameter < arm:
            nominal_length[number] = element_length(chain, int(parameter))
            change[number] = fit.cell.chain.values[parameter] - chain.values[parameter]
    # base lengths: each with those that merge with it
    combinations = fit.regrouping()
    total = combinations @ nominal_length
    translates = np.array([k < arm and chain.elements[k].axis[0] == "t" for k in base], dtype=bool)
    index = np.flatnonzero(translates & (np.abs(total) > MIN_LENGTH))
    if len(index) < 2:
        return None
    lengths, grown = total[index], (combinations @ change)[index]
    covariance = combinations[index] @ fit.estimate.covariance @ combinations[index].T
    weight = np.linalg.pinv(covariance, hermitian=True)
    power, common = float(lengths @ weight @ lengths), float(lengths @ weight @ grown)
    if not power > 0.0:
        return None
    share = common**2 / power / max(float(grown @ weight @ grown), 1e-300)
    return Scale(1.0 + common / power, power**-0.5, share)


SHORT = Settings(limit=20, passes=1)  # where base and tool settle at all they do so sooner
ROBUST = Settings(loss="cauchy", limit=40, passes=4)  # angles beyond a convention's range were lost
# of the makers' angles; others are rare (our choice)
CONVENTIONS = ("vector", "xyz fixed", "xyz moving", "zyx fixed", "zyx moving", "zyz moving", "zxz moving")
SURELY = 1.0 / 3.0  # share of the error that may be left where no second change goes with it (our choice)
FLIP = np.array([1.0, -1.0, 1.0])


def wrong_columns(nominal: Installation, blocks: Blocks, mirrored: bool = False) -> Explanation | None:
    """Return the change of columns that reduces the nominal arm's error most; None if no change helps much.

    Args:
        nominal: the arm as it was, placed.
        blocks: the rows.
        mirrored: whether an instrument with left-handed axes is tried, too.
    """
    n = nominal.chain.n
    table = [Change("joint-sign", _of_joints(reversal(n, j)), (j,), max_left=0.8) for j in range(n)]
    table += [
        Change(
            "joint-without-effect", _of_joints(standing(n, j)), (j,), {"end": _end_without(nominal.chain, j)}, SURELY
        )
        for j in range(n)
    ]
    table += [
        Change("joint-coupled", _of_joints(coupling(n, j, k, way)), (j, k), {"way": "+" if way > 0 else "-"}, SURELY)
        for j, k, way in couplings(n)
    ]
    pairs = combinations(range(n), 2)
    table += [Change("joints-exchanged", _of_joints(exchange(n, *pair)), pair, max_left=SURELY) for pair in pairs]
    if mirrored and any(isinstance(block, Positions) for block in blocks):
        table.append(Change("left-handed", _mirrored, max_left=SURELY))
    turning = [j for j in range(n) if nominal.chain.joints[j].kind != "prismatic"]
    quarters = [(j, angle) for j in turning for angle in (np.pi / 2.0, -np.pi / 2.0, np.pi)]
    table += [Change("joint-zero", partial(_turned, j, angle), (j,), {"angle": angle}, SURELY) for j, angle in quarters]
    few = _few(blocks)
    table += row_shifts(nominal, blocks, SURELY) + two_targets(nominal, few, SURELY)
    return best_changes(
        blocks,
        table,
        lambda changed: _left(nominal, _few(changed)),
        lambda changed: least_error(nominal, _few(changed)),
        n,
    )


def wrong_angles(nominal: Installation, blocks: Blocks) -> Explanation | None:
    """Return the convention of the orientations' angles that reduces the nominal arm's error most; None if none does.

    Args:
        nominal: the arm as it was, placed.
        blocks: the rows.
    """
    few = [block for block in _few(blocks) if isinstance(block, Poses) and block.euler]
    read_as = {block.euler for block in few}
    others = [euler for euler in CONVENTIONS if read_as and euler not in read_as]
    table = [
        Change("angle-convention", partial(_read_as, euler), (), {"convention": euler}, SURELY) for euler in others
    ]
    return best_changes(few, table, partial(_turned_by, nominal)) if table else None


def _turned_by(nominal: Installation, blocks: Blocks) -> np.ndarray:
    """Return the median squared orientation error [rad²] (1,) with base and tool placement fitted.

    Of most rows, since angles beyond the range of the stated convention were lost when they were read.
    """
    try:
        placed = polish_frames(install(nominal.chain, blocks, nominal.known), blocks, ROBUST).cell
    except CalibError:
        return np.array([np.inf])
    angle = errors(placed, blocks).orientation
    return np.array([np.inf if angle is None else float(np.median(angle**2))])


def _few(blocks: Blocks, max_rows: int = 200) -> Blocks:
    """Return at most `max_rows` rows of each block."""
    return [take(block, evenly(len(block), max_rows)) for block in blocks]


def _turned(joint: int, angle: float, blocks: Blocks) -> Blocks:
    """Return blocks whose zero of a joint is another one."""
    by = angle * np.eye(blocks[0].q.shape[1])[joint]
    return [replace(block, q=block.q + by) for block in blocks]


def _end_without(chain: Chain, joint: int) -> str | None:
    """Return the option that ends the chain of a URDF before its last joint, or begins it behind its first one."""
    if not chain.links or chain.n == 1:
        return None
    options = {0: f"--base {chain.links[0]}", chain.n - 1: f"--tip {chain.links[-2]}"}
    return options.get(joint)


def _of_joints(matrix: np.ndarray) -> Callable[[Blocks], Blocks]:
    return lambda blocks: [replace(block, q=block.q @ matrix.T) for block in blocks]


def _mirrored(blocks: Blocks) -> Blocks:
    """Return blocks in a frame of opposite handedness: y changes its sign, a rotation R becomes F R F."""
    found = []
    for block in blocks:
        if isinstance(block, Positions):
            block = replace(block, position=np.asarray(block.position) * FLIP)
        if isinstance(block, Poses):
            block = replace(block, quaternion=np.asarray(block.quaternion) * [-1.0, 1.0, -1.0, 1.0])
        found.append(block)
    return found


def _read_as(euler: str, blocks: Blocks) -> Blocks:
    """Return blocks with the angles of orientations read by another convention."""
    found = []
    for block in blocks:
        if isinstance(block, Poses) and block.euler:
            angles = to_angles(Rotation.from_quat(block.quaternion), block.euler)
            block = replace(block, quaternion=from_angles(angles, euler).as_quat(canonical=True), euler=euler)
        found.append(block)
    return found


def _left(nominal: Installation, blocks: Blocks) -> np.ndarray:
    """Return the mean squared error of the nominal arm [m²] after fitting base and tool placement.

    A placement that was found worse than the one that `nominal` has does not count.
    """
    squares = [np.inf]
    with suppress(CalibError):  # a second target has no placement yet
        squares.append(float(np.mean(errors(nominal, blocks).main ** 2)))
    with suppress(CalibError):
        placed = polish_frames(install(nominal.chain, blocks, nominal.known), blocks, ROBUST).cell
        squares.append(float(np.mean(errors(placed, blocks).main ** 2)))
    return np.array([min(squares)])
