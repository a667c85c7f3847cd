"""Commands of the guided session: new, next, status, redo; and formats and explain."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from calib.cli.completion import codes, topics
from calib.cli.shared import Seed, command, exit_failed, reporting, say
from calib.config_types import Plots
from calib.errors import CalibError, UsageError, command_line, require
from calib.procedure.answers import Answers

app = typer.Typer()

Folder = Annotated[Path, typer.Argument(help="the session's folder")]


@command(app, "Start")
def new(
    folder: Folder,
    answers: Answers,
    dynamics_only: bool = False,
    poses: Annotated[int, typer.Option(min=1)] = 40,
    validation: Annotated[int, typer.Option(min=0)] = 20,
    plan: bool = True,
    holdout: float = 0.0,
    base: str | None = "",
    tip: str | None = "",
    seed: Seed = 0,
) -> None:
    """Create a session FOLDER: calibrate a robot step by step. The last step writes a certificate.

    What is to be measured goes into FOLDER/3-measured as CSV (calib formats measurements), what is to be recorded into
    FOLDER/7-recorded (calib formats recordings); how the session goes on is said in FOLDER/session.toml (calib formats
    session). Without --robot or --instrument, at a terminal, it asks; what is not known of the cell is not checked, and
    stands on the certificate.

    Example: calib new cell

    Args:
        dynamics_only: identify the dynamics only; the geometry is taken from the robot's file
        poses: poses to choose for the fit
        validation: poses to measure for validation only, not fitted; 0 for none
        plan: choose poses and design motions; --no-plan: what is measured and recorded is already there, or is free
        holdout: share (0 to 0.99) of the poses and of each recording, held out where no file of validation comes
    """
    from calib.procedure.session.commands import new_session
    from calib.procedure.session.questions import checked

    if dynamics_only:
        message = (
            f"--dynamics-only needs no instrument, but --instrument is {answers.instrument}: leave one of them out"
        )
        require(answers.instrument in (None, "none"), message, UsageError)
        answers = replace(answers, instrument="none")
    if answers.robot is None or answers.instrument is None:
        answers = _completed(answers)
    session_folder = new_session(
        folder,
        poses=poses,
        validation=validation,
        plan=plan,
        holdout=holdout,
        base=base or "",
        tip=tip or "",
        seed=seed,
        **checked(answers),
    )
    say(f"made {session_folder}; next: {command_line('next', session_folder)}")


def _completed(answers: Answers) -> Answers:
    """Return the answers completed by questions at a terminal.

    Raises:
        UsageError: if answers are missing and there is no terminal.
    """
    import sys

    from calib.procedure.session.questions import QUESTIONS, with_answer

    if not sys.stdin.isatty():
        missing = "--robot" if answers.robot is None else "--instrument"
        raise UsageError(f"{missing} is missing: give it, or run `calib new` at a terminal, which asks for it")
    for question in QUESTIONS:
        while question.open(answers):
            answer = typer.prompt(question.words, default=question.default, show_default=bool(question.default))
            try:
                answers = with_answer(answers, question, answer.strip())
                break
            except CalibError as error:
                typer.echo(f"  {error}")
    return answers


@command(app, "Files and studies", listing=True)
def formats(topic: Annotated[str | None, typer.Argument(autocompletion=topics)] = None, schema: bool = False) -> None:
    """Print the content of file formats: columns, keys, units.

    Example: calib formats measurements

    Args:
        topic: measurements, instruments, robodk, join, images, descriptions, moveit, ros2, targets, programs, frames,
            logs, identify-options, options, identified, exports, constraints, mdh, parallel, robot, session, limits,
            waypoints, excitation, study, pairs or recordings
        schema: the JSON schema of a TOML file, for editors that complete its keys
    """
    from calib.procedure import formats as documents

    if schema:
        print(documents.json_schema(topic or ""), end="")
    elif topic:
        print(documents.describe(topic))
    else:
        print("\n".join(documents.overview()))


@command(app, "Files and studies", listing=True)
def explain(code: Annotated[str | None, typer.Argument(autocompletion=codes)] = None) -> None:
    """Print what a finding or a term means, and what to do.

    Example: calib explain sigma-ratio

    Args:
        code: a finding's code in metrics.json, or a term such as 'held out'; default: list all
    """
    from calib.procedure import findings

    if code:
        print(findings.explain(code))
    else:
        print("\n".join([*findings.catalogue(), *findings.glossary()]))


@command(app, "Start", "next")
def next_step(folder: Folder, pick: Annotated[int | None, typer.Option(min=1)] = None, plots: Plots = True) -> None:
    """Continue a session, then print what to do at the robot.

    Example: calib next cell

    Args:
        pick: number of a motion in 6-excitation/training/front.csv, which becomes the training motion
    """
    _go_on(folder, "next", plots=plots, pick=pick or 0)


@command(app, "Start")
def redo(folder: Folder, step: str, plots: Plots = True) -> None:
    """Repeat a step of a session and all steps that depend on it.

    Example: calib redo cell fit

    Args:
        step: a step's name or number, see calib status
    """
    _go_on(folder, "redo", step, plots)


@command(app, "Start")
def status(folder: Folder) -> None:
    """Show the progress of a session, and which steps are stale. With -v, the notes of its steps.

    Example: calib status cell
    """
    from calib.procedure.session import commands
    from calib.results.result_classes import open_result

    say(*open_result(folder, "session").status(), result=True)
    say(*commands.noted(folder))


def _go_on(folder: Path, command: str, step: str = "", plots: Plots = True, pick: int = 0) -> None:
    from calib.procedure.session import commands

    arguments: list[object] = [command, folder]
    if step:
        arguments.append(step)
    if pick:
        arguments += ["--pick", pick]
    with reporting() as (say, progress):
        stop = commands.go_on(folder, say, progress, command_line(*arguments), step, plots, pick)
    say(*stop.lines)
    exit_failed(stop.verdict)
