"""What changed between the fitted files and a validation file: a station, a target, a joint's zero, or the scale.

The fitted arm predicts the rows of the validation file. Each part of the set-up is a hypothesis: its own parameters are
fitted to these rows by least squares, and nothing else. A part is named only if the rows then agree with the fitted arm
about as well as the fitted rows do, also rows that were left out of this fit, and if the other parts explain much less.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.errors import Finding, finding
from calib.geometry.installation import FRAME_AXES, Installation
from calib.geometry.observation import layout, observe, prepare

# smallest number of rows (our choice, as all below)
MIN_ROWS = 10
# rms of the rows over that of the fitted rows: smallest as fitted, largest with the change
MIN_BEFORE = 2.0
MAX_AFTER = 2.0
# largest rms with the change, as a share of that with the next best change of another part
MAX_RIVAL = 0.7
# number of parts of the rows, each of which is left out once
FOLDS = 5
CURES = {
    "station": "refit the frames of base and tool (--refit-frames), or fix instrument and base and measure again",
    "target": "give the file's target a name of its own, or refit the frames of base and tool (--refit-frames)",
    "zero": "was the joint mastered anew, or did its encoder slip? Then this calibration is no longer that of the arm",
    "scale": "check the instrument's scale against a reference length",
}


@dataclass(frozen=True, eq=False)
class FileChange:
    """A part of the set-up with parameters of its own in a validation file.

    Attributes:
        kind: ``station``, ``target``, ``zero`` or ``scale``.
        name: name of the station, target or joint.
        columns: (m, 3, k) derivatives of the positions by the k parameters.
        estimate: (k,) their estimates.
        after: rms of the position residuals with them, of rows left out in turn [m].
    """

    kind: str
    name: str
    columns: np.ndarray
    estimate: np.ndarray
    after: float

    @property
    def text(self) -> str:
        """The change in words, with its size."""
        shift = np.einsum("mdk,k->md", self.columns, self.estimate)
        distance = 1e3 * float(np.sqrt(np.mean(np.sum(shift**2, axis=1))))
        value = float(self.estimate[0])
        texts = {
            "station": f"the station '{self.name}' {distance:.3g} mm elsewhere",
            "target": f"the target '{self.name}' mounted {distance:.3g} mm elsewhere",
            "zero": f"the zero of {self.name} changed by {1e3 * value:+.3g} mrad (or mm)",
            "scale": f"lengths {1.0 + value:.6g} times as long",
        }
        return texts[self.kind]


def changed_since_fit(cell: Installation, blocks: Sequence[PoseMeasurements], fitted: float) -> list[Finding]:
    """Return a finding on each validation file in which one changed part of the set-up explains the errors.

    Args:
        cell: the fitted arm with base and tool placement.
        blocks: rows that were not fitted.
        fitted: rms position error on the fitted rows [m].
    """
    findings = []
    for block in blocks:
        if not isinstance(block, Positions) or len(block) < MIN_ROWS:
            continue
        residual, changes = _changes(cell, block)
        before = _rms(residual)
        if before < MIN_BEFORE * fitted:
            continue
        best = min(changes, key=lambda change: change.after)
        rival = np.inf
        for change in changes:
            if change is not best:
                rival = min(rival, change.after)
        if best.after > MAX_AFTER * fitted or best.after > MAX_RIVAL * rival:
            continue
        name = Path(block.file).name or "measurements"
        values = {"before": before, "after": best.after, "change": best.text, "cure": CURES[best.kind]}
        findings.append(finding("changed-since-fit", file=name, **values))
    return findings


def _changes(cell: Installation, block: Positions) -> tuple[np.ndarray, list[FileChange]]:
    """Return the position residuals (m, 3) of a block [m], and its possible changes.

    Args:
        cell: the fitted arm with base and tool placement.
        block: rows that were not fitted.
    """
    (prepared,) = prepare(cell, [block])
    table = layout(cell)
    number = {name: index for index, name in enumerate(table.names)}
    groups: list[tuple[str, str, list[str]]] = []
    station = cell.station_names[prepared.station]
    groups.append(("station", station, [f"{station}.{axis}" for axis in FRAME_AXES]))
    for tool in np.unique(prepared.tool):
        target = cell.tool_names[tool]
        groups.append(("target", target, [f"{target}.{axis}" for axis in FRAME_AXES]))
    for joint, element in zip(cell.chain.joint_names, cell.chain.moving):
        groups.append(("zero", joint, [cell.chain.names[element]]))
    residual = np.zeros((0, 3))
    index = np.arange(len(block))
    changes = []
    for kind, name, parameters in groups:
        columns = np.array([number[parameter] for parameter in parameters])
        part = next(part for part in observe(cell, prepared, columns) if part.label == "position")
        residual = part.value.T
        index = part.index
        changes.append(_fitted(kind, name, residual, part.jacobian.transpose(2, 1, 0)))
    changes.append(_fitted("scale", station, residual, block.position[index][:, :, None]))
    return residual, changes


def _fitted(kind: str, name: str, residual: np.ndarray, columns: np.ndarray) -> FileChange:
    """Return a change with its parameters estimated, and its error on rows that are left out in turn.

    Args:
        kind, name: the changed part.
        residual: (m, 3) position residuals [m].
        columns: (m, 3, k) derivatives of the positions by its parameters.
    """
    count = columns.shape[2]
    estimate = _solved(columns, residual)
    left_out = np.array(residual)
    for fold in range(FOLDS):
        rows = np.arange(len(residual)) % FOLDS == fold
        part = _solved(columns[~rows], residual[~rows])
        left_out[rows] -= columns[rows] @ part
    return FileChange(kind, name, columns, estimate[:count], _rms(left_out))


def _solved(columns: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return the least-squares estimate (k,) of parameters with columns (m, 3, k) for residuals (m, 3)."""
    flat = columns.reshape(-1, columns.shape[2])
    return np.linalg.lstsq(flat, residual.ravel(), rcond=1e-9)[0]


def _rms(residual: np.ndarray) -> float:
    """Return the rms of the norms of residuals (m, 3)."""
    return float(np.sqrt(np.mean(np.sum(residual**2, axis=1))))
