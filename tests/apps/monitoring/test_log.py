"""The log of one robot's calibrations: a line per session, and what moved; other robots are refused."""

import csv
import shutil

import pytest

import calib
from calib import cli
from calib.apps.monitoring.log import log
from calib.errors import SessionError, UsageError
from calib.procedure.session.session_results import position_errors

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    """A finished simulated session of 2025, a copy of 2026, one of another serial number, and one not begun."""
    folder = tmp_path_factory.mktemp("sessions")
    assert cli.run(["demo", "--out", str(folder / "old"), "--geometry-only", "--no-plots"]) == 0
    for name, year, serial in (("new", 2026, "A7"), ("other", 2026, "B1"), ("old", 2025, "A7")):
        if name != "old":
            shutil.copytree(folder / "old", folder / name)
        path = folder / name / "session.toml"
        lines = [_stated(line, year, serial) for line in path.read_text().splitlines()]
        path.write_text("\n".join(lines) + "\n")
    shutil.copytree(folder / "old", folder / "begun")
    (folder / "begun/verdict.json").unlink()
    return folder


def _stated(line, year, serial):
    if line.startswith("robot_serial"):
        return f'robot_serial = "{serial}"'
    return f'created = "{year}{line.split(chr(34))[1][4:]}"' if line.startswith("created") else line


def test_a_line_per_calibration_oldest_first(sessions):
    found = log([sessions / "new", sessions / "old"])
    assert [line.date[:4] for line in found.lines] == ["2025", "2026"] and found.lines[0].moved is None
    assert found.lines[1].moved[0] < 1e-9 < found.lines[1].moved[1] and found.lines[1].parameter == ""
    session = calib.procedure.session.folder.open_session(sessions / "old")
    assert found.lines[0].errors == position_errors(session) and found.lines[0].verdict == "pass"


def test_robots_are_not_mixed_unless_told(sessions):
    with pytest.raises(UsageError, match=r"different serial numbers \(A7, B1\); give --mixed"):
        log([sessions / "old", sessions / "other"])
    assert [line.serial for line in log([sessions / "old", sessions / "other"], mixed=True).lines] == ["A7", "B1"]


def test_session_without_verdict_is_refused(sessions):
    """A session without a verdict is refused."""
    with pytest.raises(SessionError, match="has no verdict yet: calib next"):
        log([sessions / "begun"])


def test_command_writes_page_table_figure(sessions, tmp_path, capsys):
    """The command writes page, table and figure."""
    pair = [str(sessions / name) for name in ("old", "new")]
    assert cli.run(["log", *pair, "--plots", "svg", "--out", str(tmp_path / "out")]) == 0
    assert "Calibrations of".lower() in capsys.readouterr().out.lower()
    assert {"report.html", "log.csv", "metrics.json", "plot_log.svg"} == {
        each.name for each in (tmp_path / "out").iterdir()
    }
    rows = list(csv.DictReader((tmp_path / "out/log.csv").open()))
    assert [row["serial"] for row in rows] == ["A7", "A7"] and float(rows[1]["moved [mm]"]) < 1e-9
