"""Logs of half a recording, positions in one file and torques or currents in another, which are joined in the page.

They wait in ``7-recorded/received/KIND``, as joint values and points do (`calib.apps.serve.received`).
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from calib.apps.joining.logs import join_logs, quantities
from calib.apps.serve.received import (
    FILES,
    Pairing,
    Received,
    file_of,
    place,
    sources_of_joined,
    store_joined,
    take_joined,
    waiting,
)
from calib.errors import CalibError, counted, listing
from calib.toolkit.pose_data import read_header, read_table
from calib.toolkit.recordings import read_recording, series_of, words_of
from calib.toolkit.result_folders import joints_of
from calib.toolkit.sessions import ROUND, Session, chain_of, labels_in, log_name, options_of, recorded_columns

POSITIONS, EFFORTS = "positions", "efforts"
# series of the toolkit in each half of a recording
SERIES = {POSITIONS: ("q",), EFFORTS: ("torque", "current", "tau_link", "tau_motor")}
CONTENTS = {POSITIONS: "positions without torques or currents", EFFORTS: "torques or currents without positions"}
# ways to join two logs
METHODS = ("time", "row")
# motion that a kind of logs is of
MOTIONS = {"training": "training", "unseen": "validation"}
# columns that a message names
MAX_LISTED = 8


def half_of(header: Sequence[str], stem: str) -> str:
    """Return which half of a recording a log holds; empty for both halves, and for neither.

    Where the columns tell one half at most, the file's name overrules them, as in `join_logs`.

    Args:
        header: names of its columns.
        stem: the file's name without its ending.
    """
    by_columns = _halves(quantities(header))
    by_name = _halves({series_of(words_of(stem))})
    halves = by_columns
    if len(by_columns) < len(SERIES) and by_name:
        halves = by_name
    if len(halves) == 1:
        return halves[0]
    return ""


def _halves(series: set[str]) -> list[str]:
    """Return the halves of a recording of which there are series."""
    return [half for half, names in SERIES.items() if not series.isdisjoint(names)]


def put_halves_apart(session: Session, kind: str, paths: Sequence[Path]) -> list[Path]:
    """Move logs of half a recording to where they wait for the other half, and return the paths of the other logs.

    A log that the session reads, by its options too, is no half.
    """
    other_paths = []
    for path in paths:
        if not _is_half(session, path):
            other_paths.append(path)
            continue
        target = place(session, kind, FILES) / path.name
        target.parent.mkdir(parents=True, exist_ok=True)
        path.replace(target)
    return other_paths


def _is_half(session: Session, path: Path) -> bool:
    """Return whether a log is a CSV file of half a recording, which the columns that options state do not complete."""
    if path.suffix.lower() != ".csv":
        return False
    try:
        header, _ = read_header(path)
        settings = options_of(session).file_settings(path)
    except CalibError:
        # the check of the log says what is wrong
        return False
    if not half_of(header, path.stem):
        return False
    if not settings.recording.columns:
        return True
    try:
        read_recording(path, joints_of(chain_of(session)), settings.recording)
    except (CalibError, OSError):
        return True
    return False


def halves(session: Session, kind: str) -> list[Received]:
    """Return the logs of half a recording that wait, with what each holds."""
    parts = []
    for path in waiting(session, kind):
        header, _ = read_header(path)
        role = half_of(header, path.stem)
        if role:
            message = f"{CONTENTS[role]}: {listing(header, MAX_LISTED)}"
            parts.append(Received(path.name, role, message))
    return parts


def pairing_of(parts: Sequence[Received]) -> Pairing | None:
    """Return the two logs that are joined without a question: if each half is there once; otherwise None."""
    positions = [part.name for part in parts if part.role == POSITIONS]
    efforts = [part.name for part in parts if part.role == EFFORTS]
    if len(positions) == len(efforts) == 1:
        return Pairing(positions[0], efforts[0])
    return None


def missing_half(session: Session, parts: Sequence[Received]) -> str:
    """Return a line on what the other file of a recording must hold; empty where both halves or neither wait."""
    roles = {part.role for part in parts}
    if len(roles) != 1:
        return ""
    time, *columns = recorded_columns(session)
    count = chain_of(session).n
    content, headings = "positions", columns[:count]
    if POSITIONS in roles:
        content, headings = "torques or currents", columns[count:]
    return (
        f"The {content} of this motion are missing: upload the log that holds them, with a column of times of the same "
        f"clock ({time}) and a column for each joint, such as {headings[0]} to {headings[-1]}. If this log holds them "
        "under other names, state these in the options ([columns]) and upload it again."
    )


def join_halves(session: Session, kind: str, pairing: Pairing) -> list[str]:
    """Join two received logs, store the recording for the page, and return notes on what was mapped and paired.

    Raises:
        CalibError: the logs cannot be joined; the message says what to try.
    """
    sources = [file_of(session, kind, name) for name in (pairing.joints, pairing.points)]
    first, second = [replace(read_table(path), file=path.name) for path in sources]
    joined = join_logs(first, second, pairing.by)
    source = f"positions of {first.file}, torques or currents of {second.file}"
    joined = replace(joined, notes=(source, *joined.notes))
    store_joined(session, kind, joined, sources)
    return [*joined.notes, counted(len(joined.table), "sample")]


def take_recording(session: Session, kind: str) -> Path:
    """Make the joined logs a recording of a session's step, and return its path.

    Its name is that for which the session waits, with the further motion (``round2``) and the labels of payloads that
    the names of the two logs contain.

    Raises:
        UsageError: nothing is joined.
    """
    stems = " ".join(path.stem for path in sources_of_joined(session, kind))
    labels = labels_in(stems, options_of(session).settings.payloads)
    motion = MOTIONS[kind]
    further_motion = re.search(rf"{ROUND}\d+", stems.lower())
    if further_motion and kind == "training":
        motion = further_motion[0]
    return take_joined(session, kind, log_name(motion, "_".join(labels)))
