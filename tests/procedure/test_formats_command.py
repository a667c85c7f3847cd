"""The formats are documented where they are read, and the command prints that."""

import tomllib

import pytest

from calib.procedure.formats import TOPICS
from calib.procedure.session.settings import example


def test_every_format_has_its_documentation(calib):
    code, out, _ = calib("formats")
    assert (code, [line.split()[0] for line in out.splitlines()]) == (0, list(TOPICS))
    for topic in TOPICS:
        code, out, _ = calib("formats", topic)
        assert code == 0 and len(out) > 400 and "``" not in out and ">>>" not in out
    assert calib("formats", "poems")[0] == 2
    helped = calib("formats", "--help")[1]
    assert all(topic in helped for topic in TOPICS)


@pytest.mark.parametrize(
    ("topic", "words"),
    [
        ("measurements", ("q1 [deg]", "pair", "bar", "socket", "plane", "sigma_x", "r11", "RoboDK")),
        ("options", ("[columns]", "loss_scale", "wobble")),
        ("constraints", ("[target]", "sight", "[[obstacle]]")),
        ("mdh", ("[[joint]]", "alpha", "90 deg")),
        ("robot", ("[[element]]", "[[station]]", "[deflection]")),
        (
            "identified",
            ("metrics.json", "torques_N.csv", "above_band_percent", "standing", "calib explain torque-unexplained"),
        ),
        ("recordings", ("measured_torque", "JointState", "use_range")),
    ],
)
def test_what_a_user_looks_for_is_there(calib, topic, words):
    out = calib("formats", topic)[1]
    for word in words:
        assert word in out, word


def test_limits_of_a_verdict_are_those_that_the_catalogue_prints(calib):
    assert "marginal where share > 10; fail where share > 30" in calib("explain", "torque-unexplained")[1]


def test_the_session_file_is_printed_whole(calib):
    out = calib("formats", "session")[1]
    assert example() in out
    assert {"tolerance_mm", "validation_frames"} <= set(tomllib.loads(example())["fit"])


@pytest.mark.parametrize("command", ["fit", "select", "export", "new", "identify"])
def test_help_keeps_units_in_brackets(calib, command):
    code, out, _ = calib(command, "--help")
    assert code == 0
    if command == "select":
        assert "[m]" in out and "[rad]" in out and "calib formats constraints" in " ".join(out.split())
    if command == "fit":
        said = " ".join(out.split())
        assert "frames, offsets, geometry, stiffness, bending, coupling, harmonics or wobble" in said
        assert "calib formats measurements" in said and "Exit codes" in said


def test_no_commands_summary_is_cut_off(calib, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert "..." not in calib("--help")[1].partition("Commands:")[2]
