"""The LWR4+ of the library as callables: torques for excitation, measured poses or positions for pose selection."""

from functools import cache, partial

import numpy as np

from calib.dynamics import base, drives
from calib.dynamics.bodies import bodies_of, standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.geometry.observability import observation, targets_of
from calib.robot.chain import Chain
from calib.robot.kinematics import sweep, tip_jacobian
from calib.robot.library import load
from calib.workers.threads import one_blas_thread

FC = (11.9, 11.5, 8.98, 8.35, 8.31, 4.72, 6.04)  # [N m], total, Jubien et al. 2014 as quoted in facts
FV = (14.4, 15.3, 6.55, 11.0, 4.29, 2.26, 1.6)  # [N m s/rad]
CHAIN = load("lwr4plus")
LOWER, UPPER = CHAIN.sampling_limits()
TARGETS = targets_of(CHAIN, [(0.05, 0.02, 0.11)])
SIGMAS = (5e-5, 2e-4)  # [m], [rad]
jacobian = observation(TARGETS, "pose", SIGMAS)
point_jacobian = observation(TARGETS, "position", SIGMAS)


def random_poses(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(LOWER, UPPER, (count, len(LOWER)))


@cache
def lwr(v0: float = 0.05) -> tuple[base.BaseModel, np.ndarray, Chain]:
    """Return the base model with 64 columns (43 inertial, Fv Fc off), its parameters, and the chain."""
    model = IdentificationModel(bodies_of(CHAIN), drives.standard(["Fv Fc off"] * 7, v0))
    # tests ask for it while they are collected, when BLAS has all its threads
    with one_blas_thread():
        split = base.find(model)
    friction = np.column_stack([FV, FC, np.zeros(7)])
    values = np.concatenate([standard_parameters(CHAIN), friction.ravel()])
    return base.BaseModel(model, split), split.transform @ values, CHAIN


def tool_points(chain: Chain, q: np.ndarray) -> np.ndarray:
    return sweep(chain, q).position.T[:, None]


def tool_product(chain: Chain, q: np.ndarray, G: np.ndarray) -> np.ndarray:
    return np.einsum("min,mi->mn", tip_jacobian(chain, q)[:, :3], G[:, 0])


def tool(chain: Chain):
    return partial(tool_points, chain), partial(tool_product, chain)
