"""session.toml: what `calib new` writes is read back, old files open, and a wrong value is named."""

import dataclasses
import json
import tomllib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sessions import begin

from calib.data.poses.fit_options import FitOptions
from calib.dynamics.torque_rows import torque_rows
from calib.errors import SessionError, UsageError
from calib.identification.settings import IdentificationSettings, Payload
from calib.procedure.answers import CertificateSection
from calib.procedure.excitation.settings import HARMONICS, ExcitationSettings
from calib.procedure.kinematic_stage.settings import FitSettings, SelectionSettings
from calib.procedure.session.folder import open_session
from calib.procedure.session.recording_names import check_labels
from calib.procedure.session.settings import (
    DynamicsSection,
    FitSection,
    InstrumentSection,
    PosesSection,
    RobotSection,
    SessionSettings,
    example,
    read_settings,
    written,
)
from calib.procedure.session.steps import StatedConstraints, changed_inputs
from calib.records import plain

# as the version before typed settings (commit a217159) wrote it
OLDER = Path(__file__).parent / "older/cell/session.toml"
OLD = OLDER.read_text(encoding="utf-8") + '"loaded" = 3.28\n'
WORDS = st.text(st.characters(exclude_categories=["Cs"]), max_size=30)


@pytest.fixture
def old(tmp_path: Path) -> Path:
    path = tmp_path / "session.toml"
    path.write_text(OLD, encoding="utf-8")
    return path


def test_session_before_typed_settings_opens(old: Path) -> None:
    """A session of the version before typed settings opens."""
    found = open_session(old.parent).settings
    assert (found.poses.fit, found.instrument.tool) == (16, (0.3, 0.05, 0.02))
    assert found.seed == 1 and found.fit.tolerance_mm == 0.0 and found.dynamics.payloads == {"loaded": Payload(3.28)}
    then = tomllib.loads(OLD)
    then["robot"] |= {"controller": "", "external": []}
    then["instrument"] |= {"reference": False}
    then["fit"] |= {"deliverable": "urdf", "holdout": 0.0, "rounds": 3}
    then["dynamics"] |= {"holdout": 0.0, "goals": [], "hard": [], "front": 0, "sigma_percent": 0.0}
    then["dynamics"] |= {"tolerance_torque": [], "with_geometry": False}
    then["certificate"] = dict.fromkeys(vars(CertificateSection()), "")
    assert tomllib.loads(written(found)) == then, "nothing else is added, lost or spelled otherwise"


def test_schema_1_goes_on_without_dynamics(old: Path) -> None:
    """A session of schema 1 goes on without dynamics."""
    old.write_text(OLD.replace("schema = 2", "schema = 1").split("[dynamics]")[0])
    assert not open_session(old.parent).dynamic


def test_number_spelling_makes_nothing_stale() -> None:
    """A step is not stale because a number is spelled otherwise."""
    place = "session.toml [fit] tolerance_mm"
    assert changed_inputs({place: "0"}, {place: "0.0"}) == ""
    assert changed_inputs({place: "0"}, {place: "0.5"}) == f"{place} has changed"
    assert changed_inputs({"a.csv": "10"}, {"a.csv": "1e1"}) == "a.csv has changed", "a file's mark is no number"


def tell_recordings_apart(loads: dict[str, float]) -> bool:
    """Whether labels are allowed: a drawn one may be ``NONE``, which stands in names of recordings."""
    try:
        check_labels(loads)
    except ValueError:
        return False
    return True


LOADS = st.dictionaries(WORDS, st.floats(1e-3, 1e3), max_size=3).filter(tell_recordings_apart)


@settings(deadline=None)
@given(WORDS, WORDS, WORDS, LOADS, st.integers(0, 2**63 - 1))
def test_names_come_back_whatever_they_hold(name: str, given_as: str, link: str, loads: dict, seed: int) -> None:
    made = SessionSettings(
        name, "2026-01-01T00:00:00+00:00", seed, RobotSection("1-robot/robot.urdf", given_as, link, link),
        InstrumentSection(name, "pose"), PosesSection(), FitSection(), DynamicsSection(payloads=loads),
    )  # fmt: skip
    assert plain(made) == tomllib.loads(written(made))


def test_odd_robot_name_makes_a_session(tmp_path: Path) -> None:
    """The name can neither break session.toml nor add keys to it."""
    name = 'a"b\\\n"""\nseed = 7\n[x]'
    joint = "[[joint]]\nlower = -1\nupper = 1\n"
    text = f'name = {json.dumps(name)}\n{joint}{joint}alpha = "pi/2"\n'
    (tmp_path / "robot.toml").write_text(text)
    made = begin(tmp_path / "cell", str(tmp_path / "robot.toml"), "tracker", 20, 5, seed=3, dynamics=False)
    assert (made.settings.name, made.settings.seed) == (name, 3)
    assert open_session(made.folder).settings == made.settings


def test_what_cannot_be_leaves_no_session(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="seed: expected a whole number, 0 or more, found -1"):
        begin(tmp_path / "cell", "ur5", "tracker", 20, 5, seed=-1)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('constraints = ""', 'constraints = "/data/l.toml"', "poses.constraints: expected a file next to"),
        ('limits = ""', 'limits = "sub"', "dynamics.limits: expected a file, found the folder 'sub'"),
        ('file = "1-robot/robot.toml"', 'file = ""', "robot.file: expected a text, found ''"),
        ('options = ""', 'options = "a\\u0000b"', "fit.options: expected a file next to"),
        ("seed = 1", "seed = -1", "seed: expected a whole number, 0 or more, found -1"),
        ("tool = [0.3, 0.05, 0.02]", "tool = [0.1, 0.2]", r"instrument.tool: expected three numbers \[m\]"),
        ("tool = [0.3, 0.05, 0.02]", "tool = ['a', 'b', 'c']", r"instrument.tool: expected three numbers \[m\]"),
        ("tool = [0.3, 0.05, 0.02]", "tool = [nan, 0, 0]", r"expected three numbers \[m\], found \[nan, 0, 0\]"),
        ('measures = "position"', 'measures = "foo"', "measures: expected one of pose, position, pixels, nothing"),
        ("fit = 16", "fit = 0", "poses.fit: expected a whole number, 1 or more, found 0"),
        ('index = "O1"', 'index = "o1"', "poses.index: expected one of O1, .*did you mean 'O1'"),
        ('method = "detmax"', 'method = "detmx"', "poses.method: expected one of .*did you mean 'detmax'"),
        ("rate = 10.0", "rate = 1e12", "dynamics.rate: expected a number .Hz., at most 100000"),
        ("period = 2.0", "period = 1e9", "dynamics.period: expected a number .s., at most 3600"),
        ("[poses]", "poses = 3\n[poss]", "instrument: there is no key 'poses'"),
        ("schema = 2", "schema = true", "is unknown"),
        ("schema = 2", "schema = 3", "newer version"),
        ("[poses]", "[poses", "is not a TOML file"),
        ("tolerance_mm = 0.0", "tolerance_mm = -1.0", "expected 0 or more"),
        ('loss = "none"', 'los = "none"', r"fit: there is no key 'los' \(did you mean 'loss'"),
    ],
)  # fmt: skip
def test_wrong_value_names_the_expected(old: Path, before: str, after: str, message: str) -> None:
    """A wrong value is named with what is expected."""
    assert before in OLD
    (old.parent / "sub").mkdir()
    old.write_text(OLD.replace(before, after, 1))
    with pytest.raises(SessionError, match=message):
        read_settings(old)


# keys of session.toml that mean something else than the commands' options of that name, or that these have not
OWN = {
    "fit": {"options", "validation_frames", "tolerance_mm", "rounds"},
    "poses": {"fit", "validation", "plan", "constraints"},
    "dynamics": {
        "wanted", "plan", "validation", "harmonics", "repeats", "limits", "torques", "options", "tolerance_percent",
        "sigma_percent", "tolerance_torque",
        "payloads", "holdout",
    },
}  # fmt: skip


def test_session_defaults_are_the_commands() -> None:
    """A new session's defaults are the commands'."""
    commands = {
        "fit": (FitOptions(), FitSettings()),
        "poses": (SelectionSettings(),),
        "dynamics": (ExcitationSettings(), IdentificationSettings()),
    }
    new = {"fit": FitSection(), "poses": PosesSection(), "dynamics": DynamicsSection()}
    for name, section in new.items():
        for key in dataclasses.fields(section):
            stated = [getattr(one, key.name) for one in commands[name] if getattr(one, key.name, None) is not None]
            if key.name not in OWN[name]:
                assert stated, f"[{name}] {key.name}: no command has it, and it is none of OWN"
                assert getattr(section, key.name) == stated[0], f"[{name}] {key.name}"
    fit, dynamics = FitSection(), DynamicsSection()
    assert (fit.validation_frames == "own") == FitSettings().refit_frames and (fit.tolerance_mm or None) is None
    assert torque_rows(dynamics.torques) is IdentificationSettings().torque_rows and dynamics.harmonics == HARMONICS


def test_example_names_keys_with_defaults() -> None:
    """The example names every key with its default."""
    table = tomllib.loads(example())
    assert set(table) == {f.name for f in dataclasses.fields(SessionSettings)}
    assert table["dynamics"] == plain(DynamicsSection()) and table["fit"] == dataclasses.asdict(FitSection())
    assert all(len(line) <= 120 and line == line.rstrip() for line in example().splitlines())


def test_constraints_file_is_an_input(tmp_path: Path) -> None:
    """A Python file of constraints that the options name counts as read; changed, it makes the identification stale."""
    session = begin(tmp_path / "cell", "tx40", "cmm", 5, 0)
    assert StatedConstraints().paths(session) == []
    constraints = session.path("constraints.py")
    constraints.write_text("def constraints(beta):\n    return []\n")
    session.path("options.toml").write_text("[constraints]\nfile = 'constraints.py'\n")
    file = session.path("session.toml")
    keys = read_settings(file)
    dynamics = dataclasses.replace(keys.dynamics, options="options.toml")
    file.write_text(written(dataclasses.replace(keys, dynamics=dynamics)))
    assert StatedConstraints().paths(open_session(session.folder)) == [constraints.resolve()]
