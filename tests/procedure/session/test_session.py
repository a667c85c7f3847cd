"""A session survives being killed, moved, edited and run twice, and says what is stale."""

import json
import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from sessions import edit, go_on, kinds, quiet

from calib import cli
from calib.errors import CalibError, MeasurementError, SessionError
from calib.procedure.findings import UNJUDGED
from calib.procedure.session import commands, steps
from calib.procedure.session.certificate import listed
from calib.procedure.session.folder import Session, locked, open_session, read_state
from calib.robot.formats.urdf_tree import with_comment
from calib.robot.library import load


def words(session: Session, name: str) -> str:
    return next(state.words for state in steps.states(open_session(session.folder)) if state.step.name == name)


def test_finished_session_is_done_anywhere(finished: Session, tmp_path: Path) -> None:
    """A finished session is done wherever it is."""
    assert set(kinds(finished).values()) == {steps.DONE}
    moved = finished.folder.rename(tmp_path / "elsewhere")
    assert set(kinds(open_session(moved)).values()) == {steps.DONE}
    assert go_on(open_session(moved)) is None
    assert str(tmp_path) not in (moved / "state.json").read_text()


def test_two_lines_say_what_to_do_and_bring(planned: Session) -> None:
    """Two lines say what to do and what to bring."""
    waiting = next(state for state in steps.states(planned) if state.kind == steps.WAITING)
    first, second = commands.asks(planned, waiting)
    assert "20 poses" in first and "optical CMM" in first and "poses.csv" in first
    assert "measured.csv" in second and "joint1 [deg]" in second and "qw" in second
    assert (
        "the 8 of" in first
        and "2-poses/validation_poses.csv (never fitted)" in first
        and "validation_measured.csv" in second
    )


@pytest.mark.slow
def test_fit_waits_for_validation(measured: Session) -> None:
    """The fit waits for validation, but not the other way round."""
    validation = measured.path("3-measured/validation_measured.csv").rename(measured.folder / "later.csv")
    waiting = go_on(measured)
    assert waiting is not None and waiting.step.name == "validate"
    assert "8 poses" in commands.asks(measured, waiting)[0]
    before = measured.path("4-fit/robot.toml").stat().st_mtime_ns
    validation.rename(measured.path("3-measured/validation_measured.csv"))
    assert go_on(measured) is None
    assert measured.path("4-fit/robot.toml").stat().st_mtime_ns == before


@pytest.mark.slow
def test_measurement_makes_dependents_stale(finished: Session) -> None:
    """A changed measurement makes stale what rests on it."""
    path = finished.path("3-measured/measured.csv")
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:-1]) + "\n")
    found = kinds(finished)
    assert found["select"] == steps.DONE and found["measure"] == steps.STALE and found["fit"] == steps.AFTER
    assert "measured.csv has changed" in words(finished, "measure")
    assert go_on(finished) is None
    assert json.loads(finished.path("4-fit/metrics.json").read_text())["fit"]["poses"] == 19
    assert "1 of 20 planned poses remain to be measured: 20" in finished.path("3-measured/checked.txt").read_text()


@pytest.mark.slow
def test_changed_setting_makes_readers_stale(finished: Session) -> None:
    """A changed setting makes stale only what reads it."""
    edit(finished.path("session.toml"), 'model = "geometry"', 'model = "offsets"')
    found = kinds(finished)
    assert found["select"] == steps.DONE and found["measure"] == steps.STALE
    assert go_on(open_session(finished.folder)) is None
    assert json.loads(finished.path("4-fit/metrics.json").read_text())["model"] == "offsets"


@pytest.mark.slow
def test_measured_plan_is_not_replaced(finished: Session) -> None:
    """A plan is not replaced once it was measured."""
    before = finished.path("2-poses/poses.csv").read_text()
    edit(finished.path("session.toml"), "fit = 20", "fit = 25")
    assert kinds(finished)["select"] == steps.KEPT and "redo select" in words(finished, "select")
    assert go_on(open_session(finished.folder)) is None
    assert finished.path("2-poses/poses.csv").read_text() == before


def test_replacements_by_a_person_are_kept(finished: Session) -> None:
    """What a person replaced is kept, and said."""
    urdf = finished.path("6-export/robot.urdf")
    urdf.write_text(urdf.read_text() + "<!-- checked -->\n")
    assert kinds(finished)["export"] == steps.DONE
    assert "replaced manually: 6-export/robot.urdf" in words(finished, "export")
    roles = {name: role for name, role, _, _ in listed(finished)}
    assert roles["6-export/robot.urdf"] == "edited by hand" and roles["6-export/robot.toml"].startswith(
        "calibrated robot, verdict"
    )
    assert go_on(finished) is None
    assert "checked" in urdf.read_text()


def test_measurements_in_the_plan_survive(planned: Session) -> None:
    """Measurements filled into the plan are not written over."""
    path = planned.path("2-poses/poses.csv")
    first, *rest = path.read_text().splitlines()
    path.write_text("\n".join([f"{first},x,y,z", *(f"{line},0.1,0.2,0.3" for line in rest)]) + "\n")
    kept = path.read_bytes()
    assert cli.run(["redo", str(planned.folder), "select"]) == 2 and path.read_bytes() == kept


def test_redo_repeats_a_step_and_all_behind(finished: Session) -> None:
    """Redo makes a step and all behind it again."""
    urdf = finished.path("6-export/robot.urdf")
    original = urdf.read_text()
    urdf.write_text("mine")
    steps.forget(finished, steps.find(finished, "export"))
    assert kinds(finished)["fit"] == steps.DONE and kinds(finished)["export"] == steps.READY
    assert go_on(finished) is None
    assert urdf.read_text() == original
    with pytest.raises(SessionError, match="describe, select"):
        steps.find(finished, "fitting")
    with pytest.raises(SessionError, match="wanted = true"):
        steps.find(finished, "identify")


@pytest.mark.slow
def test_killed_session_goes_on_from_there(measured: Session, finished_folder: Path) -> None:
    """Killed at any step, it goes on from there."""
    for name in ("measure", "fit", "validate", "certificate"):
        assert _killed_at(measured, name) == -signal.SIGKILL
        assert kinds(measured)[name] == steps.READY and "interrupted" in words(measured, name)
    assert go_on(measured) is None
    for name in ("4-fit/estimate.csv", "5-validation/errors.csv", "6-export/robot.urdf", "2-poses/poses.csv"):
        assert measured.path(name).read_text() == (finished_folder / name).read_text(), "time does not enter"
    assert not list(measured.folder.rglob(".*.part")) and not measured.path("session.lock").exists()


def _killed_at(session: Session, name: str) -> int:
    """Run `calib next` in a process of its own that is killed while it is in a step; return its exit code."""

    def killed(session: Session, say: object) -> None:
        (session.folder / ".4-fit.x.part").mkdir(exist_ok=True)
        os.kill(os.getpid(), signal.SIGKILL)

    if not (child := os.fork()):
        try:
            there = steps.steps_of(session)
            steps.steps_of = lambda _: tuple(replace(one, make=killed) if one.name == name else one for one in there)
            cli.run(["next", "--no-plots", str(session.folder)])
        finally:
            os._exit(1)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def test_two_commands_do_not_share_a_session(planned: Session) -> None:
    """Two commands do not work on one session."""
    with (
        locked(planned, quiet),
        pytest.raises(SessionError, match=rf"busy: process {os.getpid()}"),
        locked(planned, quiet),
    ):
        pass
    with locked(planned, quiet):
        pass


def test_lock_of_a_killed_command_is_taken(planned: Session) -> None:
    """A killed command's lock is taken over."""
    planned.path("session.lock").write_text("process 999999 on some-host")
    said: list[str] = []
    with locked(planned, said.append):
        pass
    assert "process 999999" in said[0] and not planned.path("session.lock").exists()


@pytest.mark.slow
def test_failing_step_changes_no_session(measured: Session) -> None:
    """A failing step leaves the session as it was."""
    go_on(measured)
    before = read_state(measured)
    path = measured.path("3-measured/measured.csv")
    text = path.read_text()
    path.write_text(text.replace("[deg]", "[rad]"))
    with pytest.raises(MeasurementError, match=r"measured.csv, row 1, column 'joint\d'.*deg"):
        go_on(measured)
    assert not read_state(measured).running and not measured.path("session.lock").exists()
    path.write_text(text)
    assert go_on(measured) is None
    assert read_state(measured).steps.keys() == before.steps.keys()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda head: head.replace("joint2", "?").replace("joint3", "joint2").replace("?", "joint3"), "swapped"),
        (lambda head: head.replace("x [mm]", "x"), "in mm"),
        (lambda head: head.replace("joint4 [deg],", "other,"), "joint"),
    ],
)
def test_what_arrives_is_checked(measured: Session, change, message: str, capsys: pytest.CaptureFixture) -> None:
    path = measured.path("3-measured/measured.csv")
    head, _, rest = path.read_text().partition("\n")
    path.write_text(f"{change(head)}\n{rest}")
    assert cli.run(["next", "--no-plots", str(measured.folder)]) == 2
    said = capsys.readouterr().err
    assert "measured.csv" in said and message in said and "Traceback" not in said
    assert not measured.path("4-fit/robot.toml").exists()


def test_a_session_has_one_verdict(finished: Session) -> None:
    whole = json.loads(finished.path("verdict.json").read_text())
    geometry = whole["geometry"]["verdict"], whole["geometry"]["reason"]
    assert whole["verdict"] == geometry[0] == whole["files"]["robot.urdf"]["verdict"]
    others = [path for path in finished.folder.rglob("*.json") if path.name not in ("verdict.json", "state.json")]
    said = [found for path in others for found in _verdicts(json.loads(path.read_text()))]
    assert geometry in said and set(said) <= {geometry, ("", UNJUDGED.reason)}


def _verdicts(content: Any) -> list[tuple[str, str]]:
    if not isinstance(content, dict):
        return []
    own = [(content["verdict"], content["reason"])] if "verdict" in content else []
    return own + [each for value in content.values() for each in _verdicts(value)]


@pytest.mark.slow
def test_poses_are_held_out_by_default(measured: Session) -> None:
    """Without a validation file, a share of the poses is held out; five are too few for the verdict, which says so."""
    measured.path("3-measured/validation_measured.csv").unlink()
    assert go_on(measured) is not None, "waits for the planned validation poses"
    edit(measured.path("session.toml"), "holdout = 0.0", "holdout = 0.25")
    assert go_on(measured) is None
    found = json.loads(measured.path("5-validation/metrics.json").read_text())
    assert (
        found["validation"]["measured.csv"]["poses"] == 5
        and "(too few unseen poses: measured.csv 5 of 8)" in found["reason"]
    )
    assert json.loads(measured.path("4-fit/metrics.json").read_text())["fit"]["poses"] == 15


@pytest.mark.slow
def test_failed_robot_says_so_in_its_files(finished: Session, capsys: pytest.CaptureFixture) -> None:
    """A failed robot's files say so until it no longer fails."""
    place, settings = finished.path("6-export"), finished.path("session.toml")
    before = (place / "robot.urdf").read_bytes()
    marginal = (place / "README.txt").read_text()
    assert marginal.startswith("verdict marginal: geometry: ") and "rigid geometry leaves" in marginal
    assert marginal.splitlines()[0] in before.decode()
    assert "none given: pass means" in finished.path("report.html").read_text(), "no tolerance"
    edit(settings, "tolerance_mm = 0.0", "tolerance_mm = 0.001")
    assert cli.run(["next", "--no-plots", str(finished.folder)]) == 1
    said = capsys.readouterr().out.strip().split("\n")[-4:]
    assert said[0].startswith("verdict fail: geometry: ") and "(for inspection only, do not use)" in said[2]
    found = json.loads(finished.path("5-validation/metrics.json").read_text())
    assert (found["verdict"], found["code"]) == ("fail", "above-tolerance")
    assert "0.001 mm rms on unseen poses" in finished.path("report.html").read_text()
    head = (place / "robot.urdf").read_text().split("<robot", 1)[0]
    assert "<!-- verdict fail: geometry: " in head and "do not use -->" in head
    assert (place / "README.txt").read_text().startswith("verdict fail: geometry: ")
    load(place / "robot.urdf")
    edit(settings, "tolerance_mm = 0.001", "tolerance_mm = 0.0")
    assert cli.run(["next", "--no-plots", str(finished.folder)]) == 0
    assert (place / "robot.urdf").read_bytes() == before and (place / "README.txt").read_text() == marginal
    assert "verdict marginal: geometry: " in capsys.readouterr().out


@pytest.mark.parametrize("head", [b"", b"\xef\xbb\xbf", b'<?xml version="1.0"?>', b'\xef\xbb\xbf<?xml version="1.0"?>'])
def test_comment_follows_the_xml_prologue(head: bytes) -> None:
    """A comment goes behind what XML wants first."""
    found = ElementTree.fromstring(with_comment(head + b"<robot name='a'/>", "off by 3 µm --- too much"))
    assert found.tag == "robot" and found.get("name") == "a"


def test_damaged_record_can_be_thrown_away(finished: Session) -> None:
    """A damaged record is said, and can be thrown away."""
    finished.path("state.json").write_text('{"steps": ')
    with pytest.raises(SessionError, match="delete it"):
        steps.states(finished)
    finished.path("state.json").unlink()
    assert kinds(finished)["describe"] == steps.READY


def test_commands_and_their_exit_codes(finished: Session, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder = str(tmp_path / "a cell")
    new = ["new", folder, "--robot", "ur5", "--instrument", "tracker", "--poses", "15", "--validation", "0"]
    assert cli.run(new) == 0
    assert cli.run(new) == 2 and "already" in capsys.readouterr().err
    assert cli.run(["status", folder]) == 0 and "describe" in capsys.readouterr().out
    assert cli.run(["next", "--no-plots", folder]) == 0 and f"then: calib next '{folder}'" in capsys.readouterr().out
    assert cli.run(["next", str(tmp_path)]) == 2 and "calib new makes one" in capsys.readouterr().err
    assert cli.run(["status", str(finished.folder / "4-fit")]) == 2
    said = capsys.readouterr().err
    assert "is the result of a fit; not a session" in said and "calib export" in said and "calib view" in said
    assert cli.run(["redo", folder, "nothing"]) == 2
    assert cli.run(["new", str(tmp_path / "b"), "--robot", "ur55", "--instrument", "tracker"]) == 2
    assert cli.run(["new", str(tmp_path / "b"), "--robot", "ur5", "--instrument", "ruler"]) == 2
    assert not (tmp_path / "b").exists() and not list(tmp_path.glob(".*"))


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_folder_is_said(planned: Session) -> None:
    planned.folder.chmod(0o500)
    try:
        with pytest.raises(CalibError, match="cannot write"):
            go_on(planned)
    finally:
        planned.folder.chmod(0o700)


@pytest.mark.parametrize(
    "gone",
    [
        pytest.param("4-fit/robot.toml", marks=pytest.mark.slow),
        pytest.param("4-fit/metrics.json", marks=pytest.mark.slow),
        "5-validation/metrics.json",
        "6-export/robot.urdf",
    ],
)
def test_step_with_a_lost_file_is_made_again(finished: Session, gone: str) -> None:
    """A step that lost a file is made again."""
    finished.path(gone).unlink()
    assert go_on(open_session(finished.folder)) is None
    assert finished.path(gone).exists()
