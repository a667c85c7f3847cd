"""The numbered examples: short, complete, and they do what their first line says."""

import re
from pathlib import Path

import pytest
from scripts import run_here

EXAMPLES = Path(__file__).parents[2] / "examples"
NUMBERED = sorted(EXAMPLES.glob("0*.py"))


def figures(pattern: str, said: str) -> list[float]:
    return [float(each) for each in re.findall(pattern, said)]


def test_nine_examples_read_in_a_minute():
    """There are nine examples, and each is read in a minute."""
    assert [path.name[:2] for path in NUMBERED] == [f"0{k}" for k in range(1, 10)]
    for path in NUMBERED:
        lines = path.read_text(encoding="utf-8").splitlines()
        assert len(lines) <= 25 and lines[0].startswith('"""') and path.name in "\n".join(lines[:5]), path.name


def test_they_show_the_api_alone():
    for path in NUMBERED:
        used = re.findall(r"^(?:from|import) (\S+)", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
        assert set(used) <= {"calib", "practice", "pathlib"}, path.name


@pytest.mark.slow
def test_01_fit_geometry(tmp_path, capsys):
    said = run_here(EXAMPLES / "01_fit_geometry.py", tmp_path, capsys=capsys)
    judged = next(line for line in said.splitlines() if line.startswith("unseen: "))
    before, after = figures(r"([\d.]+) mm (?:nominal|calibrated)", judged)
    assert after < 0.3 * before
    assert (tmp_path / "fit/robot.urdf").is_file()


@pytest.mark.slow
def test_02_choose_poses(tmp_path, capsys):
    (share,) = figures(
        r"efficiency .*? ([\d.]+) \(", run_here(EXAMPLES / "02_choose_poses.py", tmp_path, capsys=capsys)
    )
    assert share > 0.9
    assert len((tmp_path / "poses.csv").read_text().splitlines()) == 21


def test_04_compensate(tmp_path, capsys):
    nominal, commands = figures(r"off by ([\d.]+) mm", run_here(EXAMPLES / "04_compensate.py", tmp_path, capsys=capsys))
    assert commands < 0.2 * nominal


@pytest.mark.long
@pytest.mark.slow
def test_03_session_as_script(tmp_path, capsys):
    said = run_here(EXAMPLES / "03_session_as_script.py", tmp_path, capsys=capsys)
    assert "Provide" in said and "marginal: cell7" in said  # its arm hides what no rigid geometry explains
    assert (tmp_path / "cell7/certificate.html").is_file()
    assert (tmp_path / "cell7/9-export/robot.urdf").is_file()


@pytest.mark.slow
def test_05_design_excitation(tmp_path, capsys):
    raw, _ = figures(
        r"([\d.]+) (?:raw|normalised)", said := run_here(EXAMPLES / "05_design_excitation.py", tmp_path, capsys=capsys)
    )
    assert raw < 200 and "all limits are respected" in said
    assert (tmp_path / "motion/trajectory.yaml").is_file()


@pytest.mark.slow
def test_06_identify_dynamics(tmp_path, capsys):
    said = run_here(EXAMPLES / "06_identify_dynamics.py", tmp_path, capsys=capsys)
    (unexplained,) = figures(r"unseen: ([\d.]+) % of the torque unexplained", said)
    assert unexplained < 8.0


@pytest.mark.slow
def test_07_plan_on_the_identified_model(tmp_path, capsys):
    maker, identified = figures(
        r"model: ([\d.]+) s", run_here(EXAMPLES / "07_plan_on_identified_model.py", tmp_path, capsys=capsys)
    )
    assert 0.1 < maker < identified  # friction, and a margin for what is not known
    assert (tmp_path / "motion/motion.csv").is_file()


@pytest.mark.slow
def test_08_certificate_and_fleet(tmp_path, capsys):
    said = run_here(EXAMPLES / "08_certificate_and_fleet.py", tmp_path, capsys=capsys)
    assert said.count(": waits, ") == 2 and said.count("done, pass") == 2
    assert all((tmp_path / f"cell{k}/certificate.html").is_file() for k in (1, 2))


@pytest.mark.slow
def test_09_study_on_planted_arms(tmp_path, capsys):
    """On each arm both robust losses come nearer to the hidden truth than none."""
    said = run_here(EXAMPLES / "09_study_on_planted_arms.py", tmp_path, capsys=capsys)
    errors = {loss: figures(rf"{loss} +([\d.]+)", said) for loss in ("none", "huber", "cauchy")}
    assert [len(values) for values in errors.values()] == [3, 3, 3]
    for plain, huber, cauchy in zip(*errors.values()):
        assert max(huber, cauchy) < plain
