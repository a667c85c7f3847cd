"""A frame on the base measured beside the target is an option of a session's instrument, from plan to certificate."""

import pytest
from sessions import begin, edit, go_on

from calib.apps.cell_demo import demo
from calib.data.poses.measurements import Positions
from calib.errors import MeasurementError, SessionError, UsageError
from calib.procedure.answers import Answers
from calib.procedure.session import commands, steps
from calib.procedure.session.folder import Session, open_session
from calib.procedure.session.geometry_steps import chain_of, read_measured
from calib.procedure.session.questions import QUESTIONS, checked, with_answer
from calib.records import read_json


def planned(folder, reference: bool) -> Session:
    """Return a session that waits for measurements."""
    session = begin(folder, "ur5", "cmm", 20, 0, seed=1, dynamics=False, reference=reference)
    edit(session.path("session.toml"), 'model = "auto"', 'model = "geometry"')
    waiting = go_on(session)
    assert waiting is not None and waiting.step.name == "measure"
    return session


@pytest.mark.slow
def test_base_frame_runs_through_a_session(tmp_path):
    """The second frame is planned, asked for, simulated, fitted, and stated on the certificate."""
    session, plain = (planned(tmp_path / f"reference {value}", value) for value in (True, False))
    waiting = next(state for state in steps.states(session) if state.kind == steps.WAITING)
    task, file = commands.asks(session, waiting)
    assert "the frame on the base" in task and "base_x [mm]" in file and "base_qw" in file
    waiting = next(state for state in steps.states(plain) if state.kind == steps.WAITING)
    task, file = commands.asks(plain, waiting)
    assert "the frame on the base" not in task and "base_x" not in file

    with_base, alone = (read_json(one.path("2-poses/selection.json"))["tool_sigma"] for one in (session, plain))
    assert 1.3 * alone < with_base < 5.0 * alone

    demo.simulate_next(session.folder, lambda text: None)
    (_, block), *_ = read_measured(session, chain_of(session), [session.path("3-measured/measured.csv")])
    assert isinstance(block, Positions) and block.base is not None and len(block) == 20
    assert go_on(session) is None
    assert "base frame moved by" in session.path("3-measured/checked.txt").read_text()
    assert "seen from a frame on the base" in session.path("certificate.html").read_text()

    # without its columns the file is refused
    path = session.path("3-measured/measured.csv")
    path.write_text(path.read_text().replace("base_", "foot_"))
    with pytest.raises(MeasurementError, match=r"has no base frame: .*reference = false in session.toml"):
        read_measured(session, chain_of(session), [path])
    edit(session.path("session.toml"), "reference = true", "reference = false")
    opened = open_session(session.folder)
    ((_, block),) = read_measured(opened, chain_of(opened), [path])
    assert isinstance(block, Positions) and block.base is None


def test_question_is_about_targets_only():
    """The question is asked where poses are measured; images have no second frame."""
    ask = {question.name: question for question in QUESTIONS}
    assert ask["reference"].open(Answers("ur5", "cmm")) and not ask["reference"].open(Answers("ur5", "camera"))
    answers = with_answer(Answers("ur5", "cmm"), ask["reference"], "yes")
    assert checked(answers)["reference"] is True
    assert "reference" not in checked(with_answer(Answers("ur5", "cmm"), ask["reference"], "no"))
    with pytest.raises(UsageError, match="--reference applies to a target's pose or position"):
        checked(Answers("ur5", "camera", reference=True))


def test_reference_of_images_is_refused(tmp_path):
    """Reference of images is refused in the file."""
    session = begin(tmp_path / "cell", "ur5", "camera", 5, 0, dynamics=False)
    edit(session.path("session.toml"), "reference = false", "reference = true")
    with pytest.raises(SessionError, match="reference = true applies to poses and positions"):
        open_session(session.folder)
