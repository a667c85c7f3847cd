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
MERITS = ("MCS-TX40-1-1", "MCS-TX40-4-2", "MCS-RV2SQ-1-2")  # conditions of which all figures are shown


def number(value: float) -> str:
    """Return a number with three digits; a dash for NaN."""
    if math.isnan(value):
        return "–"
    return "∞" if math.isinf(value) else f"{value:.3g}" if value < 1e4 else f"{value:.0e}"


def torque_table(conditions: Sequence[ConditionSummary]) -> Iterator[str]:
    """Yield a table of median torque errors [%]: a line per method, a column per condition; the one to take in bold."""
    names = list(dict.fromkeys(method.method for one in conditions for method in one.methods))
    short = [one.condition.name.removeprefix("MCS-") for one in conditions]
    yield f"| method | {' | '.join(short)} |"
    yield f"|---|{'---:|' * len(short)}"
    for name in names:
        yield f"| {name} | {' | '.join(_cell(one, name) for one in conditions)} |"
    yield f"| runs | {' | '.join(_runs(one) for one in conditions)} |"


def _cell(one: ConditionSummary, name: str) -> str:
    found = next((method for method in one.methods if method.method == name), None)
    if found is None:
        return ""
    failed = sum(found.failures.values())
    text = number(found.figures["torque_error"].median) + (f" ({failed}/{found.trials} failed)" if failed else "")
    if not found.enough:
        return f"{text} (n = {found.trials})"
    return f"**{text}**" if found.chosen else f"{text} ·" if found.as_good else text


def _runs(one: ConditionSummary) -> str:
    counts = sorted({method.trials for method in one.methods})
    return "–".join(map(str, dict.fromkeys((counts[0], counts[-1])))) if counts else "0"


def merit_table(one: ConditionSummary) -> Iterator[str]:
    """Yield a table of all figures of one condition, one line per method."""
    header = ("runs", "failed", "torque [%]", "β [%]", "in σ", "covered [%]", "d_τ [%]", "d_q [%]")
    header += ("iterations", "simulations")
    yield f"| method | {' | '.join(header)} | CPU [s] |"
    yield f"|---|{'---:|' * (len(header) + 1)}"
    for method in one.methods:
        yield f"| {' | '.join(_figures(method))} |"


def _figures(method: MethodSummary) -> list[str]:
    keys = ("torque_error", "beta_error", "beta_sigma", "coverage", "survey_tau", "survey_q")
    keys += ("iterations", "simulations", "cpu")
    failed = str(sum(method.failures.values()))
    return [method.method, str(method.trials), failed, *(number(method.figures[key].median) for key in keys)]


def coverage_table(conditions: Sequence[ConditionSummary], names: Sequence[str]) -> Iterator[str]:
    """Yield the share [%] of parameters within the stated 95 % interval, median over runs: a column per condition."""
    chosen = [one for name in names for one in conditions if one.condition.name == f"MCS-{name}"]
    yield f"| method | {' | '.join(names)} |"
    yield f"|---|{'---:|' * len(names)}"
    for name in METHODS:
        found = [next((method for method in one.methods if method.method == name), None) for one in chosen]
        cells = ["" if own is None else number(own.figures["coverage"].median) for own in found]
        if any(cells):
            yield f"| {name} | {' | '.join(cells)} |"


def motion_table(random: Sequence[ConditionSummary], designed: Sequence[ConditionSummary]) -> Iterator[str]:
    """Yield median torque and parameter errors [%] on random and on designed motions, for conditions that have both."""
    pairs = [(one, own) for own in designed for one in random if one.condition == _as_random(own, one) and own.methods]
    names = [f"{what}, {one.condition.name.removeprefix('MCS-')}" for one, _ in pairs for what in ("torque", "β")]
    yield f"| random → designed [%] | {' | '.join(names)} |"
    yield f"|---|{'---:|' * len(names)}"
    for name in METHODS:
        cells = []
        for pair in pairs:
            both = [method for one in pair for method in one.methods if method.method == name]
            medians = [[number(one.figures[key].median) for one in both] for key in ("torque_error", "beta_error")]
            cells += [" → ".join(own) if len(own) == 2 else "" for own in medians]
        if any(cells):
            yield f"| {name} | {' | '.join(cells)} |"


def _as_random(one: ConditionSummary, other: ConditionSummary) -> Condition:
    """Return a condition with motion, guesses and name of another."""
    theirs = other.condition
    return replace(one.condition, motion=theirs.motion, guesses=theirs.guesses, name=theirs.name)


GROUPS = {"RV2SQ": ("rv2sq", 1), "TX40": ("tx40", 1), "TX40, decimated": ("tx40", 4)}


def cost_table(rows: Iterable[TrialRow]) -> Iterator[str]:
    """Yield mean processor time per trial of each method; runs and failures over the 15 conditions."""
    digests = [one.digest for one in read_study(["MCS-*"]).conditions]
    own = [row for row in rows if row.digest in digests and row.current]
    yield f"| method | runs | without an estimate | {' | '.join(f'{name} [CPU s]' for name in GROUPS)} |"
    yield f"|---|{'---:|' * (2 + len(GROUPS))}"
    total = dict.fromkeys(GROUPS, 0.0)
    for name in METHODS:
        mine = [row for row in own if row.method == name]
        counts = [sum(row.digest == digest for row in mine) for digest in digests]
        failed, cells = sum(not row.found for row in mine), []
        for group, (robot, factor) in GROUPS.items():
            times = [row.cpu for row in mine if (row.robot, row.decimation) == (robot, factor) and row.cpu == row.cpu]
            total[group] += sum(times) / len(times) if times else float("nan")
            cells.append(number(sum(times) / len(times)) if times else "")
        span = "–".join(map(str, dict.fromkeys((min(counts), max(counts)))))
        yield f"| {name} | {span} | {failed} of {len(mine)} | {' | '.join(cells)} |"
    minutes = [number(100 * value / 60) for value in total.values()]
    yield f"| all, 100 runs each [CPU min] | | | {' | '.join(minutes)} |"


def recordings_table(folder: Path) -> Iterator[str]:
    """Yield errors on unseen motion [%] of each method on real recordings, with its seconds; bold: the one to take."""
    tables = {path.stem: list(csv.DictReader(path.read_text().splitlines())) for path in sorted(folder.glob("*.csv"))}
    yield f"| method | {' | '.join(tables)} |"
    yield f"|---|{'---:|' * len(tables)}"
    for name in METHODS:
        found = [next((row for row in own if row["method"] == name), None) for own in tables.values()]
        cells = ["" if row is None else _recorded(row) for row in found]
        if any(cells):
            yield f"| {name} | {' | '.join(cells)} |"


def _recorded(row: dict[str, str]) -> str:
    if row["failure"]:
        return "" if "[loop]" in row["failure"] else "no estimate"
    text = f"{float(row['unseen_percent']):.3g} ± {float(row['sigma']):.2g}"
    text = f"**{text}**" if row["take"] == "yes" else f"{text} ·" if row["as_good"] == "yes" else text
    return f"{text} ({float(row['seconds']):.2g} s)"


def sections(rows: Sequence[TrialRow], recordings: Path) -> dict[str, list[str]]:
    """Return the lines of each table, by the name of its place in the README."""
    made: dict[str, list[str]] = {}
    survey: list[ConditionSummary] = []
    for name in STUDIES:
        conditions = [one for one in summarise(read_study([name]), rows) if one.methods]
        lines = made.setdefault(name.removesuffix("-*"), [])
        for part in range(0, len(conditions), 5):
            lines += [*torque_table(conditions[part : part + 5]), ""]
        if name == "MCS-*":
            shown = ("TX40-1-1", "TX40-1-2", "TX40-1-3", "TX40-4-1", "TX40-4-2", "RV2SQ-1-1", "RV2SQ-1-2")
            made["coverage"] = list(coverage_table(conditions, shown))
            for one in conditions:
                if one.condition.name in MERITS:
                    made.setdefault("merit", []).extend([f"{one.condition.name}:", "", *merit_table(one), ""])
            survey = conditions
        if name == "designed":
            lines += motion_table(survey, conditions)
    made["cost"] = list(cost_table(rows))
    made["recordings"] = list(recordings_table(recordings))
    return made


def written(text: str, made: dict[str, list[str]]) -> str:
    """Return the README with each table in its place, between <!-- NAME --> and <!-- end -->."""
    for name, lines in made.items():
        block = "\n".join([f"<!-- {name} -->", *lines, "<!-- end -->"])
        text, count = re.subn(rf"<!-- {name} -->.*?<!-- end -->", lambda _, own=block: own, text, flags=re.DOTALL)
        if count != 1:
            raise SystemExit(f"README.md has {count} places for the table '{name}', <!-- {name} --> … <!-- end -->")
    return text


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rows", type=Path, default=HERE / "rows")
    parser.add_argument("--full", default="", help="all figures of this condition")
    parser.add_argument("--readme", action="store_true", help="write the tables into README.md")
    given = parser.parse_args()
    rows = read_rows(given.rows)
    if given.full:
        conditions = [one for name in STUDIES for one in summarise(read_study([name]), rows)]
        chosen = [one for one in conditions if one.condition.name == given.full]
        print("\n".join(line for one in chosen for line in merit_table(one)))
        return
    made = sections(rows, HERE / "recordings")
    if given.readme:
        readme = HERE / "README.md"
        readme.write_text(written(readme.read_text(), made))
        return
    for name, lines in made.items():
        print("\n".join([f"## {name}", "", *lines, ""]))


if __name__ == "__main__":
    main()
