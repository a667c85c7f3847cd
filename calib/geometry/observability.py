"""Identifiable geometric parameters of a set of poses, and observation Jacobians of candidate poses.

Findings on the others: rank, parameters that merge with others or stay at their nominal, placements that are hardly
determined. The Jacobians are callables for pose selection (package `poses`); they pickle, so that it can run on several
processes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.poses.measurements import PoseMeasurements, Poses, Positions
from calib.errors import Finding, Unidentifiable, UsageError, finding, one_of, require
from calib.estimation.base_columns import ColumnSplit, split_columns
from calib.estimation.nonlinear import MOST_NUMBERS
from calib.geometry.installation import Installation, see
from calib.geometry.observation import Block, families, layout, observe, prepare, target_jacobian, whitened
from calib.geometry.weighing import GeometricFit
from calib.robot.chain import Chain, random_joints
from calib.robot.kinematics import element_jacobian, forward, joint_jacobian, twist_product
from calib.transforms import pose, to_quaternion

NEAR_PRIOR = 0.7  # ratio of a parameter's σ to that of its prior from which the data say little of it (our choice)
PLACES = {"station": "the placement of the instrument", "tool": "the mounting of the tool"}


def unidentified(found: GeometricFit) -> list[Finding]:
    """Return findings on the parameters and placements that a fit's poses do not identify, and on the rank."""
    if (split := found.split) is None:
        return _loose(found)
    values, rank = split.singular_values, split.rank
    below = float(values[rank]) if rank < len(values) else None
    known = {"rank": rank, "parameters": len(values), "tolerance": split.tolerance}
    first = finding("rank", last=values[rank - 1], next=below, **known)
    return [first, *_merged(found, split), *_at_nominal(found), *_loose(found)]


def _merged(found: GeometricFit, split: ColumnSplit, max_named: int = 4) -> list[Finding]:
    """Return findings on arm parameters that depend linearly on others, grouped by these others.

    `max_named`: parameters by which families of merged ones are distinguished.
    """
    table = layout(found.start)
    families: dict[object, tuple[list[str], list[str]]] = {}
    for column, dropped in enumerate(split.dropped):
        if table.kinds[found.candidates[dropped]] != "arm":
            continue
        key, into = None, list[str]()
        if dropped not in split.without_effect:
            weight = np.abs(split.coefficients[:, column])
            partners = found.candidates[split.kept[weight > 0.1 * weight.max()]]
            groups = {table.kinds[k] for k in partners}
            arm = tuple(table.names[k] for k in partners if table.kinds[k] == "arm")
            key = "station" in groups, "tool" in groups, arm[:max_named], len(arm)
            into = [*(PLACES[group] for group in PLACES if group in groups), *arm]
        families.setdefault(key, (into, []))[1].append(table.names[found.candidates[dropped]])
    return [
        finding("merged", names=names, into=into) if into else finding("no-effect", names=names)
        for into, names in families.values()
    ]


def _at_nominal(found: GeometricFit) -> list[Finding]:
    """Return a finding on base parameters of the arm that the data determine hardly better than the prior does."""
    if found.prior is None:
        return []
    table = layout(found.start)
    combinations = found.regrouping()
    # frames have no prior, and what merges with them is theirs
    spread = np.where(np.isfinite(found.prior), found.prior, 0.0)
    prior_sigma = np.sqrt((combinations**2) @ spread**2)
    base = found.base
    loose = (found.base_sigma() > NEAR_PRIOR * prior_sigma) & np.isin(base, table.index("arm")) & (prior_sigma > 0.0)
    names = [table.names[k] for k in base[loose]]
    return [finding("near-prior", names=names)] if names else []


def _loose(found: GeometricFit, max_placement_sigma: float = 2e-3) -> list[Finding]:
    """Return findings on tools with a poorly determined placement, with the station correlated with it.

    `max_placement_sigma`: [m] a placement known no better than this is worth a word (our choice).
    """
    estimate = found.estimate
    index = {name: k for k, name in enumerate(estimate.names)}
    result: list[Finding] = []
    min_orientation_range = 45.0  # [deg] below it "the wrist is held still" is the likely reason (our choice)
    for tool in found.cell.tool_names:
        own = [index[f"{tool}.{axis}"] for axis in "xyz" if f"{tool}.{axis}" in index]
        sigma = float(np.linalg.norm(estimate.sigma[own]))
        if own and sigma >= max_placement_sigma:
            spread = _orientation_range(found)
            still = spread if spread is not None and spread < min_orientation_range else None
            station = _confused(found, own, index)
            result.append(finding("loose-tool", tool=tool, sigma=sigma, station=station, still=still))
    return result


def _confused(found: GeometricFit, own: list[int], index: dict[str, int]) -> str:
    """Return the station whose estimate is correlated with the tool's (canonical correlation above 0.95); else ''."""
    covariance = found.estimate.covariance
    for station in found.cell.station_names:
        theirs = [k for name, k in index.items() if name.rsplit(".", 1)[0] == station]
        if not theirs:
            continue
        roots = [np.linalg.cholesky(covariance[np.ix_(part, part)]) for part in (own, theirs)]
        cross = np.linalg.solve(roots[0], covariance[np.ix_(own, theirs)])
        if np.linalg.norm(np.linalg.solve(roots[1], cross.T), 2) > 0.95:
            return station
    return ""


def _orientation_range(found: GeometricFit) -> float | None:
    """Return the range that holds 95 % of the flange's orientations [deg]; None without an instrument's poses."""
    q = [block.measured.q for block in found.blocks if block.measured.has_instrument]
    if not q:
        return None
    turns = Rotation.from_matrix(forward(found.cell.chain, np.concatenate(q))[:, :3, :3])
    return 2.0 * float(np.degrees(np.quantile((turns.mean().inv() * turns).magnitude(), 0.95)))


def observation_matrix(cell: Installation, blocks: Sequence[Block], columns: np.ndarray) -> np.ndarray:
    """Return the observation matrix W (rows, c) of all blocks, scaled by stated sigmas; else by the arm's reach.

    Of more than `MOST_NUMBERS` numbers its R factor instead, whose columns have the same dependences.

    The reach (rms distance of targets from the arm's base) makes orientation rows comparable with position rows.
    """
    rows = list[np.ndarray]()
    for block in blocks:
        scales = []
        for part in observe(cell, block, columns[:0]):
            scale = part.sigma
            if part.label == "pixel":
                scale = np.asarray(part.per_length)
            elif scale is None:
                scale = np.full(part.value.shape, 1.0 / _reach(cell) if part.label == "orientation" else 1.0)
            elif part.label != "orientation":
                scale = scale / np.median(scale)
            else:
                scale = scale / np.median(scale) / _reach(cell)
            scales.append(np.broadcast_to(scale, part.value.shape))
        for _, matrix in whitened(cell, block, columns, scales):
            rows.append(matrix)
            if sum(each.size for each in rows) > MOST_NUMBERS:
                rows = [np.asarray(np.linalg.qr(np.concatenate(rows), mode="r"))]
    return np.concatenate(rows)


def _reach(cell: Installation) -> float:
    """Return a typical length of the arm [m]: the sum of its constant offsets."""
    total = sum(abs(e.value) for e in cell.chain.elements if e.axis[0] == "t")
    total += sum(float(np.linalg.norm(e.placement[:3, 3])) for e in cell.chain.elements if e.placement is not None)
    return max(total, 0.1)


def _preference(cell: Installation, columns: np.ndarray) -> list[np.ndarray]:
    """Return groups of columns in order of preference: frames, joint offsets, rotations, translations, deflections.

    Frames come first, so that what cannot be distinguished from the installation (the first joint's placement, the last
    joint's offset) stays with the installation and the arm keeps its nominal there. Rotations before translations make
    Hayati's β win over an offset along parallel axes.
    """
    order = (("station", "tool", "optics"), ("offset",), ("rad",), ("m",), ("deflection",))
    return [np.flatnonzero(np.isin(families(cell)[columns], group)) for group in order]


def base_columns(
    cell: Installation, blocks: Sequence[Block], columns: np.ndarray, tolerance: float = 1e-5
) -> ColumnSplit:
    """Split candidate parameters into identifiable ones and those that depend on them; indices into `columns`."""
    return split_columns(observation_matrix(cell, blocks, columns), _preference(cell, columns), tolerance)


KINDS = (Poses.kind, Positions.kind)
SAMPLES = 300  # random postures that decide what is identifiable
SIGMA_POSITION, SIGMA_ORIENTATION = 1e-4, 1e-4  # [m], [rad]: our choice where none is stated


@dataclass(frozen=True, eq=False)
class Observation:
    """Whitened observation Jacobian in base columns: q (m, n) -> (m, rows, p).

    Attributes:
        cell: the nominal arm, its base at the instrument's origin, with its targets; rigid.
        full: whether orientations are measured, too: six rows per target instead of three.
        free: (p,) indices of the identifiable parameters in the full vector.
        sigmas: of a position [m] and of an orientation [rad].
    """

    cell: Installation
    full: bool
    free: np.ndarray
    sigmas: tuple[float, float] = (SIGMA_POSITION, SIGMA_ORIENTATION)

    def __call__(self, q: np.ndarray) -> np.ndarray:
        rows = []
        for number in range(len(self.cell.tools)):
            seen = see(self.cell, q, 0, number)
            jacobian = target_jacobian(self.cell, seen, self.free, 0, np.full(len(q), number))
            rows.append(jacobian[:, :3] / self.sigmas[0])
            if self.full:
                rows.append(jacobian[:, 3:] / self.sigmas[1])
        return np.concatenate(rows, axis=1).transpose(2, 1, 0)

    def position(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the position of the first target (m, 3) [m] and its unwhitened Jacobian (m, 3, p)."""
        return see(self.cell, q).point.T, self(q)[:, :3] * self.sigmas[0]

    def product(self, q: np.ndarray, G: np.ndarray) -> np.ndarray:
        """Return Σ G[i] · ∂J[i]/∂q (m, n) for weights G (m, rows, p) of the whitened Jacobian; exact."""
        chain, count = self.cell.chain, len(self.cell.chain.elements)
        in_station = np.isin(self.free, layout(self.cell).index("station"))
        places = np.where(self.free < count, self.free, np.where(in_station, -1, count))
        weights, result = G.transpose(2, 1, 0), np.zeros((chain.n, len(q)))
        rows = 6 if self.full else 3
        for number in range(len(self.cell.tools)):
            seen = see(self.cell, q, 0, number)
            columns = target_jacobian(self.cell, seen, self.free, 0, np.full(len(q), number))
            weight = np.zeros(columns.shape)
            for first, sigma in zip(range(0, rows, 3), self.sigmas):
                at = rows * number + first
                weight[:, first : first + 3] = weights[:, at : at + 3] / sigma
            elements = element_jacobian(chain, seen.walked, seen.point)
            result += twist_product(chain, elements, columns, places, weight)
        return result.T


@dataclass(frozen=True, eq=False)
class Target:
    """Pose of a target in the arm's base: q (m, n) -> rotation (m, 3, 3), position (m, 3) [m]."""

    cell: Installation
    number: int = 0

    def __call__(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        poses = see(self.cell, q, 0, self.number).poses()
        return poses[:, :3, :3], poses[:, :3, 3]


@dataclass(frozen=True, eq=False)
class TargetJacobian:
    """Velocity and angular velocity of a target per joint velocity: q (m, n) -> (m, 6, n)."""

    cell: Installation
    number: int = 0

    def __call__(self, q: np.ndarray) -> np.ndarray:
        seen = see(self.cell, q, 0, self.number)
        return joint_jacobian(self.cell.chain, seen.walked, seen.point)


def targets_of(chain: Chain, tools: Sequence[Sequence[float]] = ()) -> Installation:
    """Return the arm with targets at places (3,) [m] in the tip's frame; one at the tip if none are given."""
    places = [np.asarray(tool, dtype=float) for tool in tools] or [np.zeros(3)]
    names = tuple(f"tool {k + 1}" for k in range(len(places))) if len(places) > 1 else ("tool",)
    return Installation(chain, tools=np.array([pose(None, place) for place in places]), tool_names=names)


def observation(
    cell: Installation, kind: str = "pose", sigmas: tuple[float, float] | None = None, seed: int = 0
) -> Observation:
    """Return the observation Jacobian of a nominal arm, for the parameters that random postures can identify.

    Args:
        cell: see `targets_of`.
        kind: ``pose`` or ``position``.
        sigmas: of a position [m] and an orientation [rad].
        seed: of the postures.
    """
    one_of(kind, KINDS, "kind", UsageError)
    full = kind == Poses.kind
    q = random_joints(cell.chain, SAMPLES, seed)
    blocks = prepare(cell, [_measured(q, cell, number, full) for number in range(len(cell.tools))])
    columns = np.arange(len(layout(cell).names))
    if not full:  # a point has no orientation of its own
        turns = [k for k in layout(cell).index("tool") if layout(cell).units[k] == "rad"]
        columns = np.setdiff1d(columns, turns)
    split = base_columns(cell, blocks, columns)
    require(split.rank, f"robot '{cell.chain.name}': no parameter affects the measured quantities", Unidentifiable)
    return Observation(cell, full, columns[split.kept], sigmas or (SIGMA_POSITION, SIGMA_ORIENTATION))


def _measured(q: np.ndarray, cell: Installation, number: int, full: bool) -> Positions:
    """Return noise-free measurements of one target at joint values q (m, n)."""
    poses = see(cell, q, 0, np.full(len(q), number)).poses()
    return PoseMeasurements.of(
        q,
        poses[:, :3, 3],
        to_quaternion(poses) if full else None,
        joint_names=cell.chain.joint_names,
        tool_names=(cell.tool_names[number],),
        station=cell.station_names[0],
    )
