"""Comparing methods of identification: study (simulated, truth known)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.shared import Plots, reporting, say

app = typer.Typer()
SHOWN = 3  # conditions whose tables are printed in full


@app.command()
def study(
    studies: Annotated[
        list[str] | None, typer.Argument(metavar="STUDY...", help="study files, or shipped ones: MCS-TX40-1-1, 'MCS-*'")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="folder of its rows and report; default: the study's name")] = None,
    methods: Annotated[str | None, typer.Option(help="in place of the file's: wls,iv,didim")] = None,
    runs: Annotated[int | None, typer.Option(min=0, help="data sets per condition, in place of the file's")] = None,
    workers: Annotated[str, typer.Option(help="local processes, or the address of a Dask scheduler")] = "1",
    report_only: Annotated[bool, typer.Option("--report-only", help="run nothing: report what is there")] = False,
    list_methods: Annotated[bool, typer.Option("--list-methods", help="all methods, and what each needs")] = False,
    list_studies: Annotated[bool, typer.Option("--list", help="the studies that come with the toolkit")] = False,
    plots: Plots = True,
) -> None:
    """Compare identification methods where the truth is known. Runs STUDY, or what of it is missing (Monte Carlo).

    Rows go to the disk as they come: a study that was stopped, or lost workers, goes on from there when the same
    command is given again; asked for more runs, it adds them. What a study file holds: calib formats study.
    """
    from calib.errors import UsageError
    from calib.procedure.report import console
    from calib.procedure.study import outcome, report

    if list_methods or list_studies:
        say(*(outcome.method_lines() if list_methods else ()), *(outcome.study_lines() if list_studies else ()))
        return
    if not studies:
        raise UsageError("no study named: give a file, or a name out of calib study --list")
    if out is None and (len(studies) > 1 or any(mark in studies[0] for mark in "*?[")):
        raise UsageError("several studies together need a folder: --out DIR")
    folder = out or Path(f"{Path(studies[0]).stem}-study")
    chosen = None if methods is None else [name.strip() for name in methods.split(",") if name.strip()]
    with reporting() as (_, progress):
        found = outcome.run_study(
            studies, folder, methods=chosen, runs=runs, where=workers, report_only=report_only, plots=plots,
            say=progress,
        )  # fmt: skip
    tables = [report.condition_table(one) for one in found.conditions if one.methods]
    say(*console.rendered(tables if len(tables) <= SHOWN else [report.overview(found.conditions)]))
    say(*outcome.described(found), f"written to {folder}: {outcome.REPORT} shows it")
