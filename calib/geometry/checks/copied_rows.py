"""Rows that stand twice in what was measured: copied, or a file given twice. They count twice, and prove nothing."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from scipy.spatial import KDTree

from calib.data.poses.measurements import PoseMeasurements
from calib.geometry.checks.repeatability import SAME
from calib.words import counted


class _Aside(Protocol):
    """Rows kept from the fit, `calib.procedure.kinematic_stage.inputs.Unseen`."""

    @property
    def block(self) -> PoseMeasurements: ...
    @property
    def held_out(self) -> bool: ...


def repeated(fit: Sequence[PoseMeasurements], unseen: Mapping[str, _Aside]) -> tuple[set[str], list[str]]:
    """Find rows with the joint values and the measured numbers of another, and unseen ones at joints of the fit.

    Args:
        fit: the fit's blocks.
        unseen: rows kept from it, by name.

    Returns:
        Names of those in `unseen` that mostly are rows of the fit; and notes for the user.
    """
    notes, proofless, known = [], set(), set[bytes]()
    for block in fit:
        marks = _marks(block)
        first = {mark: k for k, mark in reversed(list(enumerate(marks)))}
        within = _numbers(block, [first[mark] < k for k, mark in enumerate(marks)])
        before = _numbers(block, [mark in known for mark in marks])
        name = Path(block.file).name
        if within:
            notes.append(f"{name}: {_rows(within)} with the numbers of another row there: counted twice?")
        if before:
            notes.append(f"{name}: {_rows(before)} with the numbers of a row fitted already: is the file given twice?")
        known.update(marks)
    # of a validation file's rows that are the fit's: from there on it proves nothing (our choice)
    max_copied_share = 0.5
    for name, aside in unseen.items():
        copied = [mark in known for mark in _marks(aside.block)]
        again = _measured_again(fit, aside.block) & ~np.array(copied, dtype=bool)
        for chosen, words in ((copied, "with the numbers of a row of the fit"), (again, "at joints that were fitted")):
            if told := _numbers(aside.block, chosen):
                notes.append(f"{name}: {_rows(told)} {words}: not unseen")
        same = _numbers(aside.block, again | copied)
        if len(same) > max_copied_share * len(aside.block) and not aside.held_out:
            proofless.add(name)
    return proofless, notes


def _measured_again(fit: Sequence[PoseMeasurements], aside: PoseMeasurements) -> np.ndarray:
    """Say which rows (m,) were measured at joints at which rows of the fit were measured."""
    seen = [block.q for block in fit if type(block) is type(aside) and block.has_instrument]
    if not seen:
        return np.zeros(len(aside), dtype=bool)
    return KDTree(np.concatenate(seen)).query(aside.q, p=np.inf)[0] <= SAME


def _marks(block: PoseMeasurements) -> list[bytes]:
    """Return for each row what it says, joint values and measured numbers, to 12 digits."""
    table = np.column_stack([block.q, block.tool.astype(float), block.measured])
    return [row.tobytes() for row in np.round(table, 12) + 0.0]


def _numbers(block: PoseMeasurements, chosen: Sequence[bool] | np.ndarray) -> list[int]:
    return [int(row) for row in dict.fromkeys(block.rows[np.array(chosen, dtype=bool)])]


def _rows(numbers: Sequence[int]) -> str:
    shown = ", ".join(str(number) for number in numbers[:5]) + (", ..." if len(numbers) > 5 else "")
    return f"{counted(len(numbers), 'row')} ({shown})"
