"""The identification as the guided procedure runs it: read, identify, predict other motion, say how far to trust it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from calib.data.signals.persistency import ExcitationReport, report_excitation
from calib.identification.friction.passivity import driven
from calib.identification.identify import Identification, identify
from calib.identification.possible.solve import contradiction
from calib.identification.scores import Score
from calib.identification.uncertainty.geometry_uncertainty import (
    GeometryComparison,
    GeometryUncertainty,
    compare,
    propagate,
)
from calib.identification.uncertainty.torque_errors import TorqueErrorModel, learn_torque_errors
from calib.procedure.dynamic_stage.inputs import IdentificationInputs, Progress
from calib.procedure.dynamic_stage.tracking import Tracking
from calib.procedure.dynamic_stage.validation import Assessment, ModelFindings, assess
from calib.procedure.dynamic_stage.verdict import model_warnings, resting_parameters
from calib.procedure.findings import Verdict
from calib.procedure.robot_kinds import stage_of
from calib.units import TORQUE


@dataclass(frozen=True, eq=False)
class IdentificationOutcome:
    """What an identification came to.

    Attributes:
        inputs: what it worked on.
        found: the model and how it came about.
        findings: what a verdict needs of it beside the recordings.
        assessment: the model beside the recordings, and the verdict.
        carried: what the geometry's uncertainty adds; None for an identification that was not asked for it.
        geometries: the estimate on the nominal geometry beside it; None where there is no other than the nominal.
        errors: what errors the torques are expected to have; None where too little was recorded to say.
        seed: that reproduces it.
    """

    inputs: IdentificationInputs
    found: Identification
    findings: ModelFindings
    assessment: Assessment
    carried: GeometryUncertainty | None = None
    geometries: GeometryComparison | None = None
    errors: TorqueErrorModel | None = None
    seed: int = 0

    @property
    def fit(self) -> Mapping[str, Score]:
        """Case name → its score, of the training recordings."""
        return self.assessment.fit

    @property
    def validation(self) -> Mapping[str, Score]:
        """Case name → its score, of unseen recordings."""
        return self.assessment.validation

    @property
    def predictions(self) -> Mapping[str, np.ndarray]:
        """Case name → predicted torques (N, rows) at the full rate."""
        return self.assessment.predictions

    @property
    def repeated(self) -> Mapping[str, float]:
        """Validation case → share of its states that the training motion has been in, where it is no proof."""
        return self.assessment.repeated

    @property
    def excitation(self) -> Mapping[str, ExcitationReport]:
        """Case name → what the motion can tell."""
        return self.assessment.excitation

    @property
    def tracking(self) -> Tracking:
        """Tracking with the model fed forward."""
        return self.assessment.tracking

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a user should know."""
        return self.assessment.warnings

    @property
    def verdict(self) -> Verdict:
        """Pass, marginal or fail, with its reason."""
        return self.assessment.verdict


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
    excitation = {case.name: report_excitation(case.motion) for case in inputs.cases}
    loops = found.bias.loops
    say("errors on time left out")
    errors = learn_torque_errors(found, inputs.cases, carried.covariance)
    findings = ModelFindings(
        resting_parameters(found), model_warnings(inputs.cases, found, excitation),
        None if loops is None else loops.controller, errors and errors.discrepancy,
        contradiction(found, inputs.chain) if inputs.unit == TORQUE else None, found.unlike,
    )  # fmt: skip
    result = assess(inputs, found.dynamics, findings, errors, wrong, progress=say)
    return IdentificationOutcome(inputs, found, findings, result, carried, geometries, errors, found.settings.seed)


T = TypeVar("T", bound=IdentificationOutcome)


def assessed(outcome: T, inputs: IdentificationInputs) -> T:
    """Return an outcome judged anew on the unseen recordings of `inputs`; nothing is identified."""
    if (stage := stage_of(inputs.robot, "identify")) is not None and stage.judge is not None:
        result = stage.judge(inputs, outcome.found, outcome.findings)
    else:
        result = assess(inputs, outcome.found.dynamics, outcome.findings, outcome.errors)
    return replace(outcome, inputs=inputs, assessment=result)


def _carry(
    inputs: IdentificationInputs, found: Identification, say: Progress
) -> tuple[GeometryUncertainty, GeometryComparison | None]:
    """Return what the geometry's uncertainty adds to the estimate, and the estimate on the nominal geometry beside."""
    carried = propagate(found, inputs.robot, inputs.cases, say)
    if inputs.robot.nominal is None or not inputs.robot.moved:
        return carried, None
    say("the same on the nominal geometry")
    return carried, compare(found, carried, inputs.robot.nominal, inputs.cases)
