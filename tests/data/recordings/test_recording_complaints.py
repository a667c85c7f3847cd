"""What is said of signs and of files that cannot be read: no alarm where gravity pays, and the right advice."""

import numpy as np
import pytest

from calib.data.recordings.checks import check_recording
from calib.data.recordings.recording import Recording
from calib.data.recordings.recording_files import read_recording
from calib.data.recordings.recording_options import RecordingOptions
from calib.data.schema import Joints
from calib.errors import MeasurementError, UsageError


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
def test_descending_arm_is_no_reversed_sign(tmp_path, back, sign, alarm):
    """A descending arm gives energy back and is no reversed sign."""
    series = falling(back)
    work = float((series["tau"][1:] * np.diff(series["q"], axis=0)).sum())
    assert (work < 0) != back, "the drives of the one that only comes down are paid by gravity"
    np.savez(tmp_path / "log.npz", **(series | {"tau": sign * series["tau"]}))
    assert alarms(tmp_path / "log.npz") == alarm


@pytest.mark.parametrize("unit", ["Nmm", "N·mm", "N mm", "mNm"])
def test_newton_millimetres_are_known(tmp_path, unit):
    """Newton millimetres are recognised by their spellings."""
    series = falling(True)
    names = ["t", "q1", "q2", f"tau1 [{unit}]", f"tau2 [{unit}]"]
    table = np.column_stack([series["t"], series["q"], 1e3 * series["tau"]])
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=",".join(names), comments="")
    assert read_recording(tmp_path / "log.csv").effort == pytest.approx(series["tau"])


def test_unit_foreign_to_joint_is_refused(tmp_path):
    """A unit that a joint does not have is refused."""
    np.savez(tmp_path / "log.npz", **falling(True))
    for unit, kind in (("mm", "revolute"), ("deg", "prismatic")):
        with pytest.raises(MeasurementError, match=rf"unit \[{unit}\] of q does not suit b, a {kind} joint"):
            joints = Joints(("a", "b"), ("prismatic" if unit == "mm" else "revolute", kind))
            read_recording(tmp_path / "log.npz", joints, RecordingOptions(units={"q": unit}))


def test_non_recording_is_told_why(tmp_path):
    """A file that is no recording is told why."""
    series = falling(True)
    np.savez(tmp_path / "log.npz", **{key: value[::-1] for key, value in series.items() if key != "t"}, t=-series["t"])
    with pytest.raises(MeasurementError, match="backwards in every row: reverse the order"):
        read_recording(tmp_path / "log.npz")
    (tmp_path / "text.npz").write_text("hello\n")
    with pytest.raises(MeasurementError, match="not a NumPy archive despite its name"):
        read_recording(tmp_path / "text.npz")
    with pytest.raises(MeasurementError, match=r"write a cut as log\.npz@0:9\.4"):
        read_recording(tmp_path / "log.npz@abc")
    with pytest.raises(UsageError, match="before the recording"):
        read_recording("log.npz@-1:2")
    np.savez(tmp_path / "log.npz", t=series["t"], enc_position=series["q"], motor_amps=series["tau"])
    with pytest.raises(MeasurementError, match=r'names = \{ q = "enc_position", current = "motor_amps" \}'):
        read_recording(tmp_path / "log.npz")


@pytest.mark.parametrize("mark", [" ", ";", "|", ","])
@pytest.mark.parametrize(
    "names", ["actual_q_{} actual_current_{}", "state.q[{}] state.current[{}]", "J{}_pos J{}_current"]
)
def test_logs_with_any_separator_are_read(tmp_path, mark, names):
    """Logs of controllers are read, whatever parts the columns."""
    series = falling(True)
    q, current = names.split()
    head = ["timestamp", *(q.format(k) for k in (0, 1)), *(current.format(k) for k in (0, 1))]
    rows = np.column_stack([series["t"], series["q"], series["tau"]])
    lines = [mark.join(head), *(mark.join(f"{x:.9g}" for x in row) for row in rows)]
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    found = read_recording(tmp_path / "log.csv")
    assert found.kind == "current" and np.abs(found.q - series["q"]).max() < 1e-8


@pytest.mark.parametrize(
    "names",
    [
        "actual_q_{0} target_q_{0} actual_current_{0} target_qd_{0} target_current_{0} target_moment_{0}",  # UR's RTDE
        "state.q[{0}] state.q_d[{0}] state.tau_J[{0}] state.dq_d[{0}] state.tau_J_d[{0}] cmd.tau_J_d[{0}]",  # libfranka
        "q{0} q_d{0} tau_J{0} dq_d{0} tau_J_d{0} ddq_d{0}",
    ],
)
def test_reference_of_ur_and_franka_is_read(tmp_path, names):
    """The reference of UR and Franka logs is read."""
    series = falling(True)
    head = ["timestamp", *(name.format(k) for name in names.split() for k in (0, 1))]
    parts = [series["q"], series["q"] + 0.01, series["tau"], *(7.0 * series["q"],) * 3]
    np.savetxt(
        tmp_path / "log.csv", np.column_stack([series["t"], *parts]), delimiter=",", header=",".join(head), comments=""
    )
    found = read_recording(tmp_path / "log.csv")
    assert found.q_ref is not None and np.abs(found.q_ref - series["q"] - 0.01).max() < 1e-8
    assert np.abs(found.q - series["q"]).max() < 1e-8 and np.abs(found.effort - series["tau"]).max() < 1e-8
    assert found.v is None


def test_all_nan_column_is_not_provided():
    """What is NaN in every row is not provided."""
    t = np.linspace(0.0, 2.0, 400)
    q = np.column_stack([np.sin(3.0 * t), np.cos(3.0 * t)])
    absent = np.full_like(q, np.nan)
    checked = check_recording(Recording.of(t, q, q + 1.0, v=absent))
    assert checked.v is None and any("NaN in every row" in note for note in checked.notes)
    with pytest.raises(MeasurementError, match=r"torque of q1, q2 is NaN in every row: its driver does not provide"):
        check_recording(Recording.of(t, q, absent))


def test_encoder_counts_are_not_degrees():
    """Encoder counts are not called degrees."""
    t = np.linspace(0.0, 2.0, 400)
    counts = 2048.0 + 600.0 * np.sin(3.0 * t)[:, None]
    with pytest.raises(MeasurementError, match="encoder counts"):
        check_recording(Recording.of(t, counts, counts))
    with pytest.raises(MeasurementError, match="looks like deg"):
        check_recording(Recording.of(t, counts / 20.0, counts))
