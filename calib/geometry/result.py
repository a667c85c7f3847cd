"""Result of a geometric fit, with residuals and weights by row."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.errors import UsageError
from calib.estimation import robust
from calib.estimation.base_columns import ColumnSplit
from calib.estimation.estimate import Estimate
from calib.estimation.nonlinear import Solution
from calib.geometry.installation import Installation
from calib.geometry.observation import Block
from calib.geometry.residuals import Part
from calib.robot.calibrated import CalibratedChain, CorrectedChain
from calib.robot.chain import Chain


@dataclass(frozen=True, eq=False)
class Piece:
    """One residual part of a fit, its block and its weights.

    Attributes:
        block: index into `GeometricFit.blocks`.
        part: residuals and Jacobian at the solution.
        sigma: (rows, m) standard deviations used.
        weight: (m,) robust weights.
    """

    block: int
    part: Part
    sigma: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True, eq=False)
class GeometricFit:
    """Result of a geometric fit.

    Attributes:
        cell: the calibrated installation.
        start: the installation the fit began with.
        free: (f,) positions of the fitted parameters in the full vector (`calib.geometry.parameters`).
        estimate: values and covariance of the fitted parameters; stations and tools as displacements from the fitted
            placement, hence with value 0.
        split: which candidate columns were kept; None if the caller chose the free parameters.
        candidates: parameters to which the indices of ``split`` refer.
        solution: the last Levenberg–Marquardt pass.
        blocks: the prepared measurements.
        pieces: their residual parts at the solution.
        prior: (f,) standard deviations about the nominal that the fit was regularised with; infinite for none.
    """

    cell: Installation
    start: Installation
    free: np.ndarray
    estimate: Estimate
    split: ColumnSplit | None
    candidates: np.ndarray
    solution: Solution
    blocks: list[Block]
    pieces: list[Piece]
    prior: np.ndarray | None = None

    @property
    def calibrated(self) -> CalibratedChain:
        """Calibrated robot of a fit without joint corrections; for a fit with corrections see `calibrated_chain`."""
        return calibrated_chain(self)

    def outliers(self, threshold: float = 4.0) -> list[tuple[str, int, str, float, float]]:
        """Return (file, row, label, size in robust sigmas, size [m or rad]) of outlier rows, worst first.

        Sizes are measured against the robust spread of their own part (1.4826 · median), not against stated sigmas, so
        that an optimistic instrument does not make every row an outlier.
        """
        result = []
        for piece in self.pieces:
            measured, part = self.blocks[piece.block].measured, piece.part.per_row()
            size = np.sqrt(np.mean(part.value**2, axis=0)) / max(robust.spread(part.value), 1e-15)
            rows, sizes = measured.rows[part.index], part.sizes()
            result += [
                (measured.file, int(rows[i]), part.label, float(size[i]), float(sizes[i]))
                for i in np.flatnonzero(size > threshold)
            ]
        return sorted(result, key=lambda item: -item[3])

    def row_weights(self) -> list[np.ndarray]:
        """Return for each block the smallest robust weight of each row's parts (m,); 1 without a robust loss."""
        result = [np.ones(len(block.measured)) for block in self.blocks]
        for piece in self.pieces:
            np.minimum.at(result[piece.block], *piece.part.row_weights(piece.weight))
        return result

    def used_noises(self) -> list[Any]:
        """Return the common noise of each block's rows; None for a block without."""
        noises = {piece.block: piece.part.noise for piece in self.pieces if piece.part.noise}
        return [noises.get(number) for number in range(len(self.blocks))]

    def used_sigmas(self) -> list[dict[str, float]]:
        """Return for each block the rms standard deviation used per label [m or rad]."""
        result: list[dict[str, float]] = [{} for _ in self.blocks]
        for piece in self.pieces:
            result[piece.block][piece.part.label] = float(np.sqrt(np.mean(piece.sigma**2)))
        return result


def calibrated_chain(
    found: GeometricFit, rigid: GeometricFit | None = None, nominal: Chain | None = None
) -> CalibratedChain:
    """Return the calibrated robot from fits of one arm, with the covariance of its element values.

    Args:
        found: the fit that predicts best.
        rigid: the best fit without joint corrections; None if `found` has no corrections.
        nominal: the arm before any calibration; None for the one that the fit began with.

    Raises:
        UsageError: for a fit with joint corrections and no rigid one: without them its geometry is no robot's.
    """
    whole, nominal = found.cell.merged(), nominal or found.start.chain
    if not whole.deflection.terms:
        rigid = found
    if rigid is None:
        raise UsageError("a fit with joint corrections also needs the best fit without corrections")
    chain = rigid.cell.chain
    own = np.flatnonzero(rigid.free < len(chain.elements))
    covariance = None
    if len(own):
        covariance = np.zeros((len(chain.elements), len(chain.elements)))
        where = rigid.free[own]
        covariance[np.ix_(where, where)] = rigid.estimate.covariance[np.ix_(own, own)]
    corrections = CorrectedChain(whole.chain, whole.deflection) if whole.deflection.terms else None
    return CalibratedChain(chain, nominal, covariance, corrections)
