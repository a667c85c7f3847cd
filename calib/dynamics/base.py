"""Base parameters: which columns of the regressor carry information, and what each of them stands for.

    W chi = W_kept (chi_kept + K chi_dropped) = W_kept chi_base,    W_dropped = W_kept K

(Gautier 1991, numerically by QR). Which columns are kept is our choice where the algebra leaves one: Khalil's, who
regroups YY, MZ, M of a link behind a revolute joint, and the six moments of inertia of one behind a prismatic joint, on
the links before (Khalil & Kleinfinger 1987). The columns are tried one after another in a fixed order, not by the size
of pivots, so that no rounding of a BLAS library decides between equals.

Columns are chosen on the nominal chain; `regroup` recomputes K on the calibrated one, where it holds only nearly.
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
MIN_COEFFICIENT = 1e-4  # coefficients below are not printed: on a calibrated geometry nearly all are there, and small
BLOCK = 1024  # samples per factorisation: bounds the memory, and keeps it in the processor's cache


@dataclass(frozen=True, eq=False)
class Base:
    """Base parameters of a model.

    Attributes:
        rows: name of the model's torque rows.
        standard: names of the p parameters of the model.
        standard_units: their units.
        split: the kept and dropped columns, K = ``split.coefficients``, singular values and their gap.
        remainder: (p - b,) remainder of each dropped column after K, relative to its norm: rounding error on the
            original chain, more after `regroup`.
        lost: (p - b,) the same as a torque: rms over the samples' rows per unit of the parameter [N m or N per unit].
    """

    rows: str
    standard: tuple[str, ...]
    standard_units: tuple[str, ...]
    split: ColumnSplit
    remainder: np.ndarray
    lost: np.ndarray

    @property
    def b(self) -> int:
        return self.split.rank

    @property
    def kept(self) -> np.ndarray:
        return self.split.kept

    @property
    def without_effect(self) -> tuple[str, ...]:
        return tuple(self.standard[k] for k in self.split.without_effect)

    @property
    def regrouped(self) -> tuple[str, ...]:
        """Names of the standard parameters regrouped into others."""
        silent = set(self.split.without_effect.tolist())
        return tuple(self.standard[k] for k in self.split.dropped if k not in silent)

    @property
    def transform(self) -> np.ndarray:
        """Matrix (b, p) of base = transform @ standard."""
        result = np.zeros((self.b, len(self.standard)))
        result[np.arange(self.b), self.kept] = 1.0
        result[:, self.split.dropped] = self.split.coefficients
        return result

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the b parameters, with R if others are regrouped into them by at least `MIN_COEFFICIENT`."""
        return tuple(
            self.standard[k] + ("R" if (np.abs(row) >= MIN_COEFFICIENT).any() else "")
            for k, row in zip(self.kept, self.split.coefficients)
        )

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(self.standard_units[k] for k in self.kept)

    def to_standard(self, values: np.ndarray) -> np.ndarray:
        """Return standard parameters (p,) with the same torques: base values for the kept ones, zero for the others."""
        result = np.zeros(len(self.standard))
        result[self.kept] = shaped(values, (self.b,), "base parameters")
        return result


@dataclass(frozen=True, eq=False)
class BaseModel:
    """A model reduced to its base columns: used by excitation and identification."""

    model: IdentificationModel
    base: Base

    def __post_init__(self) -> None:
        _require_same(self.base, self.model)

    @property
    def names(self) -> tuple[str, ...]:
        return self.base.names

    @property
    def units(self) -> tuple[str, ...]:
        return self.base.units

    def regressor(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the base regressor (N, rows, b) at q, v, a (N, n), with all payloads."""
        full = self.model.regressor(q, v, a)
        return full.transpose(2, 1, 0)[self.base.kept].transpose(2, 1, 0)

    def regressor_gradient(
        self, q: np.ndarray, v: np.ndarray, a: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the gradients of Σ weights · regressor, weights (N, rows, b), for q, v and a, (N, n) each."""
        return self.model.regressor_gradient(q, v, a, weights, self.base.kept)

    def torque_gradient(
        self, q: np.ndarray, v: np.ndarray, a: np.ndarray, values: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the gradients of Σ weights · (regressor values), weights (N, rows), for q, v and a, (N, n) each."""
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
    """Return `count` random states of a model within limits (n,) of its coordinates; see its `sample`."""
    return model.sample(count, np.random.default_rng(seed), lower, upper)


def find(
    model: RegressorModel,
    samples: States | None = None,
    loads: Loads | None = None,
    tolerance: float = 1e-6,
    nominal: RegressorModel | None = None,
) -> Base:
    """Return the base parameters of a model: independent columns of its regressor.

    Args:
        samples: states to compare columns over; default `random_samples`. With recorded motion: the parameters that
            this motion identifies.
        loads: the load cases stacked, each as `carried` of the regressor; default with all payloads and without, if
            the model has any.
        tolerance: minimum part of a column of unit norm that is independent of the columns before.
        nominal: the same model on the geometry that columns are chosen on; None: `model`.
    """
    samples = random_samples(model) if samples is None else samples
    if nominal is not None:
        return regroup(find(nominal, samples, loads, tolerance), model, samples, loads)
    cases = model.load_cases() if loads is None else loads
    factor = r_factor(model, samples, cases)
    split = _clean(split_columns(factor, [np.array([k]) for k in model.preference()], tolerance))
    return _describe(model, split, factor, len(cases) * len(samples.q))


def regroup(base: Base, model: RegressorModel, samples: States | None = None, loads: Loads | None = None) -> Base:
    """Return the base recomputed for another geometry with the same columns: W_dropped ≈ W_kept K by least squares.

    The remainder says how well that holds over the samples. Columns without effect on the nominal chain (on the
    calibrated one a small one) take part; the singular values are those of the new geometry.
    """
    _require_same(base, model)
    samples = random_samples(model) if samples is None else samples
    cases = model.load_cases() if loads is None else loads
    factor = r_factor(model, samples, cases)
    kept, dropped = base.split.kept, base.split.dropped
    silent, scale = _norms(factor)
    scaled = np.where(silent, 0.0, factor / scale)
    found = np.linalg.lstsq(scaled[:, kept], scaled[:, dropped], rcond=None)[0]
    split = replace(
        base.split,
        coefficients=frozen(found * scale[dropped] / scale[kept][:, None]),
        without_effect=frozen(np.flatnonzero(silent), int),
        singular_values=frozen(np.linalg.svd(scaled, compute_uv=False)),
    )
    return _describe(model, _clean(split), factor, len(cases) * len(samples.q))


def r_factor(model: RegressorModel, samples: States, loads: Loads = (None,)) -> np.ndarray:
    """Return the R factor (p, p) of the observation matrix over samples and load cases, block by block.

    One triangle per torque row is updated with the columns that row can see at all (a joint does not feel the links
    before it), then all are stacked: memory is bounded by a block, whatever the number of samples.
    """
    p = model.p
    states = friction_states(model, samples.q) if samples.states is None else samples.states
    triangles = np.zeros((model.rows, p, p))
    for start in range(0, len(samples.q), BLOCK):
        part = slice(start, start + BLOCK)
        for carried in loads:
            load = None if samples.load is None else samples.load[part]
            block = model.regressor(samples.q[part], samples.v[part], samples.a[part], load, carried, states[:, part])
            for row in range(model.rows):
                triangles[row] = _updated(triangles[row], block.transpose(2, 1, 0)[:, row])
    return retriangulate(triangles.reshape(-1, p))


def expressions(base: Base) -> tuple[str, ...]:
    """Return the base parameters as sums of standard ones, e.g. ``ZZ1R = ZZ1 + YY2``, without small coefficients."""
    lines = []
    for name, k, row in zip(base.names, base.kept, base.split.coefficients):
        text = base.standard[k]
        for coefficient, index in zip(row, base.split.dropped):
            if abs(coefficient) < MIN_COEFFICIENT:
                continue
            size = f"{float(f'{abs(coefficient):.12g}'):.5g}"  # ties must not hang on the last bit
            factor = "" if size == "1" else f"{size} "
            text += f" {'-' if coefficient < 0 else '+'} {factor}{base.standard[index]}"
        lines.append(f"{name} = {text}")
    return tuple(lines)


def standard_name(name: str, standard: Collection[str]) -> str:
    """Return the standard parameter of a base parameter's name in a file: ``ZZ1`` for ``ZZ1R``."""
    return name[:-1] if name.endswith("R") and name not in standard and name[:-1] in standard else name


def places(own: Sequence[str], names: Sequence[str], standard: Collection[str]) -> list[int] | None:
    """Return where each base parameter of `own` stands among others' names; None if one does not.

    What is regrouped into it, and so the R of its name, may differ by another geometry or by joint corrections.
    """
    there = {standard_name(name, standard): k for k, name in enumerate(names)}
    wanted = [standard_name(name, standard) for name in own]
    return [there[name] for name in wanted] if set(wanted) <= set(there) else None


def _updated(triangle: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the R factor of [R factor; columnsᵀ] (p, p); columns (p, N)."""
    live = np.flatnonzero(columns.any(axis=1) | triangle.any(axis=0))
    result = np.zeros_like(triangle)
    if len(live):  # live[i] >= i: what stood in other columns is upper triangular in these
        result[: len(live), live] = continued(triangle[: len(live), live], columns[live].T)
    return result


def _clean(split: ColumnSplit, rounding: float = 1e-11) -> ColumnSplit:
    """Return the split with rounding errors in the coefficients set to zero.

    `rounding`: coefficients below this part of the largest of their column are rounding.
    """
    coefficients = np.array(split.coefficients)
    size = np.abs(coefficients).max(axis=0, initial=0.0)
    coefficients[np.abs(coefficients) <= rounding * size] = 0.0
    coefficients[:, np.isin(split.dropped, split.without_effect)] = 0.0
    near = np.abs(coefficients - np.round(coefficients)) <= rounding
    return replace(split, coefficients=frozen(np.where(near, np.round(coefficients), coefficients)))


def _norms(factor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mask of columns without effect, and the norms of all columns (1 for those without effect)."""
    norms = np.linalg.norm(factor, axis=0)
    silent = norms <= 1e-12 * norms.max(initial=0.0)
    return silent, np.where(silent, 1.0, norms)


def _describe(model: RegressorModel, split: ColumnSplit, factor: np.ndarray, samples: int) -> Base:
    """Return the base with the remainder ‖W_d - W_k K‖ of each dropped column, relative and as rms torque."""
    silent, scale = _norms(factor)
    rest = np.linalg.norm(factor[:, split.dropped] - factor[:, split.kept] @ split.coefficients, axis=0)
    rest[silent[split.dropped]] = 0.0
    lost = rest / np.sqrt(samples * model.rows)
    return Base(
        model.torque_rows.name, model.names, model.units, split, frozen(rest / scale[split.dropped]), frozen(lost)
    )


def _require_same(base: Base, model: RegressorModel) -> None:
    if (base.rows, base.standard) != (model.torque_rows.name, model.names):
        raise CalibError("the base parameters belong to another model: rows or parameter names differ")


def information(
    model: BaseModel, q: np.ndarray, v: np.ndarray, a: np.ndarray, sigmas: np.ndarray | None = None
) -> np.ndarray:
    """Return the information Σ ωᵀω (b, b) of a motion with regressors ω.

    Args:
        model: with b columns; q, v, a: (N, n) [rad or m, and per s, per s²].
        sigmas: (rows,) by which the rows of ω are divided; None: 1.
    """
    total = np.zeros((len(model.names),) * 2)
    for start in range(0, len(q), BLOCK):
        part = (np.ascontiguousarray(x[start : start + BLOCK]) for x in (q, v, a))
        W = model.regressor(*part) / (1.0 if sigmas is None else sigmas[:, None])
        rows = W.reshape(-1, W.shape[-1])
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
    """Return the indices (c,) of base columns that stay independent when some joints are at rest.

    Args:
        model: with b columns.
        resting: joint → its position at rest [rad or m]; None: one random position.
        lower, upper: (n,) finite limits of the random states at which columns are compared.
        known: (b, b) information of other motions, in which those joints may move.
        unused: torque rows that do not count; default those of the resting joints.
    """
    states = random_samples(model.model, lower=lower, upper=upper)
    q, v, a = (np.array(x) for x in (states.q, states.v, states.a))
    for j, value in resting.items():
        q[:, j], v[:, j], a[:, j] = q[0, j] if value is None else value, 0.0, 0.0
    Y = model.regressor(q, v, a)
    Y[:, list(resting) if unused is None else unused] = 0.0
    rows = Y.reshape(-1, Y.shape[-1])
    if known is not None:
        values, V = np.linalg.eigh(known)
        rows = np.concatenate([rows, np.sqrt(np.maximum(values, 0.0))[:, None] * V.T])
    min_independent = 1e-4  # of a column at unit norm that no other one explains (our choice)
    return np.asarray(split_columns(rows, [np.array([k]) for k in range(rows.shape[1])], min_independent).kept)
