"""Motions: excite, recall, plan."""

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.options import command
from calib.cli.shared import Out, progress, say_written
from calib.procedure.excitation.settings import ExcitationSettings, PlanSettings

app = typer.Typer()


@command(app)
def excite(
    robot: str,
    out: Out,
    settings: ExcitationSettings,
    model: Path | None = None,
    limits: Path | None = None,
    workers: str = "1",
    base: str | None = None,
    tip: str | None = None,
    plots: bool = True,
) -> None:
    """Design a motion that excites ROBOT's dynamics, within limits.

    Args:
        out: folder for the motion, its figures and metrics.json
        model: folder of an identification: predicts the torques
        limits: TOML: speeds, torques, workspace, collision, friction
    """
    from calib.api.motions import design_excitation
    from calib.cli.destination import check_destination
    from calib.workers import finishing

    check_destination("excite", robot, out, [robot, model, limits, *settings.existing])
    with progress() as say:
        designed = design_excitation(
            robot, settings, model=model, limits=limits, base=base, tip=tip, workers=workers, progress=say
        )
        say("writing")
        with finishing():
            designed.save(out, plots=plots)
    say_written(str(designed).splitlines(), out)


@command(app)
def recall(folder: Path, log: str, out: Out, skip: int = 0, overwrite: bool = False) -> None:
    """Find a designed motion in a log, and average its periods. What comes out is a recording for calib identify.

    Args:
        folder: what calib excite wrote
        log: a recording of it; log.npz@0:90 cuts
        out: the averaged period: .npz with its variance, or .csv
        skip: whole periods to leave out at the beginning
    """
    from calib.files import results
    from calib.procedure.excitation import recall as excitation_recall

    with results([(out, excitation_recall.SUFFIXES)], excitation_recall.inputs(folder, log), overwrite):
        found = excitation_recall.find(folder, log, skip)
        excitation_recall.write(found, out)
    say_written(excitation_recall.lines(found), out)


@command(app)
def plan(
    robot: str,
    waypoints: Annotated[Path, typer.Option()],
    out: Out,
    settings: PlanSettings,
    model: Path | None = None,
    limits: Path | None = None,
    drives: Path | None = None,
    base: str | None = None,
    tip: str | None = None,
    plots: bool = True,
) -> None:
    """Plan the fastest motion of ROBOT through waypoints. Speeds and torques stay within its limits.

    Args:
        waypoints: CSV of joint values, or x y z, qx qy qz qw of the tip
        out: folder for the motion, its figures and metrics.json
        model: folder of an identification: the dynamics to plan with
        limits: TOML: speeds, torques, workspace, collision, friction
        drives: TOML: [drives] Ia, Fv, Fc, off, without --model
    """
    from calib.api.motions import plan_motion
    from calib.cli.destination import check_destination

    check_destination("plan", robot, out, [robot, waypoints, model, limits, drives])
    with progress() as say:
        planned = plan_motion(
            robot, waypoints, settings, model=model, limits=limits, drives=drives, base=base, tip=tip, progress=say
        )
        say("writing")
        planned.save(out, plots=plots)
    say_written(str(planned).splitlines(), out)
