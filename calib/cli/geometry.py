"""The geometry: fit, select, export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from calib.cli.shared import Base, Overwrite, Plots, Robot, Seed, Tip, exit_failed, numbers, progress, say, say_written

app = typer.Typer()


@app.command()
def fit(
    robot: Robot,
    measured: Annotated[
        list[Path],
        typer.Argument(
            help="CSV files of measured poses (calib formats measurements), or folders of images (calib formats images)"
        ),
    ],
    out: Annotated[Path, typer.Option(help="folder for the calibrated robot and its report")],
    validate: Annotated[list[Path] | None, typer.Option(help="CSV file of unseen poses; may be repeated")] = None,
    holdout: Annotated[float, typer.Option(help="share of each file's poses kept from the fit")] = 0.0,
    refit_frames: Annotated[bool, typer.Option(help="validation files: base and tool placement of their own")] = False,
    options: Annotated[Path | None, typer.Option(help="TOML, see calib formats options")] = None,
    model: Annotated[
        str | None,
        typer.Option(
            help="auto, frames, offsets, geometry, stiffness, bending, coupling, harmonics or wobble: that rung and "
            "all below it"
        ),
    ] = None,
    loss: Annotated[str | None, typer.Option(help="auto, none, huber or cauchy")] = None,
    selection: Annotated[
        Path | None,
        typer.Option(help="CSV of calib select, or its folder: what it predicted is held against what is found"),
    ] = None,
    folds: Annotated[
        str,
        typer.Option(help="rows the ladder sets aside: transfer (stations, files, regions), regions, random or poses"),
    ] = "transfer",
    stations: Annotated[str, typer.Option(help="base placement: each file its own, or one for all")] = "each",
    tools: Annotated[str, typer.Option(help="one tool for all files, or each its own")] = "one",
    tolerance: Annotated[
        float | None, typer.Option(metavar="MM", help="rms on unseen poses, in mm, above which the verdict is fail")
    ] = None,
    deliverable: Annotated[
        str, typer.Option(help="what the verdict is about: urdf (robot.urdf alone), or corrections (with them)")
    ] = "urdf",
    base: Base = None,
    tip: Tip = None,
    seed: Seed = 0,
    plots: Plots = True,
) -> None:
    """Fit the geometry of ROBOT to measured poses, and judge it.

    Exit codes: 0 the verdict is pass or marginal, 1 fail, 2 input or usage, 3 not identifiable or not converged, 4 an
    error that nobody foresaw.
    Pass means that on poses it has not seen the calibrated arm is better than the nominal one, or that there is nothing
    to gain; that it is good enough is said only with --tolerance.
    """
    from calib.api.kinematic import fit_geometry
    from calib.procedure.kinematic_stage.settings import FitSettings
    from calib.procedure.parallel_stage.destination import check_destination
    from calib.procedure.report import console as shown
    from calib.procedure.report import geometry_section

    settings = FitSettings(
        model, loss, folds, stations, tools, holdout, refit_frames,
        None if tolerance is None else 1e-3 * tolerance, deliverable, seed,
    )  # fmt: skip
    check_destination("fit", robot, out, [options, *measured, *(validate or [])])

    def read(given: Any) -> None:
        check_destination("fit", robot, out, [given.source])
        say(*shown.rendered(geometry_section.read_blocks(given)))

    with progress() as show:
        found = fit_geometry(
            robot, measured, settings, validate=validate or (), options=options, poses=selection, base=base, tip=tip,
            on_read=read, progress=show,
        )  # fmt: skip
        show("writing")
        found.save(out, plots=plots)
    say_written(found.renderables(), out, found.verdict.level)


@app.command()
def select(
    robot: Robot,
    out: Annotated[Path, typer.Option(help="CSV file of the chosen joint values, rad")],
    m: Annotated[int, typer.Option("-m", "--poses", help="how many poses")] = 30,
    kind: Annotated[str, typer.Option(help="what will be measured: pose or position")] = "pose",
    tool: Annotated[
        list[str] | None, typer.Option(help="x,y,z of a target in the tip's frame [m]; may be repeated")
    ] = None,
    index: Annotated[str, typer.Option(help="O1 to O5, or cond")] = "O1",
    method: Annotated[str | None, typer.Option(help="detmax (default), polish, local, multistart or tabu")] = None,
    starts: Annotated[int, typer.Option(help="random sets that multistart begins at")] = 8,
    evaluations: Annotated[int, typer.Option(help="most evaluations of the index in one local search")] = 5000,
    seconds: Annotated[float | None, typer.Option(help="processor time for the search; without: to its end")] = None,
    climbs: Annotated[
        int, typer.Option(help="searches for feasible poses beyond the bound; 0: it covers the candidates only")
    ] = 0,
    constraints: Annotated[Path | None, typer.Option(help="TOML, see calib formats constraints")] = None,
    without: Annotated[
        list[str] | None,
        typer.Option(
            help="self-collision, floor, joint-margin, view: not kept; instrument, box, obstacles: not there; may be "
            "repeated"
        ),
    ] = None,
    run: Annotated[
        Path | None, typer.Option(help="CSV of the run: t, pose (0: via-point), joints; calib view rehearses it")
    ] = None,
    speed: Annotated[float, typer.Option(help="share of the joints' speeds that the run is driven at")] = 0.3,
    dwell: Annotated[float, typer.Option(help="seconds that each pose takes to settle and be measured")] = 6.0,
    candidates: Annotated[int, typer.Option(help="poses to choose from")] = 2000,
    existing: Annotated[Path | None, typer.Option(help="CSV of poses measured before, which count")] = None,
    sigma: Annotated[
        str | None, typer.Option(help="of a position [m] and an orientation [rad], e.g. 1e-4,1e-4")
    ] = None,
    workers: Annotated[str, typer.Option(help="local processes, or the address of a Dask scheduler")] = "1",
    base: Base = None,
    tip: Tip = None,
    seed: Seed = 0,
    plots: Plots = True,
    overwrite: Overwrite = False,
) -> None:
    """Choose the poses at which the geometry of ROBOT shows best.

    Beside OUT.csv, OUT_prediction.json holds what the poses will tell (calib fit --selection), OUT_predicted.png shows
    how well the tool will be known over the workspace, and OUT_outlook.png what fewer and more poses would tell.
    """
    from calib.api.kinematic import select_poses
    from calib.data.poses.fit_options import FitOptions
    from calib.files import check_results, together
    from calib.procedure.kinematic_stage import selection
    from calib.procedure.kinematic_stage.inputs import load_robot
    from calib.procedure.kinematic_stage.settings import DEFAULT_SELECTION, SelectionSettings
    from calib.procedure.measuring.constraints_file import beside
    from calib.procedure.measuring.run import RunSettings
    from calib.procedure.parallel_stage.robots import refuse_parallel

    named = beside(constraints).values() if constraints else ()
    refuse_parallel(robot, "choosing poses", "spread them over its workspace by hand")
    load_robot(robot, existing, FitOptions(), base, tip)
    written = [*selection.targets(out, plots), *([(run, (".csv",))] if run else [])]
    check_results(written, [robot, existing, constraints, *named], overwrite)
    targets = tuple(tuple(numbers(text, 3, "--tool")) for text in tool or [])
    sigmas = None if sigma is None else numbers(sigma, 2, "--sigma")
    stated = None if sigmas is None else (sigmas[0], sigmas[1])
    settings = SelectionSettings(
        kind, targets, index, method or DEFAULT_SELECTION.method, candidates, stated, seed, starts, evaluations,
        seconds, climbs, tuple(without or ()), RunSettings(speed, dwell),
    )  # fmt: skip
    with progress() as show:
        chosen = select_poses(
            robot, m, settings, constraints=constraints, existing=existing, base=base, tip=tip, workers=workers,
            progress=show,
        )  # fmt: skip
        show("writing")
        with together():
            chosen.save(out, plots=plots, overwrite=overwrite)
            if run:
                chosen.save_run(run, overwrite=overwrite)
    if run:
        say(f"the run: {run}; calib view {run} --robot {robot}")
    say(str(chosen))
    if told := selection.beside_poses(out, plots, chosen.chosen):
        say(f"what they will tell: {', '.join(str(path) for path in told.values())}")
    say(f"{m} poses written to {out}")


@app.command()
def export(
    folder: Annotated[Path, typer.Argument(help="the folder of a fit, or of an identification")],
    urdf: Annotated[
        Path | None, typer.Option(help="the URDF to put the calibrated geometry into (it stays as it is)")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="the URDF to write")] = None,
    ur_kinematics: Annotated[Path | None, typer.Option(help="write ur_description's kinematics YAML")] = None,
    offsets: Annotated[Path | None, typer.Option(help="write a CSV of joint offsets")] = None,
    into: Annotated[
        Path | None, typer.Option(help="folder for all forms, with identified dynamics: calib formats exports")
    ] = None,
    for_corrections: Annotated[
        bool, typer.Option("--for-corrections", help="the URDF that joint_corrections.csv belongs to, worse without it")
    ] = False,
    overwrite: Overwrite = False,
    prior: Annotated[
        str, typer.Option(help="with --into: what draws masses that the torques do not tell, entropic or euclidean")
    ] = "entropic",
) -> None:
    """Write the calibrated robot for other programs. With --into: in all forms, identified dynamics included.

    A result whose verdict is no pass is marked so, with the reason; with fail, for inspection only, the exit code is 1.
    """
    from calib.errors import UsageError
    from calib.files import results
    from calib.procedure.export import delivery, geometry
    from calib.procedure.parallel_stage.robots import refuse_parallel

    refuse_parallel(folder, "export", "a URDF holds no closed loops: take its robot.toml and dynamics.json")
    if into:
        from calib.api.exporting import export as export_all

        if out or ur_kinematics or offsets:
            raise UsageError("--into writes all files into one folder; leave --out, --ur-kinematics and --offsets out")
        with progress() as show:
            show("all forms, and each file read back")
            lines = export_all(folder, into, urdf=urdf, prior=prior)
        say_written(lines, into, delivery.verdicts(folder).level)
        return
    if (urdf is None) != (out is None) or not (urdf or ur_kinematics or offsets):
        raise UsageError(
            "nothing to write: give --urdf SOURCE.urdf --out FILE.urdf, --ur-kinematics, --offsets or --into"
        )
    found = geometry.read(folder)
    targets = geometry.targets(urdf, out, ur_kinematics, offsets)
    own = delivery.verdicts(folder).of("corrections" if for_corrections else "urdf", dynamics=True)
    with results(targets, [urdf, *geometry.results(folder)], overwrite):
        read = geometry.export_urdf(found, urdf, out, for_corrections, own.remark) if urdf and out else ""
        if ur_kinematics:
            geometry.export_ur_kinematics(found, ur_kinematics, own.remark)
        if offsets:
            geometry.export_offsets(found, offsets)
    if urdf and out:
        say(f"{out}: joint origins of {urdf} calibrated, all else kept; base link and flange stay where the source has "
            f"them; {read}")  # fmt: skip
    if ur_kinematics:
        say(f"{ur_kinematics}: for kinematics_params_file of ur_description")
        if note := geometry.flange_note(found):
            say(f"note: {note}")
    if offsets:
        say(f"{offsets}: offset of each joint, the rest of the geometry left out; --model offsets fits the best ones")
    if found.corrections is not None:
        say(f"note: the corrections in {folder}/joint_corrections.csv are in none of these files")
    if own.level:
        say(str(own))
    exit_failed(own.level)


@app.command()
def compensate(
    folder: Annotated[Path, typer.Argument(metavar="FIT", help="the folder of a fit, or of a session that has one")],
    targets: Annotated[Path, typer.Argument(help="CSV of nominal joints or tool poses: calib formats targets")],
    out: Annotated[Path, typer.Option(help="CSV file of joint commands")],
    frame: Annotated[
        str, typer.Option(help="what the targets are in: base (of the calibrated robot), nominal, or a station")
    ] = "base",
    tool: Annotated[
        str, typer.Option(help="what stands there: flange, a tool of the fit, or x,y,z[,roll,pitch,yaw] [m, rad]")
    ] = "flange",
    dof: Annotated[
        int | None, typer.Option(help="how much counts: 6; 5, free to turn about the tool's z; 3, position only")
    ] = None,
    start: Annotated[
        str | None, typer.Option(help="q1,...,qn [rad, m] near which targets without joints are sought")
    ] = None,
    tolerance: Annotated[
        str, typer.Option(metavar="MM,MRAD", help="what a command may leave by the calibrated model")
    ] = "0.001,0.01",
    partial: Annotated[
        bool, typer.Option("--partial", help="write what is reached, even where some targets are not")
    ] = False,
    overwrite: Overwrite = False,
    seed: Seed = 0,
) -> None:
    """Turn targets into joint commands that put the real tool there.

    Targets of a workpiece that the instrument has measured: --frame STATION (the file's name, see the fit's report).

    Targets taught with the robot, or commands that are to change least: --frame nominal.

    Targets of an offline model of the cell, which stand in the robot's base: --frame base.
    """
    from calib.api import kinematic
    from calib.files import check_results
    from calib.procedure.export.geometry import results

    may = numbers(tolerance, 2, "--tolerance")
    fitted = kinematic.read_fitted(folder)
    check_results([(out, (".csv",))], [targets, *results(fitted.folder)], overwrite)
    with progress() as show:
        found = kinematic.compensate(
            fitted, targets, frame=frame, tool=tool, dof=dof, tolerance=(1e-3 * may[0], 1e-3 * may[1]), seed=seed,
            start=numbers(start, fitted.nominal.chain.n, "--start") if start else None, progress=show,
        )  # fmt: skip
    found.save(out, partial=partial, overwrite=overwrite)
    say(str(found))
    say(f"{int(found.commands.reached.sum())} of {len(found.q)} commands written to {out}")
