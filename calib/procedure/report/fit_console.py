"""What a fit says on the console: tables and sentences for rich to print; nothing is printed here."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.console import RenderableType
from rich.markup import escape
from rich.table import Table

from calib.procedure.kinematic_stage import iso9283
from calib.procedure.kinematic_stage.fit import Outcome
from calib.procedure.kinematic_stage.inputs import Inputs
from calib.procedure.kinematic_stage.validation import Comparison

COLOURS = {"pass": "green", "marginal": "yellow", "fail": "red"}
KINDS = {
    "position_mm": "position [mm]",
    "orientation_deg": "orientation [deg]",
    "distance_mm": "distance [mm]",
    "pair": "pairs' distance [mm]",
}
ARMS = {"nominal": "nominal", "calibrated": "calibrated", "urdf_alone": "URDF alone"}
MANY = 8  # how many outliers or merged parameters are listed


def read_lines(inputs: Inputs) -> Iterator[RenderableType]:
    """Say what was read."""
    chain = inputs.chain
    yield f"robot [bold]{escape(chain.name)}[/]: {chain.n} joints, {escape(chain.base)} to {escape(chain.tip)}"
    for block in inputs.fit:
        tools = f", {len(block.tool_names)} targets" if len(block.tool_names) > 1 else ""
        ignored = f"; ignored: {', '.join(block.ignored)}" if block.ignored else ""
        sigma = "stated" if block.sigma is not None else "estimated"
        yield escape(f"{Path(block.file).name}: {len(block)} rows of kind {block.kind}{tools}, sigmas {sigma}{ignored}")
    for name, unseen in inputs.unseen.items():
        role = "held out" if unseen.held_out else "validation"
        yield escape(f"{name}: {len(unseen.block)} rows of kind {unseen.block.kind} unseen ({role})")


def outcome_lines(outcome: Outcome) -> Iterator[RenderableType]:
    """Say what came of a fit."""
    yield ladder_table(outcome)
    yield error_table(outcome)
    for name, found in (("fitted", outcome.fit), *outcome.validation.items()):
        if found.repeated:
            yield escape(f"{name}: {iso9283.sentence(found.repeated)}")
    for line in outcome.unclear:
        yield f"[yellow]identifiability[/]: {escape(line)}"
    for line in outcome.warnings:
        yield f"[yellow]note[/]: {escape(line)}"
    if outcome.outliers:
        count = len({(each.file, each.row) for each in outcome.outliers})
        worst = "; ".join(each.words for each in outcome.outliers[:MANY])
        more = "; ..." if len(outcome.outliers) > MANY else ""
        loss = outcome.climb.loss
        how = "kept in the fit" if loss == "none" else f"weighed down by the {loss} loss"
        yield f"[yellow]outliers[/]: {count} rows beyond 4 robust sigma, {how}: {escape(worst)}{more}"
    verdict = outcome.verdict
    yield f"verdict: [bold {COLOURS[verdict.level]}]{verdict.level}[/]: {escape(verdict.reason)}"


def ladder_table(outcome: Outcome) -> Table:
    """Return the rungs with their error on rows left out."""
    table = Table("model", title="ladder of models", title_justify="left")
    for name in ("parameters", "cross-validated rms [mm]"):
        table.add_column(escape(name), justify="right")
    table.add_column("")
    for rung in outcome.climb.rungs:
        style = "bold" if rung.kept else "dim"
        table.add_row(
            rung.model, str(rung.parameters), f"{1e3 * rung.cross_validated:.4f}", escape(rung.note), style=style
        )
    table.caption = f"chosen: {outcome.climb.chosen}"
    return table


def error_table(outcome: Outcome) -> Table:
    """Return nominal and calibrated errors, fitted and unseen."""
    table = Table("errors", "arm", title="nominal and calibrated arm", title_justify="left")
    for name in ("mean", "rms", "95 %", "max"):
        table.add_column(name, justify="right")
    _add(table, f"fitted: {outcome.fit.poses} poses", outcome.fit)
    for name, comparison in outcome.validation.items():
        seen = "unseen" if comparison.proves else "NOT unseen"
        _add(table, f"{seen}: {name}, {comparison.poses} poses", comparison)
    return table


def _add(table: Table, label: str, comparison: Comparison) -> None:
    """Add the rows of one set, under a line that names it."""
    found: dict[str, Any] = comparison.table()
    pairs = found.get("pair_distance_mm", {})
    table.add_row(f"[bold]{escape(label)}[/]")
    for kind, words in KINDS.items():
        for arm, words_of_arm in ARMS.items():
            numbers = pairs.get(arm) if kind == "pair" else found.get(arm, {}).get(kind)
            if numbers is not None:
                cells = [f"{numbers[key]:.4f}" for key in ("mean", "rms", "p95", "max")]
                table.add_row(f"  {escape(words)}" if arm == "nominal" else "", words_of_arm, *cells)
    table.add_section()
