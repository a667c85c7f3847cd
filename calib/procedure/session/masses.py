"""Identified masses in the geometric fit: its compliance is fitted to gravity torques of the identified masses.

Without this iteration, the gravity torques are those of the masses in the robot's description. The iteration is

    fit → identify → fit with the identified masses → identify → …

until no parameter of geometry or dynamics changes by more than `MAX_MOVE` of its σ. Sessions do this automatically for
fits with compliance or sag, up to ``rounds`` times (section ``[fit]``). The folder ``8-masses`` contains the
identification whose masses the fit uses. If this folder changes, the fit and all later steps are repeated, so that an
interrupted session can be continued. The commands are ``calib fit ROBOT MEASURED --masses FOLDER`` and ``calib
identify``, in turn.

The fit regards the masses as exact: the σ of the compliance does not include the uncertainty of the masses.
"""

import shutil
from pathlib import Path

from calib.files import write_json
from calib.folders import ESTIMATE, read_estimate
from calib.identification.model_file import MODEL, read_table
from calib.procedure.session.folder import MASSES, Session
from calib.records import read_json
from calib.robot import calibrated
from calib.units import TORQUE

# of a parameter's σ
MAX_MOVE = 0.1
ROUNDS = "rounds.json"


def largest_move(before: Path, after: Path) -> float:
    """Return the largest change of a parameter between two result folders, in units of the parameter's σ.

    Infinite if the folders have other parameters, or if the first folder has no estimate.

    Args:
        before, after: folders with ``estimate.csv``.
    """
    if not (before / ESTIMATE).is_file():
        return float("inf")
    old = {row.name: row for row in read_estimate(before)}
    new = {row.name: row for row in read_estimate(after)}
    if old.keys() != new.keys():
        return float("inf")
    largest = 0.0
    for name, parameter in new.items():
        if parameter.sigma:
            largest = max(largest, abs(parameter.value - old[name].value) / parameter.sigma)
    return largest


def return_masses(session: Session) -> list[str]:
    """Copy the identified masses into the folder from which the fit reads them, if they would still change the fit.

    Nothing is done unless the fit has compliance or sag. After copying, the session's fit is repeated.

    Returns:
        Notes for the user.
    """
    limit = session.settings.fit.rounds
    record_path = session.path(MASSES)
    identification = session.identification.path
    if not limit or not session.geometric or read_table(identification).get("unit", TORQUE) != TORQUE:
        return []
    if not {"torque", "lever"} & {term.basis for term in calibrated.read(session.fit.path).deflection.terms}:
        return []
    record = record_path / ROUNDS
    rounds = 0
    if record.is_file():
        rounds = read_json(record, "calib redo fit", dict[str, int])["rounds"]
    geometry = largest_move(record_path / "geometry", session.fit.path)
    dynamics = largest_move(record_path, identification)
    message = f"the geometry has changed by {geometry:.2g} σ, the dynamics by {dynamics:.2g} σ"
    if not (record_path / MODEL).is_file():
        message = "the compliance was fitted to the description's masses"
    settled = max(geometry, dynamics) <= MAX_MOVE
    if settled or rounds >= limit:
        write_json(record, {"rounds": 0})
        end = "converged" if settled else f"not converged, stopped by rounds = {limit}"
        return [f"identified masses in the fit's gravity torques: after {rounds} rounds {message}: {end}"]
    (record_path / "geometry").mkdir(parents=True, exist_ok=True)
    shutil.copy(session.fit.path / ESTIMATE, record_path / "geometry")
    write_json(record, {"rounds": rounds + 1})
    # the last is what the fit depends on
    for name in (calibrated.ROBOT, ESTIMATE, MODEL):
        shutil.copy(identification / name, record_path)
    return [f"the identified masses are used in the fit again, round {rounds + 1} of at most {limit}: {message}"]
