"""The errors of pose selection: each states the finding, its likely cause, and advice."""

import numpy as np


class BadInput(ValueError):
    """An invalid array or option (shape, NaN, unknown name)."""


def require(holds: object, message: str, kind: type[Exception] = BadInput) -> None:
    """Raise `kind(message)` unless `holds`; for messages that can be formatted in both cases."""
    if not holds:
        raise kind(message)


class TooFewCandidates(ValueError):
    """There are fewer candidates than poses to choose.

    Attributes:
        found: number of candidates.
        wanted: number of poses to choose.
    """

    def __init__(self, message: str, found: int, wanted: int):
        self.found, self.wanted = found, wanted
        super().__init__(message)


class NothingFeasible(ValueError):
    """No pose, or fewer poses than asked for, keep limits and predicate.

    Attributes:
        found: number of feasible poses.
        draws: number of poses drawn.
    """

    def __init__(self, message: str, found: int, draws: int):
        self.found, self.draws = found, draws
        super().__init__(message)


class NotIdentifiable(ValueError):
    """A set of poses that cannot determine all parameters.

    Attributes:
        singular_values: singular values of the column-scaled observation matrix, falling; None where it was not formed.
    """

    def __init__(self, message: str, singular_values: np.ndarray | None = None):
        self.singular_values = singular_values
        super().__init__(message)
