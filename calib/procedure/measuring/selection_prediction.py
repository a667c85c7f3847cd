"""What a selection of poses predicts of the fit: σ of its parameters, kept next to the poses, for a later comparison.

``calib select --out poses.csv`` leaves ``poses_prediction.json``; ``calib fit --selection poses.csv`` reads it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from calib import files
from calib.errors import Finding, UsageError, finding, require
from calib.geometry.parameters import layout
from calib.geometry.result import GeometricFit
from calib.records import read_json

SUFFIX = "_prediction.json"


@dataclass(frozen=True)
class SelectionPrediction:
    """What a selection predicts.

    Attributes:
        joints: (n,) of the robot, by name.
        poses: how many were chosen.
        names, units, sigmas: (p,) of the parameters [m, rad].
    """

    joints: tuple[str, ...]
    poses: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    sigmas: tuple[float, ...]

    def check_robot(self, joints: Sequence[str]) -> None:
        """Refuse, before any work is done, the selection of another robot."""
        if self.joints != tuple(joints):
            ours, theirs = ", ".join(joints), ", ".join(self.joints)
            raise UsageError(f"the selection is one of another robot: its joints are {theirs}, here they are {ours}")


def beside(poses: Path) -> Path:
    """Return where the prediction of a CSV of chosen poses lies."""
    return poses.parent / (poses.stem + SUFFIX)


def write(prediction: SelectionPrediction, poses: Path) -> Path:
    """Write what a selection predicts next to its CSV."""
    return files.write_json(beside(poses), asdict(prediction))


def read(selection: Path) -> SelectionPrediction:
    """Read what a selection predicts.

    Args:
        selection: the CSV that `calib select` wrote, or a folder with the prediction of one (``2-poses`` of a session).

    Raises:
        UsageError: where there is none, or several, or it cannot be read.
    """
    path = selection
    if not selection.is_dir():
        path = beside(selection)
    else:
        found = sorted(selection.glob(f"*{SUFFIX}"))
        require(len(found) <= 1, f"{selection} holds {len(found)} predictions: name one CSV of poses", UsageError)
        path = found[0] if found else selection / f"*{SUFFIX}"
    words = f"there is no {path}: give the CSV that calib select wrote, its prediction next to it, or their folder"
    require(path.is_file(), words, UsageError)
    return read_json(path, "choose the poses again", SelectionPrediction)


def compared_with_fit(prediction: SelectionPrediction, fit: GeometricFit) -> Finding | None:
    """Return how the σ that a fit estimates compare with those predicted when its poses were chosen."""
    names = layout(fit.cell).names
    estimated = {names[k]: float(sigma) for k, sigma in zip(fit.free, fit.estimate.sigma)}
    return sigma_ratio(dict(zip(prediction.names, prediction.sigmas)), estimated)


def sigma_ratio(
    predicted: Mapping[str, float],
    estimated: Mapping[str, float],
    residual: float | None = None,
    assumed: float | None = None,
) -> Finding | None:
    """Return estimated over predicted σ of parameters, by name; None where they have no name in common.

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
