"""Coverage of the image by a board's corners, and the summary sentence on images that were read."""

import numpy as np

from calib.data.images.pixels import Pixels
from calib.data.poses import IN_HAND

# Numbers of columns and rows of cells into which the image is divided to measure its coverage (our choice).
GRID = (12, 9)
# Share of covered cells below which a sentence advises on further images.
MIN_COVERAGE = 0.6


def image_words(block: Pixels) -> str:
    """Return a summary sentence of newly read images: corners, mounting, lens, coverage."""
    mean_count = block.seen.sum(axis=1).mean()
    corner_counts = f"{mean_count:.1f} of {block.seen.shape[1]} corners each"
    carried = "the arm carries the board"
    if block.mounting == IN_HAND:
        carried = "the arm carries the camera"
    focal = ""
    if block.lens is not None:
        origin = "given" if block.known else "found"
        focal = f", focal length {block.lens.values[0]:.0f} px {origin}"
    covered = coverage_words(block.pixel[block.seen], block.size)
    return f"{corner_counts}; {carried}{focal}; {covered}"


def coverage(pixels: np.ndarray, size: tuple[int, int], weights: np.ndarray | None = None) -> np.ndarray:
    """Return the number of corners in each cell of the image grid `GRID`, as (rows, columns).

    Args:
        pixels: (N, 2) corners [px].
        size: width and height of the image [px].
        weights: (N,) weights whose sums are returned instead of numbers; None: numbers.
    """
    bins = [np.linspace(0, length, count + 1) for length, count in zip(size, GRID)]
    counts, _, _ = np.histogram2d(pixels[:, 0], pixels[:, 1], bins, weights=weights)
    return counts.T


def coverage_words(pixels: np.ndarray, size: tuple[int, int]) -> str:
    """Return a sentence on the share of the image covered by corners, with advice if it is small."""
    covered = coverage(pixels, size) > 0
    share = float(np.mean(covered))
    sentence = f"corners lie in {share:.0%} of the image"
    if share < MIN_COVERAGE:
        sentence += "; the lens is not identifiable in the rest: bring the board closer and into the image's corners"
    return sentence
