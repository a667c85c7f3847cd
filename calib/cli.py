"""The command ``calib``: commands only, no mathematics. Exit codes: 0 done (the verdict is pass or marginal), 1 done
but the verdict is fail, 2 input or usage, 3 not identifiable or not converged."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

# many small matrices: BLAS threads only get in each other's way (a fit on two busy cores: 9 s against 19 s)
for _pool in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_pool, "1")

INTERRUPTED = "interrupted; nothing was left half-written, and the same command goes on from here"

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # a unit in brackets is a unit, not a style
    help="Calibrate a robot: choose poses, fit the geometry, validate on unseen poses, export.",
)

_FLAGS = ("--debug", "--help", "--line", "--refit-frames", "--no-refit-frames")
_USAGE: Any = typer.BadParameter.__mro__[2]  # ClickException, of the click that this typer uses (or brings)

Robot = Annotated[str, typer.Argument(help="a .urdf, an MDH .toml, a library name, or the folder of an earlier fit")]
Base = Annotated[str | None, typer.Option(help="URDF: the link the arm starts at")]
Tip = Annotated[str | None, typer.Option(help="URDF: the link the arm ends at")]
Seed = Annotated[int, typer.Option(help="reproduces everything random")]


@app.callback()
def options(
    debug: Annotated[bool, typer.Option("--debug", help="show tracebacks (or set CALIB_DEBUG)")] = False,
) -> None:
    if debug:
        os.environ["CALIB_DEBUG"] = "1"


@app.command()
def fit(
    robot: Robot,
    measured: Annotated[list[Path], typer.Argument(help="CSV files of measured poses: calib formats measurements")],
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
    folds: Annotated[
        str,
        typer.Option(help="rows the ladder sets aside: transfer (stations, files, regions), regions, random or poses"),
    ] = "transfer",
    stations: Annotated[str, typer.Option(help="base placement: each file its own, or one for all")] = "each",
    tools: Annotated[str, typer.Option(help="one tool for all files, or each its own")] = "one",
    tolerance: Annotated[
        float | None, typer.Option(metavar="MM", help="rms on unseen poses, in mm, above which the verdict is fail")
    ] = None,
    base: Base = None,
    tip: Tip = None,
    seed: Seed = 0,
) -> None:
    """Fit the geometry of ROBOT to measured poses, and say how far to trust it.

    Exit codes: 0 the verdict is pass or marginal, 1 fail, 2 input or usage, 3 not identifiable or not converged.
    Pass means that on poses it has not seen the calibrated arm is better than the nominal one, or that there is nothing
    to gain; that it is good enough is said only with --tolerance.
    """
    from calib.data.options import read_options
    from calib.errors import UsageError
    from calib.geometry.effects import MODELS
    from calib.procedure import fitting, inputs, outputs, report, show

    if model not in (None, "auto", *MODELS):
        raise UsageError(f"--model {model}: expected auto, {', '.join(MODELS)}")
    if tolerance is not None and not 0.0 < tolerance < float("inf"):
        raise UsageError(f"--tolerance {tolerance:g}: expected a length above 0, in mm")
    chosen = read_options(options)
    outputs.check_target(out)
    found = inputs.gather(
        robot, measured, validate or [], options=chosen, holdout=holdout, stations=stations, tools=tools,
        refit_frames=refit_frames, base=base, tip=tip, seed=seed,
    )  # fmt: skip
    outputs.check_target(out, found.source)
    console = _console()
    for line in show.read_lines(found):
        console.print(line, soft_wrap=True)
    with _progress() as say:
        outcome = fitting.run(
            found, chosen, model=model, loss=loss, tolerance=1e-3 * tolerance if tolerance else None, folds=folds,
            seed=seed, progress=say,
        )  # fmt: skip
        say("writing")
        outputs.write_folder(outcome, out, report.write)
    for line in show.outcome_lines(outcome):
        console.print(line, soft_wrap=True)
    console.print(f"written to {out}", soft_wrap=True, markup=False)
    if outcome.verdict.level == "fail":
        raise typer.Exit(1)


@app.command()
def select(
    robot: Robot,
    out: Annotated[Path, typer.Option(help="CSV file of the chosen joint values, rad")],
    m: Annotated[int, typer.Option("-m", help="how many poses")] = 30,
    kind: Annotated[str, typer.Option(help="what will be measured: pose or position")] = "pose",
    tool: Annotated[
        list[str] | None, typer.Option(help="x,y,z of a target in the tip's frame [m]; may be repeated")
    ] = None,
    index: Annotated[str, typer.Option(help="O1 to O5, or cond")] = "O1",
    method: Annotated[str, typer.Option(help="detmax, multistart, tabu or local")] = "detmax",
    constraints: Annotated[Path | None, typer.Option(help="TOML, see calib formats constraints")] = None,
    candidates: Annotated[int, typer.Option(help="poses to choose from")] = 2000,
    existing: Annotated[Path | None, typer.Option(help="CSV of poses measured before, which count")] = None,
    sigma: Annotated[
        str | None, typer.Option(help="of a position [m] and an orientation [rad], e.g. 1e-4,1e-4")
    ] = None,
    workers: Annotated[str, typer.Option(help="local processes, or the address of a Dask scheduler")] = "1",
    base: Base = None,
    tip: Tip = None,
    seed: Seed = 0,
) -> None:
    """Choose the poses at which the geometry of ROBOT shows best."""
    from calib import workers as work
    from calib.procedure import selecting

    targets = [_numbers(text, 3, "--tool") for text in tool or []]
    sigmas = None if sigma is None else _numbers(sigma, 2, "--sigma")
    with work.workers(workers) as mapped, _progress() as say:
        chosen = selecting.choose(
            robot, m, kind=kind, tools=targets, index=index, method=method, constraints=constraints, existing=existing,
            candidates=candidates, sigmas=(sigmas[0], sigmas[1]) if sigmas else None, base=base, tip=tip, seed=seed,
            map=mapped, progress=lambda done, total, what: say(f"{what} ({done} of {total})"),
        )  # fmt: skip
    selecting.write(chosen, out)
    console = _console()
    for words, number in selecting.table(chosen):
        console.print(f"{words:38} {number}", soft_wrap=True, markup=False)
    for note in chosen.notes:
        console.print(f"note: {note}", soft_wrap=True, markup=False)
    console.print(f"{m} poses written to {out}", soft_wrap=True, markup=False)


@app.command()
def export(
    folder: Annotated[Path, typer.Argument(help="the folder of a fit")],
    urdf: Annotated[
        Path | None, typer.Option(help="the URDF to put the calibrated geometry into (it stays as it is)")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="the URDF to write")] = None,
    ur_kinematics: Annotated[Path | None, typer.Option(help="write ur_description's kinematics YAML")] = None,
    offsets: Annotated[Path | None, typer.Option(help="write a CSV of joint offsets")] = None,
    for_corrections: Annotated[
        bool, typer.Option("--for-corrections", help="the URDF that joint_corrections.csv belongs to, worse without it")
    ] = False,
) -> None:
    """Write the calibrated geometry for other programs."""
    from calib.errors import UsageError
    from calib.procedure import exporting

    if (urdf is None) != (out is None) or not (urdf or ur_kinematics or offsets):
        raise UsageError("nothing to write: give --urdf SOURCE.urdf --out FILE.urdf, --ur-kinematics or --offsets")
    found = exporting.read(folder)
    exporting.check_targets(urdf, [path for path in (out, ur_kinematics, offsets) if path])
    console = _console()
    if urdf and out:
        exporting.export_urdf(found, urdf, out, for_corrections)
        console.print(
            f"{out}: joint origins of {urdf} calibrated, all else kept; base link and flange stay where the source has "
            "them; Pinocchio reads the same poses to 1e-9", soft_wrap=True, markup=False,
        )  # fmt: skip
    if ur_kinematics:
        exporting.export_ur_kinematics(found, ur_kinematics)
        console.print(f"{ur_kinematics}: for kinematics_params_file of ur_description", soft_wrap=True, markup=False)
        if note := exporting.flange_note(found):
            console.print(f"note: {note}", soft_wrap=True, markup=False)
    if offsets:
        exporting.export_offsets(found, offsets)
        console.print(
            f"{offsets}: offset of each joint, the rest of the geometry left out; --model offsets fits the best ones",
            soft_wrap=True, markup=False,
        )  # fmt: skip
    if found.corrected:
        note = f"note: the corrections in {folder}/joint_corrections.csv are in none of these files"
        note += f": {found.alone}" if found.alone else ""
        console.print(note, soft_wrap=True, markup=False)


# Dynamics: identify


@app.command("identify")
def identify_dynamics(
    robot: Robot,
    recordings: Annotated[list[str], typer.Argument(help="recordings of q and torque or current; log.npz@0:9.4 cuts")],
    out: Annotated[Path, typer.Option(help="folder for the identified model and its report")],
    validate: Annotated[list[str] | None, typer.Option(help="recording of other motion; may be repeated")] = None,
    method: Annotated[str | None, typer.Option(help="ols, wls, irls, tls or iv")] = None,
    friction: Annotated[
        str | None, typer.Option(help="auto, standard, or one rung: load, presliding, stribeck, root, ...")
    ] = None,
    options: Annotated[
        Path | None, typer.Option(help="TOML: drives, payloads, gains, filters, how to identify")
    ] = None,
    base: Base = None,
    tip: Tip = None,
    seed: Seed = 0,
) -> None:
    """Identify the dynamics of ROBOT from recordings, and say how well it predicts other motion."""
    from calib.identification.options import read_options
    from calib.procedure import identification_outputs, identification_plots, identification_show, identifying

    chosen = read_options(options)
    identification_outputs.check_target(out)
    console = _console()
    with _progress() as say:
        found = identifying.gather(
            robot, recordings, validate or [], options=chosen, method=method, friction=friction, base=base, tip=tip,
            seed=seed, progress=say,
        )  # fmt: skip
        identification_outputs.check_target(out, found.source)
    for line in identification_show.read_lines(found):
        console.print(line, soft_wrap=True)
    with _progress() as say:
        outcome = identifying.run(found, progress=say)
        say("writing")
        identification_outputs.write_folder(outcome, out, identification_plots.write)
    for line in identification_show.outcome_lines(outcome):
        console.print(line, soft_wrap=True)
    console.print(f"written to {out}", soft_wrap=True, markup=False)
    if outcome.verdict.level == "fail":
        raise typer.Exit(1)


# Excitation: excite


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
    workers: Annotated[str, typer.Option(help="local processes, or the address of a Dask scheduler")] = "1",
    base: Base = None,
    tip: Tip = None,
    seed: Seed = 0,
) -> None:
    """Design a motion that excites the dynamics of ROBOT within its limits."""
    from calib import workers as work
    from calib.procedure import excitation_outputs, exciting

    excitation_outputs.check_target(out)
    with work.workers(workers) as mapped, _progress() as say:
        designed = exciting.excite(
            robot, model=model, limits=limits, goals=goal or [], hard=hard or [], period=period, harmonics=harmonics,
            family=family, drives_=drives, rate=rate, starts=starts, evaluations=evaluations, front=front, base=base,
            tip=tip, seed=seed, map=mapped, progress=say,
        )  # fmt: skip
        say("writing")
        excitation_outputs.write_folder(designed, out)
    console = _console()
    for line in excitation_outputs.lines(designed):
        console.print(line, soft_wrap=True, markup=False)
    console.print(f"written to {out}", soft_wrap=True, markup=False)


# Motion planning: plan


@app.command()
def plan(
    robot: Robot,
    waypoints: Annotated[Path, typer.Option(help="CSV of joint values, a row per waypoint, in order")],
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
    from calib.procedure import motion_outputs, motion_planning

    motion_outputs.check_target(out)
    stands = None if start is None else _numbers(start, start.count(",") + 1, "--start")
    with _progress() as say:
        planned = motion_planning.plan(
            robot, waypoints, model=model, payloads=payload or [], limits=limits, drives_file=drives, lines=line,
            rate=rate, evaluations=shorten, stray=stray, start=stands, slower=slower, base=base, tip=tip,
            progress=say,
        )  # fmt: skip
        say("writing")
        motion_outputs.write_folder(planned, out)
    console = _console()
    for words in motion_outputs.lines(planned):
        console.print(words, soft_wrap=True, markup=False)
    console.print(f"written to {out}", soft_wrap=True, markup=False)


# The guided session: new, next, status, redo, demo

Folder = Annotated[Path, typer.Argument(help="the session's folder")]


@app.command()
def new(
    folder: Folder,
    robot: Annotated[str, typer.Option(help="a .urdf, an MDH .toml, a library name, or the folder of an earlier fit")],
    instrument: Annotated[str, typer.Option(help="cmm, tracker, tracker6d, mocap, camera, other-pose, other-position")],
    poses: Annotated[int, typer.Option(help="poses to choose for the fit")] = 40,
    validation: Annotated[int, typer.Option(help="poses to measure and never fit; 0 for none")] = 20,
    base: Base = "",
    tip: Tip = "",
    seed: Seed = 0,
) -> None:
    """Make a session FOLDER: calibrate a robot step by step, with a certificate at the end.

    What is to be measured goes into FOLDER/3-measured as CSV (calib formats measurements); how the session goes on is
    said in FOLDER/session.toml (calib formats session).
    """
    from calib.procedure import guided

    made = guided.begin(
        folder, robot, instrument, poses=poses, validation=validation, base=base or "", tip=tip or "", seed=seed
    )
    _console().print(f"made {made.folder}; next: calib next {made.folder}", soft_wrap=True, markup=False)


@app.command()
def formats(
    topic: Annotated[
        str | None,
        typer.Argument(help="measurements, options, constraints, mdh, robot, session or recordings"),
    ] = None,
) -> None:
    """Print what the files of this toolkit hold: columns, keys, units."""
    from calib.procedure import formats as documents

    print(documents.describe(topic) if topic else "\n".join(documents.overview()))


@app.command("next")
def next_step(folder: Folder) -> None:
    """Do what can be done in a session, then say what to do at the robot."""
    _go_on(folder, f"calib next {folder}")


@app.command()
def redo(
    folder: Folder,
    step: Annotated[str, typer.Argument(help="describe, select, measure, fit, validate, export, certificate")],
) -> None:
    """Make a step of a session again, and all that rests on it."""
    _go_on(folder, f"calib redo {folder} {step}", step)


@app.command()
def status(folder: Folder) -> None:
    """Show how far a session is, and what is stale because something changed."""
    from calib.procedure import guided

    console = _console()
    for renderable in guided.status_lines(folder):
        console.print(renderable, soft_wrap=True)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="the session's folder")] = Path("calib-demo"),
    robot: Annotated[str, typer.Option(help="a robot of the library")] = "lwr4plus",
    seed: Seed = 0,
) -> None:
    """Calibrate a simulated robot with a simulated instrument, and compare with the hidden truth."""
    from calib.procedure import demo as demonstration

    with _told() as (console, say, progress):
        found = demonstration.run(out, robot, seed, say, progress)
    console.print(f"\n{found.seconds:.1f} s. Look at", soft_wrap=True, markup=False)
    for words, name in demonstration.RESULTS:
        console.print(f"  {words:15} {found.session.folder / name}", soft_wrap=True, markup=False)
    if found.verdict == "fail":
        raise typer.Exit(1)


def _go_on(folder: Path, command: str, again: str = "") -> None:
    from calib.procedure import guided

    with _told() as (console, say, progress):
        stop = guided.go_on(folder, say, progress, command, again)
    for line in stop.lines:
        console.print(line, soft_wrap=True, markup=False)
    if stop.verdict == "fail":
        raise typer.Exit(1)


@contextmanager
def _told() -> Iterator[tuple[Any, Any, Any]]:
    """Yield a console, and two functions on it: for lines that stay, and for words that show while work goes on."""
    from rich.markup import escape

    console = _console()
    with console.status("") as status:
        say = lambda words: console.print(words, soft_wrap=True, markup=False)  # noqa: E731
        yield console, say, lambda words: status.update(escape(words))


def _numbers(text: str, count: int, option: str) -> list[float]:
    from calib.errors import UsageError

    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count:
        raise UsageError(f"{option} {text}: expected {count} numbers with commas between them")
    return values


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with one of the codes above."""
    sys.exit(run(arguments))


def run(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code; errors become one message on stderr."""
    try:
        given = list(sys.argv[1:] if arguments is None else arguments)
        code = int(app(args=_spread(given), standalone_mode=False) or 0)
        return _complain(INTERRUPTED, 130) if code == 130 else code  # Typer turns Ctrl-C into this code
    except typer.Exit as stop:
        return stop.exit_code
    except _USAGE as error:
        error.show()
        return 2
    except (KeyboardInterrupt, typer.Abort):
        return _complain(INTERRUPTED, 130)
    except Exception as error:
        code = _code(error)
        if code is None or os.environ.get("CALIB_DEBUG"):
            raise
        return _complain(str(error), code)


def _spread(arguments: list[str]) -> list[str]:
    """Return the arguments of ``fit`` and ``identify``, ``--validate a b`` written as ``--validate a --validate b``.

    Only where ROBOT and MEASURED have come before: what follows --validate then cannot be one of them.
    """
    result: list[str] = []
    option, positionals, spreading = "", 0, False
    for word in arguments:
        if word.startswith("--"):
            option = "" if word in _FLAGS or "=" in word else word
            spreading = False
        elif option:
            spreading = option == "--validate" and positionals > 2  # the command itself, ROBOT, MEASURED
            option = ""
        elif spreading:
            result.append("--validate")
        else:
            positionals += 1
        result.append(word)
    return result if {"fit", "identify"} & set(arguments[:2]) else arguments


def _code(error: Exception) -> int | None:
    """Return the exit code of an error raised on purpose; None for any other."""
    from calib.errors import CalibError, NotConverged, Unidentifiable

    if isinstance(error, (NotConverged, Unidentifiable)):
        return 3
    if isinstance(error, CalibError):
        return 2
    module = sys.modules.get("poses.errors")
    if module is not None and isinstance(error, module.NotIdentifiable):
        return 3
    if type(error).__module__.split(".")[0] in ("poses", "trajectories"):
        return 2
    return None


def _complain(message: str, code: int) -> int:
    print(f"calib: {message}", file=sys.stderr)
    return code


def _console(**options: Any) -> Any:
    from rich.console import Console

    return Console(highlight=False, **options)


@contextmanager
def _progress() -> Iterator[Any]:
    """Show on stderr what is being done, where stderr is a terminal."""
    console = _console(stderr=True)
    with console.status("") as status:
        yield lambda words: status.update(str(words))


if __name__ == "__main__":
    main()
