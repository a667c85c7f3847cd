"""How poses are chosen and a geometry is fitted and judged: one value for command, guided run and scripts."""

from dataclasses import dataclass
from typing import Annotated

from calib.arguments import checked
from calib.config_types import Expect, Flag, Holdout, OneOf, Positive, Real, Seed, Text, Typed, Whole
from calib.data.poses.choices import MIN_SIGMA, Loss, Model
from calib.procedure.measuring.run_settings import DEFAULT_RUN, RunSettings

DELIVERABLES = ("urdf", "corrections")  # what a verdict is about: robot.urdf alone, or with joint_corrections.csv
Place = Annotated[float, Real(least=-100.0, most=100.0, unit="m", quantity="length")]  # of a target in the tip's frame
Point = Annotated[tuple[Place, Place, Place], Expect("x,y,z [m]")]
Sigma = Annotated[float, Real(above=0.0, least=MIN_SIGMA, most=10.0, unit="m or rad", quantity="1")]
Stations = Annotated[str, OneOf(("each", "one"))]
Deliverable = Annotated[str, OneOf(DELIVERABLES)]
Index = Annotated[str, OneOf("poses.indices:Index")]
Method = Annotated[str, OneOf("poses.select:Method")]


@checked
@dataclass(frozen=True)
class FitSettings:
    """How a geometry is fitted and judged.

    Attributes:
        model: which rung of the ladder and all below it; auto climbs it. Default: as the options file says
        loss: how residuals count. Default: as the options file says
        folds: rows that the ladder sets aside: transfer (stations, files, regions), regions, random or poses
        stations: base placement: each file its own, or one for all
        tools: one tool (or set of reflectors) for all files, or each its own
        holdout: share of each file's poses kept from the fit: the last of ``default_rng(seed).permutation(poses)``
        refit_frames: validation files get a base and tool placement of their own
        tolerance: largest rms on unseen poses [m; on the command line mm]; above it the verdict is fail
        deliverable: what the verdict is about: urdf (robot.urdf alone), or corrections (with joint_corrections.csv)
        seed: reproduces everything random

    Raises:
        UsageError: for a value that is none of these.
    """

    model: Model | None = None
    loss: Loss | None = None
    folds: Text = "transfer"
    stations: Stations = "each"
    tools: Stations = "one"
    holdout: Holdout = 0.0
    refit_frames: Flag = False
    tolerance: Annotated[float, Real(above=0.0, quantity="length"), Typed(unit="mm")] | None = None
    deliverable: Deliverable = DELIVERABLES[0]
    seed: Seed = 0


@checked
@dataclass(frozen=True)
class SelectionSettings:
    """How poses to measure are chosen.

    Polishing raises the index by 0.1 to 0.6 %, which knows nothing of deflections: virtual LWR4+ and UR5 with errors
    that a model can hold, 40 poses, 6 seeds each, kept 0.09 mm rms with ``detmax`` and 0.12 mm with ``polish``.

    Attributes:
        kind: what will be measured
        tools: x,y,z of a target in the tip's frame [m], several of them for several targets; default the tip itself
        index: observability index that is maximised: O1 to O5, or cond, which is minimised
        method: detmax, polish, local, multistart or tabu
        candidates: poses to choose from
        sigmas: of a position [m] and an orientation [rad], e.g. 1e-4,1e-4; default equal ones
        seed: reproduces everything random
        starts: random sets that multistart begins at
        evaluations: most evaluations of the index in one local search
        seconds: processor time for the search [s]; without: to its end
        climbs: searches for feasible poses beyond the bound; 0: it covers the candidates only
        without: self-collision, floor, joint-margin, view: not kept; instrument, box, obstacles: not there
        run: how fast the poses are driven, and how long each is measured
    """

    kind: Annotated[str, OneOf(("pose", "position"))] = "pose"
    tools: tuple[Point, ...] = ()
    index: Index = "O1"
    method: Method = "detmax"
    candidates: Annotated[int, Whole(1, 1_000_000)] = 2000
    sigmas: tuple[Sigma, Sigma] | None = None
    seed: Seed = 0
    starts: Annotated[int, Whole(1)] = 8
    evaluations: Annotated[int, Whole(1)] = 5000
    seconds: Positive | None = None
    climbs: Annotated[int, Whole(0)] = 0
    without: tuple[str, ...] = ()
    run: RunSettings = DEFAULT_RUN


DEFAULT_SELECTION = SelectionSettings()
