"""What cannot be of this arm, and what that means for a verdict; all thresholds are our choice.

A finding that makes the numbers of a model wrong by far is no note under a pass: it fails, or holds the verdict at
marginal, until the options' ``accept`` says that it is meant. Findings of poses and their names:

unexplained   on rows left out even the chosen model leaves more than `NO_ARM` of the reach: fail
reflection    with the instrument's y turned the nominal arm fits `BETTER` times as well: its axes are left-handed: fail
sign          so with the signs of some joints reversed, and better than with y turned: fail
moved         the fit turned an element of the arm by more than `TURNED`, or moved it by more than `SHIFTED` of the
              reach, and no sign says why: marginal, or fail from `NO_MOUNTING` times that on, as no mounting is off.
              Sound arms at hand turned by 33 mrad at most (Motoman; UR5 12)
scale         one factor on all measured lengths takes away `SHARE` of the squares of the nominal arm's errors; off one
              by more than `FOREIGN` and 3 of its sigmas: fail, by more than `GROWN`: marginal, else a note; so where
              the fitted lengths grew together and that is more than `ALONE` of their change. No instrument is off by
              per cents, a badly printed board by one or two; two sizes of one maker's robots differ by more
commanded     less than `TOO_GOOD` remains, which no instrument measures: a note
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from calib.data.poses.measurements import PoseMeasurements, take
from calib.data.poses.pixels import Pixels
from calib.extensions import needed
from calib.geometry.accuracy import errors
from calib.geometry.checks.instrument_scale import Scale, length_factor, mirrored_rms, scale_of
from calib.geometry.checks.joint_signs import reversed_joints
from calib.geometry.installation import Installation
from calib.geometry.result import GeometricFit
from calib.procedure.findings import SpelledFinding as Finding
from calib.procedure.kinematic_stage.remarks import FLOOR, TOO_GOOD
from calib.words import listing

NO_ARM = 0.015
BETTER = 3.0
SHARE, LEAST, GROWN, FOREIGN, ALONE = 0.3, 1e-3, 5e-3, 0.025, 0.8
TURNED, SHIFTED = 0.1, 0.03  # [rad], of the reach
NO_MOUNTING = 5.0  # times these: 0.5 rad, 15 % of the reach
NAMED = 5  # elements in a sentence
LOOKED_AT = 100  # images


def findings(
    nominal: Installation,
    fit: GeometricFit,
    blocks: Sequence[PoseMeasurements],
    torques: Sequence[np.ndarray | None],
    left: float | None,
    reach: float,
) -> list[Finding]:
    """Return what is odd with the rows of a fit, what explains most first.

    Args:
        nominal: the arm as it was, placed.
        fit: of the calibrated one.
        blocks: the rows; torques: gravity torques (m, n) per block [N m].
        left: error of the chosen model on rows left out [m]; None where it was not computed.
        reach: of the arm [m].
    """
    before, after = (_rms(cell, blocks, torques) for cell in (nominal, fit.cell))
    remains = after if left is None else left
    shown, pulled = _as_positions(blocks, torques)
    wrong_way = _wrong_way(nominal, shown, pulled, before, reach)
    found = [*wrong_way, *([] if any(one.name == "sign" for one in wrong_way) else _moved(fit, reach))]
    found += [*_unexplained(remains, reach), *_commanded(before, after)]
    scale = scale_of(nominal, shown, pulled)
    if scale is not None and before * np.sqrt(1.0 - scale.explained) < NO_ARM * reach:
        found += _scale(scale) or _lengths(length_factor(fit))
    return found


def _as_positions(
    blocks: Sequence[PoseMeasurements], torques: Sequence[np.ndarray | None]
) -> tuple[list[PoseMeasurements], list[np.ndarray | None]]:
    """Return blocks and torques with some images as the poses they show: a board's square is the scale there."""
    shown = []
    for block, torque in zip(blocks, torques):
        if isinstance(block, Pixels):
            rows = np.unique(np.linspace(0, len(block) - 1, LOOKED_AT).astype(int))
            block, torque = (
                needed("camera_guess").pnp_poses(take(block, rows)),
                None if torque is None else torque[rows],
            )
        shown.append((block, torque))
    return [block for block, _ in shown], [torque for _, torque in shown]


def _unexplained(remains: float, reach: float) -> Iterator[Finding]:
    if remains > NO_ARM * reach:
        yield Finding(
            "unexplained", "fail",
            f"{1e3 * remains:.3g} mm rms remain on the measured rows, as of no arm of {reach:.1f} m reach: is it this "
            "robot, are units, joint order, signs and rows right, and did instrument and tool stay where they were?",
        )  # fmt: skip


def _wrong_way(
    nominal: Installation,
    blocks: Sequence[PoseMeasurements],
    torques: Sequence[np.ndarray | None],
    before: float,
    reach: float,
) -> list[Finding]:
    """Tell of joints or axes whose reversal lets the nominal arm explain the rows; of both, what leaves less."""
    if not before > FLOOR * reach:
        return []
    signs = reversed_joints(nominal, blocks, torques)
    mirrored = mirrored_rms(nominal, blocks, torques) if before > NO_ARM * reach else np.nan
    if signs is not None and signs.before > BETTER * signs.rms and not mirrored < signs.rms:
        names = [nominal.chain.joint_names[j] for j in signs.joints]
        several = len(names) > 1
        one = Finding(
            "sign", "fail",
            f"{_joined(names)} seem{'' if several else 's'} to turn the other way: with "
            f"{'their signs' if several else 'its sign'} reversed the nominal arm is off by {1e3 * signs.rms:.3g} mm "
            f"rms, as recorded by {1e3 * signs.before:.3g} mm: is the sign of a column reversed, or an axis of the "
            "robot's file?",
        )  # fmt: skip
        return [one]
    if before > BETTER * mirrored:
        one = Finding(
            "reflection", "fail",
            f"the instrument's axes seem left-handed: with y turned the nominal arm is off by {1e3 * mirrored:.3g} mm "
            f"rms, as measured by {1e3 * before:.3g} mm: is the sign of a column reversed, or are two exchanged?",
        )  # fmt: skip
        return [one]
    return []


def _moved(fit: GeometricFit, reach: float) -> list[Finding]:
    """Tell of elements of the arm that are further from their nominal than those of a sound arm."""
    told = []
    for element, value, nominal in zip(fit.cell.chain.elements, fit.cell.chain.values, fit.start.chain.values):
        change = float(value - nominal)
        if element.unit == "m" and abs(change) > SHIFTED * reach:
            told.append((abs(change) / (SHIFTED * reach), f"{element.name} by {1e3 * change:+.0f} mm"))
        change = (change + np.pi) % (2.0 * np.pi) - np.pi
        if element.unit == "rad" and abs(change) > TURNED:
            told.append((abs(change) / TURNED, f"{element.name} by {np.degrees(change):+.0f}°"))
    if not told:
        return []
    words = [each for _, each in sorted(told, reverse=True)]
    one = Finding(
        "moved", "fail" if max(told)[0] > NO_MOUNTING else "marginal",
        f"the fit moved {listing(words, NAMED)} from the nominal arm, further than any sound arm is off: is "
        "this the robot, does its file count a joint's angle from another zero or the other way, are the columns in "
        "its order?",
    )  # fmt: skip
    return [one]


def _joined(names: Sequence[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def _scale(found: Scale) -> list[Finding]:
    if found.explained < SHARE or abs(found.factor - 1.0) < LEAST:
        return []
    grown = 100.0 * (found.factor - 1.0)
    one = Finding(
        "scale", _level(found),
        f"all measured lengths are {abs(grown):.2g} % {'larger' if grown > 0 else 'smaller'} than the arm's, by one "
        f"factor, {found.factor:.4f} ± {found.sigma:.1g}, which explains {100 * found.explained:.0f} % of what the "
        f"nominal arm leaves: {_foreign(found)}is the instrument's (or a camera's target's) scale right? The "
        "fit takes it for the arm's",
    )  # fmt: skip
    return [one]


def _lengths(found: Scale | None) -> list[Finding]:
    """Tell that the fitted lengths grew together, whatever else of the nominal arm was wrong."""
    if found is None or abs(found.factor - 1.0) < max(LEAST, 3.0 * found.sigma):
        return []
    one = Finding(
        "scale", _level(found) if found.explained > ALONE else "pass",
        f"the fitted lengths are together {found.factor:.4f} ± {found.sigma:.1g} times the nominal ones, and that one "
        f"factor is {100 * found.explained:.0f} % of their change: {_foreign(found)}an arm may be so, the instrument's "
        "scale (or the size of a board's square) may be so, and these measurements do not tell which",
    )  # fmt: skip
    return [one]


def _foreign(found: Scale) -> str:
    return "is this the robot? If it is, " if _level(found) == "fail" else ""


def _level(found: Scale) -> str:
    off = abs(found.factor - 1.0)
    return "fail" if off - 3.0 * found.sigma > FOREIGN else "marginal" if off > GROWN else "pass"


def _commanded(before: float, after: float) -> Iterator[Finding]:
    if 0.0 < after < TOO_GOOD:
        whose = "the nominal arm" if before < TOO_GOOD else "the calibrated arm"
        size = before if before < TOO_GOOD else after
        yield Finding(
            "commanded", "pass",
            f"{whose} leaves {1e6 * size:.2g} µm rms, less than any instrument's noise: are these commanded or "
            "computed positions, not measured ones?",
        )  # fmt: skip


def _rms(cell: Installation, blocks: Sequence[PoseMeasurements], torques: Sequence[np.ndarray | None]) -> float:
    sizes = errors(cell, blocks, torques).main
    return float(np.sqrt(np.mean(sizes**2))) if len(sizes) else 0.0
