"""Constraints on parameters: table [constraints] of the options file, and the report of a constrained estimate.

The methods with constraints are in `calib.identification.methods.estimators` and `calib.identification.closed_loop`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np

from calib.config import strict
from calib.config_types import Checked, Expect, Flag, Real, Text, Whole
from calib.errors import Finding
from calib.estimation.linear import LinearFit
from calib.identification.methods.convex import function_in
from calib.records import Number

POSTURES = 50
"""Postures at which M(q) must be positive definite (our choice)."""


def _in_order(value: object) -> object:
    """Raise a ValueError if the lower bound exceeds the upper one; return the value unchanged otherwise."""
    match value:
        case [int() | float() as low, int() | float() as high] if low > high:
            raise ValueError(f"the lower bound {low:g} is above the upper {high:g}")
    return value


@strict
@dataclass(frozen=True)
class WeightedSum:
    """A constraint on a weighted sum of parameters: `equal`, or at least `least` and at most `most`."""

    weights: Mapping[str, float]
    least: float | None = None
    most: float | None = None
    equal: float | None = None
    name: Text = ""

    @property
    def limits(self) -> tuple[float, float]:
        """Lower and upper bound of the sum; infinite if not stated."""
        if self.equal is not None:
            return self.equal, self.equal
        lower = -np.inf if self.least is None else self.least
        upper = np.inf if self.most is None else self.most
        return lower, upper


_Json = partial(Checked, lambda value: value)
"""JSON schema, in a file, of a key that Python may fill with a function."""


@strict
@dataclass(frozen=True)
class CurvedConstraint:
    """A constraint h >= 0 on parameters by name, where h is twice differentiable.

    Attributes:
        h: formula of parameters' names: ``"XX2 * ZZ2 >= XZ2**2"``; in Python also a function whose arguments are named
            as the parameters.
        slope: of a function h: function of the same arguments that returns the derivative by each of them.
        name: of the constraint, for messages.
    """

    h: Annotated[str | Callable[..., float], Expect("a formula, or in Python a function"), _Json({"type": "string"})]
    slope: Annotated[Callable[..., object] | None, Expect("a function, in Python alone"), _Json({"not": {}})] = None
    name: Text = ""


Bounds = Annotated[
    tuple[Annotated[float, Real(infinite=True)], Annotated[float, Real(infinite=True)]],
    Expect("two numbers, [lower, upper]; -inf or inf for no bound"),
    Checked(_in_order),
]


@strict
@dataclass(frozen=True)
class ConstraintSettings:
    """Table [constraints] of the options file; without it the PC methods use its defaults.

    Attributes:
        signs: inertia and friction of drives must not be negative.
        inertia: number of random postures in which M(q) must be positive definite; 0: none.
        bodies: bodies must be physically consistent; replaces `inertia`.
        bounds: name of a parameter → [lower, upper]; equal bounds fix it.
        sum: constraints on weighted sums of parameters.
        curved: constraints on functions of parameters.
        file: Python file, executed, with a function ``constraints(beta)`` that returns CVXPY constraints on
            ``beta["Fv1"]``.
        convex: in Python that function itself.
    """

    signs: Flag = True
    inertia: Annotated[int, Whole(0, 10_000)] = POSTURES
    bodies: Flag = False
    bounds: Mapping[str, Bounds] = field(default_factory=dict)
    sum: tuple[WeightedSum, ...] = ()
    curved: tuple[CurvedConstraint, ...] = ()
    file: Text = ""
    convex: Annotated[Callable[..., object] | None, Expect("a function, in Python alone"), _Json({"not": {}})] = None

    @property
    def function(self) -> Callable[..., object] | None:
        """Function of parameters that returns CVXPY constraints, from Python or from the file; None without one.

        Raises:
            UsageError: for a file without such a function, see `calib.identification.methods.convex.function_in`.
        """
        if self.convex is None and self.file:
            return function_in(Path(self.file))
        return self.convex

    @property
    def by_function(self) -> bool:
        """Whether a function states constraints."""
        return self.convex is not None or bool(self.file)

    @property
    def of_user(self) -> "ConstraintSettings":
        """What the user states, without those of the methods pc-*: signs, inertia and bodies."""
        return replace(self, signs=False, inertia=0, bodies=False)

    @staticmethod
    def of(value: object) -> object:
        """Return settings from a function of parameters; other values as they are."""
        return {"convex": value} if callable(value) else value


@dataclass(frozen=True, eq=False)
class Binding:
    """A constraint that is binding at an estimate.

    Attributes:
        name: name of the constraint.
        multiplier: μ, derivative of the minimum of ½ ‖R β - z‖² by the bound; of either sign for an equality.
        free: aᵀ β of the unconstrained estimate; NaN for M(q).
        sigma: standard deviation of `free`.
        bound: value of the binding bound.
        equality: whether it is an equality constraint.
    """

    name: str
    multiplier: Number
    free: Number
    sigma: Number
    bound: Number
    equality: bool


@dataclass(frozen=True, eq=False)
class Held:
    """Constraints of an estimate, which of them are binding, and the estimate without them.

    Attributes:
        names: names of all constraints.
        binding: constraints that are binding.
        tight: indices of the random postures in which the constraint on the inertia matrix M(q) is binding.
        free: the unconstrained estimate.
        normals: (k, p) derivatives of the binding constraints.
        findings: findings on binding constraints.
    """

    names: tuple[str, ...]
    binding: tuple[Binding, ...]
    tight: np.ndarray
    free: LinearFit
    normals: np.ndarray
    findings: tuple[Finding, ...] = ()

    @property
    def postures(self) -> int:
        """Number of random postures in which the constraint on the inertia matrix M(q) is binding."""
        return len(self.tight)
