"""Objectives of motion design, with exact gradients.

Excitation indices are functions of the observation matrix W, which stacks the regressors of all samples, with the rows
of joint j divided by sigma_j. They depend on the eigenvalues λ = s² of the information matrix M = Wᵀ W + M_existing of
b parameters; without M_existing, s are the singular values of W:



    cond       s_1 / s_b                       minimise (Gautier & Khalil 1992; Kolyubin et al. 2019, eq. 24)
    logdet     -(log det M) / b                minimise (D-optimality; per column, so that searches are well scaled)
    smallest   -s_b                            minimise (E-optimality)
    trace      log tr(A M⁻¹) / 2               minimise (A-optimality; I-optimality where A = Σ yᵀy of a task's rows y,
                                               whose predicted variances tr(A M⁻¹) sums)

Swevers et al. (1997) weight the rows with the covariance of the torques: logdet with `sigmas`. Column scaling: ``raw``
uses the columns in SI units, ``normalised`` divides each column by its norm over the motion (so that the unit of a
parameter does not matter), or a vector of scales is given. For logdet, the ranking of motions is the same for every
fixed scaling.

Gradients: ∂F/∂W = 2 W S with S = ∂F/∂M. cond and smallest have kinks where singular values coincide, and their optima
lie at such kinks. A `sharpness` p < ∞ replaces max λ by (Σ λ^p)^(1/p) and min λ by (Σ λ^-p)^(-1/p). The smoothed cond
is between cond and b^(1/p) cond, and its gradient is exact.
"""

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, get_args

import numpy as np

from ..basis import SampledMotion
from ..constraints import TorqueProduct
from ..errors import BadInput, NotExciting

Index = Literal["cond", "logdet", "smallest", "trace"]
Scaling = Literal["raw", "normalised"]


class Value(NamedTuple):
    """An objective's value and its gradients.

    Attributes:
        value: the objective, smoothed.
        by_torque: (N, n) gradient by the torques; None where the objective does not depend on them.
        by_motion: (4, N, n) gradient by q, v, a, jerk; None where the objective does not depend on them.
        by_duration: gradient by the duration of the motion [1/s].
        exact: value of the objective without smoothing.
        by_information: (c, c) gradient of an excitation index by the information matrix; empty for other objectives.
    """

    value: float
    by_torque: np.ndarray | None = None
    by_motion: np.ndarray | None = None
    by_duration: float = 0.0
    exact: float = np.nan
    by_information: np.ndarray = np.zeros((0, 0))


class Observed(NamedTuple):
    """Weighted observation matrix and information matrix, for the columns of the regressor that an objective uses.

    Attributes:
        W: (n N, c) weighted observation matrix, joint after joint.
        M: (c, c) information matrix Wᵀ W, plus that of motions recorded before.
        shape: shape (N, n, b) of the regressor.
        sigmas: (n,) standard deviations of the torques; None takes 1.
        columns: indices of the regressor's b columns that are in W.
    """

    W: np.ndarray
    M: np.ndarray
    shape: tuple[int, ...]
    sigmas: np.ndarray | None
    columns: np.ndarray | slice

    def by_regressor(self, by_information: np.ndarray) -> np.ndarray:
        """Return the gradient (N, n, b) of an excitation index by the regressor, from that by the information matrix.

        With W the observation matrix, it is 2 W S, divided by the standard deviations `sigmas`.

        Args:
            by_information: S (c, c), symmetric gradient of the index by the information matrix.
        """
        count, n, b = self.shape
        slope = np.zeros((b, n, count))
        by_matrix = 2 * by_information @ self.W.T
        slope[self.columns] = by_matrix.reshape(len(by_information), n, count)
        if self.sigmas is not None:
            slope = slope / self.sigmas[:, None]
        return slope.transpose(2, 1, 0)


@dataclass(frozen=True, eq=False)
class Excitation:
    """An excitation index of the information matrix, as an objective to minimise.

    Attributes:
        index: "cond", "logdet", "smallest" or "trace".
        scaling: "raw", "normalised", or (b,) scales by which the regressor's columns are divided.
        sharpness: p of the smoothing, which replaces the largest eigenvalue by (Σ λ^p)^(1/p); infinite for no
            smoothing.
        sigmas: (n,) standard deviations of the torques [N m or N]; None takes 1. An infinite value excludes the rows of
            that joint.
        existing: (b, b) information matrix of motions recorded before, computed with these sigmas; None for no such
            motions. If R is a triangular factor of their observation matrix, the information matrix is Rᵀ R.
        columns: (c,) indices of the regressor's columns to use; None uses all.
        task: (c, c) A of the index "trace", for these columns; None takes the identity.

    Raises:
        BadInput: an unknown index or scaling.
    """

    index: Index = "cond"
    scaling: Scaling | np.ndarray = "raw"
    sharpness: float = np.inf
    sigmas: np.ndarray | None = None
    existing: np.ndarray | None = None
    columns: np.ndarray | None = None
    task: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.index not in get_args(Index):
            raise BadInput(f"index '{self.index}' is not one of {', '.join(get_args(Index))}")
        if isinstance(self.scaling, str) and self.scaling not in get_args(Scaling):
            raise BadInput(f"scaling '{self.scaling}' is not one of {', '.join(get_args(Scaling))}")

    @property
    def name(self) -> str:
        if isinstance(self.scaling, str):
            return f"{self.index} {self.scaling}"
        return f"{self.index} scaled"

    def evaluate(self, motion: SampledMotion, regressor: np.ndarray) -> Value:
        """Return the index of a motion and its gradient with respect to the information matrix.

        Args:
            motion: the motion; not used, since the regressor is given.
            regressor: (N, n, b) of the motion's N samples.
        """
        return self.seen(self.observed(regressor))

    def observed(self, regressor: np.ndarray) -> Observed:
        """Return the weighted observation matrix and its information matrix, from the regressor (N, n, b) of a motion.

        They contain only the regressor's columns that this objective uses.
        """
        columns = slice(None)
        if self.columns is not None:
            columns = self.columns
        by_column = regressor.transpose(2, 1, 0)[columns]
        Y = by_column.transpose(2, 1, 0)
        if self.sigmas is not None:
            Y = Y / self.sigmas[:, None]
        W = _stacked(Y)
        existing = None
        if self.existing is not None:
            existing = self.existing[columns][:, columns]
        return Observed(W, information(W, existing), regressor.shape, self.sigmas, columns)

    def seen(self, matrix: Observed) -> Value:
        """Return the index of an observation matrix that was formed for this objective by `observed`."""
        value, by_m, exact = self.of_information(matrix.M)
        return Value(value, exact=exact, by_information=by_m)

    def of_information(self, M: np.ndarray) -> tuple[float, np.ndarray, float]:
        """Return the index F of an information matrix M (c, c), its gradient S = ∂F/∂M, and F without smoothing.

        With normalised columns, F is that of C = D M D, D = diag(M)^-1/2. With S_C the gradient by C, ∂F/∂M = D S_C D -
        diag((C S_C)_kk / M_kk).
        """
        diagonal = np.diag(M)
        if not (diagonal > 0).all():
            raise NotExciting(
                f"column {int(np.argmin(diagonal))} of the regressor is zero along the whole motion: remove it, or "
                "move more joints"
            )
        if self.index == "trace":
            return self._trace(M)
        normalised = isinstance(self.scaling, str) and self.scaling == "normalised"
        if normalised:
            d = diagonal**-0.5
        elif isinstance(self.scaling, str):
            d = 1.0
        else:
            d = 1.0 / self.scaling
        d = np.broadcast_to(d, diagonal.shape)
        C = M * d * d[:, None]
        eigenvalues, V = np.linalg.eigh(C)
        rounding = 1e-15  # eigenvalues below this part of the largest are rounding
        eigenvalues = np.maximum(eigenvalues, rounding * eigenvalues[-1])
        value, slope = self._of_spectrum(eigenvalues)
        exact = value
        if not np.isinf(self.sharpness):
            unsmoothed = replace(self, sharpness=np.inf)
            exact, _ = unsmoothed._of_spectrum(eigenvalues)
        by_c = (V * slope) @ V.T
        by_m = by_c * d * d[:, None]
        if normalised:
            along_scale = np.einsum("ij,ji->i", C, by_c)
            by_m -= np.diag(along_scale / diagonal)
        return value, by_m, exact

    def _trace(self, M: np.ndarray) -> tuple[float, np.ndarray, float]:
        """Return the index log tr(A M⁻¹) / 2 of M (c, c), its derivative by M, and the unsmoothed index.

        The derivative is -M⁻¹ A M⁻¹ / (2 tr(A M⁻¹)). The third value repeats the first, since this index needs no
        smoothing.
        """
        d = np.diag(M) ** -0.5
        scaled = M * d * d[:, None]
        eigenvalues, V = np.linalg.eigh(scaled)
        regular = np.maximum(eigenvalues, 1e-15 * eigenvalues[-1])
        inverse = (V / regular) @ V.T * d * d[:, None]
        spread = inverse
        if self.task is not None:
            spread = inverse @ self.task
        trace = float(np.trace(spread))
        value = 0.5 * np.log(trace)
        return value, -0.5 * spread @ inverse / trace, value

    def _of_spectrum(self, eigenvalues: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the index F and its derivative ∂F/∂λ from the eigenvalues λ (c,) of the information matrix.

        Args:
            eigenvalues: λ, smallest first.
        """
        if self.index == "logdet":
            return -float(np.log(eigenvalues).mean()), -1.0 / eigenvalues / len(eigenvalues)
        low, by_low = _extreme(eigenvalues, -self.sharpness)
        if self.index == "smallest":
            smallest = np.exp(low / 2)
            return -smallest, -smallest / 2 * by_low
        high, by_high = _extreme(eigenvalues, self.sharpness)
        value = float(np.exp((high - low) / 2))
        return value, value / 2 * (by_high - by_low)


@dataclass(frozen=True, eq=False)
class TorqueSlack:
    """Mean distance of the joint torques from their limits: 1 - mean over joints and time of |τ_j| / τ_max.

    Eq. 24 of Kolyubin et al. (2019) requires F = mean(τ_max - |τ|) ≤ k τ_max. The slack F is *minimised*: a goal of k =
    0.9 requires a mean torque of at least a tenth of the limit. The absolute value is smoothed as √(τ² + (ε τ_max)²) -
    ε τ_max, ε = `smoothing`, which is never above |τ|. τ = Y χ is the motor torque; without the motor's share, the
    torques of a light wrist could not reach such goals.

    Attributes:
        joints: indices of the joints averaged over.
        parameters: (b,) χ, the parameters of the regressor's columns.
        limits: (n,) τ_max [N m or N].
        torque_product: (q, v, a, χ, G (N, n)) -> slopes of Σ G · Y χ in q, v, a.
        smoothing: ε, as a share of the torque limit.
        label: name in messages; empty for a name made from the joints.
    """

    joints: tuple[int, ...]
    parameters: np.ndarray
    limits: np.ndarray
    torque_product: TorqueProduct
    smoothing: float = 1e-3
    label: str = ""

    @property
    def name(self) -> str:
        numbers = ", ".join(str(j + 1) for j in self.joints)
        return self.label or f"torque slack of joints {numbers}"

    def evaluate(self, motion: SampledMotion, regressor: np.ndarray) -> Value:
        chosen = list(self.joints)
        torque = regressor[:, chosen] @ self.parameters
        ratio = torque / self.limits[chosen]
        size = np.sqrt(ratio**2 + self.smoothing**2)
        by_torque = np.zeros(regressor.shape[:2])
        by_torque[:, chosen] = -ratio / size / self.limits[chosen] / ratio.size
        value = 1.0 - float((size - self.smoothing).mean())
        return Value(value, by_torque, exact=value)


@dataclass(frozen=True, eq=False)
class FrictionCoverage:
    """Objective: shortfall from the required shares of time at low and at high speed, in both directions.

        F = mean over joints and the four ranges of  (max(0, 1 - share / wanted))²

    The four ranges of speed are fast and slow, each forward and backward. The share of time in a range is the mean of a
    smooth (logistic) membership of v. With the logistic function σ, high speed is σ((±v - high) / (`width` high)) and
    low speed is σ(±v / w) - σ((±v - low) / w), w = `width` low.

    Attributes:
        low, high: (n,) speeds [rad/s or m/s], 0 < low < high.
        wanted: required share of the time in each of the four ranges.
        width: width of the logistic transitions, relative to the speed.
    """

    low: np.ndarray
    high: np.ndarray
    wanted: float = 0.1
    width: float = 0.2
    name: str = "friction coverage"

    def evaluate(self, motion: SampledMotion, regressor: np.ndarray) -> Value:
        count, n = motion.v.shape
        value = 0.0
        slope = np.zeros((4, count, n))
        slow = self.width * self.low
        fast = self.width * self.high
        for sign in (1.0, -1.0):
            v = sign * motion.v
            zero, d_zero = _logistic(v / slow)
            lo, d_lo = _logistic((v - self.low) / slow)
            hi, d_hi = _logistic((v - self.high) / fast)
            at_high = (hi, d_hi / fast)
            at_low = (zero - lo, (d_zero - d_lo) / slow)
            for member, by_v in (at_high, at_low):
                share = member.mean(axis=0)
                missing = np.maximum(0.0, 1.0 - share / self.wanted)
                value += float((missing**2).sum()) / (4 * n)
                slope[1] -= sign * 2 * missing / self.wanted / count / (4 * n) * by_v
        return Value(value, None, slope, exact=value)

    def shares(self, motion: SampledMotion) -> np.ndarray:
        """Return the shares of time (4, n) without smoothing: fast forward, slow forward, fast backward, slow backward.

        Args:
            motion: the motion, whose samples have equal time steps.
        """
        rows = []
        for v in (motion.v, -motion.v):
            fast = (v > self.high).mean(axis=0)
            slow = ((v > 0) & (v < self.low)).mean(axis=0)
            rows += [fast, slow]
        return np.array(rows)


@dataclass(frozen=True)
class Duration:
    """The period [s] as an objective, for problems in which the period is a free variable."""

    name: str = "duration"

    def evaluate(self, motion: SampledMotion, regressor: np.ndarray) -> Value:
        step = motion.times[1] - motion.times[0]
        value = float(len(motion) * step)
        return Value(value, by_duration=1.0, exact=value)


Objective = Excitation | TorqueSlack | FrictionCoverage | Duration


def information(stacked: np.ndarray, existing: np.ndarray | None = None) -> np.ndarray:
    """Return the information matrix M = Wᵀ W + M_existing (b, b).

    Args:
        stacked: W (rows, b), the observation matrix.
        existing: M_existing (b, b), information of motions recorded before; None for no such motions.
    """
    M = stacked.T @ stacked
    if existing is None:
        return M
    return M + existing


def condition_numbers(
    regressor: np.ndarray,
    sigmas: np.ndarray | None = None,
    existing: np.ndarray | None = None,
    columns: np.ndarray | None = None,
) -> dict[str, float]:
    """Return the condition number of the observation matrix with raw and with normalised columns.

    It is computed by SVD of the observation matrix, which is more accurate than by the eigenvalues of the information
    matrix.

    Args:
        regressor: (N, n, b) of a motion's N samples.
        sigmas: (n,) standard deviations by which the rows are divided; None takes 1.
        existing: (b, b) information matrix of motions recorded before; None for no such motions.
        columns: (c,) indices of the columns to use; None uses all.

    Returns:
        The condition numbers by "raw" and "normalised"; infinite if a column is zero.
    """
    if sigmas is not None:
        regressor = regressor / sigmas[:, None]
    W = _stacked(regressor)
    triangle = np.asarray(np.linalg.qr(W, mode="r"))
    if existing is not None:
        values, V = np.linalg.eigh(existing)
        rows = np.sqrt(np.maximum(values, 0.0))[:, None] * V.T
        triangle = np.concatenate([triangle, rows])
    if columns is not None:
        triangle = triangle[:, columns]
    norms = np.linalg.norm(triangle, axis=0)
    if not norms.all():
        return {"raw": np.inf, "normalised": np.inf}
    spectra = {"raw": triangle, "normalised": triangle / norms}
    numbers = {}
    for key, matrix in spectra.items():
        singular_values = np.linalg.svd(matrix, compute_uv=False)
        numbers[key] = _cond(singular_values)
    return numbers


def _cond(s: np.ndarray) -> float:
    return float(s[0] / s[-1]) if s[-1] > 0 else np.inf


def _stacked(regressor: np.ndarray) -> np.ndarray:
    """Return the observation matrix W (n N, b), the rows of joint 1 first, from a regressor (N, n, b).

    The result shares the regressor's memory if that is ordered (b, n, N).
    """
    count, n, b = regressor.shape
    return regressor.transpose(2, 1, 0).reshape(b, n * count).T


def _extreme(eigenvalues: np.ndarray, p: float) -> tuple[float, np.ndarray]:
    """Return log (Σ λ^p)^(1/p) of eigenvalues λ (c,), a smoothed log of an extreme eigenvalue, and its gradient by λ.

    For p = ∞ the value is the log of the largest λ, for p = -∞ of the smallest.
    """
    logs = np.log(eigenvalues)
    if np.isinf(p):
        slope = np.zeros_like(logs)
        if p > 0:
            k = int(np.argmax(logs))
        else:
            k = int(np.argmin(logs))
        slope[k] = 1.0 / eigenvalues[k]
        return float(logs[k]), slope
    top = (p * logs).max()
    shares = np.exp(p * logs - top)
    total = shares.sum()
    value = float((top + np.log(total)) / p)
    return value, shares / total / eigenvalues


def _logistic(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    s = 0.5 * (1.0 + np.tanh(0.5 * x))
    return s, s * (1.0 - s)
