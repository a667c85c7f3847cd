"""The report of a study as one HTML file: tables, box plots, and the decision rule; the tables also for the console.

`calib study` runs the missing trials, summarises all rows, and reports which method to use. Its folder contains

rows.sqlite              every trial (`store`); any later command may add more summary.csv              one line per
condition and method: for every figure of merit the median and, as lower and
                         upper, the quartiles, each the nearest of the runs' own values
report.html              tables, box plots, the decision rule; one file
"""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

import numpy as np

from calib import files
from calib.apps.studies.conditions import Condition, Study, read_study, shipped
from calib.apps.studies.run import Progress, run, span
from calib.apps.studies.store import LOCK, ROWS, check_format, opened, read_rows
from calib.apps.studies.summary import (
    ALIKE,
    FIGURES,
    LEVEL,
    MIN_DATA_SETS,
    RELIABLE,
    SLACK,
    ConditionSummary,
    MethodSummary,
    summarise,
)
from calib.apps.studies.trial import TrialRow
from calib.config_types import Plots
from calib.errors import UsageError, require
from calib.toolkit.report_charts import AFTER, BEFORE, MARK, Box, Chart, Label, Layer, Line, Panel, write_figures
from calib.toolkit.report_pages import (
    Block,
    ChartPicture,
    Pictures,
    RecordColumn,
    ReportTable,
    Section,
    Text,
    read_figures,
    table,
)
from calib.workers import workers

# Height of one method in a box plot [in].
METHOD_HEIGHT = 0.21

RULE = (
    f"A method counts as good if it gives an estimate in at least {RELIABLE:.0%} of the trials, and if its noise-free "
    "torque error on unseen motion cannot be distinguished from that of the best method on the same data sets (sign "
    f"test, {LEVEL:.0%}) or is larger by at most {SLACK:.0%} in the median data set.",
    f"Recommended is the best good method with at most {ALIKE:g} times the processor time of the cheapest good one.",
    "A trial without an estimate counts as an infinite error, in medians and in comparisons.",
    f"A method with fewer than {MIN_DATA_SETS} runs is listed, but not compared.",
)
MEANING = (
    "torque: 100 ‖τ̂ - τ‖ / ‖τ‖ on unseen motion, with the noise-free torques τ of the true robot.",
    "β: 100 ‖β̂ - β‖ / ‖β‖ of the base parameters; in σ: rms of their errors divided by their stated σ (ideally 1); "
    "covered: share of errors within 1.96 σ (ideally 95 %).",
    "d_τ, d_q: the survey's figures, on the training data. d_τ compares with noisy torques; the noise limits it for "
    "all methods, so it cannot rank them.",
    "All are medians over trials; CPU: processor time of the method alone; p: sign test against the best method.",
)

# Results of a study beside its rows, and all files that it owns.
SUMMARY = "summary.csv"
REPORT = "report.html"
OURS = (ROWS, LOCK, SUMMARY, REPORT)


def boxes(condition: ConditionSummary, rows: Sequence[TrialRow]) -> ChartPicture:
    """Return the box plot of a condition: torque errors of each method over its runs.

    Args:
        condition: summary of the condition.
        rows: rows of the condition's trials.
    """
    layers: list[Layer] = []
    all_errors: list[float] = []
    for height, method in enumerate(condition.methods):
        method_rows = [row for row in rows if row.method == method.method]
        errors = [row.torque_error for row in method_rows if np.isfinite(row.torque_error)]
        all_errors += errors
        colour = BEFORE
        if method.as_good:
            colour = AFTER
        if len(errors) < MIN_DATA_SETS:
            layers.append(Line(errors, [height] * len(errors), "o", colour, size=4.0))
        else:
            layers.append(Box(errors, height, colour))
    low = 0.8 * max(min(all_errors, default=0.1), 1e-6)
    high = 1.25 * max(max(all_errors, default=1.0), 1.1e-6)
    for height, method in enumerate(condition.methods):
        failed = sum(method.failures.values())
        if failed:
            layers.append(Label(f"{failed} failed", high, height, (3, 0), MARK, along="center"))
    names = [method.method for method in condition.methods]
    panel = Panel(layers, x="torque error [%]", xlim=(low, high), log="x", ynames=names, grid="x")
    caption = (
        "Torque error on unseen motion, noise-free: boxes from quartile to quartile with the median, lines to the 5th "
        f"and 95th percentile, points beyond; fewer than {MIN_DATA_SETS} as points. Dark: as good as the best. Trials "
        "without an estimate are counted at the right."
    )
    return ChartPicture(Chart([panel], 0.75 + METHOD_HEIGHT * len(names)), caption, "errors")


def _short(value: float) -> str:
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞"
    if abs(value) < 1e5:
        return f"{value:.3g}"
    return f"{value:.1e}"


def _median(header: str, figure: str) -> RecordColumn:
    return RecordColumn(header, lambda method: _short(method.figures[figure].median))


def _failures(method: MethodSummary) -> str:
    counts = [f"{count} {status}" for status, count in method.failures.items()]
    return ", ".join(counts) or "0"


def _quartiles(method: MethodSummary) -> str:
    _, lower, upper = method.figures["torque_error"]
    return f"{_short(lower)}–{_short(upper)}"


def _p_value(method: MethodSummary) -> str:
    return _short(method.p)


def _mark(method: MethodSummary) -> str:
    if method.chosen:
        return "take"
    if method.as_good:
        return "as good"
    if method.enough:
        return ""
    return "few runs"


def _yes_or_no(value: bool) -> str:
    if value:
        return "yes"
    return "no"


def _is_chosen(method: MethodSummary) -> bool:
    return method.chosen


COLUMNS = (
    RecordColumn("method", "{0.method}", number=False),
    RecordColumn("trials", "{0.trials}"),
    RecordColumn("failed", _failures),
    _median("torque [%]", "torque_error"),
    RecordColumn("quartiles", _quartiles),
    _median("worst joint [%]", "torque_worst"),
    _median("β [%]", "beta_error"),
    _median("in σ", "beta_sigma"),
    _median("covered [%]", "coverage"),
    _median("d_τ [%]", "survey_tau"),
    _median("d_q [%]", "survey_q"),
    _median("rounds", "iterations"),
    _median("simulations", "simulations"),
    _median("CPU [s]", "cpu"),
    RecordColumn("p", _p_value),
    RecordColumn("", _mark, number=False),
)
ON_CONSOLE = ("method", "trials", "failed", "torque [%]", "quartiles", "covered [%]", "CPU [s]", "")


def overview(conditions: Sequence[ConditionSummary]) -> ReportTable:
    """Return a table with the recommended method of each condition."""
    lines = []
    for summary in conditions:
        name, description = summary.condition.name, _described(summary.condition)
        if not summary.methods:
            lines.append((name, description, "no rows yet", "", "", "", ""))
            continue
        chosen, chosen_error = "none", ""
        if summary.chosen is not None:
            chosen = summary.chosen.method
            chosen_error = _short(summary.chosen.figures["torque_error"].median)
        best = ""
        if summary.best is not None:
            best = f"{summary.best.method} {_short(summary.best.figures['torque_error'].median)}"
        as_good = []
        failed = []
        for method in summary.methods:
            if method.as_good and method is not summary.chosen:
                as_good.append(method.method)
            if method.failures:
                failed.append(f"{method.method} {sum(method.failures.values())}/{method.trials}")
        lines.append((name, description, chosen, chosen_error, best, ", ".join(as_good), ", ".join(failed)))
    header = ("condition", "", "take", "torque [%]", "best [%]", "as good", "without an estimate")
    return ReportTable("What to take", header, lines, numbers=(3,))


def torque_table(conditions: Sequence[ConditionSummary]) -> ReportTable:
    """Return a table with the median torque error of each method on each condition."""
    names: list[str] = []
    for summary in conditions:
        for method in summary.methods:
            if method.method not in names:
                names.append(method.method)
    lines = []
    for summary in conditions:
        by_name = {method.method: method for method in summary.methods}
        cells = [_median_cell(by_name.get(name)) for name in names]
        lines.append((summary.condition.name, *cells))
    note = (
        f"Median over trials [%]; a trial without an estimate counts as ∞. *: recommended; (n): n runs, fewer than "
        f"{MIN_DATA_SETS} runs."
    )
    numbers = range(1, len(names) + 1)
    return ReportTable("Torque error on unseen motion", ("condition", *names), lines, note, numbers=numbers)


def _median_cell(method: MethodSummary | None) -> str:
    if method is None:
        return ""
    median = _short(method.figures["torque_error"].median)
    if method.chosen:
        return f"{median}*"
    if method.enough:
        return median
    return f"{median} ({method.trials})"


def reasons(conditions: Sequence[ConditionSummary]) -> list[str]:
    """Return sentences that explain why conditions have no recommended method."""
    by_reason: dict[str, list[str]] = {}
    for summary in conditions:
        if summary.why_none:
            by_reason.setdefault(summary.why_none, []).append(summary.condition.name)
    sentences = []
    for reason, names in by_reason.items():
        if 1 < len(names) == len(conditions):
            concerned = "all"
        else:
            concerned = ", ".join(names)
        sentences.append(f"no method recommended for {concerned}: {reason}")
    return sentences


def _described(condition: Condition) -> str:
    """Return a condition as one line: robot, motion, rate, noise, decimation, cutoff, mismatch, guesses."""
    parts = [condition.robot]
    if condition.motion != "random":
        parts.append(condition.motion)
    if condition.rate:
        parts.append(f"{condition.rate:g} Hz")
    cutoff = "unfiltered"
    if condition.cutoff:
        cutoff = f"{condition.cutoff:g} Hz"
    degrees = math.degrees(condition.sigma_q)
    noise = f"{degrees:.3g}°, {condition.sigma_tau:g} N·m"
    description = f"{' '.join(parts)}, {noise}, r = {condition.decimation}, {cutoff}"
    if condition.mismatch != "none":
        description += f", {condition.mismatch}"
    if condition.guesses > 1:
        description += f", {condition.guesses} guesses"
    return description


def condition_table(summary: ConditionSummary, names: Sequence[str] = ON_CONSOLE) -> ReportTable:
    """Return a table of all methods on a condition, best first.

    Args:
        summary: summary of the condition.
        names: names of the columns; by default those for a terminal.
    """
    columns = [column for column in COLUMNS if column.name in names]
    title = f"Methods on {summary.condition.name}"
    return table(title, columns, summary.methods, _described(summary.condition), _is_chosen)


def failures(summary: ConditionSummary) -> list[Text]:
    """Return the failures of each method on a condition: kind, number, and first message; an empty list without any.

    Args:
        summary: summary of the condition.
    """
    lines = []
    for method in sorted(summary.methods, key=attrgetter("method")):
        for status, count in method.failures.items():
            lines.append(f"{method.method}: {count} {status}, e.g. {method.examples[status]}")
    if lines:
        return [Text("Without an estimate", lines)]
    return []


def summary_table(conditions: Sequence[ConditionSummary]) -> tuple[list[str], list[list[object]]]:
    """Return header and rows of ``summary.csv``."""
    header = ["condition", "method", "trials", "failed", "rank", "as_good", "take", "p"]
    for figure in FIGURES:
        header += [f"{figure}_median", f"{figure}_lower", f"{figure}_upper"]
    lines: list[list[object]] = []
    for summary in conditions:
        for method in summary.methods:
            failed = sum(method.failures.values())
            cells: list[object] = [summary.condition.name, method.method, method.trials, failed, method.rank]
            cells += [_yes_or_no(method.as_good), _yes_or_no(method.chosen), method.p]
            for figure in FIGURES:
                cells.extend(method.figures[figure])
            lines.append(cells)
    return header, lines


def make_page(
    study: Study,
    conditions: Sequence[ConditionSummary],
    rows: Sequence[TrialRow],
    notes: Sequence[str],
    plots: Plots = True,
) -> str:
    """Return the report of a study as HTML.

    Args:
        study: the study.
        conditions: summaries of its conditions.
        rows: the rows of these conditions.
        notes: notes for the reader.
        plots: whether box plots are included.
    """
    from calib.toolkit.report_pages import filled, interactive, issued

    blocks: list[Block] = [overview(conditions)]
    if len(conditions) > 1:
        blocks.append(torque_table(conditions))
    blocks += [Text("How methods are recommended", RULE), Text("Figures", MEANING)]
    sections = [Section("", blocks)]
    all_columns = [column.name for column in COLUMNS]
    for summary in conditions:
        if not summary.methods:
            continue
        blocks = [condition_table(summary, all_columns)]
        if plots:
            condition_rows = [row for row in rows if row.digest == summary.condition.digest]
            blocks.append(Pictures("", [boxes(summary, condition_rows)]))
        blocks += failures(summary)
        sections.append(Section(summary.condition.name, blocks))
    sections, figures = interactive(sections)
    return filled(
        "calib.apps.studies",
        "study.html",
        title=study.name,
        about=study.about,
        sections=sections,
        figures=figures,
        notes=notes,
        issued=f"{issued()}, {len(rows)} trials",
    )


@dataclass(frozen=True)
class StudyOutcome:
    """Result of a study.

    Attributes:
        conditions: summary of each condition.
        progress: progress of the command that ran the study.
        notes: notes for the user.
        folder: folder of rows, summary and report.
        rows: sentence on the number of rows in the store; empty where no trial was run.
    """

    conditions: tuple[ConditionSummary, ...]
    progress: Progress
    notes: tuple[str, ...]
    folder: Path
    rows: str = ""

    def described(self) -> list[str]:
        """Return the closing console lines of a command."""
        lines = [f"note: {note}" for note in self.notes]
        if self.progress.total:
            lines.append(f"{self.progress} in {span(self.progress.seconds)}")
            lines += self.progress.pace.lines()
        if self.rows:
            lines.append(self.rows)
        return lines


def _silent(message: str) -> None:
    pass


def run_study(
    studies: Sequence[str | Path],
    out: Path,
    *,
    methods: Sequence[str] | None = None,
    runs: int | None = None,
    where: str | int | None = None,
    report_only: bool = False,
    plots: Plots = True,
    say: Callable[[str], None] = _silent,
) -> StudyOutcome:
    """Run the missing trials of a study, write its report, and return its result.

    Args:
        studies: study files, names of shipped ones, or patterns of these names.
        out: the study's folder; trials whose rows it already contains are not run again.
        methods, runs: replace the methods and the number of runs in the files; None: as in the files.
        where: number of local processes, or the address of a Dask scheduler; None: the tasks run in this process.
        report_only: run nothing and leave the rows unchanged; possible while another command adds rows.
        plots: whether the report has figures.
        say: called with messages on progress.

    Raises:
        UsageError: an invalid study file, a folder in use by another command, or rows of another version.
        CalibError: rows cannot be written, or the workers are lost; rows written before remain.
    """
    study = read_study(studies, methods, runs)
    _check_folder(out, studies)
    progress = Progress(0)
    stored = ""
    if report_only:
        # Takes no lock: a study that runs there may be looked at.
        rows = read_rows(out)
    else:
        with opened(out) as store:
            say(f"{len(store.rows)} rows exist")
            with workers(where) as crew:
                progress = run(study, store, crew, lambda progress: say(str(progress)))
            say("writing")
            rows = list(store.rows.values())
            stored = f"{ROWS} contains {len(rows)} rows"
    counted, notes = _counted(study, rows)
    if not progress.lost and not counted:
        contents = "no rows"
        if rows:
            contents = f"{len(rows)} rows"
        contents = "; ".join([contents, *notes])
        advice = "ask for 1 run or more (--runs)"
        if report_only:
            advice = "run the study first, or name its folder (--out)"
        raise UsageError(f"nothing to report: {out} contains {contents}; {advice}")
    versions = sorted({row.toolkit for row in counted})
    if len(versions) > 1:
        notes.append(f"rows were made by several versions: {', '.join(versions)}")
    if progress.lost:
        notes.append(f"{progress.lost} trials were lost with their workers; run the same command again")
    conditions = tuple(summarise(study, counted))
    notes += reasons(conditions)
    files.write_table(out / SUMMARY, *summary_table(conditions))
    page = files.write(out / REPORT, make_page(study, conditions, counted, notes, plots))
    write_figures(out, read_figures(page), plots, paged=True)
    return StudyOutcome(conditions, progress, tuple(notes), out, stored)


def _counted(study: Study, rows: Sequence[TrialRow]) -> tuple[list[TrialRow], list[str]]:
    """Return the stored rows that are used for a study, and notes on the rows that are not used."""
    digests = {condition.digest for condition in study.conditions}
    study_rows = [row for row in rows if row.digest in digests]
    notes = []
    foreign = len(rows) - len(study_rows)
    if foreign:
        notes.append(f"{foreign} rows belong to conditions outside this study: kept, but not counted")
    outdated = Counter(row.method for row in study_rows if not row.current)
    if outdated:
        counts = ", ".join(f"{count} of {name}" for name, count in outdated.items())
        notes.append(f"rows of methods changed since their run do not count until they are run again: {counts}")
    return [row for row in study_rows if row.current], notes


def _check_folder(out: Path, studies: Sequence[str | Path]) -> None:
    """Raise UsageError if a study cannot be written into the folder `out`.

    The folder must not be a file or contain one of the study files `studies`, rows of an old format, or a summary or
    report that no study wrote.
    """
    require(not out.is_file(), f"{out} is a file; give a folder for the study's rows (--out)", UsageError)
    files.check_not_input([out, *(out / name for name in OURS)], studies)
    check_format(out)
    foreign = [name for name in (SUMMARY, REPORT) if (out / name).exists()]
    if foreign and not (out / ROWS).exists():
        raise UsageError(f"{out} contains {', '.join(foreign)}, not written by a study; choose another folder (--out)")


def study_lines() -> list[str]:
    """Return one line on each shipped study: name and description."""
    return [f"{name:16} {read_study([path]).about}" for name, path in shipped().items()]
