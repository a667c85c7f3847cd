"""Robots for the planning tests: the LWR4+ with its drives, and a cart whose fastest motion is known in closed form."""

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from scipy.optimize import brentq

from calib.data.csv_table import read_table
from calib.dynamics import base, drives
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.path_dynamics import PathDynamics, of_standard
from calib.identification.model_file import to_table
from calib.identification.prediction import Dynamics
from calib.robot import description
from calib.robot.library import load
from calib.simulation.known_robots import truth
from calib.trajectories.timing.path_limits import TimingLimits

CHAIN = load("lwr4plus")
WAYPOINTS = np.array(
    [[0, 0.5, 0, -1, 0, 0.5, 0], [0.8, 1.0, 0.3, -1.4, 0.5, 0.2, 0.7], [1.5, 0.3, -0.4, -0.6, 1, -0.8, 0]]
)


def read_setpoints(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of a motion's file: t (N,), and q, v, a, tau (N, n) as far as they are there."""
    table = read_table(path)
    columns = {"t": table.numbers("t", None)}
    for letter in ("q", "v", "a", "tau"):
        block = table.block(letter)
        if block is not None:
            columns[letter] = block
    return columns


@cache
def identified(viscous: float = 1.0) -> Dynamics:
    """Return the arm's model with Ia, Fv, Fc of the truth, viscous friction times a factor."""
    known = truth("lwr4plus")["drives"]
    amounts = np.column_stack([known["Ia"], viscous * np.array(known["Fv"]), known["Fc"]]).ravel()
    model = IdentificationModel(bodies_of(CHAIN), drives.standard(["Ia Fv Fc"] * 7))
    return Dynamics(model, np.concatenate([standard_parameters(CHAIN), amounts]))


@cache
def lwr(viscous: float = 1.0) -> PathDynamics:
    return of_standard(identified(viscous).model, identified(viscous).values)


@cache
def base_of_lwr() -> base.Base:
    return base.find(identified().model)


def write_model(folder: Path, **changed: float) -> None:
    """Write what `calib identify` writes of the arm's model, without its covariance; `changed`: values by name."""
    model = identified().model
    values = np.array([changed.get(name, value) for name, value in zip(model.names, identified().values)])
    table = to_table(Dynamics(model, values), base_of_lwr())
    description.write(folder / "robot.toml", CHAIN)
    (folder / "dynamics.json").write_text(json.dumps(table))


def limits(**changed) -> TimingLimits:
    """Return the arm's limits, some of them changed."""
    bounds = {
        "velocity": np.array([joint.velocity for joint in CHAIN.joints]),
        "acceleration": np.full(7, np.inf),
        "torque": np.array([joint.effort for joint in CHAIN.joints]),
    }
    return TimingLimits(**bounds | changed)


@dataclass(frozen=True)
class Cart:
    """tau = m a + F v + c sign(v) on one axis."""

    mass: float = 2.0
    viscous: float = 0.0
    coulomb: float = 0.0

    def along(self, q, slope, curvature):
        return self.mass * slope, self.mass * curvature, np.zeros_like(q)

    def friction(self, q, v, a):
        return self.viscous * v + self.coulomb * np.sign(v)

    def torque(self, q, v, a):
        return self.mass * a + self.friction(q, v, a)

    def fastest(self, force: float, way: float) -> float:
        """Return the shortest time from rest to rest: all force forwards, then all backwards, integrated by hand."""
        rate = self.viscous / self.mass
        forwards = (force - self.coulomb) / self.mass
        backwards = (force + self.coulomb) / self.mass

        def phases(first: float) -> tuple[float, float]:
            """Return when it rests and where, pushed for `first` seconds."""
            if not rate:
                speed = forwards * first
                distance = speed * first / 2 + speed**2 / backwards / 2
                return first + speed / backwards, distance
            speed = forwards / rate * -np.expm1(-rate * first)
            second = np.log1p(rate * speed / backwards) / rate
            distance = (forwards * first - speed) / rate + (speed - backwards * second) / rate
            return first + second, distance

        def overshoot(first: float) -> float:
            return phases(first)[1] - way

        return phases(brentq(overshoot, 1e-9, 1e3, xtol=1e-14))[0]


def cart_limits(force: float = np.inf, velocity: float = np.inf, acceleration: float = np.inf) -> TimingLimits:
    return TimingLimits(np.array([velocity]), np.array([acceleration]), np.array([force]))
