"""The study's tables in Markdown, from the parts' metrics; README holds them between marks of the same names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

Tables = dict[str, str]
_BLOCK = r"(<!-- table {name} -->\n\n).*?(\n\n<!-- end -->)"


def table(head: str, rows: Iterable[Sequence[Any]]) -> str:
    """Return a Markdown table; the head's columns are parted by bars."""
    lines = [f"| {head} |", "|" + "---|" * (head.count("|") + 1)]
    return "\n".join([*lines, *("| " + " | ".join(str(cell) for cell in row) + " |" for row in rows)])


def show(tables: Tables) -> None:
    """Print tables."""
    print("\n\n".join(f"{name}\n\n{text}" for name, text in tables.items()))


def excitation(found: dict[str, Any]) -> Tables:
    """Return eq. 24 as designed by the estimate and by the truth, and RSDs against the baselines' speed."""
    middle = lambda x, form: f"{x[0]:{form}} ({x[1]:{form}}–{x[2]:{form}})"  # noqa: E731
    rows, off = found["compared"], found["estimate_off_percent"]
    designs = [
        (
            name, middle(row["cond"]["102"]["raw"], ".0f"), middle(row["cond"]["44"]["raw"], ".1f"),
            f"{row['cond']['44']['normalised'][0]:.1f}", f"{row['share'][5]:.2f}, {row['share'][6]:.2f}",
            middle(row["peak"], ".2f"),
        )
        for name, row in rows.items()
    ]  # fmt: skip
    told = [
        (
            name, f"{whole['median_rsd'][0]:.3f}", f"{whole['median_rsd_wrist'][0]:.3f}", middle(whole["ratio"], ".2f"),
            f"{whole['error_in_sigma'][0]:.2f}", f"{whole['size_ratio'][0]:.2f}, {whole['separation_ratio'][0]:.2f}",
            f"{alone['median_rsd'][0]:.3f}", middle(alone["ratio"], ".2f"), f"{alone['error_in_sigma'][0]:.1f}",
        )
        for name, row in rows.items() if "102 fitted" in row
        for whole, alone in [(row["102 fitted"], row["44 fitted"])]
    ]  # fmt: skip
    places = [
        (name, f"{row['median_rsd']:.3f}", f"{row['median_error']:.3f}", f"{row['error_in_sigma']:.2f}")
        for name, row in found["geometries"].items()
    ]
    return {
        "excitation-estimate": table(
            "estimate designed with | off by [%]", [("median of the 44", f"{off['median']:.2f}"), ("most", f"{off['largest']:.0f}")]
        ),
        "excitation-designs": table(
            "motion | cond of 102 | cond of 44 | normalised | mean share τ6, τ7 | largest torque / limit", designs
        ),
        "excitation-rsd": table(
            "motion | RSD [%] | wrist [%] | over B's | error [σ] | size, separation / B's | 44 alone: RSD [%] | over B's "
            "| error [σ]",
            told,
        ),
        "excitation-geometry": table("geometry, motion | RSD [%] | error [%] | error [σ]", places),
    }
