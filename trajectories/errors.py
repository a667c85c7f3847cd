"""Errors of trajectory design. Each message states what was found, its likely cause, and what to try."""


class BadInput(ValueError):
    """Raised for an invalid array or option (shape, NaN, crossed limits, unknown name)."""


def require(holds: object, message: str, kind: type[Exception] = BadInput) -> None:
    """Raise `kind(message)` where the condition `holds` is false.

    The message is formatted before the check, so its values must exist in both cases.
    """
    if not holds:
        raise kind(message)


class NotExciting(ValueError):
    """Raised if no motion of the family excites all columns of the regressor."""


class NothingFeasible(ValueError):
    """Raised where the search finds no motion that satisfies all constraints.

    Attributes:
        constraint: name of the constraint that the least infeasible motion violates most.
        excess: size of the violation, in `unit`.
        unit: unit of `excess`.
    """

    def __init__(self, message: str, constraint: str, excess: float, unit: str):
        self.constraint, self.excess, self.unit = constraint, excess, unit
        super().__init__(message)

    def __reduce__(self):
        return type(self), (str(self), self.constraint, self.excess, self.unit)
