"""Search for a small change of columns (sign, order, coupling) with which a model explains the data much better.

Columns of poses or recordings may be mislabelled. Possible errors are a sign, exchanged columns, a zero, a unit,
left-handed axes, a joint that is measured from the horizontal instead of from the link before it, and a joint with no
effect on the measurements. Each possible error is a `Change` in a table. Every change is applied to the data, the
model's residuals are compared with those of the data as recorded, and the best change is chosen.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from calib.errors import Finding, finding

Data = TypeVar("Data")

# Largest ratio of the residuals of two changes that cannot be distinguished (our choice).
MAX_RIVAL_RATIO = 1.2
# Largest ratio of the residuals of two changes that differ by rounding only: a wrist joint's zero off by 180° has the
# same effect as reversing the joint after it. The first change in the table is then chosen (our choice).
MAX_TIE_RATIO = 1.0001


@dataclass(frozen=True, eq=False)
class Change(Generic[Data]):
    """One possible error in the meaning of columns.

    Attributes:
        code: code of the finding on this change.
        make: function from the data as recorded to the changed data.
        joints: indices of the joints concerned, from 0.
        values: further values of the finding.
        max_left: largest share of the rms residual that may remain; the change is significant below this share.
    """

    code: str
    make: Callable[[Data], Data]
    joints: tuple[int, ...] = ()
    values: Mapping[str, Any] = field(default_factory=dict)
    max_left: float = 1.0


@dataclass(frozen=True, eq=False)
class Explanation:
    """Changes of columns with which the model explains the data better than without.

    Attributes:
        changes: the changes, one or more.
        before, after: (k,) mean squared residuals without and with the changes.
        rival: another change that alone explains the data nearly as well; None if there is none.
    """

    changes: tuple[Change, ...]
    before: np.ndarray
    after: np.ndarray
    rival: Change | None = None

    @property
    def code(self) -> str:
        """Code of the finding, that of the first change."""
        return self.changes[0].code

    @property
    def joints(self) -> tuple[int, ...]:
        """Indices of the joints of all changes that have the code of the first change.

        They are in rising order; those of a single change keep the order of the change.
        """
        of_kind = [change.joints for change in self.changes if change.code == self.code]
        if len(of_kind) == 1:
            return of_kind[0]
        return tuple(sorted(set().union(*of_kind)))

    @property
    def factor(self) -> float:
        """Ratio of the rms residual with the changes to the rms residual without."""
        return _share(self.after, self.before)

    def finding(self, names: Sequence[str], **values: object) -> Finding:
        """Return the finding on these changes.

        Args:
            names: names of all joints.
            values: further values of the finding.
        """
        joints = [names[j] for j in self.joints]
        details: dict[str, object] = {"joints": joints}
        if joints:
            details |= {"joint": joints[0], "other": joints[-1]}
        rival = None
        if self.rival is not None:
            rival_joint = [names[j] for j in self.rival.joints[:1]]
            rival = " at ".join([self.rival.code, *rival_joint])
        return finding(self.code, **details, rival=rival, **self.changes[0].values, **values)


def best_changes(
    data: Data,
    table: Iterable[Change[Data]],
    left: Callable[[Data], np.ndarray],
    at_least: Callable[[Data], np.ndarray] | None = None,
    max_changes: int = 1,
) -> Explanation | None:
    """Return the changes that explain the data best, chosen one by one; None if no change is significant.

    Of changes that explain the data equally well, the first one in the table is chosen.

    Args:
        data: the data as recorded.
        table: the changes to try.
        left: function from data to (k,) mean squared residuals; if k > 1 their geometric mean is compared.
        at_least: function from data to a lower bound of `left` that is fast to compute, by which hopeless changes are
            skipped; None if there is none.
        max_changes: largest number of changes to combine.
    """
    candidates = list(table)
    changes: list[Change] = []
    rival = None
    residual_before = residual = left(data)
    while candidates and len(changes) < max_changes:
        significant: list[_Trial] = []
        for change in candidates:
            changed = change.make(data)
            if at_least is None or _share(at_least(changed), residual) < change.max_left:
                residual_after = left(changed)
                share = _share(residual_after, residual)
                if share < change.max_left:
                    significant.append(_Trial(share, change, residual_after))
        if not significant:
            break
        least = min(trial.share for trial in significant)
        best = next(trial for trial in significant if trial.share <= MAX_TIE_RATIO * least)
        remaining = sorted((trial for trial in significant if trial is not best), key=lambda trial: trial.share)
        rivals = [trial.change for trial in remaining if trial.share < MAX_RIVAL_RATIO * best.share]
        rival = rivals[0] if rivals and not changes else None
        data = best.change.make(data)
        residual = best.residual
        changes.append(best.change)
        candidates.remove(best.change)
    if not changes:
        return None
    return Explanation(tuple(changes), residual_before, residual, rival)


class _Trial(NamedTuple):
    """A change of columns that was tried.

    The fields are the share of the rms residual that remains, the change, and mean squared residuals (k,).
    """

    share: float
    change: Change
    residual: np.ndarray


def reversal(n: int, joint: int) -> np.ndarray:
    """Return the matrix (n, n) that reverses the sign of one of n columns."""
    return np.diag(np.where(np.arange(n) == joint, -1.0, 1.0))


def standing(n: int, joint: int) -> np.ndarray:
    """Return the matrix (n, n) that sets one of n columns to zero."""
    return np.diag(np.where(np.arange(n) == joint, 0.0, 1.0))


def exchange(n: int, first: int, second: int) -> np.ndarray:
    """Return the matrix (n, n) that exchanges two of n columns."""
    order = np.arange(n)
    order[[first, second]] = second, first
    return np.eye(n)[order]


def coupling(n: int, joint: int, source: int, factor: float) -> np.ndarray:
    """Return the matrix (n, n) that adds `factor` times the column `source` to the column `joint` (coupled joints)."""
    matrix = np.eye(n)
    matrix[joint, source] = factor
    return matrix


def couplings(n: int) -> list[tuple[int, int, float]]:
    """Return the possible couplings of each joint with the one before it: joint, previous joint, +1 or -1.

    A joint's values may be relative to the previous joint.
    """
    return [(joint, joint - 1, factor) for joint in range(1, n) for factor in (1.0, -1.0)]


def assigned(cost: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the column (n,) and the sign (n,) of each joint with the smallest total cost; each column is used once.

    Args:
        cost: (2, n, n) cost of column k for joint j, unchanged and with reversed sign.
    """
    from scipy.optimize import linear_sum_assignment  # slow to load

    order = linear_sum_assignment(cost.min(axis=0))[1]
    rows = np.arange(len(order))
    return order, np.where(cost[0, rows, order] <= cost[1, rows, order], 1.0, -1.0)


def _share(after: np.ndarray, before: np.ndarray) -> float:
    """Return the ratio of two rms residuals; for several residuals, the geometric mean of their ratios."""
    with np.errstate(all="ignore"):
        return float(np.exp(0.5 * np.mean(np.log(np.asarray(after) / before))))
