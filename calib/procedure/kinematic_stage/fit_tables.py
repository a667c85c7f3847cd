"""Tables of fitted parameters and residuals; frames are stated as placements, not as changes from nominal.

The fit moves a frame T by a step in the axes of T, T · Trans(d) · Exp(w). The table contains the position and rotation
vector r of T, so that the covariance of (d, w) is transformed by position = R d, r' = J_r⁻¹(r) w.
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
from calib.geometry.observation import Block, layout, observe, positions, prepare
from calib.geometry.residuals import inverse_right_jacobian
from calib.geometry.weighing import GeometricFit
from calib.procedure.kinematic_stage.fit import Outcome
from calib.procedure.kinematic_stage.verdict.comparison import INTERVAL, Comparison, interval_cells
from calib.robot.calibrated import Deflection
from calib.robot.chain import Chain
from calib.transforms import invert, rotation_vector
from calib.units import ERRORS

TO_CALIBRATED = ("to_calibrated_x [mm]", "to_calibrated_y [mm]", "to_calibrated_z [mm]")
PLACES = ("x [m]", "y [m]", "z [m]", "to_nominal_x [mm]", "to_nominal_y [mm]", "to_nominal_z [mm]", *TO_CALIBRATED)
HEADER = ("name", "unit", "nominal", "value", "sigma", "rsd [%]")
# nature of a residual -> its columns of residuals.csv
COMPONENTS = {
    "position": ("dx [mm]", "dy [mm]", "dz [mm]"),
    "orientation": ("drx [deg]", "dry [deg]", "drz [deg]"),
    "distance": ("ddistance [mm]",),
}
# no derivatives are needed where residuals alone are
NO_PARAMETERS = np.array([], dtype=int)
# a tabulated value whose row of the Jacobian is below this was not fitted
NOT_FITTED = 1e-9


@dataclass(frozen=True, eq=False)
class EstimateTable:
    """Fitted parameters as in ``estimate.csv``.

    Attributes:
        names, units: names and units of the parameters.
        nominal, values: nominal and fitted values.
        covariance: (rows, rows) covariance of the values.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    nominal: np.ndarray
    values: np.ndarray
    covariance: np.ndarray

    def rows(self) -> list[tuple[str, str, float, float, float, float | None]]:
        """Return name, unit, nominal value, value, σ and relative standard deviation [%] of each row.

        The relative standard deviation is None for a value of 0.
        """
        sigmas = np.sqrt(np.clip(np.diag(self.covariance), 0.0, None))
        rows = []
        for name, unit, nominal, value, sigma in zip(self.names, self.units, self.nominal, self.values, sigmas):
            rsd = float(100.0 * sigma / abs(value)) if value else None
            rows.append((name, unit, float(nominal), float(value), float(sigma), rsd))
        return rows


def estimate_table(fit: GeometricFit, nominal: Installation) -> EstimateTable:
    """Return the table of fitted parameters: arm elements, placements, and coefficients of deflection terms.

    Args:
        fit: the fit.
        nominal: the nominal arm with fitted frames, whose values are written to the column ``nominal``.
    """
    parameters = layout(fit.cell)
    values = _values(fit.cell)
    # the nominal arm has no deflection terms; these start from 0
    nominal_values = np.zeros(len(parameters.names))
    start = _values(replace(nominal, deflection=Deflection()))
    nominal_values[: len(start)] = start

    to_table = _to_table(fit.cell)[:, fit.free]
    fitted = np.flatnonzero(np.abs(to_table).max(axis=1, initial=0.0) > NOT_FITTED)
    to_table = to_table[fitted]
    covariance = to_table @ fit.estimate.covariance @ to_table.T
    names = tuple(parameters.names[k] for k in fitted)
    units = tuple(parameters.units[k] for k in fitted)
    return EstimateTable(names, units, nominal_values[fitted], values[fitted], covariance)


def read_covariance(folder: Path, cell: Installation) -> tuple[np.ndarray, np.ndarray]:
    """Read the covariance of a fit with respect to steps along the parameters (`calib.geometry.observation.step`).

    Args:
        folder: folder of the fit.
        cell: the fitted installation.

    Returns:
        Indices (f,) in the parameter vector, and the covariance (f, f).

    Raises:
        RobotError: if the file is missing or damaged.
        UsageError: if the file belongs to another fit.
    """
    names, table = folders.read_covariance(folder)
    index = {name: k for k, name in enumerate(layout(cell).names)}
    unknown = [name for name in names if name not in index]
    if unknown:
        raise UsageError(
            f"{folder}/covariance.csv does not belong to the robot.toml next to it: '{unknown[0]}' is not a "
            "parameter there; fit again"
        )
    columns = [index[name] for name in names]
    from_table = np.linalg.inv(_to_table(cell))[:, columns]
    free = np.flatnonzero(np.abs(from_table).max(axis=1, initial=0.0) > 0.0)
    return free, from_table[free] @ table @ from_table[free].T


def _values(cell: Installation) -> np.ndarray:
    """Return the full parameter vector of an installation; frames are represented by position and rotation vector.

    Args:
        cell: the installation (arm with stations and tools).
    """
    frames = []
    for frame in (*cell.stations, *cell.tools):
        frames += [frame[:3, 3], rotation_vector(frame[:3, :3])]
    coefficients = np.asarray(cell.deflection.coefficients)
    return np.concatenate([cell.chain.values, *frames, cell.optics.values, coefficients])


def _to_table(cell: Installation) -> np.ndarray:
    """Return the Jacobian (p, p) of the values in the table with respect to steps along the parameters.

    Args:
        cell: the installation (arm with stations and tools).
    """
    jacobian = np.eye(len(layout(cell).names))
    start = len(cell.chain.elements)
    for frame in (*cell.stations, *cell.tools):
        rotation = frame[:3, :3]
        vector = rotation_vector(rotation)[:, None]
        position_rows = slice(start, start + 3)
        rotation_rows = slice(start + 3, start + 6)
        jacobian[position_rows, position_rows] = rotation
        jacobian[rotation_rows, rotation_rows] = inverse_right_jacobian(vector, np.eye(3)[:, :, None])[:, :, 0].T
        start += 6
    return jacobian


def residuals(outcome: Outcome) -> tuple[Iterator[Sequence[object]], list[str]]:
    """Return a table of the residual (measured minus predicted) of every row, fitted or held out: rows and header.

    Held-out rows also have the columns of `INTERVAL`, as in ``errors.csv`` of a session: ``sigma`` is the standard
    deviation of the calibrated arm's position error by the fit's error model, ``interval95`` is the radius that
    contains 95 % of such errors, and ``extrapolated`` is 1 if a joint is outside the range of the fitted rows.

    Args:
        outcome: the fit.
    """
    sets = [("fit", outcome.fit)]
    for name, unseen in outcome.inputs.unseen.items():
        label = "validation"
        if unseen.held_out:
            label = "held out"
        sets.append((label, outcome.validation[name]))
    joints = [f"{joint.name} [{joint.unit}]" for joint in outcome.inputs.chain.joints]
    header = ["set", "file", "row", "station", "tool", *joints]
    for names in COMPONENTS.values():
        header += names
    header += ["size [mm]", "nominal size [mm]", "weight", "outlier", *INTERVAL]
    rows = chain.from_iterable(_residual_rows(label, comparison, outcome) for label, comparison in sets)
    return rows, header


def _residual_rows(label: str, comparison: Comparison, outcome: Outcome) -> Iterator[Sequence[object]]:
    """Yield the rows of ``residuals.csv`` for one set of measured rows.

    Args:
        label: name of the set: ``fit``, ``held out`` or ``validation``.
        comparison: the measured rows, and the arms that predict them.
        outcome: the fit.
    """
    nominal, calibrated = comparison.cells
    nominal_blocks = prepare(nominal, comparison.blocks)
    blocks = prepare(calibrated, comparison.blocks)
    intervals = iter(interval_cells(comparison))
    outliers = set()
    weights = iter(())
    if label == "fit":
        outliers = {(outlier.file, outlier.row) for outlier in outcome.outliers}
        weights = iter(outcome.selection.fit.row_weights())
    for nominal_block, block in zip(nominal_blocks, blocks):
        measured = block.measured
        count = len(measured)
        columns = {nature: np.full((len(names), count), np.nan) for nature, names in COMPONENTS.items()}
        for part in observe(calibrated, block, NO_PARAMETERS):
            nature = NATURE[part.label]
            residual = part.per_row()
            factor, _ = ERRORS[nature]
            columns[nature][: len(residual.value), residual.index] = factor * residual.value
        nominal_size = _nominal_sizes(nominal, nominal_block, count)

        # the size of a row is that of its position error, else of its distance error
        without_position = np.isnan(columns["position"]).all(axis=0)
        length = np.sqrt(np.nansum(columns["position"] ** 2, axis=0))
        size = np.where(without_position, np.abs(columns["distance"][0]), length)
        weight = next(weights, np.full(count, np.nan))
        components = [values.T for values in columns.values()]
        numbers = np.column_stack([measured.q, *components, size, nominal_size, weight])
        station = ""
        if measured.has_instrument:
            station = measured.station
        for row, tool, values in zip(measured.rows.tolist(), measured.tool.tolist(), numbers):
            outlier = int((measured.file, row) in outliers)
            tool_name = measured.tool_names[tool]
            yield [label, measured.file, row, station, tool_name, *values.tolist(), outlier, *next(intervals)]


def _nominal_sizes(nominal: Installation, block: Block, count: int) -> np.ndarray:
    """Return the size (m,) of the nominal arm's residuals [mm].

    It is the size of the position residual if positions were measured, otherwise of the first measured quantity.

    Args:
        nominal: the nominal arm with base and tool placed.
        block: measurements, prepared for the computation of residuals.
        count: number m of rows.
    """
    sizes = np.full(count, np.nan)
    for part in observe(nominal, block, NO_PARAMETERS):
        residual = part.per_row()
        if NATURE[part.label] == "position" or np.isnan(sizes[residual.index]).all():
            sizes[residual.index] = 1e3 * residual.sizes()
    return sizes


def write_errors(path: Path, arm: Chain, validation: Mapping[str, Comparison]) -> None:
    """Write the errors of both arms at every validation row, and the error vectors of measured positions.

    For measured positions, ``x y z`` is the measured position of the target. ``to_nominal`` and ``to_calibrated`` are
    the vectors from there to the positions predicted by each arm, all in the calibrated arm's base frame. The columns
    of `INTERVAL` are as in ``residuals.csv``.

    Args:
        path: path of the table.
        arm: the arm.
        validation: name of a validation file -> errors on its rows.
    """
    rows: list[list[object]] = []
    for name, comparison in validation.items():
        q = np.concatenate([block.q for block in comparison.blocks])
        row_numbers = [int(row) for block in comparison.blocks for row in block.rows]
        nominal, calibrated = (arm.main for arm in comparison.errors)
        # errors of pairs are not of single rows
        if len(nominal) != len(q):
            continue
        vectors = np.concatenate([_error_vectors(comparison, k) for k in range(len(comparison.blocks))])
        intervals = interval_cells(comparison)
        cells = np.column_stack([q, 1e3 * nominal, 1e3 * calibrated, vectors, intervals])
        rows += [[name, row, *values] for row, values in zip(row_numbers, cells)]
    joints = [f"{joint.name} [{joint.unit}]" for joint in arm.joints]
    header = ["file", "row", *joints, "nominal [mm]", "calibrated [mm]", *PLACES, *INTERVAL]
    files.write_table(path, header, rows)


def _error_vectors(comparison: Comparison, number: int) -> np.ndarray:
    """Return measured positions [m] and error vectors of both arms [mm] of one block (m, 9); NaN without positions.

    Args:
        comparison: errors on the blocks.
        number: index (from 0) of the block.
    """
    block = comparison.blocks[number]
    if not isinstance(block, Positions):
        return np.full((len(block), 9), np.nan)
    prepared = [prepare(cell, [block])[0] for cell in comparison.cells]
    calibrated = comparison.cells[1]
    T_base_station = invert(calibrated.stations[prepared[1].station])
    rotation = T_base_station[:3, :3].T
    columns = [block.position @ rotation + T_base_station[:3, 3]]
    for cell, cell_block in zip(comparison.cells, prepared):
        error_mm = 1e3 * (positions(cell, cell_block).T - block.position)
        columns.append(error_mm @ rotation)
    return np.hstack(columns)
