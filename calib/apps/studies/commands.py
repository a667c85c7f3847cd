"""Commands that compare identification methods: study (simulated, known truth), compare (recordings)."""

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calib.cli.completion import Robot
from calib.cli.shared import Seed, command, exit_failed, reporting, say
from calib.config_types import Plots
from calib.errors import UsageError, one_of, require

if TYPE_CHECKING:
    from calib.toolkit.report_pages import Block

# Between two lines on progress where the output is no terminal [s].
LOG_INTERVAL = 30.0
# Most conditions whose tables are printed in full.
MAX_DETAILED = 3

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
    plots: Plots = True,
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
    from calib.apps.fleet import stores
    from calib.apps.studies import report
    from calib.toolkit.report_pages import rendered
    from calib.toolkit.torque_models import METHODS

    if list_methods:
        say(*METHODS.values())
    if list_studies:
        say(*report.study_lines())
    if list_methods or list_studies:
        return
    if not studies:
        raise UsageError("no study given: name a file, or a study of calib study --list")
    is_pattern = any(mark in studies[0] for mark in "*?[")
    if out is None and (len(studies) > 1 or is_pattern):
        raise UsageError("several studies need one folder: give --out DIR")
    location = out or f"{Path(studies[0]).stem}-study"
    if stores.is_address(location):
        local_folder = stores.held(location)
    else:
        local_folder = nullcontext(Path(location))
    with local_folder as folder, reporting(LOG_INTERVAL) as (_, progress):
        outcome = report.run_study(
            studies,
            folder,
            methods=_names(methods),
            runs=runs,
            where=workers,
            report_only=report_only,
            plots=plots,
            say=progress,
        )
    conditions = [condition for condition in outcome.conditions if condition.methods]
    blocks: list[Block] = []
    if len(conditions) > MAX_DETAILED:
        blocks += [report.overview(outcome.conditions), report.torque_table(outcome.conditions)]
    else:
        for condition in conditions:
            blocks += [report.condition_table(condition), *report.failures(condition)]
    say(*rendered(blocks), result=True)
    say(*outcome.described(), f"written to {location}: {report.REPORT} shows it")


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
    from calib.apps.studies import method_comparison
    from calib.apps.studies.method_comparison import ComparedMethod, caveats, compare_methods, write_table
    from calib.toolkit.model_identification import gather_recordings, read_identify_options
    from calib.toolkit.report_pages import printed_section

    table = []
    if out is not None:
        table = [(out, (".csv",))]
    files.check_results(table, [robot, *recordings, *(validate or []), options], overwrite)
    names = _names(methods)
    with reporting() as (say_line, progress):
        gathered = gather_recordings(
            robot,
            recordings,
            validate or (),
            options=read_identify_options(options),
            base=base,
            tip=tip,
            seed=seed,
            friction=friction,
            progress=progress,
        )

        def say_method(method: ComparedMethod) -> None:
            say_line(method_comparison.line(method))

        compared = compare_methods(gathered, names, friction, progress, say_method)
    section = method_comparison.section(compared, caveats(gathered, compared))
    say(*printed_section(section), result=True)
    if out is not None:
        with files.results(table, overwrite=overwrite):
            say(f"written to {write_table(compared, out)}")
    if all(method.failure for method in compared):
        raise typer.Exit(3)
    verdicts = [method.verdict for method in compared if method.verdict is not None]
    exit_failed(verdicts[0].level)


def _names(text: str | None) -> list[str] | None:
    """Return the names in a comma-separated list of methods, after a check that the methods exist.

    Args:
        text: the list; None: all methods, and None is returned.
    """
    from calib.toolkit.torque_models import METHODS

    if text is None:
        return None
    names = [name.strip() for name in text.split(",") if name.strip()]
    for name in names:
        one_of(name, METHODS, "--methods:", UsageError)
    require(names, "--methods is empty; see calib study --list-methods", UsageError)
    return names
