"""Observation matrix of an installation: residual parts of each block, and their Jacobian by the fitted parameters.

The Jacobian also propagates the covariance of a fit's parameters to the pose of the tool.

The vector of all parameters has the order: arm elements (K), six per station (x y z rx ry rz, in the axes of the
station-to-base placement itself), six per tool (in the axes of the target itself), for images the lenses' values and
the boards' shapes, deflection coefficients (E).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.data.poses.fit_options import FitOptions
from calib.data.poses.measurements import PoseMeasurements, Positions, take
from calib.errors import UsageError, require
from calib.estimation.nonlinear import Rows
from calib.geometry.installation import FRAME_AXES, Installation, Seen, see
from calib.geometry.residuals import CommonNoise, ResidualPart, joined, parts
from calib.robot.calibrated import evaluate, extra_displacements, target_elements
from calib.robot.kinematics import element_jacobian
from calib.transforms import displace

TERM_UNITS = {"torque": "/(N m)", "moment": "/(N m)", "joint": "/rad"}
FRAME_UNITS = ("m", "m", "m", "rad", "rad", "rad")
KINDS = ("arm", "station", "tool", "optics", "deflection")
# number of rows evaluated at once: their Jacobian has 50 MB at 500 parameters (our choice)
PIECE = 2000
# number of poses whose sigmas are computed at once: the Jacobian has a column per parameter
CHUNK = 500


@dataclass(frozen=True)
class ParameterLayout:
    """Names, units and kinds of the parameters in the full parameter vector.

    Attributes:
        names, units: name and unit of each parameter.
        kinds: kind of each parameter, one of `KINDS`.
        moving: indices of the parameters of cameras and boards that may be fitted.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    kinds: tuple[str, ...]
    moving: tuple[int, ...] = ()

    def index(self, *kinds: str) -> np.ndarray:
        """Return the indices of all parameters of the given kinds, out of `KINDS`."""
        return np.flatnonzero(np.isin(self.kinds, kinds))

    @property
    def frame_index(self) -> np.ndarray:
        """Indices of station and tool placements, and of fitted camera and board parameters: all but those of the
        robot.
        """
        return np.concatenate([self.index("station", "tool"), np.array(self.moving, dtype=int)])

    @property
    def rigid_index(self) -> np.ndarray:
        """Indices of the arm's elements and of `frame_index`: all parameters of a rigid arm."""
        return np.concatenate([self.index("arm"), self.frame_index])

    def find(self, names: list[str] | tuple[str, ...]) -> np.ndarray:
        """Return the indices of named parameters.

        Raises:
            UsageError: a name does not exist.
        """
        index = {name: k for k, name in enumerate(self.names)}
        for name in names:
            require(name in index, f"unknown parameter '{name}'; expected one of {', '.join(self.names)}", UsageError)
        return np.array([index[name] for name in names], dtype=int)


def layout(cell: Installation) -> ParameterLayout:
    """Return names, units and kinds of all parameters of an installation.

    Args:
        cell: installation of arm, stations, tools, optics and deflection.
    """
    chain = cell.chain
    frame_names, frame_units = [], []
    for frame in (*cell.station_names, *cell.tool_names):
        frame_names += [f"{frame}.{axis}" for axis in FRAME_AXES]
        frame_units += FRAME_UNITS
    element_units = dict(zip(chain.names, chain.units))
    term_units = [element_units[term.element] + TERM_UNITS.get(term.basis, "") for term in cell.deflection.terms]
    first_of_optics = len(chain.elements) + len(frame_names)
    names = (*chain.names, *frame_names, *cell.optics.names, *cell.deflection.names(chain))
    units = (*chain.units, *frame_units, *cell.optics.units, *term_units)
    kinds = np.repeat(KINDS, layout_counts(cell))
    moving = first_of_optics + cell.optics.moving
    return ParameterLayout(names, units, tuple(kinds.tolist()), tuple(moving.tolist()))


def families(cell: Installation) -> np.ndarray:
    """Return the family of each parameter (p,).

    It is ``offset`` for joint offsets, the unit for other arm elements, and the kind for all other parameters.

    Args:
        cell: the installation, with p parameters.
    """
    table = layout(cell)
    result = list(table.kinds)
    for number, element in enumerate(cell.chain.elements):
        result[number] = table.units[number] if element.joint is None else "offset"
    return np.array(result)


def step(cell: Installation, free: np.ndarray, change: np.ndarray) -> Installation:
    """Return the installation with `change` (f,) added to the parameters `free` (f,).

    Placements are displaced by rigid motions, so that they remain valid transforms.

    Args:
        cell: the installation.
        free: (f,) indices in the full parameter vector.
        change: (f,) changes [m or rad, or the unit of the parameter].
    """
    counts = layout_counts(cell)
    full = np.zeros(sum(counts))
    full[free] = change
    arm, stations, tools, optics, terms = np.split(full, np.cumsum(counts)[:-1])
    chain = cell.chain
    if arm.any():
        chain = chain.with_values(chain.values + arm)
    deflection = cell.deflection
    if len(terms):
        deflection = deflection.with_coefficients(np.asarray(deflection.coefficients) + terms)
    instruments = cell.optics
    if optics.any():
        instruments = instruments.with_values(instruments.values + optics)
    placed_stations = _displaced(cell.stations, stations.reshape(-1, 6))
    placed_tools = _displaced(cell.tools, tools.reshape(-1, 6))
    return replace(
        cell, chain=chain, stations=placed_stations, tools=placed_tools, deflection=deflection, optics=instruments
    )


def _displaced(placements: np.ndarray, displacements: np.ndarray) -> np.ndarray:
    """Return placements (k, 4, 4) displaced by `displacements` (k, 6): along [m] and about [rad] their axes."""
    result = np.array(placements)
    for number, displacement in enumerate(displacements):
        if displacement.any():
            result[number] = displace(placements[number], displacement)
    return result


def layout_counts(cell: Installation) -> tuple[int, int, int, int, int]:
    """Return the number of parameters of each kind in the installation `cell`, in the order of `KINDS`."""
    stations = 6 * len(cell.stations)
    tools = 6 * len(cell.tools)
    return len(cell.chain.elements), stations, tools, len(cell.optics), len(cell.deflection.terms)


def parameter_values(cell: Installation) -> np.ndarray:
    """Return the full parameter vector.

    The six parameters of a placement are zero, since they are displacements from the present placement.

    Args:
        cell: the installation.
    """
    _, stations, tools, _, _ = layout_counts(cell)
    terms = np.asarray(cell.deflection.coefficients)
    return np.concatenate([cell.chain.values, np.zeros(stations + tools), cell.optics.values, terms])


def fixed_parameters(start: Installation, options: FitOptions) -> np.ndarray:
    """Return the indices of parameters fixed at their nominal values: those in ``fix``, or all but those in ``free``.

    The option ``free`` refers to the arm only; placements are always fitted.

    Args:
        start: the installation from which the fit starts.
        options: options of the fit, with the names in ``fix`` or ``free``.
    """
    table = layout(start)
    fixed = table.find(options.fix)
    if options.free:
        not_free = np.setdiff1d(table.index("arm"), table.find(options.free))
        fixed = np.union1d(fixed, not_free)
    return fixed


def stated_prior(start: Installation, options: FitOptions) -> np.ndarray | None:
    """Return the prior standard deviations in the options for the full parameter vector; infinite where none is stated.

    None if the options state no prior.

    Args:
        start: the installation from which the fit starts.
        options: options of the fit, with standard deviations by parameter name.
    """
    if not options.prior:
        return None
    table = layout(start)
    prior = np.full(len(table.names), np.inf)
    prior[table.find(tuple(options.prior))] = list(options.prior.values())
    return prior


@dataclass(frozen=True, eq=False)
class Block:
    """Measurements prepared for evaluation with an installation (arm, stations, tools).

    Attributes:
        measured: measurements of m rows.
        station: index of the measurements' station; -1 for kinds without an instrument, which refer to the arm's base.
        tool: (m,) index of each row's target among the installation's tools.
        bases: (E, m) basis functions of the deflection's terms, evaluated once; None for a long block that `pieces`
            divides.
        displacements: (K, m) displacements of the chain's elements by the known deflections; None without such
            deflections.
    """

    measured: PoseMeasurements
    station: int
    tool: np.ndarray
    bases: np.ndarray | None = None
    displacements: np.ndarray | None = None


def prepare(cell: Installation, measured: Sequence[PoseMeasurements]) -> list[Block]:
    """Return the blocks with the indices of their stations and tools, and the basis functions of their deflections.

    Stations and tools are found by name.

    Args:
        cell: the installation.
        measured: blocks of measurements, one per file, station and kind.

    Raises:
        UsageError: the installation does not have a station or tool of that name.
    """
    blocks = []
    for measurements in measured:
        station = -1
        if measurements.has_instrument:
            station = _index(cell.station_names, measurements.station, "station")
        tools = np.array([_index(cell.tool_names, name, "tool") for name in measurements.tool_names])
        block = Block(measurements, station, tools[measurements.tool])
        if not _divided(measurements):
            block = rows_of(cell, block, np.arange(len(measurements)))
        blocks.append(block)
    return blocks


def rows_of(cell: Installation, block: Block, rows: np.ndarray) -> Block:
    """Return the block with only the given rows, and with the deflection's basis functions evaluated at these rows.

    Args:
        cell: the installation, which defines the basis functions.
        block: the prepared measurements.
        rows: row numbers, or a mask (m,).
    """
    measured = take(block.measured, rows)
    bases = None
    if cell.deflection.terms:
        bases = evaluate(cell.deflection, measured.q, measured.torque, measured.load)
    known_bases = None
    if cell.known.terms:
        known_bases = evaluate(cell.known, measured.q, measured.torque, measured.load)
    displacements = extra_displacements(cell.chain, cell.known, measured.q, known_bases)
    return Block(measured, block.station, block.tool[rows], bases, displacements)


def _divided(measured: PoseMeasurements) -> bool:
    """Return whether a block is evaluated in pieces: it is long, and its rows do not depend on each other.

    Args:
        measured: the block of measurements.
    """
    return len(measured) > PIECE and isinstance(measured, Positions)


def pieces(cell: Installation, block: Block) -> Iterator[Block]:
    """Yield a block in pieces: a long block of positions or poses in pieces of at most `PIECE` rows, others whole.

    Args:
        cell: the installation, which defines the basis functions of the deflection.
        block: the prepared measurements.
    """
    if not _divided(block.measured):
        yield block
        return
    count = len(block.measured)
    for rows in np.array_split(np.arange(count), -(-count // PIECE)):
        yield rows_of(cell, block, rows)


def _index(names: tuple[str, ...], name: str, kind: str) -> int:
    require(name in names, f"{kind} '{name}' is not part of the installation; it has {', '.join(names)}", UsageError)
    return names.index(name)


def sampled(measured: Sequence[PoseMeasurements], poses: int, seed: int = 0) -> list[np.ndarray]:
    """Return numbers of random rows: for long blocks of positions or poses a sample, for other blocks all rows.

    Args:
        measured: blocks of measurements.
        poses: approximate number of poses of all samples together; each block keeps at least a tenth of it.
        seed: seed of the sample.
    """
    generator = np.random.default_rng(seed)
    total = max(sum(map(len, measured)), 1)
    result = []
    for block in measured:
        count = max(poses * len(block) // total, poses // 10)
        rows = np.arange(len(block))
        if _divided(block) and count < len(rows):
            rows = np.sort(generator.choice(rows, count, replace=False))
        result.append(rows)
    return result


def positions(cell: Installation, block: Block) -> np.ndarray:
    """Return the predicted target positions (3, m) [m] of a block's rows, in the instrument's frame.

    Args:
        cell: the installation.
        block: the prepared measurements of m rows.
    """
    return np.concatenate([predict(cell, piece).point for piece in pieces(cell, block)], axis=1)


def predict(cell: Installation, block: Block) -> Seen:
    """Return the predicted targets of the rows of a block, or of a piece of a block, in the instrument's frame.

    Args:
        cell: the installation.
        block: the prepared measurements.
    """
    return see(cell, block.measured.q, block.station, block.tool, block.bases, block.displacements)


def observe(cell: Installation, block: Block, free: np.ndarray) -> list[ResidualPart]:
    """Return the residual parts of a block with their Jacobian with respect to the parameters `free` (f,).

    Args:
        cell: the installation.
        block: the prepared measurements.
        free: (f,) indices in the full parameter vector.
    """
    observed = [_observe(cell, piece, free) for piece in pieces(cell, block)]
    if len(observed) == 1:
        return observed[0]
    return [joined(parts_of_pieces) for parts_of_pieces in zip(*observed)]


def _observe(cell: Installation, block: Block, free: np.ndarray) -> list[ResidualPart]:
    seen = predict(cell, block)
    if len(cell.optics):
        first_of_optics = sum(layout_counts(cell)[:3])
        seen = replace(seen, view=cell.optics.view(block.measured, free - first_of_optics))
    jacobian = target_jacobian(cell, seen, free, block.station, block.tool, block.bases)
    return parts(block.measured, seen, jacobian)


def whitened(
    cell: Installation,
    block: Block,
    free: np.ndarray,
    scales: Sequence[np.ndarray],
    noises: Sequence[CommonNoise | None] = (),
) -> Iterator[Rows]:
    """Yield residuals and Jacobians of a block piece by piece, whitened.

    Args:
        cell, block, free: arguments of `observe`.
        scales: for each residual part of the block, the numbers (rows, m) by which its residuals are divided.
        noises: for each residual part, the noise that its rows share; None for a part without shared noise.
    """
    start = 0
    for piece in pieces(cell, block):
        for k, part in enumerate(observe(cell, piece, free)):
            if noises and noises[k]:
                part = replace(part, noise=noises[k])
            yield part.whitened(scales[k][:, start : start + part.value.shape[1]])
        start += len(piece.measured)


def target_jacobian(
    cell: Installation, seen: Seen, free: np.ndarray, station: int, tool: np.ndarray, bases: np.ndarray | None = None
) -> np.ndarray:
    """Return velocity and angular velocity [v; ω] of the targets per unit of each fitted parameter, (f, 6, m).

    Args:
        cell: the installation.
        seen: its predicted targets.
        free: (f,) indices of the fitted parameters.
        station, tool, bases: station index, tool indices and basis functions of the rows, as in `Block`.
    """
    arm, stations, tools, optics, _ = layout_counts(cell)
    jacobian = np.zeros((len(free), 6, seen.point.shape[1]))
    section = np.searchsorted(np.cumsum([arm, stations, tools, optics]), free, side="right")
    in_arm = np.flatnonzero(section == 0)
    if len(in_arm) == len(free):
        return element_jacobian(cell.chain, seen.walked, seen.point, free)
    if len(in_arm):
        jacobian[in_arm] = element_jacobian(cell.chain, seen.walked, seen.point, free[in_arm])
    for column in np.flatnonzero(section == 1):
        number, axis = divmod(int(free[column]) - arm, 6)
        if number == station:
            _station_column(jacobian[column], cell.stations[number], seen, axis)
    for column in np.flatnonzero(section == 2):
        number, axis = divmod(int(free[column]) - arm - stations, 6)
        direction = np.where(tool == number, seen.rotation[axis % 3], 0.0)
        if axis < 3:
            jacobian[column, :3] = direction
        else:
            jacobian[column, 3:] = direction
    in_terms = np.flatnonzero(section == 4)
    if len(in_terms):
        assert bases is not None
        numbers = free[in_terms] - arm - stations - tools - optics
        targets = target_elements(cell.chain, cell.deflection)[numbers]
        elements, element_of_term = np.unique(targets, return_inverse=True)
        motions = element_jacobian(cell.chain, seen.walked, seen.point, elements)
        for column, element, number in zip(in_terms, element_of_term, numbers):
            np.multiply(motions[element], bases[number], out=jacobian[column])
    return jacobian


def _station_column(column: np.ndarray, placement: np.ndarray, seen: Seen, axis: int) -> None:
    """Fill `column` (6, m) with the targets' [v; ω] per unit displacement of a station.

    Args:
        column: (6, m) array to fill.
        placement: (4, 4) pose of the arm's base in the station's frame.
        seen: the predicted targets.
        axis: 0 to 2 for a displacement along, 3 to 5 for a rotation about x, y, z of the placement.
    """
    direction = placement[:3, axis % 3]
    if axis < 3:
        column[:3] = direction[:, None]
    else:
        lever = (seen.point - placement[:3, 3:4]).T
        column[:3] = np.cross(direction, lever).T
        column[3:] = direction[:, None]


def pose_sigmas(
    cell: Installation,
    measured: PoseMeasurements,
    free: np.ndarray,
    covariance: np.ndarray,
    station: int = 0,
    tool: np.ndarray | int = 0,
) -> np.ndarray:
    """Return standard deviations (m, 2) of a tool's position [m] and orientation [rad]: sqrt(trace J Σ Jᵀ) of each.

    J are the derivatives of position or orientation by the parameters.

    Args:
        cell: the fitted installation.
        measured: joint values (m, n), and gravity torques if the model has compliance terms.
        free: (f,) indices in the parameter vector.
        covariance: (f, f) covariance Σ of these parameters.
        station: index of the station of reference; -1 for the arm's base.
        tool: index of the tool, one or (m,).
    """
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.clip(values, 0.0, None))
    poses = Block(measured, station, np.broadcast_to(tool, len(measured)))
    result = [np.zeros((0, 2))]
    for start in range(0, len(measured), CHUNK):
        rows = np.arange(start, min(start + CHUNK, len(measured)))
        block = rows_of(cell, poses, rows)
        jacobian = target_jacobian(cell, predict(cell, block), free, station, block.tool, block.bases)
        spread = root.T @ jacobian.reshape(len(free), -1)
        spread = spread.reshape(len(root), 2, 3, len(rows))
        variances = np.sum(spread**2, axis=(0, 2))
        result.append(np.sqrt(variances).T)
    return np.concatenate(result)
