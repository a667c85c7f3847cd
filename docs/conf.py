"""Sphinx's settings; `python docs/build.py` builds the pages."""

import sys
from importlib.metadata import version as _version
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

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
html_copy_source = html_show_sourcelink = False
myst_enable_extensions = ["dollarmath", "amsmath", "deflist", "attrs_inline"]
myst_heading_anchors = 3
