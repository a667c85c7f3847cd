"""The study's tables in Markdown, from the parts' metrics; README holds them between marks of the same names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

Tables = dict[str, str]
_BLOCK = re.compile(r"(<!-- table ([\w-]+) -->\n\n)(.*?)(\n\n<!-- end -->)", re.DOTALL)


def table(head: str, rows: Iterable[Sequence[Any]]) -> str:
    """Return a Markdown table; the columns of its head are separated by bars."""
    lines = [f"| {head} |", "|" + "---|" * (head.count("|") + 1)]
    return "\n".join([*lines, *("| " + " | ".join(str(cell) for cell in row) + " |" for row in rows)])


def show(tables: Tables) -> None:
    """Print tables."""
    print("\n\n".join(f"{name}\n\n{text}" for name, text in tables.items()))


def geometry(found: dict[str, Any]) -> Tables:
    """Return Table 3, its supplements, and the comparison of methods that choose poses."""
    three = found["table_3"]
    rows = {"paper, nominal": three["paper"]["nominal"]}
    rows |= {f"nominal: {name}": row for name, row in three["nominal"].items()}
    rows |= {"paper, calibrated": three["paper"]["calibrated"]}
    rows |= {name: row for name, row in three.items() if name.startswith("calibrated")}
    errors = [
        (name, *(f"{row[key]['mean']:{form}} / {row[key]['max']:{form}}"
                 for key, form in (("position_mm", ".2f"), ("orientation_deg", ".3f"))))
        for name, row in rows.items()
    ]  # fmt: skip
    two, leds = found["table_2"], found["base_leds"]
    beside = [
        (
            "cond of the 17 poses [m, rad]",
            f"{found['condition_number']['paper']:.2f}",
            f"{found['condition_number']['ours_m_rad']:.3f}",
        ),
        ("parameters within 2σ of Table 2, of 32", "", two["within_2_sigma"]),
        *(
            (f"the same, rigid truth, {how}", "", f"{count:.1f}")
            for how, count in two["within_2_sigma_rigid_truth"].items()
        ),
        ("eq. 11 against eq. 12, most [σ]", "", f"{found['eq_11_against_eq_12']['largest_difference_in_sigmas']:.0e}"),
        ("rigid arm, true error, tool measured [mm rms]", "", f"{leds['tool only']:.3f}"),
        ("rigid arm, true error, tool and base measured [mm rms]", "", f"{leds['tool and base']:.3f}"),
        ("worst of 200 random sets, cond", "", f"{found['random_sets']['worst']:.2f}"),
    ]
    tables = {
        "geometry-errors": table("mean / max | position [mm] | orientation [deg]", errors),
        "geometry-beside": table("| paper | here", beside),
    }
    if "selection" not in found:
        return tables
    number = lambda x: f"{x:.0f}" if x >= 100 else f"{x:.4f}" if x < 1 else f"{x:.3f}"  # noqa: E731
    methods = list(dict.fromkeys(row["method"] for row in found["selection"]))
    indices = list(dict.fromkeys(row["index"] for row in found["selection"]))
    by = {(row["index"], row["method"]): row for row in found["selection"]}
    most = found["ceiling"]
    return tables | {
        "geometry-selection": table(
            "index | best of 1000 random | " + " | ".join(methods),
            [
                (index, number(by[index, methods[0]]["best_of_1000_random"]),
                 *(f"{number(row['median'])} ({number(row['worst'])}, {number(row['best'])})"
                   for row in (by[index, method] for method in methods)))
                for index in indices
            ],
        ),
        "geometry-ceiling": table(
            "O1 of any 17 poses, at most | searches | share of its det^(1/p) reached",
            [(f"{most['O1']:.0f}", most["climbs"], f"{100 * most['best_share_of_det']:.1f} %")],
        ),
    }  # fmt: skip


def dynamics(found: dict[str, Any]) -> Tables:
    """Return the counts, the essential set beside Table 4, and Fig. 8 in numbers."""
    count, essential = found["counts"], found["essential"]
    paper = {"standard": 136, "without effect": 18, "regrouped": 16, "Model 2": 102}  # all that it prints, beside 44
    words = {"standard": "standard parameters", "Model 2": "base parameters, Model 2"}
    order = ["standard", "without effect", "regrouped", "Model 2", "Model 1", "Model 3", "one load case"]
    rows = [(words.get(key, key), paper.get(key, ""), count[key]) for key in (*order, "motor torque only", "tilted")]
    rows += [("essential", 44, essential["count"]), ("of these in Table 4", "", len(essential["both"]))]
    models = [
        (name, one["base"], *one["essential"].values(), f"{one['condition']:.0f}", f"{one['error_in_sigma']:.2f}")
        for name, one in found["models"].items()
    ]
    rules = list(next(iter(found["models"].values()))["essential"])
    joints = " | ".join(f"{j}" for j in range(1, 8))
    torque = [
        (f"{geometry}, {part}", *(f"{x:.3f}" for x in one["largest"]))
        for geometry, parts in found["computed_torque"].items() for part, one in parts.items()
    ]  # fmt: skip
    tracking = [(name, *(f"{x:.3f}" for x in row)) for name, row in found["tracking_mrad"].items()]
    other = [
        (name, f"{one['published']:.3f}", f"{one['here']:.3f}", f"{one['apart_percent']:.0f}")
        for name, one in found["published"].items()
    ]
    return {
        "dynamics-counts": table("| paper | here", rows),
        "dynamics-essential": table(
            "only in Table 4 | only here",
            [(" ".join(essential["only_table_4"]) or "none", " ".join(essential["only_here"]) or "none")],
        ),
        "dynamics-models": table(f"| base | {' | '.join(rules)} | cond, normalised | error [σ]", models),
        "dynamics-torque": table(f"largest error [N m] of joint | {joints}", torque),
        "dynamics-tracking": table(f"tracking, rms [mrad] of joint | {joints}", tracking),
        "dynamics-published": table("| another unit | here | apart [%]", other),
    }


def consistency(found: dict[str, Any]) -> Tables:
    """Return what a geometry costs (Fig. 7 in numbers), and the coverage of the intervals."""
    rows = [
        (name, f"{one['torque_error_percent']:.3f}", f"{one['torque_error_without_noise_percent']:.4f}",
         f"{one['bias_in_sigma']['rms']:.2f}", one["bias_in_sigma"]["beyond_2"])
        for name, one in found["geometries"].items()
    ]  # fmt: skip
    tables = {
        "consistency-geometries": table(
            "geometry | torque [%] | without noise in the data [%] | bias, rms [σ] | beyond 2σ", rows
        )
    }
    if not found["coverage"]:
        return tables
    cells = [_covered(one) for one in found["coverage"].values()]
    return tables | {
        "consistency-coverage": table(
            " | ".join(["", *found["coverage"]]), [(key, *(cell[key] for cell in cells)) for key in cells[0]]
        )
    }


def _covered(one: dict[str, Any]) -> dict[str, Any]:
    percent = lambda x: "" if x is None else f"{100 * x:.1f} %"  # noqa: E731
    every, over, same, size = (one[k] for k in ("pooled", "geometry_exceeds_torque", "unchanged", "rms_error_in_sigma"))
    count = one["parameters"]
    return {
        "calibrations": one["runs"],
        "pooled, with the geometry's part": percent(every["with"]),
        "pooled, without": percent(every["without"]),
        "parameters whose geometric part exceeds the torques'": " ".join(over["parameters"]) or "none",
        "of these, with / without": " / ".join(percent(over[k]) for k in ("with", "without"))
        if over["parameters"]
        else "",
        "parameters that propagation changes by less than 1 %": f"{len(same['parameters'])} of {count}",
        "rms error in sigmas, with / without": f"{size['with']:.3f} / {size['without']:.3f}",
    }


def planning(found: dict[str, Any]) -> Tables:
    """Return the plans of section 5, checked on the true robot."""
    rows = [
        (name, f"{one['seconds']:.3f}", f"{one['peak']:.1%}", f"{one['worst_peak']:.1%}", f"{one['beyond']:.1%}",
         f"{one['active']:.1%}")
        for name, one in found["summary"].items()
    ]  # fmt: skip
    return {
        "planning": table("planned on | s | true peak | worst | time beyond a limit | time at a limit", rows),
        "planning-shape": table(
            "shape of the path, 60 timings, over its time before | median | best",
            [("", f"{np.median(found['shaped']):.3f}", f"{min(found['shaped']):.3f}")],
        ),
    }


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
            f"{whole['error_in_sigma'][0]:.2f}", f"{whole['size_ratio']:.2f}, {whole['separation_ratio']:.2f}",
            f"{alone['median_rsd'][0]:.3f}", middle(alone["ratio"], ".2f"), f"{alone['error_in_sigma'][0]:.1f}",
        )
        for name, row in rows.items() if "102 fitted" in row
        for whole, alone in [(row["102 fitted"], row["44 fitted"])]
    ]  # fmt: skip
    front = [
        ("B, chosen" if one["designed"] else "front" if one["best"] else "dominated", f"{one['share']:.3f}",
         f"{one['cond']:.1f}")
        for one in sorted(found["motions"]["B, 44 columns"][0]["front"], key=lambda one: one["share"])
    ]  # fmt: skip
    places = [
        (name, f"{row['median_rsd']:.3f}", f"{row['median_error']:.3f}", f"{row['error_in_sigma']:.2f}")
        for name, row in found["geometries"].items()
    ]
    return {
        "excitation-estimate": table(
            "estimate designed with | off by [%]",
            [("median of the 44", f"{off['median']:.2f}"), ("most", f"{off['largest']:.0f}")],
        ),
        "excitation-designs": table(
            "motion | cond of 102 | cond of 44 | normalised | mean share τ6, τ7 | largest torque / limit", designs
        ),
        "excitation-front": table("motion | mean share τ6 | cond of 44", front),
        "excitation-rsd": table(
            "motion | RSD [%] | wrist [%] | over B's | error [σ] | size, separation / B's | 44 alone: RSD [%] "
            "| over B's | error [σ]",
            told,
        ),
        "excitation-geometry": table("geometry, motion | RSD [%] | error [%] | error [σ]", places),
    }


def excitation_peers(found: dict[str, Any]) -> Tables:
    """Return tables of the default search over seeds, and of all searches in equal processor time."""
    spread = lambda x, form: f"{np.median(x):{form}} ({min(x):{form}}–{max(x):{form}})"  # noqa: E731
    seeds, peers = dict[str, list[Any]](), dict[str, list[Any]]()
    for name, one in found.items():
        if " seed " in name:
            (seeds if name.startswith("default, ") else peers).setdefault(name.rpartition(", ")[0], []).append(one)
    default = [
        (
            name.removeprefix("default, "), len(runs),
            *(spread([run[key] for run in runs], form)
              for key, form in (("raw", ".1f"), ("normalised", ".2f"), ("seconds", ".0f"), ("seconds_close", ".0f"))),
        )
        for name, runs in seeds.items()
    ]  # fmt: skip
    instants = [t for t in (1, 3, 10, 30) if t <= found["seconds"]]
    compared = [
        (
            name, *(_both([_at(run["curve"], t) for run in runs], ".1f") for t in instants),
            *(_both([(run["reached"] or {}).get(key) for run in runs], form)
              for key, form in (("raw", ".1f"), ("normalised", ".2f"))),
        )
        for name, runs in peers.items()
    ]  # fmt: skip
    head = " | ".join(f"{t} s" for t in instants)
    return {
        "peers-seeds": table("T0 | seeds | raw | normalised | processor time [s] | within 5 % after [s]", default),
        "peers-searches": table(f"search | {head} | raw | normalised", compared),
    }


def _at(curve: list[list[float]], seconds: float) -> float | None:
    """Return √(raw · normalised) of the best motion after some seconds; None without a motion."""
    reached = [merit for when, merit in curve if when <= seconds]
    return float(np.exp(min(reached))) if reached else None


def _both(values: list[float | None], form: str) -> str:
    return " / ".join("–" if value is None else f"{value:{form}}" for value in values)


SHOW = {
    "geometry": geometry, "dynamics": dynamics, "consistency": consistency, "excitation": excitation,
    "planning": planning, "excitation_peers": excitation_peers,
}  # fmt: skip


def blocks(text: str) -> Tables:
    """Return the tables of a document, found between their marks."""
    return {found[2]: found[3] for found in _BLOCK.finditer(text)}


def renewed(text: str, tables: Tables) -> str:
    """Return the document with its tables replaced by these."""
    return _BLOCK.sub(lambda found: found[1] + tables.get(found[2], found[3]) + found[4], text)
