"""What an identification says on the console: tables and sentences for rich to print; nothing is printed here."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from rich.console import RenderableType
from rich.markup import escape
from rich.table import Table

from calib.identification.methods.least_squares import ASSUMES
from calib.identification.scores import Score
from calib.procedure.dynamic_stage import geometry_tables
from calib.procedure.dynamic_stage.identify import IdentificationOutcome
from calib.procedure.dynamic_stage.inputs import IdentificationInputs
from calib.procedure.dynamic_stage.loop_tables import loop_lines
from calib.procedure.dynamic_stage.tracking import tracking_lines
from calib.procedure.report.console import COLOURS


def read_lines(inputs: IdentificationInputs) -> Iterator[RenderableType]:
    """Say what was read."""
    chain = inputs.chain
    how = "calibrated" if inputs.robot.moved else "nominal geometry"
    yield f"robot [bold]{escape(chain.name)}[/]: {chain.n} joints, {escape(chain.base)} to {escape(chain.tip)}, {how}"
    for case in (*inputs.cases, *inputs.unseen):
        motion = case.motion
        role = "unseen" if any(case is other for other in inputs.unseen) else "to learn from"
        load = f", carrying {', '.join(case.carried)}" if case.carried else ""
        yield escape(
            f"{case.name.rstrip(':')}: {case.duration:.1f} s at {motion.rate:.4g} Hz, {motion.kind}{load}, {role}"
        )
    yield from (f"  {_plain(note)}" for note in inputs.notes)


def outcome_lines(outcome: IdentificationOutcome) -> Iterator[RenderableType]:
    """Say what came of it."""
    found = outcome.found
    if found.friction.steps:
        yield ladder_table(outcome)
    for one in found.ripples:
        waves = (f"{k}" if source == one.joint else f"{k} of joint {source + 1}" for source, k in one.waves)
        words = f"ripple at joint {one.joint + 1}, orders {', '.join(waves)} per turn: explains {100 * one.share:.0f} %"
        yield f"{words} of the fast residual's power on time blocks left out; not part of the covariance"
    raw, normalised = found.condition
    yield f"method {found.fitted.method}: takes for granted that {ASSUMES[found.fitted.method]}"
    base = found.base
    words = f"{found.dynamics.model.p} standard parameters: {len(base.without_effect)} without effect, "
    words += f"{len(base.regrouped)} regrouped, {base.b} base; {len(found.friction.terms)} of richer friction; "
    words += f"condition {raw:.0f}, with unit columns {normalised:.0f}"
    yield words
    if found.elimination is not None:
        yield from elimination_lines(outcome)
    yield from geometry_tables.lines(outcome)
    yield from (escape(line) for line in loop_lines(found.bias))
    yield error_table(outcome)
    yield from tracking_lines(outcome.tracking, outcome.inputs.chain)
    for line in outcome.warnings:
        yield f"[yellow]note[/]: {_plain(line)}"
    verdict = outcome.verdict
    yield f"verdict: [bold {COLOURS[verdict.level]}]{verdict.level}[/]: {escape(verdict.reason)}"


def _plain(note: str) -> str:
    """Return a note for rich to print; a cut that is open at its end has a colon of its own."""
    return escape(note.replace(":: ", ": "))


def elimination_lines(outcome: IdentificationOutcome) -> Iterator[str]:
    """Say which parameters the data do not tell, in the order they went."""
    gone = outcome.found.elimination
    if gone is None:
        return
    names = dict(zip(gone.base.estimate.names, outcome.found.names))
    steps = ", ".join(f"{names[step.name]} ({step.rsd:.0f} %)" for step in gone.steps)
    yield escape(f"{len(gone.kept)} essential parameters; left out, with their RSD: {steps or 'none'}")


def ladder_table(outcome: IdentificationOutcome) -> Table:
    """Return the rungs with their error on time left out."""
    table = Table("friction", title="ladder: relative error on unseen time blocks [%]", title_justify="left")
    for name in ("p", "total", *(f"{j + 1}" for j in range(outcome.inputs.chain.n))):
        table.add_column(name, justify="right")
    table.add_column("kept at joints")
    for rung in outcome.found.friction.steps:
        at = ", ".join(str(j + 1) for j in rung.kept_at)
        joints = [f"{x:.1f}" for x in rung.joints]
        table.add_row(rung.model, str(rung.parameters), f"{rung.cross_validated:.2f}", *joints, at or escape(rung.note))
    return table


def error_table(outcome: IdentificationOutcome) -> Table:
    """Return the errors of every file, raw and below the band."""
    table = Table("file", "samples", title="100 |tau - predicted| / |tau| [%]", title_justify="left")
    for name in ("total", *outcome.found.settings.torque_rows.numbered(outcome.inputs.chain.n)):
        table.add_column(name, justify="right")
    for role, scores in (("fitted", outcome.fit), ("unseen", outcome.validation)):
        for name, found in scores.items():
            label = "repeat" if name in outcome.repeated else role
            for row in _score_rows(found):
                table.add_row(f"{escape(name)} ({label})", *row)
    return table


def _score_rows(found: Score) -> Iterator[list[str]]:
    for words, part in (
        ("all, raw", found.raw), ("all, in band", found.filtered),
        ("moving", found.moving), ("standing", found.standing),
    ):  # fmt: skip
        yield [words, _percent(part.total), *(_percent(x) for x in part.joints)]
    yield ["torque above band", "", *(_percent(x) for x in found.above)]


def _percent(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "-"
