"""Motions: excite, recall, plan."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.shared import Base, Overwrite, Plots, Robot, Seed, Tip, numbers, progress, say_written
from calib.procedure.excitation.settings import DEFAULT_DESIGN, DEFAULT_PLAN, ExcitationSettings, PlanSettings

app = typer.Typer()
DESIGN, PLAN = DEFAULT_DESIGN, DEFAULT_PLAN


@app.command()
def excite(
    robot: Robot,
    out: Annotated[Path, typer.Option(help="folder for the motion, its figures and metrics.json")],
    model: Annotated[Path | None, typer.Option(help="folder of an identification: predicts the torques")] = None,
    limits: Annotated[Path | None, typer.Option(help="TOML: speeds, torques, workspace, collision, friction")] = None,
    goal: Annotated[
        list[str] | None,
        typer.Option(help="raw=35, normalised=6, wrist=0.1, joint6=0.1, coverage=0.1, duration=12, logdet, smallest"),
    ] = None,
    hard: Annotated[list[str] | None, typer.Option(help="a goal that must be met; repeatable")] = None,
    period: Annotated[float, typer.Option(help="of the motion [s]")] = DESIGN.period,
    shortest: Annotated[float | None, typer.Option(help="that the search may shorten the period to [s]")] = None,
    harmonics: Annotated[
        int | None, typer.Option(help="frequencies per joint; control points for splines; default 12")
    ] = DESIGN.harmonics,
    family: Annotated[str, typer.Option(help="fourier or bspline")] = DESIGN.family,
    drives: Annotated[str, typer.Option(help="terms of each drive to identify, without --model")] = DESIGN.drives,
    rate: Annotated[float, typer.Option(help="of the controller [Hz]")] = DESIGN.rate,
    starts: Annotated[int, typer.Option(help="random starts of the search")] = DESIGN.starts,
    evaluations: Annotated[int, typer.Option(help="most evaluations per start")] = DESIGN.evaluations,
    front: Annotated[
        int, typer.Option(help="motions on the front of condition number and torque; 0 for none")
    ] = DESIGN.front,
    start: Annotated[str | None, typer.Option(help="joint values with commas: an approach from there")] = None,
    repeat: Annotated[int, typer.Option(help="periods to run one after the other")] = DESIGN.repeat,
    slower: Annotated[
        float, typer.Option(help="factor of a slow rehearsal, written beside the motion")
    ] = DESIGN.slower,
    existing: Annotated[
        list[str] | None, typer.Option(help="a recording, or an earlier --out, that counts already; repeatable")
    ] = None,
    lock: Annotated[
        list[str] | None, typer.Option(help="joints that stay: joint4,joint7, or joint4=0.5 [rad or m]; repeatable")
    ] = None,
    noise: Annotated[
        float | None, typer.Option(help="share of the torque limits that no parameter explains, to predict sigmas by")
    ] = DESIGN.noise,
    outlook: Annotated[
        bool, typer.Option("--outlook/--no-outlook", help="look at what other periods would tell")
    ] = DESIGN.outlook,
    workers: Annotated[str, typer.Option(help="local processes, or the address of a Dask scheduler")] = "1",
    base: Base = None,
    tip: Tip = None,
    seed: Seed = DESIGN.seed,
    plots: Plots = True,
) -> None:
    """Design a motion that excites ROBOT's dynamics, within limits."""
    from calib.api.motions import design_excitation
    from calib.procedure.parallel_stage.destination import check_destination
    from calib.workers.interrupts import finishing

    settings = ExcitationSettings(
        goals=tuple(goal or ()), hard=tuple(hard or ()), period=period, shortest=shortest,
        harmonics=harmonics, family=family,
        drives=drives, rate=rate, starts=starts, evaluations=evaluations, seed=seed, front=front,
        start=_stands(start), repeat=repeat, slower=slower, existing=tuple(existing or ()), lock=tuple(lock or ()),
        noise=noise, outlook=outlook,
    )  # fmt: skip
    check_destination("excite", robot, out, [robot, model, limits, *settings.existing])
    with progress() as say:
        designed = design_excitation(
            robot, settings, model=model, limits=limits, base=base, tip=tip, workers=workers, progress=say
        )
        say("writing")
        with finishing():
            designed.save(out, plots=plots)
    say_written(str(designed).splitlines(), out)


@app.command()
def recall(
    folder: Annotated[Path, typer.Argument(help="what calib excite wrote")],
    log: Annotated[str, typer.Argument(help="a recording of it; log.npz@0:90 cuts")],
    out: Annotated[Path, typer.Option(help="the averaged period: .npz with its variance, or .csv")],
    skip: Annotated[int, typer.Option(help="whole periods to leave out at the beginning")] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Find a designed motion in a log, and average its periods. What comes out is a recording for calib identify."""
    from calib.files import results
    from calib.procedure.excitation import recall as excitation_recall

    with results([(out, excitation_recall.SUFFIXES)], excitation_recall.inputs(folder, log), overwrite):
        found = excitation_recall.find(folder, log, skip)
        excitation_recall.write(found, out)
    say_written(excitation_recall.lines(found), out)


@app.command()
def plan(
    robot: Robot,
    waypoints: Annotated[Path, typer.Option(help="CSV of joint values, or x y z, qx qy qz qw of the tip")],
    out: Annotated[Path, typer.Option(help="folder for the motion, its figures and metrics.json")],
    model: Annotated[Path | None, typer.Option(help="folder of an identification: the dynamics to plan with")] = None,
    payload: Annotated[list[str] | None, typer.Option(help="an identified payload on board; may be repeated")] = None,
    limits: Annotated[Path | None, typer.Option(help="TOML: speeds, torques, workspace, collision, friction")] = None,
    drives: Annotated[Path | None, typer.Option(help="TOML: [drives] Ia, Fv, Fc, off, without --model")] = None,
    line: Annotated[
        bool, typer.Option("--line", help="the tool runs straight between waypoints, resting there")
    ] = PLAN.lines,
    rate: Annotated[float, typer.Option(help="of the controller [Hz]")] = PLAN.rate,
    shorten: Annotated[int, typer.Option(help="timings to spend on a faster shape between waypoints")] = PLAN.shorten,
    stray: Annotated[float, typer.Option(help="how far that may leave the spline, per joint [rad or m]")] = PLAN.stray,
    start: Annotated[str | None, typer.Option(help="joint values with commas: an approach from there")] = None,
    slower: Annotated[float, typer.Option(help="factor of a slow rehearsal, written beside the motion")] = PLAN.slower,
    base: Base = None,
    tip: Tip = None,
    plots: Plots = True,
) -> None:
    """Plan the fastest motion of ROBOT through waypoints. Speeds and torques stay within its limits."""
    from calib.api.motions import plan_motion
    from calib.procedure.parallel_stage.destination import check_destination

    settings = PlanSettings(
        payloads=tuple(payload or ()), lines=line, rate=rate, shorten=shorten, stray=stray, start=_stands(start),
        slower=slower,
    )  # fmt: skip
    check_destination("plan", robot, out, [robot, waypoints, model, limits, drives])
    with progress() as say:
        planned = plan_motion(
            robot, waypoints, settings, model=model, limits=limits, drives=drives, base=base, tip=tip, progress=say
        )
        say("writing")
        planned.save(out, plots=plots)
    say_written(str(planned).splitlines(), out)


def _stands(start: str | None) -> tuple[float, ...] | None:
    return None if start is None else tuple(numbers(start, start.count(",") + 1, "--start", finite=False))
