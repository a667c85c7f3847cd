"""What a selection of poses predicts of the fit: kept beside the poses, and held against what the fit then states.

``calib select --out poses.csv`` leaves ``poses_prediction.json``: sigmas of the parameters, and of the tool's position
at typical poses all over the workspace, for measurements as noisy as was said. ``calib fit --selection poses.csv``
reads it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from calib import files
from calib.errors import UsageError
from calib.geometry.parameters import layout
from calib.geometry.result import GeometricFit
from calib.geometry.uncertainty.spread import pose_sigmas
from calib.procedure.sigma_comparison import SigmaComparison, compare_sigmas
from calib.records import read_json
from calib.units import SMALL

SUFFIX = "_prediction.json"
NOISES = {"position": "m", "orientation": "rad"}


@dataclass(frozen=True)
class SelectionPrediction:
    """What a selection predicts.

    Attributes:
        joints: (n,) of the robot, by name.
        poses: how many were chosen.
        names, units, sigmas: (p,) of the parameters [m, rad].
        typical: (s, n) poses at which the tool was looked at [rad or m]; spread: (s,) sigma of its position [m].
        noise: of one measured position [m] and orientation [rad], as was said; empty for images.
        by_images: whether a camera sees its board at the poses.
    """

    joints: tuple[str, ...]
    poses: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    sigmas: tuple[float, ...]
    typical: tuple[tuple[float, ...], ...]
    spread: tuple[float, ...]
    noise: Mapping[str, float]
    by_images: bool = False

    def check_robot(self, joints: Sequence[str]) -> None:
        """Refuse, before any work is done, the selection of another robot."""
        if self.joints != tuple(joints):
            ours, theirs = ", ".join(joints), ", ".join(self.joints)
            raise UsageError(f"the selection is one of another robot: its joints are {theirs}, here they are {ours}")


def beside(poses: Path) -> Path:
    """Return where the prediction of a CSV of chosen poses lies."""
    return poses.parent / (poses.stem + SUFFIX)


def write(prediction: SelectionPrediction, poses: Path) -> Path:
    """Write what a selection predicts beside its CSV."""
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
        if len(found) > 1:
            raise UsageError(f"{selection} holds {len(found)} predictions: name one CSV of poses")
        path = found[0] if found else selection / f"*{SUFFIX}"
    if not path.is_file():
        raise UsageError(
            f"there is no {path}: give the CSV that calib select wrote, its prediction beside it, or their folder"
        )
    return read_json(path, "choose the poses again", SelectionPrediction)


def compared_with_fit(
    prediction: SelectionPrediction, fit: GeometricFit, torque: np.ndarray | None = None
) -> tuple[SigmaComparison, ...]:
    """Return what a fit states beside what was predicted: noise, lengths, angles, and the tool's position.

    Args:
        prediction: of the selection whose poses were measured.
        fit: of their measurements, and of others perhaps.
        torque: (s, n) gravity torques at the typical poses [N m], for compliance terms.
    """
    names, covariance = layout(fit.cell).names, fit.estimate.covariance
    stated = {names[k]: float(sigma) for k, sigma in zip(fit.free, np.sqrt(np.diag(covariance)))}
    station = -1 if prediction.by_images else 0
    spread = pose_sigmas(fit.cell, np.array(prediction.typical), fit.free, covariance, torque, station)[:, 0]
    rows = [_row(f"a measured {label}, its noise", NOISES[label], {label: prediction.noise[label]}, {label: size})
            for label, size in _noise(fit).items() if label in prediction.noise]  # fmt: skip
    for words, unit in (("lengths", "m"), ("angles", "rad")):
        own = {name: s for name, s, each in zip(prediction.names, prediction.sigmas, prediction.units) if each == unit}
        rows.append(_row(f"{words} of the arm", unit, own, stated))
    rows.append(_row("tool's position, typical poses", "m", _numbered(prediction.spread), _numbered(spread), _rms))
    return tuple(row for row in rows if row is not None)


def _row(
    kind: str, unit: str, predicted: Mapping[str, float], stated: Mapping[str, float],
    typical: Callable[[np.ndarray], float] = np.median,
) -> SigmaComparison | None:  # fmt: skip
    factor, printed = SMALL[unit]
    before, after = ({name: factor * sigma for name, sigma in each.items()} for each in (predicted, stated))
    return compare_sigmas(kind, printed, before, after, typical)


def _numbered(sigmas: Sequence[float] | np.ndarray) -> dict[str, float]:
    return {f"{k}": float(sigma) for k, sigma in enumerate(sigmas)}


def _rms(sigmas: np.ndarray) -> float:
    return float(np.sqrt(np.mean(sigmas**2)))


def _noise(fit: GeometricFit) -> dict[str, float]:
    """Return the sigma that the fit takes a measurement of each nature to have, rms over its files [m or rad]."""
    found = [each for each in fit.used_sigmas() if each]
    return {label: _rms(np.array([each[label] for each in found if label in each])) for label in NOISES
            if any(label in each for each in found)}  # fmt: skip
