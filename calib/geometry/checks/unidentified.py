"""What the poses could not tell: rank, parameters that merge or stay at nominal, placements hardly determined."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.parameters import layout
from calib.geometry.result import GeometricFit
from calib.robot.kinematics import forward

LOOSE = 2e-3  # [m] a placement known no better than this is worth a word (our choice)
NAMED = 4  # parameters by which families of merged ones are told apart


@dataclass(frozen=True)
class Rank:
    """How many parameters are identifiable at which tolerance, and the singular values on both sides of the cut."""

    rank: int
    parameters: int
    tolerance: float
    last: float
    next: float | None


@dataclass(frozen=True)
class NoEffect:
    """Arm parameters without effect on what was measured."""

    names: tuple[str, ...]


@dataclass(frozen=True)
class Merged:
    """Arm parameters that are linear combinations of the instrument's or tool's placement, or of others of the arm."""

    names: tuple[str, ...]
    station: bool
    tool: bool
    arm: tuple[str, ...]


@dataclass(frozen=True)
class HeldByPrior:
    """Arm parameters whose sigma is hardly below that of the prior."""

    names: tuple[str, ...]


@dataclass(frozen=True)
class LeftNominal:
    """Identifiable arm parameters that stay at nominal, since the poses tell them worse than a maker does."""

    names: tuple[str, ...]


@dataclass(frozen=True)
class LoosePlacement:
    """A tool whose position is known to `sigma` [m] only.

    Attributes:
        station: whose placement trades with it; empty for none.
        orientations: range of the flange's orientation over the poses [deg]; None where no instrument saw them.
    """

    tool: str
    sigma: float
    station: str
    orientations: float | None


Unidentified = Rank | NoEffect | Merged | HeldByPrior | LeftNominal | LoosePlacement


def unidentified(found: GeometricFit) -> list[Unidentified]:
    """Return what a fit's poses could not tell: its rank first, then parameters, then placements."""
    return [*_rank(found), *_merged(found), *_at_nominal(found), *_loose(found)]


def _rank(found: GeometricFit) -> list[Unidentified]:
    split = found.split
    if split is None:
        return []
    values = split.singular_values
    below = float(values[split.rank]) if split.rank < len(values) else None
    return [Rank(split.rank, len(values), split.tolerance, float(values[split.rank - 1]), below)]


def _merged(found: GeometricFit) -> list[Unidentified]:
    """Return the arm parameters that are linear combinations of others, by what they merge with."""
    split = found.split
    if split is None:
        return []
    table = layout(found.start)
    families: dict[object, list[str]] = {}
    kin: dict[object, tuple[bool, bool, tuple[str, ...]]] = {}
    for column, dropped in enumerate(split.dropped):
        if table.group(int(found.candidates[dropped])) != "arm":
            continue
        key: object = None
        if dropped not in split.without_effect:
            weight = np.abs(split.coefficients[:, column])
            partners = found.candidates[split.kept[weight > 0.1 * weight.max()]]
            groups = {table.group(int(k)) for k in partners}
            arm = tuple(table.names[k] for k in partners if table.group(int(k)) == "arm")
            key = "station" in groups, "tool" in groups, arm[:NAMED], len(arm)
            kin.setdefault(key, ("station" in groups, "tool" in groups, arm))
        families.setdefault(key, []).append(table.names[found.candidates[dropped]])
    return [
        NoEffect(tuple(names)) if key is None else Merged(tuple(names), *kin[key]) for key, names in families.items()
    ]


def _at_nominal(found: GeometricFit) -> list[Unidentified]:
    """Return arm parameters that are independent but told no better than they are known beforehand."""
    if found.split is None:
        return []
    table = layout(found.start)
    if found.prior is not None:
        sigma = found.estimate.sigma
        loose = np.isfinite(found.prior) & (sigma > 0.7 * found.prior) & (found.free < table.arm)
        held = tuple(table.names[k] for k in found.free[loose])
        return [HeldByPrior(held)] if held else []
    kept = found.candidates[found.split.kept]
    left = tuple(table.names[k] for k in np.setdiff1d(kept, found.free) if k < table.arm)
    return [LeftNominal(left)] if left else []


def _loose(found: GeometricFit) -> list[Unidentified]:
    """Return tools whose placement is hardly determined, and the station that each is confused with."""
    estimate = found.estimate
    index = {name: k for k, name in enumerate(estimate.names)}
    result: list[Unidentified] = []
    for tool in found.cell.tool_names:
        own = [index[f"{tool}.{axis}"] for axis in "xyz" if f"{tool}.{axis}" in index]
        sigma = float(np.linalg.norm(estimate.sigma[own]))
        if own and sigma >= LOOSE:
            result.append(LoosePlacement(tool, sigma, _confused(found, own, index), _orientation_range(found)))
    return result


def _confused(found: GeometricFit, own: list[int], index: dict[str, int]) -> str:
    """Return the station whose estimate trades with the tool's (canonical correlation above 0.95); empty for none."""
    covariance = found.estimate.covariance
    for station in found.cell.station_names:
        theirs = [k for name, k in index.items() if name.rsplit(".", 1)[0] == station]
        if not theirs:
            continue
        roots = [np.linalg.cholesky(covariance[np.ix_(part, part)]) for part in (own, theirs)]
        cross = np.linalg.solve(roots[0], covariance[np.ix_(own, theirs)])
        if np.linalg.norm(np.linalg.solve(roots[1], cross.T), 2) > 0.95:
            return station
    return ""


def _orientation_range(found: GeometricFit) -> float | None:
    """Return the 95 % range of the flange's orientation over the poses an instrument saw [deg]; None without any."""
    q = [block.measured.q for block in found.blocks if block.measured.has_instrument]
    if not q:
        return None
    turns = Rotation.from_matrix(forward(found.cell.chain, np.concatenate(q))[:, :3, :3])
    return 2.0 * float(np.degrees(np.quantile((turns.mean().inv() * turns).magnitude(), 0.95)))
