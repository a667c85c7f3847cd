"""Option files: TOML read within size limits, checked against frozen dataclasses, with error messages of one form.

A table of a file is described by a dataclass with the decorator `strict`. The dataclass's fields are the keys. Their
annotated types (`calib.config_types`) define allowed values, units, and the wording of error messages. pydantic
performs the checks. It is imported only where a file is read, since the import takes 0.1 CPU seconds, which ``calib
--help`` and a fit without options do not need. Error messages have the form ``file: key: what was expected, what was
found, did you mean …``. `schema` returns the same description as a JSON schema.
"""

import re
import tomllib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from inspect import cleandoc
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast, get_args, get_origin, get_type_hints

from calib.config_types import UNKNOWN, Hidden, OneOf, ParsedTable, shown
from calib.errors import CalibError, UsageError, suggestion

if TYPE_CHECKING:
    from pydantic import TypeAdapter
    from pydantic_core import ErrorDetails

T = TypeVar("T")
# A TOML file, or its content.
Tables = str | Path | Mapping[str, object]
# Largest number of levels of nested tables, and largest size of a file in bytes (our choices).
MAX_LEVELS = 32
MAX_BYTES = 8_000_000
# Descriptions of expected types, by pydantic's names of errors.
_PLAIN = {
    "float": "a number",
    "int": "a whole number",
    "string": "a text",
    "bool": "true or false",
    "tuple": "a list",
    "too_short": "at least one number",
}
# Placeholder in a field's description, replaced by the texts that are allowed besides the default.
OTHERS = "{others}"
_BARE = re.compile(r"[A-Za-z0-9_-]+")
# Pattern of an entry in a docstring: names, and their description.
_ENTRY = re.compile(r"^ {4}(\w+(?:, \w+)*): (.*(?:\n {8}.*)*)", re.M)


def read_toml(path: str | Path, error: type[CalibError] = UsageError) -> ParsedTable:
    """Return the tables of the TOML file at `path`.

    Raises:
        CalibError: of class `error`, for a file that is missing, too large, not TOML, nested too deeply, or has an
            integer of more than 64 bits.
    """
    from calib.files import check_regular

    data = b""
    try:
        check_regular(path, streams=True)
        with open(path, "rb") as file:
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise error(f"{path}: is larger than {MAX_BYTES / 1e6:g} MB: is it the right file?")
        tables = tomllib.loads(data.decode("utf-8-sig"))
    except OSError as cause:
        raise error(f"{path}: cannot be read: {cause.strerror or cause}") from cause
    except RecursionError:
        raise error(f"{path}: is nested too deeply: more than {MAX_LEVELS} levels") from None
    except ValueError as cause:  # of tomllib, of the decoder, of a number with thousands of digits, of a name with NUL
        reason = "a whole number with thousands of digits" if "digits" in str(cause) else cause
        hint = ""
        if re.search(r'"[A-Za-z]:\\[^\\]', data.decode(errors="replace")):
            hint = "; write Windows paths with /, or in single quotes: 'C:\\cells\\robot.urdf'"
        raise error(f"{path}: is not a TOML file: {reason}{hint}") from cause
    _check_size(tables, str(path), error)
    return tables


def _check_size(tables: object, where: str, error: type[CalibError]) -> None:
    """Raise an error for tables nested too deeply and for integers of more than 64 bits."""
    todo: list[tuple[tuple[int | str, ...], object]] = [((), tables)]
    while todo:
        loc, value = todo.pop()
        if len(loc) > MAX_LEVELS:
            raise error(f"{where}: {located(loc[:3])}: is nested too deeply: more than {MAX_LEVELS} levels")
        if isinstance(value, int) and not -(2**63) <= value < 2**63:
            raise error(f"{where}: {located(loc)}: a whole number of more than 64 bits: {shown(value)}")
        if isinstance(value, dict):
            todo += [((*loc, key), item) for key, item in value.items()]
        elif isinstance(value, list):
            todo += [((*loc, index), item) for index, item in enumerate(value)]


def parse(kind: type[T], table: object, where: str, error: type[CalibError] = UsageError) -> T:
    """Return a parsed table as a checked instance of the dataclass `kind`.

    Args:
        kind: a dataclass decorated with `strict`.
        table: the table, with lists and tables of the types that tomllib returns.
        where: name of the table in messages.
        error: class of the errors raised.

    Raises:
        CalibError: of class `error`, for the first key that is unknown, missing, or has an invalid value.
    """
    from pydantic import ValidationError

    try:
        return _adapter(kind).validate_python(table)
    except ValidationError as validation_error:
        raise error(_complaint(validation_error.errors(include_url=False), kind, where, table)) from None


def read(kind: type[T], source: Tables | None, name: str, foreign_tables: Collection[str] = ()) -> tuple[T, str]:
    """Return the parsed content of a TOML file or of its tables in memory, and its name for messages.

    Args:
        kind: the dataclass that describes the file.
        source: the file, or its tables; None for empty tables.
        name: name for messages, if `source` is not a file.
        foreign_tables: names of tables that are ignored because another function reads them.

    Raises:
        CalibError: the content is invalid (see `parse`).
    """
    if source is None or isinstance(source, Mapping):
        tables, where = plain_values(source or {}), name
    else:
        tables, where = read_toml(source), str(source)
    own_tables = {key: value for key, value in tables.items() if key not in foreign_tables}
    return parse(kind, own_tables, where), where


def plain_values(value: object) -> Any:
    """Return a value with numpy numbers, arrays and tuples converted to plain numbers and lists."""
    to_list = getattr(value, "tolist", None)
    if to_list is not None:
        return to_list()
    if isinstance(value, Mapping):
        return {key: plain_values(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_values(item) for item in value]
    return value


def strict(kind: type[T]) -> type[T]:
    """Return a dataclass as the description of a file's table; keys that are not its fields are refused."""
    kind.__pydantic_config__ = {"extra": "forbid"}  # ty: ignore[missing-attribute]
    return kind


@cache
def _adapter(kind: type[T]) -> "TypeAdapter[T]":
    from pydantic import TypeAdapter

    return TypeAdapter(kind)


def schema(kind: type, title: str) -> ParsedTable:
    """Return the JSON schema (draft 2020-12) of the files that the dataclass `kind` describes."""
    from pydantic.json_schema import GenerateJsonSchema

    json_schema = _for_toml(_adapter(kind).json_schema())
    # pydantic knows the docstring of the class alone, not those of the classes it extends
    for key, description in described(kind).items():
        if key in json_schema["properties"]:
            json_schema["properties"][key].setdefault("description", description)
    return {"$schema": GenerateJsonSchema.schema_dialect, **json_schema, "title": title}


def _for_toml(json_schema: object) -> Any:
    """Return a JSON schema without null (TOML has none), hidden fields and redundant titles."""
    if isinstance(json_schema, list):
        return [_for_toml(item) for item in json_schema]
    if not isinstance(json_schema, dict):
        return json_schema
    result: ParsedTable = {}
    description = json_schema.get("description")
    descriptions = _entries(description) if isinstance(description, str) else {}
    for key, value in json_schema.items():
        if key in ("properties", "$defs"):
            result[key] = {}
            for name, item in value.items():
                # A hidden field.
                if item.get("not") == {}:
                    continue
                result[key][name] = _for_toml(item)
                if key == "properties" and name in descriptions:
                    others = [word for word in item.get("enum", ()) if word != item.get("default")]
                    result[key][name] |= {"description": descriptions[name].replace(OTHERS, ", ".join(others))}
        elif key == "description" and isinstance(value, str):
            result[key] = value.partition("\n\nAttributes:")[0]
        elif key == "default" and value not in (None, [None]):  # None of a list: infinity, which JSON does not have
            result[key] = value
        elif key not in ("title", "default"):
            result[key] = _for_toml(value)
    choices = [item for item in result.pop("anyOf", ()) if item != {"type": "null"}]
    if len(choices) == 1:
        return {**choices[0], **result}
    if choices:
        return {"anyOf": choices, **result}
    return result


def inherited(table: Mapping[str, Any], kind: type) -> ParsedTable:
    """Return an option file's table in which ``[files.NAME]`` tables inherit missing keys from the table for all files.

    Args:
        table: content of the option file.
        kind: the dataclass that describes one file's table; its fields are the keys that are inherited, those of nested
            tables key by key.
    """
    files = table.get("files")
    if not isinstance(files, Mapping):
        return dict(table)
    common = {key: table[key] for key in _keys(kind) if key in table}

    def filled(file_table: object) -> object:
        if not isinstance(file_table, Mapping):
            return file_table
        result = {**common, **file_table}
        for key, value in file_table.items():
            if isinstance(value, Mapping) and isinstance(common.get(key), Mapping):
                result[key] = {**common[key], **value}
        return result

    return {**table, "files": {name: filled(file_table) for name, file_table in files.items()}}


def own_table(files: Mapping[str, T], path: str | Path) -> T | None:
    """Return the table in `files` whose name is the end of the file's path; None if there is no such table."""
    parts = Path(path).parts
    for name, table in files.items():
        name_parts = Path(name).parts
        if parts[-len(name_parts) :] == name_parts:
            return table
    return None


def described(source: object) -> dict[str, str]:
    """Return the description of each argument or attribute, from the docstring of a function or class."""
    descriptions: dict[str, str] = {}
    for base in reversed(getattr(source, "__mro__", (source,))):
        descriptions |= _entries(base.__doc__ or "")
    for name, text in descriptions.items():
        if OTHERS in text:
            descriptions[name] = text.replace(OTHERS, ", ".join(_others(cast(type, source), name)))
    return descriptions


def _others(kind: type, key: str) -> list[str]:
    """Return the texts that a key may have instead of its default, in their order."""
    default = getattr(kind, key)
    hint = get_type_hints(kind, include_extras=True)[key]
    for annotation in hint.__metadata__:
        if isinstance(annotation, OneOf):
            return [word for word in annotation.names if word != default]
    return []


def _entries(docstring: str) -> dict[str, str]:
    """Return names and descriptions under ``Args:`` or ``Attributes:`` of a docstring, without the marks of code."""
    parts = re.split("^(?:Args|Attributes):$", cleandoc(docstring), maxsplit=1, flags=re.M)
    if len(parts) == 1:
        return {}
    descriptions: dict[str, str] = {}
    for names, text in _ENTRY.findall(parts[1]):
        description = " ".join(text.replace("``", "").split()).removesuffix(".")
        for name in names.split(", "):
            descriptions[name] = description
    return descriptions


# ---- complaints -----------------------------------------------------------------------------------------------------


def check_keys(
    table: Mapping[str, object], keys: Collection[str], where: str, error: type[CalibError] = UsageError
) -> None:
    """Raise an error for a key of `table` that is not in `keys`; the message suggests the most similar key."""
    for key in table:
        if key not in keys:
            raise error(f"{where}: {_no_key(key, keys)}")


def located(loc: Sequence[int | str], table: object = None) -> str:
    """Return a location in a file in TOML notation: ``sigma.position``, ``files."a.csv".kind``, ``[[term]] number 2``.

    Args:
        loc: keys, and indices in lists, from the outermost to the innermost.
        table: the file's content. If it is given, tables in lists are also named: ``[[joint]] number 2 ('elbow')``.
    """
    result = ""
    content = table
    for k, part in enumerate(loc):
        content = _content(content, part)
        if isinstance(part, int):
            if k + 1 < len(loc) or k == 1:
                result = f"[[{result}]] number {part + 1}"
                name = _content(content, "name")
                if isinstance(name, str):
                    result = f"{result} ({shown(name)})"
            continue
        name = part if _BARE.fullmatch(part) else f'"{part}"'
        if not result:
            result = name
        elif k > 1 and isinstance(loc[k - 1], int):
            result = f"{result}, {name}"
        else:
            result = f"{result}.{name}"
    return result


def _content(table: object, key: int | str) -> object:
    """Return the value of a key of a table, or at an index of a list; None if there is no such value."""
    if isinstance(table, Mapping):
        return table.get(key)
    if isinstance(table, (list, tuple)) and isinstance(key, int) and key < len(table):
        return table[key]
    return None


def _no_key(key: str, keys: Collection[str]) -> str:
    choices = f"the keys are {', '.join(sorted(keys))}" if keys else "there are none"
    return f"there is no key '{key}'{suggestion(key, keys)}; {choices}"


def _complaint(errors: "list[ErrorDetails]", kind: type, source: str, parsed_table: object) -> str:
    """Return the message for the first of pydantic's errors; an unknown key takes precedence over a missing one."""
    unknown = [error for error in errors if error["type"] == UNKNOWN]
    first = unknown[0] if unknown else errors[0]
    loc, name, value = tuple(first["loc"]), first["type"], first["input"]

    def message(location: Sequence[int | str], text: str) -> str:
        where = ": ".join(filter(None, (source, located(location, parsed_table))))
        return f"{where}: {text}"

    if name in ("missing", "too_long"):
        count = _fixed_length(kind, loc, name)
        if count:
            list_location = loc[:-1] if name == "missing" else loc
            expected = f"a list of {count} values" if count > 1 else "a list of one value"
            return message(list_location, f"expected {expected}, found {shown(value)}")
    if name in (UNKNOWN, "missing"):
        table_location = loc[:-1]
        table = _type_at(kind, table_location)
        # A dot in a file's name makes a table in a table of it.
        is_unquoted = len(loc) == 3 and loc[0] == "files" and isinstance(value, dict) and "." not in str(loc[1])
        if name == UNKNOWN and is_unquoted:
            return message(table_location, f'the dot needs quotes: [files."{loc[1]}.{loc[2]}"]')
        if name == UNKNOWN:
            return message(table_location, _no_key(str(loc[-1]), _keys(table)))
        return message(table_location, f"there is no '{loc[-1]}'{_needed(table)}")
    location = loc
    if name != "dataclass_type":
        location = _without_index(loc)
    if name == "value_error":
        return message(location, str(first.get("ctx", {})["error"]))
    expected = _PLAIN.get(name, _PLAIN.get(name.split("_")[0], "a table"))
    if name == "tuple_type" and is_dataclass(_type_at(kind, (*loc, 0))):
        expected = f"a list of tables, [[{loc[-1]}]]"
    return message(location, f"expected {expected}, found {shown(value)}")


def _without_index(loc: tuple[int | str, ...]) -> tuple[int | str, ...]:
    """Return a location without the indices at its end: the location of the list that contains the value."""
    while loc and isinstance(loc[-1], int):
        loc = loc[:-1]
    return loc


def _fixed_length(kind: object, loc: Sequence[int | str], name: str) -> int:
    """Return the number of values of the fixed-length list at a location; 0 where there is no such list.

    Args:
        kind: the dataclass that describes the table.
        loc: location of an error; for the error ``missing``, location of the first missing value of the list.
        name: name of the error.
    """
    if name == "missing" and not isinstance(loc[-1], int):
        return 0
    list_type = _type_at(kind, loc[:-1] if name == "missing" else loc)
    value_types = get_args(list_type) if get_origin(list_type) is tuple else ()
    return 0 if Ellipsis in value_types else len(value_types)


def _keys(kind: object) -> list[str]:
    """Return the keys of the table that the dataclass `kind` describes."""
    hints = get_type_hints(kind, include_extras=True)
    return [key for key, hint in hints.items() if Hidden() not in getattr(hint, "__metadata__", ())]


def _needed(kind: Any) -> str:
    from dataclasses import MISSING

    needed = [field.name for field in fields(kind) if field.default is MISSING and field.default_factory is MISSING]
    return f"; needed are {', '.join(needed)}" if len(needed) > 1 else ""


def _type_at(kind: Any, loc: Sequence[int | str]) -> Any:
    """Return the type of the value at a location in the table that `kind` describes; for a table, its dataclass."""
    for part in loc:
        if is_dataclass(kind):
            kind = get_type_hints(kind)[str(part)]
        else:
            # The values of a mapping, the items of a list.
            kind = get_args(kind)[-1 if isinstance(part, str) else 0]
        while get_origin(kind) is not None and type(None) in get_args(kind):
            kind = get_args(kind)[0]
    return kind
