"""The formats are documented where they are read, and the command prints that."""

import os
import subprocess
import sys
import tomllib

import pytest

from calib import cli
from calib.cli.help import GROUPS
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
        ("recordings", ("measured_torque", "calib formats logs", "use_range")),
        ("logs", ("sensor_msgs/JointState", "RTDE")),
    ],
)
def test_what_a_user_looks_for_is_there(calib, topic, words):
    out = calib("formats", topic)[1]
    for word in words:
        assert word in out, word


def test_verdict_limits_match_the_catalogue(calib):
    """Limits of a verdict are those that the catalogue prints."""
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
    monkeypatch.setenv("COLUMNS", "60")
    shown = calib("--help")[1].partition("Start:")[2]
    assert "..." not in shown and [group for group in GROUPS if f"{group}:" not in f"Start:{shown}"] == []


@pytest.mark.parametrize("name", sorted(cli.command_tree().commands))
def test_commands_have_parsing_examples(calib, monkeypatch, name):
    """Each command has an example that parses, and no type of Python."""
    monkeypatch.setenv("COLUMNS", "60")
    shown, command = calib(name, "--help")[1], cli.command_tree().commands[name]
    (example,) = (line.split() for line in shown.splitlines() if line.startswith("  Example: "))
    assert example[1:3] == ["calib", name]
    command.make_context(name, example[3:])
    assert not set("<>{}") & set(shown) and max(map(len, shown.splitlines())) <= 60


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("calib ide", "identify"), ("calib fit ur10", "ur10 ur10e"), ("calib excite five", "fivebar"),
        ("calib fit --stat", "--stations"), ("calib fit --stations o", "one"), ("calib excite --solver m", "mma"),
        ("calib select --index O", "O1 O2 O3 O4 O5"), ("calib formats identi", "identified identify-options"),
        ("calib explain sigma-r", "sigma-ratio"), ("calib explain dead", ""),
    ],
)  # fmt: skip
def test_the_shell_completes_words(capsys, monkeypatch, tmp_path, line, expected):
    monkeypatch.chdir(tmp_path)
    for name, value in _asked(line).items():
        monkeypatch.setenv(name, value)
    assert cli.run([]) == 0 and sorted(capsys.readouterr().out.split()) == expected.split()


def test_completion_loads_nothing_heavy():
    code = "import sys; from calib import cli; cli.run([]); print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | _asked("calib fit ur"), capture_output=True, text=True
    )
    assert "ur10e" in done.stdout and not {"numpy", "rich", "yaml", "calib.robot.chain"} & set(done.stdout.split())


def _asked(line: str) -> dict[str, str]:
    """Return the environment in which bash asks what completes a line."""
    return {"_CALIB_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(line.split()) - 1)}


@pytest.mark.slow
def test_console_without_unicode_gets_words(tmp_path):
    """Letters that an encoding lacks are spelt: sigma, ^2, +-; others get their number."""
    assert (
        "1 σ, 2 ± 0.1 µm, kg m², 3 °…, 中".encode("ascii", "spelt").decode()
        == "1 sigma, 2 +- 0.1 um, kg m^2, 3 deg..., \\u4e2d"
    )
    written = {"PYTHONIOENCODING": "ascii", "COLUMNS": "60"}
    done = subprocess.run(
        [sys.executable, "-m", "calib", "select", "--help"], env=os.environ | written, capture_output=True, text=True
    )
    assert "measurement sigma of" in done.stdout and done.stdout.isascii() and "\\" not in done.stdout
