"""Files of full poses that hold nearly one orientation: placed as well as by their positions, and honestly left out."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.data.poses.measurements import Poses, Positions
from calib.geometry.accuracy import errors
from calib.geometry.first_guess import install
from calib.geometry.fit import placed_on
from calib.geometry.installation import Installation
from calib.geometry.inverse import Goal, reach
from calib.geometry.model_choice.ladder import select_model
from calib.geometry.weighing import Settings
from calib.robot.chain import Chain
from calib.robot.kinematics import forward
from calib.robot.library import load
from calib.simulation.cell import Cell, SimulatedInstrument, measure
from calib.simulation.virtual_cells import perturbed_cell, rigid

START = np.array([0.3, -1.4, 1.6, -1.7, -1.5, 0.4])


def driven(chain: Chain, kind: str, count: int, tilt: float, seed: int) -> np.ndarray:
    """Return joints (count, 6) along a line, a curve or over a surface; orientations differ by `tilt` [rad]."""
    s, rng = np.linspace(0.0, 1.0, count), np.random.default_rng(seed)
    ways = {
        "line": (0.0 * s, 0.5 * s - 0.25, 0.0 * s),
        "curve": (0.1 * np.cos(6.0 * s), 0.5 * s - 0.25, 0.1 * np.sin(6.0 * s)),
        "surface": (0.2 * np.cos(40.0 * s) * s, 0.2 * np.sin(40.0 * s) * s, 0.05 * np.cos(6.0 * s)),
    }
    targets = np.repeat(forward(chain, START[None]), count, axis=0)
    targets[:, :3, 3] += np.stack(ways[kind], axis=1)
    targets[:, :3, :3] = targets[:, :3, :3] @ Rotation.from_rotvec(tilt * rng.standard_normal((count, 3))).as_matrix()
    return reach(Goal(Installation(chain)), targets, np.repeat(START[None], count, axis=0))


def probe(seed: int, hidden: float = 0.3) -> Cell:
    return perturbed_cell(load("ur10"), seed, SimulatedInstrument("6-D probe", 30e-6, 1e-4), hidden=hidden)


def rms(cell: Installation, block: Positions) -> float:
    return float(np.sqrt(np.mean(errors(cell, [block]).main ** 2)))


@pytest.mark.parametrize("tilt", [0.0, pytest.param(1e-3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", [pytest.param("line", marks=pytest.mark.slow), "curve", "surface"])
def test_one_orientation_is_placed_well(kind, tilt):
    """Such poses were placed 300 mm wrong: rotations alone tell nothing of where the instrument stands there."""
    for seed in (1,):
        cell = rigid(probe(seed))
        block = measure(cell, driven(cell.nominal, kind, 80, tilt, seed), seed)
        assert isinstance(block, Poses)
        points = Positions(block.q, block.joint_names, block.position, sigma=block.sigma)
        for arm, most in ((Installation(cell.nominal), 1.1), (Installation(cell.truth.chain), 1.5)):
            whole, some = (placed_on(arm, each, Settings()) for each in (block, points))
            assert whole.solution.status.good
            assert rms(whole.cell, block) < most * max(rms(some.cell, points), 52e-6)


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [1.0])
def test_task_files_do_not_hide_the_model(hidden):
    """Leaving out the spread poses as a whole asks two surfaces of one orientation where its tool would be."""
    cell = probe(0, hidden)
    rng = np.random.default_rng(5)
    spread = rng.uniform(-2.0, 2.0, (40, 6))
    surfaces = [driven(cell.nominal, kind, 80, 0.0, 3) for kind in ("surface", "curve")]
    blocks = [replace(measure(cell, q, k), station=f"{k}") for k, q in enumerate([spread, *surfaces])]
    found = select_model(install(cell.nominal, blocks), blocks)
    assert found.folds.blind == ("0",)
    assert found.chosen.startswith("geometry")
    unseen = measure(cell, rng.uniform(-2.0, 2.0, (200, 6)), 9)
    after, before = (rms(replace(each.cell, station_names=("station", "1", "2")), unseen)
                     for each in (found.fit, found.nominal))  # fmt: skip
    assert after < 0.2 * before


def test_rows_without_tool_left_out_singly():
    """Regions of a driven surface, a tool of its own on the arm, were asked where that tool is, whatever the model."""
    cell = probe(0, 0.0)
    q = np.random.default_rng(5).uniform(-2.0, 2.0, (40, 6))
    blocks = [measure(cell, q, 0), measure(cell, driven(cell.nominal, "surface", 12, 0.02, 3), 1)]
    names = ("spread", "surface")
    blocks = [
        replace(each, station=name, tool=np.full(len(each), k), tool_names=names)
        for k, (each, name) in enumerate(zip(blocks, names))
    ]
    found = select_model(install(cell.nominal, blocks), blocks, model="geometry")
    assert found.folds.blind == names
    assert found.rungs[-1].model == "geometry" and found.rungs[-1].cross_validated < 0.15e-3
