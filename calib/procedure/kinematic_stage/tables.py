"""Tables of the fitted parameters and residuals: frames as placements, not as displacements from the nominal frame.

The fit moves a frame T by a step in its own axes, T · Trans(d) · Exp(w). In the table stand T's own position and
rotation vector r, so that the covariance of (d, w) goes through  position = R d,  r' = J_r⁻¹(r) w.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib import files, folders
from calib.data.poses.measurements import PoseMeasurements
from calib.errors import UsageError
from calib.geometry.accuracy import NATURE
from calib.geometry.installation import Installation
from calib.geometry.observation import observe, prepare
from calib.geometry.parameters import layout, parameter_values
from calib.geometry.result import GeometricFit
from calib.procedure.kinematic_stage.comparison import INTERVAL, Comparison, interval_cells
from calib.procedure.kinematic_stage.fit import Outcome
from calib.units import ERRORS

HEADER = ("name", "unit", "nominal", "value", "sigma", "rsd")


@dataclass(frozen=True, eq=False)
class EstimateTable:
    """Rows of ``estimate.csv``, and their covariance (rows, rows)."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    nominal: np.ndarray
    values: np.ndarray
    covariance: np.ndarray

    def rows(self) -> list[tuple[str, str, float, float, float, float | None]]:
        """Return name, unit, nominal, value, σ and RSD [%] of each row; no RSD at a value of 0."""
        sigma = np.sqrt(np.clip(np.diag(self.covariance), 0.0, None))
        numbers = zip(self.names, self.units, self.nominal, self.values, sigma)
        return [
            (name, unit, float(n), float(v), float(s), float(100.0 * s / abs(v)) if v else None)
            for name, unit, n, v, s in numbers
        ]


def estimate_table(found: GeometricFit, nominal: Installation) -> EstimateTable:
    """Return the table of fitted parameters: arm elements, placements, deflection coefficients.

    Args:
        found: the fit.
        nominal: the nominal arm with its frames fitted; whose values stand in the column ``nominal``.
    """
    table = layout(found.cell)
    full = np.zeros((len(table.names), len(found.free)))
    full[found.free, np.arange(len(found.free))] = 1.0
    values, before = parameter_values(found.cell), np.zeros(len(table.names))
    before[: table.arm] = nominal.chain.values
    optics = table.arm + table.stations + table.tools
    before[optics : optics + table.optics] = nominal.optics.values
    start = table.arm
    for after, first in zip((*found.cell.stations, *found.cell.tools), (*nominal.stations, *nominal.tools)):
        block = slice(start, start + 6)
        full[block] = _to_parent(after) @ full[block]
        values[block], before[block] = _elements(after), _elements(first)
        start += 6
    shown = np.flatnonzero(np.abs(full).max(axis=1, initial=0.0) > 1e-9)
    full = full[shown]
    covariance = full @ found.estimate.covariance @ full.T
    names, units = (tuple(part[k] for k in shown) for part in (table.names, table.units))
    return EstimateTable(names, units, before[shown], values[shown], covariance)


def read_covariance(folder: Path, cell: Installation) -> tuple[np.ndarray, np.ndarray]:
    """Read the covariance of the fit that `cell` came from, for steps (`calib.geometry.parameters.step`).

    Returns:
        Positions (f,) in the parameter vector, and the covariance (f, f).

    Raises:
        RobotError: where the file is missing or damaged.
        UsageError: where it belongs to another fit.
    """
    names, table = folders.read_covariance(folder)
    parameters = layout(cell)
    place = {name: k for k, name in enumerate(parameters.names)}
    strange = [name for name in names if name not in place]
    if strange:
        raise UsageError(
            f"{folder}/covariance.csv does not belong to the robot.toml next to it: '{strange[0]}' is no parameter "
            "there; fit again"
        )
    back, start = np.eye(len(parameters.names)), parameters.arm
    for placement in (*cell.stations, *cell.tools):
        block = slice(start, start + 6)
        back[block, block] = np.linalg.inv(_to_parent(placement))
        start += 6
    back = back[:, [place[name] for name in names]]
    free = np.flatnonzero(np.abs(back).max(axis=1, initial=0.0) > 0.0)
    return free, back[free] @ table @ back[free].T


def _elements(placement: np.ndarray) -> np.ndarray:
    return np.concatenate([placement[:3, 3], Rotation.from_matrix(placement[:3, :3]).as_rotvec()])


def _to_parent(placement: np.ndarray) -> np.ndarray:
    """Return ∂(position, rotation vector)/∂(d, w) (6, 6)."""
    result = np.zeros((6, 6))
    result[:3, :3] = placement[:3, :3]
    vector = Rotation.from_matrix(placement[:3, :3]).as_rotvec()
    angle = float(np.linalg.norm(vector))
    cross = np.array([[0, -vector[2], vector[1]], [vector[2], 0, -vector[0]], [-vector[1], vector[0], 0]])
    factor = 1 / 12 if angle < 1e-4 else 1 / angle**2 - (1 + np.cos(angle)) / (2 * angle * np.sin(angle))
    result[3:, 3:] = np.eye(3) + cross / 2 + factor * cross @ cross
    return result


_NONE = np.array([], dtype=int)
COMPONENTS = {
    "position": ("dx [mm]", "dy [mm]", "dz [mm]"),
    "orientation": ("drx [deg]", "dry [deg]", "drz [deg]"),
    "distance": ("ddistance [mm]",),
}


def write_residuals(outcome: Outcome, path: Path) -> Path:
    """Write the residual (measured minus predicted) of every row, fitted (with its robust weight) and unseen.

    Unseen rows have the columns of `INTERVAL` as well, as ``errors.csv`` of a session: ``sigma``, the standard
    deviation that the fit expects of the calibrated arm's position error there, ``interval95`` within which 95 % of
    such errors are to be, ``extrapolated`` 1 where a joint stands outside the training range.
    """
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
    return files.write_table(path, [*header, "size [mm]", "nominal size [mm]", "weight", "outlier", *INTERVAL], rows)


def _weights(outcome: Outcome) -> dict[tuple[str, int, str], float]:
    """Return the robust weight of each fitted residual by file, row and tool (position or orientation: the smaller)."""
    fit, result = outcome.selection.fit, {}
    for piece in fit.pieces:
        for i, w in zip(piece.part.index, piece.weight):
            key = _key(fit.blocks[piece.block].measured, int(i))
            result[key] = min(float(w), result.get(key, np.inf))
    return result


def _key(measured: PoseMeasurements, i: int) -> tuple[str, int, str]:
    return measured.file, int(measured.rows[i]), measured.tool_names[measured.tool[i]]


def _residual_rows(label: str, comparison: Comparison, named: set, weights: dict) -> list[list[object]]:
    nominal, cell = comparison.cells
    result, stated = [], iter(interval_cells(comparison, sum(map(len, comparison.blocks))))
    pairs = zip(
        prepare(nominal, comparison.blocks, comparison.torques), prepare(cell, comparison.blocks, comparison.torques)
    )
    for before, block in pairs:
        measured, m = block.measured, len(block.measured)
        columns = {nature: np.full((len(names), m), np.nan) for nature, names in COMPONENTS.items()}
        for part in observe(cell, block, _NONE):
            nature, own = NATURE[part.label], part.per_row()
            columns[nature][: len(own.value), own.index] = ERRORS[nature][0] * own.value
        first = np.full(m, np.nan)
        for part in observe(nominal, before, _NONE):
            own = part.per_row()
            if NATURE[part.label] == "position" or np.isnan(first[own.index]).all():
                first[own.index] = 1e3 * own.sizes()
        sizes = _row_sizes(columns)
        for i in range(m):
            key = _key(measured, i)
            station = measured.station if measured.has_instrument else ""
            row: list[object] = [label, key[0], key[1], station, key[2], *map(float, measured.q[i])]
            row += [_number(value) for values in columns.values() for value in values[:, i]]
            row += [_number(sizes[i]), _number(first[i]), weights.get(key), int(key[:2] in named and label == "fit")]
            row += next(stated)
            result.append(row)
    return result


def _row_sizes(columns: dict[str, np.ndarray]) -> np.ndarray:
    """Return the length [mm] of each row's position residual, or its distance residual."""
    position, distance = columns["position"], columns["distance"]
    size = np.sqrt(np.nansum(position**2, axis=0))
    return np.where(np.isnan(position).all(axis=0), np.abs(distance[0]), size)


def _number(value: float) -> float | None:
    return None if np.isnan(value) else float(value)
