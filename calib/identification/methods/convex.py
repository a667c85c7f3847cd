"""Convex constraints that a user states as CVXPY expressions of parameters by name.

In Python ``IdentifySettings(constraints=lambda beta: [beta["M3"] >= 2.0, cp.norm(beta["MX2", "MY2"]) <= 0.3])``; for
the command line a Python file that the options file names, ``[constraints] file = "constraints.py"``, with a function
``constraints(beta)``. The file is executed, as any Python program with the rights of whoever starts the command.

CVXPY (Diamond & Boyd 2016) checks by its rules that a constraint is convex, and writes it as a cone program. Affine
ones become rows as those of ``bounds`` and ``sum``; the others are convex sets (`calib.estimation.convex_sets`) in the
cone programs of this folder. At the optimum a plane replaces each set, so that a binding one counts as one
equality in the covariance (Gouriéroux & Monfort 1995; our choice, as sets are curved). An inequality of vectors is one
constraint for each entry.
"""

import importlib.util
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib.errors import CalibError, NotConverged, refuse_option, suggestion
from calib.estimation.cone_program import minimise
from calib.estimation.convex_sets import ConvexSet
from calib.workers.extras import needing

if TYPE_CHECKING:
    import cvxpy

FUNCTION = "constraints"
"""Name of the function in a file of constraints."""
WHERE = "[constraints]"
"""Where constraints are stated, for messages."""
MAX_NAME = 80
"""Characters of a constraint's name in messages, which is its text."""


@dataclass(frozen=True, eq=False)
class AffineConstraint:
    """A constraint lower <= row β <= upper.

    Attributes:
        name: text of the constraint.
        row: (p,) over the estimated columns.
        lower, upper: both alike for an equality.
    """

    name: str
    row: np.ndarray
    lower: float
    upper: float


@dataclass(frozen=True, eq=False)
class UserConstraints:
    """What a user's function states: rows and convex sets."""

    rows: tuple[AffineConstraint, ...]
    sets: tuple[ConvexSet, ...]


class Parameters:
    """Parameters by name, for a function of constraints: ``beta["M3"]`` is a CVXPY expression, two names a vector."""

    def __init__(self, row_of: Callable[[Mapping[str, float]], np.ndarray]):
        self._row_of = row_of
        self._variables: dict[str | tuple[str, ...], cvxpy.Variable] = {}
        self._rows: dict[int, np.ndarray] = {}

    def __getitem__(self, names: str | tuple[str, ...]) -> "cvxpy.Variable":
        """Return a parameter's CVXPY variable, or the vector (k,) of several parameters.

        Raises:
            UsageError: for a name that is no parameter of the model, or one that the torques do not identify.
        """
        with needing("cvxpy"):
            import cvxpy

        if isinstance(names, list):
            names = tuple(names)
        listed = (names,) if isinstance(names, str) else names
        if not isinstance(listed, tuple) or not listed or not all(isinstance(name, str) for name in listed):
            refuse_option(WHERE, f'beta[{names!r}]: expected names of parameters: beta["M3"], beta["MX2", "MY2"]')
        if names not in self._variables:
            rows = [self._row_of({name: 1.0}) for name in listed]
            if isinstance(names, str):
                variable = cvxpy.Variable(name=names)
            else:
                variable = cvxpy.Variable(len(listed), name=f"({', '.join(listed)})")
            self._variables[names] = variable
            self._rows[variable.id] = np.array(rows)
        return self._variables[names]

    @property
    def rows(self) -> Mapping[int, np.ndarray]:
        """For the id of each CVXPY variable (k,) the matrix (k, p) by which it is the estimated columns."""
        return self._rows


def function_in(path: Path) -> Callable[[Parameters], object]:
    """Execute a Python file and return its function of constraints.

    Raises:
        UsageError: for a file that is missing, raises an error, or has no such function.
    """
    where = f"{WHERE} file"
    if not path.is_file():
        refuse_option(where, f"{path}: no such file; it is named relative to the options file")
    spec = importlib.util.spec_from_file_location(f"constraints_of_{path.stem}", path)
    if spec is None or spec.loader is None:
        refuse_option(where, f"{path} is no Python file: expected a name that ends in .py")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    # whatever a user's program raises
    except Exception as error:
        refuse_option(where, f"{path} raised {_described(error)}")
    function = getattr(module, FUNCTION, None)
    if not callable(function):
        choices = [name for name, value in vars(module).items() if callable(value) and not name.startswith("_")]
        similar = suggestion(FUNCTION, choices)
        refuse_option(where, f"{path} has no function {FUNCTION}(beta){similar}")
    return function


def user_constraints(
    function: Callable[[Parameters], object], row_of: Callable[[Mapping[str, float]], np.ndarray]
) -> UserConstraints:
    """Return the rows and convex sets that a user's function of the parameters states.

    Args:
        function: returns a list of CVXPY constraints.
        row_of: weights of parameters by name → row (p,) of the estimated columns.

    Raises:
        UsageError: where the function raises an error, or returns anything but convex constraints on parameters.
    """
    beta = Parameters(row_of)
    try:
        constraints = function(beta)
    except CalibError:
        raise
    # whatever a user's program raises
    except Exception as error:
        refuse_option(WHERE, f"the function of constraints raised {_described(error)}")
    checked = _checked(constraints)
    rows: list[AffineConstraint] = []
    sets: list[ConvexSet] = []
    for constraint in checked:
        for part in _scalar_parts(constraint):
            affine, convex = _canonical(part, _name(constraint), beta)
            rows += affine
            if convex is not None:
                sets.append(convex)
    return UserConstraints(tuple(rows), tuple(sets))


def _described(error: Exception) -> str:
    """Return an error's type and message with the user's last line: ``ValueError: … (line 3 of x.py)``."""
    frames = traceback.extract_tb(error.__traceback__)
    user_frames = [
        frame for frame in frames if "cvxpy" not in frame.filename and Path(frame.filename) != Path(__file__)
    ]
    text = f"{type(error).__name__}: {' '.join(str(error).split())}"
    if isinstance(error, SyntaxError) or not user_frames:
        return text
    return f"{text} (line {user_frames[-1].lineno} of {Path(user_frames[-1].filename).name})"


def _name(constraint: "cvxpy.Constraint") -> str:
    text = " ".join(str(constraint).split()).replace("PnormApprox(", "norm(").replace("Pnorm(", "norm(")
    return text if len(text) <= MAX_NAME else f"{text[: MAX_NAME - 1]}…"


def _checked(constraints: object) -> "list[cvxpy.Constraint]":
    """Return a list of CVXPY constraints that are convex, or refuse what is none."""
    with needing("cvxpy"):
        import cvxpy

    if not isinstance(constraints, (list, tuple)):
        kind = type(constraints).__name__
        refuse_option(WHERE, f"the function of constraints returned {kind}, expected a list of CVXPY constraints")
    if not constraints:
        refuse_option(WHERE, "the function of constraints returned an empty list: state a constraint, or remove it")
    checked: list[cvxpy.Constraint] = []
    for number, constraint in enumerate(constraints, 1):
        where = f"{WHERE} constraint {number}"
        if not isinstance(constraint, cvxpy.Constraint):
            kind = type(constraint).__name__
            refuse_option(where, f'is {kind}, no CVXPY constraint: beta["Fv1"] >= 0.5, cp.norm(…) <= 0.3')
        location = f"{where} ({_name(constraint)})"
        if not constraint.is_dcp():
            refuse_option(
                location,
                "is not convex by CVXPY's rules (DCP): a convex expression <= a concave one; functions that are not, "
                "by [[constraints.curved]]",
            )
        if any(variable.attributes["integer"] or variable.attributes["boolean"] for variable in constraint.variables()):
            refuse_option(location, "has variables that are integer: no convex set")
        if any(parameter.value is None for parameter in constraint.parameters()):
            refuse_option(location, "has a cvxpy.Parameter without value")
        checked.append(constraint)
    return checked


def _scalar_parts(constraint: "cvxpy.Constraint") -> "Sequence[cvxpy.Constraint]":
    """Return one constraint for each entry of an inequality or equality of vectors; others as they are."""
    import cvxpy
    from cvxpy.constraints.nonpos import Inequality, NonNeg, NonPos
    from cvxpy.constraints.zero import Equality, Zero

    if not isinstance(constraint, (Equality, Inequality, NonNeg, NonPos, Zero)) or constraint.size == 1:
        return [constraint]
    if isinstance(constraint, (Equality, Inequality)):
        expression = constraint.expr
    else:
        expression = constraint.args[0]
    entries = cvxpy.vec(expression, order="F")
    parts: list[cvxpy.Constraint] = []
    for k in range(constraint.size):
        if isinstance(constraint, (Equality, Zero)):
            parts.append(entries[k] == 0.0)
        elif isinstance(constraint, NonNeg):
            parts.append(entries[k] >= 0.0)
        else:
            parts.append(entries[k] <= 0.0)
    return parts


def _canonical(
    constraint: "cvxpy.Constraint", name: str, beta: Parameters
) -> tuple[list[AffineConstraint], ConvexSet | None]:
    """Return the rows of the estimated parameters that an affine constraint is, or the convex set that another is.

    Raises:
        UsageError: for a constraint without parameters.
    """
    import cvxpy
    from cvxpy.reductions.solvers.conic_solvers.clarabel_conif import dims_to_solver_cones

    problem = cvxpy.Problem(cvxpy.Minimize(0), [constraint])
    data, _, _ = problem.get_problem_data(cvxpy.CLARABEL)
    first_columns = data["param_prob"].var_id_to_col
    dims = data["dims"]
    system = np.asarray(data["A"].todense())
    parts: list[np.ndarray] = []
    parameter_columns: list[int] = []
    for variable, rows in beta.rows.items():
        if variable in first_columns:
            first = first_columns[variable]
            columns = range(first, first + len(rows))
            parameter_columns += columns
            parts.append(system[:, columns] @ rows)
    if not parts:
        refuse_option(f"{WHERE} ({name})", 'contains no parameter: name one by beta["…"]')
    matrix = np.sum(parts, axis=0)
    further = np.delete(system, parameter_columns, axis=1)
    cones = tuple(dims_to_solver_cones(dims))
    convex = ConvexSet(name, matrix, further, np.asarray(data["b"], dtype=float), cones)
    if dims.zero + dims.nonneg == len(system) and not further.any():
        return _affine(convex, dims.zero), None
    return [], convex


def _affine(convex: ConvexSet, equality_count: int) -> list[AffineConstraint]:
    """Return the rows of a set that equalities, which come first, and inequalities of the parameters describe."""
    rows: list[AffineConstraint] = []
    for k, row in enumerate(convex.matrix):
        side = float(convex.sides[k])
        if k < equality_count:
            constraint = AffineConstraint(convex.name, row, side, side)
        # a lower bound of what has a minus
        elif row[np.argmax(np.abs(row))] < 0.0:
            constraint = AffineConstraint(convex.name, -row, -side, np.inf)
        else:
            constraint = AffineConstraint(convex.name, row, -np.inf, side)
        rows.append(constraint)
    return rows


def is_empty(sets: Sequence[ConvexSet], matrix: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> bool:
    """Return whether no β satisfies all of some convex sets and lower <= A β <= upper, by the nearest to zero."""
    p = sets[0].matrix.shape[1]
    equal = lower == upper
    low = np.isfinite(lower) & ~equal
    high = np.isfinite(upper) & ~equal
    rows = np.vstack([matrix[low], -matrix[high]])
    offset = np.concatenate([-lower[low], upper[high]])
    no_matrices = np.zeros((0, 1, 1, p))
    try:
        minimise(np.eye(p), np.zeros(p), rows, offset, no_matrices, 0.0, matrix[equal], lower[equal], sets)
    except NotConverged:
        return True
    return False
