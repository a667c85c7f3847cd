"""Commands for dynamics: excite, recall and identify; and plan, for motions."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calib.cli.completion import Robot
from calib.cli.shared import Out, Seed, check_destination, command, progress, say, say_written
from calib.config_types import Plots
from calib.procedure.excitation.settings import ExcitationSettings, PlanSettings

if TYPE_CHECKING:
    from calib.procedure.dynamic_stage.inputs import IdentificationInputs

app = typer.Typer()


@command(app, "Dynamics")
def excite(
    robot: Robot,
    out: Out,
    settings: ExcitationSettings,
    model: Path | None = None,
    limits: Path | None = None,
    options: Path | None = None,
    after: Path | None = None,
    pick: Annotated[int | None, typer.Option(min=1)] = None,
    workers: str = "1",
    base: str | None = None,
    tip: str | None = None,
    plots: Plots = True,
) -> None:
    """Design a motion that excites ROBOT's dynamics, within limits.

    Example: calib excite fit --period 10 --out motion

    Args:
        out: folder for the motion, its figures and metrics.json
        model: folder of an identification: predicts the torques
        limits: TOML: speeds, torques, workspace, collision, friction; or MoveIt's files: calib formats moveit
        options: TOML: options of the identification that will follow (rows, drives, couplings, payloads)
        after: folder of an identification, which the motion adds to: for its model, information and torque errors
        pick: number of a motion in --out/front.csv to take instead of a search; with the options of that design
    """
    from calib.api.motions import design_excitation
    from calib.workers import finishing

    check_destination("excite", robot, out, [robot, model, limits, options, after, *settings.existing])
    with progress() as say:
        designed = design_excitation(
            robot,
            settings,
            model=model,
            limits=limits,
            options=options,
            after=after,
            pick=None if pick is None else (out, pick),
            base=base,
            tip=tip,
            workers=workers,
            progress=say,
        )
        say("writing")
        with finishing():
            designed.save(out, plots=plots)
    say_written(str(designed).splitlines(), out)


@command(app, "Dynamics")
def recall(folder: Path, log: str, out: Out, skip: int = 0, overwrite: bool = False) -> None:
    """Find a designed motion in a log, and average its periods. The result is a recording for calib identify.

    Example: calib recall motion log.csv --out period.npz

    Args:
        folder: folder written by calib excite
        log: a recording of it; log.npz@0:90 takes seconds 0 to 90
        out: the averaged period: .npz with its variance, or .csv
        skip: whole periods to leave out at the beginning
    """
    from calib.files import results
    from calib.procedure.excitation import coefficients

    with results([(out, coefficients.SUFFIXES)], coefficients.inputs(folder, log), overwrite):
        period = coefficients.find(folder, log, skip)
        coefficients.write(period, out)
    say_written(coefficients.lines(period), out)


@command(app, "Dynamics", "identify")
def identify_dynamics(
    robot: Robot,
    recordings: list[str],
    out: Out,
    validate: list[str] | None = None,
    method: str | None = None,
    friction: str | None = None,
    options: Path | None = None,
    excitation: Path | None = None,
    after: Path | None = None,
    with_geometry: bool = False,
    base: str | None = None,
    tip: str | None = None,
    seed: Seed = 0,
    plots: Plots = True,
) -> None:
    """Identify ROBOT's dynamics from recordings, and judge them. What counts is how well other motion is predicted.

    Of standing poses (one row each, no stamps) or a log that stands, gravity and payloads are identified.

    Example: calib identify fit log.csv --out dynamics

    Args:
        recordings: recordings of q and torque or current; log.npz@0:9.4 takes seconds 0 to 9.4
        out: folder for the identified model and its report
        validate: recording of other motion; may be repeated
        method: wls or another one of calib formats identify-options
        friction: auto, standard, or one step of the ladder; calib formats identify-options names them
        options: TOML: drives, payloads, gains, filters, identification
        excitation: folder of calib excite: its prediction is compared with the result; its motion is the reference of
            recordings that have none (methods with a [loop])
        after: folder of an earlier identification, for whose further motion calib excite --after predicted σ: its
            friction terms and the sizes of its prior are kept, unless the recordings contradict them
        with_geometry: estimate joint offsets, lengths and the direction of gravity again, together with the dynamics
    """
    from calib.api.dynamic import identify_dynamics as identified
    from calib.procedure.report.dynamics_section import read_lines

    unused = method, friction, excitation, after
    if _gravity(robot, recordings, validate or [], out, options, base, tip, seed, unused):
        return
    check_destination("identify", robot, out, [options, after, *recordings, *(validate or [])])

    def read(inputs: "IdentificationInputs") -> None:
        check_destination("identify", robot, out, [inputs.source, inputs.source.parent])
        say(*read_lines(inputs))

    with progress() as show:
        result = identified(
            robot,
            recordings,
            validate=validate or (),
            method=method,
            friction=friction,
            options=options,
            base=base,
            excitation=excitation,
            after=after,
            with_geometry=with_geometry or None,
            tip=tip,
            seed=seed,
            on_read=read,
            progress=show,
        )
        show("writing")
        result.save(out, plots=plots)
    comparison = []
    if excitation is not None:
        from calib.procedure.excitation import prediction  # slow to load

        if (excitation / prediction.NAME).is_file():
            comparison = [prediction.compared_with_identification(excitation, result)]
    say_written([*result.renderables(), *comparison], out, result.verdict.level)


def _gravity(
    robot: Robot,
    recordings: list[str],
    validate: list[str],
    out: Path,
    options: Path | None,
    base: str | None,
    tip: str | None,
    seed: int,
    unused: tuple[str | None, str | None, Path | None, Path | None],
) -> bool:
    """Identify gravity and write it, if all files are standing poses; return whether they are.

    Args:
        unused: method, friction, excitation and after, which standing poses do not use; None where they are not stated.
    """
    from calib.identification.identify_options import read_options
    from calib.procedure.dynamic_stage.inputs import with_choices
    from calib.procedure.dynamic_stage.standing import recorded_poses
    from calib.procedure.robot_kinds import stage_of

    named = [*recordings, *validate]
    if stage_of(robot, "identify") is not None:
        return False
    if not recorded_poses.stand(robot, named, options, base, tip):
        still = recorded_poses.standing_files(robot, named, options, base, tip)
        if still:
            names = ", ".join(still)
            say(f"standing poses: {names}; the other files are motions. Identify each kind by its own command")
        return False
    from calib.procedure.dynamic_stage.standing import gravity_result  # slow to load

    method, friction, _, _ = unused
    with_choices(read_options(options), method, friction, seed)
    names = ("method", "friction", "excitation", "after")
    stated = [f"--{name}" for name, value in zip(names, unused) if value is not None]
    if stated:
        say(f"not used for standing poses: {', '.join(stated)}")
    gravity_result.check_target(out, [options, *named])
    result = gravity_result.identify_gravity(robot, recordings, validate, options, base, tip, seed)
    result.write(out)
    say_written(result.lines(), out, result.verdict.level)
    return True


@command(app, "Motion")
def plan(
    robot: Robot,
    waypoints: Annotated[Path, typer.Option()],
    out: Out,
    settings: PlanSettings,
    model: Path | None = None,
    limits: Path | None = None,
    drives: Path | None = None,
    base: str | None = None,
    tip: str | None = None,
    plots: Plots = True,
) -> None:
    """Plan the fastest motion of ROBOT through waypoints. Speeds and torques stay within its limits.

    Example: calib plan fit --waypoints w.csv --out plan

    Args:
        waypoints: CSV of joint values, or x y z, qx qy qz qw of the tip
        out: folder for the motion, its figures and metrics.json
        model: folder of an identification: the dynamics to plan with
        limits: TOML: speeds, torques, workspace, collision, friction; or MoveIt's files: calib formats moveit
        drives: TOML: [drives] Ia, Fv, Fc, off, without --model
    """
    from calib.api.motions import plan_motion

    check_destination("plan", robot, out, [robot, waypoints, model, limits, drives])
    with progress() as say:
        planned = plan_motion(
            robot, waypoints, settings, model=model, limits=limits, drives=drives, base=base, tip=tip, progress=say
        )
        say("writing")
        planned.save(out, plots=plots)
    say_written(str(planned).splitlines(), out)
