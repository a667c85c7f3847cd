"""Every kind of result with every verb that takes one: it works, or the refusal says what to give instead."""

import csv
from pathlib import Path

import numpy as np
import planted
import planted_motion
import pytest

import calib
from calib import cli
from calib.api.rendering import Kept
from calib.apps.fleet.fleet_report import FleetReport
from calib.apps.monitoring.comparison.robot_change import RobotChange
from calib.apps.monitoring.drift_page import DriftFound, drift
from calib.apps.monitoring.log import LogLine, RobotLog
from calib.apps.studies.report import run_study
from calib.data.poses.fit_options import FitOptions
from calib.errors import CalibError
from calib.parallel.loop_fit import ParallelFit
from calib.parallel.mechanism.closure import closed
from calib.parallel.mechanism.geometric_fit import changed, loop_parameters
from calib.parallel.robots import find
from calib.procedure.findings import LEVELS
from calib.result_kinds import BY_NAME, KINDS, TAKES, kind_of
from calib.results.result import ExportSettings
from calib.results.result_classes import CLASSES, open_result
from calib.robot import description
from calib.robot.library import load

SIGMA = 2e-5  # of the instrument [m]
WAYPOINTS = "q1,q2,q3,q4,q5,q6\n0,-1.2,1.2,0,1,0\n1,-0.8,0.6,0.5,0.5,0.5\n"
LIMITS = "[acceleration]\nall = 5.0\n"
STUDY = """
name = "small"
robot = "rv2sq"
methods = ["ols"]
runs = 1
duration = 2.0
resimulated = 0
[[noise]]
name = "1"
sigma_q = "1e-4 deg"
sigma_tau = 0.05
"""

# The verbs that each kind of result is for; all others refuse it. A session without measurements has little to show.
ARM = {"deliver", "select", "plan", "fit", "drift"}
FITTED = {"view", "certificate", "export", "diff", "fleet", "compensate", *ARM}
WORKS = {
    "fit": FITTED,
    "frames": FITTED,
    "placement": FITTED,
    "identification": {"view", "certificate", "export", "diff", "deliver", "identify", "select"},
    "excitation": {"view", "program", "recall"},
    "plan": {"view", "program"},
    "selection/poses.csv": {"program"},
    "recall.npz": set(),
    "comparison": set(),
    "drift": set(),
    "log": set(),
    "fleet": set(),
    "old fleet": set(),
    "study": set(),
    "export": ARM,
    "package": set(),
    "session": {"status", "next", "run", "redo"},
    "parallel fit": {"view", "certificate", "export", "fit"},
    "parallel identification": {"view", "certificate", "export", "fit"},
    "parallel excitation": {"view", "recall", "fit"},
    "parallel plan": {"view", "fit"},
    "empty": set(),
}
NAMES = {
    "frames": "fit",
    "placement": "fit",
    "selection/poses.csv": "selection",
    "recall.npz": "recall",
    "old fleet": "fleet",
    "parallel fit": "fit",
    "parallel identification": "identification",
    "parallel excitation": "excitation",
    "parallel plan": "plan",
    "empty": None,
}
# A robot of other joints than the recording or the waypoints beside it: refused by the joints, not by the kind.
WRONG_ROBOT = {
    *((kind, "identify") for kind in ("fit", "frames", "placement", "export")),
    ("identification", "plan"),
    *(("identification", verb) for verb in ("fit", "drift")),
    *((kind, verb) for kind in WORKS if kind.startswith("parallel") for verb in ("plan", "identify", "program")),
}
VERBS = (
    *("view", "certificate", "export", "diff", "log", "fleet", "status", "next", "run", "redo", "drift"),
    *("deliver", "compensate", "recall", "program", "identify", "select", "plan", "fit"),
)
# Verbs that compute for long, with kinds of which they read the robot alone: quickly it is that of a fit.
LONG_VERBS = {"fit", "select", "plan"}
REPEATED_KINDS = {"frames", "placement", "export"}
SLOWLY = {(verb, kind) for verb in LONG_VERBS for kind in REPEATED_KINDS}


def kinds(*verbs: str) -> list:
    """Return the kinds, each with every verb; those of parallel robots, and `SLOWLY`, are slow."""
    cases = []
    for kind in WORKS:
        for verb in verbs or ("",):
            slow = kind.startswith("parallel") or (verb, kind) in SLOWLY
            values = (verb, kind) if verb else (kind,)
            cases.append(pytest.param(*values, marks=[pytest.mark.slow] * slow))
    return cases


def command(verb: str, folder: Path, files: Path, out: Path) -> list[str]:
    """Return the command line of a verb for a folder."""
    measured = files / ("parallel.csv" if "parallel" in folder.name else "measured.csv")
    waypoints = files / ("platform.csv" if "parallel" in folder.name else "waypoints.csv")
    # rows that are held out spare the cross-validation, and one model the ladder
    model = [] if "parallel" in folder.name else ["--model", "frames"]
    planned = [folder, "--waypoints", waypoints, "--limits", files / "limits.toml", "--out", out / "plan"]
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
        "redo": [folder, "fit"],
        "drift": [folder, files / "drift.csv"],
        "deliver": [folder, "--for", "ur"],
        "compensate": [folder, files / "waypoints.csv", "--out", out / "commands.csv"],
        "recall": [folder, files / ("parallel_log.csv" if "parallel" in folder.name else "played.csv")],
        "program": [folder, "--for", "ur", "--out", out / "program.script"],
        "identify": [folder, files / "a.npz", "--out", out / "model", "--no-plots"],
        "select": [folder, "-m", "12", "--candidates", "40", "--out", out / "poses.csv", "--no-plots"],
        "plan": planned,
        "fit": [folder, measured, "--holdout", "0.25", *model, "--out", out / "fit", "--no-plots"],
    }
    if verb == "recall":
        arguments[verb] += ["--out", out / "recalled.csv"]
    return [verb, *(str(argument) for argument in arguments[verb])]


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Path:
    """A folder with one small result of each kind, and files that the verbs take beside it."""
    root = tmp_path_factory.mktemp("results")
    (root / "waypoints.csv").write_text(WAYPOINTS)
    (root / "limits.toml").write_text(LIMITS)
    (root / "empty").mkdir()
    _write_arm_results(root)
    _write_reports(root)
    return root


@pytest.fixture(scope="module")
def parallel_results(results: Path) -> Path:
    """The same folder, with results of a parallel robot."""
    _write_parallel_results(results)
    return results


@pytest.fixture
def folder(kind: str, request: pytest.FixtureRequest) -> Path:
    """The result of a kind."""
    written = "parallel_results" if kind.startswith("parallel") else "results"
    return request.getfixturevalue(written) / kind


def _write_arm_results(root: Path) -> None:
    """Write fits, identification, motions, lists of poses and a session of serial arms."""
    # so near the nominal arm that no fit searches for wrong columns
    truth = planted.cell(planted.perturb(load("tx40"), 3, 5e-5, 1e-4), 1)
    poses = planted.measure(truth, "position", 60, 5, sigma=SIGMA)
    header = ",".join([*(f"q{joint + 1}" for joint in range(6)), "x", "y", "z"])
    table = np.hstack([poses.q, poses.position])
    np.savetxt(root / "measured.csv", table, delimiter=",", header=header, comments="")
    hours = np.arange(2.0 * len(table))[:, None]
    table = np.hstack([np.vstack([table, table]), hours])
    np.savetxt(root / "drift.csv", table, delimiter=",", header=f"{header},time [h]", comments="")
    for name, model in (("fit", "geometry"), ("frames", "frames")):
        settings = calib.FitSettings(model=model, holdout=0.25)
        fit = calib.fit_geometry("tx40", poses, settings, options=FitOptions(check_limits=False))
        fit.save(root / name, plots=False)
    calib.tool("tx40", poses, options=FitOptions(check_limits=False)).save(root / "placement", plots=False)

    robot = description.write(root / "planted.toml", planted_motion.arm())
    calib.identify_dynamics(robot, planted_motion.write(root, "a.npz", 0)).save(root / "identification", plots=False)

    search = calib.ExcitationSettings(period=4.0, harmonics=2, rate=250.0, starts=1, evaluations=3, outlook=False)
    motion = calib.design_excitation("tx40", search)
    motion.save(root / "excitation", plots=False)
    t, q, _, _ = motion.sampled(100.0)
    _write_played(root / "played.csv", t, q)
    plan = calib.plan_motion("tx40", np.loadtxt(root / "waypoints.csv", delimiter=",", skiprows=1))
    plan.save(root / "plan", plots=False)

    (root / "selection").mkdir()
    selection = calib.select_poses("tx40", 12, calib.SelectionSettings(candidates=40))
    selection.save(root / "selection/poses.csv", plots=False)
    _run("recall", root / "excitation", root / "played.csv", "--out", root / "recall.npz")
    _run("new", root / "session", "--robot", "tx40", "--instrument", "tracker")


def _write_played(path: Path, t: np.ndarray, q: np.ndarray) -> None:
    """Write two periods of a motion as a log: a recall averages them; the end of the first begins the second."""
    n = q.shape[1]
    header = ",".join(["t", *(f"q{joint + 1}" for joint in range(n)), *(f"tau{joint + 1}" for joint in range(n))])
    rows = np.column_stack([t, q, np.cos(q)])
    again = rows[1:].copy()
    again[:, 0] += t[-1]
    np.savetxt(path, np.vstack([rows, again]), delimiter=",", header=header, comments="")


def _write_parallel_results(root: Path) -> None:
    """Write a fit, an identification and motions of a five-bar linkage."""
    robot, rng = find("fivebar"), np.random.default_rng(0)
    assert robot is not None
    parameters = loop_parameters(robot.mechanism)
    true = closed(changed(robot.chain, parameters, 1e-3 * rng.normal(size=len(parameters))))
    x = 0.8 * rng.uniform(robot.chain.lower, robot.chain.upper, (20, 2))
    q = true.place(x).q[:, robot.chain.actuated] + 1e-5 * rng.normal(size=(20, 2))
    with (root / "parallel.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["motor_left", "motor_right", "x [mm]", "y [mm]"], *np.hstack([q, 1e3 * x])])
    calib.fit_geometry("fivebar", root / "parallel.csv", calib.FitSettings(holdout=0.25)).save(
        root / "parallel fit", plots=False
    )
    search = calib.ExcitationSettings(period=4.0, harmonics=2, rate=250.0, starts=1, evaluations=3, outlook=False)
    motion = calib.design_excitation("fivebar", search)
    motion.save(root / "parallel excitation", plots=False)
    t, q, _, _ = motion.sampled(100.0)
    _write_played(root / "parallel_log.csv", t, q)
    model = calib.identify_dynamics("fivebar", root / "parallel excitation/motion.csv")
    model.save(root / "parallel identification", plots=False)
    corners = 0.5 * np.stack([robot.chain.lower, robot.chain.upper])
    np.savetxt(root / "platform.csv", corners, delimiter=",", header="x,y", comments="")
    calib.plan_motion("fivebar", root / "platform.csv").save(root / "parallel plan", plots=False)


def _write_reports(root: Path) -> None:
    """Write what is made of other results: comparison, drift, log, fleet, study, exports."""
    _run("diff", root / "fit", root / "fit", "--out", root / "comparison", "--no-plots")
    drift("tx40", [root / "drift.csv"], options=FitOptions(check_limits=False)).save(root / "drift", plots=False)
    line = LogLine("cell", "2026-01-15", "A7", "pass", (0.5, 0.03), None, None)
    RobotLog("tx40", (line,)).save(root / "log", plots=False)
    for name in ("fleet", "old fleet"):
        _run("fleet", root / "fit", "--out", root / name)
    # As versions before this one wrote it.
    (root / "old fleet/fleet.csv").unlink()
    (root / "small.toml").write_text(STUDY)
    run_study([root / "small.toml"], root / "study", plots=False)
    calib.export(root / "fit", root / "export")
    calib.export(root / "fit", root, ros2="six_description")
    (root / "six_description").rename(root / "package")


def _run(*arguments: object) -> None:
    assert cli.run([str(argument) for argument in arguments]) == 0


@pytest.mark.parametrize(("verb", "kind"), kinds(*VERBS))
def test_a_verb_works_or_says_what_it_takes(verb, kind, folder, results, tmp_path, capsys):
    code = cli.run(command(verb, folder, results, tmp_path))
    printed = capsys.readouterr()
    if verb in WORKS[kind]:
        assert code in (0, 1), printed.err
        return
    assert code == 2, printed.out + printed.err
    message = printed.err + printed.out
    assert str(folder) in message.replace("\n", "") or (kind, verb) in WRONG_ROBOT
    recognised = kind_of(folder)
    names_contents = verb == "fleet" and kind.endswith("identification")
    if kind == "session" or verb == "run" or names_contents or (kind, verb) in WRONG_ROBOT:
        return
    said = " ".join(message.split())
    if folder.is_file():
        assert "give" in said
        return
    nouns = [recognised.noun if recognised else "contains no result", "parallel robot"]
    assert any(noun in said for noun in nouns[: 1 + kind.startswith("parallel")])


@pytest.mark.parametrize("kind", [case for case in kinds() if case.values != ("empty",)])
def test_a_stored_result_keeps_the_protocol(kind, folder, tmp_path):
    stored = open_result(folder)
    assert isinstance(stored, calib.Result)
    assert stored.kind.name == NAMES.get(kind, kind)
    assert stored.verdict.level in LEVELS and stored.verdict.reason
    assert all(len(table.header) for table in stored.tables().values())
    assert stored.figures() == {}
    copy = open_result(stored.save(tmp_path / Path(kind).name))
    assert copy.kind is stored.kind and copy.tables().keys() == stored.tables().keys()
    asked = {"view": stored.scene, "export": lambda: stored.export(tmp_path / "robot", ExportSettings())}
    for verb, ask in asked.items():
        if verb in WORKS[kind]:
            assert ask()
        elif kind != "session":
            with pytest.raises(CalibError):
                ask()


@pytest.mark.parametrize("kind", ["fit", "identification"])
def test_delivery_states_verdict_of_result(kind, results, capsys):
    """A delivery states the result's verdict."""
    assert cli.run(["deliver", str(results / kind), "--for", "ur"]) in (0, 1)
    assert f"verdict {open_result(results / kind).verdict.level}: " in capsys.readouterr().out


@pytest.mark.parametrize("kind", kinds())
def test_each_kind_is_recognised(kind, folder):
    recognised = kind_of(folder)
    assert (recognised.name if recognised else None) == NAMES.get(kind, kind)


def test_classes_are_of_kinds_that_exist():
    assert set(CLASSES) <= {kind.name for kind in KINDS}


@pytest.mark.parametrize(
    "made",
    [
        *(calib.GeometryFit, calib.DynamicsModel, calib.ExcitationDesign, calib.MotionPlan, calib.PoseSelection),
        *(ParallelFit, RobotChange, DriftFound, RobotLog, FleetReport),
    ],
)
def test_result_in_memory_keeps_protocol(made):
    """A result in memory keeps the protocol."""
    members = ("kind", "verdict", "save", "figures", "tables", "scene")
    assert issubclass(made, Kept) and made.kind in KINDS
    fields = getattr(made, "__dataclass_fields__", {})
    assert [name for name in members if not hasattr(made, name) and name not in fields] == []


def test_result_in_memory_equals_folder(results):
    """A result in memory has what its folder has."""
    plan = calib.plan_motion("tx40", np.loadtxt(results / "waypoints.csv", delimiter=",", skiprows=1))
    stored = open_result(results / "plan")
    assert isinstance(plan, calib.Result) and plan.kind is stored.kind is BY_NAME["plan"]
    assert plan.tables()["motion"].header == stored.tables()["motion"].header
    assert len(plan.scene().played[0].t) == len(stored.scene().played[0].t)
    assert plan.verdict == stored.verdict and plan.figures()
    with pytest.raises(
        CalibError, match=r"^<MotionPlan for tx40.*> is a motion of calib plan; give the folder of a fit"
    ):
        calib.export(plan, results / "none")


def test_advice_is_for_verbs_that_exist():
    for kind in KINDS:
        assert set(kind.advice) <= set(TAKES)
