"""Gravity and payloads from torques at rest, made by Pinocchio with friction that holds each joint (case 17)."""

import csv
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio
import pytest

import calib
from calib import cli
from calib.errors import MeasurementError
from calib.procedure.dynamic_stage.standing.gravity_result import identify_gravity
from calib.procedure.dynamic_stage.standing.recorded_poses import stand
from calib.robot.chain import Chain
from calib.robot.formats.urdf_write import write_new
from calib.robot.library import load

STICTION = 0.8  # [N m]
PAYLOAD = pinocchio.Inertia(2.5, np.array([0.03, -0.02, 0.12]), np.zeros((3, 3)))
OPTIONS = '[payload.tool]\n[files."loaded.csv"]\npayload = ["tool"]\n'


def with_masses(chain: Chain) -> Chain:
    """Return a chain of rods of 4 to 1 kg, their centres 0.1 m from each joint."""
    masses = np.linspace(4.0, 1.0, chain.n)
    bodies = np.zeros((chain.n, 10))
    bodies[:, [0, 3]] = (0.01 * masses + masses * 0.1**2)[:, None]
    bodies[:, 5] = 0.01 * masses
    bodies[:, 8] = 0.1 * masses
    bodies[:, 9] = masses
    return replace(chain, inertias=bodies)


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> tuple[Path, Chain, pinocchio.Model]:
    """A description, its chain, and the real arm: masses 20 % heavier, centres off by 20 mm."""
    chain = with_masses(load("iiwa14"))
    folder = tmp_path_factory.mktemp("arm")
    text = write_new(chain)
    (folder / "arm.urdf").write_text(text)
    model = pinocchio.buildModelFromXML(text)
    random = np.random.default_rng(2)
    for inertia in list(model.inertias)[1:]:
        inertia.mass *= 1.2
        inertia.lever = inertia.lever + random.uniform(-0.02, 0.02, 3)
    return folder / "arm.urdf", chain, model


def torques(model: pinocchio.Model, q: np.ndarray, load: pinocchio.Inertia | None = None) -> np.ndarray:
    model = model.copy()
    if load is not None:
        tip = model.frames[model.getFrameId("tip") if model.existFrame("tip") else model.nframes - 1]
        model.appendBodyToJoint(model.njoints - 1, load, tip.placement)
    data = model.createData()
    return np.array([pinocchio.computeGeneralizedGravity(model, data, row) for row in q])


def sides(q: np.ndarray) -> np.ndarray:
    return np.random.default_rng(len(q)).choice([-1.0, 1.0], q.shape)


def write(path: Path, q: np.ndarray, torque: np.ndarray, extra: np.ndarray | None = None, separator: str = ",") -> str:
    n = q.shape[1]
    head = [f"q{k}" for k in range(1, n + 1)] + [f"tau{k}" for k in range(1, n + 1)]
    columns = [q, torque]
    if extra is not None:
        head += [f"approach{k}" for k in range(1, n + 1)]
        columns.append(extra)
    with path.open("w", newline="") as file:
        csv.writer(file, delimiter=separator).writerows([head, *np.hstack(columns).tolist()])
    return str(path)


def drawn(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.8, 1.8, (count, 7))


def held(model: pinocchio.Model, q: np.ndarray, **options: object) -> np.ndarray:
    """Return torques within the band of friction, with noise."""
    random = np.random.default_rng(7)
    gravity = torques(model, q, **options)  # type: ignore[arg-type]
    return gravity + random.uniform(-STICTION, STICTION, q.shape) + random.normal(0.0, 0.02, q.shape)


@pytest.mark.parametrize(
    "separator", [pytest.param(",", marks=pytest.mark.slow), ";", pytest.param("\t", marks=pytest.mark.slow)]
)
def test_a_table_of_poses_identifies_gravity(tmp_path, arm, separator):
    """No stamps: one row per pose. The exported URDF has the real arm's gravity, within the band of friction."""
    urdf, _, model = arm
    q = drawn(120)
    path = write(tmp_path / "poses.csv", q, held(model, q), separator=separator)
    assert stand(urdf, [path], None, None, None)
    result = identify_gravity(urdf, [path])
    assert result.verdict == "pass" and "description" in result.verdict.reason
    result.write(tmp_path / "out")
    written = pinocchio.buildModelFromXML((tmp_path / "out/robot.urdf").read_text())
    unseen = drawn(50, 9)
    error = torques(written, unseen) - torques(model, unseen)
    described = torques(pinocchio.buildModelFromXML(urdf.read_text()), unseen) - torques(model, unseen)
    assert np.sqrt(np.mean(error**2)) < 0.3 < np.sqrt(np.mean(described**2))
    before = pinocchio.buildModelFromXML(urdf.read_text()).inertias[3].inertia
    np.testing.assert_allclose(written.inertias[3].inertia, before, atol=1e-6)
    assert "not identified" in (tmp_path / "out/robot.urdf").read_text()[:800]


def test_friction_is_estimated_from_both_sides(tmp_path, arm):
    """Where the side from which each joint came is told, its friction at rest comes with a sigma; else a band."""
    urdf, _, model = arm
    q = drawn(120)
    side = sides(q)
    torque = torques(model, q) + STICTION * side + np.random.default_rng(1).normal(0.0, 0.05, q.shape)
    told = identify_gravity(urdf, [write(tmp_path / "told.csv", q, torque, side)])
    friction, sigma = told.gravity.friction
    assert np.all(np.abs(friction - STICTION) < 4.0 * sigma) and np.all(sigma < 0.02)
    untold = identify_gravity(urdf, [write(tmp_path / "untold.csv", q, torque)])
    assert np.isnan(untold.gravity.friction[1]).all()
    assert "approach1" in "\n".join(untold.lines()) and "approach1" not in "\n".join(told.lines())


def test_payload_from_two_files(tmp_path, arm, monkeypatch, capsys):
    urdf, _, model = arm
    monkeypatch.chdir(tmp_path)
    q = drawn(100)
    write(tmp_path / "empty.csv", q, held(model, q))
    write(tmp_path / "loaded.csv", q, held(model, q, load=PAYLOAD))
    (tmp_path / "o.toml").write_text(OPTIONS)
    words = ["identify", str(urdf), "empty.csv", "loaded.csv", "--options", "o.toml", "--out", "out"]
    assert cli.run(words) == 0
    printed = capsys.readouterr().out
    assert "payload tool: 2." in printed and "inertias and friction in motion are not" in printed
    result = identify_gravity(urdf, ["empty.csv", "loaded.csv"], options=Path("o.toml"))
    values, covariance = result.gravity.payload("tool")
    truth = np.append(PAYLOAD.mass * PAYLOAD.lever, PAYLOAD.mass)
    assert np.all(np.abs(values - truth) < 4.0 * np.sqrt(np.diag(covariance)))
    assert abs(values[3] - 2.5) < 0.1


@pytest.mark.slow
def test_a_log_that_stands_is_averaged_and_one_that_moves_is_not(tmp_path, arm):
    urdf, _, model = arm
    q = drawn(60)
    rows = np.repeat(np.arange(60), 100)
    random = np.random.default_rng(3)
    torque = held(model, q)[rows] + random.normal(0.0, 0.3, (6000, 7))
    table = np.column_stack([np.arange(6000) / 100.0, q[rows], torque])
    head = ["t", *(f"q{k}" for k in range(1, 8)), *(f"tau{k}" for k in range(1, 8))]
    log = tmp_path / "log.csv"
    with log.open("w", newline="") as file:
        csv.writer(file).writerows([head, *table.tolist()])
    assert stand(urdf, [str(log)], None, None, None)
    result = identify_gravity(urdf, [str(log)])
    assert len(result.training[0].q) + len(result.unseen[0].q) == 60 and result.verdict == "pass"
    table[:, 1:8] = 0.3 * np.sin(table[:, :1] * np.arange(1, 8) / 10.0)
    with log.open("w", newline="") as file:
        csv.writer(file).writerows([head, *table.tolist()])
    assert not stand(urdf, [str(log)], None, None, None)
    # a motion without stamps is asked for its rate, as before
    moving = write(tmp_path / "moving.csv", table[:, 1:8], table[:, 8:])
    assert not stand(urdf, [moving], None, None, None)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda gravity: -gravity, r"gravity \(0, 0, 9.81\).*gravity = \[0, 0, 9.81\] in the options"),
        (lambda gravity: 0.001 * gravity, "compensated for gravity already"),
        (lambda gravity: gravity[:, [0, 2, 1, 3, 4, 5, 6]], "verdict fail"),
    ],
)
def test_what_contradicts_the_description_does_not_pass(tmp_path, arm, change, words):
    """Masses of any sign explain torques of any sign: those described decide, and no robot.urdf is written."""
    urdf, _, model = arm
    q = drawn(120)
    result = identify_gravity(urdf, [write(tmp_path / "p.csv", q, change(held(model, q)))])
    lines = " ".join(result.lines())
    assert result.verdict == "fail"
    assert re.search(words, lines)
    result.write(tmp_path / "out")
    if "options" in words:
        assert not (tmp_path / "out/robot.urdf").exists()


def test_too_few_poses_and_corners_are_said(tmp_path, arm, capsys):
    urdf, _, model = arm
    q = drawn(4)
    few = write(tmp_path / "few.csv", q, held(model, q))
    assert cli.run(["identify", str(urdf), few, "--out", str(tmp_path / "out")]) == 2
    assert "4 standing poses, 1 of them held out" in capsys.readouterr().err
    q = drawn(80)
    q[:, 1:4] = [0.3, 0.0, 0.5]
    corner = identify_gravity(urdf, [write(tmp_path / "corner.csv", q, held(model, q))])
    assert any("need other poses" in line for line in corner.lines())


def sided(model: pinocchio.Model, q: np.ndarray, side: np.ndarray, **options: object) -> np.ndarray:
    """Return torques with friction of the stated approaches, and noise."""
    noise = np.random.default_rng(1).normal(0.0, 0.02, q.shape)
    return torques(model, q, **options) + STICTION * side + noise  # type: ignore[arg-type]


def test_friction_of_known_approach_is_no_error(tmp_path, arm, monkeypatch):
    """Held-out poses are predicted with the friction of their approach; with payloads too."""
    urdf, _, model = arm
    monkeypatch.chdir(tmp_path)
    q = drawn(40)
    side = sides(q)
    write(Path("empty.csv"), q, sided(model, q, side), side)
    write(Path("loaded.csv"), q, sided(model, q, side, load=PAYLOAD), side)
    Path("o.toml").write_text(OPTIONS)
    for result in [
        identify_gravity(urdf, ["empty.csv"]),
        identify_gravity(urdf, ["empty.csv", "loaded.csv"], (), Path("o.toml")),
    ]:
        assert result.verdict == "pass"
        assert np.sqrt(np.mean(result.errors() ** 2)) < 0.04


def test_reversed_approach_columns_do_not_pass(tmp_path, arm):
    urdf, _, model = arm
    q = drawn(40)
    side = sides(q)
    result = identify_gravity(urdf, [write(tmp_path / "p.csv", q, sided(model, q, side), -side)])
    assert result.verdict == "marginal" and "friction at rest is negative" in result.verdict.reason
    assert "approach1 … reversed" in result.verdict.advice


def test_few_poses_do_not_pass(tmp_path, arm):
    """Without friction: the band is neither zero nor far above the noise of 0.02 N m."""
    urdf, _, model = arm
    q = drawn(8)
    result = identify_gravity(urdf, [write(tmp_path / "p.csv", q, sided(model, q, np.zeros(q.shape)))])
    assert result.verdict != "pass"
    band, _ = result.gravity.friction
    assert np.all(band > 0.004) and np.all(band < 0.2)


def test_a_worse_model_than_the_description_fails(tmp_path, arm):
    urdf, _, model = arm
    described = pinocchio.buildModelFromXML(urdf.read_text())
    q, other = drawn(40), drawn(20, 5)
    fit = write(tmp_path / "fit.csv", q, held(model, q))
    result = identify_gravity(urdf, [fit], [write(tmp_path / "other.csv", other, torques(described, other))])
    assert result.verdict == "fail" and "the description is better" in result.verdict.reason


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda table: table.__setitem__((3, 8), np.nan), "row 4, column 'tau2': found nan"),
        (lambda table: table.__setitem__((3, 15), 2.0), "row 4, column 'approach2': found 2"),
        (lambda table: table.__setitem__((slice(None), slice(7)), 0.3), "one distinct pose"),
    ],
)
def test_invalid_cells_and_equal_poses_are_refused(tmp_path, arm, change, words):
    urdf, _, model = arm
    q = drawn(20)
    table = np.hstack([q, torques(model, q), sides(q)])
    change(table)
    path = write(tmp_path / "p.csv", table[:, :7], table[:, 7:14], table[:, 14:])
    with pytest.raises(MeasurementError, match=words):
        identify_gravity(urdf, [path])


def test_missing_approach_columns_are_said(tmp_path, arm):
    urdf, _, model = arm
    q = drawn(20)
    told = Path(write(tmp_path / "told.csv", q, torques(model, q), sides(q)))
    untold = write(tmp_path / "untold.csv", q, torques(model, q))
    lines = identify_gravity(urdf, [str(told), untold]).lines()
    assert any("are not used" in line and "untold.csv has none" in line for line in lines)
    told.write_text(told.read_text().replace("approach2", "other"))
    with pytest.raises(MeasurementError, match="no approach2"):
        identify_gravity(urdf, [str(told)])


def test_the_needed_number_contains_the_held_out_poses(tmp_path, arm):
    urdf, _, model = arm
    q = drawn(40)
    with pytest.raises(MeasurementError, match="5 standing poses, 1 of them held out") as caught:
        identify_gravity(urdf, [write(tmp_path / "five.csv", q[:5], torques(model, q[:5]))])
    needed = int(re.search(r"at least (\d+)", str(caught.value)).group(1))
    identify_gravity(urdf, [write(tmp_path / "enough.csv", q[:needed], torques(model, q[:needed]))])


@pytest.mark.parametrize(
    ("order", "signs", "words"),
    [
        ([0, 1, 2, 3, 4, 5, 6], [1, -1, 1, 1, 1, 1, 1], "tau2 the other sign"),
        pytest.param([0, 1, 2, 3, 4, 5, 6], [1, 1, 1, -1, 1, 1, 1], "tau4 the other sign", marks=pytest.mark.slow),
        ([0, 3, 2, 1, 4, 5, 6], [1, 1, 1, 1, 1, 1, 1], "tau2 and tau4 exchanged"),
        ([0, 1, 2, 3, 4, 5, 6], [-1, -1, -1, -1, -1, -1, -1], r"gravity = \[0, 0, 9.81\]"),
    ],
)
def test_the_cause_that_explains_the_torques_is_named(tmp_path, arm, order, signs, words):
    """One reversed torque is not gravity upside down; what the advice says makes a good fit."""
    urdf, _, model = arm
    q = drawn(40)
    wrong = held(model, q)[:, order] * signs
    result = identify_gravity(urdf, [write(tmp_path / "wrong.csv", q, wrong)])
    assert result.verdict == "fail" and re.search(words, result.verdict.advice)
    if "gravity" not in words:
        followed = identify_gravity(urdf, [write(tmp_path / "right.csv", q, (wrong * signs)[:, order])])
        assert followed.verdict != "fail"


def test_no_cause_is_named_where_none_explains(tmp_path, arm):
    urdf, _, _ = arm
    q = drawn(40)
    noise = np.random.default_rng(3).normal(0.0, 20.0, q.shape)
    result = identify_gravity(urdf, [write(tmp_path / "p.csv", q, noise)])
    assert result.verdict == "fail"
    assert "gravity = " not in result.verdict.advice and "tau" not in result.verdict.advice


def test_an_undeclared_load_is_stated(tmp_path, arm):
    urdf, _, model = arm
    q, other = drawn(30), drawn(30, 5)
    empty = write(tmp_path / "empty.csv", q, held(model, q))
    loaded = write(tmp_path / "loaded.csv", other, held(model, other, load=PAYLOAD))
    result = identify_gravity(urdf, [empty, loaded])
    assert result.verdict != "pass"
    assert re.search(r"a load of 2\.\d+ ± [\d.]+ kg in .*loaded.csv", result.verdict.reason)
    same = write(tmp_path / "same.csv", other, held(model, other))
    assert "a load of" not in identify_gravity(urdf, [empty, same]).verdict.reason


def test_options_of_motions_are_not_used(tmp_path, arm, capsys):
    urdf, _, model = arm
    q = drawn(40)
    poses = write(tmp_path / "p.csv", q, held(model, q))
    words = ["identify", str(urdf), poses, "--out", str(tmp_path / "out")]
    assert cli.run([*words, "--friction", "nonsense"]) == 2
    assert "--friction nonsense: expected" in capsys.readouterr().err
    assert cli.run([*words, "--method", "wls"]) in (0, 1)
    assert "not used for standing poses: --method" in capsys.readouterr().out
    out = str(tmp_path / "out")
    verbs = [
        ["export", out, "--into", str(tmp_path / "new")],
        ["diff", out, out],
        ["view", out, "--save", "s.rrd"],
        ["certificate", out],
        ["deliver", out, "--for", "krl"],
        ["status", out],
        ["excite", out, "--out", "e"],
    ]
    for verb in verbs:
        assert cli.run(verb) == 2
        assert "is the gravity of standing poses; " in capsys.readouterr().err
    assert calib.open_result(out).verdict == identify_gravity(urdf, [poses]).verdict


def test_a_slope_under_the_arm_is_named(tmp_path, arm):
    """On a slope of 20°, free masses do not explain the torques with gravity as stated, but along another direction."""
    urdf, _, model = arm
    q = drawn(60)
    tilted = model.copy()
    tilted.gravity.linear = 9.81 * np.array([np.sin(0.35), 0.0, -np.cos(0.35)])
    result = identify_gravity(urdf, [write(tmp_path / "p.csv", q, held(tilted, q))])
    assert result.verdict == "fail" and "stand on a slope of some 2" in result.verdict.advice


def test_a_tie_with_the_description_does_not_fail(tmp_path, arm):
    """Torques of the description itself: whether the model is a little better or worse is chance."""
    urdf, _, _ = arm
    described = pinocchio.buildModelFromXML(urdf.read_text())
    q = drawn(40)
    result = identify_gravity(urdf, [write(tmp_path / "p.csv", q, held(described, q))])
    assert result.unexplained() > result.unexplained(described=True)
    assert result.verdict == "marginal" and "no better than the description" in result.verdict.reason


def test_poses_mixed_with_a_motion_are_said(tmp_path, arm, capsys):
    urdf, _, model = arm
    q = drawn(20)
    poses = write(tmp_path / "poses.csv", q, held(model, q))
    path = 0.3 * np.sin(np.arange(300)[:, None] / 100.0 * np.arange(1, 8))
    motion = write(tmp_path / "motion.csv", path, torques(model, path))
    assert cli.run(["identify", str(urdf), poses, motion, "--out", str(tmp_path / "out")]) == 2
    assert "poses.csv; the other files are motions" in " ".join(capsys.readouterr().out.split())
