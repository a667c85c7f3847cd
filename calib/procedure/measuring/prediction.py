"""Accuracy predicted for a set of poses before the measurement: σ of parameters and of the tool's position.

With W the whitened observation Jacobian of the poses, C = (WᵀW)⁻¹ is the covariance of the fitted parameters, provided
that the assumed noise is right and the fitted parameters are those for which the poses were selected. A tool position
with Jacobian J then has the variance tr(J C Jᵀ). Additional parameters in the fitted model and unmodelled errors
increase the actual error.

``calib select --out poses.csv`` writes ``poses_prediction.json``; ``calib fit --selection poses.csv`` reads it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from calib import files
from calib.errors import Finding, UsageError, finding
from calib.geometry.observability import Observation
from calib.geometry.observation import layout
from calib.geometry.weighing import GeometricFit
from calib.poses.design import Pool
from calib.poses.errors import NotIdentifiable, TooFewCandidates
from calib.poses.exchange import greedy
from calib.poses.scaled_jacobians import prepared
from calib.records import Array, read_json

SUFFIX = "_prediction.json"
# numbers of poses for which the accuracy is predicted besides
COUNTS = (10, 20, 40, 80)
# quantile over typical poses that is stated as the worst
WORST = 0.95
# ratio of singular values from which on parameters count as not identifiable
MIN_SINGULAR = 1e-9
# column norm below which no column is scaled
TINY = 1e-300
# (unit, name of the parameters, unit in messages)
QUANTITIES = (("m", "lengths", "mm"), ("rad", "angles", "mrad"))


@dataclass(frozen=True, eq=False)
class SelectionPrediction:
    """The prediction stored with a selection of poses: robot, number of poses, and σ of the parameters.

    Attributes:
        joints: (n,) names of the robot's joints.
        poses: number of selected poses.
        names, units, sigmas: (p,) names, units (m or rad) and predicted σ of the parameters.
    """

    joints: tuple[str, ...]
    poses: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    sigmas: Array

    def check_robot(self, joints: Sequence[str]) -> None:
        """Raise a UsageError if the selection was made for a robot with other joint names."""
        if self.joints != tuple(joints):
            selection_joints = ", ".join(self.joints)
            raise UsageError(
                f"the selection belongs to another robot: its joints are {selection_joints}; "
                f"this robot has {', '.join(joints)}: choose poses for it"
            )


@dataclass(frozen=True, eq=False)
class Prediction(SelectionPrediction):
    """Predicted accuracy of a fit: σ of the parameters, and σ of the tool's position at s typical poses.

    Attributes:
        points: (s, 3) positions of the tool [m].
        spread: (s,) σ of the tool's position [m]; infinite if a parameter is not identifiable.
    """

    points: np.ndarray
    spread: np.ndarray

    @property
    def rms(self) -> float:
        """rms over typical poses of the σ of the tool's position [m]; infinite if a parameter is not identifiable."""
        return float(np.sqrt(np.mean(self.spread**2)))

    @property
    def worst(self) -> float:
        """95 % quantile over typical poses of the σ of the tool's position [m].

        Infinite if a parameter is not identifiable.
        """
        if not np.isfinite(self.spread).all():
            return float("inf")
        return float(np.quantile(self.spread, WORST))


def predicted(
    observation: Observation, jacobians: np.ndarray, typical: np.ndarray, poses: int | None = None
) -> Prediction:
    """Return the predicted accuracy of a fit: σ of the parameters, and σ of the tool's position at typical poses.

    Args:
        observation: observation Jacobian with which the Jacobians were computed.
        jacobians: (m, rows, p) Jacobians, divided by the measurement noise, of all poses to be fitted, including those
            measured earlier.
        typical: (s, n) joint values at which the tool's accuracy is predicted [rad or m].
        poses: number of poses stated in the result; None: m.
    """
    rows = jacobians.reshape(-1, jacobians.shape[2])
    scale = np.maximum(np.linalg.norm(rows, axis=0), TINY)
    _, singular, vt = np.linalg.svd(rows / scale, full_matrices=False)
    parameter_count = rows.shape[1]
    points, position_jacobians = observation.position(typical)
    if len(singular) == parameter_count and singular[-1] > MIN_SINGULAR * singular[0]:
        # a root of the covariance
        root = (vt.T / singular) / scale[:, None]
        spread = np.sqrt(((position_jacobians @ root) ** 2).sum((1, 2)))
    else:
        root = np.full((parameter_count, 1), np.inf)
        spread = np.full(len(typical), np.inf)
    parameters = layout(observation.cell)
    names = tuple(parameters.names[k] for k in observation.free)
    units = tuple(parameters.units[k] for k in observation.free)
    return Prediction(
        joints=observation.cell.chain.joint_names,
        poses=len(jacobians) if poses is None else poses,
        names=names,
        units=units,
        sigmas=np.linalg.norm(root, axis=1),
        points=points,
        spread=spread,
    )


def by_count(
    observation: Observation, candidates: np.ndarray, typical: np.ndarray, before: np.ndarray | None = None
) -> tuple[Prediction, ...]:
    """Return the predicted accuracy for each number of poses in `COUNTS`, with poses chosen greedily.

    Numbers above the number N of candidates, and numbers that do not identify all parameters, are left out; the result
    may be empty.

    Args:
        observation: observation Jacobian with which the Jacobians were computed.
        candidates: (N, rows, p) Jacobians of the candidate poses, divided by the measurement noise.
        typical: (s, n) joint values at which the tool's accuracy is predicted [rad or m].
        before: (k, rows, p) Jacobians of poses measured earlier; None: no earlier poses.
    """
    counts = [count for count in COUNTS if count <= len(candidates)]
    if not counts:
        return ()
    try:
        information = prepared(candidates, counts[-1], before)
    except (NotIdentifiable, TooFewCandidates):
        return ()
    if before is None:
        before = np.zeros((0, *candidates.shape[1:]))
    order = list(greedy(Pool(information.z, information.known), counts[-1]).members)
    predictions = []
    for count in counts:
        jacobians = np.concatenate([candidates[order[:count]], before])
        prediction = predicted(observation, jacobians, typical, count)
        if np.isfinite(prediction.rms):
            predictions.append(prediction)
    return tuple(predictions)


def table(prediction: Prediction, by_pose_count: tuple[Prediction, ...]) -> list[tuple[str, str]]:
    """Return table rows (label, text) on the predicted σ of the tool's position and of the parameters.

    Args:
        prediction: prediction for the selected poses.
        by_pose_count: predictions for other numbers of poses, of which the σ of the tool's position is listed.
    """
    label = "predicted σ of the tool's position"
    if not np.isfinite(prediction.rms):
        return [(label, "not available: these poses do not identify all parameters")]
    rows = [(label, f"{1e3 * prediction.rms:.3g} mm rms, {1e3 * prediction.worst:.3g} mm at 95 %, by noise alone")]
    sigmas = []
    for unit, quantity, printed_unit in QUANTITIES:
        indices = [k for k, parameter_unit in enumerate(prediction.units) if parameter_unit == unit]
        if not indices:
            continue
        largest = indices[int(np.argmax(prediction.sigmas[indices]))]
        median_sigma = 1e3 * np.median(prediction.sigmas[indices])
        largest_sigma = 1e3 * prediction.sigmas[largest]
        name = prediction.names[largest]
        sigmas.append(f"{quantity} {median_sigma:.2g}, at most {largest_sigma:.2g} {printed_unit} ({name})")
    rows.append(("predicted σ of parameters, median", "; ".join(sigmas)))
    if by_pose_count:
        counts = " / ".join(f"{prediction.poses}" for prediction in by_pose_count)
        values = " / ".join(f"{1e3 * prediction.rms:.3g}" for prediction in by_pose_count)
        rows.append((f"σ of the tool with {counts} poses", f"{values} mm rms"))
    return rows


def beside(poses: Path) -> Path:
    """Return the path of the file with the prediction for `poses`, the CSV of selected poses."""
    return poses.parent / (poses.stem + SUFFIX)


def write(prediction: SelectionPrediction, poses: Path) -> Path:
    """Write the prediction for a selection next to the CSV of poses, and return the path of the written file."""
    content = {field.name: getattr(prediction, field.name) for field in fields(SelectionPrediction)}
    return files.write_json(beside(poses), content)


def read(selection: Path) -> SelectionPrediction:
    """Read the prediction for a selection.

    Args:
        selection: the CSV that `calib select` wrote, or a folder with one prediction (``2-poses`` of a session).

    Raises:
        UsageError: if no prediction or more than one is found, or if the file cannot be read.
    """
    if selection.is_dir():
        predictions = sorted(selection.glob(f"*{SUFFIX}"))
        if len(predictions) > 1:
            raise UsageError(f"{selection} contains {len(predictions)} predictions: name one CSV of poses")
        path = predictions[0] if predictions else selection / f"*{SUFFIX}"
    else:
        path = beside(selection)
    if not path.is_file():
        raise UsageError(f"{path} not found; give the CSV written by `calib select`, or its folder")
    return read_json(path, "choose the poses again", SelectionPrediction)


def compared_with_fit(prediction: SelectionPrediction, fit: GeometricFit) -> Finding | None:
    """Return a finding on the ratio of the fit's σ to the σ predicted at pose selection, over common parameters.

    None: the fit and the prediction have no parameter names in common.
    """
    names = layout(fit.cell).names
    estimated = {names[k]: float(sigma) for k, sigma in zip(fit.base, fit.base_sigma())}
    predicted = dict(zip(prediction.names, prediction.sigmas))
    return sigma_ratio(predicted, estimated)


def sigma_ratio(
    predicted: Mapping[str, float],
    estimated: Mapping[str, float],
    residual: float | None = None,
    assumed: float | None = None,
) -> Finding | None:
    """Return a finding on the ratios of estimated to predicted σ; None without common parameter names.

    Args:
        predicted, estimated: parameter name -> σ.
        residual, assumed: measured and assumed torque error as shares of the torque limits; None: unknown.
    """
    common = [name for name in predicted if estimated.get(name, 0.0) > 0.0 and predicted[name] > 0.0]
    if not common:
        return None
    ratios = [estimated[name] / predicted[name] for name in common]
    low, median, high = np.quantile(ratios, [0.1, 0.5, 0.9])
    return finding(
        "sigma-ratio", count=len(common), median=median, low=low, high=high, residual=residual, assumed=assumed
    )
