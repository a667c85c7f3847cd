"""Identified masses in the geometric fit: its compliance is fitted to their gravity torques, not to the description's.

    fit → identify → fit with the identified masses → identify → …

until neither geometry nor dynamics moves by more than `MAX_MOVE` of its σ. A session does so by itself, for fits with
compliance or sag, up to ``rounds`` of ``[fit]``: ``8-masses`` holds the identification whose masses the fit uses, and
its change makes the fit, and what follows it, stale; so an interrupted session goes on where it was. By command:
``calib fit ROBOT MEASURED --masses FOLDER``, ``calib identify``, and again.

The fit takes the masses as exact: the share of the compliance's σ that comes from theirs is left out.
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
    """Return the largest |Δ| / σ of the parameters of two folders with an estimate; infinite for other parameters."""
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
    """Hand the masses that a session has just identified to its fit, if that would still change; return notes.

    The fit takes them where it has compliance or sag; its step is then stale.
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
