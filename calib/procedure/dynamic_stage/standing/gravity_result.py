"""Result of standing poses: errors at held-out poses, verdict with its causes, files."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from calib import files
from calib.dynamics import base as base_parameters
from calib.dynamics.bodies import with_payload
from calib.dynamics.regressor_model import States
from calib.errors import UsageError, listing
from calib.folders import GRAVITY_SUMMARY
from calib.identification.identify_options import read_options
from calib.procedure.dynamic_stage.standing.gravity_model import (
    GravityModel,
    carried_loads,
    centre_of,
    fitted,
    gravity_regressor,
    least_squares_of,
    stacked_torques,
    varying_part,
    with_centre,
)
from calib.procedure.dynamic_stage.standing.recorded_poses import StandingPoses, divided, read_poses
from calib.procedure.findings import Verdict
from calib.procedure.kinematic_stage.folder import URDF
from calib.robot.formats import urdf, urdf_write
from calib.robot.formats.urdf_tree import is_urdf
from calib.robot.formats.urdf_tree import read as read_tree
from calib.robot.formats.urdf_tree import text as description_text
from calib.robot.library import load_calibrated, resolve
from calib.units import DEG, motion_units

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


# smallest cosine between stated gravity and the direction that explains the torques best with the described masses
ALIKE = 0.9


# residual with that direction over the one with the stated gravity, from which on it is believed
BETTER = 0.7


# unexplained share of the training's torques up to which a cause is named, friction within its band included
EXPLAINED = 0.35


# cosine to an axis of the base from which on gravity is taken to be along it
SNAP = 0.985


# torques that hold less than this share of the described masses' gravity, and vary less than that share of it, hold
# none; torques that vary more have other columns
ABSENT, SMALL = 0.1, 0.5


# largest chance of such errors at held-out poses if the model is as good as the description, to call it worse
WORSE_CHANCE = 0.01


# smallest angle [rad] between stated gravity and another direction that is tried with free masses
TILTED = 3.0 * DEG


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
        torque = stacked_torques(self.unseen)
        return float(np.linalg.norm(self.errors(described)) / np.linalg.norm(varying_part(torque)))

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
            blocks = [gravity_regressor(model, block) @ gravity.reference for block in self.training]
            columns.append(varying_part(np.concatenate(blocks)))
        W = np.array(columns).T
        torques = np.concatenate([block.torque - gravity.held(block) for block in self.training])
        torque = varying_part(torques)
        size = np.linalg.norm(assumed)
        expected = W @ assumed
        if not np.linalg.norm(expected):
            return None
        direction = np.linalg.lstsq(W, torque, rcond=None)[0]
        scale = np.linalg.norm(direction)
        if scale < ABSENT * size and np.linalg.norm(torque) < SMALL * np.linalg.norm(expected):
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
        tilt = np.arccos(np.clip(direction @ assumed / (scale * size), -1.0, 1.0))
        if tilt > TILTED:
            before = self._unexplained_in_training(assumed)
            share = self._unexplained_in_training(believed)
            if share < BETTER * before and share <= EXPLAINED:
                option = ", ".join(f"{component:.2g}" for component in np.round(believed, 1) + 0.0)
                reason = (
                    f"with gravity along ({option}) {100 * share:.2g} % of the fitted torques are unexplained, "
                    f"with the stated {100 * before:.2g} %"
                )
                advice = f"does the arm stand on a slope of some {tilt / DEG:.0f}°? State its gravity in the options"
                return Verdict("fail", reason, "", advice)
        if turned and np.linalg.norm(torque - W @ direction) < BETTER * before * np.linalg.norm(torque):
            advice = "compare joints, signs, units and mounting with the description"
            return Verdict("fail", "the torques contradict gravity of the described masses", "", advice)
        return None

    def _unexplained_in_training(self, direction: np.ndarray) -> float:
        """Return the share of the fitted torques that free masses do not explain with gravity (3,) [m/s²]."""
        gravity = self.gravity
        model = replace(gravity.model, bodies=gravity.model.bodies.with_gravity(direction))
        columns = np.concatenate([gravity_regressor(model, block) for block in self.training])
        torque = np.concatenate([block.torque - gravity.held(block) for block in self.training])
        _, _, residual, _ = least_squares_of(columns, torque)
        return float(np.linalg.norm(residual) / np.linalg.norm(varying_part(torque)))

    def is_worse(self) -> bool:
        """Return whether the description predicts the held-out poses better, by more than chance.

        Squared errors are compared pose by pose (Diebold and Mariano, 1995).
        """
        # slow to load
        from scipy.stats import t

        excess = np.sum(self.errors() ** 2 - self.errors(described=True) ** 2, axis=1)
        count = len(excess)
        if count < 2:
            return False
        deviation = max(float(excess.std(ddof=1)), 1e-12) / np.sqrt(count)
        return bool(excess.mean() > t.ppf(1.0 - WORSE_CHANCE, count - 1) * deviation)

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
            if self.is_worse():
                return Verdict("fail", reason + "; the description is better", "", advice)
            reason += "; no better than the description"
            if doubt is None:
                doubt = Verdict("marginal", "", "", "use the description as it is, or measure more poses")
        if share <= FAIL and doubt is not None:
            return Verdict(doubt.level, reason, "", doubt.advice)
        if share <= PASS:
            return Verdict("pass", reason)
        advice = "are torques those of the motors at rest, and are joints, signs and units the description's?"
        if doubt is not None:
            advice = doubt.advice
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
        columns = np.concatenate(
            [gravity_regressor(gravity.model, block)[..., gravity.base.kept] for block in self.training]
        )
        *_, residual, sigma = least_squares_of(columns, torque)
        squares = float(np.sum((residual / sigma) ** 2))
        best = None
        for block in self.training:
            loads = []
            for other in self.training:
                carried = replace(other, carried=(*other.carried, UNDECLARED))
                load = gravity_regressor(model, carried)[..., first : first + 4]
                loads.append(load * float(other is block))
            W = np.concatenate([columns, np.concatenate(loads)], axis=2)
            values, covariance, residual, _ = least_squares_of(W, torque)
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
        centre, sigma = centre_of(values, covariance)
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
        possible = base_parameters.find(model, States(states.q, zero, zero), carried_loads(self.training))
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
                centre, centre_sigma = centre_of(*estimate)
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
        links[joint.child] = with_centre(body, estimate)
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
