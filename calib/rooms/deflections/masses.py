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

import numpy as np

from calib.errors import refuse_option
from calib.files import write_json
from calib.folders import ESTIMATE, read_estimate
from calib.identification.model_file import MODEL, read_dynamics, read_table, refuse_currents, refuse_other_arm
from calib.procedure.session.folder import MASSES, Session
from calib.records import read_json
from calib.robot import calibrated
from calib.robot.chain import Chain
from calib.units import TORQUE

# of a parameter's σ
MAX_MOVE = 0.1
ROUNDS = "rounds.json"


def identified_masses(folder: str | Path, chain: Chain) -> np.ndarray:
    """Return the standard parameters (n, 10) of an arm's bodies from an identification's folder.

    Their gravity torques are right on the geometry that they were identified on, single parameters are not
    (`calib.dynamics.base.to_standard`); payloads are left out.

    Raises:
        UsageError: for an identification of another arm, in amperes, or without bodies.
    """
    folder = Path(folder)
    refuse_currents(folder, "a fit of the compliance")
    refuse_other_arm(folder, chain)
    _, dynamics = read_dynamics(folder)
    bodies = dynamics.model.bodies
    result = np.zeros((chain.n, 10))
    if not dynamics.model.inertial:
        refuse_option(folder, "has identified no bodies, hence no gravity torques; identify with motor or link torques")
    for row, label in enumerate(bodies.labels):
        if label.isdigit():
            result[int(label) - 1] = dynamics.values[10 * row : 10 * row + 10]
    return result


def largest_move(before: Path, now: Path) -> float:
    """Return the largest |Δ| / σ of the parameters of two folders with an estimate; infinite for other parameters."""
    if not (before / ESTIMATE).is_file():
        return float("inf")
    old, new = ({row.name: row for row in read_estimate(folder)} for folder in (before, now))
    moves = [abs(one.value - old[name].value) / one.sigma for name, one in new.items() if name in old and one.sigma]
    if old.keys() == new.keys():
        return max(moves, default=0.0)
    return float("inf")


def return_masses(session: Session) -> list[str]:
    """Hand the masses that a session has just identified to its fit, if that would still change; return notes.

    The fit takes them where it has compliance or sag; its step is then stale.
    """
    limit = session.settings.fit.rounds
    place = session.path(MASSES)
    found = session.identification.path
    if not limit or not session.geometric or read_table(found).get("unit", TORQUE) != TORQUE:
        return []
    if not {"torque", "lever"} & {term.basis for term in calibrated.read(session.fit.path).deflection.terms}:
        return []
    record = place / ROUNDS
    done = read_json(record, "calib redo fit", dict[str, int])["rounds"] if record.is_file() else 0
    geometry = largest_move(place / "geometry", session.fit.path)
    dynamics = largest_move(place, found)
    words = f"the geometry has moved by {geometry:.2g} σ, the dynamics by {dynamics:.2g} σ"
    if not (place / MODEL).is_file():
        words = "the compliance was fitted to the description's masses"
    settled = max(geometry, dynamics) <= MAX_MOVE
    if settled or done >= limit:
        write_json(record, {"rounds": 0})
        end = "settled" if settled else f"not settled, stopped by rounds = {limit}"
        return [f"identified masses in the fit's gravity torques: after {done} rounds {words}: {end}"]
    (place / "geometry").mkdir(parents=True, exist_ok=True)
    shutil.copy(session.fit.path / ESTIMATE, place / "geometry")
    write_json(record, {"rounds": done + 1})
    # the last is what the fit depends on
    for name in (calibrated.ROBOT, ESTIMATE, MODEL):
        shutil.copy(found / name, place)
    return [f"identified masses return into the fit, round {done + 1} of at most {limit}: {words}"]
