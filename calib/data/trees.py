"""Files of nested tables: YAML, JSON, and OpenCV's FileStorage (YAML, XML, JSON), read as lists, tables and numbers."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from calib.errors import MeasurementError

# Types of YAML values, as OpenCV and Python's dumper write them.
_HEADER = re.compile(r"^%YAML.*$", re.MULTILINE)
_TAG = re.compile(r"(?<=[:\-,\[{] )!!?[\w./:\-]+")


def read_tree(path: Path) -> object:
    """Return the content of a YAML, JSON or XML file as nested lists, tables and numbers; matrices as lists of rows.

    Raises:
        MeasurementError: the file cannot be read, or is damaged.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise MeasurementError(f"cannot be read ({error})", path) from error
    content = text.lstrip()
    if content.startswith("<"):
        return _of_xml(content, path)
    if content.startswith(("{", "[")):
        try:
            return _with_matrices(json.loads(content))
        except ValueError:
            # YAML in flow style begins alike
            pass
    return _with_matrices(_of_yaml(text, path))


def _of_yaml(text: str, path: Path) -> object:
    """Return the content of a YAML text; of several documents (as ``rostopic echo`` writes them) their list."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    # OpenCV's header is no directive of YAML, and its tags (as Python's) are types, not values
    plain = _TAG.sub("", _HEADER.sub("", text))
    try:
        documents = list(filter(None, YAML(typ="safe", pure=True).load_all(plain)))
    except (YAMLError, ValueError, RecursionError) as error:
        raise MeasurementError(f"cannot be read as YAML ({str(error).splitlines()[0]})", path) from error
    if len(documents) == 1:
        return documents[0]
    return documents


def _of_xml(text: str, path: Path) -> object:
    """Return the content of OpenCV's XML."""
    if "<!ENTITY" in text:
        raise MeasurementError("is XML that defines entities, which OpenCV does not write: remove them", path)
    try:
        root = ET.fromstring(text)
    except (ET.ParseError, ValueError) as error:
        raise MeasurementError(f"cannot be read as XML ({error})", path) from error
    return _with_matrices(_of_element(root))


def _of_element(element: ET.Element) -> object:
    """Return the content of an XML element: table, list, number, numbers, or text."""
    children = list(element)
    if {child.tag for child in children} == {"_"}:
        return list(map(_of_element, children))
    if children:
        return {child.tag: _of_element(child) for child in children}
    try:
        numbers = list(map(float, (element.text or "").split()))
    except ValueError:
        return (element.text or "").strip().strip('"')
    if len(numbers) == 1 and element.tag not in ("data", "_"):
        return numbers[0]
    return numbers


def _with_matrices(node: object) -> object:
    """Return a tree with OpenCV's matrices (rows, cols, data) as nested lists."""
    if isinstance(node, Mapping):
        if {"rows", "cols", "data"} <= set(node) and isinstance(node["data"], list):
            return _matrix(node)
        return {str(key): _with_matrices(value) for key, value in node.items()}
    if isinstance(node, (list, tuple)):
        return list(map(_with_matrices, node))
    return node


def _matrix(node: Mapping[str, object]) -> object:
    """Return one of OpenCV's matrices as a list of rows; unchanged if its size and its numbers disagree."""
    values = as_numbers(node["data"])
    rows = node["rows"]
    if values is None or not isinstance(rows, (int, float)) or rows < 1 or values.size % int(rows):
        return dict(node)
    return values.reshape(int(rows), -1).tolist()


def by_lower_case(table: Mapping[object, object]) -> dict[str, object]:
    """Return a table with its keys as texts in lower case."""
    result = {}
    for key, value in table.items():
        result[str(key).lower()] = value
    return result


def is_numeric(node: object) -> bool:
    """Return whether a node is a list of numbers, or of lists of numbers."""
    return as_numbers(node) is not None


def as_numbers(node: object) -> np.ndarray | None:
    """Return a node as an array of numbers; None if it is not a number, or a regular list of numbers."""
    if isinstance(node, (str, bytes, bool)) or node is None:
        return None
    try:
        values = np.array(node, dtype=float)
    except (TypeError, ValueError):
        return None
    if not values.size:
        return None
    return values
