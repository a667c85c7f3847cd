"""An arm whose joints and links give under gravity, simulated by Pinocchio alone: poses, and torques of its sensors.

It shares no code with the toolkit: kinematics, gravity and payloads are Pinocchio's; joints turn by c τ, and bearings
tilt by c times the moment across the axis.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

HEAD = [f"q{j}" for j in range(1, 8)] + ["x", "y", "z"] + [f"tau{j}" for j in range(1, 8)]
QUARTER = 1.5707963267948966  # of a turn [rad]
HALF = 3.141592653589793
# origins of the joints: xyz [m], and roll and yaw [rad]
LENGTHS = (
    (0.0, 0.0, 0.34),
    (0.0, 0.0, 0.0),
    (0.0, -0.4, 0.0),
    (0.0, 0.0, 0.0),
    (0.0, -0.4, 0.0),
    (0.0, 0.0, 0.0),
    (0.0, -0.126, 0.0),
)
TURNS = (
    (0.0, 0.0),
    (-QUARTER, 0.0),
    (-QUARTER, HALF),
    (-QUARTER, 0.0),
    (-QUARTER, HALF),
    (-QUARTER, 0.0),
    (QUARTER, 0.0),
)
MASSES = (3.5, 3.5, 4.1, 4.1, 2.3, 2.2, 1.8)


def urdf(masses: bool = False) -> str:
    """Return an arm of seven joints, with or without masses."""
    lines = ['<robot name="giving"><link name="base"/>']
    parent = "base"
    for number, (xyz, turn) in enumerate(zip(LENGTHS, TURNS), 1):
        body = ""
        if masses:
            centre = f"0.002 {-0.02 * (number % 2)} 0.05"
            body = (
                f'<inertial><origin xyz="{centre}"/><mass value="{MASSES[number - 1]}"/>'
                '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>'
            )
        lines.append(f'<link name="link{number}">{body}</link>')
        origin = " ".join(map(str, xyz))
        lines.append(
            f'<joint name="joint{number}" type="revolute"><parent link="{parent}"/><child link="link{number}"/>'
            f'<origin xyz="{origin}" rpy="{turn[0]} 0 {turn[1]}"/><axis xyz="0 0 1"/>'
            '<limit lower="-2.9" upper="2.9" effort="200" velocity="3"/></joint>'
        )
        parent = f"link{number}"
    return "\n".join([*lines, "</robot>"])


@dataclass
class GivingArm:
    """An arm with planted errors: geometry, compliance about and across the axes, sensors of torque.

    Attributes:
        seed: seed of all planted errors.
        noise: of a measured position [m].
        friction: of a joint at rest, as a share of its largest torque, in the sensors' torques with either sign.
        gain: standard deviation of the sensors' gains.
    """

    seed: int = 0
    noise: float = 1e-4
    friction: float = 0.0
    gain: float = 0.01

    def __post_init__(self) -> None:
        random = np.random.default_rng(self.seed)
        self.model = pin.buildModelFromXML(urdf(masses=True))
        self.across = random.uniform(0.3, 1.0, (7, 2)) * 2e-5
        self.about = random.uniform(0.5, 1.5, 7) * np.array([1, 1, 1.5, 1.5, 3, 4, 4]) * 2e-5
        for joint in range(1, 8):
            shift = pin.SE3(pin.exp3(1e-3 * random.normal(size=3)), 5e-4 * random.normal(size=3))
            self.model.jointPlacements[joint] = self.model.jointPlacements[joint] * shift
        self.gains = 1.0 + self.gain * random.normal(size=7)
        self.offsets = 0.15 * random.normal(size=7)
        self.tool = random.uniform(-0.05, 0.05, 3) + np.array([0.0, 0.0, 0.1])

    def table(
        self, count: int, seed: int, load: float = 0.0, centre: tuple = (0.0, 0.0, 0.1), poses: np.ndarray | None = None
    ) -> np.ndarray:
        """Return rows of joint values, positions of the target in the instrument, and sensors' torques.

        Args:
            count: number of poses.
            seed: seed of poses and noise.
            load: mass of the payload [kg].
            centre: its centre of mass in the flange [m].
            poses: (count, 7) joint values; None: random ones.
        """
        random = np.random.default_rng(1000 + seed)
        model = self.model.copy()
        if load:
            inertia = pin.Inertia(load, np.array(centre), np.zeros((3, 3)))
            model.appendBodyToJoint(7, inertia, pin.SE3.Identity())
        data = model.createData()
        station = pin.SE3(pin.exp3(np.array([0.1, -0.2, 0.7])), np.array([1.5, 0.4, 0.2]))
        low = np.array([-1.5, 0.0, -2.8, -2.0, -2.8, -2.0, -2.8])
        rows = []
        if poses is None:
            poses = random.uniform(low, -low + [0, 2.0, 0, 0, 0, 0, 0], (count, 7))
        for q in poses:
            gravity = pin.computeGeneralizedGravity(model, data, q)
            pin.forwardKinematics(model, data, q)
            placement = pin.SE3.Identity()
            torque_before = self._moments(model, data)
            for joint in range(7):
                tilt = np.append(-self.across[joint] * torque_before[joint], 0.0)
                placement = placement * model.jointPlacements[joint + 1] * pin.SE3(pin.exp3(tilt), np.zeros(3))
                angle = q[joint] - self.about[joint] * gravity[joint]
                placement = placement * pin.SE3(pin.exp3(np.array([0.0, 0.0, angle])), np.zeros(3))
            point = station.act(placement.act(self.tool)) + self.noise * random.normal(size=3)
            stuck = self.friction * np.array([60, 60, 30, 30, 5, 5, 1]) * random.choice([-1.0, 1.0], 7)
            sensed = self.gains * gravity + self.offsets + 0.1 * random.normal(size=7) + stuck
            rows.append(np.concatenate([q, point, sensed]))
        return np.array(rows)

    def _moments(self, model, data) -> list[np.ndarray]:
        """Return for each joint the moment (2,) across its axis that balances gravity, in the axes before its turn."""
        result = []
        for joint in range(1, 8):
            force = np.zeros(3)
            for body in range(joint, 8):
                mass = model.inertias[body].mass
                lever = data.oMi[body].act(model.inertias[body].lever) - data.oMi[joint].translation
                force += np.cross(lever, -mass * model.gravity.linear)
            before = data.oMi[model.parents[joint]] * model.jointPlacements[joint]
            result.append((before.rotation.T @ force)[:2])
        return result

    def write(self, path: Path, table: np.ndarray, names: list[str] | None = None) -> Path:
        """Write a table to a file, with other names of its columns if there are any."""
        np.savetxt(path, table, delimiter=",", header=",".join(names or HEAD), comments="")
        return path
