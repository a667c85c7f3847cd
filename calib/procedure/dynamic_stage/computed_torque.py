"""The computed-torque test: rms torque errors of the model on held-out motion, against a tolerance for each joint.

As in Kolyubin, Shiriaev & Jubien (2019), fig. 8, where the wrist's torque is predicted within 0.5 N m.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from calib.errors import UsageError, require
from calib.identification.prediction import Score


class TorqueTest(NamedTuple):
    """Result of one torque row.

    Attributes:
        recording: name of the held-out recording.
        row: name of the torque row.
        rms: rms error of the identified model's torque over the whole recording [N m or N], without what is above the
            identification band where that is most of the error; NaN: unknown.
        tolerance: largest accepted rms error [N m or N].
    """

    recording: str
    row: str
    rms: float
    tolerance: float

    def __str__(self) -> str:
        """Return row, error and tolerance as text."""
        return f"{self.row} {self.rms:.3g} (tolerance {self.tolerance:g})"

    @property
    def passed(self) -> bool | None:
        """Whether the error is within the tolerance; None if it is unknown: the joint is not tested."""
        if np.isnan(self.rms):
            return None
        return self.rms <= self.tolerance


def check_tolerances(tolerances: Sequence[float], joint_count: int) -> None:
    """Raise a UsageError if there is neither one tolerance, nor one for each joint.

    Args:
        tolerances: tolerances of the joints; empty: none.
        joint_count: number of joints.
    """
    count = len(tolerances)
    message = f"tolerance_torque: {count} numbers for {joint_count} joints; give one for each joint, or one for all"
    require(count in (0, 1, joint_count), message, UsageError)


def torque_tests(
    tolerances: Sequence[float], proofs: Mapping[str, Score], rows: Sequence[str], joint_count: int
) -> list[TorqueTest]:
    """Return the worst result of each torque row over the held-out recordings; an empty list without tolerances.

    Args:
        tolerances: tolerance of each joint, or one for all joints [N m or N]; zero: this joint is not tested.
        proofs: name of a held-out recording -> score of the model.
        rows: names of the torque rows; with torques of motors and sensors, those of all joints one after the other.
        joint_count: number of joints.

    Raises:
        UsageError: if the number of tolerances does not match the joints, or rows are not torques of joints.
    """
    if not tolerances or not proofs:
        return []
    check_tolerances(tolerances, joint_count)
    message = f"tolerance_torque: the {len(rows)} rows {', '.join(rows)} are not torques of {joint_count} joints"
    require(len(rows) % joint_count == 0, message, UsageError)
    of_joint = np.broadcast_to(np.asarray(tolerances, dtype=float), joint_count)
    of_row = np.tile(of_joint, len(rows) // joint_count)
    tests = []
    for number, (row, tolerance) in enumerate(zip(rows, of_row)):
        if not tolerance:
            continue
        errors = {}
        for recording, score in proofs.items():
            whole = score.filtered if score.floor_dominates else score.raw
            errors[recording] = float(whole.rms[number])
        worst = max(errors, key=lambda recording: np.nan_to_num(errors[recording], nan=-1.0))
        tests.append(TorqueTest(worst, row, errors[worst], float(tolerance)))
    return tests
