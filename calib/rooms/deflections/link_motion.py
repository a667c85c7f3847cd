"""Motion of the links behind joints with corrections, and what the corrections' uncertainty means for the dynamics.

A geometric fit with joint corrections (`calib.robot.calibrated`) says how far the link of joint j is from its reading,

    q_link,j = q_j + δ_j(q, τ),    δ_j = Σ_terms c · b(q, τ),

of compliance under the torque τ_j, gear ratio, coupled axes, harmonics and sag. Compliance was fitted at rest, where τ
is the gravity torque; in motion it is the torque of the bodies, gravity, Coriolis and inertia alike (a joint of
stiffness 1/c, Spong 1987, whose motor and link are both of one position signal), computed at the measured motion from
the masses that the fit's gravity torques were made of, and low-passed to the identification band. δ is added to the
filtered positions; its first and second differences in time are added to v and a. First order in c: the torque that
bends the joint is that of the unbent arm.

Terms that move other elements than joints (tilting axes, wobble) are left out of the dynamics, and so is everything
where an identification simulates the robot, which is rigid there, and for rows of power.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.data.signals.filtering import spread
from calib.data.signals.motion import Motion
from calib.dynamics import rigid_body
from calib.dynamics.bodies import Bodies, standard_parameters
from calib.dynamics.torque_rows import BODIES, POWER
from calib.identification.geometry_uncertainty import STEP, cut, estimate, estimator, pieces, weights
from calib.identification.identify import Identification, common_decimator
from calib.identification.registry import method_named
from calib.identification.rows import Case, segments
from calib.identification.settings import IdentificationSettings, make_model
from calib.robot.calibrated import CalibratedChain, Deflection, evaluate, target_elements
from calib.robot.chain import Chain

# at the full rate; longer recordings are represented by pieces spread over them (our choice)
SAMPLES = 10_000


def with_link_motion(robot: CalibratedChain, case: Case, settings: IdentificationSettings) -> Case:
    """Return a case with its links' motion (`Case.link`) by the robot's joint corrections; unchanged without any."""
    simulated = settings.loop is not None or method_named(settings.method).needs_simulation
    rigid = simulated or not settings.deflections or settings.torque_rows == POWER
    chain = robot.complete
    terms = joint_terms(robot.complete, robot.deflection)
    if rigid or not terms.terms or len(chain.driven) != chain.n:
        return case
    own = target_elements(chain, terms)
    torque = _torques(terms, case, settings)
    moved = np.zeros((3, *case.motion.q.shape))
    for j, place in enumerate(chain.moving):
        chosen = _chosen(terms, own == place)
        if len(chosen.terms):
            bases = _bases(chosen, case.motion, torque)
            moved[:, :, j] = np.einsum("e,sen->sn", np.asarray(chosen.coefficients), bases)
    motion = case.motion
    return replace(case, link=tuple(x + dx for x, dx in zip((motion.q, motion.v, motion.a), moved)))


def joint_terms(chain: Chain, deflection: Deflection) -> Deflection:
    """Return the terms that move joints, which the dynamics follow."""
    return _chosen(deflection, np.isin(target_elements(chain, deflection), chain.moving))


def _chosen(deflection: Deflection, mask: np.ndarray) -> Deflection:
    terms = tuple(term for term, kept in zip(deflection.terms, mask) if kept)
    return replace(deflection, terms=terms, coefficients=np.asarray(deflection.coefficients)[mask])


def _torques(terms: Deflection, case: Case, settings: IdentificationSettings) -> np.ndarray | None:
    """Return the bodies' torques (N, n) along a case in its band [N m or N]; None where no term depends on them."""
    if not any(term.basis == "torque" for term in terms.terms) or terms.reference is None:
        return None
    model = make_model(terms.reference, settings)
    values = np.zeros(10 * model.bodies.count)
    known = standard_parameters(terms.reference)
    values[: len(known)] = known
    for label, stated in settings.payloads.items():
        load = settings.payload_values.get(label, stated.parameters)
        if load is not None:
            first = 10 * model.bodies.labels.index(label)
            values[first : first + 10] = load
    motion = case.motion
    return motion.in_band(model.transmitted(values, motion.q, motion.v, motion.a, case.carried))


def _bases(terms: Deflection, motion: Motion, torque: np.ndarray | None) -> np.ndarray:
    """Return the terms' bases along a motion and their first and second derivatives in time, (3, E, N)."""
    result = np.zeros((3, len(terms.terms), len(motion)))
    result[0] = evaluate(terms, motion.q, torque)
    for start, stop in segments(motion.segment):
        for order in (1, 2) if stop - start > 2 else ():
            result[order, :, start:stop] = np.gradient(result[order - 1, :, start:stop], 1.0 / motion.rate, axis=1)
    return result


def deflection_sensitivity(found: Identification, robot: CalibratedChain, cases: Sequence[Case]) -> np.ndarray:
    """Return the derivative (p, E) of the estimate by the corrections' coefficients, zero for those left out.

        dφ/dc = -(Wᵀ R⁻¹ W)⁻¹ Wᵀ R⁻¹ Σ_s ∂τ/∂s b_s,    s one of q, v, a of the joint, b_s the basis or its derivative

    as in `calib.identification.geometry_uncertainty`, of which the part by the residual is left out: it vanishes with
    the residual.
    """
    terms = robot.deflection
    chain = robot.complete
    settings = found.settings
    where = target_elements(chain, terms)
    how = estimator(found)
    inverse = estimate(how, found.rows)[1]
    decimator = common_decimator(cases, found.settings)
    model = found.dynamics.model
    standard = found.base.to_standard(found.fitted.estimate.values[: found.base.b])[: model.inertial]
    pull = np.zeros((len(inverse), len(terms.terms)))
    seen = 0
    every = -(-sum(len(case.motion) for case in cases) // SAMPLES)
    for rows, case in zip(found.rows, cases):
        torque = _torques(joint_terms(chain, terms), case, settings)
        values = standard * model.carried_columns(case.carried)
        spans = []
        for chosen, span in pieces(case, decimator, every):
            part = cut(rows, chosen)
            white = part.matrix * (weights(how, part) ** 2).reshape(part.present.shape)[:, :, None]
            back = spread(white, decimator, span.stop - span.start)
            spans.append((span, model.torque_rows.fold(back, (BODIES,) * back.shape[2])))
            seen += np.count_nonzero(part.present)
        for j in np.flatnonzero(np.isin(chain.moving, where)):
            own = where == chain.moving[j]
            bases = _bases(_chosen(terms, own), case.motion, torque)
            for span, felt in spans:
                slopes = _torque_slopes(model.bodies, values, [x[span] for x in case.links], int(j))
                pull[:, own] += np.einsum("nip,sni,sen->pe", felt, slopes, bases[:, :, span], optimize=True)
    return -inverse @ pull * (sum(np.count_nonzero(part.present) for part in found.rows) / seen)


def _torque_slopes(bodies: Bodies, values: np.ndarray, states: Sequence[np.ndarray], joint: int) -> np.ndarray:
    """Return ∂τ/∂q_j, ∂τ/∂v_j and ∂τ/∂a_j (3, N, n) of one joint by central differences."""
    result = np.zeros((3, *states[0].shape))
    for order in range(3):
        for sign in (1.0, -1.0):
            moved = [np.array(x) for x in states]
            moved[order][:, joint] += sign * STEP
            result[order] += sign / (2.0 * STEP) * rigid_body.inverse_dynamics(bodies, values, *moved)
    return result
