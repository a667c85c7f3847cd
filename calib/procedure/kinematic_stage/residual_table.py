"""``residuals.csv``: measured minus predicted of every row, fitted and unseen."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calib import files
from calib.data.poses.measurements import PoseMeasurements
from calib.geometry.accuracy import NATURE
from calib.geometry.observation import observe, prepare
from calib.procedure.kinematic_stage.comparison import Comparison
from calib.procedure.kinematic_stage.fit import Outcome
from calib.units import ERRORS

_NONE = np.array([], dtype=int)
COMPONENTS = {
    "position": ("dx [mm]", "dy [mm]", "dz [mm]"),
    "orientation": ("drx [deg]", "dry [deg]", "drz [deg]"),
    "distance": ("ddistance [mm]",),
}


def write_residuals(outcome: Outcome, path: Path) -> Path:
    """Write measured minus predicted of every row, fitted (with its robust weight) and unseen."""
    named = {(each.file, each.row) for each in outcome.outliers}
    weights = _weights(outcome)
    rows: list[list[object]] = []
    sets = [("fit", outcome.fit)]
    sets += [
        ("held out" if u.held_out else "validation", outcome.validation[n]) for n, u in outcome.inputs.unseen.items()
    ]
    for label, comparison in sets:
        rows += _residual_rows(label, comparison, named, weights if label == "fit" else {})
    joints = outcome.inputs.chain.joints
    header = ["set", "file", "row", "station", "tool", *(f"{joint.name} [{joint.unit}]" for joint in joints)]
    header += [name for names in COMPONENTS.values() for name in names]
    return files.write_table(path, [*header, "size [mm]", "nominal size [mm]", "weight", "outlier"], rows)


def _weights(outcome: Outcome) -> dict[tuple[str, int, str], float]:
    """Return the robust weight of each fitted residual by file, row and tool; the least of its natures."""
    fit, result = outcome.climb.fit, {}
    for piece in fit.pieces:
        for i, w in zip(piece.part.index, piece.weight):
            key = _key(fit.blocks[piece.block].measured, int(i))
            result[key] = min(float(w), result.get(key, np.inf))
    return result


def _key(measured: PoseMeasurements, i: int) -> tuple[str, int, str]:
    return measured.file, int(measured.rows[i]), measured.tool_names[measured.tool[i]]


def _residual_rows(label: str, comparison: Comparison, named: set, weights: dict) -> list[list[object]]:
    nominal, cell = comparison.cells
    result = []
    pairs = zip(
        prepare(nominal, comparison.blocks, comparison.torques), prepare(cell, comparison.blocks, comparison.torques)
    )
    for before, block in pairs:
        measured, m = block.measured, len(block.measured)
        columns = {nature: np.full((len(names), m), np.nan) for nature, names in COMPONENTS.items()}
        for part in observe(cell, block, _NONE):
            nature = NATURE[part.label]
            columns[nature][: len(part.value), part.index] = ERRORS[nature][0] * part.value
        first = np.full(m, np.nan)
        for part in observe(nominal, before, _NONE):
            if NATURE[part.label] == "position" or np.isnan(first[part.index]).all():
                first[part.index] = 1e3 * np.linalg.norm(part.value, axis=0)
        sizes = _row_sizes(columns)
        for i in range(m):
            key = _key(measured, i)
            station = measured.station if measured.has_instrument else ""
            row: list[object] = [label, key[0], key[1], station, key[2], *map(float, measured.q[i])]
            row += [_number(value) for values in columns.values() for value in values[:, i]]
            row += [_number(sizes[i]), _number(first[i]), weights.get(key), int(key[:2] in named and label == "fit")]
            result.append(row)
    return result


def _row_sizes(columns: dict[str, np.ndarray]) -> np.ndarray:
    """Return the length of each row's position residual [mm], or its distance residual."""
    position, distance = columns["position"], columns["distance"]
    size = np.sqrt(np.nansum(position**2, axis=0))
    return np.where(np.isnan(position).all(axis=0), np.abs(distance[0]), size)


def _number(value: float) -> float | None:
    return None if np.isnan(value) else float(value)
