"""Contents of a certificate and a report as records, which `calib.procedure.report.certificate.rendering` renders.

The records contain all words, so that HTML and PDF have the same text. A certificate has at most `MAX_PAGES` pages:
lists and texts of unlimited length are shortened in this module to a fixed number of entries or letters. The report
contains them completely.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields

from calib.config import described
from calib.procedure.answers import CertificateSection
from calib.procedure.report.page import Block, FileRow, KeyFigure, ReportTable, Section, Text, shortened
from calib.procedure.report.templates import issued

MAX_PAGES = 4
# Bounds of the certificate; the report has the whole.
# letters of a verdict's reason
MAX_REASON = 420
# letters of a sentence
MAX_LINE = 260
# sentences of one kind
MAX_LINES = 8
# files listed
MAX_FILES = 12
# letters of what a setup line says
MAX_VALUE = 90
# hexadecimal digits of a SHA-256
DIGEST_DIGITS = 16
# lines of the setup that a certificate states
CERTIFIED_SETUP = (
    "robot",
    "description",
    "instrument",
    "measurements",
    "model",
    "measured range",
    "load",
    "recordings",
    "torques",
    "payloads",
    "method",
    "friction",
)
EDITED = "edited by hand"
REPORT = "report.html"
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
NO_DETAILS = CertificateSection()
NOTES = (Text("Limitations", LIMITATIONS), Text("Conventions", CONVENTIONS))


@dataclass(frozen=True)
class Entry:
    """A line of a certificate: label and value; an empty value is a blank line to be filled in by hand."""

    label: str
    value: str = ""


@dataclass(frozen=True)
class Page:
    """A report: kind, title, subtitle, date of issue, and sections; a section on a calibration stage has a verdict."""

    kind: str
    title: str
    subtitle: str
    issued: str
    sections: Sequence[Section]


@dataclass(frozen=True)
class Judgement:
    """A verdict as printed: title of what is judged, level, label of the level, and the reason as a sentence."""

    title: str
    level: str
    label: str
    reason: str


@dataclass(frozen=True)
class Certificate(Page):
    """A calibration certificate.

    Attributes:
        number: number of the certificate.
        alert: warning at the top, such as that the results are simulated; empty: no warning.
        verdicts: verdict on each stage.
        tolerances: table of requested tolerances, by quantity and deliverable, and whether they are met.
        setup: robot, instrument and method, as stated in the results.
        details: entries made by a person, and blank lines to fill in.
        signatures: labels of the signature fields.
        sections: pages of the certificate, one per section.
    """

    number: Entry
    alert: str
    verdicts: Sequence[Judgement]
    tolerances: ReportTable
    setup: Sequence[Entry]
    details: Sequence[Entry]
    signatures: Sequence[str]


@dataclass(frozen=True)
class StageRecord:
    """Content of report and certificate on one stage of a calibration (geometry or dynamics).

    Attributes:
        section: section of the report, with verdict and key figures.
        sheet: content of the certificate's page on the stage.
        unchecked: texts on the properties that the measurements cannot prove.
        findings: texts of the findings.
    """

    section: Section
    sheet: Sequence[Block]
    unchecked: Sequence[str] = ()
    findings: Sequence[str] = ()


def records(
    title: str,
    subtitle: str,
    setup: Sequence[Entry],
    stages: Sequence[StageRecord],
    unchecked: Sequence[str] = (),
    files: Sequence[FileRow] = (),
    details: CertificateSection = NO_DETAILS,
    alert: str = "",
) -> tuple[Certificate, Page]:
    """Return certificate and report of a calibration.

    Args:
        title, subtitle: title and subtitle of both documents.
        setup: robot, instrument and method; the certificate contains only the entries of `CERTIFIED_SETUP`.
        stages: contents on the stages.
        unchecked: texts on unproven properties in addition to those of the stages.
        files: input files (name, role, size in bytes, SHA-256), the most important ones first.
        details: entries made by a person.
        alert: warning at the top; empty: no warning.
    """
    certified = []
    for entry in setup:
        if entry.label in CERTIFIED_SETUP:
            value = shortened(_local(entry.value), MAX_VALUE)
            certified.append(Entry(entry.label, value))
    # the first detail is the certificate's number
    labels = described(CertificateSection)
    number, *stated_details = (
        Entry(labels[field.name], str(getattr(details, field.name))) for field in fields(details)
    )

    sections = [stage.section for stage in stages]
    unchecked, findings = list(unchecked), []
    pages = []
    for stage in stages:
        unchecked += stage.unchecked
        findings += stage.findings
        pages.append(_certificate_page(stage.section.title, stage.sheet))
    validity = [Text("NOT checked", unchecked), Text("Findings", findings), files_table(files, MAX_FILES), *NOTES]
    pages.append(_certificate_page("Validity", validity))
    certificate = Certificate(
        kind="Calibration certificate",
        title=title,
        subtitle=subtitle,
        issued=f"issued {issued()}",
        sections=pages,
        number=number,
        alert=alert,
        verdicts=[judgement(section, MAX_REASON) for section in sections if section.verdict],
        tolerances=key_table(sections),
        setup=certified,
        details=stated_details,
        signatures=("Calibrated by", "Date", "Signature", "Checked by", "Date", "Signature"),
    )
    if alert:
        subtitle = f"{alert}; {subtitle}"
    return certificate, report(title, subtitle, setup, sections, files)


def _certificate_page(title: str, blocks: Sequence[Block]) -> Section:
    """Return a page of a certificate, with texts shortened to the allowed number of letters.

    Args:
        title: title of the page.
        blocks: its content.
    """
    return Section(title, [_cut(block) if isinstance(block, Text) else block for block in blocks])


def judgement(section: Section, max_letters: int | None = None) -> Judgement:
    """Return the verdict of a section for printing; the reason is cut at `max_letters` (None: not cut)."""
    level = section.verdict
    label = level.upper()
    if "(" in level:
        # what stands in brackets keeps its letters
        label = level.replace("pass", "PASS")
    reason = f"{section.reason[:1].upper()}{section.reason[1:]}."
    if max_letters is not None:
        reason = shortened(_local(reason), max_letters)
    return Judgement(section.title, level, label, reason)


def key_table(sections: Sequence[Section]) -> ReportTable:
    """Return the table of key figures: nominal value, calibrated value, requested tolerance, and whether it is met.

    Args:
        sections: sections of the report, with key figures.
    """
    header = ("quantity", "nominal", "after", "standard error", "on", "tolerance asked", "met")
    rows, with_tolerance = [], set()
    for section in sections:
        if section.figures:
            rows.append((section.title,))
        for figure in section.figures:
            if figure.allowed and figure.allowed != "–":
                with_tolerance.add(len(rows))
            rows.append(_cells(figure))
    return ReportTable("Tolerance asked and met", header, rows, strong=frozenset(with_tolerance), numbers=(1, 2, 3, 5))


def _cells(figure: KeyFigure) -> tuple[str, ...]:
    before, allowed, met = figure.before or "–", figure.allowed or "–", figure.met or "–"
    return figure.quantity, before, figure.after, figure.spread, figure.basis, allowed, met


def _cut(block: Text) -> Text:
    """Return the text `block` of a certificate shortened to `MAX_LINES` sentences of at most `MAX_LINE` letters."""
    lines = [shortened(_local(str(line)), MAX_LINE) for line in block.lines]
    if len(lines) > MAX_LINES:
        count = len(lines) - MAX_LINES + 1
        lines = [*lines[: MAX_LINES - 1], f"{count} more: see {REPORT}."]
    return Text(block.title, lines)


def _local(text: str) -> str:
    """Return a text in which file names replace absolute paths, since paths of this machine mean nothing elsewhere."""
    return re.sub(r"(?<![\w.~/])/(?:[^/\s]+/)+(?=[^/\s])", "", text)


def files_table(files: Sequence[FileRow], max_files: int | None = None) -> ReportTable:
    """Return the table of files with their SHA-256 digests.

    Args:
        files: the files.
        max_files: largest number of files; files edited by hand are listed first, and digests are shortened; None: all
            files, with complete digests.
    """
    if max_files is None:
        return ReportTable("", ("file", "what it is", "bytes", "SHA-256"), files, numbers=(2,))
    # what was edited by hand is not hidden among the others
    edited_first = sorted(files, key=lambda row: row[1] != EDITED)
    rows = []
    for name, role, _, digest in edited_first[:max_files]:
        rows.append((name, role, f"{digest[:DIGEST_DIGITS]}…"))
    note = ""
    if len(files) > max_files:
        note = f"{len(files) - max_files} more, and whole digests: see {REPORT}."
    return ReportTable("Files", ("file", "what it is", "SHA-256"), rows, note)


def report(
    title: str, subtitle: str, setup: Sequence[Entry], sections: Sequence[Section], files: Sequence[FileRow] = ()
) -> Page:
    """Return the record of a report: verdicts, all sections, setup, files, limitations and conventions.

    Args:
        title, subtitle: title and subtitle of the report.
        setup: robot, instrument and method.
        sections: sections on the stages.
        files: input files; empty: no list of files.
    """
    verdicts = [judgement(section) for section in sections if section.verdict]
    reasons = [f"{verdict.title}: {verdict.label}. {verdict.reason}" for verdict in verdicts]
    report_sections = [Section("Result", [Text("Verdict", reasons), key_table(sections)]), *sections]
    if setup:
        rows = [(entry.label, entry.value) for entry in setup]
        report_sections.append(Section("Setup", [ReportTable("", ("what", "value"), rows)]))
    if files:
        report_sections.append(Section("Files", [files_table(files)]))
    report_sections.append(Section("Limitations and conventions", NOTES))
    filled = [section for section in report_sections if any(len(block) for block in section.blocks)]
    return Page("Calibration report", title, subtitle, issued(), filled)
