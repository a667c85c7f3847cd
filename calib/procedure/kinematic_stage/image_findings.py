"""Findings on the images of a fit: reprojection error, the arm's share of it, image coverage, board scale."""

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

MAX_NOISE = 4.0  # corner noise over its stated sigma from which on it is remarked on (our choice)


def image_coverage(found: GeometricFit) -> tuple[ImageCoverage, ...]:
    """Return how the corners of a fit cover each set of images; empty without images."""
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


def reprojection(cell: Installation, blocks: Sequence[PoseMeasurements]) -> float | None:
    """Return the rms distance between detected and predicted corners [px]; None without images."""
    squares = [
        np.sum(part.value**2, axis=0)
        for block in prepare(cell, [block for block in blocks if isinstance(block, Pixels)])
        for part in observe(cell, block, np.array([], dtype=int))
        if isinstance(part, PixelPart)
    ]
    return float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else None


def image_notes(found: GeometricFit) -> list[Finding]:
    """Return the findings on the images of a fit; empty without images."""
    result: list[Finding] = []
    others = [Path(block.measured.file).name for block in found.blocks if not isinstance(block.measured, Pixels)]
    for piece in found.pieces:
        block, part = found.blocks[piece.block].measured, piece.part
        if not isinstance(block, Pixels) or not isinstance(part, PixelPart) or part.noise is None:
            continue
        name, noise = Path(block.file).name, part.noise
        rms, image = (float(np.sqrt(np.mean(np.sum(v**2, axis=0)))) for v in (part.value, part.alone(piece.sigma)))
        values = {"rms": rms, "image": image, "shift": noise.displacement, "turn": noise.turn}
        result.append(finding("reprojection", file=name, **values))
        if noise.factor > MAX_NOISE and block.sigma is not None:
            result.append(finding("corners-off", file=name, times=noise.factor))
        words = coverage_words(block.pixel[block.seen], block.size)
        result.append(finding("image-coverage", file=name, coverage=words))
        if "scale" not in block.free:
            result.append(finding("board-scale", file=name, square=block.board.square, others=others))
    return result
