"""Applications import what `calib.apps.PUBLIC` lists, and no inner module of the toolkit."""

import ast
from importlib import import_module
from pathlib import Path

import pytest

import calib
from calib.apps import PUBLIC

APPS = Path(calib.__file__).parent / "apps"

# inner modules that an application still imports: a number that only falls; those that are not here import none
INNER_IMPORTS = {
    "camera": 0,
    # (kept apart so that two branches can lower neighbours)
    "cell_demo": 0,
    #
    "certificate": 0,
    #
    "compensation": 0,
    #
    "controller_programs": 0,
    #
    "fleet": 0,
    #
    "joining": 0,
    #
    "monitoring": 0,
    #
    "registration": 0,
    #
    "serve": 0,
    #
    "studies": 0,
    #
    "viewer": 0,
}


def inner_imports(source: str) -> list[str]:
    """Return which modules of the toolkit a source imports that are neither public nor applications, with the line."""
    inner = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            if node.module == "calib":
                modules = [f"calib.{alias.name}" for alias in node.names if alias.name not in calib.__all__]
            else:
                modules = [node.module or ""]
        elif isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names if alias.name != "calib"]
        else:
            continue
        below = [module for module in modules if module.startswith("calib.")]
        inner += [f"line {node.lineno}: {module}" for module in below if not is_public(module)]
    return inner


def is_public(module: str) -> bool:
    return any(module == name or module.startswith(f"{name}.") for name in (*PUBLIC, "calib.apps"))


@pytest.mark.parametrize("package", sorted(path.name for path in APPS.iterdir() if (path / "__init__.py").exists()))
def test_an_application_imports_public_names(package):
    inner = []
    for path in sorted((APPS / package).rglob("*.py")):
        lines = inner_imports(path.read_text(encoding="utf-8"))
        inner += [f"{path.relative_to(APPS)} {line}" for line in lines]
    limit = INNER_IMPORTS.get(package, 0)
    advice = "import it from calib.toolkit, and add it there where it is missing"
    assert len(inner) <= limit, f"{len(inner)} inner modules, {limit} before; {advice}:\n" + "\n".join(inner)
    assert len(inner) == limit, f"well done: lower {package} to {len(inner)} in INNER_IMPORTS"


def test_every_form_of_import_is_read():
    source = "import calib\nfrom calib import fit_geometry, files, robot\nimport calib.geometry.fit as fit\n"
    source += "def f():\n    from calib.procedure.report import page\n    from calib.toolkit.chains import Chain\n"
    assert inner_imports(source) == [
        "line 2: calib.robot",
        "line 3: calib.geometry.fit",
        "line 5: calib.procedure.report",
    ]


def test_public_parts_offer_what_they_list():
    """The public parts offer what they list."""
    for path in sorted((APPS.parent / "toolkit").glob("[a-z]*.py")):
        module = import_module(f"calib.toolkit.{path.stem}")
        assert [name for name in module.__all__ if not hasattr(module, name)] == []
