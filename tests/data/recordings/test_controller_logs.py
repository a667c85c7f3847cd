"""Logs of robot controllers are known by their columns; samples are laid out as the published sources write them."""

import numpy as np
import pytest

from calib.data.csv_table import read_table
from calib.data.recordings.controller_logs import logs
from calib.data.recordings.recording_files import read_positions, read_recording
from calib.data.recordings.recording_options import RecordingOptions
from calib.data.schema import Joints
from calib.errors import MeasurementError

N = 400


def motion(n):
    """Return times [s] and smooth positions, velocities and efforts (N, n)."""
    t = 0.004 * np.arange(N)
    phase = np.outer(t, 1.0 + 0.3 * np.arange(n)) * 4.0
    return t, 0.5 * np.sin(phase), 2.0 * (1.0 + 0.3 * np.arange(n)) * np.cos(phase), 20.0 * np.sin(phase + 1.0)


def joints(n):
    return Joints(tuple(f"j{k}" for k in range(n)), ("revolute",) * n, np.full(n, -3.0), np.full(n, 3.0))


def named(name, n, form="[{}]"):
    return [name + form.format(k) for k in range(n)]


def write(path, header, rows, separator=","):
    lines = [header, *(separator.join(f"{value:.12g}" for value in row) for row in np.column_stack(rows))]
    path.write_text("\n".join(lines) + "\n")
    return path


def libfranka(path, per_second=1000.0, gap=", "):
    """Write a log as libfranka's csvRobotStateHeader, csvLine and csvRobotCommandHeader do."""
    t, q, v, tau = motion(7)
    state = [
        gap.join(named(f"state.{name}", 7)) for name in ("q", "q_d", "dq", "dq_d", "tau_J", "tau_ext_hat_filtered")
    ]
    sizes = {"q_d": 7, "dq_d": 7, "O_T_EE_d": 16, "O_dP_EE_d": 6, "tau_J_d": 7}
    command = [gap.join(named(f"cmd.{name}", size)) for name, size in sizes.items()]
    header = gap.join(["time", "success_rate", ""]) + ",".join([*state, *command])
    rest = np.zeros((N, sum(sizes.values())))
    return write(path, header, [1e4 + t * per_second, np.ones(N), q, q + 0.01, v, v, tau, 0 * tau, rest])


@pytest.mark.parametrize("gap", [", ", ","])
def test_libfrankas_time_is_in_milliseconds(tmp_path, gap):
    found = read_recording(libfranka(tmp_path / "log.csv", gap=gap), joints(7))
    t, q, v, tau = motion(7)
    assert np.allclose(found.t, t, atol=1e-9) and np.allclose(found.q, q) and np.allclose(found.v, v)
    assert np.allclose(found.effort, tau) and np.allclose(found.q_ref, q + 0.01)
    assert "read as libfranka's log (logToCSV)" in found.notes


@pytest.mark.parametrize("units", [{}, {"t": "s"}])
def test_converted_time_is_in_seconds(tmp_path, units):
    """A time that somebody converted is in seconds."""
    path = libfranka(tmp_path / "log.csv", per_second=1.0)
    found = read_recording(path, joints(7), RecordingOptions(units=units))
    assert found.duration == pytest.approx(0.004 * (N - 1)) and any("taken as seconds" in note for note in found.notes)


def test_unit_said_twice_counts_once(tmp_path):
    """A unit said twice counts once, and another is refused."""
    path = libfranka(tmp_path / "log.csv")
    assert read_recording(path, joints(7), RecordingOptions(units={"t": "ms"})).duration == pytest.approx(
        0.004 * (N - 1)
    )
    with pytest.raises(MeasurementError, match=r"header states \[ms\], the options state s"):
        read_recording(path, joints(7), RecordingOptions(units={"t": "s"}))


@pytest.mark.parametrize("separator", [" ", ","])
def test_ur_recording_is_read_with_currents(tmp_path, separator):
    """As CSVWriter of RTDE_Python_Client_Library writes it: names with _0 to _5, parted by blanks."""
    t, q, v, current = motion(6)
    kinds = ("target_q", "target_moment", "actual_q", "actual_qd", "actual_current")
    header = separator.join(["timestamp", *(one for kind in kinds for one in named(kind, 6, "_{}")), "robot_mode"])
    rows = [3e5 + t, q + 0.01, current, q, v, current / 10, np.full(N, 7)]
    found = read_recording(write(tmp_path / "robot_data.csv", header, rows, separator), joints(6))
    assert found.kind == "current" and np.allclose(found.effort, current / 10) and np.allclose(found.q_ref, q + 0.01)
    assert np.allclose(found.t, t, atol=1e-6) and "read as a UR's RTDE recording" in found.notes


def test_abb_egm_is_degrees_without_torques(tmp_path):
    """ABB's EGM has positions in degrees and no torques."""
    t, q, v, _ = motion(6)
    kinds = [f"{who}_{what}_" for who in ("R_FB", "R_PL", "S_REF") for what in ("POS", "VEL")]
    names = ["TIMESTAMP", *(f"{kind}{axis}J{k + 1}" for kind in kinds for axis in "RE" for k in range(6))]
    still = np.zeros((N, 6))
    turn = np.degrees(q)
    rows = [
        5000 + 1000 * t,
        turn,
        still,
        np.degrees(v),
        still,
        turn + 1.0,
        still,
        still,
        still,
        still,
        still,
        still,
        still,
    ]
    path = write(tmp_path / "egm.csv", ",".join(names), rows)
    times, reference = read_positions(path, joints(6), RecordingOptions())
    assert np.allclose(times, t, atol=1e-9) and np.allclose(reference, q + np.radians(1.0))
    assert "EGM sends no torques" in " ".join(read_table(path).notes)
    with pytest.raises(MeasurementError, match="has no torques and no currents"):
        read_recording(path, joints(6))


def test_sunrise_log_tells_name_of_torques(tmp_path):
    """KUKA's Sunrise log is read by the words of its torques' names, which are said; other names are stated."""
    t, q, _, tau = motion(7)
    arm = "_LBR_iiwa_7_R800_1"
    names = ["ZeitInSec", "ZeitInNanoSec", *named(f"axisQMsr{arm}", 7), *named(f"tauMsr{arm}", 7)]
    stamps = 1_600_000_000.5 + t
    rows = [np.floor(stamps), np.round(1e9 * (0.5 + t) % 1e9), np.degrees(q), tau]
    path = write(tmp_path / "DataRecorder.log", f"% {' '.join(names)}", rows, " ")
    by_words = read_recording(path, joints(7))
    assert any('torque = "tauMsr' in note for note in by_words.notes)
    stated = read_recording(path, joints(7), RecordingOptions(names={"torque": "tauMsr"}))
    for found in (by_words, stated):
        assert np.allclose(found.t, t, atol=1e-7) and np.allclose(found.q, q) and np.allclose(found.effort, tau)
    path.write_text(path.read_text().replace("tauMsr", "axisMsr"))
    with pytest.raises(MeasurementError, match=r'columns = \{ torque = "axisMsr'):
        read_recording(path, joints(7))


def test_known_logs_say_where_published():
    """Each known log says where it is published."""
    assert all(each["says"] and each["source"] for each in logs().values())


@pytest.mark.parametrize("content", ["", "%", "time, success_rate, state.q[0]\n", "TIMESTAMP,R_FB_POS_RJ1,\nx\n"])
def test_log_cut_short_is_refused(tmp_path, content):
    """A log cut short is refused with a reason."""
    (tmp_path / "log.csv").write_text(content)
    with pytest.raises(MeasurementError, match=r"log\.csv"):
        read_recording(tmp_path / "log.csv", joints(7))
