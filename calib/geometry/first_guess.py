"""First guess of the instrument's and the target's placement, in closed form from the measurements.

With the arm's poses A_i = (R_i, a_i) from the nominal chain:

* full pose  B_i = S A_i X: rotations by Shah (2013, "Solving the robot-world/hand-eye calibration problem using the
  Kronecker product"), then the two translations linearly; or, where poses hold nearly one orientation, which leaves
  these open, by turns and ways together;
* position   S⁻¹ y_i = R_i t + a_i: linear in S's rotation (9 numbers), its offset and t; the 9 are projected on SO(3);
* sockets    R_i t + a_i constant within each group: linear in t;
* images     as the room for cameras registers it.

Each guess then gets a few robust Gauss–Newton steps on the frames alone (`calib.geometry.fit`).

The nominal arm also shows units and orientations that cannot be right. A quaternion read in another order is still a
quaternion, and of two rows the angle |log R_iᵀ R_j| = 2 acos |q_i · q_j| does not depend on the order. But to move the
w is an odd permutation, a reflection of the quaternions' sphere, so that what is read is P R_iᵀ Q with constant P, Q:
an inverse, which no placement S, X brings to the arm's S A_i X.
"""

import math
from collections.abc import Callable, Sequence
from functools import singledispatch
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.poses.measurements import KINDS, PoseMeasurements, Poses, Positions, Sockets, take
from calib.errors import refuse_data
from calib.extensions import Point
from calib.geometry.installation import Installation, NoOptics
from calib.records import evenly
from calib.robot.calibrated import Deflection
from calib.robot.chain import Chain
from calib.robot.kinematics import forward
from calib.transforms import from_quaternion, invert, orthonormal, pose
from calib.units import DEG

if TYPE_CHECKING:
    from calib.data.images.optics import Optics

OPTICS: "Point[Callable[[Sequence[Any]], Optics]]" = Point(
    "optics", "optics of kinds that are not the core's; loading it registers guesses and residuals"
)

LEVER = 0.3  # what a turn counts as [m/rad] (our choice, as the next two)


def misfit(arm: np.ndarray, seen: np.ndarray, station: np.ndarray, tool: np.ndarray, lever: float) -> np.ndarray:
    """Return the distances (m,) [m] between measured poses B_i and predicted poses S A_i X of the target."""
    distance, turn = _apart(station @ arm @ tool, seen)
    return np.hypot(distance, lever * turn)


def _apart(predicted: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance (m,) [m] and the angle (m,) [rad] between poses (m, 4, 4)."""
    turn = Rotation.from_matrix(np.swapaxes(predicted[:, :3, :3], 1, 2) @ seen[:, :3, :3]).magnitude()
    return np.linalg.norm(predicted[:, :3, 3] - seen[:, :3, 3], axis=1), turn


def average_pose(poses: np.ndarray) -> np.ndarray:
    """Return the mean (4, 4) of poses (m, 4, 4): chordal mean of the rotations, median of the positions."""
    return pose(orthonormal(poses[:, :3, :3].mean(axis=0)), np.median(poses[:, :3, 3], axis=0))


def place_pose(arm: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Solve B_i = S A_i X for S and X: by orientations (Shah 2013) or rotations and displacements; the better of both.

    Args:
        arm: (m, 4, 4) poses A_i of the tip in the base.
        seen: (m, 4, 4) poses B_i of the target in the station's frame.

    Returns:
        station (4, 4) and tool (4, 4).
    """
    placed = [by_orientations(arm, seen), _by_ways(arm, seen)]
    return min(placed, key=lambda each: float(np.median(misfit(arm, seen, *each, LEVER))))


def by_orientations(arm: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return S and X by Shah's method: accurate if the poses rotate about two axes by much more than their errors."""
    a, b = arm[:, :3, :3], seen[:, :3, :3]
    # vec(R_S R_A R_X) = vec(R_B): the sum of R_B ⊗ R_A has vec(R_S) and vec(R_X) as its first singular pair
    kernel = np.einsum("mij,mkl->ikjl", b, a).reshape(9, 9)
    u, _, vt = np.linalg.svd(kernel)
    station_rotation, tool_transposed = u[:, 0].reshape(3, 3), vt[0].reshape(3, 3)
    station_rotation = orthonormal(station_rotation * np.sign(np.linalg.det(station_rotation)))
    tool_rotation = orthonormal(tool_transposed * np.sign(np.linalg.det(tool_transposed))).T
    station, offset = _translations(arm, seen[:, :3, 3], station_rotation)
    return pose(station_rotation, station), pose(tool_rotation, offset)


def _by_ways(arm: np.ndarray, seen: np.ndarray, rounds: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Return S and X from rotations and displacements about the mean: accurate for a line with one orientation.

    log(R_B,i R̄_Bᵀ) = R_S log(R_A,i R̄_Aᵀ), the chordal means being turned in the same way, and
    y_i - ȳ = R_S (a_i - ā + (R_i - R̄) t): R_S by Kabsch on both, turns at a lever of `LEVER`, and t by its linear
    solution, in turns.

    `rounds`: rounds of rotation and offset.
    """
    (a, turns), (b, seen_turns) = (chordal_turns(poses[:, :3, :3]) for poses in (arm, seen))
    station, offset, rotation = np.zeros(3), np.zeros(3), np.eye(3)
    for _ in range(rounds):
        ways = arm[:, :3, 3] + arm[:, :3, :3] @ offset
        one = np.concatenate([ways - ways.mean(axis=0), LEVER * turns])
        two = np.concatenate([seen[:, :3, 3] - seen[:, :3, 3].mean(axis=0), LEVER * seen_turns])
        rotation = Rotation.align_vectors(two, one)[0].as_matrix()
        station, offset = _translations(arm, seen[:, :3, 3], rotation)
    return pose(rotation, station), pose((rotation @ a).T @ b, offset)


def chordal_turns(rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the chordal mean (3, 3) of rotations (m, 3, 3), and their rotation vectors (m, 3) from it."""
    mean = orthonormal(rotations.mean(axis=0))
    return mean, Rotation.from_matrix(rotations @ mean.T).as_rotvec()


def _translations(arm: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return p_S (3,) and t (3,) of  y_i - R_S a_i = R_S R_i t + p_S; poorly identifiable components of t are 0."""
    turned, target = rotation @ arm[:, :3, :3], position - arm[:, :3, 3] @ rotation.T
    away = turned - turned.mean(axis=0)
    u, size, vt = np.linalg.svd(away.reshape(-1, 3), full_matrices=False)
    min_turn = 0.01  # rms turn [rad] below which it tells no offset of the target
    strong = size > min_turn * np.sqrt(len(arm))
    offset = vt[strong].T @ ((u[:, strong].T @ (target - target.mean(axis=0)).reshape(-1)) / size[strong])
    return (target - turned @ offset).mean(axis=0), offset


def check_orientations(chain: Chain, block: PoseMeasurements) -> None:
    """Raise an error for quaternions in another order than the header's, and for inverted orientations.

    Args:
        chain: the nominal arm.
        block: measurements of any kind; only full poses are checked.

    Raises:
        MeasurementError: if the orientations contradict the arm as read, and agree in another reading.
    """
    if not isinstance(block, Poses):
        return
    rows = np.flatnonzero(block.tool == np.argmax(np.bincount(block.tool)))
    max_rows = 200  # how many are looked at; our choice
    rows = rows[evenly(len(rows), max_rows)]
    arm, position, stated = forward(chain, block.q[rows]), block.position[rows], block.quaternion[rows]
    min_angle = 20.0  # median misfit [deg] from which on the file's orientations are not what they are said to be
    if len(rows) < 4 or (found := _misfit(arm, position, stated)[0]) <= min_angle:
        return
    readings = {
        "read as w x y z they agree. If w comes first, name the columns in that order: qw, qx, qy, qz": np.roll(
            stated, -1, axis=1
        ),
        "inverted they agree. Give the orientation of the target in the instrument's frame": stated * [-1, -1, -1, 1],
    }
    max_misfit = 0.1  # of the positions' spread: their median misfit then
    max_angle = 5.0  # and below which another reading of them is
    for words, quaternion in readings.items():
        angle, distance = _misfit(arm, position, quaternion)
        if angle < max_angle and distance < max_misfit:
            refuse_data(
                block.file,
                f"the orientations contradict the arm (read as x y z w: median error {found:.0f}° for the best "
                f"placement of instrument and tool); {words}",
            )


def _misfit(arm: np.ndarray, position: np.ndarray, quaternion: np.ndarray) -> tuple[float, float]:
    """Return the differences of measured and predicted poses after placing instrument and tool as well as possible.

    Args:
        arm: (m, 4, 4) poses of the tip in the base.
        position: (m, 3) [m].
        quaternion: (m, 4) x y z w.

    Returns:
        The median angle [deg], and the median distance over the positions' spread.
    """
    seen = from_quaternion(position, quaternion)
    station, tool = place_pose(arm, seen)
    distance, turned = _apart(station @ arm @ tool, seen)
    spread = float(np.sqrt(np.sum(np.var(position, axis=0))))
    return float(np.degrees(np.median(turned))), float(np.median(distance)) / max(spread, 1e-9)


UNITS = {
    1e3: "are they mm, although the header states m",
    1e-3: "are they m, although the header states mm",
    39.37: "are they inches, although the header states m",
    0.0254: "are they m, although the header states in",
    1e2: "are they cm, although the header states m",
    25.4: "are they mm, although the header states in",
    0.03937: "are they inches, although the header states mm",
}
MAX_TURN = 2.1 * math.pi * DEG  # no joint goes further: they may be rad read as deg (our choice)
TURN, TURNED = 0.05, 6.0  # poses that turn by more tell a tool well whatever they turn by [rad] (our choice)
MAX_GUESS_ROWS = 300  # rows of a block that a guess is made from (our choice)


def install(chain: Chain, measured: Sequence[PoseMeasurements], known: Deflection | None = None) -> Installation:
    """Return the nominal arm with its stations and tools placed by a first guess from the measurements.

    A tool seen in several blocks takes its guess from the block that constrains most (poses before positions before the
    rest, then the one whose poses turn most, then the most rows); a station likewise. Tools that no block can place
    start at the tip.

    Raises:
        MeasurementError: too few rows to place an instrument.
    """
    foreign = [block for block in measured if block.kind not in KINDS]
    optics = OPTICS.one()(foreign) if foreign else NoOptics()  # registers guesses and residuals, too
    stations: dict[str, np.ndarray] = {}
    tools: dict[str, np.ndarray] = {}
    for block in sorted(measured, key=lambda b: (b.placing, -_turning(chain, b), -len(b))):
        block = take(block, evenly(len(block), MAX_GUESS_ROWS))
        arm = forward(chain, block.q)
        check_scale(block, chain)
        for number in np.unique(block.tool):
            name, rows = block.tool_names[number], block.tool == number
            station, tool = guess(block, arm, rows, stations.get(block.station), tools.get(name))
            tools.setdefault(name, tool)
            if block.has_instrument and station is not None:
                stations.setdefault(block.station, station)
    station_names = tuple(dict.fromkeys(b.station for b in measured if b.has_instrument)) or ("station",)
    tool_names = tuple(dict.fromkeys(name for b in measured for name in b.tool_names))
    return Installation(
        chain,
        np.array([stations.get(name, np.eye(4)) for name in station_names]),
        np.array([tools.get(name, np.eye(4)) for name in tool_names]),
        station_names,
        tool_names,
        known=known or Deflection(),
        optics=optics,
    )


def check_scale(block: PoseMeasurements, chain: Chain) -> None:
    """Raise an error if the measured positions spread far more or far less than the predicted ones.

    Args:
        block: measurements; those without positions pass.
        chain: predicts them from the joints.

    Raises:
        MeasurementError: for a ratio beyond `max_ratio`, with the units that would explain it; for positions on a
            line.
    """
    if not isinstance(block, Positions) or len(block) < 3:
        return
    block = take(block, evenly(len(block), MAX_GUESS_ROWS))
    (measured, second), (predicted, across) = _spread(block.position), _spread(forward(chain, block.q)[:, :3, 3])
    min_spread = 1e-3  # of predicted positions, from which they are held against the measured ones [m] (our choice)
    if predicted < min_spread:
        return
    max_ratio = 15.0  # measured over predicted spread of the positions (our choice)
    if not 1.0 / max_ratio < measured / predicted < max_ratio:
        likely, header = _likely_units(block, chain, measured, predicted)
        read = "".join(f" The file was {note}." for note in block.notes if note.startswith("read as"))
        refuse_data(
            block.file,
            f"the measured positions spread over {measured:.4g} m, {measured / predicted:.3g} times the "
            f"{predicted:.4g} m of the robot at these joint values{likely}{read} State the unit in the "
            f"header, as in {header}, or check that this is the right robot",
        )
    if second < across / max_ratio and across > min_spread:
        refuse_data(
            block.file,
            f"the measured positions lie on a line within {1e3 * second:.3g} mm, those of the robot at these joint "
            f"values within {1e3 * across:.3g} mm: are two of x, y, z constant or the same column, or are poses "
            "repeated? Measure poses all over the workspace",
        )


def _spread(positions: np.ndarray) -> tuple[float, float]:
    """Return the standard deviation of positions (m, 3), over all axes and across their principal line [m]."""
    sizes = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False) / np.sqrt(len(positions))
    return float(np.linalg.norm(sizes)), float(sizes[1])


def _likely_units(block: Positions, chain: Chain, measured: float, predicted: float) -> tuple[str, str]:
    """Return a question about the units that would explain the spread, and the column header to write."""
    guesses = [("", predicted, "'x [mm]'")]
    if np.abs(block.q).max() < MAX_TURN:
        turning = np.array([joint.kind != "prismatic" for joint in chain.joints])
        moved = _spread(forward(chain, np.where(turning, block.q / DEG, block.q))[:, :3, 3])[0]
        guesses.insert(0, ("are the joints rad, although the header states deg", moved, "'q1 [rad]'"))
    for words, size, header in guesses:
        ratio = max(measured / size, 1e-300)
        factor = min((1.0, *UNITS), key=lambda each: abs(math.log(ratio / each)))
        if abs(math.log(ratio / factor)) < math.log(2.0):
            return f": {', and '.join(filter(None, (words, UNITS.get(factor, ''))))}?", header
    return ".", guesses[-1][2]


def _turning(chain: Chain, block: PoseMeasurements) -> float:
    """Return how much a block's poses rotate about their second principal axis, in steps of `TURN` [rad]."""
    rows = evenly(len(block), MAX_GUESS_ROWS)
    if len(rows) < 3:
        return 0.0
    _, turns = chordal_turns(forward(chain, block.q[rows])[:, :3, :3])
    return min(float(np.sqrt(np.clip(np.linalg.eigvalsh(np.cov(turns.T))[1], 0.0, None)) // TURN), TURNED)


Guess = tuple[np.ndarray | None, np.ndarray]


@singledispatch
def guess(
    block: PoseMeasurements, arm: np.ndarray, rows: np.ndarray, station: np.ndarray | None, tool: np.ndarray | None
) -> Guess:
    """Return the placements of station and tool for one target; known placements are kept."""
    arm = arm[rows]
    if isinstance(block, Positions) and len(arm) < (least := 3 if isinstance(block, Poses) else 4):
        refuse_data(
            block.file,
            f"{len(arm)} usable rows: placing the instrument and the target needs at least {least} different poses, "
            "a calibration at least about 20; measure more poses",
        )
    if isinstance(block, Poses):
        seen = from_quaternion(block.position[rows], block.quaternion[rows])
        if station is not None:
            return station, average_pose(invert(arm) @ invert(station) @ seen)
        return place_pose(arm, seen) if tool is None else (average_pose(seen @ invert(arm @ tool)), tool)
    if isinstance(block, Positions):
        return _place_position(arm, block.position[rows], station, tool)
    if isinstance(block, Sockets) and tool is None:
        return None, pose(None, _place_sockets(arm, block.group[rows]))
    return None, np.eye(4) if tool is None else tool


def _place_position(
    arm: np.ndarray, seen: np.ndarray, station: np.ndarray | None, tool: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Solve y_i = S (R_i t + a_i) linearly for S and t, or for one of them if the other is given.

    Of the linear solution and two plainer ones (target at the tip; target at the tip with the mean offset) the one with
    the smallest median error is taken, since a small workspace ruins the linear one.

    Args:
        arm: (m, 4, 4).
        seen: (m, 3) [m].
    """
    rotation, position = arm[:, :3, :3], arm[:, :3, 3]
    if station is not None:
        inside = (seen - station[:3, 3]) @ station[:3, :3]
        offset = np.median(np.einsum("mji,mj->mi", rotation, inside - position), axis=0)
        return station, pose(None, offset)
    if tool is not None:
        return _align(position + rotation @ tool[:3, 3], seen), tool
    tried = list[tuple[float, np.ndarray, np.ndarray]]()
    for offset in (np.zeros(3), _linear_offset(rotation, position, seen)):
        for _ in range(5):  # alternate: placement by Kabsch, offset by its linear solution
            placement = _align(position + rotation @ offset, seen)
            inside = (seen - placement[:3, 3]) @ placement[:3, :3]
            error = float(np.median(np.linalg.norm(inside - position - rotation @ offset, axis=1)))
            tried.append((error, placement, offset))
            offset = np.median(np.einsum("mji,mj->mi", rotation, inside - position), axis=0)
    _, placement, offset = min(tried, key=lambda one: one[0])
    return placement, pose(None, offset)


def _linear_offset(rotation: np.ndarray, position: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return t of R_Sᵀ y - c - R t = a, linear in the nine numbers of R_Sᵀ, c and t."""
    m = len(seen)
    centre = seen.mean(axis=0)
    rows = np.zeros((m, 3, 15))
    for axis in range(3):
        rows[:, axis, 3 * axis : 3 * axis + 3] = seen - centre
    rows[:, :, 9:12] = np.eye(3)
    rows[:, :, 12:] = -rotation
    return np.linalg.lstsq(rows.reshape(-1, 15), position.reshape(-1), rcond=1e-6)[0][12:]


def _align(points: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return the pose S with seen ≈ S points (Kabsch 1976); the worst fifth is trimmed once."""
    keep = np.ones(len(points), dtype=bool)
    placement = np.eye(4)
    for _ in range(2):
        turned = Rotation.align_vectors(seen[keep] - seen[keep].mean(axis=0), points[keep] - points[keep].mean(axis=0))
        matrix = turned[0].as_matrix()
        placement = pose(matrix, seen[keep].mean(axis=0) - matrix @ points[keep].mean(axis=0))
        error = np.linalg.norm(seen - points @ matrix.T - placement[:3, 3], axis=1)
        keep = error <= max(np.quantile(error, 0.8), 1e-12)
        if keep.sum() < 4:
            break
    return placement


def _place_sockets(arm: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return the offset t (3,) for which R_i t + a_i varies least within each group."""
    rotation, position = arm[:, :3, :3].copy(), arm[:, :3, 3].copy()
    for number in np.unique(group):
        rows = group == number
        rotation[rows] -= rotation[rows].mean(axis=0)
        position[rows] -= position[rows].mean(axis=0)
    return np.linalg.lstsq(rotation.reshape(-1, 3), -position.reshape(-1), rcond=1e-6)[0]
