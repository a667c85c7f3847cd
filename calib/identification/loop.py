"""Settings of the closed loop in which recordings were made: table [loop] of the options file.

Instrumental variables (method iv) simulate that loop; with another method and a [loop], the same simulation tests
whether least squares is biased. iv, didim and cloe take joint torque sensors (rows link, both), clie rows both.
friction = "auto": iv and didim simulate the steps chosen by least squares, cloe and clie standard friction; all take
stated steps, cloe and clie those with derivatives (not load, presliding). Recordings may carry different payloads.
Parallel robots take iv, didim, pc-iv and pc-didim with rows motor or platform: a controller per actuator, no `design`.
Gains are what the joints feel, torque per position error on the joint side::

    [loop]
    controller = "pd"                # pd, cascade, or identify: gains read from the logs (ARX, see below)
    kp = [12000.0, 4500.0]           # pd: [N m/rad], one per joint or one for all
    kd = [90.0, 28.0]                # pd: [N m s/rad]
    ki = 0.0                         # pd: [N m/(rad s)]
    position = [40.0, 40.0]          # cascade P-PI: gain P of the position loop [1/s]
    velocity = [90.0, 28.0]          # cascade: gain K of the velocity loop [N m s/rad]
    reset = 0.05                     # cascade: reset time Ti of the velocity loop [s]; none: P-P
    share = 1.0                      # of the reference's velocity that the velocity loop sees
    rate = 5000.0                    # of the controller [Hz], whole multiple of the log's or not; default: the log's,
                                     # or the least multiple of it that is 1 kHz or more
    delay = 1                        # control periods from measurement to torque
    limit = [130.0, 60.0]            # saturation [N m]
    windup = 0.1                     # largest integral of the error [rad s]
    velocity_cutoff = 200.0          # low-pass of the measured velocity [Hz]
    reference_velocity = "derivative"  # of q_ref at the instant; or "difference": over the period before it
    feedforward = "none"             # none; cad: the robot's own inertias; recording: column tau_ff
    reference = "recording"          # the column q_ref (q_des, q_cmd, …), or the session's designed motion (of the
                                     # command: --excitation FOLDER); or a file, see below
    timing = "checked"               # of the reference, by the motors' torques: checked: refused where it is late or
                                     # early; estimated: moved; stated: as it is. A designed motion is moved, too, or
                                     # where stated left at the measured positions: late by the lag, which iv bears
    design = [1.2, 1.5]              # inertias for which the gains are stated [kg m²], if they follow the estimate
    inertia = [0.4, 0.5]             # of the robot the simulation starts from [kg m²]; default kd² / (2 kp)
    instruments = "iv"               # iv, or didim: the simulated motion alone
    positive = ["Ia1", "Fv1"]        # base parameters that must not be negative
    band = 20.0                      # identify: up to which frequency [Hz] the gains are read
    integral = false                 # identify: look for ki too

In the simulated controller the measured velocity is a backward difference, (q_k - q_k-1) · rate, and so half a period
late, then low-passed at velocity_cutoff; the reference's is q_ref's derivative at instant k (of a cubic spline through
the logged samples), on time. A controller that takes the backward difference of q_ref as well needs
``reference_velocity = "difference"``: else methods that rest on the loop (cloe, clie) find kd / (2 rate) too much
inertia. The position error is q_ref,k - q_k, the torque is held over the period after `delay` more of them.

A reference of its own is a table (CSV) or an archive (npz) with stamps and q_ref or q, no torques; its clock is the
recording's: both count from their first sample. ``[files."run.csv"] reference = "run_ref.csv"`` states one per
recording, relative to the options file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, TypeVar

import numpy as np

from calib.config import strict
from calib.config_types import Flag, Name, Names, OneOf, Positive, Real, Spread, Whole
from calib.errors import Finding, refuse_option, require
from calib.records import Array, Number, Unbounded, frozen, stored

T = TypeVar("T")
MAX_SHIFT_SIGMAS = 3.0
"""Standard deviations of a shift that does not matter, however surely it is there (our choice)."""
FREQUENCY, DAMPING = 5.0, 0.7
"""Natural frequency [Hz] and damping of a controller that is not stated."""
FEEDBACK, CAD, IDENTIFIED, FLOOR = "feedback", "cad", "model", "floor"  # what is fed forward; the floor: measured

CONTROLLERS = ("pd", "cascade", "identify")
SPEEDS = ("derivative", "difference")
TIMINGS = ("checked", "estimated", "stated")
AHEAD = ("none", "cad", "recording")
INSTRUMENTS = ("iv", "didim")
NEEDED = {"pd": ("kp", "kd"), "cascade": ("position", "velocity"), "identify": ()}
OWNED = {"pd": ("kp", "kd", "ki"), "cascade": ("position", "velocity", "reset"), "identify": ("band", "integral")}


GAIN = "a number above 0, or a list with one per joint"
OTHER = "a number not below 0, or a list with one per joint"
Gains = Annotated[tuple[Annotated[float, Real(above=0, words=GAIN)], ...], Spread(words=GAIN)]
Gains0 = Annotated[tuple[Annotated[float, Real(least=0, words=OTHER)], ...], Spread(words=OTHER)]
Bounds = Annotated[tuple[Annotated[float, Real(above=0, infinite=True, words=GAIN)], ...], Spread(words=GAIN)]


@strict
@dataclass(frozen=True)
class LoopSettings:
    """Settings of the loop; the module documents each key. Tuples contain one value, or one per joint."""

    controller: Annotated[str, OneOf(CONTROLLERS)]
    kp: Gains = ()
    kd: Gains0 = ()
    ki: Gains0 = (0.0,)
    position: Gains = ()
    velocity: Gains = ()
    reset: Bounds = (np.inf,)
    share: Annotated[float, Real(above=0, most=1.0)] = 1.0
    rate: Annotated[float, Real(above=0, most=1e5, unit="Hz")] | None = None
    delay: Annotated[int, Whole(0, 100, " of control periods,")] = 0
    limit: Bounds = (np.inf,)
    windup: Bounds = (np.inf,)
    velocity_cutoff: Positive | None = None
    reference_velocity: Annotated[str, OneOf(SPEEDS)] = "derivative"
    feedforward: Annotated[str, OneOf(AHEAD)] = "none"
    reference: Name = "recording"
    timing: Annotated[str, OneOf(TIMINGS)] = "checked"
    design: Gains = ()
    inertia: Gains = ()
    instruments: Annotated[str, OneOf(INSTRUMENTS)] = "iv"
    positive: Names = ()
    band: Positive = 20.0
    integral: Flag = False

    def check_lengths(self, n: int) -> None:
        """Check that every list has one value or n values.

        Raises:
            UsageError: for another length; the message names the key.
        """
        for field in fields(self):
            values = getattr(self, field.name)
            if isinstance(values, tuple) and values and field.name != "positive":
                self.per_joint(field.name, n)

    def per_joint(self, key: str, n: int) -> np.ndarray:
        """Return the n values of a key, which has one value for all joints or one per joint.

        Args:
            key: name of the setting.
            n: number of joints.

        Raises:
            UsageError: for another number of values.
        """
        return np.array(per_joint(getattr(self, key), n, f"[loop] {key}"), dtype=float)


def per_joint(values: Sequence[T], n: int, name: str) -> tuple[T, ...]:
    """Return n values from a sequence of one value (repeated) or n values; `name` is the option in the error message.

    Raises:
        UsageError: for another number of values.
    """
    if len(values) not in (1, n):
        refuse_option(name, f"{len(values)} values for {n} joints; give one, or one per joint")
    if len(values) == 1:
        return tuple(values) * n
    return tuple(values)


def check_loop(table: object) -> object:
    """Return the parsed table [loop] unchanged, if it has a controller and the gains of this controller.

    Raises:
        ValueError: for a missing controller, gains of another controller, or missing gains.
    """
    if not isinstance(table, Mapping):
        return table
    kind = table.get("controller")
    if kind is None:
        raise ValueError(f"'controller' is missing; expected one of {', '.join(CONTROLLERS)}")
    if not isinstance(kind, str) or kind not in OWNED:
        return table
    for other, keys in OWNED.items():
        wrong = [key for key in keys if key in table and key not in OWNED[kind]]
        if wrong:
            raise ValueError(f"'{wrong[0]}' is a key of controller '{other}', but controller = '{kind}' is stated")
    for key in NEEDED[kind]:
        if key not in table:
            raise ValueError(f"controller '{kind}' needs {' and '.join(NEEDED[kind])}; '{key}' is missing")
    if kind == "identify" and table.get("share", 1.0) != 1.0:
        raise ValueError("share: not supported with controller = 'identify', which assumes share = 1: remove the key")
    return table


@dataclass(frozen=True, eq=False)
class LoopController:
    """A sampled controller for n joints.

    Attributes:
        kp, kd, ki: (n,) gains [N m/rad, N m s/rad, N m/(rad s)], with N and m for a prismatic joint; for computed
            torque [1/s², 1/s, 1/s³].
        share: (n,) share of the reference velocity in the velocity loop: 1 in a PD, less in some cascades.
        limit: (n,) torque limit [N m or N].
        windup: (n,) limit of the error's integral [rad s].
        ahead: (N, n) feedforward torque at the reference's instants [N m or N]; None: no feedforward.
        model: (10 B,) standard parameters of the controller's model (computed torque); None: no model.
        delay: control periods from measurement to torque.
        cutoff: cut-off of the low-pass on the measured velocity [Hz]; None: no low-pass.
    """

    kp: Array
    kd: Array
    ki: Array
    share: Array
    limit: Unbounded
    windup: Unbounded
    ahead: Array | None = None
    model: Array | None = None
    delay: int = 0
    cutoff: float | None = None

    def __post_init__(self) -> None:
        n = len(np.atleast_1d(self.kp))
        for name in ("kp", "kd", "ki", "share", "limit", "windup"):
            stated = np.asarray(getattr(self, name), dtype=float)
            value = np.broadcast_to(stated, (n,))
            object.__setattr__(self, name, frozen(np.array(value)))
        require(self.delay >= 0, f"a delay of {self.delay} control periods is invalid: state 0 or more")

    @property
    def rows(self) -> np.ndarray:
        """Controller values (6, n) in the order of the kernel `closed_loop`."""
        return np.array([self.kp, self.kd, self.ki, self.share, self.limit, self.windup])

    def smoothing(self, period: float) -> float:
        """Return the weight of a new velocity sample in the low-pass at a control period [s]; 1 without a low-pass."""
        if self.cutoff is None:
            return 1.0
        decay = np.exp(-2.0 * np.pi * self.cutoff * period)
        return float(1.0 - decay)

    def scaled(self, factor: np.ndarray | float) -> LoopController:
        """Return the controller with all gains multiplied by `factor`, one number or (n,).

        With the ratio of two inertias as factor, the bandwidth is the same at the other inertia.
        """
        kp = self.kp * factor
        kd = self.kd * factor
        ki = self.ki * factor
        return replace(self, kp=kp, kd=kd, ki=ki)

    def slower(self, factor: float) -> LoopController:
        """Return the controller with its bandwidth divided by `factor`: kp by factor², kd by factor, ki by factor³."""
        kp = self.kp / factor**2
        kd = self.kd / factor
        ki = self.ki / factor**3
        return replace(self, kp=kp, kd=kd, ki=ki)

    def with_feedforward(self, ahead: np.ndarray) -> LoopController:
        """Return the controller with the feedforward torques `ahead` (N, n) [N m or N], which replace earlier ones."""
        return replace(self, ahead=frozen(ahead))


@dataclass(frozen=True)
class ExogeneityTest:
    """Test of the hypothesis that W is uncorrelated with the noise, so that least squares is unbiased.

    Attributes:
        statistic: F statistic of the augmented regression.
        degrees: degrees of freedom of numerator and denominator.
        p: probability of a larger statistic if the hypothesis is true.
    """

    statistic: Number
    degrees: tuple[float, float]
    p: float

    @stored
    def least_squares_biased(self) -> bool:
        """Whether the test shows that least squares is biased, at the default level of `biased`."""
        return self.biased()

    def biased(self, level: float = 0.01) -> bool:
        """Return whether the test shows, at this significance level, that least squares is biased; use IV then.

        Args:
            level: probability of this result if least squares is unbiased.
        """
        return self.p < level


@dataclass(frozen=True, eq=False)
class LoopMetrics:
    """Results of testing an estimate with instrumental variables from a simulated control loop.

    Attributes:
        failure: reason why there are no instruments; empty otherwise.
        notes: remarks on the simulated loops.
        instruments: the method that simulates.
        beside: whether the user's estimate was made by another method.
        rounds: number of iterations until convergence.
        durbin_wu_hausman: test whether least squares is biased.
        largest_shift_sigma: largest difference of a parameter from least squares, in standard deviations.
        cragg_donald, instruments_weak, least_partial_r2: strength of the instruments, as in `InstrumentStrength`.
        distance_percent, simulated_torque_error_percent, strays_times: (n,) `distance`, `direct` and `stray` of
            `Instrumental`.
        valid, explains: whether the instruments are valid, and whether the simulation explains the recording, as in
            `Instrumental`.
        controller: the simulated controller.
        controller_explains_percent: (n,) share of the torque that an identified controller explains [%]; None if it was
            stated.
    """

    failure: str = ""
    notes: tuple[str, ...] = ()
    instruments: str = ""
    beside: bool = False
    rounds: int = 0
    durbin_wu_hausman: ExogeneityTest | None = None
    largest_shift_sigma: float = 0.0
    cragg_donald: Number = 0.0
    instruments_weak: bool = False
    least_partial_r2: float = 0.0
    distance_percent: Array = ()  # ty: ignore[invalid-assignment]
    simulated_torque_error_percent: Array = ()  # ty: ignore[invalid-assignment]
    strays_times: Array = ()  # ty: ignore[invalid-assignment]
    valid: bool = True
    explains: bool = True
    controller: LoopController | None = None
    controller_explains_percent: Array | None = None


@dataclass(frozen=True)
class LoopDisagreement:
    """Differences between an estimate that simulates the stated control loop and an estimate that does not.

    Attributes:
        method, beside: methods of the two estimates.
        parameter, sigmas: the parameter with the largest difference, and this difference in combined standard
            deviations.
        left, beside_left: unexplained share of each row's torque in the identification band, for the two estimates [%].
        factor: for each torque row, torque of the first estimate over that of the second.
    """

    method: str
    beside: str
    parameter: str
    sigmas: float
    left: tuple[float, ...]
    beside_left: tuple[float, ...]
    factor: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class LoopResults:
    """Results of simulating the closed loop of the recordings; empty if the options describe no loop.

    Attributes:
        metrics: results as stored in ``metrics.json``; None without a loop.
        findings: findings on the loop, the instruments, and the bias of least squares.
        table: rows of ``instrumental.csv``.
        controller: the simulated controller.
        disagreement: contradiction of recorded torques to an estimate that relies on the stated loop; None without one.
    """

    metrics: LoopMetrics | None = None
    findings: tuple[Finding, ...] = ()
    table: tuple[tuple[object, ...], ...] = ()
    controller: LoopController | None = None
    disagreement: LoopDisagreement | None = None


@dataclass(frozen=True, eq=False)
class Replay:
    """Record of the tracking errors of the simulated robot on a recorded motion.

    Attributes:
        name: name of the recording.
        seconds: duration of the replayed part.
        controller: the feedback controller.
        stated: whether the user stated this controller.
        terms_left_out: terms of the model that cannot be simulated; their torque is part of the disturbance.
        inertia_added: (n,) inertia added to make the simulated robot physically consistent [kg m² or kg].
        rms: (n,) rms of q - q_r [rad or m] for each kind of feedforward.
        unseen: whether this motion was not used in the fit.
    """

    name: str
    seconds: float
    controller: LoopController | None
    stated: bool
    terms_left_out: tuple[str, ...]
    inertia_added: Array
    rms: Mapping[str, Array]
    unseen: bool = False

    @stored
    def feedback_over_model(self) -> float:
        """Ratio of tracking errors without and with the model as feedforward, geometric mean over the joints."""
        ratio = self.rms[FEEDBACK] / np.maximum(self.rms[IDENTIFIED], 1e-12)
        return float(np.exp(np.mean(np.log(ratio))))
