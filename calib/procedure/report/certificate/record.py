"""What a certificate and a report say, as records; `calib.procedure.report.certificate.rendering` makes HTML and PDF
of them.

Every word is in the record, so that HTML and PDF say the same. A certificate has at most `MAX_PAGES` pages: lists and
texts that have no bound of their own are cut at a stated number here, and the report has the whole.
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
MAX_REASON = 420  # letters of a verdict's reason on the certificate
MAX_LINE = 260  # letters of a sentence there
MAX_LINES = 8  # sentences of one kind there
MAX_FILES = 12  # files listed there
MAX_VALUE = 90  # letters of what a setup line says there
DIGEST_DIGITS = 16  # hexadecimal digits of a SHA-256 there
KNOWN = (
    "robot",
    "description",
    "instrument",
    "measurements",
    "model",
    "measured range",
    "recordings",
    "torques",
    "payloads",
    "method",
    "friction",
)
EDITED = "edited by hand"
WHOLE = "report.html"
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
    """A line of a certificate: what it is, and its value; an empty one is a line to fill in by hand."""

    label: str
    value: str = ""


@dataclass(frozen=True)
class Page:
    """A report: title, origin, and sections; the judged ones have a verdict."""

    kind: str
    title: str
    subtitle: str
    issued: str
    sections: Sequence[Section]


@dataclass(frozen=True)
class Judgement:
    """A verdict: on what, its level and the word for it, and the reason as a sentence."""

    title: str
    level: str
    word: str
    reason: str


@dataclass(frozen=True)
class Certificate(Page):
    """A certificate.

    Attributes:
        number: its number.
        alert: what has to be known first: that it is simulated.
        verdicts: one of each stage.
        asked: tolerance asked and met, for each quantity and deliverable.
        known: what the data say of robot, instrument and method.
        stated: what a person says beside that, and lines to fill in.
        signatures: who signs, and what else is written there.
        sections: one a page, with the blocks of the certificate.
    """

    number: Entry
    alert: str
    verdicts: Sequence[Judgement]
    asked: ReportTable
    known: Sequence[Entry]
    stated: Sequence[Entry]
    signatures: Sequence[str]


@dataclass(frozen=True)
class StageRecord:
    """A stage of a calibration, as report and certificate show it.

    Attributes:
        section: of the report, with verdict and key figures.
        sheet: blocks of the certificate's page on it.
        unchecked: what the data do not show.
        findings: what was noticed.
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
        setup: what was calibrated, with what and how; the certificate states `KNOWN` of it.
        unchecked: what was not checked besides what the stages say.
        files: what it rests on, see `calib.procedure.report.fit_report.file_row`; the most important ones first.
        details: what a person says beside the data.
        alert: what has to be known first.
    """
    sections, about = [one.section for one in stages], described(CertificateSection)
    number, *stated = (Entry(about[one.name], str(getattr(details, one.name))) for one in fields(details))
    known = [Entry(one.label, shortened(_local(one.value), MAX_VALUE)) for one in setup if one.label in KNOWN]
    last = [
        Text("NOT checked", [*unchecked, *(line for one in stages for line in one.unchecked)]),
        Text("Findings", [line for one in stages for line in one.findings]),
        files_table(files, MAX_FILES),
        *NOTES,
    ]
    sheets = [*((one.section.title, one.sheet) for one in stages), ("Validity", last)]
    shown = [Section(name, [_cut(one) if isinstance(one, Text) else one for one in blocks]) for name, blocks in sheets]
    return Certificate(
        "Calibration certificate",
        title,
        subtitle,
        f"issued {issued()}",
        shown,
        number,
        alert,
        [judgement(one, MAX_REASON) for one in sections if one.verdict],
        key_table(sections),
        known,
        stated,
        ("Calibrated by", "Date", "Signature", "Checked by", "Date", "Signature"),
    ), report(title, f"{f'{alert}; ' if alert else ''}{subtitle}", setup, sections, files)


def judgement(section: Section, most: int | None = None) -> Judgement:
    """Return the verdict of a section, its reason cut at `most` letters."""
    level, reason = section.verdict, f"{section.reason[:1].upper()}{section.reason[1:]}."
    word = level.replace("pass", "PASS") if "(" in level else level.upper()
    return Judgement(section.title, level, word, shortened(_local(reason), most) if most else reason)


def key_table(sections: Sequence[Section]) -> ReportTable:
    """Return the table of what verdicts rest on: before, after, tolerance asked, and whether it is met."""
    header = ("quantity", "nominal", "after", "standard error", "on", "tolerance asked", "met")
    rows = [row for one in sections if one.figures for row in ((one.title,), *map(_cells, one.figures))]
    judged = frozenset(k for k, row in enumerate(rows) if len(row) > 1 and row[5] != "–")
    return ReportTable("Tolerance asked and met", header, rows, strong=judged, numbers=(1, 2, 3, 5))


def _cells(one: KeyFigure) -> tuple[str, ...]:
    return one.quantity, one.before or "–", one.after, one.spread, one.basis, one.allowed or "–", one.met or "–"


def _cut(block: Text) -> Text:
    """Return a text of a certificate with at most `MAX_LINES` sentences of `MAX_LINE` letters; the report has all."""
    lines = [shortened(_local(line), MAX_LINE) for line in block.lines]
    more = [f"{len(lines) - MAX_LINES + 1} more: see {WHOLE}."] if len(lines) > MAX_LINES else []
    return Text(block.title, [*lines[: MAX_LINES - len(more)], *more])


def _local(text: str) -> str:
    """Return a text in which files are named without the folders of this machine."""
    return re.sub(r"(?<![\w.~/])/(?:[^/\s]+/)+(?=[^/\s])", "", text)


def files_table(files: Sequence[FileRow], most: int | None = None) -> ReportTable:
    """Return the table of files with their SHA-256, those edited by hand first; at most `most`, with short ones."""
    if most is None:
        return ReportTable("", ("file", "what it is", "bytes", "SHA-256"), files, numbers=(2,))
    first = sorted(files, key=lambda row: row[1] != EDITED)  # what was edited by hand is not hidden among the rest
    rows = [(name, role, f"{digest[:DIGEST_DIGITS]}…") for name, role, _, digest in first[:most]]
    note = f"{len(files) - most} more, and whole digests: see {WHOLE}." if len(files) > most else ""
    return ReportTable("Files", ("file", "what it is", "SHA-256"), rows, note)


def report(
    title: str, subtitle: str, setup: Sequence[Entry], sections: Sequence[Section], files: Sequence[FileRow] = ()
) -> Page:
    """Return the record of a report: verdicts, all sections, setup, files, conventions."""
    judged = [one for one in map(judgement, sections) if one.level]
    reasons = Text("Verdict", [f"{one.title}: {one.word}. {one.reason}" for one in judged])
    behind = [Section("Result", [reasons, key_table(sections)]), *sections]
    if setup:
        rows = [(one.label, one.value) for one in setup]
        behind.append(Section("Setup", [ReportTable("", ("what", "value"), rows)]))
    if files:
        behind.append(Section("Files", [files_table(files)]))
    behind.append(Section("Limitations and conventions", NOTES))
    return Page("Calibration report", title, subtitle, issued(), [one for one in behind if any(map(len, one.blocks))])
