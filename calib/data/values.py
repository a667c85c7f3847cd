"""Values of an options file: each function returns what a key may hold, or refuses it by the key's name."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from calib.data.csv_table import ANGLES, LENGTHS, nearest
from calib.errors import UsageError

Own = TypeVar("Own")
Triple = tuple[float, float, float]


def known(table: Mapping[str, Any], keys: set[str], place: str) -> None:
    """Refuse a key that is none of `keys`, with the nearest one that is."""
    for key in table:
        if key not in keys:
            message = f"{place}: there is no key '{key}'{nearest(key, sorted(keys))}"
            there = f"the keys are {', '.join(sorted(keys))}" if keys else "there are none"
            raise UsageError(f"{message}; {there}")


def refuse(value: Any, place: str, expected: str) -> UsageError:
    """Return the complaint about a value."""
    return UsageError(f"{place}: expected {expected}, found {value!r}")


def table(value: Any, place: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise refuse(value, place, "a table")
    return value


def one_of(*allowed: str) -> Callable[[Any, str], str]:
    def parse(value: Any, place: str) -> str:
        if value not in allowed:
            near = nearest(value, allowed) if isinstance(value, str) else ""
            raise refuse(value, place, f"one of {', '.join(allowed)}{near}")
        return value

    return parse


def text(value: Any, place: str) -> str:
    if not isinstance(value, str) or not value.strip():
        raise refuse(value, place, "a text")
    return value


def flag(value: Any, place: str) -> bool:
    if not isinstance(value, bool):
        raise refuse(value, place, "true or false")
    return value


def positive(most: float = math.inf, unit: str = "") -> Callable[[Any, str], float]:
    def parse(value: Any, place: str) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < math.inf:
            raise refuse(value, place, "a number above 0")
        if value > most:
            raise refuse(value, place, f"{unit}, at most {most:g} (are these mm, or degrees?)")
        return float(value)

    return parse


def triple(most: float, unit: str) -> Callable[[Any, str], Triple]:
    number = positive(most, unit)

    def parse(value: Any, place: str) -> Triple:
        if isinstance(value, list) and len(value) != 3:
            raise refuse(value, place, "a number or three")
        x, y, z = (number(item, place) for item in (value if isinstance(value, list) else [value] * 3))
        return x, y, z

    return parse


def names(value: Any, place: str) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise refuse(value, place, "a list of names")
    return tuple(value)


def texts(value: Any, place: str) -> dict[str, str]:
    return {key: text(item, f"{place}.{key}") for key, item in table(value, place).items()}


def units(value: Any, place: str) -> dict[str, str]:
    unit = one_of(*ANGLES, *LENGTHS)
    return {key: unit(item, f"{place}.{key}") for key, item in table(value, place).items()}


def label(value: Any, place: str) -> str:
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise refuse(value, place, "a text or a number")
    return value if isinstance(value, str) else f"{value:.12g}"


def where(value: Any, place: str) -> dict[str, tuple[str, ...]]:
    items = {key: item if isinstance(item, list) else [item] for key, item in table(value, place).items()}
    return {key: tuple(label(item, f"{place}.{key}") for item in listed) for key, listed in items.items()}


def pairs(value: Any, place: str) -> tuple[tuple[str, str], ...]:
    if not isinstance(value, list) or not all(isinstance(pair, list) and len(pair) == 2 for pair in value):
        raise refuse(value, place, 'pairs of socket labels, [["0", "1"]]')
    return tuple((label(first, place), label(second, place)) for first, second in value)


def read_toml(path: str | Path) -> dict[str, Any]:
    """Return the tables of the TOML file at `path`.

    Raises:
        UsageError: for a file that is missing or no TOML.
    """
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: is no TOML: {error}") from error


def own_table(files: Mapping[str, Own], path: str | Path) -> Own | None:
    """Return what `files` holds under the name of the file at `path`, or the end of its path; None for nothing."""
    parts = Path(path).parts
    for name, own in files.items():
        wanted = Path(name).parts
        if parts[-len(wanted) :] == wanted:
            return own
    return None
