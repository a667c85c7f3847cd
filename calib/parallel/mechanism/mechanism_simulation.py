"""Simulation of a parallel robot with known parameters in closed loop, for methods that simulate recordings' loops.

    M(x) v̇ + h(x, v) = J_p^invᵀ tau,    v̇ of the platform's coordinates, tau held for one control period,

where M and h contain all legs, drives and payloads of the `ParallelModel` (`simulation_kernels`). Each actuator has a
separate controller (`calib.identification.closed_loop.controllers`), so that the errors of redundant actuators
determine how they share the force.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from calib.dynamics import rigid_body
from calib.dynamics.drives import DriveTerm
from calib.errors import CannotSimulate, UsageError, require
from calib.identification.closed_loop.controllers import Reference
from calib.identification.closed_loop.simulation import Sensing, SimulatedRun, failure, sample_ticks
from calib.identification.loop import LoopController
from calib.parallel.mechanism.closure import compiled
from calib.parallel.mechanism.velocities import loop_jacobians
from calib.records import frozen

# Distance [rad or m] of encoders from the reference at which a run has diverged.
FAR = 0.3
# Drive terms that can be simulated, and their columns in the kernels' array.
SHAPES = {"acceleration": 0, "velocity": 1, "sign": 2, "one": 3}


@dataclass(frozen=True, eq=False)
class ParallelPlant:
    """A parallel robot to simulate, in place of a serial arm's `calib.identification.closed_loop.simulation.Plant`.

    Attributes:
        model: `ParallelModel` of the robot with its drive terms.
        parameters: (p,) values of the model's parameters.
        carried: labels of the payloads on board; None: all.
    """

    model: Any
    parameters: np.ndarray
    carried: Collection[str] | None = None

    @property
    def terms(self) -> tuple[DriveTerm, ...]:
        """Drive terms, whose parameters are the last ones of the model."""
        return self.model.columns

    def with_parameters(self, parameters: np.ndarray) -> ParallelPlant:
        """Return the robot with other parameters."""
        return replace(self, parameters=parameters)

    def carrying(self, carried: Collection[str]) -> ParallelPlant:
        """Return the robot with these payloads on board."""
        return replace(self, carried=carried)

    def inertia_diagonal(self, q: np.ndarray) -> np.ndarray:
        """Raise an error: gains proportional to inertia are not supported for parallel robots."""
        raise UsageError("[loop] design is for serial arms only; state the gains as they are")

    def feed_forward(self, reference: Reference) -> np.ndarray:
        """Return the actuators' torques (N, n) along a reference.

        Torques of redundant actuators are those of least norm, plus the model's preload.
        """
        motion = self.model.moved(reference.q, reference.v, reference.a)
        return self.model.actuator_torques(self.parameters, motion, self.carried)

    def run(
        self,
        controller: LoopController,
        reference: Reference,
        sensing: Sensing | None = None,
        seed: int | np.random.Generator = 0,
        mixing: np.ndarray | None = None,
    ) -> SimulatedRun:
        """Return the simulated motion of the robot that follows a reference of its actuators.

        Args:
            controller: controller of the actuators.
            reference: motion of the actuated joints, with a sample per control period.
            sensing: white noise of encoders and logged torques, and control periods per sample; None: the default.
            seed: seed of the noise.
            mixing: (N, n, n) matrices by which the feedback of all actuators is multiplied, for a controller in other
                coordinates; None: none.

        Raises:
            NotConverged: if the loop is unstable; `CannotSimulate` for an inertia matrix that is not positive definite.
        """
        from calib.parallel.mechanism import simulation_kernels

        mechanism = self.model.mechanism
        sensing = sensing or Sensing()
        n = self.model.n
        rng = np.random.default_rng(seed)
        shape = reference.q.shape
        encoder = rng.normal(size=shape) * sensing.sigma_q
        heard = rng.normal(size=shape) * sensing.sigma_tau
        start = mechanism.locate(reference.q[:1])
        jacobians = loop_jacobians(mechanism, start)
        rate_by_reading = np.linalg.pinv(jacobians.readings[0])
        rate = rate_by_reading @ reference.v[0]
        out = np.empty((3, *shape))
        period = reference.period
        if mixing is None:
            mixing = np.empty((0, n, n))
        status, reached = simulation_kernels.run(
            _robot(self.model),
            self._values(),
            np.array(start.q[0]),
            np.array(start.pose[0]),
            rate,
            np.ascontiguousarray(mixing),
            controller.rows,
            reference.sampled(controller.ahead),
            encoder,
            period,
            controller.smoothing(period),
            controller.delay,
            FAR,
            out,
        )
        if status != simulation_kernels.FINE:
            raise failure(status, reached * period)
        tick = sample_ticks(len(out[0]), sensing.every)
        ticks = tick.astype(int)
        periods = np.arange(len(out[0]))
        spline = CubicSpline(periods, out[0])
        q = spline(tick, 0) / period**0
        v = spline(tick, 1) / period**1
        a = spline(tick, 2) / period**2
        t = reference.t[0] + tick * period
        measured = q + encoder[ticks]
        torque = out[2, ticks]
        logged = torque + heard[ticks]
        return SimulatedRun(t, frozen(q), v, a, frozen(measured), frozen(logged), torque)

    def _values(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the parameters of legs, platform and drives as `simulation_kernels.run` takes them."""
        model = self.model
        values = self.parameters
        joint_count = int(model.mechanism.robot.starts[-1])
        drives = np.zeros((joint_count, 5))
        drives[:, 4] = 1.0
        standard = model.spread(values)
        term_values = standard[len(standard) - len(model.terms) :]
        for term, value in zip(model.terms, term_values):
            require(
                term.shape in SHAPES, f"term '{term.name}' ({term.shape}) cannot be simulated: remove it", UsageError
            )
            drives[term.joint, SHAPES[term.shape]] += value
            if term.shape == "sign":
                require(
                    term.settings[0] > 0.0,
                    f"term '{term.name}' cannot be simulated: state its v0, above 0",
                    CannotSimulate,
                )
                drives[term.joint, 4] = term.settings[0]
        bodies_values = []
        for (bodies, *_), parameters in zip(model.legs, model.leg_parameters(values)):
            bodies_values.append(rigid_body.kernel_parameters(bodies, parameters))
        return _stacked(bodies_values), model.platform_parameters(values, self.carried), drives


def _robot(model: Any) -> tuple:
    """Return the arrays that describe a robot to `simulation_kernels.run`."""
    robot = model.mechanism.robot
    links = []
    constants = []
    tails = []
    attachments = []
    equations = []
    for leg in robot.legs:
        bodies, tail = compiled(leg)
        links.append(bodies.links)
        constants.append(bodies.constants)
        tails.append(tail)
        attachments.append(leg.attachment)
        equations.append(leg.held)
    return (
        frozen(_stacked(links), np.int64),
        frozen(_stacked(constants)),
        frozen(_stacked(tails)),
        frozen(_stacked(attachments)),
        robot.starts,
        np.array(equations),
        robot.selected,
        robot.actuated,
        robot.gravity,
        model.mechanism.fixed,
    )


def _stacked(arrays: list[np.ndarray]) -> np.ndarray:
    """Return arrays stacked along a new first axis, each padded with zeros to the largest shape."""
    shapes = [array.shape for array in arrays]
    largest = np.max(shapes, axis=0)
    result = np.zeros((len(arrays), *largest))
    for k, array in enumerate(arrays):
        filled = tuple(slice(length) for length in array.shape)
        result[k][filled] = array
    return result
