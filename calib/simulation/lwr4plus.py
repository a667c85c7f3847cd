"""The KUKA LWR4+ of Kolyubin, Shiriaev & Jubien (2019), Int. J. Adv. Manuf. Technol. 101, 243-259: Tables 1, 2 and 3.

Rows of Table 2 are frames 0 to 8, columns alpha [rad], d [m], theta [rad], r [m]; frames 0 and 1 (without q1) place the
arm in the camera's frame, frame 8 places the LED fixture behind joint 7.
"""

from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from calib.robot import description, library
from calib.robot.chain import Chain
from calib.robot.kinematics import forward, joint_jacobian, sweep
from calib.transforms import invert, pose

COLUMNS = ("alpha", "d", "theta", "r")
# Table 3: errors of the nominal and of the calibrated arm on poses outside the fit.
NOMINAL_ERRORS = {"position_mm": {"max": 9.6806, "mean": 5.9019}, "orientation_deg": {"max": 0.8058, "mean": 0.5636}}
CALIBRATED_ERRORS = {"position_mm": {"max": 1.7592, "mean": 0.7965}, "orientation_deg": {"max": 0.2268, "mean": 0.1042}}
TABLE_3 = {"nominal": NOMINAL_ERRORS, "calibrated": CALIBRATED_ERRORS}
# Numbers of measured poses and of base parameters, and the condition number of the poses' regressor.
POSES = 17
BASE_PARAMETERS = 32
CONDITION = 11.1878
# Frames of Table 2 that joints 2 to 7 move: the frames of the library's arm.
ARM_FRAMES = range(2, 8)
# Joint limits of Table 1 [rad].
JOINT_LIMITS = np.deg2rad([170.0, 120.0, 170.0, 120.0, 170.0, 90.0, 170.0])


def transform(alpha: float, d: float, theta: float, r: float) -> np.ndarray:
    """Return Rot_x(alpha) Trans_x(d) Rot_z(theta) Trans_z(r), (4, 4)."""
    about_x = Rotation.from_euler("x", alpha)
    about_z = Rotation.from_euler("z", theta)
    return pose(about_x, [d, 0.0, 0.0]) @ pose(about_z, [0.0, 0.0, r])


@cache
def table_2() -> tuple[np.ndarray, np.ndarray]:
    """Return the nominal and calibrated values of Table 2, each (9, 4)."""
    geometry = description.read_extra(library.path("lwr4plus_truth"))["truth"]["geometry"]
    return np.array(geometry["nominal"]), np.array(geometry["calibrated"])


def nominal_chain() -> Chain:
    """Return the library's nominal LWR4+ arm."""
    return description.read(library.path("lwr4plus"))


def arm(table: np.ndarray) -> Chain:
    """Return the library's arm with the values of frames 2 to 7 of a table (9, 4)."""
    values = {}
    for frame in ARM_FRAMES:
        for column, value in zip(COLUMNS, table[frame]):
            values[f"{column}{frame}"] = value
    return nominal_chain().with_values(values)


def station(table: np.ndarray) -> np.ndarray:
    """Return the pose of the arm's base in the camera's frame (4, 4): frames 0 and 1, without q1."""
    return transform(*table[0]) @ transform(*table[1])


def tool(table: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) of the LED fixture in the frame of the library arm's flange, from frame 8."""
    flange = nominal_chain().tail
    return invert(flange) @ transform(*table[8])


def constraint_values(chain: Chain, station: np.ndarray, tool: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the values (m, 6) of the constraints of Table 1, which are satisfied where they are >= 0.

    Columns: lower and upper bound of roll, lower and upper bound of pitch [rad], distance from axis 1, height [m]. The
    paper does not define roll, pitch and the origin of z. We take them from R = Rz Ry Rx of the LED fixture in the
    camera's frame, and the height above the floor plate, 0.31 m below the shoulder.

    Args:
        chain: the arm.
        station: (4, 4) pose of the arm's base in the camera's frame.
        tool: (4, 4) pose of the fixture in the frame of the arm's flange.
        q: (m, n) joint values [rad].
    """
    fixture = forward(chain, q) @ tool
    rotation = station[:3, :3] @ fixture[:, :3, :3]
    x_axis = rotation[:, :, 0]
    z_row = rotation[:, 2]
    roll = np.arctan2(z_row[:, 1], z_row[:, 2])
    cosine_of_pitch = np.hypot(x_axis[:, 0], x_axis[:, 1])
    pitch = np.arctan2(-z_row[:, 0], cosine_of_pitch)
    x, y, z = fixture[:, :3, 3].T
    across = np.hypot(x, y)
    height = z + 0.31
    values = [
        roll + 4 * np.pi / 9,
        7 * np.pi / 18 - roll,
        pitch + np.pi / 4,
        np.pi / 4 - pitch,
        across - 0.2,
        height + 0.1,
    ]
    return np.column_stack(values)


def constraint_gradients(chain: Chain, station: np.ndarray, tool: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the derivatives (m, 6, 7) of `constraint_values` with respect to the joint values q (m, 7).

    With R = Rz(ψ) Ry(θ) Rx(φ) and the angular velocity ω in the camera's frame: φ' = (ω_x cos ψ + ω_y sin ψ) / cos θ,
    θ' = ω_y cos ψ - ω_x sin ψ.
    """
    walked = sweep(chain, q)
    fixture = walked.poses() @ tool
    position = fixture[:, :3, 3]
    slope = joint_jacobian(chain, walked, position.T)
    # direction (m, 2) from axis 1 to the fixture
    from_axis = np.hypot(position[:, 0], position[:, 1])
    distance = np.maximum(from_axis, 1e-9)
    across = position[:, :2] / distance[:, None]
    away = np.einsum("mi,min->mn", across, slope[:, :2])
    rotation = station[:3, :3]
    turn = rotation @ slope[:, 3:]
    fixture_axis = rotation @ fixture[:, :3, 0].T
    x, y = fixture_axis[:2, :, None]
    omega_x = turn[:, 0]
    omega_y = turn[:, 1]
    cosine = np.maximum(np.hypot(x, y), 1e-9)
    roll = (x * omega_x + y * omega_y) / cosine**2
    pitch = (x * omega_y - y * omega_x) / cosine
    height = slope[:, 2]
    return np.stack([roll, -roll, pitch, -pitch, away, height], axis=1)


def feasible(chain: Chain, station: np.ndarray, tool: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return whether joint values q (m, 7) satisfy Table 1, joint limits included: (m,) bool."""
    in_limits = JOINT_LIMITS - np.abs(q)
    constraints = constraint_values(chain, station, tool, q)
    margins = np.concatenate([in_limits, constraints], axis=1)
    return np.all(margins >= 0.0, axis=1)
