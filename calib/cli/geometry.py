"""Commands for geometry: select and fit; and export."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calib.cli.completion import Robot
from calib.cli.shared import Out, check_destination, command, exit_failed, progress, say, say_written
from calib.config_types import Plots
from calib.procedure.kinematic_stage.settings import FitSettings, SelectionSettings

if TYPE_CHECKING:
    from calib.procedure.kinematic_stage.inputs import Inputs

app = typer.Typer()


@command(app, "Geometry")
def select(
    robot: Robot,
    out: Out,
    settings: SelectionSettings,
    m: Annotated[int, typer.Option("-m", "--poses", help="how many poses")] = 30,
    constraints: Path | None = None,
    run: Path | None = None,
    existing: Path | None = None,
    workers: str = "1",
    base: str | None = None,
    tip: str | None = None,
    plots: Plots = True,
    overwrite: bool = False,
) -> None:
    """Choose the poses that determine the geometry of ROBOT best.

    Beside OUT.csv, OUT_prediction.json holds what the poses are predicted to identify (calib fit --selection),
    OUT_figures.html shows how well the tool will be known over the workspace, and what fewer and more poses would
    identify.

    Example: calib select robot.urdf -m 40 --out poses.csv

    Args:
        out: CSV file of the chosen joint values
        constraints: TOML, see calib formats constraints, or MoveIt's files: calib formats moveit
        run: CSV of the run: t, pose (0: via-point), joints; calib view rehearses it
        existing: CSV of poses measured before, included in the selection
    """
    from calib.api.kinematic import select_poses
    from calib.data.poses.fit_options import FitOptions
    from calib.files import check_results, together
    from calib.procedure.kinematic_stage import selection
    from calib.procedure.kinematic_stage.inputs import load_robot
    from calib.procedure.measuring.constraints_file import beside
    from calib.procedure.robot_kinds import stage_of

    sources: list[str | Path | None] = [robot, existing, constraints]
    if constraints and constraints.suffix == ".toml":
        sources += beside(constraints).values()
    stage_of(robot, "choosing poses")
    load_robot(robot, existing, FitOptions(), base, tip)
    targets = selection.targets(out, plots)
    if run:
        targets = [*targets, (run, (".csv",))]
    check_results(targets, sources, overwrite)
    with progress() as show:
        chosen = select_poses(
            robot,
            m,
            settings,
            constraints=constraints,
            existing=existing,
            base=base,
            tip=tip,
            workers=workers,
            progress=show,
        )
        show("writing")
        with together():
            chosen.save(out, plots=plots, overwrite=overwrite)
            if run:
                chosen.save_run(run, overwrite=overwrite)
    if run:
        say(f"the run: {run}; calib view {run} --robot {robot}")
    say(str(chosen))
    predictions = selection.beside_poses(out, plots, chosen)
    if predictions:
        say(f"predictions: {', '.join(str(path) for path in predictions.values())}")
    say(f"{m} poses, for an instrument that measures the {settings.kind} (--kind), written to {out}")


@command(app, "Geometry")
def fit(
    robot: Robot,
    measured: list[Path],
    out: Out,
    settings: FitSettings,
    validate: list[Path] | None = None,
    options: Path | None = None,
    selection: Path | None = None,
    base: str | None = None,
    tip: str | None = None,
    plots: Plots = True,
) -> None:
    """Fit the geometry of ROBOT to measured poses, and judge it.

    Exit codes: 0 the verdict is pass or marginal, 1 fail, 2 input or usage, 3 not identifiable or not converged, 4 an
    internal error.
    Pass means that on poses it has not seen the calibrated arm is better than the nominal one, or that there is nothing
    to gain; that it is good enough is said only with --tolerance.

    Example: calib fit robot.urdf measured.csv --out fit

    Args:
        measured: CSV files of measured poses (calib formats measurements), or folders of images (calib formats images)
        out: folder for the calibrated robot and its report
        validate: CSV file of unseen poses; may be repeated
        options: TOML, see calib formats options
        selection: CSV of calib select, or its folder: its prediction is compared with the result
    """
    from calib.api.kinematic import fit_geometry
    from calib.procedure.report.geometry_section import read_lines

    check_destination("fit", robot, out, [options, *measured, *(validate or [])])

    def read(inputs: "Inputs") -> None:
        check_destination("fit", robot, out, [inputs.source])
        say(*read_lines(inputs))

    with progress() as show:
        result = fit_geometry(
            robot,
            measured,
            settings,
            validate=validate or (),
            options=options,
            poses=selection,
            base=base,
            tip=tip,
            on_read=read,
            progress=show,
        )
        show("writing")
        result.save(out, plots=plots)
    say_written(result.renderables(), out, result.verdict.level)


@command(app, "Files and studies")
def export(
    folder: Path,
    urdf: Path | None = None,
    out: Path | None = None,
    ur_kinematics: Path | None = None,
    offsets: Path | None = None,
    into: Path | None = None,
    for_corrections: bool = False,
    overwrite: bool = False,
    prior: str = "entropic",
    ros2: str = "",
    moveit: list[Path] | None = None,
    ros2_control: bool = False,
) -> None:
    """Write the calibrated robot for other programs. With --into: in all forms, identified dynamics included.

    With --ros2 NAME --out FOLDER: as a ROS 2 package with launch file and meshes.

    A result whose verdict is no pass is marked so, with the reason; with fail, for inspection only, the exit code is 1.

    Example: calib export fit --into calibrated

    Args:
        folder: the folder of a fit, or of an identification
        urdf: the URDF to put the calibrated geometry into (the file is not changed)
        out: the URDF to write
        ur_kinematics: write ur_description's kinematics YAML
        offsets: write a CSV of joint offsets
        into: folder for all formats, with identified dynamics: calib formats exports
        for_corrections: the URDF to use only together with joint_corrections.csv
        prior: with --into: distance from the prior for unidentified masses, entropic or euclidean
        ros2: name of a ROS 2 package written into the folder --out: calib formats ros2
        moveit: with --ros2: SRDF, joint_limits.yaml, or a folder with both, to copy; may be repeated
        ros2_control: with --ros2: write a ros2_control (mock hardware) if the URDF has none
    """
    from calib.errors import UsageError, command_line, require
    from calib.files import results
    from calib.procedure.export import delivery, geometry
    from calib.procedure.robot_kinds import stage_of
    from calib.results.result_classes import open_result

    stage_of(folder, "export" if into else "export to single files")
    if into or ros2:
        from calib.api.exporting import export as export_all

        if ur_kinematics or offsets or (into and out):
            raise UsageError("--into writes all files into one folder; leave --out, --ur-kinematics and --offsets out")
        require(into or out, f"--ros2 {ros2}: give the folder for the package, --out", UsageError)
        target = into or out or Path()
        with progress() as show:
            show("writing all formats, and reading each file back")
            lines = export_all(
                folder,
                target,
                urdf=urdf,
                prior=prior,
                ros2=ros2,
                moveit=moveit or (),
                control=ros2_control,
                overwrite=overwrite,
            )
        say_written(lines, target / ros2, open_result(folder).verdicts.level)
        return
    message = "nothing to write: give --urdf SOURCE.urdf --out FILE.urdf, --ur-kinematics, --offsets, --ros2 or --into"
    require((urdf is None) == (out is None) and (urdf or ur_kinematics or offsets), message, UsageError)
    urdf_form = delivery.CORRECTED_URDF if for_corrections else delivery.URDF
    targets: list[tuple[Path, tuple[str, ...]]] = []
    paths: dict[str, Path] = {}
    for form, path, suffixes in (
        (urdf_form, out, (".urdf",)),
        (delivery.UR_KINEMATICS, ur_kinematics, (".yaml", ".yml")),
        (delivery.OFFSETS, offsets, (".csv",)),
    ):
        if path:
            targets.append((path, suffixes))
            paths[form] = path
    result = open_result(folder, "export")
    verdict = result.verdicts.of("corrections" if for_corrections else "urdf", dynamics=True)
    fitted_robot = geometry.read(folder)
    with results(targets, [urdf, *geometry.results(folder)], overwrite):
        lines = delivery.deliver_single(delivery.Export(urdf, folder, remark=verdict.remark), paths)
    say(*lines)
    if fitted_robot.corrections is not None:
        say(f"note: these files do not include the corrections (joint_corrections.csv in {folder})")
    if verdict.level:
        say(str(verdict))
    if urdf and result.identification is not None:
        full_export = command_line("export", folder, "--urdf", urdf, "--into", "FOLDER")
        masses = f"the calibrated geometry with the masses of {urdf}"
        say(f"note: {out} has {masses}; {full_export} writes the identified ones")
    exit_failed(verdict.level)
