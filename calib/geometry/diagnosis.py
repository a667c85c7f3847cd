"""Checks of measurements against the model: changed set-up, systematic residuals, changed columns, a scale factor.

Changed columns are wrong joint signs, exchanged joints, mirrored axes, or angles of another convention. The nominal
arm, with free placements of base and tool, is fitted to the rows as measured, and with each of these changes. A change
is reported where it makes the error much smaller.
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
from calib.geometry.checks.mixed_rows import CONVENTIONS, unit_changes
from calib.geometry.checks.wrong_rows import ROBUST, Blocks, least_error, row_shifts, two_targets
from calib.geometry.first_guess import install
from calib.geometry.fit import polish_frames
from calib.geometry.installation import Installation
from calib.geometry.observation import Block, layout, observe, positions, prepare
from calib.geometry.residuals import ResidualPart
from calib.geometry.weighing import GeometricFit
from calib.records import evenly
from calib.robot.chain import Chain, element_length

# smallest length of the arm [m], and smallest motion of targets per unit growth [m], that determine a scale factor
MIN_LENGTH = 0.01
# smallest number of rows in which patterns are searched (our choice)
MIN_ROWS = 30
# largest probability of such a difference by chance, for rows in any order, to report a changed set-up (our choice)
MAX_CHANCE = 1e-3
# smallest ratio of the errors before and after a change of set-up that is reported (our choice)
MIN_RATIO = 1.6
# residuals are systematic if those of neighbouring poses differ by less than this share of them (our choice)
MAX_NEIGHBOUR_SHARE = 0.6
# ratio of residuals to stated uncertainty, or the inverse, above which a finding is reported (our choice)
MAX_TIMES = 5.0
# largest share of the error that may remain after a change made alone, and after reversing a joint's sign (our choice)
MAX_LEFT = 1.0 / 3.0
MAX_LEFT_SIGN = 0.8
# number of rows of each block by which changes are compared (our choice)
FEW = 200
# offsets of a joint's zero that are tried [rad]
QUARTERS = (np.pi / 2.0, -np.pi / 2.0, np.pi)
# signs of the axes of a frame of opposite handedness
FLIP = np.array([1.0, -1.0, 1.0])


def diagnose(fit: GeometricFit, with_changes: bool = True) -> list[Finding]:
    """Return findings on systematic residuals of each block and, if `with_changes`, on a set-up changed in between.

    Args:
        fit: the fit to examine.
        with_changes: whether a changed set-up is searched.
    """
    findings: list[Finding] = []
    for block, part in _lengths(fit):
        # pairs of rows count once
        if part.value.shape[1] < MIN_ROWS:
            continue
        if with_changes:
            findings += _setup_change(block, part)
        findings += _systematic(block, part)
    return findings


def _lengths(fit: GeometricFit) -> list[tuple[Block, ResidualPart]]:
    """Return each block of `fit` with its first residual part, which is in metres for every kind of measurement."""
    first = {piece.block: piece.part.per_row() for piece in reversed(fit.pieces)}
    return [(block, first[number]) for number, block in enumerate(fit.blocks)]


def _setup_change(block: Block, part: ResidualPart) -> list[Finding]:
    """Return a finding if the residuals before and after some row differ significantly in size.

    Args:
        block: the prepared measurements of m rows.
        part: their residuals [m].
    """
    size = np.linalg.norm(part.value, axis=0)
    # a few gross rows are not a set-up
    size = np.minimum(size, 4.0 * np.median(size))
    m = len(size)
    edge = max(10, m // 20)
    cuts = np.arange(edge, m - edge)
    energy = np.cumsum(size**2)
    before = np.sqrt(energy[cuts - 1] / cuts)
    after = np.sqrt((energy[-1] - energy[cuts - 1]) / (m - cuts))
    ratio = np.maximum(before / np.maximum(after, 1e-15), after / np.maximum(before, 1e-15))
    weight = np.minimum(cuts, m - cuts)
    best = int(np.argmax((ratio - 1.0) * np.sqrt(weight)))
    if ratio[best] < MIN_RATIO:
        return []
    # slow to load, and seldom needed
    from scipy.stats import mannwhitneyu

    cut = int(cuts[best])
    chance = float(mannwhitneyu(size[:cut], size[cut:]).pvalue)
    # Bonferroni: the best of many cuts
    if chance * len(cuts) > MAX_CHANCE:
        return []
    rows = block.measured.rows[part.index]
    if before[best] > after[best]:
        first, last = rows[0], rows[cut - 1]
        worse, better = before[best], after[best]
    else:
        first, last = rows[cut], rows[-1]
        worse, better = after[best], before[best]
    return [finding("set-up-changed", file=_name(block), first=first, last=last, worse=worse, rest=better)]


def _systematic(block: Block, part: ResidualPart) -> list[Finding]:
    """Return findings on systematic residuals, and on stated standard deviations that contradict the residuals.

    Residuals are systematic where they are similar at neighbouring poses: noise would differ there, a missing effect
    would not.

    Args:
        block: the prepared measurements of m rows.
        part: their residuals [m].
    """
    findings = []
    name = _name(block)
    rms = _rms_norm(part.value)
    floor = neighbour_floor(block.measured.q, part)
    if floor is not None and floor < MAX_NEIGHBOUR_SHARE * rms:
        findings.append(finding("systematic-residual", file=name, rms=rms, neighbours=floor))
    if part.sigma is not None:
        stated = _rms_norm(part.sigma)
        if not stated / MAX_TIMES <= rms <= MAX_TIMES * stated:
            code = "sigma-too-small" if rms > stated else "sigma-too-large"
            times = max(rms, stated) / max(min(rms, stated), 1e-300)
            findings.append(finding(code, file=name, rms=rms, stated=stated, times=times))
    return findings


def _rms_norm(values: np.ndarray) -> float:
    """Return the rms of the column norms of `values` (rows, m)."""
    return float(np.sqrt(np.mean(np.sum(values**2, axis=0))))


def _name(block: Block) -> str:
    return Path(block.measured.file).name or "measurements"


def neighbour_floor(q: np.ndarray, part: ResidualPart) -> float | None:
    """Return an estimate of the noise [m]: the rms of residual differences between nearest neighbours in q, over √2.

    This is von Neumann's mean square successive difference (1941), with neighbours in joint space in place of time.
    None where neighbours are further apart than a third of the joints' spread, since their systematic errors are then
    unrelated.

    Args:
        q: (m, n) joint values of the rows [rad or m].
        part: residuals of the m rows.
    """
    spread = q.std(axis=0)
    moving = spread > 1e-9
    if len(q) != part.value.shape[1] or not moving.any():
        return None
    scaled = q[:, moving] / spread[moving]
    distances, indices = KDTree(scaled).query(scaled, k=2)
    # the nearest is the pose itself
    close = distances[:, 1] < np.sqrt(moving.sum()) / 3.0
    if close.sum() < MIN_ROWS:
        return None
    neighbour = np.asarray(indices)[close, 1]
    change = part.value[:, close] - part.value[:, neighbour]
    return float(np.sqrt(np.mean(np.sum(change**2, axis=0)) / 2.0))


@dataclass(frozen=True)
class Scale:
    """Scale factor of all measured lengths, fitted together with the nominal arm's base and tool placement.

    Attributes:
        factor: measured lengths divided by the arm's nominal lengths.
        sigma: standard deviation of the factor.
        explained: share of the sum of squared errors of the nominal arm that the factor removes.
    """

    factor: float
    sigma: float
    explained: float


def scale_of(nominal: Installation, blocks: Sequence[PoseMeasurements]) -> Scale | None:
    """Return the scale factor of the instrument and its sigma from measured positions.

    The model is y - p = (s - 1) (p - mean p), with y measured and p predicted positions, up to changes of the
    placements.

    Args:
        nominal: the nominal arm with base and tool placement fitted.
        blocks: measurements; only blocks with positions are used.

    Returns:
        The scale. None without positions, and where placements alone can explain a growth of all lengths: where, beyond
            them, a growth moves the targets by less than `MIN_LENGTH` per unit (rms).
    """
    frames = layout(nominal).frame_index
    residuals, columns = [], []
    for block in prepare(nominal, blocks):
        if not isinstance(block.measured, Positions):
            continue
        part = next(part for part in observe(nominal, block, frames) if part.label == "position")
        # predicted, since the noise of measured positions is no combination of placements
        predicted = positions(nominal, block)[:, part.index]
        residuals.append(part.value.ravel())
        growth = (predicted - predicted.mean(axis=1, keepdims=True)).ravel()
        columns.append(np.column_stack([part.jacobian.reshape(len(frames), -1).T, growth]))
    if not residuals:
        return None
    value = np.concatenate(residuals)
    matrix = np.concatenate(columns)
    sizes = np.maximum(np.linalg.norm(matrix, axis=0), 1e-12)
    placements = matrix[:, :-1] / sizes[:-1]
    growth = matrix[:, -1]
    # what placements do not explain: of the residuals, and of a growth of all lengths
    residual = value - placements @ np.linalg.lstsq(placements, value, rcond=1e-9)[0]
    lever = growth - placements @ np.linalg.lstsq(placements, growth, rcond=1e-9)[0]
    power = float(lever @ lever)
    dof = len(value) - matrix.shape[1]
    if dof < 1 or power < len(value) * MIN_LENGTH**2:
        return None
    slope = float(lever @ residual) / power
    squares = float(residual @ residual)
    unexplained = max(squares - slope**2 * power, 0.0)
    sigma = float(np.sqrt(unexplained / dof / power))
    return Scale(1.0 + slope, sigma, 1.0 - unexplained / max(squares, 1e-300))


def length_factor(fit: GeometricFit) -> Scale | None:
    """Return the common factor of fitted over nominal arm lengths; None where fewer than two lengths were fitted.

    The factor's sigma is computed from the fit's covariance. `explained` is the share of the changes of the lengths
    that one common factor explains.

    Args:
        fit: a fit of the arm's lengths.
    """
    chain = fit.start.chain
    if fit.split is None:
        return None
    elements = len(chain.elements)
    nominal_length = np.zeros(len(fit.free))
    change = np.zeros(len(fit.free))
    for number, parameter in enumerate(fit.free):
        if parameter < elements:
            nominal_length[number] = element_length(chain, int(parameter))
            change[number] = fit.cell.chain.values[parameter] - chain.values[parameter]
    # base lengths: each with those that merge with it
    combinations = fit.regrouping()
    total = combinations @ nominal_length
    translates = np.zeros(len(fit.base), dtype=bool)
    for number, parameter in enumerate(fit.base):
        translates[number] = parameter < elements and chain.elements[parameter].axis[0] == "t"
    index = np.flatnonzero(translates & (np.abs(total) > MIN_LENGTH))
    if len(index) < 2:
        return None
    lengths = total[index]
    growth = (combinations @ change)[index]
    covariance = combinations[index] @ fit.estimate.covariance @ combinations[index].T
    weight = np.linalg.pinv(covariance, hermitian=True)
    power = float(lengths @ weight @ lengths)
    common = float(lengths @ weight @ growth)
    if not power > 0.0:
        return None
    explained = common**2 / power / max(float(growth @ weight @ growth), 1e-300)
    return Scale(1.0 + common / power, power**-0.5, explained)


def wrong_columns(nominal: Installation, blocks: Blocks, mirrored: bool = False) -> Explanation | None:
    """Return the change of columns that reduces the nominal arm's error most; None if no change helps much.

    Args:
        nominal: the nominal arm, with stations and tools placed.
        blocks: the measurements.
        mirrored: True: also try an instrument with left-handed axes.
    """
    chain = nominal.chain
    n = chain.n
    changes: list[Change] = []
    if not chain.is_free_flyer:
        changes = _joint_changes(chain)
    if mirrored and any(isinstance(block, Positions) for block in blocks):
        changes.append(Change("left-handed", _mirrored, max_left=MAX_LEFT))
    changes += row_shifts(nominal, blocks, MAX_LEFT)
    changes += two_targets(nominal, _few(blocks), MAX_LEFT)
    changes += unit_changes(nominal, blocks, MAX_LEFT)
    return best_changes(
        blocks,
        changes,
        lambda changed: _mean_square(nominal, _few(changed)),
        lambda changed: least_error(nominal, _few(changed)),
        n,
    )


def _joint_changes(chain: Chain) -> list[Change]:
    """Return the changes of joint columns that are tried: signs, couplings, exchanges, zeros."""
    n = chain.n
    changes: list[Change] = []
    for joint in range(n):
        make = _of_joints(reversal(n, joint))
        changes.append(Change("joint-sign", make, (joint,), max_left=MAX_LEFT_SIGN))
    for joint in range(n):
        values = {"end": _end_without(chain, joint)}
        changes.append(Change("joint-without-effect", _of_joints(standing(n, joint)), (joint,), values, MAX_LEFT))
    for joint, source, sign in couplings(n):
        values = {"way": "+" if sign > 0 else "-"}
        make = _of_joints(coupling(n, joint, source, sign))
        changes.append(Change("joint-coupled", make, (joint, source), values, MAX_LEFT))
    for first, second in combinations(range(n), 2):
        make = _of_joints(exchange(n, first, second))
        changes.append(Change("joints-exchanged", make, (first, second), max_left=MAX_LEFT))
    for joint in range(n):
        if chain.joints[joint].kind == "prismatic":
            continue
        for angle in QUARTERS:
            make = partial(_turned, joint, angle)
            changes.append(Change("joint-zero", make, (joint,), {"angle": angle}, MAX_LEFT))
    return changes


def wrong_angles(nominal: Installation, blocks: Blocks) -> Explanation | None:
    """Return the angle convention of the measured orientations that reduces the nominal arm's error most.

    None if no other convention reduces it much.

    Args:
        nominal: the nominal arm, with stations and tools placed.
        blocks: the measurements.
    """
    few = [block for block in _few(blocks) if isinstance(block, Poses) and block.euler]
    stated = {block.euler for block in few}
    changes = []
    for convention in CONVENTIONS:
        if stated and convention not in stated:
            values = {"convention": convention}
            changes.append(Change("angle-convention", partial(_read_as, convention), (), values, MAX_LEFT))
    if not changes:
        return None
    return best_changes(few, changes, partial(_median_angle, nominal))


def _median_angle(nominal: Installation, blocks: Blocks) -> np.ndarray:
    """Return the median squared orientation error [rad²] (1,) with base and tool placement fitted.

    The median is robust to angles beyond the range of the stated convention, whose orientations were lost when the file
    was read.

    Args:
        nominal: the nominal arm.
        blocks: the measurements; only full poses are used.
    """
    try:
        placed = polish_frames(install(nominal.chain, blocks, nominal.known), blocks, ROBUST).cell
    except CalibError:
        return np.array([np.inf])
    angle = errors(placed, blocks).orientation
    if angle is None:
        return np.array([np.inf])
    return np.array([float(np.median(angle**2))])


def _few(blocks: Blocks) -> Blocks:
    """Return each block reduced to at most `FEW` rows."""
    return [take(block, evenly(len(block), FEW)) for block in blocks]


def _turned(joint: int, angle: float, blocks: Blocks) -> Blocks:
    """Return the blocks with `angle` [rad] added to the values of the joint with index `joint`."""
    turn = np.zeros(blocks[0].q.shape[1])
    turn[joint] = angle
    return [replace(block, q=block.q + turn) for block in blocks]


def _end_without(chain: Chain, joint: int) -> str | None:
    """Return the command option that excludes the joint with index `joint` from a URDF's chain.

    The option begins the chain after its first joint or ends it before its last joint; None for other joints.
    """
    if not chain.links or chain.n == 1:
        return None
    options = {0: f"--base {chain.links[0]}", chain.n - 1: f"--tip {chain.links[-2]}"}
    return options.get(joint)


def _of_joints(matrix: np.ndarray) -> Callable[[Blocks], Blocks]:
    """Return a function that multiplies all joint values of blocks by a matrix (n, n)."""
    return lambda blocks: [replace(block, q=block.q @ matrix.T) for block in blocks]


def _mirrored(blocks: Blocks) -> Blocks:
    """Return the blocks in a frame of opposite handedness: y changes its sign, a rotation R becomes F R F."""
    result = []
    for block in blocks:
        if isinstance(block, Positions):
            block = replace(block, position=np.asarray(block.position) * FLIP)
        if isinstance(block, Poses):
            block = replace(block, quaternion=np.asarray(block.quaternion) * [-1.0, 1.0, -1.0, 1.0])
        result.append(block)
    return result


def _read_as(euler: str, blocks: Blocks) -> Blocks:
    """Return the blocks with the angles of orientations read by the convention `euler`."""
    result = []
    for block in blocks:
        if isinstance(block, Poses) and block.euler:
            angles = to_angles(Rotation.from_quat(block.quaternion), block.euler)
            quaternion = from_angles(angles, euler).as_quat(canonical=True)
            block = replace(block, quaternion=quaternion, euler=euler)
        result.append(block)
    return result


def _mean_square(nominal: Installation, blocks: Blocks) -> np.ndarray:
    """Return the mean squared error of the nominal arm [m²] after fitting base and tool placement.

    The placements in `nominal` are used where they give a smaller error than the fitted ones.

    Args:
        nominal: the nominal arm, with stations and tools placed.
        blocks: the measurements.
    """
    squares = [np.inf]
    # a second target has no placement yet
    with suppress(CalibError):
        squares.append(float(np.mean(errors(nominal, blocks).main ** 2)))
    with suppress(CalibError):
        placed = polish_frames(install(nominal.chain, blocks, nominal.known), blocks, ROBUST).cell
        squares.append(float(np.mean(errors(placed, blocks).main ** 2)))
    return np.array([min(squares)])
