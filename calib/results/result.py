"""One protocol of results: `Result`, which a result in memory keeps as one in a folder does.

Verbs that take a result open it (`calib.results.registry.open_result`) and ask it. `StoredResult` is what all kinds in
folders share; a kind has a class of its own where it can do more. What it cannot do it refuses, and says which folder
or command to use instead (`calib.result_kinds`).
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, NamedTuple, NoReturn, Protocol, runtime_checkable

from calib.config_types import ParsedTable
from calib.data.csv_table import Table, read_table
from calib.errors import CalibError, SessionError, UsageError
from calib.folders import METRICS, write_staged
from calib.procedure.answers import CertificateSection
from calib.procedure.findings import NOT_JUDGED, Verdict, Verdicts
from calib.procedure.report.page import Picture
from calib.records import read_json
from calib.result_kinds import ResultKind, refusal

if TYPE_CHECKING:
    from calib.procedure.dynamic_stage.folder import IdentificationFolder
    from calib.procedure.kinematic_stage.folder import FitFolder
    from calib.procedure.report.certificate.record import Certificate, Page
    from calib.procedure.session.folder import Session
    from calib.results.scene import Scene

PICTURES = "plot_*.png"


@runtime_checkable
class Result(Protocol):
    """A result, in memory or in its folder.

    Attributes:
        kind: one of `calib.result_kinds.KINDS`.
    """

    @property
    def kind(self) -> ResultKind: ...

    @property
    def verdict(self) -> Verdict:
        """The verdict; its level is `NOT_JUDGED` for what has none, as a motion."""
        ...

    def save(self, out: str | Path, /, *, plots: bool = True) -> Path:
        """Write the result's folder (of a list of poses its files), and return its path."""
        ...

    def figures(self) -> Mapping[str, Picture]:
        """Return the figures by name."""
        ...

    def tables(self) -> Mapping[str, Table]:
        """Return the tables by name, as the files that `save` writes hold them."""
        ...

    def scene(self, robot: str | None = None) -> Scene:
        """Return what the viewer draws: robot, poses, motions, torques.

        Args:
            robot: the robot to draw; None for the result's.
        """
        ...


class ExportSettings(NamedTuple):
    """What a calibrated robot is written from and as: the arguments of `calib.export`."""

    urdf: Path | None = None
    prior: str = "entropic"
    ros2: str = ""
    moveit: Sequence[Path] = ()
    control: bool = False
    overwrite: bool = False


class Exported(NamedTuple):
    """What an export has to say: verdicts other than pass, and remarks on the files."""

    verdicts: Sequence[str]
    remarks: Sequence[str]


def _has_rows(path: Path) -> bool:
    """Return whether a table that this toolkit wrote has a row below its header."""
    with path.open(encoding="utf-8", errors="replace") as file:
        lines = (line for line in file if not line.startswith("#"))
        return next(lines, None) is not None and next(lines, None) is not None


@dataclass(frozen=True)
class StoredResult:
    """A result in its folder, or in its file.

    Attributes:
        path: of the folder or file.
    """

    kind: ClassVar[ResultKind]

    path: Path

    @property
    def verdict(self) -> Verdict:
        """The verdict that ``metrics.json`` states."""
        metrics = self.to_dict()
        verdict = metrics.get("verdict")
        if isinstance(verdict, Mapping):
            return Verdict(str(verdict["level"]), str(verdict.get("reason", "")))
        if verdict:
            return Verdict(str(verdict), str(metrics.get("reason", "")))
        return Verdict(NOT_JUDGED, f"{self.kind.noun} has no verdict")

    @property
    def verdicts(self) -> Verdicts:
        """The verdicts of its stages and on its deliverables; empty where nothing was calibrated."""
        return Verdicts()

    @property
    def session(self) -> Session | None:
        """The session; None for other kinds."""
        return None

    @property
    def identification(self) -> IdentificationFolder | None:
        """Folder of the identified dynamics; None without."""
        return None

    @property
    def fit(self) -> FitFolder | None:
        """Folder of the fitted geometry; None without."""
        return None

    def check_arm(self, verb: str) -> None:
        """Refuse results of robots that are no serial arms; the base class accepts all."""

    def require_session(self) -> Session:
        """Refuse: this is no session."""
        self.refuse("session", SessionError)

    def motion(self) -> Path:
        """Refuse: there is no motion to play."""
        self.refuse("program")

    def to_dict(self) -> ParsedTable:
        """Return the content of ``metrics.json``; empty without."""
        metrics = self.path / METRICS
        if not metrics.is_file():
            return {}
        return read_json(metrics, "make it again")

    def figures(self) -> dict[str, Picture]:
        """Return the figures that were drawn when the result was written, by name."""
        start = PICTURES.partition("*")[0]
        paths = sorted(self.path.glob(PICTURES))
        return {path.stem.removeprefix(start): Picture(path.read_bytes(), "") for path in paths}

    def tables(self) -> dict[str, Table]:
        """Return the tables of the folder by name; those without rows are left out."""
        return {path.stem: read_table(path) for path in sorted(self.path.glob("*.csv")) if _has_rows(path)}

    def save(self, out: str | Path, *, plots: bool = True) -> Path:
        """Copy the folder as it is, without its figures where `plots` is False.

        Raises:
            UsageError: where something else is there.
        """
        out = Path(out)
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise UsageError(f"{out} is not empty; give a new folder")
        ignored = shutil.ignore_patterns(*(() if plots else (PICTURES,)))
        return write_staged(
            out, (), lambda staging: shutil.copytree(self.path, staging, ignore=ignored, dirs_exist_ok=True)
        )

    def scene(self, robot: str | None = None) -> Scene:
        """Refuse: there is nothing to draw."""
        self.refuse("view")

    def export(self, into: Path, settings: ExportSettings) -> Exported:
        """Refuse: there is no calibrated robot to write for other programs."""
        self.refuse("export")

    def pages(self, details: CertificateSection, plots: bool = True) -> tuple[Certificate, Page]:
        """Refuse: there is neither certificate nor report to write again."""
        self.refuse("certificate")

    def certify(self, details: CertificateSection, plots: bool, svg: Path | None) -> list[str]:
        """Write certificate and report again, and the report's figures as SVG into the folder `svg`.

        Returns:
            What was written, in words.
        """
        from calib.folders import PAGES
        from calib.procedure.report.certificate import rendering

        certificate, report = self.pages(details, plots)
        remarks = rendering.write(self.path, certificate, report)
        lines = [*remarks, f"written: {', '.join(str(self.path / name) for name in PAGES)}"]
        if svg is not None:
            lines.append(f"{rendering.write_figures(svg, report)} figures written to {svg}")
        return lines

    def status(self) -> Iterable[object]:
        """Refuse: only a session has steps."""
        self.refuse("session", SessionError)

    def refuse(self, verb: str, kind: type[CalibError] = UsageError) -> NoReturn:
        """Raise the error of a verb (`calib.result_kinds.TAKES`) that does not take this result."""
        raise kind(refusal(self.path, verb))


class Viewed(StoredResult):
    """A result that the viewer draws from its files."""

    def scene(self, robot: str | None = None) -> Scene:
        """Return what the viewer draws."""
        from calib.results import scene_files

        return scene_files.read(self.path, robot)
