"""Gravity model of standing poses: base parameters of gravity, friction at rest, payloads, with their covariance."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.dynamics import base as base_parameters
from calib.dynamics import drives
from calib.dynamics.base import Base
from calib.dynamics.bodies import standard_parameters
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.regressor_model import States
from calib.errors import MeasurementError, UsageError
from calib.identification.identify_options import IdentifyOptions
from calib.identification.settings import make_bodies
from calib.procedure.dynamic_stage.standing.recorded_poses import HELD_OUT, StandingPoses
from calib.robot.chain import Chain
from calib.robot.formats import urdf_write

# least rows of torques per base parameter
ROWS = 2.0


# prior deviations by which what the poses do not tell is divided: share of a mass, and first moment per mass [m]
MASS_SHARE, MOMENT = 0.3, 0.1


# [kg] mass that counts for a body without mass
LEAST_MASS = 0.05


# rounds of weighing the joints by their residuals
ROUNDS = 10


# smallest part of a payload parameter that the base parameters do not contain
EXACT = 1e-8


# identified masses below this share of the described ones are not believed: then only first moments change
LEAST_SHARE = 0.3


@dataclass(frozen=True, eq=False)
class GravityModel:
    """Gravity of an arm, identified from standing poses.

    Attributes:
        chain: the arm as described.
        model: its bodies and payloads, and an offset of each torque.
        base: base parameters of the gravity regressor, of which `values` are those identified.
        values, covariance: (b,) base parameters, (b, b) their covariance.
        friction: (n,) band of the friction at rest [N m or N], ± this, with its sign where it was estimated; (n,) its
            sigma where it was estimated, else NaN.
        rows: torques per parameter.
        reference: (p,) standard parameters of the description; zero where it has no masses.
    """

    chain: Chain
    model: IdentificationModel
    base: Base
    values: np.ndarray
    covariance: np.ndarray
    friction: tuple[np.ndarray, np.ndarray]
    reference: np.ndarray
    rows: float = np.inf

    def held(self, poses: StandingPoses) -> np.ndarray:
        """Return the friction (N, n) that holds joints of known approach; zero where it is unknown."""
        if poses.approach is None:
            return np.zeros(poses.q.shape)
        band, sigma = self.friction
        return poses.approach * np.where(np.isnan(sigma), 0.0, band)

    def torque(self, poses: StandingPoses) -> np.ndarray:
        """Return the gravity torques (N, n) at poses, offsets included."""
        return gravity_regressor(self.model, poses)[..., self.base.kept] @ self.values

    def described(self, poses: StandingPoses) -> np.ndarray:
        """Return the gravity torques (N, n) of the description."""
        return gravity_regressor(self.model, poses) @ self.reference

    @property
    def standard(self) -> np.ndarray:
        """Standard parameters (p,) nearest to the description's that have the identified base parameters."""
        estimate = self._nearest(MASS_SHARE)
        count = 10 * self.chain.n
        described, masses = self.reference[9:count:10], estimate[9:count:10]
        if np.any(masses < LEAST_SHARE * described):
            return self._nearest(0.0)
        return estimate

    def _nearest(self, mass_share: float) -> np.ndarray:
        """Return the nearest standard parameters, if masses may deviate by this share of the description's."""
        deviations = np.zeros(len(self.reference))
        count = self.model.inertial
        bodies = self.reference[:count].reshape(-1, 10)
        sizes = np.maximum(bodies[:, 9], LEAST_MASS)
        deviations[:count].reshape(-1, 10)[:, 6:9] = MOMENT * sizes[:, None]
        deviations[:count].reshape(-1, 10)[:, 9] = mass_share * sizes
        deviations[count:] = sizes.mean()
        transform = self.base.transform
        scaled = transform * deviations
        step = np.linalg.lstsq(scaled, self.values - transform @ self.reference, rcond=None)[0]
        return self.reference + deviations * step

    @property
    def bodies(self) -> np.ndarray:
        """Standard parameters (n, 10) of the arm's bodies; moments about the centres of mass are the description's."""
        count = self.chain.n
        estimate = self.standard[: 10 * count].reshape(-1, 10)
        reference = self.reference[: 10 * count].reshape(-1, 10)
        return np.array(list(map(with_centre, reference, estimate)))

    def payload(self, label: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Return first moments and mass (4,) of a payload in the tip's frame, and their covariance (4, 4).

        None where the poses do not determine them.
        """
        first = 10 * self.model.bodies.labels.index(label)
        selection = np.zeros((4, len(self.reference)))
        selection[np.arange(4), first + np.arange(6, 10)] = 1.0
        transform = self.base.transform
        combination = np.linalg.lstsq(transform.T, selection.T, rcond=None)[0].T
        if np.abs(combination @ transform - selection).max() > EXACT:
            return None
        return combination @ self.values, combination @ self.covariance @ combination.T


def with_centre(reference: np.ndarray, estimate: np.ndarray) -> np.ndarray:
    """Return a body (10,) with the mass and first moments found, and the reference's moments about the centre."""
    _, _, moments = urdf_write.centred(reference)
    body = np.concatenate([np.zeros(6), estimate[6:10]])
    _, _, steiner = urdf_write.centred(body)
    return np.concatenate([moments - steiner, estimate[6:10]])


def stacked_torques(poses: Sequence[StandingPoses]) -> np.ndarray:
    """Return the torques (N, n) of the poses of all files."""
    return np.concatenate([block.torque for block in poses])


def gravity_regressor(model: IdentificationModel, poses: StandingPoses) -> np.ndarray:
    zero = np.zeros(poses.q.shape)
    return model.regressor(poses.q, zero, zero, carried=poses.carried)


def fitted(chain: Chain, options: IdentifyOptions, poses: Sequence[StandingPoses], held_out: int = 0) -> GravityModel:
    """Return the gravity model of an arm, fitted to standing poses by weighted least squares.

    Args:
        chain: the arm.
        options: options with gravity and payloads.
        poses: the poses of each file.
        held_out: number of poses of these files that are held out.

    Raises:
        MeasurementError: too few poses for the parameters.
    """
    if len(chain.driven) != chain.n:
        raise UsageError(
            f"robot '{chain.name}' has mimic joints: their gravity at rest is not identified; use a motion"
        )
    linear = [joint.kind == "prismatic" for joint in chain.joints]
    offsets = drives.standard(["off"] * chain.n, linear=linear)
    model = IdentificationModel(make_bodies(chain, options.settings), offsets)
    loads = carried_loads(poses)
    q = np.concatenate([block.q for block in poses])
    zero = np.zeros(q.shape)
    base = base_parameters.find(model, States(q, zero, zero), loads)
    columns, torques, approaches = [], [], []
    for block in poses:
        columns.append(gravity_regressor(model, block)[..., base.kept])
        torques.append(block.torque)
        if block.approach is not None:
            approaches.append(block.approach)
    W = np.concatenate(columns)
    torque = np.concatenate(torques)
    count, n = torque.shape
    if W.shape[0] * n < ROWS * base.b:
        needed = np.ceil(ROWS * base.b / n)
        measured = f"{count} standing poses"
        if held_out:
            needed = np.ceil(needed / (1.0 - HELD_OUT))
            measured = f"{count + held_out} standing poses, {held_out} of them held out,"
        raise MeasurementError(
            f"{measured} for {base.b} parameters of gravity and offsets: measure at least {needed:.0f}, spread over "
            "the joints' ranges",
            poses[0].name,
        )
    sided = np.zeros(n, dtype=bool)
    if len(approaches) == len(poses):
        approach = np.concatenate(approaches)
        sided = (approach > 0.0).any(axis=0) & (approach < 0.0).any(axis=0)
        W = np.concatenate([W, (approach[:, :, None] * np.eye(n))[..., sided]], axis=2)
    values, covariance, residual, sigma = least_squares_of(W, torque)
    band = np.maximum(np.quantile(np.abs(residual), 0.95, axis=0), sigma)
    deviation = np.full(n, np.nan)
    band[sided] = values[base.b :]
    deviation[sided] = np.sqrt(np.diag(covariance))[base.b :]
    friction = band, deviation
    per_parameter = count * n / W.shape[2]
    reference = np.zeros(model.p)
    if chain.inertias is not None:
        arm = standard_parameters(chain)
        reference[: len(arm)] = arm
    parameters = covariance[: base.b, : base.b]
    return GravityModel(chain, model, base, values[: base.b], parameters, friction, reference, per_parameter)


def carried_loads(blocks: Sequence[StandingPoses]) -> tuple[tuple[str, ...], ...]:
    """Return the distinct sets of payloads with which the poses were measured."""
    return tuple(dict.fromkeys(block.carried for block in blocks))


def least_squares_of(W: np.ndarray, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return estimate (b,), covariance (b, b), residuals (N, n) and their sigma (n,), which weighs the joints.

    A joint's degrees of freedom are its rows less their leverage. Its residual at equal weights counts as one more row:
    few rows cannot give a joint a weight that leaves it no residual.

    Args:
        W: (N, n, b) regressor.
        torque: (N, n) torques.
    """
    count, n, b = W.shape
    sigma = np.ones(n)
    sizes = np.maximum(np.linalg.norm(W.reshape(-1, b), axis=0), 1e-12)
    values, residual = np.zeros(b), torque
    inverse = np.zeros((b, count * n))
    before = None
    for _ in range(ROUNDS):
        weighted = (W / sizes / sigma[:, None]).reshape(-1, b)
        inverse = np.linalg.pinv(weighted)
        values = inverse @ (torque / sigma).ravel() / sizes
        residual = torque - W @ values
        leverage = np.sum(weighted * inverse.T, axis=1).reshape(count, n)
        degrees = np.sum(1.0 - leverage, axis=0).clip(min=0.0)
        squares = np.sum(residual**2, axis=0)
        if before is None:
            before = squares / np.maximum(degrees, 1.0)
        sigma = np.maximum(np.sqrt((squares + before) / (degrees + 1.0)), 1e-6)
    covariance = inverse @ inverse.T / np.outer(sizes, sizes)
    return values, covariance, residual, sigma


def varying_part(torque: np.ndarray) -> np.ndarray:
    """Return torques (N, n) without the mean of each joint, as a vector."""
    return (torque - torque.mean(axis=0)).ravel()


def centre_of(values: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a payload's centre of mass (3,) [m] and its sigma (3,), from first moments and mass (4,)."""
    mass = values[3]
    centre = values[:3] / mass
    slopes = np.hstack([np.eye(3), -centre[:, None]]) / mass
    return centre, np.sqrt(np.diag(slopes @ covariance @ slopes.T))
