"""Tables of fitted parameters and residuals; frames are given as placements, not as changes from nominal.

The fit moves a frame T by a step in its own axes, T · Trans(d) · Exp(w). In the table stand T's own position and
rotation vector r, so that the covariance of (d, w) goes through  position = R d,  r' = J_r⁻¹(r) w.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from calib import files, folders
from calib.data.poses.measurements import Positions
from calib.errors import UsageError
from calib.geometry.accuracy import NATURE
from calib.geometry.installation import Installation
from calib.geometry.observation import layout, observe, positions, prepare
from calib.geometry.residuals import inverse_right_jacobian
from calib.geometry.weighing import GeometricFit
from calib.procedure.kinematic_stage.comparison import INTERVAL, Comparison, interval_cells
from calib.procedure.kinematic_stage.fit import Outcome
from calib.robot.calibrated import Deflection
from calib.robot.chain import Chain
from calib.transforms import invert, rotation_vector
from calib.units import ERRORS

PLACES = tuple(
    f"{name} [{unit}]"
    for head, unit in (("", "m"), ("to_nominal_", "mm"), ("to_calibrated_", "mm"))
    for name in (f"{head}x", f"{head}y", f"{head}z")
)
HEADER = ("name", "unit", "nominal", "value", "sigma", "rsd [%]")


@dataclass(frozen=True, eq=False)
class EstimateTable:
    """Rows of ``estimate.csv``, and their covariance (rows, rows)."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    nominal: np.ndarray
    values: np.ndarray
    covariance: np.ndarray

    def rows(self) -> list[tuple[str, str, float, float, float, float | None]]:
        """Return name, unit, nominal, value, σ and RSD [%] of each row; RSD is empty for a value of 0."""
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
    table, full = layout(found.cell), _to_table(found.cell)[:, found.free]
    values, before = _values(found.cell), np.zeros(len(table.names))
    first = _values(replace(nominal, deflection=Deflection()))
    before[: len(first)] = first
    shown = np.flatnonzero(np.abs(full).max(axis=1, initial=0.0) > 1e-9)
    full = full[shown]
    covariance = full @ found.estimate.covariance @ full.T
    names, units = (tuple(part[k] for k in shown) for part in (table.names, table.units))
    return EstimateTable(names, units, before[shown], values[shown], covariance)


def read_covariance(folder: Path, cell: Installation) -> tuple[np.ndarray, np.ndarray]:
    """Read the covariance of a fit, for steps along its parameters (`calib.geometry.observation.step`).

    Returns:
        Positions (f,) in the parameter vector, and the covariance (f, f).

    Raises:
        RobotError: where the file is missing or damaged.
        UsageError: where it belongs to another fit.
    """
    names, table = folders.read_covariance(folder)
    place = {name: k for k, name in enumerate(layout(cell).names)}
    strange = [name for name in names if name not in place]
    if strange:
        raise UsageError(
            f"{folder}/covariance.csv does not belong to the robot.toml next to it: '{strange[0]}' is not a "
            "parameter there; fit again"
        )
    back = np.linalg.inv(_to_table(cell))[:, [place[name] for name in names]]
    free = np.flatnonzero(np.abs(back).max(axis=1, initial=0.0) > 0.0)
    return free, back[free] @ table @ back[free].T


def _values(cell: Installation) -> np.ndarray:
    """Return the full parameter vector of an installation, frames as position and rotation vector."""
    frames = [np.concatenate([t[:3, 3], rotation_vector(t[:3, :3])]) for t in (*cell.stations, *cell.tools)]
    terms = np.asarray(cell.deflection.coefficients)
    return np.concatenate([cell.chain.values, *frames, cell.optics.values, terms])


def _to_table(cell: Installation) -> np.ndarray:
    """Return the Jacobian (p, p) of the tabulated values with respect to steps along the parameters."""
    result, start = np.eye(len(layout(cell).names)), len(cell.chain.elements)
    for k, frame in enumerate((*cell.stations, *cell.tools)):
        at, turn = start + 6 * k, rotation_vector(frame[:3, :3])[:, None]
        result[at : at + 3, at : at + 3] = frame[:3, :3]
        result[at + 3 : at + 6, at + 3 : at + 6] = inverse_right_jacobian(turn, np.eye(3)[:, :, None])[:, :, 0].T
    return result


_NONE = np.array([], dtype=int)
COMPONENTS = {
    "position": ("dx [mm]", "dy [mm]", "dz [mm]"),
    "orientation": ("drx [deg]", "dry [deg]", "drz [deg]"),
    "distance": ("ddistance [mm]",),
}


def residuals(outcome: Outcome) -> tuple[Iterator[Sequence[object]], list[str]]:
    """Return the residual (measured minus predicted) of every row: fitted, held out or validation; and the header.

    Unseen rows have the columns of `INTERVAL` as well, as ``errors.csv`` of a session: ``sigma``, the standard
    deviation that the fit expects of the calibrated arm's position error there, ``interval95`` within which 95 % of
    such errors are to be, ``extrapolated`` 1 where a joint stands outside the training range.
    """
    sets, unseen = [("fit", outcome.fit)], outcome.inputs.unseen.items()
    sets += [("held out" if one.held_out else "validation", outcome.validation[name]) for name, one in unseen]
    joints = outcome.inputs.chain.joints
    header = ["set", "file", "row", "station", "tool", *(f"{joint.name} [{joint.unit}]" for joint in joints)]
    header += [name for names in COMPONENTS.values() for name in names]
    rows = chain.from_iterable(_residual_rows(label, comparison, outcome) for label, comparison in sets)
    return rows, [*header, "size [mm]", "nominal size [mm]", "weight", "outlier", *INTERVAL]


def _residual_rows(label: str, comparison: Comparison, outcome: Outcome) -> Iterator[Sequence[object]]:
    nominal, cell = comparison.cells
    named = {(each.file, each.row) for each in outcome.outliers if label == "fit"}
    stated = iter(interval_cells(comparison))
    weights = iter(outcome.selection.fit.row_weights() if label == "fit" else ())
    for before, block in zip(*(prepare(each, comparison.blocks) for each in comparison.cells)):
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
        position, distance = columns["position"], columns["distance"]
        length = np.sqrt(np.nansum(position**2, axis=0))
        size = np.where(np.isnan(position).all(axis=0), np.abs(distance[0]), length)
        weight = next(weights, np.full(m, np.nan))
        numbers = np.column_stack([measured.q, *(values.T for values in columns.values()), size, first, weight])
        station, file = measured.station if measured.has_instrument else "", measured.file
        for number, tool, row in zip(measured.rows.tolist(), measured.tool.tolist(), numbers):
            outlier = int((file, number) in named)
            yield [label, file, number, station, measured.tool_names[tool], *row.tolist(), outlier, *next(stated)]


def write_errors(path: Path, arm: Chain, validation: Mapping[str, Comparison]) -> None:
    """Write the errors of both arms at every validation row, and the error vectors of measured positions.

    Then ``x y z`` is where the target was seen, ``to_nominal`` and ``to_calibrated`` lead from there to where each arm
    puts it, all in the calibrated arm's base. After them `INTERVAL`, as in ``residuals.csv``.
    """
    rows: list[list[object]] = []
    for name, each in validation.items():
        q = np.concatenate([block.q for block in each.blocks])
        numbers = [int(row) for block in each.blocks for row in block.rows]
        sizes = [found.main for found in each.errors]
        if len(sizes[0]) == len(q):
            places = np.concatenate([_places(each, number) for number in range(len(each.blocks))])
            cells = np.column_stack([q, *(1e3 * size for size in sizes), places, interval_cells(each)])
            rows += [[name, number, *values] for number, values in zip(numbers, cells)]
    joints = [f"{joint.name} [{joint.unit}]" for joint in arm.joints]
    files.write_table(path, ["file", "row", *joints, "nominal [mm]", "calibrated [mm]", *PLACES, *INTERVAL], rows)


def _places(found: Comparison, number: int) -> np.ndarray:
    """Return measured positions [m] and error vectors of both arms [mm] of a block (m, 9); NaN without positions."""
    block = found.blocks[number]
    if not isinstance(block, Positions):
        return np.full((len(block), 9), np.nan)
    ready = [prepare(cell, [block])[0] for cell in found.cells]
    base = invert(found.cells[1].stations[ready[1].station])
    ways = [1e3 * (positions(cell, one).T - block.position) for cell, one in zip(found.cells, ready)]
    turn = base[:3, :3].T
    return np.hstack([block.position @ turn + base[:3, 3], *(way @ turn for way in ways)])
