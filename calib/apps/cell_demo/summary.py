"""What the demonstration tells of itself: a line with one number for each step, how far it is, and five files.

In letters that every terminal has, at most 60 of them a line.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from math import nan
from shutil import get_terminal_size

from calib.apps.viewer import viewer
from calib.data.csv_table import read_table
from calib.errors import command_line
from calib.folders import CERTIFICATE, read_estimate
from calib.procedure.dynamic_stage.metrics import UnseenReport
from calib.procedure.export.delivery import prediction
from calib.procedure.kinematic_stage.folder import URDF
from calib.procedure.kinematic_stage.metrics import ValidationMetrics
from calib.procedure.session.folder import SETTINGS, WAYS, Say, Session
from calib.procedure.session.geometry_steps import chain_of
from calib.procedure.session.results import position_errors, torque_error
from calib.procedure.session.steps import steps_of

PICTURE = "demo.png"
SECONDS = {  # of processor time, about, by which the share done is told
    "select": 1.0,
    "fit": 1.0,
    "validate": 0.1,
    "excite": 3.0,
    "record": 1.2,
    "identify": 3.0,
    "predict": 1.6,
    "export": 0.3,
    "certificate": 2.0,
}


def row(name: str, number: float, meaning: str) -> str:
    """Return a line of the summary: whose number, the number with three digits, what it is."""
    return f"{name:<11} {number:>6.3g} {meaning}"


def _exported(session: Session) -> tuple[float, str]:
    outcome, out = prediction(session.path(session.export)), session.path(session.export)
    if outcome is None:
        return len(list(out.iterdir())), "files for other programs"
    return outcome.exported, "% unexplained by the exported robot"


def _minutes(session: Session) -> float:
    """Return how long the run through the poses takes [min], the time to settle included."""
    return read_table(session.path(f"2-poses/{WAYS}")).cells[0][-1] / 60.0


NUMBERS: Mapping[str, Callable[[Session], tuple[float, str]]] = {
    "describe": lambda s: (chain_of(s).n, f"joints: {s.settings.name}, simulated, errors hidden"),
    "select": lambda s: (s.settings.poses.fit, "poses chosen to measure"),
    "measure": lambda s: (_minutes(s), "min at the robot to measure them"),
    "fit": lambda s: (len(read_estimate(s.fit.path)), "parameters of its geometry, with sigma"),
    "validate": lambda s: (
        (position_errors(s) or (nan, nan))[1],
        f"mm error left on unseen poses: {s.validation.metrics().verdict}",
    ),
    "excite": lambda s: (s.settings.dynamics.period, "s of motion designed for its dynamics"),
    "record": lambda s: (s.settings.dynamics.repeats, "periods of it logged, with torques"),
    "identify": lambda s: (len(read_estimate(s.identification.path)), "parameters of its dynamics, with sigma"),
    "predict": lambda s: (
        torque_error(s) or nan,
        f"% unexplained by identified model: {s.identification.unseen.read().verdict}",
    ),
    "export": _exported,
}
"""Number of each step and what it is, read from the session's folders."""


@dataclass
class Telling:
    """Tells of a session as it goes on.

    Attributes:
        say, show: lines that stay, and words that pass.
        verbose: whether all that the session says is told besides.
    """

    session: Session
    say: Say
    show: Say
    verbose: bool = False
    began: float = field(default_factory=time.perf_counter)
    _told: set[str] = field(default_factory=set)
    _step: str = ""
    _entered: float = 0.0

    def said(self, *lines: str) -> None:
        """Tell what the session says: of a step that is done its line, once, and if verbose all its words."""
        for line in lines:
            step = line.partition(":")[0].rpartition(" ")[2]
            if line[:1].isdigit() and step in NUMBERS:
                summary_line = row(step, *NUMBERS[step](self.session))
                self.say(*({summary_line} - self._told))
                self._told.add(summary_line)
            if self.verbose:
                self.say(f"    - {line.strip()}")

    def progress(self, text: str) -> None:
        """Show the stage, the share done and the time left; `words`: a stage's purpose, or what it does."""
        moment, steps = time.perf_counter(), steps_of(self.session)
        purposes = {step.purpose: step.name for step in steps}
        if text in purposes:
            self._step, self._entered = purposes[text], moment
        names = list(purposes.values())
        before = sum(SECONDS.get(name, 0.0) for name in names[: names.index(self._step)])
        pace = (self._entered - self.began) / before if before else 1.0
        total, step_seconds = sum(SECONDS.get(name, 0.0) for name in names), SECONDS.get(self._step, 0.0)
        finished = before + min((moment - self._entered) / pace, 0.95 * step_seconds)
        stage = steps[names.index(self._step)].purpose
        text = f"{finished / total:.0%} done, {(total - finished) * pace:.0f} s left: {stage}"
        self.show(text[: get_terminal_size().columns - 3])  # the spinner and the cursor need the rest


def reasons(session: Session) -> Iterator[str]:
    """Yield what a verdict other than pass means, and the commands that explain its reasons."""
    reports: list[ValidationMetrics | UnseenReport] = [session.validation.metrics()]
    reports += [session.identification.unseen.read()] if session.dynamic else []
    for stage, report in zip(("geometry", "dynamics"), reports):
        if report.verdict != "pass":
            yield f"{stage}: {report.verdict}; why: {command_line('explain', report.code)}"
    if "marginal" in (report.verdict for report in reports):
        yield "marginal: better than nominal, but a check has a doubt;"
        yield "read the reasons before you use it."


def paths(session: Session) -> list[str]:
    """Return the five files to look at."""
    candidates = {
        "session": SETTINGS,
        "certificate": CERTIFICATE,
        "robot": f"{session.export}/{URDF}",
        "picture": PICTURE,
        "replay": viewer.FILE,
        "truth": "truth.txt",
        "fit": "4-fit",
    }
    existing = [f"{name:<11} {path}" for name, file in candidates.items() if (path := session.path(file)).exists()]
    return [*existing[1:5], existing[0]]
