"""Lists and numbers of things as text, for every message."""

from collections.abc import Iterable


def listing(names: Iterable[object], most: int = 12) -> str:
    """Return names with commas between them, the first `most` of them and how many more there are."""
    words = [str(name) for name in names]
    return ", ".join(words[:most]) + (f" and {len(words) - most} more" if len(words) > most else "")


def counted(number: int, noun: str, plural: str = "") -> str:
    """Return a number of things in words, as ``1 pose`` or ``3 poses``; `plural` where it is not noun + s."""
    return f"{number} {noun if number == 1 else plural or f'{noun}s'}"
