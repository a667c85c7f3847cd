"""How wrong images are: corners one by one, and all corners of an image together.

    r_i = J_i M_i ξ_i + ε_i,   ε ~ N(0, f² σ²),   ξ ~ N(0, diag(s_v², s_v², s_v², s_ω², s_ω², s_ω²))

ξ is what the arm does not repeat and the model does not explain: a displacement and a turn of what the arm carries,
common to all corners of the image (M_i takes them to the board's twist). Were it left out, forty-eight corners would
count as forty-eight measurements of the arm. Both variances are estimated: f from what remains in each image after its
own best pose (2K - 6 numbers), s_v and s_ω by moments of those best poses' residuals beyond what ε explains
(variance components; Rao 1972).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from calib.arrays import frozen
from calib.estimation import robust

# change of a noise that repeats no fit, as a share, and of its [m, rad] (our choice)
MAX_NOISE_CHANGE, MIN_NOISE = 0.05, 2e-6


@dataclass(frozen=True, eq=False)
class ImageNoise:
    """The noise of one block of images.

    Attributes:
        factor: of the corners' stated sigmas.
        displacement: s_v [m].
        turn: s_ω [rad].
        weight: (m,) robust weight of each image.
    """

    factor: float = 1.0
    displacement: float = 0.0
    turn: float = 0.0
    weight: np.ndarray = field(default_factory=lambda: np.ones(0))

    def __post_init__(self) -> None:
        object.__setattr__(self, "weight", frozen(self.weight))

    @property
    def deviations(self) -> np.ndarray:
        """(6,) standard deviations of ξ."""
        return np.repeat([self.displacement, self.turn], 3)

    def near(self, other: ImageNoise) -> bool:
        """Say whether two estimates are alike, so that the fit need not be repeated."""
        pairs = ((self.factor, other.factor), (self.displacement, other.displacement), (self.turn, other.turn))
        alike = all(abs(a - b) <= MAX_NOISE_CHANGE * max(a, b) + MIN_NOISE for a, b in pairs)
        return alike and np.abs(self.weight - other.weight).max(initial=0.0) < 0.05


@dataclass(frozen=True, eq=False)
class OwnPoses:
    """What the images say of themselves: k of them, each fitted with a pose of its own.

    Attributes:
        residual: (k, 6) of what the arm carries: best pose minus predicted [v; ω].
        information: (k, 6, 6) of it, at the stated sigmas.
        within: (k,) squared residual that the own pose leaves, in sigmas.
        spare: (k,) numbers that are left for it, 2K - 6.
    """

    residual: np.ndarray
    information: np.ndarray
    within: np.ndarray
    spare: np.ndarray


def estimate_noise(found: OwnPoses, unknowns: int, loss: str = "none", scale: float | None = None) -> ImageNoise:
    """Return the noise that residuals at an optimum show.

    Args:
        found: see there.
        unknowns: parameters fitted to them.
        loss, scale: of a robust fit, for the images' weights.
    """
    k = len(found.spare)
    share = max(1.0 - unknowns / max(6 * k, 1), 0.2)
    use = found.spare > 0
    factor = 1.0
    if use.any():
        each = found.within[use] / found.spare[use]
        robustly = loss != "none"
        factor = float(np.sqrt(np.median(each) if robustly else found.within[use].sum() / found.spare[use].sum()))
    factor = max(factor, 1e-3)
    covariance = factor**2 * np.linalg.pinv(found.information, hermitian=True)
    own = np.einsum("kii->ki", covariance)
    square = found.residual**2
    max_ratio = 25.0  # squared residuals beyond so many times their median are taken for it (our choice)
    square = np.minimum(square, max_ratio * np.median(square, axis=0)) / share
    spread = [_component(square[:, axes], own[:, axes]) for axes in (slice(0, 3), slice(3, 6))]
    total = covariance + np.diag(np.repeat(np.square(spread), 3))
    size = np.sqrt(
        np.einsum("ki,ki->k", found.residual, np.linalg.solve(total, found.residual[:, :, None])[:, :, 0]) / 6
    )
    return ImageNoise(factor, *spread, weight=robust.weights(size, loss, scale))


def _component(square: np.ndarray, known: np.ndarray, max_steps: int = 20) -> float:
    """Return s with E[t²] = s² + known, by the maximum-likelihood score Σ (t² - s² - c) / (s² + c)² = 0."""
    value = max(float(np.mean(square - known)), 1e-3 * float(np.median(square)))
    for _ in range(max_steps):
        weight = 1.0 / (value + known) ** 2
        value = max(float(np.sum(weight * (square - known)) / np.sum(weight)), 0.0)
        if value == 0.0:
            break
    return float(np.sqrt(value))
