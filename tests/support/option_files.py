"""One option file of every kind, as its page documents it: its tables, and what reads them."""

import tomllib
from collections.abc import Callable
from typing import Any

from calib.apps.studies import conditions
from calib.apps.studies.conditions import StudyFile
from calib.config import parse
from calib.data.poses import fit_options
from calib.identification import identify_options
from calib.procedure.excitation import limits
from calib.procedure.excitation.coefficients import TrajectoryFile
from calib.procedure.measuring import constraints_file
from calib.procedure.measuring.constraints_file import ConstraintsFile
from calib.procedure.session.folder import StateFile
from calib.procedure.session.settings import SessionSettings, example
from calib.robot import description, mdh


def documented(module: Any, start: str = "") -> dict[str, Any]:
    """Return the file that a module's docstring shows."""
    lines = module.__doc__.splitlines()
    text = "\n".join(line[4:] for line in lines if line.startswith("    "))
    text = text.replace("[XX, XY, XZ, YY, YZ, ZZ, MX, MY, MZ, M]", "[0.1, 0, 0, 0.1, 0, 0.1, 0, 0, 0, 1.0]")
    return tomllib.loads(text[text.index(start) :])


LIMITS = documented(limits) | {"target": {"height": [0.2, 1.5], "facing": [0, 0, 1]}}
LIMITS["friction"] = {key: value[:6] for key, value in LIMITS["friction"].items()}
TRAJECTORY = {
    "robot": "ur5",
    "family": "fourier",
    "period": 20.0,
    "rate": 1000.0,
    "repeat": 5,
    "joint": [{"name": "a", "q0": 0.1, "a": [0.1], "b": [0.2]}],
}
STEP = {"finished": "2026-01-01T00:00:00", "inputs": {"a.csv": "12"}, "outputs": {"b.csv": "34"}, "notes": []}
MDH = documented(mdh, 'name = "myrobot"')
ELEMENTS = documented(description)
ELEMENTS["element"][0]["placement"] = {"matrix": [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0]]}
FILES: dict[str, tuple[dict[str, Any], Callable[[dict[str, Any]], object]]] = {
    "options": (documented(fit_options), fit_options.parse_options),
    "identify-options": (documented(identify_options), identify_options.parse_options),
    "constraints": (documented(constraints_file), lambda table: parse(ConstraintsFile, table, "c.toml")),
    "limits": (LIMITS, lambda table: parse(limits.LimitsFile, table, "l.toml")),
    "mdh": (MDH, lambda table: mdh.from_table(table, "r.toml")),
    "robot": (ELEMENTS, lambda table: description.from_elements(table, "r.toml")),
    "session": (
        tomllib.loads(example().replace('file = ""', 'file = "robot.urdf"')),
        lambda table: parse(SessionSettings, table, "session.toml"),
    ),
    "trajectory": (TRAJECTORY, lambda table: parse(TrajectoryFile, table, "trajectory.toml")),
    "study": (documented(conditions), lambda table: parse(StudyFile, table, "study.toml")),
    "state": ({"schema": 2, "steps": {"fit": STEP}}, lambda table: parse(StateFile, table, "state.json")),
}
