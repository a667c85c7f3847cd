"""Simulated measurements of every kind: positions, poses, distances, bars, sockets and planes, with white noise."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.poses.measurements import KINDS, Planes, PoseMeasurements, Sockets
from calib.errors import UsageError, one_of, require
from calib.geometry.installation import Installation, see
from calib.records import FieldValues
from calib.robot.calibrated import evaluate
from calib.robot.chain import random_joints
from calib.robot.kinematics import joint_jacobian

# Rows that touch one socket or plane, and centres of a ball bar.
TOUCHES = 12
CENTRES = 3
# Sockets are placed at this share of a random point's distance, in pairs this far apart [m] (our choice).
SOCKET_SHARE = 0.6
PAIR = 0.1
# Newton steps until joints touch, the longest [rad or m], and the distance [m] at which they do.
STEPS = 80
LONGEST_STEP = 0.3
TOUCHED = 1e-12
DAMPING = 1e-9
# Share of the rows that must reach their socket or plane.
MIN_TOUCHED = 0.6


def measure_kind(
    truth: Installation,
    kind: str,
    q: np.ndarray,
    rng: np.random.Generator,
    *,
    sigma: float = 0.0,
    sigma_rotation: float | None = None,
    with_sigma: bool = True,
    station: int = 0,
    tools: Sequence[int] = (0,),
    torque: Callable[[np.ndarray], np.ndarray] | None = None,
    file: str = "simulated",
) -> PoseMeasurements:
    """Return simulated measurements of a kind at joint values q (m, n) [rad or m].

    Two rows make a distance, a third of the rows a ball bar about one centre, `TOUCHES` rows a socket or plane. For
    sockets and planes, the joints are moved from `q` until the target touches, up to the noise.

    Args:
        truth: the true arm with stations and tools.
        kind: a key of `calib.data.poses.measurements.KINDS`.
        q: joint values of the rows.
        rng: generator of the noise, the centres and the places of sockets and planes.
        sigma: σ of each coordinate or distance [m].
        sigma_rotation: σ about each axis [rad]; None: the number of `sigma`.
        with_sigma: whether the measurements state their σ.
        station: index of the station.
        tools: indices of the tools, taken in turn.
        torque: function of q that returns the gravity torques (m, n) [N m]; None: none are stated.
        file: name of the file for messages.

    Raises:
        UsageError: an unknown kind, an odd number of rows of distances, fewer rows of a bar than centres, or the arm
            does not reach its sockets or planes.
    """
    one_of(kind, KINDS, "kind of measurement", UsageError)
    count = len(q)
    require(kind != "distance" or count % 2 == 0, f"{count} rows: two rows make a distance", UsageError)
    require(kind != "bar" or count >= CENTRES, f"{count} rows: fewer than the {CENTRES} centres of a bar", UsageError)
    tool = np.resize(np.array(tools), count)
    if kind in ("sockets", "plane"):
        return _touched(truth, kind, q, tool, sigma, with_sigma, file, rng)
    gravity = None
    if torque:
        gravity = torque(q)
    bases = evaluate(truth.deflection, q, gravity)
    sighting = see(truth, q, station, tool, bases)
    point = sighting.point.T
    tool_numbers = np.unique(tools)
    common: FieldValues = {
        "q": q,
        "joint_names": truth.chain.joint_names,
        "tool": np.searchsorted(tool_numbers, tool),
        "tool_names": tuple(truth.tool_names[k] for k in tool_numbers),
        "station": truth.station_names[station],
        "file": file,
        "torque": gravity,
        "sigma": None,
    }
    if with_sigma and sigma:
        shape: tuple[int, ...] = (count, 3)
        if kind in ("distance", "bar"):
            shape = (count,)
        common["sigma"] = np.full(shape, sigma)
    if kind in ("pose", "position"):
        common["position"] = point + sigma * rng.normal(size=point.shape)
    if kind == "pose":
        angle = sigma
        if sigma_rotation is not None:
            angle = sigma_rotation
        turn = Rotation.from_rotvec(angle * rng.normal(size=point.shape))
        common["quaternion"] = (turn * Rotation.from_matrix(sighting.poses()[:, :3, :3])).as_quat()
        common["sigma_rotation"] = None
        if with_sigma and angle:
            common["sigma_rotation"] = np.full((count, 3), angle)
    elif kind == "distance":
        gap = np.linalg.norm(point[0::2] - point[1::2], axis=1) + sigma * rng.normal(size=count // 2)
        common["distance"] = np.repeat(gap, 2)
        common["group"] = np.repeat(np.arange(count // 2), 2)
    elif kind == "bar":
        group = np.minimum(np.arange(count) // (count // CENTRES), CENTRES - 1)
        centres = rng.uniform(-2.0, 2.0, (CENTRES, 3))[group]
        common["distance"] = np.linalg.norm(point - centres, axis=1) + sigma * rng.normal(size=count)
        common["group"] = group
    return KINDS[kind](**common)


def _touched(
    truth: Installation,
    kind: str,
    q: np.ndarray,
    tool: np.ndarray,
    sigma: float,
    with_sigma: bool,
    file: str,
    rng: np.random.Generator,
) -> PoseMeasurements:
    """Return measurements at joints moved from q (m, n) until the target touches its socket or plane, up to the noise.

    Args:
        truth: the true arm with its tools.
        kind: ``sockets`` or ``plane``.
        q: joint values from which the joints are moved.
        tool: (m,) indices of the tools.
        sigma: σ of the touching [m].
        with_sigma: whether the measurements state their σ.
        file: name of the file for messages.
        rng: generator of the noise and of the places.
    """
    group = np.arange(len(q)) // TOUCHES
    count = int(group[-1]) + 1
    inner = replace(truth, stations=np.eye(4)[None])
    start = see(inner, random_joints(truth.chain, count, rng), 0, tool[::TOUCHES]).point.T
    sockets = SOCKET_SHARE * start
    pairs = count // 2
    sockets[1::2] = sockets[0 : 2 * pairs : 2] + PAIR * _unit(rng.normal(size=(pairs, 3)))
    normals = _unit(rng.normal(size=(count, 3)))
    aim = sockets[group] + sigma * rng.normal(size=(len(q), 3))
    missed = np.full(len(q), np.inf)
    for _ in range(STEPS):
        sighting = see(inner, q, 0, tool)
        slope = joint_jacobian(truth.chain, sighting.walked, sighting.point)[:, :3]
        miss = (aim - sighting.point.T)[:, :, None]
        if kind == "plane":
            normal = normals[group]
            miss = np.einsum("mi,mi->m", normal, miss[:, :, 0])[:, None, None]
            slope = np.einsum("mi,mij->mj", normal, slope)[:, None]
        missed = np.linalg.norm(miss[:, :, 0], axis=1)
        transposed = slope.transpose(0, 2, 1)
        square = slope @ transposed + DAMPING * np.eye(slope.shape[1])
        change = (transposed @ np.linalg.solve(square, miss))[:, :, 0]
        length = np.maximum(np.linalg.norm(change, axis=1), TOUCHED)
        q = q + change * np.minimum(1.0, LONGEST_STEP / length)[:, None]
    good = missed < TOUCHED
    if good.mean() <= MIN_TOUCHED:
        raise UsageError(f"{int(good.sum())} of {len(q)} rows touch their {kind}: the arm does not reach the others")
    common: FieldValues = {
        "q": q[good],
        "joint_names": truth.chain.joint_names,
        "group": group[good],
        "group_names": tuple(f"place{k // 2}/{k % 2}" for k in range(count)),
        "tool": np.zeros(int(good.sum())),
        "tool_names": (truth.tool_names[tool[0]],),
        "file": file,
    }
    shape: tuple[int, ...] = (int(good.sum()), 3)
    if kind == "plane":
        shape = shape[:1]
    common["sigma"] = None
    if with_sigma and sigma:
        common["sigma"] = np.full(shape, sigma)
    if kind == "plane":
        return Planes(**common)
    links = tuple((2 * pair, 2 * pair + 1, PAIR) for pair in range(pairs))
    return Sockets(links=links, **common)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (m, 3) of length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
