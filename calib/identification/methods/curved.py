"""Nonlinear ("curved") constraints h(β) >= 0: twice differentiable functions of named parameters, stated by the user.

    min ½ ‖R β - z‖²    under    h_i(β) >= 0    and all other constraints

is solved by sequential quadratic programs (Wilson 1963; with penalised slack, so that each program has a solution:
Fletcher 1985). Each program replaces h by its tangent planes at the last β (Jacobian A), and adds the positive part of
-Σ μ_i ∇²h_i to RᵀR, as Janot's slides on the TX40 require (they use AᵀA instead). At the optimum the planes replace h:
they give the same optimum, with one multiplier each, and a covariance that treats the binding planes as equalities (our
choice; h is curved). If h is not concave, the feasible set is not convex, and the optimum is a local one.
"""

import ast
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from inspect import signature

import numpy as np

from calib.config_types import evaluated
from calib.errors import NotConverged, refuse_option, require
from calib.estimation.triangles import retriangulate
from calib.identification.methods.constrained import Constrained
from calib.identification.methods.constraint_settings import CurvedConstraint

_OPERATIONS = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_KNOWN = {name: getattr(np, name) for name in ("pi", "sqrt", "exp", "log", "sin", "cos", "tanh")}
# characters
MAX_FORMULA = 1000


@dataclass(frozen=True, eq=False)
class Curved:
    """A constraint h(u) >= 0 on k parameters u = rows β.

    Attributes:
        name: name of the constraint in messages.
        arguments: names of the parameters.
        rows: (k, p) matrix of u = rows β.
        h, slope: function of u (k,), and function that returns its derivatives (k,).
        stated: whether the user stated the derivatives; they are then compared with differences of h whenever they are
            used.
    """

    name: str
    arguments: tuple[str, ...]
    rows: np.ndarray
    h: Callable[[np.ndarray], float]
    slope: Callable[[np.ndarray], np.ndarray]
    stated: bool

    def value(self, b: np.ndarray) -> float:
        """Return h at parameters b (p,); NaN if it is not defined there."""
        with np.errstate(all="ignore"):
            try:
                return float(self.h(self.rows @ b))
            except ArithmeticError:
                return float("nan")

    def normal(self, b: np.ndarray) -> np.ndarray:
        """Return ∂h/∂b (p,) at parameters b (p,).

        Raises:
            UsageError: if h is not defined there, or the stated derivative is wrong.
        """
        u = self.rows @ b
        try:
            with np.errstate(all="ignore"):
                slope = self.slope(u)
        except ArithmeticError:
            slope = np.full(len(u), np.nan)
        if not np.isfinite([self.value(b), *slope]).all():
            self._refuse(
                f"no finite value or derivative at {self._at(u)}; restate the constraint so that it has one there"
            )
        if self.stated:
            self._compare(u, slope)
        return np.asarray(slope @ self.rows)

    def curvature(self, b: np.ndarray) -> np.ndarray:
        """Return ∂²h/∂b² (p, p) at parameters b (p,), by differences of the slope; zero where it is not defined."""
        u = self.rows @ b
        with np.errstate(all="ignore"):
            bend = _differences(self.slope, u)
        return self.rows.T @ (0.5 * np.nan_to_num(bend + bend.T)) @ self.rows

    def _compare(self, u: np.ndarray, slope: np.ndarray) -> None:
        slopes = _differences(lambda x: np.array([self.h(x)]), u)
        differences = np.ravel(slopes)
        size = _sizes(u)
        analytic = slope * size
        numeric = differences * size
        # of the derivative; of the largest one, what differences lose
        max_error, max_rounding = 1e-4, 1e-6
        largest = np.maximum(np.abs(analytic), np.abs(numeric))
        allowed = max_error * largest + max_rounding * np.abs(numeric).max()
        worst = int(np.argmax(np.abs(analytic - numeric) - allowed))
        if abs(analytic[worst] - numeric[worst]) > allowed[worst]:
            self._refuse(
                f"its derivative by {self.arguments[worst]} is stated as {slope[worst]:.6g}, but differences of h give "
                f"{differences[worst]:.6g}, at {self._at(u)}; correct 'slope', in the order of h's arguments"
            )

    def _at(self, u: np.ndarray) -> str:
        return ", ".join(f"{name} = {x:.4g}" for name, x in zip(self.arguments, u))

    def _refuse(self, message: str) -> None:
        refuse_option(f"[constraints] curved '{self.name}'", message)


def _sizes(u: np.ndarray) -> np.ndarray:
    """Return the absolute value (k,) of each argument, but at least a thousandth of the largest one."""
    smallest = max(1e-3 * float(np.abs(u).max()), 1e-9)
    return np.maximum(np.abs(u), smallest)


def _differences(function: Callable[[np.ndarray], np.ndarray], u: np.ndarray) -> np.ndarray:
    """Return the Jacobian (m, k) of a function from u (k,) to m numbers at u, by central differences."""
    steps = np.diag(1e-5 * _sizes(u))
    slopes = []
    for step in steps:
        change = function(u + step) - function(u - step)
        slopes.append(change / (2.0 * step.sum()))
    return np.transpose(slopes)


def make_curved(constraint: CurvedConstraint, row: Callable[[Mapping[str, float]], np.ndarray]) -> Curved:
    """Return a constraint from its formula, or from a Python function and its derivatives.

    Args:
        constraint: the stated constraint.
        row: function of weights by parameter name that returns the row (p,) of this weighted sum.

    Raises:
        UsageError: for a formula with anything but names, numbers, + - * / ** and a few functions.
    """
    h = constraint.h
    if callable(h):
        names = tuple(signature(h).parameters)
    else:
        names = ()
    name = constraint.name or (f"h({', '.join(names)}) >= 0" if callable(h) else h)
    location = f"[constraints] curved '{name}'"
    if callable(h) == (constraint.slope is None):
        refuse_option(location, "a function needs 'slope' (its derivatives), a formula has none: add or remove it")
    if callable(h) and constraint.slope is not None:
        function = _called(h, location, 1)
        count = len(names)
        slope = _called(constraint.slope, location, count)
        return Curved(name, names, _rows(names, row), lambda u: float(function(u)[0]), slope, True)
    text = str(h)
    tree, names = _parsed(text, location)

    def value(u: np.ndarray) -> float:
        return evaluated(tree, _KNOWN | dict(zip(names, u)), _OPERATIONS)  # ty: ignore[invalid-argument-type]

    # by complex steps, without rounding (Squire & Trapp 1998)
    def derivatives(u: np.ndarray) -> np.ndarray:
        step = 1e-30
        slopes = []
        for direction in np.eye(len(u)):
            shifted = value(u + 1j * step * direction)
            slopes.append(np.imag(shifted) / step)
        return np.array(slopes)

    rows = _rows(names, row)
    return Curved(name, names, rows, value, derivatives, False)


def _called(function: Callable[..., object], location: str, count: int) -> Callable[[np.ndarray], np.ndarray]:
    def call(u: np.ndarray) -> np.ndarray:
        values = np.ravel(np.asarray(function(*map(float, u)), dtype=float))
        if len(values) != count:
            message = f"returns {len(values)} numbers, expected {count}"
            refuse_option(location, f"'{getattr(function, '__name__', 'function')}' {message}")
        return values

    return call


def _rows(names: Sequence[str], row: Callable[[Mapping[str, float]], np.ndarray]) -> np.ndarray:
    return np.array([row({name: 1.0}) for name in names])


def _parsed(text: str, location: str) -> tuple[ast.expr, tuple[str, ...]]:
    """Return the syntax tree of h and the names in it, from a formula ``h``, ``left >= right`` or ``left <= right``.

    Args:
        text: the formula.
        location: name of the constraint, for messages.

    Raises:
        UsageError: for a text that is not such a formula.
    """
    try:
        require(len(text) <= MAX_FORMULA, "too long", ValueError)
        tree = ast.parse(text.strip(), mode="eval").body
        identifiers = [node.id for node in ast.walk(tree) if isinstance(node, ast.Name)]
        names = tuple(dict.fromkeys(name for name in identifiers if name not in _KNOWN))
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        refuse_option(location, f"is not a formula of at most {MAX_FORMULA} characters: 'XX2 * ZZ2 >= XZ2**2'")
    if isinstance(tree, ast.Compare) and len(tree.ops) == 1 and isinstance(tree.ops[0], (ast.GtE, ast.LtE)):
        ends = (tree.left, tree.comparators[0])
        larger, less = ends
        if not isinstance(tree.ops[0], ast.GtE):
            larger, less = ends[::-1]
        tree = ast.BinOp(larger, ast.Sub(), less)
    try:
        with np.errstate(all="ignore"):
            evaluated(tree, _KNOWN | dict.fromkeys(names, 1.0), _OPERATIONS)  # ty: ignore[invalid-argument-type]
    except ArithmeticError:
        pass
    except ValueError as wrong:
        allowed = f"parameters' names, numbers, + - * / **, {' '.join(_KNOWN)}, and one >= or <="
        refuse_option(location, f"expected {allowed}; found '{wrong}'")
    if not names:
        refuse_option(location, "contains no parameter: state at least one")
    return tree, names


# quadratic programs; price of a violation in the scaled problem (our choices)
MAX_ROUNDS, MAX_PRICE = 100, 1e4
# of ‖z‖: movement, and violation of h, in the scaled problem
SETTLED = 1e-9


def tangents(
    curved: Sequence[Curved],
    factor: np.ndarray,
    start: np.ndarray,
    solve: Callable[[np.ndarray, np.ndarray, np.ndarray], Constrained],
) -> tuple[np.ndarray, np.ndarray]:
    """Return the tangent planes of m curved constraints at the optimum under all constraints.

    Args:
        curved: the m constraints.
        factor: (p + 1, p + 1) upper triangle [R z; 0 ρ] of the least-squares problem min ‖R β - z‖² in the parameters
            β.
        start: (p,) β that satisfies the other constraints.
        solve: function that returns the optimum of a problem with p + m unknowns b, given its triangle (p + m + 1, p +
            m + 1) and further inequalities rows (2 m, p + m) b >= lower (2 m,), under the other constraints.

    Returns:
        normals (m, p) and bounds (m,) of the planes.

    Raises:
        UsageError: for a stated derivative that is wrong.
        NotConverged: if no estimate satisfies all constraints.
    """
    p = len(start)
    m = len(curved)
    price = 1.0
    length = float(np.linalg.norm(factor[:p, p])) or 1.0
    unit = length / np.linalg.norm(factor[:p, :p], axis=0)
    b = np.asarray(start)
    multipliers = np.zeros(m)
    normals = np.array([constraint.normal(b) for constraint in curved])
    size = np.linalg.norm(normals * unit, axis=1)
    size = np.where(size > 0.0, size, 1.0)
    # of the violation's price, below which it is at its least
    min_gain = 1e-6

    def merit(x: np.ndarray) -> float:
        residual = (factor[:p, :p] @ x - factor[:p, p]) / length
        values = np.array([constraint.value(x) for constraint in curved])
        violated = np.maximum(-values / size, 0.0)
        return float(0.5 * residual @ residual + price * violated.sum() + 0.5 * violated @ violated)

    for _ in range(MAX_ROUNDS):
        normals = np.array([constraint.normal(b) for constraint in curved])
        heights = np.array([constraint.value(b) for constraint in curved])
        curvatures = []
        for multiplier, normal_size, constraint in zip(multipliers, size, curved):
            curvatures.append(multiplier / normal_size * constraint.curvature(b))
        bend = -np.sum(curvatures, axis=0)
        planes = np.hstack([normals / size[:, None], np.eye(m)])
        rows = np.vstack([planes, np.eye(p + m)[p:]])
        lower = np.append((normals @ b - heights) / size, np.zeros(m))
        triangle = _elastic(factor, b, bend, unit, price * np.full(m, length))
        solution = solve(triangle, rows, lower)
        multipliers = solution.multipliers[:m]
        step = solution.values[:p] - b
        slack = solution.values[p:]
        satisfied = bool((slack < SETTLED).all())
        if satisfied and np.linalg.norm(factor[:p, :p] @ step) < SETTLED * length:
            return normals, normals @ b - heights
        share = _share(merit, b, step)
        merit_now = merit(b)
        b = b + share * step
        if not satisfied and price >= MAX_PRICE and merit_now - merit(b) < min_gain * merit_now:
            break
        if not satisfied:
            price = min(10.0 * price, MAX_PRICE)
    heights_text = "; ".join(f"h of '{constraint.name}' = {constraint.value(b):.3g}" for constraint in curved)
    raise NotConverged(f"the nearest estimate has {heights_text}", b)


def _share(merit: Callable[[np.ndarray], float], b: np.ndarray, step: np.ndarray) -> float:
    """Return the largest of 1, ½, ¼, … by which a step can be multiplied without an increase of the merit function.

    Args:
        merit: merit function of parameters (p,).
        b: (p,) parameters before the step.
        step: (p,) change of the parameters.
    """
    share = 1.0
    merit_now = merit(b)
    max_halvings = 30
    while not merit(b + share * step) <= merit_now + 1e-12 * abs(merit_now) and share > 0.5**max_halvings:
        share *= 0.5
    return share


def _elastic(factor: np.ndarray, b: np.ndarray, bend: np.ndarray, unit: np.ndarray, price: np.ndarray) -> np.ndarray:
    """Return the triangle of a quadratic program with unknowns x (p,) and slack t (m,).

    It represents ½ ‖R x - z‖² + ½ (x - b)ᵀ K₊ (x - b) + Σ price t + ½ ‖length t‖², where K₊ is the positive part of
    `bend` and length = ‖z‖.

    Args:
        factor: (p + 1, p + 1) upper triangle [R z; 0 ρ].
        b: (p,) point at which the constraints are linearised.
        bend: (p, p) curvature of the constraints, whose positive part is K₊.
        unit: (p,) units of the parameters, in which K₊ is computed.
        price: (m,) weights of the slack.
    """
    p = len(b)
    m = len(price)
    length = float(np.linalg.norm(factor[:-1, -1])) or 1.0
    values, vectors = np.linalg.eigh(bend * np.outer(unit, unit))
    root_values = np.sqrt(np.maximum(values, 0.0))
    root = root_values[:, None] * vectors.T / unit
    stacked = np.zeros((2 * p + 1 + m, p + m + 1))
    rows = slice(p + 1)
    bent = slice(p + 1, 2 * p + 1)
    further = slice(2 * p + 1, None)
    stacked[rows, :p] = factor[:, :p]
    stacked[rows, -1] = factor[:, p]
    stacked[bent, :p] = root
    stacked[bent, -1] = root @ b
    stacked[further, p : p + m] = length * np.eye(m)
    stacked[further, -1] = -price
    return retriangulate(stacked)
