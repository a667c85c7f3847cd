"""The tables of `README.md`, made from the rows and the tables of recordings in this folder.

    calib study 'MCS-*' --out examples/survey/rows        # runs what is missing; more runs: --runs 300
    python examples/survey/tables.py --readme             # writes the tables into the README; without: prints them

Both go on from what is there.
"""

from __future__ import annotations

import argparse
import csv
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from calib.apps.studies.conditions import Condition, read_study
from calib.apps.studies.store import read_rows
from calib.apps.studies.summary import ConditionSummary, MethodSummary, summarise
from calib.apps.studies.trial import TrialRow
from calib.identification.registry import METHODS

HERE = Path(__file__).parent
STUDIES = ("MCS-*", "unfiltered", "wrong-beliefs", "designed", "low-rate", "controller")
# conditions of which all figures of merit are printed
MERIT_CONDITIONS = ("MCS-TX40-1-1", "MCS-TX40-4-2", "MCS-RV2SQ-1-2")
# conditions of the coverage table, without "MCS-"
COVERAGE_CONDITIONS = ("TX40-1-1", "TX40-1-2", "TX40-1-3", "TX40-4-1", "TX40-4-2", "RV2SQ-1-1", "RV2SQ-1-2")
# columns of the merit table behind method, runs and failures: heading and figure of merit
MERIT_COLUMNS = {
    "torque [%]": "torque_error",
    "β [%]": "beta_error",
    "in σ": "beta_sigma",
    "covered [%]": "coverage",
    "d_τ [%]": "survey_tau",
    "d_q [%]": "survey_q",
    "iterations": "iterations",
    "simulations": "simulations",
    "CPU [s]": "cpu",
}
# columns of the cost table: heading, robot and decimation factor
COST_COLUMNS = {"RV2SQ": ("rv2sq", 1), "TX40": ("tx40", 1), "TX40, decimated": ("tx40", 4)}
# largest number of conditions in one torque table
MAX_COLUMNS = 5


def number(value: float) -> str:
    """Return a number with three digits; a dash for NaN."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞"
    if value < 1e4:
        return f"{value:.3g}"
    return f"{value:.0e}"


def table_line(cells: Iterable[str]) -> str:
    """Return the cells as a line of a Markdown table."""
    return f"| {' | '.join(cells)} |"


def header_rule(columns: int) -> str:
    """Return the line below a heading: one column of words, then columns of numbers."""
    return f"|---|{'---:|' * columns}"


def short_name(condition: Condition) -> str:
    return condition.name.removeprefix("MCS-")


def condition_heading(summaries: Iterable[ConditionSummary]) -> str:
    """Return the heading of a table with a column per condition."""
    names = [short_name(summary.condition) for summary in summaries]
    return table_line(["method", *names])


def count_range(counts: Sequence[int]) -> str:
    """Return the smallest and the largest count, as one number where they are equal."""
    low, high = min(counts), max(counts)
    if low == high:
        return str(low)
    return f"{low}–{high}"


def method_named(summary: ConditionSummary, name: str) -> MethodSummary | None:
    """Return the summary of one method on a condition; None for a method without rows."""
    for method in summary.methods:
        if method.method == name:
            return method
    return None


def median_figure(summary: ConditionSummary, name: str, figure: str) -> str:
    """Return the median of a method's figure of merit on a condition; empty for a method without rows."""
    method = method_named(summary, name)
    if method is None:
        return ""
    return number(method.figures[figure].median)


def torque_table(summaries: Sequence[ConditionSummary]) -> Iterator[str]:
    """Yield a table of median torque errors [%]: a line per method, a column per condition; the one to take in bold."""
    # each name once, in the order of the conditions
    names: dict[str, None] = {}
    for summary in summaries:
        for method in summary.methods:
            names[method.method] = None
    yield condition_heading(summaries)
    yield header_rule(len(summaries))
    for name in names:
        yield table_line([name, *(_torque_cell(summary, name) for summary in summaries)])
    yield table_line(["runs", *map(_run_count, summaries)])


def _torque_cell(summary: ConditionSummary, name: str) -> str:
    """Return the median torque error [%] of a method, with its failures and its mark of the rule."""
    method = method_named(summary, name)
    if method is None:
        return ""
    text = number(method.figures["torque_error"].median)
    failures = sum(method.failures.values())
    if failures:
        text += f" ({failures}/{method.trials} failed)"
    if not method.enough:
        return f"{text} (n = {method.trials})"
    return marked(text, chosen=method.chosen, as_good=method.as_good)


def marked(text: str, *, chosen: bool, as_good: bool) -> str:
    """Return the text in bold for the method to take, with a dot for one that is as good as the best."""
    if chosen:
        return f"**{text}**"
    if as_good:
        return f"{text} ·"
    return text


def _run_count(summary: ConditionSummary) -> str:
    if not summary.methods:
        return "0"
    return count_range([method.trials for method in summary.methods])


def merit_table(summary: ConditionSummary) -> Iterator[str]:
    """Yield a table of all figures of one condition, one line per method."""
    yield table_line(["method", "runs", "failed", *MERIT_COLUMNS])
    yield header_rule(2 + len(MERIT_COLUMNS))
    for method in summary.methods:
        failures = sum(method.failures.values())
        figures = [number(method.figures[figure].median) for figure in MERIT_COLUMNS.values()]
        yield table_line([method.method, str(method.trials), str(failures), *figures])


def coverage_table(summaries: Sequence[ConditionSummary], names: Sequence[str]) -> Iterator[str]:
    """Yield the share [%] of parameters within the stated 95 % interval, median over runs: a column per condition.

    Args:
        summaries: summaries of the conditions.
        names: conditions of the columns, without "MCS-".
    """
    by_name = {short_name(summary.condition): summary for summary in summaries}
    columns = [by_name[name] for name in names if name in by_name]
    yield condition_heading(columns)
    yield header_rule(len(columns))
    for method in METHODS:
        cells = [median_figure(summary, method, "coverage") for summary in columns]
        if any(cells):
            yield table_line([method, *cells])


def motion_table(random: Sequence[ConditionSummary], designed: Sequence[ConditionSummary]) -> Iterator[str]:
    """Yield median torque and parameter errors [%] on random and on designed motions, for conditions that have both."""
    pairs = []
    for summary in designed:
        partners = [partner for partner in random if _differ_by_motion(summary.condition, partner.condition)]
        if summary.methods and partners:
            pairs.append((partners[0], summary))
    header = ["random → designed [%]"]
    for partner, _ in pairs:
        name = short_name(partner.condition)
        header += [f"torque, {name}", f"β, {name}"]
    yield table_line(header)
    yield header_rule(len(header) - 1)
    for method in METHODS:
        cells = []
        for pair in pairs:
            cells.append(_both_motions(pair, method, "torque_error"))
            cells.append(_both_motions(pair, method, "beta_error"))
        if any(cells):
            yield table_line([method, *cells])


def _differ_by_motion(designed: Condition, random: Condition) -> bool:
    """Return whether two conditions are equal but for motion, guesses and name."""
    return random == replace(designed, motion=random.motion, guesses=random.guesses, name=random.name)


def _both_motions(pair: tuple[ConditionSummary, ConditionSummary], method: str, figure: str) -> str:
    """Return a method's figure on random and on designed motion; empty if it has no rows on one of them."""
    random_summary, designed_summary = pair
    random = median_figure(random_summary, method, figure)
    designed = median_figure(designed_summary, method, figure)
    if random and designed:
        return f"{random} → {designed}"
    return ""


def cost_table(rows: Iterable[TrialRow]) -> Iterator[str]:
    """Yield mean processor time per trial of each method; runs and failures over the 15 conditions."""
    digests = [condition.digest for condition in read_study(["MCS-*"]).conditions]
    by_method: dict[str, list[TrialRow]] = {name: [] for name in METHODS}
    for row in rows:
        if row.digest in digests and row.current and row.method in by_method:
            by_method[row.method].append(row)
    yield table_line(["method", "runs", "without an estimate", *(f"{name} [CPU s]" for name in COST_COLUMNS)])
    yield header_rule(2 + len(COST_COLUMNS))
    # seconds of one trial by all methods together
    totals = dict.fromkeys(COST_COLUMNS, 0.0)
    for name, method_rows in by_method.items():
        counts = dict.fromkeys(digests, 0)
        failures = 0
        for row in method_rows:
            counts[row.digest] += 1
            failures += not row.found
        cells = [name, count_range([*counts.values()]), f"{failures} of {len(method_rows)}"]
        for column, (robot, factor) in COST_COLUMNS.items():
            mean = _mean_time(method_rows, robot, factor)
            totals[column] += mean
            cells.append(time_cell(mean))
        yield table_line(cells)
    minutes = [number(100 * seconds / 60) for seconds in totals.values()]
    yield f"| all, 100 runs each [CPU min] | | | {' | '.join(minutes)} |"


def time_cell(seconds: float) -> str:
    """Return a time; empty for NaN."""
    if math.isnan(seconds):
        return ""
    return number(seconds)


def _mean_time(rows: Iterable[TrialRow], robot: str, factor: int) -> float:
    """Return the mean processor time [s] of the rows of a robot and a decimation factor; NaN without a time."""
    selected = [row.cpu for row in rows if row.robot == robot and row.decimation == factor]
    times = [seconds for seconds in selected if not math.isnan(seconds)]
    if not times:
        return math.nan
    return sum(times) / len(times)


def recordings_table(folder: Path) -> Iterator[str]:
    """Yield errors on unseen motion [%] of each method on real recordings, with its seconds; bold: the one to take.

    Args:
        folder: tables of `recordings.py`, one per robot.
    """
    # robot -> method -> row of the robot's table
    robots: dict[str, dict[str, dict[str, str]]] = {}
    for path in sorted(folder.glob("*.csv")):
        reader = csv.DictReader(path.read_text().splitlines())
        robots[path.stem] = {row["method"]: row for row in reader}
    yield table_line(["method", *robots])
    yield header_rule(len(robots))
    for method in METHODS:
        cells = [_recording_cell(by_method.get(method)) for by_method in robots.values()]
        if any(cells):
            yield table_line([method, *cells])


def _recording_cell(row: dict[str, str] | None) -> str:
    """Return the error on unseen motion [%] with its σ and seconds; empty for a method without a row."""
    # methods that simulate the closed loop do not run on these recordings
    if row is None or "[loop]" in row["failure"]:
        return ""
    if row["failure"]:
        return "no estimate"
    error, sigma, seconds = float(row["unseen_percent"]), float(row["sigma"]), float(row["seconds"])
    text = marked(f"{error:.3g} ± {sigma:.2g}", chosen=row["take"] == "yes", as_good=row["as_good"] == "yes")
    return f"{text} ({seconds:.2g} s)"


def sections(rows: Sequence[TrialRow], recordings: Path) -> dict[str, list[str]]:
    """Return the lines of each table, by the name of its place in the README.

    Args:
        rows: rows of the studies.
        recordings: folder of the tables of `recordings.py`.
    """
    tables: dict[str, list[str]] = {}
    survey: list[ConditionSummary] = []
    for name in STUDIES:
        summaries = [summary for summary in summarise(read_study([name]), rows) if summary.methods]
        lines: list[str] = []
        for first in range(0, len(summaries), MAX_COLUMNS):
            lines += torque_table(summaries[first : first + MAX_COLUMNS])
            lines.append("")
        tables[name.removesuffix("-*")] = lines
        if name == "MCS-*":
            survey = summaries
            tables["coverage"] = list(coverage_table(survey, COVERAGE_CONDITIONS))
            tables["merit"] = _merit_lines(survey)
        if name == "designed":
            lines += motion_table(survey, summaries)
    tables["cost"] = list(cost_table(rows))
    tables["recordings"] = list(recordings_table(recordings))
    return tables


def _merit_lines(summaries: Iterable[ConditionSummary]) -> list[str]:
    lines: list[str] = []
    for summary in summaries:
        if summary.condition.name in MERIT_CONDITIONS:
            lines += [f"{summary.condition.name}:", "", *merit_table(summary), ""]
    return lines


def with_tables(text: str, tables: dict[str, list[str]]) -> str:
    """Return the README with each table in its place, between <!-- NAME --> and <!-- end -->."""
    for name, lines in tables.items():
        start, end = f"<!-- {name} -->", "<!-- end -->"
        places = re.findall(f"{start}.*?{end}", text, flags=re.DOTALL)
        if len(places) != 1:
            raise SystemExit(f"README.md has {len(places)} places for the table '{name}', {start} … {end}")
        text = text.replace(places[0], "\n".join([start, *lines, end]))
    return text


def print_merits(rows: Sequence[TrialRow], name: str) -> None:
    """Print all figures of merit of one condition."""
    for study in STUDIES:
        for summary in summarise(read_study([study]), rows):
            if summary.condition.name == name:
                print("\n".join(merit_table(summary)))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rows", type=Path, default=HERE / "rows")
    parser.add_argument("--full", default="", help="all figures of this condition")
    parser.add_argument("--readme", action="store_true", help="write the tables into README.md")
    arguments = parser.parse_args()
    rows = read_rows(arguments.rows)
    if arguments.full:
        print_merits(rows, arguments.full)
        return
    tables = sections(rows, HERE / "recordings")
    if arguments.readme:
        readme = HERE / "README.md"
        readme.write_text(with_tables(readme.read_text(), tables))
        return
    for name, lines in tables.items():
        print("\n".join([f"## {name}", "", *lines, ""]))


if __name__ == "__main__":
    main()
