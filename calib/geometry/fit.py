"""Fit of the geometry: Levenberg–Marquardt on the whitened residuals of all kinds of measurements together."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.data.poses.measurements import PoseMeasurements
from calib.errors import Unidentifiable, refuse_data
from calib.estimation.base_columns import ColumnSplit
from calib.estimation.nonlinear import covariance, solve
from calib.estimation.relevance import relevance
from calib.geometry.first_guess import install
from calib.geometry.installation import Installation
from calib.geometry.observability import base_columns
from calib.geometry.observation import (
    Block,
    families,
    layout,
    observe,
    parameter_values,
    prepare,
    rows_of,
    sampled,
    step,
)
from calib.geometry.weighing import GeometricFit, Settings, Weigher
from calib.robot.calibrated import Deflection
from calib.robot.chain import Chain, element_length

PLAUSIBLE = {"m": 0.01, "rad": 0.05}  # how far a real arm may be from its nominal (our choice)
WARM_POSES = 2000  # of which the fit of many more begins (our choice)
CRAWLS = 60  # linearisations after which a placement that has not settled does not tell itself (our choice)


def fit(
    cell: Installation,
    measured: Sequence[PoseMeasurements],
    candidates: np.ndarray | None = None,
    *,
    settings: Settings | None = None,
    regularised: bool = False,
    prior: np.ndarray | None = None,
) -> GeometricFit:
    """Return the fit of the identifiable parameters among `candidates`; the others keep their nominal values.

    Minimises Σ ‖(y - f(x)) / σ‖². Three passes: columns that are linear combinations of others are set aside; the rest
    is fitted with a wide prior (`PLAUSIBLE`), which settles the sigmas; then every parameter that the data do not
    identify better than half of what is plausible goes back to its nominal, and the others are fitted without any
    prior.

    Args:
        cell: where to start; frames placed (`calib.geometry.first_guess`).
        measured: blocks of measurements.
        candidates: (c,) positions in the parameter vector; None for all.
        settings: see `Settings`.
        regularised: keep all independent parameters, pulled towards nominal with the most probable strength
            (`_shrunk_fit`), instead of fixing the unidentified ones at nominal.
        prior: prior standard deviations of the whole parameter vector about its present values; infinite without a
            prior. Parameters with a prior are always fitted.

    Raises:
        MeasurementError: fewer rows than unknowns.
    """
    settings = settings or Settings()
    table = layout(cell)
    candidates = np.arange(len(table.names)) if candidates is None else np.asarray(candidates, dtype=int)
    blocks = prepare(cell, measured)
    split = base_columns(cell, blocks, candidates, settings.tolerance)
    free = candidates[split.kept]
    if split is not None and not len(free):
        raise Unidentifiable(
            "these rows determine no parameter of the robot: each socket, bar, plane or pair needs several "
            "rows at different joint values; measure more rows of each"
        )
    stated = np.full(len(table.names), np.inf) if prior is None else prior
    _enough(cell, blocks, int(np.isinf(stated[free]).sum()))
    if regularised:
        free = np.setdiff1d(free, _scale_reference(cell, split, candidates))
        return replace(_shrunk_fit(cell, blocks, free, settings, stated[free]), split=split, candidates=candidates)
    start, found, max_retries = cell, None, 4
    for attempt in range(1 + max_retries):
        plausible = np.where(np.isfinite(stated[free]), np.inf, plausible_deviation(cell, free))
        if attempt == 0 and not np.isfinite(plausible).any():
            continue
        wide = attempt == 0  # sigmas settle without the wide prior
        own = np.minimum(stated[free], plausible) if wide else stated[free]
        once = replace(settings, passes=1) if wide else settings
        found = fit_with_prior(start, blocks, free, own, settings=once, nominal=cell)
        clear = _identifiable_columns(found, plausible)
        if not wide and len(clear) == len(free):
            break
        start, free = _back_to_nominal(found.cell, cell, candidates, free[clear]), free[clear]
    assert found is not None
    return replace(found, start=cell, split=split, candidates=candidates)


def _enough(cell: Installation, blocks: list[Block], unknowns: int, min_numbers: float = 1.5) -> None:
    """Raise an error for fewer than `min_numbers` measured numbers per unknown: such a fit could not be checked.

    `min_numbers`: measured numbers per unknown at least (our choice).
    """
    parts = [part for block in blocks for part in observe(cell, block, np.array([], dtype=int))]
    numbers = sum(part.value.size - part.nuisances for part in parts)
    if numbers < min_numbers * unknowns:
        poses = sum(len(block.measured) for block in blocks)
        needed = math.ceil(min_numbers * unknowns * poses / max(numbers, 1))
        refuse_data(
            blocks[0].measured.file,
            f"{poses} poses are too few: {unknowns} unknowns and a check of the fit need at least {needed} poses, "
            "the full geometry 20 to 40; measure more, or choose a smaller model ('offsets' or "
            "'frames')",
        )


def _scale_reference(cell: Installation, split: ColumnSplit, candidates: np.ndarray) -> np.ndarray:
    """Return the index of the arm's longest length among the base columns (an array of one element, or empty).

    Sockets and planes are as well explained by a smaller arm, in the limit by none at all, so that the scale has to
    come from the nominal: this length stays. What others merge with a column counts with it.
    """
    lengths = np.zeros(len(candidates))
    for place, k in enumerate(candidates):
        if k < len(cell.chain.elements):
            lengths[place] = element_length(cell.chain, int(k))
    total = lengths[split.kept] + split.coefficients @ lengths[split.dropped]
    own = np.array([k < len(cell.chain.elements) and cell.chain.elements[k].axis[0] == "t" for k in candidates])
    total = np.where(own[split.kept], np.abs(total), 0.0)
    return candidates[split.kept[[int(np.argmax(total))]]] if total.max(initial=0.0) > 0.0 else candidates[:0]


def _shrunk_fit(
    cell: Installation, blocks: list[Block], free: np.ndarray, settings: Settings, stated: np.ndarray
) -> GeometricFit:
    """Return a fit regularised towards nominal values; the prior's widths maximise the evidence (MacKay 1992).

    One width for joint offsets, one for other angles, one for lengths. Where measurements come from a few places only
    (sockets, a plane), directions they hardly see would otherwise move the arm by centimetres to explain micrometres.
    """
    kind = [{"offset": 0, "rad": 1, "m": 2}.get(each, -1) for each in families(cell)[free].tolist()]
    _, family = np.unique(kind, return_inverse=True)
    family = family - int(min(kind) < 0)
    prior = plausible_deviation(cell, free)
    nominal = parameter_values(cell)[free]
    found = fit_with_prior(cell, blocks, free, prior, settings=settings)
    min_width = 1e-6  # [m, rad]
    width_updates = 3  # updates of a regularised fit's widths
    for _ in range(width_updates):
        moved = np.where(family >= 0, parameter_values(found.cell)[free] - nominal, 0.0)
        widths = relevance(found.data().moved(moved).gram(), family, prior).ridge
        prior = np.where(family >= 0, np.clip(widths, min_width, plausible_deviation(cell, free)), np.inf)
        prior = np.minimum(prior, stated)
        found = fit_with_prior(cell, blocks, free, prior, settings=settings)
    return found


def _back_to_nominal(
    cell: Installation, nominal: Installation, candidates: np.ndarray, free: np.ndarray
) -> Installation:
    """Return `cell` with the arm's candidate parameters reset to nominal unless they are free."""
    arm = np.intersect1d(candidates, layout(cell).index("arm"))
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
    """Return the fit of exactly the parameters `free`: min Σ ‖(y - f(x)) / σ‖² + Σ ((x - x_nominal) / σ_prior)².

    Sigmas that no file states are estimated, one per file and nature (position, orientation …), and the fit repeated
    until they settle; so are the weights of a robust loss. Thousands of poses begin where a sample of them ends.

    Args:
        cell: where to start.
        blocks: measurements prepared for this installation.
        free: (f,) positions in the parameter vector.
        prior: (f,) standard deviations; infinite for none.
        settings: see `Settings`.
        nominal: mean of the prior; None for `cell`.
    """
    settings = settings or Settings()
    state, solution = cell, None
    rows = sampled([block.measured for block in blocks], max(WARM_POSES, 4 * len(free)))
    few = 4 * sum(map(len, rows)) <= sum(len(block.measured) for block in blocks)
    if few:
        some = [rows_of(cell, block, own) for block, own in zip(blocks, rows)]
        state = fit_with_prior(cell, some, free, prior, settings=settings, nominal=nominal).cell
    weigher = Weigher(settings, nominal or cell, blocks, free, prior)
    weigher.update(state, first=not few)
    image_passes = 20  # at most, until the noise of images settles (our choice)
    for _ in range(image_passes if any(weigher.noises) and settings.passes > 1 else settings.passes):
        solution = solve(
            weigher.linearise, lambda s, dx: step(s, free, dx), state,
            damping=settings.damping, limit=settings.limit,
        )  # fmt: skip
        state, settled = solution.state, weigher.settle(solution)
        if settled is not None:
            return weigher.result(settled)
    assert solution is not None
    weigher.pieces = weigher.used
    return weigher.result(solution)


def plausible_deviation(cell: Installation, columns: np.ndarray) -> np.ndarray:
    """Return how far each parameter may plausibly be from nominal (c,); infinite for frames and deflections."""
    table = layout(cell)
    return np.array([PLAUSIBLE[table.units[k]] if table.kinds[k] == "arm" else np.inf for k in columns])


def _identifiable_columns(found: GeometricFit, plausible: np.ndarray) -> np.ndarray:
    """Return the indices of fitted parameters with σ below half the plausible deviation, hence identifiable.

    Backward elimination: the worst identified parameter goes back to its nominal, which changes the covariance C of the
    others to C - c cᵀ / c_k (c its column), until all that remain are identified.
    """
    factor = found.data().factor
    norms = np.linalg.norm(factor, axis=0)
    left = covariance(factor / norms, found.estimate.residual_std**2) / np.outer(norms, norms)
    kept = np.ones(len(plausible), dtype=bool)
    while True:
        ratio = np.where(kept, np.sqrt(np.clip(np.diag(left), 0.0, None)) / plausible, 0.0)
        worst = int(np.argmax(ratio))
        if ratio[worst] <= 0.5:
            return np.flatnonzero(kept)
        kept[worst] = False
        left = left - np.outer(left[:, worst], left[worst]) / left[worst, worst]


def polish_frames(
    cell: Installation, measured: Sequence[PoseMeasurements], settings: Settings | None = None
) -> GeometricFit:
    """Return the fit of station and tool placements only; the arm stays as it is."""
    return fit(cell, measured, layout(cell).frame_index, settings=settings)


def placed_on(cell: Installation, block: PoseMeasurements, settings: Settings) -> GeometricFit:
    """Return the arm with base and tool placement fitted to one block, arm and deflections unchanged.

    Where that does not settle, since the block hardly identifies some of it (the turn about a line that is driven),
    what it identifies by less than `min_column` stays where it is. Whether that settled is the solution's status.
    """
    start = install(cell.chain, [block], cell.known)
    start = replace(start, deflection=cell.deflection, optics=start.optics.like(cell.optics))
    found = polish_frames(start, [block], replace(settings, limit=CRAWLS))
    if found.solution.status.good:
        return found
    min_column = 1e-3  # relative size of a column of a placement that a block hardly tells (our choice)
    return polish_frames(found.cell, [block], replace(settings, tolerance=min_column))


def without_corrections(
    cell: Installation, rigid: Chain, blocks: Sequence[PoseMeasurements], settings: Settings
) -> Installation | None:
    """Return the arm without corrections (for a URDF), frames fitted again; None if `cell` has no corrections.

    Args:
        cell: the calibrated installation.
        rigid: the best geometry without corrections; the geometry in `cell` is valid only together with its
            corrections.
        blocks: the fit's rows.
        settings: of the fit.
    """
    if not (cell.deflection.terms or cell.known.terms):
        return None
    bare = replace(cell, chain=rigid, deflection=Deflection(), known=Deflection())
    return polish_frames(bare, blocks, settings).cell
