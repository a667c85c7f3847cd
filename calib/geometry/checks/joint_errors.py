"""Errors of joint readings: a joint whose readings have a factor, and random errors of all joints.

Both are tested on the residuals of the rigid fit. A gear ratio that is wrong by the factor 1 + κ turns joint j by κ q_j
beyond its reading. The score test of `calib.geometry.checks.row_changes` gives the gain of this one number, and those
of its rivals: harmonics of each joint's own angle, and couplings with another joint. The factor is named only if it
explains the residuals better than any rival, also on held-out rows.

Random errors of all joints, with standard deviation s, add J_i J_iᵀ s² to the covariance of row i, with J_i the
derivatives of the measured position by the joints. The likelihood of this covariance is compared with those of noise of
one size, and of noise that grows with the same lever arms but has no direction:

    C_i = σ² I,   C_i = σ² I + s² J_i J_iᵀ,   C_i = σ² I + s² tr(J_i J_iᵀ)/3 I.

Commanded joints instead of measured ones, rounded joints, joints read while moving, and backlash have this effect.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from calib.data.poses.measurements import Positions
from calib.errors import Finding, finding
from calib.geometry.checks.row_changes import (
    MIN_ROWS,
    RowChange,
    Subject,
    WhitenedRows,
    best_gain,
    holds_on_held_out,
    significant,
    size_of,
    whitened_rows,
    without_gross,
)
from calib.geometry.observation import layout
from calib.geometry.weighing import GeometricFit

# largest sum of squares that a factor leaves, as a share of what its best rival leaves (our choice)
MAX_RIVAL_LEFT = 0.5
# largest number of joints with a factor
MAX_FACTORS = 2
# smallest difference of log-likelihoods per row that names random joint errors, and in total (our choice)
MIN_GAIN_PER_ROW = 0.1
MIN_GAIN = 10.0
# smallest share of the residuals' variance that joint errors explain (our choice)
MIN_SHARE = 0.7
# ratios s²/σ² that are tried, as powers of ten (whitened rows)
RATIOS = (-9.0, 9.0)
# largest distance of a joint reading from a multiple of the step to which readings are rounded, in steps
MAX_OFF_STEP = 1e-3
# steps of rounded readings that are tried [rad]: 1°, 0.1°, 0.01°, and 10 mrad, 1 mrad
STEPS = (np.radians(1.0), np.radians(0.1), np.radians(0.01), 1e-2, 1e-3)
# largest factor between the error that rounding causes and the one that is estimated (our choice)
MAX_ROUNDING_RATIO = 1.5


def joint_factors(fit: GeometricFit) -> list[Finding]:
    """Return findings on joints whose readings have a factor, as with a wrong gear ratio.

    Args:
        fit: a fit without joint corrections.
    """
    findings = []
    for number, block in enumerate(fit.blocks):
        if not isinstance(block.measured, Positions) or len(block.measured) < MIN_ROWS:
            continue
        rows = without_gross(whitened_rows(fit, number))
        for _ in range(MAX_FACTORS):
            change = _best_factor(fit, rows)
            if change is None:
                break
            size = size_of(rows, change)
            values = {"factor": 1.0 + size.size, "off": abs(size.size), "sigma": size.sigma}
            residuals = {"before": size.before, "after": size.after}
            findings.append(finding("joint-factor", file=size.file, joint=size.name, **values, **residuals))
            rows = rows.with_columns(change.columns)
        if findings:
            break
    return findings


def _best_factor(fit: GeometricFit, rows: WhitenedRows) -> RowChange | None:
    """Return the factor of one joint's readings that explains the residuals; None if none meets all conditions.

    Args:
        fit: a fit without joint corrections.
        rows: the whitened rows of one of its blocks.
    """
    residuals = rows.residuals(rows.solve())
    cost = float(np.sum(residuals**2))
    zeros = dict(_zero_columns(fit, rows))
    best = None
    for joint, (name, columns) in enumerate(zeros.items()):
        q = rows.block.measured.q[:, joint]
        subject = Subject("factor", name, columns * (q - q.mean())[:, None, None])
        change = best_gain(rows, residuals, subject)
        if best is None or change.gain > best.gain:
            best = change
    if best is None:
        return None
    effective = rows.matrix.shape[2] - rows.resting()
    if not significant(best, cost, residuals.size - effective, len(zeros)):
        return None
    joint = list(zeros).index(best.subject.name)
    rivals = [best_gain(rows, residuals, subject).gain for subject in _rivals(rows, list(zeros.values()), joint)]
    if cost - best.gain > MAX_RIVAL_LEFT * (cost - max(rivals)):
        return None
    if not holds_on_held_out(rows, best):
        return None
    return best


def _zero_columns(fit: GeometricFit, rows: WhitenedRows) -> Iterator[tuple[str, np.ndarray]]:
    """Yield each joint's name and the whitened derivatives (m, d, 1) of the rows by its zero.

    Args:
        fit: a fit without joint corrections.
        rows: the whitened rows of one of its blocks.
    """
    chain = fit.cell.chain
    table = layout(fit.cell)
    column = {table.names[k]: number for number, k in enumerate(table.index("arm", "station", "tool"))}
    for joint, element in zip(chain.joint_names, chain.moving):
        number = column[chain.names[element]]
        yield joint, rows.matrix[:, :, [number]]


def _rivals(rows: WhitenedRows, zeros: list[np.ndarray], joint: int) -> Iterator[Subject]:
    """Yield other errors of joints: harmonics of their own angle, and couplings with the other joints' values.

    Args:
        rows: the whitened rows of one block.
        zeros: derivatives (m, d, 1) of the rows by each joint's zero.
        joint: index of the joint whose factor is tested.
    """
    q = rows.block.measured.q
    for driven, columns in enumerate(zeros):
        for order in (1.0, 2.0):
            angle = order * q[:, driven]
            harmonics = np.column_stack([np.sin(angle), np.cos(angle)])
            yield Subject("harmonic", str(driven), columns * harmonics[:, None, :])
        for source in range(len(zeros)):
            if (driven, source) != (joint, joint):
                centred = q[:, source] - q[:, source].mean()
                yield Subject("coupling", str(driven), columns * centred[:, None, None])


@dataclass(frozen=True)
class JointScatter:
    """Random errors of all turning joints that explain the residuals.

    Attributes:
        sigma: standard deviation of each joint's error [rad].
        share: share of the residuals' variance that these errors explain.
        gain: log-likelihood minus that of the best rival.
        rms: rms of the position residuals [m].
        step: step to which the joint readings are rounded, if that explains the errors [rad]; 0: it does not.
    """

    sigma: float
    share: float
    gain: float
    rms: float
    step: float


def joint_scatter(fit: GeometricFit) -> JointScatter | None:
    """Return the random joint errors that explain the residuals of a fit; None if they do not.

    Args:
        fit: a fit without joint corrections.
    """
    chain = fit.cell.chain
    turning = [joint.kind != "prismatic" for joint in chain.joints]
    for number, block in enumerate(fit.blocks):
        if not isinstance(block.measured, Positions) or len(block.measured) < MIN_ROWS or not any(turning):
            continue
        rows = without_gross(whitened_rows(fit, number))
        residuals = rows.residuals(rows.solve())[:, :3]
        columns = np.concatenate([column for _, column in _zero_columns(fit, rows)], axis=2)[:, :3, turning]
        return _scatter(rows, residuals, columns, rows.block.measured.q[:, turning])
    return None


def _scatter(rows: WhitenedRows, residuals: np.ndarray, columns: np.ndarray, q: np.ndarray) -> JointScatter | None:
    """Return the random errors of joints that explain residuals; None if a rival explains them as well.

    Args:
        rows: the whitened rows.
        residuals: (m, 3) whitened position residuals.
        columns: (m, 3, n) their derivatives by the turning joints.
        q: (m, n) readings of these joints [rad].
    """
    directed = columns @ columns.transpose(0, 2, 1)
    trace = np.trace(directed, axis1=1, axis2=2) / 3.0
    undirected = trace[:, None, None] * np.eye(3)
    none = _likelihood(residuals, directed, 0.0)
    ratio, likelihood = _best_ratio(residuals, directed)
    _, rival = _best_ratio(residuals, undirected)
    gain = likelihood - max(rival, none)
    if gain < max(MIN_GAIN, MIN_GAIN_PER_ROW * len(residuals)):
        return None
    variance = _variance(residuals, directed, ratio)
    share = float(ratio * trace.mean() / (1.0 + ratio * trace.mean()))
    sigma = float(np.sqrt(ratio * variance))
    if share < MIN_SHARE:
        return None
    return JointScatter(sigma, share, gain, rows.position_rms(residuals), _rounding(q, sigma))


def _best_ratio(residuals: np.ndarray, shape: np.ndarray) -> tuple[float, float]:
    """Return the ratio s²/σ² of the largest likelihood, and its logarithm.

    Args:
        residuals: (m, 3) residuals.
        shape: (m, 3, 3) covariance per s².
    """
    from scipy.optimize import fminbound  # slow to load

    scale = float(np.trace(shape, axis1=1, axis2=2).mean()) / 3.0

    def cost(power: float) -> float:
        return -_likelihood(residuals, shape, 10.0**power / scale)

    power, least, *_ = fminbound(cost, *RATIOS, full_output=True)
    return float(10.0**power / scale), -float(least)


def _covariance_parts(residuals: np.ndarray, shape: np.ndarray, ratio: float) -> tuple[np.ndarray, float]:
    """Return the covariances (m, 3, 3) per σ², and the σ² of the largest likelihood.

    Args:
        residuals: (m, 3) residuals.
        shape: (m, 3, 3) covariance per s².
        ratio: s²/σ².
    """
    covariance = np.eye(3) + ratio * shape
    weighted = np.linalg.solve(covariance, residuals[:, :, None])[:, :, 0]
    return covariance, float(np.sum(residuals * weighted) / residuals.size)


def _variance(residuals: np.ndarray, shape: np.ndarray, ratio: float) -> float:
    """Return the σ² of the largest likelihood for a ratio s²/σ²."""
    return _covariance_parts(residuals, shape, ratio)[1]


def _likelihood(residuals: np.ndarray, shape: np.ndarray, ratio: float) -> float:
    """Return the largest log-likelihood over σ² for a ratio s²/σ², up to a constant."""
    covariance, variance = _covariance_parts(residuals, shape, ratio)
    determinant = np.linalg.slogdet(covariance)[1].sum()
    return float(-0.5 * (residuals.size * np.log(max(variance, 1e-300)) + determinant))


def _rounding(q: np.ndarray, sigma: float) -> float:
    """Return the step to which readings are rounded if it causes errors of the estimated size; otherwise 0.

    Args:
        q: (m, n) readings [rad].
        sigma: standard deviation of each joint's error [rad].
    """
    for step in STEPS:
        multiples = q / step
        rounded = np.abs(multiples - np.round(multiples)).max() < MAX_OFF_STEP
        expected = step / np.sqrt(12.0)
        if rounded and sigma / MAX_ROUNDING_RATIO < expected < MAX_ROUNDING_RATIO * sigma:
            return step
    return 0.0


def scatter_finding(scatter: JointScatter) -> Finding:
    """Return the finding on random errors of all joints."""
    return finding(
        "joints-scatter",
        sigma=scatter.sigma,
        share=scatter.share,
        gain=scatter.gain,
        rms=scatter.rms,
        step=scatter.step or None,
    )
