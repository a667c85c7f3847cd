"""The certificate: one HTML page without any outside reference, for the screen and for paper.

A page is a head, stages (geometry today, dynamics tomorrow) and an end; a stage is a verdict and blocks; a block is a
table, a text or a picture. The template knows blocks only, so that a new stage needs no new page.
"""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata, resources
from typing import TYPE_CHECKING, Any

import jinja2
import numpy as np

from calib.procedure.kinematic_stage import iso9283
from calib.procedure.report.fit_report import Report

if TYPE_CHECKING:
    from calib.procedure.report.figures import Drawn

WORDS = {"pass": "PASS", "marginal": "MARGINAL", "fail": "FAIL"}
KINDS = {
    "position_mm": ("position", "mm"),
    "orientation_deg": ("orientation", "deg"),
    "distance_mm": ("distance", "mm"),
}
ARMS = {"nominal": "nominal", "calibrated": "calibrated", "urdf_alone": "its URDF alone"}
EDITED = "edited by hand"
MOST_ROWS = 60
CONVENTIONS = (
    "Units: m, rad, s, kg, N·m in all files unless a header names another; this page prints mm, deg and mrad.",
    "Modified Denavit-Hartenberg rows (Khalil and Kleinfinger): Rot_x(alpha) Trans_x(d) Trans_z(r) Rot_z(theta + q).",
    "Quaternions are x y z w; roll-pitch-yaw is R = Rz(yaw) Ry(pitch) Rx(roll), as in URDF.",
    "A station is the pose of the arm's base in the instrument's frame, a tool that of the target in the tip's frame.",
    "Nominal errors are those of the nominal arm with station and tool fitted on the same rows, so that arms are "
    "compared and not installations.",
    "rms is the root mean square of the error vector's length over poses, not per axis.",
)
LIMITATIONS = (
    "Sigmas state what the measurements' noise leaves open under the chosen model; they do not cover effects that no "
    "parameter of the model holds (see the residual plots for trends).",
    "The figures hold for the region, payload and temperature of the measured poses.",
)


@dataclass(frozen=True)
class Table:
    """Rows of text under a header; `strong` are rows to set in bold, `numbers` columns to set to the right."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    strong: frozenset[int] = frozenset()
    numbers: Sequence[int] = ()
    kind: str = "table"


@dataclass(frozen=True)
class Text:
    """Sentences, as a list."""

    title: str
    lines: Sequence[str]
    kind: str = "text"


@dataclass(frozen=True)
class Pictures:
    """Figures as SVG, each with its caption; wide ones take the whole line."""

    title: str
    items: Sequence[tuple[str, str, bool]]
    kind: str = "pictures"


Block = Table | Text | Pictures


@dataclass(frozen=True)
class Stage:
    """One judged stage of the calibration."""

    title: str
    verdict: str
    reason: str
    figures: Sequence[tuple[str, str, str]] = ()
    blocks: Sequence[Block] = ()


@dataclass(frozen=True)
class Page:
    """The whole certificate.

    Attributes:
        title, subtitle: its head.
        setup: label and value of what was calibrated, with what, when, by which command.
        stages: see `Stage`.
        files: name, role, size, SHA-256.
    """

    title: str
    subtitle: str
    setup: Sequence[tuple[str, str]]
    stages: Sequence[Stage]
    files: Sequence[Sequence[str]] = ()
    limitations: Sequence[str] = LIMITATIONS
    conventions: Sequence[str] = CONVENTIONS
    extra: Mapping[str, str] = field(default_factory=dict)


def render(page: Page) -> str:
    """Return the page as HTML."""
    here = resources.files("calib.procedure.report")
    source = here.joinpath("certificate.html").read_text(encoding="utf-8")
    style = here.joinpath("certificate.css").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    return environment.from_string(source).render(page=page, style=style, words=WORDS)


def of_fit(report: Report, drawn: Mapping[str, Drawn], setup: Sequence[tuple[str, str]] = ()) -> Page:
    """Return the certificate of a fit alone, without a session around it."""
    given = setup or (
        ("robot", f"{report.robot}, {report.base} to {report.tip}, {len(report.joints)} joints"),
        ("tolerance", tolerance(report.metrics.get("tolerance_mm"))),
        ("seed", str(report.metrics["seed"])),
        ("toolkit", versions()),
    )
    return Page(f"Calibration of {report.robot}", "Geometry", given, [geometry_stage(report, drawn)])


def tolerance(millimetres: float | None) -> str:
    """Return what a verdict of pass means, in words."""
    if not millimetres:
        return "none was given: pass means better than the nominal robot on unseen poses, or nothing to gain"
    return f"{millimetres:g} mm rms on unseen poses"


def versions() -> str:
    """Return the toolkit's version and those of what its numbers depend on."""
    names = ("armature-calib", "numpy", "scipy")
    known = ", ".join(f"{name} {metadata.version(name)}" for name in names)
    return f"{known}, Python {platform.python_version()}"


def geometry_stage(report: Report, drawn: Mapping[str, Drawn]) -> Stage:
    """Return the stage of the geometric fit: errors, ladder, parameters, identifiability, figures, outliers."""
    metrics = report.metrics
    blocks: list[Block] = [error_table(metrics), *iso9283_tables(metrics)]
    if any(rung["cross_validated_mm"] is not None for rung in metrics["ladder"]):
        blocks += [ladder_table(metrics), _pictures("", drawn, ("ladder",))]
    blocks.append(_pictures("Before and after", drawn, ("position", "orientation", "distance")))
    blocks.append(_pictures("What remains", drawn, ("joints", "map")))
    blocks.append(Text("What the poses can tell", identifiability(report)))
    blocks.append(_pictures("Parameters", drawn, ("parameters", "singular_values", "correlations")))
    blocks.append(parameter_table(report))
    if metrics["outliers"]:
        blocks.append(outlier_table(metrics))
    if metrics["warnings"]:
        blocks.append(Text("Notes", metrics["warnings"]))
    return Stage("Geometry", metrics["verdict"], metrics["reason"], key_figures(metrics), blocks)


def key_figures(metrics: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return up to four numbers for the head of a stage: label, value, what it was before."""
    proof = next(iter(metrics["validation"].values()), metrics["fit"])
    where = "unseen poses" if metrics["validation"] else "fitted poses"
    result = []
    for key, (label, unit) in KINDS.items():
        if proof["calibrated"].get(key):
            before, after = (proof[arm][key]["rms"] for arm in ("nominal", "calibrated"))
            result.append((f"{label}, rms on {where}", f"{after:.3g} {unit}", f"nominal {before:.3g} {unit}"))
    worst = proof["calibrated"].get("position_mm") or proof["calibrated"].get("distance_mm")
    if worst:
        result.append(
            (f"largest of {proof['poses']} {where}", f"{worst['max']:.3g} mm", f"95 % below {worst['p95']:.3g} mm")
        )
    result.append(("parameters fitted", str(metrics["fit"]["parameters"]), f"on {metrics['fit']['poses']} poses"))
    return result[:4]


def error_table(metrics: Mapping[str, Any]) -> Table:
    """Return errors of both arms, fitted and unseen."""
    header = ("rows", "error", "arm", "mean", "rms", "95 %", "max")
    sets = [(f"fitted, {metrics['fit']['poses']} poses", metrics["fit"])]
    sets += [(f"{name}, {found['poses']} poses, unseen", found) for name, found in metrics["validation"].items()]
    rows, strong = [], set()
    for label, found in sets:
        lines = [
            (f"{words} [{unit}]", arm, found[arm][key])
            for key, (words, unit) in KINDS.items()
            for arm in ARMS
            if found.get(arm, {}).get(key)
        ]
        pairs = found.get("pair_distance_mm")
        lines += [("distance of pairs [mm]", arm, pairs[arm]) for arm in ARMS if arm in pairs] if pairs else []
        for number, (words, arm, numbers) in enumerate(lines):
            if arm == "calibrated":
                strong.add(len(rows))
            cells = [f"{numbers[key]:.3f}" for key in ("mean", "rms", "p95", "max")]
            rows.append((label if number == 0 else "", words if arm == "nominal" else "", ARMS[arm], *cells))
    note = "Distances of pairs do not depend on where instrument and tool are placed."
    if any("urdf_alone" in found for _, found in sets):
        note += (
            " A URDF cannot hold the joint corrections of the chosen model: robot.urdf is the best geometry without "
            "them, and its errors stand beside; robot_for_corrections.urdf with joint_corrections.csv has those of the "
            "calibrated arm."
        )
    return Table("Errors", header, rows, note, frozenset(strong), range(3, 7))


def ladder_table(metrics: Mapping[str, Any]) -> Table:
    """Return the rungs and their error on rows left out."""
    rows, strong = [], set()
    for rung in metrics["ladder"]:
        error = rung["cross_validated_mm"]
        if not rung["note"]:
            strong.add(len(rows))
        rows.append(
            (rung["model"], str(rung["parameters"]), "" if error is None else f"{error:.4f}", rung.get("note", ""))
        )
    header = ("model", "parameters", "cross-validated rms [mm]", "remark")
    return Table("Ladder of models", header, rows, f"Chosen: {metrics['model']}.", frozenset(strong), (1, 2))


def parameter_table(report: Report) -> Table:
    """Return the fitted parameters; of many joint corrections only the arm and the frames are printed."""
    shown = [row for row in report.parameters if len(report.parameters) <= MOST_ROWS or row[6] != "deflection"]
    rows = []
    for name, unit, nominal, value, sigma, rsd, _ in shown:
        factor, printed = {"m": (1e3, "mm"), "rad": (1e3, "mrad")}.get(unit, (1.0, unit))
        digits = ".3f" if factor > 1 else ".4g"
        numbers = [f"{factor * number:{digits}}" for number in (nominal, value)]
        relative = "" if rsd is None or rsd > 999 else f"{rsd:.0f} %" if rsd >= 10 else f"{rsd:.2g} %"
        change = f"{factor * (value - nominal):+{digits}}"
        rows.append((name, printed, *numbers, change, f"{factor * sigma:.2g}", relative))
    left = len(report.parameters) - len(shown)
    note = f"{left} joint corrections stand in joint_corrections.csv." if left else ""
    if report.kept:
        note = f"Not fitted, kept at their nominal values: {', '.join(report.kept)}. {note}"
    header = ("parameter", "unit", "nominal", "calibrated", "change", "σ", "RSD")
    return Table("Fitted parameters", header, rows, note.strip(), numbers=range(2, 7))


def outlier_table(metrics: Mapping[str, Any], most: int = 20) -> Table:
    """Return the rows that do not fit, worst first."""
    found = metrics["outliers"]
    rows = [(o["file"], str(o["row"]), o["nature"], f"{o['sigmas']:.1f}") for o in found[:most]]
    note = "Rows beyond 4 robust sigmas. They were kept in the fit; a robust loss, where used, weighed them down."
    if len(found) > most:
        note += f" {len(found) - most} more in metrics.json."
    return Table("Rows that do not fit", ("file", "row", "residual", "robust sigmas"), rows, note, numbers=(1, 3))


def identifiability(report: Report) -> list[str]:
    """Return what the poses can and cannot tell, in words."""
    values, rank, lines = report.singular_values, report.rank, []
    if values and not report.metrics["not_identifiable"]:
        lines.append(f"All {len(values)} candidate parameters can be told apart.")
    fitted = report.metrics["fit"]["parameters"]
    if values and fitted < rank:
        lines.append(
            f"{fitted} of them are fitted: the others are told less exactly than an arm of this kind may be off, so "
            "they keep their nominal values."
        )
    lines += [f"{line[0].upper()}{line[1:]}" for line in report.metrics["not_identifiable"]]
    strong = [f"{a} with {b} ({c:+.2f})" for a, b, c in report.correlations[:8]]
    if strong:
        lines.append(f"Told apart only weakly (correlation above 0.9): {', '.join(strong)}.")
    else:
        lines.append("No two parameters correlate by more than 0.9.")
    return lines


def _pictures(title: str, drawn: Mapping[str, Drawn], names: Sequence[str]) -> Pictures:
    from calib.procedure.report.style import svg

    return Pictures(title, [(svg(drawn[n].figure, n), drawn[n].caption, drawn[n].wide) for n in names if n in drawn])


_ISO_MOST = 30  # poses a certificate lists
_ISO_NOTE = (
    "After ISO 9283: AP is the barycentre of a pose's cycles minus the command (what the arm's model says of these "
    "joints; station and tool as fitted), RP the mean distance from the barycentre plus three standard deviations, vAP "
    "the largest distance between barycentres approached from different directions. The norm asks for 5 poses of 30 "
    "cycles. Five poses are too few to state an accuracy: makers judge it by 100 and more, once each, as the errors on "
    "unseen poses do; repeated poses state the repeatability, below which no calibration can get."
)


def iso9283_tables(metrics: Mapping[str, Any]) -> list[Any]:
    """Return the certificate's tables: one for each set of rows in which poses were repeated."""
    sets = [("fitted", metrics["fit"]), *metrics["validation"].items()]
    result = []
    for name, found in sets:
        if iso := found.get("iso9283"):
            rows = [_iso_row(number + 1, each) for number, each in enumerate(iso["each"][:_ISO_MOST])]
            if len(iso["each"]) > _ISO_MOST:
                rows += [("…", f"{len(iso['each']) - _ISO_MOST} more in metrics.json", *[""] * 6)]
            title = f"Accuracy and repeatability, {name} ({iso9283.sentence(iso)})"
            result.append(Table(title, _ISO_HEADER, rows, _ISO_NOTE, numbers=range(1, 8)))
    return result


_ISO_HEADER = (
    "pose", "cycles", "AP nominal [mm]", "AP calibrated [mm]", "x, y, z of it [mm]", "RP [mm]", "RP a, b, c [deg]",
    "vAP [mm]",
)  # fmt: skip


def _iso_row(number: int, each: Mapping[str, Any]) -> tuple[str, ...]:
    sizes = [f"{float(np.linalg.norm(each[f'{arm}_mm'])):.3f}" for arm in iso9283.ARMS]
    axes = ", ".join(f"{value:+.3f}" for value in each["calibrated_mm"])
    turns = ", ".join(f"{value:.4f}" for value in each.get("repeatability_deg", ()))
    varied = f"{each['multidirectional_mm']:.3f}" if "multidirectional_mm" in each else ""
    return (str(number), str(len(each["rows"])), *sizes, axes, f"{each['repeatability_mm']:.3f}", turns, varied)
