"""Rows whose time stamps run backwards by a few steps are sorted; larger steps backwards are not.

Larger steps come from two joined logs, or from a clock that was set. Rows that were written in another order than they
were sampled (several threads or sockets) look like rows in the right order whose stamps jitter by more than a step.
Positions distinguish the two cases: of two orders of the same samples, the right one gives the shorter path.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from calib.data.recordings.recording import Recording

# Median steps, and time [s], by which a stamp may be earlier than one before it, to be put in order (our choice): the
# larger counts. Threads and sockets exchange rows by milliseconds, whatever the rate.
MAX_BACK, MAX_BACK_TIME = 5, 5e-3


def in_order(recording: Recording) -> Recording:
    """Return the recording sorted by time, with a note on it, if time stamps run back by up to `MAX_BACK` steps.

    Larger steps backwards are not sorted.
    """
    t = recording.t
    if len(t) < 2 or not np.isfinite(t).all() or not (np.diff(t) < 0.0).any():
        return recording
    edges = [0, *np.flatnonzero(goes_far_back(t)).tolist(), len(t)]
    parts = [slice(*ends) for ends in pairwise(edges)]
    back = np.concatenate([np.maximum.accumulate(t[part]) - t[part] for part in parts])
    if not 0.0 < back.max() <= _max_back(t):
        return recording
    order = np.concatenate([part.start + np.argsort(t[part], kind="stable") for part in parts])
    count = int((back > 0.0).sum())
    remark = f"{count} stamps are up to {1e3 * back.max():.3g} ms earlier than stamps before them"
    if _path_length(recording.q[order]) < _path_length(recording.q):
        ordered = recording.take(order)
        note = f"{remark}: the rows are sorted by their stamps"
    else:
        ordered = replace(recording, t=t[order])
        note = f"{remark}: the rows are in order, their stamps are sorted"
    return replace(ordered, notes=(*recording.notes, note))


def goes_far_back(t: np.ndarray) -> np.ndarray:
    """Return for each time stamp (N,) whether it is far earlier than the one before (`MAX_BACK`)."""
    return np.append(False, np.diff(t) < -_max_back(t))


def _max_back(t: np.ndarray) -> float:
    """Return by how much a stamp of t (N,) may be earlier than one before it, to be put in order [s]."""
    usual_step = float(np.median(np.abs(np.diff(t))))
    return max(MAX_BACK * usual_step, MAX_BACK_TIME)


def _path_length(q: np.ndarray) -> float:
    """Return the length of the path through positions q (N, n), with each joint in units of its range."""
    travel = np.ptp(q, axis=0)
    moves = travel > 0.0
    steps = np.abs(np.diff(q[:, moves], axis=0))
    return float((steps / travel[moves]).sum())
