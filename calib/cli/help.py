"""Help texts of the commands: commands in groups, arguments in capitals, and words instead of Python types."""

import sys
import unicodedata
from pathlib import Path
from typing import Any, get_args, get_origin

from typer.core import TyperCommand, TyperGroup

_ClickCommand: Any = TyperCommand.__mro__[1]  # of the click that this typer uses (or brings)
# In the order of the list of commands.
GROUPS = ("Start", "Geometry", "Dynamics", "Motion", "Files and studies")
# Letters of the left column; a third of narrower terminals.
MAX_COLUMN = 30
# Letters of choices that stand in place of a type word.
MAX_CHOICES = 25
_SPELT = {"·": " ", "×": "x", "±": "+-", "→": "->", "–": "-", "≤": "<=", "≥": ">=", "½": "1/2", "µ": "u", "°": "deg"}
_WORDS = {int: "N", float: "NUMBER", Path: "PATH"}


def type_word(kind: object, choices: tuple[str, ...] | str = ()) -> str | None:
    """Return the word for an option's value in the help text; None for a flag, which has no value.

    It lists the allowed texts if they are short, otherwise it names the type.

    Args:
        kind: type of the option's value.
        choices: the allowed texts; or, for a module that is imported late, the module attribute that lists them.
    """
    if get_origin(kind) is list:
        kind = get_args(kind)[0]
    if choices and isinstance(choices, tuple):
        alternatives = "|".join(choices)
        if len(alternatives) <= MAX_CHOICES:
            return alternatives
    if kind is bool:
        return None
    return "NAME" if choices else _WORDS.get(kind, "TEXT")


class _Spelt(_ClickCommand):
    """Base class of commands whose help text uses only characters that the console can print.

    Typer alone would always write UTF-8.
    """

    def get_help(self, ctx: Any) -> str:
        console = sys.stdout.encoding or "utf-8"
        return super().get_help(ctx).encode(console, "spelt").decode(console)


class Command(_Spelt, TyperCommand):
    """A command whose help shows arguments in capitals (ROBOT, MEASURED...) and without Python types."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        return [piece.replace("{", "").replace("}", "") for piece in super().collect_usage_pieces(ctx)]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        for title, kind in (("Arguments", "argument"), ("Options", "option")):
            rows = []
            for parameter in self.get_params(ctx):
                record = parameter.get_help_record(ctx) if parameter.param_type_name == kind else None
                if record is not None:
                    name, description = record
                    rows.append((name.partition(" <")[0], description.replace("x>=", "at least ")))
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows, col_max=min(MAX_COLUMN, formatter.width // 3))


class CommandGroup(_Spelt, TyperGroup):
    """The list of commands, arranged by `GROUPS`; the decorator of each command states the group."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        groups: dict[str, list[tuple[str, str]]] = {title: [] for title in GROUPS}
        for name, command in self.commands.items():
            group = str(command.rich_help_panel)  # type: ignore[attr-defined]
            groups[group].append((name, command.get_short_help_str(limit=200)))
        for title, rows in groups.items():
            with formatter.section(title):
                formatter.write_dl(rows)


def spelt(error: Any) -> tuple[str, int]:
    """Return ASCII replacements (sigma, ^2, ...) for characters that an encoding lacks; an error handler of `codecs`.

    Characters without a replacement are represented by their number.

    Args:
        error: the UnicodeEncodeError with the text and the position of the characters.

    Returns:
        The replacements, and the position at which the encoding continues.
    """
    letters = error.object[error.start : error.end]
    return "".join(map(_in_ascii, letters)), error.end


def _in_ascii(letter: str) -> str:
    name = unicodedata.name(letter, "")
    if name.startswith("GREEK") and "LETTER" in name:
        return name.partition("LETTER ")[2].partition(" ")[0].lower()
    if letter in _SPELT:
        return _SPELT[letter]
    plain = unicodedata.normalize("NFKD", letter)
    if name.startswith("SUPERSCRIPT"):
        plain = f"^{plain}"
    in_ascii = plain.encode("ascii", "ignore").decode()
    return in_ascii or letter.encode("ascii", "backslashreplace").decode()
