"""session.toml: what `calib new` writes is read back, old files open, and a wrong value is named."""

from __future__ import annotations

import dataclasses
import json
import tomllib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.data.poses.fit_options import FitOptions
from calib.dynamics.torque_rows import torque_rows
from calib.errors import SessionError, UsageError
from calib.identification.settings import IdentificationSettings
from calib.procedure.excitation.settings import HARMONICS, ExcitationSettings
from calib.procedure.kinematic_stage.settings import FitSettings, SelectionSettings
from calib.procedure.session.commands import begin
from calib.procedure.session.folder import open_session
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
from calib.procedure.session.steps import _changes

# as the version before typed settings (commit a217159) wrote it
OLD = """# A calibration session; see `calib status` and `calib next`. Lengths in m, angles in rad.
# Change what you like: steps made from something that changed are shown as stale and made again.
schema = 2
name = "ur5"
created = "2026-11-20T10:00:00+01:00"
seed = 1                          # of pose selection, cross-validation and everything else random

[robot]
file = "1-robot/robot.urdf"
given = "ur5"
base = ""                        # URDF: the link the arm starts at, empty: the root
tip = ""                          # URDF: the link the arm ends at, empty: the longest chain's end

[instrument]
name = "laser tracker"
measures = "position"                # pose (with orientation) or position
sigma_position = 2e-05      # of one measurement, per axis; 0: to be estimated
sigma_orientation = 0.0
tool = [0.05, 0.0, 0.05]               # where the target roughly sits in the tip's frame; only pose selection uses it

[poses]
fit = 40                            # how many poses to choose for the fit
validation = 20              # how many more to measure and never fit; 0: no validation
plan = true                            # false: measured files hold other poses than those chosen here
index = "O1"
method = "detmax"
constraints = "limits.toml"                       # a TOML file beside this one; see `calib formats constraints`

[fit]
model = "auto"                         # or frames, offsets, geometry, stiffness, bending, coupling, harmonics, wobble
loss = "none"                          # or huber, cauchy
options = ""                           # a TOML file beside this one: column names, units; see `calib formats options`
stations = "each"                      # each measured file has its own base placement, or one for all
validation_frames = "fit"              # own: base and tool placement are fitted anew on validation files
tolerance_mm = 0.0                     # largest rms [mm] on unseen poses that is good enough: above it the verdict is
                                       # fail; 0: none, and pass only means better than the nominal robot

[dynamics]
wanted = true                          # false: geometry only
plan = true                            # false: recorded files hold other motions than those designed here
validation = true                      # false: no second motion is designed or asked for
period = 20.0                          # of the designed motion [s]; the validation motion's is 0.8 of it
harmonics = 5                          # frequencies per joint
rate = 1000.0                          # of the controller [Hz]
repeats = 3                            # how often the robot plays each motion
starts = 4                             # random starts of the search for a motion
evaluations = 400                      # most per start
limits = "limits.toml"                            # a TOML file beside this one; see `calib formats limits`
torques = "motor"                      # motor, link, or both: sensors behind the gears beside the motors' torques
friction = "auto"                      # or standard, or one rung of the ladder; see calib identify --friction
method = "wls"                         # or ols, irls, tls
options = ""                           # a TOML file beside this one; see `calib formats identify-options`
tolerance_percent = 0.0                # largest torque error on unseen motion that is good enough; 0: none

[dynamics.payloads]                    # label = mass [kg] of bodies at the flange: loaded = 3.28
"loaded" = 3.28
"""
WORDS = st.text(st.characters(exclude_categories=["Cs"]), max_size=30)


@pytest.fixture
def old(tmp_path: Path) -> Path:
    path = tmp_path / "session.toml"
    path.write_text(OLD, encoding="utf-8")
    return path


def test_a_session_of_the_version_before_typed_settings_opens(old: Path) -> None:
    found = open_session(old.parent).settings
    assert (found.poses.fit, found.instrument.tool, found.dynamics.payloads) == (
        40,
        (0.05, 0.0, 0.05),
        {"loaded": 3.28},
    )
    assert found.seed == 1 and found.fit.tolerance_mm == 0.0 and found.dynamics.limits == "limits.toml"
    then = tomllib.loads(OLD)
    then["fit"] |= {"deliverable": "urdf", "holdout": 0.0}
    then["dynamics"] |= {"holdout": 0.0}
    assert tomllib.loads(written(found)) == then, "nothing else is added, lost or spelled otherwise"


def test_a_session_of_schema_1_goes_on_without_dynamics(old: Path) -> None:
    old.write_text(OLD.replace("schema = 2", "schema = 1").split("[dynamics]")[0])
    assert not open_session(old.parent).dynamic


def test_a_step_is_not_stale_because_a_number_is_spelled_otherwise() -> None:
    place = "session.toml [fit] tolerance_mm"
    assert _changes({place: "0"}, {place: "0.0"}) == ""
    assert _changes({place: "0"}, {place: "0.5"}) == f"{place} has changed"
    assert _changes({"a.csv": "10"}, {"a.csv": "1e1"}) == "a.csv has changed", "a file's mark is no number"


@settings(deadline=None)
@given(WORDS, WORDS, WORDS, st.dictionaries(WORDS, st.floats(1e-3, 1e3), max_size=3), st.integers(0, 2**63 - 1))
def test_names_come_back_whatever_they_hold(name: str, given_as: str, link: str, loads: dict, seed: int) -> None:
    made = SessionSettings(
        name, "2026-01-01T00:00:00+00:00", seed, RobotSection("1-robot/robot.urdf", given_as, link, link),
        InstrumentSection(name, "pose"), PosesSection(), FitSection(), DynamicsSection(payloads=loads),
    )  # fmt: skip
    table = tomllib.loads(written(made))
    assert dataclasses.asdict(made) == {**table, "instrument": {**table["instrument"], "tool": (0.05, 0.0, 0.05)}}


def test_a_robot_whose_name_holds_quotes_and_lines_makes_a_session(tmp_path: Path) -> None:
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
        ('constraints = "limits.toml"', 'constraints = "/data/l.toml"', "poses.constraints: expected a file beside"),
        ('limits = "limits.toml"', 'limits = "sub"', "dynamics.limits: expected a file, found the folder 'sub'"),
        ('file = "1-robot/robot.urdf"', 'file = ""', "robot.file: expected a text, found ''"),
        ('options = ""', 'options = "a\\u0000b"', "fit.options: expected a file beside"),
        ("seed = 1", "seed = -1", "seed: expected a whole number, 0 or more, found -1"),
        ("seed = 1", f"seed = 1{'0' * 400}", "seed: a whole number of more than 64 bits"),
        ("seed = 1", f"seed = 1{'0' * 5000}", "is no TOML: a whole number of thousands of digits"),
        ("seed = 1", f"seed = {'[' * 5000}", "is nested too deeply"),
        ("seed = 1", f"seed.{'a.' * 2000}a = 1", "is nested too deeply"),
        ("seed = 1", "seed = true", "seed: expected a whole number"),
        ("tool = [0.05, 0.0, 0.05]", "tool = [1979-05-27, 0.0, 0.05]", r"three numbers \[m\], found \[1979-05-27, 0.0"),
        ("tool = [0.05, 0.0, 0.05]", "tool = [0.1, 0.2]", r"instrument.tool: expected three numbers \[m\]"),
        ("tool = [0.05, 0.0, 0.05]", "tool = ['a', 'b', 'c']", r"instrument.tool: expected three numbers \[m\]"),
        ("tool = [0.05, 0.0, 0.05]", "tool = [nan, 0, 0]", r"expected three numbers \[m\], found \[nan, 0, 0\]"),
        ('measures = "position"', 'measures = "foo"', "measures: expected one of pose, position, pixels, nothing"),
        ("fit = 40", "fit = 0", "poses.fit: expected a whole number, 1 or more, found 0"),
        ('index = "O1"', 'index = "o1"', "poses.index: expected one of O1, .*did you mean 'O1'"),
        ('method = "detmax"', 'method = "detmx"', "poses.method: expected one of .*did you mean 'detmax'"),
        ("rate = 1000.0", "rate = 1e12", "dynamics.rate: expected Hz, at most 100000"),
        ("period = 20.0", "period = 1e9", "dynamics.period: expected s, at most 3600"),
        ("[poses]", "poses = 3\n[poss]", "instrument: there is no key 'poses'"),
        ("schema = 2", "schema = true", "not known"),
    ],
)  # fmt: skip
def test_a_wrong_value_is_named_with_what_is_expected(old: Path, before: str, after: str, message: str) -> None:
    assert before in OLD
    (old.parent / "sub").mkdir()
    old.write_text(OLD.replace(before, after, 1))
    with pytest.raises(SessionError, match=message):
        read_settings(old)


# keys of session.toml that mean something else than the commands' options of that name, or that these have not
OWN = {
    "fit": {"options", "validation_frames", "tolerance_mm"},
    "poses": {"fit", "validation", "plan", "constraints"},
    "dynamics": {
        "wanted", "plan", "validation", "harmonics", "repeats", "limits", "torques", "options", "tolerance_percent",
        "payloads", "holdout",
    },
}  # fmt: skip


def test_a_new_sessions_defaults_are_the_commands() -> None:
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


def test_the_example_names_every_key_with_its_default() -> None:
    table = tomllib.loads(example())
    assert set(table) == {f.name for f in dataclasses.fields(SessionSettings)}
    assert table["dynamics"] == dataclasses.asdict(DynamicsSection()) and table["fit"] == dataclasses.asdict(
        FitSection()
    )
    assert all(len(line) <= 120 and line == line.rstrip() for line in example().splitlines())
