"""Share of the geometry's uncertainty in the identified dynamics of a parallel robot.

The estimator and its implicit derivative are those of serial arms (`calib.identification.geometry_uncertainty`). What
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
from calib.identification.geometry_uncertainty import TILTS, GeometryUncertainty, solve_sensitivity
from calib.identification.identify import Identification
from calib.identification.rows import Case, power_block, segments
from calib.records import frozen
from calib.rooms.parallel.mechanism.closure import Posture, closed
from calib.rooms.parallel.mechanism.geometric_fit import LoopCovariance, LoopParameter, changed, visible_directions
from calib.rooms.parallel.mechanism.parallel_model import PLATFORM, ParallelModel
from calib.rooms.parallel.mechanism.parallel_robot import ParallelRobot

# of the central differences [m or rad]
STEP = 1e-5
# at the full rate; longer recordings are represented by pieces spread over them (our choice)
SAMPLES = 6000


def propagate(
    found: Identification[ParallelModel],
    covariance: LoopCovariance,
    cases: Sequence[Case],
    torques: Callable[[Case], np.ndarray],
    progress: Callable[[str], None] | None = None,
) -> GeometryUncertainty:
    """Return the covariance of identified parameters with the share of the geometry's covariance.

    Args:
        found: the identification.
        covariance: of the geometry that it was made on.
        cases: its training data; torques: of the actuators (N, n) in a case [N m or N].

    Raises:
        RobotError: for a covariance of another robot.
    """
    known = found.dynamics.model.known
    parameters = covariance.of(known)
    differences = _Differences.of(found, parameters, torques)
    matrix, felt, left = solve_sensitivity(found, cases, differences, SAMPLES, progress)
    own = matrix[:, : len(parameters)]
    deviations = np.sqrt(np.clip(np.diag(covariance.matrix), 0.0, None))
    names, units = (tuple(getattr(one, key) for one in parameters) for key in ("name", "unit"))
    return GeometryUncertainty(
        found.names,
        (*names, *TILTS),
        (*units, *("rad" for _ in TILTS)),
        matrix,
        found.fitted.estimate.covariance,
        np.append(np.where(deviations > 0.0, deviations, np.nan), np.full(len(TILTS), np.nan)),
        frozen(own @ covariance.matrix @ own.T),
        felt,
        left,
    )


@dataclass(frozen=True, eq=False)
class _Differences:
    """Derivatives of an identification's residuals by the K constants of the loops and the tilts of gravity.

    Attributes:
        found: the identification.
        pairs: models on a geometry moved along a direction by `STEP`, and back.
        by_direction: (directions, K + 2) what each constant, and each tilt, is of the directions.
        torques: of the actuators (N, n) in a case.
    """

    found: Identification[ParallelModel]
    pairs: Sequence[tuple[ParallelModel, ParallelModel]]
    by_direction: np.ndarray
    torques: Callable[[Case], np.ndarray]

    @classmethod
    def of(
        cls,
        found: Identification[ParallelModel],
        parameters: Sequence[LoopParameter],
        torques: Callable[[Case], np.ndarray],
    ) -> _Differences:
        """Return the derivatives by constants of the loops of an identification's robot."""
        model = found.dynamics.model
        directions = visible_directions(model.known, parameters)

        def on(robot: ParallelRobot) -> ParallelModel:
            return replace(model, known=closed(robot))

        robot = model.known.robot
        steps = STEP * directions.T
        pairs = [(on(changed(robot, parameters, one)), on(changed(robot, parameters, -one))) for one in steps]
        pairs += [(on(robot.tilted(axis)), on(robot.tilted(-axis))) for axis in STEP * np.eye(3)[: len(TILTS)]]
        return cls(found, pairs, np.array(scipy.linalg.block_diag(directions.T, np.eye(len(TILTS)))), torques)

    def __call__(
        self, case: Case, span: slice, weighed: np.ndarray, decimator: Decimator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return ∂(W φ - y)/∂g (M, rows, K + 2) and (∂W/∂g)ᵀ R⁻¹ (y - W φ) (b, K + 2) of a case's samples `span`.

        Args:
            weighed: (M, rows) R⁻¹ (y - W φ) of the rows that the samples make.
        """
        kept = self.found.base.kept
        values = self.found.fitted.estimate.values
        rows = self.found.dynamics.model.rows
        near = self.found.dynamics.model.known.locate(case.motion.q[span])
        felt = spread(weighed if weighed.shape[1] == rows else weighed.sum(axis=1)[:, None], decimator, len(near))
        change = np.empty((len(near), rows, len(self.pairs)))
        pulled = np.empty((len(kept), len(self.pairs)))
        for k, pair in enumerate(self.pairs):
            ends = []
            for own in pair:
                W, target = self._observed(own, case, span, near)
                ends.append((W @ values - target, np.einsum("nrp,nr->p", W, felt)))
            change[:, :, k], pulled[:, k] = ((one - two) / (2.0 * STEP) for one, two in zip(*ends))
        return decimate(change, decimator) @ self.by_direction, pulled @ self.by_direction

    def _observed(
        self, model: ParallelModel, case: Case, span: slice, near: Posture
    ) -> tuple[np.ndarray, np.ndarray | float]:
        """Return W (N, rows, b), and the target (N, rows) where it depends on the geometry, else zero."""
        kept = self.found.base.kept
        if model.torque_rows.name == POWER.name:
            whole = next(slice(a, b) for a, b in segments(case.motion.segment) if a <= span.start < b)
            return power_block(model, kept, case, span, np.zeros((0, len(case.motion))), whole).T[:, None], 0.0
        q, v, a = (np.asarray(x[span]) for x in (case.motion.q, case.motion.v, case.motion.a))
        motion = model.moved(q, v, a, near)
        W = model.on_rows(model.platform_regressor(motion, case.carried), motion)[:, :, kept]
        if model.torque_rows.name != PLATFORM:
            return W, 0.0
        return W, np.einsum("nar,na->nr", motion.jacobians.readings, self.torques(case)[span])
