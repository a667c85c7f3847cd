"""Fit of the geometry: Levenberg–Marquardt on the whitened residuals of all kinds of measurements together.

The prior of making of a parameter is a normal distribution about its nominal value; its width is a plausible
manufacturing deviation.
"""

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

# standard deviation of a manufactured arm's parameter from its nominal value, by unit (our choice)
PLAUSIBLE = {"m": 0.01, "rad": 0.05}
# the same for a typical arm; it enters the estimate of the widths as one more parameter (our choice)
TYPICAL = {"m": 3e-3, "rad": 5e-3}
# smallest number of measured numbers per unknown (our choice)
MIN_NUMBERS = 1.5
# number of fits with new widths of making; afterwards the widths change by less than their uncertainty
WIDTH_UPDATES = 2
# relative rounding error of WᵀW with its diagonal scaled to 1; for columns of W its square root
ROUNDING = 1e-12
# largest number of fixed-point iterations of the widths between two fits
WIDTH_ROUNDS = 30
# a parameter depends on another if its coefficient is at least this share of its largest coefficient
MERGED = 0.1
# relative deviation of a column's coefficients from those of a common scale (our choice)
SCALE_DEVIATION = 0.2
# number of poses with which a fit of many more poses begins, and from which widths are estimated (our choice)
WARM_POSES = 2000
# largest number of passes until the noise of images converges (our choice)
IMAGE_PASSES = 20
# number of linearisations after which a placement that has not converged is poorly determined (our choice)
CRAWLS = 60
# relative size of a placement's column below which a block hardly determines the direction (our choice)
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

    A prior of making is a normal distribution about the nominal value, as wide as plausible manufacturing deviations.
    The fit minimises Σ ‖(y - f(x)) / σ‖² + Σ ((x - x_nominal) / w)². No parameters of the arm are selected. Parameters
    that cannot be distinguished share the effect that the measurements determine, and undetermined parameters stay near
    nominal. There are three widths w of making: for joint offsets, for other angles and for lengths. They are chosen to
    maximise the evidence (MacKay 1992). x are the parameters, y the measured and f(x) the predicted numbers, σ their
    standard deviations. Placements of stations and tools have no prior: only their base parameters are fitted, and arm
    parameters that merely displace base or tool stay at nominal. The identifiable parameters are computed afterwards
    (`GeometricFit.split`, `GeometricFit.base_sigma`).

    Args:
        cell: installation to start from, with stations and tools placed (`calib.geometry.first_guess`).
        measured: blocks of measurements.
        candidates: (c,) indices in the parameter vector; None for all parameters.
        settings: settings of the fit; None for the defaults.
        prior: standard deviations of the whole parameter vector about its present values [m or rad], infinite where the
            prior of making applies; None for the prior of making everywhere.
        widths: True estimates the widths of making; False uses `PLAUSIBLE`.

    Raises:
        MeasurementError: there are fewer rows than identifiable parameters.
        Unidentifiable: the rows determine no parameter.
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
    """Raise MeasurementError for fewer than `MIN_NUMBERS` measured numbers per unknown, since a fit could not be
    checked.

    Args:
        cell: the installation.
        blocks: the prepared measurements.
        unknowns: number of parameters to estimate.
    """
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
    """Return the plain reference: all parameters, the widest priors of making, and equal weight for every row.

    Only the parameters and the noise are estimated, and nothing is selected, as in a short script with SciPy. Other
    results are compared with it.

    Args:
        cell: the nominal arm, with stations and tools placed.
        measured: blocks of measurements.

    Returns:
        The fit; None if there are too few rows.
    """
    try:
        return fit(cell, measured, layout(cell).rigid_index, widths=False)
    except (MeasurementError, Unidentifiable):
        return None


def _estimated(cell: Installation, split: ColumnSplit, candidates: np.ndarray) -> np.ndarray:
    """Return the parameters to estimate: arm parameters that have an effect, and base parameters of all other kinds.

    Arm parameters that only displace base or tool are excluded: the placements of base and tool represent the same
    effect.

    Args:
        cell: the installation.
        split: the candidates, split into base parameters and dependent ones.
        candidates: (c,) indices in the parameter vector.
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
    """Return the arm's longest length and the parameters that cannot be distinguished from it; empty without lengths.

    Sockets and planes are explained equally well by a smaller arm, so that the scale must be taken from the nominal
    arm: the longest length keeps its nominal value, as do the parameters that could replace it.

    Args:
        cell: the installation.
        split: the candidates, split into base parameters and dependent ones.
        candidates: (c,) indices in the parameter vector.
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
    """Return a mask (p - b,) of the dropped columns that depend on the kept ones as under a scale common to all
    lengths.

    Args:
        lengths: (p,) values of the candidate columns that are lengths [m]; zero for others.
        split: the split of the p candidate columns into b base columns and dropped ones.
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
    """Return a first fit, and the prior (f,) with the most probable widths of making, from a sample of many poses.

    Args:
        cell: the nominal installation.
        blocks: measurements prepared for it.
        free: (f,) indices in the parameter vector.
        prior: (f,) initial standard deviations of the prior [m or rad]; infinite for no prior.
        has_stated_prior: (f,) mask of the parameters whose prior was given by the user and is kept.
        settings: settings of the fit.
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
    """Return numbers of random rows of each block: `WARM_POSES` in all, or four per parameter if this is more.

    All rows are returned where there are not so many.

    Args:
        blocks: the prepared measurements.
        parameters: number of fitted parameters.
    """
    return sampled([block.measured for block in blocks], max(WARM_POSES, 4 * parameters))


def _sample(cell: Installation, blocks: list[Block], block_rows: list[np.ndarray]) -> list[Block]:
    return [rows_of(cell, block, rows) for block, rows in zip(blocks, block_rows)]


def _most_probable_widths(
    data: Gram, family: np.ndarray, prior: np.ndarray, widest: np.ndarray, typical: np.ndarray
) -> np.ndarray:
    """Return the prior (f,) with the most probable width of each family, by MacKay's fixed-point iteration (1992).

    w² = (Σ x² + w_0²) / (Σ γ + 1), with γ = 1 - σ² / w² the share of a parameter that is determined by the data. The
    width w_0 of `typical` enters as one more parameter of the family, and determines w where the data do not (our
    choice).

    Args:
        data: whitened statistics (f, f) of the rows, for the parameters' differences from nominal.
        family: (f,) family of each parameter; -1 for a width that is not changed.
        prior: (f,) initial widths; infinite for no prior.
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
    """Return each parameter's family (f,): joint offsets, other angles or lengths.

    -1 is for a parameter without width of making.

    Args:
        cell: the installation.
        free: (f,) indices in the parameter vector.
        has_stated_prior: (f,) mask of the parameters whose prior was given by the user, which have no width of making.
    """
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
    """Return the fit of exactly the parameters `free`, which minimises squared residuals and distances from nominal.

    The minimised function is Σ ‖(y - f(x)) / σ‖² + Σ ((x - x_nominal) / σ_prior)², with x the parameters, y the
    measured and f(x) the predicted numbers, σ their standard deviations.

    Sigmas that no file states are estimated, one per file and kind of residual (position, orientation …). The fit is
    repeated until sigmas and robust weights have converged. With thousands of poses the fit starts from the fit to a
    sample of the rows.

    Args:
        cell: installation to start from.
        blocks: measurements prepared for this installation.
        free: (f,) indices in the parameter vector.
        prior: (f,) standard deviations of the parameters about nominal [m or rad], infinite for no prior; None for no
            prior at all.
        settings: settings of the fit; None for the defaults.
        nominal: mean of the prior; None for `cell`.
        warm: True where `cell` is already fitted, so that the first sigmas can be estimated from its residuals.
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
    """Return the plausible manufacturing deviation (c,) of each parameter; infinite for placements and deflections.

    Args:
        cell: the installation.
        columns: (c,) indices in the parameter vector.
        deviations: deviation of an arm's parameter by unit: `PLAUSIBLE`, or `TYPICAL` for a usual arm.
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
    """Return the fit of station and tool placements only; the arm's parameters are not changed.

    Args:
        cell: the installation to start from.
        measured: blocks of measurements.
        settings: settings of the fit; None for the defaults.
    """
    return fit(cell, measured, layout(cell).frame_index, settings=settings)


def placed_on(cell: Installation, block: PoseMeasurements, settings: Settings) -> GeometricFit:
    """Return the arm with base and tool placement fitted to one block; arm and deflections are not changed.

    The block may hardly identify some direction, such as the rotation about a straight line of poses. If the fit does
    not converge for this reason, such directions (columns below `MIN_COLUMN`) are not changed. The solution's status
    records whether the fit converged.

    Args:
        cell: the installation to start from.
        block: the measurements.
        settings: settings of the fit.
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
    """Return the arm without joint corrections (for a URDF), with base and tool placement fitted again.

    Args:
        cell: the calibrated installation.
        rigid: the best geometry without corrections; the geometry in `cell` is valid only together with its
            corrections.
        blocks: the fitted measurements.
        settings: settings of the fit.

    Returns:
        The installation; None if `cell` has no corrections.
    """
    if not (cell.deflection.terms or cell.known.terms):
        return None
    bare = replace(cell, chain=rigid, deflection=Deflection(), known=Deflection())
    return polish_frames(bare, blocks, settings).cell
