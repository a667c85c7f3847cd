"""Counts: how many parameters poses can tell, against 4R + 2P + 6 and the numbers of the literature."""

from dataclasses import replace

import numpy as np
import pytest
from planted import cell, load, measure, perturb, random_joints

from calib.data.poses.measurements import PoseMeasurements, Poses
from calib.geometry.installation import Installation, see
from calib.geometry.observability import base_columns, observation_matrix
from calib.geometry.observation import layout, prepare
from calib.robot import mdh
from calib.robot.chain import Chain
from calib.robot.formats import urdf, urdf_write
from calib.simulation import lwr4plus
from calib.transforms import to_quaternion


def split(installation: Installation, kind: str = "pose", candidates=None, tolerance: float = 1e-7, count: int = 80):
    measured = measure(installation, kind, count, 11)
    columns = np.arange(len(layout(installation).names)) if candidates is None else candidates
    return base_columns(installation, prepare(installation, [measured]), columns, tolerance)


def exact_poses(installation: Installation, q: np.ndarray) -> PoseMeasurements:
    poses = see(installation, q).poses()
    names = installation.chain.joint_names
    return Poses(q, names, position=poses[:, :3, 3], quaternion=to_quaternion(poses))


def scara(beta: bool = True) -> Chain:
    rows = [
        mdh.Row("j1", 1, r=0.3, lower=-2, upper=2),
        mdh.Row("j2", 2, d=0.25, lower=-2, upper=2),
        mdh.Row("j3", 3, "prismatic", d=0.2, lower=-0.2, upper=0.0),
        mdh.Row("j4", 4, lower=-3, upper=3),
    ]
    return mdh.chain("scara", rows, propose_beta=beta)


def without_beta(chain: Chain) -> Chain:
    return replace(chain, elements=tuple(e for e in chain.elements if not e.name.startswith("beta")))


def on_axis(installation: Installation) -> Installation:
    tool = np.eye(4)
    tool[2, 3] = 0.05
    return replace(installation, tools=tool[None])


ROBOTS = {"lwr4plus": lambda: load("lwr4plus"), "ur5": lambda: load("ur5"), "scara": scara}


@pytest.mark.parametrize(
    "name, kind, rank",
    [(n, "pose", r) for n, r in (("lwr4plus", 34), ("ur5", 30), ("scara", 20))]
    + [(n, "position", r) for n, r in (("lwr4plus", 31), ("ur5", 27))],
)
def test_with_general_frames(name, kind, rank):
    found = split(cell(ROBOTS[name](), 2), kind)
    assert found.rank == rank
    assert found.gap > 1e6  # what is dropped is nothing, what is kept is much
    assert found.singular_values[rank - 1] > 1e-4 * found.singular_values[0]


@pytest.mark.parametrize("name, rank", [("lwr4plus", 29), ("ur5", 25)])
def test_target_on_last_axis_tells_two_fewer(name, rank):
    """A target on the last axis tells two fewer."""
    found = split(on_axis(cell(ROBOTS[name](), 2)), "position")
    assert found.rank == rank and found.gap > 1e6


@pytest.mark.parametrize("name, lost", [("ur5", 2), ("scara", 3)])
def test_parallel_axes_need_beta_to_tilt(name, lost):
    """Without Hayati's beta parallel axes cannot tilt."""
    chain = ROBOTS[name]()
    assert split(cell(without_beta(chain), 2)).rank == split(cell(chain, 2)).rank - lost


def test_ur5_without_beta_is_28():
    assert split(cell(without_beta(load("ur5")), 2)).rank == 28


@pytest.mark.parametrize("name", ROBOTS)
def test_general_geometry_has_nominal_count(name):
    """4R + 2P + 6 does not depend on the axes being parallel or crossing; without β it is reached off the parallels."""
    chain = ROBOTS[name]()
    count = sum(4 if joint.kind == "revolute" else 2 for joint in chain.joints) + 6
    assert split(cell(chain, 2)).rank == count
    assert split(cell(perturb(chain, 5, 0.05, 0.2), 2)).rank == count
    assert split(cell(perturb(without_beta(chain), 5, 0.05, 0.2), 2)).rank == count


@pytest.mark.parametrize("kind, ranks", [("pose", (34, 30, 20)), ("position", (31, 27, None))])
def test_six_elements_tell_the_same(kind, ranks, tmp_path):
    """An MDH table and a URDF of the same arm: other parameters, the same count."""
    for name, rank in zip(ROBOTS, ranks):
        table = ROBOTS[name]()
        file = tmp_path / f"{name}.urdf"
        file.write_text(urdf_write.write_new(table))
        chain = urdf.read(file, table.base, table.tip)
        assert len(chain.elements) >= 6 * chain.n
        found = split(cell(chain, 2), kind)
        assert found.rank == (rank or split(cell(table, 2), kind).rank)
        assert found.gap > 1e6


def test_both_descriptions_span_same_space(tmp_path):
    """Both descriptions span the same space."""
    table = load("ur5")
    (tmp_path / "ur5.urdf").write_text(urdf_write.write_new(table))
    other = urdf.read(tmp_path / "ur5.urdf", table.base, table.tip)
    spaces = []
    for chain in (table, other):
        installation = cell(chain, 2)
        blocks = prepare(installation, [exact_poses(installation, random_joints(table, 60, 1))])
        kept = base_columns(installation, blocks, np.arange(len(layout(installation).names))).kept
        spaces.append(np.linalg.qr(observation_matrix(installation, blocks, kept))[0])
    cosines = np.linalg.svd(spaces[0].T @ spaces[1], compute_uv=False)
    assert len(cosines) == 30
    assert cosines == pytest.approx(np.ones(30), abs=1e-3)  # the two weigh orientations by slightly different reaches


def paper_form(table: np.ndarray) -> Installation:
    """Return the paper's nine rows, frames 0 and 8 fixed: 36 parameters, no frames besides."""
    rows = [
        mdh.Row(f"frame{k}", k, "revolute" if 1 <= k <= 7 else "fixed", alpha=a, d=d, theta=theta, r=r)
        for k, (a, d, theta, r) in enumerate(table)
    ]
    limits = load("lwr4plus")
    moving = [replace(rows[k], lower=limits.lower[k - 1], upper=limits.upper[k - 1]) for k in range(1, 8)]
    return Installation(mdh.chain("paper", [rows[0], *moving, rows[8]], propose_beta=False))


@pytest.mark.parametrize(
    "tool, tolerance, rank",
    [
        ("plain", 1e-3, 32),  # alpha8 = d8 = 0: theta7 is theta8 and r7 is r8, exactly
        ("plain", 1e-9, 32),
        ("nominal", 1e-6, 33),  # d8 = 1.5 mm tells theta7 from theta8, hardly
        ("nominal", 1e-3, 32),
        ("calibrated", 1e-6, 34),  # alpha8 = 5.3e-4 tells r7 from r8, hardly
        ("calibrated", 1e-3, 32),
        ("tilted", 1e-3, 34),  # alpha8 = 0.3: healthy
    ],
)
def test_the_papers_nine_rows(tool, tolerance, rank):
    nominal, calibrated = lwr4plus.table_2()
    table = nominal.copy()
    if tool == "plain":
        table[8, :2] = 0.0
    elif tool == "calibrated":
        table = calibrated
    elif tool == "tilted":
        table[8, 0] = 0.3
    installation = paper_form(table)
    candidates = layout(installation).index("arm")
    assert len(candidates) == 36
    assert split(installation, candidates=candidates, tolerance=tolerance, count=200).rank == rank


def test_papers_choice_is_well_conditioned():
    """Without alpha0, d0, theta7, r7 the 32 columns are independent (facts, 2.1); with theta7 they hardly are."""
    installation = paper_form(lwr4plus.table_2()[0])
    table = layout(installation)
    kept = np.setdiff1d(table.index("arm"), table.find(["alpha0", "d0", "theta7", "r7"]))
    blocks = prepare(installation, [measure(installation, "pose", 200, 3)])
    matrix = observation_matrix(installation, blocks, kept)
    assert np.linalg.matrix_rank(matrix) == 32
    with_theta7 = np.union1d(kept, table.find(["theta7"]))
    assert np.linalg.cond(observation_matrix(installation, blocks, with_theta7)) > 100 * np.linalg.cond(matrix)


def test_frames_and_offsets_are_preferred():
    """What the first joint's placement and the base have in common stays with the base."""
    installation = cell(load("ur5"), 2)
    table = layout(installation)
    kept = {table.names[k] for k in split(installation).kept}
    assert {table.names[k] for k in table.frame_index} <= kept
    assert not {"alpha1", "d1", "r1", "theta1"} & kept  # all four merge with the six of the station
    assert {f"theta{k}" for k in range(2, 6)} <= kept and "theta6" not in kept
    assert {"beta3", "beta4"} <= kept and not {"r2", "r3"} <= kept


def test_hayati_beta_wins_off_the_parallel():
    """On the arm as it really is alpha, d, beta, r, theta are one too many: r, ill defined there, stays at nominal."""
    installation = cell(perturb(load("ur5"), 5, 1e-3, 2e-3), 2)
    found = split(installation, tolerance=1e-9)
    kept = {layout(installation).names[k] for k in found.kept}
    assert found.rank == 30
    assert {"beta3", "beta4"} <= kept and not {"r2", "r3", "r4"} <= kept


def test_still_wrist_tells_fewer():
    """Poses that hold the wrist still tell fewer."""
    installation = cell(load("ur5"), 2)
    q = random_joints(installation.chain, 60, 0)
    q[:, 3:] = 0.3
    columns = np.arange(len(layout(installation).names))
    found = base_columns(installation, prepare(installation, [exact_poses(installation, q)]), columns)
    assert found.rank == 4 * 3 + 6 and found.gap > 1e6  # an arm of three joints


def test_distances_ignore_the_station():
    """Distances say nothing of the station."""
    installation = cell(load("ur5"), 2)
    found = split(installation, "distance", count=200)
    names = layout(installation).names
    silent = {names[k] for k in found.without_effect}
    assert {f"station.{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz")} <= silent
    assert found.rank == 27 - 6  # of what positions tell, less the station
