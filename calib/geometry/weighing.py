"""Weights of residuals (stated or estimated sigmas, robust weights, priors), and the result of a geometric fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain

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
from calib.geometry.residuals import CommonNoise, ResidualPart
from calib.records import frozen
from calib.robot.calibrated import CalibratedChain, CorrectedChain
from calib.robot.chain import Chain

# smallest estimated sigma [m, rad, px]: no instrument is more accurate, though simulated positions are
MIN_SIGMA = 1e-6
# smallest ratio of residuals to their sigmas: those of simulated positions are smaller
MIN_NOISE = 1e-6
# initial sigmas of a fit by label of the residual part [m, rad, px]
START_SIGMA = dict.fromkeys(("position", "orientation", "consistency", "distance", "plane"), 1e-3) | {"pixel": 0.3}
# smallest robust spread in units of which outliers are measured [m, rad, px]
SMALLEST_SPREAD = 1e-15
# smallest share of degrees of freedom among the measured numbers, for any number of unknowns
MIN_FREE_SHARE = 0.05
# largest change of a weight, and largest relative change of a sigma, for which the fit is not repeated
MAX_CHANGE = 0.02

_NONE = np.array([], dtype=int)


@dataclass(frozen=True, eq=False)
class Piece:
    """One residual part of a fit, with its block and its weights.

    Attributes:
        block: index of the block in `GeometricFit.blocks`.
        part: residuals at the solution.
        sigma: (rows, m) standard deviations used in the fit.
        weight: (m,) robust weights.
    """

    block: int
    part: ResidualPart
    sigma: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True, eq=False)
class GeometricFit:
    """Result of a geometric fit.

    Attributes:
        cell: the calibrated installation.
        start: the installation from which the fit started.
        free: (f,) indices of the fitted parameters in the full vector (`calib.geometry.observation`).
        estimate: values and covariance of the fitted parameters. Those of stations and tools are displacements from the
            fitted placement, and have the value 0.
        split: division of the candidates into base parameters and dependent ones; None if the caller chose the fitted
            parameters.
        candidates: indices of the parameters to which ``split`` refers.
        solution: result of the last Levenberg–Marquardt pass.
        blocks: the prepared measurements.
        pieces: residual parts of the measurements at the solution.
        prior: (f,) standard deviations of the prior about nominal values; infinite for no prior. None where no
            parameter has a prior.
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
        """Return the whitened rows at the solution, reduced by QR decomposition, without the prior."""
        return reduced(lambda: _rows(self.cell, self.free, self.blocks, self.pieces))

    def whitened_rows(self, cell: Installation, blocks: list[Block], free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals (N,) of any installation, and their Jacobian (N, f), with the weights of this fit.

        Args:
            cell: the installation, with the stations and tools of this fit.
            blocks: the fitted measurements, prepared for it.
            free: (f,) indices of the parameters of the Jacobian's columns.
        """
        rows = list(_rows(cell, free, blocks, self.pieces))
        return np.concatenate([residual for residual, _ in rows]), np.concatenate([matrix for _, matrix in rows])

    @property
    def base(self) -> np.ndarray:
        """Indices (b,) of the base parameters in the full vector; all fitted ones where the caller chose the
        parameters.
        """
        if self.split is None:
            return self.free
        return np.intersect1d(self.candidates[self.split.kept], self.free)

    @property
    def identified(self) -> int:
        """Number of identifiable parameters: base parameters of geometry and placements, and joint corrections."""
        if self.split is None:
            return len(self.free)
        corrections = np.setdiff1d(self.free, self.candidates)
        return len(self.base) + len(corrections)

    def regrouping(self) -> np.ndarray:
        """Return the base parameters as linear combinations (b, f) of the fitted parameters, in the order of `base`.

        A base parameter is the sum of its own column and, with the coefficients of `split`, of the parameters that
        depend on it.
        """
        if self.split is None:
            return np.eye(len(self.free))
        row = {int(parameter): number for number, parameter in enumerate(self.base)}
        column = {int(parameter): number for number, parameter in enumerate(self.free)}
        result = np.zeros((len(row), len(column)))
        for parameter, number in row.items():
            result[number, column[parameter]] = 1.0
        base = self.candidates[self.split.kept].tolist()
        dropped = self.candidates[self.split.dropped].tolist()
        for merged, coefficients in zip(dropped, self.split.coefficients.T):
            for parameter, coefficient in zip(base, coefficients):
                if merged in column and parameter in row:
                    result[row[parameter], column[merged]] = coefficient
        return result

    def base_sigma(self) -> np.ndarray:
        """Return the posterior standard deviations (b,) of the base parameters."""
        combinations = self.regrouping()
        return np.sqrt(np.einsum("bf,fg,bg->b", combinations, self.estimate.covariance, combinations))

    def outliers(self, threshold: float = 4.0) -> list[tuple[str, int, str, float, float]]:
        """Return the outlier rows, worst first: file, row, label, size in robust sigmas, size [m or rad].

        A robust sigma is 1.4826 · median of the sizes in the same residual part. Stated standard deviations are not
        used, since with too small ones every row would be an outlier.

        Args:
            threshold: number of robust sigmas above which a row is an outlier.
        """
        result = []
        for piece in self.pieces:
            measured = self.blocks[piece.block].measured
            part = piece.part.per_row()
            rms = np.sqrt(np.mean(part.value**2, axis=0))
            in_sigmas = rms / max(robust.spread(part.value), SMALLEST_SPREAD)
            rows = measured.rows[part.index]
            sizes = part.sizes()
            for k in np.flatnonzero(in_sigmas > threshold):
                outlier = (measured.file, int(rows[k]), part.label, float(in_sigmas[k]), float(sizes[k]))
                result.append(outlier)
        return sorted(result, key=lambda outlier: -outlier[3])

    def row_weights(self) -> list[np.ndarray]:
        """Return, for each block, the smallest robust weight of each row (m,); 1 without a robust loss."""
        result = [np.ones(len(block.measured)) for block in self.blocks]
        for piece in self.pieces:
            np.minimum.at(result[piece.block], *piece.part.row_weights(piece.weight))
        return result

    def used_noises(self) -> list[CommonNoise | None]:
        """Return, for each block, the noise that its rows share; None for a block without shared noise."""
        result: list[CommonNoise | None] = [None] * len(self.blocks)
        for piece in self.pieces:
            if piece.part.noise:
                result[piece.block] = piece.part.noise
        return result

    def used_sigmas(self) -> list[dict[str, float]]:
        """Return, for each block, the rms of the standard deviations used for each label [m or rad]."""
        result: list[dict[str, float]] = [{} for _ in self.blocks]
        for piece in self.pieces:
            result[piece.block][piece.part.label] = float(np.sqrt(np.mean(piece.sigma**2)))
        return result


def calibrated_chain(
    fit: GeometricFit, rigid: GeometricFit | None = None, nominal: Chain | None = None
) -> CalibratedChain:
    """Return the calibrated robot of one or two fits, with the covariance of its element values.

    Args:
        fit: the fit with the smallest prediction errors.
        rigid: the best fit without joint corrections; None if `fit` has no corrections.
        nominal: the arm before any calibration; None for the arm from which `fit` started.

    Raises:
        UsageError: `fit` has joint corrections and `rigid` is None. The geometry of `fit` is not valid without its
            corrections.
    """
    merged = fit.cell.merged()
    nominal = nominal or fit.start.chain
    if not merged.deflection.terms:
        rigid = fit
    if rigid is None:
        raise UsageError("a fit with joint corrections also needs the best fit without corrections")
    chain = rigid.cell.chain
    fitted_elements = np.flatnonzero(rigid.free < len(chain.elements))
    covariance = None
    if len(fitted_elements):
        elements = rigid.free[fitted_elements]
        covariance = np.zeros((len(chain.elements), len(chain.elements)))
        block = rigid.estimate.covariance[np.ix_(fitted_elements, fitted_elements)]
        covariance[np.ix_(elements, elements)] = block
    corrections = None
    if merged.deflection.terms:
        corrections = CorrectedChain(merged.chain, merged.deflection, _corrected_covariance(fit, chain, merged))
    return CalibratedChain(chain, nominal, covariance, corrections)


def _corrected_covariance(fit: GeometricFit, chain: Chain, merged: Installation) -> np.ndarray:
    """Return the covariance of a chain's elements and its corrections; zero for parameters that were not fitted.

    Args:
        fit: the fit with joint corrections.
        chain: the fitted geometry.
        merged: its installation with earlier and fitted corrections in one field (`Installation.merged`).
    """
    names = (*chain.names, *merged.deflection.names(chain))
    source, target = [], []
    for number, name in enumerate(fit.estimate.names):
        if name in names:
            source.append(number)
            target.append(names.index(name))
    covariance = np.zeros((len(names), len(names)))
    covariance[np.ix_(target, target)] = fit.estimate.covariance[np.ix_(source, source)]
    return frozen(covariance)


@dataclass(frozen=True)
class Settings:
    """Settings of the fit: loss, damping, tolerance, iterations.

    Attributes:
        loss: ``none``, ``huber`` or ``cauchy``, on the size of each row's whitened residual; ``auto`` lets the ladder
            of models choose ``cauchy`` for grossly wrong rows, else ``none`` (`calib.geometry.model_choice.ladder`).
        loss_scale: the constant of the loss, in sigmas; None for its default.
        function: the loss as a function, of which `loss` is the name then; None for a loss with that name.
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
    function: robust.Loss | None = None

    def __post_init__(self) -> None:
        if self.function is None:
            one_of(self.loss, ("auto", *robust.LOSSES), "loss", UsageError)

    @property
    def weighting(self) -> str | robust.Loss:
        """The loss by which rows are weighted: its name or its function; for ``auto``, before a choice, ``none``."""
        if self.function is not None:
            return self.function
        return "none" if self.loss == "auto" else self.loss

    def with_loss(self, loss: str) -> Settings:
        """Return the settings with another loss; a function stays if its name is given."""
        function = self.function if loss == self.loss else None
        return replace(self, loss=loss, function=function)


class Weigher:
    """Sigmas and robust weights of every residual part, updated between the passes of a fit.

    Attributes:
        settings, nominal, blocks, free: settings, installation at the prior's mean, measurements and fitted parameters
            of the fit.
        prior: (f,) standard deviations about `nominal`; None where all are infinite.
        pieces: residual parts with the sigmas and weights of the next pass.
        pieces_of_pass: residuals at the end of the last pass, with the sigmas, weights and noise that it used.
        noise: rms of the residuals divided by their sigmas, which sets the weight of the prior relative to the
            measurements.
        noise_of_pass: value of `noise` in the last pass.
    """

    def __init__(
        self, settings: Settings, nominal: Installation, blocks: list[Block], free: np.ndarray, prior: np.ndarray | None
    ):
        self.settings = settings
        self.nominal = nominal
        self.blocks = blocks
        self.free = free
        self.prior = None
        if prior is not None and np.isfinite(prior).any():
            self.prior = prior
        self.pieces: list[Piece] = []
        self.pieces_of_pass: list[Piece] = []
        self.noise = self.noise_of_pass = 1.0

    @property
    def noises(self) -> list[CommonNoise | None]:
        """Noise that the rows of each residual part share; None for a part without shared noise."""
        return [piece.part.noise for piece in self.pieces]

    def update(self, state: Installation, first: bool, resting: float = 0.0) -> None:
        """Set sigmas and weights from the residuals of an installation.

        Args:
            state: the installation.
            first: True before the first pass of a fit.
            resting: effective number of parameters that are determined by their prior.
        """
        parts: list[tuple[int, ResidualPart]] = []
        for number, block in enumerate(self.blocks):
            parts += [(number, part) for part in observe(state, block, _NONE)]
        rows = sum(part.value.size for _, part in parts)
        unknowns = len(self.free) + sum(part.nuisances for _, part in parts)
        if rows < unknowns and self.prior is None:
            refuse_data(
                self.blocks[0].measured.file,
                f"{rows} measured numbers do not determine {unknowns} unknowns; measure more poses, or fit a smaller "
                "model ('frames' or 'offsets')",
            )
        determined = max(len(self.free) - round(resting), 0)
        share = max(1.0 - (unknowns - resting) / rows, MIN_FREE_SHARE)
        loss = self.settings.weighting
        scale = self.settings.loss_scale
        robustly = loss != "none"
        start = first and not robustly
        self.pieces = []
        for number, part in parts:
            sigma = _sigma(part, share, start, robustly)
            noise = part.common_noise(sigma, determined // len(parts), loss, scale, start)
            if noise:
                sigma = noise.factor * sigma
            weight = robust.weights(_size(part, sigma), loss, scale)
            if noise:
                part = replace(part, noise=noise)
            self.pieces.append(Piece(number, part, sigma, weight))
        if not first:
            self._update_noise(rows, share)

    def _update_noise(self, rows: int, share: float) -> None:
        """Set `noise` from the weighted residuals of all parts.

        Errors shared by the rows of an image have their own noise model, and are excluded.

        Args:
            rows: number of measured numbers.
            share: degrees of freedom per measured number.
        """
        squares = 0.0
        for piece in self.pieces:
            whitened_residual = piece.part.alone(piece.sigma) / piece.sigma
            squares += float(np.sum(piece.weight * whitened_residual**2))
        self.noise = float(np.sqrt(max(squares / rows / share, MIN_NOISE**2)))

    def settle(self, solution: Solution) -> Solution | None:
        """Return the solution scaled to the sigmas of its residuals; None if new sigmas would change the estimate.

        A factor common to all sigmas changes only the scale of the covariance, unless the fit has a prior.
        """
        before = self.pieces
        noises = self.noises
        self.noise_of_pass = self.noise
        self.update(solution.state, first=False, resting=self._resting(solution))
        self.pieces_of_pass = []
        ratios = []
        for piece, earlier in zip(self.pieces, before):
            part = replace(piece.part, noise=earlier.part.noise)
            self.pieces_of_pass.append(replace(earlier, part=part))
            ratios.append(float(np.mean(piece.sigma / earlier.sigma)))
        keeps_metric = self.prior is not None or any(noises)
        common = 1.0 if keeps_metric else ratios[0]
        if not self._steady(before, noises) or any(abs(ratio / common - 1.0) > MAX_CHANGE for ratio in ratios):
            return None
        self.noise = self.noise_of_pass
        if keeps_metric:
            self.pieces = self.pieces_of_pass
            return solution
        return replace(solution, factor=solution.factor / common, cost=solution.cost / common**2)

    def _steady(self, before: list[Piece], noises: list[CommonNoise | None]) -> bool:
        """Return whether robust weights, shared noises and the prior's weight are nearly those of the last pass.

        Args:
            before: residual parts of the last pass, with their robust weights.
            noises: for each part, the shared noise of the last pass; None for a part without.
        """
        for piece, earlier in zip(self.pieces, before):
            change = np.abs(piece.weight - earlier.weight).max(initial=0.0)
            if not change < MAX_CHANGE:
                return False
        for noise, earlier_noise in zip(self.noises, noises):
            if noise is not None and earlier_noise is not None and not noise.near(earlier_noise):
                return False
        return self.prior is None or abs(self.noise / self.noise_of_pass - 1.0) < MAX_CHANGE

    def unsettled_result(self, solution: Solution) -> GeometricFit:
        """Return the fit of the last pass with the weights of that pass.

        It is used where new sigmas would still change the estimate after the last pass.

        Args:
            solution: result of the last pass.
        """
        self.pieces = self.pieces_of_pass
        self.noise = self.noise_of_pass
        return self.result(solution)

    def _resting(self, solution: Solution) -> float:
        """Return the effective number of parameters that are determined by their prior: Σ σ² / σ_prior².

        Args:
            solution: result of a pass.
        """
        if self.prior is None:
            return 0.0
        return float(np.sum(np.diag(covariance(solution.factor)) * self._precision()))

    def _precision(self) -> np.ndarray:
        """Return the prior's precisions (f,), multiplied by `noise` squared; zero for parameters without a prior."""
        if self.prior is None:
            return np.zeros(len(self.free))
        return (self.noise / self.prior) ** 2

    def _pull(self, state: Installation) -> np.ndarray:
        """Return the prior's residuals (f,) for an installation, each multiplied by the root of its precision.

        Zero for parameters without a prior.

        Args:
            state: the installation.
        """
        change = parameter_values(self.nominal) - parameter_values(state)
        return change[self.free] * np.sqrt(self._precision())

    def linearise(self, state: Installation) -> Reduced:
        """Return the whitened least-squares problem at an installation, with the prior, reduced by QR decomposition.

        Args:
            state: the installation at which derivatives are computed.
        """
        prior_rows = list[Rows]()
        statistics = list[Gram]()
        if self.prior is not None:
            weight = np.sqrt(self._precision())
            pull = self._pull(state)
            weighed = np.isfinite(self.prior)
            prior_rows.append((pull[weighed], np.diag(weight)[weighed]))
            statistics.append(Gram(np.diag(weight**2), pull * weight, float(pull @ pull), int(weighed.sum())))
        total = None
        if self._many:
            for number, block in enumerate(self.blocks):
                for _, gram in row_statistics(state, block, self.free, _scales(self.pieces, number)):
                    statistics.append(gram)
            total = sum(statistics[1:], statistics[0])
        return reduced(lambda: chain(_rows(state, self.free, self.blocks, self.pieces), prior_rows), total)

    @property
    def _many(self) -> bool:
        """Whether W is large, and WᵀW is computed faster than its rows, which is so for positions and poses."""
        count = sum(piece.sigma.size for piece in self.pieces) * len(self.free)
        return count > MOST_NUMBERS and all(separable(block.measured) for block in self.blocks)

    def _posterior(self, factor: np.ndarray, variance: float) -> np.ndarray:
        """Return the posterior covariance (f, f): (Wᵀ W / variance + diag(1 / prior²))⁻¹.

        Where measurements are so accurate that the prior is lost in rounding errors, it is computed as variance · (Rᵀ
        R)⁻¹.

        Args:
            factor: (f, f) upper triangular factor R of measurements and prior.
            variance: variance of the residuals, in units of their sigmas squared.
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
        """Return the fit at a solution, with the posterior covariance of its parameters.

        Raises:
            Unidentifiable: the rows do not determine some parameters at the solution.
        """
        state = solution.state
        undetermined = self.free[np.diag(solution.factor) == 0.0]
        if len(undetermined):
            names = [layout(state).names[parameter] for parameter in undetermined]
            raise Unidentifiable(
                f"{self.blocks[0].measured.file}: these rows do not determine {', '.join(names)} where the search "
                "ended; measure at more different joint values",
                names,
            )
        table = layout(state)
        rows = sum(piece.part.value.size - piece.part.nuisances for piece in self.pieces)
        # parameters that rest on their prior take nothing from the measurements' degrees of freedom
        resting = self._resting(solution)
        dof = max(rows - len(self.free) + round(resting), 1)
        pull = self._pull(state)
        variance = max(solution.cost - float(pull @ pull), 0.0) / dof
        names = tuple(table.names[k] for k in self.free)
        units = tuple(table.units[k] for k in self.free)
        values = parameter_values(state)[self.free]
        covariance_of_fit = self._posterior(solution.factor, variance)
        estimate = Estimate(
            names=names,
            units=units,
            values=values,
            covariance=covariance_of_fit,
            residual_std=float(np.sqrt(variance)),
            dof=dof,
        )
        return GeometricFit(
            cell=state,
            start=self.nominal,
            free=self.free,
            estimate=estimate,
            split=None,
            candidates=self.free,
            solution=solution,
            blocks=self.blocks,
            pieces=self.pieces,
            prior=self.prior,
        )


def _rows(cell: Installation, free: np.ndarray, blocks: list[Block], pieces: list[Piece]) -> Iterator[Rows]:
    """Yield the residuals of all blocks and their Jacobians, whitened with the sigmas and weights in `pieces`.

    Args:
        cell: the installation at which derivatives are computed.
        free: (f,) indices of the fitted parameters.
        blocks: the prepared measurements.
        pieces: residual parts of all blocks, with sigmas and weights.
    """
    for number, block in enumerate(blocks):
        noises = [piece.part.noise for piece in pieces if piece.block == number]
        yield from whitened(cell, block, free, _scales(pieces, number), noises)


def _scales(pieces: list[Piece], number: int) -> list[np.ndarray]:
    """Return the divisors (rows, m) of a block's residual parts: sigma over the root of the robust weight.

    Args:
        pieces: residual parts of all blocks.
        number: index of the block.
    """
    return [piece.sigma / np.sqrt(piece.weight) for piece in pieces if piece.block == number]


def _sigma(part: ResidualPart, share: float, start: bool, robustly: bool) -> np.ndarray:
    """Return the standard deviations (rows, m) of a part: stated in the file, or estimated from the residuals.

    Args:
        part: residuals in m or rad.
        share: degrees of freedom per measured number; the estimated variance is divided by it.
        start: True before the first pass: a typical value is returned in place of an estimate.
        robustly: True estimates from the median of the residuals, False from their rms.
    """
    if part.sigma is not None:
        return part.sigma
    if start:
        return np.full(part.value.shape, START_SIGMA[part.label])
    if robustly:
        spread = robust.spread(part.value)
    else:
        spread = float(np.sqrt(np.mean(part.value**2)))
    return np.full(part.value.shape, max(spread / np.sqrt(share), MIN_SIGMA))


def _size(part: ResidualPart, sigma: np.ndarray) -> np.ndarray:
    """Return the size (m,) of each row's residual in sigmas, rms over its components, without noise that rows share.

    Args:
        part: residuals of m rows.
        sigma: (rows, m) standard deviations of the residuals, in their unit.
    """
    return np.sqrt(np.mean((part.alone(sigma) / sigma) ** 2, axis=0))
