"""An XML tree that knows where each element stands in the text: for messages by line, and for edits in place.

Python's ElementTree keeps no positions, and yourdfpy (our first choice for URDF) reads broken XML by skipping what it
cannot parse, gives links without inertia the identity, and fails without a line number. Expat gives byte positions.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from calib.errors import RobotError, refused_as

_DECLARED = re.compile(rb"""^\s*<\?xml[^>]*?encoding\s*=\s*["']([A-Za-z0-9._-]+)["']""")

_ATTRIBUTE = re.compile(rb"""\s+([^\s=/>]+)\s*=\s*("[^"]*"|'[^']*')""")
_BLANK = re.compile(rb"\s*")


@dataclass(frozen=True)
class Node:
    """One element: tag, attributes, line (from 1), byte position of its ``<`` in the UTF-8 text, children."""

    tag: str
    attributes: dict[str, str]
    line: int
    start: int
    children: list[Node] = field(default_factory=list)

    def all(self, tag: str) -> Iterator[Node]:
        """Yield the direct children with this tag."""
        return (child for child in self.children if child.tag == tag)

    def first(self, tag: str) -> Node | None:
        """Return the first direct child with this tag, or None."""
        return next(self.all(tag), None)


def text(path: str | Path) -> tuple[str, str]:
    """Return a file's text, line ends as they are, and its encoding as declared (UTF-8 otherwise).

    Raises:
        RobotError: where it cannot be read or decoded.
    """
    with refused_as(RobotError, OSError, f"cannot read {path}: {{}}"):
        data = Path(path).read_bytes()
    declared = _DECLARED.match(data)
    encoding = declared[1].decode() if declared else "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8"
    with refused_as(RobotError, (LookupError, UnicodeError), f"{path}: not readable as {encoding}: {{}}"):
        found = data.decode(encoding)
        for way in ("utf-8", encoding):  # Python knows encodings that are no way back
            found.encode(way)
        return found, encoding


def parse(source: str, where: str) -> Node:
    """Return the root element of an XML text.

    Raises:
        RobotError: where it is not well-formed, with the line and column.
    """
    parser = expat.ParserCreate()
    root: list[Node] = []
    stack: list[Node] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        node = Node(tag, attributes, parser.CurrentLineNumber, parser.CurrentByteIndex)
        (stack[-1].children if stack else root).append(node)
        stack.append(node)

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda tag: stack.pop()
    try:
        parser.Parse(source, True)
    except expat.ExpatError as error:
        reason = expat.ErrorString(error.code)
        raise RobotError(f"{where}, line {error.lineno}, column {error.offset + 1}: not XML ({reason})") from None
    return root[0]


def edited(source: str, changes: Iterable[tuple[int, int, str]]) -> str:
    """Return the text with byte ranges (start, end, replacement) of its UTF-8 form replaced; they may not overlap."""
    data = source.encode("utf-8")
    for start, end, replacement in sorted(changes, reverse=True):
        data = data[:start] + replacement.encode("utf-8") + data[end:]
    return data.decode("utf-8")


def set_attributes(source: str, node: Node, values: dict[str, str]) -> list[tuple[int, int, str]]:
    """Return the changes (for `edited`) that give a node's attributes new values, in place or behind the last one."""
    data = source.encode("utf-8")
    found = {match[1].decode(): match for match in _attributes(data, node)}
    end = max([match.end() for match in found.values()], default=node.start + 1 + len(node.tag.encode()))
    changes = [(found[key].start(2) + 1, found[key].end(2) - 1, value) for key, value in values.items() if key in found]
    fresh = "".join(f' {key}="{value}"' for key, value in values.items() if key not in found)
    return [*changes, (end, end, fresh)] if fresh else changes


def insert_child(source: str, node: Node, child: str) -> list[tuple[int, int, str]]:
    """Return the change that puts a new first child into a node (an empty one is opened), indented as what follows."""
    data = source.encode("utf-8")
    last = max([match.end() for match in _attributes(data, node)], default=node.start)
    place = data.index(b">", last) + 1
    if data[place - 2 : place] == b"/>":
        return [(place - 2, place, f">{child}</{node.tag}>")]
    indent = _BLANK.match(data, place)
    return [(place, place, (indent[0].decode() if indent else "") + child)]


def _attributes(data: bytes, node: Node) -> Iterator[re.Match[bytes]]:
    """Yield the attributes of a node's start tag: name and quoted value."""
    place = node.start + 1 + len(node.tag.encode())
    while match := _ATTRIBUTE.match(data, place):
        yield match
        place = match.end()


def with_comment(content: bytes, words: str) -> bytes:
    """Return an XML file with a comment at its head, behind the declaration; ASCII, as any 8-bit encoding reads it.

    A file in UTF-16 is returned as it is.
    """
    if b"\0" in content[:4]:
        return content
    comment = f"<!-- {re.sub('-(?=-)', '- ', words)} -->".encode("ascii", "xmlcharrefreplace")
    bom = len(codecs.BOM_UTF8) if content.startswith(codecs.BOM_UTF8) else 0
    if not content[bom:].startswith(b"<?xml"):
        return content[:bom] + comment + b"\n" + content[bom:]
    start = content.index(b"?>") + 2
    return content[:start] + b"\n" + comment + content[start:]
