"""The file formats, as their own modules document them: `calib formats` prints those docstrings and nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module

from calib.errors import UsageError

TOPICS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "measurements": (
        "CSV files of measured poses, positions, distances",
        ("calib.data.pose_files", "calib.data.robodk"),
    ),
    "targets": (
        "targets of calib compensate, and the commands it writes",
        ("calib.data.target_files", "calib.procedure.compensating"),
    ),
    "options": ("the TOML file of calib fit --options", ("calib.data.options",)),
    "identify-options": (
        "the TOML file of calib identify --options",
        ("calib.identification.options", "calib.identification.loop_settings"),
    ),
    "identified": (
        "the folder that calib identify writes",
        (
            "calib.identification.storage",
            "calib.procedure.identification_verdict",
            "calib.procedure.consistency_tables",
        ),
    ),
    "exports": (
        "what calib export --into writes of an identified robot",
        ("calib.procedure.exporting_dynamics", "calib.identification.consistent"),
    ),
    "constraints": ("the TOML file of calib select --constraints", ("calib.procedure.limits",)),
    "mdh": ("a robot as a table of modified Denavit-Hartenberg rows", ("calib.robot.mdh", "calib.robot.tables")),
    "robot": ("robot.toml as calib fit writes it", ("calib.robot.description", "calib.procedure.calibrated")),
    "session": ("a session's folder and its session.toml", ("calib.procedure.session",)),
    "limits": (
        "the TOML file of calib excite --limits and calib plan --limits",
        ("calib.procedure.motion_limits",),
    ),
    "waypoints": ("the CSV of calib plan --waypoints", ("calib.procedure.motion_waypoints",)),
    "excitation": (
        "trajectory.toml of calib excite, and what calib recall writes",
        ("calib.procedure.excitation_table", "calib.procedure.excitation_recall"),
    ),
    "recordings": (
        "recordings of motion, for calib identify",
        ("calib.data.recording_options", "calib.data.recording_tables", "calib.data.archives", "calib.data.bags"),
    ),
}


def overview() -> list[str]:
    """Return one line per topic."""
    return [f"{name:17} {words}" for name, (words, _) in TOPICS.items()]


def describe(topic: str) -> str:
    """Return the documentation of a topic.

    Raises:
        UsageError: with the topics there are.
    """
    if topic not in TOPICS:
        raise UsageError(f"no format '{topic}'; there are {', '.join(TOPICS)}")
    parts = [_plain(import_module(name).__doc__ or "") for name in TOPICS[topic][1]]
    if topic == "session":
        from calib.procedure.session import example

        parts.append(f"session.toml, as calib new writes it:\n\n{example()}")
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _plain(text: str) -> str:
    """Return a docstring without reStructuredText's marks for code."""
    return text.replace("::\n", ":\n").replace("``", "")
