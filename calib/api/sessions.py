"""Guided sessions in Python: one folder per robot, created once, run as far as possible."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from calib.api.rendering import listed, optional
from calib.arguments import checked
from calib.procedure.robot_kinds import stage_of
from calib.procedure.session import commands, fleet


@checked
def new_session(
    folder: str | Path,
    robot: str | Path,
    instrument: str,
    *,
    poses: int = 40,
    validation: int = 20,
    tool: Sequence[float] | None = None,
    limits: str | Path | Mapping[str, Any] | None = None,
    dynamics: bool = True,
    base: str = "",
    tip: str = "",
    seed: int = 0,
    **motion: Any,
) -> Path:
    """Create the folder of a guided session for a robot, like `calib new`.

    Args:
        folder: new.
        robot, base, tip: as of `calib.load`.
        instrument: ``cmm``, ``tracker``, ``tracker6d``, ``mocap``, ``camera``, ``other-pose``, ``other-position``, or
            ``none``: dynamics alone, the robot's description taken as calibrated.
        poses, validation: how many to choose for the fit, and to measure and never fit.
        tool: (3,) where the target roughly sits in the tip's frame [m].
        limits: TOML file that both poses and motions keep (``calib formats limits``), or its tables.
        dynamics: identify the dynamics, too.
        seed: of everything random.
        motion: other keys of ``[dynamics]`` (``calib formats session``): torques, payloads, period …

    Returns:
        The folder; its ``session.toml`` says how the session goes on.

    Raises:
        UsageError: where the folder is in use, or a value is none of these.
    """
    stage_of(robot, "a guided session")
    known = limits if isinstance(limits, Mapping) else optional(limits)
    made = commands.begin(
        Path(folder), str(robot), instrument, poses, validation, seed, base=base, tip=tip, tool=tool, limits=known,
        dynamics=dynamics, motion=motion,
    )  # fmt: skip
    return made.folder


@checked
def run_sessions(
    folders: str | Path | Sequence[str | Path],
    *,
    workers: str | int = 1,
    plots: bool = True,
    command: str = "calib.run_sessions",
) -> Iterator[fleet.FleetRow]:
    """Run sessions as far as possible, and yield the outcome of each; failures do not stop the others.

    Args:
        folders: of the sessions, or their ``session.toml``; one or several.
        workers: local processes, or the address of a Dask scheduler.
        plots: whether figures are drawn.
        command: for the sessions' records.

    Returns:
        Rows as sessions end: ``folder``, ``state`` (done, waits or failed), ``verdict``; ``print`` says what to do now.

    Raises:
        UsageError: for a session that is named twice, or where none is.
    """
    return _run(fleet.folders_of([Path(each) for each in listed(folders)]), workers, command, plots)


def _run(folders: list[Path], workers: str | int, command: str, plots: bool) -> Iterator[fleet.FleetRow]:
    from calib.workers import workers as opened

    with opened(workers) as crew:
        yield from fleet.run(folders, crew, command, plots)
