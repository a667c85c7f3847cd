"""Command that writes the certificate of a result again, and figures as SVG: certificate."""

from pathlib import Path

import typer

from calib.cli.shared import command, say
from calib.errors import UsageError, command_line
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
        if details != CertificateSection() or svg is None:
            redo = command_line("redo", folder, "certificate")
            raise UsageError(f"{folder / SESSION} has the details, under [certificate]; then: {redo}")
        _, report = session.pages(open_session(folder))
    else:
        page, report = results.read(folder, plots, details)
        notes = rendering.write(folder, page, report)
        paths = ", ".join(str(folder / name) for name in PAGES)
        say(*notes, f"written: {paths}")
    if svg is not None:
        count = rendering.write_figures(svg, report)
        say(f"{count} figures written to {svg}")
