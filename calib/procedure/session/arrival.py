"""Messages on measured and recorded files as they come: commanded joints, drift, another motion, reversed torques."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from calib.data.poses.measurements import PoseMeasurements
from calib.data.poses.plans import MAX_JOINT_DIFFERENCE
from calib.data.recordings.recording import Recording
from calib.errors import MeasurementError
from calib.geometry.checks.drift import Drift, drift_between, drift_within, noise_of_difference
from calib.identification.checks.recorded_motion import (
    DesignedMotion,
    DifferentMotion,
    LocatedMotion,
    explain,
    locate,
    nominal_share,
)  # fmt: skip
from calib.robot.chain import Chain

MIN_READBACK_DIFFERENCE = 1e-8  # [rad or m] closer to the commanded joints they were not read back
MIN_TRACKED_SHARE = 0.98  # of the motion, explained by a recorded period; below it is noted
MAX_TORQUE_RATIO = 10.0  # a factor between measured and nominal torques that no wrong mass explains


def readback(plan: np.ndarray, measured: PoseMeasurements) -> list[str]:
    """Say how far the joints read back are from those commanded (m, n) [rad or m]."""
    distance, index = (np.atleast_1d(found) for found in KDTree(plan).query(measured.q, p=np.inf))
    close = distance <= MAX_JOINT_DIFFERENCE
    if not close.any():
        return []
    off = np.abs(measured.q[close] - plan[index[close]])
    if off.max() < MIN_READBACK_DIFFERENCE:
        return ["the joint values are the commanded ones to the last digit; log what the encoders read once it stands"]
    j = int(np.argmax(off.max(axis=0)))
    rms = 1e3 * float(np.sqrt(np.mean(off**2)))
    return [
        f"joints read back are off the commanded ones by {rms:.2g} mrad rms, {1e3 * off[:, j].max():.2g} at most "
        f"({measured.joint_names[j]})"
    ]


def drift(
    chain: Chain, blocks: Sequence[PoseMeasurements], again: Sequence[PoseMeasurements], sigma: float
) -> list[str]:
    """Say how far repeated poses differ: between fitted blocks and what was measured again at the end, and within each.

    Args:
        chain: the nominal arm.
        blocks: measured for the fit.
        again: files whose name starts with drift.
        sigma: of one position, per axis [m]; 0: not known, then only the figure is given.
    """
    found = [
        (f"{Path(later.file).name}: measured again at the end", drift_between(chain, blocks, later)) for later in again
    ]
    found += [(f"{Path(block.file).name}: measured more than once", drift_within(chain, block)) for block in blocks]
    return [_drift_words(label, one, sigma) for label, one in found if one is not None]


def _drift_words(label: str, found: Drift, sigma: float) -> str:
    words = f"{label}, {found.poses} poses differ by {1e3 * found.rms:.3g} mm rms"
    if not sigma:
        return words
    noise = f"{1e3 * noise_of_difference(sigma):.2g} mm"
    if found.exceeds(sigma):
        return (
            f"{words}, where noise alone gives {noise}: did base, tool or instrument move? Measure the "
            "base again, and the poses from where it began"
        )
    return f"{words}, as noise alone would ({noise})"


def check_motion(
    recording: Recording, motion: DesignedMotion, others: Mapping[str, DesignedMotion], wanted: int
) -> tuple[LocatedMotion, list[str]]:
    """Find the designed motion in a recording, and say what is worth a note.

    Args:
        recording: of n joints.
        motion: the one that was to be played.
        others: the session's other motions by name, to say if one of them was played instead.
        wanted: how many repetitions were asked for.

    Raises:
        MeasurementError: where it is not there, with what explains the recording.
    """
    found = locate(recording, motion)
    if found is None:
        raise MeasurementError(_other_motion(recording, motion, explain(recording, motion, others)), recording.file)
    notes = []
    if found.periods < wanted:
        notes.append(f"{found.periods} of {wanted} repetitions of the motion were recorded")
    if found.likeness < MIN_TRACKED_SHARE:
        name = recording.joint_names[found.loosest]
        explained = f"it explains {found.likeness:.1%}"
        notes.append(f"the robot follows the motion loosely ({explained}), {name} most: that is allowed")
    return found, notes


def _other_motion(recording: Recording, motion: DesignedMotion, found: DifferentMotion | None) -> str:
    """Return what a recording without the designed motion is."""
    if found is None:
        duration = recording.duration
        if duration < motion.period:
            return (
                f"{duration:.1f} s are shorter than one period of the motion ({motion.period:.1f} s): was it stopped?"
            )
        return (
            "this is another motion than the one designed here, in no order of joints, sign, unit or speed that was "
            "tried; play 6-excitation's, or set plan = false under [dynamics] in session.toml to identify from this one"
        )
    if found.name:
        return f"this is the {found.name} motion, which belongs into a file of its own"
    if found.speed != 1.0:
        return f"the motion is there at {found.speed:g} times its speed: a rehearsal? Record it at full speed"
    names, causes = recording.joint_names, []
    if found.unit != 1.0:
        causes.append(f"its positions are {'deg' if found.unit < 1.0 else 'rad under a header that says deg'}")
    if moved := [j for j, column in enumerate(found.order) if column != j]:
        pairs = ", ".join(f"the column of {names[found.order[j]]} holds {names[j]}" for j in moved)
        causes.append(f"columns are swapped ({pairs})")
    if turned := [names[j] for j, sign in enumerate(found.sign) if sign < 0]:
        causes.append(f"the sign is reversed ({', '.join(turned)})")
    return f"this is the designed motion if {' and '.join(causes)}; correct the header (or the options file)"


def check_torques(recording: Recording, chain: Chain) -> None:
    """Compare recorded torques with those of the nominal masses: reversed signs, other units.

    Raises:
        MeasurementError: where the torques of joints that carry much are reversed, or of another size.
    """
    if chain.inertias is None or recording.kind != "torque":
        return
    share = nominal_share(recording, chain)
    sure = np.flatnonzero(np.isfinite(share))
    if not len(sure):
        return
    names = ", ".join(recording.joint_names[j] for j in sure)
    size = np.abs(share[sure])
    if (size > MAX_TORQUE_RATIO).all() or (size < 1 / MAX_TORQUE_RATIO).all():
        guess = "are they mNm? Say so in the header (tau_… [mNm])"
        if np.median(size) < 1:
            guess = "are they currents (i_… [A]), or torques before the gear?"
        words = f"the torques of {names} are some {np.median(size):.2g} times what the nominal masses ask for"
        raise MeasurementError(f"{words}: {guess}", recording.file)
    if (share[sure] < 0).all():
        words = f"the torques of {names} push the wrong way for the nominal masses: reverse their sign"
        raise MeasurementError(words, recording.file)
    if turned := [recording.joint_names[j] for j in sure if share[j] < 0]:
        named, column = ", ".join(turned), f"column{'s' if len(turned) > 1 else ''}"
        raise MeasurementError(
            f"torque of {named} seems to have the wrong sign: it pushes against what the nominal masses ask for, where "
            f"the other joints' do not; negate the {column} of {named} in the log (or correct the nominal masses)",
            recording.file,
        )
