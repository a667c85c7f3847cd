"""Constraints on a motion: functions that must be at most zero at every sample, with exact gradients.

Joint, velocity, acceleration and jerk limits are linear in the variables; torques come from a regressor and parameters,
with a margin for their uncertainty; positions of the tool and of named points, and distances between bodies, come from
callables with derivative products. A constraint has values g_ik at sample i in column k. For the optimiser, each group
of columns (such as both signs of one joint's limit) is replaced by one smooth function,

    c_r = (1/ρ) log Σ_{i, k in r} exp(ρ g_ik / scale_k)  ≥  max g / scale      (Kreisselmeier & Steinhauser 1979)

so that all samples are feasible where c ≤ 0. `calib.trajectories.design.verify` checks the motion between the samples.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np

from .basis import ORDERS, SampledMotion
from .errors import BadInput, require

Regressor = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
Slopes = tuple[np.ndarray, np.ndarray, np.ndarray]
Product = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], Slopes]
TorqueProduct = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray], Slopes]
UNITS = ("rad", "rad/s", "rad/s²", "rad/s³")
LINEAR_UNITS = ("m", "m/s", "m/s²", "m/s³")


class MotionConstraint(Protocol):
    """Constraint with values (N, k) at N samples, satisfied where ≤ 0; each value depends on one sample only.

    Attributes:
        name: the constraint's name in messages.
        unit: unit of its values.
        labels: (k,) names of the columns.
        scale: (k,) [unit] numbers by which values are divided to compare different constraints.
        groups: (k,) group number of each column; the optimiser gets one smooth function per group.
    """

    @property
    def name(self) -> str: ...
    @property
    def unit(self) -> str: ...
    @property
    def labels(self) -> tuple[str, ...]: ...
    @property
    def scale(self) -> np.ndarray: ...
    @property
    def groups(self) -> np.ndarray: ...
    def values(self, motion: SampledMotion) -> np.ndarray: ...
    def slopes(self, motion: SampledMotion, weights: np.ndarray) -> np.ndarray:
        """Return the gradients (4, N, n) of Σ weights (N, k) · values by q, v, a, jerk of the motion."""
        ...


class TwoSided:
    """Two-sided limit, whose columns are the upper sides of the limited joints and then their lower sides.

    Attributes:
        joints: indices (from 0) of the limited joints.
        rows: names of all joints; empty for "joint 1", "joint 2" ...
    """

    joints: np.ndarray
    rows: tuple[str, ...] = ()

    @property
    def labels(self) -> tuple[str, ...]:
        if self.rows:
            names = [self.rows[j] for j in self.joints]
        else:
            names = [f"joint {j + 1}" for j in self.joints]
        return tuple(f"{name} {side}" for side in ("upper", "lower") for name in names)

    @property
    def groups(self) -> np.ndarray:
        return np.tile(np.arange(len(self.joints)), 2)


@dataclass(frozen=True, eq=False)
class BoxLimit(TwoSided):
    """Box limit lower ≤ d^r q / dt^r ≤ upper.

    Attributes:
        order: r, 0 to 3.
        lower, upper: (n,) limits [rad or m, per s^r]; infinite where there is no limit.
        unit: unit of the values in messages; empty for the unit of a revolute joint.
        rows: names of the n joints; empty for "joint 1", "joint 2" ...

    Raises:
        BadInput: limits of the wrong shape, a lower limit above the upper, or limits of a derivative that exclude zero.
    """

    order: int
    lower: np.ndarray
    upper: np.ndarray
    unit: str = ""
    rows: tuple[str, ...] = ()
    joints: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        lower = np.asarray(self.lower, dtype=float)
        upper = np.asarray(self.upper, dtype=float)
        kind = ORDERS[self.order]
        if lower.shape != upper.shape or lower.ndim != 1 or np.isnan(lower).any() or np.isnan(upper).any():
            raise BadInput(f"{kind} limits: expected two (n,) arrays of numbers, found {lower} and {upper}")
        if not (lower < upper).all():
            j = int(np.argmax(lower >= upper))
            raise BadInput(
                f"{kind} limits of joint {j + 1}: lower {lower[j]:g} is not below upper {upper[j]:g}; a joint that may "
                "not move is locked with 0 harmonics"
            )
        if self.order and not ((lower < 0) & (upper > 0)).all():
            raise BadInput(f"{kind} limits must include zero (the motion starts at rest), found {lower}, {upper}")
        object.__setattr__(self, "lower", lower)
        object.__setattr__(self, "upper", upper)
        object.__setattr__(self, "unit", self.unit or UNITS[self.order])
        limited = np.isfinite(lower) & np.isfinite(upper)
        object.__setattr__(self, "joints", np.flatnonzero(limited))

    @property
    def name(self) -> str:
        return ORDERS[self.order]

    @property
    def scale(self) -> np.ndarray:
        half_range = (self.upper - self.lower)[self.joints] / 2
        return np.tile(half_range, 2)

    def values(self, motion: SampledMotion) -> np.ndarray:
        x = motion.orders[self.order][:, self.joints]
        above = x - self.upper[self.joints]
        below = self.lower[self.joints] - x
        return np.concatenate([above, below], axis=1)

    def slopes(self, motion: SampledMotion, weights: np.ndarray) -> np.ndarray:
        result = np.zeros((4, *motion.q.shape))
        k = len(self.joints)
        signed = weights[:, :k] - weights[:, k:]
        result[self.order][:, self.joints] = signed
        return result


@dataclass(frozen=True, eq=False)
class TorqueLimit(TwoSided):
    """Torque limit |Y χ| + k √(y Σ yᵀ) ≤ (1 - margin) τ_max, with y a row of Y and k σ of the torque as a margin.

    Attributes:
        regressor: (q, v, a) -> observation matrix Y (N, n, b); torques are Y χ.
        product: derivative product of the regressor, (q, v, a, G (N, n, b)) -> gradients of Σ G · Y by q, v, a, each
            (N, n).
        parameters: (b,) dynamic parameters χ.
        limits: (n,) τ_max [N m or N]; infinite where there is none.
        covariance: (b, b) covariance Σ of χ; None takes χ as exact.
        deviations: k, the number of standard deviations.
        margin: further margin, as a share of the limits.
        torque_product: (q, v, a, χ, G (N, n)) -> slopes of Σ G · Y χ in q, v, a, if cheaper to compute than by
            `product`; None uses `product`.
        rows: names of the n joints; empty for "joint 1", "joint 2" ...

    Raises:
        BadInput: parameters that are not finite, limits not above zero, or a margin below 0, or of 1 or more.
    """

    regressor: Regressor
    product: Product
    parameters: np.ndarray
    limits: np.ndarray
    covariance: np.ndarray | None = None
    deviations: float = 2.0
    margin: float = 0.0
    torque_product: TorqueProduct | None = None
    name: str = "torque"
    unit: str = "N m"
    rows: tuple[str, ...] = ()
    joints: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        if not np.isfinite(self.parameters).all():
            k = int(np.argmin(np.isfinite(self.parameters)))
            raise BadInput(f"torque model: parameter {k + 1} is not finite ({self.parameters[k]})")
        require((self.limits > 0).all(), f"torque limits must be above zero, found {self.limits}")
        require(0 <= self.margin < 1, f"torque margin {self.margin}: expected a share of the limits from 0 to below 1")
        object.__setattr__(self, "joints", np.flatnonzero(np.isfinite(self.limits)))

    @property
    def scale(self) -> np.ndarray:
        return np.tile(self.limits[self.joints], 2)

    def values(self, motion: SampledMotion) -> np.ndarray:
        Y = motion.evaluated(self.regressor)
        torque = (Y @ self.parameters)[:, self.joints]
        bound = (1 - self.margin) * self.limits[self.joints]
        if self.covariance is not None:
            Y = Y[:, self.joints]
            variance = np.einsum("njb,njb->nj", Y @ self.covariance, Y)
            bound = bound - self.deviations * np.sqrt(variance)
        return np.concatenate([torque - bound, -torque - bound], axis=1)

    def slopes(self, motion: SampledMotion, weights: np.ndarray) -> np.ndarray:
        k = len(self.joints)
        signed = np.zeros((len(motion), len(self.limits)))
        result = np.zeros((4, *motion.q.shape))
        signed[:, self.joints] = weights[:, :k] - weights[:, k:]
        if self.covariance is None and self.torque_product is not None:
            result[:3] = self.torque_product(motion.q, motion.v, motion.a, self.parameters, signed)
            return result
        G = signed[:, :, None] * self.parameters
        if self.covariance is not None:
            Y = self.regressor(motion.q, motion.v, motion.a)[:, self.joints]
            spread_rows = Y @ self.covariance
            variance = np.einsum("njb,njb->nj", spread_rows, Y)
            spread = np.sqrt(np.maximum(variance, 1e-30))
            both_sides = weights[:, :k] + weights[:, k:]
            factor = self.deviations * both_sides / spread
            G[:, self.joints] += factor[:, :, None] * spread_rows
        result[:3] = self.product(motion.q, motion.v, motion.a, G)
        return result


def box_limits(
    lower: np.ndarray,
    upper: np.ndarray,
    velocity: np.ndarray | None = None,
    acceleration: np.ndarray | None = None,
    jerk: np.ndarray | None = None,
    linear: Sequence[bool] | None = None,
) -> tuple[BoxLimit, ...]:
    """Return the limits of position and of the absolute values of velocity, acceleration and jerk, each (n,).

    Args:
        lower, upper: position limits [rad or m]; infinite for no limit.
        velocity, acceleration, jerk: largest absolute values [rad or m, per s, s², s³]; None for no limit of that
            order.
        linear: whether each joint is prismatic; None: all joints are revolute.

    Raises:
        BadInput: a limit that is not a number or not above zero, or a lower limit above the upper.
    """
    units = UNITS
    if linear and all(linear):
        units = LINEAR_UNITS
    limits = [BoxLimit(0, lower, upper, units[0])]
    for order, bound in enumerate((velocity, acceleration, jerk), 1):
        if bound is None:
            continue
        sizes = np.asarray(bound, dtype=float)
        if not (sizes > 0).all():
            below_zero_if_nan = np.where(np.isnan(sizes), -1.0, sizes)
            j = int(np.argmin(below_zero_if_nan))
            raise BadInput(
                f"{ORDERS[order]} limit of joint {j + 1} is {sizes[j]:g}: it must be above zero; a joint that may "
                "not move is locked with 0 harmonics"
            )
        limits.append(BoxLimit(order, -sizes, sizes, units[order]))
    return tuple(limit for limit in limits if len(limit.joints))


class Smoothed(NamedTuple):
    """Smoothed values c of a constraint along a motion, one per group of columns.

    Attributes:
        constraint: the constraint.
        values: (r,) c of the r groups.
        excess: max g / scale + tightening, the largest unsmoothed value.
        shares: (N, k) derivative of the group's value c by the scaled value of each sample and column.
        in_group: (r, k) True where a column is part of a group.
    """

    constraint: MotionConstraint
    values: np.ndarray
    excess: float
    shares: np.ndarray
    in_group: np.ndarray

    def slopes(self, motion: SampledMotion) -> np.ndarray:
        """Return the gradients (r, 4, N, n) of the r smoothed values by q, v, a, jerk of the motion."""
        # nine digits without the small shares
        counts = self.in_group[:, None] & (self.shares > 1e-9)
        group, row = np.nonzero(counts.any(axis=2))
        scaled_shares = self.shares[row] / self.constraint.scale
        weights = np.where(self.in_group[group], scaled_shares, 0.0)
        result = np.zeros((len(self.in_group), 4, *motion.q.shape))
        slopes = self.constraint.slopes(motion.part(row), weights)
        result[group, :, row] = slopes.transpose(1, 0, 2)
        return result


def smoothed(
    constraint: MotionConstraint, motion: SampledMotion, sharpness: float, tightening: float = 0.0
) -> Smoothed:
    """Return the smoothed values of a constraint along a motion; their gradients are computed by `Smoothed.slopes`.

    Args:
        constraint: the constraint.
        motion: the motion at its samples.
        sharpness: ρ of the smoothed maximum (1/ρ) log Σ exp(ρ g / scale); the larger, the closer to the maximum.
        tightening: number added to every scaled value g / scale, to keep the motion inside the limit.
    """
    scaled = constraint.values(motion) / constraint.scale + tightening
    groups = constraint.groups
    count = int(constraint.groups.max()) + 1
    in_group = groups == np.arange(count)[:, None]  # (r, k)
    top = np.array([scaled[:, columns].max() for columns in in_group])
    shares = np.exp(sharpness * (scaled - top[groups]))
    total = in_group @ shares.sum(axis=0)
    shares /= total[groups]
    values = top + np.log(total) / sharpness
    return Smoothed(constraint, values, float(top.max()), shares, in_group)
