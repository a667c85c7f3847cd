"""Weights of residuals (stated or estimated sigmas, robust weights, priors), and the result of a geometric fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np

from calib.errors import Unidentifiable, UsageError, one_of, refuse_data
from calib.estimation import robust
from calib.estimation.base_columns import ColumnSplit
from calib.estimation.estimate import Estimate
from calib.estimation.nonlinear import MOST_NUMBERS, Reduced, Rows, Solution, covariance, reduced
from calib.estimation.relevance import Gram
from calib.geometry.installation import Installation
from calib.geometry.many_corrections import row_statistics, separable
from calib.geometry.observation import Block, layout, observe, parameter_values, whitened
from calib.geometry.residuals import Part
from calib.records import frozen
from calib.robot.calibrated import CalibratedChain, CorrectedChain
from calib.robot.chain import Chain


@dataclass(frozen=True, eq=False)
class Piece:
    """One residual part of a fit, its block and its weights.

    Attributes:
        block: index into `GeometricFit.blocks`.
        part: residuals at the solution.
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
        free: (f,) positions of the fitted parameters in the full vector (`calib.geometry.observation`).
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

    def data(self) -> Reduced:
        """Return the whitened rows at the solution, reduced, without the prior."""
        return reduced(lambda: _rows(self.cell, self.free, self.blocks, self.pieces))

    @property
    def base(self) -> np.ndarray:
        """Positions (b,) of the base parameters in the full vector; all fitted ones where the caller chose them."""
        if self.split is None:
            return self.free
        return np.intersect1d(self.candidates[self.split.kept], self.free)

    @property
    def identified(self) -> int:
        """Number of identifiable parameters: base columns of the rigid geometry and frames, and joint corrections."""
        if self.split is None:
            return len(self.free)
        corrections = np.setdiff1d(self.free, self.candidates)
        return len(self.base) + len(corrections)

    def regrouping(self) -> np.ndarray:
        """Return the base parameters as combinations (b, f) of the fitted parameters, in the order of `base`.

        A base parameter is its own column and, by the split's coefficients, those that merge with it.
        """
        if self.split is None:
            return np.eye(len(self.free))
        row = {int(parameter): number for number, parameter in enumerate(self.base)}
        column = {int(parameter): number for number, parameter in enumerate(self.free)}
        result = np.zeros((len(row), len(column)))
        for parameter, number in row.items():
            result[number, column[parameter]] = 1.0
        kept = self.candidates[self.split.kept].tolist()
        dropped = self.candidates[self.split.dropped].tolist()
        for merged, coefficients in zip(dropped, self.split.coefficients.T):
            for parameter, coefficient in zip(kept, coefficients):
                if merged in column and parameter in row:
                    result[row[parameter], column[merged]] = coefficient
        return result

    def base_sigma(self) -> np.ndarray:
        """Return the posterior standard deviations (b,) of the base parameters."""
        combinations = self.regrouping()
        return np.sqrt(np.einsum("bf,fg,bg->b", combinations, self.estimate.covariance, combinations))

    def outliers(self, threshold: float = 4.0) -> list[tuple[str, int, str, float, float]]:
        """Return the outlier rows, worst first: file, row, label, size in robust sigmas, size [m or rad].

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
        """Return, for each block, the smallest robust weight of each row (m,); 1 without a robust loss."""
        result = [np.ones(len(block.measured)) for block in self.blocks]
        for piece in self.pieces:
            np.minimum.at(result[piece.block], *piece.part.row_weights(piece.weight))
        return result

    def used_noises(self) -> list[Any]:
        """Return the noise that each block's rows share; None for a block without shared noise."""
        noises = {piece.block: piece.part.noise for piece in self.pieces if piece.part.noise}
        return [noises.get(number) for number in range(len(self.blocks))]

    def used_sigmas(self) -> list[dict[str, float]]:
        """Return, for each block, the rms of the standard deviations used for each label [m or rad]."""
        result: list[dict[str, float]] = [{} for _ in self.blocks]
        for piece in self.pieces:
            result[piece.block][piece.part.label] = float(np.sqrt(np.mean(piece.sigma**2)))
        return result


def calibrated_chain(
    found: GeometricFit, rigid: GeometricFit | None = None, nominal: Chain | None = None
) -> CalibratedChain:
    """Return the calibrated robot of one or two fits, with the covariance of its element values.

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
    corrections = None
    if whole.deflection.terms:
        names = (*chain.names, *whole.deflection.names(chain))
        fitted = [place for place, name in enumerate(found.estimate.names) if name in names]
        where = [names.index(found.estimate.names[place]) for place in fitted]
        spread = np.zeros((len(names), len(names)))
        spread[np.ix_(where, where)] = found.estimate.covariance[np.ix_(fitted, fitted)]
        corrections = CorrectedChain(whole.chain, whole.deflection, frozen(spread))
    return CalibratedChain(chain, nominal, covariance, corrections)


MIN_SIGMA = 1e-6  # [m, rad, px] of estimated sigmas: no instrument is as exact; computed positions are
MIN_NOISE = 1e-6  # residuals over their sigmas: computed positions leave less
START_SIGMA = dict.fromkeys(("position", "orientation", "consistency", "distance", "plane"), 1e-3) | {"pixel": 0.3}


@dataclass(frozen=True)
class Settings:
    """Settings of the fit: loss, damping, tolerance, iterations.

    Attributes:
        loss: ``none``, ``huber`` or ``cauchy``, on the size of each row's whitened residual; ``auto`` lets the ladder
            of models choose ``cauchy`` for grossly wrong rows, else ``none`` (`calib.geometry.model_choice.ladder`).
        loss_scale: the constant of the loss, in sigmas; None for its default.
        damping: first λ of Levenberg–Marquardt; 0 for the iterative linear least squares of eq. 11.
        tolerance: relative size below which a column counts as dependent.
        limit: maximum number of linearisations per pass.
        passes: number of re-estimations of sigmas that are not stated and of robust weights; with images, whose noise
            decreases slowly, until they settle.
    """

    loss: str = "none"
    loss_scale: float | None = None
    damping: float = 1e-8
    tolerance: float = 1e-6
    limit: int = 300
    passes: int = 3

    def __post_init__(self) -> None:
        one_of(self.loss, ("auto", *robust.LOSSES), "loss", UsageError)


_NONE = np.array([], dtype=int)


class Weigher:
    """Sigmas and robust weights of every residual part, updated between passes of a fit."""

    def __init__(
        self, settings: Settings, nominal: Installation, blocks: list[Block], free: np.ndarray, prior: np.ndarray | None
    ):
        self.settings, self.nominal, self.blocks, self.free = settings, nominal, blocks, free
        self.prior = prior if prior is not None and np.isfinite(prior).any() else None
        self.pieces: list[Piece] = []
        self.used = self.pieces
        self.noise = 1.0  # residuals over the sigmas used, by which the prior is weighed against the measurements

    @property
    def noises(self) -> list[Any]:
        """Noise that the rows of each part share; None for a part without."""
        return [piece.part.noise for piece in self.pieces]

    def update(self, state: Installation, first: bool, resting: float = 0.0) -> None:
        """Set sigmas and weights from the residuals at a state; `resting`: parameters that rest on the prior."""
        determined = max(len(self.free) - round(resting), 0)
        owned = [(number, part) for number, block in enumerate(self.blocks) for part in observe(state, block, _NONE)]
        rows = sum(part.value.size for _, part in owned)
        unknown = len(self.free) + sum(part.nuisances for _, part in owned)
        if rows < unknown and self.prior is None:
            refuse_data(
                self.blocks[0].measured.file,
                f"{rows} measured numbers do not determine {unknown} unknowns; measure more poses, or fit a smaller "
                "model ('frames' or 'offsets')",
            )
        share = max(1.0 - (unknown - resting) / rows, 0.05)
        loss, scale = "none" if self.settings.loss == "auto" else self.settings.loss, self.settings.loss_scale
        robustly, self.pieces = loss != "none", []
        for number, part in owned:
            sigma = _sigma(part, share, first and not robustly, robustly)
            noise = part.common_noise(sigma, determined // len(owned), loss, scale, first and not robustly)
            sigma = noise.factor * sigma if noise else sigma
            weight = robust.weights(_size(part, sigma), loss, scale)
            self.pieces.append(Piece(number, replace(part, noise=noise) if noise else part, sigma, weight))
        if not first:
            # what the rows of an image share has its own noise model, and says nothing of the common factor
            squares = 0.0
            for piece in self.pieces:
                whitened_residual = piece.part.alone(piece.sigma) / piece.sigma
                squares += float(np.sum(piece.weight * whitened_residual**2))
            self.noise = float(np.sqrt(max(squares / rows / share, MIN_NOISE**2)))

    def settle(self, solution: Solution) -> Solution | None:
        """Return the solution scaled to the sigmas of its residuals; None if new sigmas would change the estimate.

        A common factor on all sigmas changes only the scale, unless the fit has a prior.
        """
        before, noises, noise = self.pieces, self.noises, self.noise
        self.update(solution.state, first=False, resting=self._resting(solution))
        both = list(zip(self.pieces, before))
        self.used = [replace(old, part=replace(new.part, noise=old.part.noise)) for new, old in both]
        ratios = [float(np.mean(new.sigma / old.sigma)) for new, old in both]
        steady = all(np.abs(new.weight - old.weight).max(initial=0.0) < 0.02 for new, old in both)
        common = ratios[0] if self.prior is None and not any(noises) else 1.0
        steady = steady and all(a is None or b is None or a.near(b) for a, b in zip(self.noises, noises))
        steady = steady and (self.prior is None or abs(self.noise / noise - 1.0) < 0.02)
        if not steady or any(abs(ratio / common - 1.0) > 0.02 for ratio in ratios):
            return None
        self.noise = noise
        if self.prior is not None or any(noises):
            self.pieces = self.used
            return solution
        return replace(solution, factor=solution.factor / common, cost=solution.cost / common**2)

    def _resting(self, solution: Solution) -> float:
        """Return how many parameters rest on their prior: Σ σ² / σ_prior²."""
        if self.prior is None:
            return 0.0
        return float(np.sum(np.diag(covariance(solution.factor)) * self._precision()))

    def _precision(self) -> np.ndarray:
        """Return the prior's precisions (f,), in the measurements' unit of weight; zero where there is none."""
        if self.prior is None:
            return np.zeros(len(self.free))
        return (self.noise / self.prior) ** 2

    def _pull(self, state: Installation) -> np.ndarray:
        """Return the prior's residuals (f,) at a state, in the measurements' unit of weight; zero without a prior."""
        change = parameter_values(self.nominal) - parameter_values(state)
        return change[self.free] * np.sqrt(self._precision())

    def linearise(self, state: Installation) -> Reduced:
        """Return the whitened problem at a state, reduced, with the prior."""
        known, each, total = list[Rows](), list[Gram](), None
        if self.prior is not None:
            held = np.isfinite(self.prior)
            pull, weight = self._pull(state), np.sqrt(self._precision())
            known.append((pull[held], np.diag(weight)[held]))
            each.append(Gram(np.diag(weight**2), pull * weight, float(pull @ pull), int(held.sum())))
        if self._many:
            for number, block in enumerate(self.blocks):
                each += [own for _, own in row_statistics(state, block, self.free, _scales(self.pieces, number))]
            total = sum(each[1:], each[0])
        return reduced(lambda: chain(_rows(state, self.free, self.blocks, self.pieces), known), total)

    @property
    def _many(self) -> bool:
        """Whether W is large and its rows are of a kind whose statistics come cheaper than rows."""
        count = sum(piece.sigma.size for piece in self.pieces) * len(self.free)
        return count > MOST_NUMBERS and all(separable(block.measured) for block in self.blocks)

    def _posterior(self, factor: np.ndarray, variance: float) -> np.ndarray:
        """Return the posterior covariance (f, f): (Wᵀ W / variance + diag(1 / prior²))⁻¹.

        Where measurements are so exact that the prior is below rounding, all is scaled by the variance.

        Args:
            factor: (f, f) upper triangular R of measurements and prior.
            variance: of the residuals, in squares of their sigmas.
        """
        if self.prior is None:
            return covariance(factor, variance)
        scale = np.linalg.norm(factor, axis=0)
        scaled = factor / scale
        measured = scaled.T @ scaled - np.diag(self._precision() / scale**2)
        system = measured / max(variance, MIN_NOISE**2) + np.diag(1.0 / (self.prior * scale) ** 2)
        try:
            root = np.linalg.cholesky(system)
        except np.linalg.LinAlgError:
            return covariance(factor, variance)
        inverse = np.linalg.inv(root) / scale
        return inverse.T @ inverse

    def result(self, solution: Solution) -> GeometricFit:
        state = solution.state
        undetermined = self.free[np.diag(solution.factor) == 0.0]
        if len(undetermined):
            names = [layout(state).names[parameter] for parameter in undetermined]
            raise Unidentifiable(
                f"{self.blocks[0].measured.file}: these rows no longer determine {', '.join(names)} where the search "
                "ended; measure at more different joint values",
                names,
            )
        table, parts = layout(state), [piece.part for piece in self.pieces]
        # parameters that rest on their prior take nothing from the measurements' degrees of freedom
        pull, resting = self._pull(state), self._resting(solution)
        rows = sum(part.value.size - part.nuisances for part in parts)
        dof = max(rows - len(self.free) + round(resting), 1)
        variance = max(solution.cost - float(pull @ pull), 0.0) / dof
        estimate = Estimate(
            tuple(table.names[k] for k in self.free),
            tuple(table.units[k] for k in self.free),
            parameter_values(state)[self.free],
            self._posterior(solution.factor, variance),
            float(np.sqrt(variance)),
            dof,
        )
        return GeometricFit(
            state, self.nominal, self.free, estimate, None, self.free, solution, self.blocks, self.pieces, self.prior
        )


def _rows(cell: Installation, free: np.ndarray, blocks: list[Block], pieces: list[Piece]) -> Iterator[Rows]:
    """Yield the residuals of all blocks and their Jacobians, whitened as in `pieces`."""
    for number, block in enumerate(blocks):
        noises = [piece.part.noise for piece in pieces if piece.block == number]
        yield from whitened(cell, block, free, _scales(pieces, number), noises)


def _scales(pieces: list[Piece], number: int) -> list[np.ndarray]:
    """Return the divisors (rows, m) of a block's residual parts, from sigmas and robust weights."""
    return [piece.sigma / np.sqrt(piece.weight) for piece in pieces if piece.block == number]


def _sigma(part: Part, share: float, start: bool, robustly: bool) -> np.ndarray:
    """Return standard deviations (rows, m) of a part: those of the file, or one estimated from the residuals."""
    if part.sigma is not None:
        return part.sigma
    if start:
        return np.full(part.value.shape, START_SIGMA[part.label])
    found = robust.spread(part.value) if robustly else float(np.sqrt(np.mean(part.value**2)))
    return np.full(part.value.shape, max(found / np.sqrt(share), MIN_SIGMA))


def _size(part: Part, sigma: np.ndarray) -> np.ndarray:
    """Return each row's residual in sigmas (m,), rms over its components, without the noise that rows share."""
    return np.sqrt(np.mean((part.alone(sigma) / sigma) ** 2, axis=0))
