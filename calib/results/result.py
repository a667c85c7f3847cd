"""The protocol of results: `Result`, which results in memory and stored results implement.

Commands that take a result open it (`calib.results.result_classes.open_result`) and call its methods.
`StoredResult` is the class of all kinds in folders; a kind with additional functions has a subclass. If a kind does not
support a method, the method raises an error with advice on the folder or command to use instead
(`calib.result_kinds`).
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, NoReturn, Protocol, runtime_checkable

from calib.config_types import ParsedTable, Plots
from calib.data.csv_table import Table, read_table
from calib.errors import CalibError, SessionError, UsageError
from calib.folders import METRICS, figure_files, write_staged
from calib.procedure.answers import CertificateSection
from calib.procedure.findings import NOT_JUDGED, Verdict, Verdicts
from calib.procedure.report.page import ChartPicture, chart_pictures
from calib.records import read_json
from calib.result_kinds import ResultKind, refusal

if TYPE_CHECKING:
    from calib.procedure.dynamic_stage.folder import IdentificationFolder
    from calib.procedure.kinematic_stage.folder import FitFolder
    from calib.procedure.report.certificate.record import Certificate, Page
    from calib.procedure.session.folder import Session
    from calib.results.scene import Scene

DRAWINGS = figure_files("*")


@runtime_checkable
class Result(Protocol):
    """A result, in memory or stored in its folder.

    Attributes:
        kind: one of `calib.result_kinds.KINDS`.
    """

    @property
    def kind(self) -> ResultKind: ...

    @property
    def verdict(self) -> Verdict:
        """The verdict; the level is `NOT_JUDGED` for results without a verdict, such as motions."""
        ...

    def save(self, out: str | Path, /, *, plots: Plots = True) -> Path:
        """Write the result into a folder (a list of poses: into files), and return the path.

        Args:
            out: the folder; for a list of poses, the CSV file.
            plots: whether figures are drawn and written, too.
        """
        ...

    def figures(self) -> Mapping[str, ChartPicture]:
        """Return the figures: name -> figure."""
        ...

    def tables(self) -> Mapping[str, Table]:
        """Return the tables, as in the files that `save` writes: name -> table."""
        ...

    def scene(self, robot: str | None = None) -> Scene:
        """Return the scene for the viewer: robot, poses, motions, torques.

        Args:
            robot: name or file of the robot to draw; None: the result's robot.
        """
        ...


class ExportSettings(NamedTuple):
    """Source and format of an exported robot.

    Attributes:
        urdf: URDF of the nominal robot, to be changed; None: the fit's robot is used.
        prior: prior for masses that the torques do not identify: ``entropic`` or ``euclidean``.
        ros2: name of a ROS 2 package to write; empty: all file formats are written instead.
        moveit: MoveIt files to copy into the package.
        control: whether the package's URDF gets a ``<ros2_control>`` for mock hardware if it has none.
        overwrite: whether existing files are replaced.
    """

    urdf: Path | None = None
    prior: str = "entropic"
    ros2: str = ""
    moveit: Sequence[Path] = ()
    control: bool = False
    overwrite: bool = False


class Exported(NamedTuple):
    """Messages of an export: verdicts that are not pass, and remarks on the files."""

    verdicts: Sequence[str]
    remarks: Sequence[str]


def _has_rows(path: Path) -> bool:
    """Return whether the CSV table at `path` has a row below its header; comments are ignored."""
    with path.open(encoding="utf-8", errors="replace") as file:
        lines = (line for line in file if not line.startswith("#"))
        return next(lines, None) is not None and next(lines, None) is not None


@dataclass(frozen=True)
class StoredResult:
    """A result stored in a folder or a file.

    Attributes:
        path: path of the folder or file.
        kind: kind of the result.
    """

    path: Path
    kind: ResultKind

    @property
    def verdict(self) -> Verdict:
        """The verdict in ``metrics.json``; the level is `NOT_JUDGED` if there is none."""
        metrics = self.to_dict()
        verdict = metrics.get("verdict")
        if isinstance(verdict, Mapping):
            return Verdict(str(verdict["level"]), str(verdict.get("reason", "")))
        if verdict:
            return Verdict(str(verdict), str(metrics.get("reason", "")))
        return Verdict(NOT_JUDGED, f"{self.kind.noun} has no verdict")

    @property
    def verdicts(self) -> Verdicts:
        """The verdicts on the result's stages and deliverables; empty if the result is not a calibration."""
        return Verdicts()

    @property
    def session(self) -> Session | None:
        """The session; None if the result is not a session."""
        return None

    @property
    def identification(self) -> IdentificationFolder | None:
        """Folder of the identified dynamics; None if the result has no dynamics."""
        return None

    @property
    def fit(self) -> FitFolder | None:
        """Folder of the fitted geometry; None if the result has no fit."""
        return None

    def check_arm(self, verb: str) -> None:
        """Raise an error if the command `verb` does not support this result's robot; the base class never does."""

    def require_session(self) -> Session:
        """Raise an error, since the result is not a session; the class of sessions returns the session instead."""
        self.refuse("session", SessionError)

    def motion(self) -> Path:
        """Raise an error, since there is no motion to play; the class of motions returns the path of a file instead."""
        self.refuse("program")

    def to_dict(self) -> ParsedTable:
        """Return the content of ``metrics.json``; empty if there is no such file."""
        metrics = self.path / METRICS
        if not metrics.is_file():
            return {}
        return read_json(metrics, "make it again")

    def figures(self) -> dict[str, ChartPicture]:
        """Return the figures that were written with the result: name -> figure."""
        from calib.procedure.report.figures import figure_data

        return chart_pictures(figure_data.of_folder(self.path))

    def tables(self) -> dict[str, Table]:
        """Return the tables in the folder by name; tables without rows are left out."""
        return {path.stem: read_table(path) for path in sorted(self.path.glob("*.csv")) if _has_rows(path)}

    def save(self, out: str | Path, *, plots: Plots = True) -> Path:
        """Copy the folder, and return the path of the copy.

        Args:
            out: path of the copy.
            plots: whether figures are copied, too.

        Raises:
            UsageError: if the target is not an empty folder.
        """
        out = Path(out)
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise UsageError(f"{out} is not empty; give a new folder")
        ignored = shutil.ignore_patterns(*(() if plots else DRAWINGS))
        return write_staged(
            out, (), lambda staging: shutil.copytree(self.path, staging, ignore=ignored, dirs_exist_ok=True)
        )

    def scene(self, robot: str | None = None) -> Scene:
        """Raise an error, since there is nothing to draw; subclasses return a scene.

        Args:
            robot: name or file of the robot to draw; None: the result's robot.
        """
        self.refuse("view")

    def export(self, into: Path, settings: ExportSettings) -> Exported:
        """Raise an error, since there is no calibrated robot to export; subclasses export it.

        Args:
            into: folder to write into.
            settings: source and format of the export.
        """
        self.refuse("export")

    def pages(self, details: CertificateSection, plots: Plots = True) -> tuple[Certificate, Page]:
        """Raise an error, since the result has neither certificate nor report; subclasses return both.

        Args:
            details: certificate entries made by a person.
            plots: whether to include figures.
        """
        self.refuse("certificate")

    def certify(self, details: CertificateSection, plots: Plots, svg: Path | None) -> list[str]:
        """Write certificate and report again, and the report's figures as SVG.

        Args:
            details: certificate entries made by a person.
            plots: whether to include figures; a format writes them as files into the result's folder, too.
            svg: folder for the SVG figures; None: no SVG figures.

        Returns:
            Messages on the written files.
        """
        from calib.folders import PAGES
        from calib.procedure.report.certificate import rendering
        from calib.procedure.report.figures import figure_data, figure_files

        certificate, report = self.pages(details, plots)
        remarks = rendering.write(self.path, certificate, report)
        figure_files.write(self.path, figure_data.of_folder(self.path), plots, paged=True)
        written = [str(self.path / name) for name in PAGES if (self.path / name).exists()]
        lines = [*remarks, f"written: {', '.join(written)}"]
        if svg is not None:
            lines.append(f"{rendering.write_figures(svg, report)} figures written to {svg}")
        return lines

    def status(self) -> Iterable[object]:
        """Raise an error, since the result has no steps; the class of sessions yields their status."""
        self.refuse("session", SessionError)

    def refuse(self, verb: str, kind: type[CalibError] = UsageError) -> NoReturn:
        """Raise the error that a command does not support this kind of result.

        Args:
            verb: name of the command, a key of `calib.result_kinds.TAKES`.
            kind: class of the error.
        """
        raise kind(refusal(self.path, verb))


class Viewed(StoredResult):
    """A stored result that the viewer can draw."""

    def scene(self, robot: str | None = None) -> Scene:
        """Return the scene for the viewer, read from the result's files.

        Args:
            robot: name or file of the robot to draw; None: the result's robot.
        """
        from calib.results import scene_files

        return scene_files.read(self.path, robot)
