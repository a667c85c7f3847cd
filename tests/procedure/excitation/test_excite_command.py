"""What `calib excite` promises: a verified motion in files other programs read, and a clear refusal of bad input."""

import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from differences import check
from planned import CHAIN, base_of_lwr, identified, read_setpoints, write_model

from calib.data.recordings.recording_files import read_recording
from calib.errors import UsageError
from calib.folders import write_covariance
from calib.identification.identify_options import parse_options
from calib.procedure.excitation import coefficients, design
from calib.procedure.excitation import folder as motion_folder
from calib.procedure.excitation.excited_model import read_model
from calib.procedure.excitation.inputs import identifiable, read_inputs
from calib.procedure.excitation.limits import Points, read_motion_limits
from calib.procedure.excitation.planning import plan
from calib.procedure.excitation.prediction import foretell
from calib.procedure.excitation.prior_motions import read_prior
from calib.procedure.excitation.settings import ExcitationSettings
from calib.robot.calibrated import CalibratedChain
from calib.robot.kinematics import forward
from calib.robot.library import load
from calib.trajectories.basis import SampledMotion
from calib.trajectories.design.objectives import condition_numbers
from calib.trajectories.design.search import StartSearch
from calib.trajectories.design.verify import dense_motion
from calib.trajectories.errors import NothingFeasible
from calib.trajectories.fourier import evaluate

LIMITS = """
[target]
height = -0.2
axis_distance = 0.3
[velocity]
share = 0.9
[acceleration]
all = 12.0
[friction]
Fv = [14.4, 15.3, 6.55, 11.0, 4.29, 2.26, 1.6]
Fc = [11.9, 11.5, 8.98, 8.35, 8.31, 4.72, 6.04]
"""
QUICK = ("--starts", 1, "--evaluations", 60, "--period", 16, "--harmonics", 4, "--rate", 100, "--no-outlook")
SHORT = ExcitationSettings(starts=1, evaluations=45, period=16.0, harmonics=4, rate=100.0, samples=120)


@pytest.mark.slow
def test_motion_is_written_within_its_limits(cell, calib):
    """The motion keeps its limits, and is written for a controller."""
    Path("limits.toml").write_text(LIMITS)
    stands = "-0.8,-1.0,-1.0,-1.2,0.2,-1.5,0.3"
    played = ("--start", stands, "--repeat", 2, "--slower", 3, "--plots", "png")
    code, out, err = calib("excite", "lwr4plus", "--limits", "limits.toml", "--out", "e", *QUICK, *played)
    assert code == 0, err
    assert "self-collision (capsules" in out and "NOT checked: walls of the cell (not known), obstacles" in out
    assert "69 columns" in out and "all limits are respected" in out and "the approach and 2 periods" in out
    metrics = json.loads(Path("e/metrics.json").read_text())
    assert {"condition_number", "objective", "feasible", "margins", "seconds", "evaluations", "history"} <= set(metrics)
    assert metrics["feasible"] is True and metrics["condition_number"]["normalised"] < 12
    assert set(metrics["margins"]) == {"position", "velocity", "acceleration", "torque", "workspace", "clearance"}
    assert all(one["margin"] >= 0 for one in metrics["margins"].values())
    for name in ("plot_motion.png", "plot_path.png", "plot_history.png"):
        assert (Path("e") / name).stat().st_size > 5000
    t, q, v, a = read_setpoints(Path("e/trajectory.csv")).values()
    assert q.shape == (1601, 7) and np.allclose(np.diff(t), 0.01)
    chain = CHAIN
    assert (q < chain.upper).all() and (q > chain.lower).all() and (np.abs(a) < 12).all()
    assert (np.abs(v) <= 0.9 * np.array([joint.velocity for joint in chain.joints])).all()
    tool = forward(chain, q)[:, :3, 3]
    assert np.hypot(tool[:, 0], tool[:, 1]).min() >= 0.3 and tool[:, 2].min() >= -0.2
    assert np.abs(v[[0, -1]]).max() < 1e-9 and np.abs(a[[0, -1]]).max() < 1e-9
    assert np.allclose((q[2:] - q[:-2]) / 0.02, v[1:-1], atol=0.01)
    table = tomllib.loads(Path("e/trajectory.toml").read_text())
    series = [np.concatenate([[joint["q0"]], joint["a"], joint["b"]]) for joint in table["joint"]]
    assert np.allclose(evaluate(series, table["period"], t), q, atol=1e-9)
    check_playback(q, np.array(stands.split(","), dtype=float), metrics["playback"])


def check_playback(q: np.ndarray, stands: np.ndarray, metrics: dict) -> None:
    """The run is the approach and two periods without a jump; messages say the same; the rehearsal is slower."""
    run, lead, slow = (read_setpoints(Path(f"e/{name}.csv")) for name in ("run", "approach", "rehearsal"))
    assert np.allclose(run["q"][0], stands) and np.abs(run["v"][[0, -1]]).max() < 1e-9
    assert len(run["q"]) == len(lead["q"]) + 2 * 1600 and metrics["seconds"] == pytest.approx((len(run["q"]) - 1) / 100)
    assert np.allclose(run["q"][len(lead["q"]) - 1 :][:1601], q) and np.allclose(run["q"][-1601:], q)
    assert np.abs(np.diff(run["q"], axis=0) * 100 - (run["v"][1:] + run["v"][:-1]) / 2).max() < 0.01
    once = len(lead["q"]) + 1600
    assert len(slow["q"]) == 3 * (once - 1) + 1 and np.allclose(slow["q"][::3], run["q"][:once], atol=1e-9)
    assert (np.abs(run["tau"]) <= [joint.effort for joint in CHAIN.joints]).all()
    message = json.loads(Path("e/trajectory.json").read_text())
    points = np.array([point["positions"] for point in message["points"]])
    assert np.allclose(points, run["q"], atol=1e-8) and message["joint_names"] == list(CHAIN.joint_names)


@pytest.fixture(scope="module")
def designed() -> design.Designed:
    """Return a quick excitation, two periods of it."""
    return design.excite("lwr4plus", replace(SHORT, repeat=2, outlook=False))


@pytest.fixture(scope="module")
def earlier(designed, tmp_path_factory) -> Path:
    """Return its folder."""
    return motion_folder.write_design(designed, tmp_path_factory.mktemp("excited") / "e")


@pytest.mark.slow
def test_motions_before_count(earlier, tmp_path):
    """Designed with what is known, the two motions together tell more than twice the first one would."""
    before = coefficients.read(earlier)
    known = json.loads((earlier / "metrics.json").read_text())["condition_number"]
    second = design.excite("lwr4plus", replace(SHORT, existing=(str(earlier),), outlook=False))
    assert second.condition.raw_before == pytest.approx(known["raw"], rel=0.02)
    assert second.condition.raw < second.condition.raw_before
    # the same from the matrices themselves
    sharp, period = second.inputs.model.exact.regressor, second.period
    times = np.arange(1000) * (period / 1000)
    one = np.sqrt(2) * sharp(*before.orders(times))
    motion = dense_motion(second.family, second.found.x, times)
    both = np.concatenate([one, sharp(motion.q, motion.v, motion.a)])
    assert condition_numbers(both)["raw"] == pytest.approx(second.condition.raw, rel=0.02)
    # a recording of the first motion counts as the motion itself, less what the filters' borders eat
    q = np.tile(before.orders(np.arange(1600) / 100)[0], (2, 1))
    np.savez(tmp_path / "log.npz", t=np.arange(len(q)) / 100, q=q, tau=q)
    found = read_prior([str(tmp_path / "log.npz")], second.inputs.model, second.inputs.chain)
    assert found is not None
    ratio = np.diag(found.information) / np.diag(second.inputs.prior.information)
    assert 0.9 < np.median(ratio) < 1.02


@pytest.mark.slow
def test_validation_motion_stays_in_earlier(earlier):
    """And is another motion: joint by joint its positions are not those of the first."""
    few = replace(SHORT, period=12.0, evaluations=10, within=str(earlier), seed=5, outlook=False)
    found = design.excite("lwr4plus", few)
    first = coefficients.read(earlier)
    known = first.orders(np.linspace(0.0, first.period, 1000))
    motion = dense_motion(found.family, found.found.x, np.linspace(0.0, found.period, 1000))
    for own, whole in zip((motion.q, motion.v, motion.a), known):
        assert (own.max(axis=0) <= whole.max(axis=0) + 1e-6).all() and (
            own.min(axis=0) >= whole.min(axis=0) - 1e-6
        ).all()
    assert max(abs(np.corrcoef(a, b)[0, 1]) for a, b in zip(known[0].T, motion.q.T)) < 0.9


def test_tilted_arm_excites_nominal_columns():
    """Its tilted axes raise the exact rank by columns that no motion tells from others."""
    nominal = load("tx40")
    values = nominal.values + 5e-4 * np.random.default_rng(0).standard_normal(len(nominal.values))
    moved = CalibratedChain(nominal.with_values(values), nominal=nominal)
    names = [read_inputs(arm, SHORT).columns.names for arm in (CalibratedChain(nominal), moved)]
    assert [name.removesuffix("R") for name in names[1]] == [name.removesuffix("R") for name in names[0]]
    assert len(read_inputs(replace(moved, nominal=None), SHORT).columns.names) > len(names[0])


@pytest.mark.slow
def test_held_joint_stays_and_is_said(cell, calib):
    """A held joint stays, and its columns are said."""
    code, out, err = calib("excite", "lwr4plus", "--lock", "joint4=0.5", "--out", "e", *QUICK)
    assert code == 0, err
    metrics = json.loads(Path("e/metrics.json").read_text())
    told = metrics["setting"]["columns"]
    assert metrics["setting"]["held"] == {"joint4": 0.5} and "locked: joint4" in out
    assert len(told) < 64 and f"condition number of {len(told)} columns" in out
    assert not {"Fv4", "Fc4", "off4"} & set(told) and {"Fv3", "Fc5"} < set(told)
    assert metrics["condition_number"]["normalised"] < 100
    rows = read_setpoints(Path("e/trajectory.csv"))
    assert (rows["q"][:, 3] == 0.5).all() and (rows["v"][:, 3] == 0.0).all()


def test_held_joint_columns_have_full_rank():
    """The columns told with a joint held are all there are."""
    chain = CHAIN
    dynamics = read_model(chain, None, "Fv Fc off", read_motion_limits(None, chain))
    rng = np.random.default_rng(3)
    q, v, a = rng.uniform(-2, 2, (3, 400, 7))
    q[:, 3], v[:, 3], a[:, 3] = 0.5, 0.0, 0.0
    W = np.delete(dynamics.exact.regressor(q, v, a), 3, axis=1).reshape(-1, 64)
    held = identifiable(dynamics, chain, {3: 0.5})
    scaled = W / np.maximum(np.linalg.norm(W, axis=0), 1e-12)
    assert len(held.names) == np.linalg.matrix_rank(scaled, 1e-4)
    assert np.linalg.cond(scaled[:, held.columns]) < 200


@pytest.mark.slow
def test_motion_in_a_log_is_read_by_identify(earlier, tmp_path, cell, calib):
    """A motion is recalled from a log, and read by identify."""
    reference = coefficients.read(earlier)
    times, sigma = np.arange(4 * 1600) / 100, 0.02
    q, rng = reference.orders(times)[0], np.random.default_rng(0)
    log = np.concatenate([np.tile(q[0], (137, 1)), q, np.tile(q[0], (80, 1))])
    tau = np.cos(log) + sigma * rng.normal(size=log.shape)
    np.savez(tmp_path / "log.npz", t=np.arange(len(log)) / 100 + 5.0, q=log, tau=tau)
    code, out, err = calib("recall", earlier, tmp_path / "log.npz", "--out", tmp_path / "a.npz", "--skip", 1)
    assert code == 0, err
    assert "3 whole periods" in out and "from 17.370 s" in out
    found = np.load(tmp_path / "a.npz")
    assert np.allclose(found["q"], q[:1600], atol=1e-6)
    assert np.sqrt(found["variance_tau"].mean()) == pytest.approx(sigma, rel=0.05)
    assert (found["tau"] - np.cos(q[:1600])).std() == pytest.approx(sigma / np.sqrt(3), rel=0.05)
    averaged = read_recording(tmp_path / "a.npz")
    assert len(averaged) == 1600 and averaged.effort_variance == pytest.approx(sigma**2 / 3, rel=0.1)
    assert calib("recall", earlier, tmp_path / "log.npz", "--out", tmp_path / "a.csv")[0] == 0
    table = read_recording(tmp_path / "a.csv")
    assert np.allclose(table.q, q[:1600], atol=1e-6) and table.kind == "torque"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("no/where", "log.npz"), "does not exist; give the folder of calib excite"),
        (("{earlier}", "other.npz"), "is not in the recording"),
        (("{earlier}", "none.npz"), "cannot be read"),
        (("{earlier}", "other.npz", "--skip", "-1"), "--skip -1"),
        (("{earlier}", "other.npz", "--out", "a.txt"), "suffix .npz or .csv"),
    ],
)
def test_bad_recalls(earlier, cell, calib, options, words):
    times = np.arange(4000)[:, None] / 100
    np.savez("other.npz", t=times[:, 0], q=np.sin(times * np.arange(1, 8)), tau=np.cos(times * np.arange(1, 8)))
    given = [word.replace("{earlier}", str(earlier)) for word in options]
    code, _, err = calib("recall", *given, *(() if "--out" in given else ("--out", "a.npz")))
    assert (code, words in err) == (2, True), err


def test_recall_never_writes_onto_its_log(earlier, cell, calib):
    np.savez("log.npz", t=np.arange(10.0))
    kept = Path("log.npz").read_bytes()
    for log in ("log.npz", "log.npz@0:9"):
        code, _, err = calib("recall", earlier, log, "--out", "./log.npz")
        assert (code, "is an input" in err) == (2, True), err
    assert Path("log.npz").read_bytes() == kept


@pytest.mark.slow
def test_a_motion_folder_is_written_whole(designed, tmp_path):
    """A disk that fills in the middle leaves what was there: nothing, or the motion of before."""

    def full(designed: design.Designed, folder: Path) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(UsageError, match="No space left on device; nothing was changed"):
        motion_folder.write_design(designed, tmp_path / "e", full)
    assert list(tmp_path.iterdir()) == []
    motion_folder.write_design(designed, tmp_path / "e")
    before = {path.name: path.read_bytes() for path in (tmp_path / "e").iterdir()}
    with pytest.raises(UsageError, match="No space left on device; nothing was changed"):
        motion_folder.write_design(replace(designed, condition={"raw": 1.0}), tmp_path / "e", full)
    assert {path.name: path.read_bytes() for path in (tmp_path / "e").iterdir()} == before


def test_ctrl_c_keeps_the_best_motion_so_far(cell, calib, monkeypatch):
    """An interrupt in the middle of the search: the folder is written, verified, and says so."""
    remember = StartSearch.remember

    def interrupting(run, y, found):
        remember(run, y, found)
        if run.kept == 5:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(StartSearch, "remember", interrupting)
    code, out, err = calib("excite", "lwr4plus", "--out", "e", "--goal", "wrist=0.1", *QUICK)
    assert code == 0 and "interrupted: this is the best" in out, err
    assert "note: interrupted before any motion met the goals" in out
    metrics = json.loads(Path("e/metrics.json").read_text())
    assert metrics["setting"]["interrupted"] and metrics["feasible"] and metrics["evaluations"] < 60
    assert metrics["history"][-1] < metrics["history"][0]


@pytest.mark.slow
def test_aim_replaces_condition_numbers(designed):
    """An aim takes the place of condition numbers."""
    told = design.excite("lwr4plus", replace(SHORT, goals=("logdet",), outlook=False))
    assert told.condition.raw > designed.condition.raw and told.found.merit < 0.0


@pytest.mark.slow
def test_a_shorter_period():
    short = design.excite("lwr4plus", replace(SHORT, goals=("duration=12",), shortest=10.0, outlook=False))
    samples = short.period * SHORT.rate
    assert 10.0 <= short.period < 16.0 and samples == pytest.approx(round(samples)) and short.proof.feasible


@pytest.mark.slow
@pytest.mark.parametrize("whom", ["the terminal's group", "the command alone"])
def test_ctrl_c_in_worker_processes(tmp_path, whom):
    # short searches, so many that they do not end
    short = ["--starts", "2000", *map(str, QUICK[2:]), "--no-plots"]
    words = ["excite", "tx40", "--out", str(tmp_path / "e"), *short, "--workers", "2"]
    for patience in (4, 10, 25, 60):  # [s] until the workers of a busy machine have found something
        run = subprocess.Popen(
            [sys.executable, "-m", "calib", *words], stdout=subprocess.PIPE, text=True, start_new_session=True
        )
        try:
            time.sleep(patience)
            (os.killpg if "group" in whom else os.kill)(run.pid, signal.SIGINT)
            out, _ = run.communicate(timeout=45)
        except subprocess.TimeoutExpired:
            # before the search, a library that is loaded may lose Ctrl-C in a callback of its own: too early, too
            continue
        finally:
            if run.poll() is None:
                os.killpg(run.pid, signal.SIGKILL)
                run.wait()
        if run.returncode != 130:
            break
    assert run.returncode == 0 and "interrupted: this is the best" in out
    assert json.loads((tmp_path / "e/metrics.json").read_text())["feasible"]


@pytest.mark.parametrize(
    ("extra", "options", "words"),
    [
        ("[joints]\nq1 = [1.0, 0.5]", (), "not below"),
        ("[velocity]\nq3 = 0.0", (), "velocity limit of joint 3 is 0"),
        ("[velocity]\nq9 = 1.0", (), "there is no key 'q9'"),
        ('[frequency]\nresonance = "0.2 Hz"', (), "not below the resonance"),
        pytest.param("[target]\nheight = 1.5", (), "breaks the workspace limit", marks=pytest.mark.slow),
        ("[torque]\nmargin = 1.5", (), "torque.margin: expected a share"),
        ("[joints]\nq2 = [-1.0, 1.0]", ("--start", "0,1.2,0,0,0,0,0"), "joint2 at 1.2 is beyond its limits -1 to 1"),
        ("", ("--start", "0,nan,0,0,0,0,0"), "start: cannot read 'nan' as a number"),
        ("", ("--start", "0,0"), "expected 7 joint values, found 2"),
        ("", ("--repeat", "0"), "repeat: expected"),
        ("", ("--slower", "0.5"), "slower: expected"),
        ("", ("--lock", "joint9"), "'joint9' is not a joint"),
        ("", ("--lock", "joint4=9"), "joint4 at 9 is beyond its limits"),
        ("", ("--lock", "joint4=x"), "'x' is not a number"),
        ("", ("--lock", "q1,q2,q3,q4,q5,q6,q7"), "all joints are locked"),
        ("", ("--existing", "nowhere.npz"), "cannot be read"),
        ('[frequency]\nresonance = "0.25 Hz"', (), "take fewer harmonics or a period above 16 s"),
        ("[target]\nreach = nan", (), "target.reach: expected a number above 0, found nan"),
        ("", ("--goal", "wrist=2"), "above 0 and below 1"),
        ("", ("--goal", "elbow=0.1"), "unknown; use raw"),
        ("", ("--goal", "wrist"), "expected NAME=NUMBER"),
        ("", ("--goal", "logdet", "--goal", "raw=30"), "'logdet' replaces the others"),
        ("", ("--hard", "logdet"), "expected NAME=NUMBER"),
        ("", ("--goal", "duration=8"), "needs --shortest"),
        ("", ("--shortest", "99"), "at most the period"),
        ("", ("--period", "16.003"), "take 16 s"),
        ("", ("--period", "nan"), "period: expected"),
        ("", ("--family", "steps"), "family: expected one of fourier"),
        ("", ("--model", "nowhere"), "folder of an identification"),
    ],
)
def test_bad_input_exits_with_code_2(cell, calib, extra, options, words):
    """Bad input is refused with exit code 2."""
    Path("limits.toml").write_text(extra)
    quick = (*QUICK[:2], "--evaluations", 12, *QUICK[4:])
    code, _, err = calib("excite", "lwr4plus", "--limits", "limits.toml", "--out", "e", *quick, *options)
    assert (code, words in err) == (2, True), err
    assert not Path("e").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("extra", "changed", "words"),
    [
        ("[torque]\nall = 34.0", {"lock": ("joint2=1.57",)}, r"breaks the torque limit .*that of \[torque\]"),
        ("", {"hard": ("wrist=0.9",)}, "hard goal wrist=0.9 was not reached"),
    ],
)
def test_failed_search_names_the_obstacle(tmp_path, extra, changed, words):
    """The command says the same: see the workspace limit above."""
    limits, few = tmp_path / "limits.toml", replace(SHORT, evaluations=12, samples=40, **changed)
    limits.write_text(extra)
    with pytest.raises(NothingFeasible, match=words):
        design.excite("lwr4plus", few, limits=limits)


def test_identified_model_predicts_sigmas(tmp_path):
    """An identified model predicts torques with their uncertainty."""
    write_model(tmp_path / "m")
    names, known = base_of_lwr().names, identified()
    write_covariance(tmp_path / "m" / "covariance.csv", names, 0.01 * np.eye(len(names)))
    dynamics = read_model(CHAIN, tmp_path / "m", "", read_motion_limits(None, CHAIN))
    assert dynamics.values is not None and dynamics.covariance is not None and dynamics.friction
    assert len(dynamics.values) == len(dynamics.exact.names) == 62  # 43 + 21, less Ia1 and Ia2
    assert np.allclose(dynamics.covariance, 0.01 * np.eye(62))
    q, v, a = np.random.default_rng(0).normal(size=(3, 5, 7))
    assert np.allclose(dynamics.exact.regressor(q, v, a) @ dynamics.values, known.model.torque(known.values, q, v, a))


def test_nan_in_the_model_is_named(cell, calib):
    write_model(Path("m"), Fv3=np.nan)
    code, _, err = calib("excite", "lwr4plus", "--model", "m", "--out", "e", *QUICK)
    assert code == 2 and "parameter Fv3 of the model is not finite" in err


def test_named_points_move_with_their_links():
    chain = CHAIN
    points = Points(chain, (0, 4), np.array([[0.0, 0.0, 0.0], [0.05, 0.1, -0.1]]))
    q = np.random.default_rng(0).normal(size=(1, 7))
    G = np.random.default_rng(1).normal(size=(1, 2, 3))
    check(lambda x: (G * points(x[None])).sum(), points.product(q, G)[0], q[0])
    assert np.allclose(points(q)[:, 0], forward(chain, q)[:, :3, 3])


def test_collision_distances_have_a_slope(tmp_path):
    """Collision distances are kept with a slope."""
    (tmp_path / "l.toml").write_text("[collision]\nradius = 0.05\nfloor = -0.3\n")
    chain = CHAIN
    limits = read_motion_limits(tmp_path / "l.toml", chain)
    (clearance,) = (one for one in limits.constraints if one.name == "clearance")
    q = 0.5 * np.random.default_rng(3).normal(size=(1, 7))
    weights = np.ones((1, len(clearance.labels)))

    def total(x):
        still = np.zeros((1, 7))
        return clearance.values(SampledMotion(np.zeros(1), x[None], still, still, still)).sum()

    motion = SampledMotion(np.zeros(1), q, 0 * q, 0 * q, 0 * q)
    check(total, clearance.slopes(motion, weights)[0, 0], q[0], tolerance=1e-4)


PAYLOAD = {"rows": "both", "payload": {"load": {"mass": 3.28, "com": [0.0, 0.0, 0.05]}}}


@pytest.mark.slow
def test_design_is_for_the_model_to_identify():
    """Both torque rows, runs without and with the payload: 102 columns, and both loads keep the torque limits."""
    options = parse_options(PAYLOAD).settings
    goals = ("raw=300", "joint6=0.02")
    found = design.excite("lwr4plus", replace(SHORT, goals=goals, samples=60, outlook=False), options=options)
    exact, tau = found.inputs.model.exact, found.playback.run.tau
    assert len(exact.names) == 102 and exact.loads == ((), ("load",)) and found.condition.raw < 300
    assert [name for name, *_ in found.goals] == ["raw", "joint6"]
    margin = found.proof.worst["torque"]
    assert margin.margin > 0 and (np.abs(tau) < found.inputs.limits.torque).all()
    few = read_inputs("lwr4plus", replace(SHORT, columns=("ZZ1R", "Fvm1,Ia1")), options=options)
    assert few.columns.aimed_names == ("ZZ1R", "Ia1", "Fvm1") and len(few.columns.names) == 102
    other = parse_options({"rows": "power", "payload": {"load": {}}}).settings
    notes = " ".join(read_inputs("lwr4plus", SHORT, options=other).model.notes)
    assert "rows = 'power'" in notes and "NOT checked: torques with payload 'load'" in notes


@pytest.mark.parametrize(
    "solver",
    [
        pytest.param("mma", marks=pytest.mark.slow),
        pytest.param("ccsaq", marks=pytest.mark.slow),
        pytest.param("auglag", marks=pytest.mark.slow),
    ],
)
def test_other_solvers_keep_the_limits_too(solver):
    """Other solvers end within the limits, too."""
    found = design.excite("ur10e", replace(SHORT, solver=solver, evaluations=10, samples=60, outlook=False))
    assert found.proof.feasible and np.isfinite(found.condition.raw)


@pytest.mark.slow
def test_stated_noise_weighs_rows():
    """The default share of the torque limits, stated by joint, predicts the same; --noise beside it is refused."""
    limits = read_inputs("lwr4plus", SHORT).limits.torque
    noise = {f"q{j + 1}": 0.01 * x for j, x in enumerate(limits)}
    given = read_inputs("lwr4plus", SHORT, limits={"noise": noise})
    assert np.allclose(given.columns.sigmas, 0.01 * limits)
    few = replace(SHORT, evaluations=10, outlook=False)
    found = design.excite("lwr4plus", few, limits={"noise": noise})
    share = found.outlook.own.torque_sigma_share
    same = foretell(read_inputs("lwr4plus", few), few, found.problem, found.found, lambda period: found.problem)[0]
    assert share == pytest.approx(same.own.torque_sigma_share) and found.outlook.noise_share == pytest.approx(0.01)
    with pytest.raises(UsageError, match="leave --noise out"):
        read_inputs("lwr4plus", replace(SHORT, noise=0.02), limits={"noise": {"all": 1.0}})


@pytest.mark.slow
def test_designs_lower_the_predicted_sigma():
    """Of torques on the typical task, and of the parameters relative to their values."""
    found = {goal: design.excite("lwr4plus", replace(SHORT, goals=goal)) for goal in ((), ("torque",), ("parameters",))}
    torque = {goal: one.outlook.own.torque_sigma_share for goal, one in found.items()}
    rsd = {goal: np.mean([row.rsd**2 for row in one.predicted if row.rsd]) for goal, one in found.items()}
    assert torque["torque",] < torque[()] and rsd["parameters",] < rsd[()]
    with pytest.raises(UsageError, match="needs masses, or a model"):
        design.excite("ur10e", replace(SHORT, goals=("parameters",)))


def test_identification_of_other_arm_fails(tmp_path):
    """Of as many joints, for motions to excite and to plan alike; no search begins."""
    write_model(tmp_path)
    way = np.linspace(np.zeros(7), np.full(7, 0.1), 2)
    for use in (
        lambda: read_inputs("panda", SHORT, model=tmp_path),
        lambda: read_inputs("panda", SHORT, after=tmp_path),
        lambda: plan("panda", way, model=tmp_path, limits={"acceleration": {"all": 5.0}}),
    ):
        with pytest.raises(UsageError, match="is of another robot"):
            use()


@pytest.mark.slow
def test_a_goal_out_of_reach_is_named():
    found = design.excite("lwr4plus", replace(SHORT, goals=("raw=300", "joint7=0.5"), evaluations=12, outlook=False))
    said = " ".join(found.notes)
    assert "goal joint7=0.5 is missed: " in said and "state [friction]" in said


@pytest.mark.slow
def test_a_front_serves_the_goals():
    """With a coarse family to begin with; what is designed is as near to the goals as any motion of the front."""
    goals = ("normalised=6", "wrist=0.1")
    settings = replace(SHORT, goals=goals, period=20.0, harmonics=12, evaluations=60, front=3, outlook=False)
    found = design.excite("tx40", settings)
    missed = (found.front.values - [6.0, 0.9]) / [6.0, 0.9]
    assert missed[found.front.designed].max() < missed.max(axis=1).min() + 0.02 and found.proof.feasible


@pytest.mark.slow
def test_ctrl_c_after_the_search_is_heard(monkeypatch):
    """The motion stands without predictions; a session, which would go on with its next step, is told."""

    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(design, "foretell", interrupted)
    motion = design.excite("tx40", replace(SHORT, starts=1, evaluations=20, outlook=False))
    assert motion.interrupted and not motion.found.interrupted
    assert motion.outlook is None and motion.proof is not None


@pytest.mark.slow
def test_torque_goal_works_without_friction():
    """Typical friction stands in for what nobody knows yet, so that condition numbers do not pay for a goal in vain."""
    settings = replace(SHORT, starts=1, evaluations=100, outlook=False)
    plain = design.excite("lwr4plus", settings)
    found = design.excite("lwr4plus", replace(settings, goals=("wrist=0.1",)))
    assert found.goals[0][3] >= 0.1 and "torque goals expect friction" in " ".join(found.notes)
    assert found.condition.normalised < 1.1 * plain.condition.normalised


@pytest.mark.parametrize(
    ("options", "settings", "words"),
    [
        (PAYLOAD, {"loads": ("lode",)}, "did you mean 'load'"),
        (PAYLOAD, {"columns": ("ZZ9",)}, "'ZZ9' is not one of"),
        (PAYLOAD, {"columns": ("essential",)}, "needs --model"),
        (PAYLOAD, {"drives": "Fv"}, "states the drive terms"),
        (PAYLOAD, {"goals": ("raw=50", "raw=60")}, "'raw' is stated twice"),
        ({}, {"loads": ("load",)}, "have no payloads"),
        ({"payload": {"load": {"mass": 200.0, "com": [0.0, 0.0, 0.05]}}}, {}, "take a lighter payload"),
        ({"rows": "both", "coupling": [{"joints": [5, 6]}]}, {}, 'label = "5_6"'),
    ],
)
def test_models_without_possible_motion(options, settings, words):
    """Models that no motion can be designed for are refused."""
    with pytest.raises(UsageError, match=re.escape(words)):
        design.excite("lwr4plus", replace(SHORT, **settings), options=parse_options(options).settings)


def test_too_heavy_payload_is_refused():
    """60 kg on a TX40, rated 2 kg: joint, torque, limit and posture are said; 5 kg are designed for."""
    heavy, light = (parse_options({"payload": {"tool": {"mass": mass}}}).settings for mass in (60.0, 5.0))
    with pytest.raises(UsageError, match=r"in 7\d% of the postures: at joint 2 .* limit 131.8 N m .* in the posture"):
        read_inputs("tx40", ExcitationSettings(), options=heavy)
    assert read_inputs("tx40", ExcitationSettings(), options=light).model.values is not None
