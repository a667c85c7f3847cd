"""Joints at rest: each standstill counts as one row, with friction unknown within the static friction.

While a joint is at rest, friction may have any value that prevents motion. In a standstill of K rows the torques are

    y_k = w_k x + f + e_k,    abs(f) <= F_s unknown,

where w does not contain friction that depends only on the direction of motion (Coulomb friction and similar). The K
rows have a common f, so that together they have the information of one row of variance τ s² / K + f². Here s² is the
variance of the residuals in motion, τ the number of neighbouring residuals that count as one, and

    f² = max(F_c² / 3, mean square of the residuals at rest),

where F_c² / 3 is the variance of a value evenly distributed within ± F_c. The rows of a standstill have equal shares of
this weight, so that they still contain how the torque changes with the motion of other joints. If the torque changes by
more than the range of friction, friction has taken another value: a standstill with a torque range r counts as 1 + r /
reach values, with reach = 2 √3 √(f² + τ s²), the width of an even distribution of that variance.

After a standstill, friction does not immediately have its value in motion: gears unwind, and contacts give way. Its
value at rest decays over a travel δ, so that a row at a travel d since the last standstill has the variance

    s² + f² exp(-2 d / δ).

δ is one value for the robot, the most probable one of `TRAVELS` given the residuals of a fit (0: no decay). It is about
5 to 20 mrad on the KR300 and 1 mrad on harmonic drives.

Reversals pass through zero speed but are ordinary rows, not standstills. They are shorter than `MIN_STANDSTILL` or, in
slow motion, small speeds occur evenly, whereas a standing joint is slower than `MAX_MEDIAN` for half of the time.
Torques of sensors behind the gear do not contain such friction.

If the drive's friction is low, or the model of the motion is wrong (a torso whose effort contains no gravity), rows at
rest have more information than this. Both treatments therefore predict the motion of held-out time blocks. Rows at rest
count like all other rows if the error is then less than `CLEARLY_LESS` times as large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.data.signals.filtering import Decimator, kept
from calib.dynamics.regressor_model import RegressorModel
from calib.dynamics.torque_rows import TorqueRows
from calib.estimation.triangles import Triangles, absorb, empty, retriangulate
from calib.identification.rows import Case, ObservationRows, RestWeights, pool, segments, thinned, triangulate
from calib.identification.time_folds import estimate
from calib.records import frozen

MIN_STANDSTILL = 0.05  # [s] that a joint stands; shorter ones are reversals (our choice)
MAX_MEDIAN = 0.25  # of the width of Coulomb's sign; of a speed that passes evenly through zero it is 0.5 (our choice)
# Of the error in motion on left-out time, for which standing rows count as any others (our choice). What asks for it
# is at 0.63 and 0.79 (TIAGo), what is better without at 0.87 (UR10e), 0.96 (TIAGo) and above 1. Two robots decide it;
# with either left out the other allows 0.85.
CLEARLY_LESS = 0.85
TRAVELS = (0.0, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05)  # over which friction at rest may fade [rad or m] (our choice)
BREAKAWAY_ROUNDS = 3  # of a fit and the travel that its residuals ask for
VARIANCE_ROUNDS = 20
MIN_MOVING = 10  # rows in motion, below which a joint's standing rows count as any others: no friction is identified


def standing_joints(case: Case, v0: np.ndarray) -> np.ndarray:
    """Return the mask (N, n) of joints at rest.

    A joint is at rest if it is slower than the width of Coulomb's sign for at least `MIN_STANDSTILL`, and slower than
    `MAX_MEDIAN` times this width for half of that time.

    Args:
        case: the recording.
        v0: (n,) width of Coulomb's sign [rad/s or m/s].
    """
    motion = case.motion
    speed = np.abs(motion.v) / np.maximum(v0, 3.0 * motion.velocity_noise())
    least = max(1, int(np.ceil(MIN_STANDSTILL * motion.rate)))
    result = np.zeros(speed.shape, dtype=bool)
    for start, stop in segments(motion.segment):
        for joint in range(motion.n):
            for first, end in _runs(speed[start:stop, joint] < 1.0):
                rows = slice(start + first, start + end)
                result[rows, joint] = end - first >= least and np.median(speed[rows, joint]) < MAX_MEDIAN
    return result


def with_standstills(
    all_rows: Sequence[ObservationRows],
    cases: Sequence[Case],
    decimator: Decimator,
    model: RegressorModel,
    columns: np.ndarray,
    v0: np.ndarray,
    marks: bool = True,
) -> list[ObservationRows]:
    """Return the rows with their standstills marked, and with the columns of Coulomb friction zero in standstills.

    Standstills of joints that hardly move are not marked, but their columns are zero, too: the velocity's sign is that
    of the encoder's noise.

    Args:
        all_rows: rows of all recordings.
        cases: recordings.
        decimator: filter and decimation of the rows.
        model: the model.
        columns: indices of the model's columns in the rows.
        v0: (n,) width of Coulomb's sign [rad/s or m/s].
        marks: False leaves rows of joints that move as they are.
    """
    rows, n = all_rows[0].target.shape[1], cases[0].motion.n
    held = _held_rows(model, n, rows)
    coulomb = np.zeros((rows, len(columns)), dtype=bool)
    for place, column in enumerate(columns):
        term = model.columns[column - model.inertial] if column >= model.inertial else None
        if term is not None and term.form.undecided_at_rest:
            coulomb[:, place] = _acted(term.acts, model.torque_rows, term.side, n, rows)
    coulomb &= held[:, None]
    held = coulomb.any(axis=1)
    masks = []
    for part, case in zip(all_rows, cases):
        standing = model.torque_rows.of_joints(standing_joints(case, v0))
        stands = thinned(standing, case.motion.segment, decimator)
        masks.append(stands & part.present & held)
    counts = [(part.present & ~mask).sum(axis=0) for part, mask in zip(all_rows, masks)]
    moving = np.sum(counts, axis=0)
    result = []
    moves = moving >= MIN_MOVING
    for part, case, mask in zip(all_rows, cases, masks):
        undecided = mask if marks else mask & ~moves
        matrix = part.matrix
        if undecided.any():
            matrix = np.where(undecided[:, :, None] & coulomb, 0.0, matrix)
        if not marks:
            result.append(replace(part, matrix=matrix))
            continue
        segment = case.motion.segment[kept(case.motion.segment, decimator)]
        share = _shares(mask & moves, segment)
        swing = _swings(share > 0.0, part.target, segment)
        result.append(
            replace(part, matrix=matrix, standing=frozen(share), swing=frozen(swing), coulomb=frozen(coulomb, bool))
        )
    return result


def _held_rows(model: RegressorModel, n: int, rows: int) -> np.ndarray:
    """Return the mask (rows,) of torque rows that contain a motor's friction.

    Args:
        model: the model.
        n: number of joints.
        rows: number of torque rows.
    """
    held = np.zeros(rows, dtype=bool)
    if model.torque_rows.projection is None and rows == model.torque_rows.count(n):
        for joint in range(n):
            held[model.torque_rows.of_side("motor", joint, n)] = True
    return held


def _acted(acts: Sequence[tuple[int, object]], torque_rows: TorqueRows, side: str, n: int, rows: int) -> np.ndarray:
    """Return the mask (rows,) of torque rows that a drive term acts on.

    Args:
        acts: pairs (joint, motion) of the drive term.
        torque_rows: kind of torques in the rows.
        side: side of the term, ``link`` or ``motor``.
        n: number of joints.
        rows: number of torque rows.
    """
    result = np.zeros(rows, dtype=bool)
    if torque_rows.projection is None:
        for joint, _ in acts:
            result[torque_rows.of_side(side, joint, n)] = True
    return result


def _runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """Return (start, stop) of each run of true values in a mask (N,)."""
    padded = np.concatenate([[0], mask.astype(int), [0]])
    edges = np.flatnonzero(np.diff(padded))
    return [(int(start), int(stop)) for start, stop in edges.reshape(-1, 2)]


def _shares(mask: np.ndarray, segment: np.ndarray) -> np.ndarray:
    """Return the share (M, rows) of each row in its standstill, 1 / number of rows; 0 in motion.

    Args:
        mask: (M, rows) mask of rows at rest.
        segment: (M,) number of each sample's segment; a standstill does not continue in the next segment.
    """
    result = np.zeros(mask.shape)
    for start, stop in segments(segment):
        for row in range(mask.shape[1]):
            for first, end in _runs(mask[start:stop, row]):
                result[start + first : start + end, row] = 1.0 / (end - first)
    return result


def _swings(mask: np.ndarray, target: np.ndarray, segment: np.ndarray) -> np.ndarray:
    """Return the range of the torque (M, rows) in the standstill that contains each row; 0 in motion.

    Args:
        mask: (M, rows) mask of rows at rest.
        target: (M, rows) torques [N m or N].
        segment: (M,) number of each sample's segment.
    """
    result = np.zeros(mask.shape)
    for start, stop in segments(segment):
        for row in range(mask.shape[1]):
            for first, end in _runs(mask[start:stop, row]):
                rows = slice(start + first, start + end)
                result[rows, row] = np.ptp(target[rows, row])
    return result


@dataclass(frozen=True, eq=False)
class DividedRows:
    """Separate R factors of rows in motion and at rest, one group per torque row, so that weights may change.

    Attributes:
        moving, standing: R factors of rows in motion, and of rows at rest multiplied by the square root of their share
            in a standstill.
        swinging: R factors of rows at rest multiplied by the square root of that share times the range of the torque.
        standstills: (rows,) number of standstills.
        swing: (rows,) mean range of the torque in a standstill [N m or N].
        length: (rows,) mean number of rows of a standstill.
        coulomb: (rows, p) mask of columns that are Coulomb friction of a torque row.
    """

    moving: Triangles
    standing: Triangles
    swinging: Triangles
    standstills: np.ndarray
    swing: np.ndarray
    length: np.ndarray
    coulomb: np.ndarray

    def weights(self, values: np.ndarray, std: np.ndarray, tau: np.ndarray) -> RestWeights:
        """Return the weights of standstills for parameter values (p,), as derived in the module's docstring.

        Args:
            values: (p,) parameters.
            std, tau: (rows,) standard deviation of the residuals in motion [N m or N], and number of these residuals
                that count as one.
        """
        count = np.maximum(self.standstills, 1.0)
        friction = np.sum(np.abs(values) * self.coulomb, axis=1)
        spread = np.maximum(friction**2 / 3.0, self.standing.residual_squares(values) / count)
        noise = tau * std**2
        reach = np.maximum(2.0 * np.sqrt(3.0 * (noise + spread)), 1e-300)
        values_of_friction = 1.0 + self.swing / reach
        variance = np.maximum(noise * values_of_friction / self.length + spread, 1e-300)
        worth = frozen(noise / variance)
        return RestWeights(worth, frozen(tau * (std**2 + spread) / variance), frozen(reach))

    def joined(self, weights: RestWeights) -> Triangles:
        """Return the R factors of all rows, with the given weights of standstills."""
        if not self.standstills.any():
            return self.moving
        scaled = self.standing.factors * np.sqrt(weights.worth)[:, None, None]
        scale = np.sqrt(weights.worth / weights.reach)
        renewed = self.swinging.factors * scale[:, None, None]
        both = np.concatenate([self.moving.factors, scaled, renewed], axis=1)
        frictions = self.standstills * (1.0 + self.swing / weights.reach)
        counted = np.round(frictions * weights.count)
        factors = frozen(np.stack([retriangulate(stacked) for stacked in both]))
        rows = frozen(self.moving.rows + counted, int)
        return replace(self.moving, factors=factors, rows=rows)


def divided(all_rows: Sequence[ObservationRows]) -> DividedRows:
    """Return separate R factors of rows in motion and of rows at rest.

    Args:
        all_rows: rows of all recordings, with their standstills marked.
    """
    first = all_rows[0]
    rows = first.target.shape[1]
    moving = standing = swinging = empty(first.names, first.units, rows)
    standstills, swing, length = np.zeros(rows), np.zeros(rows), np.zeros(rows)
    for part in all_rows:
        for row in range(rows):
            share = part.standing[:, row]
            rests = part.present[:, row] & (share > 0.0)
            moves = part.present[:, row] & (share == 0.0)
            weight = part.breakaway[moves, row]
            in_motion = part.matrix[moves, row] * weight[:, None]
            moving = absorb(moving, in_motion, part.target[moves, row] * weight, row)
            matrix, target = part.matrix[rests, row], part.target[rests, row]
            ranges = share[rests] * part.swing[rests, row]
            root, wider = np.sqrt(share[rests]), np.sqrt(ranges)
            standing = absorb(standing, matrix * root[:, None], target * root, row)
            swinging = absorb(swinging, matrix * wider[:, None], target * wider, row)
            standstills[row] += share[rests].sum()
            swing[row] += ranges.sum()
            length[row] += rests.sum()
    count = np.maximum(standstills, 1.0)
    return DividedRows(
        moving, standing, swinging, standstills, swing / count, np.maximum(length, 1.0) / count, first.coulomb
    )


def with_weights(all_rows: Sequence[ObservationRows], weights: RestWeights) -> list[ObservationRows]:
    """Return the rows with other weights of their standstills.

    Args:
        all_rows: rows of all recordings, with their standstills marked.
        weights: weights of the standstills.
    """
    return [replace(part, rest=weights) for part in all_rows]


def with_breakaway(
    all_rows: Sequence[ObservationRows],
    cases: Sequence[Case],
    decimator: Decimator,
    torque_rows: TorqueRows,
    values: np.ndarray,
) -> list[ObservationRows]:
    """Return the rows with lower weights shortly after standstills, where the friction at rest still decays.

    The travel δ of this decay is estimated from residuals, as the module's docstring explains.

    Args:
        all_rows: rows of all recordings.
        cases: recordings.
        decimator: filter and decimation of the rows.
        torque_rows: kind of torques in the rows.
        values: (p,) parameters of a fit, whose residuals are used.
    """
    parts = divided(all_rows)
    spread = parts.standing.residual_squares(values) / np.maximum(parts.standstills, 1.0)
    travels = [_travel_since_standstill(part, case, decimator, torque_rows) for part, case in zip(all_rows, cases)]
    squares, all_travels = [], []
    for row in range(len(spread)):
        moves = [part.present[:, row] & (part.standing[:, row] == 0.0) for part in all_rows]
        residuals = [part.target[mask, row] - part.matrix[mask, row] @ values for part, mask in zip(all_rows, moves)]
        squares.append(np.concatenate(residuals) ** 2)
        all_travels.append(np.concatenate([travel[mask, row] for travel, mask in zip(travels, moves)]))

    best_cost, best_fade, best_variance = np.inf, 0.0, np.ones(len(spread))
    for fade in TRAVELS:
        cost, variance = 0.0, np.ones(len(spread))
        for row, (square, travel) in enumerate(zip(squares, all_travels)):
            if len(square) == 0:
                continue
            friction = spread[row] * _remembered(travel, fade)
            variance[row] = _variance_in_motion(square, friction)
            total = variance[row] + friction
            cost += float(np.sum(np.log(total) + square / total))
        if cost < best_cost:
            best_cost, best_fade, best_variance = cost, fade, variance

    result = []
    for part, travel in zip(all_rows, travels):
        ratio = spread * _remembered(travel, best_fade) / best_variance
        result.append(replace(part, breakaway=frozen(1.0 / np.sqrt(1.0 + ratio))))
    return result


def _travel_since_standstill(
    part: ObservationRows, case: Case, decimator: Decimator, torque_rows: TorqueRows
) -> np.ndarray:
    """Return the travel (M, rows) of each row's joint since its last standstill [rad or m].

    It is infinite before the first standstill.

    Args:
        part: rows of one recording.
        case: the recording.
        decimator: filter and decimation of the rows.
        torque_rows: kind of torques in the rows.
    """
    index = kept(case.motion.segment, decimator)
    segment = case.motion.segment[index]
    position = torque_rows.of_joints(case.motion.q)[index]
    result = np.full(part.target.shape, np.inf)
    for start, stop in segments(segment):
        for row in range(part.standing.shape[1]):
            runs = _runs(part.standing[start:stop, row] > 0.0)
            starts = [start + first for first, _ in runs[1:]]
            for (_, end), following in zip(runs, [*starts, stop]):
                moving = slice(start + end, following)
                away = np.abs(position[moving, row] - position[start + end - 1, row])
                result[moving, row] = np.maximum.accumulate(away)
    return result


def _remembered(travel: np.ndarray, fade: float) -> np.ndarray:
    """Return the share of the variance of friction at rest that remains after a travel.

    Args:
        travel: travel since the last standstill [rad or m].
        fade: travel δ over which friction at rest decays; 0: no friction at rest remains.
    """
    if fade == 0.0:
        return np.zeros(travel.shape)
    return np.exp(-2.0 * travel / fade)


def _variance_in_motion(squares: np.ndarray, friction: np.ndarray) -> float:
    """Return the most probable variance s² of residuals whose total variance is s² plus the variance of friction.

    Args:
        squares: (M,) squared residuals.
        friction: (M,) variances of friction at rest that remain.
    """
    variance = max(float(squares.mean()), 1e-300)
    for _ in range(VARIANCE_ROUNDS):
        variance = max(float(np.mean(squares * variance / (variance + friction))), 1e-300)
    return variance


def left_out_error(
    training: Sequence[ObservationRows],
    marked: Sequence[ObservationRows],
    std: np.ndarray,
    inflation: np.ndarray,
    prior: np.ndarray | None,
    apart: Sequence[int],
) -> float:
    """Return Σ (τ - τ̂)² of the rows in motion, each time block being predicted by a fit of the other blocks.

    τ are measured and τ̂ predicted torques. Their errors are not weighted, as in the errors shown to users. If rows
    were weighted by their residuals, a joint whose torques are fitted by wrong parameters would dominate.

    Args:
        training: rows with the tested treatment of standstills.
        marked: the same samples with their standstills marked.
        std, inflation: (rows,) standard deviation [N m or N] and variance inflation of the residuals.
        prior: (k, p + 1) whitened rows of the prior, to be appended to the rows [W y]; None without a prior.
        apart: indices of torque rows in a different unit, excluded from the sum.
    """
    rows = training[0].target.shape[1]
    data = triangulate(training)
    blocks = data.groups // rows - 1  # the last one holds samples beside cuts
    if blocks < 2:  # nothing to learn from without the only block
        return 0.0
    free = np.full(data.parameters, -1)
    squares = np.zeros(rows)
    for block in range(blocks):
        others = [other for other in range(blocks + 1) if other != block]
        values, _ = estimate(pool(data, rows, others), std, inflation, free, prior)
        for part in marked:
            moves = part.present & (part.standing == 0.0) & (part.block == block)[:, None]
            residual = part.target - part.matrix @ values
            squares += np.sum(residual**2 * moves, axis=0)
    squares[list(apart)] = 0.0
    return float(squares.sum())
