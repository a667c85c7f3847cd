"""A result file's name is written in one module of `calib`: whoever else needs the file asks there."""

import re
from collections import defaultdict
from collections.abc import Iterator
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType

import pytest

from calib import result_kinds

SOURCES = sorted((Path(__file__).parents[1] / "calib").rglob("*.py"))
KINDS = "result_kinds.py"  # recognises folders by names whose homes stand above it
RESULTS = (
    "metrics.json", "estimate.csv", "covariance.csv", "chain_covariance.csv", "information.csv", "instrumental.csv",
    "dynamics.json", "drive_gains.csv", "errors.csv", "rows.json", "trajectory.toml", "front.csv", "rehearsal.csv",
    "robot.toml", "robot.urdf", "robot_for_corrections.urdf", "robot.xml", "joint_corrections.csv",
    "joint_corrections.txt", "report.json", "certificate.html", "certificate.pdf", "residuals.csv", "trajectory.csv",
    "run.csv", "arm.toml",
    "motion.csv", "approach.csv", "trajectory.yaml", "trajectory.json", "geometries.csv", "geometry_effects.csv",
    "sensitivity.csv", "covariance_torque.csv", "drift.csv", "parameters.json", "drives.csv", "joint_offsets.csv",
    "joint_origins.yaml", "mastering.toml",
    "ur_kinematics.yaml", "poses.csv", "validation_poses.csv", "selection.json", "summary.txt",
    "checked.txt", "cuts.json",
    "simulated.txt", "session.toml", "state.json", "session.rrd",
)  # fmt: skip


def paths(source: Path) -> set[str]:
    """Return the names of files in a module's string constants; sentences that speak of one are none."""
    found = set()
    for text in texts(SourceFileLoader(source.stem, str(source)).get_code(source.stem)):
        known = re.fullmatch(r"/?(?:[\w.*-]+/)*([\w-]+\.[a-z]+)", text)
        found |= {known[1]} if known else set()
    return found


def texts(value: object) -> Iterator[str]:
    """Yield the texts among the constants of compiled code, those of its functions and classes included."""
    if isinstance(value, str):
        yield value
    inside = value.co_consts if isinstance(value, CodeType) else value
    for inner in inside if isinstance(inside, (tuple, frozenset)) else ():
        yield from texts(inner)


def test_a_results_name_has_one_home() -> None:
    homes: dict[str, list[str]] = defaultdict(list)
    for source in SOURCES:
        if source.name == KINDS:
            continue
        for name in paths(source) & set(RESULTS):
            homes[name].append(str(source.relative_to(SOURCES[0].parent)))
    assert {name: where for name, where in homes.items() if len(where) > 1} == {}
    assert set(homes) == set(RESULTS)


def test_folders_are_recognised_by_names() -> None:
    """Folders are recognised by names that are written."""
    homes = set().union(*(paths(source) for source in SOURCES if source.name != KINDS))
    for kind in result_kinds.KINDS:
        for marks in kind.marks:
            assert set(marks) <= homes


@pytest.mark.parametrize("text", ["5-validation/metrics.json", "/metrics.json", "metrics.json"])
def test_a_path_is_seen(tmp_path: Path, text: str) -> None:
    (tmp_path / "m.py").write_text(f"x = folder / {text!r}\ny = 'see metrics.json there'\n")
    assert paths(tmp_path / "m.py") == {"metrics.json"}
