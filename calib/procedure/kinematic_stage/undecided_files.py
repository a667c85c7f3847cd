"""Which of several readings of a file the nominal arm agrees with."""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from calib.data.csv_table import Table
from calib.data.poses.columns import Undecided
from calib.data.poses.fit_options import FileOptions
from calib.data.poses.measurements import PoseMeasurements
from calib.data.poses.pose_files import read_measurements
from calib.data.schema import Joints
from calib.errors import CalibError
from calib.geometry.checks.pose_direction import as_seen_by_instrument
from calib.geometry.first_guess import CHECKED_ROWS, contradiction
from calib.records import evenly
from calib.robot.chain import Chain

# smallest ratio of the contradictions of the next reading and of the best one at which the arm decides (our choice)
MIN_RATIO = 4.0


def decided(chain: Chain, undecided: Undecided, joints: Joints) -> list[PoseMeasurements]:
    """Return the measurements of a file in the only reading that the nominal arm does not contradict.

    Args:
        chain: the nominal arm.
        undecided: the file's table and the options of each reading.
        joints: the robot's joints.

    Raises:
        Undecided: no reading agrees with the arm, or several do.
    """
    table = undecided.table
    few = np.zeros(len(table), dtype=bool)
    few[evenly(len(table), CHECKED_ROWS)] = True
    scores = []
    readings = []
    faults: list[CalibError] = []
    for says, options, block in _readings(table.where(few), undecided.choices, joints, faults):
        # a camera on the arm measures the inverse
        scores.append(contradiction(chain, as_seen_by_instrument(chain, block)))
        readings.append((says, options))
    if not scores and faults:
        raise faults[0]
    if not scores or min(scores) > 1.0:
        raise undecided
    best, *rivals = np.argsort(scores, kind="stable").tolist()
    if rivals and scores[rivals[0]] < MIN_RATIO * scores[best]:
        raise undecided
    says, options = readings[best]
    note = f"read with {says}: the arm agrees with this reading and contradicts the {len(rivals)} others"
    blocks = read_measurements(table, joints, options)
    return [replace(block, notes=(note, *block.notes)) for block in blocks]


def _readings(
    table: Table, choices: Mapping[str, FileOptions], joints: Joints, faults: list[CalibError]
) -> Iterator[tuple[str, FileOptions, PoseMeasurements]]:
    """Yield what each possible reading assumes, its options, and its measurements.

    Args:
        table: rows of the file.
        choices: options by what they assume.
        joints: the robot's joints.
        faults: errors of the readings that are impossible; extended in place.
    """
    for says, options in choices.items():
        try:
            for block in read_measurements(table, joints, options):
                yield says, options, block
        except Undecided as further:
            assumptions = {f"{says}, {text}": choice for text, choice in further.choices.items()}
            yield from _readings(table, assumptions, joints, faults)
        except CalibError as fault:
            faults.append(fault)
