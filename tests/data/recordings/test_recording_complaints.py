"""What is said of signs and of files that cannot be read: no alarm where gravity pays, and the right advice."""

from __future__ import annotations

import numpy as np
import pytest

from calib.data.recordings.recording_files import read_recording
from calib.errors import MeasurementError


def falling(back: bool) -> dict[str, np.ndarray]:
    """Return an arm that comes down, slowly, its drives braking the fall; and up again if it comes `back`."""
    t = np.arange(2000) / 200
    turn = 2 * np.pi * t / 10 if back else np.pi * t / 10
    q = np.stack([0.8 * np.cos(turn), 0.3 * np.sin(4 * np.pi * t / 10)], axis=1)
    v = np.gradient(q, t, axis=0)
    return {"t": t, "q": q, "tau": np.array([30.0, 0.0]) * np.cos(q) + 10.0 * v + 1e-3 * np.sin(t)[:, None]}


def alarms(path) -> bool:
    return any("is their sign reversed" in note for note in read_recording(path).notes)


@pytest.mark.parametrize("back, sign, alarm", [(False, 1, False), (True, 1, False), (True, -1, True)])
def test_a_descending_arm_gives_energy_back_and_is_no_reversed_sign(tmp_path, back, sign, alarm):
    series = falling(back)
    work = float((series["tau"][1:] * np.diff(series["q"], axis=0)).sum())
    assert (work < 0) != back, "the drives of the one that only comes down are paid by gravity"
    np.savez(tmp_path / "log.npz", **(series | {"tau": sign * series["tau"]}))
    assert alarms(tmp_path / "log.npz") == alarm


def test_a_file_that_is_no_recording_is_told_why(tmp_path):
    series = falling(True)
    np.savez(tmp_path / "log.npz", **{key: value[::-1] for key, value in series.items() if key != "t"}, t=-series["t"])
    with pytest.raises(MeasurementError, match="backwards in every row: turn the rows around"):
        read_recording(tmp_path / "log.npz")
    (tmp_path / "text.npz").write_text("hello\n")
    with pytest.raises(MeasurementError, match="no NumPy archive, whatever its name says"):
        read_recording(tmp_path / "text.npz")
    with pytest.raises(MeasurementError, match=r"a cut is written log\.npz@0:9\.4"):
        read_recording(tmp_path / "log.npz@abc")
