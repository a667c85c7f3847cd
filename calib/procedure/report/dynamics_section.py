"""The dynamics on a certificate: torque errors on unseen motion, parameters, excitation, what could not be told."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib.errors import UsageError
from calib.estimate_files import read_estimate
from calib.folders import METRICS
from calib.procedure.dynamic_stage.folder import UNSEEN, IdentificationFolder
from calib.procedure.excitation import coefficients
from calib.procedure.report.page import Block, KeyFigure, Picture, Pictures, Section, Table, Text

TOLD = 50.0  # RSD [%] from which on a parameter is not told from zero: two sigmas
DRAWN = 300  # points per curve of the excitation
WORDS = 46  # letters of what a parameter holds that are printed
WHITE = 0.10  # share of autocorrelations beyond the bound below which a residual may be called white (0.05 if it is)


@dataclass(frozen=True, eq=False)
class DynamicReport:
    """What an identification and its validation left behind.

    Attributes:
        verdict, reason: of the dynamics.
        metrics: of the identification, as in ``metrics.json``.
        estimate: rows of ``estimate.csv``.
        unseen: ``unseen/report.json``.
    """

    verdict: str
    reason: str
    metrics: Mapping[str, Any]
    estimate: tuple[Mapping[str, str], ...]
    unseen: Mapping[str, Any]


def read(folder: Path) -> DynamicReport:
    """Read what the steps identify and predict have left.

    Raises:
        UsageError: where it is missing or made by another version.
    """
    try:
        place = IdentificationFolder(folder)
        metrics = json.loads(place.numbers.read_text(encoding="utf-8"))
        unseen = json.loads(place.unseen.report.read_text(encoding="utf-8"))
        estimate = read_estimate(folder).rows
    except (OSError, ValueError) as error:
        raise UsageError(f"{folder}: {error}; identify again: calib redo … identify") from error
    if unseen.get("schema") != UNSEEN:
        raise UsageError(f"{folder}/unseen/report.json: schema {unseen.get('schema')}, this version reads {UNSEEN}")
    return DynamicReport(unseen["verdict"], unseen["reason"], metrics, estimate, unseen)


def dynamics_stage(
    found: DynamicReport, folder: Path, excitation: Path, exported: Sequence[str] = (), plots: bool = True
) -> Section:
    """Return the stage of the dynamics: errors on unseen motion, torques, excitation, parameters, what is not told.

    Args:
        folder: of the identification.
        excitation: folder with ``training/trajectory.csv`` and its ``metrics.json``, if one was planned.
        exported: what the export had to say.
        plots: whether there are to be figures.
    """
    blocks: list[Block] = [error_table(found)]
    if plots:
        blocks += [Pictures("", judged_figures(found)), Pictures("Torques", torques(found)), planned(excitation)]
    if len(found.metrics["ladder"]) > 1:
        blocks.append(friction_table(found))
    blocks.append(Text("What the motion can tell", identifiability(found)))
    if plots:
        blocks += [consistency(folder), Pictures("Dynamic parameters", [significance(found)])]
    blocks.append(parameter_table(found))
    if exported:
        blocks.append(Text("What was exported", exported))
    notes = [*found.metrics["warnings"], *(w for w in found.unseen["warnings"] if w not in found.metrics["warnings"])]
    if notes:
        blocks.append(Text("Notes on the dynamics", notes))
    return Section("Dynamics", blocks, found.verdict, found.reason, key_figures(found))


def torques(found: DynamicReport) -> list[Picture]:
    """Return a figure of the torques of each recording."""
    from calib.procedure.report import dynamics_figures
    from calib.procedure.report.style import picture

    result, rows, units = [], found.unseen["rows"], found.unseen["units"]
    seen = "unseen" if found.unseen["validation"] else "fitted"
    for curves in found.unseen["curves"]:
        raw = {**found.unseen["fit"], **found.unseen["validation"]}[curves["name"]]["raw"]["relative_error_percent"]
        t, measured, predicted = (np.array(curves[key], dtype=float).T for key in ("t", "measured", "predicted"))
        title = f"{curves['name']}: {percent(raw['total'])} of the torque unexplained"
        figure = dynamics_figures.torques(t, measured, predicted, rows, units, title, raw["joints"])
        words = f"Torques on {curves['name']}, {seen}: measured, predicted, and what is left."
        result.append(picture(figure, words, True))
    return result


def proof_of(found: DynamicReport) -> tuple[Mapping[str, Any], str]:
    """Return the scores that judge, and on what: the worst unseen recording, else the fitted one."""
    proofs = {name: one for name, one in found.unseen["validation"].items() if one["evidence"]}
    where = "unseen motion" if proofs else "the training motion"
    sets = proofs or found.unseen["fit"]
    return max(sets.values(), key=lambda one: one["raw"]["relative_error_percent"]["total"] or 0.0), where


def key_figures(found: DynamicReport) -> list[KeyFigure]:
    """Return four numbers for the head of the stage: label, value, remark."""
    proof, where = proof_of(found)
    raw, band = proof["raw"]["relative_error_percent"], proof["filtered"]["relative_error_percent"]
    rows = [(x, name) for x, name in zip(band["joints"], found.unseen["rows"]) if x is not None]
    worst, name = max(rows, default=(None, "torque"))
    return [
        KeyFigure("torque unexplained", "", percent(raw["total"]), "", where),
        KeyFigure("torque unexplained, in the motion's band", "", percent(band["total"]), "", where),
        KeyFigure(f"the same, worst joint ({name})", "", percent(worst), "", where),
    ]


def percent(value: float | None) -> str:
    """Return a share in percent with three digits; a dash where there is none."""
    return "–" if value is None else f"{value:.3g} %"


def error_table(found: DynamicReport) -> Table:
    """Return errors of the torque per row, of every recording."""
    rows, strong = [], set()
    for role, sets in (("training", found.unseen["fit"]), ("unseen", found.unseen["validation"])):
        for name, one in sets.items():
            label = role if role == "training" or one["evidence"] else "repeat: no evidence"
            total = one["raw"]["relative_error_percent"]["total"], one["filtered"]["relative_error_percent"]["total"]
            if role == "unseen":
                strong.add(len(rows))
            rows.append((f"{name} ({label})", "all", percent(total[0]), percent(total[1]), "", "", ""))
            for j, row in enumerate(found.unseen["rows"]):
                white = one["whiteness"][j]
                rms = one["raw"]["rms"][j]
                rows.append((
                    "", row, percent(one["raw"]["relative_error_percent"]["joints"][j]),
                    percent(one["filtered"]["relative_error_percent"]["joints"][j]),
                    percent(one["above_band_percent"][j]),
                    "" if rms is None else f"{rms:.3g} {found.unseen['units'][j]}",
                    "" if white is None else f"{100 * white['outside']:.0f} %",
                ))  # fmt: skip
    header = ("recording", "torque", "error", "in band", "torque above band", "rms", "ACF outside")
    note = (
        "Error: 100 ‖τ - τ̂‖ / ‖τ‖ of the torque as recorded; in band: both low-passed to the band of the motion. "
        "What of "
        "the torque lies above that band (noise, ripple) no model of q, v, a explains. ACF outside: share of the "
        "residual's "
        "autocorrelations beyond the 95 % bounds of white noise; 5 % if it is white."
    )
    return Table("Torque errors", header, rows, note, frozenset(strong), range(2, 7))


def judged_figures(found: DynamicReport) -> list[Picture]:
    """Return errors by row and autocorrelations of the recording that judges."""
    from calib.procedure.report import dynamics_figures
    from calib.procedure.report.style import HALF, WIDE, picture

    proof, where = proof_of(found)
    own = next(iter(found.unseen["fit"].values()))
    sides = [[x or 0.0 for x in one["raw"]["relative_error_percent"]["joints"]] for one in (own, proof)]
    rows = found.unseen["rows"]
    bars = dynamics_figures.errors_by_row(sides[0], sides[1], rows)
    name = next(iter(found.unseen["autocorrelation"]))
    white = found.unseen["autocorrelation"][name]
    many = len(rows) > dynamics_figures.FEW
    width = WIDE if many else HALF
    drawn = dynamics_figures.autocorrelations(white["values"], white["bound"], rows, "What is left", width)
    left = f"Share of each torque that the model leaves, on the training motion and on {where}."
    rest = f"Autocorrelation of what is left below the band on {name}; dashed: white noise."
    return [picture(bars, left, many), picture(drawn, rest, many)]


def planned(excitation: Path) -> Pictures:
    """Return the designed motion: a picture, and how well it tells the parameters."""
    folder = excitation / "training"
    if not (folder / coefficients.NAME).exists():
        return Pictures("Excitation", [])
    motion = coefficients.read(folder)
    t = np.linspace(0.0, motion.period, DRAWN)
    q, v, _ = motion.orders(t)
    made = json.loads((folder / METRICS).read_text(encoding="utf-8"))
    condition, setting = made["condition_number"], made["setting"]
    margins = ", ".join(f"{name} {one['share']:.1%} of its scale" for name, one in made["margins"].items())
    words = (
        f"The training motion, one period of {setting['period']:g} s: condition number {condition['raw']:.3g} raw, "
        f"{condition['normalised']:.3g} with unit columns, of {len(setting['columns'])} columns. Every limit was kept, "
        f"at and between {setting['instants_verified']} instants; smallest margins: {margins}."
    )
    from calib.procedure.report.motion_figures import motion_sheet
    from calib.procedure.report.style import picture

    names, none = motion.joint_names, np.full(q.shape[1], np.inf)
    series = [(values, -none, none, title) for values, title in ((q, "position"), (v, "velocity"))]
    figure = motion_sheet(t, series, ("rad", "rad/s"), names)
    return Pictures("Excitation", [picture(figure, words, True)])


def consistency(folder: Path) -> Pictures:
    """Return figures of what the geometry's uncertainty does to the dynamics; none of a robot without a fit."""
    from calib.procedure.report import uncertainty_figures

    return Pictures("Geometry and dynamics", list(uncertainty_figures.from_folder(folder).values()))


def friction_table(found: DynamicReport) -> Table:
    """Return the ladder of friction models."""
    rows, strong = [], set()
    for rung in found.metrics["ladder"]:
        if rung["kept"]:
            strong.add(len(rows))
        at = ", ".join(map(str, rung["kept_at_joints"]))
        rows.append(
            (rung["model"], str(rung["parameters"]), percent(rung["cross_validated_percent"]), at or rung["note"])
        )
    header = ("friction", "parameters", "error on time left out", "kept at joints")
    note = f"Chosen: {found.metrics['friction']}."
    return Table("Ladder of friction models", header, rows, note, frozenset(strong), (1, 2))


def identifiability(found: DynamicReport) -> list[str]:
    """Return what the motion can and cannot tell, in words."""
    counts, condition = found.metrics["parameters"], found.metrics["condition_number"]
    lines = [
        f"Of {counts['standard']} standard parameters the torques of any motion of this arm tell {counts['base']} "
        f"combinations; {counts['essential']} of them this motion tells well enough to be kept.",
        f"Condition number of the observation matrix: {condition['raw']:.3g} in its units, "
        f"{condition['normalised']:.3g} "
        "with columns of unit norm.",
    ]
    weak = [row["name"] for row in found.estimate if row["rsd"] and float(row["rsd"]) > TOLD]
    if weak:
        lines.append(f"Not told from zero (σ above half the value): {', '.join(weak)}.")
    proof, where = proof_of(found)
    coloured = [
        row for row, white in zip(found.unseen["rows"], proof["whiteness"]) if white and white["outside"] > WHITE
    ]
    if coloured:
        lines.append(
            f"What is left on {where} is not white in {', '.join(coloured)}: something the model does not hold is in "
            "it, "
            "and σ, which takes it for noise, is too small there."
        )
    elif any(proof["whiteness"]):
        lines.append(f"What is left on {where} cannot be told from white noise.")
    return lines


def significance(found: DynamicReport) -> Picture:
    """Return the figure of parameters over their sigma."""
    from calib.procedure.report import dynamics_figures
    from calib.procedure.report.style import picture

    names = [row["name"] for row in found.estimate]
    values, sigma = (np.array([float(row[key] or "nan") for row in found.estimate]) for key in ("value", "sigma"))
    known = np.isfinite(values) & np.isfinite(sigma) & (sigma > 0)
    shown = [name for name, use in zip(names, known) if use]
    figure = dynamics_figures.significance(shown, values[known], sigma[known])
    words = "How far each parameter is from zero, in its σ; grey, below the dashed line: not told from zero."
    return picture(figure, words, True)


def parameter_table(found: DynamicReport) -> Table:
    """Return the identified parameters with σ and RSD, and what is regrouped in them."""
    rows = []
    for row in found.estimate:
        rsd = float(row["rsd"]) if row["rsd"] else np.inf
        shown = "" if rsd > 999 else f"{rsd:.0f} %" if rsd >= 10 else f"{rsd:.2g} %"
        sigma = f"{float(row['sigma']):.2g}" if row["sigma"] else ""
        words = row["expression"]
        words = words if len(words) <= WORDS else f"{words[:WORDS].rsplit(' ', 2)[0]} …"
        rows.append((row["name"], row["unit"], f"{float(row['value']):.4g}", sigma, shown, words))
    note = "R marks parameters into which others are regrouped; in full in 8-dynamics/estimate.csv."
    header = ("parameter", "unit", "value", "σ", "RSD", "what it holds")
    return Table("Identified parameters", header, rows, note, numbers=range(2, 5))
