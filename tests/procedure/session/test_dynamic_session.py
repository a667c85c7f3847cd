"""A session with dynamics walks to its end, says what a wrong recording is, and survives what people do."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pypdf import PdfReader
from sessions import begin, copy_of, edit, go_on, kinds
from without_figures import run

from calib import cli
from calib.apps.cell_demo import demo
from calib.data.csv_table import read_header
from calib.data.recordings.recording_files import read_recording
from calib.errors import MeasurementError
from calib.identification.model_file import read_dynamics
from calib.procedure.excitation import stored_front
from calib.procedure.robot_kinds import joints_of
from calib.procedure.session import commands, steps
from calib.procedure.session.dynamics_steps import check_motion, designed_motions
from calib.procedure.session.folder import Session, open_session, read_state
from calib.robot.library import load_calibrated
from calib.simulation.truth import torque_errors
from calib.simulation.virtual_cells import virtual_cell

QUICK = {"period": 6.0, "harmonics": 5, "starts": 1, "evaluations": 100, "repeats": 2, "rate": 250.0}


@pytest.fixture(scope="module")
def waiting_folder(finished_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session with a fitted geometry, whose dynamics were asked for afterwards, and that waits for recordings."""
    folder = tmp_path_factory.mktemp("dynamic") / "cell"
    shutil.copytree(finished_folder, folder)
    path = folder / "session.toml"
    edit(path, "wanted = false", "wanted = true")
    edit(path, 'friction = "auto"', 'friction = "standard"')
    for key, value in QUICK.items():
        lines = [f"{key} = {value}" if line.startswith(f"{key} =") else line for line in path.read_text().splitlines()]
        path.write_text("\n".join(lines) + "\n")
    waiting = go_on(open_session(folder))
    assert waiting is not None and waiting.step.name == "record"
    return folder


@pytest.fixture(scope="module")
def recorded_folder(waiting_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded") / "cell"
    shutil.copytree(waiting_folder, folder)
    session = open_session(folder)
    demo.simulate_recordings(session, demo.arm_of(session, virtual_cell("lwr4plus", 1)), 1)
    return folder


@pytest.fixture(scope="module")
def whole_folder(recorded_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole") / "cell"
    shutil.copytree(recorded_folder, folder)
    assert go_on(open_session(folder), plots=True) is None
    return folder


waiting, recorded, whole = (copy_of(f"{name}_folder") for name in ("waiting", "recorded", "whole"))


PLAIN = re.compile(  # columns that have no unit, or have it in a column of their own
    r"name|set|file|row|station|tool|expression|unit|essential|rank|element|matters|parameter|parameters_moved|pose|"
    r"corrected|basis|joint|order|q[xyzw]|weight|outlier|extrapolated|shift_sigma(_per_milli)?|relative_percent"
)


@pytest.mark.slow
def test_session_columns_have_units(whole: Session) -> None:
    """Joints above all: those of what is to be driven, of what was, of motions and of torques."""
    seen = 0
    for path in sorted(whole.folder.rglob("*.csv")):
        names, units = read_header(path)
        matrix = re.search("covariance|^information$", path.stem)  # units of products
        of_rows = {"unit", "armature_unit"} & set(names)  # a unit in each row
        bare = [name for name, unit in zip(names, units) if not unit and not PLAIN.fullmatch(name)]
        assert not bare or matrix or of_rows, f"{path}: {bare}"
        seen += sum(unit in ("deg", "rad") for unit in units)
    assert seen > 100 and not list(whole.folder.glob("*/validation.csv"))


@pytest.mark.slow
def test_later_dynamics_keep_the_geometry(waiting: Session) -> None:
    """Dynamics asked for afterwards keep the geometry."""
    found = kinds(waiting)
    assert [name for name, kind in found.items() if kind == steps.DONE] == [
        "describe", "select", "measure", "fit", "validate", "excite",
    ]  # fmt: skip
    assert not waiting.path("6-export").exists() and waiting.path("9-export/robot.urdf").exists()


@pytest.mark.slow
def test_two_lines_say_what_to_play_and_log(waiting: Session) -> None:
    """Two lines say what to play and what to log."""
    state = next(state for state in steps.states(waiting) if state.kind == steps.WAITING)
    first, second = commands.asks(waiting, state)
    assert "6-excitation/training/run.csv" in first and "validation/run.csv" in first
    assert "2 times" in first and "250 Hz" in first and "never used for training" in first
    assert "7-recorded/training_log.csv" in second and "q_joint1 [deg]" in second and "tau_joint7 [Nm]" in second


@pytest.mark.slow
def test_no_plan_means_no_designed_motion(waiting: Session) -> None:
    """Without a plan no motion is designed or presented."""
    shutil.rmtree(waiting.path("6-excitation"))
    head, dynamics = waiting.path("session.toml").read_text().split("[dynamics]\n")
    assert dynamics.count("plan = true ") == 1
    waiting.path("session.toml").write_text(f"{head}[dynamics]\n{dynamics.replace('plan = true ', 'plan = false')}")
    session = open_session(waiting.folder)
    stopped = go_on(session)
    assert stopped is not None and stopped.step.name == "record"
    assert not session.path("6-excitation").exists()
    assert "a different one for validation" in commands.asks(session, stopped)[0]


@pytest.mark.slow
def test_recorded_motion_survives_a_refit(waiting: Session) -> None:
    """A motion that was recorded stays when the geometry is fitted again."""
    for brought, kept in ((False, False), (True, True)):
        if brought:
            waiting.path("7-recorded").mkdir(exist_ok=True)
            waiting.path("7-recorded/training_log.csv").write_text("t\n0\n")
        before = read_state(waiting)
        steps.forget(waiting, steps.find(waiting, "fit"))
        assert ("excite" in read_state(waiting).steps) is kept and "fit" not in read_state(waiting).steps
        waiting.write_state(before)


@pytest.mark.slow
def test_it_ends_in_one_certificate_of_both(whole: Session) -> None:
    assert set(kinds(whole).values()) == {steps.DONE}
    given = {path.name for path in whole.path("9-export").rglob("*")}
    assert {"robot.urdf", "robot.xml", "drives.csv", "parameters.json", "README.txt"} <= given
    origins = re.compile("(?m)^    <origin .*")
    joints = [origins.findall(whole.path(f"{place}/robot.urdf").read_text()) for place in ("4-fit", "9-export")]
    assert joints[0] == joints[1] and "dynamics" not in given, "the calibrated geometry"
    page = whole.path("report.html").read_text()
    titles = {"Torque errors", "Excitation", "Identified parameters", "Geometry", "What was exported"}
    assert all(words in page for words in titles | {"ZZ2R", "7-recorded/training_log.csv"})
    found = json.loads(whole.path("8-dynamics/unseen/report.json").read_text())
    own = found["validation"]["validation_log.csv"]
    document = PdfReader(whole.path("certificate.pdf"))
    text = " ".join(" ".join(one.extract_text() for one in document.pages).split())
    assert len(document.pages) == 4 and "low-passed at" in text
    for row, rms, limit in zip(found["rows"], own["raw"]["rms"], found["limits"], strict=True):
        assert f"{row} {rms:.3g} N m {100.0 * rms / limit:.3g} %" in text, "in N·m and of the limit"
    assert "<inertia " in whole.path("9-export/robot.urdf").read_text()
    assert own["evidence"] and whole.verdicts().level == "marginal"  # errors that no model holds remain


@pytest.mark.slow
def test_unexplained_share_is_the_true_error(whole: Session) -> None:
    """The unexplained share is the error against the hidden arm."""
    # The truth holds friction with memory, warming gears, cables: what the certificate says of unseen motion (filtered,
    # with noise) is what it is without noise on yet another motion.
    cell = virtual_cell("lwr4plus", 1)
    chain, dynamics = read_dynamics(whole.identification.path)
    found = torque_errors(cell, demo.arm_of(whole, cell), dynamics.model, dynamics.values, chain)
    report = json.loads(whole.path("8-dynamics/unseen/report.json").read_text())
    stated = report["validation"]["validation_log.csv"]["filtered"]["relative_error_percent"]["total"]
    assert found.identified < found.nominal and found.identified / 1.5 < stated < 1.5 * found.identified


@pytest.mark.slow
def test_a_worse_stage_decides(whole: Session) -> None:
    before = whole.path("8-dynamics/estimate.csv").stat().st_mtime_ns
    edit(whole.path("session.toml"), "tolerance_percent = 0.0", "tolerance_percent = 0.1")
    assert kinds(whole)["identify"] == steps.DONE and kinds(whole)["predict"] == steps.STALE
    stop = commands.go_on(whole.folder, lambda words: None, lambda words: None, "calib next")
    assert stop.verdict == "fail"
    assert "above the tolerance of 0.1 %" in whole.path("certificate.html").read_text()
    assert whole.path("8-dynamics/estimate.csv").stat().st_mtime_ns == before
    assert json.loads(whole.path("5-validation/metrics.json").read_text())["verdict"] != "fail"


def reheaded(change: Callable[[list[str]], list[str]]) -> Callable[[str], str]:
    def changed(text: str) -> str:
        head, rest = text.split("\n", 1)
        return ",".join(change(head.split(","))) + "\n" + rest

    return changed


def swapped(header: list[str]) -> list[str]:
    names = [name.replace("joint2 ", "?").replace("joint3 ", "joint2 ").replace("?", "joint3 ") for name in header]
    return [new if new[:2] == "q_" else old for old, new in zip(header, names)]


def numbers(change: Callable[[np.ndarray, list[str]], np.ndarray]) -> Callable[[str], str]:
    def changed(text: str) -> str:
        head, *lines = text.strip().split("\n")
        table = change(np.array([line.split(",") for line in lines], dtype=float), head.split(","))
        return "\n".join([head, *(",".join(f"{x:.8g}" for x in row) for row in table)]) + "\n"

    return changed


def scaled(name: str, factor: float) -> Callable[[str], str]:
    return numbers(lambda table, header: np.where([each.startswith(name) for each in header], factor * table, table))


def in_milli_but_the_last(text: str) -> str:
    """Torques in mNm, within ten times the limits of the last joint: no limit tells the unit, the masses do."""
    return scaled("tau_joint7", 1e-3)(scaled("tau_joint", 1e3)(text))


def counted_from_the_horizontal(table: np.ndarray, header: list[str]) -> np.ndarray:
    two, three = (next(k for k, name in enumerate(header) if name.startswith(f"q_joint{j}")) for j in (2, 3))
    table[:, three] += table[:, two]
    return table


def another(table: np.ndarray, header: list[str]) -> np.ndarray:
    columns = [name.startswith("q_") for name in header]
    table[:, columns] = 30.0 * np.sin(np.outer(table[:, 0], np.arange(1, 8)))
    return table


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (reheaded(lambda header: [name.replace("[deg]", "[rad]") for name in header]), "looks like deg"),
        pytest.param(
            reheaded(swapped),
            r"columns are swapped \(the column of joint3 contains joint2, .*joint2 contains joint3",
            marks=pytest.mark.slow,
        ),
        (scaled("t [", 2.0), "0.5 times its speed"),
        (scaled("tau_joint", -1.0), "reverse their sign"),
        pytest.param(
            scaled("tau_joint4", -1.0),
            "training_log.csv: torque of joint4 .* reverse the sign of the column of joint4",
            marks=pytest.mark.slow,
        ),
        (numbers(counted_from_the_horizontal), r"if joint3, joint2 are combined \(-\)"),
        pytest.param(scaled("tau_joint", 1e-2), "times those of the nominal masses", marks=pytest.mark.slow),
        (scaled("tau_joint", 1e3), "every joint exceeds 3 times its limit: N mm"),
        pytest.param(in_milli_but_the_last, "joint2, joint3.* are they in mNm", marks=pytest.mark.slow),
        (numbers(another), "does not contain the motion designed in this session"),
        pytest.param(numbers(lambda table, header: table[:1000]), "shorter than one period", marks=pytest.mark.slow),
        (reheaded(lambda header: [name.replace("q_joint4", "x4") for name in header]), "joint"),
    ],
    ids=[
        "rad",
        "swapped",
        "rehearsal",
        "sign",
        "one",
        "horizontal",
        "unit",
        "mNm",
        "most",
        "another",
        "stopped",
        "missing",
    ],
)
def test_a_wrong_recording_is_said(recorded: Session, change: Callable[[str], str], message: str) -> None:
    path = recorded.path("7-recorded/training_log.csv")
    path.write_text(change(path.read_text()))
    with pytest.raises(MeasurementError, match=message):
        go_on(recorded)
    assert kinds(recorded)["excite"] == steps.DONE and not recorded.path("8-dynamics/dynamics.json").exists()


@pytest.mark.slow
def test_loose_or_rare_playback_is_noted(recorded: Session) -> None:
    """A motion played too seldom and loosely is noted."""
    path, motion = recorded.path("7-recorded/training_log.csv"), designed_motions(recorded)["training"]
    log = read_recording(str(path), joints_of(load_calibrated(recorded.fit.path).chain))
    loose = replace(log, q=log.q + 0.3 * log.q.std(axis=0) * np.sin(40.0 * log.t)[:, None])
    found, noted = check_motion(loose, motion, {}, 5)
    assert found.periods == 2 and [one.code for one in noted] == ["repetitions-missing", "tracking-loose"]


@pytest.mark.slow
def test_training_and_validation_stay_apart(recorded: Session) -> None:
    """The validation motion is not learnt from, and the training motion is no proof."""
    one, two = recorded.path("7-recorded/training_log.csv"), recorded.path("7-recorded/validation_log.csv")
    shutil.copyfile(two, one)
    with pytest.raises(MeasurementError, match="contains the validation motion instead"):
        go_on(recorded)


@pytest.mark.slow
def test_recordings_keep_their_plan(recorded: Session) -> None:
    """Recordings keep the plan that they were made to."""
    before = recorded.path("6-excitation/training/trajectory.csv").read_text()
    edit(recorded.path("session.toml"), "harmonics = 5", "harmonics = 4")
    assert kinds(recorded)["excite"] == steps.KEPT
    assert recorded.path("6-excitation/training/trajectory.csv").read_text() == before


@pytest.mark.slow
def test_guided_demo_stops_for_an_engineer(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A guided demonstration stops where an engineer would."""
    out = str(tmp_path / "cell")
    assert cli.run(["demo", "--guided", "--geometry-only", "--no-plots", "--out", out]) == 0
    said = capsys.readouterr().out.replace("\n", "")
    assert "Drive the 40 poses" in said and f"calib demo --bring {out}" in said
    assert not list((tmp_path / "cell/3-measured").iterdir())
    assert cli.run(["demo", "--bring", out]) == 0
    assert (tmp_path / "cell/3-measured/validation_measured.csv").exists()
    assert cli.run(["demo", "--bring", out]) == 2 and "waits for no files" in capsys.readouterr().err


def test_massless_robot_gets_no_dynamics(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A robot without masses is calibrated without dynamics."""
    session = begin(tmp_path / "cell", "ur5", "cmm", 5, 0, dynamics=False)
    assert not session.dynamic and not session.path("7-recorded").exists()


@pytest.mark.slow
def test_front_motion_is_picked(waiting: Session, capsys: pytest.CaptureFixture) -> None:
    """A picked motion becomes the training motion, its step stays done; recorded motions are not exchanged."""
    path = waiting.path("session.toml")
    edit(path, "goals = []", 'goals = ["wrist=0.5"]')
    edit(path, "front = 0", "front = 3")
    edit(path, "evaluations = 100", "evaluations = 30")
    capsys.readouterr()
    assert run("next", waiting.folder) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert "goal wrist=0.5 is missed" in words and "motions to choose from" in words
    front = stored_front.read(waiting.path("6-excitation/training"))
    number = 2 if front.values.designed == 0 else 1
    assert run("next", waiting.folder, "--pick", number) == 0
    assert stored_front.read(waiting.path("6-excitation/training")).values.designed == number - 1
    assert kinds(waiting)["excite"] == steps.DONE
    assert run("next", waiting.folder, "--pick", 99) == 2
    assert kinds(waiting)["excite"] == steps.DONE, "a pick that is refused changes nothing"
    edit(path, 'goals = ["wrist=0.5"]', 'goals = ["wrist=0.4"]')
    assert run("next", waiting.folder, "--pick", 1) == 2
    edit(path, 'goals = ["wrist=0.4"]', 'goals = ["wrist=0.5"]')
    capsys.readouterr()
    waiting.path("7-recorded").mkdir(exist_ok=True)
    waiting.path("7-recorded/training_log.csv").write_text("t\n")
    assert run("next", waiting.folder, "--pick", 1) == 2
    assert "already recorded" in capsys.readouterr().err
