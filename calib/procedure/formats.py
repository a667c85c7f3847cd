"""File formats and their documentation: `calib formats` prints the docstrings of the modules that define them."""

import json
from collections.abc import Iterator, Mapping
from importlib import import_module

from calib.config import schema
from calib.config_types import ParsedTable
from calib.errors import UsageError, one_of
from calib.extensions import Point, merged

FORMATS: Point[Mapping[str, tuple[str, str, str]]] = Point(
    "formats", "topic of `calib formats` → description, modules, dataclass of the first module's TOML file or empty"
)

# topic -> short description, and the modules whose docstrings document the topic
TOPICS: Mapping[str, tuple[str, str]] = {
    "measurements": ("CSV files of measured poses, positions, distances", "calib.data.poses.pose_files"),
    "pairs": ("pairs of poses (robot and board) without joints, for calib hand-eye", "calib.data.pose_pairs"),
    "options": ("the TOML file of calib fit --options", "calib.data.poses.fit_options"),
    "identify-options": (
        "the TOML file of calib identify --options",
        "calib.identification.identify_options calib.identification.loop",
    ),
    "identified": (
        "the folder that calib identify writes",
        "calib.identification.model_file calib.procedure.dynamic_stage.verdict "
        "calib.procedure.dynamic_stage.geometry_tables",
    ),
    "exports": (
        "files that calib export --into writes",
        "calib.procedure.export.delivery calib.identification.physical_consistency.solve",
    ),
    "constraints": ("the TOML file of calib select --constraints", "calib.procedure.measuring.constraints_file"),
    "mdh": ("a robot as a table of modified Denavit-Hartenberg rows", "calib.robot.mdh calib.robot.tables"),
    "robot": (
        "robot.toml as calib fit writes it",
        "calib.robot.description calib.geometry.installation calib.robot.calibrated",
    ),
    "session": ("a session's folder and its session.toml", "calib.procedure.session.folder"),
    "limits": ("the TOML file of calib excite --limits and calib plan --limits", "calib.procedure.excitation.limits"),
    "waypoints": ("the CSV of calib plan --waypoints", "calib.procedure.excitation.planning"),
    "excitation": (
        "trajectory.toml of calib excite, and what calib recall writes",
        "calib.procedure.excitation.coefficients",
    ),
    "recordings": (
        "recordings of motion, for calib identify",
        "calib.data.recordings.recording_options calib.data.recordings.recording_files calib.data.recordings.archives "
        "calib.procedure.dynamic_stage.standing",
    ),
    "images": (
        "a folder of images of a board, its board.toml, camera.yaml, corners.csv",
        "calib.data.images.image_folders calib.data.images.board calib.data.images.lens calib.data.images.lens_files "
        "calib.data.images.pixels calib.data.images.image_bags",
    ),
    "logs": (
        "logs of robot controllers, by brand, and ROS bags",
        "calib.data.recordings.controller_logs calib.data.recordings.ros_texts calib.data.recordings.bags "
        "calib.data.recordings.datasets calib.data.nested_tables",
    ),
    "descriptions": (
        "robots as xacro, MJCF and a UR's calibration.conf",
        "calib.robot.descriptions.xacro_files calib.robot.descriptions.mjcf calib.robot.descriptions.ur_calibration",
    ),
    "moveit": ("MoveIt's joint_limits.yaml and SRDF as limits", "calib.procedure.measuring.moveit"),
    "ros2": ("ROS 2 package of a calibrated robot, of calib export --ros2", "calib.procedure.export.ros2_package"),
    "robodk": ("CSV of RoboDK, and of three reflectors without a header", "calib.data.poses.robodk"),
    "instruments": ("text exports of trackers, CMMs and motion capture", "calib.data.poses.exports"),
    **{topic: (words, modules) for topic, (words, modules, _) in merged(FORMATS).items()},
}

# topic -> module and dataclass of the TOML files that people write
SCHEMAS: Mapping[str, tuple[str, str]] = {
    "options": ("calib.data.poses.fit_options", "FitOptions"),
    "identify-options": ("calib.identification.identify_options", "IdentifySettings"),
    "constraints": ("calib.procedure.measuring.constraints_file", "ConstraintsFile"),
    "mdh": ("calib.robot.mdh", "MdhFile"),
    "robot": ("calib.robot.description", "ElementsFile"),
    "limits": ("calib.procedure.excitation.limits", "LimitsFile"),
    "session": ("calib.procedure.session.settings", "SessionSettings"),
    **{topic: (modules.split()[0], kind) for topic, (_, modules, kind) in merged(FORMATS).items() if kind},
}
# types of a JSON schema, and bounds of its numbers, in words
_KINDS = {"string": "text", "integer": "whole number", "boolean": "true or false", "object": "table", "array": "list"}
_BOUNDS = {"exclusiveMinimum": "above", "minimum": "from", "maximum": "to"}


def overview() -> list[str]:
    """Return one line for each documented file format: name and short description."""
    return [f"{name:17} {description}" for name, (description, _) in TOPICS.items()]


def describe(topic: str) -> str:
    """Return the documentation of the file format `topic`.

    Raises:
        UsageError: for an unknown topic; the message lists the known topics.
    """
    one_of(topic, TOPICS, "format", UsageError)
    _, modules = TOPICS[topic]
    parts = [_plain(import_module(name).__doc__ or "") for name in modules.split()]
    if topic == "session":
        from calib.procedure.session.settings import example

        parts.append(f"session.toml, as calib new writes it:\n\n{example()}")
    elif topic in SCHEMAS:
        lines = ["Every key, its allowed values, and its default:\n"]
        for key, allowed, default, meaning in keys(topic):
            columns = [f"    {key:28} {allowed}"]
            if default:
                columns.append(f"default {default}")
            if meaning:
                columns.append(meaning)
            lines.append("; ".join(columns))
        parts.append("\n".join(lines))
    return "\n\n".join(part.strip() for part in parts) + "\n"


def json_schema(topic: str) -> str:
    """Return the JSON schema (draft 2020-12) of a TOML file format; editors use it to complete and check keys.

    Args:
        topic: name of the file format.

    Raises:
        UsageError: for a topic without a schema; the message lists the topics that have one.
    """
    if topic not in SCHEMAS:
        raise UsageError(f"no JSON schema for '{topic}'; available for {', '.join(SCHEMAS)}")
    return json.dumps(_schema(topic), indent=2, ensure_ascii=False) + "\n"


def _schema(topic: str) -> ParsedTable:
    module, name = SCHEMAS[topic]
    return schema(getattr(import_module(module), name), f"{TOPICS[topic][0]} (armature-calib)")


def keys(topic: str) -> Iterator[tuple[str, str, str, str]]:
    """Yield path (``sigma.position``), allowed values, default and explanation of each key of a TOML file format.

    Args:
        topic: name of a file format in `SCHEMAS`.
    """
    table = _schema(topic)
    return _keys(table, table.get("$defs", {}))


def _keys(table: ParsedTable, tables: ParsedTable, prefix: str = "") -> Iterator[tuple[str, str, str, str]]:
    for key, value in table.get("properties", {}).items():
        # the same keys, for one file
        if key == "files":
            continue
        inner = value.get("items", value.get("additionalProperties")) or value
        reference = str(inner.get("$ref", value.get("$ref", "")))
        named_table = tables.get(reference.rpartition("/")[2])
        if named_table:
            yield from _keys(named_table, tables, f"{prefix}{key}.")
            continue
        default = ""
        if "default" in value:
            default = json.dumps(value["default"])
        yield prefix + key, _allowed(value), default, value.get("description", "")


def _allowed(value: ParsedTable) -> str:
    """Return the allowed values of a key as text.

    Args:
        value: JSON schema of the key.
    """
    if "anyOf" in value:
        alternatives = dict.fromkeys(_allowed(alternative) for alternative in value["anyOf"])
        return " or ".join(alternatives)
    if "enum" in value:
        return ", ".join(value["enum"])
    if "items" in value or "prefixItems" in value:
        return f"list of: {_allowed(value.get('items') or value['prefixItems'][0])}"
    kinds = value.get("type", "value")
    if isinstance(kinds, str):
        kinds = [kinds]
    parts = [" or ".join(_KINDS.get(kind, kind) for kind in kinds)]
    parts += [f"{bound} {value[key]:g}" for key, bound in _BOUNDS.items() if key in value]
    return " ".join(parts)


def _plain(text: str) -> str:
    """Return a docstring without the markup of reStructuredText."""
    return text.replace("::\n", ":\n").replace("``", "")
