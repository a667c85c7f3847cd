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
        rms: rms error of the predicted torque, as `Score.judged` counts it [N m or N].
        tolerance: largest accepted rms error [N m or N].
    """

    recording: str
    row: str
    rms: float
    tolerance: float

    @property
    def passed(self) -> bool:
        """Whether the error is within the tolerance; a joint that never moves has no error and passes."""
        return not self.rms > self.tolerance


def torque_tests(tolerances: Sequence[float], proofs: Mapping[str, Score], rows: Sequence[str]) -> list[TorqueTest]:
    """Return the worst result of each torque row over the held-out recordings; an empty list without tolerances.

    Args:
        tolerances: tolerance of each joint, or one for all joints [N m or N]; zero: this joint is not tested.
        proofs: name of a held-out recording -> score of the model.
        rows: names of the torque rows; with torques of motors and sensors, those of all joints one after the other.

    Raises:
        UsageError: if the number of tolerances does not match the joints.
    """
    if not tolerances or not proofs:
        return []
    count = len(tolerances)
    message = f"tolerance_torque: {count} numbers for {len(rows)} torques ({', '.join(rows)}); give one for each joint"
    require(count == 1 or (len(rows) % count == 0 and len(rows) // count <= 2), message, UsageError)
    by_row = np.resize(np.asarray(tolerances, dtype=float), len(rows))
    tests = []
    for row, (name, tolerance) in enumerate(zip(rows, by_row)):
        if not tolerance:
            continue
        errors = {recording: float(np.nan_to_num(score.judged.rms[row])) for recording, score in proofs.items()}
        worst = max(errors, key=lambda recording: errors[recording])
        tests.append(TorqueTest(worst, name, errors[worst], float(tolerance)))
    return tests
