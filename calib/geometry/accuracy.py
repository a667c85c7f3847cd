"""Differences between predicted and measured positions, orientations and distances, as printed on a certificate.

For predicted positions p and measured positions y:

    position      |y - p| where positions are measured; |mean of the socket's points - p| for sockets; distance from the
                  plane for planes; for an image the rms over its corners of the distance between seen and predicted
                  corner, measured across the line of sight at the corner's distance [m]
    orientation   angle of R_y Rᵀ [rad], R_y measured, R predicted
    distance      | |p_a - p_b| - known | for distances, bars and sockets a known distance apart; for sockets without
                  one, the deviation of |m_a - m_b| from its mean over the fixture's positions [m]

``rms`` is sqrt(mean |e|²) of the error vector's norm, not per axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from calib.data.poses.measurements import PoseMeasurements, Positions, Sockets, take
from calib.geometry.installation import Installation
from calib.geometry.observation import observe, positions, prepare
from calib.units import ERRORS

# kind of error (position, orientation, distance) of each residual part, by its label
NATURE = {
    "position": "position",
    "consistency": "position",
    "plane": "position",
    "pixel": "position",
    "orientation": "orientation",
    "distance": "distance",
}

_NONE = np.array([], dtype=int)


@dataclass(frozen=True)
class ErrorStatistics:
    """Mean, rms, 95 % quantile and maximum of error magnitudes [mm or deg]."""

    mean: float
    rms: float
    p95: float
    max: float


@dataclass(frozen=True)
class ArmErrors:
    """Error statistics of one arm by kind of error; None for a kind that was not measured."""

    position_mm: ErrorStatistics | None = None
    orientation_deg: ErrorStatistics | None = None
    distance_mm: ErrorStatistics | None = None

    @property
    def main(self) -> ErrorStatistics | None:
        """Statistics of the errors that decide the verdict: of positions or, without positions, of distances [mm].

        None where neither was measured.
        """
        return self.position_mm or self.distance_mm


@dataclass(frozen=True, eq=False)
class Errors:
    """Error magnitudes by kind, one number per measured row (or pair of rows); None for a kind that was not measured.

    Attributes:
        position: [m].
        orientation: [rad].
        distance: [m].
    """

    position: np.ndarray | None
    orientation: np.ndarray | None
    distance: np.ndarray | None

    @property
    def main(self) -> np.ndarray:
        """Errors that decide the verdict: of positions or, without positions, of distances [m]; empty without both."""
        if self.position is not None:
            return self.position
        if self.distance is not None:
            return self.distance
        return np.zeros(0)

    @property
    def rms(self) -> float:
        """Root mean square of the errors in `main`; 0 without errors."""
        sizes = self.main
        if not len(sizes):
            return 0.0
        return float(np.sqrt(np.mean(sizes**2)))

    def summary(self) -> ArmErrors:
        """Return the statistics of each kind of error in mm and deg."""
        factors = {nature: factor for nature, (factor, _) in ERRORS.items()}
        position = statistics(self.position, factors["position"])
        orientation = statistics(self.orientation, factors["orientation"])
        distance = statistics(self.distance, factors["distance"])
        return ArmErrors(position, orientation, distance)


def errors(cell: Installation, measured: Sequence[PoseMeasurements]) -> Errors:
    """Return the magnitudes of the prediction errors of all measured rows.

    Args:
        cell: the installation whose predictions are compared; it must have the stations and tools named in the
            measurements.
        measured: blocks of measurements, of any kinds.
    """
    sizes: dict[str, list[np.ndarray]] = {"position": [], "orientation": [], "distance": []}
    for block in prepare(cell, measured):
        for part in observe(cell, block, _NONE):
            sizes[NATURE[part.label]].append(part.sizes())
        if isinstance(block.measured, Sockets) and not block.measured.links:
            sizes["distance"].append(_socket_spread(positions(cell, block), block.measured))
    position = _concatenated(sizes["position"])
    orientation = _concatenated(sizes["orientation"])
    distance = _concatenated(sizes["distance"])
    return Errors(position, orientation, distance)


def _concatenated(sizes: list[np.ndarray]) -> np.ndarray | None:
    """Return the error magnitudes of all blocks in one array; None for an empty list.

    Args:
        sizes: error magnitudes of each block.
    """
    result = np.concatenate([np.zeros(0), *sizes])
    return result if len(result) else None


def statistics(sizes: np.ndarray | None, factor: float = 1.0) -> ErrorStatistics | None:
    """Return mean, rms, 95 % quantile and maximum of `factor` times the error magnitudes.

    Args:
        sizes: (N,) error magnitudes [m or rad]; None where they were not measured.
        factor: factor by which they are converted to mm or deg.
    """
    if sizes is None:
        return None
    scaled = factor * sizes
    mean = float(scaled.mean())
    rms = float(np.sqrt(np.mean(scaled**2)))
    p95 = float(np.percentile(scaled, 95))
    return ErrorStatistics(mean, rms, p95, float(scaled.max()))


def rms_sigma(sizes: np.ndarray) -> float:
    """Return the standard error of the rms of independent errors e: sd(e²) / (2 rms sqrt(N)), by the delta method.

    Args:
        sizes: (N,) error magnitudes.

    Returns:
        The standard error, in the unit of `sizes`; NaN for fewer than two errors.
    """
    if len(sizes) < 2:
        return np.nan
    squares = np.square(sizes)
    rms = float(np.sqrt(np.mean(squares)))
    if not rms > 0.0:
        return np.nan
    return float(np.std(squares, ddof=1) / (2.0 * rms * np.sqrt(len(sizes))))


def pair_errors(
    cell: Installation, measured: Sequence[PoseMeasurements], limit: int = 20000, seed: int = 0
) -> np.ndarray:
    """Return the errors of the distances between pairs of positions [m], | |p_i - p_j| - |y_i - y_j| |.

    p are predicted and y measured positions.

    Args:
        cell: the installation that predicts the positions.
        measured: blocks of measurements; the positions of a pair are taken from the same block.
        limit: largest number of pairs; if there are more, so many are drawn at random.
        seed: seed of the draw.
    """
    generator = np.random.default_rng(seed)
    result = [np.zeros(0)]
    for block in measured:
        if not isinstance(block, Positions) or len(block) < 2:
            continue
        rows, number = np.unique(_pairs(len(block), limit, generator), return_inverse=True)
        first, second = number.reshape(2, -1)
        (sample,) = prepare(cell, [take(block, rows)])
        predicted = positions(cell, sample).T
        position = block.position[rows]
        predicted_distance = np.linalg.norm(predicted[first] - predicted[second], axis=1)
        distance = np.linalg.norm(position[first] - position[second], axis=1)
        result.append(np.abs(predicted_distance - distance))
    return np.concatenate(result)


def _pairs(m: int, limit: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    if m * (m - 1) // 2 <= limit:
        first, second = np.triu_indices(m, 1)
        return first, second
    first = generator.integers(0, m, limit)
    return first, (first + generator.integers(1, m, limit)) % m


def _socket_spread(point: np.ndarray, measured: Sockets) -> np.ndarray:
    """Return how much the distance of each socket pair deviates from its mean over all fixture positions [m].

    The name of a group of rows is ``<fixture position>/<socket>``. The result is empty where no pair of sockets was
    measured in two fixture positions.

    Args:
        point: (3, m) predicted target positions [m].
        measured: the block of m rows, in which the target rested in sockets.
    """
    sockets: dict[str, dict[str, np.ndarray]] = {}
    for number in np.unique(measured.group):
        name = str(number)
        if measured.group_names:
            name = measured.group_names[number]
        fixture_position, _, socket = name.rpartition("/")
        mean = point[:, measured.group == number].mean(axis=1)
        sockets.setdefault(fixture_position, {})[socket] = mean
    lengths: dict[tuple[str, str], list[float]] = {}
    for means in sockets.values():
        for pair in combinations(sorted(means), 2):
            length = float(np.linalg.norm(means[pair[0]] - means[pair[1]]))
            lengths.setdefault(pair, []).append(length)
    result = [np.zeros(0)]
    for pair_lengths in lengths.values():
        deviations = np.abs(np.array(pair_lengths) - np.mean(pair_lengths))
        if len(pair_lengths) > 1:
            result.append(deviations)
    return np.concatenate(result)
