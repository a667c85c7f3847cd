"""Which module may import which, held against every import in the sources, those inside functions included."""

import ast
import os
import re
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from calib.data.poses import MODELS
from calib.dynamics.shapes import STEPS

ROOT = Path(__file__).parents[1]
PACKAGES = [name for name in ("calib", "poses", "trajectories") if (ROOT / name).is_dir()]
SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))

DOCUMENTATION = ROOT / "calib/apps/documentation/pages"
# heavy dependency -> the only modules that may import it (a trailing dot: all of that package)
HOMES = {
    "pinocchio": ["calib.robot.collision", "calib.robot.formats.simulators", "calib.parallel.export"],
    "coal": ["calib.robot.collision"],
    "numba": [
        "calib.dynamics.gradient_kernels",
        "calib.dynamics.kernels",
        "calib.dynamics.shape_kernels",
        "calib.parallel.mechanism.closure_kernels",
        "calib.parallel.mechanism.simulation_kernels",
        "calib.robot.capsule_kernels",
        "calib.identification.closed_loop.loop_kernels",
        "calib.identification.survey.tangent_kernels",
    ],
    "yourdfpy": ["calib.robot.formats.simulators"],
    "cv2": [
        "calib.data.images.detection",
        "calib.data.images.images",
        "calib.data.images.board_and_lens",
        "calib.data.images.board_print",
        "calib.data.images.marker_layout",
        "calib.simulation.rendered_camera",
    ],
    "ruamel": ["calib.data.trees", "calib.procedure.measuring.moveit"],
    "mcap": ["calib.data."],
    "rosbags": ["calib.data.recordings.bags", "calib.data.images."],
    "pandas": ["calib.api.result_table"],
    "pyarrow": ["calib.data.recordings.datasets"],
    "starlette": ["calib.apps.serve."],
    "uvicorn": ["calib.apps.serve.commands"],
    "python_multipart": ["calib.apps.serve.uploads"],
    "rerun": ["calib.apps.viewer.viewer"],
    "nlopt": ["calib.poses.", "calib.trajectories."],
    "toppra": ["calib.trajectories."],
    "ruckig": ["calib.trajectories."],
    "clarabel": ["calib.estimation."],
    "cvxpy": ["calib.identification.methods.convex"],  # users' constraints; in the tests an independent solver
    "matplotlib": ["calib.procedure.", "calib.api.", "calib.apps."],
    "jinja2": ["calib.procedure.report.templates", "calib.apps.controller_programs.program"],
    "typst": ["calib.procedure.report.certificate.rendering"],
    "dask": ["calib.workers.cluster"],
    "distributed": ["calib.workers.cluster"],
    "fsspec": ["calib.apps.fleet.stores"],
    "cloudpickle": ["calib.workers.cluster"],
    "threadpoolctl": ["calib.workers.threads"],
    "typer": ["calib.cli", "calib.cli.", "calib.apps."],
    "click": ["calib.cli", "calib.cli."],
    "rich": ["calib.cli", "calib.cli.", "calib.api.rendering", "calib.procedure.", "calib.apps."],
}


def module_of(path: Path) -> str:
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    return name if path.is_relative_to(ROOT / "calib") else f"calib.{name}"


def imports(path: Path) -> Iterator[tuple[str, int]]:
    """Yield every imported module's full name and its line."""
    yield from imported(path.read_text(encoding="utf-8"), path.relative_to(ROOT).parent.parts)


def imported(source: str, package: tuple[str, ...]) -> Iterator[tuple[str, int]]:
    """Yield what a module of a package imports; ``from a import b`` counts as a and as a.b."""
    for node in statements(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            stem = ".".join(
                [*package[: len(package) - node.level + 1], node.module or ""] if node.level else [node.module]
            )
            yield stem.rstrip("."), node.lineno
            yield from ((f"{stem.rstrip('.')}.{alias.name}", node.lineno) for alias in node.names)


def statements(above: ast.AST) -> Iterator[ast.AST]:
    """Yield all statements below a node; no expression holds an import."""
    for part in ("body", "orelse", "finalbody", "handlers", "cases"):
        for node in getattr(above, part, None) or ():
            yield node
            yield from statements(node)


def test_the_contracts_are_kept():
    """Layers and the absence of circles, as ``[tool.importlinter]`` in pyproject.toml states them."""
    code = "from importlinter.cli import lint_imports_command as lint; lint(['--no-cache', '--no-logo'])"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout


def test_heavy_dependencies_stay_at_home():
    strays, named = [], re.compile(rf"\b({'|'.join(HOMES)})\b")
    for path in SOURCES:
        if not named.search(path.read_text(encoding="utf-8")):
            continue
        module = module_of(path)
        for name, line in imports(path):
            homes = HOMES.get(name.split(".")[0])
            if homes is not None and not any(
                module == home or (home.endswith(".") and module.startswith(home)) for home in homes
            ):
                strays.append(f"{module} line {line} imports {name}, whose home is {', '.join(homes) or 'nowhere'}")
    assert strays == []


@pytest.mark.parametrize("package", ["poses", "trajectories"])
def test_experiment_design_imports_no_calib(package):
    """Neither by its installed name: what stands in these folders works wherever they are put."""
    for path in sorted((ROOT / package).rglob("*.py")):
        absolute = [node for node in statements(ast.parse(path.read_text())) if getattr(node, "level", 0) == 0]
        modules = [node.module or "" for node in absolute if isinstance(node, ast.ImportFrom)]
        modules += [alias.name for node in absolute if isinstance(node, ast.Import) for alias in node.names]
        assert not {"calib", "poses", "trajectories"} & {module.split(".")[0] for module in modules}, path


def test_walker_sees_every_form_of_import():
    """The walker sees every form of import."""
    inside = "def f():\n    from calib import cli\n    try: import poses.select as s\n    finally: import rerun\n"
    source = inside + "from ..robot import chain\nfrom . import columns\n"
    names = {name for name, _ in imported(source, ("calib", "estimation"))}
    assert {
        "calib.cli",
        "poses.select",
        "rerun",
        "calib.robot",
        "calib.robot.chain",
        "calib.estimation.columns",
    } <= names


def test_no_core_module_names_an_application():
    """Except the list of what `import calib` offers, whose entries are loaded when first used."""
    upper = [path for folder in ("parallel", "apps") for path in (ROOT / "calib" / folder).rglob("*.py")]
    core = [path for path in SOURCES if path not in upper and path != ROOT / "calib/__init__.py"]
    named = re.compile(r"(import|from) calib\.(parallel|apps)")
    assert [path for path in core if named.search(path.read_text(encoding="utf-8"))] == []


@pytest.mark.slow
def test_applications_can_be_removed(monkeypatch):
    """Without any application the core's commands, methods and formats are there; what they offer is asked for by name.

    What an instrument measures is fitted.
    """
    from calib import extensions
    from calib.errors import UsageError

    monkeypatch.setattr(extensions, "_offers", dict)
    assert extensions.Point("commands", "").all() == []
    with pytest.raises(UsageError):
        extensions.Point("optics", "").first()
    code = "import sys; sys.modules['calib.apps'] = None; "
    code += "import calib; from calib.cli import run; "
    code += "from calib.data.poses.measurements import PoseMeasurements as Measured; import numpy as np; "
    code += "rng = np.random.default_rng(0); q = rng.uniform(-1, 1, (40, 6)); robot = calib.load('tx40'); "
    code += "seen = Measured.of(q, robot.forward(q)[:, :3, 3] + rng.normal(0, 1e-4, (40, 3))); "
    code += "assert calib.fit_geometry(robot, seen, calib.FitSettings(model='offsets')).robot.chain.n == 6; "
    code += "sys.exit(run(['formats', 'mdh']))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_geometry_is_fitted_without_nlopt(tmp_path):
    """It is for a few searches of poses and motions, which import it where they use it."""
    code = "import sys; sys.modules['nlopt'] = None; import calib, practice; from calib.cli import run; "
    code += "import calib.poses.select, calib.trajectories.design.search; practice.measure('seen.csv', 40); "
    code += "sys.exit(run(['fit', 'ur5', 'seen.csv', '--model', 'offsets', '--no-plots', '--out', 'fit']))"
    environment = os.environ | {"PYTHONPATH": f"{ROOT}:{ROOT / 'examples'}"}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode in (0, 1) and (tmp_path / "fit/robot.urdf").exists(), done.stderr


def test_a_folder_holds_at_most_14_modules():
    counted = Counter(path.parent for path in SOURCES if path.name != "__init__.py")
    assert {folder.name: count for folder, count in counted.items() if count > 14} == {}


def test_folders_with_modules_are_packages():
    """Installation finds packages by their ``__init__.py``: a folder without one would be left out."""
    folders = {path.parent for path in SOURCES}
    assert [str(folder) for folder in folders if not (folder / "__init__.py").exists()] == []


def test_a_fit_loads_no_dynamics(loaded):
    """Loading these modules took longer than the mathematics of a fit."""
    heavy = {"scipy.signal", "scipy.stats", "scipy.interpolate", "numba", "calib.procedure.dynamic_stage.inputs", "cv2"}
    assert "calib.api.kinematic" in loaded["geometry"] and heavy & loaded["geometry"] == set()


def test_the_command_line_starts_light(loaded):
    """`calib --help` loads neither Pinocchio nor matplotlib nor the optimisers."""
    heavy = {"pinocchio", "matplotlib", "scipy", "numpy", "nlopt", "cvxpy", "jinja2", "numba"}
    assert "calib.cli" in loaded["command line"] and heavy & loaded["command line"] == set()


def test_every_package_file_is_installed():
    """Every file of the packages is installed."""
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    installed = {
        path
        for name, patterns in declared.items()
        for one in patterns
        for path in ROOT.joinpath(*name.split(".")).glob(one)
    }
    installed = {path for path in installed if DOCUMENTATION not in path.parents}  # behind a link
    there = {path for package in PACKAGES for path in (ROOT / package).rglob("*") if path.is_file()}
    assert {path for path in there if path.suffix != ".py" and "__pycache__" not in path.parts} == installed


def test_rungs_are_named_in_table_alone():
    """Help, schemas and examples of files list the rungs from there."""
    ladders = {"calib/data/poses/__init__.py": MODELS[4:], "calib/dynamics/shapes.py": tuple(STEPS)}
    for table, rungs in ladders.items():
        names = "|".join(rungs)
        listed = re.compile(rf"\b({names})\b\W{{1,12}}({names})\b\W{{1,12}}({names})\b")
        places = [str(path.relative_to(ROOT)) for path in sorted((ROOT / "calib").rglob("*.py"))]
        copies = [place for place in places if place != table and listed.search((ROOT / place).read_text())]
        assert copies == []
