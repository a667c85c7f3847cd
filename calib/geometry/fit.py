"""Fit of the geometry: Levenberg–Marquardt on the whitened residuals of all kinds of measurements together."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from calib.data.poses.measurements import PoseMeasurements
from calib.errors import MeasurementError, Unidentifiable, refuse_data
from calib.estimation.base_columns import ColumnSplit
from calib.estimation.nonlinear import solve
from calib.estimation.relevance import Gram
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

# How far a parameter of a real arm may be from its nominal by making: one standard deviation (our choice)
PLAUSIBLE = {"m": 0.01, "rad": 0.05}
# widths of making of a usual arm: what one more parameter would say (our choice)
TYPICAL = {"m": 3e-3, "rad": 5e-3}
# measured numbers per unknown at least (our choice)
MIN_NUMBERS = 1.5
# fits with new widths of making, which then change by less than their uncertainty
WIDTH_UPDATES = 2
# of WᵀW with its diagonal scaled to 1; its root of columns
ROUNDING = 1e-12
# of the fixed point of the widths between two fits
WIDTH_ROUNDS = 30
# share of its largest coefficient from which a parameter counts as merged with another
MERGED = 0.1
# relative deviation of a column's coefficients from those of a common scale (our choice)
SCALE_DEVIATION = 0.2
# poses with which the fit of many more begins, and that widths are estimated from (our choice)
WARM_POSES = 2000
# passes at most until the noise of images settles (our choice)
IMAGE_PASSES = 20
# linearisations after which a placement that has not settled does not tell itself (our choice)
CRAWLS = 60
# relative size of a column of a placement that a block hardly tells (our choice)
MIN_COLUMN = 1e-3


def fit(
    cell: Installation,
    measured: Sequence[PoseMeasurements],
    candidates: np.ndarray | None = None,
    *,
    settings: Settings | None = None,
    prior: np.ndarray | None = None,
    widths: bool = True,
) -> GeometricFit:
    """Return the most probable geometry: all candidate parameters of the arm, each with a prior of making.

    Minimises Σ ‖(y - f(x)) / σ‖² + Σ ((x - x_nominal) / w)². No parameter of the arm is selected: parameters that merge
    share the effect that the measurements determine, and undetermined ones stay near nominal. The widths w of making,
    one for joint offsets, one for other angles and one for lengths, maximise the evidence (MacKay 1992). Placements
    have no prior: only their base columns are fitted, and arm parameters that merely displace base or tool stay at
    nominal. The identifiable parameters are computed afterwards (`GeometricFit.split`, `GeometricFit.base_sigma`).

    Args:
        cell: installation to start from, with frames placed (`calib.geometry.first_guess`).
        measured: blocks of measurements.
        candidates: (c,) positions in the parameter vector; None for all.
        settings: see `Settings`.
        prior: standard deviations of the whole parameter vector about its present values; infinite where the prior of
            making applies; None for making everywhere.
        widths: whether to estimate the widths of making; False to use `PLAUSIBLE`.

    Raises:
        MeasurementError: if there are fewer rows than identifiable parameters.
        Unidentifiable: if the rows determine no parameter.
    """
    settings = settings or Settings()
    table = layout(cell)
    if candidates is None:
        candidates = np.arange(len(table.names))
    candidates = np.asarray(candidates, dtype=int)
    blocks = prepare(cell, measured)
    split = base_columns(cell, blocks, candidates, settings.tolerance)
    if not split.rank:
        raise Unidentifiable(
            "these rows determine no parameter of the robot: each socket, bar, plane or pair needs several "
            "rows at different joint values; measure more rows of each"
        )
    stated_sigma = prior
    if stated_sigma is None:
        stated_sigma = np.full(len(table.names), np.inf)
    without_prior = np.isinf(stated_sigma[candidates[split.kept]])
    _require_enough(cell, blocks, int(without_prior.sum()))
    free = _estimated(cell, split, candidates)
    if not any(block.measures_length for block in measured):
        free = np.setdiff1d(free, _scale_reference(cell, split, candidates))
    has_prior = np.isfinite(stated_sigma[free])
    making = np.where(has_prior, stated_sigma[free], plausible_deviation(cell, free))
    start = cell
    warm = widths and bool(np.isfinite(making).any())
    if warm:
        start, making = _making(cell, blocks, free, making, has_prior, settings)
    result = fit_with_prior(start, blocks, free, making, settings=settings, nominal=cell, warm=warm)
    return replace(result, start=cell, split=split, candidates=candidates)


def _require_enough(cell: Installation, blocks: list[Block], unknowns: int) -> None:
    """Raise an error for fewer than `MIN_NUMBERS` measured numbers per unknown: such a fit could not be checked."""
    numbers = 0
    poses = 0
    for block in blocks:
        poses += len(block.measured)
        for part in observe(cell, block, np.array([], dtype=int)):
            numbers += part.value.size - part.nuisances
    if numbers < MIN_NUMBERS * unknowns:
        needed = math.ceil(MIN_NUMBERS * unknowns * poses / max(numbers, 1))
        refuse_data(
            blocks[0].measured.file,
            f"{poses} poses are too few: {unknowns} unknowns and a check of the fit need at least {needed} poses, "
            "the full geometry 20 to 40; measure more, or choose a smaller model ('offsets' or "
            "'frames')",
        )


def plain_fit(cell: Installation, measured: Sequence[PoseMeasurements]) -> GeometricFit | None:
    """Return the plain reference: all parameters, the widest priors of making, every row with the same weight.

    Only the parameters and the noise are estimated, and nothing is selected, as a short script on SciPy would do. Other
    results are compared with it. None if there are too few rows.

    Args:
        cell: the nominal arm, with frames placed.
        measured: blocks of measurements.
    """
    try:
        return fit(cell, measured, layout(cell).rigid_index, widths=False)
    except (MeasurementError, Unidentifiable):
        return None


def _estimated(cell: Installation, split: ColumnSplit, candidates: np.ndarray) -> np.ndarray:
    """Return the parameters to estimate: those of the arm that have an effect, and the base columns of all others.

    Parameters of the arm that only displace base or tool stay at nominal: those frames account for them.
    """
    arm = layout(cell).index("arm")
    in_arm = np.isin(candidates[split.kept], arm)
    size = np.abs(split.coefficients)
    largest = size.max(axis=0, initial=0.0)
    displaces_frames = size[in_arm].max(axis=0, initial=0.0) <= ROUNDING**0.5 * largest
    excluded = np.concatenate([split.without_effect, split.dropped[displaces_frames]])
    effective = np.setdiff1d(candidates, candidates[excluded])
    return np.union1d(np.intersect1d(effective, arm), candidates[split.kept])


def _scale_reference(cell: Installation, split: ColumnSplit, candidates: np.ndarray) -> np.ndarray:
    """Return the arm's longest length and the parameters that merge with it; empty for an arm without lengths.

    A smaller arm explains sockets and planes as well, so that the scale has to come from the nominal arm: the longest
    length keeps its nominal value, as do the parameters that could replace it.
    """
    lengths = np.zeros(len(candidates))
    for column, parameter in enumerate(candidates):
        if parameter < len(cell.chain.elements):
            lengths[column] = element_length(cell.chain, int(parameter))
    lengths[split.without_effect] = 0.0
    longest = int(np.argmax(np.abs(lengths)))
    if lengths[longest] == 0.0:
        return candidates[:0]
    # columns that depend on others by the scale alone do not replace any of them
    merges = ~_depend_by_scale(lengths, split)
    share = np.abs(split.coefficients[:, merges])
    dropped = split.dropped[merges]
    merged = share > MERGED * share.max(axis=0, initial=0.0)
    if longest in split.kept:
        base = int(np.flatnonzero(split.kept == longest)[0])
    elif longest in dropped:
        base = int(np.argmax(share[:, np.flatnonzero(dropped == longest)[0]]))
    else:
        return candidates[[longest]]
    return candidates[np.union1d([longest, split.kept[base]], dropped[merged[base]]).astype(int)]


def _depend_by_scale(lengths: np.ndarray, split: ColumnSplit) -> np.ndarray:
    """Return a mask (p - b,) of the dropped columns that depend on the kept ones as under a common factor on all
    lengths.

    Args:
        lengths: (p,) values of the candidate columns that are lengths [m]; zero for others.
        split: the split of the candidate columns into b base columns and dropped ones.
    """
    base_lengths = lengths[split.kept]
    lengths_kept = base_lengths != 0.0
    result = np.zeros(len(split.dropped), dtype=bool)
    if lengths_kept.sum() < 2:
        return result
    for number, column in enumerate(split.dropped):
        if lengths[column] == 0.0:
            continue
        expected = -base_lengths[lengths_kept] / lengths[column]
        difference = split.coefficients[lengths_kept, number] - expected
        result[number] = np.linalg.norm(difference) < SCALE_DEVIATION * np.linalg.norm(expected)
    return result


def _making(
    cell: Installation,
    blocks: list[Block],
    free: np.ndarray,
    prior: np.ndarray,
    has_stated_prior: np.ndarray,
    settings: Settings,
) -> tuple[Installation, np.ndarray]:
    """Return a first fit and the prior (f,) with the most probable widths of making, from a sample of many poses.

    Args:
        cell: the nominal installation.
        blocks: measurements prepared for it.
        free: (f,) positions in the parameter vector.
        prior: (f,) standard deviations to begin with; infinite for none.
        has_stated_prior: (f,) mask of the parameters whose prior was stated and stays.
        settings: see `Settings`.
    """
    sample = _sample(cell, blocks, _sampled_rows(blocks, len(free)))
    family = _making_families(cell, free, has_stated_prior)
    nominal = parameter_values(cell)[free]
    widest = plausible_deviation(cell, free)
    typical = plausible_deviation(cell, free, TYPICAL)
    state = cell
    for update in range(WIDTH_UPDATES):
        trial = fit_with_prior(state, sample, free, prior, settings=settings, nominal=cell, warm=update > 0)
        state = trial.cell
        deviation = parameter_values(state)[free] - nominal
        deviation = np.where(np.isfinite(prior), deviation, 0.0)
        about_nominal = trial.data().moved(deviation).gram()
        data = about_nominal.scaled(trial.estimate.residual_std**-2.0)
        prior = _most_probable_widths(data, family, prior, widest, typical)
    return state, prior


def _sampled_rows(blocks: list[Block], parameters: int) -> list[np.ndarray]:
    """Return random rows of each block, `WARM_POSES` or four per parameter; all where there are not as many."""
    return sampled([block.measured for block in blocks], max(WARM_POSES, 4 * parameters))


def _sample(cell: Installation, blocks: list[Block], block_rows: list[np.ndarray]) -> list[Block]:
    return [rows_of(cell, block, rows) for block, rows in zip(blocks, block_rows)]


def _most_probable_widths(
    data: Gram, family: np.ndarray, prior: np.ndarray, widest: np.ndarray, typical: np.ndarray
) -> np.ndarray:
    """Return the prior (f,) with the most probable width of each family, by MacKay's fixed point (1992).

    w² = (Σ x² + w_0²) / (Σ γ + 1), with γ = 1 - σ² / w² the share that the data determine of a parameter: `typical`
    counts as one more parameter of the family, and decides where the data do not determine w (our choice).

    Args:
        data: whitened statistics (f, f) of the rows, parameters counted from nominal.
        family: (f,) family of each parameter; -1 for a width that stays.
        prior: (f,) widths to begin with; infinite for none.
        widest: (f,) upper bounds of the widths.
        typical: (f,) widths w_0 of a typical arm.
    """
    width = prior.copy()
    scale = 1.0 / np.sqrt(np.maximum(np.diag(data.square), 1e-300))
    scales = np.outer(scale, scale)
    for _ in range(WIDTH_ROUNDS):
        system = (data.square + np.diag(width**-2.0)) * scales
        np.fill_diagonal(system, np.diag(system) + ROUNDING)
        inverse = np.linalg.inv(system) * scales
        change = inverse @ data.cross
        variance = np.diag(inverse)
        for number in range(int(family.max(initial=-1)) + 1):
            members = np.flatnonzero(family == number)
            first = members[0]
            determined = float(np.sum(1.0 - variance[members] / width[members] ** 2))
            squares = float(change[members] @ change[members]) + typical[first] ** 2
            most_probable = np.sqrt(squares / (max(determined, 0.0) + 1.0))
            width[members] = min(most_probable, widest[first])
    return width


def _making_families(cell: Installation, free: np.ndarray, has_stated_prior: np.ndarray) -> np.ndarray:
    """Return each parameter's family (f,): joint offsets, other angles, lengths; -1 for no width of making."""
    kinds = np.where(has_stated_prior, "", families(cell)[free])
    family = np.full(len(free), -1)
    number = 0
    for kind in ("offset", "rad", "m"):
        if kind in kinds:
            family[kinds == kind] = number
            number += 1
    return family


def fit_with_prior(
    cell: Installation,
    blocks: list[Block],
    free: np.ndarray,
    prior: np.ndarray | None = None,
    *,
    settings: Settings | None = None,
    nominal: Installation | None = None,
    warm: bool = False,
) -> GeometricFit:
    """Return the fit of exactly the parameters `free`: min Σ ‖(y - f(x)) / σ‖² + Σ ((x - x_nominal) / σ_prior)².

    Sigmas that no file states are estimated, one per file and kind of residual (position, orientation …), and the fit
    is repeated until sigmas and robust weights settle. With thousands of poses the fit starts from that of a sample.

    Args:
        cell: installation to start from.
        blocks: measurements prepared for this installation.
        free: (f,) positions in the parameter vector.
        prior: (f,) standard deviations; infinite for none.
        settings: see `Settings`.
        nominal: mean of the prior; None for `cell`.
        warm: whether `cell` is fitted already, so that its residuals give the first sigmas.
    """
    settings = settings or Settings()
    state = cell
    rows = _sampled_rows(blocks, len(free))
    poses = sum(len(block.measured) for block in blocks)
    sampled_first = 4 * sum(map(len, rows)) <= poses
    if sampled_first:
        sample = _sample(cell, blocks, rows)
        state = fit_with_prior(cell, sample, free, prior, settings=settings, nominal=nominal, warm=warm).cell
    weigher = Weigher(settings, nominal or cell, blocks, free, prior)
    weigher.update(state, first=not (sampled_first or warm))
    passes = settings.passes
    if any(weigher.noises) and passes > 1:
        passes = IMAGE_PASSES
    solution = None
    for _ in range(passes):
        solution = solve(
            weigher.linearise,
            lambda state, change: step(state, free, change),
            state,
            damping=settings.damping,
            limit=settings.limit,
        )
        state = solution.state
        settled = weigher.settle(solution)
        if settled is not None:
            return weigher.result(settled)
    assert solution is not None
    return weigher.unsettled_result(solution)


def plausible_deviation(
    cell: Installation, columns: np.ndarray, deviations: Mapping[str, float] = PLAUSIBLE
) -> np.ndarray:
    """Return the plausible manufacturing deviation (c,) of each parameter; infinite for frames and deflections.

    Args:
        cell: the installation.
        columns: (c,) positions in the parameter vector.
        deviations: deviation of an arm's parameter, by unit: `PLAUSIBLE`, or `TYPICAL` of a usual arm.
    """
    table = layout(cell)
    result = np.full(len(columns), np.inf)
    for number, parameter in enumerate(columns):
        if table.kinds[parameter] == "arm":
            result[number] = deviations[table.units[parameter]]
    return result


def polish_frames(
    cell: Installation, measured: Sequence[PoseMeasurements], settings: Settings | None = None
) -> GeometricFit:
    """Return the fit of station and tool placements only; the arm stays as it is."""
    return fit(cell, measured, layout(cell).frame_index, settings=settings)


def placed_on(cell: Installation, block: PoseMeasurements, settings: Settings) -> GeometricFit:
    """Return the arm with base and tool placement fitted to one block, arm and deflections unchanged.

    If that fit does not converge because the block hardly identifies some direction (the rotation about a straight line
    of poses), directions with columns below `MIN_COLUMN` are kept. The solution's status states whether it converged.
    """
    start = install(cell.chain, [block], cell.known)
    start = replace(start, deflection=cell.deflection, optics=start.optics.like(cell.optics))
    placed = polish_frames(start, [block], replace(settings, limit=CRAWLS))
    if placed.solution.status.good:
        return placed
    return polish_frames(placed.cell, [block], replace(settings, tolerance=MIN_COLUMN))


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
