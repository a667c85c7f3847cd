"""Errors of pose selection. Each message states what was found, its likely cause, and what to try."""

import numpy as np


class BadInput(ValueError):
    """Raised for an invalid array or option (shape, NaN, unknown name)."""


def require(holds: object, message: str, kind: type[Exception] = BadInput) -> None:
    """Raise `kind(message)` where the condition `holds` is false.

    The message is formatted before the check, so its values must exist in both cases.
    """
    if not holds:
        raise kind(message)


class TooFewCandidates(ValueError):
    """Raised where there are fewer candidates than poses to choose.

    Attributes:
        found: number of candidates.
        wanted: number of poses to choose.
    """

    def __init__(self, message: str, found: int, wanted: int):
        self.found, self.wanted = found, wanted
        super().__init__(message)


class NothingFeasible(ValueError):
    """Raised where fewer poses than requested satisfy joint limits, constraints and predicate.

    Attributes:
        found: number of feasible poses.
        draws: number of poses drawn.
    """

    def __init__(self, message: str, found: int, draws: int):
        self.found, self.draws = found, draws
        super().__init__(message)


class NotIdentifiable(ValueError):
    """Raised where a set of poses cannot determine all parameters.

    Attributes:
        singular_values: (p,) singular values of the column-scaled observation matrix, largest first; None where the
            matrix was not computed.
    """

    def __init__(self, message: str, singular_values: np.ndarray | None = None):
        self.singular_values = singular_values
        super().__init__(message)
