"""The time of a reference: found by the torques, refused where late; a copy of the positions is refused."""

from dataclasses import replace

import numpy as np
import pytest
import small_arm

from calib.data.recordings.recording import Recording
from calib.data.signals.filtering import low_pass
from calib.data.signals.motion import FilterOptions, make_motion
from calib.errors import MeasurementError
from calib.identification.closed_loop.loop_recordings import ClosedLoops, close_loops
from calib.identification.closed_loop.simulation import Sensing, simulate
from calib.identification.rows import make_case


def closed(shift: int = 0, timing: str = "checked", copied=None, noise: float = 0.0, **gains) -> ClosedLoops:
    """Return the loops of a log whose reference comes `shift` samples of 5 ms late, or is `copied` of the positions.

    `noise`: of the logged positions, which the loop did not feel.
    """
    plant, model, _ = small_arm.robot()
    run = simulate(plant, small_arm.PD, small_arm.motion(), Sensing(2e-5, sigma_tau=0.05, every=3.5), 1)
    asked = copied(run.measured) if copied else small_arm.motion().at(np.arange(len(run.t)) * 3.5)[0]
    rows, measured = slice(10, -10), run.measured + noise * np.random.default_rng(3).normal(size=run.measured.shape)
    late = Recording(
        run.t[rows], measured[rows], run.tau[rows], "torque", ("joint1", "joint2"),
        q_ref=np.roll(asked, shift, axis=0)[rows],
    )  # fmt: skip
    case = make_case("log", make_motion(late, FilterOptions(cutoff=40.0, band=20.0, clock="stamps")))
    return close_loops(model, [case], case.motion.decimator, replace(small_arm.LOOP, timing=timing, **gains))


def smoothed(q: np.ndarray) -> np.ndarray:
    return low_pass(q, 200.0, 25.0)


def rounded(q: np.ndarray) -> np.ndarray:
    return np.round(q, 5)


@pytest.mark.parametrize("shift", [3, -2])
def test_reference_moves_to_its_playback(shift):
    """A reference is moved to where the torques say that it was played."""
    right, moved = closed(), closed(shift, "estimated")
    (_, one), (_, other) = right.pairs[0], moved.pairs[0]
    inside = slice(100, -100)
    assert np.abs(one.reference.q - other.reference.q)[inside].max() < 3e-4  # of 1.5 rad
    found = float(moved.notes[0].split("moved ")[1].split(" ±")[0])
    assert abs(found - 5 * abs(shift)) < 0.3 and ("earlier" if shift > 0 else "later") in moved.notes[0]


@pytest.mark.parametrize(
    ("how", "says"),
    [({"shift": 2}, "late by 10"), ({"shift": -1}, "early by 4.9"),
     ({"shift": 12, "noise": 3e-3}, "late by 60 "),
     ({"copied": np.array}, "is the measured positions: "), ({"copied": smoothed}, "is the measured positions: "),
     ({"copied": rounded}, "is the measured positions: "),
     ({"copied": np.array, "shift": 2}, "measured positions, 10 ms later")],
)  # fmt: skip
def test_late_or_copied_reference_is_refused(how, says):
    """A late or copied reference is refused."""
    with pytest.raises(MeasurementError, match=says):
        closed(**how)
    if "copied" not in how:
        assert closed(**how, timing="stated").pairs


def test_wrong_bandwidth_is_no_delay():
    """A third of the bandwidth is enough for instrumental variables."""
    kp, kd = small_arm.LOOP.kp, small_arm.LOOP.kd
    assert closed(kp=tuple(np.divide(kp, 9.0)), kd=tuple(np.divide(kd, 3.0))).pairs
