"""The errors of trajectory design: each says what was found, why it may be so, and what to try."""


class BadInput(ValueError):
    """An array or an option that cannot be what it should be (shape, NaN, limits that cross, an unknown name)."""


def require(holds: object, message: str, kind: type[Exception] = BadInput) -> None:
    """Raise `kind(message)` unless `holds`; for messages that can be formed whether it holds or not."""
    if not holds:
        raise kind(message)


class NotExciting(ValueError):
    """No motion of the family tells all columns of the regressor apart."""


class NothingFeasible(ValueError):
    """No motion was found that keeps all constraints.

    Attributes:
        constraint: the one that was broken most where the least was broken.
        excess: by how much, in `unit`.
    """

    def __init__(self, message: str, constraint: str, excess: float, unit: str):
        self.constraint, self.excess, self.unit = constraint, excess, unit
        super().__init__(message)

    def __reduce__(self):
        return type(self), (str(self), self.constraint, self.excess, self.unit)
