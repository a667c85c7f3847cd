"""The commands on parallel robots: identify, excite, fit; what they refuse, and what is for serial arms."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from platform_sines import sines
from without_figures import run

import calib as api
from calib.folders import read_covariance
from calib.parallel.mechanism import parallel_robot
from calib.parallel.mechanism.closure import closed
from calib.parallel.mechanism.geometric_fit import changed, loop_parameters
from calib.parallel.mechanism.parallel_model import PlatformRegressor, along, make_parallel_model
from calib.parallel.robots import find
from calib.robot import library

HEAD = "t,q1,q2,q3,q4,tau1,tau2,tau3,tau4"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with logs of a DualV without and with payload, and measured poses of another geometry.

    The torques are those that the motion needs, by the model: a simulation's kernel would be compiled for 14 s.
    """
    path = tmp_path_factory.mktemp("dualv")
    known = find("dualv").mechanism
    model = replace(make_parallel_model(known, ["Fv Fc"], v0=0.05, payloads=["5"]), preload=(10.0,))
    values = np.concatenate([model.known_parameters(), np.tile([0.05, 0.3], 4)])
    values[model.names.index("M5")] = 5.37
    t, rng = np.arange(1000) / 1000.0, np.random.default_rng(0)
    for name, carried in (("empty", ()), ("load", ("5",)), ("other", ("5",))):
        x, v, a = sines(t, (1.5, 2.5, 4.0, 5.5), np.array([0.02, 0.02, 0.12]), rng)
        q = along(known, x, v, a).posture.q[:, known.robot.actuated] + 1e-5 * rng.normal(size=(len(t), 4))
        plan = PlatformRegressor(model, np.arange(model.p), values, carried)
        tau = plan.torques(plan.motion(x, v, a))
        tau = tau + 0.5 * rng.normal(size=tau.shape)
        table = np.column_stack([t, q, tau])
        np.savetxt(path / f"{name}.csv", table, delimiter=",", header=HEAD, comments="")
        if name == "empty":
            (path / "absent").mkdir()
            (path / "absent" / "load.csv").write_text((path / "empty.csv").read_text())
            reversed_ = table * np.where(np.arange(9) == 5, -1.0, 1.0)
            np.savetxt(path / "reversed.csv", reversed_, delimiter=",", header=HEAD, comments="")
            table[:, [1, 2]] = table[:, [2, 1]]
            np.savetxt(path / "swapped.csv", table, delimiter=",", header=HEAD, comments="")
            table = np.column_stack([t, q[:, :3], tau[:, :3]])
            np.savetxt(path / "three.csv", table, delimiter=",", header="t,q1,q2,q3,tau1,tau2,tau3", comments="")
    files = '[payload.5]\n[files."load.csv"]\npayload = ["5"]\n[files."other.csv"]\npayload = ["5"]\n'
    (path / "options.toml").write_text(files)
    (path / "dropped.toml").write_text('drop = ["Fc11"]\n' + files)
    (path / "power.toml").write_text('rows = "power"\n' + files)
    parameters = loop_parameters(known)
    true = closed(changed(known.robot, parameters, 1e-3 * rng.normal(size=len(parameters))))
    x = 0.9 * rng.uniform(known.robot.lower, known.robot.upper, (60, 3))
    q = true.place(x).q[:, known.robot.actuated] + 1e-5 * rng.normal(size=(60, 4))
    motors = "motor1 [deg],motor2 [deg],motor3 [deg],motor4 [deg]"
    table = np.column_stack([np.degrees(q), 1e3 * x[:, :2], np.degrees(x[:, 2])])
    np.savetxt(path / "poses.csv", table, delimiter=",", header=motors + ",x [mm],y [mm],rz [deg]", comments="")
    wrong = table[:40] + 20.0 * ((np.arange(40) < 30)[:, None] & (np.arange(7) == 4))
    np.savetxt(path / "wrong.csv", wrong, delimiter=",", header=motors + ",x [mm],y [mm],rz [deg]", comments="")
    np.savetxt(path / "readings.csv", table[:, :4], delimiter=",", header=motors, comments="")
    (path / "way.csv").write_text("x [mm],y [mm],rz [deg]\n0,0,0\n50,40,15\n-60,20,-20\n0,0,0\n")
    (path / "outside.csv").write_text("x [mm],y [mm],rz [deg]\n0,0,0\n300,0,0\n")
    log = np.loadtxt(path / "load.csv", delimiter=",", skiprows=1)
    shifted = np.column_stack([log + 0.02 * (np.arange(9) == 1), log[:, 1]])
    np.savetxt(path / "shifted.csv", shifted, delimiter=",", header=f"{HEAD},elbow1 [rad]", comments="")
    np.savetxt(path / "passive.csv", table[:, :5], delimiter=",", header=motors + ",elbow1 [deg]", comments="")
    return path


def calib(*words) -> int:
    return run(*words)


@pytest.mark.parametrize("options", ["options", pytest.param("power", marks=pytest.mark.slow)])
def test_identify_finds_payload_and_predicts(folder, tmp_path, options):
    """Identify finds the payload, and predicts other motion."""
    out = tmp_path / "id"
    files = [folder / name for name in ("empty.csv", "load.csv")]
    words = ["--validate", folder / "other.csv", "--options", folder / f"{options}.toml", "--out", out, "--no-plots"]
    assert calib("identify", "dualv", *files, *words) == 0
    table = json.loads((out / "dynamics.json").read_text())
    assert abs(table["values"]["M5"] / 5.37 - 1.0) < 0.02
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["validation"]["other.csv"]["filtered"]["relative_error_percent"]["total"] < 5.0
    assert metrics["verdict"] == "pass"
    preloads = [one["values"] for one in metrics["noticed"] if one["code"] == "preload"]
    assert len(preloads) == 2 and all(abs(one["mean"] - 10.0) < 3.0 * one["sigma"] < 0.5 for one in preloads)
    assert table["preload"] == [np.mean([one["mean"] for one in preloads])]
    assert metrics["rows"] == (["power"] if options == "power" else ["x", "y", "rz"])
    assert calib("export", out, "--into", tmp_path / "all") == 0
    exported = json.loads((tmp_path / "all" / "parameters.json").read_text())["dynamics"]
    values = dict(zip(exported["standard"]["names"], exported["standard"]["values"]))
    platform = sum(values[f"M{k}"] for k in ("4", "11", "21", "12", "22", "13", "23", "14", "24"))
    masses = re.findall(r'mass value="([^"]+)"', (tmp_path / "all" / "robot.urdf").read_text())
    assert len(masses) == 12 and abs(sum(map(float, masses)) - platform) < 1e-9 and exported["consistency"]["possible"]
    drives = np.genfromtxt(tmp_path / "all" / "drives.csv", delimiter=",", names=True, dtype=None, encoding=None)
    motor = next(row for row in drives if row["joint"] == "motor1")
    assert abs(motor["friction"] - 0.3) < 3.0 * motor["friction_sigma"] and motor["damping_sigma"] > 0.0
    if options == "power":  # the folder of an identification is a robot
        words = ["--options", folder / "options.toml", "--out", tmp_path / "again", "--no-plots"]
        assert calib("identify", out, *files, *words) == 0


@pytest.mark.slow
def test_fit_then_identify(folder, tmp_path, capsys):
    """Fit, then identify on the calibrated geometry."""
    fitted = tmp_path / "fit"
    assert calib("fit", "dualv", folder / "poses.csv", "--out", fitted) == 0
    metrics = json.loads((fitted / "metrics.json").read_text())
    assert metrics["platform_rms"]["calibrated"]["rz"] < 0.02 * metrics["platform_rms"]["nominal"]["rz"]
    assert calib("identify", fitted, folder / "empty.csv", "--out", tmp_path / "id", "--no-plots") == 0
    assert calib("fit", "dualv", folder / "readings.csv", "--out", tmp_path / "alone") == 0
    assert "scale nor base position" in capsys.readouterr().out


@pytest.mark.slow
def test_excite_writes_motion_within_limits(tmp_path):
    """Excite writes a motion within the limits."""
    out = tmp_path / "motion"
    words = ["--period", "1", "--harmonics", "3", "--starts", "1", "--evaluations", "8", "--no-outlook", "--drives"]
    assert calib("excite", "dualv", *words, "Fv Fc", "--out", out) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert max(metrics["peak_torque"]) < 127.0 and min(one["margin"] for one in metrics["margins"].values()) > -1e-9
    rows = np.loadtxt(out / "motion.csv", delimiter=",", skiprows=4)
    assert rows.shape == (1001, 1 + 3 + 3 * 4) and np.abs(rows[:, 1:3]).max() <= 0.08
    log = np.vstack([rows[:-1], rows[:-1], rows])[:, [0, *range(4, 8), *range(12, 16)]]
    log[:, 0] = np.arange(len(log)) / 1000.0
    np.savetxt(tmp_path / "log.csv", log, delimiter=",", header=HEAD, comments="")
    assert calib("recall", out, tmp_path / "log.csv", "--out", tmp_path / "mean.csv") == 0
    mean = np.loadtxt(tmp_path / "mean.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(mean[:, 1:5], rows[:-1, 4:8], atol=1e-6)


@pytest.mark.slow
def test_new_motion_adds_to_both_loads(folder, tmp_path):
    """Predicted σ are those of (C⁻¹ + ∫ Σ WᵀW / s²)⁻¹, W of the encoders' rows; a payload's come from its own run.

    The errors s are those of the identification's own band.
    """
    files, options = [folder / "empty.csv", folder / "load.csv"], folder / "options.toml"
    assert calib("identify", "dualv", *files, "--options", options, "--out", tmp_path / "id", "--no-plots") == 0
    stored = json.loads((tmp_path / "id" / "metrics.json").read_text())
    assert stored.pop("error_bands")["density"][0] == pytest.approx(3 * [1.0])
    (tmp_path / "id" / "metrics.json").write_text(json.dumps(stored))
    settings = api.ExcitationSettings(
        period=1.0, harmonics=2, starts=1, evaluations=4, outlook=False, loads=("none", "5"), columns=("essential",)
    )
    found = api.design_excitation("dualv", settings, after=tmp_path / "id")
    names, covariance = read_covariance(tmp_path / "id")
    density = json.loads((tmp_path / "id" / "metrics.json").read_text())["error_density"]
    model = make_parallel_model(find("dualv").mechanism, ["Fv Fc off"], v0=0.01, payloads=["5"])
    kept = [model.names.index(name if name in model.names else name[:-1]) for name in names]
    _, q, v, a = found.sampled(500.0)
    total = np.linalg.inv(covariance)
    for carried in ((), ("5",)):
        W = model.regressor(q, v, a, carried=carried)[:-1][:, :, kept] / np.sqrt(density)[:, None]
        total += np.einsum("nri,nrj->ij", W, W) / 500.0
    wanted = np.sqrt(np.diag(np.linalg.inv(total)))
    np.testing.assert_allclose([row.sigma for row in found.predicted], wanted, rtol=0.02)
    np.testing.assert_allclose([row.sigma_before for row in found.predicted], np.sqrt(np.diag(covariance)), rtol=1e-4)
    assert found.outlook.own.torque_sigma_share < found.outlook.before
    assert (found.save(tmp_path / "motion", plots=False) / "prediction.csv").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("line", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_plan_keeps_limits_and_waypoints(folder, tmp_path, line):
    """Plan keeps the limits, and passes the waypoints."""
    out = tmp_path / "plan"
    assert calib("plan", "dualv", "--waypoints", folder / "way.csv", "--out", out, *(["--line"] * line)) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert max(metrics["peak_torque"]) <= 127.0 and min(metrics["margins"]["torque"]["joints"]) < 0.02
    rows = np.loadtxt(out / "motion.csv", delimiter=",", skiprows=4)
    for point in ([0.05, 0.04, np.radians(15)], [-0.06, 0.02, np.radians(-20)], [0.0, 0.0, 0.0]):
        assert np.abs(rows[:, 1:4] - point).max(axis=1).min() < 2e-3


def test_the_api_fits_what_the_commands_fit(folder):
    fitted = api.fit_geometry("dualv", folder / "poses.csv", api.FitSettings(holdout=0.3))
    assert fitted.verdict.level == "pass" and "held out" in fitted.verdict.reason


@pytest.mark.slow
def test_api_works_as_the_commands_do(folder, tmp_path):
    """The API identifies and plans as the commands do."""
    robot = api.load("dualv")
    fitted = api.fit_geometry(robot, folder / "poses.csv", api.FitSettings(holdout=0.3))
    files = [folder / "empty.csv", folder / "load.csv"]
    model = api.identify_dynamics("dualv", files, options=folder / "options.toml")
    assert model.verdict.level == "marginal" and "no unseen motion was given" in str(model)
    judged = api.validate(model, folder / "other.csv")
    assert judged.verdict.level == "pass" and judged.estimate is not None
    metrics = json.loads((judged.save(tmp_path / "api", plots=False) / "metrics.json").read_text())
    assert metrics == judged.to_dict() and list(metrics["validation"]) == ["other.csv"]
    still = model.robot.mechanism.home.q[:, robot.mechanism.robot.actuated]
    assert np.abs(judged.torques(still, 0 * still, 0 * still)).max() < 1.0
    assert api.plan_motion(fitted.robot, folder / "way.csv", model=judged).duration > 0.1
    assert "robot.xml (loops closed)" in api.export(judged, tmp_path / "exported")[0]
    with pytest.raises(api.CalibError, match="urdf is for serial arms only"):
        api.export(judged, tmp_path / "no", urdf=tmp_path / "robot.urdf")


def test_api_chooses_no_parallel_poses():
    """The API chooses no poses for a parallel robot."""
    with pytest.raises(api.CalibError):
        api.select_poses(api.load("dualv"))


NOT_THERE = ("empty.csv", "absent/load.csv", "--options", "options.toml", "--no-plots")


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        pytest.param(
            ("identify", "dualv", "reversed.csv", "--validate", "other.csv", "--no-plots"),
            1,
            "fail above 30 %",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            ("fit", "dualv", "wrong.csv", "--validate", "poses.csv"),
            1,
            "worse than the nominal",
            marks=pytest.mark.slow,
        ),
        pytest.param(("identify", "dualv", *NOT_THERE), 0, "seems absent from its recordings", marks=pytest.mark.slow),
        pytest.param(
            ("identify", "dualv", NOT_THERE[1], *NOT_THERE[2:]), 0, "record a run without it", marks=pytest.mark.slow
        ),
        *(
            (words, 2, said)
            for words, said in (
                (("identify", "dualv", "three.csv"), "3 joints"),
                (("identify", "dualv", "swapped.csv"), "swapped.csv: sample 1: the loops"),
                (("identify", "dualv", "load.csv", "--method", "didim"), "needs the closed loop"),
                (("identify", "dualv", "load.csv", "--friction", "stribeck"), "standard friction only"),
                (("fit", "dualv", "passive.csv"), "passive joint"),
                (("fit", "dualv", "three.csv"), "'motor1' is missing"),
                (("excite", "dualv", "--lock", "motor1"), "lock is for serial arms"),
                (("excite", "dualv", "--goal", "wrist=0.1"), "'wrist' is not one of raw, normalised"),
                (("excite", "dualv", "--options", "options.toml", "--load", "tool"), "payload 'tool' is not one of 5"),
                (("plan", "dualv", "--waypoints", "empty.csv"), "neither the platform's coordinates (x, y, rz)"),
                (("plan", "dualv", "--waypoints", "outside.csv"), "waypoint 2: joint 1 at 0.3"),
                (("plan", "dualv", "--waypoints", "way.csv", "--shorten", 5), "shorten is for serial arms"),
                (("fit", "dualv", "poses.csv", "--model", "stiffness"), "model 'stiffness' is for serial arms"),
                (
                    ("fit", "dualv", "readings.csv", "--tolerance", 0.1),
                    "a tolerance needs a measured platform position",
                ),
                (("identify", "dualv", "load.csv", "--base", "link0"), "base 'link0'"),
                (("export", "dualv"), "give --into FOLDER"),
                (("select", "dualv"), "choosing poses is for serial arms"),
                (("new", "--robot", "dualv", "--instrument", "cmm"), "a guided session is for serial arms"),
            )
        ),
    ],
)
def test_what_is_wrong_is_said(folder, tmp_path, capsys, words, code, said):
    command, *rest = [folder / word if str(word).endswith((".csv", ".toml")) else word for word in words]
    out = tmp_path / "out"
    given = [out, *rest] if command == "new" else [*rest, "--out", out]
    assert calib(command, *given) == code
    assert said in "".join(capsys.readouterr())


@pytest.mark.slow
def test_unread_and_dropped_parts_are_noted(folder, tmp_path):
    """Contradicting encoders, unread passive joints, uncarried payloads and dropped parameters are noted."""
    words = ["--options", folder / "dropped.toml", "--out", tmp_path, "--no-plots"]
    assert calib("identify", "dualv", folder / "shifted.csv", *words) == 0
    noticed = {one["code"]: one["values"] for one in json.loads((tmp_path / "metrics.json").read_text())["noticed"]}
    assert {"encoders-contradict", "passive-joints-unread", "payload-never"} <= set(noticed)
    assert noticed["needed-parameters-dropped"]["names"] == ["Fc11"]


def test_parallel_robots_are_no_serial_arms():
    """Parallel robots are in no list of serial arms."""
    parallel = parallel_robot.library()
    assert not set(parallel) & set(library.names()) and "dualv" in parallel
