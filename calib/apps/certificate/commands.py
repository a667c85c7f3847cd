"""Command that writes the certificate of a result again, and figures as SVG: certificate."""

from pathlib import Path

import typer

from calib.cli.shared import command, say
from calib.config_types import Plots
from calib.toolkit import CertificateSection

app = typer.Typer()


@command(app, "Files and studies")
def certificate(folder: Path, details: CertificateSection, svg: Path | None = None, plots: Plots = True) -> None:
    """Write a result's certificate and report again.

    For a fit or an identification, stating serial numbers, operator …. Of a session, session.toml has these details,
    under [certificate]; here only --svg applies.

    Example: calib certificate fit --robot-serial 4711 --operator "A. Weber"

    Args:
        folder: of a fit, an identification, or a finished session
        svg: folder for all figures of the report as SVG
    """
    from calib.toolkit.result_folders import open_result

    say(*open_result(folder, "certificate").certify(details, plots, svg))
