"""Option files: TOML read within size limits, checked against frozen dataclasses, with error messages of one form.

A table of a file is a dataclass under `strict`; its fields are the keys, and their annotated types
(`calib.config_types`) say what a key may hold, in which unit, and which words a complaint uses. pydantic does the
checking. It is imported where a file is read and not before: 0.1 CPU seconds that ``calib --help`` and a fit without
options need not wait for. Complaints read ``file: key: what was expected, what was found, did you mean …``. `schema`
gives the same as a JSON schema.
"""

import re
import tomllib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from inspect import cleandoc
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from calib.config_types import UNKNOWN, Hidden, shown
from calib.errors import CalibError, UsageError, suggestion

T = TypeVar("T")
Tables = str | Path | Mapping[str, Any]  # a TOML file, or what stands in one
MAX_LEVELS = 32
_PLAIN = {  # pydantic's words
    "float": "a number",
    "int": "a whole number",
    "string": "a text",
    "bool": "true or false",
    "tuple": "a list",
    "too_short": "at least one number",
}
_BARE = re.compile(r"[A-Za-z0-9_-]+")
_ENTRY = re.compile(r"^ {4}(\w+(?:, \w+)*): (.*(?:\n {8}.*)*)", re.M)  # of a docstring: names, and what they are


def read_toml(path: str | Path, error: type[CalibError] = UsageError) -> dict[str, Any]:
    """Return the tables of the TOML file at `path`.

    Raises:
        CalibError: `error`, for a file that is missing, too large, no TOML, nested too deeply, or with a whole number
            of more than 64 bits.
    """
    from calib.files import check_regular

    max_bytes = 8_000_000  # bytes of a file, and levels of tables in tables (our choices)
    try:
        check_regular(path, streams=True)
        with open(path, "rb") as file:
            data = file.read(max_bytes + 1)
        if len(data) > max_bytes:
            raise error(f"{path}: is larger than {max_bytes / 1e6:g} MB: is it the right file?")
        found = tomllib.loads(data.decode("utf-8-sig"))
    except OSError as wrong:
        raise error(f"{path}: cannot be read: {wrong.strerror or wrong}") from wrong
    except RecursionError:
        raise error(f"{path}: is nested too deeply: more than {MAX_LEVELS} levels") from None
    except ValueError as wrong:  # of tomllib, of the decoder, of a number with thousands of digits, of a name with NUL
        words = "a whole number with thousands of digits" if "digits" in str(wrong) else wrong
        raise error(f"{path}: is not a TOML file: {words}") from wrong
    _check_size(found, str(path), error)
    return found


def _check_size(found: Any, place: str, error: type[CalibError]) -> None:
    """Raise an error for tables nested too deeply and for integers of more than 64 bits."""
    ahead: list[tuple[tuple[Any, ...], Any]] = [((), found)]
    while ahead:
        loc, value = ahead.pop()
        if len(loc) > MAX_LEVELS:
            raise error(f"{place}: {located(loc[:3])}: is nested too deeply: more than {MAX_LEVELS} levels")
        if isinstance(value, int) and not -(2**63) <= value < 2**63:
            raise error(f"{place}: {located(loc)}: a whole number of more than 64 bits: {shown(value)}")
        inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        ahead += [((*loc, key), item) for key, item in inner]


def parse(kind: type[T], found: Any, place: str, error: type[CalibError] = UsageError) -> T:
    """Return a parsed table as a checked instance of the dataclass `kind`.

    Args:
        kind: a dataclass under `strict`.
        found: the table, lists and tables in it as tomllib makes them.
        place: names it in complaints.
        error: the class of complaints.

    Raises:
        CalibError: `error`, for the first key that is unknown, missing, or holds what it cannot hold.
    """
    from pydantic import ValidationError

    try:
        return _adapter(kind).validate_python(found)
    except ValidationError as wrong:
        raise error(_complaint(wrong.errors(include_url=False), kind, place)) from None


def read(kind: type[T], given: Tables | None, name: str, others: Collection[str] = ()) -> tuple[T, str]:
    """Return the parsed content of a TOML file or of its tables in memory, and its name for messages.

    Args:
        name: in place of a file's; others: tables that another reader takes.
    """
    if given is None or isinstance(given, Mapping):
        table, place = plain_values(given or {}), name
    else:
        table, place = read_toml(given), str(given)
    return parse(kind, {key: value for key, value in table.items() if key not in others}, place), place


def plain_values(value: Any) -> Any:
    """Return a value with numpy numbers, arrays and tuples converted to plain numbers and lists."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, Mapping):
        return {key: plain_values(one) for key, one in value.items()}
    return [plain_values(one) for one in value] if isinstance(value, (list, tuple)) else value


def strict(kind: type[T]) -> type[T]:
    """Make a dataclass the schema of a file's table: keys that are not its fields are refused."""
    kind.__pydantic_config__ = {"extra": "forbid"}  # type: ignore[attr-defined]
    return kind


@cache
def _adapter(kind: Any) -> Any:
    from pydantic import TypeAdapter

    return TypeAdapter(kind)


def schema(kind: type, title: str) -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of files for the dataclass `kind`."""
    from pydantic.json_schema import GenerateJsonSchema

    found = _adapter(kind).json_schema()
    return {"$schema": GenerateJsonSchema.schema_dialect, **_for_toml(found), "title": title}


def _for_toml(found: Any) -> Any:
    """Return a schema without nulls (TOML has none), hidden fields and redundant titles."""
    if isinstance(found, list):
        return [_for_toml(item) for item in found]
    if not isinstance(found, dict):
        return found
    result, words = {}, found.get("description")
    about = _entries(words) if isinstance(words, str) else {}
    for key, value in found.items():
        if key in ("properties", "$defs"):
            said = {name: {"description": about[name]} for name in about if key == "properties"}
            known = {name: item for name, item in value.items() if item.get("not") != {}}
            result[key] = {name: _for_toml(item) | said.get(name, {}) for name, item in known.items()}
        elif key == "description" and isinstance(value, str):
            result[key] = value.partition("\n\nAttributes:")[0]
        elif key == "default" and value not in (None, [None]):  # None of a list: infinity, which JSON does not have
            result[key] = value
        elif key not in ("title", "default"):
            result[key] = _for_toml(value)
    choices = [item for item in result.pop("anyOf", ()) if item != {"type": "null"}]
    return {**choices[0], **result} if len(choices) == 1 else {**({"anyOf": choices} if choices else {}), **result}


def inherited(table: Mapping[str, Any], kind: type) -> dict[str, Any]:
    """Return a file's table whose ``[files.NAME]`` tables inherit missing keys from the table for all files.

    Args:
        table: the file.
        kind: the dataclass of one file; its fields are the keys that are handed down, tables key by key.
    """
    files = table.get("files")
    if not isinstance(files, Mapping):
        return dict(table)
    every = {key: table[key] for key in _keys(kind) if key in table}

    def filled(own: Any) -> Any:
        if not isinstance(own, Mapping):
            return own
        both = [key for key in own if isinstance(own[key], Mapping) and isinstance(every.get(key), Mapping)]
        return {**every, **own, **{key: {**every[key], **own[key]} for key in both}}

    return {**table, "files": {name: filled(own) for name, own in files.items()}}


def own_table(files: Mapping[str, T], path: str | Path) -> T | None:
    """Return the table in `files` whose name is the end of the file's path; None if there is no such table."""
    parts = Path(path).parts
    for name, own in files.items():
        wanted = Path(name).parts
        if parts[-len(wanted) :] == wanted:
            return own
    return None


def described(given: Any) -> dict[str, str]:
    """Return the description of each argument or attribute from the docstrings of a function or class."""
    found: dict[str, str] = {}
    for one in reversed(getattr(given, "__mro__", (given,))):
        found |= _entries(one.__doc__ or "")
    return found


def _entries(docstring: str) -> dict[str, str]:
    """Return names and descriptions under ``Args:`` or ``Attributes:``, without code marks."""
    parts = re.split("^(?:Args|Attributes):$", cleandoc(docstring), maxsplit=1, flags=re.M)
    return {
        name: " ".join(words.replace("``", "").split()).removesuffix(".")
        for names, words in (_ENTRY.findall(parts[1]) if len(parts) > 1 else ())
        for name in names.split(", ")
    }


# ---- complaints -----------------------------------------------------------------------------------------------------


def check_keys(
    found: Mapping[str, Any], keys: Collection[str], place: str, error: type[CalibError] = UsageError
) -> None:
    """Raise an error for a key that is not in `keys`; its message suggests the most similar key."""
    for key in found:
        if key not in keys:
            raise error(f"{place}: {_no_key(key, keys)}")


def located(loc: Sequence[Any]) -> str:
    """Return a file location in TOML notation: ``sigma.position``, ``files."a.csv".kind``, ``[[term]] number 2``."""
    result = ""
    for k, part in enumerate(loc):
        if isinstance(part, int):
            result = f"[[{result}]] number {part + 1}" if k + 1 < len(loc) or k == 1 else result
            continue
        name = part if _BARE.fullmatch(part) else f'"{part}"'
        result = f"{result}{', ' if result.endswith(tuple('0123456789')) and k > 1 else '.' if result else ''}{name}"
    return result


def _no_key(key: str, keys: Collection[str]) -> str:
    there = f"the keys are {', '.join(sorted(keys))}" if keys else "there are none"
    return f"there is no key '{key}'{suggestion(key, keys)}; {there}"


def _complaint(errors: list[Any], kind: type, place: str) -> str:
    """Return the message for pydantic's first error; an unknown key takes precedence over a missing one."""
    first = next((one for one in errors if one["type"] == UNKNOWN), errors[0])
    loc, name, found = tuple(first["loc"]), first["type"], first["input"]
    if name in ("missing", "too_long") and (count := _fixed_length(kind, loc, name)):
        at = loc[:-1] if name == "missing" else loc
        words = f"a list of {count} values" if count > 1 else "a list of one value"
        return f"{': '.join(filter(None, (place, located(at))))}: expected {words}, found {shown(found)}"
    table = _type_at(kind, loc[:-1]) if name in (UNKNOWN, "missing") else None
    at = loc if table is None else loc[:-1]
    while (
        at and isinstance(at[-1], int) and name not in (UNKNOWN, "missing", "dataclass_type")
    ):  # one of several values
        at = at[:-1]
    where = ": ".join(filter(None, (place, located(at))))
    if name == UNKNOWN and len(loc) == 3 and loc[0] == "files" and isinstance(found, dict) and "." not in loc[1]:
        return f'{where}: the dot needs quotes: [files."{loc[1]}.{loc[2]}"]'
    if name == UNKNOWN:
        return f"{where}: {_no_key(str(loc[-1]), _keys(table))}"
    if name == "missing":
        return f"{where}: there is no '{loc[-1]}'{_needed(table)}"
    if name == "value_error":
        return f"{where}: {first['ctx']['error']}"
    words = _PLAIN.get(name, _PLAIN.get(name.split("_")[0], "a table"))
    if name == "tuple_type" and is_dataclass(_type_at(kind, (*loc, 0))):
        words = f"a list of tables, [[{loc[-1]}]]"
    return f"{where}: expected {words}, found {shown(found)}"


def _fixed_length(kind: Any, loc: Sequence[Any], name: str) -> int:
    """Return how many values the list of fixed length at a location has; 0 where there is no such list.

    Args:
        loc: of an error; ``missing`` is that of the first value that the list lacks.
    """
    if name == "missing" and not isinstance(loc[-1], int):
        return 0
    listed = _type_at(kind, loc[:-1] if name == "missing" else loc)
    values = get_args(listed) if get_origin(listed) is tuple else ()
    return 0 if Ellipsis in values else len(values)


def _keys(kind: Any) -> list[str]:
    """Return the keys of the table that a dataclass describes."""
    hints = get_type_hints(kind, include_extras=True)
    return [key for key, hint in hints.items() if Hidden() not in getattr(hint, "__metadata__", ())]


def _needed(kind: Any) -> str:
    from dataclasses import MISSING

    needed = [f.name for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING]
    return f"; needed are {', '.join(needed)}" if len(needed) > 1 else ""


def _type_at(kind: Any, loc: Sequence[Any]) -> Any:
    """Return the dataclass that describes the table at a location."""
    for part in loc:
        kind = get_type_hints(kind)[part] if is_dataclass(kind) else get_args(kind)[-1 if isinstance(part, str) else 0]
        while get_origin(kind) is not None and type(None) in get_args(kind):
            kind = get_args(kind)[0]
    return kind
