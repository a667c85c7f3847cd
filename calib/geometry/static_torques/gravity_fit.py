"""Gravity of an arm from the torques that its joints measured at rest: masses, payloads and offsets of the sensors.

    s τ(q) = G(q) (x + x_load) + b + ε

τ are the measured torques of a row, G the gravity regressor by first moments and masses of the bodies, x those of the
arm, x_load those of what a file's rows carry, b an offset of each sensor. s is -1 for sensors that count the load on
the joint, not the torque that balances it. The estimate is the most probable one: x is near the description's masses
(near equal masses in the middle of the links where it has none), b near zero, and the noise ε of each joint is
estimated. The first file's load is the stated one, or none: the arm's masses then include what it carried.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calib.data.poses.measurements import PoseMeasurements, take
from calib.errors import Finding, UsageError, finding, require
from calib.estimation.robust import spread
from calib.geometry.static_torques.column_faults import column_fault
from calib.robot.chain import Chain
from calib.robot.kinematics import forward, gravity_torques, joint_frames

# standard deviation of a mass from the described one, as a share of it, and of a centre of mass [m] (our choice)
MASS_SHARE = 1.0
CENTRE = 0.15
# standard deviation of a sensor's offset, as a share of the joint's largest torque (our choice)
OFFSET = 0.1
# rounds of weighing the joints by their residuals
ROUNDS = 8
# robust sigmas beyond which a row's torque is not that of an arm at rest (our choice)
MAX_RESIDUAL = 6.0
# smallest share of the torques' variation that gravity has to explain (our choice)
MIN_EXPLAINED = 0.7
# [N m] spread of torques below which a sensor read nothing
MIN_SPREAD = 1e-3
# standard deviation of a torque sensor's gain (our choice, as data sheets state it)
GAIN = 0.01
# sigmas of its mass from which on a load is stated, and share of the arm's mass below which it is not worth a word
LOAD_SIGMAS, LEAST_LOAD = 4.0, 0.005
# share of a stated payload by which torques may differ from it
STATED_SHARE = 0.15
# [kg/m²] largest mass of an arm over the square of its length (our choice: four times that of a heavy palletiser)
MAX_MASS = 800.0
# largest payload as a share of the arm's described mass (our choice: arms lift less than their own mass)
MAX_PAYLOAD_SHARE = 3.0
# described gravity is this many times the measured one where torques are in N·mm (our choice)
MILLIMETRES = 200.0
# what is said of torques that are zero, and what to do
ZERO = "they are zero in every row", "is the sensors' signal in other columns?"
# sigmas by which a factor of torques has to exceed what an arm may have (our choice)
FACTOR_SIGMAS = 4.0
# [N² m²] sum of squares below which gravity does not vary
TINY = 1e-12
# what to do about torques that are far too large
IN_MILLIMETRES = "name the columns tau1 [N mm] …"
Fault = tuple[str, str]
"""Why torques are not used, and what to do."""


@dataclass(frozen=True, eq=False)
class GravityFit:
    """Gravity of an arm, fitted to the torques its joints measured at rest.

    Attributes:
        chain: the arm with the fitted masses; single parameters are not right, their torques are.
        sign: 1.0 where the sensors count the torque that balances the load, -1.0 where they count the load.
        offset, sigma: (n,) offset of each sensor, and standard deviation of its torques about the model [N m]; infinite
            for a joint whose torques were not read.
        loads: for each fitted file, its load (4,): first moments [kg m] and mass [kg] in the last body's frame.
        mass_sigmas: for each fitted file, the standard deviation of the load's mass [kg].
        covariance: (5 n, 5 n) of first moments and masses (4 n), and of the sensors' offsets.
    """

    chain: Chain
    sign: float
    offset: np.ndarray
    sigma: np.ndarray
    loads: tuple[np.ndarray, ...] = ()
    mass_sigmas: tuple[float, ...] = ()
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    def balancing(self, block: PoseMeasurements) -> np.ndarray:
        """Return the measured torques (m, n) of a block as those that balance gravity; NaN where none were measured."""
        assert block.measured_torque is not None
        return self.sign * block.measured_torque - self.offset

    def load(self, block: PoseMeasurements) -> tuple[np.ndarray, float]:
        """Return the load (4,) of a block's rows that explains their torques best, and the sigma of its mass [kg]."""
        torque = self.balancing(block) - gravity_torques(self.chain, block.q)
        regressor = gravity_regressor(self.chain, block.q)[..., -4:]
        deviations = load_deviations(self.chain)
        values, covariance = np.zeros(4), np.diag(deviations**2)
        weights = np.isfinite(torque)
        for _ in range(ROUNDS):
            values, covariance = most_probable(regressor, torque, weights / self.sigma, deviations)
            residual = torque - regressor @ values
            weights = np.abs(residual) < MAX_RESIDUAL * np.maximum(spreads(residual), self.sigma)
        return values, _mass_sigma(values, covariance)

    def at_rest(self, block: PoseMeasurements) -> np.ndarray:
        """Return whether each measured torque (m, n) of a block is that of the arm at rest with the block's load."""
        load, _ = self.load(block)
        loads = np.tile(load, (len(block), 1))
        return self.agrees(self.balancing(block) - gravity_torques(self.chain, block.q, loads))

    def agrees(self, residual: np.ndarray) -> np.ndarray:
        """Return whether torques (m, n) were measured, and differ from gravity by no more than those of an arm at rest.

        Args:
            residual: (m, n) measured torques minus those of gravity [N m]; NaN where none was measured.
        """
        return np.asarray(np.abs(residual) < MAX_RESIDUAL * self.sigma)


def by_stated_load(block: PoseMeasurements) -> list[np.ndarray]:
    """Return the rows of a block in groups of the same stated mass, in the order in which these appear."""
    if block.payload is None:
        return [np.arange(len(block))]
    mass = np.nan_to_num(block.payload[:, 0], nan=-1.0)
    _, first, group = np.unique(mass, return_index=True, return_inverse=True)
    return [np.flatnonzero(group == number) for number in np.argsort(first)]


def gravity_regressor(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Return the gravity torques (m, n, 4 n) [N m] per unit of each body's first moments [kg m] and mass [kg].

    Args:
        chain: the arm; its masses do not matter.
        q: (m, n) joint values [rad or m].
    """
    columns = []
    for body in range(chain.n):
        for parameter in range(6, 10):
            unit = np.zeros((chain.n, 10))
            unit[body, parameter] = 1.0
            columns.append(gravity_torques(replace(chain, inertias=unit), q))
    return np.stack(columns, axis=-1)


def carried_load(chain: Chain, payload: np.ndarray) -> np.ndarray:
    """Return payloads (m, 4), mass and centre in the tip's frame, as loads (m, 4) in the last body's frame.

    A centre that is not stated is the tip.

    Args:
        chain: the arm.
        payload: mass [kg] and centre of mass [m]; NaN where not stated.

    Raises:
        UsageError: a centre or a mass that this arm cannot carry, as of another unit.
    """
    _check_payload(chain, payload)
    zero = np.zeros((1, chain.n))
    flange = np.linalg.inv(joint_frames(chain, zero)[-1, 0]) @ forward(chain, zero)[0]
    mass = np.nan_to_num(payload[:, 0])
    centre = np.nan_to_num(payload[:, 1:]) @ flange[:3, :3].T + flange[:3, 3]
    return np.column_stack([mass[:, None] * centre, mass])


def _check_payload(chain: Chain, payload: np.ndarray) -> None:
    """Raise a UsageError for payloads (m, 4) whose centre is beyond the arm's reach, or which are too heavy for it."""
    reach = chain.stretched_length() + _travel(chain)
    distance = float(np.linalg.norm(np.nan_to_num(payload[:, 1:]), axis=1).max(initial=0.0))
    message = f"payload: its centre is {distance:.3g} m from the tip, the arm reaches {reach:.3g} m; state it in m"
    require(distance <= reach, message, UsageError)
    mass = float(np.nan_to_num(payload[:, 0]).max(initial=0.0))
    limit = MAX_MASS * reach**2
    if chain.inertias is not None and chain.inertias[:, 9].sum() > 0.0:
        limit = MAX_PAYLOAD_SHARE * float(chain.inertias[:, 9].sum())
    message = f"payload of {mass:.4g} kg: more than such an arm carries ({limit:.3g} kg at most); state it in kg"
    require(mass <= limit, message, UsageError)


def _travel(chain: Chain) -> float:
    """Return the sum of the farthest travels of an arm's prismatic joints [m], 1 m for a joint without limits."""
    farthest = np.max(np.abs(chain.sampling_limits()), axis=0)
    prismatic = [joint.kind == "prismatic" for joint in chain.joints]
    return float(farthest[prismatic].sum())


def payload_load(chain: Chain, payload: float | Sequence[float] | None) -> np.ndarray | None:
    """Return a payload as a load (4,) of the last body; None for no payload.

    Args:
        chain: the arm.
        payload: mass [kg], or mass and centre of mass x, y, z in the tip's frame [m]; by default the centre is the
            tip.

    Raises:
        UsageError: other numbers than these, or a negative mass.
    """
    if payload is None:
        return None
    expected = f"payload {payload}: expected a mass [kg], or mass,x,y,z [kg, m]"
    try:
        values = np.atleast_1d(np.asarray(payload, dtype=float))
    except (TypeError, ValueError):
        raise UsageError(expected) from None
    valid = values.shape in ((1,), (4,)) and np.isfinite(values).all() and values[0] >= 0.0
    require(valid, expected, UsageError)
    complete = np.concatenate([values, np.full(4 - len(values), np.nan)])
    return carried_load(chain, complete[None])[0]


def reference_masses(chain: Chain) -> np.ndarray:
    """Return the described standard parameters (n, 10); without masses 1 kg in the middle between successive joints."""
    if chain.inertias is not None and chain.inertias[:, 9].sum() > 0.0:
        return np.array(chain.inertias)
    zero = np.zeros((1, chain.n))
    frames = joint_frames(chain, zero)[:, 0]
    ends = np.concatenate([frames[1:, :3, 3], forward(chain, zero)[:, :3, 3]])
    result = np.zeros((chain.n, 10))
    for body, (frame, end) in enumerate(zip(frames, ends)):
        result[body, 6:9] = 0.5 * frame[:3, :3].T @ (end - frame[:3, 3])
        result[body, 9] = 1.0
    return result


def gravity_fit(chain: Chain, blocks: Sequence[PoseMeasurements]) -> tuple[GravityFit | None, list[Finding]]:
    """Return the gravity of an arm from the torques measured in blocks, and findings on these torques.

    The result is None where no block has torques, or where gravity does not explain them.

    Args:
        chain: the arm, with its described masses if they are known.
        blocks: the blocks of measurements.
    """
    measured = []
    for block in blocks:
        if block.measured_torque is not None:
            measured += [take(block, rows) for rows in by_stated_load(block)]
    if not measured or len(chain.driven) != chain.n:
        return None, []
    torques = [np.asarray(block.measured_torque) for block in measured]
    torque = np.concatenate(torques)
    fit = None
    fault = nothing_read(torque)
    if fault is None:
        if rows_with_torques(torque) < chain.n:
            return None, []
        described = reference_masses(chain)
        regressor = np.concatenate([gravity_regressor(chain, block.q) for block in measured])
        factor, fault = _factor_and_fault(chain, described, regressor, torque)
    if fault is None:
        sign = float(np.sign(factor)) or 1.0
        fit = _fitted(chain, measured, regressor, sign, abs(factor) * described[:, 6:])
        fault = _unlike_gravity(fit, measured)
    if fault is None:
        return fit, []
    reason, cure = fault
    files = sorted({block.file for block in measured})
    return None, [finding("torques-unused", files=files, reason=reason, cure=cure)]


def fault_of_file(chain: Chain, block: PoseMeasurements) -> Fault | None:
    """Return why torques of a file contradict each other, or any gravity, and what to do; None if they do not.

    Args:
        chain: the arm, with its described masses if they are known.
        block: the measurements of one file, with torques.
    """
    torque = np.asarray(block.measured_torque)
    fault = nothing_read(torque)
    if fault is not None or rows_with_torques(torque) < chain.n:
        return fault
    described = reference_masses(chain)
    regressor = gravity_regressor(chain, block.q)
    _, fault = _factor_and_fault(chain, described, regressor, torque)
    return fault


def _factor_and_fault(
    chain: Chain, described: np.ndarray, regressor: np.ndarray, torque: np.ndarray
) -> tuple[float, Fault | None]:
    """Return the factor of torques (m, n) over the described gravity, and why they are not those of an arm if so.

    Args:
        chain: the arm.
        described: (n, 10) described standard parameters, as of `reference_masses`.
        regressor: (m, n, 4 n) gravity regressor of the rows.
        torque: measured torques [N m]; NaN where none was read.
    """
    finite = np.isfinite(torque)
    factor, sigma = gravity_factor(regressor @ described[:, 6:].ravel(), torque)
    fault = _too_large(chain, described, factor, sigma)
    if fault is None:
        fault = column_fault(regressor, np.where(finite, torque, 0.0), finite)
    return factor, fault


def rows_with_torques(torque: np.ndarray) -> int:
    """Return in how many rows of torques (m, n) any was read."""
    return int(np.isfinite(torque).any(axis=1).sum())


def nothing_read(torque: np.ndarray) -> Fault | None:
    """Return that torques (m, n) are zero or empty, and what to do; None where a sensor read something."""
    finite = np.isfinite(torque)
    if np.max(np.abs(torque), initial=0.0, where=finite) >= MIN_SPREAD:
        return None
    if finite.any():
        return ZERO
    return "their columns are empty", ZERO[1]


def _too_large(chain: Chain, described: np.ndarray, factor: float, sigma: float) -> Fault | None:
    """Return that torques are far too large for an arm, and what to do; None where they may be right.

    Args:
        chain: the arm.
        described: (n, 10) described standard parameters, as of `reference_masses`.
        factor, sigma: torques over the gravity of these, and its standard deviation.
    """
    if chain.inertias is not None:
        fault = millimetre_fault(factor, sigma, "the described masses")
        if fault is not None:
            return fault
    described_mass = float(described[:, 9].sum())
    if _least_factor(factor, sigma) * described_mass > MAX_MASS * chain.stretched_length() ** 2:
        mass = abs(factor) * described_mass
        reason = f"they are the gravity of an arm of {mass:.0f} kg, which is too heavy for its length"
        return reason, IN_MILLIMETRES
    return None


def millimetre_fault(factor: float, sigma: float, reference: str) -> Fault | None:
    """Return that torques are in N mm, and what to do; None where they may be in N m.

    Args:
        factor, sigma: torques over the gravity of a reference, and its standard deviation.
        reference: what this gravity is of.
    """
    if _least_factor(factor, sigma) <= MILLIMETRES:
        return None
    return f"they are {abs(factor):.0f} times the gravity of {reference}", IN_MILLIMETRES


def _least_factor(factor: float, sigma: float) -> float:
    """Return the smallest size that a factor of torques may have by its standard deviation."""
    return abs(factor) - FACTOR_SIGMAS * sigma


def _unlike_gravity(fit: GravityFit, measured: Sequence[PoseMeasurements]) -> Fault | None:
    """Return that gravity explains too little of the measured torques, and what to ask; None where it explains them."""
    explained = 1.0 - _unexplained(fit, measured)
    if explained >= MIN_EXPLAINED:
        return None
    reason = f"gravity explains {100.0 * explained:.0f} % of their variation only"
    cure = "were they read at rest, by sensors at the joints (not currents)? Are they of this arm, in its joint order?"
    return reason, cure


def gravity_factor(expected: np.ndarray, torque: np.ndarray) -> tuple[float, float]:
    """Return the factor by which expected torques explain the variation of measured ones, and its standard deviation.

    Args:
        expected: (m, n) torques of gravity.
        torque: (m, n) measured torques; NaN where none was read.
    """
    expected_variation = _variation(np.where(np.isfinite(torque), expected, np.nan))
    variation = _variation(torque)
    squares = max(float(np.sum(expected_variation**2)), TINY)
    factor = float(np.sum(expected_variation * variation)) / squares
    residual = variation - factor * expected_variation
    variance = float(np.sum(residual**2)) / max(int(np.isfinite(torque).sum()), 1)
    return factor, float(np.sqrt(variance / squares))


def _variation(torque: np.ndarray) -> np.ndarray:
    """Return torques (m, n) minus the mean of their column; 0 where they are NaN."""
    finite = np.isfinite(torque)
    values = np.where(finite, torque, 0.0)
    mean = values.sum(axis=0) / np.maximum(finite.sum(axis=0), 1)
    return np.where(finite, values - mean, 0.0)


def _unexplained(fit: GravityFit, measured: Sequence[PoseMeasurements]) -> float:
    """Return the share of the torques' rms variation that the fitted gravity does not explain."""
    errors, sizes = [], []
    for block, load in zip(measured, fit.loads):
        torque = fit.balancing(block)
        loads = np.tile(load, (len(block), 1))
        errors.append(torque - gravity_torques(fit.chain, block.q, loads))
        sizes.append(torque)
    torque = np.concatenate(sizes)
    residual = np.concatenate(errors)
    return float(np.sqrt(np.nansum(residual**2) / max(float(np.sum(_variation(torque) ** 2)), TINY)))


def load_deviations(chain: Chain) -> np.ndarray:
    """Return the prior standard deviations (4,) of a load: first moments [kg m] and mass [kg], as for the whole arm."""
    mass = float(reference_masses(chain)[:, 9].sum())
    lever = CENTRE + float(np.linalg.norm(chain.tail[:3, 3]))
    return np.array([lever * mass, lever * mass, lever * mass, mass])


def _fitted(
    chain: Chain, measured: Sequence[PoseMeasurements], regressor: np.ndarray, sign: float, prior: np.ndarray
) -> GravityFit:
    """Return the most probable gravity.

    Args:
        chain: the arm.
        measured: blocks with measured torques.
        regressor: (m, n, 4 n) gravity regressor of all their rows.
        sign: sign of the sensors.
        prior: (n, 4) first moments and masses about which the prior is.
    """
    n = chain.n
    torque = sign * np.concatenate([np.asarray(block.measured_torque) for block in measured])
    finite = np.isfinite(torque)
    torque = torque - regressor @ prior.ravel()
    loads = [np.zeros(4) for _ in measured]
    columns = [regressor, np.tile(np.eye(n), (len(torque), 1, 1))]
    masses = np.maximum(prior[:, 3], 1e-3 * prior[:, 3].max())
    deviations = np.column_stack([*[masses * CENTRE] * 3, masses * MASS_SHARE]).ravel()
    largest = np.max(np.abs(np.where(finite, torque, 0.0)), axis=0)
    deviations = np.concatenate([deviations, np.maximum(OFFSET * largest, MIN_SPREAD)])
    first = 0
    of_load_prior = load_deviations(replace(chain, inertias=_with_parameters(chain, prior)))
    for number, block in enumerate(measured):
        rows = np.arange(first, first + len(block))
        first += len(block)
        if number == 0:
            if block.payload is not None:
                loads[0] = carried_load(chain, block.payload).mean(axis=0)
                torque[rows] -= regressor[rows][..., -4:] @ loads[0]
            continue
        of_load = np.zeros((len(torque), n, 4))
        of_load[rows] = regressor[rows][..., -4:]
        columns.append(of_load)
        deviations = np.concatenate([deviations, of_load_prior])
    matrix = np.concatenate(columns, axis=2)
    squares = _variation(np.where(finite, torque, np.nan)) ** 2
    sigma = np.maximum(np.sqrt(squares.sum(axis=0) / np.maximum(finite.sum(axis=0), 1)), MIN_SPREAD)
    values, covariance = np.zeros(matrix.shape[2]), np.eye(matrix.shape[2])
    weights = finite.astype(float)
    for _ in range(ROUNDS):
        values, covariance = most_probable(matrix, torque, weights / sigma, deviations)
        residual = np.where(finite, torque - matrix @ values, np.nan)
        sigma = np.where(finite.any(axis=0), np.maximum(spreads(residual), MIN_SPREAD), np.inf)
        weights = (np.abs(residual) < MAX_RESIDUAL * sigma).astype(float)
    masses = prior + values[: 4 * n].reshape(n, 4)
    sigmas = [0.0]
    for number in range(1, len(measured)):
        start = 5 * n + 4 * (number - 1)
        loads[number] = values[start : start + 4]
        sigmas.append(_mass_sigma(loads[number], covariance[start : start + 4, start : start + 4]))
    fitted = replace(chain, inertias=_with_parameters(chain, masses))
    offsets = values[4 * n : 5 * n]
    of_gravity = covariance[: 5 * n, : 5 * n]
    return GravityFit(fitted, sign, offsets, sigma, tuple(loads), tuple(sigmas), of_gravity)


def spreads(residual: np.ndarray) -> np.ndarray:
    """Return the robust standard deviation (n,) of each joint's residuals (m, n); NaN are left out."""
    deviations = [spread(column[np.isfinite(column)]) for column in residual.T]
    return np.array(deviations)


def _with_parameters(chain: Chain, parameters: np.ndarray) -> np.ndarray:
    """Return the chain's standard parameters (n, 10) with other first moments and masses (n, 4)."""
    result = np.zeros((chain.n, 10))
    if chain.inertias is not None:
        result = np.array(chain.inertias)
    result[:, 6:] = parameters
    return result


def most_probable(
    matrix: np.ndarray, torque: np.ndarray, weights: np.ndarray, deviations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the most probable parameters (p,) and their covariance (p, p).

    Args:
        matrix: (m, n, p) regressor.
        torque: (m, n) torques [N m]; of no effect where a weight is 0.
        weights: (m, n) reciprocal standard deviations of the torques, 0 for a torque that is not used.
        deviations: (p,) standard deviations of the prior about zero.
    """
    weighting = np.broadcast_to(weights, torque.shape)
    W = (matrix * weighting[..., None] * deviations).reshape(-1, matrix.shape[2])
    y = (np.where(weighting > 0.0, torque, 0.0) * weighting).ravel()
    inverse = np.linalg.inv(W.T @ W + np.eye(W.shape[1]))
    return deviations * (inverse @ (W.T @ y)), inverse * np.outer(deviations, deviations)


def _mass_sigma(load: np.ndarray, covariance: np.ndarray) -> float:
    """Return the standard deviation of a load's mass [kg], with that of the sensors' gain."""
    return float(np.hypot(np.sqrt(covariance[3, 3]), GAIN * load[3]))
