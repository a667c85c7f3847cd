"""Findings on the images of a fit: reprojection error, the arm's share of this error, image coverage, board scale."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib.data.images.coverage import coverage, coverage_words
from calib.data.images.pixels import Pixels
from calib.data.poses.measurements import PoseMeasurements
from calib.errors import Finding, finding
from calib.geometry.camera.pixel_residuals import PixelPart
from calib.geometry.installation import Installation
from calib.geometry.observation import observe, prepare
from calib.geometry.weighing import GeometricFit
from calib.procedure.kinematic_stage.metrics import ImageCoverage

# corner noise over its stated sigma from which on it is remarked on (our choice)
MAX_NOISE = 4.0


def image_coverage(fit: GeometricFit) -> tuple[ImageCoverage, ...]:
    """Return the number of corners in each cell of the image area, and their errors, for each set of images.

    Empty without images.
    """
    result = []
    for piece in fit.pieces:
        block, part = fit.blocks[piece.block].measured, piece.part
        if not isinstance(block, Pixels) or not isinstance(part, PixelPart):
            continue
        pixels = block.pixel[part.index, part.corner]
        count = coverage(pixels, block.size)
        square_sum = coverage(pixels, block.size, np.sum(part.value**2, axis=0))
        rms = np.round(np.sqrt(square_sum / np.maximum(count, 1.0)), 4)
        counts = tuple(map(tuple, count.astype(int).tolist()))
        sizes = tuple(map(tuple, rms.tolist()))
        result.append(ImageCoverage(Path(block.file).name, block.size, counts, sizes))
    return tuple(result)


def reprojection(cell: Installation, blocks: Sequence[PoseMeasurements]) -> float | None:
    """Return the rms distance between detected and predicted corners [px]; None without images.

    Args:
        cell: arm, camera and board, which predict the corners.
        blocks: the measurements.
    """
    images = [block for block in blocks if isinstance(block, Pixels)]
    no_parameters = np.array([], dtype=int)
    squares: list[np.ndarray] = []
    for block in prepare(cell, images):
        parts = [part for part in observe(cell, block, no_parameters) if isinstance(part, PixelPart)]
        squares += [np.sum(part.value**2, axis=0) for part in parts]
    if not squares:
        return None
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def _rms(residuals: np.ndarray) -> float:
    """Return the rms length of residual vectors (2, k) [px]."""
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=0))))


def image_notes(fit: GeometricFit) -> list[Finding]:
    """Return findings on the images of a fit: reprojection error, noise, coverage and scale; empty without images."""
    notes: list[Finding] = []
    without_images = [block.measured for block in fit.blocks if not isinstance(block.measured, Pixels)]
    other_files = [Path(block.file).name for block in without_images]
    for piece in fit.pieces:
        block, part = fit.blocks[piece.block].measured, piece.part
        if not isinstance(block, Pixels) or not isinstance(part, PixelPart) or part.noise is None:
            continue
        name = Path(block.file).name
        noise = part.noise
        rms = _rms(part.value)
        rms_in_image = _rms(part.alone(piece.sigma))
        notes.append(
            finding("reprojection", file=name, rms=rms, image=rms_in_image, shift=noise.displacement, turn=noise.turn)
        )
        if noise.factor > MAX_NOISE and block.sigma is not None:
            notes.append(finding("corners-off", file=name, times=noise.factor))
        covered = coverage_words(block.pixel[block.seen], block.size)
        notes.append(finding("image-coverage", file=name, coverage=covered))
        if "scale" not in block.free:
            notes.append(finding("board-scale", file=name, square=block.board.square, others=other_files))
    return notes
