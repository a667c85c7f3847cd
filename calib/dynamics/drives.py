"""Drive torques as columns of the regressor: motor inertia, friction, offsets, and couplings between joints.

    tau_r += parameter · shape(Σ_j weight_j · motion_j)

A term acts on one torque row r or on several. In each row the term depends on the motion of one joint or of a weighted
sum of joints. A coupled wrist therefore needs no special treatment (TX40: tau5 += Iam6 a6 + Fvm6 v6 + Fcm6 sign(v5 +
v6), tau6 += Iam6 a5 + Fvm6 v5 + Fcm6 sign(v5 + v6)). Joints are counted from 0 in the code, from 1 in names.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calib.dynamics.shapes import SHAPES, STEPS, V0, RecordedRange, Shape, TermMotion
from calib.errors import CalibError, one_of, require
from calib.records import read_only

Motion = tuple[tuple[int, float], ...]
STANDARD = {"Ia": "acceleration", "Fv": "velocity", "Fc": "sign", "off": "one"}
LINK_SIDE = {"Fvl": "velocity", "Fcl": "sign", "offl": "one"}
MOTOR_SIDE = {"Ia": "acceleration", "Fvm": "velocity", "Fcm": "sign", "offm": "one"}


@dataclass(frozen=True)
class DriveTerm:
    """One drive term: a column of the regressor.

    Attributes:
        name: name of the term's parameter, e.g. ``Fc3``.
        shape: a key of `SHAPES`.
        acts: pairs (torque row, motion) for every row that the term affects; a motion is a tuple of pairs (joint,
            weight). Empty for a parameter without effect.
        settings: values of the shape's settings; an ``edge`` may be omitted and is then infinite. Of a table: place,
            value and slope of each knot.
        side: side of the joint torque sensor, "link" or "motor"; without such a sensor all terms are on the motor side.
        linear: whether the joint is prismatic, which decides the units.
    """

    name: str
    shape: str
    acts: tuple[tuple[int, Motion], ...]
    settings: tuple[float, ...] = ()
    side: str = "motor"
    linear: bool = False

    def __post_init__(self) -> None:
        one_of(self.shape, SHAPES, f"term '{self.name}': shape")
        names = SHAPES[self.shape].settings
        if names[:1] == ("edge",) and len(self.settings) == len(names) - 1:
            object.__setattr__(self, "settings", (math.inf, *self.settings))
        if self.form.tabulated:
            self._check_table()
        elif len(self.settings) != len(names):
            raise CalibError(
                f"term '{self.name}': shape '{self.shape}' needs ({', '.join(names)}), not {self.settings}"
            )
        require(self.side in ("link", "motor"), f"term '{self.name}': side '{self.side}', expected 'link' or 'motor'")

    def _check_table(self) -> None:
        """Raise an error unless the settings are two or more knots at rising places."""
        places = np.array(self.settings[::3])
        knots_complete = len(self.settings) == 3 * len(places) and len(places) >= 2
        if not knots_complete or not np.isfinite(self.settings).all() or (np.diff(places) <= 0.0).any():
            raise CalibError(
                f"term '{self.name}': shape '{self.shape}' needs two knots or more, each a place, a value and a slope, "
                f"at rising places; found {len(self.settings)} numbers"
            )

    def packed(self, first: int) -> tuple[list[float], list[float]]:
        """Return the term's seven settings for the compiled shapes, and what stands behind them in their row.

        Args:
            first: column of the row from which this stands.
        """
        settings = list(self.settings)
        table: list[float] = []
        if self.form.tabulated:
            table = settings
            steepest = float(np.abs(table[2::3]).max())
            settings = [len(table) // 3, first, steepest, table[-3]]
        return settings + [0.0] * (7 - len(settings)), table

    @property
    def form(self) -> Shape:
        """Description of the term's shape: units, settings and properties."""
        return SHAPES[self.shape]

    @property
    def joint(self) -> int | None:
        """Joint of a term that acts on one joint and depends on its motion alone; None for a coupling of joints."""
        if len(self.acts) != 1:
            return None
        row, motion = self.acts[0]
        return row if motion == ((row, 1.0),) else None

    @property
    def nonnegative(self) -> bool:
        """Whether the parameter must not be negative for physical reasons; a coupling's inertia may be negative."""
        return self.form.nonnegative and (self.form.dissipative or self.joint is not None)

    @property
    def unit(self) -> str:
        """Unit of the term's parameter."""
        return self.form.unit_linear if self.linear else self.form.unit

    def acting(self, motions: Sequence[np.ndarray | None], states: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Yield each torque row that the term acts on, with the term's column (N,) in this row.

        Args:
            motions: q, v, a [rad or m, per s, per s²] and load [N m or N], (n, N) each; load (the torque that the gears
                transmit) is None if the term does not need it.
            states: (s, N) hysteresis states of this term alone, from `friction_states`; s is 0 for a term without
                hysteresis.
        """
        for k, (row, motion) in enumerate(self.acts):
            state = states[k] if self.form.remembers else None
            yield row, self.values(_join(self, motion, motions, state))

    def values(self, joined: TermMotion) -> np.ndarray:
        """Return the term's column (N,), its torque per unit of the parameter, for the motion `joined`."""
        if self.shape == "acceleration":
            return joined.a
        if self.shape == "velocity":
            return joined.v
        values = self._evaluated(joined, 1)[0]
        if self.form.loaded and joined.load is not None:
            return values * np.abs(joined.load)
        return values

    def slopes(self, joined: TermMotion) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the derivatives of the term's column by position (N,), velocity (N,) and acceleration (a number).

        Args:
            joined: motion that the term depends on.
        """
        _, by_x, by_v = self._evaluated(joined, 3)
        return by_x, by_v, float(self.shape == "acceleration")

    def _evaluated(self, joined: TermMotion, rows: int) -> np.ndarray:
        """Return the shape's value, with its derivatives by position and velocity if `rows` is 3, as (rows, N).

        Args:
            joined: motion of N samples that the term depends on.
            rows: 1 for the value alone, 3 with the derivatives.
        """
        from calib.dynamics import shape_kernels

        settings, table = self.packed(8)
        acts = np.array([[0.0, *settings, *table]])
        # read-only all three: numba compiles a kernel for each combination of arrays that may be written and may not
        x = _to_read(joined.x)
        v = _to_read(joined.v)
        state = v if joined.state is None else _to_read(joined.state)
        out = np.empty((rows, len(joined.v)))
        code = getattr(shape_kernels, self.shape.upper())
        shape_kernels.fill(code, acts, x, v, state, out)
        return out


def _to_read(values: np.ndarray) -> np.ndarray:
    """Return a view of an array (N,), or a copy where it is not contiguous, that cannot be written."""
    return read_only(np.ascontiguousarray(values).view())


def term(name: str, shape: str, joint: int, *settings: float, side: str = "motor", linear: bool = False) -> DriveTerm:
    """Return a drive term that acts on one joint and depends on that joint's motion.

    Args:
        name: name of the term's parameter.
        shape: a key of `SHAPES`.
        joint: joint, from 0.
        settings: values of the shape's settings, in the order of `Shape.settings`.
        side: "link" or "motor" side of a joint torque sensor.
        linear: whether the joint is prismatic.
    """
    motion = ((joint, 1.0),)
    numbers = tuple(float(setting) for setting in settings)
    return DriveTerm(name, shape, ((joint, motion),), numbers, side, linear)


def standard(
    sets: Sequence[str], v0: float | Sequence[float] = V0, linear: Sequence[bool] | None = None
) -> tuple[DriveTerm, ...]:
    """Return the standard drive terms of n joints, joint after joint.

    Args:
        sets: n strings, one per joint, of term names from Ia Fv Fc off (motor inertia, viscous and Coulomb friction,
            offset; with a torque sensor Fvl Fcl offl on its link side, Fvm Fcm offm on its motor side), e.g. ``["Ia Fv
            Fc"] * 6``.
        v0: smoothing of the Coulomb sign [rad/s or m/s], one value or one per joint.
        linear: (n,) whether each joint is prismatic; None: no joint is.

    Raises:
        CalibError: for an unknown term name.
    """
    shapes = STANDARD | LINK_SIDE | MOTOR_SIDE
    smoothing = np.broadcast_to(np.asarray(v0, dtype=float), (len(sets),))
    if linear is None:
        linear = [False] * len(sets)
    terms = []
    for joint, names in enumerate(sets):
        for name in names.split():
            require(name in shapes, f"joint {joint + 1}: drive term '{name}' is none of {', '.join(shapes)}")
            shape = shapes[name]
            settings = (smoothing[joint],) if shape == "sign" else ()
            side = "link" if name in LINK_SIDE else "motor"
            label = f"{name}{joint + 1}"
            is_linear = bool(linear[joint])
            terms.append(term(label, shape, joint, *settings, side=side, linear=is_linear))
    return tuple(terms)


def without_effect(label: str) -> tuple[DriveTerm, ...]:
    """Return seven drive parameters of a fixed body, which affect no torque; the papers include them in their counts.

    Args:
        label: label of the body.
    """
    shapes = {"Ia": "acceleration"} | LINK_SIDE | MOTOR_SIDE
    terms = []
    for name, shape in shapes.items():
        settings = (V0,) if shape == "sign" else ()
        side = "link" if name in LINK_SIDE else "motor"
        terms.append(DriveTerm(name + label, shape, (), settings, side))
    return tuple(terms)


def coupled(
    first: int, second: int, v0: float = V0, label: str | None = None, weight: float = 1.0
) -> tuple[DriveTerm, ...]:
    """Return the terms Iam, Fvm, Fcm of two joints coupled by a gear: motor inertia, viscous and Coulomb friction.

    The motor turns with q_first + weight · q_second. For a weight of 1

        tau_first += Iam a_second + Fvm v_second + Fcm sign(v_first + v_second),

    and tau_second accordingly with both joints exchanged (Gautier & Janot's model of the TX40's wrist, joints 4 and 5
    counted from 0). The remaining inertia and friction are in each joint's Ia, Fv, Fc. For a weight of -1, sums become
    differences.

    Args:
        first, second: the coupled joints, from 0.
        v0: smoothing of the Coulomb sign [rad/s].
        label: suffix of the parameters' names; None: that of the second joint, counted from 1.
        weight: weight of the second joint.
    """
    if label is None:
        label = str(second + 1)
    crossed = ((first, ((second, weight),)), (second, ((first, weight),)))
    first_total = ((first, 1.0), (second, weight))
    second_total = ((first, weight), (second, 1.0))
    total = ((first, first_total), (second, second_total))
    return (
        DriveTerm(f"Iam{label}", "acceleration", crossed),
        DriveTerm(f"Fvm{label}", "velocity", crossed),
        DriveTerm(f"Fcm{label}", "sign", total, (v0,)),
    )


def fill(terms: Sequence[DriveTerm], out: np.ndarray, motions: Sequence[np.ndarray | None], states: np.ndarray) -> None:
    """Write the regressor columns of drive terms into `out`, which must be zero.

    Args:
        terms: k drive terms.
        out: (k, n, N) regressor columns.
        motions: q, v, a, load, (n, N) each; load is None if no term needs it.
        states: (s, N) states of friction with hysteresis, from `friction_states`.
    """
    first = 0
    for column, term in zip(out, terms, strict=True):
        count = len(term.acts) if term.form.remembers else 0
        for row, values in term.acting(motions, states[first : first + count]):
            column[row] += values
        first += count


def fill_energies(terms: Sequence[DriveTerm], out: np.ndarray, v: np.ndarray) -> None:
    """Write kinetic energies per unit of the parameters of acceleration terms into `out` (k, N), which must be zero.

    The energy of a term is ½ Σ weight · v_row · v_joint. Rows of other terms remain zero.

    Args:
        terms: k drive terms.
        out: (k, N) energies.
        v: (n, N) joint velocities [rad/s or m/s].
    """
    for column, term in zip(out, terms, strict=True):
        if term.shape != "acceleration":
            continue
        for row, motion in term.acts:
            for joint, weight in motion:
                column += 0.5 * weight * v[row] * v[joint]


def slopes(
    terms: Sequence[DriveTerm], motions: Sequence[np.ndarray], weights: np.ndarray, out: Sequence[np.ndarray]
) -> None:
    """Add the gradients of Σ weights · columns with respect to q, v and a to `out`.

    Args:
        terms: k drive terms.
        motions: q, v, a, (n, N) each.
        weights: (k, n, N) weight of each entry of the columns.
        out: three arrays (n, N), for q, v and a.

    Raises:
        CalibError: for a term that depends on past motion or on torques.
    """
    for term_weights, term in zip(weights, terms, strict=True):
        message = f"term '{term.name}' ({term.shape}) depends on past motion or torques: no derivatives"
        require(term.form.slopes, message)
        for row, motion in term.acts:
            derivatives = term.slopes(_join(term, motion, [*motions, None], None))
            for gradient, derivative in zip(out, derivatives):
                for joint, weight in motion:
                    gradient[joint] += weight * term_weights[row] * derivative


def friction_states(terms: Sequence[DriveTerm], q: np.ndarray) -> np.ndarray:
    """Return the states (s, N) of friction with hysteresis along an uninterrupted record q (n, N), starting at zero.

        z_k = clip(z_{k-1} + (x_k - x_{k-1}) / width, -1, 1)

    (stop operator). After a reversal the state changes in proportion to the displacement; beyond a travel of 2 · width
    it equals Coulomb's sign. Friction thus depends on past motion (Iwan 1966; several widths side by side are the
    Maxwell-slip model). There is one state for each torque row of each term with hysteresis.

    Args:
        terms: drive terms; s is 0 if none of them has hysteresis.
        q: (n, N) joint positions x [rad or m].
    """
    from calib.dynamics import kernels

    count = q.shape[1]
    states = []
    for term in terms:
        if not term.form.remembers:
            continue
        width = term.settings[0]
        for _, motion in term.acts:
            x = np.zeros(count)
            for joint, weight in motion:
                x = x + weight * q[joint]
            states.append(kernels.stop(x, width))
    return np.array(states).reshape(len(states), count)


def _join(
    term: DriveTerm, motion: Motion, motions: Sequence[np.ndarray | None], state: np.ndarray | None
) -> TermMotion:
    """Return the motion that a term depends on: weighted sums of the joints' q, v, a and load.

    Args:
        term: the drive term.
        motion: pairs (joint, weight) of the joints that the term depends on.
        motions: q, v, a, load, (n, N) each; load is None if no term needs it.
        state: (N,) state of the stop operator; None for a term without hysteresis.
    """
    if term.form.loaded and motions[3] is None:
        raise CalibError(f"term '{term.name}' needs the transmitted torque; give load (N, n), measured or predicted")
    q, v, a, load = motions
    assert q is not None and v is not None and a is not None
    return TermMotion(
        x=_weighted(motion, q),
        v=_weighted(motion, v),
        a=_weighted(motion, a),
        load=None if load is None else _weighted(motion, load),
        state=state,
    )


def _weighted(motion: Motion, series: np.ndarray) -> np.ndarray:
    """Return the weighted sum (N,) of the joints' time series (n, N).

    A single joint of weight 1 is returned without a copy.

    Args:
        motion: pairs (joint, weight).
        series: (n, N) position, velocity, acceleration or load of all joints.
    """
    if len(motion) == 1:
        joint, weight = motion[0]
        if weight == 1.0:
            return series[joint]
    total = np.zeros(series.shape[1])
    for joint, weight in motion:
        total = total + weight * series[joint]
    return total


def offered(step: str, joint: int, joint_range: RecordedRange, linear: bool = False) -> tuple[DriveTerm, ...]:
    """Return a joint's candidate terms in one step of the friction ladder (stepwise selection of friction terms).

    Args:
        step: a key of `STEPS`.
        joint: joint, from 0.
        joint_range: recorded ranges of the joint's motion, which scale the terms' settings.
        linear: whether the joint is prismatic.
    """
    numbered = []
    for offer in STEPS[step]:
        for number, (end, settings) in enumerate(offer.settings(joint_range).items()):
            name = f"{offer.label}{joint + 1}{end}"
            candidate = term(name, offer.shape, joint, *settings, side=offer.side, linear=linear)
            numbered.append((number, candidate))
    # The first terms of all offers, then their second ones.
    numbered.sort(key=lambda pair: pair[0])
    return tuple(candidate for _, candidate in numbered)
