"""Motions of a front of trade-offs in the folder of a designed motion: ``front.csv``, ``front/3/trajectory.toml``.

``front.csv`` has one row per motion: its number, its condition number and torque slack, whether another motion is
better in both, and which motion was designed.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib import files
from calib.data.csv_table import read_table
from calib.errors import MeasurementError, UsageError, refused_as, require
from calib.procedure.excitation import coefficients
from calib.procedure.excitation.coefficients import Periodic
from calib.robot.tables import dumps
from calib.trajectories.basis import Family
from calib.trajectories.design.pareto import Front
from calib.trajectories.design.search import SearchResult
from calib.trajectories.errors import BadInput

TABLE, FOLDER = "front.csv", "front"
NUMBER, DOMINANCE, DESIGNED = "motion", "not dominated", "designed"


@dataclass(frozen=True, eq=False)
class StoredFront:
    """A front of trade-offs and its motions.

    Attributes:
        values: the front; its search results are not stored.
        motions: the front's motions, in the order of its rows.
    """

    values: Front
    motions: tuple[Periodic, ...]

    def with_designed(self, number: int) -> "StoredFront":
        """Return the front with motion `number`, counted from 1, as the designed one.

        Raises:
            UsageError: if there is no such motion.
        """
        count = len(self.motions)
        require(1 <= number <= count, f"--pick {number}: the front has the motions 1 to {count}", UsageError)
        return replace(self, values=replace(self.values, designed=number - 1))

    @property
    def designed(self) -> Periodic:
        """The designed motion."""
        return self.motions[self.values.designed]


def write(front: StoredFront, robot: str, limits: list[str], folder: Path) -> None:
    """Write the front's table and its motions into a folder.

    Args:
        front: the front with its motions.
        robot: name of the robot.
        limits: text lines on the motions' limits.
        folder: folder of the designed motion.
    """
    values = front.values
    rows = []
    for k, row in enumerate(values.values):
        rows.append([k + 1, *map(float, row), bool(values.best[k]), k == values.designed])
    files.write_table(folder / TABLE, [NUMBER, *values.names, DOMINANCE, DESIGNED], rows)
    for number, motion in enumerate(front.motions, 1):
        path = folder / FOLDER / str(number)
        path.mkdir(parents=True)
        files.write(path / coefficients.NAME, dumps(coefficients.table(motion, robot, limits)))


def read(folder: Path) -> StoredFront:
    """Return the front in the folder of a designed motion.

    Raises:
        UsageError: if it has none, or its files are damaged.
    """
    path = folder / TABLE
    require(path.is_file(), f"{folder} has no {TABLE}: design the motion with --front 5 first", UsageError)
    message = f"{folder}: its front was made by a version that kept no motions; design it again"
    require((folder / FOLDER).is_dir(), message, UsageError)
    damaged = f"{path} is damaged ({{}}); design the motion again"
    with refused_as(UsageError, (OSError, ValueError, MeasurementError), damaged):
        table = read_table(path)
        names = table.header[1:-2]
        values = np.column_stack([table.numbers(name) for name in names])
        best = np.array([text == str(True) for text in table.texts(DOMINANCE)])
        designed = table.texts(DESIGNED).index(str(True))
    motions = [coefficients.read(folder / FOLDER / str(number)) for number in range(1, len(values) + 1)]
    return StoredFront(Front(names, values, (), best, designed), tuple(motions))


def as_search_result(motion: Periodic, family: Family) -> SearchResult:
    """Return a stored motion as the result of a search, whose merit is not computed.

    Args:
        motion: the motion.
        family: family of motions of the search, to which the motion must belong.

    Raises:
        UsageError: if the motion is of another family.
    """
    message = "the front was designed with other harmonics or another start; give the same ones, or design it again"
    with refused_as(UsageError, (ValueError, IndexError, BadInput), message):
        variables = family.variables(motion.coefficients)
        for stored, nearest in zip(motion.coefficients, family.coefficients(variables), strict=True):
            require(np.allclose(stored, nearest, atol=1e-6), "", ValueError)
    factor = motion.period / family.period
    return SearchResult(variables, factor, np.nan, np.array([]), (), 0, 1.0, 0.0)
