"""Drives as columns of the regressor: motor inertia, friction, offsets, and couplings between joints.

    tau_r += parameter · Σ_joined shape(Σ_j weight_j · motion_j)

A term acts on one torque row or on several, and in each sees the motion of one joint or of a weighted sum of joints, so
a coupled wrist (TX40: tau5 += Iam6 a6 + Fvm6 v6 + Fcm6 sign(v5 + v6), tau6 += Iam6 a5 + Fvm6 v5 + Fcm6 sign(v5 + v6))
is not a special case. Joint numbers here count from 0, in names from 1.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calib.dynamics.shapes import SHAPES, STEPS, V0, Joined, JointRange, Shape
from calib.errors import CalibError, one_of, require

Motion = tuple[tuple[int, float], ...]
STANDARD = {"Ia": "acceleration", "Fv": "velocity", "Fc": "sign", "off": "one"}
LINK_SIDE = {"Fvl": "velocity", "Fcl": "sign", "offl": "one"}
MOTOR_SIDE = {"Ia": "acceleration", "Fvm": "velocity", "Fcm": "sign", "offm": "one"}


@dataclass(frozen=True)
class DriveTerm:
    """One drive term: a column of the regressor.

    Attributes:
        name: of its parameter, e.g. ``Fc3``.
        shape: a key of `SHAPES`.
        acts: pairs (torque row, motion), the motion as pairs (joint, weight); empty for a parameter without effect.
        settings: the numbers that the shape needs; an ``edge`` may be omitted.
        side: "link" or "motor" of a joint torque sensor; without such a sensor all terms are on the motor side.
        linear: whether the joint is prismatic (units).
    """

    name: str
    shape: str
    acts: tuple[tuple[int, Motion], ...]
    settings: tuple[float, ...] = ()
    side: str = "motor"
    linear: bool = False

    def __post_init__(self) -> None:
        one_of(self.shape, SHAPES, f"term '{self.name}': shape")
        wanted = SHAPES[self.shape].settings
        if wanted[:1] == ("edge",) and len(self.settings) == len(wanted) - 1:
            object.__setattr__(self, "settings", (math.inf, *self.settings))
        if len(self.settings) != len(wanted):
            raise CalibError(
                f"term '{self.name}': shape '{self.shape}' needs ({', '.join(wanted)}), not {self.settings}"
            )
        require(self.side in ("link", "motor"), f"term '{self.name}': side '{self.side}', expected 'link' or 'motor'")

    @property
    def form(self) -> Shape:
        return SHAPES[self.shape]

    @property
    def joint(self) -> int | None:
        """Joint whose motion a single-joint term depends on; None for a coupling of joints."""
        if len(self.acts) != 1 or self.acts[0][1] != ((self.acts[0][0], 1.0),):
            return None
        return self.acts[0][0]

    @property
    def nonnegative(self) -> bool:
        """Whether the parameter is physically non-negative; the inertia of a coupling may be negative."""
        return self.form.nonnegative and (self.form.dissipative or self.joint is not None)

    @property
    def unit(self) -> str:
        return self.form.unit_linear if self.linear else self.form.unit

    def acting(self, motions: Sequence[np.ndarray | None], states: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Yield each torque row that a term acts on, and the term's column in it (N,).

        Args:
            motions: as in `fill`.
            states: (s, N) of this term alone, see `friction_states`.
        """
        for k, (row, motion) in enumerate(self.acts):
            seen = _join(self, motion, motions, states[k] if self.form.remembers else None)
            yield row, self.values(seen)

    def values(self, seen: Joined) -> np.ndarray:
        """Return the term's column (N,) for a motion, per unit of the parameter."""
        if self.shape in ("acceleration", "velocity"):
            return seen.a if self.shape == "acceleration" else seen.v
        found = self._evaluated(seen, 1)[0]
        return found * np.abs(seen.load) if self.form.loaded and seen.load is not None else found

    def slopes(self, seen: Joined) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the derivatives of the column with respect to position and velocity (N,), and to acceleration."""
        _, by_x, by_v = self._evaluated(seen, 3)
        return by_x, by_v, float(self.shape == "acceleration")

    def _evaluated(self, seen: Joined, rows: int) -> np.ndarray:
        """Return the value (1, N), or the value with its derivatives with respect to position and velocity (3, N)."""
        from calib.dynamics import shape_kernels

        acts, out = np.zeros((1, 8)), np.empty((rows, len(seen.v)))
        acts[0, 1 : 1 + len(self.settings)] = self.settings
        x, v, state = map(np.ascontiguousarray, (seen.x, seen.v, seen.v if seen.state is None else seen.state))
        shape_kernels.fill(getattr(shape_kernels, self.shape.upper()), acts, x, v, state, out)
        return out


def term(name: str, shape: str, joint: int, *settings: float, side: str = "motor", linear: bool = False) -> DriveTerm:
    """Return a drive term of one joint that depends on that joint's motion."""
    return DriveTerm(name, shape, ((joint, ((joint, 1.0),)),), tuple(map(float, settings)), side, linear)


def standard(
    sets: Sequence[str], v0: float | Sequence[float] = V0, linear: Sequence[bool] | None = None
) -> tuple[DriveTerm, ...]:
    """Return the standard drive terms of n joints, joint after joint.

    Args:
        sets: n strings of names out of Ia Fv Fc off (and Fvl Fcl offl, Fvm Fcm offm), e.g. ``["Ia Fv Fc"] * 6``.
        v0: smoothing of the Coulomb sign [rad/s or m/s], one or per joint.
        linear: which joints are prismatic.
    """
    known = STANDARD | LINK_SIDE | MOTOR_SIDE
    smoothing = np.broadcast_to(np.asarray(v0, dtype=float), (len(sets),))
    result = []
    for joint, names in enumerate(sets):
        for name in names.split():
            require(name in known, f"joint {joint + 1}: drive term '{name}' is none of {', '.join(known)}")
            settings = (smoothing[joint],) if known[name] == "sign" else ()
            side = "link" if name in LINK_SIDE else "motor"
            is_linear = bool(linear[joint]) if linear is not None else False
            result.append(term(f"{name}{joint + 1}", known[name], joint, *settings, side=side, linear=is_linear))
    return tuple(result)


def without_effect(label: str) -> tuple[DriveTerm, ...]:
    """Return the seven drive parameters of a fixed body: the papers count them, they move nothing."""
    named = {"Ia": "acceleration"} | LINK_SIDE | MOTOR_SIDE
    return tuple(
        DriveTerm(name + label, shape, (), (V0,) if shape == "sign" else (), "link" if name in LINK_SIDE else "motor")
        for name, shape in named.items()
    )


def coupled(
    first: int, second: int, v0: float = V0, label: str | None = None, weight: float = 1.0
) -> tuple[DriveTerm, ...]:
    """Return Iam, Fvm, Fcm of a gear whose motor turns with q_first + weight q_second (the TX40 wrist: 4, 5, 1).

        tau_first += Iam a_second + Fvm v_second + Fcm sign(v_first + v_second), and the other way round

    for a weight of 1 (Gautier & Janot's TX40 model; the joints' own Ia Fv Fc hold the rest); of -1: the difference.
    """
    label = str(second + 1) if label is None else label
    crossed = ((first, ((second, weight),)), (second, ((first, weight),)))
    total = ((first, ((first, 1.0), (second, weight))), (second, ((first, weight), (second, 1.0))))
    return (
        DriveTerm(f"Iam{label}", "acceleration", crossed),
        DriveTerm(f"Fvm{label}", "velocity", crossed),
        DriveTerm(f"Fcm{label}", "sign", total, (v0,)),
    )


def fill(terms: Sequence[DriveTerm], out: np.ndarray, motions: Sequence[np.ndarray | None], states: np.ndarray) -> None:
    """Write the columns of terms into out (k, n, N), which must be zero.

    Args:
        motions: q, v, a, load, each (n, N), load None if unknown.
        states: (s, N), see `friction_states`.
    """
    state = 0
    for column, one in zip(out, terms, strict=True):
        own = len(one.acts) if one.form.remembers else 0
        for row, values in one.acting(motions, states[state : state + own]):
            column[row] += values
        state += own


def fill_energies(terms: Sequence[DriveTerm], out: np.ndarray, v: np.ndarray) -> None:
    """Write the kinetic energies ½ Σ weight v_row v_joint of acceleration terms into out (k, N), given v (n, N)."""
    for column, one in zip(out, terms, strict=True):
        for row, motion in one.acts if one.shape == "acceleration" else ():
            for joint, weight in motion:
                column += 0.5 * weight * v[row] * v[joint]


def slopes(
    terms: Sequence[DriveTerm], motions: Sequence[np.ndarray], weights: np.ndarray, out: Sequence[np.ndarray]
) -> None:
    """Add the gradients of Σ weights · columns, weights (k, n, N), with respect to q, v and a to `out`, (n, N) each."""
    for weight, one in zip(weights, terms, strict=True):
        require(one.form.slopes, f"term '{one.name}' ({one.shape}) depends on past motion or torques: no derivatives")
        for row, motion in one.acts:
            parts = one.slopes(_join(one, motion, [*motions, None], None))
            for target, part in zip(out, parts):
                for joint, share in motion:
                    target[joint] += share * weight[row] * part


def friction_states(terms: Sequence[DriveTerm], q: np.ndarray) -> np.ndarray:
    """Return the states (s, N) of friction with hysteresis along a gap-free record q (n, N), starting unstressed.

        z_k = clip(z_{k-1} + (x_k - x_{k-1}) / width, -1, 1):

    stiff within ±width of the last turning point, Coulomb's sign beyond: friction that depends on the past (Iwan 1966;
    several widths side by side are the Maxwell-slip model).
    """
    from calib.dynamics import kernels

    found = []
    for one in terms:
        for _, motion in one.acts if one.form.remembers else ():
            found.append(kernels.stop(sum((w * q[j] for j, w in motion), np.zeros(q.shape[1])), one.settings[0]))
    return np.array(found).reshape(len(found), q.shape[1])


def _join(one: DriveTerm, motion: Motion, motions: Sequence[np.ndarray | None], state: np.ndarray | None) -> Joined:
    """Return the motion of a term: weighted sums of q, v, a and load."""
    if one.form.loaded and motions[3] is None:
        raise CalibError(f"term '{one.name}' needs the transmitted torque; give load (N, n), measured or predicted")
    if len(motion) == 1 and motion[0][1] == 1.0:
        x, v, a, load = (None if m is None else m[motion[0][0]] for m in motions)
    else:
        x, v, a, load = (None if m is None else sum(w * m[j] for j, w in motion) for m in motions)
    return Joined(x, v, a, load, state)  # type: ignore[arg-type]


def offered(step: str, joint: int, seen: JointRange, linear: bool = False) -> tuple[DriveTerm, ...]:
    """Return the candidate terms of one joint in a step of the friction ladder, scaled by the joint's motion."""
    found = [
        (number, term(f"{one.label}{joint + 1}{end}", one.shape, joint, *settings, side=one.side, linear=linear))
        for one in STEPS[step]
        for number, (end, settings) in enumerate(one.settings(seen).items())
    ]
    return tuple(one for _, one in sorted(found, key=lambda pair: pair[0]))
