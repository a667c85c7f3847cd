"""Nested mappings as YAML in block style, which every reader takes, in YAML 1.1 and 1.2 alike.

A number always has a point, since YAML 1.1 takes 1e-05 for text; a key that could be read as something else is quoted.
"""

import json
import re
from collections.abc import Mapping
from typing import Any

_PLAIN = re.compile(r"[A-Za-z_][\w./-]*", re.ASCII)
_WORDS = {"yes", "no", "on", "off", "true", "false", "null"}  # no texts in YAML 1.1, in any case


def block(value: Mapping[str, Any], indent: str = "") -> str:
    """Return the lines of a mapping from texts to mappings, texts and finite floats."""
    lines = []
    for key, item in value.items():
        head = f"{indent}{_text(key)}:"
        if isinstance(item, Mapping) and item:
            lines.append(f"{head}\n{block(item, indent + '  ')}")
        else:
            lines.append(f"{head} {'{}' if isinstance(item, Mapping) else _scalar(item)}\n")
    return "".join(lines)


def _scalar(value: float | str) -> str:
    if isinstance(value, str):
        return _text(value)
    digits, e, exponent = repr(float(value)).partition("e")
    return digits + ("" if "." in digits else ".0") + e + exponent


def _text(value: str) -> str:
    plain = _PLAIN.fullmatch(value) and value.lower() not in _WORDS
    return value if plain else json.dumps(value)
