"""Every kind of result with the verbs that take it: results whose tables hold no positions, no parameters, one row."""

import json
import pickle
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import planted
import planted_motion
import pytest

import calib
from calib import cli
from calib.apps.compensation import joint_commands
from calib.apps.viewer import viewer
from calib.config import parse, strict
from calib.data.poses.fit_options import FitOptions
from calib.dynamics.torque_rows import POWER
from calib.errors import UsageError
from calib.parallel.mechanism.closure import closed
from calib.parallel.mechanism.geometric_fit import changed, loop_parameters
from calib.parallel.robots import find
from calib.procedure.kinematic_stage.folder import FitFolder
from calib.results import scene_files as scene
from calib.robot import calibrated, description
from calib.robot.chain import random_joints
from calib.robot.library import load

SIGMA = 2e-5  # of the instrument [m]
KINDS = ("distance", "bar", "plane", "sockets")


@pytest.fixture(scope="module")
def truth():
    """A TX40 with planted errors, in its cell; they are too small for a search of wrong columns, which takes 10 s."""
    return planted.cell(planted.perturb(load("tx40"), 3, 5e-5, 1e-4), 1)


@pytest.fixture(
    scope="module", params=[pytest.param(kind, marks=[pytest.mark.slow] * (kind != "sockets")) for kind in KINDS]
)
def pointless(request, truth, tmp_path_factory) -> tuple[str, Path]:
    """Folder of a fit by what measures no position."""
    out = tmp_path_factory.mktemp("pointless") / request.param
    rows = planted.measure(truth, request.param, 120, 5, sigma=SIGMA)
    options = FitOptions(check_limits=False)
    fit = calib.fit_geometry("tx40", rows, calib.FitSettings(model="geometry", holdout=0.25), options=options)
    fit.save(out, plots=False)
    return request.param, out


@pytest.fixture(scope="module")
def points(truth):
    """Positions of the cell, and as many of a second station and tool."""
    other = planted.cell(truth.chain, 2, ("elsewhere",))
    return tuple(planted.measure(one, "position", 60, k, sigma=SIGMA) for k, one in enumerate((truth, other)))


@pytest.fixture(scope="module")
def fitted(points, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("fitted") / "fit"
    calib.fit_geometry("tx40", points[0], calib.FitSettings(model="geometry")).save(out, plots=False)
    return out


def test_view_shows_errors_without_positions(pointless, tmp_path):
    """View shows the errors of what measures no position."""
    pytest.importorskip("rerun")
    kind, out = pointless
    shown = viewer.write(out, tmp_path / "a.rrd")
    rows = (out / "residuals.csv").read_text().splitlines()[1:]
    assert not shown.measured and sum(len(each.q) for each in shown.sizes) == len(rows)
    assert {each.kind for each in shown.sizes} == {"distance" if kind in ("distance", "bar") else "position"}
    rms = FitFolder(out).metrics().fit.calibrated.main
    assert rms is not None and f"{rms.rms:.3f} mm calibrated" in viewer.about(shown)


def test_certificate_names_what_was_measured(pointless):
    """A certificate names what was measured."""
    kind, out = pointless
    page = (out / "certificate.html").read_text()
    words = {"sockets": "socket scatter", "plane": "plane distance"}.get(kind, "distance")
    assert f"{words}, rms" in page and "position, rms" not in page


@pytest.mark.slow
def test_view_separates_rows_by_station(points, tmp_path):
    """View separates the rows of another station."""
    settings = calib.FitSettings(model="geometry", refit_frames=True)
    fit = calib.fit_geometry("tx40", points[0], settings, validate=points[1])
    shown = scene.read(fit.save(tmp_path / "fit", plots=False))
    assert [len(each.q) for each in shown.measured] == [60]
    assert [len(each.q) for each in shown.sizes] == [60] and shown.sizes[0].unseen.all()
    seen = shown.measured[0]
    errors = np.linalg.norm(seen.seen - seen.calibrated, axis=1), shown.sizes[0].calibrated
    assert all(np.sqrt(np.mean(sizes**2)) < 10 * SIGMA for sizes in errors)


@pytest.mark.slow
def test_unestimated_arms_are_not_tested(points, tmp_path):
    """Calibrations that estimated nothing of the arm are not tested."""
    frames = calib.fit_geometry("tx40", points[0], calib.FitSettings(model="frames"))
    found = calib.diff(frames, frames)
    assert found.geometry is not None and found.geometry.freedom == 0 and found.geometry.probability == 1.0
    assert found.verdict == "marginal" and "not tested" in found.verdict.reason
    found.save(tmp_path / "diff")
    geometry = calib.fit_geometry("tx40", points[0], calib.FitSettings(model="geometry"))
    assert "not tested" not in calib.diff(geometry, geometry).verdict.reason


@pytest.mark.slow
def test_fit_on_fit_knows_nominal_placement(points, fitted, tmp_path):
    """A fit on a fit knows where the nominal robot stands."""
    again = calib.fit_geometry(fitted, points[1], calib.FitSettings(model="geometry")).save(tmp_path / "b", plots=False)
    alone = calib.fit_geometry("tx40", points[1], calib.FitSettings(model="geometry")).save(tmp_path / "c", plots=False)
    placed, expected = (joint_commands.read(each).nominal for each in (again, alone))
    assert np.array_equal(placed.chain.values, expected.chain.values)
    for own, other in ((placed.stations, expected.stations), (placed.tools, expected.tools)):
        assert own == pytest.approx(other, abs=1e-6)


@pytest.mark.slow
def test_compliance_takes_masses_from_folder(truth, tmp_path):
    """A compliance takes its masses from its folder."""
    stiff = load("lwr4plus")
    soft = replace(truth, chain=planted.perturb(stiff, 4))
    rows = planted.measure(soft, "position", 150, 1, sigma=SIGMA)
    fit = calib.fit_geometry("lwr4plus", rows, calib.FitSettings(model="stiffness"))
    # the same result from a description without masses, as where they were identified
    corrections = fit.robot.corrections
    assert corrections is not None
    bare = replace(corrections, chain=replace(corrections.chain, inertias=None))
    robot = replace(fit.robot, chain=replace(fit.robot.chain, inertias=None), corrections=bare)
    calibrated.write(tmp_path, robot)
    q = random_joints(stiff, 5, 0)
    assert calib.load(tmp_path).forward(q) == pytest.approx(fit.robot.forward(q), abs=1e-12)
    again = calib.fit_geometry(tmp_path, rows, calib.FitSettings(model="geometry"))
    assert np.isfinite(again.robot.forward(q)).all()


LOADED = {"rows": "power", "payload": {"load": {}}, "files": {"b.npz": {"payload": ["load"]}}}


@pytest.fixture(scope="module")
def powered(tmp_path_factory):
    """A model of the power, from a recording without and one with a payload."""
    folder = tmp_path_factory.mktemp("power")
    robot = description.write(folder / "planted.toml", planted_motion.arm())
    logs = planted_motion.write(folder, "a.npz", 0), folder / "b.npz"
    np.savez(logs[1], **planted_motion.series(1, payload=True))
    model = calib.identify_dynamics(robot, logs, calib.IdentifySettings(**LOADED))
    return robot, model, model.save(folder / "model")


@pytest.mark.slow
def test_power_tells_payload(powered):
    """The power of two recordings tells the payload."""
    found = powered[1].estimate
    mass = found.names.index("Mload")
    assert abs(found.values[mass] - planted_motion.PAYLOAD[9]) < 4 * found.sigma[mass] < 0.2 * planted_motion.PAYLOAD[9]


@pytest.mark.slow
def test_power_model_is_a_result_like_others(powered, tmp_path):
    """A model of power is a result like others."""
    robot, model, folder = powered
    copy = pickle.loads(pickle.dumps(model))
    assert copy.found.settings.torque_rows == POWER
    assert np.array_equal(copy.estimate.values, model.estimate.values)
    assert len(model.charts()["friction"].panels) == 3
    ways = np.array([[0.0, 0.2, 0.1], [0.5, -0.3, 0.4]])
    plan = calib.plan_motion(robot, ways, model=folder)
    assert plan.track.tau is not None and np.isfinite(plan.track.tau).all()
    with pytest.raises(UsageError, match="identify again with rows = 'motor'"):
        calib.design_excitation(robot, calib.ExcitationSettings(period=4.0, starts=1), after=folder)


@pytest.mark.slow
def test_friction_step_without_terms_is_said(tmp_path):
    """A friction step without terms is said."""
    robot = description.write(tmp_path / "planted.toml", planted_motion.arm())
    log = planted_motion.write(tmp_path, "a.npz", 0)
    model = calib.identify_dynamics(robot, log, friction="coupling")
    step = model.found.friction.steps[-1]
    assert step.model == "+ coupling" and not step.kept and "none tried" in step.note


def test_a_motion_knows_its_robot(tmp_path):
    robot = description.write(tmp_path / "planted.toml", planted_motion.arm())
    plan = calib.plan_motion(robot, np.array([[0.0, 0.2, 0.1], [0.5, -0.3, 0.4]]))
    folder = plan.save(tmp_path / "plan", plots=False)
    robot.unlink()
    shown = scene.read(folder)
    assert shown.chain is not None and shown.chain.joint_names == planted_motion.arm().joint_names and not shown.notes
    with pytest.raises(UsageError, match="is a motion of calib plan; give the folder of a fit"):
        joint_commands.read(folder)


def test_motion_programs_go_where_asked(tmp_path, capsys):
    """Programs of motions are written where asked."""
    planned = calib.plan_motion("tx40", np.array([[0.0] * 6, [0.3] * 6]), calib.PlanSettings(rate=250.0))
    folder = planned.save(tmp_path / "plan", plots=False)
    for name in ("m_rsi.csv", "m.krl"):
        out = tmp_path / name
        assert cli.run(["program", str(folder), "--for", "krl", "--out", str(out)]) == 0
        assert out.is_file()
    assert not list(tmp_path.glob("*_rsi_rsi*"))
    assert cli.run(["program", str(tmp_path), "--for", "krl", "--out", str(tmp_path / "x")]) == 2
    assert "give a list of poses, a program, or the folder of a motion" in capsys.readouterr().err


@pytest.mark.slow
def test_parallel_fit_has_pages_of_arm_fits(tmp_path):
    """A parallel fit has the pages and figures of an arm's fit."""
    robot, rng = find("fivebar"), np.random.default_rng(0)
    assert robot is not None
    parameters = loop_parameters(robot.mechanism)
    true = closed(changed(robot.chain, parameters, 1e-3 * rng.normal(size=len(parameters))))
    x = 0.8 * rng.uniform(robot.chain.lower, robot.chain.upper, (20, 2))
    q = true.place(x).q[:, robot.chain.actuated] + 1e-5 * rng.normal(size=(20, 2))
    head = "motor_left,motor_right,x [mm],y [mm]"
    np.savetxt(tmp_path / "poses.csv", np.hstack([q, 1e3 * x]), delimiter=",", header=head, comments="")
    fit = calib.fit_geometry("fivebar", tmp_path / "poses.csv", calib.FitSettings(holdout=0.25))
    assert "position" in fit.charts() and fit.plot("position") is not None
    out = fit.save(tmp_path / "fit", plots=False)
    stated = json.loads((out / "report.json").read_text())["metrics"]
    assert stated["verdict"] == fit.verdict.level and stated["reason"] == fit.verdict.reason
    assert cli.run(["certificate", str(out), "--robot-serial", "SN-7", "--no-plots"]) == 0
    assert "SN-7" in (out / "certificate.html").read_text()
    with pytest.raises(UsageError, match=r"diff is for serial arms only; compare .*estimate\.csv"):
        calib.diff(out, out)


@strict
@dataclass(frozen=True)
class _Table:
    sigmas: tuple[float, float] | None = None


@pytest.mark.parametrize("given", [[], [1.0], [1.0, 2.0, 3.0]])
def test_wrong_list_length_is_refused(given):
    """Lists of fixed length are refused by their length."""
    with pytest.raises(UsageError, match=r"t\.toml: sigmas: expected a list of 2 values"):
        parse(_Table, {"sigmas": given}, "t.toml")


@pytest.mark.parametrize("arm", [pytest.param("tx40", marks=pytest.mark.slow), "ur5"])
@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind in ("bar", "plane"))) for kind in ("position", *KINDS)]
)
def test_computed_measurements_are_fitted(kind, arm):
    """Exact but for the rounding of a file: what they do not determine lies in valleys too narrow to follow."""
    cell = planted.cell(planted.perturb(load(arm), 1, 3e-4, 5e-4), 2)
    rows = planted.measure(cell, kind, 90, 5)
    rounded = replace(rows, q=np.round(rows.q, 10))
    fit = calib.fit_geometry(arm, rounded, calib.FitSettings(model="geometry"), options=FitOptions(check_limits=False))
    label = "distance_mm" if kind in ("distance", "bar") else "position_mm"
    assert fit.to_dict()["fit"]["calibrated"][label]["rms"] < 1e-4
