"""Cells with planted truth, measured exactly or with noise in every kind of measurement."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.poses.measurements import KINDS, Planes, PoseMeasurements, Sockets
from calib.geometry.installation import Installation, see
from calib.geometry.observation import observe, prepare
from calib.geometry.weighing import GeometricFit
from calib.robot.chain import Chain, random_joints
from calib.robot.kinematics import joint_jacobian
from calib.robot.library import load
from calib.transforms import pose


def perturb(chain: Chain, seed: int, length: float = 1e-3, angle: float = 2e-3) -> Chain:
    """Return the chain with every element moved by normal errors [m, rad]."""
    scale = np.array([length if unit == "m" else angle for unit in chain.units])
    return chain.with_values(chain.values + scale * np.random.default_rng(seed).normal(size=len(scale)))


def frames(count: int, seed: int, reach: float) -> np.ndarray:
    """Return random placements (count, 4, 4) with offsets of about `reach` [m] and any orientation."""
    rng = np.random.default_rng(seed)
    return pose(Rotation.random(count, rng=rng), rng.uniform(-reach, reach, (count, 3)))


def cell(
    chain: Chain, seed: int = 0, stations: Sequence[str] = ("station",), tools: Sequence[str] = ("tool",)
) -> Installation:
    """Return the chain with instruments some 2 m away and targets some 0.1 m off the flange."""
    return Installation(
        chain,
        frames(len(stations), 2 * seed + 1, 2.0),
        frames(len(tools), 2 * seed + 2, 0.1),
        tuple(stations),
        tuple(tools),
    )


def measure(
    truth: Installation,
    kind: str,
    count: int,
    seed: int = 0,
    *,
    sigma: float = 0.0,
    sigma_rotation: float | None = None,
    stated: bool = True,
    station: int = 0,
    tools: Sequence[int] = (0,),
    torque: Callable[[np.ndarray], np.ndarray] | None = None,
    file: str = "planted",
) -> PoseMeasurements:
    """Measure `count` rows of a kind at random joints, with noise `sigma` [m] and `sigma_rotation` [rad].

    Sockets, planes: the joints are moved until the point lies there, up to the noise. 12 rows make a group.
    """
    rng = np.random.default_rng(seed)
    q = random_joints(truth.chain, count, rng)
    tool = np.resize(np.array(tools), count)
    if kind in ("sockets", "plane"):
        return _touched(truth, kind, q, tool, sigma, stated, file, rng)
    from calib.robot import calibrated

    pulled = torque(q) if torque else None
    bases = calibrated.evaluate(truth.deflection, q, pulled)
    seen = see(truth, q, station, tool, bases)
    point = seen.point.T
    common: dict[str, Any] = dict(
        q=q,
        joint_names=truth.chain.joint_names,
        tool=np.searchsorted(np.unique(tools), tool),
        tool_names=tuple(truth.tool_names[k] for k in np.unique(tools)),
        station=truth.station_names[station],
        file=file,
        torque=pulled,
        sigma=np.full(count if kind in ("distance", "bar") else (count, 3), sigma) if stated and sigma else None,
    )
    if kind in ("pose", "position"):
        common["position"] = point + sigma * rng.normal(size=point.shape)
        if kind == "pose":
            angle = sigma if sigma_rotation is None else sigma_rotation
            turn = Rotation.from_rotvec(angle * rng.normal(size=point.shape))
            common["quaternion"] = (turn * Rotation.from_matrix(seen.poses()[:, :3, :3])).as_quat()
            common["sigma_rotation"] = np.full((count, 3), angle) if stated and angle else None
    elif kind == "distance":
        gap = np.linalg.norm(point[0::2] - point[1::2], axis=1) + sigma * rng.normal(size=count // 2)
        common |= {"distance": np.repeat(gap, 2), "group": np.repeat(np.arange(count // 2), 2)}
    elif kind == "bar":
        group = np.arange(count) // (count // 3)
        centres = rng.uniform(-2.0, 2.0, (3, 3))[np.minimum(group, 2)]
        length = np.linalg.norm(point - centres, axis=1) + sigma * rng.normal(size=count)
        common |= {"distance": length, "group": np.minimum(group, 2)}
    return KINDS[kind](**common)


def _touched(
    truth: Installation,
    kind: str,
    q: np.ndarray,
    tool: np.ndarray,
    sigma: float,
    stated: bool,
    file: str,
    rng: np.random.Generator,
) -> PoseMeasurements:
    """Move the joints until the target touches its socket or plane, up to the noise."""
    group = np.arange(len(q)) // 12
    count = group[-1] + 1
    inner = replace(truth, stations=np.eye(4)[None])
    start = see(inner, random_joints(truth.chain, count, rng), 0, tool[::12]).point.T
    sockets = 0.6 * start
    sockets[1::2] = sockets[0 : 2 * (count // 2) : 2] + 0.1 * _unit(rng.normal(size=(count // 2, 3)))
    normals = _unit(rng.normal(size=(count, 3)))
    aim = sockets[group] + sigma * rng.normal(size=(len(q), 3))
    for _ in range(80):
        seen = see(inner, q, 0, tool)
        jacobian = joint_jacobian(truth.chain, seen.walked, seen.point)[:, :3]
        miss, slope = (aim - seen.point.T)[:, :, None], jacobian
        if kind == "plane":
            n = normals[group]
            miss, slope = (
                np.einsum("mi,mi->m", n, miss[:, :, 0])[:, None, None],
                np.einsum("mi,mij->mj", n, slope)[:, None],
            )
        square = slope @ slope.transpose(0, 2, 1) + 1e-9 * np.eye(slope.shape[1])
        change = (slope.transpose(0, 2, 1) @ np.linalg.solve(square, miss))[:, :, 0]
        change *= np.minimum(1.0, 0.3 / np.maximum(np.linalg.norm(change, axis=1), 1e-12))[:, None]
        q = q + change
    good = np.linalg.norm(miss[:, :, 0], axis=1) < 1e-12
    assert good.mean() > 0.6, "the arm does not reach its sockets"
    common: dict[str, Any] = dict(
        group=group[good],
        group_names=tuple(f"place{k // 2}/{k % 2}" for k in range(count)),
        tool=np.zeros(good.sum()),
        tool_names=(truth.tool_names[tool[0]],),
        file=file,
    )
    spread = np.full((good.sum(), 3), sigma) if stated and sigma else None
    if kind == "plane":
        return Planes(q[good], truth.chain.joint_names, sigma=None if spread is None else spread[:, 0], **common)
    links = tuple((2 * k, 2 * k + 1, 0.1) for k in range(count // 2))
    return Sockets(q[good], truth.chain.joint_names, sigma=spread, links=links, **common)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def deviation(found: GeometricFit, exact: Sequence[PoseMeasurements]) -> tuple[float, float]:
    """Return the squared distance of the truth's base parameters from the estimate's, and what no parameter explains.

    Parameters have a gauge (an offset of joint 1 is a turn of the base), what is measured has not: the residuals of
    exact measurements at other joints are r = W (x_true - x); x_true - x by least squares, then its size in sigmas.

    Returns:
        dβᵀ C⁻¹ dβ, chi-squared with as many degrees of freedom as base parameters; and ‖r - W dx‖ / ‖r‖.
    """
    parts = [part for block in prepare(found.cell, exact) for part in observe(found.cell, block, found.free)]
    residual, matrix = map(np.concatenate, zip(*(part.whitened(np.ones(1)) for part in parts)))
    scale = np.linalg.norm(matrix, axis=0)
    # parameters that merge leave directions that are zero but for rounding
    dx = np.linalg.lstsq(matrix / scale, residual, rcond=1e-9)[0] / scale
    rest = np.linalg.norm(residual - matrix @ dx) / np.linalg.norm(residual)
    base, sigma = found.regrouping(), found.base_sigma()
    correlation = base @ found.estimate.covariance @ base.T / np.outer(sigma, sigma)
    off = base @ dx / sigma
    return float(off @ np.linalg.solve(correlation, off)), float(rest)


def position_error(found: Installation, truth: Installation, q: np.ndarray) -> np.ndarray:
    """Return the distance (m,) between predicted and true target positions [m]."""
    return np.linalg.norm(see(found, q).point - see(truth, q).point, axis=0)


__all__ = ["cell", "deviation", "frames", "load", "measure", "perturb", "position_error", "random_joints"]
