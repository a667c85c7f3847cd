"""Recordings in NumPy archives (.npz).

Beside the names of `recording_options` an archive may hold ``joint_names`` (n texts), ``drive_gain`` (n) and
``use_range`` (first row, end row; from 0), which is followed unless the path has a cut of its own or the options say
otherwise. An average over repeats (`calib recall`) says how noisy it is: ``variance_tau`` (or the effort's name; N, n)
of a single sample, and the number of ``periods`` averaged. Members are decompressed one after the other and only the
rows asked for are kept: a compressed member cannot be mapped into memory, so time grows with the file (some 200 MB/s)
and memory with the cut.
"""

from __future__ import annotations

import lzma
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from math import prod
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from calib.data.recordings.recording import Joints, Recording, read_only, span
from calib.data.recordings.recording_options import (
    OWN,
    RATES,
    SYNONYMS,
    RecordingOptions,
    find_names,
    joint_order,
    scale,
)
from calib.errors import MeasurementError

MEMBERS, LARGEST = 1000, 8_000_000_000  # of an archive, and bytes of a member (our choices)
Ends = tuple[float | None, float | None]


def read_archive(
    path: Path, joints: Joints | None = None, options: RecordingOptions | None = None, ends: Ends = (None, None)
) -> Recording:
    """Return the rows of a NumPy archive (.npz) from ends[0] to ends[1] [s], unchecked but for their shapes."""
    options = options or RecordingOptions()
    try:
        with zipfile.ZipFile(path) as archive:
            return _from_archive(archive, path, joints, options, ends)
    except (zipfile.BadZipFile, EOFError, zlib.error, lzma.LZMAError, struct.error, UnicodeError) as error:
        raise MeasurementError(f"is a damaged archive ({error}): was it copied whole?", path) from error
    except (RuntimeError, NotImplementedError) as error:  # zipfile's words for a password, and for unknown compression
        raise MeasurementError(f"cannot be unpacked ({error}): save it with np.savez", path) from error
    except OSError as error:
        raise MeasurementError(f"cannot be read: {error.strerror or error}", path) from error


def _from_archive(
    archive: zipfile.ZipFile, path: Path, joints: Joints | None, options: RecordingOptions, ends: Ends
) -> Recording:
    if len(archive.infolist()) > MEMBERS:
        raise MeasurementError(f"has {len(archive.infolist())} members: is this a recording?", path)
    members = {name.removesuffix(".npy"): name for name in archive.namelist()}
    found = find_names(tuple(members), options, path)
    count = _shape(archive, members[found["q"]], path)[0]
    t = _stamps(archive, members, found, options, count, path)
    rows, notes = _range(archive, members, t, options, ends, path)
    q = _member(archive, members[found["q"]], path, rows)
    if q.ndim != 2:
        raise MeasurementError(f"has shape {q.shape}, expected (samples, joints)", path, column=found["q"])
    kind = "current" if "current" in found else "torque"
    names = _names(archive, members, path)
    order, names = joint_order(names, joints, q.shape[1], path)
    series = {}
    for ours, theirs in found.items():
        if ours in ("t", "q"):
            continue
        values = _member(archive, members[theirs], path, rows)
        if values.shape != q.shape:
            message = f"has shape {values.shape} where {found['q']} has {q.shape} (samples, joints)"
            raise MeasurementError(message, path, column=theirs)
        series["effort" if ours == kind else ours] = _arrange(values, order, scale(ours, options.units.get(ours, "")))
    gain = _few(archive, members, "drive_gain", path, q.shape[1])
    if gain is not None and (gain == 0.0).any():
        raise MeasurementError("has a gain of zero: no current makes a torque there", path, column="drive_gain")
    factor = scale(kind, options.units.get(kind, ""))
    variance = f"variance_{found.get(kind, '')}"
    unused = [name for name in members if name not in (*found.values(), *OWN, *RATES, "periods", variance)]
    return Recording(
        t[rows],
        _arrange(q, order, scale("q", options.units.get("q", ""))),
        kind=kind,
        joint_names=names,
        drive_gain=None if gain is None else gain[order],
        effort_variance=_variance(archive, members, variance, path, q.shape, rows, order, factor),
        file=str(path),
        rows=np.arange(rows.start, rows.stop) + 1,
        notes=(*notes, *([f"not read: {', '.join(sorted(unused))}"] if unused else [])),
        **series,
    )


def _variance(
    archive: zipfile.ZipFile, members: Mapping[str, str], name: str, path: Path, shape: tuple[int, ...], rows: slice,
    order: list[int], factor: float,
) -> np.ndarray | None:  # fmt: skip
    """Return the mean variance (n,) of the averaged effort: that of one sample over the number of periods."""
    if name not in members or "periods" not in members:
        return None
    values = _member(archive, members[name], path, rows)
    if values.shape != shape:
        raise MeasurementError(f"has shape {values.shape}, expected {shape} (samples, joints)", path, column=name)
    (periods,) = _few(archive, members, "periods", path, 1)  # type: ignore[misc]  # it is there
    if not (periods >= 1 and np.isfinite(values).all() and (values >= 0).all()):
        message = f"expected variances, finite and not negative, over one period or more; periods is {periods:g}"
        raise MeasurementError(message, path, column=name)
    return np.asarray(values.mean(axis=0)[order] * factor**2 / periods)


def _stamps(
    archive: zipfile.ZipFile,
    members: Mapping[str, str],
    found: Mapping[str, str],
    options: RecordingOptions,
    count: int,
    path: Path,
) -> np.ndarray:
    """Return all stamps (N,) [s] from the first, or the counts of the samples over a stated rate."""
    if "t" not in found:
        stated = next((name for name in RATES if name in members), "")
        own = _few(archive, members, stated, path, 1) if stated and not options.rate else None
        rate = options.rate or (0.0 if own is None else float(own[0]))
        if not rate > 0:
            wanted = f"{', '.join(SYNONYMS['t'])}, or {', '.join(RATES)}"
            raise MeasurementError(f"has neither stamps nor a rate ({wanted}); found: {', '.join(members)}", path)
        return np.arange(count) / rate
    t = _member(archive, members[found["t"]], path, exact=True, kinds="fiu").ravel()
    if len(t) != count:
        raise MeasurementError(f"has {len(t)} stamps where q has {count} samples", path, column=found["t"])
    return (t - t[0] if len(t) else t).astype(float) * scale("t", options.units.get("t", ""))


def _range(
    archive: zipfile.ZipFile,
    members: Mapping[str, str],
    t: np.ndarray,
    options: RecordingOptions,
    ends: Ends,
    path: Path,
) -> tuple[slice, list[str]]:
    """Return the rows to read: of the cut, else of the file's use_range, else all."""
    if ends != (None, None):
        ordered = np.maximum.accumulate(np.nan_to_num(t, nan=-np.inf))  # time that runs back is refused later
        first, end = span(ordered, *ends)
        if first >= end:
            Recording(t, np.zeros((len(t), 0)), np.zeros((len(t), 0)), "torque", (), file=str(path)).cut(*ends)
        return slice(first, end), []
    stated = _few(archive, members, "use_range", path, 2) if options.use_range else None
    if stated is None:
        return slice(0, len(t)), []
    first, end = (int(value) for value in np.clip(stated, -1, len(t) + 1))
    if not 0 <= first < end <= len(t):
        raise MeasurementError(f"is {first} to {end}, but there are {len(t)} samples", path, column="use_range")
    whole = first == 0 and end == len(t)
    return slice(first, end), [] if whole else [f"rows {first + 1} to {end} of {len(t)} are used: its use_range"]


def _few(archive: zipfile.ZipFile, members: Mapping[str, str], name: str, path: Path, count: int) -> np.ndarray | None:
    """Return a member of `count` finite numbers; None where there is none of that name."""
    if name not in members:
        return None
    values = _member(archive, members[name], path, kinds="fiu").ravel()
    if len(values) != count or not np.isfinite(values).all():
        shown = np.array2string(values, threshold=8, edgeitems=3)
        raise MeasurementError(f"expected {count} finite number(s), found {shown[:100]}", path, column=name)
    return values


def _names(archive: zipfile.ZipFile, members: Mapping[str, str], path: Path) -> list[str]:
    """Return the joints' names; none where the archive has none."""
    if "joint_names" not in members:
        return []
    values = _member(archive, members["joint_names"], path, exact=True, kinds="US").ravel()
    return [name.decode("utf-8", "replace") if isinstance(name, bytes) else str(name) for name in values.tolist()]


def _header(archive: zipfile.ZipFile, member: str, path: Path) -> tuple[IO[bytes], tuple[int, ...], bool, np.dtype]:
    """Open a member behind its header; returns it with shape, order and type."""
    stream, column = archive.open(member), member.removesuffix(".npy")
    try:
        version = npy.read_magic(stream)
        read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, fortran, dtype = read(stream)
    except (ValueError, TypeError, KeyError, SyntaxError, tokenize.TokenError, RecursionError, OverflowError) as error:
        stream.close()
        raise MeasurementError(f"is no NumPy array ({error})", path, column=column) from error
    message, size = "", prod(shape) * dtype.itemsize
    if dtype.hasobject:
        message = "holds Python objects, which are not read (they could run code): save plain arrays"
    elif any(length < 0 for length in shape) or size > archive.getinfo(member).file_size:
        message = f"says that it is {shape}, which is more than there is: was it copied whole?"
    elif size > LARGEST:
        message = f"holds {size / 1e9:.3g} GB, more than {LARGEST / 1e9:g}: cut the recording"
    if message:
        stream.close()
        raise MeasurementError(message, path, column=column)
    return stream, shape, fortran, dtype


def _shape(archive: zipfile.ZipFile, member: str, path: Path) -> tuple[int, ...]:
    stream, shape, _, _ = _header(archive, member, path)
    stream.close()
    return shape or (0,)


def _member(
    archive: zipfile.ZipFile, member: str, path: Path, rows: slice | None = None, exact: bool = False,
    kinds: str = "fiub",
) -> np.ndarray:  # fmt: skip
    """Return the `rows` of a member as floats (with `exact` in its own type) without holding the others.

    Args:
        kinds: of numpy's types that are what it should hold.
    """
    stream, shape, fortran, dtype = _header(archive, member, path)
    if dtype.kind not in kinds:
        stream.close()
        wanted = "texts" if "U" in kinds else "numbers"
        raise MeasurementError(f"holds {dtype}, expected {wanted}", path, column=member.removesuffix(".npy"))
    with stream:
        if fortran or not shape or rows is None:
            rows = slice(0, shape[0] if shape else 1) if rows is None else rows
            values = np.frombuffer(stream.read(), dtype).reshape(shape, order="F" if fortran else "C")
            values = values[rows] if shape else values
        else:
            size = dtype.itemsize * int(np.prod(shape[1:]))
            _skip(stream, rows.start * size)
            values = np.frombuffer(stream.read((rows.stop - rows.start) * size), dtype).reshape(-1, *shape[1:])
        _skip(stream, 1 << 62)  # to its end: the sum that tells damage is checked there
    return values if exact else values.astype(float)


def _arrange(values: np.ndarray, order: list[int], factor: float) -> np.ndarray:
    """Return the columns in `order`, in SI, without a copy where nothing is to do."""
    values = values if order == list(range(values.shape[1])) else values[:, order]
    return read_only(values if factor == 1.0 else values * factor)


def _skip(stream: IO[bytes], size: int) -> None:
    """Read `size` bytes, or to the end."""
    while size > 0 and (got := len(stream.read(min(size, 1 << 22)))):
        size -= got
