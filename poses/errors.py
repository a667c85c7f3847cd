"""The errors of pose selection: each says what was found, why it may be so, and what to try."""

import numpy as np


class BadInput(ValueError):
    """An array or an option that cannot be what it should be (shape, NaN, an unknown name)."""


def require(holds: object, message: str, kind: type[Exception] = BadInput) -> None:
    """Raise `kind(message)` unless `holds`; for messages that can be formed whether it holds or not."""
    if not holds:
        raise kind(message)


class TooFewCandidates(ValueError):
    """Fewer candidates than poses to choose.

    Attributes:
        found, wanted: the two counts.
    """

    def __init__(self, message: str, found: int, wanted: int):
        self.found, self.wanted = found, wanted
        super().__init__(message)


class NothingFeasible(ValueError):
    """Limits and predicate leave no pose, or fewer than asked for.

    Attributes:
        found, draws: feasible poses found and poses drawn.
    """

    def __init__(self, message: str, found: int, draws: int):
        self.found, self.draws = found, draws
        super().__init__(message)


class NotIdentifiable(ValueError):
    """A set of poses that cannot determine all parameters.

    Attributes:
        singular_values: of the column-scaled observation matrix, falling; None where it was not formed.
    """

    def __init__(self, message: str, singular_values: np.ndarray | None = None):
        self.singular_values = singular_values
        super().__init__(message)
