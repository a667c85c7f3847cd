"""Dynamics of a robot along a path q = Φ(s), from the regressor of its identification model.

    tau = A(s) s̈ + B(s) ṡ² + Γ(s) + f(Φ, Φ' ṡ),    v = Φ' ṡ,    a = Φ' s̈ + Φ'' ṡ²
    Γ = w(Φ, 0, 0) X,    B = w(Φ, Φ', Φ'') X - Γ,    A = w(Φ, Φ', Φ' + Φ'') X - B - Γ = w(Φ, 0, Φ') X - Γ

(Kolyubin, Shiriaev, Jubien 2019, Proposition 1, eq. 29 to 32), so A = M Φ', B = M Φ'' + C(Φ, Φ') Φ' and Γ = G without
any of M, C, G. X are the parameters without friction (Remark 2 there): motor inertia Ia belongs to M where tau is the
motors' torque, and a torque offset or a spring to Γ. Every term that depends on speed is friction f: Coulomb's is a
sign that the direction of Φ' decides, viscous friction goes with ṡ, which is not affine in ṡ².
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.dynamics import drives, rigid_body
from calib.dynamics.bodies import Bodies
from calib.dynamics.drives import DriveTerm
from calib.dynamics.idim import IdentificationModel
from calib.errors import CalibError
from calib.records import frozen, shaped

Regressor = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class PathDynamics:
    """A model with parameter values, friction separate from the rest.

    Attributes:
        regressor: maps q, v, a (N, n) to (N, rows, b); the last n rows are the limited torques.
        parameters: (b,) X, zero for friction.
        terms, amounts: all drive terms and their (k,) values; Coulomb's sign is the exact one.
        bodies, inertial: bodies and their (10 B,) parameters.
    """

    regressor: Regressor
    parameters: np.ndarray
    terms: tuple[DriveTerm, ...]
    amounts: np.ndarray
    bodies: Bodies
    inertial: np.ndarray

    def __post_init__(self) -> None:
        for key in ("parameters", "amounts", "inertial"):
            value = np.asarray(getattr(self, key), dtype=float)
            object.__setattr__(self, key, frozen(shaped(value, (None,), f"path dynamics, {key}")))

    @property
    def n(self) -> int:
        return self.bodies.n

    def along(
        self, q: np.ndarray, slope: np.ndarray, curvature: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the coefficients A, B, Γ of the path dynamics, each (N, n), at Φ, Φ', Φ'' (N, n)."""
        still = np.zeros_like(q)
        gravity = self.rigid(q, still, still)
        return self.rigid(q, still, slope) - gravity, self.rigid(q, slope, curvature) - gravity, gravity

    def rigid(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the torques (N, n) without friction."""
        return self.regressor(q, v, a)[:, -self.n :] @ self.parameters

    def friction(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the friction torques (N, n); friction with hysteresis (stop operators) counts as fully stressed."""
        rubbing = [k for k, one in enumerate(self.terms) if one.form.friction]
        loaded = any(self.terms[k].form.loaded for k in rubbing)
        load = rigid_body.inverse_dynamics(self.bodies, np.array(self.inertial), q, v, a) if loaded else None
        return self._drives(rubbing, q, v, a, load)

    def torque(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the torques (N, n) of a motion with friction, by recursive Newton-Euler."""
        load = rigid_body.inverse_dynamics(self.bodies, np.array(self.inertial), q, v, a)
        return load + self._drives(range(len(self.terms)), q, v, a, load)

    def _drives(self, chosen: Sequence[int], q, v, a, load: np.ndarray | None) -> np.ndarray:
        """Return the torques (N, n) of chosen drive terms."""
        terms = [self.terms[k] for k in chosen]
        motions = [np.ascontiguousarray(x.T) for x in (q, v, a)]
        out = np.zeros((len(terms), self.n, len(q)))
        drives.fill(terms, out, [*motions, None if load is None else load.T], _stressed(terms, motions[1]))
        return np.einsum("k,kjN->Nj", self.amounts[list(chosen)], out)


def of_standard(model: IdentificationModel, values: np.ndarray) -> PathDynamics:
    """Return the path dynamics of a model with standard (or regrouped) parameters (p,), with all payloads."""
    values = shaped(values, (model.p,), "parameters of the model")
    _require_torques(model)
    rubbing = _is_friction(model)
    first = model.inertial
    without = replace(model, terms=tuple(one for one in model.columns if not one.form.friction))
    return PathDynamics(
        without.regressor, values[~rubbing], *_valued(model, values), model.bodies, np.array(values[:first])
    )


def _require_torques(model: IdentificationModel) -> None:
    if not model.torque_rows.has_bodies:
        raise CalibError("rows tau - tau_l contain no bodies: no motion planning; use a model of the torques tau")


def _is_friction(model: IdentificationModel) -> np.ndarray:
    """Return the mask (p,) of friction columns."""
    bodies = np.zeros(model.inertial, dtype=bool)
    return np.concatenate([bodies, np.array([one.form.friction for one in model.columns], dtype=bool)])


def _valued(model: IdentificationModel, values: np.ndarray) -> tuple[tuple[DriveTerm, ...], np.ndarray]:
    """Return the drive terms with non-zero values, with exact Coulomb sign, and their values."""
    found = [(one, x) for one, x in zip(model.columns, values[model.inertial :]) if x]
    return tuple(_sharp(one) for one, _ in found), np.array([x for _, x in found], dtype=float)


def _sharp(one: DriveTerm) -> DriveTerm:
    """Return the term with the exact, unsmoothed Coulomb sign: the larger torque at low speed."""
    names = one.form.settings
    return replace(one, settings=tuple(0.0 if name == "v0" else x for name, x in zip(names, one.settings)))


def _stressed(terms: Sequence[DriveTerm], v: np.ndarray) -> np.ndarray:
    """Return states (s, N) of stop operators that slide in the direction of their motion; v (n, N)."""
    found = [
        np.sign(sum((weight * v[j] for j, weight in motion), np.zeros(v.shape[1])))
        for one in terms
        if one.form.remembers
        for _, motion in one.acts
    ]
    return np.array(found).reshape(len(found), v.shape[1])
