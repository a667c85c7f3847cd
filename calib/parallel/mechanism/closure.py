"""Solution of the closure equations: all joints and the platform pose from its coordinates or from encoders.

Newton's method on the closure equations of all legs at once, eliminated leg by leg:

    J_k δq_k = G_k t - e_k        tip velocity of leg k = rigid-body velocity of its attachment, e_k the gap
    δq_k = J_k⁺ (G_k t - e_k),    t = t_0 + D v    with v the independent parts of the platform's twist

From encoders, v minimises the distance to all readings, so that redundant ones have equal weights (eq. 16 of Briot,
Gautier & Krut 2013 is the same for velocities). Samples are solved together. Whatever the motion, a sample is reached
from home along a straight line in steps too short to jump to another branch; a minor of each leg's Jacobian, and with
as many actuators as freedoms that of the platform, must keep its sign along it.
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
    """N solutions: joints of the whole tree q (N, n_t) [rad or m], and poses of the platform (N, 4, 4)."""

    q: np.ndarray
    pose: np.ndarray

    def __len__(self) -> int:
        return len(self.q)

    def __getitem__(self, index) -> Posture:  # type: ignore[no-untyped-def]
        return Posture(self.q[index], self.pose[index])


@dataclass(frozen=True, eq=False)
class LegLinks:
    """One leg at N postures.

    Attributes:
        full: (N, 6, n) Jacobian of its end: velocity, angular velocity; jacobian: (N, c, n) its rows for the c closure
            equations.
        inverse: (N, n, c) J⁺.
        carried: (N, c, 6) G, which maps the platform's twist to the attachment's velocity.
        gap: (N, c) distance of the leg's end from the attachment [m, rad].
        lever: (N, 3) from the platform's origin to the attachment, in the base's axes.
    """

    full: np.ndarray
    jacobian: np.ndarray
    inverse: np.ndarray
    carried: np.ndarray
    gap: np.ndarray
    lever: np.ndarray


def leg_links(robot: ParallelRobot, posture: Posture) -> list[LegLinks]:
    """Return every leg's Jacobian, attachment and gap at postures, by rigid-body relations alone."""
    starts = robot.starts
    links = []
    for leg, start, end in zip(robot.legs, starts, starts[1:]):
        links.append(links_of(leg, posture.q[:, start:end], posture.pose))
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
    """Return Jacobian, attachment and gap of a leg at joint values q (N, n) and platform poses (N, 4, 4)."""
    from calib.parallel.mechanism import closure_kernels

    count, n = q.shape
    full = np.zeros((count, 6, n))
    inverse = np.zeros((count, n, leg.held))
    carried = np.zeros((count, leg.held, 6))
    gap = np.zeros((count, leg.held))
    lever = np.zeros((count, 3))
    bodies, tail = compiled(leg)
    # numba compiles per kind of array
    q = np.require(q, requirements=["C", "W"])
    pose = np.require(pose, requirements=["C", "W"])
    closure_kernels.legs(
        bodies.links, bodies.constants, tail, leg.attachment, q, pose, full, inverse, carried, gap, lever
    )
    return LegLinks(full, full[:, : leg.held], inverse, carried, gap, lever)


@lru_cache(maxsize=256)
def compiled(leg: Leg) -> tuple[Bodies, np.ndarray]:
    """Return a leg's arrays for the kernels: its bodies, and its end (4, 4) in its last body's turned frame."""
    bodies = bodies_of(leg.chain)
    turn = upright_turn(int(bodies.axes[-1]))
    return bodies, frozen(turn.T @ leg.chain.tail)


# gap and step [m or rad] below which a loop is closed
CLOSED = 1e-10
# of one step [rad or m]
BOUND = 0.5
# reciprocal condition below which a posture is called singular (our choice)
SINGULAR = 1e-4
# the same, where Newton's steps fail: that explains it (our choice)
WEAK = 0.02
# samples of a record of which the first is reached from home, the others from it
SPACING = 16
# of a reading or coordinate between two solutions on the way from home [rad or m] (our choice)
MAX_STRIDE = 0.25
# of Newton's method
MAX_STEPS = 60


@dataclass(frozen=True, eq=False)
class ClosedRobot:
    """A parallel robot whose loops close at home.

    Attributes:
        robot: the robot's legs and platform.
        home: posture at home, with one sample.
        minors: per leg, rows of its Jacobian; the sign of their determinant identifies the leg's branch.
        signs: (L + 1,) signs of these determinants at home; last the sign for the encoders' rows (0 if they are
            redundant).
        fixed: whether the platform's possible twists are the named freedoms in the whole workspace.
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
            start: nearby checked postures to start from, in which case the result is not checked again; None to start
                from home.

        Raises:
            NoPosture: for samples out of reach, or at or beyond a singularity.
        """
        readings = shaped(readings, (None, self.robot.n), f"readings of '{self.robot.name}'")
        return _reached(self, readings, self.home.q[0, self.robot.actuated], _from_readings, start)

    def place(self, coordinates: np.ndarray, start: Posture | None = None) -> Posture:
        """Return the postures at platform coordinates (N, r) [m, rad] relative to home; arguments and errors as in
        `locate`.
        """
        coordinates = shaped(coordinates, (None, self.robot.r), f"platform coordinates of '{self.robot.name}'")
        return _reached(self, coordinates, np.zeros(self.robot.r), _from_coordinates, start)


_Aim = Callable[[ClosedRobot, Sequence[LegLinks], np.ndarray, np.ndarray, Posture, np.ndarray], np.ndarray]


def closed(robot: ParallelRobot) -> ClosedRobot:
    """Return a robot with its loops closed at home; checking that its freedoms are those named.

    Raises:
        RobotError: if a loop does not close at home, home is singular, or the loops leave other freedoms than those
            named.
    """
    home_q = np.concatenate([leg.home for leg in robot.legs])
    start = Posture(home_q[None], robot.home[None])
    # each leg by itself, the platform at rest
    for _ in range(10):
        steps = [-times(link.inverse, link.gap) for link in leg_links(robot, start)]
        step = np.clip(np.concatenate(steps, axis=1), -BOUND, BOUND)
        start = Posture(start.q + step, start.pose)
    gap = max(float(np.abs(link.gap).max()) for link in leg_links(robot, start))
    # what the loops make of the platform's other coordinates
    with suppress(NoPosture, np.linalg.LinAlgError):
        if gap > CLOSED:
            free = ClosedRobot(robot, start, (), np.zeros(0), False)
            start = _newton(free, start, np.zeros((1, robot.r)), _from_coordinates)
    links = leg_links(robot, start)
    for leg, leg_link in zip(robot.legs, links):
        distance = float(np.abs(leg_link.gap).max())
        if distance > 1e3 * CLOSED:
            robot.refuse(
                f"the loop of {leg.name} does not close at the platform's home: its end stays "
                f"{1e3 * distance:.3g} mm (or mrad) from its attachment; check its home, base, attachment and lengths"
            )
        rcond = float(_leg_rcond(leg_link, leg_link)[0])
        if rcond < SINGULAR:
            robot.refuse(f"{leg.name} {_why_singular(robot, start, leg)} (rcond {rcond:.1g}): correct home or lengths")
    minors = tuple(_best_rows(link.jacobian[0]) for link in links)
    fixed = _check_freedom(robot, start, links)
    opened = ClosedRobot(robot, start, minors, np.zeros(len(links) + 1), fixed)
    rows = _reading_rows(opened, links)
    rcond = float(_platform_rcond(opened, rows, rows)[0])
    if rcond < SINGULAR:
        robot.refuse(
            f"home is singular (type 2): locked actuators do not hold the platform (rcond {rcond:.1g}); state "
            "another home"
        )
    signs = frozen(_determinants(opened, links)[0])
    return ClosedRobot(robot, start, minors, signs, fixed)


def _why_singular(robot: ParallelRobot, home: Posture, leg: Leg) -> str:
    """Return the reason why a leg is singular: at home only, or in all postures."""
    rng = np.random.default_rng(0)
    k = robot.legs.index(leg)
    elsewhere = []
    for _ in range(4):
        turned_q = home.q + rng.uniform(-1.0, 1.0, home.q.shape)
        elsewhere.append(Posture(turned_q, home.pose))
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
    turned = posture.pose[:, :3, :3] @ home[:3, :3].T
    angles = Rotation.from_matrix(turned).as_euler("xyz")
    shift = posture.pose[:, :3, 3] - home[:3, 3]
    return np.hstack([shift, angles])[:, mechanism.robot.selected]


def pose_of(mechanism: ClosedRobot, coordinates: np.ndarray) -> np.ndarray:
    """Return platform poses (N, 4, 4) at coordinates (N, r); coordinates that the loops determine are zero."""
    full = np.zeros((len(coordinates), 6))
    full[:, mechanism.robot.selected] = coordinates
    pose = np.tile(mechanism.robot.home, (len(full), 1, 1))
    pose[:, :3, 3] += full[:, :3]
    turn = Rotation.from_euler("xyz", full[:, 3:]).as_matrix()
    pose[:, :3, :3] = turn @ mechanism.robot.home[:3, :3]
    return pose


def twists(
    mechanism: ClosedRobot, links: Sequence[LegLinks], shifts: Sequence[np.ndarray] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return D (N, 6, r) and t_0 (N, 6): platform twists t_0 + D v that all legs can follow, v the independent parts.

    Args:
        shifts: (N, c) per leg, the right-hand side e in J q̇ = G t - e; None: zero.
    """
    robot = mechanism.robot
    count = len(links[0].gap)
    if mechanism.fixed:
        D = np.eye(6)[:, robot.selected]
        return np.broadcast_to(D, (count, 6, robot.r)), np.zeros((count, 6))
    rows = []
    right = []
    for k, link in enumerate(links):
        across = np.eye(link.gap.shape[1]) - link.jacobian @ link.inverse
        rows.append(across @ link.carried)
        if shifts is None:
            right.append(np.zeros_like(link.gap))
        else:
            right.append(times(across, shifts[k]))
    U, s, Vt = np.linalg.svd(np.concatenate(rows, axis=1), full_matrices=False)
    rank = 6 - robot.r
    free = Vt[:, rank:].transpose(0, 2, 1)
    D = free @ np.linalg.inv(free[:, robot.selected])
    along = np.einsum("nkr,nk->nr", U[:, :, :rank], np.concatenate(right, axis=1)) / s[:, :rank]
    minimum = np.einsum("nrk,nr->nk", Vt[:, :rank], along)
    return D, minimum - times(D, minimum[:, robot.selected])


def _reading_rows(mechanism: ClosedRobot, links: Sequence[LegLinks]) -> np.ndarray:
    """Return J_p^inv (N, n, r), which maps the twist's independent parts to encoder rates (eqs 5, 15; B_p = -1)."""
    D, _ = twists(mechanism, links)
    joints = np.concatenate([link.inverse @ (link.carried @ D) for link in links], axis=1)
    return joints[:, mechanism.robot.actuated]


def _check_postures(mechanism: ClosedRobot, posture: Posture) -> None:
    """Raise NoPosture for postures at a singularity, or on another branch than home.

    Raises:
        NoPosture: naming the sample, the leg or the platform, and the type: 1 (a leg is stretched or folded), 2 (the
            actuators do not hold the platform).
    """
    links = leg_links(mechanism.robot, posture)
    home = leg_links(mechanism.robot, mechanism.home)
    signs = _determinants(mechanism, links)
    other_branch = signs * mechanism.signs < 0
    for k, (leg, link, home_link) in enumerate(zip(mechanism.robot.legs, links, home)):
        weak = _leg_rcond(link, home_link) < SINGULAR
        _refuse(mechanism, posture, weak, f"{leg.name} is singular (type 1: stretched or folded)")
        _refuse(mechanism, posture, other_branch[:, k], f"{leg.name} is on another branch than at home")
    rows, home_rows = _reading_rows(mechanism, links), _reading_rows(mechanism, home)
    weak = _platform_rcond(mechanism, rows, home_rows) < SINGULAR
    _refuse(mechanism, posture, weak, "the platform is singular (type 2: locked actuators do not hold it)")
    _refuse(mechanism, posture, other_branch[:, -1], "the platform is beyond a type 2 singularity from home")


def _refuse(mechanism: ClosedRobot, posture: Posture, bad: np.ndarray, message: str) -> None:
    if not bad.any():
        return
    indices = np.flatnonzero(bad)
    if len(indices) > 1:
        message += f" ({len(indices)} of {len(bad)} samples)"
    location = _where(mechanism, posture[indices[:1]])
    raise NoPosture(f"sample {indices[0] + 1}, platform at {location}: {message}", indices.tolist())


def _where(mechanism: ClosedRobot, posture: Posture) -> str:
    (values,) = coordinates_of(mechanism, posture)
    return ", ".join(f"{name} = {value:.4g}" for name, value in zip(mechanism.robot.freedom, values))


def _reached(
    mechanism: ClosedRobot, goals: np.ndarray, coordinates: np.ndarray, aim: _Aim, start: Posture | None
) -> Posture:
    """Return the postures at targets (N, k), found by Newton's method on a straight line from the values at home."""
    if not len(goals):
        return mechanism.home[:0]
    if start is not None:
        return _newton(mechanism, start, goals, aim)
    is_record = len(goals) > 2 * SPACING and np.abs(np.diff(goals, axis=0)).max() < MAX_STRIDE / SPACING
    if is_record:
        first = _reached(mechanism, goals[::SPACING], coordinates, aim, None)
        nearest = (np.arange(len(goals)) + SPACING // 2) // SPACING
        nearest = np.minimum(nearest, len(first) - 1)
        posture = _newton(mechanism, first[nearest], goals, aim)
    else:
        travel = goals - coordinates
        count = max(1, int(np.ceil(np.abs(travel).max() / MAX_STRIDE)))
        posture = mechanism.home[np.zeros(len(goals), dtype=int)]
        for share in np.arange(1, count) / count:
            posture = _newton(mechanism, posture, coordinates + share * travel, aim, rough=True)
        posture = _newton(mechanism, posture, goals, aim)
    _check_postures(mechanism, posture)
    return posture


def _newton(mechanism: ClosedRobot, start: Posture, goals: np.ndarray, aim: _Aim, rough: bool = False) -> Posture:
    """Return the postures near `start` that meet the targets, by Newton's method (two steps if `rough`)."""
    q = np.array(start.q)
    pose = np.array(start.pose)
    open_rows = np.arange(len(q))
    for _ in range(2 if rough else MAX_STEPS):
        posture = Posture(q[open_rows], pose[open_rows])
        links = leg_links(mechanism.robot, posture)
        D, t = twists(mechanism, links, [link.gap for link in links])
        independent = aim(mechanism, links, D, t, posture, goals[open_rows])
        twist = t + times(D, independent)
        leg_steps = [times(link.inverse, times(link.carried, twist) - link.gap) for link in links]
        steps = np.concatenate(leg_steps, axis=1)
        size = np.maximum(np.abs(steps).max(axis=1), np.abs(twist).max(axis=1))
        share = np.minimum(1.0, BOUND / np.maximum(size, 1e-300))[:, None]
        q[open_rows] += share * steps
        pose[open_rows] = _moved(posture.pose, share * twist)
        gap = np.max([np.abs(link.gap).max(axis=1) for link in links], axis=0)
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
    largest_gap, farthest_leg, weak_leg = -np.inf, "", ""
    for leg, link, home_link in zip(mechanism.robot.legs, leg_links(mechanism.robot, first), home):
        gap = float(np.abs(link.gap).max())
        if gap > largest_gap:
            largest_gap, farthest_leg = gap, leg.name
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
    by_twist = np.concatenate([link.inverse @ link.carried for link in links], axis=1)
    gap_steps = np.concatenate([times(link.inverse, link.gap) for link in links], axis=1)
    steps = gap_steps - times(by_twist, t)
    actuated = mechanism.robot.actuated
    errors = goals - posture.q[:, actuated] + steps[:, actuated]
    return times(pseudo_inverse(by_twist[:, actuated] @ D), errors)


def _from_coordinates(
    mechanism: ClosedRobot, links: Sequence[LegLinks], D: np.ndarray, t: np.ndarray, posture: Posture, goals: np.ndarray
) -> np.ndarray:
    """Return the independent twist components (N, r) that move the platform to target coordinates (N, r)."""
    target = pose_of(mechanism, goals)
    rotation = target[:, :3, :3] @ posture.pose[:, :3, :3].transpose(0, 2, 1)
    turn = Rotation.from_matrix(rotation).as_rotvec()
    shift = target[:, :3, 3] - posture.pose[:, :3, 3]
    return np.hstack([shift, turn])[:, mechanism.robot.selected]


def _moved(pose: np.ndarray, twist: np.ndarray) -> np.ndarray:
    result = np.array(pose)
    result[:, :3, 3] += twist[:, :3]
    if twist[:, 3:].any():
        result[:, :3, :3] = Rotation.from_rotvec(twist[:, 3:]).as_matrix() @ pose[:, :3, :3]
    return result


def _leg_rcond(links: LegLinks, home: LegLinks) -> np.ndarray:
    """Return reciprocal conditions (N,) of a leg's Jacobian; lengths are scaled by its longest lever at home."""
    travel = np.linalg.norm(home.full[0, :3], axis=0)
    turns = np.linalg.norm(home.full[0, 3:], axis=0) > 0.5
    length = max(float(travel[turns].max(initial=0.0)), 1e-6)
    is_position = np.arange(links.jacobian.shape[1]) < 3
    row_length = np.where(is_position, length, 1.0)
    by_row = row_length[:, None] / np.where(turns, 1.0, length)
    return _rcond(links.jacobian / by_row, links.inverse * by_row.T)


def _platform_rcond(mechanism: ClosedRobot, rows: np.ndarray, home: np.ndarray) -> np.ndarray:
    """Return reciprocal conditions (N,) of J_p^inv; translations and rotations are scaled by their maxima at home."""
    turns = mechanism.robot.selected > 2
    size = np.linalg.norm(home[0], axis=0)
    turn_size, shift_size = size[turns].max(initial=0.0), size[~turns].max(initial=0.0)
    scale = np.where(turns, turn_size, shift_size)
    row_size = np.linalg.norm(home[0] / scale, axis=1)
    scaled = rows / scale / row_size[:, None]
    return _rcond(scaled, pseudo_inverse(scaled))


def _rcond(J: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Return 1 / (|J| |J⁻|) (N,) in Frobenius norms, a lower bound of the reciprocal condition number."""
    size = np.linalg.norm(J, axis=(1, 2)) * np.linalg.norm(inverse, axis=(1, 2))
    return np.where(np.isfinite(size), 1.0 / np.maximum(size, 1e-300), 0.0)


def _determinants(mechanism: ClosedRobot, links: Sequence[LegLinks]) -> np.ndarray:
    """Return the signs (N, L + 1) of the legs' minors, and of the platform's determinant if J_p^inv is square."""
    signs = []
    for link, minor in zip(links, mechanism.minors):
        signs.append(np.sign(np.linalg.det(link.jacobian[:, minor])))
    last = np.zeros(len(links[0].gap))
    if not mechanism.robot.redundant:
        last = np.sign(np.linalg.det(_reading_rows(mechanism, links)))
    return np.column_stack([*signs, last])


def _best_rows(J: np.ndarray) -> np.ndarray:
    """Return the indices of n rows of J (c, n) whose determinant is far from zero."""
    pivots = np.asarray(scipy.linalg.qr(J.T, mode="r", pivoting=True)[-1])
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
    for trial in range(4):
        rows = []
        for link in links:
            projection = np.eye(link.gap.shape[1]) - link.jacobian @ link.inverse
            rows.append(projection @ link.carried)
        constraints = np.concatenate(rows, axis=1)[0]
        _, singular, axes = np.linalg.svd(constraints)
        remaining = 6 - int((singular > 1e-9 * max(1.0, singular[0])).sum())
        free_motions = axes[6 - remaining :]
        if remaining != robot.r:
            robot.refuse(
                f"its platform has {remaining} freedoms, but the key 'freedom' lists {robot.r} "
                f"({', '.join(robot.freedom)}); its free motions are {_motions(free_motions)}"
            )
        if np.linalg.cond(free_motions[:, robot.selected]) > 1e8:
            motions = _motions(free_motions)
            robot.refuse(
                f"the platform can move in {motions}, but the key 'freedom' lists {', '.join(robot.freedom)}: "
                "correct it"
            )
        fixed = fixed and float(np.abs(constraints @ freedoms).max()) < 1e-9
        if trial == 3:
            break
        # a little away from home, where a special posture does not hide what the loops leave
        step = 0.05 * (robot.upper - robot.lower) * rng.uniform(-1.0, 1.0, robot.r)
        neighbour = _newton(free, home, step[None], _from_coordinates)
        links = leg_links(robot, neighbour)
    return fixed


def _motions(rows: np.ndarray) -> str:
    """Return the names of a twist's components that are nonzero in rows (k, 6)."""
    sizes = np.linalg.norm(rows, axis=0)
    names = [name for name, size in zip(COORDINATES, sizes) if size > 1e-6]
    return ", ".join(names) or "none"
