"""Identifiable geometric parameters of a set of poses, and observation Jacobians of candidate poses.

Findings are made on parameters that are not identifiable: the rank, parameters that cannot be distinguished from others
or stay at their nominal value, and placements that are poorly determined. The observation Jacobians are callables for
the selection of poses (package `poses`). They can be pickled, so that the selection can run in several processes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.poses.measurements import PoseMeasurements, Poses, Positions
from calib.errors import Finding, Unidentifiable, UsageError, finding, one_of, require
from calib.estimation.base_columns import ColumnSplit, split_columns
from calib.estimation.nonlinear import MOST_NUMBERS
from calib.geometry.installation import Installation, Seen, see
from calib.geometry.observation import Block, families, layout, observe, prepare, target_jacobian, whitened
from calib.geometry.weighing import GeometricFit
from calib.robot.chain import Chain, random_joints
from calib.robot.kinematics import element_jacobian, forward, joint_jacobian, twist_product
from calib.transforms import pose, to_quaternion

# ratio of a parameter's σ to that of its prior above which the data hardly determine it (our choice)
NEAR_PRIOR = 0.7
# a parameter depends on another if its coefficient is at least this share of its largest coefficient (our choice)
MIN_SHARE = 0.1
# largest number of parameters named to distinguish groups of dependent parameters
MAX_NAMED = 4
# standard deviation of a tool's position above which a finding is reported [m] (our choice)
MAX_PLACEMENT_SIGMA = 2e-3
# range of orientations [deg] below which a still wrist is the likely reason (our choice)
MIN_ORIENTATION_RANGE = 45.0
# canonical correlation of a tool's and a station's placement above which they cannot be separated (our choice)
MAX_CORRELATION = 0.95
# smallest typical length of an arm [m]
MIN_REACH = 0.1
# kinds of measurement for which poses can be selected
KINDS = (Poses.kind, Positions.kind)
# number of random postures by which identifiable parameters are determined
SAMPLES = 300
# default standard deviations of a position [m] and of an orientation [rad] (our choice)
SIGMA_POSITION = 1e-4
SIGMA_ORIENTATION = 1e-4
PLACES = {"station": "the placement of the instrument", "tool": "the mounting of the tool"}


def unidentified(fit: GeometricFit) -> list[Finding]:
    """Return findings on the rank, and on the parameters and placements that the poses of `fit` do not identify."""
    split = fit.split
    if split is None:
        return _loose(fit)
    values = split.singular_values
    rank = split.rank
    below = None
    if rank < len(values):
        below = float(values[rank])
    numbers = {"rank": rank, "parameters": len(values), "tolerance": split.tolerance}
    on_rank = finding("rank", last=values[rank - 1], next=below, **numbers)
    return [on_rank, *_merged(fit, split), *_at_nominal(fit), *_loose(fit)]


def _merged(fit: GeometricFit, split: ColumnSplit) -> list[Finding]:
    """Return findings on arm parameters that depend linearly on other parameters, grouped by these other parameters.

    Args:
        fit: the fit.
        split: its candidate parameters, split into base parameters and dependent ones.
    """
    table = layout(fit.start)
    # per group: what they merge with, and their names
    groups: dict[object, tuple[list[str], list[str]]] = {}
    for column, dropped in enumerate(split.dropped):
        parameter = fit.candidates[dropped]
        if table.kinds[parameter] != "arm":
            continue
        key = None
        partners: list[str] = []
        if dropped not in split.without_effect:
            weight = np.abs(split.coefficients[:, column])
            merged_with = fit.candidates[split.kept[weight > MIN_SHARE * weight.max()]]
            kinds = {table.kinds[k] for k in merged_with}
            arm = tuple(table.names[k] for k in merged_with if table.kinds[k] == "arm")
            key = "station" in kinds, "tool" in kinds, arm[:MAX_NAMED], len(arm)
            partners = [PLACES[kind] for kind in PLACES if kind in kinds]
            partners += arm
        groups.setdefault(key, (partners, []))[1].append(table.names[parameter])
    findings = []
    for partners, names in groups.values():
        if partners:
            findings.append(finding("merged", names=names, into=partners))
        else:
            findings.append(finding("no-effect", names=names))
    return findings


def _at_nominal(fit: GeometricFit) -> list[Finding]:
    """Return a finding on base parameters of the arm in `fit` that the data determine hardly better than the prior."""
    if fit.prior is None:
        return []
    table = layout(fit.start)
    combinations = fit.regrouping()
    # frames have no prior, and what merges with them is theirs
    spread = np.where(np.isfinite(fit.prior), fit.prior, 0.0)
    prior_sigma = np.sqrt((combinations**2) @ spread**2)
    base = fit.base
    in_arm = np.isin(base, table.index("arm"))
    near_prior = fit.base_sigma() > NEAR_PRIOR * prior_sigma
    loose = near_prior & in_arm & (prior_sigma > 0.0)
    names = [table.names[k] for k in base[loose]]
    if not names:
        return []
    return [finding("near-prior", names=names)]


def _loose(fit: GeometricFit) -> list[Finding]:
    """Return findings on tools whose placement is poorly determined, with the station with which it is correlated.

    Args:
        fit: the fit, whose covariance is examined.
    """
    estimate = fit.estimate
    index = {name: k for k, name in enumerate(estimate.names)}
    findings: list[Finding] = []
    for tool in fit.cell.tool_names:
        names = [f"{tool}.{axis}" for axis in "xyz"]
        position = [index[name] for name in names if name in index]
        sigma = float(np.linalg.norm(estimate.sigma[position]))
        if not position or sigma < MAX_PLACEMENT_SIGMA:
            continue
        still = _orientation_range(fit)
        if still is not None and still >= MIN_ORIENTATION_RANGE:
            still = None
        station = _confused(fit, position, index)
        findings.append(finding("loose-tool", tool=tool, sigma=sigma, station=station, still=still))
    return findings


def _confused(fit: GeometricFit, position: list[int], index: dict[str, int]) -> str:
    """Return the name of the station whose estimate is correlated with the tool's position; empty if there is none.

    Args:
        fit: the fit.
        position: indices of the tool's position among the estimates.
        index: index of every estimate, by name.
    """
    covariance = fit.estimate.covariance
    for station in fit.cell.station_names:
        placement = [k for name, k in index.items() if name.rsplit(".", 1)[0] == station]
        if not placement:
            continue
        root = np.linalg.cholesky(covariance[np.ix_(position, position)])
        station_root = np.linalg.cholesky(covariance[np.ix_(placement, placement)])
        cross = np.linalg.solve(root, covariance[np.ix_(position, placement)])
        canonical_correlation = np.linalg.norm(np.linalg.solve(station_root, cross.T), 2)
        if canonical_correlation > MAX_CORRELATION:
            return station
    return ""


def _orientation_range(fit: GeometricFit) -> float | None:
    """Return the range that contains 95 % of the flange's orientations [deg].

    None where no poses were measured by an instrument.

    Args:
        fit: the fit, whose blocks contain the measured poses.
    """
    q = [block.measured.q for block in fit.blocks if block.measured.has_instrument]
    if not q:
        return None
    rotations = Rotation.from_matrix(forward(fit.cell.chain, np.concatenate(q))[:, :3, :3])
    angles = (rotations.mean().inv() * rotations).magnitude()
    return 2.0 * float(np.degrees(np.quantile(angles, 0.95)))


def observation_matrix(cell: Installation, blocks: Sequence[Block], columns: np.ndarray) -> np.ndarray:
    """Return the observation matrix W (rows, c) of all blocks for the parameters `columns` (c,).

    Rows are divided by their stated sigmas relative to the sigmas' median. Orientation rows are multiplied by a typical
    length of the arm, which makes them comparable with position rows. If W has more than `MOST_NUMBERS` numbers, the R
    factor of its QR decomposition is returned instead, whose columns have the same linear dependences.

    Args:
        cell: the installation of arm, stations and tools.
        blocks: the prepared measurements.
        columns: (c,) indices in the full parameter vector.
    """
    rows: list[np.ndarray] = []
    for block in blocks:
        scales = []
        for part in observe(cell, block, columns[:0]):
            if part.label == "pixel":
                scale = np.asarray(part.per_length)
            else:
                scale = np.ones(part.value.shape)
                if part.sigma is not None:
                    scale = part.sigma / np.median(part.sigma)
                if part.label == "orientation":
                    scale = scale / _reach(cell)
            scales.append(np.broadcast_to(scale, part.value.shape))
        for _, matrix in whitened(cell, block, columns, scales):
            rows.append(matrix)
            if sum(matrix.size for matrix in rows) > MOST_NUMBERS:
                rows = [np.asarray(np.linalg.qr(np.concatenate(rows), mode="r"))]
    return np.concatenate(rows)


def _reach(cell: Installation) -> float:
    """Return a typical length of the arm in `cell` [m]: the sum of the constant lengths along its chain."""
    lengths = 0.0
    offsets = 0.0
    for element in cell.chain.elements:
        if element.axis[0] == "t":
            lengths += abs(element.value)
        if element.placement is not None:
            offsets += float(np.linalg.norm(element.placement[:3, 3]))
    return max(lengths + offsets, MIN_REACH)


def _preference(cell: Installation, columns: np.ndarray) -> list[np.ndarray]:
    """Return groups of columns in the order in which they are preferred as base parameters.

    The order is placements, joint offsets, rotations, translations, deflections. Placements are first. Parameters that
    cannot be distinguished from the placements (those before the first joint, the last joint's offset) are then
    represented by the placements, and the arm keeps its nominal values. Rotations are before translations so that, at
    parallel axes, Hayati's β is preferred to an offset along the axes.

    Args:
        cell: the installation.
        columns: indices in the full parameter vector; the groups are positions in this array.
    """
    order = (("station", "tool", "optics"), ("offset",), ("rad",), ("m",), ("deflection",))
    return [np.flatnonzero(np.isin(families(cell)[columns], group)) for group in order]


def base_columns(
    cell: Installation, blocks: Sequence[Block], columns: np.ndarray, tolerance: float = 1e-5
) -> ColumnSplit:
    """Return the split of the parameters `columns` into base (identifiable) ones and ones that depend on them.

    The split's indices refer to `columns`.

    Args:
        cell: the installation.
        blocks: prepared measurements.
        columns: (c,) indices of the candidate parameters.
        tolerance: norm of a column's independent part, relative to the column, below which it counts as dependent.
    """
    return split_columns(observation_matrix(cell, blocks, columns), _preference(cell, columns), tolerance)


@dataclass(frozen=True, eq=False)
class Observation:
    """Whitened observation Jacobian by the base parameters: q (m, n) -> (m, rows, p).

    Attributes:
        cell: the rigid nominal arm with its targets; its base is at the instrument's origin.
        full: True: positions and orientations are measured (six rows per target); False: positions only (three rows).
        free: (p,) indices of the identifiable parameters in the full vector.
        sigmas: standard deviations of a position [m] and of an orientation [rad].
        reference: whether a frame at the arm's base is measured beside the target, with the same sigmas, so that the
            noise of both counts.
    """

    cell: Installation
    full: bool
    free: np.ndarray
    sigmas: tuple[float, float] = (SIGMA_POSITION, SIGMA_ORIENTATION)
    reference: bool = False

    def __call__(self, q: np.ndarray) -> np.ndarray:
        rows = []
        bases = self.bases(q)
        for number in range(len(self.cell.tools)):
            seen = see(self.cell, q, 0, number, bases)
            jacobian = target_jacobian(self.cell, seen, self.free, 0, np.full(len(q), number), bases)
            sigma = self._sigma(seen.point)
            rows.append(jacobian[:, :3] / sigma[:3])
            if self.full:
                rows.append(jacobian[:, 3:] / sigma[3:])
        return np.concatenate(rows, axis=1).transpose(2, 1, 0)

    def bases(self, q: np.ndarray) -> np.ndarray | None:
        """Return the basis functions (E, m) of the cell's joint corrections at q (m, n); None: it has none."""
        return None

    def _sigma(self, point: np.ndarray) -> np.ndarray:
        """Return the standard deviations (6, m) of positions [m] and orientations [rad] of a target.

        With a reference frame, σ_x² = 2 σ_p² + σ_r² (l_y² + l_z²) and so on, l the target seen from the arm's base.

        Args:
            point: (3, m) positions of the target [m].
        """
        sigma = np.repeat(self.sigmas, 3)[:, None] * np.ones(point.shape[1])
        if not self.reference:
            return sigma
        squares = 2.0 * sigma**2
        squares[:3] += self.sigmas[1] ** 2 * (np.sum(point**2, axis=0) - point**2)
        return np.sqrt(squares)

    def position(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the position of the first target (m, 3) [m] and its unwhitened Jacobian (m, 3, p).

        Args:
            q: (m, n) joint values [rad or m].
        """
        point = see(self.cell, q, bases=self.bases(q)).point
        sigma = self._sigma(point)[:3]
        return point.T, self(q)[:, :3] * sigma.T[:, :, None]

    def product(self, q: np.ndarray, G: np.ndarray) -> np.ndarray:
        """Return Σ G[i] · ∂J[i]/∂q (m, n) for weights G (m, rows, p) of the whitened Jacobian J, in closed form.

        Args:
            q: (m, n) joint values [rad or m].
            G: (m, rows, p) weights of the entries of J.
        """
        chain = self.cell.chain
        count = len(chain.elements)
        # element of each parameter; -1 for the station, behind the last element for tools
        places = np.full(len(self.free), count)
        places[np.isin(self.free, layout(self.cell).index("station"))] = -1
        in_arm = self.free < count
        places[in_arm] = self.free[in_arm]
        weights = G.transpose(2, 1, 0)
        rows = 6 if self.full else 3
        result = np.zeros((chain.n, len(q)))
        for number in range(len(self.cell.tools)):
            seen = see(self.cell, q, 0, number)
            columns = target_jacobian(self.cell, seen, self.free, 0, np.full(len(q), number))
            sigma = self._sigma(seen.point)[:rows]
            weight = np.zeros(columns.shape)
            weight[:, :rows] = weights[:, rows * number : rows * (number + 1)] / sigma
            elements = element_jacobian(chain, seen.walked, seen.point)
            result += twist_product(chain, elements, columns, places, weight)
            if self.reference:
                result -= self._noise_product(seen, columns, weight, sigma)
        return result.T

    def _noise_product(self, seen: Seen, columns: np.ndarray, weight: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        """Return the part (n, m) of `product` from the growth of noise with the distance to the reference frame.

        Args:
            seen: the target at the m postures.
            columns: (p, 6, m) Jacobian.
            weight: (p, 6, m) weights of the Jacobian, divided by the sigmas.
            sigma: (rows, m) standard deviations.
        """
        # of a relative change of σ_x, σ_y, σ_z
        share = np.sum(weight[:, :3] * columns[:, :3], axis=0) / sigma[:3] ** 2
        # σ_x dσ_x = σ_r² (l_y dl_y + l_z dl_z)
        pull = self.sigmas[1] ** 2 * seen.point * (share.sum(axis=0) - share)
        velocities = joint_jacobian(self.cell.chain, seen.walked, seen.point)[:, :3]
        return np.einsum("mxn,xm->nm", velocities, pull)


@dataclass(frozen=True, eq=False)
class TargetPose:
    """Pose of a target in the arm's base: q (m, n) -> rotation (m, 3, 3), position (m, 3) [m]."""

    cell: Installation
    number: int = 0

    def __call__(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        poses = see(self.cell, q, 0, self.number).poses()
        return poses[:, :3, :3], poses[:, :3, 3]


@dataclass(frozen=True, eq=False)
class TargetJacobian:
    """Jacobian of a target in the arm's base: q (m, n) -> (m, 6, n), [v; ω] per joint velocity."""

    cell: Installation
    number: int = 0

    def __call__(self, q: np.ndarray) -> np.ndarray:
        seen = see(self.cell, q, 0, self.number)
        return joint_jacobian(self.cell.chain, seen.walked, seen.point)


def targets_of(chain: Chain, tools: Sequence[Sequence[float]] = ()) -> Installation:
    """Return the arm with targets at the positions `tools` (3,) [m] in the tip's frame; empty for one target at the
    tip.

    Args:
        chain: the arm.
        tools: positions of the targets.
    """
    positions = [np.asarray(tool, dtype=float) for tool in tools] or [np.zeros(3)]
    names = ("tool",)
    if len(positions) > 1:
        names = tuple(f"tool {number}" for number in range(1, len(positions) + 1))
    placements = np.array([pose(None, position) for position in positions])
    return Installation(chain, tools=placements, tool_names=names)


def observation(
    cell: Installation,
    kind: str = "pose",
    sigmas: tuple[float, float] | None = None,
    seed: int = 0,
    reference: bool = False,
) -> Observation:
    """Return the observation Jacobian of a nominal arm, for the parameters that random postures can identify.

    Args:
        cell: the arm with its targets, as returned by `targets_of`.
        kind: kind of measurement, ``pose`` or ``position``.
        sigmas: standard deviations of a position [m] and an orientation [rad]; None for the defaults.
        seed: seed of the postures.
        reference: whether a frame at the arm's base is measured beside the target.

    Raises:
        UsageError: an unknown kind.
        Unidentifiable: no parameter affects the measured quantities.
    """
    one_of(kind, KINDS, "kind", UsageError)
    full = kind == Poses.kind
    q = random_joints(cell.chain, SAMPLES, seed)
    blocks = prepare(cell, [_measured(q, cell, number, full) for number in range(len(cell.tools))])
    table = layout(cell)
    columns = np.arange(len(table.names))
    if not full:
        # a point has no orientation of its own
        turns = [k for k in table.index("tool") if table.units[k] == "rad"]
        columns = np.setdiff1d(columns, turns)
    split = base_columns(cell, blocks, columns)
    require(split.rank, f"robot '{cell.chain.name}': no parameter affects the measured quantities", Unidentifiable)
    return Observation(cell, full, columns[split.kept], sigmas or (SIGMA_POSITION, SIGMA_ORIENTATION), reference)


def _measured(q: np.ndarray, cell: Installation, number: int, full: bool) -> Positions:
    """Return noise-free measurements of target `number` at joint values q (m, n).

    Orientations are included if `full`.

    Args:
        q: (m, n) joint values [rad or m].
        cell: the installation, whose predictions are the measurements.
        number: index of the target.
        full: whether orientations are measured, too.
    """
    poses = see(cell, q, 0, np.full(len(q), number)).poses()
    quaternion = None
    if full:
        quaternion = to_quaternion(poses)
    return PoseMeasurements.of(
        q,
        poses[:, :3, 3],
        quaternion,
        joint_names=cell.chain.joint_names,
        tool_names=(cell.tool_names[number],),
        station=cell.station_names[0],
    )
