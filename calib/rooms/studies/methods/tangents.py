"""Closed loops with their slopes by parameters: a whole run at once, or states advanced one at a time."""

from dataclasses import dataclass

import numpy as np

from calib.arrays import frozen, shaped
from calib.errors import Diverged, require
from calib.simulation.loop.closed_loop import LOWER, Packed, Plant, body_rows, failure, layout_of, packed, sample_ticks
from calib.simulation.loop.controllers import Controller
from calib.simulation.loop.references import Reference


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """A simulated motion without noise, and its slopes by parameters; M samples, c parameters.

    Attributes:
        t: (M,) [s].
        q, v, torque: (M, n) [rad or m, per s, N m or N].
        by_q, by_v, by_torque: (M, n, c) their slopes, per unit of each parameter.
    """

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    torque: np.ndarray
    by_q: np.ndarray
    by_v: np.ndarray
    by_torque: np.ndarray


def simulate_tangents(
    plant: Plant, controller: Controller, reference: Reference, columns: np.ndarray, every: float = 1,
    relative: np.ndarray | None = None,
) -> Sensitivities:  # fmt: skip
    """Let the robot follow a reference without noise, and say what each parameter changes: exactly, in one pass.

    Args:
        plant: whose friction hangs on position and velocity alone.
        columns: (c,) indices of the parameters.
        every: control periods per sample.
        relative: (n, c) slopes of the logarithm of all gains of a joint by the parameters, where the gains follow them
            (`calib.identification.loop.loop_recordings.Loop.design`); None: they stay.

    Raises:
        CalibError: where the inertia is not positive definite, friction too stiff, or of a kind without slopes.
        NotConverged: where the loop is unstable.
    """
    from calib.rooms.studies.methods import tangent_kernels
    from calib.simulation.loop import loop_kernels

    for one in plant.terms:
        words = f"term '{one.name}' ({one.shape}): no tangents of friction that hangs on loads or the past"
        require(one.form.slopes, words)
    n, count, c = plant.bodies.n, len(reference.t), len(columns)
    find = np.full(len(plant.parameters), -1)
    find[np.asarray(columns, dtype=int)] = np.arange(c)
    tick = sample_ticks(count, every)
    out, slopes = np.empty((3, len(tick), n)), np.empty((3, len(tick), n, c))
    model = np.empty((0, 0)) if controller.model is None else body_rows(plant.bodies, controller.model)
    scale = np.zeros((n, c)) if relative is None else np.ascontiguousarray(shaped(relative, (n, c), "relative"))
    status, reached = tangent_kernels.closed_loop_tangent(
        packed(plant), (*layout_of(plant), find), model, controller.rows, scale, controller.sampled(reference),
        np.empty((0, n)), reference.period, controller.smoothing(reference.period), controller.delay, float(every),
        np.array(reference.q[0]), np.array(reference.v[0]), count, out, slopes,
    )  # fmt: skip
    if status != loop_kernels.FINE:
        raise failure(status, reached * reference.period)
    # slope of the last sample by a parameter, in SI units, from which on the loop is unstable (our choice)
    max_slope = 1e20
    if (
        not np.abs(slopes[:, -1]).max(initial=0.0) < max_slope
    ):  # saturated torques keep the motion finite, not its slopes
        raise Diverged(f"the loop is unstable, its slopes grow without bounds: {LOWER}", None)
    t = reference.t[0] + tick * reference.period
    return Sensitivities(t, *(frozen(x) for x in out), *(frozen(x) for x in slopes))


@dataclass(frozen=True, eq=False)
class Stepper:
    """A plant made ready to be advanced many times with other parameters and states, one at a time."""

    parts: Packed
    layout: Packed

    def points(
        self, parameters: np.ndarray, q: np.ndarray, v: np.ndarray, tau: np.ndarray, period: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return states (K, n) a period later under one torque (n,), and M⁻¹ (n, n) of the first.

        Args:
            parameters: (K, p) of each state's robot.

        Raises:
            CannotSimulate, Diverged: naming the first point that cannot be followed.
        """
        from calib.simulation.loop import loop_kernels

        q, v, gain = np.array(q), np.array(v), np.empty((q.shape[1], q.shape[1]))
        order, entries, shares, owners, _ = self.layout
        where = (order, entries, shares, owners, np.ascontiguousarray(parameters), q, v, tau, period, gain)
        status, reached = loop_kernels.advance_points(*self.parts, *where)
        if status != loop_kernels.FINE:
            raise failure(status, 0.0, f"point {reached}: ")
        return q, v, gain

    def linearised(
        self, parameters: np.ndarray, q: np.ndarray, v: np.ndarray, tau: np.ndarray, period: float, columns: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return q, v (n,) a period later, M⁻¹ (n, n), and slopes (2 n, 2 n + columns) by q, v and parameters."""
        from calib.rooms.studies.methods import tangent_kernels
        from calib.simulation.loop import loop_kernels

        n = len(q)
        q, v, gain = np.array(q), np.array(v), np.empty((n, n))
        slopes = np.empty((2, n, 2 * n + columns))
        args = (self.parts, self.layout, np.ascontiguousarray(parameters), q, v, tau, period, gain)
        status = tangent_kernels.advance_linearised(*args, slopes[0], slopes[1])
        if status != loop_kernels.FINE:
            raise failure(status, 0.0, "")
        return q, v, gain, slopes.reshape(2 * n, -1)


def stepper(plant: Plant, columns: np.ndarray) -> Stepper:
    """Return a plant made ready to be advanced, with slopes by the parameters `columns` (c,)."""
    find = np.full(len(plant.parameters), -1)
    find[np.asarray(columns, dtype=int)] = 2 * plant.bodies.n + np.arange(len(columns))
    return Stepper(packed(plant), (*layout_of(plant), find))
