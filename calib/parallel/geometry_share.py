"""Share of the geometry's uncertainty in the identified dynamics of a parallel robot.

The estimator and its implicit derivative are those of serial arms
(`calib.identification.uncertainty.geometry_uncertainty`). For a parallel robot a change of the geometry g also changes
all joint values of the loops at given encoder readings, and the projection of the torques on the platform's
coordinates,

    y - W φ = J_p^invᵀ(g) τ - W(q̂(g), …; g) φ.

Closure, Jacobians and regressor are therefore computed again for changed geometries, in central differences.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from calib.data.signals.filtering import Decimator, decimate, spread
from calib.dynamics.torque_rows import POWER
from calib.identification.identify import Identification
from calib.identification.rows import Case, power_entries, power_span, segments
from calib.identification.uncertainty.geometry_uncertainty import TILTS, GeometryUncertainty, solve_sensitivity
from calib.parallel.mechanism.closure import Posture, closed
from calib.parallel.mechanism.geometric_fit import LoopCovariance, LoopParameter, changed, visible_directions
from calib.parallel.mechanism.parallel_model import PLATFORM, ParallelModel
from calib.parallel.mechanism.parallel_robot import ParallelRobot
from calib.records import frozen

# Step of the central differences [m or rad].
STEP = 1e-5
# Largest number of samples of a recording at its full rate; of longer recordings evenly spread pieces (our choice).
SAMPLES = 6000


def propagate(
    identification: Identification[ParallelModel],
    covariance: LoopCovariance,
    cases: Sequence[Case],
    torques: Callable[[Case], np.ndarray],
    progress: Callable[[str], None] | None = None,
) -> GeometryUncertainty:
    """Return how the geometry's covariance adds to the covariance of identified parameters.

    Args:
        identification: identification with a parallel robot's model.
        covariance: covariance of the geometry on which the identification is based.
        cases: training data.
        torques: function that returns the actuators' torques (N, n) of a case [N m or N].
        progress: function called with a line of text; None: none.

    Raises:
        RobotError: for a covariance of another robot.
    """
    mechanism = identification.dynamics.model.mechanism
    parameters = covariance.of(mechanism)
    differences = _Differences.of(identification, parameters, torques)
    matrix, felt, residual = solve_sensitivity(identification, cases, differences, SAMPLES, progress)
    count = len(parameters)
    slopes = matrix[:, :count]
    share = slopes @ covariance.matrix @ slopes.T
    variances = np.clip(np.diag(covariance.matrix), 0.0, None)
    deviations = np.sqrt(variances)
    names = [parameter.name for parameter in parameters]
    units = [parameter.unit for parameter in parameters]
    tilt_units = ["rad"] * len(TILTS)
    # The directions of gravity have no stated uncertainty, nor have constants that were not fitted.
    sigma = np.full(count + len(TILTS), np.nan)
    sigma[:count] = np.where(deviations > 0.0, deviations, np.nan)
    estimate = identification.fitted.estimate
    return GeometryUncertainty(
        identification.names,
        (*names, *TILTS),
        (*units, *tilt_units),
        matrix,
        estimate.covariance,
        sigma,
        frozen(share),
        felt,
        residual,
    )


@dataclass(frozen=True, eq=False)
class _Differences:
    """Derivatives of an identification's residuals by the K constants of the loops and the tilts of gravity.

    Attributes:
        identification: identification with a parallel robot's model.
        pairs: for each direction of change, the models of geometries displaced by +`STEP` and -`STEP`.
        by_direction: (directions, K + 2) components of each constant and each tilt along the directions.
        torques: function that returns the actuators' torques (N, n) of a case.
    """

    identification: Identification[ParallelModel]
    pairs: Sequence[tuple[ParallelModel, ParallelModel]]
    by_direction: np.ndarray
    torques: Callable[[Case], np.ndarray]

    @classmethod
    def of(
        cls,
        identification: Identification[ParallelModel],
        parameters: Sequence[LoopParameter],
        torques: Callable[[Case], np.ndarray],
    ) -> _Differences:
        """Return the derivatives by `parameters`, constants of the loops of the identification's robot."""
        model = identification.dynamics.model
        directions = visible_directions(model.mechanism, parameters)

        def on(robot: ParallelRobot) -> ParallelModel:
            return replace(model, mechanism=closed(robot))

        robot = model.mechanism.robot
        pairs = []
        for step in STEP * directions.T:
            forth = changed(robot, parameters, step)
            back = changed(robot, parameters, -step)
            pairs.append((on(forth), on(back)))
        axes = STEP * np.eye(3)[: len(TILTS)]
        for axis in axes:
            forth = robot.tilted(axis)
            back = robot.tilted(-axis)
            pairs.append((on(forth), on(back)))
        by_tilt = np.eye(len(TILTS))
        by_direction = scipy.linalg.block_diag(directions.T, by_tilt)
        return cls(identification, pairs, np.array(by_direction), torques)

    def __call__(
        self, case: Case, span: slice, weighed: np.ndarray, decimator: Decimator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return ∂(W φ - y)/∂g (M, rows, K + 2) and (∂W/∂g)ᵀ R⁻¹ (y - W φ) (b, K + 2) of a part of a case.

        Args:
            case: the case.
            span: the samples of the part.
            weighed: (M, rows) R⁻¹ (y - W φ) of the M samples that remain after decimation.
            decimator: filter and rate of the decimation.
        """
        model = self.identification.dynamics.model
        columns = self.identification.base.kept
        values = self.identification.fitted.estimate.values
        rows = model.rows
        reach = span
        if model.torque_rows.name == POWER.name:
            reach = power_span(span, _segment_of(case, span))
        posture = model.mechanism.locate(case.motion.q[reach])
        if weighed.shape[1] != rows:
            weighed = weighed.sum(axis=1)[:, None]
        count = span.stop - span.start
        felt = spread(weighed, decimator, count)
        change = np.empty((count, rows, len(self.pairs)))
        pulled = np.empty((len(columns), len(self.pairs)))
        for k, (forth, back) in enumerate(self.pairs):
            W, target = self._observed(forth, case, span, posture)
            residual_forth = W @ values - target
            pull_forth = np.einsum("nrp,nr->p", W, felt)
            W, target = self._observed(back, case, span, posture)
            residual_back = W @ values - target
            pull_back = np.einsum("nrp,nr->p", W, felt)
            residual_change = residual_forth - residual_back
            pull_change = pull_forth - pull_back
            change[:, :, k] = residual_change / (2.0 * STEP)
            pulled[:, k] = pull_change / (2.0 * STEP)
        decimated = decimate(change, decimator)
        return decimated @ self.by_direction, pulled @ self.by_direction

    def _observed(
        self, model: ParallelModel, case: Case, span: slice, posture: Posture
    ) -> tuple[np.ndarray, np.ndarray | float]:
        """Return W (N, rows, b) and the target (N, rows) of a part of a case by a model.

        The target is 0 for rows whose target does not depend on the geometry. `posture`: postures near those of the
        model, of rows of power at all samples that their differences reach.
        """
        columns = self.identification.base.kept
        recorded = case.motion
        if model.torque_rows.name == POWER.name:
            return self._power(model, case, span, posture), 0.0
        q = np.asarray(recorded.q[span])
        v = np.asarray(recorded.v[span])
        a = np.asarray(recorded.a[span])
        motion = model.moved(q, v, a, posture)
        regressor = model.platform_regressor(motion, case.carried)
        W = model.on_rows(regressor, motion)[:, :, columns]
        if model.torque_rows.name != PLATFORM:
            return W, 0.0
        torques = self.torques(case)[span]
        forces = np.einsum("nar,na->nr", motion.jacobians.readings, torques)
        return W, forces

    def _power(self, model: ParallelModel, case: Case, span: slice, posture: Posture) -> np.ndarray:
        """Return the power regressor W (N, 1, b) of a part of a case, solved from nearby postures."""
        recorded = case.motion
        reach = power_span(span, _segment_of(case, span))
        v = np.asarray(recorded.v[reach])
        motion = model.moved(np.asarray(recorded.q[reach]), v, np.zeros_like(v), posture)
        energies = model.energies(motion, case.carried)
        before = span.start - reach.start
        # of the bodies' columns the energies count alone
        losses = model.drives_along(motion)[before:][: span.stop - span.start]
        block = power_entries(model, self.identification.base.kept, energies, losses, before, recorded.rate)
        return block.T[:, None]


def _segment_of(case: Case, span: slice) -> slice:
    """Return the samples of the case's uninterrupted segment that contains the first sample of `span`."""
    for start, stop in segments(case.motion.segment):
        if start <= span.start < stop:
            return slice(start, stop)
    raise AssertionError("a span lies in a segment")
