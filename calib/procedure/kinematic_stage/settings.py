"""How poses are chosen and a geometry is fitted and judged: one value for command, guided run and scripts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, get_args

from calib.arguments import Within, checked
from calib.data.poses.fit_options import FINEST, LOSSES, MODELS
from calib.errors import UsageError
from calib.procedure.measuring.run import DEFAULT_RUN, RunSettings

DELIVERABLES = ("urdf", "corrections")  # what a verdict is about: robot.urdf alone, or with joint_corrections.csv
Place = Annotated[float, Within(-100.0, 100.0)]  # of a target in the tip's frame [m]
Sigma = Annotated[float, Within(least=FINEST, most=10.0)]  # [m or rad]


def _refuse_other(option: str, value: str | None, allowed: Sequence[str | None]) -> None:
    if value not in allowed:
        raise UsageError(f"{option} {value}: expected one of {', '.join(name for name in allowed if name)}")


@checked
@dataclass(frozen=True)
class FitSettings:
    """How a geometry is fitted and judged.

    Attributes:
        model: ``auto`` climbs the ladder; else a rung of it and all below; None: as the options file says.
        loss: ``auto``, ``none``, ``huber`` or ``cauchy``; None: as the options file says.
        folds: rows the ladder sets aside: ``transfer`` (stations, files, regions), ``regions``, ``random``, ``poses``.
        stations: ``each`` file has a base placement of its own, or all share ``one``.
        tools: all files share ``one`` tool (or one set of reflectors), or ``each`` has its own.
        holdout: share of each file's poses kept from the fit: the last of ``default_rng(seed).permutation(poses)``.
        refit_frames: validation files get a base and tool placement of their own.
        tolerance: largest rms on unseen poses that is good enough [m]; None: none is stated.
        deliverable: what the verdict is about: ``urdf`` (robot.urdf alone) or ``corrections`` (with the joint
            corrections, where there are any).
        seed: of everything random.

    Raises:
        UsageError: for a value that is none of these.
    """

    model: str | None = None
    loss: str | None = None
    folds: str = "transfer"
    stations: str = "each"
    tools: str = "one"
    holdout: float = 0.0
    refit_frames: bool = False
    tolerance: float | None = None
    deliverable: str = DELIVERABLES[0]
    seed: int = 0

    def __post_init__(self) -> None:
        for option, allowed in (
            ("model", (None, *MODELS)),
            ("loss", (None, *LOSSES)),
            ("stations", ("each", "one")),
            ("tools", ("one", "each")),
            ("deliverable", DELIVERABLES),
        ):
            _refuse_other(option, getattr(self, option), allowed)
        if not 0.0 <= self.holdout < 1.0:
            raise UsageError(f"holdout {self.holdout:g}: expected a share from 0 to below 1")
        if self.tolerance is not None and not 0.0 < self.tolerance < float("inf"):
            raise UsageError(f"tolerance {1e3 * self.tolerance:g} mm: expected a length above 0")
        if self.seed < 0:
            raise UsageError(f"seed {self.seed}: expected a whole number from 0")


@checked
@dataclass(frozen=True)
class SelectionSettings:
    """How poses to measure are chosen.

    Attributes:
        kind: what will be measured, ``pose`` or ``position``.
        tools: places of the targets in the tip's frame [m]; the tip itself where none is given.
        index: ``O1`` to ``O5``, or ``cond``, see `poses.indices`.
        method: see `poses.select.select_poses`. Polishing raises the index by 0.1 to 0.6 %, which knows
            nothing of deflections: virtual LWR4+ and UR5 with errors that a model can hold, 40 poses, 6 seeds each,
            kept 0.09 mm rms with ``detmax`` and 0.12 mm with ``polish``.
        candidates: poses to draw.
        sigmas: of a position [m] and an orientation [rad]; None for equal ones of our choice.
        seed: of everything random.
        starts: random sets of multistart.
        evaluations: most evaluations of the index in one local search.
        seconds: of processor time for the search; None lets it end by itself.
        climbs: searches for feasible poses beyond the bound; 0 bounds the candidates and the chosen poses only.
        without: defaults that poses need not keep, and what the cell does not have
            (`calib.procedure.measuring.constraints_file`).
        run: how fast the poses are driven, and how long each is measured.
    """

    kind: str = "pose"
    tools: tuple[tuple[Place, ...], ...] = ()
    index: str = "O1"
    method: str = "detmax"
    candidates: Annotated[int, Within(1, 1_000_000)] = 2000
    sigmas: tuple[Sigma, Sigma] | None = None
    seed: Annotated[int, Within(0, 2**63)] = 0
    starts: int = 8
    evaluations: int = 5000
    seconds: float | None = None
    climbs: int = 0
    without: tuple[str, ...] = ()
    run: RunSettings = DEFAULT_RUN

    def __post_init__(self) -> None:
        _refuse_other("kind", self.kind, ("pose", "position"))
        if (self.index, self.method) != ("O1", "detmax"):  # the defaults load nothing: the command line is quick
            from poses.indices import Index
            from poses.select import Method

            _refuse_other("index", self.index, get_args(Index))
            _refuse_other("method", self.method, get_args(Method))
        for option, least in (("starts", 1), ("evaluations", 1), ("climbs", 0)):
            if (value := getattr(self, option)) < least:
                raise UsageError(f"{option} {value}: expected at least {least}")
        if self.seconds is not None and not self.seconds > 0.0:
            raise UsageError(f"seconds {self.seconds:g}: expected a time above 0")


DEFAULT_SELECTION = SelectionSettings()
