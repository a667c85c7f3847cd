"""The dynamics: identify."""

from pathlib import Path
from typing import Any

import typer

from calib.cli.options import command
from calib.cli.shared import Out, Seed, progress, say, say_written

app = typer.Typer()


@command(app, "identify")
def identify_dynamics(
    robot: str,
    recordings: list[str],
    out: Out,
    validate: list[str] | None = None,
    method: str | None = None,
    friction: str | None = None,
    options: Path | None = None,
    excitation: Path | None = None,
    base: str | None = None,
    tip: str | None = None,
    seed: Seed = 0,
    plots: bool = True,
) -> None:
    """Identify ROBOT's dynamics from recordings, and judge them. What counts is how well other motion is predicted.

    Args:
        recordings: recordings of q and torque or current; log.npz@0:9.4 cuts
        out: folder for the identified model and its report
        validate: recording of other motion; may be repeated
        method: wls and others: calib study --list-methods
        friction: auto, standard, or one rung: load, presliding, cable, stribeck, ...
        options: TOML: drives, payloads, gains, filters, how to identify
        excitation: folder of calib excite: what it predicted is held against what is found
    """
    from calib.api.dynamic import identify_dynamics as identified
    from calib.cli.destination import check_destination
    from calib.procedure.report import console as shown
    from calib.procedure.report import dynamics_section

    check_destination("identify", robot, out, [options, *recordings, *(validate or [])])
    if excitation is not None:
        from calib.procedure.excitation import prediction

        prediction.check_folder(excitation)

    def read(given: Any) -> None:
        check_destination("identify", robot, out, [given.source, given.source.parent])
        say(*shown.rendered(dynamics_section.read_blocks(given)))

    with progress() as show:
        found = identified(
            robot, recordings, validate=validate or (), method=method, friction=friction, options=options, base=base,
            tip=tip, seed=seed, on_read=read, progress=show,
        )  # fmt: skip
        show("writing")
        found.save(out, plots=plots)
    compared = []
    if excitation is not None:
        from calib.procedure.excitation import prediction

        compared = [prediction.compared_with_identification(excitation, found)]
    say_written([*found.renderables(), *compared], out, found.verdict.level)
