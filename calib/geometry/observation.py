"""Observation matrix of an installation: residual parts of each block, and their Jacobian in the fit's parameters.

With it the covariance of a fit's parameters is propagated to the tool's pose.

The vector of all parameters has the order: arm elements (K), six per station (x y z rx ry rz, in the station-to-base
placement's own axes), six per tool (in the target's own axes), of images the lenses' values and the boards' shapes,
deflection coefficients (E).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.data.poses.fit_options import FitOptions
from calib.data.poses.measurements import PoseMeasurements, Positions, take
from calib.errors import UsageError, require
from calib.estimation.nonlinear import Rows
from calib.geometry.installation import FRAME_AXES, Installation, Seen, see
from calib.geometry.residuals import Part, joined, parts
from calib.robot.calibrated import evaluate, extra_displacements, target_elements
from calib.robot.kinematics import element_jacobian
from calib.transforms import displace

TERM_UNITS = {"torque": "/(N m)", "joint": "/rad"}
KINDS = ("arm", "station", "tool", "optics", "deflection")


@dataclass(frozen=True)
class ParameterLayout:
    """Layout of the full parameter vector by kind of parameter.

    Attributes:
        names, units: one per parameter.
        kinds: one of `KINDS` per parameter.
        moving: positions of the optics that may be fitted.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    kinds: tuple[str, ...]
    moving: tuple[int, ...] = ()

    def index(self, *kinds: str) -> np.ndarray:
        """Return the indices of all parameters of the given kinds (see `KINDS`)."""
        return np.flatnonzero(np.isin(self.kinds, kinds))

    @property
    def frame_index(self) -> np.ndarray:
        """Indices of placements and of fitted camera and board parameters: all but the robot's."""
        return np.concatenate([self.index("station", "tool"), np.array(self.moving, dtype=int)])

    @property
    def rigid_index(self) -> np.ndarray:
        """Indices of the arm's elements and of `frame_index`: all parameters of a rigid arm."""
        return np.concatenate([self.index("arm"), self.frame_index])

    def find(self, names: list[str] | tuple[str, ...]) -> np.ndarray:
        """Return the indices of named parameters.

        Raises:
            UsageError: for a name that does not exist.
        """
        table = {name: k for k, name in enumerate(self.names)}
        for name in names:
            require(name in table, f"unknown parameter '{name}'; expected one of {', '.join(self.names)}", UsageError)
        return np.array([table[name] for name in names], dtype=int)


def layout(cell: Installation) -> ParameterLayout:
    """Return the layout of an installation's parameters."""
    units = ("m", "m", "m", "rad", "rad", "rad")
    frames = [f"{name}.{axis}" for name in (*cell.station_names, *cell.tool_names) for axis in FRAME_AXES]
    terms = cell.deflection.terms
    element_units = dict(zip(cell.chain.names, cell.chain.units))
    return ParameterLayout(
        names=(*cell.chain.names, *frames, *cell.optics.names, *cell.deflection.names(cell.chain)),
        units=(
            *cell.chain.units,
            *(units * (len(frames) // 6)),
            *cell.optics.units,
            *(element_units[t.element] + TERM_UNITS.get(t.basis, "") for t in terms),
        ),
        kinds=tuple(np.repeat(KINDS, layout_counts(cell)).tolist()),
        moving=tuple((len(cell.chain.elements) + len(frames) + cell.optics.moving).tolist()),
    )


def families(cell: Installation) -> np.ndarray:
    """Return the family of each parameter (p,): ``offset`` or unit of an arm element, else its kind."""
    table, moving = layout(cell), {e.name for e in cell.chain.elements if e.joint is not None}
    arm = ["offset" if name in moving else unit for name, unit in zip(cell.chain.names, cell.chain.units)]
    return np.array([*arm, *table.kinds[len(arm) :]])


def step(cell: Installation, free: np.ndarray, change: np.ndarray) -> Installation:
    """Return the installation with `change` (f,) added to the parameters `free` (f,); frames move on the manifold."""
    where = layout_counts(cell)
    full = np.zeros(sum(where))
    full[free] = change
    arm, stations, tools, optics, terms = np.split(full, np.cumsum(where)[:-1])
    stations, tools = stations.reshape(-1, 6), tools.reshape(-1, 6)
    return replace(
        cell,
        chain=cell.chain.with_values(cell.chain.values + arm) if arm.any() else cell.chain,
        stations=np.array([displace(s, d) if d.any() else s for s, d in zip(cell.stations, stations)]),
        tools=np.array([displace(t, d) if d.any() else t for t, d in zip(cell.tools, tools)]),
        deflection=cell.deflection.with_coefficients(np.asarray(cell.deflection.coefficients) + terms)
        if len(terms)
        else cell.deflection,
        optics=cell.optics.with_values(cell.optics.values + optics) if optics.any() else cell.optics,
    )


def layout_counts(cell: Installation) -> tuple[int, int, int, int, int]:
    """Return the number of parameters of each of `KINDS`."""
    frames = 6 * len(cell.stations), 6 * len(cell.tools)
    return len(cell.chain.elements), *frames, len(cell.optics), len(cell.deflection.terms)


def parameter_values(cell: Installation) -> np.ndarray:
    """Return the full parameter vector; frames have zeros: displacements from their present placement."""
    _, stations, tools, _, _ = layout_counts(cell)
    terms = np.asarray(cell.deflection.coefficients)
    return np.concatenate([cell.chain.values, np.zeros(stations + tools), cell.optics.values, terms])


def fixed_parameters(start: Installation, options: FitOptions) -> np.ndarray:
    """Return the indices of parameters fixed at their nominal values: those in ``fix``, or all but those in ``free``.

    ``free`` speaks of the arm; frames are always fitted.
    """
    table = layout(start)
    fixed = table.find(options.fix)
    if options.free:
        fixed = np.union1d(fixed, np.setdiff1d(table.index("arm"), table.find(options.free)))
    return fixed


def stated_prior(start: Installation, options: FitOptions) -> np.ndarray | None:
    """Return the prior standard deviations of the options for the full vector; infinite without a prior."""
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
        measured: m rows.
        station: index of their station; -1 for kinds without an instrument, which refer to the arm's base.
        tool: (m,) index of each row's target among the installation's tools.
        bases: (E, m) the deflection's bases, evaluated once; None for a block that `pieces` divides.
        given: (K, m) displacements by the known deflections, or None.
    """

    measured: PoseMeasurements
    station: int
    tool: np.ndarray
    bases: np.ndarray | None = None
    given: np.ndarray | None = None


def prepare(cell: Installation, measured: Sequence[PoseMeasurements]) -> list[Block]:
    """Return the blocks with the indices of their stations and tools (by name) and their deflection bases.

    Raises:
        UsageError: for a station or tool the installation does not have.
    """
    blocks = []
    for block in measured:
        station = _index(cell.station_names, block.station, "station") if block.has_instrument else -1
        tools = np.array([_index(cell.tool_names, name, "tool") for name in block.tool_names])
        bare = Block(block, station, tools[block.tool])
        blocks.append(bare if _divided(block) else rows_of(cell, bare, np.arange(len(block))))
    return blocks


def rows_of(cell: Installation, block: Block, rows: np.ndarray) -> Block:
    """Return some rows of a block, their deflection bases evaluated."""
    measured = take(block.measured, rows)
    bases = evaluate(cell.deflection, measured.q, measured.torque) if cell.deflection.terms else None
    known = evaluate(cell.known, measured.q, measured.torque) if cell.known.terms else None
    given = extra_displacements(cell.chain, cell.known, measured.q, known)
    return Block(measured, block.station, block.tool[rows], bases, given)


PIECE = 2000  # rows observed at once: the Jacobian of so many has 50 MB at 500 parameters (our choice)


def _divided(measured: PoseMeasurements) -> bool:
    """Return whether a block is observed in pieces: it is long, and its rows do not depend on each other."""
    return len(measured) > PIECE and isinstance(measured, Positions)


def pieces(cell: Installation, block: Block) -> Iterator[Block]:
    """Yield a long block of positions or poses in pieces of at most `PIECE` rows, in their order; others whole."""
    if not _divided(block.measured):
        yield block
        return
    for rows in np.array_split(np.arange(len(block.measured)), -(-len(block.measured) // PIECE)):
        yield rows_of(cell, block, rows)


def _index(names: tuple[str, ...], name: str, what: str) -> int:
    require(name in names, f"{what} '{name}' is not part of the installation; it has {', '.join(names)}", UsageError)
    return names.index(name)


def sampled(measured: Sequence[PoseMeasurements], poses: int, seed: int = 0) -> list[np.ndarray]:
    """Return random rows of long blocks of positions or poses, all rows of the others.

    `poses`: of all blocks, about; a block keeps at least a tenth of that.
    """
    generator, result = np.random.default_rng(seed), []
    for block in measured:
        count = max(poses * len(block) // max(sum(map(len, measured)), 1), poses // 10)
        rows = np.arange(len(block))
        few = _divided(block) and count < len(rows)
        result.append(np.sort(generator.choice(rows, count, replace=False)) if few else rows)
    return result


def positions(cell: Installation, block: Block) -> np.ndarray:
    """Return the predicted target positions (3, m) [m] of a block's rows, in the instrument's frame."""
    return np.concatenate([predict(cell, piece).point for piece in pieces(cell, block)], axis=1)


def predict(cell: Installation, block: Block) -> Seen:
    """Return the predicted targets of a block's rows, or of a piece's, in the instrument's frame."""
    return see(cell, block.measured.q, block.station, block.tool, block.bases, block.given)


def observe(cell: Installation, block: Block, free: np.ndarray) -> list[Part]:
    """Return the residual parts of a block with their Jacobian with respect to the parameters `free` (f,)."""
    found = [_observe(cell, piece, free) for piece in pieces(cell, block)]
    return found[0] if len(found) == 1 else [joined(each) for each in zip(*found)]


def _observe(cell: Installation, block: Block, free: np.ndarray) -> list[Part]:
    seen = predict(cell, block)
    if len(cell.optics):
        seen = replace(seen, view=cell.optics.view(block.measured, free - sum(layout_counts(cell)[:3])))
    return parts(block.measured, seen, target_jacobian(cell, seen, free, block.station, block.tool, block.bases))


def whitened(
    cell: Installation, block: Block, free: np.ndarray, scales: Sequence[np.ndarray], noises: Sequence[Any] = ()
) -> Iterator[Rows]:
    """Yield residuals and Jacobians of a block piece by piece, whitened.

    Args:
        cell, block, free: as of `observe`.
        scales: for each of its parts, the divisor (rows, m) of its residuals.
        noises: for each of its parts, the noise that its rows share, or None.
    """
    done = 0
    for piece in pieces(cell, block):
        for k, part in enumerate(observe(cell, piece, free)):
            part = replace(part, noise=noises[k]) if noises and noises[k] else part
            yield part.whitened(scales[k][:, done : done + part.value.shape[1]])
        done += len(piece.measured)


def target_jacobian(
    cell: Installation, seen: Seen, free: np.ndarray, station: int, tool: np.ndarray, bases: np.ndarray | None = None
) -> np.ndarray:
    """Return [v; ω] of the targets per unit of each free parameter, (f, 6, m); last three arguments: see `Block`."""
    arm, stations, tools, optics, _ = layout_counts(cell)
    m = seen.point.shape[1]
    jacobian = np.zeros((len(free), 6, m))
    section = np.searchsorted(np.cumsum([arm, stations, tools, optics]), free, side="right")
    in_arm = np.flatnonzero(section == 0)
    if len(in_arm) == len(free):
        return element_jacobian(cell.chain, seen.walked, seen.point, free)
    if len(in_arm):
        jacobian[in_arm] = element_jacobian(cell.chain, seen.walked, seen.point, free[in_arm])
    for place in np.flatnonzero(section == 1):
        number, axis = divmod(int(free[place]) - arm, 6)
        if number == station:
            _station_column(jacobian[place], cell.stations[number], seen, axis)
    for place in np.flatnonzero(section == 2):
        number, axis = divmod(int(free[place]) - arm - stations, 6)
        rows = tool == number
        jacobian[place][3 * (axis // 3) : 3 * (axis // 3) + 3] = np.where(rows, seen.rotation[axis % 3], 0.0)
    in_terms = np.flatnonzero(section == 4)
    if len(in_terms):
        assert bases is not None
        numbers = free[in_terms] - arm - stations - tools - optics
        targets = target_elements(cell.chain, cell.deflection)[numbers]
        unique, inverse = np.unique(targets, return_inverse=True)
        moved = element_jacobian(cell.chain, seen.walked, seen.point, unique)
        for place, which, number in zip(in_terms, inverse, numbers):
            np.multiply(moved[which], bases[number], out=jacobian[place])
    return jacobian


def _station_column(column: np.ndarray, placement: np.ndarray, seen: Seen, axis: int) -> None:
    """Fill the column (6, m) for a unit displacement of a station along or about one of its axes."""
    direction = placement[:3, axis % 3]
    if axis < 3:
        column[:3] = direction[:, None]
    else:
        lever = (seen.point - placement[:3, 3:4]).T
        column[:3] = np.cross(direction, lever).T
        column[3:] = direction[:, None]


def pose_sigmas(
    cell: Installation, at: PoseMeasurements, free: np.ndarray, covariance: np.ndarray, station: int = 0, tool: Any = 0
) -> np.ndarray:
    """Return sigmas (m, 2) of a tool's position [m] and orientation [rad]: sqrt(trace J Σ Jᵀ) of each.

    Args:
        cell: the fitted installation.
        at: joint values (m, n), and gravity torques for compliance terms.
        free: (f,) positions in the parameter vector.
        covariance: (f, f) of steps along them.
        station: index of the station of reference; -1 for the arm's base.
        tool: which of its tools, one or (m,).
    """
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.clip(values, 0.0, None))
    result = [np.zeros((0, 2))]
    chunk = 500  # poses at once: the Jacobian has a column per parameter
    for first in range(0, len(at), chunk):
        part = np.arange(first, min(first + chunk, len(at)))
        block = rows_of(cell, Block(at, station, np.broadcast_to(tool, len(at))), part)
        jacobian = target_jacobian(cell, predict(cell, block), free, station, block.tool, block.bases)
        spread = (root.T @ jacobian.reshape(len(free), -1)).reshape(len(root), 2, 3, len(part))
        result.append(np.sqrt(np.sum(spread**2, axis=(0, 2))).T)
    return np.concatenate(result)
