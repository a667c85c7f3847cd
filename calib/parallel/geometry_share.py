"""Share of the geometry's uncertainty in the identified dynamics of a parallel robot.

The estimator and its implicit derivative are those of serial arms
(`calib.identification.uncertainty.geometry_uncertainty`). What
differs: a changed geometry moves every joint of the loops at the same encoder readings, and the torques' projection on
the platform's coordinates,

    y - W φ = J_p^invᵀ(g) τ - W(q̂(g), …; g) φ,

so that closure, Jacobians and regressor are solved again on changed geometries, by central differences.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from calib.data.signals.filtering import Decimator, decimate, spread
from calib.dynamics.torque_rows import POWER
from calib.identification.identify import Identification
from calib.identification.rows import Case, power_block, segments
from calib.identification.uncertainty.geometry_uncertainty import TILTS, GeometryUncertainty, solve_sensitivity
from calib.parallel.mechanism.closure import Posture, closed
from calib.parallel.mechanism.geometric_fit import LoopCovariance, LoopParameter, changed, visible_directions
from calib.parallel.mechanism.parallel_model import PLATFORM, ParallelModel
from calib.parallel.mechanism.parallel_robot import ParallelRobot
from calib.records import frozen

# of the central differences [m or rad]
STEP = 1e-5
# at the full rate; longer recordings are represented by pieces spread over them (our choice)
SAMPLES = 6000


def propagate(
    identification: Identification[ParallelModel],
    covariance: LoopCovariance,
    cases: Sequence[Case],
    torques: Callable[[Case], np.ndarray],
    progress: Callable[[str], None] | None = None,
) -> GeometryUncertainty:
    """Return the covariance of identified parameters with the share of the geometry's covariance.

    Args:
        identification: identification with a parallel robot's model.
        covariance: covariance of the geometry on which the identification is based.
        cases: training data; torques: returns the actuators' torques (N, n) of a case [N m or N].

    Raises:
        RobotError: for a covariance of another robot.
    """
    mechanism = identification.dynamics.model.mechanism
    parameters = covariance.of(mechanism)
    differences = _Differences.of(identification, parameters, torques)
    matrix, felt, residual = solve_sensitivity(identification, cases, differences, SAMPLES, progress)
    slopes = matrix[:, : len(parameters)]
    deviations = np.sqrt(np.clip(np.diag(covariance.matrix), 0.0, None))
    names = tuple(parameter.name for parameter in parameters)
    units = tuple(parameter.unit for parameter in parameters)
    # The directions of gravity have no stated uncertainty, nor have constants that were not fitted.
    sigma = np.full(len(parameters) + len(TILTS), np.nan)
    sigma[: len(parameters)] = np.where(deviations > 0.0, deviations, np.nan)
    return GeometryUncertainty(
        identification.names,
        (*names, *TILTS),
        (*units, *["rad"] * len(TILTS)),
        matrix,
        identification.fitted.estimate.covariance,
        sigma,
        frozen(slopes @ covariance.matrix @ slopes.T),
        felt,
        residual,
    )


@dataclass(frozen=True, eq=False)
class _Differences:
    """Derivatives of an identification's residuals by the K constants of the loops and the tilts of gravity.

    Attributes:
        identification: identification with a parallel robot's model.
        pairs: per direction, the models on geometries displaced by +`STEP` and -`STEP`.
        by_direction: (directions, K + 2) components of each constant and each tilt along the directions.
        torques: returns the actuators' torques (N, n) of a case.
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
        """Return the derivatives by constants of the loops of an identification's robot."""
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
        pairs += [(on(robot.tilted(axis)), on(robot.tilted(-axis))) for axis in axes]
        by_direction = scipy.linalg.block_diag(directions.T, np.eye(len(TILTS)))
        return cls(identification, pairs, np.array(by_direction), torques)

    def __call__(
        self, case: Case, span: slice, weighed: np.ndarray, decimator: Decimator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return ∂(W φ - y)/∂g (M, rows, K + 2) and (∂W/∂g)ᵀ R⁻¹ (y - W φ) (b, K + 2) of a case's samples `span`.

        Args:
            weighed: (M, rows) R⁻¹ (y - W φ) of the rows that result from the samples.
        """
        columns = self.identification.base.kept
        values = self.identification.fitted.estimate.values
        rows = self.identification.dynamics.model.rows
        posture = self.identification.dynamics.model.mechanism.locate(case.motion.q[span])
        if weighed.shape[1] != rows:
            weighed = weighed.sum(axis=1)[:, None]
        felt = spread(weighed, decimator, len(posture))
        change = np.empty((len(posture), rows, len(self.pairs)))
        pulled = np.empty((len(columns), len(self.pairs)))
        for k, (forth, back) in enumerate(self.pairs):
            W, target = self._observed(forth, case, span, posture)
            residual_forth = W @ values - target
            pull_forth = np.einsum("nrp,nr->p", W, felt)
            W, target = self._observed(back, case, span, posture)
            residual_back = W @ values - target
            pull_back = np.einsum("nrp,nr->p", W, felt)
            change[:, :, k] = (residual_forth - residual_back) / (2.0 * STEP)
            pulled[:, k] = (pull_forth - pull_back) / (2.0 * STEP)
        return decimate(change, decimator) @ self.by_direction, pulled @ self.by_direction

    def _observed(
        self, model: ParallelModel, case: Case, span: slice, posture: Posture
    ) -> tuple[np.ndarray, np.ndarray | float]:
        """Return W (N, rows, b), and the target (N, rows) where it depends on the geometry, else zero."""
        columns = self.identification.base.kept
        if model.torque_rows.name == POWER.name:
            segment = next(slice(a, b) for a, b in segments(case.motion.segment) if a <= span.start < b)
            no_payloads = np.zeros((0, len(case.motion)))
            block = power_block(model, columns, case, span, no_payloads, segment)
            return block.T[:, None], 0.0
        q = np.asarray(case.motion.q[span])
        v = np.asarray(case.motion.v[span])
        a = np.asarray(case.motion.a[span])
        motion = model.moved(q, v, a, posture)
        regressor = model.platform_regressor(motion, case.carried)
        W = model.on_rows(regressor, motion)[:, :, columns]
        if model.torque_rows.name != PLATFORM:
            return W, 0.0
        return W, np.einsum("nar,na->nr", motion.jacobians.readings, self.torques(case)[span])
