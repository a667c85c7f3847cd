"""Solution of the closure equations: all joints and the platform pose from its coordinates or from encoders.

Newton's method on the closure equations of all legs at once, eliminated leg by leg:

    J_k δq_k = G_k t - e_k        tip velocity of leg k = rigid-body velocity of its attachment, e_k the gap
    δq_k = J_k⁺ (G_k t - e_k),    t = t_0 + D v    with v the independent parts of the platform's twist

From encoders, v minimises the distance to all readings, so that redundant encoders have equal weights (for velocities:
eq. 16 of Briot, Gautier & Krut 2013). All samples are solved at once. A sample is reached from home along a straight
line, in steps too short to jump to another branch of the solution. At the samples a minor of each leg's Jacobian must
have the sign that it has at home; without redundant actuators also the determinant of the platform's Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.linalg
from scipy.spatial.transform import Rotation

from calib.dynamics.bodies import Bodies, bodies_of, upright_turn
from calib.errors import NoPosture
from calib.parallel.mechanism.parallel_robot import COORDINATES, Leg, ParallelRobot
from calib.records import frozen, shaped


@dataclass(frozen=True, eq=False)
class Posture:
    """N postures of a robot.

    Attributes:
        q: (N, n_t) values of all joints of all legs [rad or m], leg after leg.
        pose: (N, 4, 4) poses of the platform in the base.
    """

    q: np.ndarray
    pose: np.ndarray

    def __len__(self) -> int:
        return len(self.q)

    def __getitem__(self, index) -> Posture:  # type: ignore[no-untyped-def]
        return Posture(self.q[index], self.pose[index])


@dataclass(frozen=True, eq=False)
class LegLinks:
    """Jacobians and gap of one leg at N postures.

    Attributes:
        full: (N, 6, n) Jacobian of the leg's end: velocity, then angular velocity, per rate of n joints.
        jacobian: (N, c, n) J, the rows of `full` for the c closure equations.
        inverse: (N, n, c) pseudoinverse J⁺.
        carried: (N, c, 6) G, which maps the platform's twist to the attachment's velocity.
        gap: (N, c) displacement of the leg's end from the attachment [m, rad].
        lever: (N, 3) vector from the platform's origin to the attachment, in the base's axes [m].
    """

    full: np.ndarray
    jacobian: np.ndarray
    inverse: np.ndarray
    carried: np.ndarray
    gap: np.ndarray
    lever: np.ndarray


def leg_links(robot: ParallelRobot, posture: Posture) -> list[LegLinks]:
    """Return the Jacobians and the gap of each leg at postures; the loops need not be closed."""
    starts = robot.starts
    links = []
    for leg, start, end in zip(robot.legs, starts, starts[1:]):
        q = posture.q[:, start:end]
        links.append(links_of(leg, q, posture.pose))
    return links


def pseudo_inverse(J: np.ndarray) -> np.ndarray:
    """Return J⁺ (N, n, c) of matrices (N, c, n) with at least as many rows as columns."""
    try:
        if J.shape[1] == J.shape[2]:
            return np.linalg.inv(J)
        across = J.transpose(0, 2, 1)
        return np.linalg.solve(across @ J, across)
    except np.linalg.LinAlgError:
        return np.linalg.pinv(J)


def times(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the products A x (N, k) of matrices A (N, k, l) and vectors x (N, l), sample by sample."""
    return (A @ x[:, :, None])[:, :, 0]


def links_of(leg: Leg, q: np.ndarray, pose: np.ndarray) -> LegLinks:
    """Return the Jacobians and the gap of a leg at joint values q (N, n) and platform poses (N, 4, 4)."""
    from calib.parallel.mechanism import closure_kernels

    count, n = q.shape
    full = np.zeros((count, 6, n))
    inverse = np.zeros((count, n, leg.held))
    carried = np.zeros((count, leg.held, 6))
    gap = np.zeros((count, leg.held))
    lever = np.zeros((count, 3))
    bodies, tail = compiled(leg)
    # numba compiles a kernel once per memory layout of its arrays
    q = np.require(q, requirements=["C", "W"])
    pose = np.require(pose, requirements=["C", "W"])
    closure_kernels.legs(
        bodies.links, bodies.constants, tail, leg.attachment, q, pose, full, inverse, carried, gap, lever
    )
    jacobian = full[:, : leg.held]
    return LegLinks(full, jacobian, inverse, carried, gap, lever)


@lru_cache(maxsize=256)
def compiled(leg: Leg) -> tuple[Bodies, np.ndarray]:
    """Return a leg's arrays for the kernels.

    Returns:
        The leg's bodies, and the pose (4, 4) of its end in the last body's frame, turned so that z is the joint's axis.
    """
    bodies = bodies_of(leg.chain)
    turn = upright_turn(int(bodies.axes[-1]))
    return bodies, frozen(turn.T @ leg.chain.tail)


# Gap and Newton step [m or rad] below which a loop counts as closed.
CLOSED = 1e-10
# Gap [m or rad] at home from which on a robot's file is refused.
MAX_HOME_GAP = 1e3 * CLOSED
# Largest Newton step [rad or m].
BOUND = 0.5
# Reciprocal condition below which a posture is called singular (our choice).
SINGULAR = 1e-4
# Reciprocal condition below which a message attributes a failure of Newton's method to a singularity (our choice).
WEAK = 0.02
# Of a record every SPACING-th sample is reached from home, the samples between from the nearest of these.
SPACING = 16
# Largest change of a reading or coordinate between two solutions on the way from home [rad or m] (our choice).
MAX_STRIDE = 0.25
# Largest number of Newton steps, and of steps that are made in a rough solution on the way from home.
MAX_STEPS = 60
ROUGH_STEPS = 2
# Number of steps by which each leg is closed at home, with the platform at rest.
HOME_STEPS = 10
# Number of random postures at which a leg that is singular at home is examined.
EXAMINED_POSTURES = 4
# Number of postures near home at which the platform's freedoms are counted, and their distance as a share of the box.
FREEDOM_POSTURES = 4
FREEDOM_DISTANCE = 0.05
# Relative singular value below which a direction counts as free, and condition of freedoms that are not distinguished.
RANK_TOLERANCE = 1e-9
MAX_FREEDOM_CONDITION = 1e8


@dataclass(frozen=True, eq=False)
class ClosedRobot:
    """A parallel robot whose loops close at home.

    Attributes:
        robot: the robot's legs and platform.
        home: posture at home, with one sample.
        minors: for each leg, indices of n rows of its Jacobian; the sign of their determinant identifies the leg's
            branch.
        signs: (L + 1,) signs of these determinants at home, then the sign of the platform's determinant (0 with
            redundant actuators).
        fixed: whether the named freedoms are the platform's possible twists in the whole workspace.
    """

    robot: ParallelRobot
    home: Posture
    minors: tuple[np.ndarray, ...]
    signs: np.ndarray
    fixed: bool

    def locate(self, readings: np.ndarray, start: Posture | None = None) -> Posture:
        """Return the postures for given encoder readings of the actuated joints.

        Args:
            readings: (N, n) [rad or m]; a record, whose samples follow one another, is solved faster.
            start: nearby postures, already checked, at which the solution starts; the result is then not checked for
                singularities. None: the solution starts at home.

        Raises:
            NoPosture: for samples out of reach, or at or beyond a singularity.
        """
        readings = shaped(readings, (None, self.robot.n), f"readings of '{self.robot.name}'")
        at_home = self.home.q[0, self.robot.actuated]
        return _reached(self, readings, at_home, _from_readings, start)

    def place(self, coordinates: np.ndarray, start: Posture | None = None) -> Posture:
        """Return the postures for given coordinates of the platform.

        Args:
            coordinates: (N, r) coordinates relative to home [m, rad].
            start: as in `locate`.

        Raises:
            NoPosture: for samples out of reach, or at or beyond a singularity.
        """
        coordinates = shaped(coordinates, (None, self.robot.r), f"platform coordinates of '{self.robot.name}'")
        at_home = np.zeros(self.robot.r)
        return _reached(self, coordinates, at_home, _from_coordinates, start)


_Aim = Callable[[ClosedRobot, Sequence[LegLinks], np.ndarray, np.ndarray, Posture, np.ndarray], np.ndarray]


def closed(robot: ParallelRobot) -> ClosedRobot:
    """Return a robot with its loops closed at home, and check that its platform has the named freedoms.

    Raises:
        RobotError: if a loop does not close at home, home is singular, or the loops leave other freedoms than those
            named.
    """
    home_q = np.concatenate([leg.home for leg in robot.legs])
    start = Posture(home_q[None], robot.home[None])
    # Each leg is closed by itself, with the platform at rest.
    for _ in range(HOME_STEPS):
        steps = [-times(link.inverse, link.gap) for link in leg_links(robot, start)]
        step = np.concatenate(steps, axis=1)
        step = np.clip(step, -BOUND, BOUND)
        start = Posture(start.q + step, start.pose)
    gaps = [float(np.abs(link.gap).max()) for link in leg_links(robot, start)]
    # Loops that are still open determine the platform's coordinates that are not named as freedoms.
    with suppress(NoPosture, np.linalg.LinAlgError):
        if max(gaps) > CLOSED:
            free = ClosedRobot(robot, start, (), np.zeros(0), False)
            at_home = np.zeros((1, robot.r))
            start = _newton(free, start, at_home, _from_coordinates)
    links = leg_links(robot, start)
    for leg, leg_link in zip(robot.legs, links):
        distance = float(np.abs(leg_link.gap).max())
        if distance > MAX_HOME_GAP:
            robot.refuse(
                f"the loop of {leg.name} does not close at the platform's home: its end stays "
                f"{1e3 * distance:.3g} mm (or mrad) from its attachment; check its home, base, attachment and lengths"
            )
        rcond = float(_leg_rcond(leg_link, leg_link)[0])
        if rcond < SINGULAR:
            robot.refuse(f"{leg.name} {_why_singular(robot, start, leg)} (rcond {rcond:.1g}): correct home or lengths")
    minors = tuple(_best_rows(link.jacobian[0]) for link in links)
    fixed = _check_freedom(robot, start, links)
    no_signs = np.zeros(len(links) + 1)
    opened = ClosedRobot(robot, start, minors, no_signs, fixed)
    rows = _reading_rows(opened, links)
    rcond = float(_platform_rcond(opened, rows, rows)[0])
    if rcond < SINGULAR:
        robot.refuse(
            f"home is singular (type 2): locked actuators do not hold the platform (rcond {rcond:.1g}); state "
            "another home"
        )
    signs = frozen(_determinants(opened, links, rows)[0])
    return ClosedRobot(robot, start, minors, signs, fixed)


def _why_singular(robot: ParallelRobot, home: Posture, leg: Leg) -> str:
    """Return the reason why a leg is singular: at home only, or in all postures."""
    rng = np.random.default_rng(0)
    k = robot.legs.index(leg)
    elsewhere = []
    for _ in range(EXAMINED_POSTURES):
        displacement = rng.uniform(-1.0, 1.0, home.q.shape)
        elsewhere.append(Posture(home.q + displacement, home.pose))
    for posture in elsewhere:
        leg_link = leg_links(robot, posture)[k]
        if not float(_leg_rcond(leg_link, leg_link)[0]) < SINGULAR:
            return "is singular at home (stretched or folded)"
    return (
        f"is singular in all postures: its joints do not move its {leg.end} end in {leg.chain.n} independent "
        "ways (parallel axes behind a spherical end?)"
    )


def coordinates_of(mechanism: ClosedRobot, posture: Posture) -> np.ndarray:
    """Return the platform coordinates (N, r) of postures, relative to home: position, roll-pitch-yaw in base axes."""
    home = mechanism.robot.home
    rotation = posture.pose[:, :3, :3]
    position = posture.pose[:, :3, 3]
    turned = rotation @ home[:3, :3].T
    angles = Rotation.from_matrix(turned).as_euler("xyz")
    shift = position - home[:3, 3]
    full = np.hstack([shift, angles])
    return full[:, mechanism.robot.selected]


def pose_of(mechanism: ClosedRobot, coordinates: np.ndarray) -> np.ndarray:
    """Return platform poses (N, 4, 4) at coordinates (N, r); coordinates that are not freedoms are zero."""
    home = mechanism.robot.home
    full = np.zeros((len(coordinates), 6))
    full[:, mechanism.robot.selected] = coordinates
    turn = Rotation.from_euler("xyz", full[:, 3:]).as_matrix()
    pose = np.tile(home, (len(full), 1, 1))
    pose[:, :3, 3] += full[:, :3]
    pose[:, :3, :3] = turn @ home[:3, :3]
    return pose


def twists(
    mechanism: ClosedRobot, links: Sequence[LegLinks], shifts: Sequence[np.ndarray] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return D (N, 6, r) and t_0 (N, 6) such that all legs can follow the platform's twists t_0 + D v.

    v (r,) are the components of the twist that are named as freedoms.

    Args:
        mechanism: the robot.
        links: Jacobians and gaps of the legs.
        shifts: for each leg (N, c), the right-hand side e in J q̇ = G t - e; None: zero.
    """
    robot = mechanism.robot
    count = len(links[0].gap)
    if mechanism.fixed:
        freedoms = np.eye(6)[:, robot.selected]
        D = np.broadcast_to(freedoms, (count, 6, robot.r))
        return D, np.zeros((count, 6))
    from calib.parallel.mechanism import closure_kernels

    # least squares in the components that are no freedoms, in which the constraints have full rank
    bound = [k for k in range(6) if k not in robot.selected]
    rows = []
    right_sides = []
    for k, link in enumerate(links):
        across = _across(link)
        constraints = across @ link.carried
        rows.append(constraints[:, :, bound])
        known = np.zeros((*link.gap.shape, robot.r + 1))
        known[:, :, :-1] = -constraints[:, :, robot.selected]
        if shifts is not None:
            known[:, :, -1] = times(across, shifts[k])
        right_sides.append(known)
    matrix = np.concatenate(rows, axis=1)
    right = np.concatenate(right_sides, axis=1)
    solution = np.empty((count, len(bound), robot.r + 1))
    closure_kernels.least_squares(matrix, right, solution)
    D = np.zeros((count, 6, robot.r))
    D[:, robot.selected] = np.eye(robot.r)
    D[:, bound] = solution[:, :, :-1]
    t_0 = np.zeros((count, 6))
    t_0[:, bound] = solution[:, :, -1]
    return D, t_0


def _across(link: LegLinks) -> np.ndarray:
    """Return 1 - J J⁺ (N, c, c), which projects on the closure equations that the leg's joints cannot meet."""
    return np.eye(link.gap.shape[1]) - link.jacobian @ link.inverse


def _reading_rows(mechanism: ClosedRobot, links: Sequence[LegLinks]) -> np.ndarray:
    """Return J_p^inv (N, n, r), which maps the independent parts of the platform's twist to rates of the encoders.

    Source: eqs 5 and 15 of Briot, Gautier & Krut (2013) with B_p = -1.
    """
    D, _ = twists(mechanism, links)
    joints = joint_rates(links, D)
    return joints[:, mechanism.robot.actuated]


def joint_rates(links: Sequence[LegLinks], D: np.ndarray) -> np.ndarray:
    """Return the Jacobian (N, n_t, r) of all joints of the tree by the independent parts v of the twist D v."""
    by_leg = [link.inverse @ (link.carried @ D) for link in links]
    return np.concatenate(by_leg, axis=1)


def _check_postures(mechanism: ClosedRobot, posture: Posture) -> None:
    """Raise NoPosture for postures at a singularity, or on another branch than home.

    Raises:
        NoPosture: naming the sample, the leg or the platform, and the type: 1 (a leg is stretched or folded), 2 (the
            actuators do not hold the platform).
    """
    links = leg_links(mechanism.robot, posture)
    home = leg_links(mechanism.robot, mechanism.home)
    rows = _reading_rows(mechanism, links)
    signs = _determinants(mechanism, links, rows)
    other_branch = signs * mechanism.signs < 0
    for k, (leg, link, home_link) in enumerate(zip(mechanism.robot.legs, links, home)):
        weak = _leg_rcond(link, home_link) < SINGULAR
        _refuse(mechanism, posture, weak, f"{leg.name} is singular (type 1: stretched or folded)")
        _refuse(mechanism, posture, other_branch[:, k], f"{leg.name} is on another branch than at home")
    home_rows = _reading_rows(mechanism, home)
    weak = _platform_rcond(mechanism, rows, home_rows) < SINGULAR
    _refuse(mechanism, posture, weak, "the platform is singular (type 2: locked actuators do not hold it)")
    _refuse(mechanism, posture, other_branch[:, -1], "the platform is beyond a type 2 singularity from home")


def _refuse(mechanism: ClosedRobot, posture: Posture, bad: np.ndarray, message: str) -> None:
    """Raise NoPosture with a message if any sample is bad; the message names the first such sample."""
    if not bad.any():
        return
    indices = np.flatnonzero(bad)
    if len(indices) > 1:
        message += f" ({len(indices)} of {len(bad)} samples)"
    location = _where(mechanism, posture[indices[:1]])
    raise NoPosture(f"sample {indices[0] + 1}, platform at {location}: {message}", indices.tolist())


def _where(mechanism: ClosedRobot, posture: Posture) -> str:
    """Return the platform's coordinates at one posture as text."""
    (values,) = coordinates_of(mechanism, posture)
    coordinates = [f"{name} = {value:.4g}" for name, value in zip(mechanism.robot.freedom, values)]
    return ", ".join(coordinates)


def _reached(
    mechanism: ClosedRobot, goals: np.ndarray, coordinates: np.ndarray, aim: _Aim, start: Posture | None
) -> Posture:
    """Return the postures at given readings or coordinates, by Newton's method in steps from home.

    Args:
        mechanism: the robot.
        goals: (N, k) readings or coordinates to be reached.
        coordinates: (k,) their values at home.
        aim: function that returns the platform's twist towards the goals.
        start: nearby postures at which Newton's method starts; None: home.
    """
    if not len(goals):
        return mechanism.home[:0]
    if start is not None:
        return _newton(mechanism, start, goals, aim)
    is_record = False
    if len(goals) > 2 * SPACING:
        changes = np.abs(np.diff(goals, axis=0))
        is_record = bool(changes.max() < MAX_STRIDE / SPACING)
    if is_record:
        first = _reached(mechanism, goals[::SPACING], coordinates, aim, None)
        nearest = (np.arange(len(goals)) + SPACING // 2) // SPACING
        nearest = np.minimum(nearest, len(first) - 1)
        posture = _newton(mechanism, first[nearest], goals, aim)
    else:
        travel = goals - coordinates
        strides = np.abs(travel).max() / MAX_STRIDE
        count = max(1, int(np.ceil(strides)))
        posture = mechanism.home[np.zeros(len(goals), dtype=int)]
        for share in np.arange(1, count) / count:
            posture = _newton(mechanism, posture, coordinates + share * travel, aim, rough=True)
        posture = _newton(mechanism, posture, goals, aim)
    _check_postures(mechanism, posture)
    return posture


def _newton(mechanism: ClosedRobot, start: Posture, goals: np.ndarray, aim: _Aim, rough: bool = False) -> Posture:
    """Return the postures near `start` at the goals, by Newton's method.

    Args:
        mechanism: the robot.
        start: N postures at which the method starts.
        goals: (N, k) readings or coordinates to be reached.
        aim: function that returns the platform's twist towards the goals.
        rough: whether `ROUGH_STEPS` steps suffice.

    Raises:
        NoPosture: if a loop cannot be closed.
    """
    q = np.array(start.q)
    pose = np.array(start.pose)
    open_rows = np.arange(len(q))
    max_steps = MAX_STEPS
    if rough:
        max_steps = ROUGH_STEPS
    for _ in range(max_steps):
        posture = Posture(q[open_rows], pose[open_rows])
        links = leg_links(mechanism.robot, posture)
        D, t = twists(mechanism, links, [link.gap for link in links])
        independent = aim(mechanism, links, D, t, posture, goals[open_rows])
        twist = t + times(D, independent)
        leg_steps = []
        leg_gaps = []
        for link in links:
            gap_after = times(link.carried, twist) - link.gap
            leg_steps.append(times(link.inverse, gap_after))
            leg_gaps.append(np.abs(link.gap).max(axis=1))
        steps = np.concatenate(leg_steps, axis=1)
        joint_step = np.abs(steps).max(axis=1)
        platform_step = np.abs(twist).max(axis=1)
        size = np.maximum(joint_step, platform_step)
        share = BOUND / np.maximum(size, 1e-300)
        share = np.minimum(1.0, share)[:, None]
        q[open_rows] += share * steps
        pose[open_rows] = _moved(posture.pose, share * twist)
        gap = np.max(leg_gaps, axis=0)
        is_closed = np.maximum(size, gap) < CLOSED
        open_rows = open_rows[~is_closed]
        if not len(open_rows):
            break
    if len(open_rows) and not rough:
        _tell_unreached(mechanism, Posture(q, pose), open_rows)
    return Posture(q, pose)


def _tell_unreached(mechanism: ClosedRobot, posture: Posture, unreached: np.ndarray) -> None:
    """Raise NoPosture for samples whose loops Newton's method does not close, with the likely reason."""
    first = posture[unreached[:1]]
    home = leg_links(mechanism.robot, mechanism.home)
    largest_gap = -np.inf
    farthest_leg = ""
    weak_leg = ""
    for leg, link, home_link in zip(mechanism.robot.legs, leg_links(mechanism.robot, first), home):
        gap = float(np.abs(link.gap).max())
        if gap > largest_gap:
            largest_gap = gap
            farthest_leg = leg.name
        if not weak_leg and float(_leg_rcond(link, home_link)[0]) < WEAK:
            weak_leg = leg.name
    gap_mm = 1e3 * largest_gap
    reason = "Newton's method does not converge: singularity (type 2) or contradictory readings"
    if gap_mm > 1.0:
        reason = f"{farthest_leg} stays {gap_mm:.3g} mm from its attachment: out of reach"
    elif weak_leg:
        reason = f"{weak_leg} is stretched or folded: a singularity (type 1), the end of its reach"
    if len(unreached) > 1:
        reason += f" ({len(unreached)} of {len(posture)} samples)"
    raise NoPosture(
        f"sample {unreached[0] + 1}: the loops of '{mechanism.robot.name}' cannot be closed (last try: platform at "
        f"{_where(mechanism, first)}): {reason}; check units, zeros and order of the encoders",
        unreached.tolist(),
    )


def _from_readings(
    mechanism: ClosedRobot, links: Sequence[LegLinks], D: np.ndarray, t: np.ndarray, posture: Posture, goals: np.ndarray
) -> np.ndarray:
    """Return the independent twist components (N, r) that bring the encoder readings closest to their targets."""
    leg_rates = [link.inverse @ link.carried for link in links]
    leg_steps = [times(link.inverse, link.gap) for link in links]
    by_twist = np.concatenate(leg_rates, axis=1)
    gap_steps = np.concatenate(leg_steps, axis=1)
    steps = gap_steps - times(by_twist, t)
    actuated = mechanism.robot.actuated
    errors = goals - posture.q[:, actuated] + steps[:, actuated]
    by_independent = by_twist[:, actuated] @ D
    return times(pseudo_inverse(by_independent), errors)


def _from_coordinates(
    mechanism: ClosedRobot, links: Sequence[LegLinks], D: np.ndarray, t: np.ndarray, posture: Posture, goals: np.ndarray
) -> np.ndarray:
    """Return the independent twist components (N, r) that move the platform to target coordinates (N, r)."""
    target = pose_of(mechanism, goals)
    present = posture.pose
    inverse_rotation = present[:, :3, :3].transpose(0, 2, 1)
    rotation = target[:, :3, :3] @ inverse_rotation
    turn = Rotation.from_matrix(rotation).as_rotvec()
    shift = target[:, :3, 3] - present[:, :3, 3]
    twist = np.hstack([shift, turn])
    return twist[:, mechanism.robot.selected]


def _moved(pose: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """Return poses (N, 4, 4) displaced by v and rotated by the rotation vector ω of twists [v; ω] (N, 6)."""
    result = np.array(pose)
    turn = twist[:, 3:]
    result[:, :3, 3] += twist[:, :3]
    if turn.any():
        rotation = Rotation.from_rotvec(turn).as_matrix()
        result[:, :3, :3] = rotation @ pose[:, :3, :3]
    return result


def _leg_rcond(links: LegLinks, home: LegLinks) -> np.ndarray:
    """Return reciprocal conditions (N,) of a leg's Jacobian; lengths are divided by the leg's longest lever at home."""
    travel = np.linalg.norm(home.full[0, :3], axis=0)
    rotation = np.linalg.norm(home.full[0, 3:], axis=0)
    turns = rotation > 0.5
    longest_lever = float(travel[turns].max(initial=0.0))
    length = max(longest_lever, 1e-6)
    is_position = np.arange(links.jacobian.shape[1]) < 3
    row_length = np.where(is_position, length, 1.0)
    by_row = row_length[:, None] / np.where(turns, 1.0, length)
    return _rcond(links.jacobian / by_row, links.inverse * by_row.T)


def _platform_rcond(mechanism: ClosedRobot, rows: np.ndarray, home: np.ndarray) -> np.ndarray:
    """Return reciprocal conditions (N,) of J_p^inv; translations and rotations are divided by their maxima at home.

    Args:
        mechanism: the robot.
        rows: (N, n, r) J_p^inv.
        home: (1, n, r) J_p^inv at home.
    """
    turns = mechanism.robot.selected > 2
    size = np.linalg.norm(home[0], axis=0)
    turn_size = size[turns].max(initial=0.0)
    shift_size = size[~turns].max(initial=0.0)
    scale = np.where(turns, turn_size, shift_size)
    row_size = np.linalg.norm(home[0] / scale, axis=1)
    scaled = rows / scale / row_size[:, None]
    return _rcond(scaled, pseudo_inverse(scaled))


def _rcond(J: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Return 1 / (|J| |J⁻|) (N,) in Frobenius norms, a lower bound of the reciprocal condition number."""
    matrix_norm = np.linalg.norm(J, axis=(1, 2))
    inverse_norm = np.linalg.norm(inverse, axis=(1, 2))
    condition = matrix_norm * inverse_norm
    reciprocal = 1.0 / np.maximum(condition, 1e-300)
    return np.where(np.isfinite(condition), reciprocal, 0.0)


def _determinants(mechanism: ClosedRobot, links: Sequence[LegLinks], rows: np.ndarray) -> np.ndarray:
    """Return signs (N, L + 1) of determinants: of a minor of each leg's Jacobian, and of J_p^inv (0 if not square).

    Args:
        mechanism: the robot.
        links: Jacobians of the legs.
        rows: (N, n, r) J_p^inv.
    """
    signs = []
    for link, minor in zip(links, mechanism.minors):
        determinant = np.linalg.det(link.jacobian[:, minor])
        signs.append(np.sign(determinant))
    last = np.zeros(len(links[0].gap))
    if not mechanism.robot.redundant:
        last = np.sign(np.linalg.det(rows))
    return np.column_stack([*signs, last])


def _best_rows(J: np.ndarray) -> np.ndarray:
    """Return the indices of n rows of J (c, n) whose determinant is far from zero."""
    factors = scipy.linalg.qr(J.T, mode="r", pivoting=True)
    pivots = np.asarray(factors[-1])
    return np.sort(pivots[: J.shape[1]])


def _check_freedom(robot: ParallelRobot, home: Posture, links: Sequence[LegLinks]) -> bool:
    """Return whether the platform has the named freedoms in the whole workspace; raise if their number is wrong.

    Raises:
        RobotError: for another number of freedoms than named, or names that do not distinguish them.
    """
    freedoms = np.eye(6)[:, robot.selected]
    fixed = True
    rng = np.random.default_rng(0)
    free = ClosedRobot(robot, home, (), np.zeros(0), False)
    for trial in range(FREEDOM_POSTURES):
        rows = [_across(link) @ link.carried for link in links]
        constraints = np.concatenate(rows, axis=1)[0]
        _, singular, axes = np.linalg.svd(constraints)
        min_singular = RANK_TOLERANCE * max(1.0, singular[0])
        rank = int((singular > min_singular).sum())
        remaining = 6 - rank
        free_motions = axes[6 - remaining :]
        if remaining != robot.r:
            robot.refuse(
                f"its platform has {remaining} freedoms, but the key 'freedom' lists {robot.r} "
                f"({', '.join(robot.freedom)}); its free motions are {_motions(free_motions)}"
            )
        if np.linalg.cond(free_motions[:, robot.selected]) > MAX_FREEDOM_CONDITION:
            motions = _motions(free_motions)
            robot.refuse(
                f"the platform can move in {motions}, but the key 'freedom' lists {', '.join(robot.freedom)}: "
                "correct it"
            )
        violation = float(np.abs(constraints @ freedoms).max())
        fixed = fixed and violation < RANK_TOLERANCE
        if trial == FREEDOM_POSTURES - 1:
            break
        # Home may be a special posture: the freedoms are also counted a little away from it.
        direction = rng.uniform(-1.0, 1.0, robot.r)
        step = FREEDOM_DISTANCE * (robot.upper - robot.lower) * direction
        neighbour = _newton(free, home, step[None], _from_coordinates)
        links = leg_links(robot, neighbour)
    return fixed


def _motions(rows: np.ndarray) -> str:
    """Return, as text, the names of the components of twists (k, 6) that are not zero in all of them."""
    sizes = np.linalg.norm(rows, axis=0)
    names = [name for name, size in zip(COORDINATES, sizes) if size > 1e-6]
    return ", ".join(names) or "none"
