"""What changed between two identified models of a robot's dynamics: a test in base parameters, and the torque's change.

The combinations are the base parameters, each by its σ; what a standard parameter, or all of a joint's friction or of
its link, does to them is in the regrouping of the later model. They are tested (`change_test`). The change of the
torque is what the two models differ by over motions, Δτ = W₂ χ₂ - W₁ χ₁, each with its own geometry; both
covariances let expect (w₁ Σ₁ w₁ᵀ + w₂ Σ₂ w₂ᵀ) of its square.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np

from calib.apps.monitoring.comparison.change_test import ChangeTest, ParameterChange, Tested, tested
from calib.apps.monitoring.comparison.identifications import Identified, MotionStates
from calib.toolkit.torque_models import IdentificationModel, parameter_variances, standard_name

PARALLEL = 1e-6  # sine of an angle between what two parameters do to the combinations, below which they are one
NEARLY_ALL = 0.9  # of χ²; σ of real motions holds no unmodelled effects, which leave a rest (our choice)


@dataclass(frozen=True, eq=False)
class TorqueChange:
    """Change of the torque over one motion.

    Attributes:
        where: which motion.
        t: (N,) samples' times [s]; numbers where the table has none.
        change, expected: (N, rows) later minus earlier, and its σ by both covariances [N m or N].
        torque: (N, rows) of the later model.
        unexplained: of the measured torque by the earlier and the later model, all rows [%]; None if none was measured.
    """

    where: str
    t: np.ndarray
    change: np.ndarray
    expected: np.ndarray
    torque: np.ndarray
    unexplained: tuple[float, float] | None

    @property
    def rms(self) -> float:
        """Rms change over all rows [N m or N]."""
        return _rms(self.change)


@dataclass(frozen=True)
class PartChange:
    """The friction of a joint, or the body of a link: what it explains of the difference if it changed alone.

    Attributes:
        name: of the part.
        explained: of χ².
        count: of its combinations.
        rms: change of the torque over the first motion if nothing else had changed [N m or N].
    """

    name: str
    explained: float
    count: int
    rms: float


@dataclass(frozen=True)
class DynamicsChange(ChangeTest):
    """What changed between two identified models; the test is in `ChangeTest`.

    Attributes:
        parts: friction of each joint, body of each link: the one that explains most first.
        torques: over each motion.
    """

    parts: tuple[PartChange, ...]
    torques: tuple[TorqueChange, ...]

    @property
    def part(self) -> PartChange | None:
        """The part that explains most, if it explains all but chance, or `NEARLY_ALL` of χ²; else None."""
        first = self.parts[0]
        enough = self.suffices(first.explained, first.count) or first.explained > NEARLY_ALL * self.chi2
        return first if enough else None


def compare(before: Identified, after: Identified, motions: dict[str, MotionStates]) -> DynamicsChange:
    """Return what changed between two models of one robot, the torque over motions."""
    keys = list(dict.fromkeys([*before.keys, *after.keys]))
    values, covariances = zip(*(_spread(model, keys) for model in (before, after)))
    sigma = np.sqrt(np.diag(np.add(*covariances)))
    unit = np.where(sigma > 0.0, sigma, 1.0)
    spans = [np.eye(len(keys))[:, np.diag(model) > 0.0] for model in covariances]
    standard = _standard(before, after, keys)
    columns = np.column_stack([column for _, _, column in standard]) / unit[:, None]
    scaled = [model / np.outer(unit, unit) for model in covariances]
    test, _ = tested((values[1] - values[0]) / unit, scaled, spans, columns)
    changes = []
    for k in _apart(columns, len(keys)):
        values_and_sigma = (values[0][k], values[1][k], sigma[k]) if k < len(keys) else (np.nan, np.nan, 0.0)
        name, kind, _ = standard[k]
        changes.append(ParameterChange(name, kind, *values_and_sigma, *test.alone(k)))
    changes.sort(key=lambda model: -model.explained)
    names = [standard_name(name, after.model.names) for name, _, _ in standard]
    torques = tuple(_torque(name, states, before, after) for name, states in motions.items())
    parts = _parts(test, after.model, names, next(iter(motions.values())))
    return DynamicsChange(test.chi2, len(test.difference), tuple(changes), test.extra, parts, torques)


def _spread(model: Identified, keys: list[Hashable]) -> tuple[np.ndarray, np.ndarray]:
    """Return the values (s,) and the covariance (s, s) of a model's parameters among all that either has."""
    indices = [keys.index(key) for key in model.keys]
    values, covariance = np.zeros(len(keys)), np.zeros((len(keys),) * 2)
    values[indices], covariance[np.ix_(indices, indices)] = model.values, model.covariance
    return values, covariance


def _standard(before: Identified, after: Identified, keys: list[Hashable]) -> list[tuple[str, str, np.ndarray]]:
    """Return name, unit, and what it does to the s combinations (s,), of each of these and of regrouped parameters."""
    name_and_unit = {
        key: (name, unit) for model in (before, after) for key, name, unit in zip(model.keys, model.names, model.units)
    }
    rows = [(*name_and_unit[key], column) for key, column in zip(keys, np.eye(len(keys)))]
    names_present = {key if isinstance(key, str) else key[0] for key in keys}  # type: ignore[index]
    units = dict(zip(after.model.names, after.model.units))
    for name in dict.fromkeys(name for row in after.regrouping.values() for name in row if name not in names_present):
        column = np.zeros(len(keys))
        for key, row in after.regrouping.items():
            column[keys.index(key)] = row.get(name, 0.0)
        rows.append((name, units[name], column))
    return rows


def _apart(columns: np.ndarray, first: int) -> list[int]:
    """Return the columns (s, p) without those that another one's change would look like; the `first` ones are kept."""
    size = np.linalg.norm(columns, axis=0)
    unit = columns / np.where(size > 0.0, size, 1.0)
    chosen = list(range(first))
    for k in range(first, len(size)):
        if size[k] > 0.0 and np.abs(unit[:, chosen].T @ unit[:, k]).max() < 1.0 - PARALLEL:
            chosen.append(k)
    return chosen


def _parts(test: Tested, arm: IdentificationModel, names: list[str], states: MotionStates) -> tuple[PartChange, ...]:
    """Return each joint's friction and each link's body with what it explains."""
    column_of, result = {name: k for k, name in enumerate(arm.names)}, []
    for part, members in {**_frictions(arm), **_links(arm)}.items():
        chosen = np.array([k for k, name in enumerate(names) if name in members], dtype=int)
        if len(chosen):
            steps, explained, count = test.together(chosen)
            change = np.zeros(arm.p)
            change[[column_of[names[k]] for k in chosen]] = steps[chosen]
            result.append(PartChange(part, explained, count, _rms(arm.torque(change, *states.motion, ()))))
    return tuple(sorted(result, key=lambda part_change: -part_change.explained))


def _frictions(model: IdentificationModel) -> dict[str, set[str]]:
    rows = range(model.n)
    return {f"the friction of joint {j + 1}": {t.name for t in model.columns if t.acts[0][0] == j} for j in rows}


def _links(model: IdentificationModel) -> dict[str, set[str]]:
    names = model.names[: model.inertial]
    return {f"the body of link {k // 10 + 1}": set(names[k : k + 10]) for k in range(0, len(names), 10)}


def _torque(name: str, states: MotionStates, before: Identified, after: Identified) -> TorqueChange:
    torque_before, torque_after = (
        model.model.torque(model.dynamics.values, *states.motion, ()) for model in (before, after)
    )
    variances = [
        parameter_variances(model.dynamics, model.columns, model.covariance, *states.motion, ())
        for model in (before, after)
    ]
    unexplained, measured = None, states.measured
    if measured is not None:
        residual_percent = [
            100.0 * float(np.linalg.norm(measured - model) / np.linalg.norm(measured))
            for model in (torque_before, torque_after)
        ]
        unexplained = residual_percent[0], residual_percent[1]
    return TorqueChange(
        name, states.t, torque_after - torque_before, np.sqrt(np.add(*variances)), torque_after, unexplained
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
