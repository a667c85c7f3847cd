"""Names of a session's recordings: the motion, then the labels of the payloads, as ``training_load_log.csv``."""

import re
from collections.abc import Iterable

# words that are no labels: parts of all recordings' names, and what `calib excite --load` calls a run without payload
RECORDING_WORDS = ("training", "validation", "log", "round", "none")


def log_name(motion: str, label: str = "") -> str:
    """Return the file name of a motion's recording.

    Args:
        motion: name of the motion, as its folder in ``6-excitation``.
        label: label of the payload; empty: without payload.
    """
    return f"{motion}_{label}_log.csv" if label else f"{motion}_log.csv"


def check_labels(labels: Iterable[str]) -> None:
    """Raise a ValueError if labels do not assign recordings to payloads by their names.

    No label may be a part of all recordings' names, and no two may differ by upper and lower case alone.
    """
    seen: dict[str, str] = {}
    for label in labels:
        rival = seen.setdefault(label.lower(), label)
        if rival != label:
            raise ValueError(
                f"payloads: '{rival}' and '{label}' differ by upper and lower case alone, which files' names do not "
                "tell apart; choose another label"
            )
        if label.lower() in RECORDING_WORDS or re.fullmatch(r"round\d+", label.lower()):
            raise ValueError(f"payloads: '{label}' is a part of all recordings' names; choose another label")


def labels_in(name: str, labels: Iterable[str]) -> tuple[str, ...]:
    """Return the labels that are words of a recording's name, such as ``load`` of ``training_load_log``.

    A number may follow a label, as in ``training_load2_log``; where a longer label matches, only this one counts.
    Without such words the labels count with which a word begins, as in ``training_loaded_log``.

    Args:
        name: file name of the recording.
        labels: labels of all payloads.
    """
    as_words = _spans(name, labels, r"(?![^\W_])")
    return as_words or _spans(name, labels, "")


def _spans(name: str, labels: Iterable[str], end: str) -> tuple[str, ...]:
    """Return the labels at the beginnings of words in a name, without those inside a longer match.

    Args:
        name: the name.
        labels: the labels.
        end: pattern behind a label and its number.
    """
    matches = {}
    for label in labels:
        number = r"" if label[-1].isdigit() else r"\d*"
        match = re.search(rf"(?<![^\W_]){re.escape(label)}{number}{end}", name, re.IGNORECASE)
        if match is not None:
            matches[label] = match.span()
    longest = []
    for label, (start, stop) in matches.items():
        is_part = False
        for rival, (first, last) in matches.items():
            is_part = is_part or (first <= start and stop <= last and len(rival) > len(label))
        if not is_part:
            longest.append(label)
    return tuple(longest)
