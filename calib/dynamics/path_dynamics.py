"""Dynamics of a robot along a path q = Φ(s), from the regressor of its identification model.

    tau = A(s) s̈ + B(s) ṡ² + Γ(s) + f(Φ, Φ' ṡ),    v = Φ' ṡ,    a = Φ' s̈ + Φ'' ṡ²
    Γ = w(Φ, 0, 0) X,    B = w(Φ, Φ', Φ'') X - Γ,    A = w(Φ, Φ', Φ' + Φ'') X - B - Γ = w(Φ, 0, Φ') X - Γ

(Kolyubin, Shiriaev, Jubien 2019, Proposition 1, eq. 29 to 32), where w is the regressor. So A = M Φ', B = M Φ'' + C(Φ,
Φ') Φ' and Γ = G are found without computing M, C or G. X are the parameters without friction (their Remark 2). Motor
inertia Ia is part of M if tau is the motors' torque; a torque offset or a spring is part of Γ. All terms that depend on
speed form the friction f: Coulomb friction depends on the sign of Φ', and viscous friction is proportional to ṡ, so
that it is not affine in ṡ².
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
    """Dynamics along a path: a model with parameter values, in which friction is separate from all other torques.

    Attributes:
        regressor: function that maps q, v, a (N, n) to a regressor (N, rows, b), whose last n rows are the limited
            torques.
        parameters: (b,) parameters X of the module's docstring, without friction.
        terms, amounts: all k drive terms, with the exact Coulomb sign, and their values (k,).
        bodies, inertial: bodies and their standard parameters (10 B,).
    """

    regressor: Regressor
    parameters: np.ndarray
    terms: tuple[DriveTerm, ...]
    amounts: np.ndarray
    bodies: Bodies
    inertial: np.ndarray

    def __post_init__(self) -> None:
        for name in ("parameters", "amounts", "inertial"):
            values = np.asarray(getattr(self, name), dtype=float)
            checked = shaped(values, (None,), f"path dynamics, {name}")
            object.__setattr__(self, name, frozen(checked))

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.bodies.n

    def along(
        self, q: np.ndarray, slope: np.ndarray, curvature: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the coefficients A, B, Γ of the torques A s̈ + B ṡ² + Γ, each (N, n), at N points of the path.

        Args:
            q, slope, curvature: (N, n) path q = Φ(s) and its derivatives Φ', Φ'' with respect to the path parameter s.
        """
        zero = np.zeros_like(q)
        gravity = self.rigid(q, zero, zero)
        by_acceleration = self.rigid(q, zero, slope) - gravity
        by_square_of_speed = self.rigid(q, slope, curvature) - gravity
        return by_acceleration, by_square_of_speed, gravity

    def rigid(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the torques (N, n) [N m or N] without friction.

        Args:
            q, v, a: (N, n) the motion [rad or m, and per s, per s²].
        """
        return self.regressor(q, v, a)[:, -self.n :] @ self.parameters

    def friction(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the friction torques (N, n).

        The state of friction with hysteresis is taken as ±1, the value in continued sliding.

        Args:
            q, v, a: (N, n) the motion [rad or m, and per s, per s²].
        """
        terms, amounts = [], []
        for term, amount in zip(self.terms, self.amounts):
            if term.form.friction:
                terms.append(term)
                amounts.append(amount)
        load = None
        if any(term.form.loaded for term in terms):
            load = rigid_body.inverse_dynamics(self.bodies, np.array(self.inertial), q, v, a)
        return self._drives(terms, np.array(amounts), q, v, a, load)

    def torque(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the complete torques (N, n) of a motion, friction included, by recursive Newton-Euler.

        Args:
            q, v, a: (N, n) the motion [rad or m, and per s, per s²].
        """
        load = rigid_body.inverse_dynamics(self.bodies, np.array(self.inertial), q, v, a)
        return load + self._drives(self.terms, np.asarray(self.amounts), q, v, a, load)

    def _drives(
        self,
        terms: Sequence[DriveTerm],
        amounts: np.ndarray,
        q: np.ndarray,
        v: np.ndarray,
        a: np.ndarray,
        load: np.ndarray | None,
    ) -> np.ndarray:
        """Return the torques (N, n) of drive terms with parameter values `amounts` (k,).

        Args:
            terms, amounts: drive terms and their values.
            q, v, a: (N, n) the motion.
            load: (N, n) torques that the gears transmit [N m or N]; None if no term depends on them.
        """
        motions: list[np.ndarray | None] = [np.ascontiguousarray(series.T) for series in (q, v, a)]
        motions.append(None if load is None else load.T)
        columns = np.zeros((len(terms), self.n, len(q)))
        drives.fill(terms, columns, motions, _stressed(terms, np.ascontiguousarray(v.T)))
        return np.einsum("k,kjN->Nj", amounts, columns)


def of_standard(model: IdentificationModel, values: np.ndarray) -> PathDynamics:
    """Return the path dynamics of a model with parameter values (p,), with all payloads attached.

    Args:
        model: the identification model.
        values: (p,) standard parameters, or base parameters with zeros for the regrouped ones.

    Raises:
        CalibError: if the model's rows contain no body parameters.
    """
    values = shaped(values, (model.p,), "parameters of the model")
    if not model.torque_rows.has_bodies:
        raise CalibError("rows tau - tau_l contain no bodies: no motion planning; use a model of the torques tau")
    body_values = values[: model.inertial]
    term_values = values[model.inertial :]
    without_friction = []
    rigid_values = list(body_values)
    terms, amounts = [], []
    for term, value in zip(model.columns, term_values):
        if not term.form.friction:
            without_friction.append(term)
            rigid_values.append(value)
        if value:
            terms.append(_with_exact_sign(term))
            amounts.append(value)
    rigid_model = replace(model, terms=tuple(without_friction))
    return PathDynamics(
        regressor=rigid_model.regressor,
        parameters=np.array(rigid_values),
        terms=tuple(terms),
        amounts=np.array(amounts, dtype=float),
        bodies=model.bodies,
        inertial=np.array(body_values),
    )


def _with_exact_sign(term: DriveTerm) -> DriveTerm:
    """Return the term with the exact Coulomb sign instead of the smoothed sign, which is smaller at low speed."""
    if term.form.tabulated:
        return term
    settings = []
    for name, setting in zip(term.form.settings, term.settings):
        settings.append(0.0 if name == "v0" else setting)
    return replace(term, settings=tuple(settings))


def _stressed(terms: Sequence[DriveTerm], v: np.ndarray) -> np.ndarray:
    """Return the states (s, N), ±1, of the terms' stop operators that slide in the direction of velocity v (n, N)."""
    count = v.shape[1]
    states = []
    for term in terms:
        if not term.form.remembers:
            continue
        for _, motion in term.acts:
            speed = np.zeros(count)
            for joint, weight in motion:
                speed = speed + weight * v[joint]
            states.append(np.sign(speed))
    return np.array(states).reshape(len(states), count)
