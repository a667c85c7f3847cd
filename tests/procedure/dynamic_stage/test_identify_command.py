"""``calib identify``: the contract of its metrics, and what happens to input that cannot be."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import planted_motion as planted
import pytest
import without_figures

from calib.errors import CalibError


def run(*arguments: object) -> int:
    return without_figures.run("identify", *arguments)


@pytest.mark.slow
def test_the_folder_keeps_its_contract(robot, tmp_path, capsys):
    train, other = planted.write(tmp_path, "train.npz", 0), planted.write(tmp_path, "other.npz", 1)
    out = tmp_path / "out"
    drawn = ("--out", out, "--friction", "standard", "--plots", "svg")
    assert run(robot, f"{train}@0:18", "--validate", other, f"{train}@18.5:", *drawn) == 0
    found = json.loads((out / "metrics.json").read_text())
    assert list(found["identification"]) == ["train.npz@0:18"]
    assert list(found["validation"]) == ["other.npz", "train.npz@18.5:"]
    for group in (found["identification"], found["validation"]):
        for scored in group.values():
            for name in ("raw", "filtered", "moving"):
                relative = scored[name]["relative_error_percent"]
                assert len(relative["joints"]) == 3 == len(scored[name]["rms"]) and relative["total"] > 0.0
    assert found["parameters"] == {"standard": 42, "base": 25, "essential": found["parameters"]["essential"]}
    assert 10 < found["parameters"]["essential"] <= 25
    assert found["condition_number"]["raw"] > found["condition_number"]["normalised"] > 1.0
    assert found["verdict"] == "pass" and found["ladder"][0]["model"] == "standard"
    rows = list(csv.DictReader((out / "estimate.csv").open()))
    assert list(rows[0]) == [
        "name",
        "expression",
        "unit",
        "value",
        "sigma",
        "rsd [%]",
        "essential",
        "sigma_torque",
        "sigma_geometry",
    ]
    assert any("YY2" in row["expression"] for row in rows if row["name"] == "ZZ1R")
    assert {"dynamics.json", "covariance.csv", "robot.toml", "plot_torque_1.svg", "plot_friction.svg"} <= {
        path.name for path in out.iterdir()
    }
    assert "verdict: pass" in capsys.readouterr().out
    assert run(robot, train, *drawn[:-2]) == 0, "an own folder may be written again"
    assert not (out / "plot_torque_3.svg").exists(), "plots of the earlier run are gone"


@pytest.mark.slow
def test_a_repeat_is_no_evidence(robot, tmp_path, capsys):
    train = planted.write(tmp_path, "train.npz", 0)
    out = tmp_path / "out"
    assert run(robot, f"{train}@0:10", "--validate", f"{train}@10:", "--out", out, "--friction", "standard") == 0
    found = json.loads((out / "metrics.json").read_text())
    assert found["validation"]["train.npz@10:"]["evidence"] is False
    assert (found["verdict"], found["code"]) == ("marginal", "validation-repeats") and found["advice"]
    assert {"validation-repeats", "repeats-training"} <= {one["code"] for one in found["noticed"]}
    assert "is no evidence" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "said"),
    [
        pytest.param("rows = 'power'", False, marks=pytest.mark.slow),
        pytest.param("[payload.tool]\nmass = 2.0", True, marks=pytest.mark.slow),
    ],
)
def test_uncarried_payload_is_said(robot, tmp_path, options, said):
    """Power is explained, and a payload that is never carried is said."""
    train, other = planted.write(tmp_path, "train.npz", 0), planted.write(tmp_path, "other.npz", 1)
    (tmp_path / "options.toml").write_text(options)
    chosen = ("--options", tmp_path / "options.toml", "--friction", "standard", "--out", tmp_path / "out")
    assert run(robot, train, "--validate", other, *chosen) == 0
    found = json.loads((tmp_path / "out/metrics.json").read_text())
    assert found["validation"]["other.npz"]["filtered"]["relative_error_percent"]["total"] < 5.0
    assert ("payload-never" in {one["code"] for one in found["noticed"]}) is said


@pytest.mark.slow
def test_calibrated_folder_serves(tmp_path):
    """The calibrated robot's folder serves, and the nominal one chooses columns."""
    from calib.robot import description

    nominal = planted.arm()
    calibrated = nominal.with_values({"up": np.pi / 2 + 0.004, "upper": 0.502})
    folder = tmp_path / "fit"
    description.write(folder / "robot.toml", calibrated, {"provenance": {"nominal": nominal.values.tolist()}})
    train = planted.write(tmp_path, "train.npz", 0)
    assert run(folder, train, "--out", tmp_path / "out", "--friction", "standard") == 0
    found = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert found["parameters"]["base"] == 25, "the tilt's weak columns stay out"
    assert run(folder, train, "--out", folder) == 2, "the robot's own folder is not for --out"


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda t, q, tau: (t[:15], q[:15], tau[:15]), "15 samples are too few"),
        (lambda t, q, tau: (t, np.hstack([q, q]), np.hstack([tau, tau])), "has 6 joints"),
        (lambda t, q, tau: (t, q, tau * [1, 1, 0] + [0, 0, 1]), "was it logged"),
        (lambda t, q, tau: (t, 0 * q + q[0], tau), "no joint moves"),
    ],
)
def test_impossible_input_writes_nothing(robot, tmp_path, capsys, spoil, said):
    """What a reader refuses: tests/data/recordings."""
    path, good = tmp_path / "bad.npz", planted.series(0)
    np.savez(path, **dict(zip(("t", "q", "tau"), spoil(good["t"], good["q"], good["tau"]))))
    assert run(robot, path, "--out", tmp_path / "out") == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists() and not list(tmp_path.glob(".out*"))


@pytest.mark.slow
def test_reversed_torques_are_refused(robot, tmp_path, capsys):
    """Reversed torques are refused, and one reversed joint fails."""
    good = planted.series(0)
    every, one = tmp_path / "reversed.npz", tmp_path / "one.npz"
    np.savez(every, t=good["t"], q=good["q"], tau=-good["tau"])
    np.savez(one, t=good["t"], q=good["q"], tau=good["tau"] * np.array([1.0, 1.0, -1.0]))
    assert run(robot, every, "--out", tmp_path / "out", "--friction", "standard") == 2
    assert "sign is reversed" in capsys.readouterr().err and not (tmp_path / "out").exists()
    assert run(robot, one, "--out", tmp_path / "out", "--friction", "standard") == 1
    assert "friction of joint 3 adds energy" in capsys.readouterr().out


@pytest.mark.slow
def test_unlike_units_are_pointed_at(robot, tmp_path, capsys):
    """Columns in different units are pointed at."""
    good = planted.series(0)
    path = tmp_path / "mixed.csv"
    table = np.column_stack([good["t"], np.degrees(good["q"][:, :1]), good["q"][:, 1:], good["tau"]])
    header = "t,q1 [deg],q2,q3,tau1,tau2,tau3"
    np.savetxt(path, table, delimiter=",", header=header, comments="")
    assert run(robot, path, "--out", tmp_path / "out", "--friction", "standard", "-v") == 0
    assert "have different units (deg, no unit)" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("frition = 'auto'", "frition"),
        ("friction = 'heavy'", "friction: expected one of"),
        ("[filter]\ncutof = 3.0", "filter: there is no key 'cutof'"),
        ("[filter]\ncutoff = 120.0", "Nyquist"),
        ("[[coupling]]\njoints = [1]", "coupling"),
        ("[[term]]\nname = 'K'\nshape = 'sine'\njoint = 2", "needs (order, speed)"),
        ('[files."other.npz"]\npayload = []', "names none of the recordings"),
        ("drives = ['Ia', 'Fv']", "drives: 2 values for 3 joints"),
        ("drives = 'Ia Fx'", "drive term 'Fx'"),
        ("prior = 'cad'\nmethod = 'iv'", "controller"),
        pytest.param("keep = ['ZZ9']", "ZZ9", marks=pytest.mark.slow),
        ("gains = [1.0, 2.0]", "gains: 2 values for 3 joints"),
        ("[gain_identification]\nunloaded = 'train.npz'\nloaded = 'train.npz'", "payload"),
        ("not toml", "is not a TOML file"),
    ],
)
def test_options_are_checked_for_existence(robot, tmp_path, capsys, text, said):
    """Options are held against what exists."""
    train, identify_options = planted.write(tmp_path, "train.npz", 0), tmp_path / "options.toml"
    identify_options.write_text(text)
    code = run(robot, train, "--options", identify_options, "--out", tmp_path / "out")
    assert code == 2 and said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_unseen_payload_needs_a_centre(robot, tmp_path, capsys):
    """A payload of unknown centre on unseen motion alone is refused."""
    train, unseen = planted.write(tmp_path, "train.npz", 0), planted.write(tmp_path, "other.npz", 1)
    identify_options = tmp_path / "options.toml"
    identify_options.write_text('[payload.tool]\nmass = 2.0\n[files."other.npz"]\npayload = ["tool"]')
    code = run(robot, train, "--validate", unseen, "--options", identify_options, "--out", tmp_path / "out")
    assert code == 2 and "payload 'tool' of other.npz" in capsys.readouterr().err


def test_other_folders_are_not_overwritten(robot, tmp_path, capsys):
    train, out = planted.write(tmp_path, "train.npz", 0), tmp_path / "out"
    out.mkdir()
    (out / "estimate.csv").write_text("mine")
    assert run(robot, train, "--out", out) == 2
    assert (out / "estimate.csv").read_text() == "mine"
    assert run(robot, train, train, "--out", tmp_path / "b") == 2
    assert "is listed twice" in capsys.readouterr().err


def test_documented_option_keys_are_read(tmp_path):
    """Every key of the documented options is read."""
    from calib.identification import identify_options

    text = identify_options.__doc__.split("from 1::\n\n", 1)[1]
    path = Path(tmp_path / "documented.toml")
    path.write_text("\n".join(line[4:] for line in text.splitlines()))
    found = identify_options.read_options(path)
    assert found.settings.ratio == 20.0 and found.gain_pair is not None
    assert found.file_settings("x/run_load.npz").payload == ("tool",)
    assert found.settings.couplings[0].joints == (4, 5)


def test_model_reads_back_and_predicts_alike(robot, tmp_path):
    """The model comes back from its folder and predicts the same."""
    from calib.identification.model_file import read_dynamics
    from calib.identification.prediction import predict

    train, out = planted.write(tmp_path, "train.npz", 0), tmp_path / "out"
    assert run(robot, train, "--out", out, "--friction", "presliding") == 0
    _, dynamics = read_dynamics(out)
    case = planted.case("train.npz", 0)
    residual = case.target - predict(dynamics, case)
    metrics = json.loads((out / "metrics.json").read_text())
    rms = metrics["identification"]["train.npz"]["raw"]["rms"]
    np.testing.assert_allclose(np.sqrt(np.mean(residual**2, axis=0)), rms, rtol=0.02)
    (out / "dynamics.json").write_text("{}")
    with pytest.raises(CalibError, match="damaged or of another version"):
        read_dynamics(out)


@pytest.mark.parametrize(
    "kind", [pytest.param("mcap", marks=pytest.mark.slow), pytest.param("sqlite3", marks=pytest.mark.slow)]
)
def test_two_publisher_bag_equals_archive(robot, tmp_path, kind):
    """A bag of two publishers tells what the archive tells."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    names = ("sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    state, header, stamp = (store.types[name] for name in names)
    good = {name: series[:1600] for name, series in planted.series(0).items()}
    order, joints = [2, 0, 1], ["joint3", "finger", "joint1", "joint2"]
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin[kind.upper()]) as writer:
        arm, gripper = (
            writer.add_connection(topic, state.__msgtype__, typestore=store)
            for topic in ("/joint_states", "/gripper/joint_states")
        )
        for k, t in enumerate(good["t"]):
            ns = round(t * 1e9) + 10**18
            time = header(stamp=stamp(sec=ns // 10**9, nanosec=ns % 10**9), frame_id="")
            q, tau = (np.insert(good[name][k, order], 1, 0.1) for name in ("q", "tau"))
            message = state(header=time, name=joints, position=q, velocity=np.zeros(4), effort=tau)
            writer.write(arm, ns, store.serialize_cdr(message, state.__msgtype__))
            alone = state(header=time, name=["finger"], position=q[:1], velocity=q[:1], effort=q[:1])
            writer.write(arm if k % 7 == 0 else gripper, ns + 10, store.serialize_cdr(alone, state.__msgtype__))
    np.savez(tmp_path / "same.npz", t=good["t"], q=good["q"], dq=np.zeros_like(good["q"]), tau=good["tau"])
    found = []
    for name in ("bag", "same.npz"):
        assert run(robot, tmp_path / name, "--out", tmp_path / f"out_{name}", "--friction", "standard") == 0
        rows = list(csv.DictReader((tmp_path / f"out_{name}" / "estimate.csv").open()))
        found.append([(float(row["value"]), float(row["sigma"])) for row in rows])
    of_bag, of_archive = np.array(found[0]), np.array(found[1])
    np.testing.assert_allclose(of_bag[:, 0], of_archive[:, 0], atol=1e-3 * of_archive[:, 1].max())


def test_earlier_identification_is_carried_on(robot, tmp_path, capsys):
    """The folder states the choice, and a later identification keeps it; another friction is refused."""
    first, second = planted.write(tmp_path, "first.npz", 0), planted.write(tmp_path, "second.npz", 1)
    earlier, later = tmp_path / "earlier", tmp_path / "later"
    assert run(robot, f"{first}@0:6", "--out", earlier) == 0
    assert run(robot, f"{first}@0:6", f"{second}@0:6", "--after", earlier, "--out", later) == 0
    choice, continued = (json.loads((out / "metrics.json").read_text())["choice"] for out in (earlier, later))
    assert continued["sizes"] == pytest.approx(choice["sizes"]) and len(choice["sizes"]) > 5
    assert set(choice["terms"]) <= set(continued["terms"])

    refused = ("--after", earlier, "--out", tmp_path / "refused")
    for options, message in (
        (("--friction", "standard"), "states the friction, and so does friction = 'standard'"),
        (("--method", "ols"), "method 'ols' has no prior that could be carried on; use wls"),
    ):
        capsys.readouterr()
        assert run(robot, f"{second}@0:6", *refused, *options) == 2
        assert message in capsys.readouterr().err
    (tmp_path / "identify.toml").write_text('prior = "none"\n')
    assert run(robot, f"{second}@0:6", *refused, "--options", tmp_path / "identify.toml") == 2
    assert "prior = 'none' leaves nothing of the prior" in capsys.readouterr().err
    metrics = json.loads((earlier / "metrics.json").read_text())
    damaged = {name: -size for name, size in choice["sizes"].items()}
    for stated, message in (
        (None, "does not state its choice; identify again"),
        (choice | {"sizes": damaged}, "are not positive numbers"),
        (choice | {"tempering": 0.0}, "are not positive numbers"),
        (choice | {"ridges": [*choice["ridges"], 1.0]}, "not one ridge and group per term"),
    ):
        (earlier / "metrics.json").write_text(json.dumps(metrics | {"choice": stated}))
        assert run(robot, f"{second}@0:6", *refused) == 2
        assert message in capsys.readouterr().err


def test_validation_on_the_earlier_recording_is_named(robot, tmp_path):
    """The friction terms that are carried on were chosen from it: under any name it is not wholly unseen."""
    first, second = planted.write(tmp_path, "first.npz", 0), planted.write(tmp_path, "second.npz", 1)
    copy = shutil.copy(first, tmp_path / "copy.npz")
    earlier = tmp_path / "earlier"
    assert run(robot, f"{first}@0:6", "--out", earlier) == 0
    for validated, named in ((copy, True), (planted.write(tmp_path, "third.npz", 2), False)):
        out = tmp_path / f"later_{named}"
        run(robot, f"{second}@0:6", "--after", earlier, "--validate", validated, "--out", out)
        codes = [noticed["code"] for noticed in json.loads((out / "metrics.json").read_text())["noticed"]]
        assert ("earlier-recording-validates" in codes) == named
