"""Methods compared on recordings, as a table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from calib.procedure.report.page import Block, Section, Table, Text
from calib.rooms.studies.reports.method_comparison import APART, SLACK, ComparedMethod

HEADER = (
    "", "method", "unseen [%]", "behind the best", "raw [%]", "training [%]", "worst joint", "parameters", "rounds",
    "simulations", "seconds", "",
)  # fmt: skip


def line(one: ComparedMethod) -> str:
    """Return what is known of a method before the others are done."""
    words = one.failure or f"{one.unseen:.3g} % on other motion, {one.seconds:.2g} s"
    return f"{one.name}: {words}"


def section(found: Sequence[ComparedMethod], notes: Sequence[str]) -> Section:
    """Return the table, what a user should know, and the verdict on the model of the method that the rule comes to."""
    own = next((one for one in found if one.verdict is not None), None)
    shown = (*_blocks(found), Text("", notes, "note"))
    if own is None or own.verdict is None:
        return Section("Methods", shown)
    return Section("Methods", shown, own.verdict.level, f"{own.name}: {own.verdict.reason}")


def _blocks(found: Sequence[ComparedMethod]) -> Iterator[Block]:
    """Yield the ranked table, and why methods are not in it."""
    good = [one for one in found if not one.failure]
    rows = [
        (
            str(one.rank), one.name, f"{one.unseen:.3g} ± {one.sigma:.2g}",
            "" if one.rank == 1 else f"{one.behind:.2g} ± {one.behind_sigma:.2g}", f"{one.raw:.3g}",
            f"{one.training:.3g}", f"{one.worst[0]}: {one.worst[1]:.3g} %", str(one.parameters), str(one.iterations),
            str(one.simulations), f"{one.seconds:.2g}", "take" if one.chosen else "as good" if one.good else "",
        )
        for one in good
    ]  # fmt: skip
    note = (
        "100 ‖τ - τ̂‖ / ‖τ‖ on unseen motion, in the identification band, ± its standard error over "
        f"blocks of time; as good: within {APART:g} standard errors of the difference, or {SLACK:.0%}, of the best"
    )
    strong = frozenset(k for k, one in enumerate(good) if one.chosen)
    if rows:
        yield Table("Methods", HEADER, rows, note, strong, (0, *range(2, len(HEADER) - 1)))
    lines = [line(one) for one in found if one.failure]
    if lines:
        yield Text("Without an estimate", lines, "no estimate")
