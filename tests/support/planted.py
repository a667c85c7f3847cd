"""Cells with planted truth, measured exactly or with noise in every kind of measurement."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.poses.measurements import PoseMeasurements
from calib.geometry.installation import Installation, see
from calib.geometry.observation import observe, prepare
from calib.geometry.weighing import GeometricFit
from calib.robot.chain import Chain, random_joints
from calib.robot.library import load
from calib.simulation.kinds import measure_kind
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
    return measure_kind(
        truth,
        kind,
        q,
        rng,
        sigma=sigma,
        sigma_rotation=sigma_rotation,
        with_sigma=stated,
        station=station,
        tools=tools,
        torque=torque,
        file=file,
    )


def deviation(found: GeometricFit, exact: Sequence[PoseMeasurements]) -> tuple[float, float]:
    """Return the squared distance of the truth's base parameters from the estimate's, and what no parameter explains.

    Parameters have a gauge (an offset of joint 1 is a turn of the base), what is measured has not: the residuals of
    exact measurements at other joints are r = W (x_true - x); x_true - x by least squares, then its size in sigmas.

    Returns:
        dβᵀ C⁻¹ dβ, chi-squared with as many degrees of freedom as base parameters; and ‖r - W dx‖ / ‖r‖.
    """
    residuals = []
    matrices = []
    for block in prepare(found.cell, exact):
        for part in observe(found.cell, block, found.free):
            part_residual, part_matrix = part.whitened(np.ones(1))
            residuals.append(part_residual)
            matrices.append(part_matrix)
    residual = np.concatenate(residuals)
    matrix = np.concatenate(matrices)
    scale = np.linalg.norm(matrix, axis=0)
    # parameters that merge leave directions that are zero but for rounding
    dx = np.linalg.lstsq(matrix / scale, residual, rcond=1e-9)[0] / scale
    unexplained = np.linalg.norm(residual - matrix @ dx) / np.linalg.norm(residual)
    base = found.regrouping()
    sigma = found.base_sigma()
    correlation = base @ found.estimate.covariance @ base.T / np.outer(sigma, sigma)
    distance = base @ dx / sigma
    return float(distance @ np.linalg.solve(correlation, distance)), float(unexplained)


def position_error(found: Installation, truth: Installation, q: np.ndarray) -> np.ndarray:
    """Return the distance (m,) between predicted and true target positions [m]."""
    return np.linalg.norm(see(found, q).point - see(truth, q).point, axis=0)


__all__ = ["cell", "deviation", "frames", "load", "measure", "perturb", "position_error", "random_joints"]
