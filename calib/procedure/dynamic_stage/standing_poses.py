"""Gravity from torques at rest: ``calib identify ROBOT poses.csv --out gravity``.

A file with one row per standing pose (joints and torques, no stamps), or a log that stands at its poses, shows gravity
and nothing else of the dynamics. What standing poses determine are the base parameters of the gravity regressor (first
moments and masses), and a payload's mass and centre where one file is with it and one without::

    [payload.tool]
    [files."loaded.csv"]
    payload = ["tool"]

Friction holds a standing joint within ±Fs of its gravity torque. Without columns ``approach1`` … ``approachn`` (+1
where the joint moved upwards before it stood, -1 downwards, 0 unknown) only a band is known, which contains 95 % of the
residuals; with them, Fs is estimated. Inertias and friction in motion are not identified: those of the description
stay.

The model is judged on the poses of ``--validate``, or on a quarter of the poses that it is not fitted to.

Source: W. Khalil and E. Dombre (2002), Modeling, Identification and Control of Robots, sections 9.4 and 12.3.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from calib import files
from calib.data.csv_table import read_header, read_table
from calib.data.recordings.recording import Recording
from calib.data.recordings.recording_files import read_at_rest
from calib.data.schema import refuse
from calib.dynamics import base as base_parameters
from calib.dynamics import drives
from calib.dynamics.base import Base
from calib.dynamics.bodies import standard_parameters, with_payload
from calib.dynamics.idim import IdentificationModel
from calib.dynamics.regressor_model import States
from calib.errors import MeasurementError, UsageError, listing
from calib.folders import GRAVITY_SUMMARY
from calib.identification.identify_options import IdentifyOptions, read_options
from calib.identification.settings import make_bodies
from calib.procedure.findings import Verdict
from calib.procedure.kinematic_stage.folder import URDF
from calib.procedure.robot_kinds import joints_of
from calib.robot.chain import Chain
from calib.robot.formats import urdf, urdf_write
from calib.robot.formats.urdf_tree import is_urdf
from calib.robot.formats.urdf_tree import read as read_tree
from calib.robot.formats.urdf_tree import text as description_text
from calib.robot.library import load_calibrated, resolve
from calib.units import motion_units

# suffixes of tables
TABLES = (".csv", ".txt", ".tsv", ".dat")
# [bytes] a larger log is not searched for standing poses
MAX_BYTES = 50_000_000
# [rad or m], [s] a joint stands where it moves by less for longer; share of the rows that stand in a standing log
STILL, STANDING, SHARE = 1e-3, 0.5, 0.95
# of a table without stamps: more rows than this, with steps of less than this share of their spread, are a motion
MAX_POSES, SMOOTH = 200, 0.05
# [rad/s or m/s] a standing joint has no larger velocity
MAX_SPEED = 0.01
# [rad or m] poses that differ by less are one, fitted or held out together
SAME = 0.02
# share of the poses that is held out where no file is
HELD_OUT = 0.25
# least rows of torques per base parameter
ROWS = 2.0
# rows of torques per parameter, and held-out poses, below which nothing passes: errors of so few tell little
FEW_ROWS, FEW_HELD_OUT = 4.0, 5
# F of four load parameters of one file, and sigmas of the mass, from which on an undeclared load is stated
LOAD_F, LOAD_SIGMAS = 10.0, 5.0
# label of a load that the options do not declare
UNDECLARED = "undeclared"
# sigmas below zero from which on friction is called negative
NEGATIVE = 3.0
# unexplained share of the torques' variation up to which a model passes, and above which it fails (those of motion)
PASS, FAIL = 0.10, 0.30
# prior deviations by which what the poses do not tell is divided: share of a mass, and first moment per mass [m]
MASS_SHARE, MOMENT = 0.3, 0.1
# [kg] mass that counts for a body without mass
LEAST_MASS = 0.05
# rounds of weighing the joints by their residuals
ROUNDS = 10
# smallest part of a payload parameter that the base parameters do not contain
EXACT = 1e-8
# smallest cosine between stated gravity and the direction that explains the torques best with the described masses
ALIKE = 0.9
# residual with that direction over the one with the stated gravity, from which on it is believed
BETTER = 0.7
# unexplained share of the training's torques up to which a cause is named, friction within its band included
EXPLAINED = 0.35
# cosine to an axis of the base from which on gravity is taken to be along it
SNAP = 0.985
# torques that hold less than this share of the described masses' gravity hold none
ABSENT = 0.1
# identified masses below this share of the described ones are not believed: then only first moments change
LEAST_SHARE = 0.3
NAMES = (URDF, "gravity.csv", "friction_at_rest.csv", "payload.csv", GRAVITY_SUMMARY)
README = """\
Gravity identified from standing poses.

robot.urdf            the description with masses and centres of mass that give the identified gravity torques
gravity.csv           base parameters of the gravity regressor, with sigma
friction_at_rest.csv  per joint: band of the friction that holds it
payload.csv           mass and centre of payloads in the tip's frame

Use robot.urdf for gravity compensation, payload checks and collision detection at rest. Inertias about the centres of
mass, motor inertias and friction in motion were not identified (they are the description's): do not use it for
computed torque, planning at torque limits or simulation of fast motion. For these: calib excite, then calib identify
with its log.
"""


@dataclass(frozen=True, eq=False)
class StandingPoses:
    """Torques at standing poses, from one file.

    Attributes:
        name: the file.
        q: (N, n) joint values [rad or m].
        torque: (N, n) torques [N m or N].
        approach: (N, n) direction of the motion before each joint stood, +1, -1 or 0 (unknown); None if not recorded.
        carried: labels of the payloads.
    """

    name: str
    q: np.ndarray
    torque: np.ndarray
    approach: np.ndarray | None
    carried: tuple[str, ...]

    def where(self, rows: np.ndarray) -> "StandingPoses":
        """Return some of the poses, given by their indices or a mask."""
        approach = None if self.approach is None else self.approach[rows]
        return replace(self, q=self.q[rows], torque=self.torque[rows], approach=approach)


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
        return _regressor(self.model, poses)[..., self.base.kept] @ self.values

    def described(self, poses: StandingPoses) -> np.ndarray:
        """Return the gravity torques (N, n) of the description."""
        return _regressor(self.model, poses) @ self.reference

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
        return np.array(list(map(_with_centre, reference, estimate)))

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


def _with_centre(reference: np.ndarray, estimate: np.ndarray) -> np.ndarray:
    """Return a body (10,) with the mass and first moments found, and the reference's moments about the centre."""
    _, _, moments = urdf_write.centred(reference)
    body = np.concatenate([np.zeros(6), estimate[6:10]])
    _, _, steiner = urdf_write.centred(body)
    return np.concatenate([moments - steiner, estimate[6:10]])


def _torques(poses: Sequence[StandingPoses]) -> np.ndarray:
    """Return the torques (N, n) of the poses of all files."""
    return np.concatenate([block.torque for block in poses])


def _regressor(model: IdentificationModel, poses: StandingPoses) -> np.ndarray:
    zero = np.zeros(poses.q.shape)
    return model.regressor(poses.q, zero, zero, carried=poses.carried)


def stand(
    robot: str | Path, recordings: Sequence[str], options: Path | None, base: str | None, tip: str | None
) -> bool:
    """Return whether all files are tables of standing poses: without stamps, or logs in which nothing moves for long.

    Args:
        robot: the robot.
        recordings: the files.
        options: the options file.
        base, tip: first and last link of the arm.
    """
    settings = read_options(options)
    chain = None
    for name in recordings:
        path = Path(name)
        if path.suffix.lower() not in TABLES or not path.is_file() or path.stat().st_size > MAX_BYTES:
            return False
        recording_options = settings.file_settings(name).recording
        if recording_options.rate or "t" in recording_options.names or not read_header(path)[0]:
            return False
        chain = chain or load_calibrated(robot, base, tip).chain
        try:
            recording, stamped = read_at_rest(path, joints_of(chain), recording_options)
        except MeasurementError:
            # said by the reader of recordings
            return False
        if not stamped and _moves(recording):
            return False
        if stamped and not len(_standing_rows(recording)):
            return False
    return True


def standing_files(
    robot: str | Path, recordings: Sequence[str], options: Path | None, base: str | None, tip: str | None
) -> list[str]:
    """Return which of several files are tables of standing poses; the arguments are those of `stand`."""
    if len(recordings) < 2:
        return []
    return [name for name in recordings if stand(robot, [name], options, base, tip)]


def _moves(recording: Recording) -> bool:
    """Return whether rows without stamps follow each other as those of a motion do, or have velocities."""
    if recording.v is not None and np.abs(recording.v).max() > MAX_SPEED:
        return True
    spread = np.linalg.norm(recording.q - recording.q.mean(axis=0), axis=1).mean()
    steps = np.linalg.norm(np.diff(recording.q, axis=0), axis=1)
    return len(recording.q) > MAX_POSES and steps.mean() < SMOOTH * spread


def _standing_rows(recording: Recording) -> list[np.ndarray]:
    """Return the rows of each standstill of a log; empty if the log moves."""
    starts = [0]
    for row in range(1, len(recording.q)):
        if np.abs(recording.q[row] - recording.q[starts[-1]]).max() > STILL:
            starts.append(row)
    standing = []
    for first, last in zip(starts, [*starts[1:], len(recording.q)]):
        if recording.t[last - 1] - recording.t[first] >= STANDING:
            standing.append(np.arange(first, last))
    rows = sum(map(len, standing))
    if rows < SHARE * len(recording.q):
        return []
    return standing


def read_poses(path: str, chain: Chain, options: IdentifyOptions) -> StandingPoses:
    """Return the standing poses in a table, or the mean of each standstill of a log.

    Args:
        path: the file.
        chain: the arm.
        options: options with the file's columns and payloads.

    Raises:
        MeasurementError: an invalid file, or currents.
    """
    settings = options.file_settings(path)
    recording, stamped = read_at_rest(Path(path), joints_of(chain), settings.recording)
    if recording.kind == "current":
        raise MeasurementError(
            "has currents: gravity at rest is identified from torques; write columns tau1 … with gain x current [N m]",
            path,
        )
    columns = [f"q{joint}" for joint in range(1, chain.n + 1)]
    columns += [f"tau{joint}" for joint in range(1, chain.n + 1)]
    values = np.hstack([recording.q, recording.effort])
    message = "found {:g} where a number is needed; leave such rows out, or measure them again"
    refuse(recording, ~np.isfinite(values), columns, lambda row, k: message.format(values[row, k]))
    groups: Sequence[np.ndarray] = list(np.arange(len(recording.q))[:, None])
    if stamped:
        groups = _standing_rows(recording)
    q, torque = [], []
    for rows in groups:
        q.append(recording.q[rows].mean(axis=0))
        torque.append(recording.effort[rows].mean(axis=0))
    approach = None
    sides = _approaches(path, chain.n)
    if sides is not None:
        approach = np.array([sides[rows[0]] for rows in groups])
    return StandingPoses(path, np.array(q), np.array(torque), approach, tuple(settings.payload))


def _approaches(path: str, n: int) -> np.ndarray | None:
    """Return the columns ``approach1`` … (N, n) of a table; None without them.

    Raises:
        MeasurementError: some joints have none, or values other than +1, -1 and 0.
    """
    table = read_table(path)
    names = [f"approach{joint}" for joint in range(1, n + 1)]
    absent = [name for name in names if name not in table]
    if len(absent) == n:
        return None
    if absent:
        raise MeasurementError(
            f"has columns of approach for some joints, but no {listing(absent, 3)}: write 0 where it is unknown", path
        )
    sides = np.column_stack([table.numbers(name, None) for name in names])
    message = "found {:g}: an approach is +1 (the joint moved upwards before it stood), -1 (downwards) or 0 (unknown)"
    refuse(table, ~np.isin(sides, (-1.0, 0.0, 1.0)), names, lambda row, k: message.format(sides[row, k]))
    return sides


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
    loads = _loads(poses)
    q = np.concatenate([block.q for block in poses])
    zero = np.zeros(q.shape)
    base = base_parameters.find(model, States(q, zero, zero), loads)
    columns, torques, approaches = [], [], []
    for block in poses:
        columns.append(_regressor(model, block)[..., base.kept])
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
    values, covariance, residual, sigma = _least_squares(W, torque)
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


def _loads(blocks: Sequence[StandingPoses]) -> tuple[tuple[str, ...], ...]:
    """Return the distinct sets of payloads with which the poses were measured."""
    return tuple(dict.fromkeys(block.carried for block in blocks))


def _least_squares(W: np.ndarray, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
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


def divided(blocks: Sequence[StandingPoses], seed: int) -> tuple[list[StandingPoses], list[StandingPoses]]:
    """Return the poses to fit and those held out; rows of one pose stay together.

    Args:
        blocks: the poses of each file.
        seed: seed of the random choice.

    Raises:
        MeasurementError: a file with one distinct pose.
    """
    random = np.random.default_rng(seed)
    training, unseen = [], []
    for block in blocks:
        _, pose = np.unique(np.round(block.q / SAME), axis=0, return_inverse=True)
        distinct = int(pose.max()) + 1
        if distinct == 1:
            raise MeasurementError(
                f"has one distinct pose (rows: {len(block.q)}): measure others too, spread over the joints' ranges",
                block.name,
            )
        chosen = random.permutation(distinct)[: max(1, round(HELD_OUT * distinct))]
        out = np.isin(pose.ravel(), chosen)
        training.append(block.where(~out))
        unseen.append(block.where(out))
    return training, unseen


@dataclass(frozen=True, eq=False)
class GravityResult:
    """A gravity model with its errors at held-out poses.

    Attributes:
        gravity: the model.
        training, unseen: the poses it was fitted to, and those held out.
        source: file of the robot.
    """

    gravity: GravityModel
    training: tuple[StandingPoses, ...]
    unseen: tuple[StandingPoses, ...]
    source: Path

    def errors(self, described: bool = False) -> np.ndarray:
        """Return the torque errors (N, n) at the held-out poses, of the model or of the description."""
        predict = self.gravity.torque
        if described:
            predict = self.gravity.described
        errors = [block.torque - self.gravity.held(block) - predict(block) for block in self.unseen]
        return np.concatenate(errors)

    def unexplained(self, described: bool = False) -> float:
        """Return the share of the held-out torques that is not explained."""
        torque = _torques(self.unseen)
        return float(np.linalg.norm(self.errors(described)) / np.linalg.norm(_varying(torque)))

    def contradiction(self) -> Verdict | None:
        """Return a verdict where the torques contradict gravity as stated with the described masses, else None.

        Masses of any sign explain torques of any sign: without this comparison a reversed torque would pass.
        """
        gravity = self.gravity
        if gravity.chain.inertias is None:
            return None
        assumed = np.asarray(gravity.model.bodies.gravity)
        columns = []
        for direction in np.eye(3):
            model = replace(gravity.model, bodies=gravity.model.bodies.with_gravity(direction))
            blocks = [_regressor(model, block) @ gravity.reference for block in self.training]
            columns.append(_varying(np.concatenate(blocks)))
        W = np.array(columns).T
        torques = np.concatenate([block.torque - gravity.held(block) for block in self.training])
        torque = _varying(torques)
        size = np.linalg.norm(assumed)
        expected = W @ assumed
        if not np.linalg.norm(expected):
            return None
        direction = np.linalg.lstsq(W, torque, rcond=None)[0]
        scale = np.linalg.norm(direction)
        if scale < ABSENT * size:
            reason = f"the torques vary by {100 * scale / size:.2g} % of the described masses' gravity"
            return Verdict("fail", reason, "", "are they compensated for gravity already? Log them before compensation")
        believed = direction / scale * size
        # an arm on a wall or a ceiling stands along an axis
        upright = np.round(believed / size)
        if np.linalg.norm(upright) == 1.0 and upright @ believed > SNAP * size:
            believed = upright * size
        before = _misfit(expected, torque)
        turned = direction @ assumed < ALIKE * scale * size
        causes = _column_faults(expected.reshape(torques.shape), torques)
        if turned:
            option = ", ".join(f"{component:.4g}" for component in np.round(believed, 3) + 0.0)
            reason = f"gravity ({option}) m/s² explains the torques with the described masses, the stated does not"
            advice = (
                "is the arm mounted otherwise, or have its torques the other sign? Both are the same at rest: "
                f"gravity = [{option}] in the options"
            )
            causes.append((_misfit(W @ believed, torque), reason, advice))
        misfit, reason, advice = min(causes)
        if misfit < BETTER * before and misfit <= EXPLAINED:
            return Verdict("fail", reason, "", advice)
        if turned and np.linalg.norm(torque - W @ direction) < BETTER * before * np.linalg.norm(torque):
            advice = "compare joints, signs, units and mounting with the description"
            return Verdict("fail", "the torques contradict gravity of the described masses", "", advice)
        return None

    @property
    def verdict(self) -> Verdict:
        """The verdict, by the unexplained share of the torques at held-out poses."""
        contradiction = self.contradiction()
        if contradiction is not None:
            return contradiction
        share = self.unexplained()
        count = len(self.errors())
        reason = f"{100 * share:.3g} % of the torques at {count} held-out poses unexplained"
        if self.gravity.chain.inertias is not None:
            reason += f" (description: {100 * self.unexplained(True):.3g} %)"
        reason += ", for gravity at rest only"
        doubt = self._doubt()
        if doubt is not None:
            reason += f"; {doubt.reason}"
        if self.gravity.chain.inertias is not None and share > self.unexplained(True):
            advice = "use the description as it is" if doubt is None else doubt.advice
            return Verdict("fail", reason + "; the description is better", "", advice)
        if share <= FAIL and doubt is not None:
            return Verdict(doubt.level, reason, "", doubt.advice)
        if share <= PASS:
            return Verdict("pass", reason)
        advice = "are torques those of the motors at rest, and are joints, signs and units the description's?"
        if share <= FAIL:
            return Verdict("marginal", reason, "", advice)
        return Verdict("fail", reason, "", advice)

    def _doubt(self) -> Verdict | None:
        """Return what keeps a model from passing that predicts well: friction below zero, or few rows."""
        gravity = self.gravity
        band, sigma = gravity.friction
        negative = np.flatnonzero(band < -NEGATIVE * sigma)
        if len(negative):
            joints = listing([gravity.chain.joint_names[joint] for joint in negative], 3)
            level = "marginal"
            if gravity.chain.inertias is None:
                level = "fail"
            advice = "are the columns approach1 … reversed, or have the torques the other sign?"
            return Verdict(level, f"friction at rest is negative: {joints}", "", advice)
        load = self._load()
        if load is not None:
            return load
        held_out = len(self.errors())
        if gravity.rows < FEW_ROWS or held_out < FEW_HELD_OUT:
            few = f"few poses: {gravity.rows:.2g} torques per parameter and {held_out} held-out poses"
            return Verdict("marginal", few, "", f"measure {FEW_ROWS:g} per parameter and {FEW_HELD_OUT} held-out poses")
        return None

    def _load(self) -> Verdict | None:
        """Return a verdict where a load that one file has and others do not explains much more, else None."""
        if len(self.training) < 2:
            return None
        gravity = self.gravity
        chain = gravity.chain
        bodies = with_payload(gravity.model.bodies, np.asarray(chain.tail), UNDECLARED, on=chain.n - 1)
        model = replace(gravity.model, bodies=bodies)
        first = 10 * bodies.labels.index(UNDECLARED) + 6
        torque = np.concatenate([block.torque - gravity.held(block) for block in self.training])
        columns = np.concatenate([_regressor(gravity.model, block)[..., gravity.base.kept] for block in self.training])
        *_, residual, sigma = _least_squares(columns, torque)
        squares = float(np.sum((residual / sigma) ** 2))
        best = None
        for block in self.training:
            loads = []
            for other in self.training:
                carried = replace(other, carried=(*other.carried, UNDECLARED))
                load = _regressor(model, carried)[..., first : first + 4]
                loads.append(load * float(other is block))
            W = np.concatenate([columns, np.concatenate(loads)], axis=2)
            values, covariance, residual, _ = _least_squares(W, torque)
            unexplained = float(np.sum((residual / sigma) ** 2))
            degrees = max(torque.size - W.shape[2], 1)
            ratio = (squares - unexplained) / 4.0 / (unexplained / degrees)
            mass, deviation = values[-1], np.sqrt(covariance[-1, -1])
            if mass > LOAD_SIGMAS * deviation and ratio > LOAD_F and (best is None or ratio > best[0]):
                best = ratio, block.name, mass, deviation
        if best is None:
            return None
        _, name, mass, deviation = best
        reason = f"a load of {mass:.3g} ± {deviation:.1g} kg in {name} that the options do not declare explains them"
        return Verdict("marginal", reason, "", f'declare it: [payload.tool], [files."{name}"] payload = ["tool"]')

    def lines(self) -> list[str]:
        """Return the lines for the console and ``summary.txt``."""
        gravity = self.gravity
        chain = gravity.chain
        fitted_count = sum(len(block.q) for block in self.training)
        counts = f"{fitted_count} fitted, {len(self.errors())} held out"
        result = [f"standing poses ({counts}): gravity is identified, inertias and friction in motion are not"]
        offsets = sum(name.startswith("off") for name in gravity.base.names)
        result.append(f"{gravity.base.b} parameters: {gravity.base.b - offsets} of gravity, {offsets} offsets")
        result += self._undetermined()
        rms = np.sqrt(np.mean(self.errors() ** 2, axis=0))
        band, sigma = gravity.friction
        for joint, error, width, deviation in zip(chain.joints, rms, band, sigma):
            _, _, _, unit = motion_units([joint.kind])
            basis = f"± {deviation:.2g}, from both approaches"
            if np.isnan(deviation):
                basis = "band of 95 %"
            friction = f"± {width:.3g}" if width >= 0.0 else f"{width:.3g}"
            result.append(
                f"{joint.name}: held out {error:.3g} {unit} rms; friction at rest {friction} {unit} ({basis})"
            )
        if np.isnan(sigma).all():
            result.append("with columns approach1 … (+1, -1: the side from which a joint came) friction is estimated")
        without = [block.name for block in self.training if block.approach is None]
        if without and len(without) < len(self.training):
            result.append(f"columns approach1 … of the other files are not used: {listing(without, 3)} has none")
        result += map(self._payload_line, self._labels())
        if chain.inertias is None:
            result.append("the description has no masses: gravity.csv is written, but no robot.urdf")
        verdict = self.verdict
        result.append(str(verdict))
        if verdict.advice:
            result.append(verdict.advice)
        return result

    def _labels(self) -> list[str]:
        carried: set[str] = set()
        for block in self.training:
            carried.update(block.carried)
        return sorted(carried)

    def _payload_line(self, label: str) -> str:
        estimate = self.gravity.payload(label)
        if estimate is None:
            return f"payload {label}: not determined; measure the same poses without it too, with the wrist turned"
        values, covariance = estimate
        centre, sigma = _centre(values, covariance)
        coordinates = []
        for coordinate, deviation in zip(1e3 * centre, 1e3 * sigma):
            digits = np.format_float_positional(deviation, precision=2, unique=False, fractional=False, trim="-")
            coordinates.append(f"{coordinate:.1f} ± {digits}")
        position = ", ".join(coordinates)
        mass = f"{values[3]:.4g} ± {np.sqrt(covariance[3, 3]):.2g} kg"
        return f"payload {label}: {mass} at {position} mm in '{self.gravity.chain.tip}'"

    def _undetermined(self) -> list[str]:
        """Return a line on gravity parameters that other standing poses would determine."""
        gravity = self.gravity
        model = gravity.model
        lower, upper = gravity.chain.sampling_limits()
        states = base_parameters.random_samples(model, lower=lower, upper=upper)
        zero = np.zeros(states.q.shape)
        possible = base_parameters.find(model, States(states.q, zero, zero), _loads(self.training))
        if possible.b <= gravity.base.b:
            return []
        missing = [name for name in possible.names if name not in gravity.base.names]
        count = possible.b - gravity.base.b
        names = ""
        if missing:
            names = f", such as {listing(missing, 3)}"
        return [f"{count} more parameters of gravity need other poses{names}: move all joints over their ranges"]

    def write(self, out: Path) -> Path:
        """Write robot.urdf, tables and a README into a folder, and return it.

        Raises:
            UsageError: the folder contains other files.
        """
        gravity = self.gravity
        sigma = np.sqrt(np.diag(gravity.covariance))
        rows = zip(gravity.base.names, gravity.base.units, gravity.values, sigma)
        files.write_table(out / "gravity.csv", ["name", "unit", "value", "sigma"], list(rows))
        names = gravity.chain.joint_names
        friction = list(zip(names, *gravity.friction))
        files.write_table(out / "friction_at_rest.csv", ["joint", "band", "sigma"], friction)
        payloads = []
        for label in self._labels():
            estimate = gravity.payload(label)
            if estimate is not None:
                centre, centre_sigma = _centre(*estimate)
                payloads.append([label, estimate[0][3], *centre, np.sqrt(estimate[1][3, 3]), *centre_sigma])
        if payloads:
            head = ["payload", "mass [kg]", "x [m]", "y [m]", "z [m]"]
            head += ["sigma_mass [kg]", "sigma_x [m]", "sigma_y [m]", "sigma_z [m]"]
            files.write_table(out / "payload.csv", head, payloads)
        if gravity.chain.inertias is not None and self.contradiction() is None:
            files.write(out / URDF, urdf_text(gravity, self.source, str(self.verdict)))
        files.write(out / GRAVITY_SUMMARY, "\n".join([*self.lines(), "", README]))
        return out


def _misfit(expected: np.ndarray, torque: np.ndarray) -> float:
    """Return the share of torques that expected ones times a positive factor do not explain."""
    factor = max(float(expected @ torque / max(expected @ expected, 1e-12)), 0.0)
    return float(np.linalg.norm(torque - factor * expected) / max(np.linalg.norm(torque), 1e-12))


def _column_faults(expected: np.ndarray, torques: np.ndarray) -> list[tuple[float, str, str]]:
    """Return misfit, reason and advice for a torque column with the other sign, and for two exchanged ones.

    Args:
        expected: (N, n) gravity torques of the description, as a matrix of varying torques.
        torques: (N, n) torques.
    """
    n = torques.shape[1]
    varying = torques - torques.mean(axis=0)
    faults = []
    for joint in range(n):
        signs = np.ones(n)
        signs[joint] = -1.0
        reason = f"with tau{joint + 1} reversed the described masses explain the torques, as they are they do not"
        advice = f"has tau{joint + 1} the other sign? Reverse that column"
        faults.append((_misfit(expected.ravel(), (signs * varying).ravel()), reason, advice))
    for first, second in combinations(range(n), 2):
        order = np.arange(n)
        order[[first, second]] = second, first
        names = f"tau{first + 1} and tau{second + 1}"
        reason = f"with {names} exchanged the described masses explain the torques, as they are they do not"
        misfit = _misfit(expected.ravel(), varying[:, order].ravel())
        faults.append((misfit, reason, f"are {names} exchanged? Exchange their names in the header"))
    return faults


def _varying(torque: np.ndarray) -> np.ndarray:
    """Return torques (N, n) without the mean of each joint, as a vector."""
    return (torque - torque.mean(axis=0)).ravel()


def _centre(values: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a payload's centre of mass (3,) [m] and its sigma (3,), from first moments and mass (4,)."""
    mass = values[3]
    centre = values[:3] / mass
    slopes = np.hstack([np.eye(3), -centre[:, None]]) / mass
    return centre, np.sqrt(np.diag(slopes @ covariance @ slopes.T))


def urdf_text(gravity: GravityModel, source: Path, verdict: str) -> str:
    """Return a URDF whose gravity torques are the identified ones, with a comment on its use.

    Args:
        gravity: the model.
        source: file of the robot; its links and meshes stay where it is a URDF.
        verdict: the verdict's text.
    """
    chain = replace(gravity.chain, inertias=gravity.bodies)
    note = (
        f"<!-- calib identify: gravity from standing poses; {verdict}. Use: gravity compensation, payload checks. "
        "Inertias about the centres of mass and friction are the description's, not identified: not for computed "
        "torque or simulation of fast motion. -->\n"
    )
    text = _edited(gravity, source)
    if text is None:
        text = urdf_write.write_new(chain)
    head, mark, rest = text.partition("?>\n")
    if not mark:
        return note + text
    return head + mark + note + rest


def _edited(gravity: GravityModel, source: Path) -> str | None:
    """Return the URDF at `source` with the identified bodies; None where it is no URDF, or cannot have them."""
    if not source.is_file() or source.suffix == ".toml":
        return None
    xml, *_ = description_text(source)
    if not is_urdf(source):
        return None
    tree = read_tree(xml, str(source))
    path = tree.path(gravity.chain.base, gravity.chain.tip)
    change = gravity.bodies - gravity.reference[: 10 * gravity.chain.n].reshape(-1, 10)
    links = {}
    moving = [joint for joint in path if joint.moves]
    for joint, step in zip(moving, change):
        body = tree.bodies[joint.child]
        if body is None:
            return None
        turn = urdf.align(joint.axis)[:3, :3]
        estimate = np.concatenate([np.zeros(6), body[6:9] + turn @ step[6:9], body[9:] + step[9:]])
        if not estimate[9] > 0.0:
            return None
        links[joint.child] = _with_centre(body, estimate)
    text = urdf_write.put(xml, str(source), links)
    written = urdf.parse(text, str(source), gravity.chain.base, gravity.chain.tip)
    if written.inertias is None or np.abs(written.inertias - gravity.bodies)[:, 6:].max() > 1e-6:
        return None
    return text


def identify_gravity(
    robot: str | Path,
    recordings: Sequence[str],
    validate: Sequence[str] = (),
    options: Path | None = None,
    base: str | None = None,
    tip: str | None = None,
    seed: int = 0,
) -> GravityResult:
    """Identify an arm's gravity from files of standing poses, and judge it on poses that were not fitted.

    Args:
        robot: name of a library robot, or its file.
        recordings, validate: files of poses to fit, and of held-out poses; without the latter a quarter is held out.
        options: options file of an identification: columns, payloads, gravity.
        base, tip: first and last link of the arm.
        seed: seed of the choice of held-out poses.

    Raises:
        MeasurementError: invalid files, or too few poses.
        UsageError: an unknown robot.
    """
    settings = read_options(options)
    chain = load_calibrated(robot, base, tip).chain
    training = [read_poses(name, chain, settings) for name in recordings]
    unseen = [read_poses(name, chain, settings) for name in validate]
    held_out = 0
    if not validate:
        training, unseen = divided(training, seed)
        held_out = sum(len(block.q) for block in unseen)
    gravity = fitted(chain, settings, training, held_out)
    return GravityResult(gravity, tuple(training), tuple(unseen), Path(resolve(robot)))


def check_target(out: Path, inputs: Sequence[str | Path | None]) -> None:
    """Raise UsageError if a folder contains files that this command does not write, or one of the inputs."""
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out} is a file: give a folder")
    names = [path.name for path in out.glob("*")]
    foreign = [name for name in names if name not in NAMES]
    resolved = {Path(name).resolve() for name in inputs if name}
    if foreign or any((out / name).resolve() in resolved for name in names):
        raise UsageError(f"{out} contains {listing(foreign or names, 3)}: give another folder")
