"""Settings of pose selection and geometric fit, shared by commands, guided procedure and scripts."""

from dataclasses import dataclass
from typing import Annotated

from calib.arguments import checked
from calib.config_types import Expect, Flag, Holdout, OneOf, Positive, Real, Seed, Text, Tolerance, Typed, Whole
from calib.data.poses import MIN_SIGMA, Loss, Model
from calib.procedure.measuring import DEFAULT_RUN, RunSettings

# what a verdict is about: robot.urdf alone, or with joint_corrections.csv
DELIVERABLES = ("urdf", "corrections")
# position of a target in the tip's frame
Coordinate = Annotated[float, Real(least=-100.0, most=100.0, unit="m", quantity="length")]
Point = Annotated[tuple[Coordinate, Coordinate, Coordinate], Expect("x,y,z [m]")]
Sigma = Annotated[float, Real(above=0.0, least=MIN_SIGMA, most=10.0, unit="m or rad", quantity="1")]
Stations = Annotated[str, OneOf(("each", "one"))]
Load = Annotated[float, Real(least=0.0, most=1000.0, unit="kg", quantity="1")]
Deliverable = Annotated[str, OneOf(DELIVERABLES)]
Index = Annotated[str, OneOf("calib.poses.indices:Index")]
Method = Annotated[str, OneOf("calib.poses.select:Method")]


@checked
@dataclass(frozen=True)
class FitSettings:
    """Settings of a geometric fit and its verdict.

    Attributes:
        model: largest model of the ladder to fit; auto selects it. Default: from the options file
        loss: loss function of the residuals. Default: from the options file
        folds: cross-validation folds of the ladder: transfer (stations, files, regions), regions, random or poses
        stations: one base placement for each file, or one for all
        tools: one tool (or set of reflectors) for all files, or one for each
        holdout: share of each file's poses held out of the fit, drawn at random by the seed
        refit_frames: fit base and tool placement of the validation files separately
        tolerance: largest rms on unseen poses [m; on the command line mm]; above it the verdict is fail
        deliverable: subject of the verdict: urdf (robot.urdf alone), or corrections (with joint_corrections.csv)
        seed: reproduces everything random
        masses: folder of an identification: compliance is fitted to its gravity torques, not to the description's
        compliance: joint_compliance.csv of an identification: compliance of joints, with its σ as prior

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
    tolerance: Tolerance = None
    deliverable: Deliverable = DELIVERABLES[0]
    seed: Seed = 0
    masses: Text = ""
    compliance: Text = ""


@checked
@dataclass(frozen=True)
class SelectionSettings:
    """Settings of the selection of poses to measure.

    Polishing raises the index by 0.1 to 0.6 %, but the index ignores deflections: virtual LWR4+ and UR5 with errors
    that a model can explain (40 poses, 6 seeds each) kept 0.09 mm rms with ``detmax`` and 0.12 mm with ``polish``.

    Attributes:
        kind: quantity that will be measured
        tools: x,y,z of a target in the tip's frame [m], repeated for several targets; default the tip itself
        index: observability index to maximise (O1 to O5), or cond to minimise
        method: search method: detmax, polish, local, multistart, mlsl (NLopt's, global) or tabu
        candidates: number of poses to choose from
        loads: masses at the tip [kg], 0 for none, e.g. 0,2.5: the poses and their loads are to tell compliance, too
        sigmas: measurement σ of a position [m] and an orientation [rad], e.g. 1e-4,1e-4; default equal ones
        reference: a frame on the robot's base is measured beside the target, with the same σ: the noise of both counts
        seed: reproduces everything random
        starts: number of random starting sets of multistart
        evaluations: largest number of index evaluations in one local search
        seconds: processor time for the search [s]; default unlimited
        climbs: searches for feasible poses that exceed the bound; 0: the bound covers the candidates only
        without: to ignore: self-collision, floor, joint-margin, view (limits); instrument, box, obstacles (objects)
        run: speed between poses, and measuring time at each
    """

    kind: Annotated[str, OneOf(("pose", "position"))] = "pose"
    tools: tuple[Point, ...] = ()
    index: Index = "O1"
    method: Method = "detmax"
    candidates: Annotated[int, Whole(1, 1_000_000)] = 2000
    loads: Annotated[tuple[Load, ...], Typed("--loads")] = ()
    sigmas: tuple[Sigma, Sigma] | None = None
    reference: Flag = False
    seed: Seed = 0
    starts: Annotated[int, Whole(1)] = 8
    evaluations: Annotated[int, Whole(1)] = 5000
    seconds: Positive | None = None
    climbs: Annotated[int, Whole(0)] = 0
    without: tuple[str, ...] = ()
    run: RunSettings = DEFAULT_RUN


DEFAULT_SELECTION = SelectionSettings()
