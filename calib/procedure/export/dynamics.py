"""The identified dynamics in the forms other programs read; each file is read back before it is put in place.

``calib export IDENTIFIED --into DIR [--urdf SOURCE.urdf]`` writes, from the folder of an identification,

robot.urdf            the source with calibrated joint origins, masses and friction; comments, meshes, limits, all else
                      as it was. ``<inertial>`` of a link: origin at its centre of mass, axes of the link.
                      ``<dynamics damping friction>``: Fv and Fc. URDF has no place for motor inertia: see drives.csv.
robot.xml             MJCF for MuJoCo: bodies, armature (Ia), damping (Fv), frictionloss (Fc); no meshes.
drives.csv            joint, armature, damping, friction, offset, and the sigma of each: for simulators that take them;
                      by hand. A sigma is empty where the model has no such term. Then a row per coupling, as
                      "joint5 + joint6", of a motor that turns with both.
joint_origins.yaml    with --urdf: origins as tesseract reads them, ``<calibration_config filename=.../>`` in the SRDF:
                      calibration / joints / name / position x y z [m], orientation x y z w.
parameters.json       names, units, values and covariances of geometry and dynamics, base and standard parameters, what
                      consistency cost, and ``prediction``: unexplained torque [%] by the exported robot (robot.urdf
                      with drives.csv) and by the identified model, at the samples of the ``torques_N.csv`` named there.
README.txt            what each file is for, and the verdict on it.

Masses are those of physically consistent bodies (`calib.identification.possible.solve`). What the torques do not
identify is regularised towards the masses of the robot's description: by the entropic (log-det) prior, which keeps off
the border of the physically consistent; with ``--prior euclidean`` by its second order, which does not, so that a body
may come out thin. A link to which others are fixed (flange, covers, sensors) is identified with them as one body: the
others keep the masses the source gives them, and the moving link takes the rest. Where that rest is not physically
consistent, the moving link takes all and the others get mass zero. Links on joints that are not part of the arm
(fingers) keep theirs, standing at zero. Payloads that were identified are not part of the robot: they are in
parameters.json alone. Offsets, gear couplings and richer friction have no place in URDF and MJCF; parameters.json has
them, and a note says so. The sign of Coulomb friction was smoothed as tanh(v / v0).

``parameters.json``: all parameters of an identified robot with units and covariances.
"""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from calib import files
from calib.folders import DRIVES, JOINT_ORIGINS, MJCF, PARAMETERS, write_staged
from calib.procedure.export.identified import IdentifiedRobot, exported_prediction, notes_of, read
from calib.procedure.export.masses import as_mjcf, as_urdf
from calib.procedure.kinematic_stage.folder import URDF
from calib.robot.calibrated import nominal_of
from calib.robot.formats import urdf_write
from calib.robot.formats.markup import text
from calib.robot.formats.tesseract import joint_origins


def parameters(given: IdentifiedRobot) -> dict[str, Any]:
    """Return the content of ``parameters.json``."""
    estimate, found, chain = given.information, given.found, given.chain
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
            "base": {
                **_columns(estimate.names, estimate.units, estimate.values),
                "covariance": estimate.covariance.tolist(),
            },
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
                "prior": found.prior,
                "sigmas_widened_by": found.doubt,
                "drawn_to": found.source,
                "blamed": dict(found.blamed),
                "notes": list(found.notes),
            },
        },
    }


def _columns(names: Sequence[str], units: Sequence[str], values: np.ndarray) -> dict[str, Any]:
    return {"names": list(names), "units": list(units), "values": np.asarray(values).tolist()}


TABLE = ("joint", "armature", "damping", "friction", "offset", "armature_unit", "damping_unit", "friction_unit")
SIGMAS = ("armature_sigma", "damping_sigma", "friction_sigma", "offset_sigma")
WRITTEN = (URDF, MJCF, DRIVES, JOINT_ORIGINS, PARAMETERS)


def deliver_dynamics(identified: Path, source: Path | None, out: Path, prior: str = "entropic") -> list[str]:
    """Write the identified robot into `out`, in all forms (see the module).

    Args:
        identified: the folder of an identification.
        source: a URDF of the nominal robot; None: a URDF is written anew from the chain.
        out: folder for the files.
        prior: what the torques do not identify is regularised towards, see
        `calib.identification.possible.solve.PRIORS`.

    Returns:
        What was written, and what to know of it, in words.

    Raises:
        RobotError: where a file does not read back as the robot; nothing is written.
    """
    given = read(identified, prior)
    content, encoding = (urdf_write.write_new(given.chain), "utf-8") if source is None else text(source)
    where = "the chain's own URDF" if source is None else str(source)
    edited, notes = as_urdf(given, content, where, given.chain if source is None else nominal_of(given.robot))
    model, known = as_mjcf(given), exported_prediction(given, identified)

    def write(staging: Path) -> None:
        files.write(staging / URDF, edited.encode(encoding))
        files.write(staging / MJCF, model)
        _export_drives(given, staging / DRIVES)
        files.write_json(staging / PARAMETERS, parameters(given) | {"prediction": known and asdict(known)})
        if source is not None:
            files.write(staging / JOINT_ORIGINS, joint_origins(content, edited, where))

    write_staged(out, WRITTEN, write)
    lines = [
        *([str(known)] if known else []),
        "robot.urdf: joint origins, masses and friction; Pinocchio reads the same poses and torques to 1e-9",
        "robot.xml: MJCF with armature, damping and frictionloss; Pinocchio reads the same poses and torques to 1e-9",
        "drives.csv, parameters.json" + ("" if source is None else ", joint_origins.yaml (tesseract's SRDF)"),
    ]
    return [*lines, *notes_of(given), *notes]


def _export_drives(given: IdentifiedRobot, out: Path) -> Path:
    """Write the drives' table."""
    joints, pairs = given.chain.joints, given.drives.pairs
    named = [(joint.name, joint) for joint in joints]
    named += [(f"{joints[i].name} {'+' if w > 0 else '-'} {joints[j].name}", joints[i]) for i, j, w in pairs]
    rows, values = [], np.vstack([given.drives.values, given.drives.couplings])
    sigmas = np.zeros(values.shape) if given.drives.sigma is None else given.drives.sigma
    for (name, joint), row, sigma in zip(named, values, sigmas, strict=True):
        linear = joint.kind == "prismatic"
        units = ("kg", "N s/m", "N") if linear else ("kg m²", "N m s/rad", "N m")
        rows.append((name, *map(float, row), *units, *(float(one) or None for one in sigma)))
    return files.write_table(out, (*TABLE, *SIGMAS), rows)
