"""The study's tables in Markdown, from the parts' metrics; README holds them between marks of the same names."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

# metrics of a part of the study, as they stand in its metrics.json
Metrics = dict[str, Any]
# name of a table to its Markdown
Tables = dict[str, str]

_BLOCK = re.compile(r"(<!-- table ([\w-]+) -->\n\n)(.*?)(\n\n<!-- end -->)", re.DOTALL)
# counts of parameters that the paper prints, besides the 44 essential ones
PAPER_COUNTS = {"standard": 136, "without effect": 18, "regrouped": 16, "Model 2": 102}
COUNT_LABELS = {"standard": "standard parameters", "Model 2": "base parameters, Model 2"}
COUNTS = (
    "standard",
    "without effect",
    "regrouped",
    "Model 2",
    "Model 1",
    "Model 3",
    "one load case",
    "motor torque only",
    "tilted",
)
JOINTS = " | ".join(str(joint) for joint in range(1, 8))
# processor times [s] at which the searches are compared
INSTANTS = (1, 3, 10, 30)


def table(head: str, rows: Iterable[Sequence[Any]]) -> str:
    """Return a Markdown table; the columns of its head are separated by bars."""
    lines = [f"| {head} |", "|" + "---|" * (head.count("|") + 1)]
    lines += [f"| {' | '.join(map(str, row))} |" for row in rows]
    return "\n".join(lines)


def show(tables: Tables) -> None:
    """Print tables."""
    print("\n\n".join(f"{name}\n\n{text}" for name, text in tables.items()))


def percent(share: float | None) -> str:
    """Return a share in percent; empty for None."""
    return "" if share is None else f"{100 * share:.1f} %"


def mean_and_max(errors: dict[str, float], form: str) -> str:
    return f"{errors['mean']:{form}} / {errors['max']:{form}}"


def with_range(spread: Sequence[float], form: str) -> str:
    """Return a median with the smallest and the largest value; they come in this order."""
    median, low, high = spread
    return f"{median:{form}} ({low:{form}}–{high:{form}})"


def geometry(metrics: Metrics) -> Tables:
    """Return Table 3, its supplements, and the comparison of methods that choose poses."""
    tables = {
        "geometry-errors": table("mean / max | position [mm] | orientation [deg]", _error_rows(metrics["table_3"])),
        "geometry-beside": table("| paper | here", _supplements(metrics)),
    }
    if "selection" in metrics:
        tables["geometry-selection"] = _selection_table(metrics["selection"])
        ceiling = metrics["ceiling"]
        share = f"{100 * ceiling['best_share_of_det']:.1f} %"
        tables["geometry-ceiling"] = table(
            "O1 of any 17 poses, at most | searches | share of its det^(1/p) reached",
            [(f"{ceiling['O1']:.0f}", ceiling["climbs"], share)],
        )
    return tables


def _error_rows(table_3: Metrics) -> list[tuple[str, ...]]:
    """Return the rows of Table 3: the paper's and ours, nominal and calibrated."""
    paper = table_3["paper"]
    errors = {"paper, nominal": paper["nominal"]}
    for reading, summary in table_3["nominal"].items():
        errors[f"nominal: {reading}"] = summary
    errors["paper, calibrated"] = paper["calibrated"]
    errors |= {name: summary for name, summary in table_3.items() if name.startswith("calibrated")}
    rows = []
    for name, summary in errors.items():
        position = mean_and_max(summary["position_mm"], ".2f")
        orientation = mean_and_max(summary["orientation_deg"], ".3f")
        rows.append((name, position, orientation))
    return rows


def _supplements(metrics: Metrics) -> list[tuple[Any, ...]]:
    """Return numbers beside Table 3, each with the paper's where there is one."""
    condition = metrics["condition_number"]
    table_2 = metrics["table_2"]
    leds = metrics["base_leds"]
    equations = metrics["eq_11_against_eq_12"]["largest_difference_in_sigmas"]
    rows: list[tuple[Any, ...]] = [
        ("cond of the 17 poses [m, rad]", f"{condition['paper']:.2f}", f"{condition['ours_m_rad']:.3f}"),
        ("parameters within 2σ of Table 2, of 32", "", table_2["within_2_sigma"]),
    ]
    for weighting, count in table_2["within_2_sigma_rigid_truth"].items():
        rows.append((f"the same, rigid truth, {weighting}", "", f"{count:.1f}"))
    rows += [
        ("eq. 11 against eq. 12, most [σ]", "", f"{equations:.0e}"),
        ("rigid arm, true error, tool measured [mm rms]", "", f"{leds['tool only']:.3f}"),
        ("rigid arm, true error, tool and base measured [mm rms]", "", f"{leds['tool and base']:.3f}"),
        ("worst of 200 random sets, cond", "", f"{metrics['random_sets']['worst']:.2f}"),
    ]
    return rows


def _selection_table(selection: Sequence[Metrics]) -> str:
    """Return the value of each index by each method: median (worst, best) over seeds."""
    # index -> method -> summary of the searches
    by_index: dict[str, dict[str, Metrics]] = {}
    for summary in selection:
        by_index.setdefault(summary["index"], {})[summary["method"]] = summary
    methods = list(dict.fromkeys(summary["method"] for summary in selection))
    rows = []
    for index, summaries in by_index.items():
        row = [index, _index_value(summaries[methods[0]]["best_of_1000_random"])]
        for method in methods:
            median, worst, best = (_index_value(summaries[method][key]) for key in ("median", "worst", "best"))
            row.append(f"{median} ({worst}, {best})")
        rows.append(row)
    return table(" | ".join(["index", "best of 1000 random", *methods]), rows)


def _index_value(value: float) -> str:
    if value >= 100:
        return f"{value:.0f}"
    if value < 1:
        return f"{value:.4f}"
    return f"{value:.3f}"


def dynamics(metrics: Metrics) -> Tables:
    """Return the counts, the essential set beside Table 4, and Fig. 8 in numbers."""
    counts = metrics["counts"]
    essential = metrics["essential"]
    count_rows = [(COUNT_LABELS.get(name, name), PAPER_COUNTS.get(name, ""), counts[name]) for name in COUNTS]
    count_rows += [("essential", 44, essential["count"]), ("of these in Table 4", "", len(essential["both"]))]
    only_paper = " ".join(essential["only_table_4"]) or "none"
    only_here = " ".join(essential["only_here"]) or "none"

    model_rows = []
    rules: list[str] = []
    for name, model in metrics["models"].items():
        rules = list(model["essential"])
        condition, error = f"{model['condition']:.0f}", f"{model['error_in_sigma']:.2f}"
        model_rows.append((name, model["base"], *model["essential"].values(), condition, error))

    torque_rows = []
    for geometry_name, parts in metrics["computed_torque"].items():
        for part, errors in parts.items():
            torque_rows.append((f"{geometry_name}, {part}", *_three_digits(errors["largest"])))
    tracking_rows = [(name, *_three_digits(errors)) for name, errors in metrics["tracking_mrad"].items()]

    published_rows = []
    for name, values in metrics["published"].items():
        published, here = _three_digits([values["published"], values["here"]])
        published_rows.append((name, published, here, f"{values['apart_percent']:.0f}"))

    return {
        "dynamics-counts": table("| paper | here", count_rows),
        "dynamics-essential": table("only in Table 4 | only here", [(only_paper, only_here)]),
        "dynamics-models": table(f"| base | {' | '.join(rules)} | cond, normalised | error [σ]", model_rows),
        "dynamics-torque": table(f"largest error [N m] of joint | {JOINTS}", torque_rows),
        "dynamics-tracking": table(f"tracking, rms [mrad] of joint | {JOINTS}", tracking_rows),
        "dynamics-published": table("| another unit | here | apart [%]", published_rows),
    }


def _three_digits(values: Iterable[float]) -> list[str]:
    return [f"{value:.3f}" for value in values]


def consistency(metrics: Metrics) -> Tables:
    """Return what a geometry costs (Fig. 7 in numbers), and the coverage of the intervals."""
    rows = []
    for name, errors in metrics["geometries"].items():
        torque = f"{errors['torque_error_percent']:.3f}"
        noise_free = f"{errors['torque_error_without_noise_percent']:.4f}"
        bias = errors["bias_in_sigma"]
        rows.append((name, torque, noise_free, f"{bias['rms']:.2f}", bias["beyond_2"]))
    head = "geometry | torque [%] | without noise in the data [%] | bias, rms [σ] | beyond 2σ"
    tables = {"consistency-geometries": table(head, rows)}
    if metrics["coverage"]:
        columns = [_coverage_column(coverage) for coverage in metrics["coverage"].values()]
        labels = columns[0].keys()
        coverage_rows = list(zip(labels, *(column.values() for column in columns)))
        tables["consistency-coverage"] = table(" | ".join(["", *metrics["coverage"]]), coverage_rows)
    return tables


def _coverage_column(coverage: Metrics) -> dict[str, Any]:
    """Return the cells of a setup, by the label of their row."""
    pooled = coverage["pooled"]
    geometric = coverage["geometry_exceeds_torque"]
    unchanged = len(coverage["unchanged"]["parameters"])
    errors = coverage["rms_error_in_sigma"]
    geometric_coverage = ""
    if geometric["parameters"]:
        geometric_coverage = f"{percent(geometric['with'])} / {percent(geometric['without'])}"
    return {
        "calibrations": coverage["runs"],
        "pooled, with the geometry's part": percent(pooled["with"]),
        "pooled, without": percent(pooled["without"]),
        "parameters whose geometric part exceeds the torques'": " ".join(geometric["parameters"]) or "none",
        "of these, with / without": geometric_coverage,
        "parameters that propagation changes by less than 1 %": f"{unchanged} of {coverage['parameters']}",
        "rms error in sigmas, with / without": f"{errors['with']:.3f} / {errors['without']:.3f}",
    }


def planning(metrics: Metrics) -> Tables:
    """Return the plans of section 5, checked on the true robot."""
    rows = []
    for name, plan in metrics["summary"].items():
        shares = [f"{plan[key]:.1%}" for key in ("peak", "worst_peak", "beyond", "active")]
        rows.append((name, f"{plan['seconds']:.3f}", *shares))
    shortened = metrics["shaped"]
    return {
        "planning": table("planned on | s | true peak | worst | time beyond a limit | time at a limit", rows),
        "planning-shape": table(
            "shape of the path, 60 timings, over its time before | median | best",
            [("", f"{np.median(shortened):.3f}", f"{min(shortened):.3f}")],
        ),
    }


def excitation(metrics: Metrics) -> Tables:
    """Return eq. 24 as designed by the estimate and by the truth, and RSDs against the baselines' speed."""
    estimate_error = metrics["estimate_off_percent"]
    estimate_rows = [
        ("median of the 44", f"{estimate_error['median']:.2f}"),
        ("most", f"{estimate_error['largest']:.0f}"),
    ]
    design_rows = []
    rsd_rows = []
    for name, summary in metrics["compared"].items():
        design_rows.append(_design_row(name, summary))
        if "102 fitted" in summary:
            rsd_rows.append(_rsd_row(name, summary["102 fitted"], summary["44 fitted"]))
    geometry_rows = []
    for name, errors in metrics["geometries"].items():
        rsd, error = _three_digits([errors["median_rsd"], errors["median_error"]])
        geometry_rows.append((name, rsd, error, f"{errors['error_in_sigma']:.2f}"))
    design_head = "motion | cond of 102 | cond of 44 | normalised | mean share τ6, τ7 | largest torque / limit"
    rsd_head = (
        "motion | RSD [%] | wrist [%] | over B's | error [σ] | size, separation / B's | 44 alone: RSD [%] | over B's "
        "| error [σ]"
    )
    front = metrics["motions"]["B, 44 columns"][0]["front"]
    return {
        "excitation-estimate": table("estimate designed with | off by [%]", estimate_rows),
        "excitation-designs": table(design_head, design_rows),
        "excitation-front": table("motion | mean share τ6 | cond of 44", _front_rows(front)),
        "excitation-rsd": table(rsd_head, rsd_rows),
        "excitation-geometry": table("geometry, motion | RSD [%] | error [%] | error [σ]", geometry_rows),
    }


def _design_row(name: str, summary: Metrics) -> tuple[str, ...]:
    """Return condition numbers, torque shares and peak of a motion, medians over seeds with their ranges."""
    essential = summary["cond"]["44"]
    return (
        name,
        with_range(summary["cond"]["102"]["raw"], ".0f"),
        with_range(essential["raw"], ".1f"),
        f"{essential['normalised'][0]:.1f}",
        f"{summary['share'][5]:.2f}, {summary['share'][6]:.2f}",
        with_range(summary["peak"], ".2f"),
    )


def _rsd_row(name: str, base: Metrics, essential: Metrics) -> tuple[str, ...]:
    """Return the RSDs of a motion.

    Args:
        name: name of the motion.
        base: the 44 essential parameters with all 102 base parameters fitted.
        essential: the same, fitted alone.
    """
    return (
        name,
        f"{base['median_rsd'][0]:.3f}",
        f"{base['median_rsd_wrist'][0]:.3f}",
        with_range(base["ratio"], ".2f"),
        f"{base['error_in_sigma'][0]:.2f}",
        f"{base['size_ratio']:.2f}, {base['separation_ratio']:.2f}",
        f"{essential['median_rsd'][0]:.3f}",
        with_range(essential["ratio"], ".2f"),
        f"{essential['error_in_sigma'][0]:.1f}",
    )


def _front_rows(front: Sequence[Metrics]) -> list[tuple[str, str, str]]:
    """Return the motions of a Pareto front, by rising torque of joint 6."""
    rows = []
    for motion in sorted(front, key=lambda motion: motion["share"]):
        label = "dominated"
        if motion["best"]:
            label = "front"
        if motion["designed"]:
            label = "B, chosen"
        rows.append((label, f"{motion['share']:.3f}", f"{motion['cond']:.1f}"))
    return rows


def excitation_peers(metrics: Metrics) -> Tables:
    """Return tables of the default search over seeds, and of all searches in equal processor time."""
    # results over the seeds, by the name of the search
    default: dict[str, list[Metrics]] = {}
    peers: dict[str, list[Metrics]] = {}
    for name, result in metrics.items():
        if " seed " not in name:
            continue
        search, _, _ = name.rpartition(", ")
        if search.startswith("default, "):
            default.setdefault(search.removeprefix("default, "), []).append(result)
        else:
            peers.setdefault(search, []).append(result)
    default_rows = [(period, len(runs), *_default_cells(runs)) for period, runs in default.items()]
    instants = [seconds for seconds in INSTANTS if seconds <= metrics["seconds"]]
    peer_rows = [(search, *_peer_cells(runs, instants)) for search, runs in peers.items()]
    peer_head = ["search", *(f"{seconds} s" for seconds in instants), "raw", "normalised"]
    return {
        "peers-seeds": table("T0 | seeds | raw | normalised | processor time [s] | within 5 % after [s]", default_rows),
        "peers-searches": table(" | ".join(peer_head), peer_rows),
    }


def _default_cells(runs: Sequence[Metrics]) -> list[str]:
    """Return condition numbers and times of the default search, medians over seeds with their ranges."""
    cells = []
    for key, form in (("raw", ".1f"), ("normalised", ".2f"), ("seconds", ".0f"), ("seconds_close", ".0f")):
        values = [run[key] for run in runs]
        cells.append(with_range((float(np.median(values)), min(values), max(values)), form))
    return cells


def _peer_cells(runs: Sequence[Metrics], instants: Iterable[float]) -> list[str]:
    """Return √(raw · normalised) at instants and the condition numbers at the end, one value per seed."""
    cells = []
    for seconds in instants:
        merits = [_merit_at(run["curve"], seconds) for run in runs]
        cells.append(_seeds(merits, ".1f"))
    # a search that found no motion reached nothing
    ends = [run["reached"] or {} for run in runs]
    cells.append(_seeds([end.get("raw") for end in ends], ".1f"))
    cells.append(_seeds([end.get("normalised") for end in ends], ".2f"))
    return cells


def _merit_at(curve: Sequence[Sequence[float]], seconds: float) -> float | None:
    """Return √(raw · normalised) of the best motion after some processor time [s]; None without a motion."""
    logarithms = [logarithm for instant, logarithm in curve if instant <= seconds]
    if not logarithms:
        return None
    return float(np.exp(min(logarithms)))


def _seeds(values: Iterable[float | None], form: str) -> str:
    """Return one value per seed, with a dash for None."""
    cells = [_or_dash(value, form) for value in values]
    return " / ".join(cells)


def _or_dash(value: float | None, form: str) -> str:
    if value is None:
        return "–"
    return f"{value:{form}}"


SHOW: dict[str, Callable[[Metrics], Tables]] = {
    "geometry": geometry,
    "dynamics": dynamics,
    "consistency": consistency,
    "excitation": excitation,
    "planning": planning,
    "excitation_peers": excitation_peers,
}


def blocks(text: str) -> Tables:
    """Return the tables of a document, found between their marks."""
    return {block[2]: block[3] for block in _BLOCK.finditer(text)}


def renewed(text: str, tables: Tables) -> str:
    """Return the document with its tables replaced by these."""

    def replaced(block: re.Match[str]) -> str:
        start, name, old, end = block.groups()
        return start + tables.get(name, old) + end

    return _BLOCK.sub(replaced, text)
