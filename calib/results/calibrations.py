"""Result folders that contain a calibrated robot: fits, identifications, their exports, and sessions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from calib.config_types import Plots
from calib.errors import RobotError, UsageError, command_line, refused_as, require
from calib.folders import COVARIANCE, SESSION
from calib.procedure.answers import CertificateSection
from calib.procedure.dynamic_stage.folder import IdentificationFolder
from calib.procedure.export import delivery, geometry
from calib.procedure.findings import NOT_JUDGED, Verdict, Verdicts
from calib.procedure.kinematic_stage.folder import FitFolder
from calib.procedure.report.certificate import results as certificates
from calib.procedure.robot_kinds import mechanism, stage_of
from calib.procedure.session.folder import Session, open_session
from calib.result_kinds import BY_NAME
from calib.results.result import Exported, ExportSettings, StoredResult, Viewed
from calib.robot.library import resolve

if TYPE_CHECKING:
    from calib.data.csv_table import Table
    from calib.procedure.report.certificate.record import Certificate, Page
    from calib.procedure.report.page import ChartPicture


class CalibratedRobot(Viewed):
    """A folder that contains a robot calibrated from a nominal one (nominal and calibrated robot: ``robot.toml``)."""

    def check_arm(self, verb: str) -> None:
        stage_of(self.path, verb)

    def export(self, into: Path, settings: ExportSettings) -> Exported:
        """Write the robot for other programs, in all file formats or as a ROS 2 package.

        Args:
            into: folder to write into, which is created if necessary.
            settings: URDF to change (or the fit's robot), and format of the export.

        Returns:
            Messages on verdicts and files.

        Raises:
            UsageError, RobotError: if the robot cannot be exported, or files would be overwritten.
        """
        stage = stage_of(self.path, "export")
        if stage is not None:
            message = f"ros2 {settings.ros2}: a package is written of serial arms only"
            require(not settings.ros2, message, UsageError)
            return Exported((), stage.run(self.path, into, urdf=settings.urdf, prior=settings.prior))
        sources = self._export_sources(settings)
        if settings.ros2:
            from calib.procedure.export.ros2_package import write_package

            remark = self.verdicts.of("urdf", dynamics=True).remark
            lines = write_package(
                replace(sources, remark=remark),
                settings.ros2,
                into,
                moveit=settings.moveit,
                control=settings.control,
                overwrite=settings.overwrite,
            )
            return Exported((), lines)
        delivery.check_into(sources, into, self.path)
        lines = delivery.deliver(sources, into)
        return Exported(delivery.mark(into, self.verdicts), lines)

    def _export_sources(self, settings: ExportSettings) -> delivery.Export:
        """Return the sources of an export: this folder, and the nominal robot's description.

        Args:
            settings: the user's settings; ``urdf`` is the nominal robot's URDF, None takes the description that the fit
                used.
        """
        if settings.urdf is not None:
            return delivery.Export(settings.urdf, self.path)
        source = geometry.read(self.path).source
        message = f"{self.path} was fitted from {source}, which is missing: give the robot's URDF (argument urdf)"
        with refused_as(UsageError, RobotError, message):
            return delivery.Export(resolve(source), self.path)

    def _refuse_in_session(self) -> None:
        """Raise a UsageError if the folder belongs to a session, since only the session has a certificate."""
        folder = self.path
        redo = command_line("redo", folder.parent, "certificate")
        words = f"{folder} belongs to a session, which has the certificate: {redo}"
        require(not (folder.absolute().parent / SESSION).exists(), words, UsageError)


class StoredFit(CalibratedRobot):
    """Folder of a fitted geometry, written by `calib fit`, `tool`, `base` or `hand-eye`."""

    @property
    def verdict(self) -> Verdict:
        """The fit's verdict; within a session, the verdict on the held-out poses."""
        return self.verdicts.stages.get("geometry", super().verdict)

    @property
    def verdicts(self) -> Verdicts:
        if mechanism(self.path) is not None:
            return Verdicts({"geometry": super().verdict})
        return delivery.fit_verdicts(self.path)

    @property
    def fit(self) -> FitFolder:
        return FitFolder(self.path)

    def pages(self, details: CertificateSection, plots: Plots = True) -> tuple[Certificate, Page]:
        """Return certificate and report of the fit.

        Args:
            details: certificate entries made by a person.
            plots: whether to include figures.

        Raises:
            UsageError: if the folder belongs to a session, or has no data of a report.
        """
        self._refuse_in_session()
        if not FitFolder(self.path).report.exists():
            self.refuse("certificate")
        return certificates.read_fit(self.path, plots, details)


class StoredIdentification(CalibratedRobot):
    """Folder of identified dynamics, with the geometry that the identification used."""

    @property
    def verdict(self) -> Verdict:
        """The identification's verdict; within a session, the verdict on the held-out motion."""
        return self.verdicts.stages.get("dynamics", super().verdict)

    @property
    def verdicts(self) -> Verdicts:
        return delivery.model_verdicts(self.path)

    @property
    def identification(self) -> IdentificationFolder:
        return IdentificationFolder(self.path)

    def _export_sources(self, settings: ExportSettings) -> delivery.Export:
        return delivery.Export(settings.urdf, identified=self.path, prior=settings.prior)

    def pages(self, details: CertificateSection, plots: Plots = True) -> tuple[Certificate, Page]:
        """Return certificate and report of the identification.

        Args:
            details: certificate entries made by a person.
            plots: whether to include figures.

        Raises:
            UsageError: if the folder belongs to a session.
        """
        self._refuse_in_session()
        return certificates.read_model(self.path, plots, details)


class StoredSession(Viewed):
    """Folder of a session, with the fit and the identification that its steps have completed."""

    @cached_property
    def _session(self) -> Session:
        return open_session(self.path)

    @property
    def session(self) -> Session:
        return self._session

    def require_session(self) -> Session:
        """Return the session; other kinds of results raise an error."""
        return self.session

    @property
    def finished(self) -> bool:
        """Whether the session has a verdict."""
        return self.session.concluded

    @property
    def verdict(self) -> Verdict:
        """The worst verdict among the stages of the session; not judged as long as the session is not finished."""
        verdicts = self.verdicts
        if not verdicts.level:
            return Verdict(NOT_JUDGED, f"no verdict yet: {command_line('next', self.path)}")
        worst = next(verdict for verdict in verdicts.stages.values() if verdict.level == verdicts.level)
        return Verdict(worst.level, str(verdicts))

    @property
    def verdicts(self) -> Verdicts:
        return self.session.verdicts() if self.finished else Verdicts()

    @property
    def fit(self) -> FitFolder | None:
        folder = self.session.fit
        complete = folder.numbers.exists() and (folder.path / COVARIANCE).exists()
        return folder if self.session.geometric and complete else None

    @property
    def identification(self) -> IdentificationFolder | None:
        folder = self.session.identification
        judged = folder.numbers.exists() and folder.unseen.report.exists()
        return folder if self.session.dynamic and judged else None

    def figures(self) -> dict[str, ChartPicture]:
        """Return the figures of fit and identification by name, such as ``4-fit/map``."""
        figures = {}
        for step in self._calibrations():
            for name, picture in step.figures().items():
                figures[f"{step.path.name}/{name}"] = picture
        return figures

    def tables(self) -> dict[str, Table]:
        """Return the tables of fit and identification by name, such as ``4-fit/estimate``."""
        tables = {}
        for step in self._calibrations():
            for name, table in step.tables().items():
                tables[f"{step.path.name}/{name}"] = table
        return tables

    def _calibrations(self) -> list[StoredResult]:
        """Return the fit and the identification, if the session has completed them."""
        results: list[StoredResult] = []
        if self.fit is not None:
            results.append(StoredFit(self.fit.path, BY_NAME["fit"]))
        if self.identification is not None:
            results.append(StoredIdentification(self.identification.path, BY_NAME["identification"]))
        return results

    def pages(self, details: CertificateSection, plots: Plots = True) -> tuple[Certificate, Page]:
        """Return certificate and report of a finished session.

        Args:
            details: ignored, since ``session.toml`` contains the details.
            plots: whether to include figures.
        """
        from calib.procedure.session import certificate

        return certificate.pages(replace(self.session, plots=plots))

    def certify(self, details: CertificateSection, plots: Plots, svg: Path | None) -> list[str]:
        """Write the report's figures as SVG; the certificate itself is written by the last step of the session.

        Args:
            details: must be empty, since ``session.toml`` contains the details.
            plots: ignored.
            svg: folder for the figures.

        Returns:
            Messages on the written files.

        Raises:
            UsageError: if details are stated, or no folder for figures.
        """
        from calib.procedure.report.certificate import rendering

        redo = command_line("redo", self.path, "certificate")
        words = f"{self.path / SESSION} has the details, under [certificate]; then: {redo}"
        require(details == CertificateSection() and svg is not None, words, UsageError)
        assert svg is not None
        report = self.pages(details)[1]
        return [f"{rendering.write_figures(svg, report)} figures written to {svg}"]

    def status(self) -> Iterator[object]:
        """Yield the status of each step, and the next task or command."""
        from calib.procedure.session import commands

        return commands.status_lines(self.path)
