"""Command that writes the certificate of a result again, and figures as SVG: certificate."""

from pathlib import Path

import typer

from calib.cli.shared import command, say
from calib.errors import UsageError, command_line, require
from calib.procedure.answers import CertificateSection

app = typer.Typer()


@command(app, "Files and studies")
def certificate(folder: Path, details: CertificateSection, svg: Path | None = None, plots: bool = True) -> None:
    """Write a result's certificate and report again.

    For a fit or an identification, stating serial numbers, operator …. Of a session, session.toml has these details,
    under [certificate]; here only --svg applies.

    Example: calib certificate fit --robot-serial 4711 --operator "A. Weber"

    Args:
        folder: of a fit, an identification, or a finished session
        svg: folder for all figures of the report as SVG
    """
    from calib.folders import PAGES, SESSION
    from calib.procedure.report.certificate import rendering, results
    from calib.procedure.session import certificate as session
    from calib.procedure.session.folder import open_session

    if (folder / SESSION).exists():
        redo = command_line("redo", folder, "certificate")
        words = f"{folder / SESSION} has the details, under [certificate]; then: {redo}"
        require(details == CertificateSection() and svg is not None, words, UsageError)
        whole = session.pages(open_session(folder))[1]
    else:
        one, whole = results.read(folder, plots, details)
        say(*rendering.write(folder, one, whole), f"written: {', '.join(str(folder / name) for name in PAGES)}")
    if svg is not None:
        say(f"{rendering.write_figures(svg, whole)} figures written to {svg}")
