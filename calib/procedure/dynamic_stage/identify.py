"""The identification as the guided procedure runs it: read, identify, predict other motion, say how far to trust it."""

from dataclasses import dataclass, replace
from typing import TypeVar

from calib.identification.friction.passivity import driven
from calib.identification.identify import Identification, identify
from calib.identification.possible.solve import contradiction
from calib.identification.uncertainty.geometry_uncertainty import (
    GeometryComparison,
    GeometryUncertainty,
    compare,
    propagate,
)
from calib.identification.uncertainty.torque_errors import TorqueErrorModel, learn_torque_errors
from calib.procedure.dynamic_stage.inputs import IdentificationInputs, Progress
from calib.procedure.dynamic_stage.validation import Assessment, ModelFindings, assess
from calib.procedure.dynamic_stage.verdict import model_findings, resting_parameters
from calib.procedure.robot_kinds import stage_of
from calib.units import TORQUE


@dataclass(frozen=True, eq=False, kw_only=True)
class IdentificationOutcome(Assessment):
    """What an identification came to: the model beside the recordings, its verdict, and how it came about.

    Attributes:
        inputs: what it worked on.
        found: the model and how it came about.
        findings: what a verdict needs of it beside the recordings.
        carried: what the geometry's uncertainty adds; None for an identification that was not asked for it.
        geometries: the estimate on the nominal geometry beside it; None where there is no other than the nominal.
        errors: what errors the torques are expected to have; None where too little was recorded to say.
        seed: that reproduces it.
    """

    inputs: IdentificationInputs
    found: Identification
    findings: ModelFindings
    carried: GeometryUncertainty | None = None
    geometries: GeometryComparison | None = None
    errors: TorqueErrorModel | None = None
    seed: int = 0


T = TypeVar("T", bound=IdentificationOutcome)


def run(inputs: IdentificationInputs, progress: Progress | None = None) -> IdentificationOutcome:
    """Identify, predict every recording, and judge."""
    return judged(inputs, identify(inputs.robot, inputs.cases, inputs.options.settings, progress), progress)


def judged(
    inputs: IdentificationInputs, found: Identification, progress: Progress | None = None
) -> IdentificationOutcome:
    """Predict every recording by the training data the inputs, and judge.

    Raises:
        MeasurementError: where friction would drive most joints.
    """
    say = progress or (lambda words: None)
    wrong = driven(found.dynamics, inputs.cases)  # refused before hours go into the geometry's share
    carried, geometries = _carry(inputs, found, say)
    loops = found.bias.loops
    say("errors on time left out")
    errors = learn_torque_errors(found, inputs.cases, carried.covariance)
    findings = ModelFindings(
        resting_parameters(found), (), model_findings(inputs.cases, found),
        None if loops is None else loops.controller, errors and errors.discrepancy,
        contradiction(found, inputs.chain) if inputs.unit == TORQUE else None, found.unlike,
    )  # fmt: skip
    result = assess(inputs, found.dynamics, findings, errors, wrong, progress=say)
    return IdentificationOutcome(
        **vars(result), inputs=inputs, found=found, findings=findings, carried=carried, geometries=geometries,
        errors=errors, seed=found.settings.seed,
    )  # fmt: skip


def assessed(outcome: T, inputs: IdentificationInputs) -> T:
    """Return an outcome judged anew on the unseen recordings of `inputs`; nothing is identified."""
    if (stage := stage_of(inputs.robot, "identify")) is not None and stage.judge is not None:
        result = stage.judge(inputs, outcome.found, outcome.findings)
    else:
        result = assess(inputs, outcome.found.dynamics, outcome.findings, outcome.errors)
    return replace(outcome, inputs=inputs, **vars(result))


def _carry(
    inputs: IdentificationInputs, found: Identification, say: Progress
) -> tuple[GeometryUncertainty, GeometryComparison | None]:
    """Return what the geometry's uncertainty adds to the estimate, and the estimate on the nominal geometry beside."""
    carried = propagate(found, inputs.robot, inputs.cases, say)
    if inputs.robot.nominal is None or not inputs.robot.moved:
        return carried, None
    say("the same on the nominal geometry")
    return carried, compare(found, carried, inputs.robot.nominal, inputs.cases)
