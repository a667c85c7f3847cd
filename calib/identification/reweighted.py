"""An identification's estimate as a function of its rows: to be repeated on others, and to be differentiated."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from calib.data.signals.motion import moving
from calib.estimation.triangles import retriangulate
from calib.identification.cases import Case
from calib.identification.identify import Identification, common_decimator
from calib.identification.rows import ObservationRows, observe, thinned
from calib.identification.settings import make_model
from calib.robot.chain import Chain


@dataclass(frozen=True, eq=False)
class _Estimator:
    """An estimate as a function of its rows: A φ = Wᵀ R⁻¹ y + pull, A = Wᵀ R⁻¹ W + LᵀL.

    Attributes:
        deviation: (rows,) R = diag(deviation²).
        beforehand: (k, p) L, what was known beforehand, as whitened rows; (0, p) for nothing.
        pull: (p,) that information times its mean; what keeps parameters within bounds is part of it.
    """

    deviation: np.ndarray
    beforehand: np.ndarray
    pull: np.ndarray


def estimator(found: Identification) -> _Estimator:
    """Return how an identification weighed its rows, and what it knew beforehand."""
    fitted = found.fitted
    p = fitted.pooled.parameters
    deviation = np.array(fitted.std) if fitted.weighted else np.ones(len(fitted.std))
    if fitted.beforehand is None:
        return _Estimator(deviation, np.zeros((0, p)), np.zeros(p))
    deviation = deviation * np.sqrt(fitted.inflation)
    factors = (fitted.pooled.factors / deviation[:, None, None]).reshape(-1, p + 1)
    known, values = fitted.beforehand, fitted.estimate.values
    pull = factors[:, :p].T @ (factors[:, :p] @ values - factors[:, p]) + known.T @ (known @ values)
    return _Estimator(deviation, known, pull)


def estimate(how: _Estimator, all_rows: Sequence[ObservationRows]) -> tuple[np.ndarray, np.ndarray]:
    """Return φ (p,) from rows, and A⁻¹ (p, p); by QR of the whitened rows."""
    p = len(how.pull)
    factor = np.hstack([how.beforehand, np.zeros((len(how.beforehand), 1))])
    for part in all_rows:
        white = np.column_stack([stacked(part), part.target.ravel()]) * weights(how, part)[:, None]
        factor = retriangulate(np.vstack([factor, white]))
    inverse, solution = inverted(factor[:p, :p]), factor[:p, p]
    return inverse @ (solution + inverse.T @ how.pull), inverse @ inverse.T


def rows_on(found: Identification, chain: Chain, cases: Sequence[Case]) -> list[ObservationRows]:
    """Return the rows of an identification as another geometry would have given them; friction's columns stay."""
    model, decimator = make_model(chain, found.settings), common_decimator(cases, found.settings)
    result = []
    for part, case in zip(found.rows, cases):
        own = observe(model, found.base.kept, case, decimator)
        matrix = np.concatenate([own.matrix, part.matrix[:, :, found.base.b :]], axis=2)
        result.append(replace(part, matrix=matrix))
    return result


def standstill_shift(found: Identification, cases: Sequence[Case]) -> np.ndarray:
    """Return by how much φ (p,) changes where rows of nearly standing joints are left out; for one row per joint."""
    how, decimator = estimator(found), common_decimator(cases, found.settings)
    faster = [
        replace(part, present=part.present & thinned(moving(case.motion), case.motion.segment, decimator))
        for part, case in zip(found.rows, cases)
    ]
    return estimate(how, faster)[0] - estimate(how, found.rows)[0]


def cut(rows: ObservationRows, own: slice) -> ObservationRows:
    """Return some of the rows."""
    return replace(
        rows, matrix=rows.matrix[own], target=rows.target[own], present=rows.present[own], block=rows.block[own]
    )


def inverted(upper: np.ndarray) -> np.ndarray:
    """Return the inverse of an upper triangle (p, p) whose columns have units of their own."""
    unit = np.linalg.norm(upper, axis=0)
    return np.asarray(scipy.linalg.solve_triangular(upper / unit, np.eye(len(unit)))) / unit[:, None]


def stacked(rows: ObservationRows) -> np.ndarray:
    return rows.matrix.reshape(-1, rows.matrix.shape[2])


def weights(how: _Estimator, rows: ObservationRows, by: np.ndarray | None = None) -> np.ndarray:
    """Return 1 / deviation (or 1 / `by`) of each row, all stacked; zero where nothing was learnt."""
    return (rows.present / (how.deviation if by is None else by)).ravel()
