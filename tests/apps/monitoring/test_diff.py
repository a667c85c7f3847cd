"""Two calibrations of one robot: nothing moved, or what moved is found and named."""

from types import SimpleNamespace

import numpy as np
import pytest
from recordings import DATA

import calib
from calib import cli
from calib.apps.monitoring.comparison.tool_part import ToolPart
from calib.apps.monitoring.settings import DiffSettings
from calib.errors import RobotError, UsageError

UR5 = DATA / "ur5_gts3800"
pytestmark = pytest.mark.skipif(not UR5.is_dir(), reason=f"no recording of a UR5 at {UR5} (set CALIB_DATA)")
JOINTS = [f"joint_{k} [rad]" for k in range(1, 7)]
NAMES = ("first", "second", "crashed")


@pytest.fixture(scope="module")
def fits(tmp_path_factory):
    """Fits of every other pose of the recording, the last one with a joint 3 that reads 1 mrad less; by name."""
    folder = tmp_path_factory.mktemp("fits")
    rows = np.genfromtxt(UR5 / "grid_800.csv", delimiter=",", skip_header=1)[:, [*range(6), 9, 10, 11]]
    for name, start, zero in zip(NAMES, (0, 1, 1), (0.0, 0.0, 1e-3)):
        part = rows[start::4] - zero * (np.arange(9) == 2)
        header = ",".join([*JOINTS, "x [m]", "y [m]", "z [m]"])
        np.savetxt(folder / f"{name}.csv", part, delimiter=",", header=header, comments="")
        settings = calib.FitSettings(model="geometry", holdout=0.2)
        calib.fit_geometry(UR5 / "model.urdf", folder / f"{name}.csv", settings).save(folder / name, plots=False)
    return folder


def test_halves_of_recording_are_unchanged(fits):
    """Two halves of a recording are of an unchanged arm."""
    found = calib.diff(fits / "first", fits / "second", DiffSettings(tolerance=3e-4))
    assert found.geometry.probability > 0.01 and found.verdict == "pass" and "still within" in found.verdict.reason
    assert found.geometry.motions[0].rms < 2.0 * found.geometry.motions[0].expected


def test_planted_joint_offset_is_named(fits):
    """A planted joint offset is found and named."""
    found = calib.diff(fits / "first", fits / "crashed")
    first = found.geometry.parameters[0]
    assert found.verdict == "marginal" and found.geometry.alone and first.name == "joint_3.offset"
    assert abs(first.alone - 1e-3) < 3.0 * first.alone_sigma < 2e-4
    assert max(found.geometry.by_joint, key=lambda one: one[1])[0] == "joint_3"
    assert "a change of joint_3.offset alone (" in str(found)


def test_tolerance_near_fits_is_marginal(fits):
    """A tolerance that holds near the fits alone is marginal."""
    found = calib.diff(fits / "first", fits / "crashed", DiffSettings(tolerance=3e-4))
    assert found.parts[0].today < 3e-4 < found.geometry.motions[1].rms
    assert found.verdict == "marginal" and "near the poses of the fits" in str(found)


@pytest.mark.slow
def test_base_and_tool_count_only_where_told(fits):
    """A base that moved is no change of the arm, unless instrument and target were left as they were."""
    moved = fits / "moved"
    if not moved.exists():
        table = np.genfromtxt(fits / "second.csv", delimiter=",", skip_header=1)
        table[:, 6:] += (0.2, 0.0, 0.1)
        header = (fits / "second.csv").read_text().split("\n")[0]
        np.savetxt(fits / "moved.csv", table, delimiter=",", header=header, comments="")
        settings = calib.FitSettings(model="geometry", holdout=0.2)
        calib.fit_geometry(UR5 / "model.urdf", fits / "moved.csv", settings).save(moved, plots=False)
    free, held = (
        calib.diff(fits / "first", moved, DiffSettings(same_base=each, same_tool=each)) for each in (False, True)
    )
    assert free.verdict == "pass" and free.geometry.motions[0].rms < 1e-4
    assert held.verdict == "marginal" and held.geometry.motions[0].rms == pytest.approx(np.hypot(0.2, 0.1), rel=1e-3)


def test_command_exits_1_and_writes_folder(fits, tmp_path, capsys):
    """The command exits with 1 beyond the tolerance and writes a folder."""
    pair = [str(fits / "first"), str(fits / "crashed")]
    assert cli.run(["diff", *pair, "--tolerance", "0.1", "--plots", "svg", "--out", str(tmp_path / "out")]) == 1
    assert "verdict: fail: not within the tolerance of 0.1 mm" in capsys.readouterr().out
    assert {"report.html", "changes.csv", "metrics.json", "plot_map.svg", "plot_parameters.svg"} <= {
        each.name for each in (tmp_path / "out").iterdir()
    }
    assert cli.run(["diff", *pair, "--tolerance", "0.3"]) == 0


def test_the_nominal_robot_is_one_of_the_two(fits):
    found = calib.diff(UR5 / "model.urdf", fits / "first")
    assert found.geometry.sigmas > 30.0 and not found.geometry.alone
    with pytest.raises(UsageError, match="a nominal robot has no base placement"):
        calib.diff(UR5 / "model.urdf", fits / "first", DiffSettings(same_base=True))


def test_what_cannot_be_compared_is_refused(fits, tmp_path):
    with pytest.raises(RobotError, match=r"different robots \(ur5, panda\): joints joint_1"):
        calib.diff(fits / "first", "panda")
    with pytest.raises(UsageError, match="give folders of fits, of identifications or of sessions"):
        calib.diff(fits / "first", tmp_path)
    with pytest.raises(UsageError, match="neither ur5 nor panda is"):
        calib.diff("ur5", "panda")


def test_obstacles_to_comparison_are_said():
    """Combinations that one alone has, a failed one, another serial number, several parameters changed."""
    cell = SimpleNamespace(deflection=SimpleNamespace(terms=()))
    fit = SimpleNamespace(cell=cell, residual_rms=1e-4, judged=("fail", "bad"))
    one, two = (SimpleNamespace(**vars(fit), name=name, serial=name) for name in ("a", "b"))
    moved = SimpleNamespace(rms=1e-3, expected=1e-5)
    first = SimpleNamespace(name="joint_3.offset", alone=1e-3, alone_sigma=1e-5, unit="rad")
    found = SimpleNamespace(
        motions=[moved, moved], chi2=99.0, freedom=9, sigmas=9.0, probability=1e-9, changed=True,
        parameters=[first], alone=False, unexplained=50.0, rivals=[], extra=(1, 2), frames={},
    )  # fmt: skip
    codes = {each.code for each in ToolPart(one, two, found, None, DiffSettings()).noticed}
    assert {"combinations-left-out", "earlier-failed", "other-serial-number", "several-parameters-changed"} <= codes


@pytest.mark.slow
def test_joint_corrections_compared_apart(fits):
    """A URDF does not contain them: geometry is compared without them, and the note says what moved with them."""
    calib.fit_geometry(UR5 / "model.urdf", fits / "second.csv", calib.FitSettings(holdout=0.2)).save(
        fits / "corrected", plots=False
    )
    found = calib.diff(fits / "first", fits / "corrected")
    (note,) = (each for each in found.noticed if each.code == "corrections-not-compared")
    assert note.values["names"] == (str(fits / "corrected"),) and found.parts[0].after.cell.deflection.terms
    assert note.values["moved"] > 2.0 * found.geometry.motions[0].rms
