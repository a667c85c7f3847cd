"""Export of a parallel robot: a URDF tree with its loops' closures beside it, and MJCF with the loops closed.

``calib export FOLDER --into DIR``, from the folder of a fit or of an identification, writes

robot.urdf            the loops cut at the platform: all legs from ``base``; the first leg with a rigid end carries the
                      platform (link ``platform``), without one it floats. Masses; of an identification also friction.
robot.yaml            what closes them, for Pinocchio, in the keys of Gepetto's example-parallel-robots: ``closed_loop``
                      pairs of links that coincide, ``type`` 6d (rigid) or 3d (ball joint) of each, ``name_mot`` the
                      actuated joints; and ``home``, joint values at which the loops close.
robot.xml             MJCF for MuJoCo, the loops closed by ``equality`` (weld or connect of two sites), with motors,
                      motor inertia and friction, and the keyframe ``home``: start there, at zero the loops are open.
drives.csv            as of a serial arm (``calib formats exports``), passive joints included.
robot.toml            for this toolkit.
parameters.json       all parameters with their covariance: the dynamics' of an identification, the geometry's of a fit.
README.txt            what each file is for, and the verdict on it.

A rigid leg's last link is the platform, so that with k of them each last link has 1/k of the platform's mass: closed,
together they are the platform, and no simulator meets a moving body without mass. No SDF is written: Gazebo anchors a
loop's joint where all joints are zero, where the loops are open. Masses are those of physically consistent bodies, as
of a serial arm; payloads are not part of the robot.
"""

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from calib import files
from calib.dynamics import pseudo_inertia
from calib.dynamics.bodies import STANDARD
from calib.errors import RobotError, UsageError
from calib.folders import (
    COVARIANCE,
    ESTIMATE,
    METRICS,
    PARAMETERS,
    check_target,
    read_covariance,
    read_estimate,
    write_staged,
)
from calib.identification.model_file import MODEL, refuse_currents
from calib.identification.physical_consistency import information
from calib.identification.physical_consistency.consistency_problem import find_prior_bodies
from calib.identification.physical_consistency.solve import PossibleBodies, find_possible
from calib.identification.prediction import Dynamics
from calib.identification.prior import RADIUS
from calib.parallel.design_goal import read_model
from calib.parallel.mechanism.closure import ClosedRobot
from calib.parallel.mechanism.parallel_model import ParallelModel, make_parallel_model
from calib.parallel.mechanism.parallel_robot import Leg
from calib.parallel.mechanism.velocities import LoopMotion, of_platform
from calib.parallel.robots import ParallelMechanism
from calib.procedure.export.delivery import DRIVES, MJCF, README, TO_SIMULATE, write_drives
from calib.procedure.export.identified import Drives, drive_table
from calib.procedure.findings import NOT_JUDGED
from calib.procedure.kinematic_stage.folder import URDF
from calib.results.result_classes import open_result
from calib.robot.calibrated import ROBOT
from calib.robot.chain import Chain, Element, Joint
from calib.robot.formats.native import NativeModel
from calib.robot.formats.simulators import mjcf_text, pinocchio_model, pose_attributes
from calib.robot.formats.urdf_tree import transform_body, with_comment
from calib.robot.formats.urdf_write import add_joint, centred, numbers_text, put, write_new, xml_text
from calib.robot.kinematics import joint_frames
from calib.transforms import invert
from calib.workers.extras import available, lacking

PLATFORM = "platform"
CLOSURES = "robot.yaml"
# Files of an export, and the use of each.
USES = {
    URDF: "for ROS, MoveIt, Pinocchio: the robot cut open at its platform",
    CLOSURES: "for Pinocchio: the frames of robot.urdf that close the loops, the actuated joints, joint values at home",
    MJCF: "for MuJoCo: loops closed, masses, motor inertia and friction; start at its keyframe home",
    DRIVES: TO_SIMULATE,
    ROBOT: "for this toolkit",
    PARAMETERS: "all parameters with their covariance",
    README: "",
}
# Largest difference of frames that Pinocchio reads back [m, and entries of rotation matrices], and of forces as a share
# of the largest force.
MAX_DIFFERENCE = 1e-9
# MuJoCo's settings of the loops. In a motion of 1 s of the five-bar robot, loops open by 5 mm with MuJoCo's default
# settings, and by 0.03 mm with these.
CLOSED = {"solref": "0.002 1", "solimp": "0.99 0.999 0.0001"}
# Names of the moments of inertia in URDF, in the order of `centred`.
INERTIA_KEYS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


@dataclass(frozen=True, eq=False)
class OpenedRobot:
    """A parallel robot with its loops cut at the platform, for export as a tree; its inertias are consistent.

    Attributes:
        model: dynamics model without payloads.
        values: (p,) values of the model's parameters.
        drives: drive parameters of all joints of the tree.
    """

    model: ParallelModel
    values: np.ndarray
    drives: Drives

    @property
    def mechanism(self) -> ClosedRobot:
        return self.model.mechanism

    @cached_property
    def rigid(self) -> list[Leg]:
        """Legs with a rigid end: their last link is the platform. In the tree the first leg carries the platform."""
        return [leg for leg in self.mechanism.robot.legs if leg.end == "rigid"]

    @property
    def closing(self) -> list[Leg]:
        """Legs whose ends the tree does not connect to the platform: the loops that a simulator has to close."""
        return [leg for leg in self.mechanism.robot.legs if leg not in self.rigid[:1]]

    @property
    def free(self) -> np.ndarray:
        """Standard parameters (10,) of the platform without payloads."""
        return self.model.platform_parameters(self.values, ())

    @cached_property
    def chains(self) -> list[Chain]:
        """The legs as chains whose joints have unique names.

        Each of k legs with a rigid end has 1/k of the platform's inertial parameters in its last link.
        """
        robot = self.mechanism.robot
        rows = self.model.leg_parameters(self.values)
        names = []
        for leg in robot.legs:
            names += leg.chain.joint_names
        chains = []
        for leg, row in zip(robot.legs, rows):
            bodies = row.reshape(-1, 10)
            if leg.end == "rigid":
                T_tip = leg.chain.tail @ invert(leg.attachment)
                share = self.free / len(self.rigid)
                bodies[-1] = transform_body(share, T_tip)
            joints = []
            for joint in leg.chain.joints:
                if names.count(joint.name) > 1:
                    joint = replace(joint, name=f"{leg.name}_{joint.name}")
                joints.append(joint)
            tip = f"{leg.name}_end"
            chains.append(replace(leg.chain, joints=tuple(joints), base="base", tip=tip, inertias=bodies, links=()))
        return chains

    @property
    def joints(self) -> tuple[Joint, ...]:
        """All joints of the tree, with the names that they have in the exported files."""
        joints: list[Joint] = []
        for chain in self.chains:
            joints += chain.joints
        return tuple(joints)

    @property
    def actuated(self) -> list[str]:
        return [self.joints[j].name for j in self.mechanism.robot.actuated]

    @property
    def home(self) -> dict[str, float]:
        """Values of all joints at home, by name, at which the loops close [rad or m]."""
        names = [joint.name for joint in self.joints]
        values = self.mechanism.home.q[0].tolist()
        return dict(zip(names, values))

    def rows(self, values: np.ndarray) -> list[np.ndarray]:
        """Return values (n_t, …) of all joints of the tree as one array per leg."""
        starts = self.mechanism.robot.starts
        return np.split(values, starts[1:-1])

    def urdf(self) -> str:
        """Return the text of ``robot.urdf``."""
        root = ET.Element("robot", name=self.mechanism.robot.name)
        for chain in self.chains:
            leg_root = ET.fromstring(write_new(chain))
            elements = list(leg_root)
            # The first link is common to all legs: it is added once.
            if len(root):
                elements = elements[1:]
            root.extend(elements)
        link = ET.SubElement(root, "link", name=PLATFORM)
        if self.rigid:
            first_leg = self.rigid[0]
            end = f"{first_leg.name}_end"
            add_joint(root, "platform_fixed", "fixed", end, PLATFORM, invert(first_leg.attachment))
        else:
            mass, centre, moments = centred(self.free)
            inertial = ET.SubElement(link, "inertial")
            ET.SubElement(inertial, "origin", xyz=numbers_text(centre), rpy="0 0 0")
            ET.SubElement(inertial, "mass", value=repr(mass))
            values = [repr(float(moment)) for moment in moments]
            inertia: dict[str, str] = dict(zip(INERTIA_KEYS, values))
            ET.SubElement(inertial, "inertia", inertia)
            add_joint(root, "platform_floating", "floating", "base", PLATFORM, self.mechanism.robot.home)
        for leg in self.closing:
            name = f"{leg.name}_attachment"
            ET.SubElement(root, "link", name=name)
            add_joint(root, f"{name}_fixed", "fixed", PLATFORM, name, np.asarray(leg.attachment))
        head = f'<?xml version="1.0"?>\n<!-- loops are open here: {CLOSURES} closes them -->\n'
        text = head + xml_text(root)
        friction = {}
        for joint, row in zip(self.joints, self.drives.values.tolist()):
            viscous = row[1]
            coulomb = row[2]
            if viscous or coulomb:
                friction[joint.name] = (viscous, coulomb)
        return put(text, URDF, {}, friction)

    def closures(self) -> str:
        """Return the text of ``robot.yaml``."""
        pairs = []
        types = []
        for leg in self.closing:
            pairs.append([f"{leg.name}_end", f"{leg.name}_attachment"])
            if leg.end == "rigid":
                types.append("6d")
            else:
                types.append("3d")
        table = {"closed_loop": pairs, "type": types, "name_mot": self.actuated, "joint_name": [], "joint_type": []}
        lines = ["# Loops of robot.urdf: pairs of links that coincide; values at home [rad or m]"]
        lines += [f"{key}: {json.dumps(value)}" for key, value in table.items()]
        lines.append("home:")
        lines += [f"  {json.dumps(name)}: {value:.12f}" for name, value in self.home.items()]
        return "\n".join([*lines, ""])

    def mjcf(self) -> str:
        """Return the text of ``robot.xml``."""
        robot = self.mechanism.robot
        root = ET.Element("mujoco", model=self.mechanism.robot.name)
        world = ET.Element("worldbody")
        home = numbers_text(self.mechanism.home.q[0])
        for chain, drives in zip(self.chains, self.rows(self.drives.values)):
            inertias = np.asarray(chain.inertias)
            leg_text = mjcf_text(chain, inertias, *drives.T[:3])
            model: Any = ET.fromstring(leg_text)
            if not len(root):
                compiler = model.find("compiler")
                option = model.find("option")
                option.set("timestep", "0.001")
                root.extend([compiler, option, world])
            world.extend(model.find("worldbody"))
        if self.rigid:
            first_leg = self.rigid[0]
            chain = self.chains[robot.legs.index(first_leg)]
            last = chain.joint_names[-1]
            body = next(element for element in world.iter("body") if element.get("name") == f"{last}_body")
            T_tip = first_leg.chain.tail @ invert(first_leg.attachment)
        else:
            mass, centre, (xx, xy, xz, yy, yz, zz) = centred(self.free)
            home_attributes = pose_attributes(robot.home)
            body = ET.SubElement(world, "body", {"name": "platform_body", **home_attributes})
            ET.SubElement(body, "freejoint", name=PLATFORM)
            inertia = np.array([xx, yy, zz, xy, xz, yz])
            full = numbers_text(inertia)
            ET.SubElement(body, "inertial", pos=numbers_text(centre), mass=repr(mass), fullinertia=full)
            home += " " + " ".join(home_attributes.values())
            T_tip = np.eye(4)
        ET.SubElement(body, "site", {"name": PLATFORM, **pose_attributes(T_tip)})
        ties = ET.SubElement(root, "equality")
        motors = ET.SubElement(root, "actuator")
        for leg in self.closing:
            name = f"{leg.name}_attachment"
            attachment = pose_attributes(T_tip @ leg.attachment)
            ET.SubElement(body, "site", {"name": name, **attachment})
            tie = {"name": leg.name, "site1": name, "site2": f"{leg.name}_end_tip", **CLOSED}
            kind = "connect"
            if leg.end == "rigid":
                kind = "weld"
            ET.SubElement(ties, kind, tie)
        for name, joint in zip(self.actuated, robot.joints):
            motor = {"name": name, "joint": name}
            if np.isfinite(joint.effort):
                motor["ctrlrange"] = f"{-joint.effort!r} {joint.effort!r}"
            ET.SubElement(motors, "motor", motor)
        keyframe = ET.SubElement(root, "keyframe")
        ET.SubElement(keyframe, "key", name="home", qpos=home)
        return xml_text(root)


@dataclass(frozen=True, eq=False)
class _Source:
    """Input of an export.

    Attributes:
        opened: the robot, cut open, with its dynamics.
        parameters: content of ``parameters.json``.
        notes: sentences for the user.
    """

    opened: OpenedRobot
    parameters: dict[str, object]
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _ArmBodies:
    """The bodies of a parallel robot in the form of a serial arm's `calib.dynamics.bodies.Bodies`.

    Attributes:
        count: number of bodies.
        n: number of joints of all legs.
        labels: labels of the bodies.
        coordinates: joint of each body; -1 for payloads.
    """

    count: int
    n: int
    labels: tuple[str, ...]
    coordinates: np.ndarray


@dataclass(frozen=True, eq=False)
class _ArmModel:
    """The attributes of a serial arm's identification model that `find_possible` reads."""

    bodies: _ArmBodies
    columns: tuple[object, ...]
    names: tuple[str, ...]
    inertial: int
    torque_rows: Any


def _side_by_side(model: ParallelModel, bodies: np.ndarray | None) -> tuple[Chain, Any]:
    """Return the bodies of a model in the form of a serial arm, which `find_possible` requires.

    Args:
        model: model of the robot.
        bodies: inertial parameters of the bodies; None: unknown. Then a link of a leg becomes a rod of 1 kg between its
            joints, and the platform a ball of 1 kg.

    Returns:
        A chain with a joint per body, and a model with its labels and columns.
    """
    names = model.names[: model.inertial : 10]
    labels = tuple(name.removeprefix(STANDARD[0]) for name in names)
    count = len(labels) - len(model.payloads)
    robot = model.mechanism.robot
    if bodies is None:
        assumed = [pseudo_inertia.ball(1.0, RADIUS)] * count
        legs = robot.legs
        if model.identical_legs:
            legs = robot.legs[:1]
        body = 0
        for leg in legs:
            for frame in _next_frames(leg)[: leg.bodies]:
                assumed[body] = pseudo_inertia.rod(1.0, frame[:3, 3], RADIUS / 4)
                body += 1
        bodies = np.array(assumed)
    rows = bodies.reshape(-1, 10)[:count]
    joints = []
    elements = []
    for k, label in enumerate(labels[:count]):
        joints.append(Joint(label))
        elements.append(Element(label, "rz", joint=k, owner=k))
    chain = Chain(robot.name, tuple(joints), tuple(elements), inertias=rows)
    no_joint = [-1] * len(model.payloads)
    coordinates = np.array([*range(count), *no_joint])
    n = int(robot.starts[-1])
    arm_bodies = _ArmBodies(len(labels), n, labels, coordinates)
    return chain, _ArmModel(arm_bodies, model.columns, model.names, model.inertial, model.torque_rows)


def _next_frames(leg: Leg) -> np.ndarray:
    """Return the pose (n, 4, 4) of the next joint, or of the leg's end, in the frame of each link of a leg, at home."""
    frames = joint_frames(leg.chain, leg.home[None])[:, 0]
    next_joints = invert(frames[:-1]) @ frames[1:]
    return np.concatenate([next_joints, leg.chain.tail[None]])


def _identified(robot: ParallelMechanism, folder: Path, prior: str) -> _Source:
    """Return the robot of an identification with physically consistent bodies.

    Raises:
        RobotError: for an identification by an earlier version, which did not store how parameters regroup.
    """
    refuse_currents(folder, "an export of masses")
    model, parameters = read_model(robot, folder)
    chain, arm = _side_by_side(model, model.known_parameters())
    estimate = information.read(folder, (chain, Dynamics(arm, parameters)))
    possible = find_possible(estimate, prior=prior)
    single = model.single
    values = model.spread(possible.dynamics.values)
    owners = np.ix_(model.owners, model.owners)
    covariance = possible.covariance[owners]
    _, single_arm = _side_by_side(single, single.known_parameters())
    single_dynamics = Dynamics(single_arm, values)
    drives = drive_table(single_dynamics, covariance)
    keys = ("possible", "nearest", "distance", "allowed", "weight", "prior", "notes")
    standard = {
        "names": single.names,
        "units": single.units,
        "values": values,
        "covariance": covariance,
        "frames": "about the frame of each link (robot.toml)",
    }
    base = {
        "names": estimate.names,
        "units": estimate.units,
        "values": estimate.values,
        "covariance": estimate.covariance,
    }
    consistency = {key: getattr(possible, key) for key in keys}
    table = {"base": base, "standard": standard, "consistency": consistency}
    notes = [_consistency(possible, estimate.b), *possible.notes]
    offsets = drives.values[:, 3]
    if drives.left or np.any(offsets):
        missing = ", ".join(("offsets", *drives.left))
        notes.append(f"not in URDF and MJCF, but in parameters.json: {missing}")
    if model.payloads:
        payloads = ", ".join(model.payloads)
        notes.append(f"payloads are not part of the robot: {payloads} are in parameters.json alone")
    return _Source(OpenedRobot(single, values, drives), {"dynamics": table}, tuple(notes))


def _consistency(possible: PossibleBodies, count: int) -> str:
    """Return a sentence on how far the consistent inertias are from the estimate of `count` parameters."""
    head = f"consistent inertias {possible.distance:.2g} σ from the estimate of {count} parameters"
    limit = f"95 % of correct models are within {possible.allowed:.2g}"
    worst = "; ".join(f"{name} (without it {ratio:.3g})" for name, ratio in possible.blamed)
    if not worst:
        return f"{head}; {limit}"
    return f"{head}; {limit}; contradicted most by {worst}"


def _calibrated(robot: ParallelMechanism, folder: Path) -> _Source:
    """Return a robot with the inertias of its file, without friction.

    Raises:
        UsageError: if the file has no inertias.
    """
    model = make_parallel_model(robot.mechanism, ("",))
    bodies = model.known_parameters()
    if bodies is None:
        raise UsageError(
            f"{robot.source} has no inertias, and simulators need masses: state them there, or export an identification"
        )
    chain, arm = _side_by_side(model, bodies)
    prior_bodies = next(find_prior_bodies(chain, arm))
    estimate = read_estimate(folder)
    _, covariance = read_covariance(folder / COVARIANCE)
    names = []
    units = []
    values = []
    for row in estimate:
        names.append(row.name)
        units.append(row.unit)
        values.append(row.value)
    table: dict[str, object] = {"names": names, "units": units, "values": values, "covariance": covariance}
    drives = drive_table(Dynamics(arm, np.zeros(model.p)))
    notes = ("masses are those of the robot's file, not identified; no friction", *prior_bodies.notes)
    opened = OpenedRobot(model, prior_bodies.parameters.ravel(), drives)
    return _Source(opened, {"geometry": table}, notes)


def export_parallel(robot: ParallelMechanism, folder: Path, into: Path, prior: str = "entropic") -> tuple[str, ...]:
    """Write a parallel robot with its dynamics for other programs; the files are listed in the module's docstring.

    Args:
        folder: folder of a fit or of an identification.
        into: folder for the files.
        prior: see `calib.export`.

    Returns:
        Sentences on the files written, with remarks.

    Raises:
        RobotError: if Pinocchio computes other loops or forces from the files; then nothing is written.
    """
    result = open_result(folder, "export")
    if result.identification is None and not (folder / ESTIMATE).is_file():
        result.refuse("export")
    inputs = [robot.source]
    inputs += [folder / name for name in (ROBOT, METRICS, MODEL, ESTIMATE, COVARIANCE)]
    check_export_target(into, inputs)
    if result.identification is not None:
        source = _identified(robot, folder, prior)
    else:
        source = _calibrated(robot, folder)
    opened = source.opened
    level = result.verdict.level
    verdict = ""
    if level != NOT_JUDGED:
        verdict = str(result.verdict)
    if level == "fail":
        verdict += "; do not use"
    remark = ""
    if level in ("marginal", "fail"):
        remark = verdict
    texts = {URDF: opened.urdf(), MJCF: opened.mjcf()}
    for name, text in texts.items():
        if available("pinocchio"):
            _check(opened, text, name)

    def write(target: Path) -> None:
        robot.write(target)
        for name, text in texts.items():
            content = text.encode()
            if name == URDF:
                content = with_comment(content, "its loops are closed by robot.yaml")
            if remark:
                content = with_comment(content, remark)
            files.write(target / name, content)
        files.write(target / CLOSURES, opened.closures())
        write_drives(opened.joints, opened.drives, target / DRIVES)
        files.write_json(target / PARAMETERS, {"robot": robot.chain.name, **source.parameters})
        lines = [verdict or "verdict unknown", "", *_uses(), ""]
        files.write(target / README, "\n".join(lines))

    write_staged(into, tuple(USES), write)
    files_written = f"{URDF} ({len(opened.closing)} loops open, closed by {CLOSURES}), {MJCF} (loops closed)"
    readback = "Pinocchio reads the same loops and forces to 1e-9"
    if not available("pinocchio"):
        readback = f"not read back: {lacking('pinocchio')}"
    sentences = [f"{files_written}; {readback}", *source.notes]
    if remark:
        sentences.insert(0, remark)
    return tuple(sentences)


def check_export_target(out: Path, inputs: Iterable[str | Path | None] = ()) -> None:
    """Raise UsageError if an output folder has other content or contains an input file."""
    check_target(out, tuple(USES), (PARAMETERS,), "export", inputs)


def _uses() -> Iterator[str]:
    return (f"{name}: {use}" for name, use in USES.items() if use)


def _check(opened: OpenedRobot, text: str, where: str, postures: int = 5) -> None:
    """Raise RobotError if a file, read by Pinocchio, has open loops or other forces on the platform.

    Args:
        opened: the robot.
        text: content of the file.
        where: name of the file; ``.xml`` for MJCF, else URDF.
        postures: number of random states that are compared.
    """
    mechanism = opened.mechanism
    rng = np.random.default_rng(0)
    r = opened.mechanism.robot.r
    mjcf = where.endswith(".xml")
    robot = mechanism.robot
    coordinates = rng.uniform(robot.lower, robot.upper, (postures, r))
    posture = mechanism.place(0.9 * coordinates)
    rate, change = rng.uniform(-1.0, 1.0, (2, postures, r))
    motion = of_platform(mechanism, posture, rate, change)
    inertial = opened.values[: opened.model.inertial]
    no_friction = np.zeros(len(opened.model.terms))
    rigid = np.concatenate([inertial, no_friction])
    expected = opened.model.platform_force(rigid, motion, ())
    if mjcf:
        motor_torques = opened.drives.values[:, 0] * motion.a
        expected += np.einsum("ntr,nt->nr", motion.jacobians.joints, motor_torques)
    forces = np.zeros_like(expected)
    gap_size = 0.0
    if mjcf:
        parts = _models(text)
    else:
        parts = [pinocchio_model(text)]
    for m in range(postures):
        frames: dict[str, np.ndarray] = {}
        for model in parts:
            forces[m] += _forces(opened, model, motion, m, frames)
        for leg in opened.closing:
            end_name = f"{leg.name}_end"
            if mjcf:
                end_name += "_tip"
            end = frames[end_name]
            attachment = frames[f"{leg.name}_attachment"]
            gap = invert(end) @ attachment - np.eye(4)
            # A spherical end constrains the position only.
            if leg.end != "rigid":
                gap = gap[:, 3]
            largest_gap = float(np.abs(gap).max())
            gap_size = max(gap_size, largest_gap)
    if gap_size > MAX_DIFFERENCE:
        raise RobotError(
            f"{where}: loops stay {gap_size:.2g} m (or rad) open when Pinocchio reads it; nothing was written: "
            "report this as a bug"
        )
    largest = max(1.0, float(np.abs(expected).max()))
    difference = float(np.abs(forces - expected).max()) / largest
    if difference > MAX_DIFFERENCE:
        raise RobotError(
            f"{where}: forces differ by {difference:.2g} of the largest when Pinocchio reads it; nothing was written: "
            "report this as a bug"
        )


def _models(text: str) -> list[NativeModel]:
    """Return Pinocchio's models of an MJCF text, one per leg and one of a floating platform.

    Pinocchio reads a single tree per text. The keyframe is omitted: for joints without limits, Pinocchio requires
    cosine and sine in place of the angle.
    """
    root = ET.fromstring(text)
    world = root.find("worldbody")
    assert world is not None
    models = []
    for body in list(world):
        document = ET.Element("mujoco", model=root.get("model", ""))
        document.extend([*root.findall("compiler"), *root.findall("option"), world])
        world[:] = [body]
        models.append(pinocchio_model(xml_text(document), mjcf=True))
    return models


def _forces(
    opened: OpenedRobot, model: NativeModel, motion: LoopMotion, m: int, frames: dict[str, np.ndarray]
) -> np.ndarray:
    """Return the forces (r,) on the platform's coordinates by a Pinocchio model of a part of the robot.

    Args:
        opened: the robot.
        model: Pinocchio's model.
        motion: motion of all joints and the platform.
        m: number of the sample.
        frames: (4, 4) frames in the base by name, to which the model's frames are added.
    """
    pin = import_module("pinocchio")
    data = model.createData()
    mechanism = opened.mechanism
    model.gravity = pin.Motion(np.array(mechanism.robot.gravity), np.zeros(3))
    q = pin.neutral(model)
    v = np.zeros(model.nv)
    a = np.zeros(model.nv)
    J = np.zeros((model.nv, mechanism.robot.r))
    for j, drive in enumerate(opened.joints):
        if model.existJointName(drive.name):
            joint = model.joints[model.getJointId(drive.name)]
            value = motion.posture.q[m, j]
            first = joint.idx_q
            if joint.nq == 1:
                q[first] = value
            else:
                q[first] = np.cos(value)
                q[first + 1] = np.sin(value)
            v[joint.idx_v] = motion.v[m, j]
            a[joint.idx_v] = motion.a[m, j]
            J[joint.idx_v] = motion.jacobians.joints[m, j]
    for k, joint in enumerate(model.joints):
        if joint.nv == 6:
            pose = motion.posture.pose[m]
            first = joint.idx_q
            rows = slice(joint.idx_v, joint.idx_v + 6)
            turn = np.kron(np.eye(2), pose[:3, :3].T)
            placement = np.eye(4)
            if "platform_floating" in model.names:
                placement = model.jointPlacements[k].homogeneous
            relative = pin.SE3(invert(placement) @ pose)
            q[first : first + 7] = pin.SE3ToXYZQUAT(relative)
            v[rows] = turn @ motion.twist[m]
            a[rows] = turn @ motion.change[m]
            J[rows] = turn @ motion.jacobians.platform[m]
            # Pinocchio's accelerations are spatial ones.
            linear, angular = np.split(v[rows], 2)
            convective = np.cross(angular, linear)
            a[rows] -= [*convective, 0.0, 0.0, 0.0]
    pin.framesForwardKinematics(model, data, q)
    for k, frame in enumerate(model.frames):
        frames[frame.name] = data.oMf[k].homogeneous.copy()
    return J.T @ pin.rnea(model, data, q, v, a)
