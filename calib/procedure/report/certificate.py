"""The certificate: a summary sheet, the sections summarised on it, and notes common to all certificates.

It is written as HTML, one self-contained file for screen and print.
"""

from __future__ import annotations

import base64
import platform
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from functools import cache
from importlib import metadata, resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib import files
from calib.folders import CERTIFICATE
from calib.procedure.kinematic_stage.fit import Outcome
from calib.procedure.kinematic_stage.folder import FitFolder
from calib.procedure.kinematic_stage.inputs import Inputs
from calib.procedure.kinematic_stage.metrics import FitMetrics
from calib.procedure.kinematic_stage.validation import ARM
from calib.procedure.report import fit_report, geometry_section
from calib.procedure.report.fit_report import Report
from calib.procedure.report.page import Page, Picture, Section, Table, Text, shortened

if TYPE_CHECKING:
    import jinja2

FileRow = tuple[str, str, str, str]  # name, what it is, bytes, SHA-256
EDITED = "edited by hand"
DIGEST_DIGITS = 12  # hexadecimal digits of a SHA-256 on the first sheet
MAX_LISTED_FILES = 6  # files on the first sheet
MAX_LINE_LETTERS = (400, 200, 100, 64)  # of a line of the setup on the first sheet
MAX_SETUP_LETTERS = 1000  # of all its lines
MAX_REASON_LETTERS = 560  # letters of a reason on the first sheet; the whole of a longer one stands behind it
BEHIND = ("session made", "pose plan", "seed", "command")  # labels of the setup that the first sheet leaves out
CONVENTIONS = (
    "Units: m, rad, s, kg, N·m in all files unless a header names another; this page prints mm, deg and mrad.",
    "Modified Denavit-Hartenberg rows (Khalil and Kleinfinger): Rot_x(alpha) Trans_x(d) Trans_z(r) Rot_z(theta + q).",
    "Quaternions are x y z w; roll-pitch-yaw is R = Rz(yaw) Ry(pitch) Rx(roll), as in URDF.",
    "A station is the pose of the arm's base in the instrument's frame, a tool the target's pose in the tip's frame.",
    "Nominal errors are those of the nominal arm with station and tool fitted on the same rows, so that only the "
    "arms are compared.",
    "rms is the root mean square of the error vector's length over poses, not per axis; ± is its standard error "
    "over sets of this many poses.",
)
LIMITATIONS = (
    "Sigmas are the uncertainty from measurement noise under the chosen model; they do not cover unmodelled "
    "effects (see the residual plots for trends).",
    "The figures are valid for the region, payload and temperature of the measured poses.",
)


def certificate(
    title: str,
    subtitle: str,
    setup: Sequence[tuple[str, str]],
    sections: Sequence[Section],
    files: Sequence[FileRow] = (),
    now: datetime | None = None,
) -> Page:
    """Return the page of a certificate.

    Args:
        setup: label and value of what was calibrated, with what, when, by which command; shortened on the first sheet,
            which leaves `BEHIND` out.
        sections: what was judged.
        files: what it rests on, see `file_row`; those of the first sheet come first.
        now: when it is made; this moment by default.
    """
    behind = [*map(_fitting, sections), Section("Setup", [Table("", ("what", "value"), [*setup])])]
    if files:
        listed = Table("", ("file", "what it is", "bytes", "SHA-256"), files, numbers=(2,))
        behind.append(Section("Files", [listed]))
    behind.append(
        Section("Limitations and conventions", [Text("Limitations", LIMITATIONS), Text("Conventions", CONVENTIONS)])
    )
    filed = sorted(files, key=lambda row: row[1] != EDITED)  # what was edited by hand is not hidden among the rest
    first: dict[str, str] = {}
    for label, value in setup:
        if label not in BEHIND:
            first.setdefault(label, value)
    sizes = [len(value) for value in first.values()]
    fits = (one for one in MAX_LINE_LETTERS if sum(min(one, size) for size in sizes) <= MAX_SETUP_LETTERS)
    most = next(fits, MAX_LINE_LETTERS[-1])
    marks = [(name, role, digest[:DIGEST_DIGITS]) for name, role, _, digest in filed[:MAX_LISTED_FILES]]
    if len(files) > MAX_LISTED_FILES:
        marks.append((f"and {len(files) - MAX_LISTED_FILES} more, see Files", "", ""))
    return Page(
        title, subtitle, issued(now), [(label, shortened(value, most)) for label, value in first.items()], behind, marks
    )


def _fitting(section: Section) -> Section:
    """Return a section with its reason shortened to fit the first sheet; its first block is the full reason."""
    short = shortened(section.reason, MAX_REASON_LETTERS)
    if short == section.reason:
        return section
    return replace(section, reason=short, blocks=[Text("Reason in full", [section.reason]), *section.blocks])


def file_row(name: str, role: str, path: Path) -> FileRow:
    """Return the entry of a file in the certificate: name, content, bytes, SHA-256."""
    return name, role, str(path.stat().st_size), files.fingerprint(path)


def unseen_role(role: str, seen: bool, judged: str) -> str:
    """Return the role of a validation file, and whether the file was unseen by `judged` (fit or identification)."""
    return f"{role}, {'NOT unseen' if seen else 'unseen'} by {judged}"


def tolerance(millimetres: float | None, found: FitMetrics) -> str:
    """Return a text on the condition for verdict pass, and on the deliverable to which it applies."""
    of = f"; judged: {ARM[found.deliverable]}" if len(found.deliverables) > 1 else ""
    if not millimetres:
        return f"none given: pass means better than the nominal robot on unseen poses, or no improvement possible{of}"
    return f"{millimetres:g} mm rms on unseen poses{of}"


@cache
def versions() -> str:
    """Return the versions of the toolkit and of the libraries that its results depend on."""
    names = ("armature-calib", "numpy", "scipy")
    known = ", ".join(f"{name} {metadata.version(name)}" for name in names)
    return f"{known}, Python {platform.python_version()}"


def issued(now: datetime | None = None) -> str:
    """Return date and toolkit version of a page as text."""
    when = (now or datetime.now().astimezone()).strftime("%Y-%m-%d %H:%M %Z").strip()
    return f"{when}, armature-calib {metadata.version('armature-calib')}"


def render(page: Page) -> str:
    """Return the page as HTML."""
    return filled("calib.procedure.report", CERTIFICATE, page=page)


def filled(package: str, file: str, **values: Any) -> str:
    """Return a package's template, filled with values in the common style of pages."""
    style = resources.files("calib.procedure.report").joinpath("certificate.css").read_text(encoding="utf-8")
    return _template(package, file).render(**values, style=style)


@cache
def _template(package: str, file: str) -> jinja2.Template:
    """Return the compiled template of a file, cached within a process."""
    import jinja2  # slow to load, and not needed to write the rest

    source = resources.files(package).joinpath(file).read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    environment.filters["data_uri"] = lambda png: f"data:image/png;base64,{base64.b64encode(png).decode()}"
    return environment.from_string(source)


def write_fit(outcome: Outcome, folder: Path, plots: bool = True, page: bool = True) -> None:
    """Write ``report.json``, figures, and the certificate of a fit (without a session) into its folder.

    Args:
        plots: whether there are to be figures; the certificate is written without them, too.
        page: whether there is to be a certificate.
    """
    report = fit_report.collect(outcome)
    fit_report.write(report, FitFolder(folder).report)
    drawn: Mapping[str, Picture] = {}
    if plots:
        from calib.procedure.report.geometry_figures import draw

        drawn = draw(report)
    for name, figure in drawn.items():
        files.write(folder / f"plot_{name}.png", figure.png)
    if page:
        files.write(folder / CERTIFICATE, render(of_fit(report, drawn, outcome.inputs)))


def of_fit(report: Report, drawn: Mapping[str, Picture], inputs: Inputs | None = None) -> Page:
    """Return the certificate of a fit without a session; it lists the input files if `inputs` are given."""
    rows, named = [], []
    if inputs is not None:
        measured = ", ".join(path.name for path in _measured(inputs))
        given = {inputs.source: "nominal robot", **_measured(inputs)}
        rows = [file_row(path.name, role, path) for path, role in given.items() if path.is_file()]
        named = [("description", str(inputs.source)), ("measurements", measured)]
    given = (
        ("robot", f"{report.robot}, {report.base} to {report.tip}, {len(report.joints)} joints"),
        *named,
        ("model", report.metrics.model),
        ("tolerance", tolerance(report.metrics.tolerance_mm, report.metrics)),
        ("seed", str(report.metrics.seed)),
        ("toolkit", versions()),
    )
    section = geometry_section.certificate_section(report, drawn)
    return certificate(f"Calibration of {report.robot}", "Geometry", given, [section], rows)


def _measured(inputs: Inputs) -> dict[Path, str]:
    """Return the files for fit and validation, each with its role."""
    found = {Path(block.file): "measured" for block in inputs.fit if block.file}
    for unseen in inputs.unseen.values():
        if not unseen.held_out and unseen.block.file:
            found.setdefault(Path(unseen.block.file), unseen_role("measured", unseen.seen, "the fit"))
    return found
