"""Simulation of a robot with known parameters in closed loop: drives, friction, controller, encoders, noise.

    (M(q) + Ia) a + c(q, v) + g(q) + Fv v + Fc tanh(v / v0) + off = tau + push,    tau held for one control period,

integrated by the classical Runge-Kutta method at the controller's rate, with more steps where the smoothed sign of
Coulomb friction is stiff (`loop_kernels`). There is no chatter at rest, and the simulated model is the identified one.
At every recorded time the equation is satisfied to rounding by the true q, v, a and the torque.

`tracking_error` judges a model by a robot's deviation from its reference when the model's torques are fed forward. This
complements the computed-torque test, which by itself is "not a direct answer" about tracking (Kolyubin, Shiriaev &
Jubien 2019, section 7): a torque error that the feedback compensates has no effect here.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import solve_banded

from calib.dynamics.bodies import Bodies, upright_turn
from calib.dynamics.drives import DriveTerm
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.rigid_body import mass_matrix
from calib.errors import CalibError, CannotSimulate, Diverged, NotConverged, require
from calib.identification.closed_loop.controllers import Reference
from calib.identification.loop import LoopController
from calib.records import frozen, shaped

Packed = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
# shapes that the kernels hold as matrices; the others are acts
LINEAR = ("acceleration", "velocity", "one")
LOWER = "these gains cannot stabilise this robot at this rate; lower kp and kd (check their unit), or the delay"


def added_inertia(terms: Iterable[DriveTerm], values: np.ndarray, n: int) -> np.ndarray:
    """Return the constant inertia matrix (n, n) of the drives: motor inertias and their couplings between joints.

    Args:
        terms: drive terms.
        values: values of their parameters.
        n: number of joints.
    """
    result = np.zeros((n, n))
    for term, value in zip(terms, values, strict=True):
        if term.shape == "acceleration":
            for row, motion in term.acts:
                for joint, weight in motion:
                    result[row, joint] += weight * value
    return result


@dataclass(frozen=True, eq=False)
class Plant:
    """A robot model that can be simulated.

    Attributes:
        bodies: rigid bodies of the robot.
        terms: k drive terms of the robot; Coulomb signs must have a smoothing above zero.
        parameters: (10 B + k,) standard parameters of the bodies, then one value per term. All values that give a
            positive definite inertia matrix are valid, also base parameters with zeros for the regrouped ones.
    """

    bodies: Bodies
    terms: tuple[DriveTerm, ...]
    parameters: np.ndarray

    def __post_init__(self) -> None:
        size = self.inertial + len(self.terms)
        object.__setattr__(self, "parameters", frozen(shaped(self.parameters, (size,), "parameters of the plant")))
        for term in self.terms:
            if any(x <= 0.0 for name, x in zip(term.form.settings, term.settings) if name in ("v0", "rest")):
                raise CalibError(
                    f"term '{term.name}': sign(v) without smoothing cannot be simulated; give v0, about 0.01 rad/s"
                )

    @property
    def inertial(self) -> int:
        """Number of the bodies' parameters, which precede the drive parameters."""
        return 10 * self.bodies.count

    def with_parameters(self, parameters: np.ndarray) -> Plant:
        """Return the robot model with other parameters."""
        return replace(self, parameters=parameters)

    def carrying(self, carried: Collection[str]) -> Plant:
        """Return the robot with only the payloads of these labels; the parameters of other payloads become zero.

        Args:
            carried: labels of the payloads.
        """
        carried_columns = IdentificationModel(self.bodies).carried_columns(carried)
        factors = np.append(carried_columns, np.ones(len(self.terms)))
        return self.with_parameters(self.parameters * factors)

    def run(
        self,
        controller: LoopController,
        reference: Reference,
        sensing: Sensing | None = None,
        seed: int | np.random.Generator = 0,
    ) -> SimulatedRun:
        """Return the simulated motion of the robot that follows a reference, by `simulate`.

        Args:
            controller: the controller.
            reference: reference sampled at the controller's rate.
            sensing: noise, resolution and sampling; None: no noise, one sample per control period.
            seed: seed of all noise.
        """
        return simulate(self, controller, reference, sensing, seed)

    def feed_forward(self, reference: Reference) -> np.ndarray:
        """Return the torques (N, n) of this model along a reference, drives included [N m or N]."""
        return feed_forward(self, reference)

    def inertia(self, q: np.ndarray) -> np.ndarray:
        """Return the inertia matrices (N, n, n), motor inertia included, at joint positions q (N, n)."""
        rigid, drives = np.split(self.parameters, [self.inertial])
        matrices = mass_matrix(self.bodies, rigid, np.ascontiguousarray(q, dtype=float))
        return matrices + added_inertia(self.terms, drives, self.bodies.n)

    def inertia_diagonal(self, q: np.ndarray) -> np.ndarray:
        """Return the diagonal (n,) of the inertia matrix, motor inertia included, mean over joint positions (N, n).

        Args:
            q: (N, n) joint positions [rad or m].
        """
        return np.einsum("kii->i", self.inertia(q)) / len(q)


@dataclass(frozen=True, eq=False)
class Sensing:
    """Measurement noise, resolution and sampling of controller and log.

    Attributes:
        sigma_q: (n,) standard deviation of the noise of measured positions [rad or m]; the controller acts on it.
        q_band: cut-off of the first-order low-pass that colours the position noise at unchanged σ [Hz]; None: white.
        quantum: (n,) resolution of the encoders [rad or m]; 0 for none.
        sigma_tau: (n,) standard deviation of the white noise of recorded torques [N m or N]; it does not act on the
            joints.
        push: (n,) standard deviation of a torque that acts but is not recorded: ripple, cables, other effects [N m or
            N].
        push_band: cut-off of the first-order low-pass that colours `push` at unchanged σ [Hz]; None: white.
        every: control periods per recorded sample, not necessarily an integer (5 kHz and 140 Hz: 35.7).
    """

    sigma_q: np.ndarray | float = 0.0
    quantum: np.ndarray | float = 0.0
    sigma_tau: np.ndarray | float = 0.0
    push: np.ndarray | float = 0.0
    push_band: float | None = None
    every: float = 1
    q_band: float | None = None


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """Result of a simulation at M samples.

    Attributes:
        t: (M,) sample times [s].
        q, v, a: (M, n) true motion [rad or m, and per s, per s²].
        measured: (M, n) positions measured by the encoders [rad or m].
        tau: (M, n) torques as recorded, with noise of `Sensing.sigma_tau` [N m or N].
        torque: (M, n) torques that acted on the joints [N m or N].
    """

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    measured: np.ndarray
    tau: np.ndarray
    torque: np.ndarray


def simulate(
    plant: Plant,
    controller: LoopController,
    reference: Reference,
    sensing: Sensing | None = None,
    seed: int | np.random.Generator = 0,
    start: tuple[np.ndarray, np.ndarray] | None = None,
    push: np.ndarray | None = None,
) -> SimulatedRun:
    """Return the simulated motion of a robot that follows a reference.

    Args:
        plant: the robot.
        controller: its controller.
        reference: reference sampled at the controller's rate, which it thereby defines.
        sensing: noise, resolution and sampling; None: no noise, one sample per control period.
        seed: seed of all noise; equal seeds give exactly equal results.
        start: q, v (n,) at the first instant; None: on the reference.
        push: (N, n) additional torque at the reference's instants [N m or N]; None: no additional torque.

    Raises:
        CannotSimulate: if the inertia matrix is not positive definite, or friction too stiff for the rate.
        Diverged: if the loop is unstable.
    """
    from calib.identification.closed_loop import loop_kernels

    sensing = Sensing() if sensing is None else sensing
    n = plant.bodies.n
    count = len(reference.t)
    rng = np.random.default_rng(seed)
    # Drawn in this order, whatever of it is zero.
    drawn = {}
    for name in ("sigma_q", "push", "sigma_tau"):
        sigma = np.broadcast_to(getattr(sensing, name), (n,))
        drawn[name] = _draw(rng, sigma, count)
    if sensing.q_band is not None:
        step = 2.0 * np.pi * sensing.q_band * reference.period
        drawn["sigma_q"] = _coloured(drawn["sigma_q"], step)
    if sensing.push_band is not None:
        drawn["push"] = _coloured(drawn["push"], 2.0 * np.pi * sensing.push_band * reference.period)
    if push is not None:
        total_push = shaped(push, reference.q.shape, "push")
        if len(drawn["push"]):
            total_push = total_push + drawn["push"]
        drawn["push"] = np.ascontiguousarray(total_push)
    if start is None:
        start = reference.q[0], reference.v[0]
    q = np.array(start[0], dtype=float)
    v = np.array(start[1], dtype=float)
    tick = sample_ticks(count, sensing.every)
    out = np.empty((5, len(tick), n))
    if controller.model is None:
        model = np.empty((0, 0))
    else:
        model = body_rows(plant.bodies, controller.model)
    quantum = np.ascontiguousarray(np.broadcast_to(sensing.quantum, (n,)), dtype=float)
    status, reached = loop_kernels.closed_loop(
        *packed(plant),
        model,
        controller.rows,
        reference.sampled(controller.ahead),
        drawn["sigma_q"],
        quantum,
        drawn["push"],
        reference.period,
        controller.smoothing(reference.period),
        controller.delay,
        float(sensing.every),
        q,
        v,
        out,
    )
    if status != loop_kernels.FINE:
        raise failure(status, reached * reference.period)
    heard = 0.0
    if len(drawn["sigma_tau"]):
        heard = drawn["sigma_tau"][tick.astype(int)]
    on_ticks = np.all(tick == tick.astype(int))
    if on_ticks:
        t = reference.t[tick.astype(int)]
    else:
        t = reference.t[0] + tick * reference.period
    q, v, a, measured, torque = [frozen(series) for series in out]
    tau = frozen(out[4] + heard)
    return SimulatedRun(t, q, v, a, measured, tau, torque)


def sample_ticks(count: int, every: float) -> np.ndarray:
    """Return the times of the samples that are recorded during `count` control periods, in periods.

    `every` is the number of periods per sample, not necessarily an integer.
    """
    return np.arange(int((count - 1) / every + 1e-9) + 1) * every


def forward_dynamics(
    plant: Plant, q: np.ndarray, v: np.ndarray, tau: np.ndarray, parameters: np.ndarray | None = None
) -> np.ndarray:
    """Return the joint accelerations (N, n) under drive torques, with friction and motor inertia.

    The states of friction with hysteresis are taken as zero.

    Args:
        plant: the robot.
        q, v: (N, n) joint positions and velocities [rad or m, and per s].
        tau: (N, n) drive torques [N m or N].
        parameters: (N, p) parameters of each sample; None: the plant's.

    Raises:
        CannotSimulate: if the inertia matrix is not positive definite.
    """
    from calib.identification.closed_loop import loop_kernels

    shape = (len(q), plant.bodies.n)
    q = np.ascontiguousarray(shaped(q, shape, "states"))
    v = np.ascontiguousarray(shaped(v, shape, "states"))
    tau = np.ascontiguousarray(shaped(tau, shape, "states"))
    out = np.empty_like(q)
    count = len(plant.parameters)
    if parameters is None:
        values = np.empty((0, count))
    else:
        values = shaped(parameters, (len(q), count), "parameters")
    layout = layout_of(plant)
    contiguous = np.ascontiguousarray(values)
    failed = loop_kernels.forward_dynamics(*packed(plant), *layout, contiguous, q, v, tau, out)
    require(failed < 0, f"sample {failed}: the inertia matrix is not positive definite", CannotSimulate)
    return out


def _draw(rng: np.random.Generator, sigma: np.ndarray, count: int) -> np.ndarray:
    """Return white noise (count, n) with standard deviations sigma (n,), or an empty array if all are zero.

    Args:
        rng: generator of random numbers.
        sigma: (n,) standard deviations.
        count: number of samples.
    """
    if not np.any(sigma):
        return np.empty((0, len(sigma)))
    return rng.standard_normal((count, len(sigma))) * sigma


def _coloured(white: np.ndarray, step: float) -> np.ndarray:
    """Return low-passed noise x_k = p x_{k-1} + √(1 - p²) w_k with p = exp(-step), for white noise w (N, n).

    Its variance equals the variance of w.

    Args:
        white: (N, n) white noise w.
        step: time step over the time constant of the low-pass.
    """
    if not len(white):
        return white
    pole = float(np.exp(-step))
    filter_bands = np.array([[1.0], [-pole]])
    bands = filter_bands * np.ones(len(white))
    scaled_noise = np.sqrt(1.0 - pole**2) * white
    return np.ascontiguousarray(solve_banded((1, 0), bands, scaled_noise))


def layout_of(plant: Plant) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the index arrays by which `loop_kernels.set_parameters` writes into the arrays of `packed(plant)`."""
    n = plant.bodies.n
    first = plant.inertial
    orders = np.broadcast_to(plant.bodies.order, (plant.bodies.count, 10))
    order = np.ascontiguousarray(orders, dtype=np.int64)
    entries: list[tuple[int, int, int]] = []
    shares: list[float] = []
    owners: list[int] = []
    for k, term in enumerate(plant.terms):
        for row, motion in term.acts:
            if term.shape not in LINEAR:
                owners.append(first + k)
                continue
            motion_entries = motion
            if term.shape == "one":
                motion_entries = ((2 * n, 1.0),)
            start = n if term.shape == "velocity" else 0
            entries += [(row, start + offset, first + k) for offset, _ in motion_entries]
            shares += [weight for _, weight in motion_entries]
    entry_rows = np.array(entries, dtype=np.int64).reshape(-1, 3)
    return order, entry_rows, np.array(shares), np.array(owners, dtype=np.int64)


def packed(plant: Plant) -> Packed:
    """Return the robot model `plant` as the arrays tree, body, linear, kinds and acts of `loop_kernels`."""
    bodies = plant.bodies.count
    n = plant.bodies.n
    parents = np.where(plant.bodies.parents < 0, bodies, plant.bodies.parents)
    links = np.column_stack([parents, plant.bodies.kinds, plant.bodies.coordinates]).astype(np.int64)
    linear, acts = _drives(plant.terms, plant.parameters[10 * bodies :], n)
    kinds = []
    values = []
    longest = max((len(table) for *_, table in acts), default=0)
    for row, code, amount, settings, weights, table in acts:
        kinds.append([row, code])
        padding = [0.0] * (longest - len(table))
        values.append([amount, *settings, *weights, *table, *padding])
    parameters = plant.parameters[: 10 * bodies]
    body = body_rows(plant.bodies, parameters)
    kind_rows = np.array(kinds, dtype=np.int64).reshape(-1, 2)
    value_rows = np.array(values).reshape(-1, 8 + n + longest)
    return np.ascontiguousarray(links), body, linear, kind_rows, value_rows


def body_rows(bodies: Bodies, parameters: np.ndarray) -> np.ndarray:
    """Return placements and parameters of the bodies as the array `body` (B + 1, 23) of `loop_kernels`.

    Frames are rotated so that each joint moves about or along z.

    Args:
        bodies: the B bodies.
        parameters: (10 B,) their standard parameters.
    """
    result = np.zeros((bodies.count + 1, 23))
    result[-1, :3] = -bodies.gravity
    turns = [upright_turn(axis)[:3, :3] for axis in bodies.axes]
    for i, parent in enumerate(bodies.parents):
        if parent < 0:
            before = np.eye(3)
        else:
            before = turns[parent].T
        rotation = before @ bodies.placements[i, :3, :3] @ turns[i]
        result[i, :9] = rotation.ravel()
        result[i, 9:12] = before @ bodies.placements[i, :3, 3]
        standard = parameters[10 * i : 10 * i + 10]
        result[i, 12:22] = standard[bodies.order[i]]
    result[:-1, 22] = bodies.scales
    return result


def _drives(terms: Sequence[DriveTerm], values: np.ndarray, n: int, ramp: float = 0.1) -> tuple[np.ndarray, list]:
    """Return the linear drive terms (n, 2 n + 1), and a list of the other friction terms.

    An entry of the list is a tuple of torque row, shape code, parameter value, seven settings, joint weights (n,), and
    the knots of a table.

    `ramp`: width over which the sign with a dead zone is smoothed, relative to its dead zone (a jump cannot be
    integrated).

    Args:
        terms: drive terms.
        values: values of their parameters.
        n: number of joints.
    """
    from calib.dynamics import shape_kernels

    linear = np.zeros((n, 2 * n + 1))
    acts = []
    for term, value in zip(terms, values, strict=True):
        for row, motion in term.acts:
            if term.shape == "one":
                linear[row, 2 * n] += value
                continue
            weights = np.zeros(n)
            for joint, weight in motion:
                weights[joint] += weight
            if term.shape not in LINEAR:
                settings, table = term.packed(8 + n)
                if term.shape == "dead":
                    settings[1] = ramp * term.settings[0]
                code = getattr(shape_kernels, term.shape.upper())
                acts.append((row, code, value, settings, weights, table))
            else:
                first = 0 if term.shape == "acceleration" else n
                linear[row, first : first + n] += value * weights
    return linear, acts


def failure(status: int, time: float, where: str | None = None) -> NotConverged:
    """Return the error for a failure status of the kernels.

    Args:
        status: status returned by a kernel.
        time: time of the failure [s].
        where: text that replaces the time in the message; None: the time.
    """
    from calib.identification.closed_loop import loop_kernels

    location = f"at {time:.4g} s " if where is None else where
    if status == loop_kernels.SINGULAR:
        return CannotSimulate(
            f"{location}the inertia matrix is not positive definite: these parameters are not physically "
            "consistent; use a physically consistent estimate, or start from regular inertia"
        )
    if status == loop_kernels.STIFF:
        return CannotSimulate(
            f"{location}friction at rest is too stiff: integrating a control period takes more than "
            f"{loop_kernels.MAX_STEPS} steps; "
            "smooth the sign over a larger velocity, or give the joint its motor inertia"
        )
    return Diverged(f"the loop diverged at {time:.4g} s: {LOWER}", None)


def feed_forward(believed: Plant, reference: Reference) -> np.ndarray:
    """Return the torques (N, n) of the controller's robot model along a reference, drives included [N m or N].

    Args:
        believed: the controller's model.
        reference: reference sampled at the controller's rate.
    """
    model = IdentificationModel(believed.bodies, believed.terms)
    # instants at a time
    block = 4096
    parts = [slice(k, k + block) for k in range(0, len(reference.t), block)]
    states = ((reference.q[part], reference.v[part], reference.a[part]) for part in parts)
    return np.concatenate([model.torque(believed.parameters, *state) for state in states])


def tracking_error(
    robot: Plant,
    controller: LoopController,
    reference: Reference,
    ahead: np.ndarray | None = None,
    push: np.ndarray | None = None,
) -> np.ndarray:
    """Return the rms tracking error q - q_r (n,) [rad or m] of a robot without noise, at the controller's instants.

    Args:
        robot: the robot that moves; for a real arm, its best available model.
        controller: its controller.
        reference: reference sampled at the controller's rate.
        ahead: (N, n) feedforward torques [N m or N], e.g. from `feed_forward`; None: those of the controller.
        push: (N, n) additional torques [N m or N]; None: no additional torque.
    """
    run = simulate(robot, controller if ahead is None else controller.with_feedforward(ahead), reference, push=push)
    return np.sqrt(np.mean((run.q - reference.q) ** 2, axis=0))


def plant_of(model: Any, values: np.ndarray, terms: Sequence[DriveTerm] = ()) -> Any:
    """Return a robot that can be simulated from a model with parameter values.

    Args:
        model: an identification model, or a model with a method `plant`.
        values: parameters of the model and of the further terms.
        terms: further drive terms.
    """
    if isinstance(model, IdentificationModel):
        return Plant(model.bodies, (*model.columns, *terms), values)
    return model.plant(values, terms)


def simulable(model: object) -> bool:
    """Return whether a model's motion can be simulated."""
    return isinstance(model, IdentificationModel) or hasattr(model, "plant")
