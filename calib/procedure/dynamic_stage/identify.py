"""Identification of the guided procedure: reading, identification, prediction of other motion, verdict."""

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
    """Outcome of an identification: the model, its errors on the recordings, its verdict, and its inputs.

    Attributes:
        inputs: robot, recordings and options.
        found: the model and its estimation.
        findings: findings on the model that the verdict needs besides the recordings.
        carried: effect of the geometry's uncertainty; None if it was not requested.
        geometries: comparison with the estimate on the nominal geometry; None if the geometry is nominal.
        errors: expected torque errors; None if too little was recorded to estimate them.
        seed: of all random numbers.
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
    """Return the outcome of an identification: the model, its prediction of every recording, and the verdict."""
    return judged(inputs, identify(inputs.robot, inputs.cases, inputs.options.settings, progress), progress)


def judged(
    inputs: IdentificationInputs, found: Identification, progress: Progress | None = None
) -> IdentificationOutcome:
    """Return the outcome of an identification `found`: its prediction of every recording, and the verdict.

    Raises:
        MeasurementError: where friction would drive most joints.
    """
    say = progress or (lambda words: None)
    wrong = driven(found.dynamics, inputs.cases)  # refused before hours go into the geometry's share
    carried, geometries = _carry(inputs, found, say)
    loops = found.bias.loops
    say("errors on held-out time")
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
    """Return an outcome with a new verdict on the unseen recordings of `inputs`; nothing is identified."""
    if (stage := stage_of(inputs.robot, "identify")) is not None and stage.judge is not None:
        result = stage.judge(inputs, outcome.found, outcome.findings)
    else:
        result = assess(inputs, outcome.found.dynamics, outcome.findings, outcome.errors)
    return replace(outcome, inputs=inputs, **vars(result))


def _carry(
    inputs: IdentificationInputs, found: Identification, say: Progress
) -> tuple[GeometryUncertainty, GeometryComparison | None]:
    """Return the effect of the geometry's uncertainty on the estimate, and the comparison with the nominal geometry."""
    carried = propagate(found, inputs.robot, inputs.cases, say)
    if inputs.robot.nominal is None or not inputs.robot.moved:
        return carried, None
    say("the same on the nominal geometry")
    return carried, compare(found, carried, inputs.robot.nominal, inputs.cases)
