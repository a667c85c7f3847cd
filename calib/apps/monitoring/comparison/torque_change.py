"""Change between two identified models of a robot's dynamics: a test in base parameters, and the change of the torque.

The tested combinations (`change_test`) are the base parameters, each divided by its σ. Their derivatives by a standard
parameter, by a joint's friction or by a link's inertial parameters follow from the later model's regrouping of standard
parameters into base parameters. The change of the torque along a motion is the difference of the two models' torques,
Δτ = W₂ χ₂ - W₁ χ₁, each with the model's own geometry. If nothing changed, both covariances give its expected square,
w₁ Σ₁ w₁ᵀ + w₂ Σ₂ w₂ᵀ.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np

from calib.apps.monitoring.comparison.change_test import ChangeTest, ParameterChange, Tested, tested
from calib.apps.monitoring.comparison.identifications import Identified, MotionStates
from calib.toolkit.torque_models import IdentificationModel, parameter_variances, standard_name

# sine of an angle between what two parameters do to the combinations, below which they are one
PARALLEL = 1e-6
# of χ²; σ of real motions holds no unmodelled effects, which leave a residual (our choice)
NEARLY_ALL = 0.9


@dataclass(frozen=True, eq=False)
class TorqueChange:
    """Change of the torque along one motion.

    Attributes:
        where: name of the motion.
        t: (N,) times of the samples [s]; sample numbers where the table has no times.
        change, expected: (N, rows) later minus earlier torque, and σ of this difference by both covariances [N m or N].
        torque: (N, rows) torque of the later model [N m or N].
        unexplained: share of the measured torque that the earlier, and that the later model leaves unexplained, over
            all rows [%]; None if no torque was measured.
    """

    where: str
    t: np.ndarray
    change: np.ndarray
    expected: np.ndarray
    torque: np.ndarray
    unexplained: tuple[float, float] | None

    @property
    def rms(self) -> float:
        """Rms change of the torque over all samples and rows [N m or N]."""
        return _rms(self.change)


@dataclass(frozen=True)
class PartChange:
    """The friction of a joint, or the inertial parameters of a link, as the only change between two models.

    Attributes:
        name: name of the part.
        explained: decrease of the χ² statistic of the difference between the models, if only this part changed.
        count: number of parameter combinations that the part changes.
        rms: rms change of the torque along the first motion if only this part changed [N m or N].
    """

    name: str
    explained: float
    count: int
    rms: float


@dataclass(frozen=True)
class DynamicsChange(ChangeTest):
    """Change between two identified models, with the result of the change test.

    Attributes:
        parts: friction of each joint and inertial parameters of each link, in descending order of the decrease of χ².
        torques: change of the torque along each motion.
    """

    parts: tuple[PartChange, ...]
    torques: tuple[TorqueChange, ...]

    @property
    def part(self) -> PartChange | None:
        """The first of `parts`, if its change alone explains the difference; else None.

        It does if the remaining χ² may be chance, or if it explains the share `NEARLY_ALL` of χ².
        """
        first = self.parts[0]
        if self.suffices(first.explained, first.count) or first.explained > NEARLY_ALL * self.chi2:
            return first
        return None


def compare(before: Identified, after: Identified, motions: dict[str, MotionStates]) -> DynamicsChange:
    """Return the change between two models of one robot, with the change of the torque along the given motions.

    Args:
        before, after: the earlier and the later model.
        motions: states by the name of the motion.
    """
    keys = list(dict.fromkeys([*before.keys, *after.keys]))
    values_before, covariance_before = _among(before, keys)
    values_after, covariance_after = _among(after, keys)
    sigma = np.sqrt(np.diag(covariance_before + covariance_after))
    unit = np.where(sigma > 0.0, sigma, 1.0)
    units = np.outer(unit, unit)
    axes = np.eye(len(keys))
    spans = [axes[:, np.diag(covariance_before) > 0.0], axes[:, np.diag(covariance_after) > 0.0]]
    standard = _standard(before, after, keys)
    columns = np.column_stack([column for _, _, column in standard]) / unit[:, None]
    scaled = [covariance_before / units, covariance_after / units]
    test, _ = tested((values_after - values_before) / unit, scaled, spans, columns)

    changes = []
    for k in _distinct(columns, len(keys)):
        name, kind, _ = standard[k]
        alone = test.alone(k)
        if k < len(keys):
            change = ParameterChange(name, kind, values_before[k], values_after[k], sigma[k], *alone)
        else:
            # a parameter that was regrouped has no value of its own
            change = ParameterChange(name, kind, np.nan, np.nan, 0.0, *alone)
        changes.append(change)
    changes.sort(key=lambda change: -change.explained)

    torques = [_torque(name, states, before, after) for name, states in motions.items()]
    names = [standard_name(name, after.model.names) for name, _, _ in standard]
    first_motion = next(iter(motions.values()))
    parts = _parts(test, after.model, names, first_motion)
    return DynamicsChange(test.chi2, len(test.difference), tuple(changes), test.extra, parts, tuple(torques))


def _among(model: Identified, keys: list[Hashable]) -> tuple[np.ndarray, np.ndarray]:
    """Return values (s,) and covariance (s, s) of a model's base parameters in the order of `keys`.

    Both are zero for parameters that the model does not have.

    Args:
        model: the model.
        keys: keys of s base parameters, as in `Identified.keys`.
    """
    indices = [keys.index(key) for key in model.keys]
    values = np.zeros(len(keys))
    values[indices] = model.values
    covariance = np.zeros((len(keys), len(keys)))
    covariance[np.ix_(indices, indices)] = model.covariance
    return values, covariance


def _standard(before: Identified, after: Identified, keys: list[Hashable]) -> list[tuple[str, str, np.ndarray]]:
    """Return (name, unit, derivatives (s,) of the base parameters) of each estimated and each regrouped parameter.

    Args:
        before, after: the two models.
        keys: keys of the s base parameters.
    """
    names_and_units = {}
    for model in (before, after):
        for key, name, unit in zip(model.keys, model.names, model.units):
            names_and_units[key] = name, unit
    rows = []
    estimated = set()
    for key, column in zip(keys, np.eye(len(keys))):
        name, unit = names_and_units[key]
        rows.append((name, unit, column))
        if isinstance(key, tuple):
            estimated.add(key[0])
        else:
            estimated.add(key)

    unit_of = dict(zip(after.model.names, after.model.units))
    regrouped: dict[str, np.ndarray] = {}
    for key, coefficients in after.regrouping.items():
        for name, coefficient in coefficients.items():
            if name not in estimated:
                column = regrouped.setdefault(name, np.zeros(len(keys)))
                column[keys.index(key)] = coefficient
    for name, column in regrouped.items():
        rows.append((name, unit_of[name], column))
    return rows


def _distinct(columns: np.ndarray, first: int) -> list[int]:
    """Return the indices of columns of a matrix (s, p) that are not parallel to an earlier column.

    Args:
        columns: the matrix, whose columns are derivatives by p parameters.
        first: number of columns at the beginning that are always included.
    """
    size = np.linalg.norm(columns, axis=0)
    unit = columns / np.where(size > 0.0, size, 1.0)
    chosen = list(range(first))
    for k in range(first, len(size)):
        if size[k] > 0.0 and np.abs(unit[:, chosen].T @ unit[:, k]).max() < 1.0 - PARALLEL:
            chosen.append(k)
    return chosen


def _parts(test: Tested, arm: IdentificationModel, names: list[str], states: MotionStates) -> tuple[PartChange, ...]:
    """Return each joint's friction and each link's inertial parameters with the decrease of χ² if only they changed.

    Args:
        test: test of the tested combinations of parameters.
        arm: the model whose parameters are grouped.
        names: names of the tested parameters.
        states: motion along which the change of the torque is computed.
    """
    column_of = {name: k for k, name in enumerate(arm.names)}
    result = []
    for part, members in {**_frictions(arm), **_links(arm)}.items():
        chosen = np.array([k for k, name in enumerate(names) if name in members], dtype=int)
        if not len(chosen):
            continue
        steps, explained, count = test.together(chosen)
        change = np.zeros(arm.p)
        for k in chosen:
            change[column_of[names[k]]] = steps[k]
        torque = arm.torque(change, *states.motion, ())
        result.append(PartChange(part, explained, count, _rms(torque)))
    result.sort(key=lambda part: -part.explained)
    return tuple(result)


def _frictions(model: IdentificationModel) -> dict[str, set[str]]:
    """Return the names of the friction terms of each joint in a model, by the text "the friction of joint …"."""
    frictions: dict[str, set[str]] = {f"the friction of joint {j + 1}": set() for j in range(model.n)}
    for term in model.columns:
        part = f"the friction of joint {term.acts[0][0] + 1}"
        if part in frictions:
            frictions[part].add(term.name)
    return frictions


def _links(model: IdentificationModel) -> dict[str, set[str]]:
    """Return the names of each link's ten inertial parameters in a model, by the text "the body of link …"."""
    names = model.names[: model.inertial]
    return {f"the body of link {k // 10 + 1}": set(names[k : k + 10]) for k in range(0, len(names), 10)}


def _torque(name: str, states: MotionStates, before: Identified, after: Identified) -> TorqueChange:
    torques = []
    variances = []
    shares = []
    for model in (before, after):
        torque = model.model.torque(model.dynamics.values, *states.motion, ())
        torques.append(torque)
        variance = parameter_variances(model.dynamics, model.columns, model.covariance, *states.motion, ())
        variances.append(variance)
        if states.measured is not None:
            residual = np.linalg.norm(states.measured - torque)
            shares.append(100.0 * float(residual / np.linalg.norm(states.measured)))
    unexplained = None
    if shares:
        unexplained = shares[0], shares[1]
    expected = np.sqrt(variances[0] + variances[1])
    return TorqueChange(name, states.t, torques[1] - torques[0], expected, torques[1], unexplained)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
