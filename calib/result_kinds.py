"""Kinds of results on disk: how a folder is recognised, and the message of a command that does not accept it.

Every command that takes a result (`calib view`, `certificate`, `export`, `diff` …) refuses folders of other kinds with
the message of `refusal`. It states what the folder is, and which folder or command to use instead. The functions for
each kind of result are in `calib.results`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from zipfile import BadZipFile, ZipFile

from calib.folders import GRAVITY_SUMMARY, METRICS, OFFSETS, PARAMETERS, SESSION


@dataclass(frozen=True)
class ResultKind:
    """One kind of result.

    Attributes:
        name: identifier of the kind.
        noun: noun for a folder of this kind, with its article.
        marks: sets of file names; a folder with all files of one set is of this kind.
        advice: for each command that does not accept this kind, advice on what to do instead; a clause with
            ``{folder}``.
        companion: for a kind that is a file: end of the name of the file beside it, which follows the stem of its name.
        array: for a kind that is an archive of arrays: name of an array that only this kind contains.
    """

    name: str
    noun: str
    marks: tuple[tuple[str, ...], ...] = ()
    advice: Mapping[str, str] = field(default_factory=dict)
    companion: str = ""
    array: str = ""

    def holds(self, path: Path) -> bool:
        """Return whether a folder or a file is a result of this kind."""
        if path.is_dir():
            return any(all((path / name).exists() for name in marks) for marks in self.marks)
        if self.companion and path.is_file():
            return path.with_name(path.stem + self.companion).is_file()
        return bool(self.array) and path.suffix == ".npz" and f"{self.array}.npy" in _members(path)


def _members(archive: Path) -> list[str]:
    """Return the names of the files in an archive; empty if the file is not an archive."""
    try:
        with ZipFile(archive) as content:
            return content.namelist()
    except (OSError, BadZipFile):
        return []


_SHOWN = "calib view {folder} shows it, calib export {folder} --into DIR writes the robot for other programs"
_NOT_A_SESSION = {"session": "not a session; " + _SHOWN}

# In the order in which they are tested: a session also contains fits, an identification also a robot.
KINDS = (
    ResultKind(
        "session",
        "a session",
        ((SESSION,),),
        {
            "certificate": "its details are in {folder}/session.toml, under [certificate]; then: "
            "calib redo {folder} certificate",
            "robot": "give the robot it exported, {folder}/9-export/robot.urdf, or its fit, {folder}/4-fit",
            "export": "its last step exports the robot; for other files give {folder}/4-fit or {folder}/8-dynamics",
            "deliver": "give its fit, {folder}/4-fit",
            "compensate": "it has no fit yet: calib next {folder}",
            "recall": "give its motion, {folder}/6-excitation",
            "program": "give a list of poses or a motion in it, {folder}/2-poses/poses.csv or {folder}/6-excitation",
            "view": "it has nothing to show yet: calib next {folder}",
        },
    ),
    ResultKind(
        "export",
        "an exported robot",
        (("robot.toml", "README.txt"), (OFFSETS, "README.txt"), (PARAMETERS, "README.txt")),
    ),
    ResultKind("package", "a ROS 2 package", (("package.xml",),)),
    ResultKind(
        "identification",
        "the result of an identification",
        (("dynamics.json",),),
        _NOT_A_SESSION | {"compensate": "give the fit that it is based on"},
    ),
    ResultKind(
        "gravity",
        "the gravity of standing poses",
        ((GRAVITY_SUMMARY,),),
        {
            "certificate": "what it says is in {folder}/gravity_summary.txt; certificates are of fits and of "
            "identifications from motions",
            "compensate": "give the folder of a fit; gravity does not change where the robot goes",
            "deliver": "give the folder of a fit; the robot with this gravity is {folder}/robot.urdf",
            "diff": "give folders of fits, of identifications or of sessions; compare the files gravity.csv by hand",
            "export": "the robot with this gravity is {folder}/robot.urdf, unless the verdict left it out",
            "robot": "the robot with this gravity is {folder}/robot.urdf, unless the verdict left it out",
            "view": "its robot is {folder}/robot.urdf, and its errors are in {folder}/gravity_summary.txt",
        },
    ),
    ResultKind("excitation", "a motion of calib excite", (("trajectory.toml",),)),
    ResultKind("plan", "a motion of calib plan", (("motion.csv",),)),
    ResultKind("fit", "the result of a fit", (("robot.toml", METRICS),), _NOT_A_SESSION),
    ResultKind("comparison", "a comparison of calib diff", ((METRICS, "changes.csv"), (METRICS, "torque_changes.csv"))),
    ResultKind("drift", "a report of calib drift", (("trends.csv",),)),
    ResultKind("log", "a report of calib log", (("log.csv", METRICS),)),
    ResultKind("study", "a study of calib study", (("rows.sqlite",), ("rows.parquet",))),
    ResultKind("robot", "a robot", (("robot.toml",),)),
    # The second set of files: reports of versions that wrote no table of the arms.
    ResultKind("fleet", "a report of calib fleet", (("fleet.csv", METRICS), (METRICS, "report.html"))),
    ResultKind("selection", "a list of poses of calib select", companion="_prediction.json"),
    ResultKind("recall", "an averaged period of calib recall", array="periods"),
)
BY_NAME = {kind.name: kind for kind in KINDS}

# Description of what each command accepts. `robot` is the entry for every command that takes a robot.
TAKES = {
    "certificate": "the folder of a fit or of an identification",
    "compensate": "the folder of a fit, or of a session that has one",
    "deliver": "the folder of a fit",
    "diff": "folders of fits, of identifications or of sessions",
    "export": "the folder of a fit or of an identification",
    "fleet": "folders of fits or of sessions",
    "log": "folders of sessions",
    "program": "a list of poses, a program, or the folder of a motion",
    "recall": "the folder of calib excite",
    "result": "the folder that a command wrote with --out, or that of a session",
    "session": "the folder of a session; calib new makes one",
    "robot": "a URDF, xacro, MJCF or TOML file, the folder of a fit, or a robot of the library",
    "view": "a folder with measured poses, a motion or torques",
}


def kind_of(path: str | Path) -> ResultKind | None:
    """Return the kind of the result in a folder or a file; None if it is not a result."""
    path = Path(path)
    for kind in KINDS:
        if kind.holds(path):
            return kind
    return None


def refusal(path: str | Path, verb: str) -> str:
    """Return the message of a command that does not accept a path: what the path is, and what to give or do instead.

    Args:
        path: path given by the user.
        verb: the command, a key of `TAKES`.
    """
    kind = kind_of(path)
    if kind is None:
        what = (
            "contains no result" if Path(path).is_dir() else "is a file" if Path(path).is_file() else "does not exist"
        )
        return f"{path} {what}; give {TAKES[verb]}"
    advice = kind.advice.get(verb, f"give {TAKES[verb]}")
    return f"{path} is {kind.noun}; {advice.format(folder=path)}"
