"""``calib study``: what is missing is run, what is there is summed up, and a report says what to take.

rows.parquet, rows.csv   every trial (`store`): more may be added by anyone, at any time. While a command
                         runs its rows go to rows.csv, which is emptied into rows.parquet at the end
summary.csv              one line per condition and method: of every figure its median and, as lower and upper, its
                         quartiles, the nearest of the runs' own values
report.html              tables, box plots, the decision rule; one file
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from calib import files
from calib.errors import UsageError, require
from calib.rooms.studies import summary
from calib.rooms.studies.conditions import Study, read_study, shipped
from calib.rooms.studies.reports import report
from calib.rooms.studies.run import Progress, run, span
from calib.rooms.studies.store import JOURNAL, LOCK, WHOLE, opened, read_rows
from calib.rooms.studies.summary import ConditionSummary
from calib.workers import workers

SUMMARY, REPORT = "summary.csv", "report.html"
OURS = (JOURNAL, WHOLE, LOCK, SUMMARY, REPORT)


@dataclass(frozen=True)
class StudyOutcome:
    """What a study comes to.

    Attributes:
        study: what was asked.
        conditions: what the rows say, condition by condition.
        progress: of this command.
        notes: what a user should know.
        folder: where all of it is.
        rows: which file holds how many rows, in words; "" where nothing was run.
    """

    study: Study
    conditions: tuple[ConditionSummary, ...]
    progress: Progress
    notes: tuple[str, ...]
    folder: Path
    rows: str = ""

    def described(self) -> list[str]:
        """Return what a command says of itself at its end."""
        done = self.progress
        lines = [f"note: {note}" for note in self.notes]
        if done.wanted:
            lines.append(f"{done} in {span(done.seconds)}")
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
    """Run what a study lacks, and write its report.

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
            if store.dropped:
                notes.append(f"{store.dropped} half-written line was taken off: its trial is run again")
            say(f"{len(store.rows)} rows are there")
            with workers(where) as crew:
                progress = run(study, store, crew, lambda found: say(str(found)))
            say("writing")
            place = store.settle()
            kept = list(store.rows.values())
            settled = f"{place.name} holds {len(kept)} rows"
    digests = {condition.digest for condition in study.conditions}
    own = [row for row in kept if row.digest in digests]
    others, changed = len(kept) - len(own), Counter(row.method for row in own if not row.current)
    own = [row for row in own if row.current]
    if others:
        notes.append(f"{others} rows are of conditions that are not of this study: kept, and not counted")
    if changed:
        named_rows = ", ".join(f"{count} of {name}" for name, count in changed.items())
        words = "rows of methods that have changed since they ran do not count until they are run again"
        notes.append(f"{words}: {named_rows}")
    if not progress.lost and not own:
        told = f"{len(kept)} rows, none of them of this study's conditions" if kept else "no rows"
        told = f"{len(kept)} rows; {notes[-1]}" if changed else told
        raise UsageError(
            f"nothing to report: {out} holds {told}; "
            + ("run the study first, or name its folder (--out)" if report_only else "ask for runs (--runs, runs)")
        )
    if versions := sorted({row.toolkit for row in own}):
        notes += [f"rows were made by several versions: {', '.join(versions)}"] if len(versions) > 1 else []
    if progress.lost:
        notes.append(f"{progress.lost} trials were lost with their workers: the same command runs them again")
    conditions = tuple(summary.summarise(study, own))
    notes += report.reasons(conditions)
    header, lines = report.summary_table(conditions)
    files.write_table(out / SUMMARY, header, lines)
    page = report.make_page(study, conditions, own, notes, plots)
    files.write(out / REPORT, page)
    return StudyOutcome(study, conditions, progress, tuple(notes), out, settled)


def _check_folder(out: Path, named: Sequence[str | Path]) -> None:
    """Refuse, before any work is done, a folder that holds other files of these names, or a file."""
    require(not out.is_file(), f"{out} is a file; a study's rows go into a folder (--out)", UsageError)
    files.check_not_input([out, *(out / name for name in OURS)], named)
    foreign = [name for name in (SUMMARY, REPORT) if (out / name).exists()]
    if foreign and not any((out / name).exists() for name in (JOURNAL, WHOLE)):
        raise UsageError(f"{out} holds {', '.join(foreign)} which no study left there; choose another (--out)")


def study_lines() -> list[str]:
    """Return a line per shipped study."""
    return [f"{name:16} {read_study([path]).about}" for name, path in shipped().items()]
