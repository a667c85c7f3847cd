"""What `calib fit` promises: its files, its figures, its exit codes."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.geometry import fit as geometric_fit
from calib.geometry import installation
from calib.geometry.weighing import Settings
from calib.procedure.kinematic_stage import fit, inputs
from calib.procedure.kinematic_stage.settings import FitSettings
from calib.procedure.kinematic_stage.verdict.validation import Arms, assess
from calib.procedure.report import fit_report
from calib.procedure.report.geometry_figures import captioned
from calib.robot import calibrated
from calib.robot.calibrated import CalibratedChain
from calib.robot.formats import urdf
from calib.robot.formats.urdf_write import write_new
from calib.robot.kinematics import forward
from calib.robot.library import load
from calib.simulation.cell import SimulatedInstrument, measure
from calib.simulation.virtual_cells import perturbed_cell
from calib.transforms import from_xyz_rpy

ERRORS = {"mean", "rms", "p95", "max"}


def read_rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_planted_arm_is_found(cell, calib):
    """A planted arm is found, and the contract is kept."""
    file, other = cell.write("day1.csv", cell.measure(60)), cell.write("day2.csv", cell.measure(40, 1))
    code, out, err = calib("fit", "ur5", file, "--validate", other, "--model", "geometry", "--out", "done")
    assert code == 0, err
    assert len(out.splitlines()) <= 25 and "Errors of" not in out
    (verdict,) = (line for line in out.splitlines() if line.startswith("verdict: "))
    assert len(verdict.split()) <= 27
    metrics = json.loads(Path("done/metrics.json").read_text())
    assert metrics["fit"]["poses"] == 60
    assert set(metrics["validation"]) == {"day2.csv"}
    for part in (metrics["fit"], metrics["validation"]["day2.csv"]):
        for arm in ("nominal", "calibrated"):
            assert set(part[arm]["position_mm"]) == ERRORS
            assert part[arm]["orientation_deg"] is None
            assert part[arm]["distance_mm"] is None
    unseen = metrics["validation"]["day2.csv"]
    assert unseen["nominal"]["position_mm"]["rms"] > 0.5
    assert unseen["calibrated"]["position_mm"]["rms"] < 0.06  # noise of 0.02 mm per axis, 30 parameters from 60 poses
    assert [rung["model"] for rung in metrics["ladder"]] == ["frames", "geometry"]
    assert metrics["ladder"][-1]["parameters"] == metrics["fit"]["parameters"]
    assert metrics["verdict"] == "pass"
    assert "verdict: pass" in out and "day2.csv" in out


@pytest.mark.slow
def test_files_of_a_fit_hold_the_same_robot(cell, calib):
    """The files of a fit hold the same robot."""
    file = cell.write("day1.csv", cell.measure(60))
    assert calib("fit", "ur5", file, "--model", "geometry", "--out", "done")[0] == 0
    q = np.random.default_rng(0).uniform(-2, 2, (20, 6))
    placed = installation.read("done")
    poses = placed.stations[0] @ forward(placed.chain, q) @ placed.tools[0]
    rows = cell.measure(60)
    seen = np.array([[row[axis] for axis in "xyz"] for row in rows])
    fitted = np.array([[row[f"q{j + 1}"] for j in range(6)] for row in rows])
    predicted = placed.stations[0] @ forward(placed.chain, fitted) @ placed.tools[0]
    assert np.linalg.norm(predicted[:, :3, 3] - seen, axis=1).max() < 2e-4
    again = urdf.read("done/robot.urdf")
    assert np.abs(forward(again, q) - forward(load("done"), q)).max() < 1e-9
    assert np.isfinite(poses).all()
    estimate = read_rows(Path("done/estimate.csv"))
    assert list(estimate[0]) == ["name", "unit", "nominal", "value", "sigma", "rsd [%]"]
    names = {row["name"] for row in estimate}
    assert {"day1.x", "day1.rz", "tool.x"} <= names
    chain, nominal = load("done"), load("ur5")
    for row in estimate:
        if row["name"] in chain.names:
            k = chain.names.index(row["name"])
            assert float(row["value"]) == np.float64(f"{chain.values[k]:.12g}")
            assert float(row["nominal"]) == np.float64(f"{nominal.values[k]:.12g}")
    covariance = read_rows(Path("done/covariance.csv"))
    assert [row["name"] for row in covariance] == [row["name"] for row in estimate]
    for row in estimate:
        own = next(line for line in covariance if line["name"] == row["name"])
        assert np.isclose(np.sqrt(float(own[row["name"]])), float(row["sigma"]), rtol=1e-6)


@pytest.mark.slow
def test_residuals_are_those_of_the_metrics(cell, calib):
    rows = cell.measure(60)
    rows[7]["x"] += 0.01
    file = cell.write("day1.csv", rows)
    assert calib("fit", "ur5", file, "--model", "geometry", "--loss", "cauchy", "--out", "done")[0] == 0
    table = read_rows(Path("done/residuals.csv"))
    metrics = json.loads(Path("done/metrics.json").read_text())
    sizes = np.array([float(row["size [mm]"]) for row in table])
    assert len(table) == 60
    assert np.isclose(np.sqrt(np.mean(sizes**2)), metrics["fit"]["calibrated"]["position_mm"]["rms"], rtol=1e-6)
    assert [row["row"] for row in table if row["outlier"] == "1"] == ["8"]
    assert float(table[7]["weight"]) < 0.01 < 0.5 < float(table[0]["weight"])
    worst = metrics["outliers"][0]
    assert worst["row"] == 8
    assert 9.0 < worst["size_mm"] < 11.0


@pytest.mark.slow
def test_holdout_is_end_of_the_permutation(cell, calib):
    """Holdout keeps the last share of the permutation."""
    file = cell.write("day1.csv", cell.measure(60))
    start = ("fit", "ur5", file, "--holdout", "0.25", "--seed", "3", "--model", "offsets", "--out", "done")
    assert calib(*start)[0] in (0, 1)
    metrics = json.loads(Path("done/metrics.json").read_text())
    assert metrics["fit"]["poses"] == 45
    assert metrics["validation"]["day1.csv"]["poses"] == 15
    assert metrics["seed"] == 3
    rows = read_rows(Path("done/residuals.csv"))
    held = sorted(int(row["row"]) - 1 for row in rows if row["set"] == "held out")
    assert held == sorted(np.random.default_rng(3).permutation(60)[45:].tolist())
    stated = [[row[name] for name in ("sigma [mm]", "interval95 [mm]", "extrapolated")] for row in rows]
    assert all(each == ["", "", ""] for row, each in zip(rows, stated) if row["set"] == "fit")
    unseen = [(float(row["size [mm]"]), *map(float, each)) for row, each in zip(rows, stated) if row["set"] != "fit"]
    within = 100 * np.mean([size <= radius for size, _, radius, _ in unseen])
    assert within == pytest.approx(metrics["validation"]["day1.csv"]["interval95"]["coverage_percent"])
    assert {out for *_, out in unseen} <= {0.0, 1.0} and all(0 < sigma < radius for _, sigma, radius, _ in unseen)


@pytest.mark.slow
def test_other_station_needs_refitted_frames(cell, calib):
    """A pose file from another station needs refitted frames."""
    elsewhere = from_xyz_rpy([-2.0, 1.0, 0.0], [0.0, 0.4, 1.0])
    columns = list(cell.measure(1)[0])
    file = cell.write("a.csv", cell.measure(50), columns)
    other = cell.write("b.csv", cell.measure(40, 1, elsewhere), columns)
    code, out, _ = calib("fit", "ur5", file, "--validate", other, "--model", "geometry", "--out", "one")
    assert (code, judged_by("one"), "--refit-frames" in out) == (1, "placed-elsewhere", True)
    assert "already be calibrated" not in out
    code, out, err = calib(
        "fit", "ur5", file, "--validate", other, "--refit-frames", "--model", "geometry", "--out", "two"
    )
    assert code == 0, err
    unseen = json.loads(Path("two/metrics.json").read_text())["validation"]["b.csv"]
    assert set(unseen["calibrated"]["orientation_deg"]) == ERRORS
    assert unseen["calibrated"]["position_mm"]["rms"] < 0.1 < unseen["nominal"]["position_mm"]["rms"]


def test_two_files_have_two_stations(cell, calib):
    """Two files have two stations unless one is asked for."""
    file, other = cell.write("a.csv", cell.measure(40)), cell.write("b.csv", cell.measure(40, 1))
    assert calib("fit", "ur5", file, other, "--model", "frames", "--out", "each")[0] == 0
    placed = installation.read("each")
    assert (placed.station_names, len(placed.tool_names)) == (("a", "b"), 1)
    asked = ("--stations", "one", "--tools", "each")
    assert calib("fit", "ur5", file, other, *asked, "--model", "frames", "--out", "one")[0] == 0
    placed = installation.read("one")
    assert (placed.station_names, placed.tool_names) == (("station",), ("a tool", "b tool"))


def test_stations_with_tools_of_their_own_are_not_held_out_whole(cell, calib):
    """The other station's rows do not determine a station's own tool: regions of it are held out, which is said."""
    file, other = cell.write("a.csv", cell.measure(40)), cell.write("b.csv", cell.measure(40, 1))
    code, _, err = calib("fit", "ur5", file, other, "--tools", "each", "--model", "frames", "--out", "o")
    assert code == 0 and installation.read("o").tool_names == ("a tool", "b tool"), err
    noticed = json.loads(Path("o/metrics.json").read_text())["noticed"]
    (by_regions,) = [item["values"] for item in noticed if item["code"] == "transfer-by-regions"]
    assert by_regions["stations"] == ["a", "b"]


@pytest.mark.slow
def test_one_station_of_a_moved_instrument(cell, calib):
    """One station for an instrument that was moved is said."""
    moved = from_xyz_rpy([1.8, -0.8, 0.5], [0.1, -0.2, 2.2])
    file, other = cell.write("a.csv", cell.measure(40)), cell.write("b.csv", cell.measure(40, 1, moved))
    start = ("fit", "ur5", file, other, "--model", "geometry", "--out", "done")
    assert "with stations 'each'" in calib(*start, "--stations", "one")[1]
    assert "with stations 'each'" not in calib(*start)[1]


@pytest.mark.slow
def test_repeated_rows_prove_nothing(cell, calib):
    """Rows that count twice are said, and copies prove nothing."""
    rows = cell.measure(40)
    file, copy = cell.write("a.csv", [*rows, rows[2]]), cell.write("copy.csv", rows[:20])
    start = ("fit", "ur5", file, "--model", "geometry", "--out", "done")
    out = calib(*start, "--validate", copy)[1]
    assert "a.csv: 1 row (41) identical to another row" in out
    assert "copy.csv: 20 rows (1, 2, 3, 4, 5, ...) identical to fitted rows" in out
    assert "by cross-validation only" in out and "NOT unseen" in out
    assert "file given twice" in calib(*start[:3], file, *start[3:])[1]
    assert "with the numbers" not in calib("fit", "ur5", cell.write("b.csv", cell.measure(40, 5)), *start[3:])[1]


@pytest.mark.slow
def test_validation_files_share_an_option(cell, calib):
    """Validation files may follow one option, or each its own."""
    file = cell.write("a.csv", cell.measure(40))
    for name, seed in (("b.csv", 1), ("c.csv", 2)):
        cell.write(name, cell.measure(30, seed))
    start = ("fit", "ur5", file, "--model", "frames")
    assert calib(*start, "--validate", "b.csv", "c.csv", "--out", "one")[0] == 0
    assert calib(*start, "--out", "two", "--validate", "b.csv", "--validate", "c.csv")[0] == 0
    assert calib("fit", "--validate", "b.csv", "--out", "three", "ur5", file, "--model", "frames")[0] == 0
    found = {name: json.loads(Path(name, "metrics.json").read_text()) for name in ("one", "two", "three")}
    assert found["one"] == found["two"]
    assert set(found["one"]["validation"]) == {"b.csv", "c.csv"}
    assert set(found["three"]["validation"]) == {"b.csv"}
    assert found["three"]["fit"] == found["one"]["fit"]


@pytest.mark.slow
def test_same_seed_gives_the_same_numbers(cell, calib):
    """The same seed gives the same numbers."""
    file = cell.write("a.csv", cell.measure(40))
    for name in ("one", "two"):
        assert calib("fit", "ur5", file, "--holdout", "0.3", "--seed", "4", "--out", name)[0] == 0
    assert Path("one/metrics.json").read_bytes() == Path("two/metrics.json").read_bytes()
    assert Path("one/estimate.csv").read_bytes() == Path("two/estimate.csv").read_bytes()


@pytest.mark.slow
def test_calibrated_folder_is_a_robot(cell, calib):
    """A calibrated folder is a robot, and a worse arm fails."""
    file = cell.write("a.csv", cell.measure(60))
    assert calib("fit", "ur5", file, "--model", "geometry", "--out", "arm")[0] == 0
    # five noisy poses more, full of gross errors: what is fitted to them is worse than the arm was
    rows = cell.measure(60, 9)
    for k, row in enumerate(rows):
        row["x"] += 0.004 * (k % 3 - 1)
    bad = cell.write("bad.csv", rows)
    good = cell.write("good.csv", cell.measure(40, 2))
    code, out, _ = calib(
        "fit", "arm", bad, "--validate", good, "--refit-frames", "--model", "geometry", "--out", "worse"
    )
    assert (code, json.loads(Path("worse/metrics.json").read_text())["verdict"]) == (
        1,
        "fail",
    ) and "verdict: fail" in out


@pytest.mark.parametrize(
    "deliverable", [pytest.param("urdf", marks=pytest.mark.slow), pytest.param("corrections", marks=pytest.mark.slow)]
)
def test_deliverable_comes_first_everywhere(cell, calib, deliverable):
    """The deliverable's figure comes first in each, the alternative's has its words; plots show the deliverable."""
    file = cell.write("a.csv", cell.measure(90))
    asked = ("--model", "coupling", "--holdout", 0.25, "--deliverable", deliverable, "--out", "done")
    code, said, errors = calib("fit", "ur5", file, *asked)
    assert code == 0, errors
    (unseen,) = json.loads(Path("done/metrics.json").read_text())["validation"].values()
    nominal, alone, corrected = (unseen[arm]["position_mm"]["rms"] for arm in ("nominal", "urdf_alone", "calibrated"))
    words = [f"{alone:.3f} mm calibrated", f"{corrected:.3f} mm with joint corrections"]
    judged = alone
    if deliverable == "corrections":
        words, judged = words[::-1], corrected
    assert f"rms {nominal:.3f} mm nominal, {words[0]} ({words[1]})" in said
    assert f"{judged:.3f} mm rms on a.csv, unseen, {words[0].partition(' mm ')[2]} (nominal" in said

    certificate = Path("done/certificate.html").read_text()
    first = f"position, rms ({words[0].partition(' mm ')[2]})"
    second = f"position, rms ({words[1].partition(' mm ')[2]})"
    assert 0 < certificate.index(first) < certificate.index(second)
    histogram, _ = captioned(fit_report.read(Path("done/report.json")))["position"]
    assert f"{nominal:.3g} mm rms before, {judged:.3g} mm after" == histogram.panels[0].title


@pytest.mark.slow
def test_deflection_table_comes_back(cell, calib):
    """Deflections go out as a table with its formula, and come back."""
    file = cell.write("a.csv", cell.measure(90))
    assert calib("fit", "ur5", file, "--model", "coupling", "--out", "done")[0] == 0
    placed = installation.read("done")
    rows = read_rows(Path("done/joint_corrections.csv"))
    assert len(rows) == len(placed.deflection.terms) > 0
    assert "coefficient * b(q)" in Path("done/joint_corrections.txt").read_text()
    metrics = json.loads(Path("done/metrics.json").read_text())
    q = np.array([[row[f"q{j + 1}"] for j in range(6)] for row in cell.measure(90)])
    seen = np.array([[row[axis] for axis in "xyz"] for row in cell.measure(90)])
    size = np.linalg.norm(installation.see(placed, q).point.T - seen, axis=1)
    assert np.isclose(1e3 * np.sqrt(np.mean(size**2)), metrics["fit"]["calibrated"]["position_mm"]["rms"], rtol=1e-6)
    # robot.urdf is the best rigid geometry, beside the one that the corrections belong to
    alone = metrics["fit"]["urdf_alone"]["position_mm"]["rms"]
    assert metrics["fit"]["calibrated"]["position_mm"]["rms"] <= alone < metrics["fit"]["nominal"]["position_mm"]["rms"]
    left = [1e3 * metrics["findings"][f"{head}cross_validated"] for head in ("rigid_", "")]
    assert metrics["reason"].startswith(f"{left[0]:.3f} mm rms by cross-validation only, calibrated")
    (other,) = [one["values"] for one in metrics["noticed"] if one["code"] == "other-deliverable"]
    assert (1e3 * other["rms"], other["level"]) == (pytest.approx(left[1]), "pass")
    some = q[:20] / 2
    with_corrections = forward(urdf.read("done/robot_for_corrections.urdf"), some)
    assert np.abs(with_corrections - forward(load("done"), some)).max() < 1e-9
    rigid = urdf.read("done/robot.urdf")
    assert np.abs(forward(rigid, some) - forward(calibrated.read("done").chain, some)).max() < 1e-9
    Path("ur5.urdf").write_text(write_new(load("ur5")))
    said = calib("export", "done", "--urdf", "ur5.urdf", "--out", "new.urdf")[1]
    assert f"{left[0]:.3f} mm rms by cross-validation only, calibrated" in said
    assert np.abs(forward(urdf.read("new.urdf"), some) - forward(rigid, some)).max() < 1e-9
    assert calib("export", "done", "--urdf", "ur5.urdf", "--out", "new.urdf", "--for-corrections")[0] == 0
    assert np.abs(forward(urdf.read("new.urdf"), some) - with_corrections).max() < 1e-9
    # a simpler model afterwards leaves no correction table behind
    assert calib("fit", "ur5", file, "--model", "geometry", "--out", "done")[0] == 0
    assert not Path("done/joint_corrections.csv").exists()
    assert not Path("done/robot_for_corrections.urdf").exists()


@pytest.mark.slow
def test_fixed_parameters_stay(cell, calib):
    file = cell.write("a.csv", cell.measure(60))
    Path("o.toml").write_text('fix = ["theta2", "theta3"]\n')
    assert calib("fit", "ur5", file, "--options", "o.toml", "--model", "geometry", "--out", "done")[0] == 0
    chain, nominal = load("done"), load("ur5")
    values, before = dict(zip(chain.names, chain.values)), dict(zip(nominal.names, nominal.values))
    assert values["theta2"] == before["theta2"]
    assert values["theta4"] != before["theta4"]


@pytest.mark.slow
def test_gross_rows_stay_out_of_deliverables(cell, calib):
    """The loss that auto takes for them counts for all that comes of the fit, not for the calibrated arm alone."""

    def gears(count: int, seed: int) -> list[dict[str, float]]:
        return [row | {"q3": row["q3"] + 1e-3 * np.sin(2.0 * row["q2"])} for row in cell.measure(count, seed)]

    rows, columns = gears(100, 0), [*(f"q{j + 1}" for j in range(6)), *"xyz"]
    clean = cell.write("clean.csv", rows, columns)
    wrong = cell.write("m.csv", [row | {"x": row["x"] + 0.05 * (k % 10 == 0)} for k, row in enumerate(rows)], columns)
    unseen, alone, radius = cell.write("v.csv", gears(40, 1), columns), [], []
    for file in (clean, wrong):
        calib("fit", "ur5", file, "--validate", unseen, "--model", "coupling", "--out", "o")
        found = json.loads(Path("o/metrics.json").read_text())["validation"]["v.csv"]
        alone.append(found["urdf_alone"]["position_mm"]["rms"])
        radius.append(found["interval95"]["median_mm"])
    assert alone[1] < 1.2 * alone[0] and radius[1] < 1.5 * radius[0]


@pytest.mark.slow
def test_refitting_own_folder_is_no_failure(cell, calib):
    """Refitting a fit's own folder is no failure."""
    file = cell.write("a.csv", cell.measure(60))
    assert calib("fit", "ur5", file, "--out", "arm")[0] == 0
    code, out, _ = calib("fit", "arm", file, "--out", "again")
    assert (code, "nothing to gain" in out) == (0, True)
    code, out, _ = calib("fit", "arm", file, "--model", "geometry", "--out", "forced")
    assert (code, "verdict: fail" in out) == (0, False)


@pytest.mark.slow
def test_tolerance_is_tested_on_unseen_rows(cell, calib):
    """A tolerance is held against unseen rows, and named."""
    file = cell.write("a.csv", cell.measure(60))
    start = ("fit", "ur5", file, "--model", "geometry", "--holdout", "0.25", "--out", "done")
    for tolerance, code, word in (("0.5", 0, "within the tolerance of 0.5 mm"), ("0.001", 1, "above the tolerance")):
        found, out, _ = calib(*start, "--tolerance", tolerance)
        assert (found, word in out) == (code, True)
        assert json.loads(Path("done/metrics.json").read_text())["tolerance_mm"] == float(tolerance)
    assert calib(*start, "--tolerance", "-1")[0] == 2


@pytest.mark.slow
def test_orientations_are_tested_on_the_arm(cell, calib):
    """Orientations are held against the arm."""
    rows = cell.measure(40)
    names = ["qx", "qy", "qz", "qw"]
    for words, reading in (
        ("If w comes first", ["qw", "qx", "qy", "qz"]),
        ("target in the instrument's frame", ["qx", "qy", "qz", "-qw"]),
        ("", names),
    ):
        other = [
            row | {n: row[r.removeprefix("-")] * (-1 if r[0] == "-" else 1) for n, r in zip(names, reading)}
            for row in rows
        ]
        code, _, err = calib(
            "fit", "ur5", cell.write("a.csv", other, list(rows[0])), "--model", "offsets", "--out", "done"
        )
        assert (code, words in err) == (2 if words else 0, True), err


@pytest.mark.slow
def test_turned_orientations_fail(cell, calib):
    """Ten degrees about changing axes: not another convention, and no orientation of an arm."""
    rows, columns = cell.measure(60), list(cell.measure(1)[0])
    turns = Rotation.from_rotvec(np.radians(10.0) * _directions(60))
    for row, turn in zip(rows, turns):
        turned = turn * Rotation.from_quat([row[name] for name in columns[-4:]])
        row |= dict(zip(columns[-4:], map(float, turned.as_quat())))
    Path("o.toml").write_text("[sigma]\nposition = 2e-5\norientation = 0.2\n")
    file = cell.write("a.csv", rows, columns)
    start = ("fit", "ur5", file, "--options", "o.toml", "--model", "geometry", "--out", "done")
    code, _, _ = calib(*start, "--holdout", "0.25")
    assert (code, judged_by("done")) == (1, "orientations-off")


def judged_by(folder: str) -> str:
    return json.loads(Path(folder, "metrics.json").read_text())["code"]


def _directions(count: int) -> np.ndarray:
    axes = np.random.default_rng(5).standard_normal((count, 3))
    return axes / np.linalg.norm(axes, axis=1)[:, None]


@pytest.mark.slow
def test_placement_has_its_validation_frames(cell, calib):
    """A placement alone is validated with frames of its own."""
    file, other = cell.write("a.csv", cell.measure(60)), cell.write("b.csv", cell.measure(40, 1))
    code, out, err = calib("fit", "ur5", file, "--model", "frames", "--validate", other, "--refit-frames", "--out", "o")
    assert (code, "b.csv" in out) == (0, True), err


NOISE = 2e-5
JOINTS = [f"q{j + 1}" for j in range(6)]
REFLECTORS = ([0.05, 0.02, 0.1], [-0.05, 0.03, 0.1], [0.0, -0.06, 0.12])


def points(cell, q: np.ndarray, tool: list[float]) -> np.ndarray:
    """Return where the target is in the arm's base (m, 3)."""
    return (forward(cell.truth, q) @ from_xyz_rpy(tool, [0, 0, 0]))[:, :3, 3]


def distances(cell, q, generator) -> list[dict]:
    p = points(cell, q, REFLECTORS[0])
    known = np.linalg.norm(p[0::2] - p[1::2], axis=1) + NOISE * generator.standard_normal(len(q) // 2)
    return [dict(zip(JOINTS, row)) | {"distance": known[k // 2], "pair": k // 2} for k, row in enumerate(q)]


def bars(cell, q, generator) -> list[dict]:
    p = points(cell, q, REFLECTORS[0])
    known = np.linalg.norm(p - [0.6, 0.2, 0.3], axis=1) + NOISE * generator.standard_normal(len(q))
    return [dict(zip(JOINTS, row)) | {"distance": d, "bar": "a"} for row, d in zip(q, known)]


def reflectors(cell, q, generator) -> list[dict]:
    station = from_xyz_rpy([1.5, -0.8, 0.4], [0.1, -0.2, 2.0])
    rows = [dict(zip(JOINTS, row)) for row in q]
    for number, tool in enumerate(REFLECTORS, 1):
        seen = points(cell, q, tool) @ station[:3, :3].T + station[:3, 3]
        for row, place in zip(rows, seen + NOISE * generator.standard_normal(seen.shape)):
            row |= {f"{axis}{number}": value for axis, value in zip("xyz", place)}
    return rows


@pytest.mark.slow
@pytest.mark.parametrize(
    ("measure", "count", "nature", "poses"),
    [(distances, 240, "distance_mm", 192), (bars, 160, "distance_mm", 128), (reflectors, 60, "position_mm", 48)],
)
def test_a_kind_calibrates(cell, calib, measure, count, nature, poses):
    generator = np.random.default_rng(3)
    q = generator.uniform(-2.5, 2.5, (count, 6))
    rows = measure(cell, q, generator)
    file = cell.write("a.csv", rows, list(rows[0]))
    code, _, err = calib("fit", "ur5", file, "--model", "geometry", "--holdout", "0.2", "--out", "done")
    assert code == 0, err
    metrics = json.loads(Path("done/metrics.json").read_text())
    unseen = metrics["validation"]["a.csv"]
    assert metrics["fit"]["poses"] == poses
    assert unseen["nominal"][nature]["rms"] > 0.4
    assert unseen["calibrated"][nature]["rms"] < 0.06
    if nature == "distance_mm":
        assert unseen["calibrated"]["position_mm"] is None
    else:
        assert unseen["calibrated"]["distance_mm"] is None


@pytest.mark.slow
def test_unfinished_placement_proves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The optimiser gets one linearisation for the file's own frames: what it leaves there means nothing."""
    cell = perturbed_cell(load("ur10"), 0, SimulatedInstrument("6-D probe", 30e-6, 1e-4), hidden=0.3)
    rng = np.random.default_rng(0)
    seen, other = (measure(cell, rng.uniform(-2.0, 2.0, (count, 6)), count) for count in (40, 30))
    wanted = FitSettings(model="offsets", refit_frames=True)
    given = inputs.gather(
        CalibratedChain(cell.nominal),
        [replace(seen, file="seen.csv")],
        [replace(other, file="other.csv")],
        settings=wanted,
    )
    found = fit.run(given, settings=wanted)
    (name,) = found.validation
    assert found.validation[name].settled and found.validation[name].proves and name in found.verdict.reason
    monkeypatch.setattr(geometric_fit, "CRAWLS", 1)
    chosen = found.selection
    arms = Arms(chosen.nominal.cell, chosen.fit.cell, found.rigid.cell.chain, found.expected)
    again = assess(arms, given, found.findings, Settings(limit=1), wanted)
    assert not again.validation[name].settled and not again.validation[name].proves
    codes = {one.code: one.values.get("file") for one in again.noticed}
    assert codes["placement-unsettled"] == name and "interval-coverage" not in codes
    assert name not in again.verdict.reason and "cross-validation" in again.verdict.reason


@pytest.mark.slow
def test_self_explaining_file_proves_nothing(cell, calib) -> None:
    """Six positions are eighteen numbers, base and tool nine parameters; twelve positions leave enough."""
    file, other = cell.write("a.csv", cell.measure(60)), cell.measure(12, 1)
    for count, scored in ((6, False), (12, True)):
        few = cell.write("few.csv", other[:count])
        _, out, err = calib("fit", "ur5", file, "--model", "offsets", "--validate", few, "--refit-frames", "--out", "o")
        assert ("few.csv not scored (9 placement parameters, 18 numbers)" in out) is not scored, err
        assert ("on few.csv, unseen" in out) is scored


@pytest.mark.parametrize(
    ("count", "frames"),
    [
        pytest.param(6, ["--refit-frames"], marks=pytest.mark.slow),
        pytest.param(7, [], marks=pytest.mark.slow),
        pytest.param(8, [], marks=pytest.mark.slow),
    ],
)
def test_unseen_poses_of_a_changed_arm_contradict_the_fit(cell, calib, count, frames) -> None:
    """Joint 3 moved by 4 mrad since the fit: few poses fail as many do, also where the placement is fitted to them."""
    file = cell.write("a.csv", cell.measure(60))
    moved = [row | {"q3": row["q3"] + 4e-3} for row in cell.measure(count, 1)]
    given = ("ur5", file, "--model", "geometry", "--validate", cell.write("moved.csv", moved), *frames)
    code, out, err = calib("fit", *given, "--out", "o")
    assert (code, json.loads(Path("o/metrics.json").read_text())["code"]) == (1, "contradicted"), err
    assert "moved.csv: " in out and "times expected" in out


@pytest.mark.slow
def test_as_many_poses_as_the_verdict_asks_for_beside_a_fitted_placement_decide_it(cell, calib) -> None:
    """Nine positions have three numbers per parameter of the placement; eight are 24 numbers of 27."""
    file, other = cell.write("a.csv", cell.measure(60)), cell.measure(9, 1)
    for count in (6, 8, 9):
        given = ("ur5", file, "--model", "geometry", "--validate", cell.write("v.csv", other[:count]), "--refit-frames")
        _, out, err = calib("fit", *given, "--out", "o")
        assert (f"(too few unseen poses: v.csv {count} of 9)" in out) is (count < 9), err
        assert ("measure at least 9 such poses" in out) is (count < 9)
        assert ("on v.csv, unseen" in out) is (count == 9)


@pytest.mark.parametrize(
    "count", [20, pytest.param(28, marks=pytest.mark.slow), pytest.param(40, marks=pytest.mark.slow)]
)
def test_the_advised_holdout_leaves_poses_enough_to_decide(cell, calib, count) -> None:
    """Where it would leave too few poses to fit, it is not advised."""
    given = ("ur5", cell.write("a.csv", cell.measure(count)), "--model", "geometry", "--out", "o")
    _, out, err = calib("fit", *given, "--holdout", "0.1")
    advised = re.search(r"--holdout (0\.\d+)", out)
    assert "measure at least 8 poses" in out and (advised is None) is (count == 20), err
    if advised is None:
        return
    _, out, err = calib("fit", *given, "--holdout", advised[1])
    assert "on a.csv, unseen" in out, err


@pytest.mark.slow
def test_few_unseen_poses_are_said_and_decide_nothing(cell, calib) -> None:
    """Seven poses are named on the console, in the verdict and on the certificate; eight decide it."""
    file, other = cell.write("a.csv", cell.measure(60)), cell.measure(8, 1)
    for count in (7, 8):
        validated = cell.write(f"v{count}.csv", other[:count])
        _, out, err = calib("fit", "ur5", file, "--model", "geometry", "--validate", validated, "--out", f"o{count}")
        said = f"v{count}.csv: too few unseen poses ({count} of 8)"
        page = Path(f"o{count}/report.html").read_text()
        assert (said in out) is (said in page) is (count == 7), err
        assert (f"by cross-validation only (too few unseen poses: v{count}.csv {count} of 8)" in out) is (count == 7)
        assert (f"on v{count}.csv, unseen" in out) is (count == 8)
