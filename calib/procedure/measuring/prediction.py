"""Predicted accuracy of a set of poses before the robot moves: σ of parameters and of the tool's position.

With W the whitened observation Jacobian of the poses, C = (WᵀW)⁻¹ is the covariance that the fit will state if the
measurements are as noisy as said and the model is the geometry that the poses were chosen for; a tool's position then
has the variance tr(J C Jᵀ), J its Jacobian. Effects that the fit adds, and errors that no parameter holds, add to it.

``calib select --out poses.csv`` leaves ``poses_prediction.json``; ``calib fit --selection poses.csv`` reads it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from calib import files
from calib.errors import Finding, UsageError, finding, require
from calib.geometry.observability import Observation
from calib.geometry.observation import layout
from calib.geometry.weighing import GeometricFit
from calib.poses.design import Pool
from calib.poses.errors import NotIdentifiable, TooFewCandidates
from calib.poses.exchange import greedy
from calib.poses.information import prepared
from calib.records import Array, read_json

SUFFIX = "_prediction.json"
COUNTS = (10, 20, 40, 80)
WORST = 0.95


@dataclass(frozen=True, eq=False)
class SelectionPrediction:
    """The prediction for a selection: robot, number of poses, and sigmas of the parameters.

    Attributes:
        joints: (n,) of the robot, by name.
        poses: how many were chosen.
        names, units, sigmas: (p,) of the parameters [m, rad].
    """

    joints: tuple[str, ...]
    poses: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    sigmas: Array

    def check_robot(self, joints: Sequence[str]) -> None:
        """Raise an error if the selection belongs to a robot with other joints."""
        if self.joints != tuple(joints):
            ours, theirs = ", ".join(joints), ", ".join(self.joints)
            raise UsageError(f"the selection belongs to another robot: its joints are {theirs}; this robot has {ours}")


@dataclass(frozen=True, eq=False)
class Prediction(SelectionPrediction):
    """Predicted accuracy of a fit to m poses: sigmas of the parameters, and of the tool's position.

    Attributes:
        points, spread: (s, 3), (s,) where the tool is at typical poses, and sigma of its position there [m]; infinite
            where a parameter is not identifiable.
    """

    points: np.ndarray
    spread: np.ndarray

    @property
    def rms(self) -> float:
        """Sigma of the tool's position, rms over typical poses [m]."""
        return float(np.sqrt(np.mean(self.spread**2)))

    @property
    def worst(self) -> float:
        """Sigma of the tool's position, 95 % quantile over typical poses [m]."""
        return float(np.quantile(self.spread, WORST)) if np.isfinite(self.spread).all() else float("inf")


def predicted(seen: Observation, jacobians: np.ndarray, typical: np.ndarray, poses: int | None = None) -> Prediction:
    """Return the predicted accuracy of a fit from its Jacobians (m, rows, p), at typical poses (s, n).

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
    free_names, free_units = (tuple(each[k] for k in seen.free) for each in (names, units))
    sigmas = np.linalg.norm(root, axis=1)
    return Prediction(seen.cell.chain.joint_names, count, free_names, free_units, sigmas, points, spread)


def by_count(
    seen: Observation, candidates: np.ndarray, typical: np.ndarray, before: np.ndarray | None = None
) -> tuple[Prediction, ...]:
    """Return the predicted accuracy with `COUNTS` poses each, chosen greedily among candidates (N, rows, p).

    Args:
        seen, typical: see `predicted`.
        candidates: whitened Jacobians.
        before: (k, rows, p) Jacobians of poses measured before.
    """
    past = np.zeros((0, *candidates.shape[1:])) if before is None else before
    counts = [count for count in COUNTS if count <= len(candidates)]
    if not counts:
        return ()
    try:
        ready = prepared(candidates, counts[-1], before)
    except (NotIdentifiable, TooFewCandidates):
        return ()
    order = list(greedy(Pool(ready.z, ready.known), counts[-1]).members)
    found = [predicted(seen, np.concatenate([candidates[order[:k]], past]), typical, k) for k in counts]
    return tuple(one for one in found if np.isfinite(one.rms))


def table(one: Prediction, others: tuple[Prediction, ...]) -> list[tuple[str, str]]:
    """Return the rows (label, values) of a table: sigmas of tool and parameters, also for other pose counts."""
    if not np.isfinite(one.rms):
        return [("predicted σ of the tool's position", "not available: these poses do not identify all parameters")]
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


def beside(poses: Path) -> Path:
    """Return the path of the prediction that belongs to a CSV of chosen poses."""
    return poses.parent / (poses.stem + SUFFIX)


def write(prediction: SelectionPrediction, poses: Path) -> Path:
    """Write the prediction for a selection next to its CSV, and return its path."""
    return files.write_json(
        beside(poses), {each.name: getattr(prediction, each.name) for each in fields(SelectionPrediction)}
    )


def read(selection: Path) -> SelectionPrediction:
    """Read the prediction for a selection.

    Args:
        selection: the CSV that `calib select` wrote, or a folder with the prediction of one (``2-poses`` of a session).

    Raises:
        UsageError: if no prediction, or more than one, is found, or it cannot be read.
    """
    path = selection
    if not selection.is_dir():
        path = beside(selection)
    else:
        found = sorted(selection.glob(f"*{SUFFIX}"))
        require(len(found) <= 1, f"{selection} contains {len(found)} predictions: name one CSV of poses", UsageError)
        path = found[0] if found else selection / f"*{SUFFIX}"
    words = f"{path} not found; give the CSV written by `calib select`, or its folder"
    require(path.is_file(), words, UsageError)
    return read_json(path, "choose the poses again", SelectionPrediction)


def compared_with_fit(prediction: SelectionPrediction, fit: GeometricFit) -> Finding | None:
    """Return a finding on the ratio of the fit's σ to those predicted at pose selection; None without common names."""
    names = layout(fit.cell).names
    estimated = {names[k]: float(sigma) for k, sigma in zip(fit.base, fit.base_sigma())}
    return sigma_ratio(dict(zip(prediction.names, prediction.sigmas)), estimated)


def sigma_ratio(
    predicted: Mapping[str, float],
    estimated: Mapping[str, float],
    residual: float | None = None,
    assumed: float | None = None,
) -> Finding | None:
    """Return a finding on the ratios of estimated to predicted σ of parameters; None without common names.

    Args:
        predicted, estimated: name -> σ.
        residual, assumed: of the torque, as shares of the limits, where it is known.
    """
    common = [name for name in predicted if estimated.get(name, 0.0) > 0.0 and predicted[name] > 0.0]
    if not common:
        return None
    low, median, high = np.quantile([estimated[name] / predicted[name] for name in common], [0.1, 0.5, 0.9])
    return finding(
        "sigma-ratio", count=len(common), median=median, low=low, high=high, residual=residual, assumed=assumed
    )
