"""Lists and counts as text, for all messages."""

from collections.abc import Iterable


def listing(names: Iterable[object], most: int = 12) -> str:
    """Return the first `most` names separated by commas, and the number of further ones."""
    words = [str(name) for name in names]
    return ", ".join(words[:most]) + (f" and {len(words) - most} more" if len(words) > most else "")


def counted(number: int, noun: str, plural: str = "") -> str:
    """Return a count with its noun, as ``1 pose`` or ``3 poses``; `plural` if it is not noun + s."""
    return f"{number} {noun if number == 1 else plural or f'{noun}s'}"
