"""A session: a folder with numbered, readable files; it may be moved and copied, and its files may be edited.

session.toml     what is to be calibrated, with what, how; written by `calib new`, edited by people
1-robot/         the robot's description, copied, so that the folder can move
2-poses/         poses.csv to measure and fit, in the order of least time, poses_run.csv the ways between them, and
                 validation_poses.csv to measure and never fit; poses_prediction.json and predicted.html what they are
                 predicted to identify
3-measured/      what people bring: measured.csv (any name), files whose name starts with validation, and drift.csv,
                 some of the poses measured once more at the end (never fitted); columns: `calib formats measurements`.
                 received/ holds what was uploaded to `calib serve` and is no measurement yet, or was joined to one
4-fit/  5-validation/
6-excitation/    training and validation: two motions for the robot to play, at the controller's rate; round2 …: further
                 ones, where tolerance_percent or sigma_percent asks for more than these brought
7-recorded/      what people bring: the logs of them, training_log.csv (any name; .npz or a ROS bag, too), and files
                 whose name starts with validation or round2 …; a file whose name holds a payload's label was recorded
                 with it on board: `calib formats recordings`
8-dynamics/      the identified model; unseen/ holds it against the validation motion
8-masses/        the identification whose masses the fit's gravity torques are made of, where it has compliance
9-export/        the calibrated robot in the forms other programs read; README.txt says which file is for whom
certificate.html, certificate.pdf, report.html
                 the certificate, at most four pages A4, and the report with all tables and figures
verdict.json     the verdict of the session, of each stage, and of each exported file
                 Without dynamics there are no 6 to 8, and the export is 6-export. Where nothing is measured there are
                 no 2 to 5: 1-robot/as_given holds the geometry that dynamics are identified on.
state.json       which step was made from which files (SHA-256), when, by which version; written whole or not at all
simulated.txt    there where a simulated cell brought files (calib demo); the certificate then says that it is simulated
session.lock     there while a command works on the session
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path

from calib import files
from calib.config import parse
from calib.config_types import Plots, Text
from calib.data.poses import CORNERS, is_image_folder
from calib.errors import Busy, SessionError, command_line, refused_as
from calib.folders import PARAMETERS, STATE, write_staged
from calib.folders import SESSION as SETTINGS
from calib.procedure.dynamic_stage.folder import IdentificationFolder
from calib.procedure.findings import Verdict, Verdicts
from calib.procedure.kinematic_stage.folder import IN_SESSION, URDF, VALIDATED, FitFolder, ValidationFolder
from calib.procedure.session.settings import NOTHING, SCHEMA, SessionSettings, check_schema, read_settings, written
from calib.records import FieldValues, plain
from calib.result_kinds import refusal
from calib.robot import tables
from calib.robot.calibrated import ROBOT
from calib.robot.formats.urdf_tree import converter, is_urdf, text

FOLDERS = ("1-robot", "2-poses", "3-measured", "4-fit", "5-validation")
DYNAMIC = ("6-excitation", "7-recorded", "8-dynamics")
# of the export: without, with dynamics
EXPORT = {False: "6-export", True: "9-export"}
# says that a simulated cell brought files
MARK = "simulated.txt"
# the identification whose masses the fit uses
MASSES = "8-masses"
# the robot as it is described, where its geometry is not fitted
AS_GIVEN = "1-robot/as_given"
CHECKED, VERDICT = "checked.txt", "verdict.json"
SUMMARY, SELECTION, CUTS = "1-robot/summary.txt", "2-poses/selection.json", "7-recorded/cuts.json"
# sigma of the tool over the workspace, and what the poses will tell: calib fit --selection
PREDICTED = "2-poses/predicted.html"
PREDICTION = "2-poses/poses_prediction.json"
# as planned, in 2-poses
POSES, UNSEEN, WAYS = "poses.csv", "validation_poses.csv", "poses_run.csv"
# name today -> in sessions of earlier versions
OLDER = {f"2-poses/{UNSEEN}": "2-poses/validation.csv"}
POSES_CHECKED, MOTION_CHECKED = f"3-measured/{CHECKED}", f"7-recorded/{CHECKED}"
# of further motions: round2, round3 …
ROUND = "round"
LOGS = (".csv", ".npz", ".mcap", ".bag", ".db3", ".parquet", ".xlsx")
# what people bring: where to, and how its name begins
BROUGHT = {
    "measured": ("3-measured", ""),
    "validation": ("3-measured", "validation"),
    "drift": ("3-measured", "drift"),
    "training": ("7-recorded", ""),
    "unseen": ("7-recorded", "validation"),
}

Say = Callable[[str], None]


@dataclass(frozen=True)
class StepRecord:
    """Record of a completed step in ``state.json``.

    Attributes:
        finished: date and time at which the step was completed, ISO 8601.
        inputs, outputs: name of a file or setting -> fingerprint: SHA-256 of the file, or value of the setting as JSON.
        seconds: duration of the step [s].
        command: command that ran the step.
        seed: seed of all random numbers.
        toolkit: versions of the toolkit and its libraries.
        notes: notes for the user.
    """

    finished: Text
    inputs: Mapping[str, Text]
    outputs: Mapping[str, Text]
    seconds: float = 0.0
    command: Text = ""
    seed: int = 0
    toolkit: Text = ""
    notes: tuple[Text, ...] = ()


@dataclass(frozen=True)
class StateFile:
    """The content of ``state.json``: the completed steps, and the name of the running step (empty: none)."""

    steps: Mapping[str, StepRecord] = field(default_factory=dict)
    running: Text = ""

    def without(self, *names: str) -> StateFile:
        """Return the state without the records of the named steps, and without a running step."""
        return StateFile({name: record for name, record in self.steps.items() if name not in names})

    def notes(self, step: str) -> tuple[str, ...]:
        """Return the notes of a completed step; empty if the step has not been completed."""
        return self.steps[step].notes if step in self.steps else ()


@dataclass(frozen=True)
class Session:
    """An open session: its folder, its settings, and which figures are written (`Plots`)."""

    folder: Path
    settings: SessionSettings
    plots: Plots = True

    def path(self, name: str) -> Path:
        """Return the path of a file by its name relative to the session's folder.

        Sessions of earlier versions have other names for some files (`OLDER`); an existing file with such a name is
        returned.
        """
        older = self.folder / OLDER.get(name, name)
        return older if older.exists() else self.folder / name

    def named(self, name: str) -> Path | None:
        """Return the path of a file that a key in ``session.toml`` names.

        Args:
            name: value of the key; empty: there is no file, and None is returned.
        """
        return self.path(name) if name else None

    @property
    def links(self) -> FieldValues:
        """Names of the arm's base and tip link, as in `calib new` or in the fit; None: chosen by default."""
        links: FieldValues = {"base": self.settings.robot.base or None, "tip": self.settings.robot.tip or None}
        fitted = self.fit.path / ROBOT
        if links["tip"] is None and is_urdf(self.robot_file) and fitted.is_file():
            links["tip"] = tables.load(fitted).get("tip")
        return links

    @property
    def robot_file(self) -> Path:
        """Path of the robot's description."""
        return self.path(self.settings.robot.file)

    def brought(self, *kinds: str) -> list[Path]:
        """Return the paths that the user provided, by kind: for each kind first files, then folders of images or bags.

        Args:
            kinds: keys of `BROUGHT`, such as ``measured``.
        """
        result = []
        for kind in kinds:
            folder, prefix = BROUGHT[kind]
            prefixes = {start for where, start in BROUGHT.values() if where == folder}
            other_prefixes = tuple(prefixes - {"", prefix})
            is_data = _is_log if folder == "7-recorded" else _is_measured
            paths = []
            for path in self.path(folder).glob("*"):
                name = path.name.lower()
                if is_data(path) and name.startswith(prefix) and not name.startswith(other_prefixes):
                    paths.append(path)
            result += sorted(paths, key=_files_before_folders)
        return result

    def files_brought(self, kind: str) -> list[Path]:
        """Return the files of one kind that the user provided, including files in folders.

        Files of detected corners, which this toolkit writes into image folders, are excluded.
        """
        files_of_kind = []
        for path in self.brought(kind):
            inside = sorted(file for file in path.rglob("*") if file.is_file())
            files_of_kind += inside or [path]
        return [file for file in files_of_kind if file.name != CORNERS]

    @property
    def dynamic(self) -> bool:
        """Whether the session identifies the dynamics."""
        return self.settings.dynamics.wanted

    @property
    def needs(self) -> bool:
        """Whether the settings request an accuracy of torques or parameters, so that motions may be added."""
        section = self.settings.dynamics
        return self.dynamic and section.plan and bool(section.tolerance_percent or section.sigma_percent)

    @property
    def geometric(self) -> bool:
        """Whether the session fits the geometry; otherwise the geometry of the robot's file is used."""
        return self.settings.instrument.measures != NOTHING

    @property
    def fit(self) -> FitFolder:
        """Folder of the fitted geometry; without a fit, folder of the nominal robot."""
        return FitFolder(self.folder / (IN_SESSION if self.geometric else AS_GIVEN))

    @property
    def validation(self) -> ValidationFolder:
        """Folder of the fit's validation on held-out poses."""
        return ValidationFolder(self.folder / VALIDATED)

    @property
    def identification(self) -> IdentificationFolder:
        """Folder with the results of the identification."""
        return IdentificationFolder(self.folder / "8-dynamics")

    @property
    def export(self) -> str:
        """Name of the folder of the export, relative to the session's folder."""
        return EXPORT[self.dynamic]

    @property
    def concluded(self) -> bool:
        """Whether the session has a verdict, because the step export has been completed."""
        return self.path(VERDICT).exists()

    def write_state(self, state: StateFile) -> None:
        """Write a state to ``state.json``; the file is written completely or not at all."""
        files.write_json(self.path(STATE), {"schema": SCHEMA, **plain(state)})

    def verdicts(self) -> Verdicts:
        """Return the verdicts on the stages and deliverables.

        If the dynamics could not be exported, their verdict is at best pass for prediction only.
        """
        stages = {}
        deliverables: Mapping[str, Verdict] = {}
        if self.geometric:
            geometry = self.validation.metrics()
            stages["geometry"] = Verdict(geometry.verdict, geometry.reason)
            deliverables = geometry.deliverables
        if self.dynamic:
            dynamics = self.identification.unseen.read()
            stages["dynamics"] = Verdict(dynamics.verdict, dynamics.reason)
            out = self.path(self.export)
            if (out / ROBOT).exists() and not any(out.rglob(PARAMETERS)):
                stages["dynamics"] = stages["dynamics"].for_prediction("the dynamics could not be exported")
        return Verdicts(stages, deliverables)


def _is_log(path: Path) -> bool:
    if path.name.startswith("."):
        return False
    if path.is_dir():
        return (path / "metadata.yaml").exists()
    return path.suffix.lower() in LOGS


def _is_measured(path: Path) -> bool:
    if path.is_file():
        return path.suffix == ".csv"
    return is_image_folder(path)


def _files_before_folders(path: Path) -> tuple[bool, Path]:
    return path.is_dir(), path


def create(folder: Path, robot_file: Path, settings: SessionSettings, copied: Mapping[str, Path | str]) -> None:
    """Create the folder of a session, completely or not at all.

    Args:
        folder: path of a new or empty folder.
        robot_file: the robot's description, copied into ``1-robot``; xacro and MJCF are converted to URDF.
        settings: content of ``session.toml``; the robot's file and the date are filled in by this function.
        copied: other contents: name in the folder -> path of a file to copy, or text to write.

    Raises:
        SessionError: if the folder is not empty, or cannot be written.
    """
    robot: Path | str = robot_file
    robot_name = f"1-robot/robot{robot_file.suffix}"
    if converter(robot_file):
        robot, _ = text(robot_file)
        robot_name = f"1-robot/{URDF}"
    created = datetime.now().astimezone().isoformat(timespec="seconds")
    settings = replace(settings, created=created, robot=replace(settings.robot, file=robot_name))

    folders = [FOLDERS[0]]
    if settings.instrument.measures != NOTHING:
        folders += FOLDERS[1:]
    if settings.dynamics.wanted:
        folders += DYNAMIC
    folders.append(EXPORT[settings.dynamics.wanted])
    contents = {**copied, robot_name: robot, SETTINGS: written(settings)}

    def fill(staging: Path) -> None:
        for name in folders:
            (staging / name).mkdir()
        for name, source in contents.items():
            files.write(staging / name, source.read_bytes() if isinstance(source, Path) else source)
        if folder.exists():
            folder.rmdir()

    with refused_as(SessionError, OSError, f"cannot make {folder}: {{}}; nothing was written"):
        if (folder / SETTINGS).exists():
            raise SessionError(f"{folder} is already a session; go on with: {command_line('next', folder)}")
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise SessionError(f"{folder} is not empty; give a new folder")
        write_staged(folder, (), fill)


def open_session(folder: Path, plots: Plots = True) -> Session:
    """Read the settings of the session in a folder.

    Args:
        folder: the folder.
        plots: which figures the session's steps write.

    Raises:
        SessionError: if the folder is not a session, was made by a newer version, or has a damaged ``session.toml``.
    """
    path = folder / SETTINGS
    if not path.exists():
        raise SessionError(refusal(folder, "session"))
    return Session(folder, read_settings(path), plots=plots)


def read_state(session: Session) -> StateFile:
    """Return the content of ``state.json``; an empty state if the file is missing.

    Raises:
        SessionError: for a file that is damaged or from a newer version; the message states what to do.
    """
    path = session.path(STATE)
    if not path.exists():
        return StateFile()
    damaged = f"{path} is damaged ({{}}); delete it, and `calib next` repeats the steps"
    with refused_as(SessionError, (OSError, ValueError, RecursionError), damaged):
        state = json.loads(path.read_text(encoding="utf-8"))
    check_schema(path, state.get("schema") if isinstance(state, dict) else None)
    with refused_as(SessionError, (SessionError,), damaged):
        return parse(StateFile, state, "what it records", SessionError)


@contextmanager
def locked(session: Session, say: Say = print) -> Iterator[None]:
    """Lock the session during one command; a lock left by a killed command is replaced.

    Raises:
        Busy: while another command uses the session.
    """
    busy = f"{session.folder} is busy: {{}} works on it; wait for it to end"
    with files.locked(session.path("session.lock"), busy, Busy) as holder:
        if holder:
            say(f"the last command ({holder}) was interrupted; continuing from there")
        yield
