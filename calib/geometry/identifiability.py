"""Identifiable geometric parameters of a set of poses, and findings on the others.

Rank, parameters that merge with others or stay at their nominal, placements that are hardly determined.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from calib.errors import Finding, finding
from calib.estimation.base_columns import ColumnSplit, split_columns
from calib.geometry.installation import Installation
from calib.geometry.observation import Block, observe
from calib.geometry.parameters import layout
from calib.geometry.result import GeometricFit
from calib.robot.kinematics import forward

PLACES = {"station": "the placement of the instrument", "tool": "the mounting of the tool"}


def unidentified(found: GeometricFit) -> list[Finding]:
    """Return findings on what a fit's poses do not identify: rank, parameters, placements."""
    if (split := found.split) is None:
        return _loose(found)
    values, rank = split.singular_values, split.rank
    below = float(values[rank]) if rank < len(values) else None
    known = {"rank": rank, "parameters": len(values), "tolerance": split.tolerance}
    first = finding("rank", last=values[rank - 1], next=below, **known)
    return [first, *_merged(found, split), *_at_nominal(found, split), *_loose(found)]


def _merged(found: GeometricFit, split: ColumnSplit, max_named: int = 4) -> list[Finding]:
    """Return findings on arm parameters that depend linearly on others, grouped by these others.

    `max_named`: parameters by which families of merged ones are distinguished.
    """
    table = layout(found.start)
    families: dict[object, tuple[list[str], list[str]]] = {}
    for column, dropped in enumerate(split.dropped):
        if table.group(int(found.candidates[dropped])) != "arm":
            continue
        key, into = None, list[str]()
        if dropped not in split.without_effect:
            weight = np.abs(split.coefficients[:, column])
            partners = found.candidates[split.kept[weight > 0.1 * weight.max()]]
            groups = {table.group(int(k)) for k in partners}
            arm = tuple(table.names[k] for k in partners if table.group(int(k)) == "arm")
            key = "station" in groups, "tool" in groups, arm[:max_named], len(arm)
            into = [*(PLACES[group] for group in PLACES if group in groups), *arm]
        families.setdefault(key, (into, []))[1].append(table.names[found.candidates[dropped]])
    return [
        finding("merged", names=names, into=into) if into else finding("no-effect", names=names)
        for into, names in families.values()
    ]


def _at_nominal(found: GeometricFit, split: ColumnSplit) -> list[Finding]:
    """Return a finding on independent arm parameters that the data identify no better than the prior."""
    table = layout(found.start)
    if found.prior is not None:
        sigma = found.estimate.sigma
        loose = np.isfinite(found.prior) & (sigma > 0.7 * found.prior) & (found.free < table.arm)
        names, code = [table.names[k] for k in found.free[loose]], "near-prior"
    else:
        lost = np.setdiff1d(found.candidates[split.kept], found.free)
        names, code = [table.names[k] for k in lost if k < table.arm], "left-nominal"
    return [finding(code, names=names)] if names else []


def _loose(found: GeometricFit, max_placement_sigma: float = 2e-3) -> list[Finding]:
    """Return findings on tools with a poorly determined placement, and the station correlated with each.

    `max_placement_sigma`: [m] a placement known no better than this is worth a word (our choice).
    """
    estimate = found.estimate
    index = {name: k for k, name in enumerate(estimate.names)}
    result: list[Finding] = []
    min_orientation_range = 45.0  # [deg] below it "the wrist is held still" is the likely reason (our choice)
    for tool in found.cell.tool_names:
        own = [index[f"{tool}.{axis}"] for axis in "xyz" if f"{tool}.{axis}" in index]
        sigma = float(np.linalg.norm(estimate.sigma[own]))
        if own and sigma >= max_placement_sigma:
            spread = _orientation_range(found)
            still = spread if spread is not None and spread < min_orientation_range else None
            station = _confused(found, own, index)
            result.append(finding("loose-tool", tool=tool, sigma=sigma, station=station, still=still))
    return result


def _confused(found: GeometricFit, own: list[int], index: dict[str, int]) -> str:
    """Return the station whose estimate is correlated with the tool's (canonical correlation above 0.95); else ''."""
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
    """Return the 95 % range of the flange's orientation over an instrument's poses [deg]; None without poses."""
    q = [block.measured.q for block in found.blocks if block.measured.has_instrument]
    if not q:
        return None
    turns = Rotation.from_matrix(forward(found.cell.chain, np.concatenate(q))[:, :3, :3])
    return 2.0 * float(np.degrees(np.quantile((turns.mean().inv() * turns).magnitude(), 0.95)))


def observation_matrix(cell: Installation, blocks: Sequence[Block], columns: np.ndarray) -> np.ndarray:
    """Return W (rows, c) of all blocks, scaled by stated sigmas; else radians are scaled by the reach.

    The reach (rms distance of targets from the arm's base) makes orientation rows comparable with position rows.
    """
    rows = []
    for block in blocks:
        for part in observe(cell, block, columns):
            scale = part.sigma
            if part.label == "pixel":
                scale = np.asarray(part.per_length)
            elif scale is None:
                scale = np.full(part.value.shape, 1.0 / _reach(cell) if part.label == "orientation" else 1.0)
            elif part.label != "orientation":
                scale = scale / np.median(scale)
            else:
                scale = scale / np.median(scale) / _reach(cell)
            rows.append(part.whitened(scale)[1])
    return np.concatenate(rows)


def _reach(cell: Installation) -> float:
    """Return a typical length of the arm [m]: the sum of its constant offsets."""
    total = sum(abs(e.value) for e in cell.chain.elements if e.axis[0] == "t")
    total += sum(float(np.linalg.norm(e.placement[:3, 3])) for e in cell.chain.elements if e.placement is not None)
    return max(total, 0.1)


def _preference(cell: Installation, columns: np.ndarray) -> list[np.ndarray]:
    """Return groups of columns in order of preference: frames, joint offsets, rotations, translations, deflections.

    Frames come first, so that what cannot be distinguished from the installation (the first joint's placement, the last
    joint's offset) stays with the installation and the arm keeps its nominal there. Rotations before translations make
    Hayati's β win over an offset along parallel axes.
    """
    table = layout(cell)
    moving = {e.name for e in cell.chain.elements if e.joint is not None}
    kinds: list[list[int]] = [[], [], [], [], []]
    for place, column in enumerate(columns):
        group = table.group(int(column))
        if group in ("station", "tool", "optics"):
            kinds[0].append(place)
        elif group == "deflection":
            kinds[4].append(place)
        elif table.names[column] in moving:
            kinds[1].append(place)
        else:
            kinds[2 if table.units[column] == "rad" else 3].append(place)
    return [np.array(kind, dtype=int) for kind in kinds]


def base_columns(
    cell: Installation, blocks: Sequence[Block], columns: np.ndarray, tolerance: float = 1e-5
) -> ColumnSplit:
    """Split candidate parameters into identifiable ones and those that depend on them; indices into `columns`."""
    return split_columns(observation_matrix(cell, blocks, columns), _preference(cell, columns), tolerance)
