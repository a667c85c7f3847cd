"""Expected errors under a load with which no pose was fitted: by the doubt of compliance and of the masses."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.data.poses.measurements import PoseMeasurements, Positions
from calib.geometry.installation import Installation
from calib.geometry.model_choice.cross_validation import project_out
from calib.geometry.observation import observe
from calib.geometry.static_torques.gravity_fit import reference_masses
from calib.geometry.weighing import GeometricFit
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
# smallest standard deviation of a reading [m]
MIN_NOISE = 1e-6
# [kg] loads that differ by less are one
SAME_LOAD = 0.05
# prior standard deviation of a deflection by gravity that all loads have in common, in usual ones (our choice)
COMMON = 3.0


def load_masses(blocks: Sequence[PoseMeasurements]) -> tuple[float, ...]:
    """Return the distinct masses [kg] that the arm carried in blocks beyond its masses, rounded; 0 if none is known."""
    masses: set[float] = set()
    for block in blocks:
        if block.load is None:
            masses.add(0.0)
        else:
            masses |= set(np.unique(np.round(block.load[:, 3], 2)).tolist())
    return tuple(sorted(masses))


def unlearnt_share(fit: GeometricFit, measured: Sequence[PoseMeasurements]) -> float:
    """Return the share of a load's usual deflection that rows under several loads leave open to a fit without it.

    The compliances c of the elements have a prior of usual size. With a load's motions L of the target, and motions G
    that do not change with the load (by the mean load, and by the arm's gravity), the residuals are L c + G d + noise,
    up to the parameters of the fit. The share is that of the posterior's rms deflection, its mean included, at the
    fitted poses. Under a single load it is 1.

    Args:
        fit: a fit without compliance by torques.
        measured: the fitted blocks of positions, with the loads that the arm carried.
    """
    cell = fit.cell
    chain = cell.chain
    has_torques = any(term.basis in BY_TORQUE for term in cell.merged().deflection.terms)
    have_loads = all(
        isinstance(block, Positions) and block.base is None and block.load is not None for block in measured
    )
    if has_torques or not have_loads or len(load_masses(measured)) < 2 or len(chain.driven) != chain.n:
        return 1.0
    usual = usual_compliance(chain)
    elements = np.flatnonzero(usual)
    loads = np.concatenate([block.load for block in measured])
    weighed = replace(chain, inertias=reference_masses(chain))
    rows, motions = [], []
    for block, prepared, sigmas in zip(measured, fit.blocks, fit.used_sigmas(), strict=True):
        part = next(part for part in observe(cell, prepared, fit.free) if part.label == "position")
        by_load = load_motions(cell, block)
        by_mean = load_motions(cell, replace(block, load=np.tile(loads.mean(axis=0), (len(block), 1))))
        by_arm = _element_motions(cell, block) * gravity_moments(weighed, block.q, None)[:, None]
        columns = np.concatenate([by_load[elements], COMMON * by_mean[elements], COMMON * by_arm[elements]])
        columns *= np.tile(usual[elements], 3)[:, None, None]
        in_station = np.einsum("ij,kjm->kim", cell.stations[prepared.station][:3, :3], columns)[:, :, part.index]
        stacked = np.concatenate([part.jacobian, in_station, part.value[None]])
        rows.append(stacked.reshape(len(stacked), -1) / max(sigmas["position"], MIN_NOISE))
        motions.append(in_station[: len(elements)].reshape(len(elements), -1))
    matrix = project_out(np.concatenate(rows, axis=1), np.arange(len(fit.free)))[len(fit.free) :]
    columns, residual = matrix[:-1], matrix[-1]
    covariance = np.linalg.inv(np.eye(len(columns)) + columns @ columns.T)
    mean = covariance @ (columns @ residual)
    moments = (covariance + np.outer(mean, mean))[: len(elements), : len(elements)]
    effect = np.concatenate(motions, axis=1)
    square_share = np.sum((moments @ effect) * effect) / max(float(np.sum(effect**2)), 1e-300)
    return float(min(np.sqrt(square_share), 1.0))


def load_variance(
    cell: Installation, block: PoseMeasurements, masses: Sequence[float], mass_doubt: float, unlearnt: float = 1.0
) -> np.ndarray | None:
    """Return the error variance (m,) [m²] of the target's position due to a load with which no pose was fitted.

    With compliance by torques it is the share of the load's deflection that the masses' doubt leaves open; without, the
    deflection by compliance of a usual size. None for a load with which poses were fitted.

    Args:
        cell: the fitted installation.
        block: the rows, with their load.
        masses: masses that the fitted poses carried [kg].
        mass_doubt: standard deviation of the masses by which compliance was fitted, as a share of them.
        unlearnt: share of a usual deflection that is left open without compliance by torques, of `unlearnt_share`.
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
        variance = unlearnt**2 * np.sum(per_element**2, axis=(0, 1))
    else:
        variance = mass_doubt**2 * np.sum(np.sum(per_element, axis=0) ** 2, axis=0)
    return np.where(distance < SAME_LOAD, 0.0, variance)


def load_motions(cell: Installation, block: PoseMeasurements) -> np.ndarray:
    """Return the motion (K, 3, m) [m per rad/(N m)] of the target by a block's load, per compliance of each element.

    Args:
        cell: the installation.
        block: the rows, with their load.
    """
    return _element_motions(cell, block) * _moments_of_load(cell.chain, block)[:, None]


def _element_motions(cell: Installation, block: PoseMeasurements) -> np.ndarray:
    """Return the motion (K, 3, m) [m per unit] of the first target by each element, in the base's frame."""
    chain = cell.chain
    walked = sweep(chain, block.q)
    target = walked.position + np.einsum("cdm,c->dm", walked.rotation, cell.tools[0][:3, 3])
    return element_jacobian(chain, walked, target, np.arange(len(chain.elements)))[:, :3]


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
