"""Predicted accuracy of a set of poses, before anything is moved: σ of parameters and of the tool's position.

With W the whitened observation Jacobian of the poses, C = (WᵀW)⁻¹ is the covariance that the fit will state if the
measurements are as noisy as said and the model is the geometry that the poses were chosen for; a tool's position then
has the variance tr(J C Jᵀ), J its Jacobian. Effects that the fit adds, and errors that no parameter holds, add to it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calib.geometry.observability import Observation
from calib.geometry.parameters import layout
from poses.design import Pool
from poses.errors import NotIdentifiable, TooFewCandidates
from poses.exchange import greedy
from poses.information import prepared

COUNTS = (10, 20, 40, 80)
WORST = 0.95


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a fit of m poses will know.

    Attributes:
        poses: m.
        points, spread: (s, 3), (s,) where the tool is at typical poses, and sigma of its position there [m]; infinite
            where a parameter is not identifiable.
        names, units, sigmas: (p,) of the parameters [m, rad].
    """

    poses: int
    points: np.ndarray
    spread: np.ndarray
    names: tuple[str, ...]
    units: tuple[str, ...]
    sigmas: np.ndarray

    @property
    def rms(self) -> float:
        """Over typical poses [m]."""
        return float(np.sqrt(np.mean(self.spread**2)))

    @property
    def worst(self) -> float:
        """What 95 % of typical poses stay below [m]."""
        return float(np.quantile(self.spread, WORST)) if np.isfinite(self.spread).all() else float("inf")


def predicted(seen: Observation, jacobians: np.ndarray, typical: np.ndarray, poses: int | None = None) -> Prediction:
    """Return what measurements with Jacobians (m, rows, p) will know of a tool at typical poses (s, n).

    Args:
        seen: the observation Jacobian they come from.
        jacobians: whitened; of all that will have been measured.
        typical: where the tool's position matters [rad or m].
        poses: the number to say; by default m.
    """
    names, units = layout(seen.cell).names, layout(seen.cell).units
    rows = jacobians.reshape(-1, jacobians.shape[2])
    scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    _, s, vt = np.linalg.svd(rows / scale, full_matrices=False)
    count = len(jacobians) if poses is None else poses
    identifiable = len(rows) >= rows.shape[1] and len(s) == rows.shape[1] and s[-1] > 1e-9 * s[0]
    root = (vt.T / s) / scale[:, None] if identifiable else np.full((rows.shape[1], 1), np.inf)
    points, slopes = seen.position(typical)
    spread = np.sqrt(((slopes @ root) ** 2).sum((1, 2))) if identifiable else np.full(len(typical), np.inf)
    return Prediction(
        count, points, spread, tuple(names[k] for k in seen.free), tuple(units[k] for k in seen.free),
        np.linalg.norm(root, axis=1),
    )  # fmt: skip


def by_count(
    seen: Observation,
    candidates: np.ndarray,
    typical: np.ndarray,
    before: np.ndarray | None = None,
    counts: ArrayLike = COUNTS,
) -> tuple[Prediction, ...]:
    """Return what other numbers of poses would know, chosen greedily among candidates (N, rows, p).

    Args:
        seen, typical: see `predicted`.
        candidates: whitened Jacobians.
        before: (k, rows, p) Jacobians of poses measured before.
        counts: numbers of poses; those beyond the candidates, or too few for the parameters, are left out.
    """
    wanted = sorted(int(k) for k in np.atleast_1d(counts) if k <= len(candidates))
    past = np.zeros((0, *candidates.shape[1:])) if before is None else before
    found = []
    for most in wanted[-1:]:
        try:
            ready = prepared(candidates, most, before)
        except (NotIdentifiable, TooFewCandidates):
            break
        order = greedy(Pool(ready.z, ready.known), most).members
        for count in wanted:
            one = predicted(seen, np.concatenate([candidates[list(order[:count])], past]), typical, count)
            found += [one] if np.isfinite(one.rms) else []
    return tuple(found)


def table(one: Prediction, others: tuple[Prediction, ...]) -> list[tuple[str, str]]:
    """Return pairs of words and numbers: what is known of the tool and of the parameters, and with more poses."""
    if not np.isfinite(one.rms):
        return [("predicted σ of the tool's position", "none: not all parameters are identifiable from these poses")]
    rows = [("predicted σ of the tool's position", f"{1e3 * one.rms:.3g} mm rms, {1e3 * one.worst:.3g} mm at 95 %")]
    worst = []
    for unit, words, shown in (("m", "lengths", "mm"), ("rad", "angles", "mrad")):
        own = [k for k, each in enumerate(one.units) if each == unit]
        if own:
            k = max(own, key=lambda i: one.sigmas[i])
            middle, most = 1e3 * np.median(one.sigmas[own]), 1e3 * one.sigmas[k]
            worst.append(f"{words} {middle:.2g}, at most {most:.2g} {shown} ({one.names[k]})")
    rows.append(("predicted σ of parameters, median", "; ".join(worst)))
    if others:
        numbers = " / ".join(f"{each.poses}" for each in others)
        sizes = " / ".join(f"{1e3 * each.rms:.3g}" for each in others)
        rows.append((f"σ of the tool with {numbers} poses", f"{sizes} mm rms"))
    return rows
