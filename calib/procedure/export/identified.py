"""An identification made ready for export: its estimate, all parameters of possible bodies, and what to say of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.dynamics.bodies import Bodies, bodies_of
from calib.identification.friction.drive_table import Drives, drive_table, without_left
from calib.identification.model_file import MODEL, refuse_currents
from calib.identification.possible.information import Information
from calib.identification.possible.information import read as read_information
from calib.identification.possible.solve import PossibleBodies, find_possible
from calib.procedure.dynamic_stage.folder import IdentificationFolder, read_torques
from calib.procedure.export import geometry
from calib.robot.calibrated import CalibratedChain
from calib.robot.chain import Chain
from calib.robot.description_checks import impossible_bodies
from calib.words import listing

MAX_MASS_RATIO = 3.0  # times a body's mass in the description from which on it is named (our choice)


@dataclass(frozen=True, eq=False)
class IdentifiedRobot:
    """An identified robot, ready to be written.

    Attributes:
        robot: the geometry, with that before calibration.
        information: the estimate.
        found: all its parameters, of possible bodies.
        bodies: (B, 10) of the arm's own bodies, payloads left out.
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
        """The arm's bodies under the gravity it was identified with."""
        return bodies_of(self.chain).with_gravity(self.found.dynamics.model.bodies.gravity)


def is_identified(folder: Path) -> bool:
    """Say whether a folder is that of an identification."""
    return (folder / MODEL).is_file()


def read(folder: Path, prior: str = "entropic") -> IdentifiedRobot:
    """Return what an identification left, all parameters made those of possible bodies by a prior (`find_possible`)."""
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
    """Return how well the exported robot predicts torques, of the worst recording beside the model in `folder`.

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


def consistency_lines(found: PossibleBodies, b: int) -> list[str]:
    """Return what consistency cost, in words."""
    lines = [
        f"physically consistent inertias, {found.distance:.3g} σ from the estimate of {b} parameters (limit "
        f"{found.allowed:.3g}); regularised towards {found.source}, weight {found.weight:.3g}, {found.prior} prior; "
        f"thinnest body {1e3 * float(found.margins.min()):.3g} mm (as a standard deviation)"
    ]
    if not found.possible:
        blamed = ", ".join(f"{name} (without it {left:.3g})" for name, left in found.blamed)
        lines.append(
            "no physically consistent inertias within the estimate's uncertainty: the nearest are "
            f"{found.nearest:.3g} σ away (limit {found.allowed:.3g}), mostly by {blamed}: unmodelled friction, gains "
            "or a payload, or σ too small"
        )
    return [*lines, *found.notes]


def mass_notes(given: IdentifiedRobot) -> list[str]:
    """Return what the bodies written weigh, how that compares with the description's, and what of these cannot be."""
    names, masses = given.chain.joint_names, given.bodies[:, 9]
    notes = [f"masses written, behind each joint: {', '.join(f'{mass:.3g}' for mass in masses)} kg"]
    if given.chain.inertias is not None:
        theirs = given.chain.inertias[:, 9]
        pairs = zip(names, masses, theirs)
        unlike = [
            f"{name} {mass:.3g} kg ({own:.3g})"
            for name, mass, own in pairs
            if max(mass, own) > MAX_MASS_RATIO * min(mass, own)
        ]
        if unlike:
            notes.append(
                f"masses unlike the robot's description by more than {MAX_MASS_RATIO:g} times (that in brackets): "
                f"{', '.join(unlike)}; torques identify sums of masses, not each"
            )
    if wrong := impossible_bodies(given.chain):
        notes.append(f"the robot's own description is not physically consistent: {'; '.join(wrong)}")
    return notes


def drive_notes(given: IdentifiedRobot) -> list[str]:
    """Return what of the drives and payloads is in none of the robot files."""
    notes = []
    if np.any(given.drives.values[:, 0]):
        notes.append(
            "URDF has no place for motor inertias: robot.urdf is without them, drives.csv and robot.xml are not"
        )
    if np.any(given.drives.values[:, 3]) or given.drives.left:
        names = [*(["offsets"] if np.any(given.drives.values[:, 3]) else []), *given.drives.left]
        notes.append(f"in parameters.json alone: {listing(names, 8)}")
    carried = given.found.dynamics.model.bodies
    if payloads := [label for label, c in zip(carried.labels, carried.coordinates) if c < 0]:
        notes.append(f"payload {', '.join(payloads)} is not part of the robot: in parameters.json alone")
    return notes
