"""The Python API: few names, each documented; what it returns is what the commands write."""

import csv
import inspect
import json
import sys
import tomllib
from dataclasses import replace
from html import unescape
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import planted_motion as planted
import pytest
from without_figures import run

import calib
from calib import cli
from calib.errors import MeasurementError, UsageError
from calib.identification.identify_options import options_of, parse_options
from calib.robot import description
from calib.simulation.cell import measure, write_measured
from calib.simulation.virtual_cells import perturbed_cell


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with poses of a UR5 that is a little off."""
    folder = tmp_path_factory.mktemp("cell")
    made = perturbed_cell(calib.load("ur5").chain, seed=1)
    for name, count, seed in (("measured", 60, 0), ("other", 30, 5)):
        q = np.random.default_rng(seed).uniform(-2.0, 2.0, (count, 6))
        write_measured(measure(made, q, seed=seed + 1), folder / f"{name}.csv")
    return folder


@pytest.fixture(scope="module")
def fitted(cell: Path) -> calib.GeometryFit:
    settings = calib.FitSettings(model="geometry", holdout=0.25)
    return calib.fit_geometry("ur5", cell / "measured.csv", settings)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A planted arm and two logs of it."""
    folder = tmp_path_factory.mktemp("logs")
    description.write(folder / "robot.toml", planted.arm())
    for name, seed in (("train", 0), ("other", 7)):
        np.savez(folder / f"{name}.npz", **planted.series(seed, noise=0.02))
    return folder


@pytest.fixture(scope="module")
def model(logs: Path) -> calib.DynamicsModel:
    train, other = logs / "train.npz", logs / "other.npz"
    return calib.identify_dynamics(logs / "robot.toml", train, validate=other, friction="standard")


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: calib.fit_geometry("ur5", "a.csv", 0.25), "fit_geometry: settings: expected FitSettings or None"),
        (lambda: calib.fit_geometry("ur5", "a.csv", holdout=0.25), "fit_geometry: .*keyword argument 'holdout'"),
        (lambda: calib.load(5), "load: robot: expected a text or a path, found 5"),
        (lambda: calib.read_poses("a.csv", None), "read_poses: robot: expected a text, a path or CalibratedChain"),
        (lambda: calib.select_poses("ur5", "40"), "select_poses: count: expected a whole number, found '40'"),
        (lambda: calib.select_poses("ur5", True), "select_poses: count: expected a whole number, found True"),
        (lambda: calib.identify_dynamics("ur5", ["a.npz", 3]), "identify_dynamics: recordings: expected"),
        (lambda: calib.compensate("fit", "t.csv", start="0,0"), "compensate: start: expected several, each a number"),
        (lambda: calib.compensate("fit", "t.csv", tolerance=(1.0,)), "compensate: tolerance: expected 2 values, each"),
        (
            lambda: calib.validate("fit", "b.csv"),
            "validate: result: expected GeometryFit, DynamicsModel or MechanismResult",
        ),
        (lambda: calib.new_session("s", "ur5", "cmm", poses=4.5), "new_session: poses: expected a whole number"),
        (lambda: calib.new_session("s", "ur5", "cmm", periode=4.5), "no key 'periode' .did you mean 'period'"),
        (lambda: calib.ExcitationSettings(period="a"), "ExcitationSettings: period: expected a number above 0"),
        (
            lambda: calib.ExcitationSettings(goals="raw=35"),
            "ExcitationSettings: goals: expected a list, found 'raw=35'",
        ),
        (lambda: calib.PlanSettings(lines=1), "PlanSettings: lines: expected true or false, found 1"),
        (lambda: calib.SelectionSettings(tools=(1.0, 2.0, 3.0)), "SelectionSettings: tools: expected x,y,z"),
        (lambda: calib.FitSettings(tolerance="low"), "FitSettings: tolerance: cannot read 'low' as a number"),
        (lambda: calib.FitSettings(tolerance=0.0), "tolerance: expected a number above 0"),
        (lambda: calib.FitSettings(stations="two"), "stations: expected one of each, one, found 'two'"),
        (
            lambda: calib.SelectionSettings(kind="positions"),
            "kind: expected one of pose, position .did you mean 'position'",
        ),
        (lambda: calib.SelectionSettings(method="detmx"), "method: expected one of detmax"),
        (lambda: calib.ExcitationSettings(goals=("foo=3",)), "goal 'foo=3': 'foo' is unknown; use raw"),
        (lambda: calib.ExcitationSettings(hard=("logdet",)), "goal 'logdet': expected NAME=NUMBER"),
        (lambda: calib.load(""), "the robot's name is empty"),
        (lambda: calib.FitSettings(holdout=1.5), "holdout: expected a share"),
        (lambda: calib.FitSettings(model="geometri"), "model: expected one of"),
        (lambda: calib.SelectionSettings(index="O9"), "O9"),
        (lambda: calib.ExcitationSettings(period=-1.0), "period"),
    ],
)
def test_argument_of_wrong_type_is_named(call, words):
    """An argument of another type is refused by its name."""
    with pytest.raises(calib.CalibError, match=words):
        call()


def test_numpy_scalars_and_arrays_accepted():
    """NumPy's numbers and sequences are numbers and sequences."""
    start, tool = np.zeros(6), np.array([[0.1, 0.0, 0.0]])
    assert calib.ExcitationSettings(period=np.float32(5), seed=np.int64(3), start=start, goals=["raw=35"]).seed == 3
    assert calib.SelectionSettings(tools=tool, seconds=2).tools == ((0.1, 0.0, 0.0),)  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_data_frame_is_refused_by_its_name():
    frame = pytest.importorskip("pandas").DataFrame({"q1": [0.0]})
    with pytest.raises(UsageError, match=r"measured: .*found a DataFrame: write it"):
        calib.fit_geometry("ur5", frame)


def test_at_most_41_names_all_documented():
    assert len(calib.__all__) <= 41 and set(calib.__all__) <= set(dir(calib))
    for name in calib.__all__:
        found = getattr(calib, name)
        assert (found.__doc__ or "").strip(), name
        if inspect.isfunction(found):
            named = set(inspect.signature(found).parameters)
            assert all(parameter in found.__doc__ for parameter in named), name
    with pytest.raises(AttributeError):
        calib.no_such_name  # noqa: B018


def test_version_and_methods_are_offered(capsys):
    """The version and the methods can be asked for."""
    assert cli.run(["--version"]) == 0 and calib.__version__ in capsys.readouterr().out
    assert {"wls", "iv", "didim"} <= {one.name for one in calib.methods()}


def test_settings_are_keys_of_options_file():
    """Settings of an identification are the keys of the options file."""
    stated = calib.IdentifySettings(method="iv", filter={"cutoff": np.float64(20.0)}, keep=["ZZ1R"])  # type: ignore[arg-type]
    assert options_of(stated) == parse_options(
        {"method": "iv", "filter": {"cutoff": 20.0}, "keep": ["ZZ1R"]}, "settings"
    )
    with pytest.raises(UsageError, match=r"IdentifySettings: method: expected one of .*did you mean 'iv'"):
        calib.IdentifySettings(method="ivv")


def test_a_fit_is_what_the_command_writes(fitted, cell, tmp_path, capsys):
    command = ["fit", "ur5", str(cell / "measured.csv"), "--model", "geometry", "--holdout", "0.25", "--no-plots"]
    assert cli.run([*command, "--out", str(tmp_path / "command")]) == 0
    said = capsys.readouterr().out
    fitted.save(tmp_path / "script", plots=False)
    for name in ("estimate.csv", "covariance.csv", "robot.toml", "chain_covariance.csv", "metrics.json"):
        assert (tmp_path / "script" / name).read_bytes() == (tmp_path / "command" / name).read_bytes(), name
    assert json.loads(json.dumps(fitted.to_dict())) == json.loads((tmp_path / "script/metrics.json").read_text())
    assert all(line.strip() in " ".join(said.split()) for line in [f"verdict: {fitted.verdict.level}"])


@pytest.mark.slow
def test_measurements_and_robots_in_memory(fitted, cell):
    """Measurements and robots in memory give what their files give."""
    robot = calib.load("ur5")
    blocks = calib.read_poses(cell / "measured.csv", robot)
    assert len(blocks[0]) == len(calib.read_poses(cell / "measured.csv", "ur5")[0]) == 60
    again = calib.fit_geometry(robot, blocks, fitted.settings)
    np.testing.assert_array_equal(again.estimate.values, fitted.estimate.values)
    np.testing.assert_array_equal(again.robot.covariance, fitted.robot.covariance)


def test_measurements_in_memory_are_checked(fitted, cell):
    """Measurements in memory get the checks of files."""
    block = calib.read_poses(cell / "measured.csv", "ur5")[0]
    odd = np.array(block.position)
    odd[2, 1] = np.nan
    for wrong, words in (
        (replace(block, q=np.rad2deg(10.0 * block.q)), r"measured\.csv, row 1, .*outside the limits"),
        (replace(block, position=odd), r"row 3, column 'y': found an empty or NaN cell"),
        (replace(block, position=1e3 * block.position), "if it is in mm"),
        (replace(block, q=block.q[:, :5]), r"q has shape \(60, 5\)"),
    ):
        with pytest.raises(MeasurementError, match=words):
            calib.fit_geometry("ur5", [wrong, cell / "other.csv"], fitted.settings)


@pytest.mark.slow
def test_readers_results_stand_among_files(fitted, cell):
    """What readers return may stand among files."""
    both = [calib.read_poses(cell / "measured.csv", "ur5"), cell / "other.csv"]
    assert len(calib.fit_geometry("ur5", both, calib.FitSettings(model="geometry")).inputs.fit) == 2
    with pytest.raises(UsageError, match="unseen is empty"):
        calib.validate(fitted, [])
    with pytest.raises(UsageError, match="save: out: expected a text or a path, found None"):
        fitted.save(None)
    np.savez(cell / "log.npz", q=np.zeros(3))
    with pytest.raises(MeasurementError, match="is an archive"):
        calib.validate(fitted, cell / "log.npz")


def test_a_robot_prints_as_a_short_table(fitted):
    lines = str(fitted.robot).splitlines()
    assert len(lines) == 8 and "calibrated" in lines[0] and " revolute [rad] " in lines[2]
    assert len(repr(fitted)) < 120 and "ur5" in repr(fitted)
    assert repr(calib.load("ur5")).startswith("<CalibratedChain ur5: 6 joints, nominal geometry")


@pytest.mark.parametrize(
    "stamps, words", [(lambda t: t[::-1], "time runs backwards"), (lambda t: np.nan * t, "column 't': found nan")]
)
def test_impossible_time_in_memory_is_told(logs, stamps, words):
    """An impossible time in recordings in memory is told."""
    given = calib.read_recording(logs / "train.npz", logs / "robot.toml")
    with pytest.raises(MeasurementError, match=words):
        calib.identify_dynamics(logs / "robot.toml", replace(given, t=stamps(np.array(given.t))))


@pytest.mark.slow
def test_later_validation_equals_immediate(fitted, cell):
    """Validation afterwards is validation at once."""
    robot, other = "ur5", cell / "other.csv"
    at_once = calib.fit_geometry(robot, cell / "measured.csv", fitted.settings, validate=other)
    later = calib.validate(fitted, other)
    assert later.to_dict() == at_once.to_dict()
    assert "other.csv" in later.to_dict()["validation"] and "other.csv" not in fitted.to_dict()["validation"]


@pytest.mark.slow
def test_results_print_ladder_and_verdict(fitted, model):
    """Results print the ladder, the errors and the verdict."""
    shown = str(fitted)
    assert fitted.verdict.reason.split(";")[0] in " ".join(shown.split()) and "nominal" in shown
    assert model.verdict.level in str(model) and "other.npz" in str(model)
    assert set(fitted.plot()) >= {"position", "parameters"} and set(model.plot()) >= {"torque_1", "friction"}


@pytest.mark.slow
def test_notebook_shows_page_and_verdict(fitted, model):
    """A notebook shows the page, and a verdict equals its name."""
    for result in (fitted, model):
        assert result.verdict == result.verdict.level and result.verdict != "other"
        assert result.verdict.reason[1:40] in unescape(result._repr_html_())
        shown = result._repr_mimebundle_()
        assert shown["text/plain"] == str(result) and shown["text/html"].startswith("<iframe")
        assert unescape(shown["text/html"]).count("<html") == 1 and "<html" not in shown["text/html"]


def test_in_a_notebook_results_print_as_text(fitted, model, monkeypatch):
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    assert str(fitted).startswith(f"verdict: {fitted.verdict.level}") and "torque errors" in str(model)


def test_one_figure_by_its_name(fitted, model):
    assert fitted.plot("position")._repr_png_().startswith(b"\x89PNG")
    with pytest.raises(UsageError, match=r"plot 'frictoin' is not one of torque_1.*did you mean 'friction'"):
        model.plot("frictoin")


def test_tab_offers_what_there_is(fitted, model):
    """Tab offers what there is and no more."""
    assert "annotations" not in dir(calib) and "TYPE_CHECKING" not in dir(calib)
    for result in (fitted, model):
        wanted = [name for name in dir(result) if name != "residuals"]
        assert {"verdict", "plot", "save", "robot"} <= set(wanted) and not [name for name in wanted if name[0] == "_"]
        assert all(hasattr(result, name) for name in wanted)
    assert all(hasattr(calib.ExcitationDesign, name) for name in ("sampled", "plot", "save", "to_dict"))


def test_residuals_are_columns_without_pandas(fitted, model, tmp_path, monkeypatch):
    """Residuals are numpy columns; pandas is needed by those who ask for a data frame only."""
    monkeypatch.setitem(sys.modules, "pandas", None)
    residuals = fitted.residuals
    with (fitted.save(tmp_path / "fit", plots=False) / "residuals.csv").open(newline="") as file:
        head, first, *rows = csv.reader(file)
    assert list(residuals.columns) == head and len(residuals) == len(rows) + 1
    assert [residuals[head[5]][0], residuals[head[11]][0]] == pytest.approx([float(first[5]), float(first[11])])
    assert set(residuals["set"]) <= {"fit", "held out", "validation"}
    structured = np.asarray(residuals)
    np.testing.assert_array_equal(structured["size [mm]"], residuals["size [mm]"])
    assert next(iter(residuals))[:3] == tuple(residuals[name][0] for name in head[:3])
    assert residuals.to_dict()["row"] == residuals["row"].tolist()
    assert "dx [mm]" in str(residuals) and f"{len(residuals)} rows" in repr(residuals)
    with pytest.raises(UsageError, match=r"column 'dx \[m\]'.*did you mean 'dx \[mm\]'"):
        residuals["dx [m]"]

    torques = model.residuals
    assert torques.columns[:3] == ("file", "t [s]", "joint1 [N m]")
    assert set(torques["file"]) == {"train.npz", "other.npz"}
    last = model.inputs.unseen[0].target[-1] - model.predictions["other.npz"][-1]
    np.testing.assert_array_equal(list(torques)[-1][2:], last)

    with pytest.raises(UsageError, match=r"pandas, for data frames, .*: pip install 'armature-calib\[pandas\]'"):
        residuals.to_dataframe()
    frame = SimpleNamespace(DataFrame=lambda rows, columns: [columns, *rows])
    monkeypatch.setitem(sys.modules, "pandas", frame)
    assert residuals.to_dataframe()[0] == head


@pytest.mark.slow
def test_designed_motion_is_sampled_exactly(tmp_path):
    """A designed motion is sampled at any rate without interpolation."""
    settings = calib.ExcitationSettings(period=4.0, starts=1, evaluations=20, outlook=False, rate=100.0)
    design = calib.design_excitation("tx40", settings)
    t, q, v, a = design.sampled()
    written = (design.save(tmp_path / "m", plots=False) / "trajectory.csv").read_text().splitlines()
    head, *rows = csv.reader(line for line in written if line[0] != "#")
    assert (head[3], head[18]) == ("q_joint_3 [rad]", "a_joint_6 [rad/s^2]")
    table = np.array(rows, dtype=float)
    assert np.allclose(table[:, 3], q[:, 2], atol=1e-9) and np.allclose(table[:, 18], a[:, 5], atol=1e-8)
    fine = design.sampled(1000.0)
    assert all(np.allclose(one[::10], other, atol=1e-9) for one, other in zip(fine, (t, q, v, a)))
    assert np.allclose(np.gradient(fine[1], fine[0], axis=0)[1:-1], fine[2][1:-1], atol=1e-3)


@pytest.mark.slow
def test_geometry_noise_reaches_the_dynamics(logs):
    """Σ = Σ_torque + S Σ_geometry Sᵀ, without a file between fit and identification."""
    chain = description.read(logs / "robot.toml")
    exact = calib.identify_dynamics(calib.CalibratedChain(chain), logs / "train.npz", friction="standard")
    moved = np.diag(np.full(len(chain.elements), 1e-3**2))
    robot = calib.CalibratedChain(chain, covariance=moved)
    unsure = calib.identify_dynamics(robot, logs / "train.npz", friction="standard")
    np.testing.assert_array_equal(unsure.estimate.values, exact.estimate.values)
    added = unsure.estimate.covariance - exact.estimate.covariance
    assert np.linalg.eigvalsh(added).min() > -1e-9 * np.linalg.norm(added)
    assert (unsure.estimate.sigma > 1.01 * exact.estimate.sigma).any()


@pytest.mark.slow
def test_recordings_in_memory_and_validation(model, logs):
    """Recordings in memory are taken, and validation may come later."""
    robot = calib.load(logs / "robot.toml")
    log, other = (calib.read_recording(logs / f"{name}.npz", robot) for name in ("train", "other"))
    again = calib.identify_dynamics(robot, log, friction="standard")
    np.testing.assert_array_equal(again.estimate.values, model.estimate.values)
    judged = calib.validate(again, other)
    (score,), (before,) = judged.validation.values(), model.validation.values()
    assert score.raw.total == before.raw.total
    assert judged.verdict.level == model.verdict.level


def test_torques_have_sigmas(model):
    motion = model.inputs.cases[0].motion
    states = motion.q[:50], motion.v[:50], motion.a[:50]
    own, fast = model.torque_sigma(*states), model.torque_sigma(states[0], 3.0 * states[1], 9.0 * states[2])
    assert own.shape == model.torques(*states).shape and (own > 0.0).all()
    assert (np.median(fast, axis=0) > np.median(own, axis=0)).all()


@pytest.mark.slow
def test_export_and_compensation_in_memory(fitted, model, cell, logs, tmp_path, monkeypatch):
    """Export and compensation take results in memory."""
    written = calib.export(fitted, tmp_path / "geometry")
    assert (tmp_path / "geometry/robot.urdf").is_file() and any("robot.urdf" in line for line in written)
    calib.export(model, tmp_path / "dynamics")
    assert (tmp_path / "dynamics/robot.xml").is_file()
    (tmp_path / "targets.csv").write_text("q1,q2,q3,q4,q5,q6\n0.3,-1.2,1.6,-1.1,-1.4,0.5\n")
    assert fitted.save(tmp_path / "fit", plots=False)
    monkeypatch.chdir(tmp_path)
    assert not run("export", "fit", "--into", "by_command")
    names = sorted(path.name for path in (tmp_path / "geometry").iterdir())
    assert names == sorted(path.name for path in Path("by_command").iterdir())
    assert all((Path("geometry") / name).read_bytes() == (Path("by_command") / name).read_bytes() for name in names)
    assert run("export", "fit", "--into", "fit") == 2 and run("export", "nowhere", "--into", "out") == 2
    assert not Path("out").exists()
    commands = calib.compensate(fitted, tmp_path / "targets.csv")
    assert commands.reached.all() and "1 of 1" not in str(commands)
    assert commands.save(tmp_path / "commands.csv").is_file()


@pytest.mark.slow
def test_session_in_python_is_the_commands(logs, tmp_path, monkeypatch, capsys):
    """A session in Python is the command's session."""
    monkeypatch.chdir(tmp_path)
    robot = str(logs / "robot.toml")
    keys = {"poses": 8, "validation": 0, "holdout": 0.25, "dynamics": False}
    made = calib.new_session("script", robot, "cmm", **keys)
    command = ["new", "command", "--robot", robot, "--instrument", "cmm", "--poses", "8", "--validation", "0"]
    assert cli.run([*command, "--holdout", "0.25", "--geometry-only"]) == 0
    assert cli.run(["new", "free", "--robot", robot, "--instrument", "cmm", "--no-plan"]) == 0
    free = tomllib.loads((tmp_path / "free/session.toml").read_text())
    assert not free["poses"]["plan"] and not free["dynamics"]["plan"]
    (free,) = calib.run_sessions(["free"], plots=False)
    assert free.state == "waits" and "Provide free/3-measured/measured.csv" in str(free)
    assert not list((tmp_path / "free/2-poses").glob("*")), "no poses are chosen"
    own, other = (tomllib.loads((tmp_path / name / "session.toml").read_text()) for name in ("script", "command"))
    assert made == Path("script") and own | {"created": ""} == other | {"created": ""}
    script, command = calib.run_sessions(["script", "command/session.toml"], plots=False)
    assert script.state == command.state == "waits" and "Provide script/3-measured/measured.csv" in str(script)
    assert cli.run(["run", "command", "--no-plots"]) == 0
    assert "command: waits" in capsys.readouterr().out
    assert (made / "2-poses/poses.csv").read_bytes() == (tmp_path / "command/2-poses/poses.csv").read_bytes()
    with pytest.raises(calib.CalibError, match="given twice"):
        calib.run_sessions(["script", "script/session.toml"])


@pytest.mark.slow
def test_poses_without_constraints_say_so():
    """Poses chosen without constraints say what they keep and what is not checked."""
    chosen = calib.select_poses("ur5", 8, calib.SelectionSettings(method="detmax", candidates=200))
    assert "respected: 1 % of each joint's range to its limits, self-collision" in str(chosen)
    assert "NOT checked: line of sight (the instrument's position is not known), walls" in str(chosen)
    found = json.loads(json.dumps(chosen.to_dict()))
    assert found["random_baseline"] < found["value"] and 0.9 < found["efficiency"] <= 1.0
