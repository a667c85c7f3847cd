"""Torques and loads of blocks of measurements: measured ones, or those of the masses with what the arm carries."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.data.poses.measurements import PoseMeasurements, take
from calib.errors import Finding, finding
from calib.geometry.static_torques.gravity_fit import (
    LEAST_LOAD,
    LOAD_SIGMAS,
    STATED_SHARE,
    GravityFit,
    by_stated_load,
    carried_load,
)
from calib.geometry.static_torques.load_errors import SAME_LOAD, load_masses
from calib.robot.calibrated import Deflection
from calib.robot.chain import Chain
from calib.robot.kinematics import gravity_torques

# share of the arm's mass below which a stated payload is none: arms lift up to half of their mass, of which a
# thousandth is left where kg are read as g (our choice)
LEAST_PAYLOAD_SHARE = 5e-4
# [kg/m²] mass of an arm without described masses over the square of its length: that of the lightest ones (our choice)
LIGHTEST = 10.0
# sources of the torques that drive the compliance
MEASURED, MODELLED = "measured", "modelled"


def gravity_of(chain: Chain, q: np.ndarray, load: np.ndarray | None = None) -> np.ndarray | None:
    """Return gravity torques (m, n) [N m or N] at joint values q (m, n); None if the robot's masses are unknown.

    Args:
        chain: the arm with its masses.
        q: joint values [rad or m].
        load: (m, 4) load of the last body, as of `gravity_torques`; None for no load.
    """
    if chain.inertias is None or len(chain.driven) != chain.n:
        return None
    return gravity_torques(chain, q, load)


def with_stated_load(chain: Chain, block: PoseMeasurements) -> PoseMeasurements:
    """Return a block with the stated load, and the torques by masses and load.

    Args:
        chain: the arm with its masses.
        block: the measurements.
    """
    load = None
    if block.payload is not None:
        load = carried_load(chain, block.payload)
    return replace(block, load=load, torque=gravity_of(chain, block.q, load))


def driven(block: PoseMeasurements, gravity: GravityFit, source: str = MEASURED) -> PoseMeasurements:
    """Return a block with load and torques of an arm whose gravity was fitted.

    Where torques were measured, they tell the load; else it is the stated one. Measured torques of rows in which the
    arm was not at rest are not used.

    Args:
        block: the measurements.
        gravity: the fitted gravity.
        source: `MEASURED` takes measured torques where there are any, `MODELLED` those of masses and load.
    """
    if block.measured_torque is None:
        return with_stated_load(gravity.chain, block)
    loads = np.zeros((len(block), 4))
    for rows in by_stated_load(block):
        load, sigma = gravity.load(take(block, rows))
        if _differs(gravity, load[3], sigma, 0.0):
            loads[rows] = load
    modelled = gravity_torques(gravity.chain, block.q, loads)
    torque = modelled
    if source == MEASURED:
        measured = gravity.balancing(block)
        usable = gravity.agrees(measured - modelled) & np.isfinite(gravity.sigma)
        torque = np.where(usable, measured, modelled)
    return replace(block, load=loads, torque=torque)


def load_findings(block: PoseMeasurements, gravity: GravityFit) -> list[Finding]:
    """Return what the measured torques of a block say of its load, and of rows in which the arm was not at rest.

    Args:
        block: the measurements.
        gravity: the fitted gravity.
    """
    if block.measured_torque is None:
        return []
    findings = []
    for rows in by_stated_load(block):
        findings += _findings_of_load(take(block, rows), gravity)
    return findings


def _findings_of_load(block: PoseMeasurements, gravity: GravityFit) -> list[Finding]:
    """Return the findings of `load_findings` on rows of the same load.

    Args:
        block: the measurements.
        gravity: the fitted gravity.
    """
    name = Path(block.file).name
    load, sigma = gravity.load(block)
    resting = gravity.at_rest(block) | np.isnan(np.asarray(block.measured_torque))
    moving = np.flatnonzero(~np.all(resting, axis=1))
    findings = []
    if len(moving):
        rows = block.rows[moving].tolist()
        findings.append(finding("torques-of-motion", file=name, count=len(moving), rows=rows))
    mass = float(load[3])
    if block.payload is None or np.isnan(block.payload[:, 0]).all():
        if not _differs(gravity, mass, sigma, 0.0):
            return findings
        if mass < 0.0:
            findings.append(finding("payload-missing", file=name, mass=-mass, sigma=sigma))
        else:
            findings.append(finding("payload-found", file=name, mass=mass, sigma=sigma))
        return findings
    stated_mass = float(np.nanmean(block.payload[:, 0]))
    if _differs(gravity, mass, sigma, stated_mass) and abs(mass - stated_mass) > STATED_SHARE * max(stated_mass, mass):
        findings.append(finding("payload-differs", file=name, stated=stated_mass, mass=mass, sigma=sigma))
    return findings


def weightless_payloads(chain: Chain, blocks: Sequence[PoseMeasurements]) -> list[Finding]:
    """Return a finding on each file of which the largest stated payload is too small for the arm to feel it.

    Args:
        chain: the arm with its masses.
        blocks: the measurements.
    """
    arm_mass = LIGHTEST * chain.stretched_length() ** 2
    if chain.inertias is not None and chain.inertias[:, 9].sum() > 0.0:
        arm_mass = float(chain.inertias[:, 9].sum())
    masses: dict[str, float] = {}
    for block in blocks:
        if block.payload is not None:
            mass = float(np.nan_to_num(block.payload[:, 0]).max(initial=0.0))
            masses[block.file] = max(mass, masses.get(block.file, 0.0))
    findings = []
    for file, mass in masses.items():
        if mass > 0.0:
            values = {"mass": mass, "arm_mass": arm_mass, "times": LEAST_PAYLOAD_SHARE * arm_mass / mass}
            findings.append(finding("payload-weightless", file=Path(file).name, **values))
    return findings


def torques_used(
    deflection: Deflection, gravity: GravityFit | None, source: str, by_loads: bool = False
) -> list[Finding]:
    """Return a finding on the source of the torques that drive the compliance; none without compliance by torques.

    Args:
        deflection: the fitted corrections.
        gravity: the fitted gravity; None without measured torques.
        source: `MEASURED` or `MODELLED`.
        by_loads: whether the masses are estimated from the deflection under several stated loads.
    """
    if not deflection.by_torque:
        return []
    if gravity is None:
        origin = "of masses fitted to the deflection under the stated loads" if by_loads else "of the described masses"
        return [finding("torques-used", source=origin, sigma=None, joint=None, worst=None)]
    texts = {
        MEASURED: "as measured, elsewhere of masses fitted to these",
        MODELLED: "of masses fitted to the measured ones",
    }
    sensed = np.where(np.isfinite(gravity.sigma), gravity.sigma, 0.0)
    worst = int(np.argmax(sensed))
    sigma = float(np.sqrt(np.sum(sensed**2) / np.count_nonzero(sensed)))
    joint = gravity.chain.joint_names[worst]
    worst_sigma = float(gravity.sigma[worst])
    return [finding("torques-used", source=texts[source], sigma=sigma, joint=joint, worst=worst_sigma)]


def load_changes(fitted: Sequence[PoseMeasurements], unseen: Sequence[PoseMeasurements]) -> list[Finding]:
    """Return a finding on each block that was measured with another load than all fitted ones.

    Args:
        fitted: the fitted blocks.
        unseen: blocks that were not fitted.
    """
    masses = load_masses(fitted)
    findings = []
    for block in unseen:
        for mass in load_masses([block]):
            nearest = min(masses, key=lambda fitted_mass, mass=mass: abs(fitted_mass - mass), default=mass)
            if abs(mass - nearest) > SAME_LOAD:
                findings.append(finding("load-changed", file=Path(block.file).name, mass=mass, fitted=nearest))
    return findings


def _differs(gravity: GravityFit, mass: float, sigma: float, reference: float) -> bool:
    """Return whether a mass [kg] differs from another one by more than its sigma and more than is worth a word."""
    assert gravity.chain.inertias is not None
    smallest = LEAST_LOAD * float(gravity.chain.inertias[:, 9].sum())
    return abs(mass - reference) > max(LOAD_SIGMAS * sigma, smallest)
