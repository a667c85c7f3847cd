"""The observation matrix of an installation: residual parts and their Jacobian for every block of measurements.

With it the covariance of a fit's parameters is propagated to the tool's pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.data.poses.measurements import PoseMeasurements
from calib.errors import UsageError, require
from calib.geometry.installation import Installation, Seen, see
from calib.geometry.parameters import layout_counts
from calib.geometry.residuals import Part, parts
from calib.robot.calibrated import evaluate, extra_displacements, target_elements
from calib.robot.kinematics import element_jacobian


@dataclass(frozen=True, eq=False)
class Block:
    """Measurements prepared for evaluation with an installation (arm, stations, tools).

    Attributes:
        measured: m rows.
        station: index of their station; -1 for kinds without an instrument, which refer to the arm's base.
        tool: (m,) index of each row's target among the installation's tools.
        torque: (m, n) gravity torques [N m], or None.
        bases: (E, m) the deflection's bases, evaluated once.
        given: (K, m) displacements by the known deflections, or None.
    """

    measured: PoseMeasurements
    station: int
    tool: np.ndarray
    torque: np.ndarray | None = None
    bases: np.ndarray | None = None
    given: np.ndarray | None = None


def prepare(
    cell: Installation, measured: Sequence[PoseMeasurements], torques: Sequence[np.ndarray | None] | None = None
) -> list[Block]:
    """Return blocks of measurements matched to stations and tools by name, with evaluated deflection bases.

    Raises:
        UsageError: for a station or tool the installation does not have.
    """
    blocks = []
    for number, block in enumerate(measured):
        torque = torques[number] if torques is not None else None
        station = _index(cell.station_names, block.station, "station") if block.has_instrument else -1
        tools = np.array([_index(cell.tool_names, name, "tool") for name in block.tool_names])
        blocks.append(_ready(cell, block, station, tools[block.tool], torque))
    return blocks


def _ready(
    cell: Installation, measured: PoseMeasurements, station: int, tool: np.ndarray, torque: np.ndarray | None
) -> Block:
    bases = evaluate(cell.deflection, measured.q, torque) if cell.deflection.terms else None
    known = evaluate(cell.known, measured.q, torque) if cell.known.terms else None
    given = extra_displacements(cell.chain, cell.known, measured.q, known)
    return Block(measured, station, tool, torque, bases, given)


def _index(names: tuple[str, ...], name: str, what: str) -> int:
    require(name in names, f"{what} '{name}' is not part of the installation; it has {', '.join(names)}", UsageError)
    return names.index(name)


def predict(cell: Installation, block: Block) -> Seen:
    """Return the predicted targets of a block in the instrument's frame."""
    return see(cell, block.measured.q, block.station, block.tool, block.bases, block.given)


def observe(cell: Installation, block: Block, free: np.ndarray) -> list[Part]:
    """Return the residual parts of a block with their Jacobian with respect to the parameters `free` (f,)."""
    seen = predict(cell, block)
    if len(cell.optics):
        seen = replace(seen, view=cell.optics.view(block.measured, free - sum(layout_counts(cell)[:3])))
    return parts(block.measured, seen, target_jacobian(cell, seen, free, block.station, block.tool, block.bases))


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
        jacobian[in_terms] = moved[inverse] * bases[numbers][:, None, :]
    return jacobian


def _station_column(column: np.ndarray, placement: np.ndarray, seen: Seen, axis: int) -> None:
    """Fill the column (6, m) of a unit displacement of a station along or about one of its own axes."""
    direction = placement[:3, axis % 3]
    if axis < 3:
        column[:3] = direction[:, None]
    else:
        lever = (seen.point - placement[:3, 3:4]).T
        column[:3] = np.cross(direction, lever).T
        column[3:] = direction[:, None]


def stack(found: Sequence[Part], sigmas: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Whiten and stack parts into r (rows,) and a column-major W (rows, f).

    Args:
        found: parts of all blocks.
        sigmas: one array per part, broadcastable to its value (rows, m).
    """
    edges = np.cumsum([0, *(part.height for part in found)])
    residual, matrix = np.empty(edges[-1]), np.empty((len(found[0].jacobian), edges[-1]))
    for part, sigma, start, stop in zip(found, sigmas, edges, edges[1:]):
        part.fill(residual[start:stop], matrix[:, start:stop], sigma)
    return residual, matrix.T


def pose_sigmas(
    cell: Installation,
    q: np.ndarray,
    free: np.ndarray,
    covariance: np.ndarray,
    torque: np.ndarray | None = None,
    station: int = 0,
    tool: np.ndarray | int = 0,
) -> np.ndarray:
    """Return sigmas (m, 2) of a tool's position [m] and orientation [rad]: sqrt(trace J Σ Jᵀ) of each.

    Args:
        cell: the fitted installation.
        q: (m, n) [rad or m].
        free: (f,) positions in the parameter vector (`calib.geometry.parameters`).
        covariance: (f, f) of steps along them.
        torque: (m, n) gravity torques [N m], for compliance terms.
        station: index of the station of reference; -1 for the arm's base.
        tool: which of its tools, one or (m,).
    """
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.clip(values, 0.0, None))
    result = [np.zeros((0, 2))]
    chunk = 500  # poses at once: the Jacobian has a column per parameter
    for first in range(0, len(q), chunk):
        rows = slice(first, first + chunk)
        own = PoseMeasurements(q[rows], cell.chain.joint_names)
        pulled = None if torque is None else torque[rows]
        block = _ready(cell, own, station, np.broadcast_to(tool, len(q))[rows], pulled)
        jacobian = target_jacobian(cell, predict(cell, block), free, station, block.tool, block.bases)
        spread = (root.T @ jacobian.reshape(len(free), -1)).reshape(len(root), 2, 3, len(own))
        result.append(np.sqrt(np.sum(spread**2, axis=(0, 2))).T)
    return np.concatenate(result)
