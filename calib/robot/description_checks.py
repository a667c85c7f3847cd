"""What a robot's description says that cannot be: limits that are none, bodies that cannot exist."""

import numpy as np

from calib.robot.chain import Chain, Joint
from calib.words import listing

TURNS = 4.0 * np.pi + 0.01  # [rad] a continuous wrist may be given two turns (our choice)


def remarks(chain: Chain, bodies: bool = True) -> tuple[str, ...]:
    """Return in words what a chain's description holds that looks wrong, by joint; nothing of a sound one.

    Args:
        bodies: with those that cannot exist.
    """
    found = (*chain.remarks, *unstated_limits(chain), *_turns(chain), *_massless(chain))
    return (*found, *impossible_bodies(chain)) if bodies else found


def unstated_limits(chain: Chain) -> tuple[str, ...]:
    """Return in words the limits of 0 or below, joints that share them together."""
    found: dict[str, list[str]] = {}
    for joint in chain.joints:
        for what in joint.unstated:
            found.setdefault(what, []).append(joint.name)
    return tuple(
        f"{', '.join(names)}: {what} in the robot's description is no limit; taken as not stated"
        for what, names in found.items()
    )


def _turns(chain: Chain) -> tuple[str, ...]:
    """Return in words the limits of revolute joints beyond two turns either way."""
    wide = {joint.name: _furthest(joint) for joint in chain.joints if joint.unit != "m"}
    wide = {name: angle for name, angle in wide.items() if TURNS < angle < np.inf}
    if not wide:
        return ()
    return (f"{listing(wide, 4)}: limits up to {max(wide.values()):g} rad in the robot's description; degrees?",)


def _furthest(joint: Joint) -> float:
    return max(-joint.lower, joint.upper)


def _massless(chain: Chain) -> tuple[str, ...]:
    """Return in words the bodies of which nothing is stated where others have masses."""
    if chain.inertias is None:
        return ()
    names = [joint.name for joint, body in zip(chain.joints, chain.inertias) if not body.any()]
    return (f"body behind {listing(names, 4)}: its mass is not stated, and counts as zero",) if names else ()


def impossible_bodies(chain: Chain) -> tuple[str, ...]:
    """Return in words, by joint, the bodies that cannot exist; nothing where masses are not known.

    A body has M > 0 and, about its centre of mass, positive principal moments of which none exceeds the sum of the
    others (triangle inequality; Wensing, Kim and Slotine, 2018, eq. 7). Its radius of gyration and its centre of mass
    lie within the stretched arm's length L, and the whole arm weighs no more than `max_density` L³.
    """
    if chain.inertias is None:
        return ()
    length, total = chain.stretched_length(), float(chain.inertias[:, 9].sum())
    found = {
        joint.name: words
        for joint, body in zip(chain.joints, chain.inertias)
        if body.any() and (words := _impossible(body, length))
    }
    same: dict[str, list[str]] = {}
    for name, words in found.items():
        same.setdefault(words.partition(" (")[0], []).append(name)
    lines = [f"body behind {listing(names, 4)}: {found[names[0]]}" for names in same.values()]
    # [kg/m³] of the arm's mass by the cube of its stretched length; arms known have 1 to 50 (our choice)
    max_density = 1000.0
    if total > max_density * length**3:
        lines.append(f"its bodies weigh {total:.4g} kg in all where the stretched arm is {length:.3g} m long: grams?")
    return tuple(lines)


def _impossible(body: np.ndarray, length: float, rounding: float = 1e-6, max_excess: float = 1.0) -> str:
    """Return why a body (10,) cannot exist, in words; nothing where it can.

    `rounding`: of M L²: moments below are rounding.

    `max_excess`: share by which a moment may exceed the sum of the others: rounded sets do by up to 0.7 (our choice).
    """
    mass, first = float(body[9]), body[6:9]
    if mass <= 0.0:
        return f"no mass (M = {mass:g} kg)" if mass == 0.0 else f"a negative mass (M = {mass:g} kg)"
    if np.linalg.norm(first) > mass * length:
        return f"a centre of mass beyond the arm ({np.linalg.norm(first) / mass:.3g} m from its joint: millimetres?)"
    xx, xy, xz, yy, yz, zz = body[:6]
    about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    moments = np.linalg.eigvalsh(about - (first @ first * np.eye(3) - np.outer(first, first)) / mass)
    if moments[2] > mass * length**2:
        reach = np.sqrt(moments[2] / mass)
        return f"an inertia of a body far larger than the arm (radius of gyration {reach:.3g} m: kg mm²?)"
    if moments[0] < -rounding * mass * length**2:
        return f"a negative moment of inertia ({moments[0]:.3g} kg m² about its centre of mass)"
    if moments[2] > (1.0 + max_excess) * (moments[0] + moments[1]) + rounding * mass * length**2:
        return f"an inertia that no body has (a moment beyond the sum of the others: {moments[2]:.3g} kg m²)"
    return ""
