"""Recordings that nobody here made: what they hold, and what is found in them."""

import numpy as np
import pytest

from calib.data.recordings.recording_files import read_recording
from calib.data.signals.motion import make_motion
from calib.data.signals.persistency import repeats, report_excitation

PANDA = "franka_panda_inria/traj1_first60pct.npz"
LWR = "kuka_lwr4plus_iit/measurements_1.npz"
UR = "ur10e_innopolis/ur-20_02_19_14harm50sec"


@pytest.mark.parametrize(
    ("file", "samples", "joints", "kind", "clock"),
    [
        pytest.param(PANDA, 12326, 7, "torque", "counted", marks=pytest.mark.slow),
        (LWR, 5027, 7, "torque", "even"),
        pytest.param("staubli_tx40/tx40_first_5p4s.npz", 27000, 6, "torque", "stamps", marks=pytest.mark.slow),
        ("kuka_kr300_tuk/traj_A.npz", 2501, 6, "torque", "stamps"),
        ("tiago_laas/dynamic.npz", 5870, 8, "current", "even"),
        (f"{UR}.npz", 4772, 6, "current", "stamps"),
    ],
)
def test_every_archive_becomes_a_motion(data, file, samples, joints, kind, clock):
    recording = read_recording(data / file)
    assert (len(recording), recording.n, recording.kind) == (samples, joints, kind)
    motion = make_motion(recording)
    assert motion.sampling.clock.kind == clock
    assert np.isfinite(motion.a).all() and len(motion) > 0.9 * samples
    assert 2.0 <= motion.cutoffs.dynamics <= 10.0  # robots' position loops; the slides' TX40: at most 10 Hz
    if file == PANDA:  # its samples are whole milliseconds apart
        report = motion.sampling
        assert report.rate == pytest.approx(1000.0, rel=2e-4)
        assert report.repeated > 700 and report.lost > 800 and report.clock.roughness["counted"] < 0.05


def test_lwr_repeats_at_one_frequency(data):
    """The LWR moves at one frequency, and its second half repeats the first."""
    report = report_excitation(make_motion(read_recording(data / LWR)))
    assert report.poor and report.functions == 2
    halves = [make_motion(read_recording(f"{data / LWR}@{part}")) for part in ("0:13", "13:")]
    assert repeats(*halves) > 0.8


@pytest.mark.slow
def test_panda_and_ur10e_do_not_repeat(data):
    """The Panda and the UR10e do not repeat, but a loaded run does."""
    first, rest = (make_motion(read_recording(f"{data / PANDA}@{part}")) for part in ("0:9.4", "9.4:"))
    assert repeats(first, rest) < 0.05 and not report_excitation(first).poor
    free, loaded, other = (
        make_motion(read_recording(data / f"{name}.npz"))
        for name in (UR, f"{UR}Load", "ur10e_innopolis/ur-20_02_10-30sec_12harm")
    )
    assert repeats(free, loaded) > 0.95 and repeats(other, free) < 0.1
