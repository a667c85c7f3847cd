"""A small cell with a known truth: a UR5 whose parameters are a little off, seen by a tracker."""

import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from without_figures import words

from calib import cli
from calib.cli.shared import MAX_LINES
from calib.robot.chain import Chain
from calib.robot.kinematics import forward
from calib.robot.library import load
from calib.transforms import from_xyz_rpy, to_quaternion

STATION = from_xyz_rpy([1.5, -0.8, 0.4], [0.1, -0.2, 2.0])
TOOL = from_xyz_rpy([0.05, 0.02, 0.1], [0.3, 0.1, -0.2])
NOISE = 2e-5


@dataclass
class Cell:
    """Measurements of a robot whose true values are known."""

    folder: Path
    nominal: Chain
    truth: Chain

    def measure(self, count: int = 60, seed: int = 0, station: np.ndarray = STATION) -> list[dict[str, float]]:
        generator = np.random.default_rng(seed)
        q = generator.uniform(-2.5, 2.5, (count, self.truth.n))
        poses = station @ forward(self.truth, q) @ TOOL
        seen = poses[:, :3, 3] + NOISE * generator.standard_normal((count, 3))
        quaternion = to_quaternion(poses)
        names = [*(f"q{j + 1}" for j in range(self.truth.n)), "x", "y", "z", "qx", "qy", "qz", "qw"]
        return [dict(zip(names, map(float, row))) for row in np.hstack([q, seen, quaternion])]

    def write(self, name: str, rows: list[dict], columns: list[str] | None = None) -> Path:
        path = self.folder / name
        columns = columns or [key for key in rows[0] if key[0] != "q" or key[1].isdigit()]
        with path.open("w", newline="") as file:
            writer = csv.DictWriter(file, columns, extrasaction="ignore")
            writer.writeheader()
            writer.writerows(rows)
        return path


@pytest.fixture(scope="session")
def cell_in() -> Callable[[Path], Cell]:
    """Return a function that gives the cell whose files lie in a folder."""
    nominal = load("ur5")
    generator = np.random.default_rng(7)
    moved = [5e-4 if element.axis[0] == "t" else 2e-3 for element in nominal.elements]
    truth = nominal.with_values(nominal.values + np.array(moved) * generator.uniform(-1, 1, len(moved)))
    return lambda folder: Cell(folder, nominal, truth)


@pytest.fixture
def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cell_in: Callable[[Path], Cell]) -> Cell:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("CALIB_DEBUG", raising=False)
    return cell_in(tmp_path)


@pytest.fixture
def figures() -> bool:
    """Say whether commands draw figures, which takes a second; a test that wants them overrides this."""
    return False


@pytest.fixture
def calib(capsys: pytest.CaptureFixture[str], figures: bool):
    """Return a function that runs a command: its exit code, and what it said on stdout and stderr."""

    def run(*arguments: object) -> tuple[int, str, str]:
        code = cli.run([str(argument) for argument in arguments] if figures else words(*arguments))
        said = capsys.readouterr()
        lines = [line for line in said.out.splitlines() if not line.lstrip().startswith(("verdict", "warning"))]
        results_are_tables = {"formats", "explain", "run", "study", "compare", "-v", "--help"} & set(arguments)
        assert results_are_tables or len(lines) <= MAX_LINES + 1, "without -v a command prints 25 lines at most"
        return code, said.out, said.err

    return run
