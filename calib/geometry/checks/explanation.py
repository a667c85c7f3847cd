"""What the poses could not tell, in words a technician understands."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.parameters import ParameterLayout, layout
from calib.geometry.result import GeometricFit
from calib.robot.kinematics import forward

STILL = 45.0  # [deg] orientation range below which "the wrist is held still" is the likely reason (our choice)
LOOSE = 2e-3  # [m] a placement known no better than this is worth a word (our choice)


def explain(found: GeometricFit) -> list[str]:
    """Return sentences on rank, merged parameters, parameters left at nominal and loose placements."""
    return [*_rank(found), *_merged(found), *_unidentifiable(found), *_loose(found)]


def _rank(found: GeometricFit) -> list[str]:
    split = found.split
    if split is None:
        return []
    values = split.singular_values
    text = f"{split.rank} of {len(values)} parameters can be told apart (tolerance {split.tolerance:.0e}"
    if split.rank < len(values):
        text += f"; singular values fall from {values[split.rank - 1]:.1e} to {values[split.rank]:.1e} there"
    return [text + ")."]


def _merged(found: GeometricFit) -> list[str]:
    """Name the arm parameters that are linear combinations of others, sorted by what they merge with."""
    split = found.split
    if split is None:
        return []
    table = layout(found.start)
    families: dict[str, list[str]] = {}
    for column, dropped in enumerate(split.dropped):
        if table.group(int(found.candidates[dropped])) != "arm":
            continue
        name = table.names[found.candidates[dropped]]
        if dropped in split.without_effect:
            families.setdefault("without", []).append(name)
            continue
        weight = np.abs(split.coefficients[:, column])
        partners = found.candidates[split.kept[weight > 0.1 * weight.max()]]
        families.setdefault(_kin(table, partners), []).append(name)
    lines = []
    for kin, names in families.items():
        if kin == "without":
            lines.append(f"No effect on what was measured: {_list(names)}.")
        else:
            lines.append(f"Merged into {kin}, and left at nominal: {_list(names)}.")
    return lines


def _kin(table: ParameterLayout, partners: Sequence[int] | np.ndarray) -> str:
    """Say what a dropped parameter merges with."""
    groups = {table.group(int(k)) for k in partners}
    arm = [table.names[k] for k in partners if table.group(int(k)) == "arm"]
    places = []
    if "station" in groups:
        places.append("the placement of the instrument")
    if "tool" in groups:
        places.append("the mounting of the tool")
    if arm:
        places.append(_list(arm, 4))
    return " and ".join(places)


def _unidentifiable(found: GeometricFit) -> list[str]:
    """Name arm parameters that are independent but told no better than they are known beforehand."""
    if found.split is None:
        return []
    table = layout(found.start)
    if found.prior is not None:
        sigma = found.estimate.sigma
        loose = np.isfinite(found.prior) & (sigma > 0.7 * found.prior) & (found.free < table.arm)
        names = [table.names[k] for k in found.free[loose]]
        return [f"Drawn to nominal, since the measurements hardly tell them: {_list(names)}."] if names else []
    kept = found.candidates[found.split.kept]
    left = [table.names[k] for k in np.setdiff1d(kept, found.free) if k < table.arm]
    if not left:
        return []
    return [
        "The poses tell these worse than a robot's maker does (±10 mm, ±50 mrad), so they stay at nominal: "
        f"{_list(left)}. Poses that move the joints concerned further, or a target further off the last axis, would "
        "tell them."
    ]


def _loose(found: GeometricFit) -> list[str]:
    """Say where an instrument or tool placement is hardly determined, and whether the two are confused."""
    estimate = found.estimate
    index = {name: k for k, name in enumerate(estimate.names)}
    sigma = estimate.sigma
    lines = []
    for tool in found.cell.tool_names:
        own = [index[f"{tool}.{axis}"] for axis in "xyz" if f"{tool}.{axis}" in index]
        if not own or np.linalg.norm(sigma[own]) < LOOSE:
            continue
        text = f"The position of '{tool}' is known only to ±{1e3 * float(np.linalg.norm(sigma[own])):.1f} mm"
        partner = _confused(found, own, index)
        if partner:
            text += f": the tool cannot be told from the base (the placement of '{partner}' trades with it)"
        spread = _orientation_range(found)
        if spread is not None and spread < STILL:
            range_ = "less than 1°" if spread < 1.0 else f"{spread:.0f}°"
            text += f", because all poses hold the wrist nearly still (orientations within {range_} of each other)"
        lines.append(text + ". Predictions inside the measured region stand; the tool's own numbers do not.")
    return lines


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


def _list(names: Sequence[str], most: int = 12) -> str:
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"
