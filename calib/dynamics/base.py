"""Base parameters: the independent columns of the regressor, and the standard parameters that each of them combines.

    W chi = W_kept (chi_kept + K chi_dropped) = W_kept chi_base,    W_dropped = W_kept K

(Gautier 1991, numerically by QR). If several choices of kept columns are equivalent, Khalil's choice is used: YY, MZ, M
of a link behind a revolute joint, and the six moments of inertia of a link behind a prismatic joint, are regrouped into
the parameters of the links before it (Khalil & Kleinfinger 1987). Columns are tested one after another in a fixed
order, not in the order of pivot sizes, so that the choice between equivalent columns does not depend on the rounding of
a BLAS library.

Columns are chosen on the nominal chain. `regroup` recomputes K on the calibrated chain, where W_dropped = W_kept K
holds only approximately.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.dynamics.idim import IdentificationModel, friction_states
from calib.dynamics.regressor_model import Loads, RegressorModel, States
from calib.errors import CalibError
from calib.estimation.base_columns import ColumnSplit, split_columns
from calib.estimation.triangles import continued, retriangulate
from calib.records import frozen, shaped

SAMPLES = 500
"""Random states over which columns are compared."""
MIN_COEFFICIENT = 1e-4
"""Coefficients below are not printed: on a calibrated geometry nearly all are nonzero, and small."""
BLOCK = 1024
"""Samples per factorisation: bounds the memory, and keeps it in the processor's cache."""
ROUNDING = 1e-11
"""Coefficients below this part of the largest of their column are rounding."""
MIN_INDEPENDENT = 1e-4
"""Part of a column of unit norm that no other one explains, at least (our choice)."""


@dataclass(frozen=True, eq=False)
class Base:
    """Base parameters of a model: b combinations T (b, p) of its p standard parameters, with independent columns.

    Attributes:
        rows: name of the model's torque rows.
        standard: names of the p standard parameters of the model.
        standard_units: units of the p standard parameters.
        split: kept and dropped columns, regrouping matrix K = ``split.coefficients``, and singular values with their
            gap.
        remainder: (p - b,) norm of the part of each dropped column that W_kept K does not reproduce, over the column's
            norm: rounding on the chain on which columns were chosen, more after `regroup`.
        lost: (p - b,) that part as a torque, rms over the rows of all samples [N m or N per unit of the parameter].
    """

    rows: str
    standard: tuple[str, ...]
    standard_units: tuple[str, ...]
    split: ColumnSplit
    remainder: np.ndarray
    lost: np.ndarray

    @property
    def b(self) -> int:
        """Number of base parameters."""
        return self.split.rank

    @property
    def kept(self) -> np.ndarray:
        """Indices (b,) of the model's columns that are kept as base columns."""
        return self.split.kept

    @property
    def without_effect(self) -> tuple[str, ...]:
        """Names of the standard parameters that affect no torque."""
        return tuple(self.standard[column] for column in self.split.without_effect)

    @property
    def regrouped(self) -> tuple[str, ...]:
        """Names of the standard parameters that are regrouped into base parameters."""
        without_effect = set(self.split.without_effect.tolist())
        return tuple(self.standard[column] for column in self.split.dropped if column not in without_effect)

    @property
    def transform(self) -> np.ndarray:
        """Matrix T (b, p) that maps standard to base parameters: base = T @ standard."""
        result = np.zeros((self.b, len(self.standard)))
        result[np.arange(self.b), self.kept] = 1.0
        result[:, self.split.dropped] = self.split.coefficients
        return result

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the b base parameters, with suffix R if other parameters are regrouped into them.

        A regrouping coefficient below `MIN_COEFFICIENT` gives no suffix.
        """
        names = []
        for column, coefficients in zip(self.kept, self.split.coefficients):
            regrouped = (np.abs(coefficients) >= MIN_COEFFICIENT).any()
            names.append(self.standard[column] + ("R" if regrouped else ""))
        return tuple(names)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the b base parameters."""
        return tuple(self.standard_units[column] for column in self.kept)

    def to_standard(self, values: np.ndarray) -> np.ndarray:
        """Return standard parameters (p,) that give the same torques as the base parameters `values` (b,).

        Kept parameters have the base values, all others are zero.
        """
        result = np.zeros(len(self.standard))
        result[self.kept] = shaped(values, (self.b,), "base parameters")
        return result


@dataclass(frozen=True, eq=False)
class BaseModel:
    """An identification model with its base parameters, whose regressor has the base columns only.

    Attributes:
        model: model of all standard and drive parameters.
        base: base parameters of this model.
    """

    model: IdentificationModel
    base: Base

    def __post_init__(self) -> None:
        _require_same(self.base, self.model)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the b base parameters."""
        return self.base.names

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the b base parameters."""
        return self.base.units

    def regressor(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the base regressor (N, rows, b) at q, v, a (N, n), with all payloads attached.

        Args:
            q, v, a: (N, n) the motion [rad or m, and per s, per s²].
        """
        full = self.model.regressor(q, v, a)
        return full.transpose(2, 1, 0)[self.base.kept].transpose(2, 1, 0)

    def regressor_gradient(
        self, q: np.ndarray, v: np.ndarray, a: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the gradients of Σ weights · regressor with respect to q, v and a, (N, n) each.

        Args:
            q, v, a: (N, n) the motion [rad or m, and per s, per s²].
            weights: (N, rows, b) weight of each entry of the base regressor.
        """
        return self.model.regressor_gradient(q, v, a, weights, self.base.kept)

    def torque_gradient(
        self, q: np.ndarray, v: np.ndarray, a: np.ndarray, values: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the gradients of Σ weights · torques with respect to q, v and a, (N, n) each.

        Args:
            q, v, a: (N, n) the motion [rad or m, and per s, per s²].
            values: (b,) base parameters, which give the torques.
            weights: (N, rows) weight of each torque.
        """
        standard = np.zeros(self.model.p)
        standard[self.base.kept] = values
        return self.model.torque_gradient(q, v, a, standard, weights)


def random_samples(
    model: RegressorModel,
    count: int = SAMPLES,
    seed: int | np.random.Generator = 0,
    lower: np.ndarray | None = None,
    upper: np.ndarray | None = None,
) -> States:
    """Return `count` random states from the model's method `sample`.

    Args:
        model: model with n coordinates.
        count: number of states.
        seed: seed or generator of the random numbers.
        lower, upper: (n,) limits of the coordinates [rad or m]; None: the model's default limits.
    """
    return model.sample(count, np.random.default_rng(seed), lower, upper)


def find(
    model: RegressorModel,
    samples: States | None = None,
    loads: Loads | None = None,
    tolerance: float = 1e-6,
    nominal: RegressorModel | None = None,
) -> Base:
    """Return the base parameters of a model: the independent columns of its regressor.

    Args:
        model: torques as a linear function of p parameters, with the regressor W (rows, p).
        samples: states at which columns are compared; None: `random_samples`. For the states of a recorded motion, the
            result has the base parameters that this motion identifies.
        loads: load cases whose rows are stacked, each in the form of the regressor's argument `carried`; None: the
            model's `load_cases`.
        tolerance: smallest norm, of the part independent of the columns before, at which a unit-norm column is kept.
        nominal: the same model on the nominal geometry, on which columns are chosen; None: on `model` itself.
    """
    if samples is None:
        samples = random_samples(model)
    if nominal is not None:
        return regroup(find(nominal, samples, loads, tolerance), model, samples, loads)
    if loads is None:
        loads = model.load_cases()
    factor = r_factor(model, samples, loads)
    candidates = [np.array([column]) for column in model.preference()]
    split = _clean(split_columns(factor, candidates, tolerance))
    return _describe(model, split, factor, len(loads) * len(samples.q))


def regroup(base: Base, model: RegressorModel, samples: States | None = None, loads: Loads | None = None) -> Base:
    """Return the base parameters on another geometry, with the kept columns unchanged and K recomputed.

    K (b, p - b) minimises ‖W_dropped - W_kept K‖, with W_kept and W_dropped the kept and the dropped columns of the
    regressor over all samples; `Base.remainder` is the relative error. Columns that are zero on the nominal chain are
    included, since they may have a small effect on the calibrated chain. The singular values are those of the new
    geometry.

    Args:
        base: base parameters on the nominal geometry.
        model: the model on the new geometry.
        samples: states at which columns are compared; None: `random_samples`.
        loads: load cases whose rows are stacked; None: the model's `load_cases`.

    Raises:
        CalibError: if the model has other rows or parameters.
    """
    _require_same(base, model)
    if samples is None:
        samples = random_samples(model)
    if loads is None:
        loads = model.load_cases()
    factor = r_factor(model, samples, loads)
    kept = base.split.kept
    dropped = base.split.dropped
    without_effect, scale = _norms(factor)
    scaled = np.where(without_effect, 0.0, factor / scale)
    coefficients = np.linalg.lstsq(scaled[:, kept], scaled[:, dropped], rcond=None)[0]
    split = replace(
        base.split,
        coefficients=frozen(coefficients * scale[dropped] / scale[kept][:, None]),
        without_effect=frozen(np.flatnonzero(without_effect), int),
        singular_values=frozen(np.linalg.svd(scaled, compute_uv=False)),
    )
    return _describe(model, _clean(split), factor, len(loads) * len(samples.q))


def r_factor(model: RegressorModel, samples: States, loads: Loads = (None,)) -> np.ndarray:
    """Return the R factor (p, p) of the observation matrix over all samples and load cases.

    Samples are processed in blocks, so that the memory does not grow with their number. There is one triangle per
    torque row, updated only with the columns that can affect this row (the links before a joint do not); in the end all
    triangles are combined by a QR.

    Args:
        model: model with p parameters, whose regressor is stacked to the observation matrix.
        samples: states at which the regressor is computed.
        loads: load cases, each in the form of the regressor's argument `carried`; (None,): once, with all payloads.
    """
    p = model.p
    states = samples.states
    if states is None:
        states = friction_states(model, samples.q)
    triangles = np.zeros((model.rows, p, p))
    for start in range(0, len(samples.q), BLOCK):
        part = slice(start, start + BLOCK)
        q = samples.q[part]
        v = samples.v[part]
        a = samples.a[part]
        load = None if samples.load is None else samples.load[part]
        for carried in loads:
            regressor = model.regressor(q, v, a, load, carried, states[:, part])
            for row in range(model.rows):
                triangles[row] = _updated(triangles[row], regressor.transpose(2, 1, 0)[:, row])
    return retriangulate(triangles.reshape(-1, p))


def expressions(base: Base) -> tuple[str, ...]:
    """Return each base parameter as a sum of standard parameters, e.g. ``ZZ1R = ZZ1 + YY2``.

    Coefficients below `MIN_COEFFICIENT` are omitted.
    """
    lines = []
    for name, column, row in zip(base.names, base.kept, base.split.coefficients):
        text = base.standard[column]
        for coefficient, dropped in zip(row, base.split.dropped):
            if abs(coefficient) < MIN_COEFFICIENT:
                continue
            sign = "-" if coefficient < 0 else "+"
            # Rounded twice, so that ties do not depend on the last bit.
            rounded = float(f"{abs(coefficient):.12g}")
            size = f"{rounded:.5g}"
            factor = "" if size == "1" else f"{size} "
            text += f" {sign} {factor}{base.standard[dropped]}"
        lines.append(f"{name} = {text}")
    return tuple(lines)


def standard_name(name: str, standard: Collection[str]) -> str:
    """Return the name of the standard parameter for the name of a base parameter: ``ZZ1`` for ``ZZ1R``.

    Args:
        name: name of a base parameter, e.g. from a file.
        standard: names of the model's standard parameters; a name that is in it is returned unchanged.
    """
    if name.endswith("R") and name not in standard and name[:-1] in standard:
        return name[:-1]
    return name


def places(parameters: Sequence[str], names: Sequence[str], standard: Collection[str]) -> list[int] | None:
    """Return the indices in `names` of the base parameters in `parameters`; None if one is missing.

    Names are compared without the suffix R (`standard_name`): which parameters are regrouped may differ on another
    geometry or with joint corrections.

    Args:
        parameters: names of the base parameters to find.
        names: names in which they are searched.
        standard: names of the model's standard parameters.
    """
    index_of = {standard_name(name, standard): index for index, name in enumerate(names)}
    standard_names = [standard_name(name, standard) for name in parameters]
    if not set(standard_names) <= set(index_of):
        return None
    return [index_of[name] for name in standard_names]


def _updated(triangle: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the R factor (p, p) of `triangle` (p, p) with further rows below, which are given transposed (p, N).

    Args:
        triangle: R factor of the rows so far.
        columns: (p, N) the further N rows, transposed.
    """
    nonzero = np.flatnonzero(columns.any(axis=1) | triangle.any(axis=0))
    count = len(nonzero)
    result = np.zeros_like(triangle)
    if count:
        # nonzero[i] >= i: what stood in other columns is upper triangular in these.
        result[:count, nonzero] = continued(triangle[:count, nonzero], columns[nonzero].T)
    return result


def _clean(split: ColumnSplit) -> ColumnSplit:
    """Return the split with coefficients set to zero if they are rounding errors, and rounded if near an integer."""
    coefficients = np.array(split.coefficients)
    size = np.abs(coefficients).max(axis=0, initial=0.0)
    coefficients[np.abs(coefficients) <= ROUNDING * size] = 0.0
    coefficients[:, np.isin(split.dropped, split.without_effect)] = 0.0
    rounded = np.round(coefficients)
    is_integer = np.abs(coefficients - rounded) <= ROUNDING
    return replace(split, coefficients=frozen(np.where(is_integer, rounded, coefficients)))


def _norms(factor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a mask (p,) of the columns that are zero, and the norms (p,) of all columns, with 1 in place of 0.

    Args:
        factor: (p, p) R factor of a matrix, whose columns have the same norms.
    """
    norms = np.linalg.norm(factor, axis=0)
    without_effect = norms <= 1e-12 * norms.max(initial=0.0)
    return without_effect, np.where(without_effect, 1.0, norms)


def _describe(model: RegressorModel, split: ColumnSplit, factor: np.ndarray, samples: int) -> Base:
    """Return the base parameters with the norm ‖W_d - W_k K‖ of each dropped column, relative and as rms torque.

    Args:
        model: the model.
        split: kept columns W_k and dropped columns W_d.
        factor: (p, p) R factor of the observation matrix W.
        samples: number of samples times load cases in W.
    """
    without_effect, scale = _norms(factor)
    residual = factor[:, split.dropped] - factor[:, split.kept] @ split.coefficients
    remainder = np.linalg.norm(residual, axis=0)
    remainder[without_effect[split.dropped]] = 0.0
    return Base(
        rows=model.torque_rows.name,
        standard=model.names,
        standard_units=model.units,
        split=split,
        remainder=frozen(remainder / scale[split.dropped]),
        lost=frozen(remainder / np.sqrt(samples * model.rows)),
    )


def _require_same(base: Base, model: RegressorModel) -> None:
    """Raise `CalibError` if the base parameters were computed for another model."""
    if (base.rows, base.standard) != (model.torque_rows.name, model.names):
        raise CalibError("the base parameters belong to another model: rows or parameter names differ")


def information(
    model: BaseModel, q: np.ndarray, v: np.ndarray, a: np.ndarray, sigmas: np.ndarray | None = None
) -> np.ndarray:
    """Return the information matrix Σ ωᵀω (b, b) of a motion, summed over its samples with base regressors ω (rows, b).

    Args:
        model: base model with b columns.
        q, v, a: (N, n) the motion [rad or m, and per s, per s²].
        sigmas: (rows,) standard deviations [N m or N] by which the rows of ω are divided; None: 1.
    """
    b = len(model.names)
    total = np.zeros((b, b))
    for start in range(0, len(q), BLOCK):
        part = slice(start, start + BLOCK)
        q_part = np.ascontiguousarray(q[part])
        v_part = np.ascontiguousarray(v[part])
        a_part = np.ascontiguousarray(a[part])
        regressor = model.regressor(q_part, v_part, a_part)
        if sigmas is not None:
            regressor = regressor / sigmas[:, None]
        rows = regressor.reshape(-1, b)
        total += rows.T @ rows
    return total


def columns_at_rest(
    model: BaseModel,
    resting: Mapping[int, float | None],
    lower: np.ndarray,
    upper: np.ndarray,
    known: np.ndarray | None = None,
    unused: Sequence[int] | np.ndarray | None = None,
) -> np.ndarray:
    """Return the indices (c,) of the base columns that remain independent while some joints are at rest.

    Args:
        model: base model with b columns.
        resting: maps a joint at rest, from 0, to its position [rad or m], or to None for one random position.
        lower, upper: (n,) finite limits [rad or m] of the random positions at which columns are compared.
        known: (b, b) information matrix of other motions, in which the resting joints may move; None: no other motions.
        unused: indices of torque rows that are not used; None: those of the resting joints.
    """
    states = random_samples(model.model, lower=lower, upper=upper)
    q = np.array(states.q)
    v = np.array(states.v)
    a = np.array(states.a)
    for joint, position in resting.items():
        q[:, joint] = q[0, joint] if position is None else position
        v[:, joint] = 0.0
        a[:, joint] = 0.0
    regressor = model.regressor(q, v, a)
    if unused is None:
        unused = list(resting)
    regressor[:, unused] = 0.0
    rows = regressor.reshape(-1, regressor.shape[-1])
    if known is not None:
        eigenvalues, vectors = np.linalg.eigh(known)
        root = np.sqrt(np.maximum(eigenvalues, 0.0))[:, None] * vectors.T
        rows = np.concatenate([rows, root])
    candidates = [np.array([column]) for column in range(rows.shape[1])]
    return np.asarray(split_columns(rows, candidates, MIN_INDEPENDENT).kept)
