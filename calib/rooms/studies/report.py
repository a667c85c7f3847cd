"""The report of a study: tables, box plots, and the decision rule, as one HTML file; the same tables for a console.

``calib study``: what is missing is run, what is there is summed up, and a report says what to take.

rows.sqlite              every trial (`store`): more may be added by anyone, at any time
summary.csv              one line per condition and method: of every figure its median and, as lower and upper, its
                         quartiles, the nearest of the runs' own values
report.html              tables, box plots, the decision rule; one file
"""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib import files
from calib.errors import UsageError, require
from calib.procedure.report.charts import Chart, Panel, box, line, picture, text
from calib.procedure.report.page import Column, Picture, Pictures, Section, Table, Text, table
from calib.procedure.report.style import AFTER, BEFORE, MARK
from calib.rooms.studies import summary
from calib.rooms.studies.conditions import Condition, Study, read_study, shipped
from calib.rooms.studies.run import Progress, run, span
from calib.rooms.studies.store import LOCK, ROWS, check_format, opened, read_rows
from calib.rooms.studies.summary import (
    ALIKE,
    FIGURES,
    LEVEL,
    MIN_DATA_SETS,
    RELIABLE,
    SLACK,
    ConditionSummary,
    MethodSummary,
)
from calib.rooms.studies.trial import TrialRow
from calib.workers import workers

LINE = 0.21  # height of one method [in]


def boxes(one: ConditionSummary, rows: Sequence[TrialRow]) -> Picture:
    """Return the box plot of a condition."""
    layers: list = []
    every: list[float] = []
    for place, method in enumerate(one.methods):
        own = [row.torque_error for row in rows if row.method == method.method and np.isfinite(row.torque_error)]
        every += own
        colour = AFTER if method.as_good else BEFORE
        if len(own) < MIN_DATA_SETS:
            layers.append(line(own, [place] * len(own), "o", colour, size=4.0))
        else:
            layers.append(box(own, place, colour))
    low, high = 0.8 * max(min(every, default=0.1), 1e-6), 1.25 * max(max(every, default=1.0), 1.1e-6)
    for place, method in enumerate(one.methods):
        if failed := sum(method.failures.values()):
            layers.append(text(f"{failed} failed", high, place, (3, 0), MARK, along="center"))
    names = [method.method for method in one.methods]
    panel = Panel(layers, x="torque error [%]", xlim=(low, high), log="x", ynames=names, grid="x")
    words = (
        "Torque error on unseen motion, noise-free: boxes from quartile to quartile with the median, lines to the 5th "
        f"and 95th percentile, points beyond; fewer than {MIN_DATA_SETS} as points. Dark: as good as the best. Trials "
        "without an estimate are counted at the right."
    )
    return picture(Chart([panel], 0.75 + LINE * len(names)), words)


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


def _short(value: float) -> str:
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞"
    return f"{value:.3g}" if abs(value) < 1e5 else f"{value:.1e}"


def _median(header: str, figure: str) -> Column:
    return Column(header, lambda one: _short(one.figures[figure].median))


def _mark(one: MethodSummary) -> str:
    return "take" if one.chosen else "as good" if one.as_good else "" if one.enough else "few runs"


COLUMNS = (
    Column("method", "{0.method}", number=False),
    Column("trials", "{0.trials}"),
    Column("failed", lambda one: ", ".join(f"{count} {status}" for status, count in one.failures.items()) or "0"),
    _median("torque [%]", "torque_error"),
    Column("quartiles", lambda one: "–".join(map(_short, one.figures["torque_error"][1:]))),
    _median("worst joint [%]", "torque_worst"),
    _median("β [%]", "beta_error"),
    _median("in σ", "beta_sigma"),
    _median("covered [%]", "coverage"),
    _median("d_τ [%]", "survey_tau"),
    _median("d_q [%]", "survey_q"),
    _median("rounds", "iterations"),
    _median("simulations", "simulations"),
    _median("CPU [s]", "cpu"),
    Column("p", lambda one: _short(one.p)),
    Column("", _mark, number=False),
)
ON_CONSOLE = ("method", "trials", "failed", "torque [%]", "quartiles", "covered [%]", "CPU [s]", "")


def overview(conditions: Sequence[ConditionSummary]) -> Table:
    """Return a table of the recommended method of each condition."""
    lines = []
    for one in conditions:
        if not one.methods:
            lines.append((one.condition.name, _described(one.condition), "no rows yet", "", "", "", ""))
            continue
        best, chosen = one.best, one.chosen
        failed = ", ".join(f"{m.method} {sum(m.failures.values())}/{m.trials}" for m in one.methods if m.failures)
        lines.append(
            (
                one.condition.name,
                _described(one.condition),
                chosen.method if chosen else "none",
                _short(chosen.figures["torque_error"].median) if chosen else "",
                f"{best.method} {_short(best.figures['torque_error'].median)}" if best else "",
                ", ".join(m.method for m in one.methods if m.as_good and m is not chosen),
                failed,
            )
        )
    header = ("condition", "", "take", "torque [%]", "best [%]", "as good", "without an estimate")
    return Table("What to take", header, lines, numbers=(3,))


def torque_table(conditions: Sequence[ConditionSummary]) -> Table:
    """Return a table of the median torque error of every method on every condition."""
    names = list(dict.fromkeys(method.method for one in conditions for method in one.methods))
    lines = []
    for one in conditions:
        own = {method.method: method for method in one.methods}
        lines.append((one.condition.name, *(_median_cell(own.get(name)) for name in names)))
    note = (
        f"Median over trials [%]; a trial without an estimate counts as ∞. *: recommended; (n): n runs, fewer than "
        f"{MIN_DATA_SETS} runs."
    )
    return Table("Torque error on unseen motion", ("condition", *names), lines, note, numbers=range(1, len(names) + 1))


def _median_cell(one: MethodSummary | None) -> str:
    if one is None:
        return ""
    return _short(one.figures["torque_error"].median) + (
        "*" if one.chosen else "" if one.enough else f" ({one.trials})"
    )


def reasons(conditions: Sequence[ConditionSummary]) -> list[str]:
    """Return sentences that say why conditions have no recommended method."""
    found: dict[str, list[str]] = {}
    for one in conditions:
        if why := one.why_none:
            found.setdefault(why, []).append(one.condition.name)
    return [
        f"no method recommended for {'all' if 1 < len(names) == len(conditions) else ', '.join(names)}: {why}"
        for why, names in found.items()
    ]


def _described(one: Condition) -> str:
    """Return a condition as one line: robot, motion, rate, noise, decimation, cutoff, mismatch, guesses."""
    filtered = f"{one.cutoff:g} Hz" if one.cutoff else "unfiltered"
    wrong = "" if one.mismatch == "none" else f", {one.mismatch}"
    wrong += f", {one.guesses} guesses" if one.guesses > 1 else ""
    what = one.robot + (f" {one.motion}" if one.motion != "random" else "") + (f" {one.rate:g} Hz" if one.rate else "")
    degrees = math.degrees(one.sigma_q)
    return f"{what}, {degrees:.3g}°, {one.sigma_tau:g} N·m, r = {one.decimation}, {filtered}{wrong}"


def condition_table(one: ConditionSummary, names: Sequence[str] = ON_CONSOLE) -> Table:
    """Return a table of all methods on a condition, best first; by default with the columns for a terminal."""
    columns = [column for column in COLUMNS if column.name in names]
    title = f"Methods on {one.condition.name}"
    return table(title, columns, one.methods, _described(one.condition), lambda method: method.chosen)


def failures(one: ConditionSummary) -> list[Text]:
    """Return the failures of each method on a condition: kind, number, and first message; empty without any."""
    said = [
        f"{method.method}: {count} {status}, e.g. {method.examples[status]}"
        for method in sorted(one.methods, key=lambda method: method.method)
        for status, count in method.failures.items()
    ]
    return [Text("Without an estimate", said)] if said else []


def summary_table(conditions: Sequence[ConditionSummary]) -> tuple[list[str], list[list[object]]]:
    """Return header and rows of ``summary.csv``."""
    header = ["condition", "method", "trials", "failed", "rank", "as_good", "take", "p"]
    header += [f"{name}_{part}" for name in FIGURES for part in ("median", "lower", "upper")]
    lines: list[list[object]] = []
    for one in conditions:
        for method in one.methods:
            flags = ["yes" if flag else "no" for flag in (method.as_good, method.chosen)]
            head = [one.condition.name, method.method, method.trials, sum(method.failures.values()), method.rank]
            spreads = [value for name in FIGURES for value in method.figures[name]]
            lines.append([*head, *flags, method.p, *spreads])
    return header, lines


def make_page(
    study: Study,
    conditions: Sequence[ConditionSummary],
    rows: Sequence[TrialRow],
    notes: Sequence[str],
    plots: bool = True,
) -> str:
    """Return the report of a study as HTML.

    Args:
        rows: of these conditions.
        plots: with box plots.
    """
    from calib.procedure.report.templates import filled, issued

    head = [overview(conditions), *([torque_table(conditions)] if len(conditions) > 1 else [])]
    sections = [Section("", [*head, Text("How that was decided", RULE), Text("Figures", MEANING)])]
    for one in conditions:
        if not one.methods:
            continue
        own = [row for row in rows if row.digest == one.condition.digest]
        blocks = [condition_table(one, [column.name for column in COLUMNS])]
        drawn = [Pictures("", [boxes(one, own)])] if plots else []
        blocks = [*blocks, *drawn, *failures(one)]
        sections.append(Section(one.condition.name, blocks))
    return filled(
        "calib.rooms.studies",
        "study.html",
        title=study.name,
        about=study.about,
        sections=sections,
        notes=notes,
        issued=f"{issued()}, {len(rows)} trials",
    )


SUMMARY, REPORT = "summary.csv", "report.html"
OURS = (ROWS, LOCK, SUMMARY, REPORT)


@dataclass(frozen=True)
class StudyOutcome:
    """Result of a study.

    Attributes:
        conditions: what the rows say, condition by condition.
        progress: of this command.
        notes: what a user should know.
        folder: where all of it is.
        rows: which file holds how many rows, in words; "" where nothing was run.
    """

    conditions: tuple[ConditionSummary, ...]
    progress: Progress
    notes: tuple[str, ...]
    folder: Path
    rows: str = ""

    def described(self) -> list[str]:
        """Return the closing message of a command."""
        done = self.progress
        lines = [f"note: {note}" for note in self.notes]
        if done.wanted:
            lines += [f"{done} in {span(done.seconds)}", *done.pace.lines()]
        return [*lines, self.rows] if self.rows else lines


def run_study(
    named: Sequence[str | Path],
    out: Path,
    *,
    methods: Sequence[str] | None = None,
    runs: int | None = None,
    where: str | int | None = None,
    report_only: bool = False,
    plots: bool = True,
    say: Callable[[str], None] = lambda words: None,
) -> StudyOutcome:
    """Run the missing trials of a study, and write its report.

    Args:
        named: study files, names of shipped ones, patterns of these.
        out: the folder of its rows; those that are there count.
        methods, runs: in place of the files'.
        where: the tasks run, see `calib.workers.workers`.
        report_only: run nothing, and leave the rows as they are, also while another command adds to them.
        plots: whether the report has figures.
        say: called with words on progress.

    Raises:
        UsageError: for a file that is no study, a folder that another command works in, rows of another version.
        CalibError: where rows cannot be kept, or the workers are gone; what is kept is kept.
    """
    study = read_study(named, methods, runs)
    _check_folder(out, named)
    notes: list[str] = []
    progress, settled = Progress(0), ""
    if report_only:
        kept = read_rows(out)  # takes no lock: a study that runs there may be looked at
    else:
        with opened(out) as store:
            say(f"{len(store.rows)} rows are there")
            with workers(where) as crew:
                progress = run(study, store, crew, lambda found: say(str(found)))
            say("writing")
            kept = list(store.rows.values())
            settled = f"{ROWS} holds {len(kept)} rows"
    own, more = _counted(study, kept)
    notes += more
    if not progress.lost and not own:
        there = "; ".join([f"{len(kept)} rows" if kept else "no rows", *more])
        try_next = (
            "run the study first, or name its folder (--out)" if report_only else "ask for 1 run or more (--runs)"
        )
        raise UsageError(f"nothing to report: {out} holds {there}; {try_next}")
    if len(versions := sorted({row.toolkit for row in own})) > 1:
        notes.append(f"rows were made by several versions: {', '.join(versions)}")
    if progress.lost:
        notes.append(f"{progress.lost} trials were lost with their workers; run the same command again")
    conditions = tuple(summary.summarise(study, own))
    notes += reasons(conditions)
    files.write_table(out / SUMMARY, *summary_table(conditions))
    files.write(out / REPORT, make_page(study, conditions, own, notes, plots))
    return StudyOutcome(conditions, progress, tuple(notes), out, settled)


def _counted(study: Study, kept: Sequence[TrialRow]) -> tuple[list[TrialRow], list[str]]:
    """Return the rows that count for a study, and notes on those that do not."""
    digests = {condition.digest for condition in study.conditions}
    own = [row for row in kept if row.digest in digests]
    notes, changed = [], Counter(row.method for row in own if not row.current)
    if others := len(kept) - len(own):
        notes.append(f"{others} rows belong to conditions outside this study: kept, but not counted")
    if changed:
        named = ", ".join(f"{count} of {name}" for name, count in changed.items())
        notes.append(f"rows of methods changed since their run do not count until they are run again: {named}")
    return [row for row in own if row.current], notes


def _check_folder(out: Path, named: Sequence[str | Path]) -> None:
    """Raise if the output folder is a file, or contains files of these names that no study has written."""
    require(not out.is_file(), f"{out} is a file; give a folder for the study's rows (--out)", UsageError)
    files.check_not_input([out, *(out / name for name in OURS)], named)
    check_format(out)
    foreign = [name for name in (SUMMARY, REPORT) if (out / name).exists()]
    if foreign and not (out / ROWS).exists():
        raise UsageError(f"{out} contains {', '.join(foreign)}, not written by a study; choose another folder (--out)")


def study_lines() -> list[str]:
    """Return one line on each shipped study."""
    return [f"{name:16} {read_study([path]).about}" for name, path in shipped().items()]
