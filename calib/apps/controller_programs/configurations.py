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

from calib.controllers.table import Controller
from calib.geometry import inverse
from calib.geometry.inverse import Goal
from calib.robot.chain import AXES, Chain
from calib.robot.kinematics import joint_frames

CLEAR = (0.01, 0.001)  # [m], [m²] the upright posture is clearly before axis 1, and its elbow clearly bent
SLACK = np.radians(0.5)  # [rad] an angle that is rounded onto a boundary is on both sides of it
TRIES = 4000  # random postures among which starts in the configuration are looked for
STARTS = 24  # starts for each configuration, in its branch, and as many again where a pose has no posture yet
ROUNDS = 3  # times that this many starts are tried
STRAY = 6  # starts in any branch: what else reaches the pose is said where the configuration does not
MET = (1e-6, 1e-5)  # [m], [rad] a posture that leaves less reaches its pose
MEETING = 2e-3  # [m] axes that pass each other closer than this meet
SAME = 1e-3  # [rad] postures that differ by less are one
TURN = 2.0 * np.pi
WRAPS = (-2, -1, 0, 1, 2)  # whole turns of a joint that are tried


@dataclass(frozen=True)
class Configuration:
    """What a program says of the posture at a pose.

    Attributes:
        text: as the program has it.
        before, elbow, wrist: +1 or -1 of wrist centre, elbow and axis 5 (see the module); 0 where not said.
        ranges: joint (from 0) → least and largest angle that the controller shows [rad].
        upright: posture [rad] in which `before` and `elbow` are +1.
    """

    text: str
    before: int = 0
    elbow: int = 0
    wrist: int = 0
    ranges: dict[int, tuple[float, float]] = field(default_factory=dict)
    upright: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def signs(self) -> tuple[int, int, int]:
        """Return `before`, `elbow` and `wrist`."""
        return self.before, self.elbow, self.wrist

    def agrees(self, chain: Chain, q: np.ndarray) -> np.ndarray:
        """Return which of some postures (m, n) [rad] have the signs that are said (m,); turns are not looked at."""
        stood, signs = signs_at(chain, q, np.array(self.upright)), np.array(self.signs())
        return np.all((signs == 0) | (stood == 0) | (stood == signs), axis=1)

    def wrapped(self, controller: Controller, goal: Goal, q: np.ndarray, reference: np.ndarray) -> np.ndarray:
        """Return postures (m, n) with whole turns added: within limits and ranges, and else nearest to `near`.

        A posture that no turns bring into the ranges is NaN.
        """
        lower, upper = np.broadcast_to(goal.lower, q.shape), np.broadcast_to(goal.upper, q.shape)
        best = np.full(q.shape, np.nan)
        for joint in range(q.shape[1]):
            smallest, largest = self.ranges.get(joint, (-np.inf, np.inf))
            cost = np.full(len(q), np.inf)
            for turns in WRAPS if goal.cell.chain.joints[joint].kind == "revolute" else (0,):
                angle = q[:, joint] + TURN * turns
                allowed = (angle >= lower[:, joint] - 1e-9) & (angle <= upper[:, joint] + 1e-9)
                allowed &= (angle >= smallest - SLACK) & (angle <= largest + SLACK)
                away = np.where(allowed, np.abs(angle - reference[joint]), np.inf)
                closer = away < cost
                best[closer, joint], cost[closer] = angle[closer], away[closer]
        return best

    def holds(self, controller: Controller, chain: Chain, q: np.ndarray) -> np.ndarray:
        """Return which postures (m, n) [rad] have the signs and the turns that are said (m,)."""
        allowed = self.agrees(chain, q)
        for joint, (smallest, largest) in self.ranges.items():
            allowed &= (q[:, joint] >= smallest - SLACK) & (q[:, joint] <= largest + SLACK)
        return allowed


def has_spherical_wrist(chain: Chain) -> bool:
    """Return whether an arm has six turning joints whose last three axes meet: the arms that configurations are of."""
    if chain.n != 6 or any(joint.kind != "revolute" for joint in chain.joints):
        return False
    frames = joint_frames(chain, np.zeros((1, 6)))
    points = frames[:, :, :3, 3]
    axes = np.stack([_direction(chain, frames, joint) for joint in range(6)])
    by_4 = _nearest_point(points[4], axes[4], points[3], axes[3])
    by_6 = _nearest_point(points[4], axes[4], points[5], axes[5])
    beside = np.cross(by_4 - points[3], axes[3]), np.cross(by_6 - points[5], axes[5]), by_4 - by_6
    return max(float(np.abs(distance).max()) for distance in beside) < MEETING


def configuration_of(controller: Controller, text: str) -> Configuration | None:
    """Return the configuration that a program says (`calib.apps.controller_programs.languages.Setting`); None for
    none."""
    readers = {"tp": _tp, "krl": _krl, "rapid": _rapid}
    reader = readers.get(controller.language)
    return reader(text.split(), controller) if reader and text else None


def _tp(fields: Sequence[str], controller: Controller) -> Configuration:
    letters = {entry.upper() for entry in fields if entry.isalpha()}
    turns = [int(entry) for entry in fields if not entry.isalpha()]
    before = _sign_of(letters, "T", "B")
    # behind axis 1 it is not known which elbow U and D mean
    elbow = 0 if before < 0 else _sign_of(letters, "U", "D")
    wrist = -_sign_of(letters, "N", "F")
    ranges = {0: (-np.pi, np.pi)}
    for joint, turn in zip((3, 4, 5), turns):
        ranges[joint] = (TURN * turn - np.pi, TURN * turn + np.pi)
    return Configuration(f"CONFIG {' '.join(fields)}", before, elbow, wrist, ranges)


def _sign_of(letters: set[str], positive: str, negative: str) -> int:
    """Return +1 or -1 by the letter that is among the letters; 0 where neither is."""
    if positive in letters:
        return 1
    return -1 if negative in letters else 0


def _krl(fields: Sequence[str], controller: Controller) -> Configuration:
    status, turn = int(fields[1]), int(fields[3])
    signs = [-1 if status & 1 else 1, 1 if status & 2 else -1, -1 if status & 4 else 1]
    ranges = {k: (-np.inf, 0.0) if turn >> k & 1 else (0.0, np.inf) for k in range(6)}
    home = (0.0, -np.pi / 2, np.pi / 2, 0.0, 0.0, 0.0)
    return Configuration(" ".join(fields), signs[0], signs[1], signs[2], ranges, home)


def _rapid(fields: Sequence[str], controller: Controller) -> Configuration:
    quarters = [int(entry) for entry in fields]
    ranges = {k: (np.pi / 2 * q, np.pi / 2 * (q + 1)) for k, q in zip((0, 3, 5), quarters)}
    by_cfx = 0 if controller.coupled else 1
    cfx = quarters[3]
    signs = [by_cfx * (-1 if cfx & bit else 1) for bit in (4, 2, 1)]
    return Configuration(f"confdata [{', '.join(fields)}]", signs[0], signs[1], signs[2], ranges)


def signs_at(chain: Chain, q: np.ndarray, upright: np.ndarray) -> np.ndarray:
    """Return the signs (m, 3) of wrist centre, elbow and axis 5 at postures (m, 6); 0 for none.

    None is at a boundary, and where the upright posture of this arm is at one: its zeros are not the maker's.

    Args:
        upright: (6,) posture whose wrist centre and elbow are +1.
    """
    raw = _distances(chain, np.vstack([upright, q]))
    reference = np.where(np.abs(raw[0]) > CLEAR, np.sign(raw[0]), 0.0)
    signs = np.sign(raw[1:]) * reference
    turned = np.sign(np.where(np.abs(q[:, 4]) < SLACK, 0.0, np.sin(q[:, 4])))
    return np.column_stack([signs, turned])


def _distances(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return how far (m, 2) the wrist centre is before axis 1, and beside the line from axis 2 to axis 3 (times its
    length); with a sign of its own for each arm."""
    frames = joint_frames(chain, q)
    points = frames[:, :, :3, 3]
    axes = np.stack([_direction(chain, frames, joint) for joint in range(6)])
    wrist = _nearest_point(points[4], axes[4], points[3], axes[3])
    ahead = np.cross(axes[1], axes[0])
    before = np.einsum("mi,mi->m", wrist - points[0], ahead)
    beside = np.einsum("mi,mi->m", np.cross(points[2] - points[1], wrist - points[2]), axes[1])
    return np.column_stack([before, beside])


def _direction(chain: Chain, frames: np.ndarray, joint: int) -> np.ndarray:
    element = chain.elements[int(chain.moving[joint])]
    return element.sign * frames[joint, :, :3, AXES.index(element.axis) % 3]


def _nearest_point(point: np.ndarray, axis: np.ndarray, second: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Return the points (m, 3) of lines (point, axis) nearest to other lines, which are not parallel to them."""
    between = second - point
    slope = np.einsum("mi,mi->m", axis, across)
    along = np.einsum("mi,mi->m", between, axis) - slope * np.einsum("mi,mi->m", between, across)
    return point + (along / np.maximum(1.0 - slope**2, 1e-12))[:, None] * axis


@dataclass(frozen=True, eq=False)
class Postures:
    """Postures of the nominal arm at m poses.

    Attributes:
        q: (m, n) [rad]; where the configuration has none, the nearest of another one, or the start.
        reasons: (m,) why there is none in the configuration, or why it is not the only one; "" where all is well.
        contradicted: (m,) whether the posture nearest to the start has another configuration.
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
    """Return the posture at each of some poses (m, 4, 4) that a configuration means.

    Postures are sought from random starts in the configuration, and from `start`. Of several that agree, the nearest to
    `start` is taken; without a start they are refused as not unique.

    Args:
        goal: the nominal arm with the tool, and its limits.
        poses: of the tool in the arm's base.
        configuration: of all these poses.
        controller: whose angles the ranges are.
        start: (n,) [rad] near which, or None.
        seed: of the starts.
    """
    chain = goal.cell.chain
    lower, upper = chain.sampling_limits()
    middle = np.clip(np.zeros(chain.n), lower, upper) if start is None else np.asarray(start, float)
    drawn = np.random.default_rng(seed).uniform(lower, upper, (TRIES, chain.n))
    fitting = drawn[configuration.agrees(chain, drawn)]
    solutions = [np.empty((0, chain.n)) for _ in poses]
    waiting = np.arange(len(poses))
    for k in range(ROUNDS):
        firsts = fitting[k * STARTS : (k + 1) * STARTS]
        if k == 0:
            firsts = np.vstack([middle, firsts, drawn[:STRAY]])
        goals = np.repeat(poses[waiting], len(firsts), axis=0)
        q = inverse.reach(goal, goals, np.tile(firsts, (len(waiting), 1)))
        met = _met(goal, q, goals).reshape(len(waiting), -1)
        q = q.reshape(len(waiting), len(firsts), -1)
        for index, row, reached in zip(waiting, q, met):
            solutions[index] = np.vstack([solutions[index], row[reached]])
        agreed = [len(_agreeing(goal, configuration, controller, solutions[index], middle)) for index in waiting]
        waiting = waiting[np.array(agreed, int) == 0]
        if not len(waiting):
            break
    chosen, reasons = np.tile(middle, (len(poses), 1)), []
    contradicted = np.zeros(len(poses), bool)
    for k, reached in enumerate(solutions):
        if not len(reached):
            reasons.append("")
            continue
        agreeing = _agreeing(goal, configuration, controller, reached, middle)
        nearby = Configuration("").wrapped(controller, goal, reached, middle)
        nearest = nearby[np.argmin(np.nan_to_num(np.abs(nearby - middle), nan=np.inf).max(axis=1))]
        chosen[k] = nearest
        if len(agreeing):
            chosen[k] = agreeing[np.argmin(np.abs(agreeing - middle).max(axis=1))]
        contradicted[k] = start is not None and not configuration.holds(controller, chain, nearest[None])[0]
        reasons.append(_objection(chain, configuration, reached, agreeing, start is not None))
    return Postures(chosen, tuple(reasons), contradicted)


def _agreeing(
    goal: Goal, configuration: Configuration, controller: Controller, reached: np.ndarray, reference: np.ndarray
) -> np.ndarray:
    """Return the distinct postures of some (k, n) that have a configuration, whole turns added as it says."""
    fitting = reached[configuration.agrees(goal.cell.chain, reached)]
    wrapped = configuration.wrapped(controller, goal, fitting, reference)
    wrapped = wrapped[np.isfinite(wrapped).all(axis=1)]
    distinct: list[np.ndarray] = []
    for q in wrapped:
        if all(np.abs(q - earlier).max() > SAME for earlier in distinct):
            distinct.append(q)
    return np.array(distinct).reshape(-1, reached.shape[1])


def _objection(
    chain: Chain, configuration: Configuration, reached: np.ndarray, agreeing: np.ndarray, started: bool
) -> str:
    """Return why the posture of a configuration is none, or not the only one; else an empty text."""
    if not len(agreeing) and configuration.agrees(chain, reached).any():
        return f"{configuration.text} has no posture at this pose: none within the joints' limits has its turns"
    if not len(agreeing):
        signs = np.unique(signs_at(chain, reached, np.array(configuration.upright)), axis=0)
        stood = "; ".join(", ".join(_sign_labels(row)) for row in signs)
        required = ", ".join(_sign_labels(np.array(configuration.signs()))) or "turns only"
        return f"{configuration.text} ({required}) is no posture at this pose; the arm reaches it with {stood}"
    if len(agreeing) > 1 and not started:
        return f"{configuration.text} leaves {len(agreeing)} postures"
    return ""


def _sign_labels(signs: np.ndarray) -> list[str]:
    """Return signs of wrist centre, elbow and axis 5 in words; nothing for 0."""
    labels = (("before axis 1", "behind axis 1"), ("elbow as upright", "elbow bent back"), ("axis 5 > 0", "axis 5 < 0"))
    return [pair[0 if sign > 0 else 1] for sign, pair in zip(signs, labels) if sign]


def _met(goal: Goal, q: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Return which postures (m, n) reach their poses (m,)."""
    difference = inverse.differences(goal, q, poses)
    position = np.linalg.norm(difference[:, :3], axis=1) <= MET[0]
    return position & (np.linalg.norm(difference[:, 3:], axis=1) <= MET[1])
