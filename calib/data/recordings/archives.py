"""Recordings in NumPy archives (.npz).

Beside the names of `recording_options` an archive may hold ``joint_names`` (n texts), ``drive_gain`` (n) and
``use_range`` (first row, end row; from 0), which is followed unless the path has a cut of its own or the options say
otherwise. An average over repeats (`calib recall`) says how noisy it is: ``variance_tau`` (or the effort's name; N, n)
of a single sample, and the number of ``periods`` averaged. Members are decompressed one after the other, some rows
at a time, and only the rows asked for are kept: time grows with the file (some 200 MB/s), memory with what is used.
"""

import lzma
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from math import prod
from pathlib import Path
from typing import IO, NoReturn

import numpy as np
from numpy.lib import format as npy

from calib.data.recordings.recording import Ends, Recording, rows_in_pieces, rows_used
from calib.data.recordings.recording_options import (
    KEYS_BESIDE_SERIES,
    RATES,
    SYNONYMS,
    RecordingOptions,
    find_names,
    joint_order,
    one_effort,
)
from calib.data.recordings.stamps import in_seconds, likely_unit
from calib.data.schema import Joints
from calib.errors import MeasurementError, refuse_data, refused_as, require
from calib.records import read_only

# Largest number of members of an archive, and size of a member [B] (our choices).
MAX_MEMBERS = 1000
MAX_BYTES = 8_000_000_000
# Rows read at a time.
CHUNK = 1 << 16


def read_archive(path: Path, joints: Joints | None, options: RecordingOptions, ends: Ends = (None, None)) -> Recording:
    """Return the recording in a NumPy archive (.npz) from ends[0] to ends[1] [s]; values are not checked.

    Args:
        path: the archive.
        joints: the robot's joints, in whose order columns are put; None: as in the file.
        options: options for reading the file.
        ends: begin and end of the part to read; None: no bound.
    """
    with _opened(path) as archive:
        return _recording(archive, joints, options, ends)


def read_archived_positions(path: Path, joints: Joints, options: RecordingOptions) -> tuple[np.ndarray, np.ndarray]:
    """Return the time stamps (N,) [s] and reference positions (N, n) in an archive: q_ref, or q without q_ref.

    Args:
        path: the archive.
        joints: the robot's n joints, in whose order columns are put.
        options: options for reading the file.
    """
    with _opened(path) as archive:
        names = find_names(tuple(archive.members), options, path)
        series = "q_ref" if "q_ref" in names else "q"
        if series not in names:
            archive.fail(f"a reference needs t and q_ref (or q); found: {', '.join(archive.members)}")
        q = archive.read(names[series])
        if q.ndim != 2:
            archive.fail(f"has shape {q.shape}, expected (samples, joints)", names[series])
        order = joint_order(_joint_names(archive), joints, q.shape[1], path)[0]
        t, _ = _stamps(archive, names, options, len(q))
        return t, _arrange(q - options.zero(series), order, options.factor(series))


@contextmanager
def _opened(path: Path) -> Iterator["_Archive"]:
    packed = (RuntimeError, NotImplementedError)  # zipfile's for a password, and for unknown compression
    damaged = (zipfile.BadZipFile, EOFError, zlib.error, lzma.LZMAError, struct.error, UnicodeError)
    with (
        refused_as(MeasurementError, OSError, "cannot be read: {}", path),
        refused_as(MeasurementError, packed, "cannot be unpacked ({}): save it with np.savez", path),
        refused_as(MeasurementError, damaged, "is a damaged archive ({}): is the copy complete?", path),
        zipfile.ZipFile(path) as archive,
    ):
        yield _Archive(archive, path)


@dataclass(frozen=True)
class _Archive:
    """An open NumPy archive `file`, and its `path`."""

    file: zipfile.ZipFile
    path: Path

    @cached_property
    def members(self) -> dict[str, str]:
        """Name of each array in the archive to its file name there."""
        return {name.removesuffix(".npy"): name for name in self.file.namelist()}

    def fail(self, message: str, name: str | None = None) -> NoReturn:
        """Raise MeasurementError about the archive; with `name`, about one of its arrays.

        Args:
            message: text of the error; the file's name is prepended.
            name: name of the array; None: the whole archive.
        """
        refuse_data(self.path, message, name)

    def header(self, name: str) -> tuple[IO[bytes], tuple[int, ...], bool, np.dtype]:
        """Return the stream of an array's data, the array's shape, whether it is in Fortran order, and its dtype.

        Args:
            name: name of the array.
        """
        member = self.members[name]
        stream = self.file.open(member)
        # What numpy's reader of headers raises, and Python's parser in it.
        errors = (ValueError, TypeError, KeyError, SyntaxError, tokenize.TokenError, RecursionError, OverflowError)
        with refused_as(MeasurementError, errors, "not a NumPy array ({})", self.path, None, name):
            version = npy.read_magic(stream)
            read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
            shape, fortran, dtype = read(stream)
        size = prod(shape) * dtype.itemsize
        if dtype.hasobject:
            self.fail("contains Python objects, which could run code and are not read: save plain arrays", name)
        if any(length < 0 for length in shape) or size > self.file.getinfo(member).file_size:
            self.fail(f"states the shape {shape}, but the file is shorter: is the copy complete?", name)
        if size > MAX_BYTES:
            self.fail(f"has {size / 1e9:.3g} GB, the limit is {MAX_BYTES / 1e9:g} GB: save a shorter recording", name)
        return stream, shape, fortran, dtype

    def read(self, name: str, rows: np.ndarray | None = None, exact: bool = False, kinds: str = "fiub") -> np.ndarray:
        """Return an array of the archive as floats: all rows, or only some.

        Args:
            name: name of the array.
            rows: increasing indices of the rows to return; None for all.
            exact: return the array with its stored dtype.
            kinds: accepted kinds of dtype, as letters of ``dtype.kind``.
        """
        stream, shape, fortran, dtype = self.header(name)
        with stream:
            if dtype.kind not in kinds:
                self.fail(f"contains {dtype}, expected {'texts' if 'U' in kinds else 'numbers'}", name)
            result_type = dtype if exact else np.dtype(float)
            if rows is None or fortran or not shape:
                values = np.frombuffer(stream.read(), dtype, prod(shape))
                values = values.reshape(shape, order="F" if fortran else "C")
                if rows is not None and shape:
                    values = values[rows]
                return values.astype(result_type, copy=False)
            # A member of another length is refused later.
            rows = rows[: np.searchsorted(rows, shape[0])]
            result = np.empty((len(rows), *shape[1:]), result_type)
            row_size = prod(shape[1:]) * dtype.itemsize
            for start in range(0, shape[0], CHUNK):
                count = min(CHUNK, shape[0] - start)
                chunk = np.frombuffer(stream.read(count * row_size), dtype).reshape(count, *shape[1:])
                in_chunk = slice(*np.searchsorted(rows, (start, start + CHUNK)))
                result[in_chunk] = chunk[rows[in_chunk] - start]
        return result

    def few(self, name: str, count: int) -> np.ndarray | None:
        """Return an array of `count` finite numbers; None if the archive has no array of this name."""
        if name not in self.members:
            return None
        values = self.read(name, kinds="fiu").ravel()
        if len(values) != count or not np.isfinite(values).all():
            shown = np.array2string(values, threshold=8, edgeitems=3)
            self.fail(f"expected {count} finite number(s), found {shown[:100]}", name)
        return values


def _recording(archive: _Archive, joints: Joints | None, options: RecordingOptions, ends: Ends) -> Recording:
    count, path = len(archive.file.infolist()), archive.path
    require(count <= MAX_MEMBERS, f"has {count} members: is this a recording?", MeasurementError, path)
    members = tuple(archive.members)
    names = one_effort(find_names(members, options, path), options, members, path)
    stream, shape, _, _ = archive.header(names["q"])
    stream.close()
    sample_count = shape[0] if shape else 0
    t, time_notes = _stamps(archive, names, options, sample_count)
    rows, notes = _used(archive, t, options, ends)
    q = archive.read(names["q"], rows)
    if q.ndim != 2:
        archive.fail(f"has shape {q.shape}, expected (samples, joints)", names["q"])
    kind = "current" if "current" in names else "torque"
    order, joint_names = joint_order(_joint_names(archive), joints, q.shape[1], path)
    notes = [*time_notes, *notes]
    series = {}
    for name, member in names.items():
        if name in ("t", "q"):
            continue
        values = archive.read(member, rows)
        if values.shape != q.shape:
            archive.fail(f"has shape {values.shape}, {names['q']} has {q.shape} (samples, joints)", member)
        series["effort" if name == kind else name] = _arrange(values - options.zero(name), order, options.factor(name))

    gain = archive.few("drive_gain", q.shape[1])
    if gain is not None:
        if (gain == 0.0).any():
            archive.fail("has a gain of zero: the current would cause no torque", "drive_gain")
        gain = gain[order]
    variance_member = f"variance_{names.get(kind, '')}"
    variance = _variance(archive, variance_member, q.shape, rows)
    if variance is not None:
        variance = variance[order] * options.factor(kind) ** 2
    read_members = (*names.values(), *KEYS_BESIDE_SERIES, *RATES, "periods", variance_member)
    unused = [member for member in archive.members if member not in read_members]
    if unused:
        notes = [*notes, f"not read: {', '.join(sorted(unused))}"]
    return Recording(
        t[rows],
        _arrange(q - options.zero("q"), order, options.factor("q")),
        kind=kind,
        joint_names=joint_names,
        drive_gain=gain,
        effort_variance=variance,
        file=str(path),
        rows=rows + 1,
        notes=tuple(notes),
        **series,  # ty: ignore[invalid-argument-type]
    )


def _variance(archive: _Archive, name: str, shape: tuple[int, ...], rows: np.ndarray) -> np.ndarray | None:
    """Return each joint's mean variance (n,) of an effort that was averaged over periods; None if unknown.

    It is the stored variance of a single sample divided by the number of periods.

    Args:
        archive: the archive.
        name: name of the array with the variance of a single sample.
        shape: expected shape of this array.
        rows: indices of the rows in use.
    """
    periods = archive.few("periods", 1)
    if name not in archive.members or periods is None:
        return None
    values = archive.read(name, rows)
    if values.shape != shape:
        archive.fail(f"has shape {values.shape}, expected {shape} (samples, joints)", name)
    if not (periods[0] >= 1 and np.isfinite(values).all() and (values >= 0).all()):
        archive.fail(
            f"periods is {periods[0]:g}; expected 1 or more, and variances that are finite and not negative", name
        )
    return np.asarray(values.mean(axis=0) / periods[0])


def _stamps(
    archive: _Archive, names: Mapping[str, str], options: RecordingOptions, count: int
) -> tuple[np.ndarray, list[str]]:
    """Return the times (N,) [s] of all samples since the first one, from time stamps or a sampling rate, and notes.

    Args:
        archive: the archive.
        names: the toolkit's name of a series to the archive's.
        options: options for reading the file, which may state a sampling rate.
        count: number N of samples.
    """
    if "t" not in names:
        rate = options.rate or _rate(archive)
        if not rate > 0:
            expected = f"{', '.join(SYNONYMS['t'])}, or {', '.join(RATES)}"
            archive.fail(f"has neither stamps nor a rate ({expected}); found: {', '.join(archive.members)}")
        return np.arange(count) / rate, []
    t = archive.read(names["t"], exact=True, kinds="fiu").ravel()
    if len(t) != count:
        archive.fail(f"has {len(t)} stamps, q has {count} samples", names["t"])
    if not len(t):
        return t.astype(float), []
    if not options.units.get("t") and likely_unit(t.astype(float)):
        return in_seconds(t)
    return (t - t[0]).astype(float) * options.factor("t"), []


def _rate(archive: _Archive) -> float:
    """Return the sampling rate that is stored in the archive [Hz]; 0 if there is none."""
    for name in RATES:
        rate = archive.few(name, 1)
        if rate is not None:
            return float(rate[0])
    return 0.0


def _used(archive: _Archive, t: np.ndarray, options: RecordingOptions, ends: Ends) -> tuple[np.ndarray, list[str]]:
    """Return the indices of the rows to read, and notes.

    These are the rows within `ends` if given, otherwise within the archive's ``use_range`` if it has one, otherwise
    all. If there are more than `options.samples`, pieces spread over them are read.

    Args:
        archive: the archive.
        t: (N,) times of all samples [s].
        options: options for reading the file.
        ends: begin and end of the part to read [s]; (None, None): no bounds.
    """
    use_range = None
    if options.use_range and ends == (None, None):
        use_range = archive.few("use_range", 2)
    if use_range is None:
        return rows_used(t, ends, options.samples, archive.path)
    first, end = (int(value) for value in np.clip(use_range, -1, len(t) + 1))
    if not 0 <= first < end <= len(t):
        archive.fail(f"is {first} to {end}, the file has {len(t)} samples", "use_range")
    rows, notes = rows_in_pieces(t, first, end, options.samples)
    if (first, end) != (0, len(t)):
        notes.append(f"rows {first + 1} to {end} of {len(t)} are used, as its use_range states")
    return rows, notes


def _joint_names(archive: _Archive) -> list[str]:
    """Return the joint names that are stored in the archive; an empty list if there are none."""
    if "joint_names" not in archive.members:
        return []
    names = []
    for name in archive.read("joint_names", exact=True, kinds="US").ravel().tolist():
        if isinstance(name, bytes):
            name = name.decode("utf-8", "replace")
        names.append(str(name))
    return names


def _arrange(values: np.ndarray, order: list[int], factor: float) -> np.ndarray:
    """Return the columns of an array in the order of indices `order`, multiplied by `factor`.

    The array is copied only if order or unit changes.

    Args:
        values: (N, n) array.
        order: column indices of the robot's joints.
        factor: factor to SI.
    """
    if order != list(range(values.shape[1])):
        values = values[:, order]
    if factor != 1.0:
        values = values * factor
    return read_only(values)
