"""Fit the geometry: Levenberg–Marquardt on whitened residuals of every kind of measurement at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.data.measurements import PoseMeasurements
from calib.errors import MeasurementError, UsageError
from calib.estimation import robust
from calib.estimation.columns import ColumnSplit
from calib.estimation.estimate import Estimate
from calib.estimation.nonlinear import Solution, covariance, solve
from calib.estimation.relevance import gram, relevance
from calib.geometry.identifiability import base_columns
from calib.geometry.installation import Installation
from calib.geometry.observation import Block, observe, prepare, stack
from calib.geometry.parameters import layout, layout_counts, step
from calib.geometry.residuals import Part

PLAUSIBLE = {"m": 0.01, "rad": 0.05}  # how far a real arm may be from its nominal (our choice)
RETRIES = 4
WIDTHS = 3  # updates of a drawn fit's widths
NARROWEST = 1e-6  # [m, rad]
START_SIGMA = {"position": 1e-3, "orientation": 1e-3, "consistency": 1e-3, "distance": 1e-3, "plane": 1e-3}


@dataclass(frozen=True)
class Settings:
    """How to fit.

    Attributes:
        loss: ``none``, ``huber`` or ``cauchy``, on the size of each row's whitened residual; ``auto`` is for the
            ladder, which takes ``cauchy`` where rows are grossly wrong (`calib.geometry.ladder`), and else is ``none``.
        loss_scale: the loss's constant, in sigmas; None for its usual one.
        damping: first λ of Levenberg–Marquardt; 0 for the iterative linear least squares of eq. 11.
        tolerance: relative size of a column that counts as dependent.
        limit: linearisations at most, per pass.
        passes: how often sigmas that are not stated (and robust weights) are estimated anew.
    """

    loss: str = "none"
    loss_scale: float | None = None
    damping: float = 1e-8
    tolerance: float = 1e-6
    limit: int = 300
    passes: int = 3


@dataclass(frozen=True, eq=False)
class GeometricFit:
    """The outcome of a fit.

    Attributes:
        cell: the calibrated installation.
        start: the installation the fit began with.
        free: (f,) positions of the fitted parameters in the full vector (`calib.geometry.parameters`).
        estimate: values and covariance of the fitted parameters; stations and tools as displacements from the fitted
            placement, hence with value 0.
        split: which candidate columns were kept; None where the caller named the free ones.
        candidates: what ``split`` indexes.
        solution: the last Levenberg–Marquardt pass.
        blocks, found: the prepared measurements and their residual parts at the solution.
        sigmas: per part, the standard deviations used.
        weights: per part, (m,) robust weights.
        prior: (f,) standard deviations about the nominal that the fit was drawn with; infinite for none.
    """

    cell: Installation
    start: Installation
    free: np.ndarray
    estimate: Estimate
    split: ColumnSplit | None
    candidates: np.ndarray
    solution: Solution
    blocks: list[Block]
    found: list[Part]
    sigmas: list[np.ndarray]
    weights: list[np.ndarray]
    prior: np.ndarray | None = None


def fit(
    cell: Installation,
    measured: Sequence[PoseMeasurements],
    candidates: np.ndarray | None = None,
    *,
    settings: Settings | None = None,
    torques: Sequence[np.ndarray | None] | None = None,
    drawn: bool = False,
) -> GeometricFit:
    """Fit what can be told of the parameters `candidates`; the others keep their nominal values.

    Minimises Σ ‖(y - f(x)) / σ‖². Three passes: columns that are linear combinations of others are set aside; the rest
    is fitted with a wide prior (`PLAUSIBLE`), which settles the sigmas; then every parameter that the data do not tell
    better than half of what is plausible goes back to its nominal, and the others are fitted without any prior.

    Args:
        cell: where to start; frames placed (`calib.geometry.first_guess`).
        measured: blocks of measurements.
        candidates: (c,) positions in the parameter vector; None for all.
        settings: see `Settings`.
        torques: gravity torques (m, n) per block [N m], for compliance terms.
        drawn: keep all independent parameters, drawn to their nominal as strongly as the data themselves say
            (`drawn_fit`), in place of sending the untold ones back.

    Raises:
        MeasurementError: fewer rows than unknowns.
    """
    settings = settings or Settings()
    table = layout(cell)
    candidates = np.arange(len(table.names)) if candidates is None else np.asarray(candidates, dtype=int)
    blocks = prepare(cell, measured, torques)
    split = base_columns(cell, blocks, candidates, settings.tolerance)
    free = candidates[split.kept]
    if drawn:
        return replace(drawn_fit(cell, blocks, free, settings), split=split, candidates=candidates)
    plausible = plausible_deviation(cell, free)
    start, found = cell, None
    for prior in (plausible, *[None] * RETRIES):
        if prior is not None and not np.isfinite(prior).any():
            continue
        found = fit_with_prior(start, blocks, free, prior, settings=settings)
        told = told_columns(found, plausible)
        if prior is None and len(told) == len(free):
            break
        start, free, plausible = _back_to_nominal(found.cell, cell, candidates, free[told]), free[told], plausible[told]
    assert found is not None
    return replace(found, start=cell, split=split, candidates=candidates)


def drawn_fit(cell: Installation, blocks: list[Block], free: np.ndarray, settings: Settings) -> GeometricFit:
    """Fit with a prior about the nominal whose widths are the most probable ones (evidence; MacKay 1992).

    One width for joint offsets, one for other angles, one for lengths. Where measurements come from a few places only
    (sockets, a plane), directions they hardly see would otherwise move the arm by centimetres to explain micrometres.
    """
    table, moving = layout(cell), {e.name for e in cell.chain.elements if e.joint is not None}
    kind = [
        -1 if k >= table.arm else 0 if table.names[k] in moving else 1 if table.units[k] == "rad" else 2 for k in free
    ]
    _, family = np.unique(kind, return_inverse=True)
    family = family - int(min(kind) < 0)
    prior = plausible_deviation(cell, free)
    nominal = parameter_values(cell)[free]
    found = fit_with_prior(cell, blocks, free, prior, settings=settings)
    for _ in range(WIDTHS):
        residual, matrix = stack(found.found, [s / np.sqrt(w) for s, w in zip(found.sigmas, found.weights)])
        moved = np.where(family >= 0, parameter_values(found.cell)[free] - nominal, 0.0)
        widths = relevance(gram(residual + matrix @ moved, matrix), family, prior).ridge
        prior = np.where(family >= 0, np.clip(widths, NARROWEST, plausible_deviation(cell, free)), np.inf)
        found = fit_with_prior(cell, blocks, free, prior, settings=settings)
    return found


def _back_to_nominal(
    cell: Installation, nominal: Installation, candidates: np.ndarray, free: np.ndarray
) -> Installation:
    """Return `cell` with the arm's candidates that are not free at their nominal values again."""
    arm = candidates[candidates < layout(cell).arm]
    back = np.setdiff1d(arm, free)
    return step(cell, back, nominal.chain.values[back] - cell.chain.values[back])


def fit_with_prior(
    cell: Installation,
    blocks: list[Block],
    free: np.ndarray,
    prior: np.ndarray | None = None,
    *,
    settings: Settings | None = None,
    nominal: Installation | None = None,
) -> GeometricFit:
    """Fit exactly the parameters `free`, minimising Σ ‖(y - f(x)) / σ‖² + Σ ((x - x_nominal) / σ_prior)².

    Sigmas that no file states are estimated, one per file and nature (position, orientation …), and the fit repeated
    until they settle; so are the weights of a robust loss.

    Args:
        cell: where to start.
        blocks: measurements prepared for this installation.
        free: (f,) positions in the parameter vector.
        prior: (f,) standard deviations; infinite for none.
        settings: see `Settings`.
        nominal: what the prior draws to; None for `cell`.
    """
    settings = settings or Settings()
    weigher = _Weigher(settings, nominal or cell, blocks, free, prior)
    state, solution = cell, None
    for number in range(settings.passes):
        weigher.update(state, first=number == 0)
        solution = solve(
            weigher.linearise, lambda s, dx: step(s, free, dx), state,
            damping=settings.damping, limit=settings.limit,
        )  # fmt: skip
        state = solution.state
        if weigher.settled(state):
            break
    assert solution is not None
    return weigher.result(cell, solution)


def plausible_deviation(cell: Installation, columns: np.ndarray) -> np.ndarray:
    """Return how far a real arm's parameter may lie from its nominal (c,); infinite for frames and deflections."""
    table = layout(cell)
    return np.array([PLAUSIBLE[table.units[k]] if k < table.arm else np.inf for k in columns])


def told_columns(found: GeometricFit, plausible: np.ndarray) -> np.ndarray:
    """Return which of the fitted parameters the data tell (indices): σ below half the plausible deviation.

    Backward elimination: the worst told parameter goes back to its nominal, which changes the covariance C of the
    others to C - c cᵀ / c_k (c its column), until all that remain are told.
    """
    _, matrix = stack(found.found, [sigma / np.sqrt(w) for sigma, w in zip(found.sigmas, found.weights)])
    factor = np.linalg.qr(matrix, mode="r")
    norms = np.linalg.norm(factor, axis=0)
    left = covariance(factor / norms, found.estimate.residual_std**2) / np.outer(norms, norms)
    told = np.ones(len(plausible), dtype=bool)
    while True:
        ratio = np.where(told, np.sqrt(np.clip(np.diag(left), 0.0, None)) / plausible, 0.0)
        worst = int(np.argmax(ratio))
        if ratio[worst] <= 0.5:
            return np.flatnonzero(told)
        told[worst] = False
        left = left - np.outer(left[:, worst], left[worst]) / left[worst, worst]


class _Weigher:
    """Holds what changes between passes: sigmas and robust weights of every part."""

    def __init__(
        self, settings: Settings, nominal: Installation, blocks: list[Block], free: np.ndarray, prior: np.ndarray | None
    ):
        self.settings, self.nominal, self.blocks, self.free = settings, nominal, blocks, free
        self.prior = prior if prior is not None and np.isfinite(prior).any() else None
        self.sigmas: list[np.ndarray] = []
        self.weights: list[np.ndarray] = []

    def parts(self, state: Installation, free: np.ndarray | None = None) -> list[Part]:
        chosen = self.free if free is None else free
        return [part for block in self.blocks for part in observe(state, block, chosen)]

    def update(self, state: Installation, first: bool) -> None:
        """Set sigmas and weights from the residuals at a state."""
        found = self.parts(state, np.array([], dtype=int))
        rows = sum(part.value.size for part in found)
        unknown = len(self.free) + sum(part.nuisances for part in found)
        if rows < unknown and self.prior is None:
            raise MeasurementError(
                f"{rows} measured numbers cannot determine {unknown} unknowns; measure more poses, or fit a smaller "
                "model (--model frames or offsets)",
                self.blocks[0].measured.file,
            )
        share = max(1.0 - unknown / rows, 0.05)
        loss = "none" if self.settings.loss == "auto" else self.settings.loss
        robustly = loss != "none"
        self.sigmas = [_sigma(part, share, first and not robustly, robustly) for part in found]
        self.weights = [
            robust.weights(_size(part, sigma), loss, self.settings.loss_scale)
            for part, sigma in zip(found, self.sigmas)
        ]

    def settled(self, state: Installation) -> bool:
        """Say whether another pass would change the sigmas by less than 2 %."""
        before, weights = self.sigmas, self.weights
        self.update(state, first=False)
        same = all(abs(np.mean(new / old) - 1.0) < 0.02 for new, old in zip(self.sigmas, before))
        steady = all(np.abs(new - old).max(initial=0.0) < 0.02 for new, old in zip(self.weights, weights))
        self.sigmas, self.weights = before, weights
        return same and steady

    def linearise(self, state: Installation) -> tuple[np.ndarray, np.ndarray]:
        found = self.parts(state)
        scales = [sigma / np.sqrt(weight) for sigma, weight in zip(self.sigmas, self.weights)]
        residual, matrix = stack(found, scales)
        if self.prior is not None:
            pull = (parameter_values(self.nominal) - parameter_values(state))[self.free] / self.prior
            held = np.isfinite(self.prior)
            residual = np.concatenate([residual, pull[held]])
            matrix = np.vstack([matrix, np.diag(1.0 / self.prior)[held]])
        return residual, matrix

    def result(self, cell: Installation, solution: Solution) -> GeometricFit:
        state = solution.state
        found = self.parts(state)
        table = layout(cell)
        rows = sum(part.value.size for part in found)
        dof = rows - len(self.free) - sum(part.nuisances for part in found)
        if self.prior is not None:
            dof = max(dof + int(np.isfinite(self.prior).sum()), 1)
        variance = solution.cost / max(dof, 1)
        estimate = Estimate(
            tuple(table.names[k] for k in self.free),
            tuple(table.units[k] for k in self.free),
            parameter_values(state)[self.free],
            covariance(solution.factor, variance),
            float(np.sqrt(variance)),
            dof,
        )
        return GeometricFit(
            state, cell, self.free, estimate, None, self.free, solution, self.blocks, found, self.sigmas,
            self.weights, self.prior,
        )  # fmt: skip


def parameter_values(cell: Installation) -> np.ndarray:
    """Return the full parameter vector; frames count from their present placement, hence zeros."""
    _, stations, tools, _ = layout_counts(cell)
    return np.concatenate([cell.chain.values, np.zeros(stations + tools), np.asarray(cell.deflection.coefficients)])


def _sigma(part: Part, share: float, start: bool, robustly: bool) -> np.ndarray:
    """Return the stated sigmas of a part, or one estimated from its residuals, as (rows, m)."""
    if part.sigma is not None:
        return part.sigma
    if start:
        return np.full(part.value.shape, START_SIGMA[part.label])
    found = robust.spread(part.value) if robustly else float(np.sqrt(np.mean(part.value**2)))
    return np.full(part.value.shape, max(found / np.sqrt(share), 1e-12))


def _size(part: Part, sigma: np.ndarray) -> np.ndarray:
    """Return each row's residual in sigmas, root mean square over its components (m,)."""
    return np.sqrt(np.mean((part.value / sigma) ** 2, axis=0))


def used_sigmas(found: GeometricFit) -> list[dict[str, float]]:
    """Return per block the rms standard deviation used for each label, scaled to the residuals actually left."""
    result, start = [], 0
    for block in found.blocks:
        count = _labels(block)
        parts = zip(found.found[start : start + count], found.sigmas[start : start + count])
        result.append({part.label: float(np.sqrt(np.mean(sigma**2))) for part, sigma in parts})
        start += count
    return result


def row_weights(found: GeometricFit) -> list[np.ndarray]:
    """Return per block the smallest robust weight of each row's parts (m,); 1 without a robust loss."""
    result, start = [], 0
    for block in found.blocks:
        weight, count = np.ones(len(block.measured)), _labels(block)
        for part, own in zip(found.found[start : start + count], found.weights[start : start + count]):
            if len(part.index) == len(weight):
                weight = np.minimum(weight, own)
        result.append(weight)
        start += count
    return result


def outliers(found: GeometricFit, threshold: float = 4.0) -> list[tuple[str, int, str, float]]:
    """Return (file, row, label, size in robust sigmas) of rows that do not fit, worst first.

    Sizes are measured against the robust spread of their own part (1.4826 · median), not against stated sigmas, so
    that an optimistic instrument does not make every row an outlier.
    """
    result = []
    start = 0
    for block in found.blocks:
        labels = _labels(block)
        for part in found.found[start : start + labels]:
            spread = max(robust.spread(part.value), 1e-15)
            size = np.sqrt(np.mean(part.value**2, axis=0)) / spread
            rows = block.measured.rows[part.index]
            result += [
                (block.measured.file, int(rows[i]), part.label, float(size[i]))
                for i in np.flatnonzero(size > threshold)
            ]
        start += labels
    return sorted(result, key=lambda item: -item[3])


def _labels(block: Block) -> int:
    """Return how many parts a block gives."""
    if block.measured.kind == "pose":
        return 2
    return 2 if block.measured.kind == "sockets" and block.measured.links else 1


def frames_only(cell: Installation) -> np.ndarray:
    """Return the positions of all station and tool elements."""
    return layout(cell).frame_index


def polish_frames(
    cell: Installation,
    measured: Sequence[PoseMeasurements],
    settings: Settings | None = None,
    torques: Sequence[np.ndarray | None] | None = None,
) -> GeometricFit:
    """Fit stations and tools only, the arm staying as it is: what 'nominal' errors are measured with."""
    return fit(cell, measured, frames_only(cell), settings=settings, torques=torques)


def combine(settings: Settings, **changes: object) -> Settings:
    """Return settings with some fields changed.

    Raises:
        UsageError: for a loss that does not exist.
    """
    result = replace(settings, **changes)  # type: ignore[arg-type]
    if result.loss not in ("auto", *robust.LOSSES):
        raise UsageError(f"loss '{result.loss}' is none of auto, {', '.join(robust.LOSSES)}")
    return result
