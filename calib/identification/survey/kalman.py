"""Nonlinear Kalman filters with a linear measurement: three rules, each with the covariance or its square root.

A rule defines the prediction m⁺ of a nonlinear step f from a mean m and deviations S, S Sᵀ = P:

    ekf     m⁺ = f(m),                D = F S,  F = ∂f/∂x  (Schmidt 1966)
    ukf     m⁺ = Σ w_i f(m ± γ S_i),  D = √w_i (f_i - m⁺), and w_0^c for the middle one  (Julier & Uhlmann 2004)
    cdkf    m⁺ = the same, γ = h = √3, D = [(f_i⁺ - f_i⁻) / 2h, √(h² - 1) (f_i⁺ + f_i⁻ - 2 f_0) / 2h²]
                                      (Nørgaard, Poulsen & Ravn 2000)

Then P⁺ = D Dᵀ + N Nᵀ with the process noise N. A covariance filter computes this sum; a square-root filter computes the
triangle of [D N] by QR (van der Merwe & Wan 2001). The measurement y = H x + e is linear, so that its update is exact
in all filters: Joseph's form, or one QR of the array [R^½ HS; 0 S] (Kaminski, Bryson & Schmidt 1971).
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from calib.errors import Diverged

# spread of the unscented points, and what is known of the distribution (Gaussian)
ALPHA, BETA = 0.1, 2.0
# h of central differences, for Gaussian kurtosis
STEP = np.sqrt(3.0)


@dataclass(frozen=True)
class Filter:
    """Type of a filter: rule and form of the covariance.

    Attributes:
        rule: ``ekf``, ``ukf`` or ``cdkf``.
        root: whether the square root of the covariance is stored instead of the covariance.
    """

    rule: str
    root: bool


@dataclass(frozen=True, eq=False)
class Belief:
    """Mean and covariance of a state of L components.

    Attributes:
        mean: (L,) mean of the state.
        spread: (L, L) covariance, or its lower triangular root S.
        root: whether `spread` is the root.
    """

    mean: np.ndarray
    spread: np.ndarray
    root: bool

    @property
    def covariance(self) -> np.ndarray:
        if self.root:
            return self.spread @ self.spread.T
        return self.spread

    @property
    def deviations(self) -> np.ndarray:
        """Lower triangular root S (L, L) of the covariance.

        Raises:
            Diverged: if the covariance is no longer positive definite.
        """
        if self.root:
            return self.spread
        try:
            return np.linalg.cholesky(self.spread)
        except np.linalg.LinAlgError as error:
            raise Diverged(
                "the filter diverged: its covariance is not positive definite; use another method", self.mean
            ) from error


def believe(mean: np.ndarray, sigma: np.ndarray, kind: Filter) -> Belief:
    """Return the belief with mean (L,) and independent components of standard deviations sigma (L,).

    Args:
        mean: (L,) mean of the state.
        sigma: (L,) standard deviations.
        kind: form of the covariance.
    """
    spread = np.diag(sigma if kind.root else sigma**2)
    return Belief(np.array(mean, dtype=float), spread, kind.root)


def points(before: Belief, kind: Filter, narrower: float = 1.0) -> np.ndarray:
    """Return the sigma points (2 L + 1, L) of a belief, the mean first.

    Args:
        before: mean and covariance of a state of L components.
        kind: rule of the filter, which gives the distance of the points from the mean.
        narrower: factor of this distance.
    """
    deviations = before.deviations
    gamma = narrower * _gamma(kind, len(before.mean))
    steps = gamma * deviations.T
    return np.concatenate([before.mean[None], before.mean + steps, before.mean - steps])


def predicted(images: np.ndarray, noise: np.ndarray, kind: Filter, narrower: float = 1.0) -> Belief:
    """Return the predicted belief from the propagated sigma points.

    Args:
        images: (2 L + 1, L) states after the step, from those of `points`.
        noise: N (L, k) effect of the process noise.
        kind: rule of the filter, and form of its covariance.
        narrower: factor of the points' distance that was used.
    """
    size = images.shape[1]
    gamma = narrower * _gamma(kind, size)
    middle = images[0]
    ahead = images[1 : size + 1] - images[0]
    behind = images[size + 1 :] - images[0]
    share = 0.5 / gamma**2
    shift = share * (ahead + behind).sum(axis=0)
    if kind.rule == "cdkf":
        first = 0.5 / gamma * (ahead - behind)
        second = np.sqrt(max(gamma**2 - 1.0, 0.0)) * share * (ahead + behind)
        outer = np.vstack([first, second]).T
        return _packed(middle + shift, outer, noise, kind, 0.0, shift)
    outer = np.sqrt(share) * np.vstack([ahead, behind])
    # Σ w (f - m⁺)(f - m⁺)ᵀ about f_0: with Σ w_i = 1 and w_0^c = w_0 + 1 - α² + β, β - α² is left of the middle ones
    centre_weight = BETA - (narrower * ALPHA) ** 2
    return _packed(middle + shift, outer.T, noise, kind, centre_weight, shift)


def linearly_predicted(before: Belief, mean: np.ndarray, slopes: np.ndarray, noise: np.ndarray, kind: Filter) -> Belief:
    """Return the predicted belief of a linearised step.

    Args:
        before: belief before the step.
        mean: (L,) mean after the step.
        slopes: F (L, L) Jacobian of the step.
        noise: N (L, k) effect of the process noise.
        kind: form of the covariance.
    """
    if kind.root:
        return _packed(mean, slopes @ before.spread, noise, kind, 0.0, mean)
    return Belief(mean, slopes @ before.spread @ slopes.T + noise @ noise.T, False)


def corrected(before: Belief, measured: np.ndarray, rows: int, std: np.ndarray) -> tuple[Belief, float]:
    """Return the belief corrected by a measurement of its first `rows` components, and the innovation's size.

    The size is eᵀ (H P Hᵀ + R)⁻¹ e for the innovation e (measured minus expected), with H P Hᵀ the covariance of the
    measured components before and R = diag(std²); its mean is `rows` if the filter's noise levels are correct.

    Args:
        before: belief before the measurement.
        measured: (rows,) measured values.
        rows: number of measured components.
        std: (rows,) standard deviations of the measurement.
    """
    innovation = measured - before.mean[:rows]
    size = len(before.mean)
    if before.root:
        array = np.zeros((rows + size, rows + size))
        array[:rows, :rows] = np.diag(std)
        array[:rows, rows:] = before.spread[:rows]
        array[rows:, rows:] = before.spread
        lower = _triangle(array)
        white = scipy.linalg.solve_triangular(lower[:rows, :rows], innovation, lower=True)
        correction = lower[rows:, :rows] @ white
        after = Belief(before.mean + correction, lower[rows:, rows:], True)
        return after, float(white @ white)
    cross = before.spread[:, :rows]
    innovation_covariance = cross[:rows] + np.diag(std**2)
    gain = np.linalg.solve(innovation_covariance, cross.T).T
    remainder = np.eye(size)
    remainder[:, :rows] -= gain
    spread = remainder @ before.spread @ remainder.T + (gain * std**2) @ gain.T
    mean = before.mean + gain @ innovation
    after = Belief(mean, 0.5 * (spread + spread.T), False)
    return after, float(innovation @ np.linalg.solve(innovation_covariance, innovation))


def _gamma(kind: Filter, size: int) -> float:
    return float(STEP if kind.rule == "cdkf" else ALPHA * np.sqrt(size))


def _packed(
    mean: np.ndarray, deviations: np.ndarray, noise: np.ndarray, kind: Filter, weight: float, extra: np.ndarray
) -> Belief:
    """Return the belief with covariance P = D Dᵀ + N Nᵀ + weight · extra extraᵀ.

    Args:
        mean: (L,) mean of the state.
        deviations: D (L, m).
        noise: N (L, k).
        kind: form of the covariance.
        weight: weight of the last part.
        extra: (L,) vector of the last part.
    """
    wide = np.hstack([deviations, noise, np.sqrt(weight) * extra[:, None]])
    if kind.root:
        return Belief(mean, _triangle(wide), True)
    spread = wide @ wide.T
    return Belief(mean, spread, False)


def _triangle(wide: np.ndarray) -> np.ndarray:
    """Return the lower triangular matrix L with L Lᵀ = A Aᵀ, from A = `wide` (L, k) by QR."""
    triangle = scipy.linalg.qr(wide.T, mode="r", check_finite=False, overwrite_a=True)[0]
    return np.asarray(triangle)[: len(wide)].T
