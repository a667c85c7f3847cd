"""Classes of stored results by kind, and `open_result`, which opens the result at a path."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from calib import files
from calib.config_types import Plots
from calib.data.csv_table import Table, read_table
from calib.errors import UsageError, require
from calib.folders import GRAVITY_SUMMARY
from calib.procedure.excitation.coefficients import PLANNED, RUN, SAMPLES
from calib.procedure.findings import Verdict
from calib.procedure.kinematic_stage.selection import FIGURES_PAGE
from calib.procedure.report.page import ChartPicture, chart_pictures
from calib.result_kinds import kind_of, refusal
from calib.results.calibrations import CalibratedRobot, StoredFit, StoredIdentification, StoredSession
from calib.results.result import StoredResult, Viewed

if TYPE_CHECKING:
    from calib.results.scene import Scene

FIGURE_SUFFIXES = (".html", ".png", ".svg")
# Beginning of the line with a verdict.
VERDICT = "verdict "


class StoredMotion(Viewed):
    """Folder of a designed or planned motion."""

    def motion(self) -> Path:
        """Return the path of the motion's file to play.

        It contains the whole run with the approach if the folder has such a file, otherwise only the motion.
        """
        for name in (RUN, PLANNED, SAMPLES):
            path = self.path / name
            if path.is_file():
                return path
        self.refuse("program")


class StoredFile(StoredResult):
    """A result that is a file, possibly with accompanying files in the same folder."""

    def beside(self) -> list[Path]:
        """Return the paths of the accompanying files."""
        return []

    def tables(self) -> dict[str, Table]:
        """Return the table in a CSV file, by the file's name; empty for other files."""
        return {self.path.stem: read_table(self.path)} if self.path.suffix == ".csv" else {}

    def save(self, out: str | Path, *, plots: Plots = True) -> Path:
        """Copy the file and the files that accompany it, and return the path of the copy.

        Accompanying files are renamed after the copy.

        Args:
            out: path of the copy.
            plots: whether figures are copied, too.

        Raises:
            UsageError: if a file with one of the names exists.
        """
        out = Path(out)
        copies = {self.path: out}
        for path in self.beside():
            if plots or path.suffix not in FIGURE_SUFFIXES:
                copies[path] = out.with_name(out.stem + path.name.removeprefix(self.path.stem))
        for copy in copies.values():
            require(not copy.exists(), f"{copy} is there already; give another name", UsageError)
        for path, copy in copies.items():
            files.write(copy, path.read_bytes())
        return out


class StoredSelection(StoredFile):
    """Poses selected by `calib select`: a CSV file, with prediction and figures next to it."""

    def beside(self) -> list[Path]:
        """Return the paths of prediction and figures, which are next to the CSV."""
        start = self.path.with_suffix("")
        paths = [Path(f"{start}{self.kind.companion}")]
        for suffix in FIGURE_SUFFIXES:
            paths += sorted(start.parent.glob(f"{start.name}_*{suffix}"))
        return paths

    def figures(self) -> dict[str, ChartPicture]:
        """Return the figures on the page next to the CSV, by name."""
        from calib.procedure.report.figures import figure_data

        return chart_pictures(figure_data.read(self.path.with_name(f"{self.path.stem}{FIGURES_PAGE}")))

    def scene(self, robot: str | None = None) -> Scene:
        """Return the scene with the selected poses for the viewer.

        Args:
            robot: name or file of the robot to draw; it is required, since the CSV does not contain it.

        Raises:
            UsageError: without a robot.
        """
        from calib.results import scene_files

        return scene_files.read(self.path, robot)


class StoredGravity(StoredResult):
    """Folder of the gravity that standing poses identify."""

    @property
    def verdict(self) -> Verdict:
        """The verdict in the summary."""
        for line in (self.path / GRAVITY_SUMMARY).read_text(encoding="utf-8").splitlines():
            if line.startswith(VERDICT):
                level, _, reason = line.removeprefix(VERDICT).partition(": ")
                return Verdict(level, reason)
        return super().verdict


# classes of the kinds that have functions of their own, by name; the others are plain `StoredResult`
CLASSES: dict[str, type[StoredResult]] = {
    "fit": StoredFit,
    "identification": StoredIdentification,
    "gravity": StoredGravity,
    "excitation": StoredMotion,
    "plan": StoredMotion,
    "selection": StoredSelection,
    "recall": StoredFile,
    "session": StoredSession,
    "robot": CalibratedRobot,
}


def open_result(path: str | Path, verb: str = "result") -> StoredResult:
    """Return the result in a folder or a file.

    Args:
        path: folder or file that a command wrote, or a session.
        verb: name of the command that opens the result (a key of `calib.result_kinds.TAKES`), for the error message.

    Raises:
        UsageError: if there is no result at this path.
    """
    path = Path(path)
    kind = kind_of(path)
    if kind is None:
        raise UsageError(refusal(path, verb))
    return CLASSES.get(kind.name, StoredResult)(path, kind)


def drawn(path: str | Path, robot: str | None = None) -> Scene:
    """Return the scene that the viewer draws for a result, any CSV of poses, or a folder with several results.

    Args:
        path: file or folder of the result.
        robot: name or file of the robot to draw; None: the result's robot.

    Raises:
        UsageError: if there is nothing to draw.
    """
    if kind_of(path) is not None:
        return open_result(path, "view").scene(robot)
    from calib.results import scene_files

    return scene_files.read(path, robot)
