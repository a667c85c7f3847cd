"""Commands that compare identification methods: study (simulated, known truth), compare (recordings)."""

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from calib.cli.completion import Robot
from calib.cli.shared import Seed, command, exit_failed, reporting, say
from calib.errors import UsageError, one_of, require

app = typer.Typer()


@command(app, "Files and studies")
def study(
    studies: Annotated[list[str] | None, typer.Argument()] = None,
    out: str | None = None,
    methods: str | None = None,
    runs: Annotated[int | None, typer.Option(min=0)] = None,
    workers: str = "1",
    report_only: bool = False,
    list_methods: bool = False,
    list_studies: Annotated[bool, typer.Option("--list")] = False,
    plots: bool = True,
) -> None:
    """Compare identification methods on simulated robots. Runs STUDIES, or what of them is missing (Monte Carlo).

    Rows go to the disk as they come: a study that was stopped, or lost workers, goes on from there when the same
    command is given again; asked for more runs, it adds them. What a study file holds: calib formats study.

    Example: calib study MCS-TX40-1-1 --runs 5

    Args:
        studies: study files, or names of shipped ones: MCS-TX40-1-1, 'MCS-*'
        out: folder for rows and report, or its address (s3://bucket/study); default: the study's name
        methods: methods instead of the file's: wls,iv,didim
        runs: data sets per condition, instead of the file's
        report_only: report existing rows without running trials
        list_methods: list all methods with their requirements
        list_studies: list the studies shipped with the toolkit
    """
    from calib.identification.registry import METHODS
    from calib.procedure.report import page
    from calib.rooms.fleet import stores
    from calib.rooms.studies import report

    if list_methods or list_studies:
        say(*(map(str, METHODS.values()) if list_methods else ()), *(report.study_lines() if list_studies else ()))
        return
    if not studies:
        raise UsageError("no study given: name a file, or a study of calib study --list")
    if out is None and (len(studies) > 1 or any(mark in studies[0] for mark in "*?[")):
        raise UsageError("several studies need one folder: give --out DIR")
    place = out or f"{Path(studies[0]).stem}-study"
    log_interval = 30.0  # [s] between two lines on progress where the output is no terminal
    kept = stores.held(place) if stores.is_address(place) else nullcontext(Path(place))
    with kept as folder, reporting(log_interval) as (_, progress):
        found = report.run_study(
            studies,
            folder,
            methods=_names(methods),
            runs=runs,
            where=workers,
            report_only=report_only,
            plots=plots,
            say=progress,
        )
    seen = [one for one in found.conditions if one.methods]
    max_shown = 3  # conditions whose tables are printed in full
    if len(seen) > max_shown:
        blocks = [report.overview(found.conditions), report.torque_table(found.conditions)]
    else:
        blocks = [block for one in seen for block in (report.condition_table(one), *report.failures(one))]
    say(*page.rendered(blocks), result=True)
    say(*found.described(), f"written to {place}: {report.REPORT} shows it")


@command(app, "Files and studies")
def compare(
    robot: Robot,
    recordings: list[str],
    validate: list[str] | None = None,
    methods: str | None = None,
    friction: str = "standard",
    options: Path | None = None,
    out: Path | None = None,
    overwrite: bool = False,
    base: str | None = None,
    tip: str | None = None,
    seed: Seed = 0,
) -> None:
    """Rank identification methods on recordings of your robot.

    The recommended method gets the verdict of calib identify; if it is fail, none is recommended: exit code 1.

    Example: calib compare fit log.csv --validate other.csv

    Args:
        recordings: training recordings; log.npz@0:9.4 cuts
        validate: recording of other motion (repeatable option)
        methods: wls,iv,didim; default: all that the options allow
        friction: as for calib identify; loops are simulated with standard friction
        options: TOML, as for calib identify; with [loop], all methods run
        out: output CSV for the table
    """
    from calib import files
    from calib.identification.identify_options import read_options
    from calib.procedure.dynamic_stage import inputs
    from calib.procedure.report import page
    from calib.rooms.studies import method_comparison
    from calib.rooms.studies.method_comparison import caveats, compare_methods, write_table

    table = [] if out is None else [(out, (".csv",))]
    files.check_results(table, [robot, *recordings, *(validate or []), options], overwrite)
    chosen = _names(methods)
    with reporting() as (say_now, progress):
        given = inputs.gather(
            robot,
            recordings,
            validate or (),
            options=read_options(options),
            base=base,
            tip=tip,
            seed=seed,
            friction=friction,
            progress=progress,
        )
        found = compare_methods(given, chosen, friction, progress, lambda one: say_now(method_comparison.line(one)))
    say(*page.section(method_comparison.section(found, caveats(given, found))), result=True)
    if out is not None:
        with files.results(table, overwrite=overwrite):
            say(f"written to {write_table(found, out)}")
    if all(one.failure for one in found):
        raise typer.Exit(3)
    exit_failed(next(one.verdict.level for one in found if one.verdict is not None))


def _names(text: str | None) -> list[str] | None:
    """Return the methods of a comma-separated list after a check of their names; None for all."""
    from calib.identification.registry import METHODS

    if text is None:
        return None
    found = [name.strip() for name in text.split(",") if name.strip()]
    for name in found:
        one_of(name, METHODS, "--methods:", UsageError)
    require(found, "--methods is empty; see calib study --list-methods", UsageError)
    return found
