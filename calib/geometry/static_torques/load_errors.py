"""Expected errors under a load with which no pose was fitted: by the doubt of compliance and of the masses."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.data.poses.measurements import PoseMeasurements
from calib.geometry.installation import Installation
from calib.robot.calibrated import BY_TORQUE
from calib.robot.chain import Chain
from calib.robot.kinematics import element_jacobian, gravity_moments, sweep

# [rad] prior standard deviation of a joint's turn under its largest torque, as gears wind up (our choice); across the
# axis half of it
TURN = 1e-2
# [N m/m²] largest torque of a joint without stated effort, over the square of the length
USUAL_EFFORT = 100.0
# standard deviation of the masses, as a share: of a description, and of torques at rest, whose sensors' gain enters
DESCRIBED, WEIGHED = 0.3, 0.03
# [kg] loads that differ by less are one
SAME_LOAD = 0.05


def load_masses(blocks: Sequence[PoseMeasurements]) -> tuple[float, ...]:
    """Return the distinct masses [kg] that the arm carried in blocks beyond its masses, rounded; 0 if none is known."""
    masses: set[float] = set()
    for block in blocks:
        if block.load is None:
            masses.add(0.0)
        else:
            masses |= set(np.unique(np.round(block.load[:, 3], 2)).tolist())
    return tuple(sorted(masses))


def load_variance(
    cell: Installation, block: PoseMeasurements, masses: Sequence[float], mass_doubt: float
) -> np.ndarray | None:
    """Return the error variance (m,) [m²] of the target's position due to a load with which no pose was fitted.

    With compliance by torques it is the share of the load's deflection that the masses' doubt leaves open; without, the
    deflection by compliance of a usual size. None for a load with which poses were fitted.

    Args:
        cell: the fitted installation.
        block: the rows, with their load.
        masses: masses that the fitted poses carried [kg].
        mass_doubt: standard deviation of the masses by which compliance was fitted, as a share of them.
    """
    if block.load is None or not len(block):
        return None
    chain = cell.chain
    distance = np.min(np.abs(block.load[:, 3:] - np.array(masses or (0.0,))), axis=1)
    if distance.max() < SAME_LOAD or len(chain.driven) != chain.n:
        return None
    compliance, doubtful = _compliance(cell)
    per_element = load_motions(cell, block) * compliance[:, None, None]
    if doubtful:
        variance = np.sum(per_element**2, axis=(0, 1))
    else:
        variance = mass_doubt**2 * np.sum(np.sum(per_element, axis=0) ** 2, axis=0)
    return np.where(distance < SAME_LOAD, 0.0, variance)


def load_motions(cell: Installation, block: PoseMeasurements) -> np.ndarray:
    """Return the motion (K, 3, m) [m per rad/(N m)] of the target by a block's load, per compliance of each element.

    Args:
        cell: the installation.
        block: the rows, with their load.
    """
    chain = cell.chain
    walked = sweep(chain, block.q)
    target = walked.position + np.einsum("cdm,c->dm", walked.rotation, cell.tools[0][:3, 3])
    motions = element_jacobian(chain, walked, target, np.arange(len(chain.elements)))[:, :3]
    return motions * _moments_of_load(chain, block)[:, None]


def _moments_of_load(chain: Chain, block: PoseMeasurements) -> np.ndarray:
    """Return the moments (K, m) [N m] of a block's load alone about the axes of all elements."""
    light = replace(chain, inertias=np.zeros((chain.n, 10)))
    return gravity_moments(light, block.q, block.load)


def _compliance(cell: Installation) -> tuple[np.ndarray, bool]:
    """Return the compliance (K,) of each element [rad/N m], and whether it is only its prior standard deviation."""
    chain = cell.chain
    table = {name: k for k, name in enumerate(chain.names)}
    compliance = np.zeros(len(chain.elements))
    merged = cell.merged().deflection
    for term, coefficient in zip(merged.terms, np.asarray(merged.coefficients)):
        if term.basis in BY_TORQUE:
            compliance[table[term.element]] += coefficient
    if compliance.any():
        return compliance, False
    return usual_compliance(chain), True


def usual_compliance(chain: Chain) -> np.ndarray:
    """Return the prior standard deviation (K,) of each element's compliance [rad/N m]; 0 where none is fitted.

    Args:
        chain: the arm, with the largest torques of its joints where they are stated.
    """
    compliance = np.zeros(len(chain.elements))
    usual = USUAL_EFFORT * chain.stretched_length() ** 2
    for number, element in enumerate(chain.elements):
        if element.axis[0] != "r" or element.owner >= chain.n:
            continue
        effort = chain.joints[element.owner].effort
        if not np.isfinite(effort):
            effort = usual
        compliance[number] = TURN / effort
        if element.joint is None:
            compliance[number] *= 0.5
    return compliance
