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
from calib.results.registry import open_result
from calib.robot.calibrated import ROBOT
from calib.robot.chain import Chain, Element, Joint
from calib.robot.formats.native import NativeModel
from calib.robot.formats.simulators import mjcf_text, pinocchio_model, pose_attributes
from calib.robot.formats.urdf_tree import transform_body, with_comment
from calib.robot.formats.urdf_write import add_joint, centred, numbers_text, put, write_new, xml_text
from calib.robot.kinematics import joint_frames
from calib.transforms import invert

PLATFORM, CLOSURES = "platform", "robot.yaml"
USES = {
    URDF: "for ROS, MoveIt, Pinocchio: the robot cut open at its platform",
    CLOSURES: "for Pinocchio: the frames of robot.urdf that close the loops, the actuated joints, joint values at home",
    MJCF: "for MuJoCo: loops closed, masses, motor inertia and friction; start at its keyframe home",
    DRIVES: TO_SIMULATE,
    ROBOT: "for this toolkit",
    PARAMETERS: "all parameters with their covariance",
    README: "",
}
"""Files of an export, and the use of each."""
# of frames read back [m, and as rotation matrices], and of forces over the largest
MAX_DIFFERENCE = 1e-9
CLOSED = {"solref": "0.002 1", "solimp": "0.99 0.999 0.0001"}
"""MuJoCo's settings of the loops: with its default they give way by 5 mm (five-bar, 1 s motion), with these by 0.03."""


@dataclass(frozen=True, eq=False)
class OpenedRobot:
    """A parallel robot cut open for export, its masses consistent.

    Attributes:
        model, values: dynamics model and its parameters (p,), without payloads.
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
        """The legs whose last link is the platform; the first carries it in the tree."""
        return [leg for leg in self.mechanism.robot.legs if leg.end == "rigid"]

    @property
    def closing(self) -> list[Leg]:
        """The legs that the tree leaves open."""
        return [leg for leg in self.mechanism.robot.legs if leg not in self.rigid[:1]]

    @property
    def free(self) -> np.ndarray:
        """Standard parameters (10,) of a platform that no leg carries in the tree."""
        return self.model.platform_parameters(self.values, ())

    @cached_property
    def chains(self) -> list[Chain]:
        """The legs as chains, uniquely named; the last link of each rigid leg has its share of the platform's mass."""
        robot = self.mechanism.robot
        rows = self.model.leg_parameters(self.values)
        names = [joint.name for leg in robot.legs for joint in leg.chain.joints]
        chains = []
        for leg, row in zip(robot.legs, rows):
            bodies = row.reshape(-1, 10)
            if leg.end == "rigid":
                T_tip = leg.chain.tail @ invert(leg.attachment)
                bodies[-1] = transform_body(self.free / len(self.rigid), T_tip)
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
        """All joints of the tree, under their names in the files."""
        return tuple(joint for chain in self.chains for joint in chain.joints)

    @property
    def actuated(self) -> list[str]:
        return [self.joints[j].name for j in self.mechanism.robot.actuated]

    @property
    def home(self) -> dict[str, float]:
        """Values of all joints at which the loops close with the platform at home [rad or m]."""
        names = [joint.name for joint in self.joints]
        return dict(zip(names, self.mechanism.home.q[0].tolist()))

    def rows(self, values: np.ndarray) -> list[np.ndarray]:
        """Return values (n_t, …) of all joints, by leg."""
        return np.split(values, self.mechanism.robot.starts[1:-1])

    def urdf(self) -> str:
        """Return the text of ``robot.urdf``."""
        root = ET.Element("robot", name=self.mechanism.robot.name)
        for chain in self.chains:
            elements = list(ET.fromstring(write_new(chain)))
            # the link that all legs begin at stands in the tree once
            if len(root):
                elements = elements[1:]
            root.extend(elements)
        link = ET.SubElement(root, "link", name=PLATFORM)
        if self.rigid:
            first_leg = self.rigid[0]
            add_joint(root, "platform_fixed", "fixed", f"{first_leg.name}_end", PLATFORM, invert(first_leg.attachment))
        else:
            mass, centre, moments = centred(self.free)
            inertial = ET.SubElement(link, "inertial")
            ET.SubElement(inertial, "origin", xyz=numbers_text(centre), rpy="0 0 0")
            ET.SubElement(inertial, "mass", value=repr(mass))
            names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
            values = [repr(float(moment)) for moment in moments]
            ET.SubElement(inertial, "inertia", dict(zip(names, values)))
            add_joint(root, "platform_floating", "floating", "base", PLATFORM, self.mechanism.robot.home)
        for leg in self.closing:
            ET.SubElement(root, "link", name=f"{leg.name}_attachment")
            name = f"{leg.name}_attachment"
            add_joint(root, f"{name}_fixed", "fixed", PLATFORM, name, np.asarray(leg.attachment))
        text = f'<?xml version="1.0"?>\n<!-- loops are open here: {CLOSURES} closes them -->\n' + xml_text(root)
        friction = {}
        for joint, row in zip(self.joints, self.drives.values.tolist()):
            if row[1] or row[2]:
                friction[joint.name] = (row[1], row[2])
        return put(text, URDF, {}, friction)

    def closures(self) -> str:
        """Return the text of ``robot.yaml``."""
        pairs = []
        types = []
        for leg in self.closing:
            pairs.append([f"{leg.name}_end", f"{leg.name}_attachment"])
            types.append("6d" if leg.end == "rigid" else "3d")
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
            model: Any = ET.fromstring(mjcf_text(chain, np.asarray(chain.inertias), *drives.T[:3]))
            if not len(root):
                root.extend([model.find("compiler"), model.find("option"), world])
                root[1].set("timestep", "0.001")
            world.extend(model.find("worldbody"))
        if self.rigid:
            last = self.chains[robot.legs.index(self.rigid[0])].joint_names[-1]
            body = next(element for element in world.iter("body") if element.get("name") == f"{last}_body")
            T_tip = self.rigid[0].chain.tail @ invert(self.rigid[0].attachment)
        else:
            mass, centre, (xx, xy, xz, yy, yz, zz) = centred(self.free)
            body = ET.SubElement(world, "body", {"name": "platform_body", **pose_attributes(robot.home)})
            ET.SubElement(body, "freejoint", name=PLATFORM)
            full = numbers_text(np.array([xx, yy, zz, xy, xz, yz]))
            ET.SubElement(body, "inertial", pos=numbers_text(centre), mass=repr(mass), fullinertia=full)
            home += " " + " ".join(pose_attributes(robot.home).values())
            T_tip = np.eye(4)
        ET.SubElement(body, "site", {"name": PLATFORM, **pose_attributes(T_tip)})
        ties = ET.SubElement(root, "equality")
        motors = ET.SubElement(root, "actuator")
        for leg in self.closing:
            name = f"{leg.name}_attachment"
            ET.SubElement(body, "site", {"name": name, **pose_attributes(T_tip @ leg.attachment)})
            tie = {"name": leg.name, "site1": name, "site2": f"{leg.name}_end_tip", **CLOSED}
            ET.SubElement(ties, "weld" if leg.end == "rigid" else "connect", tie)
        for name, joint in zip(self.actuated, robot.joints):
            if np.isfinite(joint.effort):
                limit = {"ctrlrange": f"{-joint.effort!r} {joint.effort!r}"}
            else:
                limit = {}
            ET.SubElement(motors, "motor", {"name": name, "joint": name, **limit})
        ET.SubElement(ET.SubElement(root, "keyframe"), "key", name="home", qpos=home)
        return xml_text(root)


@dataclass(frozen=True, eq=False)
class _Source:
    """Input of an export: the robot with its dynamics, all parameters as a table, and notes."""

    opened: OpenedRobot
    parameters: dict[str, object]
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _ArmBodies:
    """The bodies of a parallel robot in an arm's form: number of bodies and joints, labels, joint of each body."""

    count: int
    n: int
    labels: tuple[str, ...]
    coordinates: np.ndarray


@dataclass(frozen=True, eq=False)
class _ArmModel:
    """The part of an arm's model that `find_possible` reads."""

    bodies: _ArmBodies
    columns: tuple[object, ...]
    names: tuple[str, ...]
    inertial: int
    torque_rows: Any


def _side_by_side(model: ParallelModel, bodies: np.ndarray | None) -> tuple[Chain, Any]:
    """Return the bodies of a model in the form that `find_possible` requires (parameters and labels of a serial arm).

    Bodies without known masses become rods of 1 kg each, for a leg between its joints.
    """
    labels = tuple(name.removeprefix(STANDARD[0]) for name in model.names[: model.inertial : 10])
    count = len(labels) - len(model.payloads)
    if bodies is None:
        rods = [pseudo_inertia.ball(1.0, RADIUS)] * count
        legs = model.mechanism.robot.legs[: 1 if model.identical_legs else None]
        count_of_rods = 0
        for leg in legs:
            for frame in _next_frames(leg)[: leg.bodies]:
                rods[count_of_rods] = pseudo_inertia.rod(1.0, frame[:3, 3], RADIUS / 4)
                count_of_rods += 1
        bodies = np.array(rods)
    rows = bodies.reshape(-1, 10)[:count]
    joints = tuple(Joint(label) for label in labels[:count])
    elements = tuple(Element(joint.name, "rz", joint=k, owner=k) for k, joint in enumerate(joints))
    chain = Chain(model.mechanism.robot.name, joints, elements, inertias=rows)
    coordinates = np.array([*range(count), *[-1] * len(model.payloads)])
    n = int(model.mechanism.robot.starts[-1])
    arm_bodies = _ArmBodies(len(labels), n, labels, coordinates)
    return chain, _ArmModel(arm_bodies, model.columns, model.names, model.inertial, model.torque_rows)


def _next_frames(leg: Leg) -> np.ndarray:
    """Return the frame (n, 4, 4) of what follows each link of a leg, in the link's frame, at home."""
    frames = joint_frames(leg.chain, leg.home[None])[:, 0]
    return np.concatenate([invert(frames[:-1]) @ frames[1:], leg.chain.tail[None]])


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
    covariance = possible.covariance[np.ix_(model.owners, model.owners)]
    _, single_arm = _side_by_side(single, single.known_parameters())
    drives = drive_table(Dynamics(single_arm, values), covariance)
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
    if drives.left or np.any(drives.values[:, 3]):
        notes.append(f"not in URDF and MJCF, but in parameters.json: {', '.join(('offsets', *drives.left))}")
    if model.payloads:
        notes.append(f"payloads are not part of the robot: {', '.join(model.payloads)} are in parameters.json alone")
    return _Source(OpenedRobot(single, values, drives), {"dynamics": table}, tuple(notes))


def _consistency(possible: PossibleBodies, count: int) -> str:
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
    names, units, values = [], [], []
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
    check_export_target(
        into, [robot.source, *(folder / name for name in (ROBOT, METRICS, MODEL, ESTIMATE, COVARIANCE))]
    )
    if result.identification is not None:
        source = _identified(robot, folder, prior)
    else:
        source = _calibrated(robot, folder)
    opened = source.opened
    level = result.verdict.level
    verdict = "" if level == NOT_JUDGED else str(result.verdict)
    if level == "fail":
        verdict += "; do not use"
    remark = verdict if level in ("marginal", "fail") else ""
    texts = {URDF: opened.urdf(), MJCF: opened.mjcf()}
    for name, text in texts.items():
        _check(opened, text, name)

    def write(target: Path) -> None:
        robot.write(target)
        for name, text in texts.items():
            if name == URDF:
                content = with_comment(text.encode(), "its loops are closed by robot.yaml")
            else:
                content = text.encode()
            files.write(target / name, with_comment(content, remark) if remark else content)
        files.write(target / CLOSURES, opened.closures())
        write_drives(opened.joints, opened.drives, target / DRIVES)
        files.write_json(target / PARAMETERS, {"robot": robot.chain.name, **source.parameters})
        files.write(target / README, "\n".join([verdict or "verdict unknown", "", *_uses(), ""]))

    write_staged(into, tuple(USES), write)
    files_written = f"{URDF} ({len(opened.closing)} loops open, closed by {CLOSURES}), {MJCF} (loops closed)"
    message = f"{files_written}; Pinocchio reads the same loops and forces to 1e-9"
    return (*([remark] if remark else []), message, *source.notes)


def check_export_target(out: Path, inputs: Iterable[str | Path | None] = ()) -> None:
    """Raise UsageError if an output folder has other content or contains an input file."""
    check_target(out, tuple(USES), (PARAMETERS,), "export", inputs)


def _uses() -> Iterator[str]:
    return (f"{name}: {use}" for name, use in USES.items() if use)


def _check(opened: OpenedRobot, text: str, where: str, postures: int = 5) -> None:
    """Raise RobotError if Pinocchio computes open loops or other forces on the platform on random motion."""
    mechanism = opened.mechanism
    rng = np.random.default_rng(0)
    r = opened.mechanism.robot.r
    mjcf = where.endswith(".xml")
    coordinates = rng.uniform(mechanism.robot.lower, mechanism.robot.upper, (postures, r))
    posture = mechanism.place(0.9 * coordinates)
    rate, change = rng.uniform(-1.0, 1.0, (2, postures, r))
    motion = of_platform(mechanism, posture, rate, change)
    inertial = opened.values[: opened.model.inertial]
    rigid = np.concatenate([inertial, np.zeros(len(opened.model.terms))])
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
            end_name = f"{leg.name}_end_tip" if mjcf else f"{leg.name}_end"
            gap = invert(frames[end_name]) @ frames[f"{leg.name}_attachment"] - np.eye(4)
            # A leg that ends in a point holds the position alone.
            if leg.end != "rigid":
                gap = gap[:, 3]
            gap_size = max(gap_size, float(np.abs(gap).max()))
    if gap_size > MAX_DIFFERENCE:
        raise RobotError(
            f"{where}: loops stay {gap_size:.2g} m (or rad) open when Pinocchio reads it; nothing was written: "
            "report this as a bug"
        )
    largest = max(1.0, float(np.abs(expected).max()))
    off = float(np.abs(forces - expected).max()) / largest
    if off > MAX_DIFFERENCE:
        raise RobotError(
            f"{where}: forces differ by {off:.2g} of the largest when Pinocchio reads it; nothing was written: "
            "report this as a bug"
        )


def _models(text: str) -> list[NativeModel]:
    """Return Pinocchio's models of each leg and of a floating platform of an MJCF text: Pinocchio reads one tree at a
    time.

    The keyframe is left out, since Pinocchio requires cosine and sine for joints without limits.
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
    """Return the forces (r,) on the platform's coordinates in sample m by a Pinocchio model; adds to `frames`."""
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
            if joint.nq == 1:
                q[joint.idx_q : joint.idx_q + joint.nq] = [value]
            else:
                q[joint.idx_q : joint.idx_q + joint.nq] = [np.cos(value), np.sin(value)]
            v[joint.idx_v] = motion.v[m, j]
            a[joint.idx_v] = motion.a[m, j]
            J[joint.idx_v] = motion.jacobians.joints[m, j]
    for k, joint in enumerate(model.joints):
        if joint.nv == 6:
            pose = motion.posture.pose[m]
            drive = slice(joint.idx_v, joint.idx_v + 6)
            turn = np.kron(np.eye(2), pose[:3, :3].T)
            if "platform_floating" in model.names:
                placed = model.jointPlacements[k].homogeneous
            else:
                placed = np.eye(4)
            q[joint.idx_q : joint.idx_q + 7] = pin.SE3ToXYZQUAT(pin.SE3(invert(placed) @ pose))
            v[drive] = turn @ motion.twist[m]
            a[drive] = turn @ motion.change[m]
            J[drive] = turn @ motion.jacobians.platform[m]
            # Pinocchio's accelerations are spatial
            linear, angular = np.split(v[drive], 2)
            a[drive] -= [*np.cross(angular, linear), 0.0, 0.0, 0.0]
    pin.framesForwardKinematics(model, data, q)
    for k, frame in enumerate(model.frames):
        frames[frame.name] = data.oMf[k].homogeneous.copy()
    return J.T @ pin.rnea(model, data, q, v, a)
