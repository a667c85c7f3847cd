"""What a fit says of its images: how well corners are predicted, what the arm adds, where the scale is from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.data.poses.measurements import PoseMeasurements
from calib.data.poses.pixels import IN_HAND, Pixels
from calib.geometry.accuracy import Torques
from calib.geometry.installation import Installation
from calib.geometry.observation import observe, prepare
from calib.geometry.pixel_residuals import PixelPart
from calib.geometry.result import GeometricFit

GRID = (12, 9)  # cells of the image that coverage counts (our choice)
LOOSE = 4.0  # times their stated sigmas that corners lie off within an image, from which on it is worth a word


@dataclass(frozen=True)
class ImageCoverage:
    """Where in its images a camera saw corners, and how well they are predicted there.

    Attributes:
        file: the images' folder.
        size: width and height of the images [px].
        count: corners per cell of the image, row by row (`GRID`).
        rms: distance of corners seen from corners predicted [px], per cell; 0 where none was seen.
    """

    file: str
    size: tuple[int, int]
    count: tuple[tuple[int, ...], ...]
    rms: tuple[tuple[float, ...], ...]


def image_coverage(found: GeometricFit) -> tuple[ImageCoverage, ...]:
    """Return where the images of a fit show corners; nothing where there are none."""
    result = []
    for piece in found.pieces:
        block, part = found.blocks[piece.block].measured, piece.part
        if not isinstance(block, Pixels) or not isinstance(part, PixelPart):
            continue
        pixels = block.pixel[part.index, part.corner]
        count = coverage(pixels, block.size)
        square = coverage(pixels, block.size, np.sum(part.value**2, axis=0))
        rms = np.round(np.sqrt(square / np.maximum(count, 1.0)), 4)
        cells = tuple(map(tuple, count.astype(int).tolist())), tuple(map(tuple, rms.tolist()))
        result.append(ImageCoverage(Path(block.file).name, block.size, *cells))
    return tuple(result)


def reprojection(cell: Installation, blocks: Sequence[PoseMeasurements], torques: Torques = None) -> float | None:
    """Return the rms distance of corners seen from corners predicted [px]; None without images."""
    squares = [
        np.sum(part.value**2, axis=0)
        for block in prepare(cell, blocks, torques)
        for part in observe(cell, block, np.array([], dtype=int))
        if isinstance(part, PixelPart)
    ]
    return float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else None


def image_words(block: Pixels) -> str:
    """Return what is said of images as they arrive: corners, mounting, lens, coverage."""
    lens = block.lens
    focal = "" if lens is None else f", focal length {lens.values[0]:.0f} px {'given' if block.known else 'found'}"
    seen = f"{block.seen.sum(axis=1).mean():.1f} of {block.seen.shape[1]} corners each"
    carried = "the arm carries the camera" if block.mounting == IN_HAND else "the arm carries the board"
    return f"{seen}; {carried}{focal}; {coverage_words(block.pixel[block.seen], block.size)}"


def image_notes(found: GeometricFit) -> list[str]:
    """Return what is to be said of a fit's images; nothing where there are none."""
    lines, others = [], [block.measured for block in found.blocks if not isinstance(block.measured, Pixels)]
    for piece in found.pieces:
        block, part = found.blocks[piece.block].measured, piece.part
        if not isinstance(block, Pixels) or not isinstance(part, PixelPart) or part.noise is None:
            continue
        name, noise = Path(block.file).name, part.noise
        rms = float(np.sqrt(np.mean(np.sum(part.value**2, axis=0))))
        own = float(np.sqrt(np.mean(np.sum(part.within(piece.sigma) ** 2, axis=0))))
        lines.append(
            f"{name}: reprojection error {rms:.3f} px rms, {own:.3f} px where each image has a pose of its own; the "
            f"rest, {1e3 * noise.displacement:.3f} mm and {1e3 * noise.turn:.3f} mrad per axis and image, is what "
            "the arm does not repeat or the model does not explain"
        )
        if noise.factor > LOOSE and block.sigma is not None:
            lines.append(
                f"{name}: within an image corners lie {noise.factor:.1f} times as far off as their detection explains: "
                "is the board flat, and does the lens fit (model, camera.yaml)? Options: [camera] board = ['bend'] "
                "fits a bent board, intrinsics = 'fit' the lens"
            )
        pixels = block.pixel[block.seen]
        lines.append(f"{name}: {coverage_words(pixels, block.size)}")
        if "scale" not in block.free:
            lines.append(
                f"{name}: the board gives the scale ({1e3 * block.board.square:g} mm a square): an error of 0.1 % "
                "there is one of 0.1 % in every length of the robot"
                + (", against which the other instruments' measurements stand" if others else "")
            )
    return lines


def coverage(pixels: np.ndarray, size: tuple[int, int], weights: np.ndarray | None = None) -> np.ndarray:
    """Return how many corners (N, 2) [px] lie in each cell of an image, (rows, columns) of `GRID`; or their weight."""
    bins = [np.linspace(0, length, count + 1) for length, count in zip(size, GRID)]
    return np.histogram2d(pixels[:, 0], pixels[:, 1], bins, weights=weights)[0].T


def coverage_words(pixels: np.ndarray, size: tuple[int, int]) -> str:
    """Return how much of the image the corners cover, with a word where that is little."""
    share = float(np.mean(coverage(pixels, size) > 0))
    words = f"corners lie in {share:.0%} of the image"
    few = ": bring the board (or the camera) nearer, and into the image's corners, or the lens is not told there"
    return words + (few if share < 0.6 else "")
