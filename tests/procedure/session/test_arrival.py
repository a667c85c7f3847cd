"""What arrives says of itself whether joints were read back, and whether anything moved while it was measured."""

from dataclasses import replace

import numpy as np
import pytest
from sessions import begin

from calib.data.poses.fit_options import FitOptions
from calib.data.poses.measurements import take
from calib.errors import Finding, MeasurementError, UsageError
from calib.procedure.answers import CAMERA, Answers
from calib.procedure.kinematic_stage import inputs
from calib.procedure.session import drift
from calib.procedure.session.dynamics_steps import options_of
from calib.procedure.session.folder import Session, open_session
from calib.procedure.session.geometry_steps import chain_of, read_measured, readback
from calib.procedure.session.questions import QUESTIONS, checked, with_answer
from calib.procedure.session.settings import written
from calib.robot.chain import random_joints
from calib.simulation.cell import measure, wandering
from calib.simulation.virtual_cells import virtual_cell

CELL = virtual_cell("lwr4plus")
Q = random_joints(CELL.nominal, 30, 3)


def repeated(size: float, seed: int) -> list[Finding]:
    first = wandering(measure(CELL, Q, seed), size, seed)
    again = wandering(measure(CELL, Q[:4], seed + 100), size, seed, begin=1.0)
    return drift.repeats(CELL.nominal, [first], [replace(again, file="drift.csv")], 60e-6)


@pytest.mark.parametrize("seed", range(5))
def test_drift_is_told_from_noise(seed: int) -> None:
    assert [repeated(size, seed)[0].code for size in (0.0, 1e-3)] == ["poses-repeat", "poses-moved"]


def test_pose_repeated_in_one_file_counts() -> None:
    """A pose measured twice in one file counts."""
    found = measure(CELL, np.concatenate([Q, Q[:3]]), 1)
    (repeats,) = drift.repeats(CELL.nominal, [found], [], 60e-6)
    assert (repeats.code, repeats.values["poses"], repeats.values["when"]) == ("poses-repeat", 3, "more than once")
    assert drift.repeats(CELL.nominal, [take(found, range(20))], [], 60e-6) == []


def test_commanded_joints_are_noticed() -> None:
    """Commanded joints in place of read ones are noticed."""
    found = measure(CELL, Q, 1)
    assert readback(Q, found)[0].values["rms"] == pytest.approx(9.1e-6, rel=0.01)
    assert readback(Q, replace(found, q=Q))[0].code == "readback-copied"


def test_recording_name_states_its_payload(tmp_path) -> None:
    """A recording named after a payload carries it."""
    session = begin(tmp_path / "cell", "lwr4plus", "cmm", 5, 0, payloads={"loaded": 3.28}, torques="both")
    for name in ("training.csv", "training_loaded.csv"):
        session.path(f"7-recorded/{name}").write_text("t\n")
    found = options_of(session)
    assert found.settings.payloads["loaded"].mass == 3.28 and found.settings.torque_rows.name == "both"
    assert {name: one.payload for name, one in found.files.items()} == {"training_loaded.csv": ("loaded",)}


def test_geometry_from_torques_is_asked_for_beside_an_options_file(tmp_path) -> None:
    session = begin(tmp_path / "cell", "lwr4plus", "cmm", 5, 0)
    session.path("dynamics.toml").write_text('method = "ols"\n')
    dynamics = replace(session.settings.dynamics, options="dynamics.toml", with_geometry=True)
    session.path("session.toml").write_text(written(replace(session.settings, dynamics=dynamics)))
    settings = options_of(open_session(session.path(""))).settings
    assert settings.method == "ols" and settings.with_geometry


def test_answers_are_checked_as_they_come() -> None:
    ask = {question.name: question for question in QUESTIONS}
    given = with_answer(Answers(), ask["robot"], "lwr4plus")
    given = with_answer(given, ask["instrument"], "cmm")
    with pytest.raises(UsageError, match="tool: expected x,y,z in metres"):
        with_answer(given, ask["tool"], "50,0,50")
    given = with_answer(given, ask["tool"], "0.05,0,0.05")
    with pytest.raises(UsageError, match="label=kg"):
        with_answer(given, ask["payloads"], "3.28")
    given = with_answer(with_answer(given, ask["payloads"], "loaded=3.28"), ask["dynamics"], "yes")
    assert not ask["payloads"].open(given) and ask["torques"].open(given)
    found = checked(with_answer(given, ask["torques"], "both"))
    assert found["payloads"] == {"loaded": {"mass": 3.28}} and found["tool"] == (0.05, 0.0, 0.05) and found["dynamics"]
    with pytest.raises(UsageError, match="geometry-only"):
        checked(Answers("ur5", "cmm", dynamics=False, torques="both"))


def test_wrong_unit_of_validation_is_refused(measured: Session) -> None:
    """Metres under a header of millimetres are refused in validation files, too."""
    path = measured.path("3-measured/validation_measured.csv")
    head, *lines = path.read_text().strip().split("\n")
    columns = [k for k, name in enumerate(head.split(",")) if name in ("x [mm]", "y [mm]", "z [mm]")]
    table = np.array([line.split(",") for line in lines], dtype=float)
    assert len(columns) == 3 and inputs.read_file(path, CELL.nominal, FitOptions())
    table[:, columns] *= 1e-3
    path.write_text("\n".join([head, *(",".join(map(str, row)) for row in table)]) + "\n")
    with pytest.raises(MeasurementError, match=r"validation_measured.csv: .*are they m, although the header states mm"):
        read_measured(measured, chain_of(measured), [path])


def test_camera_is_asked_for_its_own_place():
    """Where a tracker is asked for target, place and cone, a camera is asked what the arm carries, and for files."""
    asked = {}
    for instrument in ("tracker", "camera"):
        given = Answers(robot="lwr4plus", instrument=instrument)
        asked[instrument] = [question for question in QUESTIONS if question.open(given)]
    names = {key: [question.name for question in found] for key, found in asked.items()}
    assert {"tool", "instrument_at"} <= set(names["tracker"]) and not {"tool", "instrument_at"} & set(names["camera"])
    assert [names[key].count("limits") for key in names] == [1, 1]
    assert "[camera]" in next(question.words for question in asked["camera"] if question.name == "limits")
    assert "mounting" in names["camera"] and not {"mounting", "lens", "carried"} & set(names["tracker"])
    for mounting, others in (("unknown", 0), ("in hand", 4), ("to-hand", 4)):
        given = with_answer(Answers("lwr4plus", "camera"), asked["camera"][1], mounting)
        assert sum(question.open(given) for question in QUESTIONS if question.name in CAMERA) == others


def test_program_is_checked_when_typed() -> None:
    """The question is asked again at once, so that no answer is lost at the end."""
    ask = {question.name: question for question in QUESTIONS}
    answers = with_answer(Answers(), ask["robot"], "lwr4plus")
    with pytest.raises(UsageError, match=r"'0\.5' is not one of"):
        with_answer(answers, ask["program"], "0.5")
    assert with_answer(answers, ask["program"], "none").program == "none"
