"""Motions: excite, recall, plan."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.shared import Base, Robot, Seed, Tip, make_console, numbers, progress

app = typer.Typer()


@app.command()
def excite(
    robot: Robot,
    out: Annotated[Path, typer.Option(help="folder for the motion, its figures and metrics.json")],
    model: Annotated[Path | None, typer.Option(help="folder of an identification: predicts the torques")] = None,
    limits: Annotated[Path | None, typer.Option(help="TOML: speeds, torques, workspace, collision, friction")] = None,
    goal: Annotated[
        list[str] | None, typer.Option(help="raw=35, normalised=6, wrist=0.1, joint6=0.1, coverage=0.1; repeatable")
    ] = None,
    hard: Annotated[list[str] | None, typer.Option(help="a goal that must be met; repeatable")] = None,
    period: Annotated[float, typer.Option(help="of the motion [s]")] = 20.0,
    harmonics: Annotated[int, typer.Option(help="frequencies per joint; control points for splines")] = 5,
    family: Annotated[str, typer.Option(help="fourier or bspline")] = "fourier",
    drives: Annotated[str, typer.Option(help="terms of each drive to identify, without --model")] = "Fv Fc off",
    rate: Annotated[float, typer.Option(help="of the controller [Hz]")] = 1000.0,
    starts: Annotated[int, typer.Option(help="random starts of the search")] = 6,
    evaluations: Annotated[int, typer.Option(help="most evaluations per start")] = 600,
    front: Annotated[int, typer.Option(help="motions on the front of condition number and torque; 0 for none")] = 0,
    start: Annotated[str | None, typer.Option(help="joint values with commas: an approach from there")] = None,
    repeat: Annotated[int, typer.Option(help="periods to run one after the other")] = 1,
    slower: Annotated[float, typer.Option(help="factor of a slow rehearsal, written beside the motion")] = 1.0,
    existing: Annotated[
        list[str] | None, typer.Option(help="a recording, or an earlier --out, that counts already; repeatable")
    ] = None,
    lock: Annotated[
        list[str] | None, typer.Option(help="joints that stay: joint4,joint7, or joint4=0.5 [rad or m]; repeatable")
    ] = None,
    workers: Annotated[str, typer.Option(help="local processes, or the address of a Dask scheduler")] = "1",
    base: Base = None,
    tip: Tip = None,
    seed: Seed = 0,
) -> None:
    """Design a motion that excites the dynamics of ROBOT within its limits."""
    from calib import workers as work
    from calib.procedure.excitation import design, design_folder
    from calib.procedure.report import motion_figures

    design_folder.check_target(out)
    stands = None if start is None else numbers(start, start.count(",") + 1, "--start")
    lost = []
    with work.workers(workers) as crew, progress() as say:
        designed = design.excite(
            robot, model=model, limits=limits, goals=goal or [], hard=hard or [], period=period, harmonics=harmonics,
            family=family, drives_=drives, rate=rate, starts=starts, evaluations=evaluations, front=front, start=stands,
            repeat=repeat, slower=slower, existing=existing or [], lock=lock or [], base=base, tip=tip, seed=seed,
            map=crew.map_without(lost), progress=say,
        )  # fmt: skip
        say("writing")
        design_folder.write_folder(designed, out, motion_figures.write_design)
    console = make_console()
    for line in design_folder.lines(designed):
        console.print(line, soft_wrap=True, markup=False)
    for note in lost:
        console.print(f"note: {note}", soft_wrap=True, markup=False)
    console.print(f"written to {out}", soft_wrap=True, markup=False)


@app.command()
def recall(
    folder: Annotated[Path, typer.Argument(help="what calib excite wrote")],
    log: Annotated[str, typer.Argument(help="a recording of it; log.npz@0:90 cuts")],
    out: Annotated[Path, typer.Option(help="the averaged period: .npz with its variance, or .csv")],
    skip: Annotated[int, typer.Option(help="whole periods to leave out at the beginning")] = 0,
) -> None:
    """Find a designed motion in a log, and average its periods to a recording for calib identify."""
    from calib.procedure.excitation import recall as excitation_recall

    excitation_recall.check_target(out)
    found = excitation_recall.find(folder, log, skip)
    excitation_recall.write(found, out)
    console = make_console()
    for line in excitation_recall.lines(found):
        console.print(line, soft_wrap=True, markup=False)
    console.print(f"written to {out}", soft_wrap=True, markup=False)


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
    ] = False,
    rate: Annotated[float, typer.Option(help="of the controller [Hz]")] = 1000.0,
    shorten: Annotated[int, typer.Option(help="timings to spend on a faster shape between waypoints")] = 0,
    stray: Annotated[float, typer.Option(help="how far that may leave the spline, per joint [rad or m]")] = 0.0,
    start: Annotated[str | None, typer.Option(help="joint values with commas: an approach from there")] = None,
    slower: Annotated[float, typer.Option(help="factor of a slow rehearsal, written beside the motion")] = 1.0,
    base: Base = None,
    tip: Tip = None,
) -> None:
    """Plan the fastest motion of ROBOT through waypoints, within its speeds and torques."""
    from calib.procedure.excitation import plan_folder, planning
    from calib.procedure.report import motion_figures

    plan_folder.check_target(out)
    stands = None if start is None else numbers(start, start.count(",") + 1, "--start")
    with progress() as say:
        planned = planning.plan(
            robot, waypoints, model=model, payloads=payload or [], limits=limits, drives_file=drives, lines=line,
            rate=rate, evaluations=shorten, stray=stray, start=stands, slower=slower, base=base, tip=tip,
            progress=say,
        )  # fmt: skip
        say("writing")
        plan_folder.write_folder(planned, out, motion_figures.write_plan)
    console = make_console()
    for words in plan_folder.lines(planned):
        console.print(words, soft_wrap=True, markup=False)
    console.print(f"written to {out}", soft_wrap=True, markup=False)
