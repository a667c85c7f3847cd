"""Plain references beside an identified model: the nominal masses, and weighted least squares without any choice.

Plain weighted least squares has the base parameters with Coulomb and viscous friction and offsets, the rows and filters
of the identification, no prior and no richer friction. Directions of unit-norm columns that the motion shows by less
than `RANK` of the best are left out (truncated at the data's rank). Where recordings are held out, its error and that
of the nominal masses stand beside the delivered model's: what selection and prior are worth.
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
    """Torque unexplained on a recording that was held out [%], all as `Score.judged`.

    Attributes:
        delivered: by the identified model.
        plain: by plain weighted least squares; NaN where none was possible.
        nominal: by the masses of the robot's description, without friction; NaN without masses, or of currents.
    """

    delivered: Number
    plain: Number
    nominal: Number


def plain_values(identification: Identification[RegressorModel]) -> np.ndarray:
    """Return the parameters (p,) of the identified model by plain weighted least squares.

    Terms beyond the standard model are zero; a payload that no training recording carries keeps its known parameters.
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
    """Return the weighted least-squares values (p,) of least norm, truncated at the data's rank.

    Args:
        data: R factors, one group per torque row, each weighed by its residuals.
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
    """Return the model's parameters (p,) by the robot's description, without friction.

    None where it states no masses, or the torques are drives' alone, which hold no bodies.
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
    """Return the errors of plain references on held-out recordings beside the model's.

    Args:
        cases: held out.
        scores: of the model on them.
        plain: (p,) parameters by plain least squares; empty where there are none.
        nominal: (p,) by the description; None without.
        slow: what stands, see `calib.data.signals.motion.moving`.
        apart: rows in a unit of their own, which no total holds.
    """
    result = {}
    for case in cases:
        score = scores[case.name]
        errors = []
        for values in (plain, nominal):
            error = np.nan
            if values is not None and len(values) == len(dynamics.values):
                predicted = predict(Dynamics(dynamics.model, values), case)
                error = _unexplained(case, predicted, score.stands, slow, apart)
            errors.append(error)
        result[case.name] = PlainReferences(score.judged.total, *errors)
    return result


def _unexplained(
    case: Case, predicted: np.ndarray, in_motion: bool, slow: float | tuple[float, ...] | None, apart: Sequence[int]
) -> float:
    """Return 100 ‖τ - τ̂‖ / ‖τ‖ [%] of a case, of joints in motion alone if asked."""
    motion = case.motion
    rows = case.target.shape[1]
    counted = np.repeat(motion.weight[:, None] > 0.5, rows, axis=1)
    if in_motion:
        moves = moving(motion) if slow is None else moving(motion, slow)
        counted &= moves[:, np.arange(rows) % motion.n]
    counted[:, list(apart)] = False
    residual_squares = float(np.sum((case.target - predicted)[counted] ** 2))
    squares = float(np.sum(case.target[counted] ** 2))
    return 100.0 * float(np.sqrt(residual_squares / squares)) if squares > 0.0 else np.nan


def worse_than_plain(errors_by_file: Mapping[str, PlainReferences]) -> list[Finding]:
    """Return the finding on the held-out recording where plain least squares beats the model most, if it does."""
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
