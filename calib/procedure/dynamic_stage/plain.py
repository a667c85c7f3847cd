"""Plain references beside an identified model: the nominal masses, and weighted least squares without selection.

Plain weighted least squares estimates the base parameters with Coulomb and viscous friction and offsets. It uses the
rows and filters of the identification, but no prior and no richer friction. With columns scaled to unit norm,
directions with a singular value below `RANK` of the largest are omitted (truncated at the data's rank). On held-out
recordings, the errors of this estimate and of the nominal masses are shown beside the error of the delivered model. The
difference shows the benefit of selection and prior.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.data.signals.motion import moving
from calib.dynamics.bodies import standard_parameters
from calib.dynamics.regressor_model import RegressorModel
from calib.errors import Finding, finding
from calib.estimation.triangles import Triangles
from calib.identification.identify import Identification
from calib.identification.prediction import Dynamics, Score, predict
from calib.identification.rows import Case, pool, triangulate
from calib.procedure.findings import settle
from calib.records import Number, frozen
from calib.robot.chain import Chain

# singular values of unit-norm columns below this share of the largest are not identified (our choice)
RANK = 1e-2
# of weighing joints by their residuals
ROUNDS = 3
# parameters of a rigid body
BODY_PARAMETERS = 10


@dataclass(frozen=True)
class PlainReferences:
    """Unexplained share of the torque of a held-out recording [%], for three models; computed as `Score.judged`.

    Attributes:
        delivered: share of the identified model.
        plain: share of plain weighted least squares; NaN if no such estimate was possible.
        nominal: share of the masses in the robot's description, without friction; NaN without masses, or for currents.
    """

    delivered: Number
    plain: Number
    nominal: Number


def plain_values(identification: Identification[RegressorModel]) -> np.ndarray:
    """Return the parameters (p,) of the identified model, estimated by plain weighted least squares.

    Terms beyond the standard model are zero. A payload that no training recording carries keeps its known parameters.

    Args:
        identification: the identification with its recordings.
    """
    base, dynamics = identification.base, identification.dynamics
    torque_rows = identification.rows[0].target.shape[1]
    data = pool(triangulate(identification.rows), torque_rows).select(np.arange(base.b))
    standard = base.to_standard(truncated(data))
    result = np.zeros(len(dynamics.values))
    result[: len(standard)] = standard
    estimated = np.zeros(len(result), dtype=bool)
    estimated[base.kept] = True
    bodies = getattr(dynamics.model, "bodies", None)
    if bodies is not None:
        for number, label in enumerate(bodies.labels):
            body = slice(BODY_PARAMETERS * number, BODY_PARAMETERS * (number + 1))
            if label in identification.settings.payloads and not estimated[body].any():
                result[body] = dynamics.values[body]
    return frozen(result)


def truncated(data: Triangles) -> np.ndarray:
    """Return the weighted least-squares values (p,) of minimum norm, truncated at the data's rank.

    Args:
        data: triangular factors R of the regression's rows (Rᵀ R: normal equations), one group per torque row; each
            group is weighted by the inverse rms of its residuals.
    """
    weight, values = np.ones(data.groups), np.zeros(data.parameters)
    for _ in range(ROUNDS):
        stacked = (data.factors * weight[:, None, None]).reshape(-1, data.parameters + 1)
        columns, target = stacked[:, :-1], stacked[:, -1]
        norms = np.linalg.norm(columns, axis=0)
        scale = np.where(norms > 0.0, norms, 1.0)
        scaled_values, *_ = np.linalg.lstsq(columns / scale, target, rcond=RANK)
        values = scaled_values / scale
        std = np.sqrt(data.residual_squares(values) / np.maximum(data.rows, 1))
        weight = 1.0 / np.maximum(std, 1e-9 * max(float(std.max()), 1e-300))
    return values


def nominal_values(chain: Chain, dynamics: Dynamics[RegressorModel]) -> np.ndarray | None:
    """Return the model's parameters (p,) from the masses of the robot's description, without friction.

    None if the description states no masses, or if the torque rows contain no rigid-body torques.

    Args:
        chain: the arm with the masses and inertias of its description.
        dynamics: the identified model, which determines the parameters and their order.
    """
    inertias = getattr(chain, "inertias", None)
    if inertias is None or not np.any(inertias[:, 9] > 0.0) or not dynamics.model.torque_rows.has_bodies:
        return None
    bodies, result = standard_parameters(chain), np.zeros(len(dynamics.values))
    result[: len(bodies)] = bodies
    return result


def references(
    cases: Sequence[Case],
    scores: Mapping[str, Score],
    dynamics: Dynamics[RegressorModel],
    plain: np.ndarray,
    nominal: np.ndarray | None,
    slow: float | tuple[float, ...] | None = None,
    apart: Sequence[int] = (),
) -> dict[str, PlainReferences]:
    """Return the errors of the plain references and of the model on held-out recordings: recording name -> errors.

    Args:
        cases: held-out recordings.
        scores: recording name -> score of the model.
        dynamics: the model.
        plain: (p,) parameters by plain least squares; empty: no such estimate.
        nominal: (p,) parameters from the description; None: no masses in it.
        slow: speed below which a joint counts as standing, see `calib.data.signals.motion.moving`; None: default speed.
        apart: indices of rows that have another unit and are excluded from totals.
    """
    result = {}
    for case in cases:
        score = scores[case.name]
        errors = []
        for values in (plain, nominal):
            error = np.nan
            if values is not None and len(values) == len(dynamics.values):
                predicted = predict(Dynamics(dynamics.model, values), case)
                error = _unexplained(case, predicted, score, slow, apart)
            errors.append(error)
        result[case.name] = PlainReferences(score.judged.total, *errors)
    return result


def _unexplained(
    case: Case, predicted: np.ndarray, score: Score, slow: float | tuple[float, ...] | None, apart: Sequence[int]
) -> float:
    """Return the unexplained share 100 ‖τ - τ̂‖ / ‖τ‖ [%] of the torques τ of a recording; NaN without torques.

    Samples and frequencies are those that count in the model's score, see `Score.judged`.

    Args:
        case: the recording with N samples.
        predicted: (N, rows) predicted torques.
        score: the model's score on the recording, which states whether noise or standing joints are excluded.
        slow: speed below which a joint counts as standing; None: default speed.
        apart: indices of rows that have another unit and are not counted.
    """
    motion = case.motion
    rows = case.target.shape[1]
    target = case.target
    if score.noisy:
        target, predicted = motion.in_band(target), motion.in_band(predicted)
    counted = np.repeat(motion.weight[:, None] > 0.5, rows, axis=1)
    if score.stands:
        moves = moving(motion) if slow is None else moving(motion, slow)
        counted &= moves[:, np.arange(rows) % motion.n]
    counted[:, list(apart)] = False
    residual_squares = float(np.sum((target - predicted)[counted] ** 2))
    squares = float(np.sum(target[counted] ** 2))
    return 100.0 * float(np.sqrt(residual_squares / squares)) if squares > 0.0 else np.nan


def worse_than_plain(errors_by_file: Mapping[str, PlainReferences]) -> list[Finding]:
    """Return a finding on the held-out recording on which plain least squares is better by the largest factor.

    An empty list if plain least squares is better than the model by less than the catalogue's limit on every recording.

    Args:
        errors_by_file: name of a recording -> errors of the model and of the plain references.
    """
    ratios = {}
    for name, errors in errors_by_file.items():
        if np.isfinite(errors.plain) and errors.plain > 0.0:
            ratios[name] = errors.delivered / errors.plain
    if not ratios:
        return []
    name = max(ratios, key=ratios.__getitem__)
    worst = errors_by_file[name]
    candidate = finding(
        "torque-worse-than-plain", file=name, times=ratios[name], delivered=worst.delivered, plain=worst.plain
    )
    return list(settle([candidate]))
