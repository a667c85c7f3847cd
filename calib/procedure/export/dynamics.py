"""The identified dynamics in the forms other programs read; each file is read back before it is put in place.

``calib export IDENTIFIED --into DIR [--urdf SOURCE.urdf]`` writes, from the folder of an identification,

robot.urdf            the source with calibrated joint origins, masses and friction; comments, meshes, limits, all else
                      as it was. ``<inertial>`` of a link: origin at its centre of mass, axes of the link.
                      ``<dynamics damping friction>``: Fv and Fc. URDF has no place for motor inertia: see drives.csv.
robot.xml             MJCF for MuJoCo: bodies, armature (Ia), damping (Fv), frictionloss (Fc); no meshes.
drives.csv            joint, armature, damping, friction, offset: for simulators that take them by hand.
joint_origins.yaml    with --urdf: origins as tesseract reads them, ``<calibration_config filename=.../>`` in the SRDF:
                      calibration / joints / name / position x y z [m], orientation x y z w.
parameters.json       names, units, values and covariances of geometry and dynamics, base and standard parameters, and
                      what consistency cost.

Masses are those of bodies that can exist (`calib.identification.possible.solve`). A link to which others are fixed
(flange,
covers, sensors) was identified with them as one body: the others keep the masses the source gives them, and the moving
link takes the rest. Where that rest is no possible body, the moving link takes all and the others get mass zero. Links
on joints that are not part of the arm (fingers) keep theirs, standing at zero. Payloads that were identified are not
part of the robot: they are in parameters.json alone. Offsets, gear couplings and richer friction have no place in URDF
and MJCF; parameters.json has them, and a note says so. The sign of Coulomb friction was smoothed as tanh(v / v0).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib import files
from calib.dynamics import pseudo_inertia, rigid_body
from calib.dynamics.bodies import Bodies, bodies_of, with_gravity
from calib.errors import RobotError, UsageError
from calib.identification.friction.drive_table import Drives, drive_table
from calib.identification.model_file import MODEL, refuse_currents
from calib.identification.possible.information import Information
from calib.identification.possible.information import read as read_told
from calib.identification.possible.solve import Consistent, find_consistent
from calib.procedure.export import geometry
from calib.procedure.kinematic_stage.folder import URDF
from calib.robot.calibrated import CalibratedChain, nominal_of
from calib.robot.chain import Chain, random_joints
from calib.robot.formats import mjcf, urdf, urdf_inertials, urdf_write
from calib.robot.formats.markup import text
from calib.robot.formats.readback import motion_torques
from calib.robot.formats.urdf_tree import UrdfTree, transform_body
from calib.robot.formats.urdf_tree import read as read_tree
from calib.transforms import invert

SAME = 1e-9  # of poses [m, and as a rotation matrix] and of torques, relative to the largest
TABLE = ("joint", "armature", "damping", "friction", "offset", "armature_unit", "damping_unit", "friction_unit")
MJCF = "robot.xml"
WRITTEN = (URDF, MJCF, "drives.csv", "joint_origins.yaml", "parameters.json")


@dataclass(frozen=True, eq=False)
class Exported:
    """An identified robot, ready to be written.

    Attributes:
        robot: the geometry, with that before calibration.
        told: the estimate.
        found: all its parameters, of possible bodies.
        bodies: (B, 10) of the arm's own bodies, payloads left out.
        drives: by joint.
    """

    robot: CalibratedChain
    told: Information
    found: Consistent
    bodies: np.ndarray
    drives: Drives

    @property
    def chain(self) -> Chain:
        return self.robot.chain

    @property
    def arm(self) -> Bodies:
        """The arm's bodies under the gravity it was identified with."""
        return with_gravity(bodies_of(self.chain), self.found.dynamics.model.bodies.gravity)


def is_identified(folder: Path) -> bool:
    """Say whether a folder is that of an identification."""
    return (folder / MODEL).is_file()


def read(folder: Path) -> Exported:
    """Return what an identification left, with all parameters made those of possible bodies."""
    refuse_currents(folder, "an export of masses")
    told = read_told(folder)
    found = find_consistent(told)
    own = bodies_of(told.chain).count
    bodies = found.dynamics.values[: 10 * own].reshape(own, 10)
    return Exported(geometry.read(folder), told, found, bodies, drive_table(found.dynamics))


def deliver_dynamics(identified: Path, source: Path | None, out: Path) -> list[str]:
    """Write the identified robot into `out`, in all forms (see the module).

    Args:
        identified: the folder of an identification.
        source: a URDF of the nominal robot; None: a URDF is written anew from the chain.
        out: folder for the files.

    Returns:
        What was written, and what to know of it, in words.

    Raises:
        RobotError: where a file does not read back as the robot; files before it are whole, it is not written.
    """
    given = read(identified)
    content, encoding = (urdf_write.write_new(given.chain), "utf-8") if source is None else text(source)
    where = "the chain's own URDF" if source is None else str(source)
    edited, notes = with_dynamics(given, content, where, given.chain if source is None else nominal_of(given.robot))
    model = mjcf.text(given.chain, given.bodies, *given.drives.values.T[:3])
    check_mjcf(given, model)
    out.mkdir(parents=True, exist_ok=True)
    files.write(out / URDF, edited.encode(encoding))
    files.write(out / MJCF, model)
    export_drives(given, out / "drives.csv")
    export_parameters(given, out / "parameters.json")
    if source is None:
        (out / "joint_origins.yaml").unlink(missing_ok=True)
    else:
        files.write(out / "joint_origins.yaml", joint_origins(content, edited, where))
    lines = [
        "robot.urdf: joint origins, masses and friction; Pinocchio reads the same poses and torques to 1e-9",
        "robot.xml: MJCF with armature, damping and frictionloss; Pinocchio reads the same poses and torques to 1e-9",
        "drives.csv, parameters.json" + ("" if source is None else ", joint_origins.yaml (tesseract's SRDF)"),
    ]
    return [*lines, *consistency_lines(given.found, given.told.b), *notes, *drive_notes(given)]


def consistency_lines(found: Consistent, b: int) -> list[str]:
    """Return what consistency cost, in words."""
    lines = [
        f"masses of possible bodies: thinnest {1e3 * float(found.margins.min()):.3g} mm (as a standard deviation), "
        f"{found.distance:.3g} sigmas from the estimate of {b} parameters (95 %: {found.allowed:.3g}); drawn to "
        f"{found.source}, weight {found.weight:.3g} by the evidence"
    ]
    if not found.possible:
        blamed = ", ".join(f"{name} (without it {left:.3g})" for name, left in found.blamed)
        lines.append(
            f"THE ESTIMATE IS THAT OF NO POSSIBLE ROBOT: the nearest one is {found.nearest:.3g} sigmas away, beyond "
            f"{found.allowed:.3g}; most of it by {blamed}. The model does not tell all that the torques hold "
            "(friction, gains, a payload), or the sigmas are too small"
        )
    return [*lines, *found.notes]


def drive_notes(given: Exported) -> list[str]:
    """Return what of the drives and payloads is in none of the robot files."""
    notes = []
    if np.any(given.drives.values[:, 0]):
        notes.append(
            "URDF has no place for motor inertias: robot.urdf is without them, drives.csv and robot.xml are not"
        )
    if np.any(given.drives.values[:, 3]) or given.drives.left:
        names = [*(["offsets"] if np.any(given.drives.values[:, 3]) else []), *given.drives.left]
        more = f" and {len(names) - 8} more" if len(names) > 8 else ""
        notes.append(f"in parameters.json alone: {', '.join(names[:8])}{more}")
    carried = given.found.dynamics.model.bodies
    if payloads := [label for label, c in zip(carried.labels, carried.coordinates) if c < 0]:
        notes.append(f"payload {', '.join(payloads)} is not part of the robot: in parameters.json alone")
    return notes


def with_dynamics(given: Exported, content: str, where: str, nominal: Chain) -> tuple[str, list[str]]:
    """Return the URDF text with calibrated origins, masses and friction, read back, and notes."""
    chain = given.chain
    calibrated_text = urdf_write.edit(content, nominal, chain, where)
    tree = read_tree(calibrated_text, where)
    own = _own_chain(tree, chain)
    links, notes = _link_bodies(given, tree, own)
    names = own.joint_names
    friction = {name: (float(row[1]), float(row[2])) for name, row in zip(names, given.drives.values)}
    edited = urdf_inertials.put(calibrated_text, where, links, friction)
    geometry.check_readback(edited, where, chain)
    _check(given, edited, own, where)
    return edited, notes


def check_mjcf(given: Exported, model: str) -> None:
    """Refuse an MJCF in which Pinocchio sees other poses, torques or drives."""
    _check(given, model, given.chain, MJCF, mjcf=True)


def joint_origins(source: str, edited: str, where: str) -> str:
    """Return tesseract's calibration YAML: the origins of all joints that the calibration moved."""
    before, after = read_tree(source, where), read_tree(edited, where)
    lines = ["# For <calibration_config filename=.../> in the SRDF of the nominal robot; m, unit quaternions.",
             "calibration:", "  joints:"]  # fmt: skip
    for name, joint in after.joints.items():
        if np.array_equal(joint.origin, before.joints[name].origin):
            continue
        turn = Rotation.from_matrix(joint.origin[:3, :3]).as_quat()
        if np.abs(Rotation.from_quat(turn).as_matrix() - joint.origin[:3, :3]).max() > SAME:
            raise RobotError(f"{where}: the origin of joint '{name}' is no rotation")
        lines += [f"    {name}:", "      position:"]
        lines += [f"        {key}: {float(x)!r}" for key, x in zip("xyz", joint.origin[:3, 3])]
        lines += ["      orientation:", *(f"        {key}: {float(x)!r}" for key, x in zip("xyzw", turn))]
    return "\n".join(lines if len(lines) > 3 else [*lines[:2], "  joints: {}"]) + "\n"


def export_drives(given: Exported, out: Path) -> Path:
    """Write the drives' table."""
    rows = []
    for joint, row in zip(given.chain.joints, given.drives.values):
        linear = joint.kind == "prismatic"
        units = ("kg", "N s/m", "N") if linear else ("kg m²", "N m s/rad", "N m")
        rows.append((joint.name, *map(float, row), *units))
    return files.write_table(out, TABLE, rows)


def export_parameters(given: Exported, out: Path) -> Path:
    """Write all parameters with units and covariances."""
    return files.write_json(out, parameters(given))


def parameters(given: Exported) -> dict[str, Any]:
    """Return the content of ``parameters.json``."""
    told, found, chain = given.told, given.found, given.chain
    model = found.dynamics.model
    covariance = given.robot.covariance
    return {
        "robot": chain.name,
        "geometry": {
            **_columns(chain.names, chain.units, chain.values),
            "nominal": nominal_of(given.robot).values.tolist(),
            "covariance": None if covariance is None else np.asarray(covariance).tolist(),
        },
        "dynamics": {
            "gravity": model.bodies.gravity.tolist(),
            "rows": model.torque_rows.name,
            "base": {**_columns(told.names, told.units, told.values), "covariance": told.covariance.tolist()},
            "standard": {
                **_columns(model.names, model.units, found.dynamics.values),
                "covariance": found.covariance.tolist(),
                "frames": "about the chain's frame behind each joint (robot.toml), payloads about the tip",
            },
            "consistency": {
                "possible": found.possible,
                "nearest": found.nearest,
                "distance": found.distance,
                "allowed": found.allowed,
                "margins_m": dict(zip(model.bodies.labels, found.margins.tolist())),
                "weight": found.weight,
                "sigmas_widened_by": found.doubt,
                "drawn_to": found.source,
                "blamed": dict(found.blamed),
                "notes": list(found.notes),
            },
        },
    }


def _columns(names: Sequence[str], units: Sequence[str], values: np.ndarray) -> dict[str, Any]:
    return {"names": list(names), "units": list(units), "values": np.asarray(values).tolist()}


def _own_chain(tree: UrdfTree, chain: Chain) -> Chain:
    """Return the chain as the URDF has it, in the frames of its links, under the identified chain's gravity."""
    named = chain.joint_names if chain.joint_names[0] in tree.joints else None
    base = chain.base if chain.base in tree.bodies else None
    own = urdf.build(tree, *urdf.ends(tree, base, chain.tip if chain.tip in tree.bodies else None, named))
    return replace(own, gravity=chain.gravity)


def _link_bodies(given: Exported, tree: UrdfTree, own: Chain) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the inertials to write by link, about the links' frames, and notes."""
    path = [joint for joint in tree.path(own.base, own.tip) if joint.moves]
    zero = np.zeros((1, own.n))
    between = invert(urdf_write.moving_frames(own, zero)[:, 0]) @ urdf_write.moving_frames(given.chain, zero)[:, 0]
    links: dict[str, np.ndarray] = {}
    notes: list[str] = []
    for joint, turn, body in zip(path, between, given.bodies):
        if not body.any():
            continue
        whole = transform_body(body, urdf.align(joint.axis) @ turn)
        fixed, loose = urdf_inertials.hanging(tree, tree.path(own.base, own.tip), joint.child)
        others = {
            name: placed for name, placed in fixed.items() if name != joint.child and tree.bodies[name] is not None
        }
        rest = whole - _sum(tree, loose)
        links[joint.child] = rest - _sum(tree, others)
        if others and not pseudo_inertia.margin(links[joint.child]) > 0.0:
            links |= {joint.child: rest, **{name: np.zeros(10) for name in others}}
            notes.append(
                f"link {joint.child}: with what {', '.join(others)} weigh in the URDF the rest would be no possible "
                "body, so it takes all, and they have mass zero"
            )
        if not pseudo_inertia.margin(links[joint.child]) > 0.0:
            raise RobotError(
                f"{tree.where}: link '{joint.child}' would have to be no possible body, since what hangs on it "
                f"({', '.join(loose)}) is heavier than what was identified: are the drives' gains "
                "known? Correct those masses, or leave --urdf out for all other files"
            )
    return links, notes


def _sum(tree: UrdfTree, placed: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the standard parameters (10,) of links together, as the URDF has them."""
    found = [(tree.bodies[name], pose) for name, pose in placed.items()]
    return sum((transform_body(body, pose) for body, pose in found if body is not None), np.zeros(10))


def _check(given: Exported, source: str, chain: Chain, where: str, mjcf: bool = False) -> None:
    """Compare with what Pinocchio reads: frames and torques of random motion, motor inertia where there is some."""
    rng = np.random.default_rng(0)
    q = random_joints(given.chain, 20, 0)
    v, a = rng.uniform(-1.0, 1.0, (2, *q.shape))
    torques, frames, damping, friction = motion_torques(source, chain, q, v, a, mjcf)
    wanted = rigid_body.inverse_dynamics(given.arm, given.bodies.ravel(), q, v, a)
    if mjcf:
        wanted = wanted + given.drives.values[:, 0] * a
        away = float(np.abs(frames - urdf_write.moving_frames(given.chain, q)).max())
        if away > SAME:
            raise RobotError(f"{where}: Pinocchio reads other poses, by {away:.2g}; nothing was written")
    off = float(np.abs(torques - wanted).max()) / max(1.0, float(np.abs(wanted).max()))
    if off > SAME:
        raise RobotError(
            f"{where}: Pinocchio reads other torques, by {off:.2g} of the largest; nothing was written. Do other "
            "joints of the file carry mass that the arm's identification has not seen?"
        )
    for what, read_back, own in (("damping", damping, 1), ("friction", friction, 2)):
        if not np.allclose(read_back, given.drives.values[:, own], rtol=SAME, atol=1e-12):
            raise RobotError(f"{where}: Pinocchio reads another {what} than was written")


def check_identified(folder: Path) -> None:
    """Refuse a folder that holds no identification, where its dynamics are asked for."""
    if not is_identified(folder):
        raise UsageError(
            f"{folder} holds no identified dynamics (dynamics.json); give the folder that calib identify has written, "
            "or leave --into out"
        )
