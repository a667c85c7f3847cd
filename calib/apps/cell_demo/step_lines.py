"""The demonstration's console output: one number per step, the progress, and the paths of up to five files.

Lines have at most 60 characters, all of which every terminal can show.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import nan
from shutil import get_terminal_size

from calib.apps.viewer import viewer
from calib.errors import command_line
from calib.folders import CERTIFICATE, PAGES, read_estimate
from calib.toolkit.pose_data import read_table
from calib.toolkit.result_folders import URDF, UnseenReport, ValidationMetrics, prediction
from calib.toolkit.sessions import SETTINGS, WAYS, Say, Session, chain_of, position_errors, steps_of, torque_error

PICTURE = "demo.png"
# processor time of each step, about, by which the share done is told [s]
SECONDS = {
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
    """Return a line of the summary.

    Args:
        name: name of the number.
        number: the number, which is printed with three significant digits.
        meaning: unit of the number and what it means.
    """
    return f"{name:<11} {number:>6.3g} {meaning}"


def _number(session: Session, step: str) -> tuple[float, str] | None:
    """Return a step's number and what it means, read from the session's folder; None for a step without a number."""
    settings = session.settings
    match step:
        case "describe":
            return chain_of(session).n, f"joints: {settings.name}, simulated, errors hidden"
        case "select":
            return settings.poses.fit, "poses chosen to measure"
        case "measure":
            # the run through the poses, the time to settle included
            seconds = read_table(session.path(f"2-poses/{WAYS}")).cells[0][-1]
            return seconds / 60.0, "min at the robot to measure them"
        case "fit":
            return len(read_estimate(session.fit.path)), "parameters of its geometry, with sigma"
        case "validate":
            errors = position_errors(session) or (nan, nan)
            return errors[1], f"mm error left on unseen poses: {session.validation.metrics().verdict}"
        case "excite":
            return settings.dynamics.period, "s of motion designed for its dynamics"
        case "record":
            return settings.dynamics.repeats, "periods of it logged, with torques"
        case "identify":
            return len(read_estimate(session.identification.path)), "parameters of its dynamics, with sigma"
        case "predict":
            verdict = session.identification.unseen.read().verdict
            return torque_error(session) or nan, f"% unexplained by identified model: {verdict}"
        case "export":
            folder = session.path(session.export)
            outcome = prediction(folder)
            if outcome is None:
                return len(list(folder.iterdir())), "files for other programs"
            return outcome.exported, "% unexplained by the exported robot"
    return None


@dataclass
class Telling:
    """Console output of a running session.

    Attributes:
        session: the session.
        say, show: functions that print a permanent line, and show a transient status.
        verbose: whether all messages of the session are printed too.
        began: time at which the session began [s], by `time.perf_counter`.
    """

    session: Session
    say: Say
    show: Say
    verbose: bool = False
    began: float = field(default_factory=time.perf_counter)
    _printed: set[str] = field(default_factory=set)
    _step: str = ""
    _entered: float = 0.0

    def said(self, *lines: str) -> None:
        """Print the summary line of each finished step, once; if verbose, also every message of the session."""
        for line in lines:
            step = line.partition(":")[0].rpartition(" ")[2]
            number = _number(self.session, step) if line[:1].isdigit() else None
            if number is not None:
                summary_line = row(step, *number)
                if summary_line not in self._printed:
                    self.say(summary_line)
                self._printed.add(summary_line)
            if self.verbose:
                self.say(f"    - {line.strip()}")

    def progress(self, text: str) -> None:
        """Show the current step, the share of the session that is done, and the remaining time.

        Args:
            text: the purpose of a step that begins now, or what the current step is doing.
        """
        moment = time.perf_counter()
        steps = steps_of(self.session)
        names = [step.name for step in steps]
        for step in steps:
            if step.purpose == text:
                self._step, self._entered = step.name, moment
        index = names.index(self._step)
        # processor time of the steps before, of all steps and of this one, and what has passed of it
        durations = [SECONDS.get(name, 0.0) for name in names]
        before, total = sum(durations[:index]), sum(durations)
        pace = (self._entered - self.began) / before if before else 1.0
        finished = before + min((moment - self._entered) / pace, 0.95 * durations[index])
        status = f"{finished / total:.0%} done, {(total - finished) * pace:.0f} s left: {steps[index].purpose}"
        # the spinner and the cursor need the rest
        self.show(status[: get_terminal_size().columns - 3])


def reasons(session: Session) -> Iterator[str]:
    """Yield a line for each verdict of a session other than pass.

    The line states what the verdict means, and the commands that explain its reasons.
    """
    reports: dict[str, ValidationMetrics | UnseenReport] = {"geometry": session.validation.metrics()}
    if session.dynamic:
        reports["dynamics"] = session.identification.unseen.read()
    for stage, report in reports.items():
        if report.verdict != "pass":
            yield f"{stage}: {report.verdict}; why: {command_line('explain', report.code)}"
    if any(report.verdict == "marginal" for report in reports.values()):
        yield "marginal: better than nominal, but a check has a doubt;"
        yield "read the reasons before you use it."


def paths(session: Session) -> list[str]:
    """Return lines with the paths of up to five existing result files of a session, most important first."""
    candidates = {
        "session": SETTINGS,
        "certificate": CERTIFICATE,
        "robot": f"{session.export}/{URDF}",
        "report": PAGES[-1],
        "replay": viewer.FILE,
        "truth": "truth.txt",
        "fit": "4-fit",
    }
    existing = []
    for name, file in candidates.items():
        path = session.path(file)
        if path.exists():
            existing.append(f"{name:<11} {path}")
    return [*existing[1:5], existing[0]]
