"""Simulated cells: the LWR4+ of the paper, and robots of the library with random geometric errors."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from scipy.spatial.transform import Rotation

from calib.arguments import checked
from calib.config_types import Real
from calib.geometry.installation import Installation
from calib.robot.calibrated import Deflection, Term
from calib.robot.chain import Chain
from calib.robot.kinematics import forward
from calib.robot.library import load
from calib.simulation import lwr4plus
from calib.simulation.cell import Cell, SimulatedInstrument
from calib.simulation.unmodelled import PositionErrors
from calib.transforms import pose

# Orders of the gears' harmonics: periods per turn of the joint.
ORDERS = (2, 3)
CMM = SimulatedInstrument()
NO_ERRORS = PositionErrors()
# Standard deviations of a perturbed arm's lengths [m], angles [rad] and joint offsets [rad] from the nominal arm.
LENGTH = 0.3e-3
ANGLE = 0.5e-3
OFFSET = 3e-3
# Hidden deflections of the LWR4+: compliance [rad/(N m)], amplitude of a harmonic [rad], seed of the phases.
COMPLIANCE = 2e-5
AMPLITUDE = 6e-4
HIDDEN_SEED = 2
# Hidden deflections of a perturbed arm as a share of those of the LWR4+ (our choice).
SHARE = 0.2
# Scale of the hidden deflections where `UNMODELLED` errors are added.
MODELLED = 0.7
# Sizes of the errors that no model describes (our choice).
UNMODELLED = PositionErrors(gear=4e-4, backlash=5e-5, growth=5e-5, droop=5e-5, seed=2)
# A size of planted errors.
NOT_NEGATIVE = Real(least=0.0)


@checked
@dataclass(frozen=True)
class PlantedErrors:
    """Standard deviations and sizes of the errors that are planted in an arm; 0 for none of a kind.

    The defaults are as large as those of real arms (`virtual_cell`).

    Attributes:
        length: σ of each length of the chain [m].
        angle: σ of each angle of the chain [rad].
        offset: σ of each joint's offset [rad, or m for a prismatic joint].
        compliance: compliance of each joint under gravity [rad/(N m)], where the masses are known.
        harmonics: amplitude of each of two harmonics of each joint [rad; 0.3 times that value in m for a prismatic
            joint].
        unmodelled: scale of the errors of position and torque that no model describes (`calib.simulation.unmodelled`);
            1 is our choice for an industrial arm.
        masses: scale of the errors of the nominal masses (8 %), centres of mass (6 mm) and shapes.
    """

    length: Annotated[float, NOT_NEGATIVE] = LENGTH
    angle: Annotated[float, NOT_NEGATIVE] = ANGLE
    offset: Annotated[float, NOT_NEGATIVE] = OFFSET
    compliance: Annotated[float, NOT_NEGATIVE] = SHARE * COMPLIANCE
    harmonics: Annotated[float, NOT_NEGATIVE] = SHARE * AMPLITUDE
    unmodelled: Annotated[float, NOT_NEGATIVE] = 1.0
    masses: Annotated[float, NOT_NEGATIVE] = 1.0


def deflection(chain: Chain, compliance: np.ndarray, amplitude: np.ndarray, seed: int) -> Deflection:
    """Return the joint deflections of a chain: compliance and harmonics of each joint.

    Args:
        chain: the true arm.
        compliance: (n,) [rad/(N m)].
        amplitude: (n,) of each harmonic [rad, or m for a prismatic joint].
        seed: seed of the harmonics' phases.
    """
    rng = np.random.default_rng(seed)
    phases = rng.uniform(0.0, 2.0 * np.pi, (chain.n, len(ORDERS)))
    terms = []
    values = []
    for j, element_index in enumerate(chain.moving):
        name = chain.elements[element_index].name
        terms.append(Term(name, "torque", j))
        values.append(compliance[j])
        for order, phase in zip(ORDERS, phases[j]):
            terms.append(Term(name, "sin", j, order))
            values.append(amplitude[j] * np.cos(phase))

            terms.append(Term(name, "cos", j, order))
            values.append(amplitude[j] * np.sin(phase))
    return Deflection(tuple(terms), np.array(values), chain)


def virtual_cell(robot: str = "lwr4plus", seed: int = 0, instrument: SimulatedInstrument = CMM) -> Cell:
    """Return the simulated cell of a robot: the study's for the LWR4+, otherwise a perturbed one by seed.

    A third of the mean squared position error of the hidden effects (LWR4+: 0.34 of 0.65 mm rms, UR5: 0.08 of 0.13 mm)
    is of kinds that no model of this toolkit describes (`UNMODELLED`). Errors of perturbed arms are as large as those
    of real arms: 0.6 to 2.3 mm rms before and 0.08 to 0.12 mm after calibration for the TX40 of seeds 0 to 9; measured
    were 0.24 to 0.84 mm before and 0.06 to 0.09 mm after for a UR5, a UR10 and a Motoman
    (``examples/real_recordings.md``), and up to 0.65 mm before for an ABB IRB 1600 (Slamani, Nubiola & Bonev 2012).
    """
    if robot == "lwr4plus":
        return lwr4plus_cell(instrument, MODELLED, UNMODELLED)
    unmodelled = industrial(1.0)
    return perturbed_cell(load(robot), seed, instrument, unmodelled=unmodelled)


def industrial(scale: float) -> PositionErrors:
    """Return `UNMODELLED` errors of an industrial arm, whose gears have a fifth of the LWR4+'s, times a scale."""
    return PositionErrors(
        gear=SHARE * UNMODELLED.gear * scale,
        backlash=UNMODELLED.backlash * scale,
        growth=UNMODELLED.growth * scale,
        droop=UNMODELLED.droop * scale,
        seed=UNMODELLED.seed,
    )


def lwr4plus_cell(
    instrument: SimulatedInstrument = CMM, hidden: float = 1.0, unmodelled: PositionErrors = NO_ERRORS
) -> Cell:
    """Return the cell of Kolyubin et al. (2019): the true arm has the calibrated values of their Table 2.

    Hidden deflections (compliance of 20 µrad/(N m) and two harmonics of 0.6 mrad per joint) are sized such that a fit
    of 17 poses under the constraints of Table 1 has about the paper's errors on held-out poses: 0.80 mm and 0.10 deg
    (Table 3).

    Args:
        instrument: the instrument; by default the paper's optical CMM.
        hidden: scale of the hidden deflections; 0 for a rigid arm.
        unmodelled: errors that no model describes.
    """
    _, calibrated = lwr4plus.table_2()
    true = lwr4plus.arm(calibrated)
    compliance = np.full(true.n, hidden * COMPLIANCE)
    amplitude = np.full(true.n, hidden * AMPLITUDE)
    station = lwr4plus.station(calibrated)
    tool = lwr4plus.tool(calibrated)
    hidden_deflection = deflection(true, compliance, amplitude, HIDDEN_SEED)
    truth = Installation(true, station[None], tool[None], deflection=hidden_deflection)
    note = (
        "simulated LWR4+: truth = calibrated column of Table 2 of Kolyubin et al. (2019), plus joint deflections of "
        f"{hidden * COMPLIANCE * 1e6:g} µrad/(N m) and two harmonics of {hidden * AMPLITUDE * 1e3:g} mrad per joint"
        f"{unmodelled.note}"
    )
    return Cell(lwr4plus.nominal_chain(), truth, instrument, note, unmodelled)


def perturbed_cell(
    nominal: Chain,
    seed: int = 0,
    instrument: SimulatedInstrument = CMM,
    *,
    size: float = 1.0,
    hidden: float = SHARE,
    unmodelled: PositionErrors = NO_ERRORS,
) -> Cell:
    """Return a cell whose true arm differs from the nominal arm by normal random errors.

    Args:
        nominal: the arm as it is described.
        seed: seed of the deviations, the placements and the hidden part.
        instrument: the instrument.
        size: scale of the deviations (`LENGTH`, `ANGLE`; `OFFSET` for joint offsets).
        hidden: scale of the hidden deflections, relative to those of the LWR4+.
        unmodelled: errors that no model describes.
    """
    planted = PlantedErrors(size * LENGTH, size * ANGLE, size * OFFSET, hidden * COMPLIANCE, hidden * AMPLITUDE)
    return planted_cell(nominal, seed, instrument, planted, unmodelled)


def planted_cell(
    nominal: Chain, seed: int, instrument: SimulatedInstrument, planted: PlantedErrors, unmodelled: PositionErrors
) -> Cell:
    """Return a cell whose true arm has planted errors.

    Args:
        nominal: the arm as it is described.
        seed: seed of the errors, of the placements of instrument and tool, and of the harmonics' phases.
        instrument: the instrument.
        planted: sizes of the errors.
        unmodelled: errors that no model describes.
    """
    rng = np.random.default_rng(seed)
    true = _perturbed(nominal, rng, planted)
    zero_pose = forward(nominal, np.zeros((1, nominal.n)))[0]
    span = float(np.linalg.norm(zero_pose[:3, 3])) + 0.5
    station = _random_pose(rng, 3.0 * span)
    tool = _random_pose(rng, 0.12)

    compliance = np.full(true.n, planted.compliance)
    amplitude = np.full(true.n, planted.harmonics)
    for j, joint in enumerate(true.joints):
        if joint.kind != "revolute":
            amplitude[j] = 0.3 * planted.harmonics
    hidden_deflection = deflection(true, compliance, amplitude, seed)
    truth = Installation(true, station[None], tool[None], deflection=hidden_deflection)
    note = (
        f"simulated {nominal.name}: errors per element of {planted.length * 1e3:g} mm or {planted.angle * 1e3:g} mrad, "
        f"joint offsets of {planted.offset * 1e3:g} mrad (1 sigma), plus hidden deflections"
        f"{unmodelled.note}"
    )
    return Cell(nominal, truth, instrument, note, unmodelled)


def _perturbed(chain: Chain, rng: np.random.Generator, planted: PlantedErrors) -> Chain:
    """Return the chain with normal random errors in all elements, of the sizes `planted`."""
    sigmas = []
    for element in chain.elements:
        if element.unit == "m":
            sigmas.append(planted.length)
        elif element.joint is not None:
            sigmas.append(planted.offset)
        else:
            sigmas.append(planted.angle)
    errors = np.array(sigmas) * rng.standard_normal(len(sigmas))
    return chain.with_values(chain.values + errors)


def rigid(cell: Cell) -> Cell:
    """Return the cell without hidden deflections and unmodelled errors."""
    zero = np.zeros(len(cell.truth.deflection.terms))
    still = cell.truth.deflection.with_coefficients(zero)
    truth = replace(cell.truth, deflection=still)
    return replace(cell, truth=truth, unmodelled=NO_ERRORS)


def _random_pose(rng: np.random.Generator, distance: float) -> np.ndarray:
    """Return a pose (4, 4) with random orientation, at a distance [m] from the origin in a random direction."""
    direction = rng.standard_normal(3)
    turn = Rotation.random(rng=rng).as_matrix()
    position = distance * direction / np.linalg.norm(direction)
    return pose(turn, position)
