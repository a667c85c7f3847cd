"""What a fit found, in words a technician understands: rows that do not fit, what the poses could not tell."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.data.poses.measurements import PoseMeasurements
from calib.geometry.accuracy import NATURE
from calib.geometry.checks.diagnosis import BelowStated, BeyondStated, Diagnosis, SetUpChange, SystematicResidual
from calib.geometry.checks.unidentified import (
    HeldByPrior,
    LeftNominal,
    LoosePlacement,
    Merged,
    NoEffect,
    Rank,
    Unidentified,
)
from calib.geometry.model_choice.ladder import GROSS, ModelSelection
from calib.geometry.observation import observe
from calib.geometry.result import GeometricFit
from calib.units import ERRORS
from calib.words import listing

FLOOR = 4e-4  # rms per metre of reach: more is not left by a rigid geometry of a sound arm (our choice)
TOO_GOOD = 2e-6  # rms [m]: less is left by no instrument (our choice)
STILL = 45.0  # [deg] orientation range below which "the wrist is held still" is the likely reason (our choice)


def remark(finding: Diagnosis | Unidentified) -> str:
    """Return a finding on a fit as a sentence."""
    match finding:
        case SetUpChange(file, first, last, worse, rest):
            return (
                f"{_named(file)}: rows {first}–{last} fit worse than the rest ({1e3 * worse:.2f} against "
                f"{1e3 * rest:.2f} mm rms) and behave like another set-up: was the instrument, the tool or the robot's "
                "mastering touched, or was it cold? Fit them apart (two files, stations 'each') or leave them out."
            )
        case SystematicResidual(file, rms, neighbours):
            return (
                f"{_named(file)}: the remaining {1e3 * rms:.3f} mm rms are mostly systematic (neighbouring poses "
                f"differ by only {1e3 * neighbours:.3f} mm): this model does not explain them all."
            )
        case BeyondStated(file, rms, stated):
            return (
                f"{_named(file)}: the residual ({1e3 * rms:.3f} mm rms) is {rms / stated:.0f} times the stated "
                f"uncertainty ({1e3 * stated:.3f} mm): no geometry of this form explains the measurements to the "
                "instrument's accuracy. The parameters' σ are scaled up accordingly, yet such errors are not random."
            )
        case BelowStated(file, rms, stated):
            return (
                f"{_named(file)}: the stated uncertainty ({1e3 * stated:.3g} mm) is {stated / rms:.0f} times the "
                f"residual ({1e3 * rms:.3g} mm rms): in another unit? The parameters' σ are too large by as much."
            )
        case Rank(rank, parameters, tolerance, last, below):
            gap = "" if below is None else f"; singular values fall from {last:.1e} to {below:.1e} there"
            return f"{rank} of {parameters} parameters can be told apart (tolerance {tolerance:.0e}{gap})."
        case NoEffect(names):
            return f"No effect on what was measured: {listing(names)}."
        case Merged(names, station, tool, arm):
            places = ["the placement of the instrument"] if station else []
            places += ["the mounting of the tool"] if tool else []
            places += [listing(arm, 4)] if arm else []
            return f"Merged into {' and '.join(places)}, and left at nominal: {listing(names)}."
        case HeldByPrior(names):
            return f"Drawn to nominal, since the measurements hardly tell them: {listing(names)}."
        case LeftNominal(names):
            return (
                "The poses tell these worse than a robot's maker does (±10 mm, ±50 mrad), so they stay at nominal: "
                f"{listing(names)}. Poses that move the joints concerned further, or a target further off the last "
                "axis, would tell them."
            )
        case LoosePlacement():
            return _loose(finding)


def _loose(finding: LoosePlacement) -> str:
    text = f"The position of '{finding.tool}' is known only to ±{1e3 * finding.sigma:.1f} mm"
    if finding.station:
        text += f": the tool cannot be told from the base (the placement of '{finding.station}' trades with it)"
    spread = finding.orientations
    if spread is not None and spread < STILL:
        range_ = "less than 1°" if spread < 1.0 else f"{spread:.0f}°"
        text += f", because all poses hold the wrist nearly still (orientations within {range_} of each other)"
    return text + ". Predictions inside the measured region stand; the tool's own numbers do not."


def _named(file: str) -> str:
    return Path(file).name or "measurements"


@dataclass(frozen=True)
class Outlier:
    """A row that does not fit: how large its residual is [m or rad], and in robust standard deviations of all rows."""

    file: str
    row: int
    nature: str
    sigmas: float
    size: float

    @property
    def words(self) -> str:
        factor, unit = ERRORS[self.nature]
        return f"{Path(self.file).name} row {self.row} ({factor * self.size:.3g} {unit}, {self.sigmas:.1f} sigma)"


def named_outliers(found: GeometricFit) -> list[Outlier]:
    """Return rows of the fit beyond four robust sigmas, worst first; several targets of one row count once."""
    sizes: dict[tuple[str, int, str], float] = {}
    for block in found.blocks:
        for each in observe(found.cell, block, np.array([], dtype=int)):
            part = each.per_row()
            for row, size in zip(_file_rows(block.measured)[part.index], part.sizes()):
                key = block.measured.file, int(row), part.label
                sizes[key] = max(float(size), sizes.get(key, 0.0))
    result: dict[tuple[str, int, str], Outlier] = {}
    for file, row, label, sigmas in found.outliers():
        result.setdefault((file, row, label), Outlier(file, row, NATURE[label], sigmas, sizes[file, row, label]))
    return list(result.values())


def plateau(found: ModelSelection, reach: float) -> str:
    """Say that no rigid geometry explains the measurements, where the full one leaves more than `FLOOR` of the reach.

    On rows left out, and on those fitted, degrees of freedom counted: few poses predict each other badly under any
    model, which says nothing against this one.

    Args:
        found: the selection of models, judged on rows left out.
        reach: of the arm [m].

    Returns:
        The sentence, or an empty string.
    """
    rigid = [rung for rung in found.rungs if rung.model in ("frames", "offsets", "geometry")]
    if not rigid or rigid[-1].model != "geometry":
        return ""
    best = min(rigid, key=lambda rung: rung.cross_validated)
    if min(best.cross_validated, _left(found.rigid)) <= FLOOR * reach:
        return ""
    return (
        f"no rigid geometry explains these measurements: on rows left out {1e3 * best.cross_validated:.2f} mm rms "
        f"remain with the best one ({best.model}, {best.parameters} parameters), where a sound arm of {reach:.1f} m "
        f"reach leaves less than {1e3 * FLOOR * reach:.2f} mm"
    )


def gross_rows(found: ModelSelection, robust: ModelSelection, reach: float) -> str:
    """Say that rows grossly off, and no arm, leave what `plateau` complains of; empty where they do not.

    Args:
        found: the selection of models with a loss that heeds every row.
        robust: the rigid models on the same rows with a loss that does not.
        reach: of the arm [m].
    """
    off = [row for row in named_outliers(robust.rigid) if row.sigmas > GROSS]
    if not off or plateau(robust, reach):
        return ""
    count, listed = len({(row.file, row.row) for row in off}), ", ".join(row.words for row in off[:3])
    best = min(rung.cross_validated for rung in robust.rungs)
    return (
        f"{count} row{'s are' if count > 1 else ' is'} grossly off, and the loss '{found.loss}' lets "
        f"{'them' if count > 1 else 'it'} draw the fit: {listed}{', …' if len(off) > 3 else ''}; with loss auto the "
        f"other rows are explained to {1e3 * best:.2f} mm rms"
    )


def _left(found: GeometricFit) -> float:
    """Return the rms position error of a fit on its own rows [m], as if it had not used up degrees of freedom."""
    parts = [piece.part for piece in found.pieces]
    sizes = [part.sizes() for part in parts if NATURE[part.label] == "position"]
    rows, used = sum(part.height for part in parts), len(found.free) + sum(part.nuisances for part in parts)
    if not sizes or rows <= used:
        return np.inf
    return float(np.sqrt(np.mean(np.concatenate(sizes) ** 2) * rows / (rows - used)))


def remains(found: ModelSelection, reach: float) -> bool:
    """Say whether the chosen model, joint corrections included, leaves more than `FLOOR` of the reach on rows left out.

    Where it does not, that no rigid geometry explains the measurements is a remark, and no ground to doubt the model.
    """
    kept = [rung.cross_validated for rung in found.rungs if rung.kept]
    return not kept or kept[-1] > FLOOR * reach


def _file_rows(block: PoseMeasurements) -> np.ndarray:
    return block.rows
