"""Sphinx's settings; `python docs/build.py` builds the pages."""

import os
import sys
from importlib.metadata import version as _version
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))
# where notebooks find practice.py
os.environ["PYTHONPATH"] = os.pathsep.join([str(HERE.parent / "examples"), os.environ.get("PYTHONPATH", "")])

project = "armature-calib"
author = "the calibration toolkit's founders"
version = release = _version("armature-calib")
html_title = f"{project} {version}"

extensions = ["equations", "myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_static_path = ["style.css"]
html_css_files = ["style.css"]
html_math_renderer = "drawings"
smartquotes = False  # two dashes are an option
default_role = "literal"
html_show_copyright = html_copy_source = html_show_sourcelink = False
myst_enable_extensions = ["dollarmath", "amsmath", "deflist", "attrs_inline"]
myst_heading_anchors = 3

autodoc_default_options = {"member-order": "bysource"}
autodoc_typehints = "signature"
napoleon_numpy_docstring = False
napoleon_use_ivar = True
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_execution_timeout = 600
nb_merge_streams = True
suppress_warnings = ["ref.python"]  # errors that both poses and trajectories have


def setup(app: Any) -> dict[str, bool]:
    """Write the reference before the pages are read, and lay docstrings out as they are in the source."""
    import reference

    def lay_out(app: Any, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
        lines[:] = reference.readable("\n".join(lines)).splitlines()

    reference.write()
    app.connect("autodoc-process-docstring", lay_out, priority=100)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
