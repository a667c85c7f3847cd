"""The tables of `README.md`, from the rows that are kept beside it.

    calib study 'MCS-*' --out examples/survey/rows        # runs what is missing; more runs: --runs 300
    python examples/survey/tables.py                      # prints the tables

Both go on from what is there.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from calib.studies.conditions import read_study
from calib.studies.store import read_rows
from calib.studies.summary import ConditionSummary, MethodSummary, summarise
from calib.studies.trial import TrialRow

HERE = Path(__file__).parent
STUDIES = ("MCS-*", "unfiltered", "wrong-beliefs")


def number(value: float) -> str:
    """Return three digits; a dash for nothing."""
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
    """Yield all figures of one condition, a line per method."""
    header = ("runs", "failed", "torque [%]", "β [%]", "in σ", "covered [%]", "d_τ [%]", "d_q [%]", "rounds", "sims")
    yield f"| method | {' | '.join(header)} | CPU [s] |"
    yield f"|---|{'---:|' * (len(header) + 1)}"
    for method in one.methods:
        yield f"| {' | '.join(_figures(method))} |"


def _figures(method: MethodSummary) -> list[str]:
    keys = ("torque_error", "beta_error", "beta_sigma", "coverage", "survey_tau", "survey_q")
    keys += ("iterations", "simulations", "cpu")
    failed = str(sum(method.failures.values()))
    return [method.method, str(method.trials), failed, *(number(method.figures[key].median) for key in keys)]


def pace(rows: Iterable[TrialRow]) -> Iterator[str]:
    """Yield mean processor time per trial of each method, and that of a condition with 100 runs of each."""
    spent: dict[str, list[float]] = {}
    for row in rows:
        if row.mismatch == "none" and not math.isnan(row.cpu):
            spent.setdefault(row.method, []).append(row.cpu)
    means = {name: sum(own) / len(own) for name, own in spent.items()}
    yield ", ".join(f"{name} {mean:.2g} s" for name, mean in sorted(means.items(), key=lambda item: item[1]))
    yield f"{len(means)} methods, 100 runs each, one condition: {100 * sum(means.values()) / 60:.0f} CPU min of methods"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rows", type=Path, default=HERE / "rows")
    parser.add_argument("--full", default="", help="all figures of this condition")
    given = parser.parse_args()
    rows = read_rows(given.rows)
    for name in STUDIES:
        conditions = summarise(read_study([name]), rows)
        if given.full:
            chosen = [one for one in conditions if one.condition.name == given.full]
            print("\n".join(line for one in chosen for line in merit_table(one)))
            continue
        for part in range(0, len(conditions), 5):
            print("\n".join([*torque_table(conditions[part : part + 5]), ""]))
    print("\n".join(pace(rows)))


if __name__ == "__main__":
    main()
