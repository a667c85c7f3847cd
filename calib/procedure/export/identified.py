"""Preparation of an identification for export: estimate, physically consistent parameters, and remarks."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib.dynamics.bodies import Bodies, bodies_of
from calib.dynamics.drives import DriveTerm
from calib.errors import finding
from calib.identification.model_file import MODEL, refuse_currents
from calib.identification.possible.information import Information
from calib.identification.possible.information import read as read_information
from calib.identification.possible.solve import PossibleBodies, find_possible
from calib.identification.prediction import Dynamics
from calib.procedure.dynamic_stage.folder import IdentificationFolder, read_torques
from calib.procedure.export import geometry
from calib.procedure.findings import lines_of
from calib.robot.calibrated import CalibratedChain, nominal_of
from calib.robot.chain import Chain
from calib.robot.description import impossible_bodies

MAX_MASS_RATIO = 3.0  # times a body's mass in the description from which on it is named (our choice)


PLAIN = {"acceleration": 0, "velocity": 1, "sign": 2, "one": 3}


@dataclass(frozen=True, eq=False)
class Drives:
    """Drive terms that fit a table, and those that do not.

    Attributes:
        values: (n, 4) armature [kg m² or kg], damping [N m s/rad or N s/m], friction, offset [N m or N].
        left: names of terms that do not fit the table: richer friction.
        couplings: (c, 4) the same values for motors that turn with two joints (`calib.dynamics.drives.coupled`).
        pairs: (c,) their joints, from 0, and the weight of the second: 1 for the sum, -1 for the difference.
        sigma: (n + c, 4) of all values; None where no covariance is known.
    """

    values: np.ndarray
    left: tuple[str, ...]
    couplings: np.ndarray
    pairs: tuple[tuple[int, int, float], ...] = ()
    sigma: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class IdentifiedRobot:
    """Identified robot with physically consistent bodies, ready for export.

    Attributes:
        robot: the geometry, with that before calibration.
        information: the estimate.
        found: all its parameters, of physically consistent bodies.
        bodies: (B, 10) of the arm's bodies, without payloads.
        drives: by joint.
    """

    robot: CalibratedChain
    information: Information
    found: PossibleBodies
    bodies: np.ndarray
    drives: Drives

    @property
    def chain(self) -> Chain:
        return self.robot.chain

    @property
    def arm(self) -> Bodies:
        """Bodies of the arm with the gravity of the identification."""
        return bodies_of(self.chain).with_gravity(self.found.dynamics.model.bodies.gravity)


def is_identified(folder: Path) -> bool:
    """Return whether a folder is that of an identification."""
    return (folder / MODEL).is_file()


def read(folder: Path, prior: str = "entropic") -> IdentifiedRobot:
    """Return the robot of an identification's folder, made physically consistent by a prior (`find_possible`)."""
    refuse_currents(folder, "an export of masses")
    information = read_information(folder)
    found = find_possible(information, prior=prior)
    own = bodies_of(information.chain).count
    bodies = found.dynamics.values[: 10 * own].reshape(own, 10)
    table = drive_table(found.dynamics, found.covariance)
    return IdentifiedRobot(geometry.read(folder), information, found, bodies, table)


@dataclass(frozen=True)
class ExportedPrediction:
    """Unexplained share of the torque [%] on a recording: by the exported robot, and by the identified model."""

    file: str
    exported: float
    identified: float

    def __str__(self) -> str:
        return (
            f"the exported robot (with drives.csv) leaves {self.exported:.2f} % of the torque unexplained, the "
            f"identified model {self.identified:.2f} % ({self.file})"
        )


def exported_prediction(given: IdentifiedRobot, folder: Path) -> ExportedPrediction | None:
    """Return the torque prediction error of the exported robot, on the worst recording in `folder`.

    None where these recordings carry payloads or are by a version that did not keep their speeds.
    """
    dynamics, found = without_left(given.found.dynamics), []
    for path in IdentificationFolder(folder).torques:
        motion = read_torques(path) if path.is_file() else {}
        if not motion:
            continue
        torque = dynamics.model.torque(dynamics.values, motion["q"], motion["v"], motion["a"], ())
        size = np.linalg.norm(motion["measured"]) / 100.0
        left = [float(np.linalg.norm(motion["measured"] - one) / size) for one in (torque, motion["predicted"])]
        found.append(ExportedPrediction(str(path.relative_to(folder)), *left))
    return max(found, key=lambda one: one.exported, default=None)


def notes_of(given: IdentifiedRobot) -> list[str]:
    """Return findings on the exported inertias and masses, and on parameters that no robot file contains."""
    solved, chain, bodies = given.found, given.chain, given.found.dynamics.model.bodies
    masses, theirs = given.bodies[:, 9], [] if chain.inertias is None else chain.inertias[:, 9]
    found = [
        finding(
            "inertias", distance=solved.distance, count=given.information.b, allowed=solved.allowed,
            source=solved.source, weight=solved.weight, prior=solved.prior, thinnest=solved.margins.min(),
        )
    ]  # fmt: skip
    if not solved.possible:
        blamed = [f"{name} (without it {left:.3g})" for name, left in solved.blamed]
        found.append(finding("inertias-inconsistent", nearest=solved.nearest, allowed=solved.allowed, blamed=blamed))
    found.append(finding("masses-written", masses=[f"{mass:.3g}" for mass in masses]))
    rows = [row for row in zip(chain.joint_names, masses, theirs) if max(row[1:]) > MAX_MASS_RATIO * min(row[1:])]
    offsets = ["offsets"] if np.any(given.drives.values[:, 3]) else []
    optional = {
        "masses-unlike": [f"{name} {mass:.3g} kg ({stated:.3g})" for name, mass, stated in rows],
        "description-inconsistent": impossible_bodies(chain),
        "urdf-without-motor-inertias": given.drives.values[:, 0].nonzero()[0],
        "only-in-parameters": [*offsets, *given.drives.left],
        "payload-not-exported": [label for label, c in zip(bodies.labels, bodies.coordinates) if c < 0],
    }
    found += [finding(code, names=names, times=MAX_MASS_RATIO) for code, names in optional.items() if len(names)]
    return [*lines_of(found), *solved.notes]


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


def without_left(dynamics: Dynamics) -> Dynamics:
    """Return an identified model without the terms that do not fit the table."""
    left, first = drive_table(dynamics).left, dynamics.model.inertial
    values = np.array(dynamics.values)
    values[[first + k for k, one in enumerate(dynamics.model.columns) if one.name in left]] = 0.0
    return Dynamics(dynamics.model, values)


def drive_table(dynamics: Dynamics, covariance: np.ndarray | None = None) -> Drives:
    """Return the drive parameters of an identified model by joint, motor side plus link side.

    Args:
        dynamics: the model.
        covariance: of all its parameters.
    """
    model = dynamics.model
    n, left = model.bodies.n, []
    pairs = tuple(dict.fromkeys(pair for one in model.columns if (pair := _pair(one)) is not None))
    values = np.zeros((n + len(pairs), 4))
    adds = np.zeros((*values.shape, len(dynamics.values)))
    for k, (one, value) in enumerate(zip(model.columns, dynamics.values[model.inertial :]), model.inertial):
        if not one.acts or value == 0.0:
            continue
        if one.shape in PLAIN and one.joint is not None:
            values[one.joint, PLAIN[one.shape]] += value
            adds[one.joint, PLAIN[one.shape], k] = 1.0
        elif (pair := _pair(one)) is not None:
            values[n + pairs.index(pair), PLAIN[one.shape]] = value
            adds[n + pairs.index(pair), PLAIN[one.shape], k] = 1.0
        else:
            left.append(one.name)
    if covariance is None:
        return Drives(values[:n], tuple(left), values[n:], pairs)
    variance = np.einsum("nki,ij,nkj->nk", adds, covariance, adds)
    return Drives(values[:n], tuple(left), values[n:], pairs, np.sqrt(np.clip(variance, 0.0, None)))


def _pair(one: DriveTerm) -> tuple[int, int, float] | None:
    """Return the joints that a term couples and the weight of the second; None for any other term."""
    if one.shape not in PLAIN or len(one.acts) != 2:
        return None
    (first, motion), (second, _) = one.acts
    weights = dict(motion)
    return None if second not in weights else (first, second, weights[second])
