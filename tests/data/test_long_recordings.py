"""A recording longer than what is used is read in pieces: which rows, from every file, and what the user is told."""

import dataclasses
import re

import numpy as np
import pytest

from calib.data.recordings.recording import Recording, in_pieces, rows_in_pieces
from calib.data.recordings.recording_files import read_recording
from calib.data.recordings.recording_options import RecordingOptions
from calib.data.signals.motion import make_motion
from calib.data.signals.resampling import resample
from calib.errors import MeasurementError

RATE, SECONDS = 100.0, 1800
OPTIONS = RecordingOptions(samples=20_000)


@pytest.fixture(scope="module")
def recording() -> Recording:
    t = np.arange(int(SECONDS * RATE)) / RATE
    q = np.stack([np.sin(2 * np.pi * 0.3 * t), np.cos(2 * np.pi * 0.2 * t)], axis=1)
    noise = np.random.default_rng(0).normal(size=q.shape)
    return Recording.of(t, q + 1e-6 * noise, 3.0 * q + 0.1 * noise)


def test_pieces_spread_over_recording():
    """Pieces are spread over the recording, and as many as asked for."""
    rows, notes = rows_in_pieces(np.arange(181_000.0), 1000, 181_000, 20_000)
    parts = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    assert len(rows) == 20_000 and len(parts) == 20 and "20000 of 180000" in notes[0]
    for number, part in enumerate(parts):
        assert 1000 + 9000 * number <= part[0] and part[-1] < 1000 + 9000 * (number + 1)
    assert len({int(part[0] - 1000) % 9000 for part in parts}) > 15  # no phase of a motion is met each time


def test_cut_leads_around_all_time_faults(recording, tmp_path):
    """Faults of the time are counted over the whole log, and the cut leads around all of them."""
    t = recording.t.copy()
    back = np.random.default_rng(1).choice(len(t) // 2, 150, replace=False)
    t[back] -= 0.5
    path = tmp_path / "log.npz"
    np.savez(path, t=t, q=recording.q, tau=recording.effort)
    with pytest.raises(MeasurementError, match="time goes back") as error:
        read_recording(path, options=OPTIONS)
    steps = int((np.diff(t) < 0).sum())
    assert f"(and in {steps - 1} more rows)" in str(error.value)
    (cut,) = re.findall(r"@[\d.]+:[\d.]+", str(error.value))
    part = read_recording(f"{path}{cut}", options=OPTIONS)
    assert part.t[-1] - part.t[0] > 800.0


def test_value_faults_count_in_rows_read(recording, tmp_path):
    """Faults of values are counted among the rows that were read."""
    q = recording.q.copy()
    q[::1000, 1] = np.nan
    np.savez(tmp_path / "log.npz", t=recording.t, q=q, tau=recording.effort)
    with pytest.raises(MeasurementError, match=r"found nan; cut this part out \(and in 19 more rows of the 20000 read"):
        read_recording(tmp_path / "log.npz", options=OPTIONS)
    with pytest.raises(
        MeasurementError, match=r"longest part .* is @0.01:9.99 \(and in 179 more rows; of all, 180 in q"
    ):
        read_recording(tmp_path / "log.npz")


def test_a_short_recording_is_used_whole(recording):
    assert all(in_pieces(recording, most) is recording for most in (10**6, 150_000, None))
    assert len(in_pieces(recording, 140_000)) == 140_000
    rows, notes = rows_in_pieces(np.arange(50.0), 3, 50, 47)
    np.testing.assert_array_equal(rows, np.arange(3, 50))
    assert notes == []


@pytest.mark.parametrize(
    "save",
    [np.savez, pytest.param(np.savez_compressed, marks=pytest.mark.slow), pytest.param("csv", marks=pytest.mark.slow)],
)
def test_files_share_their_pieces(recording, save, tmp_path):
    """Every file is read in the same pieces."""
    if save == "csv":
        path = tmp_path / "log.csv"
        table = np.hstack([recording.t[:, None], recording.q, recording.effort])
        np.savetxt(path, table, delimiter=",", header="t,q1,q2,tau1,tau2", comments="", fmt="%.17g")
    else:
        path = tmp_path / "log.npz"
        save(path, t=recording.t, q=recording.q, tau=recording.effort)
    found, expected = read_recording(path, options=OPTIONS), in_pieces(recording, 20_000)
    for name in ("t", "q", "effort"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    np.testing.assert_array_equal(found.rows, expected.rows)
    assert sum("samples are used" in note for note in found.notes) == 1


def test_a_cut_is_taken_before_the_pieces(recording, tmp_path):
    np.savez(tmp_path / "log.npz", t=recording.t, q=recording.q, tau=recording.effort)
    found = read_recording(f"{tmp_path / 'log.npz'}@600:1200", options=OPTIONS)
    assert len(found) == 20_000 and found.t[0] >= 600.0 and 1180.0 < found.t[-1] < 1200.0


@pytest.mark.slow
def test_pieces_become_silent_segments(recording):
    """Pieces become segments without a line each."""
    used = in_pieces(recording, 20_000)
    sampled = resample(used)
    assert sampled.segment[-1] == 19 and sampled.report.lost == 0
    motion = make_motion(used, sampled=sampled)
    assert [line for line in motion.notes if "gap" in line] == [line for line in motion.notes if "19 gaps" in line]
    whole = make_motion(recording)
    where = np.searchsorted(whole.t, motion.t)
    np.testing.assert_allclose(motion.a, whole.a[where], atol=0.02 * np.ptp(whole.a))
    assert motion.decimator.factor == whole.decimator.factor


@pytest.mark.slow
def test_motion_at_the_end_alone_counts(recording):
    """Motion that fills only the end of a recording counts."""
    slow = 0.01 * np.sin(2 * np.pi * 0.05 * recording.t)[:, None]
    late = np.where(recording.t[:, None] > 900.0, recording.q, slow)
    motion = make_motion(in_pieces(dataclasses.replace(recording, q=late), 20_000))
    assert motion.cutoffs.band == pytest.approx(make_motion(in_pieces(recording, 20_000)).cutoffs.band, rel=0.3)


def test_impossible_sample_count_is_refused():
    """An impossible number of samples is refused."""
    from calib.errors import UsageError
    from calib.identification.identify_options import parse_options

    with pytest.raises(UsageError, match="samples"):
        parse_options({"recording": {"samples": 5}})
    assert parse_options({}).file_settings("a.npz").recording.samples == 600_000
    assert parse_options({"recording": {"samples": 10**7}}).file_settings("a.npz").recording.samples == 10**7
