"""Motion of the links behind joints with corrections (compliance and other joint errors), for the dynamics.

A geometric fit with joint corrections (`calib.robot.calibrated`) gives the position of the link of joint j relative to
the joint's reading,

    q_link,j = q_j + δ_j(q, τ),    δ_j = Σ_terms c · b(q, τ),

with terms for compliance under the torque τ_j, gear ratio, coupled axes, harmonics and sag. The compliance was fitted
at rest, where τ is the gravity torque. In motion, τ is the complete torque of the bodies: gravity, Coriolis and inertia
(a joint of stiffness 1/c, Spong 1987, with motor and link described by one position signal). It is computed at the
measured motion, with the masses that the fit used for gravity torques, and low-passed to the identification band. δ is
added to the filtered positions; its first and second time derivatives (by differences) are added to v and a. This is
first order in c: the torque that deflects a joint is that of the undeflected arm.

Terms that move other elements than joints (tilting axes, wobble) are ignored in the dynamics. All terms are ignored if
an identification simulates the robot (as rigid), and for rows of power.
"""

from dataclasses import replace

import numpy as np

from calib.data.signals.motion import Motion
from calib.dynamics.bodies import standard_parameters
from calib.dynamics.torque_rows import POWER
from calib.identification.registry import method_named
from calib.identification.rows import Case, segments
from calib.identification.settings import IdentificationSettings, make_model
from calib.robot.calibrated import CalibratedChain, Deflection, evaluate, target_elements
from calib.robot.chain import Chain


def with_link_motion(robot: CalibratedChain, case: Case, settings: IdentificationSettings) -> Case:
    """Return a case with the motion of its links (`Case.link`) according to the robot's joint corrections.

    Without joint corrections, for rows without bodies, or if the settings ignore them, the case is returned as it is.

    Args:
        robot: the calibrated robot, with or without joint corrections.
        case: the recording, with the motion of the motors.
        settings: settings, which may ignore corrections (`deflections`).
    """
    simulated = settings.loop is not None or method_named(settings.method).needs_simulation
    rows = settings.torque_rows
    rigid = simulated or not settings.deflections or rows == POWER or not rows.has_bodies
    chain = robot.complete
    terms = joint_terms(robot.complete, robot.deflection)
    if rigid or not terms.terms or len(chain.driven) != chain.n:
        return case
    elements = target_elements(chain, terms)
    torque = bodies_torques(terms, case, settings)
    positions = np.zeros((3, *case.motion.q.shape))
    for j, element in enumerate(chain.moving):
        chosen = chosen_terms(terms, elements == element)
        if len(chosen.terms):
            bases = motion_of_bases(chosen, case.motion, torque)
            positions[:, :, j] = np.einsum("e,sen->sn", np.asarray(chosen.coefficients), bases)
    motion = case.motion
    orders = (motion.q, motion.v, motion.a)
    link = tuple(order + displacement for order, displacement in zip(orders, positions))
    return replace(case, link=link)


def joint_terms(chain: Chain, deflection: Deflection) -> Deflection:
    """Return the correction terms that move joints, which the dynamics use; other terms are omitted.

    Args:
        chain: the arm, which shows the elements that joints move.
        deflection: joint corrections of a geometric fit.
    """
    mask = np.isin(target_elements(chain, deflection), chain.moving)
    return chosen_terms(deflection, mask)


def chosen_terms(deflection: Deflection, mask: np.ndarray) -> Deflection:
    terms = tuple(term for term, chosen in zip(deflection.terms, mask) if chosen)
    coefficients = np.asarray(deflection.coefficients)[mask]
    return replace(deflection, terms=terms, coefficients=coefficients)


def bodies_torques(terms: Deflection, case: Case, settings: IdentificationSettings) -> np.ndarray | None:
    """Return the bodies' low-passed torques (N, n) [N m or N] along a case; None if no correction needs them.

    Args:
        terms: correction terms that move joints.
        case: the recording.
        settings: settings of the identification, with payloads and gravity.
    """
    if not any(term.basis == "torque" for term in terms.terms) or terms.reference is None:
        return None
    model = make_model(terms.reference, settings)
    values = np.zeros(10 * model.bodies.count)
    parameters = standard_parameters(terms.reference)
    values[: len(parameters)] = parameters
    for label, payload in settings.payloads.items():
        load = settings.payload_values.get(label, payload.parameters)
        if load is not None:
            first = 10 * model.bodies.labels.index(label)
            values[first : first + 10] = load
    motion = case.motion
    torque = model.transmitted(values, motion.q, motion.v, motion.a, case.carried)
    return motion.in_band(torque)


def motion_of_bases(terms: Deflection, motion: Motion, torque: np.ndarray | None) -> np.ndarray:
    """Return the basis functions b of the terms along a motion, with their first two time derivatives, (3, E, N).

    Args:
        terms: E correction terms.
        motion: motion of the joints.
        torque: (N, n) torques of the bodies [N m or N]; None if no term depends on torque.
    """
    result = np.zeros((3, len(terms.terms), len(motion)))
    result[0] = evaluate(terms, motion.q, torque)
    for start, stop in segments(motion.segment):
        for order in (1, 2) if stop - start > 2 else ():
            previous = result[order - 1, :, start:stop]
            result[order, :, start:stop] = np.gradient(previous, 1.0 / motion.rate, axis=1)
    return result
