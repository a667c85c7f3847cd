"""`calib fit` and a session's steps fit, validate and certificate give one answer to the same files."""

import html
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import planted_motion as planted
import pytest
from both_ways import Judgement, agree, command, go_on, read, same, session_with
from sessions import edit

from calib.data.poses.pose_lists import read_poses
from calib.errors import finding
from calib.procedure.findings import sentence
from calib.procedure.session.folder import Session, open_session
from calib.robot.library import load
from calib.simulation.cell import measure, write_measured
from calib.simulation.virtual_cells import perturbed_cell


def by_command(robot: Path, out: Path, model: str, fit: Path, unseen: Path) -> Judgement:
    refused = command("fit", robot, fit, "--validate", unseen, "--model", model, "--out", out)
    if refused:
        return Judgement(refused=refused)
    found = read(out / "metrics.json")
    numbers = {key: found[key] for key in ("fit", "validation", "model", "ladder", "not_identifiable")}
    numbers["outliers"] = named(found["outliers"])
    notes = plainly(found["warnings"], robot.parent, fit.parent, unseen.parent)
    return Judgement(found["verdict"], found["reason"], numbers, notes)


def named(outliers: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return outliers with their files' names, wherever these lie."""
    return [{**each, "file": Path(each["file"]).name} for each in outliers]


def flat(words: str) -> str:
    """Return words as a page may print them: whatever their case, line breaks and capitals are the page's own."""
    return " ".join(words.split()).casefold()


def plainly(notes: Iterable[str], *folders: Path) -> frozenset[str]:
    """Return notes without the folders that files lie in."""
    for folder in folders:
        notes = [note.replace(f"{folder}/", "") for note in notes]
    return frozenset(notes)


def by_session(robot: Path, folder: Path, model: str, fit: Path, unseen: Path) -> Judgement:
    session = session_with(folder, robot, model, fit, unseen)
    refused = go_on(session)
    if refused:
        return Judgement(refused=refused.replace(str(session.path("3-measured")), str(fit.parent)))
    fitted, held = read(session.path("4-fit/metrics.json")), read(session.path("5-validation/metrics.json"))
    numbers = {key: fitted[key] for key in ("fit", "model", "ladder", "not_identifiable")}
    numbers["outliers"] = named(fitted["outliers"])
    numbers["validation"] = held["validation"]
    page = flat(html.unescape(session.path("report.html").read_text()))
    for words in (held["reason"], *held["warnings"]):
        assert flat(words) in page
    notes = [note for step in read(session.path("state.json"))["steps"].values() for note in step["notes"]]
    assert set(held["warnings"]) <= {*notes, *fitted["warnings"]}
    assert set(fitted["warnings"]) <= {*notes, *held["warnings"]}
    notes = plainly(held["warnings"], session.path("3-measured"), session.path("1-robot"))
    return Judgement(held["verdict"], held["reason"], numbers, notes)


def clean(files: Path, place: Path) -> tuple[Path, Path, Path]:
    return files / "robot.toml", files / "measured.csv", files / "validation.csv"


def copied(files: Path, place: Path) -> tuple[Path, Path, Path]:
    lines = (files / "measured.csv").read_text().splitlines()
    (place / "validation.csv").write_text("\n".join([lines[0], *lines[5:25]]) + "\n")
    return files / "robot.toml", files / "measured.csv", place / "validation.csv"


def swapped(files: Path, place: Path) -> tuple[Path, Path, Path]:
    for name in ("measured", "validation"):
        head, rest = (files / f"{name}.csv").read_text().split("\n", 1)
        head = head.replace("joint2", "?").replace("joint3", "joint2").replace("?", "joint3")
        (place / f"{name}.csv").write_text(f"{head}\n{rest}")
    return files / "robot.toml", place / "measured.csv", place / "validation.csv"


def moved(files: Path, place: Path) -> tuple[Path, Path, Path]:
    """An instrument that stood half a metre off for validation."""
    head, *lines = (files / "validation.csv").read_text().splitlines()
    column = head.split(",").index("x [mm]")
    table = np.array([line.split(",") for line in lines], dtype=float)
    table[:, column] += 500.0
    np.savetxt(place / "validation.csv", table, delimiter=",", header=head, comments="", fmt="%.12g")
    return files / "robot.toml", files / "measured.csv", place / "validation.csv"


def named_oddly(files: Path, place: Path) -> tuple[Path, Path, Path]:
    fit, unseen = place / 'day1, "left"\nof it.csv', place / "validation, too.csv"
    shutil.copyfile(files / "measured.csv", fit)
    shutil.copyfile(files / "validation.csv", unseen)
    return files / "robot.toml", fit, unseen


def spoiled(files: Path, place: Path) -> tuple[Path, Path, Path]:
    lines = (files / "measured.csv").read_text().splitlines()
    cells = lines[9].split(",")
    column = lines[0].split(",").index(next(name for name in lines[0].split(",") if name.split(" ")[0] == "y"))
    lines[9] = ",".join([*cells[:column], str(float(cells[column]) + 50.0), *cells[column + 1 :]])
    (place / "measured.csv").write_text("\n".join(lines) + "\n")
    return files / "robot.toml", place / "measured.csv", files / "validation.csv"


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [copied, swapped, *(pytest.param(case, marks=pytest.mark.slow) for case in (clean, moved, named_oddly, spoiled))],
)
def test_command_and_session_agree(files: Path, tmp_path: Path, case: Callable[[Path, Path], tuple[Path, ...]]) -> None:
    robot, fit, unseen = case(files, tmp_path)
    one = by_command(robot, tmp_path / "out", "geometry", fit, unseen)
    two = by_session(robot, tmp_path / "cell", "geometry", fit, unseen)
    agree(one, two)
    if case is copied:
        assert any("20 rows" in note and "do not count as validation" in note for note in two.notes)
        assert any("used in the fit: validation.csv repeats rows of the fit" in note for note in two.notes)
        page = (tmp_path / "cell/report.html").read_text()
        assert "measured, NOT unseen by the fit" in page and "measured, unseen" not in page
        assert page.count(">cross-validated rows</td>") == 1
    if case is spoiled:
        assert two.verdict == "pass", "one wrong cell neither draws the fit nor fails it"
        assert not command("fit", robot, fit, "--loss", "none", "--model", "geometry", "--out", tmp_path / "none")
        noticed = {one["code"]: one["values"] for one in read(tmp_path / "none/metrics.json")["noticed"]}
        assert noticed["gross-rows"]["count"] == 1 and noticed["gross-rows"]["rows"][0].startswith("measured.csv row 9")
        assert "rigid-misfit" not in noticed


@pytest.mark.slow
def test_corrections_stay_as_the_nominal(files: Path, tmp_path: Path) -> None:
    """A robot that comes with corrections keeps them as its nominal."""
    first = files / "bent_first.csv"
    assert not command("fit", files / "robot.toml", first, "--model", "harmonics", "--out", tmp_path / "0")
    fit, unseen = tmp_path / "measured.csv", tmp_path / "validation.csv"
    for path in (fit, unseen):
        shutil.copyfile(files / f"bent_{path.name}", path)
    one = by_command(tmp_path / "0/robot.toml", tmp_path / "1", "geometry", fit, unseen)
    two = by_session(tmp_path / "0/robot.toml", tmp_path / "cell", "geometry", fit, unseen)
    agree(one, two)
    arms = two.numbers["validation"]["validation.csv"]
    nominal, calibrated = (arms[arm]["position_mm"]["rms"] for arm in ("nominal", "calibrated"))
    assert nominal < 1.5 * calibrated  # it is calibrated already


@pytest.mark.slow
def test_odd_file_names_are_allowed(files: Path, tmp_path: Path) -> None:
    """A file's name may hold commas, quotes and line breaks."""
    robot, fit, unseen = named_oddly(files, tmp_path)
    out = tmp_path / "out"
    assert not command("fit", robot, fit, "--validate", unseen, "--model", "harmonics", "--out", out)
    targets = tmp_path / "targets.csv"
    targets.write_text("joint1 [rad],joint2 [rad],joint3 [rad]\n0.1,0.2,0.3\n-0.4,0.5,0.6\n")
    assert not command("compensate", out, targets, "--dof", "3", "--tolerance", "10,1000", "--out", tmp_path / "q.csv")
    assert not command("export", out, "--offsets", tmp_path / "offsets.csv")
    assert len((tmp_path / "q.csv").read_text().splitlines()) == 3
    assert load(out).n == 3


def planned(session: Session) -> None:
    """Let a session without plans choose its poses, which have to be measured then."""
    edit(session.path("session.toml"), "plan = false", "plan = true")
    for name in ("measured", "validation"):
        session.path(f"3-measured/{name}.csv").unlink()
    go_on(session)


@pytest.mark.slow
def test_promise_of_poses_is_checked(fitted: Path, tmp_path: Path) -> None:
    """What the poses promised is held against the same figures."""
    session = open_session(shutil.copytree(fitted, tmp_path / "cell"))
    planned(session)
    cell, names = perturbed_cell(planted.arm(), seed=1, hidden=0.0), planted.arm().joint_names
    for plan, name in (("poses", "measured"), ("validation_poses", "validation")):
        q = read_poses(session.path(f"2-poses/{plan}.csv"), names)
        write_measured(measure(cell, q, seed=2), session.path(f"3-measured/{name}.csv"))
    assert not go_on(session)
    robot, measured = session.path(session.settings.robot.file), session.path("3-measured/measured.csv")
    words = ("fit", robot, measured, "--model", "geometry", "--out", tmp_path / "out")
    for selection in (session.path("2-poses"), session.path("2-poses/poses.csv")):
        assert not command(*words, "--selection", selection)
        places = (tmp_path / "out/metrics.json", session.path("4-fit/metrics.json"))
        noticed = [{one["code"]: one["values"] for one in read(place)["noticed"]} for place in places]
        one, two = (found["sigma-ratio"] for found in noticed)
        same(one, two)
    assert 0.8 < one["median"] < 1.25  # as many poses, and as noisy, as was said
    said = sentence(finding("sigma-ratio", **one))
    assert flat(said) in flat(html.unescape(session.path("report.html").read_text()))
    assert said in read(session.path("state.json"))["steps"]["fit"]["notes"]
    foreign = session.path("2-poses/poses_prediction.json").read_text().replace("joint1", "axis1")
    (tmp_path / "foreign_prediction.json").write_text(foreign)
    assert "another robot" in command(*words, "--selection", tmp_path / "foreign.csv")
    assert "not found" in command(*words, "--selection", tmp_path / "nothing.csv")


@pytest.mark.slow
def test_the_same_poses_are_chosen(fitted: Path, files: Path, tmp_path: Path) -> None:
    out, session = tmp_path / "poses.csv", open_session(shutil.copytree(fitted, tmp_path / "cell"))
    planned(session)
    device, place = session.settings.instrument, ",".join(map(str, session.settings.instrument.tool))
    sigmas = f"{device.sigma_position},{device.sigma_orientation}"
    assert not command("select", files / "robot.toml", "-m", 4, "--tool", place, "--sigma", sigmas, "--out", out)
    names = load(fitted / "4-fit").joint_names
    chosen = read_poses(session.path("2-poses/poses.csv"), names)
    np.testing.assert_allclose(chosen, read_poses(out, names), atol=1e-6)


@pytest.mark.slow
def test_the_same_robot_is_exported(fitted: Path, tmp_path: Path) -> None:
    out = tmp_path / "joint_offsets.csv"
    assert not command("export", fitted / "4-fit", "--offsets", out)
    assert out.read_bytes() == (fitted / "6-export/joint_offsets.csv").read_bytes()
    for name in ("robot.toml", "robot.urdf"):
        assert (fitted / "4-fit" / name).read_bytes() == (fitted / "6-export" / name).read_bytes()
