"""Report pages: sections, tables, key figures, the certificate, and templates."""

from calib.procedure.answers import CertificateSection
from calib.procedure.report.certificate.record import Entry
from calib.procedure.report.certificate.record import report as report_page
from calib.procedure.report.certificate.rendering import html as as_html
from calib.procedure.report.certificate.rendering import write as write_certificate
from calib.procedure.report.certificate.rendering import write_figures
from calib.procedure.report.figures.figure_data import read as read_figures
from calib.procedure.report.fit_report import FittedParameter
from calib.procedure.report.fit_report import read as read_fit_report
from calib.procedure.report.outputs import figures_page
from calib.procedure.report.page import (
    Block,
    ChartPicture,
    KeyFigure,
    Picture,
    Pictures,
    RecordColumn,
    ReportTable,
    Section,
    Text,
    met,
    rendered,
    table,
)
from calib.procedure.report.page import section as printed_section
from calib.procedure.report.templates import filled, interactive, issued, script_sources
from calib.procedure.report.templates import read as read_template

__all__ = [
    "Block",
    "CertificateSection",
    "ChartPicture",
    "Entry",
    "FittedParameter",
    "KeyFigure",
    "Picture",
    "Pictures",
    "RecordColumn",
    "ReportTable",
    "Section",
    "Text",
    "as_html",
    "figures_page",
    "filled",
    "interactive",
    "issued",
    "met",
    "printed_section",
    "read_figures",
    "read_fit_report",
    "read_template",
    "rendered",
    "report_page",
    "script_sources",
    "table",
    "write_certificate",
    "write_figures",
]
