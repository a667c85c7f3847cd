"""Every kind of result with every verb that takes a folder: it works, or the refusal says what to give instead."""

from pathlib import Path

import numpy as np
import planted
import planted_motion
import pytest

import calib
from calib import cli
from calib.data.poses.fit_options import FitOptions
from calib.result_kinds import KINDS, TAKES, kind_of
from calib.robot import description
from calib.robot.library import load

SIGMA = 2e-5  # of the instrument [m]
WAYPOINTS = "q1,q2,q3,q4,q5,q6\n0,-1.2,1.2,0,1,0\n1,-0.8,0.6,0.5,0.5,0.5\n"
LIMITS = "[acceleration]\nall = 5.0\n"

# The verbs that each kind of result is for; all others refuse it. A session without measurements has little to show.
WORKS = {
    "fit": {"view", "certificate", "export", "diff", "fleet", "deliver", "compensate", "select", "plan"},
    "frames": {"view", "certificate", "export", "diff", "fleet", "deliver", "compensate", "select", "plan"},
    "identification": {"view", "certificate", "export", "diff", "deliver", "identify", "select"},
    "excitation": {"view", "program", "recall"},
    "plan": {"view", "program"},
    "comparison": set(),
    "fleet": set(),
    "session": {"status", "next", "run"},
    "empty": set(),
}
WRONG_ROBOT = {("fit", "identify"), ("frames", "identify"), ("identification", "plan")}


def command(verb: str, folder: Path, files: Path, out: Path) -> list[str]:
    """Return the command line of a verb for a folder."""
    arguments: dict[str, list[str | Path]] = {
        "view": [folder, "--save", out / "a.rrd"],
        "certificate": [folder, "--no-plots"],
        "export": [folder, "--into", out / "robot"],
        "diff": [folder, folder, "--out", out / "comparison", "--no-plots"],
        "log": [folder, "--out", out / "log", "--no-plots"],
        "fleet": [folder, "--out", out / "fleet"],
        "status": [folder],
        "next": [folder, "--no-plots"],
        "run": [folder],
        "deliver": [folder, "--for", "ur"],
        "compensate": [folder, files / "waypoints.csv", "--out", out / "commands.csv"],
        "recall": [folder, files / "played.csv", "--out", out / "recalled.csv"],
        "program": [folder, "--for", "ur", "--out", out / "program.script"],
        "identify": [folder, files / "a.npz", "--out", out / "model", "--no-plots"],
        "select": [folder, "-m", "12", "--candidates", "40", "--out", out / "poses.csv", "--no-plots"],
        "plan": [
            folder,
            "--waypoints",
            files / "waypoints.csv",
            "--limits",
            files / "limits.toml",
            "--out",
            out / "plan",
        ],
    }
    return [verb, *(str(argument) for argument in arguments[verb])]


VERBS = (
    *("view", "certificate", "export", "diff", "log", "fleet", "status", "next", "run"),
    *("deliver", "compensate", "recall", "program", "identify", "select", "plan"),
)


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Path:
    """A folder with one small result of each kind, and files that the verbs take beside it."""
    root = tmp_path_factory.mktemp("results")
    (root / "waypoints.csv").write_text(WAYPOINTS)
    (root / "limits.toml").write_text(LIMITS)
    (root / "empty").mkdir()
    truth = planted.cell(planted.perturb(load("tx40"), 3), 1)
    poses = planted.measure(truth, "position", 60, 5, sigma=SIGMA)
    for name, model in (("fit", "geometry"), ("frames", "frames")):
        settings = calib.FitSettings(model=model, holdout=0.25)
        fit = calib.fit_geometry("tx40", poses, settings, options=FitOptions(check_limits=False))
        fit.save(root / name, plots=False)
    robot = description.write(root / "planted.toml", planted_motion.arm())
    log = planted_motion.write(root, "a.npz", 0)
    calib.identify_dynamics(robot, log).save(root / "identification", plots=False)
    search = calib.ExcitationSettings(period=4.0, starts=1, evaluations=20, outlook=False)
    motion = calib.design_excitation("tx40", search)
    motion.save(root / "excitation", plots=False)
    t, q, _, _ = motion.sampled(100.0)
    header = ",".join(["t", *(f"q{joint + 1}" for joint in range(6)), *(f"tau{joint + 1}" for joint in range(6))])
    # two periods: a recall averages them; the end of the first is the beginning of the second
    rows = np.column_stack([t, q, np.cos(q)])
    again = rows[1:].copy()
    again[:, 0] += t[-1]
    rows = np.vstack([rows, again])
    np.savetxt(root / "played.csv", rows, delimiter=",", header=header, comments="")
    plan = calib.plan_motion("tx40", np.loadtxt(root / "waypoints.csv", delimiter=",", skiprows=1))
    plan.save(root / "plan", plots=False)
    for line in (
        ["diff", root / "fit", root / "fit", "--out", root / "comparison", "--no-plots"],
        ["fleet", root / "fit", "--out", root / "fleet"],
        ["new", root / "session", "--robot", "tx40", "--instrument", "tracker"],
    ):
        assert cli.run([str(argument) for argument in line]) == 0
    return root


@pytest.mark.parametrize("kind", WORKS)
@pytest.mark.parametrize("verb", VERBS)
def test_a_verb_works_or_says_what_it_takes(kind, verb, results, tmp_path, capsys):
    folder = results / kind
    code = cli.run(command(verb, folder, results, tmp_path))
    printed = capsys.readouterr()
    if verb in WORKS[kind]:
        assert code in (0, 1), printed.err
        return
    assert code == 2
    message = printed.err + printed.out
    assert str(folder) in message.replace("\n", "") or (kind, verb) in WRONG_ROBOT
    recognised = kind_of(folder)
    if kind != "session" and verb != "run" and (kind, verb) not in WRONG_ROBOT | {("identification", "fleet")}:
        said = " ".join(message.split())
        assert (recognised.noun if recognised else "holds no result") in said


def test_each_kind_is_recognised(results):
    expected = {"frames": "fit", "empty": None}
    for name in WORKS:
        kind = kind_of(results / name)
        assert (kind.name if kind else None) == expected.get(name, name)


def test_advice_is_for_verbs_that_exist():
    for kind in KINDS:
        assert set(kind.advice) <= set(TAKES)
