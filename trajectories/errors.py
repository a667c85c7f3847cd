"""The errors of trajectory design: each states the finding, its likely cause, and advice."""


class BadInput(ValueError):
    """An invalid array or option (shape, NaN, crossed limits, unknown name)."""


def require(holds: object, message: str, kind: type[Exception] = BadInput) -> None:
    """Raise `kind(message)` unless `holds`; for messages that can be formatted in both cases."""
    if not holds:
        raise kind(message)


class NotExciting(ValueError):
    """Raised if no motion of the family excites all columns of the regressor."""


class NothingFeasible(ValueError):
    """Raised where the search finds no motion within all constraints.

    Attributes:
        constraint: name of the constraint that the nearest motion breaks most.
        excess: by how much it is broken, in `unit`.
        unit: unit of `excess`.
    """

    def __init__(self, message: str, constraint: str, excess: float, unit: str):
        self.constraint, self.excess, self.unit = constraint, excess, unit
        super().__init__(message)

    def __reduce__(self):
        return type(self), (str(self), self.constraint, self.excess, self.unit)
