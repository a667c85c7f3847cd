"""The closed loop in ``calib identify``: instruments that are right where least squares is not, and refusals."""

import csv
import io
import json
import re
import tomllib
from dataclasses import fields, replace
from functools import cache
from pathlib import Path

import numpy as np
import planted_motion as planted
import pytest
from without_figures import run

from calib.api.dynamic import identify_dynamics
from calib.data.recordings.recording import Recording
from calib.data.signals.motion import FilterOptions, make_motion
from calib.errors import CalibError, MeasurementError, UsageError
from calib.identification import identify_options
from calib.identification import loop as loop_settings
from calib.identification.closed_loop import controllers
from calib.identification.closed_loop.simulation import Plant, Sensing, SimulatedRun, simulate
from calib.identification.identify import Identification
from calib.identification.identify import identify as identified
from calib.identification.physical_consistency import information
from calib.identification.rows import Case, make_case
from calib.identification.settings import IdentificationSettings
from calib.identification.uncertainty.geometry_uncertainty import sensitivity
from calib.procedure.excitation.coefficients import NAME, Periodic, read, table
from calib.robot.calibrated import CalibratedChain
from calib.robot.tables import dumps
from calib.simulation import known_robots

RATE, EVERY = 1000.0, 4
KP, KD = np.array([4000.0, 3000.0, 500.0]), np.array([200.0, 150.0, 25.0])
V0 = 0.3  # wide: W stays linear in the noise
GAINS = f'controller = "pd"\nkp = {KP.tolist()}\nkd = {KD.tolist()}\nrate = 1000\n'
PLAIN = f"v0 = {V0}\n[filter]\ncutoff = 20\nband = 8\nclock = 'stamps'\n"


def plant() -> Plant:
    model = planted.model()
    terms = tuple(replace(one, settings=(V0,)) if one.shape == "sign" else one for one in model.terms)
    return Plant(model.bodies, terms, planted.truth())


@cache
def motion(seed: int) -> controllers.Reference:
    limit = np.full(3, 1.5)
    return known_robots.random_fourier(-limit, limit, np.full(3, 3.0), 16.0, RATE, 10, acceleration=15.0, seed=seed)


@cache
def moved(seed: int) -> SimulatedRun:
    return simulate(plant(), controllers.pd(KP, KD), motion(seed), Sensing(sigma_tau=0.1, every=EVERY), seed)


def log(folder: Path, name: str, seed: int, noise: float = 0.0, form: str = "q_ref{}", factor: float = 1.0) -> Path:
    """Write a CSV log; `noise` [rad] is on the logged positions alone."""
    path = folder / name
    path.write_text(text_of_log(seed, noise, form, factor))
    return path


@cache
def text_of_log(seed: int, noise: float, form: str, factor: float) -> str:
    run = moved(seed)
    q = run.q + noise * np.random.default_rng(seed).normal(size=run.q.shape)
    names = ["t", *(f"q{j}" for j in (1, 2, 3)), *(f"tau{j}" for j in (1, 2, 3))]
    parts = [run.t, q, run.tau]
    if form:
        names += [form.format(j) for j in (1, 2, 3)]
        parts.append(factor * motion(seed).q[::EVERY])
    text = io.StringIO()
    np.savetxt(text, np.column_stack(parts), delimiter=",", header=",".join(names), comments="", fmt="%.8g")
    return text.getvalue()


def identify(
    robot: Path, folder: Path, train: Path, loop: str, method: str = "iv", *more: object, plain: str = PLAIN
) -> tuple[int, Path]:
    (folder / "options.toml").write_text(plain + (f"[loop]\n{loop}" if loop else ""))
    out = folder / f"out_{method}"
    chosen = ["--options", folder / "options.toml", "--method", method, "--friction", "standard", "--out", out, *more]
    return run("identify", robot, train, *chosen), out


def friction_error(out: Path) -> float:
    """Return the rms relative error of the viscous and Coulomb parameters."""
    rows = {row["name"]: float(row["value"]) for row in csv.DictReader((out / "estimate.csv").open())}
    truth = {f"{name}{j + 1}": planted.DRIVES[name][j] for name in ("Fv", "Fc") for j in range(3)}
    return float(np.sqrt(np.mean([(rows[name] / value - 1.0) ** 2 for name, value in truth.items()])))


@pytest.mark.slow
def test_iv_is_right_where_noise_biases_ols(robot, tmp_path, capsys):
    """Both through the command, on another motion whose log is clean; a prior would hide a part of the bias."""
    train, other = log(tmp_path, "train.csv", 1, noise=3e-3), log(tmp_path, "other.csv", 2)
    plain = "prior = 'none'\n" + PLAIN
    results = {
        m: identify(robot, tmp_path, train, GAINS, m, "--validate", other, plain=plain if m == "wls" else PLAIN)
        for m in ("wls", "iv")
    }
    text = capsys.readouterr().out
    found = {m: json.loads((out / "metrics.json").read_text()) for m, (_, out) in results.items()}
    unseen = {
        m: one["validation"]["other.csv"]["filtered"]["relative_error_percent"]["total"] for m, one in found.items()
    }
    assert unseen["iv"] < 0.5 * unseen["wls"]
    assert friction_error(results["iv"][1]) < 0.5 * friction_error(results["wls"][1])
    for one in found.values():
        test = one["loop"]
        assert test["durbin_wu_hausman"]["least_squares_biased"] and test["valid"] and not test["instruments_weak"]
        assert test["largest_shift_sigma"] > 3.0 and max(test["distance_percent"]) < 2.0
    assert found["iv"]["method"] == "iv" and found["wls"]["method"] == "wls"
    assert "least squares is biased" in text and "use method 'iv'" in text
    table = list(csv.DictReader((results["wls"][1] / "instrumental.csv").open()))
    assert [row["name"] for row in table] == [
        row["name"] for row in csv.DictReader((results["iv"][1] / "estimate.csv").open())
    ]


@pytest.mark.slow
def test_didim_is_a_method_of_its_own(robot, tmp_path):
    """Chosen by name it is what iv makes of instruments = 'didim', and no measured position blurs it."""
    train = log(tmp_path, "train.csv", 1, noise=3e-3)
    _, named = identify(robot, tmp_path, train, GAINS, "didim")
    _, stated = identify(robot, tmp_path, train, GAINS + "instruments = 'didim'\n", "iv")
    found = json.loads((named / "metrics.json").read_text())
    assert (
        found["method"] == found["loop"]["instruments"] == "didim"
        and "measured positions are not used" in found["method_assumes"]
    )
    assert (named / "estimate.csv").read_text() == (stated / "estimate.csv").read_text()
    assert friction_error(named) < 0.15


@pytest.mark.slow
@pytest.mark.parametrize("method", ["pc-iv", pytest.param("pc-didim", marks=pytest.mark.slow)])
def test_constraints_hold_in_every_round(robot, tmp_path, capsys, method):
    """Constraints hold in every round, and the folder stays readable."""
    train = log(tmp_path, "train.csv", 1, noise=1e-3)
    limit = 1.5 * planted.DRIVES["Fv"][0]
    code, out = identify(robot, tmp_path, train, f"{GAINS}[constraints]\nbounds = {{ Fv1 = [{limit}, inf] }}", method)
    assert code == 0 and "the estimate is at this bound" in capsys.readouterr().out
    row = next(row for row in csv.DictReader((out / "estimate.csv").open()) if row["name"] == "Fv1")
    assert float(row["value"]) == pytest.approx(limit, rel=1e-6) and not row["sigma"]
    told = json.loads((out / "metrics.json").read_text())["constraints"]
    assert [one["name"] for one in told["binding"]] == [f"Fv1 >= {limit:g}"] and told["binding"][0]["multiplier"] > 0.0
    read = information.read(out)
    assert np.isfinite(read.factor).all() and read.best >= 0.0


@pytest.mark.slow
@pytest.mark.parametrize("method", ["iv", pytest.param("pc-iv", marks=pytest.mark.slow)])
def test_user_function_holds_in_every_round(robot, tmp_path, capsys, method):
    """A file of CVXPY constraints; `iv` satisfies it alone, without the constraints of `pc-iv`."""
    train = log(tmp_path, "train.csv", 1, noise=1e-3)
    limit = 0.9 * float(np.hypot(*planted.DRIVES["Fv"][:2]))
    text = f"import cvxpy as cp\n\n\ndef constraints(beta):\n    return [cp.norm(beta['Fv1', 'Fv2']) <= {limit}]\n"
    (tmp_path / "limits.py").write_text(text)
    code, out = identify(robot, tmp_path, train, f"{GAINS}[constraints]\nfile = 'limits.py'", method)
    assert code in (0, 1) and "binds; without it the estimate is" in " ".join(capsys.readouterr().out.split())
    rows = {row["name"]: row for row in csv.DictReader((out / "estimate.csv").open())}
    assert np.hypot(float(rows["Fv1"]["value"]), float(rows["Fv2"]["value"])) == pytest.approx(limit, rel=1e-5)
    told = json.loads((out / "metrics.json").read_text())
    assert told["method"] == method and len(told["constraints"]["binding"]) == 1
    assert (len(told["constraints"]["names"]) == 1) == (method == "iv")


@pytest.mark.slow
def test_uncontrollable_estimate_ends(robot, tmp_path, capsys):
    """M(q) barely definite is nothing that a sampled controller can hold: it is kept away from singular, and told."""
    train = log(tmp_path, "train.csv", 1, noise=1e-3)
    _, out = identify(robot, tmp_path, train, f"{GAINS}[constraints]\nbounds = {{ ZZ2R = [-inf, -0.1] }}", "pc-iv")
    told = json.loads((out / "metrics.json").read_text())["constraints"]
    assert told["postures_binding"] > 0 and "ZZ2R <= -0.1" in [one["name"] for one in told["binding"]]
    assert "times as far from singular as stated" in capsys.readouterr().out.replace("\n", " ")


@pytest.mark.slow
def test_exact_positions_confirm_ols(robot, tmp_path):
    """What the test still sees is small: no parameter is off by three sigma."""
    code, out = identify(robot, tmp_path, log(tmp_path, "train.csv", 1), GAINS, "wls")
    found = json.loads((out / "metrics.json").read_text())
    assert code == 0 and found["loop"]["largest_shift_sigma"] < 3.0 and found["loop"]["valid"]
    assert not any("method 'iv'" in line for line in found["warnings"])


@pytest.mark.slow
def test_controller_may_come_from_the_log(robot, tmp_path, capsys):
    """The controller may be read from the log."""
    train = log(tmp_path, "train.csv", 1, noise=1e-5, form="q_des_{}")
    code, out = identify(robot, tmp_path, train, 'controller = "identify"\nband = 8\nrate = 1000\n')
    read = json.loads((out / "metrics.json").read_text())["loop"]
    assert code == 0 and min(read["controller_explains_percent"]) > 80.0
    np.testing.assert_allclose(read["controller"]["kp"], KP, rtol=0.1)
    np.testing.assert_allclose(read["controller"]["kd"], KD, rtol=0.3)
    assert "controller identified from train.csv" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["csv", pytest.param("npz", marks=pytest.mark.slow)])
def test_reference_may_be_a_separate_file(robot, tmp_path, kind):
    """The reference may be a file of its own."""
    train = log(tmp_path, "train.csv", 1, noise=1e-3, form="")
    asked = motion(1)
    if kind == "csv":
        table = np.column_stack([asked.t, np.rad2deg(asked.q)])
        header = "t,q1 [deg],q2 [deg],q3 [deg]"
        np.savetxt(tmp_path / "asked.csv", table, delimiter=",", header=header, comments="")
    else:
        np.savez(tmp_path / "asked.npz", t=asked.t, q_ref=asked.q)
    code, out = identify(robot, tmp_path, train, GAINS + f'reference = "asked.{kind}"\n')
    assert code == 0 and max(json.loads((out / "metrics.json").read_text())["loop"]["distance_percent"]) < 1.0


@pytest.mark.parametrize(
    ("timing", "code"),
    [("", "loop-test-failed"), pytest.param('timing = "stated"\n', "loop-not-followed", marks=pytest.mark.slow)],
)
def test_wrong_gains_are_noticed(robot, tmp_path, capsys, timing, code):
    """At a hundredth of the stiffness the simulated robot is another robot; the tool says so and trusts no test.

    Such gains may look like a late reference; taken as stated, the simulated robot does not follow.
    """
    wrong = f'controller = "pd"\nkp = {(KP / 100).tolist()}\nkd = {(KD / 10).tolist()}\nrate = 1000\n{timing}'
    identify(robot, tmp_path, log(tmp_path, "train.csv", 1, noise=1e-3), wrong, "wls")
    found = json.loads((tmp_path / "out_wls" / "metrics.json").read_text())
    assert code in {one["code"] for one in found["noticed"]} and not found["loop"]["valid"]


REFUSED = [
    ({"form": ""}, GAINS, "has no reference positions"),
    ({"factor": 180.0 / np.pi}, GAINS, "looks like deg"),
    ({"factor": 3.0}, GAINS, "check that the reference belongs to this recording"),
    ({}, GAINS.replace("rate = 1000", "rate = 100"), "is below 250 Hz"),
    ({}, 'controller = "pd"\nkp = [1, 2]\nkd = [1]\n', "2 values for 3 joints"),
    ({}, 'controller = "pd"\nkp = [1]\n', "needs kp and kd"),
    ({}, 'controller = "pid"\n', "one of pd, cascade, identify"),
    ({}, GAINS + "reset = 1.0\n", "is a key of controller 'cascade'"),
    ({}, "kp = [1]\n", "'controller' is missing"),
    ({}, GAINS + 'reference = "nowhere.csv"\n', "cannot be read"),
    ({}, GAINS + 'reference = "short.csv"\n', "do not span"),
    ({}, GAINS + 'feedforward = "recording"\n', "no column tau_ff"),
    ({}, "", "needs the closed loop"),
]


# of those that are found in the options the first one quickly
@pytest.mark.parametrize(
    "log_as, loop, message",
    [
        pytest.param(*case, id=case[2], marks=[pytest.mark.slow] * (5 <= number <= 8))
        for number, case in enumerate(REFUSED)
    ],
)
def test_what_cannot_be_simulated_is_refused(robot, tmp_path, capsys, log_as, loop, message):
    if "short.csv" in loop:
        asked = motion(1)
        short = np.column_stack([asked.t, asked.q])[:3000]
        np.savetxt(tmp_path / "short.csv", short, delimiter=",", header="t,q1,q2,q3", comments="")
    code, out = identify(robot, tmp_path, log(tmp_path, "train.csv", 1, **log_as), loop)
    assert code == 2 and message in " ".join(capsys.readouterr().err.split()) and not out.exists()


def test_wrong_number_of_gains_is_refused(robot, tmp_path, capsys):
    """Gains of another length are refused, whatever the method."""
    code, _ = identify(
        robot, tmp_path, log(tmp_path, "train.csv", 1), 'controller = "pd"\nkp = [1, 2]\nkd = [1]\n', "ols"
    )
    assert code == 2
    assert "[loop] kp: 2 values for 3 joints" in " ".join(capsys.readouterr().err.split())


def test_loop_keys_are_documented_and_read():
    """Every key of the loop is documented and read."""
    for key in (field.name for field in fields(loop_settings.LoopSettings)):
        assert re.search(rf"^    {key} = ", loop_settings.__doc__, re.M), key
    found = identify_options.parse_options(
        {"loop": {"controller": "cascade", "position": 40, "velocity": [9.0, 5.0, 1.0], "reset": 0.1, "delay": 2}}
    ).settings.loop
    assert found is not None
    made = controllers.stated_controller(found, 3)
    np.testing.assert_allclose(made.kp, np.array([9.0, 5.0, 1.0]) * (40 + 10))
    np.testing.assert_allclose(made.ki, np.array([9.0, 5.0, 1.0]) * 400)
    assert made.delay == 2
    with pytest.raises(UsageError, match="expected a whole number of control periods"):
        identify_options.parse_options({"loop": {"controller": "identify", "delay": -1}})
    with pytest.raises(CalibError, match="there is no key 'gain'"):
        identify_options.parse_options({"loop": {"controller": "identify", "gain": 1}})


STEP = 2e-3  # of the geometry [m or rad]: far more than rounding, since each identification stops at 2.5 %


def noisy_case() -> Case:
    """Return a recording with noise of 3 mrad on its positions, which biases least squares."""
    run = moved(1)
    q = run.q + 3e-3 * np.random.default_rng(1).normal(size=run.q.shape)
    names = ("joint1", "joint2", "joint3")
    log = Recording(run.t, q, run.tau, "torque", names, q_ref=motion(1).q[::EVERY])
    return make_case("log", make_motion(log, FilterOptions(cutoff=20.0, band=8.0, clock="stamps")))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["iv", "didim"])
def test_sensitivity_is_difference_of_refits(method):
    """Measured: off by 0.3 % (iv, didim) and 57 % (least squares) of the change, in sigmas of the estimate."""
    arm, case = planted.arm(), noisy_case()
    loop = loop_settings.LoopSettings(controller="pd", kp=tuple(KP), kd=tuple(KD), rate=RATE)

    def refit(change: np.ndarray, own: str = method) -> Identification:
        settings = IdentificationSettings(method=own, friction="standard", v0=(V0,), prior="none", loop=loop)
        return identified(CalibratedChain(arm.with_values(np.array(arm.values) + change), arm), [case], settings)

    k = arm.names.index("up")
    still, step = np.zeros(len(arm.names)), STEP * np.eye(len(arm.names))[k]
    found = refit(still)
    above, below = (refit(sign * step).fitted.estimate.values for sign in (1.0, -1.0))
    expected = (above - below) / (2.0 * STEP)
    sigma = found.fitted.estimate.sigma
    own, plain = (sensitivity(one, arm, [case])[0][:, k] for one in (found, refit(still, "wls")))
    off = [np.linalg.norm((one - expected) / sigma) / np.linalg.norm(expected / sigma) for one in (own, plain)]
    assert off[0] < 0.02 < 0.3 < off[1]


def design(folder) -> Periodic:
    """Write the folder of a designed motion, a period of 8 s that begins at rest; return the motion."""
    rng, order = np.random.default_rng(4), np.arange(1, 6)
    sines, cosines = 0.6 * rng.normal(size=(2, planted.N, 5)) / order
    sines -= np.outer(sines @ order, order) / (order @ order)
    cosines -= np.outer(cosines @ order**2, order**2) / (order**2 @ order**2)
    series = tuple(np.concatenate([[0.1], a, b]) for a, b in zip(sines, cosines))
    names = tuple(f"joint{j + 1}" for j in range(planted.N))
    folder.mkdir()
    (folder / NAME).write_text(
        dumps(table(Periodic(names, ("revolute",) * len(names), 8.0, RATE, 2, "fourier", series), "planted", []))
    )
    return read(folder)


@pytest.mark.slow
def test_designed_motion_is_reference_of_log(robot, tmp_path):
    """Measured: its beginning within 0.02 ms; iv, didim as with a column q_ref (10 ms late: didim 6 sigmas)."""
    motion, lead, end = design(tmp_path / "motion"), 0.7337, 0.7337 + 2 * 8.0
    t = np.arange(0.0, end + 0.6, 1.0 / RATE)
    q, v, a = motion.orders(np.clip(t - lead, 0.0, 16.0))
    moves = ((t >= lead) & (t <= end))[:, None]
    reference = controllers.Reference(t, q, v * moves, a * moves)
    run = simulate(plant(), controllers.pd(KP, KD), reference, Sensing(sigma_tau=0.1, every=EVERY), 1)
    measured = run.q + 1e-3 * np.random.default_rng(1).normal(size=run.q.shape)
    log = Recording(run.t, measured, run.tau, "torque", motion.joint_names, file="log.csv")
    logged = replace(log, q_ref=motion.orders(np.clip(run.t - lead, 0.0, 16.0))[0]).cut(lead, end)
    for method in ("iv", "didim"):
        options = identify_options.parse_options(tomllib.loads(PLAIN + f"[loop]\n{GAINS}"))
        chosen = {"options": options, "method": method, "friction": "standard"}
        found = identify_dynamics(robot, log, excitation=tmp_path / "motion", **chosen)
        column = identify_dynamics(robot, logged, **chosen)
        away = np.abs(found.estimate.values - column.estimate.values) / column.estimate.sigma
        assert away.max() < 0.5
        begins = float(found.found.loop.metrics.notes[-1].split("begins at ")[1].split(" s")[0])
        assert abs(begins - lead) < 5e-5
    with pytest.raises(MeasurementError, match="none of the designed motions"):
        backwards = replace(log, q=log.q[::-1], effort=log.effort[::-1])
        identify_dynamics(robot, backwards, excitation=tmp_path / "motion", **chosen)
