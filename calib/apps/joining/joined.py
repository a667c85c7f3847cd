"""Table of joint values with measured points, and the column names by which files are joined."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib import files
from calib.toolkit.pose_data import Table

# in small letters, without punctuation; English, German, French, Italian, Spanish
NAMES = (
    *("name", "point", "pointname", "pointid", "pose", "poseid", "id", "label", "target", "number", "no", "nr"),
    *("punkt", "punktname", "punktnummer", "punktnr", "messpunkt", "ziel", "nummer"),
    *("nom", "numero", "nome", "punto", "nombre"),
)
CLOCKS = ("t", "time", "timestamp", "datetime", "zeit", "zeitstempel", "temps", "tempo", "tiempo")


def column_of(table: Table, names: Sequence[str]) -> str:
    """Return the name of the table's first column whose name is one of `names`; empty if there is none.

    Upper and lower case and punctuation are ignored.
    """
    # of two columns with the same plain name the first
    plain = dict[str, str]()
    for name in table.header:
        plain.setdefault(re.sub(r"[^a-z0-9]", "", name.lower()), name)
    for name in names:
        if name in plain:
            return plain[name]
    return ""


@dataclass(frozen=True, eq=False)
class Joined:
    """Joint values with measured points in one table.

    Attributes:
        table: one row per measured pose.
        poses: for each row, the index of its pose in the joints' file; if joined by motion, the index of its point in
            the points' file.
        notes: how the files were joined, and what is missing.
    """

    table: Table
    poses: np.ndarray
    notes: tuple[str, ...]

    @property
    def rows(self) -> str:
        """What the rows are, for messages."""
        return "measured poses"

    def write(self, path: Path) -> Path:
        """Write the table as CSV with the notes as comments above it, and return its path."""
        header = []
        for name, unit in zip(self.table.header, self.table.units):
            header.append(f"{name} [{unit}]" if unit else name)
        columns = [cells.tolist() for cells in self.table.cells]
        return files.write_table(path, header, zip(*columns), self.notes)
