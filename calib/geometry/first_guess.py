"""First guess of the placements of instrument and target, in closed form from the measurements.

With the arm's poses A_i = (R_i, a_i) from the nominal chain:

* full pose  B_i = S A_i X: rotations by Shah (2013, "Solving the robot-world/hand-eye calibration problem using the
  Kronecker product"), then the two translations linearly. Where the orientations differ too little for this, rotations
  and displacements together are used;
* position   S⁻¹ y_i = R_i t + a_i: linear in the rotation of S (9 numbers), its offset and t; the 9 numbers are
  projected on SO(3);
* sockets    R_i t + a_i constant within each group: linear in t;
* images     `calib.geometry.camera.camera_guess`.

Each guess is then improved by a few robust Gauss–Newton steps on the placements alone (`calib.geometry.fit`).

The nominal arm also reveals wrong units and orientations. A quaternion read with its components in another order is
still a quaternion, and for two rows the angle |log R_iᵀ R_j| = 2 acos |q_i · q_j| does not depend on the order. But
moving the component w is an odd permutation, a reflection of the sphere of unit quaternions. The orientations read are
then P R_iᵀ Q with constant P, Q. This contains the inverse of R_i, which no placements S, X can make agree with the
arm's S A_i X.
"""

import math
from collections.abc import Callable, Sequence
from functools import singledispatch
from typing import TYPE_CHECKING

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

OPTICS: "Point[Callable[[Sequence[object]], Optics]]" = Point(
    "optics", "optics of kinds that are not the core's; loading it registers guesses and residuals"
)

# length by which rotations are multiplied to compare them with displacements [m/rad] (our choice)
LEVER = 0.3
# number of alternations between rotation and offset, and between placement and offset
PLACING_ROUNDS = 5
# smallest rms rotation of the target [rad] that determines its offset
MIN_TURN = 0.01
# largest and smallest number of rows by which orientations are checked (our choice)
CHECKED_ROWS = 200
MIN_CHECKED_ROWS = 4
# smallest number of positions that can contradict the arm: station and offset take 9 of their 24 numbers (our choice)
MIN_PLACED_ROWS = 8
# smallest median misfit of orientations [deg] that contradicts their stated convention (our choice)
MIN_ANGLE = 20.0
# largest median misfits of the reading that explains the orientations: an angle [deg], and a share of the
# positions' spread
MAX_ANGLE = 5.0
MAX_MISFIT = 0.1
# readings of orientations that are tried: text for the user, and order and signs of the quaternions as read
READINGS = (
    (
        "read as w x y z they agree. If w comes first, name the columns in that order: qw, qx, qy, qz",
        [1, 2, 3, 0],
        [1, 1, 1, 1],
    ),
    (
        "inverted they agree. Give the orientation of the target in the instrument's frame",
        [0, 1, 2, 3],
        [-1, -1, -1, 1],
    ),
)
# for each ratio of measured to predicted lengths, the question about units for the user
UNITS = {
    1e3: "are they mm, although the header states m",
    1e-3: "are they m, although the header states mm",
    39.37: "are they inches, although the header states m",
    0.0254: "are they m, although the header states in",
    1e2: "are they cm, although the header states m",
    25.4: "are they mm, although the header states in",
    0.03937: "are they inches, although the header states mm",
}
# largest joint angle for which values in rad may have been read as deg (our choice)
MAX_TURN = 2.1 * math.pi * DEG
# largest ratio of measured to predicted spread of positions, or of the inverse (our choice)
MAX_RATIO = 15.0
# smallest spread of predicted positions for which it is compared with that of the measured ones [m] (our choice)
MIN_SPREAD = 1e-3
# steps in which rotations of poses are compared, and rotation that determines a tool well in any case [rad]
# (our choice)
TURN = 0.05
TURNED = 6.0
# largest number of rows of a block from which a guess is made (our choice)
MAX_GUESS_ROWS = 300
# share of the points that an alignment uses, and their smallest number
TRUSTED_SHARE = 0.8
MIN_TRUSTED = 4

# station and tool (4, 4)
Placements = tuple[np.ndarray, np.ndarray]
Guess = tuple[np.ndarray | None, np.ndarray]


def misfit(arm: np.ndarray, measured: np.ndarray, station: np.ndarray, tool: np.ndarray, lever: float) -> np.ndarray:
    """Return the distances (m,) [m] between measured poses B_i and predicted poses S A_i X, angles included.

    Args:
        arm: (m, 4, 4) A_i, poses of the tip in the base.
        measured: (m, 4, 4) B_i, poses of the target in the station's frame.
        station, tool: S and X (4, 4).
        lever: length [m] by which angles [rad] are multiplied.
    """
    distance, turn = _differences(station @ arm @ tool, measured)
    return np.hypot(distance, lever * turn)


def _differences(predicted: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances (m,) [m] and the angles (m,) [rad] between predicted and measured poses (m, 4, 4)."""
    predicted_transposed = np.swapaxes(predicted[:, :3, :3], 1, 2)
    rotation = Rotation.from_matrix(predicted_transposed @ measured[:, :3, :3])
    displacement = predicted[:, :3, 3] - measured[:, :3, 3]
    return np.linalg.norm(displacement, axis=1), rotation.magnitude()


def average_pose(poses: np.ndarray) -> np.ndarray:
    """Return the mean (4, 4) of poses (m, 4, 4): chordal mean of the rotations, median of the positions."""
    rotation = orthonormal(poses[:, :3, :3].mean(axis=0))
    position = np.median(poses[:, :3, 3], axis=0)
    return pose(rotation, position)


def place_pose(arm: np.ndarray, measured: np.ndarray) -> Placements:
    """Return the placements S and X that solve B_i = S A_i X.

    They are computed by orientations (Shah 2013) and by rotations and displacements together; the better solution is
    returned.

    Args:
        arm: (m, 4, 4) poses A_i of the tip in the base.
        measured: (m, 4, 4) poses B_i of the target in the station's frame.

    Returns:
        S, the station (4, 4), and X, the tool (4, 4).
    """
    by_shah = by_orientations(arm, measured)
    by_motions = _by_displacements(arm, measured)
    if np.median(misfit(arm, measured, *by_motions, LEVER)) < np.median(misfit(arm, measured, *by_shah, LEVER)):
        return by_motions
    return by_shah


def by_orientations(arm: np.ndarray, measured: np.ndarray) -> Placements:
    """Return station S and tool X (4, 4) by Shah's method from the orientations of the poses.

    The result is accurate if the poses rotate about two axes by much more than the errors of the orientations.

    Args:
        arm: (m, 4, 4) poses A_i of the tip in the base.
        measured: (m, 4, 4) poses B_i of the target in the station's frame.
    """
    # vec(R_S R_A R_X) = vec(R_B): the sum of R_B ⊗ R_A has vec(R_S) and vec(R_X) as its first singular pair
    kernel = np.einsum("mij,mkl->ikjl", measured[:, :3, :3], arm[:, :3, :3]).reshape(9, 9)
    u, _, vt = np.linalg.svd(kernel)
    station_matrix = u[:, 0].reshape(3, 3)
    tool_matrix = vt[0].reshape(3, 3)
    station_rotation = orthonormal(station_matrix * np.sign(np.linalg.det(station_matrix)))
    tool_rotation = orthonormal(tool_matrix * np.sign(np.linalg.det(tool_matrix))).T
    station, offset = _translations(arm, measured[:, :3, 3], station_rotation)
    return pose(station_rotation, station), pose(tool_rotation, offset)


def _by_displacements(arm: np.ndarray, measured: np.ndarray) -> Placements:
    """Return S and X (4, 4) from rotations and displacements about the mean; also accurate for nearly equal
    orientations.

    log(R_B,i R̄_Bᵀ) = R_S log(R_A,i R̄_Aᵀ), where R̄ is the chordal mean of the rotations, and y_i - ȳ = R_S (a_i - ā +
    (R_i - R̄) t). R_S is computed by Kabsch's method from both equations, with rotations multiplied by `LEVER` [m], in
    alternation with the linear solution for t.

    Args:
        arm: (m, 4, 4) poses A_i = (R_A,i, a_i) of the tip in the base; R_i is R_A,i.
        measured: (m, 4, 4) poses B_i = (R_B,i, y_i) of the target in the station's frame.
    """
    arm_mean, arm_turns = chordal_turns(arm[:, :3, :3])
    measured_mean, measured_turns = chordal_turns(measured[:, :3, :3])
    measured_position = measured[:, :3, 3]
    measured_motions = np.concatenate([measured_position - measured_position.mean(axis=0), LEVER * measured_turns])
    station, offset, rotation = np.zeros(3), np.zeros(3), np.eye(3)
    for _ in range(PLACING_ROUNDS):
        position = arm[:, :3, 3] + arm[:, :3, :3] @ offset
        motions = np.concatenate([position - position.mean(axis=0), LEVER * arm_turns])
        rotation = orthonormal(measured_motions.T @ motions)
        station, offset = _translations(arm, measured_position, rotation)
    return pose(rotation, station), pose((rotation @ arm_mean).T @ measured_mean, offset)


def chordal_turns(rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the chordal mean (3, 3) of rotations (m, 3, 3), and the rotation vectors (m, 3) from this mean to each."""
    mean = orthonormal(rotations.mean(axis=0))
    return mean, Rotation.from_matrix(rotations @ mean.T).as_rotvec()


def _translations(arm: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions p_S (3,) of the station and t (3,) of the target on the tool [m].

    They solve y_i - R_S a_i = R_S R_i t + p_S; components of t that are poorly identifiable are 0.

    Args:
        arm: (m, 4, 4) poses (R_i, a_i) of the tip in the base.
        position: (m, 3) measured positions y_i [m].
        rotation: (3, 3) R_S, rotation of the station.
    """
    turned = rotation @ arm[:, :3, :3]
    target = position - arm[:, :3, 3] @ rotation.T
    turned_from_mean = turned - turned.mean(axis=0)
    target_from_mean = target - target.mean(axis=0)
    u, size, vt = np.linalg.svd(turned_from_mean.reshape(-1, 3), full_matrices=False)
    strong = size > MIN_TURN * np.sqrt(len(arm))
    components = (u[:, strong].T @ target_from_mean.reshape(-1)) / size[strong]
    offset = vt[strong].T @ components
    return (target - turned @ offset).mean(axis=0), offset


def check_orientations(chain: Chain, block: PoseMeasurements) -> None:
    """Raise an error where quaternions have another component order than stated, or orientations are inverted.

    Args:
        chain: the nominal arm.
        block: measurements of any kind; only full poses are checked.

    Raises:
        MeasurementError: the orientations as read contradict the arm, and agree with it in another reading.
    """
    if not isinstance(block, Poses):
        return
    rows = checked_rows(block)
    if len(rows) < MIN_CHECKED_ROWS:
        return
    arm = forward(chain, block.q[rows])
    position = block.position[rows]
    quaternion = block.quaternion[rows]
    error, _ = _misfit(arm, position, quaternion)
    if error <= MIN_ANGLE:
        return
    for advice, order, signs in READINGS:
        angle, distance = _misfit(arm, position, quaternion[:, order] * signs)
        if angle < MAX_ANGLE and distance < MAX_MISFIT:
            refuse_data(
                block.file,
                f"the orientations contradict the arm (read as x y z w: median error {error:.0f}° for the best "
                f"placement of instrument and tool); {advice}",
            )


def checked_rows(block: Poses) -> np.ndarray:
    """Return the indices of the rows by which a block's orientations are checked: of the target with most rows."""
    rows = np.flatnonzero(block.tool == np.argmax(np.bincount(block.tool)))
    return rows[evenly(len(rows), CHECKED_ROWS)]


def contradiction(chain: Chain, block: PoseMeasurements) -> float:
    """Return how far measurements are from the nominal arm with instrument and tool placed; above 1 they contradict it.

    It is the larger of the median distance over `MAX_MISFIT` of the positions' spread and, for poses, the median angle
    over `MAX_ANGLE`.

    Args:
        chain: the nominal arm.
        block: positions or poses; infinite for another kind, or too few rows.
    """
    if isinstance(block, Poses):
        rows = checked_rows(block)
        if len(rows) < MIN_CHECKED_ROWS:
            return math.inf
        arm = forward(chain, block.q[rows])
        angle, distance = _misfit(arm, block.position[rows], block.quaternion[rows])
        return max(angle / MAX_ANGLE, distance / MAX_MISFIT)
    if not isinstance(block, Positions) or len(block) < MIN_PLACED_ROWS:
        return math.inf
    sample = take(block, evenly(len(block), CHECKED_ROWS))
    arm = forward(chain, sample.q)
    spread = math.sqrt(float(np.sum(np.var(sample.position, axis=0))))
    worst = 0.0
    for tool in np.unique(sample.tool):
        rows = np.flatnonzero(sample.tool == tool)
        station, offset = place_position(arm[rows], sample.position[rows], None, None)
        placed = station @ arm[rows] @ offset
        distance = np.linalg.norm(placed[:, :3, 3] - sample.position[rows], axis=1)
        worst = max(worst, float(np.median(distance)) / max(spread, 1e-9))
    return worst / MAX_MISFIT


def _misfit(arm: np.ndarray, position: np.ndarray, quaternion: np.ndarray) -> tuple[float, float]:
    """Return the differences of measured and predicted poses after fitting the placements of instrument and tool.

    Args:
        arm: (m, 4, 4) poses of the tip in the base.
        position: (m, 3) measured positions [m].
        quaternion: (m, 4) measured orientations, x y z w.

    Returns:
        The median angle [deg], and the median distance divided by the positions' standard deviation.
    """
    measured = from_quaternion(position, quaternion)
    station, tool = place_pose(arm, measured)
    distance, angle = _differences(station @ arm @ tool, measured)
    spread = float(np.sqrt(np.sum(np.var(position, axis=0))))
    return float(np.degrees(np.median(angle))), float(np.median(distance)) / max(spread, 1e-9)


def install(chain: Chain, measured: Sequence[PoseMeasurements], known: Deflection | None = None) -> Installation:
    """Return the nominal arm with stations and tools placed by a first guess from the measurements.

    The guess for a tool measured in several blocks is taken from the block that determines it best: poses before
    positions before other kinds, then the block whose poses rotate most, then the block with most rows. Stations are
    treated in the same way. Tools that no block can place start at the tip.

    Args:
        chain: the nominal arm.
        measured: blocks of measurements.
        known: deflections of an earlier fit, kept fixed; None without such deflections.

    Raises:
        MeasurementError: there are too few rows to place an instrument.
    """
    foreign = [block for block in measured if block.kind not in KINDS]
    optics = NoOptics()
    if foreign:
        # registers guesses and residuals, too
        optics = OPTICS.first()(foreign)
    stations: dict[str, np.ndarray] = {}
    tools: dict[str, np.ndarray] = {}
    for block in sorted(measured, key=lambda block: (block.placing, -_turning(chain, block), -len(block))):
        sample = take(block, evenly(len(block), MAX_GUESS_ROWS))
        arm = forward(chain, sample.q)
        check_scale(sample, chain)
        for number in np.unique(sample.tool):
            name = sample.tool_names[number]
            rows = sample.tool == number
            station, tool = guess(sample, arm, rows, stations.get(sample.station), tools.get(name))
            tools.setdefault(name, tool)
            if sample.has_instrument and station is not None:
                stations.setdefault(sample.station, station)
    station_names: dict[str, None] = {}
    tool_names: dict[str, None] = {}
    for block in measured:
        if block.has_instrument:
            station_names[block.station] = None
        tool_names.update(dict.fromkeys(block.tool_names))
    if not station_names:
        station_names["station"] = None
    placed_stations = [stations.get(name, np.eye(4)) for name in station_names]
    placed_tools = [tools.get(name, np.eye(4)) for name in tool_names]
    return Installation(
        chain,
        stations=np.array(placed_stations),
        tools=np.array(placed_tools),
        station_names=tuple(station_names),
        tool_names=tuple(tool_names),
        known=known or Deflection(),
        optics=optics,
    )


def check_scale(block: PoseMeasurements, chain: Chain) -> None:
    """Raise an error if the measured positions spread much more or much less than the predicted ones.

    Args:
        block: measurements; blocks without positions are accepted.
        chain: the nominal arm, which predicts the positions.

    Raises:
        MeasurementError: the ratio of the two spreads, or its inverse, is above `MAX_RATIO` (the message names the
            units that would explain it), or the positions lie on a line.
    """
    if not isinstance(block, Positions) or len(block) < 3:
        return
    block = take(block, evenly(len(block), MAX_GUESS_ROWS))
    measured, measured_across = _spread(block.position)
    predicted, predicted_across = _spread(forward(chain, block.q)[:, :3, 3])
    if predicted < MIN_SPREAD:
        return
    if not 1.0 / MAX_RATIO < measured / predicted < MAX_RATIO:
        question, header = _likely_units(block, chain, measured, predicted)
        notes = [f" The file was {note}." for note in block.notes if note.startswith("read as")]
        refuse_data(
            block.file,
            f"the measured positions spread over {measured:.4g} m, {measured / predicted:.3g} times the "
            f"{predicted:.4g} m of the robot at these joint values{question}{''.join(notes)} State the unit in the "
            f"header, as in {header}, or check that this is the right robot",
        )
    if measured_across < predicted_across / MAX_RATIO and predicted_across > MIN_SPREAD:
        refuse_data(
            block.file,
            f"the measured positions lie on a line within {1e3 * measured_across:.3g} mm, those of the robot at these "
            f"joint values within {1e3 * predicted_across:.3g} mm: are two of x, y, z constant or the same column, or "
            "are poses repeated? Measure poses all over the workspace",
        )


def _spread(positions: np.ndarray) -> tuple[float, float]:
    """Return the standard deviation of positions (m, 3) [m], over all axes, and across their principal line."""
    centred = positions - positions.mean(axis=0)
    sizes = np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(positions))
    return float(np.linalg.norm(sizes)), float(sizes[1])


def _likely_units(block: Positions, chain: Chain, measured: float, predicted: float) -> tuple[str, str]:
    """Return a question about the units that would explain the spread, and a column header that states these units.

    Args:
        block: measured positions.
        chain: the nominal arm.
        measured, predicted: spreads of the measured and of the predicted positions [m].
    """
    # what to ask about the joints, the spread that follows, and the header that states the unit
    guesses = [("", predicted, "'x [mm]'")]
    if np.abs(block.q).max() < MAX_TURN:
        turning = np.array([joint.kind != "prismatic" for joint in chain.joints])
        in_rad = np.where(turning, block.q / DEG, block.q)
        spread, _ = _spread(forward(chain, in_rad)[:, :3, 3])
        guesses.insert(0, ("are the joints rad, although the header states deg", spread, "'q1 [rad]'"))
    for question, spread, header in guesses:
        ratio = max(measured / spread, 1e-300)
        factor = min((1.0, *UNITS), key=lambda unit: abs(math.log(ratio / unit)))
        if abs(math.log(ratio / factor)) < math.log(2.0):
            questions = [text for text in (question, UNITS.get(factor, "")) if text]
            return f": {', and '.join(questions)}?", header
    return ".", guesses[-1][2]


def _turning(chain: Chain, block: PoseMeasurements) -> float:
    """Return the size of a block's rotations about their second principal axis, in steps of `TURN` [rad].

    Args:
        chain: the nominal arm, which predicts the rotations.
        block: measurements of any kind.
    """
    rows = evenly(len(block), MAX_GUESS_ROWS)
    if len(rows) < 3:
        return 0.0
    _, turns = chordal_turns(forward(chain, block.q[rows])[:, :3, :3])
    second_variance = np.linalg.eigvalsh(np.cov(turns.T))[1]
    turning = float(np.sqrt(np.clip(second_variance, 0.0, None)) // TURN)
    return min(turning, TURNED)


@singledispatch
def guess(
    block: PoseMeasurements, arm: np.ndarray, rows: np.ndarray, station: np.ndarray | None, tool: np.ndarray | None
) -> Guess:
    """Return the placements of station and tool for one target; given placements are kept.

    Args:
        block: measurements.
        arm: poses (4, 4) of the tip in the base, one per row.
        rows: the target's rows in the block.
        station, tool: (4, 4) placements that are already known; None for those to guess.
    """
    arm = arm[rows]
    if isinstance(block, Positions):
        min_poses = 3 if isinstance(block, Poses) else 4
        if len(arm) < min_poses:
            refuse_data(
                block.file,
                f"{len(arm)} usable rows: placing the instrument and the target needs at least {min_poses} different "
                "poses, a calibration at least about 20; measure more poses",
            )
    if isinstance(block, Poses):
        measured = from_quaternion(block.position[rows], block.quaternion[rows])
        if station is not None:
            return station, average_pose(invert(arm) @ invert(station) @ measured)
        if tool is not None:
            return average_pose(measured @ invert(arm @ tool)), tool
        return place_pose(arm, measured)
    if isinstance(block, Positions):
        return place_position(arm, block.position[rows], station, tool)
    if tool is not None:
        return None, tool
    if isinstance(block, Sockets):
        return None, pose(None, _place_sockets(arm, block.group[rows]))
    return None, np.eye(4)


def place_position(
    arm: np.ndarray, measured: np.ndarray, station: np.ndarray | None, tool: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return station S and target position t that solve y_i = S (R_i t + a_i); a placement that is given is kept.

    If both are unknown, they are computed alternately: S by Kabsch's method, t as the median offset. The iteration
    starts from t = 0 and from the linear solution, which is inaccurate in a small workspace. The result with the
    smallest median error is returned.

    Args:
        arm: (m, 4, 4) poses A_i of the tip in the base.
        measured: (m, 3) measured positions y_i [m].
        station, tool: (4, 4) placements that are already known; None for those to guess.
    """
    rotation = arm[:, :3, :3]
    position = arm[:, :3, 3]
    if station is not None:
        in_base = (measured - station[:3, 3]) @ station[:3, :3]
        return station, pose(None, _median_offset(rotation, in_base - position))
    if tool is not None:
        return _align(position + rotation @ tool[:3, 3], measured), tool
    smallest = np.inf
    best_placement = np.eye(4)
    best_offset = np.zeros(3)
    for offset in (np.zeros(3), _linear_offset(rotation, position, measured)):
        # alternate: placement by Kabsch, offset by its linear solution
        for _ in range(PLACING_ROUNDS):
            placement = _align(position + rotation @ offset, measured)
            in_base = (measured - placement[:3, 3]) @ placement[:3, :3]
            error = float(np.median(np.linalg.norm(in_base - position - rotation @ offset, axis=1)))
            if error < smallest:
                smallest = error
                best_placement = placement
                best_offset = offset
            offset = _median_offset(rotation, in_base - position)
    return best_placement, pose(None, best_offset)


def _median_offset(rotation: np.ndarray, lever: np.ndarray) -> np.ndarray:
    """Return the median (3,) [m] of vectors R_iᵀ l_i, with R = `rotation` (m, 3, 3) and l = `lever` (m, 3) [m]."""
    return np.median(np.einsum("mji,mj->mi", rotation, lever), axis=0)


def _linear_offset(rotation: np.ndarray, position: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return the target's offset t (3,) [m] in the tip that solves R_Sᵀ y - c - R t = a by linear least squares.

    The unknowns are the nine numbers of the station's rotation R_Sᵀ, its offset c, and t.

    Args:
        rotation, position: (m, 3, 3) R and (m, 3) a, poses of the tip in the base.
        measured: (m, 3) y, measured positions [m].
    """
    m = len(measured)
    centre = measured.mean(axis=0)
    rows = np.zeros((m, 3, 15))
    for axis in range(3):
        rows[:, axis, 3 * axis : 3 * axis + 3] = measured - centre
    rows[:, :, 9:12] = np.eye(3)
    rows[:, :, 12:] = -rotation
    solution = np.linalg.lstsq(rows.reshape(-1, 15), position.reshape(-1), rcond=1e-6)[0]
    return solution[12:]


def _align(points: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return the pose S (4, 4) with measured ≈ S points (Kabsch 1976), for points (m, 3) and measured (m, 3) [m].

    It is computed twice, the second time without the fifth of the points that fits worst.
    """
    trusted = np.ones(len(points), dtype=bool)
    placement = np.eye(4)
    for _ in range(2):
        mean = points[trusted].mean(axis=0)
        measured_mean = measured[trusted].mean(axis=0)
        matrix = orthonormal((measured[trusted] - measured_mean).T @ (points[trusted] - mean))
        placement = pose(matrix, measured_mean - matrix @ mean)
        error = np.linalg.norm(measured - points @ matrix.T - placement[:3, 3], axis=1)
        # the largest error below the quantile, which selects the same rows
        last = int(TRUSTED_SHARE * (len(error) - 1))
        trusted = error <= max(np.partition(error, last)[last], 1e-12)
        if trusted.sum() < MIN_TRUSTED:
            break
    return placement


def _place_sockets(arm: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return the offset t (3,) [m] for which R_i t + a_i varies least within each group of rows at one socket.

    Args:
        arm: (m, 4, 4) poses (R_i, a_i) of the tip in the base.
        group: (m,) number of the socket of each row.
    """
    rotation, position = arm[:, :3, :3].copy(), arm[:, :3, 3].copy()
    for number in np.unique(group):
        rows = group == number
        rotation[rows] -= rotation[rows].mean(axis=0)
        position[rows] -= position[rows].mean(axis=0)
    return np.linalg.lstsq(rotation.reshape(-1, 3), -position.reshape(-1), rcond=1e-6)[0]
