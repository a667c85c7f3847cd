"""Messages on measured and recorded files as they come: commanded joints, drift, another motion, reversed torques."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NoReturn

import numpy as np
from scipy.spatial import KDTree

from calib.column_changes import Change
from calib.data.poses.measurements import PoseMeasurements
from calib.data.poses.pose_lists import MAX_JOINT_DIFFERENCE
from calib.data.recordings.recording import Recording
from calib.errors import Finding, finding, refuse_data
from calib.geometry.checks.repeatability import drift_between, drift_within, noise_of_difference
from calib.identification.checks.recorded_motion import (
    DesignedMotion,
    LocatedMotion,
    another_motion,
    locate,
    nominal_share,
)  # fmt: skip
from calib.procedure.findings import lines_of
from calib.robot.chain import Chain

MIN_READBACK_DIFFERENCE = 1e-8  # [rad or m] closer to the commanded joints they were not read back
MIN_TRACKED_SHARE = 0.98  # of the motion, explained by a recorded period; below it is noted
MAX_TORQUE_RATIO = 10.0  # a factor between measured and nominal torques that no wrong mass explains


def readback(plan: np.ndarray, measured: PoseMeasurements) -> list[Finding]:
    """Return how far the joints read back are from those commanded (m, n) [rad or m]; nothing of other poses."""
    distance, index = (np.atleast_1d(found) for found in KDTree(plan).query(measured.q, p=np.inf))
    close = distance <= MAX_JOINT_DIFFERENCE
    if not close.any():
        return []
    off = np.abs(measured.q[close] - plan[index[close]])
    if off.max() < MIN_READBACK_DIFFERENCE:
        return [finding("readback-copied")]
    joint = measured.joint_names[int(np.argmax(off.max(axis=0)))]
    return [finding("readback", rms=np.sqrt(np.mean(off**2)), largest=off.max(), joint=joint)]


def drift(
    chain: Chain, blocks: Sequence[PoseMeasurements], again: Sequence[PoseMeasurements], sigma: float
) -> list[Finding]:
    """Return how far repeated poses differ: from those measured again at the end, and within each block.

    Args:
        chain: the nominal arm.
        blocks: measured for the fit.
        again: files whose name starts with drift.
        sigma: of one position, per axis [m]; 0: not known, then only the figure is given.
    """
    pairs = [(later.file, "again at the end", drift_between(chain, blocks, later)) for later in again]
    pairs += [(block.file, "more than once", drift_within(chain, block)) for block in blocks]
    return [
        finding(
            "poses-moved" if sigma and found.exceeds(sigma) else "poses-repeat", file=Path(file).name, when=when,
            poses=found.poses, rms=found.rms, noise=noise_of_difference(sigma) if sigma else None,
        )
        for file, when, found in pairs if found is not None
    ]  # fmt: skip


def check_motion(
    recording: Recording, motion: DesignedMotion, others: Mapping[str, DesignedMotion], wanted: int
) -> tuple[LocatedMotion, list[Finding]]:
    """Find the designed motion in a recording, and return what is worth a note.

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
        _refuse(recording, _other_motion(recording, motion, another_motion(recording, motion, others)))
    notes = []
    if found.periods < wanted:
        notes.append(finding("repetitions-missing", periods=found.periods, wanted=wanted))
    if found.likeness < MIN_TRACKED_SHARE:
        joint = recording.joint_names[found.loosest]
        notes.append(finding("tracking-loose", share=found.likeness, joint=joint))
    return found, notes


def _other_motion(recording: Recording, motion: DesignedMotion, found: Change | None) -> Finding:
    """Return what a recording without the designed motion is."""
    if found is None and recording.duration < motion.period:
        return finding("motion-short", duration=recording.duration, period=motion.period)
    if found is None:
        return finding("motion-unknown")
    names = recording.joint_names
    if found.code != "motion-altered":
        return finding(found.code, joints=[names[j] for j in found.joints], **found.values)
    unit, order, sign = (found.values[key] for key in ("unit", "order", "sign"))
    moved = [(names[column], names[j]) for j, column in enumerate(order) if column != j]
    return finding(
        found.code, unit="" if unit == 1.0 else "deg" if unit < 1.0 else "rad under a header that says deg",
        swapped=[f"the column of {column} holds {joint}" for column, joint in moved],
        reversed=[names[j] for j, one in enumerate(sign) if one < 0],
    )  # fmt: skip


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
    joints, size = [recording.joint_names[j] for j in sure], np.abs(share[sure])
    if (size > MAX_TORQUE_RATIO).all() or (size < 1 / MAX_TORQUE_RATIO).all():
        ratio = float(np.median(size))
        code = "torques-too-small" if ratio < 1 else "torques-too-large"
        _refuse(recording, finding(code, joints=joints, ratio=ratio))
    turned = [recording.joint_names[j] for j in sure if share[j] < 0]
    if turned:
        _refuse(
            recording, finding("torques-reversed" if turned == joints else "torque-of-joint-reversed", joints=turned)
        )


def _refuse(recording: Recording, found: Finding) -> NoReturn:
    refuse_data(recording.file, lines_of([found])[0])
