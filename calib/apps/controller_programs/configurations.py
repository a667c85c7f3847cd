"""Configurations of poses: which of an arm's postures a program means by ``CONFIG``, ``S`` and ``T``, or confdata.

Three of their statements are geometric, for arms with a spherical wrist: whether the wrist centre is before or behind
axis 1; on which side of the line from axis 2 to axis 3 it is (the elbow); the sign of axis 5. Controllers name them
against a posture in which they are known:

=========  ============================================================================================================
TP         ``N`` axis 5 < 0, ``F`` > 0; ``U`` the elbow of q = 0, ``D`` the other; ``T`` before axis 1, ``B`` behind;
           turns of axes 4, 5, 6: 0 within ±180°, 1 from 180 to 540°. Behind axis 1, U and D are not used: which elbow
           they mean there is published nowhere that we found
KRL        S, bit 0: behind axis 1; bit 1: the elbow of A2 = -90°, A3 = 90°; bit 2: A5 < 0. T, bit k: A(k+1) < 0
RAPID      quarter turns of axes 1, 4 and 6; cfx 0 to 7: + 4 behind axis 1, + 2 the elbow other than at q = 0, + 1 axis
           5 < 0. Arms with a parallelogram do not use cfx
=========  ============================================================================================================

Sources: FANUC: CURPOS.DG of an R-30iA (V7.70; joints 86.75 -45.63 -10.99 56.19 -81.55 -94.01 with CFG N U T, 0, 0, 0);
Remote Motion Interface (Turn4, Turn5, Turn6); visose/Robots, FanucPostProcessor.cs. KUKA System Software 8, Operating
and Programming Instructions, "Status and Turn". ABB, RAPID Instructions, Functions and Data Types, confdata.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from calib.toolkit.chains import AXES, Chain, Controller, joint_frames
from calib.toolkit.installations import Goal, differences, reach

# [m], [m²] the upright posture is clearly before axis 1, and its elbow clearly bent
CLEAR = (0.01, 0.001)
# [rad] an angle that is rounded onto a boundary is on both sides of it
SLACK = np.radians(0.5)
# random postures among which starts in the configuration are looked for
TRIES = 4000
# starts for each configuration, in its branch, and as many again where a pose has no posture yet
STARTS = 24
# times that this many starts are tried
ROUNDS = 3
# starts in any branch: what else reaches the pose is said where the configuration does not
STRAY = 6
# [m], [rad] a posture that leaves less reaches its pose
MAX_POSITION_ERROR, MAX_TURN_ERROR = 1e-6, 1e-5
# [m] axes that pass each other closer than this meet
MEETING = 2e-3
# [rad] postures that differ by less are one
SAME = 1e-3
TURN = 2.0 * np.pi
# whole turns of a joint that are tried
WRAPS = (-2, -1, 0, 1, 2)
# of wrist centre, elbow and axis 5: in words where the sign is positive, and negative
SIGN_LABELS = (
    ("before axis 1", "behind axis 1"),
    ("elbow as upright", "elbow bent back"),
    ("axis 5 > 0", "axis 5 < 0"),
)


@dataclass(frozen=True)
class Configuration:
    """The posture (one of several inverse-kinematics solutions) that a program prescribes at a pose.

    Attributes:
        text: the configuration as the program writes it.
        before, elbow, wrist: signs +1 or -1 for the wrist centre (+1: in front of axis 1), the elbow (+1: as in the
            posture `upright`) and axis 5 (the sign of its angle); 0 where the program does not prescribe one.
        ranges: joint index (from 0) to least and largest angle that the controller shows [rad].
        upright: (6,) posture [rad] in which `before` and `elbow` are +1.
    """

    text: str
    before: int = 0
    elbow: int = 0
    wrist: int = 0
    ranges: dict[int, tuple[float, float]] = field(default_factory=dict)
    upright: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def signs(self) -> tuple[int, int, int]:
        """Return the signs `before`, `elbow` and `wrist`."""
        return self.before, self.elbow, self.wrist

    def agrees(self, chain: Chain, q: np.ndarray) -> np.ndarray:
        """Return whether each posture q (m, n) [rad] has the prescribed signs, (m,) bool.

        Whole turns are not checked.

        Args:
            chain: the arm.
            q: postures.
        """
        posture_signs = signs_at(chain, q, np.array(self.upright))
        required = np.array(self.signs())
        undecided = (required == 0) | (posture_signs == 0)
        return np.all(undecided | (posture_signs == required), axis=1)

    def wrapped(self, controller: Controller, goal: Goal, q: np.ndarray, reference: np.ndarray) -> np.ndarray:
        """Return postures q (m, n) [rad] with whole turns (2π) added, within the limits and the prescribed ranges.

        Of several possible turns, the one nearest to `reference` (n,) is taken. Where no turn brings a joint into its
        range, the joint's value is NaN.

        Args:
            controller: the controller to whose angles the prescribed ranges refer.
            goal: the arm with its joint limits.
            q: postures.
            reference: joint values [rad].
        """
        lower = np.broadcast_to(goal.lower, q.shape)
        upper = np.broadcast_to(goal.upper, q.shape)
        best = np.full(q.shape, np.nan)
        for joint in range(q.shape[1]):
            smallest, largest = self.ranges.get(joint, (-np.inf, np.inf))
            low = np.maximum(lower[:, joint] - 1e-9, smallest - SLACK)
            high = np.minimum(upper[:, joint] + 1e-9, largest + SLACK)
            turning = goal.cell.chain.joints[joint].kind == "revolute"
            cost = np.full(len(q), np.inf)
            for turns in WRAPS if turning else (0,):
                angle = q[:, joint] + TURN * turns
                allowed = (angle >= low) & (angle <= high)
                away = np.where(allowed, np.abs(angle - reference[joint]), np.inf)
                closer = away < cost
                best[closer, joint] = angle[closer]
                cost[closer] = away[closer]
        return best

    def holds(self, controller: Controller, chain: Chain, q: np.ndarray) -> np.ndarray:
        """Return whether each posture q (m, n) [rad] has the prescribed signs and turns, (m,) bool.

        Args:
            controller: the controller to whose angles the prescribed turns refer.
            chain: the arm.
            q: postures.
        """
        allowed = self.agrees(chain, q)
        for joint, (smallest, largest) in self.ranges.items():
            angle = q[:, joint]
            allowed &= (angle >= smallest - SLACK) & (angle <= largest + SLACK)
        return allowed


def has_spherical_wrist(chain: Chain) -> bool:
    """Return whether the arm `chain` has six revolute joints of which the last three axes intersect in a point.

    Configurations are defined for such arms only.
    """
    if chain.n != 6 or any(joint.kind != "revolute" for joint in chain.joints):
        return False
    points, axes = _axes(chain, np.zeros((1, 6)))
    by_4 = _nearest_point(points[4], axes[4], points[3], axes[3])
    by_6 = _nearest_point(points[4], axes[4], points[5], axes[5])
    from_axis_4 = np.cross(by_4 - points[3], axes[3])
    from_axis_6 = np.cross(by_6 - points[5], axes[5])
    distances = np.abs([from_axis_4, from_axis_6, by_4 - by_6])
    return float(distances.max()) < MEETING


def configuration_of(controller: Controller, text: str) -> Configuration | None:
    """Return the configuration that a program's text prescribes; None if the text is empty.

    Args:
        controller: the robot's controller, whose language determines how the text is read.
        text: the configuration in the program, such as ``N U T, 0, 0, 0``.
    """
    readers = {"tp": _tp, "krl": _krl, "rapid": _rapid}
    reader = readers.get(controller.language)
    if reader is None or not text:
        return None
    return reader(text.split(), controller)


def _tp(fields: Sequence[str], controller: Controller) -> Configuration:
    letters, turns = set[str](), list[int]()
    for entry in fields:
        if entry.isalpha():
            letters.add(entry.upper())
        else:
            turns.append(int(entry))
    before = _sign_of(letters, "T", "B")
    elbow = _sign_of(letters, "U", "D")
    if before < 0:
        # behind axis 1 it is not known which elbow U and D mean
        elbow = 0
    wrist = -_sign_of(letters, "N", "F")
    ranges = {0: (-np.pi, np.pi)}
    for joint, turn in zip((3, 4, 5), turns):
        ranges[joint] = (TURN * turn - np.pi, TURN * turn + np.pi)
    return Configuration(f"CONFIG {' '.join(fields)}", before, elbow, wrist, ranges)


def _sign_of(letters: set[str], positive: str, negative: str) -> int:
    """Return +1 if the letter `positive` is in `letters`, -1 if the letter `negative` is, and 0 if neither is."""
    if positive in letters:
        return 1
    if negative in letters:
        return -1
    return 0


def _krl(fields: Sequence[str], controller: Controller) -> Configuration:
    status, turn = int(fields[1]), int(fields[3])
    before = -1 if status & 1 else 1
    elbow = 1 if status & 2 else -1
    wrist = -1 if status & 4 else 1
    ranges = {}
    for joint in range(6):
        negative = turn >> joint & 1
        ranges[joint] = (-np.inf, 0.0) if negative else (0.0, np.inf)
    home = (0.0, -np.pi / 2, np.pi / 2, 0.0, 0.0, 0.0)
    return Configuration(" ".join(fields), before, elbow, wrist, ranges, home)


def _rapid(fields: Sequence[str], controller: Controller) -> Configuration:
    quarter_1, quarter_4, quarter_6, cfx = map(int, fields)
    ranges = {}
    for joint, quarter in ((0, quarter_1), (3, quarter_4), (5, quarter_6)):
        ranges[joint] = (np.pi / 2 * quarter, np.pi / 2 * (quarter + 1))
    before = elbow = wrist = 0
    if not controller.coupled:
        before = -1 if cfx & 4 else 1
        elbow = -1 if cfx & 2 else 1
        wrist = -1 if cfx & 1 else 1
    return Configuration(f"confdata [{', '.join(fields)}]", before, elbow, wrist, ranges)


def signs_at(chain: Chain, q: np.ndarray, upright: np.ndarray) -> np.ndarray:
    """Return the signs (m, 3) of wrist centre, elbow and axis 5 at postures q (m, 6) [rad]; 0 where undefined.

    A sign is undefined where the posture is at the boundary between two configurations. It is also undefined where this
    arm is at a boundary in the posture `upright`: its joint zeros then differ from the robot manufacturer's.

    Args:
        chain: the arm.
        q: postures.
        upright: (6,) posture [rad] in which the signs of wrist centre and elbow are +1.
    """
    distances = _distances(chain, np.vstack([upright, q]))
    upright_distances = distances[0]
    is_clear = np.abs(upright_distances) > CLEAR
    reference = np.where(is_clear, np.sign(upright_distances), 0.0)
    signs = np.sign(distances[1:]) * reference
    wrist = np.sign(np.sin(q[:, 4]))
    wrist = np.where(np.abs(q[:, 4]) < SLACK, 0.0, wrist)
    return np.column_stack([signs, wrist])


def _distances(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return two signed measures (m, 2) of the wrist centre, whose signs distinguish the configurations.

    The first is the distance from axis 1 towards the front [m]. The second is the distance from the line between axes 2
    and 3, multiplied by that line's length [m²]. Which side is positive differs from arm to arm.

    Args:
        chain: an arm with a spherical wrist.
        q: (m, 6) postures [rad].
    """
    points, axes = _axes(chain, q)
    wrist = _nearest_point(points[4], axes[4], points[3], axes[3])
    ahead = np.cross(axes[1], axes[0])
    before = np.einsum("mi,mi->m", wrist - points[0], ahead)
    upper_arm, forearm = points[2] - points[1], wrist - points[2]
    beside = np.einsum("mi,mi->m", np.cross(upper_arm, forearm), axes[1])
    return np.column_stack([before, beside])


def _axes(chain: Chain, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a point on each joint's axis [m] and the axis' direction, both (n, m, 3), in the arm's base.

    Args:
        chain: the arm.
        q: (m, n) postures [rad].
    """
    frames = joint_frames(chain, q)
    directions = []
    for joint, element_index in enumerate(chain.moving):
        element = chain.elements[int(element_index)]
        column = AXES.index(element.axis) % 3
        directions.append(element.sign * frames[joint, :, :3, column])
    return frames[:, :, :3, 3], np.stack(directions)


def _nearest_point(point: np.ndarray, axis: np.ndarray, second: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Return, for each of m lines, the point (m, 3) nearest to a second line that is not parallel to it.

    Args:
        point, axis: (m, 3) a point on the line, and its unit direction.
        second, across: (m, 3) a point on the second line, and its unit direction.
    """
    between = second - point
    slope = np.einsum("mi,mi->m", axis, across)
    along = np.einsum("mi,mi->m", between, axis) - slope * np.einsum("mi,mi->m", between, across)
    distance = along / np.maximum(1.0 - slope**2, 1e-12)
    return point + distance[:, None] * axis


@dataclass(frozen=True, eq=False)
class Postures:
    """Postures of the nominal arm at m poses.

    Attributes:
        q: (m, n) joint values [rad]; where no posture has the configuration, the nearest posture of another
            configuration, or the start.
        reasons: (m,) why no posture has the configuration, or why several have it; empty where exactly one has it.
        contradicted: (m,) True where the posture nearest to the start has another configuration.
    """

    q: np.ndarray
    reasons: tuple[str, ...]
    contradicted: np.ndarray


def postures(
    goal: Goal,
    poses: np.ndarray,
    configuration: Configuration,
    controller: Controller,
    start: Sequence[float] | None = None,
    seed: int = 0,
) -> Postures:
    """Return the arm's posture at each of the poses (m, 4, 4) in the prescribed configuration.

    Postures are sought from random starts in the configuration, and from `start`. If several postures have the
    configuration, the nearest to `start` is returned; without a start, they are refused as not unique.

    Args:
        goal: the nominal arm with the tool, and its limits.
        poses: tool poses in the arm's base [m].
        configuration: configuration of all these poses.
        controller: the controller to whose angles the ranges of the configuration refer.
        start: (n,) joint values [rad] near which postures are preferred; None: no preference.
        seed: seed of the random starts.
    """
    chain = goal.cell.chain
    lower, upper = chain.sampling_limits()
    if start is None:
        middle = np.clip(np.zeros(chain.n), lower, upper)
    else:
        middle = np.asarray(start, float)
    drawn = np.random.default_rng(seed).uniform(lower, upper, (TRIES, chain.n))
    in_configuration = drawn[configuration.agrees(chain, drawn)]

    # all postures that reach each pose; more starts are tried where none of them has the configuration
    solutions = [np.empty((0, chain.n))] * len(poses)
    waiting = np.arange(len(poses))
    for k in range(ROUNDS):
        starts = in_configuration[k * STARTS : (k + 1) * STARTS]
        if k == 0:
            starts = np.vstack([middle, starts, drawn[:STRAY]])
        goals = np.repeat(poses[waiting], len(starts), axis=0)
        all_starts = np.tile(starts, (len(waiting), 1))
        q = reach(goal, goals, all_starts)
        met = _met(goal, q, goals).reshape(len(waiting), -1)
        q = q.reshape(len(waiting), len(starts), -1)
        without = []
        for index, reached, is_met in zip(waiting, q, met):
            solutions[index] = np.vstack([solutions[index], reached[is_met]])
            if not len(_agreeing(goal, configuration, controller, solutions[index], middle)):
                without.append(index)
        waiting = np.array(without, int)
        if not len(waiting):
            break

    chosen = np.tile(middle, (len(poses), 1))
    contradicted = np.zeros(len(poses), bool)
    reasons = []
    for k, reached in enumerate(solutions):
        if not len(reached):
            reasons.append("")
            continue
        # the nearest in any configuration, and the nearest in this one
        nearby = Configuration("").wrapped(controller, goal, reached, middle)
        distance = np.abs(nearby - middle)
        nearest = nearby[np.argmin(np.nan_to_num(distance, nan=np.inf).max(axis=1))]
        chosen[k] = nearest
        agreeing = _agreeing(goal, configuration, controller, reached, middle)
        if len(agreeing):
            distance = np.abs(agreeing - middle).max(axis=1)
            chosen[k] = agreeing[np.argmin(distance)]
        if start is not None:
            contradicted[k] = not configuration.holds(controller, chain, nearest[None])[0]
        reasons.append(_objection(chain, configuration, reached, agreeing, start is not None))
    return Postures(chosen, tuple(reasons), contradicted)


def _agreeing(
    goal: Goal, configuration: Configuration, controller: Controller, reached: np.ndarray, reference: np.ndarray
) -> np.ndarray:
    """Return the distinct postures that have the configuration, with its whole turns added.

    Args:
        goal: the nominal arm with the tool, and its limits.
        configuration: the prescribed configuration.
        controller: the controller to whose angles the configuration refers.
        reached: (k, n) postures that reach the pose [rad].
        reference: (n,) joint values to which the nearest turns are taken [rad].
    """
    in_configuration = reached[configuration.agrees(goal.cell.chain, reached)]
    wrapped = configuration.wrapped(controller, goal, in_configuration, reference)
    wrapped = wrapped[np.isfinite(wrapped).all(axis=1)]
    distinct: list[np.ndarray] = []
    for q in wrapped:
        if all(np.abs(q - earlier).max() > SAME for earlier in distinct):
            distinct.append(q)
    return np.array(distinct).reshape(-1, reached.shape[1])


def _objection(
    chain: Chain, configuration: Configuration, reached: np.ndarray, agreeing: np.ndarray, started: bool
) -> str:
    """Return why no posture has the configuration, or why several have it; empty where exactly one has it.

    Args:
        chain: the arm.
        configuration: the prescribed configuration.
        reached: (k, n) postures that reach the pose [rad].
        agreeing: postures with the configuration among them.
        started: whether a start is given, which decides between several postures.
    """
    if not len(agreeing) and configuration.agrees(chain, reached).any():
        return f"{configuration.text} has no posture at this pose: none within the joints' limits has the stated turns"
    if not len(agreeing):
        signs = signs_at(chain, reached, np.array(configuration.upright))
        alternatives = "; ".join(_sign_text(row) for row in np.unique(signs, axis=0))
        required = _sign_text(np.array(configuration.signs())) or "turns only"
        return f"{configuration.text} ({required}) is no posture at this pose; the arm reaches it with {alternatives}"
    if len(agreeing) > 1 and not started:
        return f"{configuration.text} is ambiguous: {len(agreeing)} postures agree with it"
    return ""


def _sign_text(signs: np.ndarray) -> str:
    """Return the signs of wrist centre, elbow and axis 5 in words; a sign of 0 is omitted."""
    labels = []
    for sign, (positive, negative) in zip(signs, SIGN_LABELS):
        if sign > 0:
            labels.append(positive)
        elif sign < 0:
            labels.append(negative)
    return ", ".join(labels)


def _met(goal: Goal, q: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Return whether each posture q (m, n) reaches the corresponding pose (m, 4, 4), (m,) bool.

    Args:
        goal: the arm with the tool, and the constrained pose components.
        q: postures.
        poses: target poses.
    """
    difference = differences(goal, q, poses)
    position_error = np.linalg.norm(difference[:, :3], axis=1)
    turn_error = np.linalg.norm(difference[:, 3:], axis=1)
    return (position_error <= MAX_POSITION_ERROR) & (turn_error <= MAX_TURN_ERROR)
